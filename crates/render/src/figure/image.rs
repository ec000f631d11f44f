//! Images side by side, pixel by pixel.

use ndarray::Array2;

use super::colour::{ColourMap, INK};
use super::scene::{Anchor, Point, Scene, text_width};
use super::ticks::{short, shown};
use super::{Figure, FigureError, LABEL_SIZE, MARGIN, TITLE_SIZE};

/// The em of the numbers at colour bars.
const NUMBER_SIZE: f64 = 9.5;
/// From line to line of a row's label.
const LABEL_LINE: f64 = LABEL_SIZE + 4.0;
const BAR_HEIGHT: f64 = 7.0;
/// The longer side of an image, in points.
const SIDE: f64 = 144.0;

/// How values between the ends of the scale are spread over the colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Stretch {
    /// Evenly.
    #[default]
    Linear,
    /// By asinh, which shows faint wings beside a bright centre: evenly up to a tenth of the scale,
    /// logarithmically beyond.
    Asinh,
}

/// Over which images the colour scale is common.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Scale {
    /// Every image has its own.
    #[default]
    Own,
    /// The images of a row share one.
    Row,
    /// The images of a column share one.
    Column,
}

/// One image.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImagePanel {
    /// Above the image.
    pub title: String,
    /// The values (row, column), with row 0 at the bottom; NaN marks masked pixels.
    pub image: Array2<f64>,
    /// The colours; a diverging map is centred on zero.
    pub map: ColourMap,
    /// How values are spread over the colours.
    pub stretch: Stretch,
    /// The ends of the colour scale, instead of those from the values.
    pub limits: Option<(f64, f64)>,
}

/// Images side by side.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageRow {
    /// Beside the row; its lines are side by side.
    pub label: String,
    /// The images, from left to right.
    pub panels: Vec<ImagePanel>,
}

/// Rows of images, such as the steps from a stamp to its autocorrelation for several galaxies.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageGrid {
    /// Above all rows.
    pub title: String,
    /// The rows, from the top.
    pub rows: Vec<ImageRow>,
    /// Which images share a colour scale.
    pub scale: Scale,
}

/// The ends of a colour scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Limits {
    low: f64,
    high: f64,
}

impl Limits {
    /// The limits `given`, or else those of the finite ones among `values`; around zero for a
    /// diverging map. They are NaN if there are no values.
    pub(super) fn of(
        values: impl Iterator<Item = f64>,
        given: Option<(f64, f64)>,
        map: ColourMap,
    ) -> Self {
        let given = given.filter(|(low, high)| low.is_finite() && high.is_finite() && low < high);
        let (low, high) = given.unwrap_or_else(|| {
            values
                .filter(|value| shown(*value, false))
                .fold((f64::NAN, f64::NAN), |(low, high), value| {
                    (low.min(value), high.max(value))
                })
        });
        if map == ColourMap::Diverging && given.is_none() {
            let reach = low.abs().max(high.abs());
            return Self {
                low: -reach,
                high: reach,
            };
        }
        Self { low, high }
    }

    /// Where `value` is on the colours: 0 to 1 between the ends, NaN if it is not finite.
    pub(super) fn position(self, value: f64, stretch: Stretch) -> f64 {
        if !value.is_finite() {
            return f64::NAN;
        }
        let span = self.high - self.low;
        // All values are equal: the middle of the map.
        let even = if span > 0.0 {
            (value - self.low) / span
        } else {
            0.5
        };
        match stretch {
            Stretch::Linear => even,
            Stretch::Asinh if self.low == -self.high => {
                let out = 2.0 * even - 1.0;
                0.5 + 0.5 * (10.0 * out).asinh() / 10.0_f64.asinh()
            }
            Stretch::Asinh => (10.0 * even.clamp(0.0, 1.0)).asinh() / 10.0_f64.asinh(),
        }
    }

    /// The value at `position`, the inverse of [`Limits::position`].
    fn value(self, position: f64, stretch: Stretch) -> f64 {
        let unstretched = |stretched: f64| (stretched * 10.0_f64.asinh()).sinh() / 10.0;
        let even = match stretch {
            Stretch::Linear => position,
            Stretch::Asinh if self.low == -self.high => {
                0.5 + 0.5 * unstretched(2.0 * position - 1.0)
            }
            Stretch::Asinh => unstretched(position),
        };
        self.low + even * (self.high - self.low)
    }
}

