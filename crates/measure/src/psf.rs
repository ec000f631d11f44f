//! Point-spread functions: star stamps and functional forms.

mod average;
pub(crate) mod breadth;
mod common;
mod effect;
pub(crate) mod examine;
mod halfway;
mod moffat;
pub(crate) mod shrink;
mod star;
mod sums;

pub use average::average_stars;
pub use common::{CommonProfile, StarSurvey};
pub(crate) use star::cut_start;
pub use star::{Star, star, star_psf};
