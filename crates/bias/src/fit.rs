//! The estimates that follow from sums.

use shearq_quantities::linear::{self, Pivots, substitute};

use crate::sums::{
    Component, Layout, MAX_TERMS, ONE, OTHER, OWN, PSF, PSF_SIZE, SQUARE, WEIGHT, WEIGHTED_PSF_SIZE,
};

/// Places of the estimates in a list. The first eight are m and c of the components 1, 2, + and ×.
pub(crate) const M: [usize; 4] = [0, 2, 4, 6];
pub(crate) const C: [usize; 4] = [1, 3, 5, 7];
pub(crate) const LEAKAGE: usize = 8;
pub(crate) const LEAKAGE_OF: [usize; 2] = [9, 10];
pub(crate) const SIZE_LEAKAGE: usize = 11;
pub(crate) const QUADRATIC: [usize; 2] = [12, 13];
pub(crate) const CROSS: [usize; 2] = [14, 15];
pub(crate) const RESPONSE: [usize; 2] = [16, 17];
/// R12 and R21.
pub(crate) const OTHER_RESPONSE: [usize; 2] = [18, 19];
/// (m1 + m2)/2 and (R11 + R22)/2.
pub(crate) const MEAN_M: usize = 20;
pub(crate) const MEAN_RESPONSE: usize = 21;
/// Number of estimates.
pub(crate) const ESTIMATES: usize = 22;

/// Estimates; NaN for those that the data do not determine.
pub(crate) type Estimates = [f64; ESTIMATES];

// Smallest pivot of a scaled matrix that counts as different from zero. The sums of up to 10⁹ rows have rounding errors below
// 10⁻¹²; shears that differ by 0.1 % of their mean leave a pivot of 10⁻⁶.
const SMALLEST: f64 = 1e-9;

/// Which of m and c the true shears determine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Known {
    Both,
    /// All shears are equal and not zero; c is assumed to be zero.
    OnlyM,
    /// All shears are zero or unknown.
    OnlyC,
}

/// Which estimates the sums of all units determine.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plan {
    layout: Layout,
    truth: bool,
    pub(crate) known: [Known; 4],
    quadratic: [bool; 2],
    cross: [bool; 2],
    leakage: bool,
    size_leakage: bool,
}

impl Plan {
    /// Of the sums of all units, with the response of sheared catalogues ([`Layout::with_response`]). Parts of them, from
    /// which errors follow, are estimated with the same terms.
    pub(crate) fn new(layout: Layout, sums: &[f64], truth: bool) -> Self {
        let mut plan = Plan {
            layout,
            truth,
            known: [Known::OnlyC; 4],
            quadratic: [false; 2],
            cross: [false; 2],
            leakage: false,
            size_leakage: false,
        };
        for k in 0..layout.components() {
            let of = layout.of(sums, k);
            // One shear of zero determines c, and one other shear m if c is zero.
            let zero = of.response(OWN, OWN) == 0.0;
            plan.known[k] = match (truth && !zero, solve(&of, &[ONE, OWN])) {
                (false, _) => Known::OnlyC,
                (true, Some(_)) => Known::Both,
                (true, None) => Known::OnlyM,
            };
            if k < 2 && plan.known[k] == Known::Both {
                plan.quadratic[k] = solve(&of, &[ONE, OWN, SQUARE]).is_some();
                plan.cross[k] = solve(&of, &[ONE, OWN, OTHER]).is_some();
            }
        }
        if layout.psf {
            let of = |k| layout.of(sums, k);
            let all =
                |terms: &[usize]| (0..2).all(|k| solve(&of(k), &plan.with(k, terms)).is_some());
            let (leakage, size_leakage) = (all(&[PSF]), all(&[PSF, PSF_SIZE]));
            plan.leakage = leakage;
            plan.size_leakage = leakage && size_leakage;
        }
        plan
    }

    // The constant and, if m is determined, the shear, with more terms: PSFs that follow the shear would otherwise take a part
    // of m as leakage.
    fn with(&self, k: usize, more: &[usize]) -> Vec<usize> {
        let mut terms = vec![ONE];
        if self.truth && self.known[k] == Known::Both {
            terms.push(OWN);
        }
        terms.extend(more);
        terms
    }

