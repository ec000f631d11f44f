//! The Cramér–Rao bound on the scatter of ellipticities.

use shearq_quantities::Shear;
use shearq_quantities::statistics::RunningMean;
use shearq_simulate::kinds::ImageType;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{NOISE_SIGMA, STAMP, SetSimulator, Version};

// Step of ellipticity for the numerical derivative of an image. Chosen by hand.
const STEP: f64 = 0.02;
// The bound of sets with one S/N and one profile is known to 0.5 % (the test below).
const GALAXIES: usize = 1000;
// A prime, so that no cell is sampled twice; galaxies come from the whole field, because PSFs vary.
const STRIDE: usize = 7919;

/// Smallest possible scatter per component of unbiased ellipticities, and its standard error from the sample of
/// galaxies. It is the root mean square over galaxies on full stamps with their noise.
///
/// For a nearly round galaxy the derivatives of its image with the components of ε are orthogonal to each other
/// and to the derivatives with flux, size and centre. None of these parameters costs information, so
/// σ(ε) = σ/‖∂I/∂ε‖. `None` for offset bulges, which are not nearly round: their images change if they turn by 180 degrees.
pub fn cramer_rao(set: &SetSimulator) -> Option<(f64, f64)> {
    if set.kind().image == ImageType::OffsetBulge {
        return None;
    }
    let fields = set.image_fields(1);
    let mut scratch = RenderScratch::new();
    // A round galaxy without noise under a shear.
    let mut draw = |at: (usize, usize), shear: Shear| {
        let mut stamp = vec![0.0f32; STAMP * STAMP];
        let version = Version {
            intrinsic: Shear::ZERO,
            shear,
            size: 1.0,
            noise: 0.0,
        };
        set.draw_as(&fields, at, version, &mut scratch, &mut stamp);
        stamp
    };
    let n = set.grid().n;
    let cells = (0..GALAXIES.min(n * n)).map(|k| k * STRIDE % (n * n));
    let mut variances = RunningMean::default();
    for at in cells.map(|cell| (cell % n, cell / n)) {
        let mut variance = 0.0;
        for (e1, e2) in [(STEP, 0.0), (0.0, STEP)] {
            let [plus, minus] = [1.0, -1.0].map(|sign| draw(at, Shear::new(sign * e1, sign * e2)));
            let pixels = plus.iter().zip(&minus);
            let square: f64 = pixels.map(|(a, b)| f64::from(a - b).powi(2)).sum();
            variance += 0.5 * (2.0 * STEP * NOISE_SIGMA).powi(2) / square;
        }
        variances.add(variance);
    }
    let bound = variances.mean().sqrt();
    let error = variances.deviation() / (variances.count() as f64).sqrt();
    Some((bound, 0.5 * error / bound))
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_pipeline::simulate::simulator;
    use shearq_simulate::set::SimulationSettings;

    #[test]
    fn the_bound_agrees_with_the_challenge() {
        // Fiducial at S/N 20 and 10, small, large: two digits are given.
        for (set, expected) in [(2, 0.107), (5, 0.214), (14, 0.126), (16, 0.102)] {
            let simulator = simulator(set, SimulationSettings::new(3, 12)).unwrap();
            let (found, error) = cramer_rao(&simulator).unwrap();
            assert!((found / expected - 1.0).abs() < 0.02, "set {set}: {found}");
            // One S/N and one profile: only the spread of ellipticities remains.
            assert!(error / found < 0.005, "set {set}: {found} ± {error}");
        }
    }
}
