//! Texts of the warnings about data. Those that are fatal stop the work.
//!
//! Their conditions are in `examine.rs`, `psf/quality.rs`, `noise.rs` and `session.rs`, and in `wcs.rs` and `measure/source.rs` of the pipeline.

use std::fmt;

use shearq_quantities::linear::{Matrix2, determinant, inverse, product};
use shearq_quantities::statistics::upper_median;
use shearq_quantities::{hints, tried};
use shearq_submissions::limits::MIN_PSF;
use strum_macros::IntoStaticStr;
use thiserror::Error;

use crate::measurement::{DefectCounts, Flag, Measurement, Observables};

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
    #[error("the stamps contain sky {}{}", sky(*level, *error, *noise, *share, *subtracted), tried(self.hint()))]
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
    #[error("the sky has a gradient {}{}", gradient(*slope, *error, *noise, *subtracted), tried(self.hint()))]
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
    #[error("the galaxies are off the centre of their stamps (found a median of {:+.2} px along x and {:+.2} px along y, ± {error:.2}; expected the middle){}", offset[0], offset[1], tried(self.hint()))]
    OffCentre {
        /// Median of their centroids from the middle, along x and y in pixels.
        offset: [f64; 2],
        error: f64,
    },
    /// The galaxies are at different places of their stamps.
    #[error("the galaxies are scattered over their stamps (found {:.1} px along x and {:.1} px along y; expected less than 2 px){}", scatter[0], scatter[1], tried(self.hint()))]
    PositionScatter {
        /// Scatter of their centroids along x and y in pixels.
        scatter: [f64; 2],
    },
    /// No pixel is left in the middle of galaxies.
    #[error("the mask covers the centres of {count} of {of} stamps (found no pixel within 2 px of them; expected the galaxies, and a mask of bad pixels){}", tried(self.hint()))]
    MaskedGalaxies { count: usize, of: usize },
    /// Most galaxies are darker than their surroundings.
    #[error("galaxies are darker than their surroundings (found negative flux on {count} of {of} stamps; expected positive flux){}", tried(self.hint()))]
    Negative { count: usize, of: usize },
    /// The noise differs from stamp to stamp.
    #[error("the noise differs between stamps (found a scatter of {:.0} %; expected one level){}", 100.0 * scatter, tried(self.hint()))]
    Depths {
        /// Scatter of the stamps' noise, in units of their median.
        scatter: f64,
    },
    /// Noise is correlated over more pixels than can be measured.
    #[error("the noise is correlated over more than 3 px (found {correlation:.2} for pixels 4 and 5 px apart; expected 0). The response is corrected for shorter correlations only: m is -0.2 at S/N 20 and -0.03 at S/N 60 for noise smoothed by a Gaussian of σ = 2 px{}", tried(self.hint()))]
    LongCorrelation {
        /// Mean correlation of pixels four and five apart along an axis.
        correlation: f64,
    },
    /// Rows or columns of the image have levels of their own.
    #[error(
        "the noise is banded (found {} with levels that differ by {scatter:.2} of the noise; expected one level), which changes c1 by about {c1:+.4} and m by about {m:+.4} at S/N 20, and by a quarter of it at S/N 40{}",
        if *rows { "rows" } else { "columns" },
        tried(self.hint())
    )]
    Banding {
        /// Whether along rows, or else columns.
        rows: bool,
        /// Root mean square of the levels in units of the noise.
        scatter: f64,
        /// The changes of m and c1 at S/N 20.
        m: f64,
        c1: f64,
    },
    /// The stamps have skies of several levels.
    #[error("the sky differs between stamps (found levels with a scatter of {scatter:.2} of the noise; expected one level){}", tried(self.hint()))]
    SkyLevels {
        /// In units of the noise of a pixel.
        scatter: f64,
    },
    /// The skies of the stamps have several slopes.
    #[error("the slope of the sky differs between stamps (found a scatter of {scatter:.4} of the noise per pixel; expected none), which changes m by about {m:.3}{}", tried(self.hint()))]
    SkySlopes {
        /// Along an axis, in units of the noise of a pixel per pixel.
        scatter: f64,
        m: f64,
    },
    /// The network stopped before its first iteration on most galaxies.
    #[error("the network makes no iteration (found {count} of {of} galaxies). Their images are not deconvolved{}", tried(self.hint()))]
    Idle { count: usize, of: usize },
    /// The mean response of the galaxies is not positive by three standard errors.
    #[error("the mean response to shear is not positive by 3 standard errors (found {:.3}, {:.3}){}", response[0], response[1], tried(self.hint()))]
    NoResponse { response: [f64; 2] },
    /// Stamps are copies of other stamps.
    #[error("stamps are copies of each other (found {count} of {of}; expected none). Copies make errors too small{}", tried(self.hint()))]
    Copies { count: usize, of: usize },
    /// All pixels of a stamp are equal, on every stamp examined.
    #[error("the stamps are blank (found equal pixels on each of {of} stamps; expected a galaxy and noise){}", tried(self.hint()))]
    Blank { of: usize },
    /// Pixel values are too small or large for single precision.
    #[error("pixel values are out of range (found brightest pixels of about {peak:.1e}; expected 1e-18 to 1e17){}", tried(self.hint()))]
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
    #[error("the given noise disagrees with the noise of the stamps (found {}, expected {}), which changes m by about {:+.3} at S/N 20, and by a quarter of it at S/N 40{}{}", significant(*given, 5), significant(*measured, 5), m_of_noise(given / measured), noise_advice(*given, *measured).0, tried(self.hint()))]
    GivenNoise { given: f64, measured: f64 },
    /// Noise is correlated, and the configuration treats it as white.
    #[error("the noise of neighbouring pixels is correlated, but is treated as white (found {:.2} along x and {:.2} along y, expected 0){}", correlation[0], correlation[1], tried(self.hint()))]
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
    #[error("the noise of neighbouring pixels is correlated, but epochs are combined as if it were white (found {:.2} along x and {:.2} along y, expected 0){}", correlation[0], correlation[1], tried(self.hint()))]
    EpochNoise {
        /// Correlation of neighbours along x and y.
        correlation: [f64; 2],
    },
    /// The noise of an epoch cannot be measured.
    #[error("cannot measure the noise: on no stamp are there enough pixels that differ and are not missing (expected galaxies and noise). The epoch is left out{}", tried(self.hint()))]
    EpochNoNoise,
    /// The galaxies of an epoch are not where its offsets and its PSF place them.
    #[error(
        "the galaxies are displaced from {} (found {:+.2} px along x and {:+.2} px along y, ± {error:.2}; expected 0), which blurs the combined galaxies{}",
        if *from_first { "those of the first epoch, beyond offsets and PSFs" } else { "the offsets that are stated" },
        offset[0], offset[1], tried(self.hint())
    )]
    EpochOffset {
        /// Median displacement along x and y in pixels.
        offset: [f64; 2],
        error: f64,
        /// Whether it is that from the galaxies of the first epoch, and not from the offsets alone.
        from_first: bool,
    },
    /// PSFs of one galaxy each have their centroids at several places, from which the galaxies are not counted.
    #[error("the PSFs are at several places of their stamps (found a scatter of {scatter:.2} px, which the galaxies do not have beyond their offsets; expected PSFs in the middle). Deconvolution moves each galaxy with its PSF, which blurs the combined galaxies{}", tried(self.hint()))]
    ScatteredPsfs {
        /// Root mean square in pixels along an axis.
        scatter: f64,
    },
    /// The galaxies of an epoch have another flux than in the first one.
    #[error("the galaxies have {ratio:.2} ± {error:.2} times the flux of the first epoch (expected 1): weights and leakage of the PSF are those of one flux{}", tried(self.hint()))]
    EpochFlux { ratio: f64, error: f64 },
    /// An epoch has no light at the stated places of the galaxies, or the first epoch has none.
    #[error("{} at the stated places (found no significant light there; expected the galaxies that {} shows){}", if *from_first { "the first epoch has no galaxies" } else { "there are no galaxies" }, if *from_first { "this epoch" } else { "the first epoch" }, tried(self.hint()))]
    EpochWithoutGalaxies { from_first: bool },
    /// An epoch contains other galaxies than the first one.
    #[error("{count} of {of} galaxies are not those of the first epoch (found stamps that are blank, or differ in brightness by a factor of 2 and 5 standard errors; expected the same galaxies){}", tried(self.hint()))]
    EpochGalaxies { count: usize, of: usize },
    /// Stamps of an epoch are copies of stamps of an earlier one.
    #[error("stamps are copies of those of an earlier epoch (found {count} of {of}; expected none), so that their noise does not average{}", tried(self.hint()))]
    EpochCopies { count: usize, of: usize },
    /// No stamp is good enough to measure the noise on.
    #[error("cannot measure the noise: on no stamp are there enough pixels that differ and are not missing. All galaxies are flagged{}", tried(self.hint()))]
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
    #[error("the PSF contains a background (found {} % of its peak{of}; expected 0). It changes the star's light by {:+.0} %{}{}", significant(100.0 * level, 3), 100.0 * share, background_effect(*m), tried(self.hint()))]
    PsfBackground {
        /// Level in units of the peak.
        level: f64,
        /// Its light in units of the star's.
        share: f64,
        /// The change of m, infinite if no shapes remain; NaN where it is not known.
        m: f64,
        of: ExaminedPsfs,
    },
    /// Pixels of the PSF have another value than the pixels around them allow.
    #[error(
        "pixels of the PSF are not those of a star (found {}{of}; expected a smooth PSF). Dead pixels bias c by up to 0.01, dead rows m by 0.15, hot pixels m by 0.02, cores cut at 0.9 of the peak m by 0.02, at 0.7 by 0.08{}",
        match (*dead, *hot) {
            (0, 0) => "several pixels of the brightest value".to_owned(),
            (0, hot) => format!("{hot} much brighter than those around them, {distance:.0} px from the centre"),
            (dead, _) => format!("{dead} much darker than those around them"),
        }, tried(self.hint())
    )]
    PsfDefect {
        dead: usize,
        hot: usize,
        /// Pixels from the centre of the farthest hot pixel.
        distance: f64,
        of: ExaminedPsfs,
    },
    /// The background of the PSF image changes along x or y.
    #[error("the background of the PSF has a gradient (found {:.3} % of the peak per pixel along x and {:.3} % along y{of}; expected 0). It biases shears{}", 100.0 * slope[0], 100.0 * slope[1], tried(self.hint()))]
    PsfGradient {
        /// Change per pixel along x and y in units of the peak.
        slope: [f64; 2],
        of: ExaminedPsfs,
    },
    /// Pixels hold no light and became missing.
    #[error(
        "pixels hold no light (found {} on {stamps} of {of} stamps: {} in areas of one value, {} far below the sky, {} brighter than the PSF allows, {} on lines across the stamp; expected none). They count as missing; {flagged} of these galaxies are flagged{}",
        counts.total(), counts.repeated, counts.dark, counts.bright, counts.lines, tried(self.hint())
    )]
    Defects {
        counts: DefectCounts,
        /// Stamps with such pixels.
        stamps: usize,
        flagged: usize,
        of: usize,
    },
    /// Stamps show no light in their middle, more than by noise.
    #[error("about {} of {of} stamps have no galaxy in their middle (found {count} with S/N below 0, where galaxies of S/N 5 have one in 10⁴). They add noise to mean shears, and to their response nothing{}", 2 * count, tried(self.hint()))]
    Empty { count: usize, of: usize },
    /// The brightest pixels of many stamps have one value.
    #[error("the brightest pixel is {} on {count} of {of} stamps (expected different values), as if light above it were cut off, which biases shears{}", significant(*level, 5), tried(self.hint()))]
    Saturated { level: f64, count: usize, of: usize },
    /// The brightest pixel of every stamp has one value.
    #[error("the brightest pixel is {} on each of {of} stamps (expected different values), as if they were divided by it, so that each stamp has another noise{}", significant(*level, 5), tried(self.hint()))]
    PeakNormalised { level: f64, of: usize },
    /// Pixels below a level were replaced by it.
    #[error("pixels are cut off from below (found {:.0} % of the pixels at the darkest value of their stamp, on {count} of {of} stamps; expected one pixel), which biases shears: m is about 0.1 if those below zero became zero, and 0.02 below −1 σ{}", 100.0 * share, tried(self.hint()))]
    Clipped { share: f64, count: usize, of: usize },
    /// The brightest pixels of a stamp have one value, on many stamps.
    #[error("several pixels have the brightest value of their stamp on {count} of {of} stamps (expected one pixel), as if light above it were cut off, which biases shears{}", tried(self.hint()))]
    FlatTops { count: usize, of: usize },
    /// Many galaxies come near the level at which the header states that pixels saturate.
    #[error("the brightest pixel of {count} of {of} stamps is above {near} of SATURATE of the header, {} (expected fainter galaxies): if the detector's response falls by 5 % there, m changes by about -0.009{}", significant(*level, 5), tried(self.hint()), near = NEAR_SATURATION)]
    NearSaturation { level: f64, count: usize, of: usize },
    /// The header states a gain, and galaxies have Poisson noise that the noise of the sky lacks.
    #[error("the noise is that of the sky, without the Poisson noise of the galaxies (found a gain of {} in the header, hence {:.1} electrons of noise per pixel, and a median S/N of {snr:.0}), which changes m by about {m:+.3}{}", significant(*gain, 3), electrons, tried(self.hint()))]
    PoissonNoise {
        /// Electrons per unit of the image.
        gain: f64,
        /// Noise of a pixel in electrons.
        electrons: f64,
        snr: f64,
        m: f64,
    },
    /// The noise of the star biases shears.
    #[error(
        "the PSF is noisy (found S/N {snr:.0}{of}; expected more than {enough:.0}). {}{}",
        effect.map_or_else(
            || "With a star of S/N 50 for each galaxy, m is right to 0.003 behind Moffat and Kolmogorov PSFs, and to 0.01 behind others".to_owned(),
            |[m, c]| format!("The noise of one star changes m by about {m:.3} and c by about {c:.3}"),
        ),
        tried(self.hint())
    )]
    PsfNoise {
        /// √(Σ p²)/σ.
        snr: f64,
        enough: f64,
        /// Standard deviations of m and c by the noise of one star for all galaxies.
        effect: Option<[f64; 2]>,
        of: ExaminedPsfs,
    },
    /// The borders of stamps are missing.
    #[error(
        "the borders of stamps are missing (found up to {width} px on {count} of {of} stamps surveyed; expected pixels). The noise is measured on the pixels inside of them, and the galaxies without them"
    )]
    MissingBorder {
        /// Width of the widest in pixels.
        width: usize,
        count: usize,
        of: usize,
    },
    /// The PSF image ends where there is light.
    #[error(
        "the PSF image is cut off (found {side:.0} px across, {} % of the peak at the edge and zeros beyond{of}; expected {MIN_PSF} px or more, or a smooth end). That changes m by about {:+.3}, and c by about {:.2} times the ellipticity of the PSF{}",
        significant(100.0 * level, 2), effect[0], effect[1], tried(self.hint())
    )]
    PsfTruncated {
        /// Pixels of the galaxies across the part that is not zero.
        side: f64,
        /// Light of a pixel at its edge in units of the peak.
        level: f64,
        /// Changes of m, and of c per ellipticity of the PSF.
        effect: [f64; 2],
        of: ExaminedPsfs,
    },
    /// The PSF is narrower than pixels can show.
    #[error(
        "the PSF is narrower than the pixels can show (found a transform of {power:.2} at 2 rad/px{of}). Aliased light changes m by about {:+.3} and c by up to {:.3}, to a factor of 3: m is positive for a PSF on a corner of its pixels, and negative on a centre{}",
        effect[0], effect[1], tried(self.hint())
    )]
    PsfNarrow {
        /// Modulus of the transform, of sum one.
        power: f64,
        /// Change of m, and the largest one of c.
        effect: [f64; 2],
        of: ExaminedPsfs,
    },
    /// The PSF is broader than the galaxies that were blurred by it.
    #[error(
        "the PSF is {} the galaxies (found a FWHM of {psf:.2} px in the core, expected {} the {galaxies:.2} px of the galaxies). A PSF sampled with another pixel scale biases m by up to 10{}",
        if *fatal { "broader than" } else { "nearly as broad as" },
        if *fatal { "less than" } else { "clearly less than" }, tried(self.hint())
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
    #[error("the PSF image and the galaxy image have different pixel scales (found {}, expected {} arcsec per pixel). This can bias m by 0.1 or more{}", six_digits(*psf), six_digits(*galaxies), tried(self.hint()))]
    PixelScale {
        /// Arcseconds per pixel of the PSF image.
        psf: f64,
        /// Arcseconds per pixel of the galaxy image.
        galaxies: f64,
    },
    /// The header of a file states the set and image of another file.
    #[error("the header of the {of} states another image (found SET = {} and IMAGE = {}, expected {} and {}). With galaxies or a PSF of another image shears are wrong{}", stated[0], stated[1], expected[0], expected[1], tried(self.hint()))]
    OtherImage {
        /// The content of the file: galaxies, or the PSF.
        of: &'static str,
        /// SET and IMAGE of the header.
        stated: [u32; 2],
        /// Set and image of the path.
        expected: [u32; 2],
    },
    /// Ellipticities are along pixel axes that the header rotates, mirrors or shears against the sky's.
    #[error("e1 and e2 are along the pixel axes, which are not the sky's (found {}; expected 0°, not mirrored, no shear){}", .0, tried(self.hint()))]
    PixelFrame(PixelFrame),
    /// The headers of the PSF image and of the galaxy image state pixel axes of different orientation or shear.
    #[error("the PSF image and the galaxy image have pixel axes of different orientation or shear (found {psf}; expected {galaxies}). The PSF is deconvolved in the wrong orientation{}", tried(self.hint()))]
    PsfFrame {
        psf: PixelFrame,
        galaxies: PixelFrame,
    },
    /// One PSF is deconvolved from stamps whose pixels differ on the sky.
    #[error("one PSF is for all stamps, whose pixels differ on the sky (found {first} at {:.4} arcsec per pixel, and {other} at {:.4}; expected a PSF per stamp). This is right only for a PSF that turns with the pixels{}", scales[0], scales[1], tried(self.hint()))]
    SharedPsf {
        first: PixelFrame,
        other: PixelFrame,
        /// Arcseconds per pixel of both.
        scales: [f64; 2],
    },
    /// The configuration uses so little of the PSF that its wings are missing.
    #[error("psf.size is {size} (expected {MIN_PSF} or more). The wings of the PSF that are cut off bias m, by about 0.002 at 20 px and 0.01 at 16 px for a FWHM of 3.4 px{}", tried(self.hint()))]
    PsfSize {
        /// Pixels a side that are used.
        size: usize,
    },
    /// Most galaxies could not be measured.
    #[error("{count} of {of} galaxies are flagged (most frequent reason: {flag}){}", tried(self.hint()))]
    Flagged { flag: Flag, count: usize, of: usize },
}

