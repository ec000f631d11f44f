//! Baselines: the project's own, and what a moved digit looks like.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::support::{fail, run_simulated, shearq, succeed, text};

#[test]
fn named_configurations_keep_their_baselines() {
    let folder = Path::new("submissions/baselines");
    for name in ["named", "linear", "printed"] {
        let output = shearq(&["baseline", "check", name, "--folder", text(folder)]);
        assert!(
            output.status.success(),
            "{}{}",
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
    }
}

#[test]
fn changed_digits_and_settings_of_a_baseline_are_noticed() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let own = at("own.toml");
    fs::write(&own, "extends = \"23/raw/star\"\n[stamp]\nsize = 21\n").unwrap();
    for (submission, out) in [("23/raw/star", "raw"), (text(&own), "own")] {
        run_simulated("2", submission, &at(out), &[]);
    }
    let (folder, raw, own) = (at("baselines"), at("raw"), at("own"));
    let record = [
        "baseline",
        "record",
        "mine",
        "--folder",
        text(&folder),
        "--measured",
        text(&raw),
        text(&own),
    ];
    succeed(&record);
    assert!(fail(&record).contains("the baseline exists"));
    let junit = at("junit.xml");
    let check = [
        "baseline",
        "check",
        "--folder",
        text(&folder),
        "--format",
        "json",
        "--junit",
        text(&junit),
    ];
    let rows = |text: &str| -> Vec<Value> {
        let table: Value = serde_json::from_str(text).unwrap();
        table["rows"].as_array().unwrap().clone()
    };
    // Catalogues, threads and process are others; the figures are the same to the last digit.
    let sound = rows(&succeed(&check));
    assert_eq!(sound.len(), 10);
    assert!(
        sound
            .iter()
            .all(|row| row["difference"] == 0.0 && row["moved"] == "no")
    );

    let path = folder.join("mine.toml");
    let baseline = fs::read_to_string(&path).unwrap();
    let mut edited: toml::Table = baseline.parse().unwrap();
    let first = &mut edited["submissions"][0];
    let q = &mut first["sets"][0]["metrics"]["q"][0];
    *q = toml::Value::Float(q.as_float().unwrap() * 1.01);
    first["settings"]["deconvolution"]["lambda"] = toml::Value::Float(123.0);
    // As if this setting had come later: others than named submissions take the base's value.
    let second = edited["submissions"][1]["settings"]["deconvolution"].as_table_mut();
    second.unwrap().remove("constant_step").unwrap();
    fs::write(&path, toml::to_string(&edited).unwrap()).unwrap();
    let output = shearq(&check);
    assert_eq!(output.status.code(), Some(1));
    let moved: Vec<Value> = rows(&String::from_utf8(output.stdout).unwrap())
        .into_iter()
        .filter(|row| row["moved"] == "yes")
        .collect();
    assert_eq!(moved.len(), 1);
    assert_eq!(moved[0]["metric"], "q");
    let xml = fs::read_to_string(&junit).unwrap();
    let totals = "name=\"mine\" tests=\"2\" skipped=\"0\" errors=\"0\" failures=\"1\"";
    assert!(xml.contains(totals), "{xml}");
    assert!(xml.contains("deconvolution.lambda: 123.0 ≠"), "{xml}");
    assert!(!xml.contains("constant_step"), "{xml}");

    let mut update = check.to_vec();
    update.extend(["--update", "--reason", "λ as in the paper"]);
    succeed(&update);
    let updated = fs::read_to_string(&path).unwrap();
    assert!(
        updated.contains("reason = \"λ as in the paper\""),
        "{updated}"
    );
    succeed(&check);
    // Apart from its history it is what was recorded.
    let mut updated: toml::Table = updated.parse().unwrap();
    updated.remove("history").unwrap();
    // As text, in which what is unknown is like itself.
    let recorded: toml::Table = baseline.parse().unwrap();
    assert_eq!(updated.to_string(), recorded.to_string());

    // Other data of the same kind agree within noise, and say so.
    let data = at("data");
    succeed(&[
        "simulate",
        "--sets",
        "2",
        "--images",
        "3",
        "--grid",
        "12",
        "--seed",
        "1",
        "--out",
        text(&data),
    ]);
    let mut other = check.to_vec();
    other.extend(["--data", text(&data)]);
    let table: Value = serde_json::from_str(&succeed(&other)).unwrap();
    assert!(table["notes"].to_string().contains("not the baseline's"));
}

