//! Measuring a data folder: rows of stamps in, one catalogue per image out.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ndarray::{ArcArray2, Array2, ArrayView2, ArrayView3, Axis, Slice};
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::frames::{TableError, frame};
use shearq_measure::{
    EXAMINED_PSFS, Examination, Flag, FunctionalPsf, ImageNoise, MeasureError, Measurement,
    Measurer, NoisePlan, Psfs, Star, Survey, Warning, Worker, calibrate, examined_rows, star,
    strip,
};
use shearq_submissions::{Configuration, EllipticityType, NoiseSource, PsfCut, PsfForm};

use super::PipelineError;
use super::engine::{self, Feeder, Progress};
use super::grid::{self, whole};
use super::images::ImageId;
use super::inputs::Inputs;
use super::warned::Warned;
use crate::data::layout::{DataFolder, MAX_STAMP};
use crate::data::mosaic::Mosaic;
use crate::data::psf_table;
use crate::data::run::{RUN_FILE, Run, claim};
use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_files::table;

/// Most pixels of a row of stamps, several of which are in memory at a time: those of the largest grid of
/// stamps of the challenge's size and somewhat more.
const MAX_STRIP: usize = 1 << 24;

/// Largest distance along each axis of pixels that are looked at for correlated noise where a submission takes
/// noise as white.
const CORRELATION: usize = 2;
/// Least difference between a header's noise level and the measured one, in units of either, that is told.
const LEAST_DOUBT: f64 = 0.01;
/// The same in units of its standard error.
const CLEAR: f64 = 5.0;

/// One row of stamps of an image.
pub struct StampRow {
    /// The image.
    pub id: ImageId,
    /// Row of the mosaic, from 0.
    pub iy: usize,
    /// The image's stamps.
    pub mosaic: Mosaic,
    /// The rows of pixels of the image that hold them.
    pub pixels: Vec<f32>,
    /// NOISESIG.
    pub header_noise: Option<f64>,
    /// What the image's stamps tell of it, where the submission asks for noise to be measured on them.
    pub survey: Option<Arc<Survey>>,
    /// The PSFs of its galaxies.
    pub psfs: Psfs<'static>,
    /// What was found wrong with the image when it was opened, with its first row.
    pub warnings: Vec<Warning>,
}

/// Measurements of one row of stamps.
pub struct MeasuredRow {
    /// The image.
    pub id: ImageId,
    /// Row of the mosaic, from 0.
    pub iy: usize,
    /// The image's stamps.
    pub mosaic: Mosaic,
    /// One per galaxy.
    pub galaxies: Vec<Measurement>,
    /// What was found wrong with the image when it was opened, with its first row.
    pub warnings: Vec<Warning>,
    /// Of the rows that are examined.
    pub examination: Option<Examination>,
}

impl AsRef<[Measurement]> for MeasuredRow {
    fn as_ref(&self) -> &[Measurement] {
        &self.galaxies
    }
}

impl AsMut<[Measurement]> for MeasuredRow {
    fn as_mut(&mut self) -> &mut [Measurement] {
        &mut self.galaxies
    }
}

/// An open image with its PSFs.
pub struct ImageSource {
    id: ImageId,
    image: ImageReader,
    mosaic: Mosaic,
    header_noise: Option<f64>,
    survey: Option<Arc<Survey>>,
    psf: PsfSource,
    warnings: Vec<Warning>,
    next: usize,
}

enum PsfSource {
    Shared(ArcArray2<f64>),
    Stars {
        image: Box<ImageReader>,
        side: usize,
    },
    Functional(Vec<FunctionalPsf>),
}

