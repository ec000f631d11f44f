//! The record of a folder of results: `run.json`, written before the first result.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_submissions::Configuration;

use crate::layout::{DataFolder, Layout, fill};
use crate::listing::{self, Files};
use crate::record::read_record;
use crate::relative;
use shearq_files::FileError;
use shearq_files::open::is_there;
use shearq_files::table::FileFormat;
use shearq_simulate::kinds::SetKind;
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

/// Name of the record in a simulated data folder.
pub const SIMULATION_FILE: &str = "simulation.json";

/// Settings of a simulation, stored with its data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SimulationRecord {
    /// Version of shearq.
    pub version: String,
    /// The settings.
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
