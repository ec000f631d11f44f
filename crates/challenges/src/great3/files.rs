//! Truth as it was released or simulated, and submissions: mean shears and aperture masses of fields.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use shearq_dataset::great3::{self as released, Parameters, file_name};
use shearq_dataset::threads::Pool;
use shearq_files::open::is_there;
use shearq_files::{FileError, table};
use shearq_quantities::Shear;
use shearq_scoring::aperture::{Lattice, LatticeShear, SEPARATION_BINS, separations};
use shearq_scoring::great3::{Identity, NODES_PER_GALAXY, SUBFIELDS_PER_FIELD};
use shearq_scoring::{Repeated, repeated};

use super::rules::{Great3, NOT_CORRELATED, more, not_an_identity, zero};
use crate::Truth;
use crate::columns::{Columns, whole, wrong};

// Q_c needs shears to 2·10⁻⁴: below, values count as equal. Aperture masses of shear alone are below 10⁻⁹ at the largest separations.
pub(super) const EQUAL_SHEARS: f64 = 1e-4;
const EQUAL_MASSES: f64 = 1e-14;

// Refuses placeholders of fields that were not measured. A program that writes them would gain: Q_v of zeros is high.
fn refuse_repeated<const N: usize>(
    path: &Path,
    rows: &[[f64; N]],
    step: f64,
    name: impl Fn(Option<usize>) -> &'static str,
) -> Result<(), FileError> {
    if let Some(field) = rows
        .iter()
        .position(|row| row.iter().all(|own| *own == 0.0))
    {
        return wrong(path, zero(field, name(None)));
    }
    let Some(found) = repeated(rows, step) else {
        return Ok(());
    };
    let Repeated { rows, of, .. } = found;
    let (name, field) = (name(found.component), found.first);
    let message = format!(
        "{rows} of {of} fields have repeated values of {name}, the first of them field {field}; expected measured values, which do not repeat"
    );
    wrong(path, message)
}

const SHEARS: Columns<'static> = Columns {
    // Also as the challenge's program calls them.
    names: &[
        &["index", "field", "subfield_index", "field_index"],
        &["g1"],
        &["g2"],
    ],
    required: 3,
    unnamed: &[(3, &[0, 1, 2])],
};

const MASSES: Columns<'static> = Columns {
    names: &[
        &["field", "index", "field_index"],
        &["theta", "theta[deg]"],
        &["map_E"],
        &["map_B"],
        &["error"],
    ],
    required: 5,
    unnamed: &[(5, &[0, 1, 2, 3, 4])],
};

impl Great3 {
    // The folder that holds `stem` of subfield 0: the given one, or that of the branch below it.
    fn folder(&self, root: &Path, stem: &str) -> Result<PathBuf, FileError> {
        let below = root.join(self.0.folder());
        let folders = [root.to_owned(), below];
        let found = folders.iter().find(|folder| {
            let is = |ending: &&str| is_there(&folder.join(format!("{stem}.{ending}")));
            ["yaml", "txt", "fits"].iter().any(is)
        });
        found.cloned().ok_or_else(|| {
            let message = format!(
                "found no {stem}.yaml, .txt or .fits, here or in {}",
                folders[1].display()
            );
            FileError::new(root, message)
        })
    }

    pub(super) fn true_shears(&self, truth: &Path, fields: usize) -> Result<Vec<Shear>, FileError> {
        if !truth.is_dir() {
            return self.read_shears(truth, fields);
        }
        let folder = self.folder(truth, &file_name(released::SHEARS, 0, 0))?;
        let per = self.0.subfields_per_field();
        let shear = |subfield: usize| {
            let stem = file_name(released::SHEARS, subfield, 0);
            match Parameters::read(&folder, &stem)? {
                Some(found) => shear_of(&found),
                None => Err(missing(&folder, &stem, fields * per)),
            }
        };
        refuse_more(&folder, released::SHEARS, fields * per)?;
        let of_field = |field: usize| {
            let first = field * per;
            let g = shear(first)?;
            for subfield in first + 1..first + per {
                let other = shear(subfield)?;
                if (other.e1 - g.e1).hypot(other.e2 - g.e2) > EQUAL_SHEARS {
                    let message = format!(
                        "subfields {first} and {subfield} of field {field} have different shears (found {} {} and {} {}, expected one)",
                        g.e1, g.e2, other.e1, other.e2
                    );
                    return wrong(&folder, message);
                }
            }
            Ok(g)
        };
        (0..fields).map(of_field).collect()
    }

