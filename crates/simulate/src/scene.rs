//! Scenes: exposures of a field whose galaxies lie anywhere and blend, to test detection, deblending and measurement together.
//!
//! A scene has one reduced shear. It acts on the shapes of the galaxies *and on their places*, about the centre of the field, as
//! lensing does: a detection near a neighbour is lost or gained by how far apart the shear moves them, and such a bias is absent
//! from galaxies whose places are fixed. Stars are not sheared, and all objects are behind one PSF, or one that varies
//! over the scene. A scene may have several epochs: of the same sky, with the camera moved and turned.
//!
//! Pixels count from 0 here, +x is to the west and +y to the north, so that pixel axes of the first epoch are those of the sky.
//!
//! Random numbers are ChaCha8 streams with the key (seed, scene, epoch from 0, purpose), which also has the high half of the seed, and the index of the object as the number of the
//! stream. An object therefore depends neither on the order nor on the thread in which it is drawn, nor on the others.

use std::f64::consts::TAU;

use ndarray::Array2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use shearq_quantities::fourier::Complex64;
use shearq_quantities::linear::apply;
use shearq_quantities::{
    FunctionalPsf, ProfileError, PsfProfile, PsfTransform, Shear, TransformedPsf, checked_when_read,
};

use super::field::{MAX_RANDOM_SHEAR, random_shear};
use super::fit::{Fit, FitComponent, axis_ratio, log_normal, rayleigh};
use super::galaxy::{Galaxy, Sersic};
use super::noise::add_noise;
use super::render::{RenderScratch, Renderer, stamp_side};
use super::set::{NOISE_SIGMA, SettingsError, is_zero, stream_of};
use super::signal::power;

/// Pixels a side of the star image of a scene.
pub const STAR: usize = 64;

// Of ground-based PSFs; β = 3 is that of GREAT10.
const PSF: PsfProfile = PsfProfile::Moffat { beta: 3.0 };
// FWHM in px: below, light is beyond the largest wavenumber that is drawn; above, it is beyond the stamps.
const FWHM_PX: (f64, f64) = (1.8, 12.0);
// Dithers of epochs along each axis are up to this, a third of the side of a small scene. Chosen by hand.
const DITHER_PX: f64 = 20.0;
// Beyond it, objects that a shear moves into the image are beyond the field that is populated.
const MAX_SHEAR: f64 = 0.15;
// Half side of the populated field over that of the image: (1 + √2·0.15)/√(1 − 0.15²) is the largest |x| that a shear brings to 1.
const FIELD_MARGIN: f64 = 1.23;
// Sides of stamps: a galaxy is drawn on the smallest that holds its light. Most of them need 32 or 48 px.
const STAMPS: [usize; 6] = [32, 48, 64, 96, 144, 216];
// Objects beyond the edges of the image by more than this add no light to it: half of the largest stamp.
const EDGE_PX: f64 = 108.0;
// A hexagonal lattice with a place for each object; offsets as far as half a pixel keep objects from having one phase in their pixels.
const LATTICE_OFFSET_PX: f64 = 0.5;

// Median half-light radius of the light at S/N 10, its power of S/N, the scatter of its logarithm, and its limits. Chosen by hand, so
// that galaxies of 25th magnitude have 0.3 to 0.4 arcsec, as in COSMOS (Leauthaud et al. 2007, ApJS 172, 219), and bright ones more.
const MEDIAN_RADIUS_ARCSEC: f64 = 0.32;
const RADIUS_SNR: f64 = 10.0;
const RADIUS_POWER: f64 = 0.25;
const RADIUS_SCATTER: f64 = 0.3;
const RADII_ARCSEC: (f64, f64) = (0.14, 1.0);
// Scale of |ε| per component, and its limit: the scatter is 0.25 per component, in COSMOS 0.26 (Leauthaud et al. 2007).
const INTRINSIC_SIGMA: f64 = 0.25;
const MAX_INTRINSIC_MODULUS: f64 = 0.75;
// The bulge's share of the light, uniform up to this, and its radius over that of the disc. Chosen by hand: discs dominate at the
// redshifts of lensing surveys.
const MAX_BULGE_SHARE: f64 = 0.4;
const BULGE_RADIUS: f64 = 0.45;
// S/N of stars and the power of N(> S/N). Chosen by hand: they are flatter in magnitude than galaxies.
const STAR_SNR: (f64, f64) = (50.0, 2000.0);
const STAR_POWER: f64 = 0.5;

