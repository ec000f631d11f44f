use std::path::PathBuf;

use clap::Args;

use crate::arguments::{Form, named};
use crate::tell;
use shearq_files::table::{self, FileFormat};
use shearq_render::table::{Cell, Table};
use shearq_results::response::{Position, Shared, shears};

/// Write a shear for each galaxy of a survey.
///
/// Catalogues contain ellipticities e before the division by the response R to shear, because the response of one galaxy, or
/// of an image with few, is noisy. `shear` writes g = ⟨R⟩⁻¹ e with the mean 2 × 2 response of all catalogues, so that the mean of
/// g1 and g2, weighted by w, over any galaxies that are chosen by position is a shear. Galaxies that are chosen by a measured quantity need
/// `select` first. The table has `id`, positions and carried columns of the catalogues, set, image, g1, g2, w and flags; its
/// metadata contain the response with its error.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folders of catalogues that `measure`, `run` or `select` wrote.
    #[arg(long, value_name = "DIR", required = true, num_args = 1..)]
    measured: Vec<PathBuf>,
    /// Galaxies that share a mean response. The response of an image of 40 galaxies at S/N 10 biases m by 0.002.
    #[arg(long, value_name = "OF", default_value = "survey", value_parser = named::<Shared>())]
    response: Shared,
    /// Write only what TreeCorr reads: these positions, g1, g2 and w of galaxies with a shear.
    #[arg(long, value_name = "COLUMNS", num_args = 0..=1, default_missing_value = "ra,dec", value_parser = named::<Position>())]
    treecorr: Option<Position>,
    /// File to write, .fits or .parquet.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    form: Form,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let out = &arguments.out;
    let ending = out.extension().unwrap_or_default().to_string_lossy();
    let format = match ending.as_ref() {
        "fits" => FileFormat::Fits,
        "parquet" => FileFormat::Parquet,
        _ => anyhow::bail!(
            "--out {}: unknown kind of file (found `{ending}`, expected .fits or .parquet)",
            out.display()
        ),
    };
    let found = shears(
        &arguments.measured,
        &[],
        arguments.response,
        arguments.treecorr,
    )?;
    table::write(out, format, &found.table, &found.metadata)?;
    tell(format_args!(
        "{}: {} galaxies, {} with a shear",
        out.display(),
        found.table.height(),
        found.good
    ));
    let mut table = Table::titled("Mean response to shear");
    let rows = &found.responses;
    table.column("of", "Of", rows, |own| Cell::text(&own.of));
    table.column("galaxies", "Galaxies", rows, |own| {
        Cell::number(own.galaxies as f64, 0)
    });
    for (k, name) in ["R11", "R22", "R12", "R21"].into_iter().enumerate() {
        table.column(name, name, rows, |own| {
            Cell::with_error(own.mean[k], Some(own.error[k]), 5)
        });
    }
    // TreeCorr has no default names of columns, so that the table states the call that reads it.
    if let Some(position) = arguments.treecorr {
        let [first, second, units] = match position {
            Position::Sky => ["ra", "dec", ", ra_units='deg', dec_units='deg'"],
            Position::Pixel => ["x", "y", ""],
        };
        table.notes.push(format!(
            "treecorr.Catalog({:?}, {first}_col='{first}', {second}_col='{second}'{units}, g1_col='g1', g2_col='g2', w_col='w')",
            out.display().to_string()
        ));
    }
    arguments.form.print(&table)
}
