//! Sheared catalogues: galaxies as they would be measured under small shears, for selections by the user.
//!
//! The values X of a galaxy (ellipticity, flux, size) change to X ± hX′ if its image is sheared by ±h. This shears the
//! noise, too. For noise n of covariance C that changes by D n, the mean of any smooth function φ(X) then changes by
//!
//! ```text
//! h ⟨∇φ(X)·D n⟩ = h ⟨φ_a tr(D C X_a″) + φ_ab K_ab⟩,   K_ab = ∇X_a·D C ∇X_b
//! ```
//!
//! (Stein's lemma). The responses X′ are already corrected for the first term. Gaussian noise of covariance ∓2hK, added to
//! X, removes the second one. A covariance cannot be negative, so a small share of C is added in all catalogues, without
//! its couplings of the ellipticity to flux and size. In the same way, noise of covariance T removes the effect of noise that has
//! the shape of the PSF. For each mode, T is the geometric mean of the power behind the PSF and the power behind a PSF turned
//! by 90 degrees, minus the former.
//!
//! The difference of the means of catalogues 1p and 1m, divided by 2h, is then the response to γ1 for any selection by the
//! values of each catalogue.

use shearq_quantities::linear::cholesky;

// e1, e2, flux and size.
const VALUES: usize = 4;
/// A symmetric matrix of all values.
type Matrix = [[f64; VALUES]; VALUES];

// Of the noise. Against the rounding of covariances, which is 10⁻⁵ of them.
const MARGIN: f64 = 1e-3;
// The added share of the noise is then at most 1/256 of its bound too large.
const BISECTIONS: usize = 8;

/// The values of a galaxy in one catalogue.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ShearedGalaxy {
    /// First component of the ellipticity.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
    /// As [`Observables::flux`](crate::Observables::flux).
    pub flux: f64,
    /// As [`Observables::size`](crate::Observables::size).
    pub size: f64,
}

/// A galaxy without shear, under γ1 = ±h and under γ2 = ±h, in the order of [`ShearedCatalogues::NAMES`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ShearedCatalogues {
    /// The galaxy in each catalogue.
    pub each: [ShearedGalaxy; 5],
    /// Standard deviation of the flux in each catalogue.
    pub flux_error: f64,
}

