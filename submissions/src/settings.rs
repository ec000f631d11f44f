//! The settings of a submission, section by section.
//!
//! Each section exists twice: complete, as the pipeline takes it, and partial, as one file of an
//! inheritance chain gives it. One macro writes both, so that a field cannot be forgotten in one.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::name;

/// Declares a section's complete and partial structs, and how one is made of the other.
macro_rules! section {
    ($(#[$doc:meta])* $name:ident, $partial:ident, $key:literal {
        $($(#[$field_doc:meta])* $field:ident: $type:ty,)*
    }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $type,)*
        }

        #[derive(Debug, Clone, Default, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub(crate) struct $partial {
            $($field: Option<$type>,)*
        }

        impl $partial {
            /// `self` where it says something, `base` elsewhere.
            pub(crate) fn over(self, base: Self) -> Self {
                $partial { $($field: self.$field.or(base.$field),)* }
            }

            /// The complete section, or the key that nothing in the chain sets.
            pub(crate) fn complete(self) -> Result<$name, &'static str> {
                Ok($name {
                    $($field: self.$field.ok_or(concat!($key, ".", stringify!($field)))?,)*
                })
            }
        }
    };
}

section! {
    /// The piece of the postage stamp that is worked on.
    Stamp, PartialStamp, "stamp" {
        /// Pixels a side, cut around the stamp's centre; 5 to 64.
        size: usize,
    }
}

section! {
    /// The PSF used to deconvolve.
    Psf, PartialPsf, "psf" {
        /// From star stamps or from the functional form.
        form: PsfForm,
        /// Pixels a side of the PSF stamp; 3 to 48.
        size: usize,
    }
}

section! {
    /// Where the noise level σ of a stamp comes from.
    Noise, PartialNoise, "noise" {
        /// Its source.
        source: NoiseSource,
        /// Width in pixels of the frame at the edge of the full stamp that `border` measures.
        border: usize,
    }
}

section! {
    /// Denoising of the full stamp before it is cut.
    Denoise, PartialDenoise, "denoise" {
        /// Which method, or none.
        method: DenoiseMethod,
        /// Wavelet scales, each twice as coarse as the one before; 1 to 4.
        levels: usize,
        /// Half width in pixels of the window over which a coefficient's signal power is estimated.
        window: usize,
        /// Multiple of the noise variance that is subtracted from that power; 1 is the Wiener filter.
        strength: f64,
    }
}

section! {
    /// The Hopfield network.
    Deconvolution, PartialDeconvolution, "deconvolution" {
        /// How much a neuron changes when it is updated.
        update: Update,
        /// Step c of the adaptive rule (Eq. 10), as `step_scale` reads it.
        step: f64,
        /// What `step` is a multiple of.
        step_scale: StepScale,
        /// Change of a neuron under the constant rule, in units of brightness.
        constant_step: f64,
        /// Tikhonov parameter λ.
        lambda: f64,
        /// Most iterations M.
        max_iterations: usize,
        /// State of the neurons before the first iteration.
        start: Start,
        /// What one unit of brightness is, to which the thresholds (Eq. 9) refer.
        brightness_unit: BrightnessUnit,
        /// The unit is `brightness_unit` divided by this.
        unit_divisor: f64,
        /// σ in pixels of the round Gaussian with which the linear update's result is convolved
        /// before its shape is measured.
        target_sigma: f64,
        /// σ in pixels of the round Gaussian window by which the linear update's result is multiplied.
        window_sigma: f64,
    }
}

section! {
    /// Shape from the autocorrelation of the deconvolved stamp.
    Shape, PartialShape, "shape" {
        /// How lags of the ACF enter its moments.
        weight: AcfWeight,
        /// Share of the ACF's light inside the radius at which it is clipped; above 0, at most 1.
        acf_share: f64,
        /// Scale in pixels of the Moffat weight.
        weight_scale: f64,
        /// Added to the weighted integral of x² + y² by which the moments are divided: px⁴ times the noise
        /// of the ACF at zero lag.
        softening: f64,
        /// Which ellipticity the catalogue reports as e1, e2.
        ellipticity: EllipticityType,
        /// What ellipticities are divided by.
        calibration: Calibration,
    }
}

/// Form of the PSF in the data.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PsfForm {
    /// Star stamps, one per image or one per galaxy.
    Star,
    /// Moffat or Kolmogorov parameters, drawn with the pixel response.
    Functional,
}

/// Source of the noise level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NoiseSource {
    /// Median absolute deviation of the frame at the edge of each stamp.
    Border,
    /// The image header's NOISESIG.
    Header,
}

/// Denoising method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DenoiseMethod {
    /// Raw data.
    None,
    /// Wavelet decomposition and Wiener filtering of the coefficients.
    WaveletWiener,
}

