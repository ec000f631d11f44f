//! Radial profiles of round objects: tables, elliptical radii and quadrature nodes.
//!
//! Every profile here is a function of one squared radius, in pixels or in wavenumbers. An ellipse
//! only changes how that squared radius is made from (x, y): see [`QuadraticForm`].

use crate::Shear;

// Intervals to each doubling of the table's argument.
const STEPS_PER_OCTAVE: usize = 1 << STEP_BITS;
const STEP_BITS: u32 = 5;
const OCTAVES: usize = 32;
const INTERVALS: usize = STEPS_PER_OCTAVE * OCTAVES;

// In single precision.
const SINGLE_STEPS_PER_OCTAVE: usize = 1 << SINGLE_STEP_BITS;
const SINGLE_STEP_BITS: u32 = 9;
const SINGLE_INTERVALS: usize = SINGLE_STEPS_PER_OCTAVE * OCTAVES;

// A node of the single-precision table is the value in units of VALUE, and below it in FALL_BITS bits how much less the next
// node is, in halves of it.
const FALL_BITS: u32 = 12;
const VALUE: f32 = 1.0 / ((1 << (32 - FALL_BITS)) - 1) as f32;

/// A smooth function of a squared radius u ≥ 0, which never rises, as cubics on intervals that widen with u.
///
/// With v = 1 + u/`unit`, each doubling of v is divided into 32 equal intervals. Both the doubling
/// and the interval are read off the bits of the floating-point number v, so that a look-up needs
/// neither a logarithm nor a search. 32 doublings are held; beyond them the value is 0.
///
/// The cubics meet the function at both ends of an interval and at a quarter and three quarters
/// of it (Chebyshev–Lobatto points). For (1 + u)^(−3/2) the error is near 4e-8 of the value.
///
/// [`RadialTable::single`] interpolates linearly between 512 nodes to each doubling. Value and slope are in one number,
/// so that a look-up loads from memory once: gathers take most of its time.
#[derive(Debug, Clone)]
pub struct RadialTable {
    per_unit: f64,
    double: Box<[[f64; 4]; INTERVALS]>,
    single: Box<[u32; SINGLE_INTERVALS]>,
}

impl RadialTable {
    /// Tabulates `function(u)`, which is called some 3,000 times.
    ///
    /// Below `unit` the table's intervals are `unit`/32 wide: choose it below the scale on which
    /// the function first changes.
    pub fn new(unit: f64, function: impl Fn(f64) -> f64) -> Self {
        assert!(
            unit > 0.0 && unit.is_finite(),
            "the table's unit must be positive"
        );
        let mut double = Box::new([[0.0; 4]; INTERVALS]);
        let mut start = function(0.0);
        // The last interval stays zero: arguments beyond the table are moved into it.
        for (index, cubic) in double.iter_mut().enumerate().take(INTERVALS - 1) {
            let octave = f64::powi(2.0, (index / STEPS_PER_OCTAVE) as i32);
            let width = octave / STEPS_PER_OCTAVE as f64;
            let v = octave + width * (index % STEPS_PER_OCTAVE) as f64;
            let at = |t: f64| function((v + t * width - 1.0) * unit);
            let [quarter, three_quarters, end] = [at(0.25), at(0.75), at(1.0)];
            // Newton's divided differences at t = 0, 1/4, 3/4, 1, then multiplied out.
            let d01 = (quarter - start) / 0.25;
            let d12 = (three_quarters - quarter) / 0.5;
            let d23 = (end - three_quarters) / 0.25;
            let d012 = (d12 - d01) / 0.75;
            let d123 = (d23 - d12) / 0.75;
            let d0123 = d123 - d012;
            *cubic = [
                start,
                d01 - 0.25 * d012 + 0.1875 * d0123,
                d012 - d0123,
                d0123,
            ];
            start = end;
        }
        let mut table = RadialTable {
            per_unit: 1.0 / unit,
            double,
            single: Box::new([0; SINGLE_INTERVALS]),
        };
        let value = |index: usize| {
            let octave = f64::powi(2.0, (index / SINGLE_STEPS_PER_OCTAVE) as i32);
            let place = (index % SINGLE_STEPS_PER_OCTAVE) as f64;
            let v = octave * (1.0 + place / SINGLE_STEPS_PER_OCTAVE as f64);
            table.at((v - 1.0) * unit) / f64::from(VALUE)
        };
        let nodes = (0..SINGLE_INTERVALS).map(|index| {
            let (here, next) = (value(index), value(index + 1));
            let fall = (2.0 * (here - next)).round() as u32;
            let here = here.round().min(f64::from(1.0 / VALUE)) as u32;
            here << FALL_BITS | fall.min((1 << FALL_BITS) - 1)
        });
        let nodes: Vec<u32> = nodes.collect();
        table.single.copy_from_slice(&nodes);
        table
    }

