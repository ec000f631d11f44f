//! Entries of challenges of scenes: a catalogue of any program for each exposure, and what `bias` makes of all of them. m, c and the
//! shear error are those of `bias --units catalogues`, so that everybody can repeat them once the true shears are published.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_bias::Design;
use shearq_catalogue::columns::Names;
use shearq_catalogue::request::{Input, Request, Units};
use shearq_catalogue::sheared_files::with_sheared_files;
use shearq_catalogue::truth::Truth;
use shearq_dataset::layout::MAX_SET;
use shearq_dataset::run::RUN_FILE;
use shearq_files::atomic::list;
use shearq_files::{FileError, names_of};
use shearq_pipeline::scenes::SHEARS;
use shearq_quantities::{hints, tried};
use shearq_results::bias::{BiasFailure, Summed, sum};
use shearq_results::submit::archive::is_archive;
use shearq_results::submit::{MANIFEST_FILE, Sent};
use thiserror::Error;

use crate::kind::{Measured, RankBy};

/// m, c and the shear error of an entry, each with its standard error. The store keeps them, so the names are part of the format.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SceneScore {
    /// Mean of both components.
    pub m: Measured,
    /// Modulus of c, divided by 1 + m.
    pub c: Measured,
    /// Of 1 arcmin².
    pub shear_error: Measured,
    /// Rows that count, per arcmin².
    pub density: f64,
}

impl SceneScore {
    /// Of catalogues of `area` arcmin² each.
    ///
    /// # Errors
    /// If the catalogues do not determine m, or do not follow their true shears.
    pub fn new(summed: &Summed, area: f64) -> Result<Self, BiasFailure> {
        let result = summed.result()?;
        let all = result.all()?;
        let of = |key| {
            let found = all.value(key);
            found.map_or((f64::NAN, f64::NAN), |own| (own.value, own.error))
        };
        let (m, c1, c2) = (of("m_mean"), of("c1"), of("c2"));
        let response = 1.0 + m.0;
        let c = c1.0.hypot(c2.0);
        let c_error = (c1.0 * c1.1).hypot(c2.0 * c2.1) / c;
        let scatter = all.shear_error(area).unwrap_or(f64::NAN) / response;
        // Of a standard deviation with ν degrees of freedom: 1/√(2ν). Two lines have two parameters each.
        let freedom = 2.0 * (all.units as f64 - 2.0);
        let relative = (0.5 / freedom).sqrt().hypot(m.1 / response);
        Ok(SceneScore {
            m,
            c: (c / response, c_error / response),
            shear_error: (scatter, scatter * relative),
            density: all.galaxies as f64 / (all.units as f64 * area),
        })
    }

    /// Value and standard error of a metric; NaN for those that scenes do not have.
    pub fn value(&self, metric: RankBy) -> Measured {
        match metric {
            RankBy::M => (self.m.0.abs(), self.m.1),
            RankBy::C => self.c,
            RankBy::ShearError => self.shear_error,
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated | RankBy::Qc => {
                (f64::NAN, f64::NAN)
            }
        }
    }

    /// Whether |m| is above a limit by more than twice its error: the errors of a challenge of few scenes exceed the limit.
    pub fn is_biased(&self, max_m: f64) -> bool {
        self.m.0.abs() > max_m + 2.0 * self.m.1
    }
}

// Root mean square of a component of shears whose modulus is uniform between 0.01 and 0.05: √((0.05³ − 0.01³)/(3 · 0.04)/2).
const SHEAR_RMS: f64 = 0.0227;
// Shear error of `detect` on scenes of the default population (docs/scenes.md).
const USUAL_SHEAR_ERROR: f64 = 0.058;

/// The error of m, the mean of both components, that a good pipeline reaches on scenes of this area together, in arcmin².
pub fn expected_m_error(area: f64) -> f64 {
    USUAL_SHEAR_ERROR / (SHEAR_RMS * (2.0 * area).sqrt())
}

/// Why the catalogues of an entry cannot be summed. Nothing of it depends on the true shear.
#[derive(Debug, Error)]
pub enum SceneError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Bias(#[from] BiasFailure),
    #[error("{}: the name has no number of a scene of this challenge{}", .0.display(), tried(self.hint()))]
    Unnamed(PathBuf),
    #[error("{}: another catalogue of scene {scene} (expected one, or files of noshear, 1p, 1m, 2p and 2m)", path.display())]
    Twice { path: PathBuf, scene: u32 },
    #[error("scene {} has no catalogue (found {found} of {expected} scenes){}", names_of(scenes), tried(self.hint()))]
    Missing {
        scenes: Vec<String>,
        found: usize,
        expected: usize,
    },
    #[error("few scenes decide: the mean shear follows as if from {effective:.1} of {scenes} (expected {:.0} or more, of weights times responses in each scene){}", LEAST_EVEN * *scenes as f64, tried(self.hint()))]
    Uneven { effective: f64, scenes: usize },
}

