//! `shearq gather`.

use std::path::PathBuf;

use clap::Args;

use super::{count, tell};
use crate::io::layout::{DataFolder, MAX_IMAGE, MAX_SET};
use crate::pipeline::gather::{Gathered, Stamps, gather};
use crate::pipeline::images::ImageId;

/// Gather stamps of your own into a data folder that `measure` takes.
///
/// The sky has to be subtracted. Stamps come as FITS files of one stamp, a cube, or several extensions each, or are cut out of an exposure around
/// positions; those that reach beyond it are flagged when they are measured. The PSF is one star stamp for all, one
/// for each galaxy in the same order, or a table of functional PSFs (x,y,profile,beta,fwhm,e1,e2; docs/formats.md),
/// of which the positions do not matter. Beside the image a table tells which stamp is which, in the order of the
/// catalogues.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// FITS files of stamps, in the order of the galaxies.
    #[arg(long, value_name = "FILE", num_args = 1.., required_unless_present = "exposure", conflicts_with = "exposure")]
    stamps: Vec<PathBuf>,
    /// Image to cut stamps out of: the first of its file.
    #[arg(long, value_name = "FILE", requires = "positions")]
    exposure: Option<PathBuf>,
    /// Table of the galaxies' positions on the exposure: text, FITS or Parquet, in FITS pixels (the centre of the
    /// first is at 1).
    #[arg(long, value_name = "FILE", requires = "exposure")]
    positions: Option<PathBuf>,
    /// Columns of the positions.
    #[arg(
        long,
        value_name = "X,Y",
        value_delimiter = ',',
        num_args = 1,
        default_value = "x,y",
        requires = "exposure"
    )]
    columns: Vec<String>,
    /// Pixels a side of a stamp that is cut out.
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = clap::value_parser!(u16).range(5..=1024), requires = "exposure")]
    size: u16,
    /// FITS files of PSF stamps, or one table of functional PSFs (.csv).
    #[arg(long, value_name = "FILE", num_args = 1.., required = true)]
    psf: Vec<PathBuf>,
    /// Standard deviation of the noise of a pixel, where a submission is to take it from the header.
    #[arg(long, value_name = "SIGMA")]
    noise: Option<f64>,
    /// Set that the image belongs to.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_SET)))]
    set: u32,
    /// Number of the image in its set.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    image: u32,
    /// Data folder; images of other numbers may be there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub(super) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        stamps,
        exposure,
        positions,
        columns,
        size,
        psf,
        noise,
        set,
        image,
        out,
    } = arguments;
    if let Some(sigma) = noise {
        anyhow::ensure!(
            *sigma > 0.0 && sigma.is_finite(),
            "--noise is {sigma}; expected a positive number"
        );
    }
    let stamps = match (exposure, positions, columns.as_slice()) {
        (Some(exposure), Some(positions), [x, y]) => Stamps::Cutouts {
            exposure,
            positions,
            columns: [x, y],
            side: usize::from(*size),
        },
        (Some(_), ..) => anyhow::bail!(
            "--columns is `{}`; expected the names of two columns, as in `x,y`",
            columns.join(",")
        ),
        (None, ..) => Stamps::Files(stamps),
    };
    let data = if out.is_dir() {
        DataFolder::open(out)?
    } else {
        DataFolder::new(out)
    };
    let id = ImageId {
        set: *set,
        image: *image,
    };
    let Gathered {
        mosaic,
        incomplete,
        doubts,
    } = gather(&data, id, &stamps, psf, *noise)?;
    for doubt in doubts {
        tell(format_args!("{doubt}"));
    }
    if incomplete > 0 {
        tell(format_args!(
            "{} with pixels that are missing or beyond the edge, which will be flagged",
            count(incomplete, "stamp")
        ));
    }
    tell(format_args!(
        "{} of {1} × {1} pixels in {2}",
        count(mosaic.galaxies, "stamp"),
        mosaic.stamp,
        data.galaxies(id.set, id.image).display()
    ));
    Ok(())
}
