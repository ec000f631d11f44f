//! What headers state of an image's pixels on the sky: to detect a PSF that is sampled in other pixels than the galaxies, and
//! ellipticities that are not along the sky's axes.

use std::cell::RefCell;

use shearq_files::fits::{ImageReader, Value};
use shearq_measure::{PixelFrame, Warning};
use shearq_quantities::linear::{Matrix2, apply, determinant, inverse, product};

// Keys with the pixel scale in arcseconds: of surveys, and of GalSim.
const PIXEL_SCALE_KEYS: [&str; 2] = ["PIXSCALE", "GS_SCALE"];
// Keys of the matrix from pixels to the sky, in the unit CUNIT1.
const CD_KEYS: [&str; 4] = ["CD1_1", "CD1_2", "CD2_1", "CD2_2"];
const PC_KEYS: [&str; 4] = ["PC1_1", "PC1_2", "PC2_1", "PC2_2"];
const CDELT_KEYS: [&str; 2] = ["CDELT1", "CDELT2"];
// Rotation of the second axis in degrees, before there was a matrix (Calabretta & Greisen 2002, A&A 395, 1077, eq. 189).
const ROTATION_KEY: &str = "CROTA2";
// Plausible scales in arcseconds. Headers without a sky have scales such as 1 degree per pixel.
const PLAUSIBLE_ARCSEC: std::ops::RangeInclusive<f64> = 1e-3..=60.0;
// Least relative difference of scales, and least shear between the pixels of the PSF and of the galaxies, that is reported: a
// difference of 1 % changes m by about 0.01.
const MIN_PIXEL_DIFFERENCE: f64 = 0.01;
// Least rotation in degrees between the pixels of the PSF and of the galaxies that is reported.
const MIN_ROTATION_DEGREES: f64 = 1.0;
// Rotation in degrees and shear of the pixels below which pixel axes count as the sky's. They change m by −2 sin² 0.01° and add
// 4e-4 of g2 to g1, and 1e-4 to c: less than what calibrations reach.
const ALIGNED_DEGREES: f64 = 0.01;
const ALIGNED_SHEAR: f64 = 1e-4;
// Largest order of SIP (Shupe et al. 2005, ASPC 347, 491): headers with more are damaged.
const MAX_SIP_ORDER: i32 = 9;
// Largest number of a coefficient PVi_m of TPV.
const MAX_TPV: usize = 39;
// Powers of x and y, or of r, of the coefficients of TPV for the first axis. The second axis has x and y exchanged
// (https://fits.gsfc.nasa.gov/registry/tpvwcs/tpv.html).
const TPV_ORDERS: i32 = 7;
// Distortions are small, so that Newton's method needs some five steps.
const MAX_NEWTON_STEPS: usize = 50;
// Far below the error of a centroid, and above the rounding of pixel numbers up to 10⁵, which is 10⁻¹¹.
const INVERSE_ERROR_PX: f64 = 1e-9;

// Ratio of the determinant to the sum of squares below which axes count as parallel. Chosen by hand; `Jacobian::new` compares with
// the longer axis alone.
const MIN_AREA_TO_SUM_OF_SQUARES: f64 = 1e-6;

const ARCSEC_PER_RADIAN: f64 = 648_000.0 / std::f64::consts::PI;

#[derive(Debug, Clone, PartialEq)]
struct Polynomial {
    /// Powers of x and y.
    terms: Vec<([i32; 2], f64)>,
    // Odd powers of the distance r from the origin, which TPV has besides x and y.
    radial: Vec<(i32, f64)>,
}

impl Polynomial {
    // Derivatives are analytic, because Jacobians of each galaxy follow from them: finite differences would lose half of the digits.
    fn at(&self, [x, y]: [f64; 2]) -> (f64, [f64; 2]) {
        let (mut value, mut slope) = (0.0, [0.0; 2]);
        for &([i, j], factor) in &self.terms {
            let (xi, yj) = (x.powi(i), y.powi(j));
            value += factor * xi * yj;
            if i > 0 {
                slope[0] += factor * f64::from(i) * x.powi(i - 1) * yj;
            }
            if j > 0 {
                slope[1] += factor * f64::from(j) * xi * y.powi(j - 1);
            }
        }
        let r = x.hypot(y);
        for &(n, factor) in &self.radial {
            value += factor * r.powi(n);
            // r has a cusp at the origin; the mean of its derivative over all directions, zero, is used there.
            if r > 0.0 {
                let by_r = factor * f64::from(n) * r.powi(n - 2);
                slope[0] += by_r * x;
                slope[1] += by_r * y;
            }
        }
        (value, slope)
    }

