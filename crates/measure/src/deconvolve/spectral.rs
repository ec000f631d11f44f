//! The linear network in closed form, and the autocorrelation of what it makes of a stamp.
//!
//! Without thresholds (Eq. 9) and clipping (Eq. 12), the adaptive update v ← v + c·f (Eqs. 10 and 11)
//! from v = 0 is linear. On a plane without boundary each Fourier mode evolves alone, and after M
//! iterations
//!
//! ```text
//! v̂ = [1 − (1 − c w)^M] · conj(p)/w · û,    w = |p|² + λ d²,
//! ```
//!
//! with p and d the transforms of the PSF and of Sun's kernel. What the shape is measured on is v
//! convolved with Γ: a round Gaussian of σ that falls to zero towards |k| = [`CUT`]/σ. No mode enters that
//! the PSF has destroyed, and what remains of the PSF is round. (A sharp cut would bring noise from afar.)
//!
//! The result is multiplied by a round Gaussian window, which keeps out most of the noise, before its
//! autocorrelation is taken. (A window on the stamp itself would cut into the PSF, and what was then
//! deconvolved would have the opposite of its ellipticity.) Noise of level σ and power σ²S adds to the mean of the power of
//! each mode what the window brings there of σ²SΓ²[…]²|p|²/w², which is subtracted. So few modes are
//! left that images are sampled on a coarse grid.
//!
//! # Response to shear
//!
//! A shear γ₁ of the galaxy (before the PSF) changes the transform s = û/p of the whole stamp by
//! (k_x ∂_x − k_y ∂_y)s, γ₂ by (k_y ∂_x + k_x ∂_y)s (∂ with respect to k). ∂û is the transform of
//! −i·x times the stamp, so that the change of the autocorrelation with shear follows from the stamp
//! itself: metacalibration (Huff & Mandelbaum 2017) in the limit of a small shear. The change is
//! worked out on the whole stamp and windowed then: a shear moves the galaxy and not the window, nor the edges of the stamp
//! ([`edges`]).

mod correlation;
mod edges;
mod field;
mod modes;
mod parities;
mod pixels;
mod plane;
mod products;
mod psf;
mod restore;
mod smoothing;

use ndarray::ArrayView2;
use shearq_fourier::{Complex32, Complex64};
use shearq_submissions::LinearDeconvolution;

use self::correlation::{Correlation, CorrelationScratch};
use self::edges::{Edges, EdgesScratch};
pub(crate) use self::field::uniform;
use self::modes::multiply;
use self::parities::{change, power};
use self::pixels::{Pixels, PixelsScratch};
use self::plane::{Modes, Plane, Quarters};
pub(crate) use self::products::Gradients;
pub use self::psf::{ModeNoise, SpectralPsf};
use self::restore::{Restoration, restore};
use self::smoothing::Smoothing;
use super::sun::high_pass;
use crate::error::MeasureError;
use crate::fft::StampFft;
use crate::pixel::check_sizes;

/// Padding around a stamp, so that the deconvolved stamp does not wrap around. See
/// docs/constants.md.
const SPREAD: usize = 8;
/// Largest wave number of the target Γ, times its σ. Γ is 0.09 there. See docs/constants.md.
const CUT: f64 = 2.2;
/// Value of the window at the middle of an edge above which the edge correction is applied. See
/// docs/constants.md.
const LIT: f64 = 0.02;
/// Largest lag of the autocorrelation in σ of the window. The window's autocorrelation is a fifth
/// there. See docs/constants.md.
const REACH: f64 = 2.5;

/// The linear network for one stamp size.
#[derive(Debug, Clone)]
pub struct Spectral {
    step: f32,
    iterations: i32,
    plane: Plane,
    /// Transforms of stamps, and of PSFs.
    stamp: Pixels,
    psf: Pixels,
    /// λ d² of each mode.
    rough: Vec<f32>,
    /// Γ of each mode.
    target: Vec<f32>,
    /// k_x and k_y of each mode, in radians per pixel.
    waves: [Vec<f32>; 2],
    /// For how many modes of the plane each stands.
    counts: Vec<f32>,
    /// Place of each mode turned by 90 degrees.
    turned: Vec<u32>,
    window_sigma: f64,
    window: Smoothing,
    /// The window's own spectrum.
    window_modes: Quarters,
    /// What windowed noise of a power becomes, in units of σ².
    leak: Smoothing,
    /// The stamp's.
    edges: Edges,
    correlation: Correlation,
    reach: usize,
    /// Scale of the autocorrelation for modes in the largest circle of those kept, zero outside; of a quarter.
    scale: Vec<f32>,
    /// Share of the noise under the window that the stamp contains.
    inside: f32,
}

