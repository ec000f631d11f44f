//! Each constant of `crates/measure` and `crates/detection` states its origin in a `//` comment beside it, and
//! `crates/measure/CONSTANTS.md` lists those of `crates/measure`.
//!
//! To write a changed page, run `SHEARQ_ACCEPT=1 cargo test --release --test it constants`.

use std::fs;
use std::path::Path;

use crate::source::files;
use crate::support::assert_page;

const MEASURE: &str = "crates/measure/src";
const DETECTION: &str = "crates/detection/src";
const PAGE: &str = "crates/measure/CONSTANTS.md";

struct Constant {
    file: String,
    name: String,
    kind: String,
    value: String,
    /// The comments above it and behind it.
    origin: String,
}

/// A file without its tests.
fn code(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap();
    let code = text.split("#[cfg(test)]\nmod tests").next().unwrap();
    code.to_owned()
}

/// The constants of a file outside tests.
fn constants(folder: &str, path: &Path) -> Vec<Constant> {
    let code = code(path);
    let file = path.strip_prefix(folder).unwrap().display().to_string();
    let mut found = Vec::new();
    let mut comment = Vec::new();
    let mut rest = &code[..];
    while let Some((line, next)) = rest.split_once('\n') {
        let declared = line.trim().trim_start_matches("pub(crate) ");
        let declared = declared
            .trim_start_matches("pub(super) ")
            .trim_start_matches("pub ");
        if let Some((name, _)) = declared
            .strip_prefix("const ")
            .and_then(|of| of.split_once(": "))
            && let Some((kind, value)) = rest
                .split_once(&format!("{name}: "))
                .unwrap()
                .1
                .split_once(" =")
            && !kind.contains('\n')
            && let Some((value, behind)) = value.split_once(';')
        {
            let behind = behind.lines().next().unwrap_or_default().trim();
            comment.extend(behind.strip_prefix("// "));
            found.push(Constant {
                file: file.clone(),
                name: name.to_owned(),
                kind: kind.to_owned(),
                value: value.trim().to_owned(),
                origin: comment.join(" "),
            });
        }
        match line.trim().strip_prefix("//") {
            Some(words) => comment.push(words.trim_start_matches('/').trim()),
            None => comment.clear(),
        }
        rest = next;
    }
    found
}

/// The constants with a number of their own, and those computed from them. Numbers that count or index elements of arrays are the
/// layout of the code.
fn tuned(folder: &str) -> Vec<Constant> {
    let paths = files(&[folder]);
    let tests =
        |path: &&std::path::PathBuf| path.ends_with("tests.rs") || path.ends_with("testing.rs");
    let paths = paths.iter().filter(|path| !tests(path));
    let all: Vec<Constant> = paths
        .clone()
        .flat_map(|path| constants(folder, path))
        .collect();
    let code: String = paths.map(|path| code(path)).collect();
    let lays_out = |name: &str| {
        let places = [
            format!("[{name}]"),
            format!("; {name}]"),
            format!("::<{name}>"),
        ];
        places.iter().any(|place| code.contains(place))
    };
    let numbers = ["f64", "f32", "usize", "i32", "u32", "u64"];
    let is_number = |kind: &str| numbers.iter().any(|number| kind.contains(number));
    let all = all.into_iter().filter(|constant| is_number(&constant.kind));
    all.filter(|constant| !(constant.kind == "usize" && lays_out(&constant.name)))
        .collect()
}

#[test]
fn every_tuned_number_has_a_comment_with_its_origin() {
    // Values computed from others have no origin of their own.
    let digit = |c: char| c.is_ascii_digit() || "-_.e[],/* \n".contains(c);
    let is_own = |of: &Constant| !of.kind.contains("Range") && of.value.chars().all(digit);
    let missing = [MEASURE, DETECTION]
        .into_iter()
        .flat_map(tuned)
        .filter(|of| is_own(of) && of.origin.is_empty());
    let missing: Vec<String> = missing
        .map(|of| format!("{}: {}", of.file, of.name))
        .collect();
    assert_eq!(missing, [""; 0]);
}

#[test]
fn the_page_of_constants_equals_the_source() {
    let page = fs::read_to_string(PAGE).unwrap();
    let (head, rows) = page.split_once("|---|---|---|---|\n").unwrap();
    let rows: Vec<Vec<&str>> = rows.lines().map(|row| row.split(" | ").collect()).collect();
    let scalar = |of: &Constant| !of.kind.contains(['[', '<']) && !of.value.contains('\n');
    let mut found = format!("{head}|---|---|---|---|\n");
    for Constant {
        file,
        name,
        value,
        origin,
        ..
    } in tuned(MEASURE).into_iter().filter(scalar)
    {
        let (key, value) = (format!("| `{file}` `{name}`"), format!("`{value}`"));
        // `tests/stress/constants.py` measures effects, which outlive a move to another file.
        let known = rows.iter().find(|row| row[0] == key).or_else(|| {
            let moved =
                |row: &&Vec<&str>| row[0].ends_with(&format!(" `{name}`")) && row[1] == value;
            rows.iter().find(moved)
        });
        let effect = known.map_or("not scanned: newer than the scan", |row| {
            row.last().unwrap().trim_end_matches(" |")
        });
        let origin = match origin.replace('|', "\\|") {
            none if none.is_empty() => "–".to_owned(),
            origin => origin,
        };
        found += &format!("{key} | {value} | {origin} | {effect} |\n");
    }
    assert_page(PAGE, &found, "constants");
}
