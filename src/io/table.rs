//! Tables of named columns, read and written by the file's ending.
//!
//! | ending | format |
//! |---|---|
//! | `.fits`, `.fit`, these with `.gz`, `.fits.fz` | FITS binary table |
//! | `.parquet`, `.pq` | Parquet |
//! | anything else (`.csv`, `.dat`, `.txt`, `.cat`, `.csv.gz`) | text, plain or compressed by gzip: numbers between commas, semicolons, tabs or blanks, as the content has them; columns `x y e1 e2` unless a header names them |

use std::collections::BTreeMap;
use std::path::Path;

use shearq_scoring::Grid;

use super::error::FileError;
use super::fits;
use super::text;

/// One column.
#[derive(Debug, Clone, PartialEq)]
pub enum Column {
    /// Real numbers; NaN is a missing value.
    Real(Vec<f64>),
    /// Whole numbers.
    Whole(Vec<i64>),
    /// Words.
    Text(Vec<String>),
}

impl Column {
    /// Number of rows.
    pub fn len(&self) -> usize {
        match self {
            Column::Real(values) => values.len(),
            Column::Whole(values) => values.len(),
            Column::Text(values) => values.len(),
        }
    }

    /// Whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Columns of equal length with unique names.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Table {
    columns: Vec<(String, Column)>,
}

impl Table {
    /// From columns.
    ///
    /// # Errors
    /// A message where lengths differ or names repeat.
    pub fn new(columns: Vec<(String, Column)>) -> Result<Self, String> {
        for (k, (name, column)) in columns.iter().enumerate() {
            let (first_name, first) = &columns[0];
            if column.len() != first.len() {
                return Err(format!(
                    "column `{name}` has {} rows, but `{first_name}` has {}",
                    column.len(),
                    first.len()
                ));
            }
            if columns[..k].iter().any(|(other, _)| other == name) {
                return Err(format!("there are two columns named `{name}`"));
            }
        }
        Ok(Table { columns })
    }

    /// Names and columns, in order.
    pub fn columns(&self) -> &[(String, Column)] {
        &self.columns
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.columns.first().map_or(0, |(_, column)| column.len())
    }

    /// Takes a column of `path` out as real numbers.
    ///
    /// # Errors
    /// Where it is not there.
    pub fn require(&mut self, name: &str, path: &Path) -> Result<Vec<f64>, FileError> {
        self.take_real(name).ok_or_else(|| {
            FileError::new(
                path,
                format!("there is no column `{name}` that holds numbers, or it is asked for twice"),
            )
        })
    }

    /// Takes a column out as real numbers.
    pub fn take_real(&mut self, name: &str) -> Option<Vec<f64>> {
        let at = self.columns.iter().position(|(own, _)| own == name)?;
        match self.columns.swap_remove(at).1 {
            Column::Real(values) => Some(values),
            Column::Whole(values) => Some(values.into_iter().map(|v| v as f64).collect()),
            Column::Text(_) => None,
        }
    }
}

/// File format of a table.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// Parquet.
    Parquet,
    /// FITS binary table.
    Fits,
}

impl Format {
    /// Ending of file names.
    pub fn extension(self) -> &'static str {
        match self {
            Format::Parquet => "parquet",
            Format::Fits => "fits",
        }
    }
}

impl Default for Format {
    /// Parquet where this build has it, FITS elsewhere.
    fn default() -> Self {
        if cfg!(feature = "parquet") {
            Format::Parquet
        } else {
            Format::Fits
        }
    }
}

/// What a file is by its ending.
enum Ending {
    Parquet,
    Fits,
    Text,
}

impl Ending {
    fn of(path: &Path) -> Self {
        let name = path.to_string_lossy().to_ascii_lowercase();
        let ends = |endings: &[&str]| endings.iter().any(|end| name.ends_with(end));
        if ends(&[".parquet", ".pq"]) {
            Ending::Parquet
        } else if ends(&[".fits", ".fit", ".fits.gz", ".fit.gz", ".fits.fz"]) {
            Ending::Fits
        } else {
            Ending::Text
        }
    }
}

/// Most rows of a table that may fill the largest grid.
pub const MAX_ROWS: usize = Grid::MAX_SIDE * Grid::MAX_SIDE;
/// Rows that a catalogue may have beyond those of its grid.
const SPARE_ROWS: usize = 1 << 18;

/// Most rows that a catalogue of galaxies on `grid` may have: more than are scored, so that it can be
/// said how many there are.
pub fn most_rows(grid: &Grid) -> usize {
    grid.cells() + SPARE_ROWS
}

