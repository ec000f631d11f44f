//! Speed on the user's machine: stages of a measurement, stamp sizes, threads, scoring.

use std::hint::black_box;
use std::path::Path;
use std::time::{Duration, Instant};

use ndarray::{Array2, ArrayView2};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::parts::{
    AdaptiveMoments, ClippedAcf, Network, Rule, Spectral, WaveletWiener, border_noise,
};
use shearq_measure::{ImageNoise, Measurer, StampNoise, Worker};
use shearq_quantities::statistics::median;
use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::{Options, TruthSign};
use shearq_submissions::limits::{MAX_PSF, WINDOWS};
use shearq_submissions::{Configuration, LinearMethod, Method, NetworkMethod, NoiseSource, PsfCut};

use shearq_files::frames::frame;
use shearq_files::frames::polars::Column;

use shearq_dataset::truth::Reading;
use shearq_files::FileError;
use shearq_files::atomic::{self, Scratch};
use shearq_files::table::{self, FileFormat};
use shearq_pipeline::PipelineError;
use shearq_pipeline::engine::Quiet;
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_render::figure::{LinePlot, Series, Style};
use shearq_render::table::{Cell, Heading, Table};
use shearq_results::foreign::{Screen, plain_columns};
use shearq_results::score::{COLUMNS, score_files};
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{NOISE_SIGMA, STAMP, SetSimulator, SimulationSettings};

mod amounts;

pub use amounts::{Amounts, amounts};

/// Number of different galaxies per timing, so that branches are not predictable.
const SAMPLE: usize = 64;
/// Runs of which a time is the median.
const RUNS: usize = 5;
/// Longest time per timing.
const BUDGET: Duration = Duration::from_millis(400);
/// Stamp sizes of the table of costs.
pub const SIZES: [usize; 10] = [11, 15, 19, 23, 29, 33, 39, 48, 56, 64];

/// Microseconds per call: the median of passes over `SAMPLE` galaxies, at least [`RUNS`], after a warm-up.
pub(super) fn time(mut call: impl FnMut(usize)) -> f64 {
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

/// Seconds of `run`.
fn seconds(mut run: impl FnMut() -> Result<(), PipelineError>) -> Result<f64, PipelineError> {
    let start = Instant::now();
    run()?;
    Ok(start.elapsed().as_secs_f64())
}

/// The same: the median of [`RUNS`].
fn median_seconds(
    mut run: impl FnMut() -> Result<(), PipelineError>,
) -> Result<f64, PipelineError> {
    let runs: Result<Vec<f64>, _> = (0..RUNS).map(|_| seconds(&mut run)).collect();
    Ok(median(&mut runs?).unwrap_or(f64::NAN))
}

/// A square stamp.
fn view(stamp: &[f32]) -> ArrayView2<'_, f32> {
    let side = stamp.len().isqrt();
    ArrayView2::from_shape((side, side), stamp).expect("a square stamp")
}

/// Settings of a configuration's network.
///
/// # Errors
/// If it has the linear method.
pub(super) fn network_of(configuration: &Configuration) -> Result<&NetworkMethod, PipelineError> {
    configuration.network().ok_or_else(|| {
        PipelineError::Request(format!(
            "configuration {} has method = \"linear\"; expected \"network\"",
            configuration.name
        ))
    })
}

/// Stamps of the fiducial set, and its PSF at a size.
pub(super) struct Inputs {
    set: SetSimulator,
    stamps: Vec<Vec<f32>>,
}

