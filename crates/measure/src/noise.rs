//! The noise of an image, measured on its own stamps: its level, and how its pixels are correlated; and with it how broad
//! its galaxies are.
//!
//! What is looked at are blocks of 8 × 8 pixels along the edges of many stamps. The wings of the galaxies
//! in the middle are smooth there: the polynomials of second degree that fit a block best are taken out of
//! it, and products of what remains are summed for each lag. The fit takes from them a share that follows
//! from geometry alone, so that the covariance C, which is zero beyond a largest lag, is the solution of the
//! linear equations
//!
//! ```text
//! Σ_blocks Σ_p q(p) q(p + l) = Σ_l′ M(l, l′) C(l′),    q = (1 − BBᵀ) x,
//! ```
//!
//! B being the polynomials, orthonormal on the block. Blocks brighter than noise makes them, and those
//! beside them in the frame, are left out: there is another galaxy. So are blocks near a place that is brighter than the
//! opposite one, whose own power a neighbour may raise by a few per cent only: where all stamps have one, that adds up.

use std::iter;
use std::sync::Arc;

use multiversion::multiversion;
use ndarray::{Array2, ArrayView2};
use shearq_quantities::statistics::{SCATTER, median};
use shearq_submissions::SkySource;

use crate::error::MeasureError;
use crate::examine::{PEAKS, enough};
use crate::extent::Light;
use crate::pixel::Pixel;
use crate::sky::{Cells, Levels, Sky, Subtraction, inner};
use crate::surroundings::{Contrasts, Missing, centre, followed, turn};
use crate::warning::Warning;
use crate::worker::highest;

/// Side of a block of border pixels. See docs/constants.md.
const BLOCK: usize = 8;
const PIXELS: usize = BLOCK * BLOCK;
/// Polynomials of up to second degree that are removed from a block. See docs/constants.md.
const POLYNOMIALS: usize = 6;
/// Side of the smallest stamps whose border is free of the galaxy. See docs/constants.md.
const LEAST_STAMP: usize = 24;
/// Excess of a block's cube-root power above the median, beyond which it is left out. See
/// docs/constants.md.
const BRIGHT: f64 = 4.0;
/// Blocks to each side of a bright one that are left out with it. See docs/constants.md.
const BESIDE: usize = 2;
/// Excess of a cell over the opposite cell above which the blocks around it are left out. See
/// docs/constants.md.
const CONTRAST: f32 = 3.5;
/// Radius around such a cell in which blocks are left out. See docs/constants.md.
const AROUND: f32 = 16.0;
/// Differences of opposite blocks that count as zero, in units of the stamp's largest. See
/// docs/constants.md.
const ROUNDING: f32 = 1e-4;
/// Least power of a mode of correlated noise, in units of white noise. See docs/constants.md.
const LEAST_POWER: f64 = 1e-3;

/// The noise of an image: its level, and the correlation of its pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct StampNoise {
    sigma: f64,
    error: f64,
    reach: usize,
    /// Correlation at lags dy = 0…reach, dx = −reach…reach.
    correlation: Vec<f64>,
    /// χ² of the correlation if there were none, and its degrees of freedom.
    colour: (f64, f64),
}

impl StampNoise {
    /// White noise of a known level in image units.
    pub fn white(sigma: f64) -> Self {
        StampNoise {
            sigma,
            error: 0.0,
            reach: 0,
            correlation: vec![1.0],
            colour: (0.0, 0.0),
        }
    }

    /// Standard deviation of a pixel in image units.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Standard error of the level, in units of it.
    pub fn error(&self) -> f64 {
        self.error
    }

    /// Correlation of pixels (dx, dy) apart.
    pub fn correlation(&self, dx: i32, dy: i32) -> f64 {
        let (dx, dy) = if dy < 0 { (-dx, -dy) } else { (dx, dy) };
        let reach = self.reach as i32;
        if dx.abs() > reach || dy > reach {
            return 0.0;
        }
        self.correlation[(dy * (2 * reach + 1) + dx + reach) as usize]
    }

    /// Whether pixels are correlated more than chance would have it: χ² is five of its own standard
    /// deviations too large.
    pub fn is_correlated(&self) -> bool {
        let (square, freedom) = self.colour;
        square > freedom + 5.0 * (2.0 * freedom).sqrt()
    }

    /// Power at wave vector (kx, ky), in radians per pixel, in units of that of white noise of the same
    /// level, and its derivatives (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y).
    pub(crate) fn power(&self, [kx, ky]: [f64; 2]) -> (f64, [f64; 2]) {
        let reach = self.reach as i32;
        let (mut power, mut slopes) = (1.0, [0.0; 2]);
        for dy in 0..=reach {
            for dx in -reach..=reach {
                if dy == 0 && dx <= 0 {
                    continue;
                }
                let (x, y) = (f64::from(dx), f64::from(dy));
                let twice = 2.0 * self.correlation(dx, dy);
                let (sin, cos) = (kx * x + ky * y).sin_cos();
                power += twice * cos;
                slopes[0] -= twice * sin * (kx * x - ky * y);
                slopes[1] -= twice * sin * (ky * x + kx * y);
            }
        }
        if power < LEAST_POWER {
            return (LEAST_POWER, [0.0; 2]);
        }
        (power, slopes)
    }
}

