//! Curves and points with errors over common axes, in one panel or in many.

use plotters::backend::DrawingBackend;
use plotters::chart::{ChartBuilder, LabelAreaPosition};
use plotters::element::{Circle, DashedPathElement, Polygon, Rectangle};
use plotters::style::{Color, RGBColor, TRANSPARENT};

use super::axis::{Axis, Scale, shown};
use super::canvas::{
    Canvas, Drawn, Figure, INK, LABEL_SIZE, LEFT, LINE, MARGIN, MIDDLE, TICK_SIZE, TITLE_SIZE,
    TO_CENTRE, font, frame, line, place, room, text_width, units, widest, write,
};
use super::colour::{GREY, series_colour};

// Width of curves and of error bars, and radius of points, in points.
const CURVE: f64 = 1.75;
const ERROR: f64 = 1.0;
const POINT: f64 = 3.0;
// Half the width of the cap of an error bar.
const CAP: f64 = 2.5;
// Length of ticks and of minor ticks.
const TICK: f64 = 4.0;
const MINOR: f64 = 2.5;
// Height of a row of a legend, and the width of a sample in it with and without space.
const ENTRY: f64 = 18.0;
const SAMPLE: f64 = 24.0;
const SAMPLE_ROOM: f64 = 30.0;
// Opacity and least width of bands.
const BAND: f64 = 0.3;
const THINNEST: f64 = 3.0;
const GRID: RGBColor = RGBColor(228, 228, 228);

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Style {
    #[default]
    Line,
    /// A disc, square or triangle at each point, by its colour, without a line.
    Points,
    Dashed,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    pub x: f64,
    pub y: f64,
    /// Half the length of its error bar.
    pub y_error: f64,
}

impl Point {
    // The ends of the error bar; the point itself if it has no error.
    fn bar(&self) -> (f64, f64) {
        let half = match self.y_error.abs() {
            half if shown(half, false) => half,
            _ => 0.0,
        };
        (self.y - half, self.y + half)
    }
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct Series {
    /// Its name in the legend; without one it does not appear there.
    pub label: String,
    pub points: Vec<Point>,
    pub style: Style,
    /// Which colour of the palette of eight; the last is grey.
    pub colour: usize,
}

impl Series {
    pub fn new(label: &str, x: Vec<f64>, y: Vec<f64>, style: Style, colour: usize) -> Self {
        debug_assert_eq!(x.len(), y.len(), "points of {label}");
        let points = x.into_iter().zip(y);
        let y_error = 0.0;
        Self {
            label: label.into(),
            points: points.map(|(x, y)| Point { x, y, y_error }).collect(),
            style,
            colour,
        }
    }

    /// The same series with error bars of half the length `y_errors`.
    pub fn with_errors(mut self, y_errors: Vec<f64>) -> Self {
        debug_assert_eq!(
            self.points.len(),
            y_errors.len(),
            "errors of {}",
            self.label
        );
        for (point, y_error) in self.points.iter_mut().zip(y_errors) {
            point.y_error = y_error;
        }
        self
    }
}

/// A range of y over the whole width, such as that which a requirement allows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Band {
    pub label: String,
    pub low: f64,
    pub high: f64,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct LinePlot {
    pub title: String,
    pub x_label: String,
    pub y_label: String,
    pub x_log: bool,
    /// Whether the horizontal axis has whole numbers, such as sets.
    pub x_whole: bool,
    /// Names at x = 0, 1, … instead of numbers. They stand below each other, and x runs down and y across, so that
    /// long names are read without turning the head.
    pub x_names: Vec<String>,
    pub y_log: bool,
    /// The ends of the horizontal axis; `None` to take them from the data.
    pub x_range: Option<(f64, f64)>,
    pub bands: Vec<Band>,
    /// What is drawn, the last on top.
    pub series: Vec<Series>,
}

// What stands for a series in a legend.
#[derive(PartialEq, Clone, Copy)]
enum Sample {
    Series(Style, usize),
    Band,
}

impl LinePlot {
    fn is_turned(&self) -> bool {
        !self.x_names.is_empty()
    }

