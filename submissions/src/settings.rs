//! The settings of a submission, section by section.
//!
//! A section of a file may hold any key of any method, or none: it is partial. The complete sections, as
//! a measurement takes them, hold what their method uses and no more. One macro writes how these are made
//! of those, so that a key cannot be forgotten in one.

use serde::{Deserialize, Serialize};

use crate::limits::LEAST_PSF;

/// Declares a section as one file of an inheritance chain gives it.
macro_rules! partial {
    ($name:ident { $($field:ident: $type:ty,)* }) => {
        #[derive(Debug, Clone, Default, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub(crate) struct $name {
            $($field: Option<$type>,)*
        }

        impl $name {
            /// `self` where it says something, `base` elsewhere.
            fn over(self, base: Self) -> Self {
                $name { $($field: self.$field.or(base.$field),)* }
            }
        }
    };
}

/// Declares a complete section, and how it is made of a partial one: of those of its keys that it uses.
macro_rules! section {
    ($(#[$doc:meta])* $name:ident, $partial:ident, $key:literal {
        $($(#[$field_doc:meta])* $field:ident: $type:ty,)*
    }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $type,)*
        }

        impl $name {
            /// The complete section, or the key that nothing in the chain sets.
            fn of(partial: &$partial) -> Result<Self, &'static str> {
                Ok($name {
                    $($field: partial.$field.ok_or(concat!($key, ".", stringify!($field)))?,)*
                })
            }
        }
    };
}

partial! { PartialStamp { size: usize, } }

section! {
    /// The piece of the postage stamp that is worked on.
    Stamp, PartialStamp, "stamp" {
        /// Pixels a side, cut around the stamp's centre; 5 to 64.
        size: usize,
    }
}

partial! { PartialPsf { form: PsfForm, size: usize, } }

section! {
    /// The PSF used to deconvolve.
    Psf, PartialPsf, "psf" {
        /// From star stamps or from the functional form.
        form: PsfForm,
        /// Pixels a side of the PSF stamp; 3 to 48. With the linear method stamps may have fewer, from 32 on.
        size: usize,
    }
}

partial! { PartialNoise { source: Source, border: usize, correlation: usize, sky: SkySource, } }

/// Where the noise of a stamp is known from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
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
        sky: SkySource,
    },
}

/// What is subtracted from stamps before they are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SkySource {
    /// A plane that all stamps of the image have in common, if it is significant and matters.
    Image,
    /// A plane per stamp, fitted to the stamp's own border.
    Stamp,
    /// Nothing.
    None,
}

/// [`NoiseSource`] as a file names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Source {
    Border,
    Header,
    Image,
}

impl NoiseSource {
    /// From where the sky is known; `None` if the configuration does not measure the noise of images.
    pub fn sky(&self) -> Option<SkySource> {
        match self {
            NoiseSource::Image { sky, .. } => Some(*sky),
            NoiseSource::Border { .. } | NoiseSource::Header => None,
        }
    }

    fn of(partial: &PartialNoise) -> Result<Self, &'static str> {
        Ok(match partial.source.ok_or("noise.source")? {
            Source::Border => NoiseSource::Border {
                border: partial.border.ok_or("noise.border")?,
            },
            Source::Header => NoiseSource::Header,
            Source::Image => NoiseSource::Image {
                correlation: partial.correlation.ok_or("noise.correlation")?,
                sky: partial.sky.unwrap_or(SkySource::Image),
            },
        })
    }
}

partial! {
    PartialDenoise {
        method: Filter,
        levels: usize,
        window: usize,
        strength: f64,
    }
}

/// Denoising of the full stamp before it is cut.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "method", rename_all = "kebab-case")]
pub enum Denoise {
    /// Raw data.
    None,
    /// Wavelet decomposition and Wiener filtering of the coefficients.
    WaveletWiener(Wavelet),
}

/// [`Denoise`] as a file names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Filter {
    None,
    WaveletWiener,
}

section! {
    /// Settings of the Wiener filter of wavelet coefficients.
    Wavelet, PartialDenoise, "denoise" {
        /// Wavelet scales, each twice as coarse as the one before; 1 to 4.
        levels: usize,
        /// Half width in pixels of the window over which a coefficient's signal power is estimated.
        window: usize,
        /// Multiple of the noise variance that is subtracted from that power; 1 is the Wiener filter.
        strength: f64,
    }
}

impl Denoise {
    fn of(partial: &PartialDenoise) -> Result<Self, &'static str> {
        Ok(match partial.method.ok_or("denoise.method")? {
            Filter::None => Denoise::None,
            Filter::WaveletWiener => Denoise::WaveletWiener(Wavelet::of(partial)?),
        })
    }
}

