//! `shearq check`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;
use shearq_scoring::Grid;
use shearq_scoring::units::{Degrees, Pixels};

use super::{Findings, count, print};
use crate::io::layout::{DataFolder, Layout, MAX_IMAGE, read_truth_rows};
use crate::io::table::MAX_ROWS;
use crate::pipeline::grid;
use crate::submit::check::{Expected, Severity, check};

/// Validate a submission before it is sent: one line per finding.
///
/// PATH is a catalogue, a power-spectrum file, or a folder or archive (.tar.gz) of either, in the
/// challenge's formats (catalogues may also be CSV, FITS or Parquet with columns x, y, e1, e2). Checked:
/// the manifest's checksums, if there is one; readability,
/// names, completeness against the grid, duplicates, rows outside or in excess, positions off the
/// cells' centres, NaN, |e| > 1, constant values, missing images, bins, multipoles; and, with --data,
/// sign and axis conventions, type of ellipticity and unit of power against the true shear.
///
/// Exit code 0: no errors (perhaps warnings); 1: errors were found.
#[derive(Debug, Args)]
pub(super) struct Arguments {
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

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
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
    let mut side = *grid;
    if let (None, Some(data), Some(&set)) = (side, &data, sets.first()) {
        let rows = read_truth_rows(&data.truth(set), MAX_ROWS)?.len();
        side = Some(grid::side(&data.truth(set), rows)?);
    }
    let layout = data
        .as_ref()
        .map_or_else(Layout::default, |data| data.layout().clone());
    let stamp = match (*stamp, &data, sets.first()) {
        (Some(given), ..) => given,
        (None, Some(data), Some(&set)) => grid::stamp_of_set(data, set)? as f64,
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
        for finding in &findings {
            let severity = match finding.severity {
                Severity::Error => "error",
                Severity::Warning => "warning",
            };
            print(&format!(
                "{}: {severity} [{}]: {}\n",
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
