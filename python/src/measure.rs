//! Stamps and PSFs into calibrated ellipticities.

use std::sync::Arc;

use ndarray::{ArcArray2, Array3, ArrayView2, ArrayView3, Axis};
use numpy::{IntoPyArray, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_measure::{
    CommonProfile, EXAMINED_PSFS, Examination, Flag, FunctionalPsf, ImageNoise, MeanShear,
    MeanShearError, MeasureError, Measurement, Measurer, NoisePlan, NoiseSurvey, Pixel, PsfProfile,
    Psfs, ShearSum, StarSurvey, Subtraction, Survey, Warning, Worker, calibrate, examined_stamps,
};
use shearq_pipeline::engine;
use shearq_pipeline::measure::{COLUMNS, Value, more_columns, stated_psf_noise};
use shearq_quantities::Shear;
use shearq_quantities::statistics::upper_median;
use shearq_results::star_noise::{StarNoise, Stars};

use crate::errors::{no_memory, of_measuring};
use crate::stamps::{Borrowed, Piece, Stamps};
use crate::submissions::Configuration;
use crate::work::{Failure, Watch, threads};

/// Stamps that a worker takes at a time: enough that handing them out costs nothing, and few enough that copies of them
/// are small.
const PIECE: usize = 64;

/// PSFs of all stamps.
enum AllPsfs<'a> {
    Shared {
        psf: ArcArray2<f64>,
        /// Offset of a star in pixels, if it was moved to the centre.
        moved: Option<[f64; 2]>,
    },
    Stars(Stamps<'a>),
    Formulas(Vec<FunctionalPsf>),
}

impl AllPsfs<'_> {
    /// PSFs of the stamps from `start` to before `end`.
    fn piece(&self, start: usize, end: usize) -> PyResult<Psfs<'_>> {
        Ok(match self {
            AllPsfs::Shared { psf, .. } => Psfs::Prepared(psf.clone()),
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

    /// A level that is wrong if any is.
    fn worst(self) -> Option<f64> {
        match self {
            Noise::One(level) => level,
            Noise::Each(levels) => {
                let wrong = |sigma: &&f64| !(sigma.is_finite() && **sigma >= 0.0);
                Some(levels.iter().find(wrong).copied().unwrap_or(1.0))
            }
        }
    }
}

/// Some stamps with all that is needed to measure them.
struct Job<'s, 'p> {
    stamps: Piece<'s>,
    psfs: Psfs<'p>,
    noise: Noise<'s>,
}

/// A request to measure stamps, without their PSFs.
struct Request<'a> {
    measurer: &'a Measurer,
    stamps: Stamps<'a>,
    /// Number of stamps, rows and columns.
    dim: (usize, usize, usize),
    noise: Noise<'a>,
}

/// The catalogue, the warnings, and an error if all galaxies are flagged.
type Measured<'py> = (Bound<'py, PyDict>, Vec<String>, Option<String>);

