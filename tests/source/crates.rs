//! A crate of the workspace uses only crates of lower levels.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// The crates from the lowest level up, with their folders. A crate uses crates of lower levels only.
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
    &[("shearq-python", "python")],
];

/// Crates that use no files, data frames or threads.
const PURE: [&str; 7] = [
    "shearq-bias",
    "shearq-fourier",
    "shearq-quantities",
    "shearq-submissions",
    "shearq-scoring",
    "shearq-measure",
    "shearq-simulate",
];

/// The crates below the command line, with their folders.
pub fn libraries() -> impl Iterator<Item = (&'static str, &'static str)> {
    let all = LEVELS.iter().flat_map(|crates| crates.iter().copied());
    all.take_while(|(name, _)| *name != "shearq")
}

fn manifest(folder: &str) -> toml::Table {
    let path = Path::new(folder).join("Cargo.toml");
    fs::read_to_string(path).unwrap().parse().unwrap()
}

/// The dependencies of a crate, without its dev-dependencies.
fn dependencies(manifest: &toml::Table) -> Vec<String> {
    let found = manifest["dependencies"].as_table().unwrap();
    found.keys().cloned().collect()
}

#[test]
fn crates_use_those_below_them() {
    crate::tree::enter_root();
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
        .chain(["python", "scoring", "submissions", "."].map(str::to_owned))
        .collect();
    listed.sort_unstable();
    present.sort_unstable();
    assert_eq!(listed, present, "each crate has a level");
}

#[test]
fn pure_crates_use_neither_files_nor_threads() {
    crate::tree::enter_root();
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
    crate::tree::enter_root();
    let page = fs::read_to_string("docs/architecture.md").unwrap();
    for (level, crates) in LEVELS.iter().enumerate() {
        for (_, folder) in *crates {
            let folder = if *folder == "." { "src" } else { *folder };
            let row = format!("| {} | `{folder}` |", level + 1);
            assert!(page.contains(&row), "{row}");
        }
    }
}

#[test]
fn files_that_the_architecture_page_names_exist() {
    crate::tree::enter_root();
    let page = fs::read_to_string("docs/architecture.md").unwrap();
    let folders = [&crate::tree::CODE[..], &["tests"]].concat();
    let files = crate::tree::files(&folders);
    let quoted = page.split('`').skip(1).step_by(2);
    let named: Vec<&str> = quoted.filter(|name| name.ends_with(".rs")).collect();
    for name in &named {
        assert!(files.iter().any(|file| file.ends_with(name)), "{name}");
    }
    assert!(named.len() > 30, "{} files", named.len());
}
