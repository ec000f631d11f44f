//! Challenges whose sets have one shear for all galaxies: m and c from the sets, as in GREAT3.

use std::collections::BTreeMap;

use shearq_results::record::SetRecord;
use shearq_scoring::great3::{Observation, REQUIRED_C, REQUIRED_M};
use shearq_scoring::{Line, TrueShear};

// Fewest sets for m and c of a component: two for the line, and one that the line does not pass through by
// construction. A team that knows its mean ellipticities solves for one shear with three published values.
const MIN_SETS: usize = 3;

#[derive(Debug, Clone, PartialEq)]
pub struct ConstantShears(BTreeMap<u32, [f64; 2]>);

pub type Measured = (f64, f64);

impl ConstantShears {
    /// `None` if the shear of every set varies.
    pub fn of<'a>(
        truths: impl IntoIterator<Item = (u32, &'a TrueShear)>,
    ) -> Result<Option<Self>, String> {
        let all: Vec<(u32, Option<[f64; 2]>)> = truths
            .into_iter()
            .map(|(set, truth)| (set, truth.constant()))
            .collect();
        let shears: BTreeMap<u32, [f64; 2]> = all
            .iter()
            .filter_map(|(set, shear)| Some((*set, (*shear)?)))
            .collect();
        if shears.is_empty() {
            return Ok(None);
        }
        if let Some((set, _)) = all.iter().find(|(_, shear)| shear.is_none()) {
            return Err(format!(
                "the true shear is constant in {} of {} sets and varies in set {set}; expected one kind of sets",
                shears.len(),
                all.len()
            ));
        }
        for k in 0..2 {
            let mut values: Vec<f64> = shears.values().map(|shear| shear[k]).collect();
            values.sort_by(f64::total_cmp);
            values.dedup();
            if values.len() < MIN_SETS {
                return Err(format!(
                    "constant shears need at least {MIN_SETS} sets with different g{} to separate m from c (found {})",
                    k + 1,
                    values.len()
                ));
            }
        }
        Ok(Some(ConstantShears(shears)))
    }

    /// m and c of component `k` (0 or 1): least squares of ⟨e⟩ − g = m·g + c over the sets, unweighted as in GREAT3. Errors
    /// are those of the scatter of galaxies, or of the residuals if these are larger.
    pub fn bias(&self, sets: &[SetRecord], k: usize) -> (Measured, Measured) {
        let (mut points, mut errors) = (Vec::new(), Vec::new());
        for set in sets {
            if let Some(g) = self.0.get(&set.set) {
                let of = |metrics: &shearq_scoring::Metrics| [metrics.c1, metrics.c2][k];
                points.push((g[k], of(&set.metrics)));
                errors.push(of(&set.errors));
            }
        }
        let line = Line::through(&points);
        let error = |which: usize| {
            let each = points.iter().zip(&errors);
            let derivative = |g: f64| line.derivatives(g)[which];
            let scatter = each.map(|((g, _), error)| (derivative(*g) * error).powi(2));
            let fit = points.iter().map(|(g, _)| derivative(*g).powi(2));
            let (scatter, fit) = (scatter.sum::<f64>(), line.variance() * fit.sum::<f64>());
            // Galaxies that are shrunk towards their mean scatter less, but the means of the sets do not. An unknown scatter stays
            // unknown.
            if fit > scatter {
                fit.sqrt()
            } else {
                scatter.sqrt()
            }
        };
        ((line.slope, error(1)), (line.intercept, error(0)))
    }

    pub fn biases(&self, sets: &[SetRecord]) -> [(Measured, Measured); 2] {
        [self.bias(sets, 0), self.bias(sets, 1)]
    }

