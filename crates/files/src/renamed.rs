//! Names in files that were replaced by others: one table, from which errors name the new one.

/// Columns of catalogues, old and new.
const COLUMNS: [(&str, &str); 3] = [
    ("flag", "flags"),
    ("response1", "R11"),
    ("response2", "R22"),
];

/// Keys of JSON and TOML files, old and new.
const KEYS: [(&str, &str); 1] = [("figures", "metrics")];

/// A hint for a file with the columns `found` that lacks the column `wanted`: its old name, if the file has that.
pub fn column_hint(wanted: &str, found: &[impl AsRef<str>]) -> Option<String> {
    let has = |name: &str| found.iter().any(|found| found.as_ref() == name);
    let &(old, new) = COLUMNS
        .iter()
        .find(|(old, new)| *new == wanted && has(old))?;
    Some(format!(
        "The column `{old}` is now called `{new}`. Try: write the catalogue again with this version"
    ))
}

/// A hint for an error of serde that names a key as missing or unknown, in the text of a file: the new name of an
/// old key.
pub fn key_hint(error: &str, text: &str) -> Option<String> {
    let named = |start: &str| error.split_once(start)?.1.split('`').next();
    let (missing, unknown) = (named("missing field `"), named("unknown field `"));
    let has = |key: &str| text.contains(&format!("\"{key}\""));
    let &(old, new) = KEYS
        .iter()
        .find(|(old, new)| unknown == Some(*old) || missing == Some(*new) && has(old))?;
    Some(format!(
        "The key `{old}` is now called `{new}`. Try: write the file again with this version"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hints_name_the_new_column_of_an_old_catalogue_only() {
        let hint = column_hint("R11", &["x", "response1"]).unwrap();
        assert!(hint.contains("`response1` is now called `R11`"), "{hint}");
        assert_eq!(column_hint("R11", &["x", "response2"]), None);
        assert_eq!(column_hint("e1", &["flag"]), None);
    }

    #[test]
    fn hints_name_the_new_key_if_the_old_one_is_there() {
        let missing = "missing field `metrics` at line 3";
        let hint = key_hint(missing, "{\"figures\": []}").unwrap();
        assert!(hint.contains("`figures` is now called `metrics`"), "{hint}");
        assert_eq!(key_hint(missing, "{}"), None);
        assert!(key_hint("unknown field `figures`, expected `metrics`", "figures = 1").is_some());
        assert_eq!(key_hint("unknown field `other`", "{\"figures\": []}"), None);
    }
}
