//! Names of configurations and methods: they end up in tables, figures, file names and on terminals, and
//! often come from files of others.

use serde::{Deserialize, Deserializer};

use crate::error::ConfigurationError;

/// Longest name, in bytes: file names are made with it.
pub const MAX_NAME: usize = 100;

/// Checks a name: 1 to [`MAX_NAME`] bytes, none of them of a control character.
///
/// # Errors
/// [`ConfigurationError::Name`].
pub fn check_name(name: &str) -> Result<(), ConfigurationError> {
    if (1..=MAX_NAME).contains(&name.len()) && !name.contains(is_control) {
        return Ok(());
    }
    Err(ConfigurationError::Name {
        found: shown(name),
        expected: EXPECTED,
    })
}

/// The beginning of a name, with its control characters written out.
pub(crate) fn shown(name: &str) -> String {
    let escape = |c: char| match is_control(c) {
        true => c.escape_unicode().to_string(),
        false => c.to_string(),
    };
    let start: String = name.chars().take(MAX_NAME).map(escape).collect();
    format!("\"{start}\" ({} bytes)", name.len())
}

/// What a name must be.
pub(crate) const EXPECTED: &str = "1 to 100 bytes without control characters";

/// For `#[serde(deserialize_with)]`: reads a name and checks it.
///
/// # Errors
/// Where it is no text, or [`check_name`] refuses it.
pub fn checked_name<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let name = String::deserialize(deserializer)?;
    check_name(&name).map_err(serde::de::Error::custom)?;
    Ok(name)
}

// As `visible` in shearq-render escapes; a test of the command line compares them. Names are printed unescaped in figures.
fn is_control(c: char) -> bool {
    c.is_control()
        || matches!(
            c,
            '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}'
        )
        || matches!(c, '\u{fffe}' | '\u{ffff}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_bounded_and_hold_nothing_that_acts() {
        for good in [
            "a",
            "23/den/star",
            "λ ≥ 2 | <b> \\ $x$",
            &"x".repeat(MAX_NAME),
        ] {
            assert!(check_name(good).is_ok(), "{good}");
        }
        let long = "x".repeat(MAX_NAME + 1);
        for bad in [
            "",
            "a\nb",
            "a\u{1b}[2J",
            "a\u{202e}b",
            "a\u{9b}b",
            "a\u{7f}",
            &long,
        ] {
            let message = check_name(bad).unwrap_err().to_string();
            assert!(!message.contains(is_control), "{message:?}");
        }
    }
}
