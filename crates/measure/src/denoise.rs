//! Denoising of a stamp: wavelet decomposition and Wiener filtering of the coefficients, the
//! approach of Nurbaeva et al. (2011, A&A 531, A144).
//!
//! The wavelet is the undecimated "à trous" transform with the B₃-spline (1, 4, 6, 4, 1)/16, whose
//! scales add up to the image (Starck & Murtagh 2006). It has no preferred direction beyond the
//! pixel grid's and no shift dependence, so that it does not stretch a galaxy by where it lies on
//! the grid. Boundaries are mirrored. On scale j a coefficient w becomes
//!
//! ```text
//! w · max(0, 1 − k σ_j² / ⟨w²⟩)
//! ```
//!
//! with ⟨w²⟩ the mean square over a small window, σ_j the noise of that scale for white noise of
//! level σ, and k = 1 for the Wiener filter. The smooth remainder is kept as it is.

use multiversion::multiversion;
use shearq_quantities::statistics::{SCATTER, midpoint_median};
use shearq_submissions::Wavelet;

use crate::pixels::frame;

/// Filter for one stamp size; serial, allocates nothing per stamp.
#[derive(Debug, Clone)]
pub struct WaveletWiener {
    n: usize,
    window: usize,
    strength: f32,
    /// Variance of each scale's coefficients for white noise of unit variance.
    variances: Vec<f32>,
    /// Mirrored position of `n + 2·reach` samples, for the largest reach.
    mirror: Vec<usize>,
    reach: usize,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct DenoiseScratch {
    smooth: Vec<f32>,
    next: Vec<f32>,
    rows: Vec<f32>,
    power: Vec<f32>,
    line: Vec<f32>,
}

// B₃-spline scaling filter of the wavelet transform (Starck & Murtagh 2006).
const SPLINE: [f32; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];

impl WaveletWiener {
    /// Plans for n×n stamps.
    pub fn new(n: usize, settings: &Wavelet) -> Self {
        let reach = (2 << (settings.levels - 1)).max(settings.window);
        let mut filter = WaveletWiener {
            n,
            window: settings.window,
            strength: settings.strength as f32,
            variances: Vec::new(),
            mirror: mirrored(n, reach),
            reach,
        };
        filter.variances = scale_variances(settings.levels);
        filter
    }

    /// Buffers that fit this filter.
    pub fn scratch(&self) -> DenoiseScratch {
        let area = vec![0.0; self.n * self.n];
        DenoiseScratch {
            smooth: area.clone(),
            next: area.clone(),
            rows: area.clone(),
            power: area,
            line: vec![0.0; self.n + 2 * self.reach],
        }
    }

    /// Denoises the row-major n×n `stamp` in place, for white noise of level `sigma`.
    pub fn apply(&self, stamp: &mut [f32], sigma: f32, scratch: &mut DenoiseScratch) {
        filter(self, stamp, sigma, scratch);
    }

    /// Separable convolution with five taps `hole` pixels apart.
    #[inline(always)]
    fn convolve(
        &self,
        from: &[f32],
        to: &mut [f32],
        rows: &mut [f32],
        line: &mut [f32],
        taps: &[f32; 5],
        hole: usize,
    ) {
        let (n, reach) = (self.n, self.reach);
        for (row, out) in from.chunks_exact(n).zip(rows.chunks_exact_mut(n)) {
            self.mirror_row(row, line);
            let shifted: [&[f32]; 5] =
                std::array::from_fn(|k| &line[reach + k * hole - 2 * hole..][..n]);
            weigh(shifted, taps, out);
        }
        for (y, out) in to.chunks_exact_mut(n).enumerate() {
            let shifted: [&[f32]; 5] = std::array::from_fn(|k| {
                let source = self.mirror[reach + y + k * hole - 2 * hole];
                &rows[source * n..][..n]
            });
            weigh(shifted, taps, out);
        }
    }

    /// Mean over the (2·window + 1)² neighbours, in place.
    #[inline(always)]
    fn box_mean(&self, image: &mut [f32], rows: &mut [f32], line: &mut [f32]) {
        let (n, reach, window) = (self.n, self.reach, self.window);
        if window == 0 {
            return;
        }
        let scale = 1.0 / (2 * window + 1) as f32;
        for (row, out) in image.chunks_exact(n).zip(rows.chunks_exact_mut(n)) {
            self.mirror_row(row, line);
            out.fill(0.0);
            for k in 0..=2 * window {
                for (o, &v) in out.iter_mut().zip(&line[reach + k - window..][..n]) {
                    *o += scale * v;
                }
            }
        }
        for (y, out) in image.chunks_exact_mut(n).enumerate() {
            out.fill(0.0);
            for k in 0..=2 * window {
                let source = self.mirror[reach + y + k - window];
                for (o, &v) in out.iter_mut().zip(&rows[source * n..][..n]) {
                    *o += scale * v;
                }
            }
        }
    }