    fn both(axes: &[Self; 2], at: [f64; 2]) -> ([f64; 2], Matrix2) {
        let [first, second] = axes.each_ref().map(|axis| axis.at(at));
        ([first.0, second.0], [first.1, second.1])
    }
}

#[derive(Debug, Clone, PartialEq)]
enum Projection {
    // Arcseconds; of simulations and of projections that are not read.
    Plane,
    /// The gnomonic one about a point, with the distortion of TPV or without.
    Tangent {
        ra: f64,
        dec: f64,
        /// Native longitude of the celestial pole in radians.
        lonpole: f64,
        tpv: Option<[Polynomial; 2]>,
    },
}

// From pixels to the sky (Greisen & Calabretta 2002, A&A 395, 1061; Calabretta & Greisen 2002, A&A 395, 1077). The CDS's crate
// `wcs` 0.4 has no TPV, leaves SIP untested and gives no derivative.
#[derive(Debug, Clone, PartialEq)]
struct Map {
    /// The pixel of the reference point.
    origin: [f64; 2],
    sip: Option<[Polynomial; 2]>,
    /// To arcseconds of a plane along west and north, or to degrees of longitude and latitude.
    matrix: Matrix2,
    projection: Projection,
}

impl Map {
    /// Coordinates on the projection plane, longitude first, and their derivatives by pixels.
    fn plane(&self, at: [f64; 2]) -> ([f64; 2], Matrix2) {
        let mut offset = [0, 1].map(|k| at[k] - self.origin[k]);
        let mut slope = self.matrix;
        if let Some(sip) = &self.sip {
            let (shift, mut by) = Polynomial::both(sip, offset);
            offset = [0, 1].map(|k| offset[k] + shift[k]);
            by[0][0] += 1.0;
            by[1][1] += 1.0;
            slope = product(self.matrix, by);
        }
        let place = apply(self.matrix, offset);
        match &self.projection {
            Projection::Tangent { tpv: Some(tpv), .. } => {
                let (place, by) = Polynomial::both(tpv, place);
                (place, product(by, slope))
            }
            _ => (place, slope),
        }
    }

    // By Newton's method, because SIP's inverse coefficients AP and BP are optional and approximate. `None` where it diverges.
    fn pixel(&self, wanted: [f64; 2]) -> Option<[f64; 2]> {
        let mut at = self.origin;
        for _ in 0..MAX_NEWTON_STEPS {
            let (place, slope) = self.plane(at);
            let step = apply(
                regular_inverse(slope)?,
                [0, 1].map(|k| wanted[k] - place[k]),
            );
            at = [0, 1].map(|k| at[k] + step[k]);
            if step[0].hypot(step[1]) < INVERSE_ERROR_PX {
                return Some(at);
            }
        }
        None
    }

    /// Right ascension and declination in degrees, and the derivatives of (west, north) in arcseconds there.
    fn sky(&self, at: [f64; 2]) -> (Option<[f64; 2]>, Matrix2) {
        let (place, slope) = self.plane(at);
        let Projection::Tangent {
            ra, dec, lonpole, ..
        } = &self.projection
        else {
            return (None, slope);
        };
        let [centre, east, north] = tangent([*ra, *dec], *lonpole);
        let [xi, eta] = place.map(f64::to_radians);
        let point = [0, 1, 2].map(|k| centre[k] + xi * east[k] + eta * north[k]);
        let length = dot(&point, &point).sqrt();
        let there = [
            point[1].atan2(point[0]).to_degrees().rem_euclid(360.0),
            point[2].atan2(point[0].hypot(point[1])).to_degrees(),
        ];
        // A step on the tangent plane moves the direction by its part across it, which west and north of the place itself
        // measure: towards the poles they turn against the axes at the reference point.
        let [_, its_east, its_north] = tangent(there, std::f64::consts::PI);
        let row = |axis: &[f64; 3]| [&east, &north].map(|by| dot(axis, by) / length);
        let local = [row(&its_east).map(|value| -value), row(&its_north)];
        let scale = ARCSEC_PER_RADIAN * 1f64.to_radians();
        let jacobian = product(local, slope).map(|row| row.map(|value| value * scale));
        (Some(there), jacobian)
    }

