//! Tables of named columns. Files are read by their first bytes and written by their ending.
//!
//! | file | format |
//! |---|---|
//! | starts like a FITS file, plain or compressed by gzip, whatever its name (`.fits`, `.cat`, `.ldac`, `.ftz`) | FITS table |
//! | starts like a Parquet file, whatever its name (`.parquet`, `.parq`, `.pq`) | Parquet |
//! | starts like an Arrow file, whatever its name (`.feather`, `.arrow`) | Arrow |
//! | anything else (`.csv`, `.dat`, `.txt`, `.cat`, `.csv.gz`) | text, plain or compressed by gzip: numbers between commas, semicolons, tabs or blanks, as the content has them; columns `x y e1 e2` unless a header or the comments of SExtractor name them |
//!
//! `FILE[TABLE]` is a table of a FITS file, by name or number.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use crate::frames::polars::DataFrame;
use crate::frames::{Metadata, reals};

use crate::FileError;
use crate::content::Content;
use crate::fields::numbers_alone;
use crate::open::is_there;

use crate::fits::TableHead;
use crate::{arrow, atomic, fits, parquet, text};

pub use crate::MAX_ROWS;

/// A column of numbers of the table of `path`; missing ones are NaN.
pub fn numbers<'t>(
    table: &'t DataFrame,
    name: &str,
    path: &Path,
) -> Result<Cow<'t, [f64]>, FileError> {
    let column = table.column(name).ok();
    column.and_then(reals).ok_or_else(|| {
        let texts = column.and_then(|own| own.str().ok());
        match texts.map(|own| own.iter().flatten().next().unwrap_or_default()) {
            Some(first) => {
                let message = format!(
                    "column `{name}` holds texts (found `{first}` first, expected numbers)"
                );
                FileError::new(path, message).hint(match text::is_sexagesimal(first) {
                    true => text::DEGREES_HINT,
                    false => "a table with a column of numbers",
                })
            }
            None => {
                let message = format!("there is no column `{name}` that holds numbers");
                FileError::new(path, message)
            }
        }
    })
}

#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "lowercase")]
pub enum FileFormat {
    #[default]
    Parquet,
    Fits,
}

impl FileFormat {
    /// The format of a file by its name or first bytes; `None` of others, whose metadata are not read.
    pub fn of(path: &Path) -> Option<Self> {
        match Ending::of(path) {
            Ending::Parquet => Some(FileFormat::Parquet),
            Ending::Fits => Some(FileFormat::Fits),
            Ending::Arrow | Ending::Text => None,
        }
    }

    pub fn extension(self) -> &'static str {
        match self {
            FileFormat::Parquet => "parquet",
            FileFormat::Fits => "fits",
        }
    }
}

enum Ending {
    Parquet,
    Arrow,
    Fits,
    Text,
}

impl Ending {
    // By the first bytes; by the name of a file that is damaged, or still to be written.
    fn of(path: &Path) -> Self {
        match Content::of(path) {
            Content::Parquet => return Ending::Parquet,
            Content::Arrow => return Ending::Arrow,
            Content::Fits => return Ending::Fits,
            Content::Text | Content::Other(..) => {}
        }
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

// Rows that a catalogue may have in addition to the cells of its grid.
const SPARE_ROWS: usize = 1 << 18;

/// Most rows that a catalogue of galaxies on a grid of `cells` may have: more than are scored, so that it can be
/// said how many there are.
pub fn most_rows(cells: usize) -> usize {
    cells + SPARE_ROWS
}

#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    pub path: PathBuf,
    /// Name (EXTNAME) or number (the first extension is 1) of a table of a FITS file.
    pub table: Option<String>,
}

impl Place {
    /// The place that `FILE[TABLE]` names, if no file has all of that for its name and one is called `FILE`.
    pub fn of(path: &Path) -> Self {
        let whole = Place {
            path: path.to_owned(),
            table: None,
        };
        if is_there(path) {
            return whole;
        }
        let inner = path.to_str().and_then(|text| text.strip_suffix(']'));
        match inner.and_then(|text| text.rsplit_once('[')) {
            Some((file, table)) if !table.is_empty() && is_there(Path::new(file)) => Place {
                path: PathBuf::from(file),
                table: Some(table.to_owned()),
            },
            _ => whole,
        }
    }

