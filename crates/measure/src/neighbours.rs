//! Neighbours on the stamp of a galaxy: subtracted, or a reason to flag the galaxy.
//!
//! Galaxies look nearly the same rotated by 180 degrees, and neighbours do not. If a place far from the galaxy is brighter
//! than its opposite by more than noise explains, there is a neighbour: a profile is fitted to the difference of the two
//! sides and subtracted. No pixels are copied from the opposite side, because copies repeat noise. Nearer to the galaxy,
//! where lopsided galaxies differ from their own opposites, the stamp is compared with a reference population of galaxies.
//! A neighbour that is too near or too bright flags the galaxy.

mod candidate;
mod galaxy_basis;

use shearq_quantities::linear::cholesky;

use self::candidate::{CandidateFinder, Scale};
use crate::asymmetry::{Asymmetry, opposite, rotation_sum};
use crate::centroid::refined_centroid;
use crate::measurement::Flag;

// Least excess of a place over its opposite that is a neighbour, in σ of its noise.
// At 4.0, 5 of 1,000 isolated galaxies at S/N 20 lose a neighbour that is noise.
const MIN_SIGNIFICANCE: f32 = 5.0;
// The same in units of the galaxy's light. Chosen by hand.
const MIN_EXCESS: f32 = 0.03;
// Least light of a candidate that flags the galaxy, in σ.
// 9 of 86,400 isolated galaxies of the sets are flagged (simulate --sets 1-24 --images 1 --grid 60 --seed 77). At 4.6 it is
// 13, and 2 % more blends at 5 to 7 px are found.
const MIN_CANDIDATE_SIGNIFICANCE: f32 = 4.7;
// The same in units of the galaxy's light: a third of the faintest neighbour of the study. Chosen by hand.
const MIN_CANDIDATE_LIGHT: f32 = 0.1;
// Share of a neighbour's distance from the galaxy at which the fit of its profile begins. Chosen by hand.
const FIT_START: f32 = 0.3;
// Distance in pixels below which the comparison with the reference population alone finds neighbours.
// Below the largest distance of candidates. With the asymmetry at all distances, twice as many galaxies with knots are
// flagged at S/N 100, and nearly all behind a PSF with coma.
const CANDIDATE_DISTANCE: f32 = 14.0;
// Distance in pixels below which a neighbour cannot be subtracted.
// Chosen by hand. With 13, m1 is −0.047 ± 0.004 for bright neighbours at 13 to 16 px that are sheared with the galaxy:
// cargo run --release -p shearq-studies --example neighbours -- 4800 3 20, seed 3.
const MIN_SUBTRACTED_DISTANCE: f32 = 16.0;
// Largest light of a neighbour that can be subtracted, in units of the galaxy's light within 8 px.
// It is two to three galaxies. Chosen by hand.
const MAX_SUBTRACTED_LIGHT: f32 = 5.0;

// σ in pixels of the Gaussians of a neighbour's profile, from a PSF's core to a large galaxy's wings.
// Steps of 1.75.
const SIGMAS: [f32; GAUSSIANS] = [2.0, 3.5, 6.0, 10.5];
const GAUSSIANS: usize = 4; // The length of SIGMAS.
// Which Gaussians may be elongated; the first of them may be displaced.
// Those of a galaxy's own size.
const ELONGATED: [usize; 2] = [1, 2];
const NEIGHBOUR_TERMS: usize = GAUSSIANS + 2 + 2 * ELONGATED.len();
// Prior σ of the amplitudes in units of the neighbour's peak: round terms, displacement, elongations.
// Chosen by hand. Without the prior, the measurement noise of one component is 0.131 instead of 0.120 at 16 to 20 px: cargo
// run --release -p shearq-studies --example neighbours -- 300 1 20, seed 1.
const AMPLITUDE_PRIOR: [f32; NEIGHBOUR_TERMS] =
    [1.0, 1.0, 0.3, 0.03, 0.3, 0.3, 0.3, 0.3, 0.03, 0.03];
