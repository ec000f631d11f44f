//! The sums of galaxies: a list of numbers per unit and bin. Lists add up.

use serde::{Deserialize, Serialize};

/// One galaxy.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Row {
    /// Ellipticity.
    pub e: [f64; 2],
    /// Weight w.
    pub weight: f64,
    /// Derivatives of w e1 with g1 and of w e2 with g2: w R + e dw/dg.
    pub slope: [f64; 2],
    /// True shear.
    pub g: [f64; 2],
    /// Ellipticity of the PSF.
    pub psf: [f64; 2],
    /// Size of the PSF, in any unit.
    pub psf_size: f64,
}

/// A version of an artificially sheared image: component and sign of the shear.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Version {
    /// Component, 0 or 1.
    pub component: usize,
    /// Whether the shear is positive.
    pub plus: bool,
}

/// The sheared versions with their names: 1p, 1m, 2p, 2m.
pub const VERSIONS: [(&str, Version); 4] = [
    ("1p", version(0, true)),
    ("1m", version(0, false)),
    ("2p", version(1, true)),
    ("2m", version(1, false)),
];

const fn version(component: usize, plus: bool) -> Version {
    Version { component, plus }
}

/// Terms z of the fit: a constant, the same and the other component of shear, the square of the shear.
pub(crate) const ONE: usize = 0;
pub(crate) const OWN: usize = 1;
pub(crate) const OTHER: usize = 2;
pub(crate) const SQUARE: usize = 3;
/// The PSF's ellipticity, and its product with the PSF's size.
pub(crate) const PSF: usize = 4;
pub(crate) const PSF_SIZE: usize = 5;
/// Most terms.
pub(crate) const MOST: usize = 6;

/// Places of the first sums: galaxies, weights, squared weights, weights times PSF size.
pub(crate) const COUNT: usize = 0;
pub(crate) const WEIGHT: usize = 1;
pub(crate) const WEIGHT2: usize = 2;
pub(crate) const SIZE: usize = 3;
/// Then per version: weights times ellipticity, weights.
const VERSION: usize = 4;
const HEAD: usize = VERSION + 2 * VERSIONS.len();

/// Which sums there are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layout {
    /// Whether rows have the ellipticity of the PSF. Then there are also sums in the frame of the PSF.
    pub psf: bool,
    /// Whether a mean response from sheared versions adds to the responses of the rows.
    pub versions: bool,
}

impl Layout {
    pub(crate) fn terms(self) -> usize {
        if self.psf { MOST } else { PSF }
    }

    /// Components: 1, 2, and along and across the PSF.
    pub(crate) fn components(self) -> usize {
        if self.psf { 4 } else { 2 }
    }

    /// Sums w e z, then w R z z, then w z z if they are needed.
    fn of_component(self) -> usize {
        let n = self.terms();
        n + triangle(n) * if self.versions { 2 } else { 1 }
    }

    /// Numbers per unit and bin.
    pub fn len(self) -> usize {
        HEAD + self.components() * self.of_component()
    }

    /// Never: there is always a count.
    pub fn is_empty(self) -> bool {
        false
    }

    /// Adds a galaxy to the sums of its unit and bin.
    ///
    /// # Panics
    /// If `sums` has not [`Layout::len`] numbers.
    pub fn add(self, sums: &mut [f64], row: &Row) {
        sums[COUNT] += 1.0;
        sums[WEIGHT] += row.weight;
        sums[WEIGHT2] += row.weight * row.weight;
        sums[SIZE] += row.weight * row.psf_size;
        let of_component = self.of_component();
        let mut components = sums[HEAD..].chunks_exact_mut(of_component);
        for k in 0..2 {
            if let Some(sums) = components.next() {
                let (g, other, p) = (row.g[k], row.g[1 - k], row.psf[k]);
                self.component(
                    sums,
                    row.e[k],
                    row.slope[k],
                    row.weight,
                    [g, other, p],
                    row.psf_size,
                );
            }
        }
        if !self.psf {
            return;
        }
        let modulus = row.psf[0].hypot(row.psf[1]);
        // A round PSF has no direction.
        let [cos, sin] = if modulus > 0.0 {
            row.psf.map(|p| p / modulus)
        } else {
            [1.0, 0.0]
        };
        let rotated = |[a, b]: [f64; 2]| [a * cos + b * sin, b * cos - a * sin];
        let (e, g) = (rotated(row.e), rotated(row.g));
        let [r1, r2] = row.slope;
        let slopes = [
            r1 * cos * cos + r2 * sin * sin,
            r1 * sin * sin + r2 * cos * cos,
        ];
        for k in 0..2 {
            if let Some(sums) = components.next() {
                let p = if k == 0 { modulus } else { 0.0 };
                self.component(
                    sums,
                    e[k],
                    slopes[k],
                    row.weight,
                    [g[k], g[1 - k], p],
                    row.psf_size,
                );
            }
        }
    }

