//! Stamps of several epochs of a galaxy, combined mode by mode before the window.
//!
//! Epoch e has a stamp û, a PSF p and white noise of level σ on pixels of area a. Inverse-variance weights W of the deconvolved stamps
//! are real and do not change with shear:
//!
//! ```text
//! Σ W û/p = Σ u conj(p) û / q,    W = u |p|²/q,    q = Σ u |p|²,    u = (a/σ²)/Σ(a/σ²).
//! ```
//!
//! With w = q + λd² the closed form of the iterations is v̂ = Γ[1 − (1 − c w)^M]/w · Σ u conj(p) û, which for one epoch equals the result for a
//! single stamp. Noise
//! has the level (Σ a/σ²)^(−½) and, in its units, the power Γ²[…]²q/w² in each mode; a shear changes it by the mean of the
//! epochs' changes with the weights W. Averages of ellipticities of single epochs would need a response of each noisy epoch:
//! with 16 epochs of S/N 5, the error of m is six times as large.
//!
//! Stamps may be turned against each other. Modes are along common axes, and turned stamps are transformed at
//! these modes ([`ToTurnedModes`]) without interpolation. The window is at the same place of the sky in all of them.

use shearq_quantities::linear::{LANES, Matrix2, ROWS, apply, determinant, inverse, product};

use super::deconvolution::{
    Lags, MIN_PSF_POWER, Restoration, Spectral, SpectralPsf, SpectralScratch, multiply_modes,
    restore, sheared,
};
use super::edges::{SHEARS, edge_lines};
use crate::error::MeasureError;
use crate::transform::ToTurnedModes;
use crate::transform::{Modes, Spectrum, lanes, store};
use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::PixelShape;

// Difference of matrices that single precision does not resolve.
const SAME: f64 = 1e-7;

/// The map from pixels of an epoch, about the middle of its stamp, to common coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum EpochPixels {
    /// Triangular, of determinant one: sums along the axes are separable.
    Shaped(PixelShape),
    Turned(Matrix2),
}

impl EpochPixels {
    pub(crate) fn new(matrix: Matrix2) -> Self {
        let [[stretch, skew], [below, last]] = matrix;
        let triangular = below.abs() < SAME && stretch > 0.0;
        if triangular && (stretch * last - 1.0).abs() < SAME {
            EpochPixels::Shaped(PixelShape { stretch, skew })
        } else {
            EpochPixels::Turned(matrix)
        }
    }

    fn matrix(self) -> Matrix2 {
        match self {
            EpochPixels::Shaped(PixelShape { stretch, skew }) => {
                [[stretch, skew], [0.0, 1.0 / stretch]]
            }
            EpochPixels::Turned(matrix) => matrix,
        }
    }

    pub(crate) fn map(self, at: [f64; 2]) -> [f64; 2] {
        apply(self.matrix(), at)
    }

    pub(crate) fn pixel(self, at: [f64; 2]) -> [f64; 2] {
        apply(self.inverse(), at)
    }

    fn inverse(self) -> Matrix2 {
        inverse(self.matrix())
    }

    /// Area of a pixel.
    pub(crate) fn area(self) -> f64 {
        determinant(self.matrix()).abs()
    }
}

/// The PSF of an epoch as the linear network uses it.
#[derive(Debug, Clone)]
pub(crate) struct SpectralEpoch {
    pixels: EpochPixels,
    /// v̂/û of the epoch; until epochs are combined, p.
    restore: Modes,
    /// As of [`SpectralPsf`]; until epochs are combined, the transforms of the PSF times x and y.
    tilts: [Modes; 2],
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub(crate) struct EpochScratch {
    sums: [Spectrum; 3],
    stamps: ToTurnedModes,
    psfs: ToTurnedModes,
    edges: Vec<f32>,
}

/// The stamp of an epoch, and the place (x, y) of the galaxy in pixels from its middle.
pub(crate) type EpochStamp<'a> = (&'a [f32], [f64; 2]);

impl Spectral {
    pub(crate) fn epoch_scratch(&self) -> EpochScratch {
        let n = self.stamp_size();
        EpochScratch {
            sums: [(); 3].map(|()| self.plane.spectrum()),
            stamps: ToTurnedModes::new(n),
            psfs: ToTurnedModes::new(self.psf.side()),
            edges: vec![0.0; ROWS * n],
        }
    }

