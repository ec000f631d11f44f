//! The keys of a header that state its WCS. Each key of a rotation or distortion is used or named.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

use shearq_files::names_of;
use shearq_measure::Detector;
use shearq_quantities::linear::{Matrix2, determinant};

use super::map::{ARCSEC_PER_RADIAN, Map, Polynomial, Projection, SkyProjection};
use super::unit::other_than_light;

// Keys with the pixel scale in arcseconds: of surveys, of GalSim and of STPSF.
const PIXEL_SCALE_KEYS: [&str; 3] = ["PIXSCALE", "GS_SCALE", "PIXELSCL"];
// The same of observatories. Elsewhere PSCALE is the scale of a plate, so that a WCS comes first.
const OTHER_SCALE_KEYS: [&str; 3] = ["PIXSCAL1", "SECPIX", "PSCALE"];
// Keys of the pixels of a PSF along one of the galaxies: of STPSF and WebbPSF. PSFEx states the inverse, and programs disagree on SAMPLING.
const OVERSAMPLING_KEY: &str = "OVERSAMP";
const STEP_KEY: &str = "PSF_SAMP";
const AMBIGUOUS_KEY: &str = "SAMPLING";
// Ends of units per second.
const RATES: [&str; 7] = ["/S", "/SEC", "/SECOND", " S-1", ".S-1", " S**-1", " S^-1"];
// Keys of electrons per ADU.
const GAIN_KEYS: [&str; 2] = ["GAIN", "EGAIN"];
// Rounding of the inverse of such a step.
const MAX_STEP_ROUNDING: f64 = 1e-4;
// Largest order of SIP (Shupe et al. 2005, ASPC 347, 491): headers with more are damaged.
const MAX_SIP_ORDER: i32 = 9;
// Largest number of a coefficient PVi_m of TPV.
const MAX_TPV: usize = 39;
// Powers of x and y, or of r, of the coefficients of TPV for the first axis. The second axis has x and y exchanged
// (https://fits.gsfc.nasa.gov/registry/tpvwcs/tpv.html).
const TPV_ORDERS: i32 = 7;
// Least number m of a key PVi_m that only TPV has: for TAN, the standard has 0 to 4 on the axis of longitudes.
const MIN_TPV_ONLY: usize = 5;
// Ratio of the determinant to the sum of squares below which axes count as parallel. Chosen by hand; `Jacobian::new` compares with
// the longer axis alone.
const MIN_AREA_TO_SUM_OF_SQUARES: f64 = 1e-6;
// Largest difference of CD from PC with CDELT in units of their size: what writers round.
const MAX_MATRIX_DIFFERENCE: f64 = 1e-5;
// Keys of the pixels of a larger image (IRAF), with their values of an image that is no section.
const SECTION_KEYS: [(&str, f64); 4] = [
    ("LTV1", 0.0),
    ("LTV2", 0.0),
    ("LTM1_1", 1.0),
    ("LTM2_2", 1.0),
];
// Most keys that a message lists.
const MAX_NAMED_KEYS: usize = 4;
// Plausible scales in arcseconds. Headers without a sky have scales such as 1 degree per pixel.
const PLAUSIBLE_ARCSEC: std::ops::RangeInclusive<f64> = 1e-3..=60.0;

/// Values of the keys of a header as its cards have them, texts with their quotes.
pub(crate) struct Keys {
    values: BTreeMap<String, String>,
    used: RefCell<BTreeSet<String>>,
    /// The first key of a text where a number is needed.
    unreadable: RefCell<Option<String>>,
}

impl Keys {
    pub(crate) fn new(values: BTreeMap<String, String>) -> Self {
        Keys {
            values,
            used: RefCell::default(),
            unreadable: RefCell::default(),
        }
    }

    fn number(&self, key: &str) -> Option<f64> {
        let value = self.values.get(key).filter(|value| !value.is_empty())?;
        // FITS writes exponents of double precision as D.
        let number = value.replace(['D', 'd'], "E").parse().ok();
        match number {
            Some(_) => drop(self.used.borrow_mut().insert(key.to_owned())),
            // Other programs use PIXSCALE for text.
            None if PIXEL_SCALE_KEYS.contains(&key) || OTHER_SCALE_KEYS.contains(&key) => {}
            None => drop(self.unreadable.borrow_mut().get_or_insert(key.to_owned())),
        }
        number
    }

