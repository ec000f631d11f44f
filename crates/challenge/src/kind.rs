//! Kinds of challenges: what differs between them, and the metrics that rank entries. Challenges whose sets have one shear for all
//! galaxies determine m and c from the sets, as GREAT3.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use shearq_results::compare::Paired;
use shearq_results::record::{SetRecord, mean};
use shearq_results::submit::Contents;
use shearq_scoring::great3::{Observation, REQUIRED_C, REQUIRED_M};
use shearq_scoring::{Definition, Line, Metrics, TrueShear};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RankBy {
    Q,
    QCorrected,
    QCalibrated,
    /// |m|, the multiplicative bias by cross-correlation; of constant shears, the mean over both components.
    M,
    /// c, the modulus of the additive bias, divided by the response: otherwise shrunk shapes have less of it.
    C,
    Qc,
    /// Error of a shear component from 1 arcmin², of scenes.
    ShearError,
}

impl RankBy {
    pub fn definition(self) -> Definition {
        match self {
            RankBy::QCorrected => Definition::Corrected,
            _ => Definition::Leaderboard,
        }
    }

    pub fn label(self) -> &'static str {
        match self {
            RankBy::Q => "Q",
            RankBy::QCorrected => "Q (corrected)",
            RankBy::QCalibrated => "Q cal.",
            RankBy::M => "|m|",
            RankBy::C => "c",
            RankBy::Qc => "Q_c",
            RankBy::ShearError => "σ·√arcmin²",
        }
    }

    pub fn meaning(self) -> &'static str {
        match self {
            RankBy::Q => {
                "Q is the quality factor 5·10⁻³/σ_sys, with the arithmetic of GREAT10's leaderboard."
            }
            RankBy::QCorrected => {
                "Q is the quality factor 5·10⁻³/σ_sys, with azimuthal averages over fixed bins."
            }
            RankBy::QCalibrated => {
                "Q cal. is the quality factor after dividing by the measured response, so that it does not change if all ellipticities are shrunk or stretched."
            }
            RankBy::M => {
                "|m| is the modulus of the multiplicative bias, by cross-correlation with the true shear."
            }
            RankBy::C => "c is the modulus of the additive bias, divided by the response.",
            RankBy::Qc => {
                "Q_c is GREAT3's quality factor of constant shear, 2464/√(Σ (m/0.002)² + Σ (c/0.0002)² + 4) over both components."
            }
            RankBy::ShearError => {
                "σ·√arcmin² is the error of a shear component from 1 arcmin², by the scatter of the measured shears of scenes around a line through the true ones, divided by 1 + m."
            }
        }
    }

    pub fn larger_is_better(self) -> bool {
        matches!(
            self,
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated | RankBy::Qc
        )
    }

    pub fn is_of_spectra(self) -> bool {
        matches!(self, RankBy::Q | RankBy::QCorrected)
    }

    /// Whether sets with one shear each (`constant`), or with a shear that varies, have this metric.
    pub fn suits(self, constant: bool) -> bool {
        match self {
            RankBy::M | RankBy::C => true,
            RankBy::Qc => constant,
            // Of scenes alone, which have no other metric.
            RankBy::ShearError => false,
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated => !constant,
        }
    }

    /// Whether the metric is unknown for a set without a measurable response, not only for all sets together.
    pub fn needs_the_response_of_each_set(self) -> bool {
        self == RankBy::QCalibrated
    }

    /// Value and standard error over all sets. `constant` has the true shears of sets with one shear each.
    pub fn of(self, sets: &[SetRecord], constant: Option<&ConstantShears>) -> (f64, f64) {
        let mean = |metric| mean(sets, metric);
        match self {
            RankBy::Q | RankBy::QCorrected => mean(|metrics| metrics.q),
            RankBy::QCalibrated => mean(|metrics| metrics.q_calibrated),
            RankBy::M => {
                let (response, error) = response(sets, constant);
                ((response - 1.0).abs(), error)
            }
            RankBy::C => {
                let (modulus, error) = additive_bias(sets, constant);
                let (response, _) = response(sets, constant);
                (modulus / response, error / response)
            }
            RankBy::Qc => constant.map_or((f64::NAN, f64::NAN), |shears| shears.q_c(sets)),
            RankBy::ShearError => (f64::NAN, f64::NAN),
        }
    }

    /// Smallest error with which a value is published: that of a measurement with the noise of the images. An entry chooses its
    /// own error, for example by the same ellipticities with little noise in all images of a set.
    pub fn least_error(self, value: f64, noise: &Noise) -> f64 {
        match self {
            // Q is the inverse of a power, which has the square of the response.
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated => 2.0 * value * noise.response,
            RankBy::M => noise.response,
            RankBy::C => noise.c,
            // A scatter around the truth, which nobody can make smaller than that of the measurement.
            RankBy::ShearError => 0.0,
            RankBy::Qc => {
                // Q = Q₀/√(S/4 + 1), with S the sum of the squares of m and c in units of the requirements. Errors u of m and c in
                // these units add up to 2u√S + u² to S.
                let perfect = Observation::Ground.q_c([[0.0; 2]; 2]);
                let sum = 4.0 * ((perfect / value).powi(2) - 1.0).max(0.0);
                let u = (noise.response / REQUIRED_M).hypot(noise.c / REQUIRED_C);
                let more = sum + 2.0 * u * sum.sqrt() + u * u;
                value - perfect / (more / 4.0 + 1.0).sqrt()
            }
        }
    }

    /// Value of an entry of zeros, whose mean Q is `q`: its m is −1 and its c is 0. NaN where the metric divides by the
    /// response.
    pub fn of_zero_shear(self, q: f64) -> f64 {
        match self {
            RankBy::Q | RankBy::QCorrected => q,
            RankBy::M => 1.0,
            RankBy::Qc => Observation::Ground.q_c([[0.0, -1.0]; 2]),
            RankBy::QCalibrated | RankBy::C | RankBy::ShearError => f64::NAN,
        }
    }

    pub fn paired(self) -> Option<Paired> {
        match self {
            RankBy::Q | RankBy::QCorrected => Some(Paired::Q),
            RankBy::QCalibrated => Some(Paired::Calibrated),
            RankBy::M | RankBy::C | RankBy::Qc | RankBy::ShearError => None,
        }
    }
}

