//! Stamps and PSFs into calibrated ellipticities.

use std::sync::Arc;

use ndarray::{ArcArray2, Array3, ArrayView2, ArrayView3, Axis};
use numpy::{IntoPyArray, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_measure::{
    EXAMINED_PSFS, Examination, Flag, FunctionalPsf, ImageNoise, MeasureError, Measurement,
    Measurer, NoisePlan, Pixel, PsfProfile, Psfs, Survey, Warning, Worker, calibrate,
    examined_rows,
};
use shearq_pipeline::engine;
use shearq_quantities::Shear;
use shearq_submissions::PsfCut;

use crate::errors::{no_memory, of_measuring};
use crate::stamps::{Borrowed, Piece, Stamps};
use crate::submissions::Configuration;
use crate::work::{Failure, Watch, threads};

/// Stamps that a worker takes at a time: enough that handing them out costs nothing, few enough that copies
/// of them, where they have to be made, are small.
const PIECE: usize = 64;

/// PSFs of all stamps.
enum AllPsfs<'a> {
    Shared(ArcArray2<f64>),
    Stars(Stamps<'a>),
    Formulas(Vec<FunctionalPsf>),
}

impl AllPsfs<'_> {
    /// Those from `start` to before `end`.
    fn piece(&self, start: usize, end: usize) -> PyResult<Psfs<'_>> {
        Ok(match self {
            AllPsfs::Shared(psf) => Psfs::Prepared(psf.clone()),
            AllPsfs::Stars(stars) => match stars.piece(start, end)? {
                Piece::Single(stars) => Psfs::stars(stars),
                Piece::Double(stars) => Psfs::stars(stars),
                Piece::Copied(stars) => Psfs::stars(stars),
            },
            AllPsfs::Formulas(formulas) => Psfs::functional(&formulas[start..end]),
        })
    }
}

/// Noise levels of all stamps, or of a piece.
#[derive(Clone, Copy)]
enum Noise<'a> {
    One(Option<f64>),
    Each(&'a [f64]),
}

impl<'a> Noise<'a> {
    fn piece(self, start: usize, end: usize) -> Self {
        match self {
            Noise::One(level) => Noise::One(level),
            Noise::Each(levels) => Noise::Each(&levels[start..end]),
        }
    }
}

/// The catalogue, the mean response, and the warnings.
type Measured<'py> = (Bound<'py, PyDict>, Option<[f64; 2]>, Vec<String>);

/// Some stamps with all that is needed to measure them.
struct Job<'a> {
    stamps: Piece<'a>,
    psfs: Psfs<'a>,
    noise: Noise<'a>,
}

