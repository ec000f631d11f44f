//! Parquet files.
//!
//! Writing uses polars' frame writer. Reading uses polars' footer parser and column decoder, but reads the bytes itself:
//!
//! * Only the wanted column chunks are read.
//! * Files are not memory-mapped: a mapped file that shrinks kills the process.
//! * No second thread pool starts.
//! * 8- and 16-bit integers decode into wider ones without polars' features for them.
//!
//! Rows are counted before memory is allocated for them, but not pages that compress to next to nothing: catalogues are the
//! user's own, while entries of challenges, which strangers send, are text.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flate2::Crc;
use polars::prelude::{
    ArrowDataType, ArrowField, Column, CompatLevel, DataFrame, DataType, FileMetadataRef,
    KeyValueMetadata, ParquetReader, ParquetWriter, PolarsError, PolarsResult, SchemaExt,
    SerReader, Series, StatisticsOptions,
};
use polars_arrow::io::ipc::write::{default_ipc_fields, schema_to_bytes};
use polars_parquet::parquet::page::CompressedPage;
use polars_parquet::read::{
    BasicDecompressor, ColumnChunkMetadata, Filter, PageReader, column_iter_to_arrays,
};
use polars_parquet::write::{CompressionOptions, Encoding, Version, WriteOptions, row_group_iter};
use serde_json::{Map, Value, json};

use crate::FileError;
use crate::fields::{
    MAX_VECTOR, Wanted, decoded, decoded_type, guarded, names, pick, with_missing,
};
use crate::frames::{Metadata, element_name, frame};
use crate::open;

// Rows of a row group: polars' own number.
const ROW_GROUP: usize = 512 * 512;
// The key under which Parquet files keep the Arrow schema.
const SCHEMA_KEY: &str = "ARROW:schema";

/// The bytes of `frame` as a Parquet file with `metadata`.
///
/// Equal frames give equal bytes, with checksums that [`read`] verifies. The metadata becomes the file's key-value metadata, in the order
/// of the keys, and is repeated in the Arrow schema, where pandas and astropy read it. The data are not compressed: measured shears and sizes are noise in most of their
/// bits, so that compression gains a few per cent of space and costs up to half of the reading
/// speed. Repeated integers and words still become small, by dictionaries.
pub fn encode(frame: &DataFrame, metadata: &Metadata) -> PolarsResult<Vec<u8>> {
    if metadata.contains_key(SCHEMA_KEY) {
        let message =
            format!("the metadata key {SCHEMA_KEY} is reserved for the file's own schema");
        return Err(PolarsError::InvalidOperation(message.into()));
    }
    let pairs = metadata.iter();
    let mut pairs: Vec<_> = pairs
        .map(|(key, value)| (key.clone(), value.clone()))
        .collect();
    if !metadata.is_empty() {
        pairs.push((SCHEMA_KEY.into(), arrow_schema(frame, metadata)));
    }
    // Nothing selects rows by minima and maxima, which cost a pass over the values.
    let statistics = StatisticsOptions {
        null_count: true,
        ..StatisticsOptions::empty()
    };
    // Row groups are encoded by these options, and the writer only puts them and the footer into the file.
    let options = WriteOptions {
        statistics,
        version: Version::V1,
        compression: CompressionOptions::Uncompressed,
        data_page_size: None,
    };
    let mut bytes = Vec::new();
    let mut writer = ParquetWriter::new(&mut bytes)
        .with_statistics(statistics)
        .with_key_value_metadata(Some(KeyValueMetadata::from_static(pairs)))
        .batched(frame.schema())?;
    let encodings: Vec<_> = frame.columns().iter().map(encoding).collect();
    for start in (0..frame.height()).step_by(ROW_GROUP) {
        let mut group = frame.slice(start as i64, ROW_GROUP);
        group.rechunk_mut();
        for batch in group.iter_chunks(CompatLevel::newest(), false) {
            let fields = writer.parquet_schema().fields().to_vec();
            let columns = row_group_iter(batch, encodings.clone().into(), fields, options);
            writer.write_row_groups(vec![columns])?;
        }
    }
    writer.finish()?;
    let sums = checksums(&bytes)?;
    let footer = bytes.len() - END_BYTES - footer_bytes(&bytes);
    bytes.splice(footer..footer, sums);
    Ok(bytes)
}

