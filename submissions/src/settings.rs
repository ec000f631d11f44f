//! The settings of a configuration, section by section. Each is declared here once: its key, its type, its meaning and
//! its range.

use std::fmt::Display;
use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize, Serializer};
use toml::Table;

use crate::error::OutOfRange;
use crate::name::{EXPECTED, check_name, shown};

/// Limits that the arithmetic of the measurement sets to settings.
pub mod limits {
    use std::ops::RangeInclusive;

    /// Largest side of what is cut of a stamp, in pixels.
    pub const MAX_CUT: usize = 64;
    /// Largest side of a PSF stamp, in pixels.
    pub const MAX_PSF: usize = 48;
    /// Pixels a side of the smallest PSF stamps that the linear method takes where its settings ask for more.
    // Smaller ones lose too much of the wings: of a Moffat profile of FWHM 3.4 px, m changes by 0.002 at 20 px and by
    // 0.01 at 16 px.
    pub const MIN_PSF: usize = 32;
    /// Narrowest target of the linear method, in pixels.
    // Chosen by hand, as is the broadest.
    pub const MIN_TARGET: f64 = 1.0;
    /// Broadest target of the linear method, in pixels.
    pub const MAX_TARGET: f64 = 6.0;
    /// Windows of the linear method: σ in pixels.
    pub const WINDOWS: RangeInclusive<f64> = 2.0..=16.0;
    /// Largest eigenvalue of G = DᵀD, D being Sun's high-pass (Sect. 3.1), rounded up: the square of the kernel's
    /// transform where that is largest.
    pub const MAX_ROUGHNESS: f64 = 0.0093;
}
use limits::{MAX_CUT, MAX_PSF, MAX_ROUGHNESS, MAX_TARGET, MIN_PSF, MIN_TARGET, WINDOWS};

// Callers write the condition for good values, not for bad ones: comparisons with NaN are false, so NaN is refused.
fn require(
    good: bool,
    key: &'static str,
    found: impl Serialize,
    expected: impl Into<String>,
) -> Result<(), OutOfRange> {
    if good {
        return Ok(());
    }
    // In TOML, so that the message shows the value as the user wrote it.
    let found = toml::Value::try_from(found).map_or_else(|e| e.to_string(), |v| v.to_string());
    Err(OutOfRange {
        key,
        found,
        expected: expected.into(),
    })
}

fn within<T: PartialOrd + Display + Serialize>(
    key: &'static str,
    found: T,
    range: RangeInclusive<T>,
    unit: &str,
) -> Result<(), OutOfRange> {
    let expected = format!("{} to {}{unit}", range.start(), range.end());
    require(range.contains(&found), key, found, expected)
}

// Zero turns these settings off, not an absent key: a configuration states every setting of its method, so that an absent key
// is an error.
fn zero_or_within(
    key: &'static str,
    found: f64,
    range: RangeInclusive<f64>,
    unit: &str,
) -> Result<(), OutOfRange> {
    let good = found == 0.0 || range.contains(&found);
    let expected = format!("0, or {} to {}{unit}", range.start(), range.end());
    require(good, key, found, expected)
}

fn positive(key: &'static str, found: f64) -> Result<(), OutOfRange> {
    let good = found > 0.0 && found.is_finite();
    require(good, key, found, "a positive number")
}

/// The piece of the postage stamp that is worked on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stamp {
    /// Pixels a side, cut around the stamp's centre; 5 to 64.
    pub size: usize,
}

impl Stamp {
    fn validate(&self) -> Result<(), OutOfRange> {
        within("stamp.size", self.size, 5..=MAX_CUT, " pixels")
    }
}

/// The PSF used to deconvolve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Psf {
    /// From star stamps or from the functional form.
    pub form: PsfForm,
    /// Pixels a side of the PSF stamp; 3 to 48. With the linear method stamps may have fewer, from 32 on.
    pub size: usize,
}

impl Psf {
    fn validate(&self) -> Result<(), OutOfRange> {
        within("psf.size", self.size, 3..=MAX_PSF, " pixels")
    }
}

/// Where the noise of a stamp is known from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "source", rename_all = "kebab-case")]
pub enum NoiseSource {
    /// Median absolute deviation of the frame at the edge of each stamp.
    Border {
        /// Width of that frame of the full stamp, in pixels.
        border: usize,
    },
    /// The image header's NOISESIG.
    Header,
    /// The frames of many of the image's stamps: the level, and how pixels are correlated.
    Image {
        /// Largest distance in pixels, along each axis, of pixels that may be correlated; 0 for white noise.
        correlation: usize,
        /// From where the sky that is subtracted is known.
        #[serde(default)]
        sky: SkySource,
    },
}

