//! Point-spread functions: star stamps and functional forms.

mod functional;
mod star;

pub use functional::{FunctionalPsf, PsfProfile, PsfTransform, TransformedPsf};
pub(crate) use star::cut_start;
pub use star::star_psf;
