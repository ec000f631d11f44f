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

use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flate2::Crc;
use polars::prelude::{
    ArrowDataType, ArrowField, ChunkFillNullValue, ChunkedArray, Column, CompatLevel, DataFrame,
    DataType, FileMetadataRef, IntoSeries, KeyValueMetadata, NamedFrom, ParquetReader,
    ParquetWriter, PolarsError, PolarsNumericType, PolarsResult, SchemaExt, SerReader, Series,
    StatisticsOptions,
};
use polars_arrow::io::ipc::write::{default_ipc_fields, schema_to_bytes};
use polars_parquet::parquet::page::CompressedPage;
use polars_parquet::read::{
    BasicDecompressor, ColumnChunkMetadata, Filter, PageReader, column_iter_to_arrays,
};
use polars_parquet::write::{CompressionOptions, Encoding, Version, WriteOptions, row_group_iter};
use serde_json::{Map, Value, json};

use crate::FileError;
use crate::frames::{Metadata, element_name, element_of, frame, reals};
use crate::open;

// Longest vector that becomes one column per number.
const MAX_VECTOR: usize = 8;
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
    let wanted_all = |fields: &[ArrowField]| fields.iter().cloned().map(Wanted::whole).collect();
    let fields = match wanted {
        None => wanted_all(&source.fields),
        Some(names) => source.pick(names)?,
    };
    source.check_rows(most_rows)?;
    let columns = fields.iter().map(|field| source.read_column(field));
    let columns = columns.collect::<Result<_, FileError>>()?;
    frame(columns).map_err(|error| FileError::new(path, error))
}

/// The same of columns of numbers: columns of text are left out, and refused if they are wanted.
pub(crate) fn read_numbers(
    path: &Path,
    wanted: Option<&[&str]>,
    most_rows: usize,
) -> Result<DataFrame, FileError> {
    let table = read(path, wanted, most_rows)?;
    let columns = table.columns().iter();
    let texts = columns.filter(|column| column.dtype().is_string());
    let texts: Vec<String> = texts.map(|column| column.name().to_string()).collect();
    if let (Some(name), Some(_)) = (texts.first(), wanted) {
        let message = format!("column `{name}` holds text; expected numbers");
        return Err(FileError::new(path, message));
    }
    Ok(table.drop_many(texts))
}

/// Reads the columns `wanted` by row groups of at most `most_rows` rows, and gives each group to `take`.
pub(crate) fn read_groups(
    path: &Path,
    wanted: &[&str],
    most_rows: usize,
    mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
) -> Result<(), FileError> {
    let mut source = Source::open(path)?;
    let fields = source.pick(wanted)?;
    let fields: Vec<Wanted> = fields
        .iter()
        .map(|field| source.decoded(field))
        .collect::<Result<_, FileError>>()?;
    source.check_rows(usize::MAX)?;
    for number in 0..source.footer.row_groups.len() {
        let rows = source.footer.row_groups[number].num_rows();
        if rows > most_rows {
            let detail = format!("found a row group of {rows} rows, expected at most {most_rows}");
            return Err(damaged(path, detail));
        }
        let column = |field| with_missing(path, source.read_chunk(field, number)?);
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
        let wanted = source.decoded(&Wanted::whole(field))?;
        let chunk = source.read_rows(&wanted, number, Some(1))?;
        let first = chunk.str().ok().and_then(|texts| texts.get(0));
        found.extend(first.map(|text| (name, text.to_owned())));
    }
    Ok(found)
}

