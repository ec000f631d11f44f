//! Arrow files (Feather, version 2), read by record batch.
//!
//! Columns have the types and missing values of Parquet files ([`crate::fields`]). polars decodes the record batches; what a
//! damaged file asks it to allocate is compared with the file before.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;

use polars::prelude::{
    ArrowDataType, ArrowField, DataFrame, DataType, NamedFrom, PolarsResult, Series,
};
use polars_arrow::array::{Array, DictionaryArray, FixedSizeListArray, ListArray, PrimitiveArray};
use polars_arrow::io::ipc::read::{FileMetadata, FileReader, read_file_metadata};
use polars_arrow::match_integer_type;
use polars_arrow::offset::OffsetsBuffer;
use polars_arrow::types::NativeType;
use polars_arrow_format::ipc::planus::ReadAsRoot;
use polars_arrow_format::ipc::{Block, MessageHeaderRef, MessageRef, RecordBatchRef};

use crate::FileError;
use crate::fields::{Wanted, decoded, decoded_type, guarded, names, pick, with_missing};
use crate::frames::{Metadata, frame};
use crate::open;

// Bytes that a byte of a compressed buffer may become: a block of zstd has at least four bytes and at most 128 KiB of content
// (RFC 8878, Sect. 3.1.1.2); a byte of LZ4, 255.
const MAX_EXPANSION: u64 = 1 << 15;
// Bytes of a buffer of text with 32-bit offsets, the usual ones.
const MAX_BUFFER: u64 = 1 << 31;

/// All columns, or those in `wanted`, as [`crate::parquet::read`] has them.
pub(crate) fn read(
    path: &Path,
    wanted: Option<&[&str]>,
    most_rows: usize,
) -> Result<DataFrame, FileError> {
    let mut source = Source::open(path)?;
    let fields = pick(path, &source.fields, wanted)?;
    let rows = source.rows()?.iter().sum::<usize>();
    if rows > most_rows {
        let message = format!("found {rows} rows, expected at most {most_rows}");
        return Err(FileError::new(path, message));
    }
    let mut all: Option<DataFrame> = None;
    source.batches(&fields, None, |batch| {
        match &mut all {
            None => all = Some(batch),
            Some(all) => {
                let mut batch = batch;
                let joined = widen(all, &batch)
                    .and_then(|()| widen(&mut batch, all))
                    .and_then(|()| all.vstack_mut(&batch).map(drop));
                joined.map_err(|error| damaged(path, error))?;
            }
        }
        Ok(())
    })?;
    let mut all = all.unwrap_or_default();
    all.rechunk_mut();
    Ok(all)
}

// Makes columns floats that are floats in another batch, where integers are missing.
fn widen(frame: &mut DataFrame, other: &DataFrame) -> PolarsResult<()> {
    for column in other.columns() {
        let own = frame.column(column.name())?;
        if column.dtype().is_float() && own.dtype().is_integer() {
            let floats = own.cast(&DataType::Float64)?;
            frame.with_column(floats)?;
        }
    }
    Ok(())
}

/// Reads the columns `wanted` by record batch, and gives each batch to `take`.
pub(crate) fn read_batches(
    path: &Path,
    wanted: &[&str],
    most_rows: usize,
    take: impl FnMut(DataFrame) -> Result<(), FileError>,
) -> Result<(), FileError> {
    let mut source = Source::open(path)?;
    let fields = pick(path, &source.fields, Some(wanted))?;
    if let Some(rows) = source.rows()?.iter().find(|rows| **rows > most_rows) {
        let detail = format!("found a record batch of {rows} rows, expected at most {most_rows}");
        return Err(damaged(path, detail));
    }
    source.batches(&fields, None, take)
}

