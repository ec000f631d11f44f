//! Pages as text.

use std::collections::HashSet;

use super::*;
use crate::figure::{LinePlot, Series, Style};
use crate::table::Heading;

const NASTY: &str = "<script>alert(\"x\" + 'y')</script> & </style>";

fn picture() -> Picture {
    let (x, y) = (vec![1.0, 2.0, 3.0], vec![1.0, 4.0, 9.0]);
    let plot = LinePlot {
        title: "Power".into(),
        series: vec![Series::new("true", x, y, Style::Line, 0)],
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
    let text = Block::Text(format!("{NASTY}\n\n{NASTY}"));
    let tables = vec![text, Block::Table(table()), Block::Table(table())];
    let figures = vec![Block::Figure(picture()), Block::Figure(picture())];
    Report {
        title: NASTY.into(),
        subtitle: NASTY.into(),
        sections: vec![
            Section::new("scores", NASTY, tables),
            Section::new("scores", "Again", figures),
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

// Values of an attribute. That elements nest and texts are escaped is a matter of maud; `escape.rs` counts the elements.
fn values<'a>(page: &'a str, key: &str) -> Vec<&'a str> {
    let start = format!(" {key}=\"");
    let rests = page.split(&start).skip(1);
    rests.map(|rest| rest.split('"').next().unwrap()).collect()
}

#[test]
fn places_of_the_page_have_one_name_each_whatever_the_words_are() {
    let page = report().render();
    let ids = values(&page, "id");
    let unique: HashSet<&str> = ids.iter().copied().collect();
    assert_eq!(ids.len(), unique.len());
    let links = values(&page, "href").into_iter();
    let links = links.filter_map(|href| href.strip_prefix('#'));
    for id in links.chain(values(&page, "aria-labelledby")) {
        assert!(unique.contains(id), "{id}");
    }
    let count = |start: &str| page.matches(start).count();
    assert_eq!((count("<script"), count("<h1"), count("<table")), (1, 1, 2));
    assert_eq!((count("<section"), values(&page, "alt").len()), (6, 2));
    assert_eq!(count("<th"), count("<thead") + values(&page, "scope").len());
    assert!(values(&page, "onclick").is_empty());
    assert_eq!(page, report().render());
}

#[test]
fn the_page_refers_to_nothing_outside() {
    let page = report().render();
    for outside in ["http://", "https://", "url(", "@import", "href=\"//"] {
        assert!(!page.contains(outside), "{outside}");
    }
}

#[test]
fn cells_sort_by_value_and_read_as_numbers() {
    let page = report().render();
    for cell in [
        "<td class=\"num\" data-value=\"-87.125\">−87.1 ± 1.5</td>",
        "data-value=\"0.00000095\">0.0 ± 1.0<",
        "data-value=\"NaN\">–<",
        "<td class=\"num detail\" data-value=\"Infinity\">∞</td>",
        "<th scope=\"col\" class=\"num detail\">m</th>",
        "<td class=\"num detail\"></td></tr>",
    ] {
        assert!(page.contains(cell), "{cell}");
    }
}

#[test]
fn details_are_folded_and_figures_have_letters_of_the_text() {
    let blocks = vec![Block::Table(table()), Block::Folded(table())];
    let page = Report {
        sections: vec![
            Section::new("a", "A", blocks).titled("B"),
            Section::new("b", "", vec![Block::Figure(picture())]),
        ],
        ..Report::default()
    };
    let page = page.render();
    let (shown, folded) = page.split_once("<details><summary>").unwrap();
    assert_eq!(
        [shown, folded].map(|part| part.matches("<table").count()),
        [1, 1]
    );
    assert!(shown.contains(">B<") && !page.contains(">A<"));
    // 72 points are 96 pixels.
    let width: f64 = values(&page, "width")[0].parse().unwrap();
    assert!((width * 0.75 - picture().size.0).abs() < 0.5, "{width}");
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
    let empty = Report::default().render();
    assert!(!empty.contains("<nav") && !empty.contains("<h2"));
}
