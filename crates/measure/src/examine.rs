//! Whether the stamps of an image meet the requirements of the measurement (sky subtracted, one galaxy in the middle of
//! each, noise of one level), and whether epochs show the same galaxies.
//!
//! Estimates are robust, so that neighbours on a few stamps do not matter. The sky is measured in the corners, where a galaxy has
//! least light.
//!
//! # Warnings
//!
//! [`Warning`] has the texts of all, of which those that are fatal stop the work. Their conditions are here, in `psf.rs` and
//! `session.rs`, and in `wcs.rs` and `measure/source.rs` of the pipeline.

use std::f64::consts::PI;
use std::fmt;

use ndarray::ArrayView2;
use shearq_quantities::linear::{Matrix2, apply, determinant};
use shearq_quantities::statistics::{OF_MEDIAN, median, scatter};
use shearq_submissions::PsfCut;
use shearq_submissions::limits::MIN_PSF;
use strum_macros::IntoStaticStr;
use thiserror::Error;

use crate::error::MeasureError;
use crate::measurement::{Flag, Measurement};
use crate::psf::{PsfQuality, Psfs, Star, psf_warnings};
use crate::sky::{INNER_AREA, INNER_RADIUS, inner_light};
use crate::stamp::{
    CENTROID_WEIGHT_SIGMA, CORE_RADIUS_PX, CoreSize, FullStamp, PEAK_RANGE, Pixel, SkySubtraction,
    core_sums, galaxy_centroid_near, hash, highest,
};

