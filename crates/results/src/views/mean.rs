//! Mean shears as a table.

use shearq_submissions::{Calibration, Configuration, EllipticityType};

use crate::mean::SetMean;
use shearq_render::table::{Cell, Heading, Table};

/// Mean shears of sets that `configuration` measured, of the catalogues called `name`.
pub fn mean_table(means: &[SetMean], configuration: &Configuration, name: &str) -> Table {
    /// Place of the column of galaxies that a selection leaves out.
    const CUT: usize = 3;
    let selected = means.iter().any(|mean| mean.cut > 0);
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
        let shear = |k: usize| match &mean.shear {
            Some(found) => Cell::with_error(found.shear[k], Some(found.error()[k]), 5),
            None => Cell::number(f64::NAN, 5),
        };
        let mut row = vec![
            Cell::number(f64::from(mean.set), 0),
            Cell::number(mean.galaxies as f64, 0),
            Cell::number(mean.flagged as f64, 0),
            shear(0),
            shear(1),
            Cell::number(mean.scatter[0], 4),
            Cell::number(mean.scatter[1], 4),
        ];
        if selected {
            row.insert(CUT, Cell::number(mean.cut as f64, 0));
        }
        row
    });
    let mut notes = vec![format!(
        "Mean ellipticities of {name} by {}. Positive g2 is a stretch along x = y.",
        configuration.name
    )];
    if configuration.calibration() == Calibration::None {
        notes.push(
            "This configuration does not divide by the response to shear, so these are no shears."
                .into(),
        );
    } else if configuration.ellipticity() == EllipticityType::Distortion {
        notes.push("The ellipticities are distortions, divided by their response to shear.".into());
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
    let mut headings: Vec<Heading> = headings.map(|(key, label)| Heading::new(key, label)).into();
    if selected {
        headings.insert(CUT, Heading::new("cut", "Cut"));
    }
    Table {
        title: "Mean shear".into(),
        headings,
        rows: rows.collect(),
        notes,
    }
}

/// Whether the noise of the stars is at least a tenth of an error.
fn noticed(mean: &SetMean) -> bool {
    let errors = mean.shear.iter().flat_map(|shear| shear.error());
    let mut pairs = errors.zip(mean.psf_error);
    pairs.any(|(error, psf)| psf > 0.1 * error)
}