/// What is subtracted from stamps before they are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SkySource {
    /// A plane that all stamps of the image have in common, if it is significant and matters.
    #[default]
    Image,
    /// A plane per stamp, fitted to the stamp's own border.
    Stamp,
    /// Nothing.
    None,
}

impl NoiseSource {
    /// From where the sky is known; `None` if the configuration does not measure the noise of images.
    pub fn sky(&self) -> Option<SkySource> {
        match self {
            NoiseSource::Image { sky, .. } => Some(*sky),
            NoiseSource::Border { .. } | NoiseSource::Header => None,
        }
    }

    fn validate(&self) -> Result<(), OutOfRange> {
        match *self {
            NoiseSource::Border { border } => within("noise.border", border, 1..=16, " pixels"),
            NoiseSource::Header => Ok(()),
            NoiseSource::Image { correlation, .. } => {
                within("noise.correlation", correlation, 0..=4, " pixels")
            }
        }
    }
}

/// Denoising of the full stamp before it is cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "method", rename_all = "kebab-case")]
pub enum Denoise {
    /// Raw data.
    None,
    /// Wavelet decomposition and Wiener filtering of the coefficients.
    WaveletWiener(Wavelet),
}

/// Settings of the Wiener filter of wavelet coefficients.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Wavelet {
    /// Wavelet scales, each twice as coarse as the one before; 1 to 4.
    pub levels: usize,
    /// Half width in pixels of the window over which a coefficient's signal power is estimated.
    pub window: usize,
    /// Multiple of the noise variance that is subtracted from that power; 1 is the Wiener filter.
    pub strength: f64,
}

impl Wavelet {
    fn validate(&self) -> Result<(), OutOfRange> {
        within("denoise.levels", self.levels, 1..=4, "")?;
        within("denoise.window", self.window, 0..=8, " pixels")?;
        positive("denoise.strength", self.strength)
    }
}

fn validate_rule(step: f64, lambda: f64, max_iterations: usize) -> Result<(), OutOfRange> {
    positive("deconvolution.step", step)?;
    let good = lambda >= 0.0 && lambda.is_finite();
    let expected = "zero or a positive number";
    require(good, "deconvolution.lambda", lambda, expected)?;
    let key = "deconvolution.max_iterations";
    within(key, max_iterations, 1..=100_000, "")
}

/// The Hopfield network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkDeconvolution {
    /// How much a neuron changes when it is updated.
    pub update: Update,
    /// Step c of the adaptive rule (Eq. 12), as `step_scale` reads it.
    pub step: f64,
    /// What `step` is a multiple of.
    pub step_scale: StepScale,
    /// Change of a neuron under the constant rule, in units of brightness. The calibration of λ
    /// works with both rules.
    pub constant_step: f64,
    /// Tikhonov parameter λ.
    pub lambda: f64,
    /// Most iterations M.
    pub max_iterations: usize,
    /// State of the neurons before the first iteration.
    pub start: Start,
    /// When negative neurons are set to zero (Eq. 14).
    pub clipping: Clipping,
    /// Which state is kept where the energy rises.
    pub kept: Kept,
    /// What one unit of brightness is, to which the thresholds (Eq. 11) refer.
    pub brightness_unit: BrightnessUnit,
    /// The unit is `brightness_unit` divided by this.
    pub unit_divisor: f64,
    /// What the PSF is divided by before H is made of it.
    pub psf_scale: PsfScale,
    /// Divisor of the high-pass kernel d (Sect. 3.1), printed as 100. λ acts through G = DᵀD, so that
    /// a divisor of 1 moves its axis by 10⁴, and one of 0.1, that of `paper`, by 10⁶.
    pub high_pass_divisor: f64,
}

impl NetworkDeconvolution {
    /// The λ that has with the printed d, divided by 100, the effect of `lambda` with this one.
    pub fn printed_lambda(&self, lambda: f64) -> f64 {
        lambda * (PRINTED_DIVISOR / self.high_pass_divisor).powi(2)
    }

