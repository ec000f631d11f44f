//! Fingerprints of contents, to determine whether two results were made from the same data.
//!
//! A small file is read completely. A large image is sampled: its length, its beginning, and blocks spread evenly over the
//! rest. This detects another image, noise or scale, and any changed region above a 64th of the file. It does not detect
//! a change between the blocks, such as of a few stamps.
//!
//! The fingerprints of its image, PSF and true shear are stored with a catalogue, and compared when it is used.

use std::collections::BTreeMap;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::great3;
use crate::images::{self, ImageId};
use crate::layout::{DataFolder, LAYOUT_FILE, Layout};
use crate::run::{Run, Source};
use crate::threads::Pool;
use shearq_files::FileError;
use shearq_files::open::{self, is_there};
use shearq_files::table::read_metadata;
use shearq_submissions::PsfForm;

// Longer files are sampled, because reading all images again would delay each resumption. Chosen by hand.
const MAX_WHOLE_BYTES: u64 = 1 << 20;
// Bytes at the beginning of a longer file: its headers.
const HEAD_BYTES: u64 = 16 * 1024;
// Sampled blocks of the rest.
const BLOCKS: u64 = 64;
// Bytes of a block: what a system reads at once.
const BLOCK_BYTES: u64 = 4096;

/// A SHA-256 of several parts.
// With their lengths, so that `ab`, `c` differs from `a`, `bc`.
#[derive(Debug, Default)]
pub struct Fingerprint(Sha256);

impl Fingerprint {
    pub fn add(&mut self, part: impl AsRef<[u8]>) {
        let part = part.as_ref();
        self.0.update((part.len() as u64).to_le_bytes());
        self.0.update(part);
    }

    /// The first 64 bits in hexadecimal. For a million contents, the probability that any two collide is 3·10⁻⁸.
    pub fn finish(self) -> String {
        let digest = self.0.finalize();
        hex(&digest[..8])
    }
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub fn of_bytes(bytes: &[u8]) -> String {
    let mut print = Fingerprint::default();
    print.add(bytes);
    print.finish()
}

pub fn of_file(path: &Path) -> Result<String, FileError> {
    Ok(of_bytes(&read(path)?))
}

/// Fingerprint of an image or its PSF: a sample if the file is large.
pub fn of_image(path: &Path) -> Result<String, FileError> {
    sample(path).map_err(FileError::doing(path, "cannot open the file"))
}

fn sample(path: &Path) -> std::io::Result<String> {
    let mut file = open::open(path)?;
    let length = file.metadata()?.len();
    let mut print = Fingerprint::default();
    print.add(length.to_le_bytes());
    let mut part = Vec::new();
    let mut add = |file: &mut std::fs::File, bytes: u64| {
        part.clear();
        file.take(bytes).read_to_end(&mut part)?;
        print.add(&part);
        std::io::Result::Ok(())
    };
    if length <= MAX_WHOLE_BYTES {
        add(&mut file, MAX_WHOLE_BYTES)?;
        return Ok(print.finish());
    }
    add(&mut file, HEAD_BYTES)?;
    // The last block ends with the file, so that a truncated or extended file differs.
    let room = length - HEAD_BYTES - BLOCK_BYTES;
    for block in 1..=BLOCKS {
        let start = HEAD_BYTES + (u128::from(room) * u128::from(block) / u128::from(BLOCKS)) as u64;
        file.seek(SeekFrom::Start(start))?;
        add(&mut file, BLOCK_BYTES)?;
    }
    Ok(print.finish())
}

/// Fingerprint of one set: its true shear, the settings of its simulation, and the existing files of `images`.
pub fn of_set(
    source: &Source,
    data: &DataFolder,
    set: u32,
    images: &[u32],
) -> Result<String, FileError> {
    let mut print = Fingerprint::default();
    if let Source::Simulated(_) = source {
        print.add(of_source(source, data)?);
    }
    print.add(read(&data.truth(set))?);
    for &image in images {
        let path = data.galaxies(set, image);
        if is_there(&path) {
            print.add(image.to_le_bytes());
            print.add(of_image(&path)?);
        }
    }
    Ok(print.finish())
}

/// Fingerprint of all data of a source: the settings of a simulation, or the true shear of every set of a folder.
pub fn of_source(source: &Source, data: &DataFolder) -> Result<String, FileError> {
    let mut print = Fingerprint::default();
    match source {
        Source::Simulated(settings) => {
            let text = serde_json::to_vec(settings)
                .map_err(FileError::doing(data.root(), "cannot store the settings"))?;
            print.add(text);
        }
        Source::Folder { .. } => {
            for set in data.sets_with_truth()? {
                print.add(set.to_le_bytes());
                print.add(read(&data.truth(set))?);
            }
        }
    }
    Ok(print.finish())
}

fn read(path: &Path) -> Result<Vec<u8>, FileError> {
    open::read(path, open::DATA).map_err(FileError::doing(path, "cannot read the file"))
}

pub const GALAXIES: &str = "galaxies";
pub const PSF: &str = "psf";
const TRUTH: &str = "truth";
// The table of gathered stamps, which has their noise and their pixels on the sky.
const STAMPS: &str = "stamps";
// The shift of an epoch of GREAT3, which decides where its galaxies are.
const DITHER: &str = "dither";
pub const PRINTS: [&str; 5] = [GALAXIES, PSF, STAMPS, TRUTH, DITHER];

/// The files that a run measures, if they are there. A simulated run has none.
#[derive(Debug)]
pub struct Inputs<'a> {
    run: &'a Run,
    data: &'a DataFolder,
    truths: BTreeMap<u32, String>,
}