/// Buffers for one thread. Their content between calls does not matter, but for the stamp that
/// [`Spectral::noise_field`] looks at.
#[derive(Debug, Clone)]
pub struct SpectralScratch {
    /// For stamps, and for PSFs.
    fft: [PixelsScratch; 2],
    /// Spectra mode by mode, before the window.
    changes: [Modes; 3],
    /// v̂ of a stamp and its changes with the components of shear, behind the window; or other changes.
    windowed: [Quarters; 3],
    /// A PSF.
    image: Vec<f32>,
    /// The windowed stamp's transform.
    stamp: Quarters,
    /// Real spectra.
    real: [Vec<f32>; 2],
    /// A real even spectrum by parity.
    even: Vec<f32>,
    /// A quarter on its way through the window.
    smooth: Vec<f32>,
    /// Where the window is, (x, y) in pixels from the middle of the stamp, and the phases that move this place to the origin.
    centre: [f32; 2],
    phases: Modes,
    edges: EdgesScratch,
    correlation: CorrelationScratch,
}

/// Autocorrelations on lags dy = 0…R, dx = −R…R, in steps of [`Spectral::spacing`]:
/// `[dy·(2R+1) + dx + R]`.
#[derive(Debug, Clone)]
pub struct Lags {
    /// Of the result.
    pub acf: Vec<f32>,
    /// Its derivative with respect to a shear γ₁ of the galaxy.
    pub shear1: Vec<f32>,
    /// Its derivative with respect to γ₂.
    pub shear2: Vec<f32>,
    /// Sum of the windowed result, and its derivatives with respect to γ₁ and γ₂.
    pub flux: [f32; 3],
}

impl Spectral {
    /// Plans for n×n stamps and p×p PSFs.
    ///
    /// # Errors
    /// Where a size is out of range.
    pub fn new(n: usize, p: usize, settings: &LinearDeconvolution) -> Result<Self, MeasureError> {
        check_sizes(n, p)?;
        let sigma = settings.target_sigma;
        // Below the stamp's own Nyquist frequency, π.
        let cut = (CUT / sigma).min(3.0);
        let plane = Plane::new((n + SPREAD).max(p), cut);
        let waves = plane.waves();
        let target = waves.iter().map(|&[kx, ky]| {
            let square = kx * kx + ky * ky;
            (taper(square.sqrt() / cut) * (-0.5 * sigma * sigma * square).exp()) as f32
        });
        let window = window_modes(settings.window_sigma, &plane);
        let inside = inside(n, settings.window_sigma);
        let size = plane.size as f64;
        let reach = (REACH * settings.window_sigma / plane.lag_spacing()) as usize;
        let reach = reach.clamp(1, plane.lags / 2 - 1);
        let least = plane.wave(plane.modes) * (1.0 + 1e-12);
        let scale = |&[kx, ky]: &[f64; 2]| {
            if kx.hypot(ky) <= least {
                1.0 / (size * size) as f32
            } else {
                0.0
            }
        };
        let mut window_quarters = plane.quarters();
        let [even, ..] = window_quarters.each();
        for (y, line) in even
            .chunks_exact_mut(plane.width)
            .take(plane.modes + 1)
            .enumerate()
        {
            for (x, value) in line.iter_mut().take(plane.modes + 1).enumerate() {
                *value = (window[x] * window[y]) as f32;
            }
        }
        Ok(Spectral {
            step: settings.step as f32,
            iterations: i32::try_from(settings.max_iterations).unwrap_or(i32::MAX),
            stamp: Pixels::new(n, &plane),
            psf: Pixels::new(p, &plane),
            rough: waves
                .iter()
                .map(|&[kx, ky]| (settings.lambda * high_pass(kx, ky).powi(2)) as f32)
                .collect(),
            target: target.collect(),
            waves: [0, 1].map(|axis| waves.iter().map(|k| k[axis] as f32).collect()),
            counts: plane.counts(),
            turned: (0..waves.len()).map(|at| plane.turned(at) as u32).collect(),
            window_sigma: settings.window_sigma,
            window: Smoothing::new(|distance| window[distance], &plane),
            window_modes: window_quarters,
            leak: Smoothing::new(|distance| inside * size * window[distance].powi(2), &plane),
            edges: Edges::new(n, &plane),
            correlation: Correlation::new(reach, &plane),
            reach,
            scale: waves[..plane.quarter()].iter().map(scale).collect(),
            inside: (inside * inside) as f32,
            plane,
        })
    }

    /// Stamp side n.
    pub fn stamp_size(&self) -> usize {
        self.stamp.side()
    }

    /// Largest lag, in steps of [`Spectral::spacing`].
    pub fn reach(&self) -> usize {
        self.reach
    }