/// A horizontal colour bar with the values at its ends and, where there is room, at its middle.
pub(super) fn draw_colour_bar(
    scene: &mut Scene,
    (left, top): Point,
    width: f64,
    limits: Limits,
    map: ColourMap,
    stretch: Stretch,
) {
    if !(limits.low.is_finite() && limits.high.is_finite()) {
        return;
    }
    let steps = 96;
    for step in 0..steps {
        let at = |step: i32| left + width * f64::from(step) / f64::from(steps);
        let colour = map.colour((f64::from(step) + 0.5) / f64::from(steps));
        scene.rectangle((at(step), top), (at(step + 1), top + BAR_HEIGHT), colour);
    }
    scene.frame((left, top), (left + width, top + BAR_HEIGHT), INK, 0.75);
    let baseline = top + BAR_HEIGHT + NUMBER_SIZE + 2.0;
    // What is nothing beside the scale reads as zero.
    let span = limits.high - limits.low;
    let number = |value: f64| {
        short(if value.abs() < 2e-3 * span {
            0.0
        } else {
            value
        })
    };
    let (low, high) = (number(limits.low), number(limits.high));
    let middle = number(limits.value(0.5, stretch));
    let taken = [&low, &middle, &high].map(|text| text_width(text, NUMBER_SIZE));
    scene.text(&low, (left, baseline), NUMBER_SIZE, INK, Anchor::Start);
    scene.text(
        &high,
        (left + width, baseline),
        NUMBER_SIZE,
        INK,
        Anchor::End,
    );
    if taken[1] + 2.0 * taken[0].max(taken[2]) + 16.0 < width && limits.low < limits.high {
        scene.text(
            &middle,
            (left + 0.5 * width, baseline),
            NUMBER_SIZE,
            INK,
            Anchor::Middle,
        );
    }
}

impl ImageGrid {
    /// The colour scale of one panel.
    fn limits(&self, row: usize, column: usize) -> Limits {
        let panel = &self.rows[row].panels[column];
        let sharing: Vec<&ImagePanel> = match self.scale {
            Scale::Own => vec![panel],
            Scale::Row => self.rows[row].panels.iter().collect(),
            Scale::Column => self
                .rows
                .iter()
                .filter_map(|row| row.panels.get(column))
                .collect(),
        };
        let values = sharing
            .into_iter()
            .flat_map(|panel| panel.image.iter().copied());
        Limits::of(values, panel.limits, panel.map)
    }
}

impl Figure for ImageGrid {
    fn scene(&self) -> Result<Scene, FigureError> {
        let columns = self
            .rows
            .iter()
            .map(|row| row.panels.len())
            .max()
            .unwrap_or(0);
        let gap = MARGIN + 6.0;
        let cell_width = SIDE + gap;
        let label_lines = self.rows.iter().map(|row| row.label.lines().count());
        let label_room = match label_lines.max().unwrap_or(0) {
            0 => 0.0,
            lines => lines as f64 * LABEL_LINE + 4.0,
        };
        let title_height = if self.title.is_empty() {
            0.0
        } else {
            TITLE_SIZE + 10.0
        };
        let bar_room = 5.0 + BAR_HEIGHT + NUMBER_SIZE + 4.0;
        let above = |row: &ImageRow| match row.panels.iter().any(|panel| !panel.title.is_empty()) {
            true => LABEL_SIZE + 6.0,
            false => 0.0,
        };
        let left = MARGIN + label_room;
        let heights = self
            .rows
            .iter()
            .map(|row| above(row) + SIDE + bar_room + 8.0);
        let panels_width = (columns as f64 * cell_width - gap).max(0.0);
        let title_width = text_width(&self.title, TITLE_SIZE);
        let mut scene = Scene::new(
            left + panels_width.max(title_width) + MARGIN,
            MARGIN + title_height + heights.sum::<f64>() + 4.0,
        );
        let middle = left + 0.5 * panels_width.max(title_width);
        scene.text(
            &self.title,
            (middle, MARGIN + TITLE_SIZE),
            TITLE_SIZE,
            INK,
            Anchor::Middle,
        );

        let mut top = MARGIN + title_height;
        for (number, row) in self.rows.iter().enumerate() {
            top += above(row);
            for (line, text) in row.label.lines().enumerate() {
                let x = MARGIN + LABEL_SIZE + line as f64 * LABEL_LINE;
                let baseline = (x, top + 0.5 * SIDE);
                scene.text_upwards(text, baseline, LABEL_SIZE, INK, Anchor::Middle);
            }
            for (column, panel) in row.panels.iter().enumerate() {
                let corner = (left + column as f64 * cell_width, top);
                draw_panel(&mut scene, panel, self.limits(number, column), corner);
            }
            top += SIDE + bar_room + 8.0;
        }
        Ok(scene)
    }
}

