//! CSV and ASCII tables of numbers, plain or compressed by gzip. Rows are read from a stream, so that the text of a large table
//! is never in memory as a whole.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use csv::{ReaderBuilder, StringRecord};
use flate2::bufread::MultiGzDecoder;

use crate::frames::polars::{Column, DataFrame};

use crate::content::GZIP_MAGIC;
use crate::open;
use crate::{FileError, MAX_EXACT_INTEGER, names_of};

// Columns of a GREAT10 catalogue, an ASCII table without a header.
pub(super) const CHALLENGE_COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

// Of a row with the comments before it, and of everything before the first row. A binary or malicious file has no line feeds,
// and would be read into memory as one line. Chosen by hand.
const MAX_RECORD_BYTES: usize = 1 << 20;
// A file may have one row per byte on disk, and at least this many: gzip can expand a thousandfold, but
// rows of measured numbers do not compress to less than a byte. Chosen by hand.
const MIN_ROW_LIMIT: usize = 1 << 20;
// Chosen by hand.
const BUFFER_BYTES: usize = 1 << 15;
// Of a field in a message: a damaged field may be a megabyte. Chosen by hand.
const MAX_FIELD_CHARS: usize = 40;
/// Start of a cell of CSV that keeps a spreadsheet from interpreting `text` as a formula.
pub fn formula_mark(text: &str) -> &'static str {
    match text.starts_with(['=', '+', '-', '@', '\t', '\r']) {
        true => "'",
        false => "",
    }
}

pub(super) struct Request<'a> {
    // `None` reads all columns, with NaN for fields that are not numbers.
    pub(super) wanted: Option<&'a [&'a str]>,
    // Columns of identifiers. They become columns of text if a value is not a number, or an integer above 2⁵³: as floats, 4000
    // identifiers from 10¹⁸ on were 32 different ones.
    pub(super) identities: &'a [&'a str],
    pub(super) default_names: &'a [&'a str],
    pub(super) most_rows: usize,
}

/// Reads columns.
///
/// The names of the columns are the first of these that the file has:
///
/// 1. the first line that is neither empty nor a `#` comment, if its first field that is not empty is not a number;
/// 2. the numbered comments of SExtractor;
/// 3. numbers from 1, if numbers are wanted;
/// 4. a comment that contains all wanted names;
/// 5. the default names. A table with more columns than these is refused, because their meaning is not known.
///
/// The separator is the first of `;`, `,` and tab that the first row contains as often as the header. Without one it is
/// blanks. An empty field is NaN. A file without a row is a table without rows.
pub(super) fn read(path: &Path, request: &Request<'_>) -> Result<DataFrame, FileError> {
    let mut input = open_text(path)?;
    let size = std::fs::metadata(path).map_or(0, |about| about.len()) as usize;
    let head = Head::read(&mut input, path)?;
    let separator = Separator::of(head.header.as_deref(), head.first.as_deref());
    let names = head.names(path, separator, request)?;
    let mut rows = Rows::new(path, request, &names)?;
    rows.most = rows.most.min(MIN_ROW_LIMIT.max(size));
    read_rows(input, head, separator, &mut rows)?;
    rows.table()
}

/// Names and fields of a text table, before columns are chosen.
pub(super) struct Columns {
    /// Names, if a header or the comments of SExtractor give them.
    pub(super) names: Option<Vec<String>>,
    /// Words of each comment, the last comment first. One with a word for each field of the first row may be a header.
    pub(super) comments: Vec<Vec<String>>,
    pub(super) fields: Vec<String>,
}

pub(super) fn columns(path: &Path) -> Result<Columns, FileError> {
    let head = Head::read(&mut open_text(path)?, path)?;
    let separator = Separator::of(head.header.as_deref(), head.first.as_deref());
    let fields = head.fields(separator);
    let names = match &head.header {
        Some(header) => {
            let (names, others) = (separator.split(header), split_names(header));
            let other = names.len() != fields.len() && others.len() == fields.len();
            Some(if other { others } else { names })
        }
        None => head.sextractor_names(&fields),
    };
    let comments = head.comments.iter().rev().map(|line| split_names(line));
    Ok(Columns {
        names,
        comments: comments.collect(),
        fields,
    })
}

