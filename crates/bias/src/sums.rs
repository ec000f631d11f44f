//! The sums of galaxies: a list of numbers per unit and bin. Lists add up.
//!
//! Each list has the sums Σ w e z and Σ w R z z of the terms z of the fit, from which all estimates follow, so that a
//! jackknife leaves out a unit by one subtraction and needs no second reading of the rows.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use serde::{Deserialize, Serialize};

/// One galaxy of a catalogue.
///
/// Pairs are the components 1 and 2 in the axes of the catalogue; all components use the same axes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Row {
    /// Ellipticity (e1, e2) in any definition and unit that [`Row::response`] converts to a shear.
    pub e: [f64; 2],
    /// Weight w, without unit. Rows of weight zero should not be added.
    pub weight: f64,
    /// Shear response of the *weighted* ellipticity, `response[i][j]` = d(w eᵢ)/dgⱼ = w Rᵢⱼ + eᵢ dw/dgⱼ. For an ellipticity
    /// that is a shear estimate it is w times the unit matrix. The elements (0, 1) and (1, 0) are used if
    /// [`Layout::matrix`].
    pub response: [[f64; 2]; 2],
    /// True reduced shear (g1, g2).
    pub g: [f64; 2],
    /// Ellipticity of the PSF, in the definition in which α is wanted.
    pub psf: [f64; 2],
    /// Size of the PSF, in any unit: only its relative changes enter.
    pub psf_size: f64,
}

/// A sheared catalogue of metacalibration (Sheldon & Huff 2017, ApJ 841, 24): component and sign of the shear that was
/// added to the images before measuring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ShearedCatalogue {
    /// Component, 0 or 1.
    pub component: usize,
    /// Whether the shear is positive.
    pub plus: bool,
}

/// The sheared catalogues by their names in ngmix and metadetect: 1p, 1m, 2p and 2m. Indices of sheared catalogues in
/// this crate are places in this list.
pub const SHEARED_CATALOGUES: [(&str, ShearedCatalogue); 4] = [
    ("1p", sheared(0, true)),
    ("1m", sheared(0, false)),
    ("2p", sheared(1, true)),
    ("2m", sheared(1, false)),
];

const fn sheared(component: usize, plus: bool) -> ShearedCatalogue {
    ShearedCatalogue { component, plus }
}

// Terms z of the fit: a constant, the same and the other component of shear, the square of the shear.
pub(crate) const ONE: usize = 0;
pub(crate) const OWN: usize = 1;
pub(crate) const OTHER: usize = 2;
pub(crate) const SQUARE: usize = 3;
// The PSF's ellipticity, and its product with the PSF's size: leakage grows with the PSF relative to the galaxy.
pub(crate) const PSF: usize = 4;
pub(crate) const PSF_SIZE: usize = 5;
pub(crate) const MAX_TERMS: usize = 6;

// Places of the first sums: galaxies, weights, squared weights, weights times PSF size.
pub(crate) const COUNT: usize = 0;
pub(crate) const WEIGHT: usize = 1;
pub(crate) const WEIGHT2: usize = 2;
pub(crate) const WEIGHTED_PSF_SIZE: usize = 3;
// Then per sheared catalogue: weights times ellipticity, weights.
const SHEARED: usize = 4;
const HEAD: usize = SHEARED + 2 * SHEARED_CATALOGUES.len();

/// Which sums are kept: those that the columns of the catalogues determine.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layout {
    /// Whether rows have the ellipticity of the PSF. Then there are also sums in the frame of the PSF, for m₊, m×, c₊, c×.
    pub psf: bool,
    /// Whether sheared catalogues are summed with [`crate::UnitSums::add_sheared`]. The difference of their mean
    /// ellipticities is added to the mean response of the rows: it is the whole response (metadetection), or the
    /// response of the selection R_S (metacalibration).
    // The name in files of sums of shearq 0.2.
    #[serde(rename = "versions")]
    pub sheared: bool,
    /// Whether rows have the responses R12 of e1 to g2 and R21 of e2 to g1. Then both components are fitted together.
    pub matrix: bool,
}

