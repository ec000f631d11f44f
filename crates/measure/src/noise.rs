//! The noise of an image, measured on the stamps of its galaxies: its level, and the correlation of its pixels; and with it
//! the mean square radius of the galaxies and the sky.
//!
//! Blocks of 8 × 8 pixels along the border of many stamps are surveyed. The wings of the galaxies are smooth there: the
//! polynomials of second degree that fit a block best are removed, and products of the residuals are summed for each lag.
//! The fit removes a share that follows from geometry alone, so that the covariance C, which is zero beyond a largest lag,
//! is the solution of the linear equations
//!
//! ```text
//! Σ_blocks Σ_p q(p) q(p + l) = Σ_l′ M(l, l′) C(l′),    q = (1 − BBᵀ) x,
//! ```
//!
//! B being the polynomials, orthonormal on the block. Blocks brighter than noise makes them, and their neighbours along
//! the border, are left out: there is another galaxy. So are blocks near a place that is brighter than the opposite one:
//! a neighbour may raise their power by a few per cent only, which adds up if all stamps have one.
//!
//! Galaxies look nearly the same rotated by 180° about their centre, and neighbours do not: [`Asymmetry`] compares each place of
//! a stamp with the opposite one.

use std::iter;
use std::ops::Range;
use std::sync::Arc;

use multiversion::multiversion;
use ndarray::{Array2, ArrayView2};
use shearq_quantities::PixelShape;
use shearq_quantities::linear::{Pivots, eliminate, substitute};
use shearq_quantities::statistics::{SCATTER, median};
use shearq_submissions::SkySource;

use crate::defects::{Defects, LightLimits};
use crate::error::MeasureError;
use crate::examine::enough;
use crate::missing::{MissingPixels, missing_border, padding, rotation_sum};
use crate::moments::{GalaxyMoments, galaxy_centroid};
use crate::pixels::{PEAK_RANGE, Pixel, all_finite, highest};
use crate::sky::{Sky, SkyLevels, inner_light};
use crate::stamp::{FullStamp, SkySubtraction};
use crate::warning::Warning;

// In pixels. Chosen by hand.
const BLOCK_SIDE: usize = 8;
const BLOCK_PIXELS: usize = BLOCK_SIDE * BLOCK_SIDE;
// 1, x, y, x², xy and y².
const POLYNOMIALS: usize = 6;
// The border of smaller stamps has light of the galaxy. Chosen by hand.
const MIN_STAMP_SIDE: usize = 24;
// Far above rounding. The matrix depends on geometry alone.
const MIN_PIVOT: f64 = 1e-9;
// Of a mode of correlated noise, in units of white noise: a sum over few lags may be negative. Chosen by hand.
const MIN_POWER: f64 = 1e-3;
// Excess of a block's cube-root power above the median, in units of the scatter, beyond which it is left out. Loses less
// than 10⁻⁴ of the power of white noise, 2·10⁻³ of the long waves of smoothed noise. Command and seed not recorded.
const MAX_BLOCK_EXCESS: f64 = 4.0;
// Blocks to each side of a bright one that are left out with it. Chosen by hand.
const NEIGHBOURING_BLOCKS: usize = 2;
// Excess of a place over its opposite, in σ, above which the blocks around it are left out.
// A tenth of the stamps without neighbours lose some. Chosen by hand.
const MAX_CONTRAST: f32 = 3.5;
// In pixels around such a place. Chosen by hand.
const CONTRAST_RADIUS: f32 = 16.0;
// Smaller differences of opposite places, in units of the stamp's largest, are rounding. Chosen by hand.
const MIN_CONTRAST: f32 = 1e-4;
// One vector of AVX-512.
const LANES: usize = 16;

/// The noise of an image: its level, and the correlation of its pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct StampNoise {
    sigma: f64,
    error: f64,
    max_lag: usize,
    /// At lags dy = 0…max_lag, dx = −max_lag…max_lag.
    correlation: Vec<f64>,
    /// χ² of the correlation against white noise, and its degrees of freedom.
    chi2: (f64, f64),
}

impl StampNoise {
    /// White noise of a known level in image units.
    pub fn white(sigma: f64) -> Self {
        StampNoise {
            sigma,
            error: 0.0,
            max_lag: 0,
            correlation: vec![1.0],
            chi2: (0.0, 0.0),
        }
    }

