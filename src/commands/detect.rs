use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{MAX_IMAGE, MAX_SET};
use shearq_files::table::FileFormat;
use shearq_pipeline::detect::{Detected, DetectionTask};
use shearq_pipeline::gather::{Content, Files, Masks};
use shearq_quantities::Frame;
use shearq_submissions::DetectionMethod;

use crate::arguments::{SummaryArguments, Threads, mask_bit, named};
use crate::progress::Bar;
use crate::{count, tell};

/// Detect the galaxies of an exposure and measure them, with the response of the detection.
///
/// Subtract the sky first. Each pixel has a weight, by its light above a threshold and above four neighbours, and an ellipticity.
/// Both are functions of the exposure whose response to shear is known in closed form, so that the mean shear is calibrated with
/// its detection. Pixels with a weight that touch each other are a row of the catalogue: its place (x, y; ra, dec), the sums of
/// weighted ellipticities (e1, e2), their response, the weight (selection) and the S/N. `mean`, `shear` and `bias` use it as it is.
///
/// The noise has to be the same everywhere on the exposure, and the PSF, too, unless --psf is a model of it. Near an edge or a missing pixel (21 px at a seeing of
/// 0.7″ and pixels of 0.2″), nothing is detected.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Exposure: the first image of its file, or the one of `FILE[SCI,2]`.
    #[arg(long, value_name = "FILE")]
    exposure: PathBuf,
    /// Stamp of a star, or of the PSF, centred on the star; or a model of PSFEx or Piff, if the PSF varies over the exposure.
    #[arg(long, value_name = "FILE")]
    psf: PathBuf,
    /// Mask of the exposure: a pixel is missing if it is not zero.
    #[arg(long, value_name = "FILE")]
    mask: Option<PathBuf>,
    /// The bits of the mask that make a pixel missing [default: all].
    #[arg(long, value_name = "LIST", value_delimiter = ',', requires = "mask", value_parser = mask_bit)]
    mask_bits: Option<Vec<u8>>,
    /// Standard deviation of the white noise of a pixel [default: the header key NOISESIG, or measured with the correlation of pixels].
    #[arg(long, value_name = "SIGMA")]
    noise: Option<f64>,
    /// S/N of the smoothed light at which a pixel has half of its weight.
    #[arg(long, value_name = "S/N", default_value_t = DetectionMethod::default().threshold)]
    threshold: f64,
    /// Axes of the ellipticities: those of the sky, by the WCS at the middle of the exposure, or of the pixels [default: sky if
    /// the WCS rotates, mirrors or shears the pixels, else pixel].
    #[arg(long, value_name = "pixel|sky")]
    frame: Option<Frame>,
    /// Set of the catalogue.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_SET)))]
    set: u32,
    /// Number of the catalogue in its set.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_IMAGE)))]
    image: u32,
    /// Folder for the catalogue, which may have those of other exposures.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// File format of the catalogue [default: parquet].
    #[arg(long, value_parser = named::<FileFormat>())]
    catalogue_format: Option<FileFormat>,
    #[command(flatten)]
    threads: Threads,
    #[command(flatten)]
    summary: SummaryArguments,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let files = |path, content| Files {
        paths: std::slice::from_ref(path),
        extension: None,
        content,
    };
    let settings = DetectionMethod {
        threshold: arguments.threshold,
        ..DetectionMethod::default()
    };
    // Of the settings, the threshold alone is the user's.
    settings.validate().map_err(|error| {
        anyhow::anyhow!(
            "--threshold is {}; expected {}",
            error.found,
            error.expected
        )
    })?;
    anyhow::ensure!(
        arguments
            .noise
            .is_none_or(|noise| noise > 0.0 && noise.is_normal()),
        "--noise is {:?}; expected a positive number",
        arguments.noise.unwrap_or_default()
    );
    let bits = arguments.mask_bits.as_ref();
    let task = DetectionTask {
        exposure: files(&arguments.exposure, Content::Sky),
        psf: files(&arguments.psf, Content::Psf),
        masks: arguments.mask.as_ref().map(|path| Masks {
            files: files(path, Content::Mask),
            bits: bits.map(|bits| bits.iter().fold(0, |all, bit| all | 1u64 << bit)),
        }),
        noise: arguments.noise,
        frame: arguments.frame,
        settings,
    };
    let (out, threads) = (&arguments.out, arguments.threads.number());
    let run = task.run(out, arguments.catalogue_format.unwrap_or_default())?;
    let id = ImageId {
        set: arguments.set,
        image: arguments.image,
    };
    let start = Instant::now();
    let Detected {
        detections,
        weight,
        margin,
        cells,
        noise,
        is_measured,
        frame,
        missing,
        unlit,
        doubts,
    } = task.write_catalogue(&run, out, id, threads, |pixels| {
        Box::new(Bar::of("detecting", "pixels", pixels))
    })?;
    for doubt in &doubts {
        tell(format_args!("warning: {doubt}."));
    }
    let path = run.catalogue(out, id.set, id.image);
    tell(format_args!(
        "{} in {:.1} s, none within {margin} px of edges and of the {missing} missing pixels; {}",
        count(detections, "detection"),
        start.elapsed().as_secs_f64(),
        path.display()
    ));
    let source = if is_measured { "measured" } else { "given" };
    tell(format_args!("noise: σ = {noise:.4}, {source}"));
    if cells > 1 {
        tell(format_args!(
            "PSF: that of the model at the middle of each of {cells} parts of the exposure"
        ));
    }
    if frame == Frame::Sky {
        tell(format_args!(
            "frame: sky (e1 > 0 along east–west, e2 > 0 along north-west)"
        ));
    }
    arguments.summary.print(|| {
        serde_json::json!({
            "catalogue": path,
            "detections": detections,
            "weight": weight,
            "margin": margin,
            "cells": cells,
            "noise": noise,
            "noise_is_measured": is_measured,
            "frame": frame.to_string(),
            "missing": missing,
            "unlit": unlit,
            "warnings": doubts,
        })
    })
}