    // Mean ellipticities of the PSF of each of `fields`.
    pub(super) fn psfs(&self, truth: Truth<'_>, fields: usize) -> Result<Vec<Shear>, FileError> {
        let (subfields, epochs) = (fields * self.0.subfields_per_field(), self.0.epochs());
        let source = truth.psf.unwrap_or(truth.path);
        if truth.psf.is_none() && !source.is_dir() {
            return Err(FileError::new(source, "Q_c needs the PSF").hint("--psf FILE"));
        }
        let known = match source.is_dir() {
            true => self.psfs_of_folder(source, subfields)?,
            false => self.psfs_of_table(source, subfields)?,
        };
        // A subfield without a known PSF counts as round, as in the challenge.
        let mean = |shears: &[Shear]| match shears.len() {
            0 => Shear::ZERO,
            n => {
                let mean = |of: fn(&Shear) -> f64| shears.iter().map(of).sum::<f64>() / n as f64;
                Shear::new(mean(|g| g.e1), mean(|g| g.e2))
            }
        };
        let subfields: Vec<Shear> = known
            .chunks(epochs)
            .map(|epochs| mean(&epochs.iter().copied().flatten().collect::<Vec<_>>()))
            .collect();
        Ok(subfields
            .chunks(self.0.subfields_per_field())
            .map(mean)
            .collect())
    }

    // The PSF of each epoch of each subfield; `None` if it is not known.
    fn psfs_of_folder(
        &self,
        folder: &Path,
        subfields: usize,
    ) -> Result<Vec<Option<Shear>>, FileError> {
        let folder = self.folder(folder, &file_name(released::PSF_SHAPES, 0, 0))?;
        let epochs = self.0.epochs();
        refuse_more(&folder, released::PSF_SHAPES, subfields)?;
        let psf = |k: usize| {
            let stem = file_name(released::PSF_SHAPES, k / epochs, k % epochs);
            match Parameters::read(&folder, &stem)? {
                Some(found) => psf_of(&found),
                None => {
                    let of = format!("{subfields} subfields with {epochs} epochs each");
                    wrong(
                        &folder,
                        format!("found no {stem}.yaml or .txt; expected {of}"),
                    )
                }
            }
        };
        let found: Result<Vec<_>, _> = (0..subfields * epochs).map(psf).collect();
        let extra = file_name(released::PSF_SHAPES, 0, epochs);
        match Parameters::read(&folder, &extra)? {
            Some(extra) => {
                let message = format!(
                    "{} has no such epoch (expected {epochs} per subfield)",
                    self.0
                );
                wrong(&extra.path, message)
            }
            None => found,
        }
    }

    fn psfs_of_table(
        &self,
        path: &Path,
        subfields: usize,
    ) -> Result<Vec<Option<Shear>>, FileError> {
        let epochs = self.0.epochs();
        let columns = Columns {
            names: &[&["subfield"], &["epoch"], &["psf_g1"], &["psf_g2"]],
            required: 4,
            unnamed: &[(4, &[0, 1, 2, 3])],
        }
        .read(path)?;
        let mut found = vec![None; subfields * epochs];
        let rows = columns[0].iter().zip(&columns[1]);
        let psfs = columns[2].iter().zip(&columns[3]);
        for (k, ((subfield, epoch), (e1, e2))) in rows.zip(psfs).enumerate() {
            let fault = |message: String| FileError::new(path, format!("row {}: {message}", k + 1));
            let number = |found: f64, end: usize, name: &str| {
                let last = end - 1;
                let message = || {
                    format!(
                        "no {name} of {} (found {found}, expected 0 to {last})",
                        self.0
                    )
                };
                whole(found, end).ok_or_else(|| fault(message()))
            };
            let subfield = number(*subfield, subfields, "subfield")?;
            let epoch = number(*epoch, epochs, "epoch")?;
            let psf = known_psf(Shear::new(*e1, *e2)).map_err(fault)?;
            if found[subfield * epochs + epoch].replace(psf).is_some() {
                return Err(fault(format!(
                    "subfield {subfield} epoch {epoch} is there twice; expected each once"
                )));
            }
        }
        if let Some(k) = found.iter().position(Option::is_none) {
            let message = format!(
                "subfield {} has no PSF of epoch {}; expected {subfields} subfields with {epochs} epochs each",
                k / epochs,
                k % epochs
            );
            return wrong(path, message);
        }
        Ok(found.into_iter().flatten().collect())
    }

