//! What a linear measurement looks at before it measures: where the galaxy is, and whether there is another.
//!
//! Galaxies look nearly the same turned by 180 degrees, and neighbours do not. If a place far from the galaxy is brighter than
//! its opposite by more than noise explains, there is a neighbour: a profile is fitted to the difference of the two sides and
//! subtracted. No pixels are copied, because copies repeat noise. Nearer to the galaxy, where lopsided galaxies differ from their
//! own opposites, the stamp is compared with usual galaxies. A neighbour that is too near or too bright flags the galaxy.

mod centre;
mod contrast;
mod missing;
mod near;
mod profile;
mod usual;

use self::centre::refined;
pub(crate) use self::centre::{centre, followed};
pub(crate) use self::contrast::{Contrasts, turn};
pub(crate) use self::missing::Missing;
use self::near::Near;
use self::profile::{AROUND, Profile};
use crate::measurement::Flag;

/// Least difference of opposite places that is a neighbour, in units of its noise. See
/// docs/constants.md.
const SIGNIFICANT: f32 = 5.0;
/// Least difference of opposite places that is a neighbour, in units of the galaxy's light. See
/// docs/constants.md.
const BRIGHT: f32 = 0.03;
/// Least light of a neighbour that overlaps the galaxy or cannot be subtracted, in units of its error. See docs/constants.md.
const OVERLAPPING: f32 = 4.7;
/// Least light of a neighbour that overlaps the galaxy, in units of the galaxy's. See docs/constants.md.
const BLENDED: f32 = 0.1;
/// Share of a neighbour's distance from the centre at which the fit of its profile begins. See
/// docs/constants.md.
const FITTED_FROM: f32 = 0.3;
/// Distance below which the comparison with usual galaxies alone finds neighbours, on stamps that it covers so far. See
/// docs/constants.md.
const COMPARED_TO: f32 = 14.0;
/// Distance below which a neighbour cannot be removed. See docs/constants.md.
const TOO_NEAR: f32 = 16.0;
/// Light of a neighbour, in units of the galaxy's light within 8 px, above which it cannot be
/// removed. See docs/constants.md.
const TOO_BRIGHT: f32 = 5.0;

/// A stamp's surroundings, and room for it without neighbours.
pub(crate) struct Surroundings {
    n: usize,
    pub(crate) filled: Vec<f32>,
    contrasts: Contrasts,
    near: Near,
    /// Distance below which `near` alone finds neighbours.
    compared_to: f32,
    profile: Profile,
}

impl Surroundings {
    pub(crate) fn new(n: usize) -> Self {
        let near = Near::new(n);
        Surroundings {
            n,
            filled: vec![0.0; n * n],
            contrasts: Contrasts::new(n),
            compared_to: COMPARED_TO.min(near.reach()),
            near,
            profile: Profile::new(n),
        }
    }

    /// Looks for neighbours of a galaxy centred at `centre`, in noise of level `noise` on large scales. True
    /// where some were subtracted; the stamp without them is in `self.filled`.
    ///
    /// # Errors
    /// Where one is too near, or too bright.
    pub(crate) fn clear(
        &mut self,
        stamp: &[f32],
        centre: [f32; 2],
        noise: f32,
    ) -> Result<bool, Flag> {
        let centre = refined(stamp, self.n, centre);
        // Pixel p is opposite to `turn − p`.
        let turn = turn(centre, self.n);
        self.contrasts.compare_smoothed(stamp, turn, differs(noise));
        let hits = &mut self.contrasts.blocks;
        hits.sort_unstable_by(|a, b| b.excess.total_cmp(&a.excess));
        // Light of the brightest neighbour that was subtracted.
        let mut most: Option<f32> = None;
        while let Some(&brightest) = hits.first() {
            let seen = if most.is_some() { &self.filled } else { stamp };
            let ([x, y], peak) = self.profile.place(seen, turn, brightest.place);
            let distance = x.hypot(y);
            // The brightest one is done wherever its light was found.
            hits.remove(0);
            if distance < self.compared_to {
                // It is a neighbour or the galaxy's own shape, which the comparison with usual galaxies tells. Either hides
                // nothing farther away.
                hits.retain(|hit| (hit.place[0] - x).hypot(hit.place[1] - y) > AROUND);
                continue;
            }
            if distance < TOO_NEAR {
                return Err(Flag::Neighbour);
            }
            let side = [x / distance, y / distance];
            let from = FITTED_FROM * distance;
            let along = |place: [f32; 2]| place[0] * side[0] + place[1] * side[1];
            if most.is_none() {
                self.filled.copy_from_slice(stamp);
            }
            let known = profile::Known { peak, noise };
            let light = self
                .profile
                .subtract(&mut self.filled, turn, [x, y], from, known);
            most = Some(most.unwrap_or(0.0).max(light));
            hits.retain(|hit| along(hit.place) <= from);
        }
        let Some(most) = most else {
            let light = self.contrasts.light;
            return blended(&mut self.near, stamp, centre, light, noise).map(|()| false);
        };
        let light = self.contrasts.inner(&self.filled, turn);
        if most > TOO_BRIGHT * light {
            return Err(Flag::Neighbour);
        }
        blended(&mut self.near, &self.filled, centre, light, noise).map(|()| true)
    }
}

