//! The metrics of GREAT3 (Mandelbaum et al. 2014, ApJS 212, 5).

use std::fmt;

#[cfg(feature = "serde")]
use serde::Serialize;
use shearq_quantities::Shear;
use shearq_quantities::units::Radians;

use crate::aperture::SEPARATION_BINS;
use crate::error::ScoringError;
use crate::line::Line;
use crate::resample::{group_sizes, jackknife_error};

/// Subfields of a branch.
pub const SUBFIELDS: usize = 200;
/// Subfields of a field, where galaxies share a shear field or a model of the PSF.
pub const SUBFIELDS_PER_FIELD: usize = 20;
/// Galaxies per side of a subfield.
pub const GRID: usize = 100;
/// Nodes of the lattice of a field from a galaxy of a subfield to the next, along each axis.
pub const NODES_PER_GALAXY: usize = 7;
/// Epochs of a subfield in the experiments multiepoch and full. The others have one.
pub const EPOCHS: usize = 6;
/// Stars per side of an image of stars.
pub const STARS_PER_SIDE: usize = 3;

/// Identity of a galaxy, SSSXXXYYY: subfield, column and row from 0. In variable branches columns and rows are nodes of the lattice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Identity(u32);

impl Identity {
    /// Of numbers below 1000 each.
    pub fn new(subfield: usize, (x, y): (usize, usize)) -> Self {
        Identity((1_000_000 * subfield + 1000 * x + y) as u32)
    }

    /// As it stands in a table; `None` if it has a sign, a fraction or more than nine digits, as a number of another column.
    pub fn of_number(number: f64) -> Option<Self> {
        let is_whole = (0.0..1e9).contains(&number) && number.fract() == 0.0;
        is_whole.then_some(Identity(number as u32))
    }

    /// As it stands in a table.
    pub fn number(self) -> i64 {
        self.0.into()
    }

    /// Number of its subfield.
    pub fn subfield(self) -> usize {
        self.0 as usize / 1_000_000
    }

    /// Column and row.
    pub fn place(self) -> (usize, usize) {
        (self.0 as usize / 1000 % 1000, self.0 as usize % 1000)
    }
}

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:09}", self.0)
    }
}

/// Requirement on |c| of a survey of Stage IV, to which Q_c refers.
pub const REQUIRED_C: f64 = 2e-4;
/// Requirement on |m| of a survey of Stage IV, to which Q_c refers.
pub const REQUIRED_M: f64 = 2e-3;
// 2000 times the factor η_c = 1.232 of the challenge's program. All 872 entries of constant shear on the public leaderboard
// follow from their own m and c with it, to 10⁻³.
const Q_C_SCALE: f64 = 1.232 * 2000.0;
// Scale of Q_v in the challenge's program.
const Q_V_SCALE: f64 = 1.837e-4;

/// Simulated ground or space data, which differ in the floor of Q.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Observation {
    /// From the ground.
    Ground,
    /// From space.
    Space,
}

impl Observation {
    // σ² of Q_c and of Q_v: without it, luck would have the best scores.
    fn floors(self) -> (f64, f64) {
        match self {
            Observation::Ground => (4.0, 9e-8),
            Observation::Space => (1.0, 4e-8),
        }
    }

    /// Q_c = 1.232 · 2000 / √[Σ (c/2·10⁻⁴)² + Σ (m/2·10⁻³)² + σ²], of `[c, m]` of both components.
    pub fn q_c(self, biases: [[f64; 2]; 2]) -> f64 {
        let terms = biases.map(|[c, m]| (c / REQUIRED_C).powi(2) + (m / REQUIRED_M).powi(2));
        Q_C_SCALE / (terms[0] + terms[1] + self.floors().0).sqrt()
    }
}

/// Component of an ellipticity along an axis and at 45° to it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
pub struct PlusCross<T> {
    /// Along the axis.
    pub plus: T,
    /// At 45° to the axis.
    pub cross: T,
}

/// Position angle φ = ½ atan2(e2, e1) of an ellipse, from +x towards +y; 0 if it is round.
pub fn position_angle(shape: Shear) -> Radians {
    Radians(0.5 * shape.e2.atan2(shape.e1))
}

/// The components in a frame whose first axis has the position angle φ: g e^(−2iφ).
pub fn along(g: Shear, axis: Radians) -> PlusCross<f64> {
    let (sin, cos) = (2.0 * axis.0).sin_cos();
    PlusCross {
        plus: g.e1 * cos + g.e2 * sin,
        cross: g.e2 * cos - g.e1 * sin,
    }
}

