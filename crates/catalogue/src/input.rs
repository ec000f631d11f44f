//! A catalogue: a file, several files, or a table in memory.

use std::path::PathBuf;

use shearq_files::frames::polars::DataFrame;

#[derive(Debug, Clone, Default)]
pub struct Input {
    /// The file, or the name of the table.
    pub name: PathBuf,
    /// The table, if it is in memory.
    pub frame: Option<DataFrame>,
    /// Names of the columns that the table in memory lacks, and what they have in place of a number or text in each row, such as `has
    /// the shape (100, 9)`; empty of those that are not read because nothing needs them.
    pub unread: Vec<(String, String)>,
    /// The files of a catalogue in several, with the sheared catalogue (0 for noshear) that a file contains.
    pub parts: Vec<(PathBuf, Option<usize>)>,
}

impl From<PathBuf> for Input {
    fn from(name: PathBuf) -> Self {
        Input {
            name,
            ..Input::default()
        }
    }
}
