//! One simulated set: the shear field of all of its images, the intrinsic ellipticities and PSFs of each image, and the
//! drawing of each galaxy.
//!
//! Random numbers come from ChaCha8 streams with the key (seed, set, image, purpose) and, for galaxies, the index on the grid
//! as the number of the stream. A galaxy therefore does not depend on the order or the thread in which it is drawn.

use std::ops::RangeInclusive;

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};
use shearq_quantities::fourier::Complex64;
use shearq_quantities::{FunctionalPsf, PsfProfile, PsfTransform, Shear, checked_when_read};
use shearq_scoring::modes::Decomposer;
use shearq_scoring::{Bins, Definition, Grid, TrueShear};

use super::field::{Content, ShearSpectrum, random_field, random_shear};
use super::fit::rayleigh;
use super::galaxy::Galaxy;
use super::kinds::{ImageType, SetKind, Variability};
use super::noise::add_noise;
use super::render::{RenderScratch, Renderer};
use super::signal::power;

#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct SettingsError(String);

impl SettingsError {
    pub(crate) fn new(message: String) -> Self {
        SettingsError(message)
    }
}

// Pixels a side of a postage stamp, as in GREAT10.
pub const STAMP: usize = 48;
/// Noise per pixel; images are scaled so that it is one.
pub const NOISE_SIGMA: f64 = 1.0;
// Per component, by default. Chosen by hand: GREAT10 did not publish it.
const DEFAULT_INTRINSIC_SIGMA: f64 = 0.14;
// Larger intrinsic ellipticities are scaled back to this modulus. Chosen by hand.
pub const MAX_INTRINSIC_MODULUS: f64 = 0.7;
// Beyond it shears are not weak, and with intrinsic shapes ellipticities could exceed 1.
const MAX_SHEAR: f64 = 0.5;
// Of PSFs, where it does not vary. Chosen by hand.
const PSF_FWHM_PX: f64 = 3.4;
// Relative amplitude of the FWHM over a field of PSFs. Chosen by hand.
const PSF_FWHM_VARIATION: f64 = 0.1;
// |ε| of one PSF for all galaxies, and of fields of Moffat PSFs, which cancel partly over the image. Chosen by hand.
const ONE_PSF_ELLIPTICITY: f64 = 0.025;
const PSF_FIELD_ELLIPTICITY: f64 = 0.05;
// |ε| of turbulent PSFs: rms over the field, and the largest value. Chosen by hand.
const TURBULENT_PSF_RMS: f64 = 0.03;
const MAX_TURBULENT_PSF_ELLIPTICITY: f64 = 0.2;
// Standard deviation of ln(size) in sets 17 and 18. Chosen by hand.
const SIZE_SCATTER: f64 = 0.2;
// Range of S/N in the "smooth" sets. Chosen by hand.
const SNR_RANGE: (f64, f64) = (10.0, 80.0);

// Galaxies a side: scoring needs 8 or more, and an image of 400² stamps has 1.5 GB.
const GRID_SIDES: RangeInclusive<usize> = 8..=400;

// Beyond these tilts all power lies in one mode or none.
const TILTS: RangeInclusive<f64> = -20.0..=20.0;

// Factors on bandpowers: beyond these, most sets have all power in one bandpower.
const SCATTERS: RangeInclusive<f64> = 1.0..=100.0;

/// Settings of a simulation apart from the list of sets and images. Reading them checks them by
/// [`SimulationSettings::validate`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(remote = "Self", deny_unknown_fields)]
pub struct SimulationSettings {
    pub seed: u64,
    /// 64 more bits of the seed of a blind challenge, so that nobody finds it by trying.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub seed_high: u64,
    pub grid: usize,
    pub spectrum: ShearSpectrum,
    /// Standard deviation of each component of the intrinsic ellipticities (shear-type).
    pub intrinsic_sigma: f64,
    /// The shear [g1, g2] of all galaxies, instead of a field drawn from `spectrum`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub constant_shear: Option<[f64; 2]>,
    /// Whether each set has one shear, drawn as in GREAT3, instead of a field.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub one_shear_per_set: bool,
    /// What images of sets with fixed PSFs share.
    #[serde(default, skip_serializing_if = "FixedPsf::is_one")]
    pub fixed_psf: FixedPsf,
    /// Whether all galaxies are turned by 90 degrees before lensing. Noise and centres stay as they are.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub rotated: bool,
}

pub(crate) fn is_zero<T: Default + PartialEq>(number: &T) -> bool {
    *number == T::default()
}

