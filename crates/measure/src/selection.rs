//! Selections and weights by S/N, flux and size that keep the shear calibrated.
//!
//! With a weight w(F, S) of flux and size, the mean of f = w e responds to a shear of the galaxies by
//!
//! ```text
//! ⟨∂f/∂γ⟩ = ⟨w R + e (w_F F′ + w_S S′)⟩ − ⟨tr(D C f″)⟩,
//! ```
//!
//! where the primes are derivatives with shear of the image with its noise, and the last term takes out that they shear the noise:
//! for Gaussian noise n of covariance C, changed by D n, Stein's lemma gives ⟨∇f·D n⟩ = ⟨tr(D C f″)⟩, to all orders. Its products
//! of changes with noise are in [`Coupling`]. In the same way, half of the trace with the difference to noise behind a PSF
//! turned by 90 degrees takes out of ⟨f⟩ what noise with the shape of the PSF adds to it.
//!
//! Both terms need second derivatives of w, so that cuts are smooth steps. A sharp cut would give each of them the
//! density of galaxies at the edge, with an infinite scatter.
//!
//! # Sheared catalogues
//!
//! Users may also select from catalogues of the galaxies as they would be measured under small shears. The values X of a galaxy
//! (ellipticity, flux, size) change to X ± hX′ if its image is sheared by ±h. This shears the
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

use std::fmt;
use std::ops::Mul;
use std::sync::Arc;

use shearq_quantities::jet::{Jet, step};
use shearq_quantities::linear::cholesky;

use crate::measurement::{
    Coupling, FLUX, Observables, RING, ResponseMatrix, SIZE, ShearedGalaxy, VARIABLES, isotropic,
};
use crate::spectral::NoiseChanges;

// In standard deviations of the S/N, which are 1. Chosen by hand.
const SNR_HALF_WIDTH: f64 = 1.5;
// In px. At S/N 20 the standard deviation of the size is 0.40 px, and half widths of 0.25, 0.5 and 1 standard deviation give
// errors of m of 2.4, 1.8 and 1.4 (10⁻³) for 64,000 measurements.
const SIZE_HALF_WIDTH: f64 = 0.3;
// Chosen by hand: the noise of the light of the ring is 0.12 of the flux at S/N 20.
const NEIGHBOUR_HALF_WIDTH: f64 = 0.15;
// Chosen by hand: one galaxy of some thousands lies within a step of 0.015 in S/N, and the error of the response is its own size.
const MIN_WIDTH_RATIO: f64 = 0.01;

/// A quantity that galaxies can be selected by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Quantity {
    /// Flux over its error.
    Snr,
    /// [`Observables::flux`].
    Flux,
    /// [`Observables::size`].
    Size,
    /// [`Observables::neighbour`].
    Neighbour,
}

impl Quantity {
    /// All, with the names of their columns.
    pub const ALL: [(&str, Quantity); 4] = [
        ("snr", Quantity::Snr),
        ("flux", Quantity::Flux),
        ("size", Quantity::Size),
        ("neighbour", Quantity::Neighbour),
    ];
}

/// A cut: a smooth step from weight 0 to 1 (above) or 1 to 0 (below).
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Cut {
    /// What is cut.
    pub quantity: Quantity,
    /// Whether values above the threshold are kept.
    pub above: bool,
    /// Where the weight is one half.
    pub threshold: f64,
    /// Distance from the threshold at which the weight is 0 or 1. `None`: 1.5 for S/N, 1.5 errors for the flux, 0.3 px for the size, 0.15 for
    /// neighbours.
    pub half_width: Option<f64>,
}

/// Cuts and a weight, which are multiplied.
#[derive(Clone, Default)]
pub struct Selection {
    cuts: Vec<Cut>,
    weight: Option<Weight>,
}

/// A smooth weight of S/N, flux and size.
type Weight = Arc<dyn Fn(f64, f64, f64) -> f64 + Send + Sync>;

impl fmt::Debug for Selection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Selection")
            .field("cuts", &self.cuts)
            .field("weight", &self.weight.is_some())
            .finish()
    }
}

/// A weighted ellipticity with its response. Means of many divide by each other; weights are in both.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
pub struct Selected {
    /// Weighted ellipticity, before calibration.
    pub e: [f64; 2],
    /// Its response to shear, in the mean over orientations of the galaxy.
    pub response: ResponseMatrix,
    /// The weight; zero for galaxies that are cut.
    pub weight: f64,
}