/// What the stamps of an image tell of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Survey {
    /// Its noise.
    pub noise: StampNoise,
    /// How broad its galaxies are seen through the PSF: the mean square of their radii per axis in px², were they
    /// Gaussians. `None` of a few galaxies.
    pub extent: Option<f64>,
    /// The sky that is to be subtracted from its stamps; `None` if there is none that matters.
    pub sky: Option<Sky>,
}

/// Plan for measuring the noise of images with stamps of one size.
#[derive(Debug, Clone)]
pub struct NoisePlan {
    full: usize,
    reach: usize,
    /// What is done about the sky; `None` if it is not looked at.
    sky: Option<SkySource>,
    /// First pixels of the blocks, around the frame.
    blocks: Arc<[(usize, usize)]>,
    lags: Arc<[(i32, i32)]>,
    polynomials: Arc<[[f64; PIXELS]; POLYNOMIALS]>,
    /// M(l, l′).
    matrix: Arc<Array2<f64>>,
}

impl NoisePlan {
    /// Plans for stamps of `full` pixels a side and a covariance of lags up to `reach` along each axis.
    ///
    /// # Errors
    /// If the stamps are smaller than 24 × 24 pixels, or the lags longer than 4 px.
    pub fn new(full: usize, reach: usize) -> Result<Self, MeasureError> {
        if full < LEAST_STAMP {
            let expected = format!(
                "at least {LEAST_STAMP} × {LEAST_STAMP}, for the noise to be measured on their frames"
            );
            return Err(MeasureError::square("stamps", (full, full), expected));
        }
        if reach > BLOCK / 2 {
            return Err(MeasureError::Shape {
                what: "a noise correlation",
                found: format!("lags up to {reach} px"),
                expected: format!("at most {} px", BLOCK / 2),
            });
        }
        let polynomials = polynomials();
        Ok(NoisePlan {
            full,
            reach,
            sky: None,
            blocks: frame(full).into(),
            lags: lags(reach).into(),
            matrix: Arc::new(matrix(reach, &polynomials)),
            polynomials: Arc::new(polynomials),
        })
    }

    /// The same with the sky of images, as a configuration treats it.
    #[must_use]
    pub fn with_sky(self, sky: SkySource) -> Self {
        NoisePlan {
            sky: Some(sky),
            ..self
        }
    }

    /// Which of `rows` rows of `columns` stamps are looked at, evenly spread: enough for a thousand stamps,
    /// or all.
    pub fn rows(&self, columns: usize, rows: usize) -> Vec<usize> {
        let count = enough(columns, rows);
        (0..count)
            .map(|k| (2 * k + 1) * rows / (2 * count))
            .collect()
    }

    /// A survey of no stamps.
    pub fn survey(&self) -> NoiseSurvey {
        NoiseSurvey {
            plan: self.clone(),
            block: vec![0.0; PIXELS],
            pixels: vec![0.0; self.full * self.full],
            contrasts: Contrasts::new(self.full),
            missing: Missing::new(self.full),
            over_noise: Vec::new(),
            products: Vec::new(),
            brightest: Vec::new(),
            typical: Vec::new(),
            light: Light::default(),
            cells: Cells::new(self.full),
            levels: (self.sky == Some(SkySource::Image)).then(Levels::default),
            subtraction: Subtraction::of(self.sky, None),
            peak: 0.0,
            counts: [0; 3],
        }
    }
}

/// Sums over stamps of an image. The result does not depend on anything but the stamps and their order.
#[derive(Debug, Clone)]
pub struct NoiseSurvey {
    plan: NoisePlan,
    block: Vec<f64>,
    /// The stamp, and how it compares with itself turned about the galaxy.
    pixels: Vec<f32>,
    contrasts: Contrasts,
    missing: Missing,
    /// Of each place of a stamp, how much brighter it is than its opposite, over the root of its pixels.
    over_noise: Vec<f32>,
    /// Of each block, frame by frame, the sum of products at each lag; NaN where pixels are missing.
    products: Vec<f32>,
    /// Of each block, the most that a place around it is brighter than its opposite, over the root of its pixels.
    brightest: Vec<f32>,
    /// Of each frame, the median over all places.
    typical: Vec<f32>,
    light: Light,
    cells: Cells,
    /// Levels of the cells, until the sky is found.
    levels: Option<Levels>,
    /// What is taken from the stamps for all but noise.
    subtraction: Subtraction,
    /// The brightest pixel.
    peak: f32,
    /// Number of stamps looked at, of those with missing pixels, and of those that were left out.
    counts: [usize; 3],
}

