//! What the tests share: the binary, the folders beside the project, numbers from CSV files.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A folder of `shared` beside the project; says so and gives none where it is absent.
pub fn shared(name: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../shared")
        .join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("skipped: there is no folder shared/{name} beside the project");
    None
}

/// Runs the binary.
pub fn shearq(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_shearq"))
        .args(arguments)
        .output()
        .expect("the binary starts")
}

/// Runs the binary, which must succeed, and gives its standard output.
pub fn succeed(arguments: &[&str]) -> String {
    let output = shearq(arguments);
    assert!(
        output.status.success(),
        "{arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Runs the binary, which must fail with exit code 1 and one error, and gives that.
pub fn fail(arguments: &[&str]) -> String {
    let output = shearq(arguments);
    let message = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {message}");
    assert!(message.starts_with("error: "), "{message}");
    assert!(!message.contains("panicked"), "{message}");
    message
}

/// Every file below a folder with its content, by name.
pub fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().display().to_string();
                found.push((name, std::fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8 path")
}

/// Columns of a CSV file by name.
pub fn csv(path: &Path, names: &[&str]) -> Vec<Vec<f64>> {
    let content = std::fs::read_to_string(path).expect("readable CSV");
    let mut lines = content.lines();
    let header: Vec<&str> = lines.next().expect("header").split(',').collect();
    let places: Vec<usize> = names
        .iter()
        .map(|name| header.iter().position(|h| h == name).expect("column"))
        .collect();
    let mut columns = vec![Vec::new(); names.len()];
    for line in lines {
        let fields: Vec<&str> = line.split(',').collect();
        for (column, &place) in columns.iter_mut().zip(&places) {
            column.push(fields[place].parse().expect("number"));
        }
    }
    columns
}
