//! Stars with noise. Each is the PSF of all galaxies of some catalogues, and changes their m and c alike.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::units::UnitSums;

/// The noise of the star that is the PSF of all galaxies of a catalogue.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StarNoise {
    /// What distinguishes the star from others.
    pub star: String,
    /// Standard deviation of m by the noise, the same for both components.
    pub m: f64,
    /// Standard deviation of c by the noise, independent for each component.
    pub c: f64,
}

/// The galaxies behind a star that are in several units. Units differ by less than the noise of this star, so that a
/// jackknife over them does not contain it.
#[derive(Debug, Clone, PartialEq)]
pub struct Behind {
    pub(crate) m: f64,
    pub(crate) c: f64,
    /// Their sums, in one unit.
    pub(crate) sums: UnitSums,
}

impl Behind {
    /// The same galaxies with all bins joined to one.
    fn all_bins(&self) -> Self {
        Behind {
            sums: self.sums.all_bins(),
            ..*self
        }
    }
}

/// The same stars with all bins joined to one.
pub fn all_bins(stars: &[Behind]) -> Vec<Behind> {
    stars.iter().map(Behind::all_bins).collect()
}

/// The galaxies of each star that several units share. `noises` has the noise of each catalogue's star, and `units` the
/// unit of each catalogue, unless every unit has galaxies of all catalogues.
pub(crate) fn shared(
    sums: &UnitSums,
    noises: &[Option<&StarNoise>],
    units: Option<&[u32]>,
) -> Vec<Behind> {
    let mut stars: BTreeMap<&str, (BTreeSet<u32>, [f64; 2])> = BTreeMap::new();
    for (catalogue, noise) in (0..).zip(noises) {
        if let Some(StarNoise { star, m, c }) = noise {
            let (catalogues, most) = stars.entry(star).or_default();
            catalogues.insert(catalogue);
            *most = [most[0].max(*m), most[1].max(*c)];
        }
    }
    let unit_of = |catalogue: &u32| units.and_then(|units| units.get(*catalogue as usize));
    stars.retain(|_, (catalogues, _)| {
        units.is_none()
            || catalogues
                .iter()
                .map(unit_of)
                .collect::<BTreeSet<_>>()
                .len()
                > 1
    });
    let behind = stars.into_values().map(|(catalogues, [m, c])| Behind {
        m,
        c,
        sums: sums.of_catalogues(|catalogue| catalogues.contains(&catalogue)),
    });
    behind.collect()
}
