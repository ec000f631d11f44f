//! Speed on the user's machine: stages of a measurement, stamp sizes, threads, scoring.

use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ndarray::{Array2, ArrayView2};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_dataset::truth::Reading;
use shearq_files::FileError;
use shearq_files::atomic::{self, Scratch};
use shearq_files::frames::frame;
use shearq_files::frames::polars::Column;
use shearq_files::table::{self, FileFormat};
use shearq_measure::parts::{
    AdaptiveMoments, ClippedAcf, Network, Rule, Spectral, WaveletWiener, border_noise,
};
use shearq_measure::{ImageNoise, Measurer, StampNoise, Worker};
use shearq_pipeline::PipelineError;
use shearq_pipeline::engine::Quiet;
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_quantities::statistics::median;
use shearq_quantities::units::{Degrees, Pixels};
use shearq_render::table::{Cell, Table};
use shearq_results::catalogues::COLUMNS;
use shearq_results::foreign::{Screen, plain_columns};
use shearq_results::score::score_files;
use shearq_scoring::{Options, TruthSign};
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{NOISE_SIGMA, STAMP, SetSimulator, SimulationSettings};
use shearq_submissions::limits::{MAX_PSF, WINDOWS};
use shearq_submissions::{Configuration, LinearMethod, Method, NetworkMethod, NoiseSource, PsfCut};

// Number of different galaxies per timing, so that branches are not predictable.
const SAMPLE: usize = 64;
// Runs of which a time is the median: other work on the machine disturbs single runs.
const RUNS: usize = 5;
// Longest time per timing.
const BUDGET: Duration = Duration::from_millis(400);
// Stamp sizes of the table of costs.
const SIZES: [usize; 10] = [11, 15, 19, 23, 29, 33, 39, 48, 56, 64];

// Microseconds per call: the median of passes over `SAMPLE` galaxies, at least `RUNS`, after a warm-up.
fn time(mut call: impl FnMut(usize)) -> f64 {
    // The first pass fills caches and grows buffers.
    for k in 0..SAMPLE {
        call(k);
    }
    let begin = Instant::now();
    let mut passes = Vec::new();
    while passes.len() < RUNS || begin.elapsed() < BUDGET {
        let start = Instant::now();
        for k in 0..SAMPLE {
            call(k);
        }
        passes.push(start.elapsed().as_secs_f64() * 1e6 / SAMPLE as f64);
    }
    median(&mut passes).unwrap_or(f64::NAN)
}

fn median_seconds(
    mut run: impl FnMut() -> Result<(), PipelineError>,
) -> Result<f64, PipelineError> {
    let mut seconds = || {
        let start = Instant::now();
        run().map(|()| start.elapsed().as_secs_f64())
    };
    let mut runs = (0..RUNS)
        .map(|_| seconds())
        .collect::<Result<Vec<f64>, _>>()?;
    Ok(median(&mut runs).unwrap_or(f64::NAN))
}

fn view(stamp: &[f32]) -> ArrayView2<'_, f32> {
    let side = stamp.len().isqrt();
    ArrayView2::from_shape((side, side), stamp).expect("a square stamp")
}

// Stamps of the fiducial set, and its PSF at a size.
struct Inputs {
    set: SetSimulator,
    stamps: Vec<Vec<f32>>,
}

impl Inputs {
    fn new(settings: SimulationSettings) -> Result<Self, PipelineError> {
        let set = simulator(2, settings)?;
        let fields = set.image_fields(1);
        let mut scratch = RenderScratch::new();
        let n = set.grid().n;
        let stamps = (0..SAMPLE)
            .map(|k| {
                let mut stamp = vec![0.0; STAMP * STAMP];
                set.draw(&fields, k % n, k / n, &mut scratch, &mut stamp);
                stamp
            })
            .collect();
        Ok(Inputs { set, stamps })
    }