impl Layout {
    pub(crate) fn terms(self) -> usize {
        if self.psf { MAX_TERMS } else { PSF }
    }

    // 1, 2, and along and across the PSF: GREAT3 (Mandelbaum et al. 2014, ApJS 212, 5) ranks by m₊ and c₊, because an
    // incomplete correction of the PSF points along it and averages out in pixel axes if PSFs have random directions.
    pub(crate) fn components(self) -> usize {
        if self.psf { 4 } else { 2 }
    }

    // Sums w e z, then w R z z, then w z z if there are sheared catalogues: their response is known as a mean only, and
    // multiplies w z z after all rows are summed.
    fn of_component(self) -> usize {
        let n = self.terms();
        n + triangle(n) * if self.sheared { 2 } else { 1 }
    }

    /// Numbers per unit and bin.
    pub fn len(self) -> usize {
        self.matrix_start() + self.of_other_components() + self.components() / 2 * self.of_pair()
    }

    // After all others, so that files of sums without a response matrix stay readable.
    fn matrix_start(self) -> usize {
        HEAD + self.components() * self.of_component()
    }

    // Per sheared catalogue, weights times the ellipticity in the component that it does not shear, for R12 and R21: with
    // R = [[0.8, 0.1], [0.1, 0.7]] and g1 = g2, the diagonal alone gives m = 0.125 and 0.143 instead of 0.
    fn of_other_components(self) -> usize {
        if self.matrix && self.sheared {
            SHEARED_CATALOGUES.len()
        } else {
            0
        }
    }

    // Of a pair of components: sums w R12 z z', w R21 z' z, then w z z' if they are needed; none without a matrix.
    fn of_pair(self) -> usize {
        let n = self.terms();
        match (self.matrix, self.sheared) {
            (false, _) => 0,
            (true, false) => 2 * n * n,
            (true, true) => 3 * n * n,
        }
    }

    /// Of `sums`, what divides the ellipticities of both components: weights times responses, or weights alone if sheared catalogues
    /// contain the response.
    pub(crate) fn divisors(self, sums: &[f64]) -> [f64; 2] {
        let n = self.terms();
        let weights = if self.sheared { triangle(n) } else { 0 };
        [0, 1].map(|k| sums[HEAD + k * self.of_component() + n + weights])
    }

    /// Never: there is always a count.
    pub fn is_empty(self) -> bool {
        false
    }

    /// Adds a galaxy to `sums`, the [`Layout::len`] numbers of its unit and bin.
    ///
    /// # Panics
    /// If `sums` has fewer numbers.
    pub fn add(self, sums: &mut [f64], row: &Row) {
        sums[COUNT] += 1.0;
        sums[WEIGHT] += row.weight;
        sums[WEIGHT2] += row.weight * row.weight;
        sums[WEIGHTED_PSF_SIZE] += row.weight * row.psf_size;
        let [[r11, mut r12], [mut r21, r22]] = row.response;
        if !self.matrix {
            [r12, r21] = [0.0; 2];
        }
        let response = [[r11, r12], [r21, r22]];
        // With a known number of terms, the sums become vector code without loops.
        if !self.psf {
            self.add_pair::<PSF>(sums, 0, row, (row.e, response, row.g, row.psf));
            return;
        }
        self.add_pair::<MAX_TERMS>(sums, 0, row, (row.e, response, row.g, row.psf));
        let modulus = row.psf[0].hypot(row.psf[1]);
        // A round PSF has no direction.
        let [cos, sin] = if modulus > 0.0 {
            row.psf.map(|p| p / modulus)
        } else {
            [1.0, 0.0]
        };
        let rotated = |[a, b]: [f64; 2]| [a * cos + b * sin, b * cos - a * sin];
        let (e, g) = (rotated(row.e), rotated(row.g));
        // U R Uᵀ with the rotation U. Without R12 and R21 the added zeros change no bit.
        let shared = cos * sin * (r12 + r21);
        let rest = cos * sin * (r22 - r11);
        let response = [
            [
                r11 * cos * cos + r22 * sin * sin + shared,
                r12 * cos * cos - r21 * sin * sin + rest,
            ],
            [
                r21 * cos * cos - r12 * sin * sin + rest,
                r11 * sin * sin + r22 * cos * cos - shared,
            ],
        ];
        self.add_pair::<MAX_TERMS>(sums, 1, row, (e, response, g, [modulus, 0.0]));
    }

