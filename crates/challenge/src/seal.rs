//! Checksums of both folders of a challenge, the private key that belongs to them, and receipts of entries.
//!
//! `key.toml` contains the checksums of all private files and of the list of public checksums. The public description
//! contains a keyed hash of the private checksums, so that even the organiser cannot change the truth and its checksums
//! after participants have the public folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use hmac::{Hmac, KeyInit, Mac};
use jiff::Timestamp;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use shearq_dataset::fingerprint::hex;
use shearq_dataset::threads::Pool;
use shearq_files::atomic::list;
use shearq_files::{FileError, atomic, open};
use shearq_results::submit::FileSum;

use crate::error::ChallengeError;
use crate::kind::Noise;
use crate::terms::{CHALLENGE_FILE, Challenge};

/// Checksums of the public files, in the format of `sha256sum`.
pub const SUMS_FILE: &str = "SHA256SUMS";
/// The organiser's decisions in the private folder. They may change, so the seal does not cover them.
pub const BOARD_FILE: &str = "board.toml";
pub const KEY_FILE: &str = "key.toml";

/// SHA-256 of files by their names below a folder, with `/` between folders.
pub type Sums = BTreeMap<String, String>;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Key {
    pub name: String,
    pub version: u32,
    /// 128 random bits as text, because TOML has no such numbers; absent for images of another simulator.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<String>,
    /// 256 random bits in hexadecimal digits, which sign receipts and the private checksums.
    pub secret: String,
    /// SHA-256 of [`SUMS_FILE`] in the public folder; absent until that folder is complete.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub public: Option<String>,
    /// Errors below which no value is published; absent until the images were measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noise: Option<Noise>,
    #[serde(default)]
    pub files: Sums,
}

impl Key {
    pub fn new(name: &str, version: u32, seed: Option<u128>) -> Self {
        Key {
            name: name.into(),
            version,
            seed: seed.map(|seed| seed.to_string()),
            secret: hex(&rand::random::<[u8; 32]>()),
            public: None,
            noise: None,
            files: Sums::new(),
        }
    }

    pub fn read(private: &Path) -> Result<Option<Self>, FileError> {
        read_toml(&private.join(KEY_FILE), "key")
    }

    pub fn write(&self, private: &Path) -> Result<(), FileError> {
        let path = private.join(KEY_FILE);
        let text =
            toml::to_string(self).map_err(FileError::doing(&path, "cannot write the key"))?;
        atomic::write(&path, text.as_bytes())
    }

    /// HMAC-SHA256 of `parts` with the secret, in hexadecimal digits. `purpose` keeps signatures of one use from
    /// another.
    pub fn sign(&self, purpose: &str, parts: &[&str]) -> String {
        let mut mac = Hmac::<Sha256>::new_from_slice(self.secret.as_bytes())
            .expect("HMAC takes keys of any length");
        for part in [&["shearq", purpose][..], parts].concat() {
            // A zero byte after each part, so that no two lists of parts are the same bytes.
            mac.update(part.as_bytes());
            mac.update(&[0]);
        }
        hex(&mac.finalize().into_bytes())
    }

    /// Signature of the private checksums, for the public description.
    pub fn seal(&self) -> String {
        self.sign("truth", &[&sums_text(&self.files)])
    }
}

// Reads the file of a `thing`; `None` if it is absent.
pub(crate) fn read_toml<T: DeserializeOwned>(
    path: &Path,
    thing: &str,
) -> Result<Option<T>, FileError> {
    if !open::is_there(path) {
        return Ok(None);
    }
    let text = open::read_to_string(path, open::SETTINGS)
        .map_err(|error| FileError::new(path, format!("cannot read the {thing}: {error}")))?;
    let read = toml::from_str(&text);
    read.map_err(|error| FileError::new(path, error.to_string().trim_end()))
}

pub fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// Gives the private folder and its files to their owner alone. Does nothing on systems without file modes.
pub fn close(path: &Path) -> Result<(), FileError> {
    let folder = path.is_dir();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let mode = if folder { 0o700 } else { 0o600 };
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode))
            .map_err(FileError::doing(path, "cannot set the mode"))?;
    }
    match folder {
        true => list(path)?.iter().try_for_each(|inside| close(inside)),
        false => Ok(()),
    }
}

pub fn is_open_to_others(folder: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        folder
            .metadata()
            .is_ok_and(|about| about.permissions().mode() & 0o077 != 0)
    }
    #[cfg(not(unix))]
    {
        let _ = folder;
        false
    }
}

