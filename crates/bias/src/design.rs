//! How catalogues belong together.

use serde::{Deserialize, Serialize};

use crate::stars::{Behind, StarNoise, shared};
use crate::units::UnitSums;

/// Smallest and largest value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Range {
    /// Smallest value.
    pub low: f64,
    /// Largest value.
    pub high: f64,
}

impl Default for Range {
    fn default() -> Self {
        Range {
            low: f64::MAX,
            high: f64::MIN,
        }
    }
}

impl Range {
    /// Includes a value.
    pub fn add(&mut self, value: f64) {
        self.low = self.low.min(value);
        self.high = self.high.max(value);
    }

    /// The value, if all are equal.
    pub fn constant(self) -> Option<f64> {
        (self.low == self.high).then_some(self.low)
    }
}

/// What is known of a catalogue.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Catalogue {
    /// Its name.
    pub name: String,
    /// Rows.
    pub rows: u64,
    /// Rows with a flag.
    pub flagged: u64,
    /// Rows with a weight of zero or less.
    pub unweighted: u64,
    /// Rows that the selection leaves out.
    pub unselected: u64,
    /// Rows with a missing value, if those are left out.
    pub missing: u64,
    /// True shears g1 and g2.
    pub shear: [Range; 2],
    /// Ellipticities e1 and e2.
    pub ellipticity: [Range; 2],
    /// The noise of the star that is the PSF of all its galaxies, if it is known.
    #[serde(default)]
    pub star: Option<StarNoise>,
}

impl Catalogue {
    /// The true shear, if all galaxies have the same.
    fn constant(&self) -> Option<[f64; 2]> {
        let [a, b] = self.shear.map(Range::constant);
        Some([a?, b?])
    }
}

/// How catalogues belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Design {
    /// Without true shear: only mean ellipticities and leakage follow.
    Null,
    /// One true shear.
    Single,
    /// Shears +γ and −γ of the same galaxies.
    Pairs,
    /// Several pairs of shears, ±g1, ±g2 and possibly zero with other PSFs.
    Arms,
    /// Catalogues with a shear each.
    Fields,
    /// Shears that vary within catalogues.
    Galaxies,
    /// Galaxies that are rotated by 90 degrees, in neighbouring rows or catalogues.
    Rotated,
}

impl Design {
    /// Name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Design::Null => "null",
            Design::Single => "single",
            Design::Pairs => "pairs",
            Design::Arms => "arms",
            Design::Fields => "fields",
            Design::Galaxies => "galaxies",
            Design::Rotated => "rotated",
        }
    }

    /// What it is, in words.
    pub fn meaning(self) -> &'static str {
        match self {
            Design::Null => "no true shear",
            Design::Single => "one true shear",
            Design::Pairs => "pairs of shears +γ and −γ",
            Design::Arms => "arms of shears ±g1 and ±g2",
            Design::Fields => "one true shear per catalogue",
            Design::Galaxies => "true shears that vary within catalogues",
            Design::Rotated => "pairs of galaxies rotated by 90 degrees",
        }
    }

    /// Recognises a design from the true shears. Rotated pairs are not recognised.
    pub fn of(catalogues: &[Catalogue], truth: bool) -> Self {
        let used = || catalogues.iter().filter(|catalogue| catalogue.rows > 0);
        if !truth {
            return Design::Null;
        }
        let shears: Option<Vec<[f64; 2]>> = used().map(Catalogue::constant).collect();
        let Some(shears) = shears else {
            return Design::Galaxies;
        };
        let count = |shear: [f64; 2]| shears.iter().filter(|other| **other == shear).count();
        let mut kinds: Vec<[f64; 2]> = Vec::new();
        for shear in &shears {
            if !kinds.contains(shear) {
                kinds.push(*shear);
            }
        }
        // Zero and minus zero are equal.
        let paired = kinds.iter().all(|&[a, b]| count([-a, -b]) == count([a, b]));
        match (kinds.len(), paired) {
            (0 | 1, _) => Design::Single,
            (2, true) => Design::Pairs,
            (_, true) => Design::Arms,
            (_, false) => Design::Fields,
        }
    }
}

/// Units of the errors.
#[derive(Debug, Clone, PartialEq)]
pub struct Grouping {
    /// The sums by unit.
    pub sums: UnitSums,
    /// The galaxies of noisy stars that several units share.
    pub stars: Vec<Behind>,
    /// What a unit is, in words.
    pub unit: &'static str,
    /// Whether galaxies under different shears may be in different units, so that errors are too large.
    pub misaligned: bool,
}

