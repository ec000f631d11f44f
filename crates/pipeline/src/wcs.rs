//! What headers state of an image's pixels on the sky: to detect a PSF that is sampled in other pixels than the galaxies, and
//! ellipticities that are not along the sky's axes.

mod header;
mod map;
mod unit;

use shearq_files::FileError;
use shearq_files::fits::{ImageReader, Value};
use shearq_measure::{Detector, PixelFrame, Warning};
use shearq_quantities::linear::{Matrix2, determinant, inverse, product};

pub(crate) use self::header::{Keys, Wcs};
use self::map::{Map, Projection, regular_inverse};

// Keys of the matrix from pixels to the sky.
const CD_KEYS: [&str; 4] = ["CD1_1", "CD1_2", "CD2_1", "CD2_2"];
/// Projections that are read, in the words of messages.
pub(crate) const READ_PROJECTIONS: &str = "TAN, TAN-SIP, TPV, SIN, STG, CAR or a linear one";
// Least relative difference of scales that is reported: it changes m by about as much.
const MIN_PIXEL_DIFFERENCE: f64 = 0.01;
// Relative difference of the pixels of stamps from those at the reference point, by a distortion, above which stamps without places
// are refused: it adds as much to c. Chosen by hand: a tenth of what surveys require.
const MAX_DISTORTION: f64 = 1e-4;
// Rotation in degrees and shear of the pixels below which pixel axes count as the sky's. They change m by −2 sin² 0.01° and add
// 4e-4 of g2 to g1, and 1e-4 to c: less than what calibrations reach.
const ALIGNED_DEGREES: f64 = 0.01;
const ALIGNED_SHEAR: f64 = 1e-4;

impl Wcs {
    pub(crate) fn of_header(image: &mut ImageReader) -> Result<Self, FileError> {
        Ok(Wcs::of_keys(&Keys::new(image.cards()?)))
    }

    /// Derivatives of (u, v) by x (first column) and y in arcseconds at a pixel, with u to the west and v to the north.
    pub(crate) fn jacobian(&self, at: [f64; 2]) -> Option<Matrix2> {
        Some(self.map.as_ref()?.sky(at).1)
    }

    /// The same at the reference point.
    pub(crate) fn reference(&self) -> Option<Matrix2> {
        let map = self.map.as_ref()?;
        Some(match map.projection {
            Projection::Plane => map.matrix,
            Projection::Sky { .. } => {
                let plain = Map {
                    sip: None,
                    ..map.clone()
                };
                plain.sky(map.origin).1
            }
        })
    }

    /// Why the pixels of several stamps are not known from the header of their cube, which an exposure with a distortion had:
    /// `at` is the middle of the stamps.
    pub(crate) fn fault_of_cube(&self, planes: usize, at: [f64; 2]) -> Option<String> {
        let map = self.map.as_ref().filter(|map| map.is_distorted())?;
        let [[xx, xy], [yx, yy]] = product(inverse(self.reference()?), map.sky(at).1);
        let off = [xx - 1.0, xy, yx, yy - 1.0].map(f64::abs);
        let off = off.into_iter().fold(0.0, f64::max);
        (planes > 1 && off > MAX_DISTORTION).then(|| {
            format!(
                "the header of a cube of {planes} stamps has the distorted WCS of an exposure, and the places of the stamps on it are not known (found pixels that differ by {off:.4} from those at the reference point; expected at most {MAX_DISTORTION})"
            )
        })
    }

    /// Arcseconds per pixel.
    pub(crate) fn scale(&self) -> Option<f64> {
        self.scale
    }

    pub(crate) fn detector(&self) -> Detector {
        self.detector
    }

    /// Pixels of a PSF along a pixel of the galaxies.
    pub(crate) fn oversampling(&self) -> Option<f64> {
        self.oversampling
    }

    /// Keys that state where the image is in a larger one, if it is a section of one.
    pub(crate) fn section(&self) -> Option<&str> {
        self.section.as_deref()
    }

    pub(crate) fn has_sky(&self) -> bool {
        let projection = self.map.as_ref().map(|map| &map.projection);
        matches!(projection, Some(Projection::Sky { .. }))
    }

