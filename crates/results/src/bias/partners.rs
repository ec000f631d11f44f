//! Galaxies that count under all test shears (`--paired`).

use std::collections::{BTreeMap, HashSet};

use shearq_bias::{Catalogue, Design, same_galaxies};
use shearq_catalogue::roles::Role;
use shearq_catalogue::rows::rows;
use shearq_catalogue::source::{Reading, Source};
use shearq_files::FileError;

use super::error::BiasFailure;

/// The catalogues that contain the same galaxies. Their rows are read once more for each catalogue, so that memory contains the
/// galaxies of one catalogue and not of all.
pub(super) struct Partners<'a> {
    reading: &'a Reading<'a>,
    all: &'a [Vec<Source>],
    groups: Vec<u32>,
}

impl<'a> Partners<'a> {
    pub(super) fn new(
        reading: &'a Reading<'a>,
        all: &'a [Vec<Source>],
        design: Design,
        catalogues: &[Catalogue],
    ) -> Result<Self, BiasFailure> {
        if !matches!(design, Design::Pairs | Design::Arms) {
            return Err(BiasFailure::NothingPairs(design));
        }
        let groups = same_galaxies(catalogues, design);
        let are_matched = all[0][0].columns.of(Role::Id).is_some();
        // By their numbers, rows behind one that is missing would be paired with other galaxies.
        let mut first = BTreeMap::<u32, &Catalogue>::new();
        let read = groups.iter().zip(catalogues);
        for (group, own) in read.filter(|(_, own)| own.rows > 0 && !are_matched) {
            let first = first.entry(*group).or_insert(own);
            if first.rows != own.rows {
                return Err(BiasFailure::PairedRows {
                    first: first.name.clone(),
                    second: own.name.clone(),
                    rows: [first.rows, own.rows],
                });
            }
        }
        Ok(Partners {
            reading,
            all,
            groups,
        })
    }

    /// The galaxies that count in all other catalogues of the same galaxies.
    pub(super) fn of(&self, number: usize) -> Result<HashSet<u64>, FileError> {
        let mut found: Option<HashSet<u64>> = None;
        for (other, sources) in self.all.iter().enumerate() {
            if other == number || self.groups[other] != self.groups[number] {
                continue;
            }
            let mut good = HashSet::new();
            let name = &self.reading.request.catalogues[other].name;
            rows(name, self.reading, sources, |item| {
                let counts = item.sheared == 0 && item.selected.of(0).binned.is_ok();
                if counts
                    && found
                        .as_ref()
                        .is_none_or(|known| known.contains(&item.galaxy))
                {
                    good.insert(item.galaxy);
                }
            })?;
            found = Some(good);
        }
        Ok(found.unwrap_or_default())
    }
}
