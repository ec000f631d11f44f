//! Where a figure is drawn: lengths, texts and lines, and files of pixels or shapes.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use ab_glyph::FontRef;
use plotters::backend::DrawingBackend;
use plotters::coord::Shift;
use plotters::drawing::{DrawingArea, DrawingAreaErrorKind, IntoDrawingArea};
use plotters::element::PathElement;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{Color, FontStyle, IntoFont, RGBColor, TextStyle, WHITE, register_font};
use plotters_bitmap::BitMapBackend;
use plotters_svg::SVGBackend;
use shearq_files::{FileError, atomic};

use super::pdf;
use crate::escape;

// The em of a figure's title, in points.
pub(super) const TITLE_SIZE: f64 = 15.0;
// The em of labels of axes, panels and legends, in points.
pub(super) const LABEL_SIZE: f64 = 12.5;
// The em of numbers at ticks, in points.
pub(super) const TICK_SIZE: f64 = 11.0;
// The space between a figure's parts and around it, in points.
pub(super) const MARGIN: f64 = 12.0;
// Width of axes and frames, in points.
pub(super) const LINE: f64 = 1.0;

pub(super) const INK: RGBColor = RGBColor(38, 38, 38);

// Coordinates per point. `plotters` has whole coordinates; at four per point they are finer than a pixel of any screen.
const UNITS: f64 = 4.0;
// Coordinates per side of a pixel of a PNG, which thus has 144 pixels per inch. `plotters` does not smooth the edges of
// lines, the mean over four coordinates does.
const UNITS_PER_PIXEL: usize = 2;
// The largest figure in square points. A PNG takes 60 bytes per square point while it is drawn.
const MAX_AREA: f64 = 5e6;

#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    #[error("{}: found {found} as the figure's format; expected the extension `.pdf`, `.png` or `.svg`", path.display())]
    Extension { path: PathBuf, found: String },
    #[error(transparent)]
    File(#[from] FileError),
    #[error(
        "the figure would be {width:.0} × {height:.0} points, expected at most {MAX_AREA:.0} \
         square points: put fewer panels into it"
    )]
    TooLarge { width: f64, height: f64 },
    #[error("cannot draw the figure: {detail}")]
    Drawing { detail: String },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PictureFormat {
    /// Pixels, two per point.
    Png,
    /// Shapes and text.
    Svg,
    /// A page of shapes, texts among them.
    Pdf,
}

impl PictureFormat {
    /// The format that the extension of `path` names, in capitals or not.
    pub fn of(path: &Path) -> Result<Self, FigureError> {
        let extension = path.extension().map(|e| e.to_string_lossy());
        match extension.as_deref().map(str::to_ascii_lowercase).as_deref() {
            Some("png") => Ok(Self::Png),
            Some("svg") => Ok(Self::Svg),
            Some("pdf") => Ok(Self::Pdf),
            other => Err(FigureError::Extension {
                path: path.into(),
                found: other.map_or("no extension".into(), |found| format!("`.{found}`")),
            }),
        }
    }
}

// Where a figure is drawn, in `UNITS` from its upper left corner.
pub(super) type Canvas<B> = DrawingArea<B, Shift>;
pub(super) type Drawn<B> = Result<(), DrawingAreaErrorKind<<B as DrawingBackend>::ErrorType>>;

/// A picture that can be drawn. Values that are not finite, or not positive on a logarithmic axis, are left out.
pub trait Figure: Sized {
    /// Width and height in points that it needs.
    fn extent(&self) -> (f64, f64);

    fn draw<B: DrawingBackend>(&self, canvas: &Canvas<B>) -> Drawn<B>;

    /// Width and height in points.
    fn size(&self) -> (f64, f64) {
        let (width, height) = self.extent();
        (width.max(1.0).ceil(), height.max(1.0).ceil())
    }

    /// The contents of a picture file. The same figure gives the same bytes.
    fn render(&self, format: PictureFormat) -> Result<Vec<u8>, FigureError> {
        let (width, height) = self.size();
        if width * height > MAX_AREA {
            return Err(FigureError::TooLarge { width, height });
        }
        let size = (units(width) as u32, units(height) as u32);
        match format {
            PictureFormat::Svg => {
                let mut svg = String::new();
                draw_on(self, SVGBackend::with_string(&mut svg, size))?;
                let (_, shapes) = svg.split_once(">\n").unwrap_or_default();
                let shapes =
                    shapes.replace("dy=\"0.5ex\"", &format!("dy=\"{CENTRE_TO_BASELINE}em\""));
                // Smoothed edges would show as seams between the rectangles that are pixels of an image.
                let head = format!(
                    "<svg width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {} {}\" \
                     xmlns=\"http://www.w3.org/2000/svg\">\n\
                     <style>rect{{shape-rendering:crispEdges}}</style>\n",
                    size.0, size.1
                );
                Ok((head + &shapes).into_bytes())
            }
            PictureFormat::Png => {
                let mut rgb = vec![0; 3 * size.0 as usize * size.1 as usize];
                draw_on(self, BitMapBackend::with_buffer(&mut rgb, size))?;
                png(&rgb, size.0 as usize).map_err(failed)
            }
            PictureFormat::Pdf => {
                let font = FontRef::try_from_slice(DEJAVU_SANS).map_err(failed)?;
                let mut page = pdf::Page::new(size, UNITS as f32, font);
                draw_on(self, &mut page)?;
                page.file(width, height).map_err(failed)
            }
        }
    }

    /// Writes the figure to `path`, as PDF, PNG or SVG by its extension.
    fn save(&self, path: impl AsRef<Path>) -> Result<(), FigureError> {
        let path = path.as_ref();
        let bytes = self.render(PictureFormat::of(path)?)?;
        Ok(atomic::write(path, &bytes)?)
    }
}