/// Something in the data of an image that biases shears, or is likely a mistake.
///
/// The text of [`Display`](fmt::Display) is one line without the name of the image.
#[derive(Debug, Clone, PartialEq, Error, IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
#[non_exhaustive]
#[expect(
    missing_docs,
    reason = "the text of a variant states what its fields are"
)]
pub enum Warning {
    /// The corners of the stamps are brighter or darker than zero.
    #[error("the stamps contain sky {}", sky(*level, *error, *noise, *share, *subtracted))]
    Sky {
        /// Mean level in image units.
        level: f64,
        error: f64,
        /// Noise of a pixel in image units.
        noise: f64,
        /// Light of this sky within 8 px of a galaxy, in units of the galaxy's.
        share: f64,
        /// Whether it was subtracted from the stamps before they were measured.
        subtracted: bool,
    },
    /// The level of the stamps' corners changes along x or y.
    #[error("the sky has a gradient {}", gradient(*slope, *error, *noise, *subtracted))]
    Gradient {
        /// Change per pixel along x and y, in image units.
        slope: [f64; 2],
        error: f64,
        /// Noise of a pixel in image units.
        noise: f64,
        /// Whether it was subtracted from the stamps before they were measured.
        subtracted: bool,
    },
    /// The galaxies are not in the middle of their stamps.
    #[error(
        "the galaxies are off the centre of their stamps (found a median of {:+.2} px along x and {:+.2} px along y, ± {error:.2}; expected the middle). Try: cut the stamps around the galaxies",
        offset[0], offset[1]
    )]
    OffCentre {
        /// Median of their centroids from the middle, along x and y in pixels.
        offset: [f64; 2],
        error: f64,
    },
    /// The galaxies are at different places of their stamps.
    #[error(
        "the galaxies are scattered over their stamps (found {:.1} px along x and {:.1} px along y; expected less than 2 px). Try: cut the stamps around the galaxies",
        scatter[0], scatter[1]
    )]
    PositionScatter {
        /// Scatter of their centroids along x and y in pixels.
        scatter: [f64; 2],
    },
    /// Most galaxies are darker than their surroundings.
    #[error(
        "galaxies are darker than their surroundings (found negative flux on {count} of {of} stamps; expected positive flux). Try: check the sign of the image"
    )]
    Negative { count: usize, of: usize },
    /// The noise differs from stamp to stamp.
    #[error(
        "the noise differs between stamps (found a scatter of {:.0} %; expected one level). Try: give the noise of each stamp (gather --variance or --weight-map, `noise` in Python), or put stamps of one depth into an image",
        100.0 * scatter
    )]
    Depths {
        /// Scatter of the stamps' noise, in units of their median.
        scatter: f64,
    },
    /// Noise is correlated over more pixels than can be measured.
    #[error(
        "the noise is correlated over more than 3 px (found {correlation:.2} for pixels 4 and 5 px apart; expected 0). The response is corrected for shorter correlations only. Try: use images before resampling or smoothing"
    )]
    LongCorrelation {
        /// Mean correlation of pixels four and five apart along an axis.
        correlation: f64,
    },
    /// The network stopped before its first iteration on most galaxies.
    #[error(
        "the network makes no iteration (found {count} of {of} galaxies). Their images are not deconvolved. Try: other values of deconvolution.step and deconvolution.lambda"
    )]
    Idle { count: usize, of: usize },
    /// The mean response of the galaxies is not positive by three standard errors.
    #[error(
        "the mean response to shear is not positive by 3 standard errors (found {:.3}, {:.3}). Try: check that the PSF has the pixel scale of the galaxies, and that there are galaxies", response[0], response[1]
    )]
    NoResponse { response: [f64; 2] },
    /// Stamps are copies of other stamps.
    #[error(
        "stamps are copies of each other (found {count} of {of}; expected none). Copies make errors too small. Try: remove repeated galaxies"
    )]
    Copies { count: usize, of: usize },
    /// All pixels of a stamp are equal, on every stamp examined.
    #[error(
        "the stamps are blank (found equal pixels on each of {of} stamps; expected a galaxy and noise). Try: check the file and its extension"
    )]
    Blank { of: usize },
    /// Pixel values are too small or large for single precision.
    #[error(
        "pixel values are out of range (found brightest pixels of about {peak:.1e}; expected 1e-18 to 1e17). Try: divide the image and its noise by a constant"
    )]
    Brightness {
        /// Median of the stamps' brightest pixels.
        peak: f64,
    },
    /// The noise of the stamps disagrees with the header.
    #[error(
        "NOISESIG disagrees with the measured noise (found {}, expected {}): {} is used",
        significant(*given, 5), significant(*measured, 5),
        if *used { "the measured noise" } else { "NOISESIG" }
    )]
    NoiseLevel {
        given: f64,
        measured: f64,
        used: bool,
    },
    /// The noise of the stamps disagrees with the one in the call.
    #[error(
        "the given noise disagrees with the noise of the stamps (found {}, expected {}), which biases shears. Try: leave out the noise, so that it is measured",
        significant(*given, 5), significant(*measured, 5)
    )]
    GivenNoise { given: f64, measured: f64 },
    /// Noise is correlated, and the configuration treats it as white.
    #[error(
        "the noise of neighbouring pixels is correlated, but is treated as white (found {:.2} along x and {:.2} along y, expected 0). Try: set noise.source to \"image\" and noise.correlation above 0",
        correlation[0], correlation[1]
    )]
    CorrelatedNoise {
        /// Correlation of neighbours along x and y.
        correlation: [f64; 2],
    },
    /// A warning about one of several epochs.
    #[error("epoch {epoch}: {warning}")]
    Epoch {
        /// The epoch, from 1.
        epoch: usize,
        warning: Box<Warning>,
    },
    /// Noise of an epoch is correlated, and all epochs are combined as white noise.
    #[error(
        "the noise of neighbouring pixels is correlated, but epochs are combined as if it were white (found {:.2} along x and {:.2} along y, expected 0). Try: exposures that were not resampled",
        correlation[0], correlation[1]
    )]
    EpochNoise {
        /// Correlation of neighbours along x and y.
        correlation: [f64; 2],
    },
    /// The noise of an epoch cannot be measured.
    #[error(
        "cannot measure the noise: no stamp has enough pixels that differ (expected galaxies and noise). The epoch is left out. Try: check the file and its extension"
    )]
    EpochNoNoise,
    /// The galaxies of an epoch are not where its offsets and its PSF place them.
    #[error(
        "the galaxies are displaced from {} (found {:+.2} px along x and {:+.2} px along y, ± {error:.2}; expected 0), which blurs the combined galaxies. Try: check sign, order and axes of the dithers or positions, and that the PSF is centred on its stamp",
        if *from_first { "those of the first epoch, beyond offsets and PSFs" } else { "the offsets that are stated" },
        offset[0], offset[1]
    )]
    EpochOffset {
        /// Median displacement along x and y in pixels.
        offset: [f64; 2],
        error: f64,
        /// Whether it is that from the galaxies of the first epoch, and not from the offsets alone.
        from_first: bool,
    },
    /// The galaxies of an epoch have another flux than in the first one.
    #[error(
        "the galaxies have {ratio:.2} ± {error:.2} times the flux of the first epoch (expected 1): weights and leakage of the PSF are those of one flux. Try: scale image, noise and gain to one zero point"
    )]
    EpochFlux { ratio: f64, error: f64 },
    /// An epoch has no light at the stated places of the galaxies, or the first epoch has none.
    #[error(
        "{} at the stated places (found no significant light there; expected the galaxies that {} shows). Try: check that image, WCS and dither belong together",
        if *from_first { "the first epoch has no galaxies" } else { "there are no galaxies" },
        if *from_first { "this epoch" } else { "the first epoch" }
    )]
    EpochWithoutGalaxies { from_first: bool },
    /// An epoch contains other galaxies than the first one.
    #[error(
        "{count} of {of} galaxies are not those of the first epoch (found stamps that are blank, or differ in brightness by a factor of 2 and 5 standard errors; expected the same galaxies). Try: check that files and rows of the epochs belong together. Bands of galaxies with various colours may have this warning, too"
    )]
    EpochGalaxies { count: usize, of: usize },
    /// Stamps of an epoch are copies of stamps of an earlier one.
    #[error(
        "stamps are copies of those of an earlier epoch (found {count} of {of}; expected none), so that their noise does not average. Try: remove one of the epochs"
    )]
    EpochCopies { count: usize, of: usize },
    /// No stamp is good enough to measure the noise on.
    #[error(
        "cannot measure the noise: no stamp has enough pixels that differ. All galaxies are flagged. Try: set noise.source to \"header\" to use NOISESIG"
    )]
    NoNoise,
    /// The star was not in the middle of its stamp, and was cut around itself.
    #[error(
        "the star is off the centre of its stamp (found ({:+.1}, {:+.1}) px{of}; expected at most 1 px). It was moved to the centre by whole pixels",
        offset[0], offset[1]
    )]
    PsfOffCentre {
        /// Offset along x and y in pixels.
        offset: [f64; 2],
        of: ExaminedPsfs,
    },
    /// The PSF image contains a background.
    #[error(
        "the PSF contains a background (found {} % of its peak{of}; expected 0). It changes the star's light by {:+.0} % and biases shears. Try: subtract the background, or use a larger PSF stamp if the PSF fills it",
        significant(100.0 * level, 3), 100.0 * share
    )]
    PsfBackground {
        /// Level in units of the peak.
        level: f64,
        /// Its light in units of the star's.
        share: f64,
        of: ExaminedPsfs,
    },
    /// The background of the PSF image changes along x or y.
    #[error(
        "the background of the PSF has a gradient (found {:.3} % of the peak per pixel along x and {:.3} % along y{of}; expected 0). It biases shears. Try: subtract the background",
        100.0 * slope[0], 100.0 * slope[1]
    )]
    PsfGradient {
        /// Change per pixel along x and y in units of the peak.
        slope: [f64; 2],
        of: ExaminedPsfs,
    },
    /// The noise of the star biases shears.
    #[error(
        "the PSF is noisy (found S/N {snr:.0}{of}; expected more than {enough:.0}). {}",
        effect.map_or_else(
            || "With a star of S/N 50 for each galaxy, m is right to 0.003 behind Moffat and Kolmogorov PSFs, and to 0.01 behind others. Try: a model of the PSF, fitted to all stars".to_owned(),
            |[m, c]| format!("The noise of one star changes m by about {m:.3} and c by about {c:.3}. Try: average several stars, or fit a model"),
        )
    )]
    PsfNoise {
        /// √(Σ p²)/σ.
        snr: f64,
        enough: f64,
        /// Standard deviations of m and c by the noise of one star for all galaxies.
        effect: Option<[f64; 2]>,
        of: ExaminedPsfs,
    },
    /// The PSF is narrower than pixels can show.
    #[error(
        "the PSF is narrower than the pixels can show (found light on {area:.1} px{of}; expected 6 px or more, a FWHM of about 1 px). Try: check that the file is a PSF with the pixel scale of the galaxies"
    )]
    PsfNarrow {
        /// Noise-equivalent area in px².
        area: f64,
        of: ExaminedPsfs,
    },
    /// The PSF is broader than the galaxies that were blurred by it.
    #[error(
        "the PSF is {} the galaxies (found a FWHM of {psf:.2} px in the core, expected {} the {galaxies:.2} px of the galaxies). A PSF sampled with another pixel scale biases m by up to 10. Try: check the sampling of the PSF, and that the objects are not stars",
        if *fatal { "broader than" } else { "nearly as broad as" },
        if *fatal { "less than" } else { "clearly less than" }
    )]
    PsfBroad {
        /// FWHM of its core in pixels.
        psf: f64,
        /// FWHM of the core of the galaxies in pixels.
        galaxies: f64,
        /// Whether the difference is too large for stars that are measured as galaxies.
        fatal: bool,
    },
    /// The headers of the PSF image and of the galaxy image state different pixel scales.
    #[error(
        "the PSF image and the galaxy image have different pixel scales (found {}, expected {} arcsec per pixel). This can bias m by 0.1 or more. Try: resample the PSF to the pixels of the galaxies, or correct its header",
        six_digits(*psf), six_digits(*galaxies)
    )]
    PixelScale {
        /// Arcseconds per pixel of the PSF image.
        psf: f64,
        /// Arcseconds per pixel of the galaxy image.
        galaxies: f64,
    },
    /// The header of a file states the set and image of another file.
    #[error(
        "the header of the {of} states another image (found SET = {} and IMAGE = {}, expected {} and {}). With galaxies or a PSF of another image shears are wrong. Try: put the files back, or correct the header",
        stated[0], stated[1], expected[0], expected[1]
    )]
    OtherImage {
        /// The content of the file: galaxies, or the PSF.
        of: &'static str,
        /// SET and IMAGE of the header.
        stated: [u32; 2],
        /// Set and image of the path.
        expected: [u32; 2],
    },
    /// Ellipticities are along pixel axes that the header rotates, mirrors or shears against the sky's.
    #[error(
        "e1 and e2 are along the pixel axes, which are not the sky's (found {0}; expected 0°, not mirrored, no shear). Try: transform e1 and e2 with the WCS, or compare them with shears along the pixel axes"
    )]
    PixelFrame(PixelFrame),
    /// The headers of the PSF image and of the galaxy image state pixel axes of different orientation or shear.
    #[error(
        "the PSF image and the galaxy image have pixel axes of different orientation or shear (found {psf}; expected {galaxies}). The PSF is deconvolved in the wrong orientation. Try: draw the PSF with the WCS of the galaxies, or correct its header"
    )]
    PsfFrame {
        psf: PixelFrame,
        galaxies: PixelFrame,
    },
    /// The configuration uses so little of the PSF that its wings are missing.
    #[error(
        "psf.size is {size} (expected {MIN_PSF} or more). The wings of the PSF that are cut off bias m, by about 0.002 at 20 px and 0.01 at 16 px for a FWHM of 3.4 px. Try: psf.size = {MIN_PSF}"
    )]
    PsfSize {
        /// Pixels a side that are used.
        size: usize,
    },
    /// Most galaxies could not be measured.
    #[error(
        "{count} of {of} galaxies are flagged (most frequent reason: {flag}). Try: {}",
        advice(*flag)
    )]
    Flagged { flag: Flag, count: usize, of: usize },
}