    #[inline(always)]
    fn mirror_row(&self, row: &[f32], line: &mut [f32]) {
        let (n, reach) = (self.n, self.reach);
        line[reach..reach + n].copy_from_slice(row);
        for (value, &at) in line[..reach].iter_mut().zip(&self.mirror) {
            *value = row[at];
        }
        for (value, &at) in line[reach + n..].iter_mut().zip(&self.mirror[reach + n..]) {
            *value = row[at];
        }
    }
}

#[inline(always)]
fn weigh(rows: [&[f32]; 5], taps: &[f32; 5], out: &mut [f32]) {
    let [a, b, c, d, e] = rows;
    let rows = a.iter().zip(b).zip(c).zip(d).zip(e);
    for (out, ((((a, b), c), d), e)) in out.iter_mut().zip(rows) {
        *out = taps[0] * a + taps[1] * b + taps[2] * c + taps[3] * d + taps[4] * e;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn filter(plan: &WaveletWiener, stamp: &mut [f32], sigma: f32, scratch: &mut DenoiseScratch) {
    let DenoiseScratch {
        smooth,
        next,
        rows,
        power,
        line,
    } = scratch;
    smooth.copy_from_slice(stamp);
    stamp.fill(0.0);
    for (level, &variance) in plan.variances.iter().enumerate() {
        plan.convolve(smooth, next, rows, line, &SPLINE, 1 << level);
        // Detail of this scale, in place of the finer smooth image.
        for ((fine, &coarse), p) in smooth.iter_mut().zip(next.iter()).zip(power.iter_mut()) {
            *fine -= coarse;
            *p = *fine * *fine;
        }
        plan.box_mean(power, rows, line);
        let noise = plan.strength * variance * sigma * sigma;
        for ((out, &w), &p) in stamp.iter_mut().zip(smooth.iter()).zip(power.iter()) {
            // A power at or below the noise leaves nothing.
            *out += w * (1.0 - noise / p.max(noise).max(f32::MIN_POSITIVE));
        }
        std::mem::swap(smooth, next);
    }
    for (out, &s) in stamp.iter_mut().zip(smooth.iter()) {
        *out += s;
    }
}

/// Positions 0..n mirrored about the first and last pixel, `reach` further on both sides.
fn mirrored(n: usize, reach: usize) -> Vec<usize> {
    let period = 2 * (n as i64 - 1).max(1);
    (-(reach as i64)..(n + reach) as i64)
        .map(|i| {
            let folded = i.rem_euclid(period);
            folded.min(period - folded) as usize
        })
        .collect()
}

/// Variance of each scale's coefficients for unit white noise: the squared norm of the scale's
/// response to one pixel, which is separable, computed on a line long enough for all scales.
fn scale_variances(levels: usize) -> Vec<f32> {
    let side = 4 * (2 << levels) + 1;
    let mut smooth = vec![0.0f64; side];
    smooth[side / 2] = 1.0;
    (0..levels)
        .map(|level| {
            let hole = 1usize << level;
            let mut next = vec![0.0f64; side];
            for (x, value) in next.iter_mut().enumerate() {
                for (k, tap) in SPLINE.iter().enumerate() {
                    let at = (x + k * hole).wrapping_sub(2 * hole);
                    if at < side {
                        *value += f64::from(*tap) * smooth[at];
                    }
                }
            }
            // ‖a⊗a − b⊗b‖² = (a·a)² − 2(a·b)² + (b·b)².
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
            let variance = dot(&smooth, &smooth).powi(2) - 2.0 * dot(&smooth, &next).powi(2)
                + dot(&next, &next).powi(2);
            smooth = next;
            variance as f32
        })
        .collect()
}

/// Noise level of a stamp: 1.4826 times the median absolute deviation from the median of the pixels
/// within `border` of the edge that are finite. `buffer` is overwritten. `None` where less than half of them are.
pub fn border_noise(stamp: &[f32], n: usize, border: usize, buffer: &mut Vec<f32>) -> Option<f32> {
    buffer.clear();
    for part in frame(stamp, n, border) {
        buffer.extend_from_slice(part);
    }
    let all = buffer.len();
    buffer.retain(|value| value.is_finite());
    if 2 * buffer.len() < all {
        return None;
    }
    let middle = midpoint_median(buffer)?;
    for value in buffer.iter_mut() {
        *value = (*value - middle).abs();
    }
    Some(midpoint_median(buffer)? * SCATTER)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn settings(strength: f64) -> Wavelet {
        Wavelet {
            levels: 3,
            window: 2,
            strength,
        }
    }

    fn noise(rng: &mut impl Rng, n: usize) -> Vec<f32> {
        (0..n * n).map(|_| StandardNormal.sample(rng)).collect()
    }

    #[test]
    fn without_noise_the_scales_add_up_to_the_stamp() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let filter = WaveletWiener::new(48, &settings(1.0));
        let original = noise(&mut rng, 48);
        let mut stamp = original.clone();
        let mut scratch = filter.scratch();
        scratch.power.fill(f32::NAN);
        filter.apply(&mut stamp, 0.0, &mut scratch);
        for (a, b) in stamp.iter().zip(&original) {
            // Sums of four f32 scales of order one.
            assert!((a - b).abs() < 2e-6);
        }
    }

    #[test]
    fn scale_variances_are_those_of_white_noise() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let n = 96;
        let filter = WaveletWiener::new(n, &settings(1.0));
        let mut scratch = filter.scratch();
        let mut smooth = noise(&mut rng, n);
        let mut next = smooth.clone();
        for (level, expected) in filter.variances.iter().enumerate() {
            let DenoiseScratch { rows, line, .. } = &mut scratch;
            filter.convolve(&smooth, &mut next, rows, line, &SPLINE, 1 << level);
            let measured = smooth
                .iter()
                .zip(&next)
                .map(|(a, b)| (a - b).powi(2))
                .sum::<f32>()
                / (n * n) as f32;
            // About n²/(4·4^level) independent coefficients: 3, 6 and 12 % at three sigma.
            let tolerance = 0.06 * f32::from(1u8 << level);
            assert!(
                (measured / expected - 1.0).abs() < tolerance,
                "scale {level}"
            );
            std::mem::swap(&mut smooth, &mut next);
        }
    }

    #[test]
    fn noise_loses_most_power_and_bright_blobs_keep_their_flux() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let n = 48;
        let filter = WaveletWiener::new(n, &settings(1.0));
        let mut scratch = filter.scratch();
        let mut stamp = noise(&mut rng, n);
        filter.apply(&mut stamp, 1.0, &mut scratch);
        let left = stamp.iter().map(|v| v * v).sum::<f32>() / (n * n) as f32;
        assert!(left < 0.25, "{left}");
        let mut blob: Vec<f32> = (0..n * n)
            .map(|k| {
                let (y, x) = ((k / n) as f32 - 23.5, (k % n) as f32 - 23.5);
                100.0 * (-(x * x + y * y) / 18.0).exp()
            })
            .collect();
        let flux: f32 = blob.iter().sum();
        filter.apply(&mut blob, 1.0, &mut scratch);
        // Faint negative rings around a blob are removed: a tenth of the noise per pixel.
        let change = (blob.iter().sum::<f32>() - flux) / (n * n) as f32;
        assert!(change.abs() < 0.15, "{change}");
    }