/// What all images of a set with fixed PSFs share.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FixedPsf {
    /// A PSF field that varies over the image, as in GREAT10: Nurbaeva et al., Table 2 and Sects. 5.1 and 5.3.
    Field,
    /// One PSF of all galaxies. Records without the setting mean this one.
    #[default]
    One,
}

impl FixedPsf {
    fn is_one(&self) -> bool {
        *self == FixedPsf::One
    }
}

checked_when_read!(SimulationSettings);

#[derive(Clone, Copy)]
enum Purpose {
    Shear = 1,
    Intrinsic = 2,
    Psf = 3,
    Galaxy = 4,
    Bandpowers = 5,
}

// Stands for the image in keys of streams that all images of a set share. Images count from 1, so no image has it.
const WHOLE_SET: u32 = 0;

impl SimulationSettings {
    pub fn new(seed: u64, grid: usize) -> Self {
        SimulationSettings {
            seed,
            seed_high: 0,
            grid,
            spectrum: ShearSpectrum::default(),
            intrinsic_sigma: DEFAULT_INTRINSIC_SIGMA,
            constant_shear: None,
            one_shear_per_set: false,
            fixed_psf: FixedPsf::Field,
            rotated: false,
        }
    }

    pub fn validate(&self) -> Result<(), SettingsError> {
        let &SimulationSettings {
            seed: _,
            seed_high: _,
            grid,
            spectrum:
                ShearSpectrum {
                    amplitude,
                    tilt,
                    scatter,
                },
            intrinsic_sigma,
            constant_shear,
            one_shear_per_set: _,
            fixed_psf: _,
            rotated: _,
        } = self;
        if let Some([g1, g2]) = constant_shear {
            let modulus = g1.hypot(g2);
            if modulus > MAX_SHEAR || modulus.is_nan() {
                return Err(SettingsError(format!(
                    "the constant shear is {g1}, {g2}; expected a modulus of at most {MAX_SHEAR}"
                )));
            }
        }
        if !GRID_SIDES.contains(&grid) {
            let (least, most) = (GRID_SIDES.start(), GRID_SIDES.end());
            return Err(SettingsError(format!(
                "the simulation has {grid} galaxies a side; expected {least} to {most}"
            )));
        }
        for (what, value) in [
            ("amplitude", amplitude),
            ("intrinsic_sigma", intrinsic_sigma),
        ] {
            // NaN passes no comparison, so that the condition is that of good values.
            if !(value.is_finite() && value >= 0.0) {
                return Err(SettingsError(format!(
                    "the simulation's {what} is {value}; expected a finite number, not negative"
                )));
            }
        }
        if !SCATTERS.contains(&scatter) {
            let (least, most) = (SCATTERS.start(), SCATTERS.end());
            return Err(SettingsError(format!(
                "the simulation's scatter of bandpowers is {scatter}; expected {least} to {most}"
            )));
        }
        if !TILTS.contains(&tilt) {
            let (least, most) = (TILTS.start(), TILTS.end());
            return Err(SettingsError(format!(
                "the simulation's tilt is {tilt}; expected {least} to {most}"
            )));
        }
        Ok(())
    }

    fn stream(&self, set: u32, image: u32, purpose: Purpose) -> ChaCha8Rng {
        stream_of([self.seed, self.seed_high], [set, image], purpose as u64)
    }
}

/// Random numbers that depend on a seed of 128 bits, its low half first, on two numbers and on a purpose.
pub(crate) fn stream_of(seed: [u64; 2], numbers: [u32; 2], purpose: u64) -> ChaCha8Rng {
    // The numbers have 32 bits, which leaves as many of each word for the high half.
    let with_high = |number: u32, bits: u64| u64::from(number) | bits << 32;
    let [low, high] = seed;
    let [first, second] = numbers;
    let words = [with_high(first, high), with_high(second, high >> 32)];
    stream([low, words[0], words[1], purpose])
}

/// Random numbers that depend on these words alone.
pub fn stream(words: [u64; 4]) -> ChaCha8Rng {
    let mut key = [0; 32];
    for (bytes, word) in key.chunks_exact_mut(8).zip(words) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    ChaCha8Rng::from_seed(key)
}

#[derive(Debug, Clone)]
pub enum PsfField {
    One(FunctionalPsf),
    /// One per galaxy, `[ix, iy]`.
    PerGalaxy(Array2<FunctionalPsf>),
}

impl PsfField {
    pub fn at(&self, ix: usize, iy: usize) -> &FunctionalPsf {
        match self {
            PsfField::One(psf) => psf,
            PsfField::PerGalaxy(field) => &field[(ix, iy)],
        }
    }

