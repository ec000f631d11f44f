//! Reports as one HTML file that needs nothing else: style, script and pictures are inside.
//!
//! A [`Report`] is a list of sections of text, tables and figures, and the settings that made it. The
//! page may fetch nothing: a content security policy in the file forbids it. Without scripts it
//! reads the same, only that its tables cannot be sorted. The same report gives the same bytes.
//!
//! ```
//! # use shearq_render::html::{Block, Report, Section};
//! let report = Report {
//!     title: "Scores".into(),
//!     sections: vec![Section::new("q", "Q", vec![Block::Text("**Q** as in `score`.".into())])],
//!     ..Report::default()
//! };
//! assert!(report.render().contains("<p><b>Q</b> as in <code>score</code>.</p>"));
//! ```

use std::borrow::Cow;
use std::collections::HashSet;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use maud::{DOCTYPE, Markup, PreEscaped, Render, html};

use crate::escape::visible;
use crate::figure::{Figure, FigureError, PictureFormat};
use crate::table::{Cell, Table, TableFormat};
use shearq_files::{FileError, atomic};

const STYLE: &str = include_str!("html/style.css");
const SCRIPT: &str = include_str!("html/script.js");

/// Characters above which the heading of a row may be folded.
const LONG: usize = 16;

/// Characters above which the words of a cell run over several lines.
const SENTENCE: usize = 48;

/// What replaces `DARK` in the style sheet, which needs it in two places.
const DARK: &str = "color-scheme: dark; --paper: #15171a; --ink: #dddcd8; --muted: #a0a4a9; \
     --rule: #34383d; --strong-rule: #8b9096; --link: #8fb8e0; --shade: #202327; --edge: #000a; --dim: brightness(.92);";

/// A report.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    /// Title of the page.
    pub title: String,
    /// One line below it; may be empty.
    pub subtitle: String,
    /// What it has to say.
    pub sections: Vec<Section>,
    /// Meanings of columns by the keys of their headings. Those of columns that the report has are listed, and linked
    /// from the tables.
    pub glossary: Vec<(String, String)>,
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
    /// The same with a field that hides rows without the words that a reader types.
    Filtered(Table),
    /// A figure.
    Figure(Picture),
}

impl Block {
    fn is_figure(&self) -> bool {
        matches!(self, Block::Figure(_))
    }
}

/// A figure as it stands in a report.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// File name without extension, for links to the figure.
    stem: String,
    /// Caption, with the markup of [`Block::Text`]; without it, the description for those who cannot see the figure.
    caption: String,
    svg: Vec<u8>,
    /// Width and height in points.
    size: (f64, f64),
    /// Labels and paths, relative to the report, of the same figure in other formats.
    links: Vec<(String, String)>,
}

impl Picture {
    /// Draws a figure for a report.
    ///
    /// # Errors
    /// Those of [`Figure::render`].
    pub fn draw(
        figure: &dyn Figure,
        stem: impl Into<String>,
        caption: impl Into<String>,
    ) -> Result<Self, FigureError> {
        Ok(Picture {
            stem: stem.into(),
            caption: caption.into(),
            svg: figure.render(PictureFormat::Svg)?,
            size: figure.size(),
            links: Vec::new(),
        })
    }

    /// The same with one more link.
    pub fn link(mut self, label: impl Into<String>, path: impl Into<String>) -> Self {
        self.links.push((label.into(), path.into()));
        self
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
        let glossary = self.used_glossary();
        page.glossary.clone_from(&glossary);
        if !glossary.is_empty() {
            contents.push(GLOSSARY);
        }
        if !self.settings.is_empty() {
            contents.push(SETTINGS);
        }
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
                            (section(id, &part.heading, html! {
                                @for blocks in part.blocks.chunk_by(|a, b| a.is_figure() && b.is_figure()) {
                                    @if blocks.len() > 1 {
                                        div.figures { @for block in blocks { (page.block(block)) "\n" } } "\n"
                                    } @else {
                                        @for block in blocks { (page.block(block)) "\n" }
                                    }
                                }
                            }))
                        }
                        @if !glossary.is_empty() {
                            (section(GLOSSARY.0, GLOSSARY.1, meanings(&glossary)))
                        }
                        @if !self.settings.is_empty() {
                            (section(SETTINGS.0, SETTINGS.1, settings(&self.settings)))
                        }
                    } "\n"
                } "\n"
            } "\n"
        };
        markup.into_string()
    }

    /// The entries of the glossary whose columns are in tables: key, label, meaning.
    fn used_glossary(&self) -> Vec<Entry> {
        let blocks = self.sections.iter().flat_map(|section| &section.blocks);
        let tables = blocks.filter_map(|block| match block {
            Block::Table(table) | Block::Filtered(table) => Some(table),
            _ => None,
        });
        let headings: Vec<_> = tables.flat_map(|table| &table.headings).collect();
        let entries = self.glossary.iter().filter_map(|(key, meaning)| {
            let heading = headings.iter().find(|heading| heading.key == key)?;
            Some(Entry {
                key: key.clone(),
                label: heading.label.clone(),
                meaning: meaning.clone(),
            })
        });
        entries.collect()
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

/// Name and heading of the section of meanings.
const GLOSSARY: (&str, &str) = ("glossary", "Glossary");

/// The meaning of a column.
#[derive(Debug, Clone)]
struct Entry {
    key: String,
    label: String,
    meaning: String,
}

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

/// Words from elsewhere: escaped as all text is, with control characters, which no page can hold, written out.
struct Words<'a>(&'a str);