    /// The noise that explains the products of blocks, one per lag. `None` if the variance is not positive.
    fn from_products(plan: &NoisePlan, blocks: &[&[f32]]) -> Option<StampNoise> {
        let count = blocks.len() as f64;
        let mean = |lag| {
            blocks
                .iter()
                .map(|block| f64::from(block[lag]))
                .sum::<f64>()
                / count
        };
        let covariance = solve(plan.matrix.view(), (0..plan.lags.len()).map(mean))?;
        let variance = covariance[0];
        if !(variance > 0.0 && variance.is_finite()) {
            return None;
        }
        let max_lag = plan.max_lag as i32;
        let width = 2 * max_lag + 1;
        let mut correlation = vec![0.0; ((max_lag + 1) * width) as usize];
        for (&(dx, dy), value) in plan.lags.iter().zip(&covariance) {
            let ratio = value / variance;
            correlation[(dy * width + dx + max_lag) as usize] = ratio;
            if dy == 0 {
                correlation[(max_lag - dx) as usize] = ratio;
            }
        }
        let chi2 = count * white_chi2(&plan.matrix, &covariance) / (variance * variance);
        // The variance is the mean of a sum of products of each block. Their scatter contains what correlation and lags that are
        // fitted together add to the error, and how noise that is not Gaussian changes it.
        let weights = solve(plan.matrix.t(), iter::once(1.0).chain(iter::repeat(0.0)))?;
        let squares = blocks.iter().map(|block| {
            let of_block = block.iter().zip(&weights).map(|(p, w)| f64::from(*p) * w);
            (of_block.sum::<f64>() - variance).powi(2)
        });
        let of_variance = (squares.sum::<f64>() / (count * (count - 1.0))).sqrt();
        Some(StampNoise {
            sigma: variance.sqrt(),
            error: 0.5 * of_variance / variance,
            max_lag: plan.max_lag,
            correlation,
            chi2: (chi2, covariance.len() as f64 - 1.0),
        })
    }

    /// Standard deviation of a pixel in image units.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Standard error of the level, in units of it.
    pub fn error(&self) -> f64 {
        self.error
    }

    /// Noise of the same correlation and another standard deviation.
    pub fn at_level(&self, sigma: f64) -> Self {
        StampNoise {
            sigma,
            ..self.clone()
        }
    }

    /// The correlation of pixels so far apart along the axis along which it is larger, whatever its sign.
    pub fn correlation_along(&self, distance: i32) -> f64 {
        let [x, y] = [(distance, 0), (0, distance)].map(|(dx, dy)| self.correlation(dx, dy));
        if x.abs() > y.abs() { x } else { y }
    }

    /// Correlation of pixels (dx, dy) apart.
    pub fn correlation(&self, dx: i32, dy: i32) -> f64 {
        let (dx, dy) = if dy < 0 { (-dx, -dy) } else { (dx, dy) };
        let max_lag = self.max_lag as i32;
        if dx.abs() > max_lag || dy > max_lag {
            return 0.0;
        }
        self.correlation[(dy * (2 * max_lag + 1) + dx + max_lag) as usize]
    }

    /// Whether all wave vectors have the same power.
    pub(crate) fn is_white(&self) -> bool {
        self.max_lag == 0
    }

    /// Whether pixels are correlated more than by chance: χ² exceeds its mean by five of its standard deviations.
    pub fn is_correlated(&self) -> bool {
        let (chi2, freedom) = self.chi2;
        chi2 > freedom + 5.0 * (2.0 * freedom).sqrt()
    }

    /// Power at wave vector (kx, ky), in radians per pixel, in units of that of white noise of the same level, and its
    /// derivatives (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y), by which a shear of the image changes it. With pixels that are
    /// not square, in the coordinates of [`PixelShape::map`].
    pub fn power(&self, [kx, ky]: [f64; 2], pixels: PixelShape) -> (f64, [f64; 2]) {
        let max_lag = self.max_lag as i32;
        let (mut power, mut slopes) = (1.0, [0.0; 2]);
        for dy in 0..=max_lag {
            for dx in -max_lag..=max_lag {
                if dy == 0 && dx <= 0 {
                    continue;
                }
                let [x, y] = pixels.map([f64::from(dx), f64::from(dy)]);
                let twice = 2.0 * self.correlation(dx, dy);
                let (sin, cos) = (kx * x + ky * y).sin_cos();
                power += twice * cos;
                slopes[0] -= twice * sin * (kx * x - ky * y);
                slopes[1] -= twice * sin * (ky * x + kx * y);
            }
        }
        if power < MIN_POWER {
            return (MIN_POWER, [0.0; 2]);
        }
        (power, slopes)
    }
}

/// The x of a matrix times x = `right`; `None` if the matrix is singular.
fn solve(matrix: ArrayView2<'_, f64>, right: impl Iterator<Item = f64>) -> Option<Vec<f64>> {
    let rows = matrix.rows().into_iter().zip(right);
    let mut rows: Vec<Vec<f64>> = rows
        .map(|(row, right)| row.iter().copied().chain([right]).collect())
        .collect();
    if !eliminate(&mut rows, Pivots::Largest, MIN_PIVOT) {
        return None;
    }
    let mut out = vec![0.0; rows.len()];
    substitute(&rows, &mut out);
    Some(out)
}

/// χ² of a covariance against white noise of variance one, for one block.
///
/// With S_l one for pixels ±l apart, products are q′S_l q/2 (q′q at l = 0), so that M(l, l′) = tr(P S_l P S_l′)/2 (without
/// the half at l = 0) and, in white noise, the products' covariance is M(l, l′), and twice that for l′ = 0. That of the
/// solutions has the inverse A(l, l′) = M(l′, l), half of it for l′ = 0, of which the variance at lag zero, whatever it is,
/// takes its share.
fn white_chi2(matrix: &Array2<f64>, covariance: &[f64]) -> f64 {
    let inverse = |i: usize, j: usize| matrix[(j, i)] * if j == 0 { 0.5 } else { 1.0 };
    let mut chi2 = 0.0;
    for i in 1..covariance.len() {
        for j in 1..covariance.len() {
            let freed = inverse(i, 0) * inverse(0, j) / inverse(0, 0);
            chi2 += covariance[i] * covariance[j] * (inverse(i, j) - freed);
        }
    }
    chi2
}