/// The comments before the first row, without their `#`.
pub(super) fn comments(path: &Path) -> Result<Vec<String>, FileError> {
    Ok(Head::read(&mut open_text(path)?, path)?.comments)
}

fn cannot_read<E: std::fmt::Display>(path: &Path) -> impl FnOnce(E) -> FileError {
    FileError::doing(path, "cannot read the table")
}

fn too_long(path: &Path) -> FileError {
    cannot_read(path)(format!(
        "a row with what stands before it has more than {MAX_RECORD_BYTES} bytes"
    ))
}

// The text of a file, of a gzip file what it unpacks to.
fn open_text(path: &Path) -> Result<Box<dyn BufRead>, FileError> {
    let file = open::open(path).map_err(cannot_read(path))?;
    let mut file = BufReader::with_capacity(BUFFER_BYTES, file);
    let start = file.fill_buf().map_err(cannot_read(path))?;
    Ok(match start.starts_with(&GZIP_MAGIC) {
        true => Box::new(BufReader::with_capacity(
            BUFFER_BYTES,
            MultiGzDecoder::new(file),
        )),
        false => Box::new(file),
    })
}

// Lines are split here and not by polars or csv: polars has no line numbers for messages, and csv counts a line feed before or
// after the row, by the end of the first line. csv splits lines with quotes.
fn read_rows(
    mut text: Box<dyn BufRead>,
    head: Head,
    separator: Separator,
    rows: &mut Rows<'_>,
) -> Result<(), FileError> {
    let Some(first) = head.first else {
        return Ok(());
    };
    let (mut bytes, mut number) = (first.into_bytes(), head.before);
    // Bytes since the last row.
    let mut since = bytes.len();
    loop {
        let part = text
            .by_ref()
            .take(BUFFER_BYTES as u64)
            .read_to_end(&mut bytes);
        let read = part.map_err(cannot_read(rows.path))?;
        since += read;
        let end = match bytes.iter().rposition(|byte| *byte == b'\n') {
            _ if read == 0 => bytes.len(),
            Some(line_feed) => line_feed + 1,
            None => 0,
        };
        let lines = std::str::from_utf8(&bytes[..end]).map_err(|error| {
            let good = &bytes[..error.valid_up_to()];
            let lines = good.iter().filter(|byte| **byte == b'\n').count();
            not_text(rows.path, number + 1 + lines as u64)
        })?;
        let quotes = lines.contains('"');
        rows.is_cut = read == 0;
        let rows_before = rows.rows;
        for line in lines.lines() {
            number += 1;
            let trimmed = line.trim_ascii();
            if trimmed.is_empty() || trimmed.starts_with('#') {
                continue;
            }
            match separator {
                Separator::Blanks if quotes => rows.add(number, quoted_blanks(trimmed))?,
                Separator::Blanks => rows.add(number, trimmed.split_ascii_whitespace())?,
                Separator::Byte(_) if quotes && line.contains('"') => {
                    let fields = separator.split(line);
                    rows.add(number, fields.iter().map(String::as_str))?;
                }
                // Not trimmed: the first field of a line that starts with a tab is empty.
                Separator::Byte(byte) => rows.add(number, line.split(char::from(byte)))?,
            }
        }
        if read == 0 {
            return Ok(());
        }
        bytes.drain(..end);
        if rows.rows > rows_before {
            since = bytes.len();
        } else if since > MAX_RECORD_BYTES {
            return Err(too_long(rows.path));
        }
    }
}

// Formats that are text but no tables, by the start of their first line, so that the message names the format instead of a
// field that is not a number.
const OTHER_FORMATS: [(&str, &str, &str); 4] = [
    ("<?xml", "XML, such as a VOTable", "votable"),
    ("<VOTABLE", "a VOTable", "votable"),
    ("Title:", "a machine-readable table of CDS or AAS", "mrt"),
    ("Byte-by-byte", "a machine-readable table of CDS", "mrt"),
];

// Types of IPAC tables, in the line below the names.
const IPAC_TYPES: [&str; 5] = ["double|", "long|", "int|", "char|", "real|"];