impl NoiseSurvey {
    /// Looks at the frame of a stamp. Blocks with pixels that are missing are left out, those along an edge whose pixels are
    /// all equal (padding has no noise), and stamps where too many are missing or all are equal.
    ///
    /// # Errors
    /// Where the stamp has other sizes than planned.
    pub fn add<T: Pixel>(&mut self, stamp: ArrayView2<'_, T>) -> Result<(), MeasureError> {
        let full = self.plan.full;
        if stamp.dim() != (full, full) {
            let expected = format!("{full} × {full}");
            return Err(MeasureError::square("a stamp", stamp.dim(), expected));
        }
        for (to, value) in self.pixels.iter_mut().zip(stamp) {
            *to = value.to_f32();
        }
        let whole = self.pixels.iter().all(|value| value.is_finite());
        let padded = padded(&self.pixels, full);
        let flat = self.pixels.iter().all(|value| *value == self.pixels[0]);
        self.peak = self.peak.max(highest(&self.pixels));
        self.counts[0] += 1;
        self.counts[1] += usize::from(!whole);
        if flat {
            self.counts[2] += 1;
            return Ok(());
        }
        if self.levels.is_some() {
            self.cells.look(&self.pixels);
        }
        if self.subtraction != Subtraction::Nothing {
            self.subtraction.apply(&mut self.pixels, &mut self.cells);
        }
        if !(whole || self.missing.mend(&mut self.pixels, full)) {
            self.counts[2] += 1;
            return Ok(());
        }
        if let Some(levels) = &mut self.levels {
            levels.add(&self.cells, inner(&self.pixels, full));
        }
        let blocks = Arc::clone(&self.plan.blocks);
        for &(y0, x0) in &*blocks {
            for (at, value) in self.block.iter_mut().enumerate() {
                let (y, x) = (y0 + at / BLOCK, x0 + at % BLOCK);
                *value = f64::from(stamp[(y, x)].to_f32());
            }
            let reaches = [y0 == 0, y0 + BLOCK == full, x0 == 0, x0 + BLOCK == full];
            let of_padding = reaches.iter().zip(padded).any(|(at, is)| *at && is);
            if of_padding || self.block.iter().any(|value| !value.is_finite()) {
                self.products
                    .extend(iter::repeat_n(f32::NAN, self.plan.lags.len()));
                continue;
            }
            let first = self.products.len();
            self.products.resize(first + self.plan.lags.len(), 0.0);
            look_at(
                &*self.plan.polynomials,
                &self.plan.lags,
                &mut self.block,
                &mut self.products[first..],
            );
        }
        self.compare();
        Ok(())
    }

    /// Adds the stamps of another survey, as if they had been added here.
    ///
    /// # Errors
    /// If the surveys have different plans.
    pub fn join(&mut self, other: &Self) -> Result<(), MeasureError> {
        let plan = |plan: &NoisePlan| {
            let NoisePlan { full, reach, .. } = plan;
            format!("stamps of {full} × {full} pixels with lags up to {reach} px")
        };
        if (self.plan.full, self.plan.reach) != (other.plan.full, other.plan.reach) {
            return Err(MeasureError::Shape {
                what: "a noise survey",
                found: plan(&other.plan),
                expected: plan(&self.plan),
            });
        }
        self.products.extend_from_slice(&other.products);
        self.brightest.extend_from_slice(&other.brightest);
        self.typical.extend_from_slice(&other.typical);
        self.light.join(&other.light);
        if let (Some(levels), Some(more)) = (&mut self.levels, &other.levels) {
            levels.join(more);
        }
        self.peak = self.peak.max(other.peak);
        for (count, more) in self.counts.iter_mut().zip(other.counts) {
            *count += more;
        }
        Ok(())
    }

    /// Looks for places of the stamp that are brighter than the opposite ones, and how broad its galaxy is.
    fn compare(&mut self) {
        let full = self.plan.full;
        let found = centre(&self.pixels, full);
        self.light.add(&self.pixels, full, followed(found));
        let turn = turn(found, full);
        self.contrasts.compare(&self.pixels, turn);
        let places = &self.contrasts.blocks;
        let over_noise = places.iter().map(|at| at.excess / at.pixels.sqrt());
        self.over_noise.clear();
        self.over_noise.extend(over_noise);
        for &(y0, x0) in &*self.plan.blocks {
            let middle = |first: usize, turn: i32| {
                first as f32 + (BLOCK as f32 - 1.0) / 2.0 - turn as f32 / 2.0
            };
            let (x, y) = (middle(x0, turn[0]), middle(y0, turn[1]));
            let mut most = 0.0f32;
            for (at, &over_noise) in places.iter().zip(&self.over_noise) {
                let square = (at.place[0] - x).powi(2) + (at.place[1] - y).powi(2);
                let near = if square < AROUND * AROUND {
                    over_noise
                } else {
                    0.0
                };
                most = most.max(near);
            }
            self.brightest.push(most);
        }
        let most = places.iter().map(|at| at.excess).fold(0.0, f32::max);
        // Where one side was filled from the other there is no difference but rounding.
        let mut at = places.iter();
        self.over_noise
            .retain(|_| at.next().is_some_and(|at| at.excess > ROUNDING * most));
        self.typical.extend(median(&mut self.over_noise));
    }

    /// How many stamps were looked at.
    pub fn looked_at(&self) -> usize {
        self.counts[0]
    }

    /// How many of the stamps looked at have missing pixels.
    pub fn incomplete(&self) -> usize {
        self.counts[1]
    }

    /// Whether there is no stamp that is not left out: galaxies on them cannot be measured.
    pub fn is_blind(&self) -> bool {
        self.counts[0] == self.counts[2]
    }

