//! What is known of a catalogue, and which catalogues have the same shear.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use crate::stars::StarNoise;

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

/// Numbers of two columns, or of one that is named twice, that many rows share exactly, such as zeros for failed
/// measurements. They are reported, not removed: only the user can decide whether they are measurements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Repeated {
    /// The columns.
    pub columns: [String; 2],
    /// The numbers.
    pub values: [f64; 2],
    /// The rows that have them and count.
    pub rows: u64,
}

/// A row that has much of the sum of all responses. It is reported, not removed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Dominant {
    /// The row, from 1.
    pub row: u64,
    /// The component, 0 or 1.
    pub component: usize,
    /// Its response, times its weight.
    pub response: f64,
    /// The mean of all rows that count.
    pub mean: f64,
    /// The part of the sum that it has.
    pub share: f64,
}

/// What is known of a catalogue: its rows, how many of them do not count and why, and its ranges. A row is counted in the
/// first of these reasons that applies.
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
    /// Rows with a number that stands for a failed measurement, such as −99, if those are left out.
    pub failed: u64,
    /// Rows with a distortion above 1, to which no shear belongs. Noise makes them.
    pub above_one: u64,
    /// Rows that do not count because the galaxy does not count under all test shears.
    pub without_partner: u64,
    /// Rows that count with |e| above 1, and above 2.
    pub beyond: [u64; 2],
    /// Pairs of numbers that many rows share exactly.
    pub repeated: Vec<Repeated>,
    /// Rows that have the numbers of an earlier row, if these are not few.
    pub copies: u64,
    /// Rows that have the identifier of an earlier row, if these are not few.
    pub shared_identifiers: u64,
    /// Comparisons with a text, such as `band == 'r'`, that no row fulfils.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unmatched: Vec<String>,
    /// A sum over the rows that count that no other galaxies have; 0 without rows.
    pub content: u64,
    /// A row with much of the response.
    pub dominant: Option<Dominant>,
    /// Range of the true shears g1 and g2 of the rows that count. Designs are recognised from it.
    pub shear: [Range; 2],
    /// Range of the ellipticities e1 and e2 of the rows that count.
    pub ellipticity: [Range; 2],
    /// The noise of the star that is the PSF of all its galaxies, if it is known.
    pub star: Option<StarNoise>,
    /// The fingerprint of the image that it was measured on, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<String>,
}

impl Catalogue {
    /// Rows that count.
    pub fn counted(&self) -> u64 {
        let excluded = [
            self.flagged,
            self.unweighted,
            self.unselected,
            self.missing,
            self.failed,
            self.above_one,
            self.without_partner,
        ];
        self.rows.saturating_sub(excluded.iter().sum())
    }

    /// The true shear, if all galaxies have the same.
    pub fn constant(&self) -> Option<[f64; 2]> {
        let [a, b] = self.shear.map(Range::constant);
        Some([a?, b?])
    }
}

// Largest relative difference of equal shears: single precision rounds by 6·10⁻⁸, and FITS tables in it did not pair with
// tables of double precision.
const ROUNDING: f64 = 1e-6;

pub(crate) fn same(a: [f64; 2], b: [f64; 2]) -> bool {
    let modulus = a[0].hypot(a[1]).max(b[0].hypot(b[1]));
    (a[0] - b[0]).hypot(a[1] - b[1]) <= ROUNDING * modulus
}

// Side of the cells in which equal shears are looked for: twice the largest difference of equal ones, whose modulus is below 1.
const CELL: f64 = 2.0 * ROUNDING;

/// Different shears, in the order in which they appear, each found in a time that does not depend on their number.
#[derive(Debug, Default)]
pub(crate) struct Kinds {
    pub(crate) shears: Vec<[f64; 2]>,
    cells: HashMap<[i64; 2], Vec<usize>>,
}

impl Kinds {
    pub(crate) fn of(shears: &[[f64; 2]]) -> Self {
        let mut kinds = Kinds::default();
        for &shear in shears {
            if kinds.place(shear).is_none() {
                let cell = Self::cell(shear);
                kinds
                    .cells
                    .entry(cell)
                    .or_default()
                    .push(kinds.shears.len());
                kinds.shears.push(shear);
            }
        }
        kinds
    }

    fn cell(shear: [f64; 2]) -> [i64; 2] {
        shear.map(|g| (g / CELL).floor() as i64)
    }

    /// The place of a shear, that of the first of several that are as near.
    pub(crate) fn place(&self, shear: [f64; 2]) -> Option<usize> {
        let [a, b] = Self::cell(shear);
        let near = (-1..=1).flat_map(|i| (-1..=1).map(move |j| [a + i, b + j]));
        let near = near.filter_map(|cell| self.cells.get(&cell)).flatten();
        let equal = near.filter(|place| same(self.shears[**place], shear));
        equal.min().copied()
    }

    /// How many of `shears` each kind has.
    pub(crate) fn counts(&self, shears: &[[f64; 2]]) -> Vec<usize> {
        let mut counts = vec![0; self.shears.len()];
        for place in shears.iter().filter_map(|shear| self.place(*shear)) {
            counts[place] += 1;
        }
        counts
    }

    /// The number in `counts` of minus a shear.
    pub(crate) fn opposite(&self, [a, b]: [f64; 2], counts: &[usize]) -> usize {
        self.place([-a, -b]).map_or(0, |place| counts[place])
    }
}

/// The arm of each catalogue: those of one true shear are an arm, and all with varying shear.
pub(crate) fn arms(catalogues: &[Catalogue]) -> Vec<u32> {
    let shears: Vec<[f64; 2]> = catalogues.iter().filter_map(Catalogue::constant).collect();
    let kinds = Kinds::of(&shears);
    let arm = |own: &Catalogue| {
        let kind = own.constant().and_then(|shear| kinds.place(shear));
        kind.unwrap_or(kinds.shears.len()) as u32
    };
    catalogues.iter().map(arm).collect()
}
