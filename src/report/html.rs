//! Reports as one HTML file that needs nothing else: style, script and pictures are inside.
//!
//! A [`Report`] is a list of sections of text, tables and figures, and the settings that made it. The
//! page may fetch nothing: a content security policy in the file forbids it. Without scripts it
//! reads the same, only that its tables cannot be sorted. The same report gives the same bytes.
//!
//! ```
//! # use shearq::report::html::{Block, Report, Section};
//! let report = Report {
//!     title: "Scores".into(),
//!     sections: vec![Section::new("q", "Q", vec![Block::Text("**Q** as in `score`.".into())])],
//!     ..Report::default()
//! };
//! assert!(report.render().contains("<p><b>Q</b> as in <code>score</code>.</p>"));
//! ```

use std::collections::HashSet;
use std::fmt::Write;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;

use super::escape::markup as escape;
use super::figure::{Figure, FigureError, Format};
use super::table::{Cell, Table, TableFormat};
use crate::io::{FileError, atomic};

const STYLE: &str = include_str!("html/style.css");
const SCRIPT: &str = include_str!("html/script.js");

/// Characters above which the heading of a row may be folded.
const LONG: usize = 16;

/// What replaces `DARK` in the style sheet, which needs it in two places.
const DARK: &str = "color-scheme: dark; --paper: #15171a; --ink: #dddcd8; --muted: #a0a4a9; \
     --rule: #34383d; --strong-rule: #8b9096; --link: #8fb8e0; --shade: #202327; --edge: #000a; --dim: brightness(.92);";

/// Pixels of a PNG per point, as figures are drawn.
const PIXELS_PER_POINT: f64 = 2.0;

/// A report.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    /// Title of the page.
    pub title: String,
    /// One line below it; may be empty.
    pub subtitle: String,
    /// What it has to say.
    pub sections: Vec<Section>,
    /// What made it, by name: version, seed, inputs, resolved settings. Values of several lines are
    /// shown as they are.
    pub settings: Vec<(String, String)>,
}

/// A part of a report, with an entry in its contents.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Section {
    /// Name in links. Characters other than ASCII letters, digits, `-` and `_` become hyphens, and
    /// a name that is taken gets a number.
    pub id: String,
    /// Heading.
    pub heading: String,
    /// Contents, in order.
    pub blocks: Vec<Block>,
}

impl Section {
    /// A section.
    pub fn new(id: impl Into<String>, heading: impl Into<String>, blocks: Vec<Block>) -> Self {
        Section {
            id: id.into(),
            heading: heading.into(),
            blocks,
        }
    }
}

/// A piece of a section.
#[derive(Debug, Clone, PartialEq)]
pub enum Block {
    /// Paragraphs, with blank lines between them. `` `code` `` and `**bold**` are understood and
    /// nothing else.
    Text(String),
    /// A table, which readers can sort. Its columns of detail are folded away until asked for; its
    /// values are in the page in full precision, as CSV.
    Table(Table),
    /// A figure.
    Figure(Picture),
    /// Lines in a typewriter font, as they are.
    Code(String),
}

/// A figure as it stands in a report.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// File name without extension, for links to the figure.
    pub stem: String,
    /// What it shows, in words, for those who cannot see it; the caption stands in where it is empty.
    pub alt: String,
    /// Caption, with the markup of [`Block::Text`].
    pub caption: String,
    /// Format of `bytes`.
    pub format: Format,
    /// The picture file. SVG is small and sharp for curves and bars, PNG is smaller for images.
    pub bytes: Vec<u8>,
    /// Labels and paths, relative to the report, of the same figure and its data in other formats.
    pub links: Vec<(String, String)>,
}

impl Picture {
    /// Draws a figure for a report.
    ///
    /// # Errors
    /// Those of [`Figure::render`].
    pub fn draw(
        figure: &dyn Figure,
        format: Format,
        stem: impl Into<String>,
        caption: impl Into<String>,
    ) -> Result<Self, FigureError> {
        Ok(Picture {
            stem: stem.into(),
            alt: String::new(),
            caption: caption.into(),
            format,
            bytes: figure.render(format)?,
            links: Vec::new(),
        })
    }

    /// The same with a description in words.
    pub fn described(self, alt: impl Into<String>) -> Self {
        Picture {
            alt: alt.into(),
            ..self
        }
    }

