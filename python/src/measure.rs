//! Stamps and PSFs into calibrated ellipticities.

use std::ops::Range;
use std::sync::Arc;

use ndarray::{Array3, ArrayView2};
use numpy::{IntoPyArray, PyArray3, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_catalogue::star_noise::{StarNoise, Stars};
use shearq_measure::{
    ArraySource, Batch, Detector, Flag, FunctionalPsf, Jacobian, JacobianError, KnownNoise,
    MeanShear, MeanShearError, MeasureError, Measurement, Measurer, Oversampling, PsfProfile, Psfs,
    Session, ShearSum, Star, Warning,
};
use shearq_pipeline::PipelineError;
use shearq_pipeline::measure::{
    COLUMNS, ImageRow, Measured, Value, measure_images, more_columns, settings_for_small_stamps,
};
use shearq_quantities::Shear;

use crate::errors::of_measuring;
use crate::stamps::{Borrowed, Stamps};
use crate::submissions::Configuration;
use crate::work::{Failure, Watch, threads};

enum AllPsfs<'a> {
    Shared(Arc<Star>),
    Stars(Stamps<'a>),
    Formulas(Vec<FunctionalPsf>),
}

impl<'a> AllPsfs<'a> {
    // Rows of the image are read one after another, so that converted stars are not in memory all at once.
    fn slice(&self, range: Range<usize>) -> PyResult<Psfs<'a>> {
        Ok(match self {
            AllPsfs::Shared(psf) => Psfs::Prepared(psf.clone()),
            AllPsfs::Stars(stars) => Psfs::Stars(stars.slice(range)?),
            AllPsfs::Formulas(formulas) => Psfs::functional(formulas[range].to_vec()),
        })
    }
}

// The columns, the warnings, an error if all galaxies are flagged, and the frame. The Python package decides about the error,
// after it has issued the warnings that explain it.
type Catalogue<'py> = (Bound<'py, PyDict>, Vec<String>, Option<String>, String);

/// One image: stamps `(n, ny, nx)`, with offsets of the galaxies from their centres for epochs.
///
/// PSFs are one star stamp for all, star stamps one per galaxy, or formulas (FWHM, e1, e2 and β, which is NaN for
/// Kolmogorov), one for all or one per galaxy. The noise is one level for all or one per stamp. Without any, the
/// configuration measures it on the stamps. Jacobians (n, 2, 2), one for all or one per galaxy, are for the frame of the sky.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct Image<'py> {
    stamps: Bound<'py, PyAny>,
    star: Option<PyReadonlyArray2<'py, f64>>,
    stars: Option<Bound<'py, PyAny>>,
    formulas: Option<PyReadonlyArray2<'py, f64>>,
    noise: Option<f64>,
    noises: Option<PyReadonlyArray1<'py, f64>>,
    /// Whether the levels of single stamps are those of maps, beside which the correlation of the noise is measured.
    stated: bool,
    jacobians: Option<PyReadonlyArray3<'py, f64>>,
    offsets: Option<PyReadonlyArray2<'py, f64>>,
    /// Electrons per unit and the level of saturation that the header of the stamps states.
    detector: (Option<f64>, Option<f64>),
}

/// The arrays of an image, which its source borrows.
struct Arrays<'py> {
    stamps: Borrowed<'py>,
    stars: Option<Borrowed<'py>>,
}

type Source<'a> = (ArraySource<'a, PipelineError>, KnownNoise<'a>);