// m at S/N 20 by the relative excess v of the given variance, as −v/(1/this + v). 800 galaxies: −0.008, −0.033, −0.088 and −0.19 for a given σ
// that is 1.05, 1.2, 1.5 and 2 times the true one, +0.007, +0.028 and +0.058 for 0.95, 0.8 and 0.5; a quarter of it at S/N 40.
const M_BY_GIVEN_VARIANCE: f64 = 0.077;
// m times the S/N and the noise of a pixel in electrons: docs/survey.md, S/N 30 over 100 and 10 electrons of sky, +0.004 and +0.013.
const M_BY_POISSON_NOISE: f64 = 1.2;
// Least m that is stated: what Euclid requires.
const MIN_POISSON_M: f64 = 0.002;
const MIN_ELECTRONS: f64 = 2.0; // Of noise per pixel: detectors read with more, so that below it the gain is not that of the pixels.
// The column `snr` in units of the S/N: docs/limitations.md.
const SNR_COLUMN: f64 = 0.74;
// Share of negative fluxes of galaxies at S/N 5, whose column `snr` is 3.7 in the mean.
const NEGATIVE_AT_SNR_5: f64 = 1e-4;
// Share of negative fluxes that no galaxies of S/N 2 or more have: their mean column `snr` is 1.5. More are stamps without a galaxy.
const MAX_NEGATIVE_OF_FAINT: f64 = 0.1;
// Pixels without light per stamp that has any, up to which darker ones than bright ones are tails of the noise: Student's t of 5 degrees of
// freedom has 1.1 (0.77 of them dark), with m as without tails. Dead pixels and fill values come in areas, and cosmic rays are bright.
const MAX_TAIL_PIXELS: f64 = 1.5;
// Of the level of saturation, from which detectors are rarely linear to a per cent. Chosen by hand.
pub(crate) const NEAR_SATURATION: f64 = 0.8;
// Bright pixels among tails, in units of the dark ones: 0.3 of Student's t of 5 degrees of freedom, because light hides others. Chosen by hand.
const BRIGHT_TAILS: [f64; 2] = [0.1, 0.7];
// Standard deviations of a number beyond chance. Chosen by hand.
const MIN_EXCESS: f64 = 5.0;
// Relative difference of a noise level from a power of another one that is taken for it. Chosen by hand.
const POWER_OF_NOISE: f64 = 0.1;

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

