//! Records of folders of results: `run.json`, which is written before the first result, and the claim of a folder by it.

use std::fs::{File, TryLockError};
use std::path::{Component, Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};
use shearq_files::open::is_there;
use shearq_files::table::FileFormat;
use shearq_files::{FileError, atomic};
use shearq_simulate::kinds::SetKind;
use shearq_simulate::set::SimulationSettings;
use shearq_submissions::Configuration;

use crate::images::{self, Files, ImageId};
use crate::layout::{DataFolder, Layout, check_folder, fill};
use crate::pattern::endings;

pub const RUN_FILE: &str = "run.json";

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    Folder {
        // Relative to the folder of the record, so that both can be moved together.
        path: PathBuf,
        layout: Layout,
    },
    /// Simulated and measured in memory. The true shear is in the folder of the catalogues.
    Simulated(SimulationSettings),
}

impl Source {
    /// `beside` is the folder of the record.
    pub fn folder(data: &DataFolder, beside: &Path) -> Result<Self, FileError> {
        Ok(Source::Folder {
            path: relative_path(beside, data.root())?,
            layout: data.layout().clone(),
        })
    }

    /// The same source, of a record in the folder `from`, for one in the folder `to`.
    pub fn moved(&self, from: &Path, to: &Path) -> Result<Self, FileError> {
        Ok(match self {
            Source::Folder { path, layout } => Source::Folder {
                path: relative_path(to, &from.join(path))?,
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
    pub fn data(&self, measured: &Path) -> Result<DataFolder, FileError> {
        match self {
            Source::Folder { path, .. } => DataFolder::open(shortened(measured.join(path))),
            Source::Simulated(_) => DataFolder::open(measured),
        }
    }
}

pub fn relative_path(from: &Path, to: &Path) -> Result<PathBuf, FileError> {
    relative(from, to).map_err(FileError::doing(to, "cannot determine where the folder is"))
}

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Source::Folder { path, .. } => path.display().fmt(f),
            Source::Simulated(settings) => write!(f, "a simulation with seed {}", settings.seed),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    pub version: String,
    pub source: Source,
    // The name that stored records have.
    #[serde(rename = "submission")]
    pub configuration: Configuration,
    pub format: FileFormat,
    /// Cuts and weights that were applied to the catalogues, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selection: Option<String>,
    /// Whether the images of a set are epochs of the same galaxies, with one catalogue by the number of the first.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub epochs: bool,
}

impl Run {
    /// Reads the record of a folder; `None` without a record.
    pub fn read(folder: &Path) -> Result<Option<Self>, FileError> {
        read_record(&folder.join(RUN_FILE))
    }

    pub fn new(source: Source, configuration: Configuration, format: FileFormat) -> Self {
        // All images of a subfield of GREAT3 are epochs.
        let epochs = source.layout().great3.is_some();
        Run {
            version: crate::VERSION.into(),
            source,
            configuration,
            format,
            selection: None,
            epochs,
        }
    }

    /// Images of `sets` of a data folder (of all its sets if empty) by whose numbers there are catalogues.
    pub fn images(&self, data: &DataFolder, sets: &[u32]) -> Result<Vec<ImageId>, FileError> {
        let mut all = images::of_folder(data, sets)?;
        if self.epochs {
            images::check_epochs(data, sets)?;
            all.dedup_by_key(|id| id.set);
        }
        Ok(all)
    }

    /// The images that the catalogue `id` is measured from.
    pub fn epochs_of(&self, data: &DataFolder, id: ImageId) -> Result<Vec<ImageId>, FileError> {
        match self.epochs {
            true => images::of_folder(data, &[id.set]),
            false => Ok(vec![id]),
        }
    }

    /// Reads the record of a folder that must be one of catalogues.
    pub fn require(folder: &Path) -> Result<Self, FileError> {
        const EXPECTED: &str = "a folder of catalogues that `shearq measure` or `shearq run` wrote";
        check_folder(folder, EXPECTED)?;
        if let Some(run) = Run::read(folder)? {
            return Ok(run);
        }
        // The most frequent mistake is to name the data in place of the results.
        let images = DataFolder::open(folder).and_then(|data| data.images(&[]));
        Err(match images {
            Ok(images) if !images.sets().is_empty() => FileError::new(folder, format!(
                "this is a data folder: it contains galaxy images and no {RUN_FILE}; expected {EXPECTED}"
            ))
            .hint(format!(
                "shearq measure --data {} --out OUT --submission 48/linear/star",
                folder.display()
            )),
            _ => FileError::new(folder, format!("there is no {RUN_FILE}; expected {EXPECTED}")),
        })
    }

    /// Claims a folder for the catalogues of this run.
    pub fn claim(&self, folder: &Path) -> Result<Claim, FileError> {
        claim(&folder.join(RUN_FILE), self, &self.pattern())
    }

    pub fn catalogue(&self, folder: &Path, set: u32, image: u32) -> PathBuf {
        folder.join(fill(&self.pattern(), set, image))
    }

    /// The catalogues of `sets` (of all if empty) that are there.
    pub fn catalogues(&self, folder: &Path, sets: &[u32]) -> Result<Files, FileError> {
        images::find(folder, &self.pattern(), &[""], sets)
    }

    fn pattern(&self) -> String {
        let ending = self.format.extension();
        format!("set{{set:02}}/catalogue-{{image:03}}.{ending}")
    }
}

/// Opens the data folder that a command is to read images from.
pub fn open_data(folder: &Path) -> Result<DataFolder, FileError> {
    let data = DataFolder::open(folder)?;
    // Users may measure into the data folder, which then has a record of catalogues and images.
    if !is_there(&folder.join(RUN_FILE)) || !data.images(&[])?.sets().is_empty() {
        return Ok(data);
    }
    let Some(run) = Run::read(folder)? else {
        return Ok(data);
    };
    let message = format!(
        "this folder contains catalogues ({RUN_FILE}) and no galaxy images; expected the data folder that they were measured from"
    );
    Err(match &run.source {
        Source::Folder { path, .. } => {
            let data = shortened(folder.join(path));
            FileError::new(folder, message).hint(format!("--data {}", data.display()))
        }
        Source::Simulated(_) => FileError::new(
            folder,
            message + "; they were simulated in memory, and `shearq simulate` writes images",
        ),
    })
}

/// Name of the record in a simulated data folder.
pub const SIMULATION_FILE: &str = "simulation.json";

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SimulationRecord {
    pub version: String,
    pub settings: SimulationSettings,
}

/// The kind of a set, if the data were simulated. Other data may have the same set numbers.
pub fn kind_of(data: &DataFolder, set: u32) -> Result<Option<SetKind>, FileError> {
    let is_simulated = is_there(&data.root().join(SIMULATION_FILE))
        || Run::read(data.root())?.is_some_and(|run| matches!(run.source, Source::Simulated(_)));
    Ok(SetKind::of(set).filter(|_| is_simulated))
}

// Absolute if there is no common ancestor, as for two drives on Windows. Neither path must exist.
fn relative(folder: &Path, path: &Path) -> std::io::Result<PathBuf> {
    let (folder, path) = (resolve(folder)?, resolve(path)?);
    let shared = folder
        .components()
        .zip(path.components())
        .take_while(|(a, b)| a == b)
        .count();
    if shared == 0 {
        return Ok(path);
    }
    let up = folder
        .components()
        .skip(shared)
        .map(|_| Component::ParentDir);
    let path: PathBuf = up.chain(path.components().skip(shared)).collect();
    Ok(match path.as_os_str().is_empty() {
        true => ".".into(),
        false => path,
    })
}

/// `path` without the `folder/..` in it, if that is the same folder: a short name for messages.
pub fn shortened(path: PathBuf) -> PathBuf {
    let mut short = PathBuf::new();
    for part in path.components() {
        match (part, short.components().next_back()) {
            (Component::ParentDir, Some(Component::Normal(_))) => {
                short.pop();
            }
            (part, _) => short.push(part),
        }
    }
    if short.as_os_str().is_empty() {
        short.push(".");
    }
    // After a symbolic link, `..` is the parent of its target.
    match (resolve(&short), resolve(&path)) {
        (Ok(one), Ok(other)) if one == other => short,
        _ => path,
    }
}

// `canonicalize` fails for paths that do not exist yet, such as a new output folder, so only the existing part is resolved by it.
fn resolve(path: &Path) -> std::io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    for there in path.ancestors() {
        let (Ok(mut resolved), Ok(rest)) = (there.canonicalize(), path.strip_prefix(there)) else {
            continue;
        };
        for part in rest.components() {
            match part {
                Component::ParentDir => {
                    resolved.pop();
                }
                part => resolved.push(part),
            }
        }
        return Ok(resolved);
    }
    Ok(path)
}

/// `None` without a record.
pub fn read_record<R: DeserializeOwned>(path: &Path) -> Result<Option<R>, FileError> {
    let text = match shearq_files::open::read_to_string(path, shearq_files::open::SETTINGS) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(FileError::doing(path, "cannot read the record")(error)),
    };
    parse_record(path, &text).map(Some)
}

/// `path` is for messages.
pub fn parse_record<R: DeserializeOwned>(path: &Path, text: &str) -> Result<R, FileError> {
    serde_json::from_str(text).map_err(|error| {
        // `is_data`: valid JSON, but with other keys or types.
        let [key, version] = match error.is_data() {
            true => [key_before(text, &error), other_version(text)].map(Option::unwrap_or_default),
            false => [const { String::new() }; 2],
        };
        let message = format!("not a record of this kind: {key}{error}{version}");
        match version.is_empty() {
            true => FileError::new(path, message),
            false => FileError::new(path, message).hint("another folder"),
        }
    })
}

// The key whose value serde refuses, which its error does not name. At the end of an object or a list a key is missing, or the
// whole is wrong.
fn key_before(text: &str, error: &serde_json::Error) -> Option<String> {
    let line = text.lines().nth(error.line().checked_sub(1)?)?;
    let before = line.get(..error.column())?;
    let (start, _) = before.rsplit_once("\":")?;
    let (_, key) = start.rsplit_once('"')?;
    (!before.ends_with(['}', ']'])).then(|| format!("`{key}`: "))
}

fn other_version(text: &str) -> Option<String> {
    let record: serde_json::Value = serde_json::from_str(text).ok()?;
    let of_store = || record.get("run")?.get("version");
    let version = record.get("version").or_else(of_store)?;
    (version != crate::VERSION).then(|| format!("; the record belongs to version {version}"))
}

pub fn write_record(path: &Path, record: &impl Serialize) -> Result<(), FileError> {
    atomic::write(path, record_text(path, record)?.as_bytes())
}

/// Indented, because users read and compare records. `path` is for messages.
pub fn record_text(path: &Path, record: &impl Serialize) -> Result<String, FileError> {
    let mut text = serde_json::to_string_pretty(record)
        .map_err(FileError::doing(path, "cannot write the record"))?;
    text.push('\n');
    Ok(text)
}

/// Numbers that may be NaN. JSON has no NaN: serde_json writes null, which it does not read as a number.
pub trait Numbers: Sized {
    type Form: DeserializeOwned;
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
pub fn nan_for_null<'de, D: Deserializer<'de>, N: Numbers>(deserializer: D) -> Result<N, D::Error> {
    N::Form::deserialize(deserializer).map(N::from_form)
}

/// A folder of results that this process writes to until it drops this. Other processes of the same settings may write to
/// it too, unless one is [alone](Claim::alone).
#[derive(Debug)]
#[must_use]
pub struct Claim {
    record: File,
    path: PathBuf,
}

impl Claim {
    /// Refuses the folder to other processes that claim it alone, for results that the record does not determine.
    pub fn alone(self) -> Result<Self, FileError> {
        match self.record.try_lock() {
            Err(TryLockError::WouldBlock) => {
                let folder = self.path.parent().unwrap_or(&self.path);
                let message = "another process writes to this folder";
                Err(FileError::new(folder, message).hint("wait for it, or another folder"))
            }
            // File systems without locks have none that could be taken by others.
            _ => Ok(self),
        }
    }

