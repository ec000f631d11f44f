//! Entries that are nearly those of others.

use std::collections::{BTreeMap, BTreeSet};

use shearq_scoring::FieldSum;

use crate::judge::{Entry, EntryInfo};

/// Cells of a set whose mean shapes a store keeps. Two methods that share all galaxies differ by far more than the
/// criterion in any dozen of them.
const CELLS: usize = 32;
/// Shapes are kept as multiples of this.
const STEP: f64 = 1e-7;
/// Largest 1 - r of a near copy, with r the correlation of its shapes. Noise of a thousandth of the shapes has it.
const DECORRELATION: f64 = 1e-6;

/// Mean shapes of some cells, which spread over the field.
pub fn sketch(total: &FieldSum) -> Vec<i32> {
    let (side, cells) = (total.e1.ncols(), total.e1.len());
    let kept = CELLS.min(cells);
    let mean = |sum: f64, count: f64| (sum / count.max(1.0) / STEP).round() as i32;
    (0..kept)
        .map(|k| k * cells / kept)
        .map(|cell| (cell / side, cell % side))
        .flat_map(|cell| [total.e1[cell], total.e2[cell]].map(|sum| mean(sum, total.count[cell])))
        .collect()
}

/// An entry that is nearly an earlier one.
#[derive(Debug, Clone)]
pub struct NearCopy<'a> {
    /// The later entry.
    pub entry: &'a EntryInfo,
    /// The earlier entry.
    pub earlier: &'a EntryInfo,
    /// Files with identical bytes.
    pub files: usize,
    /// 1 - r, with r the correlation of the shapes; NaN without common sets of catalogues.
    pub decorrelation: f64,
}

impl NearCopy<'_> {
    /// What both entries share.
    pub fn reason(&self) -> String {
        let of = self.entry.files.len();
        format!(
            "{} of {of} files are identical, 1 - correlation of the shapes is {:.0e}",
            self.files, self.decorrelation
        )
    }
}

/// 1 - r of the shapes of two entries, over their common sets.
fn decorrelation(a: &EntryInfo, b: &EntryInfo) -> f64 {
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (set, shapes) in &a.shapes {
        for (a, b) in shapes.iter().zip(b.shapes.get(set).into_iter().flatten()) {
            let (a, b) = (f64::from(*a), f64::from(*b));
            ab += a * b;
            aa += a * a;
            bb += b * b;
        }
    }
    // NaN stays, in contrast to `max`.
    (1.0 - ab / (aa * bb).sqrt()).clamp(0.0, 2.0)
}

/// For each of `entries`, which are in order of arrival, the first earlier entry with a common file or equal shapes.
pub fn near_copies(entries: &[Entry]) -> Vec<NearCopy<'_>> {
    let mut owners: BTreeMap<&str, usize> = BTreeMap::new();
    let mut copies = Vec::new();
    for (own, Entry { info, .. }) in entries.iter().enumerate() {
        let of_files = info.files.iter().filter_map(|file| owners.get(&**file));
        let of_shapes = || {
            let near = |other: &Entry| decorrelation(info, &other.info) < DECORRELATION;
            entries[..own].iter().position(near)
        };
        if let Some(first) = of_files.min().copied().or_else(of_shapes) {
            let earlier = &entries[first].info;
            let theirs: BTreeSet<&String> = earlier.files.iter().collect();
            copies.push(NearCopy {
                entry: info,
                earlier,
                files: info
                    .files
                    .iter()
                    .filter(|file| theirs.contains(file))
                    .count(),
                decorrelation: decorrelation(info, earlier),
            });
        }
        for file in &info.files {
            owners.entry(file).or_insert(own);
        }
    }
    copies
}
