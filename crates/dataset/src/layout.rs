//! Names of the files of a challenge, and its conventions.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_files::open::is_there;
use shearq_files::{FileError, open};
use shearq_quantities::checked_when_read;
use shearq_scoring::{Grid, TruthSign};

use crate::files::{self, Files};
use crate::great3;
pub use crate::mosaic::MAX_STAMP;
pub use crate::pattern::{IMAGE_PLACEHOLDERS, MAX_IMAGE, MAX_SET, check_pattern, fill};
use crate::pattern::{PLACEHOLDERS, STAMPS, endings};

/// Name of the layout file inside a data folder.
pub const LAYOUT_FILE: &str = "layout.toml";

/// File-name patterns and conventions of a data folder. `{set}` and `{image}` stand for plain numbers, `{set:02}` and
/// `{image:03}` for numbers with leading zeros. A layout is checked when it is read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(remote = "Self", deny_unknown_fields, default)]
pub struct Layout {
    pub galaxies: String,
    pub psf_star: String,
    pub psf_functional: String,
    pub truth: String,
    pub intrinsic: String,
    pub truth_sign: TruthSign,
    /// Side of the field in degrees.
    pub field_degrees: f64,
    /// Pixels a side of a stamp, if the image header has no STAMP.
    pub stamp: usize,
    /// The folder is a branch of GREAT3.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub great3: Option<great3::BranchLayout>,
}

impl Default for Layout {
    fn default() -> Self {
        Layout {
            galaxies: "set{set:02}/galaxies-{image:03}.fits".into(),
            psf_star: "set{set:02}/psf-{image:03}.fits".into(),
            psf_functional: "set{set:02}/psf-{image:03}.csv".into(),
            truth: "set{set:02}/truth.csv".into(),
            intrinsic: "set{set:02}/intrinsic-{image:03}.csv".into(),
            truth_sign: TruthSign::Standard,
            field_degrees: 10.0,
            stamp: 48,
            great3: None,
        }
    }
}

checked_when_read!(Layout);

impl Layout {
    // Checks every value against its range.
    fn validate(&self) -> Result<(), String> {
        let Layout {
            galaxies,
            psf_star,
            psf_functional,
            truth,
            intrinsic,
            truth_sign: _,
            field_degrees,
            stamp,
            great3: _,
        } = self;
        check_pattern("galaxies", galaxies, &PLACEHOLDERS)?;
        // One of these may serve several sets or images.
        for (key, pattern) in [
            ("psf_star", psf_star),
            ("psf_functional", psf_functional),
            ("truth", truth),
            ("intrinsic", intrinsic),
        ] {
            check_pattern(key, pattern, &[])?;
        }
        // Here and not when scoring, so that the message names the key of layout.toml.
        if !Grid::FIELDS.contains(field_degrees) {
            let (least, most) = (Grid::FIELDS.start(), Grid::FIELDS.end());
            return Err(format!(
                "`field_degrees` is {field_degrees:?}; expected {least} to {most}"
            ));
        }
        if !(1..=MAX_STAMP).contains(stamp) {
            return Err(format!(
                "`stamp` is {stamp}; expected 1 to {MAX_STAMP} pixels"
            ));
        }
        Ok(())
    }
}

/// Checks that `folder` is a folder. `expected` describes it in the error.
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

#[derive(Debug, Clone)]
pub struct DataFolder {
    root: PathBuf,
    layout: Layout,
}

impl DataFolder {
    /// Opens a folder, with the layout of its `layout.toml`, else of GREAT3 if it has such files, else the default one.
    pub fn open(root: impl AsRef<Path>) -> Result<Self, FileError> {
        let root = root.as_ref().to_owned();
        check_folder(&root, "a data folder")?;
        let path = root.join(LAYOUT_FILE);
        let layout = if is_there(&path) {
            let text = open::read_to_string(&path, open::SETTINGS)
                .map_err(FileError::doing(&path, "cannot read the layout"))?;
            toml::from_str(&text).map_err(|e| FileError::new(&path, e.to_string().trim_end()))?
        } else {
            match great3::detect(&root)? {
                Some(found) => Layout {
                    galaxies: great3::GALAXIES.into(),
                    psf_star: found.psf_star.into(),
                    stamp: found.stamp,
                    great3: Some(found.branch),
                    ..Layout::default()
                },
                None => Layout::default(),
            }
        };
        Ok(DataFolder { root, layout })
    }

