//! From pixels to the sky: distortions, projections, and their derivatives.

use shearq_quantities::linear::{Matrix2, apply, determinant, inverse, product};

// Distortions are small, so that Newton's method needs some five steps.
const MAX_NEWTON_STEPS: usize = 50;
// Far below the error of a centroid, and above the rounding of pixel numbers up to 10⁵, which is 10⁻¹¹.
const INVERSE_ERROR_PX: f64 = 1e-9;
pub(super) const ARCSEC_PER_RADIAN: f64 = 648_000.0 / std::f64::consts::PI;

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Polynomial {
    /// Powers of x and y.
    pub(super) terms: Vec<([i32; 2], f64)>,
    // Odd powers of the distance r from the origin, which TPV has besides x and y.
    pub(super) radial: Vec<(i32, f64)>,
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
pub(super) enum Projection {
    // Arcseconds; of simulations and of projections that are not read.
    Plane,
    /// One about a point, with the distortion of TPV or without.
    Sky {
        kind: SkyProjection,
        ra: f64,
        dec: f64,
        /// Native longitude of the celestial pole in radians.
        lonpole: f64,
        tpv: Option<[Polynomial; 2]>,
    },
}

/// How a place on the plane, in radians, follows from the direction on the sky.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SkyProjection {
    /// TAN: the distance from the reference point is tan θ, θ being the angle on the sky.
    Gnomonic,
    /// STG: 2 tan(θ/2), of coadds for Roman.
    Stereographic,
    /// SIN: sin θ, of 2MASS and WISE.
    Orthographic,
    /// CAR: longitude and latitude about the reference point, of maps of the whole sky.
    PlateCarree,
}

impl SkyProjection {
    /// The direction of a place along the axes (reference point, east, north), of any length, and its derivatives by ξ and η.
    fn direction(self, [xi, eta]: [f64; 2]) -> ([f64; 3], [[f64; 3]; 2]) {
        let square = xi * xi + eta * eta;
        // Height over the plane, and its derivative by R².
        let (height, by_square) = match self {
            SkyProjection::Gnomonic => (1.0, 0.0),
            SkyProjection::Stereographic => (1.0 - square / 4.0, -0.25),
            SkyProjection::Orthographic => {
                let height = (1.0 - square).sqrt();
                (height, -0.5 / height)
            }
            SkyProjection::PlateCarree => {
                let ((sine, cosine), (up, out)) = (xi.sin_cos(), eta.sin_cos());
                let by_xi = [-out * sine, out * cosine, 0.0];
                let by_eta = [-up * cosine, -up * sine, out];
                return ([out * cosine, out * sine, up], [by_xi, by_eta]);
            }
        };
        let slope = 2.0 * by_square;
        let by = [[slope * xi, 1.0, 0.0], [slope * eta, 0.0, 1.0]];
        ([height, xi, eta], by)
    }

    /// The place of a unit vector with these components. `None` on the half of the sky that would be mirrored onto the plane.
    fn place(self, [height, east, north]: [f64; 3]) -> Option<[f64; 2]> {
        let scale = match self {
            SkyProjection::Gnomonic if height > 0.0 => 1.0 / height,
            SkyProjection::Stereographic if height > -1.0 => 2.0 / (1.0 + height),
            SkyProjection::Orthographic if height > 0.0 => 1.0,
            SkyProjection::PlateCarree => {
                return Some([east.atan2(height), north.atan2(height.hypot(east))]);
            }
            _ => return None,
        };
        Some([east * scale, north * scale])
    }
}

// From pixels to the sky (Greisen & Calabretta 2002, A&A 395, 1061; Calabretta & Greisen 2002, A&A 395, 1077). The CDS's crate
// `wcs` 0.4 has no TPV, leaves SIP untested and gives no derivative.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Map {
    /// The pixel of the reference point.
    pub(super) origin: [f64; 2],
    pub(super) sip: Option<[Polynomial; 2]>,
    /// To arcseconds of a plane along west and north, or to degrees of longitude and latitude.
    pub(super) matrix: Matrix2,
    pub(super) projection: Projection,
}

impl Map {
    pub(super) fn is_distorted(&self) -> bool {
        let has_tpv = matches!(self.projection, Projection::Sky { tpv: Some(_), .. });
        self.sip.is_some() || has_tpv
    }

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
            Projection::Sky { tpv: Some(tpv), .. } => {
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

    // The projection, and the axes of its plane.
    fn axes(&self) -> Option<(SkyProjection, [[f64; 3]; 3])> {
        match &self.projection {
            Projection::Plane => None,
            Projection::Sky {
                kind,
                ra,
                dec,
                lonpole,
                ..
            } => Some((*kind, tangent([*ra, *dec], *lonpole))),
        }
    }

    /// Right ascension and declination in degrees, and the derivatives of (west, north) in arcseconds there.
    pub(super) fn sky(&self, at: [f64; 2]) -> (Option<[f64; 2]>, Matrix2) {
        let (place, slope) = self.plane(at);
        let Some((kind, axes)) = self.axes() else {
            return (None, slope);
        };
        let (direction, by_place) = kind.direction(place.map(f64::to_radians));
        let of_axes = |along: [f64; 3]| {
            [0, 1, 2].map(|k| (0..3).map(|axis| along[axis] * axes[axis][k]).sum::<f64>())
        };
        let point = of_axes(direction);
        let length = dot(&point, &point).sqrt();
        let there = [
            point[1].atan2(point[0]).to_degrees().rem_euclid(360.0),
            point[2].atan2(point[0].hypot(point[1])).to_degrees(),
        ];
        // A step on the plane moves the direction by its part across it, which west and north of the place itself
        // measure: towards the poles they turn against the axes at the reference point.
        let [_, its_east, its_north] = tangent(there, std::f64::consts::PI);
        let steps = by_place.map(of_axes);
        let row = |axis: &[f64; 3]| steps.each_ref().map(|step| dot(axis, step) / length);
        let local = [row(&its_east).map(|value| -value), row(&its_north)];
        let scale = ARCSEC_PER_RADIAN * 1f64.to_radians();
        let jacobian = product(local, slope).map(|row| row.map(|value| value * scale));
        (Some(there), jacobian)
    }

    /// The pixel of a place on the sky; `None` on its other half, and where the distortion has no inverse.
    pub(super) fn pixel_of(&self, sky: [f64; 2]) -> Option<[f64; 2]> {
        let (kind, axes) = self.axes()?;
        let [point, ..] = tangent(sky, std::f64::consts::PI);
        let place = kind.place(axes.each_ref().map(|axis| dot(&point, axis)))?;
        self.pixel(place.map(f64::to_degrees))
    }
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

pub(super) fn regular_inverse(matrix: Matrix2) -> Option<Matrix2> {
    determinant(matrix).is_normal().then(|| inverse(matrix))
}