// Least rotation of pixels that differ. Chosen by hand.
const MIN_ROTATION_DEGREES: f64 = 1.0;
// Least shear, and relative difference of scales, of pixels that differ: a difference of scales by 1 % changes m by about 0.01.
const MIN_PIXEL_DIFFERENCE: f64 = 0.01;

impl PixelFrame {
    /// Of the Jacobian ((du/dx, du/dy), (dv/dx, dv/dy)) of pixels, u to the west and v to the north.
    pub fn from_jacobian(jacobian: Matrix2) -> Self {
        let [[ux, uy], [vx, vy]] = jacobian;
        let all = determinant(jacobian);
        // A round object has the second moments J⁻¹ J⁻ᵀ in pixels; this is their ellipticity (Bartelmann & Schneider 2001,
        // eq. 4.10).
        let (xx, yy, xy) = (vy * vy + uy * uy, vx * vx + ux * ux, -(vx * vy + ux * uy));
        let size = xx + yy + 2.0 * all.abs();
        // The rotation of the polar decomposition, with +x mirrored where it is to the east.
        let parity = all.signum();
        PixelFrame {
            angle: (parity * vx - uy).atan2(parity * ux + vy).to_degrees(),
            mirrored: all < 0.0,
            shear: [(xx - yy) / size, 2.0 * xy / size],
        }
    }