    /// The same with one more link.
    pub fn link(mut self, label: impl Into<String>, path: impl Into<String>) -> Self {
        self.links.push((label.into(), path.into()));
        self
    }

    /// Width and height in points, where the file tells.
    fn size(&self) -> Option<(f64, f64)> {
        match self.format {
            Format::Png => {
                let number = |at: usize| {
                    let bytes = self.bytes.get(at..at + 4)?.try_into().ok()?;
                    Some(f64::from(u32::from_be_bytes(bytes)) / PIXELS_PER_POINT)
                };
                self.bytes.starts_with(b"\x89PNG").then_some(())?;
                Some((number(16)?, number(20)?))
            }
            Format::Svg => {
                let text = str::from_utf8(&self.bytes).ok()?;
                let (_, tag) = text.split_once("<svg")?;
                let (tag, _) = tag.split_once('>')?;
                let number = |name: &str| {
                    let (_, rest) = tag.split_once(&format!(" {name}=\""))?;
                    rest.split_once('"')?.0.parse::<f64>().ok()
                };
                Some((number("width")?, number("height")?))
            }
        }
    }
}

impl Report {
    /// The page.
    pub fn render(&self) -> String {
        let mut page = Page::new();
        let ids: Vec<String> = self
            .sections
            .iter()
            .map(|section| page.ids.give(&section.id))
            .collect();
        let mut contents: Vec<(&str, &str)> = ids
            .iter()
            .zip(&self.sections)
            .map(|(id, section)| (id.as_str(), section.heading.as_str()))
            .collect();
        if !self.settings.is_empty() {
            contents.push((SETTINGS.0, SETTINGS.1));
        }
        page.head(&self.title, &self.subtitle);
        page.contents(&contents);
        page.text.push_str("<main id=\"main\">\n");
        for (id, section) in ids.iter().zip(&self.sections) {
            page.open_section(id, &section.heading);
            for block in &section.blocks {
                match block {
                    Block::Text(text) => page.paragraphs(text),
                    Block::Table(table) => page.table(table),
                    Block::Figure(picture) => page.figure(picture),
                    Block::Code(code) => page.code(code),
                }
            }
            page.text.push_str("</section>\n");
        }
        if !self.settings.is_empty() {
            page.settings(&self.settings);
        }
        page.text.push_str("</main>\n</body>\n</html>\n");
        page.text
    }

    /// Writes the page, whole or not at all.
    ///
    /// # Errors
    /// Where the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), FileError> {
        atomic::write(path, self.render().as_bytes())
    }
}

/// Name and heading of the section of settings.
const SETTINGS: (&str, &str) = ("settings", "What made this report");

/// Names that are taken.
#[derive(Debug)]
struct Ids(HashSet<String>);

impl Ids {
    /// A name like `wish`, not given before.
    fn give(&mut self, wish: &str) -> String {
        let mut id = String::new();
        for c in wish.chars() {
            if c.is_ascii_alphanumeric() || c == '_' {
                id.push(c);
            } else if !id.is_empty() && !id.ends_with('-') {
                id.push('-');
            }
        }
        let stem = match id.trim_end_matches('-') {
            "" => "part",
            stem => stem,
        };
        let mut id = stem.to_owned();
        let mut number = 1;
        while !self.0.insert(id.clone()) {
            number += 1;
            id = format!("{stem}-{number}");
        }
        id
    }
}

/// A page on its way.
#[derive(Debug)]
struct Page {
    text: String,
    ids: Ids,
    tables: usize,
    figures: usize,
}

/// Appends formatted text to the page.
macro_rules! put {
    ($page:expr, $($words:tt)*) => {
        // Writing to a string cannot fail.
        let _ = write!($page.text, $($words)*);
    };
}

impl Page {
    fn new() -> Self {
        let taken = ["main", "theme", SETTINGS.0];
        Page {
            text: String::new(),
            ids: Ids(taken.map(String::from).into()),
            tables: 0,
            figures: 0,
        }
    }