impl ImageSource {
    /// Opens an image and what the submission needs of its PSF.
    ///
    /// # Errors
    /// Where a file is absent, damaged or does not fit the submission.
    pub fn open(
        data: &DataFolder,
        id: ImageId,
        configuration: &Configuration,
    ) -> Result<Self, PipelineError> {
        let (image, mosaic) = open_galaxies(data, id)?;
        let stamp = mosaic.stamp;
        if stamp < configuration.stamp.size {
            let path = data.galaxies(id.set, id.image);
            return Err(FileError::new(path, too_small(stamp, configuration)).into());
        }
        let header_noise = image.number("NOISESIG")?;
        if configuration.noise == NoiseSource::Header
            && !header_noise.is_some_and(|sigma| sigma > 0.0 && sigma.is_finite())
        {
            let found = header_noise.map_or("absent".into(), |sigma| sigma.to_string());
            let other = match configuration.linear() {
                Some(_) => "image",
                None => "border",
            };
            let message = format!(
                "the header key NOISESIG is {found}; expected a positive number, as submission {} takes the noise from it (noise.source = \"{other}\" would measure it)",
                configuration.name
            );
            return Err(FileError::new(data.galaxies(id.set, id.image), message).into());
        }
        let (psf, moved) = open_psf(data, id, configuration, &mosaic)?;
        let mut warnings: Vec<Warning> = Warning::of_settings(configuration).into_iter().collect();
        warnings.extend(moved.map(Warning::of_moved));
        Ok(ImageSource {
            psf,
            id,
            image,
            mosaic,
            header_noise,
            survey: None,
            warnings,
            next: 0,
        })
    }

    /// The image's stamps.
    pub fn mosaic(&self) -> Mosaic {
        self.mosaic
    }

    /// Measures the noise of the image on its stamps, and how broad its galaxies are, for the rows that follow and for the
    /// caller; `None` where too many pixels of all of them are missing. NOISESIG does not take its place then, so that their
    /// galaxies are flagged.
    ///
    /// # Errors
    /// Where they cannot be read, or hold no frame of noise alone.
    pub fn look(
        &mut self,
        data: &DataFolder,
        plan: &NoisePlan,
    ) -> Result<Option<Arc<Survey>>, PipelineError> {
        let path = data.galaxies(self.id.set, self.id.image);
        let mut image = ImageReader::open(&path)?;
        let Mosaic { columns, stamp, .. } = self.mosaic;
        let mut survey = plan.survey();
        let mut next = 0;
        for row in plan.rows(columns, self.mosaic.rows()) {
            image.skip_rows((row - next) * stamp);
            next = row + 1;
            let pixels = image.read_rows(stamp)?;
            let stamps = strip(&pixels, columns, stamp)?;
            for stamp in stamps.outer_iter().take(self.mosaic.of_row(row)) {
                survey.add(stamp)?;
            }
        }
        self.survey = survey.shared().map_err(|error| {
            if let MeasureError::Data(wrong) = error {
                return FileError::new(&path, wrong);
            }
            let missing = match survey.incomplete() {
                0 => String::new(),
                count => format!(", {count} of which have missing pixels"),
            };
            let looked_at = survey.looked_at();
            let message = format!(
                "the frames of {looked_at} stamp(s){missing} hold too little noise to measure it; expected two or more whole frames of pixels that differ by noise: set noise.source to \"border\", or to \"header\" where NOISESIG is known"
            );
            FileError::new(&path, message)
        })?;
        if self.survey.is_none() {
            self.header_noise = None;
        }
        Ok(self.survey.clone())
    }

    /// The next row of stamps, `None` after the last.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn next_row(&mut self) -> Result<Option<StampRow>, PipelineError> {
        let mosaic = self.mosaic;
        if self.next == mosaic.rows() {
            return Ok(None);
        }
        let iy = self.next;
        self.next += 1;
        let first = iy * mosaic.columns;
        Ok(Some(StampRow {
            id: self.id,
            iy,
            mosaic,
            pixels: self.image.read_rows(mosaic.stamp)?,
            header_noise: self.header_noise,
            survey: self.survey.clone(),
            psfs: match &mut self.psf {
                PsfSource::Shared(psf) => Psfs::Prepared(psf.clone()),
                PsfSource::Stars { image, side } => {
                    let mut stars = Psfs::strip(image.read_rows(*side)?, mosaic.columns, *side)?;
                    // Behind the last galaxy there is nothing to measure.
                    stars.truncate(mosaic.of_row(iy));
                    stars
                }
                PsfSource::Functional(field) => {
                    Psfs::functional(field[first..first + mosaic.of_row(iy)].to_vec())
                }
            },
            warnings: std::mem::take(&mut self.warnings),
        }))
    }
}

