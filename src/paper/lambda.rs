//! Sect. 4 of the paper: the regularisation parameter λ on synthetic galaxies, Figs 4 to 7.
//!
//! A galaxy is an exponential (Sérsic n = 1) profile u on a stamp; the observed stamp is u₀ = Hu + n with a Moffat PSF
//! (β = 3) of the galaxy's own and white noise of S/N = 10 log₁₀(σ_S²/σ²) dB, σ_S² being the variance of Hu over the stamp.
//!
//! * CTR = K_c/K_t (Eq. 17): of all changes of a neuron's state, the share that brings it nearer to u. The update that
//!   raises the energy and ends the run counts as attempted.
//! * dSNR = 10 log₁₀(‖u₀ − u‖²/‖u* − u‖²) (Eq. 18), mean over galaxies.
//! * 1/RMSD = √(2N/Σ|e − e*|²) (Eq. 19), distortions, over the galaxies that could be measured.

use std::ops::Range;

use anyhow::Context;
use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_dataset::threads::Progress;
use shearq_measure::parts::{
    ClippedAcf, ClippedAcfScratch, Network, NetworkScratch, Rule, convolve, psf_factor,
};
use shearq_pipeline::{PipelineError, engine};
use shearq_quantities::statistics::RunningMean;
use shearq_quantities::{Distortion, FunctionalPsf, PsfProfile, Shear};
use shearq_render::figure::{LinePlot, PanelGrid, Series, Style};
use shearq_render::page::{Page, PageError};
use shearq_render::table::{Cell, Table};
use shearq_simulate::galaxy::{Component, Sersic};
use shearq_submissions::{Configuration, NetworkDeconvolution, PsfScale, Update};

// λ of the curves: 10^−6 to 10^6 in steps of half a decade.
const LAMBDAS: usize = 25;
// Place of the paper's choice among them, λ = 10⁻⁴.
const PAPER_LAMBDA: usize = 4;
// Place of λ = 10^−3.5, at which the paper's Fig. 4 shows CTR against S/N.
const FIG_4_LAMBDA: usize = 5;
// S/N in dB of Fig. 4. The paper shows curves over λ at three of them.
const SNR_DB: [f64; 7] = [10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0];
const SNR_DB_OVER_LAMBDA: [f64; 3] = [10.0, 20.0, 40.0];
// The adaptive update is dashed, as in the paper.
const UPDATES: [(Update, &str, Style); 2] = [
    (Update::Adaptive, "adaptive", Style::Dashed),
    (Update::Constant, "constant", Style::Line),
];

fn log_lambda(place: usize) -> f64 {
    -6.0 + 0.5 * place as f64
}

// A value and its standard error.
type Measured = (f64, f64);

// One galaxy, deconvolved with one λ.
#[derive(Default)]
struct Outcome {
    // Transitions that brought a neuron nearer to the truth, of all.
    correct: u64,
    transitions: u64,
    iterations: u32,
    dsnr: f64,
    // |e − e*|² of a galaxy with a shape.
    deviation: Option<f64>,
}

#[derive(Debug, Clone, Default)]
struct Sums {
    correct: u64,
    transitions: u64,
    // Σ correct², Σ all² and Σ correct·all over galaxies, for the error of CTR.
    transition_squares: [f64; 3],
    dsnr: RunningMean,
    deviation: RunningMean,
    iterations: u64,
}

impl Sums {
    fn add(&mut self, outcome: &Outcome) {
        self.correct += outcome.correct;
        self.transitions += outcome.transitions;
        let [c, t] = [outcome.correct as f64, outcome.transitions as f64];
        let squares = [c * c, t * t, c * t];
        let sums = self.transition_squares.iter_mut().zip(squares);
        sums.for_each(|(sum, square)| *sum += square);
        self.dsnr.add(outcome.dsnr);
        if let Some(deviation) = outcome.deviation {
            self.deviation.add(deviation);
        }
        self.iterations += u64::from(outcome.iterations);
    }

