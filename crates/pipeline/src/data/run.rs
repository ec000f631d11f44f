//! The record of a folder of results: `run.json`, written before the first result.

use std::fs::File;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};
use shearq_submissions::Configuration;

use crate::data::layout::{DataFolder, Layout};
use crate::data::listing::{self, Files};
use crate::data::pattern::fill;
use crate::data::relative;
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_files::table::FileFormat;
use shearq_simulate::set::SimulationSettings;

/// Name of the record in a folder of results.
pub const RUN_FILE: &str = "run.json";

/// The source of the galaxies of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// Images of a data folder.
    Folder {
        /// The folder, relative to the folder of the record.
        path: PathBuf,
        /// Its layout.
        layout: Layout,
    },
    /// Simulated and measured in memory. The true shear lies beside the catalogues.
    Simulated(SimulationSettings),
}

impl Source {
    /// A data folder, for a record in the folder `beside`.
    ///
    /// # Errors
    /// If the way from one to the other is not known.
    pub fn folder(data: &DataFolder, beside: &Path) -> Result<Self, FileError> {
        Ok(Source::Folder {
            path: way(beside, data.root())?,
            layout: data.layout().clone(),
        })
    }

    /// The same source, of a record in the folder `from`, for one in the folder `to`.
    ///
    /// # Errors
    /// If the way from one to the other is not known.
    pub fn moved(&self, from: &Path, to: &Path) -> Result<Self, FileError> {
        Ok(match self {
            Source::Folder { path, layout } => Source::Folder {
                path: way(to, &from.join(path))?,
                layout: layout.clone(),
            },
            Source::Simulated(settings) => Source::Simulated(*settings),
        })
    }

    /// Layout of the data, also of simulated data.
    pub fn layout(&self) -> Layout {
        match self {
            Source::Folder { layout, .. } => layout.clone(),
            Source::Simulated(_) => Layout::default(),
        }
    }

    /// The data folder with the true shear, for a run in the folder `measured`.
    ///
    /// # Errors
    /// If the data folder no longer exists.
    pub fn data(&self, measured: &Path) -> Result<DataFolder, FileError> {
        match self {
            Source::Folder { path, .. } => {
                DataFolder::open(relative::shortened(measured.join(path)))
            }
            Source::Simulated(_) => DataFolder::open(measured),
        }
    }
}

/// The relative path from the folder of a record to a data folder or a file.
///
/// # Errors
/// If the current folder cannot be determined.
pub fn way(from: &Path, to: &Path) -> Result<PathBuf, FileError> {
    relative::from(from, to).map_err(FileError::doing(to, "cannot determine where the folder is"))
}

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Source::Folder { path, .. } => path.display().fmt(f),
            Source::Simulated(settings) => write!(f, "a simulation with seed {}", settings.seed),
        }
    }
}

/// Settings of a measurement, stored with its catalogues.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Version of shearq.
    pub version: String,
    /// Source of the galaxies.
    pub source: Source,
    /// The configuration.
    #[serde(rename = "submission")]
    pub configuration: Configuration,
    /// File format of the catalogues.
    pub format: FileFormat,
    /// Cuts and weights that were applied to the catalogues, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selection: Option<String>,
}

impl Run {
    /// Reads the record of a folder; `None` where there is none.
    ///
    /// # Errors
    /// If it exists and cannot be read.
    pub fn read(folder: &Path) -> Result<Option<Self>, FileError> {
        read_record(&folder.join(RUN_FILE))
    }

    /// A run of this version.
    pub fn new(source: Source, configuration: Configuration, format: FileFormat) -> Self {
        Run {
            version: crate::VERSION.into(),
            source,
            configuration,
            format,
            selection: None,
        }
    }

    /// Reads the record of a folder that must be one of catalogues.
    ///
    /// # Errors
    /// If there is none, or it cannot be read.
    pub fn require(folder: &Path) -> Result<Self, FileError> {
        const EXPECTED: &str = "a folder of catalogues that `shearq measure` or `shearq run` wrote";
        check_folder(folder, EXPECTED)?;
        if let Some(run) = Run::read(folder)? {
            return Ok(run);
        }
        let images = DataFolder::open(folder).and_then(|data| data.images(&[]));
        let message = match images {
            Ok(images) if !images.sets().is_empty() => format!(
                "this is a data folder: it contains galaxy images and no {RUN_FILE}; expected {EXPECTED}. Try: shearq measure --data {} --out OUT --submission 48/linear/star",
                folder.display()
            ),
            _ => format!("there is no {RUN_FILE}; expected {EXPECTED}"),
        };
        Err(FileError::new(folder, message))
    }

    /// The catalogue of an image.
    pub fn catalogue(&self, folder: &Path, set: u32, image: u32) -> PathBuf {
        folder.join(fill(&self.pattern(), set, image))
    }

