//! The chain through the binary on small simulated data.

use std::fs;
use std::path::Path;

use serde_json::Value;
use shearq_render::table::Cell;

use crate::support::{contents, fail, succeed, text};

fn simulate(folder: &Path, sets: &str, images: &str, threads: &str) {
    succeed(&[
        "simulate",
        "--sets",
        sets,
        "--images",
        images,
        "--grid",
        "12",
        "--seed",
        "5",
        "--threads",
        threads,
        "--out",
        text(folder),
    ]);
}

#[test]
fn results_are_the_same_bytes_for_any_threads_and_when_resumed() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    simulate(&at("one"), "1,2,19", "2", "1");
    simulate(&at("three"), "1,2,19", "2", "3");
    assert_eq!(contents(&at("one")), contents(&at("three")));
    for format in ["fits", "parquet"] {
        let measure = |out: &str, threads: &str| {
            succeed(&[
                "measure",
                "--submission",
                "23/den/func",
                "--data",
                text(&at("one")),
                "--out",
                text(&at(out)),
                "--threads",
                threads,
                "--catalogue-format",
                format,
            ]);
        };
        let (a, b) = (format!("a-{format}"), format!("b-{format}"));
        measure(&a, "1");
        measure(&b, "3");
        let expected = contents(&at(&a));
        // Two catalogues of each of three sets, and the record.
        assert_eq!(expected.len(), 7);
        assert_eq!(expected, contents(&at(&b)));
        fs::remove_file(at(&b).join(format!("set02/catalogue-001.{format}"))).unwrap();
        fs::write(
            at(&b).join(format!(
                "set19/.catalogue-001.{format}.0123456789abcdef.part"
            )),
            "half",
        )
        .unwrap();
        fs::remove_file(at(&b).join(format!("set19/catalogue-001.{format}"))).unwrap();
        measure(&b, "2");
        assert_eq!(expected, contents(&at(&b)));
    }
}

#[test]
fn the_chain_ends_in_scores_that_every_format_carries() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    simulate(&at("data"), "8", "8", "2");
    let own = at("own.toml");
    fs::write(&own, "extends = \"23/raw/star\"\n[stamp]\nsize = 21\n").unwrap();
    for (submission, out) in [("23/raw/star", "raw"), (text(&own), "own")] {
        succeed(&[
            "measure",
            "--submission",
            submission,
            "--data",
            text(&at("data")),
            "--out",
            text(&at(out)),
        ]);
    }
    let score = |format: &str| {
        succeed(&[
            "score",
            "--data",
            text(&at("data")),
            "--measured",
            text(&at("raw")),
            "--format",
            format,
        ])
    };
    let json: Value = serde_json::from_str(&score("json")).unwrap();
    let row = &json["rows"][0];
    let q = row["q"].as_f64().unwrap();
    assert!(q > 0.0 && row["q_error"].as_f64().unwrap() > 0.0);
    assert_eq!(row["set"], "08");
    assert_eq!(row["images"], 8.0);
    assert!(
        score("csv")
            .lines()
            .nth(1)
            .unwrap()
            .contains(&q.to_string())
    );
    let shown = Cell::with_error(q, row["q_error"].as_f64(), 2);
    let (shown, _) = shown.digits().unwrap();
    for format in ["table", "markdown", "latex"] {
        assert!(score(format).contains(&shown), "{format}: {shown}");
    }
    let compared = succeed(&[
        "compare",
        text(&at("raw")),
        text(&at("own")),
        "--format",
        "json",
    ]);
    let compared: Value = serde_json::from_str(&compared).unwrap();
    assert_eq!(compared["rows"][0]["q_published"], 80.33);
    assert_eq!(compared["rows"][1]["submission"], "own");
    assert!(compared["rows"][1]["q_published"].is_null());
    assert!(compared["rows"][1]["sigma"].is_number());
    let picture = at("figure.png");
    for (submission, responds) in [("23/raw/star", false), ("48/linear/star", true)] {
        let shown = succeed(&[
            "show",
            "--submission",
            submission,
            "--data",
            text(&at("data")),
            "--galaxy",
            "8/1/14",
            "--out",
            text(&picture),
        ]);
        assert!(fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
        assert_eq!(shown.contains(", response 0."), responds, "{shown}");
    }
}

#[test]
fn submissions_can_be_listed_shown_and_started() {
    let root = tempfile::tempdir().unwrap();
    let own = root.path().join("own.toml");
    assert!(succeed(&["submissions", "list"]).contains("29/den/func"));
    let shown = succeed(&["submissions", "show", "23/den/star"]);
    assert!(shown.contains("q = 87.06") && shown.contains("method = \"wavelet-wiener\""));
    succeed(&["submissions", "init", text(&own), "--method", "network"]);
    let settings = |text: &str| text.split_once("[stamp]").unwrap().1.to_owned();
    let base = shearq_submissions::Registry::embedded()
        .unwrap()
        .get("paper")
        .unwrap();
    let started = settings(&succeed(&["submissions", "show", text(&own)]));
    let base = settings(&toml::to_string(&base.configuration).unwrap());
    assert_eq!(started, base);
    assert!(fail(&["submissions", "init", text(&own)]).contains("exists"));
    let linear = root.path().join("linear.toml");
    succeed(&["submissions", "init", text(&linear)]);
    let started = settings(&succeed(&["submissions", "show", text(&linear)]));
    assert!(started.contains("target_sigma = 1.5") && !started.contains("unit_divisor"));
    let named = settings(&succeed(&["submissions", "show", "48/linear/star"]));
    assert_eq!(started, named);
    let message = fail(&["submissions", "show", "23/raw/stars"]);
    assert!(
        message.contains("known configurations: subm/19/den/star"),
        "{message}"
    );
}