    // NaN without transitions.
    fn ctr(&self) -> Measured {
        let ctr = self.correct as f64 / self.transitions as f64;
        // The error of a ratio of sums over galaxies, not over pixels: those of one galaxy go together.
        let [correct, all, both] = self.transition_squares;
        let square = correct - 2.0 * ctr * both + ctr * ctr * all;
        (ctr, square.max(0.0).sqrt() / self.transitions as f64)
    }

    // In dB.
    fn dsnr(&self) -> Measured {
        (self.dsnr.mean(), error_of_mean(&self.dsnr))
    }

    fn inverse_rmsd(&self) -> Measured {
        let mean = self.deviation.mean();
        let value = (2.0 / mean).sqrt();
        (value, 0.5 * value * error_of_mean(&self.deviation) / mean)
    }
}

fn error_of_mean(values: &RunningMean) -> f64 {
    values.deviation() / (values.count() as f64).sqrt()
}

/// An update and S/N, with the sums over galaxies at each λ.
#[derive(Debug, Clone)]
pub(crate) struct Curve {
    update: Update,
    snr_db: f64,
    lambdas: Range<usize>,
    sums: Vec<Sums>,
}

impl Curve {
    fn at(&self, lambda: usize) -> &Sums {
        &self.sums[lambda - self.lambdas.start]
    }

    fn is_over_lambda(&self) -> bool {
        self.sums.len() == LAMBDAS
    }

    fn update_name(&self) -> &'static str {
        let named = UPDATES.iter().find(|(update, ..)| *update == self.update);
        named.map_or("", |(_, name, _)| name)
    }
}

fn empty_curves() -> Vec<Curve> {
    let curve = |update, snr_db| {
        let lambdas = match SNR_DB_OVER_LAMBDA.contains(&snr_db) {
            true => 0..LAMBDAS,
            false => FIG_4_LAMBDA..FIG_4_LAMBDA + 1,
        };
        Curve {
            update,
            snr_db,
            sums: vec![Sums::default(); lambdas.len()],
            lambdas,
        }
    };
    let updates = UPDATES.iter();
    let curves = updates.flat_map(|&(update, ..)| SNR_DB.map(|snr_db| curve(update, snr_db)));
    curves.collect()
}

// Galaxies per unit of work. Each is deconvolved 158 times.
const CHUNK: u64 = 8;

/// Deconvolves synthetic galaxies with the settings of a network, by both updating rules.
pub(crate) fn calibrate(
    configuration: &Configuration,
    galaxies: u64,
    seed: u64,
    threads: usize,
    progress: &mut dyn Progress,
) -> anyhow::Result<Vec<Curve>> {
    let deconvolution = Deconvolution::new(configuration)?;
    let mut curves = empty_curves();
    engine::ordered(
        threads,
        |feeder| {
            let mut firsts = (0..galaxies).step_by(CHUNK as usize);
            firsts.all(|first| feeder.push(first..(first + CHUNK).min(galaxies)));
            Ok(())
        },
        || deconvolution.worker(),
        |worker, range: Range<u64>| {
            let outcomes = range.map(|galaxy| deconvolution.galaxy(seed, galaxy, worker));
            outcomes.collect::<Result<Vec<_>, _>>()
        },
        |of_galaxies| {
            progress.advance(of_galaxies.len() as u64);
            for outcomes in of_galaxies {
                let sums = curves.iter_mut().flat_map(|curve| &mut curve.sums);
                sums.zip(&outcomes)
                    .for_each(|(sums, outcome)| sums.add(outcome));
            }
            Ok(())
        },
    )?;
    Ok(curves)
}

struct Deconvolution {
    stamp_size: usize,
    psf_size: usize,
    settings: NetworkDeconvolution,
    // One per λ.
    networks: Vec<Network>,
    acf: ClippedAcf,
    curves: Vec<Curve>,
}

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