/// Measures stamps `(n, ny, nx)` with a star stamp for all, star stamps one each, or formulas (FWHM, e1, e2 and
/// β, which is not a number for Kolmogorov), one or one each; and a noise level for all or one each, or none where the
/// submission measures it on the stamps. Returns the catalogue's columns, the mean response that the ellipticities were
/// divided by, and what is wrong with the data.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python gives them by name")]
pub(crate) fn measure<'py>(
    py: Python<'py>,
    stamps: &Bound<'py, PyAny>,
    star: Option<PyReadonlyArray2<'py, f64>>,
    stars: Option<&Bound<'py, PyAny>>,
    formulas: Option<PyReadonlyArray2<'py, f64>>,
    noise: Option<f64>,
    noises: Option<PyReadonlyArray1<'py, f64>>,
    submission: &Bound<'py, Configuration>,
    threads_asked: Option<u16>,
    progress: Option<Py<PyAny>>,
) -> PyResult<Measured<'py>> {
    let submission = &submission.get().entry.configuration;
    let stamps = Borrowed::new(stamps)?;
    let (count, rows, columns) = stamps.dim();
    let stamps = stamps.shared();
    let measurer = Measurer::new(submission, rows).map_err(of_measuring)?;
    let cut = submission.psf_cut();
    let least = cut.least;
    let stars = stars.map(Borrowed::new).transpose()?;
    let noise = match &noises {
        None => Noise::One(noise),
        Some(levels) => Noise::Each(levels.as_slice()?),
    };

    // A batch of no stamps finds all that is wrong with the request, before the work begins.
    let none = Array3::<f64>::zeros((0, rows, columns));
    let looked_at = match noise {
        Noise::One(None) => measurer.noise_plan().filter(|_| count > 0),
        Noise::One(Some(_)) | Noise::Each(_) => None,
    };
    let level = match noise {
        // It will be measured.
        Noise::One(None) if looked_at.is_some() => Some(1.0),
        Noise::One(level) => level,
        Noise::Each(levels) => Some(worst(levels)),
    };
    let look = |psfs: Psfs<'_>| {
        if rows != columns {
            return Err(MeasureError::Shape {
                what: "stamps",
                found: format!("{rows} × {columns} pixels"),
                expected: "squares".into(),
            });
        }
        measurer.batch(none.view(), &psfs, level).map(|_| ())
    };
    let mut moved = None;
    let psfs = match (star, &stars, formulas) {
        (Some(star), None, None) => {
            look(Psfs::star(star.as_array())).map_err(of_measuring)?;
            let found = shearq_measure::star(star.as_array(), cut).map_err(of_measuring)?;
            moved = found.moved;
            AllPsfs::Shared(found.psf.into_shared())
        }
        (None, Some(stars), None) => {
            let (given, rows, columns) = stars.dim();
            one_each("psf", given, count)?;
            if rows < least || columns < least {
                return Err(PyValueError::new_err(format!(
                    "psf: PSF stamps of {rows} × {columns} pixels; expected at least {least} × {least}, as submission {} needs",
                    submission.name
                )));
            }
            let none = Array3::<f64>::zeros((0, rows, columns));
            look(Psfs::stars(none)).map_err(of_measuring)?;
            AllPsfs::Stars(stars.shared())
        }
        (None, None, Some(formulas)) => {
            look(Psfs::functional(Vec::new())).map_err(of_measuring)?;
            let formulas = self::formulas(formulas.as_array()).map_err(of_measuring)?;
            match formulas.as_slice() {
                [one] => {
                    let psf = one.stamp_beside(cut.size, rows).into_shared();
                    look(Psfs::Prepared(psf.clone())).map_err(of_measuring)?;
                    AllPsfs::Shared(psf)
                }
                _ => {
                    one_each("psf", formulas.len(), count)?;
                    AllPsfs::Formulas(formulas)
                }
            }
        }
        _ => return Err(PyValueError::new_err("psf: expected one kind of PSFs")),
    };
    if let Noise::Each(levels) = noise {
        one_each("noise", levels.len(), count)?;
    }

    let survey = match looked_at {
        Some(plan) => look_at(plan, &stamps, count)?,
        None => None,
    };
    let mut galaxies = Vec::new();
    galaxies
        .try_reserve_exact(count)
        .map_err(|_| no_memory("the catalogue"))?;
    let failure = Failure::default();
    let mut watch = Watch::new(progress, &failure);
    let result = py.detach(|| {
        engine::ordered(
            threads(threads_asked),
            |feeder| {
                for start in (0..count).step_by(PIECE) {
                    let end = (start + PIECE).min(count);
                    let job = job(&stamps, &psfs, noise, start, end);
                    if !feeder.push(job.map_err(|error| failure.keep(error))?) {
                        break;
                    }
                }
                Ok(())
            },
            || measurer.worker(),
            |worker, job: Job<'_>| Ok(measure_job(worker, survey.as_ref(), &job)?),
            |measured: Vec<Measurement>| {
                watch.advance(measured.len())?;
                galaxies.extend(measured);
                Ok(())
            },
        )
        .and_then(|()| watch.tell())
    });
    failure.or(result)?;
    let mut galaxies = [galaxies];
    let response = calibrate(submission, &mut galaxies);
    let mut examination = examine(&stamps, count, rows)?;
    add_psfs(&mut examination, &psfs, count, moved, cut)?;
    let mut warnings = examination.warnings();
    if let Noise::One(Some(given)) = noise {
        warnings.extend(examination.given_noise(given));
    }
    warnings.extend(Warning::of_settings(submission));
    warnings.extend(Warning::of_flags(&galaxies));
    if let Some(fatal) = warnings.iter().position(Warning::is_fatal) {
        return Err(of_measuring(MeasureError::Data(
            warnings.swap_remove(fatal),
        )));
    }
    let warnings = warnings.iter().map(Warning::to_string).collect();
    Ok((catalogue(py, &galaxies[0])?, response, warnings))
}

