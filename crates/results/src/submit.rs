//! Submissions to a challenge: the two kinds of files that it accepts, their manifest, and archives of them.
//!
//! * Catalogue: ASCII `x y e1 e2`, one line per galaxy, one file per image, `g10_v1_objs_{set}_{image}.{method}.dat`.
//! * Power spectrum: ASCII `index l power`, the eight bins 2 to 9, one file per set, `{method}_set{set}.dat`; power is
//!   ℓ²C_ℓ/2π.
//!
//! [`pack`] writes submissions and [`check`] looks for their faults.

pub mod archive;
pub mod check;
mod manifest;
pub mod pack;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_dataset::layout::{DataFolder, MAX_IMAGE, MAX_SET, check_folder};
use shearq_dataset::run::{Run, relative_path};
use shearq_files::atomic::{Scratch, list};
use shearq_files::open::is_there;
use shearq_files::{FileError, table};
use shearq_scoring::{Bins, Definition, Grid, SCORED};

use archive::{is_archive, read_archive};
pub use manifest::{Contents, Entry, FileSum, MANIFEST_FILE, Manifest};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpectrumLine {
    pub index: u32,
    pub l: f64,
    pub power: f64,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    Catalogue {
        set: u32,
        image: u32,
        method: String,
    },
    Spectrum {
        set: u32,
        method: String,
    },
}

impl Kind {
    pub const EXPECTED: &str =
        "neither g10_v1_objs_{set}_{image}.{method}.dat nor {method}_set{set}.dat";

    pub fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?.strip_suffix(".dat")?;
        if let Some(rest) = name.strip_prefix("g10_v1_objs_") {
            let (numbers, method) = rest.split_once('.')?;
            let (set, image) = numbers.split_once('_')?;
            return Some(Kind::Catalogue {
                set: number(set, MAX_SET)?,
                image: number(image, MAX_IMAGE)?,
                method: method.to_owned(),
            });
        }
        let (method, set) = name.rsplit_once("_set")?;
        Some(Kind::Spectrum {
            set: number(set, MAX_SET)?,
            method: method.to_owned(),
        })
    }

    pub fn file_name(&self) -> String {
        match self {
            Kind::Catalogue { set, image, method } => {
                format!("g10_v1_objs_{set}_{image}.{method}.dat")
            }
            Kind::Spectrum { set, method } => format!("{method}_set{set}.dat"),
        }
    }
}

fn number(text: &str, most: u32) -> Option<u32> {
    // A leading zero would give one image two names.
    if (text.starts_with('0') && text != "0") || !text.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    text.parse().ok().filter(|number| *number <= most)
}

/// Reads a power-spectrum file without checking it; [`check`] checks it.
pub fn read_spectrum(path: &Path) -> Result<Vec<SpectrumLine>, FileError> {
    let table = table::read_text(path, &["index", "l", "power"])?;
    let column = |name: &str| table::numbers(&table, name, path);
    let (index, l, power) = (column("index")?, column("l")?, column("power")?);
    if let Some(odd) = index
        .iter()
        .find(|i| i.fract() != 0.0 || !(0.0..=99.0).contains(*i))
    {
        return Err(FileError::new(
            path,
            format!("not the number of a bin (found {odd}, expected 2 to 9)"),
        ));
    }
    Ok((0..index.len())
        .map(|k| SpectrumLine {
            index: index[k] as u32,
            l: l[k],
            power: power[k],
        })
        .collect())
}

/// The first line whose multipole differs from its bin's, the bin's multipole, and the number of such lines.
pub fn wrong_multipoles<'a>(
    lines: &'a [SpectrumLine],
    bins: &Bins,
) -> Option<(&'a SpectrumLine, f64, usize)> {
    let centre = |line: &SpectrumLine| bins.l.get((line.index as usize).wrapping_sub(1)).copied();
    let off = |line: &'a SpectrumLine| {
        let centre = centre(line).filter(|l| !(line.l - l).abs().le(&(0.5 * bins.width)))?;
        Some((line, centre))
    };
    let mut wrong = lines.iter().filter_map(off);
    let (line, centre) = wrong.next()?;
    Some((line, centre, 1 + wrong.count()))
}