    /// The PSF of cell `(ix, iy)` as a star without noise, of sum one.
    pub fn star(&self, ix: usize, iy: usize) -> Array2<f32> {
        self.at(ix, iy).stamp(STAMP).mapv(|value| value as f32)
    }
}

#[derive(Debug)]
pub struct SetSimulator {
    kind: SetKind,
    settings: SimulationSettings,
    grid: Grid,
    decomposer: Decomposer,
    shear: Array2<Complex64>,
    renderer: Renderer,
    transform: PsfTransform,
}

/// Intrinsic ellipticities and PSFs over the grid of one image.
#[derive(Debug)]
pub struct ImageFields {
    pub image: u32,
    /// Unlensed shear-type ellipticities, `[ix, iy]`.
    pub intrinsic: Array2<Complex64>,
    pub psf: PsfField,
}

impl SetSimulator {
    /// Draws the fields that the whole set shares.
    pub fn new(
        kind: SetKind,
        settings: SimulationSettings,
    ) -> Result<Self, shearq_scoring::ScoringError> {
        let grid = Grid::great10(settings.grid)?;
        let decomposer = Decomposer::new(grid);
        let shear = match settings.constant_shear {
            Some([g1, g2]) => Array2::from_elem((grid.n, grid.n), Complex64::new(g1, g2)),
            None if settings.one_shear_per_set => {
                let mut rng = settings.stream(kind.set, WHOLE_SET, Purpose::Shear);
                Array2::from_elem((grid.n, grid.n), random_shear(&mut rng))
            }
            None => {
                let mut rng = settings.stream(kind.set, WHOLE_SET, Purpose::Bandpowers);
                // From a stream of their own: the field of a scatter of one is that of simulations without scatter.
                let factors = settings.spectrum.factors(&mut rng);
                let bins = Bins::new(&grid, Definition::Leaderboard);
                let mut rng = settings.stream(kind.set, WHOLE_SET, Purpose::Shear);
                random_field(&decomposer, &mut rng, Content::EOnly, |l| {
                    settings.spectrum.c_l(l) * factors[bins.nearest(l)]
                })
            }
        };
        let strongest = shear.iter().map(|g| g.norm()).fold(0.0, f64::max);
        // Comparisons with NaN are false, so that the first one alone would accept it.
        if strongest > MAX_SHEAR || shear.iter().any(|g| !g.norm().is_finite()) {
            return Err(shearq_scoring::ScoringError::StrongShear {
                found: strongest,
                most: MAX_SHEAR,
            });
        }
        let profile = psf_profile(kind);
        Ok(SetSimulator {
            kind,
            settings,
            grid,
            decomposer,
            shear,
            renderer: Renderer::new(STAMP),
            transform: PsfTransform::new(profile).expect("β = 3 and Kolmogorov are valid profiles"),
        })
    }

    pub fn kind(&self) -> SetKind {
        self.kind
    }

    pub fn grid(&self) -> Grid {
        self.grid
    }

    pub fn truth(&self) -> TrueShear {
        TrueShear {
            g1: self.shear.mapv(|g| g.re),
            g2: self.shear.mapv(|g| g.im),
        }
    }

    pub fn shear_at(&self, ix: usize, iy: usize) -> Shear {
        let g = self.shear[(ix, iy)];
        Shear::new(g.re, g.im)
    }

    /// S/N written into headers: that of every galaxy, or the mode of its distribution.
    pub fn nominal_snr(&self) -> f64 {
        match self.kind.image {
            ImageType::LowSnr => 10.0,
            ImageType::HighSnr => 40.0,
            // The fiducial S/N of Table 2 of the paper.
            _ => 20.0,
        }
    }

    /// Draws the fields of image `image` (from 1).
    pub fn image_fields(&self, image: u32) -> ImageFields {
        let image_key = |variability| match variability {
            Variability::Fixed => WHOLE_SET,
            Variability::Variable => image,
        };
        let set = self.kind.set;
        let mut rng =
            self.settings
                .stream(set, image_key(self.kind.ellipticity), Purpose::Intrinsic);
        // As in GREAT10, intrinsic ellipticities are B modes only, which do not add to the E-mode power that is scored. The
        // variance σ² of a component is half of the power per cell.
        let cell = (self.grid.side().0 / self.grid.n as f64).powi(2);
        let power = 2.0 * self.settings.intrinsic_sigma.powi(2) * cell;
        let mut intrinsic = random_field(&self.decomposer, &mut rng, Content::BOnly, |_| {
            power / NYQUIST_SHARE
        });
        intrinsic.mapv_inplace(|e| {
            let modulus = e.norm();
            let e = if modulus > MAX_INTRINSIC_MODULUS {
                e * (MAX_INTRINSIC_MODULUS / modulus)
            } else {
                e
            };
            if self.settings.rotated { -e } else { e }
        });
        let mut rng = self
            .settings
            .stream(set, image_key(self.kind.psf), Purpose::Psf);
        ImageFields {
            image,
            intrinsic,
            psf: self.psf_field(&mut rng),
        }
    }

