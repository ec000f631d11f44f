//! Sums by independent unit and arm, and the sums of all units with the response of each arm.

use std::collections::BTreeMap;

use crate::sums::{COUNT, Layout, ShearedResponse, WEIGHT, add, join, shifted};

/// Sums of the units of a jackknife, by arm.
///
/// An arm is the catalogues under one test shear. Sheared catalogues give the response as a difference of weighted means,
/// and each mean belongs to one arm: a mean over both arms of ±γ contains (W₊ − W₋)(E₊ − E₋), which changes m by 2kγ² if
/// the sum of weights W (or the number of selected galaxies) is W₀ (1 + kγ²). With a weight of 1/(0.07 + e²), m was 0.026
/// instead of −0.008 at |γ| = 0.07.
#[derive(Debug, Clone, PartialEq)]
pub struct Units {
    layout: Layout,
    bins: usize,
    // As in [`crate::UnitSums`]: by how many bits keys were shifted.
    shift: u32,
    units: BTreeMap<Name, BTreeMap<u32, Vec<f64>>>,
}

type Name = (u32, u64);

/// The sums of a unit in some bins, by arm.
pub(crate) type Unit<'a> = Vec<(u32, &'a [f64])>;

impl Units {
    pub(crate) fn new(
        (layout, bins, shift): (Layout, usize, u32),
        named: impl Iterator<Item = (Name, u32, Vec<f64>)>,
    ) -> Self {
        let mut units: BTreeMap<Name, BTreeMap<u32, Vec<f64>>> = BTreeMap::new();
        for (name, arm, sums) in named {
            join(units.entry(name).or_default(), arm, sums);
        }
        Units {
            layout,
            bins,
            shift,
            units,
        }
    }

    pub(crate) fn layout(&self) -> Layout {
        self.layout
    }

    pub(crate) fn count(&self) -> usize {
        self.units.len()
    }

    /// Number of galaxies in a bin.
    pub fn galaxies(&self, bin: usize) -> usize {
        let units = self.of_bins(bin, 1);
        let all = units.iter().flatten();
        all.map(|(_, sums)| sums[COUNT]).sum::<f64>() as usize
    }

    // Units without a galaxy in the bins are no units of them: they would make the factor (n − 1)/n of the jackknife too large.
    pub(crate) fn of_bins(&self, first: usize, count: usize) -> Vec<Unit<'_>> {
        let units = self.units.values();
        units
            .filter_map(|arms| self.in_bins(arms, first, count))
            .collect()
    }

    fn in_bins<'a>(
        &self,
        arms: &'a BTreeMap<u32, Vec<f64>>,
        first: usize,
        count: usize,
    ) -> Option<Unit<'a>> {
        let length = self.layout.len();
        let arms = arms
            .iter()
            .map(|(arm, sums)| (*arm, &sums[first * length..(first + count) * length]));
        let unit: Unit<'_> = arms
            .filter(|(_, sums)| sums.iter().any(|sum| *sum != 0.0))
            .collect();
        (!unit.is_empty()).then_some(unit)
    }

    /// The same units with all bins joined to one.
    #[must_use]
    pub fn all_bins(&self) -> Self {
        let length = self.layout.len();
        let joined = |sums: &Vec<f64>| {
            let mut all = vec![0.0; length];
            sums.chunks_exact(length).for_each(|bin| add(&mut all, bin));
            all
        };
        let of_unit = |arms: &BTreeMap<u32, Vec<f64>>| {
            let arms = arms.iter().map(|(arm, sums)| (*arm, joined(sums)));
            arms.collect()
        };
        let units = self.units.iter();
        Units {
            bins: 1,
            units: units.map(|(name, arms)| (*name, of_unit(arms))).collect(),
            ..*self
        }
    }

    // Units whose keys are equal after a larger shift are one.
    fn coarsened(&self, shift: u32) -> Self {
        let by = shift - self.shift;
        let named = self.units.iter().flat_map(|(name, arms)| {
            let name = (name.0, shifted(name.1, by));
            arms.iter()
                .map(move |(arm, sums)| (name, *arm, sums.clone()))
        });
        Units::new((self.layout, self.bins, shift), named)
    }

    /// These and other units with the same names: sums of shards join at the larger shift.
    pub(crate) fn aligned(&self, other: &Units) -> [Units; 2] {
        let shift = self.shift.max(other.shift);
        [self.coarsened(shift), other.coarsened(shift)]
    }

    /// The units of a bin in each of `sides`, which are aligned; `None` where a unit has no galaxy.
    pub(crate) fn pairs(sides: &[Units; 2], bin: usize) -> Vec<[Option<Unit<'_>>; 2]> {
        let mut pairs: BTreeMap<Name, [Option<Unit<'_>>; 2]> = BTreeMap::new();
        for (place, side) in sides.iter().enumerate() {
            for (name, arms) in &side.units {
                if let Some(unit) = side.in_bins(arms, bin, 1) {
                    pairs.entry(*name).or_default()[place] = Some(unit);
                }
            }
        }
        pairs.into_values().collect()
    }
}