    /// What the stamps looked at tell of their image; `None` where they do not tell its noise.
    pub fn found(&self) -> Option<Survey> {
        Some(Survey {
            noise: self.noise()?,
            extent: self.light.extent(),
            sky: match self.subtraction {
                Subtraction::Plane(sky) => Some(sky),
                Subtraction::Nothing | Subtraction::EachStamp => None,
            },
        })
    }

    /// The same for [`Worker::set_survey`](crate::Worker::set_survey); `None` where all stamps are such that their galaxies
    /// will be flagged.
    ///
    /// # Errors
    /// Where they do not tell the noise.
    pub fn shared(&self) -> Result<Option<Arc<Survey>>, MeasureError> {
        match self.found() {
            Some(found) => Ok(Some(Arc::new(found))),
            None if self.is_blind() => Ok(None),
            None if self.peak > 0.0 && !PEAKS.contains(&self.peak) => {
                Err(MeasureError::Data(Warning::Brightness {
                    peak: f64::from(self.peak),
                }))
            }
            None => Err(MeasureError::Noise(
                "not to be seen on the stamps' frames".into(),
            )),
        }
    }

    /// A survey of the same stamps without the sky that was found on them, if there is any: galaxies are found and compared
    /// better without sky.
    pub fn without_sky(&self) -> Option<NoiseSurvey> {
        let sky = self.sky()?;
        Some(NoiseSurvey {
            levels: None,
            subtraction: Subtraction::of(self.plan.sky, Some(sky)),
            ..self.plan.survey()
        })
    }

    /// The sky under the stamps looked at, away from other galaxies.
    fn sky(&self) -> Option<Sky> {
        let levels = self.levels.as_ref()?;
        let ring = self.plan.blocks.len();
        // A gradient makes one side of all stamps brighter than the other.
        let medians: Vec<f32> = (0..ring)
            .map(|at| {
                let of = self.brightest.iter().skip(at).step_by(ring);
                median(&mut of.copied().collect::<Vec<_>>())
            })
            .collect::<Option<_>>()?;
        let least = medians.iter().copied().fold(f32::INFINITY, f32::min);
        let contrast = self.contrast()?;
        let most: Vec<f32> = medians.iter().map(|m| contrast + m - least).collect();
        let lost = self.lost(&most)?;
        let middle = |first: usize| first as f64 + (BLOCK as f64 - self.plan.full as f64) / 2.0;
        let blocks: Vec<[f64; 2]> = self
            .plan
            .blocks
            .iter()
            .map(|&(y, x)| [middle(x), middle(y)])
            .collect();
        let nearest: Vec<usize> = self
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
        levels.sky(&self.cells, |stamp, cell| {
            lost[stamp * ring + nearest[cell]]
        })
    }

    /// How much brighter than its opposite a place may be.
    fn contrast(&self) -> Option<f32> {
        Some(CONTRAST * SCATTER * median(&mut self.typical.clone())?)
    }

    /// Of each block, frame by frame, whether it is left out: it or those beside it are brighter than noise, pixels are
    /// missing, or a place near it is brighter than its opposite by more than `most`, block by block around the frame.
    fn lost(&self, most: &[f32]) -> Option<Vec<bool>> {
        let lags = self.plan.lags.len();
        let powers: Vec<f64> = self
            .products
            .chunks_exact(lags)
            .map(|products| f64::from(products[0]))
            .collect();
        let bright = brightest(&powers)?;
        let ring = self.plan.blocks.len();
        let frames = powers.chunks_exact(ring);
        let places = self.brightest.chunks_exact(ring);
        let lost = frames.zip(places).flat_map(|(powers, places)| {
            (0..ring).map(move |at| {
                let beside = (ring - BESIDE..=ring + BESIDE).any(|by| {
                    let power = powers[(at + by) % ring];
                    power > bright || power == 0.0
                });
                beside || powers[at].is_nan() || places[at] > most[at]
            })
        });
        Some(lost.collect())
    }

    /// The noise of the stamps looked at; `None` where less than a few frames are left that hold noise alone.
    pub fn noise(&self) -> Option<StampNoise> {
        let lags = self.plan.lags.len();
        let ring = self.plan.blocks.len();
        let lost = self.lost(&vec![self.contrast()?; ring])?;
        let mut sums = vec![0.0; lags];
        let mut count = 0;
        let blocks = self.products.chunks_exact(lags).zip(lost);
        for (products, _) in blocks.filter(|(_, lost)| !lost) {
            count += 1;
            for (sum, product) in sums.iter_mut().zip(products) {
                *sum += f64::from(*product);
            }
        }
        if count < 2 * ring {
            return None;
        }
        let count = count as f64;
        let means: Vec<f64> = sums.iter().map(|sum| sum / count).collect();
        self.solved(&means, count)
    }