/// Where objects are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layout {
    /// Anywhere, independently of each other.
    #[default]
    Random,
    /// On a hexagonal lattice: without blends, at the same density.
    Hexagonal,
}

/// Settings of scenes. Reading them checks them by [`SceneSettings::validate`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(remote = "Self", deny_unknown_fields)]
pub struct SceneSettings {
    pub seed: u64,
    /// 64 more bits of the seed of a blind challenge, so that nobody finds it by trying.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub seed_high: u64,
    /// Pixels a side.
    pub side: usize,
    /// Pixels along the edges that are without objects before lensing; 0 populates the field beyond the edges.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub border: usize,
    pub pixel_arcsec: f64,
    /// FWHM of the PSF, a Moffat profile of β = 3, before the pixel.
    pub seeing_arcsec: f64,
    /// Ellipticity ε of the PSF.
    pub psf_shape: [f64; 2],
    /// Relative change of the FWHM of the PSF from the middle of the scene to its right edge, and the change of e1 on that way and of e2
    /// from the middle to the upper edge.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub psf_gradient: [f64; 2],
    pub layout: Layout,
    /// Galaxies per arcmin².
    pub density: f64,
    /// Least and largest S/N of galaxies.
    pub snr: [f64; 2],
    /// d log₁₀ N/dm of the galaxies.
    pub counts_slope: f64,
    /// Stars per arcmin².
    pub star_density: f64,
    /// Exposures of each scene. Those after the first are moved and turned at random, and have the same PSF on their pixels.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub epochs: u32,
    /// Electrons per unit of the image: light has their noise, too. Without a number, all pixels have the same noise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// The shear of all scenes; without one, each has its own, drawn as in GREAT3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub constant_shear: Option<[f64; 2]>,
    /// Whether all shears have the opposite sign; all else stays.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub opposite: bool,
    /// Whether the scene is turned by 90 degrees about its centre before lensing. PSF, pixels and noise stay.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rotated: bool,
    /// Whether the noise of every pixel has the opposite sign.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub negative_noise: bool,
}

