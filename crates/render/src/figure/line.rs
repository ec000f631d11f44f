//! Curves and points over a common axis, in one panel or in many.

use super::colour::{GRID, INK, Rgb, series_colour};
use super::layout::{draw_label, draw_label_upwards, draw_title, label_room, title_room};
use super::legend::{Entry, Legend, Sample};
use super::scene::{Anchor, Point, Scene};
use super::style::Style;
use super::ticks::{Axis, Direction, Scale, TINIEST, shown};
use super::{Figure, FigureError, LABEL_SIZE, MARGIN, TICK_SIZE};

/// One curve or set of points.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Series {
    /// Its name in the legend; without one it does not appear there.
    pub label: String,
    /// Where the points are across.
    pub x: Vec<f64>,
    /// Where they are up, as many as in `x`.
    pub y: Vec<f64>,
    /// Half the length of an error bar at each point, as many as in `x`.
    pub y_err: Option<Vec<f64>>,
    /// Line or points.
    pub style: Style,
    /// Which colour of the palette of eight.
    pub colour: usize,
}

impl Series {
    /// A series without error bars.
    pub fn new(label: &str, x: Vec<f64>, y: Vec<f64>, style: Style, colour: usize) -> Self {
        Self {
            label: label.into(),
            x,
            y,
            y_err: None,
            style,
            colour,
        }
    }

    /// The same series with error bars of half the length `y_err`.
    pub fn with_errors(self, y_err: Vec<f64>) -> Self {
        Self {
            y_err: Some(y_err),
            ..self
        }
    }

    fn check(&self, figure: &str) -> Result<(), FigureError> {
        let lengths = [
            ("values of y", self.y.len()),
            (
                "error bars",
                self.y_err.as_ref().map_or(self.x.len(), Vec::len),
            ),
        ];
        for (what, found) in lengths {
            if found != self.x.len() {
                return Err(FigureError::Lengths {
                    figure: figure.into(),
                    place: format!("series `{}`", self.label),
                    what,
                    found,
                    expected: self.x.len(),
                });
            }
        }
        Ok(())
    }

    /// The ends of the error bar at a point, or the point itself where there is none.
    fn bar(&self, point: usize) -> (f64, f64) {
        let half = self
            .y_err
            .as_ref()
            .map_or(0.0, |errors| errors[point].abs());
        let half = if shown(half, false) { half } else { 0.0 };
        (self.y[point] - half, self.y[point] + half)
    }
}

/// Series over common axes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LinePlot {
    /// Above the plot.
    pub title: String,
    /// Below the horizontal axis, with the unit.
    pub x_label: String,
    /// Beside the vertical axis, with the unit.
    pub y_label: String,
    /// Whether the horizontal axis is logarithmic.
    pub x_log: bool,
    /// Whether the horizontal axis is of whole numbers, as those of sets.
    pub x_whole: bool,
    /// Whether the vertical axis is logarithmic.
    pub y_log: bool,
    /// The ends of the horizontal axis; from the data if there are none.
    pub x_range: Option<(f64, f64)>,
    /// The ends of the vertical axis; from the data if there are none.
    pub y_range: Option<(f64, f64)>,
    /// What is drawn, the last on top.
    pub series: Vec<Series>,
}

impl LinePlot {
    fn check(&self) -> Result<(), FigureError> {
        self.series
            .iter()
            .try_for_each(|series| series.check(&self.title))
    }

    /// The axes for a plot of this size inside its frame.
    fn axes(&self, width: f64, height: f64) -> (Axis, Axis) {
        let points = || {
            self.series.iter().flat_map(|series| {
                (0..series.x.len())
                    .filter(|&i| shown(series.x[i], self.x_log) && shown(series.y[i], self.y_log))
                    .map(move |i| (series, i))
            })
        };
        let x = points().map(|(series, i)| series.x[i]);
        // On a logarithmic axis a bar down to zero has no end: it must not stretch the axis.
        let y = points().flat_map(|(series, i)| {
            let (low, high) = series.bar(i);
            let low = if self.y_log {
                low.max(0.3 * series.y[i])
            } else {
                low
            };
            [low, high]
        });
        (
            Axis::new(
                x,
                self.x_range,
                match self.x_whole {
                    true => Scale::Whole,
                    false => Scale::log(self.x_log),
                },
                width,
                TICK_SIZE,
                Direction::Across,
            ),
            Axis::new(
                y,
                self.y_range,
                Scale::log(self.y_log),
                height,
                TICK_SIZE,
                Direction::Up,
            ),
        )
    }

    fn legend_entries(&self) -> impl Iterator<Item = Entry> {
        self.series.iter().map(|series| Entry {
            label: series.label.clone(),
            colour: series_colour(series.colour),
            sample: Sample::Curve(series.style),
        })
    }
}

