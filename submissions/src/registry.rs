//! Configurations by name or by file. A file inherits by `extends`: the tables of the chain are merged key by key, and serde
//! reads the merged table once.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::LazyLock;

use serde::{Deserialize, Deserializer, Serialize};
use toml::de::DeTable;
use toml::{Table, Value};

use crate::error::{ConfigurationError, SettingError};
use crate::settings::{Configuration, DetectionMethod, Method};

// The files with a comment on each key, from which `submissions init` makes a user's file. Together they have every key of
// both methods, and so define which keys exist.
const NETWORK_TEMPLATE: &str = include_str!("../named/paper.toml");
const LINEAR_TEMPLATE: &str = include_str!("../named/48-linear-star.toml");

macro_rules! embedded {
    ($($file:literal,)*) => {
        [$(($file, include_str!(concat!("../named/", $file)))),*]
    };
}

// In the order of the paper's Table 1, then the configurations that it does not have: tables list them in this order.
const EMBEDDED: [(&str, &str); 16] = embedded![
    "paper.toml",
    "subm-19-den-star.toml",
    "subm-23-den-func.toml",
    "23-den-func.toml",
    "23-den-star.toml",
    "23-raw-func.toml",
    "23-raw-star.toml",
    "29-den-func.toml",
    "48-linear-star.toml",
    "48-linear-func.toml",
    "48-linear-survey.toml",
    "48-linear-centroid.toml",
    "as-printed-paper.toml",
    "as-printed-23-raw-star.toml",
    "as-printed-23-den-star.toml",
    "as-printed-29-den-func.toml",
];

// Not in lists and tables: these have the settings that other embedded files share, and are no rows of Table 1.
const UNLISTED_BASES: [&str; 2] = ["paper", "as-printed/paper"];

// Files that one configuration may extend in turn. Chosen by hand: embedded chains have two.
const MAX_EXTENDS: usize = 16;

// A thousand times the text of all settings: a data file given by mistake is refused before it fills the memory.
const MAX_FILE_BYTES: u64 = 1 << 20;

// Stands for the path in errors about a text that was given without a file, and is its name if the text states none.
const UNNAMED_TEXT: &str = "settings";

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

/// A resolved configuration and what was published for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// All settings.
    pub configuration: Configuration,
    /// Published figures, where there are any.
    pub published: Option<Published>,
    /// The name or path that its `extends` states.
    pub extends: Option<String>,
}

// The keys of a file that describe it. They are not inherited: another file is another method.
#[derive(Debug, Clone, Deserialize)]
struct Head {
    name: Option<String>,
    description: Option<String>,
    extends: Option<String>,
    published: Option<Published>,
}

#[derive(Debug, Clone)]
struct File {
    path: PathBuf,
    head: Head,
    settings: Table,
    // The text of a user's file, for line numbers in errors; `None` for embedded files. Only users' files are refused for
    // keys without effect: an embedded base may set, for instance, a denoiser that only its variants turn on.
    text: Option<String>,
}

impl File {
    fn parse(path: &Path, text: &str) -> Result<Self, ConfigurationError> {
        let syntax = |error: toml::de::Error| ConfigurationError::Syntax {
            path: path.to_owned(),
            message: error.to_string().trim_end().to_owned(),
        };
        let mut settings: Table = toml::from_str(text).map_err(syntax)?;
        for key in ["name", "description", "extends", "published"] {
            settings.remove(key);
        }
        Ok(File {
            path: path.to_owned(),
            head: toml::from_str(text).map_err(syntax)?,
            settings,
            text: None,
        })
    }

    fn of_user(path: &Path, text: String) -> Result<Self, ConfigurationError> {
        let file = File::parse(path, &text)?;
        let text = Some(text);
        Ok(File { text, ..file })
    }

    // As the file states, else the file's name without its ending.
    fn name(&self) -> String {
        let stem = || self.path.file_stem().unwrap_or_default();
        let own = self.head.name.clone();
        own.unwrap_or_else(|| stem().to_string_lossy().into_owned())
    }

    fn fault(&self, error: SettingError) -> ConfigurationError {
        let text = self.text.as_deref();
        ConfigurationError::Setting {
            path: self.path.clone(),
            line: text.and_then(|text| line_of(text, error.key())),
            error,
        }
    }
}

