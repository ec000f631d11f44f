//! Whether the stamps of an image meet the requirements of the measurement (sky subtracted, one galaxy in the middle of
//! each, noise of one level), and whether epochs show the same galaxies.
//!
//! Estimates are robust, so that neighbours on a few stamps do not matter. The sky is measured in the corners, where a galaxy has
//! least light.

use std::f64::consts::PI;

use ndarray::ArrayView2;
use shearq_quantities::linear::{Matrix2, apply, determinant};
use shearq_quantities::statistics::{OF_MEDIAN, median, scatter};
use shearq_submissions::PsfCut;

use crate::error::MeasureError;
use crate::moments::{
    CENTROID_WEIGHT_SIGMA, CORE_RADIUS_PX, CoreSize, core_sums, galaxy_centroid_near,
};
use crate::psf::quality::{self, PsfQuality};
use crate::psf::{Psfs, Star};
use crate::sky::{INNER_AREA, INNER_RADIUS, inner_light};
use crate::stamp::{FullStamp, PEAK_RANGE, Pixel, SkySubtraction, hash, highest};
use crate::warning::Warning;

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
        quality::warnings(&self.psfs, !self.each, galaxies)
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
mod tests {
    use ndarray::Array2;

    use super::*;
    use crate::sky::Sky;

    const N: usize = 48;

    /// A Gaussian of 3 px on a stamp with a plane under it.
    fn stamp(level: f32, slope: [f32; 2], centre: [f32; 2]) -> Array2<f32> {
        Array2::from_shape_fn((N, N), |(y, x)| {
            let (x, y) = (x as f32 - 23.5, y as f32 - 23.5);
            let (dx, dy) = (x - centre[0], y - centre[1]);
            10.0 * (-(dx * dx + dy * dy) / 18.0).exp() + level + slope[0] * x + slope[1] * y
        })
    }

    #[test]
    fn a_stamp_shows_its_level_slope_and_centre() {
        let mut examination = Examination::new(N, 1);
        let stamp = stamp(0.5, [0.01, -0.02], [0.75, -0.5]);
        examination.add_at(stamp.view(), [0.75, 0.0]).unwrap();
        let stamp = examination.stamps[0];
        // In single precision.
        assert!((stamp.corner - 0.5).abs() < 1e-5, "{stamp:?}");
        assert!((stamp.slope[0] - 0.01).abs() < 1e-6, "{stamp:?}");
        assert!((stamp.slope[1] + 0.02).abs() < 1e-6, "{stamp:?}");
        assert!(stamp.noise[0] < 1e-4 && stamp.noise[1] < 1e-4, "{stamp:?}");
        // Centroids fall short of the centre, and planes pull them.
        assert!(stamp.place[0].abs() < 0.15, "{stamp:?}");
        assert!((stamp.place[1] + 0.5).abs() < 0.15, "{stamp:?}");
    }

    #[test]
    fn a_corner_with_missing_pixels_is_left_out() {
        let mut examination = Examination::new(N, 1);
        let mut stamp = stamp(0.5, [0.0; 2], [0.0; 2]);
        stamp[(1, 1)] = f32::NAN;
        stamp[(46, 2)] = 1e4;
        examination.add(stamp.view()).unwrap();
        assert!((examination.stamps[0].corner - 0.5).abs() < 1e-5);
        assert!(median_ignoring_nan(&mut [f64::NAN; 4]).is_nan());
        assert_eq!(
            median_ignoring_nan(&mut [3.0, -f64::NAN, f64::NAN, 1.0]),
            2.0
        );
        assert_eq!(median_ignoring_nan(&mut [4.0, 1.0, 9.0, 2.0]), 3.0);
    }

