//! The description of a challenge: `challenge.toml`.

use std::collections::BTreeMap;
use std::path::Path;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use shearq_files::{FileError, open};
use shearq_quantities::units::{Degrees, Pixels};
use shearq_results::submit::check::Expected;
use shearq_results::submit::manifest::Contents;
use shearq_results::submit::packed::{Packed, Submission};
use shearq_scoring::Grid;
use shearq_submissions::{check_name, checked_name};

use crate::deadline::Deadline;
use crate::kind::{Kind, RankBy, by_name};

/// Name of the description in the public folder.
pub const CHALLENGE_FILE: &str = "challenge.toml";

/// Description of a challenge. It is public.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Challenge {
    #[serde(deserialize_with = "checked_name")]
    pub name: String,
    pub version: u32,
    #[serde(deserialize_with = "by_name")]
    pub kind: &'static Kind,
    #[serde(default)]
    pub contact: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub address: String,
    /// [`Key::seal`](crate::seal::Key::seal) of the private files; empty until they are complete.
    #[serde(default)]
    pub seal: String,
    pub data: Data,
    pub conventions: BTreeMap<String, String>,
    pub rules: Rules,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Data {
    pub sets: Vec<u32>,
    /// Images of each set, numbered from 1.
    pub images: u32,
    pub grid: usize,
    pub stamp: usize,
    /// Side of the field in degrees.
    pub field_degrees: f64,
}

impl Data {
    pub fn galaxies(&self) -> u64 {
        self.sets.len() as u64 * u64::from(self.images) * (self.grid as u64).pow(2)
    }

    /// Grid of the galaxies.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn grid(&self) -> Result<Grid, shearq_scoring::ScoringError> {
        Grid::new(
            self.grid,
            Pixels(self.stamp as f64),
            Degrees(self.field_degrees),
        )
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rules {
    pub metric: RankBy,
    pub contents: Vec<Contents>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub entries_per_team: Option<u32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub opens: Option<Deadline>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub closes: Option<Deadline>,
    /// Whether entries may cover some sets only. They have no rank.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub partial: bool,
}

/// Entries that determine m and c of both components: one, and a shift and a stretch of each (crates/challenge/tests/extraction.rs).
pub const TUNING_ENTRIES: u32 = 5;

impl Rules {
    /// The entries of a team, in words, if they suffice to tune m and c to the truth.
    pub fn tunable_entries(&self) -> Option<String> {
        if !matches!(self.metric, RankBy::M | RankBy::C | RankBy::Qc) {
            return None;
        }
        match self.entries_per_team {
            None => Some("any number".into()),
            Some(most) => (most >= TUNING_ENTRIES).then(|| most.to_string()),
        }
    }

    /// Whether a time is before the first day of entries.
    pub fn is_early(&self, received: Timestamp) -> bool {
        self.opens
            .as_ref()
            .is_some_and(|opens| received < opens.first)
    }

    /// Kind of the files of an entry.
    ///
    /// # Errors
    /// If the challenge does not accept it.
    pub fn accept(&self, submission: &Submission) -> Result<Contents, String> {
        let contents = match (&submission.packed, &submission.manifest) {
            (Packed::Catalogues(_), _) => Contents::Catalogues,
            (Packed::Spectra(_), Some(manifest)) if manifest.contents.is_spectra() => {
                manifest.contents
            }
            (Packed::Spectra(_), _) => Contents::Spectra,
        };
        match self.contents.contains(&contents) {
            true => Ok(contents),
            false => Err(format!(
                "the challenge does not accept {} (expected catalogues)",
                match contents {
                    Contents::Catalogues => "catalogues",
                    Contents::Spectra | Contents::CrossSpectra => "power spectra",
                }
            )),
        }
    }
}

impl Challenge {
    /// Reads the description in a public folder, or the file itself.
    ///
    /// # Errors
    /// If there is none, or a value is out of range.
    pub fn read(place: &Path) -> Result<Self, FileError> {
        let path = match place.is_dir() {
            true => place.join(CHALLENGE_FILE),
            false => place.to_owned(),
        };
        let text = open::read_to_string(&path, open::SETTINGS).map_err(FileError::doing(
            &path,
            "cannot read the description of the challenge (expected the public folder that `shearq challenge new` wrote)",
        ))?;
        let challenge: Challenge =
            toml::from_str(&text).map_err(|e| FileError::new(&path, e.to_string().trim_end()))?;
        challenge
            .check()
            .map_err(|message| FileError::new(&path, message))?;
        Ok(challenge)
    }

    /// Properties that an entry must have.
    pub fn expected(&self) -> Result<Expected, FileError> {
        let Data { sets, images, .. } = &self.data;
        let grid = self.data.grid();
        Ok(Expected {
            grid: grid.map_err(|error| FileError::new(CHALLENGE_FILE, error))?,
            truth: BTreeMap::new(),
            secret_truth: BTreeMap::new(),
            images: Some(*images),
            sets: sets.clone(),
            partial: self.rules.partial,
        })
    }

    fn check(&self) -> Result<(), String> {
        let Data { sets, images, .. } = &self.data;
        if sets.is_empty() || !sets.is_sorted_by(|a, b| a < b) || *images == 0 {
            return Err("`data`: expected ascending `sets` and at least one image".into());
        }
        self.data
            .grid()
            .map_err(|error| format!("`data`: {error}"))?;
        check_name(&self.name).map_err(|error| error.to_string())
    }

    /// The text of the file.
    pub fn text(&self, path: &Path) -> Result<String, FileError> {
        toml::to_string(self).map_err(FileError::doing(path, "cannot write the description"))
    }
}
