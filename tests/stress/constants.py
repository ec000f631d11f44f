#!/usr/bin/env python3
"""Which constants of the measurement matter: each one times 0.7 and 1.4, on the same simulated galaxies.

    python3 tests/stress/constants.py [--only REGEX] [--galaxies 2000] [--json constants.json] [--page crates/measure/CONSTANTS.md]

The constants are the numbers that `const` declares in crates/measure/src outside tests. A copy of the sources is built once,
in which each of them is a function that reads its factor from the environment; the sources themselves have no hook. The page
has the measured changes in its last column.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from cases import CASES, Case
from scenes import SHEAR, noise_field, render
from stress import read_catalogues, run_measure, stars_of, write_images

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "crates/measure/src"
DECLARATION = re.compile(
    r"^(?P<indent> *)(?P<vis>pub(?:\([a-z]+\))? )?const (?P<name>[A-Z][A-Z0-9_]*): (?P<type>f32|f64|usize|i32|u32|u64|isize) = (?P<value>[^;]+);(?: *// (?P<tail>.*))?$"
)
FACTORS = (0.7, 1.4)
#: Cases in which most branches of a measurement are taken, and the configuration that measures them.
SCANNED = [
    ("48/linear/star", "base"),
    ("48/linear/star", "snr7"),
    ("48/linear/star", "mixed"),
    ("48/linear/star", "radius8"),
    ("48/linear/star", "star50-each"),
    ("48/linear/star", "star100-image"),
    ("48/linear/star", "near16-24"),
    ("48/linear/star", "near10-16"),
    ("48/linear/star", "sky+0.5"),
    ("48/linear/star", "bad-pixels"),
    ("48/linear/star", "edge"),
    ("48/linear/star", "smoothed"),
    ("23/den/star", "base"),
]
#: Changes below these are called none: 10⁻³ in m is the requirement of surveys, and one per cent of the scatter is two
#: per cent of the galaxies.
NOTABLE = {"m": 1e-3, "scatter": 0.01, "flagged": 0.005}


@dataclass
class Constant:
    path: str
    line: int
    name: str
    type: str
    value: str

    @property
    def key(self):
        return f"{self.path}:{self.name}"


def constants():
    """The numeric constants."""
    found = []
    for path in sorted(SOURCES.rglob("*.rs")):
        if path.name == "tests.rs" or "tests" in path.parts:
            continue
        for number, line in enumerate(path.read_text().split("\n"), 1):
            if line.strip() == "#[cfg(test)]":
                break
            if match := DECLARATION.match(line):
                relative = str(path.relative_to(SOURCES))
                found.append(Constant(relative, number, match["name"], match["type"], match["value"]))
    return found


def with_hooks(text, wanted):
    """The source with functions instead of these constants."""
    lines = text.split("\n")
    for constant in wanted:
        match = DECLARATION.match(lines[constant.line - 1])
        rounds = "" if constant.type.startswith("f") else (
            " let w = if f < 1.0 { w.min(BASE as f64 - 1.0).max(0.0).floor() } else if f > 1.0 { w.max(BASE as f64 + 1.0).ceil() } else { w };"
        )
        lines[constant.line - 1] = (
            f"{match['indent']}#[allow(non_snake_case, unused)] {match['vis'] or ''}fn {constant.name}() -> {constant.type} {{ "
            f"const BASE: {constant.type} = {constant.value}; static FACTOR: std::sync::OnceLock<f64> = std::sync::OnceLock::new(); "
            f"let f = *FACTOR.get_or_init(|| std::env::var(\"SCAN\").ok().and_then(|s| s.strip_prefix(\"{constant.key}=\").and_then(|v| v.parse().ok())).unwrap_or(1.0)); "
            f"if f == 1.0 {{ return BASE; }} let w = BASE as f64 * f;{rounds} w as {constant.type} }}"
        )
    names = sorted({constant.name for constant in wanted}, key=len, reverse=True)
    declared = {constant.line for constant in wanted}
    call = re.compile(r"(?<![A-Za-z0-9_])(" + "|".join(names) + r")(?![A-Za-z0-9_(])")
    in_use = False
    for index, line in enumerate(lines):
        text = line.strip()
        in_use = in_use or bool(re.match(r"(pub(\([a-z]+\))? )?use ", text))
        if not in_use and index + 1 not in declared and not text.startswith("//"):
            lines[index] = call.sub(r"\1()", line)
        in_use = in_use and not text.endswith(";")
    return "\n".join(lines)


def build(found, work):
    """A program in which constants follow the environment, and those of them that can: a length of an array cannot."""
    tree = work / "tree"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".git", "target", "docs"))
    (tree / "docs").symlink_to(ROOT / "docs")
    sources = tree / "crates/measure/src"
    fixed = set()
    while True:
        for path in {constant.path for constant in found}:
            wanted = [constant for constant in found if constant.path == path and constant.key not in fixed]
            text = (SOURCES / path).read_text()
            (sources / path).write_text(with_hooks(text, wanted) if wanted else text)
        command = ["cargo", "build", "--release", "--bin", "shearq", "--message-format", "short"]
        run = subprocess.run(command, cwd=tree, capture_output=True, text=True)
        if run.returncode == 0:
            break
        lost = set()
        for path, line in re.findall(r"^crates/measure/src/(\S+?):(\d+):\d+: error", run.stderr, re.M):
            text = (sources / path).read_text().split("\n")[int(line) - 1]
            lost |= {c.key for c in found if re.search(rf"(?<![A-Z0-9_]){c.name}(?![A-Z0-9_])", text)}
        if not lost - fixed:
            raise SystemExit(run.stderr[-4000:])
        fixed |= lost
        print(f"{len(fixed)} constants are lengths or parts of other constants", flush=True)
    folder = os.environ.get("CARGO_TARGET_DIR") or tree / "target"
    program = shutil.copy(Path(folder) / "release/shearq", work / "shearq-scan")
    return str(program), [constant for constant in found if constant.key not in fixed]


def write_scene(name, galaxies, seed, folder):
    """Images of one case, written once for all measurements."""
    case = next(case for case in CASES if case.name == name)
    random = np.random.default_rng([seed, sum(name.encode())])
    grid = min(case.grid, 2 * int(np.ceil(np.sqrt(galaxies / 4) / 2)))
    stamps, psf = render(case, grid * grid, random, None)
    field = noise_field(case, stamps.shape[1:], random)
    fields = [field, -field]
    return write_images(case, stamps, stars_of(case, psf, grid, random, 2), fields, folder)


def measure(program, configuration, data, number, work, factor=None):
    """Mean response to shear, scatter and flags of each galaxy, or None where `measure` refuses."""
    options = SimpleNamespace(shearq=program, submission=configuration, threads=1)
    with tempfile.TemporaryDirectory(dir=work) as folder:
        environment = dict(os.environ)
        if factor:
            environment["SCAN"] = factor
        if run_measure(options, data, Path(folder) / "out", environment):
            return None
        tables = read_catalogues(Path(folder) / "out", ["e1", "e2", "R11", "R22", "flags"], number)
    stack = lambda name: np.array([table[name].to_numpy() for table in tables]).reshape(2, 2, -1)
    # Networks have no response.
    e = [stack(f"e{k}") / (np.nanmean(r) if np.isfinite(r := stack(f"R{k}{k}")).any() else 1.0) for k in (1, 2)]
    return np.array(e), stack("flags")


def change(base, other):
    """Changes of m, of the relative scatter and of the flagged share, of the galaxies that both measure."""
    (e0, f0), (e1, f1) = base, other
    good = ((f0 == 0) & (f1 == 0)).all((0, 1)) & np.isfinite(e0).all((0, 1, 2)) & np.isfinite(e1).all((0, 1, 2))
    if good.sum() < 8:
        return {"m": None, "scatter": None, "flagged": float((f1 != 0).mean() - (f0 != 0).mean())}
    apart = [(e[:, :, 0] - e[:, :, 1])[..., good].mean((0, 1)) / (2 * SHEAR) for e in (e0, e1)]
    noise = [(e[:, 0] - e[:, 1])[..., good].std() / a.mean() for e, a in zip((e0, e1), apart)]
    differences = (apart[1] - apart[0]).reshape(-1)
    return {
        "m": float(differences.mean()),
        "m_error": float(differences.std() / np.sqrt(len(differences))),
        "scatter": float(noise[1] / noise[0] - 1.0),
        "flagged": float((f1 != 0).mean() - (f0 != 0).mean()),
    }


def scan(found, options):
    """Rows `{key, factor, case, m, scatter, flagged}`; rows without any change are left out."""
    rows = []
    with tempfile.TemporaryDirectory(dir=options.work) as work:
        work = Path(work)
        program, tunable = build(found, work)
        bases = []
        for configuration, name in SCANNED:
            galaxies = options.galaxies if configuration.startswith("48") else options.galaxies // 5
            data = work / f"{configuration.replace('/', '-')}-{name}"
            number = write_scene(name, galaxies, options.seed, data)
            bases.append((configuration, name, data, number, measure(program, configuration, data, number, work)))
        for constant in tunable:
            for factor in FACTORS:
                for configuration, name, data, number, base in bases:
                    other = measure(program, configuration, data, number, work, f"{constant.key}={factor}")
                    row = {"key": constant.key, "factor": factor, "case": f"{configuration} {name}"}
                    if other is None or base is None:
                        rows.append(row | {"refused": other is None})
                    elif any(not np.array_equal(a, b, equal_nan=True) for a, b in zip(base, other)):
                        rows.append(row | change(base, other))
            print(f"{constant.key}: {summary(constant.key, rows, True)}", flush=True)
    scanned = [constant.key for constant in tunable]
    return {"galaxies": options.galaxies, "seed": options.seed, "scanned": scanned, "rows": rows}


def summary(key, rows, scanned):
    """The largest change in words."""
    if not scanned:
        return "not scanned: a length, or part of another constant"
    mine = [row for row in rows if row["key"] == key]
    if not mine:
        return "no change"
    words = []
    if refused := [row for row in mine if row.get("refused")]:
        words.append(f"× {refused[0]['factor']} is refused ({refused[0]['case']})")
    for name, text in (("m", "m {:+.1f}·10⁻³"), ("scatter", "scatter {:+.1f} %"), ("flagged", "flagged {:+.1f} %")):
        values = [row for row in mine if row.get(name) is not None]
        if name == "m":
            values = [row for row in values if abs(row["m"]) > 3 * row["m_error"]]
        worst = max(values, key=lambda row: abs(row[name]), default=None)
        if worst and abs(worst[name]) >= NOTABLE[name]:
            value = worst[name] * (1e3 if name == "m" else 1e2)
            words.append(f"{text.format(value)} (× {worst['factor']}, {worst['case'].split()[-1]})")
    return ", ".join(words) or "small"


def page(result, options):
    """Writes the effects into the page, whose other columns `cargo test` compares with the sources."""
    row = re.compile(r"\| `(?P<path>[^`]+)` `(?P<name>[^`]+)` \|.* \| ")
    lines = options.page.read_text().split("\n")
    for index, line in enumerate(lines):
        if match := row.match(line):
            key = f"{match['path']}:{match['name']}"
            lines[index] = f"{match[0]}{summary(key, result['rows'], key in result['scanned'])} |"
    options.page.write_text("\n".join(lines))


def main():
    words = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    words.add_argument("--only", default="", help="constants whose FILE:NAME matches this expression")
    words.add_argument("--galaxies", type=int, default=2000, help="measurements a case")
    words.add_argument("--seed", type=int, default=20261)
    words.add_argument("--work", type=Path, help="folder for the copy of the sources and the images")
    words.add_argument("--json", type=Path, default=ROOT / "tests/stress/constants.json", help="result of the scan")
    words.add_argument("--page", type=Path, help="write the effects of an earlier scan into this page, without scanning")
    options = words.parse_args()
    if options.page:
        page(json.loads(options.json.read_text()), options)
        return
    result = scan([c for c in constants() if re.search(options.only, c.key)], options)
    options.json.write_text(json.dumps(result, indent=0) + "\n")


if __name__ == "__main__":
    main()