    /// Pixels between lags.
    pub fn spacing(&self) -> f64 {
        self.plane.lag_spacing()
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> SpectralScratch {
        let p = self.psf.side();
        let zeros = |quarters: usize| vec![0.0; quarters * self.plane.quarter()];
        SpectralScratch {
            fft: [self.stamp.scratch(), self.psf.scratch()],
            changes: std::array::from_fn(|_| self.plane.spectrum()),
            windowed: std::array::from_fn(|_| self.plane.quarters()),
            image: vec![0.0; p * p],
            stamp: self.plane.quarters(),
            real: [zeros(2), zeros(2)],
            even: zeros(2),
            smooth: zeros(1),
            centre: [0.0; 2],
            phases: self.plane.spectrum(),
            edges: self.edges.scratch(),
            correlation: self.correlation.scratch(),
        }
    }

    /// Puts the window at `centre`, (x, y) in pixels from the middle of the stamp, for the stamps that follow.
    /// Their shear is about this place: the window is where the galaxy is, sheared or not.
    pub fn place_window(&self, centre: [f32; 2], scratch: &mut SpectralScratch) {
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
            let mut phase = turn(f64::from(ky[0]) * f64::from(centre[1]));
            let step = turn(f64::from(kx[1]) * f64::from(centre[0]));
            for (re, im) in re.iter_mut().zip(im) {
                (*re, *im) = (phase.re as f32, phase.im as f32);
                phase *= step;
            }
        }
    }

    /// |g|² of each mode over the plane's area in px², of a round Gaussian galaxy of flux one with a mean square of `extent`
    /// px² per axis, times the number of modes that it stands for. The sum of this times |p|² is that of the squared pixels
    /// of the galaxy behind p.
    pub fn light(&self, extent: f64) -> Vec<f32> {
        let area = (self.plane.size * self.plane.size) as f64;
        let [kx, ky] = &self.waves;
        let waves = kx.iter().zip(ky).map(|(x, y)| x * x + y * y);
        let modes = waves.zip(&self.counts);
        modes
            .map(|(square, &count)| {
                (f64::from(count) / area * (-f64::from(square) * extent).exp()) as f32
            })
            .collect()
    }

    /// Room for the lags.
    pub fn lags(&self) -> Lags {
        let lags = vec![0.0; (self.reach + 1) * (2 * self.reach + 1)];
        Lags {
            acf: lags.clone(),
            shear1: lags.clone(),
            shear2: lags,
            flux: [0.0; 3],
        }
    }

    /// Deconvolves a row-major `stamp` with noise of level `noise` and writes the
    /// autocorrelation with its derivatives.
    pub fn autocorrelate(
        &self,
        psf: &SpectralPsf,
        stamp: &[f32],
        noise: f32,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        self.deconvolve(psf, stamp, scratch);
        let SpectralScratch {
            windowed: [v, first, second],
            stamp,
            even,
            correlation,
            ..
        } = scratch;
        stamp.copy_from(v);
        out.flux = [&*v, first, second].map(Quarters::sum);
        let variance = noise * noise;
        power(v, &self.scale, &psf.floor, variance, even);
        self.correlation.lags(even, correlation, &mut out.acf);
        let sheared = [(first, &mut out.shear1), (second, &mut out.shear2)];
        for ((changed, out), mean) in sheared.into_iter().zip(&psf.noise_tilts) {
            change(v, changed, &self.scale, mean, variance, even);
            self.correlation.lags(even, correlation, out);
        }
    }

    /// v̂ of a stamp and its changes with the components of shear, windowed, to `scratch.windowed`.
    fn deconvolve(&self, psf: &SpectralPsf, stamp: &[f32], scratch: &mut SpectralScratch) {
        let SpectralScratch {
            fft: [fft, _],
            changes: [moved, edges1, edges2],
            windowed,
            smooth,
            centre,
            phases,
            edges,
            ..
        } = scratch;
        self.stamp.transform(stamp, fft, windowed);
        let centre = *centre;
        let at_edges = self.sees_edges(centre);
        if at_edges {
            let fft = (&self.stamp, fft);
            self.edges.take(stamp, centre, fft, edges, [edges1, edges2]);
        }
        let off_middle = centre != [0.0; 2];
        if off_middle {
            // About the window's place.
            moved.copy_from(&psf.restore);
            multiply(moved, phases);
        }
        let with = Restoration {
            restore: if off_middle { moved } else { &psf.restore },
            tilts: &psf.tilts,
            waves: &self.waves,
            centre,
            edges: at_edges.then_some([edges1, edges2]),
        };
        restore(windowed, &with);
        for spectrum in windowed {
            self.window.apply(spectrum, smooth);
        }
    }