impl Inputs {
    pub(super) fn new(settings: SimulationSettings) -> Result<Self, PipelineError> {
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

    pub(super) fn psf(&self, cut: impl Into<PsfCut>) -> Array2<f64> {
        let fields = self.set.image_fields(1);
        fields.psf.at(0, 0).stamp_beside(cut.into().size, STAMP)
    }

    /// The stamps of at least `side` pixels a side: larger ones have noise around the set's stamps.
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

    /// A worker, and the PSF for it.
    fn prepared(
        &self,
        configuration: &Configuration,
    ) -> Result<(Worker, Array2<f64>), PipelineError> {
        let measurer = Measurer::new(configuration, configuration.stamp.size.max(STAMP))?;
        // Its sizes may differ by a pixel from those of the configuration.
        let psf = self.psf(measurer.configuration().psf_cut());
        Ok((measurer.worker(), psf))
    }

    /// Microseconds of a whole measurement of a galaxy whose PSF is set.
    fn whole(&self, configuration: &Configuration) -> Result<f64, PipelineError> {
        let (mut worker, psf) = self.prepared(configuration)?;
        let stamps = self.of_side(configuration.stamp.size);
        let mut image = worker.image(ImageNoise::Level(NOISE_SIGMA));
        let mut worker = image.psf(psf.view())?;
        Ok(time(|k| {
            let _ = black_box(worker.measure(view(&stamps[k])));
        }))
    }

    /// Microseconds of setting a PSF.
    fn taking_a_psf(&self, configuration: &Configuration) -> Result<f64, PipelineError> {
        let (mut worker, psf) = self.prepared(configuration)?;
        let mut image = worker.image(ImageNoise::Level(NOISE_SIGMA));
        Ok(time(|_| {
            let _ = image.psf(black_box(psf.view()));
        }))
    }

    /// The stamps, cut to n×n.
    pub(super) fn cuts(&self, n: usize) -> Vec<Vec<f32>> {
        self.stamps.iter().map(|stamp| centre(stamp, n)).collect()
    }
}

/// Microseconds of a whole measurement of a galaxy whose PSF is set.
///
/// # Errors
/// If the sizes of the configuration are invalid.
pub fn whole(
    configuration: &Configuration,
    settings: SimulationSettings,
) -> Result<f64, PipelineError> {
    Inputs::new(settings)?.whole(configuration)
}

/// Cost of each stage of a measurement, and of simulating the galaxy.
///
/// # Errors
/// If the sizes of the configuration are invalid.
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
    let before = rows.len();
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
    let stages: f64 = rows[before..].iter().map(|(_, time)| time).sum();
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
    Ok(Table {
        title: format!("Stages of {}", configuration.name),
        headings: vec![
            Heading::new("stage", "Stage"),
            Heading::new("microseconds", "µs per galaxy"),
            Heading::new("per_second", "galaxies per second"),
        ],
        rows: rows
            .into_iter()
            .map(|(stage, time)| {
                // The rest is a difference, and may be less than its error.
                let rate = if time > 0.0 { 1e6 / time } else { f64::NAN };
                vec![
                    Cell::text(stage),
                    Cell::number(time, 1),
                    Cell::number(rate, 0),
                ]
            })
            .collect(),
        notes,
    })
}

/// Stages of the network; returns notes.
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

/// Stages of the linear network.
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

/// Cost of a whole measurement against stamp size, in µs over [`SIZES`].
///
/// # Errors
/// If the sizes of the configuration are invalid.
pub fn size_costs(
    configuration: &Configuration,
    settings: SimulationSettings,
) -> Result<Vec<f64>, PipelineError> {
    let inputs = Inputs::new(settings)?;
    SIZES
        .iter()
        .map(|&n| inputs.whole(&sized(configuration, n)))
        .collect()
}

/// A configuration for stamps of `n` pixels a side. The linear method's window keeps its share of the stamp, and its PSF
/// stamps are as large, up to the largest, because both must be odd or even.
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

