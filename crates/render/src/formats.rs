//! Tables in the formats of papers and programs.

use comfy_table::{CellAlignment, ContentArrangement, presets};
use serde_json::{Map, Value, json};

use crate::table::{Cell, Table, TableFormat};
use crate::{escape, terminal};

impl Table {
    /// The table in a format, ending in a line break.
    pub fn render(&self, format: TableFormat) -> String {
        match format {
            TableFormat::Table => terminal::fitted(self, None),
            TableFormat::Markdown => self.markdown(),
            TableFormat::Latex => self.latex(),
            TableFormat::Csv => self.csv(),
            TableFormat::Json => {
                let mut text = serde_json::to_string_pretty(&self.json()).unwrap_or_default();
                text.push('\n');
                text
            }
        }
    }

    fn markdown(&self) -> String {
        let mut table = comfy_table::Table::new();
        table
            .load_preset(presets::ASCII_MARKDOWN)
            .set_content_arrangement(ContentArrangement::Disabled)
            .set_header(self.headings.iter().map(|h| escape::markdown(&h.label)));
        for row in &self.rows {
            table.add_row(row.iter().map(|cell| cell.print(escape::markdown, false)));
        }
        for (k, column) in table.column_iter_mut().enumerate() {
            if self.holds_numbers(k) {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        let mut text = String::new();
        if !self.title.is_empty() {
            text.push_str(&format!("{}\n\n", escape::markdown(&self.title)));
        }
        text.push_str(&format!("{table}\n"));
        for note in &self.notes {
            text.push_str(&format!("\n{}\n", escape::markdown(note)));
        }
        text
    }

    fn latex(&self) -> String {
        let columns: String = (0..self.headings.len())
            .map(|k| if self.holds_numbers(k) { 'r' } else { 'l' })
            .collect();
        let line = |cells: Vec<String>| format!("{} \\\\\n", cells.join(" & "));
        let mut text = format!(
            "% {}\n% needs \\usepackage{{booktabs}}\n\\begin{{tabular}}{{@{{}}{columns}@{{}}}}\n\\toprule\n",
            escape::line(&self.title)
        );
        text.push_str(&line(
            self.headings
                .iter()
                .map(|h| escape::latex(&h.label))
                .collect(),
        ));
        text.push_str("\\midrule\n");
        for row in &self.rows {
            text.push_str(&line(
                row.iter()
                    .map(|cell| cell.print(escape::latex, true))
                    .collect(),
            ));
        }
        text.push_str("\\bottomrule\n\\end{tabular}\n");
        for note in &self.notes {
            text.push_str(&format!("% {}\n", escape::line(note)));
        }
        text
    }

    fn csv(&self) -> String {
        let errors: Vec<bool> = (0..self.headings.len())
            .map(|k| self.has_errors(k))
            .collect();
        // Writing to memory cannot fail, and rows may have fewer cells than there are headings.
        let mut text = csv::WriterBuilder::new()
            .flexible(true)
            .from_writer(Vec::new());
        let mut header = Vec::new();
        for (heading, &errors) in self.headings.iter().zip(&errors) {
            header.push(heading.key.to_owned());
            if errors {
                header.push(format!("{}_error", heading.key));
            }
        }
        let _ = text.write_record(header);
        for row in &self.rows {
            let mut fields = Vec::new();
            for (cell, &errors) in row.iter().zip(&errors) {
                let (words, error) = match cell {
                    Cell::Empty => (String::new(), None),
                    Cell::Text(words) => (escape::csv(words), None),
                    Cell::Number { value, error, .. } => (number(*value), *error),
                };
                fields.push(words);
                if errors {
                    fields.push(error.map_or(String::new(), number));
                }
            }
            let _ = text.write_record(fields);
        }
        let text = text.into_inner().unwrap_or_default();
        String::from_utf8(text).unwrap_or_default()
    }

    /// Title, rows as objects, and notes.
    pub fn json(&self) -> Value {
        let object = |row: &Vec<Cell>| {
            let mut object = Map::new();
            for (heading, cell) in self.headings.iter().zip(row) {
                let value = match cell {
                    Cell::Empty => Value::Null,
                    Cell::Text(words) => json!(words),
                    Cell::Number {
                        value, decimals, ..
                    } => exact(*value, *decimals),
                };
                object.insert(heading.key.into(), value);
                if let Cell::Number {
                    error: Some(error), ..
                } = cell
                {
                    object.insert(format!("{}_error", heading.key), json!(error));
                }
            }
            Value::Object(object)
        };
        let rows: Vec<Value> = self.rows.iter().map(object).collect();
        json!({ "title": self.title, "rows": rows, "notes": self.notes })
    }
}

// A number as JSON: counts without a decimal point.
fn exact(value: f64, decimals: usize) -> Value {
    const EXACT: f64 = 9_007_199_254_740_992.0;
    if decimals == 0 && value.fract() == 0.0 && value.abs() < EXACT {
        json!(value as i64)
    } else {
        json!(value)
    }
}

fn number(value: f64) -> String {
    if value.is_nan() {
        String::new()
    } else {
        value.to_string()
    }
}