    // Without the quadratic, cross and PSF terms, which would enlarge the errors of m and c: each of them is fitted separately.
    fn main_terms(&self, k: usize) -> &'static [usize] {
        match self.known[k] {
            Known::Both => &[ONE, OWN],
            Known::OnlyM => &[OWN],
            Known::OnlyC => &[ONE],
        }
    }

    /// The unknowns of component `k` with its `terms`. With a response matrix, the other component of its pair is fitted
    /// with the terms `others` at the same time.
    fn solve(&self, sums: &[f64], k: usize, terms: &[usize], others: &[usize]) -> Option<Solution> {
        match self.layout.matrix {
            true => solve_both(self.layout, sums, k, [terms, others]),
            false => solve(&self.layout.of(sums, k), terms),
        }
    }

    /// The estimates of sums.
    pub(crate) fn estimates(&self, sums: &[f64]) -> Estimates {
        let layout = self.layout;
        let mut found = [f64::NAN; ESTIMATES];
        for k in 0..layout.components() {
            let terms = self.main_terms(k);
            let of = layout.of(sums, k);
            let solved = match (layout.matrix, self.known[k]) {
                (true, _) | (false, Known::Both) => {
                    self.solve(sums, k, terms, self.main_terms(k ^ 1))
                }
                // One unknown is a ratio.
                (false, Known::OnlyM | Known::OnlyC) => {
                    let mut x = [0.0; MAX_TERMS];
                    x[0] = of.with_e[terms[0]] / of.response(terms[0], terms[0]);
                    Some(x)
                }
            };
            let Some([first, second, ..]) = solved else {
                continue;
            };
            match self.known[k] {
                Known::Both => (found[M[k]], found[C[k]]) = (second - 1.0, first),
                Known::OnlyM => found[M[k]] = first - 1.0,
                Known::OnlyC => found[C[k]] = first,
            }
        }
        for k in 0..2 {
            let of = layout.of(sums, k);
            found[RESPONSE[k]] = of.response(ONE, ONE) / sums[WEIGHT];
            if let Some(mixed) = layout.mixed(sums, k) {
                found[OTHER_RESPONSE[k]] = mixed.response(ONE, ONE) / sums[WEIGHT];
            }
            let last = |terms: &[usize], others: &[usize]| {
                let solved = self.solve(sums, k, terms, others);
                solved.map_or(f64::NAN, |x| x[terms.len() - 1])
            };
            for (determined, places, terms) in [
                (self.quadratic, QUADRATIC, [ONE, OWN, SQUARE]),
                (self.cross, CROSS, [ONE, OWN, OTHER]),
            ] {
                let others = match determined[k ^ 1] {
                    true => &terms,
                    false => self.main_terms(k ^ 1),
                };
                if determined[k] {
                    found[places[k]] = last(&terms, others);
                }
            }
            if self.leakage {
                found[LEAKAGE_OF[k]] = last(&self.with(k, &[PSF]), &self.with(k ^ 1, &[PSF]));
            }
        }
        for (mean, [a, b]) in [(MEAN_M, [M[0], M[1]]), (MEAN_RESPONSE, RESPONSE)] {
            found[mean] = (found[a] + found[b]) / 2.0;
        }
        if self.leakage {
            found[LEAKAGE] = self.joint(sums, &[PSF]);
        }
        if self.size_leakage {
            // Change of the leakage with a relative change of the size.
            found[SIZE_LEAKAGE] =
                self.joint(sums, &[PSF, PSF_SIZE]) * sums[WEIGHTED_PSF_SIZE] / sums[WEIGHT];
        }
        found
    }

    /// Estimates of `sums` if some of their galaxies, which have the sums `own`, had a larger m and c. `change` is the
    /// difference of m, and of c for each component.
    pub(crate) fn shifted(&self, sums: &[f64], own: &[f64], change: (f64, [f64; 4])) -> Estimates {
        let mut changed = sums.to_vec();
        self.layout.shift(&mut changed, own, change);
        self.estimates(&changed)
    }

    // The last of `more` terms, from both components: the mean weighted by the pivots, the inverse variances for equal noise.
    // Tangential and cross components entered at first, too, and α was 0.073 instead of 0.08.
    fn joint(&self, sums: &[f64], more: &[usize]) -> f64 {
        let (mut sum, mut weight) = (0.0, 0.0);
        for k in 0..2 {
            let terms = self.with(k, more);
            let alone = last_of(&self.layout.of(sums, k), &terms);
            let Some((mut x, pivot)) = alone else {
                continue;
            };
            if self.layout.matrix {
                let both = self.solve(sums, k, &terms, &self.with(k ^ 1, more));
                x = both.map_or(f64::NAN, |x| x[terms.len() - 1]);
            }
            sum += x * pivot;
            weight += pivot;
        }
        sum / weight
    }
}

