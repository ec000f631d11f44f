//! Files: FITS, Parquet, Arrow, ASCII and CSV tables, read with care and written completely or not at all.
//!
//! [`fits`] is the only user of cfitsio and serialises its calls. [`open`] is the only place that opens files for
//! reading. [`atomic`] writes each file under a temporary name and renames it when it is complete.
//! [`frames`] are polars' data frames with text metadata.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use shearq_quantities::tried;
use thiserror::Error;

pub use fields::panic_is_caught;

mod arrow;
pub mod atomic;
mod content;
mod fields;
pub mod fits;
pub mod frames;
pub mod open;
pub mod parquet;
pub mod table;
pub mod text;

/// Most rows of a table that may fill the largest grid, of 4000 × 4000 cells.
pub const MAX_ROWS: usize = 4000 * 4000;
/// 2⁵³: all integers up to it are 64-bit floats.
pub const MAX_EXACT_INTEGER: f64 = 9_007_199_254_740_992.0;
/// Most pixels per side of an image.
// Chosen by hand. A damaged header cannot ask for memory beyond it.
pub(crate) const MAX_SIDE: usize = 200_000;

/// A file that cannot be used: its path, the place, the found and the expected value, and what the user can try.
#[derive(Debug, Error)]
#[error("{}: {}", path.display(), self.text())]
pub struct FileError {
    pub path: PathBuf,
    /// Place, found value, expected value.
    message: String,
    /// What to try, such as a command.
    pub hint: Option<String>,
    /// Whether the only fault is that a requested column is absent or that the columns have no names.
    pub no_column: bool,
}

// Most names of columns that a message lists.
const MAX_NAMES: usize = 40;

// Most characters of a message, which may quote contents of a file.
const MAX_MESSAGE_CHARS: usize = 4000;

/// Names of columns as a message lists them.
pub fn names_of(names: &[impl AsRef<str>]) -> String {
    let shown: Vec<&str> = names.iter().take(MAX_NAMES).map(AsRef::as_ref).collect();
    let more = if names.len() > MAX_NAMES { ", …" } else { "" };
    shown.join(", ") + more
}

impl FileError {
    pub fn new(path: impl AsRef<Path>, message: impl Display) -> Self {
        let mut message = message.to_string();
        if let Some((end, _)) = message.char_indices().nth(MAX_MESSAGE_CHARS) {
            message.truncate(end);
            message.push('…');
        }
        FileError {
            path: path.as_ref().to_owned(),
            message,
            hint: None,
            no_column: false,
        }
    }

    /// About `path`, from an error whose text ends with its `hint`.
    pub fn with_hint(path: impl AsRef<Path>, error: &impl Display, hint: Option<String>) -> Self {
        let text = error.to_string();
        let message = text.strip_suffix(&tried(hint.as_ref())).unwrap_or(&text);
        FileError::new(path, message).hint_if(hint)
    }

    /// With what the user can try, in place of an earlier hint.
    #[must_use]
    pub fn hint(self, hint: impl Into<String>) -> Self {
        FileError {
            hint: Some(hint.into()),
            ..self
        }
    }

    /// With what the user can try, if anything.
    #[must_use]
    pub fn hint_if(self, hint: Option<String>) -> Self {
        FileError { hint, ..self }
    }

    /// The message with the hint, without the path.
    pub fn text(&self) -> String {
        // A question has its mark.
        let message = self.message.as_str();
        let end = tried(self.hint.as_ref());
        message.to_owned()
            + end
                .strip_prefix('.')
                .filter(|_| message.ends_with('?'))
                .unwrap_or(&end)
    }

    /// The same about another path, such as that of an archive for a file in it.
    #[must_use]
    pub fn about(self, path: PathBuf) -> Self {
        FileError { path, ..self }
    }

    /// With other words in message and hint.
    #[must_use]
    pub fn with_words(self, found: &str, other: &str) -> Self {
        FileError {
            message: self.message.replace(found, other),
            hint: self.hint.map(|hint| hint.replace(found, other)),
            ..self
        }
    }

    /// About `path`, whose columns are `found`, without one named `wanted`.
    pub fn no_column(path: &Path, wanted: &str, found: &[impl AsRef<str>]) -> Self {
        let found = names_of(found);
        let message = format!("there is no column `{wanted}`; columns found: {found}");
        let number = wanted.parse::<f64>().ok();
        let hint = number.map(|_| {
            "leave it out: without columns, weights are 1 and no row has a flag".to_owned()
        });
        FileError {
            no_column: true,
            ..FileError::new(path, message).hint_if(hint)
        }
    }

    /// About `path`, a text table without names whose first row has the fields `first`: more than the columns
    /// `expected` that a table without names has.
    pub(crate) fn no_names(path: &Path, first: &[impl AsRef<str>], expected: &[&str]) -> Self {
        let message = format!(
            "{} columns have no names (found the first row `{}`, expected {}: {})",
            first.len(),
            names_of(first),
            expected.len(),
            names_of(expected)
        );
        FileError {
            no_column: true,
            ..FileError::new(path, message).hint("add a first line with the names")
        }
    }

    /// Adds a hint on where the names of columns are specified, if the fault is about columns.
    #[must_use]
    pub fn hint_of_columns(mut self, hint: &str) -> Self {
        if self.no_column {
            let last = self.hint.as_mut().unwrap_or(&mut self.message);
            *last += &format!("; {hint}");
        }
        self
    }

    /// For `map_err`: about `path`, while doing `what`.
    pub fn doing<E: Display>(path: &Path, what: &'static str) -> impl FnOnce(E) -> FileError {
        let path = path.to_owned();
        move |error| FileError::new(path, format!("{what}: {error}"))
    }
}

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
