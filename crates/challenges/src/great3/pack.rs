//! The pre-submission of GREAT3: galaxies of a branch into mean shears or aperture masses of its fields.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};

use shearq_catalogue::columns::looks_like_weight;
use shearq_dataset::run::Run;
use shearq_dataset::threads::Pool;
use shearq_files::{FileError, names_of, table};
use shearq_quantities::Shear;
use shearq_results::response::{Shared, shears};
use shearq_scoring::aperture::{ApertureMass, SEPARATION_BINS};
use shearq_scoring::great3::{Branch, GRID, Identity, NODES_PER_GALAXY, SUBFIELDS};
use shearq_scoring::{Repeated, repeated};

use super::files::{EQUAL_SHEARS, lattice};
use super::rules::{NOT_AVERAGED, NOT_CORRELATED, more, not_an_identity, zero};
use crate::columns::{Columns, wrong};
use crate::{BranchCatalogues, Presubmission, Presubmitting};

// Share of the galaxies of a branch above which equal shears are placeholders. Chosen by hand.
const MIN_PLACEHOLDER_SHARE: f64 = 0.1;

const GALAXIES: Columns<'static> = Columns {
    names: &[&["ID"], &["g1"], &["g2"], &["weight", "w"]],
    required: 3,
    // The last with positions, as the challenge's own catalogues had.
    unnamed: &[(3, &[0, 1, 2]), (4, &[0, 1, 2, 3]), (6, &[0, 3, 4, 5])],
};

fn unmeasured(file: &Path, field: usize) -> FileError {
    let message =
        format!("field {field} has no measured galaxy with a weight, so that it has no shear");
    FileError::new(file, message).hint("a smaller cut on quality")
}

fn subfields(packing: &Presubmitting<'_>) -> usize {
    packing.subfields.unwrap_or(SUBFIELDS)
}

fn grid(packing: &Presubmitting<'_>) -> usize {
    packing.grid.unwrap_or(GRID)
}

// A row of a catalogue.
struct Galaxy {
    id: Identity,
    g: Shear,
    weight: f64,
    catalogue: usize,
}

// All galaxies of a branch, in the order of their identities.
pub(super) struct Galaxies {
    branch: Branch,
    files: Vec<PathBuf>,
    galaxies: Vec<Galaxy>,
    // Names of columns that are not used.
    unused: BTreeSet<String>,
}

impl Galaxies {
    pub(super) fn read(branch: Branch, packing: &Presubmitting<'_>) -> Result<Self, FileError> {
        let mut all = Galaxies {
            branch,
            files: Vec::new(),
            galaxies: Vec::new(),
            unused: BTreeSet::new(),
        };
        match packing.catalogues {
            BranchCatalogues::Files(files) => {
                for path in files {
                    // `measure` writes ellipticities that are not divided by their response.
                    let hint = "catalogues of measure are packed by --measured DIR";
                    let read = GALAXIES.read_all(path);
                    let (columns, unused) = read.map_err(|error| error.hint_of_columns(hint))?;
                    // Galaxies that another program excludes by a weight of zero would count fully.
                    if let Some(name) = unused.iter().find(|name| looks_like_weight(name))
                        && columns[3].is_empty()
                    {
                        let message = format!(
                            "`{name}` looks like a weight but is not used (expected `weight` or `w`)"
                        );
                        return Err(
                            FileError::new(path, message).hint("rename it to weight, or remove it")
                        );
                    }
                    all.unused.extend(unused);
                    all.add(path, &columns, packing)?;
                }
            }
            BranchCatalogues::Measured(folder) => {
                let run = Run::require(folder)?;
                let files = run.catalogues(folder, &[])?;
                // Set by set, because the columns of two million galaxies are 200 MB.
                for set in files.sets() {
                    let found = shears(&[folder.to_owned()], &[set], Shared::Set, None)?;
                    let path = files.of_set(set).swap_remove(0).1;
                    let column = |name: &str| {
                        let read = table::numbers(&found.table, name, &path);
                        Ok(read?.into_owned())
                    };
                    let columns: Vec<_> = ["id", "g1", "g2", "w"]
                        .into_iter()
                        .map(column)
                        .collect::<Result<_, FileError>>()
                        .map_err(|error| error.hint_of_columns("galaxies of a branch of GREAT3 have identities (galaxy_catalog-*.fits)"))?;
                    all.add(&path, &columns, packing)?;
                }
            }
        }
        all.checked(packing)
    }

    // Places in identities from a galaxy to the next along an axis.
    fn step(&self) -> usize {
        match self.branch.constant {
            true => 1,
            false => NODES_PER_GALAXY,
        }
    }

