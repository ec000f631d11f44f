//! A drawing as a list of shapes, and its rendering by plotters.
//!
//! Figures describe themselves in points, as real numbers; plotters' backends take whole pixels.
//! A scene is therefore drawn several times larger: an SVG keeps the larger grid behind its nominal
//! size, and a PNG is averaged down, which smooths edges.

use plotters::backend::{BitMapBackend, DrawingBackend, SVGBackend};
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{
    FontDesc, FontFamily, FontStyle, FontTransform, RGBColor, ShapeStyle, TextStyle,
};

use super::FigureError;
use super::colour::{Rgb, WHITE};
use crate::report::escape::line;
use crate::report::font;

/// Backend pixels per point.
const SCALE: u32 = 4;
/// Backend pixels averaged into one pixel of a PNG, per side: it has two pixels per point.
const AVERAGED: u32 = 2;
/// The largest scene in square points, for which drawing takes about a gigabyte.
const LARGEST: f64 = 2e7;

/// A place in points: x to the right, y downwards.
pub(super) type Point = (f64, f64);

/// Which part of a text is at its given place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

#[derive(Debug, Clone)]
enum Shape {
    Path {
        points: Vec<Point>,
        colour: Rgb,
        width: f64,
    },
    Rectangle {
        corner: Point,
        opposite: Point,
        colour: Rgb,
    },
    Disc {
        centre: Point,
        radius: f64,
        colour: Rgb,
    },
    Text {
        baseline: Point,
        text: String,
        size: f64,
        colour: Rgb,
        anchor: Anchor,
        upwards: bool,
    },
}

/// A drawing of a given size, on white.
#[derive(Debug, Clone)]
pub struct Scene {
    width: f64,
    height: f64,
    shapes: Vec<Shape>,
}

impl Scene {
    /// An empty drawing of this size in points.
    pub(super) fn new(width: f64, height: f64) -> Self {
        Self {
            width: width.max(1.0),
            height: height.max(1.0),
            shapes: Vec::new(),
        }
    }

    /// A line through `points`.
    pub(super) fn path(&mut self, points: Vec<Point>, colour: Rgb, width: f64) {
        self.shapes.push(Shape::Path {
            points,
            colour,
            width,
        });
    }

    /// A line through `points` in dashes of four widths, which run on around corners.
    pub(super) fn dashes(&mut self, points: &[Point], colour: Rgb, width: f64) {
        let (dash, period) = (4.0 * width, 6.5 * width);
        let mut walked = 0.0;
        for pair in points.windows(2) {
            let ((x0, y0), (x1, y1)) = (pair[0], pair[1]);
            let length = (x1 - x0).hypot(y1 - y0);
            let at = |along: f64| {
                (
                    x0 + (x1 - x0) * along / length,
                    y0 + (y1 - y0) * along / length,
                )
            };
            let mut start = -(walked % period);
            while start < length && length > 0.0 {
                let (from, to) = (start.max(0.0), (start + dash).min(length));
                if to > from {
                    self.path(vec![at(from), at(to)], colour, width);
                }
                start += period;
            }
            walked += length;
        }
    }

    /// A filled rectangle.
    pub(super) fn rectangle(&mut self, corner: Point, opposite: Point, colour: Rgb) {
        self.shapes.push(Shape::Rectangle {
            corner,
            opposite,
            colour,
        });
    }

    /// The outline of a rectangle.
    pub(super) fn frame(&mut self, (x0, y0): Point, (x1, y1): Point, colour: Rgb, width: f64) {
        let corners = vec![(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)];
        self.path(corners, colour, width);
    }

    /// A filled circle.
    pub(super) fn disc(&mut self, centre: Point, radius: f64, colour: Rgb) {
        self.shapes.push(Shape::Disc {
            centre,
            radius,
            colour,
        });
    }

    /// A line of text; `size` is the font's em, and `baseline` is where `anchor` is on its baseline.
    pub(super) fn text(
        &mut self,
        text: &str,
        baseline: Point,
        size: f64,
        colour: Rgb,
        anchor: Anchor,
    ) {
        self.add_text(text, baseline, size, colour, anchor, false);
    }

