//! Point-spread functions: star stamps and functional forms.

pub(crate) mod breadth;
pub(crate) mod examine;
mod functional;
mod star;

pub use functional::{FunctionalPsf, PsfProfile, PsfTransform, TransformedPsf};
pub(crate) use star::cut_start;
pub use star::{Star, star, star_psf};
