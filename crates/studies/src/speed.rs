//! Speed on the user's machine: measuring, simulating and threads. `cargo bench` times the kernels.

use std::hint::black_box;
use std::time::{Duration, Instant};

use ndarray::{Array2, ArrayView2};
use shearq_dataset::threads::Quiet;
use shearq_measure::{ImageNoise, Measurer};
use shearq_pipeline::PipelineError;
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_quantities::statistics::median;
use shearq_render::table::{Cell, Table};
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{NOISE_SIGMA, STAMP, SimulationSettings};
use shearq_submissions::Configuration;

// Set 2 is the fiducial one: S/N 20 and one PSF for all galaxies.
const FIDUCIAL_SET: u32 = 2;
// Different galaxies per timing, so that the processor cannot learn the branches of one.
const SAMPLE_GALAXIES: usize = 64;
// A time is the median of at least so many runs, because other work on the machine disturbs single ones.
const MIN_RUNS: usize = 5;
// Longest time per timing. Chosen by hand: all timings of three configurations take about a minute.
const BUDGET: Duration = Duration::from_millis(400);

// Median time of `run`, after a first one that fills caches and grows buffers.
fn median_seconds<E>(mut run: impl FnMut() -> Result<(), E>) -> Result<f64, E> {
    run()?;
    let begin = Instant::now();
    let mut seconds = Vec::new();
    while seconds.len() < MIN_RUNS || begin.elapsed() < BUDGET {
        let start = Instant::now();
        run()?;
        seconds.push(start.elapsed().as_secs_f64());
    }
    Ok(median(&mut seconds).unwrap_or(f64::NAN))
}

// Microseconds per galaxy, of passes over the sample.
fn microseconds(
    mut call: impl FnMut(usize) -> Result<(), PipelineError>,
) -> Result<f64, PipelineError> {
    let pass = median_seconds(|| (0..SAMPLE_GALAXIES).try_for_each(&mut call))?;
    Ok(1e6 * pass / SAMPLE_GALAXIES as f64)
}

/// Microseconds per galaxy on one thread.
#[derive(Debug, Clone, Copy)]
pub struct Costs {
    /// Measurement, with given noise and a PSF that is set.
    pub measure: f64,
    /// Setting the PSF.
    pub psf: f64,
    pub simulate: f64,
}

pub fn costs(
    configuration: &Configuration,
    settings: SimulationSettings,
) -> Result<Costs, PipelineError> {
    let set = simulator(FIDUCIAL_SET, settings)?;
    let (fields, n) = (set.image_fields(1), set.grid().n);
    let mut scratch = RenderScratch::new();
    let mut draw = |k: usize| {
        let mut stamp = Array2::<f32>::zeros((STAMP, STAMP));
        let pixels = stamp.as_slice_mut().expect("a new array is contiguous");
        set.draw(&fields, k % n, k / n, &mut scratch, pixels);
        stamp
    };
    let stamps: Vec<Array2<f32>> = (0..SAMPLE_GALAXIES).map(&mut draw).collect();
    let simulate = microseconds(|k| {
        black_box(draw(k));
        Ok(())
    })?;
    let measurer = Measurer::new(configuration, STAMP)?;
    // The measurer's sizes may differ by a pixel from those of the configuration: PSF and stamp are both odd or even.
    let size = measurer.configuration().psf_cut().size;
    let star = fields.psf.at(0, 0).stamp_beside(size, STAMP);
    let mut worker = measurer.worker();
    let mut image = worker.image(ImageNoise::Level(NOISE_SIGMA));
    let psf = microseconds(|_| {
        image.psf(black_box(star.view()))?;
        Ok(())
    })?;
    let mut worker = image.psf(star.view())?;
    let measure = microseconds(|k| {
        let stamp: ArrayView2<'_, f32> = black_box(stamps[k].view());
        let _ = black_box(worker.measure(stamp));
        Ok(())
    })?;
    Ok(Costs {
        measure,
        psf,
        simulate,
    })
}

/// Time per galaxy of each configuration, and the rate of simulating and measuring in memory with `threads`.
pub fn speeds(
    configurations: &[Configuration],
    settings: SimulationSettings,
    threads: usize,
) -> Result<Table, PipelineError> {
    let set = simulator(FIDUCIAL_SET, settings)?;
    let mut rows = Vec::new();
    for configuration in configurations {
        let measurers = measurers(std::slice::from_ref(configuration))?;
        let rate = |threads: usize| -> Result<f64, PipelineError> {
            let all = || run_set(&set, &[1], &measurers, threads, &mut Quiet, |_, _| Ok(()));
            Ok(set.grid().cells() as f64 / median_seconds(all)?)
        };
        let (one, many) = (rate(1)?, rate(threads)?);
        rows.push((
            &configuration.name,
            costs(configuration, settings)?,
            many,
            many / one,
        ));
    }
    let mut table = Table::titled("Speed of configurations");
    table.column("submission", "Configuration", &rows, |row| {
        Cell::text(row.0)
    });
    let mut microseconds = |key, label, of: fn(&Costs) -> f64| {
        table.column(key, label, &rows, |row| Cell::number(of(&row.1), 1));
    };
    microseconds("microseconds", "µs per galaxy", |costs| costs.measure);
    microseconds("psf_microseconds", "µs per PSF", |costs| costs.psf);
    microseconds("simulate_microseconds", "µs to simulate", |costs| {
        costs.simulate
    });
    table.column("per_second", "galaxies per second", &rows, |row| {
        Cell::number(row.2, 0)
    });
    table.column("speed_up", "speed-up", &rows, |row| Cell::number(row.3, 2));
    table.notes = vec![format!(
        "Medians. µs are on one thread, with given noise; a PSF is set for each galaxy or once per image. Galaxies per second are simulated and measured in memory with {threads} thread(s); the speed-up is relative to one thread."
    )];
    Ok(table)
}
