//! Calibration of the regularisation parameter λ on synthetic galaxies (Sect. 4).
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
use shearq_measure::parts::{
    ClippedAcf, ClippedAcfScratch, Network, NetworkScratch, Rule, convolve, psf_factor,
};
use shearq_quantities::{Distortion, Shear};
use shearq_quantities::{FunctionalPsf, PsfProfile};
use shearq_submissions::{Configuration, NetworkDeconvolution, PsfScale, Update};

use super::speed::network_of;
use shearq_pipeline::PipelineError;
use shearq_pipeline::engine::{self, Progress};
use shearq_simulate::galaxy::{Component, Sersic};

/// S/N in dB of the curves.
pub const SNR_DB: [f64; 3] = [10.0, 20.0, 40.0];
/// log₁₀ λ of the curves: −6 to 6 in halves.
pub const LOG_LAMBDA: [f64; 25] = log_lambda();
/// Place of the paper's choice among them, λ = 10⁻⁴.
pub const PAPER_LAMBDA: usize = 4;
/// S/N in dB of the CTR curve at the λ of the paper's Fig. 4.
pub const CTR_SNR_DB: [f64; 7] = [10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0];
/// log₁₀ of that λ.
pub const CTR_LOG_LAMBDA: f64 = -3.5;
/// Both rules, in the order of [`Curves`].
pub const UPDATES: [Update; 2] = [Update::Adaptive, Update::Constant];

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
    /// Transitions that brought a neuron nearer to the truth.
    pub correct: u64,
    /// All transitions.
    pub transitions: u64,
    /// Sums over galaxies of the squares of their correct transitions and of all their transitions, and of the
    /// product of both, for the error of CTR.
    pub transition_squares: [f64; 3],
    /// Σ dSNR in dB.
    pub dsnr: f64,
    /// Σ dSNR², for its error.
    pub dsnr_square: f64,
    /// Galaxies.
    pub galaxies: u64,
    /// Σ |e − e*|².
    pub deviation: f64,
    /// Σ |e − e*|⁴, for the error of the RMSD.
    pub deviation_square: f64,
    /// Galaxies with a shape.
    pub measured: u64,
    /// Accepted iterations.
    pub iterations: u64,
}

impl LambdaSums {
    fn add(&mut self, other: &LambdaSums) {
        self.correct += other.correct;
        self.transitions += other.transitions;
        for (sum, more) in self
            .transition_squares
            .iter_mut()
            .zip(other.transition_squares)
        {
            *sum += more;
        }
        self.dsnr += other.dsnr;
        self.dsnr_square += other.dsnr_square;
        self.galaxies += other.galaxies;
        self.deviation += other.deviation;
        self.deviation_square += other.deviation_square;
        self.measured += other.measured;
        self.iterations += other.iterations;
    }

    /// CTR; not a number without transitions.
    pub fn ctr(&self) -> f64 {
        self.correct as f64 / self.transitions as f64
    }

    /// Standard error of CTR, which is a ratio of sums over galaxies: pixels of one galaxy go together.
    pub fn ctr_error(&self) -> f64 {
        let ctr = self.ctr();
        let [correct, all, both] = self.transition_squares;
        let square = correct - 2.0 * ctr * both + ctr * ctr * all;
        square.max(0.0).sqrt() / self.transitions as f64
    }

    /// Mean dSNR in dB.
    pub fn mean_dsnr(&self) -> f64 {
        self.dsnr / self.galaxies as f64
    }

    /// Standard error of the mean dSNR, from its scatter.
    pub fn mean_dsnr_error(&self) -> f64 {
        let (n, mean) = (self.galaxies as f64, self.mean_dsnr());
        ((self.dsnr_square / n - mean * mean).max(0.0) / n).sqrt()
    }

    /// 1/RMSD.
    pub fn inverse_rmsd(&self) -> f64 {
        (2.0 * self.measured as f64 / self.deviation).sqrt()
    }

    /// Standard error of 1/RMSD, from the scatter of |e − e*|².
    pub fn inverse_rmsd_error(&self) -> f64 {
        let n = self.measured as f64;
        let mean = self.deviation / n;
        let variance = (self.deviation_square / n - mean * mean) / n;
        0.5 * self.inverse_rmsd() * variance.sqrt() / mean
    }
}

/// The curves of Sect. 4.
#[derive(Debug, Clone)]
pub struct Curves {
    /// `[rule][S/N of SNR_DB][λ of LOG_LAMBDA]`.
    pub over_lambda: Vec<Vec<Vec<LambdaSums>>>,
    /// `[rule][S/N of CTR_SNR_DB]` at [`CTR_LOG_LAMBDA`].
    pub over_snr: Vec<Vec<LambdaSums>>,
    /// Galaxies.
    pub galaxies: u64,
}

impl Curves {
    fn new() -> Self {
        Curves {
            over_lambda: vec![vec![vec![LambdaSums::default(); LOG_LAMBDA.len()]; SNR_DB.len()]; 2],
            over_snr: vec![vec![LambdaSums::default(); CTR_SNR_DB.len()]; 2],
            galaxies: 0,
        }
    }

