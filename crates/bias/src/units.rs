//! Sums per unit and bin, in bounded memory.

use std::collections::{BTreeMap, HashMap};

use serde::{Deserialize, Serialize};

use crate::error::BiasError;
use crate::sums::{Layout, Row};

// Units that are kept, at least and at most, and per catalogue in between. A jackknife of 1000 units determines an error to
// 1/√2000 = 2 %; more units only cost memory and time.
const MIN_KEPT_UNITS: usize = 2048;
const UNITS_PER_CATALOGUE: usize = 1024;
const MAX_KEPT_UNITS: usize = 8192;

// 64 MiB of numbers are kept, if that leaves at least 256 units, whose jackknife determines an error to 4 %.
const MAX_KEPT_NUMBERS: usize = 1 << 23;
const MIN_UNITS_OF_MANY_BINS: usize = 256;

/// Sums per unit and bin, for any number of rows in bounded memory.
///
/// A unit is a set of galaxies that is independent of others; errors follow from the scatter between units. It is named by
/// the place of its catalogue in a list and a key: the number of a row, or the hash of an identifier. If there are more than
/// 2048 to 8192 units, neighbouring keys are joined. Sums can be written by serde, and sums of shards merge to the sums of
/// all catalogues; the order of additions, and with it the last bits, then follows the order of the shards.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnitSums {
    layout: Layout,
    bins: usize,
    catalogues: usize,
    // Number of bits by which keys are shifted: units have the same key afterwards. Sums of shards with different shifts join at
    // the larger one, so that a unit contains the same galaxies in all.
    shift: u32,
    units: Vec<((u32, u64), Vec<f64>)>,
    #[serde(skip)]
    places: HashMap<(u32, u64), usize>,
    // Rows of one unit are neighbours in most files.
    #[serde(skip)]
    last: Option<((u32, u64), usize)>,
}

impl UnitSums {
    /// Without rows yet, for a number of bins and catalogues.
    pub fn new(layout: Layout, bins: usize, catalogues: usize) -> Self {
        UnitSums {
            layout,
            bins,
            catalogues,
            shift: 0,
            units: Vec::new(),
            places: HashMap::new(),
            last: None,
        }
    }

    /// Which sums there are.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// Number of bins.
    pub fn bins(&self) -> usize {
        self.bins
    }

    /// Adds a galaxy to the unit `key` of the `catalogue` of this number, in a bin from 0.
    ///
    /// # Panics
    /// If the bin does not exist.
    pub fn add(&mut self, catalogue: u32, key: u64, bin: usize, row: &Row) {
        let layout = self.layout;
        layout.add(self.sums(catalogue, key, bin), row);
    }

    /// Adds the ellipticity `e`, divided by twice the added shear, and the weight of a galaxy in the sheared catalogue at the
    /// place `sheared` of [`crate::SHEARED_CATALOGUES`]; see [`Layout::add_sheared`].
    ///
    /// # Panics
    /// If the bin or the sheared catalogue does not exist.
    pub fn add_sheared(
        &mut self,
        catalogue: u32,
        key: u64,
        bin: usize,
        sheared: usize,
        (e, weight): ([f64; 2], f64),
    ) {
        let layout = self.layout;
        layout.add_sheared(self.sums(catalogue, key, bin), sheared, e, weight);
    }

    /// The sums of a unit and bin.
    fn sums(&mut self, catalogue: u32, key: u64, bin: usize) -> &mut [f64] {
        let unit = (catalogue, shifted(key, self.shift));
        let place = match self.last {
            Some((last, place)) if last == unit => place,
            _ => self.place(catalogue, key),
        };
        let length = self.layout.len();
        &mut self.units[place].1[bin * length..(bin + 1) * length]
    }

    /// Most units.
    fn most(&self) -> usize {
        let fit = MAX_KEPT_NUMBERS / (self.bins * self.layout.len());
        let most = (UNITS_PER_CATALOGUE * self.catalogues).clamp(MIN_KEPT_UNITS, MAX_KEPT_UNITS);
        most.min(fit.max(MIN_UNITS_OF_MANY_BINS))
    }