    /// The pixel of a place on the sky; `None` on its other half, and where the distortion has no inverse.
    fn pixel_of(&self, sky: [f64; 2]) -> Option<[f64; 2]> {
        let Projection::Tangent {
            ra, dec, lonpole, ..
        } = &self.projection
        else {
            return None;
        };
        let [centre, east, north] = tangent([*ra, *dec], *lonpole);
        let [point, ..] = tangent(sky, std::f64::consts::PI);
        let height = dot(&point, &centre);
        // The other half of the sky would be mirrored onto the plane.
        if height.is_nan() || height <= 0.0 {
            return None;
        }
        self.pixel([&east, &north].map(|axis| (dot(&point, axis) / height).to_degrees()))
    }
}

// Arcseconds of a unit of CUNIT1; `arcsec` states whether this is the one without a name.
fn arcsec_of(unit: &str, arcsec: bool) -> f64 {
    match unit {
        "ARCSEC" => 1.0,
        "" if arcsec => 1.0,
        "ARCMIN" => 60.0,
        "RAD" => ARCSEC_PER_RADIAN,
        _ => 3600.0,
    }
}

fn singular_text([[a, b], [c, d]]: Matrix2) -> String {
    format!(
        "the matrix of the WCS, CD or PC with CDELT, is singular (found {a}, {b}, {c}, {d}; expected one with an inverse)"
    )
}

/// Unit vectors to a place in degrees, and along the axes of the tangent plane there: east and north, if the pole is at π.
fn tangent([ra, dec]: [f64; 2], lonpole: f64) -> [[f64; 3]; 3] {
    let ((sin_ra, cos_ra), (sin_dec, cos_dec)) =
        (ra.to_radians().sin_cos(), dec.to_radians().sin_cos());
    let east = [-sin_ra, cos_ra, 0.0];
    let north = [-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec];
    // The direction to the pole has the native longitude φ, that is (sin φ, −cos φ) on the plane.
    let (sine, cosine) = lonpole.sin_cos();
    [
        [cos_dec * cos_ra, cos_dec * sin_ra, sin_dec],
        [0, 1, 2].map(|k| -cosine * east[k] + sine * north[k]),
        [0, 1, 2].map(|k| -sine * east[k] - cosine * north[k]),
    ]
}

fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Wcs {
    /// Arcseconds per pixel.
    scale: Option<f64>,
    map: Option<Map>,
    /// CTYPE1 if it is a projection that is not read: only the matrix is used then.
    unread: Option<String>,
    /// What is wrong with the numbers, if they give no map.
    damage: Option<String>,
}

impl Wcs {
    pub(crate) fn of_header(image: &ImageReader) -> Self {
        let text = |key: &str| image.text(key).trim().to_owned();
        let unreadable = RefCell::new(None);
        let wcs = Wcs::of_keys(
            |key| match image.number(key) {
                Ok(number) => number,
                // Other programs use PIXSCALE for text.
                Err(_) if PIXEL_SCALE_KEYS.contains(&key) => None,
                Err(_) => {
                    unreadable
                        .borrow_mut()
                        .get_or_insert_with(|| key.to_owned());
                    None
                }
            },
            |key| text(key).to_ascii_uppercase(),
        );
        // Without this key, the others would place galaxies elsewhere on the sky.
        match unreadable.into_inner() {
            None => wcs,
            Some(key) => Wcs {
                scale: wcs.scale,
                damage: Some(format!(
                    "the WCS has {key} = '{}' (expected a number)",
                    text(&key)
                )),
                ..Wcs::default()
            },
        }
    }