impl Quantity {
    /// The half width of a step without a stated one, of a galaxy with this error of its flux.
    fn usual_half_width(self, flux_error: f64) -> f64 {
        match self {
            Quantity::Snr => SNR_HALF_WIDTH,
            Quantity::Flux => SNR_HALF_WIDTH * flux_error,
            Quantity::Size => SIZE_HALF_WIDTH,
            Quantity::Neighbour => NEIGHBOUR_HALF_WIDTH,
        }
    }
}

impl Cut {
    /// The least useful half width for a galaxy with this error of its flux. A narrower step is a sharp cut: its response to shear is
    /// the number of galaxies within it, divided by its width, and hardly any lies within it.
    pub fn least_half_width(&self, flux_error: f64) -> f64 {
        MIN_WIDTH_RATIO * self.quantity.usual_half_width(flux_error)
    }

    /// A cut; `None` if the threshold is not finite or the half width not positive.
    pub fn new(
        quantity: Quantity,
        above: bool,
        threshold: f64,
        half_width: Option<f64>,
    ) -> Option<Self> {
        let usable = threshold.is_finite() && half_width.is_none_or(|width| width > 0.0);
        usable.then_some(Cut {
            quantity,
            above,
            threshold,
            half_width,
        })
    }
}

impl Selection {
    /// Adds a cut.
    #[must_use]
    pub fn with_cut(mut self, cut: Cut) -> Self {
        self.cuts.push(cut);
        self
    }

    /// Adds a weight: a function of S/N, flux and size that is smooth on the scale of their noise. Derivatives are taken
    /// numerically.
    #[must_use]
    pub fn with_weight(
        mut self,
        weight: impl Fn(f64, f64, f64) -> f64 + Send + Sync + 'static,
    ) -> Self {
        self.weight = Some(Arc::new(weight));
        self
    }

    /// The cuts.
    pub fn cuts(&self) -> &[Cut] {
        &self.cuts
    }

    /// The weighted ellipticity and response of a galaxy with the ellipticity `e` and the `response` before calibration.
    pub fn apply(&self, e: [f64; 2], response: ResponseMatrix, galaxy: &Observables) -> Selected {
        let w = self.jet(galaxy);
        if w.value == 0.0 && w.first == [0.0; VARIABLES] {
            return Selected::default();
        }
        let Coupling {
            sheared_e,
            sheared,
            turned_e,
            turned,
            turned_size,
        } = galaxy.coupling;
        // Σ w_a x_a, and Σ w_ab C_ab.
        let along = |values: [f64; VARIABLES]| -> f64 {
            w.first.iter().zip(values).map(|(w, value)| w * value).sum()
        };
        let curved = |products: [[f64; VARIABLES]; VARIABLES]| -> f64 {
            let pairs = w.second.as_flattened().iter().zip(products.as_flattened());
            pairs.map(|(w, product)| w * product).sum()
        };
        let turned_weight = curved(turned) + w.first[SIZE] * turned_size;
        let mut selected = Selected {
            weight: w.value,
            ..Selected::default()
        };
        let mut trace = 0.0;
        for k in 0..2 {
            selected.e[k] = w.value * e[k] + along(turned_e[k]) + 0.5 * e[k] * turned_weight;
            let responses = [
                galaxy.flux_response[k],
                galaxy.size_response[k],
                galaxy.ring_response[k],
            ];
            trace += w.value * response[k][k] + e[k] * along(responses)
                - 2.0 * along(sheared_e[k])
                - e[k] * curved(sheared[k]);
        }
        selected.response = isotropic(trace);
        selected
    }

    fn jet(&self, galaxy: &Observables) -> Jet<VARIABLES> {
        let cuts = self.cuts.iter().map(|cut| cut.jet(galaxy));
        let weight = self
            .weight
            .iter()
            .map(|weight| numerical(&**weight, galaxy));
        cuts.chain(weight).fold(Jet::constant(1.0), Jet::mul)
    }
}