partial! {
    PartialDeconvolution {
        update: Update,
        step: f64,
        step_scale: StepScale,
        constant_step: f64,
        lambda: f64,
        max_iterations: usize,
        start: Start,
        clipping: Clipping,
        kept: Kept,
        brightness_unit: BrightnessUnit,
        unit_divisor: f64,
        psf_scale: PsfScale,
        high_pass_divisor: f64,
        target_sigma: f64,
        window_sigma: f64,
        reference_extent: f64,
        reference_area: f64,
    }
}

section! {
    /// The Hopfield network.
    NetworkDeconvolution, PartialDeconvolution, "deconvolution" {
        /// How much a neuron changes when it is updated.
        update: Update,
        /// Step c of the adaptive rule (Eq. 10), as `step_scale` reads it.
        step: f64,
        /// What `step` is a multiple of.
        step_scale: StepScale,
        /// Change of a neuron under the constant rule, in units of brightness. The calibration of λ
        /// works with both rules.
        constant_step: f64,
        /// Tikhonov parameter λ.
        lambda: f64,
        /// Most iterations M.
        max_iterations: usize,
        /// State of the neurons before the first iteration.
        start: Start,
        /// When negative neurons are set to zero (Eq. 12).
        clipping: Clipping,
        /// Which state is kept where the energy rises.
        kept: Kept,
        /// What one unit of brightness is, to which the thresholds (Eq. 9) refer.
        brightness_unit: BrightnessUnit,
        /// The unit is `brightness_unit` divided by this.
        unit_divisor: f64,
        /// What the PSF is divided by before H is made of it.
        psf_scale: PsfScale,
        /// Divisor of the high-pass kernel d (Sect. 3.1), printed as 100. λ acts through G = DᵀD, so that
        /// a divisor of 1 moves its axis by 10⁴.
        high_pass_divisor: f64,
    }
}

impl NetworkDeconvolution {
    /// The λ that has with the printed d, divided by 100, the effect of `lambda` with this one.
    pub fn printed_lambda(&self, lambda: f64) -> f64 {
        lambda * (PRINTED_DIVISOR / self.high_pass_divisor).powi(2)
    }
}

/// Divisor of d as Sect. 3.1 prints it.
const PRINTED_DIVISOR: f64 = 100.0;

section! {
    /// The linear network: the adaptive rule without thresholds (Eq. 9) and clipping (Eq. 12), from zero
    /// and on a plane without boundary, all M iterations in closed form.
    LinearDeconvolution, PartialDeconvolution, "deconvolution" {
        /// Step c of the adaptive rule (Eq. 10).
        step: f64,
        /// Tikhonov parameter λ.
        lambda: f64,
        /// Iterations M.
        max_iterations: usize,
        /// σ in pixels of the round Gaussian with which the result is convolved before its shape is
        /// measured.
        target_sigma: f64,
        /// σ in pixels of the round Gaussian window by which the result is multiplied.
        window_sigma: f64,
        /// Mean square per axis of the galaxies' radii, in px² and without the PSF's, that the window is for. Where it is
        /// measured with the noise, those of images with broader or narrower galaxies are wider or narrower; zero for
        /// the same window on all.
        reference_extent: f64,
        /// Noise-equivalent area 1/Σp² in px² of the PSF that lengths are for. For a broader one target and weight are
        /// longer; for one below half of it they are shorter. Zero for the same with all PSFs.
        reference_area: f64,
    }
}

partial! {
    PartialShape {
        acf: AcfKind,
        background: Background,
        acf_share: f64,
        share_of: ShareOf,
        weight_scale: f64,
        half_snr: f64,
        sheared_step: f64,
        neighbours: Neighbours,
        ellipticity: EllipticityType,
        calibration: Calibration,
    }
}

section! {
    /// Shape from the autocorrelation of the deconvolved stamp, clipped at a radius (Sect. 3.2).
    ClippedShape, PartialShape, "shape" {
        /// What the autocorrelation takes to lie outside the stamp.
        acf: AcfKind,
        /// What is subtracted before the light is counted.
        background: Background,
        /// Share of the ACF's light inside the radius at which it is clipped; above 0, at most 1.
        acf_share: f64,
        /// What it is a share of.
        share_of: ShareOf,
        /// Which ellipticity the catalogue reports as e1, e2.
        ellipticity: EllipticityType,
    }
}