    fn head(&mut self, title: &str, subtitle: &str) {
        let (title, version) = (escape(title), crate::VERSION);
        let style = STYLE.replace("DARK", DARK);
        put!(
            self,
            "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; \
             img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; \
             base-uri 'none'; form-action 'none'\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <meta name=\"color-scheme\" content=\"light dark\">\n\
             <meta name=\"generator\" content=\"shearq {version}\">\n\
             <link rel=\"icon\" href=\"data:,\">\n<title>{title}</title>\n\
             <style>\n{style}</style>\n<script>\n{SCRIPT}</script>\n</head>\n<body>\n\
             <a class=\"skip\" href=\"#main\">Skip the contents</a>\n\
             <header>\n<div>\n<h1>{title}</h1>\n"
        );
        if !subtitle.is_empty() {
            put!(self, "<p class=\"subtitle\">{}</p>\n", escape(subtitle));
        }
        self.text.push_str(
            "</div>\n<button id=\"theme\" type=\"button\" title=\"Change between light and dark\" \
             hidden>Dark</button>\n</header>\n",
        );
    }

    fn contents(&mut self, entries: &[(&str, &str)]) {
        if entries.is_empty() {
            return;
        }
        self.text.push_str("<nav aria-label=\"Contents\">\n<ol>\n");
        for (id, heading) in entries {
            put!(self, "<li><a href=\"#{id}\">{}</a></li>\n", escape(heading));
        }
        self.text.push_str("</ol>\n</nav>\n");
    }

    fn open_section(&mut self, id: &str, heading: &str) {
        let heading = escape(heading);
        put!(
            self,
            "<section aria-labelledby=\"{id}\">\n<h2 id=\"{id}\">{heading} \
             <a class=\"anchor\" href=\"#{id}\" aria-label=\"Link to this section\">#</a></h2>\n"
        );
    }

    fn paragraphs(&mut self, text: &str) {
        for paragraph in paragraphs(text) {
            put!(self, "<p>{}</p>\n", inline(&paragraph));
        }
    }

    fn code(&mut self, code: &str) {
        // The parser drops one line break after the tag, so that the first of the code's own stays.
        put!(
            self,
            "<pre tabindex=\"0\">\n<code>{}</code></pre>\n",
            escape(code.trim_end_matches('\n'))
        );
    }

    fn figure(&mut self, picture: &Picture) {
        self.figures += 1;
        let id = self.ids.give(&format!("figure-{}", picture.stem));
        let mime = match picture.format {
            Format::Png => "image/png",
            Format::Svg => "image/svg+xml",
        };
        let size = picture.size().map_or_else(String::new, |(w, h)| {
            format!(" width=\"{}\" height=\"{}\"", w.round(), h.round())
        });
        let alt = if picture.alt.is_empty() {
            plain(&picture.caption)
        } else {
            picture.alt.clone()
        };
        // As an image, and not as elements of the page, an SVG keeps its names and styles to itself.
        put!(
            self,
            "<figure id=\"{id}\">\n<div class=\"plate\">\
             <img src=\"data:{mime};base64,{}\" alt=\"{}\"{size}></div>\n<figcaption>\n",
            BASE64.encode(&picture.bytes),
            escape(&alt)
        );
        put!(
            self,
            "<p><span class=\"number\">Figure {}.</span> {}</p>\n",
            self.figures,
            inline(&paragraphs(&picture.caption).join(" "))
        );
        self.text.push_str("<p class=\"tools\">");
        for (k, (label, path)) in picture.links.iter().enumerate() {
            let space = if k > 0 { " " } else { "" };
            let (url, label) = (relative_url(path), escape(label));
            put!(self, "{space}<a href=\"{url}\">{label}</a>");
        }
        self.text.push_str("</p>\n</figcaption>\n</figure>\n");
    }

