//! Kinds of challenges. A kind is one value with metric, layout and rules.

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use shearq_pipeline::data::layout::Layout;
use shearq_results::compare::Paired;
use shearq_results::row::{SetRecord, mean_metric};
use shearq_results::submit::manifest::Contents;
use shearq_scoring::Definition;

/// Metric that ranks the entries of a challenge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RankBy {
    /// Q with the arithmetic of GREAT10's leaderboard.
    Q,
    /// Q with azimuthal averages over fixed bins.
    QCorrected,
    /// Q after dividing by the measured response.
    QCalibrated,
    /// |m|, the multiplicative bias by cross-correlation.
    M,
    /// c, the modulus of the additive bias.
    C,
    /// Noise of one galaxy's ellipticity per component.
    Noise,
}

impl RankBy {
    /// Definition of bandpowers that entries are scored with.
    pub fn definition(self) -> Definition {
        match self {
            RankBy::QCorrected => Definition::Corrected,
            _ => Definition::Leaderboard,
        }
    }

    /// Heading in tables.
    pub fn label(self) -> &'static str {
        match self {
            RankBy::Q => "Q",
            RankBy::QCorrected => "Q (corrected)",
            RankBy::QCalibrated => "Q cal.",
            RankBy::M => "|m|",
            RankBy::C => "c",
            RankBy::Noise => "noise",
        }
    }

    /// Meaning in one sentence.
    pub fn meaning(self) -> &'static str {
        match self {
            RankBy::Q => {
                "Q is the quality factor 5·10⁻³/σ_sys, with the arithmetic of GREAT10's leaderboard."
            }
            RankBy::QCorrected => {
                "Q is the quality factor 5·10⁻³/σ_sys, with azimuthal averages over fixed bins."
            }
            RankBy::QCalibrated => {
                "Q cal. is the quality factor after dividing by the measured response."
            }
            RankBy::M => {
                "|m| is the modulus of the multiplicative bias, by cross-correlation with the true shear."
            }
            RankBy::C => "c is the modulus of the additive bias.",
            RankBy::Noise => {
                "Noise is the scatter of one galaxy's ellipticity per component, divided by the response."
            }
        }
    }

    /// Whether a larger value is better.
    pub fn larger_is_better(self) -> bool {
        matches!(self, RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated)
    }

    /// Decimals of a leaderboard, unless the organiser chooses other.
    pub fn decimals(self) -> usize {
        match self {
            RankBy::Q | RankBy::QCorrected | RankBy::QCalibrated => 1,
            RankBy::M | RankBy::Noise => 4,
            RankBy::C => 5,
        }
    }

    /// Whether a power spectrum has this metric.
    pub fn is_of_spectra(self) -> bool {
        matches!(self, RankBy::Q | RankBy::QCorrected)
    }

    /// Mean over sets, and its standard error.
    pub fn of(self, sets: &[SetRecord]) -> (f64, f64) {
        let mean = |name: &str| mean_metric(sets, name);
        match self {
            RankBy::Q | RankBy::QCorrected => mean("q"),
            RankBy::QCalibrated => mean("q_calibrated"),
            RankBy::M => {
                let (m, error) = mean("m_cross");
                (m.abs(), error)
            }
            RankBy::C => {
                let (c1, c2) = (mean("c1"), mean("c2"));
                let modulus = c1.0.hypot(c2.0);
                // The error along the direction of c.
                let error = (c1.0 * c1.1).hypot(c2.0 * c2.1) / modulus;
                (modulus, error)
            }
            RankBy::Noise => mean("galaxy_noise"),
        }
    }

    /// The metric of paired differences, if there is one.
    pub fn paired(self) -> Option<Paired> {
        match self {
            RankBy::Q | RankBy::QCorrected => Some(Paired::Q),
            RankBy::QCalibrated => Some(Paired::Calibrated),
            RankBy::M | RankBy::C | RankBy::Noise => None,
        }
    }
}

/// A kind of challenge. Its values are the defaults of a new challenge.
#[derive(Debug)]
pub struct Kind {
    /// Name on the command line and in `challenge.toml`.
    pub name: &'static str,
    /// Full name.
    pub title: &'static str,
    /// Metric that ranks the entries.
    pub metric: RankBy,
    /// Accepted files.
    pub contents: &'static [Contents],
    /// Most entries of a team; `None` for any number.
    pub entries_per_team: Option<u32>,
    /// Names of the files.
    pub layout: fn() -> Layout,
    /// Conventions, as names and descriptions.
    pub conventions: &'static [(&'static str, &'static str)],
    /// Rules for participants, one sentence each.
    pub rules: &'static [&'static str],
}

/// The Galaxy Challenge of GREAT10 (Kitching et al. 2012): 24 sets with a variable shear field each.
pub static GREAT10: Kind = Kind {
    name: "great10",
    title: "GREAT10 Galaxy Challenge",
    metric: RankBy::Q,
    contents: &[
        Contents::Catalogues,
        Contents::Spectra,
        Contents::CrossSpectra,
    ],
    entries_per_team: None,
    layout: Layout::default,
    conventions: &[
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
    rules: &[
        "An entry covers all images of all sets.",
        "All images of a set have one shear field, so methods may average over them.",
    ],
};

/// All kinds.
pub static KINDS: [&Kind; 1] = [&GREAT10];

/// The kind called `name`.
pub fn kind(name: &str) -> Option<&'static Kind> {
    KINDS.into_iter().find(|kind| kind.name == name)
}

impl Serialize for &'static Kind {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name)
    }
}

/// For `#[serde(deserialize_with)]`: reads the name of a kind.
pub(crate) fn by_name<'de, D: Deserializer<'de>>(d: D) -> Result<&'static Kind, D::Error> {
    let name = String::deserialize(d)?;
    kind(&name).ok_or_else(|| {
        let known: Vec<&str> = KINDS.iter().map(|kind| kind.name).collect();
        let message = format!(
            "unknown kind of challenge (found `{name}`, expected {})",
            known.join(" or ")
        );
        serde::de::Error::custom(message)
    })
}