fn check_format(path: &Path, line: &str) -> Result<(), FileError> {
    match OTHER_FORMATS.iter().find(|(start, ..)| {
        let first = line.get(..start.len());
        first.is_some_and(|first| first.eq_ignore_ascii_case(start))
    }) {
        None => Ok(()),
        Some((_, format, name)) => Err(FileError::new(
            path,
            format!(
                "the file is {format}, which is not read; expected a text, FITS, Parquet or Arrow table"
            ),
        )
        .hint(format!(
            "stilts tcopy ifmt={name} in={} out=table.fits",
            path.display()
        ))),
    }
}

fn not_text(path: &Path, line: u64) -> FileError {
    FileError::new(
        path,
        format!("this is not a text table: line {line} is not UTF-8"),
    )
}

// Split at blanks outside of quotes; csv splits at single characters only.
fn quoted_blanks(line: &str) -> impl Iterator<Item = &str> {
    let mut quoted = false;
    line.split(move |c: char| {
        quoted ^= c == '"';
        !quoted && c.is_ascii_whitespace()
    })
    .filter(|field| !field.is_empty())
    .map(|field| {
        let inner = field.strip_prefix('"').and_then(|f| f.strip_suffix('"'));
        inner.unwrap_or(field)
    })
}

#[derive(Clone, Copy)]
enum Separator {
    Byte(u8),
    Blanks,
}

impl Separator {
    // Preferably one that divides header and first row into equally many fields, because a comma may also occur in a name; else
    // any that divides the row.
    fn of(header: Option<&str>, row: Option<&str>) -> Self {
        let Some(row) = row.or(header) else {
            return Separator::Blanks;
        };
        let count = |line: &str, separator: Separator| separator.split(line).len();
        let alike = |separator: Separator| {
            header.is_some_and(|header| count(header, separator) == count(row, separator))
        };
        // A table aligned with blanks may contain tabs. They are separators only if they divide it further than blanks.
        let blank = |separator: Separator| {
            matches!(separator, Separator::Byte(b'\t'))
                && count(row, Separator::Blanks) > count(row, separator)
                && (header.is_none() || alike(Separator::Blanks))
        };
        let found: Vec<Separator> = [b';', b',', b'\t']
            .into_iter()
            .filter(|byte| row.as_bytes().contains(byte))
            .map(Separator::Byte)
            .filter(|separator| count(row, *separator) > 1 && !blank(*separator))
            .collect();
        let best = found.iter().find(|separator| alike(**separator));
        best.or(found.first()).copied().unwrap_or(Separator::Blanks)
    }

    fn split(self, line: &str) -> Vec<String> {
        match self {
            Separator::Blanks => quoted_blanks(line.trim()).map(str::to_owned).collect(),
            Separator::Byte(byte) => {
                let mut record = StringRecord::new();
                let mut reader = ReaderBuilder::new()
                    .delimiter(byte)
                    .has_headers(false)
                    .from_reader(line.as_bytes());
                match reader.read_record(&mut record) {
                    Ok(_) => record.iter().map(|field| field.trim().to_owned()).collect(),
                    // Valid UTF-8 in memory has no error.
                    Err(_) => Vec::new(),
                }
            }
        }
    }
}

#[derive(Default)]
struct Head {
    comments: Vec<String>,
    header: Option<String>,
    first: Option<String>,
    // Lines before the first row, for line numbers in messages.
    before: u64,
}

