//! `shearq pack`.

use std::path::PathBuf;

use crate::choices::named;
use clap::Args;
use shearq_submissions::is_control;

use crate::progress::Bar;
use crate::{count, tell};
use shearq_pipeline::data::run::{Run, open_data};
use shearq_results::foreign::Foreign;
use shearq_results::submit::archive::is_archive;
use shearq_results::submit::manifest::Contents;
use shearq_results::submit::pack::{Origin, Packing};

/// Longest name of a method, in bytes: a tar header has 100 for the file names made with it.
const MAX_METHOD: usize = 64;

/// Endings of archives that are not made.
const OTHER_ARCHIVES: [&str; 7] = ["zip", "tar", "gz", "bz2", "xz", "zst", "7z"];

/// Write catalogues as the files that the challenge takes, with a manifest.
///
/// Either one ASCII catalogue per image (`g10_v1_objs_{set}_{image}.{method}.dat`), or one power
/// spectrum per set (`{method}_set{set}.dat`): of the ellipticities averaged over the images, as the
/// original scoring takes it from catalogues, or from cross-spectra between groups of images, in which
/// noise has no mean (up to twenty groups; at least two images). manifest.json lists the files with their
/// SHA-256 checksums and says what made them; of cross-spectra it has the covariances too, from eight
/// images on. The same catalogues give the same bytes, archives included. `shearq check` validates the
/// result, `shearq unpack` unpacks an archive.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Folder that `measure` or `run` wrote.
    #[arg(long, value_name = "DIR", required_unless_present = "foreign")]
    measured: Option<PathBuf>,
    /// Catalogues of another program, described in a TOML file (docs/formats.md), instead of
    /// --measured. They are packed in the signs and the type of ellipticity that are scored.
    #[arg(long, value_name = "FILE", conflicts_with = "measured")]
    foreign: Option<PathBuf>,
    /// Data folder that they were measured from, which gives the grid of spectra.
    #[arg(
        long,
        value_name = "DIR",
        requires = "foreign",
        conflicts_with = "measured"
    )]
    data: Option<PathBuf>,
    /// New folder to write to, or an archive ending in .tar.gz or .tgz.
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// Method's name in file names [default: the submission's or the program's, with `-` for `/`].
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    /// Which kind of submission.
    #[arg(long, value_parser = named::<Contents>(), default_value = "catalogues")]
    kind: Contents,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        measured,
        foreign,
        data,
        out,
        method,
        kind,
    } = arguments;
    let ending = out.extension().unwrap_or_default().to_string_lossy();
    anyhow::ensure!(
        is_archive(out) || !OTHER_ARCHIVES.contains(&ending.as_ref()),
        "--out {}: expected a folder, or an archive ending in .tar.gz or .tgz",
        out.display()
    );
    let run = measured.as_deref().map(Run::require).transpose()?;
    let foreign = foreign.as_deref().map(Foreign::read).transpose()?;
    let data = data.as_deref().map(open_data).transpose()?;
    let (origin, name) = match (measured, &run, &foreign) {
        (Some(folder), Some(run), _) => (Origin::Measured { folder, run }, &run.configuration.name),
        (_, _, Some(foreign)) => {
            let data = data.as_ref();
            (Origin::Foreign { foreign, data }, &foreign.name)
        }
        _ => anyhow::bail!("there is nothing to pack: give --measured DIR or --foreign FILE"),
    };
    let method = method.clone().unwrap_or_else(|| name.replace('/', "-"));
    anyhow::ensure!(
        (1..=MAX_METHOD).contains(&method.len())
            && !method.starts_with('.')
            && !method.contains(|c: char| "/\\:".contains(c) || c.is_whitespace() || is_control(c)),
        "the method's name is `{method}`; expected 1 to {MAX_METHOD} bytes without `/`, `\\`, `:`, blanks and a first `.`"
    );
    let packing = Packing {
        origin,
        method,
        contents: *kind,
    };
    let mut bar = Bar::new("packing", packing.galaxies()?);
    let files = packing.write(out, &mut bar)?;
    drop(bar);
    tell(format_args!(
        "{} and a manifest written to {}",
        count(files, "file"),
        out.display()
    ));
    Ok(())
}
