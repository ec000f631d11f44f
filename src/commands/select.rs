use std::path::PathBuf;

use clap::Args;

use crate::arguments::{SummaryArguments, Unsheared};

use crate::tell;
use shearq_catalogue::select::smooth_selection;
use shearq_catalogue::selected::write_selected;
use shearq_dataset::run::Run;

/// Write catalogues with cuts and weights that keep the shear calibrated.
///
/// Galaxies of linear configurations are selected and weighted by `snr`, `flux` (image units) and `size` (px), and
/// selected by `neighbour`, the light in a ring around the galaxy over its flux. Ellipticities
/// are multiplied by the weights, and responses contain how shear and noise change the selection. `score`, `mean`, `bias`, `compare`, `shear` and `pack` then use the selection. Rows of galaxies that are left out
/// stay, with ellipticity and response zero; the column `selection` has the weights.
///
/// Cuts are smooth steps, because a sharp one has no finite response. `step(snr, 10, 1.5)` is a weight of 1/2 at an S/N of 10
/// that reaches 0 and 1 at 10 ∓ 1.5; `1 - step(size, 6)` keeps small galaxies, and `and` joins steps. The default half
/// width is 1.5 in `snr`, 1.5 errors in `flux`, 0.3 px in `size` and 0.15 in `neighbour`. Wider steps give smaller errors.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder of catalogues that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR")]
    measured: PathBuf,
    /// Galaxies to keep, such as "step(snr, 10) and step(size, 2.5, 0.5)", or by columns that shear does not change, such as
    /// "x < 1280".
    #[arg(
        long = "where",
        value_name = "CONDITION",
        allow_hyphen_values = true,
        required_unless_present = "weight"
    )]
    condition: Option<String>,
    #[command(flatten)]
    unsheared: Unsheared,
    /// Weight as a formula of snr, flux and size, such as "snr^2/(snr^2 + 100)".
    #[arg(long, value_name = "FORMULA", allow_hyphen_values = true)]
    weight: Option<String>,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    summary: SummaryArguments,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (condition, weight) = (&arguments.condition, &arguments.weight);
    let run = Run::require(&arguments.measured)?;
    // Clap requires one of both options, so that there is a selection.
    let Some(selection) = smooth_selection(
        condition.as_deref(),
        weight.as_deref(),
        &arguments.unsheared.names,
    )?
    else {
        return Ok(());
    };
    let (kept, good) = write_selected(&run, &arguments.measured, &arguments.out, &selection)?;
    tell(format_args!(
        "{}: {kept} of {good} galaxies without a flag have a weight above zero",
        arguments.out.display()
    ));
    arguments
        .summary
        .print(|| serde_json::json!({ "out": arguments.out, "kept": kept, "good": good }))
}
