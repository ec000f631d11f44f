//! Shear correlations ξ± and the aperture mass dispersion of galaxies on a square lattice, from exact pair sums.
//!
//! All galaxies of a field of GREAT3 lie on one lattice of 700 × 700 nodes, those of GREAT10 on one of 100 × 100. The
//! separation of a pair is then a lag of the lattice, and the sum over all pairs of one lag is a correlation of the field
//! with itself: five Fourier transforms replace the 2·10¹⁰ pairs of 200,000 galaxies, without an approximation.

use std::ops::AddAssign;

use ndarray::{Array2, ArrayView2};
#[cfg(feature = "serde")]
use serde::Serialize;
use shearq_quantities::Shear;
use shearq_quantities::fourier::{Complex64, Plan64, Planner64};
use shearq_quantities::units::Degrees;

use crate::error::ScoringError;
use crate::grid::{Grid, check_shape};

/// Logarithmic bins of separation of GREAT3.
pub const SEPARATION_BINS: usize = 15;
/// Lower edge of the first bin.
pub const MIN_SEPARATION: Degrees = Degrees(0.02);
/// Upper edge of the last bin.
pub const MAX_SEPARATION: Degrees = Degrees(10.0);

// Width of a bin in ln r.
fn bin_width() -> f64 {
    (MAX_SEPARATION.0 / MIN_SEPARATION.0).ln() / SEPARATION_BINS as f64
}

/// Centres of the bins in ln r, and radii of the apertures.
pub fn separations() -> [Degrees; SEPARATION_BINS] {
    std::array::from_fn(|b| Degrees(MIN_SEPARATION.0 * ((b as f64 + 0.5) * bin_width()).exp()))
}

/// A square of `side` × `side` nodes, `field / side` apart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lattice {
    /// Nodes per side.
    pub side: usize,
    /// Side of the field.
    pub field: Degrees,
}

// Radians of a degree. The challenge's program multiplies positions by this number, and rounding decides below.
const DEGREE: f64 = std::f64::consts::PI / 180.0;

// A lag is at the limit of all separations if its r² agrees with the limit's to rounding. Lags of the lattice of GREAT3 that are
// not at the limit differ from it by 1/700² or more.
const AT_LIMIT: f64 = 1e-12;

impl Lattice {
    /// That of a field of GREAT3.
    pub const GREAT3: Lattice = Lattice {
        side: 700,
        field: Degrees(10.0),
    };

    // Squared separation of two nodes in radian², rounded as in the challenge's program.
    fn separation_squared(&self, a: (usize, usize), b: (usize, usize)) -> f64 {
        let place = |k: usize| k as f64 * self.field.0 / self.side as f64 * DEGREE;
        let (x, y) = (place(a.0) - place(b.0), place(a.1) - place(b.1));
        x * x + y * y
    }

    // Pairs at exactly 10°, such as 420 × 560 nodes, are in the last bin if their rounded separation is below it: half of them are,
    // as in the challenge's program. Without them ξ± differs by 10⁻⁷ from its values.
    fn is_within(&self, a: (usize, usize), b: (usize, usize)) -> bool {
        let limit = |of: Degrees| (of.0 * DEGREE).powi(2);
        (limit(MIN_SEPARATION)..limit(MAX_SEPARATION)).contains(&self.separation_squared(a, b))
    }

    fn bin(&self, lag_squared: usize) -> Lag {
        let step = self.field.0 / self.side as f64;
        let r_squared = lag_squared as f64 * step * step;
        let at = |limit: Degrees| (r_squared / (limit.0 * limit.0) - 1.0).abs() < AT_LIMIT;
        if at(MIN_SEPARATION) {
            Lag::Limit(0)
        } else if at(MAX_SEPARATION) {
            Lag::Limit(SEPARATION_BINS - 1)
        } else if r_squared < MIN_SEPARATION.0.powi(2) || r_squared > MAX_SEPARATION.0.powi(2) {
            Lag::Outside
        } else {
            // Inner edges are irrational multiples of the step, so rounding decides nothing.
            Lag::Bin((0.5 * (r_squared / MIN_SEPARATION.0.powi(2)).ln() / bin_width()) as usize)
        }
    }
}

