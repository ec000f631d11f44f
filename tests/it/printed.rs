//! Standard output that nobody reads or that is full.

use std::process::{Command, Stdio};

use crate::support::{Folder, assert_has, refused};

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
fn measured() -> Folder {
    let folder = Folder::with_set(2);
    folder.measure("--submission 23/raw/star");
    folder
}

#[test]
fn a_reader_that_goes_away_is_no_failure() {
    let folder = measured();
    for line in COMMANDS {
        let mut child = Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args(line.split(' '))
            .current_dir(folder.root())
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
    assert!(folder.at("galaxy.png").is_file());
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_at_standard_output_is_one_error() {
    let folder = measured();
    for line in COMMANDS {
        let message = refused(folder.root(), &format!("shearq {line} > /dev/full"));
        assert_eq!(message.matches("error: ").count(), 1, "{message}");
        assert_has(&message, "standard output: No space left on device");
    }
}