    fn text(&self, key: &str) -> String {
        let value = self.values.get(key).map_or("", String::as_str);
        value.trim_matches('\'').trim().to_ascii_uppercase()
    }

    /// Marks keys whose value another key states, or replaces by the standard.
    fn settle(&self, keys: [&String; 2]) {
        self.used.borrow_mut().extend(keys.map(String::clone));
    }

    fn has(&self, key: &str) -> bool {
        self.values.contains_key(key)
    }

    /// What is said of a WCS that has a letter, such as CTYPE1A, where there is none without, or one of pixels.
    fn lettered(&self, is_sought: impl Fn(&str) -> bool) -> Option<String> {
        let is_there = |letter: &char| {
            let key = format!("CTYPE1{letter}");
            self.has(&key) && is_sought(&self.text(&key))
        };
        let letter = ('A'..='Z').find(is_there)?;
        Some(format!(
            "the WCS has the letter {letter} (found CTYPE1{letter}), which is not read (expected keys without a letter). Ellipticities are along the pixel axes"
        ))
    }

    /// An element of the matrices CD and PC, also by its name before the standard, such as PC001002 (Pan-STARRS).
    fn element(&self, matrix: &str, [i, j]: [usize; 2]) -> Option<f64> {
        let found = self.number(&format!("{matrix}{i}_{j}"));
        found.or_else(|| self.number(&format!("{matrix}{i:03}{j:03}")))
    }

    /// The elements of CD or PC; without all of them, `None`.
    fn matrix(&self, name: &str, diagonal: f64) -> Option<Matrix2> {
        let found = [1, 2].map(|i| [1, 2].map(|j| self.element(name, [i, j])));
        let is_there = found.iter().flatten().any(Option::is_some);
        let absent = |i, j| if i == j { diagonal } else { 0.0 };
        is_there.then(|| [0, 1].map(|i| [0, 1].map(|j| found[i][j].unwrap_or(absent(i, j)))))
    }

    /// Pixels of a PSF along a pixel of the galaxies. Elsewhere the keys may be texts.
    fn oversampling(&self) -> Option<f64> {
        let number = |key: &str| self.values.get(key)?.parse::<f64>().ok();
        let of_step = || Some(number(STEP_KEY)?.recip());
        let of_either = || {
            let step = number(AMBIGUOUS_KEY)?;
            Some(step.max(step.recip()))
        };
        let stated = number(OVERSAMPLING_KEY).or_else(of_step).or_else(of_either);
        let stated = stated.filter(|stated| stated.is_finite() && *stated > 0.0)?;
        let is_rounded = (stated - stated.round()).abs() < MAX_STEP_ROUNDING * stated;
        Some(if is_rounded { stated.round() } else { stated })
    }

    /// Electrons per unit of the pixels, and the value of saturated ones.
    fn detector(&self) -> Detector {
        let number = |key: &str| {
            let value = self.values.get(key)?.parse::<f64>().ok()?;
            (value > 0.0 && value.is_finite()).then_some(value)
        };
        let unit = self.text("BUNIT");
        let unit = unit.trim();
        let of_rate = RATES.into_iter().find_map(|end| unit.strip_suffix(end));
        let (unit, is_rate) = (of_rate.unwrap_or(unit).trim(), of_rate.is_some());
        let gain = match unit {
            "ELECTRON" | "ELECTRONS" | "E" | "E-" => Some(1.0),
            "" | "ADU" | "DN" | "COUNT" | "COUNTS" => GAIN_KEYS.into_iter().find_map(number),
            // Calibrated pixels: the level of saturation is that of the raw ones.
            _ => return Detector::default(),
        };
        let time = if is_rate {
            number("EXPTIME")
        } else {
            Some(1.0)
        };
        Detector {
            gain: gain.zip(time).map(|(gain, time)| gain * time),
            saturation: number("SATURATE").filter(|_| !is_rate),
        }
    }

