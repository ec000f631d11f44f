//! `shearq mean`.

use std::path::PathBuf;

use clap::Args;
use shearq_submissions::{Calibration, EllipticityType};

use super::arguments::{Form, SetList, Threads};
use crate::io::run::{Run, Source};
use crate::pipeline::inputs;
use crate::report::table::{Cell, Heading, Table};
use crate::results::mean::mean_shears;
use crate::results::score::without_catalogue;

/// Mean ellipticity of each set: the shear, where a set has one shear.
///
/// The ellipticities are those of the catalogues, divided by their response where the submission does so. Each
/// galaxy with an ellipticity counts alike, flagged ones have none. The error is the scatter over the root of their number, which holds
/// for galaxies that are independent of one another; of pairs turned by 90 degrees it is too large.
#[derive(Debug, Args)]
pub(super) struct Arguments {
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

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        measured,
        sets,
        form,
        threads,
    } = arguments;
    let run = Run::require(measured)?;
    let sets = sets.as_ref().map_or(&[][..], |list| &list.0);
    // The data need not be there any more.
    let data = match &run.source {
        Source::Folder { .. } => run.source.data(measured).ok(),
        Source::Simulated(_) => None,
    };
    if let Some(data) = &data {
        inputs::verify(data, measured, &run, sets, threads.number())?;
    }
    let means = mean_shears(&run, measured, sets)?;
    let headings = [
        ("set", "Set"),
        ("galaxies", "Galaxies"),
        ("flagged", "Flagged"),
        ("g1", "g1"),
        ("g2", "g2"),
        ("scatter1", "σ(e1)"),
        ("scatter2", "σ(e2)"),
    ];
    let rows = means.iter().map(|mean| {
        vec![
            Cell::number(f64::from(mean.set), 0),
            Cell::number(mean.galaxies as f64, 0),
            Cell::number(mean.flagged as f64, 0),
            Cell::with_error(mean.mean[0], Some(mean.error[0]), 5),
            Cell::with_error(mean.mean[1], Some(mean.error[1]), 5),
            Cell::number(mean.scatter[0], 4),
            Cell::number(mean.scatter[1], 4),
        ]
    });
    let submission = &run.submission;
    let mut notes = vec![format!(
        "Mean ellipticities of {} by {}, g2 along the diagonal of the pixels.",
        measured.display(),
        submission.name
    )];
    if submission.calibration() == Calibration::None {
        notes.push(
            "This submission does not divide by the response to shear: these are no shears.".into(),
        );
    } else if submission.ellipticity() == EllipticityType::Distortion {
        notes.push("Of distortions, divided by their response to shear.".into());
    }
    if let Some(data) = &data {
        let used = means.iter().map(|mean| (mean.set, mean.images.as_slice()));
        notes.extend(without_catalogue(data, &used.collect(), sets)?);
    }
    form.print(&Table {
        title: "Mean shear".into(),
        headings: headings
            .iter()
            .map(|(key, label)| Heading::new(key, *label))
            .collect(),
        rows: rows.collect(),
        notes,
    })
}
