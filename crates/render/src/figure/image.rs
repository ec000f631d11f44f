//! Images side by side, pixel by pixel.

use ndarray::Array2;
use plotters::backend::DrawingBackend;
use plotters::element::Rectangle;
use plotters::style::Color;

use super::axis::short;
use super::canvas::{
    Canvas, Drawn, Figure, LABEL_SIZE, LEFT, MARGIN, MIDDLE, RIGHT, TITLE_SIZE, frame, place, room,
    text_width, write,
};
use super::colour::{ColourMap, position};

// The em of the numbers at colour bars.
const NUMBER_SIZE: f64 = 9.5;
// Height of a colour bar, its distance from the image, and the height of both with the numbers.
const BAR: f64 = 7.0;
const BAR_GAP: f64 = 5.0;
const BAR_ROOM: f64 = 30.0;
// The longer side of an image, in points.
const IMAGE_SIDE_PX: f64 = 144.0;
const GAP: f64 = 18.0;

/// How values between the ends of the scale are spread over the colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Stretch {
    #[default]
    Linear,
    /// By asinh, which shows faint wings of a bright centre: evenly up to a tenth of the scale,
    /// logarithmically beyond.
    Asinh,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImagePanel {
    pub title: String,
    /// The values (row, column), with row 0 at the bottom; NaN marks masked pixels.
    pub image: Array2<f64>,
    pub map: ColourMap,
    pub stretch: Stretch,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageRow {
    pub label: String,
    pub panels: Vec<ImagePanel>,
}

/// Rows of images, such as the steps from a stamp to its autocorrelation for several galaxies.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ImageGrid {
    pub title: String,
    pub rows: Vec<ImageRow>,
}

impl ImageGrid {
    fn width(&self) -> f64 {
        let most = self.rows.iter().map(|row| row.panels.len()).max();
        let panels = (IMAGE_SIDE_PX + GAP) * most.unwrap_or(0) as f64 - GAP;
        // Texts above the rows, not beside them: the numbers of a galaxy are longer than an image is high.
        let labels = self
            .rows
            .iter()
            .map(|row| text_width(&row.label, LABEL_SIZE));
        labels.fold(panels.max(text_width(&self.title, TITLE_SIZE)), f64::max)
    }
}

impl Figure for ImageGrid {
    fn extent(&self) -> (f64, f64) {
        let rows = self
            .rows
            .iter()
            .map(|row| room(&row.label, LABEL_SIZE) + LABEL_SIZE + 6.0 + IMAGE_SIDE_PX + BAR_ROOM);
        (
            2.0 * MARGIN + self.width(),
            2.0 * MARGIN + room(&self.title, TITLE_SIZE) + rows.sum::<f64>(),
        )
    }

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Drawn<B> {
        let mut top = MARGIN;
        let at = (MARGIN + 0.5 * self.width(), top + 0.5 * TITLE_SIZE);
        write(canvas, &self.title, TITLE_SIZE, MIDDLE, at)?;
        top += room(&self.title, TITLE_SIZE);
        for row in &self.rows {
            let above = (MARGIN, top + 0.5 * LABEL_SIZE);
            write(canvas, &row.label, LABEL_SIZE, LEFT, above)?;
            top += room(&row.label, LABEL_SIZE) + LABEL_SIZE + 6.0;
            for (k, panel) in row.panels.iter().enumerate() {
                draw_panel(
                    canvas,
                    panel,
                    (MARGIN + k as f64 * (IMAGE_SIDE_PX + GAP), top),
                )?;
            }
            top += IMAGE_SIDE_PX + BAR_ROOM;
        }
        Ok(())
    }
}

// Draws one image into a square, with its title above and its colour bar below.
fn draw_panel<B: DrawingBackend>(
    canvas: &Canvas<B>,
    panel: &ImagePanel,
    (left, top): (f64, f64),
) -> Drawn<B> {
    let centre = left + 0.5 * IMAGE_SIDE_PX;
    write(
        canvas,
        &panel.title,
        LABEL_SIZE,
        MIDDLE,
        (centre, top - 9.0),
    )?;
    let (rows, columns) = panel.image.dim();
    if rows == 0 || columns == 0 {
        return frame(
            canvas,
            (left, top),
            (left + IMAGE_SIDE_PX, top + IMAGE_SIDE_PX),
        );
    }
    let pixel = IMAGE_SIDE_PX / rows.max(columns) as f64;
    let (width, height) = (pixel * columns as f64, pixel * rows as f64);
    let x = left + 0.5 * (IMAGE_SIDE_PX - width);
    let bottom = top + 0.5 * (IMAGE_SIDE_PX + height);
    let limits = panel.map.limits(panel.image.iter());
    for (row, values) in panel.image.rows().into_iter().enumerate() {
        let y = |row: usize| bottom - row as f64 * pixel;
        let colours: Vec<_> = values
            .iter()
            .map(|&value| {
                let at = position(value, limits);
                panel.map.colour(match panel.stretch {
                    Stretch::Linear => at,
                    Stretch::Asinh => (10.0 * at).asinh() / 10_f64.asinh(),
                })
            })
            .collect();
        // Neighbours of one colour are one rectangle, which keeps SVG files small.
        let mut start = 0;
        for run in colours.chunk_by(|a, b| a == b) {
            let end = start + run.len();
            let from = place((x + start as f64 * pixel, y(row + 1)));
            let to = place((x + end as f64 * pixel, y(row)));
            canvas.draw(&Rectangle::new([from, to], run[0].filled()))?;
            start = end;
        }
    }
    frame(canvas, (x, bottom - height), (x + width, bottom))?;

    let top = top + IMAGE_SIDE_PX + BAR_GAP;
    const COLOUR_BAR_STEPS: usize = 96;
    for step in 0..COLOUR_BAR_STEPS {
        let at = |step: usize| left + IMAGE_SIDE_PX * step as f64 / COLOUR_BAR_STEPS as f64;
        let colour = panel
            .map
            .colour((step as f64 + 0.5) / COLOUR_BAR_STEPS as f64);
        let corners = [place((at(step), top)), place((at(step + 1), top + BAR))];
        canvas.draw(&Rectangle::new(corners, colour.filled()))?;
    }
    frame(canvas, (left, top), (left + IMAGE_SIDE_PX, top + BAR))?;
    let below = top + BAR + 0.5 * NUMBER_SIZE + 4.0;
    for (value, anchor, x) in [
        (limits.0, LEFT, left),
        (limits.1, RIGHT, left + IMAGE_SIDE_PX),
    ] {
        if value.is_finite() {
            // Limits below 1/500 of the scale are printed as zero.
            let none = value.abs() < 2e-3 * (limits.1 - limits.0);
            let text = short(if none { 0.0 } else { value });
            write(canvas, &text, NUMBER_SIZE, anchor, (x, below))?;
        }
    }
    Ok(())
}
