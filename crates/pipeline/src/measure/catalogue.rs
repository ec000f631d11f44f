//! Catalogues: their columns, their metadata, and the folder that they are written to.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_files::frames::frame;
use shearq_files::frames::polars::{Column, DataFrame, PolarsResult};
use shearq_files::{FileError, table};
use shearq_measure::{
    Batch, Flag, Flags, Measurement, Observables, PixelFrame, ShearedCatalogues, Warning,
};
use shearq_quantities::Frame;
use shearq_submissions::{Calibration, Configuration, EllipticityType};

use crate::PipelineError;
use crate::stamp_table::StampTable;
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::metadata::{
    CATALOGUE_FIRST_PIXEL, CATALOGUE_FRAME, E_NOISE, NOT_APPLIED, PSF_NOISE, RESPONSE, WARNINGS,
    frame_entry,
};
use shearq_dataset::run::{Claim, Run};
use shearq_dataset::threads::Progress;

#[derive(Debug, Clone)]
pub struct ImageHead {
    pub id: ImageId,
    pub mosaic: Mosaic,
    /// The table of the stamps if they were gathered.
    pub(crate) table: Option<StampTable>,
    /// The files of its epochs.
    pub(crate) epochs: Vec<PathBuf>,
    /// Whether ellipticities are along pixel axes that a WCS states to be the sky's.
    pub(crate) aligned: bool,
    /// Fingerprints of the files that the image is measured from.
    pub prints: BTreeMap<String, String>,
}

#[derive(Debug, Clone, Copy)]
pub enum Value {
    Real(fn(&Measurement) -> f64),
    Whole(fn(&Measurement) -> i32),
}

/// The columns of catalogues after the position, in order, for the command line and Python. [`more_columns`] follow.
pub const COLUMNS: [(&str, Value); 19] = [
    ("e1", Value::Real(|g| g.e1)),
    ("e2", Value::Real(|g| g.e2)),
    ("flags", Value::Whole(|g| g.flags.bits() as i32)),
    (
        "iterations",
        Value::Whole(|g| g.descent.map_or(0, |d| d.iterations as i32)),
    ),
    // −1 if the method did not run.
    (
        "stop",
        Value::Whole(|g| g.descent.map_or(-1, |d| d.stop.code() as i32)),
    ),
    (
        "updated",
        Value::Whole(|g| g.descent.map_or(0, |d| d.updated as i32)),
    ),
    (
        "first_energy",
        Value::Real(|g| g.descent.map_or(f64::NAN, |d| d.first_energy)),
    ),
    (
        "energy",
        Value::Real(|g| g.descent.map_or(f64::NAN, |d| d.energy)),
    ),
    ("noise", Value::Real(|g| g.noise)),
    ("flux", Value::Real(|g| g.flux)),
    ("radius", Value::Real(|g| g.radius)),
    ("size", Value::Real(|g| g.size)),
    ("R11", Value::Real(|g| response(g, 0, 0))),
    ("R22", Value::Real(|g| response(g, 1, 1))),
    ("R12", Value::Real(|g| response(g, 0, 1))),
    ("R21", Value::Real(|g| response(g, 1, 0))),
    ("psf_e1", Value::Real(|g| g.psf.ellipticity()[0])),
    ("psf_e2", Value::Real(|g| g.psf.ellipticity()[1])),
    ("psf_sigma", Value::Real(|g| g.psf.sigma())),
];