/// The pixel axes of an image against the sky's: +x to the west, +y to the north.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PixelFrame {
    /// Position angle of +y in degrees, from north through east, without the shear.
    pub angle: f64,
    /// Whether +x is to the east where +y is to the north.
    pub mirrored: bool,
    /// Reduced shear that an object that is round on the sky has along the pixel axes.
    pub shear: [f64; 2],
}

impl fmt::Display for PixelFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Adding zero removes the sign of a negative zero.
        let angle = (self.angle * 10.0).round() / 10.0 + 0.0;
        let not = if self.mirrored { "" } else { "not " };
        let [g1, g2] = self.shear.map(|g| (g * 1e4).round() / 1e4 + 0.0);
        write!(
            f,
            "rotated by {angle:.1}° from north to east, {not}mirrored, sheared by ({g1:+.4}, {g2:+.4})"
        )
    }
}

/// How many of the examined PSFs a warning is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExaminedPsfs {
    /// Their number.
    pub count: usize,
    /// PSFs examined.
    pub of: usize,
}

impl fmt::Display for ExaminedPsfs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ExaminedPsfs { of: 1, .. } => Ok(()),
            ExaminedPsfs { count, of } => write!(f, " on {count} of {of} PSFs examined"),
        }
    }
}

impl Warning {
    /// A warning about the star for all galaxies, which was at the offset `moved` in pixels before it was centred.
    pub fn of_moved(moved: [f64; 2]) -> Warning {
        Warning::PsfOffCentre {
            offset: moved,
            of: ExaminedPsfs { count: 1, of: 1 },
        }
    }

    /// Warnings about the galaxies of an image.
    pub(crate) fn of_galaxies(galaxies: &[Measurement]) -> impl Iterator<Item = Warning> {
        let flagged = galaxies.iter().filter(|g| !g.flags.is_empty()).count();
        let with = |flag: Flag| galaxies.iter().filter(|g| g.flags.contains(flag)).count();
        let flags = Warning::of_counts(Flag::ALL.map(with), flagged, galaxies.len());
        flags.into_iter().chain(Warning::of_idle(galaxies))
    }

    /// A warning if the network made no iteration on more than half of the galaxies that it ran on.
    fn of_idle(galaxies: &[Measurement]) -> Option<Warning> {
        let (mut count, mut of) = (0, 0);
        for descent in galaxies.iter().filter_map(|galaxy| galaxy.descent.as_ref()) {
            count += usize::from(descent.iterations == 0);
            of += 1;
        }
        (2 * count > of).then_some(Warning::Idle { count, of })
    }

    /// A warning if `count` of `of` galaxies are flagged and these are more than half. `with` has the galaxies
    /// with each of [`Flag::ALL`].
    pub fn of_counts(with: [usize; Flag::ALL.len()], count: usize, of: usize) -> Option<Warning> {
        let counts = || Flag::ALL.into_iter().zip(with);
        let explains = |(_, with): &(Flag, usize)| 2 * with > of;
        // Of equal numbers the first reason.
        let most = || counts().rev().max_by_key(|(_, with)| *with);
        let (flag, _) = counts().find(explains).or_else(most)?;
        (2 * count > of).then_some(Warning::Flagged { flag, count, of })
    }

    /// The warning itself, if it is about an epoch.
    pub fn inner(&self) -> &Warning {
        match self {
            Warning::Epoch { warning, .. } => warning,
            other => other,
        }
    }

    /// A name for each kind of warning, for counting: the name of the variant, such as `psf-noise`.
    pub fn kind(&self) -> &'static str {
        self.inner().into()
    }

    /// Whether no result should be made from such data.
    pub fn is_fatal(&self) -> bool {
        matches!(self.inner(), Warning::PsfBroad { fatal: true, .. })
    }
}

fn sky(level: f64, error: f64, noise: f64, share: f64, subtracted: bool) -> String {
    let decimals = if subtracted { 3 } else { 2 };
    let in_noise = match noise > 0.0 {
        true => format!(", or {:.decimals$} of the noise", level / noise),
        false => String::new(),
    };
    let (level, error) = (significant(level, 3), significant(error, 3));
    match subtracted {
        true => format!(
            "(found {level} ± {error}{in_noise}; expected 0). It was subtracted from all stamps"
        ),
        false => format!(
            "(found {level} ± {error} in their corners{in_noise}; expected 0). Its light within 8 px of a galaxy is {:.0} % of the galaxy's, which biases shears. Try: subtract the sky",
            100.0 * share
        ),
    }
}

