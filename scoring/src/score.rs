//! Scores of one set: every convention, noise, biases, null tests, and errors of all of them.

use ndarray::{Array2, ArrayView2};
use serde::Serialize;
use shearq_fourier::Complex64;

use crate::bandpower::{BINS, Bins, Definition, SCORED};
use crate::catalogue::{FieldSum, TrueShear};
use crate::convention::{Convention, ConventionClass};
use crate::error::ScoringError;
use crate::errors::{self, Scatter};
use crate::grid::Grid;
use crate::matching::ConventionMatch;
use crate::metrics::Metrics;
use crate::modes::{Decomposer, Modes};
use crate::quality::{BiasFits, Quality, bias_fits, calibrated_quality, quality, quality_error};
use crate::resample::jackknife_error;

/// Most groups of images that the jackknife leaves out in turn.
pub const MAX_GROUPS: usize = 20;
/// Errors of its own by which the response must be above zero for anything to be divided by it.
const CLEAR_RESPONSE: f64 = 3.0;

/// Which convention the metrics of a table are taken from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Choice {
    /// The one whose E modes clearly correlate best with the truth, otherwise the standard one.
    #[default]
    Matched,
    /// The one with the highest Q, as the challenge's leaderboard took it.
    Best,
    /// A fixed one.
    Insist(Convention),
}

/// Variance of the ellipticities' noise, for Q_dn.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Noise {
    /// Known: variance per component, galaxy and image.
    Given(f64),
    /// Measured from the scatter of the E modes between images of the set.
    #[default]
    Measured,
}

/// How to score.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Options {
    /// Bandpower definition.
    pub definition: Definition,
    /// Noise to remove for Q_dn.
    pub noise: Noise,
    /// Convention of the headline metrics.
    pub choice: Choice,
}

/// Sums of a set's images, kept in up to [`MAX_GROUPS`] groups so that each can be left out.
///
/// Image `k` (counted from 0 in the order added) belongs to group `k mod MAX_GROUPS`, so that two
/// submissions of the same images are grouped alike. Memory does not grow with the images.
#[derive(Debug, Clone)]
pub struct SetImages {
    groups: Vec<FieldSum>,
    total: FieldSum,
    next: usize,
}

impl SetImages {
    /// No images yet.
    pub fn new(grid: &Grid) -> Self {
        SetImages {
            groups: Vec::new(),
            total: FieldSum::new(grid),
            next: 0,
        }
    }

    /// Images given as e₁ and e₂ on the cells `[ix, iy]`, where a value that is not finite is a galaxy
    /// without an ellipticity.
    ///
    /// # Errors
    /// Where an array is not of the grid's shape.
    pub fn of_arrays<'a>(
        grid: &Grid,
        images: impl IntoIterator<Item = [ArrayView2<'a, f64>; 2]>,
    ) -> Result<Self, ScoringError> {
        let mut all = SetImages::new(grid);
        for [e1, e2] in images {
            check_shape("e1 of an image", &e1, grid)?;
            check_shape("e2 of an image", &e2, grid)?;
            let mut sum = FieldSum::new(grid);
            sum.images = 1;
            for ((cell, &e1), &e2) in e1.indexed_iter().zip(&e2) {
                if e1.is_finite() && e2.is_finite() {
                    (sum.e1[cell], sum.e2[cell], sum.count[cell]) = (e1, e2, 1.0);
                }
            }
            all.add(&sum);
        }
        Ok(all)
    }

    /// Adds the sum of one image (with `images` = 1).
    pub fn add(&mut self, image: &FieldSum) {
        let group = self.next % MAX_GROUPS;
        if group == self.groups.len() {
            self.groups.push(image.clone());
        } else {
            self.groups[group].merge(image);
        }
        self.total.merge(image);
        self.next += 1;
    }

    /// The groups.
    pub fn groups(&self) -> &[FieldSum] {
        &self.groups
    }

    /// The sum of all images.
    pub fn total(&self) -> &FieldSum {
        &self.total
    }
}

