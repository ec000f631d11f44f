//! The description of a challenge, `challenge.toml`, its deadlines and the clock of arrivals.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::str::FromStr;

use jiff::civil::Date;
use jiff::tz::TimeZone;
use jiff::{Timestamp, ZonedDateTime};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use shearq_dataset::layout::{MAX_IMAGE, MAX_SET};
use shearq_files::{FileError, open};
use shearq_quantities::units::{Degrees, Pixels};
use shearq_results::submit::check::{Expected, ExpectedImages};
use shearq_results::submit::{Contents, Packed, Sent, Submission};
use shearq_scoring::Grid;
use shearq_submissions::{check_name, checked_name};

use crate::kind::{Kind, RankBy};

pub const CHALLENGE_FILE: &str = "challenge.toml";

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Challenge {
    #[serde(deserialize_with = "checked_name")]
    pub name: String,
    pub version: u32,
    pub kind: Kind,
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
    #[serde(default, skip_serializing_if = "is_zero")]
    pub grid: usize,
    #[serde(default, skip_serializing_if = "is_zero")]
    pub stamp: usize,
    #[serde(default, skip_serializing_if = "is_zero")]
    pub field_degrees: f64,
    /// Exposures instead of galaxies on a grid: each is a set of one image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<SceneData>,
}

fn is_zero<T: Default + PartialEq>(number: &T) -> bool {
    *number == T::default()
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneData {
    /// Pixels a side.
    pub side: usize,
    /// The area that has objects.
    pub arcmin2: f64,
    /// Whether the PSF varies over a scene.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub psf_varies: bool,
    /// Exposures of a scene after the first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub epochs: Option<u32>,
    /// Electrons per unit, if light has noise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
}

impl Data {
    fn files(&self) -> u64 {
        self.sets.len() as u64 * u64::from(self.images)
    }

    /// Galaxies of all images, or the number of scenes, in which nobody knows theirs.
    pub fn galaxies(&self) -> u64 {
        if self.scene.is_some() {
            return self.files();
        }
        self.files()
            .saturating_mul((self.grid as u64).saturating_pow(2))
    }

    /// Bytes of the largest valid entry, unpacked.
    pub fn largest_entry(&self) -> u64 {
        let rows = match self.scene {
            Some(SceneData { side, .. }) => self.files() * BYTES_PER_PIXEL * (side * side) as u64,
            None => self.galaxies().saturating_mul(BYTES_PER_ROW),
        };
        (FREE_BYTES + self.files() * BYTES_PER_FILE).saturating_add(rows)
    }

    pub fn grid(&self) -> Result<Grid, shearq_scoring::ScoringError> {
        Grid::new(
            self.grid,
            Pixels(self.stamp as f64),
            Degrees(self.field_degrees),
        )
    }
}

// Four numbers of 24 characters, which is the longest that a 64-bit number has, and four separators, rounded up.
const BYTES_PER_ROW: u64 = 128;
// Of catalogues of scenes: twice the exposures, so that five sheared catalogues with many columns fit. Chosen by hand.
const BYTES_PER_PIXEL: u64 = 8;
// A header, its line in the manifest, and what tar adds; a spectrum with its covariances. Chosen by hand.
const BYTES_PER_FILE: u64 = 1 << 12;
// Licences and notes beside the files. Chosen by hand.
const FREE_BYTES: u64 = 1 << 20;

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
    /// Largest |m| of ranked entries of scenes, to which twice its error is added.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_m: Option<f64>,
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

    /// Whether entries are still accepted, so that the truth has to stay secret.
    pub fn is_open(&self, now: Timestamp) -> bool {
        self.closes.as_ref().is_none_or(|closes| now <= closes.last)
    }

    pub fn is_early(&self, received: Timestamp) -> bool {
        self.opens
            .as_ref()
            .is_some_and(|opens| received < opens.first)
    }

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

    /// Opens an entry: a folder, or an archive that unpacks to the size of the largest entry at most.
    pub fn open(&self, entry: &Path) -> Result<Sent, FileError> {
        match entry.is_dir() {
            true => Ok(Sent::in_place(entry)),
            false => Sent::unpacked(entry, Some(self.data.largest_entry())),
        }
    }

    pub fn expected(&self) -> Result<Expected, FileError> {
        let Data { sets, images, .. } = &self.data;
        let grid = self.data.grid();
        Ok(Expected {
            grid: grid.map_err(|error| FileError::new(CHALLENGE_FILE, error))?,
            definition: self.rules.metric.definition(),
            truth: BTreeMap::new(),
            secret_truth: BTreeMap::new(),
            images: ExpectedImages::Each(*images),
            sets: sets.clone(),
            partial: self.rules.partial,
        })
    }

    fn check(&self) -> Result<(), String> {
        let Data { sets, images, .. } = &self.data;
        if sets.is_empty() || !sets.is_sorted_by(|a, b| a < b) {
            return Err("`data.sets`: expected ascending numbers".into());
        }
        // Names of files have no larger ones.
        for (name, found, most) in [
            ("sets", sets[sets.len() - 1], MAX_SET),
            ("images", *images, MAX_IMAGE),
        ] {
            if found > most || found == 0 {
                return Err(format!(
                    "`data.{name}`: found {found}, expected 1 to {most}"
                ));
            }
        }
        match self.data.scene {
            None => {
                let grid = self.data.grid();
                grid.map_err(|error| format!("`data`: {error}"))?;
            }
            Some(SceneData { side, arcmin2, .. }) => {
                if side == 0 || arcmin2.is_nan() || arcmin2 <= 0.0 {
                    return Err(format!(
                        "`data.scene`: found {side} pixels a side and {arcmin2} arcmin², expected positive numbers"
                    ));
                }
            }
        }
        check_name(&self.name).map_err(|error| error.to_string())
    }

    pub fn text(&self, path: &Path) -> Result<String, FileError> {
        toml::to_string(self).map_err(FileError::doing(path, "cannot write the description"))
    }
}