    #[test]
    fn border_noise_is_the_median_deviation_of_sorted_pixels() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let usual = |values: &mut Vec<f64>| {
            values.sort_by(f64::total_cmp);
            let half = values.len() / 2;
            0.5 * (values[half] + values[values.len() - 1 - half])
        };
        for (n, missing) in [(48, 0), (23, 0), (48, 1), (9, 3)] {
            let mut stamp = noise(&mut rng, n);
            stamp[..missing].fill(f32::NAN);
            let border = |at: usize| at < 4 || at + 4 >= n;
            let pixels = stamp.iter().enumerate();
            let pixels =
                pixels.filter(|(at, v)| (border(at / n) || border(at % n)) && v.is_finite());
            let mut pixels: Vec<f64> = pixels.map(|(_, v)| f64::from(*v)).collect();
            let middle = usual(&mut pixels);
            let mut moduli = pixels.iter().map(|v| (v - middle).abs()).collect();
            let expected = f64::from(SCATTER) * usual(&mut moduli);
            let found = border_noise(&stamp, n, 4, &mut Vec::new()).unwrap();
            // Single precision.
            assert!(
                (f64::from(found) / expected - 1.0).abs() < 1e-6,
                "{n} {missing}"
            );
        }
    }

    #[test]
    fn border_noise_is_robust_against_a_star_in_the_corner() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut stamp = noise(&mut rng, 48);
        for value in &mut stamp {
            *value = 3.0 * *value + 7.0;
        }
        stamp[0] = 1e6;
        let sigma = border_noise(&stamp, 48, 4, &mut Vec::new()).unwrap();
        // 704 pixels: the deviation scatters by 1.17/√(2·704) = 3 %.
        assert!((sigma / 3.0 - 1.0).abs() < 0.1, "{sigma}");
        // Pixels that are missing do not count, and half of the frame has to be there.
        stamp[..3 * 48].fill(f32::NAN);
        let sigma = border_noise(&stamp, 48, 4, &mut Vec::new()).unwrap();
        assert!((sigma / 3.0 - 1.0).abs() < 0.1, "{sigma}");
        stamp[24 * 48..].fill(f32::NAN);
        assert_eq!(border_noise(&stamp, 48, 4, &mut Vec::new()), None);
    }
}