    fn of_keys(number: impl Fn(&str) -> Option<f64>, text: impl Fn(&str) -> String) -> Self {
        let kinds = ["CTYPE1", "CTYPE2"].map(&text);
        let kind = kinds[0].as_str();
        // GalSim writes planes in arcseconds without a unit; others without a unit have degrees, as the standard prescribes.
        let plane = kind == "LINEAR";
        let gs_plane = plane && !text("GS_WCS").is_empty();
        let unit = arcsec_of(&text("CUNIT1"), gs_plane);
        let matrix = cd(CD_KEYS.map(&number)).or_else(|| scaled_pc(&number));
        // Relative to its size: rounded numbers of parallel axes leave a small determinant. A header of zeros has no WCS.
        let size = |m: &Matrix2| m.iter().flatten().map(|v| v * v).sum::<f64>();
        let regular = |m: &Matrix2| determinant(*m).abs() > MIN_AREA_TO_SUM_OF_SQUARES * size(m);
        let singular = |m: &Matrix2| !regular(m) && size(m) > 0.0;
        let damage = matrix.filter(singular).map(singular_text);
        let matrix = matrix.filter(regular);
        let stated = PIXEL_SCALE_KEYS.into_iter().find_map(&number);
        let of_matrix = matrix.map(|matrix| determinant(matrix).abs().sqrt() * unit);
        let scale = stated
            .or(of_matrix)
            .filter(|scale| PLAUSIBLE_ARCSEC.contains(scale));
        let Some(matrix) = matrix else {
            return Wcs {
                scale,
                damage,
                ..Wcs::default()
            };
        };
        let latitude_first = kind.starts_with("DEC") || kind.get(1..4) == Some("LAT");
        let named = latitude_first || kind.starts_with("RA") || kind.get(1..4) == Some("LON");
        let equatorial = kind.starts_with("DEC") || kind.starts_with("RA");
        let longitude = usize::from(latitude_first);
        let origin = ["CRPIX1", "CRPIX2"].map(|key| number(key).unwrap_or(0.0));
        let in_unit = |matrix: Matrix2, unit: f64| matrix.map(|row| row.map(|v| v * unit));
        let projection = kind.get(5..8).unwrap_or_default();
        let read = equatorial && ["TAN", "TPV"].contains(&projection);
        if !read {
            let [first, second] = in_unit(matrix, unit);
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
                unread: named.then(|| kind.to_owned()),
                damage: None,
            };
        }
        let [first, second] = in_unit(matrix, unit / 3600.0);
        let centre = ["CRVAL1", "CRVAL2"].map(|key| number(key).unwrap_or(0.0) * unit / 3600.0);
        let (ra, dec) = (centre[longitude], centre[1 - longitude]);
        // The default of LONPOLE for zenithal projections (Calabretta & Greisen 2002).
        let lonpole = if dec >= 90.0 { 0.0 } else { 180.0 };
        let sip = kind
            .ends_with("-SIP")
            .then(|| ["A", "B"].map(|name| sip(name, &number)));
        // SCAMP wrote distortions of TPV under the name TAN.
        let latitude = 2 - longitude;
        let scamp = (0..=MAX_TPV).any(|m| number(&format!("PV{latitude}_{m}")).is_some());
        let tpv = projection == "TPV" || scamp;
        Wcs {
            scale,
            map: Some(Map {
                origin,
                sip,
                matrix: match latitude_first {
                    true => [second, first],
                    false => [first, second],
                },
                projection: Projection::Tangent {
                    ra,
                    dec,
                    lonpole: number("LONPOLE").unwrap_or(lonpole).to_radians(),
                    tpv: tpv.then(|| {
                        [longitude, 1 - longitude]
                            .map(|axis| tpv_of(axis, &number, axis == longitude))
                    }),
                },
            }),
            unread: None,
            damage: None,
        }
    }

    /// Derivatives of (u, v) by x (first column) and y in arcseconds at a pixel, with u to the west and v to the north.
    pub(crate) fn jacobian(&self, at: [f64; 2]) -> Option<Matrix2> {
        Some(self.map.as_ref()?.sky(at).1)
    }

    /// The same at the reference point.
    fn reference(&self) -> Option<Matrix2> {
        let map = self.map.as_ref()?;
        Some(match map.projection {
            Projection::Plane => map.matrix,
            Projection::Tangent { .. } => {
                let plain = Map {
                    sip: None,
                    ..map.clone()
                };
                plain.sky(map.origin).1
            }
        })
    }

    pub(crate) fn has_sky(&self) -> bool {
        let projection = self.map.as_ref().map(|map| &map.projection);
        matches!(projection, Some(Projection::Tangent { .. }))
    }

    /// Right ascension and declination of a pixel in degrees.
    pub(crate) fn sky(&self, at: [f64; 2]) -> Option<[f64; 2]> {
        self.map.as_ref()?.sky(at).0
    }

    /// The pixel of a right ascension and declination in degrees.
    pub(crate) fn pixel(&self, sky: [f64; 2]) -> Option<[f64; 2]> {
        self.map.as_ref()?.pixel_of(sky)
    }

    /// The projection of a header that is not read.
    pub(crate) fn unread(&self) -> Option<&str> {
        self.unread.as_deref()
    }

    /// What is wrong with a header that states a WCS but gives no places on the sky; `None` for a usable WCS, and without one.
    pub(crate) fn fault(&self) -> Option<String> {
        let expected = "expected TAN, TAN-SIP, TPV or a linear one";
        match (&self.damage, &self.unread) {
            (Some(damage), _) => Some(damage.clone()),
            (None, Some(kind)) => Some(format!("the projection {kind} is not read ({expected})")),
            (None, None) => None,
        }
    }

    /// Keys that state the same of an image of other stamps of these pixels, as GalSim writes and reads them.
    pub(crate) fn keys(&self) -> Vec<(&'static str, Value)> {
        let Some([[xx, xy], [yx, yy]]) = self.reference() else {
            return Vec::new();
        };
        let text = |text: &str| Value::Text(text.into());
        // Without a reference point, because the stamps are not where the image of the header had them.
        let mut keys = vec![("GS_WCS", text("JacobianWCS"))];
        keys.extend(["CTYPE1", "CTYPE2"].map(|key| (key, text("LINEAR"))));
        keys.extend(["CUNIT1", "CUNIT2"].map(|key| (key, text("arcsec"))));
        let matrix = [xx, xy, yx, yy].map(Value::Real);
        keys.extend(CD_KEYS.into_iter().zip(matrix));
        keys
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
            unread: None,
            damage: None,
        }
    }

    pub(crate) fn states_axes(&self) -> bool {
        self.reference().is_some()
    }

    /// A warning if the ellipticities along these pixels are not along the sky's axes.
    pub(crate) fn frame(&self) -> Option<Warning> {
        let jacobian = self.reference()?;
        (!aligned(&jacobian)).then(|| Warning::PixelFrame(frame(&jacobian)))
    }

    /// Warnings if the PSF and the galaxies state different pixels.
    pub(crate) fn disagreements(psf: &Self, galaxies: &Self) -> impl Iterator<Item = Warning> {
        let scale = || {
            let (psf, galaxies) = (psf.scale?, galaxies.scale?);
            let differs = (psf / galaxies - 1.0).abs() > MIN_PIXEL_DIFFERENCE;
            differs.then_some(Warning::PixelScale { psf, galaxies })
        };
        let frames = || {
            let (psf, galaxies) = (psf.reference()?, galaxies.reference()?);
            let PixelFrame {
                angle,
                mirrored,
                shear: [g1, g2],
            } = frame(&product(regular_inverse(psf)?, galaxies));
            // A rotation that both have in common does no harm: the PSF is deconvolved in the pixels of the galaxies.
            let differs = mirrored
                || angle.abs() > MIN_ROTATION_DEGREES
                || g1.hypot(g2) > MIN_PIXEL_DIFFERENCE;
            differs.then(|| Warning::PsfFrame {
                psf: frame(&psf),
                galaxies: frame(&galaxies),
            })
        };
        scale().into_iter().chain(frames())
    }
}

