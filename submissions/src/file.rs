//! Settings as a file has them: one link of a chain of files, or all that was stored with results.

use std::io::Read;
use std::path::Path;

use serde::{Deserialize, Deserializer, Serialize};

use crate::error::ConfigurationError;
use crate::settings::{
    Configuration, MethodName, PartialConfiguration, PartialDeconvolution, PartialDenoise,
    PartialNoise, PartialPsf, PartialShape, PartialStamp,
};

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

/// One file as written.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct File {
    pub(crate) name: Option<String>,
    pub(crate) description: Option<String>,
    pub(crate) extends: Option<String>,
    method: Option<MethodName>,
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
    pub(crate) published: Option<Published>,
}

impl File {
    pub(crate) fn parse(path: &Path, text: &str) -> Result<Self, ConfigurationError> {
        toml::from_str(text).map_err(|error| ConfigurationError::Parse {
            path: path.to_owned(),
            message: error.to_string().trim_end().to_owned(),
        })
    }

    /// What the file sets.
    pub(crate) fn settings(self) -> PartialConfiguration {
        let File {
            name: _,
            description: _,
            extends: _,
            method,
            stamp,
            psf,
            noise,
            denoise,
            deconvolution,
            shape,
            published: _,
        } = self;
        PartialConfiguration {
            method,
            stamp,
            psf,
            noise,
            denoise,
            deconvolution,
            shape,
        }
    }
}

impl<'de> Deserialize<'de> for Configuration {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        use serde::de::Error;
        let mut file = File::deserialize(deserializer)?;
        let (name, description) = (file.name.take(), file.description.take());
        let configuration = file
            .settings()
            .complete(
                name.ok_or_else(|| Error::missing_field("name"))?,
                description.ok_or_else(|| Error::missing_field("description"))?,
            )
            .map_err(Error::missing_field)?;
        configuration.validate().map_err(Error::custom)?;
        Ok(configuration)
    }
}

/// The key of a file that the method it resolves to does not use: its name, its line, and why it is dead.
pub(crate) struct DeadKey {
    pub(crate) key: String,
    pub(crate) line: usize,
    pub(crate) reason: String,
}

/// Keys of `text`, a valid file, that `submission` has no use for, in order.
pub(crate) fn dead_keys(text: &str, configuration: &Configuration) -> Vec<DeadKey> {
    let (Ok(file), Ok(used)) = (
        toml::de::DeTable::parse(text),
        toml::Table::try_from(configuration),
    ) else {
        return Vec::new();
    };
    let mut dead = Vec::new();
    for (section, keys) in file.get_ref() {
        let section = section.get_ref();
        if section == "published" {
            continue;
        }
        let live = used.get(section.as_ref()).and_then(toml::Value::as_table);
        for (key, _) in keys.get_ref().as_table().into_iter().flatten() {
            if live.is_some_and(|live| live.contains_key(key.get_ref().as_ref())) {
                continue;
            }
            // A section that the method has may be turned off by one of its own keys.
            let switch = match section.as_ref() {
                "noise" => "source",
                _ => "method",
            };
            let (name, value) = match live.and_then(|live| live.get(switch)) {
                Some(value) => (format!("{section}.{switch}"), value),
                None => ("method".to_owned(), &used["method"]),
            };
            dead.push(DeadKey {
                key: format!("{section}.{}", key.get_ref()),
                line: 1 + text[..key.span().start].matches('\n').count(),
                reason: format!("{name} = {value}"),
            });
        }
    }
    dead.sort_by_key(|dead| dead.line);
    dead
}

/// Most bytes of a file, a thousand times those of all settings.
const MOST: u64 = 1 << 20;

/// The text of a file.
pub(crate) fn read(path: &Path) -> Result<String, ConfigurationError> {
    let mut text = String::new();
    std::fs::File::open(path)
        .and_then(|file| file.take(MOST + 1).read_to_string(&mut text))
        .map_err(|source| ConfigurationError::Read {
            path: path.to_owned(),
            source,
        })?;
    if text.len() as u64 > MOST {
        return Err(ConfigurationError::Parse {
            path: path.to_owned(),
            message: format!("it has more than {MOST} bytes, the most that settings may have"),
        });
    }
    Ok(text)
}
