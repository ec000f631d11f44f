//! Pixel scales that headers state, to detect a PSF that is sampled in other pixels than the galaxies.

use shearq_files::fits::ImageReader;
use shearq_measure::Warning;

/// Keys with the pixel scale in arcseconds: of surveys, and of GalSim.
const SCALES: [&str; 2] = ["PIXSCALE", "GS_SCALE"];
/// Keys of the matrix from pixels to the sky, in the unit CUNIT1.
const MATRIX: [&str; 4] = ["CD1_1", "CD1_2", "CD2_1", "CD2_2"];
const STEPS: [&str; 2] = ["CDELT1", "CDELT2"];
/// Plausible scales in arcseconds. Headers without a sky have scales such as 1 degree per pixel.
const PLAUSIBLE: std::ops::RangeInclusive<f64> = 1e-3..=60.0;
/// Least relative difference that is reported: a difference of 1 % changes m by about 0.01.
const LEAST_DIFFERENCE: f64 = 0.01;

/// Arcseconds per pixel that the header of an image states, `None` if it states none.
pub(crate) fn of_header(image: &ImageReader) -> Option<f64> {
    // A key that is no number is no scale.
    let number = |key: &str| image.number(key).ok().flatten();
    let unit = match image.text("CUNIT1").trim().to_ascii_lowercase().as_str() {
        "arcsec" => 1.0,
        "arcmin" => 60.0,
        "rad" => 648_000.0 / std::f64::consts::PI,
        _ => 3600.0,
    };
    let stated = SCALES.into_iter().find_map(number);
    let matrix = || {
        let [xx, xy, yx, yy] = MATRIX.map(number);
        if xx.is_none() && yy.is_none() && xy.is_none() {
            return None;
        }
        let [xx, xy, yx, yy] = [xx, xy, yx, yy].map(|value| value.unwrap_or(0.0));
        Some((xx * yy - xy * yx).abs().sqrt() * unit)
    };
    let steps = || {
        let [x, y] = STEPS.map(number);
        Some((x? * y?).abs().sqrt() * unit)
    };
    let scale = stated.or_else(matrix).or_else(steps);
    scale.filter(|scale| PLAUSIBLE.contains(scale))
}

/// A warning if the PSF and the galaxies state different scales.
pub(crate) fn disagreement(psf: Option<f64>, galaxies: Option<f64>) -> Option<Warning> {
    let (psf, galaxies) = (psf?, galaxies?);
    let differs = (psf / galaxies - 1.0).abs() > LEAST_DIFFERENCE;
    differs.then_some(Warning::PixelScale { psf, galaxies })
}

#[cfg(test)]
mod tests {
    use shearq_files::fits::{ImageWriter, Value};

    use super::*;

    fn scale(keys: &[(&str, Value)]) -> Option<f64> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image.fits");
        let mut writer = ImageWriter::create(&path, 2, 2, keys).unwrap();
        writer.write_rows(&[0.0; 4]).unwrap();
        writer.finish().unwrap();
        of_header(&ImageReader::open(&path).unwrap())
    }

    #[test]
    fn headers_state_the_scale_by_any_of_the_usual_keys() {
        let (real, text) = (Value::Real, |text: &str| Value::Text(text.into()));
        let degrees = 0.2 / 3600.0;
        let headers = [
            vec![("PIXSCALE", real(0.2))],
            vec![("GS_SCALE", real(0.2)), ("CD1_1", real(5.0))],
            vec![("CDELT1", real(-degrees)), ("CDELT2", real(degrees))],
            // Rotated by 90 degrees.
            vec![("CD1_2", real(degrees)), ("CD2_1", real(degrees))],
            vec![
                ("CD1_1", real(0.2)),
                ("CD2_2", real(0.2)),
                ("CUNIT1", text("arcsec")),
            ],
        ];
        for header in headers {
            let found = scale(&header).unwrap();
            assert!((found - 0.2).abs() < 1e-12, "{header:?}: {found}");
        }
        let none = [
            vec![],
            vec![("CDELT1", real(1.0)), ("CDELT2", real(1.0))],
            vec![("PIXSCALE", text("small"))],
        ];
        for header in none {
            assert_eq!(scale(&header), None, "{header:?}");
        }
    }

    #[test]
    fn scales_that_differ_by_rounding_agree() {
        assert_eq!(disagreement(Some(0.2), Some(0.2001)), None);
        assert_eq!(disagreement(None, Some(0.2)), None);
        let found = disagreement(Some(0.263), Some(0.2)).unwrap();
        assert_eq!(found.kind(), "pixel-scale");
    }
}