/// Why stamps of `stamp` pixels a side cannot be measured, with the lines of a configuration that measures them.
fn too_small(stamp: usize, configuration: &Configuration) -> String {
    let Configuration { name, .. } = configuration;
    let needed = configuration.stamp.size;
    let mut lines = format!("  extends = \"{name}\"\n  stamp.size = {stamp}");
    if let Some(linear) = configuration.linear() {
        // The linear method asks for a window of at most a quarter of the stamp, and for a PSF that is even or odd as it.
        let window = stamp as f64 / 4.0;
        if linear.deconvolution.window_sigma > window {
            lines += &format!("\n  deconvolution.window_sigma = {window}");
        }
        if configuration.psf.size % 2 != stamp % 2 {
            lines += &format!("\n  psf.size = {}", configuration.psf.size - 1);
        }
    }
    format!(
        "the stamps are too small for the configuration {name} (found {stamp} px a side, expected {needed} or more). Try: --submission own.toml, with the file own.toml of these lines:\n{lines}"
    )
}

/// Opens the galaxies of an image, whose stamps are those of its header, or of the data's layout.
pub(super) fn open_galaxies(
    data: &DataFolder,
    id: ImageId,
) -> Result<(ImageReader, Mosaic), PipelineError> {
    let path = data.galaxies(id.set, id.image);
    let image = ImageReader::open(&path)?;
    let mosaic = grid::of_image(data, &path, &image)?;
    check_strip(&path, mosaic.columns, mosaic.stamp)?;
    Ok((image, mosaic))
}

/// Checks that a row of `n` stamps of `side` pixels a side is one that can be held in memory.
pub(super) fn check_strip(path: &Path, n: usize, side: usize) -> Result<(), FileError> {
    let pixels = n * side * side;
    if pixels <= MAX_STRIP {
        return Ok(());
    }
    let message = format!(
        "a row of {n} stamps of {side} pixels a side has {pixels} pixels; expected at most {MAX_STRIP}"
    );
    Err(FileError::new(path, message))
}

/// The PSFs of an image, and the offset of a star for all galaxies that was moved to the middle of its stamp.
fn open_psf(
    data: &DataFolder,
    id: ImageId,
    configuration: &Configuration,
    mosaic: &Mosaic,
) -> Result<(PsfSource, Option<[f64; 2]>), PipelineError> {
    let cut = configuration.psf_cut();
    let PsfCut { size, least } = cut;
    match configuration.psf.form {
        PsfForm::Functional => {
            let path = data.psf_functional(id.set, id.image);
            let rows = psf_table::read(&path, mosaic)?;
            if let Some(wide) = rows.iter().find(|psf| psf.fwhm > size as f64) {
                let message = format!(
                    "a PSF has a FWHM of {} px; expected at most the {size} pixels a side of the submission's PSF stamp",
                    wide.fwhm
                );
                return Err(FileError::new(&path, message).into());
            }
            let source = match rows.as_slice() {
                [psf] => {
                    let stamp = psf.stamp_beside(cut.size, mosaic.stamp);
                    if stamp.iter().any(|value| !value.is_finite()) {
                        let message = format!(
                            "a PSF with a FWHM of {} px has no light on its stamp; expected a width of about a pixel or more",
                            psf.fwhm
                        );
                        return Err(FileError::new(&path, message).into());
                    }
                    PsfSource::Shared(stamp.into_shared())
                }
                _ => PsfSource::Functional(rows),
            };
            Ok((source, None))
        }
        PsfForm::Star => {
            let path = data.psf_star(id.set, id.image);
            let mut image = ImageReader::open(&path)?;
            let (width, height) = (image.width(), image.height());
            let (columns, rows) = (mosaic.columns, mosaic.rows());
            let side = match whole(&image, &path, "STAMP", MAX_STAMP)? {
                Some(side) => side,
                // One star is never as large as a mosaic of the smallest PSF stamps that could be taken.
                None if width >= columns * least
                    && width.is_multiple_of(columns)
                    && height == rows * (width / columns) =>
                {
                    width / columns
                }
                None => width,
            };
            if side < least {
                let message =
                    format!("the PSF stamp has {side} pixels a side; the submission needs {least}");
                return Err(FileError::new(&path, message).into());
            }
            let stars = whole(&image, &path, "NSTAMPS", mosaic.columns * mosaic.rows())?;
            if let Some(stars) = stars.filter(|stars| *stars != 1 && *stars != mosaic.galaxies) {
                let message = format!(
                    "the header key NSTAMPS is {stars}; expected 1, or {} as there are galaxies",
                    mosaic.galaxies
                );
                return Err(FileError::new(&path, message).into());
            }
            let one = (width, height) == (side, side);
            if mosaic.galaxies > 1 && (width, height) == (columns * side, rows * side) {
                check_strip(&path, columns, side)?;
                let image = Box::new(image);
                return Ok((PsfSource::Stars { image, side }, None));
            }
            if !one || side > MAX_STAMP {
                let message = format!(
                    "the star image is {width} × {height} pixels; expected one stamp, or {columns} × {rows} as there are galaxies, of {0} × {0} pixels",
                    side.min(MAX_STAMP)
                );
                return Err(FileError::new(&path, message).into());
            }
            let pixels = image.read_rows(height)?;
            let stamp = ArrayView2::from_shape((height, width), &pixels)
                .map_err(|error| FileError::new(&path, error))?;
            let Star { psf, moved } =
                star(stamp, cut).map_err(|error| FileError::new(&path, error))?;
            Ok((PsfSource::Shared(psf.into_shared()), moved))
        }
    }
}