impl<'a> Inputs<'a> {
    pub fn new(run: &'a Run, data: &'a DataFolder, images: &[ImageId]) -> Result<Self, FileError> {
        let mut truths = BTreeMap::new();
        // Read once per set, not per image: the truth of a set has a row for each galaxy of an image.
        if let Source::Folder { .. } = run.source {
            for of_set in images.chunk_by(|a, b| a.set == b.set) {
                let path = data.truth(of_set[0].set);
                if is_there(&path) {
                    truths.insert(of_set[0].set, of_file(&path)?);
                }
            }
        }
        Ok(Inputs { run, data, truths })
    }

    fn files(&self, id: ImageId) -> BTreeMap<&'static str, PathBuf> {
        let psf = match self.run.configuration.psf.form {
            PsfForm::Star => self.data.psf_star(id.set, id.image),
            PsfForm::Functional => self.data.psf_functional(id.set, id.image),
        };
        BTreeMap::from([
            (GALAXIES, self.data.galaxies(id.set, id.image)),
            (PSF, psf),
            (STAMPS, self.data.stamps(id.set, id.image)),
            (TRUTH, self.data.truth(id.set)),
            (
                DITHER,
                great3::dither_file(self.data.root(), id.set, id.image),
            ),
        ])
    }

    pub fn prints(&self, id: ImageId) -> Result<BTreeMap<String, String>, FileError> {
        let mut prints = BTreeMap::new();
        if let Source::Simulated(_) = self.run.source {
            return Ok(prints);
        }
        let epochs = self.run.epochs_of(self.data, id)?;
        for (key, path) in self.files(id) {
            let print = match key {
                TRUTH => self.truths.get(&id.set).cloned(),
                _ if epochs.len() > 1 => Some(self.print_of_all(key, &epochs)?),
                // A single epoch is measured where its galaxies are.
                DITHER => None,
                _ if is_there(&path) => Some(of_image(&path)?),
                _ => None,
            };
            prints.extend(print.map(|print| (key.to_owned(), print)));
        }
        Ok(prints)
    }

    fn print_of_all(&self, key: &str, epochs: &[ImageId]) -> Result<String, FileError> {
        let mut print = Fingerprint::default();
        for &id in epochs {
            if let Some(path) = self.files(id).get(key).filter(|path| is_there(path)) {
                print.add(id.image.to_le_bytes());
                print.add(of_image(path)?);
            }
        }
        Ok(print.finish())
    }

    /// Checks that the catalogues of `images` in `out` were measured from the present files.
    pub fn verify(&self, out: &Path, images: &[ImageId], pool: &Pool) -> Result<(), FileError> {
        let mut found = pool.in_order(images, |id| self.verify_image(out, *id));
        found.try_for_each(|checked| checked)
    }

    fn verify_image(&self, out: &Path, id: ImageId) -> Result<(), FileError> {
        let catalogue = self.run.catalogue(out, id.set, id.image);
        let now = self.prints(id)?;
        // Simulated in memory: the settings in the record identify the data.
        if now.is_empty() {
            return Ok(());
        }
        let kept = read_metadata(&catalogue, self.run.format, now.keys())?;
        let mut files = self.files(id);
        // In this order: without an epoch all of them differ, and the image explains most.
        for key in PRINTS {
            if let (Some(now), Some(kept), Some(path)) =
                (now.get(key), kept.get(key), files.remove(key))
                && now != kept
            {
                let (path, what) = match self.run.epochs && key != TRUTH {
                    true => self.changed(key, id, &catalogue)?,
                    false => (path, "the file"),
                };
                let message = format!(
                    "{what} has changed since {} was measured (found the fingerprint {now}, expected {kept})",
                    catalogue.display()
                );
                return Err(FileError::new(path, message).hint("measure again into another folder"));
            }
        }
        Ok(())
    }

    /// The file that made the fingerprint of all epochs another one. The catalogue has one for all, because the header of a FITS file
    /// has no room for one of each.
    fn changed(
        &self,
        key: &str,
        id: ImageId,
        catalogue: &Path,
    ) -> Result<(PathBuf, &'static str), FileError> {
        images::check_epochs(self.data, &[id.set])?;
        let written = |path: &Path| path.metadata().and_then(|about| about.modified()).ok();
        let epochs = self.run.epochs_of(self.data, id)?.into_iter();
        let paths: Vec<PathBuf> = epochs.filter_map(|id| self.files(id).remove(key)).collect();
        let mut newer = paths
            .iter()
            .filter(|path| written(path) > written(catalogue));
        Ok(match (newer.next(), newer.next(), paths.first()) {
            (Some(path), None, _) => (path.clone(), "the file"),
            (_, _, Some(path)) => (path.clone(), "the file, or that of another epoch,"),
            (_, _, None) => (catalogue.to_owned(), "a file of an epoch"),
        })
    }
}

