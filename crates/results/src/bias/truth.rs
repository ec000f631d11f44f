//! The true shear of catalogues or galaxies.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use shearq_dataset::layout::stated_sign;
use shearq_dataset::truth::{Sign, SignBasis};
use shearq_files::FileError;
use shearq_files::open::{SETTINGS, read_to_string};
use shearq_files::table::{self, Place};
use shearq_scoring::TruthSign;

use super::columns::{Role, names_of_role};
use super::identity;
use super::positions::{Positions, check};

/// Where the true shear comes from.
#[derive(Debug, Clone, Default)]
pub enum Truth {
    /// From columns of the catalogues, if there are any.
    #[default]
    Columns,
    /// All catalogues have one shear.
    Constant([f64; 2]),
    /// A shear per catalogue, by its path or parts of it: the name of its file or of a folder above.
    Catalogues(BTreeMap<String, [f64; 2]>),
    /// A shear per galaxy, by the key of its identifier.
    Galaxies(Arc<HashMap<u64, [f64; 2]>>),
    /// A shear per galaxy, by its position.
    Positions(Arc<Positions>),
    /// A shear per galaxy of each catalogue, by its position.
    Data(BTreeMap<PathBuf, Arc<Positions>>),
}

/// The sign of g2 in a [`Truth`].
#[derive(Debug, Clone, Default, PartialEq)]
pub enum TrueSign {
    /// Shears that the user typed or keeps beside ellipticities, and data folders: standard.
    #[default]
    Convention,
    /// It is known.
    Known(Sign),
    /// The catalogues must determine the sign of this file.
    OfCatalogues(PathBuf),
}

impl TrueSign {
    /// The sign that was specified, else the standard one.
    pub fn or_standard(specified: Option<TruthSign>) -> Self {
        let basis = SignBasis::Specified;
        specified.map_or(TrueSign::Convention, |of| {
            TrueSign::Known(Sign { of, basis })
        })
    }
}

/// Names of the column of catalogues in a table of true shears.
const CATALOGUE: [&str; 3] = ["catalogue", "catalog", "file"];

impl Truth {
    /// Reads a table of true shears: columns `catalogue g1 g2` (text), or `id g1 g2` or `x y g1 g2` in any format, with
    /// the sign of its g2. The shears themselves are as in the file.
    ///
    /// # Errors
    /// If the file cannot be read or has other columns, names a catalogue or galaxy twice, or states another sign than
    /// `specified`.
    pub fn read(path: &Path, specified: Option<TruthSign>) -> Result<(Self, TrueSign), FileError> {
        let place = Place::of(path);
        let columns = table::columns(&place)?;
        // A table with a shear per catalogue is typed by the user, as --g1 and --g2 are; another one must have a sign.
        let sign = |undetermined: Option<TrueSign>, by_modes: &dyn Fn() -> Option<TruthSign>| {
            let found = Sign::of_truth(stated_sign(&place.path)?, specified, by_modes)
                .map_err(|fault| FileError::new(path, fault))?;
            Ok(found.map_or(undetermined.unwrap_or_default(), TrueSign::Known))
        };
        // Names in any case: FITS writers like capitals.
        let named = |name: &str| {
            let mut names = columns.named.iter().flat_map(|list| &list.names);
            names
                .find(|own| own.eq_ignore_ascii_case(name))
                .map(String::as_str)
        };
        if CATALOGUE.iter().any(|name| named(name).is_some()) {
            return Ok((of_catalogues(path)?, sign(None, &|| None)?));
        }
        let unclear = Some(TrueSign::OfCatalogues(path.to_owned()));
        let shears = named("g1").zip(named("g2"));
        let positions = named("x").zip(named("y"));
        let other = || names_of_role(Role::Id).find_map(named);
        let id = named("id").or_else(|| other().filter(|_| positions.is_none()));
        if let (Some(_), None, Some(_)) = (shears, id, positions) {
            let positions = Positions::read(path, TruthSign::Standard)?;
            let sign = sign(unclear, &|| positions.sign_by_modes())?;
            return Ok((Truth::Positions(Arc::new(positions)), sign));
        }
        let (Some((name1, name2)), Some(id)) = (shears, id) else {
            let found: Vec<&String> = columns.named.iter().flat_map(|list| &list.names).collect();
            return Err(FileError::new(
                path,
                format!(
                    "this is no table of true shears (found {}, expected the columns id, g1, g2 or x, y, g1, g2 or catalogue, g1, g2)",
                    shearq_files::names_of(&found)
                ),
            ));
        };
        let mut galaxies = HashMap::new();
        table::read_parts(&place, &[id, name1, name2], &[id], |part| {
            let column = |name| table::numbers(&part, name, path);
            let (g1, g2) = (column(name1)?, column(name2)?);
            for (row, key) in identity::keys(&part, id, path)?.into_iter().enumerate() {
                let shear = [g1[row], g2[row]];
                check(shear)
                    .map_err(|fault| FileError::new(path, format!("row {}: {fault}", row + 1)))?;
                if galaxies.insert(key, shear).is_some() {
                    let message = format!(
                        "row {}: the identifier {} occurs twice",
                        row + 1,
                        identity::shown(&part, id, row)
                    );
                    return Err(FileError::new(path, message));
                }
            }
            Ok(())
        })?;
        Ok((
            Truth::Galaxies(Arc::new(galaxies)),
            sign(unclear, &|| None)?,
        ))
    }