/// What a survey of an image's stamps found.
#[derive(Debug, Clone, PartialEq)]
pub struct Survey {
    /// The noise of the image.
    pub noise: StampNoise,
    /// Mean square radius per axis of the galaxies behind the PSF, in px²; `None` of a few galaxies.
    pub mean_square_radius: Option<f64>,
    /// The sky that is to be subtracted from the stamps; `None` if it does not matter.
    pub sky: Option<Sky>,
}

/// The geometry of surveys of stamps of one size.
#[derive(Debug, Clone)]
pub struct NoisePlan {
    full: usize,
    max_lag: usize,
    /// How the sky is treated; `None` if it is not measured.
    sky: Option<SkySource>,
    /// First pixels (y, x) of the blocks, around the border.
    blocks: Arc<[(usize, usize)]>,
    /// (dx, dy) of half the plane, zero first.
    lags: Arc<[(i32, i32)]>,
    polynomials: Arc<[[f64; BLOCK_PIXELS]; POLYNOMIALS]>,
    /// M(l, l′).
    matrix: Arc<Array2<f64>>,
}

impl NoisePlan {
    /// For stamps of `full` pixels a side and a covariance of lags up to `max_lag` along each axis; `sky` as a configuration
    /// treats it.
    ///
    /// # Errors
    /// If the stamps are too small for their blocks.
    pub fn new(full: usize, max_lag: usize, sky: Option<SkySource>) -> Result<Self, MeasureError> {
        if full < MIN_STAMP_SIDE {
            let expected = format!(
                "at least {MIN_STAMP_SIDE} × {MIN_STAMP_SIDE}, for the noise to be measured on their frames"
            );
            return Err(MeasureError::square("stamps", (full, full), expected));
        }
        if max_lag > BLOCK_SIDE / 2 {
            return Err(MeasureError::Shape {
                what: "a noise correlation",
                found: format!("lags up to {max_lag} px"),
                expected: format!("at most {} px", BLOCK_SIDE / 2),
            });
        }
        let polynomials = polynomials();
        let lags = lags(max_lag as i32);
        Ok(NoisePlan {
            full,
            max_lag,
            sky,
            blocks: border_blocks(full).into(),
            matrix: Arc::new(matrix(&lags, &polynomials)),
            lags: lags.into(),
            polynomials: Arc::new(polynomials),
        })
    }

    /// Which of `rows` rows of `columns` stamps are surveyed, evenly spread: enough for a thousand stamps, or all.
    pub fn rows(&self, columns: usize, rows: usize) -> Vec<usize> {
        let count = enough(columns, rows);
        (0..count)
            .map(|k| (2 * k + 1) * rows / (2 * count))
            .collect()
    }

    /// A survey without stamps.
    pub fn survey(&self) -> NoiseSurvey {
        NoiseSurvey {
            plan: self.clone(),
            stamp: FullStamp {
                subtraction: SkySubtraction::of(self.sky, None),
                ..FullStamp::new(self.full)
            },
            light: None,
            defects: Defects::new(self.full),
            asymmetry: Asymmetry::new(self.full),
            missing: MissingPixels::new(self.full),
            contrasts: Vec::new(),
            places: Default::default(),
            products: Vec::new(),
            block_contrasts: Vec::new(),
            typical_contrasts: Vec::new(),
            galaxies: GalaxyMoments::default(),
            levels: (self.sky == Some(SkySource::Image)).then(SkyLevels::default),
            peak: 0.0,
            surveyed: 0,
            incomplete: 0,
            unusable: 0,
            bordered: [0; 2],
        }
    }
}

/// Blocks side by side from the edges of a stamp inwards, once around its border.
fn border_blocks(full: usize) -> Vec<(usize, usize)> {
    let count = full / BLOCK_SIDE;
    let start = |at: usize| {
        if 2 * at < count {
            at * BLOCK_SIDE
        } else {
            full - (count - at) * BLOCK_SIDE
        }
    };
    let last = count - 1;
    let top = (0..last).map(|at| (0, at));
    let right = (0..last).map(|at| (at, last));
    let bottom = (1..=last).rev().map(|at| (last, at));
    let left = (1..=last).rev().map(|at| (at, 0));
    let ring = top.chain(right).chain(bottom).chain(left);
    ring.map(|(y, x)| (start(y), start(x))).collect()
}

fn lags(max_lag: i32) -> Vec<(i32, i32)> {
    let rows = (0..=max_lag).flat_map(|dy| (-max_lag..=max_lag).map(move |dx| (dx, dy)));
    let half = rows.filter(|&(dx, dy)| dy > 0 || dx >= 0);
    half.collect()
}