    fn table(&mut self, table: &Table) {
        self.tables += 1;
        let number = self.tables;
        let id = self.ids.give(&format!("table-{number}"));
        let title = self.ids.give(&format!("{id}-title"));
        // The caption stands outside what scrolls; the table is named by it.
        put!(
            self,
            "<div class=\"table\" id=\"{id}\">\n<p class=\"title\" id=\"{title}\">\
             <span class=\"number\">Table {number}.</span> {}</p>\n\
             <div class=\"scroll\" role=\"region\" tabindex=\"0\" aria-labelledby=\"{title}\">\n\
             <table aria-labelledby=\"{title}\">\n<thead>\n<tr>",
            escape(&table.title)
        );
        let columns: Vec<Column> = (0..table.headings.len())
            .map(|k| Column::of(table, k))
            .collect();
        for (heading, column) in table.headings.iter().zip(&columns) {
            put!(
                self,
                "<th scope=\"col\"{}>{}</th>",
                column.class(),
                escape(&heading.label)
            );
        }
        self.text.push_str("</tr>\n</thead>\n<tbody>\n");
        for row in &table.rows {
            self.text.push_str("<tr>");
            for (k, column) in columns.iter().enumerate() {
                column.cell(k, row.get(k), &mut self.text);
            }
            self.text.push_str("</tr>\n");
        }
        self.text.push_str("</tbody>\n</table>\n</div>\n");
        if !table.notes.is_empty() {
            self.text.push_str("<div class=\"notes\">\n");
            for note in &table.notes {
                put!(self, "<p>{}</p>\n", escape(note));
            }
            self.text.push_str("</div>\n");
        }
        put!(
            self,
            "<p class=\"tools\"><a download=\"{id}.csv\" \
             href=\"data:text/csv;charset=utf-8;base64,{}\" \
             aria-label=\"Table {number} as CSV\">CSV</a></p>\n</div>\n",
            BASE64.encode(table.render(TableFormat::Csv))
        );
    }

    fn settings(&mut self, settings: &[(String, String)]) {
        let (id, heading) = SETTINGS;
        self.open_section(id, heading);
        self.text.push_str("<dl>\n");
        for (name, value) in settings {
            put!(self, "<dt>{}</dt>", escape(name));
            let value = value.trim_end_matches('\n');
            if value.contains('\n') {
                self.text.push_str("<dd class=\"long\">");
                self.code(value);
                self.text.push_str("</dd>\n");
            } else {
                put!(self, "<dd>{}</dd>\n", escape(value));
            }
        }
        self.text.push_str("</dl>\n</section>\n");
    }
}

/// How a column of a table is set.
#[derive(Debug, Clone, Copy)]
struct Column {
    /// Holds numbers and stands on the right.
    numbers: bool,
    /// Width of the longest error, in digits; none where no cell has one.
    error_width: Option<f64>,
    /// Can be folded away.
    detail: bool,
}

impl Column {
    fn of(table: &Table, k: usize) -> Self {
        let cells = || table.rows.iter().filter_map(|row| row.get(k));
        Column {
            numbers: cells().any(|cell| matches!(cell, Cell::Number { .. })),
            error_width: cells()
                .filter_map(error_text)
                .map(|error| width_in_digits(&error))
                .reduce(f64::max),
            detail: table.headings[k].detail,
        }
    }

    fn class(self) -> &'static str {
        match (self.numbers, self.detail) {
            (false, false) => "",
            (true, false) => " class=\"num\"",
            (false, true) => " class=\"detail\"",
            (true, true) => " class=\"num detail\"",
        }
    }

    /// Appends a cell; words in the first column head their row.
    fn cell(self, k: usize, cell: Option<&Cell>, text: &mut String) {
        let class = self.class();
        match cell {
            None | Some(Cell::Empty) => text.push_str(&format!("<td{class}></td>")),
            Some(Cell::Text(words)) if k == 0 => {
                // Folded on narrow screens, where this column stays while others scroll.
                let long = words.chars().count() > LONG;
                let class = match (long, self.detail) {
                    (true, false) => " class=\"long\"",
                    (true, true) => " class=\"long detail\"",
                    (false, _) => class,
                };
                text.push_str(&format!("<th scope=\"row\"{class}>{}</th>", escape(words)));
            }
            Some(Cell::Text(words)) => {
                text.push_str(&format!("<td{class}>{}</td>", escape(words)));
            }
            Some(
                number @ Cell::Number {
                    value, decimals, ..
                },
            ) => {
                let shown = print_number(*value, *decimals);
                text.push_str(&format!(
                    "<td{class} data-value=\"{}\">{shown}",
                    sort_value(*value)
                ));
                if let Some(width) = self.error_width {
                    // The space of the error is kept where there is none, so that values align.
                    let (mark, error) = match error_text(number) {
                        Some(error) => ("", error),
                        None => (" style=\"visibility:hidden\"", String::new()),
                    };
                    text.push_str(&format!(
                        "<span class=\"pm\"{mark}>\u{a0}±\u{a0}</span>\
                         <span class=\"error\" style=\"min-width:{width}ch\">{error}</span>"
                    ));
                }
                text.push_str("</td>");
            }
        }
    }
}

