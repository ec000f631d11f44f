//! PSF images that are cut off: zeros around a part at whose edge there is light.

use ndarray::ArrayView2;
use shearq_quantities::statistics::upper_median;
use shearq_submissions::limits::MIN_PSF;

// Lower quartile, over the pixels of the edge, of their light in units of what the next two pixels inside extrapolate to. Moffat PSFs,
// Gaussians and Kolmogorov's that are cut have 0.6 to 1.0. A profile that ends there, as in GREAT08, was integrated over pixels that the
// end crosses, and has 0.20 to 0.37.
const MIN_SHARP_RATIO: f64 = 0.45;
// m and c of 256 galaxies of half-light radii 2 to 4 px behind Moffat PSFs of FWHM 2.4, 3.4 and 5 px and Kolmogorov's of 3.4 px. m over the
// level at the edge is −1.3 to −3.9 for PSFs of up to 14 px across, −0.5 to −1.3 for 16 px, and zero or positive from 20 px on, where the
// window ends; c over level and ellipticity is 3 to 13.
const M_PER_LEVEL: f64 = -2.5;
const RADII_WITH_M_PX: std::ops::Range<f64> = 6.0..9.0;
// Within what was measured. Chosen by hand.
const C_PER_LEVEL: f64 = 10.0;
// Level from which c exceeds 0.001 for an ellipticity of 0.05.
const MAX_LEVEL: f64 = 0.002;
// Requirement of Euclid, LSST and GREAT3 on |m|.
const MAX_M: f64 = 0.002;

/// Where a PSF ends that its image cuts off.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Truncation {
    /// Pixels of the galaxies across the part that is not zero.
    pub side: f64,
    /// Median light of the pixels at its edge, in units of the peak.
    pub level: f64,
}

impl Truncation {
    /// Of a PSF image of which so many pixels are along a pixel of the galaxies; `None` if it is not smaller than configurations
    /// require, has no frame of zeros, or ends too faintly to matter.
    pub fn of(psf: ArrayView2<'_, f64>, oversampling: f64) -> Option<Truncation> {
        let (rows, columns) = psf.dim();
        let at = |y: i64, x: i64| {
            let [y, x] = [y, x].map(|at| usize::try_from(at).unwrap_or(usize::MAX));
            psf.get((y, x)).copied()
        };
        let mut light = [[usize::MAX, 0]; 2];
        for ((y, x), _) in psf.indexed_iter().filter(|(_, value)| **value != 0.0) {
            for (range, at) in light.iter_mut().zip([x, y]) {
                *range = [range[0].min(at), range[1].max(at)];
            }
        }
        let has_frame = |[first, last]: [usize; 2], side: usize| first > 0 && last + 1 < side;
        if !has_frame(light[0], columns) || !has_frame(light[1], rows) {
            return None;
        }
        let across = light.map(|[first, last]| last.checked_sub(first).map_or(0, |d| d + 1));
        let side = across[0].max(across[1]) as f64 / oversampling;
        let (mut edge, mut sharp) = (Vec::new(), Vec::new());
        for ((y, x), &value) in psf.indexed_iter().filter(|(_, value)| **value != 0.0) {
            for (dy, dx) in [(0, 1), (0, -1), (1, 0), (-1, 0)] {
                let away = |k: i64| at(y as i64 + k * dy, x as i64 + k * dx).unwrap_or(0.0);
                if away(1) == 0.0 {
                    edge.push(value);
                    sharp.push(value * away(-2) / away(-1).powi(2));
                }
            }
        }
        sharp.retain(|ratio: &f64| ratio.is_finite());
        sharp.sort_by(f64::total_cmp);
        let peak = psf.iter().copied().fold(0.0, f64::max);
        let found = Truncation {
            side,
            level: upper_median(&mut edge)? / peak,
        };
        let is_sharp = *sharp.get(sharp.len() / 4)? > MIN_SHARP_RATIO;
        let matters = found.level > MAX_LEVEL || found.effect()[0].abs() > MAX_M;
        (is_sharp && matters && side < MIN_PSF as f64).then_some(found)
    }

    /// About how much it changes m, and c per ellipticity of the PSF.
    pub fn effect(self) -> [f64; 2] {
        let std::ops::Range { start, end } = RADII_WITH_M_PX;
        let radius = 0.5 * (self.side - 1.0);
        let share = ((end - radius) / (end - start)).clamp(0.0, 1.0);
        [M_PER_LEVEL * share * self.level, C_PER_LEVEL * self.level]
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use shearq_quantities::{PsfProfile, Shear};

    use super::super::testing::drawn;
    use super::*;

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

    fn cut_at(psf: &Array2<f64>, radius: f64) -> Array2<f64> {
        let middle = 0.5 * (psf.nrows() as f64 - 1.0);
        Array2::from_shape_fn(psf.dim(), |(y, x)| {
            match (x as f64 - middle).hypot(y as f64 - middle) > radius {
                true => 0.0,
                false => psf[(y, x)],
            }
        })
    }

    #[test]
    fn cut_psfs_state_their_effect() {
        let psf = |fwhm| drawn(MOFFAT, fwhm, Shear::new(0.03, -0.02), 48);
        // Measured changes of m, to a factor of 2.5.
        for (fwhm, radius, m) in [
            (2.4, 5.0, -0.026),
            (2.4, 6.0, -0.011),
            (2.4, 7.0, -0.0037),
            (3.4, 6.0, -0.051),
            (3.4, 7.0, -0.022),
            (3.4, 8.0, -0.003),
            (5.0, 6.0, -0.19),
            (5.0, 8.0, -0.033),
        ] {
            let found = Truncation::of(cut_at(&psf(fwhm), radius).view(), 1.0).unwrap();
            let ratio = found.effect()[0] / m;
            assert!((0.4..2.5).contains(&ratio), "{fwhm} {radius}: {found:?}");
        }
        let of = |psf: Array2<f64>| Truncation::of(psf.view(), 1.0);
        assert_eq!(of(psf(3.4)), None);
        assert_eq!(of(cut_at(&psf(3.4), 12.0)), None);
        assert_eq!(of(Array2::zeros((48, 48))), None);
        // On finer pixels, and from 32 px on.
        let fine = cut_at(&psf(6.8), 12.0);
        let found = Truncation::of(fine.view(), 2.0).unwrap();
        assert!((found.side - 12.0).abs() < 0.6, "{found:?}");
        assert_eq!(
            of(cut_at(&drawn(MOFFAT, 9.0, Shear::default(), 48), 16.0)),
            None
        );
    }

    #[test]
    fn profiles_that_end_are_not_cut() {
        // Integrated over pixels, as GREAT08's.
        let fine = 9;
        let truncated = |radius: f64| {
            let mut psf = Array2::zeros((48, 48));
            for (y, x) in (0..48 * fine).flat_map(|y| (0..48 * fine).map(move |x| (y, x))) {
                let [u, v] = [x, y].map(|at| (at as f64 + 0.5) / fine as f64 - 24.0);
                let r = u.hypot(v);
                if r < radius {
                    psf[(y / fine, x / fine)] += (1.0 + (r / 2.795).powi(2)).powi(-3);
                }
            }
            psf
        };
        for radius in [5.7, 6.3, 7.0] {
            assert_eq!(
                Truncation::of(truncated(radius).view(), 1.0),
                None,
                "{radius}"
            );
        }
    }
}