/// 1, x, y, x², xy and y² on a block, made orthonormal (Gram and Schmidt).
fn polynomials() -> [[f64; BLOCK_PIXELS]; POLYNOMIALS] {
    let mut out = [[0.0; BLOCK_PIXELS]; POLYNOMIALS];
    let powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)];
    for (k, (px, py)) in powers.into_iter().enumerate() {
        let middle = (BLOCK_SIDE as f64 - 1.0) / 2.0;
        let (done, rest) = out.split_at_mut(k);
        let own = &mut rest[0];
        for (at, value) in own.iter_mut().enumerate() {
            let y = (at / BLOCK_SIDE) as f64 - middle;
            let x = (at % BLOCK_SIDE) as f64 - middle;
            *value = x.powi(px) * y.powi(py);
        }
        remove_polynomials(done, own);
        let norm = own.iter().map(|value| value * value).sum::<f64>().sqrt();
        own.iter_mut().for_each(|value| *value /= norm);
    }
    out
}

/// M(l, l′): the mean of the products at lag l on noise of covariance one at ±l′ and zero elsewhere.
fn matrix(lags: &[(i32, i32)], polynomials: &[[f64; BLOCK_PIXELS]; POLYNOMIALS]) -> Array2<f64> {
    let mut out = Array2::zeros((lags.len(), lags.len()));
    let place = |at: usize| ((at % BLOCK_SIDE) as i32, (at / BLOCK_SIDE) as i32);
    for (j, &(dx, dy)) in lags.iter().enumerate() {
        // Covariance of the block's pixels: polynomials are removed by columns, and then by rows.
        let mut covariance: Vec<[f64; BLOCK_PIXELS]> = (0..BLOCK_PIXELS)
            .map(|a| {
                std::array::from_fn(|b| {
                    let ((ax, ay), (bx, by)) = (place(a), place(b));
                    let lag = (bx - ax, by - ay);
                    f64::from(lag == (dx, dy) || lag == (-dx, -dy))
                })
            })
            .collect();
        for _ in 0..2 {
            for row in &mut covariance {
                remove_polynomials(polynomials, row);
            }
            covariance = (0..BLOCK_PIXELS)
                .map(|a| std::array::from_fn(|b| covariance[b][a]))
                .collect();
        }
        for (i, &(dx, dy)) in lags.iter().enumerate() {
            let mut sum = 0.0;
            for (a, row) in covariance.iter().enumerate() {
                let (x, y) = place(a);
                let (x, y) = (x + dx, y + dy);
                let side = 0..BLOCK_SIDE as i32;
                if side.contains(&x) && side.contains(&y) {
                    sum += row[y as usize * BLOCK_SIDE + x as usize];
                }
            }
            out[(i, j)] = sum;
        }
    }
    out
}

/// Removes the polynomials from a block, and writes the sum of products of its residuals at each lag.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn residual_products(
    polynomials: &[[f64; BLOCK_PIXELS]],
    lags: &[(i32, i32)],
    block: &mut [f64],
    products: &mut [f32],
) {
    remove_polynomials(polynomials, block);
    // Between zeros, so that all lags are sums over rows of one length.
    let mut rows = [[0.0; 3 * BLOCK_SIDE]; BLOCK_SIDE];
    for (row, from) in rows.iter_mut().zip(block.chunks_exact(BLOCK_SIDE)) {
        row[BLOCK_SIDE..2 * BLOCK_SIDE].copy_from_slice(from);
    }
    for (out, &(dx, dy)) in products.iter_mut().zip(lags) {
        *out = product(&rows, dx, dy) as f32;
    }
}

#[inline(always)]
fn remove_polynomials(polynomials: &[[f64; BLOCK_PIXELS]], block: &mut [f64]) {
    for polynomial in polynomials {
        // Columns side by side, so that an addition does not wait for the one before.
        let mut columns = [0.0; BLOCK_SIDE];
        let rows = polynomial.chunks_exact(BLOCK_SIDE);
        for (p, row) in rows.zip(block.chunks_exact(BLOCK_SIDE)) {
            for (sum, (p, value)) in columns.iter_mut().zip(p.iter().zip(row)) {
                *sum += p * value;
            }
        }
        let share: f64 = columns.iter().sum();
        for (value, p) in block.iter_mut().zip(polynomial) {
            *value -= share * p;
        }
    }
}

#[inline(always)]
fn product(rows: &[[f64; 3 * BLOCK_SIDE]; BLOCK_SIDE], dx: i32, dy: i32) -> f64 {
    let right = BLOCK_SIDE.saturating_add_signed(dx as isize);
    let mut columns = [0.0; BLOCK_SIDE];
    for (a, b) in rows.iter().zip(&rows[dy as usize..]) {
        let pairs = a[BLOCK_SIDE..2 * BLOCK_SIDE]
            .iter()
            .zip(&b[right..right + BLOCK_SIDE]);
        for (sum, (a, b)) in columns.iter_mut().zip(pairs) {
            *sum += a * b;
        }
    }
    columns.iter().sum()
}

