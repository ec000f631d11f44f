//! The linear network in closed form, and the autocorrelation of its result.
//!
//! A PSF has its centre at (p − 1)/2, as stamps have it, because the window is fixed at the stamp's middle; the network has it at
//! pixel p/2, as the convolution of the paper.
//!
//! Without thresholds (Nurbaeva et al. 2015, Eq. 11) and clipping (Eq. 14), the adaptive update v ← v + c·f (Eqs. 12 and 13)
//! from v = 0 is linear. On a plane without boundary each Fourier mode evolves alone, and the shape is measured on the result of
//! M iterations, convolved with a round Gaussian of σ:
//!
//! ```text
//! v̂ = Γ · [1 − (1 − c w)^M] · conj(p)/w · û,    w = |p|² + λ d²,
//! ```
//!
//! with û, p and d the transforms of the stamp, of the PSF and of Sun's kernel. Γ is the transform of the Gaussian times a taper
//! that falls to zero towards |k| = [`TARGET_CUT`]/σ. No mode enters that the PSF has destroyed, and what remains of the PSF is
//! round. (A sharp cut would bring noise from afar.)
//!
//! The result is multiplied by a round Gaussian window, which keeps out most of the noise, before its
//! autocorrelation is taken. (A window on the stamp itself would cut into the PSF, and what was then
//! deconvolved would have the opposite of its ellipticity.) Noise of level σ and power σ²S adds to the mean of the power of
//! each mode what the window brings there of σ²SΓ²[…]²|p|²/w², which is subtracted. So few modes remain that lags are sampled
//! on a coarse grid.
//!
//! # Response to shear
//!
//! A shear γ₁ of the galaxy (before the PSF) changes the transform s = û/p of the whole stamp by
//! (k_x ∂_x − k_y ∂_y)s, γ₂ by (k_y ∂_x + k_x ∂_y)s (∂ with respect to k). ∂û is the transform of
//! −i·x times the stamp, so that the change of the autocorrelation with shear follows from the stamp
//! itself: metacalibration (Huff & Mandelbaum 2017) in the limit of a small shear. The change is
//! worked out on the whole stamp and windowed then: a shear moves the galaxy and not the window, nor the edges of the stamp
//! ([`Edges`]).
//!
//! # Sheared pixels
//!
//! On the sky, pixels may be sheared. Stamp and PSF are then transformed as what they are, samples on a skewed lattice
//! ([`PixelShape::map`]), at the wave vectors of square pixels of their area. All that follows stays as it is: target, window,
//! lags and shear are round in those coordinates. Turning and shearing the ellipticities afterwards would be right to
//! first order in the shear of the pixels only.

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::PixelShape;
use shearq_quantities::fourier::Complex64;
use shearq_quantities::linear::LANES;
use shearq_submissions::LinearDeconvolution;

use super::edges::{Edges, EdgesScratch};
use super::modes::{
    MIN_PSF_POWER, add_squares, amplitudes, dot, multiply_modes, negative_products, roots, weighted,
};
use super::noise::{ModeNoise, NoiseChanges, change_of_power, subtract_noise};
use super::pixels::EpochPixels;
use super::restoration::{Restoration, restore, sheared};
use super::window::{Smoothing, even_modes, inside};
use crate::error::MeasureError;
use crate::network::high_pass;
use crate::noise::StampNoise;
use crate::pixels::{check_psf, check_sizes, copy_row};
use crate::transform::{
    HexLattice, LagsScratch, Modes, Plane, Spectrum, ToLags, ToModes, ToTurnedModes,
    TransformScratch, even_parities, lanes, store, table,
};

// Margin around a stamp, so that the deconvolved stamp does not wrap around. Chosen by hand.
const MARGIN_PX: usize = 8;
// Period of the plane in multiples of this. Layout: sizes whose rows fill vectors.
const PERIOD_STEP_PX: usize = 16;
// Largest wave number of the target Γ, times its σ. Chosen by hand: the Gaussian alone is 0.09 there, and noise outweighs the
// galaxy beyond it.
pub(super) const TARGET_CUT: f64 = 2.2;
// Share of the largest wave number at which the taper of Γ begins. Chosen by hand.
const TAPER_START: f64 = 0.75;
// Value of the window at the middle of an edge above which the edge correction is applied. Chosen by hand. Below it |m|
// stays under 10⁻³ for the largest galaxies, and a tenth of the time is saved.
const MIN_EDGE_WINDOW: f64 = 0.02;
// Radius of the ring whose light over the flux is the column `neighbour`, in σ of the window. Chosen by hand: 12 px for a
// window of 8 px.
const RING_RADIUS: f64 = 1.5;
// Largest radius of the ring in units of the stamp's side. At the edges of the stamp the ring's weight has fallen to 4 % of
// its peak.
const LARGEST_RING: f64 = 0.25;
// Largest lag of the autocorrelation in σ of the window. Chosen by hand: the window's autocorrelation is a fifth there.
const LARGEST_LAG: f64 = 2.5;
// Rows of lags per sample of a grid that samples the kept modes, along an axis, at least. Chosen by hand. Lags are closer
// together than the modes would need because the weight of the moments, which multiplies the autocorrelation, has finer
// structure.
const LAGS_PER_SAMPLE: f64 = 1.5;