impl Head {
    fn read(input: &mut impl BufRead, path: &Path) -> Result<Self, FileError> {
        let mut head = Head::default();
        let mut left = MAX_RECORD_BYTES;
        loop {
            let mut line = Vec::new();
            let read = input
                .by_ref()
                .take(left as u64 + 1)
                .read_until(b'\n', &mut line)
                .map_err(cannot_read(path))?;
            if read == 0 {
                return Ok(head);
            }
            left = left.checked_sub(read).ok_or_else(|| too_long(path))?;
            let number = head.before + 1;
            let line = String::from_utf8(line).map_err(|_| not_text(path, number))?;
            let line = match line.strip_prefix('\u{feff}') {
                Some(rest) if head.before == 0 => rest.to_owned(),
                _ => line,
            };
            let text = line.trim();
            if head.before == 0 {
                check_format(path, text)?;
            }
            if text.contains('\r') {
                let message = format!(
                    "line {number} holds carriage returns; expected lines that end in line feeds"
                );
                return Err(FileError::new(path, message));
            }
            if let Some(comment) = text.strip_prefix('#') {
                let comment = comment.trim_start_matches('#').trim();
                head.comments.push(comment.to_owned());
            } else if head.header.is_none() && is_header(text) {
                head.header = Some(text.to_owned());
            } else if !text.is_empty() {
                let bars = head.header.as_ref().is_some_and(|own| own.starts_with('|'));
                if bars && IPAC_TYPES.iter().any(|own| text.contains(own)) {
                    return Err(FileError::new(path, "the file is an IPAC table, which is not read; expected a text, FITS, Parquet or Arrow table").hint(format!("stilts tcopy ifmt=ipac in={} out=table.fits", path.display())));
                }
                head.first = Some(line);
                return Ok(head);
            }
            head.before += 1;
        }
    }

    fn fields(&self, separator: Separator) -> Vec<String> {
        let first = self.first.as_ref();
        first.map_or_else(Vec::new, |line| separator.split(line))
    }

    // SExtractor's ASCII_HEAD: a comment `# NUMBER NAME description [unit]` per column. An array has one comment with the number
    // of its first column; the second column is called `NAME_1` here.
    fn sextractor_names(&self, fields: &[String]) -> Option<Vec<String>> {
        let mut names: Vec<String> = Vec::new();
        let mut named: (usize, &str) = (0, "");
        let mut lines = 0;
        let fill = |names: &mut Vec<String>, (first, name): (usize, &str), end: usize| {
            while names.len() < end {
                names.push(format!("{name}_{}", names.len() + 1 - first));
            }
        };
        for comment in &self.comments {
            let mut words = comment.split_ascii_whitespace();
            let number = words.next().and_then(|word| word.parse::<usize>().ok());
            let (Some(number), Some(name)) = (number, words.next()) else {
                continue;
            };
            let letters = |c: char| c.is_ascii_alphanumeric() || c == '_';
            let identifier = name.starts_with(|c: char| c.is_ascii_alphabetic());
            // Numbers increase from 1 to at most the number of columns.
            let next = number > names.len() && (number == 1) == names.is_empty();
            if !next || number > fields.len().max(1) || !identifier || !name.chars().all(letters) {
                return None;
            }
            fill(&mut names, named, number - 1);
            names.push(name.to_owned());
            named = (number, name);
            lines += 1;
        }
        if lines < 2 {
            return None;
        }
        fill(&mut names, named, fields.len());
        Some(names)
    }

    // In the order that `read` documents.
    fn names(
        &self,
        path: &Path,
        separator: Separator,
        request: &Request<'_>,
    ) -> Result<Vec<String>, FileError> {
        let fields = self.fields(separator);
        let fits = |names: &Vec<String>| match request.wanted {
            Some(wanted) => wanted.iter().all(|w| names.iter().any(|n| n == w)),
            None => fields.len() == names.len(),
        };
        if let Some(header) = &self.header {
            // Some programs separate the names by commas and the numbers by blanks.
            let (names, others) = (separator.split(header), split_names(header));
            let other = !fits(&names) && fits(&others);
            return Ok(if other { others } else { names });
        }
        if let Some(names) = self.sextractor_names(&fields) {
            return Ok(names);
        }
        let numbers: Vec<String> = (1..=fields.len()).map(|k| k.to_string()).collect();
        let number = |name: &&str| name.parse::<usize>().is_ok();
        if request
            .wanted
            .is_some_and(|wanted| wanted.iter().all(number))
        {
            return Ok(numbers);
        }
        // The names are usually in the last line before the rows, after a history of commands.
        let comments = self.comments.iter().rev();
        if let Some(names) = comments.map(|line| split_names(line)).find(fits) {
            return Ok(names);
        }
        if fields.len() > request.default_names.len() {
            return Err(FileError::no_names(path, &fields, request.default_names));
        }
        Ok(owned(request.default_names))
    }
}