fn one() -> u32 {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde gives a reference")]
fn is_one(count: &u32) -> bool {
    *count == 1
}

impl Default for SceneSettings {
    fn default() -> Self {
        SceneSettings {
            seed: 1,
            seed_high: 0,
            side: 1000,
            border: 0,
            pixel_arcsec: 0.2,
            seeing_arcsec: 0.7,
            psf_shape: [0.03, -0.02],
            psf_gradient: [0.0; 2],
            layout: Layout::Random,
            density: 75.0,
            snr: [3.0, 400.0],
            // Of deep counts in R; in I it is 0.27 (Smail et al. 1995, ApJ 449, L105).
            counts_slope: 0.32,
            star_density: 0.0,
            epochs: 1,
            gain: None,
            constant_shear: None,
            opposite: false,
            rotated: false,
            negative_noise: false,
        }
    }
}

checked_when_read!(SceneSettings);

// More than deep surveys have in one filter.
const MAX_EPOCHS: u32 = 999;
// Objects of a field: 30 times those of the deepest surveys on the largest image.
const MAX_OBJECTS: f64 = 1e8;

impl SceneSettings {
    pub fn validate(&self) -> Result<(), SettingsError> {
        let SceneSettings {
            seed: _,
            seed_high: _,
            side,
            border,
            pixel_arcsec,
            seeing_arcsec,
            psf_shape,
            psf_gradient: [of_size, of_shape],
            layout: _,
            density,
            snr: [faint, bright],
            counts_slope,
            star_density,
            epochs,
            gain,
            constant_shear,
            opposite: _,
            rotated: _,
            negative_noise: _,
        } = *self;
        let expect = |is_sound: bool, found: String, expected: String| match is_sound {
            true => Ok(()),
            false => Err(SettingsError::new(format!("{found}; expected {expected}"))),
        };
        expect(
            (64..=20_000).contains(&side),
            format!("the scene has {side} pixels a side"),
            "64 to 20000".into(),
        )?;
        expect(
            2 * border < side,
            format!("the border of {border} pixels leaves nothing of a side of {side}"),
            "less than half of the side".into(),
        )?;
        expect(
            pixel_arcsec.is_finite() && pixel_arcsec > 0.0,
            format!("a pixel is {pixel_arcsec} arcsec"),
            "a positive number".into(),
        )?;
        let (least, most) = FWHM_PX;
        let fwhm = seeing_arcsec / pixel_arcsec;
        expect(
            [-of_size, of_size]
                .iter()
                .all(|own| (least..=most).contains(&(fwhm * (1.0 + own)))),
            format!(
                "the seeing of {seeing_arcsec} arcsec is {fwhm:.2} pixels, with a change of {of_size}"
            ),
            format!("{least} to {most} everywhere"),
        )?;
        // Where the terms of model.psf have errors of 1 % of the peak.
        expect(
            of_size.abs() <= 0.2,
            format!("the FWHM of the PSF changes by {of_size}"),
            "at most 0.2".into(),
        )?;
        let [e1, e2] = psf_shape.map(|e| e.abs() + of_shape.abs());
        expect(
            e1.hypot(e2) <= 0.3,
            format!("the PSF's ellipticity is up to {e1}, {e2}"),
            "a modulus of at most 0.3".into(),
        )?;
        for (what, density) in [("galaxies", density), ("stars", star_density)] {
            let count = density * self.field_arcmin2();
            expect(
                density >= 0.0 && count <= MAX_OBJECTS,
                format!("the scene has {density} {what} per arcmin²"),
                format!("0 or more, and at most {MAX_OBJECTS:e} in the field"),
            )?;
        }
        expect(
            faint > 0.0 && faint <= bright && bright <= 1e5,
            format!("the S/N of galaxies is {faint} to {bright}"),
            "two rising numbers, above 0 and at most 1e5".into(),
        )?;
        expect(
            counts_slope > 0.0 && counts_slope <= 2.0,
            format!("the slope of number counts is {counts_slope}"),
            "above 0 and at most 2".into(),
        )?;
        expect(
            (1..=MAX_EPOCHS).contains(&epochs),
            format!("a scene has {epochs} epochs"),
            format!("1 to {MAX_EPOCHS}"),
        )?;
        expect(
            gain.is_none_or(|gain| gain > 0.0 && gain.is_normal()),
            format!("the gain is {}", gain.unwrap_or_default()),
            "a positive number".into(),
        )?;
        let [g1, g2] = constant_shear.unwrap_or_default();
        expect(
            g1.hypot(g2) <= MAX_SHEAR,
            format!("the constant shear is {g1}, {g2}"),
            format!(
                "a modulus of at most {MAX_SHEAR}, which the edges of a scene are populated for"
            ),
        )
    }

    // Half a side of the field that is populated, in pixels.
    fn half_field(&self) -> f64 {
        match self.border {
            0 => FIELD_MARGIN * (self.reach() + EDGE_PX),
            border => 0.5 * self.side as f64 - border as f64,
        }
    }

    // Largest distance along an axis of the first epoch, in pixels from its middle, of a place on an image of any epoch.
    fn reach(&self) -> f64 {
        let half = 0.5 * self.side as f64;
        match self.epochs {
            1 => half,
            // Corners of images that are turned.
            _ => (half + DITHER_PX) * 2f64.sqrt(),
        }
    }

    fn field_arcmin2(&self) -> f64 {
        (2.0 * self.half_field() * self.pixel_arcsec / 60.0).powi(2)
    }

    /// The area of the image that has objects.
    pub fn area_arcmin2(&self) -> f64 {
        let side = self.side as f64 - 2.0 * self.border as f64;
        (side * self.pixel_arcsec / 60.0).powi(2)
    }

    fn stream(&self, scene: u32, purpose: Purpose) -> ChaCha8Rng {
        self.stream_of_epoch(scene, 1, purpose)
    }

    fn stream_of_epoch(&self, scene: u32, epoch: u32, purpose: Purpose) -> ChaCha8Rng {
        stream_of(
            [self.seed, self.seed_high],
            [scene, epoch - 1],
            purpose as u64,
        )
    }

    /// How an epoch (from 1) of a scene sees the sky. Versions of a scene are seen alike.
    pub fn view(&self, scene: u32, epoch: u32) -> View {
        if epoch == 1 {
            return View::default();
        }
        let mut rng = self.stream_of_epoch(scene, epoch, Purpose::View);
        View {
            radians: rng.random_range(0.0..TAU),
            dither: [0; 2].map(|_| rng.random_range(-DITHER_PX..DITHER_PX)),
        }
    }
}

/// Where a place of the first epoch is in another one: turned by an angle from +x to +y about the middle, and moved by pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct View {
    pub radians: f64,
    pub dither: [f64; 2],
}

