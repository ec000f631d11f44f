//! Lengths of source files. Clippy's `too_many_lines` limits functions.

use std::fs;

use crate::tree::{CODE, files};

/// Most lines of a file before its tests.
const LONGEST: usize = 800;

/// Files that are longer. Split them; add none.
const KNOWN: [&str; 0] = [];

#[test]
fn files_have_at_most_800_lines() {
    crate::tree::enter_root();
    let mut long = Vec::new();
    for path in files(&CODE) {
        let name = path.display().to_string();
        if name.contains("/tests") {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        let code = text.split("\n#[cfg(test)]\nmod tests {").next().unwrap();
        let lines = code.lines().count();
        if lines > LONGEST {
            long.push((name, lines));
        }
    }
    for (name, lines) in &long {
        assert!(
            KNOWN.contains(&name.as_str()),
            "{name} has {lines} lines before its tests; expected at most {LONGEST}"
        );
    }
    for name in KNOWN {
        assert!(
            long.iter().any(|(found, _)| found == name),
            "{name} is short enough: remove it from the list of known long files"
        );
    }
}
