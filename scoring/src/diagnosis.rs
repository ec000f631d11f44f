//! Probable faults of ellipticities that disagree with the true shear: order of rows, components, type of
//! ellipticity, copies. The caller words the findings.

use std::f64::consts::PI;

use ndarray::{Array2, Zip};
use shearq_quantities::fourier::Complex64;

use crate::bandpower::{Bins, Definition, SCORED};
use crate::catalogue::{FieldSum, SetImages, TrueShear, TruthSign};
use crate::convention::Convention;
use crate::error::ScoringError;
use crate::grid::{Grid, check_shape};
use crate::modes::{Decomposer, Modes};
use crate::score::{SetScore, SetScorer};

// Significance in standard deviations from which a finding is reported.
const MIN_SIGNIFICANCE_SIGMA: f64 = 5.0;
// Least gain in correlation with the truth for which another order is reported.
const MIN_CORRELATION_GAIN: f64 = 0.02;
// Least shortfall of the correlation below the value that the noise allows. Errors common to all images of a
// set also lower the correlation, as a poor PSF correction does.
const MIN_CORRELATION_SHORTFALL: f64 = 0.3;
// |m| from which ellipticities are called biased. Chosen by hand: Q of such ellipticities can still be high.
const LARGE_M: f64 = 0.1;
const LARGE_M_SIGMA: f64 = 3.0;
// m from which a distortion is suspected: a distortion responds nearly twice as much as a shear.
const MIN_M_OF_DISTORTION: f64 = 0.5;
// A shear field whose rms exceeds this is not weak lensing.
const MAX_WEAK_SHEAR_RMS: f64 = 0.3;
// Difference of the shares of B modes that determines the sign of g₂. A pure E-mode field has a share of 0 in
// the right sign and of about one half in the other.
const MIN_B_SHARE_DIFFERENCE: f64 = 0.2;

/// A probable fault of a set's ellipticities, or of its true shear.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// The true shear is too strong for weak lensing.
    StrongTruth {
        /// Root mean square of |g|.
        rms: f64,
    },
    /// Another convention of signs and axes correlates clearly better with the truth.
    Convention {
        /// The convention scored.
        scored: Convention,
        /// Its correlation with the truth.
        correlation: f64,
        /// The better one.
        better: Convention,
        /// Its correlation with the truth.
        with: f64,
    },
    /// e₁ and e₂ in the other order correlate clearly better.
    Swapped {
        /// Correlation with the truth as scored.
        correlation: f64,
        /// Correlation after the exchange.
        with: f64,
    },
    /// The galaxies lie in neighbouring cells of those that they belong to.
    Shifted {
        /// Cells along x that they are too far right.
        x: i32,
        /// Cells along y that they are too far up.
        y: i32,
        /// Correlation with the truth as scored.
        correlation: f64,
        /// Correlation after shifting back.
        with: f64,
    },
    /// The correlation is far below the value that the noise allows.
    Uncorrelated {
        /// Correlation with the truth as scored.
        correlation: f64,
        /// Correlation that the noise between images allows.
        allowed: f64,
    },
    /// The response to shear is too large for a shear-type ellipticity.
    Distortion {
        /// Multiplicative bias.
        m: f64,
        /// Its error.
        error: f64,
    },
    /// A large multiplicative bias.
    Biased {
        /// Multiplicative bias.
        m: f64,
        /// Its error.
        error: f64,
        /// The part of the galaxies that are missing and count as zero, which is minus their part of m.
        missing: f64,
    },
}

/// How the ellipticities of one image follow the true shear: by E modes of the scored bins, or by their mean if the true
/// shear is constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageResponse {
    /// Slope of the ellipticities on the true shear; 1 without bias.
    pub slope: f64,
    /// Standard error of the slope by the noise of the image.
    pub error: f64,
    /// Correlation with the true shear, −1 to 1.
    pub correlation: f64,
}

/// Rows that share a value, as placeholders of galaxies that were not measured do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Repeated<const N: usize> {
    /// Rows with the value, or with one of several such values.
    pub rows: usize,
    /// All rows.
    pub of: usize,
    /// The first row with the most frequent value, from 0.
    pub first: usize,
    /// This row.
    pub value: [f64; N],
    /// The component that repeats; `None` if all components of a row repeat together.
    pub component: Option<usize>,
}

impl<const N: usize> Repeated<N> {
    /// Whether all rows are equal, or have one of a few values, in all components.
    pub fn is_constant(&self) -> bool {
        self.rows == self.of && self.component.is_none()
    }
}