impl Deconvolution {
    fn new(configuration: &Configuration) -> anyhow::Result<Self> {
        let (stamp_size, psf_size) = (configuration.stamp.size, configuration.psf.size);
        let method = configuration.network();
        let method = method.context("a linear configuration has no λ")?;
        let settings = method.deconvolution.clone();
        let networks = (0..LAMBDAS).map(|place| {
            let lambda = settings.printed_lambda(10f64.powf(log_lambda(place)));
            Network::plan(stamp_size, psf_size, lambda)
        });
        Ok(Deconvolution {
            networks: networks.collect::<Result<_, _>>()?,
            acf: ClippedAcf::new(stamp_size, &method.shape),
            settings,
            stamp_size,
            psf_size,
            curves: empty_curves(),
        })
    }

    fn worker(&self) -> Worker {
        Worker {
            networks: self.networks.clone(),
            scratch: self.networks[0].scratch(),
            acf: self.acf.scratch(),
            out: vec![0.0; self.stamp_size * self.stamp_size],
        }
    }

    // The outcomes of galaxy `number` in the order of the curves and their λ.
    fn galaxy(
        &self,
        seed: u64,
        number: u64,
        worker: &mut Worker,
    ) -> Result<Vec<Outcome>, PipelineError> {
        let galaxy = self.draw(seed, number)?;
        for network in &mut worker.networks {
            network.set_psf(galaxy.psf.view(), PsfScale::Sum)?;
        }
        let mut outcomes = Vec::new();
        for curve in &self.curves {
            let settings = NetworkDeconvolution {
                update: curve.update,
                ..self.settings.clone()
            };
            let (stamp, sigma) = observe(&galaxy, curve.snr_db);
            let peak = stamp.iter().copied().fold(0.0f32, f32::max);
            let rule = Rule::new(&settings, f64::from(peak), sigma);
            for lambda in curve.lambdas.clone() {
                outcomes.push(match &rule {
                    Some(rule) => self.deconvolve(worker, lambda, rule, &galaxy, &stamp)?,
                    None => Outcome::default(),
                });
            }
        }
        Ok(outcomes)
    }

