//! Properties of any settings and any catalogue. The inputs differ from run to run; a failure prints the smallest
//! input that fails.

use std::fs;

use proptest::collection::vec;
use proptest::num::f64::{NEGATIVE, NORMAL, POSITIVE, QUIET_NAN, ZERO};
use proptest::prelude::*;
use shearq_files::frames::frame;
use shearq_files::frames::polars::Column;
use shearq_files::table::{self, FileFormat};
use shearq_submissions::{Configuration, Registry};
use toml::Value;

const NAMES: [&str; 4] = ["x", "y", "e1", "e2"];

fn config() -> ProptestConfig {
    ProptestConfig {
        cases: 200,
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

/// Any value of a setting: numbers at their limits, words that other settings use, and other types.
fn setting() -> impl Strategy<Value = Value> {
    let words = "star,functional,linear,network,image,border,header,response,\
        none,total,peak,shear,distortion,";
    prop_oneof![
        any::<i64>().prop_map(Value::Integer),
        (-3i64..100).prop_map(Value::Integer),
        proptest::num::f64::ANY.prop_map(Value::Float),
        (-1.0..30.0).prop_map(Value::Float),
        any::<bool>().prop_map(Value::Boolean),
        proptest::sample::select(words.split(',').collect::<Vec<_>>())
            .prop_map(|word| Value::String(word.to_owned())),
        Just(Value::Array(Vec::new())),
    ]
}

/// The keys of a table that have no keys inside, with the tables they are in.
fn leaves(value: &Value, place: &[String], found: &mut Vec<Vec<String>>) {
    match value {
        Value::Table(table) => {
            for (key, inside) in table {
                leaves(inside, &[place, std::slice::from_ref(key)].concat(), found);
            }
        }
        _ => found.push(place.to_vec()),
    }
}

/// The table that a key is in.
fn parent<'a>(value: &'a mut Value, place: &[String]) -> Option<&'a mut toml::Table> {
    let mut table = value.as_table_mut()?;
    for key in &place[..place.len() - 1] {
        table = table.get_mut(key)?.as_table_mut()?;
    }
    Some(table)
}

proptest! {
    #![proptest_config(config())]

    /// Changed settings are refused with a message, or are a configuration that is read back as written.
    #[test]
    fn changed_settings_are_refused_or_read_back(
        name in any::<prop::sample::Index>(),
        changes in vec((any::<prop::sample::Index>(), prop::option::of(setting())), 0..4),
    ) {
        let registry = Registry::embedded().unwrap();
        let configuration = registry.get(&registry.names()[name.index(registry.names().len())]).unwrap().configuration;
        let mut settings = Value::try_from(&configuration).unwrap();
        for (which, value) in changes {
            let mut places = Vec::new();
            leaves(&settings, &[], &mut places);
            let place = which.get(&places);
            let key = place.last().unwrap();
            let table = parent(&mut settings, place).unwrap();
            match value {
                Some(value) => table.insert(key.clone(), value),
                None => table.remove(key),
            };
        }
        let text = toml::to_string(&settings).unwrap();
        match text.parse::<Configuration>() {
            Ok(read) => {
                let again = toml::to_string(&read).unwrap();
                prop_assert_eq!(again.parse::<Configuration>().unwrap(), read);
            }
            Err(error) => prop_assert!(!error.to_string().trim().is_empty()),
        }
    }

    /// Catalogues are read back from files of both formats and from text. cfitsio reads subnormal numbers and −0 as 0.
    #[test]
    fn catalogues_are_read_back(
        rows in vec(prop::array::uniform4(POSITIVE | NEGATIVE | NORMAL | ZERO | QUIET_NAN), 1..40),
        separator in prop::sample::select(vec![",", ";", "\t", " "]),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let at = |ending: &str| folder.path().join(format!("table.{ending}"));
        let columns = (0..4).map(|k| {
            let values: Vec<f64> = rows.iter().map(|row| row[k]).collect();
            Column::new(NAMES[k].into(), values)
        });
        let frame = frame(columns.collect()).unwrap();
        for format in [FileFormat::Parquet, FileFormat::Fits] {
            table::write(&at(format.extension()), format, &frame, &Default::default()).unwrap();
        }
        let line = |row: &[f64; 4]| row.map(|value| format!("{value:e}")).join(separator);
        let lines: Vec<String> = rows.iter().map(line).collect();
        fs::write(at("csv"), NAMES.join(separator) + "\n" + &lines.join("\n") + "\n").unwrap();
        for ending in ["parquet", "fits", "csv"] {
            let path = at(ending);
            let read = table::read(&path, Some(&NAMES), table::MAX_ROWS).unwrap();
            for (k, name) in NAMES.iter().enumerate() {
                let found = table::numbers(&read, name, &path).unwrap();
                prop_assert_eq!(found.len(), rows.len(), "{}", ending);
                for (found, row) in found.iter().zip(&rows) {
                    let same = *found == row[k] || (found.is_nan() && row[k].is_nan());
                    prop_assert!(same, "{}, {}: {} {}", ending, name, found, row[k]);
                }
            }
        }
    }

    /// Text tables of any cells are read or refused.
    #[test]
    fn text_tables_of_any_cells_are_read_or_refused(
        cells in vec(vec("[-+0-9.eENaif\"#|, ]{0,12}", 0..6), 0..8),
        head in prop::sample::select(&["x,y,e1,e2\n", "# x y e1 e2\n", "# 1 x\n# 2 y\n# 3 e1\n# 4 e2\n", "\n", ""][..]),
        separator in prop::sample::select(vec![",", ";", "\t", " "]),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("table.csv");
        let lines: Vec<String> = cells.iter().map(|cells| cells.join(separator)).collect();
        fs::write(&path, head.to_owned() + &lines.join("\n")).unwrap();
        match table::read(&path, Some(&NAMES), table::MAX_ROWS) {
            Ok(read) => prop_assert!(read.height() <= cells.len()),
            Err(error) => prop_assert!(error.to_string().contains("table.csv")),
        }
    }
}
