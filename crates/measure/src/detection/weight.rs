//! The weight of a pixel and its weighted ellipticity as functions of its functionals, with first and second derivatives.

/// Smoothed light v₀; its excess over four neighbours; light M₀₀ and both components of M₂₂ under a Gaussian.
pub(super) const COUNT: usize = 8;
pub(super) const NEIGHBOURS: usize = 4;
pub(super) const LIGHT: usize = 0;
// The first of NEIGHBOURS places.
pub(super) const EXCESS: usize = 1;
pub(super) const M00: usize = EXCESS + NEIGHBOURS;
pub(super) const M22: usize = M00 + 1;

pub(super) type Values = [f64; COUNT];
pub(super) type Square = [Values; COUNT];

/// The steps of the weight in image units, and what moments are divided by.
#[derive(Debug, Clone, Copy)]
pub(super) struct Steps {
    pub(super) threshold: f64,
    pub(super) threshold_half_width: f64,
    pub(super) neighbour_half_width: f64,
    pub(super) neighbour_share: f64,
    pub(super) softening: f64,
}

/// A function of the functionals with its derivatives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Derivatives {
    pub(super) value: f64,
    pub(super) first: Values,
    pub(super) second: Square,
}

impl Derivatives {
    const ZERO: Derivatives = Derivatives {
        value: 0.0,
        first: [0.0; COUNT],
        second: [[0.0; COUNT]; COUNT],
    };

    fn times(&self, other: &Derivatives) -> Derivatives {
        let mut out = Derivatives::ZERO;
        out.value = self.value * other.value;
        for a in 0..COUNT {
            out.first[a] = self.value * other.first[a] + self.first[a] * other.value;
            for b in 0..COUNT {
                out.second[a][b] = self.value * other.second[a][b]
                    + self.first[a] * other.first[b]
                    + self.first[b] * other.first[a]
                    + self.second[a][b] * other.value;
            }
        }
        out
    }
}

impl Steps {
    /// Whether a pixel of this light and its neighbours may have a weight. `slack` is subtracted from all bounds.
    pub(super) fn may_count(&self, light: f64, neighbours: [f64; NEIGHBOURS], slack: f64) -> bool {
        let least = self.threshold - self.threshold_half_width - slack;
        let width = self.neighbour_half_width + self.neighbour_share * light + slack;
        light > least && neighbours.iter().all(|other| light - other > -width)
    }

    /// The weight w = s(v₀) Π s(v₀ − v_j); zero with all its derivatives unless it is positive.
    pub(super) fn weight(&self, u: &Values) -> Option<Derivatives> {
        let width = self.threshold_half_width;
        let [value, slope, curve] = step((u[LIGHT] - self.threshold) / width);
        let mut out = Derivatives::ZERO;
        out.value = value;
        out.first[LIGHT] = slope / width;
        out.second[LIGHT][LIGHT] = curve / (width * width);
        for j in EXCESS..M00 {
            if out.value <= 0.0 {
                return None;
            }
            // The argument t = u_j / (half width + share · v₀), and its derivatives with u_j (a) and v₀ (b).
            let share = self.neighbour_share;
            let width = self.neighbour_half_width + share * u[LIGHT];
            let (a, b) = (1.0 / width, -share * u[j] / (width * width));
            let ab = -share / (width * width);
            let bb = 2.0 * share * share * u[j] / (width * width * width);
            let [value, slope, curve] = step(u[j] / width);
            let mut factor = Derivatives::ZERO;
            factor.value = value;
            (factor.first[j], factor.first[LIGHT]) = (slope * a, slope * b);
            factor.second[j][j] = curve * a * a;
            factor.second[j][LIGHT] = curve * a * b + slope * ab;
            factor.second[LIGHT][j] = factor.second[j][LIGHT];
            factor.second[LIGHT][LIGHT] = curve * b * b + slope * bb;
            out = out.times(&factor);
        }
        (out.value > 0.0).then_some(out)
    }

    /// A component of e = M₂₂/(M₀₀ + C).
    pub(super) fn ellipticity(&self, u: &Values, component: usize) -> Derivatives {
        let at = M22 + component;
        let inverse = 1.0 / (u[M00] + self.softening);
        let e = u[at] * inverse;
        let mut out = Derivatives::ZERO;
        out.value = e;
        (out.first[at], out.first[M00]) = (inverse, -e * inverse);
        out.second[M00][M00] = 2.0 * e * inverse * inverse;
        out.second[M00][at] = -inverse * inverse;
        out.second[at][M00] = out.second[M00][at];
        out
    }

    /// w e of both components; `None` without a weight.
    pub(super) fn weighted(&self, u: &Values) -> Option<(f64, [Derivatives; 2])> {
        let weight = self.weight(u)?;
        let of = |component| weight.times(&self.ellipticity(u, component));
        Some((weight.value, [of(0), of(1)]))
    }
}

/// A step from 0 at t = −1 to 1 at t = 1 with two continuous derivatives: its value and these.
fn step(t: f64) -> [f64; 3] {
    let t = (0.5 * (t + 1.0)).clamp(0.0, 1.0);
    let rest = 1.0 - t;
    [
        t * t * t * (10.0 - 15.0 * t + 6.0 * t * t),
        15.0 * t * t * rest * rest,
        15.0 * t * rest * (rest - t),
    ]
}

/// Σ_ab A_ab B_ab.
pub(super) fn trace(left: &Square, right: &Square) -> f64 {
    let pairs = left.as_flattened().iter().zip(right.as_flattened());
    pairs.map(|(a, b)| a * b).sum()
}

pub(super) fn dot(left: &Values, right: &Values) -> f64 {
    left.iter().zip(right).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::close;

    #[test]
    fn derivatives_are_those_of_differences() {
        let steps = Steps {
            threshold: 7.0,
            threshold_half_width: 2.0,
            neighbour_half_width: 0.8,
            neighbour_share: 0.15,
            softening: 9.0,
        };
        let u = [7.4, 0.3, -0.6, 1.1, -0.2, 11.0, 1.3, -2.1];
        let value = |u: &Values, k: usize| steps.weighted(u).unwrap().1[k].value;
        let moved = |a: usize, h: f64, mut u: Values| {
            u[a] += h;
            u
        };
        // Differences have errors of h² times third derivatives, below 3.
        let h = 1e-4;
        for k in 0..2 {
            let found = steps.weighted(&u).unwrap().1[k];
            for a in 0..COUNT {
                let [up, down] = [h, -h].map(|h| moved(a, h, u));
                let slope = (value(&up, k) - value(&down, k)) / (2.0 * h);
                close(found.first[a], slope, 1e-7);
                for b in 0..COUNT {
                    let [up, down] = [up, down].map(|u| steps.weighted(&u).unwrap().1[k].first[b]);
                    close(found.second[a][b], (up - down) / (2.0 * h), 1e-7);
                }
            }
        }
    }

    #[test]
    fn a_pixel_without_weight_may_not_count() {
        let steps = Steps {
            threshold: 7.0,
            threshold_half_width: 2.0,
            neighbour_half_width: 0.8,
            neighbour_share: 0.15,
            softening: 9.0,
        };
        for light in [4.9, 5.1, 7.0, 30.0] {
            for excess in [-6.0, -2.1, -1.6, -0.5, 3.0] {
                let u = [light, excess, 1.0, 1.0, 1.0, 5.0, 0.0, 0.0];
                let counts = steps.may_count(light, [1, 2, 3, 4].map(|j| light - u[j]), 0.0);
                assert_eq!(counts, steps.weight(&u).is_some(), "{light} {excess}");
            }
        }
    }
}