    // What belongs to x and to y as what belongs across and upwards, and back.
    fn turned<T>(&self, [x, y]: [T; 2]) -> [T; 2] {
        if self.is_turned() { [y, x] } else { [x, y] }
    }

    // The points that can be shown.
    fn points(&self) -> impl Iterator<Item = &Point> {
        let all = self.series.iter().flat_map(|series| &series.points);
        all.filter(|point| self.shows(point))
    }

    fn shows(&self, point: &Point) -> bool {
        shown(point.x, self.x_log) && shown(point.y, self.y_log)
    }

    // The axes across and upwards of a frame of this size.
    fn axes(&self, (width, height): (f64, f64)) -> [Axis; 2] {
        let x = self.points().map(|point| point.x);
        let y = self.points().flat_map(|point| {
            let (low, high) = point.bar();
            // On a logarithmic axis a bar down to zero has no end: it must not stretch the axis.
            let end = if self.y_log { 0.3 * point.y } else { low };
            [low.max(end), high]
        });
        let y = y.chain(self.bands.iter().flat_map(|band| [band.low, band.high]));
        let [x_scale, y_scale] = [self.x_log, self.y_log].map(|log| match log {
            true => Scale::Logarithmic,
            false => Scale::Linear,
        });
        let x_scale = match (self.is_turned(), self.x_whole) {
            (true, _) => Scale::Names(&self.x_names),
            (_, true) => Scale::Whole,
            _ => x_scale,
        };
        let [x_length, y_length] = self.turned([width, height]);
        self.turned([
            Axis::new(x, self.x_range, x_scale, x_length, self.is_turned()),
            Axis::new(y, None, y_scale, y_length, !self.is_turned()),
        ])
    }

    fn labels(&self) -> [&str; 2] {
        self.turned([&self.x_label, &self.y_label])
    }

    fn legend(&self) -> impl Iterator<Item = (&str, Sample)> {
        let series = self.series.iter();
        let series = series.map(|s| (s.label.as_str(), Sample::Series(s.style, s.colour)));
        let bands = self
            .bands
            .iter()
            .map(|band| (band.label.as_str(), Sample::Band));
        series.chain(bands)
    }