/// Measures stamps `(n, ny, nx)`.
///
/// PSFs are one star stamp for all, star stamps one per galaxy, or formulas (FWHM, e1, e2 and β, which is NaN for
/// Kolmogorov), one for all or one per galaxy. The noise is one level for all or one per stamp. Without any, the
/// configuration measures it on the stamps. Returns the columns of the catalogue, the warnings, and an error if all
/// galaxies are flagged.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python passes them by name")]
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
    let configuration = &submission.get().entry.configuration;
    let stamps = Borrowed::new(stamps)?;
    let (count, rows, _) = stamps.dim();
    let measurer = Measurer::new(configuration, rows).map_err(of_measuring)?;
    let stars = stars.map(Borrowed::new).transpose()?;
    let request = Request {
        measurer: &measurer,
        stamps: stamps.shared(),
        dim: stamps.dim(),
        noise: match &noises {
            None => Noise::One(noise),
            Some(levels) => Noise::Each(levels.as_slice()?),
        },
    };
    let psfs = match (star, &stars, formulas) {
        (Some(star), None, None) => request.star(&star),
        (None, Some(stars), None) => request.stars(stars),
        (None, None, Some(formulas)) => request.formulas(&formulas),
        _ => Err(PyValueError::new_err("psf: expected one kind of PSFs")),
    }?;
    if let Noise::Each(levels) = request.noise {
        one_each("noise", levels.len(), count)?;
    }
    let survey = request.survey()?;
    let known = Known {
        survey: survey.as_ref(),
        stars: request.stars_in_common(&psfs)?,
    };
    let galaxies = request.measure(py, &psfs, &known, threads(threads_asked), progress)?;
    let mut galaxies = [galaxies];
    calibrate(configuration, &mut galaxies);
    let subtraction = measurer.subtraction(survey.as_deref());
    let examination = request.examine(&psfs, subtraction)?;
    let warnings = request.warnings(&examination, &galaxies)?;
    let [galaxies] = galaxies;
    let flagged = galaxies.iter().filter(|g| !g.flags.is_empty()).count();
    let all_flagged = (count > 0 && flagged == count)
        .then(|| Warning::of_flags(&[galaxies.as_slice()]))
        .flatten()
        .map(|warning| format!("stamps: no galaxy could be measured: {warning}"));
    let warnings = warnings.iter().map(Warning::to_string).collect();
    let columns = catalogue(py, configuration, &galaxies)?;
    if configuration.linear().is_some() {
        let effect = stated_psf_noise(configuration, examination.psf_noise());
        let [m, c] = effect.unwrap_or_default();
        for (name, value) in [("psf_m", m), ("psf_c", c)] {
            columns.set_item(name, vec![value; count].into_pyarray(py))?;
        }
    }
    Ok((columns, warnings, all_flagged))
}

impl<'s> Request<'s> {
    /// The plan for measuring the noise on the stamps, unless it is given.
    fn noise_plan(&self) -> Option<&NoisePlan> {
        match self.noise {
            Noise::One(None) => self.measurer.noise_plan().filter(|_| self.dim.0 > 0),
            Noise::One(Some(_)) | Noise::Each(_) => None,
        }
    }

    /// Checks stamps, PSFs and noise before the work begins: a batch of no stamps has the same errors.
    fn check(&self, psfs: Psfs<'_>) -> PyResult<()> {
        let (_, rows, columns) = self.dim;
        if rows != columns {
            return Err(of_measuring(MeasureError::Shape {
                what: "stamps",
                found: format!("{rows} × {columns} pixels"),
                expected: "squares".into(),
            }));
        }
        let none = Array3::<f64>::zeros((0, rows, columns));
        // A noise that will be measured has any level.
        let measured = self.noise_plan().map(|_| 1.0);
        let level = measured.or_else(|| self.noise.worst());
        let found = self.measurer.batch(none.view(), &psfs, level);
        found.map(|_| ()).map_err(of_measuring)
    }