    /// Right ascension and declination of a pixel in degrees.
    pub(crate) fn sky(&self, at: [f64; 2]) -> Option<[f64; 2]> {
        self.map.as_ref()?.sky(at).0
    }

    /// The pixel of a right ascension and declination in degrees.
    pub(crate) fn pixel(&self, sky: [f64; 2]) -> Option<[f64; 2]> {
        self.map.as_ref()?.pixel_of(sky)
    }

    /// The pixel that has the place on the sky of a pixel of another image. `None` for those that are not on this one, where a distortion may
    /// lead back to its pixels.
    pub(crate) fn place_of(&self, other: &Self, at: [f64; 2]) -> Option<[f64; 2]> {
        let place = self.pixel(other.sky(at)?)?;
        let [there, here] = [self.reference()?, self.jacobian(place)?].map(determinant);
        let is_finite = place.iter().all(|at| at.is_finite());
        (is_finite && there * here > 0.0).then_some(place)
    }

    /// The projection of a header that is not read.
    pub(crate) fn unread(&self) -> Option<&str> {
        self.unread.as_deref()
    }

    /// What is wrong with a header that states a WCS but gives no places on the sky; `None` for a usable WCS, and without one.
    pub(crate) fn fault(&self) -> Option<String> {
        let expected = format!("expected {READ_PROJECTIONS}");
        match (&self.damage, &self.unread) {
            (Some(damage), _) => Some(damage.clone()),
            (None, Some(kind)) => Some(format!("the projection {kind} is not read ({expected})")),
            (None, None) => None,
        }
    }

    /// Keys that state the same of an image of other stamps of these pixels, as GalSim writes and reads them.
    pub(crate) fn keys(&self) -> Vec<(&'static str, Value)> {
        let Detector { gain, saturation } = self.detector;
        let stated = [("GAIN", gain), ("SATURATE", saturation)];
        let stated = stated
            .into_iter()
            .filter_map(|(key, value)| Some((key, Value::Real(value?))));
        let Some([[xx, xy], [yx, yy]]) = self.reference() else {
            return stated.collect();
        };
        let text = |text: &str| Value::Text(text.into());
        // Without a reference point, because the stamps are not where the image of the header had them.
        let mut keys = vec![("GS_WCS", text("JacobianWCS"))];
        keys.extend(["CTYPE1", "CTYPE2"].map(|key| (key, text("LINEAR"))));
        keys.extend(["CUNIT1", "CUNIT2"].map(|key| (key, text("arcsec"))));
        let matrix = [xx, xy, yx, yy].map(Value::Real);
        keys.extend(CD_KEYS.into_iter().zip(matrix));
        keys.extend(stated);
        keys
    }

    /// What of the header is used against its name, or not used.
    pub(crate) fn doubts(&self) -> &[String] {
        &self.doubts
    }

    pub(crate) fn of_jacobian(matrix: Matrix2) -> Self {
        Wcs {
            scale: Some(determinant(matrix).abs().sqrt()),
            map: Some(Map {
                origin: [0.0; 2],
                sip: None,
                matrix,
                projection: Projection::Plane,
            }),
            ..Wcs::default()
        }
    }

    pub(crate) fn states_axes(&self) -> bool {
        self.reference().is_some()
    }

    /// A warning if the ellipticities along these pixels are not along the sky's axes.
    pub(crate) fn frame(&self) -> Option<Warning> {
        let jacobian = self.reference()?;
        (!aligned(&jacobian)).then(|| Warning::PixelFrame(PixelFrame::from_jacobian(jacobian)))
    }

    /// Warnings if the PSF and the galaxies state different pixels.
    pub(crate) fn disagreements(psf: &Self, galaxies: &Self) -> impl Iterator<Item = Warning> {
        let scale = || scale_difference(psf.scale?, galaxies.scale?);
        let frames = || {
            let (psf, galaxies) = (psf.reference()?, galaxies.reference()?);
            regular_inverse(psf)?;
            // A rotation that both have in common does no harm: the PSF is deconvolved in the pixels of the galaxies.
            let differs = PixelFrame::differ(psf, galaxies);
            differs.then(|| Warning::PsfFrame {
                psf: PixelFrame::from_jacobian(psf),
                galaxies: PixelFrame::from_jacobian(galaxies),
            })
        };
        scale().into_iter().chain(frames())
    }
}

