//! The true shear of catalogues or galaxies.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use shearq_files::FileError;
use shearq_files::open::{SETTINGS, read_to_string};
use shearq_files::table::{self, MAX_ROWS, Place};
use shearq_scoring::TruthSign;

use super::positions::{Positions, check};

/// Where the true shear comes from.
#[derive(Debug, Clone, Default)]
pub enum Truth {
    /// From columns of the catalogues, if there are any.
    #[default]
    Columns,
    /// All catalogues have one shear.
    Constant([f64; 2]),
    /// A shear per catalogue, by its path or file name.
    Catalogues(BTreeMap<String, [f64; 2]>),
    /// A shear per galaxy, by the bits of its identifier.
    Galaxies(Arc<HashMap<u64, [f64; 2]>>),
    /// A shear per galaxy, by its position.
    Positions(Arc<Positions>),
    /// A shear per galaxy of each catalogue, by its position.
    Data(BTreeMap<PathBuf, Arc<Positions>>),
}

/// Names of the column of catalogues in a table of true shears.
const CATALOGUE: [&str; 3] = ["catalogue", "catalog", "file"];

impl Truth {
    /// Reads a table of true shears: columns `catalogue g1 g2` (text), or `id g1 g2` or
    /// `x y g1 g2` in any format.
    ///
    /// # Errors
    /// If the file cannot be read or has other columns, or names a catalogue or galaxy twice.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let place = Place::of(path);
        let columns = table::columns(&place)?;
        let named = |name: &str| {
            let mut lists = columns.named.iter();
            lists.any(|list| list.names.iter().any(|own| own == name))
        };
        if CATALOGUE.iter().any(|name| named(name)) {
            return of_catalogues(path);
        }
        let shears = named("g1") && named("g2");
        if shears && !named("id") && named("x") && named("y") {
            let positions = Positions::read(path, TruthSign::Standard)?;
            return Ok(Truth::Positions(Arc::new(positions)));
        }
        if !(shears && named("id")) {
            let found: Vec<&String> = columns.named.iter().flat_map(|list| &list.names).collect();
            return Err(FileError::new(
                path,
                format!(
                    "this is no table of true shears (found {}, expected the columns id, g1, g2 or x, y, g1, g2 or catalogue, g1, g2)",
                    shearq_files::names_of(&found)
                ),
            ));
        }
        let read = table::read_from(&place, Some(&["id", "g1", "g2"]), MAX_ROWS)?;
        let column = |name| table::numbers(&read, name, path);
        let (ids, g1, g2) = (column("id")?, column("g1")?, column("g2")?);
        let mut galaxies = HashMap::with_capacity(ids.len());
        for (row, id) in ids.iter().enumerate() {
            let shear = [g1[row], g2[row]];
            check(shear)
                .map_err(|fault| FileError::new(path, format!("row {}: {fault}", row + 1)))?;
            if galaxies.insert(id.to_bits(), shear).is_some() {
                let message = format!("row {}: the identifier {id} occurs twice", row + 1);
                return Err(FileError::new(path, message));
            }
        }
        Ok(Truth::Galaxies(Arc::new(galaxies)))
    }

    /// The shear of a catalogue; `None` if it depends on the galaxy.
    ///
    /// # Errors
    /// If the table of catalogues does not contain this one.
    pub(crate) fn of_catalogue(&self, path: &Path) -> Result<Option<[f64; 2]>, FileError> {
        match self {
            Truth::Constant(shear) => Ok(Some(*shear)),
            Truth::Catalogues(all) => {
                let name = path
                    .file_name()
                    .map(|name| name.to_string_lossy().into_owned());
                let found = all
                    .get(&path.display().to_string())
                    .or_else(|| all.get(&name.unwrap_or_default()));
                found.copied().map(Some).ok_or_else(|| {
                    let names: Vec<&String> = all.keys().collect();
                    FileError::new(
                        path,
                        format!(
                            "the table of true shears does not contain this catalogue (found {})",
                            shearq_files::names_of(&names)
                        ),
                    )
                })
            }
            Truth::Columns | Truth::Galaxies(_) | Truth::Positions(_) | Truth::Data(_) => Ok(None),
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