impl ShearedCatalogues {
    /// Names of the catalogues.
    pub const NAMES: [&'static str; 5] = ["noshear", "1p", "1m", "2p", "2m"];

    /// Names of the values in each catalogue.
    pub const QUANTITIES: [&'static str; 5] = ["e1", "e2", "snr", "flux", "size"];

    /// The names of all columns, catalogue by catalogue: `e1_noshear`, `e2_noshear`, …
    pub fn columns() -> impl Iterator<Item = String> {
        let columns = |name| Self::QUANTITIES.map(|quantity| format!("{quantity}_{name}"));
        Self::NAMES.into_iter().flat_map(columns)
    }

    /// The values in a catalogue, in the order of [`ShearedCatalogues::QUANTITIES`].
    pub fn values(&self, catalogue: usize) -> [f64; 5] {
        let ShearedGalaxy { e1, e2, flux, size } = self.each[catalogue];
        [e1, e2, flux / self.flux_error, flux, size]
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ShearSettings {
    pub(crate) step: f64,
    /// Gaussian numbers from the pixels of the galaxy.
    pub(crate) normals: [f64; 4],
}

/// Mean products of the changes of the values by noise.
pub(crate) struct NoiseProducts {
    /// Covariance C of the noise of the values.
    pub(crate) plain: Matrix,
    /// K for γ1 and for γ2.
    pub(crate) sheared: [Matrix; 2],
    /// T.
    pub(crate) turned: Matrix,
}

impl NoiseProducts {
    pub(crate) const NONE: NoiseProducts = NoiseProducts {
        plain: [[0.0; VALUES]; VALUES],
        sheared: [[[0.0; VALUES]; VALUES]; 2],
        turned: [[0.0; VALUES]; VALUES],
    };
}

/// The galaxy in each catalogue, from its values, their derivatives with γ1 and γ2, and its noise. `None` if the products
/// are not products of noise.
pub(crate) fn sheared(
    values: [f64; VALUES],
    derivatives: [[f64; VALUES]; 2],
    products: &NoiseProducts,
    settings: &ShearSettings,
) -> Option<[ShearedGalaxy; 5]> {
    let &ShearSettings { step, normals } = settings;
    let NoiseProducts {
        plain,
        sheared,
        turned,
    } = products;
    let added = round(plain);
    let covariance = |share: f64, along: [f64; 2]| -> Matrix {
        std::array::from_fn(|a| {
            std::array::from_fn(|b| {
                let of_shear = along[0] * sheared[0][a][b] + along[1] * sheared[1][a][b];
                share * added[a][b] + turned[a][b] - 2.0 * of_shear
            })
        })
    };
    let shears = [
        [0.0; 2],
        [step, 0.0],
        [-step, 0.0],
        [0.0, step],
        [0.0, -step],
    ];
    let silent = plain.iter().flatten().all(|value| *value == 0.0);
    let share = if silent {
        0.0
    } else {
        let root_of_added = root(&added)?;
        let norm = |matrix: &Matrix| whitened_norm(matrix, &root_of_added);
        let most = norm(turned) + 2.0 * step * norm(&sheared[0]).max(norm(&sheared[1])) + MARGIN;
        let enough = |share: f64| {
            shears
                .iter()
                .all(|along| root(&covariance(share, *along)).is_some())
        };
        let (mut low, mut high) = (0.0, most);
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (low + high);
            *(if enough(middle) { &mut high } else { &mut low }) = middle;
        }
        high
    };
    let galaxy = |along: [f64; 2]| -> Option<ShearedGalaxy> {
        let root = if silent {
            [[0.0; VALUES]; VALUES]
        } else {
            root(&covariance(share, along))?
        };
        let [e1, e2, flux, size] = std::array::from_fn(|a| {
            let added: f64 = (0..=a).map(|k| root[a][k] * normals[k]).sum();
            let changed = along[0] * derivatives[0][a] + along[1] * derivatives[1][a];
            values[a] + changed + added
        });
        Some(ShearedGalaxy { e1, e2, flux, size })
    };
    let [plain, first_plus, first_minus, second_plus, second_minus] = shears.map(galaxy);
    Some([
        plain?,
        first_plus?,
        first_minus?,
        second_plus?,
        second_minus?,
    ])
}

/// Noise of the size of `covariance` that does not depend on the direction of the galaxy: couplings of the ellipticity to
/// flux and size would change with shear, and the added noise must not.
fn round(covariance: &Matrix) -> Matrix {
    let mut round = [[0.0; VALUES]; VALUES];
    let mean = 0.5 * (covariance[0][0] + covariance[1][1]);
    (round[0][0], round[1][1]) = (mean, mean);
    for a in 2..VALUES {
        for b in 2..VALUES {
            round[a][b] = covariance[a][b];
        }
    }
    round
}

/// The lower triangle L of LLᵀ = `matrix`; `None` if it is not positive.
fn root(matrix: &Matrix) -> Option<Matrix> {
    let mut root = *matrix;
    let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
    cholesky(&mut root, &mut [0.0; VALUES], VALUES, positive)?;
    for (a, row) in root.iter_mut().enumerate() {
        row[a + 1..].fill(0.0);
    }
    Some(root)
}

/// The root of the sum of squares of L⁻¹ M L⁻ᵀ, no less than the modulus of its eigenvalues.
fn whitened_norm(matrix: &Matrix, root: &Matrix) -> f64 {
    // L⁻¹ of each column, transposed; twice, because the matrix is symmetric.
    let solved = |matrix: &Matrix| -> Matrix {
        let mut out = [[0.0; VALUES]; VALUES];
        for column in 0..VALUES {
            for a in 0..VALUES {
                let known: f64 = (0..a).map(|k| root[a][k] * out[column][k]).sum();
                out[column][a] = (matrix[a][column] - known) / root[a][a];
            }
        }
        out
    };
    let whitened = solved(&solved(matrix));
    let squares = whitened.iter().flatten().map(|value| value * value);
    squares.sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    fn symmetric(lower: [[f64; 4]; 4]) -> Matrix {
        std::array::from_fn(|a| std::array::from_fn(|b| lower[a.max(b)][a.min(b)]))
    }

    fn products() -> NoiseProducts {
        NoiseProducts {
            plain: symmetric([
                [0.09, 0.0, 0.0, 0.0],
                [0.01, 0.08, 0.0, 0.0],
                [0.1, -0.05, 4.0, 0.0],
                [0.02, 0.01, 0.3, 0.12],
            ]),
            sheared: [
                symmetric([
                    [0.03, 0.0, 0.0, 0.0],
                    [0.0, -0.02, 0.0, 0.0],
                    [0.2, 0.0, 0.1, 0.0],
                    [0.08, 0.0, 0.2, -0.05],
                ]),
                symmetric([
                    [0.0, 0.0, 0.0, 0.0],
                    [0.02, 0.01, 0.0, 0.0],
                    [0.0, 0.3, -0.2, 0.0],
                    [0.0, 0.06, 0.1, 0.04],
                ]),
            ],
            turned: symmetric([
                [0.002, 0.0, 0.0, 0.0],
                [0.001, -0.003, 0.0, 0.0],
                [0.01, 0.02, 0.1, 0.0],
                [-0.002, 0.001, 0.03, 0.002],
            ]),
        }
    }

    #[test]
    fn catalogues_scatter_by_the_products_of_noise() {
        let products = products();
        let values = [0.1, -0.2, 30.0, 2.5];
        let derivatives = [[0.9, 0.05, 3.0, 0.4], [-0.02, 0.8, 1.0, 0.2]];
        let step = 0.01;
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let count = 200_000;
        let mut sums = [[0.0; 4]; 5];
        let mut squares = [[[0.0; 4]; 4]; 5];
        for _ in 0..count {
            let normals = [0; 4].map(|_| StandardNormal.sample(&mut rng));
            let settings = ShearSettings { step, normals };
            let found = sheared(values, derivatives, &products, &settings).unwrap();
            for (catalogue, ShearedGalaxy { e1, e2, flux, size }) in found.into_iter().enumerate() {
                let x = [e1, e2, flux, size];
                for a in 0..4 {
                    sums[catalogue][a] += x[a] - values[a];
                    for b in 0..4 {
                        squares[catalogue][a][b] += (x[a] - values[a]) * (x[b] - values[b]);
                    }
                }
            }
        }
        let count = f64::from(count);
        let along = [
            [0.0, 0.0],
            [step, 0.0],
            [-step, 0.0],
            [0.0, step],
            [0.0, -step],
        ];
        let covariance = |catalogue: usize, a: usize, b: usize| {
            squares[catalogue][a][b] / count
                - sums[catalogue][a] * sums[catalogue][b] / count / count
        };
        for a in 0..4 {
            for catalogue in 0..5 {
                let expected = along[catalogue][0] * derivatives[0][a]
                    + along[catalogue][1] * derivatives[1][a];
                let error = (covariance(catalogue, a, a) / count).sqrt();
                let found = sums[catalogue][a] / count;
                assert!(
                    (found - expected).abs() < 4.0 * error,
                    "{catalogue} {a}: {found} {expected}"
                );
            }
            for b in 0..4 {
                let scale = (covariance(0, a, a) * covariance(0, b, b)).sqrt();
                // All catalogues have the same normals, so that their difference scatters much less than each.
                let error = 4.0 * scale * (2.0 / count).sqrt();
                for (k, [plus, minus]) in [[1, 2], [3, 4]].into_iter().enumerate() {
                    let difference = covariance(plus, a, b) - covariance(minus, a, b);
                    let expected = -4.0 * step * products.sheared[k][a][b];
                    assert!(
                        (difference - expected).abs() < error,
                        "{k} {a} {b}: {difference} {expected}"
                    );
                    let mean = 0.5 * (covariance(plus, a, b) + covariance(minus, a, b));
                    assert!((mean - covariance(0, a, b)).abs() < error);
                }
            }
        }
        // Apart from T, a share of the galaxy's own noise was added.
        let share = (covariance(0, 3, 3) - products.turned[3][3]) / products.plain[3][3];
        assert!(share > 0.0 && share < 0.5, "{share}");
        for a in 0..4 {
            for b in 0..4 {
                let expected = share * round(&products.plain)[a][b] + products.turned[a][b];
                let scale = (covariance(0, a, a) * covariance(0, b, b)).sqrt();
                let error = 6.0 * scale * (2.0 / count).sqrt();
                assert!((covariance(0, a, b) - expected).abs() < error, "{a} {b}");
            }
        }
    }

    #[test]
    fn without_noise_catalogues_are_exact() {
        let derivatives = [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]];
        let settings = |step: f64, normal: f64| ShearSettings {
            step,
            normals: [normal; 4],
        };
        let found = sheared(
            [0.0; 4],
            derivatives,
            &NoiseProducts::NONE,
            &settings(0.5, 9.0),
        )
        .unwrap();
        let expected = |e1, e2, flux, size| ShearedGalaxy { e1, e2, flux, size };
        assert_eq!(found[0], expected(0.0, 0.0, 0.0, 0.0));
        assert_eq!(found[1], expected(0.5, 1.0, 1.5, 2.0));
        assert_eq!(found[4], expected(-2.5, -3.0, -3.5, -4.0));
        let mut bad = products();
        bad.plain[2][2] = -1.0;
        assert_eq!(
            sheared([0.0; 4], derivatives, &bad, &settings(0.01, 0.0)),
            None
        );
        bad.plain[2][2] = f64::NAN;
        assert_eq!(
            sheared([0.0; 4], derivatives, &bad, &settings(0.01, 0.0)),
            None
        );
    }

    #[test]
    fn the_norm_bounds_the_eigenvalues() {
        let root = root(&products().plain).unwrap();
        // Of C itself, whitened, all four eigenvalues are one.
        assert!((whitened_norm(&products().plain, &root) - 2.0).abs() < 1e-12);
        let once = products().sheared[0];
        let twice = once.map(|row| row.map(|value| -2.0 * value));
        let norms = [once, twice].map(|matrix| whitened_norm(&matrix, &root));
        assert!((norms[1] / norms[0] - 2.0).abs() < 1e-12);
    }
}
