//! The paper's Sect. 5: configurations on simulated sets, set by set, resumable.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use shearq_scoring::{BINS, FieldSum, Grid, Noise, Options, Row, RowCounts, SetImages, SetScorer};
use shearq_submissions::{Configuration, checked_name};

use super::response::{Regression, Response};
use shearq_dataset::grid::Mosaic;
use shearq_dataset::run::{Claim, claim, nan_for_null, read_record, write_record};
use shearq_dataset::threads::Progress;
use shearq_files::FileError;
use shearq_measure::{Measurement, Measurer};
use shearq_pipeline::PipelineError;
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_quantities::statistics::RunningMean;
use shearq_results::catalogues::OWN;
use shearq_results::record::SetRecord;
use shearq_simulate::kinds::SetKind;
use shearq_simulate::set::{STAMP, SimulationSettings};

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    pub version: String,
    pub simulation: SimulationSettings,
    pub images: u32,
    pub configurations: Vec<Configuration>,
}

/// A folder of results that belongs to a plan for as long as this value exists.
#[derive(Debug)]
pub struct Study<'a> {
    pub plan: &'a Plan,
    pub folder: &'a Path,
    pub claim: Claim,
}

impl<'a> Study<'a> {
    pub fn open(plan: &'a Plan, folder: &'a Path) -> Result<Self, FileError> {
        Ok(Study {
            plan,
            folder,
            claim: claim(&folder.join("plan.json"), plan)?,
        })
    }

