//! A table with its cells coloured by their values.

use ndarray::Array2;

use super::colour::{ColourMap, INK, MASKED, WHITE, text_on};
use super::image::{Limits, Stretch, draw_colour_bar};
use super::layout::{draw_label, draw_label_upwards, draw_title, label_room, title_room};
use super::scene::{Anchor, Scene, text_width};
use super::ticks::plain;
use super::{Figure, FigureError, LABEL_SIZE, MARGIN, TICK_SIZE, TITLE_SIZE};

/// A matrix of values with names of rows and columns, the first row on top.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HeatMap {
    /// Above the table.
    pub title: String,
    /// What the rows are.
    pub row_label: String,
    /// What the columns are.
    pub column_label: String,
    /// One name per row.
    pub rows: Vec<String>,
    /// One name per column.
    pub columns: Vec<String>,
    /// The values (row, column); those that are not finite are drawn as missing.
    pub values: Array2<f64>,
    /// How many decimals are written in the cells.
    pub decimals: usize,
    /// What the values are, beside the colour bar.
    pub value_label: String,
    /// The colours; a diverging map is centred on zero.
    pub map: ColourMap,
}

impl HeatMap {
    fn check(&self) -> Result<(), FigureError> {
        let (rows, columns) = self.values.dim();
        let lengths = [
            ("names of rows", self.rows.len(), rows),
            ("names of columns", self.columns.len(), columns),
        ];
        for (what, found, expected) in lengths {
            if found != expected {
                return Err(FigureError::Lengths {
                    figure: self.title.clone(),
                    place: format!("{rows} × {columns} values"),
                    what,
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }

    fn cell_text(&self, value: f64) -> String {
        if value.is_finite() {
            plain(value, self.decimals.min(12))
        } else {
            "–".into()
        }
    }
}

impl HeatMap {
    /// The table for a terminal, with coloured cells if it has colours.
    pub fn terminal(&self, coloured: bool) -> String {
        let texts = self.values.map(|&value| self.cell_text(value));
        let length = |text: &String| text.chars().count();
        let longest = |texts: &[String]| texts.iter().map(length).max().unwrap_or(0);
        let names = longest(&self.rows);
        let cell = texts
            .iter()
            .chain(&self.columns)
            .map(length)
            .max()
            .unwrap_or(0);
        let limits = Limits::of(self.values.iter().copied(), None, self.map);
        let mut text = format!("{} ({})\n{:names$}", self.title, self.value_label, "");
        for column in &self.columns {
            text.push_str(&format!(" {column:>cell$} "));
        }
        text.push('\n');
        for (row, name) in self.rows.iter().enumerate() {
            text.push_str(&format!("{name:names$}"));
            for (value, words) in self.values.row(row).iter().zip(texts.row(row)) {
                let position = limits.position(*value, Stretch::Linear);
                if coloured && !position.is_nan() {
                    let paper = self.map.colour(position);
                    let ([r, g, b], [pr, pg, pb]) = (text_on(paper), paper);
                    text.push_str(&format!(
                        "\x1b[38;2;{r};{g};{b};48;2;{pr};{pg};{pb}m {words:>cell$} \x1b[0m"
                    ));
                } else {
                    text.push_str(&format!(" {words:>cell$} "));
                }
            }
            text.push('\n');
        }
        text
    }
}

impl Figure for HeatMap {
    fn scene(&self) -> Result<Scene, FigureError> {
        self.check()?;
        let (rows, columns) = self.values.dim();
        let widest = |texts: &mut dyn Iterator<Item = String>| {
            texts
                .map(|text| text_width(&text, TICK_SIZE))
                .fold(0.0, f64::max)
        };
        let value_width = widest(&mut self.values.iter().map(|&value| self.cell_text(value)));
        let name_width = widest(&mut self.columns.iter().cloned());
        // Long names of columns run upwards, so that they do not make the cells wide.
        let upright = name_width > 2.0 * value_width.max(24.0);
        let cell_width = if upright {
            value_width
        } else {
            value_width.max(name_width)
        } + 16.0;
        let cell_height = 26.0;
        let names_height = if upright { name_width } else { TICK_SIZE };
        let (width, height) = (columns as f64 * cell_width, rows as f64 * cell_height);

        let left =
            MARGIN + label_room(&self.row_label) + widest(&mut self.rows.iter().cloned()) + 8.0;
        let title_height = title_room(&self.title);
        let top = MARGIN + title_height + label_room(&self.column_label) + names_height + 8.0;
        let limits = Limits::of(self.values.iter().copied(), None, self.map);
        let bar_top = top + height + 12.0;
        let bar_height = 10.0 + TICK_SIZE + label_room(&self.value_label);
        // A small table still needs room for its title and colour bar.
        let bar_width = width.clamp(160.0, 320.0);
        let wide = width
            .max(bar_width)
            .max(text_width(&self.title, TITLE_SIZE) - left + MARGIN);
        let mut scene = Scene::new(left + wide + MARGIN, bar_top + bar_height + MARGIN);

        let middle = left + 0.5 * width;
        let title_middle = middle.max(MARGIN + 0.5 * text_width(&self.title, TITLE_SIZE));
        draw_title(&mut scene, &self.title, title_middle);
        let baseline = (middle, MARGIN + title_height + LABEL_SIZE);
        draw_label(&mut scene, &self.column_label, baseline);
        let baseline = (MARGIN + LABEL_SIZE, top + 0.5 * height);
        draw_label_upwards(&mut scene, &self.row_label, baseline);
        for (column, name) in self.columns.iter().enumerate() {
            let x = left + (column as f64 + 0.5) * cell_width;
            if upright {
                let baseline = (x + 0.36 * TICK_SIZE, top - 6.0);
                scene.text_upwards(name, baseline, TICK_SIZE, INK, Anchor::Start);
            } else {
                scene.text(name, (x, top - 6.0), TICK_SIZE, INK, Anchor::Middle);
            }
        }
        for (row, name) in self.rows.iter().enumerate() {
            let y = top + (row as f64 + 0.5) * cell_height + 0.36 * TICK_SIZE;
            scene.text(name, (left - 7.0, y), TICK_SIZE, INK, Anchor::End);
        }
        for ((row, column), &value) in self.values.indexed_iter() {
            let position = limits.position(value, Stretch::Linear);
            let colour = if position.is_nan() {
                MASKED
            } else {
                self.map.colour(position)
            };
            let (x, y) = (
                left + column as f64 * cell_width,
                top + row as f64 * cell_height,
            );
            scene.rectangle((x, y), (x + cell_width, y + cell_height), colour);
            scene.frame((x, y), (x + cell_width, y + cell_height), WHITE, 1.0);
            let baseline = (
                x + 0.5 * cell_width,
                y + 0.5 * cell_height + 0.36 * TICK_SIZE,
            );
            let text = self.cell_text(value);
            scene.text(&text, baseline, TICK_SIZE, text_on(colour), Anchor::Middle);
        }
        let bar_left = left + 0.5 * (width - bar_width).max(0.0);
        draw_colour_bar(
            &mut scene,
            (bar_left, bar_top),
            bar_width,
            limits,
            self.map,
            Stretch::Linear,
        );
        let baseline = (bar_left + 0.5 * bar_width, bar_top + bar_height);
        draw_label(&mut scene, &self.value_label, baseline);
        Ok(scene)
    }
}