    // To the sums of the components 1 and 2 (pair 0), or of those along and across the PSF (pair 1), which have N terms.
    fn add_pair<const N: usize>(
        self,
        sums: &mut [f64],
        pair: usize,
        row: &Row,
        (e, response, g, psf): ([f64; 2], [[f64; 2]; 2], [f64; 2], [f64; 2]),
    ) {
        let terms = |k: usize| -> [f64; N] {
            let (g, other, p) = (g[k], g[1 - k], psf[k]);
            let all = [1.0, g, other, g * g, p, p * row.psf_size];
            std::array::from_fn(|term| all[term])
        };
        let z = [terms(0), terms(1)];
        let length = self.of_component();
        let start = HEAD + 2 * pair * length;
        let components = sums[start..].chunks_exact_mut(length);
        for (k, sums) in components.take(2).enumerate() {
            component(sums, e[k], response[k][k], row.weight, &z[k]);
        }
        if !self.matrix {
            return;
        }
        let start = self.matrix_start() + self.of_other_components() + pair * self.of_pair();
        let mut matrices = sums[start..start + self.of_pair()].chunks_exact_mut(N * N);
        for (factor, [a, b]) in [
            (response[0][1], [0, 1]),
            (response[1][0], [1, 0]),
            (row.weight, [0, 1]),
        ] {
            let Some(sums) = matrices.next() else { break };
            for (sums, z_s) in sums.chunks_exact_mut(N).zip(z[a]) {
                let scaled = factor * z_s;
                for (sum, z_t) in sums.iter_mut().zip(z[b]) {
                    *sum += scaled * z_t;
                }
            }
        }
    }

    /// Adds the ellipticity of a galaxy to `sums` of the sheared catalogue at this place of [`SHEARED_CATALOGUES`]:
    /// measured on a sheared image, or on the unsheared image of a galaxy that the sheared catalogue selects.
    ///
    /// `e` is divided by twice the added shear h beforehand, so that differences of means are derivatives,
    /// (⟨e⟩₊ − ⟨e⟩₋)/2h.
    pub fn add_sheared(self, sums: &mut [f64], catalogue: usize, e: [f64; 2], weight: f64) {
        let (_, which) = SHEARED_CATALOGUES[catalogue];
        sums[SHEARED + 2 * catalogue] += weight * e[which.component];
        sums[SHEARED + 2 * catalogue + 1] += weight;
        if self.of_other_components() > 0 {
            sums[self.matrix_start() + catalogue] += weight * e[1 - which.component];
        }
    }

    /// Adds `sums` to `into` as if the weight of each galaxy were multiplied by `factor`.
    pub(crate) fn add_weighted(into: &mut [f64], sums: &[f64], factor: f64) {
        for (at, (into, value)) in into.iter_mut().zip(sums).enumerate() {
            *into += match at {
                COUNT => *value,
                WEIGHT2 => factor * factor * value,
                _ => factor * value,
            };
        }
    }

    /// Mean ellipticity.
    pub(crate) fn mean(self, sums: &[f64]) -> [f64; 2] {
        [0, 1].map(|k| self.of(sums, k).with_e[ONE] / sums[WEIGHT])
    }