    fn add(&mut self, other: &Curves) {
        let mine = self.over_lambda.iter_mut().flatten().flatten();
        for (sum, more) in mine.zip(other.over_lambda.iter().flatten().flatten()) {
            sum.add(more);
        }
        let mine = self.over_snr.iter_mut().flatten();
        for (sum, more) in mine.zip(other.over_snr.iter().flatten()) {
            sum.add(more);
        }
        self.galaxies += other.galaxies;
    }

    /// The λ this study would choose for a rule: among the λ whose 1/RMSD, averaged over the three
    /// S/N relative to the best at each, is within two standard errors of the highest, the largest,
    /// which regularises most at no cost.
    pub fn best_log_lambda(&self, rule: usize) -> f64 {
        let relative = |k: usize| -> (f64, f64) {
            let (mut value, mut variance) = (0.0, 0.0);
            for curve in &self.over_lambda[rule] {
                let best = curve
                    .iter()
                    .map(LambdaSums::inverse_rmsd)
                    .fold(0.0, f64::max);
                value += curve[k].inverse_rmsd() / best / SNR_DB.len() as f64;
                variance += (curve[k].inverse_rmsd_error() / best / SNR_DB.len() as f64).powi(2);
            }
            (value, variance.sqrt())
        };
        let all: Vec<(f64, f64)> = (0..LOG_LAMBDA.len()).map(relative).collect();
        let best = all.iter().map(|v| v.0).fold(0.0, f64::max);
        (0..LOG_LAMBDA.len())
            .rev()
            .find(|&k| all[k].0 + 2.0 * all[k].1 >= best)
            .map_or(f64::NAN, |k| LOG_LAMBDA[k])
    }
}

/// Galaxies worked on together.
const CHUNK: u64 = 8;