/// What distinguishes the branches of one observation and shear.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Experiment {
    /// Parametric galaxies, one PSF per subfield.
    Control,
    /// Galaxies of images of the Hubble Space Telescope.
    RealGalaxy,
    /// A PSF that varies over the field.
    VariablePsf,
    /// Several epochs.
    Multiepoch,
    /// All of these.
    Full,
}

/// One of the 20 branches, such as control-ground-constant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Branch {
    /// The experiment.
    pub experiment: Experiment,
    /// From the ground or from space.
    pub observation: Observation,
    /// Whether all galaxies of a field have one shear.
    pub constant: bool,
}

impl Branch {
    /// All branches.
    pub fn all() -> impl Iterator<Item = Self> {
        use Experiment::{Control, Full, Multiepoch, RealGalaxy, VariablePsf};
        let kinds = [Observation::Ground, Observation::Space]
            .into_iter()
            .flat_map(|observation| [true, false].map(|constant| (observation, constant)));
        let experiments = [Control, RealGalaxy, VariablePsf, Multiepoch, Full];
        experiments.into_iter().flat_map(move |experiment| {
            kinds.clone().map(move |(observation, constant)| Branch {
                experiment,
                observation,
                constant,
            })
        })
    }

    /// The branch of a name or a folder; `None` if there is no such branch.
    pub fn named(name: &str) -> Option<Self> {
        Branch::all().find(|branch| branch.to_string() == name.replace('/', "-"))
    }

    /// Where the challenge has its files, below the root of its data.
    pub fn folder(self) -> String {
        self.to_string().replace('-', "/")
    }

    fn has_epochs(self) -> bool {
        matches!(self.experiment, Experiment::Multiepoch | Experiment::Full)
    }

    /// Images of a subfield.
    pub fn epochs(self) -> usize {
        if self.has_epochs() { EPOCHS } else { 1 }
    }

    /// Subfields that share a row of a submission.
    pub fn subfields_per_field(self) -> usize {
        match self.experiment {
            Experiment::VariablePsf | Experiment::Full => SUBFIELDS_PER_FIELD,
            _ if self.constant => 1,
            _ => SUBFIELDS_PER_FIELD,
        }
    }

    /// Pixels per side of a stamp.
    pub fn stamp(self) -> usize {
        match (self.observation, self.has_epochs()) {
            (Observation::Space, false) => 96,
            _ => 48,
        }
    }

    /// Side of a pixel in arcsec.
    pub fn pixel_arcsec(self) -> f64 {
        match (self.observation, self.has_epochs()) {
            (Observation::Ground, _) => 0.2,
            (Observation::Space, false) => 0.05,
            (Observation::Space, true) => 0.1,
        }
    }
}

impl fmt::Display for Branch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let experiment = match self.experiment {
            Experiment::Control => "control",
            Experiment::RealGalaxy => "real_galaxy",
            Experiment::VariablePsf => "variable_psf",
            Experiment::Multiepoch => "multiepoch",
            Experiment::Full => "full",
        };
        let observation = match self.observation {
            Observation::Ground => "ground",
            Observation::Space => "space",
        };
        let shear = if self.constant {
            "constant"
        } else {
            "variable"
        };
        write!(f, "{experiment}-{observation}-{shear}")
    }
}

/// A value with two errors.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
pub struct Bias {
    /// Best value.
    pub value: f64,
    /// The challenge's error, from the mean square of the residuals: σ² = Σ residual²/N.
    pub error: f64,
    /// Error by the jackknife over fields.
    pub jackknife: f64,
}

/// The score of a branch with one shear per field.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
pub struct ConstantScore {
    /// Q_c.
    pub q: f64,
    /// Its error by the jackknife over fields.
    pub jackknife: f64,
    /// Additive bias.
    pub c: PlusCross<Bias>,
    /// Multiplicative bias.
    pub m: PlusCross<Bias>,
}

/// Submitted and true shear of a field, in the frame of its PSF.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConstantField {
    /// True shear.
    pub truth: Shear,
    /// Submitted shear.
    pub submitted: Shear,
    /// Mean ellipticity of the PSF, zero if unknown.
    pub psf: Shear,
}

// g_sub − g_true = c + m g_true without weights, along the PSF and at 45° to it.
fn biases(fields: &[ConstantField]) -> Result<[Line; 2], ScoringError> {
    let rotated = |of: fn(PlusCross<f64>) -> f64| -> Vec<(f64, f64)> {
        let pair = |field: &ConstantField| {
            let axis = position_angle(field.psf);
            let truth = of(along(field.truth, axis));
            (truth, of(along(field.submitted, axis)) - truth)
        };
        fields.iter().map(pair).collect()
    };
    let lines = [
        Line::through(&rotated(|own| own.plus)),
        Line::through(&rotated(|own| own.cross)),
    ];
    match lines.iter().all(Line::is_determined) {
        true => Ok(lines),
        false => Err(ScoringError::SameShears),
    }
}