// The first field decides, because later fields of rows may be texts. Empty fields are skipped.
fn is_header(line: &str) -> bool {
    split_names(line)
        .first()
        .is_some_and(|field| number(field).is_none())
}

// Any separator: comments and headers are often separated in another way than the rows.
fn split_names(line: &str) -> Vec<String> {
    line.split([';', ',', ' ', '\t'])
        .map(|name| name.trim().trim_matches('"'))
        .filter(|name| !name.is_empty())
        .map(str::to_owned)
        .collect()
}

fn owned(names: &[&str]) -> Vec<String> {
    names.iter().map(|&name| name.to_owned()).collect()
}

struct Rows<'a> {
    path: &'a Path,
    names: &'a [String],
    // Only wanted columns must be numbers; other columns of a catalogue may be dates or names.
    strict: bool,
    most: usize,
    slots: Vec<Option<usize>>,
    places: Vec<usize>,
    columns: Vec<Values>,
    rows: usize,
    // Whether the file ends within the line that is read.
    is_cut: bool,
}

enum Values {
    Numbers(Vec<f64>),
    // Becomes `Texts` at the first value that a float does not represent exactly.
    Identities(Vec<f64>),
    Texts(Vec<String>),
}

impl Values {
    fn add(&mut self, field: &str) -> bool {
        let exact = |value: &f64| value.abs() <= MAX_EXACT_INTEGER;
        match self {
            Values::Numbers(values) => {
                let value = value(field);
                values.push(value.unwrap_or(f64::NAN));
                return value.is_some();
            }
            Values::Identities(values) => match number(field) {
                // As a text, a missing identity would turn all others into texts, which differ from the numbers of other catalogues.
                Some(value) if value.is_nan() => return false,
                Some(value) if exact(&value) => values.push(value),
                _ => {
                    let mut texts: Vec<String> = values.iter().map(f64::to_string).collect();
                    texts.push(field.trim().to_owned());
                    *self = Values::Texts(texts);
                }
            },
            Values::Texts(texts) => texts.push(field.trim().to_owned()),
        }
        true
    }
}

impl<'a> Rows<'a> {
    fn new(path: &'a Path, request: &Request<'_>, names: &'a [String]) -> Result<Self, FileError> {
        let place = |name: &&str| {
            let place = names.iter().position(|own| own == name);
            place.ok_or_else(|| FileError::no_column(path, name, names))
        };
        let places: Vec<usize> = match request.wanted {
            Some(wanted) => wanted.iter().map(place).collect::<Result<_, _>>()?,
            None => (0..names.len()).collect(),
        };
        for &place in &places {
            if names.iter().filter(|name| **name == names[place]).count() > 1 {
                let message = format!("there are two columns named `{}`", names[place]);
                return Err(FileError::new(path, message));
            }
        }
        let values = |place: &usize| match request.identities.contains(&names[*place].as_str()) {
            true => Values::Identities(Vec::new()),
            false => Values::Numbers(Vec::new()),
        };
        let slot = |column| places.iter().position(|&place| place == column);
        Ok(Rows {
            path,
            names,
            strict: request.wanted.is_some(),
            most: request.most_rows,
            slots: (0..names.len()).map(slot).collect(),
            columns: places.iter().map(values).collect(),
            places,
            rows: 0,
            is_cut: false,
        })
    }

