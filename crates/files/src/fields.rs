//! Columns of Arrow's types, as Parquet and Arrow files have them: which of them are read, and what they become.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use polars::prelude::{
    ArrowDataType, ArrowField, ChunkFillNullValue, ChunkedArray, Column, DataFrame, DataType,
    IntoSeries, NamedFrom, PolarsNumericType, PolarsResult, Series,
};

use crate::frames::{element_name, element_of, reals};
use crate::{FileError, MAX_EXACT_INTEGER};

// Longest vector that becomes one column per number.
pub(crate) const MAX_VECTOR: usize = 8;

/// A column, or the numbers at one place of a column of vectors.
pub(crate) struct Wanted {
    pub(crate) field: ArrowField,
    pub(crate) element: Option<usize>,
}

impl Wanted {
    pub(crate) fn whole(field: ArrowField) -> Self {
        Wanted {
            field,
            element: None,
        }
    }

    /// What is said of lists that are too short, which are no damage.
    pub(crate) fn short(&self, path: &Path, fault: &str) -> FileError {
        let name = self.field.name.as_str();
        let message = format!(
            "column `{name}`: {fault}, as `{}` needs",
            element_name(name, self.element.unwrap_or_default())
        );
        FileError::new(path, message).hint("a column of numbers in place of lists")
    }

    /// The numbers of decoded vectors; other columns as they are.
    pub(crate) fn taken(&self, vectors: Series) -> Result<Series, String> {
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

/// The names of the columns that can be read.
pub(crate) fn names(fields: &[ArrowField]) -> Vec<String> {
    fields.iter().flat_map(names_in).collect()
}

/// The columns called `wanted` of a file with these fields; all of them, if `None`.
pub(crate) fn pick(
    path: &Path,
    fields: &[ArrowField],
    wanted: Option<&[&str]>,
) -> Result<Vec<Wanted>, FileError> {
    let Some(wanted) = wanted else {
        return Ok(fields.iter().cloned().map(Wanted::whole).collect());
    };
    let mut seen = BTreeSet::new();
    wanted
        .iter()
        .map(|&name| {
            if !seen.insert(name) {
                let message = format!("column `{name}` is named twice; expected every name once");
                return Err(FileError::new(path, message));
            }
            let called = |name| fields.iter().find(move |field| field.name == name);
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
                .ok_or_else(|| FileError::no_column(path, name, &names(fields)))
        })
        .collect()
}

/// The same column with the type into which it is decoded.
pub(crate) fn decoded(path: &Path, wanted: &Wanted) -> Result<Wanted, FileError> {
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
        FileError::new(path, message)
    })?;
    Ok(Wanted {
        field: ArrowField::new(field.name.clone(), decoded, field.is_nullable),
        element: *element,
    })
}

// Runs a part of polars on the contents of a file.
//
// Its decoders return errors for most damage, but index out of range or overflow on some; that
// must not take a long run down, so such a panic becomes an error too.
pub(crate) fn guarded<T>(place: &str, run: impl FnOnce() -> PolarsResult<T>) -> Result<T, String> {
    let detail = match caught(run) {
        Ok(Ok(value)) => return Ok(value),
        Ok(Err(error)) => error.to_string(),
        Err(_) => "the contents contradict themselves".into(),
    };
    Err(format!("{place}: {detail}"))
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
pub(crate) fn decoded_type(declared: &ArrowDataType) -> Option<ArrowDataType> {
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
        Type::Utf8 | Type::LargeUtf8 => Some(Type::Utf8View),
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

/// A table without its columns of text, which are refused if they are wanted.
pub(crate) fn numbers_alone(
    path: &Path,
    table: DataFrame,
    is_wanted: bool,
) -> Result<DataFrame, FileError> {
    let columns = table.columns().iter();
    let texts = columns.filter(|column| column.dtype().is_string());
    let texts: Vec<String> = texts.map(|column| column.name().to_string()).collect();
    if let Some(name) = texts.first().filter(|_| is_wanted) {
        let message = format!("column `{name}` holds text; expected numbers");
        return Err(FileError::new(path, message));
    }
    Ok(table.drop_many(texts))
}

/// The column, in which missing numbers are NaN: one of integers with missing ones becomes one of floats.
pub(crate) fn with_missing(path: &Path, column: Series) -> Result<Column, FileError> {
    let name = column.name().to_string();
    let filled = match (column.null_count(), column.dtype()) {
        (0, _) => return Ok(column.into()),
        (_, DataType::Float64) => filled(column.f64(), f64::NAN),
        (_, DataType::Float32) => filled(column.f32(), f32::NAN),
        (count, _) => {
            let column = Column::from(column);
            let numbers = reals(&column);
            let exact = numbers.filter(|all| !all.iter().any(|own| own.abs() >= MAX_EXACT_INTEGER));
            return match exact {
                Some(numbers) => Ok(Column::new(name.into(), numbers.into_owned())),
                None => {
                    let message = format!(
                        "column `{name}` has {count} missing value(s) (expected them in columns of floats, of integers below 2⁵³ or of truth values, where they become NaN)"
                    );
                    Err(FileError::new(path, message)
                        .hint("the table without these rows, or with values for them"))
                }
            };
        }
    };
    filled.map_err(|error| FileError::new(path, format!("column `{name}`: {error}")))
}

fn filled<T>(values: PolarsResult<&ChunkedArray<T>>, missing: T::Native) -> PolarsResult<Column>
where
    T: PolarsNumericType,
    ChunkedArray<T>: ChunkFillNullValue<T::Native> + IntoSeries,
{
    Ok(values?.fill_null_with_values(missing)?.into_series().into())
}
