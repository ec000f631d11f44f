//! Runs recorded in a results store, and compared.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::support::{fail, run_simulated, succeed, text};

/// Two small runs on the same simulated data, in folders and in a store.
struct Recorded {
    root: tempfile::TempDir,
}

const SUBMISSIONS: [(&str, &str); 2] = [("23/raw/star", "raw"), ("23/raw/func", "func")];

impl Recorded {
    fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        let recorded = Recorded { root };
        for (submission, out) in SUBMISSIONS {
            let store = recorded.at("store");
            let out = recorded.at(out);
            run_simulated("2,5", submission, &out, &["--store", text(&store)]);
        }
        recorded
    }

    fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// `score` of some sets of a folder into a store.
    fn score(&self, out: &str, sets: &str, store: &str) {
        succeed(&[
            "score",
            "--measured",
            text(&self.at(out)),
            "--sets",
            sets,
            "--store",
            text(&self.at(store)),
        ]);
    }

    /// Rows of `compare --store` with more arguments.
    fn compare(&self, store: &str, more: &[&str]) -> Vec<Value> {
        let store = self.at(store);
        let mut arguments = vec!["compare", "--store", text(&store), "--format", "json"];
        arguments.extend(more);
        let table: Value = serde_json::from_str(&succeed(&arguments)).unwrap();
        table["rows"].as_array().unwrap().clone()
    }
}

fn files(store: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    if !store.exists() {
        return Vec::new();
    }
    let mut files: Vec<_> = fs::read_dir(store)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| (path.clone(), fs::read(path).unwrap()))
        .collect();
    files.sort();
    files
}

#[test]
fn a_store_gives_the_figures_of_the_folders() {
    let recorded = Recorded::new();
    let before = files(&recorded.at("store"));
    assert_eq!(before.len(), 2);
    for (_, out) in SUBMISSIONS {
        recorded.score(out, "2,5", "store");
    }
    assert_eq!(files(&recorded.at("store")), before);
    let folders = succeed(&[
        "compare",
        text(&recorded.at("func")),
        text(&recorded.at("raw")),
        "--format",
        "json",
    ]);
    let folders: Value = serde_json::from_str(&folders).unwrap();
    // Recorded set by set, as shards do, and in one go: one run either way.
    for (_, out) in SUBMISSIONS {
        recorded.score(out, "5", "parts");
        recorded.score(out, "2", "parts");
    }
    assert_eq!(files(&recorded.at("parts")).len(), 4);
    for store in ["store", "parts"] {
        let rows = recorded.compare(store, &["--sort", "submission"]);
        assert_eq!(rows.len(), 2);
        for (k, row) in rows.iter().enumerate() {
            assert_eq!(row["sets"], "2,5");
            for key in [
                "submission",
                "q",
                "q_error",
                "q_difference",
                "q_difference_error",
                "sigma",
                "q_calibrated_difference",
                "q_calibrated_sigma",
                "m_half",
            ] {
                assert_eq!(row[key], folders["rows"][k][key], "{store} {k} {key}");
            }
        }
    }
}

#[test]
fn what_was_changed_since_it_was_recorded_is_refused() {
    let recorded = Recorded::new();
    let store = recorded.at("store");
    let [one, other] = files(&store).try_into().unwrap();
    fs::write(&one.0, &other.1).unwrap();
    let message = fail(&["compare", "--store", text(&store)]);
    assert!(message.contains(text(&one.0)), "{message}");
    assert!(
        message.contains("changed after it was recorded"),
        "{message}"
    );
    // Under a name of one's own it is what it is.
    fs::remove_file(&one.0).unwrap();
    fs::rename(&other.0, store.join("mine.parquet")).unwrap();
    assert_eq!(recorded.compare("store", &[]).len(), 1);
}