/// Two small runs on data of other seeds, and a folder for baselines.
fn two_runs(root: &Path) -> [std::path::PathBuf; 3] {
    let at = |name: &str| root.join(name);
    for (seed, out) in [("1", "one"), ("2", "two")] {
        run_simulated("2", "23/raw/star", &at(out), &["--seed", seed]);
    }
    [at("one"), at("two"), at("baselines")]
}

#[test]
fn of_two_that_record_one_baseline_one_fails() {
    let root = tempfile::tempdir().unwrap();
    let [one, two, folder] = two_runs(root.path());
    for _ in 0..5 {
        let _ = fs::remove_dir_all(&folder);
        let start = |measured: &Path| {
            std::process::Command::new(env!("CARGO_BIN_EXE_shearq"))
                .args(["baseline", "record", "mine", "--folder", text(&folder)])
                .args(["--measured", text(measured)])
                .stderr(std::process::Stdio::piped())
                .spawn()
                .unwrap()
        };
        let outputs = [start(&one), start(&two)].map(|child| child.wait_with_output().unwrap());
        let codes = outputs.each_ref().map(|output| output.status.code());
        assert!(
            codes == [Some(0), Some(1)] || codes == [Some(1), Some(0)],
            "{codes:?}"
        );
        let (won, lost) = if codes[0] == Some(0) { (0, 1) } else { (1, 0) };
        let said = String::from_utf8_lossy(&outputs[lost].stderr);
        assert!(said.contains("the baseline exists"), "{said}");
        let kept: toml::Table = fs::read_to_string(folder.join("mine.toml"))
            .unwrap()
            .parse()
            .unwrap();
        let seed = kept["source"]["simulated"]["seed"].as_integer();
        assert_eq!(seed, Some(won as i64 + 1));
    }
}

#[test]
fn settings_of_a_baseline_are_checked_like_any_others() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (own, out, folder) = (at("own.toml"), at("out"), at("baselines"));
    fs::write(&own, "extends = \"23/den/star\"\n").unwrap();
    run_simulated("2", text(&own), &out, &[]);
    succeed(&[
        "baseline",
        "record",
        "mine",
        "--folder",
        text(&folder),
        "--measured",
        text(&out),
    ]);
    let path = folder.join("mine.toml");
    let sound = fs::read_to_string(&path).unwrap();
    let check = ["baseline", "check", "--folder", text(&folder)];
    succeed(&check);
    for (section, key, value, expected) in [
        (
            "denoise",
            "levels",
            toml::Value::from(100_000_000),
            "`denoise.levels` is 100000000; expected 1 to 4",
        ),
        (
            "denoise",
            "strength",
            (-1.0).into(),
            "`denoise.strength` is -1.0; expected a positive number",
        ),
        (
            "denoise",
            "levles",
            2.into(),
            "there is no setting `denoise.levles`",
        ),
        ("shape", "acf_share", 2.0.into(), "`shape.acf_share` is 2"),
    ] {
        let mut edited: toml::Table = sound.parse().unwrap();
        let settings = &mut edited["submissions"][0]["settings"][section];
        settings.as_table_mut().unwrap().insert(key.into(), value);
        fs::write(&path, toml::to_string(&edited).unwrap()).unwrap();
        let message = fail(&check);
        assert!(
            message.contains("mine.toml") && message.contains(expected),
            "{message}"
        );
    }
    for (key, value, expected) in [
        (
            "grid",
            toml::Value::from(1_000_000),
            "1000000 galaxies a side; expected 8 to 400",
        ),
        ("intrinsic_sigma", f64::NAN.into(), "intrinsic_sigma is NaN"),
    ] {
        let mut edited: toml::Table = sound.parse().unwrap();
        let settings = edited["source"]["simulated"].as_table_mut().unwrap();
        settings.insert(key.into(), value);
        fs::write(&path, toml::to_string(&edited).unwrap()).unwrap();
        let message = fail(&check);
        assert!(
            message.contains("mine.toml") && message.contains(expected),
            "{message}"
        );
    }
    // What is kept with catalogues goes the same way.
    let record = out.join("run.json");
    let spoilt = fs::read_to_string(&record)
        .unwrap()
        .replace("\"levels\": ", "\"levels\": 90");
    fs::write(&record, spoilt).unwrap();
    let message = fail(&["score", "--measured", text(&out)]);
    assert!(
        message.contains("run.json") && message.contains("expected 1 to 4"),
        "{message}"
    );
}

