//! Each constant of this crate states its origin in a `//` comment beside it.

#![expect(clippy::unwrap_used, reason = "a test fails by a panic")]

use std::fs;
use std::path::{Path, PathBuf};

/// Source files below `folder`; files of tests are left out.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if !path.ends_with("tests.rs") {
            found.push(path);
        }
    }
    found
}

/// Name, type and value of a declaration that starts with `text`, if it is a constant.
fn declaration(text: &str) -> Option<(&str, &str, &str)> {
    let text = text.trim_start();
    let text = match text.strip_prefix("pub") {
        None => text,
        Some(rest) => rest.split_once(' ').map_or(rest, |(_, rest)| rest),
    };
    let (name, rest) = text.strip_prefix("const ")?.split_once(": ")?;
    let (kind, rest) = rest.split_once(" =")?;
    if kind.contains('\n') {
        return None; // A parameter, or a constant of a trait.
    }
    // The length of an array type has a semicolon too; a value has none.
    let (value, _) = rest.split_once(';')?;
    Some((name, kind, value.trim()))
}

/// Whether a `//` comment stands above the declaration that starts at `line`, or behind it.
fn has_comment(code: &str, line: usize) -> bool {
    let own = code[line..].lines().next().unwrap_or_default();
    let above = code[..line].lines().rev().map(str::trim_start);
    let mut block = above.take_while(|text| text.starts_with("//") || text.starts_with("#["));
    own.contains("; // ") || block.any(|text| text.starts_with("// "))
}

#[test]
fn every_number_has_a_comment_with_its_origin() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut missing = Vec::new();
    for path in sources(&source) {
        let code = fs::read_to_string(&path).unwrap();
        let code = code.split("#[cfg(test)]\nmod tests").next().unwrap();
        for (at, _) in code.match_indices("const ") {
            let line = code[..at].rfind('\n').map_or(0, |end| end + 1);
            let Some((name, kind, value)) = declaration(&code[line..]) else {
                continue;
            };
            let number = ["f64", "f32", "usize", "i32", "u32", "u64"];
            let number = number.iter().any(|number| kind.contains(number));
            // Values computed from others have no origin of their own.
            let digit = |c: char| c.is_ascii_digit() || "-_.e[],/* \n".contains(c);
            let literal = !kind.contains("Range") && value.chars().all(digit);
            if number && literal && !has_comment(code, line) {
                missing.push(format!("{}: {name}", path.display()));
            }
        }
    }
    assert_eq!(missing, [""; 0]);
}
