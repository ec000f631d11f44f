use std::path::{Path, PathBuf};

use clap::{Arg, Args};

use crate::arguments::{Form, SetList, TableReading, Threads, Unsheared, listed, sets_of};
use crate::origin::remember_columns;
use crate::progress::reading;
use crate::tell;
use shearq_catalogue::request::Request;
use shearq_catalogue::roles::Role;
use shearq_catalogue::select::{selection, smooth_selection};
use shearq_catalogue::truth::{Truth, expand};
use shearq_dataset::fingerprint;
use shearq_dataset::metadata::Axes;
use shearq_dataset::run::Run;
use shearq_measure::{PixelFrame, Warning};
use shearq_render::table::TableFormat;
use shearq_results::bias::sum_with_progress;
use shearq_results::mean::mean_shears;
use shearq_results::score::without_catalogue;
use shearq_results::views::bias::{chosen_by_measurement, mean_shear_table};
use shearq_results::views::mean::mean_table;

/// Mean shear of each set, for fields of constant shear, or of catalogues of any program.
///
/// With --measured, the mean shear is the mean ellipticity of all galaxies without a flag, divided by their mean response if
/// the configuration has a response. The error includes the error of the mean response, and the noise of one star per image. It
/// assumes independent galaxies, apart from branches of GREAT3 with constant shear: their galaxies are pairs that are rotated by
/// 90 degrees, so that the error is that of the noise of pixels alone.
///
/// With CATALOGUE, the tables and the options of their columns are those of `bias`, and all rows make one mean: g = ⟨R⟩⁻¹⟨e⟩, with
/// responses of columns or of the sheared catalogues of metacal and metadetect. Errors are from a jackknife over units.
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
    /// Catalogues of any program, all with the same columns. FILE[TABLE] is one table of a FITS file.
    #[arg(
        value_name = "CATALOGUE",
        required_unless_present = "measured",
        conflicts_with_all = ["measured", "sets"]
    )]
    catalogues: Vec<PathBuf>,
    /// Folder of catalogues that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR", conflicts_with = "TableReading")]
    measured: Option<PathBuf>,
    /// Sets [default: all there are].
    #[arg(long, value_name = "LIST", conflicts_with = "TableReading")]
    sets: Option<SetList>,
    /// Galaxies to keep, such as "step(snr, 10) and step(size, 2.5, 0.5)", or by columns that shear does not change, such as
    /// "x < 1280".
    #[arg(long = "where", value_name = "CONDITION", allow_hyphen_values = true)]
    condition: Option<String>,
    #[command(flatten)]
    reading: TableReading,
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

/// An argument that other commands share, and that tables have no use for.
pub(crate) fn of_folders(argument: Arg) -> Arg {
    argument.conflicts_with_all(["catalogues", "TableReading"])
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.measured {
        Some(folder) => of_folder(arguments, folder),
        None => of_tables(arguments),
    }
}

fn of_tables(arguments: &Arguments) -> anyhow::Result<()> {
    let catalogues = listed(&arguments.catalogues)?;
    for path in &catalogues {
        anyhow::ensure!(
            !(path.is_dir() && Run::read(path)?.is_some()),
            "{0}: this is a folder that `measure` or `run` wrote (expected tables). Try: shearq mean --measured {0}",
            path.display()
        );
    }
    let found = expand(&catalogues, Truth::Columns)?;
    let mut request = Request {
        selection: selection(arguments.condition.as_deref(), arguments.weight.as_deref())?,
        ..arguments.reading.request(found)?
    };
    // With the ellipticity of the PSF, the estimate is the shear at a round PSF.
    request
        .names
        .decline(&[Role::G1, Role::G2, Role::Psf1, Role::Psf2, Role::PsfSize]);
    let summed = sum_with_progress(&request, &|_| true, &reading)?;
    remember_columns(summed.columns());
    let result = summed.result()?;
    if let Some(warning) = chosen_by_measurement(&result) {
        tell(format_args!("warning: {warning}"));
    }
    arguments.form.print(&mean_shear_table(&result)?)
}

fn of_folder(arguments: &Arguments, measured: &Path) -> anyhow::Result<()> {
    anyhow::ensure!(
        !measured.is_file(),
        "--measured: {0} is a file (expected a folder of catalogues that `measure` or `run` wrote). Try: shearq mean {0}",
        measured.display()
    );
    let sets = sets_of(arguments.sets.as_ref());
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