/// A survey of stamps of an image. Its result depends on nothing but the stamps and their order.
#[derive(Debug, Clone)]
pub struct NoiseSurvey {
    plan: NoisePlan,
    /// Its sky is subtracted for all but the noise.
    stamp: FullStamp,
    /// What pixels hold light, if it is known.
    light: Option<LightLimits>,
    defects: Defects,
    asymmetry: Asymmetry,
    missing: MissingPixels,
    /// Of each place of the last stamp its excess over its opposite in units of √pixels, and its (x, y) from the galaxy.
    contrasts: Vec<f32>,
    places: [Vec<f32>; 2],
    /// Of each block, stamp by stamp, the sum of products at each lag; NaN where pixels are missing.
    products: Vec<f32>,
    /// Of each block the largest contrast around it.
    block_contrasts: Vec<f32>,
    /// Of each stamp the median contrast.
    typical_contrasts: Vec<f32>,
    galaxies: GalaxyMoments,
    /// Until the sky is found.
    levels: Option<SkyLevels>,
    peak: f32,
    surveyed: usize,
    incomplete: usize,
    unusable: usize,
    /// Stamps whose border is missing, and its largest width in pixels.
    bordered: [usize; 2],
}

impl NoiseSurvey {
    /// The same of stamps from which pixels are removed that hold no light.
    pub(crate) fn with_light(self, light: Option<LightLimits>) -> Self {
        NoiseSurvey { light, ..self }
    }

    /// Surveys a stamp. Blocks begin inside of a missing border. Those with missing pixels are left out, those along an edge whose pixels are all equal (padding has
    /// no noise), and stamps where too many pixels are missing or all are equal.
    ///
    /// # Errors
    /// If the stamp has other sizes than planned.
    pub fn add<T: Pixel>(&mut self, stamp: ArrayView2<'_, T>) -> Result<(), MeasureError> {
        let full = self.plan.full;
        self.stamp.read(stamp)?;
        let padded = padding(&self.stamp.pixels, full).map(|depth| depth > 0);
        let mut is_whole = all_finite(&self.stamp.pixels);
        self.incomplete += usize::from(!is_whole);
        let mut has_defects = false;
        if let Some(light) = &self.light {
            let pixels = &mut self.stamp.pixels;
            let found = self.defects.remove_before_survey(pixels, full, light);
            has_defects = !found.is_empty();
            is_whole &= !has_defects;
        }
        self.peak = self.peak.max(highest(&self.stamp.pixels));
        self.surveyed += 1;
        if self.stamp.is_blank() {
            self.unusable += 1;
            return Ok(());
        }
        if self.levels.is_some() {
            self.stamp.cells.measure(&self.stamp.pixels);
        }
        let products = self.products.len();
        // Of pixels as given: a sky is smooth, and the light that fills missing pixels has no noise.
        self.add_products(padded);
        self.stamp.subtract_sky();
        if !(is_whole || self.missing.fill(&mut self.stamp.pixels, full)) {
            self.products.truncate(products);
            // Stamps that are filled around their galaxies show no noise, which is an error.
            self.unusable += usize::from(!has_defects);
            return Ok(());
        }
        if let Some(levels) = &mut self.levels {
            levels.add(&self.stamp.cells, inner_light(&self.stamp.pixels, full));
        }
        self.add_contrasts();
        Ok(())
    }

    fn add_products(&mut self, padded: [bool; 4]) {
        let NoisePlan {
            full,
            ref blocks,
            ref lags,
            ref polynomials,
            ..
        } = self.plan;
        let mut block = [0.0; BLOCK_PIXELS];
        let border = missing_border(&self.stamp.pixels, full);
        if border > 0 {
            let [count, widest] = self.bordered;
            self.bordered = [count + 1, widest.max(border)];
        }
        // Those at the edges move, and overlap the next ones.
        let inward = |first: usize| first.clamp(border, full - border - BLOCK_SIDE);
        for &(y0, x0) in &**blocks {
            let (y, x) = (inward(y0), inward(x0));
            let rows = self.stamp.pixels.chunks_exact(full).skip(y);
            for (to, row) in block.chunks_exact_mut(BLOCK_SIDE).zip(rows) {
                for (value, pixel) in to.iter_mut().zip(&row[x..]) {
                    *value = f64::from(*pixel);
                }
            }
            let edges = [
                y0 == 0,
                y0 + BLOCK_SIDE == full,
                x0 == 0,
                x0 + BLOCK_SIDE == full,
            ];
            let is_padded = edges.iter().zip(padded).any(|(at, padded)| *at && padded);
            if is_padded || block.iter().any(|value| !value.is_finite()) {
                self.products.extend(iter::repeat_n(f32::NAN, lags.len()));
                continue;
            }
            let first = self.products.len();
            self.products.resize(first + lags.len(), 0.0);
            residual_products(
                &**polynomials,
                lags,
                &mut block,
                &mut self.products[first..],
            );
        }
    }

