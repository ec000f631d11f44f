//! Ellipticities on a grid into spectra and metrics of merit.

use std::path::PathBuf;

use ndarray::{Array2, ArrayView1};
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray1, ToPyArray};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_catalogue::foreign;
use shearq_catalogue::galaxies::{CalibrationSums, Galaxies};
use shearq_catalogue::request::{Placed, Request};
use shearq_dataset::truth::{Sign, SignFault, word};
use shearq_files::FileError;
use shearq_files::table::MAX_ROWS;
use shearq_quantities::units::{Degrees, Pixels};
use shearq_quantities::{MeasuredRange, Shear};
use shearq_results::views::scores;
use shearq_scoring::aperture::{Lattice, LatticeShear};
use shearq_scoring::modes::Decomposer;
use shearq_scoring::resample::{PairedSet, paired_difference};
use shearq_scoring::{
    AddedImages, BINS, Bins, Choice, Convention, Definition, Fault, FieldSum, Grid, Metrics, Noise,
    Options, Row, SCORED, ScoredImages, SetScore, SetSession, TrueShear, TruthSign,
    sign_by_correlation, sign_by_modes,
};

use crate::bias::{Given, names_of, of_bias, shapes_of, sign_of};
use crate::errors::{chosen, of_scoring};

/// Names, headings and meanings of the metrics.
#[pyfunction]
pub(crate) fn metrics() -> Vec<(&'static str, &'static str, &'static str)> {
    let metrics = Metrics::ALL.iter();
    metrics
        .map(|metric| (metric.name, metric.heading, metric.meaning))
        .collect()
}

fn grid(n: usize, stamp: f64, field_degrees: f64) -> PyResult<Grid> {
    Grid::new(n, Pixels(stamp), Degrees(field_degrees)).map_err(of_scoring)
}

fn definition(name: &str) -> PyResult<Definition> {
    chosen("definition", name, r#""leaderboard" or "corrected""#)
}

fn choice(name: &str) -> PyResult<Choice> {
    name.parse().map_err(|expected| {
        PyValueError::new_err(format!("convention: found {name:?}, {expected}"))
    })
}

type Pair<'py> = (PyReadonlyArray1<'py, f64>, PyReadonlyArray1<'py, f64>);

// Images one after the other, `lengths` rows each. Without positions, rows are in the order of the grid.
struct Rows<'a> {
    e1: ArrayView1<'a, f64>,
    e2: ArrayView1<'a, f64>,
    positions: Option<(ArrayView1<'a, f64>, ArrayView1<'a, f64>)>,
    weights: Option<ArrayView1<'a, f64>>,
    lengths: Vec<usize>,
}

impl<'a> Rows<'a> {
    fn new(e: &'a Pair<'_>, positions: Option<&'a Pair<'_>>, lengths: Vec<usize>) -> Self {
        Rows {
            e1: e.0.as_array(),
            e2: e.1.as_array(),
            positions: positions.map(|(x, y)| (x.as_array(), y.as_array())),
            weights: None,
            lengths,
        }
    }