// Least number of rows that share a value. Chosen by hand.
const MIN_REPEATS: usize = 3;
// Rows by the least number of them that share all components, and that share one. Of N shapes with a scatter σ per component that
// are rounded to δ, N δ²/2πσ² share the most frequent pair, and N δ/√(2π)σ the most frequent number. Shapes of two decimals and
// σ = 0.1 have shares of 0.16 % and 4 %, of four decimals 10⁻⁷ and 0.04 %.
const MAX_PER_PAIR: usize = 100;
const MAX_PER_COMPONENT: usize = 10;

/// Values that more rows share than measurements do: all components of 1 % of the rows, or one component of 10 %, at least three
/// rows. Numbers count as equal within `step`, so that noise below it hides no placeholder. `None` without such values.
pub fn repeated<const N: usize>(rows: &[[f64; N]], step: f64) -> Option<Repeated<N>> {
    let cells: Vec<[i64; N]> = rows
        .iter()
        .map(|row| row.map(|value| (value / step).round() as i64))
        .collect();
    let shared = |component: Option<usize>| {
        let key = |row: &usize| match component {
            None => &cells[*row][..],
            Some(k) => &cells[*row][k..=k],
        };
        let per = match component {
            None => MAX_PER_PAIR,
            Some(_) => MAX_PER_COMPONENT,
        };
        // All of two rows that are equal count, too.
        let least = rows
            .len()
            .min(MIN_REPEATS)
            .max(rows.len().div_ceil(per))
            .max(2);
        let mut order: Vec<usize> = (0..rows.len()).collect();
        // Stable, so that the first row of a value stays the first.
        order.sort_by(|a, b| key(a).cmp(key(b)));
        let groups = || {
            order
                .chunk_by(|a, b| key(a) == key(b))
                .filter(|own| own.len() >= least)
        };
        let first = *groups().max_by_key(|own| own.len())?.first()?;
        Some(Repeated {
            rows: groups().map(<[usize]>::len).sum(),
            of: rows.len(),
            first,
            value: rows[first],
            component,
        })
    };
    let components = (0..N).filter_map(|k| shared(Some(k)));
    shared(None)
        .into_iter()
        .chain(components)
        .reduce(|worst, own| if own.rows > worst.rows { own } else { worst })
}

impl SetScorer {
    /// Probable faults of the images scored as `score`, most important first. `convention` is the one to
    /// compare others with. At most one finding concerns the order of the ellipticities, and m is examined only if
    /// there is none.
    ///
    /// # Errors
    /// If the shape of the images differs from the grid.
    pub fn diagnose(
        &self,
        images: &SetImages,
        score: &SetScore,
        convention: Convention,
    ) -> Result<Vec<Fault>, ScoringError> {
        self.check_images(images)?;
        let mut findings = Vec::new();
        let rms = self.truth().rms();
        if rms > MAX_WEAK_SHEAR_RMS {
            findings.push(Fault::StrongTruth { rms });
        }
        if score.constant.is_some() {
            return Ok(findings);
        }
        match self.misplaced(images.total(), score, convention) {
            Some(finding) => findings.push(finding),
            None if convention == score.chosen => {
                let (m, error) = (score.metrics.m_cross, score.errors.m_cross);
                let missing = self.zero_share(images.total());
                findings.extend(Fault::of_bias(m, error, missing));
            }
            None => {}
        }
        Ok(findings)
    }

