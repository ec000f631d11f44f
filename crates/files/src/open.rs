//! Opening files for reading. All reading starts here, so that only regular files are read. Opening a pipe may wait
//! for ever, and a device may have no end.

use std::fs::{File, Metadata};
use std::io::{Error, ErrorKind, Read};
use std::path::Path;

/// Most bytes of a data file that is read completely: some hundred times the size of a challenge's catalogue.
pub const DATA: u64 = 1 << 27;
/// Most bytes of a settings file: ten times the size of a run or a baseline of all sets. Parsing needs twenty times as
/// much memory.
pub const SETTINGS: u64 = 1 << 22;

/// Opens a regular file, or a link to one.
pub fn open(path: &Path) -> std::io::Result<File> {
    // Checked before, because opening a pipe waits and opening a device may act. Checked after, because the name may
    // have changed its file.
    regular(&std::fs::metadata(path)?)?;
    let file = File::open(path)?;
    regular(&file.metadata()?)?;
    Ok(file)
}

/// Whether anything has this name. The reader reports it if it is no regular file.
pub fn is_there(path: &Path) -> bool {
    std::fs::symlink_metadata(path)
        .map_or_else(|error| error.kind() != ErrorKind::NotFound, |_| true)
}

/// All bytes of a file.
pub fn read(path: &Path, most: u64) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        let message =
            format!("it has more than {most} bytes, the most that is read of such a file");
        return Err(Error::new(ErrorKind::FileTooLarge, message));
    }
    Ok(bytes)
}

pub fn read_to_string(path: &Path, most: u64) -> std::io::Result<String> {
    String::from_utf8(read(path, most)?).map_err(|error| {
        let message = format!("byte {} is not UTF-8", error.utf8_error().valid_up_to() + 1);
        Error::new(ErrorKind::InvalidData, message)
    })
}

fn regular(about: &Metadata) -> std::io::Result<()> {
    if about.is_file() {
        return Ok(());
    }
    let kind = if about.is_dir() {
        "a folder"
    } else {
        "a pipe, a socket or a device"
    };
    let message = format!("this is {kind}; expected a file");
    Err(Error::new(ErrorKind::InvalidInput, message))
}