    /// Whether all galaxies of the set have one PSF.
    pub fn has_one_psf(&self) -> bool {
        self.kind.psf == Variability::Fixed && self.settings.fixed_psf == FixedPsf::One
    }

    // One PSF has a small ellipticity in a random direction. Fields have an ellipticity that rotates over the image and a FWHM that
    // varies, with random phases. Kolmogorov PSFs have a random field of ellipticity with the power ∝ ℓ^(−11/3) of turbulence instead.
    fn psf_field(&self, rng: &mut ChaCha8Rng) -> PsfField {
        let profile = psf_profile(self.kind);
        let tau = std::f64::consts::TAU;
        let psf = |fwhm: f64, e: Complex64| {
            FunctionalPsf::new(profile, fwhm, Shear::new(e.re, e.im))
                .expect("the PSFs drawn here are within range")
        };
        if self.has_one_psf() {
            let angle = rng.random_range(0.0..tau);
            return PsfField::One(psf(
                PSF_FWHM_PX,
                Complex64::from_polar(ONE_PSF_ELLIPTICITY, angle),
            ));
        }
        let n = self.grid.n;
        let phases: [f64; 4] = std::array::from_fn(|_| rng.random_range(0.0..tau));
        let wave = |phase: f64, ix: usize, iy: usize, turns: f64| {
            let (sin, cos) = phases[3].sin_cos();
            let along = (ix as f64 * cos + iy as f64 * sin) / n as f64;
            phase + turns * tau * along
        };
        let turbulence = (self.kind.image == ImageType::Kolmogorov).then(|| {
            let field = random_field(&self.decomposer, rng, Content::Both, |l| {
                l.powf(-11.0 / 3.0)
            });
            let mean_square = field.iter().map(|e| e.norm_sqr()).sum::<f64>() / field.len() as f64;
            // Limited, because a Gaussian field has no largest value, and an |ε| near 1 has no PSF.
            field.mapv(|e| {
                let e = e * (TURBULENT_PSF_RMS / mean_square.sqrt());
                e * (MAX_TURBULENT_PSF_ELLIPTICITY / e.norm()).min(1.0)
            })
        });
        PsfField::PerGalaxy(Array2::from_shape_fn((n, n), |(ix, iy)| {
            let fwhm =
                PSF_FWHM_PX * (1.0 + PSF_FWHM_VARIATION * wave(phases[0], ix, iy, 1.0).sin());
            let e = match &turbulence {
                Some(field) => field[(ix, iy)],
                None => Complex64::from_polar(PSF_FIELD_ELLIPTICITY, wave(phases[1], ix, iy, 1.5)),
            };
            psf(fwhm, e)
        }))
    }

    /// Draws galaxy `(ix, iy)` of an image with its noise into `out` (48×48, row-major) and returns
    /// its ellipticity after lensing.
    pub fn draw(
        &self,
        fields: &ImageFields,
        ix: usize,
        iy: usize,
        scratch: &mut RenderScratch,
        out: &mut [f32],
    ) -> Shear {
        self.draw_with_noise(fields, (ix, iy), NOISE_SIGMA as f32, scratch, out);
        self.observed(fields, ix, iy)
    }

    fn draw_with_noise(
        &self,
        fields: &ImageFields,
        (ix, iy): (usize, usize),
        sigma: f32,
        scratch: &mut RenderScratch,
        out: &mut [f32],
    ) {
        let e = fields.intrinsic[(ix, iy)];
        let intrinsic = Shear::new(e.re, e.im);
        let mut rng = self
            .settings
            .stream(self.kind.set, fields.image, Purpose::Galaxy);
        rng.set_stream((iy * self.grid.n + ix) as u64);
        let centre = (STAMP as f64 - 1.0) / 2.0;
        let x = centre + rng.random_range(-0.5..0.5);
        let y = centre + rng.random_range(-0.5..0.5);
        let mut again = rng.clone();
        let (galaxy, snr) = self.galaxy(intrinsic, self.shear_at(ix, iy), &mut rng);
        let psf = self
            .transform
            .of(fields.psf.at(ix, iy))
            .expect("all PSFs of a set have one profile");
        self.renderer.render(&galaxy, &psf, (x, y), scratch, out);
        // The S/N is defined before lensing: it sets the flux, which shear does not change.
        let (unlensed, _) = self.galaxy(intrinsic, Shear::ZERO, &mut again);
        let scale = (snr * NOISE_SIGMA / power(&unlensed, &psf).sqrt()) as f32;
        add_noise(&mut rng, scale, sigma, out);
    }