#[test]
fn a_baseline_of_a_data_folder_has_the_images_asked_for() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (data, folder) = (at("data"), at("baselines"));
    let simulate = |images: &str| {
        let simulate = [
            "simulate", "--sets", "2,5", "--grid", "8", "--images", images,
        ];
        succeed(&[&simulate[..], &["--out", text(&data)]].concat());
    };
    simulate("3");
    let record = |name: &str, more: &[&str]| {
        let record = [
            "baseline",
            "record",
            name,
            "--folder",
            text(&folder),
            "--data",
            text(&data),
        ];
        succeed(&[&record[..], &["--submission", "23/raw/star"], more].concat());
        let text = fs::read_to_string(folder.join(format!("{name}.toml"))).unwrap();
        let baseline: toml::Table = text.parse().unwrap();
        let sets = baseline["submissions"][0]["sets"].as_array().unwrap();
        sets.iter()
            .map(|set| {
                (
                    set["set"].as_integer().unwrap(),
                    set["images"].as_array().unwrap().len(),
                )
            })
            .collect::<Vec<_>>()
    };
    assert_eq!(record("all", &[]), [(2, 3), (5, 3)]);
    assert_eq!(record("some", &["--images", "2", "--sets", "5"]), [(5, 2)]);
    // As many are measured again, whatever was added, wherever the command is given.
    simulate("4");
    let check = [
        "baseline",
        "check",
        "some",
        "--folder",
        text(&folder),
        "--format",
        "json",
    ];
    let table: Value = serde_json::from_str(&succeed(&check)).unwrap();
    assert!(
        !table["notes"].to_string().contains("not the baseline's"),
        "{table}"
    );
    assert!(
        table["rows"]
            .as_array()
            .unwrap()
            .iter()
            .all(|row| row["difference"] == 0.0)
    );
}

#[test]
fn a_check_reads_the_file_unless_it_uses_the_stored_settings() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (own, folder) = (at("own.toml"), at("baselines"));
    let write = |size: u32| {
        let text = format!("extends = \"23/raw/star\"\n[stamp]\nsize = {size}\n");
        fs::write(&own, text).unwrap();
    };
    write(23);
    let place = ["--folder", text(&folder)];
    let record = [
        "baseline",
        "record",
        "mine",
        "--simulate",
        "--sets",
        "2",
        "--images",
        "3",
        "--grid",
        "12",
        "--submission",
        text(&own),
    ];
    succeed(&[&record[..], &place].concat());
    let check = [&["baseline", "check", "--format", "json"], &place[..]].concat();
    succeed(&check);
    write(19);
    let output = shearq(&check);
    assert_eq!(output.status.code(), Some(1));
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.contains("stamp.size: 23 ≠ 19"), "{table}");
    let table: Value = serde_json::from_str(&table).unwrap();
    let rows = table["rows"].as_array().unwrap();
    assert!(rows.iter().any(|row| row["moved"] == "yes"), "{rows:?}");
    succeed(&[&check[..], &["--stored"]].concat());
    // An update takes the file's settings, and goes on reading it.
    succeed(&[&check[..], &["--update", "--reason", "smaller"]].concat());
    succeed(&check);
    fs::remove_file(&own).unwrap();
    let message = fail(&check);
    assert!(
        message.contains("own.toml: cannot find the configuration file of the baseline")
            && message.contains("--stored"),
        "{message}"
    );
    succeed(&[&check[..], &["--stored"]].concat());
}

#[test]
fn messages_of_a_check_name_the_data_as_they_were_given() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let (data, folder) = (at("data"), at("baselines"));
    let simulate = [
        "simulate", "--sets", "2", "--grid", "8", "--images", "2", "--out",
    ];
    succeed(&[&simulate[..], &[text(&data)]].concat());
    let place = ["--folder", text(&folder), "--data", text(&data)];
    let record = ["baseline", "record", "mine", "--submission", "23/raw/star"];
    succeed(&[&record[..], &place].concat());
    let image = data.join("set02/galaxies-002.fits");
    let whole = fs::read(&image).unwrap();
    fs::write(&image, &whole[..whole.len() / 2]).unwrap();
    let message = fail(&[&["baseline", "check", "mine"], &place[..]].concat());
    assert!(message.contains(text(&image)), "{message}");
    assert!(
        !message.contains(".part") && !message.contains(".."),
        "{message}"
    );
}