fn gradient(slope: [f64; 2], error: f64, noise: f64, subtracted: bool) -> String {
    let (unit, name) = match noise > 0.0 {
        true => (noise, "the noise"),
        false => (1.0, "the image"),
    };
    let ([x, y], error) = (slope.map(|slope| slope / unit), error / unit);
    let end = match subtracted {
        true => ". It was subtracted from all stamps",
        false => ", which biases shears. Try: subtract the sky",
    };
    format!(
        "(found {x:+.4} along x and {y:+.4} along y, ± {error:.4}, in units of {name} per pixel; expected 0){end}"
    )
}

/// A number with `digits` significant digits, in whatever unit pixels have.
fn significant(value: f64, digits: i32) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let decimals = digits - 1;
    if !(1e-3..1e5).contains(&value.abs()) {
        return format!("{value:.*e}", decimals as usize);
    }
    let decimals = decimals - value.abs().log10().floor() as i32;
    format!("{value:.*}", decimals.max(0) as usize)
}

/// A pixel scale to six digits, without trailing zeros.
fn six_digits(scale: f64) -> f64 {
    if !(scale.is_finite() && scale > 0.0) {
        return scale;
    }
    let unit = 10f64.powf(5.0 - scale.log10().floor());
    (scale * unit).round() / unit
}

/// What to check if most galaxies have this flag.
fn advice(flag: Flag) -> &'static str {
    match flag {
        Flag::NotFinite => "check masks, and positions outside the image (are they degrees?)",
        Flag::BadPsf => "check the PSF stamps: sum, centre and finite pixels",
        Flag::NoScale => "check that the stamps are not blank and that the noise is known",
        Flag::NoLight | Flag::NoExtent => "check the sky, the sign of the image and its units",
        Flag::NoShear => "check that there is a galaxy on the stamps",
    }
}

// Largest side in px of the corner blocks in which the sky is measured. Chosen by hand.
const BLOCK: usize = 8;
const BLOCKS_PER_SIDE: usize = 4; // At least, on small stamps. Chosen by hand.
// Distances in px of pixel pairs that show long correlations: next to the distances that the survey covers.
const LONG_LAGS: [usize; 2] = [4, 5];
// On 48 px they give the variance to 0.15 %: √(2/n) for n independent pixels.
const EXAMINED_STAMPS: usize = 1000;
// Fewest galaxies whose core is compared with the core of the PSF. Chosen by hand.
const MIN_GALAXIES_CORE: usize = 30;
// Largest weight of one galaxy in units of the median light. Chosen by hand.
const MAX_LIGHT: f64 = 4.0;
// Light of the sky within 8 px, in units of the galaxy's. A share of 0.48 changes m by −0.006 (fiducial), −0.013 (large) and −0.011
// (S/N 10); the threshold keeps |Δm| below 5·10⁻³. Command and seed were not kept.
const SKY_SHARE: f64 = 0.15;
// Largest ratio of corner to side brightness of a galaxy's wings; a sky is equal in both. Chosen by hand.
const WINGS_RATIO: f64 = 0.6;
// Change of the sky's share over 8 px. A change of 0.076 gives c = 0.0035, and m = −0.009 at S/N 10. Command and seed were
// not kept.
const GRADIENT_SHARE: f64 = 0.04;
// Mean offset of the galaxies in px: between half a pixel and one pixel along both axes (0.71 and 1.41).
const OFFSET: f64 = 0.85;
// Scatter of the galaxies' positions in px. Chosen by hand.
const POSITION_SCATTER: f64 = 2.0;
// Relative difference of given noise and noise in the corners: it changes m by 0.005 at S/N 20. Command and seed were not
// kept.
const GIVEN_NOISE_DIFFERENCE: f64 = 0.02;
// Relative scatter of the noise between stamps. Chosen by hand.
const DEPTHS: f64 = 0.1;
// Correlation at distances of 4 and 5 px. Chosen by hand.
const LONG_CORRELATION: f64 = 0.03;
// Fewest galaxies by which epochs are compared: the scatter of 30 is known to 13 %. Chosen by hand.
const MIN_GALAXIES_EPOCHS: usize = 30;
// Displacement of an epoch in px. Of two equal epochs it adds δ²/4 to a second moment of 3 px² or more, and hence less than 0.0004
// to an ellipticity; weighted centroids of PSFs with coma and of galaxies differ by less.
const EPOCH_OFFSET: f64 = 0.1;
// Relative difference of the flux within 8 px. Chosen by hand: different seeing changes it by up to a tenth.
const EPOCH_FLUX: f64 = 0.2;
// Share of galaxies whose brightness differs by a factor of 2. Chosen by hand: cosmic rays, masks and variable objects are fewer.
const OTHER_GALAXIES: f64 = 0.1;
// Light per noise of an epoch in units of the first epoch's, from which its galaxies must be visible. Chosen by hand: exposures of
// a set rarely have sixteen times less weight, and those that have need not be told from exposures without galaxies.
const MIN_EPOCH_DEPTH: f64 = 0.25;
// Noise of a star's centroid times its S/N in px: the σ of the centroid's weight.
const PSF_CENTROID_NOISE: f64 = CENTROID_WEIGHT_SIGMA;
/// PSFs of single galaxies of an image that are examined.
pub const EXAMINED_PSFS: usize = 100; // Chosen by hand.

/// Which of `rows` rows of `columns` stamps are examined: enough for a thousand stamps, or all. They are spread
/// evenly but not regularly, so that they do not miss what differs from row to row.
pub fn examined_rows(columns: usize, rows: usize) -> Vec<usize> {
    // The golden ratio minus 1: fractional steps between examined rows without a period.
    const STEP: f64 = 0.618_033_988_749_895;
    let count = enough(columns, rows);
    let place = |k: usize| (k as f64 + (STEP * k as f64).fract()) * rows as f64 / count as f64;
    let mut chosen: Vec<usize> = (0..count)
        .map(|k| (place(k) as usize).min(rows - 1))
        .collect();
    // If there are hardly more rows than needed, two places may be in one row. Its stamps would count as copies.
    chosen.dedup();
    chosen
}

/// Number of rows, out of `rows` rows of `columns` stamps, with enough stamps.
pub(crate) fn enough(columns: usize, rows: usize) -> usize {
    EXAMINED_STAMPS.div_ceil(columns.max(1)).min(rows)
}

#[derive(Debug, Clone, Copy)]
struct StampStatistics {
    /// Number among all stamps, from 0.
    at: usize,
    /// Level of its corners, and of the middles of its sides.
    corner: f64,
    side: f64,
    /// Change of the corners' level per pixel along x and y.
    slope: [f64; 2],
    /// Noise of two of the corners, and of the other two.
    noise: [f64; 2],
    /// Sums over pairs at the distances `LONG_LAGS`: of products, of the pixels, and their number.
    pairs: [f64; 3],
    /// Centroid from the expected place.
    place: [f64; 2],
    /// Light within `INNER_RADIUS`, without sky.
    flux: f64,
    peak: f64,
    /// Sums under the narrow weight of [`CoreSize`].
    core: [f64; 2],
    /// Equal for equal stamps.
    trace: u64,
    /// Whether pixels of the core are missing, so that place and core are wrong.
    is_core_damaged: bool,
}