    /// The catalogues of `sets` (of all if empty) that are there.
    ///
    /// # Errors
    /// If a folder cannot be listed.
    pub fn catalogues(&self, folder: &Path, sets: &[u32]) -> Result<Files, FileError> {
        listing::find(folder, &self.pattern(), &[""], sets)
    }

    fn pattern(&self) -> String {
        let ending = self.format.extension();
        format!("set{{set:02}}/catalogue-{{image:03}}.{ending}")
    }
}

/// Checks that `folder` is a folder. `expected` describes it in the error.
///
/// # Errors
/// If there is nothing of this name, or a file.
pub fn check_folder(folder: &Path, expected: &str) -> Result<(), FileError> {
    let found = if folder.is_dir() {
        return Ok(());
    } else if folder.exists() {
        "this is a file"
    } else {
        "there is no such folder"
    };
    Err(FileError::new(
        folder,
        format!("{found}; expected {expected}"),
    ))
}

/// Opens the data folder that a command is to read images from.
///
/// # Errors
/// As [`DataFolder::open`], and if the folder contains catalogues instead of images.
pub fn open_data(folder: &Path) -> Result<DataFolder, FileError> {
    let data = DataFolder::open(folder)?;
    let Some(run) = Run::read(folder).ok().flatten() else {
        return Ok(data);
    };
    // Catalogues may be beside the images.
    if !data.images(&[])?.sets().is_empty() {
        return Ok(data);
    }
    let advice = match &run.source {
        Source::Folder { path, .. } => {
            let data = relative::shortened(folder.join(path));
            format!(". Try: --data {}", data.display())
        }
        Source::Simulated(_) => {
            "; they were simulated in memory, and `shearq simulate` writes images".into()
        }
    };
    let message = format!(
        "this folder contains catalogues ({RUN_FILE}) and no galaxy images; expected the data folder that they were measured from{advice}"
    );
    Err(FileError::new(folder, message))
}

/// Reads any record; `None` where there is none.
///
/// # Errors
/// If it exists and cannot be read.
pub fn read_record<R: DeserializeOwned>(path: &Path) -> Result<Option<R>, FileError> {
    let text = match shearq_files::open::read_to_string(path, shearq_files::open::SETTINGS) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(FileError::doing(path, "cannot read the record")(error)),
    };
    serde_json::from_str(&text).map(Some).map_err(|error| {
        // Valid JSON with other keys or types.
        let hint = match error.is_data() {
            true => "; the record belongs to another version. Try: another folder",
            false => "",
        };
        FileError::new(path, format!("not a record of this kind: {error}{hint}"))
    })
}

/// Writes any record as indented JSON.
///
/// # Errors
/// If it cannot be written.
pub fn write_record(path: &Path, record: &impl Serialize) -> Result<(), FileError> {
    atomic::write(path, record_text(path, record)?.as_bytes())
}

/// Any record as indented JSON, for a file at `path`.
///
/// # Errors
/// If it cannot be written as JSON.
pub fn record_text(path: &Path, record: &impl Serialize) -> Result<String, FileError> {
    let mut text = serde_json::to_string_pretty(record)
        .map_err(FileError::doing(path, "cannot write the record"))?;
    text.push('\n');
    Ok(text)
}

/// Numbers of records that may be NaN, which is null in JSON.
pub trait Numbers: Sized {
    /// The form in JSON.
    type Form: DeserializeOwned;
    /// The numbers, with NaN for null.
    fn from_form(form: Self::Form) -> Self;
}

impl Numbers for f64 {
    type Form = Option<f64>;
    fn from_form(form: Option<f64>) -> Self {
        form.unwrap_or(f64::NAN)
    }
}

impl Numbers for Vec<f64> {
    type Form = Vec<Option<f64>>;
    fn from_form(form: Vec<Option<f64>>) -> Self {
        form.into_iter().map(f64::from_form).collect()
    }
}

impl<const N: usize> Numbers for [f64; N]
where
    [Option<f64>; N]: DeserializeOwned,
{
    type Form = [Option<f64>; N];
    fn from_form(form: [Option<f64>; N]) -> Self {
        form.map(f64::from_form)
    }
}

/// For `#[serde(deserialize_with)]`: reads null as NaN.
///
/// # Errors
/// If there is anything but numbers and null.
pub fn nan_for_null<'de, D: Deserializer<'de>, N: Numbers>(deserializer: D) -> Result<N, D::Error> {
    N::Form::deserialize(deserializer).map(N::from_form)
}

/// A folder of results that this process writes to until it drops this. Other processes of the same settings may write to
/// it too.
#[derive(Debug)]
#[must_use]
pub struct Claim {
    /// The record, with a shared lock on it.
    record: File,
    path: PathBuf,
}

