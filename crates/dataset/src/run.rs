//! The record of a folder of results: `run.json`, written before the first result.

use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_submissions::Configuration;

use crate::images::{self, ImageId};
use crate::layout::{DataFolder, Layout, check_folder, fill};
use crate::listing::{self, Files};
use crate::record::read_record;
use shearq_files::FileError;
use shearq_files::open::is_there;
use shearq_files::table::FileFormat;
use shearq_simulate::kinds::SetKind;
use shearq_simulate::set::SimulationSettings;

pub const RUN_FILE: &str = "run.json";

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    Folder {
        // Relative to the folder of the record, so that both can be moved together.
        path: PathBuf,
        layout: Layout,
    },
    /// Simulated and measured in memory. The true shear lies beside the catalogues.
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
    /// Reads the record of a folder; `None` where there is none.
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
        let message = match images {
            Ok(images) if !images.sets().is_empty() => format!(
                "this is a data folder: it contains galaxy images and no {RUN_FILE}; expected {EXPECTED}. Try: shearq measure --data {} --out OUT --submission 48/linear/star",
                folder.display()
            ),
            _ => format!("there is no {RUN_FILE}; expected {EXPECTED}"),
        };
        Err(FileError::new(folder, message))
    }

    pub fn catalogue(&self, folder: &Path, set: u32, image: u32) -> PathBuf {
        folder.join(fill(&self.pattern(), set, image))
    }

    /// The catalogues of `sets` (of all if empty) that are there.
    pub fn catalogues(&self, folder: &Path, sets: &[u32]) -> Result<Files, FileError> {
        listing::find(folder, &self.pattern(), &[""], sets)
    }

    fn pattern(&self) -> String {
        let ending = self.format.extension();
        format!("set{{set:02}}/catalogue-{{image:03}}.{ending}")
    }
}

/// Opens the data folder that a command is to read images from.
pub fn open_data(folder: &Path) -> Result<DataFolder, FileError> {
    let data = DataFolder::open(folder)?;
    let Some(run) = Run::read(folder).ok().flatten() else {
        return Ok(data);
    };
    // Users may measure into the data folder, which then has a record of catalogues and images.
    if !data.images(&[])?.sets().is_empty() {
        return Ok(data);
    }
    let advice = match &run.source {
        Source::Folder { path, .. } => {
            let data = shortened(folder.join(path));
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

/// Name of the record in a simulated data folder.
pub const SIMULATION_FILE: &str = "simulation.json";

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SimulationRecord {
    pub version: String,
    pub settings: SimulationSettings,
}

/// The kind of a set, if the data were simulated. Other data may have the same set numbers.
pub fn kind_of(data: &DataFolder, set: u32) -> Option<SetKind> {
    let in_memory = || {
        let run = Run::read(data.root()).ok().flatten();
        run.is_some_and(|run| matches!(run.source, Source::Simulated(_)))
    };
    if is_there(&data.root().join(SIMULATION_FILE)) || in_memory() {
        SetKind::of(set)
    } else {
        None
    }
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
}