#[derive(Clone, Copy)]
enum Purpose {
    // Beyond those of GREAT10's sets and GREAT3's branches.
    Shear = 64,
    Galaxy,
    Star,
    Noise,
    View,
}

/// A galaxy or a star that adds light to the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Source {
    /// The same in all versions of a scene.
    pub index: usize,
    pub is_star: bool,
    /// Its centre after lensing, in 0-based pixels.
    pub centre: [f64; 2],
    /// √(Σ I²)/σ alone, before lensing and behind a round PSF.
    pub snr: f64,
    pub flux: f64,
    /// Circularised half-light radius of the disc, or of the only component, in pixels; 0 of a star.
    pub half_light_px: f64,
    /// The bulge's share of the light, and its circularised half-light radius in pixels; 0 without one.
    pub bulge_share: f64,
    pub bulge_half_light_px: f64,
    /// Row of the fit in the table of galaxies, from 1; 0 without a table.
    pub fit: usize,
    /// ε of the disc, or of the only component, before lensing.
    pub intrinsic: Shear,
    /// The same after lensing.
    pub observed: Shear,
    light: Galaxy,
}

/// Light of a source, to be added to the image.
#[derive(Debug, Clone)]
pub struct Stamp {
    /// The pixel (x, y) of the image that the first pixel of the stamp is; it may be outside.
    corner: [i64; 2],
    side: usize,
    pixels: Vec<f32>,
}

impl Stamp {
    /// Adds what is within the image, `[y, x]`.
    pub fn add_to(&self, image: &mut Array2<f32>) {
        let (rows, columns) = image.dim();
        let Some((from, to)) = overlap(self.corner[0], self.side, columns) else {
            return;
        };
        for (y, line) in (self.corner[1]..).zip(self.pixels.chunks_exact(self.side)) {
            let Some(y) = usize::try_from(y).ok().filter(|y| *y < rows) else {
                continue;
            };
            let mut row = image.row_mut(y);
            let own = &line[from..from + to.len()];
            for (pixel, light) in row.slice_mut(ndarray::s![to.clone()]).iter_mut().zip(own) {
                *pixel += light;
            }
        }
    }
}