impl Grouping {
    /// The same units with all bins joined to one.
    #[must_use]
    pub fn all_bins(&self) -> Self {
        Grouping {
            sums: self.sums.all_bins(),
            stars: self.stars.iter().map(Behind::all_bins).collect(),
            ..*self
        }
    }
}

/// Fewest groups of catalogues that serve as units. Below, the same rows of all catalogues form a unit.
const FEWEST_GROUPS: usize = 20;

/// Joins sums to units.
///
/// `by_key` forces units of the same keys in all catalogues, or of whole catalogues; `matched` states that keys are
/// identifiers of galaxies rather than numbers of rows.
pub fn group(
    sums: UnitSums,
    catalogues: &[Catalogue],
    design: Design,
    by_key: Option<bool>,
    matched: bool,
) -> Grouping {
    let numbers = numbers(catalogues, design);
    let noises: Vec<Option<&StarNoise>> = catalogues.iter().map(|own| own.star.as_ref()).collect();
    let groups = numbers.iter().max().map_or(0, |last| *last as usize + 1);
    if !by_key.unwrap_or(groups < FEWEST_GROUPS) {
        let stars = shared(&sums, &noises, Some(&numbers));
        let sums = sums.by_group(|catalogue| {
            let number = numbers.get(catalogue as usize);
            number.copied().unwrap_or(catalogue)
        });
        let unit = match design {
            Design::Pairs | Design::Rotated => "pairs of catalogues",
            Design::Arms => "sets of catalogues with one catalogue per shear",
            _ => "catalogues",
        };
        return Grouping {
            sums,
            stars,
            unit,
            misaligned: false,
        };
    }
    let rows = catalogues.iter().map(|catalogue| catalogue.rows);
    let paired = matches!(design, Design::Pairs | Design::Arms | Design::Rotated);
    let differ = rows.clone().min() != rows.max();
    Grouping {
        stars: shared(&sums, &noises, None),
        sums: sums.by_key(),
        unit: match (matched, catalogues.len()) {
            (true, _) => "galaxies with the same identifier",
            (false, 1) => "galaxies in blocks of neighbouring rows",
            (false, _) => "the same rows of all catalogues",
        },
        misaligned: paired && !matched && differ,
    }
}

/// The group of each catalogue: the k-th catalogues of each shear belong together.
fn numbers(catalogues: &[Catalogue], design: Design) -> Vec<u32> {
    let number = |k: usize| -> usize {
        match design {
            Design::Pairs | Design::Arms => {
                let own = catalogues[k].constant();
                let same = |other: &&Catalogue| other.constant() == own;
                catalogues[..k].iter().filter(same).count()
            }
            Design::Rotated => k / 2,
            _ => k,
        }
    };
    (0..catalogues.len()).map(|k| number(k) as u32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn catalogues(shears: &[[f64; 2]]) -> Vec<Catalogue> {
        let range = |value| Range {
            low: value,
            high: value,
        };
        let of = |shear: &[f64; 2]| Catalogue {
            rows: 1,
            shear: shear.map(range),
            ..Catalogue::default()
        };
        shears.iter().map(of).collect()
    }

    #[test]
    fn designs_are_recognised_from_the_true_shears() {
        let of = |shears: &[[f64; 2]]| Design::of(&catalogues(shears), true);
        let (plus, minus) = ([0.02, 0.0], [-0.02, 0.0]);
        assert_eq!(of(&[plus]), Design::Single);
        assert_eq!(of(&[plus, minus, plus, minus]), Design::Pairs);
        assert_eq!(of(&[plus, minus, [0.0, 0.02], [0.0, -0.02]]), Design::Arms);
        assert_eq!(of(&[plus, minus, plus]), Design::Fields);
        assert_eq!(of(&[plus, [0.01, 0.0]]), Design::Fields);
        let mut varying = catalogues(&[plus]);
        varying[0].shear[1].add(0.5);
        assert_eq!(Design::of(&varying, true), Design::Galaxies);
        assert_eq!(Design::of(&varying, false), Design::Null);
    }

    #[test]
    fn the_same_catalogue_of_each_shear_belongs_to_a_group() {
        let (plus, minus) = ([0.02, 0.0], [-0.02, 0.0]);
        let shears = catalogues(&[plus, plus, minus, minus]);
        assert_eq!(numbers(&shears, Design::Pairs), [0, 1, 0, 1]);
        assert_eq!(numbers(&shears, Design::Rotated), [0, 0, 1, 1]);
        assert_eq!(numbers(&shears, Design::Fields), [0, 1, 2, 3]);
    }
}
