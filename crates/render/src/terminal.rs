//! Tables and text cut to the width of a terminal.

use comfy_table::{
    CellAlignment, ColumnConstraint, ContentArrangement, TableComponent, Width, presets,
};
use unicode_width::UnicodeWidthStr;

use crate::escape;
use crate::table::{Cell, Table};

// Blanks after a column's contents: its margin, and one between columns.
const PADDING: usize = 2;
// Words longer than this may be broken.
const LONGEST_WORD: usize = 16;

// Contents of a column: its heading and its cells as printed.
struct Column {
    heading: String,
    cells: Vec<String>,
    numbers: bool,
}

impl Column {
    fn of(table: &Table, k: usize, folded: bool) -> Self {
        let cells = || table.rows.iter().filter_map(|row| row.get(k));
        let print = |cell: &Cell| match (cell.digits(), cell) {
            (Some((value, Some(error))), _) if folded => format!("{value}\n± {error}"),
            (Some((value, Some(error))), _) => format!("{value} ± {error}"),
            (Some((value, None)), _) => value,
            (None, Cell::Text(words)) => escape::line(words),
            (None, _) => String::new(),
        };
        Column {
            heading: escape::line(&table.headings[k].label),
            cells: cells().map(print).collect(),
            numbers: table.holds_numbers(k),
        }
    }

    // The least width: numbers stay whole, words are broken only where they are very long.
    fn least(&self) -> usize {
        let words = |text: &str| {
            let longest = text.split_whitespace().map(UnicodeWidthStr::width).max();
            longest.unwrap_or(0).min(LONGEST_WORD)
        };
        let cells = self.cells.iter().map(|cell| match self.numbers {
            true => cell.lines().map(UnicodeWidthStr::width).max().unwrap_or(0),
            false => words(cell),
        });
        cells.max().unwrap_or(0).max(words(&self.heading))
    }
}

/// The table in lines of at most `width` columns, if any: errors go below their values, words are folded,
/// and what is wider still is continued below, with the columns of words that it starts with again, or the first.
pub fn fitted(table: &Table, width: Option<usize>) -> String {
    let mut text = String::new();
    if !table.title.is_empty() {
        text.push_str(&wrapped(&escape::line(&table.title), width));
    }
    let columns = |folded| -> Vec<Column> {
        (0..table.headings.len())
            .map(|k| Column::of(table, k, folded))
            .collect()
    };
    let width = width.unwrap_or(usize::MAX);
    let least = |column: &Column| column.least() + PADDING;
    let mut all = columns(false);
    if all.iter().map(least).sum::<usize>() > width {
        all = columns(true);
    }
    if !all.is_empty() {
        let words = all.iter().take_while(|column| !column.numbers).count();
        let room: usize = all.iter().take(words).map(least).sum();
        // Where they leave little room for anything else, the first has to do.
        let names = if 2 * room > width { 1 } else { words.max(1) };
        let (names, mut rest) = all.split_at(names);
        // The columns that fit together, at least one.
        loop {
            let mut part: Vec<&Column> = names.iter().collect();
            let mut used: usize = names.iter().map(least).sum();
            while let Some((next, after)) = rest.split_first()
                && (part.len() == names.len() || used + least(next) <= width)
            {
                part.push(next);
                used += least(next);
                rest = after;
            }
            text.push_str(&block(&part, width));
            if rest.is_empty() {
                break;
            }
        }
    }
    for note in &table.notes {
        text.push_str(&wrapped(&escape::line(note), Some(width)));
    }
    text
}

fn block(columns: &[&Column], width: usize) -> String {
    let mut table = comfy_table::Table::new();
    table
        .load_preset(presets::UTF8_HORIZONTAL_ONLY)
        .remove_style(TableComponent::HorizontalLines)
        .remove_style(TableComponent::MiddleIntersections)
        .remove_style(TableComponent::LeftBorderIntersections)
        .remove_style(TableComponent::RightBorderIntersections)
        .set_content_arrangement(ContentArrangement::Dynamic)
        .set_width(u16::try_from(width).unwrap_or(u16::MAX))
        .set_header(columns.iter().map(|column| &column.heading));
    let rows = columns.iter().map(|column| column.cells.len()).max();
    for k in 0..rows.unwrap_or(0) {
        table.add_row(
            columns
                .iter()
                .map(|column| column.cells.get(k).map_or("", |c| c)),
        );
    }
    for (place, column) in table.column_iter_mut().zip(columns) {
        let least = u16::try_from(column.least() + 1).unwrap_or(u16::MAX);
        place.set_padding((0, 1));
        place.set_constraint(ColumnConstraint::LowerBoundary(Width::Fixed(least)));
        if column.numbers {
            place.set_cell_alignment(CellAlignment::Right);
        }
    }
    format!("{table}\n")
}

/// A paragraph in lines of at most `width` columns, broken between words.
pub fn wrapped(text: &str, width: Option<usize>) -> String {
    let Some(width) = width else {
        return format!("{text}\n");
    };
    let mut lines = String::new();
    let mut used = 0;
    for word in text.split(' ') {
        let own = word.width();
        if used > 0 && used + 1 + own > width {
            lines.push('\n');
            used = 0;
        }
        if used > 0 {
            lines.push(' ');
            used += 1;
        }
        lines.push_str(word);
        used += own;
    }
    lines.push('\n');
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::Heading;

    fn table(columns: usize) -> Table {
        let key = |k: usize| ["set", "a", "b", "c", "d", "e", "f", "g", "h"][k % 9];
        Table {
            title: "A title of some words that is longer than a narrow terminal is wide".into(),
            headings: (0..columns)
                .map(|k| Heading::new(key(k), format!("Metric {k}")))
                .collect(),
            rows: (0..3)
                .map(|row| {
                    let cell = |k| match k {
                        0 => Cell::text("fiducial, variable PSF"),
                        k => Cell::with_error(-1234.5 * (k + row) as f64, Some(3.25), 2),
                    };
                    (0..columns).map(cell).collect()
                })
                .collect(),
            notes: vec!["A note with words enough to need a second line on a terminal of eighty columns, as it is.".into()],
        }
    }

    #[test]
    fn no_line_is_wider_than_the_terminal_and_no_number_is_lost() {
        for columns in 1..40 {
            for width in [40, 60, 80, 132, 300] {
                let text = fitted(&table(columns), Some(width));
                for line in text.lines() {
                    assert!(line.width() <= width, "{columns} in {width}: {line}");
                }
                assert_eq!(text.matches("± 3.2").count(), 3 * (columns - 1), "{text}");
                assert_eq!(text.matches('-').count(), 3 * (columns - 1), "{text}");
            }
        }
    }

    #[test]
    fn what_fits_stays_on_one_line() {
        let text = fitted(&table(3), Some(80));
        assert!(text.contains("-1234.5 ± 3.2"), "{text}");
        let narrow = fitted(&table(3), Some(40));
        assert!(narrow.contains("-1234.5 ") && narrow.lines().count() > text.lines().count());
        assert_eq!(fitted(&table(30), None).lines().count(), 1 + 4 + 3 + 1);
    }
}