/// The eight bandpowers of a power-spectrum file for galaxies on `grid`, in order.
pub fn read_bandpowers(path: &Path, grid: &Grid) -> Result<Vec<f64>, FileError> {
    let lines = read_spectrum(path)?;
    let bins = Bins::new(grid, Definition::Leaderboard);
    if let Some((SpectrumLine { index, l, .. }, centre, _)) = wrong_multipoles(&lines, &bins) {
        let message = format!(
            "bin {index} has l = {l}; expected {centre:.1}, as the true shear has {n} × {n} cells",
            n = grid.n
        );
        return Err(FileError::new(path, message));
    }
    let found: Vec<u32> = lines.iter().map(|line| line.index).collect();
    let expected: Vec<u32> = SCORED.map(|b| b as u32 + 1).collect();
    if found != expected {
        return Err(FileError::new(
            path,
            format!("the bins are {found:?}; expected {expected:?}"),
        ));
    }
    if let Some(bad) = lines.iter().find(|line| !line.power.is_finite()) {
        return Err(FileError::new(
            path,
            format!("the power of bin {} is not a finite number", bad.index),
        ));
    }
    Ok(lines.iter().map(|line| line.power).collect())
}

/// A given folder or file, or the temporary folder of an unpacked archive.
#[derive(Debug)]
pub struct Sent {
    path: PathBuf,
    given: PathBuf,
    _unpacked: Option<Scratch>,
}

impl Sent {
    /// Opens a submission, and unpacks it if it has the name of an archive.
    pub fn open(given: &Path) -> Result<Self, FileError> {
        match is_archive(given) && !given.is_dir() {
            true => Sent::unpacked(given, None),
            false => Ok(Sent::in_place(given)),
        }
    }

    /// A folder or a file that is read where it is.
    pub fn in_place(given: &Path) -> Self {
        Sent {
            path: given.to_owned(),
            given: given.to_owned(),
            _unpacked: None,
        }
    }

    /// Unpacks an archive of any name, to `most` bytes ([`read_archive`]).
    pub fn unpacked(given: &Path, most: Option<u64>) -> Result<Self, FileError> {
        let folder = Scratch::new()?;
        read_archive(given, Some(folder.path()), most)?;
        Ok(Sent {
            path: folder.path().to_owned(),
            given: given.to_owned(),
            _unpacked: Some(folder),
        })
    }

    /// The folder or file with the content.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The name of a file for messages: a member of the archive, not of the temporary folder.
    pub fn as_given(&self, path: &Path) -> PathBuf {
        match path.strip_prefix(&self.path) {
            Ok(name) if name.as_os_str().is_empty() => self.given.clone(),
            Ok(name) => self.given.join(name),
            Err(_) => path.to_owned(),
        }
    }

    pub fn named(&self, error: FileError) -> FileError {
        let given = self.as_given(&error.path);
        error.about(given)
    }

    /// The files without the manifest and hidden files, or the given file.
    pub fn files(&self) -> Result<Vec<PathBuf>, FileError> {
        if !self.path.is_dir() {
            std::fs::metadata(&self.path)
                .map_err(FileError::doing(&self.given, "cannot read the file"))?;
            return Ok(vec![self.path.clone()]);
        }
        let mut files = list(&self.path).map_err(|error| self.named(error))?;
        files.retain(|file| {
            let own = file.file_name().is_some_and(|name| {
                name == MANIFEST_FILE || name.to_string_lossy().starts_with('.')
            });
            !file.is_dir() && !own
        });
        Ok(files)
    }
}

#[derive(Debug, Clone)]
pub enum Packed {
    /// Catalogues by set and image.
    Catalogues(BTreeMap<u32, BTreeMap<u32, PathBuf>>),
    /// A power spectrum per set.
    Spectra(BTreeMap<u32, PathBuf>),
}

#[derive(Debug, Clone)]
pub struct Submission {
    pub method: String,
    pub packed: Packed,
    pub manifest: Option<Manifest>,
}

impl Submission {
    /// What distinguishes methods of one name: the configuration as TOML, or the path from the data to the submission.
    pub fn settings(&self, path: &Path, data: &DataFolder) -> Result<String, FileError> {
        let run = self.manifest.as_ref().and_then(|own| own.run.as_ref());
        match run {
            Some(run) => settings_of(run, path),
            None => Ok(relative_path(data.root(), path)?.display().to_string()),
        }
    }

