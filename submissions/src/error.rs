//! What can be wrong with a submission.

use std::path::PathBuf;

use thiserror::Error;

use crate::validate::OutOfRange;

/// What can be wrong with a submission's name or file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigurationError {
    /// Neither a known name nor a file.
    #[error("{}there is no submission or file named `{name}`; known submissions: {known}", from.as_ref().map_or_else(String::new, |from| format!("{}: `extends`: ", from.display())))]
    Unknown {
        /// The file that names it, if one does.
        from: Option<PathBuf>,
        /// What was asked for.
        name: String,
        /// The names that exist.
        known: String,
    },
    /// A file that cannot be read.
    #[error("cannot read the submission file {path}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of the wrong type.
    #[error("in the submission file {path}: {message}")]
    Parse {
        /// The file.
        path: PathBuf,
        /// Line, column and what was expected.
        message: String,
    },
    /// A file that inherits from itself.
    #[error("{path}: `extends` goes round in a circle: {chain}")]
    Cycle {
        /// The file asked for.
        path: PathBuf,
        /// The names followed.
        chain: String,
    },
    /// A key that no file of the chain sets.
    #[error(
        "{path}: the key `{key}` is set neither here nor in what it extends; start from `extends = \"paper\"` or `extends = \"48/linear/star\"`"
    )]
    Missing {
        /// The file asked for.
        path: PathBuf,
        /// The key.
        key: &'static str,
    },
    /// A name that cannot be one.
    #[error("the name is {found}; expected {expected}")]
    Name {
        /// Its beginning and length.
        found: String,
        /// What a name must be.
        expected: &'static str,
    },
    /// A value of a file that is out of range.
    #[error("{path}: {error}")]
    Range {
        /// The file asked for.
        path: PathBuf,
        /// The key, its value and the accepted range.
        error: OutOfRange,
    },
    /// A value set in code that is out of range.
    #[error(transparent)]
    Setting(#[from] OutOfRange),
    /// A key that the method does not use.
    #[error("{path}: line {line}: `{key}` has no effect with {reason}; expected no such key")]
    Dead {
        /// The file.
        path: PathBuf,
        /// The line of the key.
        line: usize,
        /// The key.
        key: String,
        /// The setting that turns it off.
        reason: String,
    },
}