    // `index g1 g2`, a row for each field.
    fn read_shears(&self, path: &Path, expected: usize) -> Result<Vec<Shear>, FileError> {
        let columns = SHEARS.read(path)?;
        let mut found = vec![None; expected];
        for (k, &number) in columns[0].iter().enumerate() {
            let field = field_of(path, k, number, expected)?;
            for (name, column) in [("g1", &columns[1]), ("g2", &columns[2])] {
                let found = column[k];
                if found.is_nan() || found.abs() >= 1.0 {
                    let message =
                        format!("field {field}: {name} is {found}, expected a shear below 1");
                    return wrong(path, message);
                }
            }
            let g = Shear::new(columns[1][k], columns[2][k]);
            if found[field].replace(g).is_some() {
                let message = format!("field {field} is there twice; expected each once");
                return wrong(path, message);
            }
        }
        complete(path, found)
    }

    pub(super) fn submitted_shears(
        &self,
        path: &Path,
        fields: usize,
    ) -> Result<Vec<Shear>, FileError> {
        let shears = self.read_shears(path, fields)?;
        let rows: Vec<_> = shears.iter().map(|g| [g.e1, g.e2]).collect();
        let name =
            |component: Option<usize>| ["(g1, g2)", "g1", "g2"][component.map_or(0, |k| k + 1)];
        refuse_repeated(path, &rows, EQUAL_SHEARS, name)?;
        Ok(shears)
    }

    // `field theta map_E map_B error`, a row for each field and bin.
    fn read_masses(&self, path: &Path, expected: usize) -> Result<Vec<Masses>, FileError> {
        let columns = MASSES.read(path)?;
        let mut found = vec![None::<[Option<[f64; 2]>; SEPARATION_BINS]>; expected];
        for (k, &number) in columns[0].iter().enumerate() {
            let field = field_of(path, k, number, expected)?;
            let theta = columns[1][k];
            // As the challenge compares them: equal to 3 decimals.
            let is = |centre: f64| (centre - theta).abs() < 1.5e-3;
            let Some(bin) = separations().iter().position(|centre| is(centre.0)) else {
                let [first, last] = [0, SEPARATION_BINS - 1].map(|bin| separations()[bin].0);
                let message = format!(
                    "field {field}: theta is {theta}, expected one of the {SEPARATION_BINS} centres {first:.4} to {last:.4} degrees to 3 decimals"
                );
                return Err(FileError::new(path, message).hint("shearq pack --challenge great3"));
            };
            for (name, column) in [("map_E", 2), ("map_B", 3), ("error", 4)] {
                let found = columns[column][k];
                let least = if name == "error" { 0.0 } else { -1.0 };
                // Dispersions of shears below 1.
                if !(least..1.0).contains(&found) {
                    let expected = if name == "error" { "0 to 1" } else { "-1 to 1" };
                    let message = format!("field {field}: {name} is {found}, expected {expected}");
                    return wrong(path, message);
                }
            }
            let own = found[field].get_or_insert_default();
            if own[bin].replace([columns[2][k], columns[3][k]]).is_some() {
                let theta = separations()[bin].0;
                let message =
                    format!("field {field}: theta = {theta:.4} is there twice; expected each once");
                return wrong(path, message);
            }
        }
        let mut masses = Vec::new();
        for (field, own) in complete(path, found)?.into_iter().enumerate() {
            if let Some(bin) = own.iter().position(Option::is_none) {
                let theta = separations()[bin].0;
                let message = format!(
                    "field {field}: theta = {theta:.4} is missing; expected {SEPARATION_BINS} rows per field"
                );
                return wrong(path, message);
            }
            let own = own.map(Option::unwrap_or_default);
            masses.push(Masses {
                e: own.map(|[e, _]| e),
                b: own.map(|[_, b]| b),
            });
        }
        Ok(masses)
    }

