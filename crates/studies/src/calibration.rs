//! Calibration of the regularisation parameter λ on synthetic galaxies: Sect. 4 of the paper, its Figs 4 to 7.
//!
//! A galaxy is an exponential (Sérsic n = 1) profile u on a stamp; the observed stamp is
//! u₀ = Hu + n with a Moffat PSF (β = 3) of the galaxy's own and white noise of
//! SNR = 10 log₁₀(σ_S²/σ²) dB, σ_S² being the variance of Hu over the stamp. Half-light radii are
//! uniform in 1.5–4 px, FWHM in 2.8–4 px, ellipticities of galaxies Gaussian of 0.2 per component
//! (at most 0.6), of PSFs uniform to 0.05. The paper gives none of these numbers.
//!
//! * CTR = K_c/K_t (Eq. 15): of all changes of a neuron's state, the share that brings it nearer to
//!   u. The update that raises the energy and ends the run counts as attempted.
//! * dSNR = 10 log₁₀(‖u₀ − u‖²/‖u* − u‖²) (Eq. 16), mean over galaxies.
//! * 1/RMSD = √(2N/Σ|e − e*|²) (Eq. 17), distortions, over the galaxies that could be measured.

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_dataset::threads::Progress;
use shearq_measure::parts::{
    ClippedAcf, ClippedAcfScratch, Network, NetworkScratch, Rule, convolve, psf_factor,
};
use shearq_pipeline::PipelineError;
use shearq_pipeline::engine;
use shearq_quantities::{Distortion, FunctionalPsf, PsfProfile, Shear};
use shearq_render::figure::{LinePlot, PanelGrid, Series, Style};
use shearq_render::page::{Page, PageError};
use shearq_render::table::{Cell, Table};
use shearq_simulate::galaxy::{Component, Sersic};
use shearq_submissions::{Configuration, NetworkDeconvolution, PsfScale, Update};

/// log₁₀ λ of the curves: −6 to 6 in halves.
pub const LOG_LAMBDA: [f64; 25] = log_lambda();
/// Place of the paper's choice among them, λ = 10⁻⁴.
pub const PAPER_LAMBDA: usize = 4;
// Place of λ = 10^−3.5, at which the paper's Fig. 4 shows CTR against S/N.
const FIG_4_LAMBDA: usize = 5;
// S/N in dB of the curves over λ.
const SNR_DB: [f64; 3] = [10.0, 20.0, 40.0];
// S/N in dB of the curve at `FIG_4_LAMBDA`.
const FIG_4_SNR_DB: [f64; 7] = [10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0];
// Both rules with their names, in the order of `Curves`.
const UPDATES: [(Update, &str); 2] = [
    (Update::Adaptive, "adaptive"),
    (Update::Constant, "constant"),
];

const fn log_lambda() -> [f64; 25] {
    let mut values = [0.0; 25];
    let mut k = 0;
    while k < 25 {
        values[k] = -6.0 + 0.5 * k as f64;
        k += 1;
    }
    values
}

/// Sums over galaxies at one S/N, rule and λ.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LambdaSums {
    // Transitions that brought a neuron nearer to the truth.
    correct: u64,
    transitions: u64,
    // Sums over galaxies of (correct)², (all)² and correct·all transitions, for the error of CTR.
    transition_squares: [f64; 3],
    // Σ dSNR in dB and Σ dSNR².
    dsnr: [f64; 2],
    galaxies: u64,
    // Σ |e − e*|² and Σ |e − e*|⁴ of the galaxies with a shape.
    deviation: [f64; 2],
    measured: u64,
    iterations: u64,
}

// A value and its standard error.
type Measured = (f64, f64);

impl LambdaSums {
    fn add(&mut self, other: &LambdaSums) {
        self.correct += other.correct;
        self.transitions += other.transitions;
        self.galaxies += other.galaxies;
        self.measured += other.measured;
        self.iterations += other.iterations;
        let sums = [
            &mut self.transition_squares[..],
            &mut self.dsnr,
            &mut self.deviation,
        ];
        let more = [&other.transition_squares[..], &other.dsnr, &other.deviation];
        for (sum, more) in sums.into_iter().flatten().zip(more.into_iter().flatten()) {
            *sum += more;
        }
    }

