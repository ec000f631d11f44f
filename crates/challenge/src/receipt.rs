//! Receipts: signed statements of when an entry arrived.
//!
//! A receipt shows that somebody with the private folder had this archive, under this team's name, at the stated time. It
//! shows neither who sent the archive nor whose work it is, and it does not bind the organisers themselves, who have the
//! secret and the clock.

use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use shearq_files::{FileError, atomic, open};

use crate::seal::Key;

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Receipt {
    pub challenge: String,
    pub team: String,
    pub received: Timestamp,
    /// SHA-256 of the archive, or of the list of a folder's files.
    pub sha256: String,
    /// HMAC-SHA256 of the other values with the secret of the private folder.
    pub signature: String,
}

impl Receipt {
    pub fn sign(key: &Key, team: &str, received: Timestamp, sha256: &str) -> Self {
        let mut receipt = Receipt {
            challenge: key.name.clone(),
            team: team.into(),
            received,
            sha256: sha256.into(),
            signature: String::new(),
        };
        receipt.signature = receipt.signed(key);
        receipt
    }

    fn signed(&self, key: &Key) -> String {
        let (version, received) = (key.version.to_string(), self.received.to_string());
        key.sign(
            "receipt",
            &[
                &self.challenge,
                &version,
                &self.team,
                &received,
                &self.sha256,
            ],
        )
    }

    pub fn path(entry: &Path) -> PathBuf {
        let mut name = entry.file_name().unwrap_or_default().to_owned();
        name.push(".receipt.toml");
        entry.with_file_name(name)
    }

    /// Reads the receipt of an entry; `None` if there is none.
    pub fn read(key: &Key, entry: &Path, sha256: &str) -> Result<Option<Self>, FileError> {
        let path = Receipt::path(entry);
        refuse_link(&path)?;
        if !open::is_there(&path) {
            return Ok(None);
        }
        let text = open::read_to_string(&path, open::SETTINGS)
            .map_err(FileError::doing(&path, "cannot read the receipt"))?;
        let receipt: Receipt =
            toml::from_str(&text).map_err(|e| FileError::new(&path, e.to_string().trim_end()))?;
        if receipt.sha256 != sha256 {
            let message = format!(
                "the receipt belongs to other content (found SHA-256 {}, expected {sha256})",
                receipt.sha256
            );
            return Err(FileError::new(path, message));
        }
        if receipt.signature != receipt.signed(key) {
            let message = "the receipt was not signed with the key of this challenge";
            return Err(FileError::new(path, message));
        }
        Ok(Some(receipt))
    }

    /// Writes the receipt beside the entry and returns its path.
    pub fn write(&self, entry: &Path) -> Result<PathBuf, FileError> {
        let path = Receipt::path(entry);
        refuse_link(&path)?;
        let text =
            toml::to_string(self).map_err(FileError::doing(&path, "cannot write the receipt"))?;
        atomic::write(&path, text.as_bytes())?;
        Ok(path)
    }
}

// A link in an inbox may name any file of the organiser's system.
fn refuse_link(path: &Path) -> Result<(), FileError> {
    match path.is_symlink() {
        true => Err(FileError::new(path, "this is a link; expected a file")),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(unix)]
    #[test]
    fn a_link_is_neither_read_nor_written() {
        let folder = tempfile::tempdir().unwrap();
        let (entry, target) = (folder.path().join("a.tgz"), folder.path().join("target"));
        let key = Key::new("pilot", 1, None);
        let receipt = Receipt::sign(&key, "A", "2026-11-24T10:00:00Z".parse().unwrap(), "1f");
        std::fs::write(&target, toml::to_string(&receipt).unwrap()).unwrap();
        std::os::unix::fs::symlink(&target, Receipt::path(&entry)).unwrap();
        assert!(
            Receipt::read(&key, &entry, "1f")
                .unwrap_err()
                .message
                .contains("link")
        );
        assert!(receipt.write(&entry).is_err());
    }

    #[test]
    fn only_the_signed_time_team_and_content_are_accepted() {
        let folder = tempfile::tempdir().unwrap();
        let entry = folder.path().join("a.tar.gz");
        let key = Key::new("pilot", 1, None);
        let receipt = Receipt::sign(&key, "A", "2026-11-24T10:00:00Z".parse().unwrap(), "1f");
        assert_eq!(Receipt::read(&key, &entry, "1f").unwrap(), None);
        let path = receipt.write(&entry).unwrap();
        let read = |key: &Key| Receipt::read(key, &entry, "1f");
        assert_eq!(read(&key).unwrap(), Some(receipt.clone()));
        assert!(read(&Key::new("pilot", 1, None)).is_err());
        assert!(Receipt::read(&key, &entry, "2f").is_err());
        for (from, to) in [
            ("2026-11-24", "2026-11-23"),
            ("\"A\"", "\"B\""),
            ("pilot", "pirat"),
        ] {
            let text = toml::to_string(&receipt).unwrap();
            std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
            assert!(
                read(&key).unwrap_err().message.contains("not signed"),
                "{to}"
            );
        }
    }

    #[test]
    fn signatures_are_hmac_sha256() {
        // RFC 4231 has no text with NUL bytes; the value is Python's hmac.new(b"k", b"shearq\0p\0a\0", "sha256").
        let mut key = Key::new("pilot", 1, None);
        key.secret = "k".into();
        let expected = "d991599aeae2e087af36c4ebc918d97b5352b998917f29a2ecba5cbabb577abd";
        assert_eq!(key.sign("p", &["a"]), expected);
    }
}
