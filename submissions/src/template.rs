//! Commented files for users to start from.

use crate::error::ConfigurationError;
use crate::file::dead_keys;
use crate::registry::{LINEAR, NETWORK, Registry};

/// A method to start a file of one's own with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Template {
    /// The Hopfield network of the paper.
    Network,
    /// The linear network in closed form.
    Linear,
}

impl Template {
    /// A file with all settings of the method, each with its meaning, to be changed or thinned out. Those
    /// that another setting turns off are comments.
    ///
    /// # Errors
    /// Where the embedded submissions are not valid, which a test rules out.
    pub fn text(self) -> Result<String, ConfigurationError> {
        let (base, text) = match self {
            Template::Network => ("paper", NETWORK),
            Template::Linear => ("48/linear/star", LINEAR),
        };
        let configuration = Registry::embedded()?.get(base)?.configuration;
        let dead: Vec<usize> = dead_keys(text, &configuration)
            .iter()
            .map(|dead| dead.line)
            .collect();
        let mut own = String::new();
        for (number, line) in (1..).zip(text.lines()) {
            if line.starts_with("name =") {
                own.push_str(&format!("extends = \"{base}\"\n"));
            } else if line.starts_with("description =") {
                own.push_str("description = \"my own variant\"\n");
            } else if dead.contains(&number) {
                own.push_str(&format!("# {line}\n"));
            } else {
                own.push_str(&format!("{line}\n"));
            }
        }
        Ok(own)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