/// Columns of catalogues after [`COLUMNS`]. Linear configurations have the S/N and the other [`Observables`]; then sheared
/// catalogues, if the configuration requests them. NaN for galaxies that could not be measured.
pub fn more_columns(
    configuration: &Configuration,
    galaxies: &[Measurement],
) -> Vec<(String, Vec<f64>)> {
    let Some(linear) = configuration.linear() else {
        return Vec::new();
    };
    let found = || galaxies.iter().map(|galaxy| galaxy.observables.as_ref());
    let snr = found().map(|found| found.map_or(f64::NAN, Observables::snr));
    let neighbour = found().map(|found| found.map_or(f64::NAN, Observables::neighbour));
    let mut columns = vec![
        ("snr".to_owned(), snr.collect()),
        ("neighbour".to_owned(), neighbour.collect()),
    ];
    let missing = [f64::NAN; Observables::COLUMNS.len()];
    let rows = found().map(|found| found.map_or(missing, Observables::to_array));
    let rows: Vec<_> = rows.collect();
    for (at, name) in Observables::COLUMNS.into_iter().enumerate() {
        if !COLUMNS.iter().any(|(known, _)| *known == name) {
            columns.push((name.to_owned(), rows.iter().map(|row| row[at]).collect()));
        }
    }
    if linear.shape.sheared_step > 0.0 {
        const COUNT: usize = ShearedCatalogues::QUANTITIES.len();
        let values = |at: usize| {
            let value = move |galaxy: &Measurement| {
                let sheared = galaxy.sheared.as_ref();
                sheared.map_or(f64::NAN, |all| all.values(at / COUNT)[at % COUNT])
            };
            galaxies.iter().map(value).collect()
        };
        let names = ShearedCatalogues::columns().enumerate();
        columns.extend(names.map(|(at, name)| (name, values(at))));
    }
    columns
}

fn response(galaxy: &Measurement, i: usize, j: usize) -> f64 {
    galaxy.response.map_or(f64::NAN, |response| response[i][j])
}

fn catalogue(
    head: &ImageHead,
    galaxies: &[Measurement],
    configuration: &Configuration,
) -> PolarsResult<DataFrame> {
    let (mut columns, carried) = match &head.table {
        Some(table) => table.of_catalogue(),
        None => Default::default(),
    };
    // Stamps that were not cut from an exposure have no other position than that in the mosaic.
    if !columns.iter().any(|column| column.name() == "x") {
        let positions = (0..galaxies.len()).map(|place| head.mosaic.position(place));
        let (x, y): (Vec<f64>, Vec<f64>) = positions.unzip();
        columns.extend([Column::new("x".into(), x), Column::new("y".into(), y)]);
    }
    columns.extend(COLUMNS.iter().map(|(name, value)| match value {
        Value::Real(of) => {
            let values: Vec<f64> = galaxies.iter().map(of).collect();
            Column::new((*name).into(), values)
        }
        Value::Whole(of) => {
            let values: Vec<i64> = galaxies.iter().map(|g| i64::from(of(g))).collect();
            Column::new((*name).into(), values)
        }
    }));
    let more = more_columns(configuration, galaxies).into_iter();
    columns.extend(more.map(|(name, values)| Column::new(name.into(), values)));
    // Last, because these are the user's and differ from image to image.
    columns.extend(carried);
    frame(columns)
}

// By these, `merge` and a later call determine whether a catalogue belongs to this run and to these files.
pub(crate) fn metadata(
    run: &Run,
    id: ImageId,
    prints: BTreeMap<String, String>,
) -> Result<BTreeMap<String, String>, PipelineError> {
    let ellipticity = match run.configuration.ellipticity() {
        EllipticityType::Distortion => "distortion",
        EllipticityType::Shear => "shear",
    };
    let settings = toml::to_string(&run.configuration)?;
    let mut all = prints;
    all.extend(
        [
            ("creator", format!("shearq {}", run.version)),
            ("submiss", run.configuration.name.clone()),
            ("elltype", ellipticity.to_owned()),
            ("set", id.set.to_string()),
            ("image", id.image.to_string()),
            ("settings", settings),
        ]
        .map(|(key, value)| (key.to_owned(), value)),
    );
    if run.configuration.calibration() == Calibration::Response {
        all.insert(RESPONSE.into(), NOT_APPLIED.into());
    }
    Ok(all)
}

