//! GREAT10-like sets in memory.

use std::sync::Arc;

use numpy::IntoPyArray;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_pipeline::engine;
use shearq_pipeline::simulate::simulator;
use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};
use shearq_simulate::field::ShearSpectrum;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{
    FixedPsf, ImageFields, NOISE_SIGMA, PsfField, STAMP, SetSimulator, SimulationSettings,
};

use crate::errors::{no_memory, of_pipeline};
use crate::work::{Failure, Watch, threads};

// FWHM, e1, e2 and β.
const FORMULA: usize = 4;

struct Drawn {
    pixels: Vec<f32>,
    stars: Vec<f32>,
    formulas: Vec<[f64; FORMULA]>,
    observed: Vec<Shear>,
}

/// Simulates images of a set like the command line, into arrays by name. Images follow one another, and galaxies are in the
/// order of the grid, x fastest.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "Python passes them by name")]
pub(crate) fn simulate<'py>(
    py: Python<'py>,
    set: u32,
    images: Vec<u32>,
    seed: u64,
    grid: usize,
    amplitude: f64,
    tilt: f64,
    intrinsic_sigma: Option<f64>,
    psf_fields: bool,
    threads_asked: Option<u16>,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let usual = SimulationSettings::new(seed, grid);
    let settings = SimulationSettings {
        spectrum: ShearSpectrum {
            amplitude,
            tilt,
            ..ShearSpectrum::default()
        },
        intrinsic_sigma: intrinsic_sigma.unwrap_or(usual.intrinsic_sigma),
        fixed_psf: match psf_fields {
            true => FixedPsf::Field,
            false => FixedPsf::One,
        },
        ..usual
    };
    settings
        .validate()
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    let simulator = py
        .detach(|| simulator(set, settings))
        .map_err(of_pipeline)?;
    let cells = grid * grid;
    // Reserved before the work: memory that is missing is an exception at once, not after minutes.
    let mut pixels: Vec<f32> = Vec::new();
    let wanted = images
        .len()
        .checked_mul(cells * STAMP * STAMP)
        .ok_or_else(|| no_memory("the images"))?;
    pixels
        .try_reserve_exact(wanted)
        .map_err(|_| no_memory("the images"))?;
    let (mut stars, mut formulas, mut observed, mut intrinsic) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let failure = Failure::default();
    let mut watch = Watch::new(progress, &failure);
    let result = py.detach(|| {
        engine::ordered(
            threads(threads_asked),
            |feeder| {
                for &image in &images {
                    let fields = Arc::new(simulator.image_fields(image));
                    for iy in 0..grid {
                        if !feeder.push((Arc::clone(&fields), iy)) {
                            return Ok(());
                        }
                    }
                }
                Ok(())
            },
            RenderScratch::new,
            |scratch, (fields, iy): (Arc<ImageFields>, usize)| {
                let shapes = (0..grid).map(|ix| fields.intrinsic[(ix, iy)]);
                let shapes: Vec<_> = shapes.map(|e| [e.re, e.im]).collect();
                Ok((shapes, draw(&simulator, &fields, iy, scratch)))
            },
            |(shapes, row)| {
                watch.advance(shapes.len())?;
                intrinsic.extend(shapes.into_iter().flatten());
                pixels.extend(row.pixels);
                stars.extend(row.stars);
                formulas.extend(row.formulas.into_iter().flatten());
                observed.extend(row.observed.iter().flat_map(|e| [e.e1, e.e2]));
                Ok(())
            },
        )
        .and_then(|()| watch.report())
    });
    failure.or(result)?;
    let truth = (0..cells).map(|k| simulator.shear_at(k % grid, k / grid));
    let truth: Vec<f64> = truth.flat_map(|g| [g.e1, g.e2]).collect();
    let centres = (0..cells).map(|k| simulator.grid().centre(k % grid, k / grid));
    let positions: Vec<f64> = centres.flat_map(|(x, y)| [x, y]).collect();
    let found = PyDict::new(py);
    found.set_item("stamp", STAMP)?;
    found.set_item("noise", NOISE_SIGMA)?;
    found.set_item("kind", simulator.kind().image.label())?;
    found.set_item("stamps", pixels.into_pyarray(py))?;
    found.set_item("stars", stars.into_pyarray(py))?;
    found.set_item("formulas", formulas.into_pyarray(py))?;
    found.set_item("truth", truth.into_pyarray(py))?;
    found.set_item("positions", positions.into_pyarray(py))?;
    found.set_item("intrinsic", intrinsic.into_pyarray(py))?;
    found.set_item("observed", observed.into_pyarray(py))?;
    Ok(found)
}

// A PSF for all galaxies comes with the first row only, so that arrays of PSFs have one element per PSF.
fn draw(set: &SetSimulator, fields: &ImageFields, iy: usize, scratch: &mut RenderScratch) -> Drawn {
    let n = set.grid().n;
    let mut pixels = vec![0.0; n * STAMP * STAMP];
    let stamps = pixels.chunks_exact_mut(STAMP * STAMP).enumerate();
    let observed = stamps
        .map(|(ix, stamp)| set.draw(fields, ix, iy, scratch, stamp))
        .collect();
    let psfs: Vec<FunctionalPsf> = match &fields.psf {
        PsfField::One(psf) if iy == 0 => vec![*psf],
        PsfField::One(_) => Vec::new(),
        PsfField::PerGalaxy(field) => (0..n).map(|ix| field[(ix, iy)]).collect(),
    };
    Drawn {
        pixels,
        stars: psfs
            .iter()
            .flat_map(|psf| psf.stamp(STAMP))
            .map(|light| light as f32)
            .collect(),
        formulas: psfs.iter().map(formula).collect(),
        observed,
    }
}

fn formula(psf: &FunctionalPsf) -> [f64; FORMULA] {
    // NaN stands for Kolmogorov, which has no β, so that the array has one type.
    let beta = match psf.profile {
        PsfProfile::Moffat { beta } => beta,
        PsfProfile::Kolmogorov => f64::NAN,
    };
    [psf.fwhm, psf.shape.e1, psf.shape.e2, beta]
}