impl Claim {
    /// Checks that the record of the folder has not been removed or replaced.
    ///
    /// # Errors
    /// If it is not.
    pub fn check(&self) -> Result<(), FileError> {
        if self.is_there() {
            return Ok(());
        }
        let folder = self.path.parent().unwrap_or(&self.path);
        let message = "the folder was removed or replaced while results were written to it; they are incomplete";
        Err(FileError::new(folder, message))
    }

    /// The error of work in the folder: that the folder was removed, if it was, else `error`.
    pub fn explain<E: From<FileError>>(&self, error: E) -> E {
        self.check().map_or_else(E::from, |()| error)
    }

    /// Whether the record is the file that was claimed.
    #[cfg(unix)]
    fn is_there(&self) -> bool {
        use std::os::unix::fs::MetadataExt;
        let (Ok(held), Ok(found)) = (self.record.metadata(), std::fs::metadata(&self.path)) else {
            return false;
        };
        (held.dev(), held.ino()) == (found.dev(), found.ino())
    }

    /// Elsewhere an open file cannot be removed.
    #[cfg(not(unix))]
    fn is_there(&self) -> bool {
        self.path.exists()
    }

    /// Checks the folder at the end of the work, and that all `results` are there.
    ///
    /// # Errors
    /// If one of them is not.
    pub fn check_results(
        &self,
        results: impl IntoIterator<Item = PathBuf>,
    ) -> Result<(), FileError> {
        self.check()?;
        match results.into_iter().find(|path| !path.is_file()) {
            None => Ok(()),
            Some(path) => {
                let message = "the file was removed while results were written to its folder. Try: the same command again";
                Err(FileError::new(path, message))
            }
        }
    }
}

/// Claims the folder of `path` for `record`. Writes the record if there is none, and refuses a folder with a different
/// record. Leftovers of killed processes are removed if no other process is at work.
///
/// # Errors
/// If the folder belongs to other settings, or the record cannot be read or written.
pub fn claim<R: Serialize + DeserializeOwned>(path: &Path, record: &R) -> Result<Claim, FileError> {
    let mut earlier: Option<R> = read_record(path)?;
    if earlier.is_none() {
        // If another process is first, its record is compared like any earlier record.
        let _ = atomic::write_if_absent(path, record_text(path, record)?.as_bytes())?;
        earlier = read_record(path)?;
    }
    let differences = differences(&earlier, &Some(record))
        .map_err(|error| FileError::new(path, format!("cannot compare records: {error}")))?;
    let folder = path.parent().unwrap_or(path);
    if !differences.is_empty() {
        return Err(FileError::new(
            folder,
            format!(
                "this folder contains results of other settings (earlier ≠ now):\n  {}\nuse another folder, or remove this one",
                most_important(differences).join("\n  ")
            ),
        ));
    }
    let file = open_to_lock(path).map_err(FileError::doing(path, "cannot open the record"))?;
    // A process with an exclusive lock is the only one at work here.
    if file.try_lock().is_ok() {
        atomic::remove_leftovers(folder)?;
    }
    // Shares the lock with other processes. On file systems without locks, leftovers stay and do no harm.
    let _ = file.unlock();
    let _ = file.lock_shared();
    Ok(Claim {
        record: file,
        path: path.to_owned(),
    })
}

/// Most differences that a message lists.
const SHOWN: usize = 6;
/// Most characters of one of them.
const LONGEST: usize = 160;