    fn validate(&self) -> Result<(), OutOfRange> {
        validate_rule(self.step, self.lambda, self.max_iterations)?;
        positive("deconvolution.constant_step", self.constant_step)?;
        positive("deconvolution.unit_divisor", self.unit_divisor)?;
        let (key, divisor) = ("deconvolution.high_pass_divisor", self.high_pass_divisor);
        within(key, divisor, 1e-3..=1e6, "")?;
        // Nesterov's momentum continues from a second, extrapolated state, which `after-test` would not clip.
        require(
            !(self.clipping == Clipping::AfterTest && self.update == Update::Accelerated),
            "deconvolution.clipping",
            self.clipping,
            "\"before-test\" or \"never\" with update = \"accelerated\"",
        )
    }
}

/// Divisor of d as Sect. 3.1 prints it.
const PRINTED_DIVISOR: f64 = 100.0;

/// The linear network: the adaptive rule without thresholds (Eq. 11) and clipping (Eq. 14), from zero
/// and on a plane without boundary, all M iterations in closed form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinearDeconvolution {
    /// Step c of the adaptive rule (Eq. 12).
    pub step: f64,
    /// Tikhonov parameter λ.
    pub lambda: f64,
    /// Iterations M.
    pub max_iterations: usize,
    /// σ in pixels of the round Gaussian with which the result is convolved before its shape is
    /// measured.
    pub target_sigma: f64,
    /// σ in pixels of the round Gaussian window by which the result is multiplied.
    pub window_sigma: f64,
    /// Variance per axis in px² of the galaxies' light, without the PSF's, for which `window_sigma` holds. If it is
    /// measured on the images, the window scales with it; zero keeps one window for all.
    pub reference_extent: f64,
    /// Noise-equivalent area 1/Σp² in px² of the PSF for which `target_sigma` and `weight_scale` hold. They grow with broader
    /// PSFs, and shrink with PSFs below half of that area. Zero keeps them for all PSFs.
    pub reference_area: f64,
}

impl LinearDeconvolution {
    fn validate(&self) -> Result<(), OutOfRange> {
        validate_rule(self.step, self.lambda, self.max_iterations)?;
        let (key, target) = ("deconvolution.target_sigma", self.target_sigma);
        within(key, target, MIN_TARGET..=MAX_TARGET, " pixels")?;
        let (key, window) = ("deconvolution.window_sigma", self.window_sigma);
        within(key, window, WINDOWS, " pixels")?;
        let (key, extent) = ("deconvolution.reference_extent", self.reference_extent);
        zero_or_within(key, extent, 0.1..=1e3, " px²")?;
        let (key, area) = ("deconvolution.reference_area", self.reference_area);
        zero_or_within(key, area, 1.0..=1e4, " px²")?;
        // The largest eigenvalue of W is 1 for a PSF of sum one.
        require(
            self.step * (1.0 + MAX_ROUGHNESS * self.lambda) < 2.0,
            "deconvolution.step",
            self.step,
            "step·(1 + 0.0093 lambda) below 2 with the linear method, which diverges beyond",
        )
    }
}

/// Shape from the autocorrelation of the deconvolved stamp, clipped at a radius (Sect. 3.2).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClippedShape {
    /// What the autocorrelation takes to lie outside the stamp.
    pub acf: AcfKind,
    /// What is subtracted before the light is counted.
    pub background: Background,
    /// Share of the ACF's light inside the radius at which it is clipped; above 0, at most 1.
    pub acf_share: f64,
    /// What it is a share of.
    pub share_of: ShareOf,
    /// Which ellipticity the catalogue reports as e1, e2.
    pub ellipticity: EllipticityType,
}

impl ClippedShape {
    fn validate(&self) -> Result<(), OutOfRange> {
        let good = self.acf_share > 0.0 && self.acf_share <= 1.0;
        let expected = "above 0 and at most 1";
        require(good, "shape.acf_share", self.acf_share, expected)
    }
}

/// Shape from the autocorrelation of the deconvolved stamp, under a round Moffat weight.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WeightedShape {
    /// Scale in pixels of the Moffat weight.
    pub weight_scale: f64,
    /// Matched-filter S/N ν₀ at which the regularisation halves the ellipticity of a round Gaussian galaxy of the size that the
    /// window in use is for (`reference_extent` at the configured window): e is weighted by ν²/(ν² + ν₀²), because noisier galaxies deserve less weight. Zero for no regularisation.
    pub half_snr: f64,
    /// What a shear leaves in its place.
    #[serde(default)]
    pub origin: ShearOrigin,
    /// Modulus a: an ellipticity e is reported as e/√(1 + |e|²/a²), because galaxies of large ellipticity tell less of the
    /// shear. Zero to report e.
    #[serde(default)]
    pub saturation: f64,
    /// Shear of the sheared catalogues (`1p`, `1m`, `2p`, `2m`): further columns of ellipticity, S/N, flux and size. Zero
    /// for none.
    pub sheared_step: f64,
    /// What ellipticities are divided by.
    pub calibration: Calibration,
}

