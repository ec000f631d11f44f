//! What headers state of an image's pixels on the sky: to detect a PSF that is sampled in other pixels than the galaxies, and
//! ellipticities that are not along the sky's axes.

use shearq_files::fits::{ImageReader, Value};
use shearq_measure::{PixelFrame, Warning};

// Keys with the pixel scale in arcseconds: of surveys, and of GalSim.
const PIXEL_SCALE_KEYS: [&str; 2] = ["PIXSCALE", "GS_SCALE"];
// Keys of the matrix from pixels to the sky, in the unit CUNIT1.
const MATRIX: [&str; 4] = ["CD1_1", "CD1_2", "CD2_1", "CD2_2"];
const STEPLESS: [&str; 4] = ["PC1_1", "PC1_2", "PC2_1", "PC2_2"];
const CDELT_KEYS: [&str; 2] = ["CDELT1", "CDELT2"];
// Rotation of the second axis in degrees, before there was a matrix (Calabretta & Greisen 2002, A&A 395, 1077, eq. 189).
const ROTATION: &str = "CROTA2";
// Plausible scales in arcseconds. Headers without a sky have scales such as 1 degree per pixel.
const PLAUSIBLE: std::ops::RangeInclusive<f64> = 1e-3..=60.0;
// Least relative difference of scales, and least shear between the pixels of the PSF and of the galaxies, that is reported: a
// difference of 1 % changes m by about 0.01.
const LEAST_DIFFERENCE: f64 = 0.01;
// Least rotation in degrees that is reported: it changes m by −2 sin² 1° = −6e-4, and adds 3.5 % of g2 to g1.
const LEAST_ROTATION: f64 = 1.0;
// Least shear of the pixels that is reported, as it adds to c.
const LEAST_SHEAR: f64 = 1e-3;

/// What a header states of the pixels on the sky.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Wcs {
    /// Arcseconds per pixel.
    scale: Option<f64>,
    /// Derivatives of (u, v) by x (first column) and y in arcseconds, with u to the west and v to the north.
    jacobian: Option<[[f64; 2]; 2]>,
}

impl Wcs {
    pub(crate) fn of_header(image: &ImageReader) -> Self {
        // A key that is no number is no scale.
        let number = |key: &str| image.number(key).ok().flatten();
        let text = |key: &str| image.text(key).trim().to_ascii_uppercase();
        let kind = text("CTYPE1");
        // GalSim writes planes in arcseconds without a unit.
        let plane = kind == "LINEAR";
        let unit = match text("CUNIT1").as_str() {
            "ARCSEC" => 1.0,
            "" if plane && !text("GS_WCS").is_empty() => 1.0,
            "ARCMIN" => 60.0,
            "RAD" => 648_000.0 / std::f64::consts::PI,
            _ => 3600.0,
        };
        let steps = CDELT_KEYS.map(number);
        let matrix = cd(MATRIX.map(number)).or_else(|| {
            let [x, y] = [steps[0]?, steps[1]?];
            let (sine, cosine) = number(ROTATION).unwrap_or(0.0).to_radians().sin_cos();
            let [xx, xy, yx, yy] = STEPLESS.map(number);
            Some(match [xx, xy, yx, yy].iter().any(Option::is_some) {
                true => {
                    let [xx, yy] = [xx, yy].map(|value| value.unwrap_or(1.0));
                    let [xy, yx] = [xy, yx].map(|value| value.unwrap_or(0.0));
                    [[xx * x, xy * x], [yx * y, yy * y]]
                }
                false => [[x * cosine, -y * sine], [x * sine, y * cosine]],
            })
        });
        let matrix = matrix.filter(|m| determinant(m).is_normal());
        let stated = PIXEL_SCALE_KEYS.into_iter().find_map(number);
        let scale = stated.or_else(|| Some(determinant(&matrix?).abs().sqrt() * unit));
        Wcs {
            scale: scale.filter(|scale| PLAUSIBLE.contains(scale)),
            jacobian: matrix.map(|matrix| {
                let [first, second] = matrix.map(|row| row.map(|value| value * unit));
                let west = |row: [f64; 2]| row.map(|value| -value);
                if plane {
                    [first, second]
                } else if kind.starts_with("DEC") || kind.get(1..4) == Some("LAT") {
                    [west(second), first]
                } else if kind.starts_with("RA") || kind.get(1..4) == Some("LON") {
                    [west(first), second]
                } else if determinant(&matrix) < 0.0 {
                    // Unnamed axes are right ascension and declination if one of them is reversed.
                    [west(first), second]
                } else {
                    [first, second]
                }
            }),
        }
    }