    fn add<'f>(
        &mut self,
        line: u64,
        fields: impl Iterator<Item = &'f str>,
    ) -> Result<(), FileError> {
        if self.rows == self.most {
            let message = format!("line {line}: expected at most {} rows", self.most);
            return Err(FileError::new(self.path, message));
        }
        self.rows += 1;
        let mut count = 0;
        for (column, field) in fields.enumerate() {
            count += 1;
            let Some(slot) = self.slots.get(column).copied().flatten() else {
                continue;
            };
            if !self.columns[slot].add(field) && self.strict {
                return Err(self.not_a_number(line, column, field));
            }
        }
        let expected = self.names.len();
        if count == expected {
            return Ok(());
        }
        let names = names_of(self.names);
        let message = format!("line {line}: {count} fields; expected {expected} ({names})");
        let error = FileError::new(self.path, message);
        Err(match self.is_cut {
            true => error.hint("a complete copy, because the file ends within this line"),
            false => error,
        })
    }

    #[cold]
    fn not_a_number(&self, line: u64, column: usize, field: &str) -> FileError {
        let field: String = field.trim().chars().take(MAX_FIELD_CHARS).collect();
        let name = &self.names[column];
        let expected = match self.slots[column].map(|slot| &self.columns[slot]) {
            Some(Values::Identities(_)) => "an identity",
            _ => "a number",
        };
        let mut message = format!("line {line}: `{field}` in column `{name}` is not {expected}");
        if is_sexagesimal(&field) {
            return FileError::new(self.path, message).hint(DEGREES_HINT);
        }
        // VizieR's tables have lines of units and of dashes below the names.
        if value(&field.replacen(',', ".", 1)).is_some_and(|own| !own.is_nan()) {
            return FileError::new(self.path, message).hint("numbers with decimal points");
        }
        if self.rows == 1 && line > 1 && !field.is_empty() {
            message +=
                ". If it is one of units or dashes below the names, try: the table without it";
        }
        FileError::new(self.path, message)
    }

    fn table(self) -> Result<DataFrame, FileError> {
        let columns = self
            .places
            .iter()
            .zip(self.columns)
            .map(|(&place, values)| {
                let name = self.names[place].as_str().into();
                match values {
                    Values::Numbers(values) | Values::Identities(values) => {
                        Column::new(name, values)
                    }
                    Values::Texts(texts) => Column::new(name, texts),
                }
            })
            .collect();
        crate::frames::frame(columns).map_err(|error| FileError::new(self.path, error.to_string()))
    }
}

/// What to do about hours, minutes and seconds.
pub(crate) const DEGREES_HINT: &str = "degrees, which SkyCoord(ra, dec, unit=(\"hourangle\", \"deg\")) of astropy has as ra.deg and dec.deg";

/// Whether a text is an angle with minutes and seconds: `10:00:03.1`, `-2 30 00` or `10h00m03.1s`.
pub(crate) fn is_sexagesimal(text: &str) -> bool {
    let number = |part: &str| part.trim_start_matches(['+', '-']).parse::<f64>().is_ok();
    let text = text.trim().trim_end_matches(['s', '"']);
    let parts = text.split([':', ' ', 'h', 'd', 'm', '°', '\'']);
    let parts: Vec<&str> = parts.filter(|part| !part.is_empty()).collect();
    parts.len() == 3 && parts.into_iter().all(number)
}

// Missing numbers and truth values, in the words of pandas, SQL, R and astropy.
const MISSING: [&str; 7] = ["null", "na", "n/a", "none", "--", "\\n", "<na>"];
const WORDS_OF_TRUTH: [(&str, f64); 4] = [("true", 1.0), ("false", 0.0), ("t", 1.0), ("f", 0.0)];

/// A number, a truth value as 1 or 0, or a missing number.
pub(crate) fn value(field: &str) -> Option<f64> {
    number(field).or_else(|| {
        let word = field.trim().trim_matches('"');
        let is = |own: &&str| own.eq_ignore_ascii_case(word);
        let truth = || {
            WORDS_OF_TRUTH
                .iter()
                .find(|(own, _)| is(own))
                .map(|own| own.1)
        };
        match MISSING.iter().any(is) {
            true => Some(f64::NAN),
            false => truth(),
        }
    })
}

// Trimmed only if that fails, because fields rarely contain blanks. An empty field is a missing value.
fn number(field: &str) -> Option<f64> {
    field.parse().ok().or_else(|| match field.trim() {
        "" => Some(f64::NAN),
        field => field.parse().ok().or_else(|| fortran(field)),
    })
}

// A number in double precision as Fortran writes it, `1.5D-02`.
fn fortran(field: &str) -> Option<f64> {
    let (digits, exponent) = field.split_once(['d', 'D'])?;
    let is_number = digits.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
    let number = is_number.then(|| format!("{digits}e{exponent}"))?;
    number.parse().ok()
}

#[cfg(test)]
mod tests;
