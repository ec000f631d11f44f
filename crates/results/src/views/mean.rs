//! Mean shears as a table.

use shearq_submissions::{Calibration, Configuration, EllipticityType};

use crate::mean::SetMean;
use shearq_render::table::{Cell, Heading, Table};

/// Means of sets measured by `submission`, of catalogues that are called `name`.
pub fn mean_table(means: &[SetMean], configuration: &Configuration, name: &str) -> Table {
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
        vec![
            Cell::number(f64::from(mean.set), 0),
            Cell::number(mean.galaxies as f64, 0),
            Cell::number(mean.flagged as f64, 0),
            Cell::with_error(mean.mean[0], Some(mean.error[0]), 5),
            Cell::with_error(mean.mean[1], Some(mean.error[1]), 5),
            Cell::number(mean.scatter[0], 4),
            Cell::number(mean.scatter[1], 4),
        ]
    });
    let mut notes = vec![format!(
        "Mean ellipticities of {name} by {}, g2 along the diagonal of the pixels.",
        configuration.name
    )];
    if configuration.calibration() == Calibration::None {
        notes.push(
            "This submission does not divide by the response to shear: these are no shears.".into(),
        );
    } else if configuration.ellipticity() == EllipticityType::Distortion {
        notes.push("Of distortions, divided by their response to shear.".into());
    }
    Table {
        title: "Mean shear".into(),
        headings: headings.map(|(key, label)| Heading::new(key, label)).into(),
        rows: rows.collect(),
        notes,
    }
}
