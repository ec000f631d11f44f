//! What a results store keeps of a scored run.

use std::path::Path;

use shearq_scoring::{Choice, Definition, Noise, Options};

use super::PipelineError;
use super::score::ScoredSet;
use crate::io::FileError;
use crate::io::fingerprint;
use crate::io::layout::DataFolder;
use crate::io::run::{Run, Source};
use crate::io::store::{RunRecord, SetRecord};

/// What was measured, and by what.
pub struct Measured<'a> {
    /// Name of the submission, or of another program's catalogues.
    pub name: &'a str,
    /// All settings, as TOML.
    pub settings: String,
    /// Where the galaxies come from.
    pub source: &'a Source,
    /// Where the true shear is.
    pub data: &'a DataFolder,
}

impl<'a> Measured<'a> {
    /// A run of ours.
    ///
    /// # Errors
    /// Where the settings cannot be written as TOML.
    pub fn run(run: &'a Run, data: &'a DataFolder, folder: &Path) -> Result<Self, FileError> {
        let settings = toml::to_string(&run.submission)
            .map_err(FileError::doing(folder, "cannot store the settings"))?;
        Ok(Measured {
            name: &run.submission.name,
            settings,
            source: &run.source,
            data,
        })
    }
}

/// The record of a scored run.
///
/// # Errors
/// Where the data cannot be read for their fingerprint.
pub fn run_record(
    measured: Measured<'_>,
    scored: &[ScoredSet],
    options: Options,
) -> Result<RunRecord, PipelineError> {
    let Measured {
        name,
        settings,
        source,
        data,
    } = measured;
    let sets = scored
        .iter()
        .map(|scored| {
            let print = fingerprint::of_set(source, data, scored.set, &scored.images)?;
            Ok(set_record(scored, print))
        })
        .collect::<Result<_, FileError>>()?;
    Ok(RunRecord {
        submission: name.to_owned(),
        version: crate::VERSION.into(),
        settings,
        source: match source {
            Source::Simulated(settings) => serde_json::to_string(settings)
                .map_err(FileError::doing(data.root(), "cannot store the settings"))?,
            Source::Folder { .. } => fingerprint::of_source(source, data)?,
        },
        definition: match options.definition {
            Definition::Leaderboard => "leaderboard".into(),
            Definition::Corrected => "corrected".into(),
        },
        choice: match options.choice {
            Choice::Matched => "matched".into(),
            Choice::Best => "best".into(),
            Choice::Insist(convention) => convention.number().to_string(),
        },
        noise: match options.noise {
            Noise::Measured => "measured".into(),
            Noise::Given(variance) => variance.to_string(),
        },
        sets,
    })
}

/// The record of one set, of data with the fingerprint `data`.
pub fn set_record(scored: &ScoredSet, data: String) -> SetRecord {
    let ScoredSet {
        set,
        images,
        score,
        rows,
        basis,
    } = scored;
    SetRecord {
        set: *set,
        data,
        images: images.clone(),
        galaxies: (rows.used + rows.not_finite) as u64,
        flagged: rows.not_finite as u64,
        figures: score.figures,
        errors: score.errors,
        q_replicates: score.replicates.iter().map(|r| r.q).collect(),
        q_leaderboard: score.conventions[score.best.index()].quality.q,
        convention: score.chosen.number(),
        convention_known: basis.is_known(),
        convention_leaderboard: score.best.number(),
    }
}
