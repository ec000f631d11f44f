//! Named configurations: the settings of a method, in TOML files that inherit from each other.
//!
//! A [`Configuration`] has all settings of its method. The [`Registry`] has the configurations of the paper's Table 1
//! and the linear ones. A file works wherever a name does, and `extends` a name or another file. An error names file and
//! place of unknown keys, unused keys, values out of range, unknown names and cycles.
#![forbid(unsafe_code)]

mod error;
mod name;
mod registry;
mod settings;

pub use error::{ConfigurationError, OutOfRange, SettingError};
pub use name::{MAX_NAME, check_name, checked_name};
pub use registry::{Entry, Published, Registry, Template};
pub use settings::{
    AcfKind, Background, BrightnessUnit, Calibration, ClippedShape, Clipping, Configuration,
    Denoise, DetectionMethod, EllipticityType, Kept, LinearDeconvolution, LinearMethod, Method,
    NetworkDeconvolution, NetworkMethod, NoiseSource, Psf, PsfCut, PsfForm, PsfScale, ShareOf,
    ShearOrigin, SkySource, Stamp, Start, StepScale, Update, Wavelet, WeightedShape, limits,
};

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