/// Measures every galaxy of a row, before any calibration.
///
/// # Errors
/// Where the row's stamps have other sizes than planned.
pub fn measure_row(worker: &mut Worker, row: &StampRow) -> Result<MeasuredRow, PipelineError> {
    let Mosaic { columns, stamp, .. } = row.mosaic;
    // Behind the last galaxy there is nothing to measure.
    let here = Slice::from(..row.mosaic.of_row(row.iy));
    let stamps = strip(&row.pixels, columns, stamp)?;
    let stamps = stamps.slice_axis(Axis(0), here);
    let mut image = worker.image(ImageNoise::of(row.survey.as_ref(), row.header_noise));
    let galaxies = image.measure_each(stamps, &row.psfs)?;
    Ok(MeasuredRow {
        id: row.id,
        iy: row.iy,
        mosaic: row.mosaic,
        galaxies,
        warnings: row.warnings.clone(),
        examination: examine(row, stamps, worker.configuration().psf_cut())?,
    })
}

/// Examines the stamps of a row, if it is one of those that are enough for its image.
fn examine(
    row: &StampRow,
    stamps: ArrayView3<'_, f32>,
    cut: PsfCut,
) -> Result<Option<Examination>, PipelineError> {
    let Mosaic { columns, stamp, .. } = row.mosaic;
    let rows = examined_rows(columns, row.mosaic.rows());
    if !rows.contains(&row.iy) {
        return Ok(None);
    }
    let mut examination = Examination::new(stamp, columns);
    for stamp in stamps.outer_iter() {
        examination.add(stamp)?;
    }
    let most = EXAMINED_PSFS.div_ceil(rows.len());
    // A PSF of all galaxies once for the image.
    if row.psfs.count().is_some() || rows.first() == Some(&row.iy) {
        examination.add_psfs(&row.psfs, cut, most);
    }
    Ok(Some(examination))
}

/// What is wrong with an image whose rows have been measured and calibrated.
pub(crate) fn warnings(rows: &[MeasuredRow]) -> Vec<Warning> {
    let mut found: Vec<Warning> = rows.iter().flat_map(|row| row.warnings.clone()).collect();
    let mut examinations = rows.iter().filter_map(|row| row.examination.as_ref());
    if let Some(first) = examinations.next() {
        let mut all = first.clone();
        examinations.for_each(|more| all.join(more));
        found.extend(all.warnings());
    }
    found.extend(Warning::of_flags(rows));
    found
}

