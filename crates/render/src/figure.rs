//! Figures for reports: curves, grids of panels, bars, tables in colour and images.
//!
//! Every kind implements [`Figure`], which writes it as PNG or SVG, by the file's extension, with
//! one font and a palette that colour-blind readers can tell apart. Values that are not finite, and
//! those that are not positive on a logarithmic axis, are left out; no data make a figure fail
//! because of what they are, only lists that should be equally long and are not.
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

mod bar;
mod colour;
mod heat;
mod image;
mod layout;
mod legend;
mod line;
mod scene;
mod style;
mod ticks;

use std::path::{Path, PathBuf};

use shearq_files::{FileError, atomic};

pub use bar::{BarGroup, BarPlot};
pub use colour::ColourMap;
pub use heat::HeatMap;
pub use image::{ImageGrid, ImagePanel, ImageRow, Scale, Stretch};
pub use line::{LinePlot, PanelGrid, Series};
pub(super) use scene::PIXELS_PER_POINT;
pub use scene::Scene;
pub use style::Style;

/// The em of a figure's title, in points.
const TITLE_SIZE: f64 = 15.0;
/// The em of labels of axes, panels and legends, in points.
const LABEL_SIZE: f64 = 12.5;
/// The em of numbers at ticks, in points.
const TICK_SIZE: f64 = 11.0;
/// The space between a figure's parts and around it, in points.
const MARGIN: f64 = 12.0;

/// Why a figure could not be drawn or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FigureError {
    /// The file's extension names no format.
    #[error("{}: found {found} as the figure's format; expected the extension `.png` or `.svg`", path.display())]
    Extension {
        /// The file.
        path: PathBuf,
        /// Its extension, or that it has none.
        found: String,
    },
    /// The file could not be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Two lists that belong together differ in length.
    #[error("figure `{figure}`, {place}: found {found} {what}, expected {expected}")]
    Lengths {
        /// The figure's title.
        figure: String,
        /// The series, group or panel.
        place: String,
        /// What is counted.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there must be.
        expected: usize,
    },
    /// The figure has too many parts to draw into one picture.
    #[error(
        "the figure would be {width:.0} × {height:.0} points, expected at most {largest:.0} \
         square points: put fewer panels into it"
    )]
    TooLarge {
        /// In points.
        width: f64,
        /// In points.
        height: f64,
        /// In square points.
        largest: f64,
    },
    /// The pixels could not be drawn.
    #[error("cannot draw the figure: {detail}")]
    Drawing {
        /// Why.
        detail: String,
    },
}

/// A format of picture files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PictureFormat {
    /// Pixels, two per point.
    Png,
    /// Shapes and text.
    Svg,
}

impl PictureFormat {
    /// The format that the extension of `path` names, in capitals or not.
    ///
    /// # Errors
    /// [`FigureError::Extension`] if it is neither `png` nor `svg`.
    pub fn of(path: &Path) -> Result<Self, FigureError> {
        let extension = path
            .extension()
            .map(|extension| extension.to_string_lossy());
        match extension.as_deref().map(str::to_ascii_lowercase).as_deref() {
            Some("png") => Ok(Self::Png),
            Some("svg") => Ok(Self::Svg),
            other => Err(FigureError::Extension {
                path: path.into(),
                found: other.map_or("no extension".into(), |found| format!("`.{found}`")),
            }),
        }
    }
}

/// A picture that can be drawn.
pub trait Figure {
    /// The shapes it consists of.
    ///
    /// # Errors
    /// [`FigureError::Lengths`] if lists that belong together differ in length.
    fn scene(&self) -> Result<Scene, FigureError>;

    /// The contents of a picture file.
    ///
    /// # Errors
    /// Those of [`Figure::scene`], [`FigureError::TooLarge`] and [`FigureError::Drawing`].
    fn render(&self, format: PictureFormat) -> Result<Vec<u8>, FigureError> {
        let scene = self.scene()?;
        match format {
            PictureFormat::Svg => Ok(scene.to_svg()?.into_bytes()),
            PictureFormat::Png => scene.to_png(),
        }
    }

    /// Writes the figure to `path`, as PNG or SVG by its extension; a file that is there is replaced
    /// at once or, on failure, not at all.
    ///
    /// # Errors
    /// Those of [`PictureFormat::of`] and [`Figure::render`], and [`FigureError::File`].
    fn save(&self, path: impl AsRef<Path>) -> Result<(), FigureError>
    where
        Self: Sized,
    {
        let path = path.as_ref();
        let bytes = self.render(PictureFormat::of(path)?)?;
        Ok(atomic::write(path, &bytes)?)
    }
}