/// The inside of the axes of one plot.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
}

impl Frame {
    /// Draws the outline.
    pub(super) fn draw_outline(self, scene: &mut Scene) {
        let corners = ((self.left, self.top), (self.right, self.bottom));
        scene.frame(corners.0, corners.1, INK, 1.0);
    }

    pub(super) fn width(&self) -> f64 {
        self.right - self.left
    }

    pub(super) fn height(&self) -> f64 {
        self.bottom - self.top
    }

    fn place(&self, x: &Axis, y: &Axis, (at, up): Point) -> Point {
        (
            self.left + x.fraction(at) * self.width(),
            self.bottom - y.fraction(up) * self.height(),
        )
    }

    fn contains(&self, (x, y): Point) -> bool {
        (self.left - 0.5..=self.right + 0.5).contains(&x)
            && (self.top - 0.5..=self.bottom + 0.5).contains(&y)
    }

    /// The part of a straight line inside, by the method of Liang and Barsky.
    fn clip(&self, from: Point, to: Point) -> Option<(Point, Point)> {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        let (mut start, mut end) = (0.0_f64, 1.0_f64);
        let sides = [
            (-dx, from.0 - self.left),
            (dx, self.right - from.0),
            (-dy, from.1 - self.top),
            (dy, self.bottom - from.1),
        ];
        for (direction, distance) in sides {
            if direction == 0.0 {
                if distance < 0.0 {
                    return None;
                }
            } else if direction < 0.0 {
                start = start.max(distance / direction);
            } else {
                end = end.min(distance / direction);
            }
        }
        let at = |along: f64| (from.0 + along * dx, from.1 + along * dy);
        (start <= end).then(|| (at(start), at(end)))
    }

    /// The vertical axis with its grid lines, numbers and factor.
    pub(super) fn draw_vertical_axis(&self, scene: &mut Scene, axis: &Axis) {
        let height = |value: f64| self.bottom - axis.fraction(value) * self.height();
        for tick in &axis.ticks {
            let y = height(tick.value);
            scene.path(vec![(self.left, y), (self.right, y)], GRID, 0.75);
            scene.path(vec![(self.left - 4.0, y), (self.left, y)], INK, 1.0);
            let baseline = (self.left - 7.0, y + 0.36 * TICK_SIZE);
            scene.text(&tick.label, baseline, TICK_SIZE, INK, Anchor::End);
        }
        for y in axis.minor.iter().map(|&value| height(value)) {
            scene.path(vec![(self.left - 2.0, y), (self.left, y)], INK, 0.75);
        }
        if let Some(factor) = &axis.factor {
            let baseline = (self.left, self.top - 4.0);
            scene.text(factor, baseline, TICK_SIZE, INK, Anchor::Start);
        }
    }

    fn draw_horizontal_axis(&self, scene: &mut Scene, axis: &Axis) {
        let across = |value: f64| self.left + axis.fraction(value) * self.width();
        for tick in &axis.ticks {
            let x = across(tick.value);
            scene.path(vec![(x, self.top), (x, self.bottom)], GRID, 0.75);
            scene.path(vec![(x, self.bottom), (x, self.bottom + 4.0)], INK, 1.0);
            let baseline = (x, self.bottom + 6.0 + TICK_SIZE);
            scene.text(&tick.label, baseline, TICK_SIZE, INK, Anchor::Middle);
        }
        for x in axis.minor.iter().map(|&value| across(value)) {
            scene.path(vec![(x, self.bottom), (x, self.bottom + 2.0)], INK, 0.75);
        }
        if let Some(factor) = &axis.factor {
            let baseline = (self.right + 4.0, self.bottom + 3.0);
            scene.text(factor, baseline, TICK_SIZE, INK, Anchor::Start);
        }
    }
}