/// Sums over stamps of an image. They depend on nothing but the stamps and their order.
#[derive(Debug, Clone)]
pub struct Examination {
    stamp: FullStamp,
    block: usize,
    stamps: Vec<StampStatistics>,
    /// Stamps that were added.
    added: usize,
    blank: usize,
    psfs: Vec<PsfQuality>,
    /// Whether there is a PSF per galaxy.
    each: bool,
}

// Errors by which a value differs from zero. Chosen by hand: among 10 tests on 200 images, Gaussian noise alone exceeds it in
// one of 1,000 runs.
const SIGNIFICANT: f64 = 5.0;

/// A measured quantity with its standard error.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Estimate {
    pub(crate) value: f64,
    pub(crate) error: f64,
}

impl Estimate {
    /// Whether the value differs from zero.
    pub(crate) fn is_significant(self) -> bool {
        self.value.abs() > SIGNIFICANT * self.error
    }
}

/// A block's mean, variance about its plane, and sums over pairs.
#[derive(Debug, Clone, Copy, Default)]
struct Block {
    mean: f64,
    variance: f64,
    pairs: [f64; 3],
}

impl Examination {
    /// For `count` stamps of `full` pixels a side.
    pub fn new(full: usize, count: usize) -> Self {
        Examination {
            stamp: FullStamp::new(full),
            block: BLOCK.min(full / BLOCKS_PER_SIDE),
            stamps: Vec::with_capacity(count),
            added: 0,
            blank: 0,
            psfs: Vec::new(),
            each: false,
        }
    }

    /// The same for stamps from which this is subtracted before they are measured.
    pub(crate) fn without(mut self, subtraction: SkySubtraction) -> Self {
        self.stamp.subtraction = subtraction;
        self
    }

    /// The same for PSFs of one galaxy each.
    #[must_use]
    pub fn with_psf_of_each(self) -> Self {
        Examination { each: true, ..self }
    }

    /// Examines the PSF of all galaxies, of sum one, whose star was at the offset `moved` in pixels before it was centred.
    pub fn add_psf(&mut self, psf: ArrayView2<'_, f64>, moved: Option<[f64; 2]>) {
        self.psfs.extend(PsfQuality::from_psf(psf, moved));
    }

    /// Examines a PSF of all galaxies, or up to `most` PSFs of one galaxy each, as a configuration cuts them. PSFs that
    /// cannot be used are left out.
    pub fn add_psfs(&mut self, psfs: &Psfs<'_>, cut: PsfCut, most: usize) {
        let count = psfs.count();
        self.each |= count.is_some();
        let count = count.unwrap_or(1);
        let some = most.min(count);
        for at in (0..some).map(|k| (2 * k + 1) * count / (2 * some)) {
            if let Ok(Star { psf, moved }) = psfs.at(at, cut, self.stamp.side) {
                self.add_psf(psf.view(), moved);
            }
        }
    }

    /// Examines a stamp with its galaxy in the middle.
    ///
    /// # Errors
    /// If the stamp has other sizes than planned.
    pub fn add<T: Pixel>(&mut self, stamp: ArrayView2<'_, T>) -> Result<(), MeasureError> {
        self.add_at(stamp, [0.0; 2])
    }