/// The PSF of galaxy `ix` of a row as it is deconvolved with.
///
/// # Errors
/// Where it cannot be used.
pub fn psf_of(row: &StampRow, ix: usize, cut: PsfCut) -> Result<Array2<f64>, PipelineError> {
    Ok(row.psfs.at(ix, cut, row.mosaic.stamp)?.psf)
}

/// What a measurement did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Summary {
    /// Images measured now.
    pub images: usize,
    /// Images found already measured.
    pub already: usize,
    /// Galaxies measured now.
    pub galaxies: u64,
    /// Of these, flagged.
    pub flagged: u64,
    /// Galaxies with each of [`Flag::ALL`].
    pub flags: [u64; Flag::ALL.len()],
}

impl Summary {
    /// Counts one image.
    pub(super) fn count(&mut self, rows: &[MeasuredRow]) {
        self.images += 1;
        for galaxy in rows.iter().flat_map(|row| &row.galaxies) {
            self.galaxies += 1;
            self.flagged += u64::from(!galaxy.flags.is_empty());
            for (count, flag) in self.flags.iter_mut().zip(Flag::ALL) {
                *count += u64::from(galaxy.flags.contains(flag));
            }
        }
    }
}

/// Measures `images` of the run's data into catalogues in `out`.
///
/// Catalogues that are there already are kept if the folder's record says that the same settings
/// made them.
///
/// # Errors
/// Where the folder holds results of other settings, data are absent or damaged, or a catalogue
/// cannot be written.
pub fn measure_folder(
    run: &Run,
    data: &DataFolder,
    out: &Path,
    images: &[ImageId],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Summary, PipelineError> {
    let claim = claim(&out.join(RUN_FILE), run)?;
    let inputs = Inputs::new(run, data, images)?;
    let (todo, done) = to_do(run, out, images);
    inputs.verify(out, &done, threads)?;
    let mut summary = Summary {
        already: done.len(),
        ..Summary::default()
    };
    let Some(&first) = todo.first() else {
        return Ok(summary);
    };
    // All images of a folder have stamps of one size; each is checked when it is opened.
    let stamp = ImageSource::open(data, first, &run.configuration)?
        .mosaic
        .stamp;
    let measurer = Measurer::new(&run.configuration, stamp)?;
    let first = first_noise(data, first, &measurer)?;
    let mut warned = Warned::default();
    let mut rows = Vec::new();
    // Of each image as it was when it was opened, in the images' order.
    let (send, receive) = std::sync::mpsc::channel();
    engine::ordered(
        threads,
        |feeder| {
            let print = |id| {
                // Nobody listens after an error, which is reported elsewhere.
                let _ = send.send(inputs.prints(id)?);
                Ok(())
            };
            read_images(data, &todo, &measurer, first, print, feeder)
        },
        || measurer.worker(),
        |worker, row: StampRow| measure_row(worker, &row),
        |row: MeasuredRow| {
            progress.advance(row.galaxies.len() as u64);
            let (id, mosaic) = (row.id, row.mosaic);
            rows.push(row);
            if rows.len() == mosaic.rows() {
                calibrate(&run.configuration, &mut rows);
                warned.add(id, warnings(&rows), progress)?;
                let prints = receive.recv().unwrap_or_default();
                // Writing would make the folder again, without the earlier catalogues.
                claim.check()?;
                write_catalogue(run, out, &rows, prints)?;
                summary.count(&rows);
                rows.clear();
                progress.note(&format!("set {:02} image {:03}", id.set, id.image));
            }
            Ok(())
        },
    )
    .map_err(|error| claim.explain(error))?;
    claim.check_results(catalogues(run, out, images))?;
    warned.finish(progress);
    Ok(summary)
}

/// What the stamps of the first image to be measured with the linear method tell of it, where the submission measures
/// its noise; and what it says against the header and against what the submission takes it for.
fn first_noise(
    data: &DataFolder,
    first: ImageId,
    measurer: &Measurer,
) -> Result<(Option<Arc<Survey>>, Vec<Warning>), PipelineError> {
    let configuration = measurer.configuration();
    let nothing = (None, Vec::new());
    if configuration.linear().is_none() {
        return Ok(nothing);
    }
    let own;
    let plan = match measurer.noise_plan() {
        Some(plan) => plan,
        // Small stamps have no frame to look at.
        None => match NoisePlan::new(measurer.full(), CORRELATION) {
            Ok(plan) => {
                own = plan;
                &own
            }
            Err(_) => return Ok(nothing),
        },
    };
    let mut source = ImageSource::open(data, first, configuration)?;
    let asked = measurer.noise_plan().is_some();
    let given = source.header_noise;
    let survey = match source.look(data, plan) {
        Ok(Some(survey)) => survey,
        Err(error) if asked => return Err(error),
        Ok(None) if asked => return Ok((None, vec![Warning::NoNoise])),
        Ok(None) | Err(_) => return Ok(nothing),
    };
    let white =
        !matches!(configuration.noise, NoiseSource::Image { correlation } if correlation > 0);
    // A survey that takes noise as white does not look for more.
    let coloured = if white && asked {
        source.look(data, &NoisePlan::new(measurer.full(), CORRELATION)?)?
    } else {
        None
    };
    let coloured = &coloured.as_ref().unwrap_or(&survey).noise;
    let mut warnings: Vec<Warning> = doubtful(given, &survey, asked).into_iter().collect();
    if white && coloured.is_correlated() {
        warnings.push(Warning::CorrelatedNoise {
            correlation: [coloured.correlation(1, 0), coloured.correlation(0, 1)],
        });
    }
    Ok((asked.then_some(survey), warnings))
}

/// A warning if the header's noise level is not the measured one, which may be `used`.
fn doubtful(given: Option<f64>, survey: &Survey, used: bool) -> Option<Warning> {
    let (given, noise) = (given?, &survey.noise);
    let apart = noise.sigma() / given - 1.0;
    let differs = apart.abs() > (CLEAR * noise.error()).max(LEAST_DOUBT);
    // A header of zero or of no number.
    (differs || apart.is_nan()).then_some(Warning::NoiseLevel {
        given,
        measured: noise.sigma(),
        used,
    })
}

/// Number of galaxies that `measure_folder` will measure, for progress bars: an estimate from the
/// first image.
///
/// # Errors
/// As [`measure_folder`].
pub fn galaxies_to_do(
    run: &Run,
    data: &DataFolder,
    out: &Path,
    images: &[ImageId],
) -> Result<u64, PipelineError> {
    let (todo, _) = to_do(run, out, images);
    let Some(&first) = todo.first() else {
        return Ok(0);
    };
    let mosaic = ImageSource::open(data, first, &run.configuration)?.mosaic;
    Ok((todo.len() * mosaic.galaxies) as u64)
}

/// The catalogues of `images`, as they are called.
pub(super) fn catalogues(
    run: &Run,
    out: &Path,
    images: &[ImageId],
) -> impl Iterator<Item = PathBuf> {
    images.iter().map(|id| run.catalogue(out, id.set, id.image))
}

/// Those of `images` that have no catalogue yet, and those that have one.
pub(super) fn to_do(run: &Run, out: &Path, images: &[ImageId]) -> (Vec<ImageId>, Vec<ImageId>) {
    images
        .iter()
        .partition(|id| !run.catalogue(out, id.set, id.image).is_file())
}

fn read_images(
    data: &DataFolder,
    todo: &[ImageId],
    measurer: &Measurer,
    (first, mut warnings): (Option<Arc<Survey>>, Vec<Warning>),
    mut opened: impl FnMut(ImageId) -> Result<(), FileError>,
    feeder: &mut Feeder<'_, StampRow>,
) -> Result<(), PipelineError> {
    let mut first = Some(first);
    for &id in todo {
        opened(id)?;
        let mut source = ImageSource::open(data, id, measurer.configuration())?;
        let stamp = measurer.full();
        let found = source.mosaic.stamp;
        if found != stamp {
            let path = data.galaxies(id.set, id.image);
            let message = format!(
                "the stamps have {found} pixels a side; those of the images before have {stamp}"
            );
            return Err(FileError::new(path, message).into());
        }
        source.warnings.append(&mut warnings);
        match (measurer.noise_plan(), first.take()) {
            (None, _) => {}
            (Some(_), Some(found)) => {
                // Without noise the header's does not take its place.
                source.header_noise = source.header_noise.filter(|_| found.is_some());
                source.survey = found;
            }
            (Some(plan), None) => {
                let given = source.header_noise;
                let found = source.look(data, plan)?;
                source.warnings.extend(match found {
                    Some(survey) => doubtful(given, &survey, true),
                    None => Some(Warning::NoNoise),
                });
            }
        }
        while let Some(row) = source.next_row()? {
            if !feeder.push(row) {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// Catalogue of one image from its rows of stamps, in order.
///
/// # Errors
/// Where polars cannot make it.
pub fn catalogue(rows: &[MeasuredRow]) -> Result<DataFrame, TableError> {
    let galaxies = || {
        rows.iter().flat_map(|row| {
            row.galaxies
                .iter()
                .enumerate()
                .map(move |(ix, g)| (row, ix, g))
        })
    };
    let real = |name: &str, value: &dyn Fn(&Measurement) -> f64| {
        let values: Vec<f64> = galaxies().map(|(_, _, g)| value(g)).collect();
        Column::new(name.into(), values)
    };
    let whole = |name: &str, value: &dyn Fn(&Measurement) -> i64| {
        let values: Vec<i64> = galaxies().map(|(_, _, g)| value(g)).collect();
        Column::new(name.into(), values)
    };
    let energy = |g: &Measurement| g.descent.map_or(f64::NAN, |d| d.energy);
    let first = |g: &Measurement| g.descent.map_or(f64::NAN, |d| d.first_energy);
    let (x, y): (Vec<f64>, Vec<f64>) = galaxies()
        .map(|(row, ix, _)| row.mosaic.centre(ix, row.iy))
        .unzip();
    frame(vec![
        Column::new("x".into(), x),
        Column::new("y".into(), y),
        real("e1", &|g| g.e1),
        real("e2", &|g| g.e2),
        whole("flag", &|g| i64::from(g.flags.bits())),
        whole("iterations", &|g| {
            g.descent.map_or(0, |d| i64::from(d.iterations))
        }),
        // −1 where the network did not run.
        whole("stop", &|g| {
            g.descent.map_or(-1, |d| i64::from(d.stop.code()))
        }),
        whole("updated", &|g| {
            g.descent.map_or(0, |d| i64::from(d.updated))
        }),
        real("first_energy", &first),
        real("energy", &energy),
        real("noise", &|g| g.noise),
        real("flux", &|g| g.flux),
        real("radius", &|g| g.radius),
        real("size", &|g| g.size),
        real("response1", &|g| g.response_diagonal()[0]),
        real("response2", &|g| g.response_diagonal()[1]),
    ])
}

/// Writes the catalogue of one image from its rows of stamps, in order; `prints` are the
/// fingerprints of what they were measured from.
pub(super) fn write_catalogue(
    run: &Run,
    out: &Path,
    rows: &[MeasuredRow],
    prints: BTreeMap<String, String>,
) -> Result<(), PipelineError> {
    let id = rows[0].id;
    let path = run.catalogue(out, id.set, id.image);
    let table = catalogue(rows).map_err(|error| FileError::new(&path, error.to_string()))?;
    table::write(&path, run.format, &table, &metadata(run, id, prints)?)?;
    Ok(())
}

/// What made the catalogue of an image from files with the fingerprints `prints`, as the catalogue carries
/// it.
pub(super) fn metadata(
    run: &Run,
    id: ImageId,
    prints: BTreeMap<String, String>,
) -> Result<BTreeMap<String, String>, PipelineError> {
    let ellipticity = match run.configuration.ellipticity() {
        EllipticityType::Distortion => "distortion",
        EllipticityType::Shear => "shear",
    };
    let settings = toml::to_string(&run.configuration).map_err(|error| {
        PipelineError::Request(format!("the settings cannot be stored: {error}"))
    })?;
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
    Ok(all)
}
