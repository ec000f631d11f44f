//! Finding submissions by name or file, and resolving what they inherit.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::error::ConfigurationError;
use crate::file::{File, Published, dead_keys, read};
use crate::settings::{Configuration, PartialConfiguration};

/// The commented configuration that the submissions with the network rest on.
pub(crate) const NETWORK: &str = include_str!("../named/paper.toml");
/// The same of those with the linear method.
pub(crate) const LINEAR: &str = include_str!("../named/48-linear-star.toml");

/// The embedded files, in the order of the paper's Table 1, then those it does not have.
const EMBEDDED: [(&str, &str); 14] = [
    ("paper.toml", NETWORK),
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
    ("48-linear-star.toml", LINEAR),
    (
        "48-linear-func.toml",
        include_str!("../named/48-linear-func.toml"),
    ),
    (
        "as-printed-paper.toml",
        include_str!("../named/as-printed-paper.toml"),
    ),
    (
        "as-printed-23-raw-star.toml",
        include_str!("../named/as-printed-23-raw-star.toml"),
    ),
    (
        "as-printed-23-den-star.toml",
        include_str!("../named/as-printed-23-den-star.toml"),
    ),
    (
        "as-printed-29-den-func.toml",
        include_str!("../named/as-printed-29-den-func.toml"),
    ),
];

/// Those that others rest on, which are not listed.
const BASES: [&str; 2] = ["paper", "as-printed/paper"];

/// Longest chain of `extends` followed.
const MAX_DEPTH: usize = 16;