fn source<'a>(
    image: &'a Image<'_>,
    arrays: &'a Arrays<'_>,
    measurer: &Measurer,
    failed: &'a Failure,
) -> PyResult<Source<'a>> {
    let (count, rows, _) = arrays.stamps.dim();
    if rows != measurer.full() {
        return Err(PyValueError::new_err(format!(
            "epochs: stamps of {rows} px a side; expected {}, as the first epoch has",
            measurer.full()
        )));
    }
    let psfs = match (&image.star, &arrays.stars, &image.formulas) {
        // Cut once here, not once per row.
        (Some(star), None, None) => Star::cut(star.as_array(), measurer.configuration().psf_cut())
            .map(|star| AllPsfs::Shared(Arc::new(star)))
            .map_err(of_measuring),
        (None, Some(stars), None) => star_of_each(measurer, stars, count),
        (None, None, Some(formulas)) => formula_psfs(measurer, formulas.as_array(), count),
        _ => Err(PyValueError::new_err("psf: expected one kind of PSFs")),
    }?;
    let noise = match (&image.noises, image.noise) {
        (Some(levels), _) if image.stated => KnownNoise::StatedEach(levels.as_slice()?.into()),
        (Some(levels), _) => KnownNoise::GivenEach(levels.as_slice()?.into()),
        (None, Some(level)) => KnownNoise::Given(level),
        (None, None) => KnownNoise::Unknown,
    };
    let jacobians = image.jacobians.as_ref().map(|array| {
        let matrices = array.as_array();
        let matrices = matrices
            .outer_iter()
            .map(|m| [[m[(0, 0)], m[(0, 1)]], [m[(1, 0)], m[(1, 1)]]]);
        let each: Result<Vec<_>, JacobianError> = matrices.map(Jacobian::new).collect();
        each.map_err(|error| PyValueError::new_err(format!("wcs: {error}")))
    });
    let jacobians = jacobians.transpose()?;
    let (is_shared, moved) = match psfs {
        AllPsfs::Shared(ref star) => (true, star.moved),
        AllPsfs::Stars(_) | AllPsfs::Formulas(_) => (false, None),
    };
    let stamps = arrays.stamps.shared();
    let mut source = ArraySource::from_fn(
        count,
        move |range| stamps.slice(range).map_err(|error| failed.keep(error)),
        move |range| psfs.slice(range).map_err(|error| failed.keep(error)),
        moved,
    );
    let (gain, saturation) = image.detector;
    source = source.with_detector(Detector { gain, saturation });
    if is_shared {
        source = source.with_shared_psf();
    }
    if let Some(jacobians) = jacobians {
        source = source.with_jacobians(jacobians).map_err(of_measuring)?;
    }
    if let Some(offsets) = &image.offsets {
        let rows = offsets.as_array();
        let each: Vec<[f64; 2]> = rows.outer_iter().map(|row| [row[0], row[1]]).collect();
        source = source.with_offsets(each).map_err(of_measuring)?;
    }
    Ok((source, noise))
}

/// PSFs (n, y, x) on finer pixels, integrated over pixels of the galaxies.
#[pyfunction]
pub(crate) fn psfs_from_oversampled<'py>(
    py: Python<'py>,
    fine: PyReadonlyArray3<'py, f64>,
    factor: usize,
) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let fine = fine.as_array();
    let (count, rows, columns) = fine.dim();
    let oversampling = Oversampling::new((rows, columns), factor).map_err(of_measuring)?;
    let mut psfs = Array3::zeros((count, rows / factor, columns / factor));
    for (fine, mut psf) in fine.outer_iter().zip(psfs.outer_iter_mut()) {
        psf.assign(&oversampling.psf(fine));
    }
    Ok(psfs.into_pyarray(py))
}

/// Measures the galaxies of an image, or of several whose stamps are epochs of the same galaxies.
///
/// Returns the columns of the catalogue, the warnings, an error if all galaxies are flagged, and the frame.
#[pyfunction]
pub(crate) fn measure<'py>(
    py: Python<'py>,
    images: Vec<Image<'py>>,
    submission: &Bound<'py, Configuration>,
    threads_asked: Option<u16>,
    progress: Option<Py<PyAny>>,
) -> PyResult<Catalogue<'py>> {
    let configuration = &submission.get().entry.configuration;
    let borrowed = images.iter().map(|image| {
        Ok(Arrays {
            stamps: Borrowed::new(&image.stamps)?,
            stars: image.stars.as_ref().map(Borrowed::new).transpose()?,
        })
    });
    let arrays: Vec<Arrays<'_>> = borrowed.collect::<PyResult<_>>()?;
    let (count, rows, _) = arrays.first().map_or((0, 0, 0), |first| first.stamps.dim());
    let least = configuration.stamp.size;
    if rows < least {
        let lines = settings_for_small_stamps(rows, configuration);
        return Err(PyValueError::new_err(format!(
            "stamps: stamps of {rows} × {rows} pixels; expected at least {least} × {least}, as configuration {} needs. Try: submission=\"\"\"\n{lines}\n\"\"\"",
            configuration.name
        )));
    }
    let measurer = Measurer::new(configuration, rows).map_err(of_measuring)?;
    let failure = Failure::default();
    let sources = images.iter().zip(&arrays);
    let sources: Vec<Source<'_>> = sources
        .map(|(image, arrays)| source(image, arrays, &measurer, &failure))
        .collect::<PyResult<_>>()?;
    let watch = Watch::new(progress, &failure);
    let threads = threads(threads_asked);
    let measured = py.detach(|| measured(&measurer, sources, threads, watch));
    let batch = failure.or(measured)?;
    let all_flagged = batch
        .all_flagged()
        .map(|warning| format!("stamps: no galaxy could be measured: {warning}"));
    let warnings = batch.warnings.iter().map(Warning::to_string).collect();
    let columns = catalogue(py, configuration, &batch.galaxies)?;
    // A column although it is one number per call: tables of several images can then be concatenated.
    if configuration.linear().is_some() {
        let [m, c] = batch.psf_noise.unwrap_or_default();
        for (name, value) in [("psf_m", m), ("psf_c", c)] {
            columns.set_item(name, vec![value; count].into_pyarray(py))?;
        }
    }
    Ok((columns, warnings, all_flagged, batch.frame.to_string()))
}

