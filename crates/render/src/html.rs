//! Reports as one HTML file that needs nothing else: style, script and pictures are inside.
//!
//! The page may fetch nothing: a content security policy in the file forbids it. Without scripts it reads the same, only
//! that its tables cannot be sorted. The same report gives the same bytes.
//!
//! ```
//! # use shearq_render::html::{Block, Report, Section};
//! let report = Report {
//!     title: "Scores".into(),
//!     sections: vec![Section::new("q", "Q", vec![Block::Text("Q as in the challenge.".into())])],
//!     ..Report::default()
//! };
//! assert!(report.render().contains("<p>Q as in the challenge.</p>"));
//! ```

use std::collections::HashSet;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, Render, html};
use shearq_files::{FileError, atomic};

use crate::escape::visible;
use crate::figure::{Figure, FigureError, PictureFormat};
use crate::table::{Cell, Table, TableFormat};

const STYLE: &str = include_str!("html/style.css");
const SCRIPT: &str = include_str!("html/script.js");

// What replaces `DARK` in the style sheet, which needs it in two places: for systems in dark mode, and for readers who
// choose it.
const DARK: &str = "color-scheme: dark; --paper: #15171a; --ink: #dddcd8; --muted: #a0a4a9; \
     --rule: #34383d; --strong-rule: #8b9096; --link: #8fb8e0; --shade: #202327; --edge: #000a; --dim: brightness(.92);";

// Characters above which the words of a cell run over several lines.
const LONGEST_LINE: usize = 36;

#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    pub title: String,
    /// One line below the title; may be empty.
    pub subtitle: String,
    pub sections: Vec<Section>,
    /// Meanings of columns by the keys of their headings. Those of columns that the report has are listed, and linked
    /// from the tables.
    pub glossary: Vec<(String, String)>,
    /// What made the report, by name: version, seed, inputs, resolved settings.
    pub settings: Vec<(String, String)>,
}

/// A part of a report, with an entry in its contents.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Section {
    id: String,
    heading: String,
    blocks: Vec<Block>,
}

impl Section {
    /// A section with the name `id` in links.
    pub fn new(id: impl Into<String>, heading: impl Into<String>, blocks: Vec<Block>) -> Self {
        Section {
            id: id.into(),
            heading: heading.into(),
            blocks,
        }
    }

    /// The same section under another heading.
    pub fn titled(self, heading: impl Into<String>) -> Self {
        Section {
            heading: heading.into(),
            ..self
        }
    }

    pub fn push(&mut self, block: Block) {
        self.blocks.push(block);
    }
}

/// A piece of a section.
#[derive(Debug, Clone, PartialEq)]
pub enum Block {
    /// Paragraphs, with blank lines between them.
    Text(String),
    /// A table, which readers can sort. Its columns of detail are folded away until asked for; its
    /// values are in the page in full precision, as CSV.
    Table(Table),
    /// The same with a field that hides rows without the words that a reader types.
    Filtered(Table),
    /// The same behind its title, on which a reader clicks: details of what stands above.
    Folded(Table),
    Figure(Picture),
}

/// A figure as it stands in a report.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    name: String,
    // Also the description for those who cannot see the figure.
    caption: String,
    svg: Vec<u8>,
    // Width and height in points.
    size: (f64, f64),
}

impl Picture {
    /// Draws a figure for a report.
    pub fn draw(
        figure: &impl Figure,
        name: impl Into<String>,
        caption: impl Into<String>,
    ) -> Result<Self, FigureError> {
        Ok(Picture {
            name: name.into(),
            caption: caption.into(),
            svg: figure.render(PictureFormat::Svg)?,
            size: figure.size(),
        })
    }
}

// Name in links and heading of the sections that every report may have.
const SETTINGS: (&str, &str) = ("settings", "What made this report");
const GLOSSARY: (&str, &str) = ("glossary", "Glossary");