/// A warning with the most frequent reason if the catalogues of the results folder `out` have galaxies and all are flagged.
pub fn all_flagged(run: &Run, out: &Path) -> Result<Option<Warning>, FileError> {
    let files = run.catalogues(out, &[])?;
    let mut summary = Summary::default();
    for set in files.wanted(&[]) {
        for (_, path) in files.of_set(set) {
            let read = table::read(&path, Some(&["flags"]), table::MAX_ROWS)?;
            for &bits in &*table::numbers(&read, "flags", &path)? {
                if bits == 0.0 {
                    return Ok(None);
                }
                summary.add(Flags::from_bits(bits as u32));
            }
        }
    }
    // A catalogue of another program may have values without a flag of ours.
    summary.flagged = summary.galaxies;
    Ok(summary.all_flagged())
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Summary {
    /// Images measured now.
    pub images: usize,
    /// Images measured before.
    pub already: usize,
    /// Galaxies measured now.
    pub galaxies: u64,
    /// Galaxies measured now that are flagged.
    pub flagged: u64,
    /// Images measured now in the frame of the sky.
    pub on_sky: usize,
    /// Galaxies measured now with each of [`Flag::ALL`].
    pub flags: [u64; Flag::ALL.len()],
    /// Galaxies measured now with pixels that hold no light, and the number of these pixels.
    pub with_defects: u64,
    pub defects: u64,
}

impl Summary {
    /// A warning with the most frequent reason if galaxies were measured and all are flagged.
    pub fn all_flagged(&self) -> Option<Warning> {
        let Summary {
            galaxies, flagged, ..
        } = *self;
        let with = self.flags.map(|count| count as usize);
        let all = Warning::of_counts(with, flagged as usize, galaxies as usize)?;
        (galaxies > 0 && flagged == galaxies).then_some(all)
    }

    fn count(&mut self, galaxies: &[Measurement]) {
        self.images += 1;
        for galaxy in galaxies {
            self.add(galaxy.flags);
            self.with_defects += u64::from(!galaxy.defects.is_empty());
            self.defects += u64::from(galaxy.defects.total());
        }
    }

    fn add(&mut self, flags: Flags) {
        self.galaxies += 1;
        self.flagged += u64::from(!flags.is_empty());
        for (count, flag) in self.flags.iter_mut().zip(Flag::ALL) {
            *count += u64::from(flags.contains(flag));
        }
    }
}

// Catalogues are written atomically, so that one that exists is complete.
pub(super) fn to_do(run: &Run, out: &Path, images: &[ImageId]) -> (Vec<ImageId>, Vec<ImageId>) {
    images
        .iter()
        .partition(|id| !run.catalogue(out, id.set, id.image).is_file())
}

pub(crate) struct CatalogueWriter<'a> {
    run: &'a Run,
    out: &'a Path,
    images: &'a [ImageId],
    rotated_pairs: bool,
    claim: Claim,
    pub(crate) todo: Vec<ImageId>,
    pub(crate) done: Vec<ImageId>,
    summary: Summary,
    warned: Warned,
}

impl<'a> CatalogueWriter<'a> {
    pub(crate) fn claim(
        run: &'a Run,
        out: &'a Path,
        images: &'a [ImageId],
    ) -> Result<Self, FileError> {
        let claim = run.claim(out)?;
        let (todo, done) = to_do(run, out, images);
        let great3 = run.source.layout().great3;
        let summary = Summary {
            already: done.len(),
            ..Summary::default()
        };
        Ok(CatalogueWriter {
            run,
            out,
            images,
            rotated_pairs: great3.is_some_and(|branch| branch.rotated_pairs),
            claim,
            todo,
            done,
            summary,
            warned: Warned::default(),
        })
    }