/// Runs the study with the settings of `submission` (stamp and PSF size, step, start, M, unit, ACF
/// share), both rules in turn, on `galaxies` galaxies.
///
/// # Errors
/// Where the submission's sizes cannot be worked with.
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
            for first in (0..galaxies).step_by(CHUNK as usize) {
                if !feeder.push(first..(first + CHUNK).min(galaxies)) {
                    break;
                }
            }
            Ok(())
        },
        || planned.scratch(),
        |scratch, range: std::ops::Range<u64>| {
            let mut curves = Curves::new();
            for galaxy in range {
                planned.galaxy(seed, galaxy, scratch, &mut curves)?;
            }
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

/// Everything planned for one submission.
struct LambdaStudy {
    n: usize,
    p: usize,
    settings: NetworkDeconvolution,
    networks: Vec<Network>,
    ctr_network: Network,
    acf: ClippedAcf,
}

struct LambdaScratch {
    networks: Vec<Network>,
    ctr_network: Network,
    buffers: NetworkScratch,
    acf_scratch: ClippedAcfScratch,
    out: Vec<f32>,
}

/// One synthetic galaxy.
struct Synthetic {
    original: Vec<f32>,
    convolved: Vec<f64>,
    /// Of the sum or peak that the submission asks for.
    psf: Array2<f64>,
    shape: Distortion,
    /// White noise of unit variance.
    noise: Vec<f64>,
}

impl LambdaStudy {
    fn new(configuration: &Configuration) -> Result<Self, PipelineError> {
        let (n, p) = (configuration.stamp.size, configuration.psf.size);
        let method = network_of(configuration)?;
        let settings = method.deconvolution.clone();
        let plan = |log: f64| Network::plan(n, p, settings.printed_lambda(10f64.powf(log)));
        let networks = LOG_LAMBDA
            .iter()
            .map(|log| plan(*log))
            .collect::<Result<_, _>>()?;
        Ok(LambdaStudy {
            networks,
            ctr_network: plan(CTR_LOG_LAMBDA)?,
            acf: ClippedAcf::new(n, &method.shape),
            settings,
            n,
            p,
        })
    }

    fn scratch(&self) -> LambdaScratch {
        let n = self.n;
        LambdaScratch {
            networks: self.networks.clone(),
            ctr_network: self.ctr_network.clone(),
            buffers: self.ctr_network.scratch(),
            acf_scratch: self.acf.scratch(),
            out: vec![0.0; n * n],
        }
    }

    /// Adds one galaxy to all curves.
    fn galaxy(
        &self,
        seed: u64,
        number: u64,
        scratch: &mut LambdaScratch,
        curves: &mut Curves,
    ) -> Result<(), PipelineError> {
        let galaxy = self.draw(seed, number)?;
        for network in scratch
            .networks
            .iter_mut()
            .chain([&mut scratch.ctr_network])
        {
            network.set_psf(galaxy.psf.view(), PsfScale::Sum)?;
        }
        for (rule, update) in UPDATES.into_iter().enumerate() {
            for (s, snr) in SNR_DB.into_iter().enumerate() {
                let (stamp, sigma) = observe(&galaxy, snr);
                for k in 0..LOG_LAMBDA.len() {
                    let networks = std::mem::take(&mut scratch.networks);
                    let sums = self.run(&networks[k], update, &galaxy, &stamp, sigma, scratch);
                    scratch.networks = networks;
                    curves.over_lambda[rule][s][k].add(&sums?);
                }
            }
            for (s, snr) in CTR_SNR_DB.into_iter().enumerate() {
                let (stamp, sigma) = observe(&galaxy, snr);
                let network = scratch.ctr_network.clone();
                let sums = self.run(&network, update, &galaxy, &stamp, sigma, scratch)?;
                curves.over_snr[rule][s].add(&sums);
            }
        }
        curves.galaxies += 1;
        Ok(())
    }

    fn draw(&self, seed: u64, number: u64) -> Result<Synthetic, PipelineError> {
        let n = self.n;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(number);
        let mut normal = |scale: f64| -> f64 {
            let draw: f64 = StandardNormal.sample(&mut rng);
            scale * draw
        };
        let (e1, e2) = (normal(0.2), normal(0.2));
        let modulus = e1.hypot(e2);
        let cap = (0.6 / modulus).min(1.0);
        let shape = Shear::new(e1 * cap, e2 * cap);
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
        let psf = psf.stamp(self.p);
        // u₀ = Hu for the H that deconvolves, so that states compare with u.
        let factor = psf_factor(psf.view(), self.settings.psf_scale)?;
        let psf = psf.mapv(|value| value * factor);
        // Mean over 4 × 4 points of each pixel.
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
        network: &Network,
        update: Update,
        galaxy: &Synthetic,
        stamp: &[f32],
        sigma: f64,
        scratch: &mut LambdaScratch,
    ) -> Result<LambdaSums, PipelineError> {
        let settings = NetworkDeconvolution {
            update,
            ..self.settings.clone()
        };
        let mut sums = LambdaSums {
            galaxies: 1,
            ..LambdaSums::default()
        };
        let peak = stamp.iter().copied().fold(0.0f32, f32::max);
        let Some(rule) = Rule::new(&settings, f64::from(peak), sigma) else {
            return Ok(sums);
        };
        let original = &galaxy.original;
        let (mut correct, mut transitions) = (0, 0);
        let descent = network.trace(
            &rule,
            stamp,
            &mut scratch.buffers,
            &mut scratch.out,
            |before, after| {
                for ((b, a), u) in before.iter().zip(after).zip(original) {
                    if a != b {
                        transitions += 1;
                        correct += u64::from((a - u).abs() < (b - u).abs());
                    }
                }
            },
        )?;
        (sums.correct, sums.transitions) = (correct, transitions);
        let [c, t] = [correct as f64, transitions as f64];
        sums.transition_squares = [c * c, t * t, c * t];
        sums.iterations = u64::from(descent.iterations);
        let distance = |image: &[f32]| -> f64 {
            image
                .iter()
                .zip(original)
                .map(|(v, u)| f64::from(v - u).powi(2))
                .sum()
        };
        sums.dsnr = 10.0 * (distance(stamp) / distance(&scratch.out)).log10();
        sums.dsnr_square = sums.dsnr * sums.dsnr;
        let light = scratch.out.iter().map(|&v| f64::from(v)).sum();
        let shape = self
            .acf
            .measure(&scratch.out, light, &mut scratch.acf_scratch)?
            .and_then(|moments| moments.distortion());
        if let Ok(Distortion { e1, e2 }) = shape {
            let deviation = (e1 - galaxy.shape.e1).powi(2) + (e2 - galaxy.shape.e2).powi(2);
            sums.deviation = deviation;
            sums.deviation_square = deviation * deviation;
            sums.measured = 1;
        }
        Ok(sums)
    }
}

/// The observed stamp at a S/N in dB, and its noise level.
fn observe(galaxy: &Synthetic, snr_db: f64) -> (Vec<f32>, f64) {
    let image = &galaxy.convolved;
    let count = image.len() as f64;
    let mean = image.iter().sum::<f64>() / count;
    let variance = image.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / count;
    let sigma = (variance / 10f64.powf(snr_db / 10.0)).sqrt();
    let stamp = image
        .iter()
        .zip(&galaxy.noise)
        .map(|(v, n)| (v + sigma * n) as f32)
        .collect();
    (stamp, sigma)
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
                dsnr,
                dsnr_square: dsnr * dsnr,
                galaxies: 1,
                ..LambdaSums::default()
            });
        }
        // 4/6, from which they are (1 − 4/3) and (3 − 8/3) off.
        let expected = (2.0f64 / 9.0).sqrt() / 6.0;
        assert!((sums.ctr_error() - expected).abs() < 1e-12);
        assert_eq!(sums.mean_dsnr(), 4.0);
        assert!((sums.mean_dsnr_error() - 0.5f64.sqrt()).abs() < 1e-12);
    }
}
