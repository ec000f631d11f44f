//! Standard output that nobody reads or that is full, and words of others that would act on a terminal or
//! in a document.

use std::process::{Command, Stdio};

use shearq_render::escape::visible;
use shearq_results::store;

use crate::support::{printed, refused, shell};

/// Commands that print, each in its own way.
const COMMANDS: [&str; 8] = [
    "--help",
    "--version",
    "submissions list",
    "submissions show 23/raw/star",
    "score --measured out",
    "score --measured out --format json",
    "compare out",
    "show --submission 23/raw/star --data data --galaxy 2/1/1 --out galaxy.png",
];

/// Data in a new folder, and what was measured on them.
fn measured() -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    let simulate = "shearq simulate --sets 2 --images 2 --grid 8 --out data";
    let measure = "shearq measure --submission 23/raw/star --data data --out out";
    printed(root.path(), &format!("{simulate} && {measure}"));
    root
}

#[test]
fn a_reader_that_goes_away_is_no_failure() {
    let root = measured();
    for line in COMMANDS {
        let mut child = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(line.split(' '))
            .current_dir(root.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{line}: {said}");
        assert!(
            !said.contains("error") && !said.contains("panicked"),
            "{said}"
        );
    }
    assert!(root.path().join("galaxy.png").is_file());
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_at_standard_output_is_one_error() {
    let root = measured();
    for line in COMMANDS {
        let output = shell(root.path(), &format!("shearq {line} > /dev/full"));
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{line}: {said}");
        assert_eq!(said.matches("error: ").count(), 1, "{said}");
        let expected = "standard output: No space left on device";
        assert!(said.contains(expected), "{said}");
    }
}

/// Whether nothing in what was said acts on a terminal.
fn quiet(said: &str) -> bool {
    visible(said) == said
}

#[test]
fn a_store_with_a_name_that_acts_is_refused() {
    let root = tempfile::tempdir().unwrap();
    let run = "shearq run --simulate --images 3 --grid 12 --sets 2 --submission 23/raw/star";
    printed(root.path(), &format!("{run} --out out --store store"));
    let place = root.path().join("store");
    let (mut runs, _) = store::read(&place).unwrap();
    runs[0].configuration = "\u{1b}[2J".into();
    store::write(&place, &runs[0]).unwrap();
    let message = refused(root.path(), "shearq compare --store store");
    let expected = "without control characters";
    assert!(message.contains(expected) && quiet(&message), "{message}");
}
