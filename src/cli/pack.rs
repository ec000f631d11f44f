//! `shearq pack`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use shearq_scoring::Grid;
use shearq_scoring::units::{Degrees, Pixels};

use crate::io::layout::MAX_SET;
use crate::io::run::Run;
use crate::io::table;
use crate::pipeline::score::grid_side;
use crate::submit::challenge::{Kind, write_catalogue, write_spectrum};

/// Write measured catalogues as the files that the challenge takes.
///
/// Either one ASCII catalogue per image (`g10_v1_objs_{set}_{image}.{method}.dat`), or one power
/// spectrum per set (`{method}_set{set}.dat`). `shearq check` validates the result.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folder that `measure` wrote.
    #[arg(long, value_name = "DIR")]
    measured: PathBuf,
    /// Folder to write to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Method's name in file names [default: the submission's, with `-` for `/`].
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    /// Which kind of submission.
    #[arg(long, value_enum, default_value_t)]
    kind: KindArgument,
}

#[derive(Debug, Clone, Copy, Default, ValueEnum)]
enum KindArgument {
    /// Ellipticity catalogues.
    #[default]
    Catalogues,
    /// Shear power spectra.
    Spectra,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        measured,
        out,
        method,
        kind,
    } = arguments;
    let run = Run::require(measured)?;
    let layout = run.source.layout();
    let method = method
        .clone()
        .unwrap_or_else(|| run.submission.name.replace('/', "-"));
    anyhow::ensure!(
        !method.is_empty()
            && !method.contains(|c: char| "/\\".contains(c) || c.is_whitespace() || c.is_control()),
        "the method's name is `{method}`; expected one without `/`, `\\` and blanks"
    );
    let mut files = 0;
    for set in 1..=MAX_SET {
        let catalogues = run.catalogues(measured, set);
        if catalogues.is_empty() {
            continue;
        }
        match kind {
            KindArgument::Catalogues => {
                for (image, path) in catalogues {
                    let kind = Kind::Catalogue {
                        set,
                        image,
                        method: method.clone(),
                    };
                    write_catalogue(&path, &out.join(kind.file_name()))?;
                    files += 1;
                }
            }
            KindArgument::Spectra => {
                // A catalogue has a row for every cell, measured or not.
                let cells = table::read(&catalogues[0].1, Some(&["x"]))?.rows();
                let grid = Grid::new(
                    grid_side(&catalogues[0].1, cells)?,
                    Pixels(layout.stamp as f64),
                    Degrees(layout.field_degrees),
                )?;
                let paths: Vec<PathBuf> = catalogues.into_iter().map(|(_, path)| path).collect();
                let kind = Kind::Spectrum {
                    set,
                    method: method.clone(),
                };
                write_spectrum(&grid, &paths, &out.join(kind.file_name()))?;
                files += 1;
            }
        }
    }
    anyhow::ensure!(
        files > 0,
        "{}: there is no catalogue here to pack",
        measured.display()
    );
    eprintln!("{files} files written to {}", out.display());
    Ok(())
}