/// Neuron updating rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Update {
    /// Proportional to the energy's gradient (Eq. 10).
    Adaptive,
    /// A constant (Eq. 6).
    Constant,
    /// The adaptive one with Nesterov's momentum: the same energy in fewer iterations.
    Accelerated,
    /// The adaptive one without thresholds (Eq. 9) and clipping (Eq. 12), from zero and on a plane
    /// without boundary: all M iterations in closed form.
    Linear,
}

/// What the adaptive step is a multiple of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StepScale {
    /// 1: c is `step` itself.
    Fixed,
    /// The stamp's brightest pixel in units of brightness: c = `step`·max(u₀).
    Peak,
}

/// First state of the network. All are non-negative: with a negative start the first clipping at
/// zero raises the energy and stops the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Start {
    /// The observed stamp, negative pixels set to zero.
    ClippedData,
    /// The mean of the observed stamp everywhere (zero if it is negative).
    Flat,
    /// Zero everywhere.
    Zero,
}

/// What a unit of brightness is derived from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BrightnessUnit {
    /// The image's own unit.
    Image,
    /// The stamp's noise level.
    Noise,
    /// The stamp's brightest pixel.
    Peak,
}

/// Weight of the ACF's lags.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AcfWeight {
    /// One inside the radius that holds `acf_share` of the light, zero outside (Sect. 3.2).
    Clipped,
    /// A Moffat profile of scale `weight_scale` and of the galaxy's own ellipticity.
    Moffat,
}

/// Calibration of reported ellipticities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Calibration {
    /// None.
    None,
    /// The image's mean response to shear, measured on its own galaxies (metacalibration).
    Response,
}

/// Ellipticity definition of a catalogue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EllipticityType {
    /// χ = (1 − q²)/(1 + q²): the moments' own (Eq. 13).
    Distortion,
    /// ε = (1 − q)/(1 + q): that of shear.
    Shear,
}

/// Every setting of a submission, resolved. Wherever they are read from, they are checked against their
/// ranges.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(remote = "Self", deny_unknown_fields)]
pub struct Submission {
    /// Name, as tables print it.
    pub name: String,
    /// What it is, in a sentence.
    pub description: String,
    /// Stamp size.
    pub stamp: Stamp,
    /// PSF form and size.
    pub psf: Psf,
    /// Noise level.
    pub noise: Noise,
    /// Denoising.
    pub denoise: Denoise,
    /// Deconvolution.
    pub deconvolution: Deconvolution,
    /// Shape measurement.
    pub shape: Shape,
}

impl Serialize for Submission {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // The derived one.
        Submission::serialize(self, serializer)
    }
}

impl<'de> Deserialize<'de> for Submission {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        // The derived one.
        let submission = Submission::deserialize(deserializer)?;
        submission.validate().map_err(serde::de::Error::custom)?;
        Ok(submission)
    }
}

/// The sections of one file, none of which must be complete.
#[derive(Debug, Clone, Default)]
pub(crate) struct PartialSubmission {
    pub(crate) stamp: PartialStamp,
    pub(crate) psf: PartialPsf,
    pub(crate) noise: PartialNoise,
    pub(crate) denoise: PartialDenoise,
    pub(crate) deconvolution: PartialDeconvolution,
    pub(crate) shape: PartialShape,
}

impl PartialSubmission {
    pub(crate) fn over(self, base: Self) -> Self {
        PartialSubmission {
            stamp: self.stamp.over(base.stamp),
            psf: self.psf.over(base.psf),
            noise: self.noise.over(base.noise),
            denoise: self.denoise.over(base.denoise),
            deconvolution: self.deconvolution.over(base.deconvolution),
            shape: self.shape.over(base.shape),
        }
    }

    pub(crate) fn complete(
        self,
        name: String,
        description: String,
    ) -> Result<Submission, &'static str> {
        Ok(Submission {
            name,
            description,
            stamp: self.stamp.complete()?,
            psf: self.psf.complete()?,
            noise: self.noise.complete()?,
            denoise: self.denoise.complete()?,
            deconvolution: self.deconvolution.complete()?,
            shape: self.shape.complete()?,
        })
    }
}

/// Checks a value that others depend on.
fn need(
    good: bool,
    key: &'static str,
    found: &impl Serialize,
    expected: &'static str,
) -> Result<(), OutOfRange> {
    if good {
        return Ok(());
    }
    // As a settings file has it.
    let found = toml::Value::try_from(found).map_or_else(|e| e.to_string(), |v| v.to_string());
    Err(OutOfRange {
        key,
        found,
        expected,
    })
}

/// A value that is out of range.
#[derive(Debug, thiserror::Error)]
#[error("`{key}` is {found}; expected {expected}")]
pub(crate) struct OutOfRange {
    pub(crate) key: &'static str,
    pub(crate) found: String,
    pub(crate) expected: &'static str,
}