    /// The place that `FILE[TABLE]` names, or `table` of this file if it is given.
    pub fn with_table(path: &Path, table: Option<&str>) -> Result<Self, FileError> {
        let mut place = Place::of(path);
        if let Some(name) = table
            && let Some(other) = place.table.replace(name.to_owned())
        {
            let message = format!(
                "two tables are named (found `{other}` in brackets and `{name}`, expected one)"
            );
            return Err(FileError::new(path, message));
        }
        Ok(place)
    }

    /// Refuses a format that is not read, and a table of a file that has only one.
    fn check(&self) -> Result<(), FileError> {
        Content::of(&self.path).check(&self.path)?;
        match (&self.table, Ending::of(&self.path)) {
            (Some(table), Ending::Text | Ending::Parquet | Ending::Arrow) => {
                let message = format!(
                    "the file is no FITS file (found table `{table}`, expected the file's name alone)"
                );
                Err(FileError::new(&self.path, message))
            }
            _ => Ok(()),
        }
    }
}

/// Names and fields of a table, before columns are chosen.
#[derive(Debug, Clone, Default)]
pub struct Columns {
    /// Lists of names, one to be chosen: a header, comments that may be one, or the tables of a FITS file.
    pub named: Vec<Named>,
    /// Fields of the first row of a text table that has no header.
    pub unnamed: Vec<String>,
    /// Words of the other comments of such a table, whose number differs from that of its fields, so that they name no column.
    pub remarks: Vec<Vec<String>>,
}

#[derive(Debug, Clone)]
pub struct Named {
    pub names: Vec<String>,
    /// The table of a FITS file that has them.
    pub table: Option<TableHead>,
    /// Whether they are words of a comment, which may be no names at all.
    pub doubtful: bool,
}

/// The columns that the table of a file has, of one table if `place` names it.
pub fn columns(place: &Place) -> Result<Columns, FileError> {
    place.check()?;
    let path = &place.path;
    let plain = |names, doubtful| Named {
        names,
        table: None,
        doubtful,
    };
    let named = match Ending::of(path) {
        Ending::Parquet => vec![plain(parquet::columns(path)?, false)],
        Ending::Arrow => vec![plain(arrow::columns(path)?, false)],
        Ending::Fits => {
            let tables = fits::tables(path, place.table.as_deref())?.into_iter();
            let named = tables.map(|head| Named {
                names: head.columns.clone(),
                table: Some(head),
                doubtful: false,
            });
            named.collect()
        }
        Ending::Text => {
            let found = text::columns(path)?;
            match found.names {
                Some(names) => vec![plain(names, false)],
                None => {
                    let count = found.fields.len();
                    let comments = found.comments.into_iter();
                    let (names, remarks): (Vec<_>, Vec<_>) =
                        comments.partition(|words| words.len() == count);
                    return Ok(Columns {
                        named: names.into_iter().map(|words| plain(words, true)).collect(),
                        unnamed: found.fields,
                        remarks,
                    });
                }
            }
        }
    };
    Ok(Columns {
        named,
        ..Columns::default()
    })
}

/// Reads the columns `wanted` (all, if `None`) as real numbers. A
/// table of text, in Parquet or in Arrow has at most `most_rows`. Columns of a text table without names have numbers, from 1.
pub fn read(
    path: &Path,
    wanted: Option<&[&str]>,
    most_rows: usize,
) -> Result<DataFrame, FileError> {
    read_from(&Place::of(path), wanted, most_rows)
}

pub fn read_from(
    place: &Place,
    wanted: Option<&[&str]>,
    most_rows: usize,
) -> Result<DataFrame, FileError> {
    place.check()?;
    let path = &place.path;
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
        identities: &[],
        default_names: &text::CHALLENGE_COLUMNS,
        most_rows,
    };
    let table = match Ending::of(path) {
        Ending::Parquet => parquet::read(path, wanted, most_rows)?,
        Ending::Arrow => arrow::read(path, wanted, most_rows)?,
        Ending::Fits => return fits::read_table(path, wanted, place.table.as_deref()),
        Ending::Text => return text::read(path, &request),
    };
    numbers_alone(path, table, wanted.is_some())
}

/// The number that a field of a text table stands for: also a truth value (1 or 0), and NaN if it is missing.
pub fn number_of(field: &str) -> Option<f64> {
    text::value(field)
}