    /// Adds the size of the galaxy, and by how much places are brighter than their opposites.
    fn add_contrasts(&mut self) {
        let full = self.plan.full;
        let centroid = galaxy_centroid(&self.stamp.pixels, full);
        self.galaxies.add(&self.stamp.pixels, full);
        let rotation = rotation_sum(centroid, full);
        self.asymmetry.compare(&self.stamp.pixels, rotation);
        let places = &self.asymmetry.places;
        self.contrasts.clear();
        self.contrasts
            .extend(places.iter().map(|at| at.excess / at.pixels.sqrt()));
        for (axis, to) in self.places.iter_mut().enumerate() {
            to.clear();
            to.extend(places.iter().map(|at| at.offset[axis]));
        }
        for &(y0, x0) in &*self.plan.blocks {
            let middle = |first: usize, rotation: i32| {
                first as f32 + (BLOCK_SIDE as f32 - 1.0) / 2.0 - rotation as f32 / 2.0
            };
            let block = [middle(x0, rotation[0]), middle(y0, rotation[1])];
            self.block_contrasts
                .push(largest_around(block, &self.places, &self.contrasts));
        }
        let largest = places.iter().map(|at| at.excess).fold(0.0, f32::max);
        // One side may have been filled from the other, which leaves no difference but rounding.
        let mut at = places.iter();
        self.contrasts.retain(|_| {
            at.next()
                .is_some_and(|at| at.excess > MIN_CONTRAST * largest)
        });
        self.typical_contrasts.extend(median(&mut self.contrasts));
    }

    /// Adds the stamps of another survey, as if they had been added here.
    ///
    /// # Errors
    /// If the surveys have different plans.
    pub fn join(&mut self, other: &Self) -> Result<(), MeasureError> {
        let describe = |NoisePlan { full, max_lag, .. }: &NoisePlan| {
            format!("stamps of {full} × {full} pixels with lags up to {max_lag} px")
        };
        if (self.plan.full, self.plan.max_lag) != (other.plan.full, other.plan.max_lag) {
            return Err(MeasureError::Shape {
                what: "a noise survey",
                found: describe(&other.plan),
                expected: describe(&self.plan),
            });
        }
        self.products.extend_from_slice(&other.products);
        self.block_contrasts
            .extend_from_slice(&other.block_contrasts);
        self.typical_contrasts
            .extend_from_slice(&other.typical_contrasts);
        self.galaxies.join(&other.galaxies);
        if let (Some(levels), Some(more)) = (&mut self.levels, &other.levels) {
            levels.join(more);
        }
        self.peak = self.peak.max(other.peak);
        self.surveyed += other.surveyed;
        self.incomplete += other.incomplete;
        self.unusable += other.unusable;
        let ([count, widest], [more, width]) = (self.bordered, other.bordered);
        self.bordered = [count + more, widest.max(width)];
        Ok(())
    }

    /// What the stamps show of their image; `None` if all of them are unusable, so that their galaxies will be flagged.
    ///
    /// # Errors
    /// If usable stamps do not show the noise.
    pub fn result(&self) -> Result<Option<Survey>, MeasureError> {
        let sky = match self.stamp.subtraction {
            SkySubtraction::Plane(sky) => Some(sky),
            SkySubtraction::Nothing | SkySubtraction::EachStamp => None,
        };
        match self.noise() {
            Some(noise) => Ok(Some(Survey {
                noise,
                mean_square_radius: self.galaxies.mean_square_radius(),
                sky,
            })),
            None if self.surveyed == self.unusable => Ok(None),
            None if self.peak > 0.0 && !PEAK_RANGE.contains(&self.peak) => {
                Err(MeasureError::Data(Warning::Brightness {
                    peak: f64::from(self.peak),
                }))
            }
            None => Err(MeasureError::NoBorders {
                examined: self.surveyed,
                incomplete: self.incomplete,
            }),
        }
    }

    /// A warning if the borders of stamps are missing.
    pub(crate) fn missing_border(&self) -> Option<Warning> {
        let [count, width] = self.bordered;
        let of = self.surveyed;
        (count > 0).then_some(Warning::MissingBorder { width, count, of })
    }

    /// A survey for a second pass over the stamps, without the sky that was found on them, if it matters: galaxies are
    /// centred and compared better without sky.
    pub fn without_sky(&self) -> Option<NoiseSurvey> {
        let sky = self.sky()?;
        let mut again = self.plan.survey().with_light(self.light);
        again.levels = None;
        again.stamp.subtraction = SkySubtraction::of(self.plan.sky, Some(sky));
        Some(again)
    }

    /// The sky under the stamps, away from other galaxies.
    fn sky(&self) -> Option<Sky> {
        let levels = self.levels.as_ref()?;
        let ring = self.plan.blocks.len();
        // A gradient makes one side of all stamps brighter than the other: only contrast beyond the median of a block counts.
        let medians: Vec<f32> = (0..ring)
            .map(|at| {
                let of_block = self.block_contrasts.iter().skip(at).step_by(ring);
                median(&mut of_block.copied().collect::<Vec<_>>())
            })
            .collect::<Option<_>>()?;
        let least = medians.iter().copied().fold(f32::INFINITY, f32::min);
        let contrast = self.max_contrast()?;
        let limits: Vec<f32> = medians.iter().map(|m| contrast + m - least).collect();
        let rejected = self.rejected_blocks(&limits)?;
        let middle =
            |first: usize| first as f64 + (BLOCK_SIDE as f64 - self.plan.full as f64) / 2.0;
        let blocks = self.plan.blocks.iter();
        let blocks: Vec<[f64; 2]> = blocks.map(|&(y, x)| [middle(x), middle(y)]).collect();
        let nearest: Vec<usize> = self
            .stamp
            .cells
            .places()
            .map(|[x, y]| {
                let square =
                    |&at: &usize| (blocks[at][0] - x).powi(2) + (blocks[at][1] - y).powi(2);
                (0..ring)
                    .min_by(|a, b| square(a).total_cmp(&square(b)))
                    .unwrap_or(0)
            })
            .collect();
        levels.sky(&self.stamp.cells, |stamp, cell| {
            rejected[stamp * ring + nearest[cell]]
        })
    }

