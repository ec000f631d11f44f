//! Archives of submissions, `.tar.gz` and `.zip`, read to a limit of bytes.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Error, ErrorKind, Read, Write};
use std::path::Path;

use flate2::bufread::{DeflateDecoder, GzDecoder};
use rawzip::{CompressionMethod, RECOMMENDED_BUFFER_SIZE, ZipArchive};
use shearq_files::FileError;
use shearq_files::atomic::PartFolder;
use shearq_files::open::open;
use shearq_render::escape::line;
use tar::Archive;

use super::manifest::{FileSum, MANIFEST_FILE, Manifest};

// Largest accepted manifest in bytes: about 200 per file, with room for covariances.
const MAX_MANIFEST_BYTES: u64 = 1 << 26;

// Largest accepted compression ratio beyond the first [`FREE_BYTES`] bytes. ASCII numbers reach 3, blank catalogues
// about 100.
const MAX_RATIO: u64 = 300;
// Unpacked bytes that any archive may have.
const FREE_BYTES: u64 = 1 << 24;
// Bytes counted per file in addition to its content, about its cost on disk.
const BYTES_PER_FILE: u64 = 1 << 12;
/// Most files, including the manifest: more than 8,000 images in each of 24 sets.
pub const MAX_FILES: u64 = 200_000;

/// Whether `pack` writes an archive under this name, and not a folder.
pub fn is_tar_gz(path: &Path) -> bool {
    let name = path.to_string_lossy().to_ascii_lowercase();
    name.ends_with(".tar.gz") || name.ends_with(".tgz")
}

/// Whether a file has the name of an archive that is read.
pub fn is_archive(path: &Path) -> bool {
    let ending = path.extension().unwrap_or_default();
    is_tar_gz(path) || ending.eq_ignore_ascii_case("zip")
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArchiveFormat {
    TarGz,
    Zip,
}

impl ArchiveFormat {
    /// The format that the first bytes of a file show, whatever its name.
    pub fn of_content(path: &Path) -> std::io::Result<Option<Self>> {
        let mut first = Vec::new();
        open(path)?.take(4).read_to_end(&mut first)?;
        Ok(match first.as_slice() {
            [0x1f, 0x8b, ..] => Some(ArchiveFormat::TarGz),
            // The second one is an archive without files.
            b"PK\x03\x04" | b"PK\x05\x06" => Some(ArchiveFormat::Zip),
            _ => None,
        })
    }
}

/// The manifest of an archive, and the checksums of its other files.
#[derive(Debug, Clone, Default)]
pub struct Unpacked {
    pub manifest: Option<Manifest>,
    pub files: BTreeMap<String, FileSum>,
}

impl Unpacked {
    /// Compares the files with the manifest, which must exist if it is `required`.
    pub fn verify(&self, archive: &Path, required: bool) -> Result<(), FileError> {
        match &self.manifest {
            Some(manifest) => manifest.verify(&self.files, archive),
            None if required => {
                let message =
                    format!("cannot verify the files, because there is no {MANIFEST_FILE}");
                Err(FileError::new(archive, message))
            }
            None => Ok(()),
        }
    }
}

/// Unpacks the archive at `path` into the new folder `out`. After an error no folder remains. The manifest must exist if
/// it is `required`.
pub fn unpack(path: &Path, out: &Path, required: bool) -> Result<Unpacked, FileError> {
    let part = PartFolder::new(out)?;
    let unpacked = read_archive(path, Some(part.path()), None)?;
    unpacked.verify(path, required)?;
    part.finish()?;
    Ok(unpacked)
}

/// Reads a whole archive and writes its files to the folder `into`, if given. They may unpack to `most` bytes; without a
/// limit, to some hundred times the size of the archive.
pub fn read_archive(
    path: &Path,
    into: Option<&Path>,
    most: Option<u64>,
) -> Result<Unpacked, FileError> {
    let cannot_read = || FileError::doing::<Error>(path, "cannot read the archive");
    let file = open(path).map_err(cannot_read())?;
    let bytes = file.metadata().map_err(cannot_read())?.len();
    let most = most.unwrap_or(FREE_BYTES + MAX_RATIO * bytes);
    let members = Members {
        path,
        into,
        most,
        folder: None,
        unpacked: Unpacked::default(),
    };
    match ArchiveFormat::of_content(path).map_err(cannot_read())? {
        Some(ArchiveFormat::Zip) => members.of_zip(file),
        _ => members.of_tar(file),
    }
}

// The members of an archive that were read so far.
struct Members<'a> {
    path: &'a Path,
    into: Option<&'a Path>,
    most: u64,
    // The one folder that contains all files, if there is one.
    folder: Option<String>,
    unpacked: Unpacked,
}

