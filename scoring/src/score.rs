//! Scores of one set in every convention: noise, biases, null tests and their errors.

use std::fmt::Display;
use std::str::FromStr;

use ndarray::Array2;
#[cfg(feature = "serde")]
use serde::Serialize;
use shearq_quantities::fourier::Complex64;
use shearq_quantities::statistics::MIN_RESPONSE_SIGNIFICANCE;

use crate::bandpower::{BINS, Bins, Definition, SCORED};
use crate::catalogue::{FieldSum, SetImages, TrueShear};
use crate::convention::{Convention, ConventionClass, ConventionMatch};
use crate::error::ScoringError;
use crate::errors::{self, Scatter};
use crate::grid::{Grid, check_shape};
use crate::metrics::Metrics;
use crate::modes::{Decomposer, Modes};
use crate::quality::{
    BiasFits, Quality, ShearBias, bias_fits, calibrated_quality, quality, quality_error,
};
use crate::resample::jackknife_error;

/// How to choose the convention of the metrics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Choice {
    /// The convention that correlates significantly best with the truth, otherwise the standard one.
    #[default]
    Matched,
    /// The convention with the highest Q, as on the challenge's leaderboard.
    Best,
    /// This convention.
    Insist(Convention),
}

impl Display for Choice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Choice::Matched => f.write_str("matched"),
            Choice::Best => f.write_str("best"),
            Choice::Insist(convention) => convention.number().fmt(f),
        }
    }
}

impl FromStr for Choice {
    type Err = &'static str;

    /// `matched`, `best` or the number of a convention.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let insisted = |number: u8| Some(Choice::Insist(Convention::try_from(number).ok()?));
        match text {
            "matched" => Ok(Choice::Matched),
            "best" => Ok(Choice::Best),
            _ => text
                .parse()
                .ok()
                .and_then(insisted)
                .ok_or("expected `matched`, `best` or a number from 1 to 8"),
        }
    }
}

/// Noise of the ellipticities, for Q_dn.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Noise {
    /// This variance per component, galaxy and image.
    Given(f64),
    /// Measured from the scatter of the E modes between images of the set.
    #[default]
    Measured,
}

impl Display for Noise {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Noise::Given(variance) => variance.fmt(f),
            Noise::Measured => f.write_str("measured"),
        }
    }
}

impl FromStr for Noise {
    type Err = &'static str;

    /// `measured`, or a variance.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.parse() {
            _ if text == "measured" => Ok(Noise::Measured),
            Ok(variance) if variance >= 0.0 && f64::is_finite(variance) => {
                Ok(Noise::Given(variance))
            }
            _ => Err("expected `measured`, zero or a positive number"),
        }
    }
}

/// How to score.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Options {
    /// Bandpower definition.
    pub definition: Definition,
    /// Noise to remove for Q_dn.
    pub noise: Noise,
    /// Convention of the metrics.
    pub choice: Choice,
}

/// One convention's spectra and metrics.
#[derive(Debug, Clone)]
#[cfg_attr(feature = "serde", derive(Serialize))]
#[non_exhaustive]
pub struct ConventionScore {
    /// The convention.
    pub convention: Convention,
    /// E-mode bandpowers.
    pub ee: [f64; BINS],
    /// B-mode bandpowers.
    pub bb: [f64; BINS],
    /// EB cross bandpowers; consistent with zero for a sound measurement.
    pub eb: [f64; BINS],
    /// Correlation of the E modes with the true ones over bins 2 to 9, −1 to 1.
    pub correlation: f64,
    /// Σ Re(E_t E*)/Σ|E_t|² − 1 over bins 2 to 9: the multiplicative bias of the shear by
    /// cross-correlation with the truth.
    pub m_cross: f64,
    /// Q and σ_sys.
    pub quality: Quality,
    /// Q of the spectrum divided by (1 + m)², m by cross-correlation.
    pub quality_calibrated: Quality,
    /// Q after subtracting the noise power; `None` if the noise is unknown.
    pub quality_dn: Option<Quality>,
    pub(crate) noise_free: [f64; BINS],
    /// M and A before subtracting the noise power.
    pub fit: BiasFits,
    /// M and A after subtracting the noise power; `None` if the noise is unknown.
    pub fit_dn: Option<BiasFits>,
}