    // One image on the grid at a time: all images of a set would take gigabytes.
    fn add_up<'s>(&self, session: &'s SetSession) -> PyResult<AddedImages<'s>> {
        // The sum is checked for overflow, because the lengths come from the caller and index the arrays below.
        let count = self.e1.len();
        let fits = self
            .lengths
            .iter()
            .try_fold(0usize, |sum, n| sum.checked_add(*n))
            == Some(count)
            && self.e2.len() == count
            && self
                .positions
                .is_none_or(|(x, y)| x.len() == count && y.len() == count)
            && self.weights.is_none_or(|weights| weights.len() == count);
        if !fits {
            return Err(PyValueError::new_err(
                "e1, e2, positions: lengths that differ",
            ));
        }
        let grid = session.grid();
        let mut images = session.begin();
        let mut start = 0;
        for length in &self.lengths {
            let mut sum = FieldSum::new(grid);
            let counts = sum.add_weighted(
                grid,
                (0..*length).map(|k| {
                    let (x, y) = match self.positions {
                        Some((x, y)) => (x[start + k], y[start + k]),
                        None => grid.centre(k % grid.n, k / grid.n),
                    };
                    let (e1, e2) = (self.e1[start + k], self.e2[start + k]);
                    let weight = self.weights.map_or(1.0, |weights| weights[start + k]);
                    (Row { x, y, e1, e2 }, weight)
                }),
            );
            session
                .examine(sum, counts)
                .and_then(|image| images.add(&image))
                .map_err(of_scoring)?;
            start += length;
        }
        Ok(images)
    }

    // As [`Rows::add_up`], of ellipticities that can be scored.
    fn measured<'s>(&self, session: &'s SetSession) -> PyResult<AddedImages<'s>> {
        let images = self.add_up(session)?;
        let counts = images.rows();
        if counts.used == 0 {
            return Err(PyValueError::new_err(format!(
                "e1, e2: no galaxy has an ellipticity on the grid ({} are not finite, {} lie outside); expected numbers",
                counts.not_finite, counts.outside
            )));
        }
        match foreign::fault_of_rows(counts, session.grid(), ADVICE) {
            Some(fault) => Err(of_rows(&fault)),
            None => Ok(images),
        }
    }
}

// Ends messages about numbers that stand for failed measurements. Arrays have NaN where a measurement is missing.
const ADVICE: &str = "try drop_missing=True or set it to NaN";

fn of_rows(fault: &str) -> PyErr {
    PyValueError::new_err(format!("e1, e2: {fault}"))
}

/// Which values stand for a failed measurement of an ellipticity.
#[pyfunction]
pub(crate) fn failed<'py>(
    py: Python<'py>,
    values: PyReadonlyArray1<'py, f64>,
) -> Bound<'py, PyArray1<bool>> {
    let range = MeasuredRange::ELLIPTICITY;
    let failed = values.as_array().mapv(|value| range.excludes(value));
    failed.into_pyarray(py)
}

// x, y, e1, e2 and weights, rows per catalogue, and what is read as what.
type Calibrated<'py> = ([Bound<'py, PyArray1<f64>>; 5], Vec<usize>, Vec<String>);

/// The galaxies of catalogues of any program, one per image, calibrated together: x, y, e1, e2 and weights, the rows of each catalogue, and
/// which columns are used as what.
#[pyfunction]
pub(crate) fn galaxies<'py>(
    py: Python<'py>,
    catalogues: Vec<Given<'py>>,
    columns: Vec<String>,
    preset: Vec<PathBuf>,
    ellipticity: Option<&str>,
    drop_missing: bool,
    step: f64,
) -> PyResult<Calibrated<'py>> {
    let request = Request {
        names: names_of(&columns, &preset)?,
        shapes: ellipticity.map(shapes_of).transpose()?,
        drop_missing,
        step: Some(step),
        placed: Some(Placed::default()),
        ..Request::default()
    };
    let inputs = catalogues.into_iter().map(Given::input);
    let inputs = inputs.collect::<PyResult<Vec<_>>>()?;
    let found = py.detach(|| {
        let mut mean = CalibrationSums::default();
        let mut opened = Vec::new();
        for input in inputs {
            let own = Galaxies::open(input, &request, ["x", "y", "e1", "e2"], MAX_ROWS)?;
            mean.add(&own)?;
            opened.push(own);
        }
        let calibration = mean.calibration()?;
        let (mut values, mut lengths) = (<[Vec<f64>; 5]>::default(), Vec::new());
        for own in &opened {
            let mut rows = own.read(MAX_ROWS)?;
            if rows.is_empty() {
                // Numbers of images by galaxy would not contain it.
                let [e1, e2] = [f64::NAN; 2];
                let (x, y) = (1.0, 1.0);
                rows.push((Row { x, y, e1, e2 }, calibration.weight));
            }
            lengths.push(rows.len());
            for (row, weight) in rows {
                let [e1, e2] = calibration.shear([row.e1, row.e2]);
                let all = [row.x, row.y, e1, e2, weight / calibration.weight];
                values
                    .iter_mut()
                    .zip(all)
                    .for_each(|(own, value)| own.push(value));
            }
        }
        let account = opened.first().map(Galaxies::account);
        Ok((values, lengths, account.unwrap_or_default()))
    });
    let (values, lengths, account) = found.map_err(|error| of_bias(FileError::into(error)))?;
    Ok((values.map(|own| own.into_pyarray(py)), lengths, account))
}

