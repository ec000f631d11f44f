//! Figures as PDF files of one page: a backend of `plotters` that writes drawing operators by `pdf-writer`.

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::io::Write;

use ab_glyph::{Font, FontRef, OutlineCurve, Point, ScaleFont};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use pdf_writer::types::LineCapStyle;
use pdf_writer::{Content, Filter, Finish, Name, Pdf, Rect, Ref};
use plotters_backend::text_anchor::{HPos, VPos};
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingBackend, DrawingErrorKind,
    rasterizer,
};

type Drawn = Result<(), DrawingErrorKind<Infallible>>;

/// The page, in coordinates from its upper left corner as `plotters` has them.
pub(super) struct Page {
    content: Content,
    size: (u32, u32),
    /// Percentages of opacity.
    opacities: BTreeSet<u8>,
    font: FontRef<'static>,
}

impl Page {
    /// A page of `size` coordinates, of which a point has `per_point`.
    pub(super) fn new(size: (u32, u32), per_point: f32, font: FontRef<'static>) -> Self {
        let mut content = Content::new();
        // PDF counts points from the lower left corner.
        let height = size.1 as f32 / per_point;
        content.transform([1.0 / per_point, 0.0, 0.0, -1.0 / per_point, 0.0, height]);
        Page {
            content,
            size,
            opacities: BTreeSet::new(),
            font,
        }
    }

    /// The file, with a page of `width` × `height` points.
    pub(super) fn file(self, width: f64, height: f64) -> std::io::Result<Vec<u8>> {
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
        encoder.write_all(&self.content.finish())?;
        let content = encoder.finish()?;
        let [catalog, pages, page, stream] = [1, 2, 3, 4].map(Ref::new);
        let mut pdf = Pdf::new();
        pdf.catalog(catalog).pages(pages);
        pdf.pages(pages).kids([page]).count(1);
        let mut sheet = pdf.page(page);
        sheet.parent(pages).contents(stream);
        sheet.media_box(Rect::new(0.0, 0.0, width as f32, height as f32));
        let mut resources = sheet.resources();
        let mut states = resources.ext_g_states();
        for &percent in &self.opacities {
            let name = opacity_name(percent);
            let mut state = states
                .insert(Name(name.as_bytes()))
                .start::<pdf_writer::writers::ExtGraphicsState<'_>>();
            let opacity = f32::from(percent) / 100.0;
            state.stroking_alpha(opacity).non_stroking_alpha(opacity);
        }
        states.finish();
        resources.finish();
        sheet.finish();
        pdf.stream(stream, &content).filter(Filter::FlateDecode);
        Ok(pdf.finish())
    }

    // Sets the colour of lines and of areas.
    fn paint(&mut self, colour: BackendColor) {
        let [r, g, b] = <[u8; 3]>::from(colour.rgb).map(|channel| f32::from(channel) / 255.0);
        self.content.set_stroke_rgb(r, g, b).set_fill_rgb(r, g, b);
        let percent = (colour.alpha * 100.0).round() as u8;
        self.opacities.insert(percent);
        self.content
            .set_parameters(Name(opacity_name(percent).as_bytes()));
    }

    fn trace(&mut self, points: impl IntoIterator<Item = BackendCoord>) {
        for (k, (x, y)) in points.into_iter().enumerate() {
            let (x, y) = (x as f32, y as f32);
            match k {
                0 => self.content.move_to(x, y),
                _ => self.content.line_to(x, y),
            };
        }
    }