/// A warning if the pixels of a PSF and of galaxies have these scales in arcseconds.
pub(crate) fn scale_difference(psf: f64, galaxies: f64) -> Option<Warning> {
    let differs = (psf / galaxies - 1.0).abs() > MIN_PIXEL_DIFFERENCE;
    differs.then_some(Warning::PixelScale { psf, galaxies })
}

/// Whether ellipticities along the pixel axes are ellipticities along the sky's.
pub(crate) fn aligned(jacobian: &Matrix2) -> bool {
    let frame = PixelFrame::from_jacobian(*jacobian);
    // Ellipticities do not change by half a turn.
    let turned = (frame.angle + 90.0).rem_euclid(180.0) - 90.0;
    !frame.mirrored
        && turned.abs() <= ALIGNED_DEGREES
        && frame.shear[0].hypot(frame.shear[1]) <= ALIGNED_SHEAR
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use shearq_files::fits::ImageWriter;

    use super::*;

    fn wcs(keys: &[(&str, Value)]) -> Wcs {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image.fits");
        let mut writer = ImageWriter::create(&path, 2, 2, keys).unwrap();
        writer.write_rows(&[0.0; 4]).unwrap();
        writer.finish().unwrap();
        Wcs::of_header(&mut ImageReader::open(&path).unwrap()).unwrap()
    }

    #[test]
    fn a_wcs_with_a_letter_alone_is_named() {
        let wcs = Wcs::of_keys(&Keys::new(BTreeMap::from([(
            "CTYPE1A".into(),
            "'RA---TAN'".into(),
        )])));
        assert_eq!(wcs.jacobian([1.0, 1.0]), None);
        assert!(wcs.doubts()[0].contains("found CTYPE1A"));
        assert!(
            Wcs::of_keys(&Keys::new(BTreeMap::new()))
                .doubts()
                .is_empty()
        );
    }

    fn of_cards(cards: &[(&str, &str)]) -> Wcs {
        let cards = cards
            .iter()
            .map(|(key, value)| ((*key).into(), (*value).into()));
        Wcs::of_keys(&Keys::new(cards.collect()))
    }

    #[test]
    fn steps_units_and_levels_are_those_of_the_pixels() {
        for (key, value, expected) in [
            ("PSF_SAMP", "0.5", Some(2.0)),
            // Pixels of the galaxies per pixel of the PSF, which is coarser.
            ("PSF_SAMP", "2.0", Some(0.5)),
            ("SAMPLING", "2", Some(2.0)),
            ("SAMPLING", "-1", None),
        ] {
            assert_eq!(of_cards(&[(key, value)]).oversampling(), expected, "{key}");
        }
        for (unit, gain, saturation) in [
            ("'adu'", Some(1.5), Some(6e4)),
            ("'nJy'", None, None),
            ("'electron s-1'", Some(100.0), None),
            ("'ELECTRONS/S'", Some(100.0), None),
            ("'MJy/sr'", None, None),
        ] {
            let keys = [
                ("BUNIT", unit),
                ("GAIN", "1.5"),
                ("EXPTIME", "100"),
                ("SATURATE", "60000"),
            ];
            let found = of_cards(&keys).detector();
            assert_eq!((found.gain, found.saturation), (gain, saturation), "{unit}");
        }
    }

    #[test]
    fn plates_whose_pole_is_the_southern_one_are_not_read() {
        let fault = |more: &[(&str, &str)]| {
            let mut cards = vec![
                ("CTYPE1", "'RA---CAR'"),
                ("CTYPE2", "'DEC--CAR'"),
                ("CRPIX1", "1"),
                ("CRPIX2", "1"),
                ("CRVAL1", "10"),
                ("CD1_1", "-0.01"),
                ("CD2_2", "0.01"),
            ];
            cards.extend(more);
            of_cards(&cards).fault()
        };
        assert_eq!(fault(&[("CRVAL2", "40")]), None);
        assert!(fault(&[("CRVAL2", "40"), ("LATPOLE", "0")]).is_some());
        assert!(fault(&[("CRVAL2", "90")]).is_some());
    }

    // The name of a header, its cards, and places with derivatives.
    type Header = (String, BTreeMap<String, String>, Vec<[f64; 8]>);

    /// Headers of lines `KEY = VALUE`, with lines `at` of places and derivatives.
    fn headers(text: &str) -> Vec<Header> {
        let mut found: Vec<(String, BTreeMap<_, _>, Vec<_>)> = Vec::new();
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            if line.starts_with('[') {
                found.push((line.to_owned(), BTreeMap::new(), Vec::new()));
                continue;
            }
            let Some((_, keys, places)) = found.last_mut() else {
                continue;
            };
            if let Some((key, value)) = line.split_once(" = ") {
                keys.insert(key.to_owned(), value.to_owned());
            } else if let Some(numbers) = line.strip_prefix("at ") {
                let numbers: Vec<f64> = numbers.split(' ').map(|n| n.parse().unwrap()).collect();
                places.push(numbers.try_into().unwrap());
            }
        }
        found
    }

    #[test]
    fn places_and_derivatives_are_those_of_astropy() {
        let mut checked = 0;
        for (name, keys, places) in headers(include_str!("wcs/astropy.txt")) {
            let wcs = Wcs::of_keys(&Keys::new(keys));
            for [x, y, ra, dec, ux, uy, vx, vy] in places {
                let sky = wcs.sky([x, y]).unwrap();
                // 1e-6 px are 6e-11 degrees.
                let off = [(sky[0] - ra) * dec.to_radians().cos(), sky[1] - dec];
                assert!(off[0].hypot(off[1]) < 2e-11, "{name} {x} {y}: {sky:?}");
                let back = wcs.pixel([ra, dec]).unwrap();
                let error = (back[0] - x).hypot(back[1] - y);
                assert!(error < 1e-6, "{name} {x} {y}: {back:?}");
                let found = wcs.jacobian([x, y]).unwrap();
                for (found, expected) in found.as_flattened().iter().zip([ux, uy, vx, vy]) {
                    assert!((found - expected).abs() < 2e-8, "{name} {x} {y}: {found}");
                }
                checked += 1;
            }
        }
        assert_eq!(checked, 133);
        let wcs = sky([-1.0, 0.0, 0.0, 1.0]);
        assert_eq!(wcs.pixel([180.0, 0.0]), None);
    }

    #[test]
    fn keys_of_distortions_are_used_or_named() {
        let tan = "CTYPE1 = 'RA---TAN'\nCTYPE2 = 'DEC--TAN'\nCD1_1 = -7e-5\nCD2_2 = 7e-5\n";
        let sip = "CTYPE1 = 'RA---TAN-SIP'\nCTYPE2 = 'DEC--TAN-SIP'\nCD1_1 = -7e-5\nCD2_2 = 7e-5\n";
        let orders = "A_ORDER = 2\nB_ORDER = 2\nA_2_0 = 1e-6\nB_0_2 = 1e-6\n";
        let said = |start: &str, more: &str| {
            let text = format!("[]\n{start}{more}");
            let (_, keys, _) = headers(&text).remove(0);
            let wcs = Wcs::of_keys(&Keys::new(keys));
            wcs.fault()
                .into_iter()
                .chain(wcs.doubts)
                .collect::<String>()
        };
        for (start, more, words) in [
            (tan, "", ""),
            // Without effect.
            (
                tan,
                "CROTA2 = 3\nPV1_1 = 0\nPV2_2 = 0\nLATPOLE = 4\nCD1_1A = 5",
                "",
            ),
            (sip, orders, ""),
            (sip, "AP_ORDER = 2\nAP_2_0 = 1", ""),
            (
                tan,
                orders,
                "has SIP coefficients (A_ORDER, B_ORDER), and CTYPE1 is RA---TAN ",
            ),
            (tan, "A_2_0 = 1e-6", "the WCS has A_2_0, whose distortion"),
            (sip, "A_ORDER = 2", "one of A_ORDER and B_ORDER"),
            (sip, "A_ORDER = 2\nB_ORDER = 1\nB_2_0 = 1", "B_2_0, whose"),
            (
                sip,
                "A_ORDER = 2\nB_ORDER = 2\nPV1_1 = 1\nPV1_7 = 2",
                "PV1_1, PV1_7 of the WCS are not used",
            ),
            (
                tan,
                "PV2_1 = 1.01",
                "PV2_1 of the WCS are not used, because its projection",
            ),
            (
                tan,
                "CPDIS1 = 'Lookup'\nD2IMDIS2 = 'Lookup'\nCPERR1 = 0.073",
                "CPDIS1, D2IMDIS2, whose distortion, up to 0.07 px, is",
            ),
            (tan, "CQDIS2 = 'TPD'", "CQDIS2, whose"),
            (
                tan,
                "AMDX1 = 67\nAMDX2 = 1\nAMDY1 = 3\nAMDY2 = 4\nAMDY3 = 5",
                "AMDX1 to AMDY3 (5 keys), whose",
            ),
            (
                "",
                "CTYPE1 = 'RA---TAN'\nCDELT1 = -1e-4\nCDELT2 = 1e-4\nCROTA1 = 30",
                "CROTA1 without CROTA2",
            ),
            (
                "",
                "CTYPE1 = 'RA---TAN'\nCDELT1 = -1e-4\nCDELT2 = 1e-4\nCROTA1 = 30\nCROTA2 = 30",
                "",
            ),
            (
                tan,
                "PC1_1 = 0.8\nCDELT1 = 1e-4\nCDELT2 = 1e-4",
                "two matrices",
            ),
            (tan, "PC1_1 = 1\nPC2_2 = 1\nCDELT1 = 1\nCDELT2 = 1", ""),
            (
                "",
                "CTYPE1 = 'PIXEL'\nCD1_1 = 1\nCD2_2 = 1\nCTYPE1A = 'RA---TAN'",
                "the WCS has the letter A",
            ),
            (
                "",
                "CTYPE1 = 'LINEAR'\nCD1_1 = 1\nCD2_2 = 1\nCTYPE1P = 'X'",
                "",
            ),
            (tan, "CTYPE1A = 'RA---TAN'", ""),
            (
                tan,
                "PC1_1 = -7\nPC002002 = 0.7\nCDELT1 = 1e-5\nCDELT2 = 1e-4",
                "",
            ),
            (
                tan,
                "CTYPE2 = 'DEC--SIN'",
                "the projections RA---TAN and DEC--SIN",
            ),
            (tan, "CUNIT1 = 'furlong'", "the unit of the WCS is furlong"),
            (tan, "PV1_7 = 'x'", "PV1_7 = 'x' (expected a number)"),
        ] {
            let found = said(start, more);
            let is_right = if words.is_empty() {
                found.is_empty()
            } else {
                found.contains(words)
            };
            assert!(is_right, "{more}: {found}");
        }
    }

    #[test]
    fn cubes_of_a_distorted_exposure_have_no_pixels() {
        let tan = "[]\nCTYPE1 = RA---TAN\nCTYPE2 = DEC--TAN\nCD1_1 = -7e-5\nCD2_2 = 7e-5\nCRPIX1 = 900\nCRPIX2 = 2000\n";
        let sip = "A_ORDER = 2\nB_ORDER = 2\nA_2_0 = 3e-6\n";
        let fault = |more: &str, planes| {
            let (_, keys, _) = headers(&format!("{tan}{more}")).remove(0);
            Wcs::of_keys(&Keys::new(keys)).fault_of_cube(planes, [24.5, 24.5])
        };
        assert_eq!(fault("", 9), None);
        assert_eq!(fault(sip, 1), None);
        let found = fault(sip, 9).unwrap();
        // 2 · 3e-6 · 875.5.
        assert!(
            found.contains("a cube of 9 stamps") && found.contains("0.0053"),
            "{found}"
        );
    }

    const DEGREES: f64 = 0.2 / 3600.0;

    fn real(value: f64) -> Value {
        Value::Real(value)
    }

    /// A header of right ascension and declination with this matrix, in units of the pixel scale.
    fn sky(matrix: [f64; 4]) -> Wcs {
        let matrix = matrix.map(|value| real(value * DEGREES));
        let keys = CD_KEYS.into_iter().zip(matrix);
        let kind = ("CTYPE1", Value::Text("RA---TAN".into()));
        wcs(&[kind].into_iter().chain(keys).collect::<Vec<_>>())
    }

    #[test]
    fn headers_state_finer_pixels_and_other_quantities() {
        let text = |text: &str| Value::Text(text.into());
        for (key, value, expected) in [
            ("OVERSAMP", real(4.0), Some(4.0)),
            ("PSF_SAMP", real(0.5), Some(2.0)),
            ("PSF_SAMP", real(0.333333), Some(3.0)),
            ("SAMPLING", real(0.25), Some(4.0)),
            ("SAMPLING", real(3.0), Some(3.0)),
            ("SAMPLING", text("point"), None),
            ("PSF_SAMP", real(0.0), None),
        ] {
            assert_eq!(wcs(&[(key, value)]).oversampling, expected, "{key}");
        }
        let gain = |unit: &str, gain: f64| {
            let keys = [
                ("BUNIT", text(unit)),
                ("GAIN", real(gain)),
                ("EXPTIME", real(10.0)),
            ];
            let found = wcs(&keys).detector.gain;
            // What `gather` writes to its images.
            assert_eq!(wcs(&wcs(&keys).keys()).detector.gain, found);
            found
        };
        assert_eq!(gain("adu", 2.5), Some(2.5));
        assert_eq!(gain("electron", 2.5), Some(1.0));
        assert_eq!(gain("ELECTRONS/S", 2.5), Some(10.0));
        assert_eq!(gain("counts/s", 2.5), Some(25.0));
        assert_eq!(gain("nJy", 2.5), None);
        assert_eq!(gain("", 0.0), None);
        let magnitudes = wcs(&[("BUNIT", text("mag"))]);
        assert!(magnitudes.doubts()[0].contains("BUNIT = mag"));
        assert!(wcs(&[("BUNIT", text("adu"))]).doubts().is_empty());
    }

    #[test]
    fn headers_state_the_scale_by_any_of_the_usual_keys() {
        let text = |text: &str| Value::Text(text.into());
        let headers = [
            vec![("PIXSCALE", real(0.2))],
            vec![("GS_SCALE", real(0.2)), ("CD1_1", real(5.0))],
            vec![("PIXSCAL1", real(0.2)), ("PIXSCAL2", real(0.2))],
            vec![("SECPIX", real(0.2))],
            vec![("PSCALE", real(0.2))],
            vec![
                ("PSCALE", real(60.0)),
                ("CD1_1", real(-DEGREES)),
                ("CD2_2", real(DEGREES)),
            ],
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
        for header in [
            vec![],
            vec![("CDELT1", real(1.0)), ("CDELT2", real(1.0))],
            vec![("PIXSCALE", text("small"))],
            vec![("SECPIX", text("0.2 0.2"))],
        ] {
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
            let found = sky(matrix).frame().map(|warning| {
                let Warning::PixelFrame(frame) = warning else {
                    panic!("{warning}");
                };
                // Rounding.
                assert!(frame.shear[1].abs() < 1e-12);
                let rounded = |value: f64| (value * 1e9).round() / 1e9 + 0.0;
                (
                    rounded(frame.angle),
                    frame.mirrored,
                    rounded(frame.shear[0]),
                )
            });
            assert_eq!(found, expected, "{matrix:?}");
        }
        let same = wcs(&sky([-cosine, sine, sine, cosine]).keys());
        let turned =
            Warning::PixelFrame(PixelFrame::from_jacobian(same.reference().unwrap())).to_string();
        assert!(
            turned.contains("rotated by 30.0° from north to east, not mirrored"),
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
            .chain(["PC1_1", "PC1_2", "PC2_1", "PC2_2"].into_iter().zip(pc))
            .collect();
        for other in [aips, wcs(&keys)] {
            assert_eq!(Wcs::disagreements(&other, &same).count(), 0, "{other:?}");
        }
    }

    #[test]
    fn a_psf_of_other_pixels_is_reported() {
        let scale = |scale| Wcs {
            scale,
            ..Wcs::default()
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