/// Mean ellipticity of a set with constant true shear, in the chosen convention. Such a set has no power to
/// compare; its means are its metrics.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
#[non_exhaustive]
pub struct MeanShear {
    /// Mean ellipticity of the galaxies.
    pub e: [f64; 2],
    /// Standard error of the mean.
    pub error: [f64; 2],
    /// The true shear.
    pub truth: [f64; 2],
}

/// The score of one set.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct SetScore {
    /// The grid.
    pub grid: Grid,
    /// The bins of the definition used.
    pub bins: Bins,
    /// Images averaged over.
    pub images: usize,
    /// Bandpowers of the true shear's E modes.
    pub true_ee: [f64; BINS],
    /// Bandpowers of the true shear's B modes; nonzero if the sign of g₂ is wrong.
    pub true_bb: [f64; BINS],
    /// Standard errors of the scored E-mode bandpowers in the chosen convention, for a fixed truth. Not numbers in
    /// other bins, or if unknown.
    pub ee_error: [f64; BINS],
    /// Noise bandpowers of the averaged E modes, if known.
    pub noise: Option<[f64; BINS]>,
    /// Noise variance per component, galaxy and image that corresponds to `noise`.
    pub noise_variance: Option<f64>,
    /// All eight conventions, in order.
    pub conventions: Vec<ConventionScore>,
    /// The convention with the highest Q.
    pub best: Convention,
    /// How well each convention correlates with the truth.
    pub matching: ConventionMatch,
    /// The convention of the metrics.
    pub chosen: Convention,
    /// Metrics in the chosen convention. NaN: Q_dn and the noise of a galaxy if the noise is unknown, calibrated Q and that noise
    /// if the response is less than 3σ above zero, most metrics if the true shear is constant.
    pub metrics: Metrics,
    /// Standard errors of the metrics; not a number if unknown.
    pub errors: Metrics,
    /// The metrics with each group of images left out in turn; empty with fewer than two images.
    pub replicates: Vec<Metrics>,
    /// Means, if the true shear is the same everywhere. All metrics except c1 and c2 are then unknown.
    pub constant: Option<MeanShear>,
}

impl SetScore {
    /// The chosen convention's spectra.
    pub fn spectra(&self) -> &ConventionScore {
        &self.conventions[self.chosen.index()]
    }

    /// Whether the convention with the highest Q is of another class than the chosen one. Its Q is then due to
    /// a wrong convention, not to a good measurement.
    pub fn wrong_convention_wins(&self) -> bool {
        self.best.class() != self.chosen.class()
    }

    /// Q of zero shear: what an entry without images has. It exceeds the Q of measurements while their noise power exceeds
    /// the power of the shear.
    pub fn zero_quality(&self) -> Quality {
        quality(&self.bins, &[0.0; BINS], &self.true_ee)
    }

    /// Share of B modes in the scored true power. It is about one half if the sign of g₂ is wrong.
    pub fn true_b_share(&self) -> f64 {
        let sum = |p: &[f64; BINS]| SCORED.map(|b| p[b]).sum::<f64>();
        let (e, b) = (sum(&self.true_ee), sum(&self.true_bb));
        b / (e + b)
    }
}

/// Covariance of the eight scored bandpowers of a power spectrum.
pub type SpectrumCovariance = [[f64; SCORED.end - SCORED.start]; SCORED.end - SCORED.start];

/// The score of a power spectrum: Q, M/2, √A and σ_sys. Only catalogues have the other metrics.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct SpectrumScore {
    /// Metrics; not a number if only catalogues have them.
    pub metrics: Metrics,
    /// Standard errors of Q, M/2 and √A; not a number if the covariance is unknown.
    pub errors: Metrics,
    /// Q of zero shear, which an entry has without any image.
    pub zero_q: f64,
}