    pub fn read(sent: &Sent) -> Result<Self, FileError> {
        let whole = |message: String| FileError::new(&sent.given, message);
        check_folder(&sent.path, "a folder or an archive (.tar.gz)")?;
        let files = sent.files()?;
        let manifest = Manifest::read(&sent.path)?;
        if let Some(manifest) = &manifest {
            let sums = FileSum::of_files(&sent.path, &files)?;
            manifest.verify(&sums.into_iter().collect(), &sent.given)?;
        }
        let mut catalogues = BTreeMap::<u32, BTreeMap<u32, PathBuf>>::new();
        let mut spectra = BTreeMap::new();
        let mut methods = Vec::new();
        for file in files {
            let kind = Kind::of(&file).ok_or_else(|| {
                FileError::new(
                    sent.as_given(&file),
                    format!("the name is {}", Kind::EXPECTED),
                )
            })?;
            match kind {
                Kind::Catalogue { set, image, method } => {
                    catalogues.entry(set).or_default().insert(image, file);
                    methods.push(method);
                }
                Kind::Spectrum { set, method } => {
                    spectra.insert(set, file);
                    methods.push(method);
                }
            }
        }
        // Files of two methods would be scored as one.
        methods.sort();
        methods.dedup();
        let [method] = methods.as_slice() else {
            return Err(whole(match methods.len() {
                0 => "the submission contains no files".into(),
                _ => format!(
                    "the files belong to several methods: {}",
                    methods.join(", ")
                ),
            }));
        };
        let packed = match (catalogues.is_empty(), spectra.is_empty()) {
            (false, true) => Packed::Catalogues(catalogues),
            (true, false) => Packed::Spectra(spectra),
            _ => {
                return Err(whole(
                    "the submission contains catalogues and spectra; expected one kind".into(),
                ));
            }
        };
        Ok(Submission {
            method: method.clone(),
            packed,
            manifest,
        })
    }
}

pub fn settings_of(run: &Run, path: &Path) -> Result<String, FileError> {
    toml::to_string(&run.configuration)
        .map_err(FileError::doing(path, "cannot write the settings as TOML"))
}

/// Whether a path is an archive, or a folder that `pack` wrote.
pub fn is_packed(path: &Path) -> bool {
    // Below a file, the system's answer is an error other than "not found", which counts as there.
    is_archive(path) || (path.is_dir() && is_there(&path.join(MANIFEST_FILE)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_recognised_and_made() {
        for name in [
            "g10_v1_objs_7_12.NN23.dat",
            "g10_v1_objs_100_1000.NN23.dat",
            "NN_23_set24.dat",
        ] {
            let kind = Kind::of(Path::new(name)).unwrap();
            assert_eq!(kind.file_name(), name);
        }
        for wrong in [
            "g10_v1_objs_7.NN.dat",
            "NN_set1.txt",
            "NN_set01.dat",
            "NN_set10000.dat",
            "g10_v1_objs_1_1000000.NN.dat",
            "set.dat",
            "x",
        ] {
            assert_eq!(Kind::of(Path::new(wrong)), None, "{wrong}");
        }
    }

    // Reads a folder of empty files.
    fn read(names: &[&str]) -> Result<Submission, FileError> {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        Submission::read(&Sent::open(folder.path())?)
    }

    #[test]
    fn files_are_sorted_by_kind_set_and_image() {
        let names = ["g10_v1_objs_2_10.M.dat", "g10_v1_objs_2_9.M.dat", ".hidden"];
        let submission = read(&names).unwrap();
        let Packed::Catalogues(sets) = submission.packed else {
            panic!("catalogues are no spectra");
        };
        let images: Vec<u32> = sets[&2].keys().copied().collect();
        assert_eq!((submission.method.as_str(), images), ("M", vec![9, 10]));
        let spectra = read(&["M_set1.dat", "M_set2.dat"]).unwrap();
        assert!(matches!(spectra.packed, Packed::Spectra(files) if files.len() == 2));
    }

    #[test]
    fn a_submission_has_one_method_and_one_kind() {
        let one = "g10_v1_objs_2_1.M.dat";
        for (names, expected) in [
            (&[][..], "contains no files"),
            (&[one, "g10_v1_objs_2_2.N.dat"], "several methods: M, N"),
            (&[one, "M_set2.dat"], "catalogues and spectra"),
            (&[one, "notes.txt"], "the name is neither"),
        ] {
            let message = read(names).unwrap_err().to_string();
            assert!(message.contains(expected), "{names:?}: {message}");
        }
    }
}