    fn max_contrast(&self) -> Option<f32> {
        Some(MAX_CONTRAST * SCATTER * median(&mut self.typical_contrasts.clone())?)
    }

    /// Of each block, stamp by stamp, whether it is left out: it or those beside it are brighter than noise, pixels are
    /// missing, or the contrast around it exceeds the limit of its place in the border.
    fn rejected_blocks(&self, max_contrasts: &[f32]) -> Option<Vec<bool>> {
        let lags = self.plan.lags.len();
        let powers = self.products.chunks_exact(lags);
        let powers: Vec<f64> = powers.map(|products| f64::from(products[0])).collect();
        let limit = max_block_power(&powers)?;
        let ring = self.plan.blocks.len();
        let borders = powers.chunks_exact(ring);
        let contrasts = self.block_contrasts.chunks_exact(ring);
        let rejected = borders.zip(contrasts).flat_map(|(powers, contrasts)| {
            (0..ring).map(move |at| {
                let is_beside =
                    (ring - NEIGHBOURING_BLOCKS..=ring + NEIGHBOURING_BLOCKS).any(|by| {
                        let power = powers[(at + by) % ring];
                        power > limit || power == 0.0
                    });
                is_beside || powers[at].is_nan() || contrasts[at] > max_contrasts[at]
            })
        });
        Some(rejected.collect())
    }

    /// `None` where less than two borders of blocks hold noise alone.
    fn noise(&self) -> Option<StampNoise> {
        let lags = self.plan.lags.len();
        let ring = self.plan.blocks.len();
        let rejected = self.rejected_blocks(&vec![self.max_contrast()?; ring])?;
        let blocks = self.products.chunks_exact(lags).zip(rejected);
        let kept = blocks.filter(|(_, rejected)| !rejected);
        let kept: Vec<&[f32]> = kept.map(|(products, _)| products).collect();
        if kept.len() < 2 * ring {
            return None;
        }
        StampNoise::from_products(&self.plan, &kept)
    }
}

/// The largest of the `values` at `places` within [`CONTRAST_RADIUS`] of one, or zero if none is positive.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn largest_around([x, y]: [f32; 2], [xs, ys]: &[Vec<f32>; 2], values: &[f32]) -> f32 {
    let mut largest = [0.0f32; LANES];
    let near = |at: [f32; 2], value: f32| {
        let square = (at[0] - x) * (at[0] - x) + (at[1] - y) * (at[1] - y);
        if square < CONTRAST_RADIUS * CONTRAST_RADIUS {
            value
        } else {
            0.0
        }
    };
    // NaN is not larger.
    let larger = |a: f32, b: f32| if b > a { b } else { a };
    let ((xs, last_x), (ys, last_y), (values, last)) = (
        xs.as_chunks::<LANES>(),
        ys.as_chunks::<LANES>(),
        values.as_chunks::<LANES>(),
    );
    for ((xs, ys), values) in xs.iter().zip(ys).zip(values) {
        for lane in 0..LANES {
            largest[lane] = larger(largest[lane], near([xs[lane], ys[lane]], values[lane]));
        }
    }
    for ((x, y), value) in last_x.iter().zip(last_y).zip(last) {
        largest[0] = larger(largest[0], near([*x, *y], *value));
    }
    largest.into_iter().fold(0.0, larger)
}

/// The power beyond which a block is brighter than noise makes it.
fn max_block_power(powers: &[f64]) -> Option<f64> {
    let mut positive: Vec<f64> = powers
        .iter()
        .copied()
        .filter(|power| *power > 0.0)
        .collect();
    if positive.is_empty() {
        return None;
    }
    positive.sort_by(f64::total_cmp);
    // Cube roots of powers of white noise are nearly Gaussian (Wilson and Hilferty 1931). The lower scatter, because
    // neighbours raise the upper one.
    let at = |rank: usize| positive[rank].cbrt();
    let (median, low) = (at(positive.len() / 2), at(positive.len() * 16 / 100));
    let limit = (median + MAX_BLOCK_EXCESS * (median - low)).powi(3);
    // Not below the median by rounding, where all are alike.
    Some(limit.max(positive[positive.len() / 2]))
}

// Two cells along each axis make a block. Chosen by hand.
const CELL_SIDE: i32 = 3;
// In pixels, of the middle of a place from the galaxy's centre. Chosen by hand.
const MIN_DISTANCE: f32 = 9.0;

/// A place of a stamp that is brighter than the opposite one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BrightPlace {
    /// Difference of their light.
    pub(crate) excess: f32,
    /// Pixels of both.
    pub(crate) pixels: f32,
    /// Middle (x, y) from the galaxy's centre.
    pub(crate) offset: [f32; 2],
}