// Power and noise gain of the mean field of a group of images, or of all images.
#[derive(Debug, Clone, Copy)]
struct MeanPower {
    power: [[f64; BINS]; 2],
    // Noise variance of the field per unit noise variance of a galaxy.
    gain: f64,
}

type NoisePower = [[f64; BINS]; 2];

/// Scores catalogues and power spectra of one set against its true shear.
#[derive(Debug, Clone)]
pub struct SetScorer {
    grid: Grid,
    options: Options,
    decomposer: Decomposer,
    bins: Bins,
    truth: TrueShear,
}

impl SetScorer {
    /// Prepares the transforms and bins.
    ///
    /// # Errors
    /// If the shape of the truth differs from the grid, or if a given noise variance is negative or not finite.
    pub fn new(grid: Grid, truth: TrueShear, options: Options) -> Result<Self, ScoringError> {
        if let Noise::Given(variance) = options.noise
            && !(variance.is_finite() && variance >= 0.0)
        {
            return Err(ScoringError::NoiseVariance(variance));
        }
        check_shape("g1 of the truth", &truth.g1, grid.n)?;
        check_shape("g2 of the truth", &truth.g2, grid.n)?;
        Ok(SetScorer {
            grid,
            options,
            decomposer: Decomposer::new(grid),
            bins: Bins::new(&grid, options.definition),
            truth,
        })
    }

    pub(crate) fn check_images(&self, images: &SetImages) -> Result<(), ScoringError> {
        if images.total().images == 0 {
            return Err(ScoringError::NoImages);
        }
        check_shape("the sum of the images", &images.total().e1, self.grid.n)
    }

    /// Scores the images of a set.
    ///
    /// # Errors
    /// If there is no image, or if the shape of the images differs from the grid.
    pub fn score(&self, images: &SetImages) -> Result<SetScore, ScoringError> {
        self.check_images(images)?;
        let total = images.total();
        let groups: Vec<MeanPower> = match self.options.noise {
            Noise::Given(_) => Vec::new(),
            Noise::Measured => images.groups().iter().map(|g| self.mean_power(g)).collect(),
        };
        let noise = self.noise_power(total, &groups);
        let conventions = Convention::ALL.map(|k| {
            let (modes, truth) = (self.modes(total, k), self.true_modes(total, k));
            self.convention_score(k, &modes, &truth, noise.as_ref())
        });
        let matching = ConventionMatch::new(
            conventions.each_ref().map(|c| c.correlation),
            self.scored_modes(),
        );
        let best = best_of(&conventions);
        let chosen = match self.options.choice {
            Choice::Matched => matching.convention(),
            Choice::Best => best,
            Choice::Insist(k) => k,
        };
        let mut metrics = self.metrics(total, &conventions[chosen.index()]);
        let replicates = self.replicates(images, chosen, &groups, noise.as_ref());
        let chosen_one = &conventions[chosen.index()];
        let (mut errors, ee_error) = self.errors(images, chosen_one, &metrics, &replicates);
        // Nothing can be divided by a response that is consistent with zero.
        if 1.0 + metrics.m_cross < MIN_RESPONSE_SIGNIFICANCE * errors.m_cross {
            for of in [&mut metrics, &mut errors] {
                (of.q_calibrated, of.galaxy_noise) = (f64::NAN, f64::NAN);
            }
        }
        let constant = self.truth.constant().map(|truth| MeanShear {
            e: [truth[0] + metrics.c1, truth[1] + metrics.c2],
            error: [errors.c1, errors.c2],
            truth,
        });
        let noise = noise.map(|power| power[chosen.class().index()]);
        let noise_variance = noise.as_ref().map(|_| match self.options.noise {
            Noise::Given(variance) => variance,
            Noise::Measured => self.noise_variance(total, &conventions[chosen.index()]),
        });
        let true_modes = self.true_modes(total, Convention::STANDARD);
        Ok(SetScore {
            grid: self.grid,
            bins: self.bins.clone(),
            images: total.images,
            true_ee: self.bins.power_of(&true_modes.e, &true_modes.e),
            true_bb: self.bins.power_of(&true_modes.b, &true_modes.b),
            ee_error,
            noise,
            noise_variance,
            conventions: conventions.into(),
            best,
            matching,
            chosen,
            metrics,
            errors,
            replicates,
            constant,
        })
    }