/// Modulus of the mean additive bias of all sets, and its standard error along its direction.
pub fn additive_bias(sets: &[SetRecord], constant: Option<&ConstantShears>) -> (f64, f64) {
    let [c1, c2] = match constant {
        None => [|m: &Metrics| m.c1, |m: &Metrics| m.c2].map(|metric| mean(sets, metric)),
        Some(shears) => shears.biases(sets).map(|(_, c)| c),
    };
    let modulus = c1.0.hypot(c2.0);
    (modulus, (c1.0 * c1.1).hypot(c2.0 * c2.1) / modulus)
}

/// Errors of a reference measurement of all images, without bias: of the response, and of c.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Noise {
    pub response: f64,
    pub c: f64,
}

/// A value as it is published: the nearest multiple of a round step, which is the smallest one of 1, 2 or 5 times a power of
/// ten that is not below the error. A team that sends shifted and scaled entries learns no more than the noise of its images
/// hides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Published {
    pub value: f64,
    pub step: f64,
    pub decimals: usize,
}

impl Published {
    pub fn new(value: f64, error: f64) -> Self {
        // Without any error, one digit.
        let error = match error {
            known if known.is_normal() && known > 0.0 => known,
            _ => value.abs().max(f64::MIN_POSITIVE),
        };
        // Printed and parsed, because the logarithm of 0.001 is not exactly −3.
        let text = format!("{error:e}");
        let (digits, exponent) = text.split_once('e').unwrap_or(("1", "0"));
        let digits: f64 = digits.parse().unwrap_or(1.0);
        let exponent: i32 = exponent.parse().unwrap_or(0);
        let (first, more) = match digits {
            d if d <= 1.0 => (1, 0),
            d if d <= 2.0 => (2, 0),
            d if d <= 5.0 => (5, 0),
            _ => (1, 1),
        };
        let power = exponent + more;
        let step = format!("{first}e{power}").parse().unwrap_or(error);
        let decimals = usize::try_from(-power).unwrap_or(0);
        Published {
            value: rounded((value / step).round() * step, decimals),
            step,
            decimals,
        }
    }
}