/// The error of a cell as printed, where it has one.
fn error_text(cell: &Cell) -> Option<String> {
    match cell {
        Cell::Number {
            value,
            error: Some(error),
            decimals,
        } if error.is_finite() && !value.is_nan() => Some(format!("{error:.decimals$}")),
        _ => None,
    }
}

/// The width of a number without sign, in digits; a decimal point takes about half of one.
fn width_in_digits(number: &str) -> f64 {
    let points = number.matches('.').count();
    number.len() as f64 - 0.5 * points as f64
}

/// A number for people.
fn print_number(value: f64, decimals: usize) -> String {
    if value.is_nan() {
        return "–".into();
    }
    if value.is_infinite() {
        return if value > 0.0 { "∞" } else { "−∞" }.into();
    }
    format!("{value:.decimals$}").replace('-', "−")
}

/// A number as scripts read it.
fn sort_value(value: f64) -> String {
    if value.is_infinite() {
        return if value > 0.0 { "Infinity" } else { "-Infinity" }.into();
    }
    value.to_string()
}

/// The paragraphs of a text, each with its line breaks turned into spaces.
fn paragraphs(text: &str) -> Vec<String> {
    let mut paragraphs = vec![String::new()];
    for line in text.lines().map(str::trim) {
        let Some(last) = paragraphs.last_mut() else {
            break;
        };
        if line.is_empty() {
            paragraphs.push(String::new());
        } else {
            if !last.is_empty() {
                last.push(' ');
            }
            last.push_str(line);
        }
    }
    paragraphs.retain(|paragraph| !paragraph.is_empty());
    paragraphs
}

