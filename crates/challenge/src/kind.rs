//! Kinds of challenges: what differs between them, and the metrics that rank entries.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use shearq_dataset::layout::Layout;
use shearq_results::compare::Paired;
use shearq_results::record::{SetRecord, mean};
use shearq_results::submit::Contents;
use shearq_scoring::Definition;
use shearq_scoring::great3::Observation;

use crate::constant::ConstantShears;

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
    Noise,
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
            RankBy::Noise => "noise",
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
            RankBy::Noise => {
                "Noise is the scatter of one galaxy's ellipticity per component, divided by the response."
            }
        }
    }

    pub fn larger_is_better(self) -> bool {
        matches!(
            self,
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated | RankBy::Qc
        )
    }

    /// Decimals of a leaderboard, unless the organiser chooses other.
    pub fn decimals(self) -> usize {
        match self {
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated | RankBy::Qc => 1,
            RankBy::M | RankBy::Noise => 4,
            RankBy::C => 5,
        }
    }

    pub fn is_of_spectra(self) -> bool {
        matches!(self, RankBy::Q | RankBy::QCorrected)
    }

    /// Whether sets with one shear each (`constant`), or with a shear that varies, have this metric.
    pub fn suits(self, constant: bool) -> bool {
        match self {
            RankBy::M | RankBy::C => true,
            RankBy::Qc => constant,
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated | RankBy::Noise => !constant,
        }
    }

    /// Whether the metric is unknown for a set without a measurable response, not only for all sets together.
    pub fn needs_the_response_of_each_set(self) -> bool {
        matches!(self, RankBy::QCalibrated | RankBy::Noise)
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
                let (c1, c2) = match constant {
                    None => (mean(|metrics| metrics.c1), mean(|metrics| metrics.c2)),
                    Some(shears) => {
                        let [(_, c1), (_, c2)] = shears.biases(sets);
                        (c1, c2)
                    }
                };
                let modulus = c1.0.hypot(c2.0);
                // The error along the direction of c.
                let error = (c1.0 * c1.1).hypot(c2.0 * c2.1) / modulus;
                let (response, _) = response(sets, constant);
                (modulus / response, error / response)
            }
            RankBy::Qc => constant.map_or((f64::NAN, f64::NAN), |shears| shears.q_c(sets)),
            RankBy::Noise => mean(|metrics| metrics.galaxy_noise),
        }
    }

    /// Value of an entry of zeros, whose mean Q is `q`: its m is −1 and its c is 0. NaN where the metric divides by the
    /// response.
    pub fn of_zero_shear(self, q: f64) -> f64 {
        match self {
            RankBy::Q | RankBy::QCorrected => q,
            RankBy::M => 1.0,
            RankBy::Qc => Observation::Ground.q_c([[0.0, -1.0]; 2]),
            RankBy::QCalibrated | RankBy::C | RankBy::Noise => f64::NAN,
        }
    }

    pub fn paired(self) -> Option<Paired> {
        match self {
            RankBy::Q | RankBy::QCorrected => Some(Paired::Q),
            RankBy::QCalibrated => Some(Paired::Calibrated),
            RankBy::M | RankBy::C | RankBy::Qc | RankBy::Noise => None,
        }
    }
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

/// A kind of challenge: all in which challenges of different kinds differ. Its values are the defaults of a new challenge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// The Galaxy Challenge of GREAT10 (Kitching et al. 2012): 24 sets with a variable shear field each.
    Great10,
    /// Sets with one shear each, ranked by Q_c, as the branches of GREAT3 with constant shear (Mandelbaum et al. 2014). The images
    /// are those of GREAT10's layout.
    Great3,
}

impl Kind {
    /// Name on the command line and in `challenge.toml`.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Great10 => "great10",
            Kind::Great3 => "great3",
        }
    }

    pub fn title(self) -> &'static str {
        match self {
            Kind::Great10 => "GREAT10 Galaxy Challenge",
            Kind::Great3 => "GREAT3-like challenge of constant shear",
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
            Kind::Great10 | Kind::Great3 => vec![Contents::Catalogues],
        }
    }

    /// Most entries of a team; `None` for any number.
    pub fn entries_per_team(self) -> Option<u32> {
        match self {
            // Published values determine the truth entry by entry (docs/run-a-challenge.md).
            Kind::Great10 | Kind::Great3 => Some(10),
        }
    }

    /// Names of images and PSFs.
    pub fn layout(self) -> Layout {
        match self {
            Kind::Great10 | Kind::Great3 => Layout::default(),
        }
    }

    pub fn conventions(self) -> BTreeMap<String, String> {
        let conventions = match self {
            Kind::Great10 | Kind::Great3 => [
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
            ],
        };
        let owned = |(name, text): (&str, &str)| (name.to_owned(), text.to_owned());
        conventions.map(owned).into()
    }

    /// Rules for participants, one sentence each.
    pub fn rules(self) -> [&'static str; 2] {
        match self {
            Kind::Great10 => [
                "An entry covers all images of all sets.",
                "All images of a set have one shear field, so methods may average over them.",
            ],
            Kind::Great3 => [
                "An entry covers all images of all sets.",
                "All galaxies of a set have one shear; no two sets have the same.",
            ],
        }
    }
}
