//! Finding submissions by name or file, and resolving what they inherit.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::settings::{
    PartialDeconvolution, PartialDenoise, PartialNoise, PartialPsf, PartialShape, PartialStamp,
    PartialSubmission, Submission,
};

/// The commented base configuration: the defaults of every submission, and a user's template.
pub const TEMPLATE: &str = include_str!("../named/paper.toml");

/// The embedded files, in the order of the paper's Table 1.
const EMBEDDED: [(&str, &str); 10] = [
    ("paper.toml", TEMPLATE),
    (
        "subm-19-den-star.toml",
        include_str!("../named/subm-19-den-star.toml"),
    ),
    (
        "subm-23-den-func.toml",
        include_str!("../named/subm-23-den-func.toml"),
    ),
    (
        "23-den-func.toml",
        include_str!("../named/23-den-func.toml"),
    ),
    (
        "23-den-star.toml",
        include_str!("../named/23-den-star.toml"),
    ),
    (
        "23-raw-func.toml",
        include_str!("../named/23-raw-func.toml"),
    ),
    (
        "23-raw-star.toml",
        include_str!("../named/23-raw-star.toml"),
    ),
    (
        "29-den-func.toml",
        include_str!("../named/29-den-func.toml"),
    ),
    (
        "48-linear-star.toml",
        include_str!("../named/48-linear-star.toml"),
    ),
    (
        "48-linear-func.toml",
        include_str!("../named/48-linear-func.toml"),
    ),
];

/// Longest chain of `extends` followed.
const MAX_DEPTH: usize = 16;

/// Figures published for a submission.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Published {
    /// Quality factor Q.
    pub q: f64,
    /// Multiplicative bias M/2.
    pub m_half: f64,
    /// Additive bias √A in units of 10⁻⁴.
    pub sqrt_a: f64,
}

/// A resolved submission and what was published for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// All settings.
    pub submission: Submission,
    /// Published figures, where there are any.
    pub published: Option<Published>,
    /// What it directly inherits from.
    pub extends: Option<String>,
}

/// What can be wrong with a submission's name or file.
#[derive(Debug, Error)]
pub enum SubmissionError {
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
        "{path}: the key `{key}` is set neither here nor in what it extends; start from `extends = \"paper\"`"
    )]
    Missing {
        /// The file asked for.
        path: PathBuf,
        /// The key.
        key: &'static str,
    },
    /// A value out of range.
    #[error("{path}: {message}")]
    Range {
        /// The file asked for.
        path: PathBuf,
        /// The key, its value and the accepted range.
        message: String,
    },
}

/// One file as written.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    name: Option<String>,
    description: Option<String>,
    extends: Option<String>,
    #[serde(default)]
    stamp: PartialStamp,
    #[serde(default)]
    psf: PartialPsf,
    #[serde(default)]
    noise: PartialNoise,
    #[serde(default)]
    denoise: PartialDenoise,
    #[serde(default)]
    deconvolution: PartialDeconvolution,
    #[serde(default)]
    shape: PartialShape,
    published: Option<Published>,
}

impl File {
    fn parse(path: &Path, text: &str) -> Result<File, SubmissionError> {
        toml::from_str(text).map_err(|error| SubmissionError::Parse {
            path: path.to_owned(),
            message: error.to_string().trim_end().to_owned(),
        })
    }

    fn settings(self) -> PartialSubmission {
        let File {
            name: _,
            description: _,
            extends: _,
            stamp,
            psf,
            noise,
            denoise,
            deconvolution,
            shape,
            published: _,
        } = self;
        PartialSubmission {
            stamp,
            psf,
            noise,
            denoise,
            deconvolution,
            shape,
        }
    }
}

/// The embedded submissions, by name.
#[derive(Debug)]
pub struct Registry {
    names: Vec<String>,
    files: BTreeMap<String, (PathBuf, File)>,
}

impl Registry {
    /// Parses the embedded files.
    ///
    /// # Errors
    /// Where one of them is not valid, which a test rules out.
    pub fn embedded() -> Result<Self, SubmissionError> {
        let mut registry = Registry {
            names: Vec::new(),
            files: BTreeMap::new(),
        };
        for (file_name, text) in EMBEDDED {
            let path = Path::new("submissions/named").join(file_name);
            let file = File::parse(&path, text)?;
            let name = own_name(&file, &path);
            if name != "paper" {
                registry.names.push(name.clone());
            }
            registry.files.insert(name, (path, file));
        }
        Ok(registry)
    }