    /// Keys that state the same of an image of other stamps of these pixels, as GalSim writes and reads them.
    pub(crate) fn keys(&self) -> Vec<(&'static str, Value)> {
        let Some([[xx, xy], [yx, yy]]) = self.jacobian else {
            return Vec::new();
        };
        let text = |text: &str| Value::Text(text.into());
        let mut keys = vec![("GS_WCS", text("JacobianWCS"))];
        keys.extend(["CTYPE1", "CTYPE2"].map(|key| (key, text("LINEAR"))));
        keys.extend(["CUNIT1", "CUNIT2"].map(|key| (key, text("arcsec"))));
        let matrix = [xx, xy, yx, yy].map(Value::Real);
        keys.extend(MATRIX.into_iter().zip(matrix));
        keys
    }

    /// A warning if the ellipticities along these pixels are not along the sky's axes.
    pub(crate) fn frame(&self) -> Option<Warning> {
        let frame = frame(&self.jacobian?);
        // Ellipticities do not change by half a turn.
        let turned = (frame.angle + 90.0).rem_euclid(180.0) - 90.0;
        let differs = frame.mirrored
            || turned.abs() > LEAST_ROTATION
            || frame.shear[0].hypot(frame.shear[1]) > LEAST_SHEAR;
        differs.then_some(Warning::PixelFrame(frame))
    }

    /// Warnings if the PSF and the galaxies state different pixels.
    pub(crate) fn disagreements(psf: &Self, galaxies: &Self) -> impl Iterator<Item = Warning> {
        let scale = || {
            let (psf, galaxies) = (psf.scale?, galaxies.scale?);
            let differs = (psf / galaxies - 1.0).abs() > LEAST_DIFFERENCE;
            differs.then_some(Warning::PixelScale { psf, galaxies })
        };
        let frames = || {
            let (psf, galaxies) = (psf.jacobian?, galaxies.jacobian?);
            let PixelFrame {
                angle,
                mirrored,
                shear: [g1, g2],
            } = frame(&ratio(&psf, &galaxies));
            let differs =
                mirrored || angle.abs() > LEAST_ROTATION || g1.hypot(g2) > LEAST_DIFFERENCE;
            differs.then(|| Warning::PsfFrame {
                psf: frame(&psf),
                galaxies: frame(&galaxies),
            })
        };
        scale().into_iter().chain(frames())
    }
}

/// The matrix of four keys, of which some may be absent.
fn cd([xx, xy, yx, yy]: [Option<f64>; 4]) -> Option<[[f64; 2]; 2]> {
    if xx.is_none() && yy.is_none() && xy.is_none() {
        return None;
    }
    Some([[xx, xy], [yx, yy]].map(|row| row.map(|value| value.unwrap_or(0.0))))
}

fn determinant([[a, b], [c, d]]: &[[f64; 2]; 2]) -> f64 {
    a * d - b * c
}