impl BrightPlace {
    /// A place, or its opposite if the excess is negative.
    fn from_excess(excess: f32, pixels: f32, offset: [f32; 2]) -> Self {
        let side = excess.signum();
        BrightPlace {
            excess: excess.abs(),
            pixels,
            offset: offset.map(|at| side * at),
        }
    }
}

/// Compares places of stamps of one size with their opposites.
#[derive(Debug, Clone)]
pub(crate) struct Asymmetry {
    n: i32,
    /// Sums of the pixels of [`CELL_SIDE`] rows, column by column, with room for columns off the stamp: of cells and of
    /// their opposites.
    lines: [Vec<f32>; 2],
    cells: Vec<Cell>,
    /// Those found last.
    pub(crate) places: Vec<BrightPlace>,
}

/// Excess of a cell over its opposite, and the number of pixels of both.
#[derive(Debug, Clone, Copy)]
struct Cell {
    excess: f32,
    pixels: i32,
}

/// The first pixel beyond the centre along each axis.
fn beyond_centre(rotation: [i32; 2]) -> [i32; 2] {
    rotation.map(|sum| sum.div_euclid(2) + 1)
}

/// Cells from the centre of a stamp of `n` pixels a side to an edge.
fn cells_to_edge(n: i32) -> i32 {
    (n / 2 + CELL_SIDE - 1) / CELL_SIDE
}

impl Asymmetry {
    pub(crate) fn new(n: usize) -> Self {
        Asymmetry {
            n: n as i32,
            lines: std::array::from_fn(|_| vec![0.0; 3 * n]),
            cells: Vec::with_capacity(n * n / 8),
            places: Vec::with_capacity(n * n / 8),
        }
    }

    /// Compares blocks of 2 × 2 cells.
    pub(crate) fn compare(&mut self, stamp: &[f32], rotation: [i32; 2]) {
        let to_edge = self.compare_cells(stamp, rotation);
        let [x0, y0] = beyond_centre(rotation);
        let row = 2 * to_edge as usize;
        for (at, pair) in self.cells.windows(row + 2).enumerate() {
            let (i, j) = ((at % row) as i32 - to_edge, (at / row) as i32 - 1);
            // Not from the end of a row to the next one's beginning.
            if i + 1 == to_edge {
                continue;
            }
            let middle = |first: i32, step: i32, sum: i32| {
                (first + (step + 1) * CELL_SIDE) as f32 - 0.5 - sum as f32 / 2.0
            };
            let (x, y) = (middle(x0, i, rotation[0]), middle(y0, j, rotation[1]));
            if x * x + y * y < MIN_DISTANCE * MIN_DISTANCE {
                continue;
            }
            let cells = [pair[0], pair[1], pair[row], pair[row + 1]];
            let pixels: i32 = cells.iter().map(|cell| cell.pixels).sum();
            if pixels == 0 {
                continue;
            }
            let excess = cells.iter().map(|cell| cell.excess).sum();
            self.places
                .push(BrightPlace::from_excess(excess, pixels as f32, [x, y]));
        }
    }

    /// Compares all cells. Returns the number of cells from the centre to an edge.
    fn compare_cells(&mut self, stamp: &[f32], rotation: [i32; 2]) -> i32 {
        self.places.clear();
        self.cells.clear();
        let to_edge = cells_to_edge(self.n);
        let [x0, y0] = beyond_centre(rotation);
        let n = self.n as usize;
        let columns = |x: i32| cell_on_stamp(x, self.n).len() as i32;
        // One row of cells from the other half, for blocks on the line between both.
        for j in -1..to_edge {
            let y = y0 + j * CELL_SIDE;
            let opposite_y = rotation[1] - y - CELL_SIDE + 1;
            let rows = [y, opposite_y].map(|y| cell_on_stamp(y, self.n));
            for (line, rows) in self.lines.iter_mut().zip(&rows) {
                add_rows(stamp, rows.clone(), &mut line[n..2 * n]);
            }
            let [own, other] = rows.map(|rows| rows.len() as i32);
            for i in -to_edge..to_edge {
                let x = x0 + i * CELL_SIDE;
                let opposite_x = rotation[0] - x - CELL_SIDE + 1;
                let light = |line: &[f32], x: i32| -> f32 {
                    line[(self.n + x) as usize..][..CELL_SIDE as usize]
                        .iter()
                        .sum()
                };
                let [here, there] = &self.lines;
                self.cells.push(Cell {
                    excess: light(here, x) - light(there, opposite_x),
                    pixels: own * columns(x) + other * columns(opposite_x),
                });
            }
        }
        to_edge
    }
}

/// Of the [`CELL_SIDE`] pixels from `first` on along an axis, those on a stamp of `n` pixels.
fn cell_on_stamp(first: i32, n: i32) -> Range<usize> {
    let on_stamp = |at: i32| at.clamp(0, n) as usize;
    on_stamp(first)..on_stamp(first + CELL_SIDE)
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_rows(stamp: &[f32], rows: Range<usize>, line: &mut [f32]) {
    line.fill(0.0);
    let n = line.len();
    for row in rows {
        for (sum, value) in line.iter_mut().zip(&stamp[row * n..][..n]) {
            *sum += value;
        }
    }
}

#[cfg(test)]
mod tests;