/// The names of the columns, in file order, from the footer alone.
pub fn columns(path: impl AsRef<Path>) -> Result<Vec<String>, FileError> {
    Ok(Source::open(path.as_ref())?.names())
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

/// A column, or the numbers at one place of a column of vectors.
struct Wanted {
    field: ArrowField,
    element: Option<usize>,
}

impl Wanted {
    fn whole(field: ArrowField) -> Self {
        Wanted {
            field,
            element: None,
        }
    }

    fn taken(&self, vectors: Series) -> Result<Series, String> {
        let Some(place) = self.element else {
            return Ok(vectors);
        };
        let mut numbers = Vec::with_capacity(vectors.len());
        for chunk in vectors
            .list()
            .map_err(|error| error.to_string())?
            .downcast_iter()
        {
            let inner = Series::try_from((self.field.name.clone(), chunk.values().clone()));
            let inner = Column::from(inner.map_err(|error| error.to_string())?);
            let inner = reals(&inner).ok_or("found vectors of no numbers")?;
            for row in 0..chunk.len() {
                let (start, end) = chunk.offsets().start_end(row);
                let missing = chunk.validity().is_some_and(|valid| !valid.get_bit(row));
                if start + place >= end && !missing {
                    let length = end - start;
                    return Err(format!(
                        "found a vector of {length} numbers, expected more than {place}"
                    ));
                }
                numbers.push(if missing {
                    f64::NAN
                } else {
                    inner[start + place]
                });
            }
        }
        let name = element_name(&self.field.name, place);
        Ok(Series::new(name.into(), numbers))
    }
}

/// The names under which a column is read: `g[0]` and `g[1]` of vectors of two.
fn names_in(field: &ArrowField) -> Vec<String> {
    let length = match &field.dtype {
        ArrowDataType::FixedSizeList(_, length) => (*length).min(MAX_VECTOR),
        ArrowDataType::List(_) | ArrowDataType::LargeList(_) => 2,
        _ => 0,
    };
    match decoded_vector(&field.dtype) {
        Some(_) => (0..length).map(|k| element_name(&field.name, k)).collect(),
        None => vec![field.name.to_string()],
    }
}

struct Source<'a> {
    path: &'a Path,
    file: File,
    /// In bytes.
    length: u64,
    footer: FileMetadataRef,
    fields: Vec<ArrowField>,
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
                .map_err(|error| damaged(path, format!("footer: {error}")))?;
        }
        let (footer, fields) = guarded(path, "footer", || {
            let mut reader = ParquetReader::new(Cursor::new(&tail));
            let fields = reader.schema()?.iter_values().cloned().collect();
            Ok((reader.get_metadata()?.clone(), fields))
        })?;
        let mut source = Self {
            path,
            file,
            length,
            footer,
            fields,
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

    fn names(&self) -> Vec<String> {
        self.fields.iter().flat_map(names_in).collect()
    }

    fn pick(&self, names: &[&str]) -> Result<Vec<Wanted>, FileError> {
        let mut seen = BTreeSet::new();
        names
            .iter()
            .map(|&name| {
                if !seen.insert(name) {
                    let message =
                        format!("column `{name}` is named twice; expected every name once");
                    return Err(FileError::new(self.path, message));
                }
                let called = |name| self.fields.iter().find(move |field| field.name == name);
                let whole = || called(name).cloned().map(Wanted::whole);
                let element = || {
                    let (column, place) = element_of(name)?;
                    let field = called(column).filter(|field| names_in(field).len() > place)?;
                    decoded_vector(&field.dtype)?;
                    Some(Wanted {
                        field: field.clone(),
                        element: Some(place),
                    })
                };
                whole()
                    .or_else(element)
                    .ok_or_else(|| FileError::no_column(self.path, name, &self.names()))
            })
            .collect()
    }

    fn read_column(&mut self, wanted: &Wanted) -> Result<Column, FileError> {
        let wanted = self.decoded(wanted)?;
        let field = &wanted.field;
        let mut column = match wanted.element {
            None => Series::new_empty(field.name.clone(), &DataType::from_arrow_field(field)),
            Some(place) => {
                let name = element_name(&field.name, place);
                Series::new_empty(name.into(), &DataType::Float64)
            }
        };
        for number in 0..self.footer.row_groups.len() {
            let series = self.read_chunk(&wanted, number)?;
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

    fn decoded(&self, wanted: &Wanted) -> Result<Wanted, FileError> {
        let Wanted { field, element } = wanted;
        let decoded = match element {
            Some(_) => decoded_vector(&field.dtype),
            None => decoded_type(&field.dtype),
        };
        let decoded = decoded.ok_or_else(|| {
            let message = format!(
                "column `{}` has type {:?}; expected integers of at most 64 bits, 32- or 64-bit floats, booleans or text",
                field.name, field.dtype
            );
            FileError::new(self.path, message)
        })?;
        Ok(Wanted {
            field: ArrowField::new(field.name.clone(), decoded, field.is_nullable),
            element: *element,
        })
    }

    /// The rows of a decoded column in one row group.
    fn read_chunk(&mut self, wanted: &Wanted, number: usize) -> Result<Series, FileError> {
        self.read_rows(wanted, number, None)
    }

    /// The same, or the first `most` rows.
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
            check_sum(&bytes, sum).map_err(damaged)?;
        }
        let series = guarded(path, &place, || decode(chunk, bytes, field, most))?;
        let rows = most.map_or(group.num_rows(), |most| most.min(group.num_rows()));
        if series.len() != rows {
            return Err(damaged(format!(
                "found {} rows, expected {rows}",
                series.len()
            )));
        }
        wanted.taken(series).map_err(damaged)
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

fn check_sum(bytes: &[u8], expected: u32) -> Result<(), String> {
    let found = crc32(bytes);
    match found == expected {
        true => Ok(()),
        false => Err(format!(
            "its bytes changed after they were written (found CRC-32 {found:08x}, expected {expected:08x}). Try: copy or measure it again"
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

// Runs a part of polars on the contents of a file.
//
// Its decoders return errors for most damage, but index out of range or overflow on some; that
// must not take a long run down, so such a panic becomes an error too.
fn guarded<T>(
    path: &Path,
    place: &str,
    run: impl FnOnce() -> PolarsResult<T>,
) -> Result<T, FileError> {
    let detail = match caught(run) {
        Ok(Ok(value)) => return Ok(value),
        Ok(Err(error)) => error.to_string(),
        Err(_) => "the contents contradict themselves".into(),
    };
    Err(damaged(path, format!("{place}: {detail}")))
}

thread_local! {
    // Whether a panic on this thread is caught and reported as an error.
    static CAUGHT: Cell<bool> = const { Cell::new(false) };
}

/// Whether a panic on this thread is caught and reported as an error.
///
/// The hook that prints the messages of panics belongs to the whole process, so a program and no library replaces it.
/// A program whose hook is silent if this is true prints one error for a damaged file and no message of a panic.
pub fn panic_is_caught() -> bool {
    CAUGHT.get()
}

fn caught<T>(run: impl FnOnce() -> T) -> std::thread::Result<T> {
    let outer = CAUGHT.replace(true);
    let result = catch_unwind(AssertUnwindSafe(run));
    CAUGHT.set(outer);
    result
}

// The type into which a column of type `declared` is decoded; `None` if it is not supported.
fn decoded_type(declared: &ArrowDataType) -> Option<ArrowDataType> {
    use ArrowDataType as Type;
    match declared {
        Type::Int8 | Type::Int16 | Type::Int32 => Some(Type::Int32),
        Type::UInt8 | Type::UInt16 | Type::UInt32 => Some(Type::UInt32),
        Type::Boolean
        | Type::Int64
        | Type::UInt64
        | Type::Float32
        | Type::Float64
        | Type::Utf8View => Some(declared.clone()),
        // Text with few different values, as data frames in Python like to write it.
        Type::Dictionary(_, value, _) => {
            matches!(**value, Type::Utf8 | Type::LargeUtf8 | Type::Utf8View)
                .then_some(Type::Utf8View)
        }
        _ => None,
    }
}

// The type into which a column of vectors of numbers is decoded; `None` if it has no vectors. Lists of a fixed length are
// stored like others.
fn decoded_vector(declared: &ArrowDataType) -> Option<ArrowDataType> {
    use ArrowDataType as Type;
    match declared {
        Type::List(inner) | Type::LargeList(inner) | Type::FixedSizeList(inner, _) => {
            let number = matches!(inner.dtype, Type::Float32 | Type::Float64);
            number.then(|| Type::LargeList(inner.clone()))
        }
        _ => None,
    }
}

/// The column, in which missing floats are NaN.
fn with_missing(path: &Path, column: Series) -> Result<Column, FileError> {
    let name = column.name().to_string();
    let filled = match (column.null_count(), column.dtype()) {
        (0, _) => return Ok(column.into()),
        (_, DataType::Float64) => filled(column.f64(), f64::NAN),
        (_, DataType::Float32) => filled(column.f32(), f32::NAN),
        (count, _) => {
            let message = format!(
                "column `{name}` has {count} missing value(s); only float columns may have any (they become NaN)"
            );
            return Err(FileError::new(path, message));
        }
    };
    filled.map_err(|error| damaged(path, format!("column `{name}`: {error}")))
}

fn filled<T>(values: PolarsResult<&ChunkedArray<T>>, missing: T::Native) -> PolarsResult<Column>
where
    T: PolarsNumericType,
    ChunkedArray<T>: ChunkFillNullValue<T::Native> + IntoSeries,
{
    Ok(values?.fill_null_with_values(missing)?.into_series().into())
}