    /// Examines a stamp with its galaxy expected at `place`, (x, y) in pixels from the middle.
    ///
    /// # Errors
    /// If the stamp has other sizes than planned.
    pub fn add_at<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
        place: [f64; 2],
    ) -> Result<(), MeasureError> {
        let n = self.stamp.side;
        self.stamp.read(stamp)?;
        self.added += 1;
        if self.stamp.is_blank() {
            self.blank += 1;
            return Ok(());
        }
        // Without pixels, as of a galaxy that an exposure does not contain. All such stamps would be copies of each other.
        if self.stamp.pixels.iter().all(|value| !value.is_finite()) {
            return Ok(());
        }
        self.stamp.subtract_sky();
        let pixels = &mut self.stamp.pixels;
        let (edge, middle) = (n - self.block, (n - self.block) / 2);
        let at = |y, x| block(pixels, n, self.block, (y, x));
        let corners = [at(0, 0), at(0, edge), at(edge, 0), at(edge, edge)];
        let sides = [
            at(0, middle),
            at(edge, middle),
            at(middle, 0),
            at(middle, edge),
        ];
        let [a, b, c, d] = corners.map(|corner| corner.mean);
        let apart = 2.0 * edge as f64;
        let noise = |one: Block, other: Block| {
            // NaN if most of a corner is missing.
            let mean = match [one.variance, other.variance] {
                [a, b] if b.is_nan() => a,
                [a, b] if a.is_nan() => b,
                [a, b] => 0.5 * (a + b),
            };
            mean.sqrt()
        };
        let mut pairs = [0.0; 3];
        for corner in corners {
            for (sum, more) in pairs.iter_mut().zip(corner.pairs) {
                *sum += more;
            }
        }
        let corner = median_ignoring_nan(&mut corners.map(|corner| corner.mean));
        let border = StampStatistics {
            at: self.added - 1,
            corner,
            side: median_ignoring_nan(&mut sides.map(|side| side.mean)),
            slope: [(b + d - a - c) / apart, (c + d - a - b) / apart],
            noise: [noise(corners[0], corners[3]), noise(corners[1], corners[2])],
            pairs,
            peak: f64::from(highest(pixels)),
            trace: trace(pixels),
            place: [0.0; 2],
            flux: 0.0,
            core: [0.0; 2],
            is_core_damaged: misses_core(pixels, n, place),
        };
        // The sky of a stamp without corners is unknown.
        let sky = if corner.is_nan() { 0.0 } else { corner };
        for value in pixels.iter_mut() {
            // Missing pixels are as bright as the sky.
            *value = if value.is_finite() {
                (f64::from(*value) - sky) as f32
            } else {
                0.0
            };
        }
        let found = galaxy_centroid_near(pixels, n, place);
        self.stamps.push(StampStatistics {
            place: [0, 1].map(|k| f64::from(found[k]) - place[k]),
            flux: inner_light(pixels, n),
            core: core_sums(
                |x, y| f64::from(pixels[y * n + x]),
                [n; 2],
                found.map(f64::from),
            ),
            ..border
        });
        Ok(())
    }

    /// Adds what another examination has found, as if its stamps had been added here.
    pub fn join(&mut self, other: &Self) {
        let before = self.added;
        self.stamps
            .extend(other.stamps.iter().map(|stamp| StampStatistics {
                at: before + stamp.at,
                ..*stamp
            }));
        self.added += other.added;
        self.blank += other.blank;
        self.psfs.extend_from_slice(&other.psfs);
        self.each |= other.each;
    }

    /// What is wrong with the stamps.
    pub fn warnings(&self) -> Vec<Warning> {
        let mut found = Vec::new();
        let examined = self.stamps.len() + self.blank;
        if self.stamps.is_empty() {
            if self.blank > 0 {
                found.push(Warning::Blank { of: self.blank });
            }
            found.extend(self.psfs(None));
            return found;
        }
        let Estimate { value: peak, .. } = self.median(|stamp| stamp.peak, 0.0);
        // Zero on stamps without a positive pixel.
        if peak > 0.0 && !PEAK_RANGE.contains(&(peak as f32)) {
            found.push(Warning::Brightness { peak });
        }
        let Estimate { value: noise, .. } = self.noise();
        let flux = self.median(|stamp| stamp.flux, noise * INNER_RADIUS);
        // An offset needs light to be measured.
        let lit = flux.is_significant();
        let Estimate { value: flux, .. } = flux;
        if lit && flux < 0.0 {
            let count = self.stamps.iter().filter(|stamp| stamp.flux < 0.0).count();
            found.push(Warning::Negative {
                count,
                of: examined,
            });
        }
        let sky = self.sky(noise, flux);
        let gradient = self.gradient(noise, flux);
        if sky.is_none() && gradient.is_none() {
            found.extend(self.long_correlation(noise));
        }
        found.extend(self.subtracted(noise, flux));
        found.extend(sky);
        found.extend(gradient);
        if lit && flux > 0.0 {
            found.extend(self.places());
        }
        found.extend(self.depths());
        found.extend(self.copies(examined));
        let galaxies = self.core().filter(|_| lit && flux > 0.0);
        found.extend(self.psfs(galaxies));
        found
    }

    /// How much the noise of the star changes m and c of a linear configuration: one standard deviation, the same for all
    /// galaxies. `None` if there is a PSF per galaxy, or no PSF was examined.
    pub fn psf_noise(&self) -> Option<[f64; 2]> {
        let psf = self.psfs.first().filter(|_| !self.each)?;
        Some(psf.noise_bias())
    }

    /// A warning if `given` is not the noise of the stamps.
    pub fn given_noise(&self, given: f64) -> Option<Warning> {
        let measured = self.noise_unlike(given)?;
        Some(Warning::GivenNoise { given, measured })
    }

    /// The noise in the corners of the stamps, if it differs from `given`.
    pub(crate) fn noise_unlike(&self, given: f64) -> Option<f64> {
        let Estimate { value, error } = self.noise();
        let apart = Estimate {
            value: given - value,
            error,
        };
        let differs = apart.value.abs() > GIVEN_NOISE_DIFFERENCE * value;
        (apart.is_significant() && differs && value > 0.0).then_some(value)
    }

    fn noise(&self) -> Estimate {
        let of = |stamp: &StampStatistics| stamp.noise[0].hypot(stamp.noise[1]) / 2f64.sqrt();
        let Estimate { value, error } = self.median(of, 0.0);
        // One stamp or two have no scatter. The variance of n pixels has the relative error √(2/n).
        let pixels = (4 * self.block * self.block * self.stamps.len()) as f64;
        let error = error.max(OF_MEDIAN * value / (2.0 * pixels).sqrt());
        Estimate { value, error }
    }

    fn psfs(&self, galaxies: Option<CoreSize>) -> Vec<Warning> {
        psf_warnings(&self.psfs, !self.each, galaxies)
    }

    fn core(&self) -> Option<CoreSize> {
        let mut lights: Vec<f64> = self
            .stamps
            .iter()
            .map(|stamp| stamp.core[0].abs())
            .collect();
        let most = MAX_LIGHT * median(&mut lights).filter(|_| lights.len() >= MIN_GALAXIES_CORE)?;
        let sums = || {
            self.stamps.iter().map(|stamp| {
                // Bright stars and bad pixels count no more than a few galaxies.
                let share = (most / stamp.core[0].abs()).min(1.0);
                stamp.core.map(|sum| share * sum)
            })
        };
        let light: f64 = sums().map(|core| core[0]).sum();
        let q = 0.5 * sums().map(|core| core[1]).sum::<f64>() / light;
        let rest = sums().map(|core| (0.5 * core[1] - q * core[0]).powi(2));
        CoreSize::from_weighted(q, rest.sum::<f64>().sqrt() / light.abs())
    }

    fn sky(&self, noise: f64, flux: f64) -> Option<Warning> {
        let pixels = (self.block * self.block) as f64;
        // The median of four corners is about the mean of two.
        let corner = self.median(|stamp| stamp.corner, noise / (2.0 * pixels).sqrt());
        let side = self.median(|stamp| stamp.side, 0.0).value;
        let Estimate {
            value: level,
            error,
        } = corner;
        let share = level * (INNER_AREA / flux.abs());
        let wings = level > 0.0 && level < WINGS_RATIO * side;
        let found = corner.is_significant() && share.abs() > SKY_SHARE && !wings;
        found.then_some(Warning::Sky {
            level,
            error,
            noise,
            share,
            subtracted: false,
        })
    }

    fn subtracted(&self, noise: f64, flux: f64) -> Vec<Warning> {
        let SkySubtraction::Plane(sky) = self.stamp.subtraction else {
            return Vec::new();
        };
        let level = (sky.level != 0.0).then(|| Warning::Sky {
            level: sky.level,
            error: sky.level_error,
            noise,
            share: sky.level * INNER_AREA / flux.abs(),
            subtracted: true,
        });
        let gradient = (sky.slope != [0.0; 2]).then_some(Warning::Gradient {
            slope: sky.slope,
            error: sky.slope_error,
            noise,
            subtracted: true,
        });
        level.into_iter().chain(gradient).collect()
    }

    fn gradient(&self, noise: f64, flux: f64) -> Option<Warning> {
        let edge = (self.stamp.side - self.block) as f64;
        let floor = noise / (self.block as f64 * edge);
        let slope = [0, 1].map(|k| self.median(|stamp| stamp.slope[k], floor));
        let (slope, steep) = vector(slope);
        let share = steep.value * (INNER_RADIUS * INNER_AREA / flux.abs());
        (steep.is_significant() && share > GRADIENT_SHARE).then_some(Warning::Gradient {
            slope,
            error: steep.error,
            noise,
            subtracted: false,
        })
    }

    fn places(&self) -> Option<Warning> {
        let offset = [0, 1].map(|k| self.median(|stamp| stamp.place[k], 0.0));
        let count = self.stamps.len() as f64;
        let scatter = offset.map(|offset| offset.error * count.sqrt() / OF_MEDIAN);
        let (offset, away) = vector(offset);
        if away.value > OFFSET && away.is_significant() {
            let error = away.error;
            return Some(Warning::OffCentre { offset, error });
        }
        (scatter[0].max(scatter[1]) > POSITION_SCATTER)
            .then_some(Warning::PositionScatter { scatter })
    }

    /// Compares the noise of two corners with the noise of the other two. Both vary together from stamp to stamp if
    /// the stamps' noise differs, and independently if all stamps have one level.
    fn depths(&self) -> Option<Warning> {
        let usable = |stamp: &&StampStatistics| stamp.noise.iter().all(|noise| *noise > 0.0);
        let logs: Vec<[f64; 2]> = self
            .stamps
            .iter()
            .filter(usable)
            .map(|stamp| stamp.noise.map(f64::ln))
            .collect();
        let count = logs.len() as f64;
        let middle = [0, 1].map(|k| median(&mut logs.iter().map(|log| log[k]).collect::<Vec<_>>()));
        let [a, b] = [middle[0]?, middle[1]?];
        // A neighbour on a corner counts at most a factor of e.
        let about = |log: &[f64; 2]| [(log[0] - a).clamp(-1.0, 1.0), (log[1] - b).clamp(-1.0, 1.0)];
        let products: Vec<f64> = logs.iter().map(|log| about(log).iter().product()).collect();
        let mean = products.iter().sum::<f64>() / count;
        let square = products
            .iter()
            .map(|product| (product - mean).powi(2))
            .sum::<f64>();
        let variance = Estimate {
            value: mean,
            error: (square / (count - 1.0) / count).sqrt(),
        };
        let scatter = mean.max(0.0).sqrt();
        (variance.is_significant() && scatter > DEPTHS).then_some(Warning::Depths { scatter })
    }

    fn long_correlation(&self, noise: f64) -> Option<Warning> {
        let Estimate { value: level, .. } = self.median(|stamp| stamp.corner, 0.0);
        let of = |stamp: &StampStatistics| {
            let [products, sums, count] = stamp.pairs;
            (products - level * sums + count * level * level) / (count * noise * noise)
        };
        let all = self.stamps.iter().map(of);
        let mut all: Vec<f64> = all.filter(|r| r.is_finite()).collect();
        let count = all.len() as f64;
        let (middle, scatter) = scatter(&mut all).filter(|_| count > 1.0)?;
        let most = 3.0 * scatter;
        let clipped = all.iter().map(|r| (r - middle).clamp(-most, most));
        let found = Estimate {
            value: middle + clipped.sum::<f64>() / count,
            error: scatter / count.sqrt(),
        };
        let correlation = found.value;
        (found.is_significant() && correlation > LONG_CORRELATION)
            .then_some(Warning::LongCorrelation { correlation })
    }

    fn copies(&self, of: usize) -> Option<Warning> {
        let mut traces: Vec<u64> = self.stamps.iter().map(|stamp| stamp.trace).collect();
        traces.sort_unstable();
        let count = traces.windows(2).filter(|pair| pair[0] == pair[1]).count();
        (count > 0).then_some(Warning::Copies { count, of })
    }

    /// Median of a number over stamps. Each stamp has an error of at least `floor`.
    fn median(&self, of: impl Fn(&StampStatistics) -> f64, floor: f64) -> Estimate {
        median_of(self.stamps.iter().map(of), floor)
    }

    /// What contradicts that this is an epoch of the galaxies of `earlier` ones, whose stamps were added in the same order.
    /// `axes` maps pixels of the first to pixels of this one. Places must agree, because epochs are added, and with
    /// `common_flux` the flux.
    pub(crate) fn contradictions(
        &self,
        earlier: &[&Self],
        axes: Matrix2,
        common_flux: bool,
    ) -> Vec<Warning> {
        let mut found = Vec::new();
        let is_copy = |own: &&StampStatistics| {
            let mut others = earlier.iter().filter_map(|other| other.of(own.at));
            others.any(|other| other.trace == own.trace)
        };
        let (count, of) = (self.stamps.iter().filter(is_copy).count(), self.added);
        if count > 0 {
            found.push(Warning::EpochCopies { count, of });
        }
        let Some(first) = earlier.first() else {
            return found;
        };
        let own = self.stamps.iter();
        let pairs: Vec<(&StampStatistics, &StampStatistics)> = own
            .filter_map(|own| Some((own, first.of(own.at)?)))
            // A core without some of its pixels is displaced and fainter, which looks like another galaxy.
            .filter(|(own, other)| !own.is_core_damaged && !other.is_core_damaged)
            .collect();
        if pairs.len() < MIN_GALAXIES_EPOCHS {
            return found;
        }
        found.extend(self.displacement(first, &pairs, axes));
        let medians = |of: &dyn Fn(&StampStatistics) -> f64| {
            let own = median_of(pairs.iter().map(|(own, _)| of(own)), 0.0);
            (
                own,
                median_of(pairs.iter().map(|(_, other)| of(other)), 0.0),
            )
        };
        let (own, other) = medians(&|stamp| stamp.flux);
        let lit = own.is_significant() && other.is_significant() && other.value > 0.0;
        let noise = [self, first].map(|epoch| epoch.noise().value);
        found.extend(missing_galaxies([own, other], noise));
        // An aperture of 8 px of other sides has other light.
        if common_flux && lit && (determinant(axes).abs() - 1.0).abs() < EPOCH_FLUX {
            let ratio = own.value / other.value;
            // From pairs, whose fluxes differ less than fluxes of different galaxies.
            let residuals = pairs
                .iter()
                .map(|(own, other)| own.flux - ratio * other.flux);
            let error = median_of(residuals, 0.0).error / other.value.abs();
            let apart = Estimate {
                value: ratio - 1.0,
                error,
            };
            if apart.is_significant() && apart.value.abs() > EPOCH_FLUX {
                found.push(Warning::EpochFlux { ratio, error });
            }
        }
        let (own, other) = medians(&|stamp| stamp.core[0]);
        let scale = own.value / other.value;
        // Of Σ W n, whose weight W of σ = 1 px has Σ W² = π.
        let noise = PI.sqrt() * noise[0].hypot(scale * noise[1]);
        let differs = |(own, other): &&(&StampStatistics, &StampStatistics)| {
            let [own, other] = [own.core[0], scale * other.core[0]];
            let apart = Estimate {
                value: own - other,
                error: noise,
            };
            apart.is_significant() && apart.value.abs() > 0.5 * own.abs().max(other.abs())
        };
        let blank = self.blank.saturating_sub(first.blank);
        let (count, of) = (
            pairs.iter().filter(differs).count() + blank,
            pairs.len() + blank,
        );
        if lit && count as f64 > OTHER_GALAXIES * of as f64 {
            found.push(Warning::EpochGalaxies { count, of });
        }
        found
    }

    /// The displacement of galaxies from the first epoch, without the displacement of the PSFs: a galaxy moves with its PSF,
    /// and deconvolution moves it back.
    fn displacement(
        &self,
        first: &Self,
        pairs: &[(&StampStatistics, &StampStatistics)],
        axes: Matrix2,
    ) -> Option<Warning> {
        let (own_psf, first_psf) = (self.psf_offset(), first.psf_offset());
        let of_psfs = apply(axes, first_psf.map(|axis| axis.value));
        let away = [0, 1].map(|k| {
            let places = pairs
                .iter()
                .map(|(own, other)| own.place[k] - apply(axes, other.place)[k]);
            let Estimate { value, error } = median_of(places, 0.0);
            Estimate {
                value: value - (own_psf[k].value - of_psfs[k]),
                error: error.hypot(own_psf[k].error).hypot(first_psf[k].error),
            }
        });
        let (offset, away) = vector(away);
        let found = away.value > EPOCH_OFFSET && away.is_significant();
        found.then_some(Warning::EpochOffset {
            offset,
            error: away.error,
            from_first: true,
        })
    }

    /// Median offset of the PSFs from the centres of their stamps.
    fn psf_offset(&self) -> [Estimate; 2] {
        let noise = self.psfs.iter().map(|psf| PSF_CENTROID_NOISE / psf.snr());
        let noise = median_of(noise, 0.0).value;
        [0, 1].map(|k| {
            let found = median_of(self.psfs.iter().map(|psf| psf.offset[k]), noise);
            match self.psfs.is_empty() {
                true => Estimate {
                    value: 0.0,
                    error: 0.0,
                },
                false => found,
            }
        })
    }

    fn of(&self, at: usize) -> Option<&StampStatistics> {
        let place = self.stamps.binary_search_by_key(&at, |stamp| stamp.at);
        place.ok().map(|place| &self.stamps[place])
    }
}

