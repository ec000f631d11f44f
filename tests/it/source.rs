//! The source code itself: a crate of the workspace uses only crates of lower levels, a file only files that do not use it, and
//! `unsafe` stands where it is known.

use std::collections::{BTreeMap, BTreeSet};
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
const PURE: [&str; 7] = [
    "crates/bias",
    "crates/detection",
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

pub(crate) fn files(folders: &[&str]) -> Vec<PathBuf> {
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
const KNOWN: [&str; 3] = [
    "crates/fitsio-sys/src/lib.rs",
    "crates/files/src/fits/",
    "src/lib.rs",
];

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

// Files, or folders of files, with hints inside of texts: lines of tables, reports and lists, which have no fields, and texts of
// `MeasureError::Shape` and of a configuration whose crate is below the one that joins.
const HINTS_IN_TEXTS: [&str; 15] = [
    "crates/catalogue/src/columns.rs",
    "crates/catalogue/src/sheared_files.rs",
    "crates/catalogue/src/source.rs",
    "crates/challenge/src/entry.rs",
    "crates/challenge/src/ranking.rs",
    "crates/dataset/src/files.rs",
    "crates/detection/src/detector.rs",
    "crates/measure/src/psf/oversampled.rs",
    "crates/pipeline/src/detect.rs",
    "crates/pipeline/src/gather.rs",
    "crates/pipeline/src/wcs/header.rs",
    "crates/quantities/src/lib.rs",
    "crates/results/src/submit/check.rs",
    "crates/results/src/views/",
    "submissions/src/error.rs",
];

#[test]
fn hints_are_fields_of_errors() {
    let mut found = [false; HINTS_IN_TEXTS.len()];
    let libraries = files(&["crates", "scoring", "submissions"]);
    for path in libraries.iter().filter(|path| !path.ends_with("tests.rs")) {
        let name = path.display().to_string();
        let text = fs::read_to_string(path).unwrap();
        let code = text.split("#[cfg(test)]\nmod tests").next().unwrap();
        let mut lines = code.lines().map(|line| line.split("//").next().unwrap());
        if lines.any(|line| line.contains("Try: ")) {
            let place = HINTS_IN_TEXTS
                .iter()
                .position(|known| name.starts_with(known));
            let place = place.unwrap_or_else(|| panic!("{name}: a hint belongs to `hint`"));
            found[place] = true;
        }
    }
    assert_eq!(found, [true; HINTS_IN_TEXTS.len()], "{HINTS_IN_TEXTS:?}");
}

#[test]
fn files_of_a_crate_use_each_other_without_circles() {
    let crates = levels().into_keys().map(|folder| match folder.as_str() {
        "src" => folder,
        _ => folder + "/src",
    });
    for folder in crates {
        assert_eq!(circle(&folder), BTreeMap::new(), "{folder}");
    }
}

#[test]
fn a_circle_of_files_is_found() {
    let root = tempfile::tempdir().unwrap();
    for (name, code) in [
        ("lib.rs", "mod above;\nmod below;"),
        ("above.rs", "use crate::below::{Low, other::{self, Deep}};"),
        (
            "below.rs",
            "mod other;\nuse self::other::Deep;\n#[cfg(test)]\nmod tests { use crate::above::*; }",
        ),
        ("below/other.rs", "// crate::above\npub struct Deep;"),
    ] {
        let path = root.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, code).unwrap();
    }
    let folder = root.path().to_str().unwrap();
    assert_eq!(circle(folder), BTreeMap::new());
    for code in ["use super::super::above::High;", "use super::{Low, Lower};"] {
        fs::write(root.path().join("below/other.rs"), code).unwrap();
        assert!(circle(folder).len() >= 2, "{code}");
    }
}

/// The files of a crate that use each other in circles, as modules, each with the others that it uses.
fn circle(folder: &str) -> BTreeMap<Vec<String>, BTreeSet<Vec<String>>> {
    let module = |path: &Path| -> Vec<String> {
        let path = path.strip_prefix(folder).unwrap().with_extension("");
        let names = path.iter().map(|name| name.to_string_lossy().into_owned());
        names
            .filter(|name| !["lib", "main"].contains(&name.as_str()))
            .collect()
    };
    let paths = files(&[folder]);
    let modules: BTreeSet<Vec<String>> = paths.iter().map(|path| module(path)).collect();
    let mut uses: BTreeMap<_, BTreeSet<_>> = BTreeMap::new();
    for path in paths.iter().filter(|path| !path.ends_with("tests.rs")) {
        let (own, text) = (module(path), fs::read_to_string(path).unwrap());
        let code = text.split("#[cfg(test)]\nmod tests").next().unwrap();
        let lines = code.lines().map(|line| line.split("//").next().unwrap());
        let used = used_paths(&lines.collect::<Vec<_>>().join("\n"))
            .into_iter()
            .map(|path| {
                let (mut from, mut rest) = (own.clone(), &path[..]);
                while let [first, others @ ..] = rest {
                    match first.as_str() {
                        "crate" => from.clear(),
                        "super" => drop(from.pop()),
                        "self" => {}
                        _ => break,
                    }
                    rest = others;
                }
                from.extend_from_slice(rest);
                while !modules.contains(&from) {
                    from.pop();
                }
                from
            });
        // Names of the root are those of other files.
        let used = used
            .filter(|used| *used != own && !used.is_empty())
            .collect();
        if !own.is_empty() {
            uses.insert(own, used);
        }
    }
    // Without those that use no other or that no other uses, until all do both.
    loop {
        let count = uses.len();
        let used: BTreeSet<_> = uses.values().flatten().cloned().collect();
        uses.retain(|own, others| used.contains(own) && !others.is_empty());
        let kept: BTreeSet<_> = uses.keys().cloned().collect();
        uses.values_mut()
            .for_each(|others| others.retain(|other| kept.contains(other)));
        if uses.len() == count {
            return uses;
        }
    }
}

/// The paths in code that begin with `crate`, `super` or `self`, or with a module that the code declares.
fn used_paths(code: &str) -> Vec<Vec<String>> {
    let is_name = |c: char| c.is_alphanumeric() || c == '_';
    let declared = code.lines().filter_map(|line| {
        let (before, name) = line.trim().strip_suffix(';')?.rsplit_once(' ')?;
        before
            .split(' ')
            .next_back()
            .filter(|word| *word == "mod")?;
        Some(name)
    });
    let mut found = Vec::new();
    for start in ["crate", "super", "self"].into_iter().chain(declared) {
        for (at, _) in code.match_indices(&format!("{start}::")) {
            if !code[..at].ends_with(|c| is_name(c) || c == ':') {
                use_tree(&code[at..], &[], &mut found);
            }
        }
    }
    found
}

/// Adds each path of a tree such as `a::{b, c::{self, d}}`, and returns the code behind it.
fn use_tree<'c>(code: &'c str, before: &[String], found: &mut Vec<Vec<String>>) -> &'c str {
    let end = code.find(|c: char| !(c.is_alphanumeric() || c == '_'));
    let (name, rest) = code.split_at(end.unwrap_or(code.len()));
    let path = [before, &[name.to_owned()]].concat();
    match rest.strip_prefix("::") {
        Some(rest) if rest.starts_with(|c: char| c.is_alphanumeric() || c == '_') => {
            use_tree(rest, &path, found)
        }
        Some(rest) if rest.starts_with('{') => {
            let mut rest = rest[1..].trim_start();
            while !rest.is_empty() && !rest.starts_with('}') {
                rest = use_tree(rest, &path, found);
                // Behind a name that ends or is renamed, or an asterisk.
                let next = rest.find([',', '}']).unwrap_or(rest.len());
                rest = rest[next..].trim_start_matches(',').trim_start();
            }
            rest.strip_prefix('}').unwrap_or(rest)
        }
        _ => {
            found.push(path);
            rest
        }
    }
}
