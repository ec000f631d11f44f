//! A table with its cells coloured by their values.

use ndarray::Array2;
use plotters::backend::DrawingBackend;
use plotters::element::Rectangle;
use plotters::style::{Color, RGBColor};

use super::axis::plain;
use super::colour::{ColourMap, position, text_on};
use super::{
    Canvas, Drawing, Drawn, FigureError, LABEL_SIZE, MARGIN, MIDDLE, RIGHT, TICK_SIZE, TITLE_SIZE,
    TO_CENTRE, font, place, room, text_width, widest, write, write_in,
};

// Height of a row, in points, and the white line between cells.
const ROW: f64 = 26.0;
const SEAM: f64 = 0.5;

/// A matrix of values with names of rows and columns, the first row on top.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HeatMap {
    pub title: String,
    /// What the rows are, above their names.
    pub row_label: String,
    pub column_label: String,
    pub rows: Vec<String>,
    pub columns: Vec<String>,
    /// The values (row, column); those that are not finite are drawn as missing.
    pub values: Array2<f64>,
    /// How many decimals are written in the cells.
    pub decimals: usize,
    /// What the values are, in the title.
    pub value_label: String,
    pub map: ColourMap,
}

struct Sizes {
    cell: f64,
    // Left and upper edge of the cells, and the width of all.
    left: f64,
    top: f64,
    width: f64,
}

impl HeatMap {
    fn heading(&self) -> String {
        match self.value_label.as_str() {
            "" => self.title.clone(),
            label => format!("{} ({label})", self.title),
        }
    }

    fn cell(&self, value: f64) -> (String, RGBColor) {
        let words = match value.is_finite() {
            true => plain(value, self.decimals.min(12)),
            false => "–".into(),
        };
        let limits = self.map.limits(self.values.iter());
        (words, self.map.colour(position(value, limits)))
    }

    /// The table for a terminal, with coloured cells if it has colours.
    pub fn terminal(&self, coloured: bool) -> String {
        let cells = self.values.map(|&value| self.cell(value));
        // Counted in characters, as terminals do, and not in bytes.
        let longest = |texts: &mut dyn Iterator<Item = &String>| {
            texts.map(|text| text.chars().count()).max().unwrap_or(0)
        };
        let names = longest(&mut self.rows.iter());
        let width = longest(&mut cells.iter().map(|(words, _)| words).chain(&self.columns));
        let mut text = format!("{}\n{:names$}", self.heading(), "");
        for column in &self.columns {
            text.push_str(&format!(" {column:>width$} "));
        }
        text.push('\n');
        for (name, row) in self.rows.iter().zip(cells.rows()) {
            text.push_str(&format!("{name:names$}"));
            for (words, paper) in row {
                // A missing value has no colour of the map, which would look like a value.
                if coloured && words != "–" {
                    let (RGBColor(r, g, b), RGBColor(pr, pg, pb)) = (text_on(*paper), paper);
                    text.push_str(&format!(
                        "\x1b[38;2;{r};{g};{b};48;2;{pr};{pg};{pb}m {words:>width$} \x1b[0m"
                    ));
                } else {
                    text.push_str(&format!(" {words:>width$} "));
                }
            }
            text.push('\n');
        }
        text
    }

    fn sizes(&self) -> Sizes {
        let values: Vec<String> = self
            .values
            .iter()
            .map(|&value| self.cell(value).0)
            .collect();
        let value = widest(values.iter().map(String::as_str), TICK_SIZE);
        // All columns are equally wide, so that colours compare by area.
        let name = widest(self.columns.iter().map(String::as_str), TICK_SIZE);
        let cell = value.max(name) + 16.0;
        let rows = widest(self.rows.iter().map(String::as_str), TICK_SIZE);
        let rows = rows.max(text_width(&self.row_label, LABEL_SIZE));
        let heads = room(&self.title, TITLE_SIZE) + room(&self.column_label, LABEL_SIZE);
        Sizes {
            cell,
            left: MARGIN + rows + 8.0,
            top: MARGIN + heads + TICK_SIZE + 8.0,
            width: cell * self.columns.len() as f64,
        }
    }
}

impl Drawing for HeatMap {
    fn check(&self) -> Result<(), FigureError> {
        let (rows, columns) = self.values.dim();
        let lengths = [
            ("names of rows", self.rows.len(), rows),
            ("names of columns", self.columns.len(), columns),
        ];
        match lengths
            .into_iter()
            .find(|(_, found, expected)| found != expected)
        {
            None => Ok(()),
            Some((what, found, expected)) => Err(FigureError::Lengths {
                figure: self.title.clone(),
                place: format!("{rows} × {columns} values"),
                what,
                found,
                expected,
            }),
        }
    }

    fn extent(&self) -> (f64, f64) {
        let sizes = self.sizes();
        let title = text_width(&self.heading(), TITLE_SIZE);
        (
            MARGIN + (sizes.left + sizes.width).max(MARGIN + title),
            sizes.top + ROW * self.rows.len() as f64 + MARGIN,
        )
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Drawn<B> {
        let sizes = self.sizes();
        let middle = 0.5 * self.extent().0;
        let at = (middle, MARGIN + 0.5 * TITLE_SIZE);
        write(canvas, &self.heading(), TITLE_SIZE, MIDDLE, at)?;
        let centre = sizes.left + 0.5 * sizes.width;
        let above = MARGIN + room(&self.title, TITLE_SIZE) + 0.5 * LABEL_SIZE;
        write(
            canvas,
            &self.column_label,
            LABEL_SIZE,
            MIDDLE,
            (centre, above),
        )?;
        let heads = (sizes.left - 7.0, sizes.top - 6.0 - 0.5 * LABEL_SIZE);
        write(canvas, &self.row_label, LABEL_SIZE, RIGHT, heads)?;
        for (k, name) in self.columns.iter().enumerate() {
            let x = sizes.left + (k as f64 + 0.5) * sizes.cell;
            let y = sizes.top - 6.0;
            write(canvas, name, TICK_SIZE, MIDDLE, (x, y - 0.5 * TICK_SIZE))?;
        }
        for (row, name) in self.rows.iter().enumerate() {
            let y = sizes.top + row as f64 * ROW;
            write(
                canvas,
                name,
                TICK_SIZE,
                RIGHT,
                (sizes.left - 7.0, y + 0.5 * ROW),
            )?;
            for (column, &value) in self.values.row(row).iter().enumerate() {
                let x = sizes.left + column as f64 * sizes.cell;
                let (words, colour) = self.cell(value);
                let corners = [
                    place((x + SEAM, y + SEAM)),
                    place((x + sizes.cell - SEAM, y + ROW - SEAM)),
                ];
                canvas.draw(&Rectangle::new(corners, colour.filled()))?;
                let ink = text_on(colour);
                let style = font(TICK_SIZE).color(&ink).pos(MIDDLE);
                let middle = y + 0.5 * ROW + TO_CENTRE * TICK_SIZE;
                write_in(
                    canvas,
                    &words,
                    &style,
                    place((x + 0.5 * sizes.cell, middle)),
                )?;
            }
        }
        Ok(())
    }
}
