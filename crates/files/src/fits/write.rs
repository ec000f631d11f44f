//! Writing FITS files, without cfitsio: bytes go through the standard library, which reports every write that fails.

use std::fs::File;
use std::io::Write;
use std::path::Path;

use crate::frames::polars::{Column, DataFrame};
use crate::frames::reals;

use super::file::{BLOCK, CARD, MAX_COLUMNS};
use crate::FileError;
use crate::atomic::{self, PartFile};

// Most characters of a text between its quotes.
const LONGEST_TEXT: usize = 68;
// Fewest characters of a text between its quotes.
const SHORTEST_TEXT: usize = 8;
// Significant digits that distinguish any two numbers.
const DIGITS: i32 = 17;

#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    Int(i64),
    Real(f64),
    /// Text of printable ASCII characters. A long one continues on CONTINUE cards.
    Text(String),
}

#[derive(Debug, Default)]
struct Header(String);

impl Header {
    /// The header of a file: `bits` per pixel, negative for floats, and the `sides`, x first.
    fn primary(bits: i64, sides: &[usize]) -> Self {
        let mut header = Header::default();
        header.logical("SIMPLE", "file does conform to FITS standard");
        header.count("BITPIX", bits, "number of bits per data pixel");
        header.count("NAXIS", sides.len(), "number of data axes");
        for (axis, side) in sides.iter().enumerate() {
            let axis = axis + 1;
            let comment = format!("length of data axis {axis}");
            header.count(&format!("NAXIS{axis}"), side, &comment);
        }
        header.logical("EXTEND", "FITS dataset may contain extensions");
        for line in [
            "  FITS (Flexible Image Transport System) format is defined in 'Astronomy",
            "  and Astrophysics', volume 376, page 359; bibcode: 2001A&A...376..359H",
        ] {
            header.card(format!("COMMENT {line}"));
        }
        header
    }

    fn add(&mut self, key: &str, value: &Value) -> Result<(), String> {
        let allowed = |c: char| matches!(c, 'A'..='Z' | '0'..='9' | '-' | '_');
        if !(1..=8).contains(&key.len()) || !key.chars().all(allowed) {
            return Err(format!(
                "`{key}` is no key of a FITS header: one to eight of A-Z, 0-9, - and _"
            ));
        }
        match value {
            Value::Int(value) => self.fixed(key, &value.to_string(), ""),
            Value::Real(value) if value.is_finite() => self.fixed(key, &real(*value), ""),
            Value::Real(value) => {
                return Err(format!(
                    "the header key {key} cannot have the value {value}"
                ));
            }
            Value::Text(value) => self.text(key, value, "")?,
        }
        Ok(())
    }

    fn text(&mut self, key: &str, value: &str, comment: &str) -> Result<(), String> {
        if let Some(other) = value.chars().find(|c| !matches!(c, ' '..='~')) {
            return Err(format!(
                "the header key {key} has the character {other:?}; FITS allows printable ASCII"
            ));
        }
        let pieces = pieces(value);
        let last = pieces.len() - 1;
        for (k, piece) in pieces.iter().enumerate() {
            let start = match k {
                0 => format!("{key:<8}= "),
                _ => "CONTINUE  ".to_owned(),
            };
            let quoted = match k {
                _ if k < last => format!("'{piece}&'"),
                _ => format!("'{piece:<SHORTEST_TEXT$}'"),
            };
            let comment = if comment.is_empty() {
                String::new()
            } else {
                format!(" / {comment}")
            };
            self.card(format!("{start}{quoted:<20}{comment}"));
        }
        Ok(())
    }

    fn count(&mut self, key: &str, value: impl ToString, comment: &str) {
        self.fixed(key, &value.to_string(), comment);
    }

    /// The blocks of the finished header.
    fn blocks(mut self) -> Vec<u8> {
        self.card("END".into());
        let mut bytes = self.0.into_bytes();
        bytes.resize(bytes.len().next_multiple_of(BLOCK), b' ');
        bytes
    }

    fn logical(&mut self, key: &str, comment: &str) {
        self.fixed(key, "T", comment);
    }