    /// CTR. NaN without transitions.
    pub fn ctr(&self) -> Measured {
        let ctr = self.correct as f64 / self.transitions as f64;
        // The error of a ratio of sums over galaxies, not over pixels: those of one galaxy go together.
        let [correct, all, both] = self.transition_squares;
        let square = correct - 2.0 * ctr * both + ctr * ctr * all;
        (ctr, square.max(0.0).sqrt() / self.transitions as f64)
    }

    /// Mean dSNR in dB.
    pub fn mean_dsnr(&self) -> Measured {
        let n = self.galaxies as f64;
        let mean = self.dsnr[0] / n;
        (mean, ((self.dsnr[1] / n - mean * mean).max(0.0) / n).sqrt())
    }

    /// 1/RMSD.
    pub fn inverse_rmsd(&self) -> Measured {
        let n = self.measured as f64;
        let mean = self.deviation[0] / n;
        let variance = (self.deviation[1] / n - mean * mean) / n;
        let value = (2.0 * n / self.deviation[0]).sqrt();
        (value, 0.5 * value * variance.sqrt() / mean)
    }
}

#[derive(Debug, Clone)]
pub struct Curves {
    /// `[rule][S/N][λ of LOG_LAMBDA]`; the first rule is the adaptive one.
    pub over_lambda: Vec<Vec<Vec<LambdaSums>>>,
    /// `[rule][S/N of Fig. 4]`.
    pub over_snr: Vec<Vec<LambdaSums>>,
    galaxies: u64,
}

impl Curves {
    fn new() -> Self {
        Curves {
            over_lambda: vec![vec![vec![LambdaSums::default(); LOG_LAMBDA.len()]; SNR_DB.len()]; 2],
            over_snr: vec![vec![LambdaSums::default(); FIG_4_SNR_DB.len()]; 2],
            galaxies: 0,
        }
    }

    fn add(&mut self, other: &Curves) {
        let mine = self.over_lambda.iter_mut().flatten().flatten();
        let mine = mine.chain(self.over_snr.iter_mut().flatten());
        let more = other.over_lambda.iter().flatten().flatten();
        for (sum, more) in mine.zip(more.chain(other.over_snr.iter().flatten())) {
            sum.add(more);
        }
        self.galaxies += other.galaxies;
    }

    // The λ that this study chooses for a rule.
    fn best_log_lambda(&self, rule: usize) -> f64 {
        // The S/N count alike: each curve is relative to its own best value.
        let relative = |k: usize| -> Measured {
            let (mut value, mut variance) = (0.0, 0.0);
            for curve in &self.over_lambda[rule] {
                let best = curve
                    .iter()
                    .map(|at| at.inverse_rmsd().0)
                    .fold(0.0, f64::max);
                let (own, error) = curve[k].inverse_rmsd();
                value += own / best / SNR_DB.len() as f64;
                variance += (error / best / SNR_DB.len() as f64).powi(2);
            }
            (value, variance.sqrt())
        };
        let all: Vec<Measured> = (0..LOG_LAMBDA.len()).map(relative).collect();
        let best = all.iter().map(|v| v.0).fold(0.0, f64::max);
        // Of those within two standard errors of the best, the largest regularises most at no cost.
        let near = (0..LOG_LAMBDA.len()).rfind(|&k| all[k].0 + 2.0 * all[k].1 >= best);
        near.map_or(f64::NAN, |k| LOG_LAMBDA[k])
    }
}

// Galaxies per unit of work. Each is deconvolved 150 times.
const CHUNK: u64 = 8;

