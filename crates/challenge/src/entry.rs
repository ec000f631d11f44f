//! What a challenge knows of an entry.

use std::path::PathBuf;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use shearq_results::record::SetRecord;
use shearq_results::submit::Contents;

/// What identifies a scored entry. The store keeps it with its scores, so the names are part of the format.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EntryInfo {
    pub challenge: String,
    pub team: String,
    pub method: String,
    /// One line about the entry; may be empty.
    pub title: String,
    /// Address for questions; may be empty. The leaderboard does not show it.
    pub contact: String,
    /// Time of arrival: of the receipt, or of the first `rank` that scored the entry.
    pub received: Timestamp,
    pub receipt: bool,
    pub file: String,
    pub sha256: String,
    /// SHA-256 of sets, images and files.
    pub content: String,
    pub contents: Contents,
    pub reference: bool,
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

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused {
    pub path: PathBuf,
    pub team: String,
    pub reason: String,
}