/// A warning if one of two epochs has no light where the other has some. `fluxes` and `noise` are of this epoch and of the
/// first one.
fn missing_galaxies(fluxes: [Estimate; 2], noise: [f64; 2]) -> Option<Warning> {
    // Fluxes in units of the noise, because epochs may have different zero points.
    let seen = |k: usize| fluxes[k].is_significant() && fluxes[k].value > 0.0;
    let at_most = |k: usize| (fluxes[k].value + SIGNIFICANT * fluxes[k].error) / noise[k];
    let is_dark = |dark: usize, lit: usize| {
        seen(lit) && !seen(dark) && at_most(dark) < MIN_EPOCH_DEPTH * fluxes[lit].value / noise[lit]
    };
    let from_first = is_dark(1, 0);
    (from_first || is_dark(0, 1)).then_some(Warning::EpochWithoutGalaxies { from_first })
}

/// Median of numbers, each with an error of at least `floor`.
fn median_of(all: impl Iterator<Item = f64>, floor: f64) -> Estimate {
    let mut all: Vec<f64> = all.filter(|value| !value.is_nan()).collect();
    let count = all.len() as f64;
    let (value, scatter) = scatter(&mut all).unwrap_or((f64::NAN, f64::NAN));
    let error = OF_MEDIAN * scatter.max(floor) / count.sqrt();
    Estimate { value, error }
}

