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
mod survey;
#[cfg(test)]
mod test_stars;

pub use average::average_stars;
pub(crate) use common::CommonProfile;
pub(crate) use star::cut_start;
pub use star::{Star, star, star_psf};
pub(crate) use survey::{StarLooker, StarSurvey};
