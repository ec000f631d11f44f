//! Selections of measured galaxies by `mean` and `select`.

use serde_json::Value;
use shearq_files::table;

use crate::support::{Small, fail, shearq, succeed, text};

const LINEAR: [&str; 2] = ["--submission", "48/linear/star"];

/// g1 and the number of galaxies of set 2, as `mean` prints them.
fn mean(small: &Small, folder: &str, more: &[&str]) -> (f64, f64) {
    let folder = small.at(folder);
    let arguments = ["mean", "--measured", text(&folder), "--format", "json"];
    let printed = succeed(&[&arguments[..], more].concat());
    let table: Value = serde_json::from_str(&printed).unwrap();
    let row = &table["rows"][0];
    let number = |name: &str| row[name].as_f64().unwrap();
    (number("g1"), number("galaxies"))
}

#[test]
fn selected_folders_have_the_means_of_the_option_and_can_be_scored() {
    let small = Small::new("2");
    small.measure(&LINEAR);
    let (data, out, chosen) = (small.at("data"), small.at("out"), small.at("chosen"));
    // The median, so that some galaxies are left out, some weighted.
    let mut sizes = small.measured("02", "size");
    sizes.sort_by(f64::total_cmp);
    let cut = format!("size > {}", sizes[sizes.len() / 2]);
    let options = ["--where", &cut, "--weight", "snr^2/(snr^2 + 100)"];
    let arguments = ["select", "--measured", text(&out), "--out", text(&chosen)];
    succeed(&[&arguments[..], &options].concat());
    let (plain, all) = mean(&small, "out", &[]);
    let (selected, kept) = mean(&small, "out", &options);
    let (written, rows) = mean(&small, "chosen", &[]);
    assert!(kept < all && kept > 0.3 * all, "{kept} of {all}");
    assert_eq!(rows, all);
    assert_ne!(selected, plain);
    // Rounding of sums in another order.
    assert!((selected - written).abs() < 1e-12, "{selected} {written}");
    let path = chosen.join("set02/catalogue-001.parquet");
    let read = table::read(&path, None, table::MAX_ROWS).unwrap();
    let column = |name: &str| table::numbers(&read, name, &path).unwrap().into_owned();
    let (weights, e1, flags) = (column("selection"), column("e1"), column("flags"));
    for ((weight, e1), flag) in weights.iter().zip(&e1).zip(&flags) {
        if *weight == 0.0 && *flag == 0.0 {
            assert_eq!(*e1, 0.0);
        }
    }
    assert!(weights.iter().any(|weight| *weight > 0.0 && *weight < 1.0));
    succeed(&["score", "--data", text(&data), "--measured", text(&chosen)]);
    // Further measuring would mix selected catalogues with others.
    let again = ["measure", "--data", text(&data), "--out", text(&chosen)];
    let refused = fail(&[&again[..], &LINEAR].concat());
    assert!(refused.contains("results of other settings"), "{refused}");
    let twice = small.at("twice");
    let arguments = ["select", "--measured", text(&chosen), "--out", text(&twice)];
    let refused = fail(&[&arguments[..], &options].concat());
    assert!(refused.contains("have the selection"), "{refused}");
}

#[test]
fn selections_that_cannot_be_corrected_are_refused() {
    let small = Small::new("2");
    small.measure(&LINEAR);
    let out = small.at("out");
    let refused =
        |option: &str, value: &str| fail(&["mean", "--measured", text(&out), option, value]);
    for (option, value, expected) in [
        ("--where", "R11 > 0.3", "its response to shear is not known"),
        ("--where", "snr", "not a condition on galaxies"),
        ("--where", "snr > 1e9", "the selection leaves none"),
        ("--weight", "abs(snr)", "is not smooth"),
        ("--weight", "e1", "cannot depend on `e1`"),
        ("--weight", "snr +", "cannot read the expression"),
        ("--weight", "0 - snr", "the weight is -"),
    ] {
        let message = refused(option, value);
        assert!(message.contains(expected), "{option} {value}: {message}");
    }
    small.measure(&["--submission", "23/raw/star"]);
    let message = refused("--where", "snr > 10");
    assert!(
        message.contains("expected a catalogue of a linear configuration"),
        "{message}"
    );
    let none = shearq(&[
        "select",
        "--measured",
        text(&out),
        "--out",
        text(&small.at("none")),
    ]);
    assert_eq!(none.status.code(), Some(2));
}
