//! Writes catalogues as a submission to a challenge, with a manifest.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use flate2::write::GzEncoder;
use flate2::{Compression, GzBuilder};
use shearq_quantities::units::Degrees;
use shearq_scoring::{
    Convention, ConventionMatch, FieldSum, Grid, Options, Row, SCORED, ScoringError, SetImages,
    SetSession, SpectrumCovariance, cross_spectrum, measured_bandpowers,
};

use super::archive::{MAX_FILES, is_tar_gz};
use super::{Contents, Entry, FileSum, Kind, MANIFEST_FILE, Manifest};
use crate::catalogues::{Catalogues, OWN};
use shearq_catalogue::foreign::Foreign;
use shearq_catalogue::galaxies::{Calibration, Galaxy};
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::record_text;
use shearq_dataset::threads::Progress;
use shearq_dataset::{grid, truth};
use shearq_files::FileError;
use shearq_files::atomic::{PartFile, PartFolder};
use shearq_files::open::is_there;
use shearq_files::table::{MAX_ROWS, most_rows};
use tar::{Builder, Header};

#[derive(Debug, Clone)]
pub struct Packing<'a> {
    pub catalogues: &'a Catalogues,
    /// The data that another program's catalogues were measured from, for the grid of spectra.
    pub data: Option<&'a DataFolder>,
    /// Name of the method in file names.
    pub method: String,
    pub contents: Contents,
    pub entry: Option<Entry>,
}

