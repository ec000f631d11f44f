use std::path::PathBuf;
use std::str::FromStr;

use anyhow::Context;
use clap::Args;
use shearq_measure::{Measurement, Measurer, Stop};
use shearq_submissions::Registry;

use crate::{print, tell};
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::run::open_data;
use shearq_dataset::threads::{ALL_CORES, Pool};
use shearq_pipeline::measure::ImageSource;
use shearq_render::figure::{Figure, PictureFormat};
use shearq_results::views::pages::{steps_figure, steps_row};

/// Plot each processing step of single galaxies, as in Fig. 3 of Nurbaeva et al. (2015).
///
/// Each row shows a galaxy: its stamp, the PSF, the deconvolved galaxy, the residual, the autocorrelation (ACF) of
/// the deconvolved galaxy, and the part of the ACF whose moments are measured. The residual is the stamp minus the
/// deconvolved galaxy convolved with the PSF; noise remains if all went well. Linear configurations multiply the ACF
/// by a weight. The label has the ellipticity and, for linear configurations, the response to shear.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Configuration: a name from `shearq submissions list` or a TOML file.
    #[arg(long, value_name = "NAME|FILE")]
    submission: String,
    /// Data folder with the images.
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Galaxy; INDEX counts from 1 along the rows of the grid. May be given several times.
    #[arg(long, value_name = "SET/IMAGE/INDEX", required = true)]
    galaxy: Vec<GalaxyId>,
    /// File for the plot, .pdf, .png or .svg.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

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
            _ => Err("expected SET/IMAGE/INDEX such as 7/1/42, numbers from 1".into()),
        }
    }
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let out = &arguments.out;
    // Before the work: an ending that is no picture is an error.
    PictureFormat::of(out)?;
    let submission = Registry::embedded()?
        .get(&arguments.submission)?
        .configuration;
    let data = open_data(&arguments.data)?;
    // For the survey of the whole image, with which a galaxy is measured as in `measure`.
    let threads = Pool::new(ALL_CORES)?;
    let (mut rows, mut responses) = (Vec::new(), false);
    for &GalaxyId { image, index } in &arguments.galaxy {
        let mut source = ImageSource::open(&data, image, &submission)?;
        let measurer = Measurer::new(&submission, source.mosaic().stamp)?;
        if measurer.configuration() != &submission {
            // `Measurer` changes the sizes for stamps of the other parity, and with them the pixels that are cut of PSFs.
            source = ImageSource::open(&data, image, measurer.configuration())?;
        }
        let session = source.session(&measurer, &threads)?;
        let Mosaic {
            columns, galaxies, ..
        } = source.mosaic();
        anyhow::ensure!(
            index <= galaxies,
            "--galaxy {}/{}/{index}: no such galaxy (found {index}, expected 1 to {galaxies})",
            image.set,
            image.image
        );
        let (ix, iy) = ((index - 1) % columns, (index - 1) / columns);
        let (measured, steps) = session
            .steps(&mut source, iy, ix)
            .with_context(|| format!("the PSF of galaxy {index} cannot be used"))?;
        let steps = steps
            .with_context(|| format!("galaxy {index} could not be measured: {}", measured.flags))?;
        let response_text = response(&measured, "\nR ");
        // The title explains R if any galaxy has one.
        responses |= !response_text.is_empty();
        let label = format!(
            "{}/{}/{index}: {:+.3}, {:+.3}{response_text}",
            image.set, image.image, measured.e1, measured.e2
        );
        rows.push(steps_row(&label, steps));
        print(&format!("{}\n", describe(image, index, &measured)))?;
    }
    let title = format!(
        "{}; set/image/galaxy: e1, e2{}",
        submission.name,
        match responses {
            true => " before calibration; R: response to shear",
            false => "",
        }
    );
    steps_figure(&title, rows).save(out)?;
    tell(format_args!("wrote {}", out.display()));
    Ok(())
}

// Networks have no response, so that nothing is printed for them.
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
            // The closed form computes no energy.
            _ if d.energy.is_nan() => "in closed form",
            Stop::Stable => "stable: no neuron to update",
            Stop::EnergyRise => "energy stopped falling",
            Stop::MaxIterations => "limit reached",
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
