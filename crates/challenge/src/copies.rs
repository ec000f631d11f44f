//! Entries that are nearly those of others.

use std::collections::{BTreeMap, BTreeSet};

use crate::judge::{Entry, EntryInfo};

// Largest 1 - r of a near copy, with r the correlation of its shapes. Noise of a thousandth of the shapes has it.
const DECORRELATION: f64 = 1e-6;

/// An entry that is nearly an earlier one.
#[derive(Debug, Clone)]
pub struct NearCopy<'a> {
    pub entry: &'a EntryInfo,
    pub earlier: &'a EntryInfo,
    pub files: usize,
    /// 1 - r, with r the correlation of the shapes; NaN without common sets of catalogues.
    pub decorrelation: f64,
}

impl NearCopy<'_> {
    pub fn reason(&self) -> String {
        let of = self.entry.files.len();
        format!(
            "{} of {of} files are identical, 1 - correlation of the shapes is {:.0e}",
            self.files, self.decorrelation
        )
    }
}

// Smallest 1 - r of the shapes of two entries in a common set: a copy may have another scale and shift in each set.
fn decorrelation(a: &EntryInfo, b: &EntryInfo) -> f64 {
    let of_set = |(set, shapes): (&String, &Vec<i32>)| {
        let (a, b) = (centred(shapes), centred(b.shapes.get(set)?));
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let r = product(&a, &b) / (product(&a, &a) * product(&b, &b)).sqrt();
        Some((1.0 - r).clamp(0.0, 2.0))
    };
    // NaN, which shapes without scatter have, is left out.
    a.shapes.iter().filter_map(of_set).fold(f64::NAN, f64::min)
}

// Components relative to their means.
fn centred(shapes: &[i32]) -> Vec<f64> {
    let mean = |k: usize| {
        let own = shapes.iter().skip(k).step_by(2);
        own.map(|e| f64::from(*e)).sum::<f64>() / (shapes.len() as f64 / 2.0)
    };
    let means = [mean(0), mean(1)];
    let each = shapes.iter().enumerate();
    each.map(|(k, e)| f64::from(*e) - means[k % 2]).collect()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ranking::tests::entry;

    #[test]
    fn another_scale_and_shift_in_each_set_hide_no_copy() {
        let of = |team: &str, scales: [f64; 2], noise: f64| {
            let mut entry = entry(team, "2026-11-24T10:00:00Z", 1.0, &[1.0]);
            for (set, scale) in (1..).zip(scales) {
                let shapes = (0..64).map(|k| {
                    let value = (f64::from(k * set) * 1.7).sin() + noise * f64::from(k).cos();
                    (1e6 * (scale * value + 0.1 * scale)).round() as i32
                });
                entry.info.shapes.insert(set.to_string(), shapes.collect());
            }
            entry
        };
        let entries = [
            of("Owner", [1.0, 1.0], 0.0),
            of("Copy", [1.5, 1.01], 0.0),
            of("Other", [1.0, 1.0], 0.1),
        ];
        let copies = near_copies(&entries);
        let teams: Vec<&str> = copies.iter().map(|copy| copy.entry.team.as_str()).collect();
        assert_eq!(teams, ["Copy"]);
    }
}