impl Packing<'_> {
    /// Number of galaxies to pack, estimated from the first catalogue for progress bars.
    pub fn galaxies(&self) -> Result<u64, FileError> {
        let own = self.catalogues;
        let place = || {
            own.description
                .as_ref()
                .map_or(own.path.clone(), Foreign::pattern)
        };
        if own.files.serve_all_sets() {
            let message = "the pattern of the catalogues contains no {set}, which the names of packed files need";
            return Err(FileError::new(place(), message));
        }
        let mut all = own
            .files
            .sets()
            .into_iter()
            .flat_map(|set| own.files.of_set(set));
        let Some((_, first)) = all.next() else {
            return Err(FileError::new(place(), "found no catalogue to pack"));
        };
        let rows = own.rows(&first, MAX_ROWS)?.len();
        Ok(((1 + all.count()) * rows) as u64)
    }

    // With the true shear, for another program's catalogues if it is known.
    fn session(&self, set: u32, grid: Grid) -> Result<SetSession, FileError> {
        let data = self.data.filter(|data| is_there(&data.truth(set)));
        let truth = data.map(|data| data.read_truth(set, &grid)).transpose()?;
        let options = Options {
            choice: OWN,
            ..Options::default()
        };
        SetSession::new(grid, truth, options)
            .map_err(|error| FileError::new(&self.catalogues.path, error))
    }

    fn grid(&self, set: u32, catalogue: &Path) -> Result<Grid, FileError> {
        match (&self.catalogues.run, self.data) {
            (Some(run), _) => {
                let field = Degrees(run.source.layout().field_degrees);
                let rows = self.catalogues.rows(catalogue, MAX_ROWS)?;
                let rows: Vec<Row> = rows.into_iter().map(|own| own.0).collect();
                grid::of_catalogue(catalogue, &rows, field)
            }
            (None, Some(data)) => truth::grid_of_set(data, set),
            (None, None) => {
                let message = "cannot determine the grid of the spectra";
                Err(FileError::new(catalogue, message).hint("--data DIR"))
            }
        }
    }

    /// Writes the files and their manifest to `out`: an archive, by its ending, or a new folder. After an error nothing
    /// remains. The same catalogues give the same bytes. Returns the number of files without the manifest.
    pub fn write(&self, out: &Path, progress: &mut dyn Progress) -> Result<usize, FileError> {
        let found = self.catalogues;
        let per_set = |set| match self.contents {
            Contents::Catalogues => found.files.of_set(set).len(),
            Contents::Spectra | Contents::CrossSpectra => 1,
        };
        // Checked first, because catalogues of a whole challenge take minutes to pack.
        check_number(found.files.sets().into_iter().map(per_set).sum(), out)?;
        let mut destination = Destination::create(out)?;
        let mut files = BTreeMap::new();
        let mut covariances = BTreeMap::new();
        let mut matching = ConventionMatch::default();
        let mut add = |kind: Kind, text: String| -> Result<(), FileError> {
            let (name, mut bytes) = (kind.file_name(), text.as_bytes());
            destination.add(&name, bytes)?;
            let sum = FileSum::copying(&mut bytes, &mut std::io::sink())
                .map_err(FileError::doing(out, "cannot add up"))?;
            files.insert(name, sum);
            Ok(())
        };
        for set in found.files.sets() {
            let catalogues = found.files.of_set(set);
            let method = self.method.clone();
            if self.contents.is_spectra() {
                let kind = Kind::Spectrum { set, method };
                let (text, covariance) =
                    self.spectrum(set, &catalogues, &mut matching, progress)?;
                if let Some(covariance) = covariance {
                    covariances.insert(kind.file_name(), covariance);
                }
                add(kind, text)?;
                continue;
            }
            let calibration = found.calibration(set)?;
            for (image, path) in catalogues {
                let method = method.clone();
                let rows = self.catalogues.rows(&path, MAX_ROWS)?;
                add(
                    Kind::Catalogue { set, image, method },
                    catalogue_text(&rows, &calibration),
                )?;
                progress.advance(rows.len() as u64);
            }
        }
        // A spectrum does not contain the convention, so that a wrong one could not be found by the organiser.
        if let (true, Some(foreign)) = (matching.is_clear(), &found.description)
            && matching.convention() != Convention::STANDARD
        {
            let wrong = matching.convention();
            let message = format!(
                "the catalogues are in convention {} ({}), judged by the true shear; spectra need convention 5",
                wrong.number(),
                wrong.describe()
            );
            return Err(FileError::new(foreign.pattern(), message)
                .hint("exchange `x` and `y`, or set `e2_sign`, in the description"));
        }
        let count = files.len();
        let manifest = Manifest {
            version: shearq_dataset::VERSION.into(),
            method: self.method.clone(),
            contents: self.contents,
            entry: self.entry.clone(),
            run: found.run.clone(),
            foreign: found.description.clone(),
            files,
            covariances,
        };
        destination.add(MANIFEST_FILE, record_text(out, &manifest)?.as_bytes())?;
        destination.finish()?;
        Ok(count)
    }

    fn spectrum(
        &self,
        set: u32,
        catalogues: &[(u32, PathBuf)],
        matching: &mut ConventionMatch,
        progress: &mut dyn Progress,
    ) -> Result<(String, Option<SpectrumCovariance>), FileError> {
        let first = &catalogues[0].1;
        let grid = self.grid(set, first)?;
        let session = self.session(set, grid)?;
        let mut images = session.begin();
        let calibration = self.catalogues.calibration(set)?;
        for (_, path) in catalogues {
            let mut sum = FieldSum::new(&grid);
            let rows = self.catalogues.rows(path, most_rows(grid.cells()))?;
            progress.advance(rows.len() as u64);
            let counts = sum.add_weighted(&grid, rows);
            calibration.apply(&mut sum);
            session
                .examine(sum, counts)
                .and_then(|image| images.add(&image))
                .map_err(|error| FileError::new(path, error))?;
        }
        if images.rows().used == 0 {
            let message = "no catalogue of the set has an ellipticity on the grid";
            return Err(FileError::new(first, message));
        }
        let wrong = |error| FileError::new(first, error);
        if session.scorer().is_some() {
            matching.merge(&images.match_convention().map_err(wrong)?);
        }
        spectrum_text(&grid, images.images(), self.contents).map_err(wrong)
    }
}

