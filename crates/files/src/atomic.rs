//! Files that are written completely or not at all.
//!
//! Until they are complete they have temporary names, `.NAME.RANDOM.part`, and are locked by their process. The next process
//! removes the leftovers of a killed one: below a folder of results by [`remove_leftovers`], elsewhere in the folder of the first file
//! that it writes.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{self, Permissions};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use tempfile::{Builder, NamedTempFile, TempDir};

use crate::FileError;

/// A file that is being written under a temporary name in the same folder, and locked. [`PartFile::finish`] renames it. If
/// it is dropped before, it is removed.
///
/// The temporary names differ, so that several processes can write the same file. The last one determines the content.
#[derive(Debug)]
pub struct PartFile {
    part: NamedTempFile,
    target: PathBuf,
}

impl PartFile {
    /// Creates the folder and the file, which is open for writing.
    pub fn create(target: impl AsRef<Path>) -> Result<(Self, fs::File), FileError> {
        let target = regular(target.as_ref())?;
        let cannot = || FileError::doing(&target, "cannot write the file");
        let (names, folder) = names_for(&target)?;
        let part = held(NamedTempFile::path, || {
            let mut builder = names.builder();
            // tempfile's own files can be read by their user alone.
            let part = builder.permissions(usual(0o666)).tempfile_in(&folder)?;
            // File systems without locks have none that could be taken by others.
            let _ = part.as_file().lock();
            Ok(part)
        });
        let part = part.map_err(cannot())?;
        let file = part.as_file().try_clone().map_err(cannot())?;
        Ok((PartFile { part, target }, file))
    }

    pub fn path(&self) -> &Path {
        self.part.path()
    }

    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Gives the file its name. The content is on disk before the name, and the name before any file that is written
    /// later.
    pub fn finish(self) -> Result<(), FileError> {
        let PartFile { part, target } = self;
        part.as_file()
            .sync_data()
            .and_then(|()| Ok(part.persist(&target).map(drop)?))
            .and_then(|()| sync_names(&target))
            .map_err(FileError::doing(&target, "cannot write the file"))
    }

    /// Gives the file its name unless another file has it. Returns whether it was renamed.
    pub fn finish_if_absent(self) -> Result<bool, FileError> {
        let PartFile { part, target } = self;
        let cannot = || FileError::doing(&target, "cannot write the file");
        part.as_file().sync_data().map_err(cannot())?;
        match part.persist_noclobber(&target) {
            Ok(_) => sync_names(&target).map_err(cannot()).map(|()| true),
            Err(_) if target.exists() => Ok(false),
            // Some file systems cannot refuse to replace a file. Then the last one wins.
            Err(failure) => {
                let part = failure.file;
                PartFile { part, target }.finish().map(|()| true)
            }
        }
    }
}

#[derive(Debug)]
pub struct PartFolder {
    part: TempDir,
    path: PathBuf,
    target: PathBuf,
    _lock: fs::File,
}

