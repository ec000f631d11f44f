//! The ledger of results: tables in the documents are generated from it.
//!
//! A page marks a table by `<!-- ledger: NAME -->` in the line before it. The rows of NAME in `docs/ledger.csv` make the
//! table; `docs/ledger.toml` states the run behind each value. To write changed tables into the pages, run
//! `SHEARQ_ACCEPT=1 cargo test --release --test it ledger`.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use crate::documents::pages;
use crate::support::{Folder, assert_page, shell};

/// One value of the ledger.
struct Entry {
    table: String,
    row: usize,
    column: String,
    value: String,
    error: String,
    run: String,
}

fn ledger() -> Vec<Entry> {
    let mut reader = csv::Reader::from_path("docs/ledger.csv").unwrap();
    let entries = reader.deserialize().map(|entry| {
        let (table, row, column, value, error, run) = entry.unwrap();
        Entry {
            table,
            row,
            column,
            value,
            error,
            run,
        }
    });
    entries.collect()
}

/// The table in Markdown.
fn markdown(name: &str, ledger: &[Entry]) -> String {
    let entries: Vec<&Entry> = ledger.iter().filter(|entry| entry.table == name).collect();
    assert!(!entries.is_empty(), "no table {name} in docs/ledger.csv");
    let first = entries.iter().filter(|entry| entry.row == 1);
    let columns: Vec<&str> = first.map(|entry| entry.column.as_str()).collect();
    let mut text = format!(
        "| {} |\n|{}\n",
        columns.join(" | "),
        "---|".repeat(columns.len())
    );
    for row in entries.chunk_by(|a, b| a.row == b.row) {
        let found: Vec<&str> = row.iter().map(|entry| entry.column.as_str()).collect();
        assert_eq!(found, columns, "columns of {name}, row {}", row[0].row);
        let cells = row.iter().map(|entry| match entry.error.as_str() {
            "" => entry.value.clone(),
            // No line breaks between a value and its error, which narrow columns would make three lines of.
            error => format!("{}\u{a0}±\u{a0}{error}", entry.value),
        });
        writeln!(text, "| {} |", cells.collect::<Vec<_>>().join(" | ")).unwrap();
    }
    text
}

/// The page with the tables of the ledger, and their names.
fn with_tables(page: &str, ledger: &[Entry]) -> (String, Vec<String>) {
    let mut lines = page.lines().peekable();
    let (mut text, mut names) = (String::new(), Vec::new());
    while let Some(line) = lines.next() {
        text += line;
        text.push('\n');
        let name = line
            .strip_prefix("<!-- ledger: ")
            .and_then(|rest| rest.strip_suffix(" -->"));
        if let Some(name) = name {
            while lines.next_if(|line| line.starts_with('|')).is_some() {}
            text += &markdown(name, ledger);
            names.push(name.to_owned());
        }
    }
    (text, names)
}

#[test]
fn tables_in_the_documents_equal_the_ledger() {
    let (ledger, mut used) = (ledger(), BTreeSet::new());
    for path in pages() {
        let page = fs::read_to_string(&path).unwrap();
        let (expected, names) = with_tables(&page, &ledger);
        used.extend(names);
        assert_page(&path, &expected, "ledger");
    }
    let all: BTreeSet<String> = ledger.iter().map(|entry| entry.table.clone()).collect();
    assert_eq!(used, all, "tables of the ledger that no page shows");
    assert!(all.len() > 10);
}

/// What `codes/compare.py table` in a folder prints, or its error.
fn table_of_codes(root: &Path) -> Result<String, String> {
    let output = shell(root, "python3 codes/compare.py table");
    match output.status.success() {
        true => Ok(String::from_utf8(output.stdout).unwrap()),
        false => Err(String::from_utf8(output.stderr).unwrap()),
    }
}

#[test]
fn rows_of_codes_are_on_their_page() {
    let table = table_of_codes(Path::new(".")).unwrap();
    assert!(table.lines().count() > 10, "{table}");
    let page = fs::read_to_string("docs/compare-your-code.md").unwrap();
    let (before, rest) = page.split_once("<!-- codes -->\n").unwrap();
    let rows = rest.split_inclusive('\n');
    let after: String = rows.skip_while(|line| line.starts_with('|')).collect();
    let expected = format!("{before}<!-- codes -->\n{table}{after}");
    assert_page("docs/compare-your-code.md", &expected, "ledger");
}

#[test]
fn rows_of_other_data_or_without_errors_are_refused() {
    let folder = Folder::new();
    let copy = format!("cp -r {}/codes .", env!("CARGO_MANIFEST_DIR"));
    assert!(shell(folder.root(), &copy).status.success());
    assert!(table_of_codes(folder.root()).is_ok());
    let file = "codes/shearq/sn20.toml";
    let text = fs::read_to_string(folder.at(file)).unwrap();
    for (from, to, says) in [
        ("rows = 40000", "rows = 4000", "40000 rows of the data"),
        ("\"--paired\", ", "", "bias --paired"),
        ("m1 = [-", "m1 = [nan, 1.0, -", "no number"),
        ("galaxies = ", "galaxy = ", "galaxies"),
    ] {
        assert!(text.contains(from), "{from}");
        folder.write(file, text.replace(from, to));
        let error = table_of_codes(folder.root()).unwrap_err();
        assert!(error.contains(says), "{to}: {error}");
    }
}

#[test]
fn each_value_of_the_ledger_has_a_run() {
    let runs = fs::read_to_string("docs/ledger.toml").unwrap();
    let runs: toml::Table = runs.parse().unwrap();
    let ledger = ledger();
    for entry in &ledger {
        assert!(
            runs.contains_key(&entry.run),
            "{} has no run in docs/ledger.toml",
            entry.run
        );
    }
    for (name, run) in &runs {
        assert!(
            ledger.iter().any(|entry| entry.run == *name),
            "no value of the run {name}"
        );
        for key in ["command", "data", "machine", "version"] {
            assert!(
                run[key].as_str().is_some_and(|text| !text.is_empty()),
                "{name}: {key}"
            );
        }
    }
}

/// The numbers of a text: digits with a decimal point.
fn decimals(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for word in text.split(|c: char| !(c.is_ascii_digit() || c == '.')) {
        let word = word.trim_matches('.');
        // Versions have two points.
        if word.matches('.').count() == 1 {
            found.push(word.to_owned());
        }
    }
    found
}

#[test]
fn decimal_numbers_of_the_readme_are_in_the_ledger() {
    let readme = fs::read_to_string(PathBuf::from("README.md")).unwrap();
    let ledger = ledger();
    let known: BTreeSet<String> = ledger
        .iter()
        .flat_map(|entry| decimals(&format!("{} {}", entry.value, entry.error)))
        .collect();
    let (mut code, mut checked) = (false, 0);
    for line in readme.lines() {
        if line.starts_with("```") {
            code = !code;
        }
        // Commands, their output and versions of programs are no results.
        if code
            || line.contains("Rust 1.")
            || line.contains("Python 3.")
            || line.contains("Version 0.")
        {
            continue;
        }
        for number in decimals(line) {
            assert!(
                known.contains(&number),
                "README.md: {number} is not in docs/ledger.csv: {line}"
            );
            checked += 1;
        }
    }
    assert!(checked > 5, "{checked} numbers");
}
