use std::path::PathBuf;

use clap::Args;

use crate::arguments::{Form, SetList, Threads, Unsheared, sets_of};
use crate::tell;
use shearq_catalogue::select::smooth_selection;
use shearq_dataset::fingerprint;
use shearq_dataset::metadata::Axes;
use shearq_dataset::run::Run;
use shearq_measure::{PixelFrame, Warning};
use shearq_render::table::TableFormat;
use shearq_results::mean::mean_shears;
use shearq_results::score::without_catalogue;
use shearq_results::views::mean::mean_table;

/// Mean shear of each set, for fields of constant shear.
///
/// The mean shear is the mean ellipticity of all galaxies without a flag, divided by their mean response if
/// the configuration does so. The error includes the error of the mean response, and the noise of one star per image. It
/// assumes independent galaxies, apart from branches of GREAT3 with constant shear: their galaxies are pairs that are rotated by
/// 90 degrees, so that the error is that of the noise of pixels alone.
///
/// --where and --weight select and weight galaxies of linear configurations by `snr`, `flux` (image units) and `size` (px), and
/// select by `neighbour`, the light in a ring around the galaxy over its flux.
/// The mean stays calibrated: the response contains how shear and noise change the selection.
///
/// Cuts are smooth steps, because a sharp one has no finite response. `step(snr, 10, 1.5)` is a weight of 1/2 at an S/N of 10
/// that reaches 0 and 1 at 10 ∓ 1.5; `1 - step(size, 6)` keeps small galaxies, and `and` joins steps. The default half
/// width is 1.5 in `snr`, 1.5 errors in `flux`, 0.3 px in `size` and 0.15 in `neighbour`. Wider steps give smaller errors.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder of catalogues that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR")]
    measured: PathBuf,
    /// Sets [default: all there are].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    /// Galaxies to keep, such as "step(snr, 10) and step(size, 2.5, 0.5)", or by columns that shear does not change, such as
    /// "x < 1280".
    #[arg(long = "where", value_name = "CONDITION", allow_hyphen_values = true)]
    condition: Option<String>,
    #[command(flatten)]
    unsheared: Unsheared,
    /// Weight as a formula of snr, flux and size, such as "snr^2/(snr^2 + 100)".
    #[arg(long, value_name = "FORMULA", allow_hyphen_values = true)]
    weight: Option<String>,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let (measured, sets) = (&arguments.measured, sets_of(arguments.sets.as_ref()));
    let (condition, weight) = (&arguments.condition, &arguments.weight);
    let selection = smooth_selection(
        condition.as_deref(),
        weight.as_deref(),
        &arguments.unsheared.names,
    )?;
    let run = Run::require(measured)?;
    let data = fingerprint::verify_source(measured, &run, sets, arguments.threads.number())?;
    let means = mean_shears(&run, measured, sets, selection.as_ref())?;
    for mean in &means {
        let set = mean.set;
        anyhow::ensure!(
            mean.galaxies > 0 || mean.cut == 0,
            "set {set:02}: the selection leaves none of {} galaxies (expected some). Try: a lower threshold",
            mean.cut
        );
        anyhow::ensure!(
            mean.shear.is_some() || mean.galaxies == 0,
            "set {set:02}: the mean response of {} galaxies is not positive, so there is no mean shear. Try: more galaxies, or a lower threshold",
            mean.galaxies
        );
        if let Some(flagged) = mean.mostly_flagged() {
            anyhow::ensure!(mean.galaxies > 0, "set {set:02}: {flagged}");
            tell(format_args!("warning: set {set:02}: {flagged}"));
        }
        // The pixel axes are rotated, mirrored or sheared against the sky, and the printed shear is along them.
        if let Axes::Oriented(frame) = mean.axes
            && frame != PixelFrame::default()
        {
            let warning = Warning::PixelFrame(frame);
            tell(format_args!("warning: set {set:02}: {warning}"));
        }
        if mean.above_one > 0 {
            tell(format_args!(
                "warning: set {set:02}: {} of {} galaxies have |e| of 1 or more, and count in the mean (expected 0). Try: check the catalogues, or measure again with a larger shape.half_snr",
                mean.above_one, mean.galaxies
            ));
        }
        // An error of zero would look like a perfect measurement.
        if mean.is_constant() {
            tell(format_args!(
                "warning: set {set:02}: all {} galaxies have the same ellipticity (found a scatter of 0, expected noise), so the error is meaningless. Try: check the stamps for copies",
                mean.galaxies
            ));
        } else if mean.repeated > 0 {
            tell(format_args!(
                "warning: set {set:02}: {} of {} galaxies have the ellipticity of an earlier one of their image; expected measured values, which do not repeat. Try: each galaxy once, and a flag for those that were not measured",
                mean.repeated, mean.galaxies
            ));
        }
    }
    let name = measured.display().to_string();
    let mut table = mean_table(&means, &run.configuration, &name);
    if let Some(text) = &run.selection {
        table
            .notes
            .push(format!("The catalogues have the selection `{text}`."));
    }
    for (name, text) in [("where", condition), ("weight", weight)] {
        let note = text
            .iter()
            .map(|text| format!("Galaxies of --{name} \"{text}\"."));
        table.notes.extend(note);
    }
    // Of epochs, one image of a set has a catalogue.
    if let Some(data) = data.as_ref().filter(|_| !run.epochs) {
        let used = means.iter().map(|mean| (mean.set, mean.images.as_slice()));
        // A mean over fewer images than the data have is valid, but the reader must know.
        let without = without_catalogue(data, &used.collect(), sets)?;
        table.notes.extend(without);
    }
    if !matches!(arguments.form.format, TableFormat::Csv | TableFormat::Json) {
        // Machine-readable formats keep every column, because a missing one breaks the program that reads them.
        table = table.narrow();
    }
    arguments.form.print(&table)
}