    fn component(
        self,
        sums: &mut [f64],
        e: f64,
        slope: f64,
        weight: f64,
        [g, other, p]: [f64; 3],
        size: f64,
    ) {
        let n = self.terms();
        let z: [f64; MOST] = [1.0, g, other, g * g, p, p * size];
        let (with_e, matrices) = sums.split_at_mut(n);
        let (with_slope, with_weight) = matrices.split_at_mut(triangle(n));
        let mut at = 0;
        for s in 0..n {
            with_e[s] += weight * e * z[s];
            let scaled = slope * z[s];
            for z in &z[..=s] {
                with_slope[at] += scaled * z;
                at += 1;
            }
        }
        if self.versions {
            let mut at = 0;
            for s in 0..n {
                let scaled = weight * z[s];
                for z in &z[..=s] {
                    with_weight[at] += scaled * z;
                    at += 1;
                }
            }
        }
    }

    /// Adds an ellipticity of a sheared version, or of a galaxy that this version selects.
    pub fn add_version(self, sums: &mut [f64], version: usize, e: [f64; 2], weight: f64) {
        let (_, which) = VERSIONS[version];
        sums[VERSION + 2 * version] += weight * e[which.component];
        sums[VERSION + 2 * version + 1] += weight;
    }

    /// Mean ellipticity.
    pub(crate) fn mean(self, sums: &[f64]) -> [f64; 2] {
        [0, 1].map(|k| self.of(sums, k).with_e[ONE] / sums[WEIGHT])
    }

    /// Mean ellipticity of a version, in its component of shear.
    pub(crate) fn version_mean(self, sums: &[f64], version: usize) -> f64 {
        sums[VERSION + 2 * version] / sums[VERSION + 2 * version + 1]
    }

    /// Changes `sums` as if some of their galaxies, which have the sums `own`, had a larger m and c: e becomes
    /// e + R (m g + c). R is the response of the row plus `extra`.
    pub(crate) fn shift(
        self,
        sums: &mut [f64],
        own: &[f64],
        extra: [f64; 4],
        (m, c): (f64, [f64; 4]),
    ) {
        for k in 0..self.components() {
            let of = self.of(own, k);
            let start = HEAD + k * self.of_component();
            for (s, with_e) in sums[start..][..self.terms()].iter_mut().enumerate() {
                *with_e += m * of.slope(s, OWN, extra[k]) + c[k] * of.slope(s, ONE, extra[k]);
            }
        }
    }

    /// The sums of a component.
    pub(crate) fn of(self, sums: &[f64], component: usize) -> Component<'_> {
        let n = self.terms();
        let start = HEAD + component * self.of_component();
        let own = &sums[start..start + self.of_component()];
        let (with_e, matrices) = own.split_at(n);
        let (with_slope, with_weight) = matrices.split_at(triangle(n));
        Component {
            with_e,
            with_slope,
            with_weight,
        }
    }
}

/// Sums of one component.
pub(crate) struct Component<'a> {
    /// Σ w e z.
    pub(crate) with_e: &'a [f64],
    /// Σ w R z z, the lower triangle by rows.
    with_slope: &'a [f64],
    /// Σ w z z, if there is such a sum.
    with_weight: &'a [f64],
}

impl Component<'_> {
    /// Σ w (R + extra) z_s z_t.
    pub(crate) fn slope(&self, s: usize, t: usize, extra: f64) -> f64 {
        let at = triangle(s.max(t)) + s.min(t);
        let more = self.with_weight.get(at).map_or(0.0, |w| extra * w);
        self.with_slope[at] + more
    }
}

/// Numbers in the lower triangle of an n × n matrix.
const fn triangle(n: usize) -> usize {
    n * (n + 1) / 2
}