    /// The same with the shear of each of `catalogues` by its path, if catalogues have a shear each.
    ///
    /// # Errors
    /// If the table of catalogues does not contain one, or it is not clear which rows belong to which catalogues.
    pub(super) fn of_paths<'p>(
        &self,
        catalogues: impl IntoIterator<Item = &'p Path>,
    ) -> Result<Self, FileError> {
        let Truth::Catalogues(all) = self else {
            return Ok(self.clone());
        };
        let (mut found, mut files) = (BTreeMap::new(), BTreeMap::new());
        for path in catalogues {
            let name = row_of(all.keys(), path)?;
            let is_file = Path::new(name).file_name() == path.file_name();
            if let Some(other) = files.insert(name, path).filter(|_| is_file) {
                let message = format!(
                    "`{name}` in the table of true shears is this catalogue and {}; expected one. Try: the folder before the name",
                    other.display()
                );
                return Err(FileError::new(path, message));
            }
            found.insert(path.display().to_string(), all[name]);
        }
        Ok(Truth::Catalogues(found))
    }

    /// The shear of a catalogue; `None` if it is not known, or depends on the galaxy.
    pub(crate) fn of_catalogue(&self, path: &Path) -> Option<[f64; 2]> {
        match self {
            Truth::Constant(shear) => Some(*shear),
            Truth::Catalogues(all) => all.get(&path.display().to_string()).copied(),
            Truth::Columns | Truth::Galaxies(_) | Truth::Positions(_) | Truth::Data(_) => None,
        }
    }

    /// The shears of a catalogue by position, if they are known so.
    ///
    /// # Errors
    /// If they are known of other catalogues only.
    pub(super) fn positions(&self, path: &Path) -> Result<Option<&Positions>, FileError> {
        match self {
            Truth::Positions(positions) => Ok(Some(positions)),
            Truth::Data(all) => match all.get(path) {
                Some(positions) => Ok(Some(positions)),
                None => Err(FileError::new(
                    path,
                    "this catalogue has no known true shear, but the folders have one. Try: separate commands, or --truth FILE",
                )),
            },
            _ => Ok(None),
        }
    }
}

/// The name among `names` that is the path of a catalogue, or the longest one that is a part of it.
fn row_of<'n>(
    names: impl IntoIterator<Item = &'n String>,
    path: &Path,
) -> Result<&'n String, FileError> {
    // `FILE[TABLE]` is also meant by the name of the file.
    let whole = Place::of(path).path;
    let same: Vec<Vec<_>> = [path, &whole]
        .map(|path| path.components().collect())
        .into();
    let (mut best, mut length, mut all) = (Vec::new(), 0, Vec::new());
    for name in names {
        all.push(name);
        let own: Vec<_> = Path::new(name).components().collect();
        let part = |parts: &Vec<_>| parts.windows(own.len()).any(|some| some == own);
        if own.is_empty() || own.len() < length || !same.iter().any(part) {
            continue;
        }
        if own.len() > length {
            (length, best) = (own.len(), Vec::new());
        }
        best.push(name);
    }
    match best[..] {
        [one] => Ok(one),
        [] => Err(FileError::new(
            path,
            format!(
                "the table of true shears does not contain this catalogue (found {}; expected this path, the name of the file, or a folder of it)",
                shearq_files::names_of(&all)
            ),
        )),
        [first, second, ..] => Err(FileError::new(
            path,
            format!(
                "`{first}` and `{second}` in the table of true shears both fit this catalogue; expected one. Try: longer names"
            ),
        )),
    }
}