// Absent keys of a matrix are zero (Greisen & Calabretta 2002) if others are present.
fn cd([xx, xy, yx, yy]: [Option<f64>; 4]) -> Option<Matrix2> {
    if xx.is_none() && yy.is_none() && xy.is_none() {
        return None;
    }
    Some([[xx, xy], [yx, yy]].map(|row| row.map(|value| value.unwrap_or(0.0))))
}

// PC with CDELT, or the older rotation with CDELT.
fn scaled_pc(number: impl Fn(&str) -> Option<f64>) -> Option<Matrix2> {
    let [x, y] = CDELT_KEYS.map(&number);
    let (x, y) = (x?, y?);
    let (sine, cosine) = number(ROTATION_KEY).unwrap_or(0.0).to_radians().sin_cos();
    let [xx, xy, yx, yy] = PC_KEYS.map(&number);
    Some(match [xx, xy, yx, yy].iter().any(Option::is_some) {
        true => {
            let [xx, yy] = [xx, yy].map(|value| value.unwrap_or(1.0));
            let [xy, yx] = [xy, yx].map(|value| value.unwrap_or(0.0));
            [[xx * x, xy * x], [yx * y, yy * y]]
        }
        false => [[x * cosine, -y * sine], [x * sine, y * cosine]],
    })
}