/// A resolved submission and what was published for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// All settings.
    pub configuration: Configuration,
    /// Published figures, where there are any.
    pub published: Option<Published>,
    /// What it directly inherits from.
    pub extends: Option<String>,
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
    pub fn embedded() -> Result<Self, ConfigurationError> {
        let mut registry = Registry {
            names: Vec::new(),
            files: BTreeMap::new(),
        };
        for (file_name, text) in EMBEDDED {
            let path = Path::new("submissions/named").join(file_name);
            let file = File::parse(&path, text)?;
            let name = own_name(&file, &path);
            if !BASES.contains(&name.as_str()) {
                registry.names.push(name.clone());
            }
            registry.files.insert(name, (path, file));
        }
        Ok(registry)
    }

    /// Names of the embedded submissions, in the order of the paper's Table 1, then those it does not have.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The submissions of the paper's Table 1 with their published figures, in its order.
    ///
    /// # Errors
    /// As [`Registry::get`].
    pub fn published(&self) -> Result<Vec<(Configuration, Published)>, ConfigurationError> {
        let mut found = Vec::new();
        for name in &self.names {
            let entry = self.get(name)?;
            found.extend(
                entry
                    .published
                    .map(|figures| (entry.configuration, figures)),
            );
        }
        Ok(found)
    }

    /// The submission of this name, or in this file.
    ///
    /// A name wins over a file; a path with `./` in front is always a file.
    ///
    /// # Errors
    /// Where there is no such name or file, or it or what it extends is not valid.
    pub fn get(&self, name_or_path: &str) -> Result<Entry, ConfigurationError> {
        let link = self.find(name_or_path, None)?;
        let file = link.text.is_some().then(|| link.path.clone());
        let entry = self.entry(link, name_or_path)?;
        match file {
            Some(path) => self.distinct(path, entry),
            None => Ok(entry),
        }
    }

    /// Refuses a file with the name of a known configuration and other settings: tables and stores would show two methods
    /// of one name.
    fn distinct(&self, path: PathBuf, entry: Entry) -> Result<Entry, ConfigurationError> {
        let own = &entry.configuration;
        if !self.files.contains_key(&own.name) {
            return Ok(entry);
        }
        let known = self.get(&own.name)?.configuration;
        let table = |configuration| toml::Table::try_from(configuration).unwrap_or_default();
        match difference(&table(own), &table(&known)) {
            None => Ok(entry),
            Some(difference) => Err(ConfigurationError::Taken {
                path,
                name: own.name.clone(),
                difference,
            }),
        }
    }

    /// The submission of a settings file with this text. Errors speak of it as `path`, after which it is named
    /// where it does not name itself, and relative to which it finds files that it extends.
    ///
    /// # Errors
    /// Where the text, or what it extends, is not valid.
    pub fn get_text(&self, path: &Path, text: &str) -> Result<Entry, ConfigurationError> {
        let link = Link {
            file: File::parse(path, text)?,
            path: path.to_owned(),
            text: Some(text.to_owned()),
        };
        self.entry(link, &path.to_string_lossy())
    }

    /// What a file, called `asked`, resolves to.
    fn entry(&self, link: Link, asked: &str) -> Result<Entry, ConfigurationError> {
        let (published, extends) = (link.file.published, link.file.extends.clone());
        let (path, name) = (link.path.clone(), own_name(&link.file, &link.path));
        let description = link.file.description.clone().unwrap_or_default();
        let settings = self.resolve(link, &mut vec![asked.to_owned()])?;
        let configuration =
            settings
                .complete(name, description)
                .map_err(|key| ConfigurationError::Missing {
                    path: path.clone(),
                    key,
                })?;
        configuration
            .validate()
            .map_err(|error| ConfigurationError::Range { path, error })?;
        Ok(Entry {
            configuration,
            published,
            extends,
        })
    }

    /// The settings of a file over those of what it extends. Its own keys have to be of use.
    fn resolve(
        &self,
        link: Link,
        chain: &mut Vec<String>,
    ) -> Result<PartialConfiguration, ConfigurationError> {
        let Link { path, file, text } = link;
        let base = match file.extends.clone() {
            None => PartialConfiguration::default(),
            Some(parent) => {
                let again = chain.contains(&parent);
                chain.push(parent.clone());
                if again || chain.len() > MAX_DEPTH {
                    let chain = chain.join(" → ");
                    return Err(ConfigurationError::Cycle { path, chain });
                }
                self.resolve(self.find(&parent, Some(&path))?, chain)?
            }
        };
        let settings = file.settings().over(base);
        if let Some(text) = text
            && let Ok(configuration) = settings.complete(String::new(), String::new())
            && let Some(dead) = dead_keys(&text, &configuration).into_iter().next()
        {
            return Err(ConfigurationError::Dead {
                path,
                line: dead.line,
                key: dead.key,
                reason: dead.reason,
            });
        }
        Ok(settings)
    }

    /// The file of a name or path; paths are relative to the file `from` that names them.
    fn find(&self, name: &str, from: Option<&Path>) -> Result<Link, ConfigurationError> {
        if let Some((path, file)) = self.files.get(name) {
            return Ok(Link {
                path: path.clone(),
                file: file.clone(),
                text: None,
            });
        }
        let path = match from.and_then(Path::parent) {
            Some(folder) => folder.join(name),
            None => PathBuf::from(name),
        };
        if !path.is_file() {
            return Err(ConfigurationError::Unknown {
                from: from.map(Path::to_owned),
                name: name.to_owned(),
                known: self.names.join(", "),
            });
        }
        let text = read(&path)?;
        Ok(Link {
            file: File::parse(&path, &text)?,
            path,
            text: Some(text),
        })
    }
}

/// The path that errors about a text without a file name.
const TEXT: &str = "settings";

impl FromStr for Configuration {
    type Err = ConfigurationError;

    /// The configuration of a TOML text, as of a settings file. `extends` names an embedded configuration, or a file
    /// relative to the working folder. A text without a name has the name `settings`.
    fn from_str(text: &str) -> Result<Self, ConfigurationError> {
        let entry = Registry::embedded()?.get_text(Path::new(TEXT), text)?;
        Ok(entry.configuration)
    }
}

/// One file of a chain.
struct Link {
    path: PathBuf,
    file: File,
    /// Text of a user's own file. Embedded ones hold values in stand-by for those who extend them.
    text: Option<String>,
}

/// The name a file gives itself, or its own name without the ending.
fn own_name(file: &File, path: &Path) -> String {
    file.name.clone().unwrap_or_else(|| {
        path.file_stem()
            .map_or_else(String::new, |s| s.to_string_lossy().into_owned())
    })
}