// σ in pixels of the Gaussians whose derivatives model a displacement of the galaxy.
// Small and large galaxies behind the PSF.
const GALAXY_SIGMAS: [f32; 2] = [2.2, 4.0];
const GALAXY_TERMS: usize = 2 * GALAXY_SIGMAS.len();
const TERMS: usize = NEIGHBOUR_TERMS + GALAXY_TERMS;
// Added to the diagonal of normal equations, relative to it, so that they are soluble. Chosen by hand.
const RELATIVE_RIDGE: f64 = 1e-6;

// σ in pixels of the Gaussian that is fitted for a neighbour's position. Chosen by hand.
const POSITION_SIGMA: f32 = 3.0;
// Three σ, in pixels around a neighbour.
const POSITION_RADIUS: f32 = 9.0;
// Chosen by hand.
const POSITION_STEPS: usize = 4;
// In pixels. Chosen by hand.
const MAX_POSITION_STEP: f32 = 2.0;

/// Removes neighbours from stamps of one size.
pub(crate) struct NeighbourRemover {
    n: usize,
    /// The last stamp without its neighbours.
    pub(crate) cleaned: Vec<f32>,
    asymmetry: Asymmetry,
    candidates: CandidateFinder,
    /// Small stamps have candidates up to a smaller distance.
    candidate_distance: f32,
    fit: NeighbourFit,
}

impl NeighbourRemover {
    pub(crate) fn new(n: usize) -> Self {
        let candidates = CandidateFinder::new(n);
        NeighbourRemover {
            n,
            cleaned: vec![0.0; n * n],
            asymmetry: Asymmetry::new(n),
            candidate_distance: CANDIDATE_DISTANCE.min(candidates.half_side()),
            candidates,
            fit: NeighbourFit::new(n),
        }
    }

    /// Subtracts the neighbours of a galaxy with this centroid, in noise of level `noise` on large scales. Returns whether
    /// there were some; the stamp without them is then in `cleaned`.
    ///
    /// # Errors
    /// If a neighbour is too near, or too bright.
    pub(crate) fn remove(
        &mut self,
        stamp: &[f32],
        centroid: [f32; 2],
        noise: f32,
    ) -> Result<bool, Flag> {
        let centroid = refined_centroid(stamp, self.n, centroid);
        let rotation = rotation_sum(centroid, self.n);
        self.asymmetry
            .compare_smoothed(stamp, rotation, is_neighbour(noise));
        let places = &mut self.asymmetry.places;
        places.sort_unstable_by(|a, b| b.excess.total_cmp(&a.excess));
        // Light of the brightest neighbour that was subtracted.
        let mut subtracted: Option<f32> = None;
        while let Some(&brightest) = places.first() {
            let current = if subtracted.is_some() {
                &self.cleaned
            } else {
                stamp
            };
            let ([x, y], peak) = self.fit.position(current, rotation, brightest.offset);
            let distance = x.hypot(y);
            // Wherever its light was found, so that the loop ends.
            places.remove(0);
            if distance < self.candidate_distance {
                // A neighbour or the galaxy's own shape, which the reference population separates. Either hides nothing
                // farther away.
                places.retain(|place| {
                    (place.offset[0] - x).hypot(place.offset[1] - y) > POSITION_RADIUS
                });
                continue;
            }
            if distance < MIN_SUBTRACTED_DISTANCE {
                return Err(Flag::Neighbour);
            }
            let side = [x / distance, y / distance];
            let start = FIT_START * distance;
            let along = |offset: [f32; 2]| offset[0] * side[0] + offset[1] * side[1];
            if subtracted.is_none() {
                self.cleaned.copy_from_slice(stamp);
            }
            let light =
                self.fit
                    .subtract(&mut self.cleaned, rotation, [x, y], start, [peak, noise]);
            subtracted = Some(subtracted.unwrap_or(0.0).max(light));
            // Other places on this side were fitted with it.
            places.retain(|place| along(place.offset) <= start);
        }
        let Some(subtracted) = subtracted else {
            let light = self.asymmetry.light;
            return self
                .candidates
                .check(stamp, centroid, light, noise)
                .map(|()| false);
        };
        let light = self.asymmetry.inner_light(&self.cleaned, rotation);
        if subtracted > MAX_SUBTRACTED_LIGHT * light {
            return Err(Flag::Neighbour);
        }
        self.candidates
            .check(&self.cleaned, centroid, light, noise)
            .map(|()| true)
    }
}