/// The first value of each column of texts. Of a text table, any field of the first row may be one.
pub fn first_texts(place: &Place) -> Result<Vec<(String, String)>, FileError> {
    place.check()?;
    let path = &place.path;
    match Ending::of(path) {
        Ending::Parquet => parquet::first_texts(path),
        Ending::Arrow => arrow::first_texts(path),
        Ending::Fits => fits::first_texts(path, place.table.as_deref()),
        Ending::Text => {
            let found = text::columns(path)?;
            let names = found.names.into_iter().flatten();
            Ok(names.zip(found.fields).collect())
        }
    }
}

pub const TRUTH_COLUMNS: [&str; 4] = ["x", "y", "g1", "g2"];

// Rows of a FITS table that are read at a time.
const ROWS_PER_PART: usize = 1 << 17;

/// Reads the columns `wanted` in parts, and gives each part to `take`: row groups of a Parquet file, record batches of an Arrow file, a fixed number of
/// rows of a FITS table, and all of a text table. So a table may have any number of rows. Columns of text are read too, of a
/// text table those in `identities`; 64-bit integers keep all digits.
pub fn read_parts(
    place: &Place,
    wanted: &[&str],
    identities: &[&str],
    mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
) -> Result<(), FileError> {
    place.check()?;
    let path = &place.path;
    match Ending::of(path) {
        Ending::Parquet => parquet::read_groups(path, wanted, MAX_ROWS, take),
        Ending::Arrow => arrow::read_batches(path, wanted, MAX_ROWS, take),
        Ending::Fits => {
            fits::read_table_parts(path, wanted, place.table.as_deref(), ROWS_PER_PART, take)
        }
        Ending::Text => {
            let request = text::Request {
                wanted: Some(wanted),
                identities,
                default_names: &text::CHALLENGE_COLUMNS,
                most_rows: MAX_ROWS,
            };
            take(text::read(path, &request)?)
        }
    }
}

/// Reads a truth file's x, y, g1, g2, of at most `most_rows`.
pub fn read_truth(path: &Path, most_rows: usize) -> Result<DataFrame, FileError> {
    match Ending::of(path) {
        Ending::Text => read_text(path, &TRUTH_COLUMNS),
        Ending::Fits | Ending::Parquet | Ending::Arrow => {
            read(path, Some(&TRUTH_COLUMNS), most_rows)
        }
    }
}

/// Whether the columns of a file have types, so that a text of digits is no number.
pub fn has_types(path: &Path) -> bool {
    !matches!(Ending::of(path), Ending::Text)
}

/// Reads an ASCII or CSV table. `names` are the columns of a table without a header.
pub fn read_text(path: &Path, names: &[&str]) -> Result<DataFrame, FileError> {
    let request = text::Request {
        wanted: Some(names),
        identities: &[],
        default_names: names,
        most_rows: MAX_ROWS,
    };
    text::read(path, &request)
}

/// The value of `key` that a table of any format states: in a comment `# key: value ...` before the first row of
/// a text table, in the header of a FITS table, or in the metadata of a Parquet or Arrow file.
pub fn stated(path: &Path, key: &str) -> Result<Option<String>, FileError> {
    let format = match Ending::of(path) {
        Ending::Text => {
            let value = |comment: &String| {
                let rest = comment.strip_prefix(key)?.trim_start();
                let rest = rest.strip_prefix(['=', ':'])?;
                rest.split_whitespace().next().map(str::to_owned)
            };
            return Ok(text::comments(path)?.iter().find_map(value));
        }
        Ending::Arrow => {
            let found = arrow::metadata(path)?.remove(key);
            return Ok(found.map(|value| value.trim().to_owned()));
        }
        Ending::Parquet => FileFormat::Parquet,
        Ending::Fits => FileFormat::Fits,
    };
    let mut found = read_metadata(path, format, [key])?;
    Ok(found.remove(key).map(|value| value.trim().to_owned()))
}

/// The part of `metadata` that a table written as `format` contains: all in Parquet, and keys of at most eight
/// characters in FITS.
pub fn kept(metadata: &Metadata, format: FileFormat) -> Metadata {
    metadata
        .iter()
        .filter(|(key, _)| format == FileFormat::Parquet || key.len() <= 8)
        .map(|(key, value)| (key.clone(), value.clone()))
        .collect()
}