    fn psf(&self, cut: impl Into<PsfCut>) -> Array2<f64> {
        let fields = self.set.image_fields(1);
        fields.psf.at(0, 0).stamp_beside(cut.into().size, STAMP)
    }

    // The stamps of at least `side` pixels a side: larger ones have noise around the set's stamps.
    fn of_side(&self, side: usize) -> Vec<Vec<f32>> {
        let before = side.saturating_sub(STAMP) / 2;
        let mut rng = ChaCha8Rng::seed_from_u64(side as u64);
        let surrounded = |stamp: &Vec<f32>| {
            if side <= STAMP {
                return stamp.clone();
            }
            let mut large: Vec<f32> = (0..side * side)
                .map(|_| StandardNormal.sample(&mut rng))
                .collect();
            for (y, row) in stamp.chunks_exact(STAMP).enumerate() {
                large[(before + y) * side + before..][..STAMP].copy_from_slice(row);
            }
            large
        };
        self.stamps.iter().map(surrounded).collect()
    }

    // A worker, and the PSF for it.
    fn prepared(
        &self,
        configuration: &Configuration,
    ) -> Result<(Worker, Array2<f64>), PipelineError> {
        let measurer = Measurer::new(configuration, configuration.stamp.size.max(STAMP))?;
        // Its sizes may differ by a pixel from those of the configuration.
        let psf = self.psf(measurer.configuration().psf_cut());
        Ok((measurer.worker(), psf))
    }

    // Microseconds of a whole measurement of a galaxy whose PSF is set.
    fn whole(&self, configuration: &Configuration) -> Result<f64, PipelineError> {
        let (mut worker, psf) = self.prepared(configuration)?;
        let stamps = self.of_side(configuration.stamp.size);
        let mut image = worker.image(ImageNoise::Level(NOISE_SIGMA));
        let mut worker = image.psf(psf.view())?;
        Ok(time(|k| {
            let _ = black_box(worker.measure(view(&stamps[k])));
        }))
    }

    // Microseconds of setting a PSF.
    fn taking_a_psf(&self, configuration: &Configuration) -> Result<f64, PipelineError> {
        let (mut worker, psf) = self.prepared(configuration)?;
        let mut image = worker.image(ImageNoise::Level(NOISE_SIGMA));
        Ok(time(|_| {
            let _ = image.psf(black_box(psf.view()));
        }))
    }

    fn cuts(&self, n: usize) -> Vec<Vec<f32>> {
        self.stamps.iter().map(|stamp| centre(stamp, n)).collect()
    }
}

/// Microseconds of a whole measurement of a galaxy whose PSF is set.
pub fn whole(
    configuration: &Configuration,
    settings: SimulationSettings,
) -> Result<f64, PipelineError> {
    Inputs::new(settings)?.whole(configuration)
}