    pub(crate) fn epoch(&self) -> SpectralEpoch {
        SpectralEpoch {
            pixels: EpochPixels::Shaped(PixelShape::SQUARE),
            restore: self.plane.mode_by_mode(),
            tilts: [(); 2].map(|()| self.plane.mode_by_mode()),
        }
    }

    /// Takes the PSF of an epoch, as [`Spectral::set_psf`] takes one.
    pub(crate) fn set_epoch_psf(
        &self,
        psf: ArrayView2<'_, f64>,
        pixels: EpochPixels,
        scratch: &mut SpectralScratch,
        epochs: &mut EpochScratch,
        out: &mut SpectralEpoch,
    ) -> Result<(), MeasureError> {
        out.pixels = pixels;
        self.fill_psf_image(psf, &mut scratch.psf_image)?;
        match pixels {
            EpochPixels::Shaped(shape) => {
                self.set_pixel_shape(shape, scratch);
                self.psf_modes(scratch);
            }
            EpochPixels::Turned(matrix) => {
                let (image, out) = (&scratch.psf_image, &mut scratch.changes);
                epochs
                    .psfs
                    .transform_moments(image, matrix, &self.plane, out);
            }
        }
        let outs = [&mut out.restore].into_iter().chain(&mut out.tilts);
        for (out, modes) in outs.zip(&scratch.changes) {
            out.copy_from(modes);
        }
        Ok(())
    }

    /// Combines epochs whose PSFs were set, with weights u that sum to one. Of `out`, all is written that refers to noise.
    pub(crate) fn combine(
        &self,
        epochs: &mut [SpectralEpoch],
        weights: &[f32],
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) {
        combine(self, epochs, weights, &mut scratch.real[0], out);
        self.spread_noise(scratch, out);
    }

    /// Deconvolves the stamps of combined epochs and writes the autocorrelation with its derivatives, with noise of level
    /// `noise`. The window is at the offset of each epoch.
    pub(crate) fn autocorrelate_epochs<'a>(
        &self,
        psf: &SpectralPsf,
        epochs: &[SpectralEpoch],
        stamp: impl Fn(usize) -> EpochStamp<'a>,
        noise: f32,
        (scratch, buffers): (&mut SpectralScratch, &mut EpochScratch),
        out: &mut Lags,
    ) {
        for (which, epoch) in epochs.iter().enumerate() {
            let (stamp, place) = stamp(which);
            let at = epoch.pixels.map(place).map(|at| at as f32);
            self.place_window(at, at, scratch);
            match epoch.pixels {
                EpochPixels::Shaped(shape) => {
                    self.set_pixel_shape(shape, scratch);
                    self.restore(&epoch.restore, &epoch.tilts, stamp, scratch);
                }
                EpochPixels::Turned(matrix) => {
                    self.restore_turned(epoch, matrix, stamp, scratch, buffers);
                }
            }
            for (sum, spectrum) in buffers.sums.iter_mut().zip(&scratch.windowed) {
                match which {
                    0 => sum.copy_from(spectrum),
                    _ => add(&mut sum.0, &spectrum.0),
                }
            }
        }
        self.take_epoch_lags(psf, noise, (scratch, buffers), out);
    }

    /// Writes the lags of the epochs autocorrelated last, in noise of another level.
    pub(crate) fn take_epoch_lags(
        &self,
        psf: &SpectralPsf,
        noise: f32,
        (scratch, buffers): (&mut SpectralScratch, &EpochScratch),
        out: &mut Lags,
    ) {
        for (spectrum, sum) in scratch.windowed.iter_mut().zip(&buffers.sums) {
            spectrum.copy_from(sum);
        }
        self.take_lags(psf, noise, scratch, out);
    }

    // As `restore`, of turned pixels.
    fn restore_turned(
        &self,
        epoch: &SpectralEpoch,
        matrix: Matrix2,
        stamp: &[f32],
        scratch: &mut SpectralScratch,
        buffers: &mut EpochScratch,
    ) {
        let SpectralScratch {
            changes,
            windowed,
            centre,
            phases,
            origin,
            ..
        } = scratch;
        let EpochScratch { stamps, edges, .. } = buffers;
        stamps.transform_moments(stamp, matrix, &self.plane, changes);
        for (spectrum, modes) in windowed.iter_mut().zip(&*changes) {
            spectrum.take_modes(modes);
        }
        let [moved, edges1, edges2] = changes;
        let (n, inverse) = (self.stamp_size(), epoch.pixels.inverse());
        let [pixel, origin_pixel] =
            [*centre, *origin].map(|at| epoch.pixels.pixel(at.map(f64::from)));
        let gradients = inverse.map(|[a, b]| a.hypot(b));
        let at_edges = self.contains_light(pixel, gradients);
        if at_edges {
            // M⁻¹ V M of both shears V.
            let shears = SHEARS.map(|shear| product(inverse, product(shear, matrix)));
            edge_lines(stamp, n, shears, origin_pixel.map(|at| at as f32), edges);
            stamps.transform_edges(edges, matrix, &self.plane, [edges1, edges2]);
        }
        moved.copy_from(&epoch.restore);
        if *centre != [0.0; 2] {
            multiply_modes(moved, phases);
        }
        let with = Restoration {
            restore: moved,
            tilts: &epoch.tilts,
            waves: &self.waves,
            origin: *origin,
            edges: at_edges.then_some([edges1, edges2]),
        };
        restore(windowed, &with);
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add(sum: &mut [f32], values: &[f32]) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum += value;
    }
}