/// The linear network for one stamp size.
#[derive(Debug, Clone)]
pub struct Spectral {
    pub(super) step: f32,
    pub(super) iterations: i32,
    pub(super) plane: Plane,
    pub(super) stamp: ToModes,
    pub(super) psf: ToModes,
    /// λ d² of each mode.
    pub(super) rough: Vec<f32>,
    /// Γ of each mode.
    pub(super) target: Vec<f32>,
    /// k_x and k_y of each mode, in radians per pixel.
    pub(super) waves: [Vec<f32>; 2],
    /// For how many modes of the plane each stands. One without k_y is stored twice, and counts half each time.
    pub(super) counts: Vec<f32>,
    /// Place of each mode turned by 90 degrees, or of its opposite.
    pub(super) turned: Vec<u32>,
    pub(super) window_sigma: f64,
    pub(super) window: Smoothing,
    pub(super) window_spectrum: Spectrum,
    /// Of the ring (r/R)⁴ exp(2 − 2r²/R²), and what its parts cc count in the light of the ring.
    pub(super) ring_spectrum: Spectrum,
    pub(super) ring_counts: Vec<f32>,
    /// What windowed noise of a power becomes, in units of σ².
    pub(super) leak: Smoothing,
    pub(super) edges: Edges,
    pub(super) to_lags: ToLags,
    pub(super) lattice: HexLattice,
    /// Scale of the autocorrelation for modes in the largest circle of those kept, zero outside; of a quarter.
    pub(super) scale: Vec<f32>,
    /// Share of the noise under the window that the stamp contains.
    pub(super) inside: f32,
}

/// Buffers for one thread. Their content between calls does not matter, but for the stamp that
/// `Spectral::products` reads, and the PSF on pixels of another shape.
#[derive(Debug, Clone)]
pub struct SpectralScratch {
    pub(super) of_stamp: TransformScratch,
    pub(super) of_psf: TransformScratch,
    /// Spectra mode by mode, before the window.
    pub(super) changes: [Modes; 3],
    /// v̂ of a stamp and its changes with the components of shear, behind the window; or other changes.
    pub(super) windowed: [Spectrum; 3],
    pub(super) psf_image: Vec<f32>,
    /// v̂ of the stamp behind the window.
    pub(super) stamp: Spectrum,
    pub(super) gradients: [Spectrum; 5],
    /// Real spectra, mode by mode.
    pub(super) real: [Vec<f32>; 2],
    /// A real even spectrum by parity.
    pub(super) even: Vec<f32>,
    /// A quarter on its way through the window.
    pub(super) quarter: Vec<f32>,
    /// The shape of pixels and, if they are not square, the transforms of stamps and of PSFs.
    pub(super) pixels: PixelShape,
    pub(super) skewed: Option<Box<[ToModes; 2]>>,
    /// Where the window is, (x, y) in pixels from the middle of the stamp, and the phases that move this place to the origin.
    pub(super) centre: [f32; 2],
    pub(super) phases: Modes,
    /// Origin of the shear (x, y) in pixels from the middle of the stamp.
    pub(super) origin: [f32; 2],
    pub(super) edges: EdgesScratch,
    /// v̂ and its changes, summed over epochs, before the window.
    pub(super) sums: [Spectrum; 3],
    pub(super) turned: Option<Box<TurnedScratch>>,
    pub(super) lags: LagsScratch,
}

/// Transforms of pixels that are turned against those of other epochs.
#[derive(Debug, Clone)]
pub(super) struct TurnedScratch {
    pub(super) stamps: ToTurnedModes,
    pub(super) psfs: ToTurnedModes,
    pub(super) edges: Vec<f32>,
}

/// Autocorrelations on the half of the lags of [`Spectral::lattice`] with dy ≥ 0, row by row; the others follow from
/// A(−dx, −dy) = A(dx, dy).
#[derive(Debug, Clone)]
pub struct Lags {
    /// Of the result.
    pub acf: Vec<f32>,
    /// Its derivative with respect to a shear γ₁ of the galaxy.
    pub shear1: Vec<f32>,
    /// Its derivative with respect to γ₂.
    pub shear2: Vec<f32>,
    /// Sum of the windowed result.
    pub flux: Light<f32>,
    /// Sum of the result under the ring.
    pub ring: Light<f32>,
}

/// A sum over the image.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Light<T> {
    /// The sum.
    pub value: T,
    /// Its derivatives with respect to γ₁ and γ₂.
    pub response: [T; 2],
}