/// Scores images of `n` × `n` galaxies against their true shear, both in the order of the grid, x running
/// fastest, or the images at positions. Returns all metrics, spectra and counts by name.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python passes them by name")]
pub(crate) fn score<'py>(
    py: Python<'py>,
    n: usize,
    stamp: f64,
    field_degrees: f64,
    truth: Pair<'py>,
    truth_sign: Option<&str>,
    e: Pair<'py>,
    positions: Option<Pair<'py>>,
    weights: Option<PyReadonlyArray1<'py, f64>>,
    lengths: Vec<usize>,
    definition: &str,
    convention: &str,
    noise_variance: Option<f64>,
) -> PyResult<Bound<'py, PyDict>> {
    let grid = grid(n, stamp, field_degrees)?;
    let options = Options {
        definition: self::definition(definition)?,
        noise: noise_variance.map_or(Noise::Measured, Noise::Given),
        choice: choice(convention)?,
    };
    let (g1, g2) = (truth.0.as_array(), truth.1.as_array());
    let given = truth_sign.map(sign_of).transpose()?;
    let catalogue = Rows {
        weights: weights.as_ref().map(|own| own.as_array()),
        ..Rows::new(&e, positions.as_ref(), lengths)
    };
    let (scored, mut warnings, challenge) = py.detach(|| {
        // One row more than the grid has, so that a truth that is too long is an error.
        let truth = g1.iter().zip(&g2).take(grid.cells() + 1).enumerate();
        let truth = truth.map(|(k, (&e1, &e2))| {
            let (x, y) = grid.centre(k % n, k / n);
            Row { x, y, e1, e2 }
        });
        let standard = TrueShear::from_rows(&grid, TruthSign::Standard, truth).map_err(of_scoring)?;
        let by_modes = sign_by_modes(&grid, &standard).map_err(of_scoring)?;
        let sign = sign_of_truth(&standard, given, by_modes, || {
            let session = SetSession::new(grid, None, options).map_err(of_scoring)?;
            let images = catalogue.measured(&session)?;
            sign_by_correlation(&standard, images.images().total()).map_err(of_scoring)
        })?;
        let challenge = sign.of == TruthSign::Challenge;
        let truth = match challenge {
            true => standard.flipped(),
            false => standard,
        };
        let session = SetSession::new(grid, Some(truth), options).map_err(of_scoring)?;
        let ScoredImages { score, rows, findings, odd, .. } =
            catalogue.measured(&session)?.finish().map_err(of_scoring)?;
        let mut warnings = scores::oddities(&rows, "e1, e2", score.bins.definition);
        if let Some(other) = by_modes.filter(|other| *other != sign.of) {
            warnings.push(format!(
                "warning: truth_g2 seems to have the other sign: with it the shear is an E-mode field. Try: truth_sign=\"{}\"",
                word(other)
            ));
        }
        let odd = scores::odd_images(&odd, &|place| format!("image {}", place + 1));
        // The Python package words a wrong convention, with the name of its argument.
        let told = findings
            .iter()
            .filter(|fault| !matches!(fault, Fault::Convention { .. }));
        let lines = odd.into_iter().chain(told.map(scores::words));
        warnings.extend(lines.map(|line| format!("warning: {line}.")));
        PyResult::Ok((score, warnings, challenge))
    })?;
    if scored.constant.is_some() {
        warnings.push("note: the true shear is the same everywhere, so that only `mean`, c1 and c2 are known; other metrics are NaN.".into());
    }

    let found = PyDict::new(py);
    let names = Metrics::ALL.map(|metric| metric.name);
    let by_name = |metrics: &Metrics| {
        let values = PyDict::new(py);
        for (name, value) in names.iter().zip(metrics.values()) {
            values.set_item(name, value)?;
        }
        PyResult::Ok(values)
    };
    found.set_item("metrics", by_name(&scored.metrics)?)?;
    found.set_item("errors", by_name(&scored.errors)?)?;
    // For paired differences of two methods (`difference`), whose common noise cancels.
    let replicates: Vec<f64> = scored.replicates.iter().flat_map(Metrics::values).collect();
    let replicates = Array2::from_shape_vec((scored.replicates.len(), names.len()), replicates)
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    found.set_item("replicates", replicates.into_pyarray(py))?;
    found.set_item("spectrum", spectrum_of(py, &scored)?)?;
    found.set_item("noise_variance", scored.noise_variance)?;
    found.set_item("images", scored.images)?;
    found.set_item("convention", scored.chosen.number())?;
    let matched = scored.matching.convention();
    found.set_item("matched", (matched.number(), matched.describe()))?;
    found.set_item("matched_clearly", scored.matching.is_clear())?;
    let leaderboard = &scored.conventions[scored.best.index()];
    found.set_item("q_leaderboard", leaderboard.quality.q)?;
    found.set_item("correlation", scored.spectra().correlation)?;
    found.set_item(
        "truth_sign",
        if challenge { "challenge" } else { "standard" },
    )?;
    found.set_item("warnings", warnings)?;
    found.set_item(
        "constant",
        scored.constant.map(|mean| (mean.e, mean.error, mean.truth)),
    )?;
    Ok(found)
}

