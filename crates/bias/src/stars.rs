//! Stars with noise. Each is the PSF of all galaxies of some catalogues, and changes their m and c alike.
//!
//! A jackknife over units that share a star does not see this error, because leaving out a unit does not change the star.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::arms::Units;
use crate::units::UnitSums;

/// The noise of the star that is the PSF of all galaxies of a catalogue.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StarNoise {
    /// What distinguishes the star from others.
    pub star: String,
    /// Standard deviation of m by the noise of the star, the same for both components.
    pub m: f64,
    /// Standard deviation of c by the noise of the star, independent for each component.
    pub c: f64,
}

/// The galaxies behind a star that are in several units. A jackknife over the units contains only the part of its noise by
/// which they differ.
#[derive(Debug, Clone, PartialEq)]
pub struct Behind {
    pub(crate) m: f64,
    pub(crate) c: f64,
    /// Their sums: by unit, or in one if every unit has galaxies of all catalogues.
    pub(crate) units: Units,
    pub(crate) by_unit: bool,
}

impl Behind {
    /// The same galaxies with all bins joined to one.
    pub(crate) fn all_bins(&self) -> Self {
        Behind {
            units: self.units.all_bins(),
            ..*self
        }
    }
}

/// The galaxies of each star that several units share. `noises` has the noise of each catalogue's star, and `units` the
/// unit of each catalogue, unless every unit has galaxies of all catalogues.
pub(crate) fn shared(
    sums: &UnitSums,
    noises: &[Option<&StarNoise>],
    units: Option<&[u32]>,
    arm: impl Fn(u32) -> u32 + Copy,
) -> Vec<Behind> {
    let mut stars: BTreeMap<&str, (BTreeSet<u32>, [f64; 2])> = BTreeMap::new();
    for (catalogue, noise) in (0..).zip(noises) {
        if let Some(StarNoise { star, m, c }) = noise {
            let (catalogues, most) = stars.entry(star).or_default();
            catalogues.insert(catalogue);
            // The larger of two statements about one star is the safe one.
            *most = [most[0].max(*m), most[1].max(*c)];
        }
    }
    let unit = |catalogue: u32| {
        let units = units.unwrap_or_default();
        units.get(catalogue as usize).copied().unwrap_or(0)
    };
    let behind = stars.into_values().map(|(catalogues, [m, c])| Behind {
        m,
        c,
        units: sums
            .of_catalogues(|catalogue| catalogues.contains(&catalogue))
            .by_group(arm, unit),
        by_unit: units.is_some(),
    });
    // A star in one unit differs from unit to unit, and is in the jackknife.
    behind
        .filter(|star| !star.by_unit || star.units.count() > 1)
        .collect()
}