#[test]
fn runs_are_chosen_sorted_and_grouped() {
    let recorded = Recorded::new();
    let q = |row: &Value| row["q"].as_f64().unwrap();
    let up = recorded.compare("store", &["--sort", "q"]);
    let down = recorded.compare("store", &["--sort", "q:desc"]);
    assert!(q(&up[0]) <= q(&up[1]) && q(&up[0]) == q(&down[1]));
    assert!(up[0]["q_difference"].is_null() && up[1]["q_difference"].is_number());
    let chosen = recorded.compare(
        "store",
        &["--where", "snr == 'low' and submission == '*/star'"],
    );
    assert_eq!(chosen.len(), 1);
    assert_eq!(chosen[0]["sets"], "5");
    assert_eq!(chosen[0]["submission"], "23/raw/star");
    let grouped = recorded.compare("store", &["--group-by", "snr"]);
    let groups: Vec<&str> = grouped.iter().map(|r| r["snr"].as_str().unwrap()).collect();
    assert_eq!(groups, ["fiducial", "fiducial", "low", "low"]);
    assert!(grouped[1]["q_difference"].is_number() && grouped[2]["q_difference"].is_null());
    // Three images tell no error.
    assert!(grouped[1]["sigma"].is_null());
    let store = recorded.at("store");
    let mut query = vec!["compare", "--store", text(&store), "--where"];
    query.push("colour == 'red'");
    let message = fail(&query);
    assert!(message.contains("found `colour`") && message.contains("set_kind"));
    query[3] = "--where=q > 300000";
    query.pop();
    assert!(fail(&query).contains("meets the conditions"));
    let picture = recorded.at("map.png");
    let plain = succeed(&[
        "compare",
        "--store",
        text(&store),
        "--heat-map",
        text(&picture),
    ]);
    assert!(fs::read(picture).unwrap().starts_with(b"\x89PNG"));
    // Not a terminal: the table alone, without colours.
    assert!(plain.contains("23/raw/func") && !plain.contains('\x1b'));
}

#[test]
fn what_is_no_file_of_a_store_is_refused_by_name() {
    let recorded = Recorded::new();
    let store = recorded.at("store");
    let catalogue = recorded.at("raw").join("set02/catalogue-001.parquet");
    fs::copy(&catalogue, store.join("stray.parquet")).unwrap();
    let compare = || fail(&["compare", "--store", text(&store)]);
    let message = compare();
    assert!(
        message.contains("stray.parquet") && message.contains("results store"),
        "{message}"
    );
    fs::write(store.join("stray.parquet"), b"PAR1").unwrap();
    assert!(compare().contains("stray.parquet"));
    let message = fail(&["compare", "--store", text(&recorded.at("none"))]);
    assert!(
        message.contains("cannot read the results store"),
        "{message}"
    );
    fs::create_dir(recorded.at("empty")).unwrap();
    let message = fail(&["compare", "--store", text(&recorded.at("empty"))]);
    assert!(message.contains("found no recorded run"), "{message}");
}

#[test]
fn metrics_are_chosen_and_unknown_ones_refused() {
    let recorded = Recorded::new();
    let store = recorded.at("store");
    let grouped = ["compare", "--store", text(&store), "--group-by", "set"];
    let table = succeed(&[&grouped[..], &["--metrics", "q,q", "--format", "csv"]].concat());
    let mut lines = table.lines();
    assert_eq!(lines.next(), Some("submission,run,set,sets,q,q_error"));
    assert_eq!(lines.count(), 4);
    let (raw, new) = (recorded.at("raw"), recorded.at("new"));
    let score = ["score", "--measured", text(&raw), "--store", text(&new)];
    let message = fail(&[&score[..], &["--metrics", "q,nope"]].concat());
    assert!(
        message.contains("found \"nope\", expected some of"),
        "{message}"
    );
    assert!(message.contains("q_dn"), "{message}");
    assert!(files(&new).is_empty());
}

#[test]
fn numbers_that_no_catalogues_have_are_refused() {
    use shearq_files::frames::polars::Column;

    let recorded = Recorded::new();
    let path = files(&recorded.at("store"))[0].0.clone();
    let metadata = shearq_files::parquet::metadata(&path).unwrap();
    for (column, most) in [
        ("images", "at most 3"),
        ("galaxies", "at most"),
        ("flagged", "at most"),
    ] {
        let mut table = shearq_files::parquet::read(&path, None, 1_000).unwrap();
        let values = vec![1_i64 << 62; table.height()];
        table
            .with_column(Column::new(column.into(), values))
            .unwrap();
        let other = recorded.at("other");
        let _ = fs::remove_dir_all(&other);
        fs::create_dir(&other).unwrap();
        let file = fs::File::create(other.join("edited.parquet")).unwrap();
        shearq_files::parquet::write(file, &table, &metadata).unwrap();
        let message = fail(&["compare", "--store", text(&other)]);
        let expected = format!("row 1: column `{column}` is 4611686018427387904; expected {most}");
        assert!(message.contains(&expected), "{message}");
    }
}
