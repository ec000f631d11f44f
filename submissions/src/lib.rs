//! Named submission configurations: how to get from a stamp to an ellipticity, in TOML files with
//! inheritance.
//!
//! A [`Submission`] holds every setting, resolved. The seven variants of the paper's Table 1 are
//! embedded ([`Registry`]); a user's own file works wherever a name does, and `extends` either a name
//! or another file. Unknown keys, values out of range, unknown names and cycles are refused with the
//! file and place.

mod name;
mod registry;
mod settings;

pub use name::{MAX_NAME, check_name, checked_name, is_control};
pub use registry::{Entry, Published, Registry, SubmissionError, TEMPLATE};
pub use settings::{
    AcfWeight, BrightnessUnit, Calibration, Deconvolution, Denoise, DenoiseMethod, EllipticityType,
    Noise, NoiseSource, Psf, PsfForm, Shape, Stamp, Start, StepScale, Submission, Update,
};
