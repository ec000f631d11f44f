use std::convert::Infallible;
use std::hint::black_box;
use std::time::{Duration, Instant};

use clap::Args;
use ndarray::Array2;
use shearq_dataset::threads::Quiet;
use shearq_measure::{ImageNoise, MeasureError, Measurer};
use shearq_pipeline::PipelineError;
use shearq_pipeline::run::run_set;
use shearq_pipeline::simulate::simulator;
use shearq_quantities::statistics::median;
use shearq_render::table::{Cell, Table};
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{FixedPsf, NOISE_SIGMA, STAMP, SetSimulator, SimulationSettings};
use shearq_submissions::Configuration;

use crate::arguments::{Form, Threads, configurations};

/// Measure the speed on this machine: measuring, simulating and threads.
///
/// It takes less than a minute. Other work on the machine disturbs it, so compare ratios within one run rather than
/// absolute times. docs/validation.md explains the results.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Configuration: a name from `shearq submissions list` or a TOML file. May be given several times.
    #[arg(long, value_name = "NAME|FILE", default_values = ["23/den/star", "48/linear/star"])]
    submission: Vec<String>,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

// Set 2 is the fiducial one: S/N 20 and one PSF for all galaxies.
const FIDUCIAL_SET: u32 = 2;
// 2,500 galaxies per image, so that the command takes less than a minute. Chosen by hand.
const GRID_SIDE: usize = 50;
// Different galaxies per timing, so that the processor cannot learn the branches of one.
const SAMPLE_GALAXIES: usize = 64;
// A time is the median of at least so many runs, because other work on the machine disturbs single ones.
const MIN_RUNS: usize = 5;
// Longest time per timing. Chosen by hand: all timings of three configurations take about a minute.
const BUDGET: Duration = Duration::from_millis(400);

struct Speed {
    name: String,
    // Microseconds per galaxy on one thread, with given noise and a PSF that is set.
    measure: f64,
    // Microseconds to set the PSF.
    psf: f64,
    simulate: f64,
    // Simulated and measured in memory, with all threads.
    per_second: f64,
    speed_up: f64,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let threads = arguments.threads.number();
    // Setting a PSF is measured by itself.
    let settings = SimulationSettings {
        fixed_psf: FixedPsf::One,
        ..SimulationSettings::new(1, GRID_SIDE)
    };
    let set = simulator(FIDUCIAL_SET, settings)?;
    let configurations = configurations(&arguments.submission)?;
    let rows = configurations.iter().map(|own| speed(own, &set, threads));
    let rows: Vec<Speed> = rows.collect::<Result<_, PipelineError>>()?;
    let mut table = Table::titled("Speed of configurations");
    table.column("submission", "Configuration", &rows, |row| {
        Cell::text(&row.name)
    });
    let mut number = |key, label, of: fn(&Speed) -> f64, decimals| {
        table.column(key, label, &rows, |row| Cell::number(of(row), decimals));
    };
    number("microseconds", "µs per galaxy", |row| row.measure, 1);
    number("psf_microseconds", "µs per PSF", |row| row.psf, 1);
    let simulate = |row: &Speed| row.simulate;
    number("simulate_microseconds", "µs to simulate", simulate, 1);
    number("per_second", "galaxies per second", |row| row.per_second, 0);
    number("speed_up", "speed-up", |row| row.speed_up, 2);
    table.notes = vec![format!(
        "Medians. µs are on one thread, with given noise; a PSF is set for each galaxy or once per image. Galaxies per second are simulated and measured in memory with {threads} thread(s); the speed-up is relative to one thread."
    )];
    arguments.form.print(&table)
}

fn speed(
    configuration: &Configuration,
    set: &SetSimulator,
    threads: usize,
) -> Result<Speed, PipelineError> {
    let (fields, n) = (set.image_fields(1), set.grid().n);
    let mut scratch = RenderScratch::new();
    let mut draw = |k: usize| {
        let mut stamp = Array2::<f32>::zeros((STAMP, STAMP));
        let pixels = stamp.as_slice_mut().expect("a new array is contiguous");
        set.draw(&fields, k % n, k / n, &mut scratch, pixels);
        stamp
    };
    let stamps: Vec<Array2<f32>> = (0..SAMPLE_GALAXIES).map(&mut draw).collect();
    let Ok(simulate) = microseconds::<Infallible>(|k| {
        black_box(draw(k));
        Ok(())
    });
    let measurer = Measurer::new(configuration, STAMP)?;
    // The measurer's sizes may differ by a pixel from those of the configuration: PSF and stamp are both odd or even.
    let size = measurer.configuration().psf_cut().size;
    let star = fields.psf.at(0, 0).stamp_beside(size, STAMP);
    let mut worker = measurer.worker();
    let mut image = worker.image(ImageNoise::Level(NOISE_SIGMA));
    let psf = microseconds::<MeasureError>(|_| {
        image.psf(black_box(star.view()))?;
        Ok(())
    })?;
    let mut worker = image.psf(star.view())?;
    let measure = microseconds::<MeasureError>(|k| {
        let _ = black_box(worker.measure(black_box(stamps[k].view())));
        Ok(())
    })?;
    let measurers = [measurer];
    let per_second = |threads: usize| -> Result<f64, PipelineError> {
        let all = || run_set(set, &[1], &measurers, threads, &mut Quiet, |_, _| Ok(()));
        Ok(set.grid().cells() as f64 / median_seconds(all)?)
    };
    let (one, many) = (per_second(1)?, per_second(threads)?);
    Ok(Speed {
        name: configuration.name.clone(),
        measure,
        psf,
        simulate,
        per_second: many,
        speed_up: many / one,
    })
}

// Microseconds per galaxy, of passes over the sample.
fn microseconds<E>(mut call: impl FnMut(usize) -> Result<(), E>) -> Result<f64, E> {
    let pass = median_seconds(|| (0..SAMPLE_GALAXIES).try_for_each(&mut call))?;
    Ok(1e6 * pass / SAMPLE_GALAXIES as f64)
}

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