/// Deconvolves synthetic galaxies with the settings of a configuration, by both rules.
pub fn calibrate(
    configuration: &Configuration,
    galaxies: u64,
    seed: u64,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Curves, PipelineError> {
    let planned = LambdaStudy::new(configuration)?;
    let mut curves = Curves::new();
    engine::ordered(
        threads,
        |feeder| {
            let mut firsts = (0..galaxies).step_by(CHUNK as usize);
            firsts.all(|first| feeder.push(first..(first + CHUNK).min(galaxies)));
            Ok(())
        },
        || planned.worker(),
        |worker, mut range: std::ops::Range<u64>| {
            let mut curves = Curves::new();
            range.try_for_each(|galaxy| planned.galaxy(seed, galaxy, worker, &mut curves))?;
            Ok(curves)
        },
        |more| {
            progress.advance(more.galaxies);
            curves.add(&more);
            Ok(())
        },
    )?;
    Ok(curves)
}

struct LambdaStudy {
    n: usize,
    psf_size: usize,
    settings: NetworkDeconvolution,
    networks: Vec<Network>,
    acf: ClippedAcf,
}

// A network for each λ, and scratch.
struct Worker {
    networks: Vec<Network>,
    scratch: NetworkScratch,
    acf: ClippedAcfScratch,
    out: Vec<f32>,
}

struct Synthetic {
    original: Vec<f32>,
    convolved: Vec<f64>,
    // With the sum or peak of 1 that the configuration asks for.
    psf: Array2<f64>,
    shape: Distortion,
    noise: Vec<f64>,
}

impl LambdaStudy {
    fn new(configuration: &Configuration) -> Result<Self, PipelineError> {
        let (n, psf_size) = (configuration.stamp.size, configuration.psf.size);
        let method = configuration
            .network()
            .ok_or_else(|| PipelineError::NoNetwork(configuration.name.clone()))?;
        let settings = method.deconvolution.clone();
        let plan =
            |log: &f64| Network::plan(n, psf_size, settings.printed_lambda(10f64.powf(*log)));
        Ok(LambdaStudy {
            networks: LOG_LAMBDA.iter().map(plan).collect::<Result<_, _>>()?,
            acf: ClippedAcf::new(n, &method.shape),
            settings,
            n,
            psf_size,
        })
    }

    fn worker(&self) -> Worker {
        Worker {
            networks: self.networks.clone(),
            scratch: self.networks[0].scratch(),
            acf: self.acf.scratch(),
            out: vec![0.0; self.n * self.n],
        }
    }

    fn galaxy(
        &self,
        seed: u64,
        number: u64,
        worker: &mut Worker,
        curves: &mut Curves,
    ) -> Result<(), PipelineError> {
        let galaxy = self.draw(seed, number)?;
        for network in &mut worker.networks {
            network.set_psf(galaxy.psf.view(), PsfScale::Sum)?;
        }
        for (rule, (update, _)) in UPDATES.into_iter().enumerate() {
            let settings = NetworkDeconvolution {
                update,
                ..self.settings.clone()
            };
            for (sums, snr) in curves.over_lambda[rule].iter_mut().zip(SNR_DB) {
                let observed = observe(&galaxy, snr);
                for (lambda, sum) in sums.iter_mut().enumerate() {
                    sum.add(&self.run(worker, lambda, &settings, &galaxy, &observed)?);
                }
            }
            for (sum, snr) in curves.over_snr[rule].iter_mut().zip(FIG_4_SNR_DB) {
                let observed = observe(&galaxy, snr);
                sum.add(&self.run(worker, FIG_4_LAMBDA, &settings, &galaxy, &observed)?);
            }
        }
        curves.galaxies += 1;
        Ok(())
    }

    fn draw(&self, seed: u64, number: u64) -> Result<Synthetic, PipelineError> {
        let n = self.n;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // A stream for each galaxy, so that the number of threads does not matter.
        rng.set_stream(number);
        let mut normal = |scale: f64| -> f64 {
            let draw: f64 = StandardNormal.sample(&mut rng);
            scale * draw
        };
        let (e1, e2) = (normal(0.2), normal(0.2));
        let modulus = e1.hypot(e2);
        let cap = (0.6 / modulus).min(1.0);
        let shape = Shear::new(e1 * cap, e2 * cap);
        // The same noise at each S/N and λ, so that curves differ by λ and S/N alone.
        let noise = (0..n * n).map(|_| normal(1.0)).collect();
        let galaxy = Component {
            profile: Sersic::Exponential,
            half_light_radius: rng.random_range(1.5..4.0),
            flux: 1.0,
            dx: rng.random_range(-0.5..0.5),
            dy: rng.random_range(-0.5..0.5),
            shape,
        };
        let fwhm = rng.random_range(2.8..4.0);
        let psf_shape = Shear::new(rng.random_range(-0.05..0.05), rng.random_range(-0.05..0.05));
        let psf = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, fwhm, psf_shape)
            .expect("the PSFs drawn here are within range");
        let psf = psf.stamp(self.psf_size);
        // u₀ = Hu for the H that deconvolves, so that states compare with u.
        let factor = psf_factor(psf.view(), self.settings.psf_scale)?;
        let psf = psf.mapv(|value| value * factor);
        // Mean over 4 × 4 points of each pixel, because an exponential profile has a cusp.
        let centre = (n as f64 - 1.0) / 2.0;
        let original = Array2::from_shape_fn((n, n), |(y, x)| {
            let (y, x) = (y as f64 - centre, x as f64 - centre);
            let points = (0..16).map(|s| {
                let at = |s: usize| (s as f64 + 0.5) / 4.0 - 0.5;
                galaxy.value(x + at(s % 4), y + at(s / 4))
            });
            points.sum::<f64>() / 16.0
        });
        let convolved = convolve(original.view(), psf.view());
        Ok(Synthetic {
            original: original.iter().map(|&v| v as f32).collect(),
            convolved: convolved.into_iter().collect(),
            psf,
            shape: shape.to_distortion(),
            noise,
        })
    }

    fn run(
        &self,
        worker: &mut Worker,
        lambda: usize,
        settings: &NetworkDeconvolution,
        galaxy: &Synthetic,
        (stamp, sigma): &(Vec<f32>, f64),
    ) -> Result<LambdaSums, PipelineError> {
        let Worker {
            networks,
            scratch,
            acf,
            out,
        } = worker;
        let mut sums = LambdaSums {
            galaxies: 1,
            ..LambdaSums::default()
        };
        let peak = stamp.iter().copied().fold(0.0f32, f32::max);
        let Some(rule) = Rule::new(settings, f64::from(peak), *sigma) else {
            return Ok(sums);
        };
        let original = &galaxy.original;
        let (mut correct, mut transitions) = (0, 0);
        let count = |before: &[f32], after: &[f32]| {
            for ((b, a), u) in before.iter().zip(after).zip(original) {
                if a != b {
                    transitions += 1;
                    correct += u64::from((a - u).abs() < (b - u).abs());
                }
            }
        };
        let descent = networks[lambda].trace(&rule, stamp, scratch, out, count)?;
        (sums.correct, sums.transitions) = (correct, transitions);
        let [c, t] = [correct as f64, transitions as f64];
        sums.transition_squares = [c * c, t * t, c * t];
        sums.iterations = u64::from(descent.iterations);
        let distance = |image: &[f32]| -> f64 {
            let pixels = image.iter().zip(original);
            pixels.map(|(v, u)| f64::from(v - u).powi(2)).sum()
        };
        let dsnr = 10.0 * (distance(stamp) / distance(out)).log10();
        sums.dsnr = [dsnr, dsnr * dsnr];
        let light = out.iter().map(|&v| f64::from(v)).sum();
        let shape = self
            .acf
            .measure(out, light, acf)?
            .and_then(|moments| moments.distortion());
        if let Ok(Distortion { e1, e2 }) = shape {
            let deviation = (e1 - galaxy.shape.e1).powi(2) + (e2 - galaxy.shape.e2).powi(2);
            sums.deviation = [deviation, deviation * deviation];
            sums.measured = 1;
        }
        Ok(sums)
    }
}

