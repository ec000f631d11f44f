//! Files that are written completely or not at all.
//!
//! Until they are complete they have temporary names, `.NAME.RANDOM.part`. The next process removes the leftovers of a
//! killed one: [`remove_leftovers`] in a folder that one process uses alone, [`sweep`] elsewhere. A lock marks the files
//! of a running process.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use tempfile::{TempDir, TempPath};

use crate::error::FileError;

/// A file that is being written under a temporary name in the same folder. [`PartFile::finish`] renames it. If it is
/// dropped before, it is removed.
///
/// The temporary names differ, so that several processes can write the same file. The last one determines the content.
#[derive(Debug)]
pub struct PartFile {
    part: PathBuf,
    target: PathBuf,
    finished: bool,
    /// The file with a lock, on systems with locks.
    _held: fs::File,
}

impl PartFile {
    /// Creates the folder and the file, which is open for writing.
    ///
    /// # Errors
    /// If either cannot be created.
    pub fn create(target: impl AsRef<Path>) -> Result<(Self, fs::File), FileError> {
        let target = regular(target.as_ref())?;
        let (part, held) = held(&target, "cannot write the file", |part| {
            fs::File::create_new(part)
        })?;
        let file = held
            .try_clone()
            .map_err(FileError::doing(&target, "cannot write the file"))?;
        let part = PartFile {
            part,
            target,
            finished: false,
            _held: held,
        };
        Ok((part, file))
    }

    /// The temporary name.
    pub fn path(&self) -> &Path {
        &self.part
    }

    /// The final name.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Gives the file its name. The content is on disk before the name, and the name before any file that is written
    /// later.
    ///
    /// # Errors
    /// If it cannot be flushed to disk or renamed.
    pub fn finish(mut self) -> Result<(), FileError> {
        self.flush()
            .and_then(|()| fs::rename(&self.part, &self.target))
            .map_err(FileError::doing(&self.target, "cannot write the file"))?;
        self.finished = true;
        sync_names(&self.target).map_err(FileError::doing(&self.target, "cannot write the file"))
    }

    /// Gives the file its name unless another file has it. Returns whether it was renamed.
    ///
    /// # Errors
    /// If it cannot be flushed to disk or named.
    pub fn finish_if_absent(mut self) -> Result<bool, FileError> {
        let named = self.flush().and_then(|()| {
            let part = TempPath::try_from_path(&self.part)?;
            part.persist_noclobber(&self.target).map_err(|failure| {
                // Only removing the temporary file can fail, which does not matter to the caller.
                let _ = failure.path.keep();
                failure.error
            })
        });
        match named {
            Ok(()) => {
                self.finished = true;
                sync_names(&self.target)
                    .map_err(FileError::doing(&self.target, "cannot write the file"))?;
                Ok(true)
            }
            Err(_) if self.target.exists() => Ok(false),
            // Some file systems cannot name a file only if there is none. Then the last one wins.
            Err(_) => self.finish().map(|()| true),
        }
    }

    fn flush(&self) -> std::io::Result<()> {
        fs::File::open(&self.part).and_then(|file| file.sync_data())
    }
}

impl Drop for PartFile {
    fn drop(&mut self) {
        if !self.finished {
            // Nothing more can be done about a leftover here; the next run removes it.
            let _ = fs::remove_file(&self.part);
        }
    }
}

/// A folder on its way, like a [`PartFile`].
#[derive(Debug)]
pub struct PartFolder {
    part: PathBuf,
    target: PathBuf,
    finished: bool,
    /// The folder with a lock, on systems with locks.
    _held: fs::File,
}

impl PartFolder {
    /// Creates the folder under a temporary name, and removes leftovers of killed processes next to it.
    ///
    /// # Errors
    /// If it cannot be created, or `target` exists and is no empty folder.
    pub fn new(target: impl AsRef<Path>) -> Result<Self, FileError> {
        let target = target.as_ref().to_owned();
        if target.exists() && !(target.is_dir() && list(&target)?.is_empty()) {
            let message = "this exists already; expected a new or an empty folder";
            return Err(FileError::new(&target, message));
        }
        sweep_beside(&target);
        let (part, held) = held(&target, "cannot make the folder", |part| {
            fs::create_dir(part)?;
            fs::File::open(part)
        })?;
        Ok(PartFolder {
            part,
            target,
            finished: false,
            _held: held,
        })
    }

    /// The temporary name, for the files.
    pub fn path(&self) -> &Path {
        &self.part
    }

