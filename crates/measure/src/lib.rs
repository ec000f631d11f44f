//! Galaxy shapes from stamps and PSFs, for weak lensing.
//!
//! A configuration deconvolves by a Hopfield network or by its linear closed form, measures moments of the
//! autocorrelation, and determines their response to shear. Input are views of arrays, output are plain structs.
//! The crate reads no files and starts no threads.
//!
//! # A batch
//!
//! ```
#![doc = include_str!("../examples/batch.rs")]
//! ```
//!
//! The ellipticities of a [`Batch`] are not divided by a response: the mean shear of any galaxies is the sum of their
//! ellipticities over the sum of their responses ([`ShearSum`]). PSFs are stars or formulas, one for all galaxies
//! or one per galaxy ([`Psfs`]). Pixels are `f32` or `f64`.
//!
//! # One stamp
//!
//! ```
#![doc = include_str!("../examples/one_stamp.rs")]
//! ```
//!
//! The response of a single galaxy is too noisy to divide by; see [`Measurer::stamp`].
//!
//! # A stream
//!
//! A [`Measurer`] serves all threads. Each thread has a [`Worker`] with its own buffers; measuring a galaxy allocates
//! nothing. A [`Session`] measures one image of any [`StampSource`]: it surveys noise, sky and stars, measures rows in the
//! caller's threads, and warns.
//!
//! For galaxies without an image, the types fix the order: worker, image, PSF, galaxy.
//!
//! # Epochs
//!
//! [`ImageWorker::measure_epochs`] measures a galaxy on several stamps, which a linear configuration combines with
//! inverse-variance weights in each Fourier mode before it measures the shape.
//!
//! # Conventions
//!
//! Stamps are indexed `[y, x]`. e1 > 0 is elongation along +x, e2 > 0 along x = y. With Jacobians
//! ([`StampSource::jacobians`]) shapes are measured on the sky: e1 > 0 is elongation east–west, e2 > 0 along north-west, and
//! the target, window and weight of the linear method are round there. Noise is a standard deviation per
//! pixel in image units. A request that cannot be met is a [`MeasureError`]. A galaxy that cannot be measured has
//! [`Flags`] and no ellipticity.

#![warn(missing_docs, clippy::missing_errors_doc)]

mod calibration;
mod defects;
mod denoise;
mod error;
mod examine;
mod measurement;
mod measurer;
mod method;
mod missing;
mod moments;
mod network;
mod noise;
mod pixels;
mod psf;
mod random;
mod selection;
mod session;
mod shape;
mod sky;
mod spectral;
mod stamp;
#[cfg(test)]
mod testing;
mod transform;
mod warning;

pub use calibration::{MeanShear, MeanShearError, ShearSum, is_significant};
pub use error::{EpochError, INVERTED_PSF, MeasureError};
pub use examine::{EXAMINED_PSFS, Examination, examined_rows};
pub use measurement::{
    Coupling, DefectCounts, Descent, Flag, Flags, Measurement, Observables, PsfShape,
    ResponseMatrix, ShearedCatalogues, ShearedGalaxy, Stop,
};
pub use measurer::{Epoch, ImageNoise, ImageWorker, Measurer, PsfWorker, Steps, Worker};
pub use method::AdaptedSettings;
pub use ndarray;
pub use noise::{NoisePlan, NoiseSurvey, StampNoise, Survey};
pub use pixels::{Pixel, Pixels};
pub use psf::{Oversampling, Psfs, Star, Truncation, average_stars};
pub use selection::{Cut, Quantity, Selected, Selection};
pub use session::{
    ArraySource, Batch, Detector, KnownNoise, Lazy, LazyStamps, MeasuredImage, MeasuredRow,
    OneThread, RowJob, Session, StampRows, StampSource, Threads,
};
pub use shearq_quantities::{
    Distortion, Frame, FunctionalPsf, Jacobian, JacobianError, PsfProfile, Shear,
};
pub use shearq_submissions::{Configuration, ConfigurationError, DetectionMethod, PsfCut};
pub use sky::Sky;
pub use warning::{ExaminedPsfs, PixelFrame, Warning};

/// The parts of a measurement, for benchmarks and simulations. Slices and buffers have to be of the sizes planned.
pub mod parts {
    pub use crate::defects::ExposureDefects;
    pub use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise};
    pub use crate::network::{Network, NetworkScratch, Rule, Step, convolve, psf_factor};
    pub use crate::pixels::frame;
    pub use crate::psf::gaussian_sigma;
    pub use crate::shape::{
        ClippedAcf, ClippedAcfScratch, Moments, Ratio, RoundMoments, TypicalGalaxy,
    };
    pub use crate::spectral::{Lags, Light, ModeNoise, Spectral, SpectralPsf, SpectralScratch};
    pub use crate::transform::HexLattice;
    pub use crate::warning::significant;
}

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