/// The first value of each column of text.
pub(crate) fn first_texts(path: &Path) -> Result<Vec<(String, String)>, FileError> {
    let mut source = Source::open(path)?;
    let is_text = |field: &&ArrowField| decoded_type(&field.dtype) == Some(ArrowDataType::Utf8View);
    let fields = source.fields.iter().filter(is_text).cloned();
    let fields: Vec<Wanted> = fields.map(Wanted::whole).collect();
    source.rows()?;
    let mut found = Vec::new();
    source.batches(&fields, Some(1), |batch| {
        for column in batch.columns() {
            let first = column.str().ok().and_then(|texts| texts.get(0));
            found.extend(first.map(|text| (column.name().to_string(), text.to_owned())));
        }
        Ok(())
    })?;
    Ok(found)
}

/// The names of the columns, in file order.
pub(crate) fn columns(path: &Path) -> Result<Vec<String>, FileError> {
    Ok(names(&Source::open(path)?.fields))
}

pub(crate) fn metadata(path: &Path) -> Result<Metadata, FileError> {
    let source = Source::open(path)?;
    let all = source.metadata.custom_schema_metadata.iter();
    let pairs = all.flat_map(|pairs| pairs.iter());
    Ok(pairs
        .map(|(key, value)| (key.to_string(), value.to_string()))
        .collect())
}

fn damaged(path: &Path, detail: impl std::fmt::Display) -> FileError {
    let message = format!("not a readable Arrow file, or damaged: {detail}");
    FileError::new(path, message)
}

struct Source<'a> {
    path: &'a Path,
    file: File,
    /// In bytes.
    length: u64,
    metadata: FileMetadata,
    fields: Vec<ArrowField>,
}

impl<'a> Source<'a> {
    fn open(path: &'a Path) -> Result<Self, FileError> {
        let cannot = || FileError::doing(path, "cannot read the file");
        let mut file = open::open(path).map_err(cannot())?;
        let length = file.metadata().map_err(cannot())?.len();
        let metadata = guarded("footer", || {
            // polars allocates what the last bytes state.
            let mut end = [0; 4];
            file.seek(SeekFrom::End(-10))?;
            file.read_exact(&mut end)?;
            let size = u64::try_from(i32::from_le_bytes(end)).unwrap_or(u64::MAX);
            if size > length {
                let message = format!("found {size} bytes, expected at most {length}");
                return Err(polars::error::PolarsError::ComputeError(message.into()));
            }
            file.rewind()?;
            read_file_metadata(&mut file)
        })
        .map_err(|detail| damaged(path, detail))?;
        Ok(Source {
            path,
            file,
            length,
            fields: metadata.schema.iter_values().cloned().collect(),
            metadata,
        })
    }

    /// The number of rows of each record batch, after a comparison of all places and sizes with those of the file.
    fn rows(&mut self) -> Result<Vec<usize>, FileError> {
        let metadata = &self.metadata;
        for block in metadata.dictionaries.iter().flatten() {
            check_block(&mut self.file, self.length, block)
                .map_err(|detail| damaged(self.path, format!("dictionary: {detail}")))?;
        }
        let blocks = metadata.blocks.iter().enumerate();
        blocks
            .map(|(number, block)| {
                check_block(&mut self.file, self.length, block).map_err(|detail| {
                    damaged(self.path, format!("record batch {number}: {detail}"))
                })
            })
            .collect()
    }