/// Whether a place differs from its opposite by more than noise: by the galaxy's light, the excess and the number of pixels.
fn is_neighbour(noise: f32) -> impl Fn(f32, f32, f32) -> bool {
    let square = (MIN_SIGNIFICANCE * noise).powi(2);
    move |light, excess, pixels| excess > MIN_EXCESS * light && excess * excess > square * pixels
}

impl CandidateFinder {
    /// # Errors
    /// If another galaxy overlaps this one of light `light`, or cannot be subtracted.
    fn check(
        &mut self,
        stamp: &[f32],
        centroid: [f32; 2],
        light: f32,
        noise: f32,
    ) -> Result<(), Flag> {
        let scale = Scale {
            noise,
            light,
            min_light: MIN_CANDIDATE_LIGHT * light.max(0.0),
        };
        match self.most_significant(stamp, centroid, scale) {
            Some(found) if found.significance > MIN_CANDIDATE_SIGNIFICANCE => Err(Flag::Neighbour),
            _ => Ok(()),
        }
    }
}

/// Fits the profile of a neighbour: concentric Gaussians, whose amplitudes follow by linear least squares.
///
/// The excess of a pixel over its opposite is, but for noise, the neighbour's light there less that in the opposite pixel.
/// The profile is subtracted from the whole stamp: a neighbour's wings extend to the galaxy's side, where a fit or a copy of
/// the opposite side alone would leave them.
struct NeighbourFit {
    n: usize,
    /// Factors of the terms along x and y: of the neighbour at the pixels and at their opposites, and of the galaxy.
    here: [Vec<NeighbourFactors>; 2],
    opposite: [Vec<NeighbourFactors>; 2],
    galaxy: [Vec<GalaxyFactors>; 2],
}

impl NeighbourFit {
    fn new(n: usize) -> Self {
        let factors = || [(); 2].map(|()| vec![NeighbourFactors::default(); n]);
        NeighbourFit {
            n,
            here: factors(),
            opposite: factors(),
            galaxy: [(); 2].map(|()| vec![GalaxyFactors::default(); n]),
        }
    }

    /// Position of a neighbour from the galaxy's centre, (x, y) in pixels, near `start`, and its peak: those of a Gaussian
    /// that fits best. A centroid would be drawn inwards where the stamp ends beside the neighbour.
    fn position(&self, stamp: &[f32], rotation: [i32; 2], start: [f32; 2]) -> ([f32; 2], f32) {
        let mut peak = 0.0;
        let centre = rotation.map(|sum| sum as f32 / 2.0);
        let [mut x, mut y] = start;
        for _ in 0..POSITION_STEPS {
            // A Gaussian, and its derivatives with the position along both axes.
            let mut matrix = [[0.0; 3]; 3];
            let mut right = [0.0; 3];
            for row in self.near(centre[1] + y) {
                let dy = row as f32 - centre[1] - y;
                for column in self.near(centre[0] + x) {
                    let dx = column as f32 - centre[0] - x;
                    let excess = stamp[row * self.n + column]
                        - opposite(stamp, self.n, rotation, [column, row]).unwrap_or(0.0);
                    let square = (dx * dx + dy * dy) / (POSITION_SIGMA * POSITION_SIGMA);
                    let light = (-0.5 * square).exp();
                    let terms = [light, light * dx, light * dy];
                    add_equation(&mut matrix, &mut right, terms, excess, 1.0);
                }
            }
            let [light, along_x, along_y] = solve(matrix, right);
            if light <= 0.0 {
                return (start, peak);
            }
            peak = light as f32;
            let step = |along: f64| {
                let step = POSITION_SIGMA * POSITION_SIGMA * (along / light) as f32;
                step.clamp(-MAX_POSITION_STEP, MAX_POSITION_STEP)
            };
            (x, y) = (x + step(along_x), y + step(along_y));
        }
        // Farther away it is another object.
        if (x - start[0]).hypot(y - start[1]) < POSITION_RADIUS {
            ([x, y], peak)
        } else {
            (start, peak)
        }
    }