    /// The covariance behind mean products of `count` blocks.
    fn solved(&self, means: &[f64], count: f64) -> Option<StampNoise> {
        let covariance = solve(&self.plan.matrix, means)?;
        let variance = covariance[0];
        let positive = variance > 0.0 && variance.is_finite();
        positive.then(|| {
            let reach = self.plan.reach as i32;
            let width = 2 * reach + 1;
            let mut correlation = vec![0.0; ((reach + 1) * width) as usize];
            for (&(dx, dy), value) in self.plan.lags.iter().zip(&covariance) {
                let ratio = value / variance;
                correlation[(dy * width + dx + reach) as usize] = ratio;
                if dy == 0 {
                    correlation[(reach - dx) as usize] = ratio;
                }
            }
            let square = count * colour(&self.plan.matrix, &covariance) / (variance * variance);
            // Of squares of noise that is correlated in patches of Σρ² pixels.
            let patch = correlation.iter().map(|ratio| ratio * ratio).sum::<f64>() * 2.0;
            let freedom = (PIXELS - POLYNOMIALS) as f64 * count;
            StampNoise {
                sigma: variance.sqrt(),
                error: (0.5 * patch.max(1.0) / freedom).sqrt(),
                reach: self.plan.reach,
                correlation,
                colour: (square, covariance.len() as f64 - 1.0),
            }
        })
    }
}

/// Whether the pixels along the lower, upper, left and right edge of a stamp of `n` × `n` are all equal.
fn padded(pixels: &[f32], n: usize) -> [bool; 4] {
    let last = n * (n - 1);
    [(0, 1), (last, 1), (0, n), (n - 1, n)].map(|(first, step)| {
        let mut edge = (0..n).map(|at| pixels[first + at * step]);
        edge.all(|value| value == pixels[first])
    })
}

/// χ² of a covariance against white noise of variance one, for one block.
///
/// With S_l one for pixels ±l apart, products are q′S_l q/2 (q′q at l = 0), so that M(l, l′) = tr(P S_l P S_l′)/2 (without the half at l = 0) and, in
/// white noise, the products' covariance is M(l, l′), and twice that for l′ = 0. That of the solutions has the inverse
/// A(l, l′) = M(l′, l), half of it for l′ = 0, of which the variance at lag zero, whatever it is, takes its share.
fn colour(matrix: &Array2<f64>, covariance: &[f64]) -> f64 {
    let inverse = |i: usize, j: usize| matrix[(j, i)] * if j == 0 { 0.5 } else { 1.0 };
    let others = 1..covariance.len();
    let pairs = others
        .clone()
        .flat_map(|i| others.clone().map(move |j| (i, j)));
    pairs
        .map(|(i, j)| {
            let freed = inverse(i, 0) * inverse(0, j) / inverse(0, 0);
            covariance[i] * covariance[j] * (inverse(i, j) - freed)
        })
        .sum()
}