// The observed stamp at a S/N in dB, and its noise level.
fn observe(galaxy: &Synthetic, snr_db: f64) -> (Vec<f32>, f64) {
    let image = &galaxy.convolved;
    let count = image.len() as f64;
    let mean = image.iter().sum::<f64>() / count;
    let variance = image.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / count;
    let sigma = (variance / 10f64.powf(snr_db / 10.0)).sqrt();
    let stamp = image.iter().zip(&galaxy.noise);
    let stamp = stamp.map(|(v, n)| (v + sigma * n) as f32).collect();
    (stamp, sigma)
}

fn curve(
    label: &str,
    x: Vec<f64>,
    sums: &[LambdaSums],
    value: fn(&LambdaSums) -> Measured,
    (style, colour): (Style, usize),
) -> Series {
    let (y, errors) = sums.iter().map(value).unzip();
    Series::new(label, x, y, style, colour).with_errors(errors)
}

// Series of both rules, the adaptive one dashed as in the paper.
fn both_rules<'a>(
    x: &[f64],
    sums: impl Fn(usize) -> &'a [LambdaSums],
    value: fn(&LambdaSums) -> Measured,
) -> Vec<Series> {
    let series = UPDATES.iter().zip([Style::Dashed, Style::Line]).enumerate();
    let series = series.map(|(rule, ((_, name), style))| {
        curve(name, x.to_vec(), sums(rule), value, (style, rule))
    });
    series.collect()
}