impl Cut {
    /// The step from 0 to 1, or from 1 to 0.
    fn jet(&self, galaxy: &Observables) -> Jet<VARIABLES> {
        let (flux, error) = (galaxy.flux, galaxy.flux_error);
        let place = match self.quantity {
            Quantity::Snr => Jet::variable(FLUX, flux) * (1.0 / error),
            Quantity::Flux => Jet::variable(FLUX, flux),
            Quantity::Size => Jet::variable(SIZE, galaxy.size),
            Quantity::Neighbour => Jet::variable(RING, galaxy.ring) / Jet::variable(FLUX, flux),
        };
        let usual = self.quantity.usual_half_width(error);
        let sign = if self.above { 1.0 } else { -1.0 };
        // Without a flux and its noise the S/N is NaN, and passes no cut.
        let t = (place + -self.threshold) * (sign / self.half_width.unwrap_or(usual));
        t.map(step(t.value))
    }
}

/// A weight and its derivatives by differences.
fn numerical(weight: &dyn Fn(f64, f64, f64) -> f64, galaxy: &Observables) -> Jet<VARIABLES> {
    // Steps of the flux in its errors, and of the size in px: rounding of second differences is then 10⁻¹⁰ of the weight.
    const STEP: f64 = 1e-3;
    let steps = [STEP * galaxy.flux_error, STEP];
    let at = |i: i32, j: i32| {
        let flux = galaxy.flux + f64::from(i) * steps[0];
        let size = galaxy.size + f64::from(j) * steps[1];
        weight(flux / galaxy.flux_error, flux, size)
    };
    let middle = at(0, 0);
    let [[fp, fm], [sp, sm]] = [[at(1, 0), at(-1, 0)], [at(0, 1), at(0, -1)]];
    let cross = at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1);
    let cross = cross / (4.0 * steps[0] * steps[1]);
    Jet {
        value: middle,
        first: [
            (fp - fm) / (2.0 * steps[0]),
            (sp - sm) / (2.0 * steps[1]),
            0.0,
        ],
        second: [
            [(fp - 2.0 * middle + fm) / (steps[0] * steps[0]), cross, 0.0],
            [cross, (sp - 2.0 * middle + sm) / (steps[1] * steps[1]), 0.0],
            [0.0; VARIABLES],
        ],
    }
}

// e1, e2, flux and size.
const VALUES: usize = 4;

/// A symmetric matrix of all values.
pub(crate) type Matrix = [[f64; VALUES]; VALUES];

// Of the noise. Against the rounding of covariances, which is 10⁻⁵ of them.
const MARGIN: f64 = 1e-3;
// The added share of the noise is then at most 1/256 of its bound too large.
const BISECTIONS: usize = 8;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ShearSettings {
    pub(crate) step: f64,
    /// Gaussian numbers from the pixels of the galaxy.
    pub(crate) normals: [f64; 4],
}