impl WeightedShape {
    fn validate(&self) -> Result<(), OutOfRange> {
        let (scale, half) = (self.weight_scale, self.half_snr);
        within("shape.weight_scale", scale, 0.5..=10.0, " pixels")?;
        within("shape.half_snr", half, 0.0..=1e3, "")?;
        zero_or_within("shape.saturation", self.saturation, 0.05..=1.0, "")?;
        let (key, step) = ("shape.sheared_step", self.sheared_step);
        zero_or_within(key, step, 1e-3..=0.05, "")
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

/// Neuron updating rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Update {
    /// Proportional to the energy's gradient (Eq. 12).
    Adaptive,
    /// A constant (Eq. 6).
    Constant,
    /// The adaptive one with Nesterov's momentum: the same energy in fewer iterations.
    Accelerated,
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

/// First state of the network. All but the first are non-negative.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Start {
    /// The observed stamp as it is, as "X(0) = Y" (Sect. 3.1) says. Where it has negative pixels, the first
    /// clipping at zero raises the energy and stops the network.
    Data,
    /// The observed stamp, negative pixels set to zero.
    ClippedData,
    /// The mean of the observed stamp everywhere (zero if it is negative).
    Flat,
    /// Zero everywhere.
    Zero,
}

/// When neurons below zero are set to zero (Eq. 14).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Clipping {
    /// Before the energy is compared, in the order of steps 4 and 5 of Sect. 3.1.
    BeforeTest,
    /// After it: the energy of the update as it is has to be lower than that of the state before, which has
    /// been clipped.
    AfterTest,
    /// Not at all.
    Never,
}

/// Which state is kept where an update raises the energy and the network stops ("otherwise break the
/// iteration loop", step 5 of Sect. 3.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kept {
    /// The last of falling energy.
    Lowest,
    /// The one that raised it, as a loop leaves its variable.
    Last,
}

/// What the PSF is divided by. The paper has "known PSF image" (Sect. 2.1) and no more. Thresholds, c and λ
/// refer to W = HᵀH, which a PSF of peak one makes some three hundred times larger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PsfScale {
    /// Its sum.
    Sum,
    /// Its brightest pixel.
    Peak,
}

/// What the autocorrelation takes to lie outside the n×n pixels of the stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AcfKind {
    /// Zero: lags up to n − 1.
    Full,
    /// The stamp again, as a transform without padding has it: lags up to n/2.
    Circular,
}

/// What is subtracted before the ACF's light is counted. The paper speaks of "the total light" (Sect. 3.2) and
/// of no background; the pedestal of noise clipped at zero takes half of that light at S/N 20.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Background {
    /// Nothing.
    None,
    /// From the ACF, the mean of its outermost lags.
    AcfEdge,
    /// From the deconvolved stamp, the mean of the 3 px frame at its edge.
    StampFrame,
}

/// What light the share of the ACF refers to (Sect. 3.2: "the radius that encloses 90 % of the total light").
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ShareOf {
    /// The sum over all lags.
    Total,
    /// The most that any radius encloses, which is more where a background was subtracted.
    Maximum,
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

/// Calibration of reported ellipticities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Calibration {
    /// None.
    None,
    /// The image's mean response to shear, measured on its own galaxies (metacalibration).
    Response,
}

/// The place that a shear of the galaxy leaves where it is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ShearOrigin {
    /// The middle of the stamp, or the stated place of the galaxy.
    #[default]
    Stamp,
    /// The galaxy's centroid as far as noise allows, on single stamps.
    Centroid,
}

/// Ellipticity definition of a catalogue.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EllipticityType {
    /// χ = (1 − q²)/(1 + q²): the moments' own (Eq. 15).
    Distortion,
    /// ε = (1 − q)/(1 + q): that of shear.
    #[default]
    Shear,
}

/// Every setting of a configuration, resolved: those that its method uses and no others. Wherever they are read
/// from, they are checked against their ranges.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(remote = "Self")]
pub struct Configuration {
    /// Name, as tables print it.
    pub name: String,
    /// What it is, in a sentence.
    pub description: String,
    /// Stamp size.
    pub stamp: Stamp,
    /// PSF form and size.
    pub psf: Psf,
    /// Noise level.
    pub noise: NoiseSource,
    /// The way from a stamp to an ellipticity.
    #[serde(flatten)]
    pub method: Method,
}

