//! Sect. 5 of the paper: the configurations of Table 1 on simulated sets, Figs 8 to 11.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shearq_dataset::grid::Mosaic;
use shearq_dataset::layout::fill;
use shearq_dataset::run::{Claim, nan_for_null, read_record, write_record};
use shearq_dataset::threads::Progress;
use shearq_measure::Measurer;
use shearq_pipeline::PipelineError;
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_render::figure::{LinePlot, PanelGrid, Series, Style};
use shearq_render::page::{Page, PageError};
use shearq_render::table::{Cell, Table};
use shearq_results::catalogues::OWN;
use shearq_results::record::SetRecord;
use shearq_results::views::pages::{bins, spectrum_panel};
use shearq_scoring::{BINS, FieldSum, Metrics, Options, Row, ScoredImages, SetSession};
use shearq_simulate::kinds::{SetKind, shares};
use shearq_simulate::set::{STAMP, SimulationSettings};
use shearq_submissions::{Configuration, PsfForm, Published};

// The paper shows these two in Figs 3 and 9 to 11.
pub(crate) const RAW: &str = "23/raw/star";
const DENOISED: &str = "23/den/star";

/// Names of the scores of a set.
pub(crate) const SCORES: &str = "sets/set{set:02}.json";

/// What determines the results of a folder.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Plan {
    pub(crate) version: String,
    pub(crate) simulation: SimulationSettings,
    pub(crate) images: u32,
    pub(crate) configurations: Vec<Configuration>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct ConfigurationScore {
    #[serde(rename = "submission")]
    configuration: String,
    #[serde(flatten)]
    score: SetRecord,
    // Number of the convention that correlates best with the truth.
    convention_matched: u8,
    ee: [f64; BINS],
    // Standard errors of the bandpowers for a fixed truth; NaN outside the scored bins.
    #[serde(deserialize_with = "nan_for_null")]
    ee_error: [f64; BINS],
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct SetScores {
    set: u32,
    images: u32,
    l: [f64; BINS],
    true_ee: [f64; BINS],
    // In the order of the plan.
    results: Vec<ConfigurationScore>,
}

/// The scores on each of `sets`, which are written to the claimed folder as soon as they are known. Those that are there
/// already are read.
pub(crate) fn score_sets(
    plan: &Plan,
    sets: &[u32],
    (folder, claim): (&Path, &Claim),
    threads: usize,
    progress: &mut dyn Progress,
) -> anyhow::Result<Vec<SetScores>> {
    // The paper's Table 1 has two pairs of configurations that differ only in name.
    let (distinct, places) = distinct(&plan.configurations);
    let measurers = measurers(&distinct)?;
    let path = |set: u32| folder.join(fill(SCORES, set, 0));
    let mut results = Vec::new();
    for &set in sets {
        if let Some(scores) = read_record::<SetScores>(&path(set))? {
            anyhow::ensure!(
                (scores.set, scores.images) == (set, plan.images),
                "{}: these are scores of {} images of set {}; expected {} of set {set}. Try: remove the file",
                path(set).display(),
                scores.images,
                scores.set,
                plan.images
            );
            progress.skip(u64::from(plan.images) * (plan.simulation.grid as u64).pow(2));
            results.push(scores);
            continue;
        }
        let mut scores = score_set(plan, set, &measurers, threads, progress)?;
        let named = |(configuration, &place): (&Configuration, &usize)| ConfigurationScore {
            configuration: configuration.name.clone(),
            ..scores.results[place].clone()
        };
        scores.results = plan.configurations.iter().zip(&places).map(named).collect();
        progress.note(&format!("set {set:02}"));
        // Writing would make a removed folder again, without its earlier results.
        claim.check()?;
        write_record(&path(set), &scores)?;
        results.push(scores);
    }
    claim.check_results(sets.iter().map(|&set| path(set)))?;
    Ok(results)
}

// Simulates the images of a set, measures them with all measurers and scores the results.
fn score_set(
    plan: &Plan,
    set: u32,
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<SetScores, PipelineError> {
    let scoring = |source| PipelineError::Scoring {
        set: Some(set),
        source,
    };
    let simulator = simulator(set, plan.simulation)?;
    let grid = simulator.grid();
    let mosaic = Mosaic::square(grid.n, STAMP);
    let images: Vec<u32> = (1..=plan.images).collect();
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let session = SetSession::new(grid, Some(simulator.truth()), options).map_err(scoring)?;
    let mut sums = vec![session.begin(); measurers.len()];
    run_set(
        &simulator,
        &images,
        measurers,
        threads,
        progress,
        |image, _| {
            for (added, batch) in sums.iter_mut().zip(image.batches) {
                let mut field = FieldSum::new(&grid);
                let galaxies = batch.galaxies.iter().enumerate();
                // Ellipticities of flagged galaxies are NaN, which counts as missing. Networks have no response to divide by.
                let rows = field.add_image(
                    &grid,
                    galaxies.map(|(place, galaxy)| {
                        let (x, y) = mosaic.position(place);
                        let (e1, e2) = (galaxy.e1, galaxy.e2);
                        Row { x, y, e1, e2 }
                    }),
                );
                let examined = session.examine(field, rows).map_err(scoring)?;
                added.add(&examined).map_err(scoring)?;
            }
            Ok(())
        },
    )?;
    let mut scores = SetScores {
        set,
        images: plan.images,
        l: [0.0; BINS],
        true_ee: [0.0; BINS],
        results: Vec::new(),
    };
    for added in &sums {
        let ScoredImages { score, rows, .. } = added.finish().map_err(scoring)?;
        (scores.l, scores.true_ee) = (score.bins.l, score.true_ee);
        scores.results.push(ConfigurationScore {
            configuration: String::new(),
            // The settings of the plan identify simulated data, so there is no fingerprint.
            score: SetRecord::new(set, true, images.clone(), &score, &rows, true),
            convention_matched: score.matching.best().number(),
            ee: score.spectra().ee,
            ee_error: score.ee_error,
        });
    }
    Ok(scores)
}

// The configurations without repetition, and the place among them of each given one.
fn distinct(configurations: &[Configuration]) -> (Vec<Configuration>, Vec<usize>) {
    let mut kept: Vec<Configuration> = Vec::new();
    let mut places = Vec::new();
    for configuration in configurations {
        let same = |other: &Configuration| {
            Configuration {
                name: other.name.clone(),
                description: other.description.clone(),
                ..configuration.clone()
            } == *other
        };
        places.push(kept.iter().position(same).unwrap_or_else(|| {
            kept.push(configuration.clone());
            kept.len() - 1
        }));
    }
    (kept, places)
}

type Metric = fn(&Metrics) -> f64;

fn measured((value, error): (f64, f64), decimals: usize) -> Cell {
    Cell::with_error(value, Some(error), decimals)
}

fn of_each_set(results: &[SetScores], place: usize, metric: Metric) -> Vec<(f64, f64)> {
    let scores = results.iter().map(|set| &set.results[place].score);
    let values = scores.map(|score| (metric(&score.metrics), metric(&score.errors)));
    values.collect()
}

// Mean over the challenge's 24 sets, of which one simulated set stands for all of its kind.
fn mean_of_24(results: &[SetScores], place: usize, metric: Metric) -> (f64, f64) {
    let sets: Vec<u32> = results.iter().map(|set| set.set).collect();
    let (mut mean, mut variance) = (0.0, 0.0);
    let values = of_each_set(results, place, metric);
    for ((value, error), share) in values.into_iter().zip(shares(&sets)) {
        mean += share * value;
        variance += (share * error).powi(2);
    }
    (mean, variance.sqrt())
}

/// Table 1: our metrics beside the published ones.
pub(crate) fn table_one(
    results: &[SetScores],
    configurations: &[(Configuration, Published)],
) -> Table {
    let rows: Vec<_> = configurations.iter().enumerate().collect();
    let mut table = Table::titled("Table 1: configurations over all sets (simulated data)");
    let mut words = |key, label, detail, word: &dyn Fn(&Configuration) -> String| {
        let place = table.column(key, label, &rows, |(_, (own, _))| Cell::text(word(own)));
        table.headings[place].detail = detail;
    };
    words("method", "Method", false, &|own| own.name.clone());
    words("size", "Size", true, &|own| {
        format!("{0}×{0}", own.stamp.size)
    });
    words("denoised", "Den", true, &|own| match own.wavelet() {
        Some(_) => "Y".into(),
        None => "N".into(),
    });
    words("psf", "PSF", true, &|own| match own.psf.form {
        PsfForm::Star => "Star".into(),
        PsfForm::Functional => "Func".into(),
    });
    type InTable = Option<(&'static str, &'static str, fn(&Published) -> f64)>;
    let mut metric = |key, label, metric: Metric, published: InTable, decimals| {
        table.column(key, label, &rows, |(place, _)| {
            measured(mean_of_24(results, *place, metric), decimals)
        });
        if let Some((key, label, value)) = published {
            table.column(key, label, &rows, |(_, (_, published))| {
                Cell::number(value(published), decimals)
            });
        }
    };
    let m_half: InTable = Some(("m_half_published", "M/2 publ.", |p| p.m_half));
    metric("m_half", "M/2", |f| f.m_half, m_half, 4);
    let sqrt_a: InTable = Some(("sqrt_a_published", "√A publ.", |p| p.sqrt_a));
    metric("sqrt_a", "√A×10⁴", |f| f.sqrt_a, sqrt_a, 4);
    let q: InTable = Some(("q_published", "Q publ.", |p| p.q));
    metric("q", "Q", |f| f.q, q, 2);
    metric("q_calibrated", "Q calibrated", |f| f.q_calibrated, None, 2);
    metric("q_dn", "Q_dn", |f| f.q_dn, None, 1);
    metric("m_cross", "m (cross)", |f| f.m_cross, None, 4);
    table.notes = vec![
        "Q calibrated: after dividing the bandpowers by (1 + m)², with m by cross-correlation with the truth; unknown if the response of a set is less than 3σ above zero.".into(),
        "Means over sets: each kind of image counts as often as among the challenge's 24 sets; absent kinds do not count.".into(),
        "Standard convention, leaderboard definition. Errors come from the part of the spectra that the truth does not explain. Published metrics refer to the challenge's images, 200 per set.".into(),
    ];
    table
}

/// Figs 8 to 11 with their data.
pub(crate) fn figures(page: &mut Page<'_>, results: &[SetScores]) -> Result<(), PageError> {
    let scores = results.first().map_or(&[][..], |set| &set.results);
    let names: Vec<&str> = scores
        .iter()
        .map(|own| own.configuration.as_str())
        .collect();
    let all: Vec<(usize, &str)> = names.iter().copied().enumerate().collect();
    let title = "Quality factor per set";
    let mut plot = metric_per_set(results, &all, |f| f.q, title, "Q");
    plot.series.extend(lines_of_means(results, &all, |f| f.q));
    page.figure(
        "fig8-q-per-set",
        &plot,
        "As Fig. 8 of the paper: quality factor per set and configuration; lines: means over the challenge's 24 sets.",
    )?;
    let [raw, denoised] = [RAW, DENOISED].map(|name| names.iter().position(|own| *own == name));
    if let (Some(raw), Some(denoised)) = (raw, denoised) {
        let both = [(raw, RAW), (denoised, DENOISED)];
        let images = results.first().map_or(0, |set| set.images);
        let caption = format!(
            "As Fig. 9 of the paper: true and measured shear power spectra of {DENOISED}. The measured spectra contain the noise of {images} images."
        );
        page.figure(
            "fig9-power-spectra",
            &power_spectra(results, denoised),
            &caption,
        )?;
        page.data("fig9-power-spectra", &spectra_table(results, denoised))?;
        // Two panels, as the paper has them.
        let panels = |title: &str, metric: Metric, label| PanelGrid {
            title: title.into(),
            columns: 2,
            plots: both
                .iter()
                // Their titles name them: a legend would have two entries of one colour.
                .map(|&(place, name)| metric_per_set(results, &[(place, "")], metric, name, label))
                .collect(),
        };
        page.figure(
            "fig10-multiplicative",
            &panels("Multiplicative bias per set", |f| f.m_half, "M/2"),
            "As Fig. 10 of the paper: multiplicative bias per set, raw and denoised.",
        )?;
        page.figure(
            "fig11-additive",
            &panels("Additive bias per set", |f| f.sqrt_a, "√A × 10⁴"),
            "As Fig. 11 of the paper: additive bias per set, raw and denoised.",
        )?;
    }
    Ok(())
}

// Figs 8, 10 and 11: a metric per set for the configurations at `places`.
fn metric_per_set(
    results: &[SetScores],
    places: &[(usize, &str)],
    metric: Metric,
    title: &str,
    y_label: &str,
) -> LinePlot {
    let series = places.iter().enumerate().map(|(k, &(place, name))| {
        let (y, errors) = of_each_set(results, place, metric).into_iter().unzip();
        // Shifted, so that points do not hide each other.
        let aside = (k as f64 - 0.5 * (places.len() as f64 - 1.0)) * 0.12;
        let x = results.iter().map(|set| f64::from(set.set) + aside);
        Series::new(name, x.collect(), y, Style::Points, k).with_errors(errors)
    });
    LinePlot {
        title: title.into(),
        x_label: "set".into(),
        x_whole: true,
        y_label: y_label.into(),
        series: series.collect(),
        ..LinePlot::default()
    }
}

// The mean over the challenge's sets of each configuration as a line over all sets, in its colour and without a place in the legend.
fn lines_of_means(results: &[SetScores], places: &[(usize, &str)], metric: Metric) -> Vec<Series> {
    let sets = results.iter().map(|set| f64::from(set.set));
    let ends = [
        sets.clone().fold(f64::INFINITY, f64::min) - 0.5,
        sets.fold(f64::NEG_INFINITY, f64::max) + 0.5,
    ];
    let lines = places.iter().enumerate().map(|(k, &(place, _))| {
        let (mean, _) = mean_of_24(results, place, metric);
        Series::new("", ends.to_vec(), vec![mean; 2], Style::Line, k)
    });
    lines.collect()
}

fn power_spectra(results: &[SetScores], place: usize) -> PanelGrid {
    let panel = |set: &SetScores| {
        let own = &set.results[place];
        let powers = [&set.l, &set.true_ee, &own.ee, &own.ee_error];
        spectrum_panel(Some(set.set), SetKind::of(set.set), powers, None)
    };
    PanelGrid {
        title: format!("Shear power spectra of {DENOISED}"),
        columns: 4,
        plots: results.iter().map(panel).collect(),
    }
}

fn spectra_table(results: &[SetScores], place: usize) -> Table {
    let rows = results.iter();
    let rows = rows.flat_map(|set| bins(&set.l).map(move |bin| (set, bin)));
    let rows: Vec<(&SetScores, usize)> = rows.collect();
    let mut table = Table::titled("Shear power spectra");
    table.column("set", "Set", &rows, |row| {
        Cell::number(f64::from(row.0.set), 0)
    });
    table.column("bin", "Bin", &rows, |row| {
        Cell::number((row.1 + 1) as f64, 0)
    });
    table.column("l", "ℓ", &rows, |&(set, bin)| Cell::number(set.l[bin], 1));
    table.column("true", "true", &rows, |&(set, bin)| {
        Cell::number(set.true_ee[bin], 9)
    });
    table.column("measured", "measured", &rows, |&(set, bin)| {
        let own = &set.results[place];
        measured((own.ee[bin], own.ee_error[bin]), 9)
    });
    table
}

/// Metrics of every set and configuration: the data of Figs 8, 10 and 11.
pub(crate) fn per_set_table(results: &[SetScores]) -> Table {
    let rows = results.iter();
    let rows = rows.flat_map(|set| set.results.iter().map(|own| (set.set, own)));
    let rows: Vec<(u32, &ConfigurationScore)> = rows.collect();
    let mut table = Table::titled("Every set and configuration");
    table.column("set", "Set", &rows, |row| Cell::number(f64::from(row.0), 0));
    table.column("kind", "Kind", &rows, |row| {
        Cell::text(SetKind::of(row.0).map_or("", |kind| kind.image.label()))
    });
    table.column("submission", "Configuration", &rows, |(_, own)| {
        Cell::text(&own.configuration)
    });
    let mut metric = |key, label, metric: Metric, decimals| {
        table.column(key, label, &rows, |(_, own)| {
            let score = &own.score;
            measured((metric(&score.metrics), metric(&score.errors)), decimals)
        });
    };
    metric("q", "Q", |f| f.q, 2);
    metric("q_dn", "Q_dn", |f| f.q_dn, 1);
    metric("m_half", "M/2", |f| f.m_half, 4);
    metric("sqrt_a", "√A×10⁴", |f| f.sqrt_a, 4);
    metric("m_cross", "m (cross)", |f| f.m_cross, 4);
    metric("q_calibrated", "Q calibrated", |f| f.q_calibrated, 2);
    metric("galaxy_noise", "Noise", |f| f.galaxy_noise, 4);
    table.column("conventions", "Conv. matched/best", &rows, |(_, own)| {
        let best = own.score.convention_leaderboard.number();
        Cell::text(format!("{}/{best}", own.convention_matched))
    });
    table.column("flagged", "Flagged", &rows, |(_, own)| {
        Cell::number(own.score.flagged as f64, 0)
    });
    table
}

#[cfg(test)]
mod tests {
    use shearq_dataset::run::claim;
    use shearq_dataset::threads::Quiet;
    use shearq_submissions::Registry;

    use super::*;

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
        let folder = root.path().join("paper");
        let plan = plan(&["23/raw/star"]);
        let claimed = claim(&folder.join("plan.json"), &plan, SCORES).unwrap();
        let place = (folder.as_path(), &claimed);
        let error = score_sets(&plan, &[2], place, 1, &mut Remover(&folder)).unwrap_err();
        let message = error.to_string();
        assert!(message.contains("removed or replaced"), "{message}");
        assert!(!folder.exists());
    }

    #[test]
    fn results_are_kept_and_read_again() {
        let root = tempfile::tempdir().unwrap();
        let plan = plan(&["23/raw/star", "23/den/star"]);
        let claimed = claim(&root.path().join("plan.json"), &plan, SCORES).unwrap();
        let place = (root.path(), &claimed);
        let first = score_sets(&plan, &[2], place, 1, &mut Quiet).unwrap();
        assert_eq!(first[0].results.len(), 2);
        assert_eq!(first[0].results[1].configuration, "23/den/star");
        let text = |results: &[SetScores]| serde_json::to_string(results).unwrap();
        let again = score_sets(&plan, &[2], place, 1, &mut Quiet).unwrap();
        assert_eq!(text(&again), text(&first));
    }

    #[test]
    fn configurations_that_differ_only_in_name_are_measured_once() {
        let mut configurations =
            plan(&["23/raw/star", "23/den/star", "23/raw/star"]).configurations;
        configurations[2].name = "mine".into();
        configurations[2].description = "The same under another name".into();
        let (kept, places) = distinct(&configurations);
        assert_eq!((kept.len(), places), (2, vec![0, 1, 0]));
    }
}
