//! How the autocorrelation of a stamp changes with a field of noise.

use super::modes::{multiply, scale_into};
use super::parities::change;
use super::plane::Modes;
use super::{Lags, Spectral, SpectralPsf, SpectralScratch};
use shearq_quantities::product::LANES;

impl Spectral {
    /// Writes how the autocorrelation of the stamp last given changes with a field of noise of σ = 1
    /// that is added to it, and with what a shear makes of that field: in `acf` the one, in `shear1` and
    /// `shear2` the other.
    ///
    /// Of the change of noise under shear only the symmetric part is taken, −Re(tilt) of each mode (and what
    /// the slope of its own power adds): of
    /// the rest, which moves pixels about, the mean is zero. Modes have random signs.
    pub fn noise_field(
        &self,
        psf: &SpectralPsf,
        seed: u64,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        let [field, first, second] = &mut scratch.changes;
        self.signs(seed, field);
        multiply(field, &psf.field);
        scale_into(first, field, &psf.field_tilts[0]);
        scale_into(second, field, &psf.field_tilts[1]);
        self.look_through_window(3, scratch);
        self.take_changes(3, scratch, out);
    }

    /// Writes to `acf` how the autocorrelation of the stamp last given would change further, were the PSF behind the field
    /// of noise of [`Spectral::noise_field`] turned by 90 degrees.
    pub fn turned_field(
        &self,
        psf: &SpectralPsf,
        seed: u64,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        let [lack, field, _] = &mut scratch.changes;
        self.signs(seed, field);
        multiply(field, &psf.field);
        scale_into(lack, field, &psf.turned);
        self.look_through_window(1, scratch);
        self.take_changes(1, scratch, out);
    }

    /// Writes how the autocorrelation of the stamp last given changes with the first `count` changes of v̂ in
    /// `scratch.windowed`.
    pub(super) fn take_changes(&self, count: usize, scratch: &mut SpectralScratch, out: &mut Lags) {
        let SpectralScratch {
            windowed,
            stamp,
            real: [nothing, _],
            even,
            correlation,
            ..
        } = scratch;
        nothing.fill(0.0);
        let lags = [&mut out.acf, &mut out.shear1, &mut out.shear2];
        for (changed, out) in windowed.iter().zip(lags).take(count) {
            change(stamp, changed, &self.scale, nothing, 0.0, even);
            self.correlation.lags(even, correlation, out);
        }
    }

    /// The half spectrum of a real field with the power of white noise of σ = 1 in each mode and random
    /// signs of real and imaginary parts.
    fn signs(&self, seed: u64, out: &mut Modes) {
        let size = self.plane.size as f32 * std::f32::consts::FRAC_1_SQRT_2;
        let quarter = self.plane.quarter();
        let (above_re, below_re) = out.re.split_at_mut(quarter);
        let (above_im, below_im) = out.im.split_at_mut(quarter);
        let mut state = seed;
        for at in (0..quarter).step_by(LANES) {
            // Four bits for each of sixteen places.
            let bits = split_mix(&mut state);
            let parts = [&mut *above_re, above_im, below_re, below_im];
            for (part, out) in parts.into_iter().enumerate() {
                let bits = bits >> (part * LANES);
                for (lane, value) in out[at..][..LANES].iter_mut().enumerate() {
                    *value = if bits >> lane & 1 == 0 { size } else { -size };
                }
            }
        }
        // Modes without k_y are stored twice. Those without k_x are conjugate to their opposites.
        let width = self.plane.width;
        below_re[..width].copy_from_slice(&above_re[..width]);
        below_im[..width].copy_from_slice(&above_im[..width]);
        for at in (0..quarter).step_by(width) {
            below_re[at] = above_re[at];
            below_im[at] = -above_im[at];
        }
        for half in [above_re, below_re] {
            half[0] *= std::f32::consts::SQRT_2;
        }
        (above_im[0], below_im[0]) = (0.0, 0.0);
    }
}

/// The next number between 0 and 1 of the SplitMix64 sequence.
pub(crate) fn uniform(state: &mut u64) -> f64 {
    (split_mix(state) >> 11) as f64 / (1u64 << 53) as f64
}

/// The next number of the SplitMix64 sequence.
pub(crate) fn split_mix(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
