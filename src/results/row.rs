//! Runs as Parquet files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_scoring::{Figure, Figures};
use shearq_submissions::check_name;
use shearq_tables::{Column, Table, TableError, read_parquet, write_parquet};

use super::{RunRecord, SetRecord, Value};
use crate::io::atomic;
use crate::io::error::FileError;
use crate::io::fingerprint;
use crate::io::parquet::bare;

/// Key and value in the footer that tell the files of a store.
const SCHEMA: (&str, &str) = ("schema", "shearq results store 1");

pub fn prepare(store: &Path) -> Result<(), FileError> {
    std::fs::create_dir_all(store)
        .map_err(FileError::doing(store, "cannot make the results store"))?;
    atomic::sweep(store);
    Ok(())
}

pub fn write(store: &Path, run: &RunRecord) -> Result<PathBuf, FileError> {
    let failed = |error: TableError| bare(store, &error);
    let metadata = BTreeMap::from([(SCHEMA.0.to_owned(), SCHEMA.1.to_owned())]);
    let table = Table::new(columns(run)?, metadata).map_err(failed)?;
    let mut bytes = Vec::new();
    write_parquet(&mut bytes, &table).map_err(failed)?;
    let path = store.join(file_name(run, &bytes));
    atomic::write(&path, &bytes)?;
    Ok(path)
}

/// Name of the file that holds `bytes`.
fn file_name(run: &RunRecord, bytes: &[u8]) -> String {
    let words: Vec<&str> = run
        .submission
        .split(|c: char| !c.is_ascii_alphanumeric())
        .filter(|word| !word.is_empty())
        .collect();
    let print = fingerprint::of_bytes(bytes);
    format!("{}-{}-{print}.parquet", words.join("-"), run.id())
}

/// The rows of a run, by column.
fn columns(run: &RunRecord) -> Result<Vec<(String, Column)>, FileError> {
    let mut columns: Vec<(String, Column)> = Vec::new();
    for set in &run.sets {
        for (k, (name, value)) in run.row(set).into_iter().enumerate() {
            if k == columns.len() {
                let column = match value {
                    Value::Text(_) => Column::Text(Vec::new()),
                    Value::Real(_) => Column::F64(Vec::new()),
                    Value::Count(_) => Column::I64(Vec::new()),
                };
                columns.push((name, column));
            }
            match (&mut columns[k].1, value) {
                (Column::Text(values), Value::Text(value)) => values.push(value),
                (Column::F64(values), Value::Real(value)) => values.push(value),
                (Column::I64(values), Value::Count(value)) => values.push(value as i64),
                // Every row has the same columns.
                _ => {}
            }
        }
    }
    Ok(columns)
}

pub fn read(path: &Path) -> Result<RunRecord, FileError> {
    let table = read_parquet(path, None).map_err(|error| bare(path, &error))?;
    let found = table.metadata().get(SCHEMA.0).map(String::as_str);
    if found != Some(SCHEMA.1) {
        let message = format!(
            "found {}, expected a file of a results store: `{}` = \"{}\" in its metadata",
            found.map_or("no schema".into(), |found| format!("schema \"{found}\"")),
            SCHEMA.0,
            SCHEMA.1
        );
        return Err(FileError::new(path, message));
    }
    let rows = Rows {
        path,
        table: &table,
    };
    let text = |name| rows.text(name, 0).map(str::to_owned);
    let submission = text("submission")?;
    check_name(&submission).map_err(|message| FileError::new(path, message))?;
    let run = RunRecord {
        submission,
        version: text("version")?,
        settings: text("settings")?,
        source: text("source")?,
        definition: text("definition")?,
        choice: text("choice")?,
        noise: text("noise")?,
        sets: (0..table.rows())
            .map(|row| rows.set(row))
            .collect::<Result<_, _>>()?,
    };
    for row in 0..table.rows() {
        let found = rows.text("run", row)?;
        if found != run.id() {
            let message = format!(
                "row {}: `run` is {found}, but what made it amounts to {}; was the file edited?",
                row + 1,
                run.id()
            );
            return Err(FileError::new(path, message));
        }
    }
    Ok(run)
}

/// Rows of a file of the store.
struct Rows<'a> {
    path: &'a Path,
    table: &'a Table,
}

impl Rows<'_> {
    fn wrong(&self, name: &str, row: usize, expected: &str) -> FileError {
        let message = format!("row {}: column `{name}` has no {expected}", row + 1);
        FileError::new(self.path, message)
    }

    fn text(&self, name: &str, row: usize) -> Result<&str, FileError> {
        match self.table.column(name) {
            Some(Column::Text(values)) => values.get(row).map(String::as_str),
            _ => None,
        }
        .ok_or_else(|| self.wrong(name, row, "text"))
    }

    fn real(&self, name: &str, row: usize) -> Result<f64, FileError> {
        match self.table.column(name) {
            Some(Column::F64(values)) => values.get(row).copied(),
            _ => None,
        }
        .ok_or_else(|| self.wrong(name, row, "real number"))
    }

    fn count<T: TryFrom<i64>>(&self, name: &str, row: usize) -> Result<T, FileError> {
        match self.table.column(name) {
            Some(Column::I64(values)) => values.get(row).and_then(|&v| T::try_from(v).ok()),
            _ => None,
        }
        .ok_or_else(|| self.wrong(name, row, "number that can be counted to"))
    }

    /// Numbers of a JSON list; null is NaN where `T` has it.
    fn list<T: std::str::FromStr>(&self, name: &str, row: usize) -> Result<Vec<T>, FileError> {
        let text = self.text(name, row)?;
        text.strip_prefix('[')
            .and_then(|rest| rest.strip_suffix(']'))
            .and_then(|inner| {
                let numbers = inner.split(',').filter(|part| !part.is_empty());
                numbers
                    .map(|part| if part == "null" { "NaN" } else { part })
                    .map(|part| part.parse().ok())
                    .collect()
            })
            .ok_or_else(|| self.wrong(name, row, "list of numbers"))
    }

    fn set(&self, row: usize) -> Result<SetRecord, FileError> {
        let figures = |suffix: &str| -> Result<Figures, FileError> {
            let mut values = [f64::NAN; Figures::ALL.len()];
            for (value, Figure { name, .. }) in values.iter_mut().zip(Figures::ALL) {
                *value = self.real(&format!("{name}{suffix}"), row)?;
            }
            Ok(Figures::from_values(values))
        };
        Ok(SetRecord {
            set: self.count("set", row)?,
            data: self.text("data", row)?.to_owned(),
            images: self.list("image_numbers", row)?,
            galaxies: self.count("galaxies", row)?,
            flagged: self.count("flagged", row)?,
            figures: figures("")?,
            errors: figures("_error")?,
            q_replicates: self.list("q_replicates", row)?,
            q_leaderboard: self.real("q_leaderboard", row)?,
            convention: self.count("convention", row)?,
            // Earlier versions let each set choose.
            convention_known: match self.table.column("convention_known") {
                Some(_) => self.count::<u8>("convention_known", row)? > 0,
                None => self.text("choice", row)?.parse::<u8>().is_ok(),
            },
            convention_leaderboard: self.count("convention_leaderboard", row)?,
        })
    }
}