/// The galaxy in each catalogue, from its values, their derivatives with γ1 and γ2, and the mean products of their changes by
/// noise: the covariance C, K for γ1 and for γ2, and T. `None` if the products are not products of noise.
pub(crate) fn sheared(
    values: [f64; VALUES],
    derivatives: [[f64; VALUES]; 2],
    products: &NoiseChanges<Matrix>,
    settings: &ShearSettings,
) -> Option<[ShearedGalaxy; 5]> {
    let &ShearSettings { step, normals } = settings;
    let NoiseChanges {
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
    use crate::testing::close;

    fn galaxy() -> Observables {
        Observables {
            flux: 30.0,
            flux_error: 2.0,
            size: 2.5,
            flux_response: [3.0, -1.0],
            size_response: [0.2, 0.4],
            ring: 9.0,
            ring_response: [0.5, -0.3],
            coupling: Coupling {
                sheared_e: [[0.1, 0.2, 0.1], [0.6, 0.7, 0.5]],
                sheared: [
                    [[0.3, 0.4, 0.2], [0.4, 0.5, 0.3], [0.2, 0.3, 0.4]],
                    [[0.8, 0.9, 0.6], [0.9, 1.0, 0.7], [0.6, 0.7, 0.8]],
                ],
                turned_e: [[0.1, -0.2, 0.1], [0.3, -0.4, -0.2]],
                turned: [[0.5, 0.6, 0.3], [0.6, -0.7, -0.4], [0.3, -0.4, 0.5]],
                turned_size: 0.8,
            },
        }
    }

    const RESPONSE: ResponseMatrix = [[0.4, 9.0], [9.0, 0.3]];

    fn cuts(all: &[(Quantity, bool, f64, Option<f64>)]) -> Selection {
        let add = |selection: Selection, (quantity, above, at, width): &(_, _, _, _)| {
            selection.with_cut(Cut::new(*quantity, *above, *at, *width).unwrap())
        };
        all.iter().fold(Selection::default(), add)
    }

    #[test]
    fn cuts_without_a_place_or_a_width_are_refused() {
        for (threshold, width) in [(f64::NAN, None), (10.0, Some(0.0)), (10.0, Some(f64::NAN))] {
            assert_eq!(Cut::new(Quantity::Snr, true, threshold, width), None);
        }
    }

    #[test]
    fn products_of_steps_have_the_derivatives_of_differences() {
        let selection = cuts(&[
            (Quantity::Snr, true, 14.2, None),
            (Quantity::Size, true, 2.4, Some(0.4)),
            (Quantity::Flux, false, 31.0, Some(4.0)),
            (Quantity::Neighbour, false, 0.31, None),
        ]);
        let jet = selection.jet(&galaxy());
        assert!(jet.value > 0.01 && jet.value < 0.9);
        const STEP: f64 = 1e-4;
        for a in [FLUX, SIZE, RING] {
            let [plus, minus] = [STEP, -STEP].map(|step| {
                let mut moved = galaxy();
                *[&mut moved.flux, &mut moved.size, &mut moved.ring][a] += step;
                selection.jet(&moved)
            });
            let slope = |plus: f64, minus: f64| (plus - minus) / (2.0 * STEP);
            // Truncation of differences.
            close(slope(plus.value, minus.value), jet.first[a], 1e-6);
            for b in [FLUX, SIZE, RING] {
                close(slope(plus.first[b], minus.first[b]), jet.second[a][b], 1e-5);
            }
        }
    }

    #[test]
    fn galaxies_away_from_the_step_keep_their_ellipticity_or_vanish() {
        let e = [0.1, -0.2];
        let all = cuts(&[(Quantity::Snr, true, 5.0, None)]);
        let kept = all.apply(e, RESPONSE, &galaxy());
        assert_eq!((kept.e, kept.weight), (e, 1.0));
        assert_eq!(kept.response, isotropic(0.4 + 0.3));
        let none = cuts(&[(Quantity::Snr, false, 5.0, None)]);
        assert_eq!(none.apply(e, RESPONSE, &galaxy()), Selected::default());
    }

    #[test]
    fn terms_of_a_weight_follow_the_equation_of_the_module() {
        // w = F S²/100: w_F = S²/100, w_S = F S/50, w_FF = 0, w_FS = S/50, w_SS = F/50.
        let weighted = Selection::default().with_weight(|_, flux, size| flux * size * size / 100.0);
        let e = [0.1, -0.2];
        let found = weighted.apply(e, RESPONSE, &galaxy());
        let (w, w_f, w_s, w_fs, w_ss) = (1.875, 0.0625, 1.5, 0.05, 0.6);
        let first = w * 0.4 + 0.1 * (w_f * 3.0 + w_s * 0.2)
            - 2.0 * (w_f * 0.1 + w_s * 0.2)
            - 0.1 * (2.0 * w_fs * 0.4 + w_ss * 0.5);
        let second = w * 0.3 - 0.2 * (-w_f + w_s * 0.4) - 2.0 * (w_f * 0.6 + w_s * 0.7)
            + 0.2 * (2.0 * w_fs * 0.9 + w_ss * 1.0);
        let curved = 2.0 * w_fs * 0.6 - w_ss * 0.7 + w_s * 0.8;
        let e1 = w * 0.1 + w_f * 0.1 - w_s * 0.2 + 0.5 * 0.1 * curved;
        let e2 = -w * 0.2 + w_f * 0.3 - w_s * 0.4 - 0.5 * 0.2 * curved;
        // Rounding of second differences.
        close(found.response[0][0], 0.5 * (first + second), 1e-6);
        assert_eq!(found.response, isotropic(2.0 * found.response[0][0]));
        close(found.e[0], e1, 1e-6);
        close(found.e[1], e2, 1e-6);
    }

    fn symmetric(lower: [[f64; 4]; 4]) -> Matrix {
        std::array::from_fn(|a| std::array::from_fn(|b| lower[a.max(b)][a.min(b)]))
    }

    fn products() -> NoiseChanges<Matrix> {
        NoiseChanges {
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
            &NoiseChanges::default(),
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