// The line that sets `key`, such as `denoise.levels`. serde's errors state no line, because the tables of several files are
// merged before it reads them; the parser keeps the place of each key.
fn line_of(text: &str, key: &str) -> Option<usize> {
    let file = DeTable::parse(text).ok()?;
    let (section, inner) = key.split_once('.').unwrap_or((key, ""));
    let (name, value) = file
        .get_ref()
        .iter()
        .find(|(k, _)| k.get_ref() == section)?;
    let inner = value.get_ref().as_table().and_then(|keys| {
        let mut keys = keys.keys();
        keys.find(|name| name.get_ref() == inner)
    });
    let start = inner.unwrap_or(name).span().start;
    Some(1 + text[..start].matches('\n').count())
}

// Key by key in each section: a file that sets one key of a section inherits the others.
fn merge(mut base: Table, own: &Table) -> Table {
    for (key, value) in own {
        let merged = match (base.remove(key), value) {
            (Some(Value::Table(base)), Value::Table(own)) => Value::Table(merge(base, own)),
            _ => value.clone(),
        };
        base.insert(key.clone(), merged);
    }
    base
}

// Every key of every method, with values that are valid for the linear method. It takes the place of a list of keys in code,
// which could differ from the templates.
static ALL_KEYS: LazyLock<Table> = LazyLock::new(|| {
    // Embedded files are valid, which a test checks, so that defaults are never used.
    let settings = |text| File::parse(Path::new(UNNAMED_TEXT), text).map(|file| file.settings);
    let network = settings(NETWORK_TEMPLATE).unwrap_or_default();
    merge(network, &settings(LINEAR_TEMPLATE).unwrap_or_default())
});

/// Every key that settings may have. Only records of runs have the method of exposures, which no file extends.
fn known_keys(settings: &Table) -> Table {
    let mut known = ALL_KEYS.clone();
    if settings.get("method").and_then(Value::as_str) == Some("detection") {
        let section = Table::try_from(DetectionMethod::default()).unwrap_or_default();
        known.insert("detection".into(), Value::Table(section));
    }
    known
}

// Keys in sections as `section.key`, as users write them in messages and options.
fn leaves(table: &Table) -> Vec<(String, &Value)> {
    let mut found = Vec::new();
    for (name, value) in table {
        match value {
            Value::Table(section) => {
                let key = |(key, value)| (format!("{name}.{key}"), value);
                found.extend(section.iter().map(key));
            }
            value => found.push((name.clone(), value)),
        }
    }
    found
}

fn get<'t>(table: &'t Table, key: &str) -> Option<&'t Value> {
    match key.split_once('.') {
        Some((section, key)) => table.get(section)?.get(key),
        None => table.get(key),
    }
}

fn refuse_unknown_keys(settings: &Table) -> Result<(), SettingError> {
    let all = known_keys(settings);
    let listed = |table: &Table| table.keys().cloned().collect::<Vec<_>>().join(", ");
    for (key, value) in settings {
        let unknown = |key: String, of: &Table| SettingError::UnknownKey {
            key,
            expected: listed(of),
        };
        match (all.get(key), value) {
            (None, _) => return Err(unknown(key.clone(), &all)),
            (Some(Value::Table(known)), Value::Table(keys)) => {
                if let Some(inner) = keys.keys().find(|inner| !known.contains_key(*inner)) {
                    return Err(unknown(format!("{key}.{inner}"), known));
                }
            }
            (Some(Value::Table(known)), value) => {
                return Err(SettingError::Value {
                    key: key.clone(),
                    found: value.to_string(),
                    expected: format!("expected a section with {}", listed(known)),
                });
            }
            _ => {}
        }
    }
    Ok(())
}

