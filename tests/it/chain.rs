//! The chain through the binary on small simulated data, and what it says of bad input.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::support::{contents, fail, shearq, succeed, text};

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
fn results_are_the_same_bytes_for_any_number_of_threads_and_after_a_resumed_run() {
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
        assert_eq!(expected.len(), 7);
        assert_eq!(expected, contents(&at(&b)));
        fs::remove_file(at(&b).join(format!("set02/catalogue-001.{format}"))).unwrap();
        fs::write(
            at(&b).join(format!("set19/.catalogue-001.{format}.part")),
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
    simulate(&at("data"), "8", "4", "2");
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
    assert_eq!(row["images"], 4.0);
    assert!(
        score("csv")
            .lines()
            .nth(1)
            .unwrap()
            .contains(&q.to_string())
    );
    for format in ["table", "markdown", "latex"] {
        assert!(score(format).contains(&format!("{q:.2}")), "{format}");
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
    succeed(&[
        "show",
        "--submission",
        "23/raw/star",
        "--data",
        text(&at("data")),
        "--galaxy",
        "8/1/14",
        "--out",
        text(&picture),
    ]);
    assert!(fs::read(picture).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn other_settings_in_the_same_folder_are_refused_with_the_difference() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    simulate(&at("data"), "2", "1", "1");
    let measure = |submission| {
        vec![
            "measure".to_owned(),
            "--submission".into(),
            submission,
            "--data".into(),
            text(&at("data")).into(),
            "--out".into(),
            text(&at("out")).into(),
        ]
    };
    let first = measure("23/raw/star".to_owned());
    succeed(&first.iter().map(String::as_str).collect::<Vec<_>>());
    let second = measure("23/raw/func".to_owned());
    let message = fail(&second.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(
        message.contains("submission.psf.form: \"star\" ≠ \"functional\""),
        "{message}"
    );
    let message = fail(&[
        "simulate",
        "--sets",
        "2",
        "--images",
        "2",
        "--grid",
        "12",
        "--seed",
        "6",
        "--out",
        text(&at("data")),
    ]);
    assert!(message.contains("settings.seed: 5 ≠ 6"), "{message}");
}

#[test]
fn bad_input_gets_one_error_that_names_file_and_fault() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    simulate(&at("data"), "2", "2", "1");
    let measure = |data: &Path| {
        fail(&[
            "measure",
            "--submission",
            "23/raw/star",
            "--data",
            text(data),
            "--out",
            text(&at("never")),
        ])
    };
    assert!(measure(&at("absent")).contains("there is no such folder"));
    let image = at("data").join("set02/galaxies-002.fits");
    let whole = fs::read(&image).unwrap();
    let spoil = |bytes: &[u8], expected: &str| {
        fs::write(&image, bytes).unwrap();
        let message = measure(&at("data"));
        assert!(message.contains("galaxies-002.fits"), "{message}");
        assert!(message.contains(expected), "{message}");
        // The first image is kept.
        assert!(at("never").join("set02").read_dir().unwrap().count() <= 1);
    };
    spoil(&whole[..whole.len() / 2], "cannot read rows");
    spoil(b"", "empty");
    spoil(b"This is not an image.", "cannot open the image");
    let mut wide = whole.clone();
    let at_key = wide.windows(6).position(|w| w == b"NAXIS1").unwrap();
    wide[at_key + 10..at_key + 30].copy_from_slice(b"          4000000000");
    spoil(&wide, "4000000000");
    fs::write(&image, &whole).unwrap();
    let star = at("data").join("set02/psf-001.fits");
    let mut zero = fs::read(&star).unwrap();
    zero[2880..].fill(0);
    fs::write(&star, zero).unwrap();
    fs::remove_dir_all(at("never")).unwrap();
    let message = measure(&at("data"));
    assert!(
        message.contains("psf-001.fits") && message.contains("sum to 0"),
        "{message}"
    );
    fs::remove_file(&star).unwrap();
    assert!(measure(&at("data")).contains("psf-001.fits"));
    let truth = at("data").join("set02/truth.csv");
    let bad = at("bad.csv");
    fs::write(&bad, "x,y,e1,e2\n24.5,24.5,0.1,zero\n").unwrap();
    let message = fail(&["score", "--truth", text(&truth), text(&bad)]);
    assert!(
        message.contains("bad.csv") && message.contains("line 2"),
        "{message}"
    );
    let usage = shearq(&["measure", "--submission", "23/raw/star"]);
    assert_eq!(usage.status.code(), Some(2));
}

#[test]
fn damaged_pixels_are_flagged_and_the_rest_is_measured() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    simulate(&at("data"), "2", "1", "1");
    let image = at("data").join("set02/galaxies-001.fits");
    let mut bytes = fs::read(&image).unwrap();
    let start = bytes.len() - bytes.len() % 2880;
    // The first pixel of the first stamp lies right after the header.
    let header = bytes[..start]
        .chunks(2880)
        .position(|block| block.windows(8).any(|w| w == b"END     "))
        .unwrap();
    let pixel = (header + 1) * 2880;
    bytes[pixel..pixel + 4].copy_from_slice(&f32::NAN.to_be_bytes());
    fs::write(&image, bytes).unwrap();
    succeed(&[
        "measure",
        "--submission",
        "23/raw/star",
        "--data",
        text(&at("data")),
        "--out",
        text(&at("out")),
        "--catalogue-format",
        "fits",
    ]);
    let path = at("out").join("set02/catalogue-001.fits");
    let mut table = shearq::io::table::read(&path, None).unwrap();
    let (flags, e1) = (
        table.take_real("flag").unwrap(),
        table.take_real("e1").unwrap(),
    );
    assert_eq!(flags.iter().filter(|f| **f != 0.0).count(), 1);
    assert_eq!(flags[0], 1.0);
    assert!(e1[0].is_nan() && e1[1..].iter().all(|e| e.is_finite()));
    let out = succeed(&[
        "score",
        "--data",
        text(&at("data")),
        "--measured",
        text(&at("out")),
    ]);
    assert!(out.contains("1 of 144 galaxies"), "{out}");
}

#[test]
fn submissions_can_be_listed_shown_and_started() {
    let root = tempfile::tempdir().unwrap();
    let own = root.path().join("own.toml");
    assert!(succeed(&["submissions", "list"]).contains("29/den/func"));
    let shown = succeed(&["submissions", "show", "23/den/star"]);
    assert!(shown.contains("q = 87.06") && shown.contains("method = \"wavelet-wiener\""));
    succeed(&["submissions", "init", text(&own)]);
    let settings = |text: &str| text.split_once("[stamp]").unwrap().1.to_owned();
    let base = shearq_submissions::Registry::embedded()
        .unwrap()
        .get("paper")
        .unwrap();
    let started = settings(&succeed(&["submissions", "show", text(&own)]));
    let base = settings(&toml::to_string(&base.submission).unwrap());
    assert_eq!(started, base);
    assert!(fail(&["submissions", "init", text(&own)]).contains("exists"));
    let message = fail(&["submissions", "show", "23/raw/stars"]);
    assert!(
        message.contains("known submissions: subm/19/den/star"),
        "{message}"
    );
}