// Where pairs of one lag belong; at a limit each pair is tested by itself.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Lag {
    Outside,
    Bin(usize),
    Limit(usize),
}

/// Shears with weights on the nodes of a lattice. A node without a galaxy has the weight 0.
#[derive(Debug, Clone)]
pub struct LatticeShear {
    lattice: Lattice,
    // Σ w g and Σ w of each node, the number of galaxies in the imaginary part of the latter.
    shear: Array2<Complex64>,
    weight: Array2<Complex64>,
    // Σ w² |g|² and Σ w of all galaxies, for the errors.
    power: f64,
    total: f64,
}

// Sums over pairs.
#[derive(Debug, Clone, Copy, Default)]
struct PairSum {
    pairs: f64,
    weight: f64,
    weighted_r: f64,
    plus: f64,
    minus: f64,
}

impl AddAssign for PairSum {
    fn add_assign(&mut self, other: Self) {
        self.pairs += other.pairs;
        self.weight += other.weight;
        self.weighted_r += other.weighted_r;
        self.plus += other.plus;
        self.minus += other.minus;
    }
}

impl LatticeShear {
    /// No galaxies.
    ///
    /// # Errors
    /// If the lattice has no nodes or more than 2000 per side.
    pub fn new(lattice: Lattice) -> Result<Self, ScoringError> {
        const MAX_SIDE: usize = 2000;
        if !(1..=MAX_SIDE).contains(&lattice.side) {
            return Err(ScoringError::GridSide {
                found: lattice.side,
                min: 1,
                max: MAX_SIDE,
            });
        }
        let zero = Array2::from_elem((lattice.side, lattice.side), Complex64::ZERO);
        Ok(LatticeShear {
            lattice,
            shear: zero.clone(),
            weight: zero,
            power: 0.0,
            total: 0.0,
        })
    }

    /// Adds a galaxy at the 0-based node `(ix, iy)`, x along columns.
    ///
    /// # Errors
    /// If the node is outside the lattice, or a number is not finite.
    pub fn add(&mut self, node: (usize, usize), g: Shear, weight: f64) -> Result<(), ScoringError> {
        let side = self.lattice.side;
        if node.0 >= side || node.1 >= side {
            return Err(ScoringError::OutsideLattice { node, side });
        }
        if !(g.e1.is_finite() && g.e2.is_finite() && weight.is_finite()) {
            return Err(ScoringError::NotFinite("a shear or weight"));
        }
        self.shear[node] += weight * Complex64::new(g.e1, g.e2);
        self.weight[node] += Complex64::new(weight, 1.0);
        self.power += (weight * g.modulus()).powi(2);
        self.total += weight;
        Ok(())
    }

    /// Galaxies at the cells `[ix, iy]` of a grid, where `weights` is not zero.
    ///
    /// # Errors
    /// If the arrays have another shape than the grid, or a number is not finite.
    pub fn on_grid(
        grid: &Grid,
        shear: &Array2<Complex64>,
        weights: ArrayView2<'_, f64>,
    ) -> Result<Self, ScoringError> {
        check_shape("the shear", shear, grid.n)?;
        check_shape("the weights", &weights, grid.n)?;
        let mut galaxies = LatticeShear::new(Lattice {
            side: grid.n,
            field: grid.field,
        })?;
        for ((node, g), &weight) in shear.indexed_iter().zip(weights) {
            if weight != 0.0 {
                galaxies.add(node, Shear::new(g.re, g.im), weight)?;
            }
        }
        Ok(galaxies)
    }