impl Submission {
    /// Checks every value against its range.
    pub(crate) fn validate(&self) -> Result<(), OutOfRange> {
        let Submission {
            name,
            description: _,
            stamp,
            psf,
            noise,
            denoise,
            deconvolution: d,
            shape,
        } = self;
        let whole = |key, found: usize, low, high, expected| {
            if (low..=high).contains(&found) {
                Ok(())
            } else {
                Err(OutOfRange {
                    key,
                    found: found.to_string(),
                    expected,
                })
            }
        };
        let real = |key, found: f64, good: bool, expected| {
            if good && found.is_finite() {
                Ok(())
            } else {
                Err(OutOfRange {
                    key,
                    found: found.to_string(),
                    expected,
                })
            }
        };
        if name::check_name(name).is_err() {
            return Err(OutOfRange {
                key: "name",
                found: name::shown(name),
                expected: name::EXPECTED,
            });
        }
        whole("stamp.size", stamp.size, 5, 64, "5 to 64 pixels")?;
        whole("psf.size", psf.size, 3, 48, "3 to 48 pixels")?;
        whole("noise.border", noise.border, 1, 16, "1 to 16 pixels")?;
        whole("denoise.levels", denoise.levels, 1, 4, "1 to 4")?;
        whole("denoise.window", denoise.window, 0, 8, "0 to 8 pixels")?;
        let s = denoise.strength;
        real("denoise.strength", s, s > 0.0, "a positive number")?;
        real(
            "deconvolution.step",
            d.step,
            d.step > 0.0,
            "a positive number",
        )?;
        let c = d.constant_step;
        real(
            "deconvolution.constant_step",
            c,
            c > 0.0,
            "a positive number",
        )?;
        real(
            "deconvolution.lambda",
            d.lambda,
            d.lambda >= 0.0,
            "zero or a positive number",
        )?;
        let most = d.max_iterations;
        whole(
            "deconvolution.max_iterations",
            most,
            1,
            100_000,
            "1 to 100000",
        )?;
        let u = d.unit_divisor;
        real(
            "deconvolution.unit_divisor",
            u,
            u > 0.0,
            "a positive number",
        )?;
        let a = shape.acf_share;
        real(
            "shape.acf_share",
            a,
            a > 0.0 && a <= 1.0,
            "above 0 and at most 1",
        )?;
        let w = shape.weight_scale;
        let fits = (0.5..=10.0).contains(&w);
        real("shape.weight_scale", w, fits, "0.5 to 10 pixels")?;
        let s = shape.softening;
        let fits = (0.0..=1e6).contains(&s);
        real("shape.softening", s, fits, "0 to 1e6")?;
        let t = d.target_sigma;
        let fits = (1.0..=6.0).contains(&t);
        real("deconvolution.target_sigma", t, fits, "1 to 6 pixels")?;
        let w = d.window_sigma;
        let fits = (2.0..=16.0).contains(&w);
        real("deconvolution.window_sigma", w, fits, "2 to 16 pixels")?;
        self.validate_linear()
    }

    /// What the linear update and the Moffat weight, which come together, allow.
    fn validate_linear(&self) -> Result<(), OutOfRange> {
        let Submission {
            stamp,
            psf,
            denoise,
            deconvolution: d,
            shape,
            ..
        } = self;
        let linear = d.update == Update::Linear;
        let weighted = shape.weight == AcfWeight::Moffat;
        need(
            linear == weighted,
            "shape.weight",
            &shape.weight,
            "\"moffat\" with the linear update, \"clipped\" with the others",
        )?;
        need(
            linear || shape.calibration == Calibration::None,
            "shape.calibration",
            &shape.calibration,
            "\"none\": the response is known for the linear update alone",
        )?;
        if !linear {
            return Ok(());
        }
        need(
            denoise.method == DenoiseMethod::None,
            "denoise.method",
            &denoise.method,
            "\"none\" with the linear update, which has to know the noise",
        )?;
        need(
            d.step_scale == StepScale::Fixed,
            "deconvolution.step_scale",
            &d.step_scale,
            "\"fixed\" with the linear update",
        )?;
        // The largest eigenvalue of W is 1 for a PSF of sum one, and 0.0093 λ that of its other term
        // (Sun's kernel has a transform of −0.096 at most).
        need(
            d.step * (1.0 + 0.0093 * d.lambda) < 2.0,
            "deconvolution.step",
            &d.step,
            "step·(1 + 0.0093 lambda) below 2 with the linear update, which diverges beyond",
        )?;
        // Lags are up to 0.95 target_sigma apart; of a sharper weight their sums depend on where they lie.
        need(
            shape.weight_scale >= d.target_sigma,
            "shape.weight_scale",
            &shape.weight_scale,
            "at least deconvolution.target_sigma",
        )?;
        need(
            stamp.size % 2 == psf.size % 2,
            "psf.size",
            &psf.size,
            "even with an even stamp.size and odd with an odd one, with the linear update, whose window is centred on the stamp",
        )?;
        // Noise beyond the stamp's edges, which its level is subtracted for, is 1 % of the window's.
        need(
            4.0 * d.window_sigma <= stamp.size as f64,
            "deconvolution.window_sigma",
            &d.window_sigma,
            "at most a quarter of stamp.size with the linear update",
        )
    }
}
