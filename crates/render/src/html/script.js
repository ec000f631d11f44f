(() => {
  "use strict";
  const root = document.documentElement;
  const STORE = "shearq-report-theme";
  const prefersDark = matchMedia("(prefers-color-scheme: dark)");
  // Some browsers refuse storage to files opened from disk; the choice then lasts as long as the page.
  try {
    const chosen = localStorage.getItem(STORE);
    if (chosen === "light" || chosen === "dark") root.dataset.theme = chosen;
  } catch {}

  const themeButton = () => {
    const button = document.getElementById("theme");
    const dark = () => (root.dataset.theme ? root.dataset.theme === "dark" : prefersDark.matches);
    const label = () => { button.textContent = dark() ? "Light" : "Dark"; };
    button.hidden = false;
    label();
    prefersDark.addEventListener("change", label);
    button.addEventListener("click", () => {
      const theme = dark() ? "light" : "dark";
      root.dataset.theme = theme;
      try { localStorage.setItem(STORE, theme); } catch {}
      label();
    });
  };

  // Numbers come before words, and what is missing comes last, in both directions.
  const NUMBER = 0, WORDS = 1, MISSING = 2;
  const collator = new Intl.Collator("en", { numeric: true });
  const key = (cell) => {
    if ("value" in cell.dataset) {
      const value = Number(cell.dataset.value);
      return Number.isNaN(value) ? { kind: MISSING } : { kind: NUMBER, value };
    }
    const value = cell.textContent.trim();
    return value === "" || value === "–" ? { kind: MISSING } : { kind: WORDS, value };
  };
  const compare = (a, b, sign) => {
    if (a.kind !== b.kind) return a.kind - b.kind;
    if (a.kind === NUMBER) return sign * (a.value < b.value ? -1 : a.value > b.value ? 1 : 0);
    return a.kind === WORDS ? sign * collator.compare(a.value, b.value) : 0;
  };

  // Ascending, descending, and back to the order of the report.
  const NEXT = { ascending: "descending", descending: null };
  const sortable = (table) => {
    const body = table.tBodies[0];
    const original = [...body.rows];
    const headings = [...table.tHead.rows[0].cells];
    table.tHead.classList.add("sortable");
    headings.forEach((heading, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...heading.childNodes);
      heading.append(button);
      button.addEventListener("click", () => {
        const now = heading.getAttribute("aria-sort");
        const next = now ? NEXT[now] : "ascending";
        headings.forEach((other) => other.removeAttribute("aria-sort"));
        if (next) heading.setAttribute("aria-sort", next);
        const sign = next === "descending" ? -1 : 1;
        const rows = next
          ? original
            .map((row) => ({ row, key: key(row.cells[column]) }))
            .sort((a, b) => compare(a.key, b.key, sign))
            .map(({ row }) => row)
          : original;
        body.append(...rows);
      });
    });
  };

  // Hides the rows that lack one of the words.
  const filterable = (table) => {
    const place = table.closest(".filtered");
    if (!place) return;
    const field = document.createElement("input");
    field.type = "search";
    field.placeholder = "Filter rows";
    field.setAttribute("aria-label", "Filter rows");
    const count = document.createElement("span");
    count.setAttribute("role", "status");
    field.addEventListener("input", () => {
      const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      const rows = [...table.tBodies[0].rows];
      let shown = 0;
      for (const row of rows) {
        const text = row.textContent.toLowerCase();
        row.hidden = !words.every((word) => text.includes(word));
        if (!row.hidden) shown += 1;
      }
      count.textContent = words.length ? `${shown} of ${rows.length} rows` : "";
    });
    place.querySelector(".tools").prepend(field, count);
  };

  const foldable = (table) => {
    if (!table.querySelector("th.detail")) return;
    const button = document.createElement("button");
    button.type = "button";
    const fold = (narrow) => {
      table.classList.toggle("narrow", narrow);
      button.textContent = narrow ? "All columns" : "Fewer columns";
      button.setAttribute("aria-expanded", String(!narrow));
    };
    fold(true);
    button.addEventListener("click", () => fold(!table.classList.contains("narrow")));
    table.closest(".table").querySelector(".tools").append(button);
  };

  // Marks the section at the top of the window in the contents.
  const contents = () => {
    const links = [...document.querySelectorAll("nav a")];
    const sections = links.map((link) => document.getElementById(link.hash.slice(1)));
    let current = null;
    const mark = () => {
      let at = 0;
      sections.forEach((section, k) => {
        if (section.getBoundingClientRect().top < innerHeight / 4) at = k;
      });
      if (innerHeight + scrollY >= root.scrollHeight - 2 && scrollY > 0) at = links.length - 1;
      if (links[at] === current) return;
      if (current) current.removeAttribute("aria-current");
      current = links[at];
      current.setAttribute("aria-current", "location");
      const nav = current.closest("nav");
      nav.scrollLeft = current.offsetLeft - nav.clientWidth / 3;
    };
    if (links.length === 0) return;
    addEventListener("scroll", mark, { passive: true });
    addEventListener("resize", mark);
    mark();
  };

  document.addEventListener("DOMContentLoaded", () => {
    themeButton();
    for (const table of document.querySelectorAll("main table")) {
      sortable(table);
      filterable(table);
      foldable(table);
    }
    contents();
  });
})();
