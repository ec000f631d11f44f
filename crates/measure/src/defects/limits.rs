//! What light behind a PSF can look like, by the properties that [`defects`](super) states.

use multiversion::multiversion;
use ndarray::ArrayView2;

// Two vectors of AVX-512.
pub(super) const LANES: usize = 32;
// Pixels ±d from a pixel, d = (x, y). Those two pixels away show clusters of hot pixels.
pub(super) const PAIRS: [(isize, isize); 6] = [(1, 0), (0, 1), (1, 1), (1, -1), (2, 0), (0, 2)];
// Largest −ln R_d/(|d|² p_max) of 22 PSFs (Moffat of FWHM 1 to 5 px, Kolmogorov of e = 0.28, Airy of λ/D 0.8 to 3 px, Euclid VIS and NISP, Roman)
// without the margin. Gaussians have π. Strong coma with a peak of a third of an Airy disc has 22.
const RATIO_EXPONENT: f32 = 12.0;
// Chosen by hand: Poisson noise of cores changes the ratio, and so do errors of the PSF.
const RATIO_MARGIN: f32 = 1.5;
// Peak of a PSF of sum one below which its pixels show its ratios: FWHM of 2.8 px or more of Moffat PSFs. At other phases those to opposite pixels are at most
// 1.25 times as large, which the margin covers; a star of FWHM 1.5 px falls eight times as steeply as its pixels show.
pub(super) const MAX_SAMPLED_PEAK: f64 = 0.07;
// Directions d in which light falls, and their opposites.
pub(super) const DIRECTIONS: usize = 4;
// Of Q_d, which depends on the phase more than R_d. Chosen by hand.
const STEEPNESS_MARGIN: f32 = 2.0;
// Of the stamp's brightest pixel. Rings and spikes of diffraction are fainter. Chosen by hand.
pub(super) const FAINT_SHARE: f32 = 0.1;
// In units of the noise. Gaussian noise exceeds it in one of 10¹⁵ pixels.
pub(super) const MIN_DEPARTURE: f32 = 8.0;
// Times the depth of the PSF's side lobes. Chosen by hand.
const LOBE_MARGIN: f32 = 1.5;

/// What light behind a PSF can look like.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct LightLimits {
    /// R_d of [`PAIRS`], with its margin.
    pub(super) ratios: [f32; PAIRS.len()],
    /// Departures from them that noise may cause, in units of its departure for one pixel. The mean of a pair is not taken below
    /// zero and R_d has a margin, so that half of R_d amplifies its noise.
    pub(super) noise: [f32; PAIRS.len()],
    /// Q_d of the first [`DIRECTIONS`] of [`PAIRS`], with its margin, and the departures that noise may cause.
    pub(super) steepness: [f32; DIRECTIONS],
    pub(super) steepness_noise: [f32; DIRECTIONS],
    /// Depth of the side lobes in units of the peak.
    pub(super) lobe: f32,
}

// exp(|d|² RATIO_EXPONENT p_max) of each pair.
fn bounds(peak: f32) -> [f32; PAIRS.len()] {
    PAIRS.map(|(x, y)| (RATIO_EXPONENT * peak * (x * x + y * y) as f32).exp())
}

impl LightLimits {
    /// For a PSF of sum one.
    pub(crate) fn from_psf(psf: ArrayView2<'_, f64>) -> Self {
        let layout = psf.as_standard_layout();
        let pixels = layout.as_slice().unwrap_or_default();
        let [low, high] = range(pixels);
        // Infinite where pixels do not show them.
        let (pairs, steps) = if high < MAX_SAMPLED_PEAK {
            steepest(pixels, psf.ncols(), f64::from(FAINT_SHARE) * high)
        } else {
            ([f64::INFINITY; PAIRS.len()], [f64::INFINITY; DIRECTIONS])
        };
        let bounds = bounds(high as f32);
        let ratios = std::array::from_fn(|k| RATIO_MARGIN * bounds[k].min(pairs[k] as f32));
        let steepness = steps.map(|step| STEEPNESS_MARGIN * step as f32);
        LightLimits {
            ratios,
            noise: ratios.map(ratio_noise),
            steepness,
            steepness_noise: steepness.map(ratio_noise),
            lobe: LOBE_MARGIN * (-low / high) as f32,
        }
    }