/// The first setting that differs, in words. A description changes no result.
fn difference(own: &toml::Table, known: &toml::Table) -> Option<String> {
    let keys: BTreeSet<&String> = own.keys().chain(known.keys()).collect();
    keys.into_iter().find_map(|key| {
        let (found, expected) = (own.get(key), known.get(key));
        if found == expected || key == "description" {
            return None;
        }
        if let (Some(toml::Value::Table(found)), Some(toml::Value::Table(expected))) =
            (found, expected)
        {
            return difference(found, expected).map(|inner| format!("{key}.{inner}"));
        }
        let shown =
            |value: Option<&toml::Value>| value.map_or("absent".into(), ToString::to_string);
        Some(format!(
            "{key}: found {}, expected {}",
            shown(found),
            shown(expected)
        ))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Denoise, LinearDeconvolution, Method, NetworkMethod, NoiseSource, PsfForm};

    fn write(folder: &Path, name: &str, text: &str) -> String {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path.to_string_lossy().into_owned()
    }

    #[test]
    fn every_embedded_submission_resolves_and_keeps_its_published_figures() {
        let registry = Registry::embedded().unwrap();
        assert_eq!(registry.names().len(), EMBEDDED.len() - BASES.len());
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
            let s = &entry.configuration;
            assert_eq!(s.stamp.size, size, "{name}");
            assert_eq!(s.psf.size, 15, "{name}");
            assert_eq!(s.wavelet().is_some(), den, "{name}");
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
        assert_eq!(entry.configuration.name, "own");
        assert_eq!(entry.configuration.stamp.size, 31);
        let network = entry.configuration.network().unwrap();
        assert_eq!(network.deconvolution.lambda, 0.5);
        assert!(entry.configuration.wavelet().is_some());
        assert_eq!(entry.published, None);
    }

    #[test]
    fn files_with_the_name_of_a_known_configuration_have_its_settings() {
        let folder = tempfile::tempdir().unwrap();
        let registry = Registry::embedded().unwrap();
        let read = |file: &str, text: &str| {
            let path = write(folder.path(), file, text);
            registry.get(&path).map_err(|error| error.to_string())
        };
        let named = "name = \"48/linear/star\"\n";
        let other = format!("{named}extends = \"23/raw/star\"\n");
        let error = read("own.toml", &other).unwrap_err();
        assert!(
            error.contains("own.toml: the name `48/linear/star` is that of a known"),
            "{error}"
        );
        let changed = format!("{named}extends = \"48/linear/star\"\n[stamp]\nsize = 40\n");
        let error = read("own.toml", &changed).unwrap_err();
        assert!(
            error.contains("(stamp.size: found 40, expected 48). Try: another"),
            "{error}"
        );
        // The bases, which are not listed, have names too; a file without one has the name of its path.
        assert!(read("paper.toml", "extends = \"48/linear/star\"\n").is_err());
        let same = format!("{named}extends = \"48/linear/star\"\ndescription = \"mine\"\n");
        assert_eq!(
            read("own.toml", &same).unwrap().configuration.name,
            "48/linear/star"
        );
    }

    #[test]
    fn a_text_is_read_like_the_file_that_would_hold_it() {
        let folder = tempfile::tempdir().unwrap();
        let registry = Registry::embedded().unwrap();
        let text = "extends = \"48/linear/star\"\n[noise]\nsource = \"border\"\n";
        let path = PathBuf::from(write(folder.path(), "own.toml", text));
        let file = registry.get(&path.to_string_lossy()).unwrap();
        assert_eq!(registry.get_text(&path, text).unwrap(), file);
        let wrong = registry.get_text(&path, "extends = \"paper\"\n[stamp]\nsise = 2\n");
        let message = wrong.unwrap_err().to_string();
        assert!(
            message.contains("own.toml") && message.contains("line 3"),
            "{message}"
        );
    }

    #[test]
    fn a_file_without_extends_has_all_settings() {
        let registry = Registry::embedded().unwrap();
        let configuration = registry.get("48/linear/star").unwrap().configuration;
        let text = toml::to_string(&configuration).unwrap();
        assert_eq!(text.parse::<Configuration>().unwrap(), configuration);
        for key in ["half_snr", "sheared_step", "neighbours"] {
            let less: Vec<&str> = text.lines().filter(|line| !line.starts_with(key)).collect();
            let error = less.join("\n").parse::<Configuration>().unwrap_err();
            assert!(
                error.to_string().contains(&format!("shape.{key}")),
                "{error}"
            );
        }
    }

    #[test]
    fn a_configuration_is_parsed_from_text_and_checked() {
        let own = "extends = \"48/linear/star\"\n[noise]\nsource = \"border\"\n";
        let own: Configuration = own.parse().unwrap();
        assert_eq!(own.name, "settings");
        assert_eq!(own.noise, NoiseSource::Border { border: 4 });
        let text = toml::to_string(&own).unwrap();
        assert_eq!(text.parse::<Configuration>().unwrap(), own);
        let wrong = "extends = \"48/linear/star\"\n[deconvolution]\nwindow_sigma = -6\n";
        let error = wrong.parse::<Configuration>().unwrap_err();
        assert!(
            matches!(&error, ConfigurationError::Range { error, .. } if error.key == "deconvolution.window_sigma"),
            "{error}"
        );
    }

    #[test]
    fn settings_made_in_code_are_checked() {
        let registry = Registry::embedded().unwrap();
        let linear = |change: fn(&mut LinearDeconvolution)| {
            let mut configuration = registry.get("48/linear/star").unwrap().configuration;
            if let Method::Linear(linear) = &mut configuration.method {
                change(&mut linear.deconvolution);
            }
            configuration.validate().map_err(|error| error.key)
        };
        assert_eq!(linear(|_| {}), Ok(()));
        assert_eq!(
            linear(|d| d.window_sigma = -6.0),
            Err("deconvolution.window_sigma")
        );
        assert_eq!(
            linear(|d| d.target_sigma = 1e9),
            Err("deconvolution.target_sigma")
        );
        let mut network = registry.get("23/den/star").unwrap().configuration;
        if let Method::Network(NetworkMethod {
            denoise: Denoise::WaveletWiener(wavelet),
            ..
        }) = &mut network.method
        {
            wavelet.levels = 60;
        }
        let error = network.validate().unwrap_err();
        assert_eq!((error.key, error.found.as_str()), ("denoise.levels", "60"));
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
        let dead = |text: &str, expected: &str| {
            let found = message("dead.toml", text);
            assert!(
                found.contains("dead.toml") && found.contains(expected),
                "{found}"
            );
        };
        dead(
            "extends = \"48/linear/star\"\n[shape]\nacf_share = 0.5\n",
            "line 3: `shape.acf_share` is not used when method = \"linear\"",
        );
        dead(
            "extends = \"48/linear/star\"\n[noise]\nborder = 3\n",
            "line 3: `noise.border` is not used when noise.source = \"image\"",
        );
        dead(
            "extends = \"23/raw/star\"\ndenoise = { levels = 2 }\n",
            "line 2: `denoise.levels` is not used when denoise.method = \"none\"",
        );
        dead(
            "extends = \"23/raw/star\"\n[shape]\ncalibration = \"response\"\n",
            "line 3: `shape.calibration` is not used when method = \"network\"",
        );
        let child = "extends = \"dead.toml\"\n[stamp]\nsize = 29\n";
        assert!(message("child.toml", child).contains("dead.toml: line 3"));
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

    #[test]
    fn only_what_the_method_uses_is_stored_and_it_is_read_back() {
        let registry = Registry::embedded().unwrap();
        for name in registry.names() {
            let configuration = registry.get(name).unwrap().configuration;
            let table = toml::Table::try_from(&configuration).unwrap();
            let linear = configuration.linear().is_some();
            assert_eq!(table.contains_key("denoise"), !linear, "{name}");
            let keys = ["target_sigma", "unit_divisor"];
            let held = keys.map(|key| table["deconvolution"].get(key).is_some());
            assert_eq!(held, [linear, !linear], "{name}");
            let text = toml::to_string(&configuration).unwrap();
            assert_eq!(
                toml::from_str::<Configuration>(&text).unwrap(),
                configuration
            );
        }
    }

    #[test]
    fn a_file_can_change_its_method_and_where_its_noise_comes_from() {
        let folder = tempfile::tempdir().unwrap();
        let registry = Registry::embedded().unwrap();
        let own = write(
            folder.path(),
            "own.toml",
            "extends = \"48/linear/star\"\n[noise]\nsource = \"border\"\n",
        );
        let noise = registry.get(&own).unwrap().configuration.noise;
        assert_eq!(noise, NoiseSource::Border { border: 4 });
        let text = "extends = \"23/den/star\"\nmethod = \"linear\"\n";
        let own = write(folder.path(), "own.toml", text);
        let message = registry.get(&own).unwrap_err().to_string();
        assert!(
            message.contains("`deconvolution.target_sigma` is set"),
            "{message}"
        );
    }
}
