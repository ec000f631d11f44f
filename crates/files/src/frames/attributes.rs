//! Metadata of Parquet files where other programs look for them: in the Arrow schema.

use std::collections::BTreeMap;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use polars::prelude::{CompatLevel, DataFrame, DataType, SchemaExt};
use polars_arrow::io::ipc::write::{default_ipc_fields, schema_to_bytes};
use serde_json::{Map, Value, json};

use super::Metadata;

/// Key of what becomes `DataFrame.attrs` in pandas.
const PANDAS: &str = "PANDAS_ATTRS";
/// Key of what becomes `Table.meta` in astropy: YAML, of which JSON is a part.
const ASTROPY: &str = "table_meta_yaml";
/// What precedes the length of a message of Arrow.
const START: [u8; 4] = [0xff; 4];

/// The value of the key `ARROW:schema` for a table with `metadata`, which pyarrow, pandas and astropy read from there.
pub(super) fn arrow_schema(table: &DataFrame, metadata: &Metadata) -> String {
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
    STANDARD.encode([&START[..], &length, &bytes].concat())
}
