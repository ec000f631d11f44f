//! polars' frames of named columns, with text metadata.

use std::borrow::Cow;
use std::collections::BTreeMap;

use ::polars::prelude::{
    ChunkedArray, Column, DataFrame, DataType, PolarsNumericType, PolarsResult,
};

pub use ::polars::prelude as polars;

/// Text by name, which a file contains in addition to its columns.
pub type Metadata = BTreeMap<String, String>;

/// A frame of columns of one length with different names.
pub fn frame(columns: Vec<Column>) -> PolarsResult<DataFrame> {
    DataFrame::new_infer_height(columns)
}

/// The values of a column of numbers as 64-bit floats; `None` for another column. A missing value is NaN, true is 1 and
/// false 0. Integers beyond ±2⁵³ are rounded. 64-bit floats in one piece are borrowed, not copied.
pub fn reals(column: &Column) -> Option<Cow<'_, [f64]>> {
    let series = column.as_materialized_series();
    if let Ok(all) = series.f64()
        && let Ok(whole) = all.cont_slice()
    {
        return Some(Cow::Borrowed(whole));
    }
    let values = match series.dtype() {
        DataType::Float64 => series.f64().ok().map(|all| list(all, |v| v)),
        DataType::Float32 => series.f32().ok().map(|all| list(all, f64::from)),
        DataType::Int64 => series.i64().ok().map(|all| list(all, |v| v as f64)),
        DataType::UInt64 => series.u64().ok().map(|all| list(all, |v| v as f64)),
        DataType::Int32 => series.i32().ok().map(|all| list(all, f64::from)),
        DataType::UInt32 => series.u32().ok().map(|all| list(all, f64::from)),
        DataType::Boolean => series.bool().ok().map(|all| {
            let value = |flag: Option<bool>| flag.map_or(f64::NAN, f64::from);
            all.iter().map(value).collect()
        }),
        _ => None,
    };
    values.map(Cow::Owned)
}

/// The name of the number at `place` of the vectors in a column.
pub fn element_name(column: &str, place: impl std::fmt::Display) -> String {
    format!("{column}[{place}]")
}

/// The column and the place that [`element_name`] named.
pub fn element_of(name: &str) -> Option<(&str, usize)> {
    let (column, place) = name.strip_suffix(']')?.rsplit_once('[')?;
    Some((column, place.parse().ok()?))
}

fn list<T>(chunks: &ChunkedArray<T>, convert: impl Fn(T::Native) -> f64) -> Vec<f64>
where
    T: PolarsNumericType,
{
    let mut values = Vec::with_capacity(chunks.len());
    for chunk in chunks.downcast_iter() {
        if chunk.validity().is_none() {
            values.extend(chunk.values().iter().map(|&value| convert(value)));
        } else {
            let value = |value: Option<&T::Native>| value.map_or(f64::NAN, |&value| convert(value));
            values.extend(chunk.iter().map(value));
        }
    }
    values
}