    /// Number of galaxies, and Σ w e g and Σ w R g² of both components.
    pub(crate) fn counts_and_slopes(self, sums: &[f64]) -> (f64, [[f64; 2]; 2]) {
        let of = [0, 1].map(|k| self.of(sums, k));
        let slopes = [
            of.each_ref().map(|of| of.with_e[OWN]),
            of.each_ref().map(|of| of.response(OWN, OWN)),
        ];
        (sums[COUNT], slopes)
    }

    /// The first sheared catalogue without galaxies, if there are sheared catalogues.
    pub(crate) fn without_galaxies(self, sums: &[f64]) -> Option<&'static str> {
        let mut names = SHEARED_CATALOGUES.iter().enumerate();
        let found = names.find(|(at, _)| sums[SHEARED + 2 * at + 1] == 0.0);
        found.filter(|_| self.sheared).map(|(_, (name, _))| *name)
    }

    /// Mean response from the sheared catalogues of these sums; NaN if one of them has no galaxy.
    pub(crate) fn mean_response(self, sums: &[f64]) -> ShearedResponse {
        // The sum of weights differs from catalogue to catalogue, because each selects and weights other galaxies. Four
        // catalogues are needed because a selection responds to each component, and a one-sided difference has an error of
        // first order in h.
        let mean = |catalogue: usize, at: usize| sums[at] / sums[SHEARED + 2 * catalogue + 1];
        let own = |k: usize| {
            let of = |catalogue: usize| mean(catalogue, SHEARED + 2 * catalogue);
            of(2 * k) - of(2 * k + 1)
        };
        let [a, b] = [own(0), own(1)];
        let mut response = ShearedResponse {
            own: [a, b, (a + b) / 2.0, (a + b) / 2.0],
            other: [0.0; 4],
        };
        if self.matrix {
            // The catalogues 2p and 2m give the response of e1 to g2.
            let other = |k: usize| {
                let of = |catalogue: usize| mean(catalogue, self.matrix_start() + catalogue);
                of(2 - 2 * k) - of(3 - 2 * k)
            };
            let [a, b] = [other(0), other(1)];
            // In a frame of random directions only the antisymmetric part is left.
            response.other = [a, b, (a - b) / 2.0, (b - a) / 2.0];
        }
        response
    }

    /// The layout of sums with the mean response of sheared catalogues in the response of each row.
    pub(crate) fn with_response(self) -> Self {
        Layout {
            sheared: false,
            ..self
        }
    }

    /// Adds `sums` to `into`, sums of the layout [`Layout::with_response`], with the mean response of the sheared catalogues
    /// added to the response of each row: Σ w (R + mean) z z'.
    pub(crate) fn add_with_response(self, into: &mut [f64], sums: &[f64], mean: &ShearedResponse) {
        let mut add = |at: usize, value: f64| into[at] += value;
        (0..HEAD).for_each(|at| add(at, sums[at]));
        let (target, n) = (self.with_response(), self.terms());
        let with_weight = if self.sheared { triangle(n) } else { 0 };
        for k in 0..self.components() {
            let own = &sums[HEAD + k * self.of_component()..];
            let start = HEAD + k * target.of_component();
            for (at, value) in own[..target.of_component()].iter().enumerate() {
                add(start + at, *value);
            }
            let weights = &own[target.of_component()..][..with_weight];
            for (at, weight) in weights.iter().enumerate() {
                add(start + n + at, mean.own[k] * weight);
            }
        }
        for pair in 0..self.components() / 2 {
            let start = self.matrix_start() + self.of_other_components() + pair * self.of_pair();
            let own = &sums[start..start + self.of_pair()];
            let start = target.matrix_start() + pair * target.of_pair();
            let (responses, weights) = own.split_at(target.of_pair());
            for (at, value) in responses.iter().enumerate() {
                add(start + at, *value);
            }
            // Of the first component with the second one: the response R21 has the terms in the other order.
            for (at, weight) in weights.iter().enumerate() {
                let transposed = at % n * n + at / n;
                add(start + at, mean.other[2 * pair] * weight);
                add(
                    start + n * n + transposed,
                    mean.other[2 * pair + 1] * weight,
                );
            }
        }
    }

    // Changes `sums` as if some of their galaxies, which have the sums `own`, had a larger m and c: e becomes e + R (m g + c),
    // because a wrong PSF changes the shear before the response.
    pub(crate) fn shift(self, sums: &mut [f64], own: &[f64], (m, c): (f64, [f64; 4])) {
        for k in 0..self.components() {
            let of = self.of(own, k);
            let mixed = self.mixed(own, k);
            let start = HEAD + k * self.of_component();
            for (s, with_e) in sums[start..][..self.terms()].iter_mut().enumerate() {
                *with_e += m * of.response(s, OWN) + c[k] * of.response(s, ONE);
                if let Some(mixed) = &mixed {
                    *with_e += m * mixed.response(s, OWN) + c[k ^ 1] * mixed.response(s, ONE);
                }
            }
        }
    }

    /// The sums that mix a component with the other one of its pair; `None` without a response matrix.
    pub(crate) fn mixed(self, sums: &[f64], component: usize) -> Option<Mixed<'_>> {
        if !self.matrix {
            return None;
        }
        let n = self.terms();
        let start = self.matrix_start()
            + self.of_other_components()
            + component / 2 * self.of_pair()
            + component % 2 * n * n;
        Some(Mixed {
            with_response: &sums[start..start + n * n],
            terms: n,
        })
    }

    /// The sums of a component.
    pub(crate) fn of(self, sums: &[f64], component: usize) -> Component<'_> {
        let n = self.terms();
        let start = HEAD + component * self.of_component();
        let own = &sums[start..start + self.of_component()];
        let (with_e, with_response) = own.split_at(n);
        Component {
            with_e,
            with_response,
        }
    }
}

