//! Sums per unit and bin, in bounded memory.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use shearq_quantities::hash::NumberMap;

use crate::arms::Units;
use crate::error::BiasError;
use crate::sums::{Layout, Row, add, join, shifted};

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
    places: NumberMap<(u32, u64), usize>,
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
            places: NumberMap::default(),
            last: None,
        }
    }

    /// Which sums there are.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// How many catalogues of equal weight would determine the mean shear as well: (Σ W)²/Σ W², where W is what a catalogue's
    /// ellipticities are divided by. The smaller one of both components.
    pub fn effective_catalogues(&self) -> f64 {
        let mut each: BTreeMap<u32, [f64; 2]> = BTreeMap::new();
        for ((catalogue, _), sums) in &self.units {
            let own = each.entry(*catalogue).or_default();
            for sums in sums.chunks_exact(self.layout.len()) {
                let [first, second] = self.layout.divisors(sums);
                *own = [own[0] + first, own[1] + second];
            }
        }
        let effective = |k: usize| {
            let (sum, squares) = each.values().fold((0.0, 0.0), |(sum, squares), own| {
                (sum + own[k], squares + own[k] * own[k])
            });
            sum * sum / squares
        };
        effective(0).min(effective(1))
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
        let mut unit = (catalogue, shifted(key, self.shift));
        if let Some(&place) = self.places.get(&unit) {
            self.last = Some((unit, place));
            return place;
        }
        let most = self.most();
        if self.units.len() >= most {
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
        if by == 0 {
            return;
        }
        self.shift = shift;
        self.renamed(|(catalogue, key)| (catalogue, shifted(key, by)));
    }

    // The order follows the names, not the hash map: sums of floating-point numbers depend on the order, and results must be
    // the same on each run.
    fn renamed(&mut self, name: impl Fn((u32, u64)) -> (u32, u64)) {
        let mut joined: BTreeMap<(u32, u64), Vec<f64>> = BTreeMap::new();
        for (unit, sums) in self.units.drain(..) {
            join(&mut joined, name(unit), sums);
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

    /// The sums by key, whatever the catalogue: the same row or identifier in all catalogues is a unit. The shape of a galaxy
    /// under +γ and −γ is then left out together, and cancels in the error of m. `arm` is the arm of a catalogue, see
    /// [`Units`].
    pub fn by_key(self, arm: impl Fn(u32) -> u32) -> Units {
        self.units(arm, |(_, key)| (0, key))
    }

    /// The sums by group of catalogues, with the arm of each catalogue.
    pub fn by_group(self, arm: impl Fn(u32) -> u32, group: impl Fn(u32) -> u32) -> Units {
        self.units(arm, |(catalogue, _)| (group(catalogue), 0))
    }

    fn units(self, arm: impl Fn(u32) -> u32, unit: impl Fn((u32, u64)) -> (u32, u64)) -> Units {
        let layout = self.layout;
        // Without sheared catalogues all sums are linear, so that arms make no difference.
        let arm = |catalogue| if layout.sheared { arm(catalogue) } else { 0 };
        let named = self.units.into_iter();
        let named = named.map(|(name, sums)| (unit(name), arm(name.0), sums));
        Units::new((layout, self.bins, self.shift), named)
    }

    pub(crate) fn of_catalogues(&self, wanted: impl Fn(u32) -> bool) -> Self {
        let all = self.units.iter();
        let units = all.filter(|((catalogue, _), _)| wanted(*catalogue));
        UnitSums {
            units: units.cloned().collect(),
            places: NumberMap::default(),
            last: None,
            ..*self
        }
    }

    pub(crate) fn by_catalogue(&self) -> OfCatalogues<'_> {
        let mut units: BTreeMap<u32, Vec<(u64, &[f64])>> = BTreeMap::new();
        for ((catalogue, key), sums) in &self.units {
            units.entry(*catalogue).or_default().push((*key, sums));
        }
        OfCatalogues {
            layout: self.layout,
            units,
        }
    }
}

/// The units of each catalogue.
pub(crate) struct OfCatalogues<'a> {
    layout: Layout,
    units: BTreeMap<u32, Vec<(u64, &'a [f64])>>,
}

impl OfCatalogues<'_> {
    /// What `of` makes of the sums over all bins of each unit of two catalogues; `None` where a catalogue has no galaxy of it.
    pub(crate) fn pairs<T>(
        &self,
        a: u32,
        b: u32,
        of: impl Fn(Layout, &[f64]) -> T,
    ) -> Vec<[Option<T>; 2]> {
        let length = self.layout.len();
        let mut pairs: BTreeMap<u64, [Option<T>; 2]> = BTreeMap::new();
        for (place, catalogue) in [a, b].iter().enumerate() {
            for (key, sums) in self.units.get(catalogue).into_iter().flatten() {
                let mut all = vec![0.0; length];
                sums.chunks_exact(length).for_each(|bin| add(&mut all, bin));
                pairs.entry(*key).or_default()[place] = Some(of(self.layout, &all));
            }
        }
        pairs.into_values().collect()
    }
}
