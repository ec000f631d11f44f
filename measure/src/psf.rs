//! Point-spread functions: star stamps and functional forms.

pub(crate) mod breadth;
mod functional;
mod star;

pub use functional::{FunctionalPsf, PsfProfile, PsfTransform, TransformedPsf};
pub(crate) use star::cut_start;
pub use star::star_psf;