/// Examines the PSF of all `count` stamps, which was `moved` to the middle of its stamp, or as many of those for one each as are
/// enough.
fn add_psfs(
    examination: &mut Examination,
    psfs: &AllPsfs<'_>,
    count: usize,
    moved: Option<[f64; 2]>,
    cut: PsfCut,
) -> PyResult<()> {
    match psfs {
        AllPsfs::Shared(psf) => examination.add_psf(psf.view(), moved),
        AllPsfs::Formulas(formulas) => {
            examination.add_psfs(&Psfs::functional(formulas), cut, EXAMINED_PSFS);
        }
        AllPsfs::Stars(_) => {
            let some = EXAMINED_PSFS.min(count);
            for at in (0..some).map(|k| (2 * k + 1) * count / (2 * some)) {
                examination.add_psfs(&psfs.piece(at, at + 1)?, cut, 1);
            }
        }
    }
    Ok(())
}

/// Examines as many of the stamps as are enough.
fn examine(stamps: &Stamps<'_>, count: usize, side: usize) -> PyResult<Examination> {
    let chosen = examined_rows(1, count);
    let mut examination = Examination::new(side, chosen.len());
    for at in chosen {
        match stamps.piece(at, at + 1)? {
            Piece::Single(one) => examination.add(one.index_axis(Axis(0), 0)),
            Piece::Double(one) => examination.add(one.index_axis(Axis(0), 0)),
            Piece::Copied(one) => examination.add(one.index_axis(Axis(0), 0)),
        }
        .map_err(of_measuring)?;
    }
    Ok(examination)
}

/// What the stamps tell of their image, from as many as are enough.
fn look_at(plan: &NoisePlan, stamps: &Stamps<'_>, count: usize) -> PyResult<Option<Arc<Survey>>> {
    let mut survey = plan.survey();
    for at in plan.rows(1, count) {
        match stamps.piece(at, at + 1)? {
            Piece::Single(one) => survey.add(one.index_axis(Axis(0), 0)),
            Piece::Double(one) => survey.add(one.index_axis(Axis(0), 0)),
            Piece::Copied(one) => survey.add(one.index_axis(Axis(0), 0)),
        }
        .map_err(of_measuring)?;
    }
    survey.shared().map_err(of_measuring)
}

/// The first level that is none, so that it is told; any where all are.
fn worst(levels: &[f64]) -> f64 {
    let bad = levels
        .iter()
        .find(|sigma| !(sigma.is_finite() && **sigma >= 0.0));
    bad.copied().unwrap_or(1.0)
}

/// Checks that there is one for each stamp.
fn one_each(argument: &str, found: usize, count: usize) -> PyResult<()> {
    if found == count {
        return Ok(());
    }
    Err(PyValueError::new_err(format!(
        "{argument}: {found} given; expected {count}, one for each stamp"
    )))
}

