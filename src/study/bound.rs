//! The Cramér–Rao bound on the scatter of ellipticities.

use shearq_scoring::Shear;

use crate::simulate::render::RenderScratch;
use crate::simulate::set::{NOISE_SIGMA, STAMP, SetSimulator};

/// Ellipticity by which galaxies are changed to find how their images change.
const STEP: f64 = 0.02;
/// Galaxies looked at.
const GALAXIES: usize = 100;

/// Least scatter per component that an unbiased ellipticity of the set's galaxies can have, on their
/// full stamps with their noise: root mean square over galaxies.
///
/// For a nearly round galaxy the change of its image with one component of ε is orthogonal to its
/// changes with the other, with flux, size and centre, so that none of these costs information:
/// σ(ε) = σ/‖∂I/∂ε‖.
pub fn cramer_rao(set: &SetSimulator) -> f64 {
    let n = set.grid().n;
    let fields = set.image_fields(1);
    let mut scratch = RenderScratch::new();
    let mut draw = |at: (usize, usize), shape: Shear| {
        let mut stamp = vec![0.0; STAMP * STAMP];
        set.draw_as(
            &fields,
            at,
            (Shear::new(0.0, 0.0), shape),
            &mut scratch,
            &mut stamp,
        );
        stamp
    };
    let count = GALAXIES.min(n * n);
    let mut variance = 0.0;
    for k in 0..count {
        let at = (k % n, k / n);
        for (e1, e2) in [(STEP, 0.0), (0.0, STEP)] {
            // Both are drawn with the same noise, which cancels.
            let plus = draw(at, Shear::new(e1, e2));
            let minus = draw(at, Shear::new(-e1, -e2));
            let square: f64 = plus
                .iter()
                .zip(&minus)
                .map(|(a, b)| f64::from(a - b).powi(2))
                .sum();
            variance += (2.0 * STEP * NOISE_SIGMA).powi(2) / square;
        }
    }
    (variance / (2.0 * count as f64)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::simulate::simulator;
    use crate::simulate::set::SimulationSettings;

    #[test]
    fn the_bound_is_that_of_the_challenges_description() {
        // Fiducial at S/N 20 and 10, small, large: two digits are given.
        for (set, expected) in [(2, 0.107), (5, 0.214), (14, 0.126), (16, 0.102)] {
            let simulator = simulator(set, SimulationSettings::new(3, 12)).unwrap();
            let found = cramer_rao(&simulator);
            assert!((found / expected - 1.0).abs() < 0.02, "set {set}: {found}");
        }
    }
}
