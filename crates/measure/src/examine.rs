//! Whether the stamps of an image meet the requirements of the measurement (sky subtracted, one galaxy in the middle of
//! each, noise of one level), and whether epochs show the same galaxies.
//!
//! Estimates are robust, so that neighbours on a few stamps do not matter. The sky is measured in the corners, where a galaxy has
//! least light.

use std::f64::consts::PI;

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::linear::{Matrix2, apply, determinant};
use shearq_quantities::statistics::{OF_MEDIAN, median, scatter};
use shearq_submissions::PsfCut;

use crate::defects::{Defects, LightLimits, extremes};
use crate::error::MeasureError;
use crate::moments::{
    CENTROID_WEIGHT_SIGMA, CORE_RADIUS_PX, CoreSize, core_sums, galaxy_centroid_near,
};
use crate::pixels::{PEAK_RANGE, Pixel, all_finite, highest};
use crate::psf::{PsfQuality, Psfs, Star, psf_warnings};
use crate::random::hash;
use crate::sky::{INNER_AREA, INNER_RADIUS, inner_light};
use crate::stamp::{FullStamp, SkySubtraction};
use crate::warning::{NEAR_SATURATION, Warning};

// Largest side in px of the corner blocks in which the sky is measured. Chosen by hand.
const BLOCK: usize = 8;
const BLOCKS_PER_SIDE: usize = 4; // At least, on small stamps. Chosen by hand.
// Square of the scatter of the rows' or columns' levels, in units of the pixel's variance. Offsets of 0.1 σ have 0.01, which 1000 stamps
// measure to 0.0015, and change c1 by 0.001 at S/N 20.
const BANDING: f64 = 0.004;
// The same of the other direction in units of it, below which it is banding and not noise of large scale. Chosen by hand.
const BANDING_ACROSS: f64 = 0.33;
// c1 by columns and m, in units of the squared scatter that is found, by waves of 2 px, waves of 4 px, and random levels. 1500 galaxies at S/N
// 20, columns of 0.2 σ: alternate ones c1 = +0.0037 and m = −0.0035, two and two +0.0058 and −0.0153, random ones −0.0069 and −0.0025. The
// squared scatter that is found is 4/3 as large for waves. Rows have c1 of the other sign; at S/N 40, all are a quarter.
const C1_BY_LEVELS: [f64; 3] = [0.078, 0.123, -0.17];
// m of the same.
const M_BY_LEVELS: [f64; 3] = [-0.066, -0.285, -0.05];
// By which c1 of waves falls behind the square: +0.0105 for alternate columns of 0.5 σ, +0.027 for 1 σ. The same galaxies.
const C1_DAMPING: f64 = 3.0;
// Shares of both waves in random levels, 0.159 + 0.302 without a straight line, and in waves: 0.81 for two and two.
const SHARE_OF_WAVES: [f64; 2] = [0.46, 0.8];
// Of four Gaussian numbers of variance 1.
const VARIANCE_OF_MEDIAN_OF_FOUR: f64 = 0.298;
// Share of the long correlation that a scatter of the stamps' levels explains, from which it is one. Chosen by hand.
const LEVELS_SHARE: f64 = 0.5;
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
// m over the square of the share that the scatter of the slopes has. 1600 galaxies of half-light radii 2.2 to 4 px at S/N 20: −0.012 for
// 0.01 of the noise per pixel along both axes, −0.047 for 0.02; at S/N 10 −0.048 for 0.01.
const M_PER_SQUARED_SLOPE_SHARE: f64 = -2.2;
// Relative error of the squared scatter of one stamp's number, from the median modulus: 2 × 1.17, of Gaussian noise.
const SQUARED_SCATTER_ERROR: f64 = 2.34;
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
// Radius of the middle of a galaxy in px: seldom saturated or damaged as a whole. Chosen by hand.
const MASKED_RADIUS_PX: f64 = 2.0;
// Share of galaxies with a masked middle. Chosen by hand: bad pixels and saturated galaxies are fewer.
const MASKED_GALAXIES: f64 = 0.1;
// Stamps with the largest peak in units of those with any other one. Chosen by hand.
const MIN_SATURATED: usize = 5;
// Share of pixels at the darkest value that is no chance, and that leaves others. Chosen by hand: noise clipped at −2 σ has 2 %.
const CLIPPED_SHARE: std::ops::RangeInclusive<f64> = 0.02..=0.95;
// Pixels at the brightest value of a stamp: symmetry makes two of them equal.
const MIN_FLAT_TOP: usize = 3;
// Share of stamps with a flat top. Chosen by hand.
const FLAT_TOPS: f64 = 0.05;
// Share of equal neighbours from which all values repeat, as whole numbers do. Chosen by hand.
const MAX_EQUAL_SHARE: f64 = 0.005;
// Noise over the peak below which symmetric galaxies may have equal pixels. Chosen by hand.
const MIN_NOISE_TO_PEAK: f64 = 1e-4;
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
    /// The same difference of two opposite corners from the other two, which noise makes as large, and no plane.
    saddle: f64,
    /// Noise of two of the corners, and of the other two.
    noise: [f64; 2],
    /// Sums over pairs at the distances `LONG_LAGS`: of products, of the pixels, and their number.
    pairs: [f64; 3],
    /// Variance that the rows of two corners share, and that the columns do: all of it, that of waves of 2 px, and of 4 px.
    bands: [[f64; 3]; 2],
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
    /// Whether all pixels are missing where a galaxy is expected.
    is_masked: bool,
    /// Share of pixels with the darkest value, and the number with the brightest; zero if other values repeat, too.
    darkest_share: f64,
    brightest: usize,
}

