//! Bars in groups: one group per category, one bar per variant.

use super::colour::{INK, series_colour};
use super::legend::{Entry, Legend, Sample};
use super::line::{Frame, draw_error_bar};
use super::scene::{Anchor, Scene, text_width};
use super::ticks::{Axis, Direction, Scale, shown};
use super::{Figure, FigureError, LABEL_SIZE, MARGIN, TICK_SIZE, TITLE_SIZE};

/// Radius of points with error bars.
const POINT: f64 = 3.2;

/// The bars of one variant, one per category.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BarGroup {
    /// Its name in the legend.
    pub label: String,
    /// The heights; a bar that is not finite is left out.
    pub values: Vec<f64>,
    /// Half the lengths of error bars, as many as in `values`.
    pub errors: Option<Vec<f64>>,
}

/// Bars side by side for each category, such as the quality factor of variants in each set.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BarPlot {
    /// Above the plot.
    pub title: String,
    /// Below the names of the categories.
    pub x_label: String,
    /// Beside the vertical axis, with the unit.
    pub y_label: String,
    /// Below the bars.
    pub categories: Vec<String>,
    /// The variants, each with a value per category.
    pub groups: Vec<BarGroup>,
}

impl BarPlot {
    fn check(&self) -> Result<(), FigureError> {
        for group in &self.groups {
            let expected = self.categories.len();
            let lengths = [
                ("values", group.values.len()),
                (
                    "error bars",
                    group.errors.as_ref().map_or(expected, Vec::len),
                ),
            ];
            for (what, found) in lengths {
                if found != expected {
                    return Err(FigureError::Lengths {
                        figure: self.title.clone(),
                        place: format!("group `{}`", group.label),
                        what,
                        found,
                        expected,
                    });
                }
            }
        }
        Ok(())
    }
}

impl Figure for BarPlot {
    #[allow(
        clippy::too_many_lines,
        reason = "the elements of a plot in drawing order"
    )]
    fn scene(&self) -> Result<Scene, FigureError> {
        self.check()?;
        let (categories, groups) = (self.categories.len().max(1), self.groups.len().max(1));
        let widest = self
            .categories
            .iter()
            .map(|name| text_width(name, TICK_SIZE))
            .fold(0.0, f64::max);
        // A category is as wide as its bars and the gap beside them, or as its name if the names
        // of all fit side by side.
        let bar = (600.0 / (categories * (groups + 1)) as f64).clamp(5.0, 34.0);
        let slot = bar * (groups as f64 + 0.8);
        let named = slot.max(widest + 12.0);
        let upright = named * categories as f64 > 720.0 && widest + 8.0 > slot;
        let slot = if upright { slot } else { named };
        let (width, height) = ((slot * categories as f64).max(300.0), 320.0);
        let slot = width / categories as f64;

        // Bars start at zero, which must be on the axis.
        let ends = self.groups.iter().flat_map(|group| {
            group
                .values
                .iter()
                .enumerate()
                .filter(|(_, value)| shown(**value, false))
                .flat_map(|(number, &value)| {
                    let error = group
                        .errors
                        .as_ref()
                        .map_or(0.0, |errors| errors[number].abs());
                    let error = if shown(error, false) { error } else { 0.0 };
                    [value - error, value + error]
                })
        });
        let (low, high) = ends.fold((0.0_f64, 0.0_f64), |(low, high), end| {
            (low.min(end), high.max(end))
        });
        let range = if low < high {
            (1.06 * low, 1.06 * high)
        } else {
            (0.0, 1.0)
        };
        let none = std::iter::empty();
        let axis = Axis::new(
            none,
            Some(range),
            Scale::Linear,
            height,
            TICK_SIZE,
            Direction::Up,
        );

        let names_height = if upright { widest } else { TICK_SIZE };
        let entries: Vec<Entry> = self
            .groups
            .iter()
            .enumerate()
            .filter(|(_, group)| !group.label.is_empty())
            .map(|(number, group)| Entry {
                label: group.label.clone(),
                colour: series_colour(number),
                sample: Sample::Box,
            })
            .collect();

        let label_room = if self.y_label.is_empty() {
            0.0
        } else {
            LABEL_SIZE + 6.0
        };
        let left = MARGIN + label_room + axis.label_width(TICK_SIZE) + 9.0;
        let total_width = left + width + MARGIN;
        let legend = Legend::new(&entries, total_width - 2.0 * MARGIN);
        let title_height = if self.title.is_empty() {
            0.0
        } else {
            TITLE_SIZE + 10.0
        };
        let factor_room = if axis.factor.is_some() {
            TICK_SIZE + 2.0
        } else {
            0.0
        };
        let top = MARGIN + title_height + legend.height() + 6.0 + factor_room;
        let frame = Frame {
            left,
            top,
            right: left + width,
            bottom: top + height,
        };
        let below = if self.x_label.is_empty() {
            0.0
        } else {
            LABEL_SIZE + 6.0
        };
        let names_end = frame.bottom + 10.0 + names_height;
        let mut scene = Scene::new(total_width, names_end + below + MARGIN);

        let middle = 0.5 * (frame.left + frame.right);
        scene.text(
            &self.title,
            (middle, MARGIN + TITLE_SIZE),
            TITLE_SIZE,
            INK,
            Anchor::Middle,
        );
        legend.draw(&mut scene, middle, MARGIN + title_height);
        frame.draw_vertical_axis(&mut scene, &axis);
        let label = (MARGIN + LABEL_SIZE, 0.5 * (frame.top + frame.bottom));
        scene.text_upwards(&self.y_label, label, LABEL_SIZE, INK, Anchor::Middle);
        let label = (middle, names_end + LABEL_SIZE);
        scene.text(&self.x_label, label, LABEL_SIZE, INK, Anchor::Middle);

        let up = |value: f64| frame.bottom - axis.fraction(value) * height;
        for (number, name) in self.categories.iter().enumerate() {
            let centre = frame.left + (number as f64 + 0.5) * slot;
            if upright {
                let baseline = (centre + 0.36 * TICK_SIZE, frame.bottom + 8.0);
                scene.text_upwards(name, baseline, TICK_SIZE, INK, Anchor::End);
            } else {
                let baseline = (centre, frame.bottom + 8.0 + TICK_SIZE);
                scene.text(name, baseline, TICK_SIZE, INK, Anchor::Middle);
            }
            let start = centre - 0.5 * bar * groups as f64;
            for (place, group) in self.groups.iter().enumerate() {
                let value = group.values[number];
                if !shown(value, false) {
                    continue;
                }
                let x = start + place as f64 * bar;
                let inset = 0.04 * bar;
                let colour = series_colour(place);
                let error = group.errors.as_ref().map(|errors| errors[number].abs());
                if let Some(error) = error.filter(|error| shown(*error, true)) {
                    // A value with an error is a point, because a column would hide half of the error.
                    let x = x + 0.5 * bar;
                    let (low, high) = ((x, up(value - error)), (x, up(value + error)));
                    draw_error_bar(&mut scene, frame, low, high, colour);
                    scene.disc((x, up(value)), POINT, colour);
                } else {
                    scene.rectangle((x + inset, up(value)), (x + bar - inset, up(0.0)), colour);
                }
            }
        }
        scene.path(
            vec![(frame.left, up(0.0)), (frame.right, up(0.0))],
            INK,
            1.0,
        );
        scene.frame(
            (frame.left, frame.top),
            (frame.right, frame.bottom),
            INK,
            1.0,
        );
        Ok(scene)
    }
}