// polars would hash each number of a column to estimate whether a dictionary is smaller, and write it plainly in any case.
fn encoding(column: &Column) -> Vec<Encoding> {
    vec![match column.dtype().is_float() {
        true => Encoding::Plain,
        false => Encoding::RleDictionary,
    }]
}

// Bytes after the footer: its length and `PAR1`.
const END_BYTES: usize = 8;
// What follows the checksums.
const SUMS_MARK: [u8; 8] = *b"CRC-32 1";
// Bytes of a checksum.
const SUM_BYTES: usize = 4;
// Bytes before the footer: its checksum and the mark.
const MARKED_SUM_BYTES: usize = SUM_BYTES + SUMS_MARK.len();

// The CRC-32 of each column chunk and of the footer, which are put before the footer. Parquet gives the places of everything else,
// so that other readers skip them. polars neither writes nor compares Parquet's own checksums of pages. Without any, a bit that a disk
// or a transfer turned changed Q or hid a column in 4 of 10 cases.
fn checksums(bytes: &[u8]) -> PolarsResult<Vec<u8>> {
    let mut reader = ParquetReader::new(Cursor::new(bytes));
    let footer = reader.get_metadata()?;
    let ranges = footer
        .row_groups
        .iter()
        .flat_map(|group| group.byte_ranges_iter());
    let chunks = ranges.map(|range| &bytes[range.start as usize..range.end as usize]);
    let end = bytes.len() - END_BYTES;
    let all = chunks.chain([&bytes[end - footer_bytes(bytes)..end]]);
    let sums = all.flat_map(|part| crc32(part).to_le_bytes());
    Ok(sums.chain(SUMS_MARK).collect())
}

fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    crc.update(bytes);
    crc.sum()
}

// The length of the footer, of which `bytes` are the last of the file.
fn footer_bytes(bytes: &[u8]) -> usize {
    let length = bytes.last_chunk::<END_BYTES>();
    length.map_or(0, |&[a, b, c, d, ..]| {
        u32::from_le_bytes([a, b, c, d]) as usize
    })
}

// pandas reads this key into `DataFrame.attrs`.
const PANDAS: &str = "PANDAS_ATTRS";
// astropy reads this key into `Table.meta`, as YAML, which includes JSON.
const ASTROPY: &str = "table_meta_yaml";
// What precedes the length of a message of Arrow.
const ARROW_START: [u8; 4] = [0xff; 4];

/// The value of the key `ARROW:schema` for a table with `metadata`, which pyarrow, pandas and astropy read from there.
fn arrow_schema(table: &DataFrame, metadata: &Metadata) -> String {
    let pairs = metadata.iter();
    let pairs: Map<String, Value> = pairs.map(|(k, v)| (k.clone(), json!(v))).collect();
    let columns = table.columns().iter().map(|column| {
        let kind = match column.dtype() {
            DataType::Float64 => "float64",
            DataType::Int64 => "int64",
            _ => "string",
        };
        json!({"name": column.name().as_str(), "datatype": kind})
    });
    let columns: Vec<Value> = columns.collect();
    let astropy = json!({"datatype": columns, "meta": pairs}).to_string();
    let mut all: BTreeMap<_, _> = metadata
        .iter()
        .map(|(key, value)| (key.as_str().into(), value.as_str().into()))
        .collect();
    all.insert(ASTROPY.into(), astropy.into());
    all.insert(PANDAS.into(), Value::Object(pairs).to_string().into());
    let schema = table.schema().to_arrow(CompatLevel::newest());
    let bytes = schema_to_bytes(
        &schema,
        &default_ipc_fields(schema.iter_values()),
        Some(&all),
    );
    let length = (bytes.len() as u32).to_le_bytes();
    STANDARD.encode([&ARROW_START[..], &length, &bytes].concat())
}

/// Reads the Parquet file at `path`: all columns in file order, or those in `wanted`, in that order.
///
/// Small integers become 32-bit ones, and text with a dictionary plain text. Missing values in float
/// columns become NaN. Columns that are not wanted may be of any type. It runs on the calling thread
/// alone, so that a caller with many files reads them in parallel. A file of more than `most_rows` rows is refused before
/// memory is allocated for them: repeated values need next to nothing in a file.
pub fn read(
    path: impl AsRef<Path>,
    wanted: Option<&[&str]>,
    most_rows: usize,
) -> Result<DataFrame, FileError> {
    let path = path.as_ref();
    let mut source = Source::open(path)?;
    let fields = pick(path, &source.fields, wanted)?;
    source.check_rows(most_rows)?;
    let columns = fields.iter().map(|field| source.read_column(field));
    let columns = columns.collect::<Result<_, FileError>>()?;
    frame(columns).map_err(|error| FileError::new(path, error))
}