    #[test]
    fn a_missing_pixel_changes_nothing_about_a_plane() {
        let pixels = stamp(0.5, [0.02, -0.01], [0.0; 2]);
        let mut pixels = pixels.into_raw_vec_and_offset().0;
        let whole = block(&pixels, N, 8, (0, 0));
        pixels[N + 1] = f32::NAN;
        pixels[6 * N + 6] = f32::INFINITY;
        let most = block(&pixels, N, 8, (0, 0));
        assert!((most.mean - whole.mean).abs() < 1e-6, "{most:?} {whole:?}");
        // Two of 64 pixels on the plane's mean: their share of its slope's square, 0.03.
        assert!(most.variance < 1e-4, "{most:?}");
        for pixel in pixels.iter_mut().take(5 * N) {
            *pixel = f32::NAN;
        }
        let few = block(&pixels, N, 8, (0, 0));
        assert!(few.mean.is_nan() && few.variance.is_nan());
    }

    /// Bright pixels in the noise of corners, of which one pixel or all are missing.
    fn without_corners(all: bool) -> Examination {
        let mut examination = Examination::new(N, 8);
        for k in 0..8u8 {
            let mut stamp = stamp(0.0, [0.0, 0.0], [0.1 * f32::from(k), 0.0]);
            stamp[(5, 4)] += 10.0;
            for ((y, x), value) in stamp.indexed_iter_mut() {
                let away = |at: usize| at.min(N - 1 - at);
                let missing = if all {
                    away(x) < 8 && away(y) < 8
                } else {
                    away(x) == 1 && away(y) == 1
                };
                if missing {
                    *value = f32::NAN;
                }
            }
            examination.add(stamp.view()).unwrap();
        }
        examination
    }

    #[test]
    fn noise_is_that_of_the_pixels_that_corners_have() {
        let Estimate {
            value: noise,
            error,
        } = without_corners(false).noise();
        // One pixel of 10 among the 63 of a corner, in the mean with three corners without noise: √(10² / 60 / 4).
        assert!((noise - 0.645).abs() < 0.03, "{noise}");
        assert!(error.is_finite());
    }

    #[test]
    fn of_stamps_without_corners_all_but_noise_and_sky_is_told() {
        let examination = without_corners(true);
        assert!(examination.noise().value.is_nan());
        let sky = Sky {
            level: 0.1,
            level_error: 0.01,
            slope: [0.01, 0.0],
            slope_error: 0.001,
        };
        let subtracted = examination.clone().without(SkySubtraction::Plane(sky));
        for warning in [examination.warnings(), subtracted.warnings()].concat() {
            let text = warning.to_string();
            assert!(!text.contains("inf") && !text.contains("NaN"), "{text}");
        }
        assert!(examination.core().is_none() && examination.stamps.len() < MIN_GALAXIES_CORE);
        assert!(examination.stamps.iter().all(|stamp| stamp.flux > 100.0));
    }

    #[test]
    fn examinations_joined_are_one() {
        let [mut one, mut first, mut second] = [(); 3].map(|()| Examination::new(N, 8));
        for k in 0..8 {
            let stamp = stamp(0.5 + 0.1 * k as f32, [0.02, 0.0], [0.1 * k as f32, 0.0]);
            one.add(stamp.view()).unwrap();
            let part = if k < 3 { &mut first } else { &mut second };
            part.add(stamp.view()).unwrap();
        }
        first.join(&second);
        assert_eq!(first.warnings(), one.warnings());
        assert!(!one.warnings().is_empty());
    }

    /// An epoch of galaxies of several fluxes at `centre`, which is expected at `place`, with a PSF at `of_psf`. Its first stamp has
    /// no pixels.
    fn epoch(
        centre: [f32; 2],
        place: [f64; 2],
        of_psf: [f32; 2],
        order: [usize; 2],
    ) -> Examination {
        let mut epoch = Examination::new(N, 42);
        let missing = Array2::from_elem((N, N), f32::NAN);
        epoch.add(missing.view()).unwrap();
        epoch.add(missing.view()).unwrap();
        for k in 0..40 {
            let flux = 1.0 + ((order[0] + order[1] * k) % 40) as f32;
            let noise = |at: usize| ((at * at * (k + 1)) % 97) as f32 / 97.0 - 0.5;
            let mut stamp = stamp(0.0, [0.0; 2], centre) * flux;
            let pixels = stamp.iter_mut().enumerate();
            pixels.for_each(|(at, value)| *value += 0.1 * noise(at));
            epoch.add_at(stamp.view(), place).unwrap();
        }
        let star = stamp(0.0, [0.0; 2], of_psf).mapv(f64::from);
        let star = &star / star.sum();
        epoch.add_psf(star.view(), None);
        epoch
    }