    // A value in fixed format: it ends in column 30 if it has room.
    fn fixed(&mut self, key: &str, value: &str, comment: &str) {
        let comment = if comment.is_empty() {
            String::new()
        } else {
            format!(" / {comment}")
        };
        self.card(format!("{key:<8}= {value:>20}{comment}"));
    }

    fn card(&mut self, text: String) {
        self.0.push_str(&format!("{text:<CARD$.CARD$}"));
    }
}

// A text with its quotes doubled, in pieces that each fit on a card. All but the last leave room for `&`.
fn pieces(text: &str) -> Vec<String> {
    let mut pieces = vec![String::new()];
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        let width = 1 + usize::from(letter == '\'');
        let room = LONGEST_TEXT - usize::from(letters.peek().is_some());
        let mut piece = pieces.pop().unwrap_or_default();
        if piece.len() + width > room {
            pieces.push(piece);
            piece = String::new();
        }
        for _ in 0..width {
            piece.push(letter);
        }
        pieces.push(piece);
    }
    pieces
}

// A finite number with `DIGITS` digits, without zeros at the end: `0.5`, `3.` or `1.0E-12`.
fn real(value: f64) -> String {
    let scientific = format!("{:.*e}", DIGITS as usize - 1, value);
    let (mantissa, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let trimmed = |number: &str| number.trim_end_matches('0').to_owned();
    if (-4..DIGITS).contains(&exponent) {
        let decimals = (DIGITS - 1 - exponent) as usize;
        let number = format!("{value:.decimals$}");
        return if number.contains('.') {
            trimmed(&number)
        } else {
            number + "."
        };
    }
    let mut mantissa = trimmed(mantissa);
    if mantissa.ends_with('.') {
        mantissa.push('0');
    }
    let sign = if exponent < 0 { '-' } else { '+' };
    format!("{mantissa}E{sign}{:02}", exponent.abs())
}

pub struct ImageWriter {
    file: File,
    part: PartFile,
    width: usize,
    height: usize,
    next_row: usize,
    bytes: Vec<u8>,
}

impl std::fmt::Debug for ImageWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ImageWriter").finish_non_exhaustive()
    }
}

impl ImageWriter {
    /// Starts an image of 32-bit floats.
    pub fn create(
        path: impl AsRef<Path>,
        width: usize,
        height: usize,
        header: &[(&str, Value)],
    ) -> Result<Self, FileError> {
        let path = path.as_ref();
        let header = image_header([width, height], header).map_err(cannot(path))?;
        let (part, file) = PartFile::create(path)?;
        let mut writer = ImageWriter {
            file,
            part,
            width,
            height,
            next_row: 0,
            bytes: header,
        };
        writer.write()?;
        Ok(writer)
    }

    pub fn write_rows(&mut self, pixels: &[f32]) -> Result<(), FileError> {
        let rows = pixels.len() / self.width;
        if rows * self.width != pixels.len() || self.next_row + rows > self.height {
            return Err(FileError::new(
                self.part.target(),
                format!(
                    "{} pixels are not the next rows of this image",
                    pixels.len()
                ),
            ));
        }
        self.bytes.clear();
        self.bytes
            .extend(pixels.iter().flat_map(|pixel| pixel.to_be_bytes()));
        self.write()?;
        self.next_row += rows;
        Ok(())
    }

    pub fn finish(self) -> Result<(), FileError> {
        self.closed()?.finish()
    }

    /// Like [`ImageWriter::finish`], but does not replace an existing file. Returns whether the file was written.
    pub fn finish_if_absent(self) -> Result<bool, FileError> {
        self.closed()?.finish_if_absent()
    }

    fn closed(mut self) -> Result<PartFile, FileError> {
        let ImageWriter {
            width,
            height,
            next_row,
            ..
        } = self;
        if next_row != height {
            return Err(FileError::new(
                self.part.target(),
                format!("{next_row} of {height} rows were written"),
            ));
        }
        let data = size_of::<f32>() * width * height;
        self.bytes.clear();
        self.bytes.resize(data.next_multiple_of(BLOCK) - data, 0);
        self.write()?;
        Ok(self.part)
    }