impl Render for Words<'_> {
    fn render_to(&self, page: &mut String) {
        visible(self.0).as_ref().render_to(page);
    }
}

/// Words in which symbols with an index are typeset. Not for attributes.
struct Typeset<'a>(&'a str);

/// Symbols with an index, as terminals and as pages show them.
const INDEXED: [(&str, &str); 3] = [
    ("C_ℓ", "C<sub>ℓ</sub>"),
    ("Q_dn", "Q<sub>dn</sub>"),
    ("σ_sys", "σ<sub>sys</sub>"),
];

impl Render for Typeset<'_> {
    fn render_to(&self, page: &mut String) {
        let mut words = Words(self.0).render().into_string();
        for (plain, typeset) in INDEXED {
            words = words.replace(plain, typeset);
        }
        page.push_str(&words);
    }
}

fn meanings(glossary: &[Entry]) -> Markup {
    html! {
        dl {
            @for entry in glossary {
                dt id={ "glossary-" (entry.key) } { (Typeset(&entry.label)) }
                dd { (Typeset(&entry.meaning)) } "\n"
            }
        } "\n"
    }
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
            link rel="icon" href="data:,"; "\n"
            title { (Words(title)) } "\n"
            style { (PreEscaped(STYLE.replace("DARK", DARK))) } "\n"
            script { (PreEscaped(SCRIPT)) } "\n"
        } "\n"
    }
}