// By the same engine as the command line, so that arrays and files have equal results.
fn measured<'a>(
    measurer: &Measurer,
    images: Vec<Source<'a>>,
    threads: usize,
    mut watch: Watch<'_>,
) -> Result<Batch, PipelineError> {
    let mut whole: Option<Batch> = None;
    measure_images(
        threads,
        std::slice::from_ref(measurer),
        |feeder| {
            let (mut sources, mut sessions) = (Vec::new(), Vec::new());
            for (mut source, noise) in images {
                sessions.push(Session::open(measurer, &mut source, noise, feeder.ahead())?);
                sources.push(source);
            }
            let Some((own, others)) = sources.split_first_mut() else {
                return Ok(());
            };
            let first = sessions.remove(0).with_epochs(sessions)?;
            let (first, head) = (Arc::new(first), Arc::new(()));
            for row in 0..first.rows().len() {
                let row = ImageRow {
                    head: Arc::clone(&head),
                    jobs: vec![first.read_epochs(own, others, row)?],
                };
                if !feeder.push(row) {
                    break;
                }
            }
            Ok(())
        },
        |measured| match measured {
            Measured::Galaxies(count) => watch.advance(count),
            Measured::Image((), batches) => {
                whole = batches.into_iter().next();
                Ok(())
            }
        },
    )?;
    watch.report()?;
    // Without stamps there is no row, and no image was finished.
    Ok(whole.unwrap_or_default().checked()?)
}

// Sizes are checked before the work, which would flag each galaxy with `BadPsf`.
fn star_of_each<'a>(
    measurer: &Measurer,
    stars: &'a Borrowed<'_>,
    count: usize,
) -> PyResult<AllPsfs<'a>> {
    let (given, rows, columns) = stars.dim();
    one_each("psf", given, count)?;
    let configuration = measurer.configuration();
    let least = configuration.psf_cut().least;
    if rows < least || columns < least {
        // The linear method requires one parity.
        let size = rows.min(columns) - (least - rows.min(columns)) % 2;
        return Err(PyValueError::new_err(format!(
            "psf: PSF stamps of {rows} × {columns} pixels; expected at least {least} × {least}, as the configuration {} requires. Try: larger PSF stamps, or, if no light is beyond them, submission={{\"extends\": \"{}\", \"psf\": {{\"size\": {size}}}}}",
            configuration.name, configuration.name
        )));
    }
    Ok(AllPsfs::Stars(stars.shared()))
}

fn formula_psfs<'a>(
    measurer: &Measurer,
    rows: ArrayView2<'_, f64>,
    count: usize,
) -> PyResult<AllPsfs<'a>> {
    let formulas = formulas(rows).map_err(of_measuring)?;
    let [one] = formulas.as_slice() else {
        one_each("psf", formulas.len(), count)?;
        return Ok(AllPsfs::Formulas(formulas));
    };
    let size = measurer.configuration().psf_cut().size;
    let psf = one.stamp_beside(size, measurer.full());
    Ok(AllPsfs::Shared(Arc::new(psf.into())))
}

fn one_each(argument: &str, found: usize, count: usize) -> PyResult<()> {
    if found == count {
        return Ok(());
    }
    Err(PyValueError::new_err(format!(
        "{argument}: {found} given; expected {count}, one for each stamp"
    )))
}

// Rows are FWHM, e1, e2 and β, with NaN for Kolmogorov.
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

// The list of columns is the pipeline's, so that files and arrays have the same ones.
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
    for (name, values) in more_columns(configuration, galaxies) {
        columns.set_item(name, values.into_pyarray(py))?;
    }
    Ok(columns)
}

// g1 and g2, their covariance, the mean R11 and R22, R12 and R21, and the number of galaxies.
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
    let (e1, e2, weights) = (e1.as_array(), e2.as_array(), weights.as_array());
    let [r11, r22, r12, r21] = responses.each_ref().map(|column| column.as_array());
    for (k, &place) in places.as_array().iter().enumerate() {
        let weight = weights[k];
        let response = [[r11[k], r12[k]], [r21[k], r22[k]]];
        sum.add([e1[k], e2[k]], response, weight);
        shares[place as usize][0] += weight * r11[k];
        shares[place as usize][1] += weight * r22[k];
    }
    // Galaxies behind one star share its noise, so that their errors do not average: each star adds with its share of the response.
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
