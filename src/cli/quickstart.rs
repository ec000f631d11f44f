//! `shearq quickstart`.

use std::path::{Path, PathBuf};

use clap::Args;
use shearq_scoring::Options;
use shearq_submissions::Registry;

use super::arguments::{ScoreSettings, Threads};
use super::progress::{Bar, goes_on};
use super::{measure, print, print_table, tell, width};
use crate::io::layout::DataFolder;
use crate::io::run::{Run, Source};
use crate::io::table::FileFormat;
use crate::pipeline::images;
use crate::pipeline::simulate::{SimulationRecord, simulate_folder};
use crate::report::comparison::{compare, q_heat_map};
use crate::report::html::Block;
use crate::report::pages;
use crate::report::scores::per_set;
use crate::report::table::Cell;
use crate::report::terminal::wrapped;
use crate::results::compare::{Paired, by_name, difference, mean_figure, score_all};
use crate::results::row::SetRecord;
use crate::results::score::{OWN, score_folder};
use crate::simulate::set::SimulationSettings;

/// The whole chain on a small simulated default: simulate, measure with three submissions, score,
/// compare. Takes well under two minutes.
///
/// It runs what these commands would: `simulate --sets 2,8 --images 10 --grid 60 --seed 2013`, then
/// `measure` and `score --convention 5` with 23/raw/star, 23/den/star and 48/linear/star, then
/// `compare --convention 5`, and writes report.html. The data are simulated,
/// and few: the errors printed are what tells whether a difference is one.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folder to write to.
    #[arg(long, value_name = "DIR", default_value = "shearq-quickstart")]
    out: PathBuf,
    #[command(flatten)]
    threads: Threads,
}

const SETS: [u32; 2] = [2, 8];
const IMAGES: u32 = 10;
const GRID: usize = 60;
const SEED: u64 = 2013;
const SUBMISSIONS: [&str; 3] = ["23/raw/star", "23/den/star", "48/linear/star"];

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    goes_on();
    let Arguments { out, threads } = arguments;
    let threads = threads.number();
    let data = DataFolder::new(out.join("data"));
    let record = SimulationRecord {
        version: crate::VERSION.into(),
        settings: SimulationSettings::new(SEED, GRID),
    };
    let galaxies = (SETS.len() * IMAGES as usize * GRID * GRID) as u64;
    let mut bar = Bar::new("simulating", galaxies);
    let images = images::of_simulation(&SETS, IMAGES);
    simulate_folder(&record, &images, &data, threads, &mut bar)?;
    drop(bar);
    tell(format_args!(
        "simulated sets {SETS:?}, {IMAGES} images of {GRID} × {GRID} galaxies each, in {}",
        data.root().display()
    ));
    let registry = Registry::embedded()?;
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let (mut folders, mut sections) = (Vec::new(), Vec::new());
    let mut made_by = vec![(
        "Simulation".to_owned(),
        serde_json::to_string(&record.settings)?,
    )];
    for name in SUBMISSIONS {
        let folder = out.join(name.replace('/', "-"));
        let submission = registry.get(name)?.submission;
        let run = Run::new(
            Source::folder(&data, &folder)?,
            submission,
            FileFormat::default(),
        );
        measure::measure(&run, &data, &folder, &images, threads)?;
        let scored = score_folder(&data, &folder, &run, &[], options, threads)?;
        let title = format!("Scores of {name} (simulated data)");
        let table = per_set(&scored, &title, options.definition);
        print_table(&table.narrow())?;
        print("\n")?;
        sections.push(pages::scores(name, &scored, table)?);
        made_by.push((name.to_owned(), toml::to_string(&run.submission)?));
        folders.push(folder);
    }
    let way = ScoreSettings::default().way();
    let variants = score_all(&folders, &[], None, way, threads)?;
    let table = compare(&variants, options.definition);
    print_table(&table.narrow())?;
    let records = by_name(&variants);
    let verdict = verdict(&records);
    print(&format!("\n{}", wrapped(&verdict, Some(width()))))?;
    let mut comparison = pages::comparison(table, &q_heat_map(&records))?;
    comparison.blocks.insert(0, Block::Text(verdict));
    sections.insert(0, comparison);
    let report = out.join("report.html");
    pages::save(&report, "Quickstart (simulated data)", sections, made_by)?;
    tell(format_args!(
        "\nreport in {}\nNext: {}",
        report.display(),
        next_step(out)
    ));
    Ok(())
}

/// Significance from which one submission is said to be better than another.
const CLEAR: f64 = 3.0;