/// A method with its settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "method", rename_all = "kebab-case")]
pub enum Method {
    /// The Hopfield network of the paper.
    Network(NetworkMethod),
    /// Its linear part in closed form, calibrated by its own response to shear.
    Linear(LinearMethod),
    /// Detection on exposures with its response, which has no stamps.
    Detection {
        /// Its settings.
        detection: DetectionMethod,
    },
}

/// Settings of the network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NetworkMethod {
    /// Denoising.
    pub denoise: Denoise,
    /// Deconvolution.
    pub deconvolution: NetworkDeconvolution,
    /// Shape measurement.
    pub shape: ClippedShape,
}

/// Settings of detection. Lengths are in units of the PSF's σ: that of the Gaussian with the same noise-equivalent area.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DetectionMethod {
    /// S/N of the smoothed light at which a pixel has half of its weight.
    pub threshold: f64,
    /// Half width of that step, in S/N.
    pub threshold_half_width: f64,
    /// σ of the Gaussian that smooths the deconvolved image for detection.
    pub detection_sigma: f64,
    /// Distance of the four neighbours that a pixel is compared with, rounded to whole pixels.
    pub neighbour_distance: f64,
    /// Half width of the steps of these differences: standard deviations of their noise …
    pub neighbour_half_width: f64,
    /// … plus this share of the smoothed light. Without it single pixels of bright galaxies dominate the response.
    pub neighbour_share: f64,
    /// σ of the Gaussian under which moments are taken.
    pub moment_sigma: f64,
    /// What is added to the light that moments are divided by, in standard deviations of its noise.
    pub softening: f64,
}

impl Default for DetectionMethod {
    // From 1 to 8 scenes of 20 arcmin² with the default population of `simulate --scenes`, seed 101, in eight versions. The shear error
    // per area is the same at a moment_sigma of 1.4, 3 % larger at 1.6 and 8 % at 1.8; 5 % smaller at a threshold of 5 than at 7, with
    // twice the pixels; and the same at a neighbour_share of 0.15, 0.2 and 0.3, which narrow the edges of galaxies to less than a
    // pixel or leave bright ones more pixels. The others are those of the first prototype; 0.8 to 1.2 times them, or softening from 8
    // to 30, change the error by 3 %.
    fn default() -> Self {
        DetectionMethod {
            threshold: 6.0,
            threshold_half_width: 2.0,
            detection_sigma: 1.2,
            neighbour_distance: 1.9,
            neighbour_half_width: 1.0,
            neighbour_share: 0.2,
            moment_sigma: 1.6,
            softening: 15.0,
        }
    }
}

impl DetectionMethod {
    /// Checks every setting against its range.
    ///
    /// # Errors
    /// The first setting that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        let ranges = [
            ("detection.threshold", self.threshold, 3.0..=1e4),
            (
                "detection.threshold_half_width",
                self.threshold_half_width,
                0.5..=1e3,
            ),
            ("detection.detection_sigma", self.detection_sigma, 0.8..=4.0),
            (
                "detection.neighbour_distance",
                self.neighbour_distance,
                0.5..=6.0,
            ),
            (
                "detection.neighbour_half_width",
                self.neighbour_half_width,
                0.2..=10.0,
            ),
            ("detection.neighbour_share", self.neighbour_share, 0.0..=1.0),
            ("detection.moment_sigma", self.moment_sigma, 1.0..=6.0),
            ("detection.softening", self.softening, 1.0..=1e9),
        ];
        for (key, found, range) in ranges {
            within(key, found, range, "")?;
        }
        require(
            self.threshold > self.threshold_half_width,
            "detection.threshold",
            self.threshold,
            "more than detection.threshold_half_width",
        )
    }
}

/// Settings of the linear network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinearMethod {
    /// Deconvolution.
    pub deconvolution: LinearDeconvolution,
    /// Shape measurement.
    pub shape: WeightedShape,
}