    // Adds the galaxies of a table with the columns of `GALAXIES`.
    fn add(
        &mut self,
        path: &Path,
        columns: &[Vec<f64>],
        packing: &Presubmitting<'_>,
    ) -> Result<(), FileError> {
        let (branch, catalogue) = (self.branch, self.files.len());
        self.files.push(path.to_owned());
        for k in 0..columns[0].len() {
            let found = columns[0][k];
            let Some(id) = Identity::of_number(found) else {
                return wrong(path, not_an_identity(k, found));
            };
            let fault = |what: String| FileError::new(path, format!("galaxy {id}: {what}"));
            if id.subfield() >= subfields(packing) {
                return Err(fault(format!(
                    "subfield {} does not exist in {branch} (expected 0 to {})",
                    id.subfield(),
                    subfields(packing) - 1
                ))
                .hint("only the catalogues of one branch"));
            }
            let (x, y) = id.place();
            let last = grid(packing) * self.step() - 1;
            if x.max(y) > last {
                return Err(fault(format!(
                    "column {x} and row {y} are outside of the grid (expected 0 to {last})"
                ))
                .hint("--branch with the branch of these identities"));
            }
            let g = Shear::new(columns[1][k], columns[2][k]);
            for (name, found) in [("g1", g.e1), ("g2", g.e2)] {
                if found <= -NOT_AVERAGED {
                    return Err(fault(format!(
                        "{name} is {found}, which the challenge's program would average"
                    ))
                    .hint("10 for a galaxy that was not measured"));
                }
            }
            let weight = columns[3].get(k).copied().unwrap_or(1.0);
            if !(weight.is_finite() && weight >= 0.0) {
                return Err(fault(format!(
                    "the weight is {weight}, expected zero or a positive number"
                )));
            }
            self.galaxies.push(Galaxy {
                id,
                g,
                weight,
                catalogue,
            });
        }
        Ok(())
    }

    // The checks of the challenge's program, in the order in which their messages help most: a repeated galaxy before the missing
    // one that it stands for.
    fn checked(mut self, packing: &Presubmitting<'_>) -> Result<Self, FileError> {
        // Stable, so that the first of two rows stays first.
        self.galaxies.sort_by_key(|galaxy| galaxy.id);
        let file = |galaxy: &Galaxy| self.files[galaxy.catalogue].as_path();
        if let Some(pair) = self
            .galaxies
            .windows(2)
            .find(|pair| pair[0].id == pair[1].id)
        {
            let message = format!(
                "galaxy {} is there twice; it is also in {}",
                pair[0].id,
                file(&pair[0]).display()
            );
            return Err(FileError::new(file(&pair[1]), message).hint("remove one of the two rows"));
        }
        let there: BTreeSet<usize> = self.galaxies.iter().map(|own| own.id.subfield()).collect();
        let last = self
            .files
            .last()
            .map_or(Path::new("catalogues"), PathBuf::as_path);
        let lacking: Vec<usize> = (0..subfields(packing))
            .filter(|k| !there.contains(k))
            .collect();
        if !lacking.is_empty() {
            let first = lacking.iter().take(5).map(usize::to_string);
            let which = first.collect::<Vec<_>>().join(", ");
            let which = which + if lacking.len() > 5 { ", …" } else { "" };
            let message = format!(
                "{} of {} subfields are missing: {which}",
                lacking.len(),
                subfields(packing)
            );
            return Err(FileError::new(last, message)
                .hint("the catalogues of all subfields in one command"));
        }
        for subfield in self
            .galaxies
            .chunk_by(|a, b| a.id.subfield() == b.id.subfield())
        {
            self.check_subfield(subfield, packing, file)?;
        }
        Ok(self)
    }