impl Report {
    pub fn render(&self) -> String {
        let mut page = Page {
            glossary: self.used_glossary(),
            ..Page::new()
        };
        let ids = self.sections.iter().map(|section| page.id(&section.id));
        let ids: Vec<String> = ids.collect();
        let headings = self.sections.iter().map(|section| section.heading.as_str());
        let mut contents: Vec<(&str, &str)> =
            ids.iter().map(String::as_str).zip(headings).collect();
        let mut ends = Vec::new();
        if !page.glossary.is_empty() {
            ends.push((GLOSSARY, page.meanings()));
        }
        if !self.settings.is_empty() {
            ends.push((SETTINGS, settings(&self.settings)));
        }
        contents.extend(ends.iter().map(|(name, _)| *name));
        let markup = html! {
            (DOCTYPE) "\n"
            html lang="en" {
                (head(&self.title))
                body { "\n"
                    a.skip href="#main" { "Skip the contents" } "\n"
                    header {
                        div {
                            h1 { (Words(&self.title)) }
                            @if !self.subtitle.is_empty() {
                                p.subtitle { (Words(&self.subtitle)) }
                            }
                        }
                        button #theme type="button" title="Change between light and dark" hidden { "Dark" }
                    } "\n"
                    @if !contents.is_empty() {
                        nav aria-label="Contents" {
                            ol {
                                @for (id, heading) in contents {
                                    li { a href={ "#" (id) } { (Words(heading)) } }
                                }
                            }
                        } "\n"
                    }
                    main #main { "\n"
                        @for (id, part) in ids.iter().zip(&self.sections) {
                            (section((id, &part.heading), html! {
                                @for block in &part.blocks { (page.block(block)) "\n" }
                            }))
                        }
                        @for (name, contents) in ends { (section(name, contents)) }
                    } "\n"
                } "\n"
            } "\n"
        };
        markup.into_string()
    }

    // The entries of the glossary whose columns are in tables.
    fn used_glossary(&self) -> Vec<Entry> {
        let blocks = self.sections.iter().flat_map(|section| &section.blocks);
        let tables = blocks.filter_map(|block| match block {
            Block::Table(table) | Block::Filtered(table) | Block::Folded(table) => Some(table),
            _ => None,
        });
        let headings: Vec<_> = tables.flat_map(|table| &table.headings).collect();
        let entries = self.glossary.iter().filter_map(|(key, meaning)| {
            let heading = headings.iter().find(|heading| heading.key == key)?;
            Some(Entry {
                key: heading.key,
                label: heading.label.clone(),
                meaning: meaning.clone(),
            })
        });
        entries.collect()
    }

    /// Writes the page, whole or not at all.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), FileError> {
        atomic::write(path, self.render().as_bytes())
    }
}

// The meaning of a column.
#[derive(Debug)]
struct Entry {
    key: &'static str,
    label: String,
    meaning: String,
}

// Words from elsewhere: escaped as all text is, with control characters, which no page can hold, written out.
struct Words<'a>(&'a str);

impl Render for Words<'_> {
    fn render_to(&self, page: &mut String) {
        visible(self.0).as_ref().render_to(page);
    }
}

// Words in which symbols with an index are typeset, such as C_ℓ, Q_dn and σ_sys. Not for attributes.
struct Typeset<'a>(&'a str);

impl Render for Typeset<'_> {
    fn render_to(&self, page: &mut String) {
        let words = Words(self.0).render().into_string();
        let is_word = |c: char| c.is_alphanumeric() || c == '_';
        for word in words.split_inclusive(|c| !is_word(c)) {
            let end = word.find(|c| !is_word(c)).unwrap_or(word.len());
            match word[..end].split_once('_') {
                Some((symbol, index)) if is_symbol(symbol, index) => {
                    page.push_str(&format!("{symbol}<sub>{index}</sub>{}", &word[end..]));
                }
                _ => page.push_str(word),
            }
        }
    }
}

// One letter with a short index, perhaps after others that are not ASCII, as in ℓ²C_ℓ. Names of files and columns keep their
// underscores.
fn is_symbol(symbol: &str, index: &str) -> bool {
    let mut letters = symbol.chars().rev();
    let is_letter = |c: char| c.is_uppercase() || !c.is_ascii();
    letters.next().is_some_and(is_letter)
        && letters.all(|c| !c.is_ascii())
        && (1..=3).contains(&index.chars().count())
        && index.chars().all(char::is_alphabetic)
}