type Solution = [f64; MAX_TERMS];

/// Solves Σ_t x_t Σ w R z_s z_t = Σ w e z_s over the given terms; `None` if the terms are not independent.
fn solve(of: &Component<'_>, terms: &[usize]) -> Option<Solution> {
    eliminate(of, terms).map(|(x, _)| x)
}

/// The last unknown with its pivot, which is its weight in a mean.
fn last_of(of: &Component<'_>, terms: &[usize]) -> Option<(f64, f64)> {
    eliminate(of, terms).map(|(x, pivot)| (x[terms.len() - 1], pivot))
}

// Gaussian elimination of a symmetric matrix without exchange of rows, after scaling its diagonal to ±1: shears of 10⁻² have
// squares of 10⁻⁸ of the constant's, and one threshold for pivots serves all terms.
fn eliminate(of: &Component<'_>, terms: &[usize]) -> Option<(Solution, f64)> {
    let n = terms.len();
    let mut a = [[0.0; MAX_TERMS + 1]; MAX_TERMS];
    let mut scale = [0.0; MAX_TERMS];
    for (i, &s) in terms.iter().enumerate() {
        scale[i] = of.response(s, s).abs().sqrt();
        if !(scale[i] > 0.0 && scale[i].is_finite()) {
            return None;
        }
    }
    for (i, &s) in terms.iter().enumerate() {
        for (j, &t) in terms.iter().enumerate() {
            a[i][j] = of.response(s, t) / (scale[i] * scale[j]);
        }
        a[i][n] = of.with_e[s] / scale[i];
    }
    let a = &mut a[..n];
    if !linear::eliminate(a, Pivots::InOrder, SMALLEST) {
        return None;
    }
    let mut x = [0.0; MAX_TERMS];
    substitute(a, &mut x);
    let pivot = a[n - 1][n - 1] * scale[n - 1] * scale[n - 1];
    for (x, scale) in x.iter_mut().zip(scale).take(n) {
        *x /= scale;
    }
    Some((x, pivot))
}

/// Solves Σ_t x_kt Σ w R_kk z_ks z_kt + Σ_t x_jt Σ w R_kj z_ks z_jt = Σ w e_k z_ks, and the same with k and j exchanged, for
/// the component `k` and the other one `j` of its pair. Returns the unknowns of `k`.
fn solve_both(
    layout: Layout,
    sums: &[f64],
    k: usize,
    [terms, others]: [&[usize]; 2],
) -> Option<Solution> {
    let unknowns = || {
        let own = terms.iter().map(|t| (k, *t));
        own.chain(others.iter().map(|t| (k ^ 1, *t)))
    };
    let [own, other] = [k, k ^ 1].map(|k| (k, layout.of(sums, k), layout.mixed(sums, k)));
    let of = |component: usize| if component == k { &own } else { &other };
    let response = |(a, s): (usize, usize), (b, t): (usize, usize)| {
        let (_, alone, mixed) = of(a);
        match (a == b, mixed) {
            (true, _) => alone.response(s, t),
            (false, Some(mixed)) => mixed.response(s, t),
            (false, None) => 0.0,
        }
    };
    let n = terms.len() + others.len();
    let mut scale = [0.0; 2 * MAX_TERMS];
    for (scale, unknown) in scale.iter_mut().zip(unknowns()) {
        *scale = response(unknown, unknown).abs().sqrt();
        if !(*scale > 0.0 && scale.is_finite()) {
            return None;
        }
    }
    let mut rows = [[0.0; 2 * MAX_TERMS + 1]; 2 * MAX_TERMS];
    for ((row, equation), own) in rows.iter_mut().zip(unknowns()).zip(scale) {
        for ((value, unknown), other) in row.iter_mut().zip(unknowns()).zip(scale) {
            *value = response(equation, unknown) / (own * other);
        }
        row[n] = of(equation.0).1.with_e[equation.1] / own;
    }
    // With R12 and R21 the matrix is not symmetric, so that rows are exchanged.
    if !linear::eliminate(&mut rows[..n], Pivots::Largest, SMALLEST) {
        return None;
    }
    let mut x = [0.0; 2 * MAX_TERMS];
    substitute(&rows[..n], &mut x);
    Some(std::array::from_fn(|at| match at < terms.len() {
        true => x[at] / scale[at],
        false => 0.0,
    }))
}