// Replaces the transforms of PSFs by what restores stamps, and writes the power of the combined noise of σ = 1 before the window.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn combine(
    plan: &Spectral,
    epochs: &mut [SpectralEpoch],
    weights: &[f32],
    powers: &mut [f32],
    out: &mut SpectralPsf,
) {
    for at in (0..powers.len()).step_by(LANES) {
        let mut squares = [0.0f32; LANES];
        for (epoch, weight) in epochs.iter().zip(weights) {
            let (re, im) = (lanes(&epoch.restore.re, at), lanes(&epoch.restore.im, at));
            for l in 0..LANES {
                squares[l] += weight * (re[l] * re[l] + im[l] * im[l]);
            }
        }
        let (rough, target) = (lanes(&plan.rough, at), lanes(&plan.target, at));
        let (kx, ky) = (lanes(&plan.waves[0], at), lanes(&plan.waves[1], at));
        let mut amplitudes = [0.0; LANES];
        let of_modes = [&squares[..], rough, target];
        super::deconvolution::amplitudes(of_modes, plan.step, plan.iterations, &mut amplitudes);
        let mut power = [0.0f32; LANES];
        let mut mean_tilts = [[0.0f32; LANES]; 2];
        for (epoch, weight) in epochs.iter_mut().zip(weights) {
            let [mut restore, mut first, mut second] = [[[0.0f32; LANES]; 2]; 3];
            {
                let values = |modes: &'_ Modes| [*lanes(&modes.re, at), *lanes(&modes.im, at)];
                let [p, x, y] = [&epoch.restore, &epoch.tilts[0], &epoch.tilts[1]].map(values);
                for l in 0..LANES {
                    // Times conj(p)/|p|².
                    let (re, im) = (p[0][l], -p[1][l]);
                    let square = re * re + im * im;
                    let inverse = |of: f32| if of < MIN_PSF_POWER { 0.0 } else { 1.0 / of };
                    let (own, all) = (inverse(square), weight * inverse(squares[l]));
                    let changes = sheared([x[0][l], x[1][l]], [y[0][l], y[1][l]], kx[l], ky[l]);
                    for (component, out) in [&mut first, &mut second].into_iter().enumerate() {
                        let [ar, ai] = changes[component];
                        let tilt = [ar * re - ai * im, ar * im + ai * re];
                        (out[0][l], out[1][l]) = (tilt[0] * own, tilt[1] * own);
                        mean_tilts[component][l] -= tilt[0] * all;
                    }
                    let amplitude = weight * amplitudes[l];
                    (restore[0][l], restore[1][l]) = (re * amplitude, im * amplitude);
                }
            }
            let SpectralEpoch {
                restore: to_restore,
                tilts: [to_first, to_second],
                ..
            } = epoch;
            let outs = [
                (to_restore, restore),
                (to_first, first),
                (to_second, second),
            ];
            for (modes, values) in outs {
                store([&mut modes.re[..], &mut modes.im[..]], at, values);
            }
        }
        for l in 0..LANES {
            power[l] = amplitudes[l] * amplitudes[l] * squares[l];
        }
        let [tilt1, tilt2] = &mut out.field_tilts;
        store([&mut tilt1[..], &mut tilt2[..]], at, mean_tilts);
        store([&mut out.clarity[..], &mut *powers], at, [squares, power]);
    }
}
