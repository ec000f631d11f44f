//! Scores of one set: every convention, noise, biases, null tests, and errors of all of them.

use std::collections::BTreeMap;

use ndarray::Array2;
use serde::{Deserialize, Deserializer, Serialize};

use crate::bandpower::{BINS, Bins, Definition, SCORED};
use crate::catalogue::{FieldSum, TrueShear};
use crate::convention::{Convention, ConventionClass};
use crate::error::ScoringError;
use crate::grid::Grid;
use crate::modes::{Decomposer, Modes};
use crate::quality::{BiasFits, Quality, bias_fits, quality};
use crate::resample::jackknife_error;

/// Most groups of images that the jackknife leaves out in turn.
pub const MAX_GROUPS: usize = 20;
/// Standard deviations of chance at which a correlation with the truth is believed.
const CLEAR_MATCH: f64 = 4.0;

/// Which convention the figures of a table are taken from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Choice {
    /// The one whose E modes correlate best with the truth.
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
    /// Convention of the headline figures.
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

/// One convention's spectra and figures.
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
    /// The same after removing the noise power; `None` where the noise is not known.
    pub quality_dn: Option<Quality>,
    /// M and A before removing noise.
    pub fit: BiasFits,
    /// M and A after removing noise.
    pub fit_dn: Option<BiasFits>,
}

/// Headline figures of one set, or of a jackknife replicate of it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Figures {
    /// Quality factor.
    pub q: f64,
    /// Quality factor after removing the noise; not a number where the noise is unknown.
    pub q_dn: f64,
    /// M/2 from the power spectrum.
    pub m_half: f64,
    /// signed √A in units of 10⁻⁴ (C_ℓ in steradian).
    pub sqrt_a: f64,
    /// Multiplicative bias by cross-correlation of E modes with the truth.
    pub m_cross: f64,
    /// Multiplicative bias of component 1, from the catalogue.
    pub m1: f64,
    /// Multiplicative bias of component 2.
    pub m2: f64,
    /// Additive bias of component 1.
    pub c1: f64,
    /// Additive bias of component 2.
    pub c2: f64,
    /// Mean C_ℓ of the B modes over bins 2 to 9, in 10⁻⁹ steradian.
    pub b_power: f64,
    /// Mean C_ℓ of the EB cross-spectrum over bins 2 to 9, in 10⁻⁹ steradian.
    pub eb_power: f64,
}

impl Figures {
    /// Names of the figures, in the order of [`Figures::values`].
    pub const NAMES: [&'static str; 11] = [
        "q", "q_dn", "m_half", "sqrt_a", "m_cross", "m1", "m2", "c1", "c2", "b_power", "eb_power",
    ];

    /// All figures as an array.
    pub fn values(&self) -> [f64; 11] {
        let Figures {
            q,
            q_dn,
            m_half,
            sqrt_a,
            m_cross,
            m1,
            m2,
            c1,
            c2,
            b_power,
            eb_power,
        } = *self;
        [
            q, q_dn, m_half, sqrt_a, m_cross, m1, m2, c1, c2, b_power, eb_power,
        ]
    }

    /// The inverse of [`Figures::values`].
    pub fn from_values(values: [f64; 11]) -> Self {
        let [
            q,
            q_dn,
            m_half,
            sqrt_a,
            m_cross,
            m1,
            m2,
            c1,
            c2,
            b_power,
            eb_power,
        ] = values;
        Figures {
            q,
            q_dn,
            m_half,
            sqrt_a,
            m_cross,
            m1,
            m2,
            c1,
            c2,
            b_power,
            eb_power,
        }
    }
}

/// JSON has no NaN: what was written as null is read as that.
impl<'de> Deserialize<'de> for Figures {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let found = BTreeMap::<String, Option<f64>>::deserialize(deserializer)?;
        let mut values = [0.0; Self::NAMES.len()];
        for (value, name) in values.iter_mut().zip(Self::NAMES) {
            let number = found.get(name);
            let number = number.ok_or_else(|| serde::de::Error::missing_field(name))?;
            *value = number.unwrap_or(f64::NAN);
        }
        Ok(Self::from_values(values))
    }
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
    /// Noise bandpowers of the averaged E modes, where known.
    pub noise: Option<[f64; BINS]>,
    /// Noise variance per component, galaxy and image that `noise` amounts to.
    pub noise_variance: Option<f64>,
    /// All eight conventions, in order.
    pub conventions: Vec<ConventionScore>,
    /// The convention with the highest Q.
    pub best: Convention,
    /// The convention whose E modes correlate best with the truth.
    pub matched: Convention,
    /// The convention of the headline figures.
    pub chosen: Convention,
    /// How it was chosen.
    pub choice: Choice,
    /// Headline figures.
    pub figures: Figures,
    /// The same with each group of images left out in turn; empty with fewer than two images.
    pub replicates: Vec<Figures>,
}