    #[test]
    fn epochs_that_contradict_the_first_are_named() {
        const SAME: Matrix2 = [[1.0, 0.0], [0.0, 1.0]];
        let dither = [0.5, -0.25];
        let (at, centred) = (dither.map(f64::from), [0.0; 2]);
        let first = epoch([0.0; 2], centred, [0.0; 2], [0, 1]);
        // Stamps without pixels are no copies.
        assert_eq!(first.copies(42), None);
        let kinds = |other: &Examination, axes: Matrix2| {
            let found = other.contradictions(&[&first], axes, true);
            found.iter().map(Warning::kind).collect::<Vec<_>>()
        };
        // Galaxies with a lesser share of noise, so that all are compared.
        let mut scaled = epoch([0.0; 2], centred, [0.0; 2], [0, 1]);
        for stamp in &mut scaled.stamps {
            (stamp.flux, stamp.core[0], stamp.trace) = (2.0 * stamp.flux, 2.0 * stamp.core[0], 0);
        }
        // In other filters, galaxies have other fluxes.
        assert_eq!(scaled.contradictions(&[&first], SAME, false), []);
        for (other, expected) in [
            (epoch(dither, at, [0.0; 2], [0, 1]), &[][..]),
            (epoch(dither, centred, dither, [0, 1]), &[]),
            (
                epoch(dither, at.map(|at| -at), [0.0; 2], [0, 1]),
                &["epoch-offset"],
            ),
            (epoch(dither, at, [1.0, 0.0], [0, 1]), &["epoch-offset"]),
            (epoch(dither, at, [0.0; 2], [39, 39]), &["epoch-galaxies"]),
            (scaled, &["epoch-flux"]),
            (first.clone(), &["epoch-copies"]),
        ] {
            assert_eq!(kinds(&other, SAME), expected);
        }
        // Noise alone, in either of both.
        let mut dark = Examination::new(N, 42);
        for k in 0..42 {
            let noise = |at: usize| ((at * at * (k + 1)) % 97) as f32 / 97.0 - 0.5;
            let stamp = Array2::from_shape_fn((N, N), |(y, x)| 0.1 * noise(y * N + x));
            dark.add(stamp.view()).unwrap();
        }
        assert_eq!(kinds(&dark, SAME), ["epoch-without-galaxies"]);
        let found = first.contradictions(&[&dark], SAME, true);
        assert_eq!(found, [Warning::EpochWithoutGalaxies { from_first: true }]);
        // Galaxies off their places by as much on the sky, of an epoch whose x axis is mirrored.
        let both = [
            epoch(dither, centred, [0.0; 2], [0, 1]),
            epoch([-0.5, -0.25], centred, [0.0; 2], [0, 1]),
        ];
        assert!(
            both[1]
                .contradictions(&[&both[0]], [[-1.0, 0.0], [0.0, 1.0]], true)
                .is_empty()
        );
        assert!(!both[1].contradictions(&[&both[0]], SAME, true).is_empty());
    }

    #[test]
    fn galaxies_with_missing_cores_are_not_compared() {
        const SAME: Matrix2 = [[1.0, 0.0], [0.0, 1.0]];
        let [mut first, mut masked] = [(); 2].map(|()| Examination::new(N, 80));
        for k in 0..80u8 {
            let galaxy = stamp(0.0, [0.0; 2], [0.01 * f32::from(k), 0.0]);
            first.add(galaxy.view()).unwrap();
            let mut damaged = galaxy.clone();
            // A quarter without the columns of its core.
            if k % 4 == 0 {
                damaged.slice_mut(ndarray::s![.., 22..26]).fill(f32::NAN);
            }
            // No copies of each other.
            damaged *= 1.001;
            masked.add(damaged.view()).unwrap();
        }
        assert_eq!(masked.contradictions(&[&first], SAME, true), []);
    }