impl Members<'_> {
    fn of_tar(mut self, file: File) -> Result<Unpacked, FileError> {
        let path = self.path;
        let cannot_read = || FileError::doing::<Error>(path, "cannot read the archive");
        let mut archive = Archive::new(Bounded {
            inner: GzDecoder::new(BufReader::new(file)),
            read: 0,
            most: self.most,
        });
        // Raw: extensions of tar, such as names of any length, are entries that are not plain files.
        for entry in archive.entries().map_err(cannot_read())?.raw(true) {
            let mut entry = entry.map_err(cannot_read())?;
            // Python's tarfile writes PAX headers for times and long names. Names and sizes here are those of the plain headers.
            let kind = entry.header().entry_type();
            if kind.is_pax_global_extensions() || kind.is_pax_local_extensions() {
                continue;
            }
            let name = String::from_utf8_lossy(&entry.path_bytes()).into_owned();
            if kind.is_dir() {
                continue;
            }
            self.add(&name, kind.is_file(), &mut entry)?;
        }
        check_end(archive.into_inner()).map_err(cannot_read())?;
        Ok(self.unpacked)
    }

    fn of_zip(mut self, file: File) -> Result<Unpacked, FileError> {
        let path = self.path;
        let cannot_read = || FileError::doing(path, "cannot read the archive");
        let mut buffer = vec![0; RECOMMENDED_BUFFER_SIZE];
        let archive = ZipArchive::from_file(file, &mut buffer).map_err(cannot_read())?;
        let mut members = archive.entries(&mut buffer);
        let mut read = 0;
        while let Some(member) = members.next_entry().map_err(cannot_read())? {
            if member.is_dir() {
                continue;
            }
            // Some programs write the separators of Windows.
            let name = String::from_utf8_lossy(member.file_path().as_bytes()).replace('\\', "/");
            let is_file = !member.mode().is_symlink();
            let method = member.compression_method();
            let content = archive
                .get_entry(member.wayfinder())
                .map_err(cannot_read())?;
            let inner: Box<dyn Read> = match method {
                CompressionMethod::STORE => Box::new(content.verifying_reader(content.reader())),
                CompressionMethod::DEFLATE => {
                    let decoder = DeflateDecoder::new(BufReader::new(content.reader()));
                    Box::new(content.verifying_reader(decoder))
                }
                _ => {
                    let message = format!(
                        "cannot unpack `{name}`: its compression or encryption is not supported"
                    );
                    return Err(FileError::new(path, message).hint("deflate, without a password"));
                }
            };
            let most = self.most;
            let mut bounded = Bounded { inner, read, most };
            self.add(&name, is_file, &mut bounded)?;
            read = bounded.read;
        }
        Ok(self.unpacked)
    }

    fn add(&mut self, full: &str, is_file: bool, content: &mut dyn Read) -> Result<(), FileError> {
        let wrong = |message: String| FileError::new(self.path, message);
        let inside = full.strip_prefix("./").unwrap_or(full);
        if is_of_system(inside) {
            return Ok(());
        }
        // A folder that was packed as a whole.
        let (folder, name) = match inside.split_once('/') {
            Some((folder, name)) if is_plain_name(folder) => (Some(folder), name),
            _ => (None, inside),
        };
        let count = self.unpacked.files.len() + usize::from(self.unpacked.manifest.is_some());
        if count == 0 {
            self.folder = folder.map(str::to_owned);
        }
        if !is_file || !is_plain_name(name) || folder != self.folder.as_deref() {
            return Err(wrong(format!(
                "unsupported member (found `{}`, expected plain files, all in one folder or in none)",
                line(full)
            )));
        }
        let is_manifest = name == MANIFEST_FILE;
        if self.unpacked.files.contains_key(name)
            || (is_manifest && self.unpacked.manifest.is_some())
        {
            return Err(wrong(format!("the archive contains `{name}` twice")));
        }
        if count as u64 >= MAX_FILES.min(self.most / BYTES_PER_FILE) {
            return Err(wrong(format!("too many files (found more than {count})")));
        }
        let mut bytes = Vec::new();
        let mut target: Box<dyn Write> = match self.into {
            _ if is_manifest => Box::new(&mut bytes),
            None => Box::new(std::io::sink()),
            Some(folder) => {
                let target = folder.join(name);
                Box::new(
                    File::create_new(&target).map_err(FileError::doing(&target, "cannot write"))?,
                )
            }
        };
        let cannot = |error: Error| wrong(format!("cannot unpack `{name}`: {error}"));
        let mut content: Box<dyn Read> = match is_manifest {
            true => Box::new(content.take(MAX_MANIFEST_BYTES)),
            false => Box::new(content),
        };
        let sum = FileSum::copying(&mut content, &mut target).map_err(cannot)?;
        drop(target);
        if !is_manifest {
            self.unpacked.files.insert(name.to_owned(), sum);
            return Ok(());
        }
        if sum.bytes == MAX_MANIFEST_BYTES {
            return Err(wrong(format!(
                "{MANIFEST_FILE} is too large (expected less than {MAX_MANIFEST_BYTES} bytes)"
            )));
        }
        let manifest: Manifest = serde_json::from_slice(&bytes).map_err(|error| {
            wrong(format!(
                "{MANIFEST_FILE} is not the manifest of a submission: {error}"
            ))
        })?;
        self.unpacked.manifest = Some(manifest);
        if let Some(folder) = self.into {
            std::fs::write(folder.join(MANIFEST_FILE), &bytes)
                .map_err(FileError::doing(folder, "cannot write the manifest"))?;
        }
        Ok(())
    }
}