fn head(title: &str) -> Markup {
    let policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; \
                  script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'";
    html! {
        head { "\n"
            meta charset="utf-8";
            meta http-equiv="Content-Security-Policy" content=(policy);
            meta name="viewport" content="width=device-width, initial-scale=1";
            meta name="color-scheme" content="light dark";
            meta name="generator" content={ "shearq " (env!("CARGO_PKG_VERSION")) };
            // Browsers would ask for an icon, which the policy forbids.
            link rel="icon" href="data:,"; "\n"
            title { (Words(title)) } "\n"
            style { (PreEscaped(STYLE.replace("DARK", DARK))) } "\n"
            script { (PreEscaped(SCRIPT)) } "\n"
        } "\n"
    }
}

fn section((id, heading): (&str, &str), contents: Markup) -> Markup {
    html! {
        section aria-labelledby=(id) { "\n"
            h2 id=(id) {
                (Words(heading)) " "
                a.anchor href={ "#" (id) } aria-label="Link to this section" { "#" }
            } "\n"
            (contents)
        } "\n"
    }
}

fn settings(settings: &[(String, String)]) -> Markup {
    html! {
        dl {
            @for (name, value) in settings {
                @let value = value.trim_end_matches('\n');
                dt { (Words(name)) }
                @if value.contains('\n') {
                    // The parser drops one line break after the tag, so that the first of the value's own stays.
                    dd.long { pre tabindex="0" { "\n" code { (Words(value)) } } }
                } @else {
                    dd { (Words(value)) }
                } "\n"
            }
        } "\n"
    }
}

// A page on its way: what is numbered in it, and the names that are taken.
#[derive(Debug)]
struct Page {
    ids: HashSet<String>,
    tables: usize,
    figures: usize,
    glossary: Vec<Entry>,
}

impl Page {
    fn new() -> Self {
        let taken = ["main", "theme", GLOSSARY.0, SETTINGS.0];
        Page {
            ids: taken.map(String::from).into(),
            tables: 0,
            figures: 0,
            glossary: Vec::new(),
        }
    }

    // A name like `wish`, which may hold any characters and was perhaps given before.
    fn id(&mut self, wish: &str) -> String {
        let parts = wish.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
        let parts: Vec<&str> = parts.filter(|part| !part.is_empty()).collect();
        let stem = if parts.is_empty() {
            "part".into()
        } else {
            parts.join("-")
        };
        let numbered = (2..).map(|number| format!("{stem}-{number}"));
        let mut names = std::iter::once(stem.clone()).chain(numbered);
        let free = names
            .find(|name| !self.ids.contains(name))
            .unwrap_or_default();
        self.ids.insert(free.clone());
        free
    }

    fn meanings(&self) -> Markup {
        html! {
            dl {
                @for entry in &self.glossary {
                    dt id={ "glossary-" (entry.key) } { (Typeset(&entry.label)) }
                    dd { (Typeset(&entry.meaning)) } "\n"
                }
            } "\n"
        }
    }

    fn block(&mut self, block: &Block) -> Markup {
        match block {
            Block::Text(text) => html! {
                @for paragraph in text.split("\n\n") { p { (Typeset(paragraph)) } }
            },
            Block::Table(table) => self.table(table, false),
            Block::Filtered(table) => self.table(table, true),
            Block::Folded(table) => html! {
                details { summary { (Words(&table.title)) } (self.table(table, false)) }
            },
            Block::Figure(picture) => self.figure(picture),
        }
    }