/// A deadline: a whole day in UTC, or a moment with its zone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Deadline {
    text: String,
    /// First second: entries of this second are not before it.
    pub first: Timestamp,
    /// Last second: entries of this second are not after it.
    pub last: Timestamp,
}

impl fmt::Display for Deadline {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.first == self.last {
            // Participants live in other zones.
            true if !self.text.ends_with('Z') => write!(f, "{}, {}", self.text, self.first),
            true => f.write_str(&self.text),
            false => write!(f, "{} (UTC)", self.text),
        }
    }
}

impl FromStr for Deadline {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = |_| {
            format!(
                "not a day or a moment (found `{text}`, expected such as 2026-12-01, 2026-12-01T18:00+01:00 or 2026-12-01T18:00[Europe/Berlin])"
            )
        };
        let second = |moment: Timestamp| Timestamp::from_second(moment.as_second()).map_err(wrong);
        // Jiff reads the date of a longer text as well.
        if let (10, Ok(day)) = (text.len(), text.parse::<Date>()) {
            let utc = |hour, minute, second| {
                let time = day.at(hour, minute, second, 0);
                TimeZone::UTC.to_timestamp(time).map_err(wrong)
            };
            return Ok(Deadline {
                text: text.into(),
                first: utc(0, 0, 0)?,
                last: utc(23, 59, 59)?,
            });
        }
        // The offset comes first, so that the description of a challenge is read where no zone files are.
        let (text, moment) = match text.parse::<Timestamp>() {
            Ok(moment) => (text.to_owned(), second(moment)?),
            Err(_) => {
                let moment: ZonedDateTime = text.parse().map_err(wrong)?;
                (moment.to_string(), second(moment.timestamp())?)
            }
        };
        Ok(Deadline {
            text,
            first: moment,
            last: moment,
        })
    }
}

impl Serialize for Deadline {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.text)
    }
}

impl<'de> Deserialize<'de> for Deadline {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

pub fn now() -> Timestamp {
    let now = Timestamp::now();
    Timestamp::from_second(now.as_second()).unwrap_or(now)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Deadline, String> {
        text.parse()
    }

    #[test]
    fn a_day_lasts_until_its_last_second_in_utc() {
        let day = parse("2026-12-31").unwrap();
        assert_eq!(day.first.to_string(), "2026-12-31T00:00:00Z");
        assert_eq!(day.last.to_string(), "2026-12-31T23:59:59Z");
        assert_eq!(day.to_string(), "2026-12-31 (UTC)");
    }

    #[test]
    fn a_moment_has_the_offset_of_its_zone() {
        // Berlin is an hour ahead of UTC in winter, and two hours in summer.
        for (text, utc) in [
            ("2026-12-01T18:00Z", "2026-12-01T18:00:00Z"),
            ("2026-12-01T18:00:00+01:00", "2026-12-01T17:00:00Z"),
            ("2026-12-01T18:00[Europe/Berlin]", "2026-12-01T17:00:00Z"),
            ("2026-07-01T18:00[Europe/Berlin]", "2026-07-01T16:00:00Z"),
        ] {
            let moment = parse(text).unwrap();
            assert_eq!(moment.first.to_string(), utc, "{text}");
            assert_eq!(moment.first, moment.last);
            assert_eq!(parse(&moment.text).as_ref(), Ok(&moment));
        }
        // In UTC, too, unless that is what was given.
        let printed = |text| parse(text).unwrap().to_string();
        assert_eq!(printed("2026-12-01T18:00Z"), "2026-12-01T18:00Z");
        assert_eq!(
            printed("2026-07-01T18:00[Europe/Berlin]"),
            "2026-07-01T18:00:00+02:00[Europe/Berlin], 2026-07-01T16:00:00Z"
        );
    }

    #[test]
    fn impossible_and_ambiguous_deadlines_are_refused() {
        assert!(parse("2024-02-29").is_ok());
        for wrong in [
            "2026-02-29",
            "2026-13-01",
            "2026-1-1",
            "soon",
            "2026-12-01T18:00",
            "2026-12-01 18:00",
            "2026-12-01T18:00[Europe/Atlantis]",
            "9999-12-31",
            "12026-12-01",
        ] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