/// Reads the columns `wanted` by row groups of at most `most_rows` rows, and gives each group to `take`.
pub(crate) fn read_groups(
    path: &Path,
    wanted: &[&str],
    most_rows: usize,
    mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
) -> Result<(), FileError> {
    let mut source = Source::open(path)?;
    let fields = pick(path, &source.fields, Some(wanted))?;
    let fields: Vec<Wanted> = fields
        .iter()
        .map(|field| decoded(path, field))
        .collect::<Result<_, FileError>>()?;
    source.check_rows(usize::MAX)?;
    for number in 0..source.footer.row_groups.len() {
        let rows = source.footer.row_groups[number].num_rows();
        if rows > most_rows {
            let detail = format!("found a row group of {rows} rows, expected at most {most_rows}");
            return Err(damaged(path, detail));
        }
        let column = |field| with_missing(path, source.read_rows(field, number, None)?);
        let columns = fields.iter().map(column);
        let columns = columns.collect::<Result<_, FileError>>()?;
        take(frame(columns).map_err(|error| FileError::new(path, error))?)?;
    }
    Ok(())
}

/// The first value of each column of text.
pub(crate) fn first_texts(path: &Path) -> Result<Vec<(String, String)>, FileError> {
    let mut source = Source::open(path)?;
    let is_text = |field: &&ArrowField| decoded_type(&field.dtype) == Some(ArrowDataType::Utf8View);
    let fields: Vec<ArrowField> = source.fields.iter().filter(is_text).cloned().collect();
    let mut groups = source.footer.row_groups.iter();
    let Some(number) = groups.position(|group| group.num_rows() > 0) else {
        return Ok(Vec::new());
    };
    let mut found = Vec::new();
    for field in fields {
        let name = field.name.to_string();
        let wanted = decoded(path, &Wanted::whole(field))?;
        let chunk = match source.read_rows(&wanted, number, Some(1)) {
            // Other bytes than text, which no role has.
            Err(_) if source.bytes.contains(&name) => continue,
            chunk => chunk?,
        };
        let first = chunk.str().ok().and_then(|texts| texts.get(0));
        found.extend(first.map(|text| (name, text.to_owned())));
    }
    Ok(found)
}

/// The names of the columns, in file order, from the footer alone.
pub fn columns(path: impl AsRef<Path>) -> Result<Vec<String>, FileError> {
    Ok(names(&Source::open(path.as_ref())?.fields))
}

pub fn metadata(path: impl AsRef<Path>) -> Result<Metadata, FileError> {
    let source = Source::open(path.as_ref())?;
    let pairs = source.footer.key_value_metadata().iter().flatten();
    // Arrow's schema repeats them.
    let own = pairs.filter(|pair| pair.key != SCHEMA_KEY);
    Ok(own
        .map(|pair| (pair.key.clone(), pair.value.clone().unwrap_or_default()))
        .collect())
}

fn damaged(path: &Path, detail: impl std::fmt::Display) -> FileError {
    let message = format!("not a readable Parquet file, or damaged: {detail}");
    FileError::new(path, message)
}

struct Source<'a> {
    path: &'a Path,
    file: File,
    /// In bytes.
    length: u64,
    footer: FileMetadataRef,
    fields: Vec<ArrowField>,
    /// Columns of bytes, which are read as text: astropy writes its bytes so, without a statement that they are text.
    bytes: Vec<String>,
    /// By the start of the column chunk; none in files of other programs.
    checksums: BTreeMap<i64, u32>,
}