/// The pixels of `galaxies` in units of those of `psf`.
fn ratio(psf: &[[f64; 2]; 2], galaxies: &[[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let all = determinant(psf);
    let [[a, b], [c, d]] = *psf;
    let rows = [[d / all, -b / all], [-c / all, a / all]];
    rows.map(|[x, y]| [0, 1].map(|k| x * galaxies[0][k] + y * galaxies[1][k]))
}

fn frame(jacobian: &[[f64; 2]; 2]) -> PixelFrame {
    let [[ux, uy], [vx, vy]] = *jacobian;
    let all = determinant(jacobian);
    // A round object has the second moments J⁻¹ J⁻ᵀ in pixels, of which this is the ellipticity (Bartelmann & Schneider 2001,
    // eq. 4.10).
    let (xx, yy, xy) = (vy * vy + uy * uy, vx * vx + ux * ux, -(vx * vy + ux * uy));
    let size = xx + yy + 2.0 * all.abs();
    // The rotation of the polar decomposition, with +x mirrored where it is to the east.
    let parity = all.signum();
    PixelFrame {
        angle: (parity * vx - uy).atan2(parity * ux + vy).to_degrees(),
        mirrored: all < 0.0,
        shear: [(xx - yy) / size, 2.0 * xy / size],
    }
}

#[cfg(test)]
mod tests {
    use shearq_files::fits::ImageWriter;

    use super::*;

    fn wcs(keys: &[(&str, Value)]) -> Wcs {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image.fits");
        let mut writer = ImageWriter::create(&path, 2, 2, keys).unwrap();
        writer.write_rows(&[0.0; 4]).unwrap();
        writer.finish().unwrap();
        Wcs::of_header(&ImageReader::open(&path).unwrap())
    }

    const DEGREES: f64 = 0.2 / 3600.0;

    fn real(value: f64) -> Value {
        Value::Real(value)
    }

    /// A header of right ascension and declination with this matrix, in units of the pixel scale.
    fn sky(matrix: [f64; 4]) -> Wcs {
        let mut keys = vec![("CTYPE1", Value::Text("RA---TAN".into()))];
        keys.extend(
            MATRIX
                .into_iter()
                .zip(matrix.map(|value| real(value * DEGREES))),
        );
        wcs(&keys)
    }

    #[test]
    fn headers_state_the_scale_by_any_of_the_usual_keys() {
        let text = |text: &str| Value::Text(text.into());
        let headers = [
            vec![("PIXSCALE", real(0.2))],
            vec![("GS_SCALE", real(0.2)), ("CD1_1", real(5.0))],
            vec![("CDELT1", real(-DEGREES)), ("CDELT2", real(DEGREES))],
            // Rotated by 90 degrees.
            vec![("CD1_2", real(DEGREES)), ("CD2_1", real(DEGREES))],
            vec![
                ("CD1_1", real(0.2)),
                ("CD2_2", real(0.2)),
                ("CUNIT1", text("arcsec")),
            ],
        ];
        for header in headers {
            let found = wcs(&header).scale.unwrap();
            assert!((found - 0.2).abs() < 1e-12, "{header:?}: {found}");
        }
        let none = [
            vec![],
            vec![("CDELT1", real(1.0)), ("CDELT2", real(1.0))],
            vec![("PIXSCALE", text("small"))],
        ];
        for header in none {
            assert_eq!(wcs(&header).scale, None, "{header:?}");
        }
    }

    #[test]
    fn pixel_axes_differ_from_the_skys_by_rotation_parity_and_shear() {
        let (sine, cosine) = 30f64.to_radians().sin_cos();
        // The matrix gives (east, north) of a step along x and y. Angle, parity and shear are as they were put in.
        for (matrix, expected) in [
            ([-1.0, 0.0, 0.0, 1.0], None),
            // Half a turn does not change an ellipticity.
            ([1.0, 0.0, 0.0, -1.0], None),
            ([1.0, 0.0, 0.0, 1.0], Some((0.0, true, 0.0))),
            // +y at 30° from north to east.
            ([-cosine, sine, sine, cosine], Some((30.0, false, 0.0))),
            // DECam: x to the south and y to the east.
            ([0.0, 1.0, -1.0, 0.0], Some((90.0, true, 0.0))),
            // GalSim's ShearWCS of g1 = 0.1: the steps are 1 − g1 and 1 + g1.
            ([-0.9, 0.0, 0.0, 1.1], Some((0.0, false, 0.1))),
        ] {
            let found = sky(matrix).frame();
            let found = found.map(|warning| match warning {
                Warning::PixelFrame(PixelFrame {
                    angle,
                    mirrored,
                    shear,
                }) => {
                    // Rounding.
                    assert!(shear[1].abs() < 1e-12);
                    let rounded = |value: f64| (value * 1e9).round() / 1e9 + 0.0;
                    (rounded(angle), mirrored, rounded(shear[0]))
                }
                other => panic!("{other}"),
            });
            assert_eq!(found, expected, "{matrix:?}");
        }
        let same = wcs(&sky([-cosine, sine, sine, cosine]).keys());
        let turned = Warning::PixelFrame(frame(&same.jacobian.unwrap())).to_string();
        assert!(
            turned.contains("+y at position angle 30.0°, not mirrored"),
            "{turned}"
        );
        assert!((same.scale.unwrap() - 0.2).abs() < 1e-12);
        // The same rotation in the words of AIPS, and with steps and a matrix.
        let steps = [("CDELT1", real(-DEGREES)), ("CDELT2", real(DEGREES))];
        let [a, b] = steps.clone();
        let aips = wcs(&[a, b, ("CROTA2", real(-30.0))]);
        let [a, b] = steps;
        let pc = [cosine, -sine, sine, cosine].map(real);
        let keys: Vec<_> = [a, b]
            .into_iter()
            .chain(STEPLESS.into_iter().zip(pc))
            .collect();
        for other in [aips, wcs(&keys)] {
            assert_eq!(Wcs::disagreements(&other, &same).count(), 0, "{other:?}");
        }
    }

    #[test]
    fn a_psf_of_other_pixels_is_reported() {
        let scale = |scale| Wcs {
            scale,
            jacobian: None,
        };
        let kinds = |psf: &Wcs, galaxies: &Wcs| {
            let found = Wcs::disagreements(psf, galaxies);
            found.map(|warning| warning.kind()).collect::<Vec<_>>()
        };
        // Rounding.
        assert!(kinds(&scale(Some(0.2)), &scale(Some(0.2001))).is_empty());
        assert!(kinds(&scale(None), &scale(Some(0.2))).is_empty());
        assert_eq!(
            kinds(&scale(Some(0.263)), &scale(Some(0.2))),
            ["pixel-scale"]
        );
        let plain = sky([-1.0, 0.0, 0.0, 1.0]);
        assert!(kinds(&plain, &sky([-1.001, 0.0, 0.0, 0.999])).is_empty());
        for other in [
            [0.0, 1.0, -1.0, 0.0],
            [1.0, 0.0, 0.0, -1.0],
            [-0.98, 0.0, 0.0, 1.02],
        ] {
            assert_eq!(kinds(&sky(other), &plain), ["psf-frame"], "{other:?}");
        }
    }
}
