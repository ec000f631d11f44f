//! Metadata of Parquet files in the forms in which pandas and astropy read them.

use serde_json::{Map, Value, json};

use crate::frames::Metadata;
use crate::frames::polars::{DataFrame, DataType};

/// Key of what becomes `DataFrame.attrs` in pandas.
const PANDAS: &str = "PANDAS_ATTRS";
/// Key of what becomes `Table.meta` in astropy: YAML, of which JSON is a part.
const ASTROPY: &str = "table_meta_yaml";

/// `metadata`, and the same for pandas and astropy, unless it is empty.
pub(crate) fn with(metadata: &Metadata, table: &DataFrame) -> Metadata {
    let mut all = metadata.clone();
    if metadata.is_empty() {
        return all;
    }
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
    let astropy = json!({"datatype": columns, "meta": pairs});
    all.insert(ASTROPY.into(), astropy.to_string());
    all.insert(PANDAS.into(), Value::Object(pairs).to_string());
    all
}