    #[test]
    fn the_noise_of_a_star_has_one_effect_on_all_galaxies_or_none() {
        // Checks, which fourth differences see as noise.
        let star = Array2::from_shape_fn((N, N), |(y, x)| {
            let noise = if (x / 2 + y / 3) % 2 == 0 {
                2e-4
            } else {
                -2e-4
            };
            f64::from(stamp(0.0, [0.0; 2], [0.0; 2])[(y, x)]) / 565.5 + noise
        });
        let mut one = Examination::new(N, 1);
        assert_eq!(one.psf_noise(), None);
        one.add_psf(star.view(), None);
        let [m, c] = one.psf_noise().unwrap();
        assert!(m > 1e-3 && c > 0.3 * m && c < m, "{m} {c}");
        let stars = ndarray::stack![ndarray::Axis(0), star, star];
        let mut several = Examination::new(N, 2);
        several.add_psfs(&Psfs::stars(stars), N.into(), 2);
        assert_eq!((several.psfs.len(), several.psf_noise()), (2, None));
        // Stars of S/N 100 are enough for a galaxy each, but not for all galaxies.
        assert!(m < 0.02, "{m}");
        let noisy = |examination: &Examination| {
            let mut warnings = examination.warnings().into_iter();
            warnings.any(|warning| matches!(warning, Warning::PsfNoise { .. }))
        };
        assert!(noisy(&one) && !noisy(&one.clone().with_psf_of_each()));
    }

    #[test]
    fn rows_are_spread_without_a_period_and_cover_small_images() {
        assert_eq!(examined_rows(16, 16), (0..16).collect::<Vec<_>>());
        assert_eq!(examined_rows(7, 1), [0]);
        assert!(examined_rows(7, 0).is_empty());
        let rows = examined_rows(100, 100);
        assert_eq!(rows.len(), 10);
        // Where a few rows more than are enough are spread, two chosen places may be in one row.
        for side in 1..120 {
            let rows = examined_rows(side, side);
            assert!(rows.windows(2).all(|pair| pair[0] < pair[1]), "{side}");
            assert!(rows.last() < Some(&side));
        }
        let even = rows.iter().filter(|row| *row % 2 == 0).count();
        assert!((3..=7).contains(&even), "{rows:?}");
    }

    // Odd, so that the median of evenly spread values is the middle one. Errors of the median are then below all limits.
    const COUNT: usize = 2001;

    /// Stamps with noise of one and galaxies of flux 1000, each changed with its number from −1 to 1.
    fn examined(change: impl Fn(f64, &mut StampStatistics)) -> Examination {
        let mut examination = Examination::new(N, COUNT);
        examination.added = COUNT;
        examination.stamps = (0..COUNT)
            .map(|at| {
                let mut stamp = StampStatistics {
                    at,
                    corner: 0.0,
                    side: 0.0,
                    slope: [0.0; 2],
                    noise: [1.0; 2],
                    pairs: [0.0, 0.0, 100.0],
                    place: [0.0; 2],
                    flux: 1000.0,
                    peak: 20.0,
                    core: [100.0, 100.0],
                    trace: at as u64,
                    is_core_damaged: false,
                };
                change(2.0 * at as f64 / (COUNT - 1) as f64 - 1.0, &mut stamp);
                stamp
            })
            .collect();
        examination
    }

    /// Whether a kind of warning is there beyond its limit and absent before it, by a fifth. Limits are literal: a test that
    /// takes the constant itself does not notice another value.
    fn begins_at(limit: f64, kind: &str, warnings: impl Fn(f64) -> Vec<Warning>) {
        for (factor, expected) in [(0.8, false), (1.2, true)] {
            let found = warnings(factor * limit);
            let has = found.iter().any(|warning| warning.kind() == kind);
            assert_eq!(has, expected, "{kind} at {factor} times {limit}: {found:?}");
        }
    }