    // Appends the outline of a glyph whose origin is at `x` on the baseline `y`.
    fn glyph(&mut self, curves: &[OutlineCurve], scale: f32, (x, y): (f32, f32)) {
        let at = |point: Point| (x + scale * point.x, y - scale * point.y);
        let mut end = None;
        for curve in curves {
            let (from, to) = match *curve {
                OutlineCurve::Line(from, to)
                | OutlineCurve::Quad(from, _, to)
                | OutlineCurve::Cubic(from, _, _, to) => (from, to),
            };
            if end != Some(from) {
                self.content.move_to(at(from).0, at(from).1);
            }
            let [a, b] = match *curve {
                OutlineCurve::Line(from, to) => [from, to],
                // PDF has cubic curves only.
                OutlineCurve::Quad(from, control, to) => [from, to].map(|of| Point {
                    x: (of.x + 2.0 * control.x) / 3.0,
                    y: (of.y + 2.0 * control.y) / 3.0,
                }),
                OutlineCurve::Cubic(_, a, b, _) => [a, b],
            };
            let [a, b, c] = [a, b, to].map(at);
            self.content.cubic_to(a.0, a.1, b.0, b.1, c.0, c.1);
            end = Some(to);
        }
    }
}

fn opacity_name(percent: u8) -> String {
    format!("o{percent}")
}

impl DrawingBackend for &mut Page {
    type ErrorType = Infallible;

    fn get_size(&self) -> (u32, u32) {
        self.size
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        Ok(())
    }

    fn draw_pixel(&mut self, (x, y): BackendCoord, colour: BackendColor) -> Drawn {
        self.draw_rect((x, y), (x + 1, y + 1), &colour, true)
    }

