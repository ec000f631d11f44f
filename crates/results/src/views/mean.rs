//! Mean shears as a table.

use shearq_submissions::{Calibration, Configuration, EllipticityType};

use crate::crowding::CLOSE_PX;
use crate::mean::SetMean;
use shearq_dataset::metadata::Axes;
use shearq_render::table::{Cell, Table};

/// Mean shears of sets that `configuration` measured, of the catalogues called `name`.
pub fn mean_table(means: &[SetMean], configuration: &Configuration, name: &str) -> Table {
    let mut table = Table::titled("Mean shear");
    let count = |galaxies: usize| Cell::number(galaxies as f64, 0);
    table.column("set", "Set", means, |mean| {
        Cell::number(f64::from(mean.set), 0)
    });
    table.column("galaxies", "Galaxies", means, |mean| count(mean.galaxies));
    table.column("flagged", "Flagged", means, |mean| count(mean.flagged));
    if means.iter().any(|mean| mean.cut > 0) {
        table.column("cut", "Cut", means, |mean| count(mean.cut));
    }
    for (k, key) in ["g1", "g2"].into_iter().enumerate() {
        table.column(key, key, means, |mean| match &mean.shear {
            Some(found) => Cell::with_error(found.shear[k], Some(found.error()[k]), 5),
            None => Cell::number(f64::NAN, 5),
        });
    }
    table.column("scatter1", "σ(e1)", means, |mean| {
        Cell::number(mean.scatter[0], 4)
    });
    table.column("scatter2", "σ(e2)", means, |mean| {
        Cell::number(mean.scatter[1], 4)
    });
    let frame = table.column("frame", "Frame", means, |mean| {
        Cell::text(mean.axes.frame().to_string())
    });
    table.headings[frame].detail = true;
    let on_sky = means.iter().filter(|mean| mean.axes == Axes::Sky).count();
    let convention = match on_sky {
        0 => "Positive g2 is a stretch along x = y.",
        _ if on_sky == means.len() => {
            "Frame: sky, north up and seen from Earth. Positive g1 is a stretch along east–west, positive g2 along north-west."
        }
        _ => "The frame of each set is the pixels' or the sky's (--format csv).",
    };
    let notes = &mut table.notes;
    notes.push(format!(
        "Mean ellipticities of {name} by {}. {convention}",
        configuration.name
    ));
    if configuration.calibration() == Calibration::None {
        notes.push(
            "This configuration does not divide by the response to shear, so these are no shears."
                .into(),
        );
    } else if configuration.ellipticity() == EllipticityType::Distortion {
        notes.push("The ellipticities are distortions, divided by their response to shear.".into());
    }
    if means.iter().any(|mean| mean.rotated_pairs) {
        notes.push(
            "Errors are of the noise of pixels: each galaxy has a partner rotated by 90°, so that intrinsic shapes cancel."
                .into(),
        );
    }
    match configuration.is_detection() {
        true => notes.push("The response contains that of the detection.".into()),
        false => notes.extend(without_detection(means)),
    }
    if means.iter().any(noticed) {
        let images = means.iter().map(|mean| mean.images.len()).sum::<usize>();
        let stated = means.iter().map(|mean| mean.noisy_stars).sum::<usize>();
        let of = if stated == images {
            "each image".to_owned()
        } else {
            format!("{stated} of {images} images, whose catalogues state it")
        };
        notes.push(format!("Errors include the noise of the star of {of}."));
    }
    table
}

/// What the response does not contain if stamps were cut at positions of an exposure, of which some have another one on their stamp.
fn without_detection(means: &[SetMean]) -> Option<String> {
    let [crowded, placed] = [|mean: &SetMean| mean.crowded, |mean: &SetMean| mean.placed]
        .map(|of| means.iter().map(of).sum::<usize>());
    (crowded > 0).then(|| {
        format!(
            "Calibrated at given positions, without detection: {:.0} % of the positions have another one within {CLOSE_PX} px, and which positions a detection finds depends on shear. Try: simulate --scenes, to measure m with your detection (docs/scenes.md).",
            100.0 * crowded as f64 / placed as f64
        )
    })
}

/// Whether the noise of the stars is at least a tenth of an error.
fn noticed(mean: &SetMean) -> bool {
    let errors = mean.shear.iter().flat_map(|shear| shear.error());
    let mut pairs = errors.zip(mean.psf_error);
    pairs.any(|(error, psf)| psf > 0.1 * error)
}