/// Lags of half the plane, zero first.
fn lags(reach: usize) -> Vec<(i32, i32)> {
    let reach = reach as i32;
    let rows = (0..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
    let half = rows.filter(|&(dx, dy)| dy > 0 || dx >= 0);
    half.collect()
}

/// First pixels (y, x) of blocks side by side from the edges of a stamp inwards, once around its frame.
fn frame(full: usize) -> Vec<(usize, usize)> {
    let count = full / BLOCK;
    let start = |at: usize| {
        if 2 * at < count {
            at * BLOCK
        } else {
            full - (count - at) * BLOCK
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

/// 1, x, y, x², xy and y² on a block, made orthonormal (Gram and Schmidt).
fn polynomials() -> [[f64; PIXELS]; POLYNOMIALS] {
    let mut out = [[0.0; PIXELS]; POLYNOMIALS];
    let powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)];
    for (k, (px, py)) in powers.into_iter().enumerate() {
        let middle = (BLOCK as f64 - 1.0) / 2.0;
        let (done, rest) = out.split_at_mut(k);
        let own = &mut rest[0];
        for (at, value) in own.iter_mut().enumerate() {
            let (y, x) = ((at / BLOCK) as f64 - middle, (at % BLOCK) as f64 - middle);
            *value = x.powi(px) * y.powi(py);
        }
        take_out(done, own);
        let norm = own.iter().map(|value| value * value).sum::<f64>().sqrt();
        own.iter_mut().for_each(|value| *value /= norm);
    }
    out
}

/// Takes orthonormal `polynomials` out of a block, and writes the sum of products of what is left at each of `lags`.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn look_at(
    polynomials: &[[f64; PIXELS]],
    lags: &[(i32, i32)],
    block: &mut [f64],
    products: &mut [f32],
) {
    take_out(polynomials, block);
    let rows = beside_zeros(block);
    for (out, &(dx, dy)) in products.iter_mut().zip(lags) {
        *out = product(&rows, dx, dy) as f32;
    }
}

/// Takes orthonormal `polynomials` out of a block.
#[inline(always)]
fn take_out(polynomials: &[[f64; PIXELS]], block: &mut [f64]) {
    for polynomial in polynomials {
        // Columns side by side, each of which would wait for the one before.
        let mut columns = [0.0; BLOCK];
        let rows = polynomial.chunks_exact(BLOCK);
        for (p, row) in rows.zip(block.chunks_exact(BLOCK)) {
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

/// The rows of a block with zeros on either side, so that all lags are sums over rows of one length.
#[inline(always)]
fn beside_zeros(block: &[f64]) -> [[f64; 3 * BLOCK]; BLOCK] {
    let mut rows = [[0.0; 3 * BLOCK]; BLOCK];
    for (row, from) in rows.iter_mut().zip(block.chunks_exact(BLOCK)) {
        row[BLOCK..2 * BLOCK].copy_from_slice(from);
    }
    rows
}

/// Sum of products of the block's pixels (dx, dy) apart.
#[inline(always)]
fn product(rows: &[[f64; 3 * BLOCK]; BLOCK], dx: i32, dy: i32) -> f64 {
    let right = BLOCK.saturating_add_signed(dx as isize);
    let mut columns = [0.0; BLOCK];
    for (a, b) in rows.iter().zip(&rows[dy as usize..]) {
        let pairs = a[BLOCK..2 * BLOCK].iter().zip(&b[right..right + BLOCK]);
        for (sum, (a, b)) in columns.iter_mut().zip(pairs) {
            *sum += a * b;
        }
    }
    columns.iter().sum()
}

/// M(l, l′): the mean of the products at lag l on noise of covariance one at ±l′ and zero elsewhere.
fn matrix(reach: usize, polynomials: &[[f64; PIXELS]; POLYNOMIALS]) -> Array2<f64> {
    let lags = lags(reach);
    let mut out = Array2::zeros((lags.len(), lags.len()));
    let place = |at: usize| ((at % BLOCK) as i32, (at / BLOCK) as i32);
    for (j, &(dx, dy)) in lags.iter().enumerate() {
        // Covariance of the block's pixels, by columns, and then by rows, without polynomials.
        let mut covariance: Vec<[f64; PIXELS]> = (0..PIXELS)
            .map(|a| {
                std::array::from_fn(|b| {
                    let ((ax, ay), (bx, by)) = (place(a), place(b));
                    let lag = (bx - ax, by - ay);
                    f64::from(u8::from(lag == (dx, dy) || lag == (-dx, -dy)))
                })
            })
            .collect();
        for _ in 0..2 {
            for row in &mut covariance {
                take_out(polynomials, row);
            }
            covariance = (0..PIXELS)
                .map(|a| std::array::from_fn(|b| covariance[b][a]))
                .collect();
        }
        for (i, &(dx, dy)) in lags.iter().enumerate() {
            let mut sum = 0.0;
            for (a, row) in covariance.iter().enumerate() {
                let (x, y) = place(a);
                let (x, y) = (x + dx, y + dy);
                let side = 0..BLOCK as i32;
                if side.contains(&x) && side.contains(&y) {
                    sum += row[y as usize * BLOCK + x as usize];
                }
            }
            out[(i, j)] = sum;
        }
    }
    out
}

/// The power beyond which a block is left out.
fn brightest(powers: &[f64]) -> Option<f64> {
    let mut all: Vec<f64> = powers
        .iter()
        .copied()
        .filter(|power| *power > 0.0)
        .collect();
    if all.is_empty() {
        return None;
    }
    all.sort_by(f64::total_cmp);
    let (median, low) = (all[all.len() / 2].cbrt(), all[all.len() * 16 / 100].cbrt());
    // Not below the median by rounding, where all are alike.
    let bright = (median + BRIGHT * (median - low)).powi(3);
    Some(bright.max(all[all.len() / 2]))
}

/// Solves linear equations by elimination with pivots; `None` where there is no solution.
fn solve(matrix: &Array2<f64>, right: &[f64]) -> Option<Vec<f64>> {
    let n = right.len();
    let mut rows: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            let mut row: Vec<f64> = matrix.row(i).to_vec();
            row.push(right[i]);
            row
        })
        .collect();
    for k in 0..n {
        let pivot = (k..n).max_by(|&a, &b| rows[a][k].abs().total_cmp(&rows[b][k].abs()))?;
        rows.swap(k, pivot);
        let (done, rest) = rows.split_at_mut(k + 1);
        let pivot = &done[k];
        if pivot[k].abs() < 1e-9 {
            return None;
        }
        for row in rest {
            let factor = row[k] / pivot[k];
            for (value, p) in row[k..].iter_mut().zip(&pivot[k..]) {
                *value -= factor * p;
            }
        }
    }
    let mut out = vec![0.0; n];
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|j| rows[k][j] * out[j]).sum();
        out[k] = (rows[k][n] - known) / rows[k][k];
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const SIDE: usize = 48;

    /// Uniform noise of variance one, or its sum over 2 × 2 pixels halved, which has it too.
    fn noise(rng: &mut ChaCha8Rng, correlated: bool) -> Array2<f32> {
        let half = 3f32.sqrt();
        let white = Array2::from_shape_fn((SIDE + 1, SIDE + 1), |_| rng.random_range(-half..half));
        Array2::from_shape_fn((SIDE, SIDE), |(y, x)| {
            if correlated {
                0.5 * (white[(y, x)]
                    + white[(y + 1, x)]
                    + white[(y, x + 1)]
                    + white[(y + 1, x + 1)])
            } else {
                white[(y, x)]
            }
        })
    }

    fn survey(
        reach: usize,
        count: usize,
        mut stamp: impl FnMut(&mut ChaCha8Rng) -> Array2<f32>,
    ) -> StampNoise {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let mut survey = NoisePlan::new(SIDE, reach).unwrap().survey();
        for _ in 0..count {
            survey.add(stamp(&mut rng).view()).unwrap();
        }
        survey.noise().unwrap()
    }

    #[test]
    fn white_noise_has_its_level_and_no_correlation() {
        let found = survey(3, 400, |rng| noise(rng, false));
        // 8,000 blocks; uniform noise scatters less than the error says.
        assert!(
            (found.sigma() - 1.0).abs() < 3.0 * found.error(),
            "{found:?}"
        );
        assert!(found.error() < 2e-3 && !found.is_correlated(), "{found:?}");
        let (power, _) = found.power([0.5, -0.8]);
        // 24 lags of 1/√400,000 each, both ways: 1.5 %.
        assert!((power - 1.0).abs() < 0.06, "{power}");
    }

    #[test]
    fn chance_has_as_much_correlation_as_white_noise_is_allowed() {
        let mut rng = ChaCha8Rng::seed_from_u64(21);
        let plan = NoisePlan::new(SIDE, 3).unwrap();
        let count = 150;
        let found = (0..count).map(|_| {
            let mut survey = plan.survey();
            for _ in 0..16 {
                survey.add(noise(&mut rng, false).view()).unwrap();
            }
            survey.noise().unwrap()
        });
        let found: Vec<StampNoise> = found.collect();
        assert!(found.iter().all(|noise| !noise.is_correlated()));
        let (mean, freedom) = (
            found.iter().map(|noise| noise.colour.0).sum::<f64>() / f64::from(count),
            found[0].colour.1,
        );
        // χ² scatters by √(2·24): 0.57 in the mean of 150.
        assert!((mean - freedom).abs() < 2.0, "{mean} {freedom}");
    }

    #[test]
    fn padding_is_no_noise() {
        let padded = |edges: &[bool; 4], rng: &mut ChaCha8Rng| {
            let mut stamp = noise(rng, false);
            for ((y, x), value) in stamp.indexed_iter_mut() {
                let near = [y < 3, y >= SIDE - 2, x < 1, x >= SIDE - 5];
                if near.iter().zip(edges).any(|(near, edge)| *near && *edge) {
                    *value = 7.0;
                }
            }
            stamp
        };
        for edge in 0..4 {
            let mut edges = [false; 4];
            edges[edge] = true;
            let found = survey(3, 300, |rng| padded(&edges, rng));
            assert!(
                (found.sigma() - 1.0).abs() < 3.0 * found.error() && !found.is_correlated(),
                "{edge}: {found:?}"
            );
        }
        let mut rng = ChaCha8Rng::seed_from_u64(10);
        let mut survey = NoisePlan::new(SIDE, 3).unwrap().survey();
        for _ in 0..30 {
            survey.add(padded(&[true; 4], &mut rng).view()).unwrap();
        }
        assert!(survey.noise().is_none() && !survey.is_blind());
    }

    #[test]
    fn missing_pixels_cost_their_blocks_alone() {
        let found = survey(3, 600, |rng| {
            let mut stamp = noise(rng, false);
            for value in &mut stamp {
                if rng.random_range(0.0..1.0) < 0.01 {
                    *value = f32::NAN;
                }
            }
            stamp
        });
        assert!(
            (found.sigma() - 1.0).abs() < 3.0 * found.error(),
            "{found:?}"
        );
        // Of 600 frames of 20 blocks of 64 pixels about half are whole: as of 300 frames without missing pixels.
        assert!(
            found.error() < 2.5e-3 && !found.is_correlated(),
            "{found:?}"
        );
        let mut survey = NoisePlan::new(SIDE, 3).unwrap().survey();
        survey
            .add(Array2::from_elem((SIDE, SIDE), f32::NAN).view())
            .unwrap();
        assert!(survey.noise().is_none());
    }

    #[test]
    fn stamps_without_anything_on_them_leave_an_image_blind_and_cost_others_nothing() {
        let plan = NoisePlan::new(SIDE, 3).unwrap();
        let (mut empty, mut with, mut without) = (plan.survey(), plan.survey(), plan.survey());
        let mut rng = ChaCha8Rng::seed_from_u64(12);
        for _ in 0..20 {
            let flat = Array2::from_elem((SIDE, SIDE), 2.5f32);
            let stamp = noise(&mut rng, false);
            empty.add(flat.view()).unwrap();
            with.add(flat.view()).unwrap();
            for survey in [&mut with, &mut without] {
                survey.add(stamp.view()).unwrap();
            }
        }
        assert!(empty.is_blind() && empty.shared().unwrap().is_none());
        assert!(!with.is_blind());
        assert_eq!(with.found(), without.found());
    }

    #[test]
    fn surveys_joined_are_one() {
        let plan = NoisePlan::new(SIDE, 2).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(10);
        let mut whole = plan.survey();
        let mut parts = [plan.survey(), plan.survey()];
        for k in 0..60 {
            let mut stamp = noise(&mut rng, false);
            stamp[(SIDE / 2, SIDE / 2)] += 500.0;
            if k % 7 == 0 {
                stamp[(0, 0)] = f32::NAN;
            }
            whole.add(stamp.view()).unwrap();
            parts[k / 25 % 2].add(stamp.view()).unwrap();
        }
        // The last ten were added to the first.
        let [mut first, second] = parts;
        first.join(&second).unwrap();
        assert_eq!(first.looked_at(), whole.looked_at());
        assert_eq!(first.incomplete(), whole.incomplete());
        let [found, expected] = [first, whole].map(|survey| survey.found().unwrap());
        // Sums in another order.
        assert!((found.noise.sigma() / expected.noise.sigma() - 1.0).abs() < 1e-12);
        assert!((found.extent.unwrap() / expected.extent.unwrap() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn noise_of_summed_pixels_has_their_power_in_every_mode() {
        let found = survey(3, 1000, |rng| noise(rng, true));
        assert!(found.is_correlated());
        assert!((found.correlation(1, 0) - 0.5).abs() < 0.01, "{found:?}");
        assert!((found.correlation(-1, 1) - 0.25).abs() < 0.01, "{found:?}");
        let wave = |kx: f64, ky: f64| (1.0 + kx.cos()) * (1.0 + ky.cos());
        for k in [[0.0, 0.0], [0.5, 0.3], [-1.0, 0.4], [0.9, -1.1]] {
            let (power, slopes) = found.power(k);
            let expected = wave(k[0], k[1]);
            // As above with a million pixels, four times as much where the power is.
            assert!((power - expected).abs() < 0.12, "{k:?}: {power} {expected}");
            let dx = -k[0].sin() * (1.0 + k[1].cos());
            let dy = -k[1].sin() * (1.0 + k[0].cos());
            let along = [k[0] * dx - k[1] * dy, k[1] * dx + k[0] * dy];
            // Far lags weigh more in slopes, which scatter by 0.07 between seeds.
            for (found, expected) in slopes.iter().zip(along) {
                assert!((found - expected).abs() < 0.25, "{k:?}: {found} {expected}");
            }
        }
    }

    #[test]
    fn galaxies_their_wings_and_neighbours_are_kept_out() {
        let plain = survey(2, 300, |rng| noise(rng, false));
        let crowded = survey(2, 300, |rng| {
            let mut stamp = noise(rng, false);
            // An exponential disc in the middle with a scale of 6 px and 2000 times the noise's light, and in
            // every stamp one like it, of 3 px and S/N 20, 20 px away in any direction.
            let away: f32 = rng.random_range(0.0..std::f32::consts::TAU);
            for ((y, x), value) in stamp.indexed_iter_mut() {
                let (y, x) = (y as f32 - 23.5, x as f32 - 23.5);
                *value += 2000.0 / 226.0 * (-x.hypot(y) / 6.0).exp();
                let (x, y) = (x - 20.0 * away.cos(), y - 20.0 * away.sin());
                *value += 300.0 / 56.0 * (-x.hypot(y) / 3.0).exp();
            }
            stamp
        });
        // The same noise, of which fewer blocks are left.
        assert!(
            (crowded.sigma() / plain.sigma() - 1.0).abs() < 4e-3,
            "{crowded:?} {plain:?}"
        );
        assert!(!crowded.is_correlated(), "{crowded:?}");
    }

    #[test]
    fn the_matrix_is_what_noise_of_one_covariance_gives() {
        // Products of blocks of noise that sums of pixels correlate, against M times the covariance.
        let plan = NoisePlan::new(SIDE, 1).unwrap();
        let covariance = [1.0, 0.5, 0.25, 0.5, 0.25];
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut survey = plan.survey();
        for _ in 0..500 {
            survey.add(noise(&mut rng, true).view()).unwrap();
        }
        let blocks = survey.products.chunks_exact(plan.lags.len());
        let count = blocks.len() as f64;
        let mut means = vec![0.0; plan.lags.len()];
        for block in blocks {
            for (mean, product) in means.iter_mut().zip(block) {
                *mean += f64::from(*product) / count;
            }
        }
        for (i, mean) in means.iter().enumerate() {
            let row = plan.matrix.row(i);
            let expected: f64 = row.iter().zip(covariance).map(|(m, c)| m * c).sum();
            // 10,000 blocks of some fifteen independent patches each.
            assert!((mean - expected).abs() < 0.6, "{i}: {mean} {expected}");
        }
    }

    #[test]
    fn frames_go_once_around_and_small_stamps_have_none() {
        assert_eq!(frame(48).len(), 20);
        let odd = frame(51);
        assert_eq!((odd.len(), odd[0], odd[5]), (20, (0, 0), (0, 43)));
        assert!(NoisePlan::new(23, 2).is_err());
        let long = NoisePlan::new(48, 5).unwrap_err().to_string();
        assert!(long.contains("lags up to 5 px"), "{long}");
        let mut survey = NoisePlan::new(48, 3).unwrap().survey();
        for (full, reach) in [(48, 2), (50, 3)] {
            let other = NoisePlan::new(full, reach).unwrap().survey();
            let refused = survey.join(&other).unwrap_err().to_string();
            assert!(
                refused.contains(&format!("stamps of {full} × {full} pixels with lags up to {reach} px; expected stamps of 48")),
                "{refused}"
            );
        }
        let plan = NoisePlan::new(48, 3).unwrap();
        assert_eq!(plan.rows(3, 3), [0, 1, 2]);
        // Stamps one by one, as in a batch: a thousand of them, not one.
        assert_eq!(plan.rows(1, 10_000).len(), 1000);
        assert_eq!(plan.rows(1000, 7), [3]);
        assert_eq!(plan.rows(100, 100), [5, 15, 25, 35, 45, 55, 65, 75, 85, 95]);
        assert!(plan.survey().noise().is_none());
    }
}