    /// What is said of pixels that are no light.
    fn unit_text(&self) -> Option<String> {
        let unit = self.values.get("BUNIT")?.trim_matches('\'').trim();
        other_than_light(unit).map(|found| {
            format!("the pixels are {found} (found BUNIT = {unit}; expected a unit of light, such as adu or electron), whose shapes are not those of the light. Try: the image of the light, or convert the pixels")
        })
    }

    /// The keys that state where the image is in a larger one.
    fn section(&self) -> Option<String> {
        let keys = SECTION_KEYS.into_iter().filter_map(|(key, own)| {
            // Text or NaN are no place.
            let value = self.values.get(key)?.parse::<f64>().ok()?;
            (value.is_finite() && value != own).then(|| format!("{key} = {value}"))
        });
        let keys: Vec<String> = keys.collect();
        (!keys.is_empty()).then(|| names_of(&keys))
    }

    /// Keys of rotations and distortions that are not used, although they are not zero.
    fn unused(&self) -> Vec<String> {
        let used = self.used.borrow();
        let unused = self.values.iter().filter(|(key, value)| {
            let is_zero = value.parse::<f64>().is_ok_and(|value| value == 0.0);
            is_distortion(key) && !used.contains(*key) && !is_zero
        });
        unused.map(|(key, _)| key.clone()).collect()
    }

    /// What is said of these keys.
    fn unused_text(&self, has_sip: bool) -> Option<String> {
        let unused = self.unused();
        let named = match unused.as_slice() {
            [] => return None,
            [first, .., last] if unused.len() > MAX_NAMED_KEYS => {
                format!("{first} to {last} ({} keys)", unused.len())
            }
            few => names_of(few),
        };
        let all = |start: &str| unused.iter().all(|key| key.starts_with(start));
        if has_sip && all("PV") {
            return Some(format!(
                "{named} of the WCS are not used, because the header states the distortion by SIP, too"
            ));
        }
        if all("PV") && self.text("CTYPE1").contains("SIN") {
            return Some(format!(
                "{named} of the WCS are not used (found a slant SIN projection, as of the NCP of radio astronomy; expected SIN without parameters), which moves positions by arcseconds far from the centre. Try: resample to TAN"
            ));
        }
        if all("PV") {
            return Some(format!(
                "{named} of the WCS are not used, because its projection has no such parameters (found {}, expected TPV for distortions of SCAMP). Try: {} for both CTYPE if they are such distortions",
                self.text("CTYPE1"),
                "RA---TPV and DEC--TPV"
            ));
        }
        if all("CROTA") {
            return Some(format!(
                "the WCS has {named} without CROTA2 (expected the rotation in CROTA2, which the standard prescribes), and is read without a rotation. Try: CROTA2, or CD1_1 to CD2_2"
            ));
        }
        // Tables state their largest displacement.
        let keys = ["CPERR1", "CPERR2", "D2IMERR1", "D2IMERR2"];
        let stated = keys.into_iter().filter_map(|key| self.number(key));
        let error = stated.reduce(f64::max);
        let error = error.map_or_else(String::new, |error| format!(", up to {error:.2} px,"));
        Some(format!(
            "the WCS has {named}, whose distortion{error} is not read (expected SIP or TPV). Places of ra and dec and the axes of ellipticities lack it"
        ))
    }
}

// Whether a key, of the coordinates that have no letter, changes where pixels are on the sky.
fn is_distortion(key: &str) -> bool {
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let axis = |text: &str| ["1", "2"].contains(&text);
    let pair = |text: &str| {
        text.split_once('_')
            .is_some_and(|(i, j)| digits(i) && digits(j))
    };
    let after = |names: &[&str]| names.iter().find_map(|name| key.strip_prefix(name));
    after(&["CROTA", "CPDIS", "CQDIS", "D2IMDIS", "AXISCORR"]).is_some_and(axis)
        || after(&["PV1_", "PV2_", "AMDX", "AMDY", "PROJP"]).is_some_and(digits)
        || after(&["A_", "B_"]).is_some_and(pair)
        || ["A_ORDER", "B_ORDER", "D2IMARR"].contains(&key)
}

