//! What a pipeline with detection makes of an area of sky: a cut that lowers m may cost more galaxies than it is worth.

use shearq_render::table::{Cell, Heading, Table};

use crate::bias::BiasResult;

// Shape noise per component of the galaxies that the effective number counts: that of COSMOS (Leauthaud et al. 2007, ApJS 172, 219).
const SHAPE_NOISE: f64 = 0.26;

// Ratio of the effective number and that of detections above which shapes cancel. The error of 24 units is itself known to 14 %.
const MAX_EFFECTIVE: f64 = 1.3;

/// Adds columns to a table of bias: detections per arcmin², the error of a shear component from 1 arcmin², and the effective number.
/// Each catalogue is of `area` arcmin².
///
/// The error is σ(c)·√A, A being the area of the units. σ(c) contains noise, shapes and how detections cluster, because units are
/// whole images; under ±γ the galaxies are the same, so that the area of a unit is that of one image. The effective
/// number is that of galaxies measured without noise that would have this error (Chang et al. 2013, MNRAS 434, 2121).
pub fn add_per_area(table: &mut Table, result: &BiasResult, area: f64) {
    let images = result.about.catalogues.len() as f64;
    let of_unit = result.grouping.whole_catalogues;
    for (key, label) in [
        ("density", "n/arcmin²"),
        ("shear_error", "σ·√arcmin²"),
        ("effective_density", "n_eff"),
    ] {
        table.headings.push(Heading::new(key, label));
    }
    let mut most = 0.0_f64;
    for (row, bin) in table.rows.iter_mut().zip(&result.bins) {
        let all = bin.estimate.as_ref().ok();
        let density = all.map_or(0.0, |all| all.galaxies as f64 / (images * area));
        let error = all
            .filter(|_| of_unit)
            .and_then(|all| all.shear_error(area));
        let error = error.unwrap_or(f64::NAN);
        let effective = (SHAPE_NOISE / error).powi(2);
        most = most.max(effective / density);
        row.extend([
            Cell::number(density, 2),
            Cell::number(error, 4),
            Cell::number(effective, 2),
        ]);
    }
    if most > MAX_EFFECTIVE {
        table.notes.push(format!(
            "n_eff is up to {most:.1} times the number of detections (expected less than it): shapes cancel in c, as of rotated versions, or scatter by less than {SHAPE_NOISE}. Try: catalogues of other galaxies each"
        ));
    }
    table.notes.push(match of_unit {
        true => format!(
            "Per area: {area} arcmin² of each catalogue. σ·√arcmin² is the error of a shear component from 1 arcmin², by the scatter of c between images; n_eff galaxies per arcmin² with a shape noise of {SHAPE_NOISE} and no measurement noise have the same. Give neither rotated versions nor those of opposite noise, of which shapes or noise cancel in c."
        ),
        false => "Per area: the error of a shear needs images as units. Try: --units catalogues".into(),
    });
}