impl SetScore {
    /// The chosen convention's spectra.
    pub fn spectra(&self) -> &ConventionScore {
        &self.conventions[self.chosen.index()]
    }

    /// Jackknife standard errors of the headline figures; `None` with fewer than two images.
    pub fn errors(&self) -> Option<Figures> {
        if self.replicates.len() < 2 {
            return None;
        }
        let full = self.figures.values();
        let rows: Vec<[f64; 11]> = self.replicates.iter().map(Figures::values).collect();
        Some(Figures::from_values(std::array::from_fn(|i| {
            jackknife_error(full[i], rows.iter().map(|row| row[i]), self.images)
        })))
    }

    /// Whether the leaderboard's best convention is of another class than the matched one: its Q
    /// is then the gain from a wrong convention, not from a good measurement.
    pub fn wrong_convention_wins(&self) -> bool {
        self.best.class() != self.matched.class()
    }

    /// The least correlation, or difference of two, that is clearly more than chance: of N modes without
    /// anything in common it scatters by 1/√(N/2), opposite modes being conjugates.
    pub fn clear_correlation(&self) -> f64 {
        let modes: usize = SCORED.map(|b| self.bins.modes[b]).sum();
        CLEAR_MATCH * (2.0 / modes as f64).sqrt()
    }

    /// The matched convention's correlation with the truth, and whether it is clearly more than chance.
    pub fn match_with_truth(&self) -> (f64, bool) {
        let correlation = self.conventions[self.matched.index()].correlation;
        (correlation, correlation >= self.clear_correlation())
    }

    /// The highest correlation with the truth among the conventions of a class.
    pub fn class_correlation(&self, class: ConventionClass) -> f64 {
        self.conventions
            .iter()
            .filter(|c| c.convention.class() == class)
            .fold(f64::NEG_INFINITY, |best, c| best.max(c.correlation))
    }

    /// Share of the scored true power that is in B modes; a truth read with the wrong sign of g₂
    /// has about one half.
    pub fn true_b_share(&self) -> f64 {
        let sum = |p: &[f64; BINS]| SCORED.map(|b| p[b]).sum::<f64>();
        let (e, b) = (sum(&self.true_ee), sum(&self.true_bb));
        b / (e + b)
    }
}

/// What the noise of a group of images is measured from.
#[derive(Debug, Clone, Copy)]
struct GroupPower {
    /// E-mode bandpowers of the group's mean field.
    power: [f64; BINS],
    /// Variance of its noise per unit variance of a galaxy's.
    gain: f64,
}