    pub(super) fn submitted_masses(
        &self,
        path: &Path,
        fields: usize,
    ) -> Result<Vec<Masses>, FileError> {
        let masses = self.read_masses(path, fields)?;
        let rows: Vec<_> = masses.iter().map(|own| own.e).collect();
        refuse_repeated(path, &rows, EQUAL_MASSES, |_| "map_E")?;
        Ok(masses)
    }

    pub(super) fn true_masses(
        &self,
        truth: &Path,
        fields: usize,
        pool: &Pool,
    ) -> Result<Vec<Masses>, FileError> {
        if !truth.is_dir() {
            return self.read_masses(truth, fields);
        }
        let folder = self.folder(
            truth,
            &stem_of(&file_name(released::GALAXY_CATALOGUES, 0, 0)),
        )?;
        let catalogue =
            |subfield: usize| folder.join(file_name(released::GALAXY_CATALOGUES, subfield, 0));
        let subfields = fields * SUBFIELDS_PER_FIELD;
        if let Some(lacking) = (0..subfields).find(|k| !is_there(&catalogue(*k))) {
            let stem = stem_of(&file_name(released::GALAXY_CATALOGUES, lacking, 0));
            return Err(missing(&folder, &stem, subfields));
        }
        if is_there(&catalogue(subfields)) {
            return Err(more_subfields(&catalogue(subfields), subfields));
        }
        let fields = (0..subfields).step_by(SUBFIELDS_PER_FIELD);
        let masses = pool.in_order(fields, |first| {
            let mut galaxies = lattice()?;
            for subfield in first..first + SUBFIELDS_PER_FIELD {
                add_truth(&mut galaxies, &folder, &catalogue(subfield), subfield)?;
            }
            let found = galaxies.correlations().aperture_mass();
            Ok(Masses {
                e: found.map_e,
                b: found.map_b,
            })
        });
        masses.collect()
    }
}

// ⟨M_ap²⟩ of a field by separation.
pub(super) struct Masses {
    pub(super) e: [f64; SEPARATION_BINS],
    pub(super) b: [f64; SEPARATION_BINS],
}

fn stem_of(name: &str) -> String {
    name.trim_end_matches(".fits").to_owned()
}

fn missing(folder: &Path, stem: &str, subfields: usize) -> FileError {
    let message = format!("found no {stem}.*, expected {subfields} subfields");
    FileError::new(folder, message).hint("--subfields N if the branch was simulated with fewer")
}

fn more_subfields(path: &Path, subfields: usize) -> FileError {
    FileError::new(path, format!("expected {subfields} subfields"))
        .hint("--subfields N if the branch was simulated with more")
}

// Refuses files of a subfield after the last: a part of the branch would be scored as the whole.
fn refuse_more(folder: &Path, pattern: &str, subfields: usize) -> Result<(), FileError> {
    match Parameters::read(folder, &file_name(pattern, subfields, 0))? {
        Some(more) => Err(more_subfields(&more.path, subfields)),
        None => Ok(()),
    }
}

// The ellipticity of a PSF; `None` if it is not known, which files state by −10.
fn known_psf(psf: Shear) -> Result<Option<Shear>, String> {
    match psf {
        Shear { e1, e2 } if e1 <= -NOT_CORRELATED || e2 <= -NOT_CORRELATED => Ok(None),
        psf if psf.modulus() < 1.0 => Ok(Some(psf)),
        Shear { e1, e2 } => Err(format!(
            "not the ellipticity of a PSF (found {e1} {e2}, expected a modulus below 1, or -10 if it is not known)"
        )),
    }
}

fn field_of(path: &Path, k: usize, found: f64, fields: usize) -> Result<usize, FileError> {
    let (row, last) = (k + 1, fields - 1);
    whole(found, fields).ok_or_else(|| {
        let message =
            format!("row {row}: not the number of a field (found {found}, expected 0 to {last})");
        FileError::new(path, message)
    })
}

fn complete<T>(path: &Path, found: Vec<Option<T>>) -> Result<Vec<T>, FileError> {
    let expected = found.len();
    let missing = found.iter().position(Option::is_none);
    let there: Vec<T> = found.into_iter().flatten().collect();
    let Some(field) = missing else {
        return Ok(there);
    };
    let found = there.len();
    let more = more(expected - found);
    let message =
        format!("field {field} is missing{more} (found {found} fields, expected {expected})");
    wrong(path, message)
}