    /// ξ± of all pairs, by Fourier transforms: exact to rounding.
    pub fn correlations(&self) -> Correlations {
        let side = self.lattice.side;
        let transforms = Transforms::of_lags(side);
        let at = |lag: (usize, isize)| transforms.place(lag);
        let mut sums = [PairSum::default(); SEPARATION_BINS];
        let lags = || {
            let side = side as isize;
            // One of each lag and its opposite, which has the same pairs.
            let half = (0..side).flat_map(move |dx| (1 - side..side).map(move |dy| (dx, dy)));
            half.filter(|&(dx, dy)| dx > 0 || dy > 0)
                .map(|(dx, dy)| (dx as usize, dy))
        };
        let bins: Vec<Lag> = (0..=2 * (side - 1) * (side - 1))
            .map(|lag_squared| self.lattice.bin(lag_squared))
            .collect();
        let bin = |(dx, dy): (usize, isize)| bins[dx * dx + dy.unsigned_abs().pow(2)];
        let step = self.lattice.field.0 / side as f64;

        let counts = transforms.weight_correlation(&self.weight);
        for lag in lags() {
            // A lag without pairs has rounding errors instead of zeros.
            let found = counts[at(lag)];
            if let Lag::Bin(b) = bin(lag)
                && found.im.round() > 0.0
            {
                let r = step * (lag.0 as f64).hypot(lag.1 as f64);
                sums[b].pairs += found.im.round();
                sums[b].weight += found.re;
                sums[b].weighted_r += found.re * r;
            }
        }
        let (plus, minus) = transforms.shear_correlations(&self.shear);
        for lag in lags() {
            match bin(lag) {
                Lag::Outside => {}
                Lag::Bin(b) => {
                    sums[b].plus += plus[at(lag)].re;
                    sums[b].minus += in_frame_of_pair(minus[at(lag)], lag);
                }
                Lag::Limit(b) => {
                    for a in (0..side - lag.0).flat_map(|x| (0..side).map(move |y| (x, y))) {
                        if let Some(y) = a.1.checked_add_signed(lag.1).filter(|&y| y < side) {
                            sums[b] += self.pair(a, (a.0 + lag.0, y));
                        }
                    }
                }
            }
        }
        self.normalised(sums)
    }

    /// The same from a loop over all pairs of nodes: the definition, and the reference of
    /// [`LatticeShear::correlations`]. 10,000 galaxies take a second.
    pub fn correlations_by_pairs(&self) -> Correlations {
        let nodes: Vec<(usize, usize)> = self
            .weight
            .indexed_iter()
            .filter(|(_, weight)| weight.im > 0.0)
            .map(|(node, _)| node)
            .collect();
        let mut sums = [PairSum::default(); SEPARATION_BINS];
        for (k, &a) in nodes.iter().enumerate() {
            for &b in &nodes[k + 1..] {
                let (x, y) = (b.0.abs_diff(a.0), b.1.abs_diff(a.1));
                if let Lag::Bin(bin) | Lag::Limit(bin) = self.lattice.bin(x * x + y * y) {
                    sums[bin] += self.pair(a, b);
                }
            }
        }
        self.normalised(sums)
    }

    // All pairs of the galaxies of two nodes; none if the nodes are outside the limits.
    fn pair(&self, a: (usize, usize), b: (usize, usize)) -> PairSum {
        if !self.lattice.is_within(a, b) {
            return PairSum::default();
        }
        let lag = (b.0 - a.0, b.1 as isize - a.1 as isize);
        let (first, second) = (self.shear[a], self.shear[b]);
        let weight = self.weight[a].re * self.weight[b].re;
        let step = self.lattice.field.0 / self.lattice.side as f64;
        PairSum {
            pairs: self.weight[a].im * self.weight[b].im,
            weight,
            weighted_r: weight * step * (lag.0 as f64).hypot(lag.1 as f64),
            plus: (first * second.conj()).re,
            minus: in_frame_of_pair(first * second, lag),
        }
    }