    fn near(&self, pixel: f32) -> std::ops::Range<usize> {
        let on_stamp = |at: f32| at.clamp(0.0, self.n as f32) as usize;
        on_stamp((pixel - POSITION_RADIUS).ceil())
            ..on_stamp((pixel + POSITION_RADIUS + 1.0).floor())
    }

    /// Subtracts from `stamp` the neighbour at `position` from the galaxy's centre, and returns its light. The fit is to
    /// pixels farther than `start` in the neighbour's direction.
    fn subtract(
        &mut self,
        stamp: &mut [f32],
        rotation: [i32; 2],
        position: [f32; 2],
        start: f32,
        peak_and_noise: [f32; 2],
    ) -> f32 {
        for axis in 0..2 {
            let centre = rotation[axis] as f32 / 2.0;
            for at in 0..self.n {
                let x = at as f32 - centre;
                self.here[axis][at] = NeighbourFactors::at(x - position[axis]);
                self.opposite[axis][at] = NeighbourFactors::at(-x - position[axis]);
                self.galaxy[axis][at] = GalaxyFactors::at(x);
            }
        }
        let amplitudes = self.amplitudes(stamp, rotation, position, start, peak_and_noise);
        for (row, line) in stamp.chunks_exact_mut(self.n).enumerate() {
            let y = &self.here[1][row];
            for (pixel, x) in line.iter_mut().zip(&self.here[0]) {
                let terms = x.terms(y);
                let light = terms.iter().zip(&amplitudes);
                *pixel -= light.map(|(t, a)| t * *a as f32).sum::<f32>();
            }
        }
        let areas = SIGMAS.map(|sigma| 2.0 * std::f32::consts::PI * sigma * sigma);
        let lights = amplitudes.iter().zip(areas);
        lights.map(|(peak, area)| *peak as f32 * area).sum()
    }

    /// Amplitudes of the neighbour's terms, and of those of the galaxy's displacement.
    fn amplitudes(
        &self,
        stamp: &[f32],
        rotation: [i32; 2],
        position: [f32; 2],
        start: f32,
        [peak, noise]: [f32; 2],
    ) -> [f64; TERMS] {
        let distance = position[0].hypot(position[1]);
        let side = position.map(|p| p / distance);
        let mut matrix = [[0.0; TERMS]; TERMS];
        let mut right = [0.0; TERMS];
        if peak > 0.0 {
            for (k, prior) in AMPLITUDE_PRIOR.into_iter().enumerate() {
                let ratio = f64::from(noise / (prior * peak));
                matrix[k][k] = ratio * ratio;
            }
        }
        for row in 0..self.n {
            let across = (row as f32 - rotation[1] as f32 / 2.0) * side[1];
            for column in 0..self.n {
                if (column as f32 - rotation[0] as f32 / 2.0) * side[0] + across <= start {
                    continue;
                }
                let own = self.here[0][column].terms(&self.here[1][row]);
                let mut terms = [0.0; TERMS];
                terms[..NEIGHBOUR_TERMS].copy_from_slice(&own);
                let mut excess = stamp[row * self.n + column];
                let mut weight = 1.0;
                if let Some(light) = opposite(stamp, self.n, rotation, [column, row]) {
                    let other = self.opposite[0][column].terms(&self.opposite[1][row]);
                    for (term, other) in terms.iter_mut().zip(other) {
                        *term -= other;
                    }
                    let galaxy = self.galaxy[0][column].terms(&self.galaxy[1][row]);
                    terms[NEIGHBOUR_TERMS..].copy_from_slice(&galaxy);
                    excess -= light;
                    // A difference has twice the variance of a pixel.
                    weight = 0.5;
                }
                add_equation(&mut matrix, &mut right, terms, excess, weight);
            }
        }
        solve(matrix, right)
    }
}

/// Factors along one axis of a neighbour's terms.
#[derive(Clone, Copy, Default)]
struct NeighbourFactors {
    /// In units of [`POSITION_SIGMA`].
    offset: f32,
    gaussians: [f32; GAUSSIANS],
}

impl NeighbourFactors {
    fn at(x: f32) -> Self {
        NeighbourFactors {
            offset: x / POSITION_SIGMA,
            gaussians: SIGMAS.map(|sigma| (-0.5 * (x / sigma).powi(2)).exp()),
        }
    }