    /// Whether pixels of these Jacobians differ in orientation, parity or shear.
    pub fn differ(first: Matrix2, other: Matrix2) -> bool {
        let PixelFrame {
            angle,
            mirrored,
            shear: [g1, g2],
        } = PixelFrame::from_jacobian(product(inverse(first), other));
        mirrored || angle.abs() > MIN_ROTATION_DEGREES || g1.hypot(g2) > MIN_PIXEL_DIFFERENCE
    }
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

    /// A warning if one PSF is for stamps with these Jacobians, which differ.
    pub fn of_shared_psf(pixels: impl IntoIterator<Item = Matrix2>) -> Option<Warning> {
        let mut pixels = pixels.into_iter();
        let first = pixels.next()?;
        let scale = |matrix: Matrix2| determinant(matrix).abs().sqrt();
        let differs = |other: &Matrix2| {
            let is_larger = (scale(*other) / scale(first) - 1.0).abs() > MIN_PIXEL_DIFFERENCE;
            is_larger || PixelFrame::differ(first, *other)
        };
        let other = pixels.find(differs)?;
        Some(Warning::SharedPsf {
            first: PixelFrame::from_jacobian(first),
            other: PixelFrame::from_jacobian(other),
            scales: [first, other].map(scale),
        })
    }

    /// Warnings about the galaxies of an image.
    pub(crate) fn of_galaxies(galaxies: &[Measurement]) -> impl Iterator<Item = Warning> {
        let flagged = galaxies.iter().filter(|g| !g.flags.is_empty()).count();
        let with = |flag: Flag| galaxies.iter().filter(|g| g.flags.contains(flag)).count();
        let flags = Warning::of_counts(Flag::ALL.map(with), flagged, galaxies.len());
        let defects = Warning::of_defects(galaxies);
        let flags = flags.into_iter().chain(defects);
        let flags = flags.chain(Warning::of_empty(galaxies));
        flags.chain(Warning::of_idle(galaxies))
    }