/// Costs against stamp size of several configurations as a table.
pub fn sizes_table(costs: &[(&str, Vec<f64>)]) -> Table {
    let mut rows = Vec::new();
    for (name, costs) in costs {
        for (n, cost) in SIZES.iter().zip(costs) {
            rows.push(vec![
                Cell::text(*name),
                Cell::number(*n as f64, 0),
                Cell::number(*cost, 1),
                Cell::number(cost * 1e3 / (n * n) as f64, 1),
            ]);
        }
    }
    Table {
        title: "Cost against stamp size".into(),
        headings: vec![
            Heading::new("submission", "Configuration"),
            Heading::new("stamp", "Stamp [px]"),
            Heading::new("microseconds", "µs per galaxy"),
            Heading::new("nanoseconds_per_pixel", "ns per pixel"),
        ],
        rows,
        notes: Vec::new(),
    }
}

/// The same as a plot.
pub fn sizes_figure(costs: &[(&str, Vec<f64>)]) -> LinePlot {
    let sizes: Vec<f64> = SIZES.iter().map(|n| *n as f64).collect();
    LinePlot {
        title: "Cost against stamp size".into(),
        x_label: "stamp [px]".into(),
        y_label: "µs per galaxy".into(),
        series: costs
            .iter()
            .enumerate()
            .map(|(k, (name, costs))| {
                Series::new(name, sizes.clone(), costs.clone(), Style::Line, k)
            })
            .collect(),
        ..LinePlot::default()
    }
}

/// Rate of simulating and measuring in memory against the number of threads.
///
/// # Errors
/// If the sizes of the configuration are invalid, or if threads cannot be started.
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
    let one = rate(1)?;
    let mut rows = vec![vec![
        Cell::number(1.0, 0),
        Cell::number(one, 0),
        Cell::number(1.0, 2),
    ]];
    for count in 2..=threads {
        let many = rate(count)?;
        rows.push(vec![
            Cell::number(count as f64, 0),
            Cell::number(many, 0),
            Cell::number(many / one, 2),
        ]);
    }
    Ok(Table {
        title: format!("Simulating and measuring {} in memory", configuration.name),
        headings: vec![
            Heading::new("threads", "Threads"),
            Heading::new("per_second", "galaxies per second"),
            Heading::new("speed_up", "speed-up"),
        ],
        rows,
        notes: Vec::new(),
    })
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
    let table = frame(columns.into()).map_err(|error| FileError::new(&truth, error.to_string()))?;
    let mut rows = Vec::new();
    for (format, ending) in [("Parquet", "parquet"), ("FITS", "fits"), ("ASCII", "dat")] {
        let mut paths = Vec::new();
        for k in 0..images {
            let path = folder.path().join(format!("{k}.{ending}"));
            match ending {
                "dat" => atomic::write(&path, dat.as_bytes())?,
                _ => {
                    let kind = if ending == "fits" {
                        FileFormat::Fits
                    } else {
                        FileFormat::Parquet
                    };
                    table::write(&path, kind, &table, &Default::default())?;
                }
            }
            paths.push(path);
        }
        let seconds = score_seconds(&truth, &paths, threads)?;
        rows.push(vec![
            Cell::text(format),
            Cell::number(seconds, 3),
            Cell::number((images * side * side) as f64 / seconds / 1e6, 1),
        ]);
    }
    Ok(Table {
        title: format!("Scoring {images} catalogues of 10,000 rows, {threads} thread(s)"),
        headings: vec![
            Heading::new("format", "Format"),
            Heading::new("seconds", "seconds"),
            Heading::new("million_rows_per_second", "million rows per second"),
        ],
        rows,
        notes: vec!["Reading, summing, spectra of eight conventions, jackknife.".into()],
    })
}

fn score_seconds(
    truth: &Path,
    paths: &[std::path::PathBuf],
    threads: usize,
) -> Result<f64, PipelineError> {
    let reading = Reading {
        field: Degrees(10.0),
        stamp: Pixels(48.0),
        sign: Some(TruthSign::Standard),
    };
    median_seconds(|| {
        let read = plain_columns(COLUMNS, Screen::default());
        black_box(score_files(
            truth,
            paths,
            &reading,
            &read,
            Options::default(),
            threads,
        )?);
        Ok(())
    })
}