    /// How the ellipticities of one image follow the true shear in a convention. `None` if the image has no galaxy or the
    /// true shear is zero.
    ///
    /// # Panics
    /// If the shape of the image differs from the grid.
    pub fn response(&self, image: &FieldSum, convention: Convention) -> Option<ImageResponse> {
        let field = convention.field(&image.e1, &image.e2);
        let truth = self.weighted_truth(image, convention);
        let (mut cross, mut of_truth, mut of_image) = (0.0, 0.0, 0.0);
        let mut each: Vec<(Complex64, Complex64)> = Vec::new();
        let mut add = |truth: Complex64, e: Complex64| {
            cross += (truth.conj() * e).re;
            of_truth += truth.norm_sqr();
            of_image += e.norm_sqr();
            each.push((truth, e));
        };
        let constant = self.truth().constant().is_some();
        if constant {
            truth
                .iter()
                .zip(&field)
                .for_each(|(truth, e)| add(*truth, *e));
        } else {
            let [truth, e] = [truth, field].map(|field| self.modes_of(field).e);
            self.bins().each_scored(|at, _, _| add(truth[at], e[at]));
        }
        let slope = cross / of_truth;
        if !slope.is_finite() {
            return None;
        }
        // A mode and the opposite one are conjugates, so that N modes have N independent numbers. The galaxies of a
        // constant shear have two each.
        let numbers = each.len() as f64 * if constant { 2.0 } else { 1.0 };
        let white = (of_image - slope * cross).max(0.0) * of_truth / numbers;
        // The same from the modes themselves, for noise that has more power where the true shear has (White 1980).
        let own = each
            .iter()
            .map(|(truth, e)| (truth.conj() * (e - slope * truth)).re.powi(2));
        let coloured = own.sum::<f64>() * if constant { 1.0 } else { 2.0 };
        Some(ImageResponse {
            slope,
            error: white.max(coloured).sqrt() / of_truth,
            correlation: cross / (of_truth * of_image).sqrt(),
        })
    }

    // The true shear times the weight of each cell, which is 0 for a galaxy that is missing: without weights, an image of low
    // weights had a small response, as of galaxies in another order.
    fn weighted_truth(&self, sum: &FieldSum, convention: Convention) -> Array2<Complex64> {
        let weight = convention.turn(&sum.count);
        let (g1, g2) = (&self.truth().g1 * &weight, &self.truth().g2 * &weight);
        Convention::STANDARD.field(&g1, &g2)
    }

    // Correlation with the truth that weights and missing galaxies leave. The corrected definition gives the truth the same
    // weights.
    fn kept_by_weights(&self, sum: &FieldSum, convention: Convention) -> f64 {
        if self.bins().definition == Definition::Corrected {
            return 1.0;
        }
        let truth = Convention::STANDARD.field(&self.truth().g1, &self.truth().g2);
        let [weighted, truth] =
            [self.weighted_truth(sum, convention), truth].map(|field| self.modes_of(field).e);
        let product = |a, b| self.bins().scored_product(a, b);
        product(&weighted, &truth)
            / (product(&weighted, &weighted) * product(&truth, &truth)).sqrt()
    }

    // The part of the galaxies that are missing and count as zero.
    fn zero_share(&self, sum: &FieldSum) -> f64 {
        match self.bins().definition {
            Definition::Leaderboard => {
                1.0 - sum.count.mean().unwrap_or(0.0) / sum.images.max(1) as f64
            }
            Definition::Corrected => 0.0,
        }
    }

    fn misplaced(&self, sum: &FieldSum, score: &SetScore, convention: Convention) -> Option<Fault> {
        let correlation = score.conventions[convention.index()].correlation;
        if !correlation.is_finite() {
            return None;
        }
        let modes: usize = SCORED.map(|b| score.bins.modes[b]).sum();
        let better = |with: f64| {
            gain(correlation, with, modes) > MIN_SIGNIFICANCE_SIGMA * MIN_SIGNIFICANCE_SIGMA
        };
        let mut best: Option<(f64, Fault)> = None;
        let mut offer = |with: f64, finding: Fault| {
            if better(with) && best.as_ref().is_none_or(|(other, _)| with > *other) {
                best = Some((with, finding));
            }
        };
        let matching = &score.matching;
        if matching.is_clear() && matching.best() != convention {
            let (other, with) = (matching.best(), matching.correlation(matching.best()));
            let finding = Fault::Convention {
                scored: convention,
                correlation,
                better: other,
                with,
            };
            offer(with, finding);
        }
        let swapped = FieldSum {
            e1: sum.e2.clone(),
            e2: sum.e1.clone(),
            ..sum.clone()
        };
        let with = Convention::ALL
            .map(|k| self.correlation_of(&swapped, k))
            .into_iter()
            .fold(f64::NEG_INFINITY, f64::max);
        offer(with, Fault::Swapped { correlation, with });
        for ((x, y), with) in self.shifted(sum, convention) {
            let finding = Fault::Shifted {
                x,
                y,
                correlation,
                with,
            };
            offer(with, finding);
        }
        best.map(|(_, finding)| finding).or_else(|| {
            let allowed = allowed(score, convention)? * self.kept_by_weights(sum, convention);
            // A shortfall must exceed the scatter of chance correlations.
            let chance = 2.0 * score.matching.least_clear();
            let shortfall = allowed - correlation.max(0.0);
            (shortfall > MIN_CORRELATION_SHORTFALL.max(chance)).then_some(Fault::Uncorrelated {
                correlation,
                allowed,
            })
        })
    }