    fn star<'p>(&self, star: &PyReadonlyArray2<'_, f64>) -> PyResult<AllPsfs<'p>> {
        self.check(Psfs::star(star.as_array()))?;
        let cut = self.measurer.configuration().psf_cut();
        let found = shearq_measure::star(star.as_array(), cut).map_err(of_measuring)?;
        Ok(AllPsfs::Shared {
            psf: found.psf.into_shared(),
            moved: found.moved,
        })
    }

    fn stars<'p>(&self, stars: &'p Borrowed<'_>) -> PyResult<AllPsfs<'p>> {
        let (given, rows, columns) = stars.dim();
        one_each("psf", given, self.dim.0)?;
        let configuration = self.measurer.configuration();
        let least = configuration.psf_cut().least;
        if rows < least || columns < least {
            return Err(PyValueError::new_err(format!(
                "psf: PSF stamps of {rows} × {columns} pixels; expected at least {least} × {least}, as the configuration {} requires",
                configuration.name
            )));
        }
        self.check(Psfs::stars(Array3::<f64>::zeros((0, rows, columns))))?;
        Ok(AllPsfs::Stars(stars.shared()))
    }

    fn formulas<'p>(&self, rows: &PyReadonlyArray2<'_, f64>) -> PyResult<AllPsfs<'p>> {
        self.check(Psfs::functional(Vec::new()))?;
        let formulas = formulas(rows.as_array()).map_err(of_measuring)?;
        let [one] = formulas.as_slice() else {
            one_each("psf", formulas.len(), self.dim.0)?;
            return Ok(AllPsfs::Formulas(formulas));
        };
        let cut = self.measurer.configuration().psf_cut();
        let psf = one.stamp_beside(cut.size, self.dim.1).into_shared();
        self.check(Psfs::Prepared(psf.clone()))?;
        Ok(AllPsfs::Shared { psf, moved: None })
    }

    /// Noise and galaxy sizes, measured on some of the stamps if the noise is not given.
    fn survey(&self) -> PyResult<Option<Arc<Survey>>> {
        let Some(plan) = self.noise_plan() else {
            return Ok(None);
        };
        let mut survey = self.look(plan, plan.survey())?;
        if let Some(again) = survey.without_sky() {
            survey = self.look(plan, again)?;
        }
        survey.shared().map_err(of_measuring)
    }

    /// Adds the stamps that `plan` chooses to a survey.
    fn look(&self, plan: &NoisePlan, mut survey: NoiseSurvey) -> PyResult<NoiseSurvey> {
        for at in plan.stamps(self.dim.0) {
            match self.stamps.piece(at, at + 1)? {
                Piece::Single(one) => survey.add(one.index_axis(Axis(0), 0)),
                Piece::Double(one) => survey.add(one.index_axis(Axis(0), 0)),
                Piece::Copied(one) => survey.add(one.index_axis(Axis(0), 0)),
            }
            .map_err(of_measuring)?;
        }
        Ok(survey)
    }

    /// What noisy stars, one per galaxy, have in common, from some of them.
    fn stars_in_common(&self, psfs: &AllPsfs<'_>) -> PyResult<Option<Arc<CommonProfile>>> {
        let (AllPsfs::Stars(_), Some(mut looker)) = (psfs, self.measurer.star_looker()) else {
            return Ok(None);
        };
        let mut survey = StarSurvey::default();
        for at in examined_stamps(self.dim.0) {
            survey.add(looker.look(&psfs.piece(at, at + 1)?, 0));
            if survey.is_over() {
                break;
            }
        }
        Ok(survey.common())
    }

    /// Measures all galaxies, without calibration.
    fn measure(
        &self,
        py: Python<'_>,
        psfs: &AllPsfs<'_>,
        known: &Known<'_>,
        threads: usize,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Vec<Measurement>> {
        let count = self.dim.0;
        let mut galaxies = Vec::new();
        galaxies
            .try_reserve_exact(count)
            .map_err(|_| no_memory("the catalogue"))?;
        let failure = Failure::default();
        let mut watch = Watch::new(progress, &failure);
        let result = py.detach(|| {
            engine::ordered(
                threads,
                |feeder| {
                    for start in (0..count).step_by(PIECE) {
                        let job = self.job(psfs, start, (start + PIECE).min(count));
                        if !feeder.push(job.map_err(|error| failure.keep(error))?) {
                            break;
                        }
                    }
                    Ok(())
                },
                || self.measurer.worker(),
                |worker, job: Job<'_, '_>| Ok(measure_job(worker, known, &job)?),
                |measured: Vec<Measurement>| {
                    watch.advance(measured.len())?;
                    galaxies.extend(measured);
                    Ok(())
                },
            )
            .and_then(|()| watch.report())
        });
        failure.or(result)?;
        Ok(galaxies)
    }

    fn job<'p>(&self, psfs: &'p AllPsfs<'_>, start: usize, end: usize) -> PyResult<Job<'s, 'p>> {
        Ok(Job {
            stamps: self.stamps.piece(start, end)?,
            psfs: psfs.piece(start, end)?,
            noise: self.noise.piece(start, end),
        })
    }

    /// The warnings about stamps and PSFs.
    fn warnings(
        &self,
        examination: &Examination,
        galaxies: &[Vec<Measurement>],
    ) -> PyResult<Vec<Warning>> {
        let configuration = self.measurer.configuration();
        let mut warnings = examination.warnings();
        warnings.extend(self.given_noise(examination)?);
        warnings.extend(Warning::of_settings(configuration));
        warnings.extend(Warning::of_galaxies(galaxies));
        match warnings.iter().position(Warning::is_fatal) {
            Some(fatal) => Err(of_measuring(MeasureError::Data(
                warnings.swap_remove(fatal),
            ))),
            None => Ok(warnings),
        }
    }

    /// Examines some of the stamps and PSFs.
    fn examine(&self, psfs: &AllPsfs<'_>, subtraction: Subtraction) -> PyResult<Examination> {
        let (count, side, _) = self.dim;
        let chosen = examined_stamps(count);
        let mut examination = Examination::new(side, chosen.len()).without(subtraction);
        for at in chosen {
            match self.stamps.piece(at, at + 1)? {
                Piece::Single(one) => examination.add(one.index_axis(Axis(0), 0)),
                Piece::Double(one) => examination.add(one.index_axis(Axis(0), 0)),
                Piece::Copied(one) => examination.add(one.index_axis(Axis(0), 0)),
            }
            .map_err(of_measuring)?;
        }
        let cut = self.measurer.configuration().psf_cut();
        match psfs {
            AllPsfs::Shared { psf, moved } => examination.add_psf(psf.view(), *moved),
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
        Ok(examination)
    }

    /// A warning if the given noise disagrees with the stamps. Stamps with levels of their own are examined in units of
    /// their levels, and the warning states the median level.
    fn given_noise(&self, examination: &Examination) -> PyResult<Option<Warning>> {
        let levels = match self.noise {
            Noise::One(level) => {
                return Ok(level.and_then(|level| examination.given_noise(level)));
            }
            Noise::Each(levels) => levels,
        };
        let (count, side, _) = self.dim;
        let chosen = examined_stamps(count);
        let mut positive: Vec<f64> = chosen.iter().map(|&at| levels[at]).collect();
        positive.retain(|level| *level > 0.0);
        let Some(median) = upper_median(&mut positive) else {
            return Ok(None);
        };
        let mut scaled = Examination::new(side, chosen.len());
        for at in chosen.into_iter().filter(|&at| levels[at] > 0.0) {
            let scale = median / levels[at];
            let stamp = match self.stamps.piece(at, at + 1)? {
                Piece::Single(one) => one.mapv(|value| f64::from(value) * scale),
                Piece::Double(one) => one.mapv(|value| value * scale),
                Piece::Copied(one) => one * scale,
            };
            let added = scaled.add(stamp.index_axis(Axis(0), 0));
            added.map_err(of_measuring)?;
        }
        Ok(scaled.given_noise(median))
    }
}