    /// Draws a row of galaxies with noise: stamps side by side, row-major.
    pub fn draw_row(
        &self,
        fields: &ImageFields,
        iy: usize,
        scratch: &mut RenderScratch,
    ) -> Vec<f32> {
        self.strip(|ix, stamp| {
            self.draw(fields, ix, iy, scratch, stamp);
        })
    }

    /// Draws the stars of a row of galaxies in the same layout.
    pub fn draw_stars(&self, fields: &ImageFields, iy: usize) -> Vec<f32> {
        self.strip(|ix, stamp| {
            let star = fields.psf.star(ix, iy);
            stamp
                .iter_mut()
                .zip(&star)
                .for_each(|(to, light)| *to = *light);
        })
    }

    // The stamps that `draw` fills, for each column of the grid.
    fn strip(&self, mut draw: impl FnMut(usize, &mut [f32])) -> Vec<f32> {
        let n = self.grid.n;
        let mut strip = vec![0.0; n * STAMP * STAMP];
        let mut stamp = vec![0.0; STAMP * STAMP];
        for ix in 0..n {
            draw(ix, &mut stamp);
            let lines = strip.chunks_exact_mut(n * STAMP);
            for (line, pixels) in lines.zip(stamp.chunks_exact(STAMP)) {
                line[ix * STAMP..][..STAMP].copy_from_slice(pixels);
            }
        }
        strip
    }

    /// Ellipticity of galaxy `(ix, iy)` after lensing.
    pub fn observed(&self, fields: &ImageFields, ix: usize, iy: usize) -> Shear {
        let e = fields.intrinsic[(ix, iy)];
        Shear::new(e.re, e.im).sheared_by(self.shear_at(ix, iy))
    }

    // The galaxy and its S/N.
    fn galaxy(&self, intrinsic: Shear, shear: Shear, rng: &mut ChaCha8Rng) -> (Galaxy, f64) {
        let shape = intrinsic.sheared_by(shear);
        // Half-light radii in pixels before the PSF. Chosen by hand.
        let (mut bulge, mut disc) = match self.kind.image {
            ImageType::SmallGalaxy => (1.8, 2.6),
            ImageType::LargeGalaxy => (3.4, 10.0),
            _ => (2.3, 4.8),
        };
        let mut fraction = 0.5;
        let mut offset = None;
        let mut snr = self.nominal_snr();
        match self.kind.image {
            ImageType::SmoothSnr => {
                // A Rayleigh distribution with its mode at the nominal S/N.
                snr = rayleigh(rng, snr, SNR_RANGE.1).max(SNR_RANGE.0);
            }
            ImageType::SmoothGalaxy => {
                // Log-normal about the fiducial sizes.
                let draw: f64 = StandardNormal.sample(rng);
                let scale = (SIZE_SCATTER * draw).exp();
                bulge *= scale;
                disc *= scale;
            }
            ImageType::UniformBulge => fraction = rng.random_range(0.0..1.0),
            ImageType::OffsetBulge => {
                let dx: f64 = StandardNormal.sample(rng);
                let dy: f64 = StandardNormal.sample(rng);
                let (dx, dy) = match self.settings.rotated {
                    true => (-dy, dx),
                    false => (dx, dy),
                };
                // A shear moves the bulge with the rest of the galaxy.
                let [[xx, xy], [yx, yy]] = shear.matrix();
                offset = Some((xx * dx + xy * dy, yx * dx + yy * dy));
            }
            _ => {}
        }
        let galaxy = Galaxy::bulge_and_disc(1.0, fraction, bulge, disc, shape)
            .and_then(|galaxy| match offset {
                Some((dx, dy)) => galaxy.with_bulge_offset(dx, dy),
                None => Ok(galaxy),
            })
            .expect("sizes, fractions and ellipticities drawn here are within range");
        (galaxy, snr)
    }
}

/// Share of the grid's modes inside the circle of the axes' Nyquist multipole, which random fields
/// fill: π/4.
pub const NYQUIST_SHARE: f64 = std::f64::consts::FRAC_PI_4;