/// Reads the columns `wanted` (all, if `None`) as real numbers; the format follows from the ending. A
/// text table has at most `most_rows`.
///
/// # Errors
/// Where the file cannot be read, or lacks a column.
pub fn read(path: &Path, wanted: Option<&[&str]>, most_rows: usize) -> Result<Table, FileError> {
    if let Some(wanted) = wanted {
        for (k, column) in wanted.iter().enumerate() {
            if wanted[..k].contains(column) {
                let message = format!("the column `{column}` is asked for twice");
                return Err(FileError::new(path, message));
            }
        }
    }
    let request = text::Request {
        wanted,
        default_names: &text::CHALLENGE_COLUMNS,
        most_rows,
    };
    match Ending::of(path) {
        Ending::Parquet => read_parquet(path, wanted),
        Ending::Fits => fits::read_table(path, wanted),
        Ending::Text => text::read(path, &request),
    }
}

/// Reads a truth file's x, y, g1, g2: a text table, which needs no header, or another format.
///
/// # Errors
/// Where the file cannot be read, or lacks a column.
pub fn read_truth(path: &Path) -> Result<Table, FileError> {
    const NAMES: [&str; 4] = ["x", "y", "g1", "g2"];
    match Ending::of(path) {
        Ending::Text => read_text(path, &NAMES),
        Ending::Parquet | Ending::Fits => read(path, Some(&NAMES), MAX_ROWS),
    }
}

/// Reads an ASCII or CSV table whose columns, where it has no header, are `names`.
///
/// # Errors
/// Where the file cannot be read.
pub fn read_text(path: &Path, names: &[&str]) -> Result<Table, FileError> {
    let request = text::Request {
        wanted: Some(names),
        default_names: names,
        most_rows: MAX_ROWS,
    };
    text::read(path, &request)
}

/// What is left of `metadata` in a table written as `format`: all in Parquet; in FITS what fits into a
/// header, which is keys of at most eight characters with values of at most 68.
pub fn kept(metadata: &BTreeMap<String, String>, format: Format) -> BTreeMap<String, String> {
    let fits = |key: &str, value: &str| key.len() <= 8 && value.len() <= 68;
    metadata
        .iter()
        .filter(|(key, value)| format == Format::Parquet || fits(key, value))
        .map(|(key, value)| (key.clone(), value.clone()))
        .collect()
}

/// The values of `keys` that a table written by [`write`] carries, those that it has.
///
/// # Errors
/// Where the file cannot be read, or this build lacks its format.
pub fn read_metadata<'a>(
    path: &Path,
    format: Format,
    keys: impl Iterator<Item = &'a String>,
) -> Result<BTreeMap<String, String>, FileError> {
    match format {
        Format::Parquet => {
            let mut all = parquet_metadata(path)?;
            Ok(keys.filter_map(|key| all.remove_entry(key)).collect())
        }
        Format::Fits => fits::read_table_keys(path, keys),
    }
}

/// Writes `table` as `format`, with the key–value pairs that say what made it, as far as
/// they are [`kept`].
///
/// # Errors
/// Where the file cannot be written, or this build lacks the format.
pub fn write(
    path: &Path,
    format: Format,
    table: Table,
    metadata: &BTreeMap<String, String>,
) -> Result<(), FileError> {
    match format {
        Format::Parquet => write_parquet(path, table, metadata),
        Format::Fits => {
            let keys: Vec<(String, fits::Value)> = kept(metadata, format)
                .into_iter()
                .map(|(key, value)| (key.to_ascii_uppercase(), fits::Value::Text(value)))
                .collect();
            let header: Vec<(&str, fits::Value)> =
                keys.iter().map(|(k, v)| (k.as_str(), v.clone())).collect();
            fits::write_table(path, &table, &header)
        }
    }
}

#[cfg(feature = "parquet")]
use super::parquet::{metadata as parquet_metadata, read as read_parquet, write as write_parquet};

#[cfg(not(feature = "parquet"))]
fn read_parquet(path: &Path, _wanted: Option<&[&str]>) -> Result<Table, FileError> {
    Err(FileError::new(path, WITHOUT_PARQUET))
}

#[cfg(not(feature = "parquet"))]
fn parquet_metadata(path: &Path) -> Result<BTreeMap<String, String>, FileError> {
    Err(FileError::new(path, WITHOUT_PARQUET))
}

#[cfg(not(feature = "parquet"))]
fn write_parquet(
    path: &Path,
    _table: Table,
    _metadata: &BTreeMap<String, String>,
) -> Result<(), FileError> {
    Err(FileError::new(path, WITHOUT_PARQUET))
}

#[cfg(not(feature = "parquet"))]
pub(super) const WITHOUT_PARQUET: &str =
    "this build of shearq has no Parquet support; rebuild with the feature `parquet` or use FITS";