/// What is known of all galaxies before they are measured.
struct Known<'a> {
    survey: Option<&'a Arc<Survey>>,
    stars: Option<Arc<CommonProfile>>,
}

fn measure_job(
    worker: &mut Worker,
    known: &Known<'_>,
    job: &Job<'_, '_>,
) -> Result<Vec<Measurement>, MeasureError> {
    match &job.stamps {
        Piece::Single(stamps) => each(worker, known, stamps.view(), job),
        Piece::Double(stamps) => each(worker, known, stamps.view(), job),
        Piece::Copied(stamps) => each(worker, known, stamps.view(), job),
    }
}

fn each<T: Pixel>(
    worker: &mut Worker,
    known: &Known<'_>,
    stamps: ArrayView3<'_, T>,
    job: &Job<'_, '_>,
) -> Result<Vec<Measurement>, MeasureError> {
    match job.noise {
        Noise::One(level) => {
            let noise = ImageNoise::of(known.survey, level);
            let mut image = worker.image_with_stars(noise, known.stars.as_ref());
            image.measure_each(stamps, &job.psfs)
        }
        Noise::Each(levels) => {
            let mut image = worker.image_with_stars(ImageNoise::Unknown, known.stars.as_ref());
            image.measure_each_with_noise(stamps, &job.psfs, levels)
        }
    }
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

/// The columns of a catalogue, by name.
fn catalogue<'py>(
    py: Python<'py>,
    configuration: &shearq_submissions::Configuration,
    galaxies: &[Measurement],
) -> PyResult<Bound<'py, PyDict>> {
    let columns = PyDict::new(py);
    for (name, value) in COLUMNS {
        match value {
            Value::Real(of) => {
                let values: Vec<f64> = galaxies.iter().map(of).collect();
                columns.set_item(name, values.into_pyarray(py))?;
            }
            Value::Whole(of) => {
                let values: Vec<i32> = galaxies.iter().map(of).collect();
                columns.set_item(name, values.into_pyarray(py))?;
            }
        }
    }
    let galaxies: Vec<&Measurement> = galaxies.iter().collect();
    for (name, values) in more_columns(configuration, &galaxies) {
        columns.set_item(name, values.into_pyarray(py))?;
    }
    Ok(columns)
}

