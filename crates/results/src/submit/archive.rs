//! Compressed archives (`.tar.gz`) of submissions; the same files give the same bytes.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Write};
use std::path::Path;

use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use flate2::{Compression, GzBuilder};
use tar::{Archive, Builder, Header};

use super::manifest::{FileSum, MANIFEST_FILE, Manifest};
use shearq_files::FileError;
use shearq_files::atomic::{PartFile, PartFolder, sweep_beside};
use shearq_files::open::{is_there, open};

// Largest accepted manifest in bytes: about 200 per file, with room for covariances.
const MAX_MANIFEST_BYTES: u64 = 1 << 26;

// Largest accepted compression ratio beyond the first [`FREE_BYTES`] bytes. ASCII numbers reach 3, blank catalogues
// about 100.
const MAX_RATIO: u64 = 300;
// Unpacked bytes that any archive may have.
const FREE_BYTES: u64 = 1 << 24;
// Bytes counted per file in addition to its content, about its cost on disk.
const BYTES_PER_FILE: u64 = 1 << 12;
// Most files, including the manifest: more than 8,000 images in each of 24 sets.
pub const MAX_FILES: u64 = 200_000;

pub fn is_archive(path: &Path) -> bool {
    let name = path.to_string_lossy();
    name.ends_with(".tar.gz") || name.ends_with(".tgz")
}

pub struct ArchiveWriter {
    builder: Builder<GzEncoder<BufWriter<File>>>,
    part: PartFile,
}

impl std::fmt::Debug for ArchiveWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ArchiveWriter").finish_non_exhaustive()
    }
}

impl ArchiveWriter {
    pub fn create(path: &Path) -> Result<Self, FileError> {
        if is_there(path) {
            return Err(exists(path));
        }
        sweep_beside(path);
        let (part, file) = PartFile::create(path)?;
        // Time and system would change the bytes.
        let encoder = GzBuilder::new()
            .mtime(0)
            .operating_system(UNKNOWN_SYSTEM)
            .write(BufWriter::new(file), Compression::default());
        Ok(ArchiveWriter {
            builder: Builder::new(encoder),
            part,
        })
    }

    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), FileError> {
        let mut header = Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_mtime(0);
        header.set_uid(0);
        header.set_gid(0);
        self.builder
            .append_data(&mut header, name, bytes)
            .map_err(cannot_write(self.part.target()))
    }

    pub fn finish(self) -> Result<(), FileError> {
        let ArchiveWriter { builder, part } = self;
        builder
            .into_inner()
            .and_then(GzEncoder::finish)
            .and_then(|mut file| file.flush())
            .map_err(cannot_write(part.target()))?;
        let path = part.target().to_owned();
        match part.finish_if_absent()? {
            true => Ok(()),
            false => Err(exists(&path)),
        }
    }
}

fn exists(path: &Path) -> FileError {
    FileError::new(
        path,
        "the archive exists already; expected a new file. Try: another name for --out",
    )
}

// gzip's code for an unknown system.
const UNKNOWN_SYSTEM: u8 = 255;

fn cannot_write(path: &Path) -> impl FnOnce(std::io::Error) -> FileError {
    FileError::doing(path, "cannot write the archive")
}

#[derive(Debug, Clone)]
pub struct Unpacked {
    pub manifest: Option<Manifest>,
    pub files: BTreeMap<String, FileSum>,
}

impl Unpacked {
    /// Compares the files with the manifest, which must exist if it is `required`.
    pub fn verify(&self, archive: &Path, required: bool) -> Result<(), FileError> {
        let faults = match &self.manifest {
            Some(manifest) => manifest.faults(&self.files),
            None if required => {
                let message =
                    format!("cannot verify the files, because there is no {MANIFEST_FILE}");
                return Err(FileError::new(archive, message));
            }
            None => Vec::new(),
        };
        if faults.is_empty() {
            return Ok(());
        }
        let lines: Vec<String> = faults
            .iter()
            .map(|(name, message)| format!("\n  {name}: {message}"))
            .collect();
        let message = format!("the files disagree with {MANIFEST_FILE}:{}", lines.concat());
        Err(FileError::new(archive, message))
    }
}