fn sign_of_truth(
    standard: &TrueShear,
    given: Option<TruthSign>,
    by_modes: Option<TruthSign>,
    by_correlation: impl FnOnce() -> PyResult<Option<TruthSign>>,
) -> PyResult<Sign> {
    let refused = |fault: SignFault| {
        // Arrays have no line that states a sign, as files do.
        let text = match fault {
            SignFault::Unclear => "cannot determine the sign of g2 in the truth (found no E-mode field, and no slope of e2 on g2 of 5σ; expected one of them). Try: truth_sign=\"standard\" (g2 > 0 along x = y), or truth_sign=\"challenge\" (the other sign)".to_owned(),
            other => other.to_string(),
        };
        PyValueError::new_err(format!("truth_g2: {text}"))
    };
    match Sign::of_truth(None, given, || by_modes).map_err(refused)? {
        Some(sign) => Ok(sign),
        None if standard.g2.iter().all(|g2| *g2 == 0.0) => Ok(Sign::ZERO),
        None => Sign::of_catalogues(by_correlation()?).map_err(refused),
    }
}

fn spectrum_of<'py>(py: Python<'py>, scored: &SetScore) -> PyResult<Bound<'py, PyDict>> {
    let (found, spectra) = (bins(py, &scored.bins)?, scored.spectra());
    let noise = scored.noise.unwrap_or([f64::NAN; BINS]);
    for (name, powers) in [
        ("ee", &spectra.ee),
        ("ee_error", &scored.ee_error),
        ("bb", &spectra.bb),
        ("eb", &spectra.eb),
        ("true_ee", &scored.true_ee),
        ("true_bb", &scored.true_bb),
        ("noise", &noise),
    ] {
        found.set_item(name, powers.to_pyarray(py))?;
    }
    Ok(found)
}

fn bins<'py>(py: Python<'py>, bins: &Bins) -> PyResult<Bound<'py, PyDict>> {
    let found = PyDict::new(py);
    found.set_item("l", bins.l.to_pyarray(py))?;
    found.set_item("dln_l", bins.dln_l.to_pyarray(py))?;
    found.set_item("modes", bins.modes.map(|modes| modes as i64).to_pyarray(py))?;
    let to_c_l: [f64; BINS] = std::array::from_fn(|bin| bins.to_c_l(bin));
    found.set_item("to_c_l", to_c_l.to_pyarray(py))?;
    let scored: [bool; BINS] = std::array::from_fn(|bin| SCORED.contains(&bin));
    found.set_item("scored", scored.to_pyarray(py))?;
    Ok(found)
}

