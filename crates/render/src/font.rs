//! The font of all figures, shipped with the program.
//!
//! Figures must look the same on machines without any fonts, such as the nodes of a cluster, and
//! need glyphs such as ℓ, γ, σ and superscripts: DejaVu Sans has them.

use std::sync::LazyLock;

use ab_glyph::{Font, FontRef, GlyphId, OutlineCurve};
use tiny_skia::{Path, PathBuilder};

/// The generic name, so that viewers of an SVG file, which holds text and no font, choose a font of the
/// same kind.
pub(super) const FAMILY: &str = "sans-serif";

/// None if the font were broken, which a test excludes.
static DEJAVU_SANS: LazyLock<Option<FontRef<'static>>> =
    LazyLock::new(|| FontRef::try_from_slice(include_bytes!("../fonts/DejaVuSans.ttf")).ok());

/// The glyphs of a line of text, each with its place along the baseline, and where the line ends, in units
/// of the font.
fn glyphs(font: &FontRef<'_>, text: &str) -> (Vec<(GlyphId, f32)>, f32) {
    let mut end = 0.0;
    let mut glyphs: Vec<(GlyphId, f32)> = Vec::with_capacity(text.len());
    for c in text.chars() {
        let glyph = font.glyph_id(c);
        if let Some((before, _)) = glyphs.last() {
            end += font.kern_unscaled(*before, glyph);
        }
        glyphs.push((glyph, end));
        end += font.h_advance_unscaled(glyph);
    }
    (glyphs, end)
}

/// Width of a line of text in ems.
pub(super) fn width(text: &str) -> f32 {
    DEJAVU_SANS.as_ref().map_or(0.0, |font| {
        glyphs(font, text).1 / font.units_per_em().unwrap_or(1.0)
    })
}

/// Outline of a line of text in ems: it begins at 0 on the baseline, and y runs downwards. None where
/// nothing is to be seen.
pub(super) fn outline(text: &str) -> Option<Path> {
    let font = DEJAVU_SANS.as_ref()?;
    let em = font.units_per_em()?;
    let mut path = PathBuilder::new();
    for (glyph, start) in glyphs(font, text).0 {
        let Some(outline) = font.outline(glyph) else {
            continue;
        };
        let place = |p: ab_glyph::Point| ((start + p.x) / em, -p.y / em);
        // Curves follow one another; where one does not begin at the end of the last, a contour does.
        let mut last = None;
        for curve in outline.curves {
            let (from, to) = match curve {
                OutlineCurve::Line(from, to) => (from, to),
                OutlineCurve::Quad(from, _, to) => (from, to),
                OutlineCurve::Cubic(from, _, _, to) => (from, to),
            };
            if last != Some(from) {
                let (x, y) = place(from);
                path.move_to(x, y);
            }
            last = Some(to);
            let (x, y) = place(to);
            match curve {
                OutlineCurve::Line(..) => path.line_to(x, y),
                OutlineCurve::Quad(_, control, _) => {
                    let (cx, cy) = place(control);
                    path.quad_to(cx, cy, x, y);
                }
                OutlineCurve::Cubic(_, first, second, _) => {
                    let ((x1, y1), (x2, y2)) = (place(first), place(second));
                    path.cubic_to(x1, y1, x2, y2, x, y);
                }
            }
        }
    }
    path.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn glyphs_that_figures_need_are_in_the_font() {
        let font = DEJAVU_SANS.as_ref().expect("a font that can be read");
        for c in "aZ09 ±−×√ℓγσλχε⁻³⁵°µ–…".chars() {
            assert_ne!(font.glyph_id(c), GlyphId(0), "{c}");
        }
        assert!(outline(" ").is_none());
    }

    #[test]
    fn a_line_is_as_wide_as_its_outline_is_about() {
        // Digits have one width, 1303 of 2048 units; the ink stays within.
        let line = width("0000");
        assert!((line - 4.0 * 1303.0 / 2048.0).abs() < 1e-6, "{line}");
        let ink = outline("0000").expect("an outline").bounds();
        assert!(ink.left() > 0.0 && ink.right() < line, "{ink:?}");
        // On the baseline, upwards.
        assert!(
            ink.top() < -0.7 && ink.top() > -0.8 && ink.bottom() < 0.05,
            "{ink:?}"
        );
    }
}