    // Draws axes and series into a frame of this size. `labels` across and upwards take the room given, as numbers do.
    fn draw_in<B: DrawingBackend>(
        &self,
        canvas: &Canvas<B>,
        corner: (f64, f64),
        size: (f64, f64),
        labels: [&str; 2],
        rooms: [f64; 2],
    ) -> Drawn<B> {
        let end = (corner.0 + size.0, corner.1 + size.1);
        let [across, up] = self.axes(size);
        let (width, height) = place((size.0 + rooms[1], size.1 + rooms[0]));
        let outer = place((corner.0 - rooms[1], corner.1));
        let area = canvas.clone().shrink(outer, (width as u32, height as u32));
        let mut chart = ChartBuilder::on(&area)
            .set_label_area_size(LabelAreaPosition::Bottom, units(rooms[0]))
            .set_label_area_size(LabelAreaPosition::Left, units(rooms[1]))
            .build_cartesian_2d(&across, &up)?;
        let [x_desc, y_desc] = labels.map(crate::escape::line);
        chart
            .configure_mesh()
            .x_desc(x_desc)
            .y_desc(y_desc)
            .axis_desc_style(font(LABEL_SIZE))
            .label_style(font(TICK_SIZE))
            .y_label_offset(units(TO_CENTRE * TICK_SIZE))
            .set_all_tick_mark_size(units(TICK))
            .axis_style(INK.stroke_width(units(LINE) as u32))
            .bold_line_style(GRID.stroke_width(units(0.75) as u32))
            .light_line_style(TRANSPARENT)
            .draw()?;
        let [x, y] = self.turned([&across, &up]);
        let at = |x: f64, y: f64| chart.backend_coord(&self.turned([x, y]).into());
        for band in &self.bands {
            let ends = [(x.low, band.low), (x.high, band.high)];
            let [(x0, y0), (x1, y1)] = ends.map(|(x, end)| at(x, y.clamped(end)));
            // A band that is narrow on this axis must differ from a line of the grid.
            let wider = |a: i32, b: i32| (units(THINNEST) - (b - a).abs()).max(0) / 2;
            let (dx, dy) = (wider(x0, x1), wider(y0, y1));
            let corners = [(x0 - dx, y0 + dy), (x1 + dx, y1 - dy)];
            canvas.draw(&Rectangle::new(corners, GREY.mix(BAND).filled()))?;
        }
        let mut empty = true;
        for series in &self.series {
            // None where nothing can be shown, which interrupts a line.
            let places = series.points.iter().map(|point| {
                let (px, py) = (x.at(point.x), y.at(point.y));
                let seen = self.shows(point) && x.contains(px) && y.contains(py);
                seen.then(|| at(px, py))
            });
            let places: Vec<_> = places.collect();
            empty &= places.iter().all(Option::is_none);
            let colour = series_colour(series.colour);
            for (point, _) in series
                .points
                .iter()
                .zip(&places)
                .filter(|(_, at)| at.is_some())
            {
                let (low, high) = point.bar();
                if high > low {
                    let ends = [low, high].map(|end| at(x.at(point.x), y.clamped(end)));
                    draw_error(canvas, ends, colour)?;
                }
            }
            draw_series(canvas, &places, series.style, series.colour)?;
        }
        for (axis, horizontal) in [(&across, true), (&up, false)] {
            for &value in &axis.minor {
                let (from, inwards) = match horizontal {
                    true => (chart.backend_coord(&(value, up.low)), (0, -units(MINOR))),
                    false => (chart.backend_coord(&(across.low, value)), (units(MINOR), 0)),
                };
                let to = (from.0 + inwards.0, from.1 + inwards.1);
                line(canvas, vec![from, to], INK, 0.75)?;
            }
        }
        if empty {
            let middle = (0.5 * (corner.0 + end.0), 0.5 * (corner.1 + end.1));
            write(canvas, "no data", LABEL_SIZE, MIDDLE, middle)?;
        }
        frame(canvas, corner, end)
    }
}

fn draw_error<B: DrawingBackend>(
    canvas: &Canvas<B>,
    ends: [(i32, i32); 2],
    colour: RGBColor,
) -> Drawn<B> {
    line(canvas, ends.to_vec(), colour, ERROR)?;
    let (dx, dy) = match ends[0].0 == ends[1].0 {
        true => (units(CAP), 0),
        false => (0, units(CAP)),
    };
    for (x, y) in ends {
        line(
            canvas,
            vec![(x - dx, y - dy), (x + dx, y + dy)],
            colour,
            ERROR,
        )?;
    }
    Ok(())
}

// Points, or the lines through those that follow each other.
fn draw_series<B: DrawingBackend>(
    canvas: &Canvas<B>,
    points: &[Option<(i32, i32)>],
    style: Style,
    colour: usize,
) -> Drawn<B> {
    let number = colour;
    let colour = series_colour(colour);
    for run in points.split(Option::is_none) {
        let run: Vec<(i32, i32)> = run.iter().copied().flatten().collect();
        match (style, run.as_slice()) {
            (_, []) => {}
            (Style::Line, [_, _, ..]) => line(canvas, run, colour, CURVE)?,
            (Style::Dashed, [_, _, ..]) => {
                let stroke = colour.stroke_width(units(CURVE) as u32);
                let [dash, gap] = [7.0, 4.0].map(units);
                canvas.draw(&DashedPathElement::new(run, dash, gap, stroke))?;
            }
            // A point between missing ones has no line to show it.
            (_, run) => {
                for &(x, y) in run {
                    let r = units(POINT);
                    match number % 3 {
                        0 => canvas.draw(&Circle::new((x, y), r, colour.filled()))?,
                        1 => {
                            let r = r - units(0.3);
                            let corners = [(x - r, y - r), (x + r, y + r)];
                            canvas.draw(&Rectangle::new(corners, colour.filled()))?;
                        }
                        _ => {
                            let corners = vec![(x - r, y + r), (x + r, y + r), (x, y - r - 1)];
                            canvas.draw(&Polygon::new(corners, colour.filled()))?;
                        }
                    }
                }
            }
        }
    }
    Ok(())
}

impl Figure for LinePlot {
    fn extent(&self) -> (f64, f64) {
        PanelGrid::from(self).extent()
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Drawn<B> {
        PanelGrid::from(self).draw(canvas)
    }
}

/// Several plots in rows, with one legend.
///
/// Where all plots have the same label at an axis, it is written at the left column and the bottom
/// row only.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PanelGrid {
    pub title: String,
    pub columns: usize,
    pub plots: Vec<LinePlot>,
}

impl From<&LinePlot> for PanelGrid {
    fn from(plot: &LinePlot) -> Self {
        PanelGrid {
            title: plot.title.clone(),
            columns: 1,
            plots: vec![LinePlot {
                title: String::new(),
                ..plot.clone()
            }],
        }
    }
}

struct Layout<'a> {
    columns: usize,
    frame: (f64, f64),
    // Space of the numbers below and to the left of a frame, and of its labels.
    numbers: [f64; 2],
    labels: [f64; 2],
    // Whether all plots have the same label across, upwards.
    common: [bool; 2],
    step: (f64, f64),
    first: (f64, f64),
    extent: (f64, f64),
    legend: Vec<Vec<(&'a str, Sample)>>,
}

impl PanelGrid {
    fn layout(&self) -> Layout<'_> {
        let plots = &self.plots;
        let columns = self.columns.clamp(1, plots.len().max(1));
        let rows = plots.len().div_ceil(columns).max(1) as f64;
        // A column of a report is 760 points wide: panels fill it, so that it shrinks no letter below those of captions.
        let (width, height) = match columns {
            1 => (450.0, 280.0),
            2 => (300.0, 200.0),
            3 => (230.0, 160.0),
            _ => (170.0, 125.0),
        };
        // Named rows need no more space than their names.
        let named = plots
            .iter()
            .map(|plot| 26.0 * plot.x_names.len() as f64 + 14.0);
        let turned = plots.iter().all(LinePlot::is_turned) && !plots.is_empty();
        let height = if turned {
            named.fold(60.0, f64::max)
        } else {
            height
        };
        let frame = (width, height);
        let axes: Vec<[Axis; 2]> = plots.iter().map(|plot| plot.axes(frame)).collect();
        let texts = axes
            .iter()
            .flat_map(|[_, up]| &up.ticks)
            .map(|tick| tick.1.as_str());
        let beside = widest(texts, TICK_SIZE) + 2.0 * TICK + 2.0;
        let numbers = [TICK_SIZE + 2.0 * TICK, beside];
        let label = |k: usize| plots.iter().map(move |plot| plot.labels()[k]);
        let common = [0, 1].map(|k| {
            let mut pairs = label(k).zip(label(k).skip(1));
            pairs.all(|(a, b)| a == b)
        });
        let labels = [0, 1].map(|k| label(k).map(|l| room(l, LABEL_SIZE)).fold(0.0, f64::max));
        let own = [0, 1].map(|k| if common[k] { 0.0 } else { labels[k] });
        let titled = plots.iter().any(|plot| !plot.title.is_empty());
        let above = if titled { LABEL_SIZE + 10.0 } else { 8.0 };
        // Half of the last number of an axis stands outside.
        let step = (
            width + numbers[1] + own[1] + MARGIN,
            height + numbers[0] + own[0] + above,
        );
        let left = MARGIN + labels[1] + numbers[1];
        let extent_x = left + step.0 * (columns - 1) as f64 + width + 1.5 * MARGIN;
        let legend = self.legend(extent_x - 2.0 * MARGIN);
        let heads = room(&self.title, TITLE_SIZE) + ENTRY * legend.len() as f64;
        let top = MARGIN + heads + above;
        let extent_y = top + step.1 * (rows - 1.0) + height + numbers[0] + labels[0] + 0.5 * MARGIN;
        Layout {
            columns,
            frame,
            numbers,
            labels,
            common,
            step,
            first: (left, top),
            extent: (extent_x, extent_y),
            legend,
        }
    }