/// Cost of each stage of a measurement, and of simulating the galaxy.
pub fn stages(
    configuration: &Configuration,
    settings: SimulationSettings,
) -> Result<Table, PipelineError> {
    let inputs = Inputs::new(settings)?;
    let (n, p) = (configuration.stamp.size, configuration.psf.size);
    let psf = inputs.psf(p);
    let fields = inputs.set.image_fields(1);
    let grid = inputs.set.grid().n;
    let mut render = RenderScratch::new();
    let mut stamp = vec![0.0; STAMP * STAMP];
    let mut rows: Vec<(&str, f64)> = Vec::new();
    if let NoiseSource::Border { border: width } = configuration.noise {
        let mut border = Vec::new();
        rows.push((
            "noise level",
            time(|k| {
                let stamp = &inputs.stamps[k];
                black_box(border_noise(stamp, STAMP, width, &mut border));
            }),
        ));
    }
    if let Some(settings) = configuration.wavelet() {
        let filter = WaveletWiener::new(STAMP, settings);
        let mut filter_scratch = filter.scratch();
        rows.push((
            "denoise",
            time(|k| {
                stamp.copy_from_slice(&inputs.stamps[k]);
                filter.apply(black_box(&mut stamp), 1.0, &mut filter_scratch);
            }),
        ));
    }
    let cut = inputs.cuts(n);
    let mut notes = vec![format!(
        "One thread; median of passes over {SAMPLE} galaxies."
    )];
    let linear = configuration.linear().is_some();
    match &configuration.method {
        Method::Linear(method) => linear_stages(method, n, psf.view(), &cut, &mut rows)?,
        Method::Network(method) => {
            notes.extend(network_stages(method, n, psf.view(), &cut, &mut rows)?);
        }
    }
    let whole = inputs.whole(configuration)?;
    let stages: f64 = rows.iter().map(|(_, time)| time).sum();
    let rest = if linear {
        "sheared noise (one galaxy in eight) and the rest"
    } else {
        "the rest"
    };
    rows.push((rest, whole - stages));
    rows.push(("whole measurement", whole));
    let taken = inputs.taking_a_psf(configuration)?;
    rows.push(("set the PSF, if each galaxy has its own", taken));
    rows.push((
        "simulate",
        time(|k| {
            black_box(
                inputs
                    .set
                    .draw(&fields, k % grid, k / grid, &mut render, &mut stamp),
            );
        }),
    ));
    let mut table = Table::titled(format!("Stages of {}", configuration.name));
    table.column("stage", "Stage", &rows, |row| Cell::text(row.0));
    table.column("microseconds", "µs per galaxy", &rows, |row| {
        Cell::number(row.1, 1)
    });
    table.column("per_second", "galaxies per second", &rows, |row| {
        // The rest is a difference, and may be less than its error.
        Cell::number(if row.1 > 0.0 { 1e6 / row.1 } else { f64::NAN }, 0)
    });
    table.notes = notes;
    Ok(table)
}