/// Mean responses from sheared catalogues of the four components: to the own component of shear, and to the other one of
/// the pair.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ShearedResponse {
    own: [f64; 4],
    other: [f64; 4],
}

impl ShearedResponse {
    pub(crate) fn is_finite(self) -> bool {
        self.own.iter().chain(&self.other).all(|r| r.is_finite())
    }
}

/// Sums of a component k and the other one j of its pair.
pub(crate) struct Mixed<'a> {
    /// Σ w R_kj z_k z_j by rows.
    with_response: &'a [f64],
    terms: usize,
}

impl Mixed<'_> {
    /// Σ w R_kj z_ks z_jt.
    pub(crate) fn response(&self, s: usize, t: usize) -> f64 {
        self.with_response[s * self.terms + t]
    }
}

/// Sums of one component.
pub(crate) struct Component<'a> {
    /// Σ w e z.
    pub(crate) with_e: &'a [f64],
    /// Σ w R z z, the lower triangle by rows.
    with_response: &'a [f64],
}

impl Component<'_> {
    /// Σ w R z_s z_t.
    pub(crate) fn response(&self, s: usize, t: usize) -> f64 {
        self.with_response[triangle(s.max(t)) + s.min(t)]
    }
}

fn component<const N: usize>(sums: &mut [f64], e: f64, response: f64, weight: f64, z: &[f64; N]) {
    let (with_e, matrices) = sums.split_at_mut(N);
    for (sum, z) in with_e.iter_mut().zip(z) {
        *sum += weight * e * z;
    }
    // Without sheared catalogues there is no second matrix.
    for (matrix, factor) in matrices
        .chunks_exact_mut(triangle(N))
        .zip([response, weight])
    {
        let matrix = &mut matrix[..triangle(N)];
        for s in 0..N {
            let scaled = factor * z[s];
            for t in 0..=s {
                matrix[triangle(s) + t] += scaled * z[t];
            }
        }
    }
}

/// Numbers in the lower triangle of an n × n matrix.
const fn triangle(n: usize) -> usize {
    n * (n + 1) / 2
}

