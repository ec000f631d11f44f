//! Baselines: the project's own, and what a moved digit looks like.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::support::{fail, run_simulated, shearq, succeed, text};

#[test]
fn the_named_submissions_have_not_moved_from_the_projects_baselines() {
    let folder = Path::new("submissions/baselines");
    for name in ["named", "linear"] {
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
fn a_changed_digit_and_a_changed_setting_are_seen_and_an_update_keeps_the_reason() {
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
    let q = &mut first["sets"][0]["figures"]["q"][0];
    *q = toml::Value::Float(q.as_float().unwrap() * 1.01);
    first["settings"]["deconvolution"]["lambda"] = toml::Value::Float(123.0);
    // As if this setting had come later: others than named submissions take the base's value.
    let second = edited["submissions"][1]["settings"]["denoise"].as_table_mut();
    second.unwrap().remove("window").unwrap();
    fs::write(&path, toml::to_string(&edited).unwrap()).unwrap();
    let output = shearq(&check);
    assert_eq!(output.status.code(), Some(1));
    let moved: Vec<Value> = rows(&String::from_utf8(output.stdout).unwrap())
        .into_iter()
        .filter(|row| row["moved"] == "yes")
        .collect();
    assert_eq!(moved.len(), 1);
    assert_eq!(moved[0]["figure"], "q");
    let xml = fs::read_to_string(&junit).unwrap();
    assert!(xml.contains("tests=\"2\" failures=\"1\""), "{xml}");
    assert!(xml.contains("deconvolution.lambda: 123.0 ≠"), "{xml}");
    assert!(!xml.contains("window"), "{xml}");

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
    assert_eq!(updated, baseline.parse::<toml::Table>().unwrap());

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