/// Arcseconds of a unit; `None` if it is unknown. Without a unit they are degrees, as the standard prescribes, or arcseconds in the
/// planes of GalSim.
fn arcsec_of(unit: &str, gs_plane: bool) -> Option<f64> {
    Some(match unit {
        "" if gs_plane => 1.0,
        "" => 3600.0,
        _ if unit.starts_with("DEG") => 3600.0,
        "ARCSEC" | "ARCSECS" => 1.0,
        "ARCMIN" => 60.0,
        "MAS" => 1e-3,
        "RAD" => ARCSEC_PER_RADIAN,
        _ => return None,
    })
}

/// What a header states of pixels on the sky.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Wcs {
    /// Arcseconds per pixel.
    pub(super) scale: Option<f64>,
    pub(super) map: Option<Map>,
    /// CTYPE1 if it is a projection that is not read: only the matrix is used then.
    pub(super) unread: Option<String>,
    /// What is wrong with the numbers, if they give no map.
    pub(super) damage: Option<String>,
    /// What of the header is used against its name, or not used.
    pub(super) doubts: Vec<String>,
    /// Keys that state where the image is in a larger one.
    pub(super) section: Option<String>,
    pub(super) detector: Detector,
    /// Pixels of a PSF along a pixel of the galaxies.
    pub(super) oversampling: Option<f64>,
}

impl Wcs {
    pub(crate) fn of_keys(keys: &Keys) -> Self {
        let mut wcs = Wcs {
            section: keys.section(),
            detector: keys.detector(),
            oversampling: keys.oversampling(),
            ..Wcs::of_readable(keys)
        };
        wcs.doubts.extend(keys.unit_text());
        let unreadable = keys.unreadable.borrow().clone();
        // Without this key, the others would place galaxies elsewhere on the sky.
        match unreadable {
            None => wcs,
            Some(key) => wcs.damaged(format!(
                "the WCS has {key} = '{}' (expected a number)",
                keys.values[&key].trim_matches(['\'', ' '])
            )),
        }
    }

    fn damaged(self, damage: String) -> Self {
        Wcs {
            scale: self.scale,
            damage: Some(damage),
            section: self.section,
            detector: self.detector,
            oversampling: self.oversampling,
            ..Wcs::default()
        }
    }