    // Warnings first, because a fatal one must not leave a catalogue.
    pub(crate) fn add(
        &mut self,
        head: &ImageHead,
        batch: &Batch,
        progress: &mut dyn Progress,
    ) -> Result<(), PipelineError> {
        let ImageId { set, image } = head.id;
        let found = &batch.warnings;
        self.warned.add(head, found, progress)?;
        // If a user removed the folder meanwhile, writing would create it again with the later catalogues only.
        self.claim.check()?;
        let path = self.run.catalogue(self.out, set, image);
        let table = catalogue(head, &batch.galaxies, &self.run.configuration)
            .map_err(|error| FileError::new(&path, error.to_string()))?;
        let mut metadata = metadata(self.run, head.id, head.prints.clone())?;
        if !found.is_empty() {
            let lines: Vec<String> = found.iter().map(Warning::to_string).collect();
            metadata.insert(WARNINGS.into(), lines.join("\n"));
        }
        for warning in found {
            if let Warning::PixelFrame(frame) = warning.inner() {
                metadata.extend([frame_entry(frame)]);
            }
        }
        if head.aligned {
            metadata.extend([frame_entry(&PixelFrame::default())]);
        }
        if batch.frame == Frame::Sky {
            metadata.insert(CATALOGUE_FRAME.into(), Frame::Sky.to_string());
        }
        if let Some(table) = &head.table {
            metadata.insert(
                CATALOGUE_FIRST_PIXEL.into(),
                table.head.first_pixel.to_string(),
            );
        }
        if let Some([m, c]) = batch.psf_noise {
            metadata.insert(PSF_NOISE.into(), format!("{m:.2e} {c:.2e}"));
        }
        let [e1, e2] = batch.e_noise;
        if self.rotated_pairs && e1 > 0.0 && e2 > 0.0 {
            metadata.insert(E_NOISE.into(), format!("{e1:.3e} {e2:.3e}"));
        }
        table::write(&path, self.run.format, &table, &metadata)?;
        self.summary.on_sky += usize::from(batch.frame == Frame::Sky);
        self.summary.count(&batch.galaxies);
        progress.note(&format!("set {set:02} image {image:03}"));
        Ok(())
    }

    // A removed folder causes other errors, such as files that cannot be written; it is the one to report.
    pub(crate) fn explain(&self, error: PipelineError) -> PipelineError {
        self.claim.explain(error)
    }

    pub(crate) fn finish(self, progress: &mut dyn Progress) -> Result<Summary, PipelineError> {
        let path = |id: &ImageId| -> PathBuf { self.run.catalogue(self.out, id.set, id.image) };
        self.claim.check_results(self.images.iter().map(path))?;
        self.warned.finish(progress);
        Ok(self.summary)
    }
}

/// Kinds of warnings that were shown, and the number of further images with each: many images often have the same warning,
/// and a line for each image would hide the others.
#[derive(Debug, Default)]
struct Warned {
    kinds: BTreeMap<&'static str, usize>,
}

impl Warned {
    fn add(
        &mut self,
        head: &ImageHead,
        warnings: &[Warning],
        progress: &mut dyn Progress,
    ) -> Result<(), PipelineError> {
        for warning in warnings {
            let (epoch, warning) = match warning {
                Warning::Epoch { epoch, warning } => (head.epochs.get(epoch - 1), &**warning),
                of_image => (None, of_image),
            };
            if warning.is_fatal() {
                return Err(match epoch {
                    Some(path) => FileError::new(path, warning).into(),
                    None => PipelineError::Fatal {
                        id: head.id,
                        warning: warning.clone(),
                    },
                });
            }
            match self.kinds.get_mut(warning.kind()) {
                Some(more) => *more += 1,
                None => {
                    self.kinds.insert(warning.kind(), 0);
                    let ImageId { set, image } = head.id;
                    let of = match epoch {
                        Some(path) => path.display().to_string(),
                        None => format!("set {set:02} image {image:03}"),
                    };
                    progress.warn(&format!("warning: {of}: {warning}"));
                }
            }
        }
        Ok(())
    }

    fn finish(self, progress: &mut dyn Progress) {
        for (kind, more) in self.kinds.iter().filter(|(_, more)| **more > 0) {
            let images = if *more == 1 {
                "image has"
            } else {
                "images have"
            };
            progress.warn(&format!(
                "warning: {more} more {images} the warning \"{kind}\""
            ));
        }
    }
}