fn draw_on<B: DrawingBackend>(figure: &impl Figure, backend: B) -> Result<(), FigureError> {
    let canvas = backend.into_drawing_area();
    canvas.fill(&WHITE).map_err(failed)?;
    figure.draw(&canvas).map_err(failed)?;
    canvas.present().map_err(failed)
}

fn failed(error: impl std::fmt::Display) -> FigureError {
    FigureError::Drawing {
        detail: error.to_string(),
    }
}

// A PNG file of rows of `width` coordinates.
fn png(rgb: &[u8], width: usize) -> Result<Vec<u8>, png::EncodingError> {
    const SIDE: usize = UNITS_PER_PIXEL;
    let across = width / SIDE;
    let mut pixels = Vec::with_capacity(rgb.len() / (SIDE * SIDE));
    for rows in rgb.chunks_exact(3 * SIDE * width) {
        for at in (0..across).flat_map(|x| [0, 1, 2].map(|channel| 3 * SIDE * x + channel)) {
            let square = (0..SIDE * SIDE).map(|k| 3 * (k / SIDE * width + k % SIDE) + at);
            let sum: usize = square.map(|k| usize::from(rows[k])).sum();
            pixels.push(((sum + SIDE * SIDE / 2) / (SIDE * SIDE)) as u8);
        }
    }
    let mut file = Vec::new();
    let down = pixels.len() / (3 * across);
    let mut encoder = png::Encoder::new(&mut file, across as u32, down as u32);
    encoder.set_color(png::ColorType::Rgb);
    // 144 pixels per inch.
    encoder.set_pixel_dims(Some(png::PixelDimensions {
        xppu: 5669,
        yppu: 5669,
        unit: png::Unit::Meter,
    }));
    encoder.write_header()?.write_image_data(&pixels)?;
    Ok(file)
}

pub(super) fn units(points: f64) -> i32 {
    (points * UNITS).round() as i32
}

pub(super) fn place((x, y): (f64, f64)) -> (i32, i32) {
    (units(x), units(y))
}

// Distance of the baseline from the place of a text that `plotters` centres upwards in a PNG, in em; 0.27 em
// in an SVG.
const CENTRE_TO_BASELINE: f64 = 0.12;
// Half the height of digits and capitals above that, in em.
pub(super) const TO_CENTRE: f64 = 0.36 - CENTRE_TO_BASELINE;

// Which part of a text stands at its place.
pub(super) const LEFT: Pos = pos(HPos::Left, VPos::Center);
pub(super) const RIGHT: Pos = pos(HPos::Right, VPos::Center);
pub(super) const MIDDLE: Pos = pos(HPos::Center, VPos::Center);

const fn pos(h_pos: HPos, v_pos: VPos) -> Pos {
    Pos { h_pos, v_pos }
}

// Shipped, so that figures are the same on machines without fonts, and with ℓ, γ, σ and superscripts. An SVG file
// names only the family, and its viewer chooses a font.
pub(super) const DEJAVU_SANS: &[u8] = include_bytes!("../../fonts/DejaVuSans.ttf");

pub(super) fn font(size: f64) -> TextStyle<'static> {
    const FAMILY: &str = "sans-serif";
    static REGISTERED: LazyLock<bool> =
        LazyLock::new(|| register_font(FAMILY, FontStyle::Normal, DEJAVU_SANS).is_ok());
    LazyLock::force(&REGISTERED);
    // `plotters` has the height of the line, 1.16 em in DejaVu Sans, in pictures, and 1.24 em in SVG.
    TextStyle::from((FAMILY, 1.2 * size * UNITS).into_font()).color(&INK)
}

pub(super) fn text_width(text: &str, size: f64) -> f64 {
    let size = font(size).font.box_size(&escape::line(text));
    f64::from(size.map_or(0, |size| size.0)) / UNITS
}

pub(super) fn widest<'a>(texts: impl Iterator<Item = &'a str>, size: f64) -> f64 {
    texts.map(|text| text_width(text, size)).fold(0.0, f64::max)
}

// Writes a text with the middle of its digits at the height of `at`.
pub(super) fn write<B: DrawingBackend>(
    canvas: &Canvas<B>,
    text: &str,
    size: f64,
    anchor: Pos,
    (x, y): (f64, f64),
) -> Drawn<B> {
    let at = place((x, y + TO_CENTRE * size));
    match text {
        "" => Ok(()),
        text => canvas.draw_text(&escape::line(text), &font(size).pos(anchor), at),
    }
}

pub(super) fn line<B: DrawingBackend>(
    canvas: &Canvas<B>,
    through: Vec<(i32, i32)>,
    colour: RGBColor,
    width: f64,
) -> Drawn<B> {
    let style = colour.stroke_width(units(width) as u32);
    canvas.draw(&PathElement::new(through, style))
}

pub(super) fn frame<B: DrawingBackend>(
    canvas: &Canvas<B>,
    corner: (f64, f64),
    opposite: (f64, f64),
) -> Drawn<B> {
    let ((x0, y0), (x1, y1)) = (place(corner), place(opposite));
    // A closed path would not be filled where it overlaps itself.
    line(canvas, vec![(x0, y1), (x0, y0), (x1, y0)], INK, LINE)?;
    line(canvas, vec![(x1, y0), (x1, y1), (x0, y1)], INK, LINE)
}

// Height of a text with its margin; zero for an empty text.
pub(super) fn room(text: &str, size: f64) -> f64 {
    match text {
        "" => 0.0,
        _ => size + 8.0,
    }
}
