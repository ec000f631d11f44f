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
fn selected_folders_have_the_means_of_where_and_are_scored() {
    let small = Small::new("2");
    small.measure(&LINEAR);
    let (data, out, chosen) = (small.at("data"), small.at("out"), small.at("chosen"));
    // The median, so that some galaxies are left out, some weighted.
    let mut sizes = small.measured("02", "size");
    sizes.sort_by(f64::total_cmp);
    let cut = format!("step(size, {})", sizes[sizes.len() / 2]);
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
    let again = ["mean", "--measured", text(&chosen)];
    let refused = fail(&[&again[..], &options].concat());
    assert!(refused.contains("has a selection already"), "{refused}");
}

#[test]
fn bias_has_the_selection_of_the_folder_and_warns_of_others() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let data = at("data");
    let shears = ["--constant-shear", "0.02,0.02", "--opposite"];
    let size = [
        "--sets", "2", "--images", "1", "--grid", "40", "--seed", "5",
    ];
    let simulated = [&["simulate", "--out", text(&data)], &size[..], &shears].concat();
    succeed(&simulated);
    let cut = ["--where", "step(size, 2) and step(snr, 15)"];
    let (mut measured, mut selected) = (Vec::new(), Vec::new());
    for sign in ["+", "-"] {
        let data = data.join(format!("g1_{sign}0.02_g2_{sign}0.02"));
        let (out, chosen) = (at(&format!("out{sign}")), at(&format!("chosen{sign}")));
        let folders = ["--data", text(&data), "--out", text(&out)];
        succeed(&[&["measure"], &LINEAR[..], &folders].concat());
        let folders = ["--measured", text(&out), "--out", text(&chosen)];
        succeed(&[&["select"], &folders[..], &cut].concat());
        measured.push(text(&out).to_owned());
        selected.push(text(&chosen).to_owned());
    }
    let m = |folders: &[String], options: &[&str]| {
        let folders: Vec<&str> = folders.iter().map(String::as_str).collect();
        let arguments = [&["bias", "--format", "json"], &folders[..], options].concat();
        let run = shearq(&arguments);
        let warned = String::from_utf8_lossy(&run.stderr).into_owned();
        let table: Value = serde_json::from_slice(&run.stdout).unwrap();
        let row = &table["rows"][0];
        (["m1", "m2"].map(|m| row[m].as_f64().unwrap()), warned)
    };
    let (at_once, silent) = m(&measured, &cut);
    let (written, _) = m(&selected, &[]);
    assert_eq!(silent, "");
    for (a, b) in at_once.iter().zip(written) {
        // Folders are calibrated image by image: responses of both differ by about a hundredth, and so do the parts of m.
        assert!((a - b).abs() < 1e-3, "{a} {b}");
        assert!(a.abs() < 0.1, "{a}");
    }
    let (_, warned) = m(&measured, &["--bins", "snr:2"]);
    assert!(warned.contains("a choice by `snr`"), "{warned}");
    let (filtered, warned) = m(&measured, &["--where", "size > 2 and snr > 15"]);
    assert!(warned.contains("Try: --where 'step("), "{warned}");
    // A cut in size removes sheared galaxies; m of 3200 galaxies without shape noise has an error of 0.03.
    assert!(filtered[0] + filtered[1] < -0.2, "{filtered:?}");
    // The table says how the galaxies were chosen, and shards of other choices do not merge.
    let folders: Vec<&str> = measured.iter().map(String::as_str).collect();
    let shard = |number: usize, cut: &str| {
        let sums = at(&format!("{number}.json"));
        let part = format!("{number}/2");
        let options = [
            "--where",
            cut,
            "--weight",
            "snr^2",
            "--shard",
            &part,
            "--sums",
            text(&sums),
        ];
        succeed(&[&["bias"], &folders[..], &options].concat());
        text(&sums).to_owned()
    };
    let (first, second) = (shard(1, "step(snr, 15)"), shard(2, "step(snr, 15)"));
    let merged = succeed(&["bias", "--merge", &first, &second]);
    let stated = "Selection: where: step(snr, 15); weight: snr^2.";
    assert!(merged.contains(stated), "{merged}");
    let other = shard(2, "step(snr, 16)");
    let refused = fail(&["bias", "--merge", &first, &other]);
    assert!(refused.contains("different options"), "{refused}");
    let path = at("chosen+").join("set02/catalogue-001.parquet");
    let given = ["bias", text(&path), "--g1", "0.02", "--g2", "0.02"];
    let refused = fail(&[&given[..], &cut].concat());
    assert!(refused.contains("has a selection already"), "{refused}");
}