/// Which submission to use, and the figures that say so.
fn verdict(submissions: &[(String, Vec<SetRecord>)]) -> String {
    let mean = |sets: &[SetRecord], name: &str| mean_figure(sets, name).0;
    let calibrated = |sets: &[SetRecord]| mean(sets, "q_calibrated");
    let known = submissions
        .iter()
        .filter(|(_, sets)| calibrated(sets).is_finite());
    let best = known.max_by(|a, b| calibrated(&a.1).total_cmp(&calibrated(&b.1)));
    let Some((name, sets)) = best else {
        return "So few data tell no submission from another.".into();
    };
    let shown = |sets: &[SetRecord], name: &str, decimals: usize| {
        let (value, error) = mean_figure(sets, name);
        Cell::with_error(value, Some(error), decimals).in_words()
    };
    let rivals = || submissions.iter().filter(|(other, _)| other != name);
    let behind = |others: &[SetRecord]| difference(Paired::Calibrated, others, sets);
    let others: Vec<String> = rivals()
        .map(|(other, others)| {
            let behind = behind(others).map_or(String::new(), |d| {
                let lower = Cell::with_error(d.difference, Some(d.error), 1);
                format!(", lower by {}", lower.in_words())
            });
            format!(
                "{other} has m = {} and Q calibrated = {}{behind}",
                shown(others, "m_cross", 2),
                shown(others, "q_calibrated", 1)
            )
        })
        .collect();
    // Neither is one told from another that has no calibrated Q.
    let untold: Vec<&str> = rivals()
        .filter(|(_, others)| !behind(others).is_some_and(|d| d.sigma() >= CLEAR))
        .map(|(other, _)| other.as_str())
        .collect();
    let lead = match untold.is_empty() {
        true => format!("Use {name}"),
        false => format!(
            "{name} has the highest Q calibrated, which these images do not tell from that of {}",
            untold.join(" and ")
        ),
    };
    // Where images are few, Q itself can rank otherwise.
    let raised = submissions
        .iter()
        .filter(|(_, others)| mean(others, "q") > mean(sets, "q") && mean(others, "m_cross") < 0.0)
        .map(|(other, _)| other.as_str())
        .collect::<Vec<_>>();
    let warning = match raised.is_empty() {
        true => String::new(),
        false => format!(
            " Q itself is higher for {}, which lose shear and noise alike (m below zero): real analyses cannot use that.",
            raised.join(" and ")
        ),
    };
    let noise: Vec<String> = sets
        .iter()
        .map(|set| {
            let noise = Some(set.errors.galaxy_noise);
            let noise = Cell::with_error(set.figures.galaxy_noise, noise, 3).in_words();
            format!("{noise} in set {}", set.set)
        })
        .collect();
    format!(
        "{lead}: m = {}, noise of a galaxy once calibrated {}, and Q calibrated = {}; {}.{warning}",
        shown(sets, "m_cross", 2),
        noise.join(" and "),
        shown(sets, "q_calibrated", 1),
        others.join("; ")
    )
}

fn next_step(out: &Path) -> String {
    format!(
        "shearq show --submission 48/linear/star --data {} --galaxy 8/1/1 --out galaxy.png",
        out.join("data").display()
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_scoring::Figures;

    /// A submission with one set of eight images, whose calibrated Q is that of `replicates` without any.
    fn submission(
        name: &str,
        q: f64,
        calibrated: f64,
        replicates: [f64; 8],
    ) -> (String, Vec<SetRecord>) {
        let with = |q, q_calibrated, m_cross| Figures {
            q,
            q_calibrated,
            m_cross,
            ..Figures::unknown()
        };
        let record = SetRecord {
            set: 2,
            simulated: true,
            data: String::new(),
            images: (1..=8).collect(),
            galaxies: 8,
            flagged: 0,
            figures: with(q, calibrated, -0.3),
            errors: with(0.1, 2.0, 0.01),
            q_replicates: vec![q; 8],
            q_calibrated_replicates: replicates.map(|off| calibrated + off).to_vec(),
            q_leaderboard: q,
            convention: 5,
            convention_known: true,
            convention_leaderboard: 5,
        };
        (name.into(), vec![record])
    }

    #[test]
    fn a_submission_is_named_where_its_images_tell_it_from_the_others() {
        let common = [0.5, -0.5, 0.5, -0.5, 0.5, -0.5, 0.5, -0.5];
        let own = [0.7, -0.7, 0.3, -0.3, 0.7, -0.7, 0.3, -0.3];
        let better = submission("b", 10.0, 25.0, own);
        // The noise that both have in common takes their errors of 2 down to √(7/8 · Σ 0.2²) = 0.53.
        let told = verdict(&[submission("a", 12.0, 20.0, common), better.clone()]);
        assert!(told.starts_with("Use b: m = -0.300 ± 0.010"), "{told}");
        assert!(
            told.contains("Q calibrated = 20.0 ± 2.0, lower by 5.00 ± 0.53"),
            "{told}"
        );
        assert!(
            told.contains("Q itself is higher for a, which lose shear"),
            "{told}"
        );
        let untold = verdict(&[submission("a", 9.0, 24.0, common), better.clone()]);
        let start =
            "b has the highest Q calibrated, which these images do not tell from that of a: m";
        assert!(
            untold.starts_with(start) && !untold.contains("itself"),
            "{untold}"
        );
        let unknown = verdict(&[submission("a", 9.0, f64::NAN, common), better]);
        assert!(unknown.contains("do not tell from that of a"), "{unknown}");
        assert!(
            unknown.contains("a has m = -0.300 ± 0.010 and Q calibrated = unknown"),
            "{unknown}"
        );
        let none = verdict(&[submission("a", 9.0, f64::NAN, common)]);
        assert!(none.starts_with("So few data"), "{none}");
    }
}