pub(super) fn lattice() -> Result<LatticeShear, FileError> {
    LatticeShear::new(Lattice::GREAT3).map_err(|error| FileError::new("GREAT3", error))
}

// Adds the galaxies of a subfield with their intrinsic ellipticities, sheared: ⟨M_ap²⟩ of the shear alone would not have their
// noise, which the submission has.
fn add_truth(
    galaxies: &mut LatticeShear,
    folder: &Path,
    path: &Path,
    subfield: usize,
) -> Result<(), FileError> {
    const WANTED: [&str; 5] = ["ID", "g1", "g2", "g1_intrinsic", "g2_intrinsic"];
    let read = table::read(path, Some(&WANTED), table::MAX_ROWS)?;
    let mut columns = Vec::new();
    for name in WANTED {
        columns.push(table::numbers(&read, name, path)?);
    }
    // Files of offsets are optional, as identities contain them.
    let offset =
        match Parameters::read(folder, &file_name(released::SUBFIELD_OFFSETS, subfield, 0))? {
            None => None,
            Some(found) => Some([found.number("offset_deg_x")?, found.number("offset_deg_y")?]),
        };
    let side = columns[0].len().isqrt();
    if side == 0 || side * side != columns[0].len() {
        let message = format!(
            "found {} galaxies, expected those of a square grid: the table is incomplete",
            columns[0].len()
        );
        return wrong(path, message);
    }
    let is_constant = |column: &[f64]| side > 1 && column.iter().all(|g| *g == column[0]);
    if is_constant(&columns[1]) && is_constant(&columns[2]) {
        let message = format!(
            "all galaxies have the true shear {} {}, expected one that varies",
            columns[1][0], columns[2][0]
        );
        return Err(FileError::new(path, message).hint("--branch with constant shear"));
    }
    let mut seen = BTreeSet::new();
    for (k, &found) in columns[0].iter().enumerate() {
        let id = Identity::of_number(found).filter(|id| id.subfield() == subfield);
        let Some(id) = id else {
            return wrong(path, not_an_identity(k, found));
        };
        if !seen.insert(id) {
            return wrong(
                path,
                format!("galaxy {id} is there twice; expected each once"),
            );
        }
        let (x, y) = id.place();
        // Without repetition, all places of the grid have their galaxy.
        if x.max(y) >= side * NODES_PER_GALAXY {
            let message = format!(
                "galaxy {id} is outside of the grid of {side} × {side} galaxies: others are missing"
            );
            return wrong(path, message);
        }
        if let Some(degrees) = offset {
            let nodes = degrees.map(|offset| {
                (offset * Lattice::GREAT3.side as f64 / Lattice::GREAT3.field.0).round() as usize
            });
            if [x % NODES_PER_GALAXY, y % NODES_PER_GALAXY] != nodes {
                let message = format!(
                    "galaxy {id} disagrees with subfield_offset-{subfield:03} (found the offset {} and {} nodes, expected {} and {})",
                    x % NODES_PER_GALAXY,
                    y % NODES_PER_GALAXY,
                    nodes[0],
                    nodes[1]
                );
                return wrong(path, message);
            }
        }
        let shear = |first: usize| below_one(Shear::new(columns[first][k], columns[first + 1][k]));
        let fault = |message: String| FileError::new(path, format!("galaxy {id}: {message}"));
        let intrinsic = shear(3).map_err(fault)?;
        let g = intrinsic.sheared_by(shear(1).map_err(fault)?);
        galaxies
            .add((x, y), g, 1.0)
            .map_err(|error| FileError::new(path, format!("galaxy {id}: {error}")))?;
    }
    Ok(())
}

fn shear_of(found: &Parameters) -> Result<Shear, FileError> {
    let shear = Shear::new(found.number("g1")?, found.number("g2")?);
    below_one(shear).map_err(|message| FileError::new(&found.path, message))
}

fn psf_of(found: &Parameters) -> Result<Option<Shear>, FileError> {
    let psf = Shear::new(found.number("psf_g1")?, found.number("psf_g2")?);
    known_psf(psf).map_err(|message| FileError::new(&found.path, message))
}

fn below_one(g: Shear) -> Result<Shear, String> {
    match g.modulus() < 1.0 {
        true => Ok(g),
        false => Err(format!(
            "not a shear (found {} {}, expected |g| < 1)",
            g.e1, g.e2
        )),
    }
}