/// The mean shear: g1 and g2, their covariance, the mean responses R11 and R22, R12 and R21, and the number of galaxies.
type Mean = ([f64; 2], [[f64; 2]; 2], [f64; 2], [f64; 2], usize);

/// The mean shear of galaxies without flags from columns e1, e2, (R11, R22, R12, R21) and weights of one length. The covariance
/// contains the noise of `stars`, which are numbers with the scatter of m and of c; `places` has the place of each galaxy's
/// star among them.
#[pyfunction]
pub(crate) fn mean_shear(
    e1: PyReadonlyArray1<'_, f64>,
    e2: PyReadonlyArray1<'_, f64>,
    responses: [PyReadonlyArray1<'_, f64>; 4],
    weights: PyReadonlyArray1<'_, f64>,
    stars: Vec<[f64; 3]>,
    places: PyReadonlyArray1<'_, i64>,
) -> PyResult<Mean> {
    let mut sum = ShearSum::default();
    let mut shares = vec![[0.0; 2]; stars.len()];
    let e = e1.as_slice()?.iter().zip(e2.as_slice()?);
    let weighted = weights.as_slice()?.iter().zip(places.as_slice()?);
    let [r11, r22, r12, r21] = &responses;
    let own = r11.as_slice()?.iter().zip(r22.as_slice()?);
    let other = r12.as_slice()?.iter().zip(r21.as_slice()?);
    for (((&e1, &e2), ((&r11, &r22), (&r12, &r21))), (&weight, &place)) in
        e.zip(own.zip(other)).zip(weighted)
    {
        sum.add([e1, e2], [[r11, r12], [r21, r22]], weight);
        shares[place as usize][0] += weight * r11;
        shares[place as usize][1] += weight * r22;
    }
    let mut noise = Stars::default();
    for ([star, m, c], share) in stars.into_iter().zip(shares) {
        let star = format!("{star:.0}");
        noise.add(Some(StarNoise { star, m, c }), share);
    }
    let MeanShear {
        shear,
        mut covariance,
        response,
        cross_response,
        galaxies,
        ..
    } = sum.mean().map_err(|error| {
        let argument = match error {
            MeanShearError::Response { component, .. } => format!("R{component}{component}"),
            MeanShearError::Singular { .. } => "R11, R22, R12, R21".into(),
            _ => "weights".into(),
        };
        PyValueError::new_err(format!("{argument}: {error}"))
    })?;
    for (k, error) in noise.errors(shear).into_iter().enumerate() {
        covariance[k][k] += error * error;
    }
    Ok((shear, covariance, response, cross_response, galaxies))
}

/// Names, bits and meanings of the flags.
#[pyfunction]
pub(crate) fn flags() -> Vec<(String, u32, String)> {
    let flag = |flag: Flag| (format!("{flag:?}"), flag as u32, flag.to_string());
    Flag::ALL.map(flag).into()
}