/// Draws axes and series into the frame, without labels and title.
fn draw_plot(scene: &mut Scene, plot: &LinePlot, frame: Frame) {
    let (x_axis, y_axis) = plot.axes(frame.width(), frame.height());
    frame.draw_horizontal_axis(scene, &x_axis);
    frame.draw_vertical_axis(scene, &y_axis);
    let mut empty = true;
    for series in &plot.series {
        let colour = series_colour(series.colour);
        let place = |x, y| frame.place(&x_axis, &y_axis, (x, y));
        let visible = |i: usize| shown(series.x[i], plot.x_log) && shown(series.y[i], plot.y_log);
        let points: Vec<Option<Point>> = (0..series.x.len())
            .map(|i| visible(i).then(|| place(series.x[i], series.y[i])))
            .collect();
        empty &= points.iter().all(Option::is_none);
        if series.y_err.is_some() {
            for i in (0..points.len()).filter(|&i| points[i].is_some()) {
                let (low, high) = series.bar(i);
                // A bar that reaches zero or below runs off a logarithmic axis.
                let low = if plot.y_log { low.max(TINIEST) } else { low };
                draw_error_bar(
                    scene,
                    frame,
                    place(series.x[i], low),
                    place(series.x[i], high),
                    colour,
                );
            }
        }
        match series.style {
            Style::Points => {
                for point in points
                    .into_iter()
                    .flatten()
                    .filter(|&point| frame.contains(point))
                {
                    scene.disc(point, 2.7, colour);
                }
            }
            Style::Line | Style::Dashed => {
                // A point between missing ones has no line to show it.
                let at = |number: Option<usize>| number.and_then(|i| *points.get(i)?);
                for (i, point) in points.iter().enumerate() {
                    let alone = at(i.checked_sub(1)).is_none() && at(Some(i + 1)).is_none();
                    if let Some(point) = point.filter(|&point| alone && frame.contains(point)) {
                        scene.disc(point, 1.8, colour);
                    }
                }
                for run in runs(&points, frame) {
                    match series.style {
                        Style::Dashed => scene.dashes(&run, colour, 1.8),
                        _ => scene.path(run, colour, 1.8),
                    }
                }
            }
        }
    }
    if empty {
        let middle = (
            0.5 * (frame.left + frame.right),
            0.5 * (frame.top + frame.bottom),
        );
        scene.text(
            "no data",
            middle,
            LABEL_SIZE,
            [120, 120, 120],
            Anchor::Middle,
        );
    }
    frame.draw_outline(scene);
}

/// An error bar with caps where its ends are inside the frame.
pub(super) fn draw_error_bar(
    scene: &mut Scene,
    frame: Frame,
    low: Point,
    high: Point,
    colour: Rgb,
) {
    let Some((from, to)) = frame.clip(low, high) else {
        return;
    };
    scene.path(vec![from, to], colour, 1.1);
    for end in [low, high].into_iter().filter(|&end| frame.contains(end)) {
        scene.path(
            vec![(end.0 - 2.5, end.1), (end.0 + 2.5, end.1)],
            colour,
            1.1,
        );
    }
}

/// The connected parts of a line that are inside the frame; missing points break it.
fn runs(points: &[Option<Point>], frame: Frame) -> Vec<Vec<Point>> {
    let mut runs: Vec<Vec<Point>> = Vec::new();
    for pair in points.windows(2) {
        let (Some(from), Some(to)) = (pair[0], pair[1]) else {
            continue;
        };
        let Some((from, to)) = frame.clip(from, to) else {
            continue;
        };
        match runs.last_mut() {
            Some(run) if run.last() == Some(&from) => run.push(to),
            _ => runs.push(vec![from, to]),
        }
    }
    runs
}

impl Figure for LinePlot {
    fn scene(&self) -> Result<Scene, FigureError> {
        PanelGrid {
            title: String::new(),
            columns: 1,
            plots: vec![self.clone()],
        }
        .scene()
    }
}

/// Several plots in rows, with one legend.
///
/// Where all plots have the same label at an axis, it is written at the left column and the bottom
/// row only.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PanelGrid {
    /// Above all plots.
    pub title: String,
    /// How many plots are in a row.
    pub columns: usize,
    /// The plots, by rows.
    pub plots: Vec<LinePlot>,
}

/// Sizes of a [`PanelGrid`], in points.
struct Cells {
    columns: usize,
    /// Sides of a frame.
    frame: (f64, f64),
    /// Space left and right of a frame, for numbers.
    left: f64,
    right: f64,
    /// Space above a frame, for its title, and below it, for numbers.
    above: f64,
    below: f64,
    /// Space of the numbers on the vertical axes.
    tick_room: f64,
    /// Whether all plots have the same labels: of x, of y.
    common: (bool, bool),
    /// Space of the labels that all plots have in common: beside all and below all.
    outer: (f64, f64),
}