fn psf_profile(kind: SetKind) -> PsfProfile {
    match kind.image {
        ImageType::Kolmogorov => PsfProfile::Kolmogorov,
        _ => PsfProfile::Moffat { beta: 3.0 },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::galaxy::Component;

    fn settings(seed: u64, grid: usize) -> SimulationSettings {
        SimulationSettings::new(seed, grid)
    }

    #[test]
    fn rotated_galaxies_have_the_opposite_ellipticity() {
        // Set 24 has displaced bulges, which turn with their galaxies.
        let kind = SetKind::of(24).unwrap();
        let draw = |rotated, shear: [f64; 2]| {
            let settings = SimulationSettings {
                constant_shear: Some(shear),
                rotated,
                ..settings(3, 8)
            };
            let set = SetSimulator::new(kind, settings).unwrap();
            let mut fields = set.image_fields(1);
            // A round PSF: only the galaxies turn.
            let round =
                FunctionalPsf::new(psf_profile(kind), PSF_FWHM_PX, Shear::new(0.0, 0.0)).unwrap();
            fields.psf = PsfField::One(round);
            let mut scratch = RenderScratch::new();
            let mut out = vec![0.0; STAMP * STAMP];
            let e = fields.intrinsic[(2, 5)];
            set.draw_with_noise(&fields, (2, 5), 0.0, &mut scratch, &mut out);
            // Quadrupole and centroid: [xx − yy, xy, x, y], by flux.
            let mut sums = [0.0; 5];
            for (at, value) in out.iter().enumerate() {
                let centre = (STAMP as f64 - 1.0) / 2.0;
                let x = (at % STAMP) as f64 - centre;
                let y = (at / STAMP) as f64 - centre;
                let terms = [x * x - y * y, x * y, x, y, 1.0];
                for (sum, term) in sums.iter_mut().zip(terms) {
                    *sum += f64::from(*value) * term;
                }
            }
            (e, [0, 1, 2, 3].map(|k| sums[k] / sums[4]))
        };
        let (e, plain) = draw(false, [0.0, 0.0]);
        let (turned, moments) = draw(true, [0.0, 0.0]);
        assert_eq!(turned, -e);
        // The centre of the galaxy is off the centre of the stamp by the same dither, so only what is left of the
        // second moments after it changes its sign.
        let central = |m: [f64; 4]| [m[0] - m[2] * m[2] + m[3] * m[3], m[1] - m[2] * m[3]];
        let (a, b) = (central(plain), central(moments));
        // Light outside the stamp makes the moments differ by up to 0.1 px².
        for k in 0..2 {
            assert!((a[k] + b[k]).abs() < 0.1, "{a:?} {b:?}");
            assert!(a[k].abs() > 0.3, "{a:?}");
        }
        let settings = SimulationSettings {
            constant_shear: Some([0.03, -0.02]),
            ..settings(3, 8)
        };
        let truth = SetSimulator::new(kind, settings).unwrap().truth();
        assert!(truth.g1.iter().all(|g| *g == 0.03) && truth.g2.iter().all(|g| *g == -0.02));
        for (g1, shown) in [(0.6, "0.6, 0"), (f64::NAN, "NaN, 0")] {
            let settings = SimulationSettings {
                constant_shear: Some([g1, 0.0]),
                ..settings
            };
            let error = settings.validate().unwrap_err().to_string();
            assert!(error.contains(shown), "{error}");
        }
    }

    fn simulator(set: u32, seed: u64, grid: usize) -> SetSimulator {
        SetSimulator::new(SetKind::of(set).unwrap(), settings(seed, grid)).unwrap()
    }

    #[test]
    fn fixed_fields_repeat_over_images_and_variable_ones_do_not() {
        let same = |set: u32| {
            let simulator = simulator(set, 7, 16);
            let (a, b) = (simulator.image_fields(1), simulator.image_fields(2));
            (a.intrinsic == b.intrinsic, a.psf.at(3, 4) == b.psf.at(3, 4))
        };
        assert_eq!(same(1), (false, false));
        assert_eq!(same(2), (false, true));
        assert_eq!(same(3), (true, false));
        assert_eq!(same(20), (false, true));
    }

    #[test]
    fn fixed_psfs_are_a_field_unless_one_is_asked_for() {
        let psf = |set: u32, fixed_psf| {
            let settings = SimulationSettings {
                fixed_psf,
                ..settings(7, 16)
            };
            let kind = SetKind::of(set).unwrap();
            SetSimulator::new(kind, settings)
                .unwrap()
                .image_fields(1)
                .psf
        };
        for set in [1, 2, 3, 20] {
            let field = psf(set, FixedPsf::Field);
            let PsfField::PerGalaxy(each) = &field else {
                panic!("set {set}: one PSF");
            };
            let differ = |of: fn(&FunctionalPsf) -> f64| {
                let values = each.iter().map(of);
                let (least, most) = (
                    values.clone().fold(f64::INFINITY, f64::min),
                    values.fold(f64::NEG_INFINITY, f64::max),
                );
                most - least
            };
            // The FWHM varies by 10 % to both sides of 3.4 px, the ellipticity turns.
            assert!(differ(|psf| psf.fwhm) > 0.5, "set {set}");
            assert!(differ(|psf| psf.shape.e1) > 0.05, "set {set}");
            let is_one = matches!(psf(set, FixedPsf::One), PsfField::One(_));
            assert_eq!(is_one, [2, 20].contains(&set), "set {set}");
        }
        let turbulent = psf(20, FixedPsf::Field);
        let squares = (0..256).map(|k| turbulent.at(k % 16, k / 16).shape.modulus().powi(2));
        let rms = (squares.sum::<f64>() / 256.0).sqrt();
        // Limited at 0.2, which no galaxy of a field of rms 0.03 reaches.
        assert!((rms / TURBULENT_PSF_RMS - 1.0).abs() < 1e-9, "{rms}");
    }

    #[test]
    fn intrinsic_shapes_have_the_scatter_asked_for() {
        let simulator = simulator(2, 1, 64);
        let fields = simulator.image_fields(1);
        let mean = fields.intrinsic.iter().map(|e| e.norm_sqr()).sum::<f64>() / (2.0 * 4096.0);
        // 4096 modes' worth of squared Gaussians: 2 % on the variance, four sigma on σ.
        assert!((mean.sqrt() / 0.14 - 1.0).abs() < 0.05, "{}", mean.sqrt());
    }

    #[test]
    fn galaxies_depend_on_image_and_place_not_on_order() {
        let simulator = simulator(22, 5, 16);
        let fields = simulator.image_fields(1);
        let draw = |simulator: &SetSimulator, fields: &ImageFields, ix, iy| {
            let mut out = vec![0.0; STAMP * STAMP];
            simulator.draw(fields, ix, iy, &mut RenderScratch::new(), &mut out);
            out
        };
        let first = draw(&simulator, &fields, 3, 2);
        let other = draw(&simulator, &fields, 2, 3);
        assert_ne!(first, other);
        assert_eq!(first, draw(&simulator, &fields, 3, 2));
        assert_ne!(first, draw(&simulator, &simulator.image_fields(2), 3, 2));
    }

    #[test]
    fn flux_does_not_depend_on_orientation_and_shear() {
        // Small ones, of which the stamp holds nearly all light; one elliptical PSF.
        let mut fields = simulator(14, 5, 16).image_fields(1);
        let long = fields.psf.at(3, 2).shape;
        let mut out = vec![0.0; STAMP * STAMP];
        let mut flux = |intrinsic: f64, shear: f64| {
            let along = |size: f64| [long.e1, long.e2].map(|e| e * size / long.modulus());
            let [e1, e2] = along(intrinsic);
            fields.intrinsic[(3, 2)] = Complex64::new(e1, e2);
            let sheared = SimulationSettings {
                constant_shear: Some(along(shear)),
                ..settings(5, 16)
            };
            let set = SetSimulator::new(SetKind::of(14).unwrap(), sheared).unwrap();
            let mut scratch = RenderScratch::new();
            set.draw_with_noise(&fields, (3, 2), 0.0, &mut scratch, &mut out);
            out.iter().map(|v| f64::from(*v)).sum::<f64>()
        };
        let along = flux(0.3, 0.0);
        for (intrinsic, shear) in [(-0.3, 0.0), (0.3, 0.05), (-0.3, 0.05)] {
            let other = flux(intrinsic, shear);
            // Light beyond the stamp. By the S/N of the stamp itself it was 0.006.
            assert!(
                (other / along - 1.0).abs() < 1e-3,
                "{intrinsic} {shear}: {}",
                other / along - 1.0
            );
        }
    }

    /// Largest distance of the numbers' distribution from the one with this share below and at a number, which rises between its steps.
    fn farthest(mut values: Vec<f64>, below: impl Fn(f64) -> f64) -> f64 {
        values.sort_by(f64::total_cmp);
        let count = values.len() as f64;
        let ends = values.chunk_by(|a, b| a == b);
        let mut seen = 0.0;
        let distances = ends.map(|equal| {
            seen += equal.len() as f64;
            (seen / count - below(equal[0])).abs()
        });
        distances.fold(0.0, f64::max)
    }

    #[test]
    fn drawn_galaxies_have_the_distributions_stated() {
        const COUNT: u32 = 100_000;
        // Kolmogorov's limit that chance passes once in 10,000. Widths and modes that are off by 4 % are farther away.
        let limit = 2.23 / f64::from(COUNT).sqrt();
        let draw = |set: u32, of: &dyn Fn(&Galaxy, f64) -> f64| -> Vec<f64> {
            let simulator = simulator(set, 1, 8);
            let mut rng = stream([u64::from(set), 0, 0, 0]);
            let galaxies = (0..COUNT).map(|_| {
                let (galaxy, snr) = simulator.galaxy(Shear::ZERO, Shear::ZERO, &mut rng);
                of(&galaxy, snr)
            });
            galaxies.collect()
        };
        let normal = |x: f64| 0.5 * puruspe::erfc(-x / 2f64.sqrt());
        for set in [10, 11, 12] {
            let snr = draw(set, &|_, snr| snr);
            assert!(snr.iter().all(|snr| (10.0..=80.0).contains(snr)));
            let rayleigh = |snr: f64| match snr {
                80.0 => 1.0,
                _ => 1.0 - (-snr * snr / (2.0 * 20.0 * 20.0)).exp(),
            };
            let apart = farthest(snr, rayleigh);
            assert!(apart < limit, "S/N of set {set}: {apart}");
        }
        for set in [17, 18] {
            for (component, usual) in [(0, 2.3), (1, 4.8)] {
                let size = |galaxy: &Galaxy, _| galaxy.components()[component].half_light_radius;
                let apart = farthest(draw(set, &size), |size| normal((size / usual).ln() / 0.2));
                assert!(apart < limit, "sizes of set {set}: {apart}");
            }
        }
        for set in [21, 22] {
            let fraction = |galaxy: &Galaxy, _| galaxy.components()[0].flux;
            let apart = farthest(draw(set, &fraction), |fraction| fraction);
            assert!(apart < limit, "bulge fractions of set {set}: {apart}");
        }
        for set in [23, 24] {
            let offsets: [fn(&Component) -> f64; 2] = [|bulge| bulge.dx, |bulge| bulge.dy];
            for offset in offsets {
                let of_bulge = |galaxy: &Galaxy, _| offset(&galaxy.components()[0]);
                let apart = farthest(draw(set, &of_bulge), normal);
                assert!(apart < limit, "bulge offsets of set {set}: {apart}");
            }
        }
        for (set, snr, bulge, disc) in [
            (1, 20.0, 2.3, 4.8),
            (5, 10.0, 2.3, 4.8),
            (9, 40.0, 2.3, 4.8),
            (13, 20.0, 1.8, 2.6),
            (16, 20.0, 3.4, 10.0),
            (19, 20.0, 2.3, 4.8),
        ] {
            let (galaxy, found) =
                simulator(set, 1, 8).galaxy(Shear::ZERO, Shear::ZERO, &mut stream([0; 4]));
            let [first, second] = galaxy.components() else {
                panic!("set {set}: not a bulge and a disc");
            };
            let sizes = [first.half_light_radius, second.half_light_radius];
            assert_eq!((found, sizes), (snr, [bulge, disc]), "set {set}");
            assert_eq!((first.flux, second.flux), (0.5, 0.5), "set {set}");
        }
    }

    #[test]
    fn noise_and_signal_have_the_levels_stated() {
        let simulator = simulator(8, 5, 16);
        let fields = simulator.image_fields(1);
        let mut out = vec![0.0; STAMP * STAMP];
        let mut scratch = RenderScratch::new();
        let (mut total, mut corner) = (0.0, 0.0);
        for k in 0..64 {
            simulator.draw(&fields, k % 8, k / 8, &mut scratch, &mut out);
            total += out.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() / 64.0;
            let frame = out[..4 * STAMP].iter().map(|v| f64::from(*v).powi(2));
            corner += frame.sum::<f64>() / (64.0 * 4.0 * STAMP as f64);
        }
        // Noise of σ = 1 in the corner (12288 pixels: 1.3 %) and S/N 40: Σ I² = 1600.
        assert!((corner - 1.0).abs() < 0.06, "{corner}");
        let signal = total - (STAMP * STAMP) as f64;
        // √(2·2304 + 4·1600)/√64 = 13.
        assert!((signal - 1600.0).abs() < 52.0, "{signal}");
    }
}