// Names of all files below a folder, without those that change after a challenge is complete.
pub(crate) fn names(folder: &Path) -> Result<Vec<String>, FileError> {
    let (mut folders, mut names) = (vec![folder.to_owned()], Vec::new());
    while let Some(next) = folders.pop() {
        for path in list(&next)? {
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let name = path.strip_prefix(folder).unwrap_or(&path);
            let parts: Vec<_> = name.iter().map(|part| part.to_string_lossy()).collect();
            let name = parts.join("/");
            if ![SUMS_FILE, KEY_FILE, BOARD_FILE].contains(&name.as_str()) {
                names.push(name);
            }
        }
    }
    Ok(names)
}

pub(crate) fn sums(
    folder: &Path,
    names: Vec<String>,
    threads: usize,
) -> Result<Sums, ChallengeError> {
    let pool = Pool::new(threads)?;
    let sums = pool.in_order(names, |name| {
        let sum = FileSum::of(&folder.join(&name))?.sha256;
        Ok((name, sum))
    });
    sums.collect()
}

fn sums_text(sums: &Sums) -> String {
    sums.iter()
        .map(|(name, sum)| format!("{sum}  {name}\n"))
        .collect()
}

/// Writes the checksums of all files below `public` and returns the SHA-256 of their list.
pub fn seal_public(public: &Path, threads: usize) -> Result<String, ChallengeError> {
    let text = sums_text(&sums(public, names(public)?, threads)?);
    atomic::write(public.join(SUMS_FILE), text.as_bytes())?;
    Ok(sha256(text.as_bytes()))
}

fn read_sums(public: &Path) -> Result<(Sums, String), FileError> {
    let path = public.join(SUMS_FILE);
    let bytes = open::read(&path, open::DATA).map_err(FileError::doing(&path, "cannot read it"))?;
    let text = String::from_utf8_lossy(&bytes);
    let sums = text
        .lines()
        .filter_map(|line| line.split_once("  "))
        .map(|(sum, name)| (name.to_owned(), sum.to_owned()))
        .collect();
    Ok((sums, sha256(&bytes)))
}

// Compares files below `folder` with their checksums in `list`.
fn unchanged(
    folder: &Path,
    names: Vec<String>,
    expected: &Sums,
    list: &str,
    threads: usize,
) -> Result<(), ChallengeError> {
    for (name, found) in sums(folder, names, threads)? {
        let expected = expected.get(&name).map_or("no such file", String::as_str);
        if found != expected {
            let message = format!(
                "the file was changed (found SHA-256 {found}, expected {expected} of {list})"
            );
            return Err(FileError::new(folder.join(name), message).into());
        }
    }
    Ok(())
}

/// Checks the public files that are there against [`SUMS_FILE`]. A participant may have downloaded some sets only.
pub fn verify_public(public: &Path, threads: usize) -> Result<(), ChallengeError> {
    let (expected, _) = read_sums(public)?;
    let is_there = |name: &&String| open::is_there(&public.join(name));
    let names = expected.keys().filter(is_there).cloned().collect();
    unchanged(public, names, &expected, SUMS_FILE, threads)
}

/// Checks that the description in `public` and the key in `private` belong together, and that no private file was changed.
/// Returns the key and the SHA-256 that identifies the challenge.
pub fn verify(
    public: &Path,
    private: &Path,
    challenge: &Challenge,
    threads: usize,
) -> Result<(Key, String), ChallengeError> {
    let key = Key::read(private)?.ok_or_else(|| {
        let message = format!(
            "there is no {KEY_FILE}; expected the private folder that `shearq challenge new` wrote"
        );
        FileError::new(private, message)
    })?;
    let (sums, id) = read_sums(public)?;
    if key.public.as_ref() != Some(&id) {
        let expected = key.public.as_deref().unwrap_or("a complete challenge");
        let message = format!(
            "the public folder does not belong to {} (found SHA-256 {id}, expected {expected})",
            private.display()
        );
        return Err(FileError::new(public.join(SUMS_FILE), message).into());
    }
    unchanged(
        public,
        vec![CHALLENGE_FILE.into()],
        &sums,
        SUMS_FILE,
        threads,
    )?;
    if challenge.seal != key.seal() {
        let message = format!(
            "the checksums are not those of the challenge (found seal {}, expected {} of {CHALLENGE_FILE})",
            key.seal(),
            challenge.seal
        );
        return Err(FileError::new(private.join(KEY_FILE), message).into());
    }
    let names = key.files.keys().cloned().collect();
    unchanged(private, names, &key.files, KEY_FILE, threads)?;
    Ok((key, id))
}

