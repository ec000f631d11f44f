//! What can be reached: the Cramér–Rao bound on the scatter of ellipticities, and the Q that such scatter
//! leaves.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use shearq_fourier::Complex64;
use shearq_quantities::Shear;
use shearq_quantities::statistics::RunningMean;
use shearq_scoring::modes::Decomposer;
use shearq_scoring::quality::quality;
use shearq_scoring::{Bins, Convention, Definition};

use shearq_simulate::kinds::ImageType;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{NOISE_SIGMA, STAMP, SetSimulator, Version};

/// Ellipticity by which galaxies are changed to find how their images change.
const STEP: f64 = 0.02;
/// Galaxies looked at.
const GALAXIES: usize = 1000;
/// Cells from one of them to the next: a prime, so that none is looked at twice.
const STRIDE: usize = 7919;
/// Fields of noise behind a mean Q, which scatters by a third of itself: the mean is good to 2 %.
const TRIALS: u32 = 200;

/// Least scatter per component that an unbiased ellipticity of the set's galaxies can have, on their
/// full stamps with their noise: root mean square over galaxies.
///
/// For a nearly round galaxy the change of its image with one component of ε is orthogonal to its
/// changes with the other, with flux, size and centre, so that none of these costs information:
/// σ(ε) = σ/‖∂I/∂ε‖. `None` for bulges off their discs' centres: such a galaxy is not nearly round. The first number
/// is the bound, the second its standard error, of the galaxies that happen to be looked at.
pub fn cramer_rao(set: &SetSimulator) -> Option<(f64, f64)> {
    if set.kind().image == ImageType::OffsetBulge {
        return None;
    }
    let n = set.grid().n;
    let fields = set.image_fields(1);
    let mut scratch = RenderScratch::new();
    let mut draw = |at: (usize, usize), shape: Shear| {
        let mut stamp = vec![0.0; STAMP * STAMP];
        let version = Version {
            intrinsic: Shear::new(0.0, 0.0),
            shear: shape,
            noise: 0.0,
        };
        set.draw_as(&fields, at, version, &mut scratch, &mut stamp);
        stamp
    };
    let count = GALAXIES.min(n * n);
    let mut variances = RunningMean::default();
    for k in 0..count {
        // All over the field, in which PSFs vary.
        let cell = k * STRIDE % (n * n);
        let at = (cell % n, cell / n);
        let mut variance = 0.0;
        for (e1, e2) in [(STEP, 0.0), (0.0, STEP)] {
            let plus = draw(at, Shear::new(e1, e2));
            let minus = draw(at, Shear::new(-e1, -e2));
            let square: f64 = plus
                .iter()
                .zip(&minus)
                .map(|(a, b)| f64::from(a - b).powi(2))
                .sum();
            variance += 0.5 * (2.0 * STEP * NOISE_SIGMA).powi(2) / square;
        }
        variances.add(variance);
    }
    let bound = variances.mean().sqrt();
    let error = variances.deviation() / (count as f64).sqrt();
    Some((bound, 0.5 * error / bound))
}

/// Mean Q of a set's spectrum where its ellipticities have white noise of `scatter` per component in each
/// of `images` images and nothing else, whose mean power is subtracted: what sample noise leaves of a
/// perfect method.
pub fn sample_limit(set: &SetSimulator, scatter: f64, images: u32) -> f64 {
    let grid = set.grid();
    let (decomposer, bins) = (
        Decomposer::new(grid),
        Bins::new(&grid, Definition::Leaderboard),
    );
    let truth = set.truth();
    let shear = Convention::STANDARD.apply(&truth.g1, &truth.g2);
    let modes = decomposer.decompose(shear.clone()).e;
    let power = bins.power(&modes, &modes);
    let variance = scatter * scatter / f64::from(images);
    let mean = bins.white_noise(variance);
    let mut rng = ChaCha8Rng::seed_from_u64(u64::from(set.kind().set));
    let normal = Normal::new(0.0, variance.sqrt()).expect("a finite scatter");
    let total: f64 = (0..TRIALS)
        .map(|_| {
            let noisy = shear
                .mapv(|g| g + Complex64::new(normal.sample(&mut rng), normal.sample(&mut rng)));
            let modes = decomposer.decompose(noisy).e;
            let mut found = bins.power(&modes, &modes);
            for (found, mean) in found.iter_mut().zip(mean) {
                *found -= mean;
            }
            quality(&bins, &found, &power).q
        })
        .sum();
    total / f64::from(TRIALS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_pipeline::simulate::simulator;
    use shearq_simulate::set::SimulationSettings;

    #[test]
    fn the_bound_is_that_of_the_challenges_description() {
        // Fiducial at S/N 20 and 10, small, large: two digits are given.
        for (set, expected) in [(2, 0.107), (5, 0.214), (14, 0.126), (16, 0.102)] {
            let simulator = simulator(set, SimulationSettings::new(3, 12)).unwrap();
            let (found, error) = cramer_rao(&simulator).unwrap();
            assert!((found / expected - 1.0).abs() < 0.02, "set {set}: {found}");
            // One S/N and one profile: nothing but the ellipticities' spread is left.
            assert!(error / found < 0.005, "set {set}: {found} ± {error}");
        }
    }

    #[test]
    fn the_sample_limit_is_that_of_the_challenges_description() {
        // 200 images with scatter at the bound: 850, 2,200 and 4,900 are given for one shear field; Q of
        // a field goes with its own power in the widest bins, which has few modes.
        let mut limits = Vec::new();
        for (scatter, expected) in [(0.214, 850.0), (0.107, 2200.0), (0.054, 4900.0)] {
            let simulator = simulator(2, SimulationSettings::new(3, 100)).unwrap();
            let found = sample_limit(&simulator, scatter, 200);
            assert!((found / expected - 1.0).abs() < 0.15, "{found} {expected}");
            limits.push(found);
        }
        assert!(limits[0] < limits[1] && limits[1] < limits[2]);
    }
}