    /// How well each convention correlates with the truth over bins 2 to 9.
    ///
    /// # Errors
    /// If there is no image, or if the shape of the images differs from the grid.
    pub fn match_convention(&self, images: &SetImages) -> Result<ConventionMatch, ScoringError> {
        self.check_images(images)?;
        let correlations = Convention::ALL.map(|k| self.correlation_of(images.total(), k));
        Ok(ConventionMatch::new(correlations, self.scored_modes()))
    }

    pub(crate) fn choice(&self) -> Choice {
        self.options.choice
    }

    pub(crate) fn truth(&self) -> &TrueShear {
        &self.truth
    }

    pub(crate) fn modes_of(&self, field: Array2<Complex64>) -> Modes {
        self.decomposer.modes_of(field)
    }

    // Modes of the averaged field in a convention, and modes of the truth to compare them with.
    pub(crate) fn both_modes(&self, sum: &FieldSum, convention: Convention) -> (Modes, Modes) {
        (
            self.modes(sum, convention),
            self.true_modes(sum, convention),
        )
    }

    pub(crate) fn correlation_of(&self, sum: &FieldSum, convention: Convention) -> f64 {
        let (modes, truth) = self.both_modes(sum, convention);
        self.correlation(&modes, &truth)
    }

    fn scored_modes(&self) -> usize {
        SCORED.map(|b| self.bins.modes[b]).sum()
    }

    fn correlation(&self, modes: &Modes, truth: &Modes) -> f64 {
        let product = |a, b| self.bins.scored_product(a, b);
        let power = product(&truth.e, &truth.e) * product(&modes.e, &modes.e);
        product(&truth.e, &modes.e) / power.sqrt()
    }

    /// Scores a power spectrum: bandpowers of bins 2 to 9 against the true E modes. Errors need their
    /// covariance.
    ///
    /// # Errors
    /// If there are not exactly eight bandpowers.
    pub fn score_spectrum(
        &self,
        powers: &[f64],
        covariance: Option<&SpectrumCovariance>,
    ) -> Result<SpectrumScore, ScoringError> {
        if powers.len() != SCORED.len() {
            return Err(ScoringError::SpectrumBins {
                found: powers.len(),
                expected: SCORED.len(),
            });
        }
        let mut measured = [0.0; BINS];
        measured[SCORED].copy_from_slice(powers);
        let truth = self.true_bandpowers();
        let unknown = [[f64::NAN; BINS]; BINS];
        let covariance = covariance.map_or(unknown, |scored| {
            let mut all = [[0.0; BINS]; BINS];
            for (i, row) in SCORED.zip(scored) {
                all[i][SCORED].copy_from_slice(row);
            }
            all
        });
        let fit = bias_fits(&self.bins, self.grid.side().0, &measured, &truth);
        let (m, a) = errors::of_biases(&self.bins, &truth, &covariance);
        let found = quality(&self.bins, &measured, &truth);
        Ok(SpectrumScore {
            metrics: Metrics {
                q: found.q,
                m_half: fit.cl.m_half,
                sqrt_a: fit.cl.sqrtA * 1e4,
                sigma_sys_1e4: found.sigma_sys * 1e4,
                ..Metrics::unknown()
            },
            errors: Metrics {
                q: quality_error(&self.bins, &measured, &truth, &covariance),
                m_half: m / 2.0,
                sqrt_a: errors::of_sqrt_a(fit.cl.A, a),
                ..Metrics::unknown()
            },
            zero_q: quality(&self.bins, &[0.0; BINS], &truth).q,
        })
    }

    /// Bandpowers of the true shear's E modes without a mask.
    pub fn true_bandpowers(&self) -> [f64; BINS] {
        let full = FieldSum {
            count: Array2::from_elem((self.grid.n, self.grid.n), 1.0),
            images: 1,
            ..FieldSum::new(&self.grid)
        };
        let modes = self.true_modes(&full, Convention::STANDARD);
        self.bins.power_of(&modes.e, &modes.e)
    }