/// Both components, and their length with the larger of their errors.
fn vector([x, y]: [Estimate; 2]) -> ([f64; 2], Estimate) {
    let length = Estimate {
        value: x.value.hypot(y.value),
        error: x.error.max(y.error),
    };
    ([x.value, y.value], length)
}

/// Mean, variance and pairs of a square block from (y, x) on. A missing pixel counts as the mean of those that are present;
/// if less than half are, all results are NaN.
fn block(pixels: &[f32], n: usize, side: usize, (y0, x0): (usize, usize)) -> Block {
    let mut all = [0.0; BLOCK * BLOCK];
    let all = &mut all[..side * side];
    for (y, out) in all.chunks_exact_mut(side).enumerate() {
        let row = &pixels[(y0 + y) * n + x0..][..side];
        out.iter_mut()
            .zip(row)
            .for_each(|(out, &pixel)| *out = f64::from(pixel));
    }
    let present = || all.iter().filter(|value| value.is_finite());
    let count = present().count();
    if 2 * count < all.len() {
        return Block {
            mean: f64::NAN,
            variance: f64::NAN,
            pairs: [f64::NAN; 3],
        };
    }
    let mean = present().sum::<f64>() / count as f64;
    for value in all.iter_mut().filter(|value| !value.is_finite()) {
        *value = mean;
    }
    let row = |y: usize| &all[y * side..][..side];
    let middle = (side as f64 - 1.0) / 2.0;
    let [mut square, mut along, mut across, mut spread] = [0.0; 4];
    for y in 0..side {
        let dy = y as f64 - middle;
        spread += dy * dy * side as f64;
        for (x, value) in row(y).iter().enumerate() {
            let value = value - mean;
            square += value * value;
            along += value * (x as f64 - middle);
            across += value * dy;
        }
    }
    let mut pairs = [0.0; 3];
    let mut pair = |a: f64, b: f64| {
        pairs[0] += a * b;
        pairs[1] += a + b;
        pairs[2] += 1.0;
    };
    for apart in LONG_LAGS.into_iter().filter(|apart| *apart < side) {
        for y in 0..side {
            let here = row(y);
            here.iter()
                .zip(&here[apart..])
                .for_each(|(a, b)| pair(*a, *b));
            if y + apart < side {
                here.iter()
                    .zip(row(y + apart))
                    .for_each(|(a, b)| pair(*a, *b));
            }
        }
    }
    let plane = (along * along + across * across) / spread;
    Block {
        mean,
        variance: ((square - plane) / (count as f64 - 3.0)).clamp(0.0, f64::MAX),
        pairs,
    }
}

/// Whether a pixel is missing that the centroid or the narrow weight of a galaxy at `place` depends on.
fn misses_core(pixels: &[f32], n: usize, place: [f64; 2]) -> bool {
    let middle = (n as f64 - 1.0) / 2.0;
    let mut missing = pixels.iter().enumerate().filter(|(_, v)| !v.is_finite());
    missing.any(|(at, _)| {
        let [x, y] = [at % n, at / n].map(|at| at as f64 - middle);
        (x - place[0]).hypot(y - place[1]) < CORE_RADIUS_PX
    })
}

/// A number from the bits of the stamp's pixels.
fn trace(pixels: &[f32]) -> u64 {
    // Noise makes a fifth of the pixels different for every stamp.
    hash(pixels.iter().step_by(5).map(|value| value.to_bits()))
}

/// Median of up to four numbers, ignoring NaN.
fn median_ignoring_nan(values: &mut [f64; 4]) -> f64 {
    values.sort_by(f64::total_cmp);
    // NaN comes last, or first if its sign is negative.
    let first = values.iter().take_while(|value| value.is_nan()).count();
    let rest = &values[first..];
    let count = rest.iter().take_while(|value| !value.is_nan()).count();
    match count {
        0 => f64::NAN,
        _ => 0.5 * (rest[(count - 1) / 2] + rest[count / 2]),
    }
}

#[cfg(test)]
mod tests;
