//! `shearq check`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::Args;
use shearq_quantities::units::{Degrees, Pixels};
use shearq_scoring::Grid;

use crate::{Findings, count, print};
use shearq_files::table::MAX_ROWS;
use shearq_pipeline::data::layout::{DataFolder, Layout, read_truth_rows};
use shearq_pipeline::data::pattern::MAX_IMAGE;
use shearq_pipeline::grid;
use shearq_pipeline::truth::grid_of_set;
use shearq_results::submit::check::{Expected, Finding, Severity, check};

/// Validate a submission before it is sent: one line per problem, with the number of files that have it.
///
/// PATH is a catalogue, a power-spectrum file, or a folder or archive (.tar.gz) of either, in the
/// challenge's formats (catalogues may also be CSV, FITS or Parquet with columns x, y, e1, e2). Checked:
/// the manifest's checksums, if there is one; readability,
/// names, completeness against the grid, duplicates, rows outside or in excess, positions off the
/// cells' centres, NaN, |e| > 1, constant values, copies, missing images, bins, multipoles; and, with --data,
/// sign and axis conventions, order of rows, type of ellipticity, bias and unit of power against the true shear.
///
/// Exit code 0: no errors (perhaps warnings); 1: errors were found.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// File, folder or archive.
    path: PathBuf,
    /// Data folder whose true shear to check against.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Galaxies a side [default: that of the data's truth, or 100].
    #[arg(long, value_name = "N")]
    grid: Option<usize>,
    /// Pixels a side of a grid cell [default: that of the data's images or layout, or 48].
    #[arg(long, value_name = "PX", allow_negative_numbers = true)]
    stamp: Option<f64>,
    /// Images that every set must have [default: as many as the highest number says].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    images: Option<u32>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        path,
        data,
        grid,
        stamp,
        images,
        json,
    } = arguments;
    let data = data.as_ref().map(DataFolder::open).transpose()?;
    let sets = data
        .as_ref()
        .map_or_else(|| Ok(Vec::new()), DataFolder::sets_with_truth)?;
    // Without a truth, the images of the data have the grid.
    let first = match (&data, sets.first()) {
        (Some(data), None) => data.images(&[])?.sets().first().copied(),
        (_, first) => first.copied(),
    };
    let mut side = *grid;
    if let (None, Some(data), Some(set)) = (side, &data, first) {
        side = Some(match sets.is_empty() {
            true => grid_of_set(data, set)?.n,
            false => {
                let rows = read_truth_rows(&data.truth(set), MAX_ROWS)?.len();
                grid::side(&data.truth(set), rows)?
            }
        });
    }
    let layout = data
        .as_ref()
        .map_or_else(Layout::default, |data| data.layout().clone());
    let stamp = match (*stamp, &data, first) {
        (Some(given), ..) => given,
        (None, Some(data), Some(set)) => grid::stamp_of_set(data, set)? as f64,
        _ => layout.stamp as f64,
    };
    let grid = Grid::new(
        side.unwrap_or(100),
        Pixels(stamp),
        Degrees(layout.field_degrees),
    )?;
    let mut truth = BTreeMap::new();
    if let Some(data) = &data {
        for set in sets {
            truth.insert(set, data.read_truth(set, &grid)?);
        }
    }
    let expected = Expected {
        grid,
        truth,
        images: *images,
    };
    let findings = check(path, &expected);
    let errors = findings
        .iter()
        .filter(|f| f.severity == Severity::Error)
        .count();
    if *json {
        print(&(serde_json::to_string_pretty(&findings)? + "\n"))?;
    } else {
        for (finding, files) in problems(&findings) {
            let severity = match finding.severity {
                Severity::Error => "error",
                Severity::Warning => "warning",
            };
            let others = match files {
                1 => String::new(),
                _ => format!(" ({files} files; this is the first)"),
            };
            print(&format!(
                "{}: {severity} [{}]: {}{others}\n",
                finding.path.display(),
                finding.check,
                finding.message
            ))?;
        }
        let summary = match findings.len() {
            0 => "no findings".to_owned(),
            all => format!(
                "{} and {} found",
                count(errors, "error"),
                count(all - errors, "warning")
            ),
        };
        print(&format!("{}: {summary}\n", path.display()))?;
    }
    if errors > 0 {
        return Err(Findings.into());
    }
    Ok(())
}

/// The first finding of each problem, in order, and the number of files that have it.
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