    fn place(&mut self, catalogue: u32, key: u64) -> usize {
        let most = self.most();
        let mut unit = (catalogue, shifted(key, self.shift));
        if !self.places.contains_key(&unit) && self.units.len() >= most {
            while self.units.len() >= most && self.shift < u64::BITS {
                self.coarsen(self.shift + 1);
            }
            unit = (catalogue, shifted(key, self.shift));
        }
        let place = match self.places.get(&unit) {
            Some(&place) => place,
            None => {
                self.units
                    .push((unit, vec![0.0; self.bins * self.layout.len()]));
                self.places.insert(unit, self.units.len() - 1);
                self.units.len() - 1
            }
        };
        self.last = Some((unit, place));
        place
    }

    /// Joins units whose keys are equal after a larger shift.
    fn coarsen(&mut self, shift: u32) {
        let by = shift - self.shift;
        self.shift = shift;
        self.renamed(|(catalogue, key)| (catalogue, shifted(key, by)));
    }

    // The order follows the names, not the hash map: sums of floating-point numbers depend on the order, and results must be
    // the same on each run.
    fn renamed(&mut self, name: impl Fn((u32, u64)) -> (u32, u64)) {
        let mut joined: BTreeMap<(u32, u64), Vec<f64>> = BTreeMap::new();
        for (unit, sums) in self.units.drain(..) {
            match joined.entry(name(unit)) {
                std::collections::btree_map::Entry::Vacant(free) => {
                    free.insert(sums);
                }
                std::collections::btree_map::Entry::Occupied(mut there) => {
                    add(there.get_mut(), &sums);
                }
            }
        }
        self.units = joined.into_iter().collect();
        let places = self.units.iter().enumerate();
        self.places = places.map(|(place, (unit, _))| (*unit, place)).collect();
        self.last = None;
    }

    /// Adds the sums of other rows of the same catalogues.
    ///
    /// # Errors
    /// [`BiasError::Layouts`] if the sums differ in layout or bins, [`BiasError::Length`] if they contradict themselves.
    pub fn merge(&mut self, mut other: UnitSums) -> Result<(), BiasError> {
        if (self.layout, self.bins) != (other.layout, other.bins) {
            return Err(BiasError::Layouts {
                found: other.layout,
                found_bins: other.bins,
                expected: self.layout,
                expected_bins: self.bins,
            });
        }
        let length = self.bins * self.layout.len();
        if let Some((_, sums)) = other.units.iter().find(|(_, sums)| sums.len() != length) {
            return Err(BiasError::Length {
                found: sums.len(),
                expected: length,
            });
        }
        let shift = self.shift.max(other.shift);
        self.catalogues = self.catalogues.max(other.catalogues);
        self.coarsen(shift);
        other.coarsen(shift);
        self.units.append(&mut other.units);
        self.renamed(|unit| unit);
        let most = self.most();
        while self.units.len() > most && self.shift < u64::BITS {
            self.coarsen(self.shift + 1);
        }
        Ok(())
    }

    /// Adds the sums of other catalogues, whose numbers continue the numbers of these.
    ///
    /// # Errors
    /// As [`UnitSums::merge`].
    pub fn append(&mut self, mut other: UnitSums) -> Result<(), BiasError> {
        let first = self.catalogues as u32;
        other.renamed(|(catalogue, key)| (catalogue + first, key));
        other.catalogues += self.catalogues;
        self.merge(other)
    }

    /// The same sums with a unit for each key, whatever the catalogue: the same row or identifier in all catalogues. The shape
    /// of a galaxy under +γ and −γ is then left out together, and cancels in the error of m.
    pub fn by_key(mut self) -> Self {
        self.renamed(|(_, key)| (0, key));
        self
    }