    #[expect(clippy::too_many_lines, reason = "each key of a header in turn")]
    fn of_readable(keys: &Keys) -> Self {
        let kinds = ["CTYPE1", "CTYPE2"].map(|key| keys.text(key));
        let kind = kinds[0].as_str();
        let plane = kind == "LINEAR";
        let gs_plane = plane && !keys.text("GS_WCS").is_empty();
        let is_latitude = |kind: &str| kind.starts_with("DEC") || kind.get(1..4) == Some("LAT");
        let is_longitude = |kind: &str| kind.starts_with("RA") || kind.get(1..4) == Some("LON");
        let is_sky = |kind: &str| is_latitude(kind) || is_longitude(kind);
        let (latitude_first, named) = (is_latitude(kind), is_sky(kind));
        let equatorial = kind.starts_with("DEC") || kind.starts_with("RA");
        let longitude = usize::from(latitude_first);

        let of = |all: [&str; 3]| all.into_iter().find_map(|key| keys.number(key));
        let (stated, other) = (of(PIXEL_SCALE_KEYS), of(OTHER_SCALE_KEYS));
        let mut units = ["CUNIT1", "CUNIT2"].map(|key| keys.text(key));
        if units[1].is_empty() {
            units[1] = units[0].clone();
        }
        // Images without a sky have other units, and no scale.
        let arcsec = units.each_ref().map(|unit| arcsec_of(unit, gs_plane));
        let matrix = matrix(keys, 2 - longitude);
        let only_scale = |matrix: Option<Matrix2>| Wcs {
            scale: stated
                .or(matrix.map(|matrix| determinant(matrix).abs().sqrt()))
                .or(other)
                .filter(|scale| PLAUSIBLE_ARCSEC.contains(scale)),
            ..Wcs::default()
        };
        let matrix = match matrix {
            Ok(None) => {
                return Wcs {
                    doubts: keys.lettered(|_| true).into_iter().collect(),
                    ..only_scale(None)
                };
            }
            Ok(Some(matrix)) => matrix,
            Err(damage) => return only_scale(None).damaged(damage),
        };
        let [Some(first), Some(second)] = arcsec else {
            let unit = units[usize::from(arcsec[0].is_some())].to_lowercase();
            let expected = "expected deg, arcmin, arcsec, mas or rad";
            return match named {
                true => {
                    only_scale(None).damaged(format!("the unit of the WCS is {unit} ({expected})"))
                }
                false => only_scale(None),
            };
        };
        let units = [first, second];
        let [first, second] = [0, 1].map(|i| matrix[i].map(|value| value * units[i]));
        let Wcs { scale, .. } = only_scale(Some([first, second]));
        let projections = kinds
            .each_ref()
            .map(|kind| kind.get(5..8).unwrap_or_default());
        if named && !kinds[1].is_empty() && projections[0] != projections[1] {
            return only_scale(None).damaged(format!(
                "the axes have the projections {} and {} (expected one)",
                kinds[0], kinds[1]
            ));
        }
        let origin = ["CRPIX1", "CRPIX2"].map(|key| keys.number(key).unwrap_or(0.0));
        let centre = [0, 1].map(|i| {
            let value = keys.number(["CRVAL1", "CRVAL2"][i]).unwrap_or(0.0);
            value * units[i] / 3600.0
        });
        let (ra, dec) = (centre[longitude], centre[1 - longitude]);
        let kind_of_sky = match projections[0] {
            _ if !equatorial => None,
            "TAN" | "TPV" => Some(SkyProjection::Gnomonic),
            "STG" => Some(SkyProjection::Stereographic),
            "SIN" => Some(SkyProjection::Orthographic),
            "CAR" if is_upright(keys, dec) => Some(SkyProjection::PlateCarree),
            _ => None,
        };
        let Some(kind_of_sky) = kind_of_sky else {
            let west = |row: [f64; 2]| row.map(|value| -value);
            let matrix = match (plane, latitude_first) {
                (true, _) => [first, second],
                (_, true) => [west(second), first],
                // Unnamed axes are right ascension and declination if one of them is reversed.
                _ if named || determinant(matrix) < 0.0 => [west(first), second],
                _ => [first, second],
            };
            return Wcs {
                scale,
                map: Some(Map {
                    origin,
                    sip: None,
                    matrix,
                    projection: Projection::Plane,
                }),
                unread: named.then(|| match kind {
                    "CAR" if equatorial => format!("{kind} with a turned north"),
                    _ => kind.to_owned(),
                }),
                // Of projections that are not read, none is.
                doubts: match named {
                    true => Vec::new(),
                    false => {
                        let lettered = keys.lettered(is_sky).filter(|_| !gs_plane);
                        keys.unused_text(false)
                            .into_iter()
                            .chain(lettered)
                            .collect()
                    }
                },
                ..Wcs::default()
            };
        };
        let degrees = |row: [f64; 2]| row.map(|value| value / 3600.0);
        let distortion = match Distortion::of(keys, &kinds, longitude) {
            Ok(distortion) => distortion,
            Err(damage) => return only_scale(None).damaged(damage),
        };
        // The default of LONPOLE for zenithal projections; PVi_3 of the axis of longitudes replaces the key (Calabretta & Greisen
        // 2002).
        let default = if dec >= 90.0 { 0.0 } else { 180.0 };
        let by_pv = match distortion.tpv {
            None => keys.number(&format!("PV{}_3", longitude + 1)),
            Some(_) => None,
        };
        let lonpole = match kind_of_sky {
            SkyProjection::PlateCarree => 180.0,
            _ => by_pv.or_else(|| keys.number("LONPOLE")).unwrap_or(default),
        };
        let Distortion {
            sip,
            tpv,
            mut doubts,
        } = distortion;
        doubts.extend(keys.unused_text(sip.is_some()));
        Wcs {
            scale,
            map: Some(Map {
                origin,
                sip,
                matrix: match latitude_first {
                    true => [degrees(second), degrees(first)],
                    false => [degrees(first), degrees(second)],
                },
                projection: Projection::Sky {
                    kind: kind_of_sky,
                    ra,
                    dec,
                    lonpole: lonpole.to_radians(),
                    tpv,
                },
            }),
            doubts,
            ..Wcs::default()
        }
    }
}