    /// A line of text that runs upwards.
    pub(super) fn text_upwards(
        &mut self,
        text: &str,
        baseline: Point,
        size: f64,
        colour: Rgb,
        anchor: Anchor,
    ) {
        self.add_text(text, baseline, size, colour, anchor, true);
    }

    fn add_text(
        &mut self,
        text: &str,
        baseline: Point,
        size: f64,
        colour: Rgb,
        anchor: Anchor,
        upwards: bool,
    ) {
        if !text.is_empty() {
            let text = line(text);
            self.shapes.push(Shape::Text {
                baseline,
                text,
                size,
                colour,
                anchor,
                upwards,
            });
        }
    }

    /// The scene as an SVG file.
    pub(super) fn to_svg(&self) -> Result<String, FigureError> {
        let (width, height) = self.pixels()?;
        let mut svg = String::new();
        {
            let mut backend = SVGBackend::with_string(&mut svg, (width, height));
            self.draw(&mut backend, TextRules::SVG)?;
            backend.present().map_err(drawing)?;
        }
        // The nominal size is that in points; the view box keeps the finer grid.
        let fine = format!("width=\"{width}\" height=\"{height}\"");
        let nominal = format!("width=\"{}\" height=\"{}\"", width / SCALE, height / SCALE);
        let svg = svg.replacen(&fine, &nominal, 1);
        // Smoothed edges would show as seams between the rectangles that are pixels of an image.
        Ok(svg.replacen('>', "><style>rect{shape-rendering:crispEdges}</style>", 1))
    }

    /// The scene as red, green and blue of each pixel by rows, with the width and height.
    pub(super) fn to_pixels(&self) -> Result<(Vec<u8>, (u32, u32)), FigureError> {
        let (width, height) = self.pixels()?;
        let mut fine = vec![255; width as usize * height as usize * 3];
        {
            let mut backend = BitMapBackend::with_buffer(&mut fine, (width, height));
            self.draw(&mut backend, TextRules::BITMAP)?;
            backend.present().map_err(drawing)?;
        }
        let size = (width / AVERAGED, height / AVERAGED);
        let row_length = width as usize * 3;
        let mut pixels = Vec::with_capacity(size.0 as usize * size.1 as usize * 3);
        for rows in fine.chunks_exact(row_length * AVERAGED as usize) {
            for column in 0..size.0 as usize {
                for channel in 0..3 {
                    let mut sum = 0_u32;
                    for row in rows.chunks_exact(row_length) {
                        for part in 0..AVERAGED as usize {
                            sum +=
                                u32::from(row[(column * AVERAGED as usize + part) * 3 + channel]);
                        }
                    }
                    pixels.push((sum / (AVERAGED * AVERAGED)) as u8);
                }
            }
        }
        Ok((pixels, size))
    }

    /// The size of the backend.
    fn pixels(&self) -> Result<(u32, u32), FigureError> {
        if self.width * self.height > LARGEST {
            return Err(FigureError::TooLarge {
                width: self.width,
                height: self.height,
                largest: LARGEST,
            });
        }
        Ok((
            self.width.ceil() as u32 * SCALE,
            self.height.ceil() as u32 * SCALE,
        ))
    }

    fn draw<B: DrawingBackend>(
        &self,
        backend: &mut B,
        rules: TextRules,
    ) -> Result<(), FigureError> {
        if !font::register() {
            return Err(FigureError::Drawing {
                detail: "the built-in font is unusable".into(),
            });
        }
        let size = backend.get_size();
        backend
            .draw_rect(
                (0, 0),
                (size.0 as i32, size.1 as i32),
                &style(WHITE, 1),
                true,
            )
            .map_err(drawing)?;
        for shape in &self.shapes {
            draw_shape(backend, shape, rules)?;
        }
        Ok(())
    }
}

/// How a backend places and sizes text, in ems of what is asked of it.
#[derive(Debug, Clone, Copy)]
struct TextRules {
    /// The size to ask for.
    size: f64,
    /// How far the baseline comes to lie below the place given.
    baseline: f64,
    /// Whether thick lines need discs at their corners, to be round.
    corners: bool,
}

