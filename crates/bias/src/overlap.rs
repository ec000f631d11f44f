//! Whether two measurements are of the same galaxies.

use shearq_quantities::statistics::upper_median;

use crate::arms::{Unit, Units};
use crate::design::ENOUGH_TO_CORRELATE;
use crate::sums::{Layout, WEIGHT, add};

/// What the units of two measurements have in common.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overlap {
    /// The part of the galaxies of both that is in units which both have.
    pub shared: f64,
    /// The quadrant correlation of the ellipticities in these units (Blomqvist 1950, Annals of Mathematical Statistics 21,
    /// 593), which one galaxy with a large response does not change; `None` if they are too few.
    pub correlation: Option<f64>,
}

// Below it most units have no partner, whatever a changed code flags. Chosen by hand.
const MIN_SHARED: f64 = 0.5;
// The value below which galaxies are different ones: noise of 1.5 times the shapes leaves 0.19.
const MIN_CORRELATION: f64 = 0.1;

impl Overlap {
    /// Whether most galaxies are in units that both have.
    pub fn is_shared(&self) -> bool {
        self.shared >= MIN_SHARED
    }

    /// Whether most galaxies are in units that both have, and their ellipticities do not show that they are others. Paired errors are
    /// then right.
    pub fn is_of_same_galaxies(&self) -> bool {
        self.is_shared() && self.correlation.is_none_or(|own| own >= MIN_CORRELATION)
    }
}

impl Units {
    /// What these and other units have in common.
    pub fn overlap(&self, other: &Units) -> Overlap {
        let sides = self.all_bins().aligned(&other.all_bins());
        let pairs = Units::pairs(&sides, 0);
        let (mut all, mut shared) = (0.0, 0.0);
        let mut numbers: [Vec<[f64; 2]>; 2] = Default::default();
        for pair in &pairs {
            // Sums of one side alone may have the PSF or sheared catalogues.
            let own = [0, 1].map(|side| {
                let unit = pair[side].as_ref()?;
                Some(of_unit(sides[side].layout(), unit))
            });
            let galaxies: f64 = own.iter().flatten().map(|(count, _)| count).sum();
            all += galaxies;
            let [Some((_, a)), Some((_, b))] = own else {
                continue;
            };
            shared += galaxies;
            for k in 0..2 {
                if a[k].is_finite() && b[k].is_finite() {
                    numbers[k].push([a[k], b[k]]);
                }
            }
        }
        let signs: Vec<f64> = numbers.iter().flat_map(|own| signs(own)).collect();
        let count = signs.len();
        Overlap {
            shared: if all > 0.0 { shared / all } else { 0.0 },
            correlation: (count >= ENOUGH_TO_CORRELATE)
                .then(|| signs.iter().sum::<f64>() / count as f64),
        }
    }
}

// The number of galaxies and their mean ellipticity, under all shears together.
fn of_unit(layout: Layout, unit: &Unit<'_>) -> (f64, [f64; 2]) {
    let mut sums = vec![0.0; layout.len()];
    unit.iter().for_each(|(_, own)| add(&mut sums, own));
    let mean = match sums[WEIGHT] > 0.0 {
        true => layout.mean(&sums),
        false => [f64::NAN; 2],
    };
    (layout.counts_and_slopes(&sums).0, mean)
}

// Products of the signs of differences from the medians. Round galaxies without noise are equal to them.
fn signs(pairs: &[[f64; 2]]) -> Vec<f64> {
    let median = |side: usize| {
        let mut all: Vec<f64> = pairs.iter().map(|pair| pair[side]).collect();
        upper_median(&mut all).unwrap_or(0.0)
    };
    let [a, b] = [median(0), median(1)];
    let products = pairs.iter().map(|pair| (pair[0] - a) * (pair[1] - b));
    let signs = products.filter(|own| *own != 0.0).map(f64::signum);
    signs.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Row, UnitSums};

    // A fixed sequence of numbers between −1 and 1.
    fn shape(number: u64) -> f64 {
        let bits = number.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (bits >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    fn units(galaxies: std::ops::Range<u64>, shift: u64, factor: f64) -> Units {
        units_of(Layout::default(), galaxies, shift, factor)
    }

    fn units_of(layout: Layout, galaxies: std::ops::Range<u64>, shift: u64, factor: f64) -> Units {
        weighted(layout, galaxies, shift, factor, |_| 1.0)
    }

    fn weighted(
        layout: Layout,
        galaxies: std::ops::Range<u64>,
        shift: u64,
        factor: f64,
        weight: impl Fn(u64) -> f64,
    ) -> Units {
        let mut sums = UnitSums::new(layout, 1, 1);
        for galaxy in galaxies {
            let e = shape(galaxy);
            let response = 1.0 + 0.1 * shape(galaxy + 2_000_000 + shift);
            let row = Row {
                e: [factor * e, factor * shape(galaxy + 1_000_000)],
                weight: weight(galaxy),
                g: [0.02, 0.02],
                response: [[response, 0.0], [0.0, response]],
                ..Row::default()
            };
            sums.add(0, galaxy + shift, 0, &row);
        }
        sums.by_key(|_| 0)
    }

    #[test]
    fn the_same_galaxies_are_recognised() {
        let own = units(0..1000, 0, 1.0);
        for (other, shared, same) in [
            (units(0..1000, 0, 1.3), 1.0, true),
            (units(0..900, 0, 1.0), 1800.0 / 1900.0, true),
            (units(0..1000, 5000, 1.0), 0.0, false),
            // Other galaxies have some of the names.
            (units(0..1000, 7, 1.0), 0.993, false),
            (units(0..100, 0, 1.0), 200.0 / 1100.0, false),
        ] {
            let found = own.overlap(&other);
            assert!((found.shared - shared).abs() < 1e-9, "{found:?}");
            assert_eq!(found.is_of_same_galaxies(), same, "{found:?}");
        }
        // One side knows the PSF.
        let layout = Layout {
            psf: true,
            ..Layout::default()
        };
        let other = units_of(layout, 0..1000, 0, 1.3);
        for found in [own.overlap(&other), other.overlap(&own)] {
            assert_eq!(found, own.overlap(&units(0..1000, 0, 1.3)));
        }
        // Galaxies without a weight have no ellipticity.
        let some = weighted(Layout::default(), 0..1000, 0, 1.3, |galaxy| {
            (galaxy % 3) as f64
        });
        for found in [own.overlap(&some), some.overlap(&own)] {
            assert!(found.correlation.unwrap() > 0.9, "{found:?}");
        }
        // Too few for a correlation.
        let few = units(0..100, 0, 1.0).overlap(&units(0..100, 7, 1.0));
        assert!(few.correlation.is_none() && few.is_of_same_galaxies());
    }
}