/// Whether north is up at the reference point of CAR, as it is by default: native longitudes of the pole other than 0 for northern
/// points and 180° for southern ones have no solution, or turn the sphere (Calabretta & Greisen 2002, eq. 8 to 10).
fn is_upright(keys: &Keys, dec: f64) -> bool {
    let of = |key: &str, default: f64| keys.number(key).unwrap_or(default);
    let up = match of("LONPOLE", if dec >= 0.0 { 0.0 } else { 180.0 }) {
        0.0 => dec >= 0.0,
        180.0 => dec <= 0.0,
        _ => false,
    };
    let moved = [
        "PV1_1", "PV1_2", "PV1_3", "PV1_4", "PV2_1", "PV2_2", "PV2_3", "PV2_4",
    ];
    // Two poles are as near to a LATPOLE of 0, and the southern one is taken.
    up && dec < 90.0 && of("LATPOLE", 90.0) > 0.0 && !moved.iter().any(|key| keys.has(key))
}

/// The matrix from pixels to the units of the axes. A header of zeros has none.
fn matrix(keys: &Keys, latitude: usize) -> Result<Option<Matrix2>, String> {
    let size = |m: &Matrix2| m.iter().flatten().map(|v| v * v).sum::<f64>();
    let cd = keys.matrix("CD", 0.0).filter(|matrix| size(matrix) > 0.0);
    if cd.is_some() {
        keys.settle([&"CROTA1".into(), &"CROTA2".into()]);
    }
    let scaled = scaled(keys, latitude).filter(|(matrix, _)| size(matrix) > 0.0);
    let found = match (cd, scaled) {
        // Writers add PC and CDELT of one to a CD, which turn and scale nothing.
        (Some(cd), Some((pc, true))) if pc != [[1.0, 0.0], [0.0, 1.0]] => {
            let difference: Matrix2 = [0, 1].map(|i| [0, 1].map(|j| cd[i][j] - pc[i][j]));
            if size(&difference) > MAX_MATRIX_DIFFERENCE.powi(2) * size(&cd) {
                return Err(format!(
                    "the WCS has two matrices, CD of {} and PC with CDELT of {} (expected one)",
                    listed(cd),
                    listed(pc)
                ));
            }
            Some(cd)
        }
        (Some(cd), _) => Some(cd),
        (None, scaled) => scaled.map(|(matrix, _)| matrix),
    };
    match found {
        // Relative to its size: rounded numbers of parallel axes leave a small determinant.
        Some(matrix) if determinant(matrix).abs() <= MIN_AREA_TO_SUM_OF_SQUARES * size(&matrix) => {
            Err(format!(
                "the matrix of the WCS, CD or PC with CDELT, is singular (found {}; expected one with an inverse)",
                listed(matrix)
            ))
        }
        found => Ok(found),
    }
}

fn listed([[a, b], [c, d]]: Matrix2) -> String {
    format!("{a}, {b}, {c}, {d}")
}

/// PC with CDELT, and that there is a PC; or the older rotation with CDELT.
fn scaled(keys: &Keys, latitude: usize) -> Option<(Matrix2, bool)> {
    let steps = ["CDELT1", "CDELT2"].map(|key| keys.number(key));
    // Before there was a matrix, the axis of latitudes had the angle, from it to the axis of longitudes; many programs wrote it for
    // both axes (Calabretta & Greisen 2002, eq. 189).
    let [angle, other] = [latitude, 3 - latitude].map(|axis| format!("CROTA{axis}"));
    let pc = keys.matrix("PC", 1.0);
    if pc.is_some() || keys.values.get(&angle) == keys.values.get(&other) {
        keys.settle([&angle, &other]);
    }
    if let Some(pc) = pc {
        let scaled = [0, 1].map(|i| pc[i].map(|value| value * steps[i].unwrap_or(1.0)));
        return Some((scaled, true));
    }
    let [Some(x), Some(y)] = steps else {
        return None;
    };
    let (sine, cosine) = keys.number(&angle).unwrap_or(0.0).to_radians().sin_cos();
    let sine = if latitude == 1 { -sine } else { sine };
    Some(([[x * cosine, -y * sine], [x * sine, y * cosine]], false))
}

