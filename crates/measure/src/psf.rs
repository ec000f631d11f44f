//! Point-spread functions: formulas, and stars.

mod average;
mod denoised_star;
mod oversampled;
mod psfs;
mod quality;
mod shape;
mod star;
#[cfg(test)]
mod testing;
mod width;

pub use self::average::average_stars;
pub(crate) use self::denoised_star::{ResidualProfiles, StarDenoiser, StarSurvey};
pub use self::oversampled::from_oversampled;
pub use self::psfs::Psfs;
pub(crate) use self::quality::{PsfQuality, psf_warnings};
pub use self::star::Star;
pub(crate) use self::star::cut_start;
pub(crate) use self::width::{
    WIDTH_STEPS, gaussian_variance, noise_equivalent_area, width_factor, width_step,
};