/// E, B and EB bandpowers of the mean of images of `n` × `n` galaxies in the order of the grid, x running
/// fastest. No truth is needed.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python passes them by name")]
pub(crate) fn spectrum<'py>(
    py: Python<'py>,
    n: usize,
    stamp: f64,
    field_degrees: f64,
    e: Pair<'py>,
    positions: Option<Pair<'py>>,
    lengths: Vec<usize>,
    definition: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let grid = grid(n, stamp, field_degrees)?;
    let definition = self::definition(definition)?;
    let catalogue = Rows::new(&e, positions.as_ref(), lengths);
    let (all, modes) = py.detach(|| {
        let session = SetSession::new(grid, None, Options::default()).map_err(of_scoring)?;
        let images = catalogue.add_up(&session)?;
        let counts = images.rows();
        // Other faults of rows are no errors here, because any field has a spectrum.
        let failed = (counts.sentinels > 0).then(|| foreign::fault_of_rows(counts, &grid, ADVICE));
        if let Some(fault) = failed.flatten() {
            return Err(of_rows(&fault));
        }
        let total = images.images().total();
        let scale = 1.0 / total.images.max(1) as f64;
        let standard = Convention::STANDARD;
        let field = standard
            .apply(&(&total.e1 * scale), &(&total.e2 * scale))
            .map_err(of_scoring)?;
        let modes = Decomposer::new(grid).decompose(field).map_err(of_scoring)?;
        PyResult::Ok((Bins::new(&grid, definition), modes))
    })?;
    let found = bins(py, &all)?;
    for (name, a, b) in [
        ("ee", &modes.e, &modes.e),
        ("bb", &modes.b, &modes.b),
        ("eb", &modes.e, &modes.b),
    ] {
        let power = all.power(a, b).map_err(of_scoring)?;
        found.set_item(name, power.to_pyarray(py))?;
    }
    Ok(found)
}

/// The difference of two metrics of the same images, with its error; `None` where it has none.
#[pyfunction]
pub(crate) fn difference(
    images: usize,
    first: f64,
    first_replicates: Vec<f64>,
    second: f64,
    second_replicates: Vec<f64>,
) -> Option<(f64, f64)> {
    let set = PairedSet {
        images,
        first,
        first_replicates: &first_replicates,
        second,
        second_replicates: &second_replicates,
    };
    paired_difference(&[set]).map(|found| (found.difference, found.error))
}

/// Correlations and aperture masses of galaxies at nodes of a lattice, with weights. NaN marks a galaxy without a shear.
#[pyfunction]
pub(crate) fn aperture_mass<'py>(
    py: Python<'py>,
    g: Pair<'py>,
    nodes: (PyReadonlyArray1<'py, i64>, PyReadonlyArray1<'py, i64>),
    weights: PyReadonlyArray1<'py, f64>,
    side: usize,
    field_degrees: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let (g1, g2, weights) = (g.0.as_array(), g.1.as_array(), weights.as_array());
    let (x, y) = (nodes.0.as_array(), nodes.1.as_array());
    let (found, masses) = py.detach(|| {
        let field = Degrees(field_degrees);
        let mut galaxies = LatticeShear::new(Lattice { side, field }).map_err(of_scoring)?;
        for k in 0..g1.len() {
            // The package checks that nodes are not negative; larger ones are errors here.
            let node = (x[k] as usize, y[k] as usize);
            if !(g1[k].is_nan() || g2[k].is_nan()) {
                let g = Shear::new(g1[k], g2[k]);
                galaxies.add(node, g, weights[k]).map_err(of_scoring)?;
            }
        }
        let found = galaxies.correlations();
        let masses = found.aperture_mass();
        PyResult::Ok((found, masses))
    })?;
    let columns = PyDict::new(py);
    for (name, values) in [
        ("theta", masses.theta),
        ("map_e", masses.map_e),
        ("map_b", masses.map_b),
        ("error", masses.error),
        ("pairs", found.pairs),
        ("mean_r", found.mean_r),
        ("xi_plus", found.xi_plus),
        ("xi_minus", found.xi_minus),
    ] {
        columns.set_item(name, values.to_vec().into_pyarray(py))?;
    }
    Ok(columns)
}