/// Unpacks the archive at `path` into the new folder `out`. After an error no folder remains. The manifest must exist if
/// it is `required`.
pub fn unpack(path: &Path, out: &Path, required: bool) -> Result<Unpacked, FileError> {
    let part = PartFolder::new(out)?;
    // Read completely before any file is written.
    read(path, None)?.verify(path, required)?;
    let unpacked = read(path, Some(part.path()))?;
    unpacked.verify(path, required)?;
    part.finish()?;
    Ok(unpacked)
}

/// Reads a whole archive and writes its files to the folder `into`, if given.
pub fn read(path: &Path, into: Option<&Path>) -> Result<Unpacked, FileError> {
    let cannot_read = || FileError::doing::<std::io::Error>(path, "cannot read the archive");
    let file = open(path).map_err(cannot_read())?;
    let most = FREE_BYTES + MAX_RATIO * file.metadata().map_err(cannot_read())?.len();
    let mut files = 0;
    let mut archive = Archive::new(Bounded {
        decoder: GzDecoder::new(BufReader::new(file)),
        read: 0,
        most,
    });
    let mut unpacked = Unpacked {
        manifest: None,
        files: BTreeMap::new(),
    };
    // Raw: extensions of tar, such as names of any length, are entries that are not plain files.
    for entry in archive.entries().map_err(cannot_read())?.raw(true) {
        let mut entry = entry.map_err(cannot_read())?;
        // Python's tarfile writes PAX headers for times and long names. Names and sizes here are those of the plain headers.
        let kind = entry.header().entry_type();
        if kind.is_pax_global_extensions() || kind.is_pax_local_extensions() {
            continue;
        }
        let name = String::from_utf8_lossy(&entry.path_bytes()).into_owned();
        // `tar czf … -C folder .` starts with the folder itself.
        if name == "./" && entry.header().entry_type().is_dir() {
            continue;
        }
        let name = match name.strip_prefix("./") {
            Some(rest) if is_plain_name(rest) => rest.to_owned(),
            _ => name,
        };
        if !entry.header().entry_type().is_file() || !is_plain_name(&name) {
            let message = format!(
                "unsupported member (found `{name}`, expected plain files without folders)"
            );
            return Err(FileError::new(path, message));
        }
        if unpacked.files.contains_key(&name)
            || (name == MANIFEST_FILE && unpacked.manifest.is_some())
        {
            let message = format!("the archive contains `{name}` twice");
            return Err(FileError::new(path, message));
        }
        files += 1;
        if files > MAX_FILES.min(most / BYTES_PER_FILE) {
            let message = format!("too many files (found more than {})", files - 1);
            return Err(FileError::new(path, message));
        }
        let mut bytes = Vec::new();
        let mut target: Box<dyn Write> = match into {
            _ if name == MANIFEST_FILE => Box::new(&mut bytes),
            None => Box::new(std::io::sink()),
            Some(folder) => {
                let target = folder.join(&name);
                Box::new(
                    File::create_new(&target).map_err(FileError::doing(&target, "cannot write"))?,
                )
            }
        };
        if name == MANIFEST_FILE && entry.size() > MAX_MANIFEST_BYTES {
            let message = format!(
                "{MANIFEST_FILE} is too large (found {} bytes, expected at most {MAX_MANIFEST_BYTES})",
                entry.size()
            );
            return Err(FileError::new(path, message));
        }
        let sum = FileSum::copying(&mut entry, &mut target)
            .map_err(|error| FileError::new(path, format!("cannot unpack `{name}`: {error}")))?;
        drop(target);
        if name != MANIFEST_FILE {
            unpacked.files.insert(name, sum);
            continue;
        }
        let manifest: Manifest = serde_json::from_slice(&bytes).map_err(|error| {
            FileError::new(
                path,
                format!("{MANIFEST_FILE} is not the manifest of a submission: {error}"),
            )
        })?;
        unpacked.manifest = Some(manifest);
        if let Some(folder) = into {
            std::fs::write(folder.join(MANIFEST_FILE), &bytes)
                .map_err(FileError::doing(folder, "cannot write the manifest"))?;
        }
    }
    check_end(archive.into_inner()).map_err(cannot_read())?;
    Ok(unpacked)
}