/// The sums of units: of all, and without one. They have the layout [`Layout::with_response`].
pub(crate) struct Totals<'a> {
    layout: Layout,
    arms: BTreeMap<u32, Vec<f64>>,
    // The share of each bin in the sum of weights, if bins are weighted.
    shares: Option<&'a [f64]>,
    // The mean response of all arms, for arms without galaxies in one of their sheared catalogues.
    response: ShearedResponse,
    pub(crate) all: Vec<f64>,
    /// A sheared catalogue without galaxies in all arms.
    pub(crate) lacking: Option<&'static str>,
}

impl<'a> Totals<'a> {
    /// Of all `units`, which have one bin, or as many as `shares`: the galaxies of each bin then have this share in the sum of
    /// all weights.
    pub(crate) fn new(layout: Layout, units: &[Unit<'_>], shares: Option<&'a [f64]>) -> Self {
        let mut arms: BTreeMap<u32, Vec<f64>> = BTreeMap::new();
        for (arm, sums) in units.iter().flatten() {
            let own = arms.entry(*arm).or_insert_with(|| vec![0.0; sums.len()]);
            add(own, sums);
        }
        let mut totals = Totals {
            layout,
            arms,
            shares,
            response: ShearedResponse::default(),
            all: Vec::new(),
            lacking: None,
        };
        let factors = totals.factors(None);
        let mut pooled = vec![0.0; layout.len()];
        for sums in totals.arms.values() {
            add(&mut pooled, &totals.weighted(sums, &factors));
        }
        totals.lacking = layout.without_galaxies(&pooled);
        totals.response = totals.mean_response(&pooled);
        totals.all = totals.reduced(None, &factors);
        totals
    }

    fn mean_response(&self, sums: &[f64]) -> ShearedResponse {
        match self.layout.sheared {
            true => self.layout.mean_response(sums),
            false => ShearedResponse::default(),
        }
    }

    // By what the weights of the galaxies of each bin are multiplied, from the weights of all units except one.
    fn factors(&self, without: Option<&Unit<'_>>) -> Vec<f64> {
        let Some(shares) = self.shares else {
            return vec![1.0];
        };
        let length = self.layout.len();
        let weight = |sums: &[f64], bin: usize| sums[bin * length + WEIGHT];
        let of_bin = |(bin, share): (usize, &f64)| {
            let all: f64 = self.arms.values().map(|sums| weight(sums, bin)).sum();
            let less = without.map_or(0.0, |unit| {
                unit.iter().map(|(_, sums)| weight(sums, bin)).sum()
            });
            // Rounding leaves 10⁻¹⁶ of a bin whose galaxies are all in the unit.
            let rest = all - less;
            if rest > 1e-12 * all {
                share / rest
            } else {
                0.0
            }
        };
        shares.iter().enumerate().map(of_bin).collect()
    }

    fn weighted(&self, sums: &[f64], factors: &[f64]) -> Vec<f64> {
        let length = self.layout.len();
        let mut all = vec![0.0; length];
        for (bin, factor) in sums.chunks_exact(length).zip(factors) {
            Layout::add_weighted(&mut all, bin, *factor);
        }
        all
    }

    fn add_arm(&self, into: &mut [f64], sums: &[f64]) {
        let own = self.mean_response(sums);
        let response = if own.is_finite() { own } else { self.response };
        self.layout.add_with_response(into, sums, &response);
    }

    fn reduced(&self, without: Option<&Unit<'_>>, factors: &[f64]) -> Vec<f64> {
        let mut all = vec![0.0; self.layout.with_response().len()];
        for (arm, sums) in &self.arms {
            let unit = without.and_then(|unit| unit.iter().find(|(own, _)| own == arm));
            let sums = match unit {
                None => self.weighted(sums, factors),
                Some((_, unit)) => self.weighted(&minus(sums, unit), factors),
            };
            self.add_arm(&mut all, &sums);
        }
        all
    }

    /// The sums of all units except one.
    pub(crate) fn without(&self, unit: &Unit<'_>) -> Vec<f64> {
        if self.shares.is_some() {
            return self.reduced(Some(unit), &self.factors(Some(unit)));
        }
        // Subtracting a unit costs as much as adding it: n units need n estimates instead of n² sums.
        let mut rest = self.all.clone();
        for (arm, own) in unit {
            if !self.layout.sheared {
                rest = minus(&rest, own);
                continue;
            }
            let total = &self.arms[arm];
            let mut before = vec![0.0; rest.len()];
            self.add_arm(&mut before, total);
            rest = minus(&rest, &before);
            self.add_arm(&mut rest, &minus(total, own));
        }
        rest
    }

    /// The sums of one unit, with the responses and weights of all of them.
    pub(crate) fn of_unit(&self, unit: &Unit<'_>) -> Vec<f64> {
        let factors = self.factors(None);
        let mut all = vec![0.0; self.layout.with_response().len()];
        for (arm, sums) in unit {
            let total = self.arms.get(arm);
            let own = total.map(|total| self.mean_response(&self.weighted(total, &factors)));
            let response = own.filter(|own| own.is_finite()).unwrap_or(self.response);
            let sums = self.weighted(sums, &factors);
            self.layout.add_with_response(&mut all, &sums, &response);
        }
        all
    }
}

fn minus(sums: &[f64], less: &[f64]) -> Vec<f64> {
    debug_assert_eq!(sums.len(), less.len(), "sums of one layout");
    let differences = sums.iter().zip(less);
    differences.map(|(sum, less)| sum - less).collect()
}