impl PartFolder {
    /// Creates the folder under a temporary name, and removes leftovers of killed processes next to it. `target` may be an
    /// empty folder, but no other.
    pub fn new(target: impl AsRef<Path>) -> Result<Self, FileError> {
        let target = target.as_ref().to_owned();
        if target.exists() && !(target.is_dir() && list(&target)?.is_empty()) {
            let message = "this exists already; expected a new or an empty folder";
            return Err(FileError::new(&target, message));
        }
        let (names, folder) = names_for(&target)?;
        let made = held_folder(&names, &folder, usual(0o777));
        let (part, lock) = made.map_err(FileError::doing(&target, "cannot make the folder"))?;
        // tempfile makes an absolute path, which messages would show.
        let path = folder.join(part.path().file_name().unwrap_or_default());
        Ok(PartFolder {
            part,
            path,
            target,
            _lock: lock,
        })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives the folder its name, its files being on disk.
    pub fn finish(mut self) -> Result<(), FileError> {
        for path in list(self.path())? {
            fs::File::open(&path)
                .and_then(|file| file.sync_data())
                .map_err(FileError::doing(&self.target, "cannot write the files"))?;
        }
        fs::rename(self.path(), &self.target)
            .and_then(|()| sync_names(&self.target))
            .map_err(FileError::doing(&self.target, "cannot make the folder"))?;
        self.part.disable_cleanup(true);
        Ok(())
    }
}

/// Waits until no other process holds the folder, and holds it until the result is dropped, so that what is read from it can
/// decide what is written.
pub fn hold(folder: &Path) -> Result<fs::File, FileError> {
    let held =
        fs::File::open(folder).map_err(FileError::doing(folder, "cannot open the folder"))?;
    // File systems without locks have none that could be taken by others.
    let _ = held.lock();
    Ok(held)
}

/// A folder among the system's temporary ones that is removed when dropped, and that no other user can look into. If the
/// process is killed, the next temporary folder removes it.
#[derive(Debug)]
pub struct Scratch {
    folder: TempDir,
    _lock: fs::File,
}

impl Scratch {
    pub fn new() -> Result<Self, FileError> {
        let temporary = std::env::temp_dir();
        sweep(&temporary, 0);
        let made = held_folder(&Names::of("shearq".as_ref()), &temporary, usual(0o700));
        let doing = "cannot make a temporary folder";
        let (folder, lock) = made.map_err(FileError::doing(&temporary, doing))?;
        Ok(Scratch {
            folder,
            _lock: lock,
        })
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

// Most attempts to make a temporary file or folder. A single attempt fails once in thousands.
const ATTEMPTS: u32 = 100;

/// Makes a file or folder, and locks it, by `make`.
fn held<T>(path: impl Fn(&T) -> &Path, mut make: impl FnMut() -> io::Result<T>) -> io::Result<T> {
    let mut attempts = 0;
    loop {
        match make() {
            // Before it was opened, another thread or process may have taken it for a leftover.
            Err(error) if error.kind() == ErrorKind::NotFound && attempts < ATTEMPTS => {
                attempts += 1;
            }
            // Or before it was locked.
            Ok(made) if !path(&made).exists() => {}
            made => return made,
        }
    }
}

fn held_folder(names: &Names, folder: &Path, mode: Permissions) -> io::Result<(TempDir, fs::File)> {
    held(
        |made: &(TempDir, fs::File)| made.0.path(),
        || {
            let part = names
                .builder()
                .permissions(mode.clone())
                .tempdir_in(folder)?;
            let lock = fs::File::open(part.path())?;
            let _ = lock.lock();
            Ok((part, lock))
        },
    )
}

/// Permissions before the system applies its `umask`.
fn usual(mode: u32) -> Permissions {
    std::os::unix::fs::PermissionsExt::from_mode(mode)
}

// The file that `target` names, which may be a link to it and need not be there.
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

// Ending of temporary names, and the number of random letters and digits before it.
const PART: &str = ".part";
const RANDOM: usize = 16;

struct Names {
    start: OsString,
}

impl Names {
    fn of(name: &std::ffi::OsStr) -> Self {
        let mut start = OsString::from(".");
        start.push(name);
        start.push(".");
        Names { start }
    }

    fn builder(&self) -> Builder<'_, '_> {
        let mut builder = Builder::new();
        builder.prefix(&self.start).suffix(PART).rand_bytes(RANDOM);
        builder
    }
}

/// Temporary names for `target`, and its folder, which is made. The first file that a process writes into a folder removes the
/// leftovers of killed processes there; not each one, because a folder may have thousands.
fn names_for(target: &Path) -> Result<(Names, PathBuf), FileError> {
    let name = target
        .file_name()
        .ok_or_else(|| FileError::new(target, "this is not the name of a file"))?;
    let folder = folder_of(target);
    fs::create_dir_all(folder).map_err(FileError::doing(folder, "cannot make the folder"))?;
    static SWEPT: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
    let mut swept = SWEPT.lock().unwrap_or_else(PoisonError::into_inner);
    if swept.insert(folder.to_owned()) {
        sweep(folder, 0);
    }
    Ok((Names::of(name), folder.to_owned()))
}

/// The folder of a file; `.` for a bare file name.
pub fn folder_of(target: &Path) -> &Path {
    match target.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// The files and folders in a folder, sorted, because file systems list in any order and results must not depend on it.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    let mut paths: Vec<PathBuf> = fs::read_dir(folder)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
        .map_err(FileError::doing(folder, "cannot list the folder"))?;
    paths.sort();
    Ok(paths)
}

/// Whether a name is a temporary one. Other programs end their names in `.part`, too.
fn is_part(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let own = name
        .strip_prefix('.')
        .and_then(|name| name.strip_suffix(PART)?.rsplit_once('.'));
    own.is_some_and(|(_, own)| {
        own.len() == RANDOM && own.bytes().all(|b| b.is_ascii_alphanumeric())
    })
}

// Folders within folders that results are in, as EXPERIMENT/OBSERVATION/SHEAR of GREAT3. Deeper ones
// are not searched, because links may form circles.
const MAX_DEPTH: usize = 3;

/// Removes the temporary files and folders that killed processes left in `folder` and the folders in it.
pub fn remove_leftovers(folder: &Path) {
    sweep(folder, MAX_DEPTH);
}

// A running process has locked its files. Files without a known state or without permission stay, and do no harm; so do all
// on file systems without locks.
fn sweep(folder: &Path, depth: usize) {
    for path in list(folder).unwrap_or_default() {
        let Ok(about) = path.symlink_metadata() else {
            continue;
        };
        if !is_part(&path) || !(about.is_file() || about.is_dir()) {
            if depth > 0 && path.is_dir() {
                sweep(&path, depth - 1);
            }
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

// Flushes the names in the folder of `file` to disk, so that even a power failure cannot keep later
// results without the record that was written before them.
fn sync_names(file: &Path) -> io::Result<()> {
    let folder = match fs::File::open(folder_of(file)) {
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

/// Writes `bytes` to `target`, whole or not at all.
pub fn write(target: impl AsRef<Path>, bytes: &[u8]) -> Result<(), FileError> {
    written(target, bytes)?.finish()
}

/// Like [`write()`], but does not replace an existing `target`. Returns whether it was written.
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
    fn abandoned_files_leave_nothing_and_finished_ones_themselves() {
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
        let (killed, living) = (
            target.with_file_name(".truth.csv.0123456789abcdef.part"),
            part(),
        );
        fs::write(&killed, "half").unwrap();
        remove_leftovers(folder.path());
        assert!(!killed.exists() && living.path().exists());
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
        assert!(!at(left).exists() && !at(".out.fedcba9876543210.part").exists());
        let folder_of = PartFolder::new(at("packed")).unwrap();
        sweep(folder.path(), 0);
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
    fn threads_keep_the_temporary_folders_of_others() {
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
}