    /// Names of the embedded submissions, in the order of the paper's Table 1.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The submissions of the paper's Table 1 with their published figures, in its order.
    ///
    /// # Errors
    /// As [`Registry::get`].
    pub fn published(&self) -> Result<Vec<(Submission, Published)>, SubmissionError> {
        let mut found = Vec::new();
        for name in &self.names {
            let entry = self.get(name)?;
            found.extend(entry.published.map(|figures| (entry.submission, figures)));
        }
        Ok(found)
    }

    /// The submission of this name, or in this file.
    ///
    /// A name wins over a file; a path with `./` in front is always a file.
    ///
    /// # Errors
    /// Where there is no such name or file, or it or what it extends is not valid.
    pub fn get(&self, name_or_path: &str) -> Result<Entry, SubmissionError> {
        let (path, file) = self.find(name_or_path, None)?;
        let name = own_name(&file, &path);
        let description = file.description.clone().unwrap_or_default();
        let (published, extends) = (file.published, file.extends.clone());
        let mut chain = vec![name_or_path.to_owned()];
        let mut here = path.clone();
        let mut next = file.extends.clone();
        let mut settings = file.settings();
        while let Some(parent) = next {
            let again = chain.contains(&parent);
            chain.push(parent.clone());
            if again || chain.len() > MAX_DEPTH {
                return Err(SubmissionError::Cycle {
                    path,
                    chain: chain.join(" → "),
                });
            }
            let (parent_path, parent_file) = self.find(&parent, Some(&here))?;
            next = parent_file.extends.clone();
            here = parent_path;
            settings = settings.over(parent_file.settings());
        }
        let submission =
            settings
                .complete(name, description)
                .map_err(|key| SubmissionError::Missing {
                    path: path.clone(),
                    key,
                })?;
        submission
            .validate()
            .map_err(|error| SubmissionError::Range {
                path,
                message: error.to_string(),
            })?;
        Ok(Entry {
            submission,
            published,
            extends,
        })
    }

    /// The file of a name or path; paths are relative to the file `from` that names them.
    fn find(&self, name: &str, from: Option<&Path>) -> Result<(PathBuf, File), SubmissionError> {
        if let Some((path, file)) = self.files.get(name) {
            return Ok((path.clone(), file.clone()));
        }
        let path = match from.and_then(Path::parent) {
            Some(folder) => folder.join(name),
            None => PathBuf::from(name),
        };
        if !path.is_file() {
            return Err(SubmissionError::Unknown {
                from: from.map(Path::to_owned),
                name: name.to_owned(),
                known: self.names.join(", "),
            });
        }
        let text = std::fs::read_to_string(&path).map_err(|source| SubmissionError::Read {
            path: path.clone(),
            source,
        })?;
        let file = File::parse(&path, &text)?;
        Ok((path, file))
    }
}