// Least number of scenes of equal weight that determine the mean shear as well as those of an entry, in units of all. Poisson noise of 180
// galaxies in a scene leaves 0.99. An entry that is of few scenes has a line through them by chance, and no error.
const LEAST_EVEN: f64 = 0.8;

impl SceneError {
    hints! {
        Self::File(error) => return error.hint.clone(),
        Self::Bias(error) => return error.hint(),
        Self::Unnamed(..) => "scene-001.csv, or any name in a folder scene-001",
        Self::Missing { .. } => "a catalogue of each scene, such as scene-001.csv",
        Self::Uneven { .. } => "all galaxies of each scene, and weights that do not depend on the scene",
    }
}

// In names of files and folders, before the number of a scene. The last one is of catalogues by shearq.
const BEFORE_NUMBER: [&str; 3] = ["scene-", "scene_", "catalogue-"];

/// The scene that the name of a file or of its folders within an entry states.
pub fn scene_of(name: &Path) -> Option<u32> {
    let text = name.to_string_lossy().to_lowercase();
    let number = |rest: &str| -> Option<u32> {
        let end = rest.find(|c: char| !c.is_ascii_digit());
        let number = rest[..end.unwrap_or(rest.len())].parse().ok()?;
        (1..=MAX_SET).contains(&number).then_some(number)
    };
    let after = |before: &&str| {
        let mut places = text.match_indices(*before);
        places.find_map(|(at, _)| number(&text[at + before.len()..]))
    };
    BEFORE_NUMBER.iter().find_map(after)
}

// Whether the name of a file or folder is that of a part of an entry.
fn is_part(path: &Path) -> bool {
    let of_scene = |own| scene_of(Path::new(own)).is_some();
    path.ends_with(RUN_FILE) || (path.file_name().is_some_and(of_scene) && !is_archive(path))
}

/// Whether a folder is an entry: `detect` wrote it, or names of what it contains state scenes. Where an inbox may be (`is_outer`), most
/// of them must, because the name of a team or of its archive could, too.
pub fn is_entry(inside: &[PathBuf], is_outer: bool) -> bool {
    let parts = inside.iter().filter(|path| is_part(path)).count();
    let is_run = inside.iter().any(|path| path.ends_with(RUN_FILE));
    is_run
        || if is_outer {
            2 * parts > inside.len()
        } else {
            parts > 0
        }
}

/// The catalogues of an entry that is a folder, in order of their paths. They may be in folders, and `detect` writes the record of
/// its run beside them.
pub fn files(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    let (mut folders, mut found) = (vec![folder.to_owned()], Vec::new());
    while let Some(next) = folders.pop() {
        for path in list(&next)? {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let is_other = name.starts_with('.') || [RUN_FILE, MANIFEST_FILE].contains(&&*name);
            match path.is_dir() {
                // A link could lead to a folder above.
                _ if is_other || path.is_symlink() => {}
                true => folders.push(path),
                false => found.push(path),
            }
        }
    }
    found.sort();
    Ok(found)
}

// The catalogue of each scene.
fn catalogues(sent: &Sent, scenes: &[u32]) -> Result<BTreeMap<u32, Input>, SceneError> {
    let scene = |path: &Path| {
        let name = path.strip_prefix(sent.path()).unwrap_or(path);
        let own = scene_of(name).filter(|own| scenes.binary_search(own).is_ok());
        own.ok_or_else(|| SceneError::Unnamed(sent.as_given(path)))
    };
    let files = files(sent.path())?;
    files.iter().try_for_each(|path| scene(path).map(|_| ()))?;
    let inputs = files.into_iter().map(Input::from).collect();
    let unsheared = Truth::Constant([0.0; 2]);
    let mut found = BTreeMap::new();
    for input in with_sheared_files(inputs, &unsheared, &Names::default()) {
        let (path, scene) = (input.name.clone(), scene(&input.name)?);
        if found.insert(scene, input).is_some() {
            let path = sent.as_given(&path);
            return Err(SceneError::Twice { path, scene });
        }
    }
    let missing = scenes.iter().filter(|scene| !found.contains_key(scene));
    let missing: Vec<String> = missing.map(u32::to_string).collect();
    match missing.is_empty() {
        true => Ok(found),
        false => Err(SceneError::Missing {
            scenes: missing,
            found: found.len(),
            expected: scenes.len(),
        }),
    }
}

