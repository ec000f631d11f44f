//! Words that come from files, made harmless in each format that they are put into. One function a format;
//! serde_json escapes JSON itself.

use std::borrow::Cow;

use shearq_files::text::formula_mark;

/// Whether a character is invisible but acts on the text around it: control characters, marks of the direction of writing,
/// separators of lines, and code points that no text may contain.
fn is_control(c: char) -> bool {
    c.is_control()
        || matches!(
            c,
            '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}'
        )
        || matches!(c, '\u{fffe}' | '\u{ffff}')
}

/// Text for a terminal: control characters but line breaks and tabs are written out as `\u001b`, which in
/// JSON and TOML means the same character.
pub fn visible(text: &str) -> Cow<'_, str> {
    let hidden = |c: char| is_control(c) && !matches!(c, '\n' | '\t');
    if !text.contains(hidden) {
        return Cow::Borrowed(text);
    }
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match hidden(c) {
            true => safe.push_str(&format!("\\u{:04x}", u32::from(c))),
            false => safe.push(c),
        }
    }
    Cow::Owned(safe)
}

/// On one line: a line break in the name of a file could forge a message.
pub fn line(text: &str) -> String {
    visible(text).replace(['\n', '\t'], " ")
}

/// Text in a line or a cell of Markdown.
pub(super) fn markdown(text: &str) -> String {
    let mut safe = String::new();
    for c in line(text).chars() {
        if "\\`*_[]<>|&$~#".contains(c) {
            safe.push('\\');
        }
        safe.push(c);
    }
    safe
}

/// Contents of a cell of CSV, without formulas. The writer of CSV adds quotes.
pub(super) fn csv(text: &str) -> String {
    format!("{}{text}", formula_mark(text))
}

/// Text in a line or a cell of LaTeX.
pub(super) fn latex(text: &str) -> String {
    let text = line(text);
    let mut characters = text.chars().peekable();
    let mut safe = String::new();
    // What the text ends with: mathematics, and a superscript in it.
    let (mut math, mut raised) = (false, false);
    while let Some(c) = characters.next() {
        let plain = || c.to_string();
        let (is_math, is_raised, token) = match c {
            '\\' => (false, false, "\\textbackslash{}".into()),
            '~' => (false, false, "\\textasciitilde{}".into()),
            '^' => (false, false, "\\textasciicircum{}".into()),
            '_' | '%' | '&' | '#' | '$' | '{' | '}' => (false, false, format!("\\{c}")),
            // LaTeX reads these as options after the end of a row.
            '[' | ']' | '*' => (false, false, format!("{{{c}}}")),
            '<' | '>' | '|' => (true, false, plain()),
            // The root covers the one letter that follows.
            '√' => match characters.next_if(char::is_ascii_alphanumeric) {
                Some(letter) => (true, false, format!("\\sqrt{{{letter}}}")),
                None => (true, false, "\\surd".into()),
            },
            '²' => (true, true, "2".into()),
            '³' => (true, true, "3".into()),
            '⁴' => (true, true, "4".into()),
            '⁻' => (true, true, "-".into()),
            _ => match SYMBOLS.iter().find(|(symbol, _)| *symbol == c) {
                Some((_, command)) => (true, false, (*command).to_owned()),
                None => (false, false, plain()),
            },
        };
        // Neighbours share their dollars and superscripts: `$x$$y$` and `^{1}^{2}` are errors or display mathematics.
        let (closing, opening) = match (raised, is_raised) {
            (true, false) => ("}", ""),
            (false, true) => ("", "^{"),
            _ => ("", ""),
        };
        safe += closing;
        if math != is_math {
            safe.push('$');
        }
        safe += opening;
        safe += &token;
        (math, raised) = (is_math, is_raised);
    }
    let end = match (math, raised) {
        (true, true) => "}$",
        (true, false) => "$",
        (false, _) => "",
    };
    safe + end
}