    // The paper gives none of the distributions of radii, widths and ellipticities; these were chosen by hand.
    fn draw(&self, seed: u64, number: u64) -> Result<Synthetic, PipelineError> {
        let n = self.stamp_size;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // A stream for each galaxy, so that the number of threads does not matter.
        rng.set_stream(number);
        let mut normal = |scale: f64| -> f64 {
            let draw: f64 = StandardNormal.sample(&mut rng);
            scale * draw
        };
        let (e1, e2) = (normal(0.2), normal(0.2));
        let cap = (0.6 / e1.hypot(e2)).min(1.0);
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

    fn deconvolve(
        &self,
        worker: &mut Worker,
        lambda: usize,
        rule: &Rule,
        galaxy: &Synthetic,
        stamp: &[f32],
    ) -> Result<Outcome, PipelineError> {
        let Worker {
            networks,
            scratch,
            acf,
            out,
        } = worker;
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
        let descent = networks[lambda].trace(rule, stamp, scratch, out, count)?;
        let distance = |image: &[f32]| -> f64 {
            let pixels = image.iter().zip(original);
            pixels.map(|(v, u)| f64::from(v - u).powi(2)).sum()
        };
        let light = out.iter().map(|&v| f64::from(v)).sum();
        let moments = self.acf.measure(out, light, acf)?;
        let shape = moments.and_then(|moments| moments.distortion()).ok();
        let deviation =
            |e: Distortion| (e.e1 - galaxy.shape.e1).powi(2) + (e.e2 - galaxy.shape.e2).powi(2);
        Ok(Outcome {
            correct,
            transitions,
            iterations: descent.iterations,
            dsnr: 10.0 * (distance(stamp) / distance(out)).log10(),
            deviation: shape.map(deviation),
        })
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

fn series(
    label: &str,
    points: impl Iterator<Item = (f64, Measured)>,
    (style, colour): (Style, usize),
) -> Series {
    let (x, measured): (_, Vec<Measured>) = points.unzip();
    let (y, errors) = measured.into_iter().unzip();
    Series::new(label, x, y, style, colour).with_errors(errors)
}

fn over_lambda(
    curve: &Curve,
    value: fn(&Sums) -> Measured,
) -> impl Iterator<Item = (f64, Measured)> {
    let points = curve.lambdas.clone().zip(&curve.sums);
    points.map(move |(place, sums)| (10f64.powf(log_lambda(place)), value(sums)))
}

/// Draws Figs 4 to 7 and writes their data.
pub(crate) fn figures(page: &mut Page<'_>, curves: &[Curve]) -> Result<(), PageError> {
    let of_update = |update| curves.iter().filter(move |curve| curve.update == update);
    let against_snr = UPDATES
        .iter()
        .enumerate()
        .map(|(k, &(update, name, style))| {
            let points =
                of_update(update).map(|curve| (curve.snr_db, curve.at(FIG_4_LAMBDA).ctr()));
            series(name, points, (style, k))
        });
    page.figure(
        "fig4-ctr-snr",
        &LinePlot {
            title: "Correct transition rate, λ = 10⁻³·⁵".into(),
            x_label: "SNR [dB]".into(),
            y_label: "CTR".into(),
            series: against_snr.collect(),
            ..LinePlot::default()
        },
        "As Fig. 4 of the paper: correct transition rate against S/N for the adaptive and the constant update.",
    )?;
    let plot = |title: String, y_label: &str, series| LinePlot {
        title,
        x_label: "λ".into(),
        y_label: y_label.into(),
        x_log: true,
        series,
        ..LinePlot::default()
    };
    let adaptive = |title: &str, y_label: &str, value: fn(&Sums) -> Measured| {
        let curves = of_update(Update::Adaptive).filter(|curve| curve.is_over_lambda());
        let series = curves.enumerate().map(|(k, curve)| {
            let label = format!("SNR {} dB", curve.snr_db);
            series(&label, over_lambda(curve, value), (Style::Line, k))
        });
        plot(title.into(), y_label, series.collect())
    };
    page.figure(
        "fig5-ctr-lambda",
        &adaptive("Correct transition rate", "CTR", Sums::ctr),
        "As Fig. 5 of the paper: correct transition rate against λ, adaptive update.",
    )?;
    page.figure(
        "fig6-dsnr-lambda",
        &adaptive(
            "Discriminative signal-to-noise ratio",
            "dSNR [dB]",
            Sums::dsnr,
        ),
        "As Fig. 6 of the paper: discriminative signal-to-noise ratio against λ, adaptive update.",
    )?;
    let panel = |snr_db: f64| {
        let both = UPDATES.iter().enumerate();
        let both = both.flat_map(|(k, &(update, name, style))| {
            let curves = of_update(update).filter(move |curve| curve.snr_db == snr_db);
            curves
                .map(move |curve| series(name, over_lambda(curve, Sums::inverse_rmsd), (style, k)))
        });
        plot(format!("SNR {snr_db} dB"), "1/RMSD", both.collect())
    };
    page.figure(
        "fig7-rmsd-lambda",
        &PanelGrid {
            title: "Accuracy of the ellipticities".into(),
            columns: 3,
            plots: SNR_DB_OVER_LAMBDA.map(panel).into(),
        },
        "As Fig. 7 of the paper: 1/RMSD of the ellipticities against λ for both updates.",
    )?;
    page.data("curves", &curves_table(curves))
}

fn measured((value, error): Measured, decimals: usize) -> Cell {
    Cell::with_error(value, Some(error), decimals)
}

// The data of Figs 4 to 7.
fn curves_table(curves: &[Curve]) -> Table {
    let points = |curve: &'_ Curve| -> Vec<_> {
        let points = curve.lambdas.clone().zip(curve.sums.iter().cloned());
        let curve = (curve.update_name(), curve.snr_db);
        points
            .map(|(lambda, sums)| (curve, log_lambda(lambda), sums))
            .collect()
    };
    let rows: Vec<((&str, f64), f64, Sums)> = curves.iter().flat_map(points).collect();
    let mut table = Table::titled("Deconvolution of synthetic galaxies");
    table.column("update", "Update", &rows, |row| Cell::text(row.0.0));
    table.column("snr_db", "SNR [dB]", &rows, |row| Cell::number(row.0.1, 0));
    table.column("log10_lambda", "log λ", &rows, |row| {
        Cell::number(row.1, 1)
    });
    table.column("ctr", "CTR", &rows, |row| measured(row.2.ctr(), 4));
    table.column("dsnr_db", "dSNR [dB]", &rows, |row| {
        measured(row.2.dsnr(), 3)
    });
    table.column("inverse_rmsd", "1/RMSD", &rows, |row| {
        measured(row.2.inverse_rmsd(), 3)
    });
    table.column("iterations", "Iterations", &rows, |row| {
        Cell::number(row.2.iterations as f64 / row.2.dsnr.count() as f64, 1)
    });
    table
}

/// The best λ at each S/N, and the values at the paper's choice.
pub(crate) fn best_table(curves: &[Curve], galaxies: u64) -> Table {
    let curves = curves.iter().filter(|curve| curve.is_over_lambda());
    let best = |curve: &Curve| {
        let at = |place: &usize| curve.at(*place).inverse_rmsd().0;
        (0..LAMBDAS)
            .max_by(|a, b| at(a).total_cmp(&at(b)))
            .unwrap_or(0)
    };
    let rows: Vec<(&Curve, usize)> = curves.map(|curve| (curve, best(curve))).collect();
    let mut table = Table::titled(format!("λ on {galaxies} synthetic galaxies"));
    table.column("update", "Update", &rows, |row| {
        Cell::text(row.0.update_name())
    });
    table.column("snr_db", "SNR [dB]", &rows, |row| {
        Cell::number(row.0.snr_db, 0)
    });
    table.column("best_log10_lambda", "best log λ", &rows, |row| {
        Cell::number(log_lambda(row.1), 1)
    });
    table.column(
        "inverse_rmsd_best",
        "1/RMSD there",
        &rows,
        |(curve, best)| measured(curve.at(*best).inverse_rmsd(), 3),
    );
    let mut at_paper = |key, label, value: fn(&Sums) -> Measured, decimals| {
        table.column(key, label, &rows, |(curve, _)| {
            measured(value(curve.at(PAPER_LAMBDA)), decimals)
        });
    };
    at_paper("inverse_rmsd", "1/RMSD at 10⁻⁴", Sums::inverse_rmsd, 3);
    at_paper("ctr", "CTR at 10⁻⁴", Sums::ctr, 4);
    at_paper("dsnr_db", "dSNR at 10⁻⁴ [dB]", Sums::dsnr, 2);
    table.notes = vec!["The paper chooses λ = 10⁻⁴.".into()];
    if rows.iter().any(|(_, best)| [0, LAMBDAS - 1].contains(best)) {
        table.notes.push(format!(
            "warning: a best λ is at the edge of the range, 10^{} to 10^{}; the true optimum may lie beyond.",
            log_lambda(0),
            log_lambda(LAMBDAS - 1)
        ));
    }
    table
}

#[cfg(test)]
mod tests {
    use shearq_dataset::threads::Quiet;
    use shearq_submissions::Registry;

    use super::*;

    #[test]
    fn errors_are_those_of_ratios_and_means_over_galaxies() {
        let mut sums = Sums::default();
        for (correct, transitions, dsnr) in [(1, 2, 3.0), (3, 4, 5.0)] {
            sums.add(&Outcome {
                correct,
                transitions,
                dsnr,
                ..Outcome::default()
            });
        }
        // 4/6, from which they are (1 − 4/3) and (3 − 8/3) off.
        let expected = (2.0f64 / 9.0).sqrt() / 6.0;
        assert!((sums.ctr().1 - expected).abs() < 1e-12);
        // Deviation √2 of two galaxies.
        assert_eq!(sums.dsnr().0, 4.0);
        assert!((sums.dsnr().1 - 1.0).abs() < 1e-12);
    }

    #[test]
    fn updates_compare_as_the_paper_found() {
        let registry = Registry::embedded().unwrap();
        let of = |name: &str| {
            // CTR rests on 10⁴ transitions a galaxy; 1/RMSD of both rules on the same galaxies.
            let configuration = registry.get(name).unwrap().configuration;
            let curves = calibrate(&configuration, 40, 3, 2, &mut Quiet).unwrap();
            let middle = curves.len() / 2;
            let whole = |curves: &[Curve]| -> Vec<Curve> {
                let whole = curves.iter().filter(|curve| curve.is_over_lambda());
                whole.cloned().collect()
            };
            // At the S/N of Fig. 4, and over λ.
            let [adaptive, constant] = [&curves[..middle], &curves[middle..]].map(whole);
            (curves, adaptive, constant)
        };
        let (_, adaptive, constant) = of("paper");
        let (all_printed, adaptive_printed, constant_printed) = of("as-printed/paper");
        // CTR is highest at λ = 10^−3.5 at each S/N, but not as printed.
        let ctr_is_highest = |curve: &Curve| {
            let others = (0..LAMBDAS).filter(|place| *place != FIG_4_LAMBDA);
            let highest = curve.at(FIG_4_LAMBDA).ctr().0;
            { others }.all(|place| curve.at(place).ctr().0 < highest)
        };
        assert!(adaptive.iter().all(ctr_is_highest));
        assert!(!adaptive_printed.iter().all(ctr_is_highest));
        // 1/RMSD of the adaptive update is the better one for λ ≤ 10⁻⁴, whatever the S/N.
        let both = adaptive.iter().zip(&constant);
        for (adaptive, constant) in both.chain(adaptive_printed.iter().zip(&constant_printed)) {
            for weak in 0..=PAPER_LAMBDA {
                let [adaptive, constant] = [adaptive, constant].map(|c| c.at(weak).inverse_rmsd());
                assert!(adaptive.0 >= constant.0);
            }
        }
        // As printed, the adaptive update has the higher CTR at each S/N, and dSNR rises with S/N and decreases with λ.
        let (fig_4_adaptive, fig_4_constant) = all_printed.split_at(SNR_DB.len());
        for (adaptive, constant) in fig_4_adaptive.iter().zip(fig_4_constant) {
            assert!(adaptive.at(FIG_4_LAMBDA).ctr().0 > constant.at(FIG_4_LAMBDA).ctr().0);
        }
        let dsnr =
            |curve: &Curve| [PAPER_LAMBDA, LAMBDAS - 1].map(|place| curve.at(place).dsnr().0);
        let printed = adaptive_printed.iter().map(dsnr).collect::<Vec<_>>();
        assert!(printed.is_sorted_by(|a, b| a[0] < b[0]));
        assert!(printed.iter().all(|[paper, strongest]| strongest < paper));
        for [paper, strongest] in adaptive.iter().map(dsnr) {
            // By two decibels and more, each known to a few tenths.
            assert!(strongest < paper - 1.0);
        }
        // The mean over S/N; λ has steps of half a decade.
        let highest_ctr = |curves: &[Curve]| {
            let sum = |place: &usize| curves.iter().map(|c| c.at(*place).ctr().0).sum::<f64>();
            let best = (0..LAMBDAS).max_by(|a, b| sum(a).total_cmp(&sum(b)));
            log_lambda(best.unwrap())
        };
        let [adopted, printed] = [&adaptive, &adaptive_printed].map(|curves| highest_ctr(curves));
        assert!((-4.0..=-3.0).contains(&adopted), "10^{adopted}");
        assert!(printed > 0.0, "10^{printed}");
    }
}