fn section(id: &str, heading: &str, contents: Markup) -> Markup {
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

fn code(code: &str) -> Markup {
    // The parser drops one line break after the tag, so that the first of the code's own stays.
    html! {
        pre tabindex="0" { "\n" code { (Words(code.trim_end_matches('\n'))) } }
    }
}

fn settings(settings: &[(String, String)]) -> Markup {
    html! {
        dl {
            @for (name, value) in settings {
                @let value = value.trim_end_matches('\n');
                dt { (Words(name)) }
                @if value.contains('\n') {
                    dd.long { (code(value)) }
                } @else {
                    dd { (Words(value)) }
                } "\n"
            }
        } "\n"
    }
}

/// A page on its way: what is numbered in it, and the names that are taken.
#[derive(Debug)]
struct Page {
    ids: Ids,
    tables: usize,
    figures: usize,
    glossary: Vec<Entry>,
}

impl Page {
    fn new() -> Self {
        let taken = ["main", "theme", GLOSSARY.0, SETTINGS.0];
        Page {
            ids: Ids(taken.map(String::from).into()),
            tables: 0,
            figures: 0,
            glossary: Vec::new(),
        }
    }

    fn block(&mut self, block: &Block) -> Markup {
        match block {
            Block::Text(text) => html! {
                @for paragraph in paragraphs(text) { p { (inline(&paragraph)) } }
            },
            Block::Table(table) => self.table(table, false),
            Block::Filtered(table) => self.table(table, true),
            Block::Figure(picture) => self.figure(picture),
        }
    }

    fn figure(&mut self, picture: &Picture) -> Markup {
        self.figures += 1;
        let id = self.ids.give(&format!("figure-{}", picture.stem));
        // As an image, and not as elements of the page, an SVG keeps its names and styles to itself.
        html! {
            figure id=(id) {
                div.plate {
                    img src={ "data:image/svg+xml;base64," (BASE64.encode(&picture.svg)) }
                        alt=(Words(&plain(&picture.caption))) width=(picture.size.0) height=(picture.size.1);
                }
                figcaption {
                    p {
                        span.number { "Figure " (self.figures) "." } " "
                        (inline(&paragraphs(&picture.caption).join(" ")))
                    }
                    p.tools {
                        @for (k, (label, path)) in picture.links.iter().enumerate() {
                            @if k > 0 { " " }
                            a href=(relative_url(path)) { (Words(label)) }
                        }
                    }
                }
            }
        }
    }

    fn table(&mut self, table: &Table, filtered: bool) -> Markup {
        self.tables += 1;
        let number = self.tables;
        let id = self.ids.give(&format!("table-{number}"));
        let title = self.ids.give(&format!("{id}-title"));
        let csv = BASE64.encode(table.render(TableFormat::Csv));
        let (table, known) = (&table.without_empty_columns(), &self.glossary);
        let columns: Vec<Column> = (0..table.headings.len())
            .map(|k| Column::of(table, k))
            .collect();
        let meaning = |key: &str| known.iter().find(|entry| entry.key == key);
        let explained: Vec<_> = table
            .headings
            .iter()
            .filter_map(|heading| meaning(heading.key))
            .collect();
        // The caption stands outside what scrolls; the table is named by it.
        html! {
            div.table.filtered[filtered] id=(id) {
                p.title id=(title) { span.number { "Table " (number) "." } " " (Words(&table.title)) }
                div.scroll role="region" tabindex="0" aria-labelledby=(title) {
                    table aria-labelledby=(title) {
                        thead {
                            tr {
                                @for (heading, column) in table.headings.iter().zip(&columns) {
                                    th scope="col" class=[column.class(false)] title=[meaning(heading.key).map(|entry| Words(&entry.meaning))] {
                                        (Typeset(&heading.label))
                                    }
                                }
                            }
                        } "\n"
                        tbody { "\n"
                            @for row in &table.rows {
                                tr {
                                    @for (k, column) in columns.iter().enumerate() {
                                        (column.cell(k, row.get(k)))
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

    /// Classes of a cell; of one whose words may be folded on narrow screens if it is `long`.
    fn class(self, long: bool) -> Option<String> {
        let classes = [
            ("long", long),
            ("num", self.numbers),
            ("detail", self.detail),
        ];
        let classes: Vec<&str> = classes
            .iter()
            .filter(|class| class.1)
            .map(|class| class.0)
            .collect();
        (!classes.is_empty()).then(|| classes.join(" "))
    }

    /// A cell. The first column heads the rows, and stays while others scroll.
    fn cell(self, k: usize, cell: Option<&Cell>) -> Markup {
        let class = self.class(false);
        match cell {
            None | Some(Cell::Empty) if k == 0 => html! { th scope="row" class=[class] {} },
            None | Some(Cell::Empty) => html! { td class=[class] {} },
            Some(number @ Cell::Number { value, .. }) if k == 0 => html! {
                th scope="row" class=[class] data-value=(sort_value(*value)) {
                    (number.digits().map_or_else(String::new, |shown| shown.0.replace('-', "−")))
                }
            },
            Some(Cell::Text(words)) if k == 0 => {
                let long = words.chars().count() > LONG;
                html! { th scope="row" class=[self.class(long)] { (Words(words)) } }
            }
            Some(Cell::Text(words)) => {
                let sentence = words.chars().count() > SENTENCE;
                let classes = [class.as_deref(), sentence.then_some("sentence")];
                let classes: Vec<&str> = classes.into_iter().flatten().collect();
                let class = (!classes.is_empty()).then(|| classes.join(" "));
                html! { td class=[class] { (Words(words)) } }
            }
            Some(number @ Cell::Number { value, .. }) => html! {
                td class=[class] data-value=(sort_value(*value)) {
                    (number.digits().map_or_else(String::new, |shown| shown.0.replace('-', "−")))
                    @if let Some(width) = self.error_width {
                        // The space of the error is kept where there is none, so that values align.
                        @let error = error_text(number);
                        span.pm style=[error.is_none().then_some("visibility:hidden")] { "\u{a0}±\u{a0}" }
                        span.error style={ "min-width:" (width) "ch" } { (error.unwrap_or_default()) }
                    }
                }
            },
        }
    }
}

/// The error of a cell as printed, where it has one.
fn error_text(cell: &Cell) -> Option<String> {
    cell.digits()?.1
}

/// The width of a number without sign, in digits; a decimal point takes about half of one.
fn width_in_digits(number: &str) -> f64 {
    let points = number.matches('.').count();
    number.len() as f64 - 0.5 * points as f64
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

/// The parts of a text outside and inside of pairs of `mark`, in turn. Marks without a partner, or with nothing between,
/// are text.
fn marked<'a>(text: &'a str, mark: &str) -> Vec<(bool, Cow<'a, str>)> {
    let mut parts: Vec<Cow<'_, str>> = text.split(mark).map(Cow::from).collect();
    if parts.len().is_multiple_of(2)
        && let (Some(last), Some(before)) = (parts.pop(), parts.last_mut())
    {
        *before = format!("{before}{mark}{last}").into();
    }
    let parts = parts.into_iter().enumerate();
    let part = |(k, part): (usize, Cow<'a, str>)| match (k % 2 == 1, part.is_empty()) {
        (true, true) => (false, mark.repeat(2).into()),
        (inside, _) => (inside, part),
    };
    parts.map(part).collect()
}

/// A paragraph with its markup as HTML.
fn inline(text: &str) -> Markup {
    html! {
        @for (is_code, part) in marked(text, "`") {
            @if is_code { code { (Words(&part)) } } @else {
                @for (is_bold, part) in marked(&part, "**") {
                    @if is_bold { b { (Typeset(&part)) } } @else { (Typeset(&part)) }
                }
            }
        }
    }
}

/// A text without its markup.
fn plain(text: &str) -> String {
    let text = paragraphs(text).join(" ");
    let outside = |part: &str| marked(part, "**").into_iter().map(|own| own.1).collect();
    let parts = marked(&text, "`").into_iter();
    let words = parts.map(|(code, part)| {
        if code {
            part.into_owned()
        } else {
            outside(&part)
        }
    });
    words.collect()
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
mod tests;