// The first pixel of the stamp that is on an image of `columns`, and the columns that the stamp covers.
fn overlap(corner: i64, side: usize, columns: usize) -> Option<(usize, std::ops::Range<usize>)> {
    let first = corner.max(0);
    let end = (corner + side as i64).min(columns as i64);
    (first < end).then_some(((first - corner) as usize, first as usize..end as usize))
}

/// Draws the sources of scenes.
#[derive(Debug)]
pub struct SceneSimulator {
    settings: SceneSettings,
    /// Galaxies are drawn from these; if it is empty, from the population of [`SceneSettings`].
    fits: Vec<Fit>,
    psf: FunctionalPsf,
    transform: PsfTransform,
    renderers: Vec<Renderer>,
    /// Places of a hexagonal lattice: distance, columns and rows.
    lattice: (f64, [usize; 2]),
}

impl SceneSimulator {
    /// # Errors
    /// If settings are out of range, or a fit cannot be drawn.
    pub fn new(settings: SceneSettings, fits: Vec<Fit>) -> Result<Self, SettingsError> {
        settings.validate()?;
        for (k, fit) in fits.iter().enumerate() {
            let sample = fit.galaxy(settings.pixel_arcsec, 1.0, |own| {
                Shear::new(own.modulus(), 0.0)
            });
            sample.map_err(|error| SettingsError::new(format!("fit {}: {error}", k + 1)))?;
        }
        let psf = psf_at(&settings, [0.0; 2]);
        let psf = psf.map_err(|error| SettingsError::new(error.to_string()))?;
        // Of a lattice with one place in √3/2 times the square of the distance.
        let px2_per_galaxy = (60.0 / settings.pixel_arcsec).powi(2) / settings.density;
        let distance = (px2_per_galaxy * 2.0 / 3f64.sqrt()).sqrt();
        let places = |step: f64| (2.0 * settings.half_field() / step).ceil() as usize;
        let lattice = (
            distance,
            [places(distance), places(distance * 0.75f64.sqrt())],
        );
        Ok(SceneSimulator {
            settings,
            fits,
            psf,
            transform: PsfTransform::new(PSF).expect("β = 3 is a valid profile"),
            renderers: STAMPS.map(Renderer::new).into(),
            lattice,
        })
    }

    pub fn settings(&self) -> &SceneSettings {
        &self.settings
    }

    /// Objects of a scene, of which some are beyond the edges of the image: galaxies, then stars.
    pub fn objects(&self) -> usize {
        self.galaxies()
            + (self.settings.star_density * self.settings.field_arcmin2()).round() as usize
    }

    fn galaxies(&self) -> usize {
        match self.settings.layout {
            Layout::Hexagonal => self.lattice.1.iter().product(),
            Layout::Random => {
                (self.settings.density * self.settings.field_arcmin2()).round() as usize
            }
        }
    }

    /// Pixels along the edges that the largest shear of these scenes, or of GREAT3 where each has its own, moves objects across.
    pub fn sheared_border(&self) -> f64 {
        let g = self.settings.constant_shear.map(|[g1, g2]| g1.hypot(g2));
        g.unwrap_or(MAX_RANDOM_SHEAR) * self.settings.side as f64 / 2.0
    }

    /// The shear of a scene (from 1).
    pub fn shear(&self, scene: u32) -> Shear {
        let g = match self.settings.constant_shear {
            Some([g1, g2]) => Complex64::new(g1, g2),
            None => random_shear(&mut self.settings.stream(scene, Purpose::Shear)),
        };
        // Subtracted from zero, which makes no minus zero.
        match self.settings.opposite {
            true => Shear::new(0.0 - g.re, 0.0 - g.im),
            false => Shear::new(g.re, g.im),
        }
    }

    /// The PSF at the middle as a star without noise, of sum one.
    pub fn star(&self) -> Array2<f32> {
        self.psf.stamp(STAR).mapv(|value| value as f32)
    }