/// Draws Figs 4 to 7 and writes their data.
pub fn figures(page: &mut Page<'_>, curves: &Curves) -> Result<(), PageError> {
    let lambda = LOG_LAMBDA.map(|log| 10f64.powf(log));
    page.figure(
        "fig4-ctr-snr",
        &LinePlot {
            title: "Correct transition rate, λ = 10⁻³·⁵".into(),
            x_label: "SNR [dB]".into(),
            y_label: "CTR".into(),
            series: both_rules(&FIG_4_SNR_DB, |rule| &curves.over_snr[rule], LambdaSums::ctr),
            ..LinePlot::default()
        },
        "As Fig. 4 of the paper: correct transition rate against S/N for the adaptive and the constant update.",
    )?;
    let adaptive = |title: &str, y_label: &str, value: fn(&LambdaSums) -> Measured| {
        let series = SNR_DB.iter().zip(&curves.over_lambda[0]).enumerate();
        let series = series.map(|(k, (snr, sums))| {
            let label = format!("SNR {snr} dB");
            curve(&label, lambda.to_vec(), sums, value, (Style::Line, k))
        });
        LinePlot {
            title: title.into(),
            x_label: "λ".into(),
            y_label: y_label.into(),
            x_log: true,
            series: series.collect(),
            ..LinePlot::default()
        }
    };
    page.figure(
        "fig5-ctr-lambda",
        &adaptive("Correct transition rate", "CTR", LambdaSums::ctr),
        "As Fig. 5 of the paper: correct transition rate against λ, adaptive update.",
    )?;
    page.figure(
        "fig6-dsnr-lambda",
        &adaptive(
            "Discriminative signal-to-noise ratio",
            "dSNR [dB]",
            LambdaSums::mean_dsnr,
        ),
        "As Fig. 6 of the paper: discriminative signal-to-noise ratio against λ, adaptive update.",
    )?;
    let panel = |(s, snr): (usize, &f64)| LinePlot {
        title: format!("SNR {snr} dB"),
        x_label: "λ".into(),
        y_label: "1/RMSD".into(),
        x_log: true,
        series: both_rules(
            &lambda,
            |rule| &curves.over_lambda[rule][s],
            LambdaSums::inverse_rmsd,
        ),
        ..LinePlot::default()
    };
    page.figure(
        "fig7-rmsd-lambda",
        &PanelGrid {
            title: "Accuracy of the ellipticities".into(),
            columns: 3,
            plots: SNR_DB.iter().enumerate().map(panel).collect(),
        },
        "As Fig. 7 of the paper: 1/RMSD of the ellipticities against λ for both updates.",
    )?;
    page.data("curves", &curves_table(curves))
}

fn measured((value, error): Measured, decimals: usize) -> Cell {
    Cell::with_error(value, Some(error), decimals)
}

// The curves over λ with the names of their rules and their S/N.
fn named_curves(curves: &Curves) -> Vec<(&'static str, f64, &[LambdaSums])> {
    let rules = UPDATES.iter().zip(&curves.over_lambda);
    let of_rule = rules.flat_map(|((_, name), of_rule)| {
        let of_snr = SNR_DB.iter().zip(of_rule);
        of_snr.map(|(snr, curve)| (*name, *snr, curve.as_slice()))
    });
    of_rule.collect()
}