struct Bounded {
    decoder: GzDecoder<BufReader<File>>,
    read: u64,
    most: u64,
}

impl Read for Bounded {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let found = self.decoder.read(buffer)?;
        self.read += found as u64;
        if self.read > self.most {
            let most = self.most;
            let message = format!("it unpacks to more than {most} bytes");
            return Err(std::io::Error::new(
                std::io::ErrorKind::FileTooLarge,
                message,
            ));
        }
        Ok(found)
    }
}

// Checks that only blank blocks and the checksum of gzip follow the last file.
fn check_end(mut archive: Bounded) -> std::io::Result<()> {
    let wrong = |what| Err(std::io::Error::new(std::io::ErrorKind::InvalidData, what));
    let mut buffer = [0; 4096];
    loop {
        let read = archive.read(&mut buffer)?;
        if read == 0 {
            break;
        }
        if buffer[..read].iter().any(|byte| *byte != 0) {
            return wrong("found data after the end");
        }
    }
    if archive.decoder.into_inner().read(&mut buffer)? > 0 {
        return wrong("found data after the end");
    }
    Ok(())
}

fn is_plain_name(name: &str) -> bool {
    !name.is_empty()
        && !name.starts_with('.')
        && !name.contains(|c: char| "/\\:".contains(c) || c.is_control())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The error of reading an archive of files, and bytes after its end.
    fn refusal(files: &mut dyn Iterator<Item = (String, &[u8])>, after: u64) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tar.gz");
        let mut writer = ArchiveWriter::create(&path).unwrap();
        for (name, bytes) in files {
            writer.add(&name, bytes).unwrap();
        }
        writer.builder.finish().unwrap();
        let zeros = std::io::repeat(0).take(after);
        std::io::copy(&mut { zeros }, writer.builder.get_mut()).unwrap();
        writer.finish().unwrap();
        read(&path, None)
            .err()
            .map_or_else(String::new, |e| e.message)
    }

    #[test]
    fn everything_in_an_archive_is_counted() {
        let mut one = [("a".to_owned(), &b"x"[..])].into_iter();
        assert_eq!(refusal(&mut one.clone(), 1 << 20), "");
        let message = refusal(&mut one, 200 << 20);
        assert!(message.contains("it unpacks to more than"), "{message}");
        let mut empty = (0..30_000).map(|k| (format!("{k}"), &b""[..]));
        let message = refusal(&mut empty, 0);
        assert!(message.contains("too many files"), "{message}");
        let zeros = vec![0; 64 << 20];
        let message = refusal(&mut [("a".to_owned(), &zeros[..])].into_iter(), 0);
        assert!(message.contains("it unpacks to more than"), "{message}");
    }

    #[test]
    fn pax_headers_are_no_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tar.gz");
        let mut writer = ArchiveWriter::create(&path).unwrap();
        for kind in [tar::EntryType::XGlobalHeader, tar::EntryType::XHeader] {
            let times = b"20 mtime=1700000000\n";
            let mut header = Header::new_ustar();
            header.set_entry_type(kind);
            header.set_size(times.len() as u64);
            writer
                .builder
                .append_data(&mut header, "pax/header", &times[..])
                .unwrap();
        }
        writer.add("a", b"x").unwrap();
        writer.finish().unwrap();
        let names: Vec<String> = read(&path, None).unwrap().files.into_keys().collect();
        assert_eq!(names, ["a"]);
    }

    #[test]
    fn an_invalid_manifest_is_refused() {
        for wrong in ["null", "[]", "{}", "1", "", "{\"method\": null}"] {
            let mut files = [(MANIFEST_FILE.to_owned(), wrong.as_bytes())].into_iter();
            let message = refusal(&mut files, 0);
            assert!(
                message.contains("is not the manifest of a submission"),
                "{wrong}: {message}"
            );
        }
    }
}