    /// The PSF as a polynomial of degree two of the place from the middle, in units of the side: its terms 1, u, u², v, uv and v², on stamps
    /// with a pixel at the middle.
    pub fn star_terms(&self) -> Vec<f64> {
        let star = |u: f64, v: f64| self.at_place([2.0 * u, 2.0 * v]).stamp(STAR + 1);
        let (middle, edge) = (star(0.0, 0.0), 0.5);
        let [right, left] = [star(edge, 0.0), star(-edge, 0.0)];
        let [up, down] = [star(0.0, edge), star(0.0, -edge)];
        let corners = [(edge, edge), (-edge, -edge), (edge, -edge), (-edge, edge)];
        let [a, b, c, d] = corners.map(|(u, v)| star(u, v));
        let square = |one: &Array2<f64>, other: &Array2<f64>| 2.0 * (one + other - 2.0 * &middle);
        let (of_u2, of_v2) = (square(&right, &left), square(&up, &down));
        let terms = [middle, right - left, of_u2, up - down, a + b - c - d, of_v2];
        terms.iter().flatten().copied().collect()
    }

    // At a place from the middle in units of half the side. Beyond the edges it is as at them.
    fn at_place(&self, place: [f64; 2]) -> FunctionalPsf {
        let inside = place.map(|at| at.clamp(-1.0, 1.0));
        psf_at(&self.settings, inside).expect("settings were checked")
    }