// Stages of the network; returns notes.
fn network_stages(
    method: &NetworkMethod,
    n: usize,
    psf: ArrayView2<'_, f64>,
    cut: &[Vec<f32>],
    rows: &mut Vec<(&'static str, f64)>,
) -> Result<Vec<String>, PipelineError> {
    let settings = &method.deconvolution;
    let lambda = settings.printed_lambda(settings.lambda);
    let mut network = Network::plan(n, psf.nrows(), lambda)?;
    network.set_psf(psf, settings.psf_scale)?;
    let mut scratch = network.scratch();
    let mut out = vec![0.0; n * n];
    let rules: Vec<Option<Rule>> = cut
        .iter()
        .map(|stamp| {
            let peak = stamp.iter().copied().fold(0.0, f32::max);
            Rule::new(settings, f64::from(peak), 1.0)
        })
        .collect();
    let mut iterations = 0;
    let network_time = time(|k| {
        if let Some(rule) = &rules[k]
            && let Ok(descent) =
                network.deconvolve(rule, black_box(&cut[k]), &mut scratch, &mut out)
        {
            iterations = descent.iterations;
        }
    });
    rows.push(("deconvolve", network_time));
    let shape = ClippedAcf::new(n, &method.shape);
    let mut shape_scratch = shape.scratch();
    rows.push((
        "autocorrelation",
        time(|k| {
            let _ = shape.autocorrelate(black_box(&cut[k]), &mut shape_scratch);
        }),
    ));
    shape.autocorrelate(&out, &mut shape_scratch)?;
    let light = out.iter().map(|&v| f64::from(v)).sum();
    rows.push((
        "moments",
        time(|_| {
            let _ = black_box(shape.moments(black_box(shape_scratch.acf()), light));
        }),
    ));
    Ok(vec![format!(
        "The network made {iterations} iterations of the last galaxy."
    )])
}

fn linear_stages(
    method: &LinearMethod,
    n: usize,
    psf: ArrayView2<'_, f64>,
    stamps: &[Vec<f32>],
    rows: &mut Vec<(&'static str, f64)>,
) -> Result<(), PipelineError> {
    let spectral = Spectral::new(n, psf.nrows(), &method.deconvolution)?;
    let (mut own, mut scratch) = (spectral.psf(), spectral.scratch());
    let mut lags = spectral.lags();
    let white = spectral.noise(&StampNoise::white(1.0));
    spectral.set_psf(psf, &white, &mut scratch, &mut own)?;
    rows.push((
        "deconvolve and autocorrelate, with response",
        time(|k| spectral.autocorrelate(&own, black_box(&stamps[k]), 1.0, &mut scratch, &mut lags)),
    ));
    let scale = method.shape.weight_scale;
    let moments = AdaptiveMoments::new(scale, spectral.spacing(), spectral.reach());
    let mut values = moments.scratch();
    rows.push((
        "adaptive moments and response",
        time(|_| {
            if let Ok(shape) = black_box(moments.measure(black_box(&lags.acf), 0.0, &mut values)) {
                black_box(moments.response(&shape, &lags.shear1, &mut values));
                black_box(moments.response(&shape, &lags.shear2, &mut values));
            }
        }),
    ));
    Ok(())
}

fn centre(stamp: &[f32], n: usize) -> Vec<f32> {
    let start = (STAMP - n) / 2;
    (0..n)
        .flat_map(|y| &stamp[(start + y) * STAMP + start..][..n])
        .copied()
        .collect()
}

/// Cost of a whole measurement against stamp size.
pub fn size_costs(
    configurations: &[Configuration],
    settings: SimulationSettings,
) -> Result<Table, PipelineError> {
    let inputs = Inputs::new(settings)?;
    let mut rows = Vec::new();
    for configuration in configurations {
        for n in SIZES {
            let cost = inputs.whole(&sized(configuration, n))?;
            rows.push((configuration.name.as_str(), n, cost));
        }
    }
    let mut table = Table::titled("Cost against stamp size");
    table.column("submission", "Configuration", &rows, |row| {
        Cell::text(row.0)
    });
    table.column("stamp", "Stamp [px]", &rows, |row| {
        Cell::number(row.1 as f64, 0)
    });
    table.column("microseconds", "µs per galaxy", &rows, |row| {
        Cell::number(row.2, 1)
    });
    table.column("nanoseconds_per_pixel", "ns per pixel", &rows, |row| {
        Cell::number(row.2 * 1e3 / (row.1 * row.1) as f64, 1)
    });
    Ok(table)
}

// A configuration for stamps of `n` pixels a side. The linear method's window keeps its share of the stamp, and its PSF
// stamps are as large, up to the largest, because both must be odd or even.
fn sized(configuration: &Configuration, n: usize) -> Configuration {
    let mut sized = configuration.clone();
    let share = n as f64 / sized.stamp.size as f64;
    sized.stamp.size = n;
    if let Method::Linear(method) = &mut sized.method {
        sized.psf.size = n.min(MAX_PSF - n % 2);
        let window = &mut method.deconvolution.window_sigma;
        *window = (*window * share).clamp(*WINDOWS.start(), *WINDOWS.end());
    }
    sized
}

/// Rate of simulating and measuring in memory against the number of threads.
pub fn scaling(
    configuration: &Configuration,
    settings: SimulationSettings,
    threads: usize,
) -> Result<Table, PipelineError> {
    let inputs = Inputs::new(settings)?;
    let measurers = measurers(std::slice::from_ref(configuration))?;
    let galaxies = inputs.set.grid().cells() as f64;
    let rate = |threads: usize| -> Result<f64, PipelineError> {
        let set = &inputs.set;
        let seconds =
            median_seconds(|| run_set(set, &[1], &measurers, threads, &mut Quiet, |_, _| Ok(())))?;
        Ok(galaxies / seconds)
    };
    let rates = (1..=threads.max(1))
        .map(|count| Ok((count, rate(count)?)))
        .collect::<Result<Vec<_>, PipelineError>>()?;
    let one = rates[0].1;
    let name = &configuration.name;
    let mut table = Table::titled(format!("Simulating and measuring {name} in memory"));
    table.column("threads", "Threads", &rates, |rate| {
        Cell::number(rate.0 as f64, 0)
    });
    table.column("per_second", "galaxies per second", &rates, |rate| {
        Cell::number(rate.1, 0)
    });
    table.column("speed_up", "speed-up", &rates, |rate| {
        Cell::number(rate.1 / one, 2)
    });
    Ok(table)
}

/// Rate of scoring a set of 10,000-row catalogues from each format, in a temporary folder.
///
/// # Errors
/// If the files cannot be written or read.
pub fn scoring(images: usize, threads: usize) -> Result<Table, PipelineError> {
    let folder = Scratch::new()?;
    let side = 100;
    let position = |k: usize| (k as f64).mul_add(48.0, 24.5);
    let x: Vec<f64> = (0..side * side).map(|k| position(k % side)).collect();
    let y: Vec<f64> = (0..side * side).map(|k| position(k / side)).collect();
    // Any ellipticities do; these differ in every digit.
    let e1: Vec<f64> = (0..side * side)
        .map(|k| 0.1 * (k as f64 * 0.7).sin())
        .collect();
    let e2: Vec<f64> = (0..side * side)
        .map(|k| 0.1 * (k as f64 * 1.3).cos())
        .collect();
    let ascii = |header: &str, separator: &str| -> String {
        let mut text = header.to_owned();
        for k in 0..side * side {
            let fields = [x[k], y[k], e1[k], e2[k]].map(|v| format!("{v:.9}"));
            text.push_str(&(fields.join(separator) + "\n"));
        }
        text
    };
    let truth = folder.path().join("truth.csv");
    atomic::write(&truth, ascii("x,y,g1,g2\n", ",").as_bytes())?;
    let dat = ascii("", " ");
    let columns = [("x", &x), ("y", &y), ("e1", &e1), ("e2", &e2)];
    let columns = columns.map(|(name, values)| Column::new(name.into(), values));
    let columns =
        frame(columns.into()).map_err(|error| FileError::new(&truth, error.to_string()))?;
    let mut rows = Vec::new();
    for (format, ending, kind) in [
        ("Parquet", "parquet", Some(FileFormat::Parquet)),
        ("FITS", "fits", Some(FileFormat::Fits)),
        ("ASCII", "dat", None),
    ] {
        let path = |k: usize| folder.path().join(format!("{k}.{ending}"));
        let paths: Vec<PathBuf> = (0..images).map(path).collect();
        for path in &paths {
            match kind {
                Some(kind) => table::write(path, kind, &columns, &Default::default())?,
                None => atomic::write(path, dat.as_bytes())?,
            }
        }
        rows.push((format, score_seconds(&truth, &paths, threads)?));
    }
    let mut table = Table::titled(format!(
        "Scoring {images} catalogues of 10,000 rows, {threads} thread(s)"
    ));
    table.column("format", "Format", &rows, |row| Cell::text(row.0));
    table.column("seconds", "seconds", &rows, |row| Cell::number(row.1, 3));
    let millions = (images * side * side) as f64 / 1e6;
    table.column(
        "million_rows_per_second",
        "million rows per second",
        &rows,
        |row| Cell::number(millions / row.1, 1),
    );
    table.notes = vec!["Reading, summing, spectra of eight conventions, jackknife.".into()];
    Ok(table)
}

fn score_seconds(truth: &Path, paths: &[PathBuf], threads: usize) -> Result<f64, PipelineError> {
    let reading = Reading {
        field: Degrees(10.0),
        stamp: Pixels(48.0),
        sign: Some(TruthSign::Standard),
    };
    median_seconds(|| {
        let read = plain_columns(COLUMNS, Screen::default());
        let options = Options::default();
        black_box(score_files(
            truth, paths, &reading, &read, options, threads,
        )?);
        Ok(())
    })
}