/// Whether a place differs from its opposite by more than noise explains: by the galaxy's light, the excess and the number of
/// pixels.
fn differs(noise: f32) -> impl Fn(f32, f32, f32) -> bool {
    let square = (SIGNIFICANT * noise).powi(2);
    move |light, excess, pixels| excess > BRIGHT * light && excess * excess > square * pixels
}

/// # Errors
/// Where another galaxy overlaps this one, whose light is `light`, or cannot be subtracted.
fn blended(
    near: &mut Near,
    stamp: &[f32],
    centre: [f32; 2],
    light: f32,
    noise: f32,
) -> Result<(), Flag> {
    let known = near::Known {
        noise,
        light,
        least: BLENDED * light.max(0.0),
    };
    match near.suspect(stamp, centre, known) {
        Some(suspect) if suspect.significance > OVERLAPPING => Err(Flag::Neighbour),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 48;

    /// A Gaussian on a square stamp, (x, y) from its middle.
    fn gaussian(stamp: &mut [f32], [x, y]: [f32; 2], width: f32, peak: f32) {
        let n = stamp.len().isqrt();
        let middle = 0.5 * (n - 1) as f32;
        for (at, value) in stamp.iter_mut().enumerate() {
            let (dx, dy) = ((at % n) as f32 - middle - x, (at / n) as f32 - middle - y);
            *value += peak * (-(dx * dx + dy * dy) / (2.0 * width * width)).exp();
        }
    }

    fn blob(stamp: &mut [f32], x: f32, y: f32, light: f32) {
        gaussian(stamp, [x, y], 3.0, light);
    }

    #[test]
    fn centres_are_found_and_the_window_follows_those_that_are_far() {
        for (x, y) in [(0.0, 0.0), (1.0, -0.5), (-3.0, 1.5), (0.3, 4.0)] {
            let mut stamp = vec![0.0; N * N];
            blob(&mut stamp, x, y, 10.0);
            let found = centre(&stamp, N);
            // For a Gaussian of 3 px a step goes 1.5 · 4/(4 + 9) of the way; three of them leave 0.16 of it.
            let left = (found[0] - x).hypot(found[1] - y);
            assert!(left < 0.16 * x.hypot(y) + 0.01, "{found:?} {x} {y}");
        }
        assert_eq!(followed([0.9, -0.8]), [0.0; 2]);
        assert_eq!(followed([-2.0, 1.0]), [-2.0, 1.0]);
        assert_eq!(centre(&[-1.0; N * N], N), [0.0; 2]);
    }

    #[test]
    fn a_galaxy_alone_is_left_as_it_is_and_far_neighbours_are_filled() {
        let mut look = Surroundings::new(N);
        let mut alone = vec![0.0; N * N];
        blob(&mut alone, 0.4, -0.3, 20.0);
        assert_eq!(look.clear(&alone, [0.4, -0.3], 1.0), Ok(false));
        for (x, y) in [(20.0, 3.0), (-13.0, 14.0), (0.0, -19.0)] {
            let mut stamp = alone.clone();
            blob(&mut stamp, x, y, 20.0);
            assert_eq!(look.clear(&stamp, [0.4, -0.3], 1.0), Ok(true), "{x} {y}");
            // The fit has no Gaussian of this width: 5 % of the peak may be left of it.
            let worst = look.filled.iter().zip(&alone).map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, f32::max) < 1.0, "{x} {y}");
        }
        // Two of them, on different sides.
        let mut stamp = alone.clone();
        blob(&mut stamp, 20.0, 0.0, 20.0);
        blob(&mut stamp, 0.0, 20.0, 15.0);
        assert_eq!(look.clear(&stamp, [0.4, -0.3], 1.0), Ok(true));
        assert!(
            look.filled
                .iter()
                .skip(20 * N + 40)
                .take(8)
                .all(|v| v.abs() < 3.0)
        );
    }

    #[test]
    fn near_neighbours_are_told() {
        let mut look = Surroundings::new(N);
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.0, 0.0, 20.0);
        blob(&mut stamp, -7.0, 8.0, 20.0);
        assert_eq!(look.clear(&stamp, [0.0; 2], 1.0), Err(Flag::Neighbour));
        // One that overlaps the galaxy, in noise that does not hide it and in noise that does.
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.0, 0.0, 20.0);
        blob(&mut stamp, 5.0, -3.0, 12.0);
        assert_eq!(look.clear(&stamp, [0.0; 2], 1.0), Err(Flag::Neighbour));
        assert_eq!(look.clear(&stamp, [0.0; 2], 20.0), Ok(false));
    }

    /// With a faint disc, 5.5 px off.
    fn lopsided() -> Vec<f32> {
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.5, 0.0, 20.0);
        gaussian(&mut stamp, [5.5, 0.0], 5.0, 2.0);
        stamp
    }

    #[test]
    fn a_lopsided_galaxy_is_no_pair() {
        let mut look = Surroundings::new(N);
        let stamp = lopsided();
        let noise = 0.5;
        assert_eq!(look.clear(&stamp, [0.0; 2], noise), Ok(false));
        // Opposite places differ all the same.
        look.contrasts
            .compare_smoothed(&stamp, turn([0.0; 2], N), differs(noise));
        assert!(!look.contrasts.blocks.is_empty());
    }

    #[test]
    fn a_lopsided_galaxy_hides_no_neighbours() {
        let mut look = Surroundings::new(N);
        // The last one is fainter than the disc's side, which is looked at first.
        for (y, light) in [(0.0, 4.0), (6.0, 4.0), (-10.0, 4.0), (0.0, 2.0)] {
            let mut stamp = lopsided();
            blob(&mut stamp, 19.5, y, light);
            assert_eq!(look.clear(&stamp, [0.0; 2], 0.5), Ok(true), "{y}");
            let mut left = look.filled.iter().zip(lopsided()).map(|(a, b)| a - b);
            // Of 4, with the disc's wing.
            assert!(left.all(|left| left.abs() < 1.0), "{y}");
        }
    }

    #[test]
    fn neighbours_too_near_to_be_subtracted_are_told_if_they_are_faint() {
        let mut look = Surroundings::new(N);
        for (distance, expected) in [(14.8, Err(Flag::Neighbour)), (16.8, Ok(true))] {
            let mut stamp = vec![0.0; N * N];
            blob(&mut stamp, 0.0, 0.0, 20.0);
            // Less light than the comparison with usual galaxies requires.
            let (share, width) = (0.08, 2.0f32);
            assert!(share < BLENDED && share > BRIGHT);
            let peak = share * 20.0 * (3.0 / width).powi(2);
            let place = [-0.6 * distance, 0.8 * distance];
            gaussian(&mut stamp, place, width, peak);
            assert_eq!(look.clear(&stamp, [0.0; 2], 0.05), expected, "{distance}");
        }
    }

    #[test]
    fn neighbours_on_small_stamps_are_told() {
        // Beyond the cells of usual galaxies, in noise in which these cells do not show them.
        for (n, noise, beyond) in [
            (24, 3.0, 1.5),
            (25, 3.0, 1.5),
            (28, 4.0, 1.0),
            (31, 4.0, 1.5),
        ] {
            let mut look = Surroundings::new(n);
            let mut stamp = vec![0.0; n * n];
            gaussian(&mut stamp, [0.0; 2], 2.5, 20.0);
            assert_eq!(look.clear(&stamp, [0.0; 2], noise), Ok(false), "{n}");
            let place = [look.near.reach() + beyond, 0.0];
            gaussian(&mut stamp, place, 2.5, 10.0);
            let found = look.clear(&stamp, [0.0; 2], noise);
            assert_eq!(found, Err(Flag::Neighbour), "{n}");
            look.compared_to = COMPARED_TO;
            assert_eq!(look.clear(&stamp, [0.0; 2], noise), Ok(false), "{n}");
        }
    }

    #[test]
    fn elongated_neighbours_are_subtracted_and_noise_is_not_copied() {
        let mut look = Surroundings::new(N);
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.0, 0.0, 20.0);
        let alone = stamp.clone();
        for (at, value) in stamp.iter_mut().enumerate() {
            let (x, y) = ((at % N) as f32 - 40.5, (at / N) as f32 - 27.5);
            *value += 30.0 * (-(x * x + 1.5 * y * y + 0.5 * x * y) / 18.0).exp();
        }
        // A bright pixel, opposite to the neighbour's side but not to its light.
        let bright = 40 * N + 6;
        stamp[bright] += 2.0;
        assert_eq!(look.clear(&stamp, [0.0; 2], 0.5), Ok(true));
        let left = |at: usize| look.filled[at] - alone[at];
        // Round terms alone leave a fifth of the peak.
        let worst = (0..N * N)
            .filter(|at| *at != bright)
            .map(|at| left(at).abs());
        assert!(worst.fold(0.0, f32::max) < 2.0);
        let opposite = left(N * N - 1 - bright);
        assert!(opposite.abs() < 0.5, "{opposite}");
    }

    #[test]
    fn neighbours_that_outshine_the_galaxy_are_told() {
        let mut look = Surroundings::new(N);
        for (light, expected) in [(75.0, Ok(true)), (95.0, Err(Flag::Neighbour))] {
            let mut stamp = vec![0.0; N * N];
            blob(&mut stamp, 0.0, 0.0, 20.0);
            blob(&mut stamp, -14.0, 9.0, light);
            assert_eq!(look.clear(&stamp, [0.0; 2], 1.0), expected, "{light}");
        }
    }
}