    fn normalised(&self, sums: [PairSum; SEPARATION_BINS]) -> Correlations {
        // Per component. Pairs of independent shapes: var ξ = 2σ⁴/N, as in TreeCorr.
        let variance = self.power / (2.0 * self.total);
        let mean = |of: fn(&PairSum) -> f64| {
            std::array::from_fn(|b| match sums[b].weight {
                0.0 => 0.0,
                weight => of(&sums[b]) / weight,
            })
        };
        Correlations {
            pairs: sums.map(|sum| sum.pairs),
            mean_r: mean(|sum| sum.weighted_r),
            xi_plus: mean(|sum| sum.plus),
            xi_minus: mean(|sum| sum.minus),
            variance: sums.map(|sum| match sum.weight {
                0.0 => 0.0,
                weight => 2.0 * variance.powi(2) / weight,
            }),
        }
    }
}

// g_a g_b e^(−4iα), with the lag in the direction α.
fn in_frame_of_pair(product: Complex64, (dx, dy): (usize, isize)) -> f64 {
    let lag = Complex64::new(dx as f64, -dy as f64);
    let spin_2 = lag * lag / lag.norm_sqr();
    (product * spin_2 * spin_2).re
}

/// Correlations of shear, by bins of separation. Bins without pairs are zero.
#[derive(Debug, Clone, PartialEq)]
pub struct Correlations {
    /// Number of pairs, each counted once.
    pub pairs: [f64; SEPARATION_BINS],
    /// Weighted mean separation in degrees.
    pub mean_r: [f64; SEPARATION_BINS],
    /// ξ₊ = ⟨g_a g_b*⟩, real part.
    pub xi_plus: [f64; SEPARATION_BINS],
    /// ξ₋ = ⟨g_a g_b e^(−4iα)⟩, real part, with the pair in the direction α.
    pub xi_minus: [f64; SEPARATION_BINS],
    /// Variance of either by the scatter of shapes alone.
    pub variance: [f64; SEPARATION_BINS],
}

/// Aperture mass dispersion by radius: E and B modes, and the error of either by the scatter of shapes.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
pub struct ApertureMass {
    /// Radius of the aperture in degrees: [`separations`].
    pub theta: [f64; SEPARATION_BINS],
    /// ⟨M_ap²⟩.
    pub map_e: [f64; SEPARATION_BINS],
    /// ⟨M_×²⟩, zero for shear alone.
    pub map_b: [f64; SEPARATION_BINS],
    /// Standard error of both.
    pub error: [f64; SEPARATION_BINS],
}

impl Correlations {
    /// ⟨M_ap²⟩(R) = ∫ d ln r s²/2 · (T₊(s) ξ₊ + T₋(s) ξ₋) with s = r/R, and ⟨M_×²⟩ with the other sign (Crittenden et al.
    /// 2002, ApJ 568, 20; Schneider et al. 2002), as a sum over the bins at their mean separations.
    ///
    /// The sum is cut at both limits of separation, so that E and B modes mix at radii near them.
    pub fn aperture_mass(&self) -> ApertureMass {
        let theta = separations().map(|radius| radius.0);
        let mut found = ApertureMass {
            theta,
            map_e: [0.0; SEPARATION_BINS],
            map_b: [0.0; SEPARATION_BINS],
            error: [0.0; SEPARATION_BINS],
        };
        for (k, radius) in theta.iter().enumerate() {
            let mut variance = 0.0;
            for b in 0..SEPARATION_BINS {
                let s2 = (self.mean_r[b] / radius).powi(2);
                let kernel = 0.5 * bin_width() * s2 * (-0.25 * s2).exp() / 128.0;
                let (t_plus, t_minus) = (kernel * (s2 * (s2 - 16.0) + 32.0), kernel * s2 * s2);
                found.map_e[k] += t_plus * self.xi_plus[b] + t_minus * self.xi_minus[b];
                found.map_b[k] += t_plus * self.xi_plus[b] - t_minus * self.xi_minus[b];
                variance += (t_plus * t_plus + t_minus * t_minus) * self.variance[b];
            }
            found.error[k] = variance.sqrt();
        }
        found
    }
}