    /// Multiplies the images of the first `count` spectra of `scratch.changes` by the window, which is at their origin, to
    /// `scratch.windowed`.
    fn look_through_window(&self, count: usize, scratch: &mut SpectralScratch) {
        let SpectralScratch {
            windowed,
            changes,
            smooth,
            ..
        } = scratch;
        for (windowed, modes) in windowed.iter_mut().zip(changes).take(count) {
            windowed.take(modes);
            self.window.apply(windowed, smooth);
        }
    }

    /// Whether a window at `centre` sees light at the edges.
    fn sees_edges(&self, centre: [f32; 2]) -> bool {
        let off = centre.into_iter().map(f32::abs).fold(0.0, f32::max);
        let away = (self.stamp_size() as f64 / 2.0 - f64::from(off)) / self.window_sigma;
        (-0.5 * away * away).exp() > LIT
    }

    /// The deconvolved stamp itself, convolved with Γ and windowed, for pictures.
    pub fn deconvolved(&self, psf: ArrayView2<'_, f64>, stamp: &[f32]) -> Vec<f32> {
        let n = self.stamp_size();
        let plan = StampFft::new(self.plane.size);
        let (mut u, mut h, mut fft) = (plan.spectrum(), plan.spectrum(), plan.scratch());
        let rows = psf.rows().into_iter();
        let rows = rows.map(|row| row.into_iter().map(|&v| v as f32));
        plan.rows(rows, &mut fft, &mut h);
        plan.columns(&mut fft, &mut h);
        let rows = stamp.chunks_exact(n);
        plan.rows(rows.map(|row| row.iter().copied()), &mut fft, &mut u);
        plan.columns(&mut fft, &mut u);
        let centre = (psf.nrows() / 2) as f32;
        let size = self.plane.size;
        for (at, u) in u.iter_mut().enumerate() {
            let (x, y) = (at / size, at % size);
            let modes = self.plane.modes;
            if x > modes || (y > modes && y + modes < size) {
                *u = Complex32::ZERO;
                continue;
            }
            let mode = self.plane.place(x, y.min(size - y), y > modes);
            let [kx, ky] = [self.waves[0][mode], self.waves[1][mode]];
            // The PSF's transform about the pixel that a convolution takes for its centre.
            let p = h[at] * Complex32::from_polar(1.0, centre * (kx + ky));
            *u *= p.conj() * (self.amplitude(mode, p.norm_sqr()) / (size * size) as f32);
        }
        plan.columns_back(&mut fft, &mut u);
        let window = |at: usize| {
            let x = (at as f64 - (n as f64 - 1.0) / 2.0) / self.window_sigma;
            (-0.5 * x * x).exp() as f32
        };
        let mut image = Vec::with_capacity(n * n);
        for y in 0..n {
            let row = &plan.row_back(&u, y, &mut fft)[..n];
            image.extend(
                row.iter()
                    .enumerate()
                    .map(|(x, v)| v * window(x) * window(y)),
            );
        }
        image
    }
}

/// Fall of Γ towards its largest wave number, at 1: a quarter of a cosine, squared.
fn taper(k: f64) -> f64 {
    /// Share of the largest wave number at which the taper of Γ begins. See docs/constants.md.
    const FROM: f64 = 0.75;
    if k >= 1.0 {
        // The cosine would be 10⁻¹⁶, which makes modes of denormal numbers, and these take long.
        return 0.0;
    }
    let place = ((k - FROM) / (1.0 - FROM)).max(0.0);
    (std::f64::consts::FRAC_PI_2 * place).cos().powi(2)
}

/// Share of a squared window along an axis that n pixels hold: beyond is no noise.
fn inside(n: usize, sigma: f64) -> f64 {
    let share = |from: i32, to: i32| {
        let middle = (n as f64 - 1.0) / 2.0;
        let squares = (from..to).map(|at| (-((f64::from(at) - middle) / sigma).powi(2)).exp());
        squares.sum::<f64>()
    };
    let side = n as i32;
    share(0, side) / share(-side, 2 * side)
}

/// Transform of a Gaussian window of `sigma` px along an axis, over the plane's period, at modes 0, 1, … 2·`modes`.
fn window_modes(sigma: f64, plane: &Plane) -> Vec<f64> {
    let period = plane.size as f64;
    let places = (0..plane.size).map(|at| at as f64 - (plane.size / 2) as f64);
    let window: Vec<[f64; 2]> = places
        .map(|x| [x, (-0.5 * (x / sigma).powi(2)).exp() / period])
        .collect();
    let mode = |j: usize| {
        let terms = window.iter();
        terms.map(|[x, w]| w * (plane.wave(j) * x).cos()).sum()
    };
    (0..=2 * plane.modes).map(mode).collect()
}

/// exp(iφ).
fn turn(phase: f64) -> Complex64 {
    Complex64::from_polar(1.0, phase)
}

#[cfg(test)]
mod tests;