    fn write(&mut self) -> Result<(), FileError> {
        let written = self.file.write_all(&self.bytes);
        written.map_err(FileError::doing(
            self.part.target(),
            "cannot write the image",
        ))
    }
}

// The error for a file `path` that cannot be written.
fn cannot(path: &Path) -> impl Fn(String) -> FileError {
    move |error| FileError::new(path, format!("cannot write the file: {error}"))
}

/// The blocks of the header of an image of `sides` = [columns, rows] 32-bit floats.
fn image_header(sides: [usize; 2], keys: &[(&str, Value)]) -> Result<Vec<u8>, String> {
    let mut header = Header::primary(-32, &sides);
    header.text("EXTNAME", "_PRIMARY", "")?;
    for (key, value) in keys {
        header.add(key, value)?;
    }
    Ok(header.blocks())
}

enum Values {
    Real(Vec<f64>),
    Whole(Vec<i64>),
    Text(Vec<String>, usize),
    /// Of one row.
    Vector(Vec<f64>),
}

impl Values {
    fn of(column: &Column) -> Self {
        let series = column.as_materialized_series();
        if let Ok(whole) = series.i64()
            && whole.null_count() == 0
        {
            return Values::Whole(whole.iter().flatten().collect());
        }
        match reals(column) {
            Some(values) => Values::Real(values.into_owned()),
            None => {
                let words = series.str().into_iter().flat_map(|words| words.iter());
                let words: Vec<String> = words.map(|word| word.unwrap_or("").to_owned()).collect();
                let longest = words.iter().map(String::len).max().unwrap_or(0).max(1);
                Values::Text(words, longest)
            }
        }
    }

    /// Bytes per row, the format's letter with its count, and its name.
    fn format(&self) -> (usize, String, &'static str) {
        match self {
            Values::Real(_) => (size_of::<f64>(), "1D".into(), "8-byte DOUBLE"),
            Values::Whole(_) => (size_of::<i64>(), "1K".into(), "8-byte INTEGER"),
            Values::Text(_, longest) => (*longest, format!("{longest}A"), "ASCII Character"),
            Values::Vector(all) => {
                let (bytes, count) = (size_of_val(all.as_slice()), all.len());
                (bytes, format!("{count}D"), "8-byte DOUBLE")
            }
        }
    }

    // Appends the value of a row as it stands in the file: big-endian numbers, texts with spaces at their end.
    fn append(&self, row: usize, bytes: &mut Vec<u8>) {
        match self {
            Values::Real(values) => bytes.extend(values[row].to_be_bytes()),
            Values::Whole(values) => bytes.extend(values[row].to_be_bytes()),
            Values::Text(words, longest) => {
                let end = bytes.len() + longest;
                bytes.extend(words[row].as_bytes());
                bytes.resize(end, b' ');
            }
            Values::Vector(all) => bytes.extend(all.iter().flat_map(|value| value.to_be_bytes())),
        }
    }
}

/// Writes `table` as the only binary table of a file, with `header` keys of at most eight characters.
pub fn write_table(
    path: &Path,
    table: &DataFrame,
    header: &[(&str, Value)],
) -> Result<(), FileError> {
    let bytes = table_bytes(table, header).map_err(cannot(path))?;
    atomic::write(path, &bytes)
}

fn table_bytes(table: &DataFrame, keys: &[(&str, Value)]) -> Result<Vec<u8>, String> {
    if table.width() > MAX_COLUMNS {
        return Err(format!(
            "the table has {} columns; FITS allows {MAX_COLUMNS}",
            table.width()
        ));
    }
    let columns: Vec<(&str, Values)> = table
        .columns()
        .iter()
        .map(|column| (column.name().as_str(), Values::of(column)))
        .collect();
    bytes_of_columns(&columns, table.height(), keys)
}

/// Writes a table of one row with one column, a vector, as [`read_vector`](super::read_vector) reads it.
pub fn write_vector(
    path: &Path,
    column: &str,
    vector: Vec<f64>,
    keys: &[(&str, Value)],
) -> Result<(), FileError> {
    let columns = [(column, Values::Vector(vector))];
    let bytes = bytes_of_columns(&columns, 1, keys).map_err(cannot(path))?;
    atomic::write(path, &bytes)
}

