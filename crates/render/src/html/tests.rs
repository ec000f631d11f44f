//! Pages as text.

use std::collections::HashSet;

use super::*;
use crate::figure::{LinePlot, Series, Style};
use crate::table::Heading;

const NASTY: &str = "<script>alert(\"x\" + 'y')</script> & </style>";

fn picture() -> Picture {
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
    Picture::draw(&plot, "power", NASTY).unwrap()
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
                Cell::with_error(-87.125, Some(1.5), 2),
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
                    Block::Text(format!("{NASTY}\n\n{NASTY}")),
                    Block::Table(table()),
                    Block::Table(table()),
                ],
            ),
            Section::new(
                "scores",
                "Again",
                vec![Block::Figure(picture()), Block::Figure(picture())],
            ),
            Section::new("settings", "", Vec::new()),
            Section::new("\" onclick=\"", "", Vec::new()),
        ],
        glossary: vec![("q".into(), NASTY.into()), ("unused".into(), NASTY.into())],
        settings: vec![
            ("seed".into(), NASTY.into()),
            (NASTY.into(), format!("[a]\nb = \"{NASTY}\"\n")),
        ],
    }
}

// Elements as (name, attributes), after checking that they nest, that attributes are quoted and
// that no bare `<`, `>` or `&` is in the text between.
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
    assert_eq!((count("table"), count("img"), count("section")), (2, 2, 6));
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
}

#[test]
fn cells_sort_by_value_and_read_as_numbers() {
    let page = report().render();
    assert!(page.contains("<td class=\"num\" data-value=\"-87.125\">−87.1 ± 1.5</td>"));
    assert!(page.contains("data-value=\"0.00000095\">0.0 ± 1.0<"));
    assert!(page.contains("data-value=\"NaN\">–<"));
    assert!(page.contains("<td class=\"num detail\" data-value=\"Infinity\">∞</td>"));
    assert!(page.contains("<th scope=\"col\" class=\"num detail\">m</th>"));
    assert!(page.contains("<td class=\"num detail\"></td></tr>"));
}

#[test]
fn control_characters_are_written_out() {
    assert_eq!(
        Words("a\u{0}\r\n<").render().into_string(),
        "a\\u0000\\u000d\n&lt;"
    );
    assert_eq!(
        Typeset("ℓ²C_ℓ/2π, σ_sys and Q_dn of NN_set1.dat, A_1 and q_dn")
            .render()
            .into_string(),
        "ℓ²C<sub>ℓ</sub>/2π, σ<sub>sys</sub> and Q<sub>dn</sub> of NN_set1.dat, A_1 and q_dn"
    );
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