// Printing rounds exactly; a product with a power of ten does not.
fn rounded(value: f64, decimals: usize) -> f64 {
    let nearest: f64 = format!("{value:.decimals$}").parse().unwrap_or(value);
    // Without the sign of −0.
    nearest + 0.0
}

/// Mean response 1 + m of all sets and both components, and its standard error.
pub fn response(sets: &[SetRecord], constant: Option<&ConstantShears>) -> (f64, f64) {
    match constant {
        None => {
            let (m, error) = mean(sets, |metrics| metrics.m_cross);
            (1.0 + m, error)
        }
        Some(shears) => {
            let [(m1, _), (m2, _)] = shears.biases(sets);
            (1.0 + 0.5 * (m1.0 + m2.0), 0.5 * m1.1.hypot(m2.1))
        }
    }
}

/// Most entries of a team, unless the organiser chooses another number.
// Published values determine the truth entry by entry (docs/run-a-challenge.md).
pub const ENTRIES_PER_TEAM: u32 = 10;

// A line through two shears has no error.
pub(crate) const MIN_SCENES: u32 = 3;

/// Largest |m| of ranked entries of scenes, unless the organiser chooses another number.
// That of sep without a cut (docs/scenes.md): a challenge of some hundred scenes determines m to 0.02, and cannot require less.
pub const MAX_M: f64 = 0.02;

/// A kind of challenge: all in which challenges of different kinds differ. Its values are the defaults of a new challenge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// The Galaxy Challenge of GREAT10 (Kitching et al. 2012): 24 sets with a variable shear field each.
    Great10,
    /// Sets with one shear each, ranked by Q_c, as the branches of GREAT3 with constant shear (Mandelbaum et al. 2014). The images
    /// have GREAT10's layout.
    Great3,
    /// Exposures with one shear each, on which whole pipelines with their detection compete, ranked by their shear error.
    Scenes,
}

impl Kind {
    /// Name on the command line and in `challenge.toml`.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Great10 => "great10",
            Kind::Great3 => "great3",
            Kind::Scenes => "scenes",
        }
    }

    pub fn title(self) -> &'static str {
        match self {
            Kind::Great10 => "GREAT10 Galaxy Challenge",
            Kind::Great3 => "GREAT3-like challenge of constant shear",
            Kind::Scenes => "challenge of scenes",
        }
    }

    /// Metric that ranks entries, of sets with one shear each (`constant`) or with a shear that varies.
    pub fn metric(self, constant: bool) -> RankBy {
        match self {
            // Q itself is the challenge's, but entries without images win it while noise dominates, and so do shrunk shapes.
            Kind::Great10 if constant => RankBy::Qc,
            Kind::Great10 => RankBy::QCalibrated,
            // Not defined for a shear that varies, so that such data are refused.
            Kind::Great3 => RankBy::Qc,
            Kind::Scenes => RankBy::ShearError,
        }
    }

    pub fn contents(self, spectra: bool) -> Vec<Contents> {
        match self {
            // Q of a spectrum can be tuned without images, entry by entry (crates/challenge/tests/extraction.rs).
            Kind::Great10 if spectra => {
                vec![
                    Contents::Catalogues,
                    Contents::Spectra,
                    Contents::CrossSpectra,
                ]
            }
            Kind::Great10 | Kind::Great3 | Kind::Scenes => vec![Contents::Catalogues],
        }
    }

    /// Conventions of entries, for participants: GREAT10's, without those of stamps and spectra for scenes.
    pub fn conventions(self) -> BTreeMap<String, String> {
        let mut conventions = vec![
            (
                "positions",
                "FITS pixels of the stamp centre; the first pixel of an image has its centre at 1",
            ),
            (
                "ellipticity",
                "shear type: (a - b)/(a + b) for an ellipse with the axes a and b",
            ),
            ("e1", "positive along x"),
            ("e2", "positive along x = y"),
            ("power", "l^2 C_l / (2 pi) with l in radian^-1"),
        ];
        if self == Kind::Scenes {
            conventions.retain(|(name, _)| name.starts_with('e'));
        }
        let owned = conventions
            .into_iter()
            .map(|(name, text)| (name.to_owned(), text.to_owned()));
        owned.collect()
    }

    /// What participants may assume about the shear, in a sentence.
    pub fn rule(self) -> &'static str {
        match self {
            Kind::Great10 => {
                "All images of a set have one shear field, so methods may average over them."
            }
            Kind::Great3 => "All galaxies of a set have one shear; no two sets have the same.",
            Kind::Scenes => {
                "All galaxies of a scene have one shear with 0.01 < |g| < 0.05, which acts on their shapes and on their places; no two scenes have the same."
            }
        }
    }
}