fn bytes_of_columns(
    columns: &[(&str, Values)],
    rows: usize,
    keys: &[(&str, Value)],
) -> Result<Vec<u8>, String> {
    let width: usize = columns.iter().map(|(_, values)| values.format().0).sum();
    let mut bytes = Header::primary(8, &[]).blocks();
    bytes.extend(table_header(columns, width, rows, keys)?);
    let start = bytes.len();
    bytes.reserve(width * rows + BLOCK);
    for row in 0..rows {
        for (_, values) in columns {
            values.append(row, &mut bytes);
        }
    }
    let data = bytes.len() - start;
    bytes.resize(start + data.next_multiple_of(BLOCK), 0);
    Ok(bytes)
}

/// The blocks of the header of a binary table with rows of `width` bytes (FITS standard 4.0, section 7.3).
fn table_header(
    columns: &[(&str, Values)],
    width: usize,
    rows: usize,
    keys: &[(&str, Value)],
) -> Result<Vec<u8>, String> {
    let mut header = Header::default();
    header.text("XTENSION", "BINTABLE", "binary table extension")?;
    header.count("BITPIX", 8, "8-bit bytes");
    header.count("NAXIS", 2, "2-dimensional binary table");
    header.count("NAXIS1", width, "width of table in bytes");
    header.count("NAXIS2", rows, "number of rows in table");
    header.count("PCOUNT", 0, "size of special data area");
    header.count("GCOUNT", 1, "one data group (required keyword)");
    header.count("TFIELDS", columns.len(), "number of fields in each row");
    for (k, (name, values)) in columns.iter().enumerate() {
        let k = k + 1;
        let (_, code, kind) = values.format();
        header.text(
            &format!("TTYPE{k}"),
            name,
            &format!("label for field {k:>3}"),
        )?;
        header.text(
            &format!("TFORM{k}"),
            &code,
            &format!("data format of field: {kind}"),
        )?;
    }
    header.text(
        "EXTNAME",
        "CATALOGUE",
        "name of this binary table extension",
    )?;
    for (key, value) in keys {
        header.add(key, value)?;
    }
    Ok(header.blocks())
}

#[cfg(test)]
mod tests {
    use super::super::{read_table, read_table_keys};
    use super::*;
    use crate::frames::polars::{NamedFrom, Series};

    #[test]
    fn a_vector_is_read_back_with_its_keys() {
        let path = std::env::temp_dir().join(format!("shearq-vector-{}.fits", std::process::id()));
        let keys = [("DEGREE", Value::Int(2))];
        write_vector(&path, "MASK", vec![1.5, -2.0, 3e5], &keys).unwrap();
        let (found, cards) = super::super::read_vector(&path, 1, "MASK").unwrap();
        std::fs::remove_file(&path).unwrap();
        assert_eq!(
            (found, cards["DEGREE"].as_str()),
            (vec![1.5, -2.0, 3e5], "2")
        );
    }

    #[test]
    fn a_table_of_all_kinds_of_columns_is_read_back() {
        let columns = vec![
            Column::from(Series::new("id".into(), [1_i64, i64::MIN, i64::MAX])),
            Column::from(Series::new("x".into(), [1.5_f64, f64::NAN, -1e-300])),
            Column::from(Series::new("bulge".into(), [1.5_f32, 2.0, -1e30])),
            Column::from(Series::new("missing".into(), [Some(7_i64), None, Some(9)])),
            Column::from(Series::new("name".into(), ["a", "", "long words"])),
        ];
        let table = DataFrame::new(3, columns).unwrap();
        let folder = tempfile::tempdir().unwrap();
        for rows in [0, 1, 3] {
            let path = folder.path().join(format!("{rows}.fits"));
            let table = table.head(Some(rows));
            let note = "word ".repeat(40);
            let header = [("NOTE", Value::Text(note.clone()))];
            write_table(&path, &table, &header).unwrap();
            assert_eq!(path.metadata().unwrap().len() as usize % BLOCK, 0);
            let names = ["id", "x", "bulge", "missing"];
            let read = read_table(&path, Some(&names), None).unwrap();
            assert_eq!(read.height(), rows);
            for name in names {
                let bits = |frame: &DataFrame| -> Vec<u64> {
                    let values = reals(frame.column(name).unwrap()).unwrap().into_owned();
                    values.into_iter().map(f64::to_bits).collect()
                };
                assert_eq!(bits(&read), bits(&table), "{name}");
            }
            let keys = read_table_keys(&path, ["NOTE".to_owned()].iter()).unwrap();
            assert_eq!(keys["NOTE"].trim_end(), note.trim_end());
        }
    }