/// Sums over stamps of an image. They depend on nothing but the stamps and their order.
#[derive(Debug, Clone)]
pub struct Examination {
    stamp: FullStamp,
    /// What pixels hold light, if it is known.
    light: Option<LightLimits>,
    defects: Defects,
    block: usize,
    stamps: Vec<StampStatistics>,
    /// Stamps that were added.
    added: usize,
    blank: usize,
    psfs: Vec<PsfQuality>,
    /// What light behind these PSFs can look like.
    psf_light: Option<LightLimits>,
    /// Of PSFs of one galaxy each: their centroid, and that of the galaxy from its expected place.
    pairs: Vec<[[f64; 2]; 2]>,
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
    /// Levels of its rows and of its columns, without their straight line.
    lines: [[f64; BLOCK]; 2],
}

impl Examination {
    /// For `count` stamps of `full` pixels a side.
    pub fn new(full: usize, count: usize) -> Self {
        Examination {
            stamp: FullStamp::new(full),
            light: None,
            defects: Defects::new(full),
            block: BLOCK.min(full / BLOCKS_PER_SIDE),
            stamps: Vec::with_capacity(count),
            added: 0,
            blank: 0,
            psfs: Vec::new(),
            psf_light: None,
            pairs: Vec::new(),
            each: false,
        }
    }

    /// The same for stamps from which this is subtracted before they are measured.
    pub(crate) fn without(mut self, subtraction: SkySubtraction) -> Self {
        self.stamp.subtraction = subtraction;
        self
    }

    /// The same for stamps from which pixels are removed that hold no light.
    pub(crate) fn with_light(self, light: Option<LightLimits>) -> Self {
        Examination { light, ..self }
    }

    /// The same for stamps behind the PSFs that another examination has, from which pixels are removed that hold no light.
    #[must_use]
    pub fn behind(self, psfs: &Examination) -> Self {
        self.with_light(psfs.psf_light)
    }

    /// The same for PSFs of one galaxy each.
    #[must_use]
    pub fn with_psf_of_each(self) -> Self {
        Examination { each: true, ..self }
    }

    /// Examines the PSF of all galaxies, of sum one, whose star was at the offset `moved` in pixels before it was centred.
    pub fn add_psf(&mut self, psf: ArrayView2<'_, f64>, moved: Option<[f64; 2]>) {
        self.psfs.extend(PsfQuality::from_psf(psf, moved));
        let own = LightLimits::from_psf(psf);
        self.psf_light = Some(self.psf_light.map_or(own, |all| all.wider(&own)));
    }