    // Correlations with the truth after moving the field back by one cell in each direction.
    fn shifted(&self, sum: &FieldSum, convention: Convention) -> Vec<((i32, i32), f64)> {
        let (modes, truth) = self.both_modes(sum, convention);
        let bins = self.bins();
        let product = |a, b| bins.scored_product(a, b);
        let scale = (product(&truth.e, &truth.e) * product(&modes.e, &modes.e)).sqrt();
        let n = modes.e.nrows() as f64;
        let phase = |k: usize, cells: i32| 2.0 * PI * k as f64 * f64::from(cells) / n;
        let neighbours = (-1..=1).flat_map(|x| (-1..=1).map(move |y| (x, y)));
        neighbours
            .filter(|shift| *shift != (0, 0))
            .map(|(x, y)| {
                let mut cross = 0.0;
                bins.each_scored(|at, _, _| {
                    let back = Complex64::from_polar(1.0, phase(at.0, x) + phase(at.1, y));
                    cross += (truth.e[at].conj() * modes.e[at] * back).re;
                });
                ((x, y), cross / scale)
            })
            .collect()
    }
}

// Twice the gain in the logarithm of the likelihood of `modes` modes with Gaussian noise of unknown variance,
// from the correlations with the truth before and after.
fn gain(before: f64, after: f64, modes: usize) -> f64 {
    let left = |r: f64| (1.0 - r.clamp(0.0, 1.0).powi(2)).max(f64::EPSILON);
    match after > before + MIN_CORRELATION_GAIN {
        true => modes as f64 * (left(before) / left(after)).ln(),
        false => 0.0,
    }
}

fn allowed(score: &SetScore, convention: Convention) -> Option<f64> {
    let noise = score.noise.as_ref()?;
    if convention.class() != score.chosen.class() {
        return None;
    }
    let total = &score.conventions[convention.index()].ee;
    let sum = |powers: &[f64; crate::BINS]| -> f64 {
        let of_a_mode = score.bins.white_noise(1.0);
        let of_bin = |b: usize| match score.bins.modes[b] {
            0 => 0.0,
            modes => powers[b] * modes as f64 / of_a_mode[b],
        };
        SCORED.map(of_bin).sum()
    };
    let signal = 1.0 - sum(noise) / sum(total);
    (signal > 0.0).then(|| signal.min(1.0).sqrt())
}

impl Fault {
    /// The finding about a multiplicative bias: as large as for a distortion, or large in either direction. The part `missing` of
    /// the galaxies counts as zero.
    pub fn of_bias(m: f64, error: f64, missing: f64) -> Option<Self> {
        if m - MIN_M_OF_DISTORTION > LARGE_M_SIGMA * error {
            return Some(Fault::Distortion { m, error });
        }
        (m.abs() - LARGE_M > LARGE_M_SIGMA * error).then_some(Fault::Biased { m, error, missing })
    }
}

/// The sign of g₂ in a truth that was read as `standard`: the sign in which its power is in E modes. `None` if both
/// signs have similar shares of B modes, or if so few modes contain the power that they have E ≫ B by chance.
///
/// # Errors
/// If the shape of the truth differs from the grid.
pub fn sign_by_modes(grid: &Grid, standard: &TrueShear) -> Result<Option<TruthSign>, ScoringError> {
    check_shape("g1 of the truth", &standard.g1, grid.n)?;
    check_shape("g2 of the truth", &standard.g2, grid.n)?;
    let decomposer = Decomposer::new(*grid);
    let bins = Bins::new(grid, crate::Definition::Leaderboard);
    let modes =
        |truth: &TrueShear| decomposer.modes_of(Convention::STANDARD.field(&truth.g1, &truth.g2));
    let powers = |Modes { e, b }: &Modes| (bins.scored_product(e, e), bins.scored_product(b, b));
    let own = modes(standard);
    let [(e, b), (other_e, other_b)] = [powers(&own), powers(&modes(&standard.flipped()))];
    let difference = other_b / (other_e + other_b) - b / (e + b);
    let found = sign_where(difference, MIN_B_SHARE_DIFFERENCE);
    // E and B of equal power: ln(E/B) of N modes has the variance 2/N (Fisher's z). Modes k and -k are conjugate, so
    // that N is half the participation number (Σ p)²/Σ p² of their powers p.
    let power = Zip::from(&own.e)
        .and(&own.b)
        .map_collect(|e, b| Complex64::from(e.norm_sqr() + b.norm_sqr()));
    let number = 0.5 * (e + b).powi(2) / bins.scored_product(&power, &power);
    let clear = MIN_SIGNIFICANCE_SIGMA * (2.0 / number).sqrt();
    let ratio = match found {
        Some(TruthSign::Challenge) => other_e / other_b,
        _ => e / b,
    };
    Ok(found.filter(|_| ratio.ln() >= clear))
}