    #[test]
    fn what_fits_does_not_allow_is_refused_and_leaves_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("table.fits");
        let column = |name: String| Column::from(Series::new(name.into(), [1.0_f64]));
        let many = (0..=MAX_COLUMNS).map(|k| column(format!("c{k}"))).collect();
        let many = DataFrame::new(1, many).unwrap();
        let found = write_table(&path, &many, &[]).unwrap_err().to_string();
        assert!(found.contains("1000 columns; FITS allows 999"), "{found}");
        let named = DataFrame::new(1, vec![column("größe".into())]).unwrap();
        let found = write_table(&path, &named, &[]).unwrap_err().to_string();
        assert!(
            found.contains("'ö'") && found.contains("printable ASCII"),
            "{found}"
        );
        assert!(!path.exists());
    }

    fn cards(header: Header) -> Vec<String> {
        let blocks = header.blocks();
        assert_eq!(blocks.len() % BLOCK, 0);
        let lines = blocks
            .chunks(CARD)
            .map(|card| String::from_utf8(card.to_vec()).unwrap());
        lines
            .map(|line| line.trim_end().to_owned())
            .filter(|line| !line.is_empty())
            .collect()
    }

    #[test]
    fn numbers_have_all_their_digits() {
        // C prints these strings for "%.17G", without the decimal point at the end.
        let known = [
            (0.0, "0."),
            (-0.0, "-0."),
            (1.0, "1."),
            (-2.5, "-2.5"),
            (0.1, "0.10000000000000001"),
            (1e-4, "0.0001"),
            (1e-5, "1.0000000000000001E-05"),
            (1e16, "10000000000000000."),
            (1e17, "1.0E+17"),
            (2.5e-300, "2.5E-300"),
            (123_456_789.125, "123456789.125"),
            (f64::MAX, "1.7976931348623157E+308"),
        ];
        for (value, text) in known {
            assert_eq!(real(value), text, "{value:e}");
            assert_eq!(text.parse::<f64>().unwrap().to_bits(), f64::to_bits(value));
        }
    }

    #[test]
    fn texts_continue_and_keep_their_quotes() {
        for length in [0, 1, 7, 8, 67, 68, 69, 134, 135, 136, 300] {
            for quote in ['x', '\''] {
                let text: String = (0..length)
                    .map(|k| if k % 3 == 1 { quote } else { 'a' })
                    .collect();
                let mut header = Header::default();
                header.add("KEY", &Value::Text(text.clone())).unwrap();
                let cards = cards(header);
                let mut read = String::new();
                for card in &cards[..cards.len() - 1] {
                    let inner = card[10..]
                        .strip_prefix('\'')
                        .unwrap()
                        .strip_suffix('\'')
                        .unwrap();
                    assert!(inner.len() <= LONGEST_TEXT && inner.len() >= SHORTEST_TEXT);
                    read.truncate(read.trim_end_matches('&').len());
                    read.push_str(&inner.replace("''", "'"));
                }
                assert_eq!(read.trim_end(), text);
            }
        }
    }

    #[test]
    fn what_the_standard_forbids_is_refused() {
        let mut header = Header::default();
        for key in ["", "lower", "TOO_LONG_", "A B", "Ä"] {
            assert!(header.add(key, &Value::Int(1)).is_err(), "{key}");
        }
        for value in [f64::NAN, f64::INFINITY] {
            assert!(header.add("KEY", &Value::Real(value)).is_err());
        }
        assert!(
            header
                .add("KEY", &Value::Text("two\nlines".into()))
                .is_err()
        );
        assert_eq!(cards(header), ["END"]);
    }
}
