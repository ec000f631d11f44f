//! Functions of several variables with their first and second derivatives, so that responses to shear read like their formulas.

use std::ops::{Add, Div, Mul};

/// The value of a function at a place, with its derivatives with N variables.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jet<const N: usize> {
    /// The value.
    pub value: f64,
    /// ∂f/∂x_a.
    pub first: [f64; N],
    /// ∂²f/∂x_a ∂x_b.
    pub second: [[f64; N]; N],
}

/// A smooth step from 0 at t = −1 to 1 at t = 1, whose first two derivatives vanish at both ends: its value and these.
/// NaN is below the step, and infinity above it.
pub fn step(t: f64) -> [f64; 3] {
    let u = 0.5 * (t + 1.0);
    let u = if u.is_nan() { 0.0 } else { u.clamp(0.0, 1.0) };
    let rest = 1.0 - u;
    [
        u * u * u * (10.0 - 15.0 * u + 6.0 * u * u),
        15.0 * u * u * rest * rest,
        15.0 * u * rest * (rest - u),
    ]
}

impl<const N: usize> Jet<N> {
    /// A function of no variable.
    pub const fn constant(value: f64) -> Self {
        Jet {
            value,
            first: [0.0; N],
            second: [[0.0; N]; N],
        }
    }

    /// The variable `index` where it has this value.
    ///
    /// # Panics
    /// Unless `index` is below N.
    pub const fn variable(index: usize, value: f64) -> Self {
        let mut jet = Jet::constant(value);
        jet.first[index] = 1.0;
        jet
    }

    /// A function of this one, by its value and its first two derivatives here. A derivative of zero leaves out what it multiplies,
    /// which may be infinite.
    #[must_use]
    pub fn map(self, [value, first, second]: [f64; 3]) -> Self {
        if first == 0.0 && second == 0.0 {
            return Jet::constant(value);
        }
        let chain =
            |a: usize, b: usize| first * self.second[a][b] + second * self.first[a] * self.first[b];
        Jet {
            value,
            first: self.first.map(|of| first * of),
            second: std::array::from_fn(|a| std::array::from_fn(|b| chain(a, b))),
        }
    }

    /// The same function with M variables, of which its own are those of these places.
    ///
    /// # Panics
    /// Unless all places are below M.
    #[must_use]
    pub fn among<const M: usize>(&self, places: [usize; N]) -> Jet<M> {
        let mut jet = Jet::constant(self.value);
        for a in 0..N {
            jet.first[places[a]] = self.first[a];
            for b in 0..N {
                jet.second[places[a]][places[b]] = self.second[a][b];
            }
        }
        jet
    }
}

impl<const N: usize> Add<f64> for Jet<N> {
    type Output = Self;

    fn add(mut self, other: f64) -> Self {
        self.value += other;
        self
    }
}

impl<const N: usize> Mul<f64> for Jet<N> {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        Jet {
            value: self.value * factor,
            first: self.first.map(|own| own * factor),
            second: self.second.map(|row| row.map(|own| own * factor)),
        }
    }
}

impl<const N: usize> Mul for Jet<N> {
    type Output = Self;

    #[expect(
        clippy::suspicious_arithmetic_impl,
        reason = "derivatives of a product are sums"
    )]
    fn mul(self, other: Self) -> Self {
        let product = |a: usize, b: usize| {
            self.second[a][b] * other.value
                + self.first[a] * other.first[b]
                + self.first[b] * other.first[a]
                + self.value * other.second[a][b]
        };
        Jet {
            value: self.value * other.value,
            first: std::array::from_fn(|a| {
                self.first[a] * other.value + self.value * other.first[a]
            }),
            second: std::array::from_fn(|a| std::array::from_fn(|b| product(a, b))),
        }
    }
}

impl<const N: usize> Div for Jet<N> {
    type Output = Self;

    #[expect(
        clippy::suspicious_arithmetic_impl,
        reason = "derivatives of a ratio are products and differences"
    )]
    fn div(self, other: Self) -> Self {
        // From f = q g: f′ = q′ g + q g′, and so on.
        let value = self.value / other.value;
        let first: [f64; N] =
            std::array::from_fn(|a| (self.first[a] - value * other.first[a]) / other.value);
        let second = |a: usize, b: usize| {
            let mixed = first[a] * other.first[b] + first[b] * other.first[a];
            (self.second[a][b] - mixed - value * other.second[a][b]) / other.value
        };
        Jet {
            value,
            first,
            second: std::array::from_fn(|a| std::array::from_fn(|b| second(a, b))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // Where the step is between its ends.
    fn function([x, y, z]: [f64; 3]) -> f64 {
        let t = (x * y + 0.7) / (2.0 * z);
        step(t)[0] * y / x
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let place = [0.6, -0.9, 1.3];
        let at = |mut place: [f64; 3], a: usize, h: f64| {
            place[a] += h;
            place
        };
        let jet = |[x, y, z]: [f64; 3]| {
            let [x, y, z] = [(0, x), (1, y), (2, z)].map(|(k, value)| Jet::<3>::variable(k, value));
            let t = (x * y + 0.7) / (z * 2.0);
            t.map(step(t.value)) * y / x
        };
        let found = jet(place);
        // Differences have errors of h² times third derivatives, below 20, and of rounding over h.
        let (h, tolerance) = (1e-4, 1e-6);
        assert!((found.value - function(place)).abs() < 1e-15);
        for a in 0..3 {
            let [up, down] = [at(place, a, h), at(place, a, -h)];
            let slope = (function(up) - function(down)) / (2.0 * h);
            assert!((found.first[a] - slope).abs() < tolerance, "{a}");
            for b in 0..3 {
                let curve = (jet(up).first[b] - jet(down).first[b]) / (2.0 * h);
                assert!((found.second[a][b] - curve).abs() < tolerance, "{a} {b}");
            }
        }
    }

    #[test]
    fn places_keep_derivatives() {
        let own = Jet::<2> {
            value: 1.0,
            first: [2.0, 3.0],
            second: [[4.0, 5.0], [5.0, 6.0]],
        };
        let among = own.among::<4>([3, 1]);
        assert_eq!(among.first, [0.0, 3.0, 0.0, 2.0]);
        assert_eq!(among.second[3], [0.0, 5.0, 0.0, 4.0]);
        assert_eq!(among.second[1], [0.0, 6.0, 0.0, 5.0]);
    }

    #[test]
    fn a_step_ends_where_it_should() {
        assert_eq!(step(-1.0), [0.0; 3]);
        assert_eq!(step(1.0), [1.0, 0.0, 0.0]);
        assert_eq!(step(f64::INFINITY), step(2.0));
        assert_eq!(step(f64::NAN), step(f64::NEG_INFINITY));
        assert_eq!(step(0.0)[0], 0.5);
        let beyond = Jet::<1> {
            value: f64::INFINITY,
            first: [f64::INFINITY],
            second: [[0.0]],
        };
        assert_eq!(beyond.map(step(beyond.value)), Jet::constant(1.0));
    }
}
