//! The source code itself: a crate of the workspace uses only crates of lower levels, and `unsafe` stands where it is known.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Folder and level of each crate, as the table of the page states them.
fn levels() -> BTreeMap<String, usize> {
    let page = fs::read_to_string("docs/architecture.md").unwrap();
    let rows = page.lines().filter_map(|line| {
        let mut cells = line.strip_prefix("| ")?.split(" | ");
        let level = cells.next()?.parse().ok()?;
        Some((cells.next()?.trim_matches('`').to_owned(), level))
    });
    rows.collect()
}

// Folders with code.
const CODE: [&str; 5] = ["src", "crates", "scoring", "submissions", "python"];

// Crates that use no files, data frames or threads.
const PURE: [&str; 6] = [
    "crates/bias",
    "crates/quantities",
    "crates/measure",
    "crates/simulate",
    "scoring",
    "submissions",
];

fn manifest(folder: &str) -> toml::Table {
    let folder = if folder == "src" { "." } else { folder };
    let path = Path::new(folder).join("Cargo.toml");
    fs::read_to_string(path).unwrap().parse().unwrap()
}

fn name(manifest: &toml::Table) -> &str {
    manifest["package"]["name"].as_str().unwrap()
}

// Without dev-dependencies.
fn dependencies(manifest: &toml::Table) -> Vec<String> {
    let found = manifest["dependencies"].as_table().unwrap();
    found.keys().cloned().collect()
}

#[test]
fn crates_use_those_below_them() {
    let levels = levels();
    let mut present: Vec<String> = ["python", "scoring", "src", "submissions"]
        .map(str::to_owned)
        .into();
    let inner = fs::read_dir("crates").unwrap().map(|entry| entry.unwrap());
    present.extend(inner.map(|entry| format!("crates/{}", entry.file_name().to_string_lossy())));
    present.sort_unstable();
    let listed: Vec<&String> = levels.keys().collect();
    assert_eq!(
        listed,
        present.iter().collect::<Vec<_>>(),
        "each crate has a level"
    );
    let manifests = levels
        .iter()
        .map(|(folder, level)| (manifest(folder), level));
    let manifests: Vec<_> = manifests.collect();
    for (own, level) in &manifests {
        for used in dependencies(own) {
            if used.starts_with("shearq") {
                let below = manifests
                    .iter()
                    .find(|(other, _)| name(other) == used)
                    .unwrap()
                    .1;
                assert!(
                    below < level,
                    "{} uses {used}, which is not below it",
                    name(own)
                );
            }
        }
    }
}

#[test]
fn pure_crates_use_neither_files_nor_threads() {
    for folder in PURE {
        let used = dependencies(&manifest(folder));
        for other in ["shearq-files", "fitsio", "polars", "rayon"] {
            assert!(
                !used.iter().any(|one| one == other),
                "{folder} uses {other}"
            );
        }
    }
}

#[test]
fn files_that_the_architecture_page_names_exist() {
    let page = fs::read_to_string("docs/architecture.md").unwrap();
    let files = files(&[&CODE[..], &["tests"]].concat());
    let quoted = page.split('`').skip(1).step_by(2);
    let named: Vec<&str> = quoted.filter(|name| name.ends_with(".rs")).collect();
    for name in &named {
        assert!(files.iter().any(|file| file.ends_with(name)), "{name}");
    }
    assert!(named.len() > 30, "{} files", named.len());
}

fn files(folders: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders: Vec<PathBuf> = folders.iter().map(PathBuf::from).collect();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|ending| ending == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

// Files, or folders of files, with `unsafe`: calls of cfitsio, and one of the C library. Crates that use the macro of
// `multiversion` cannot forbid it, because the macro expands to checked calls of functions with target features. So their
// text is searched.
const KNOWN: [&str; 2] = ["crates/files/src/fits/", "src/lib.rs"];

#[test]
fn unsafe_code_is_where_it_is_known() {
    let mut found = [false; KNOWN.len()];
    for path in files(&CODE) {
        let name = path.display().to_string();
        let text = fs::read_to_string(&path).unwrap();
        let code = text.lines().map(|line| line.split("//").next().unwrap());
        let is_unsafe = code.clone().any(|line| {
            let mut words = line.split(|c: char| !(c.is_alphanumeric() || c == '_'));
            line.contains("unsafe ")
                && words.any(|word| word == "unsafe")
                && !line.contains("'unsafe-")
        });
        if !is_unsafe {
            continue;
        }
        let place = KNOWN.iter().position(|known| name.starts_with(known));
        let place = place.unwrap_or_else(|| panic!("{name} has unsafe code"));
        found[place] = true;
    }
    assert_eq!(found, [true; KNOWN.len()], "{KNOWN:?}");
}
