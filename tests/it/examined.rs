//! What `score` and `compare` say of catalogues before anybody believes their figures.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::support::{fail, run_simulated, shearq, succeed, text};

/// Cells a side of the grid.
const SIDE: usize = 16;

/// A table of x, y and two values, from the cell's number.
fn table(path: &Path, names: &str, value: impl Fn(usize) -> Option<(f64, f64)>) {
    let mut content = format!("x,y,{names}\n");
    for k in 0..SIDE * SIDE {
        if let Some((a, b)) = value(k) {
            let (x, y) = (
                24.5 + 48.0 * (k % SIDE) as f64,
                24.5 + 48.0 * (k / SIDE) as f64,
            );
            writeln!(content, "{x},{y},{a},{b}").unwrap();
        }
    }
    std::fs::write(path, content).unwrap();
}

/// A shear of some waves, so that conventions can be told.
fn shear(k: usize) -> (f64, f64) {
    let (x, y) = ((k % SIDE) as f64, (k / SIDE) as f64);
    let angle = |a: f64, b: f64| 2.0 * std::f64::consts::PI * (a * x + b * y) / SIDE as f64;
    // E modes: along x, along y and along the diagonal.
    let (first, second, third) = (
        angle(3.0, 0.0).sin(),
        angle(0.0, 4.0).cos(),
        angle(2.0, 2.0).sin(),
    );
    (0.03 * first - 0.02 * second, 0.04 * third)
}

/// A folder with `truth.csv` of that shear and a catalogue `e.csv`; their paths.
fn case(folder: &Path, e: impl Fn(usize) -> Option<(f64, f64)>) -> (PathBuf, PathBuf) {
    let (truth, catalogue) = (folder.join("truth.csv"), folder.join("e.csv"));
    table(&truth, "g1,g2", |k| Some(shear(k)));
    table(&catalogue, "e1,e2", e);
    (truth, catalogue)
}

/// Arguments that score the case.
fn scoring<'a>(files: &'a (PathBuf, PathBuf), more: &[&'a str]) -> Vec<&'a str> {
    let mut arguments = vec![
        "score",
        "--truth-sign",
        "standard",
        "--truth",
        text(&files.0),
    ];
    arguments.push(text(&files.1));
    arguments.extend(more);
    arguments
}

fn json(files: &(PathBuf, PathBuf), more: &[&str]) -> Value {
    let mut all = vec!["--format", "json"];
    all.extend(more);
    serde_json::from_str(&succeed(&scoring(files, &all))).unwrap()
}

fn has(object: &Value, words: &str) -> bool {
    let lines = object["warnings"].as_array().unwrap();
    lines
        .iter()
        .any(|line| line.as_str().unwrap().contains(words))
}

#[test]
fn values_that_stand_for_none_are_asked_about() {
    let folder = tempfile::tempdir().unwrap();
    for sentinel in [-99.0, 99.0, -999.0, -9.0, 1e30] {
        let files = case(folder.path(), |k| {
            Some(if k < 20 {
                (sentinel, sentinel)
            } else {
                shear(k)
            })
        });
        let message = fail(&scoring(&files, &[]));
        let printed = if sentinel == 1e30 {
            "1e30".into()
        } else {
            sentinel.to_string()
        };
        for words in ["e.csv", "20 rows", "row 1 ", &printed] {
            assert!(message.contains(words), "{words}: {message}");
        }
        let missing = sentinel.to_string();
        let named = json(&files, &["--missing", &missing]);
        assert_eq!(named["rows"]["not_finite"], 20);
        assert!(has(&named, "20 of 256 galaxies"));
        let cut = json(&files, &["--max-modulus", "1"]);
        assert_eq!(cut["metrics"], named["metrics"]);
    }
}

#[test]
fn positions_in_cells_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let files = case(folder.path(), |k| Some(shear(k)));
    let mut content = "x,y,e1,e2\n".to_owned();
    for k in 0..SIDE * SIDE {
        writeln!(content, "{},{},0.01,0.02", k % SIDE + 1, k / SIDE + 1).unwrap();
    }
    std::fs::write(&files.1, content).unwrap();
    let message = fail(&scoring(&files, &[]));
    assert!(
        message.contains("e.csv") && message.contains("255 of 256 rows"),
        "{message}"
    );
    assert!(message.contains("positions in pixels"), "{message}");
}

