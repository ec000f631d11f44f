//! One kind of error for everything that can be wrong with a file.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// A file that cannot be used: which, where in it, what was found and what was expected.
#[derive(Debug, Error)]
#[error("{}: {message}", path.display())]
pub struct FileError {
    /// The file.
    pub path: PathBuf,
    /// Place, what was found, what was expected.
    pub message: String,
}

impl FileError {
    /// About `path`, saying `message`.
    pub fn new(path: impl AsRef<Path>, message: impl Display) -> Self {
        FileError {
            path: path.as_ref().to_owned(),
            message: message.to_string(),
        }
    }

    /// For `map_err`: about `path`, while doing `what`.
    pub fn doing<E: Display>(path: &Path, what: &'static str) -> impl FnOnce(E) -> FileError {
        let path = path.to_owned();
        move |error| FileError::new(path, format!("{what}: {error}"))
    }
}
