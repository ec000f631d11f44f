use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use clap::Args;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{MAX_IMAGE, MAX_SET};
use shearq_files::table::FileFormat;
use shearq_pipeline::detect::{Detected, DetectionTask, EpochFiles, MAX_EPOCHS};
use shearq_pipeline::gather::{Content, Files, Masks};
use shearq_quantities::Frame;
use shearq_submissions::DetectionMethod;

use crate::arguments::{SummaryArguments, Threads, listed, mask_bit, named};
use crate::progress::Bar;
use crate::{count, tell};

/// Detect the galaxies of an exposure, or of several of one sky, and measure them, with the response of the detection.
///
/// Subtract the sky first. Each pixel has a weight, by its light above a threshold and above four neighbours, and an ellipticity.
/// Both are functions of the exposure whose response to shear is known in closed form, so that the mean shear is calibrated with
/// its detection. Pixels with a weight that touch each other are a row of the catalogue: its place (x, y; ra, dec), the sums of
/// weighted ellipticities (e1, e2), their response, the weight (selection) and the S/N. `mean`, `shear` and `bias` use it as it is.
///
/// Of several exposures of one sky (epochs), each with its PSF, noise and mask, `detect` combines the light at each place, with weights by
/// their noise behind the PSF, before it detects. They may be dithered, rotated and mirrored, have other pixels, and be partly beyond
/// each other; all need a celestial WCS, and fluxes of one zero point. Detections are on the pixels of the first one.
///
/// The noise has to be the same everywhere on the exposure, and the PSF, too, unless --psf is a model of it. Near an edge or a missing pixel (21 px at a seeing of
/// 0.7″ and pixels of 0.2″), nothing is detected.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Exposure: the first image of its file, or the one of `FILE[SCI,2]`. Several are epochs of one sky.
    #[arg(long, value_name = "FILE", num_args = 1.., required = true)]
    exposure: Vec<PathBuf>,
    /// Stamp of a star, or of the PSF, centred on the star; or a model of PSFEx or Piff, if the PSF varies over the exposure. One for all
    /// exposures, or one for each.
    #[arg(long, value_name = "FILE", num_args = 1.., required = true)]
    psf: Vec<PathBuf>,
    /// Mask of the exposure: a pixel is missing if it is not zero. One for each exposure.
    #[arg(long, value_name = "FILE", num_args = 1..)]
    mask: Vec<PathBuf>,
    /// The bits of the mask that make a pixel missing [default: all].
    #[arg(long, value_name = "LIST", value_delimiter = ',', requires = "mask", value_parser = mask_bit)]
    mask_bits: Option<Vec<u8>>,
    /// Standard deviation of the white noise of a pixel, of all exposures or of each [default: the header key NOISESIG, or measured with
    /// the correlation of pixels].
    #[arg(long, value_name = "SIGMA", num_args = 1..)]
    noise: Vec<f64>,
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

/// The value of a list that belongs to exposure `at` of some: the only one, if there is one for all.
fn part<'a, T>(
    (option, noun): (&str, &str),
    values: &'a [T],
    (at, of): (usize, usize),
    one_for_all: bool,
) -> anyhow::Result<Option<&'a T>> {
    match values.len() {
        0 => Ok(None),
        1 if one_for_all || of == 1 => Ok(values.first()),
        found if found == of => Ok(Some(&values[at])),
        found => anyhow::bail!(
            "--{option} has {} for {} (expected one for each, in the same order)",
            count(found, noun),
            count(of, "exposure")
        ),
    }
}

/// The exposures, each with its files.
fn epochs<'a>(
    arguments: &'a Arguments,
    [exposures, psfs, masks]: [&'a [PathBuf]; 3],
) -> anyhow::Result<Vec<EpochFiles<'a>>> {
    let files = |path, content| Files {
        paths: std::slice::from_ref(path),
        extension: None,
        content,
    };
    anyhow::ensure!(
        exposures.len() <= MAX_EPOCHS,
        "--exposure has {} (expected at most {MAX_EPOCHS})",
        count(exposures.len(), "file")
    );
    let bits = arguments.mask_bits.as_ref();
    let bits = bits.map(|bits| bits.iter().fold(0, |all, bit| all | 1u64 << bit));
    let mut epochs = Vec::new();
    for (at, exposure) in exposures.iter().enumerate() {
        let of = (at, exposures.len());
        let psf = part(("psf", "file"), psfs, of, true)?;
        let noise = part(("noise", "number"), &arguments.noise, of, true)?.copied();
        anyhow::ensure!(
            noise.is_none_or(|noise| noise > 0.0 && noise.is_normal()),
            "--noise is {:?}; expected a positive number",
            noise.unwrap_or_default()
        );
        epochs.push(EpochFiles {
            exposure: files(exposure, Content::Sky),
            psf: files(
                psf.context("--psf names no file (expected one)")?,
                Content::Psf,
            ),
            masks: part(("mask", "file"), masks, of, false)?.map(|path| Masks {
                files: files(path, Content::Mask),
                bits,
            }),
            noise,
        });
    }
    Ok(epochs)
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let lists = [&arguments.exposure, &arguments.psf, &arguments.mask];
    let [exposures, psfs, masks] = lists.map(|list| listed(list));
    let (exposures, psfs, masks) = (exposures?, psfs?, masks?);
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
    let task = DetectionTask {
        epochs: epochs(arguments, [&exposures, &psfs, &masks])?,
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
    let levels: Vec<String> = noise.iter().map(|own| format!("{own:.4}")).collect();
    tell(format_args!("noise: σ = {}, {source}", levels.join(", ")));
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
            "epochs": noise.len(),
            "noise": match noise[..] {
                [noise] => serde_json::json!(noise),
                _ => serde_json::json!(noise),
            },
            "noise_is_measured": is_measured,
            "frame": frame.to_string(),
            "missing": missing,
            "unlit": unlit,
            "warnings": doubts,
        })
    })
}