    // The entries that have a label, each once, in rows of at most `width`.
    fn legend(&self, width: f64) -> Vec<Vec<(&str, Sample)>> {
        let mut entries: Vec<(&str, Sample)> = Vec::new();
        for entry in self.plots.iter().flat_map(LinePlot::legend) {
            if !entry.0.is_empty() && !entries.contains(&entry) {
                entries.push(entry);
            }
        }
        let mut rows: Vec<Vec<(&str, Sample)>> = Vec::new();
        let mut used = f64::INFINITY;
        for entry in entries {
            let needed = entry_width(entry.0);
            if used + needed > width {
                rows.push(Vec::new());
                used = 0.0;
            }
            used += needed;
            rows.last_mut().into_iter().for_each(|row| row.push(entry));
        }
        rows
    }
}

// Width of an entry of a legend with the space after it.
fn entry_width(label: &str) -> f64 {
    SAMPLE_ROOM + text_width(label, LABEL_SIZE) + 1.5 * MARGIN
}

impl Figure for PanelGrid {
    fn extent(&self) -> (f64, f64) {
        self.layout().extent
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Drawn<B> {
        let layout = self.layout();
        let middle = 0.5 * (layout.first.0 + layout.extent.0 - 1.5 * MARGIN);
        let mut y = MARGIN + 0.5 * TITLE_SIZE;
        write(canvas, &self.title, TITLE_SIZE, MIDDLE, (middle, y))?;
        y = MARGIN + room(&self.title, TITLE_SIZE) + 0.5 * ENTRY;
        for row in &layout.legend {
            let width: f64 = row.iter().map(|(label, _)| entry_width(label)).sum();
            let mut x = middle - 0.5 * (width - 1.5 * MARGIN);
            for &(label, sample) in row {
                let ends = [x, x + SAMPLE].map(|x| place((x, y)));
                let centre = place((x + 0.5 * SAMPLE, y));
                match sample {
                    Sample::Series(Style::Points, colour) => {
                        draw_series(canvas, &[Some(centre)], Style::Points, colour)?;
                    }
                    Sample::Series(style, colour) => {
                        draw_series(canvas, &ends.map(Some), style, colour)?;
                    }
                    Sample::Band => {
                        let corners = [
                            (ends[0].0, centre.1 - units(5.0)),
                            (ends[1].0, centre.1 + units(5.0)),
                        ];
                        canvas.draw(&Rectangle::new(corners, GREY.mix(BAND).filled()))?;
                    }
                }
                write(canvas, label, LABEL_SIZE, LEFT, (x + SAMPLE_ROOM, y))?;
                x += entry_width(label);
            }
            y += ENTRY;
        }
        for (number, plot) in self.plots.iter().enumerate() {
            let (row, column) = (number / layout.columns, number % layout.columns);
            let corner = (
                layout.first.0 + column as f64 * layout.step.0,
                layout.first.1 + row as f64 * layout.step.1,
            );
            let above = (corner.0 + 0.5 * layout.frame.0, corner.1 - 9.0);
            write(canvas, &plot.title, LABEL_SIZE, MIDDLE, above)?;
            // The last plot of each column carries the label, also above a gap in the last row.
            let labelled = [
                !layout.common[0] || number + layout.columns >= self.plots.len(),
                !layout.common[1] || column == 0,
            ];
            let [x_label, y_label] = plot.labels();
            let label = |k: usize, text| if labelled[k] { text } else { "" };
            let rooms = [0, 1]
                .map(|k| layout.numbers[k] + if labelled[k] { layout.labels[k] } else { 0.0 });
            let labels = [label(0, x_label), label(1, y_label)];
            plot.draw_in(canvas, corner, layout.frame, labels, rooms)?;
        }
        Ok(())
    }
}