    /// The bins in use.
    pub fn bins(&self) -> &Bins {
        &self.bins
    }

    // Modes of the averaged field in a convention.
    //
    // Leaderboard: sums divided by the number of images, so that missing galaxies count as zero.
    // Corrected: the same field, in which a cell has the weight w = count/images, rescaled by 1/⟨w²⟩^½. Its power
    // then equals the power of an unmasked field.
    fn modes(&self, sum: &FieldSum, convention: Convention) -> Modes {
        let scale = self.rescaling(sum) / sum.images as f64;
        self.decomposer
            .modes_of(convention.field(&(&sum.e1 * scale), &(&sum.e2 * scale)))
    }

    // Modes of the true shear. In the corrected definition the shear has the weights of the galaxies, so that
    // missing galaxies do not appear as a bias.
    fn true_modes(&self, sum: &FieldSum, convention: Convention) -> Modes {
        let standard = Convention::STANDARD;
        match self.options.definition {
            Definition::Leaderboard => self
                .decomposer
                .modes_of(standard.field(&self.truth.g1, &self.truth.g2)),
            Definition::Corrected => {
                let scale = self.rescaling(sum) / sum.images as f64;
                let weight = if convention.transposes() {
                    sum.count.t().to_owned()
                } else {
                    sum.count.clone()
                } * scale;
                self.decomposer.modes_of(
                    standard.field(&(&self.truth.g1 * &weight), &(&self.truth.g2 * &weight)),
                )
            }
        }
    }

    // 1/⟨w²⟩^½ in the corrected definition, 1 on the leaderboard.
    fn rescaling(&self, sum: &FieldSum) -> f64 {
        match self.options.definition {
            Definition::Leaderboard => 1.0,
            Definition::Corrected => {
                let images = sum.images as f64;
                let mean_square = sum.count.mapv(|c| (c / images).powi(2)).mean();
                match mean_square {
                    Some(w2) if w2 > 0.0 => 1.0 / w2.sqrt(),
                    _ => 1.0,
                }
            }
        }
    }

    // Noise variance of the averaged field per unit noise variance of a galaxy: 1/K on the leaderboard, and
    // ⟨w⟩/⟨w²⟩/K in the corrected definition, which rescales for gaps, where w is the mean weight of a cell. Galaxies with
    // weights add the noise of their squares.
    fn noise_gain(&self, sum: &FieldSum) -> f64 {
        let images = sum.images as f64;
        let gain = match self.options.definition {
            Definition::Leaderboard => 1.0 / images,
            Definition::Corrected => {
                let mean = sum.count.mean().unwrap_or(0.0) / images;
                self.rescaling(sum).powi(2) * mean / images
            }
        };
        gain * sum.weight_noise()
    }

    // E-mode bandpowers of a mean field in either class of conventions, and its noise gain. All conventions of
    // a class have the same scored bandpowers.
    fn mean_power(&self, sum: &FieldSum) -> MeanPower {
        MeanPower {
            power: ConventionClass::BOTH.map(|class| {
                let modes = self.modes(sum, class.representative());
                self.bins.power_of(&modes.e, &modes.e)
            }),
            gain: self.noise_gain(sum),
        }
    }

    // Noise bandpowers of the E modes of `sum`, which consists of `groups`. `None` if they cannot be determined.
    //
    // Measured: with noise gains r_g of the groups and r of all, ⟨P(E_g)⟩ = S + σ²⟨r_g⟩ and
    // P(Ē) = S + σ²r, so σ²r = r(⟨P(E_g)⟩ − P(Ē)) / (⟨r_g⟩ − r). This noise includes all E modes that change
    // from image to image. The classes differ: in the wrong class half of the intrinsic power is in E modes.
    fn noise_power(&self, sum: &FieldSum, groups: &[MeanPower]) -> Option<NoisePower> {
        let gain = self.noise_gain(sum);
        match self.options.noise {
            Noise::Given(variance) => Some([self.bins.white_noise(variance * gain); 2]),
            Noise::Measured if groups.len() < 2 => None,
            Noise::Measured => {
                let count = groups.len() as f64;
                let mean_gain = groups.iter().map(|g| g.gain).sum::<f64>() / count;
                let total = self.mean_power(sum);
                Some(std::array::from_fn(|class| {
                    std::array::from_fn(|b| {
                        let mean = groups.iter().map(|g| g.power[class][b]).sum::<f64>() / count;
                        gain * (mean - total.power[class][b]) / (mean_gain - gain)
                    })
                }))
            }
        }
    }