/// Draws one image into a square, with its title above and its colour bar below.
fn draw_panel(scene: &mut Scene, panel: &ImagePanel, limits: Limits, (left, top): Point) {
    let centre = left + 0.5 * SIDE;
    scene.text(
        &panel.title,
        (centre, top - 5.0),
        LABEL_SIZE,
        INK,
        Anchor::Middle,
    );
    let (rows, columns) = panel.image.dim();
    if rows == 0 || columns == 0 {
        let middle = (centre, top + 0.5 * SIDE);
        scene.text(
            "no data",
            middle,
            LABEL_SIZE,
            [120, 120, 120],
            Anchor::Middle,
        );
        scene.frame((left, top), (left + SIDE, top + SIDE), INK, 0.75);
        return;
    }
    let pixel = SIDE / rows.max(columns) as f64;
    let (width, height) = (pixel * columns as f64, pixel * rows as f64);
    let (x0, y0) = (left + 0.5 * (SIDE - width), top + 0.5 * (SIDE + height));
    for (row, values) in panel.image.rows().into_iter().enumerate() {
        let (bottom, top) = (y0 - row as f64 * pixel, y0 - (row + 1) as f64 * pixel);
        // Neighbours of one colour are drawn as one rectangle, which keeps SVG files small.
        let mut start = 0;
        let colours: Vec<_> = values
            .iter()
            .map(|&value| panel.map.colour(limits.position(value, panel.stretch)))
            .collect();
        for end in 1..=columns {
            if end == columns || colours[end] != colours[start] {
                let (from, to) = (x0 + start as f64 * pixel, x0 + end as f64 * pixel);
                scene.rectangle((from, bottom), (to, top), colours[start]);
                start = end;
            }
        }
    }
    scene.frame((x0, y0), (x0 + width, y0 - height), INK, 0.75);
    draw_colour_bar(
        scene,
        (left, top + SIDE + 5.0),
        SIDE,
        limits,
        panel.map,
        panel.stretch,
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_and_values_are_inverse() {
        for limits in [
            Limits {
                low: -1.0,
                high: 3.0,
            },
            Limits {
                low: -2.0,
                high: 2.0,
            },
        ] {
            for stretch in [Stretch::Linear, Stretch::Asinh] {
                for position in [0.0, 0.2, 0.5, 0.9, 1.0] {
                    let back = limits.position(limits.value(position, stretch), stretch);
                    assert!(
                        (back - position).abs() < 1e-12,
                        "{limits:?} {stretch:?} {position}"
                    );
                }
            }
        }
    }

    #[test]
    fn limits_leave_out_what_is_not_finite() {
        let values = [f64::NAN, 2.0, f64::INFINITY, -1.0];
        let limits = |map| Limits::of(values.into_iter(), None, map);
        assert_eq!(
            limits(ColourMap::Grey),
            Limits {
                low: -1.0,
                high: 2.0
            }
        );
        assert_eq!(
            limits(ColourMap::Diverging),
            Limits {
                low: -2.0,
                high: 2.0
            }
        );
        assert!(
            limits(ColourMap::Grey)
                .position(f64::NAN, Stretch::Linear)
                .is_nan()
        );
        let none = Limits::of(std::iter::empty(), None, ColourMap::Grey);
        assert!(none.low.is_nan());
    }
}