/// The key of a unit that joins 2^`shift` neighbouring keys.
pub(crate) fn shifted(key: u64, shift: u32) -> u64 {
    // A shift by 64 bits or more overflows, and means one unit.
    key.checked_shr(shift).unwrap_or(0)
}

/// Adds sums to those under the same key.
pub(crate) fn join<K: Ord>(all: &mut BTreeMap<K, Vec<f64>>, key: K, sums: Vec<f64>) {
    match all.entry(key) {
        Entry::Vacant(free) => _ = free.insert(sums),
        Entry::Occupied(mut there) => add(there.get_mut(), &sums),
    }
}

pub(crate) fn add(sums: &mut [f64], more: &[f64]) {
    for (sum, more) in sums.iter_mut().zip(more) {
        *sum += more;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // As the documentation of the crate has the sums, in the order in which they are kept.
    fn plain(layout: Layout, sums: &mut [f64], pair: usize, row: &Row) {
        let n = layout.terms();
        for k in 0..2 {
            let z = terms(row, k);
            let mut at = HEAD + (2 * pair + k) * layout.of_component();
            for z in &z[..n] {
                sums[at] += row.weight * row.e[k] * z;
                at += 1;
            }
            for factor in [row.response[k][k], row.weight] {
                if factor == row.weight && !layout.sheared {
                    break;
                }
                for s in 0..n {
                    for t in 0..=s {
                        sums[at] += factor * z[s] * z[t];
                        at += 1;
                    }
                }
            }
        }
        let mut at = layout.matrix_start() + layout.of_other_components() + pair * layout.of_pair();
        for (factor, [a, b]) in [
            (row.response[0][1], [0, 1]),
            (row.response[1][0], [1, 0]),
            (row.weight, [0, 1]),
        ] {
            if !layout.matrix || factor == row.weight && !layout.sheared {
                break;
            }
            for s in 0..n {
                for t in 0..n {
                    sums[at] += factor * terms(row, a)[s] * terms(row, b)[t];
                    at += 1;
                }
            }
        }
    }

    fn terms(row: &Row, k: usize) -> [f64; MAX_TERMS] {
        let (g, p) = (row.g[k], row.psf[k]);
        [1.0, g, row.g[1 - k], g * g, p, p * row.psf_size]
    }

    #[test]
    fn sums_of_all_layouts_are_those_of_plain_loops() {
        for kind in 0..8 {
            let layout = Layout {
                psf: kind & 1 > 0,
                sheared: kind & 2 > 0,
                matrix: kind & 4 > 0,
            };
            let (mut found, mut expected) = (vec![0.0; layout.len()], vec![0.0; layout.len()]);
            // Of the responses to the other component, of galaxies and shears.
            let mut mixed = [0.0; 2];
            for number in 1..20 {
                let value = |k: i32| (f64::from(number * k) * 0.7).sin();
                let row = Row {
                    e: [value(1), value(2)],
                    weight: 2.0 + value(3),
                    response: [[value(4), value(5)], [value(6), value(7)]],
                    g: [value(8), value(9)],
                    psf: [value(10), value(11)],
                    psf_size: 3.0 + value(12),
                };
                let parts = (row.e, row.response, row.g, row.psf);
                for pair in 0..layout.components() / 2 {
                    match layout.psf {
                        true => layout.add_pair::<MAX_TERMS>(&mut found, pair, &row, parts),
                        false => layout.add_pair::<PSF>(&mut found, pair, &row, parts),
                    }
                    plain(layout, &mut expected, pair, &row);
                }
                for (k, mixed) in mixed.iter_mut().enumerate() {
                    *mixed += row.response[k][1 - k] * row.g[k];
                }
            }
            assert_eq!(found, expected, "{layout:?}");
            for component in 0..layout.components() {
                let of = layout.mixed(&found, component);
                let of = of.map(|of| of.response(OWN, ONE));
                let expected = layout.matrix.then(|| mixed[component % 2]);
                assert_eq!(of, expected, "{layout:?} {component}");
            }
        }
    }
}