    fn transformed(&self, psf: &FunctionalPsf) -> TransformedPsf<'_> {
        self.transform
            .of(psf)
            .expect("the transform is that of the PSF's profile")
    }

    /// Object `index` of a scene; `None` if it adds no light to the images.
    pub fn source(&self, scene: u32, index: usize) -> Option<Source> {
        let settings = &self.settings;
        let (is_star, purpose, own) = match index.checked_sub(self.galaxies()) {
            Some(star) => (true, Purpose::Star, star),
            None => (false, Purpose::Galaxy, index),
        };
        let mut rng = settings.stream(scene, purpose);
        rng.set_stream(own as u64);
        let place = match settings.layout {
            Layout::Hexagonal if !is_star => self.lattice_place(index, &mut rng),
            _ => {
                let half = settings.half_field();
                [0; 2].map(|_| rng.random_range(-half..half))
            }
        };
        let place = match settings.rotated {
            true => [-place[1], place[0]],
            false => place,
        };
        let g = match is_star {
            true => Shear::ZERO,
            false => self.shear(scene),
        };
        let middle = 0.5 * (settings.side as f64 - 1.0);
        let offset = apply(g.matrix(), place);
        if !is_within(offset, settings.reach() + EDGE_PX) {
            return None;
        }
        let centre = offset.map(|offset| middle + offset);
        Some(match is_star {
            true => self.star_source(index, centre, &mut rng),
            false => self.galaxy_source(index, centre, g, &mut rng),
        })
    }

    // A place of the lattice, from the middle of the image.
    fn lattice_place(&self, index: usize, rng: &mut ChaCha8Rng) -> [f64; 2] {
        let (distance, [columns, rows]) = self.lattice;
        let (column, row) = (index % columns, index / columns);
        let shift = if row % 2 == 1 { 0.5 } else { 0.0 };
        let x = column as f64 + shift - 0.5 * columns as f64;
        let y = (row as f64 - 0.5 * rows as f64) * 0.75f64.sqrt();
        [x, y].map(|at| at * distance + rng.random_range(-LATTICE_OFFSET_PX..LATTICE_OFFSET_PX))
    }

    fn star_source(&self, index: usize, centre: [f64; 2], rng: &mut ChaCha8Rng) -> Source {
        let snr = random_snr(rng, STAR_SNR.into(), STAR_POWER);
        let point = |flux| Galaxy::point(flux).expect("fluxes drawn here are positive");
        let flux = snr * NOISE_SIGMA / power(&point(1.0), &self.transformed(&self.psf)).sqrt();
        Source {
            index,
            is_star: true,
            centre,
            snr,
            flux,
            half_light_px: 0.0,
            bulge_share: 0.0,
            bulge_half_light_px: 0.0,
            fit: 0,
            intrinsic: Shear::ZERO,
            observed: Shear::ZERO,
            light: point(flux),
        }
    }

    fn galaxy_source(
        &self,
        index: usize,
        centre: [f64; 2],
        g: Shear,
        rng: &mut ChaCha8Rng,
    ) -> Source {
        let settings = &self.settings;
        // N(> S/N) as a power of it: magnitudes are −2.5 log₁₀ of the flux.
        let snr = random_snr(rng, settings.snr, 2.5 * settings.counts_slope);
        let angle = rng.random_range(0.0..TAU);
        let (row, fit) = match self.fits.len() {
            0 => (0, population(snr, rng)),
            count => {
                let row = rng.random_range(0..count);
                (row + 1, self.fits[row])
            }
        };
        let snr = fit.snr.unwrap_or(snr);
        let direction = Complex64::from_polar(if settings.rotated { -1.0 } else { 1.0 }, angle);
        let intrinsic = |own: &FitComponent| {
            let e = direction * own.modulus();
            Shear::new(e.re, e.im)
        };
        let galaxy = |flux, g| {
            fit.galaxy(settings.pixel_arcsec, flux, |own| {
                intrinsic(own).sheared_by(g)
            })
            .expect("fits were checked, and ellipticities are within range")
        };
        // S/N is defined before lensing, so that a cut by it does not select by shear.
        let unlensed = galaxy(1.0, Shear::ZERO);
        let scale = snr * NOISE_SIGMA / power(&unlensed, &self.transformed(&self.psf)).sqrt();
        let light = galaxy(scale, g);
        let bulge = fit.bulge.map_or(0.0, |bulge| bulge.flux);
        let bulge_radius = fit.bulge.map_or(0.0, |bulge| bulge.half_light_arcsec);
        Source {
            index,
            is_star: false,
            centre,
            snr,
            flux: light.flux(),
            half_light_px: fit.main.half_light_arcsec / settings.pixel_arcsec,
            bulge_share: bulge / (bulge + fit.main.flux),
            bulge_half_light_px: bulge_radius / settings.pixel_arcsec,
            fit: row,
            intrinsic: intrinsic(&fit.main),
            observed: intrinsic(&fit.main).sheared_by(g),
            light,
        }
    }

    /// A source as a view of the scene has it; `None` if it adds no light to that image.
    pub fn seen(&self, source: &Source, view: View) -> Option<Source> {
        let middle = 0.5 * (self.settings.side as f64 - 1.0);
        let mut seen = *source;
        // The first epoch keeps the bits.
        if view != View::default() {
            let [x, y] = source.centre.map(|at| at - middle);
            let (sin, cos) = view.radians.sin_cos();
            let turned = [cos * x - sin * y, sin * x + cos * y];
            seen.centre = [0, 1].map(|axis| middle + turned[axis] + view.dither[axis]);
            seen.light = source.light.turned(view.radians);
        }
        let offset = seen.centre.map(|at| at - middle);
        is_within(offset, 0.5 * self.settings.side as f64 + EDGE_PX).then_some(seen)
    }

    /// Draws a source. Its light beyond the stamp is below 10⁻⁴ of its peak.
    pub fn draw(&self, source: &Source, scratch: &mut RenderScratch) -> Stamp {
        let half = 0.5 * self.settings.side as f64;
        let psf = self.at_place(source.centre.map(|at| (at + 0.5) / half - 1.0));
        let psf = self.transformed(&psf);
        let largest = STAMPS.len() - 1;
        let at = stamp_side(&source.light, &psf, &STAMPS).unwrap_or(largest);
        let side = STAMPS[at];
        let middle = 0.5 * (side as f64 - 1.0);
        let corner = source.centre.map(|centre| (centre - middle).round());
        let [x, y] = [0, 1].map(|axis| source.centre[axis] - corner[axis]);
        let mut pixels = vec![0.0; side * side];
        self.renderers[at].render(&source.light, &psf, (x, y), scratch, &mut pixels);
        Stamp {
            corner: corner.map(|pixel| pixel as i64),
            side,
            pixels,
        }
    }

    /// Adds the noise of an epoch (from 1) of a scene to the light of its sources, `[y, x]`. All versions of a scene have the same noise but for its
    /// sign, whatever their galaxies, unless light has noise.
    pub fn add_noise(&self, scene: u32, epoch: u32, image: &mut Array2<f32>) {
        let mut rng = (self.settings).stream_of_epoch(scene, epoch, Purpose::Noise);
        let sign = if self.settings.negative_noise {
            -1.0
        } else {
            1.0
        };
        let sigma = (sign * NOISE_SIGMA) as f32;
        let mut noise = vec![0.0; image.ncols()];
        for mut row in image.rows_mut() {
            let Some(pixels) = row.as_slice_mut() else {
                continue;
            };
            let Some(gain) = self.settings.gain else {
                add_noise(&mut rng, 1.0, sigma, pixels);
                continue;
            };
            add_noise(&mut rng, 0.0, sigma, &mut noise);
            // The variance of electrons is their number.
            let of_light = 1.0 / (gain * NOISE_SIGMA * NOISE_SIGMA) as f32;
            for (pixel, noise) in pixels.iter_mut().zip(&noise) {
                *pixel += noise * (1.0 + of_light * pixel.max(0.0)).sqrt();
            }
        }
    }
}

