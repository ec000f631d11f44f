//! `score --truth ... --format json` gives the figures of the challenge's own program, under the
//! same names.

use serde_json::Value;

use crate::support::{succeed, text};

/// Every key of `expected` is in `found`, with the same numbers.
fn compare(place: &str, found: &Value, expected: &Value, tolerance: f64, wrong: &mut Vec<String>) {
    match expected {
        Value::Object(entries) => {
            for (key, value) in entries {
                // Words are not figures.
                if ["case", "description", "files"].contains(&key.as_str()) {
                    continue;
                }
                match found.get(key) {
                    Some(inner) => {
                        compare(&format!("{place}.{key}"), inner, value, tolerance, wrong);
                    }
                    None => wrong.push(format!("{place}.{key} is missing")),
                }
            }
        }
        Value::Array(values) => {
            for (k, value) in values.iter().enumerate() {
                compare(&format!("{place}[{k}]"), &found[k], value, tolerance, wrong);
            }
        }
        Value::Number(number) => {
            // Conventions of one class tie up to rounding.
            if place.ends_with(".winner") {
                return;
            }
            let (f, e) = (found.as_f64(), number.as_f64().unwrap());
            // Powers of B modes are rounding of those of E, which are up to 3·10⁻⁵: 10⁻⁶ of them. M and correlations are
            // differences of nearly equal numbers.
            let name = place.rsplit('.').next().unwrap_or_default();
            let scale = match name.split('[').next() {
                Some("EE" | "BB") => 3e-11,
                Some("M" | "m" | "corr" | "corr_matched") => 1e-3,
                _ => 0.0,
            };
            if !f.is_some_and(|f| (f - e).abs() <= tolerance * e.abs().max(scale)) {
                wrong.push(format!("{place}: found {f:?}, expected {e}"));
            }
        }
        other => {
            if found != other {
                wrong.push(format!("{place}: found {found}, expected {other}"));
            }
        }
    }
}

fn keys_of(value: &Value, found: &mut Vec<String>) {
    for (key, value) in value.as_object().into_iter().flatten() {
        found.push(key.clone());
        // Those below are the users' files, roles of columns, and options.
        if !["inputs", "columns", "settings"].contains(&key.as_str()) {
            keys_of(value, found);
        }
    }
}

/// Asserts that the manual describes each key, apart from numbers of conventions.
fn assert_described(keys: &[String]) {
    let docs = std::fs::read_to_string("docs/files.md").unwrap();
    let docs = &docs[docs.find("JSON of one set").unwrap()..];
    let between = |c: char| !c.is_alphanumeric() && c != '_';
    assert!(keys.len() > 60);
    for key in keys.iter().filter(|key| key.parse::<u8>().is_err()) {
        let described = docs.split(between).any(|word| word == key);
        assert!(described, "{key} is not described");
    }
}

#[test]
fn json_has_each_figure_of_the_public_cases_and_each_key_a_text() {
    let mut wrong = Vec::new();
    let (mut cases, mut keys) = (0, Vec::new());
    for entry in std::fs::read_dir("scoring/tests/data").unwrap() {
        let case = entry.unwrap().path();
        let Ok(expected) = std::fs::read_to_string(case.join("expected.json")) else {
            continue;
        };
        cases += 1;
        let expected: Value = serde_json::from_str(&expected).unwrap();
        let truth = case.join("truth.csv.gz");
        let noise = expected["noise_var"].to_string();
        let mut arguments = vec!["score", "--truth", text(&truth)];
        let catalogues: Vec<_> = expected["files"]["catalogues"]
            .as_array()
            .unwrap()
            .iter()
            .map(|name| case.join(format!("{}.gz", name.as_str().unwrap())))
            .collect();
        arguments.extend(catalogues.iter().map(|path| text(path)));
        arguments.extend(["--noise-var", &noise, "--format", "json"]);
        let found: Value = serde_json::from_str(&succeed(&arguments)).unwrap();
        keys_of(&found, &mut keys);
        let name = expected["case"].as_str().unwrap();
        assert_eq!(found["case"], name);
        assert!(found["description"].is_string() && found["files"]["truth"].is_string());
        // The cases' own README: 1e-9, and 1e-8 where nearly equal powers are subtracted.
        let tolerance = if name.contains("tiny_noise") {
            1e-8
        } else {
            1e-9
        };
        compare(name, &found, &expected, tolerance, &mut wrong);
    }
    assert_eq!(cases, 4);
    assert_described(&keys);
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
