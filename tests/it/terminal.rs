//! What a terminal of eighty columns shows, and the pages written beside it.

use std::fs;
use std::path::Path;

use unicode_width::UnicodeWidthStr;

use crate::support::{printed, shell};

/// Scored runs on the same small simulated data, in folders and in a store.
fn runs() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    for (submission, out) in [("23/den/star", "den"), ("48/linear/star", "linear")] {
        let run = "shearq run --simulate --sets 2,8 --images 3 --grid 12 --store store";
        printed(
            root.path(),
            &format!("{run} --submission {submission} --out {out}"),
        );
    }
    root
}

/// Printed where no terminal states its width: eighty columns.
fn assert_narrow(root: &Path, command: &str) -> String {
    let printed = printed(root, &format!("shearq {command}"));
    for line in printed.lines() {
        // A name or a path stands whole.
        let fits = line.width() <= 80 || line.split_whitespace().count() == 1;
        assert!(fits, "{command}: {} columns: {line}", line.width());
    }
    printed
}

#[test]
fn tables_fit_eighty_columns_and_wide_ones_are_asked_for() {
    let root = runs();
    let root = root.path();
    let scored = assert_narrow(root, "score --measured den");
    assert!(scored.contains("More with --wide:") && scored.contains("Fiducial"));
    for command in [
        "compare den linear",
        "compare --store store",
        "compare --store store",
        "submissions list",
        "study --sets 2 --images 2 --pairs 1 --grid 8 --out study",
        "run --simulate --sets 2 --images 2 --grid 8 --submission 23/raw/star --out run",
    ] {
        assert_narrow(root, command);
    }
    let wide = printed(root, "shearq score --measured den --wide");
    assert!(wide.lines().any(|line| line.width() > 120), "{wide}");
    assert!(wide.contains("σ_sys×10⁴") && !wide.contains("Left out"));
    // A terminal that states its width is believed.
    let narrow = printed(root, "COLUMNS=60 shearq score --measured den");
    assert!(narrow.lines().all(|line| line.width() <= 60), "{narrow}");
}

#[test]
fn errors_have_two_digits_and_values_as_many_decimals() {
    let score = "shearq score --measured den --format markdown --wide";
    let markdown = printed(runs().path(), score);
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
    let root = runs();
    let report = |command: &str| {
        let line = format!("shearq {command} --report page.html");
        printed(root.path(), &line);
        fs::read_to_string(root.path().join("page.html")).unwrap()
    };
    let made = report(
        "run --simulate --sets 2,8 --images 3 --grid 12 --out linear --submission 48/linear/star",
    );
    for expected in [
        "Scores of 48/linear/star",
        "target_sigma",
        "image/svg+xml",
        "Fiducial",
    ] {
        assert!(made.contains(expected), "{expected}");
    }
    assert_eq!(report("score --measured linear"), made);
    let compared = report("compare linear");
    assert!(compared.contains("Q cal.") && compared.contains("linear"));
    let failed = shell(
        root.path(),
        "shearq score --measured linear --report linear/run.json/page.html",
    );
    assert_eq!(failed.status.code(), Some(1));
}
