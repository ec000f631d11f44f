//! What a terminal of eighty columns shows, and the pages written beside it.

use std::fs;

use unicode_width::UnicodeWidthStr;

use crate::support::{Folder, assert_has, printed, refused};

/// Scored runs on the same small simulated data, in folders and in a store.
fn runs() -> Folder {
    let folder = Folder::new();
    for (submission, out) in [("23/den/star", "den"), ("48/linear/star", "linear")] {
        let run = "run --simulate --fixed-psf one --sets 2,8 --images 3 --grid 12 --store store";
        folder.run(&format!("{run} --submission {submission} --out {out}"));
    }
    folder
}

/// Printed where no terminal states its width: eighty columns.
fn assert_narrow(folder: &Folder, command: &str) -> String {
    let printed = folder.run(command);
    for line in printed.lines() {
        // A name or a path stands whole.
        let fits = line.width() <= 80 || line.split_whitespace().count() == 1;
        assert!(fits, "{command}: {} columns: {line}", line.width());
    }
    printed
}

#[test]
fn tables_fit_eighty_columns_and_wide_ones_are_asked_for() {
    let folder = runs();
    let scored = assert_narrow(&folder, "score --measured den");
    assert!(scored.contains("More with --wide:") && scored.contains("Fiducial"));
    for command in [
        "compare den linear",
        "compare --store store",
        "submissions list",
        "run --simulate --fixed-psf one --sets 2 --images 2 --grid 8 --submission 23/raw/star --out run",
    ] {
        assert_narrow(&folder, command);
    }
    let wide = folder.run("score --measured den --wide");
    assert!(wide.lines().any(|line| line.width() > 120), "{wide}");
    assert!(wide.contains("σ_sys×10⁴") && !wide.contains("Left out"));
    // A terminal that states its width is believed.
    let narrow = printed(folder.root(), "COLUMNS=60 shearq score --measured den");
    assert!(narrow.lines().all(|line| line.width() <= 60), "{narrow}");
}

#[test]
fn errors_have_two_digits_and_values_as_many_decimals() {
    let markdown = runs().run("score --measured den --format markdown --wide");
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
    let folder = runs();
    let report = |command: &str| {
        folder.run(&format!("{command} --report page.html"));
        fs::read_to_string(folder.at("page.html")).unwrap()
    };
    let run = "run --simulate --fixed-psf one --sets 2,8 --images 3 --grid 12";
    let made = report(&format!("{run} --out linear --submission 48/linear/star"));
    for words in [
        "Scores of 48/linear/star",
        "target_sigma",
        "image/svg+xml",
        "Fiducial",
    ] {
        assert_has(&made, words);
    }
    assert_eq!(report("score --measured linear"), made);
    assert_has(&report("compare linear"), "Q cal.");
    let below_a_file = "shearq score --measured linear --report linear/run.json/page.html";
    refused(folder.root(), below_a_file);
}
