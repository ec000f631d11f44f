//! The font of all figures, shipped with the program.
//!
//! Figures must look the same on machines without any fonts, such as the nodes of a cluster, and
//! need glyphs such as ℓ, γ, σ and superscripts: DejaVu Sans has them.

use std::sync::OnceLock;

use plotters::style::{FontStyle, register_font};

/// The family under which the font is registered: the generic name, so that viewers of an SVG file,
/// which holds text and no font, choose a font of the same kind.
pub(super) const FAMILY: &str = "sans-serif";

/// The width of a line of the font per em: its ascent and descent, by which plotters sizes glyphs.
pub(super) const LINE_PER_EM: f64 = (1901.0 + 483.0) / 2048.0;

const DEJAVU_SANS: &[u8] = include_bytes!("../../assets/DejaVuSans.ttf");

/// Makes the font known to plotters, once per process; tells whether it could be.
pub(super) fn register() -> bool {
    static REGISTERED: OnceLock<bool> = OnceLock::new();
    *REGISTERED.get_or_init(|| register_font(FAMILY, FontStyle::Normal, DEJAVU_SANS).is_ok())
}
