//! What is known of names of columns: roles, surveys and patterns, in `catalogues.toml` and in files of the user.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use serde::Deserialize;
use shearq_files::{FileError, open};
use shearq_submissions::EllipticityType;

use crate::expression::fits;
use crate::roles::{CATALOGUES, Key, Role, name_of, named, role_names};

/// The content of `catalogues.toml`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recognition {
    /// Words that name a sheared catalogue, noshear first.
    pub steps: [Vec<String>; CATALOGUES],
    /// Names of columns by role, the preferred one first.
    pub names: BTreeMap<String, Vec<String>>,
    pub ellipticity: Types,
    pub psf_size: Sizes,
    /// Columns of cuts, and whether rows of value 1 count.
    pub cuts: BTreeMap<String, bool>,
    pub patterns: Patterns,
    #[serde(rename = "survey")]
    pub surveys: Vec<Survey>,
}

/// Names of ellipticities that state their type.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Types {
    pub distortion: Vec<String>,
    /// Names of e1 that needs a response.
    pub undivided: Vec<String>,
}

/// Names of sizes of the PSF that are squares of one.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sizes {
    pub squared: Vec<String>,
}

/// Patterns of names: of their [`words`], and the last four of whole names in small letters.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Patterns {
    pub weight: Vec<String>,
    pub no_weight: Vec<String>,
    pub calibration: Vec<String>,
    pub no_calibration: Vec<String>,
    pub response: Vec<String>,
    pub no_response: Vec<String>,
    pub secondary: Vec<String>,
    pub step_size: Vec<String>,
    pub error: Vec<String>,
    pub flag: Vec<String>,
    pub no_flag: Vec<String>,
    pub choice: Vec<String>,
    pub shape: Vec<String>,
    pub truth: Vec<String>,
    pub convergence: Vec<String>,
    pub lensfit: Vec<String>,
    pub harmless: Vec<String>,
    pub not_harmless: Vec<String>,
    pub response_in_capitals: Vec<String>,
    pub step: Vec<String>,
    pub unit: Vec<String>,
    pub fixed: Vec<String>,
}

/// A public catalogue or a program's output, whose columns are known by its documentation.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Survey {
    pub name: String,
    #[serde(default)]
    pub ellipticity: EllipticityType,
    /// Columns that a catalogue must have in addition to e1 and e2.
    #[serde(default)]
    pub required: Vec<String>,
    /// The columns by role; `none` for a role that has no column although a general name is there. Those of a file of the user may
    /// be formulas.
    #[serde(deserialize_with = "columns_by_role")]
    pub columns: BTreeMap<Key, String>,
    /// The file of the user that describes it.
    #[serde(skip)]
    pub file: Option<PathBuf>,
}

// A file of --preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Presets {
    survey: Vec<Survey>,
}

fn columns_by_role<'de, D: serde::Deserializer<'de>>(
    value: D,
) -> Result<BTreeMap<Key, String>, D::Error> {
    use serde::de::Error;
    let all = BTreeMap::<String, String>::deserialize(value)?;
    let known = |(role, column): (String, String)| match named(&role) {
        Some(key) => Ok((key, column)),
        None => Err(D::Error::custom(format!(
            "unknown role (found `{role}`, expected one of {})",
            role_names()
        ))),
    };
    let all: BTreeMap<Key, String> = all.into_iter().map(known).collect::<Result<_, _>>()?;
    match ["e1", "e2"]
        .iter()
        .find(|role| named(role).is_none_or(|key| !all.contains_key(&key)))
    {
        None => Ok(all),
        Some(role) => Err(D::Error::custom(format!("no column for {role}"))),
    }
}

/// What shearq knows of names of columns.
pub fn recognition() -> &'static Recognition {
    static KNOWN: LazyLock<Recognition> = LazyLock::new(|| {
        let known = toml::from_str(include_str!("../catalogues.toml"));
        #[expect(
            clippy::expect_used,
            reason = "a test reads the file, which is a part of the program"
        )]
        known.expect("catalogues.toml")
    });
    &KNOWN
}

/// The names of columns of a role, the preferred one first.
pub fn names_of_role(role: Role) -> impl Iterator<Item = &'static str> {
    let names = recognition().names.get(&name_of((role, 0)));
    names.into_iter().flatten().map(String::as_str)
}

/// The surveys that a file describes as `[[survey]]` of `catalogues.toml` does.
pub fn read_presets(path: &Path) -> Result<Vec<Survey>, FileError> {
    let text = open::read_to_string(path, open::SETTINGS)
        .map_err(FileError::doing(path, "cannot read the surveys"))?;
    let mut presets: Presets = toml::from_str(&text)
        .map_err(|error| FileError::new(path, error.to_string().trim_end()))?;
    for survey in &mut presets.survey {
        survey.file = Some(path.to_owned());
    }
    Ok(presets.survey)
}

/// The words of a name in small letters, between underscores: `_lens_weight_` of `lensWeight`, `_g_0_` of `g[0]`.
pub fn words(name: &str) -> String {
    let (mut words, mut before) = (String::from("_"), '_');
    for c in name.chars() {
        if before.is_lowercase() && c.is_uppercase() {
            words.push('_');
        }
        match c.is_alphanumeric() {
            true => words.extend(c.to_lowercase()),
            false if words.ends_with('_') => {}
            false => words.push('_'),
        }
        before = c;
    }
    match words.ends_with('_') {
        true => words,
        false => words + "_",
    }
}

/// Whether the words of a name have one of these patterns.
pub fn has_any(patterns: &[String], name: &str) -> bool {
    let words = words(name);
    patterns.iter().any(|pattern| fits(pattern, &words))
}

/// Whether a name, in any case, has one of these patterns.
pub fn fits_any(patterns: &[String], name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    patterns.iter().any(|pattern| fits(pattern, &name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_role_and_no_other_has_names() {
        let known = recognition();
        let roles = role_names();
        let steps = ["1p", "1m", "2p", "2m"];
        let unsheared = |role: &&str| !steps.iter().any(|step| role.ends_with(step));
        let mut roles: Vec<&str> = roles.split(", ").filter(unsheared).collect();
        roles.sort_unstable();
        assert_eq!(known.names.keys().collect::<Vec<_>>(), roles);
        assert_eq!(known.surveys.len(), 23);
    }

    #[test]
    fn presets_of_users_are_read_and_wrong_keys_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("own.toml");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            read_presets(&path).map_err(|error| error.to_string())
        };
        let good = "[[survey]]\nname = \"Own\"\nrequired = [\"wl\"]\n[survey.columns]\ne1 = \"a\"\ne2 = \"b\"\nw = \"wl\"\n";
        let own = read(good).unwrap();
        assert_eq!(own[0].columns[&(Role::Weight, 0)], "wl");
        for (from, to, expected) in [
            ("w = ", "weights = ", "found `weights`"),
            ("name = ", "title = ", "title"),
            ("e2 = \"b\"\n", "", "no column for e2"),
        ] {
            let error = read(&good.replace(from, to)).unwrap_err();
            assert!(
                error.contains(expected) && error.contains("own.toml"),
                "{error}"
            );
        }
    }
}