impl<'a> Source<'a> {
    fn open(path: &'a Path) -> Result<Self, FileError> {
        let cannot = || FileError::doing(path, "cannot read the file");
        let mut file = open::open(path).map_err(cannot())?;
        let length = file.metadata().map_err(cannot())?.len();
        // The last bytes of the file, or all of a shorter one.
        let mut last = |bytes: usize| {
            let mut tail = vec![0; usize::try_from(length).map_or(bytes, |all| all.min(bytes))];
            file.seek(SeekFrom::End(-(tail.len() as i64)))
                .and_then(|_| file.read_exact(&mut tail))
                .map_err(cannot())?;
            Ok::<_, FileError>(tail)
        };
        let size = footer_bytes(&last(END_BYTES)?) + END_BYTES;
        let tail = last(MARKED_SUM_BYTES + size)?;
        // Before polars reads the footer, which may say anything if it is damaged.
        let is_marked =
            tail.len() == MARKED_SUM_BYTES + size && tail[SUM_BYTES..].starts_with(&SUMS_MARK);
        if let (true, Some(sum)) = (is_marked, tail.first_chunk()) {
            let footer = &tail[MARKED_SUM_BYTES..tail.len() - END_BYTES];
            check_sum(footer, u32::from_le_bytes(*sum))
                .map_err(|error| damaged(path, format!("footer: {error}")).hint(COPY_AGAIN))?;
        }
        let (footer, fields) = guarded("footer", || {
            let mut reader = ParquetReader::new(Cursor::new(&tail));
            let fields = reader.schema()?.iter_values().cloned().collect();
            Ok((reader.get_metadata()?.clone(), fields))
        })
        .map_err(|detail| damaged(path, detail))?;
        let mut fields: Vec<ArrowField> = fields;
        let mut bytes = Vec::new();
        for field in &mut fields {
            use ArrowDataType::{Binary, BinaryView, LargeBinary, Utf8View};
            if matches!(field.dtype, Binary | LargeBinary | BinaryView) {
                field.dtype = Utf8View;
                bytes.push(field.name.to_string());
            }
        }
        let mut source = Self {
            path,
            file,
            length,
            footer,
            fields,
            bytes,
            checksums: BTreeMap::new(),
        };
        if is_marked {
            let groups = source.footer.row_groups.iter();
            let chunks = groups.flat_map(|group| group.parquet_columns());
            let starts: Vec<i64> = chunks.map(start_of).collect();
            let size = starts.len() * SUM_BYTES;
            let end = (length - tail.len() as u64) as i64;
            let sums = source.read_bytes(end - size as i64, size as i64);
            let sums = sums.map_err(|error| damaged(path, error))?;
            let sums = sums
                .as_chunks()
                .0
                .iter()
                .map(|sum| u32::from_le_bytes(*sum));
            source.checksums = starts.into_iter().zip(sums).collect();
        }
        Ok(source)
    }

    fn check_rows(&self, most: usize) -> Result<(), FileError> {
        let groups = self.footer.row_groups.iter();
        let rows = groups.fold(0, |rows: usize, group| {
            rows.saturating_add(group.num_rows())
        });
        if rows != self.footer.num_rows {
            return Err(damaged(
                self.path,
                format!(
                    "found row groups of {rows} rows, expected {} as in the footer",
                    self.footer.num_rows
                ),
            ));
        }
        if rows > most {
            let message = format!("found {rows} rows, expected at most {most}");
            return Err(FileError::new(self.path, message));
        }
        Ok(())
    }

    fn read_column(&mut self, wanted: &Wanted) -> Result<Column, FileError> {
        let wanted = decoded(self.path, wanted)?;
        let field = &wanted.field;
        let mut column = match wanted.element {
            None => Series::new_empty(field.name.clone(), &DataType::from_arrow_field(field)),
            Some(place) => {
                let name = element_name(&field.name, place);
                Series::new_empty(name.into(), &DataType::Float64)
            }
        };
        for number in 0..self.footer.row_groups.len() {
            let series = self.read_rows(&wanted, number, None)?;
            column = match number {
                0 => series,
                _ => {
                    let joined = column.append(&series);
                    joined.map_err(|error| {
                        let name = field.name.as_str();
                        damaged(
                            self.path,
                            format!("column `{name}`, row group {number}: {error}"),
                        )
                    })?;
                    column
                }
            };
        }
        // In one piece, so that readers borrow the values instead of copying them.
        with_missing(self.path, column.rechunk())
    }

