//! Each constant of this crate states its origin: in a `//` comment beside it, or in the table of `docs/constants.md`.

#![expect(clippy::unwrap_used, reason = "a test fails by a panic")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Values by file, relative to the source folder, and name.
type Constants = BTreeMap<(String, String), String>;

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

/// Constants that are numbers or arrays of numbers, without a comment. Values computed from others are left out.
fn declared(source: &Path) -> Constants {
    let mut found = Constants::new();
    for path in sources(source) {
        let code = fs::read_to_string(&path).unwrap();
        let code = code.split("#[cfg(test)]\nmod tests").next().unwrap();
        let file = path.strip_prefix(source).unwrap();
        let file = file.to_string_lossy().replace('\\', "/");
        for (at, _) in code.match_indices("const ") {
            let line = code[..at].rfind('\n').map_or(0, |end| end + 1);
            let Some((name, kind, value)) = declaration(&code[line..]) else {
                continue;
            };
            if has_comment(code, line) {
                continue;
            }
            let number = ["f64", "f32", "usize", "i32", "u32", "u64"];
            let number = number.iter().any(|number| kind.contains(number));
            let digit = |c: char| c.is_ascii_digit() || "-_.e[],/* \n".contains(c);
            if number && !kind.contains("Range") && value.chars().all(digit) {
                let value = value.split_whitespace().collect::<Vec<_>>().join(" ");
                found.insert((file.clone(), name.to_owned()), value);
            }
        }
    }
    found
}

/// The rows of the table.
fn listed(page: &Path) -> Constants {
    let text = fs::read_to_string(page).unwrap();
    let rows = text.lines().filter_map(|line| {
        let mut cells = line
            .split(" | ")
            .map(|cell| cell.trim_matches(['|', ' ', '`']));
        let (file, name, value) = (cells.next()?, cells.next()?, cells.next()?);
        let row = (file.to_owned(), name.to_owned());
        file.ends_with(".rs").then(|| (row, value.to_owned()))
    });
    rows.collect()
}

#[test]
fn the_table_lists_every_constant_without_a_comment() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let declared = declared(&root.join("src"));
    let listed = listed(&root.join("../../docs/constants.md"));
    for (key, value) in &declared {
        assert_eq!(listed.get(key), Some(value), "{key:?} in docs/constants.md");
    }
    for key in listed.keys() {
        assert!(declared.contains_key(key), "{key:?} is not in the code");
    }
}