/// The coefficients of an axis of SIP, `A` or `B`, of offsets from the reference pixel.
fn sip(name: &str, number: impl Fn(&str) -> Option<f64>) -> Polynomial {
    let order = number(&format!("{name}_ORDER")).unwrap_or(0.0) as i32;
    let order = order.min(MAX_SIP_ORDER);
    let powers = (0..=order).flat_map(|i| (0..=order - i).map(move |j| [i, j]));
    let terms = powers.filter_map(|[i, j]| Some(([i, j], number(&format!("{name}_{i}_{j}"))?)));
    Polynomial {
        terms: terms.collect(),
        radial: Vec::new(),
    }
}

/// The coefficients of an axis of TPV, from 0, in degrees, by longitude and latitude.
fn tpv_of(axis: usize, number: impl Fn(&str) -> Option<f64>, longitude: bool) -> Polynomial {
    let factor = |m: usize| number(&format!("PV{}_{m}", axis + 1));
    let (mut terms, mut radial) = (Vec::new(), Vec::new());
    let mut m = 0;
    for order in 0..=TPV_ORDERS {
        for j in 0..=order {
            // Without PVi_1 the coordinate itself, as the convention prescribes.
            let factor = factor(m).or((m == 1).then_some(1.0));
            let powers = if longitude {
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

fn regular_inverse(matrix: Matrix2) -> Option<Matrix2> {
    determinant(matrix).is_normal().then(|| inverse(matrix))
}

/// Whether ellipticities along the pixel axes are ellipticities along the sky's.
pub(crate) fn aligned(jacobian: &Matrix2) -> bool {
    let frame = frame(jacobian);
    // Ellipticities do not change by half a turn.
    let turned = (frame.angle + 90.0).rem_euclid(180.0) - 90.0;
    !frame.mirrored
        && turned.abs() <= ALIGNED_DEGREES
        && frame.shear[0].hypot(frame.shear[1]) <= ALIGNED_SHEAR
}

pub(crate) fn frame(jacobian: &Matrix2) -> PixelFrame {
    let [[ux, uy], [vx, vy]] = *jacobian;
    let all = determinant(*jacobian);
    // A round object has the second moments J⁻¹ J⁻ᵀ in pixels; this is their ellipticity (Bartelmann & Schneider 2001,
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

    #[test]
    fn places_and_derivatives_are_those_of_astropy() {
        let (mut keys, mut checked) = (std::collections::HashMap::new(), 0);
        let lines = include_str!("wcs/astropy.txt").lines();
        for line in lines.filter(|line| !line.starts_with('#')) {
            if line.starts_with('[') {
                keys.clear();
            } else if let Some((key, value)) = line.split_once(" = ") {
                keys.insert(key, value);
            } else if let Some(numbers) = line.strip_prefix("at ") {
                let numbers: Vec<f64> = numbers.split(' ').map(|n| n.parse().unwrap()).collect();
                let &[x, y, ra, dec, ux, uy, vx, vy] = &numbers[..] else {
                    panic!("{line}");
                };
                let wcs = Wcs::of_keys(
                    |key| keys.get(key)?.parse().ok(),
                    |key| {
                        keys.get(key)
                            .map_or_else(String::new, |text| text.to_ascii_uppercase())
                    },
                );
                let sky = wcs.sky([x, y]).unwrap();
                // 1e-6 px are 6e-11 degrees.
                let off = [(sky[0] - ra) * dec.to_radians().cos(), sky[1] - dec];
                assert!(off[0].hypot(off[1]) < 2e-11, "{keys:?} {line}: {sky:?}");
                let back = wcs.pixel([ra, dec]).unwrap();
                assert!(
                    (back[0] - x).hypot(back[1] - y) < 1e-6,
                    "{keys:?} {line}: {back:?}"
                );
                let found = wcs.jacobian([x, y]).unwrap();
                for (found, expected) in found.as_flattened().iter().zip([ux, uy, vx, vy]) {
                    assert!((found - expected).abs() < 2e-8, "{keys:?} {line}: {found}");
                }
                checked += 1;
            }
        }
        assert_eq!(checked, 36);
        let wcs = sky([-1.0, 0.0, 0.0, 1.0]);
        assert_eq!(wcs.pixel([180.0, 0.0]), None);
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
        for header in [
            vec![],
            vec![("CDELT1", real(1.0)), ("CDELT2", real(1.0))],
            vec![("PIXSCALE", text("small"))],
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
        let turned = Warning::PixelFrame(frame(&same.reference().unwrap())).to_string();
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
            .chain(PC_KEYS.into_iter().zip(pc))
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