const SYMBOLS: [(char, &str); 11] = [
    ('Δ', "\\Delta"),
    ('λ', "\\lambda"),
    ('µ', "\\mu"),
    ('μ', "\\mu"),
    ('ℓ', "\\ell"),
    ('χ', "\\chi"),
    ('ε', "\\varepsilon"),
    ('σ', "\\sigma"),
    ('±', "\\pm"),
    ('×', "\\times"),
    ('−', "-"),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::figure::{Figure, LinePlot, PictureFormat, Series, Style};
    use crate::html::{Block, Report, Section};
    use crate::table::{Cell, Heading, Table, TableFormat};

    // Names that do something in one format or another.
    const NASTY: [&str; 24] = [
        "back\\slash \\input{/etc/passwd}",
        "\\",
        "two\nlines \\input{x}",
        "carriage\rreturn",
        "\u{1b}[2J\u{1b}]0;title\u{7}",
        "\u{9b}31mred",
        "=cmd|' /C calc'!A0",
        "+1+1",
        "-2+3",
        "@SUM(A1)",
        "a|b||c",
        "<script>alert(1)</script>",
        "</text><text>&amp;&#x1b;",
        "a & b && c",
        "\"quotes\" and 'those', too",
        "100 % %s %n",
        "$HOME $x$ $$ Δ$λ",
        "under_score __bold__ *star* `code`",
        "\u{202e}txt.exe\u{202c} \u{200f}",
        "[link](http://example.org) ![](x)",
        "#{} ~ ^ √ √A√\\ 10⁻⁴³χ",
        "\0nul\u{7f}\u{fffe}",
        "* [4ex] * row",
        "nasty\u{2028}separator",
    ];

    fn table(name: &str) -> Table {
        Table {
            title: format!("Scores of {name}"),
            headings: vec![Heading::new("name", name), Heading::new("q", "Q")],
            rows: vec![
                vec![Cell::text(name), Cell::number(1.0, 1)],
                vec![Cell::text(name), Cell::number(2.0, 1)],
            ],
            notes: vec![format!("Warning: {name}")],
        }
    }

    fn names() -> Vec<String> {
        let mut names: Vec<String> = NASTY.map(str::to_owned).into();
        names.push("long ".repeat(2000));
        names.push(NASTY.concat());
        names
    }

    // Number of `what` that no backslash stands before.
    fn bare(text: &str, what: char) -> usize {
        let mut escaped = false;
        let mut count = 0;
        for c in text.chars() {
            count += usize::from(c == what && !escaped);
            escaped = c == '\\' && !escaped;
        }
        count
    }

    fn assert_quiet(text: &str, name: &str) {
        let loud = text.chars().find(|&c| is_control(c) && c != '\n');
        assert_eq!(loud, None, "{name:?}: {text}");
    }

    #[test]
    fn tables_for_people_keep_their_lines_and_columns() {
        let lines = |text: &str| text.lines().count();
        let plain = table("plain");
        for name in names() {
            let table = table(&name);
            for format in [
                TableFormat::Table,
                TableFormat::Markdown,
                TableFormat::Latex,
            ] {
                let text = table.render(format);
                assert_quiet(&text, &name);
                assert_eq!(
                    lines(&text),
                    lines(&plain.render(format)),
                    "{name:?}: {text}"
                );
            }
            let markdown = table.render(TableFormat::Markdown);
            for row in markdown.lines().filter(|line| line.starts_with('|')) {
                assert_eq!(bare(row, '|'), 3, "{name:?}: {row}");
            }
            for mark in ['<', '&', '`', '$', '['] {
                assert_eq!(bare(&markdown, mark), 0, "{name:?}: {markdown}");
            }
        }
    }

    #[test]
    fn latex_has_no_commands_but_ours() {
        for name in names() {
            let text = table(&name).render(TableFormat::Latex);
            for row in text.lines().filter(|line| line.ends_with(" \\\\")) {
                assert_eq!(bare(row, '&'), 1, "{name:?}: {row}");
                assert_eq!(bare(row, '%') + bare(row, '#') + bare(row, '~'), 0, "{row}");
                assert_eq!(bare(row, '$') % 2, 0, "{name:?}: {row}");
                assert_eq!(bare(row, '{'), bare(row, '}'), "{name:?}: {row}");
                let adjoining = row.replace("\\$", "x").contains("$$");
                assert!(!row.starts_with(['[', '*']) && !adjoining, "{row}");
                assert!(!row.contains("}^") && !row.contains("\\input"), "{row}");
            }
            // Outside rows a name stands in comments alone.
            for line in text.lines().filter(|line| line.contains("Warning")) {
                assert!(line.starts_with("% "), "{line}");
            }
        }
    }

    #[test]
    fn csv_and_json_keep_what_is_said() {
        for name in names() {
            let table = table(&name);
            let csv = table.render(TableFormat::Csv);
            let cell = csv.strip_prefix("name,q\n").expect("the header");
            let cell = cell.trim_start_matches('"');
            assert!(!cell.starts_with(['=', '+', '-', '@']), "{name:?}: {csv}");
            // Read back as CSV is: quotes come in pairs, and separators count outside of them.
            let mut quoted = false;
            let outside = |c: &char| {
                quoted ^= *c == '"';
                !quoted
            };
            let outside: String = csv.chars().filter(outside).collect();
            assert_eq!(outside.matches(',').count(), 3, "{name:?}: {csv}");
            assert_eq!(outside.matches('\n').count(), 3, "{name:?}: {csv}");
            let json: serde_json::Value =
                serde_json::from_str(&visible(&table.render(TableFormat::Json))).unwrap();
            assert_eq!(json["rows"][0]["name"], name.as_str());
        }
    }

    #[test]
    fn pages_and_pictures_have_no_elements_but_ours() {
        for name in names() {
            let report = |name: &str| Report {
                title: name.into(),
                sections: vec![Section::new(name, name, vec![Block::Table(table(name))])],
                settings: vec![(name.into(), name.into())],
                ..Report::default()
            };
            let plot = |name: &str| LinePlot {
                title: name.into(),
                x_names: vec![name.into()],
                series: vec![Series::new(name, vec![0.0], vec![1.0], Style::Points, 0)],
                ..LinePlot::default()
            };
            let svg = |name: &str| {
                String::from_utf8(plot(name).render(PictureFormat::Svg).unwrap()).unwrap()
            };
            let tags = |text: &str| text.matches('<').count();
            // A setting of two lines is shown as lines of code.
            let plain = if name.contains('\n') {
                "two\nlines"
            } else {
                "plain"
            };
            let (found, plain) = (report(&name).render(), report(plain).render());
            assert_quiet(&found, &name);
            assert_eq!(tags(&found), tags(&plain), "{name:?}");
            // A very long name makes a picture too large to draw.
            if name.len() < 200 {
                let found = svg(&name);
                assert_quiet(&found, &name);
                assert_eq!(tags(&found), tags(&svg("plain")), "{name:?}: {found}");
                let entity = |rest: &str| {
                    let name = rest.split(';').next().unwrap_or_default();
                    ["amp", "lt", "gt", "quot", "apos", "#39"].contains(&name)
                };
                assert!(found.split('&').skip(1).all(entity), "{name:?}: {found}");
            }
        }
    }
}