/// Checks that an array has a value for every cell.
fn check_shape(
    what: &'static str,
    array: &ArrayView2<'_, f64>,
    grid: &Grid,
) -> Result<(), ScoringError> {
    match array.dim() == (grid.n, grid.n) {
        true => Ok(()),
        false => Err(ScoringError::Shape {
            what,
            found: array.dim(),
            side: grid.n,
        }),
    }
}

/// One convention's spectra and metrics.
#[derive(Debug, Clone, Serialize)]
pub struct ConventionScore {
    /// Which convention.
    pub convention: Convention,
    /// E-mode bandpowers.
    pub ee: [f64; BINS],
    /// B-mode bandpowers.
    pub bb: [f64; BINS],
    /// EB cross bandpowers; zero within noise for a sound measurement.
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
    /// The same after removing the noise power; `None` where the noise is not known.
    pub quality_dn: Option<Quality>,
    /// E-mode bandpowers less those of noise; the former where noise is not known.
    noise_free: [f64; BINS],
    /// M and A before removing noise.
    pub fit: BiasFits,
    /// M and A after removing noise.
    pub fit_dn: Option<BiasFits>,
}

/// What is known of a set whose true shear is the same everywhere, in the chosen convention: it has no
/// power to compare, and its means are its metrics.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MeanShear {
    /// Mean ellipticity of the galaxies.
    pub e: [f64; 2],
    /// Its standard error.
    pub error: [f64; 2],
    /// The true shear.
    pub truth: [f64; 2],
}

/// Everything found about one set.
#[derive(Debug, Clone)]
pub struct SetScore {
    /// The grid.
    pub grid: Grid,
    /// The bins of the definition used.
    pub bins: Bins,
    /// Images averaged over.
    pub images: usize,
    /// Bandpowers of the true shear's E modes.
    pub true_ee: [f64; BINS],
    /// Bandpowers of the true shear's B modes: nonzero where the sign of g₂ is misread.
    pub true_bb: [f64; BINS],
    /// Standard errors of the chosen convention's scored E-mode bandpowers, for the truth as it is; not numbers elsewhere
    /// and where unknown.
    pub ee_error: [f64; BINS],
    /// Noise bandpowers of the averaged E modes, where known.
    pub noise: Option<[f64; BINS]>,
    /// Noise variance per component, galaxy and image that `noise` amounts to.
    pub noise_variance: Option<f64>,
    /// All eight conventions, in order.
    pub conventions: Vec<ConventionScore>,
    /// The convention with the highest Q.
    pub best: Convention,
    /// How well each convention correlates with the truth.
    pub matching: ConventionMatch,
    /// The convention of the headline metrics.
    pub chosen: Convention,
    /// Headline metrics.
    pub metrics: Metrics,
    /// Their standard errors; not a number where unknown.
    pub errors: Metrics,
    /// The metrics with each group of images left out in turn; empty with fewer than two images.
    pub replicates: Vec<Metrics>,
    /// Means, where the true shear is the same everywhere. All metrics but c1 and c2 are then unknown.
    pub constant: Option<MeanShear>,
}

impl SetScore {
    /// The chosen convention's spectra.
    pub fn spectra(&self) -> &ConventionScore {
        &self.conventions[self.chosen.index()]
    }

    /// Whether the leaderboard's best convention is of another class than the chosen one: its Q is then
    /// the gain from a wrong convention, not from a good measurement.
    pub fn wrong_convention_wins(&self) -> bool {
        self.best.class() != self.chosen.class()
    }

    /// Share of the scored true power that is in B modes; a truth read with the wrong sign of g₂
    /// has about one half.
    pub fn true_b_share(&self) -> f64 {
        let sum = |p: &[f64; BINS]| SCORED.map(|b| p[b]).sum::<f64>();
        let (e, b) = (sum(&self.true_ee), sum(&self.true_bb));
        b / (e + b)
    }
}

/// Covariance of the eight bandpowers of a power-spectrum submission.
pub type SpectrumCovariance = [[f64; SCORED.end - SCORED.start]; SCORED.end - SCORED.start];

/// Metrics of a power-spectrum submission; errors are not numbers where the covariance is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpectrumScore {
    /// Q and σ_sys.
    pub quality: Quality,
    /// Standard error of Q.
    pub quality_error: f64,
    /// M/2.
    pub m_half: f64,
    /// Its standard error.
    pub m_half_error: f64,
    /// Signed √A in 10⁻⁴ (C_ℓ in steradian).
    pub sqrt_a: f64,
    /// Its standard error.
    pub sqrt_a_error: f64,
}