/// Q_c, c and m of the fields of a branch with constant shear.
///
/// # Errors
/// If a number is not finite, or the true shears do not determine m.
pub fn constant_score(
    fields: &[ConstantField],
    observation: Observation,
) -> Result<ConstantScore, ScoringError> {
    let numbers = |field: &ConstantField| [field.truth, field.submitted, field.psf];
    let mut shears = fields.iter().flat_map(numbers);
    if !shears.all(|g| g.e1.is_finite() && g.e2.is_finite()) {
        return Err(ScoringError::NotFinite("a shear"));
    }
    // m and c along the PSF show its leakage in c₊ alone; in pixel axes it would average out.
    let whole = biases(fields)?;
    let quality = |of: &[Line; 2]| observation.q_c(of.map(|line| [line.intercept, line.slope]));
    let groups = group_sizes(fields.len()).len();
    let mut replicates = Vec::with_capacity(groups);
    for left_out in 0..groups {
        let kept = fields.iter().enumerate();
        let kept = kept.filter(|(k, _)| k % groups != left_out);
        let kept: Vec<ConstantField> = kept.map(|(_, field)| *field).collect();
        // With two fields, one determines no line: the errors are unknown.
        replicates.extend(biases(&kept));
    }
    let error = |full: f64, of: &dyn Fn(&[Line; 2]) -> f64| {
        jackknife_error(full, replicates.iter().map(of), fields.len())
    };
    let both = |which: usize, value: fn(&Line) -> f64| {
        let bias = |component: usize| Bias {
            value: value(&whole[component]),
            error: whole[component].errors_of_great3()[which],
            jackknife: error(value(&whole[component]), &|of| value(&of[component])),
        };
        PlusCross {
            plus: bias(0),
            cross: bias(1),
        }
    };
    let q = quality(&whole);
    Ok(ConstantScore {
        q,
        jackknife: error(q, &quality),
        c: both(0, |line| line.intercept),
        m: both(1, |line| line.slope),
    })
}

/// Q with its error by the jackknife.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(Serialize))]
pub struct Quality {
    /// Q.
    pub q: f64,
    /// Its error by the jackknife: over fields for Q_v, over sets for GREAT08. Not a number for a single one.
    pub jackknife: f64,
}

impl Quality {
    // `of` gives Q from the chosen of `count` fields.
    pub(crate) fn over(count: usize, of: impl Fn(&dyn Fn(usize) -> bool) -> f64) -> Self {
        let groups = group_sizes(count).len();
        let q = of(&|_| true);
        let replicates = (0..groups).map(|left_out| of(&|k| k % groups != left_out));
        Quality {
            q,
            jackknife: jackknife_error(q, replicates, count),
        }
    }
}

/// Bins of separation that Q_v uses, 0.0853° to 3.5495°: in the others the sums are cut at the field or lack pairs.
pub const Q_V_BINS: std::ops::RangeInclusive<usize> = 3..=12;

/// Q_v = 1.837·10⁻⁴ / [σ² + ⟨|⟨M_E,sub − M_E,true⟩_fields|⟩_bins] of ⟨M_ap²⟩ by field and bin.
///
/// # Errors
/// If the numbers of fields differ or a number is not finite.
pub fn variable_score(
    submitted: &[[f64; SEPARATION_BINS]],
    truth: &[[f64; SEPARATION_BINS]],
    observation: Observation,
) -> Result<Quality, ScoringError> {
    if submitted.len() != truth.len() || truth.is_empty() {
        return Err(ScoringError::Count {
            what: "fields",
            found: submitted.len(),
            expected: truth.len().max(1),
        });
    }
    let mut values = submitted.iter().chain(truth).flatten();
    if !values.all(|value| value.is_finite()) {
        return Err(ScoringError::NotFinite("an aperture mass"));
    }
    let pairs: Vec<_> = submitted.iter().zip(truth).collect();
    Ok(Quality::over(pairs.len(), |is_in| {
        let chosen = || {
            let all = pairs.iter().enumerate();
            all.filter(|(k, _)| is_in(*k)).map(|(_, pair)| pair)
        };
        let fields = chosen().count() as f64;
        let difference = |bin: usize| chosen().map(|(s, t)| s[bin] - t[bin]).sum::<f64>().abs();
        let mean = Q_V_BINS.map(difference).sum::<f64>() / (fields * Q_V_BINS.count() as f64);
        Q_V_SCALE / (observation.floors().1 + mean)
    }))
}
