//! `shearq show`.

use std::path::PathBuf;
use std::str::FromStr;

use anyhow::Context;
use clap::Args;
use ndarray::Axis;
use shearq_measure::{Measurement, Measurer, Stop, strip};
use shearq_submissions::Registry;

use crate::{print, tell};
use shearq_pipeline::data::mosaic::Mosaic;
use shearq_pipeline::data::run::open_data;
use shearq_pipeline::images::ImageId;
use shearq_pipeline::measure::ImageSource;
use shearq_render::figure::{Figure, PictureFormat};
use shearq_results::views::steps::{steps_figure, steps_row};

/// Draw the steps of galaxies like the paper's Fig. 3: stamp, PSF, deconvolved, residual, ACF,
/// clipped ACF.
///
/// A row is a galaxy: its stamp as it is measured, the PSF, the deconvolved galaxy, what the stamp has beyond
/// that galaxy seen through the PSF (noise alone where all went well), the autocorrelation of the deconvolved galaxy,
/// and as much of it as its moments are taken of, for linear submissions times their weight. Its
/// label has the ellipticity, and for linear submissions the response by which that of a sample is divided.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Name of a submission or a TOML file of your own.
    #[arg(long, value_name = "NAME|FILE")]
    submission: String,
    /// Data folder.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Galaxies; INDEX counts from 1 along the rows of the grid. May be given several times.
    #[arg(long, value_name = "SET/IMAGE/INDEX", required = true)]
    galaxy: Vec<GalaxyId>,
    /// Picture to write, .png or .svg.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// A galaxy on the command line.
#[derive(Debug, Clone, Copy)]
struct GalaxyId {
    image: ImageId,
    index: usize,
}

impl FromStr for GalaxyId {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Option<Vec<u32>> = text
            .split('/')
            .map(|part| part.parse().ok().filter(|n| *n >= 1))
            .collect();
        match numbers.as_deref() {
            Some(&[set, image, index]) => Ok(GalaxyId {
                image: ImageId { set, image },
                index: index as usize,
            }),
            _ => Err("expected SET/IMAGE/INDEX, three numbers from 1".into()),
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let Arguments {
        submission,
        data,
        galaxy,
        out,
    } = arguments;
    PictureFormat::of(out)?;
    let submission = Registry::embedded()?.get(submission)?.configuration;
    let data = open_data(data)?;
    let (mut rows, mut responses) = (Vec::new(), false);
    for &GalaxyId { image, index } in galaxy {
        let mut source = ImageSource::open(&data, image, &submission)?;
        let measurer = Measurer::new(&submission, source.head().mosaic.stamp)?;
        source.survey(&data, &measurer)?;
        let Mosaic {
            columns,
            galaxies,
            stamp: side,
        } = source.head().mosaic;
        anyhow::ensure!(
            index <= galaxies,
            "set {} image {} has {galaxies} galaxies; galaxy {index} was asked for",
            image.set,
            image.image
        );
        let (ix, iy) = ((index - 1) % columns, (index - 1) / columns);
        let row = loop {
            let row = source
                .next_row()?
                .context("the image ended before the galaxy")?;
            if row.iy == iy {
                break row;
            }
        };
        let psf = row.psfs.at(ix, submission.psf_cut(), side);
        let psf = psf
            .map(|star| star.psf)
            .with_context(|| format!("the PSF of galaxy {index} cannot be used"))?;
        let mut worker = measurer.worker();
        let mut worker = worker.image(row.head.noise());
        let mut worker = worker.psf(psf.view())?;
        let stamps = strip(&row.pixels, columns, side)?;
        let stamp = stamps.index_axis(Axis(0), ix);
        let measured = worker.measure(stamp)?;
        anyhow::ensure!(
            measured.descent.is_some(),
            "galaxy {index} could not be measured: {}",
            measured.flags
        );
        let steps = worker.steps(stamp, psf.view(), &measured)?;
        let own_response = response(&measured, "\nR ");
        responses |= !own_response.is_empty();
        let label = format!(
            "{}/{}/{index}: {:+.3}, {:+.3}{own_response}",
            image.set, image.image, measured.e1, measured.e2
        );
        rows.push(steps_row(&label, psf, steps));
        print(&format!("{}\n", describe(image, index, &measured)))?;
    }
    let title = format!(
        "{}; set/image/galaxy: e1, e2{}",
        submission.name,
        match responses {
            true => " before calibration; R: their response to shear",
            false => "",
        }
    );
    steps_figure(&title, rows).save(out)?;
    tell(format_args!("wrote {}", out.display()));
    Ok(())
}

/// The galaxy's own response to shear after `lead`, where the method knows it.
fn response(measured: &Measurement, lead: &str) -> String {
    match measured.response_diagonal() {
        [first, second] if first.is_finite() && second.is_finite() => {
            format!("{lead}{first:.3}, {second:.3}")
        }
        _ => String::new(),
    }
}

fn describe(id: ImageId, index: usize, m: &Measurement) -> String {
    let stop = m.descent.map_or_else(String::new, |d| {
        let ended = match d.stop {
            // The closed form has no energy to follow.
            _ if d.energy.is_nan() => "in closed form",
            Stop::Stable => "until no neuron was to be updated",
            Stop::EnergyRise => "until the energy fell no more",
            Stop::MaxIterations => "as many as allowed",
        };
        format!("{} iterations ({ended})", d.iterations)
    });
    format!(
        "set {} image {} galaxy {index}: e1 {:+.4}, e2 {:+.4}{}, flag {}, {stop}, noise {:.3}, ACF radius {:.1} px",
        id.set,
        id.image,
        m.e1,
        m.e2,
        response(m, " before calibration, response "),
        m.flags.bits(),
        m.noise,
        m.radius
    )
}