/// The differences that explain most, in this order, and the number of the others.
fn most_important(mut differences: Vec<String>) -> Vec<String> {
    const FIRST: [&str; 8] = [
        "version",
        "submission.name",
        "submissions",
        "submission.method",
        "source",
        "settings",
        "simulation",
        "images",
    ];
    differences.sort_by_key(|line| {
        let key = line.split(": ").next().unwrap_or(line);
        // Descriptions do not change results.
        if key.ends_with("description") {
            return FIRST.len() + 1;
        }
        let of = |first: &&str| {
            key.strip_prefix(*first)
                .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        FIRST.iter().position(of).unwrap_or(FIRST.len())
    });
    let more = differences.len().saturating_sub(SHOWN);
    differences.truncate(SHOWN);
    for line in &mut differences {
        if let Some((end, _)) = line.char_indices().nth(LONGEST) {
            line.truncate(end);
            line.push('…');
        }
    }
    if more > 0 {
        differences.push(format!("and {more} more"));
    }
    differences
}

/// Opens a record so that it can be locked. Over NFS an exclusive lock requires write permission.
fn open_to_lock(path: &Path) -> std::io::Result<File> {
    let writable = File::options().read(true).write(true).open(path);
    writable.or_else(|_| File::open(path))
}

/// Differences of two records, as `key: first ≠ second`; a missing value is null.
///
/// # Errors
/// If a record cannot be written as JSON.
pub fn differences(
    first: &impl Serialize,
    second: &impl Serialize,
) -> Result<Vec<String>, serde_json::Error> {
    let (first, second) = (serde_json::to_value(first)?, serde_json::to_value(second)?);
    let mut found = Vec::new();
    compare("", &first, &second, &mut found);
    Ok(found)
}

fn compare(key: &str, a: &serde_json::Value, b: &serde_json::Value, found: &mut Vec<String>) {
    if let (serde_json::Value::Array(a), serde_json::Value::Array(b)) = (a, b)
        && let (Some(first), Some(second)) = (names(a), names(b))
    {
        if first != second {
            let (first, second) = (first.join(", "), second.join(", "));
            found.push(format!("{key}: {first} ≠ {second}"));
            return;
        }
        for (k, (a, b)) in a.iter().zip(b).enumerate() {
            compare(&format!("{key}[{k}]"), a, b, found);
        }
        return;
    }
    match (a, b) {
        (serde_json::Value::Object(a), serde_json::Value::Object(b)) => {
            let keys: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            for name in keys {
                let null = serde_json::Value::Null;
                let path = if key.is_empty() {
                    name.clone()
                } else {
                    format!("{key}.{name}")
                };
                compare(
                    &path,
                    a.get(name).unwrap_or(&null),
                    b.get(name).unwrap_or(&null),
                    found,
                );
            }
        }
        _ if a != b => found.push(format!("{key}: {a} ≠ {b}")),
        _ => {}
    }
}

/// The names of objects that all have one.
fn names(values: &[serde_json::Value]) -> Option<Vec<&str>> {
    values
        .iter()
        .map(|value| value.get("name")?.as_str())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leftovers_are_removed_if_no_other_process_is_at_work() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("record.json");
        let left = folder
            .path()
            .join("set01/.catalogue-001.fits.0123456789abcdef.part");
        std::fs::create_dir(folder.path().join("set01")).unwrap();
        std::fs::write(&left, "half").unwrap();
        let first = claim(&path, &1).unwrap();
        assert!(!left.exists());
        std::fs::write(&left, "being written").unwrap();
        let second = claim(&path, &1).unwrap();
        assert!(left.exists());
        drop((first, second));
        let _third = claim(&path, &1).unwrap();
        assert!(!left.exists());
        let message = claim(&path, &2).unwrap_err().to_string();
        assert!(message.contains(": 1 ≠ 2"), "{message}");
    }

    #[test]
    fn important_differences_come_first_and_others_are_counted() {
        let mut lines: Vec<String> = (0..34)
            .map(|k| format!("submission.a.k{k}: 1 ≠ 2"))
            .collect();
        lines.insert(0, "submission.description: \"a\" ≠ \"b\"".into());
        lines.push("submission.name: \"a\" ≠ \"b\"".into());
        lines.push("version: \"1\" ≠ \"2\"".into());
        let shown = most_important(lines);
        assert_eq!(shown.len(), SHOWN + 1);
        assert!(shown[0].starts_with("version") && shown[1].starts_with("submission.name"));
        assert_eq!(shown[2], "submission.a.k0: 1 ≠ 2");
        assert_eq!(shown[SHOWN], "and 31 more");
        assert_eq!(
            most_important(vec!["images: 1 ≠ 2".into()]),
            ["images: 1 ≠ 2"]
        );
    }

    #[test]
    fn a_removed_or_replaced_folder_is_detected() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("out");
        let path = folder.join("record.json");
        let claimed = claim(&path, &1).unwrap();
        let result = folder.join("result");
        std::fs::write(&result, "").unwrap();
        claimed.check_results([result.clone()]).unwrap();
        std::fs::remove_file(&result).unwrap();
        let message = claimed.check_results([result]).unwrap_err().to_string();
        assert!(message.contains("was removed"), "{message}");
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(claimed.check().is_err());
        let _other = claim(&path, &1).unwrap();
        let message = claimed.check().unwrap_err().to_string();
        assert!(
            message.contains("out: the folder was removed or replaced"),
            "{message}"
        );
    }

    #[test]
    fn lists_of_named_things_differ_by_name_or_by_value() {
        let of = |values: &[(&str, u32)]| -> Vec<serde_json::Value> {
            let object = |&(name, size)| serde_json::json!({ "name": name, "size": size });
            values.iter().map(object).collect()
        };
        let found = differences(&of(&[("a", 1), ("b", 2)]), &of(&[("a", 1)])).unwrap();
        assert_eq!(found, [": a, b ≠ a"]);
        let found = differences(&of(&[("a", 1), ("b", 2)]), &of(&[("a", 1), ("b", 3)])).unwrap();
        assert_eq!(found, ["[1].size: 2 ≠ 3"]);
    }
}