    fn check_subfield<'p>(
        &self,
        galaxies: &[Galaxy],
        packing: &Presubmitting<'_>,
        file: impl Fn(&Galaxy) -> &'p Path,
    ) -> Result<(), FileError> {
        let first = &galaxies[0];
        let (step, subfield) = (self.step(), first.id.subfield());
        let offset = |id: Identity| (id.place().0 % step, id.place().1 % step);
        let expected = offset(first.id);
        if let Some(odd) = galaxies.iter().find(|own| offset(own.id) != expected) {
            let message = format!(
                "galaxy {}: its offset from the first galaxy of its subfield is not a multiple of {NODES_PER_GALAXY} nodes (found {:?}, expected {expected:?} as of {})",
                odd.id,
                offset(odd.id),
                first.id
            );
            return Err(
                FileError::new(file(odd), message).hint("the identities of galaxy_catalog-*.fits")
            );
        }
        let measured =
            |own: &&Galaxy| own.weight > 0.0 && own.g.e1 < NOT_AVERAGED && own.g.e2 < NOT_AVERAGED;
        let shears = galaxies.iter().filter(measured);
        let shears: Vec<_> = shears.map(|own| [own.g.e1, own.g.e2]).collect();
        // True shears, which all galaxies of a field share, have no such galaxies among others.
        let among_others = |found: &Repeated<2>| {
            found.rows as f64 > MIN_PLACEHOLDER_SHARE * found.of as f64 && !found.is_constant()
        };
        if let Some(found) = repeated(&shears, EQUAL_SHEARS).filter(among_others) {
            let message = format!(
                "subfield {subfield}: {} of {} galaxies have repeated shears, most often {:?}; expected measured values, which do not repeat",
                found.rows, found.of, found.value
            );
            return Err(
                FileError::new(file(first), message).hint("10 for a galaxy that was not measured")
            );
        }
        let count = grid(packing) * grid(packing);
        let found = galaxies.len();
        if found != count {
            let there: BTreeSet<Identity> = galaxies.iter().map(|own| own.id).collect();
            let nodes = |offset: usize| (0..grid(packing)).map(move |k| step * k + offset);
            let all = nodes(expected.0).flat_map(|x| nodes(expected.1).map(move |y| (x, y)));
            let mut all = all.map(|place| Identity::new(subfield, place));
            let id = all.find(|id| !there.contains(id)).unwrap_or(first.id);
            let more = more(count - found);
            let message = format!(
                "galaxy {id} is missing{more}: subfield {subfield} has {found} galaxies, expected {count}"
            );
            return Err(FileError::new(file(first), message)
                .hint("a row with g1 = g2 = 10 for each galaxy that was not measured"));
        }
        Ok(())
    }

    pub(super) fn summarise(
        &self,
        packing: &Presubmitting<'_>,
        pool: &Pool,
    ) -> Result<Presubmission, FileError> {
        let size = self.branch.subfields_per_field() * grid(packing) * grid(packing);
        let fields: Vec<Range<usize>> = (0..self.galaxies.len())
            .step_by(size)
            .map(|start| start..(start + size).min(self.galaxies.len()))
            .collect();
        let file = &self.files[0];
        let mut text = String::new();
        if self.branch.constant {
            text += "# index g1 g2\n";
            for (field, range) in fields.into_iter().enumerate() {
                let mean = |of: fn(&Shear) -> f64, other: fn(&Shear) -> f64| {
                    let own = self.galaxies[range.clone()].iter().filter(|own| {
                        of(&own.g) < NOT_AVERAGED
                            && (!packing.whole_galaxies || other(&own.g) < NOT_AVERAGED)
                    });
                    let (mut sum, mut weight) = (0.0, 0.0);
                    for own in own {
                        sum += own.weight * of(&own.g);
                        weight += own.weight;
                    }
                    match weight > 0.0 {
                        true => Ok(sum / weight),
                        false => Err(unmeasured(file, field)),
                    }
                };
                let g1 = mean(|g| g.e1, |g| g.e2)?;
                let g2 = mean(|g| g.e2, |g| g.e1)?;
                if Shear::new(g1, g2) == Shear::ZERO {
                    return wrong(file, zero(field, "(g1, g2)"));
                }
                let _ = writeln!(text, "{field} {g1} {g2}");
            }
        } else {
            text += "# field theta[deg] map_E map_B error\n";
            let limit = if packing.whole_galaxies {
                NOT_AVERAGED
            } else {
                NOT_CORRELATED
            };
            let masses = pool.in_order(fields.into_iter().enumerate(), |(field, range)| {
                self.masses(&self.galaxies[range], limit)
                    .map_err(|fault| match fault {
                        Some(error) => error,
                        None => unmeasured(file, field),
                    })
            });
            for (field, own) in masses.enumerate() {
                let own = own?;
                // Without a pair, or of galaxies without shears.
                if own.map_e.iter().all(|mass| *mass == 0.0) {
                    return wrong(file, zero(field, "map_E"));
                }
                for b in 0..SEPARATION_BINS {
                    let _ = writeln!(
                        text,
                        "{field} {} {:e} {:e} {:e}",
                        own.theta[b], own.map_e[b], own.map_b[b], own.error[b]
                    );
                }
            }
        }
        let note = self.note();
        Ok(Presubmission { text, note })
    }

    fn note(&self) -> String {
        let number = |is: &dyn Fn(f64) -> bool| {
            let all = self.galaxies.iter();
            all.filter(|own| is(own.g.e1) || is(own.g.e2)).count()
        };
        let mut note = format!(
            "{} galaxies of {}, {} not measured",
            self.galaxies.len(),
            self.branch,
            number(&|g| g.is_nan() || g >= NOT_AVERAGED)
        );
        if !self.unused.is_empty() {
            let unused: Vec<&str> = self.unused.iter().map(String::as_str).collect();
            note += &format!("; columns that are not used: {}", names_of(&unused));
        }
        // Estimates may exceed 1, and a cut would bias the mean, so that they count as in the challenge.
        match number(&|g| (1.0..NOT_AVERAGED).contains(&g.abs())) {
            0 => note,
            count => {
                note + &format!(
                    "; {count} with a g of 1 or more, which no galaxy has, count in the means"
                )
            }
        }
    }

    // `None` of galaxies without a shear.
    fn masses(&self, galaxies: &[Galaxy], limit: f64) -> Result<ApertureMass, Option<FileError>> {
        let mut found = lattice()?;
        let mut weight = 0.0;
        for own in galaxies
            .iter()
            .filter(|own| own.g.e1 < limit && own.g.e2 < limit)
        {
            weight += own.weight;
            found
                .add(own.id.place(), own.g, own.weight)
                .map_err(|error| {
                    Some(FileError::new(
                        "GREAT3",
                        format!("galaxy {}: {error}", own.id),
                    ))
                })?;
        }
        match weight > 0.0 {
            true => Ok(found.correlations().aperture_mass()),
            false => Err(None),
        }
    }
}
