//! The source code itself: a crate of the workspace uses only crates of lower levels, and `unsafe` stands where it is known.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

// The crates from the lowest level up, with their folders. A crate uses crates of lower levels only.
const LEVELS: [&[(&str, &str)]; 8] = [
    &[
        ("shearq-fourier", "crates/fourier"),
        ("shearq-quantities", "crates/quantities"),
        ("shearq-submissions", "submissions"),
    ],
    &[
        ("shearq-bias", "crates/bias"),
        ("shearq-scoring", "scoring"),
        ("shearq-measure", "crates/measure"),
        ("shearq-files", "crates/files"),
    ],
    &[
        ("shearq-simulate", "crates/simulate"),
        ("shearq-render", "crates/render"),
    ],
    &[("shearq-dataset", "crates/dataset")],
    &[
        ("shearq-pipeline", "crates/pipeline"),
        ("shearq-results", "crates/results"),
    ],
    &[
        ("shearq-studies", "crates/studies"),
        ("shearq-challenge", "crates/challenge"),
    ],
    &[("shearq", ".")],
    &[("shearq-python", "python"), ("shearq-benches", "benches")],
];

// Folders with code.
const CODE: [&str; 5] = ["src", "crates", "scoring", "submissions", "python"];

// Crates that use no files, data frames or threads.
const PURE: [&str; 7] = [
    "shearq-bias",
    "shearq-fourier",
    "shearq-quantities",
    "shearq-submissions",
    "shearq-scoring",
    "shearq-measure",
    "shearq-simulate",
];

fn manifest(folder: &str) -> toml::Table {
    let path = Path::new(folder).join("Cargo.toml");
    fs::read_to_string(path).unwrap().parse().unwrap()
}

// Without dev-dependencies.
fn dependencies(manifest: &toml::Table) -> Vec<String> {
    let found = manifest["dependencies"].as_table().unwrap();
    found.keys().cloned().collect()
}

#[test]
fn crates_use_those_below_them() {
    let levels: BTreeMap<&str, usize> = LEVELS
        .iter()
        .enumerate()
        .flat_map(|(level, crates)| crates.iter().map(move |(name, _)| (*name, level)))
        .collect();
    for (level, crates) in LEVELS.iter().enumerate() {
        for (name, folder) in *crates {
            let manifest = manifest(folder);
            assert_eq!(manifest["package"]["name"].as_str(), Some(*name));
            for used in dependencies(&manifest) {
                if used.starts_with("shearq") {
                    let Some(below) = levels.get(used.as_str()) else {
                        panic!("{name} uses {used}, which has no level");
                    };
                    assert!(*below < level, "{name} uses {used}, which is not below it");
                }
            }
        }
    }
    let folders = LEVELS.iter().flat_map(|crates| crates.iter());
    let mut listed: Vec<&str> = folders.map(|(_, folder)| *folder).collect();
    let inner = fs::read_dir("crates").unwrap().map(|entry| entry.unwrap());
    let mut present: Vec<String> = inner
        .map(|entry| format!("crates/{}", entry.file_name().to_string_lossy()))
        .chain(["benches", "python", "scoring", "submissions", "."].map(str::to_owned))
        .collect();
    listed.sort_unstable();
    present.sort_unstable();
    assert_eq!(listed, present, "each crate has a level");
}

#[test]
fn pure_crates_use_neither_files_nor_threads() {
    for (name, folder) in LEVELS.iter().flat_map(|crates| crates.iter()) {
        if !PURE.contains(name) {
            continue;
        }
        let used = dependencies(&manifest(folder));
        for other in ["shearq-files", "fitsio", "polars", "rayon"] {
            assert!(!used.iter().any(|one| one == other), "{name} uses {other}");
        }
    }
}

#[test]
fn the_architecture_page_lists_every_crate_with_its_level() {
    let page = fs::read_to_string("docs/architecture.md").unwrap();
    for (level, crates) in LEVELS.iter().enumerate() {
        for (_, folder) in *crates {
            if *folder == "benches" {
                continue;
            }
            let folder = if *folder == "." { "src" } else { *folder };
            let row = format!("| {} | `{folder}` |", level + 1);
            assert!(page.contains(&row), "{row}");
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