/// A run of text of one kind.
#[derive(Debug, PartialEq)]
enum Run<'a> {
    Plain(&'a str),
    Bold(&'a str),
    Code(&'a str),
}

/// Splits at `` `code` `` and `**bold**`; marks without a partner or with nothing between are text.
fn runs(text: &str) -> Vec<Run<'_>> {
    let mut runs = Vec::new();
    let (mut start, mut at) = (0, 0);
    while let Some(found) = text[at..].find(['`', '*']) {
        let open = at + found;
        let mark = if text[open..].starts_with('`') {
            "`"
        } else if text[open..].starts_with("**") {
            "**"
        } else {
            at = open + 1;
            continue;
        };
        let inner = open + mark.len();
        match text[inner..].find(mark) {
            Some(length) if length > 0 => {
                if open > start {
                    runs.push(Run::Plain(&text[start..open]));
                }
                let inside = &text[inner..inner + length];
                runs.push(if mark == "`" {
                    Run::Code(inside)
                } else {
                    Run::Bold(inside)
                });
                at = inner + length + mark.len();
                start = at;
            }
            _ => at = inner,
        }
    }
    if start < text.len() {
        runs.push(Run::Plain(&text[start..]));
    }
    runs
}

/// A paragraph with its markup as HTML.
fn inline(text: &str) -> String {
    runs(text)
        .into_iter()
        .map(|run| match run {
            Run::Plain(words) => escape(words),
            Run::Bold(words) => format!("<b>{}</b>", escape(words)),
            Run::Code(words) => format!("<code>{}</code>", escape(words)),
        })
        .collect()
}

/// A text without its markup.
fn plain(text: &str) -> String {
    let text = paragraphs(text).join(" ");
    runs(&text)
        .into_iter()
        .map(|run| match run {
            Run::Plain(words) | Run::Bold(words) | Run::Code(words) => words,
        })
        .collect()
}

/// A path as a URL that cannot be taken for anything but a path.
fn relative_url(path: &str) -> String {
    let mut url = String::new();
    for byte in path.bytes() {
        match byte {
            // Two slashes at the start would name another machine.
            b'/' if url == "/" => {}
            b'/' | b'-' | b'_' | b'.' | b'~' => url.push(char::from(byte)),
            byte if byte.is_ascii_alphanumeric() => url.push(char::from(byte)),
            byte => url.push_str(&format!("%{byte:02X}")),
        }
    }
    url
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::report::figure::{LinePlot, Series, Style};
    use crate::report::table::Heading;

    const NASTY: &str = "<script>alert(\"x\" + 'y')</script> & </style>";

    fn picture(format: Format) -> Picture {
        let plot = LinePlot {
            title: "Power".into(),
            series: vec![Series::new(
                "true",
                vec![1.0, 2.0, 3.0],
                vec![1.0, 4.0, 9.0],
                Style::Line,
                0,
            )],
            ..LinePlot::default()
        };
        Picture::draw(&plot, format, "power", "The `power`, **binned**.")
            .unwrap()
            .link("PNG", "figures/power 1.png")
            .link("odd", "javascript:alert(1)")
    }

    fn table() -> Table {
        Table {
            title: NASTY.into(),
            headings: vec![
                Heading::new("name", NASTY),
                Heading::new("q", "Q"),
                Heading::new("m", "m").detail(),
            ],
            rows: vec![
                vec![
                    Cell::text(NASTY),
                    Cell::with_error(-87.125, Some(12.5), 1),
                    Cell::number(f64::INFINITY, 2),
                ],
                vec![
                    Cell::text("b"),
                    Cell::with_error(9.5e-7, Some(1.0), 1),
                    Cell::number(0.25, 2),
                ],
                vec![Cell::text("c"), Cell::number(f64::NAN, 1)],
            ],
            notes: vec![NASTY.into()],
        }
    }

    fn report() -> Report {
        Report {
            title: NASTY.into(),
            subtitle: NASTY.into(),
            sections: vec![
                Section::new(
                    "scores",
                    NASTY,
                    vec![
                        Block::Text(format!("{NASTY} **{NASTY}**\n\n`{NASTY}`")),
                        Block::Table(table()),
                        Block::Table(table()),
                    ],
                ),
                Section::new(
                    "scores",
                    "Again",
                    vec![
                        Block::Figure(picture(Format::Svg)),
                        Block::Figure(picture(Format::Png).described(NASTY)),
                        Block::Code(NASTY.into()),
                    ],
                ),
                Section::new("settings", "", Vec::new()),
                Section::new("\" onclick=\"", "", Vec::new()),
            ],
            settings: vec![
                ("seed".into(), NASTY.into()),
                (NASTY.into(), format!("[a]\nb = \"{NASTY}\"\n")),
            ],
        }
    }

    /// Elements as (name, attributes), after checking that they nest, that attributes are quoted and
    /// that no bare `<`, `>` or `&` is in the text between.
    fn elements(page: &str) -> Vec<(String, Vec<(String, String)>)> {
        const VOID: [&str; 3] = ["meta", "link", "img"];
        let mut rest = page.strip_prefix("<!DOCTYPE html>").unwrap();
        let (mut open, mut all) = (Vec::<String>::new(), Vec::new());
        while let Some((text, after)) = rest.split_once('<') {
            assert!(!text.contains('>'), "bare > in {text:?}");
            for part in text.split('&').skip(1) {
                let (entity, _) = part.split_once(';').expect("an entity");
                assert!(["amp", "lt", "gt", "quot", "#39"].contains(&entity));
            }
            if let Some(closing) = after.strip_prefix('/') {
                let (name, after) = closing.split_once('>').unwrap();
                assert_eq!(open.pop().as_deref(), Some(name));
                rest = after;
                continue;
            }
            let end = after.find([' ', '>']).unwrap();
            let name = after[..end].to_owned();
            let mut tag = &after[end..];
            let mut attributes = Vec::new();
            while let Some(attribute) = tag.strip_prefix(' ') {
                let end = attribute.find(['=', ' ', '>']).unwrap();
                let key = attribute[..end].to_owned();
                tag = &attribute[end..];
                let mut value = String::new();
                if let Some(quoted) = tag.strip_prefix("=\"") {
                    let (inside, after) = quoted.split_once('"').unwrap();
                    assert!(!inside.contains(['<', '>']));
                    value = inside.to_owned();
                    tag = after;
                }
                assert!(attributes.iter().all(|(other, _)| *other != key));
                attributes.push((key, value));
            }
            rest = tag.strip_prefix('>').expect("the end of a tag");
            if name == "style" || name == "script" {
                rest = rest.split_once(&format!("</{name}>")).unwrap().1;
            } else if !VOID.contains(&name.as_str()) {
                open.push(name.clone());
            }
            all.push((name, attributes));
        }
        assert!(open.is_empty() && rest == "\n");
        all
    }

    #[test]
    fn the_page_is_well_formed_whatever_the_words_are() {
        let page = report().render();
        let elements = elements(&page);
        let count = |name: &str| elements.iter().filter(|(n, _)| n == name).count();
        assert_eq!((count("script"), count("style"), count("h1")), (1, 1, 1));
        assert_eq!((count("table"), count("img"), count("section")), (2, 2, 5));
        let values = |key: &str| -> Vec<&str> {
            elements
                .iter()
                .flat_map(|(_, attributes)| attributes)
                .filter(|(k, _)| k == key)
                .map(|(_, value)| value.as_str())
                .collect()
        };
        let ids = values("id");
        let unique: HashSet<&str> = ids.iter().copied().collect();
        assert_eq!(ids.len(), unique.len());
        for href in values("href") {
            if let Some(id) = href.strip_prefix('#') {
                assert!(unique.contains(id), "{href}");
            }
        }
        for id in values("aria-labelledby") {
            assert!(unique.contains(id), "{id}");
        }
        assert!(values("onclick").is_empty());
        for (name, attributes) in &elements {
            let has = |key: &str| attributes.iter().any(|(k, v)| k == key && !v.is_empty());
            assert!(name != "th" || has("scope"));
            assert!(name != "img" || (has("alt") && has("width") && has("height")));
        }
        assert!(!page.contains("<script>alert"));
        assert_eq!(page, report().render());
    }

    #[test]
    fn the_page_refers_to_nothing_outside() {
        let page = report().render();
        assert!(!page.contains("http://") && !page.contains("https://") && !page.contains("url("));
        assert!(!page.contains("@import") && !page.contains("href=\"//"));
        assert!(page.contains("href=\"figures/power%201.png\""));
        assert!(page.contains("href=\"javascript%3Aalert%281%29\""));
        assert_eq!(relative_url("//host/a"), "/host/a");
        assert_eq!(relative_url("../größe#1.csv"), "../gr%C3%B6%C3%9Fe%231.csv");
    }

    #[test]
    fn cells_sort_by_value_and_read_as_numbers() {
        let page = report().render();
        assert!(page.contains(
            "<td class=\"num\" data-value=\"-87.125\">−87.1<span class=\"pm\">\u{a0}±\u{a0}</span>\
             <span class=\"error\" style=\"min-width:3.5ch\">12.5</span></td>"
        ));
        assert!(page.contains("data-value=\"0.00000095\">0.0<"));
        assert!(page.contains("data-value=\"NaN\">–<"));
        assert!(page.contains("<td class=\"num detail\" data-value=\"Infinity\">∞</td>"));
        assert!(page.contains("<th scope=\"col\" class=\"num detail\">m</th>"));
        assert!(page.contains("<td class=\"num detail\"></td></tr>"));
    }

    #[test]
    fn markup_is_code_and_bold_and_nothing_else() {
        assert_eq!(
            inline("a `b*c` **d & e** *f* ` ** g"),
            "a <code>b*c</code> <b>d &amp; e</b> *f* ` ** g"
        );
        assert_eq!(inline("``** ** **"), "``<b> </b> **");
        assert_eq!(plain("the `a`\n**b**"), "the a b");
        assert_eq!(paragraphs("a\nb\n\n \nc\n"), ["a b", "c"]);
        assert_eq!(escape("a\u{0}\r\n"), "a\\u0000\\u000d\n");
    }

    #[test]
    fn pictures_know_their_size() {
        let size = picture(Format::Svg).size().unwrap();
        assert_eq!(picture(Format::Png).size(), Some(size));
        let broken = Picture {
            bytes: b"\x89PNG".to_vec(),
            ..picture(Format::Png)
        };
        assert_eq!(broken.size(), None);
    }

    #[test]
    fn a_report_is_written_and_an_empty_one_too() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/report.html");
        report().save(&path).unwrap();
        assert_eq!(std::fs::read_to_string(path).unwrap(), report().render());
        let empty = elements(&Report::default().render());
        assert!(empty.iter().all(|(name, _)| name != "nav" && name != "h2"));
    }
}
