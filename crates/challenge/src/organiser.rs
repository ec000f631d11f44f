//! What organisers decide about a board: withdrawn entries, and names that stand for teams.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Deserialize;
use shearq_files::{FileError, open};

use crate::judge::Entry;
use crate::seal::{BOARD_FILE, Key};

// Fewest digits of an SHA-256 that name an entry.
const LEAST_DIGITS: usize = 8;

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Decisions {
    /// Whether teams without an alias have drawn names, and methods, titles and refused entries are not published.
    pub anonymous: bool,
    pub aliases: BTreeMap<String, String>,
    /// Reasons, by the first digits of the SHA-256 of the archive, or `DIGITS/TEAM` if several teams sent it.
    pub withdrawn: BTreeMap<String, String>,
}

impl Decisions {
    /// Reads the decisions in a private folder; without a file there are none.
    pub fn read(private: &Path) -> Result<Self, FileError> {
        let path = private.join(BOARD_FILE);
        if !open::is_there(&path) {
            return Ok(Decisions::default());
        }
        let text = open::read_to_string(&path, open::SETTINGS)
            .map_err(FileError::doing(&path, "cannot read the decisions"))?;
        toml::from_str(&text).map_err(|e| FileError::new(&path, e.to_string().trim_end()))
    }

    /// Marks withdrawn entries and replaces the names of teams.
    ///
    /// # Errors
    /// If an entry or a team is unknown, or a name stands for two teams.
    pub fn apply(&self, entries: &mut [Entry], key: &Key) -> Result<(), String> {
        for (id, reason) in &self.withdrawn {
            // Two teams may have sent the same archive.
            let (digits, team) = match id.split_once('/') {
                Some((digits, team)) => (digits, Some(team)),
                None => (id.as_str(), None),
            };
            let names = |entry: &Entry| {
                digits.len() >= LEAST_DIGITS
                    && entry.info.sha256.starts_with(digits)
                    && team.is_none_or(|team| entry.info.team == team)
            };
            let named: Vec<usize> = (0..entries.len()).filter(|k| names(&entries[*k])).collect();
            let [entry] = named.as_slice() else {
                let known: Vec<String> = entries
                    .iter()
                    .map(|entry| {
                        let info = &entry.info;
                        format!("{} ({}, {})", info.short_id(), info.team, info.file)
                    })
                    .collect();
                return Err(format!(
                    "`withdrawn` names no single entry (found `{id}`, expected {LEAST_DIGITS} digits or more of an SHA-256: {})",
                    known.join(", ")
                ));
            };
            entries[*entry].withdrawn = Some(reason.clone());
        }
        let teams: BTreeSet<String> = entries
            .iter()
            .filter(|entry| !entry.info.reference)
            .map(|entry| entry.info.team.clone())
            .collect();
        if let Some(unknown) = self.aliases.keys().find(|team| !teams.contains(*team)) {
            let known: Vec<&str> = teams.iter().map(String::as_str).collect();
            return Err(format!(
                "`aliases` has an unknown team (found `{unknown}`, expected one of {})",
                known.join(", ")
            ));
        }
        let mut names: BTreeMap<String, String> = BTreeMap::new();
        for team in &teams {
            let name = match (self.aliases.get(team), self.anonymous) {
                (Some(alias), _) => alias.clone(),
                // Neither the order of arrival nor the rank may tell the name, and it stays from board to board.
                (None, true) => format!("team {}", &key.sign("team", &[team])[..6]),
                (None, false) => team.clone(),
            };
            if let Some((other, _)) = names.iter().find(|(_, own)| **own == name) {
                return Err(format!("`{name}` stands for two teams: {other} and {team}"));
            }
            names.insert(team.clone(), name);
        }
        for Entry { info, .. } in entries.iter_mut().filter(|entry| !entry.info.reference) {
            info.team = names[&info.team].clone();
            if self.anonymous {
                info.method.clear();
                info.title.clear();
            }
        }
        Ok(())
    }
}