/// A text table of catalogues with their shears.
fn of_catalogues(path: &Path) -> Result<Truth, FileError> {
    let text = read_to_string(path, SETTINGS)
        .map_err(FileError::doing(path, "cannot read the true shears"))?;
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(number, line)| (number + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let fields = |line: &str| -> Vec<String> {
        let split: Vec<&str> = match line.contains(',') {
            true => line.split(',').collect(),
            false => line.split_whitespace().collect(),
        };
        split
            .iter()
            .map(|field| field.trim().trim_matches('"').to_owned())
            .collect()
    };
    let header = lines
        .next()
        .map(|(_, line)| fields(line))
        .unwrap_or_default();
    let place = |names: &[&str]| header.iter().position(|own| names.contains(&own.as_str()));
    let (Some(name), Some(g1), Some(g2)) = (place(&CATALOGUE), place(&["g1"]), place(&["g2"]))
    else {
        return Err(FileError::new(
            path,
            "the first line does not name the columns (expected catalogue, g1, g2)",
        ));
    };
    let mut all = BTreeMap::new();
    for (number, line) in lines {
        let fields = fields(line);
        let fault = |fault: String| FileError::new(path, format!("line {number}: {fault}"));
        let value = |column: usize| {
            let field = fields.get(column).map_or("", String::as_str);
            field
                .parse::<f64>()
                .map_err(|_| fault(format!("found `{field}`, expected a number")))
        };
        let shear = [value(g1)?, value(g2)?];
        check(shear).map_err(&fault)?;
        let name = fields.get(name).cloned().unwrap_or_default();
        if all.insert(name.clone(), shear).is_some() {
            return Err(fault(format!("the catalogue {name} occurs twice")));
        }
    }
    Ok(Truth::Catalogues(all))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The shears of catalogues by a table of names, or why they are not known.
    fn shears(table: &[(&str, f64)], catalogues: &[&str]) -> Result<Vec<f64>, String> {
        let table = table.iter().map(|(name, g)| ((*name).to_owned(), [*g; 2]));
        let truth = Truth::Catalogues(table.collect());
        let truth = truth.of_paths(catalogues.iter().map(Path::new));
        let truth = truth.map_err(|error| error.to_string())?;
        let found = catalogues.iter().map(Path::new);
        Ok(found
            .map(|path| truth.of_catalogue(path).unwrap()[0])
            .collect())
    }

    #[test]
    fn catalogues_are_named_by_paths_files_or_folders() {
        let (plus, minus) = ("out/plus/set01/c-1.parquet", "out/minus/set01/c-1.parquet");
        let more = "out/plus/set01/c-2.parquet";
        for names in [
            [plus, minus],
            ["plus", "minus"],
            ["out/plus", "out/minus/set01"],
            // The longest name counts.
            ["out", "minus/set01/c-1.parquet"],
        ] {
            let table = [(names[0], 0.02), (names[1], -0.02)];
            let found = shears(&table, &[plus, more, minus]);
            match names[0] == plus {
                true => assert!(
                    found
                        .unwrap_err()
                        .contains("does not contain this catalogue")
                ),
                false => assert_eq!(found.unwrap(), [0.02, 0.02, -0.02]),
            }
        }
        assert_eq!(shears(&[("c-1.parquet", 0.01)], &[plus]).unwrap(), [0.01]);
        for (table, reason) in [
            (vec![("c-1.parquet", 0.01)], "expected one. Try: the folder"),
            (
                vec![("plus", 0.01), ("minus", 0.0), ("out", 0.0)],
                "both fit",
            ),
            (
                vec![("plus", 0.01), ("inus", 0.0), ("", 0.0)],
                "found , inus, plus",
            ),
        ] {
            let found = shears(&table, &[plus, minus]).unwrap_err();
            assert!(found.contains(reason), "{reason}: {found}");
        }
    }
}