/// PSFs from rows of FWHM, e1, e2 and β.
fn formulas(rows: ArrayView2<'_, f64>) -> Result<Vec<FunctionalPsf>, MeasureError> {
    let formula = |row: ndarray::ArrayView1<'_, f64>| {
        let profile = match row[3] {
            beta if beta.is_nan() => PsfProfile::Kolmogorov,
            beta => PsfProfile::Moffat { beta },
        };
        Ok(FunctionalPsf::new(
            profile,
            row[0],
            Shear::new(row[1], row[2]),
        )?)
    };
    rows.outer_iter().map(formula).collect()
}

fn job<'a>(
    stamps: &Stamps<'a>,
    psfs: &'a AllPsfs<'a>,
    noise: Noise<'a>,
    start: usize,
    end: usize,
) -> PyResult<Job<'a>> {
    Ok(Job {
        stamps: stamps.piece(start, end)?,
        psfs: psfs.piece(start, end)?,
        noise: noise.piece(start, end),
    })
}

fn measure_job(
    worker: &mut Worker,
    survey: Option<&Arc<Survey>>,
    job: &Job<'_>,
) -> Result<Vec<Measurement>, MeasureError> {
    match &job.stamps {
        Piece::Single(stamps) => each(worker, survey, stamps.view(), job),
        Piece::Double(stamps) => each(worker, survey, stamps.view(), job),
        Piece::Copied(stamps) => each(worker, survey, stamps.view(), job),
    }
}

fn each<T: Pixel>(
    worker: &mut Worker,
    survey: Option<&Arc<Survey>>,
    stamps: ArrayView3<'_, T>,
    job: &Job<'_>,
) -> Result<Vec<Measurement>, MeasureError> {
    match job.noise {
        Noise::One(level) => {
            let mut image = worker.image(ImageNoise::of(survey, level));
            image.measure_each(stamps, &job.psfs)
        }
        Noise::Each(levels) => {
            let mut image = worker.image(ImageNoise::Unknown);
            image.measure_each_with_noise(stamps, &job.psfs, levels)
        }
    }
}

/// The columns of a catalogue, by name.
fn catalogue<'py>(py: Python<'py>, galaxies: &[Measurement]) -> PyResult<Bound<'py, PyDict>> {
    let columns = PyDict::new(py);
    let real = |name: &str, value: &dyn Fn(&Measurement) -> f64| {
        let values: Vec<f64> = galaxies.iter().map(value).collect();
        columns.set_item(name, values.into_pyarray(py))
    };
    let whole = |name: &str, value: &dyn Fn(&Measurement) -> i32| {
        let values: Vec<i32> = galaxies.iter().map(value).collect();
        columns.set_item(name, values.into_pyarray(py))
    };
    real("e1", &|g| g.e1)?;
    real("e2", &|g| g.e2)?;
    real("R11", &|g| g.response_diagonal()[0])?;
    real("R22", &|g| g.response_diagonal()[1])?;
    whole("flags", &|g| g.flags.bits() as i32)?;
    real("noise", &|g| g.noise)?;
    real("flux", &|g| g.flux)?;
    real("radius", &|g| g.radius)?;
    real("size", &|g| g.size)?;
    whole("iterations", &|g| {
        g.descent.map_or(0, |d| d.iterations as i32)
    })?;
    // −1 where the network did not run, as in the catalogues of the command line.
    whole("stop", &|g| g.descent.map_or(-1, |d| d.stop.code() as i32))?;
    whole("updated", &|g| g.descent.map_or(0, |d| d.updated as i32))?;
    real("first_energy", &|g| {
        g.descent.map_or(f64::NAN, |d| d.first_energy)
    })?;
    real("energy", &|g| g.descent.map_or(f64::NAN, |d| d.energy))?;
    Ok(columns)
}

/// Names, bits and meanings of the flags.
#[pyfunction]
pub(crate) fn flags() -> Vec<(String, u32, String)> {
    let flag = |flag: Flag| (format!("{flag:?}"), flag as u32, flag.to_string());
    Flag::ALL.map(flag).into()
}