    fn convention_score(
        &self,
        convention: Convention,
        modes: &Modes,
        truth: &Modes,
        noise: Option<&NoisePower>,
    ) -> ConventionScore {
        let side = self.grid.side().0;
        let ee = self.bins.power_of(&modes.e, &modes.e);
        let true_ee = self.bins.power_of(&truth.e, &truth.e);
        let cross = self.bins.scored_product(&truth.e, &modes.e);
        let true_power = self.bins.scored_product(&truth.e, &truth.e);
        let m_cross = cross / true_power - 1.0;
        let denoised = noise.map(|n| {
            let n = &n[convention.class().index()];
            std::array::from_fn::<f64, BINS, _>(|b| ee[b] - n[b])
        });
        ConventionScore {
            convention,
            ee,
            bb: self.bins.power_of(&modes.b, &modes.b),
            eb: self.bins.power_of(&modes.e, &modes.b),
            correlation: self.correlation(modes, truth),
            m_cross,
            quality: quality(&self.bins, &ee, &true_ee),
            quality_calibrated: calibrated_quality(&self.bins, &ee, &true_ee, 1.0 + m_cross),
            quality_dn: denoised
                .as_ref()
                .map(|ee| quality(&self.bins, ee, &true_ee)),
            noise_free: denoised.unwrap_or(ee),
            fit: bias_fits(&self.bins, side, &ee, &true_ee),
            fit_dn: denoised
                .as_ref()
                .map(|ee| bias_fits(&self.bins, side, ee, &true_ee)),
        }
    }

    fn replicates(
        &self,
        images: &SetImages,
        chosen: Convention,
        groups: &[MeanPower],
        noise: Option<&NoisePower>,
    ) -> Vec<Metrics> {
        if images.groups().len() < 2 {
            return Vec::new();
        }
        let without = |(k, group)| {
            let mut rest = groups.to_vec();
            if k < rest.len() {
                rest.remove(k);
            }
            self.replicate(images.total(), group, chosen, &rest, noise)
        };
        images.groups().iter().enumerate().map(without).collect()
    }

    // The metrics without one group of images; `others` are the remaining groups. If they are too few to measure
    // the noise, the noise of all images is scaled.
    fn replicate(
        &self,
        total: &FieldSum,
        group: &FieldSum,
        chosen: Convention,
        others: &[MeanPower],
        noise: Option<&NoisePower>,
    ) -> Metrics {
        let rest = total.without(group);
        let own = self.noise_power(&rest, others).or_else(|| {
            let more = self.noise_gain(&rest) / self.noise_gain(total);
            noise.map(|n| n.map(|class| class.map(|power| power * more)))
        });
        let score = self.convention_score(
            chosen,
            &self.modes(&rest, chosen),
            &self.true_modes(&rest, chosen),
            own.as_ref(),
        );
        self.metrics(&rest, &score)
    }