    /// A warning if many galaxies have a negative flux. They keep their rows: a flag that depends on the flux selects by shear, and half
    /// of the stamps without a galaxy have a positive one.
    fn of_empty(galaxies: &[Measurement]) -> Option<Warning> {
        let good = galaxies.iter().filter(|galaxy| galaxy.flags.is_empty());
        let observables = good.filter_map(|galaxy| galaxy.observables.as_ref());
        let snr: Vec<f64> = observables.map(Observables::snr).collect();
        let (count, of) = (negative_by_more_than_chance(&snr)?, snr.len());
        (2 * count <= of).then_some(Warning::Empty { count, of })
    }

    /// A warning if the Poisson noise of the galaxies matters, at so many electrons per unit of the image.
    pub(crate) fn of_poisson(galaxies: &[Measurement], gain: f64) -> Option<Warning> {
        let good = galaxies.iter().filter(|galaxy| galaxy.flags.is_empty());
        let seen =
            good.filter_map(|galaxy| Some((galaxy.observables.as_ref()?.snr(), galaxy.noise)));
        let (mut snr, mut noise): (Vec<f64>, Vec<f64>) = seen.unzip();
        let snr = upper_median(&mut snr)? / SNR_COLUMN;
        let electrons = gain * upper_median(&mut noise)?;
        let m = M_BY_POISSON_NOISE / (snr * electrons);
        (m > MIN_POISSON_M && m.is_finite() && electrons > MIN_ELECTRONS).then_some(
            Warning::PoissonNoise {
                gain,
                electrons,
                snr,
                m,
            },
        )
    }

