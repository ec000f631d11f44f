//! What a terminal of eighty columns shows, and the pages written beside it.

use std::fs;

use unicode_width::UnicodeWidthStr;

use crate::support::{run_simulated, shearq, succeed, text};

/// Printed where no terminal tells its width: eighty columns.
fn assert_narrow(arguments: &[&str]) -> String {
    let printed = succeed(arguments);
    for line in printed.lines() {
        let width = line.width();
        // A name or a path stands whole.
        let words = line.split_whitespace().count();
        assert!(
            width <= 80 || words == 1,
            "{arguments:?}: {width} columns: {line}"
        );
    }
    printed
}

#[test]
fn tables_fit_eighty_columns_and_wide_ones_are_asked_for() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    for (submission, out) in [("23/den/star", "den"), ("48/linear/star", "linear")] {
        run_simulated(
            "2,8",
            submission,
            &at(out),
            &["--store", text(&at("store"))],
        );
    }
    let (den, linear, store) = (at("den"), at("linear"), at("store"));
    let scored = assert_narrow(&["score", "--measured", text(&den)]);
    assert!(scored.contains("More with --wide:") && scored.contains("Fiducial"));
    for arguments in [
        &["compare", text(&den), text(&linear)][..],
        &["compare", "--store", text(&store)],
        &["compare", "--store", text(&store), "--group-by", "snr"],
        &["submissions", "list"],
        &[
            "study",
            "--sets",
            "2",
            "--images",
            "2",
            "--pairs",
            "1",
            "--grid",
            "8",
            "--out",
            text(&at("study")),
        ],
        &[
            "run",
            "--simulate",
            "--sets",
            "2",
            "--images",
            "2",
            "--grid",
            "8",
            "--submission",
            "23/raw/star",
            "--out",
            text(&at("run")),
        ],
    ] {
        assert_narrow(arguments);
    }
    let wide = succeed(&["score", "--measured", text(&den), "--wide"]);
    assert!(wide.lines().any(|line| line.width() > 120), "{wide}");
    assert!(wide.contains("σ_sys×10⁴") && !wide.contains("Left out"));
    // A terminal that says so is believed.
    let narrow = std::process::Command::new(env!("CARGO_BIN_EXE_shearq"))
        .args(["score", "--measured", text(&den)])
        .env("COLUMNS", "60")
        .output()
        .unwrap();
    let narrow = String::from_utf8(narrow.stdout).unwrap();
    assert!(narrow.lines().all(|line| line.width() <= 60), "{narrow}");
}

#[test]
fn errors_have_two_digits_and_values_as_many_decimals() {
    let root = tempfile::tempdir().unwrap();
    let out = root.path().join("out");
    run_simulated("2,8", "23/den/star", &out, &[]);
    let markdown = succeed(&[
        "score",
        "--measured",
        text(&out),
        "--format",
        "markdown",
        "--wide",
    ]);
    let mut seen = 0;
    for cell in markdown.split('|') {
        let Some((value, error)) = cell.trim().split_once(" ± ") else {
            continue;
        };
        seen += 1;
        let digits = error.trim_start_matches(['0', '.']).replace('.', "").len();
        assert!(digits == 2 || !error.contains('.'), "{cell}");
        let decimals = |number: &str| number.split_once('.').map_or(0, |(_, after)| after.len());
        assert_eq!(decimals(value), decimals(error), "{cell}");
    }
    assert!(seen > 20, "{markdown}");
}

#[test]
fn pages_hold_the_table_the_figures_and_what_made_them() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let page = |name: &str| fs::read_to_string(at(name)).unwrap();
    let (out, html) = (at("out"), at("run.html"));
    run_simulated("2,8", "48/linear/star", &out, &["--report", text(&html)]);
    let made = page("run.html");
    assert!(made.contains("Scores of 48/linear/star") && made.contains("target_sigma"));
    assert!(made.contains("image/svg+xml") && made.contains("Fiducial"));
    let (first, second) = (at("score.html"), at("compare.html"));
    succeed(&["score", "--measured", text(&out), "--report", text(&first)]);
    assert_eq!(page("score.html"), made);
    succeed(&["compare", text(&out), "--report", text(&second)]);
    let compared = page("compare.html");
    assert!(compared.contains("Q cal.") && compared.contains(text(&out)));
    let nowhere = at("out/run.json/page.html");
    let failed = shearq(&[
        "score",
        "--measured",
        text(&out),
        "--report",
        text(&nowhere),
    ]);
    assert_eq!(failed.status.code(), Some(1));
}