    // The result of each set, which is written to `path` as soon as it is known. Existing results, of `images` images, are
    // read.
    pub(super) fn each_set<R: Serialize + DeserializeOwned>(
        &self,
        sets: &[u32],
        images: u32,
        path: impl Fn(u32) -> PathBuf,
        progress: &mut dyn Progress,
        mut measure: impl FnMut(u32, &mut dyn Progress) -> Result<R, PipelineError>,
    ) -> Result<Vec<R>, PipelineError> {
        let path = |set: u32| self.folder.join(path(set));
        let mut results = Vec::new();
        for &set in sets {
            if let Some(result) = read_record(&path(set))? {
                progress.skip(u64::from(images) * (self.plan.simulation.grid as u64).pow(2));
                results.push(result);
                continue;
            }
            let result = measure(set, progress)?;
            // Writing would make a removed folder again, without its earlier results.
            self.claim.check()?;
            write_record(&path(set), &result)?;
            results.push(result);
        }
        self.claim
            .check_results(sets.iter().map(|&set| path(set)))?;
        Ok(results)
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConfigurationResult {
    #[serde(deserialize_with = "checked_name")]
    #[serde(rename = "submission")]
    pub configuration: String,
    /// Standard convention, leaderboard definition.
    #[serde(flatten)]
    pub score: SetRecord,
    /// Number of the convention that correlates best with the truth.
    pub convention_matched: u8,
    pub ee: [f64; BINS],
    /// Standard errors of the bandpowers for a fixed truth; NaN outside the scored bins.
    #[serde(deserialize_with = "nan_for_null")]
    pub ee_error: [f64; BINS],
    pub response: Response,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetResult {
    pub set: u32,
    pub images: u32,
    pub l: [f64; BINS],
    pub true_ee: [f64; BINS],
    /// One per configuration, in the order of the plan.
    pub results: Vec<ConfigurationResult>,
}

/// Runs the configurations of the study on `sets`.
pub fn run_sets(
    study: &Study<'_>,
    sets: &[u32],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<SetResult>, PipelineError> {
    let plan = study.plan;
    // The paper's Table 1 has two pairs of configurations that differ only in name.
    let (distinct, place) = distinct(&plan.configurations);
    let measurers = measurers(&distinct)?;
    let path = |set: u32| format!("sets/set{set:02}.json").into();
    study.each_set(sets, plan.images, path, progress, |set, progress| {
        let mut result = measure_set(plan, set, &measurers, threads, progress)?;
        let named = |(configuration, &at): (&Configuration, &usize)| ConfigurationResult {
            configuration: configuration.name.clone(),
            ..result.results[at].clone()
        };
        result.results = plan.configurations.iter().zip(&place).map(named).collect();
        Ok(result)
    })
}

// Sums over the images of a set that one configuration measured. Ellipticities are not yet divided by a response.
#[derive(Clone)]
struct ConfigurationSums {
    images: SetImages,
    rows: RowCounts,
    regression: Regression,
    responses: [RunningMean; 2],
}

// Simulates the images of a set, measures them with all measurers and scores the results.
fn measure_set(
    plan: &Plan,
    set: u32,
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<SetResult, PipelineError> {
    let scoring = |source| PipelineError::Scoring {
        set: Some(set),
        source,
    };
    let simulator = simulator(set, plan.simulation)?;
    let grid = simulator.grid();
    let images: Vec<u32> = (1..=plan.images).collect();
    let sums = ConfigurationSums {
        images: SetImages::new(&grid),
        rows: RowCounts::default(),
        regression: Regression::default(),
        responses: [RunningMean::default(); 2],
    };
    let mut sums = vec![sums; measurers.len()];
    run_set(
        &simulator,
        &images,
        measurers,
        threads,
        progress,
        |image, _| {
            for (sums, batch) in sums.iter_mut().zip(image.batches) {
                let galaxies = &batch.galaxies;
                let (field, used) = field_sum(&grid, galaxies);
                sums.images.add(&field).map_err(scoring)?;
                sums.rows += used;
                let pairs = image.observed.iter().copied().zip(galaxies);
                sums.regression.add(pairs);
                let good = galaxies.iter().filter(|galaxy| galaxy.flags.is_empty());
                for galaxy in good.filter(|_| batch.response.is_some()) {
                    let means = sums.responses.iter_mut().zip(galaxy.response_diagonal());
                    means.for_each(|(mean, response)| mean.add(response));
                }
            }
            Ok(())
        },
    )?;
    progress.note(&format!("set {set:02}"));
    let options = Options {
        noise: Noise::Measured,
        choice: OWN,
        ..Options::default()
    };
    let scorer = SetScorer::new(grid, simulator.truth(), options).map_err(scoring)?;
    let mut result = SetResult {
        set,
        images: plan.images,
        l: [0.0; BINS],
        true_ee: [0.0; BINS],
        results: Vec::new(),
    };
    for mut sums in sums {
        // The response of a set, as `score` uses it: that of an image is noisy, and ⟨1/R̂⟩ exceeds 1/⟨R⟩.
        if sums.responses[0].count() > 0 {
            let response = sums.responses.map(|own| own.mean());
            sums.images.divide(response);
            sums.regression.divide(response);
        }
        let score = scorer.score(&sums.images).map_err(scoring)?;
        (result.l, result.true_ee) = (score.bins.l, score.true_ee);
        // The settings of the plan identify simulated data, so there is no fingerprint.
        let simulated = SetKind::of(set).is_some();
        result.results.push(ConfigurationResult {
            configuration: String::new(),
            score: SetRecord::new(set, simulated, images.clone(), &score, &sums.rows, true),
            convention_matched: score.matching.best().number(),
            ee: score.spectra().ee,
            ee_error: score.ee_error,
            response: sums.regression.response(),
        });
    }
    Ok(result)
}

// The configurations without repetition, and the index among them of each given one.
fn distinct(configurations: &[Configuration]) -> (Vec<Configuration>, Vec<usize>) {
    let mut kept: Vec<Configuration> = Vec::new();
    let mut place = Vec::new();
    for configuration in configurations {
        let same = |other: &Configuration| {
            Configuration {
                name: other.name.clone(),
                description: other.description.clone(),
                ..configuration.clone()
            } == *other
        };
        place.push(kept.iter().position(same).unwrap_or_else(|| {
            kept.push(configuration.clone());
            kept.len() - 1
        }));
    }
    (kept, place)
}

// The measurements of one image on the grid, and how the rows were used. Flagged galaxies count as missing.
fn field_sum(grid: &Grid, galaxies: &[Measurement]) -> (FieldSum, RowCounts) {
    let mut sum = FieldSum::new(grid);
    let mosaic = Mosaic::square(grid.n, STAMP);
    let rows = galaxies.iter().enumerate().map(|(place, galaxy)| {
        let (x, y) = mosaic.position(place);
        Row {
            x,
            y,
            e1: galaxy.e1,
            e2: galaxy.e2,
        }
    });
    let counts = sum.add_image(grid, rows);
    (sum, counts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_dataset::threads::Quiet;
    use shearq_submissions::Registry;

    fn plan(names: &[&str]) -> Plan {
        let registry = Registry::embedded().unwrap();
        let configuration = |name: &&str| registry.get(name).unwrap().configuration;
        Plan {
            version: "test".into(),
            simulation: SimulationSettings::new(5, 12),
            images: 2,
            configurations: names.iter().map(configuration).collect(),
        }
    }

    // Removes the folder as soon as the set is measured.
    struct Remover<'a>(&'a Path);

    impl Progress for Remover<'_> {
        fn advance(&mut self, _: u64) {}

        fn note(&mut self, _: &str) {
            std::fs::remove_dir_all(self.0).unwrap();
        }

        fn warn(&mut self, _: &str) {}
    }

    #[test]
    fn a_removed_folder_is_an_error_and_is_not_made_again() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("study");
        let plan = plan(&["23/raw/star"]);
        let study = Study::open(&plan, &folder).unwrap();
        study.claim.check().unwrap();
        let error = run_sets(&study, &[2], 1, &mut Remover(&folder)).unwrap_err();
        let message = error.to_string();
        assert!(message.contains("removed or replaced"), "{message}");
        assert!(study.claim.check().is_err());
        assert!(!folder.exists());
    }

    #[test]
    fn results_are_kept_and_read_again() {
        let root = tempfile::tempdir().unwrap();
        let plan = plan(&["23/raw/star", "23/den/star"]);
        let study = Study::open(&plan, root.path()).unwrap();
        let first = run_sets(&study, &[2], 1, &mut Quiet).unwrap();
        assert_eq!(first[0].results.len(), 2);
        assert_eq!(first[0].results[1].configuration, "23/den/star");
        let text = |results: &[SetResult]| serde_json::to_string(results).unwrap();
        let again = run_sets(&study, &[2], 1, &mut Quiet).unwrap();
        assert_eq!(text(&again), text(&first));
        // A result that is missing at the end is an error.
        let path = root.path().join("sets/set02.json");
        std::fs::remove_file(&path).unwrap();
        assert!(study.claim.check_results([path]).is_err());
    }

    #[test]
    fn configurations_that_differ_only_in_name_are_measured_once() {
        let registry = Registry::embedded().unwrap();
        let raw = registry.get("23/raw/star").unwrap().configuration;
        let den = registry.get("23/den/star").unwrap().configuration;
        let renamed = Configuration {
            name: "mine".into(),
            description: "The same under another name".into(),
            ..raw.clone()
        };
        let (kept, place) = distinct(&[raw.clone(), den.clone(), renamed]);
        assert_eq!(place, [0, 1, 0]);
        assert_eq!(kept, [raw, den]);
    }
}
