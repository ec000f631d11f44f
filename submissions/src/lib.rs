//! Named submission configurations: how to get from a stamp to an ellipticity, in TOML files with
//! inheritance.
//!
//! A [`Configuration`] holds every setting of its method, resolved. The seven variants of the paper's Table 1
//! and the linear ones are embedded ([`Registry`]); a user's own file works wherever a name does, and
//! `extends` either a name or another file. Unknown keys, keys that the method does not use, values out of
//! range, unknown names and cycles are refused with the file and place.

#![forbid(unsafe_code)]

mod error;
mod file;
pub mod limits;
mod name;
mod registry;
mod settings;
mod template;
mod validate;

pub use error::ConfigurationError;
pub use file::Published;
pub use name::{MAX_NAME, check_name, checked_name, is_control};
pub use registry::{Entry, Registry};
pub use settings::{
    AcfKind, Background, BrightnessUnit, Calibration, ClippedShape, Clipping, Configuration,
    Denoise, EllipticityType, Kept, LinearDeconvolution, LinearMethod, Method,
    NetworkDeconvolution, NetworkMethod, NoiseSource, Psf, PsfCut, PsfForm, PsfScale, ShareOf,
    Stamp, Start, StepScale, Update, Wavelet, WeightedShape,
};
pub use template::Template;
pub use validate::OutOfRange;
