//! Standard output that nobody reads or that is full, and words of others that would act on a terminal or
//! in a document.

use std::fs;
use std::process::{Command, Stdio};

use shearq_results::store;

use crate::support::{Small, fail, run_simulated, succeed, text};

/// Commands that print, each in its own way.
fn commands<'a>(out: &'a str, data: &'a str, picture: &'a str) -> Vec<Vec<&'a str>> {
    let measure = [
        "measure",
        "--submission",
        "23/raw/star",
        "--data",
        data,
        "--out",
        out,
    ];
    succeed(&measure);
    vec![
        vec!["--help"],
        vec!["--version"],
        vec!["submissions", "list"],
        vec!["submissions", "show", "23/raw/star"],
        vec!["score", "--measured", out],
        vec!["score", "--measured", out, "--format", "json"],
        vec!["compare", out],
        vec![
            "show",
            "--submission",
            "23/raw/star",
            "--data",
            data,
            "--galaxy",
            "2/1/1",
            "--out",
            picture,
        ],
    ]
}

#[test]
fn a_reader_that_goes_away_is_no_failure() {
    let small = Small::new("2");
    let (out, data, picture) = (small.at("out"), small.at("data"), small.at("galaxy.png"));
    for arguments in commands(text(&out), text(&data), text(&picture)) {
        let mut child = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(&arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}");
        assert!(
            !said.contains("error") && !said.contains("panicked"),
            "{said}"
        );
    }
    assert!(picture.is_file());
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_at_standard_output_is_one_error() {
    let small = Small::new("2");
    let (out, data, picture) = (small.at("out"), small.at("data"), small.at("galaxy.png"));
    for arguments in commands(text(&out), text(&data), text(&picture)) {
        let full = fs::File::options().write(true).open("/dev/full").unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(&arguments)
            .stdout(full)
            .output()
            .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {said}");
        assert_eq!(said.matches("error: ").count(), 1, "{said}");
        assert!(
            said.contains("standard output: No space left on device"),
            "{said}"
        );
    }
}

/// Whether nothing in what was said acts on a terminal.
fn quiet(said: &str) -> bool {
    !said.contains(|c: char| shearq_submissions::is_control(c) && c != '\n')
}

#[test]
fn a_store_with_a_name_that_acts_is_refused() {
    let root = tempfile::tempdir().unwrap();
    let (out, place) = (root.path().join("out"), root.path().join("store"));
    run_simulated("2", "23/raw/star", &out, &["--store", text(&place)]);
    let (mut runs, _) = store::read(&place).unwrap();
    runs[0].configuration = "\u{1b}[2J".into();
    store::write(&place, &runs[0]).unwrap();
    let message = fail(&["compare", "--store", text(&place)]);
    assert!(
        message.contains("without control characters") && quiet(&message),
        "{message}"
    );
}