    /// Gives the `wanted` columns of each record batch to `take`, of at most `most` rows together.
    fn batches(
        &mut self,
        wanted: &[Wanted],
        most: Option<usize>,
        mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
    ) -> Result<(), FileError> {
        let path = self.path;
        let wanted = wanted.iter().map(|own| decoded(path, own));
        let wanted: Vec<Wanted> = wanted.collect::<Result<_, _>>()?;
        // In the order of the file, each once.
        let is_wanted = |field: &ArrowField| wanted.iter().any(|own| own.field.name == field.name);
        let numbered = self.fields.iter().enumerate();
        let read: Vec<(usize, &ArrowField)> =
            numbered.filter(|(_, field)| is_wanted(field)).collect();
        if read.is_empty() {
            return Ok(());
        }
        let mut metadata = self.metadata.clone();
        if !(read.iter()).any(|(_, field)| matches!(field.dtype, ArrowDataType::Dictionary(..))) {
            metadata.dictionaries = None;
        }
        let places = read.iter().map(|(place, _)| *place).collect();
        let mut reader = FileReader::new(&mut self.file, metadata, Some(places), most);
        let mut left = most.unwrap_or(usize::MAX);
        for number in 0..self.metadata.blocks.len() {
            if left == 0 {
                break;
            }
            let place = format!("record batch {number}");
            let arrays = guarded(&place, || reader.next().transpose());
            let arrays = arrays.map_err(|detail| damaged(path, detail))?;
            let Some(arrays) = arrays.map(|batch| batch.into_arrays()) else {
                break;
            };
            let series = |own: &Wanted| {
                let mut all = read.iter().zip(&arrays);
                let name = own.field.name.as_str();
                let place = format!("{place}, column `{name}`");
                let found = all.find(|((_, field), _)| field.name == own.field.name);
                let array = found.map(|(_, array)| array.as_ref());
                let series = guarded(&place, || {
                    array.map(|array| converted(own, array)).transpose()
                })
                .map_err(|detail| damaged(path, detail))?;
                let series = series.ok_or_else(|| damaged(path, format!("{place}: absent")))?;
                let series = own.taken(series);
                let series = series.map_err(|fault| own.short(path, &fault))?;
                with_missing(path, series)
            };
            let columns = wanted.iter().map(series).collect::<Result<_, _>>()?;
            let batch = frame(columns).map_err(|error| FileError::new(path, error))?;
            left = left.saturating_sub(batch.height());
            take(batch)?;
        }
        Ok(())
    }
}

// A column in the type into which it is decoded.
fn converted(wanted: &Wanted, array: &dyn Array) -> polars::error::PolarsResult<Series> {
    use polars_arrow::datatypes::PhysicalType;
    use polars_arrow::types::PrimitiveType as Number;
    let name = wanted.field.name.clone();
    let array: Box<dyn Array> = match array.dtype().to_physical_type() {
        PhysicalType::Primitive(Number::Int8) => widened::<i8, i32>(array),
        PhysicalType::Primitive(Number::Int16) => widened::<i16, i32>(array),
        PhysicalType::Primitive(Number::UInt8) => widened::<u8, u32>(array),
        PhysicalType::Primitive(Number::UInt16) => widened::<u16, u32>(array),
        PhysicalType::Dictionary(key) => {
            return match_integer_type!(key, |$T| {
                let own: &DictionaryArray<$T> = downcast(array);
                let words = Series::try_from((name.clone(), own.values().clone()))?;
                let words = words.str()?;
                let texts = own.keys_iter().map(|key| key.and_then(|key| words.get(key)));
                Ok(Series::new(name, texts.collect::<Vec<Option<&str>>>()))
            });
        }
        PhysicalType::List => {
            let own: &ListArray<i32> = downcast(array);
            lists(wanted, own.offsets().into(), own.values().clone(), own)
        }
        PhysicalType::FixedSizeList => {
            let own: &FixedSizeListArray = downcast(array);
            let offsets: Vec<i64> = (0..=own.len())
                .map(|row| (row * own.size()) as i64)
                .collect();
            lists(
                wanted,
                OffsetsBuffer::try_from(offsets)?,
                own.values().clone(),
                own,
            )
        }
        _ => array.to_boxed(),
    };
    Series::try_from((name, array))
}

// polars has no columns of small integers without its features for them.
fn widened<T: NativeType, U: NativeType + From<T>>(array: &dyn Array) -> Box<dyn Array> {
    let own: &PrimitiveArray<T> = downcast(array);
    let values: Vec<U> = own.values_iter().map(|value| U::from(*value)).collect();
    PrimitiveArray::from_vec(values)
        .with_validity(own.validity().cloned())
        .boxed()
}

