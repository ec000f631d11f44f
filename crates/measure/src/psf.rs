//! Point-spread functions: formulas, and stars.

mod average;
mod denoised_star;
mod moffat;
mod oversampled;
mod psfs;
mod quality;
mod residual_profile;
mod shape;
mod star;
mod star_survey;
#[cfg(test)]
mod testing;
mod truncation;
mod width;

pub use self::average::average_stars;
pub(crate) use self::denoised_star::StarDenoiser;
pub use self::oversampled::Oversampling;
pub use self::psfs::Psfs;
pub(crate) use self::quality::{PsfQuality, psf_warnings};
pub(crate) use self::residual_profile::ResidualProfiles;
pub use self::star::Star;
pub(crate) use self::star::cut_start;
pub(crate) use self::star_survey::StarSurvey;
pub use self::truncation::Truncation;
pub use self::width::gaussian_sigma;
pub(crate) use self::width::{
    WIDTH_STEPS, gaussian_variance, noise_equivalent_area, width_factor, width_step,
};