/// The name a file gives itself, or its own name without the ending.
fn own_name(file: &File, path: &Path) -> String {
    file.name.clone().unwrap_or_else(|| {
        path.file_stem()
            .map_or_else(String::new, |s| s.to_string_lossy().into_owned())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{DenoiseMethod, PsfForm};

    fn write(folder: &Path, name: &str, text: &str) -> String {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path.to_string_lossy().into_owned()
    }

    #[test]
    fn every_embedded_submission_resolves_and_keeps_its_published_figures() {
        let registry = Registry::embedded().unwrap();
        assert_eq!(registry.names().len(), EMBEDDED.len() - 1);
        assert_eq!(registry.published().unwrap().len(), 7);
        // (name, size, denoised, star PSF, M/2, √A·10⁴, Q) of the paper's Table 1. Its "90,70" is 90.70.
        let table = [
            ("subm/19/den/star", 19, true, true, 0.0626, -0.15, 17.78),
            ("subm/23/den/func", 23, true, false, -0.0153, 0.0982, 83.16),
            ("23/den/func", 23, true, false, -0.0364, 0.09, 83.88),
            ("23/den/star", 23, true, true, 0.0357, 0.0895, 87.06),
            ("23/raw/func", 23, false, false, 0.0218, 0.103, 71.62),
            ("23/raw/star", 23, false, true, -0.0239, 0.104, 80.33),
            ("29/den/func", 29, true, false, 0.0416, 0.0771, 90.70),
        ];
        for ((name, size, den, star, m_half, sqrt_a, q), listed) in
            table.into_iter().zip(registry.names())
        {
            assert_eq!(name, listed);
            let entry = registry.get(name).unwrap();
            let s = &entry.submission;
            assert_eq!(s.stamp.size, size, "{name}");
            assert_eq!(s.psf.size, 15, "{name}");
            assert_eq!(s.denoise.method != DenoiseMethod::None, den, "{name}");
            assert_eq!(s.psf.form == PsfForm::Star, star, "{name}");
            let expected = Published { q, m_half, sqrt_a };
            assert_eq!(entry.published, Some(expected), "{name}");
        }
    }

    #[test]
    fn a_file_extends_a_name_and_another_file_but_not_published_figures() {
        let folder = tempfile::tempdir().unwrap();
        write(
            folder.path(),
            "base.toml",
            "extends = \"23/den/star\"\n[stamp]\nsize = 31\n",
        );
        let own = write(
            folder.path(),
            "own.toml",
            "extends = \"base.toml\"\n[deconvolution]\nlambda = 0.5\n",
        );
        let entry = Registry::embedded().unwrap().get(&own).unwrap();
        assert_eq!(entry.submission.name, "own");
        assert_eq!(entry.submission.stamp.size, 31);
        assert_eq!(entry.submission.deconvolution.lambda, 0.5);
        assert_eq!(
            entry.submission.denoise.method,
            DenoiseMethod::WaveletWiener
        );
        assert_eq!(entry.published, None);
    }

    #[test]
    fn settings_read_back_are_checked_like_those_of_a_file() {
        let submission = Registry::embedded().unwrap().get("23/den/star").unwrap();
        let good = toml::Table::try_from(&submission.submission).unwrap();
        let read = |table: toml::Table| table.try_into::<Submission>().map_err(|e| e.to_string());
        assert_eq!(read(good.clone()), Ok(submission.submission));
        let spoilt = |section: &str, key: &str, value: toml::Value| {
            let mut table = good.clone();
            let place = match section {
                "" => &mut table,
                section => table[section].as_table_mut().unwrap(),
            };
            place.insert(key.into(), value);
            read(table).unwrap_err()
        };
        let message = spoilt("denoise", "levels", 100_000_000.into());
        assert!(
            message.contains("`denoise.levels` is 100000000; expected 1 to 4"),
            "{message}"
        );
        let message = spoilt("denoise", "strength", (-1.0).into());
        assert!(
            message.contains("`denoise.strength` is -1; expected a positive"),
            "{message}"
        );
        assert!(spoilt("denoise", "levles", 2.into()).contains("unknown field `levles`"));
        assert!(spoilt("", "name", "a\nb".into()).contains("without control characters"));
        assert!(spoilt("", "name", "x".repeat(101).into()).contains("101 bytes"));
    }

    #[test]
    fn mistakes_are_named_with_file_and_place() {
        let folder = tempfile::tempdir().unwrap();
        let registry = Registry::embedded().unwrap();
        let message = |name: &str, text: &str| {
            let path = write(folder.path(), name, text);
            registry.get(&path).unwrap_err().to_string()
        };
        let unknown = message("a.toml", "extends = \"paper\"\n[stamp]\nsise = 23\n");
        assert!(
            unknown.contains("a.toml") && unknown.contains("line 3"),
            "{unknown}"
        );
        assert!(
            unknown.contains("sise") && unknown.contains("size"),
            "{unknown}"
        );
        let wrong_type = message("b.toml", "extends = \"paper\"\n[stamp]\nsize = \"big\"\n");
        assert!(wrong_type.contains("line 3"), "{wrong_type}");
        let range = message("c.toml", "extends = \"paper\"\n[shape]\nacf_share = 1.5\n");
        assert!(
            range.contains("shape.acf_share") && range.contains("1.5"),
            "{range}"
        );
        let missing = message("d.toml", "[stamp]\nsize = 23\n");
        assert!(missing.contains("psf.form"), "{missing}");
        let cycle = message("e.toml", "extends = \"e.toml\"\n");
        assert!(cycle.contains("circle"), "{cycle}");
        let nobody = message("f.toml", "extends = \"23/raw/stars\"\n");
        assert!(
            nobody.contains("f.toml") && nobody.contains("23/raw/star,"),
            "{nobody}"
        );
    }
}
