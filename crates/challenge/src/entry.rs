//! What a challenge knows of an entry and of its team.

use std::path::PathBuf;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use shearq_render::escape::line;
use shearq_results::record::SetRecord;
use shearq_results::submit::Contents;
use shearq_submissions::check_name;
use unicode_normalization::UnicodeNormalization;
use unicode_normalization::char::is_combining_mark;

use crate::kind::{ConstantShears, Measured, Noise, Published, RankBy};
use crate::scenes::SceneScore;

/// What identifies an entry that was compared with the true shear. The store keeps it with its scores, so the names are
/// part of the format.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EntryInfo {
    pub challenge: String,
    pub team: String,
    pub method: String,
    /// One line about the entry; may be empty.
    pub title: String,
    /// Address for questions; may be empty. The leaderboard does not show it.
    pub contact: String,
    /// Time of arrival: of the receipt, as the organiser stated it, or of the first `rank` that scored the entry.
    pub received: Timestamp,
    pub receipt: bool,
    pub file: String,
    pub sha256: String,
    /// SHA-256 of sets, images and files.
    pub content: String,
    pub contents: Contents,
    /// The configuration of shearq by which it was measured, as its manifest states.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub configuration: Option<String>,
    pub reference: bool,
    /// Whether the comparison with the true shear gave a score. It counts as an entry in any case.
    pub scored: bool,
    /// What the comparison showed besides the score. It depends on the truth, so it is for the organiser alone.
    pub findings: Vec<String>,
    /// What ranks an entry of scenes, which has no metrics of sets.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scenes: Option<SceneScore>,
}

impl EntryInfo {
    /// The first digits of the SHA-256, which name the entry.
    pub fn short_id(&self) -> &str {
        &self.sha256[..self.sha256.len().min(8)]
    }
}

#[derive(Debug, Clone)]
pub struct Entry {
    pub info: EntryInfo,
    pub sets: Vec<SetRecord>,
    /// Why the organiser withdrew it.
    pub withdrawn: Option<String>,
}

impl Entry {
    /// Value and standard error of a metric. `constant` has the true shears of sets with one shear each.
    pub fn value(&self, metric: RankBy, constant: Option<&ConstantShears>) -> Measured {
        match &self.info.scenes {
            Some(scenes) => scenes.value(metric),
            None => metric.of(&self.sets, constant),
        }
    }

    /// The same as it is published. `noise` has the errors of a measurement with the noise of the images.
    pub fn published(
        &self,
        metric: RankBy,
        constant: Option<&ConstantShears>,
        noise: &Noise,
    ) -> Published {
        let (value, error) = self.value(metric, constant);
        // `max` of an unknown error is the other one.
        Published::new(value, error.max(metric.least_error(value, noise)))
    }
}

/// An entry that was not compared with the true shear.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused {
    pub path: PathBuf,
    pub team: String,
    pub reason: String,
}

// Greek and Cyrillic letters, and the Latin ones that their small or their capital form looks like (Unicode's confusables.txt).
const LOOK_ALIKE: [(&str, &str); 4] = [
    ("авекмнорстухѕіјԛԝһԁӏ", "abekmhopctyxsijqwhdl"),
    ("αβεζηικμνορτυχ", "abezhikmnoptux"),
    ("ıɑɡ", "iag"),
    // I, l and 1 are one.
    ("l1|0", "iiio"),
];

/// What the spellings of a team's name have in common: compatible and similar characters (NFKD, letters of other scripts and digits
/// that look alike), without case, accents, blanks and characters that nobody sees.
pub fn team_key(name: &str) -> String {
    let latin = |c: char| {
        let mut pairs = LOOK_ALIKE
            .iter()
            .flat_map(|(alike, latin)| alike.chars().zip(latin.chars()));
        pairs.find(|(alike, _)| *alike == c).map_or(c, |own| own.1)
    };
    name.nfkc()
        .filter(|c| !c.is_whitespace() && !is_invisible(*c))
        .flat_map(char::to_uppercase)
        .flat_map(char::to_lowercase)
        .nfkd()
        .filter(|c| !is_combining_mark(*c))
        .map(latin)
        .collect()
}

// Names that a board or its page uses itself, or by which a team would speak as the organiser.
const RESERVED_NAMES: [&str; 7] = [
    "zero shear",
    "no image",
    "reference",
    "truth",
    "true shear",
    "host",
    "organiser",
];

/// Whether a team may have this name.
///
/// # Errors
///
/// In words, if it is no visible text, or one that the organiser alone has.
pub fn check_team(name: &str) -> Result<(), String> {
    check_name(name).map_err(|error| error.to_string())?;
    let key = team_key(name);
    if key.is_empty() {
        return Err("the name of the team has no visible character".into());
    }
    // Two folders whose names are no text would be one team.
    if name.contains(char::REPLACEMENT_CHARACTER) {
        return Err("the name of the team is not UTF-8. Try: another name of the folder".into());
    }
    match RESERVED_NAMES.iter().find(|own| team_key(own) == key) {
        Some(own) => Err(format!(
            "no team may have the name `{own}` (found `{}`). Try: another name of the folder, or --team NAME of pack",
            line(name)
        )),
        None => Ok(()),
    }
}

// Unicode's Default_Ignorable_Code_Point, control characters, and the blank of Braille.
fn is_invisible(c: char) -> bool {
    c.is_control()
        || matches!(u32::from(c),
            0xAD | 0x34F | 0x61C | 0x115F..=0x1160 | 0x17B4..=0x17B5 | 0x180B..=0x180F
            | 0x200B..=0x200F | 0x202A..=0x202E | 0x2060..=0x206F | 0x2800 | 0x3164
            | 0xFE00..=0xFE0F | 0xFEFF | 0xFFA0 | 0xFFF0..=0xFFF8 | 0x1BCA0..=0x1BCA3
            | 0x1D173..=0x1D17A | 0xE0000..=0xE0FFF)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spellings_of_one_name_are_one_team() {
        for name in [
            "Shear Team",
            "shear  team ",
            "ＳＨＥＡＲ\u{a0}team",
            "She\u{200b}ar T\u{ad}eam",
        ] {
            assert_eq!(team_key(name), "shearteam", "{name:?}");
        }
        // Cyrillic a, capital В and Н, and Greek omicron.
        for (alike, latin) in [("Sheаr", "shear"), ("ВОНR", "Bohr"), ("Cοsmo", "cosmo")] {
            assert_eq!(team_key(alike), team_key(latin));
        }
        for alike in ["A1ice", "ALlCE", "Álice", "Alicé"] {
            assert_eq!(team_key(alike), team_key("Alice"), "{alike}");
        }
        assert_eq!(team_key("h0st"), team_key("host"));
        assert_eq!(team_key("Космос"), team_key("КОСМОС"));
        assert_eq!(team_key("STRASSE é"), team_key("Straße e\u{301}"));
        assert_ne!(team_key("Team 1"), team_key("Team 2"));
        assert_eq!(team_key("\u{200b} \u{2800}"), "");
    }
}