// All curves over λ as one table: the data of Figs 5 to 7.
fn curves_table(curves: &Curves) -> Table {
    let mut rows = Vec::new();
    for (rule, snr, curve) in named_curves(curves) {
        let points = LOG_LAMBDA.iter().zip(curve);
        rows.extend(points.map(|(log, sums)| (rule, snr, *log, sums)));
    }
    let title = format!("Calibration of λ on {} synthetic galaxies", curves.galaxies);
    let mut table = Table::titled(title);
    table.column("update", "Update", &rows, |row| Cell::text(row.0));
    table.column("snr_db", "SNR [dB]", &rows, |row| Cell::number(row.1, 0));
    table.column("log10_lambda", "log λ", &rows, |row| {
        Cell::number(row.2, 1)
    });
    table.column("ctr", "CTR", &rows, |row| measured(row.3.ctr(), 4));
    table.column("dsnr_db", "dSNR [dB]", &rows, |row| {
        measured(row.3.mean_dsnr(), 3)
    });
    table.column("inverse_rmsd", "1/RMSD", &rows, |row| {
        measured(row.3.inverse_rmsd(), 3)
    });
    table.column("iterations", "Iterations", &rows, |row| {
        Cell::number(row.3.iterations as f64 / row.3.galaxies as f64, 1)
    });
    table
}

/// The best λ at each S/N and the values at 10⁻⁴.
pub fn best_table(curves: &Curves, configuration: &Configuration) -> Table {
    let rows = named_curves(curves);
    let best = |curve: &[LambdaSums]| {
        let at = |k: &usize| curve[*k].inverse_rmsd().0;
        let best = (0..curve.len()).max_by(|a, b| at(a).total_cmp(&at(b)));
        best.unwrap_or(0)
    };
    let mut table = Table::titled(format!(
        "Calibration of λ for {} on {} synthetic galaxies",
        configuration.name, curves.galaxies
    ));
    table.column("update", "Update", &rows, |row| Cell::text(row.0));
    table.column("snr_db", "SNR [dB]", &rows, |row| Cell::number(row.1, 0));
    table.column("best_log10_lambda", "best log λ", &rows, |row| {
        Cell::number(LOG_LAMBDA[best(row.2)], 1)
    });
    table.column("inverse_rmsd_best", "1/RMSD there", &rows, |row| {
        measured(row.2[best(row.2)].inverse_rmsd(), 3)
    });
    table.column("inverse_rmsd", "1/RMSD at 10⁻⁴", &rows, |row| {
        measured(row.2[PAPER_LAMBDA].inverse_rmsd(), 3)
    });
    table.column("ctr", "CTR at 10⁻⁴", &rows, |row| {
        measured(row.2[PAPER_LAMBDA].ctr(), 4)
    });
    table.column("dsnr_db", "dSNR at 10⁻⁴ [dB]", &rows, |row| {
        measured(row.2[PAPER_LAMBDA].mean_dsnr(), 2)
    });
    let chosen = UPDATES.iter().enumerate().map(|(rule, (_, name))| {
        format!(
            "10^{:.1} for the {name} update",
            curves.best_log_lambda(rule)
        )
    });
    table.notes = vec![format!(
        "λ chosen (the largest within two standard errors of the best 1/RMSD over all S/N): {}. The paper suggests 10^-4.",
        chosen.collect::<Vec<_>>().join(", ")
    )];
    let last = LOG_LAMBDA.len() - 1;
    if rows.iter().any(|row| [0, last].contains(&best(row.2))) {
        table.notes.push(format!(
            "warning: a best λ is at the edge of the range, 10^{} to 10^{}; the true optimum may lie beyond.",
            LOG_LAMBDA[0], LOG_LAMBDA[last]
        ));
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;
    #[test]
    fn errors_are_those_of_ratios_and_means_over_galaxies() {
        let mut sums = LambdaSums::default();
        // Correct of all transitions, and dSNR, of two galaxies.
        for (correct, all, dsnr) in [(1u64, 2u64, 3.0f64), (3, 4, 5.0)] {
            let [c, t] = [correct as f64, all as f64];
            sums.add(&LambdaSums {
                correct,
                transitions: all,
                transition_squares: [c * c, t * t, c * t],
                dsnr: [dsnr, dsnr * dsnr],
                galaxies: 1,
                ..LambdaSums::default()
            });
        }
        // 4/6, from which they are (1 − 4/3) and (3 − 8/3) off.
        let expected = (2.0f64 / 9.0).sqrt() / 6.0;
        assert!((sums.ctr().1 - expected).abs() < 1e-12);
        assert_eq!(sums.mean_dsnr().0, 4.0);
        assert!((sums.mean_dsnr().1 - 0.5f64.sqrt()).abs() < 1e-12);
    }
}