struct Bounded<R> {
    inner: R,
    read: u64,
    most: u64,
}

impl<R: Read> Read for Bounded<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let found = self.inner.read(buffer)?;
        self.read += found as u64;
        if self.read > self.most {
            let most = self.most;
            let message = format!("it unpacks to more than {most} bytes");
            return Err(Error::new(ErrorKind::FileTooLarge, message));
        }
        Ok(found)
    }
}

// Checks that only blank blocks and the checksum of gzip follow the last file.
fn check_end(mut archive: Bounded<GzDecoder<BufReader<File>>>) -> std::io::Result<()> {
    let wrong = |what| Err(Error::new(ErrorKind::InvalidData, what));
    // No checksum covers what follows the last file, so it could carry anything.
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
    if archive.inner.into_inner().read(&mut buffer)? > 0 {
        return wrong("found data after the end");
    }
    Ok(())
}

/// Whether an operating system wrote a file beside others: macOS does it in every archive.
pub fn is_of_system(path: &str) -> bool {
    let name = path.rsplit('/').next().unwrap_or(path);
    path.starts_with("__MACOSX/")
        || name.starts_with("._")
        || [".DS_Store", "Thumbs.db", "desktop.ini"].contains(&name)
}

fn is_plain_name(name: &str) -> bool {
    // A name with a separator could leave the folder that it is unpacked to.
    !name.is_empty()
        && !name.starts_with('.')
        && !name.contains(|c: char| "/\\:".contains(c) || c.is_control())
}