// Fewest sets for m and c of a component: two for the line, and one that the line does not pass through by
// construction. With its mean ellipticities and three published values, a team can solve for one shear.
const MIN_SETS: usize = 3;

#[derive(Debug, Clone, PartialEq)]
pub struct ConstantShears(BTreeMap<u32, [f64; 2]>);

pub type Measured = (f64, f64);

impl ConstantShears {
    /// `None` if the shear of every set varies.
    pub fn of<'a>(
        truths: impl IntoIterator<Item = (u32, &'a TrueShear)>,
    ) -> Result<Option<Self>, String> {
        let all: Vec<(u32, Option<[f64; 2]>)> = truths
            .into_iter()
            .map(|(set, truth)| (set, truth.constant()))
            .collect();
        let shears: BTreeMap<u32, [f64; 2]> = all
            .iter()
            .filter_map(|(set, shear)| Some((*set, (*shear)?)))
            .collect();
        if shears.is_empty() {
            return Ok(None);
        }
        if let Some((set, _)) = all.iter().find(|(_, shear)| shear.is_none()) {
            return Err(format!(
                "the true shear is constant in {} of {} sets and varies in set {set}; expected one kind of sets",
                shears.len(),
                all.len()
            ));
        }
        ConstantShears::new(shears).map(Some)
    }

    /// The shears of sets that have one each.
    pub fn new(shears: BTreeMap<u32, [f64; 2]>) -> Result<Self, String> {
        for k in 0..2 {
            let mut values: Vec<f64> = shears.values().map(|shear| shear[k]).collect();
            values.sort_by(f64::total_cmp);
            values.dedup();
            if values.len() < MIN_SETS {
                return Err(format!(
                    "constant shears need at least {MIN_SETS} sets with different g{} to separate m from c (found {})",
                    k + 1,
                    values.len()
                ));
            }
        }
        Ok(ConstantShears(shears))
    }

    /// The shear of a set; NaN without the set.
    pub fn of_set(&self, set: u32) -> [f64; 2] {
        self.0.get(&set).copied().unwrap_or([f64::NAN; 2])
    }

    /// m and c of component `k` (0 or 1): least squares of ⟨e⟩ − g = m·g + c over the sets, unweighted as in GREAT3. Errors
    /// follow from the scatter of galaxies, or from the residuals if these are larger.
    pub fn bias(&self, sets: &[SetRecord], k: usize) -> (Measured, Measured) {
        let (mut points, mut errors) = (Vec::new(), Vec::new());
        for set in sets {
            if let Some(g) = self.0.get(&set.set) {
                let of = |metrics: &Metrics| [metrics.c1, metrics.c2][k];
                points.push((g[k], of(&set.metrics)));
                errors.push(of(&set.errors));
            }
        }
        let line = Line::through(&points);
        let error = |which: usize| {
            let each = points.iter().zip(&errors);
            let derivative = |g: f64| line.derivatives(g)[which];
            let scatter = each.map(|((g, _), error)| (derivative(*g) * error).powi(2));
            let fit = points.iter().map(|(g, _)| derivative(*g).powi(2));
            let (scatter, fit) = (scatter.sum::<f64>(), line.variance() * fit.sum::<f64>());
            // Galaxies that are shrunk towards their mean scatter less, but the means of the sets do not. An unknown scatter stays
            // unknown.
            if fit > scatter {
                fit.sqrt()
            } else {
                scatter.sqrt()
            }
        };
        ((line.slope, error(1)), (line.intercept, error(0)))
    }

