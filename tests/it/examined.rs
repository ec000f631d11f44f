//! What `score` and `compare` say of catalogues before anybody believes their figures.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::support::{run_simulated, shearq, succeed, text};

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
fn catalogues_are_compared_only_in_known_conventions() {
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