/// What the noise of a mean field is measured from: that of a group of images, or of all.
#[derive(Debug, Clone, Copy)]
struct MeanPower {
    /// Its E-mode bandpowers in conventions of either class.
    power: [[f64; BINS]; 2],
    /// Variance of its noise per unit variance of a galaxy's.
    gain: f64,
}

/// Noise bandpowers in conventions of either class.
type NoisePower = [[f64; BINS]; 2];

/// Scores submissions of one set against its true shear.
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
    /// Where the truth is not of the grid's shape, or a given noise variance negative or not finite.
    pub fn new(grid: Grid, truth: TrueShear, options: Options) -> Result<Self, ScoringError> {
        if let Noise::Given(variance) = options.noise
            && !(variance.is_finite() && variance >= 0.0)
        {
            return Err(ScoringError::NoiseVariance(variance));
        }
        check_shape("g1 of the truth", &truth.g1.view(), &grid)?;
        check_shape("g2 of the truth", &truth.g2.view(), &grid)?;
        Ok(SetScorer {
            grid,
            options,
            decomposer: Decomposer::new(grid),
            bins: Bins::new(&grid, options.definition),
            truth,
        })
    }

    /// Scores the images of a submission.
    ///
    /// # Errors
    /// Where no image was added, or images of another grid.
    pub fn score(&self, images: &SetImages) -> Result<SetScore, ScoringError> {
        let total = &images.total;
        if total.images == 0 {
            return Err(ScoringError::NoImages);
        }
        check_shape("the sum of the images", &total.e1.view(), &self.grid)?;
        let groups: Vec<MeanPower> = match self.options.noise {
            Noise::Given(_) => Vec::new(),
            Noise::Measured => images.groups.iter().map(|g| self.mean_power(g)).collect(),
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
        let replicates: Vec<Metrics> = match images.groups.len() {
            0 | 1 => Vec::new(),
            _ => (0..images.groups.len())
                .map(|k| {
                    let mut rest = groups.clone();
                    if k < rest.len() {
                        rest.remove(k);
                    }
                    self.replicate(total, &images.groups[k], chosen, &rest, noise.as_ref())
                })
                .collect(),
        };
        let chosen_one = &conventions[chosen.index()];
        let (mut errors, ee_error) = self.errors(images, chosen_one, &metrics, &replicates);
        // By a response that may as well be zero nothing can be divided.
        if 1.0 + metrics.m_cross < CLEAR_RESPONSE * errors.m_cross {
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
            true_ee: self.bins.power(&true_modes.e, &true_modes.e),
            true_bb: self.bins.power(&true_modes.b, &true_modes.b),
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

    /// How well each convention of a submission's field correlates with the truth over bins 2 to 9.
    pub fn match_convention(&self, images: &SetImages) -> ConventionMatch {
        let total = &images.total;
        let correlations = Convention::ALL.map(|k| self.correlation_of(total, k));
        ConventionMatch::new(correlations, self.scored_modes())
    }

    /// The true shear.
    pub(crate) fn truth(&self) -> &TrueShear {
        &self.truth
    }

    /// Modes of a submission's averaged field under a convention, and those of the truth beside it.
    pub(crate) fn both_modes(&self, sum: &FieldSum, convention: Convention) -> (Modes, Modes) {
        (
            self.modes(sum, convention),
            self.true_modes(sum, convention),
        )
    }

    /// Correlation of a submission's E modes with the true ones over the scored bins, under a convention.
    pub(crate) fn correlation_of(&self, sum: &FieldSum, convention: Convention) -> f64 {
        let (modes, truth) = self.both_modes(sum, convention);
        self.correlation(&modes, &truth)
    }

    fn scored_modes(&self) -> usize {
        SCORED.map(|b| self.bins.modes[b]).sum()
    }

    /// Correlation of E modes with the true ones over the scored bins.
    fn correlation(&self, modes: &Modes, truth: &Modes) -> f64 {
        let product = |a, b| self.bins.scored_product(a, b);
        let power = product(&truth.e, &truth.e) * product(&modes.e, &modes.e);
        product(&truth.e, &modes.e) / power.sqrt()
    }

    /// Scores a power-spectrum submission: bandpowers of bins 2 to 9 against the true E modes, with
    /// errors where their covariance is known.
    ///
    /// # Errors
    /// Where there are not exactly eight bandpowers.
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
        Ok(SpectrumScore {
            quality: quality(&self.bins, &measured, &truth),
            quality_error: quality_error(&self.bins, &measured, &truth, &covariance),
            m_half: fit.cl.m,
            m_half_error: m / 2.0,
            sqrt_a: fit.cl.sqrtA * 1e4,
            sqrt_a_error: errors::of_sqrt_a(fit.cl.A, a),
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
        self.bins.power(&modes.e, &modes.e)
    }

    /// The bins in use.
    pub fn bins(&self) -> &Bins {
        &self.bins
    }

    /// Modes of the averaged field under a convention.
    ///
    /// Leaderboard: sums divided by the number of images, so that missing galaxies count as zero.
    /// Corrected: the same field, which is the mean of the galaxies present weighted by their share
    /// w = count/images, rescaled by 1/⟨w²⟩^½ so that its power is that of an unmasked field.
    fn modes(&self, sum: &FieldSum, convention: Convention) -> Modes {
        let scale = self.rescaling(sum) / sum.images as f64;
        self.decomposer
            .decompose(convention.apply(&(&sum.e1 * scale), &(&sum.e2 * scale)))
    }

    /// Modes of the true shear; in the corrected definition seen through the submission's weights,
    /// so that missing galaxies are not mistaken for a bias.
    fn true_modes(&self, sum: &FieldSum, convention: Convention) -> Modes {
        let standard = Convention::STANDARD;
        match self.options.definition {
            Definition::Leaderboard => self
                .decomposer
                .decompose(standard.apply(&self.truth.g1, &self.truth.g2)),
            Definition::Corrected => {
                let scale = self.rescaling(sum) / sum.images as f64;
                let weight = if convention.transposes() {
                    sum.count.t().to_owned()
                } else {
                    sum.count.clone()
                } * scale;
                self.decomposer.decompose(
                    standard.apply(&(&self.truth.g1 * &weight), &(&self.truth.g2 * &weight)),
                )
            }
        }
    }

    /// 1/⟨w²⟩^½ in the corrected definition, 1 on the leaderboard.
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

    /// Variance of the field's noise per unit variance of a galaxy's: 1/K on the leaderboard, and
    /// ⟨w⟩/⟨w²⟩/K in the corrected definition, where gaps are made up for by rescaling.
    fn noise_gain(&self, sum: &FieldSum) -> f64 {
        let images = sum.images as f64;
        match self.options.definition {
            Definition::Leaderboard => 1.0 / images,
            Definition::Corrected => {
                let mean = sum.count.mean().unwrap_or(0.0) / images;
                self.rescaling(sum).powi(2) * mean / images
            }
        }
    }

    /// E-mode bandpowers of a mean field in either class of conventions, with its noise gain. Within a
    /// class the scored bandpowers are the same.
    fn mean_power(&self, sum: &FieldSum) -> MeanPower {
        MeanPower {
            power: ConventionClass::BOTH.map(|class| {
                let modes = self.modes(sum, class.representative());
                self.bins.power(&modes.e, &modes.e)
            }),
            gain: self.noise_gain(sum),
        }
    }

    /// Noise bandpowers of the E modes averaged in `sum`, which is made of `groups`; `None` where
    /// they cannot be known.
    ///
    /// Measured: with noise gains r_g of the groups and r of all, ⟨P(E_g)⟩ = S + σ²⟨r_g⟩ and
    /// P(Ē) = S + σ²r, so σ²r = r(⟨P(E_g)⟩ − P(Ē)) / (⟨r_g⟩ − r). It counts whatever changes from
    /// image to image in the E modes, and nothing else; in the wrong class of conventions half of the
    /// intrinsic ellipticities' power are E modes, so each class has noise of its own.
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
        let ee = self.bins.power(&modes.e, &modes.e);
        let true_ee = self.bins.power(&truth.e, &truth.e);
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
            bb: self.bins.power(&modes.b, &modes.b),
            eb: self.bins.power(&modes.e, &modes.b),
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

    /// Headline metrics with one group of images left out; `others` are the rest. Where too few are
    /// left to measure the noise, that of all images is scaled.
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
            m_half: score.fit.cl.m,
            sqrt_a: score.fit.cl.sqrtA * 1e4,
            m_cross: score.m_cross,
            galaxy_noise: self.noise_variance(sum, score).sqrt() / (1.0 + score.m_cross).abs(),
            m1: first.m,
            m2: second.m,
            c1: first.c,
            c2: second.c,
            b_power: mean_c_l(&score.bb),
            eb_power: mean_c_l(&score.eb),
            sigma_sys_1e4: score.quality.sigma_sys * 1e4,
        };
        match self.truth.constant() {
            None => own,
            Some(_) => Metrics {
                c1: own.c1,
                c2: own.c2,
                ..Metrics::unknown()
            },
        }
    }

    /// Noise variance of one galaxy per component: that of white noise with the power that was removed from
    /// the scored bandpowers. Not a number where none was.
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

    /// m and c of both components, from the galaxies.
    fn biases(&self, sum: &FieldSum, convention: Convention) -> [ShearBias; 2] {
        let (s1, s2) = convention.signs();
        let count = convention.turn(&sum.count);
        [
            ShearBias::new(&self.truth.g1, &convention.turn(&sum.e1) * s1, &count),
            ShearBias::new(&self.truth.g2, &convention.turn(&sum.e2) * s2, &count),
        ]
    }

    /// Standard errors of the metrics ([`crate::errors`]). c has the jackknife's over images where that is
    /// larger: what moves all galaxies of an image alike shows nowhere else.
    fn errors(
        &self,
        images: &SetImages,
        score: &ConventionScore,
        metrics: &Metrics,
        replicates: &[Metrics],
    ) -> (Metrics, [f64; BINS]) {
        let (sum, bins, k) = (&images.total, &self.bins, score.convention);
        let biases = self.biases(sum, k);
        let [v1, v2] = {
            let residual = |bias: &ShearBias| bias.residual.mapv(|r| r / sum.images as f64);
            let field = Convention::STANDARD.apply(&residual(&biases[0]), &residual(&biases[1]));
            let scatter = Scatter::new(&self.grid, bins.width, &self.decomposer.decompose(field));
            let scatter = match self.truth.constant() {
                Some(_) => scatter.of_one_kind(),
                None => scatter,
            };
            let images = sum.images as f64;
            let sums = |weights: [&Array2<f64>; 2]| {
                scatter
                    .of_sums(&self.decomposer, weights)
                    .map(|variance| variance.sqrt() * images)
            };
            let m = sums([&biases[0].of_m, &biases[1].of_m]);
            let c = sums([&biases[0].of_c, &biases[1].of_c]);
            [(m[0], c[0]), (m[1], c[1])]
        };
        let jackknife = |of: fn(&Metrics) -> f64| {
            jackknife_error(of(metrics), replicates.iter().map(of), images.total.images)
        };
        let c1 = v1.1.max(jackknife(|f| f.c1));
        let c2 = v2.1.max(jackknife(|f| f.c2));
        if self.truth.constant().is_some() {
            let means = Metrics {
                c1,
                c2,
                ..Metrics::unknown()
            };
            return (means, [f64::NAN; BINS]);
        }
        let (mut modes, truth) = (self.modes(sum, k), self.true_modes(sum, k));
        let signal = &truth.e * Complex64::from(1.0 + score.m_cross);
        modes.e -= &signal;
        let scatter = Scatter::new(&self.grid, bins.width, &modes);
        let true_ee = bins.power(&truth.e, &truth.e);
        let power = scatter.of_power(bins, &signal, 1.0);
        let apart = std::array::from_fn(|b| score.ee[b] - true_ee[b]);
        let q_dn = match (self.options.noise, images.groups.len() as f64) {
            (_, _) if score.quality_dn.is_none() => f64::NAN,
            (noise, groups) => {
                let own = match noise {
                    Noise::Given(_) => 1.0,
                    Noise::Measured => groups / (groups - 1.0),
                };
                let apart = std::array::from_fn(|b| score.noise_free[b] - true_ee[b]);
                let variance = scatter.of_power(bins, &signal, own);
                errors::of_quality(bins, metrics.q_dn, &apart, &variance)
            }
        };
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
        let galaxy_noise = {
            let own = match (self.options.noise, images.groups.len() as f64) {
                (Noise::Given(_), _) => 0.0,
                (Noise::Measured, groups) => bins.variance_of_white_power() / (groups - 1.0) / 4.0,
            };
            metrics.galaxy_noise * (own + (m_cross / response).powi(2)).sqrt()
        };
        let fit = &score.fit.cl;
        let [bb, eb] = scatter.of_null_tests(bins, &signal);
        let metrics = Metrics {
            q: errors::of_quality(bins, metrics.q, &apart, &power),
            q_dn,
            q_calibrated,
            m_half: m / 2.0,
            sqrt_a: errors::of_sqrt_a(fit.A, a),
            m_cross,
            galaxy_noise,
            m1: v1.0,
            m2: v2.0,
            c1,
            c2,
            b_power: errors::of_mean_c_l(bins, &bb),
            eb_power: errors::of_mean_c_l(bins, &eb),
            sigma_sys_1e4: errors::of_sigma_sys(bins, &apart, &power) * 1e4,
        };
        let mut ee_error = [f64::NAN; BINS];
        for b in SCORED {
            ee_error[b] = power[b].sqrt();
        }
        (metrics, ee_error)
    }
}

/// The convention with the highest Q, the first of equals.
fn best_of(conventions: &[ConventionScore; 8]) -> Convention {
    conventions
        .iter()
        .reduce(|best, c| match c.quality.q > best.quality.q {
            true => c,
            false => best,
        })
        .map_or(Convention::STANDARD, |c| c.convention)
}

/// e = (1 + m)·g + c over all galaxies of a set: least squares of each galaxy's ellipticity on its true
/// shear, from the sums per cell.
struct ShearBias {
    /// Not a number where the true shear is the same everywhere; c is then the mean of e − g.
    m: f64,
    c: f64,
    /// Sum per cell of what the fit leaves.
    residual: Array2<f64>,
    /// Weights of the sums per cell in m.
    of_m: Array2<f64>,
    /// Weights of the sums per cell in c.
    of_c: Array2<f64>,
}

impl ShearBias {
    fn new(g: &Array2<f64>, sum: Array2<f64>, count: &Array2<f64>) -> Self {
        let galaxies = count.sum();
        let mean = (g * count).sum() / galaxies;
        let apart = g - mean;
        let square = (&apart * &apart * count).sum();
        let constant = g.iter().all(|value| *value == g[(0, 0)]);
        let of_m = match constant {
            true => Array2::zeros(g.dim()),
            false => &apart / square,
        };
        let slope = match constant {
            true => 1.0,
            false => (&of_m * &sum).sum(),
        };
        let of_c = of_m.mapv(|w| 1.0 / galaxies - w * mean);
        let c = sum.sum() / galaxies - slope * mean;
        ShearBias {
            m: if constant { f64::NAN } else { slope - 1.0 },
            c,
            residual: &sum - &(g.mapv(|g| slope * g + c) * count),
            of_m,
            of_c,
        }
    }
}

/// E-mode bandpowers of a submission's averaged field and the bins they refer to: what a
/// power-spectrum submission holds. No truth is needed.
///
/// # Errors
/// Where no image was added.
pub fn measured_bandpowers(
    grid: &Grid,
    sum: &FieldSum,
    convention: Convention,
) -> Result<(Bins, [f64; BINS]), ScoringError> {
    if sum.images == 0 {
        return Err(ScoringError::NoImages);
    }
    let scale = 1.0 / sum.images as f64;
    let field = convention.apply(&(&sum.e1 * scale), &(&sum.e2 * scale));
    let modes = Decomposer::new(*grid).decompose(field);
    let bins = Bins::new(grid, Definition::Leaderboard);
    let power = bins.power(&modes.e, &modes.e);
    Ok((bins, power))
}
