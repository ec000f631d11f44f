//! A survey of the stamps of an image: their noise, the size of their galaxies, and their sky.

use std::iter;
use std::sync::Arc;

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::statistics::{SCATTER, median};
use shearq_submissions::SkySource;

use super::blocks::{BLOCK, PIXELS, look_at};
use super::covariance::noise_of;
use super::plan::NoisePlan;
use super::stamp_noise::StampNoise;
use crate::error::MeasureError;
use crate::extent::Light;
use crate::pixel::{self, PEAKS, Pixel, highest};
use crate::sky::{Cells, Levels, Sky, Subtraction, inner};
use crate::surroundings::{Contrasts, Missing, centre, followed, turn};
use crate::warning::Warning;

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

/// Places that are compared side by side. See docs/constants.md.
const LANES: usize = 16;

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

impl NoisePlan {
    /// A survey of no stamps.
    pub fn survey(&self) -> NoiseSurvey {
        NoiseSurvey {
            plan: self.clone(),
            block: vec![0.0; PIXELS],
            pixels: vec![0.0; self.full * self.full],
            contrasts: Contrasts::new(self.full),
            missing: Missing::new(self.full),
            over_noise: Vec::new(),
            places: Default::default(),
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
    /// Where they are, x and y from the galaxy's centre.
    places: [Vec<f32>; 2],
    /// Of each block, frame by frame, the sum of products at each lag; NaN where pixels are missing.
    pub(super) products: Vec<f32>,
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
        pixel::copy(stamp, &mut self.pixels);
        let whole = self.pixels.iter().all(|value| value.is_finite());
        let padded = pixel::padding(&self.pixels, full).map(|depth| depth > 0);
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
            for (y, to) in (y0..).zip(self.block.chunks_exact_mut(BLOCK)) {
                // Pixels as given, before sky is subtracted and missing ones are filled.
                let row = stamp.row(y);
                match row.as_slice() {
                    Some(row) => widen(to, row[x0..].iter()),
                    None => widen(to, row.iter().skip(x0)),
                }
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
        for (axis, to) in self.places.iter_mut().enumerate() {
            to.clear();
            to.extend(places.iter().map(|at| at.place[axis]));
        }
        for &(y0, x0) in &*self.plan.blocks {
            let middle = |first: usize, turn: i32| {
                first as f32 + (BLOCK as f32 - 1.0) / 2.0 - turn as f32 / 2.0
            };
            let place = [middle(x0, turn[0]), middle(y0, turn[1])];
            self.brightest
                .push(most_around(place, &self.places, &self.over_noise));
        }
        let most = places.iter().map(|at| at.excess).fold(0.0, f32::max);
        // Where one side was filled from the other there is no difference but rounding.
        let mut at = places.iter();
        self.over_noise
            .retain(|_| at.next().is_some_and(|at| at.excess > ROUNDING * most));
        self.typical.extend(median(&mut self.over_noise));
    }

    /// Whether there is no stamp that is not left out: galaxies on them cannot be measured.
    pub(super) fn is_blind(&self) -> bool {
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

    /// The same for the threads of a session; `None` if all stamps are such that their galaxies will be flagged.
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
            None => Err(MeasureError::NoBorders {
                examined: self.counts[0],
                incomplete: self.counts[1],
            }),
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
        noise_of(&self.plan.matrix, self.plan.reach, &means, count)
    }
}

/// Single-precision pixels in double precision.
fn widen<'a, T: Pixel + 'a>(to: &mut [f64], from: impl Iterator<Item = &'a T>) {
    for (value, pixel) in to.iter_mut().zip(from) {
        *value = f64::from(pixel.to_f32());
    }
}

/// The largest of the `values` at `places` within [`AROUND`] of one, or zero if none is positive.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn most_around([x, y]: [f32; 2], [xs, ys]: &[Vec<f32>; 2], values: &[f32]) -> f32 {
    let mut most = [0.0f32; LANES];
    let near = |at: [f32; 2], value: f32| {
        let square = (at[0] - x) * (at[0] - x) + (at[1] - y) * (at[1] - y);
        if square < AROUND * AROUND { value } else { 0.0 }
    };
    // A value that is no number is not larger.
    let larger = |a: f32, b: f32| if b > a { b } else { a };
    let ((xs, last_x), (ys, last_y), (values, last)) = (
        xs.as_chunks::<LANES>(),
        ys.as_chunks::<LANES>(),
        values.as_chunks::<LANES>(),
    );
    for ((xs, ys), values) in xs.iter().zip(ys).zip(values) {
        for lane in 0..LANES {
            most[lane] = larger(most[lane], near([xs[lane], ys[lane]], values[lane]));
        }
    }
    for ((x, y), value) in last_x.iter().zip(last_y).zip(last) {
        most[0] = larger(most[0], near([*x, *y], *value));
    }
    most.into_iter().fold(0.0, larger)
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