/// The sign of g₂ in a truth that was read as `standard`: the sign with which e₂ of the images correlates. `None` if
/// the correlation is not significant.
///
/// # Errors
/// If the shapes of the truth and of the sum differ.
pub fn sign_by_correlation(
    standard: &TrueShear,
    sum: &FieldSum,
) -> Result<Option<TruthSign>, ScoringError> {
    check_shape("e2 of the images", &sum.e2, standard.g2.nrows())?;
    let product = |a: &Array2<f64>, b: &Array2<f64>| (a * b).sum();
    let (g, e) = (&standard.g2, &sum.e2);
    let correlation = product(g, e) / (product(g, g) * product(e, e)).sqrt();
    let clear = MIN_SIGNIFICANCE_SIGMA / (g.len() as f64).sqrt();
    Ok(sign_where(correlation, clear))
}

fn sign_where(value: f64, clear: f64) -> Option<TruthSign> {
    if value >= clear {
        Some(TruthSign::Standard)
    } else if value <= -clear {
        Some(TruthSign::Challenge)
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // As of ellipticities.
    const STEP: f64 = 1e-4;

    #[test]
    fn placeholders_repeat_and_rounded_shapes_do_not() {
        let shapes = |edit: &dyn Fn(usize, [f64; 2]) -> [f64; 2]| -> Vec<[f64; 2]> {
            // Uniform within ±0.25, whose scatter is 0.14.
            let number = |k: usize| ((k as f64 * 12.9898).sin() * 43758.5453).rem_euclid(1.0);
            let shape = |k| [0.5 * number(2 * k) - 0.25, 0.5 * number(2 * k + 1) - 0.25];
            (0..2500).map(|k| edit(k, shape(k))).collect()
        };
        let found = |edit: &dyn Fn(usize, [f64; 2]) -> [f64; 2]| {
            repeated(&shapes(edit), STEP).map(|own| (own.rows, own.first, own.component))
        };
        for digits in [2, 3, 4, 9] {
            let scale = 10f64.powi(digits);
            assert_eq!(found(&|_, e| e.map(|e| (e * scale).round() / scale)), None);
        }
        let half =
            |value: [f64; 2]| move |k: usize, e: [f64; 2]| if k % 2 == 1 { value } else { e };
        assert_eq!(found(&half([0.0; 2])), Some((1250, 1, None)));
        assert_eq!(found(&half([0.02, -0.01])), Some((1250, 1, None)));
        // Noise below the step hides nothing, and one in 50 galaxies is enough.
        let hidden = |k: usize, e: [f64; 2]| if k % 50 == 3 { e.map(|e| 1e-6 * e) } else { e };
        assert_eq!(found(&hidden), Some((50, 3, None)));
        assert_eq!(found(&|_, e| e.map(|e| 1e-300 * e)), Some((2500, 0, None)));
        let first = |k: usize, [e1, e2]: [f64; 2]| [if k.is_multiple_of(3) { 0.1 } else { e1 }, e2];
        assert_eq!(found(&first), Some((834, 0, Some(0))));
        assert_eq!(repeated(&[[0.1, 0.2]], STEP), None);
        assert!(repeated(&[[0.1, 0.2]; 2], STEP).is_some());
    }

    #[test]
    fn a_better_order_must_be_clear() {
        assert_eq!(gain(0.98, 0.985, 700), 0.0);
        assert!(gain(0.0, 0.1, 700) < MIN_SIGNIFICANCE_SIGMA * MIN_SIGNIFICANCE_SIGMA);
        assert!(gain(0.49, 0.98, 700) > MIN_SIGNIFICANCE_SIGMA * MIN_SIGNIFICANCE_SIGMA);
        assert!(gain(-0.5, 0.5, 700) > MIN_SIGNIFICANCE_SIGMA * MIN_SIGNIFICANCE_SIGMA);
    }
}