/// Checks that every catalogue of `sets` (of all if empty) in the results folder `out` was measured from the present files
/// in `data`.
pub fn verify(
    data: &DataFolder,
    out: &Path,
    run: &Run,
    sets: &[u32],
    pool: &Pool,
) -> Result<(), FileError> {
    if let Source::Folder { layout, .. } = &run.source {
        // They are in no file of an image, but change the scale of ℓ and the sign of the true g2.
        let of = |layout: &Layout| (layout.field_degrees, layout.truth_sign);
        let (then, now) = (of(layout), of(data.layout()));
        if then != now {
            let message = format!(
                "field in degrees and sign of the truth are {now:?}; {} was measured with {then:?}",
                out.display()
            );
            return Err(FileError::new(data.root().join(LAYOUT_FILE), message));
        }
    }
    let files = run.catalogues(out, sets)?;
    let of_set = |set| {
        let images = files.of_set(set).into_iter();
        images.map(move |(image, _)| ImageId { set, image })
    };
    let images: Vec<ImageId> = files.sets().into_iter().flat_map(of_set).collect();
    Inputs::new(run, data, &images)?.verify(out, &images, pool)
}

/// As [`verify`], with the data folder that the record names, which is returned. Catalogues are read without data, so that data
/// that were removed meanwhile are no error, but data that changed are.
pub fn verify_source(
    out: &Path,
    run: &Run,
    sets: &[u32],
    threads: usize,
) -> Result<Option<DataFolder>, FileError> {
    let data = match &run.source {
        Source::Folder { .. } => run.source.data(out).ok(),
        Source::Simulated(_) => None,
    };
    if let Some(data) = &data {
        let pool = Pool::new(threads).map_err(|error| FileError::new(out, error))?;
        verify(data, out, run, sets, &pool)?;
    }
    Ok(data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_distinguishes_large_images() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("galaxies-001.fits");
        let print = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            of_image(&path).unwrap()
        };
        let small: Vec<u8> = (0..5000u32).map(|k| (k % 251) as u8).collect();
        let mut other = small.clone();
        other[4321] ^= 1;
        assert_eq!(print(&small), print(&small));
        assert_ne!(print(&small), print(&other));
        let large: Vec<u8> = small.iter().copied().cycle().take(3 << 20).collect();
        let whole = print(&large);
        assert_eq!(whole, print(&large));
        // The headers, the end, the length and any stretch longer than the way between blocks.
        let between = large.len() / BLOCKS as usize;
        for at in [100, 1 << 20, large.len() - between] {
            let mut other = large.clone();
            other[at..at + between]
                .iter_mut()
                .for_each(|byte| *byte ^= 1);
            assert_ne!(print(&other), whole, "{at}");
        }
        assert_ne!(print(&large[..large.len() - 1]), whole);
        let mut between_blocks = large.clone();
        between_blocks[(HEAD_BYTES + BLOCK_BYTES) as usize] ^= 1;
        assert_eq!(print(&between_blocks), whole);
    }
}