struct Distortion {
    sip: Option<[Polynomial; 2]>,
    tpv: Option<[Polynomial; 2]>,
    doubts: Vec<String>,
}

impl Distortion {
    // Headers with both kinds state one distortion twice. The name of the axes decides, as in astropy.
    fn of(keys: &Keys, kinds: &[String; 2], longitude: usize) -> Result<Self, String> {
        let has_suffix = kinds.iter().any(|kind| kind.ends_with("-SIP"));
        let is_tpv = kinds[0].get(5..8) == Some("TPV");
        // SCAMP wrote distortions of TPV under the name TAN.
        let scamp = || {
            let is_tan = kinds[0].get(5..8) == Some("TAN");
            let mut only_tpv = MIN_TPV_ONLY..=MAX_TPV;
            is_tan && only_tpv.any(|m| [1, 2].iter().any(|i| keys.has(&format!("PV{i}_{m}"))))
        };
        if is_tpv || !has_suffix && scamp() {
            let axes = [longitude, 1 - longitude];
            return Ok(Distortion {
                sip: None,
                tpv: Some(axes.map(|axis| tpv_of(keys, axis, axis == longitude))),
                doubts: Vec::new(),
            });
        }
        let orders = ["A_ORDER", "B_ORDER"].map(|key| keys.number(key));
        let (sip, mut doubts) = match orders {
            [Some(a), Some(b)] => {
                let axes = [("A", a), ("B", b)];
                (
                    Some(axes.map(|(name, order)| sip(keys, name, order))),
                    Vec::new(),
                )
            }
            [None, None] => (None, Vec::new()),
            _ => return Err("the WCS has one of A_ORDER and B_ORDER (expected both)".to_owned()),
        };
        if sip.is_some() && !has_suffix {
            doubts.push(format!(
                "the WCS has SIP coefficients (A_ORDER, B_ORDER), and CTYPE1 is {} (expected RA---TAN-SIP). They are used. Try: remove them if the image is resampled",
                kinds[0]
            ));
        }
        Ok(Distortion {
            sip,
            tpv: None,
            doubts,
        })
    }
}

/// The coefficients of an axis of SIP, `A` or `B`, of offsets from the reference pixel.
fn sip(keys: &Keys, name: &str, order: f64) -> Polynomial {
    let order = (order as i32).min(MAX_SIP_ORDER);
    let powers = (0..=order).flat_map(|i| (0..=order - i).map(move |j| [i, j]));
    let terms =
        powers.filter_map(|[i, j]| Some(([i, j], keys.number(&format!("{name}_{i}_{j}"))?)));
    Polynomial {
        terms: terms.collect(),
        radial: Vec::new(),
    }
}

/// The coefficients of an axis of TPV, from 0, in degrees, by longitude and latitude.
fn tpv_of(keys: &Keys, axis: usize, is_longitude: bool) -> Polynomial {
    let factor = |m: usize| keys.number(&format!("PV{}_{m}", axis + 1));
    let (mut terms, mut radial) = (Vec::new(), Vec::new());
    let mut m = 0;
    for order in 0..=TPV_ORDERS {
        for j in 0..=order {
            // Without PVi_1 the coordinate itself, as the convention prescribes.
            let factor = factor(m).or((m == 1).then_some(1.0));
            let powers = if is_longitude {
                [order - j, j]
            } else {
                [j, order - j]
            };
            terms.extend(factor.map(|factor| (powers, factor)));
            m += 1;
        }
        if order % 2 == 1 {
            radial.extend(factor(m).map(|factor| (order, factor)));
            m += 1;
        }
    }
    Polynomial { terms, radial }
}
