//! Entries that were scored.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use shearq_results::record::SetRecord;
use shearq_results::submit::manifest::Contents;

/// A scored entry, as the store keeps it with its scores.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EntryInfo {
    /// Name of the challenge.
    pub challenge: String,
    /// Name of the team.
    pub team: String,
    /// Name of the method.
    pub method: String,
    /// One line about the entry; may be empty.
    pub title: String,
    /// Address for questions; may be empty. The leaderboard does not show it.
    pub contact: String,
    /// Time of arrival: of the receipt, or of the first `rank` that scored the entry.
    pub received: Timestamp,
    /// Whether a receipt states the time.
    pub receipt: bool,
    /// Name of the archive or folder.
    pub file: String,
    /// SHA-256 of the archive.
    pub sha256: String,
    /// SHA-256 of sets, images and files.
    pub content: String,
    /// First digits of the checksum of each file.
    pub files: Vec<String>,
    /// Some mean shapes of each set of catalogues ([`sketch`](crate::copies::sketch)).
    pub shapes: BTreeMap<String, Vec<i32>>,
    /// Kind of files.
    pub contents: Contents,
    /// Whether it is a reference of the organiser, without a rank.
    pub reference: bool,
}

/// A scored entry of the store.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Team, method and time.
    pub info: EntryInfo,
    /// Scores of each set.
    pub sets: Vec<SetRecord>,
    /// Why the organiser withdrew it.
    pub withdrawn: Option<String>,
}
