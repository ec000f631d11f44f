//! Bars in groups: one group per category, one bar per variant.

use super::colour::{INK, series_colour};
use super::layout::{draw_label, draw_label_upwards, draw_title, label_room, title_room};
use super::legend::{Entry, Legend, Sample};
use super::line::{Frame, draw_error_bar};
use super::scene::{Anchor, Scene, text_width};
use super::ticks::{Axis, Direction, Scale, shown};
use super::{Figure, FigureError, LABEL_SIZE, MARGIN, TICK_SIZE};

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

/// The widths of bars and categories, and how the categories are named.
struct Slots {
    /// Width of a bar.
    bar: f64,
    /// Width of a category.
    slot: f64,
    /// Width of all categories.
    width: f64,
    /// Whether the names of categories run upwards.
    upright: bool,
    /// Height of the names.
    names_height: f64,
}

impl Slots {
    /// A category is as wide as its bars and the gap beside them, or as its name if the names of all fit side by side.
    fn of(plot: &BarPlot) -> Self {
        let (categories, groups) = (plot.categories.len().max(1), plot.groups.len().max(1));
        let names = plot.categories.iter();
        let widest = names
            .map(|name| text_width(name, TICK_SIZE))
            .fold(0.0, f64::max);
        let bar = (600.0 / (categories * (groups + 1)) as f64).clamp(5.0, 34.0);
        let slot = bar * (groups as f64 + 0.8);
        let named = slot.max(widest + 12.0);
        let upright = named * categories as f64 > 720.0 && widest + 8.0 > slot;
        let slot = if upright { slot } else { named };
        let width = (slot * categories as f64).max(300.0);
        Slots {
            bar,
            slot: width / categories as f64,
            width,
            upright,
            names_height: if upright { widest } else { TICK_SIZE },
        }
    }
}

impl BarPlot {
    /// The vertical axis. It contains zero, where bars start.
    fn axis(&self, height: f64) -> Axis {
        let ends = self.groups.iter().flat_map(|group| {
            let values = group.values.iter().enumerate();
            let values = values.filter(|(_, value)| shown(**value, false));
            values.flat_map(|(number, &value)| {
                let errors = group.errors.as_ref();
                let error = errors.map_or(0.0, |errors| errors[number].abs());
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
        Axis::new(
            none,
            Some(range),
            Scale::Linear,
            height,
            TICK_SIZE,
            Direction::Up,
        )
    }

    fn legend_entries(&self) -> Vec<Entry> {
        let groups = self.groups.iter().enumerate();
        groups
            .filter(|(_, group)| !group.label.is_empty())
            .map(|(number, group)| Entry {
                label: group.label.clone(),
                colour: series_colour(number),
                sample: Sample::Box,
            })
            .collect()
    }

    /// Draws the names of the categories and, for each group, a bar or a point per category.
    fn draw_categories(&self, scene: &mut Scene, frame: Frame, slots: &Slots, axis: &Axis) {
        let up = |value: f64| frame.bottom - axis.fraction(value) * (frame.bottom - frame.top);
        for (number, name) in self.categories.iter().enumerate() {
            let centre = frame.left + (number as f64 + 0.5) * slots.slot;
            if slots.upright {
                let baseline = (centre + 0.36 * TICK_SIZE, frame.bottom + 8.0);
                scene.text_upwards(name, baseline, TICK_SIZE, INK, Anchor::End);
            } else {
                let baseline = (centre, frame.bottom + 8.0 + TICK_SIZE);
                scene.text(name, baseline, TICK_SIZE, INK, Anchor::Middle);
            }
            let start = centre - 0.5 * slots.bar * self.groups.len().max(1) as f64;
            for (place, group) in self.groups.iter().enumerate() {
                let value = group.values[number];
                if !shown(value, false) {
                    continue;
                }
                let x = start + place as f64 * slots.bar;
                let inset = 0.04 * slots.bar;
                let colour = series_colour(place);
                let error = group.errors.as_ref().map(|errors| errors[number].abs());
                if let Some(error) = error.filter(|error| shown(*error, true)) {
                    // A value with an error is a point, because a column would hide half of the error.
                    let x = x + 0.5 * slots.bar;
                    let (low, high) = ((x, up(value - error)), (x, up(value + error)));
                    draw_error_bar(scene, frame, low, high, colour);
                    scene.disc((x, up(value)), POINT, colour);
                } else {
                    let corner = (x + slots.bar - inset, up(0.0));
                    scene.rectangle((x + inset, up(value)), corner, colour);
                }
            }
        }
        let zero = vec![(frame.left, up(0.0)), (frame.right, up(0.0))];
        scene.path(zero, INK, 1.0);
    }
}

impl Figure for BarPlot {
    fn scene(&self) -> Result<Scene, FigureError> {
        self.check()?;
        let slots = Slots::of(self);
        let height = 320.0;
        let axis = self.axis(height);

        let left = MARGIN + label_room(&self.y_label) + axis.label_width(TICK_SIZE) + 9.0;
        let total_width = left + slots.width + MARGIN;
        let entries = self.legend_entries();
        let legend = Legend::new(&entries, total_width - 2.0 * MARGIN);
        let factor_room = if axis.factor.is_some() {
            TICK_SIZE + 2.0
        } else {
            0.0
        };
        let title_height = title_room(&self.title);
        let top = MARGIN + title_height + legend.height() + 6.0 + factor_room;
        let frame = Frame {
            left,
            top,
            right: left + slots.width,
            bottom: top + height,
        };
        let names_end = frame.bottom + 10.0 + slots.names_height;
        let total_height = names_end + label_room(&self.x_label) + MARGIN;
        let mut scene = Scene::new(total_width, total_height);

        let middle = 0.5 * (frame.left + frame.right);
        draw_title(&mut scene, &self.title, middle);
        legend.draw(&mut scene, middle, MARGIN + title_height);
        frame.draw_vertical_axis(&mut scene, &axis);
        let beside = (MARGIN + LABEL_SIZE, 0.5 * (frame.top + frame.bottom));
        draw_label_upwards(&mut scene, &self.y_label, beside);
        draw_label(&mut scene, &self.x_label, (middle, names_end + LABEL_SIZE));
        self.draw_categories(&mut scene, frame, &slots, &axis);
        frame.draw_outline(&mut scene);
        Ok(scene)
    }
}