/// The sums of an entry with a catalogue of each of `scenes`, which are in ascending order and have the `shear` each.
pub fn summed(
    sent: &Sent,
    scenes: &[u32],
    shear: impl Fn(u32) -> [f64; 2],
) -> Result<Summed, SceneError> {
    let catalogues = catalogues(sent, scenes)?;
    let shears = catalogues.iter().map(|(scene, input)| {
        let name = input.name.display().to_string();
        (name, shear(*scene))
    });
    let request = Request {
        truth: Truth::Catalogues(shears.collect()),
        catalogues: catalogues.into_values().collect(),
        units: Units::Catalogues,
        design: Some(Design::Fields),
        ..Request::default()
    };
    let summed = sum(&request, &|_| true)?;
    let (effective, scenes) = (summed.effective_catalogues(), scenes.len());
    // Not a number fails, too.
    match effective >= LEAST_EVEN * scenes as f64 {
        true => Ok(summed),
        false => Err(SceneError::Uneven { effective, scenes }),
    }
}

/// What is known of an entry without the true shears: which column is used as what, a line each, and what is probably wrong.
pub fn check(sent: &Sent, scenes: &[u32]) -> Result<(Vec<String>, Option<String>), SceneError> {
    let summed = summed(sent, scenes, |_| [0.0; 2])?;
    // The response must be clear, and the ellipticities no constants.
    summed.result()?;
    let about = summed.about();
    Ok((about.columns.clone(), about.undivided.clone()))
}

// Options of `bias` in hints, and what stands for them in an entry.
const IN_ENTRIES: [(&str, &str); 2] = [
    ("--columns ", "names of columns as by `bias --columns`, "),
    ("--drop-missing", "catalogues without such rows"),
];

/// A text about the catalogues of an entry, without the folder that it was unpacked to and the options of `bias`.
pub fn shortened(text: &str, sent: &Sent) -> String {
    let text = text.replace(&format!("{}/", sent.path().display()), "");
    let replaced = |text: String, (option, words): &(&str, &str)| text.replace(option, words);
    IN_ENTRIES.iter().fold(text, replaced)
}

/// The true shears of the scenes in a private folder.
pub fn true_shears(private: &Path) -> Result<BTreeMap<u32, [f64; 2]>, FileError> {
    let path = private.join(SHEARS);
    let (truth, _) = Truth::read(&path, None)?;
    let Truth::Catalogues(all) = truth else {
        return Err(FileError::new(
            path,
            "expected the columns catalogue, g1, g2",
        ));
    };
    let each = all.iter();
    Ok(each
        .filter_map(|(name, shear)| Some((scene_of(Path::new(name))?, *shear)))
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_state_scenes() {
        let of = |name: &str| scene_of(Path::new(name));
        for name in [
            "scene-012.csv",
            "Scene_12.FITS",
            "scene-012/set01/catalogue-001.parquet",
            "set01/catalogue-012.parquet",
            "scene-finder/scene-12_1p.csv",
        ] {
            assert_eq!(of(name), Some(12), "{name}");
        }
        for name in [
            "12.csv",
            "scene.csv",
            "scene-0.csv",
            "scene-99999999999.csv",
        ] {
            assert_eq!(of(name), None, "{name}");
        }
    }

    #[test]
    fn an_inbox_is_no_entry_because_of_one_name() {
        let of = |names: &[&str]| {
            let inside: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
            is_entry(&inside, true)
        };
        assert!(of(&["scene-001.csv", "scene-002.csv", "notes.txt"]) && of(&[RUN_FILE, "set01"]));
        assert!(!of(&["scene-1-team.tar.gz"]) && !of(&["honest", "Scene-7"]));
    }

    #[test]
    fn limits_contain_twice_the_error_of_m() {
        let of = |m| SceneScore {
            m,
            c: (0.0, 0.0),
            shear_error: (0.05, 0.01),
            density: 60.0,
        };
        assert!(!of((-0.059, 0.02)).is_biased(0.02) && of((-0.061, 0.02)).is_biased(0.02));
    }

    // 0.058/(0.0227 √(2 · 400 · 21.16)).
    #[test]
    fn four_hundred_scenes_determine_m_to_two_percent() {
        let error = expected_m_error(400.0 * 21.16);
        assert!((error - 0.0196).abs() < 1e-4, "{error}");
    }
}
