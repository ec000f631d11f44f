//! Words that come from files, made harmless in each format that they are put into. One function a format;
//! JSON is written by serde_json, which knows its own.

use std::borrow::Cow;

use shearq_submissions::is_control;

use shearq_files::text::formula_mark;

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

/// The same on one line.
pub(super) fn line(text: &str) -> String {
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

/// What a character becomes in LaTeX.
enum Latex {
    Text(Cow<'static, str>),
    Math(Cow<'static, str>),
    Superscript(char),
}

/// Text in a line or a cell of LaTeX.
pub(super) fn latex(text: &str) -> String {
    let text = line(text);
    let mut characters = text.chars();
    let mut safe = String::new();
    // What is open: mathematics, and a superscript in it.
    let (mut math, mut raised) = (false, false);
    while let Some(c) = characters.next() {
        let token = latex_token(c, &mut characters);
        if raised && !matches!(token, Latex::Superscript(_)) {
            safe.push('}');
            raised = false;
        }
        if math == matches!(token, Latex::Text(_)) {
            safe.push('$');
            math = !math;
        }
        match token {
            Latex::Text(words) | Latex::Math(words) => safe.push_str(&words),
            Latex::Superscript(c) => {
                if !raised {
                    safe.push_str("^{");
                    raised = true;
                }
                safe.push(c);
            }
        }
    }
    if raised {
        safe.push('}');
    }
    if math {
        safe.push('$');
    }
    safe
}

fn latex_token(c: char, rest: &mut std::str::Chars<'_>) -> Latex {
    let text = |words| Latex::Text(Cow::Borrowed(words));
    let math = |words| Latex::Math(Cow::Borrowed(words));
    match c {
        '\\' => text("\\textbackslash{}"),
        '~' => text("\\textasciitilde{}"),
        '^' => text("\\textasciicircum{}"),
        '_' | '%' | '&' | '#' | '$' | '{' | '}' => Latex::Text(format!("\\{c}").into()),
        // After the end of a row these would be taken for its options.
        '[' | ']' | '*' => Latex::Text(format!("{{{c}}}").into()),
        '<' | '>' | '|' => Latex::Math(c.to_string().into()),
        // Of the one letter that follows.
        '√' => match rest.clone().next().filter(char::is_ascii_alphanumeric) {
            Some(letter) => {
                rest.next();
                Latex::Math(format!("\\sqrt{{{letter}}}").into())
            }
            None => math("\\surd"),
        },
        'Δ' => math("\\Delta"),
        'λ' => math("\\lambda"),
        'µ' | 'μ' => math("\\mu"),
        'ℓ' => math("\\ell"),
        'χ' => math("\\chi"),
        'ε' => math("\\varepsilon"),
        'σ' => math("\\sigma"),
        '±' => math("\\pm"),
        '×' => math("\\times"),
        '−' => math("-"),
        '²' => Latex::Superscript('2'),
        '³' => Latex::Superscript('3'),
        '⁴' => Latex::Superscript('4'),
        '⁻' => Latex::Superscript('-'),
        other => Latex::Text(other.to_string().into()),
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;
    use crate::figure::{Figure, HeatMap, PictureFormat};
    use crate::html::{Block, Report, Section};
    use crate::table::{Cell, Heading, Table, TableFormat};

    /// Names that do something in one format or another.
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

    /// Number of `what` that no backslash stands before.
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
            let map = |name: &str| HeatMap {
                title: name.into(),
                rows: vec![name.into()],
                columns: vec!["1".into()],
                values: Array2::ones((1, 1)),
                ..HeatMap::default()
            };
            let svg = |name: &str| {
                String::from_utf8(map(name).render(PictureFormat::Svg).unwrap()).unwrap()
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