impl<T: Copy> Light<T> {
    pub(crate) fn map<U>(self, of: impl Fn(T) -> U) -> Light<U> {
        Light {
            value: of(self.value),
            response: self.response.map(of),
        }
    }
}

/// The PSF of one of the stamps of a galaxy.
#[derive(Debug, Clone)]
pub(super) struct SpectralEpoch {
    pub(super) pixels: EpochPixels,
    /// v̂/û of the epoch; until epochs are combined, p.
    pub(super) restore: Modes,
    /// (k_x ∂_x − k_y ∂_y)p/p and (k_y ∂_x + k_x ∂_y)p/p; until epochs are combined, the transforms of the PSF times x and y.
    pub(super) tilts: [Modes; 2],
}

/// The PSF of a galaxy, or those of its epochs, as the linear network uses them.
#[derive(Debug, Clone)]
pub struct SpectralPsf {
    /// Their first `count` are those of the galaxy; others are buffers.
    pub(super) epochs: Vec<SpectralEpoch>,
    pub(super) count: usize,
    /// Σ u|p|²/S of each mode: the squared S/N of a point source of flux one in noise of level one.
    pub(super) clarity: Vec<f32>,
    /// Change of a mode of noise with the components of shear, in units of it and in the mean.
    pub(super) field_tilts: [Vec<f32>; 2],
    /// Mean power of windowed noise, in units of σ², by parity.
    pub(super) floor: Vec<f32>,
    /// Mean of −Re(conj(v̂)·δv̂) of windowed noise, in units of σ², by parity.
    pub(super) noise_tilts: [Vec<f32>; 2],
    /// Power of noise of σ = 1 before the window, of each mode and the modes that it stands for, times each change; by parity.
    pub(super) powers: NoiseChanges<Vec<f32>>,
}

impl SpectralPsf {
    /// |p|²/S of each mode, S being the power of the noise.
    pub fn clarity(&self) -> &[f32] {
        &self.clarity
    }

    /// Standard deviation of [`Lags::flux`] in noise of σ = 1.
    pub fn flux_error(&self) -> f32 {
        self.floor[0].sqrt()
    }
}

impl Spectral {
    /// Plans for n×n stamps and p×p PSFs.
    ///
    /// # Errors
    /// Where a size is out of range.
    pub fn new(n: usize, p: usize, settings: &LinearDeconvolution) -> Result<Self, MeasureError> {
        check_sizes(n, p)?;
        let (sigma, window_sigma) = (settings.target_sigma, settings.window_sigma);
        // At most 2.2, below the Nyquist frequency of the stamp, π: σ is at least 1 px.
        let cut = TARGET_CUT / sigma;
        let period = (n + MARGIN_PX).max(p).next_multiple_of(PERIOD_STEP_PX);
        let samples = (cut * period as f64 / std::f64::consts::PI).ceil() as usize + 2;
        let samples = smooth_length(samples).min(period);
        let plane = Plane::new(period, samples / 2 - 1);
        let lags = smooth_length((LAGS_PER_SAMPLE * samples as f64).ceil() as usize);
        let row_spacing = period as f64 / lags as f64;
        let reach = (LARGEST_LAG * window_sigma / row_spacing) as usize;
        let lattice = HexLattice {
            row_spacing,
            reach: reach.clamp(1, lags / 2 - 1),
        };

        let indices = || (0..2 * plane.quarter()).map(|at| plane.indices(at));
        let waves: Vec<[f64; 2]> = indices()
            .map(|(x, y, below)| {
                [
                    plane.wave(x),
                    if below { -1.0 } else { 1.0 } * plane.wave(y),
                ]
            })
            .collect();
        let kept = |x: usize, y: usize| x.max(y) <= plane.modes;
        let counts = indices().map(|(x, y, _)| match (kept(x, y), y) {
            (false, _) => 0.0,
            (true, 0) => 0.5 * plane.count(x) as f32,
            (true, _) => plane.count(x) as f32,
        });
        // (k_x, k_y) becomes (k_y, −k_x), and (k_x, −k_y) the opposite of (k_y, k_x).
        let turned = indices().enumerate().map(|(at, (x, y, below))| {
            let place = if kept(x, y) {
                plane.place(y, x, !below)
            } else {
                at
            };
            place as u32
        });
        let target = waves.iter().map(|&[kx, ky]| {
            let square = kx * kx + ky * ky;
            (taper(square.sqrt() / cut) * (-0.5 * sigma * sigma * square).exp()) as f32
        });
        let rough = waves
            .iter()
            .map(|&[kx, ky]| (settings.lambda * high_pass(kx, ky).powi(2)) as f32);
        let circle = plane.wave(plane.modes) * (1.0 + 1e-12);
        let size = period as f64;
        let scale = waves[..plane.quarter()].iter().map(|&[kx, ky]| {
            if kx.hypot(ky) <= circle {
                1.0 / (size * size) as f32
            } else {
                0.0
            }
        });
        let window = even_modes(|x| (-0.5 * (x / window_sigma).powi(2)).exp(), &plane);
        let radius = (RING_RADIUS * window_sigma).min(LARGEST_RING * n as f64);
        let [ring0, ring2, ring4] = [0, 2, 4].map(|power| {
            let along =
                |x: f64| (x / radius).powi(power) * (1.0 - 2.0 * (x / radius).powi(2)).exp();
            even_modes(along, &plane)
        });
        let ring = |y: usize, x: usize| {
            ring0[x] * ring4[y] + 2.0 * ring2[x] * ring2[y] + ring4[x] * ring0[y]
        };
        let inside = inside(n, window_sigma);
        let mut window_spectrum = plane.spectrum();
        let [cc, ..] = window_spectrum.quarters_mut();
        let side = plane.modes + 1;
        let stored = [plane.rows, plane.width];
        cc.copy_from_slice(&table([side, side], stored, |y, x| window[x] * window[y]));
        let mut ring_spectrum = plane.spectrum();
        let [cc, ..] = ring_spectrum.quarters_mut();
        cc.copy_from_slice(&table([side, side], stored, ring));
        let count = |mode: usize| if mode == 0 { 1.0 } else { 2.0 };
        let ring_counts = table([side, side], stored, |y, x| {
            count(y) * count(x) * ring(y, x)
        });
        Ok(Spectral {
            step: settings.step as f32,
            iterations: i32::try_from(settings.max_iterations).unwrap_or(i32::MAX),
            stamp: ToModes::new(n, &plane, true),
            psf: ToModes::new(p, &plane, true),
            rough: rough.collect(),
            target: target.collect(),
            counts: counts.collect(),
            turned: turned.collect(),
            scale: scale.collect(),
            waves: [0, 1].map(|axis| waves.iter().map(|k| k[axis] as f32).collect()),
            window_sigma,
            window: Smoothing::new(|distance| window[distance], &plane),
            window_spectrum,
            ring_spectrum,
            ring_counts,
            leak: Smoothing::new(|distance| inside * size * window[distance].powi(2), &plane),
            edges: Edges::new(n, &plane),
            to_lags: ToLags::hexagonal(lattice, lags, &plane),
            lattice,
            inside: (inside * inside) as f32,
            plane,
        })
    }