    fn metrics(&self, sum: &FieldSum, score: &ConventionScore) -> Metrics {
        let [first, second] = self.biases(sum, score.convention);
        let mean_c_l = |power: &[f64; BINS]| {
            SCORED.map(|b| power[b] * self.bins.to_c_l(b)).sum::<f64>() / SCORED.len() as f64 * 1e9
        };
        let own = Metrics {
            q: score.quality.q,
            q_dn: score.quality_dn.map_or(f64::NAN, |quality| quality.q),
            q_calibrated: score.quality_calibrated.q,
            m_half: score.fit.cl.m_half,
            sqrt_a: score.fit.cl.sqrtA * 1e4,
            m_cross: score.m_cross,
            // Divided by the response, so that shrinking all ellipticities does not lower it.
            galaxy_noise: self.noise_variance(sum, score).sqrt() / (1.0 + score.m_cross).abs(),
            m1: first.m,
            m2: second.m,
            c1: first.c,
            c2: second.c,
            b_power: mean_c_l(&score.bb),
            eb_power: mean_c_l(&score.eb),
            sigma_sys_1e4: score.quality.sigma_sys * 1e4,
        };
        // A constant shear has power in the zero mode only, which no bin contains.
        match self.truth.constant() {
            None => own,
            Some(_) => Metrics {
                c1: own.c1,
                c2: own.c2,
                ..Metrics::unknown()
            },
        }
    }

    // Noise variance of one galaxy per component: white noise of this variance has the power that was subtracted
    // from the scored bandpowers. Not a number if none was subtracted.
    fn noise_variance(&self, sum: &FieldSum, score: &ConventionScore) -> f64 {
        let unit = self.bins.white_noise(self.noise_gain(sum));
        let removed = SCORED
            .map(|b| score.ee[b] - score.noise_free[b])
            .sum::<f64>();
        match score.quality_dn {
            Some(_) => removed / SCORED.map(|b| unit[b]).sum::<f64>(),
            None => f64::NAN,
        }
    }

    fn biases(&self, sum: &FieldSum, convention: Convention) -> [ShearBias; 2] {
        let (s1, s2) = convention.signs();
        let count = convention.turn(&sum.count);
        [
            ShearBias::new(&self.truth.g1, &convention.turn(&sum.e1) * s1, &count),
            ShearBias::new(&self.truth.g2, &convention.turn(&sum.e2) * s2, &count),
        ]
    }

    // Standard errors of the metrics (`crate::errors`) and of the E-mode bandpowers. For c the jackknife error is
    // used if it is larger: only the jackknife includes shifts common to all galaxies of an image.
    fn errors(
        &self,
        images: &SetImages,
        score: &ConventionScore,
        metrics: &Metrics,
        replicates: &[Metrics],
    ) -> (Metrics, [f64; BINS]) {
        let [(m1, c1), (m2, c2)] = self.galaxy_errors(images.total(), score.convention);
        let jackknife = |of: fn(&Metrics) -> f64| {
            let replicates = replicates.iter().map(of);
            jackknife_error(of(metrics), replicates, images.total().images)
        };
        let means = Metrics {
            c1: c1.max(jackknife(|f| f.c1)),
            c2: c2.max(jackknife(|f| f.c2)),
            ..Metrics::unknown()
        };
        if self.truth.constant().is_some() {
            return (means, [f64::NAN; BINS]);
        }
        let from_galaxies = Metrics { m1, m2, ..means };
        self.spectrum_errors(images, score, metrics, from_galaxies)
    }

    fn galaxy_errors(&self, sum: &FieldSum, convention: Convention) -> [(f64, f64); 2] {
        let images = sum.images as f64;
        let biases = self.biases(sum, convention);
        let residual = |bias: &ShearBias| bias.residual.mapv(|r| r / images);
        let field = Convention::STANDARD.field(&residual(&biases[0]), &residual(&biases[1]));
        let modes = self.decomposer.modes_of(field);
        let scatter = Scatter::new(&self.grid, self.bins.width, &modes);
        let scatter = match self.truth.constant() {
            Some(_) => scatter.of_one_kind(),
            None => scatter,
        };
        let sums = |weights: [&Array2<f64>; 2]| {
            scatter
                .of_sums(&self.decomposer, weights)
                .map(|variance| variance.sqrt() * images)
        };
        let m = sums([&biases[0].of_m, &biases[1].of_m]);
        let c = sums([&biases[0].of_c, &biases[1].of_c]);
        [(m[0], c[0]), (m[1], c[1])]
    }