impl Default for GroupPower {
    fn default() -> Self {
        GroupPower {
            power: [0.0; BINS],
            gain: 0.0,
        }
    }
}

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
    /// Where a given noise variance is negative or not finite.
    pub fn new(grid: Grid, truth: TrueShear, options: Options) -> Result<Self, ScoringError> {
        if let Noise::Given(variance) = options.noise
            && !(variance.is_finite() && variance >= 0.0)
        {
            return Err(ScoringError::NoiseVariance(variance));
        }
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
    /// Where no image was added.
    pub fn score(&self, images: &SetImages) -> Result<SetScore, ScoringError> {
        let total = &images.total;
        if total.images == 0 {
            return Err(ScoringError::NoImages);
        }
        let groups = self.group_powers(images);
        let noise = self.noise_power(total, &groups);
        let modes: Vec<Modes> = Convention::ALL.map(|k| self.modes(total, k)).into();
        let true_modes = self.true_modes(total, Convention::STANDARD);
        let conventions: Vec<ConventionScore> = Convention::ALL
            .iter()
            .zip(&modes)
            .map(|(&k, modes)| {
                let truth = match self.options.definition {
                    Definition::Leaderboard => &true_modes,
                    // The mask is turned with the convention.
                    Definition::Corrected => &self.true_modes(total, k),
                };
                self.convention_score(k, modes, truth, noise.as_ref())
            })
            .collect();
        let argmax = |value: fn(&ConventionScore) -> f64| {
            conventions
                .iter()
                .fold(None::<&ConventionScore>, |best, c| match best {
                    Some(b) if value(b) >= value(c) || value(c).is_nan() => Some(b),
                    _ => Some(c),
                })
                .map_or(Convention::STANDARD, |c| c.convention)
        };
        let best = argmax(|c| c.quality.q);
        // A blank submission correlates with nothing: then no convention is better than the standard.
        let matched = if conventions.iter().all(|c| c.correlation.is_nan()) {
            Convention::STANDARD
        } else {
            argmax(|c| c.correlation)
        };
        let chosen = match self.options.choice {
            Choice::Matched => matched,
            Choice::Best => best,
            Choice::Insist(k) => k,
        };
        let figures = self.figures(total, &conventions[chosen.index()]);
        let replicates = if images.groups.len() < 2 {
            Vec::new()
        } else {
            images
                .groups
                .iter()
                .enumerate()
                .map(|(k, group)| {
                    let mut rest = groups.clone();
                    rest.remove(k);
                    self.replicate(total, group, chosen, &rest, noise.as_ref())
                })
                .collect()
        };
        let noise_variance = noise.as_ref().map(|power| match self.options.noise {
            Noise::Given(variance) => variance,
            Noise::Measured => {
                let unit = self.bins.white_noise(self.noise_gain(total));
                SCORED.map(|b| power[b]).sum::<f64>() / SCORED.map(|b| unit[b]).sum::<f64>()
            }
        });
        Ok(SetScore {
            grid: self.grid,
            bins: self.bins.clone(),
            images: total.images,
            true_ee: self.bins.power(&true_modes.e, &true_modes.e),
            true_bb: self.bins.power(&true_modes.b, &true_modes.b),
            noise,
            noise_variance,
            conventions,
            best,
            matched,
            chosen,
            choice: self.options.choice,
            figures,
            replicates,
        })
    }

    /// Q of a power-spectrum submission: bandpowers of bins 2 to 9 against the true E modes.
    ///
    /// # Errors
    /// Where there are not exactly eight bandpowers.
    pub fn score_spectrum(&self, powers: &[f64]) -> Result<(Quality, BiasFits), ScoringError> {
        if powers.len() != SCORED.len() {
            return Err(ScoringError::SpectrumBins {
                found: powers.len(),
                expected: SCORED.len(),
            });
        }
        let mut measured = [0.0; BINS];
        measured[SCORED].copy_from_slice(powers);
        let truth = self.true_bandpowers();
        Ok((
            quality(&self.bins, &measured, &truth),
            bias_fits(&self.bins, self.grid.side().0, &measured, &truth),
        ))
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

    /// E-mode bandpowers of each group's mean field, with its noise gain. The sign and axis
    /// convention does not matter to the mean of the noise; the standard one is used.
    fn group_powers(&self, images: &SetImages) -> Vec<GroupPower> {
        match self.options.noise {
            Noise::Given(_) => images
                .groups
                .iter()
                .map(|_| GroupPower::default())
                .collect(),
            Noise::Measured => images
                .groups
                .iter()
                .map(|group| GroupPower {
                    power: self.standard_power(group),
                    gain: self.noise_gain(group),
                })
                .collect(),
        }
    }

    fn standard_power(&self, sum: &FieldSum) -> [f64; BINS] {
        let modes = self.modes(sum, Convention::STANDARD);
        self.bins.power(&modes.e, &modes.e)
    }

    /// Noise bandpowers of the E modes averaged in `sum`, which is made of `groups`; `None` where
    /// they cannot be known.
    ///
    /// Measured: with noise gains r_g of the groups and r of all, ⟨P(E_g)⟩ = S + σ²⟨r_g⟩ and
    /// P(Ē) = S + σ²r, so σ²r = r(⟨P(E_g)⟩ − P(Ē)) / (⟨r_g⟩ − r). It counts whatever changes from
    /// image to image in the E modes, and nothing else.
    fn noise_power(&self, sum: &FieldSum, groups: &[GroupPower]) -> Option<[f64; BINS]> {
        let gain = self.noise_gain(sum);
        match self.options.noise {
            Noise::Given(variance) => Some(self.bins.white_noise(variance * gain)),
            Noise::Measured if groups.len() < 2 => None,
            Noise::Measured => {
                let count = groups.len() as f64;
                let mean_gain = groups.iter().map(|g| g.gain).sum::<f64>() / count;
                let total = self.standard_power(sum);
                Some(std::array::from_fn(|b| {
                    let mean = groups.iter().map(|g| g.power[b]).sum::<f64>() / count;
                    gain * (mean - total[b]) / (mean_gain - gain)
                }))
            }
        }
    }

    fn convention_score(
        &self,
        convention: Convention,
        modes: &Modes,
        truth: &Modes,
        noise: Option<&[f64; BINS]>,
    ) -> ConventionScore {
        let side = self.grid.side().0;
        let ee = self.bins.power(&modes.e, &modes.e);
        let true_ee = self.bins.power(&truth.e, &truth.e);
        let cross = self.bins.scored_product(&truth.e, &modes.e);
        let true_power = self.bins.scored_product(&truth.e, &truth.e);
        let power = self.bins.scored_product(&modes.e, &modes.e);
        let denoised = noise.map(|n| std::array::from_fn::<f64, BINS, _>(|b| ee[b] - n[b]));
        ConventionScore {
            convention,
            ee,
            bb: self.bins.power(&modes.b, &modes.b),
            eb: self.bins.power(&modes.e, &modes.b),
            correlation: cross / (true_power * power).sqrt(),
            m_cross: cross / true_power - 1.0,
            quality: quality(&self.bins, &ee, &true_ee),
            quality_dn: denoised
                .as_ref()
                .map(|ee| quality(&self.bins, ee, &true_ee)),
            fit: bias_fits(&self.bins, side, &ee, &true_ee),
            fit_dn: denoised
                .as_ref()
                .map(|ee| bias_fits(&self.bins, side, ee, &true_ee)),
        }
    }

    /// Headline figures with one group of images left out; `others` are the rest. Where too few are
    /// left to measure the noise, that of all images is scaled.
    fn replicate(
        &self,
        total: &FieldSum,
        group: &FieldSum,
        chosen: Convention,
        others: &[GroupPower],
        noise: Option<&[f64; BINS]>,
    ) -> Figures {
        let rest = total.without(group);
        let own = self.noise_power(&rest, others).or_else(|| {
            let more = self.noise_gain(&rest) / self.noise_gain(total);
            noise.map(|n| n.map(|power| power * more))
        });
        let score = self.convention_score(
            chosen,
            &self.modes(&rest, chosen),
            &self.true_modes(&rest, chosen),
            own.as_ref(),
        );
        self.figures(&rest, &score)
    }

    fn figures(&self, sum: &FieldSum, score: &ConventionScore) -> Figures {
        let k = score.convention;
        let turn = |a: &Array2<f64>| {
            if k.transposes() {
                a.t().to_owned()
            } else {
                a.clone()
            }
        };
        let (s1, s2) = k.signs();
        let count = turn(&sum.count);
        let (m1, c1) = shear_bias(&self.truth.g1, &(turn(&sum.e1) * s1), &count);
        let (m2, c2) = shear_bias(&self.truth.g2, &(turn(&sum.e2) * s2), &count);
        let mean_c_l = |power: &[f64; BINS]| {
            SCORED.map(|b| power[b] * self.bins.to_c_l(b)).sum::<f64>() / SCORED.len() as f64 * 1e9
        };
        Figures {
            q: score.quality.q,
            q_dn: score.quality_dn.map_or(f64::NAN, |quality| quality.q),
            m_half: score.fit.cl.m,
            sqrt_a: score.fit.cl.sqrtA * 1e4,
            m_cross: score.m_cross,
            m1,
            m2,
            c1,
            c2,
            b_power: mean_c_l(&score.bb),
            eb_power: mean_c_l(&score.eb),
        }
    }
}

/// (m, c) of e = (1 + m)·g + c over all galaxies of a set: least squares of each galaxy's
/// ellipticity on its true shear, from the sums per cell.
fn shear_bias(g: &Array2<f64>, sum: &Array2<f64>, count: &Array2<f64>) -> (f64, f64) {
    let mut s = [0.0; 5];
    for ((&g, &e), &w) in g.iter().zip(sum).zip(count) {
        s[0] += w;
        s[1] += w * g;
        s[2] += w * g * g;
        s[3] += e;
        s[4] += e * g;
    }
    let slope = (s[4] - s[3] * s[1] / s[0]) / (s[2] - s[1] * s[1] / s[0]);
    (slope - 1.0, (s[3] - slope * s[1]) / s[0])
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