// Whether a place from the middle is at most so far along both axes.
fn is_within(offset: [f64; 2], reach: f64) -> bool {
    offset.iter().all(|at| (-reach..reach).contains(at))
}

// At a place from the middle of the scene, in units of half the side.
fn psf_at(settings: &SceneSettings, [u, v]: [f64; 2]) -> Result<FunctionalPsf, ProfileError> {
    let [of_size, of_shape] = settings.psf_gradient;
    let fwhm = settings.seeing_arcsec / settings.pixel_arcsec * (1.0 + of_size * u);
    let [e1, e2] = settings.psf_shape;
    FunctionalPsf::new(PSF, fwhm, Shear::new(e1 + of_shape * u, e2 + of_shape * v))
}

// An S/N between two bounds with N(> S/N) ∝ (S/N)^−power.
fn random_snr(rng: &mut ChaCha8Rng, [faint, bright]: [f64; 2], power: f64) -> f64 {
    let u: f64 = rng.random();
    let (low, high) = (bright.powf(-power), faint.powf(-power));
    (low + (high - low) * (1.0 - u)).powf(-1.0 / power)
}

/// A galaxy of the default population: an exponential disc, and a de Vaucouleurs bulge of its ellipticity with up to 0.4 of the
/// light. Bright galaxies are larger.
fn population(snr: f64, rng: &mut ChaCha8Rng) -> Fit {
    let median = MEDIAN_RADIUS_ARCSEC * (snr / RADIUS_SNR).powf(RADIUS_POWER);
    let radius = log_normal(rng, median, RADIUS_SCATTER, RADII_ARCSEC);
    let e = rayleigh(rng, INTRINSIC_SIGMA, MAX_INTRINSIC_MODULUS);
    let share = rng.random_range(0.0..MAX_BULGE_SHARE);
    let component = |profile, half_light_arcsec, flux| FitComponent {
        profile,
        half_light_arcsec,
        flux,
        axis_ratio: axis_ratio(e),
    };
    Fit {
        main: component(Sersic::Exponential, radius, 1.0 - share),
        bulge: Some(component(
            Sersic::DeVaucouleurs,
            BULGE_RADIUS * radius,
            share,
        )),
        snr: None,
    }
}

#[cfg(test)]
mod tests;