    /// Stamp side n.
    pub fn stamp_size(&self) -> usize {
        self.stamp.side()
    }

    /// Where the lags are.
    pub fn lattice(&self) -> HexLattice {
        self.lattice
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> SpectralScratch {
        let p = self.psf.side();
        let zeros = |quarters: usize| vec![0.0; quarters * self.plane.quarter()];
        SpectralScratch {
            of_stamp: self.stamp.scratch(),
            of_psf: self.psf.scratch(),
            changes: [(); 3].map(|()| self.plane.mode_by_mode()),
            windowed: [(); 3].map(|()| self.plane.spectrum()),
            psf_image: vec![0.0; p * p],
            stamp: self.plane.spectrum(),
            gradients: [(); 5].map(|()| self.plane.spectrum()),
            real: [zeros(2), zeros(2)],
            even: zeros(2),
            quarter: zeros(1),
            pixels: PixelShape::SQUARE,
            skewed: None,
            centre: [0.0; 2],
            phases: self.plane.mode_by_mode(),
            origin: [0.0; 2],
            edges: self.edges.scratch(&self.plane),
            sums: [(); 3].map(|()| self.plane.spectrum()),
            turned: None,
            lags: self.to_lags.scratch(),
        }
    }

    /// Room for the lags.
    pub fn lags(&self) -> Lags {
        let lags = vec![0.0; self.to_lags.len()];
        Lags {
            acf: lags.clone(),
            shear1: lags.clone(),
            shear2: lags,
            flux: Light::default(),
            ring: Light::default(),
        }
    }

    /// A PSF of zeros.
    pub fn psf(&self) -> SpectralPsf {
        let zeros = || vec![0.0; self.target.len()];
        SpectralPsf {
            epochs: Vec::new(),
            count: 0,
            clarity: zeros(),
            field_tilts: [zeros(), zeros()],
            floor: zeros(),
            noise_tilts: [zeros(), zeros()],
            powers: NoiseChanges {
                sheared: [zeros(), zeros()],
                turned: zeros(),
                plain: zeros(),
            },
        }
    }

    /// Noise of level one with the correlation of `noise`.
    pub fn noise(&self, noise: &StampNoise) -> ModeNoise {
        self.noise_on(noise, PixelShape::SQUARE)
    }

    /// The same for pixels of this shape.
    pub(crate) fn noise_on(&self, noise: &StampNoise, pixels: PixelShape) -> ModeNoise {
        let waves = self.waves[0].iter().zip(&self.waves[1]);
        let mut out = ModeNoise {
            power: Vec::with_capacity(self.counts.len()),
            tilts: Default::default(),
        };
        for (&kx, &ky) in waves {
            let (power, slopes) = noise.power([kx, ky].map(f64::from), pixels);
            out.power.push(power as f32);
            for (tilt, slope) in out.tilts.iter_mut().zip(slopes) {
                tilt.push((0.5 * slope / power) as f32);
            }
        }
        out
    }

    /// |g|² of each mode over the plane's area in px², of a round Gaussian galaxy of flux one with a mean square of `extent`
    /// px² per axis, times the number of modes that it stands for. The sum of this times |p|² is that of the squared pixels
    /// of the galaxy behind p.
    pub fn light(&self, extent: f64) -> Vec<f32> {
        let area = (self.plane.period * self.plane.period) as f64;
        let [kx, ky] = &self.waves;
        let squares = kx.iter().zip(ky).map(|(x, y)| x * x + y * y);
        let modes = squares.zip(&self.counts);
        let light = modes.map(|(square, &count)| {
            (f64::from(count) / area * (-f64::from(square) * extent).exp()) as f32
        });
        light.collect()
    }

    /// Takes stamps and PSFs of such pixels from now on. Places and lengths are then in the coordinates of
    /// [`PixelShape::map`].
    pub(crate) fn set_pixel_shape(&self, shape: PixelShape, scratch: &mut SpectralScratch) {
        let shape = if shape.is_square() {
            PixelShape::SQUARE
        } else {
            shape
        };
        if scratch.pixels == shape {
            return;
        }
        scratch.pixels = shape;
        if shape != PixelShape::SQUARE {
            let both = || Box::new([self.stamp.clone(), self.psf.clone()]);
            for transform in &mut **scratch.skewed.get_or_insert_with(both) {
                transform.set_pixel_shape(&self.plane, shape);
            }
        }
    }

    /// Takes a PSF, for images with `noise`; it is used as it is, so it should sum to one and be centred on the middle of its
    /// stamp, (p − 1)/2 on both axes: the window is where deconvolution leaves the galaxy.
    ///
    /// # Errors
    /// Where its size is not the planned one or a pixel is not finite.
    pub fn set_psf(
        &self,
        psf: ArrayView2<'_, f64>,
        noise: &ModeNoise,
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) -> Result<(), MeasureError> {
        self.fill_psf_image(psf, &mut scratch.psf_image)?;
        self.retake_psf(noise, scratch, out);
        Ok(())
    }

    /// Takes the PSF last given again, after a change of the noise or of the shape of pixels.
    pub(crate) fn retake_psf(
        &self,
        noise: &ModeNoise,
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) {
        self.psf_modes(scratch);
        self.take_epoch(0, EpochPixels::Shaped(scratch.pixels), scratch, out);
        self.combine(&[1.0], noise, scratch, out);
    }

    // Takes the transforms in `scratch.changes` as those of the PSF of an epoch.
    pub(super) fn take_epoch(
        &self,
        at: usize,
        pixels: EpochPixels,
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) {
        let new = || SpectralEpoch {
            pixels,
            restore: self.plane.mode_by_mode(),
            tilts: [(); 2].map(|()| self.plane.mode_by_mode()),
        };
        out.epochs.resize_with(out.epochs.len().max(at + 1), new);
        let epoch = &mut out.epochs[at];
        epoch.pixels = pixels;
        let modes = [&mut epoch.restore].into_iter().chain(&mut epoch.tilts);
        for (modes, taken) in modes.zip(&mut scratch.changes) {
            std::mem::swap(modes, taken);
        }
    }

    /// Combines the first epochs, whose PSFs were set, with weights u that sum to one, in images with `noise`.
    pub(crate) fn combine(
        &self,
        weights: &[f32],
        noise: &ModeNoise,
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) {
        let [power, amplitude] = &mut scratch.real;
        power.fill(0.0);
        for (epoch, weight) in out.epochs.iter().zip(weights) {
            add_squares(&epoch.restore, *weight, power);
        }
        let of_modes = [&power[..], &self.rough, &self.target];
        amplitudes(of_modes, self.step, self.iterations, amplitude);
        combine(self, weights, noise, amplitude, power, out);
        out.count = weights.len();
        self.spread_noise(scratch, out);
    }

    // The transforms of the PSF last given and of it times x and y, to `scratch.changes`.
    pub(super) fn psf_modes(&self, scratch: &mut SpectralScratch) {
        let SpectralScratch {
            of_psf,
            windowed: spectra,
            changes,
            psf_image: image,
            pixels,
            skewed,
            ..
        } = scratch;
        let to_modes = match skewed {
            Some(skewed) if *pixels != PixelShape::SQUARE => &skewed[1],
            _ => &self.psf,
        };
        to_modes.transform_moments(image, of_psf, spectra);
        for (modes, spectrum) in changes.iter_mut().zip(&*spectra) {
            modes.take_spectrum(spectrum);
        }
    }

    // Copies a PSF to the middle of an image of the planned size, with zero around a smaller one.
    pub(super) fn fill_psf_image(
        &self,
        psf: ArrayView2<'_, f64>,
        image: &mut [f32],
    ) -> Result<(), MeasureError> {
        let (p, side) = (self.psf.side(), psf.nrows());
        let fits = side < p && (p - side).is_multiple_of(2);
        check_psf(psf, if fits { side } else { p })?;
        let first = (p - side) / 2;
        image.fill(0.0);
        let rows = image.chunks_exact_mut(p).skip(first);
        for (row, from) in rows.zip(psf.into_outer_iter()) {
            copy_row(from, &mut row[first..]);
        }
        Ok(())
    }

    // Writes what follows from the power of noise of σ = 1 before the window, which is in `scratch.real[0]`.
    pub(super) fn spread_noise(&self, scratch: &mut SpectralScratch, out: &mut SpectralPsf) {
        let SpectralScratch {
            real: [power, modes],
            even,
            quarter,
            ..
        } = scratch;
        let mut spread = |modes: &[f32], out: &mut [f32]| {
            even_parities(modes, out);
            self.leak.apply_even(out, quarter);
        };
        spread(power, &mut out.floor);
        for (out, tilts) in out.noise_tilts.iter_mut().zip(&out.field_tilts) {
            negative_products(tilts, power, modes);
            spread(modes, out);
        }
        // Amplitude behind the turned PSF in units of that behind the PSF, less one.
        roots(power, even);
        for (at, (out, &there)) in modes.iter_mut().zip(&self.turned).enumerate() {
            let (here, there) = (even[at], even[there as usize]);
            *out = if here > 0.0 { there / here - 1.0 } else { 0.0 };
        }
        let area = (self.plane.period * self.plane.period) as f32 * self.inside;
        let mut weigh = |change: &[f32], out: &mut [f32]| {
            weighted(change, power, &self.counts, area, even);
            even_parities(even, out);
        };
        let powers = &mut out.powers;
        for (tilt, sheared) in out.field_tilts.iter().zip(&mut powers.sheared) {
            weigh(tilt, sheared);
        }
        weigh(modes, &mut powers.turned);
        modes.fill(1.0);
        weigh(modes, &mut powers.plain);
    }

    /// Puts the window at `centre` and the origin of the shear at `origin`, (x, y) in pixels from the middle of the stamp, for the
    /// stamps that follow.
    pub fn place_window(&self, centre: [f32; 2], origin: [f32; 2], scratch: &mut SpectralScratch) {
        scratch.origin = origin;
        if scratch.centre == centre {
            return;
        }
        scratch.centre = centre;
        if centre == [0.0; 2] {
            // In the middle phases are not used.
            return;
        }
        let Modes { re, im } = &mut scratch.phases;
        let [kx, ky] = &self.waves;
        let width = self.plane.width;
        let rows = re.chunks_exact_mut(width).zip(im.chunks_exact_mut(width));
        for ((re, im), ky) in rows.zip(ky.chunks_exact(width)) {
            // In double precision: a row has one phase along y, and steps of one phase along x.
            let turn = |k: f32, by: f32| Complex64::cis(f64::from(k) * f64::from(by));
            let mut phase = turn(ky[0], centre[1]);
            let step = turn(kx[1], centre[0]);
            for (re, im) in re.iter_mut().zip(im) {
                (*re, *im) = (phase.re as f32, phase.im as f32);
                phase *= step;
            }
        }
    }

    /// Deconvolves a row-major `stamp` with noise of level `noise` and writes the
    /// autocorrelation with its derivatives. The window is where [`Spectral::place_window`] put it.
    pub fn autocorrelate(
        &self,
        psf: &SpectralPsf,
        stamp: &[f32],
        noise: f32,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        self.restore(&psf.epochs[0], stamp, scratch);
        self.take_lags(psf, noise, scratch, out);
    }

    /// Writes the lags of v̂ and its changes in `scratch.windowed`, before the window, with noise of level `noise`.
    pub(crate) fn take_lags(
        &self,
        psf: &SpectralPsf,
        noise: f32,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        let ring = |spectrum: &Spectrum| {
            let [cc, ..] = spectrum.quarters();
            dot(cc, &self.ring_counts)
        };
        let [v, first, second] = &scratch.windowed;
        out.ring = Light {
            value: ring(v),
            response: [ring(first), ring(second)],
        };
        self.apply_window(scratch);
        let SpectralScratch {
            windowed: [v, first, second],
            stamp,
            even,
            lags,
            ..
        } = scratch;
        stamp.copy_from(v);
        out.flux = Light {
            value: v.sum(),
            response: [first.sum(), second.sum()],
        };
        let variance = noise * noise;
        v.power(even);
        subtract_noise(even, &self.scale, &psf.floor, variance);
        self.to_lags.lags(even, lags, &mut out.acf);
        let sheared = [(first, &mut out.shear1), (second, &mut out.shear2)];
        for ((changed, out), mean) in sheared.into_iter().zip(&psf.noise_tilts) {
            change_of_power(v, changed, &self.scale, mean, variance, even);
            self.to_lags.lags(even, lags, out);
        }
    }

    pub(super) fn apply_window(&self, scratch: &mut SpectralScratch) {
        for spectrum in &mut scratch.windowed {
            self.window.apply(spectrum, &mut scratch.quarter);
        }
    }

    // v̂ of a stamp and its changes with the components of shear, before the window, to `scratch.windowed`.
    pub(super) fn restore(
        &self,
        SpectralEpoch {
            restore: amplitudes,
            tilts,
            ..
        }: &SpectralEpoch,
        stamp: &[f32],
        scratch: &mut SpectralScratch,
    ) {
        let SpectralScratch {
            of_stamp,
            changes: [moved, edges1, edges2],
            windowed,
            centre,
            phases,
            origin,
            edges,
            pixels,
            skewed,
            ..
        } = scratch;
        let skewed = skewed
            .as_deref()
            .filter(|_| *pixels != PixelShape::SQUARE)
            .map(|[stamp, _]| stamp);
        let to_modes = skewed.unwrap_or(&self.stamp);
        to_modes.transform_moments(stamp, of_stamp, windowed);
        let (centre, origin) = (*centre, *origin);
        let at_edges = self.sees_edges(centre, *pixels);
        if at_edges {
            let (transform, out) = ((to_modes, of_stamp), [&mut *edges1, edges2]);
            match skewed {
                None => self.edges.take(stamp, origin, transform, edges, out),
                Some(_) => {
                    let place = (origin, *pixels);
                    self.edges
                        .take_skewed(stamp, place, (transform, &self.plane), edges, out);
                }
            }
        }
        let off_middle = centre != [0.0; 2];
        if off_middle {
            moved.copy_from(amplitudes);
            multiply_modes(moved, phases);
        }
        let with = Restoration {
            restore: if off_middle { moved } else { amplitudes },
            tilts,
            waves: &self.waves,
            origin,
            edges: at_edges.then_some([edges1, edges2]),
        };
        restore(windowed, &with);
    }

    // Whether a window at `centre` contains light at the edges.
    pub(super) fn sees_edges(&self, centre: [f32; 2], pixels: PixelShape) -> bool {
        if pixels == PixelShape::SQUARE {
            let half = self.stamp_size() as f64 / 2.0;
            let off = centre.into_iter().map(f32::abs).fold(0.0, f32::max);
            let away = (half - f64::from(off)) / self.window_sigma;
            return (-0.5 * away * away).exp() > MIN_EDGE_WINDOW;
        }
        let PixelShape { stretch, skew } = pixels;
        let gradients = [(1.0 / stretch).hypot(skew), stretch];
        self.contains_light(pixels.pixel(centre.map(f64::from)), gradients)
    }

    // Whether a window at a place in pixels contains light at the edges. Distances from edges are those in pixels over the lengths
    // of the gradients of x and y.
    pub(super) fn contains_light(&self, [x, y]: [f64; 2], [sides, levels]: [f64; 2]) -> bool {
        let half = self.stamp_size() as f64 / 2.0;
        let away = ((half - x.abs()) / sides).min((half - y.abs()) / levels) / self.window_sigma;
        (-0.5 * away * away).exp() > MIN_EDGE_WINDOW
    }

    /// The deconvolved stamp itself, convolved with Γ and windowed, for pictures. It is moved by `shift` pixels along both axes.
    pub fn deconvolved(
        &self,
        psf: &SpectralPsf,
        stamp: &[f32],
        shift: f64,
        scratch: &mut SpectralScratch,
    ) -> Vec<f32> {
        let SpectralScratch {
            of_stamp,
            changes: [v, ..],
            windowed: [spectrum, ..],
            centre,
            pixels,
            skewed,
            ..
        } = scratch;
        let to_modes = match skewed {
            Some(skewed) if *pixels != PixelShape::SQUARE => &skewed[0],
            _ => &self.stamp,
        };
        to_modes.transform(stamp, of_stamp, spectrum);
        v.take_spectrum(spectrum);
        multiply_modes(v, &psf.epochs[0].restore);
        let n = self.stamp_size();
        let from_middle = |at: usize| at as f64 - (n as f64 - 1.0) / 2.0;
        let area = (self.plane.period * self.plane.period) as f64;
        let width = self.plane.width;
        let pixel = |at: usize| {
            let [x, y] = [from_middle(at % n), from_middle(at / n)];
            let [moved_x, moved_y] = pixels.map([x - shift, y - shift]);
            let [x, y] = pixels.map([x, y]);
            let mut sum = 0.0;
            for first in (0..v.re.len()).step_by(width) {
                let mut phase = Complex64::cis(f64::from(self.waves[1][first]) * moved_y);
                let step = Complex64::cis(f64::from(self.waves[0][1]) * moved_x);
                for mode in first..first + width {
                    let v = Complex64::new(f64::from(v.re[mode]), f64::from(v.im[mode]));
                    sum += f64::from(self.counts[mode]) * (v * phase).re;
                    phase *= step;
                }
            }
            let square = (x - f64::from(centre[0])).powi(2) + (y - f64::from(centre[1])).powi(2);
            let window = (-0.5 * square / self.window_sigma.powi(2)).exp();
            (sum / area * window) as f32
        };
        (0..n * n).map(pixel).collect()
    }

    /// The spectrum of weights of the lags.
    pub(crate) fn spectrum_of(&self, weights: &[f32], scratch: &mut SpectralScratch) -> Vec<f32> {
        let mut spectrum = scratch.even.clone();
        self.to_lags
            .spectrum(weights, &mut scratch.lags, &mut spectrum);
        spectrum
    }
}

// The smallest even number of at least `least` with no prime factor above 5. Dense products need none; it stays because other
// grids of modes and lags would change results.
fn smooth_length(least: usize) -> usize {
    let smooth = |size: &usize| {
        let mut rest = *size;
        for prime in [2, 3, 5] {
            while rest.is_multiple_of(prime) {
                rest /= prime;
            }
        }
        rest == 1 && size.is_multiple_of(2)
    };
    (least..).find(smooth).unwrap_or(least)
}

// Fall of Γ towards its largest wave number, at 1: a quarter of a cosine, squared.
fn taper(k: f64) -> f64 {
    if k >= 1.0 {
        // The cosine would be 10⁻¹⁶, which makes modes of denormal numbers, and these take long.
        return 0.0;
    }
    let place = ((k - TAPER_START) / (1.0 - TAPER_START)).max(0.0);
    (std::f64::consts::FRAC_PI_2 * place).cos().powi(2)
}

// Replaces the transforms of PSFs and of them times x and y by what restores stamps. `powers` are Σ u|p|², and become powers of
// the combined noise of σ = 1 before the window.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn combine(
    plan: &Spectral,
    weights: &[f32],
    noise: &ModeNoise,
    amplitudes: &[f32],
    powers: &mut [f32],
    out: &mut SpectralPsf,
) {
    let inverse = |of: f32| if of < MIN_PSF_POWER { 0.0 } else { 1.0 / of };
    for at in (0..powers.len()).step_by(LANES) {
        let (kx, ky) = (lanes(&plan.waves[0], at), lanes(&plan.waves[1], at));
        let (squares, amplitudes) = (*lanes(powers, at), lanes(amplitudes, at));
        let noise_power = lanes(&noise.power, at);
        let mut field_tilts = [0, 1].map(|component| *lanes(&noise.tilts[component], at));
        let [mut clarity, mut power] = [[0.0f32; LANES]; 2];
        for (epoch, weight) in out.epochs.iter_mut().zip(weights) {
            let [mut restore, mut first, mut second] = [[[0.0f32; LANES]; 2]; 3];
            {
                let values = |modes: &'_ Modes| [*lanes(&modes.re, at), *lanes(&modes.im, at)];
                let [p, x, y] = [&epoch.restore, &epoch.tilts[0], &epoch.tilts[1]].map(values);
                for l in 0..LANES {
                    // Times conj(p)/|p|².
                    let (re, im) = (p[0][l], -p[1][l]);
                    let (own, all) = (inverse(re * re + im * im), weight * inverse(squares[l]));
                    let [[ar, ai], [br, bi]] =
                        sheared([x[0][l], x[1][l]], [y[0][l], y[1][l]], kx[l], ky[l]);
                    let (a, b) = (ar * re - ai * im, br * re - bi * im);
                    (first[0][l], first[1][l]) = (a * own, (ar * im + ai * re) * own);
                    (second[0][l], second[1][l]) = (b * own, (br * im + bi * re) * own);
                    field_tilts[0][l] -= a * all;
                    field_tilts[1][l] -= b * all;
                    let amplitude = weight * amplitudes[l];
                    (restore[0][l], restore[1][l]) = (re * amplitude, im * amplitude);
                    let square = restore[0][l] * restore[0][l] + restore[1][l] * restore[1][l];
                    power[l] += square / weight;
                }
            }
            let [tilt1, tilt2] = &mut epoch.tilts;
            for (modes, values) in [
                (&mut epoch.restore, restore),
                (tilt1, first),
                (tilt2, second),
            ] {
                store([&mut modes.re[..], &mut modes.im[..]], at, values);
            }
        }
        for l in 0..LANES {
            power[l] *= noise_power[l];
            clarity[l] = squares[l] / noise_power[l];
        }
        let [tilt1, tilt2] = &mut out.field_tilts;
        store([&mut tilt1[..], &mut tilt2[..]], at, field_tilts);
        store([&mut out.clarity[..], &mut *powers], at, [clarity, power]);
    }
}