fn lists(
    wanted: &Wanted,
    offsets: OffsetsBuffer<i64>,
    values: Box<dyn Array>,
    own: &dyn Array,
) -> Box<dyn Array> {
    let validity = own.validity().cloned();
    ListArray::new(
        wanted.field.dtype.clone(),
        offsets,
        values.clone(),
        validity,
    )
    .boxed()
}

// A panic here is reported like one of polars: the type of the array contradicts its own.
fn downcast<A: 'static>(array: &dyn Array) -> &A {
    let own = array.as_any().downcast_ref();
    own.expect("an array of its own type")
}

// The bytes of a part; `None` unless they are among the first `most`.
fn part(start: i64, size: i64, most: u64) -> Option<Range<u64>> {
    let start = u64::try_from(start).ok()?;
    let end = start.checked_add(u64::try_from(size).ok()?)?;
    (end <= most).then_some(start..end)
}

// The number of rows of a record batch or dictionary, if the file has all of its buffers and none of them asks for more memory
// than its bytes can have compressed.
fn check_block(file: &mut File, length: u64, block: &Block) -> Result<usize, String> {
    let head = part(block.offset, block.meta_data_length.into(), length);
    let body = head.clone().and_then(|head| {
        let start = i64::try_from(head.end).ok()?;
        part(start, block.body_length, length)
    });
    let (Some(head), Some(body)) = (head, body) else {
        return Err(format!(
            "found bytes from {}, {} and {} of them, expected a part of the file's {length} bytes",
            block.offset, block.meta_data_length, block.body_length
        ));
    };
    let failed = |error: std::io::Error| error.to_string();
    let mut message = vec![0; (head.end - head.start) as usize];
    file.seek(SeekFrom::Start(head.start)).map_err(failed)?;
    file.read_exact(&mut message).map_err(failed)?;
    // The mark of a continued message, and its length.
    let start = if message.starts_with(&[0xff; 4]) {
        8
    } else {
        4
    };
    let words = message.get(start..).unwrap_or_default();
    let faulty = |error: polars_arrow_format::ipc::planus::Error| error.to_string();
    let header = MessageRef::read_as_root(words).map_err(faulty)?.header();
    let batch = match header.map_err(faulty)? {
        Some(MessageHeaderRef::RecordBatch(batch)) => Some(batch),
        Some(MessageHeaderRef::DictionaryBatch(own)) => own.data().map_err(faulty)?,
        _ => None,
    };
    let batch: RecordBatchRef<'_> = batch.ok_or("found another message")?;
    let is_compressed = batch.compression().map_err(faulty)?.is_some();
    for buffer in batch.buffers().map_err(faulty)?.into_iter().flatten() {
        let Some(own) = part(buffer.offset(), buffer.length(), body.end - body.start) else {
            return Err(format!(
                "found a buffer of {} bytes from {}, expected a part of {} bytes",
                buffer.length(),
                buffer.offset(),
                block.body_length
            ));
        };
        let size = own.end - own.start;
        if is_compressed && size > 0 {
            let mut stated = [0; 8];
            file.seek(SeekFrom::Start(body.start + own.start))
                .map_err(failed)?;
            file.read_exact(&mut stated).map_err(failed)?;
            let stated = i64::from_le_bytes(stated);
            let most = MAX_BUFFER.min(MAX_EXPANSION * size);
            // −1 marks a buffer that is not compressed.
            if stated != -1 && u64::try_from(stated).is_ok_and(|stated| stated > most) {
                return Err(format!(
                    "found {stated} bytes in a buffer of {size}, expected at most {most}"
                ));
            }
        }
    }
    usize::try_from(batch.length().map_err(faulty)?).map_err(|error| error.to_string())
}