    /// GREAT3's Q_c (Mandelbaum et al. 2014, ApJS 212, 5) with σ² = 4 of its ground branches, and its error to first order.
    /// Components are those of the pixel axes; GREAT3 turns them to the PSF, which leaves the part of c as it is.
    pub fn q_c(&self, sets: &[SetRecord]) -> Measured {
        let biases = self.biases(sets);
        let q = |biases| Observation::Ground.q_c(biases);
        let best = q(biases.map(|(m, c)| [c.0, m.0]));
        // ∂Q/∂b = −Q³b/(Q₀·requirement)² for each bias b, Q₀ being Q times the root.
        let perfect = q([[0.0; 2]; 2]);
        let variance: f64 = biases
            .iter()
            .flat_map(|(m, c)| [(m, REQUIRED_M), (c, REQUIRED_C)])
            .map(|((value, error), required)| (value * error / (required * required)).powi(2))
            .sum();
        (
            best,
            best.powi(3) / (4.0 * perfect * perfect) * variance.sqrt(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use shearq_scoring::Metrics;

    fn shear(g1: f64, g2: f64) -> TrueShear {
        let all = |g| Array2::from_elem((8, 8), g);
        TrueShear {
            g1: all(g1),
            g2: all(g2),
        }
    }

    // Three shears of both signs.
    const SHEARS: [[f64; 2]; 3] = [[0.02, -0.01], [-0.03, 0.01], [0.04, 0.03]];

    fn shears() -> ConstantShears {
        let truths = SHEARS.map(|[g1, g2]| shear(g1, g2));
        ConstantShears::of((1..).zip(&truths)).unwrap().unwrap()
    }

    // Sets with the biases m and c, and errors of 10⁻⁴ of each mean.
    fn sets(m: [f64; 2], c: [f64; 2]) -> Vec<SetRecord> {
        let set = |(number, g): (u32, [f64; 2])| {
            let (mut metrics, mut errors) = (Metrics::unknown(), Metrics::unknown());
            metrics.c1 = m[0] * g[0] + c[0];
            metrics.c2 = m[1] * g[1] + c[1];
            (errors.c1, errors.c2) = (1e-4, 1e-4);
            SetRecord {
                metrics,
                errors,
                ..crate::ranking::tests::record(number, 0.0, &[])
            }
        };
        (1..).zip(SHEARS).map(set).collect()
    }

    #[test]
    fn m_c_and_q_c_are_those_of_the_shears() {
        let found = shears().biases(&sets([0.01, -0.02], [3e-4, 0.0]));
        for ((m, c), expected) in found.iter().zip([(0.01, 3e-4), (-0.02, 0.0)]) {
            assert!((m.0 - expected.0).abs() < 1e-12 && (c.0 - expected.1).abs() < 1e-14);
        }
        // Σ(g − ⟨g⟩)² of 0.02, −0.03, 0.04 is 0.0026, and ⟨g⟩ = 0.01.
        let (m, c) = found[0];
        assert!((m.1 - 1e-4 / 0.0026f64.sqrt()).abs() < 1e-12, "{m:?}");
        let expected = 1e-4 * (1.0 / 3.0 + 1e-4 / 0.0026f64).sqrt();
        assert!((c.1 - expected).abs() < 1e-12, "{c:?}");
        // No submission can pass 1232; zero shear has m = −1: 2464/√(2·500² + 4).
        assert!((shears().q_c(&sets([0.0; 2], [0.0; 2])).0 - 1232.0).abs() < 1e-9);
        let zero = shears().q_c(&sets([-1.0; 2], [0.0; 2])).0;
        assert!((zero - 2464.0 / 500_004f64.sqrt()).abs() < 1e-9, "{zero}");
    }

    #[test]
    fn small_scatter_of_galaxies_does_not_forge_errors() {
        // Residuals that are orthogonal to 1 and g change neither m nor c.
        let g: Vec<f64> = SHEARS.iter().map(|shear| shear[0]).collect();
        let apart = [g[1] - g[2], g[2] - g[0], g[0] - g[1]].map(|r| 0.01 * r);
        let mut sets = sets([0.01, 0.0], [0.0, 0.0]);
        for (set, apart) in sets.iter_mut().zip(apart) {
            set.metrics.c1 += apart;
            set.errors.c1 *= 0.02;
        }
        let (m, c) = shears().bias(&sets, 0);
        assert!((m.0 - 0.01).abs() < 1e-12 && c.0.abs() < 1e-14);
        // One degree of freedom; Σ(g − ⟨g⟩)² = 0.0026.
        let residual = apart.iter().map(|r| r * r).sum::<f64>().sqrt();
        assert!((m.1 - residual / 0.0026f64.sqrt()).abs() < 1e-12, "{m:?}");
        let expected = residual * (1.0 / 3.0 + 1e-4 / 0.0026f64).sqrt();
        assert!((c.1 - expected).abs() < 1e-12, "{c:?}");
    }

    #[test]
    fn shears_that_do_not_separate_m_from_c_are_refused() {
        let refused = |truths: &[TrueShear]| ConstantShears::of((1..).zip(truths)).unwrap_err();
        let one = refused(&[shear(0.02, -0.01)]);
        assert!(one.contains("at least 3 sets with different g1"), "{one}");
        let same = refused(&[shear(0.02, 0.0), shear(0.01, 0.0), shear(0.03, 0.0)]);
        assert!(
            same.contains("different g2 to separate m from c (found 1)"),
            "{same}"
        );
        let mut varies = shear(0.02, 0.01);
        varies.g1[(0, 0)] = 0.0;
        let mixed = refused(&[shear(0.02, -0.01), varies.clone()]);
        assert!(
            mixed.contains("constant in 1 of 2 sets and varies in set 2"),
            "{mixed}"
        );
        assert_eq!(ConstantShears::of([(1, &varies)]), Ok(None));
    }
}