    fn figure(&mut self, picture: &Picture) -> Markup {
        self.figures += 1;
        let id = self.id(&format!("figure-{}", picture.name));
        // As an image, and not as elements of the page, an SVG keeps its names and styles to itself.
        html! {
            figure id=(id) {
                div.plate {
                    img src={ "data:image/svg+xml;base64," (BASE64.encode(&picture.svg)) }
                        alt=(Words(&picture.caption)) width=(pixels(picture.size.0)) height=(pixels(picture.size.1));
                }
                figcaption {
                    p { span.number { "Figure " (self.figures) "." } " " (Typeset(&picture.caption)) }
                }
            }
        }
    }

    fn table(&mut self, table: &Table, filtered: bool) -> Markup {
        self.tables += 1;
        let number = self.tables;
        let id = self.id(&format!("table-{number}"));
        let title = self.id(&format!("{id}-title"));
        // The file has all columns.
        let csv = BASE64.encode(table.render(TableFormat::Csv));
        let table = &table.without_empty_columns();
        let class = |k: usize| match (table.holds_numbers(k), table.headings[k].detail) {
            (true, true) => Some("num detail"),
            (true, false) => Some("num"),
            (false, true) => Some("detail"),
            (false, false) => None,
        };
        let meaning = |key: &str| self.glossary.iter().find(|entry| entry.key == key);
        let headings = table.headings.iter();
        let explained: Vec<_> = headings
            .filter_map(|heading| meaning(heading.key))
            .collect();
        // The title stands outside what scrolls; the table is named by it.
        html! {
            div.table.filtered[filtered] id=(id) {
                p.title id=(title) { span.number { "Table " (number) "." } " " (Words(&table.title)) }
                div.scroll role="region" tabindex="0" aria-labelledby=(title) {
                    table aria-labelledby=(title) {
                        thead {
                            tr {
                                @for (k, heading) in table.headings.iter().enumerate() {
                                    th scope="col" class=[class(k)] title=[meaning(heading.key).map(|entry| Words(&entry.meaning))] {
                                        (Typeset(&heading.label))
                                    }
                                }
                            }
                        } "\n"
                        tbody { "\n"
                            @for row in &table.rows {
                                tr {
                                    @for k in 0..table.headings.len() {
                                        (cell(k, row.get(k).unwrap_or(&Cell::Empty), class(k)))
                                    }
                                } "\n"
                            }
                        }
                    }
                }
                @if !table.notes.is_empty() {
                    div.notes {
                        @for note in &table.notes { p { (Typeset(note)) } }
                    }
                }
                p.tools {
                    a download={ (id) ".csv" } href={ "data:text/csv;charset=utf-8;base64," (csv) }
                        aria-label={ "Table " (number) " as CSV" } { "CSV" }
                    @if !explained.is_empty() {
                        span {
                            "Columns: "
                            @for (k, entry) in explained.iter().enumerate() {
                                @if k > 0 { ", " }
                                a href={ "#glossary-" (entry.key) } { (Typeset(&entry.label)) }
                            }
                        }
                    }
                }
            }
        }
    }
}

// Pixels of a style sheet, of which an inch has 96, for points, of which it has 72: letters of figures are then as large as
// those of the text.
fn pixels(points: f64) -> f64 {
    (points * 96.0 / 72.0).round()
}

// A cell. The first column heads the rows, and stays while others scroll.
fn cell(k: usize, cell: &Cell, class: Option<&str>) -> Markup {
    let value = match cell {
        Cell::Number { value, .. } => Some(sort_value(*value)),
        _ => None,
    };
    let words = cell.print(str::to_owned, false);
    let shown = match cell {
        Cell::Number { .. } => words.replace('-', "−"),
        _ => words,
    };
    let sentence = shown.chars().count() > LONGEST_LINE;
    let class = if sentence { Some("sentence") } else { class };
    html! {
        @if k == 0 {
            th scope="row" class=[class] data-value=[value] { (Words(&shown)) }
        } @else {
            td class=[class] data-value=[value] { (Words(&shown)) }
        }
    }
}

// A number as scripts read it.
fn sort_value(value: f64) -> String {
    match value.is_infinite() {
        true if value > 0.0 => "Infinity".into(),
        true => "-Infinity".into(),
        false => value.to_string(),
    }
}

#[cfg(test)]
mod tests;