    /// The folder with all stars of each star field of GREAT3 stacked.
    pub fn with_stacked_stars(mut self) -> Result<Self, FileError> {
        let Some(branch) = &mut self.layout.great3 else {
            let message = "only star fields of GREAT3 can be stacked (expected image-000-0.fits, starfield_image-000-0.fits and galaxy_catalog-000.fits)";
            return Err(FileError::new(&self.root, message));
        };
        if self.layout.psf_star != great3::STAR_FIELDS {
            let example = fill(great3::PSF_IMAGES, 0, 0);
            let message = format!(
                "there are PSFs of single galaxies (found images such as {example}), which are used in place of the star fields that were to be stacked"
            );
            return Err(FileError::new(&self.root, message)
                .hint("without --stack-stars, or remove these images"));
        }
        branch.stacked_stars = true;
        Ok(self)
    }

    pub fn new(root: impl AsRef<Path>) -> Self {
        DataFolder {
            root: root.as_ref().to_owned(),
            layout: Layout::default(),
        }
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The galaxy image of a set; the name without a compression ending if no file exists.
    pub fn galaxies(&self, set: u32, image: u32) -> PathBuf {
        self.image(&self.layout.galaxies, set, image)
    }

    pub fn psf_star(&self, set: u32, image: u32) -> PathBuf {
        self.image(&self.layout.psf_star, set, image)
    }

    // A FITS image, which may be compressed, by the pattern of its name.
    fn image(&self, pattern: &str, set: u32, image: u32) -> PathBuf {
        let plain = self.root.join(fill(pattern, set, image));
        endings(pattern)
            .iter()
            .map(|ending| {
                let mut path = plain.clone().into_os_string();
                path.push(ending);
                PathBuf::from(path)
            })
            .find(|path| is_there(path))
            .unwrap_or(plain)
    }

    pub fn psf_functional(&self, set: u32, image: u32) -> PathBuf {
        self.root
            .join(fill(&self.layout.psf_functional, set, image))
    }

    /// The table of an image's stamps.
    pub fn stamps(&self, set: u32, image: u32) -> PathBuf {
        match self.layout.great3 {
            Some(_) => great3::galaxy_catalogue(&self.root, set),
            None => self.root.join(fill(STAMPS, set, image)),
        }
    }

    pub fn truth(&self, set: u32) -> PathBuf {
        self.root.join(fill(&self.layout.truth, set, 0))
    }

    pub fn intrinsic(&self, set: u32, image: u32) -> PathBuf {
        self.root.join(fill(&self.layout.intrinsic, set, image))
    }

    /// The galaxy images of `sets` (of all if empty) that are there.
    pub fn images(&self, sets: &[u32]) -> Result<Files, FileError> {
        let pattern = &self.layout.galaxies;
        files::find(&self.root, pattern, endings(pattern), sets)
    }

    /// The data folder, if this is the folder of one of its sets.
    pub fn folder_above(&self) -> Option<PathBuf> {
        let (first, rest) = self.layout.galaxies.split_once('/')?;
        let root = self.root.canonicalize().ok()?;
        let above = self
            .root
            .parent()
            .filter(|path| !path.as_os_str().is_empty());
        let here = files::find(root.parent()?, first, &[""], &[]).ok()?;
        // Any folder with digits in its name may be a set; images of the layout in it decide.
        let is_set = here
            .sets()
            .into_iter()
            .any(|set| root.ends_with(fill(first, set, 0)));
        let images = files::find(&root, rest, endings(rest), &[]).ok()?;
        (is_set && !images.is_empty()).then(|| above.map_or_else(|| "..".into(), Path::to_owned))
    }

    /// Sets that have a file of true shear. If one file serves all sets, these are the sets that have images.
    pub fn sets_with_truth(&self) -> Result<Vec<u32>, FileError> {
        let mut pattern = self.layout.truth.clone();
        for form in IMAGE_PLACEHOLDERS {
            pattern = pattern.replace(form, &fill(form, 0, 0));
        }
        let truths = files::find(&self.root, &pattern, &[""], &[])?;
        // The pattern has no {set}: one file may be the truth of a million sets.
        if truths.serve_all_sets() {
            return Ok(self.images(&[])?.sets());
        }
        Ok(truths.sets())
    }
}