    /// The function at squared radius `u` ≥ 0.
    #[inline]
    pub fn at(&self, u: f64) -> f64 {
        const FRACTION: u32 = 52 - STEP_BITS;
        let bits = self.bits_of(u);
        let [c0, c1, c2, c3] = self.double[(bits >> FRACTION) as usize & (INTERVALS - 1)];
        let t = (bits & ((1 << FRACTION) - 1)) as f64 * (1.0 / (1u64 << FRACTION) as f64);
        c0 + t * (c1 + t * (c2 + t * c3))
    }

    #[inline]
    fn bits_of(&self, u: f64) -> u64 {
        // Just under 2^32, inside the last interval.
        const LAST: f64 = 4_294_967_295.0;
        (1.0 + u * self.per_unit).clamp(1.0, LAST).to_bits() - 1.0f64.to_bits()
    }

    /// The same in single precision, in a form that the compiler can turn into vector code. For functions from 1 to 0 that
    /// change by at most 1 if ln v changes by 1.
    pub fn single(&self) -> SingleTable<'_> {
        SingleTable {
            per_unit: self.per_unit as f32,
            nodes: &self.single,
        }
    }
}

/// A [`RadialTable`] in single precision.
#[derive(Debug, Clone, Copy)]
pub struct SingleTable<'a> {
    per_unit: f32,
    nodes: &'a [u32; SINGLE_INTERVALS],
}

impl SingleTable<'_> {
    /// The function at squared radius `u` ≥ 0. It has the units of the table, which are 7e-7, and the error of linear
    /// interpolation, up to 2e-6 of the value for (1 + u)^(−3/2).
    #[inline(always)]
    pub fn at(self, u: f32) -> f32 {
        const FRACTION: u32 = 23 - SINGLE_STEP_BITS;
        // The largest f32 under 2^32.
        const LAST: f32 = 4_294_967_040.0;
        let v = (1.0 + u * self.per_unit).min(LAST);
        let bits = v.to_bits().wrapping_sub(1.0f32.to_bits());
        let index = (bits >> FRACTION) as usize & (SINGLE_INTERVALS - 1);
        let node = self.nodes[index];
        let half_t =
            (bits & ((1 << FRACTION) - 1)) as i32 as f32 * (0.5 / (1u32 << FRACTION) as f32);
        let value = (node >> FALL_BITS) as i32 as f32;
        let fall = (node & ((1 << FALL_BITS) - 1)) as i32 as f32;
        VALUE * (value - half_t * fall)
    }
}

/// xx·x² + 2·xy·x·y + yy·y²: the squared radius of a round profile that a shear made elliptical.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QuadraticForm {
    /// Coefficient of x².
    pub xx: f64,
    /// Half the coefficient of xy.
    pub xy: f64,
    /// Coefficient of y².
    pub yy: f64,
}

impl QuadraticForm {
    /// The squared circular radius at a position: |S⁻¹x|², S being [`Shear::matrix`].
    pub fn of_positions(shape: Shear) -> Self {
        // S has determinant 1, so its inverse is the matrix of the opposite shear.
        Self::of_wavenumbers(Shear::new(-shape.e1, -shape.e2))
    }

    /// The squared circular wavenumber at a wave vector: |Sᵀk|², S being [`Shear::matrix`].
    pub fn of_wavenumbers(shape: Shear) -> Self {
        let [[a, b], [c, d]] = shape.matrix();
        QuadraticForm {
            xx: a * a + c * c,
            xy: a * b + c * d,
            yy: b * b + d * d,
        }
    }

    /// The form times a number.
    pub fn scaled(self, by: f64) -> Self {
        QuadraticForm {
            xx: self.xx * by,
            xy: self.xy * by,
            yy: self.yy * by,
        }
    }