impl TextRules {
    /// Glyphs are sized by the line height, and their baseline is half of it below.
    const BITMAP: Self = Self {
        size: font::LINE_PER_EM,
        baseline: 0.5 * font::LINE_PER_EM,
        corners: true,
    };
    /// The backend divides the size by 1.24 and writes `dy="0.76em"`.
    const SVG: Self = Self {
        size: 1.24,
        baseline: 0.76,
        corners: false,
    };
}

fn draw_shape<B: DrawingBackend>(
    backend: &mut B,
    shape: &Shape,
    rules: TextRules,
) -> Result<(), FigureError> {
    match shape {
        Shape::Path {
            points,
            colour,
            width,
        } => {
            let width = (width * f64::from(SCALE)).round().max(1.0) as u32;
            let style = style(*colour, width);
            if !rules.corners {
                return backend
                    .draw_path(points.iter().copied().map(pixel), &style)
                    .map_err(drawing);
            }
            for pair in points.windows(2) {
                let (from, to) = (pixel(pair[0]), pixel(pair[1]));
                if from != to {
                    backend.draw_path([from, to], &style).map_err(drawing)?;
                }
            }
            for corner in points.iter().skip(1).take(points.len().saturating_sub(2)) {
                if width > 2 {
                    backend
                        .draw_circle(pixel(*corner), width / 2, &style, true)
                        .map_err(drawing)?;
                }
            }
        }
        Shape::Rectangle {
            corner,
            opposite,
            colour,
        } => {
            let (from, to) = (pixel(*corner), pixel(*opposite));
            let (left, right) = (from.0.min(to.0), from.0.max(to.0));
            let (top, bottom) = (from.1.min(to.1), from.1.max(to.1));
            backend
                .draw_rect((left, top), (right, bottom), &style(*colour, 1), true)
                .map_err(drawing)?;
        }
        Shape::Disc {
            centre,
            radius,
            colour,
        } => {
            let radius = (radius * f64::from(SCALE)).round() as u32;
            backend
                .draw_circle(pixel(*centre), radius, &style(*colour, 1), true)
                .map_err(drawing)?;
        }
        Shape::Text {
            baseline,
            text,
            size,
            colour,
            anchor,
            upwards,
        } => {
            let em = size * f64::from(SCALE);
            let above = rules.baseline * size;
            let (place, turn) = if *upwards {
                ((baseline.0 - above, baseline.1), FontTransform::Rotate270)
            } else {
                ((baseline.0, baseline.1 - above), FontTransform::None)
            };
            let horizontal = match anchor {
                Anchor::Start => HPos::Left,
                Anchor::Middle => HPos::Center,
                Anchor::End => HPos::Right,
            };
            let colour = RGBColor(colour[0], colour[1], colour[2]);
            let style = TextStyle::from(face(rules.size * em).transform(turn))
                .color(&colour)
                .pos(Pos::new(horizontal, VPos::Top));
            backend
                .draw_text(text, &style, pixel(place))
                .map_err(drawing)?;
        }
    }
    Ok(())
}

/// The width of `text` at an em of `size`, in points.
pub(super) fn text_width(text: &str, size: f64) -> f64 {
    // Measured large, as the answer is in whole pixels.
    const EM: f64 = 200.0;
    if !font::register() {
        return 0.0;
    }
    let bounds = face(EM * font::LINE_PER_EM).layout_box(text);
    bounds.map_or(0.0, |((left, _), (right, _))| {
        f64::from(right - left) / EM * size
    })
}

fn face(size: f64) -> FontDesc<'static> {
    FontDesc::new(FontFamily::SansSerif, size, FontStyle::Normal)
}

fn style(colour: Rgb, width: u32) -> ShapeStyle {
    let colour = RGBColor(colour[0], colour[1], colour[2]);
    ShapeStyle {
        color: colour.into(),
        filled: true,
        stroke_width: width,
    }
}

fn pixel((x, y): Point) -> (i32, i32) {
    // The conversion saturates, so that any number gives a place.
    (
        (x * f64::from(SCALE)).round() as i32,
        (y * f64::from(SCALE)).round() as i32,
    )
}

fn drawing(error: impl std::fmt::Display) -> FigureError {
    FigureError::Drawing {
        detail: error.to_string(),
    }
}
