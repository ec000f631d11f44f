//! Tables: columns, rows of cells, and notes; for terminals, papers and programs.

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TableFormat {
    #[default]
    Table,
    Json,
    /// Comma-separated, full precision, value and error in separate columns; an apostrophe before words that a
    /// spreadsheet would execute as a formula.
    Csv,
    Markdown,
    Latex,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Cell {
    /// Nothing, in a column of words or of numbers.
    Empty,
    Text(String),
    /// A number, perhaps with an error, and the decimals that are printed.
    Number {
        // The value; not a number is printed as a dash.
        value: f64,
        error: Option<f64>,
        decimals: usize,
    },
}

impl Cell {
    pub fn text(words: impl Into<String>) -> Self {
        Cell::Text(words.into())
    }

    pub fn number(value: f64, decimals: usize) -> Self {
        Cell::Number {
            value,
            error: None,
            decimals,
        }
    }

    pub fn with_error(value: f64, error: Option<f64>, decimals: usize) -> Self {
        Cell::Number {
            value,
            error,
            decimals,
        }
    }

    /// A number and its error in digits for people. The error has two significant digits, and the number as many
    /// decimals. `None` if the cell is not a number.
    pub fn digits(&self) -> Option<(String, Option<String>)> {
        let Cell::Number {
            value,
            error,
            decimals,
        } = self
        else {
            return None;
        };
        if value.is_nan() {
            return Some(("–".into(), None));
        }
        if value.is_infinite() {
            return Some((if *value > 0.0 { "∞" } else { "-∞" }.into(), None));
        }
        let decimals = match *error {
            Some(error) if error.is_finite() => decimals_of(error, *decimals),
            // Without a known error the last digits may be noise.
            Some(_) => decimals_for(*value, UNSURE).min(*decimals),
            None => *decimals,
        };
        let error = error.filter(|error| error.is_finite());
        let shown = |number: f64| match format!("{number:.decimals$}") {
            // A number that rounds to zero has no sign.
            zero if zero.starts_with('-') && !zero.contains(|c: char| ('1'..='9').contains(&c)) => {
                zero[1..].to_owned()
            }
            number => number,
        };
        Some((shown(*value), error.map(shown)))
    }

    /// A number with its error as in sentences; "error unknown" if it is unknown.
    pub fn in_words(&self) -> String {
        match self.digits() {
            Some((number, Some(error))) => format!("{number} ± {error}"),
            Some((number, None)) if number != "–" => format!("{number} (error unknown)"),
            _ => "unknown".into(),
        }
    }

    /// For people, words by `escape`; `latex` wraps numbers in mathematics.
    pub(crate) fn print(&self, escape: fn(&str) -> String, latex: bool) -> String {
        match (self, self.digits()) {
            (Cell::Text(words), _) => escape(words),
            (_, None) => String::new(),
            (_, Some((number, None))) if number == "–" => number,
            (_, Some((number, None))) if latex => format!("${}$", number.replace('∞', "\\infty")),
            (_, Some((number, None))) => number,
            (_, Some((number, Some(error)))) if latex => format!("${number} \\pm {error}$"),
            (_, Some((number, Some(error)))) => format!("{number} ± {error}"),
        }
    }
}

// Most decimals that the error of a number can require.
const MAX_DECIMALS: usize = 12;

// Significant digits of a number with an unknown error.
const UNSURE: i32 = 3;

// Decimals that give `error` two significant digits; `otherwise` for an error of zero.
fn decimals_of(error: f64, otherwise: usize) -> usize {
    match error > 0.0 {
        true => decimals_for(error, 2),
        false => otherwise,
    }
}

// Decimals that give a number this number of significant `digits`.
fn decimals_for(number: f64, digits: i32) -> usize {
    // Rounding can lengthen a number: 0.0996 is 0.10.
    let before = usize::try_from(digits - 1).unwrap_or(0);
    let rounded = format!("{number:.before$e}");
    let exponent = rounded
        .split_once('e')
        .map(|(_, exponent)| exponent.parse::<i32>());
    let Some(Ok(exponent)) = exponent else {
        return MAX_DECIMALS;
    };
    let decimals = digits - 1 - exponent;
    usize::try_from(decimals).unwrap_or(0).min(MAX_DECIMALS)
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Heading {
    pub key: &'static str,
    pub label: String,
    /// Left out of tables for people unless they are to be wide; CSV and JSON have every column.
    pub detail: bool,
}

impl Heading {
    pub fn new(key: &'static str, label: impl Into<String>) -> Self {
        Heading {
            key,
            label: label.into(),
            detail: false,
        }
    }

    /// The same, left out of narrow tables.
    pub fn detail(self) -> Self {
        Heading {
            detail: true,
            ..self
        }
    }
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct Table {
    pub title: String,
    pub headings: Vec<Heading>,
    pub rows: Vec<Vec<Cell>>,
    pub notes: Vec<String>,
}

impl Table {
    /// A table without columns yet.
    pub fn titled(title: impl Into<String>) -> Self {
        Table {
            title: title.into(),
            ..Table::default()
        }
    }

    /// Adds a column with the cell of each of `rows`, the same for all columns, and returns its place. Heading and cells
    /// stand together in the code, so that none can be put under the heading of another column.
    pub fn column<R>(
        &mut self,
        key: &'static str,
        label: impl Into<String>,
        rows: &[R],
        cell: impl Fn(&R) -> Cell,
    ) -> usize {
        self.headings.push(Heading::new(key, label));
        self.rows.resize(rows.len(), Vec::new());
        for (cells, row) in self.rows.iter_mut().zip(rows) {
            cells.push(cell(row));
        }
        self.headings.len() - 1
    }

    /// The table without columns that have no value in any row.
    pub fn without_empty_columns(&self) -> Self {
        let has_value = |k: usize| {
            self.rows.iter().any(|row| match row.get(k) {
                None | Some(Cell::Empty) => false,
                Some(Cell::Text(words)) => !words.is_empty(),
                Some(Cell::Number { value, .. }) => !value.is_nan(),
            })
        };
        let places = (0..self.headings.len()).filter(|&k| self.rows.is_empty() || has_value(k));
        self.picked(&places.collect::<Vec<_>>())
    }

    // The columns at `places`, in that order.
    fn picked(&self, places: &[usize]) -> Self {
        let row = |row: &Vec<Cell>| {
            places
                .iter()
                .map(|&k| row.get(k).cloned().unwrap_or(Cell::Empty))
                .collect()
        };
        Table {
            title: self.title.clone(),
            headings: places.iter().map(|&k| self.headings[k].clone()).collect(),
            rows: self.rows.iter().map(row).collect(),
            notes: self.notes.clone(),
        }
    }

    pub fn narrow(&self) -> Self {
        let all = 0..self.headings.len();
        self.picked(
            &all.filter(|&k| !self.headings[k].detail)
                .collect::<Vec<_>>(),
        )
    }

    // Number of columns that name the rows: those before the first column of numbers, except set numbers.
    fn names(&self) -> usize {
        let number = |k: &usize| {
            if self.headings[*k].key == "set" {
                return false;
            }
            let mut cells = self.rows.iter().filter_map(|row| row.get(*k));
            cells.any(|cell| matches!(cell, Cell::Number { .. }))
        };
        let all = self.headings.len();
        (0..all).find(number).unwrap_or(all)
    }

    /// Keys of the columns after those that name the rows.
    pub fn metrics(&self) -> Vec<&'static str> {
        let metrics = self.headings.iter().skip(self.names());
        metrics.map(|heading| heading.key).collect()
    }

    /// The columns that name the rows, without details, followed by the columns `metrics`; or the first of `metrics` that is
    /// not the key of a metric.
    pub fn chosen<'a>(&self, metrics: &'a [String]) -> Result<Self, &'a str> {
        let names = self.names();
        let mut places: Vec<usize> = (0..names).filter(|&k| !self.headings[k].detail).collect();
        for key in metrics {
            let place = self.place(key).filter(|&place| place >= names);
            let place = place.ok_or(key.as_str())?;
            if !places.contains(&place) {
                places.push(place);
            }
        }
        Ok(self.picked(&places))
    }

    pub fn place(&self, key: &str) -> Option<usize> {
        self.headings.iter().position(|heading| heading.key == key)
    }

    /// The columns of `keys`, of rows that have something in the last of them, under another title and
    /// with some of the notes.
    pub fn part(&self, keys: &[&str], title: &str, notes: &[String]) -> Self {
        let all = 0..self.headings.len();
        let kept: Vec<usize> = all
            .filter(|&k| keys.contains(&self.headings[k].key))
            .collect();
        let mut part = self.picked(&kept);
        part.title = title.to_owned();
        part.rows.retain(|row| row.last() != Some(&Cell::Empty));
        part.notes = notes.to_vec();
        part
    }

    /// Whether a column holds numbers, and stands on the right.
    pub(crate) fn holds_numbers(&self, k: usize) -> bool {
        let mut cells = self.rows.iter().filter_map(|row| row.get(k));
        cells.any(|cell| matches!(cell, Cell::Number { .. }))
    }

    /// Whether a column holds errors, and needs a second column in CSV.
    pub(crate) fn has_errors(&self, k: usize) -> bool {
        self.rows
            .iter()
            .any(|row| matches!(row.get(k), Some(Cell::Number { error: Some(_), .. })))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::escape;

    fn table() -> Table {
        Table {
            title: "Scores".into(),
            headings: vec![Heading::new("name", "Name"), Heading::new("q", "Q")],
            rows: vec![
                vec![Cell::text("a,b"), Cell::with_error(87.125, Some(1.5), 1)],
                vec![Cell::text("c_d"), Cell::number(f64::NAN, 1)],
            ],
            notes: vec!["A note.".into()],
        }
    }

    #[test]
    fn every_format_holds_the_numbers() {
        let people = table().render(TableFormat::Table);
        assert!(people.contains("87.1 ± 1.5") && people.contains('–'));
        assert!(
            table()
                .render(TableFormat::Markdown)
                .contains("| 87.1 ± 1.5 |")
        );
        let latex = table().render(TableFormat::Latex);
        assert!(latex.contains("a,b & $87.1 \\pm 1.5$ \\\\") && latex.contains("c\\_d"));
        assert_eq!(
            table().render(TableFormat::Csv),
            "name,q,q_error\n\"a,b\",87.125,1.5\nc_d,,\n"
        );
        assert_eq!(escape::latex("√A×10⁴"), "$\\sqrt{A}\\times$10$^{4}$");
        let json: Value = serde_json::from_str(&table().render(TableFormat::Json)).unwrap();
        assert_eq!(json["rows"][0]["q_error"], 1.5);
        assert!(json["rows"][1]["q"].is_null());
    }

    #[test]
    fn numbers_without_the_error_they_ought_to_have_are_short() {
        let shown = |value, error| Cell::with_error(value, error, 4).digits().unwrap().0;
        for (value, expected) in [
            (2.011, "2.01"),
            (-0.020_914, "-0.0209"),
            (123.456, "123"),
            (9.999, "10.0"),
            (0.0, "0.00"),
        ] {
            assert_eq!(shown(value, Some(f64::NAN)), expected);
        }
        assert_eq!(shown(2.011, None), "2.0110");
    }

    #[test]
    fn empty_cells_keep_number_columns_and_parts_omit_rows() {
        let mut whole = table();
        whole.rows.push(vec![Cell::text("mean"), Cell::Empty]);
        assert!(whole.render(TableFormat::Csv).ends_with("mean,,\n"));
        assert!(whole.json()["rows"][2]["q"].is_null());
        let part = whole.part(&["name", "q"], "Part", &[]);
        assert_eq!((part.rows.len(), part.headings.len()), (2, 2));
    }

    #[test]
    fn metrics_are_chosen_beside_the_names_of_rows() {
        let mut whole = table();
        whole.headings.push(Heading::new("m", "m").detail());
        whole.rows[0].push(Cell::number(0.5, 1));
        assert_eq!(whole.metrics(), ["q", "m"]);
        let keys = |metrics: &[&str]| {
            let metrics: Vec<String> = metrics.iter().map(|&key| key.to_owned()).collect();
            whole
                .chosen(&metrics)
                .map(|table| {
                    table
                        .headings
                        .iter()
                        .map(|heading| heading.key)
                        .collect::<Vec<_>>()
                })
                .map_err(str::to_owned)
        };
        // A column of detail that is asked for is there.
        assert_eq!(keys(&["m", "q", "m"]).unwrap(), ["name", "m", "q"]);
        assert_eq!(keys(&["q", "name"]).unwrap_err(), "name");
        assert_eq!(keys(&["Q"]).unwrap_err(), "Q");
        // The number of a set names a row.
        let mut sets = whole.clone();
        sets.headings[1].key = "set";
        assert_eq!(sets.metrics(), ["m"]);
        let chosen = whole.chosen(&["m".to_owned()]).unwrap();
        let csv = chosen.render(TableFormat::Csv);
        assert!(csv.starts_with("name,m"), "{csv}");
    }
}