// Refuses more files than `check` and `unpack` read. The manifest is one more file.
fn check_number(files: usize, out: &Path) -> Result<(), FileError> {
    if (files as u64) < MAX_FILES {
        return Ok(());
    }
    let most = MAX_FILES - 1;
    let message = format!("too many files to pack (found {files}, expected at most {most})");
    Err(FileError::new(out, message))
}

// The measured galaxies of a catalogue in the challenge's format, which has no weights: they multiply the shears, so that means over
// galaxies are the weighted ones. Galaxies without an ellipticity are left out; the original scoring counts them as zero.
fn catalogue_text(rows: &[Galaxy], calibration: &Calibration) -> String {
    let mut text = String::new();
    for (Row { x, y, e1, e2 }, weight) in rows {
        let weight = weight / calibration.weight;
        let [e1, e2] = calibration.shear([*e1, *e2]).map(|e| weight * e);
        if e1.is_finite() && e2.is_finite() {
            text.push_str(&format!("{x} {y} {e1:.9} {e2:.9}\n"));
        }
    }
    text
}

// The power spectrum of a set in the challenge's format, and the covariance of its bandpowers, if known.
fn spectrum_text(
    grid: &Grid,
    images: &SetImages,
    contents: Contents,
) -> Result<(String, Option<SpectrumCovariance>), ScoringError> {
    let standard = Convention::STANDARD;
    let (bins, power, covariance) = match contents {
        Contents::CrossSpectra => cross_spectrum(grid, images, standard)
            .map(|cross| (cross.bins, cross.power, cross.covariance))?,
        _ => measured_bandpowers(grid, images.total(), standard)
            .map(|(bins, power)| (bins, power, None))?,
    };
    let text = SCORED
        .map(|b| format!("{} {:.6} {:.12e}\n", b + 1, bins.l[b], power[b]))
        .collect();
    let first = SCORED.start;
    let scored = covariance
        .map(|all| std::array::from_fn(|i| std::array::from_fn(|j| all[first + i][first + j])));
    Ok((text, scored))
}

enum Destination {
    Folder(PartFolder),
    Archive(Box<ArchiveWriter>),
}

impl Destination {
    fn create(out: &Path) -> Result<Self, FileError> {
        if is_tar_gz(out) {
            let archive = Box::new(ArchiveWriter::create(out)?);
            return Ok(Destination::Archive(archive));
        }
        PartFolder::new(out).map(Destination::Folder)
    }

    fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), FileError> {
        match self {
            Destination::Archive(archive) => archive.add(name, bytes),
            Destination::Folder(folder) => {
                let path = folder.path().join(name);
                std::fs::write(&path, bytes)
                    .map_err(FileError::doing(&path, "cannot write the file"))
            }
        }
    }

    fn finish(self) -> Result<(), FileError> {
        match self {
            Destination::Archive(archive) => archive.finish(),
            Destination::Folder(folder) => folder.finish(),
        }
    }
}

// Packs files so that equal files give equal bytes.
struct ArchiveWriter {
    builder: Builder<GzEncoder<BufWriter<File>>>,
    part: PartFile,
}

impl ArchiveWriter {
    fn create(path: &Path) -> Result<Self, FileError> {
        if is_there(path) {
            return Err(exists(path));
        }
        let (part, file) = PartFile::create(path)?;
        // Time and system would change the bytes.
        let encoder = GzBuilder::new()
            .mtime(0)
            .operating_system(UNKNOWN_SYSTEM)
            .write(BufWriter::new(file), Compression::default());
        Ok(ArchiveWriter {
            builder: Builder::new(encoder),
            part,
        })
    }

    fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), FileError> {
        let mut header = Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_mtime(0);
        header.set_uid(0);
        header.set_gid(0);
        self.builder
            .append_data(&mut header, name, bytes)
            .map_err(cannot_write(self.part.target()))
    }

    fn finish(self) -> Result<(), FileError> {
        let ArchiveWriter { builder, part } = self;
        builder
            .into_inner()
            .and_then(GzEncoder::finish)
            .and_then(|mut file| file.flush())
            .map_err(cannot_write(part.target()))?;
        let path = part.target().to_owned();
        match part.finish_if_absent()? {
            true => Ok(()),
            false => Err(exists(&path)),
        }
    }
}

fn exists(path: &Path) -> FileError {
    FileError::new(path, "the archive exists already; expected a new file")
        .hint("another name for --out")
}

// gzip's code for an unknown system.
const UNKNOWN_SYSTEM: u8 = 255;

fn cannot_write(path: &Path) -> impl FnOnce(std::io::Error) -> FileError {
    FileError::doing(path, "cannot write the archive")
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::super::archive::read_archive;
    use super::*;

    #[test]
    fn as_many_files_are_packed_as_are_read() {
        let out = Path::new("sent.tar.gz");
        assert!(check_number(199_999, out).is_ok());
        let message = check_number(200_000, out).unwrap_err().to_string();
        assert_eq!(
            message,
            "sent.tar.gz: too many files to pack (found 200000, expected at most 199999)"
        );
    }

    // The error of reading an archive of files, and bytes after its end.
    fn refusal(files: &mut dyn Iterator<Item = (String, &[u8])>, after: u64) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tar.gz");
        let mut writer = ArchiveWriter::create(&path).unwrap();
        for (name, bytes) in files {
            writer.add(&name, bytes).unwrap();
        }
        writer.builder.finish().unwrap();
        let zeros = std::io::repeat(0).take(after);
        std::io::copy(&mut { zeros }, writer.builder.get_mut()).unwrap();
        writer.finish().unwrap();
        read_archive(&path, None, None)
            .err()
            .map_or_else(String::new, |e| e.text())
    }

    #[test]
    fn everything_in_an_archive_is_counted() {
        let mut one = [("a".to_owned(), &b"x"[..])].into_iter();
        assert_eq!(refusal(&mut one.clone(), 1 << 20), "");
        let message = refusal(&mut one, 200 << 20);
        assert!(message.contains("it unpacks to more than"), "{message}");
        let mut empty = (0..30_000).map(|k| (format!("{k}"), &b""[..]));
        let message = refusal(&mut empty, 0);
        assert!(message.contains("too many files"), "{message}");
        let zeros = vec![0; 64 << 20];
        let message = refusal(&mut [("a".to_owned(), &zeros[..])].into_iter(), 0);
        assert!(message.contains("it unpacks to more than"), "{message}");
    }

    #[test]
    fn pax_headers_are_no_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tar.gz");
        let mut writer = ArchiveWriter::create(&path).unwrap();
        for kind in [tar::EntryType::XGlobalHeader, tar::EntryType::XHeader] {
            let times = b"20 mtime=1700000000\n";
            let mut header = Header::new_ustar();
            header.set_entry_type(kind);
            header.set_size(times.len() as u64);
            writer
                .builder
                .append_data(&mut header, "pax/header", &times[..])
                .unwrap();
        }
        writer.add("a", b"x").unwrap();
        writer.finish().unwrap();
        let files = read_archive(&path, None, None).unwrap().files;
        let names: Vec<&String> = files.keys().collect();
        assert_eq!(names, ["a"]);
    }

    #[test]
    fn an_invalid_manifest_is_refused() {
        for wrong in ["null", "[]", "{}", "1", "", "{\"method\": null}"] {
            let mut files = [(MANIFEST_FILE.to_owned(), wrong.as_bytes())].into_iter();
            let message = refusal(&mut files, 0);
            assert!(
                message.contains("is not the manifest of a submission"),
                "{wrong}: {message}"
            );
        }
    }
}
