//! `shearq mean`.

use std::path::PathBuf;

use clap::Args;

use crate::arguments::{Form, SetList, Threads};
use crate::tell;
use shearq_pipeline::data::run::{Run, Source};
use shearq_pipeline::inputs;
use shearq_results::mean::mean_shears;
use shearq_results::score::without_catalogue;
use shearq_results::views::mean::mean_table;

/// Mean shear of each set, for fields of constant shear.
///
/// The mean shear is the mean ellipticity of all galaxies without a flag, divided by the mean response if the
/// configuration does so. The error includes the error of the mean response. It assumes independent galaxies: for pairs
/// that are rotated by 90 degrees it is too large.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder of catalogues that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR")]
    measured: PathBuf,
    /// Sets [default: all there are].
    #[arg(long, value_name = "LIST")]
    sets: Option<SetList>,
    #[command(flatten)]
    form: Form,
    #[command(flatten)]
    threads: Threads,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        measured,
        sets,
        form,
        threads,
    } = arguments;
    let run = Run::require(measured)?;
    let sets = sets.as_ref().map_or(&[][..], |list| &list.0);
    // The data may have been removed since.
    let data = match &run.source {
        Source::Folder { .. } => run.source.data(measured).ok(),
        Source::Simulated(_) => None,
    };
    if let Some(data) = &data {
        inputs::verify(data, measured, &run, sets, threads.number())?;
    }
    let means = mean_shears(&run, measured, sets)?;
    for mean in &means {
        let set = mean.set;
        if let Some(flagged) = mean.mostly_flagged() {
            anyhow::ensure!(mean.galaxies > 0, "set {set:02}: {flagged}");
            tell(format_args!("warning: set {set:02}: {flagged}"));
        }
        if mean.is_constant() {
            tell(format_args!(
                "warning: set {set:02}: all {} galaxies have the same ellipticity (found a scatter of 0, expected noise), so the error is meaningless. Try: check the stamps for copies",
                mean.galaxies
            ));
        }
    }
    let name = measured.display().to_string();
    let mut table = mean_table(&means, &run.configuration, &name);
    if let Some(data) = &data {
        let used = means.iter().map(|mean| (mean.set, mean.images.as_slice()));
        table
            .notes
            .extend(without_catalogue(data, &used.collect(), sets)?);
    }
    form.print(&table)
}
