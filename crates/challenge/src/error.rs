//! Why a challenge cannot be made or ranked.

use shearq_dataset::layout::MAX_SET;
use shearq_dataset::threads::ThreadError;
use shearq_files::FileError;
use shearq_pipeline::PipelineError;
use shearq_quantities::{hints, tried};
use shearq_results::score::ScoreError;
use shearq_scoring::ScoringError;
use thiserror::Error;

use crate::kind::{Kind, MIN_SCENES};
use crate::terms::Deadline;

// Significance of the response that a method of ordinary noise must expect. Entries need 3; two more make a refusal by
// chance unlikely.
pub(crate) const EXPECTED_RESPONSE: f64 = 5.0;

/// Failure to make a challenge: a file or a measurement, or data and rules by which entries could not be ranked.
#[derive(Debug, Error)]
pub enum ChallengeError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// Reference images that cannot be simulated or measured.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    #[error(transparent)]
    Threads(#[from] ThreadError),
    #[error(transparent)]
    Simulation(#[from] shearq_simulate::set::SettingsError),
    #[error(
        "--amplitude 0: without shear, entries cannot be ranked (found 0, expected a positive number)"
    )]
    NoShear,
    #[error("--amplitude and --tilt are those of a field of shears, but --kind great3 has one shear per set{}", tried(self.hint()))]
    NoSpectrum,
    #[error("--kind scenes needs the number of scenes{}", tried(self.hint()))]
    NoScenes,
    #[error("--scenes is of another kind of challenge (found --kind {}){}", .0.name(), tried(self.hint()))]
    ScenesOfKind(Kind),
    #[error("--scenes: found {0}, expected {MIN_SCENES} to {MAX_SET}")]
    SceneCount(u32),
    #[error(
        "--density: found 0 galaxies per arcmin² (expected a positive number): there is nothing to measure"
    )]
    NoGalaxies,
    #[error(
        "--closes: the last day is before the first one (found {closes}, expected {opens} or later)"
    )]
    ClosesFirst { opens: Deadline, closes: Deadline },
    #[error("--spectra: {metric} is not defined for power spectra{}", tried(self.hint()))]
    NotOfSpectra { metric: &'static str },
    #[error(
        "--spectra: the response of power spectra follows from differences between sets (found 1 set, expected at least 2)"
    )]
    OneSpectrum,
    #[error("the true shear {}, so {metric} is not defined{}", if *constant { "is the same for all galaxies of a set" } else { "varies within the sets" }, tried(self.hint()))]
    Undefined {
        metric: &'static str,
        constant: bool,
    },
    #[error("{0}")]
    Shears(String),
    #[error("the images contradict the true shear of {of}: sign, order, scale, positions or sets differ (found a response of {response:.2} ± {error:.2}, expected 0.625 to 1.6){}", tried(self.hint()))]
    Contradiction {
        of: String,
        response: f64,
        error: f64,
    },
    #[error("the data are too small to rank entries by {metric}: the response of {of} is expected to be {found:.1}σ from zero (expected at least {EXPECTED_RESPONSE}){}", tried(self.hint()))]
    SmallResponse {
        metric: &'static str,
        of: String,
        found: f64,
        // Images that would do.
        images: f64,
    },
    #[error("the data are too small to rank entries by {metric}: a spectrum without images reaches {template:.0}, a catalogue with the noise of these images about {catalogue:.0}{}", tried(self.hint()))]
    BehindTemplate {
        metric: &'static str,
        template: f64,
        catalogue: f64,
        images: f64,
    },
}

impl ChallengeError {
    hints! {
        Self::File(error) => return error.hint.clone(),
        Self::Score(error) => return error.hint(),
        Self::Pipeline(error) => return error.hint(),
        Self::NoSpectrum => "without them",
        Self::NoScenes => "--scenes N",
        Self::ScenesOfKind(..) => "--kind scenes",
        Self::NotOfSpectra { .. } => "--metric q or q-corrected",
        Self::Undefined { constant, .. } => match constant {
            true => "--metric qc, m or c",
            false => "--metric q-calibrated, m or c",
        },
        Self::Contradiction { .. } => "the same command with the right true shear",
        Self::SmallResponse { images, .. } => {
            &format!("{images} images per set, or more galaxies per image")
        }
        Self::BehindTemplate { images, .. } => {
            &format!("--metric q-calibrated, or {images} images per set")
        }
    }
}

pub(crate) fn unscored(source: ScoringError) -> ChallengeError {
    ChallengeError::Score(ScoreError::Scoring { set: None, source })
}
