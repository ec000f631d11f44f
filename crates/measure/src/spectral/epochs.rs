//! Stamps of several epochs of a galaxy, combined mode by mode before the window.
//!
//! Epoch e has a stamp û, a PSF p and white noise of level σ on pixels of area a. Inverse-variance weights W of the deconvolved stamps
//! are real and do not change with shear:
//!
//! ```text
//! Σ W û/p = Σ u conj(p) û / q,    W = u |p|²/q,    q = Σ u |p|²,    u = (a/σ²)/Σ(a/σ²).
//! ```
//!
//! With w = q + λd² the closed form of the iterations is v̂ = Γ[1 − (1 − c w)^M]/w · Σ u conj(p) û: a single stamp is one epoch.
//! Noise has the level (Σ a/σ²)^(−½) and, in its units, the power Γ²[…]²q/w² in each mode; a shear changes it by the mean of the
//! epochs' changes with the weights W. Averages of ellipticities of single epochs would need a response of each noisy epoch:
//! with 16 epochs of S/N 5, the error of m is six times as large.
//!
//! Stamps may be turned against each other. Modes are along common axes, and turned stamps are transformed at
//! these modes ([`ToTurnedModes`]) without interpolation. The window is at the same place of the sky in all of them.

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::linear::{Matrix2, ROWS, product};

use super::deconvolution::{Spectral, SpectralEpoch, SpectralPsf, SpectralScratch, TurnedScratch};
use super::edges::{SHEARS, edge_lines};
use super::modes::multiply_modes;
use super::pixels::EpochPixels;
use super::restoration::{Restoration, restore};
use crate::error::MeasureError;
use crate::transform::ToTurnedModes;

/// The stamp of an epoch. Places (x, y) are in pixels from its middle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EpochStamp<'a> {
    pub(crate) pixels: &'a [f32],
    pub(crate) window: [f64; 2],
    /// Origin of the shear.
    pub(crate) origin: [f64; 2],
}

impl SpectralScratch {
    /// Keeps v̂ and its changes before [`Spectral::take_lags`] windows them.
    pub(crate) fn keep(&mut self) {
        for (kept, spectrum) in self.sums.iter_mut().zip(&self.windowed) {
            kept.copy_from(spectrum);
        }
    }

    /// Takes back what was kept.
    pub(crate) fn recall(&mut self) {
        for (spectrum, kept) in self.windowed.iter_mut().zip(&self.sums) {
            spectrum.copy_from(kept);
        }
    }
}

impl Spectral {
    fn turned_scratch(&self) -> Box<TurnedScratch> {
        let n = self.stamp_size();
        Box::new(TurnedScratch {
            stamps: ToTurnedModes::new(n),
            psfs: ToTurnedModes::new(self.psf.side()),
            edges: vec![0.0; ROWS * n],
        })
    }

    /// Takes the PSF of an epoch, as [`Spectral::set_psf`] takes one. [`Spectral::combine`] follows the last.
    pub(crate) fn set_epoch_psf(
        &self,
        at: usize,
        psf: ArrayView2<'_, f64>,
        pixels: EpochPixels,
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) -> Result<(), MeasureError> {
        self.fill_psf_image(psf, &mut scratch.psf_image)?;
        match pixels {
            EpochPixels::Shaped(shape) => {
                self.set_pixel_shape(shape, scratch);
                self.psf_modes(scratch);
            }
            EpochPixels::Turned(matrix) => {
                let turned = &mut scratch.turned;
                let TurnedScratch { psfs, .. } =
                    &mut **turned.get_or_insert_with(|| self.turned_scratch());
                let (image, out) = (&scratch.psf_image, &mut scratch.changes);
                psfs.transform_moments(image, matrix, &self.plane, out);
            }
        }
        self.take_epoch(at, pixels, scratch, out);
        Ok(())
    }

    /// Deconvolves the stamps of a galaxy, whose sum [`Spectral::take_lags`] takes.
    pub(crate) fn restore_epochs<'a>(
        &self,
        psf: &SpectralPsf,
        stamp: &dyn Fn(usize) -> EpochStamp<'a>,
        scratch: &mut SpectralScratch,
    ) {
        for (which, epoch) in psf.epochs[..psf.count].iter().enumerate() {
            let EpochStamp {
                pixels,
                window,
                origin,
            } = stamp(which);
            let [window, origin] =
                [window, origin].map(|at| epoch.pixels.map(at).map(|at| at as f32));
            self.place_window(window, origin, scratch);
            match epoch.pixels {
                EpochPixels::Shaped(shape) => {
                    self.set_pixel_shape(shape, scratch);
                    self.restore(epoch, pixels, scratch);
                }
                EpochPixels::Turned(matrix) => self.restore_turned(epoch, matrix, pixels, scratch),
            }
            if psf.count == 1 {
                return;
            }
            for (sum, spectrum) in scratch.sums.iter_mut().zip(&scratch.windowed) {
                match which {
                    0 => sum.copy_from(spectrum),
                    _ => add(&mut sum.0, &spectrum.0),
                }
            }
        }
        scratch.recall();
    }

    // As `restore`, of turned pixels.
    fn restore_turned(
        &self,
        epoch: &SpectralEpoch,
        matrix: Matrix2,
        stamp: &[f32],
        scratch: &mut SpectralScratch,
    ) {
        let SpectralScratch {
            changes,
            windowed,
            centre,
            phases,
            origin,
            turned,
            ..
        } = scratch;
        let TurnedScratch { stamps, edges, .. } =
            &mut **turned.get_or_insert_with(|| self.turned_scratch());
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