impl Cells {
    fn of(grid: &PanelGrid) -> Self {
        let plots = &grid.plots;
        let columns = grid.columns.clamp(1, plots.len().max(1));
        let (width, height) = match columns {
            1 => (600.0, 370.0),
            2 => (380.0, 250.0),
            3 => (280.0, 190.0),
            _ => (205.0, 150.0),
        };
        let common = |label: fn(&LinePlot) -> &str| {
            let mut pairs = plots.windows(2);
            pairs.all(|pair| label(&pair[0]) == label(&pair[1]))
        };
        let common = (common(|plot| &plot.x_label), common(|plot| &plot.y_label));
        let room = |label: fn(&LinePlot) -> &str| {
            let rooms = plots.iter().map(|plot| label_room(label(plot)));
            rooms.fold(0.0, f64::max)
        };
        let (x_room, y_room) = (room(|plot| &plot.x_label), room(|plot| &plot.y_label));
        let axes: Vec<(Axis, Axis)> = plots.iter().map(|plot| plot.axes(width, height)).collect();
        let numbers = axes.iter().map(|(_, y)| y.label_width(TICK_SIZE));
        let tick_room = numbers.fold(0.0, f64::max) + 9.0;
        let factor_across = axes.iter().any(|(x, _)| x.factor.is_some());
        let factor_up = axes.iter().any(|(_, y)| y.factor.is_some());
        let titled = plots.len() != 1 && plots.iter().any(|plot| !plot.title.is_empty());
        let title = if titled { LABEL_SIZE + 10.0 } else { 6.0 };
        let factor = if factor_up { TICK_SIZE + 2.0 } else { 0.0 };
        Cells {
            columns,
            frame: (width, height),
            left: tick_room + if common.1 { 0.0 } else { y_room },
            right: if factor_across { 42.0 } else { 10.0 },
            above: title + factor,
            below: TICK_SIZE + 10.0 + if common.0 { 0.0 } else { x_room },
            tick_room,
            common,
            outer: (
                if common.1 { y_room } else { 0.0 },
                if common.0 { x_room } else { 0.0 },
            ),
        }
    }

    /// Width and height of a frame with the space around it.
    fn cell(&self) -> (f64, f64) {
        let (width, height) = self.frame;
        (
            self.left + width + self.right,
            self.above + height + self.below,
        )
    }

    /// The frame of plot `number` of a grid whose corner is `origin`.
    fn frame(&self, number: usize, origin: Point) -> Frame {
        let (row, column) = (number / self.columns, number % self.columns);
        let (cell_width, cell_height) = self.cell();
        let left = origin.0 + column as f64 * cell_width + self.left;
        let top = origin.1 + row as f64 * cell_height + self.above;
        Frame {
            left,
            top,
            right: left + self.frame.0,
            bottom: top + self.frame.1,
        }
    }
}

impl PanelGrid {
    fn legend_entries(&self) -> Vec<Entry> {
        let mut entries: Vec<Entry> = Vec::new();
        for entry in self.plots.iter().flat_map(LinePlot::legend_entries) {
            if !entries.contains(&entry) {
                entries.push(entry);
            }
        }
        entries
    }

    /// The title above all plots; a single plot's own title is there too.
    fn whole_title(&self) -> &str {
        match self.plots.as_slice() {
            [only] if self.title.is_empty() => &only.title,
            _ => &self.title,
        }
    }

    /// Draws a plot with its title and labels.
    fn draw_panel(&self, scene: &mut Scene, number: usize, cells: &Cells, frame: Frame) {
        let plot = &self.plots[number];
        draw_plot(scene, plot, frame);
        let centre = (
            0.5 * (frame.left + frame.right),
            0.5 * (frame.top + frame.bottom),
        );
        if self.plots.len() != 1 {
            draw_label(scene, &plot.title, (centre.0, frame.top - 6.0));
        }
        // The last plot of each column carries the label, also above a gap in the last row.
        if !cells.common.0 || number + cells.columns >= self.plots.len() {
            let baseline = (centre.0, frame.bottom + TICK_SIZE + 10.0 + LABEL_SIZE);
            draw_label(scene, &plot.x_label, baseline);
        }
        if !cells.common.1 || number.is_multiple_of(cells.columns) {
            let baseline = (frame.left - cells.tick_room - 4.0, centre.1);
            draw_label_upwards(scene, &plot.y_label, baseline);
        }
    }
}

impl Figure for PanelGrid {
    fn scene(&self) -> Result<Scene, FigureError> {
        self.plots.iter().try_for_each(LinePlot::check)?;
        let cells = Cells::of(self);
        let rows = self.plots.len().div_ceil(cells.columns).max(1);
        let (cell_width, cell_height) = cells.cell();
        let grid_width = cells.columns as f64 * cell_width;
        let origin_x = MARGIN + cells.outer.0;
        let total_width = origin_x + grid_width + 0.5 * MARGIN;
        let entries = self.legend_entries();
        let legend = Legend::new(&entries, total_width - 2.0 * MARGIN);
        let title = self.whole_title();
        let title_height = title_room(title);
        let origin_y = MARGIN + title_height + legend.height();
        let bottom_room = cells.outer.1 + 0.5 * MARGIN;
        let total_height = origin_y + rows as f64 * cell_height + bottom_room;

        let mut scene = Scene::new(total_width, total_height);
        let middle = origin_x + 0.5 * (grid_width + cells.left - cells.right);
        draw_title(&mut scene, title, middle);
        legend.draw(&mut scene, middle, MARGIN + title_height);
        for number in 0..self.plots.len() {
            let frame = cells.frame(number, (origin_x, origin_y));
            self.draw_panel(&mut scene, number, &cells, frame);
        }
        Ok(scene)
    }
}