// Transforms of a lattice that is padded with zeros, so that opposite sides make no pairs.
struct Transforms {
    n: usize,
    forward: Plan64,
    inverse: Plan64,
}

impl Transforms {
    fn of_lags(side: usize) -> Self {
        let mut planner = Planner64::new();
        let n = 2 * side;
        Transforms {
            n,
            forward: planner.forward(n),
            inverse: planner.inverse(n),
        }
    }

    fn place(&self, (dx, dy): (usize, isize)) -> usize {
        dx * self.n + dy.rem_euclid(self.n as isize) as usize
    }

    // Transforms rows, turns the square over its diagonal, and transforms rows again. The result is turned; turning it back would
    // take as long as a transform, and the inverse does it.
    fn transform(&self, field: &mut [Complex64], plan: &Plan64) {
        plan.process(field);
        turn(field, self.n);
        plan.process(field);
    }

    fn spectrum(&self, nodes: &Array2<Complex64>) -> Vec<Complex64> {
        let mut padded = vec![Complex64::ZERO; self.n * self.n];
        for ((x, y), value) in nodes.indexed_iter() {
            padded[x * self.n + y] = *value;
        }
        self.transform(&mut padded, &self.forward);
        padded
    }

    // Puts `of(f(k), f(−k))` in place of each pair of values.
    fn combine(
        &self,
        field: &mut [Complex64],
        of: impl Fn(Complex64, Complex64) -> (Complex64, Complex64),
    ) {
        let n = self.n;
        let scale = 1.0 / (n * n) as f64;
        for i in 0..n {
            let opposite_row = (n - i) % n;
            if opposite_row < i {
                continue;
            }
            for j in 0..n {
                let (k, opposite) = (i * n + j, opposite_row * n + (n - j) % n);
                if k <= opposite {
                    let (a, b) = of(field[k], field[opposite]);
                    (field[k], field[opposite]) = (a * scale, b * scale);
                }
            }
        }
    }

    // Σ g(x) g*(x + d) in the real part of the first, Σ g(x) g(x + d) in the second.
    fn shear_correlations(&self, nodes: &Array2<Complex64>) -> (Vec<Complex64>, Vec<Complex64>) {
        let mut minus = self.spectrum(nodes);
        let mut plus = minus.clone();
        self.combine(&mut plus, |a, b| (a.norm_sqr().into(), b.norm_sqr().into()));
        self.combine(&mut minus, |a, b| (a * b, a * b));
        self.transform(&mut plus, &self.inverse);
        self.transform(&mut minus, &self.inverse);
        (plus, minus)
    }

    // The correlations of the real and of the imaginary part, each with itself.
    fn weight_correlation(&self, nodes: &Array2<Complex64>) -> Vec<Complex64> {
        let mut field = self.spectrum(nodes);
        self.combine(&mut field, |a, b| {
            // The spectra of the two parts, both of real numbers: one transform serves both.
            let (real, imaginary) = (0.5 * (a + b.conj()), 0.5 * (a - b.conj()));
            let power = Complex64::new(real.norm_sqr(), imaginary.norm_sqr());
            (power, power)
        });
        self.transform(&mut field, &self.inverse);
        field
    }
}

// Transposes a square in place, by tiles that fit into the cache: 3 times as fast as by rows.
fn turn(field: &mut [Complex64], n: usize) {
    const TILE: usize = 16;
    for i0 in (0..n).step_by(TILE) {
        for j0 in (i0..n).step_by(TILE) {
            for i in i0..(i0 + TILE).min(n) {
                for j in j0.max(i + 1)..(j0 + TILE).min(n) {
                    field.swap(i * n + j, j * n + i);
                }
            }
        }
    }
}