    /// The rows of a decoded column in one row group, or the first `most`.
    fn read_rows(
        &mut self,
        wanted: &Wanted,
        number: usize,
        most: Option<usize>,
    ) -> Result<Series, FileError> {
        let field = &wanted.field;
        let (path, name) = (self.path, field.name.as_str());
        let footer = self.footer.clone();
        let group = &footer.row_groups[number];
        let place = format!("column `{name}`, row group {number}");
        let damaged = |detail: String| damaged(path, format!("{place}: {detail}"));
        let found = group
            .columns_under_root_iter(name)
            .map(|mut all| (all.len(), all.next()));
        let Some((1, Some(chunk))) = found else {
            return Err(damaged("found no single column chunk".into()));
        };
        let values = usize::try_from(chunk.num_values()).unwrap_or(usize::MAX);
        let most_values = match wanted.element {
            None => group.num_rows(),
            Some(_) => group.num_rows().saturating_mul(MAX_VECTOR),
        };
        if values > most_values || values < most_values && wanted.element.is_none() {
            return Err(damaged(format!(
                "found {} values, expected {most_values} as the row group has {} rows",
                chunk.num_values(),
                group.num_rows()
            )));
        }
        let start = start_of(chunk);
        let bytes = self
            .read_bytes(start, chunk.compressed_size())
            .map_err(damaged)?;
        if let Some(&sum) = self.checksums.get(&start) {
            check_sum(&bytes, sum).map_err(|error| damaged(error).hint(COPY_AGAIN))?;
        }
        let series = guarded(&place, || decode(chunk, bytes, field, most))
            .map_err(|detail| self::damaged(path, detail))?;
        let rows = most.map_or(group.num_rows(), |most| most.min(group.num_rows()));
        if series.len() != rows {
            return Err(damaged(format!(
                "found {} rows, expected {rows}",
                series.len()
            )));
        }
        wanted
            .taken(series)
            .map_err(|fault| wanted.short(path, &fault))
    }

    // `size` bytes from `start`, after checking that the file has them.
    fn read_bytes(&mut self, start: i64, size: i64) -> Result<Vec<u8>, String> {
        let range = u64::try_from(start).ok().zip(u64::try_from(size).ok());
        let Some((start, size)) = range.filter(|(start, size)| {
            start
                .checked_add(*size)
                .is_some_and(|end| end <= self.length)
        }) else {
            return Err(format!(
                "found bytes from {start}, {size} of them, expected a part of the file's {} bytes",
                self.length
            ));
        };
        let size = usize::try_from(size).map_err(|error| error.to_string())?;
        let mut bytes = vec![0; size];
        self.file
            .seek(SeekFrom::Start(start))
            .and_then(|_| self.file.read_exact(&mut bytes))
            .map_err(|error| error.to_string())?;
        Ok(bytes)
    }
}

const COPY_AGAIN: &str = "copy or measure it again";

fn check_sum(bytes: &[u8], expected: u32) -> Result<(), String> {
    let found = crc32(bytes);
    match found == expected {
        true => Ok(()),
        false => Err(format!(
            "its bytes changed after they were written (found CRC-32 {found:08x}, expected {expected:08x})"
        )),
    }
}

fn start_of(chunk: &ColumnChunkMetadata) -> i64 {
    let dictionary = chunk.dictionary_page_offset();
    dictionary.unwrap_or(chunk.data_page_offset())
}

// The values in one column chunk of a file, or the first `most`, as the type in `field`.
fn decode(
    chunk: &ColumnChunkMetadata,
    bytes: Vec<u8>,
    field: &ArrowField,
    most: Option<usize>,
) -> PolarsResult<Series> {
    let length = bytes.len();
    // Cloning it shares the bytes.
    let source = Cursor::new(bytes.into());
    let pages = || PageReader::new(source.clone(), chunk, Vec::new(), length);
    // The decoder allocates the number of values that a page claims, and reads a negative count as a huge one; a failed
    // allocation ends the process: add the claims up first.
    let mut claimed = 0_usize;
    for page in pages() {
        if let CompressedPage::Data(page) = page? {
            claimed = claimed.saturating_add(page.num_values());
        }
    }
    if i64::try_from(claimed) != Ok(chunk.num_values()) {
        let expected = chunk.num_values();
        let wrong =
            format!("found pages with {claimed} values, expected {expected} as in the footer");
        return Err(PolarsError::ComputeError(wrong.into()));
    }
    let (arrays, _) = column_iter_to_arrays(
        vec![BasicDecompressor::new(pages(), Vec::new())],
        vec![&chunk.descriptor().descriptor.primitive_type],
        field.clone(),
        most.map(Filter::new_limited),
    )?;
    Series::try_from((field, arrays))
}
