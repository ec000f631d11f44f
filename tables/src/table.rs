//! The table in memory: named columns of equal length with text metadata.

use std::collections::{BTreeMap, BTreeSet};

use crate::TableError;

/// The key under which Parquet files keep the Arrow schema.
pub(crate) const SCHEMA_KEY: &str = "ARROW:schema";

/// The values of one column, one per row.
#[derive(Debug, Clone, PartialEq)]
pub enum Column {
    /// 64-bit floats; NaN stands for a missing value.
    F64(Vec<f64>),
    /// 32-bit floats; NaN stands for a missing value.
    F32(Vec<f32>),
    /// Signed integers.
    I64(Vec<i64>),
    /// Unsigned integers, such as identifiers and flags.
    U32(Vec<u32>),
    /// Text.
    Text(Vec<String>),
}

impl Column {
    /// The number of rows.
    pub fn len(&self) -> usize {
        match self {
            Self::F64(values) => values.len(),
            Self::F32(values) => values.len(),
            Self::I64(values) => values.len(),
            Self::U32(values) => values.len(),
            Self::Text(values) => values.len(),
        }
    }

    /// Whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The values as 64-bit floats, or `None` for text.
    ///
    /// Integers beyond ±2⁵³ are rounded to the nearest float.
    pub fn to_f64(&self) -> Option<Vec<f64>> {
        match self {
            Self::F64(values) => Some(values.clone()),
            Self::F32(values) => Some(values.iter().map(|&value| f64::from(value)).collect()),
            Self::I64(values) => Some(values.iter().map(|&value| value as f64).collect()),
            Self::U32(values) => Some(values.iter().map(|&value| f64::from(value)).collect()),
            Self::Text(_) => None,
        }
    }
}

/// Named columns of equal length, in a fixed order, with text metadata.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Table {
    columns: Vec<(String, Column)>,
    metadata: BTreeMap<String, String>,
}

impl Table {
    /// A table of `columns`, in this order, with `metadata`.
    ///
    /// # Errors
    /// [`TableError::DuplicateColumn`] if two columns share a name,
    /// [`TableError::UnequalLengths`] if a column's length differs from the first one's, and
    /// [`TableError::ReservedKey`] for a metadata key that Parquet files use for themselves.
    pub fn new(
        columns: Vec<(String, Column)>,
        metadata: BTreeMap<String, String>,
    ) -> Result<Self, TableError> {
        let mut seen = BTreeSet::new();
        for (name, column) in &columns {
            if !seen.insert(name.as_str()) {
                return Err(TableError::DuplicateColumn { name: name.clone() });
            }
            let (first, expected) = (&columns[0].0, columns[0].1.len());
            if column.len() != expected {
                return Err(TableError::UnequalLengths {
                    column: name.clone(),
                    found: column.len(),
                    first: first.clone(),
                    expected,
                });
            }
        }
        if metadata.contains_key(SCHEMA_KEY) {
            return Err(TableError::ReservedKey {
                key: SCHEMA_KEY.into(),
            });
        }
        Ok(Self { columns, metadata })
    }

    /// The number of rows, 0 for a table without columns.
    pub fn rows(&self) -> usize {
        self.columns.first().map_or(0, |(_, column)| column.len())
    }

    /// The columns with their names, in order.
    pub fn columns(&self) -> &[(String, Column)] {
        &self.columns
    }

    /// The column called `name`, if there is one.
    pub fn column(&self, name: &str) -> Option<&Column> {
        self.columns
            .iter()
            .find(|(own, _)| own == name)
            .map(|(_, column)| column)
    }

    /// The metadata.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The columns and the metadata, without copying.
    pub fn into_parts(self) -> (Vec<(String, Column)>, BTreeMap<String, String>) {
        (self.columns, self.metadata)
    }
}