#[test]
fn what_is_odd_is_said_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let half = case(folder.path(), |k| (k % 2 == 0).then(|| shear(k)));
    assert!(has(
        &json(&half, &[]),
        "128 of 256 galaxies of this set are not in the catalogues"
    ));
    let large = case(folder.path(), |k| {
        Some(if k < 3 { (1.2, 0.3) } else { shear(k) })
    });
    assert!(has(&json(&large, &[]), "3 rows of this set with |e| > 1"));
    // CSV has no room for notes: they go to standard error.
    let output = shearq(&scoring(&large, &["--format", "csv"]));
    let (out, err) = (output.stdout, String::from_utf8(output.stderr).unwrap());
    assert!(err.contains("3 rows of this set with |e| > 1"), "{err}");
    assert!(!String::from_utf8(out).unwrap().contains("|e|"));
}

#[test]
fn a_constant_shear_gives_means_and_no_power() {
    let folder = tempfile::tempdir().unwrap();
    let (truth, catalogue) = (folder.path().join("t.csv"), folder.path().join("e.csv"));
    table(&truth, "g1,g2", |_| Some((0.03, -0.02)));
    // Uniform numbers of ± 0.05, from a multiplicative hash.
    let shape = |k: u64| {
        let mixed = (k + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let mixed = (mixed ^ (mixed >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        0.1 * ((mixed >> 11) as f64 / (1u64 << 53) as f64 - 0.5)
    };
    let e = |k: usize| (0.031 + shape(k as u64), -0.018 + shape(k as u64 + 1000));
    table(&catalogue, "e1,e2", |k| Some(e(k)));
    let mean = (0..SIDE * SIDE).map(|k| e(k).0).sum::<f64>() / (SIDE * SIDE) as f64;
    let files = (truth, catalogue);
    let printed = succeed(&scoring(&files, &[]));
    assert!(printed.contains(&format!("{mean:.5} ±")), "{printed}");
    assert!(
        !printed.contains("M/2") && !printed.contains("--truth-sign"),
        "{printed}"
    );
    let found = json(&files, &[]);
    assert!(found["metrics"]["q"].is_null() && found["metrics"]["m_half"].is_null());
    let c = found["metrics"]["c1"].as_f64().unwrap();
    assert!((c - (mean - 0.03)).abs() < 1e-12, "{c}");
    // Of 256 numbers evenly spread over 0.1: 0.1/√12/16. It is told by the lowest modes, some 100.
    let error = found["mean_shear"]["error"][0].as_f64().unwrap();
    assert!((error / 0.0018 - 1.0).abs() < 0.4, "{error}");
}

#[test]
fn every_key_of_the_json_is_described() {
    let folder = tempfile::tempdir().unwrap();
    let found = json(
        &case(folder.path(), |k| Some(shear(k))),
        &["--noise-var", "0.01"],
    );
    let docs = std::fs::read_to_string("docs/files-challenge.md").unwrap();
    let docs = &docs[docs.find("## JSON of one set").unwrap()..];
    fn keys(value: &Value, found: &mut Vec<String>) {
        for (key, value) in value.as_object().into_iter().flatten() {
            found.push(key.clone());
            keys(value, found);
        }
    }
    let mut all = Vec::new();
    keys(&found, &mut all);
    assert!(all.len() > 60);
    for key in all.iter().filter(|key| key.parse::<u8>().is_err()) {
        let word = |c: char| !c.is_alphanumeric() && c != '_';
        assert!(docs.split(word).any(|w| w == key), "{key} is not described");
    }
}

/// Catalogues of another program made of ours, each ellipticity changed.
fn foreign(folder: &Path, ours: &Path, change: impl Fn(usize, f64, f64) -> (f64, f64)) -> PathBuf {
    let packed = folder.join("packed");
    let pack = [
        "pack",
        "--method",
        "M",
        "--measured",
        text(ours),
        "--out",
        text(&packed),
    ];
    succeed(&pack);
    for image in 1..=3 {
        let source = packed.join(format!("g10_v1_objs_8_{image}.M.dat"));
        let mut content = "x,y,e1,e2\n".to_owned();
        for (k, line) in std::fs::read_to_string(source).unwrap().lines().enumerate() {
            let row: Vec<f64> = line.split(' ').map(|v| v.parse().unwrap()).collect();
            let (e1, e2) = change(1000 * image + k, row[2], row[3]);
            writeln!(content, "{},{},{e1},{e2}", row[0], row[1]).unwrap();
        }
        std::fs::write(folder.join(format!("other-{image:03}.csv")), content).unwrap();
    }
    std::fs::remove_dir_all(packed).unwrap();
    let description = folder.join("other.toml");
    std::fs::write(
        &description,
        "name = \"other\"\ncatalogues = \"other-{image:03}.csv\"\nellipticity = \"shear\"\n",
    )
    .unwrap();
    description
}

#[test]
fn submissions_are_compared_in_conventions_that_are_known_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let (raw, small) = (folder.path().join("raw"), folder.path().join("small"));
    // Ten times the shear, so that three small images tell the convention; and a tenth of it.
    for (out, amplitude) in [(&raw, "100"), (&small, "0.01")] {
        run_simulated("8", "48/linear/star", out, &["--amplitude", amplitude]);
    }
    let compare = |ours: &Path, other: &Path| -> Value {
        let arguments = [
            "compare",
            "--format",
            "json",
            "--foreign",
            text(other),
            text(ours),
        ];
        serde_json::from_str(&succeed(&arguments)).unwrap()
    };
    let notes = |found: &Value| found["notes"].to_string();
    // The same with e2 flipped: matched, and no different.
    let data = folder.path().join("raw");
    let same = compare(&raw, &foreign(folder.path(), &data, |_, e1, e2| (e1, -e2)));
    assert!(
        notes(&same).contains("Convention 6 (e2 flipped), matched"),
        "{same}"
    );
    // Packed catalogues have nine decimals.
    assert!(
        same["rows"][1]["q_difference"].as_f64().unwrap().abs() < 1e-6,
        "{same}"
    );
    // Noise: the data do not tell, and nothing is said of a difference.
    let noise = |k: usize| ((k * 2_654_435_761) % 1000) as f64 / 1000.0 - 0.5;
    let other = foreign(folder.path(), &small, |k, _, _| (noise(k), noise(k + 77)));
    let unknown = compare(&small, &other);
    assert!(
        notes(&unknown).contains("cannot determine the sign and axis convention"),
        "{unknown}"
    );
    assert!(unknown["rows"][1]["sigma"].is_null(), "{unknown}");
    // Ours is in the standard convention whatever its noise says.
    let ours = |more: &[&str]| {
        let mut arguments = vec!["compare", "--format", "json"];
        arguments.extend(more);
        arguments.extend([text(&small), text(&small)]);
        succeed(&arguments)
    };
    assert_eq!(ours(&[]), ours(&["--convention", "5"]));
}

#[test]
fn cross_spectra_are_scored_with_the_errors_of_their_manifest() {
    let folder = tempfile::tempdir().unwrap();
    let (out, sent) = (folder.path().join("out"), folder.path().join("sent"));
    let arguments = [
        "run",
        "--simulate",
        "--sets",
        "2,5",
        "--images",
        "20",
        "--grid",
        "12",
        "--submission",
        "48/linear/star",
        "--out",
        text(&out),
    ];
    succeed(&arguments);
    let pack = [
        "pack",
        "--kind",
        "cross-spectra",
        "--method",
        "M",
        "--measured",
        text(&out),
    ];
    succeed(&[&pack[..], &["--out", text(&sent)]].concat());
    let score = [
        "score",
        "--format",
        "json",
        "--data",
        text(&out),
        "--spectra",
        text(&sent),
    ];
    let found = shearq(&score);
    let found: Value = serde_json::from_slice(&found.stdout).unwrap();
    for row in found["rows"].as_array().unwrap() {
        assert!(row["q_error"].as_f64().unwrap() > 0.0, "{row}");
    }
}