    /// The form's value.
    #[inline]
    pub fn at(self, x: f64, y: f64) -> f64 {
        self.xx * x * x + 2.0 * self.xy * x * y + self.yy * y * y
    }
}

/// Nodes and weights of the `n`-point Gauss–Legendre rule on (−1, 1); the weights sum to 2.
pub fn gauss_legendre(n: usize) -> Vec<(f64, f64)> {
    (0..n)
        .map(|i| {
            let mut x = ((i as f64 + 0.75) / (n as f64 + 0.5) * std::f64::consts::PI).cos();
            let mut slope = 1.0;
            for _ in 0..100 {
                // Legendre's recurrence up to degree n.
                let (mut last, mut now) = (1.0, x);
                for j in 2..=n {
                    let j = j as f64;
                    (last, now) = (now, ((2.0 * j - 1.0) * x * now - (j - 1.0) * last) / j);
                }
                slope = n as f64 * (x * now - last) / (x * x - 1.0);
                let step = now / slope;
                x -= step;
                if step.abs() < 1e-15 {
                    break;
                }
            }
            (x, 2.0 / ((1.0 - x * x) * slope * slope))
        })
        .collect()
}

/// Nodes and weights that integrate over (`from`, `to`), cut into `panels` equal parts with an
/// `order`-point Gauss–Legendre rule in each.
pub fn composite_rule(from: f64, to: f64, panels: usize, order: usize) -> Vec<(f64, f64)> {
    let rule = gauss_legendre(order);
    let half = 0.5 * (to - from) / panels as f64;
    (0..panels)
        .flat_map(|panel| {
            let middle = from + half * (2 * panel + 1) as f64;
            rule.iter()
                .map(move |&(x, w)| (middle + half * x, half * w))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_follows_the_function_in_both_precisions() {
        let f = |u: f64| (1.0 + u).powf(-1.5);
        let table = RadialTable::new(0.1, f);
        let single = table.single();
        for i in 0..200_000 {
            let u = 1e-7 * (i as f64 * 1.5e-4).exp();
            if u > 1e8 {
                break;
            }
            assert!((table.at(u) / f(u) - 1.0).abs() < 1e-7, "u = {u}");
            // f″ h²/8 is 1.8e-6 of f for intervals h of 1/512 of v, and f32 adds 1e-7. Half of a value's unit and half
            // of a fall's are 7.2e-7.
            let error = (f64::from(single.at(u as f32)) - f(u)).abs();
            assert!(error < 2e-6 * f(u) + 7.2e-7, "u = {u}: {error}");
        }
        assert_eq!(table.at(0.0), 1.0);
        assert!((single.at(0.0) - 1.0).abs() <= f32::EPSILON);
    }

    #[test]
    fn table_is_zero_beyond_its_end() {
        let table = RadialTable::new(1.0, |_| 1.0);
        assert_eq!(table.at(4.0e9), 1.0);
        assert_eq!(table.at(1e30), 0.0);
        assert_eq!(table.single().at(1e30), 0.0);
        assert_eq!(table.single().at(f32::INFINITY), 0.0);
    }

    #[test]
    fn gauss_legendre_integrates_polynomials() {
        for n in 1..=20 {
            let rule = gauss_legendre(n);
            for degree in 0..2 * n {
                let sum: f64 = rule.iter().map(|&(x, w)| w * x.powi(degree as i32)).sum();
                let exact = if degree % 2 == 0 {
                    2.0 / (degree + 1) as f64
                } else {
                    0.0
                };
                assert!((sum - exact).abs() < 1e-14, "n = {n}, degree {degree}");
            }
        }
    }

    #[test]
    fn forms_undo_and_apply_the_shear() {
        let shape = Shear::new(0.3, -0.2);
        let [[a, b], [c, d]] = shape.matrix();
        // A point of the unit circle, moved by the shear, has circular radius 1 again.
        let (cos, sin) = (0.6, 0.8);
        let moved = (a * cos + b * sin, c * cos + d * sin);
        assert!((QuadraticForm::of_positions(shape).at(moved.0, moved.1) - 1.0).abs() < 1e-14);
        let k = (a * 0.7 + c * 0.2, b * 0.7 + d * 0.2);
        let form = QuadraticForm::of_wavenumbers(shape).at(0.7, 0.2);
        assert!((form - (k.0 * k.0 + k.1 * k.1)).abs() < 1e-14);
    }
}