section! {
    /// Shape from the autocorrelation of the deconvolved stamp, under a Moffat weight of the galaxy's own
    /// ellipticity.
    WeightedShape, PartialShape, "shape" {
        /// Scale in pixels of the Moffat weight.
        weight_scale: f64,
        /// S/N at which a galaxy counts half, that of the best filter for a round galaxy of `reference_extent`: what is
        /// added to the weighted integral of x² + y² by which the moments are divided halves the ellipticity of such a
        /// galaxy, so that those of low S/N count less, as their noise asks. Zero for all alike.
        half_snr: f64,
        /// Shear of sheared versions of ellipticity, S/N, flux and size (`1p`, `1m`, `2p`, `2m`), which catalogues then have in
        /// addition. Zero for none.
        sheared_step: f64,
        /// What is done about neighbours.
        neighbours: Neighbours,
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

/// When neurons below zero are set to zero (Eq. 12).
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

/// What is done about neighbours of a galaxy on its stamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Neighbours {
    /// Those that are near or much brighter flag the galaxy; others are subtracted.
    Flag,
    /// They are not looked for: all light counts as light of the galaxy.
    Keep,
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

/// Every setting of a submission, resolved: those that its method uses and no others. Wherever they are read
/// from, they are checked against their ranges.
#[derive(Debug, Clone, PartialEq, Serialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "method", rename_all = "kebab-case")]
pub enum Method {
    /// The Hopfield network of the paper.
    Network(NetworkMethod),
    /// Its linear part in closed form, calibrated by its own response to shear.
    Linear(LinearMethod),
}

/// [`Method`] as a file names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum MethodName {
    Network,
    Linear,
}

/// Settings of the network.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NetworkMethod {
    /// Denoising.
    pub denoise: Denoise,
    /// Deconvolution.
    pub deconvolution: NetworkDeconvolution,
    /// Shape measurement.
    pub shape: ClippedShape,
}

/// Settings of the linear network.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LinearMethod {
    /// Deconvolution.
    pub deconvolution: LinearDeconvolution,
    /// Shape measurement.
    pub shape: WeightedShape,
}

/// How much of a PSF is cut around its middle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PsfCut {
    /// Pixels a side.
    pub size: usize,
    /// Pixels a side of the smallest stamp that will do, of which all are taken; of the parity of `size`.
    pub least: usize,
    /// Whether the middle of the PSF must be the middle of these pixels: stars on stamps of the other parity are shifted
    /// by half a pixel. The network does not need it, as an autocorrelation does not change with a shift.
    pub centred: bool,
}

impl From<usize> for PsfCut {
    /// So many pixels a side, of any PSF.
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
        let least = size.min(LEAST_PSF);
        PsfCut {
            size,
            least: least - (size - least) % 2,
            centred: true,
        }
    }

    /// The network's settings; `None` for the linear method.
    pub fn network(&self) -> Option<&NetworkMethod> {
        match &self.method {
            Method::Network(network) => Some(network),
            Method::Linear(_) => None,
        }
    }

    /// The linear network's settings; `None` for the network.
    pub fn linear(&self) -> Option<&LinearMethod> {
        match &self.method {
            Method::Network(_) => None,
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

    /// Type of the reported ellipticity.
    pub fn ellipticity(&self) -> EllipticityType {
        match &self.method {
            Method::Network(network) => network.shape.ellipticity,
            Method::Linear(linear) => linear.shape.ellipticity,
        }
    }

    /// What ellipticities are divided by. The network's response is not known.
    pub fn calibration(&self) -> Calibration {
        match &self.method {
            Method::Network(_) => Calibration::None,
            Method::Linear(linear) => linear.shape.calibration,
        }
    }
}

/// The sections of one file, none of which must be complete.
#[derive(Debug, Clone, Default)]
pub(crate) struct PartialConfiguration {
    pub(crate) method: Option<MethodName>,
    pub(crate) stamp: PartialStamp,
    pub(crate) psf: PartialPsf,
    pub(crate) noise: PartialNoise,
    pub(crate) denoise: PartialDenoise,
    pub(crate) deconvolution: PartialDeconvolution,
    pub(crate) shape: PartialShape,
}

impl PartialConfiguration {
    pub(crate) fn over(self, base: Self) -> Self {
        PartialConfiguration {
            method: self.method.or(base.method),
            stamp: self.stamp.over(base.stamp),
            psf: self.psf.over(base.psf),
            noise: self.noise.over(base.noise),
            denoise: self.denoise.over(base.denoise),
            deconvolution: self.deconvolution.over(base.deconvolution),
            shape: self.shape.over(base.shape),
        }
    }

    /// All settings of the method, or the key that nothing in the chain sets.
    pub(crate) fn complete(
        &self,
        name: String,
        description: String,
    ) -> Result<Configuration, &'static str> {
        Ok(Configuration {
            name,
            description,
            stamp: Stamp::of(&self.stamp)?,
            psf: Psf::of(&self.psf)?,
            noise: NoiseSource::of(&self.noise)?,
            method: match self.method.ok_or("method")? {
                MethodName::Network => Method::Network(NetworkMethod {
                    denoise: Denoise::of(&self.denoise)?,
                    deconvolution: NetworkDeconvolution::of(&self.deconvolution)?,
                    shape: ClippedShape::of(&self.shape)?,
                }),
                MethodName::Linear => Method::Linear(LinearMethod {
                    deconvolution: LinearDeconvolution::of(&self.deconvolution)?,
                    shape: WeightedShape::of(&self.shape)?,
                }),
            },
        })
    }
}
