//! The bytes of a FITS file, plain or compressed by gzip.
//!
//! cfitsio would unpack a whole gzip file into memory before it reads the header. Here the file is unpacked into a
//! nameless temporary file, step by step: the header first, and the pixels when they are read.

use std::ffi::CString;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use flate2::bufread::MultiGzDecoder;

use crate::error::FileError;
use crate::open::open;

// Most bytes that a gzip file may unpack to: ten images of the challenge.
const MAX_UNPACKED_BYTES: u64 = 1 << 30;
// Bytes that are unpacked at a time, at least.
const UNPACK_STEP_BYTES: u64 = 1 << 23;

pub struct Source {
    path: PathBuf,
    file: File,
    /// Bytes in it.
    size: u64,
    /// Bytes on disk.
    disk: u64,
    packed: Option<MultiGzDecoder<BufReader<File>>>,
}

impl Source {
    /// Opens a plain or gzip-compressed FITS file; `what` is expected in it.
    pub fn open(path: &Path, what: &'static str) -> Result<Self, FileError> {
        let cannot = || FileError::doing(path, "cannot open the file");
        let file = open(path).map_err(cannot())?;
        let size = file.metadata().map_err(cannot())?.len();
        let mut source = Source {
            path: path.to_owned(),
            file,
            size,
            disk: size,
            packed: None,
        };
        if source.start()?.starts_with(&[0x1f, 0x8b]) {
            source.file.rewind().map_err(cannot())?;
            let plain = tempfile::tempfile().map_err(FileError::doing(
                path,
                "cannot make a temporary file to unpack to",
            ))?;
            let packed = std::mem::replace(&mut source.file, plain);
            source.packed = Some(MultiGzDecoder::new(BufReader::new(packed)));
            source.size = 0;
        }
        let start = source.start()?;
        if start == *b"SIMPLE" {
            return Ok(source);
        }
        let message = if start.is_empty() {
            format!("the file is empty; expected a FITS {what}")
        } else {
            format!(
                "the file starts with `{}`; expected a FITS {what}, which starts with `SIMPLE`, plain or compressed by gzip or fpack",
                start.escape_ascii()
            )
        };
        Err(FileError::new(path, message))
    }

    pub fn name(&self) -> Result<CString, FileError> {
        let name = match self.packed {
            None => literal(self.path.as_os_str().as_encoded_bytes()),
            Some(_) => open_file_name(&self.file),
        };
        CString::new(name).map_err(FileError::doing(&self.path, "cannot open the file"))
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes on disk.
    pub fn disk_size(&self) -> u64 {
        self.disk
    }

    pub fn is_packed(&self) -> bool {
        self.packed.is_some()
    }

    /// Checks that a gzip file may have so many bytes.
    pub fn allow(&self, wanted: u64) -> Result<(), FileError> {
        if wanted <= MAX_UNPACKED_BYTES {
            return Ok(());
        }
        let message = format!(
            "its header asks for {wanted} bytes; expected at most {MAX_UNPACKED_BYTES} in a gzip file: unpack it first"
        );
        Err(FileError::new(&self.path, message))
    }

    /// Bytes that are there, after a search for as many as `wanted`.
    pub fn size(&mut self, wanted: u64) -> Result<u64, FileError> {
        if wanted <= self.size || !self.is_packed() {
            return Ok(self.size);
        }
        self.allow(wanted)?;
        let Some(packed) = &mut self.packed else {
            return Ok(self.size);
        };
        let more = (wanted - self.size).max(UNPACK_STEP_BYTES);
        self.size += self
            .file
            .seek(SeekFrom::Start(self.size))
            .and_then(|_| std::io::copy(&mut packed.take(more), &mut self.file))
            .map_err(FileError::doing(&self.path, "cannot unpack the gzip file"))?;
        Ok(self.size)
    }

    /// Bytes from `start`, as many as there are up to `size`.
    pub fn read_at(&mut self, start: u64, size: usize) -> Result<Vec<u8>, FileError> {
        self.size(start.saturating_add(size as u64))?;
        let mut bytes = Vec::new();
        self.file
            .seek(SeekFrom::Start(start))
            .and_then(|_| (&mut self.file).take(size as u64).read_to_end(&mut bytes))
            .map_err(FileError::doing(&self.path, "cannot read the file"))?;
        Ok(bytes)
    }

    pub fn check_end(&mut self) -> Result<(), FileError> {
        let Some(packed) = &mut self.packed else {
            return Ok(());
        };
        let rest = std::io::copy(&mut packed.take(MAX_UNPACKED_BYTES), &mut std::io::sink())
            .map_err(FileError::doing(&self.path, "cannot unpack the gzip file"))?;
        if rest < MAX_UNPACKED_BYTES {
            return Ok(());
        }
        let message =
            format!("more than {MAX_UNPACKED_BYTES} bytes follow what was read of the gzip file");
        Err(FileError::new(&self.path, message))
    }

    fn start(&mut self) -> Result<Vec<u8>, FileError> {
        self.read_at(0, 6)
    }
}

/// A name of an open file that has none.
fn open_file_name(file: &File) -> Vec<u8> {
    use std::os::fd::AsRawFd;
    format!("/dev/fd/{}", file.as_raw_fd()).into_bytes()
}

// A name that cfitsio does not change. cfitsio replaces a tilde at the start by a home folder.
fn literal(name: &[u8]) -> Vec<u8> {
    let here: &[u8] = if name.starts_with(b"~") { b"./" } else { b"" };
    [here, name].concat()
}