/// The values of `keys` that a table written by [`write()`] carries, those that it has.
pub fn read_metadata(
    path: &Path,
    format: FileFormat,
    keys: impl IntoIterator<Item = impl AsRef<str>>,
) -> Result<Metadata, FileError> {
    match format {
        FileFormat::Parquet => {
            let mut all = parquet::metadata(path)?;
            let keys = keys.into_iter();
            Ok(keys
                .filter_map(|key| all.remove_entry(key.as_ref()))
                .collect())
        }
        FileFormat::Fits => {
            let found = fits::read_table_keys(path, keys)?;
            let whole = found.into_iter();
            Ok(whole.map(|(key, value)| (key, unescaped(&value))).collect())
        }
    }
}

/// A text in the characters that a FITS header may have: ASCII, with `\n`, `\\` and `\u{…}` for others.
fn escaped(text: &str) -> String {
    text.chars()
        .map(|c| match c {
            '\\' => "\\\\".to_owned(),
            ' '..='~' => c.to_string(),
            _ => c.escape_default().to_string(),
        })
        .collect()
}

// The text that `escaped` made this of. Other texts stay as they are.
fn unescaped(text: &str) -> String {
    let (mut plain, mut rest) = (String::with_capacity(text.len()), text);
    while let Some((before, after)) = rest.split_once('\\') {
        plain.push_str(before);
        let code = || {
            let (code, after) = after.strip_prefix("u{")?.split_once('}')?;
            Some((char::from_u32(u32::from_str_radix(code, 16).ok()?)?, after))
        };
        let simple = [('n', '\n'), ('r', '\r'), ('t', '\t'), ('\\', '\\')];
        let simple = simple.into_iter();
        let known = simple.filter_map(|(name, c)| Some((c, after.strip_prefix(name)?)));
        let (c, after) = known.chain(code()).next().unwrap_or(('\\', after));
        plain.push(c);
        rest = after;
    }
    plain + rest
}

/// Writes `table` in this `format`, with the part of `metadata` that is [`kept`].
pub fn write(
    path: &Path,
    format: FileFormat,
    table: &DataFrame,
    metadata: &Metadata,
) -> Result<(), FileError> {
    match format {
        FileFormat::Parquet => {
            let bytes = parquet::encode(table, metadata);
            atomic::write(path, &bytes.map_err(|error| FileError::new(path, error))?)
        }
        FileFormat::Fits => {
            let keys: Vec<(String, fits::Value)> = kept(metadata, format)
                .into_iter()
                .map(|(key, value)| (key.to_ascii_uppercase(), fits::Value::Text(escaped(&value))))
                .collect();
            let header: Vec<(&str, fits::Value)> =
                keys.iter().map(|(k, v)| (k.as_str(), v.clone())).collect();
            fits::write_table(path, table, &header)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_text_survives_a_fits_header() {
        let texts = [
            "plain",
            "a\n\n\tb = \"c\" # \\n\r",
            "σ·γ \u{1F30C}",
            "\\u{",
            "\\",
            "'it''s'",
        ];
        for text in texts {
            let header = escaped(text);
            assert!(
                header.bytes().all(|b| (b' '..=b'~').contains(&b)),
                "{header}"
            );
            assert_eq!(unescaped(&header), text);
        }
        // Of other programs.
        assert_eq!(unescaped("C:\\data"), "C:\\data");
        assert_eq!(unescaped("\\u{zz}"), "\\u{zz}");
    }

    #[test]
    fn long_metadata_are_the_same_in_both_formats() {
        let folder = tempfile::tempdir().unwrap();
        let column = crate::frames::polars::Column::new("x".into(), [1.0, 2.0]);
        let table = crate::frames::frame(vec![column]).unwrap();
        let long = "key = \"it's\"\n".repeat(300);
        let metadata = Metadata::from([("settings".into(), long), ("creator".into(), "σ".into())]);
        for format in [FileFormat::Parquet, FileFormat::Fits] {
            let path = folder
                .path()
                .join("table")
                .with_extension(format.extension());
            write(&path, format, &table, &metadata).unwrap();
            let found = read_metadata(&path, format, metadata.keys()).unwrap();
            assert_eq!(found, metadata, "{format:?}");
        }
    }
}