    pub fn biases(&self, sets: &[SetRecord]) -> [(Measured, Measured); 2] {
        [self.bias(sets, 0), self.bias(sets, 1)]
    }

    /// GREAT3's Q_c (Mandelbaum et al. 2014, ApJS 212, 5) with σ² = 4 of its ground branches, and its error to first order.
    /// Components are along the pixel axes; GREAT3 rotates them to the PSF, which does not change the term of c.
    pub fn q_c(&self, sets: &[SetRecord]) -> Measured {
        let biases = self.biases(sets);
        let q = |biases| Observation::Ground.q_c(biases);
        let best = q(biases.map(|(m, c)| [c.0, m.0]));
        // ∂Q/∂b = −Q³b/(Q₀·requirement)² for each bias b, Q₀ being Q times the root.
        let perfect = q([[0.0; 2]; 2]);
        let variance: f64 = biases
            .iter()
            .flat_map(|(m, c)| [(m, REQUIRED_M), (c, REQUIRED_C)])
            .map(|((value, error), required)| (value * error / (required * required)).powi(2))
            .sum();
        (
            best,
            best.powi(3) / (4.0 * perfect * perfect) * variance.sqrt(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;

    fn shear(g1: f64, g2: f64) -> TrueShear {
        let all = |g| Array2::from_elem((8, 8), g);
        TrueShear {
            g1: all(g1),
            g2: all(g2),
        }
    }

    // Three shears of both signs.
    const SHEARS: [[f64; 2]; 3] = [[0.02, -0.01], [-0.03, 0.01], [0.04, 0.03]];

    fn shears() -> ConstantShears {
        let truths = SHEARS.map(|[g1, g2]| shear(g1, g2));
        ConstantShears::of((1..).zip(&truths)).unwrap().unwrap()
    }

    // Sets with the biases m and c, and errors of 10⁻⁴ of each mean.
    fn sets(m: [f64; 2], c: [f64; 2]) -> Vec<SetRecord> {
        let set = |(number, g): (u32, [f64; 2])| {
            let (mut metrics, mut errors) = (Metrics::unknown(), Metrics::unknown());
            metrics.c1 = m[0] * g[0] + c[0];
            metrics.c2 = m[1] * g[1] + c[1];
            (errors.c1, errors.c2) = (1e-4, 1e-4);
            SetRecord {
                metrics,
                errors,
                ..crate::ranking::tests::record(number, 0.0, &[])
            }
        };
        (1..).zip(SHEARS).map(set).collect()
    }

    #[test]
    fn published_values_are_multiples_of_a_step_above_the_error() {
        let of = |value, error| {
            let own = Published::new(value, error);
            (own.value, own.step, own.decimals)
        };
        assert_eq!(of(16.23, 1.7), (16.0, 2.0, 0));
        assert_eq!(of(123.456, 34.0), (100.0, 50.0, 0));
        assert_eq!(of(123.456, 68.0), (100.0, 100.0, 0));
        assert_eq!(of(0.03346, 0.04), (0.05, 0.05, 2));
        assert_eq!(of(-0.02, 0.1), (0.0, 0.1, 1));
        assert_eq!(of(0.123_456, 0.001), (0.123, 0.001, 3));
        // Without an error, one digit.
        assert_eq!(of(16.2, f64::NAN), (20.0, 20.0, 0));
    }

    #[test]
    fn errors_of_an_entry_do_not_add_digits() {
        let noise = Noise {
            response: 0.02,
            c: 3e-4,
        };
        let step =
            |metric: RankBy, value| Published::new(value, metric.least_error(value, &noise)).step;
        assert_eq!(step(RankBy::QCalibrated, 100.0), 5.0);
        assert_eq!((step(RankBy::M, 0.01), step(RankBy::C, 1e-5)), (0.02, 5e-4));
        // Errors of 10 requirements, without a bias and with one of 20 requirements.
        assert_eq!(step(RankBy::Qc, 1232.0), 1000.0);
        assert_eq!(step(RankBy::Qc, 123.0), 50.0);
    }

    #[test]
    fn m_c_and_q_c_are_those_of_the_shears() {
        let found = shears().biases(&sets([0.01, -0.02], [3e-4, 0.0]));
        for ((m, c), expected) in found.iter().zip([(0.01, 3e-4), (-0.02, 0.0)]) {
            assert!((m.0 - expected.0).abs() < 1e-12 && (c.0 - expected.1).abs() < 1e-14);
        }
        // Σ(g − ⟨g⟩)² of 0.02, −0.03, 0.04 is 0.0026, and ⟨g⟩ = 0.01.
        let (m, c) = found[0];
        assert!((m.1 - 1e-4 / 0.0026f64.sqrt()).abs() < 1e-12, "{m:?}");
        let expected = 1e-4 * (1.0 / 3.0 + 1e-4 / 0.0026f64).sqrt();
        assert!((c.1 - expected).abs() < 1e-12, "{c:?}");
        // No submission can pass 1232; zero shear has m = −1: 2464/√(2·500² + 4).
        assert!((shears().q_c(&sets([0.0; 2], [0.0; 2])).0 - 1232.0).abs() < 1e-9);
        let zero = shears().q_c(&sets([-1.0; 2], [0.0; 2])).0;
        assert!((zero - 2464.0 / 500_004f64.sqrt()).abs() < 1e-9, "{zero}");
    }

    #[test]
    fn small_scatter_of_galaxies_does_not_forge_errors() {
        // Residuals that are orthogonal to 1 and g change neither m nor c.
        let g: Vec<f64> = SHEARS.iter().map(|shear| shear[0]).collect();
        let apart = [g[1] - g[2], g[2] - g[0], g[0] - g[1]].map(|r| 0.01 * r);
        let mut sets = sets([0.01, 0.0], [0.0, 0.0]);
        for (set, apart) in sets.iter_mut().zip(apart) {
            set.metrics.c1 += apart;
            set.errors.c1 *= 0.02;
        }
        let (m, c) = shears().bias(&sets, 0);
        assert!((m.0 - 0.01).abs() < 1e-12 && c.0.abs() < 1e-14);
        // One degree of freedom; Σ(g − ⟨g⟩)² = 0.0026.
        let residual = apart.iter().map(|r| r * r).sum::<f64>().sqrt();
        assert!((m.1 - residual / 0.0026f64.sqrt()).abs() < 1e-12, "{m:?}");
        let expected = residual * (1.0 / 3.0 + 1e-4 / 0.0026f64).sqrt();
        assert!((c.1 - expected).abs() < 1e-12, "{c:?}");
    }

    #[test]
    fn shears_that_do_not_separate_m_from_c_are_refused() {
        let refused = |truths: &[TrueShear]| ConstantShears::of((1..).zip(truths)).unwrap_err();
        let one = refused(&[shear(0.02, -0.01)]);
        assert!(one.contains("at least 3 sets with different g1"), "{one}");
        let same = refused(&[shear(0.02, 0.0), shear(0.01, 0.0), shear(0.03, 0.0)]);
        assert!(
            same.contains("different g2 to separate m from c (found 1)"),
            "{same}"
        );
        let mut varies = shear(0.02, 0.01);
        varies.g1[(0, 0)] = 0.0;
        let mixed = refused(&[shear(0.02, -0.01), varies.clone()]);
        assert!(
            mixed.contains("constant in 1 of 2 sets and varies in set 2"),
            "{mixed}"
        );
        assert_eq!(ConstantShears::of([(1, &varies)]), Ok(None));
    }
}