    fn draw_line<S: BackendStyle>(
        &mut self,
        from: BackendCoord,
        to: BackendCoord,
        style: &S,
    ) -> Drawn {
        self.draw_path([from, to], style)
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        (x0, y0): BackendCoord,
        (x1, y1): BackendCoord,
        style: &S,
        fill: bool,
    ) -> Drawn {
        let corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)];
        match fill {
            true => self.fill_polygon(corners, &style.color()),
            false => self.draw_path(corners.into_iter().chain([(x0, y0)]), style),
        }
    }

    fn draw_path<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        path: I,
        style: &S,
    ) -> Drawn {
        if style.color().alpha > 0.0 {
            self.paint(style.color());
            self.content.set_line_width(style.stroke_width() as f32);
            self.trace(path);
            self.content.stroke();
        }
        Ok(())
    }

    fn draw_circle<S: BackendStyle>(
        &mut self,
        (x, y): BackendCoord,
        radius: u32,
        style: &S,
        fill: bool,
    ) -> Drawn {
        if !fill {
            return rasterizer::draw_circle(self, (x, y), radius, style, fill);
        }
        // A line without length and with round ends.
        self.paint(style.color());
        self.content
            .save_state()
            .set_line_cap(LineCapStyle::RoundCap)
            .set_line_width(2.0 * radius as f32);
        self.trace([(x, y), (x, y)]);
        self.content.stroke().restore_state();
        Ok(())
    }

    fn fill_polygon<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        corners: I,
        style: &S,
    ) -> Drawn {
        if style.color().alpha > 0.0 {
            self.paint(style.color());
            self.trace(corners);
            match style.color().alpha < 1.0 {
                true => self.content.fill_nonzero(),
                // With a thin line of the same colour, without which viewers show seams between the rectangles that are pixels
                // of an image.
                false => self
                    .content
                    .set_line_width(1.0)
                    .close_fill_nonzero_and_stroke(),
            };
        }
        Ok(())
    }

    // Texts are outlines, so that a file needs no font and looks as the PNG does.
    fn draw_text<S: BackendTextStyle>(
        &mut self,
        text: &str,
        style: &S,
        (x, y): BackendCoord,
    ) -> Drawn {
        // An operator that fills needs a path.
        if text.trim().is_empty() {
            return Ok(());
        }
        let size = style.size() as f32;
        let outlines = self.font.clone();
        let font = outlines.as_scaled(size);
        let (mut glyphs, mut width) = (Vec::new(), 0.0);
        for character in text.chars() {
            let id = font.glyph_id(character);
            if let Some(&(last, _)) = glyphs.last() {
                width += font.kern(last, id);
            }
            glyphs.push((id, width));
            width += font.h_advance(id);
        }
        let left = match style.anchor().h_pos {
            HPos::Left => 0.0,
            HPos::Center => -0.5 * width,
            HPos::Right => -width,
        };
        // The baseline of `plotters` in pictures: half a size below the upper edge of a box of 1/1.24 sizes.
        let baseline = size
            * match style.anchor().v_pos {
                VPos::Top => 0.5,
                VPos::Center => 0.5 - 0.5 / 1.24,
                VPos::Bottom => 0.5 - 1.0 / 1.24,
            };
        let turned = style.transform();
        let axes = [turned.transform(1, 0), turned.transform(0, 1)];
        let [(a, b), (c, d)] = axes.map(|(x, y)| (x as f32, y as f32));
        self.content.save_state();
        self.content.transform([a, b, c, d, x as f32, y as f32]);
        self.paint(style.color());
        for (id, at) in glyphs {
            if let Some(outline) = outlines.outline(id) {
                self.glyph(
                    &outline.curves,
                    font.h_scale_factor(),
                    (left + at, baseline),
                );
            }
        }
        self.content.fill_nonzero();
        self.content.restore_state();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use plotters::style::text_anchor::Pos;
    use plotters::style::{BLACK, Color, RED};

    use super::*;
    use crate::figure::canvas::{DEJAVU_SANS, font};

    fn drawn(draw: impl FnOnce(&mut &mut Page)) -> String {
        let outlines = FontRef::try_from_slice(DEJAVU_SANS).unwrap();
        let mut page = Page::new((400, 200), 4.0, outlines);
        draw(&mut &mut page);
        let text = page.content.finish().to_vec();
        String::from_utf8(text).unwrap().replace('\n', " ")
    }

    #[test]
    fn shapes_have_colours_opacities_and_corners() {
        let text = drawn(|page| {
            page.draw_rect((1, 2), (11, 22), &RED.mix(0.3), true)
                .unwrap();
            page.draw_path([(0, 0), (5, 5)], &Color::stroke_width(&BLACK, 3))
                .unwrap();
            page.draw_circle((50, 60), 7, &BLACK, true).unwrap();
        });
        for part in [
            "0.25 0 0 -0.25 0 50 cm",
            "1 0 0 rg /o30 gs 1 2 m 11 2 l 11 22 l 1 22 l f",
            "0 0 0 rg /o100 gs 3 w 0 0 m 5 5 l S",
            "q 1 J 14 w 50 60 m 50 60 l S Q",
        ] {
            assert!(text.contains(part), "{part} in {text}");
        }
    }

    // Least and largest x of the outlines of a text.
    fn extent(h_pos: HPos) -> (f32, f32) {
        let style = font(10.0).pos(Pos::new(h_pos, VPos::Center));
        let text = drawn(|page| page.draw_text("HH", &style, (100, 100)).unwrap());
        let words: Vec<&str> = text.split(' ').collect();
        let curves = words.iter().enumerate().filter(|(_, word)| **word == "c");
        let x = curves.map(|(at, _)| words[at - 2].parse::<f32>().unwrap());
        x.fold((f32::MAX, f32::MIN), |(low, high), x| {
            (low.min(x), high.max(x))
        })
    }

    #[test]
    fn texts_stand_at_their_anchors() {
        let (left, right) = extent(HPos::Left);
        let width = right - left;
        // Two capitals H of 10 points at four coordinates per point; DejaVu Sans has 0.75 em each, with their margins.
        assert!((50.0..60.0).contains(&width), "{width}");
        assert!((0.0..8.0).contains(&left), "{left}");
        let (left, right) = extent(HPos::Right);
        assert!(
            (-8.0..0.0).contains(&right) && left < -width,
            "{left} {right}"
        );
        let (left, right) = extent(HPos::Center);
        assert!((left + right).abs() < 1.0, "{left} {right}");
    }
}