// Configurations that records of runs contain, as JSON or TOML. They are read through a table, like files, to refuse unknown
// keys: serde's `deny_unknown_fields` does not work with `flatten`, which puts the sections of the method at the top level.
impl<'de> Deserialize<'de> for Configuration {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        configuration_of(Table::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

fn configuration_of(mut table: Table) -> Result<Configuration, SettingError> {
    let mut own = Table::new();
    for key in ["name", "description"] {
        let missing = || SettingError::Missing {
            key: key.into(),
            bases: "`extends = \"paper\"` or `extends = \"48/linear/star\"`",
        };
        own.insert(key.into(), table.remove(key).ok_or_else(missing)?);
    }
    // Stored results contain these, but they do not change a measurement.
    table.remove("published");
    table.remove("extends");
    refuse_unknown_keys(&table)?;
    let over = |base: Table, settings: &Table| {
        Configuration::from_table(merge(merge(base, settings), &own))
    };
    // serde stops at the first fault and does not say whether a key is missing or a value is wrong. Merged over valid values
    // of all keys, none is missing, so a failure is a wrong value; what fails only without them is a missing key.
    let configuration =
        over(known_keys(&table), &table).map_err(|error| wrong_value(&own, &table, error))?;
    if over(Table::new(), &table).is_err() {
        let used = Table::try_from(&configuration).unwrap_or_default();
        // The method determines which other keys are required, so it is reported first.
        let keys = leaves(&used).into_iter().map(|(key, _)| key);
        let mut keys = std::iter::once("method".to_owned()).chain(keys);
        let missing = keys.find(|key| get(&table, key).is_none() && get(&own, key).is_none());
        let key = missing.unwrap_or_default();
        // Of the two methods only one has the key, and the file may extend the other.
        let bases = match (key.as_str(), &configuration.method) {
            ("method", _) => "`extends = \"paper\"` or `extends = \"48/linear/star\"`",
            (_, Method::Network(_)) => "`extends = \"paper\"`",
            (_, Method::Linear(_) | Method::Detection { .. }) => "`extends = \"48/linear/star\"`",
        };
        return Err(SettingError::Missing { key, bases });
    }
    configuration.validate()?;
    Ok(configuration)
}

// The value that serde refused with `error`. serde buffers sections with `flatten` and tags, and loses the place of their
// errors, so each value is tried alone among valid ones.
fn wrong_value(own: &Table, settings: &Table, error: toml::de::Error) -> SettingError {
    let tags = ["method", "noise.source", "denoise.method"];
    let mut tried = merge(known_keys(settings), own);
    let mut keys = leaves(settings);
    // These choose the variant, and with it the other keys that serde reads, so they are tried first.
    keys.sort_by_key(|(key, _)| !tags.contains(&key.as_str()));
    let wrong = |key: String, value: &Value, error: &toml::de::Error| SettingError::Value {
        key,
        found: value.to_string(),
        expected: error.message().to_owned(),
    };
    for (key, value) in keys {
        let alone = match key.split_once('.') {
            Some((section, inner)) => {
                let inner = Table::from_iter([(inner.to_owned(), value.clone())]);
                Table::from_iter([(section.to_owned(), Value::Table(inner))])
            }
            None => Table::from_iter([(key.clone(), value.clone())]),
        };
        tried = merge(tried, &alone);
        if let Err(error) = Configuration::from_table(tried.clone()) {
            return wrong(key, value, &error);
        }
    }
    let (key, value) = own
        .iter()
        .next()
        .map_or(("", &Value::Boolean(false)), |(k, v)| (k, v));
    wrong(key.to_owned(), value, &error)
}

// Keys of a file without effect, each with the setting that turns it off. A user who sets such a key expects a change, and
// would compare two equal measurements.
fn unused_keys(settings: &Table, configuration: &Configuration) -> Vec<(String, String)> {
    let used = Table::try_from(configuration).unwrap_or_default();
    let reason = |key: &str| {
        // `noise.source` and `denoise.method` choose which keys of their own section count.
        let switch = match key.split_once('.') {
            Some(("noise", _)) => "noise.source".to_owned(),
            Some((section, _)) => format!("{section}.method"),
            None => "method".to_owned(),
        };
        match get(&used, &switch) {
            Some(value) => format!("{switch} = {value}"),
            None => format!("method = {}", used["method"]),
        }
    };
    let keys = leaves(settings).into_iter().map(|(key, _)| key);
    let unused = keys.filter(|key| get(&used, key).is_none());
    unused
        .map(|key| (reason(&key), key))
        .map(|(reason, key)| (key, reason))
        .collect()
}

/// The embedded configurations, by name.
#[derive(Debug)]
pub struct Registry {
    names: Vec<String>,
    files: BTreeMap<String, File>,
}

impl Registry {
    /// Parses the embedded files.
    ///
    /// # Errors
    /// If one of them is not valid, which a test excludes.
    pub fn embedded() -> Result<Self, ConfigurationError> {
        let mut registry = Registry {
            names: Vec::new(),
            files: BTreeMap::new(),
        };
        for (file_name, text) in EMBEDDED {
            let file = File::parse(&Path::new("submissions/named").join(file_name), text)?;
            let name = file.name();
            if !UNLISTED_BASES.contains(&name.as_str()) {
                registry.names.push(name.clone());
            }
            registry.files.insert(name, file);
        }
        Ok(registry)
    }

    /// Names of the embedded configurations, in the order of the paper's Table 1, then those it does not have.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The configurations of the paper's Table 1 with their published figures, in its order.
    ///
    /// # Errors
    /// As [`Registry::get`].
    pub fn published(&self) -> Result<Vec<(Configuration, Published)>, ConfigurationError> {
        let mut found = Vec::new();
        for name in &self.names {
            let entry = self.get(name)?;
            let published = entry.published;
            found.extend(published.map(|figures| (entry.configuration, figures)));
        }
        Ok(found)
    }

    /// The configuration of this name, or in this file.
    ///
    /// A name wins over a file; a path with `./` in front is always a file.
    ///
    /// # Errors
    /// If there is no such name or file, or it or what it extends is not valid.
    pub fn get(&self, name_or_path: &str) -> Result<Entry, ConfigurationError> {
        let file = self.find(name_or_path, None)?;
        let entry = self.entry(&file, name_or_path)?;
        if file.text.is_some() {
            self.check_distinct(&file.path, &entry.configuration)?;
        }
        Ok(entry)
    }

    // Refuses other settings under the name of a known configuration: tables and stores would show two methods of one name.
    fn check_distinct(&self, path: &Path, own: &Configuration) -> Result<(), ConfigurationError> {
        if !self.files.contains_key(&own.name) {
            return Ok(());
        }
        let known = self.get(&own.name)?.configuration;
        let table = |configuration| Table::try_from(configuration).unwrap_or_default();
        match difference(&table(own), &table(&known)) {
            None => Ok(()),
            Some(difference) => Err(ConfigurationError::Taken {
                path: path.to_owned(),
                name: own.name.clone(),
                difference,
            }),
        }
    }

    /// The configuration of a settings file at `path` with this text. Errors name `path`, files in `extends` are relative to
    /// it, and it gives the name if the text states none. The file need not exist.
    ///
    /// # Errors
    /// If the text, or what it extends, is not valid.
    pub fn get_text(&self, path: &Path, text: &str) -> Result<Entry, ConfigurationError> {
        let file = File::of_user(path, text.to_owned())?;
        self.entry(&file, &path.to_string_lossy())
    }

    fn entry(&self, file: &File, asked: &str) -> Result<Entry, ConfigurationError> {
        let settings = self.resolve(file, &mut vec![asked.to_owned()])?;
        let configuration = read(file, &settings).map_err(|error| file.fault(error))?;
        Ok(Entry {
            configuration,
            published: file.head.published,
            extends: file.head.extends.clone(),
        })
    }

    // `chain` has the names that led here, to refuse a cycle.
    fn resolve(&self, file: &File, chain: &mut Vec<String>) -> Result<Table, ConfigurationError> {
        let path = &file.path;
        let base = match &file.head.extends {
            None => Table::new(),
            Some(parent) => {
                let again = chain.contains(parent);
                chain.push(parent.clone());
                if again || chain.len() > MAX_EXTENDS {
                    return Err(ConfigurationError::Cycle {
                        path: path.clone(),
                        chain: chain.join(" → "),
                    });
                }
                self.resolve(&self.find(parent, Some(path))?, chain)?
            }
        };
        let settings = merge(base, &file.settings);
        if file.text.is_none() {
            return Ok(settings);
        }
        match read(file, &settings) {
            Ok(configuration) => {
                if let Some((key, reason)) = unused_keys(&file.settings, &configuration)
                    .into_iter()
                    .next()
                {
                    return Err(file.fault(SettingError::Unused { key, reason }));
                }
            }
            // A file may be incomplete, or out of range, as a base for others. The last of the chain is checked by `entry`.
            Err(SettingError::Missing { .. } | SettingError::OutOfRange(_)) => {}
            Err(error) => return Err(file.fault(error)),
        }
        Ok(settings)
    }

    // Paths are relative to the file `from` that contains them, as in other formats with `include`, so that a folder of
    // settings files can move.
    fn find(&self, name: &str, from: Option<&Path>) -> Result<File, ConfigurationError> {
        if let Some(file) = self.files.get(name) {
            return Ok(file.clone());
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
        File::of_user(&path, read_text(&path)?)
    }
}

fn read(file: &File, settings: &Table) -> Result<Configuration, SettingError> {
    let description = file.head.description.clone().unwrap_or_default();
    let mut all = settings.clone();
    all.insert("name".into(), file.name().into());
    all.insert("description".into(), description.into());
    configuration_of(all)
}

fn read_text(path: &Path) -> Result<String, ConfigurationError> {
    let mut text = String::new();
    std::fs::File::open(path)
        .and_then(|file| file.take(MAX_FILE_BYTES + 1).read_to_string(&mut text))
        .map_err(|source| ConfigurationError::Read {
            path: path.to_owned(),
            source,
        })?;
    if text.len() as u64 > MAX_FILE_BYTES {
        return Err(ConfigurationError::Syntax {
            path: path.to_owned(),
            message: format!(
                "it has more than {MAX_FILE_BYTES} bytes, the most that settings may have"
            ),
        });
    }
    Ok(text)
}

impl FromStr for Configuration {
    type Err = ConfigurationError;

    /// The configuration of a TOML text, as of a settings file. `extends` names an embedded configuration, or a file
    /// relative to the working folder. A text without a name has the name `settings`.
    fn from_str(text: &str) -> Result<Self, ConfigurationError> {
        let entry = Registry::embedded()?.get_text(Path::new(UNNAMED_TEXT), text)?;
        Ok(entry.configuration)
    }
}

/// The method of a new settings file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Template {
    /// The Hopfield network of the paper.
    Network,
    /// The linear network in closed form.
    Linear,
}

impl Template {
    /// The text of a settings file with all settings of the method and their meaning. Settings that another one turns off
    /// are commented out.
    ///
    /// # Errors
    /// If the embedded configurations are not valid, which a test excludes.
    pub fn text(self) -> Result<String, ConfigurationError> {
        let (base, text) = match self {
            Template::Network => ("paper", NETWORK_TEMPLATE),
            Template::Linear => ("48/linear/star", LINEAR_TEMPLATE),
        };
        let registry = Registry::embedded()?;
        let configuration = registry.get(base)?.configuration;
        let unused = unused_keys(&registry.files[base].settings, &configuration);
        let lines = unused.iter().filter_map(|(key, _)| line_of(text, key));
        let unused: BTreeSet<usize> = lines.collect();
        let mut own = String::new();
        for (number, line) in (1..).zip(text.lines()) {
            if line.starts_with("name =") {
                own.push_str(&format!("extends = \"{base}\"\n"));
            } else if line.starts_with("description =") {
                own.push_str("description = \"my own variant\"\n");
            } else if unused.contains(&number) {
                own.push_str(&format!("# {line}\n"));
            } else {
                own.push_str(&format!("{line}\n"));
            }
        }
        Ok(own)
    }
}

// For the message. A description changes no result, so it may differ.
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
    fn embedded_files_resolve_and_keep_their_published_figures() {
        let registry = Registry::embedded().unwrap();
        assert_eq!(
            registry.names().len(),
            EMBEDDED.len() - UNLISTED_BASES.len()
        );
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

    // What a file of this text in `folder` is.
    fn read(folder: &Path, name: &str, text: &str) -> Result<Entry, String> {
        let path = write(folder, name, text);
        let entry = Registry::embedded().unwrap().get(&path);
        entry.map_err(|error| error.to_string())
    }

    #[test]
    fn files_extend_names_and_files_without_published_figures() {
        let folder = tempfile::tempdir().unwrap();
        let base = "extends = \"23/den/star\"\n[stamp]\nsize = 31\n";
        write(folder.path(), "base.toml", base);
        let own = "extends = \"base.toml\"\n[deconvolution]\nlambda = 0.5\n";
        let entry = read(folder.path(), "own.toml", own).unwrap();
        let configuration = entry.configuration;
        assert_eq!(
            (configuration.name.as_str(), configuration.stamp.size),
            ("own", 31)
        );
        assert_eq!(configuration.network().unwrap().deconvolution.lambda, 0.5);
        assert!(configuration.wavelet().is_some());
        assert_eq!(entry.published, None);
        // A method without its settings.
        let text = "extends = \"23/den/star\"\nmethod = \"linear\"\n";
        let error = read(folder.path(), "own.toml", text).unwrap_err();
        assert!(
            error.contains("`deconvolution.reference_area` is set"),
            "{error}"
        );
    }

    #[test]
    fn files_of_a_known_name_have_its_settings() {
        let folder = tempfile::tempdir().unwrap();
        let read = |file: &str, text: &str| read(folder.path(), file, text);
        let named = "name = \"48/linear/star\"\n";
        let error = read("own.toml", &format!("{named}extends = \"23/raw/star\"\n")).unwrap_err();
        let known = "own.toml: the name `48/linear/star` is that of a known";
        assert!(error.contains(known), "{error}");
        let changed = format!("{named}extends = \"48/linear/star\"\n[stamp]\nsize = 40\n");
        let error = read("own.toml", &changed).unwrap_err();
        let size = "(stamp.size: found 40, expected 48). Try: another";
        assert!(error.contains(size), "{error}");
        // The bases, which are not listed, have names too; a file without one has the name of its path.
        assert!(read("paper.toml", "extends = \"48/linear/star\"\n").is_err());
        let same = format!("{named}extends = \"48/linear/star\"\ndescription = \"mine\"\n");
        let same = read("own.toml", &same).unwrap();
        assert_eq!(same.configuration.name, "48/linear/star");
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
        let without = |key: &str| {
            let less: Vec<&str> = text.lines().filter(|line| !line.starts_with(key)).collect();
            less.join("\n").parse::<Configuration>()
        };
        // A file of an earlier version reports e.
        assert_eq!(without("saturation").unwrap(), configuration);
        for key in ["half_snr", "sheared_step"] {
            let error = without(key).unwrap_err();
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
            matches!(&error, ConfigurationError::Setting { error, .. } if error.key() == "deconvolution.window_sigma"),
            "{error}"
        );
    }

    #[test]
    fn settings_of_detection_are_read_back_from_records() {
        let registry = Registry::embedded().unwrap();
        let detection = |threshold: f64| Configuration {
            name: "detection".into(),
            method: Method::Detection {
                detection: DetectionMethod {
                    threshold,
                    ..DetectionMethod::default()
                },
            },
            ..registry.get("48/linear/star").unwrap().configuration
        };
        let own = detection(9.0);
        let text = toml::to_string(&own).unwrap();
        assert_eq!(toml::from_str::<Configuration>(&text).unwrap(), own);
        for (wrong, key) in [
            (text.replace("softening", "soft"), "soft"),
            (text.replace("9.0", "1.0"), "detection.threshold"),
        ] {
            let error = toml::from_str::<Configuration>(&wrong).unwrap_err();
            assert!(error.to_string().contains(key), "{error}");
        }
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
            assert_eq!(text.parse::<Configuration>().unwrap(), configuration);
        }
    }

    #[test]
    fn a_template_resolves_to_its_base_and_sets_all_that_applies() {
        let folder = tempfile::tempdir().unwrap();
        let registry = Registry::embedded().unwrap();
        for (template, base) in [
            (Template::Network, "paper"),
            (Template::Linear, "48/linear/star"),
        ] {
            let text = template.text().unwrap();
            let path = folder.path().join("own.toml");
            std::fs::write(&path, &text).unwrap();
            let own = registry.get(path.to_str().unwrap()).unwrap().configuration;
            let base = registry.get(base).unwrap().configuration;
            assert_eq!((&own.stamp, &own.psf), (&base.stamp, &base.psf));
            assert_eq!((&own.noise, &own.method), (&base.noise, &base.method));
            let all = toml::Table::try_from(&own).unwrap();
            for (section, keys) in all.iter().filter_map(|(s, t)| Some((s, t.as_table()?))) {
                let (_, rest) = text.split_once(&format!("[{section}]\n")).unwrap();
                let of_section = rest.split("\n[").next().unwrap();
                for key in keys.keys() {
                    let set = of_section
                        .lines()
                        .any(|l| l.starts_with(&format!("{key} =")));
                    assert!(set, "{section}.{key}");
                }
            }
        }
    }
}
