//! Point-spread functions: star stamps and functional forms.

pub(crate) mod breadth;
mod star;

pub(crate) use star::cut_start;
pub use star::star_psf;
