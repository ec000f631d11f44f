//! A drawing as a list of shapes, and its two renderings: an SVG file, and pixels by tiny-skia.
//!
//! Figures describe themselves in points, as real numbers.

use std::fmt::Write;

use tiny_skia::{
    Color, FillRule, LineJoin, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, Transform,
};

use super::FigureError;
use super::colour::Rgb;
use crate::escape::{line, markup};
use crate::font;

/// Pixels of a PNG per point.
pub(crate) const PIXELS_PER_POINT: f32 = 2.0;
/// The largest scene in square points, for which drawing takes about a third of a gigabyte.
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
        let (width, height) = self.size()?;
        // Smoothed edges would show as seams between the rectangles that are pixels of an image.
        let mut svg = format!(
            "<svg width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
             xmlns=\"http://www.w3.org/2000/svg\" font-family=\"{}\">\n\
             <style>rect{{shape-rendering:crispEdges}}path{{fill:none;stroke-linejoin:round}}</style>\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#FFFFFF\"/>\n",
            font::FAMILY
        );
        for shape in &self.shapes {
            write_shape(&mut svg, shape);
        }
        svg.push_str("</svg>\n");
        Ok(svg)
    }

    /// The scene as a PNG file.
    pub(super) fn to_png(&self) -> Result<Vec<u8>, FigureError> {
        let (width, height) = self.size()?;
        let pixels = |points: u32| points * PIXELS_PER_POINT as u32;
        let mut pixmap = Pixmap::new(pixels(width), pixels(height))
            .ok_or_else(|| drawing("no memory for its pixels"))?;
        pixmap.fill(Color::WHITE);
        for shape in &self.shapes {
            paint_shape(&mut pixmap, shape);
        }
        pixmap.encode_png().map_err(drawing)
    }

    /// Width and height in whole points.
    fn size(&self) -> Result<(u32, u32), FigureError> {
        if self.width * self.height > LARGEST {
            return Err(FigureError::TooLarge {
                width: self.width,
                height: self.height,
                largest: LARGEST,
            });
        }
        Ok((self.width.ceil() as u32, self.height.ceil() as u32))
    }
}

/// A number of points in a file: hundredths of a point are finer than any print.
fn hundredths(x: f64) -> f64 {
    // A negative zero would be written with its sign.
    (x * 100.0).round() / 100.0 + 0.0
}

fn write_shape(svg: &mut String, shape: &Shape) {
    let hex = |[r, g, b]: Rgb| format!("#{r:02X}{g:02X}{b:02X}");
    let h = hundredths;
    // Writing to a string cannot fail.
    let _ = match shape {
        Shape::Path {
            points,
            colour,
            width,
        } => {
            let mut path = String::new();
            for (k, (x, y)) in points.iter().enumerate() {
                let command = if k == 0 { 'M' } else { 'L' };
                let _ = write!(path, "{command}{} {}", h(*x), h(*y));
            }
            writeln!(
                svg,
                "<path d=\"{path}\" stroke=\"{}\" stroke-width=\"{}\"/>",
                hex(*colour),
                h(*width)
            )
        }
        Shape::Rectangle {
            corner,
            opposite,
            colour,
        } => {
            let [left, top, right, bottom] = edges(*corner, *opposite).map(h);
            writeln!(
                svg,
                "<rect x=\"{left}\" y=\"{top}\" width=\"{}\" height=\"{}\" fill=\"{}\"/>",
                h(right - left),
                h(bottom - top),
                hex(*colour)
            )
        }
        Shape::Disc {
            centre: (x, y),
            radius,
            colour,
        } => writeln!(
            svg,
            "<circle cx=\"{}\" cy=\"{}\" r=\"{}\" fill=\"{}\"/>",
            h(*x),
            h(*y),
            h(*radius),
            hex(*colour)
        ),
        Shape::Text {
            baseline: (x, y),
            text,
            size,
            colour,
            anchor,
            upwards,
        } => {
            let (x, y) = (h(*x), h(*y));
            let anchor = match anchor {
                Anchor::Start => "start",
                Anchor::Middle => "middle",
                Anchor::End => "end",
            };
            let turn = match upwards {
                true => format!(" transform=\"rotate(-90 {x} {y})\""),
                false => String::new(),
            };
            writeln!(
                svg,
                "<text x=\"{x}\" y=\"{y}\" font-size=\"{}\" text-anchor=\"{anchor}\" \
                 fill=\"{}\"{turn}>{}</text>",
                h(*size),
                hex(*colour),
                markup(text)
            )
        }
    };
}

/// Draws one shape; places that are not finite draw nothing.
fn paint_shape(pixmap: &mut Pixmap, shape: &Shape) {
    let to_pixels = Transform::from_scale(PIXELS_PER_POINT, PIXELS_PER_POINT);
    let paint = |[r, g, b]: Rgb, anti_alias| {
        let mut paint = Paint {
            anti_alias,
            ..Paint::default()
        };
        paint.set_color_rgba8(r, g, b, u8::MAX);
        paint
    };
    match shape {
        Shape::Path {
            points,
            colour,
            width,
        } => {
            let stroke = Stroke {
                width: *width as f32,
                line_join: LineJoin::Round,
                ..Stroke::default()
            };
            if let Some(path) = polyline(points) {
                pixmap.stroke_path(&path, &paint(*colour, true), &stroke, to_pixels, None);
            }
        }
        Shape::Rectangle {
            corner,
            opposite,
            colour,
        } => {
            let [left, top, right, bottom] = edges(*corner, *opposite).map(|x| x as f32);
            if let Some(area) = Rect::from_ltrb(left, top, right, bottom) {
                pixmap.fill_rect(area, &paint(*colour, false), to_pixels, None);
            }
        }
        Shape::Disc {
            centre: (x, y),
            radius,
            colour,
        } => {
            if let Some(path) = PathBuilder::from_circle(*x as f32, *y as f32, *radius as f32) {
                let rule = FillRule::Winding;
                pixmap.fill_path(&path, &paint(*colour, true), rule, to_pixels, None);
            }
        }
        Shape::Text {
            baseline: (x, y),
            text,
            size,
            colour,
            anchor,
            upwards,
        } => {
            let back = match anchor {
                Anchor::Start => 0.0,
                Anchor::Middle => 0.5,
                Anchor::End => 1.0,
            };
            let place = to_pixels
                .pre_translate(*x as f32, *y as f32)
                .pre_rotate(if *upwards { -90.0 } else { 0.0 })
                .pre_translate((-back * text_width(text, *size)) as f32, 0.0)
                .pre_scale(*size as f32, *size as f32);
            if let Some(path) = font::outline(text) {
                pixmap.fill_path(&path, &paint(*colour, true), FillRule::Winding, place, None);
            }
        }
    }
}

/// The line through `points`, where there are two or more.
fn polyline(points: &[Point]) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for (k, (x, y)) in points.iter().enumerate() {
        let (x, y) = (*x as f32, *y as f32);
        match k {
            0 => builder.move_to(x, y),
            _ => builder.line_to(x, y),
        }
    }
    builder.finish()
}

/// Left, top, right and bottom of a rectangle.
fn edges((x0, y0): Point, (x1, y1): Point) -> [f64; 4] {
    [x0.min(x1), y0.min(y1), x0.max(x1), y0.max(y1)]
}

/// The width of `text` at an em of `size`, in points.
pub(super) fn text_width(text: &str, size: f64) -> f64 {
    f64::from(font::width(text)) * size
}

fn drawing(error: impl std::fmt::Display) -> FigureError {
    FigureError::Drawing {
        detail: error.to_string(),
    }
}