    #[test]
    fn warnings_about_stamps_begin_at_their_limits() {
        let light_of_sky = 1000.0 / INNER_AREA;
        begins_at(0.15, "sky", |share| {
            let level = share * light_of_sky;
            examined(|_, stamp| (stamp.corner, stamp.side) = (level, level)).warnings()
        });
        begins_at(0.6, "sky", |ratio| {
            examined(|_, stamp| (stamp.corner, stamp.side) = (2.0, 2.0 / ratio)).warnings()
        });
        begins_at(0.04, "gradient", |share| {
            let slope = share * light_of_sky / INNER_RADIUS;
            examined(|_, stamp| stamp.slope = [0.0, slope]).warnings()
        });
        begins_at(0.85, "off-centre", |offset| {
            examined(|_, stamp| stamp.place = [offset, 0.0]).warnings()
        });
        // Half of the places of an even spread of ±1 are within ½ of its median; of a normal one, within 1/1.4826 of σ.
        begins_at(2.0, "position-scatter", |scatter| {
            examined(|at, stamp| stamp.place[1] = 2.0 / 1.4826 * scatter * at).warnings()
        });
        begins_at(0.1, "depths", |scatter| {
            examined(|at, stamp| stamp.noise = [(3f64.sqrt() * scatter * at).exp(); 2]).warnings()
        });
        begins_at(0.03, "long-correlation", |correlation| {
            examined(|_, stamp| stamp.pairs[0] = 100.0 * correlation).warnings()
        });
        begins_at(0.02, "given-noise", |difference| {
            let given = examined(|_, _| {}).given_noise(1.0 + difference);
            given.into_iter().collect()
        });
    }

    #[test]
    fn a_noisy_psf_has_an_uncertain_centroid() {
        let mut epoch = examined(|_, _| {});
        epoch.add_psf(stamp(0.0, [0.0; 2], [0.0; 2]).mapv(f64::from).view(), None);
        // The weight of a centroid has σ = 2 px.
        let expected = OF_MEDIAN * 2.0 / epoch.psfs[0].snr();
        let found = epoch.psf_offset()[0].error;
        assert!((found - expected).abs() < 1e-12, "{found} {expected}");
    }

    #[test]
    fn warnings_about_epochs_begin_at_their_limits() {
        const SAME: Matrix2 = [[1.0, 0.0], [0.0, 1.0]];
        // Copies are told by their trace.
        let epoch = |change: &dyn Fn(f64, &mut StampStatistics)| {
            let first = examined(|_, _| {});
            let own = examined(|at, stamp| {
                stamp.trace += COUNT as u64;
                change(at, stamp);
            });
            own.contradictions(&[&first], SAME, true)
        };
        begins_at(0.1, "epoch-offset", |offset| {
            epoch(&|_, stamp| stamp.place[0] = offset)
        });
        begins_at(0.2, "epoch-flux", |difference| {
            epoch(&|_, stamp| stamp.flux *= 1.0 + difference)
        });
        begins_at(0.1, "epoch-galaxies", |share| {
            epoch(&|at, stamp| {
                if 0.5 * (at + 1.0) < share {
                    stamp.core[0] = 300.0;
                }
            })
        });
        // Without significant flux, this epoch has at most five errors of its median: below the limit it cannot show the galaxies.
        let error = OF_MEDIAN * 1.4826 * 0.5 / (COUNT as f64).sqrt();
        begins_at(4.0, "epoch-without-galaxies", |times_deeper| {
            let spread = 1000.0 / times_deeper / (SIGNIFICANT * error);
            epoch(&|at, stamp| stamp.flux = spread * at)
        });
    }

    #[test]
    fn bright_stars_count_as_four_galaxies_in_the_core() {
        let core = |count: usize| {
            let mut examination = examined(|_, _| {});
            examination.stamps.truncate(count);
            examination.stamps[0].core = [10_000.0, 5_000.0];
            examination.core().map(|core| core.mean_square_radius)
        };
        assert_eq!(core(29), None);
        let q = 0.5 * (29.0 * 100.0 + 4.0 * 50.0) / (29.0 * 100.0 + 4.0 * 100.0);
        let expected = CoreSize::from_weighted(q, 0.0).unwrap();
        let found = core(30).unwrap();
        assert!(
            (found / expected.mean_square_radius - 1.0).abs() < 1e-12,
            "{found}"
        );
    }
}
