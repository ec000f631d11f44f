//! Faults of configurations: names, files and settings.

use std::path::PathBuf;

use thiserror::Error;

/// A setting with a value out of its range.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("`{key}` is {found}; expected {expected}")]
#[non_exhaustive]
pub struct OutOfRange {
    /// The key as a settings file has it, such as `denoise.levels`.
    pub key: &'static str,
    /// The value, as a settings file would have it.
    pub found: String,
    /// The accepted range.
    pub expected: String,
}

/// What is wrong with a setting. Keys are written as in `denoise.levels`.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum SettingError {
    /// A key that no method has.
    #[error("there is no setting `{key}`; expected {expected}")]
    UnknownKey {
        /// The key.
        key: String,
        /// The keys that its section has.
        expected: String,
    },
    /// A value of another type, or a word that is none of the accepted ones.
    #[error("`{key}` is {found}; {expected}")]
    Value {
        /// The key.
        key: String,
        /// The value, as the file has it.
        found: String,
        /// What the reader says about it, with what it expected.
        expected: String,
    },
    /// A key that no file of the chain sets.
    #[error("the key `{key}` is set neither here nor in what it extends; start from {bases}")]
    Missing {
        /// The key.
        key: String,
        /// The lines that extend configurations with this key.
        bases: &'static str,
    },
    /// A key that the method does not use.
    #[error("`{key}` is not used when {reason}; remove it")]
    Unused {
        /// The key.
        key: String,
        /// The setting that turns it off.
        reason: String,
    },
    /// A value that is out of range.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
}

impl SettingError {
    /// The key that is wrong.
    pub fn key(&self) -> &str {
        match self {
            SettingError::UnknownKey { key, .. }
            | SettingError::Value { key, .. }
            | SettingError::Missing { key, .. }
            | SettingError::Unused { key, .. } => key,
            SettingError::OutOfRange(error) => error.key,
        }
    }
}

/// A fault in the name or file of a configuration.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigurationError {
    /// Neither a known name nor a file.
    #[error("{}there is no configuration or file named `{name}`; known configurations: {known}", from.as_ref().map_or_else(String::new, |from| format!("{}: `extends`: ", from.display())))]
    Unknown {
        /// The file that names it, if one does.
        from: Option<PathBuf>,
        /// The name that was given.
        name: String,
        /// The names that exist.
        known: String,
    },
    /// A file that cannot be read.
    #[error("cannot read the configuration file {path}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// Not TOML, or too long for settings.
    #[error("in the configuration file {path}: {message}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, column and what was expected.
        message: String,
    },
    /// A file that inherits from itself.
    #[error("{path}: `extends` goes round in a circle: {chain}")]
    Cycle {
        /// The file that was given.
        path: PathBuf,
        /// The names followed.
        chain: String,
    },
    /// A name that cannot be one.
    #[error("the name is {found}; expected {expected}")]
    Name {
        /// The beginning of the name, and its length.
        found: String,
        /// The expected form.
        expected: &'static str,
    },
    /// A file with the name of a known configuration, but other settings.
    #[error("{path}: the name `{name}` is that of a known configuration with other settings ({difference}). Try: another `name`", path = path.display())]
    Taken {
        /// The file.
        path: PathBuf,
        /// The name.
        name: String,
        /// The first setting that differs.
        difference: String,
    },
    /// A setting of a file that is wrong.
    #[error("{path}: {}{error}", line.map_or_else(String::new, |line| format!("line {line}: ")))]
    Setting {
        /// The file that was given.
        path: PathBuf,
        /// The line, if this file sets the key.
        line: Option<usize>,
        /// What is wrong with it.
        error: SettingError,
    },
    /// A value set in code that is out of range.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
}