    /// All terms at a pixel, `self` being along x: round ones, two of a displacement, and two of each elongation.
    fn terms(&self, y: &NeighbourFactors) -> [f32; NEIGHBOUR_TERMS] {
        let mut terms = [0.0; NEIGHBOUR_TERMS];
        for (k, term) in terms.iter_mut().take(GAUSSIANS).enumerate() {
            *term = self.gaussians[k] * y.gaussians[k];
        }
        let (u, v) = (self.offset, y.offset);
        let round = terms[ELONGATED[0]];
        terms[GAUSSIANS] = u * round;
        terms[GAUSSIANS + 1] = v * round;
        for (k, gaussian) in ELONGATED.into_iter().enumerate() {
            let round = terms[gaussian];
            terms[GAUSSIANS + 2 + 2 * k] = (u * u - v * v) * round;
            terms[GAUSSIANS + 3 + 2 * k] = u * v * round;
        }
        terms
    }
}

/// Factors along one axis of the terms of a galaxy's displacement.
#[derive(Clone, Copy, Default)]
struct GalaxyFactors {
    x: f32,
    gaussians: [f32; GALAXY_SIGMAS.len()],
}

impl GalaxyFactors {
    fn at(x: f32) -> Self {
        GalaxyFactors {
            x,
            gaussians: GALAXY_SIGMAS.map(|sigma| (-0.5 * (x / sigma).powi(2)).exp()),
        }
    }

    fn terms(&self, y: &GalaxyFactors) -> [f32; GALAXY_TERMS] {
        std::array::from_fn(|k| {
            let round = self.gaussians[k / 2] * y.gaussians[k / 2];
            round * if k % 2 == 0 { self.x } else { y.x }
        })
    }
}

/// Adds a pixel to the lower triangle of normal equations.
fn add_equation<const N: usize>(
    matrix: &mut [[f64; N]; N],
    right: &mut [f64; N],
    terms: [f32; N],
    value: f32,
    weight: f64,
) {
    for i in 0..N {
        let term = weight * f64::from(terms[i]);
        right[i] += term * f64::from(value);
        for j in 0..=i {
            matrix[i][j] += term * f64::from(terms[j]);
        }
    }
}