    fn of_defects(galaxies: &[Measurement]) -> Option<Warning> {
        let mut counts = DefectCounts::default();
        let (mut stamps, mut flagged) = (0, 0);
        for galaxy in galaxies.iter().filter(|galaxy| !galaxy.defects.is_empty()) {
            counts += galaxy.defects;
            stamps += 1;
            flagged += usize::from(!galaxy.flags.is_empty());
        }
        (stamps > 0 && (flagged > 0 || !are_tails(counts, stamps))).then_some(Warning::Defects {
            counts,
            stamps,
            flagged,
            of: galaxies.len(),
        })
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

    hints! {
        Self::Epoch { warning, .. } => return warning.hint(),
        Self::Sky { subtracted: false, .. } | Self::Gradient { subtracted: false, .. } => "subtract the sky",
        Self::GivenNoise { given, measured } => noise_advice(*given, *measured).1,
        Self::PsfNoise { effect: None, .. } => "a model of the PSF, fitted to all stars",
        Self::PsfNoise { .. } => "average several stars, or fit a model",
        Self::OffCentre { .. } | Self::PositionScatter { .. } => "cut the stamps around the galaxies",
        Self::MaskedGalaxies { .. } => "--mask-bits with the bits of bad pixels (without DETECTED), or a mask that is no segmentation map",
        Self::Negative { .. } => "the image times -1 if it is inverted, or one that is no difference of images",
        Self::Depths { .. } => "give the noise of each stamp (gather --variance or --weight-map, `noise` in Python), or put stamps of one depth into an image",
        Self::LongCorrelation { .. } => "use images before resampling or smoothing",
        Self::Banding { rows, .. } => &format!("subtract from each {} of the exposure its median, without the galaxies", if *rows { "row" } else { "column" }),
        Self::SkyLevels { .. } | Self::SkySlopes { .. } => "--submission own.toml with the file own.toml of these lines:\n  extends = \"48/linear/star\"\n  noise.sky = \"stamp\"",
        Self::Idle { .. } => "other values of deconvolution.step and deconvolution.lambda",
        Self::NoResponse { .. } => "check that the PSF has the pixel scale of the galaxies, and that there are galaxies",
        Self::Copies { .. } => "remove repeated galaxies",
        Self::Blank { .. } => "check the file and its extension",
        Self::Brightness { peak } => &format!("divide the image and its noise by {peak:.0e}, as images in units such as erg/s/cm² require"),
        Self::CorrelatedNoise { .. } => "set noise.source to \"image\" and noise.correlation above 0",
        Self::EpochNoise { .. } => "exposures that were not resampled",
        Self::EpochNoNoise => "check the file, its extension and its mask",
        Self::EpochOffset { .. } => "check sign, order and axes of the dithers or positions, and that the PSF is centred on its stamp",
        Self::ScatteredPsfs { .. } => "PSFs in the middle of their stamps, or offsets of the galaxies less those of their PSFs",
        Self::EpochFlux { .. } => "scale image, noise and gain to one zero point",
        Self::EpochWithoutGalaxies { .. } => "check that image, WCS and dither belong together",
        Self::EpochGalaxies { .. } => "check that files and rows of the epochs belong together. Bands of galaxies with various colours may have this warning, too",
        Self::EpochCopies { .. } => "remove one of the epochs",
        Self::NoNoise => "cut off borders of missing pixels (with stamp.size of the smaller stamps in a settings file), and mask neighbours but not the sky and the galaxies",
        Self::PsfBackground { .. } => "subtract the background, or use a larger PSF stamp if the PSF fills it",
        Self::PsfDefect { .. } => "a model of the PSF, or other stars",
        Self::PsfGradient { .. } => "subtract the background",
        Self::Defects { .. } => "replace such pixels by NaN, and cut stamps before a deblender fills them",
        Self::Empty { .. } => "check that the positions are those of galaxies on this image",
        Self::Saturated { .. } | Self::FlatTops { .. } => "replace saturated pixels by NaN",
        Self::NearSaturation { .. } => "an image that is corrected for non-linearity, or such pixels as NaN",
        Self::PoissonNoise { gain, .. } => &format!("gather into a new folder with --gain {gain}, if this is the gain of the pixels"),
        Self::PeakNormalised { .. } => "stamps in one unit",
        Self::Clipped { .. } => "images whose negative pixels are kept",
        Self::PsfTruncated { .. } => "a larger PSF image (PSF_SIZE of PSFEx), which contains the wings",
        Self::PsfNarrow { .. } => "a PSF on finer pixels, with gather --psf-oversampling (psf_oversampling in Python); or check that the file is a PSF with the pixel scale of the galaxies",
        Self::PsfBroad { .. } => "check the sampling of the PSF, and that the objects are not stars",
        Self::PixelScale { .. } => "resample the PSF to the pixels of the galaxies, or correct its header",
        Self::OtherImage { .. } => "put the files back, or correct the header",
        Self::PixelFrame(..) => "transform e1 and e2 with the WCS, or compare them with shears along the pixel axes",
        Self::PsfFrame { .. } => "draw the PSF with the WCS of the galaxies, or correct its header",
        Self::SharedPsf { .. } => "a PSF on the pixels of each stamp",
        Self::PsfSize { .. } => &format!("psf.size = {MIN_PSF}"),
        Self::Flagged { flag, .. } => advice(*flag),
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
            "(found {level} ± {error} in their corners{in_noise}; expected 0). Its light within 8 px of a galaxy is {:.0} % of the galaxy's, which biases shears",
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
        false => ", which biases shears",
    };
    format!(
        "(found {x:+.4} along x and {y:+.4} along y, ± {error:.4}, in units of {name} per pixel; expected 0){end}"
    )
}

/// What a background of the PSF does to m.
fn background_effect(m: f64) -> String {
    if m.is_nan() {
        " and biases shears".to_owned()
    } else if m.is_infinite() {
        ", and leaves galaxies no width after deconvolution".to_owned()
    } else {
        format!(" and m by about {m:+.3}, to a factor of 2 for galaxies as wide as the PSF")
    }
}

/// m at S/N 20 if the given noise is `ratio` times the true one.
fn m_of_noise(ratio: f64) -> f64 {
    let excess = ratio * ratio - 1.0;
    -M_BY_GIVEN_VARIANCE * excess / (1.0 + M_BY_GIVEN_VARIANCE * excess)
}

/// What may be wrong with a given noise level, and what to try: a map of standard deviations, or of squared variances, in place of
/// variances.
fn noise_advice(given: f64, measured: f64) -> (&'static str, &'static str) {
    // Near one, a number and its square are alike.
    let is = |level: f64| {
        (measured / level - 1.0).abs() < POWER_OF_NOISE
            && (level / given).ln().abs() > POWER_OF_NOISE
    };
    if is(given * given) {
        (
            ". It is the square root of it: a map of variances may hold standard deviations",
            "square the map",
        )
    } else if is(given.sqrt()) {
        (
            ". It is the square of it: variances may be squared twice, or given as standard deviations",
            "take the square root",
        )
    } else {
        (
            "",
            "without `noise` (Python), --variance or --weight-map (gather), so that the noise is measured",
        )
    }
}

/// The number of galaxies with a negative S/N, if it exceeds that of galaxies of S/N 5, or of the fainter ones that the positive numbers
/// show.
fn negative_by_more_than_chance(snr: &[f64]) -> Option<usize> {
    let of = snr.len() as f64;
    let count = snr.iter().filter(|snr| **snr < 0.0).count();
    let mut positive: Vec<f64> = snr.iter().copied().filter(|snr| *snr > 0.0).collect();
    let rank = positive.len() / 4;
    let faint = match positive.is_empty() {
        true => f64::INFINITY,
        false => *positive.select_nth_unstable_by(rank, f64::total_cmp).1,
    };
    // Above the share of negative numbers of variance 1 about this mean.
    let of_faint = match count as f64 > MAX_NEGATIVE_OF_FAINT * of {
        true => 0.0,
        false => 0.5 * (-0.5 * faint * faint).exp(),
    };
    let chance = NEGATIVE_AT_SNR_5.max(of_faint) * of;
    (count as f64 > 1.0 + chance + MIN_EXCESS * chance.sqrt()).then_some(count)
}

/// Whether pixels that were removed on these stamps are the tails of their noise.
fn are_tails(counts: DefectCounts, stamps: usize) -> bool {
    let DefectCounts { dark, bright, .. } = counts;
    let few = f64::from(counts.total()) <= MAX_TAIL_PIXELS * stamps as f64;
    // Dead pixels alone are dark, and as many hot ones are no tails.
    let least = BRIGHT_TAILS[0] * f64::from(dark);
    let most = BRIGHT_TAILS[1] * f64::from(dark);
    few && (least..=most).contains(&f64::from(bright)) && dark + bright == counts.total()
}

/// A number with `digits` significant digits, in whatever unit pixels have.
pub fn significant(value: f64, digits: i32) -> String {
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
        Flag::NotFinite => {
            "check that masks leave the galaxies, that deblenders leave the sky, and that positions are pixels inside the image"
        }
        Flag::BadPsf => "check the PSF stamps: sum, centre and finite pixels",
        Flag::NoScale => "check that the stamps are not blank and that the noise is known",
        Flag::NoLight | Flag::NoExtent => "check the sky, the sign of the image and its units",
        Flag::NoShear => "check that there is a galaxy on the stamps",
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    #[test]
    fn faint_galaxies_are_told_from_stamps_without_any() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut found = |mean: f64, empty: usize| {
            let mut draw = |k: usize| -> f64 {
                let noise: f64 = StandardNormal.sample(&mut rng);
                noise + if k < empty { 0.0 } else { mean }
            };
            let snr: Vec<f64> = (0..1000).map(&mut draw).collect();
            negative_by_more_than_chance(&snr).is_some()
        };
        // The column `snr` is 0.74 of the S/N: 3, 5 and 20.
        assert!(!found(2.2, 0) && !found(3.7, 0) && !found(15.0, 0));
        assert!(found(3.7, 100) && found(15.0, 20) && found(15.0, 300) && found(2.2, 500));
    }

    #[test]
    fn tails_of_noise_are_no_defects() {
        let counts = |dark, bright| DefectCounts {
            dark,
            bright,
            ..DefectCounts::default()
        };
        assert!(are_tails(counts(154, 47), 178));
        // Cosmic rays, areas of fill values, and bad columns.
        assert!(!are_tails(counts(3, 47), 50));
        assert!(!are_tails(counts(500, 0), 10));
        // A dead pixel on each stamp, and a hot one on half of them.
        assert!(!are_tails(counts(80, 0), 80) && !are_tails(counts(40, 40), 80));
        let lines = DefectCounts {
            lines: 48,
            ..counts(1, 0)
        };
        assert!(!are_tails(lines, 48));
    }

    #[test]
    fn a_wrong_noise_level_states_its_m() {
        for (ratio, m) in [
            (1.05, -0.008),
            (1.5, -0.088),
            (2.0, -0.19),
            (0.8, 0.028),
            (0.5, 0.058),
        ] {
            assert!((m_of_noise(ratio) / m - 1.0).abs() < 0.1, "{ratio}");
        }
    }
}
