use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::Args;
use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::{Definition, Grid};

use crate::arguments::SummaryArguments;
use crate::{Findings, count, print, print_json, tell_unread};
use shearq_challenges::PublicChallenge;
use shearq_dataset::grid;
use shearq_dataset::layout::{DataFolder, Layout, MAX_IMAGE};
use shearq_dataset::truth::grid_of_set;
use shearq_files::table::{MAX_ROWS, read_truth};
use shearq_results::catalogues::sent_galaxies;
use shearq_results::submit::check::{Expected, ExpectedImages, Finding, Severity, check_sent};
use shearq_results::submit::{Kind, Sent};

/// Check a submission before you send it.
///
/// PATH is a catalogue, a power-spectrum file, or a folder or archive (.tar.gz) of either. Files have the challenge's
/// formats; catalogues may also be CSV, FITS or Parquet, whose columns are recognised as in `score`.
///
/// The command checks names, checksums, missing and repeated galaxies and images, positions, values, copies and
/// bins. With --data it also compares signs, axes, order of rows, type of ellipticity, bias and units with the true
/// shear. It prints one line per problem.
///
/// Exit code 0: no errors, perhaps warnings; 1: errors.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// File, folder or archive to check.
    path: PathBuf,
    /// Data folder with the true shear.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Galaxies per side of an image [default: as in the data, or as far as the positions of the first catalogue reach].
    #[arg(long, value_name = "N")]
    grid: Option<usize>,
    /// Pixels per side of a stamp [default: as in the data, or 48].
    #[arg(long, value_name = "PX", allow_hyphen_values = true)]
    stamp: Option<f64>,
    /// Number of images of every set [default: the highest number found].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    /// Check a submission file of this challenge: great3, great08.
    #[arg(long, value_name = "NAME", conflicts_with_all = ["data", "grid", "stamp", "images"])]
    challenge: Option<String>,
    /// Branch of the challenge, such as control-ground-constant.
    #[arg(long, value_name = "NAME", requires = "challenge", conflicts_with_all = ["data", "grid", "stamp", "images"])]
    branch: Option<String>,
    /// Subfields of a branch of GREAT3 that was simulated [default: 200].
    #[arg(long, value_name = "N", requires = "branch", conflicts_with_all = ["data", "grid", "stamp", "images"], value_parser = clap::value_parser!(u16).range(1..=1000))]
    subfields: Option<u16>,
    #[command(flatten)]
    summary: SummaryArguments,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let path = &arguments.path;
    if let Some(challenge) = &arguments.challenge {
        let branch = PublicChallenge::named(challenge)?.branch(arguments.branch.as_deref())?;
        let fault = branch.check(path, arguments.subfields.map(usize::from));
        let findings: Vec<Finding> = fault.err().into_iter().map(Finding::unreadable).collect();
        return report(&findings, path, arguments.summary.is_json());
    }
    let data = arguments.data.as_ref().map(DataFolder::open).transpose()?;
    let sets = data
        .as_ref()
        .map_or_else(|| Ok(Vec::new()), DataFolder::sets_with_truth)?;
    // Without a truth, the images determine the grid.
    let first = match (&data, sets.first()) {
        (Some(data), None) => data.images(&[])?.sets().first().copied(),
        (_, first) => first.copied(),
    };
    let mut side = arguments.grid;
    if let (None, Some(data), Some(set)) = (side, &data, first) {
        side = Some(match sets.is_empty() {
            true => grid_of_set(data, set)?.n,
            false => {
                let rows = read_truth(&data.truth(set), MAX_ROWS)?.height();
                grid::side(&data.truth(set), rows)?
            }
        });
    }
    let layout = data
        .as_ref()
        .map_or_else(Layout::default, |data| data.layout().clone());
    let stamp = match (arguments.stamp, &data, first) {
        (Some(given), ..) => given,
        (None, Some(data), Some(set)) => grid::stamp_of_set(data, set)? as f64,
        _ => layout.stamp as f64,
    };
    let sent = Sent::open(path);
    if let (None, Ok(sent)) = (side, &sent) {
        side = reach(sent, stamp);
    }
    let grid = Grid::new(
        side.unwrap_or(100),
        Pixels(stamp),
        Degrees(layout.field_degrees),
    )?;
    let mut truth = BTreeMap::new();
    if let Some(data) = &data {
        // An image with a misspelt name would otherwise be missing from the count without notice.
        tell_unread(data.images(&[])?.unread());
        for set in sets {
            truth.insert(set, data.read_truth(set, &grid)?);
        }
    }
    let images = match (arguments.images, &data) {
        (Some(count), _) => ExpectedImages::Each(count),
        (None, Some(data)) => {
            let images = data.images(&[])?;
            let numbers = |set| {
                images
                    .of_set(set)
                    .into_iter()
                    .map(|(image, _)| image)
                    .collect()
            };
            let sets = images.sets().into_iter();
            ExpectedImages::OfSets(sets.map(|set| (set, numbers(set))).collect())
        }
        (None, None) => ExpectedImages::Unknown,
    };
    let expected = Expected {
        grid,
        definition: Definition::Leaderboard,
        truth,
        secret_truth: BTreeMap::new(),
        images,
        sets: Vec::new(),
        partial: false,
    };
    let findings = match sent {
        Ok(sent) => check_sent(&sent, &expected, &mut |_| {}),
        Err(error) => vec![Finding::unreadable(error)],
    };
    report(&findings, path, arguments.summary.is_json())
}