    fn spectrum_errors(
        &self,
        images: &SetImages,
        score: &ConventionScore,
        metrics: &Metrics,
        others: Metrics,
    ) -> (Metrics, [f64; BINS]) {
        let (bins, groups) = (&self.bins, images.groups().len() as f64);
        let (mut modes, truth) = self.both_modes(images.total(), score.convention);
        let signal = &truth.e * Complex64::from(1.0 + score.m_cross);
        modes.e -= &signal;
        let scatter = Scatter::new(&self.grid, bins.width, &modes);
        let true_ee = bins.power_of(&truth.e, &truth.e);
        let power = scatter.of_power(bins, &signal, 1.0);
        let apart = std::array::from_fn(|b| score.ee[b] - true_ee[b]);
        let q_dn = match score.quality_dn {
            None => f64::NAN,
            Some(_) => {
                // The subtracted noise was measured on the same G groups, which raises the noise² term by G/(G − 1).
                let own = match self.options.noise {
                    Noise::Given(_) => 1.0,
                    Noise::Measured => groups / (groups - 1.0),
                };
                let apart = std::array::from_fn(|b| score.noise_free[b] - true_ee[b]);
                let variance = scatter.of_power(bins, &signal, own);
                errors::of_quality(bins, metrics.q_dn, &apart, &variance)
            }
        };
        // Noise of different modes is independent.
        let independent =
            std::array::from_fn(|i| std::array::from_fn(|j| if i == j { power[i] } else { 0.0 }));
        let (m, a) = errors::of_biases(bins, &true_ee, &independent);
        let m_cross = scatter.of_cross(bins, &truth.e).sqrt();
        let response = 1.0 + score.m_cross;
        let q_calibrated = scatter.of_calibrated_quality(
            bins,
            &truth.e,
            response,
            &score.ee,
            &true_ee,
            metrics.q_calibrated,
        );
        // Relative variance of the noise: half the relative error of its power, squared.
        let own = match self.options.noise {
            Noise::Given(_) => 0.0,
            Noise::Measured => bins.variance_of_white_power() / (groups - 1.0) / 4.0,
        };
        let [bb, eb] = scatter.of_null_tests(bins, &signal);
        let metrics = Metrics {
            q: errors::of_quality(bins, metrics.q, &apart, &power),
            q_dn,
            q_calibrated,
            m_half: m / 2.0,
            sqrt_a: errors::of_sqrt_a(score.fit.cl.A, a),
            m_cross,
            galaxy_noise: metrics.galaxy_noise * (own + (m_cross / response).powi(2)).sqrt(),
            b_power: errors::of_mean_c_l(bins, &bb),
            eb_power: errors::of_mean_c_l(bins, &eb),
            sigma_sys_1e4: errors::of_sigma_sys(bins, &apart, &power) * 1e4,
            ..others
        };
        let mut ee_error = [f64::NAN; BINS];
        for b in SCORED {
            ee_error[b] = power[b].sqrt();
        }
        (metrics, ee_error)
    }
}

// The convention with the highest Q, the first of equals.
fn best_of(conventions: &[ConventionScore; 8]) -> Convention {
    conventions
        .iter()
        .reduce(|best, c| match c.quality.q > best.quality.q {
            true => c,
            false => best,
        })
        .map_or(Convention::STANDARD, |c| c.convention)
}

/// E-mode bandpowers of the averaged field of `sum` and their bins. No truth is needed.
///
/// # Errors
/// If there is no image, or if the shape of the sum differs from the grid.
pub fn measured_bandpowers(
    grid: &Grid,
    sum: &FieldSum,
    convention: Convention,
) -> Result<(Bins, [f64; BINS]), ScoringError> {
    if sum.images == 0 {
        return Err(ScoringError::NoImages);
    }
    check_shape("e1 of the sum", &sum.e1, grid.n)?;
    check_shape("e2 of the sum", &sum.e2, grid.n)?;
    let scale = 1.0 / sum.images as f64;
    let field = convention.field(&(&sum.e1 * scale), &(&sum.e2 * scale));
    let modes = Decomposer::new(*grid).modes_of(field);
    let bins = Bins::new(grid, Definition::Leaderboard);
    let power = bins.power_of(&modes.e, &modes.e);
    Ok((bins, power))
}