    /// The same sums with a unit for each group of catalogues.
    pub fn by_group(mut self, group: impl Fn(u32) -> u32) -> Self {
        self.renamed(|(catalogue, _)| (group(catalogue), 0));
        self
    }

    /// Number of units.
    pub(crate) fn count(&self) -> usize {
        self.units.len()
    }

    pub(crate) fn of_catalogues(&self, wanted: impl Fn(u32) -> bool) -> Self {
        let all = self.units.iter();
        let units = all.filter(|((catalogue, _), _)| wanted(*catalogue));
        UnitSums {
            units: units.cloned().collect(),
            places: HashMap::new(),
            last: None,
            ..*self
        }
    }

    pub(crate) fn mean_pairs(&self, a: u32, b: u32) -> Vec<[[f64; 2]; 2]> {
        let length = self.layout.len();
        let mean = |unit: &[f64]| {
            let mut all = vec![0.0; length];
            unit.chunks_exact(length).for_each(|bin| add(&mut all, bin));
            let own = self.layout.mean(&all);
            own.iter().all(|e| e.is_finite()).then_some(own)
        };
        let of = |catalogue: u32| {
            let units = self.units.iter();
            let own = units.filter(move |((own, _), _)| *own == catalogue);
            own.filter_map(move |((_, key), sums)| Some((*key, mean(sums)?)))
        };
        let first: BTreeMap<u64, [f64; 2]> = of(a).collect();
        let pair = |(key, own): (u64, [f64; 2])| Some([*first.get(&key)?, own]);
        of(b).filter_map(pair).collect()
    }

    // Units without a galaxy in the bin are no units of it: they would make the factor (n − 1)/n of the jackknife too large.
    pub(crate) fn of_bin(&self, bin: usize) -> Vec<&[f64]> {
        let length = self.layout.len();
        let of_bin = |sums: &'_ [f64]| bin * length..(bin + 1) * length.min(sums.len());
        let all = self.units.iter().map(|(_, sums)| &sums[of_bin(sums)]);
        all.filter(|sums| sums.iter().any(|sum| *sum != 0.0))
            .collect()
    }

    /// The sums of each unit of a bin in these and other sums, whose units have the same names. `None` if a unit has no
    /// galaxy.
    pub(crate) fn pairs_with(&self, other: &UnitSums, bin: usize) -> Vec<[Option<Vec<f64>>; 2]> {
        let shift = self.shift.max(other.shift);
        let mut pairs: BTreeMap<(u32, u64), [Option<Vec<f64>>; 2]> = BTreeMap::new();
        for (place, sums) in [self, other].into_iter().enumerate() {
            let mut sums = sums.clone();
            sums.coarsen(shift);
            let length = sums.layout.len();
            for (unit, all) in &sums.units {
                let own = &all[bin * length..(bin + 1) * length];
                if own.iter().any(|sum| *sum != 0.0) {
                    pairs.entry(*unit).or_default()[place] = Some(own.to_vec());
                }
            }
        }
        pairs.into_values().collect()
    }

    /// The same sums with all bins joined to one.
    pub fn all_bins(&self) -> Self {
        let length = self.layout.len();
        let joined = |sums: &Vec<f64>| {
            let mut all = vec![0.0; length];
            for bin in sums.chunks_exact(length) {
                add(&mut all, bin);
            }
            all
        };
        UnitSums {
            bins: 1,
            units: self
                .units
                .iter()
                .map(|(unit, sums)| (*unit, joined(sums)))
                .collect(),
            places: self.places.clone(),
            last: None,
            ..*self
        }
    }
}

fn shifted(key: u64, shift: u32) -> u64 {
    // A shift by 64 bits or more overflows, and means one unit.
    key.checked_shr(shift).unwrap_or(0)
}

pub(crate) fn add(sums: &mut [f64], more: &[f64]) {
    for (sum, more) in sums.iter_mut().zip(more) {
        *sum += more;
    }
}
