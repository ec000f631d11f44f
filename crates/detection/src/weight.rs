//! The weight of a pixel and its weighted ellipticity as functions of its functionals, with first and second derivatives.

use shearq_quantities::jet::{Jet, step};

/// Smoothed light v₀; its excess over four neighbours; light M₀₀ and both components of M₂₂ under a Gaussian.
pub(crate) const COUNT: usize = 8;
pub(crate) const NEIGHBOURS: usize = 4;
pub(crate) const LIGHT: usize = 0;
// The first of NEIGHBOURS places.
pub(crate) const EXCESS: usize = 1;
pub(crate) const M00: usize = EXCESS + NEIGHBOURS;
pub(crate) const M22: usize = M00 + 1;

pub(crate) type Values = [f64; COUNT];
pub(crate) type Square = [Values; COUNT];

/// The steps of the weight in image units, and what moments are divided by.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Steps {
    pub(crate) threshold: f64,
    pub(crate) threshold_half_width: f64,
    pub(crate) neighbour_half_width: f64,
    pub(crate) neighbour_share: f64,
    pub(crate) softening: f64,
}

impl Steps {
    /// Whether a pixel of this light and its neighbours may have a weight. `slack` is subtracted from all bounds.
    pub(crate) fn may_count(&self, light: f64, neighbours: [f64; NEIGHBOURS], slack: f64) -> bool {
        let least = self.threshold - self.threshold_half_width - slack;
        let width = self.neighbour_half_width + self.neighbour_share * light + slack;
        light > least && neighbours.iter().all(|other| light - other > -width)
    }

    /// The weight w = s(v₀) Π s(v₀ − v_j); `None` unless it is positive.
    pub(crate) fn weight(&self, u: &Values) -> Option<Jet<COUNT>> {
        let light = Jet::variable(LIGHT, u[LIGHT]);
        let above = (light + -self.threshold) * (1.0 / self.threshold_half_width);
        let mut weight = above.map(step(above.value));
        for j in EXCESS..M00 {
            if weight.value <= 0.0 {
                return None;
            }
            let [light, excess] = [Jet::<2>::variable(0, u[LIGHT]), Jet::variable(1, u[j])];
            let t = excess / (light * self.neighbour_share + self.neighbour_half_width);
            weight = weight * t.map(step(t.value)).among([LIGHT, j]);
        }
        (weight.value > 0.0).then_some(weight)
    }

    /// A component of e = M₂₂/(M₀₀ + C).
    pub(crate) fn ellipticity(&self, u: &Values, component: usize) -> Jet<COUNT> {
        let moment = M22 + component;
        let [light, shape] = [Jet::<2>::variable(0, u[M00]), Jet::variable(1, u[moment])];
        (shape / (light + self.softening)).among([M00, moment])
    }

    /// w e of both components; `None` without a weight.
    pub(crate) fn weighted(&self, u: &Values) -> Option<(f64, [Jet<COUNT>; 2])> {
        let weight = self.weight(u)?;
        let of = |component| weight * self.ellipticity(u, component);
        Some((weight.value, [of(0), of(1)]))
    }
}

/// Σ_ab A_ab B_ab.
pub(crate) fn trace(left: &Square, right: &Square) -> f64 {
    let pairs = left.as_flattened().iter().zip(right.as_flattened());
    pairs.map(|(a, b)| a * b).sum()
}

pub(crate) fn dot(left: &Values, right: &Values) -> f64 {
    left.iter().zip(right).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::close;

    const STEPS: Steps = Steps {
        threshold: 7.0,
        threshold_half_width: 2.0,
        neighbour_half_width: 0.8,
        neighbour_share: 0.15,
        softening: 9.0,
    };

    #[test]
    fn derivatives_are_those_of_differences() {
        let u = [7.4, 0.3, -0.6, 1.1, -0.2, 11.0, 1.3, -2.1];
        let value = |u: &Values, k: usize| STEPS.weighted(u).unwrap().1[k].value;
        let moved = |a: usize, h: f64, mut u: Values| {
            u[a] += h;
            u
        };
        // Differences have errors of h² times third derivatives, below 3.
        let h = 1e-4;
        for k in 0..2 {
            let found = STEPS.weighted(&u).unwrap().1[k];
            for a in 0..COUNT {
                let [up, down] = [h, -h].map(|h| moved(a, h, u));
                let slope = (value(&up, k) - value(&down, k)) / (2.0 * h);
                close(found.first[a], slope, 1e-7);
                for b in 0..COUNT {
                    let [up, down] = [up, down].map(|u| STEPS.weighted(&u).unwrap().1[k].first[b]);
                    close(found.second[a][b], (up - down) / (2.0 * h), 1e-7);
                }
            }
        }
    }

    #[test]
    fn a_pixel_without_weight_may_not_count() {
        for light in [4.9, 5.1, 7.0, 30.0] {
            for excess in [-6.0, -2.1, -1.6, -0.5, 3.0] {
                let u = [light, excess, 1.0, 1.0, 1.0, 5.0, 0.0, 0.0];
                let counts = STEPS.may_count(light, [1, 2, 3, 4].map(|j| light - u[j]), 0.0);
                assert_eq!(counts, STEPS.weight(&u).is_some(), "{light} {excess}");
            }
        }
    }
}