    /// Gives the folder its name, its files being on disk.
    ///
    /// # Errors
    /// If a file cannot be flushed or the folder cannot be renamed.
    pub fn finish(mut self) -> Result<(), FileError> {
        for path in list(&self.part)? {
            fs::File::open(&path)
                .and_then(|file| file.sync_data())
                .map_err(FileError::doing(&self.target, "cannot write the files"))?;
        }
        fs::rename(&self.part, &self.target)
            .and_then(|()| sync_names(&self.target))
            .map_err(FileError::doing(&self.target, "cannot make the folder"))?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for PartFolder {
    fn drop(&mut self) {
        if !self.finished {
            let _ = fs::remove_dir_all(&self.part);
        }
    }
}

/// A folder among the system's temporary ones that is removed when dropped. If the process is killed, the next
/// temporary folder removes it.
#[derive(Debug)]
pub struct Scratch {
    folder: TempDir,
    _held: fs::File,
}

impl Scratch {
    /// Makes an empty folder that no other user can look into.
    ///
    /// # Errors
    /// If it cannot be created.
    pub fn new() -> Result<Self, FileError> {
        let temporary = std::env::temp_dir();
        sweep(&temporary);
        let mut folder = None;
        let (_, held) = held(
            &temporary.join("shearq"),
            "cannot make a temporary folder",
            |part| {
                let made = tempfile::Builder::new()
                    .rand_bytes(0)
                    .prefix(part.file_name().unwrap_or_default())
                    .tempdir_in(&temporary)?;
                let file = fs::File::open(made.path());
                folder = Some(made);
                file
            },
        )?;
        let folder = folder.ok_or_else(|| FileError::new(&temporary, "no temporary folder"))?;
        Ok(Scratch {
            folder,
            _held: held,
        })
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

/// Most attempts to make a temporary file or folder. A single attempt fails once in thousands.
const ATTEMPTS: u32 = 100;

/// Makes a file or folder under a temporary name for `target` by `make`, and locks it.
fn held(
    target: &Path,
    doing: &'static str,
    mut make: impl FnMut(&Path) -> std::io::Result<fs::File>,
) -> Result<(PathBuf, fs::File), FileError> {
    let mut attempts = 0;
    loop {
        let part = part_of(target)?;
        let file = match make(&part) {
            // Before it was opened, another thread or process may have taken it for a leftover.
            Err(error) if error.kind() == ErrorKind::NotFound && attempts < ATTEMPTS => {
                attempts += 1;
                continue;
            }
            made => made.map_err(FileError::doing(target, doing))?,
        };
        // File systems without locks have none that could be taken by others.
        let _ = file.lock();
        // Before it was locked, another process may have taken it for a leftover.
        if part.exists() {
            return Ok((part, file));
        }
    }
}

/// The file that `target` names, which may be a link to it and need not be there.
fn regular(target: &Path) -> Result<PathBuf, FileError> {
    match fs::metadata(target) {
        Ok(about) if !(about.is_file() || about.is_dir()) => {
            let message = "this is no regular file; expected one that can be replaced";
            Err(FileError::new(target, message))
        }
        Ok(_) if target.is_symlink() => {
            fs::canonicalize(target).map_err(FileError::doing(target, "cannot follow the link"))
        }
        _ => Ok(target.to_owned()),
    }
}

/// A temporary name for `target` in its folder, which is made.
fn part_of(target: &Path) -> Result<PathBuf, FileError> {
    let name = target
        .file_name()
        .ok_or_else(|| FileError::new(target, "this is not the name of a file"))?;
    let folder = target.parent().unwrap_or(Path::new(""));
    if !folder.as_os_str().is_empty() {
        fs::create_dir_all(folder).map_err(FileError::doing(folder, "cannot make the folder"))?;
    }
    let own: u64 = rand::random();
    Ok(folder.join(format!(".{}.{own:016x}{PART}", name.to_string_lossy())))
}

/// Ending of temporary names.
const PART: &str = ".part";

/// Removes the temporary files that killed processes left in `folder` and the folders in it. No other
/// process may be writing there.
///
/// # Errors
/// If a folder cannot be listed or a leftover cannot be removed.
pub fn remove_leftovers(folder: &Path) -> Result<(), FileError> {
    for path in list(folder)? {
        if path.is_dir() {
            list(&path)?.iter().try_for_each(|path| remove_part(path))?;
        } else {
            remove_part(&path)?;
        }
    }
    Ok(())
}

fn list(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    fs::read_dir(folder)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
        .map_err(FileError::doing(folder, "cannot list the folder"))
}

/// Removes a file with a temporary name.
fn remove_part(path: &Path) -> Result<(), FileError> {
    if !(is_part(path) && path.is_file()) {
        return Ok(());
    }
    match fs::remove_file(path) {
        // Another process that is about to claim the folder may have removed its own.
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        result => result.map_err(FileError::doing(path, "cannot remove the leftover")),
    }
}

/// Whether a name is one that [`part_of`] gives.
fn is_part(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let own = name
        .strip_prefix('.')
        .and_then(|name| name.strip_suffix(PART)?.rsplit_once('.'));
    own.is_some_and(|(_, own)| own.len() == 16 && own.bytes().all(|b| b.is_ascii_hexdigit()))
}

/// Removes the temporary files and folders in `folder` that no running process has locked. Files without a known state
/// or without permission stay, and do no harm.
pub fn sweep(folder: &Path) {
    for path in list(folder).unwrap_or_default() {
        let Ok(about) = path.symlink_metadata() else {
            continue;
        };
        if !is_part(&path) || !(about.is_file() || about.is_dir()) {
            continue;
        }
        let Ok(file) = fs::File::open(&path) else {
            continue;
        };
        if file.try_lock().is_ok() {
            let _ = match about.is_dir() {
                true => fs::remove_dir_all(&path),
                false => fs::remove_file(&path),
            };
        }
    }
}

/// The same in the folder of `target`.
pub fn sweep_beside(target: &Path) {
    match target.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => sweep(folder),
        _ => sweep(Path::new(".")),
    }
}

/// Flushes the names in the folder of `file` to disk, so that even a power failure cannot keep later
/// results without the record that was written before them.
#[cfg(unix)]
fn sync_names(file: &Path) -> std::io::Result<()> {
    let folder = match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let folder = match fs::File::open(folder) {
        // A folder that may be written to but not read.
        Err(error) if error.kind() == ErrorKind::PermissionDenied => return Ok(()),
        folder => folder?,
    };
    match folder.sync_all() {
        // Some network file systems cannot flush folders; they order names themselves.
        Err(error) if error.kind() == ErrorKind::InvalidInput => Ok(()),
        result => result,
    }
}

/// On other systems a folder cannot be opened as a file.
#[cfg(not(unix))]
fn sync_names(_file: &Path) -> std::io::Result<()> {
    Ok(())
}

/// Writes `bytes` to `target`, whole or not at all.
///
/// # Errors
/// If the file cannot be written.
pub fn write(target: impl AsRef<Path>, bytes: &[u8]) -> Result<(), FileError> {
    written(target, bytes)?.finish()
}

/// Like [`write()`], but does not replace an existing `target`. Returns whether it was written.
///
/// # Errors
/// If the file cannot be written.
pub fn write_if_absent(target: impl AsRef<Path>, bytes: &[u8]) -> Result<bool, FileError> {
    written(target, bytes)?.finish_if_absent()
}

fn written(target: impl AsRef<Path>, bytes: &[u8]) -> Result<PartFile, FileError> {
    let (part, mut file) = PartFile::create(target)?;
    file.write_all(bytes)
        .map_err(FileError::doing(part.target(), "cannot write the file"))?;
    Ok(part)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_abandoned_file_leaves_nothing_and_a_finished_one_only_itself() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("new/result.csv");
        let (part, _) = PartFile::create(&target).unwrap();
        fs::write(part.path(), "half").unwrap();
        drop(part);
        let count = || fs::read_dir(target.parent().unwrap()).unwrap().count();
        assert_eq!(count(), 0);
        write(&target, b"whole").unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"whole");
        assert_eq!(count(), 1);
    }

    #[test]
    fn processes_that_write_the_same_file_do_not_meet_in_it() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("set01/truth.csv");
        let part = || PartFile::create(&target).unwrap().0;
        let (one, two) = (part(), part());
        fs::write(one.path(), "one").unwrap();
        fs::write(two.path(), "two").unwrap();
        one.finish().unwrap();
        two.finish().unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"two");
        assert!(!write_if_absent(&target, b"three").unwrap());
        assert_eq!(fs::read(&target).unwrap(), b"two");
        let killed = part();
        fs::write(killed.path(), "half").unwrap();
        std::mem::forget(killed);
        remove_leftovers(folder.path()).unwrap();
        assert_eq!(fs::read_dir(target.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn what_nobody_holds_is_swept_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let left = ".out.tar.gz.0123456789abcdef.part";
        fs::write(at(left), "half").unwrap();
        fs::create_dir(at(".out.fedcba9876543210.part")).unwrap();
        fs::write(at(".out.fedcba9876543210.part/one.dat"), "half").unwrap();
        // Another program's, and one that is being written.
        fs::write(at(".film.mp4.part"), "half").unwrap();
        let (living, _file) = PartFile::create(at("out.csv")).unwrap();
        let folder_of = PartFolder::new(at("packed")).unwrap();
        sweep(folder.path());
        let mut names: Vec<PathBuf> = list(folder.path()).unwrap();
        names.sort();
        let mut expected = [
            at(".film.mp4.part"),
            living.path().to_owned(),
            folder_of.path().to_owned(),
        ];
        expected.sort();
        assert_eq!(names, expected);
    }

    #[test]
    fn threads_that_make_temporary_folders_do_not_remove_those_of_others() {
        let make = || {
            for _ in 0..200 {
                let scratch = Scratch::new().unwrap();
                fs::write(scratch.path().join("file"), "x").unwrap();
            }
        };
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(make);
            }
        });
    }

    #[test]
    fn of_two_that_make_a_new_file_one_is_told_so() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("baseline.toml");
        let part = || written(&target, b"mine").unwrap();
        let (one, two) = (part(), part());
        assert!(one.finish_if_absent().unwrap() && !two.finish_if_absent().unwrap());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
