//! Properties of any settings. The inputs differ from run to run; a failure prints the smallest
//! input that fails.

use proptest::collection::vec;
use proptest::prelude::*;
use shearq_submissions::{Configuration, Registry};
use toml::Value;

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

}