impl LinearMethod {
    /// Checks the settings for stamps of `n` pixels a side and PSFs of `p`.
    fn validate(&self, n: usize, p: usize) -> Result<(), OutOfRange> {
        self.deconvolution.validate()?;
        self.shape.validate()?;
        // Lags are up to 0.95 target_sigma apart. A narrower weight is not sampled finely enough: its sums depend on the phase
        // of the lags.
        let scale = self.shape.weight_scale;
        require(
            scale >= self.deconvolution.target_sigma,
            "shape.weight_scale",
            scale,
            "at least deconvolution.target_sigma",
        )?;
        require(
            n % 2 == p % 2,
            "psf.size",
            p,
            "even with an even stamp.size and odd with an odd one, with the linear method, whose window is centred on the stamp",
        )?;
        // A wider window reaches beyond the stamp, and includes light that the periodic transform wraps around.
        let window = self.deconvolution.window_sigma;
        require(
            4.0 * window <= n as f64,
            "deconvolution.window_sigma",
            window,
            "at most a quarter of stamp.size with the linear method",
        )
    }
}

impl Serialize for Configuration {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // The derived function: `remote` makes it one of the type, so that reading can check the keys.
        Configuration::serialize(self, serializer)
    }
}

impl Configuration {
    // The derived reader. It ignores unused keys, which `registry` checks with the file and the line.
    pub(crate) fn from_table(table: Table) -> Result<Self, toml::de::Error> {
        Configuration::deserialize(table)
    }

    /// Checks every setting against its range, and against the settings that it must agree with.
    ///
    /// Files are checked when they are read. A configuration that is made or changed in code is checked here.
    ///
    /// # Errors
    /// The first setting that is out of range.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        if check_name(&self.name).is_err() {
            return Err(OutOfRange {
                key: "name",
                found: shown(&self.name),
                expected: EXPECTED.into(),
            });
        }
        self.stamp.validate()?;
        self.psf.validate()?;
        self.noise.validate()?;
        match &self.method {
            Method::Network(network) => {
                if let Denoise::WaveletWiener(wavelet) = &network.denoise {
                    wavelet.validate()?;
                }
                network.deconvolution.validate()?;
                network.shape.validate()
            }
            Method::Linear(linear) => linear.validate(self.stamp.size, self.psf.size),
            Method::Detection { detection } => detection.validate(),
        }
    }
}

/// How much of a PSF is cut around its middle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PsfCut {
    /// Pixels a side.
    pub size: usize,
    /// Pixels a side of the smallest usable stamp, which is not cut; of the parity of `size`.
    pub least: usize,
    /// Whether the PSF must be centred on these pixels: stars on stamps of the other parity are then shifted by half a pixel.
    /// The network does not need it, because an autocorrelation does not change with a shift.
    pub centred: bool,
}

impl From<usize> for PsfCut {
    fn from(size: usize) -> Self {
        PsfCut {
            size,
            least: size,
            centred: false,
        }
    }
}

impl Configuration {
    /// How much of a PSF is taken.
    pub fn psf_cut(&self) -> PsfCut {
        let size = self.psf.size;
        if self.linear().is_none() {
            return size.into();
        }
        let least = size.min(MIN_PSF);
        PsfCut {
            size,
            least: least - (size - least) % 2,
            centred: true,
        }
    }

    /// The network's settings; `None` for other methods.
    pub fn network(&self) -> Option<&NetworkMethod> {
        match &self.method {
            Method::Network(network) => Some(network),
            Method::Linear(_) | Method::Detection { .. } => None,
        }
    }

    /// The linear network's settings; `None` for other methods.
    pub fn linear(&self) -> Option<&LinearMethod> {
        match &self.method {
            Method::Network(_) | Method::Detection { .. } => None,
            Method::Linear(linear) => Some(linear),
        }
    }

    /// How stamps are denoised; `None` where they are not.
    pub fn wavelet(&self) -> Option<&Wavelet> {
        match &self.network()?.denoise {
            Denoise::None => None,
            Denoise::WaveletWiener(wavelet) => Some(wavelet),
        }
    }

    /// Type of the reported ellipticity. That of the linear method is no function of the axis ratio, but its typical response is
    /// that of ε.
    pub fn ellipticity(&self) -> EllipticityType {
        match &self.method {
            Method::Network(network) => network.shape.ellipticity,
            Method::Linear(_) | Method::Detection { .. } => EllipticityType::Shear,
        }
    }

    /// Whether galaxies are detected on exposures, so that responses contain that of the detection.
    pub fn is_detection(&self) -> bool {
        matches!(self.method, Method::Detection { .. })
    }

    /// What ellipticities are divided by. The network's response is not known.
    pub fn calibration(&self) -> Calibration {
        match &self.method {
            Method::Network(_) => Calibration::None,
            Method::Linear(linear) => linear.shape.calibration,
            Method::Detection { .. } => Calibration::Response,
        }
    }
}