// Side of the grid by the positions of the first catalogue, if at least half of its cells have a galaxy. Without data or --grid,
// the 100 of GREAT10 would make each position of a smaller challenge wrong.
fn reach(sent: &Sent, stamp: f64) -> Option<usize> {
    let files = sent.files().ok()?;
    let first = files
        .iter()
        .find(|file| !matches!(Kind::of(file), Some(Kind::Spectrum { .. })))?;
    let rows = sent_galaxies(first, MAX_ROWS).ok()?;
    let last = rows.iter().map(|(row, _)| row.x.max(row.y));
    let last = last.fold(0.0, f64::max);
    let side = ((last - 0.5) / stamp).ceil() as usize;
    // A wrong position must not enlarge the grid.
    (side >= 8 && side.checked_pow(2)? <= 2 * rows.len()).then_some(side)
}

// Fails if a finding is an error.
pub(super) fn report(findings: &[Finding], path: &Path, json: bool) -> anyhow::Result<()> {
    // Warnings alone do not make a submission wrong, so that the command succeeds with them.
    let errors = findings
        .iter()
        .filter(|f| f.severity == Severity::Error)
        .count();
    // JSON lists each file, because programs correct single files.
    if json {
        print_json(serde_json::json!({ "path": path, "errors": errors, "findings": findings }))?;
    } else {
        for (finding, files) in problems(findings) {
            let severity = match finding.severity {
                Severity::Error => "error",
                Severity::Warning => "warning",
            };
            let others = match files {
                1 => "",
                _ => &format!(" ({files} files; this is the first)"),
            };
            print(&format!(
                "{}: {severity} [{}]: {}{others}\n",
                finding.path.display(),
                finding.check,
                finding.message
            ))?;
        }
        let warnings = count(findings.len() - errors, "warning");
        let summary = match findings.len() {
            0 => "no findings".to_owned(),
            _ => format!("{} and {warnings} found", count(errors, "error")),
        };
        print(&format!("{}: {summary}\n", path.display()))?;
    }
    match errors {
        0 => Ok(()),
        _ => Err(Findings.into()),
    }
}

// The first finding of each problem and the number of files that have it: a wrong sign is found in each of 200 images.
fn problems(findings: &[Finding]) -> Vec<(&Finding, usize)> {
    let mut problems: Vec<(&Finding, BTreeSet<&Path>)> = Vec::new();
    for finding in findings {
        let same = |(first, _): &&mut (&Finding, BTreeSet<&Path>)| {
            first.check == finding.check && first.severity == finding.severity
        };
        match problems.iter_mut().find(same) {
            Some((_, files)) => _ = files.insert(&finding.path),
            None => problems.push((finding, BTreeSet::from([finding.path.as_path()]))),
        }
    }
    problems
        .into_iter()
        .map(|(finding, files)| (finding, files.len()))
        .collect()
}