    /// Examines a PSF of all galaxies, or up to `most` PSFs of one galaxy each, as a configuration cuts them. PSFs that
    /// cannot be used are left out.
    pub fn add_psfs(&mut self, psfs: &Psfs<'_>, cut: PsfCut, most: usize) {
        let count = psfs.count();
        self.each |= count.is_some();
        // The stamps of these PSFs were added before.
        let first = count.and_then(|count| self.added.checked_sub(count));
        let count = count.unwrap_or(1);
        let some = most.min(count);
        for at in (0..some).map(|k| (2 * k + 1) * count / (2 * some)) {
            if let Ok(Star {
                psf,
                moved,
                unshifted,
            }) = psfs.at(at, cut, self.stamp.side)
            {
                let psf = unshifted.unwrap_or(psf);
                let before = self.psfs.len();
                self.add_psf(psf.view(), moved);
                let stamp = first.and_then(|first| self.of(first + at));
                let both = stamp.zip(self.psfs.get(before));
                self.pairs
                    .extend(both.map(|(stamp, psf)| [psf.offset, stamp.place]));
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
        if let Some(light) = &self.light {
            let pixels = &mut self.stamp.pixels;
            self.defects.remove_before_survey(pixels, n, light);
        }
        // Without pixels, as of a galaxy that an exposure does not contain. All such stamps would be copies of each other.
        if self.stamp.pixels.iter().all(|value| !value.is_finite()) {
            return Ok(());
        }
        let (darkest_share, brightest) = ends(&self.stamp.pixels);
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
        let [rows, columns] = [0, 1].map(|axis| corners.map(|corner| corner.lines[axis]));
        let lines = self.block;
        let shared = |[first, second]: [[&[f64; BLOCK]; 2]; 2]| {
            let [first, second] =
                [first, second].map(|[a, b]| shared_levels(&a[..lines], &b[..lines]));
            // Two of the lines determine the straight one.
            [0, 1, 2].map(|k| (first[k] + second[k]) / (2.0 * (lines as f64 - 2.0)))
        };
        let bands = [
            shared([[&rows[0], &rows[1]], [&rows[2], &rows[3]]]),
            shared([[&columns[0], &columns[2]], [&columns[1], &columns[3]]]),
        ];
        let corner = median_ignoring_nan(&mut corners.map(|corner| corner.mean));
        let is_whole = all_finite(pixels);
        let border = StampStatistics {
            at: self.added - 1,
            corner,
            side: median_ignoring_nan(&mut sides.map(|side| side.mean)),
            slope: [(b + d - a - c) / apart, (c + d - a - b) / apart],
            saddle: (a + d - b - c) / apart,
            noise: [noise(corners[0], corners[3]), noise(corners[1], corners[2])],
            pairs,
            bands,
            peak: f64::from(highest(pixels)),
            trace: trace(pixels),
            place: [0.0; 2],
            flux: 0.0,
            core: [0.0; 2],
            // The centroid or the narrow weight depends on them.
            is_core_damaged: !is_whole && missing_near(pixels, n, place, CORE_RADIUS_PX)[0] > 0,
            is_masked: !is_whole
                && matches!(missing_near(pixels, n, place, MASKED_RADIUS_PX), [missing, of] if missing == of && of > 0),
            darkest_share,
            brightest,
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
        self.pairs.extend_from_slice(&other.pairs);
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
            let banding = self.banding(noise);
            let slopes = || self.sky_slopes(noise, flux);
            let long = || self.long_correlation(noise);
            found.extend(banding.or_else(slopes).or_else(long));
        }
        found.extend(self.subtracted(noise, flux));
        found.extend(sky);
        found.extend(gradient);
        let masked = self.stamps.iter().filter(|stamp| stamp.is_masked).count();
        if masked as f64 > MASKED_GALAXIES * examined as f64 {
            found.push(Warning::MaskedGalaxies {
                count: masked,
                of: examined,
            });
        } else if lit && flux > 0.0 {
            found.extend(self.places());
        }
        found.extend(self.depths());
        found.extend(self.copies(examined));
        found.extend(self.clipped(examined));
        let saturated = self.saturated(examined);
        found.extend(saturated.or_else(|| self.flat_tops(examined)));
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

    /// Compares the levels of rows, or columns, in one corner with those in the next, where galaxies and short correlations have no part.
    fn banding(&self, noise: f64) -> Option<Warning> {
        let mean = |axis: usize, of: usize| {
            self.clipped_mean(|stamp| stamp.bands[axis][of] / (noise * noise))
        };
        let [rows, columns] = [mean(0, 0)?, mean(1, 0)?];
        let (along_rows, found, other) = match rows.value > columns.value {
            true => (true, rows, columns),
            false => (false, columns, rows),
        };
        let is_banding = found.is_significant()
            && (BANDING..1.0).contains(&found.value)
            && other.value.abs() < BANDING_ACROSS * found.value;
        if !is_banding {
            return None;
        }
        let all = found.value;
        let wave = |of: usize| Some(mean(usize::from(!along_rows), of)?.value.clamp(0.0, all));
        let (of_two, of_four) = (wave(1)?, wave(2)?);
        let [random, regular] = SHARE_OF_WAVES;
        let waves = (((of_two + of_four) / all - random) / (regular - random)).clamp(0.0, 1.0);
        let two = of_two / (of_two + of_four).max(f64::MIN_POSITIVE);
        let effect = |[by_two, by_four, by_random]: [f64; 3], damping: f64| {
            let regular = (by_two * two + by_four * (1.0 - two)) / (1.0 + damping * all);
            (waves * regular + (1.0 - waves) * by_random) * all
        };
        let c1 = effect(C1_BY_LEVELS, C1_DAMPING);
        Some(Warning::Banding {
            rows: along_rows,
            scatter: all.sqrt(),
            m: effect(M_BY_LEVELS, 0.0),
            c1: if along_rows { -c1 } else { c1 },
        })
    }

    /// Compares the scatter of the slopes over stamps with that of the difference across: noise of any correlation that is shorter than the
    /// stamp makes them equal, and so do the wings of galaxies.
    fn sky_slopes(&self, noise: f64, flux: f64) -> Option<Warning> {
        let (x, count) = self.scatter_of(|stamp| stamp.slope[0])?;
        let (y, _) = self.scatter_of(|stamp| stamp.slope[1])?;
        let (across, _) = self.scatter_of(|stamp| stamp.saddle)?;
        let (of_slopes, of_noise) = (0.5 * (x * x + y * y), across * across);
        let count = count as f64;
        let excess = Estimate {
            value: of_slopes - of_noise,
            error: SQUARED_SCATTER_ERROR * (0.5 * of_slopes.powi(2) + of_noise.powi(2)).sqrt()
                / count.sqrt(),
        };
        let scatter = excess.value.max(0.0).sqrt();
        let share = scatter * (INNER_RADIUS * INNER_AREA / flux.abs());
        (excess.is_significant() && share > GRADIENT_SHARE).then_some(Warning::SkySlopes {
            scatter: scatter / noise,
            m: M_PER_SQUARED_SLOPE_SHARE * share * share,
        })
    }

    fn long_correlation(&self, noise: f64) -> Option<Warning> {
        let Estimate { value: level, .. } = self.median(|stamp| stamp.corner, 0.0);
        let found = self.clipped_mean(|stamp| {
            let [products, sums, count] = stamp.pairs;
            (products - level * sums + count * level * level) / (count * noise * noise)
        })?;
        let correlation = found.value;
        if !found.is_significant() || correlation < LONG_CORRELATION {
            return None;
        }
        let (corners, _) = self.scatter_of(|stamp| stamp.corner)?;
        let (sides, _) = self.scatter_of(|stamp| stamp.side)?;
        let (across, _) = self.scatter_of(|stamp| stamp.saddle)?;
        let (levels, of_sides) = (corners / noise, sides / noise);
        // The sum of four corners has twice the scatter of one.
        let apart = 2.0 * (self.stamp.side - self.block) as f64;
        let of_noise = VARIANCE_OF_MEDIAN_OF_FOUR * (0.5 * apart * across / noise).powi(2);
        // The wings of galaxies are fainter in the corners.
        let is_sky = levels > WINGS_RATIO * of_sides;
        if is_sky && levels * levels - of_noise > LEVELS_SHARE * correlation {
            return Some(Warning::SkyLevels { scatter: levels });
        }
        // Wings of galaxies without noise have more power than the fits that remove them leave for noise. What a block shares is
        // no part of its noise.
        let correlation = correlation / (1.0 + correlation);
        (is_sky || correlation < 0.5).then_some(Warning::LongCorrelation { correlation })
    }

    /// The scatter over stamps, and the number of those that have the quantity.
    fn scatter_of(&self, of: fn(&StampStatistics) -> f64) -> Option<(f64, usize)> {
        let mut all: Vec<f64> = self.stamps.iter().map(of).collect();
        all.retain(|own| own.is_finite());
        scatter(&mut all).map(|(_, scatter)| (scatter, all.len()))
    }

    /// The mean over stamps, each within 3 standard deviations of the median.
    fn clipped_mean(&self, of: impl Fn(&StampStatistics) -> f64) -> Option<Estimate> {
        let all = self.stamps.iter().map(of);
        let mut all: Vec<f64> = all.filter(|r| r.is_finite()).collect();
        let count = all.len() as f64;
        let (middle, scatter) = scatter(&mut all).filter(|_| count > 1.0)?;
        let most = 3.0 * scatter;
        let clipped = all.iter().map(|r| (r - middle).clamp(-most, most));
        Some(Estimate {
            value: middle + clipped.sum::<f64>() / count,
            error: scatter / count.sqrt(),
        })
    }

    fn copies(&self, of: usize) -> Option<Warning> {
        let mut traces: Vec<u64> = self.stamps.iter().map(|stamp| stamp.trace).collect();
        traces.sort_unstable();
        let count = traces.windows(2).filter(|pair| pair[0] == pair[1]).count();
        (count > 0).then_some(Warning::Copies { count, of })
    }

    /// A warning if the largest of all peaks occurs much more often than any other value: whole numbers repeat, too.
    fn saturated(&self, of: usize) -> Option<Warning> {
        let peaks = self.stamps.iter().map(|stamp| (stamp.peak, stamp.trace));
        let mut peaks: Vec<(f64, u64)> = peaks.collect();
        peaks.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        // Copies of a stamp have a warning of their own.
        peaks.dedup();
        let mut counts = peaks.chunk_by(|a, b| a.0 == b.0).map(<[_]>::len);
        let count = counts.next_back()?;
        let most = MIN_SATURATED * counts.max().unwrap_or(1);
        let (level, _) = *peaks.last()?;
        if count <= most {
            return None;
        }
        // Saturation leaves several pixels at the level, and fainter galaxies.
        let is_single = |stamp: &StampStatistics| stamp.brightest <= 1;
        Some(match count == of && self.stamps.iter().all(is_single) {
            true => Warning::PeakNormalised { level, of },
            false => Warning::Saturated { level, count, of },
        })
    }

    /// A warning if many pixels of most stamps have the darkest value of the stamp.
    fn clipped(&self, of: usize) -> Option<Warning> {
        let is_clipped = |stamp: &&StampStatistics| CLIPPED_SHARE.contains(&stamp.darkest_share);
        let clipped: Vec<_> = self.noisy().filter(is_clipped).collect();
        let count = clipped.len();
        let Estimate { value: share, .. } =
            median_of(clipped.into_iter().map(|stamp| stamp.darkest_share), 0.0);
        (2 * count > self.stamps.len()).then_some(Warning::Clipped { share, count, of })
    }

    /// A warning if several pixels of many stamps have the brightest value of the stamp: levels of saturation differ between exposures.
    fn flat_tops(&self, of: usize) -> Option<Warning> {
        let is_flat = |stamp: &&StampStatistics| stamp.brightest >= MIN_FLAT_TOP;
        let count = self.noisy().filter(is_flat).count();
        let least = (FLAT_TOPS * self.stamps.len() as f64).max(MIN_SATURATED as f64);
        (count as f64 > least).then_some(Warning::FlatTops { count, of })
    }

    /// A warning if many stamps come near this value, at which pixels saturate.
    pub(crate) fn near_saturation(&self, level: f64) -> Option<Warning> {
        let is_near = |stamp: &&StampStatistics| stamp.peak > NEAR_SATURATION * level;
        let count = self.stamps.iter().filter(is_near).count();
        let of = self.stamps.len();
        let is_many = count as f64 > FLAT_TOPS * of as f64;
        (level > 0.0 && is_many).then_some(Warning::NearSaturation { level, count, of })
    }

    fn noisy(&self) -> impl Iterator<Item = &StampStatistics> {
        let is_noisy = |stamp: &&StampStatistics| {
            stamp.noise[0].hypot(stamp.noise[1]) > MIN_NOISE_TO_PEAK * stamp.peak
        };
        self.stamps.iter().filter(is_noisy)
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
        let count = pairs.iter().filter(differs).count() + blank;
        let of = pairs.len() + blank;
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

    /// A warning if PSFs of one galaxy each are at several places of their stamps, and the galaxies do not follow them: deconvolution
    /// moves each galaxy with its PSF. PSFs that are drawn at the phase of a galaxy (as in MEDS) do so unless the expected place is
    /// that from the PSF's.
    pub(crate) fn scattered_psfs(&self) -> Option<Warning> {
        let is_known = |pair: &&[[f64; 2]; 2]| pair.as_flattened().iter().all(|at| at.is_finite());
        let pairs: Vec<_> = self.pairs.iter().filter(is_known).collect();
        let count = pairs.len() as f64;
        let mean = |of: usize, k: usize| pairs.iter().map(|pair| pair[of][k]).sum::<f64>() / count;
        let means = [0, 1].map(|of| [0, 1].map(|k| mean(of, k)));
        let centred = pairs
            .iter()
            .flat_map(|pair| [0, 1].map(|k| [0, 1].map(|of| pair[of][k] - means[of][k])));
        let centred: Vec<[f64; 2]> = centred.collect();
        let of_psfs: f64 = centred.iter().map(|[psf, _]| psf * psf).sum();
        let scatter = (of_psfs / centred.len() as f64).sqrt();
        let slope = centred.iter().map(|[psf, place]| psf * place).sum::<f64>() / of_psfs;
        let residuals = centred
            .iter()
            .map(|[psf, place]| (place - slope * psf).powi(2));
        let error = (residuals.sum::<f64>() / centred.len() as f64 / of_psfs).sqrt();
        let follow = Estimate {
            value: slope - 1.0,
            error,
        };
        let found = pairs.len() >= MIN_GALAXIES_EPOCHS
            && scatter > EPOCH_OFFSET
            && slope < 0.5
            && follow.is_significant();
        found.then_some(Warning::ScatteredPsfs { scatter })
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
            lines: [[f64::NAN; BLOCK]; 2],
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
    let mut lines = [[0.0; BLOCK]; 2];
    for (at, value) in all.iter().enumerate() {
        lines[0][at / side] += (value - mean) / side as f64;
        lines[1][at % side] += (value - mean) / side as f64;
    }
    for (line, moment) in lines.iter_mut().zip([across, along]) {
        for (at, level) in line[..side].iter_mut().enumerate() {
            *level -= moment / spread * (at as f64 - middle);
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
        lines,
    }
}

/// Sums over lines of products of their levels: of all, of waves of 2 px, and of waves of 4 px.
fn shared_levels(a: &[f64], b: &[f64]) -> [f64; 3] {
    let sum = |levels: &[f64], wave: [f64; 4]| {
        let along = levels.iter().zip(wave.iter().cycle());
        along.map(|(level, wave)| level * wave).sum::<f64>()
    };
    let both = |wave: [f64; 4]| sum(a, wave) * sum(b, wave) / a.len() as f64;
    let all = a.iter().zip(b).map(|(a, b)| a * b).sum();
    let four = both([1.0, 0.0, -1.0, 0.0]) + both([0.0, 1.0, 0.0, -1.0]);
    [all, both([1.0, -1.0, 1.0, -1.0]), 2.0 * four]
}

/// Pixels nearer to `place` than `radius`: those that are missing, and all.
fn missing_near(pixels: &[f32], n: usize, place: [f64; 2], radius: f64) -> [usize; 2] {
    let middle = (n as f64 - 1.0) / 2.0;
    let mut counts = [0; 2];
    for (at, value) in pixels.iter().enumerate() {
        let [x, y] = [at % n, at / n].map(|at| at as f64 - middle);
        if (x - place[0]).hypot(y - place[1]) < radius {
            counts[0] += usize::from(!value.is_finite());
            counts[1] += 1;
        }
    }
    counts
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

/// The share of finite pixels with the darkest value, and the number of those with the brightest one; zero if other values are often
/// those of the next pixel.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn ends(pixels: &[f32]) -> (f64, usize) {
    let [mut low, mut high] = extremes(pixels);
    if !(low.is_finite() && high.is_finite()) {
        let finite = || pixels.iter().copied().filter(|value| value.is_finite());
        low = finite().fold(f32::INFINITY, f32::min);
        high = finite().fold(f32::NEG_INFINITY, f32::max);
    }
    // Sums of whole numbers, so that vector instructions take several pixels at a time.
    let (mut darkest, mut brightest, mut count, mut equal) = (0u32, 0u32, 0u32, 0u32);
    for value in pixels {
        darkest += u32::from(*value == low);
        brightest += u32::from(*value == high);
        count += u32::from(value.is_finite());
    }
    for (value, next) in pixels.iter().zip(&pixels[1..]) {
        equal += u32::from((value == next) & (*value != low) & (*value != high));
    }
    match f64::from(equal) > MAX_EQUAL_SHARE * f64::from(count) {
        true => (0.0, 0),
        false => (f64::from(darkest) / f64::from(count), brightest as usize),
    }
}

#[cfg(test)]
mod tests;
