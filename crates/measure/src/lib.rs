//! Galaxy shapes from postage stamps and PSFs, for weak lensing: deconvolution by a Hopfield network or its
//! linear closed form, moments of the autocorrelation, and calibration by the response to shear. Views of
//! arrays in, plain structs out: no files, no threads.
//!
//! # One stamp
//!
//! ```
#![doc = include_str!("../examples/one_stamp.rs")]
//! ```
//!
//! A single galaxy's response is its own, and its ellipticity is not divided by it: see
//! [`Measurer::stamp`].
//!
//! # A batch
//!
//! ```
#![doc = include_str!("../examples/batch.rs")]
//! ```
//!
//! The ellipticities of a [`Batch`] are divided by its mean response. PSFs may also be one each, or
//! formulas ([`Psfs`]); pixels are `f32` or `f64`. Submissions are named configurations or settings files
//! (`shearq_submissions`).
//!
//! # A stream
//!
//! A [`Measurer`] is not changed by measuring and serves all threads; each has a [`Worker`] with buffers of its
//! own, which takes a PSF ([`Worker::set_psf`]), measures galaxies ([`Worker::measure`]) and allocates nothing
//! for them. [`calibrate`] does the rest when an image is complete.
//!
//! # Conventions
//!
//! Stamps are indexed `[y, x]`. e1 > 0 is elongation along +x, e2 > 0 along x = y. Noise levels are standard
//! deviations per pixel in image units. What is wrong with a request is a [`MeasureError`]; a galaxy that
//! cannot be measured has [`Flags`] and no ellipticity.

mod batch;
mod calibrate;
mod deconvolve;
mod denoise;
mod ellipticity;
mod error;
mod examine;
mod extent;
mod fft;
mod flag;
mod galaxy;
mod mean_shear;
mod measurement;
mod method;
mod noise;
pub mod parts;
mod pixel;
mod psf;
mod psfs;
mod shape;
mod sizes;
mod steps;
mod surroundings;
mod warning;
mod worker;

pub use batch::{Batch, strip};
pub use calibrate::calibrate;
pub use deconvolve::{Descent, Stop};
pub use error::MeasureError;
pub use examine::{EXAMINED_PSFS, Examination, examined_rows};
pub use flag::{Flag, Flags};
pub use galaxy::Measurer;
pub use mean_shear::{MeanShear, MeanShearError, ShearSum};
pub use measurement::{Measurement, ResponseMatrix};
pub use method::AdaptedSettings;
pub use ndarray;
pub use noise::{NoisePlan, NoiseSurvey, StampNoise, Survey};
pub use pixel::Pixel;
pub use psf::{Star, average_stars, star, star_psf};
pub use psfs::{Psfs, StarPixels};
pub use shearq_quantities::{Distortion, FunctionalPsf, PsfProfile, Shear};
pub use shearq_submissions::{Configuration, ConfigurationError, PsfCut};
pub use steps::Steps;
pub use warning::{Of, Warning};
pub use worker::{ImageNoise, ImageWorker, PsfWorker, Worker};