    /// Checks that the record of the folder has not been removed or replaced.
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

    // Whether the record is the file that was claimed.
    #[cfg(unix)]
    fn is_there(&self) -> bool {
        use std::os::unix::fs::MetadataExt;
        let (Ok(held), Ok(found)) = (self.record.metadata(), std::fs::metadata(&self.path)) else {
            return false;
        };
        (held.dev(), held.ino()) == (found.dev(), found.ino())
    }

    // Windows does not remove an open file, so that a file of this name is the one that was claimed.
    #[cfg(not(unix))]
    fn is_there(&self) -> bool {
        self.path.exists()
    }

    /// Checks the folder at the end of the work, and that all `results` are there.
    pub fn check_results(
        &self,
        results: impl IntoIterator<Item = PathBuf>,
    ) -> Result<(), FileError> {
        self.check()?;
        match results.into_iter().find(|path| !path.is_file()) {
            None => Ok(()),
            Some(path) => {
                let message = "the file was removed while results were written to its folder";
                Err(FileError::new(path, message).hint("the same command again"))
            }
        }
    }
}

/// Claims the folder of `path` for `record`. Writes the record if there is none, and refuses a folder with a different
/// record, or with results by the names of `pattern` and no record. Leftovers of killed processes are removed.
pub fn claim<R: Serialize + DeserializeOwned>(
    path: &Path,
    record: &R,
    pattern: &str,
) -> Result<Claim, FileError> {
    let folder = path.parent().unwrap_or(path);
    if folder.exists() {
        check_folder(folder, "a folder to write to")?;
    }
    let mut earlier: Option<R> = read_record(path)?;
    if earlier.is_none() {
        // Results whose record was lost would be kept as those of the new one.
        let results = images::find(folder, pattern, endings(pattern), &[])?;
        // Another process that is first has written its record before its results.
        if let Some(found) = results.first().filter(|_| !is_there(path)) {
            let message = format!(
                "nothing states the settings of this file (found no {} in {})",
                path.file_name().unwrap_or_default().display(),
                folder.display()
            );
            return Err(
                FileError::new(found, message).hint("another folder, or remove the results")
            );
        }
        // If another process is first, its record is compared like any earlier record.
        let _ = atomic::write_if_absent(path, record_text(path, record)?.as_bytes())?;
        earlier = read_record(path)?;
    }
    let differences = differences(&earlier, &Some(record))
        .map_err(|error| FileError::new(path, format!("cannot compare records: {error}")))?;
    if !differences.is_empty() {
        return Err(FileError::new(
            folder,
            format!(
                "this folder contains results of other settings (earlier ≠ now):\n  {}\nuse another folder, or remove this one",
                most_important(differences).join("\n  ")
            ),
        ));
    }
    let record = File::open(path).map_err(FileError::doing(path, "cannot open the record"))?;
    atomic::remove_leftovers(folder);
    Ok(Claim {
        record,
        path: path.to_owned(),
    })
}

// A message must fit on a screen. Chosen by hand.
const MAX_DIFFERENCES: usize = 6;
const MAX_DIFFERENCE_CHARS: usize = 160;

// The differences that explain most, in this order, and the number of the others.
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
    let more = differences.len().saturating_sub(MAX_DIFFERENCES);
    differences.truncate(MAX_DIFFERENCES);
    for line in &mut differences {
        if let Some((end, _)) = line.char_indices().nth(MAX_DIFFERENCE_CHARS) {
            // Values of settings may be lists or texts of any length.
            line.truncate(end);
            line.push('…');
        }
    }
    if more > 0 {
        differences.push(format!("and {more} more"));
    }
    differences
}

/// Differences of two records, as `key: first ≠ second`; a missing value is null.
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

// Lists of named objects, such as configurations, are compared by name first: an inserted one would otherwise make all that
// follow differ.
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
    fn a_path_is_shortened_unless_a_link_leads_elsewhere() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        std::fs::create_dir_all(at("out/deep")).unwrap();
        std::fs::create_dir_all(at("data")).unwrap();
        assert_eq!(shortened(at("out/deep/../../data")), at("data"));
        assert_eq!(shortened("src/..".into()), Path::new("."));
        assert_eq!(shortened("../..".into()), Path::new("../.."));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(at("out/deep"), at("link")).unwrap();
            std::fs::create_dir_all(at("out/data")).unwrap();
            assert_eq!(shortened(at("link/../data")), at("link/../data"));
        }
    }

    #[test]
    fn a_path_is_the_same_however_it_was_given() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        std::fs::create_dir_all(at("data/deep")).unwrap();
        let between = |folder: &str, path: &str| relative(&at(folder), &at(path)).unwrap();
        for same in ["data", "data/", "./data", "data/deep/..", "new/../data"] {
            assert_eq!(between("out", same), Path::new("../data"), "{same}");
            assert_eq!(between("new/out/", same), Path::new("../../data"), "{same}");
        }
        assert_eq!(between("data", "data"), Path::new("."));
        assert_eq!(between("data", "data/deep"), Path::new("deep"));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(at("data"), at("link")).unwrap();
            assert_eq!(between("out", "link"), Path::new("../data"));
        }
    }

    #[test]
    fn a_damaged_record_does_not_count_as_none() {
        let folder = tempfile::tempdir().unwrap();
        let data = DataFolder::open(folder.path()).unwrap();
        assert_eq!(kind_of(&data, 1).unwrap(), None);
        std::fs::write(folder.path().join(RUN_FILE), "{").unwrap();
        assert!(kind_of(&data, 1).is_err());
        assert!(open_data(folder.path()).is_err());
    }

    const PATTERN: &str = "set{set}";

    #[test]
    fn leftovers_are_removed_unless_a_process_holds_them() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("record.json");
        // Branches of GREAT3 have images three folders below the record.
        let [left, deep] = [
            "set01/.catalogue-001.fits",
            "control/ground/constant/.image-000-0.fits",
        ]
        .map(|name| folder.path().join(format!("{name}.0123456789abcdef.part")));
        for path in [&left, &deep] {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "half").unwrap();
        }
        let _first = claim(&path, &1, PATTERN).unwrap();
        assert!(!left.exists() && !deep.exists());
        let target = folder.path().join("set01/catalogue-002.fits");
        let (held, _) = atomic::PartFile::create(target).unwrap();
        std::fs::write(&left, "half").unwrap();
        let _second = claim(&path, &1, PATTERN).unwrap();
        assert!(!left.exists() && held.path().exists());
        let message = claim(&path, &2, PATTERN).unwrap_err().to_string();
        assert!(message.contains(": 1 ≠ 2"), "{message}");
    }

    #[test]
    fn important_differences_come_first_and_others_are_counted() {
        let line = |k| format!("submission.a.k{k}: 1 ≠ 2");
        let mut lines: Vec<String> = (0..34).map(line).collect();
        lines.insert(0, "submission.description: \"a\" ≠ \"b\"".into());
        lines.push("submission.name: \"a\" ≠ \"b\"".into());
        lines.push("version: \"1\" ≠ \"2\"".into());
        let shown = most_important(lines);
        assert_eq!(shown.len(), MAX_DIFFERENCES + 1);
        assert!(shown[0].starts_with("version") && shown[1].starts_with("submission.name"));
        assert_eq!(shown[2], "submission.a.k0: 1 ≠ 2");
        assert_eq!(shown[MAX_DIFFERENCES], "and 31 more");
        let one = || vec!["images: 1 ≠ 2".to_owned()];
        assert_eq!(most_important(one()), one());
    }

    #[test]
    fn a_removed_or_replaced_folder_is_detected() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("out");
        let path = folder.join("record.json");
        let claimed = claim(&path, &1, PATTERN).unwrap();
        let result = folder.join("result");
        std::fs::write(&result, "").unwrap();
        claimed.check_results([result.clone()]).unwrap();
        std::fs::remove_file(&result).unwrap();
        let message = claimed.check_results([result]).unwrap_err().to_string();
        assert!(message.contains("was removed"), "{message}");
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(claimed.check().is_err());
        let _other = claim(&path, &1, PATTERN).unwrap();
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