#[test]
fn sheared_versions_give_the_response_of_any_selection() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let own = at("own.toml");
    let settings = "name = \"own\"\nextends = \"48/linear/star\"\n[shape]\nsheared_step = 0.02\n";
    std::fs::write(&own, settings).unwrap();
    let data = at("data");
    let sets = ["--sets", "8", "--images", "1", "--grid", "20"];
    let shears = ["--constant-shear=0.03,0.03", "--opposite"];
    succeed(&[&["simulate", "--out", text(&data)], &sets[..], &shears].concat());
    let measured = ["+", "-"].map(|sign| {
        let data = data.join(format!("g1_{sign}0.03_g2_{sign}0.03"));
        let out = at(sign);
        let folders = ["--data", text(&data), "--out", text(&out)];
        succeed(&[&["measure", "--submission", text(&own)], &folders[..]].concat());
        text(&out).to_owned()
    });
    let folders = [measured[0].as_str(), measured[1].as_str()];
    let said = |options: &[&str]| succeed(&[&["bias"], &folders[..], options].concat());
    // The ellipticity of each version may be cut, too.
    let cut = [
        "--where",
        "e1*e1 + e2*e2 < 0.09 and size > 1",
        "--step",
        "0.02",
    ];
    let table: Value =
        serde_json::from_str(&said(&[&cut[..], &["--format", "json"]].concat())).unwrap();
    let row = &table["rows"][0];
    let number = |name: &str| row[name].as_f64().unwrap();
    assert!((200.0..800.0).contains(&number("n")), "{}", number("n"));
    for k in ["m1", "m2"] {
        let error = number(&format!("{k}_error"));
        assert!(
            number(k).abs() < 4.0 * error,
            "{k}: {} ± {error}",
            number(k)
        );
    }
    assert!(said(&cut).contains("Columns: shearq, sheared versions."));
    // Names of the unsheared version, and columns that shear does not change, select the same galaxies with the same response.
    let json = |select: &str| {
        let printed = said(&["--where", select, "--step", "0.02", "--format", "json"]);
        let table: Value = serde_json::from_str(&printed).unwrap();
        table["rows"][0].clone()
    };
    let plain = json("size > 2.7");
    assert!(plain["n"].as_f64().unwrap() < 700.0, "{plain}");
    for select in ["size_noshear > 2.7", "size > 2.7 and x > 0 and flags == 0"] {
        assert_eq!(json(select), plain, "{select}");
    }
    // Bins of columns without versions keep the response of the selection, and the reverse.
    let of_all = |options: &[&str]| {
        let printed = said(&[options, &["--step", "0.02", "--format", "json"]].concat());
        let table: Value = serde_json::from_str(&printed).unwrap();
        ["m1", "m2", "r1", "r2"].map(|name| table["rows"][0][name].as_f64().unwrap())
    };
    let alone = of_all(&["--where", "size > 2.7"]);
    let binned = of_all(&["--where", "size > 2.7", "--bins", "x:2"]);
    for (alone, binned) in alone.iter().zip(binned) {
        // Sums in another order.
        assert!((alone - binned).abs() < 1e-9, "{alone} {binned}");
    }
    let by_place = of_all(&["--where", "x > 0", "--bins", "snr:2"]);
    for (alone, binned) in of_all(&["--bins", "snr:2"]).iter().zip(by_place) {
        assert!((alone - binned).abs() < 1e-9, "{alone} {binned}");
    }
    for (select, expected) in [
        (
            "size_1p > 2.7",
            "belongs to one sheared catalogue (expected a column of all). Try: size",
        ),
        (
            "size > 2.7 and R11 > 0",
            "`R11`: it changes with shear, and has no columns of sheared",
        ),
    ] {
        let refused = fail(
            &[
                &["bias"],
                &folders[..],
                &["--where", select, "--step", "0.02"],
            ]
            .concat(),
        );
        assert!(refused.contains(expected), "{refused}");
    }
    // Without a selection that needs them, and with one whose response is known, versions only add noise.
    assert!(said(&[]).contains("Columns: shearq."));
    assert!(said(&["--where", "step(snr, 20)"]).contains("Columns: shearq."));
    let refused = fail(&[&["bias"], &folders[..], &cut[..2]].concat());
    assert!(
        refused.contains("found 0.02, expected 0.01). Try: --step 0.02"),
        "{refused}"
    );
    // What `select` wrote has none that are not selected.
    let chosen = at("chosen");
    let folders = ["--measured", &measured[0], "--out", text(&chosen)];
    succeed(&[&["select"], &folders[..], &["--where", "step(snr, 20)"]].concat());
    for (folder, has) in [(at("+"), true), (chosen, false)] {
        let path = folder.join("set08/catalogue-001.parquet");
        let read = table::read(&path, None, table::MAX_ROWS).unwrap();
        let names = read.get_column_names();
        assert_eq!(names.iter().any(|name| *name == "snr_2m"), has);
    }
}

#[test]
fn selections_that_cannot_be_corrected_are_refused() {
    let small = Small::new("2");
    small.measure(&LINEAR);
    let out = small.at("out");
    let refused =
        |option: &str, value: &str| fail(&["mean", "--measured", text(&out), option, value]);
    for (option, value, expected) in [
        (
            "--where",
            "step(R11, 0.3)",
            "its response to shear is not known",
        ),
        ("--where", "snr > 10", "Try: step(NAME, THRESHOLD)"),
        ("--where", "step(snr, 10, 0)", "half width positive"),
        ("--where", "step(snr, 1e9)", "the selection leaves none"),
        ("--weight", "abs(snr)", "is not smooth"),
        ("--weight", "e1", "cannot depend on `e1`"),
        ("--weight", "snr +", "cannot read the expression"),
        ("--weight", "0 - snr", "the weight is -"),
    ] {
        let message = refused(option, value);
        assert!(message.contains(expected), "{option} {value}: {message}");
    }
    let (from, to) = (text(&out), small.at("too-few"));
    let select = ["select", "--measured", from, "--out", text(&to), "--where"];
    let message = fail(&[&select[..], &["step(snr, 1e9)"]].concat());
    assert!(
        message.contains("leaves no galaxies with a response"),
        "{message}"
    );
    assert!(!to.exists());
    small.measure(&["--submission", "23/raw/star"]);
    let message = refused("--where", "step(snr, 10)");
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