/// A signed statement of when an entry arrived.
///
/// A receipt shows that somebody with the private folder had this archive, under this team's name, at the stated time. It
/// shows neither who sent the archive nor whose work it is, and it does not bind the organisers themselves, who have the
/// secret and the clock.
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

    const ENDING: &str = ".receipt.toml";

    pub fn path(entry: &Path) -> PathBuf {
        let mut name = entry.file_name().unwrap_or_default().to_owned();
        name.push(Receipt::ENDING);
        entry.with_file_name(name)
    }

    /// The entry whose receipt has this path.
    pub fn entry_of(receipt: &Path) -> Option<PathBuf> {
        let name = receipt.file_name()?.to_str()?;
        Some(receipt.with_file_name(name.strip_suffix(Receipt::ENDING)?))
    }

    fn stored(path: &Path) -> Result<Option<Self>, FileError> {
        refuse_link(path)?;
        read_toml(path, "receipt")
    }

    /// The receipt that the content has already; `None` if there is no receipt, or one of other content.
    pub fn earlier(key: &Key, entry: &Path, sha256: &str) -> Result<Option<Self>, FileError> {
        let stored = Receipt::stored(&Receipt::path(entry));
        let earlier = stored.and_then(|stored| match stored {
            Some(receipt) if receipt.sha256 == sha256 => Receipt::read(key, entry, sha256),
            _ => Ok(None),
        });
        earlier
            .map_err(|error| error.hint("move the receipt away and sign again, for a later time"))
    }

    pub fn read(key: &Key, entry: &Path, sha256: &str) -> Result<Option<Self>, FileError> {
        let path = Receipt::path(entry);
        let Some(receipt) = Receipt::stored(&path)? else {
            return Ok(None);
        };
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

    // A folder, a key, and a receipt for the content 1f.
    fn signed() -> (tempfile::TempDir, Key, Receipt) {
        let key = Key::new("pilot", 1, None);
        let time = "2026-11-24T10:00:00Z".parse().unwrap();
        let receipt = Receipt::sign(&key, "A", time, "1f");
        (tempfile::tempdir().unwrap(), key, receipt)
    }

    #[cfg(unix)]
    #[test]
    fn a_link_is_neither_read_nor_written() {
        let (folder, key, receipt) = signed();
        let (entry, target) = (folder.path().join("a.tgz"), folder.path().join("target"));
        std::fs::write(&target, toml::to_string(&receipt).unwrap()).unwrap();
        std::os::unix::fs::symlink(&target, Receipt::path(&entry)).unwrap();
        let error = Receipt::read(&key, &entry, "1f").unwrap_err();
        assert!(error.text().contains("link"), "{error}");
        assert!(receipt.write(&entry).is_err());
    }

    #[test]
    fn only_the_signed_time_team_and_content_are_accepted() {
        let (folder, key, receipt) = signed();
        let entry = folder.path().join("a.tar.gz");
        assert_eq!(Receipt::read(&key, &entry, "1f").unwrap(), None);
        let path = receipt.write(&entry).unwrap();
        let read = |key: &Key| Receipt::read(key, &entry, "1f");
        assert_eq!(read(&key).unwrap(), Some(receipt.clone()));
        assert!(read(&Key::new("pilot", 1, None)).is_err());
        assert!(Receipt::read(&key, &entry, "2f").is_err());
        let earlier = |sha256| Receipt::earlier(&key, &entry, sha256);
        assert_eq!(earlier("1f").unwrap(), Some(receipt.clone()));
        assert_eq!(earlier("2f").unwrap(), None);
        let text = toml::to_string(&receipt).unwrap();
        for (from, to) in [("-24T", "-23T"), ("\"A\"", "\"B\""), ("pilot", "pirat")] {
            std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
            let error = read(&key).unwrap_err();
            assert!(error.text().contains("not signed"), "{to}: {error}");
        }
        // A receipt of a later time must not take its place.
        for broken in [&text[..40], &text.replacen("-24T", "-23T", 1)] {
            std::fs::write(&path, broken).unwrap();
            let error = earlier("1f").unwrap_err();
            assert!(error.text().contains("move the receipt away"), "{error}");
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