/// Solves normal equations; unknowns without pixels are zero.
fn solve<const N: usize>(mut matrix: [[f64; N]; N], mut right: [f64; N]) -> [f64; N] {
    for (i, row) in matrix.iter_mut().enumerate() {
        row[i] *= 1.0 + RELATIVE_RIDGE;
    }
    // No pivot is refused, so that there is always a solution.
    let positive = |pivot: f64| Some(pivot.max(f64::MIN_POSITIVE));
    let _ = cholesky(&mut matrix, &mut right, N, positive);
    right
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
    fn far_neighbours_are_subtracted_from_a_galaxy() {
        let mut remover = NeighbourRemover::new(N);
        let mut alone = vec![0.0; N * N];
        blob(&mut alone, 0.4, -0.3, 20.0);
        assert_eq!(remover.remove(&alone, [0.4, -0.3], 1.0), Ok(false));
        for (x, y) in [(20.0, 3.0), (-13.0, 14.0), (0.0, -19.0)] {
            let mut stamp = alone.clone();
            blob(&mut stamp, x, y, 20.0);
            assert_eq!(
                remover.remove(&stamp, [0.4, -0.3], 1.0),
                Ok(true),
                "{x} {y}"
            );
            // The fit has no Gaussian of this width: 5 % of the peak may be left of it.
            let worst = remover
                .cleaned
                .iter()
                .zip(&alone)
                .map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, f32::max) < 1.0, "{x} {y}");
        }
        // Two of them, on different sides.
        let mut stamp = alone.clone();
        blob(&mut stamp, 20.0, 0.0, 20.0);
        blob(&mut stamp, 0.0, 20.0, 15.0);
        assert_eq!(remover.remove(&stamp, [0.4, -0.3], 1.0), Ok(true));
        assert!(
            remover
                .cleaned
                .iter()
                .skip(20 * N + 40)
                .take(8)
                .all(|v| v.abs() < 3.0)
        );
    }

    #[test]
    fn near_neighbours_flag_the_galaxy() {
        let mut remover = NeighbourRemover::new(N);
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.0, 0.0, 20.0);
        blob(&mut stamp, -7.0, 8.0, 20.0);
        assert_eq!(remover.remove(&stamp, [0.0; 2], 1.0), Err(Flag::Neighbour));
        // One that overlaps the galaxy, in noise that does not hide it and in noise that does.
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.0, 0.0, 20.0);
        blob(&mut stamp, 5.0, -3.0, 12.0);
        assert_eq!(remover.remove(&stamp, [0.0; 2], 1.0), Err(Flag::Neighbour));
        assert_eq!(remover.remove(&stamp, [0.0; 2], 20.0), Ok(false));
    }

    /// With a faint disc, 5.5 px off.
    fn lopsided() -> Vec<f32> {
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.5, 0.0, 20.0);
        gaussian(&mut stamp, [5.5, 0.0], 5.0, 2.0);
        stamp
    }

    #[test]
    fn a_lopsided_galaxy_is_not_a_pair() {
        let mut remover = NeighbourRemover::new(N);
        let stamp = lopsided();
        let noise = 0.5;
        assert_eq!(remover.remove(&stamp, [0.0; 2], noise), Ok(false));
        // Opposite places differ all the same.
        remover
            .asymmetry
            .compare_smoothed(&stamp, rotation_sum([0.0; 2], N), is_neighbour(noise));
        assert!(!remover.asymmetry.places.is_empty());
    }

    #[test]
    fn a_lopsided_galaxy_hides_no_neighbours() {
        let mut remover = NeighbourRemover::new(N);
        // The last one is fainter than the disc's side, which is looked at first.
        for (y, light) in [(0.0, 4.0), (6.0, 4.0), (-10.0, 4.0), (0.0, 2.0)] {
            let mut stamp = lopsided();
            blob(&mut stamp, 19.5, y, light);
            assert_eq!(remover.remove(&stamp, [0.0; 2], 0.5), Ok(true), "{y}");
            let mut left = remover.cleaned.iter().zip(lopsided()).map(|(a, b)| a - b);
            // Of 4, with the disc's wing.
            assert!(left.all(|left| left.abs() < 1.0), "{y}");
        }
    }

    #[test]
    fn faint_neighbours_too_near_to_subtract_are_flagged() {
        let mut remover = NeighbourRemover::new(N);
        for (distance, expected) in [(14.8, Err(Flag::Neighbour)), (16.8, Ok(true))] {
            let mut stamp = vec![0.0; N * N];
            blob(&mut stamp, 0.0, 0.0, 20.0);
            // Less light than the comparison with the reference population requires.
            let (share, width) = (0.08, 2.0f32);
            assert!(share < MIN_CANDIDATE_LIGHT && share > MIN_EXCESS);
            let peak = share * 20.0 * (3.0 / width).powi(2);
            let place = [-0.6 * distance, 0.8 * distance];
            gaussian(&mut stamp, place, width, peak);
            assert_eq!(
                remover.remove(&stamp, [0.0; 2], 0.05),
                expected,
                "{distance}"
            );
        }
    }

    #[test]
    fn neighbours_on_small_stamps_are_flagged() {
        // Beyond the cells of the reference population, in noise in which these cells do not show them.
        for (n, noise, beyond) in [
            (24, 3.0, 1.5),
            (25, 3.0, 1.5),
            (28, 4.0, 1.0),
            (31, 4.0, 1.5),
        ] {
            let mut remover = NeighbourRemover::new(n);
            let mut stamp = vec![0.0; n * n];
            gaussian(&mut stamp, [0.0; 2], 2.5, 20.0);
            assert_eq!(remover.remove(&stamp, [0.0; 2], noise), Ok(false), "{n}");
            let place = [remover.candidates.half_side() + beyond, 0.0];
            gaussian(&mut stamp, place, 2.5, 10.0);
            let found = remover.remove(&stamp, [0.0; 2], noise);
            assert_eq!(found, Err(Flag::Neighbour), "{n}");
            remover.candidate_distance = CANDIDATE_DISTANCE;
            assert_eq!(remover.remove(&stamp, [0.0; 2], noise), Ok(false), "{n}");
        }
    }

    #[test]
    fn elongated_neighbours_are_subtracted_without_copies() {
        let mut remover = NeighbourRemover::new(N);
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
        assert_eq!(remover.remove(&stamp, [0.0; 2], 0.5), Ok(true));
        let left = |at: usize| remover.cleaned[at] - alone[at];
        // Round terms alone leave a fifth of the peak.
        let worst = (0..N * N)
            .filter(|at| *at != bright)
            .map(|at| left(at).abs());
        assert!(worst.fold(0.0, f32::max) < 2.0);
        let opposite = left(N * N - 1 - bright);
        assert!(opposite.abs() < 0.5, "{opposite}");
    }

    #[test]
    fn neighbours_that_outshine_the_galaxy_flag_it() {
        let mut remover = NeighbourRemover::new(N);
        for (light, expected) in [(75.0, Ok(true)), (95.0, Err(Flag::Neighbour))] {
            let mut stamp = vec![0.0; N * N];
            blob(&mut stamp, 0.0, 0.0, 20.0);
            blob(&mut stamp, -14.0, 9.0, light);
            assert_eq!(remover.remove(&stamp, [0.0; 2], 1.0), expected, "{light}");
        }
    }

    /// Concentric Gaussians around `place` from the middle, in light of 1, 0.5, …
    fn neighbour(place: [f32; 2]) -> Vec<f32> {
        let at = |pixel: usize, axis: usize| {
            NeighbourFactors::at(pixel as f32 - 23.5 - place[axis]).gaussians
        };
        let pixel = |p: usize| {
            let (x, y) = (at(p % N, 0), at(p / N, 1));
            (0..GAUSSIANS).map(|k| x[k] * y[k] / (1 << k) as f32).sum()
        };
        (0..N * N).map(pixel).collect()
    }

    #[test]
    fn a_round_neighbour_is_subtracted_and_the_galaxy_kept() {
        let galaxy = |p: usize| {
            let (x, y) = ((p % N) as f32 - 23.5, (p / N) as f32 - 23.5);
            20.0 * (-(x * x + 0.7 * y * y + 0.4 * x * y) / 18.0).exp()
        };
        let mut fit = NeighbourFit::new(N);
        // The nearest one reaches its own opposite side.
        for place in [
            [20.0, 0.0],
            [-12.0, 9.0],
            [5.0, -17.0],
            [16.0, 16.0],
            [8.0, -7.0],
        ] {
            let light = neighbour(place);
            let mut stamp: Vec<f32> = (0..N * N).map(|p| galaxy(p) + light[p]).collect();
            fit.subtract(&mut stamp, [47, 47], place, 5.0, [1.5, 0.0]);
            // f32 holds light of 20 to 2e-6, and the equations lose three to four digits.
            let worst = (0..N * N).map(|p| (stamp[p] - galaxy(p)).abs());
            assert!(worst.fold(0.0, f32::max) < 5e-3, "{place:?}");
        }
    }

    #[test]
    fn neighbours_at_the_edge_have_their_position() {
        let fit = NeighbourFit::new(N);
        for place in [[20.0, 1.0], [-12.0, 9.5], [2.0, -21.5]] {
            let stamp: Vec<f32> = (0..N * N)
                .map(|p| {
                    let (x, y) = (
                        (p % N) as f32 - 23.5 - place[0],
                        (p / N) as f32 - 23.5 - place[1],
                    );
                    (-(x * x + y * y) / 18.0).exp()
                })
                .collect();
            let ([x, y], peak) = fit.position(&stamp, [47, 47], [place[0] - 2.0, place[1] + 2.5]);
            assert!((peak - 1.0).abs() < 0.01, "{peak}");
            // Steps go the whole way for a Gaussian of that width, and converge quadratically.
            assert!(
                (x - place[0]).hypot(y - place[1]) < 0.01,
                "{x} {y} {place:?}"
            );
        }
    }

    #[test]
    fn unknowns_without_pixels_are_zero() {
        let mut matrix = [[0.0; 3]; 3];
        matrix[0][0] = 4.0;
        let found = solve(matrix, [2.0, 0.0, 0.0]);
        assert!((found[0] - 0.5).abs() < 1e-6 && found[1..] == [0.0; 2]);
    }
}
