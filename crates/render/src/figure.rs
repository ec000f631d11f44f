//! Figures for reports: curves and points with errors, and images, drawn by `plotters`.
//!
//! ```
//! # use shearq_render::figure::{Figure, PictureFormat, LinePlot, Series, Style};
//! let plot = LinePlot {
//!     title: "Shear power".into(),
//!     x_label: "ℓ".into(),
//!     y_label: "ℓ(ℓ+1)C(ℓ)/2π".into(),
//!     x_log: true,
//!     y_log: true,
//!     series: vec![Series::new("true", vec![100.0, 200.0], vec![1e-5, 2e-5], Style::Line, 0)],
//!     ..LinePlot::default()
//! };
//! assert!(plot.render(PictureFormat::Svg)?.starts_with(b"<svg"));
//! # Ok::<(), shearq_render::figure::FigureError>(())
//! ```

mod axis;
mod canvas;
mod colour;
mod image;
mod pdf;
mod plot;

pub use self::canvas::{Figure, FigureError, PictureFormat};
pub use self::colour::ColourMap;
pub use self::image::{ImageGrid, ImagePanel, ImageRow, Stretch};
pub use self::plot::{Band, LinePlot, PanelGrid, Point, Series, Style};