    /// For any PSF of sum one with this peak.
    pub(super) fn from_peak(peak: f32) -> Self {
        let ratios = bounds(peak).map(|bound| RATIO_MARGIN * bound);
        LightLimits {
            ratios,
            noise: ratios.map(ratio_noise),
            steepness: [f32::INFINITY; DIRECTIONS],
            ..LightLimits::default()
        }
    }

    /// For light behind either of two PSFs.
    pub(crate) fn wider(&self, other: &Self) -> Self {
        LightLimits {
            ratios: largest_of(self.ratios, other.ratios),
            noise: largest_of(self.noise, other.noise),
            steepness: largest_of(self.steepness, other.steepness),
            steepness_noise: largest_of(self.steepness_noise, other.steepness_noise),
            lobe: self.lobe.max(other.lobe),
        }
    }
}

/// Largest ratios of pixels from `faint` on to the means of pairs, and to those of the next two pixels; infinite where these have no light.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn steepest(pixels: &[f64], columns: usize, faint: f64) -> ([f64; PAIRS.len()], [f64; DIRECTIONS]) {
    let (mut pairs, [mut there, mut back]) = ([0.0f64; PAIRS.len()], [[0.0f64; DIRECTIONS]; 2]);
    for (y, line) in pixels.chunks_exact(columns).enumerate() {
        // Without an early exit, so that several pixels are tested at a time.
        if !line
            .iter()
            .fold(false, |any, value| any | (*value >= faint))
        {
            continue;
        }
        for (x, &value) in line.iter().enumerate() {
            if value < faint {
                continue;
            }
            let at = |dx: isize, dy: isize| {
                let (x, y) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                let place = y.wrapping_mul(columns).wrapping_add(x);
                if x < columns {
                    pixels.get(place).copied().unwrap_or(0.0)
                } else {
                    0.0
                }
            };
            let ratio = |a: f64, b: f64| value / (0.5 * (a + b)).max(0.0);
            let (mut near, mut far) = ([[0.0; 2]; DIRECTIONS], [[0.0; 2]; DIRECTIONS]);
            for k in 0..DIRECTIONS {
                let (dx, dy) = PAIRS[k];
                near[k] = [at(dx, dy), at(-dx, -dy)];
                far[k] = [at(2 * dx, 2 * dy), at(-2 * dx, -2 * dy)];
            }
            for k in 0..DIRECTIONS {
                pairs[k] = pairs[k].max(ratio(near[k][0], near[k][1]));
                there[k] = there[k].max(ratio(near[k][0], far[k][0]));
                back[k] = back[k].max(ratio(near[k][1], far[k][1]));
            }
            // (2, 0) and (0, 2) are twice the first two.
            for k in DIRECTIONS..PAIRS.len() {
                pairs[k] = pairs[k].max(ratio(far[k - DIRECTIONS][0], far[k - DIRECTIONS][1]));
            }
        }
    }
    (pairs, std::array::from_fn(|k| there[k].max(back[k])))
}

/// Departure from a ratio to the mean of two pixels that noise may cause, in units of its departure for one pixel.
fn ratio_noise(ratio: f32) -> f32 {
    (1.0 + ratio * ratio / 8.0).sqrt()
}

fn largest_of<const N: usize>(one: [f32; N], other: [f32; N]) -> [f32; N] {
    std::array::from_fn(|k| one[k].max(other[k]))
}

/// Smallest and largest pixel of a PSF, or zero.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn range(psf: &[f64]) -> [f64; 2] {
    extremes_from([0.0; 2], psf)
}

// A part of its callers, so that it has their vector instructions.
#[inline(always)]
pub(super) fn extremes_from<T: Copy + PartialOrd>([low, high]: [T; 2], numbers: &[T]) -> [T; 2] {
    let lower = |a: T, b: T| if b < a { b } else { a };
    let higher = |a: T, b: T| if b > a { b } else { a };
    let (mut lows, mut highs) = ([low; LANES], [high; LANES]);
    let (chunks, rest) = numbers.as_chunks::<LANES>();
    for values in chunks {
        for lane in 0..LANES {
            lows[lane] = lower(lows[lane], values[lane]);
            highs[lane] = higher(highs[lane], values[lane]);
        }
    }
    let rest = rest.iter().copied();
    [
        lows.into_iter().chain(rest.clone()).fold(low, lower),
        highs.into_iter().chain(rest).fold(high, higher),
    ]
}
