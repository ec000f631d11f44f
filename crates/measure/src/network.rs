//! The Hopfield network of Nurbaeva et al. (2015, A&A 577, A104), Sects. 2.1 to 3.1.
//!
//! The network's state v is the deconvolved stamp. It lowers the energy (Eq. 7)
//!
//! ```text
//! E(v) = ½ vᵀ(W + λG)v − Qᵀv,   W = HᵀH,  G = DᵀD,  Q = Hᵀu₀            (Eq. 8)
//! ```
//!
//! where H is the convolution with the PSF under a zero boundary and D the high-pass of Sun (2000).
//! One iteration takes the negative gradient f = Q − (W + λG)v (Eq. 13), changes the neurons whose
//! |f_i| exceeds the threshold TH_i = ½|W_ii + λG_ii| (Eqs. 6 and 11), and clips at zero (Eq. 14).
//! It stops when there is no neuron to update, when the energy no longer falls, or after M
//! iterations.
//!
//! Stamps are row-major, rows along y. A PSF of side p has its centre at pixel c = p/2 (integer
//! division) on both axes: `(Hv)[y, x] = Σ h[j, i]·v[y − (j − c), x − (i − c)]`, pixels outside the
//! stamp counting as zero. The matrices, which have n⁴ numbers, are never formed; the tests compare with them.

use multiversion::multiversion;
use ndarray::{Array2, ArrayView2};
use shearq_quantities::linear::LANES;
use shearq_submissions::limits::MAX_PSF;
use shearq_submissions::{
    BrightnessUnit, Clipping, Kept, NetworkDeconvolution, PsfScale, Start, StepScale, Update,
};

use crate::error::{MeasureError, length};
use crate::measurement::{Descent, Stop};
use crate::pixels::{check_psf, check_sizes};
use crate::transform::{Plane, Spectrum, ToModes, ToPixels, TransformScratch};

// High-pass kernel D of the regularisation; its elements sum to zero. Nurbaeva et al., Sect. 3.1.
const SUN_KERNEL: [[f64; 3]; 3] = [
    [0.007, 0.010, 0.007],
    [0.010, -0.068, 0.010],
    [0.007, 0.010, 0.007],
];

/// The transform of D, which is real.
pub(crate) fn high_pass(kx: f64, ky: f64) -> f64 {
    let (cx, cy) = (kx.cos(), ky.cos());
    SUN_KERNEL[1][1]
        + 2.0 * SUN_KERNEL[1][0] * cx
        + 2.0 * SUN_KERNEL[0][1] * cy
        + 4.0 * SUN_KERNEL[0][0] * cx * cy
}

/// How far an updated neuron moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Step {
    /// Δv_i = c·|f_i| (Eq. 12), c without unit.
    Adaptive(f64),
    /// The same with momentum.
    Accelerated(f64),
    /// Δv_i in image units (Eq. 6).
    Constant(f64),
}

/// The updating rule for one stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rule {
    /// Size of an update.
    pub step: Step,
    /// One unit of brightness in image units: thresholds are TH_i times this.
    pub unit: f64,
    /// M.
    pub max_iterations: usize,
    /// First state.
    pub start: Start,
    /// When negative neurons are set to zero.
    pub clipping: Clipping,
    /// Which state is kept where the energy rises.
    pub kept: Kept,
}

impl Rule {
    /// The rule for a stamp whose brightest pixel is `peak` and whose noise is `sigma`, both in
    /// image units. `None` where the unit of brightness would not be positive, so that the stamp
    /// cannot be measured with these settings.
    pub fn new(settings: &NetworkDeconvolution, peak: f64, sigma: f64) -> Option<Self> {
        let unit = match settings.brightness_unit {
            BrightnessUnit::Image => 1.0,
            BrightnessUnit::Noise => sigma,
            BrightnessUnit::Peak => peak,
        } / settings.unit_divisor;
        if !(unit.is_finite() && unit > 0.0) {
            return None;
        }
        let c = match settings.step_scale {
            StepScale::Fixed => settings.step,
            StepScale::Peak => settings.step * peak / unit,
        };
        let step = match settings.update {
            Update::Adaptive => Step::Adaptive(c),
            Update::Accelerated => Step::Accelerated(c),
            Update::Constant => Step::Constant(settings.constant_step * unit),
        };
        Some(Rule {
            step,
            unit,
            max_iterations: settings.max_iterations,
            start: settings.start,
            clipping: settings.clipping,
            kept: settings.kept,
        })
    }

    // What an update clips at.
    fn floor(&self) -> f32 {
        match self.clipping {
            Clipping::BeforeTest => 0.0,
            Clipping::AfterTest | Clipping::Never => f32::NEG_INFINITY,
        }
    }
}

impl Stop {
    /// Code in catalogues: 0 stable, 1 energy rise, 2 most iterations.
    pub fn code(self) -> u32 {
        match self {
            Stop::Stable => 0,
            Stop::EnergyRise => 1,
            Stop::MaxIterations => 2,
        }
    }
}

/// A network for one stamp size, PSF size and λ, holding one PSF at a time.
///
/// Running it needs a [`NetworkScratch`] of the caller and allocates nothing. The network itself is
/// not changed by a run, so one can serve many threads.
#[derive(Debug, Clone)]
pub struct Network {
    n: usize,
    p: usize,
    lambda: f32,
    to_modes: ToModes,
    to_pixels: ToPixels,
    /// From a PSF with as many pixels before its centre as after it.
    psf_to_modes: ToModes,
    /// Modes of the PSF, and of the PSF turned by 180°, for Hᵀ.
    transfer: Spectrum,
    transfer_transposed: Spectrum,
    centred_psf: Vec<f32>,
    psf_scratch: TransformScratch,
    /// TH_i for a unit of brightness of one (Eq. 11), and infinite behind the image: the state has to stay zero there.
    thresholds: Vec<f32>,
}

/// Buffers for one thread's runs. Images are row-major, with zeros behind them that fill the last lanes. The zeros around
/// `lines_of_d` stay, too. All else may have any value between runs.
#[derive(Debug, Clone)]
pub struct NetworkScratch {
    n: usize,
    p: usize,
    state: Vec<f32>,
    next: Vec<f32>,
    /// State after an accelerated update, before its momentum; and the same one iteration before.
    moved: Vec<f32>,
    last: Vec<f32>,
    /// u₀ − Hv.
    residual: Vec<f32>,
    /// Dv.
    rough: Vec<f32>,
    /// u₀.
    data: Vec<f32>,
    /// Hv.
    convolved: Vec<f32>,
    /// Hᵀ(u₀ − Hv), and then f.
    gradient: Vec<f32>,
    /// D(Dv).
    rough_twice: Vec<f32>,
    /// Sums along x for D, with a row of zeros before and after.
    lines_of_d: Vec<f32>,
    transform: TransformScratch,
    modes: Spectrum,
}

impl Network {
    /// Plans for n×n stamps and p×p PSFs; the PSF is zero until [`Network::set_psf`].
    ///
    /// # Errors
    /// If a size is out of range.
    pub fn plan(n: usize, p: usize, lambda: f64) -> Result<Self, MeasureError> {
        check_sizes(n, p)?;
        // Light that wraps around has to end before the stamp begins again. An odd period has no mode but zero that is its own
        // opposite.
        let plane = Plane::with_all_modes((n + p / 2) | 1);
        let psf_to_modes = ToModes::new(2 * (p / 2) + 1, &plane, false);
        Ok(Network {
            n,
            p,
            lambda: lambda as f32,
            to_modes: ToModes::new(n, &plane, false),
            to_pixels: ToPixels::new(n, &plane),
            transfer: plane.spectrum(),
            transfer_transposed: plane.spectrum(),
            centred_psf: vec![0.0; psf_to_modes.side() * psf_to_modes.side()],
            psf_scratch: psf_to_modes.scratch(),
            psf_to_modes,
            thresholds: vec![f32::INFINITY; padded(n)],
        })
    }

    /// Takes a PSF of sum one, scaled; allocates nothing. Returns the factor on it, which is also that from the network's
    /// states to the light of the galaxy.
    ///
    /// # Errors
    /// If its size is not the planned one, a pixel is not finite, or a peak of one is asked for and no pixel is positive.
    pub fn set_psf(
        &mut self,
        psf: ArrayView2<'_, f64>,
        scale: PsfScale,
    ) -> Result<f64, MeasureError> {
        check_psf(psf, self.p)?;
        let factor = psf_factor(psf, scale)?;
        // One of even side has no pixels in the last row and column.
        let side = self.psf_to_modes.side();
        for (to, row) in self.centred_psf.chunks_exact_mut(side).zip(psf.rows()) {
            for (to, value) in to.iter_mut().zip(row) {
                *to = (*value * factor) as f32;
            }
        }
        let modes = &mut self.transfer;
        self.psf_to_modes
            .transform(&self.centred_psf, &mut self.psf_scratch, modes);
        let modes = &mut self.transfer_transposed;
        modes.copy_from(&self.transfer);
        // Turned by 180°, what is odd along one axis changes its sign.
        let [_, cs, sc, _] = modes.quarters_mut();
        for value in cs.iter_mut().chain(sc) {
            *value = -*value;
        }
        self.set_thresholds(psf, factor * factor);
        Ok(factor)
    }

    // TH_i = ½|W_ii + λG_ii| (Eq. 11): W_ii is the sum of h² over the part of the PSF that falls inside the
    // stamp when centred on pixel i, times `square`, and G_ii the same for d.
    fn set_thresholds(&mut self, psf: ArrayView2<'_, f64>, square: f64) {
        let Network { n, p, .. } = *self;
        // Sums over all rectangles from the corner, so that any window costs four look-ups.
        let mut sums = [0.0; (MAX_PSF + 1) * (MAX_PSF + 1)];
        let stride = p + 1;
        for y in 0..p {
            let mut row = 0.0;
            for x in 0..p {
                row += psf[(y, x)] * psf[(y, x)];
                sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
            }
        }
        // Kernel rows j with 0 ≤ y + j − c < n.
        let window = |at: usize, side: usize| {
            let c = side / 2;
            (c.saturating_sub(at), side.min(n + c - at))
        };
        for y in 0..n {
            let ((j0, j1), (dj0, dj1)) = (window(y, p), window(y, 3));
            for x in 0..n {
                let ((i0, i1), (di0, di1)) = (window(x, p), window(x, 3));
                let at = |j: usize, i: usize| sums[j * stride + i];
                let w = square * (at(j1, i1) - at(j0, i1) - at(j1, i0) + at(j0, i0));
                let rows = SUN_KERNEL[dj0..dj1].iter();
                let g: f64 = rows.flat_map(|row| &row[di0..di1]).map(|d| d * d).sum();
                self.thresholds[y * n + x] = (0.5 * (w + f64::from(self.lambda) * g).abs()) as f32;
            }
        }
    }

    /// Stamp side n.
    pub fn stamp_size(&self) -> usize {
        self.n
    }

    /// Buffers that fit this network.
    pub fn scratch(&self) -> NetworkScratch {
        let image = vec![0.0; padded(self.n)];
        NetworkScratch {
            n: self.n,
            p: self.p,
            state: image.clone(),
            next: image.clone(),
            moved: image.clone(),
            last: image.clone(),
            residual: image.clone(),
            rough: image.clone(),
            data: image.clone(),
            convolved: image.clone(),
            gradient: image.clone(),
            rough_twice: image,
            lines_of_d: vec![0.0; self.n * (self.n + 2)],
            transform: self.to_pixels.scratch(),
            modes: self.transfer.clone(),
        }
    }

    /// Deconvolves the row-major n×n stamp `u0` into `out`.
    ///
    /// # Errors
    /// If `u0` or `out` does not have n² pixels, or the scratch is of another network's sizes.
    pub fn deconvolve(
        &self,
        rule: &Rule,
        u0: &[f32],
        scratch: &mut NetworkScratch,
        out: &mut [f32],
    ) -> Result<Descent, MeasureError> {
        self.trace(rule, u0, scratch, out, |_, _| {})
    }

    /// Like [`Network::deconvolve`], showing `observe` the state before and after each iteration, row-major. The last one
    /// shown may be an update that raised the energy and is not kept.
    ///
    /// # Errors
    /// As [`Network::deconvolve`].
    pub fn trace(
        &self,
        rule: &Rule,
        u0: &[f32],
        scratch: &mut NetworkScratch,
        out: &mut [f32],
        observe: impl FnMut(&[f32], &[f32]),
    ) -> Result<Descent, MeasureError> {
        self.start(rule, u0, scratch, out)?;
        let descent = self.descend(rule, scratch, observe);
        out.copy_from_slice(&scratch.state[..out.len()]);
        Ok(descent)
    }

    // Checks the sizes of a run, takes the stamp and sets the first state.
    fn start(
        &self,
        rule: &Rule,
        u0: &[f32],
        scratch: &mut NetworkScratch,
        out: &[f32],
    ) -> Result<(), MeasureError> {
        let pixels = self.n * self.n;
        length("a stamp", u0.len(), pixels)?;
        length("a deconvolved stamp", out.len(), pixels)?;
        if (scratch.n, scratch.p) != (self.n, self.p) {
            let of = |n, p| format!("{n} × {n} pixels and a PSF of {p} × {p}");
            return Err(MeasureError::Shape {
                what: "buffers for a network",
                found: of(scratch.n, scratch.p),
                expected: of(self.n, self.p),
            });
        }
        scratch.data[..pixels].copy_from_slice(u0);
        let state = &mut scratch.state[..pixels];
        match rule.start {
            Start::Data => state.copy_from_slice(u0),
            Start::ClippedData => {
                for (v, &u) in state.iter_mut().zip(u0) {
                    *v = if u > 0.0 { u } else { 0.0 };
                }
            }
            Start::Flat => {
                let mean = u0.iter().map(|&u| f64::from(u)).sum::<f64>() / pixels as f64;
                state.fill(mean.max(0.0) as f32);
            }
            Start::Zero => state.fill(0.0),
        }
        Ok(())
    }

    // Runs the network from `b.state` on `b.data`; the result is left in `b.state`. Costs are compared instead of energies (Eq. 7),
    // which are small differences of large terms.
    fn descend(
        &self,
        rule: &Rule,
        b: &mut NetworkScratch,
        mut observe: impl FnMut(&[f32], &[f32]),
    ) -> Descent {
        let pixels = self.n * self.n;
        let constant = 0.5 * sum_of_squares(&b.data);
        let accelerated = matches!(rule.step, Step::Accelerated(_));
        if accelerated {
            b.last.copy_from_slice(&b.state);
        }
        b.next.copy_from_slice(&b.state);
        let mut cost = self.cost(b);
        let mut descent = Descent {
            iterations: 0,
            stop: Stop::MaxIterations,
            first_energy: cost - constant,
            energy: cost - constant,
            updated: 0,
        };
        let mut momentum = 1.0;
        while (descent.iterations as usize) < rule.max_iterations {
            descent.updated = self.update(rule, b);
            if descent.updated == 0 {
                descent.stop = Stop::Stable;
                break;
            }
            let extrapolated = accelerated && extrapolate(rule, b, &mut momentum);
            let mut next = self.cost(b);
            // NaN does not fall.
            let mut falls = next < cost;
            if extrapolated && !falls {
                // Momentum went too far: the update itself is left.
                momentum = 1.0;
                b.next.copy_from_slice(&b.moved);
                next = self.cost(b);
                falls = next < cost;
            }
            if falls && rule.clipping == Clipping::AfterTest && clip(&mut b.next) {
                next = self.cost(b);
            }
            observe(&b.state[..pixels], &b.next[..pixels]);
            if falls || rule.kept == Kept::Last {
                std::mem::swap(&mut b.state, &mut b.next);
                std::mem::swap(&mut b.last, &mut b.moved);
                cost = next;
                descent.energy = cost - constant;
                descent.iterations += 1;
            }
            if !falls {
                descent.stop = Stop::EnergyRise;
                break;
            }
        }
        descent
    }

    // Residual and roughness of the candidate; returns J(v) = ½‖u₀ − Hv‖² + ½λ‖Dv‖² (Eq. 4), which is the
    // energy E plus the constant ½‖u₀‖² but has no cancellation in it.
    fn cost(&self, b: &mut NetworkScratch) -> f64 {
        self.convolve(
            &self.transfer,
            &b.next,
            &mut b.transform,
            &mut b.modes,
            &mut b.convolved,
        );
        let misfit = misfit(&b.data, &b.convolved, &mut b.residual);
        if self.lambda <= 0.0 {
            return 0.5 * misfit;
        }
        roughen(&b.next, self.n, &mut b.lines_of_d, &mut b.rough);
        0.5 * misfit + 0.5 * f64::from(self.lambda) * sum_of_squares(&b.rough)
    }

    fn convolve(
        &self,
        transfer: &Spectrum,
        image: &[f32],
        transform: &mut TransformScratch,
        modes: &mut Spectrum,
        out: &mut [f32],
    ) {
        self.to_modes.transform(image, transform, modes);
        modes.multiply(transfer);
        self.to_pixels.transform(modes, transform, out);
    }

    // Takes f = Hᵀ(u₀ − Hv) − λD(Dv) (Eq. 13; D is symmetric), updates every neuron beyond its
    // threshold (Eq. 6) and clips at zero (Eq. 14) where that comes first; returns how many were beyond.
    fn update(&self, rule: &Rule, b: &mut NetworkScratch) -> u32 {
        let transposed = &self.transfer_transposed;
        self.convolve(
            transposed,
            &b.residual,
            &mut b.transform,
            &mut b.modes,
            &mut b.gradient,
        );
        if self.lambda > 0.0 {
            roughen(&b.rough, self.n, &mut b.lines_of_d, &mut b.rough_twice);
            for (f, rough) in b.gradient.iter_mut().zip(&b.rough_twice) {
                *f -= self.lambda * rough;
            }
        }
        update_neurons(rule, &b.state, &b.gradient, &self.thresholds, &mut b.next)
    }
}

/// The factor that gives a PSF of sum one the scale `scale`.
///
/// # Errors
/// If no pixel is positive.
pub fn psf_factor(psf: ArrayView2<'_, f64>, scale: PsfScale) -> Result<f64, MeasureError> {
    match scale {
        PsfScale::Sum => Ok(1.0),
        PsfScale::Peak => {
            let peak = psf.iter().copied().fold(0.0, f64::max);
            if peak > 0.0 {
                Ok(1.0 / peak)
            } else {
                Err(MeasureError::DarkPsf(psf.sum()))
            }
        }
    }
}

/// The convolution Hv of a square image, zero outside it, by plain sums. For simulations, pictures and tests.
pub fn convolve(image: ArrayView2<'_, f64>, kernel: ArrayView2<'_, f64>) -> Array2<f64> {
    let (cy, cx) = (kernel.nrows() / 2, kernel.ncols() / 2);
    Array2::from_shape_fn(image.dim(), |(y, x)| {
        let mut sum = 0.0;
        for ((j, i), &value) in kernel.indexed_iter() {
            let at = ((y + cy).wrapping_sub(j), (x + cx).wrapping_sub(i));
            sum += value * image.get(at).copied().unwrap_or(0.0);
        }
        sum
    })
}

// Whole lanes: no loop over pixels has a remainder.
fn padded(n: usize) -> usize {
    (n * n).next_multiple_of(LANES)
}

#[inline(always)]
fn lanes<T>(image: &[T]) -> impl Iterator<Item = &[T; LANES]> {
    image.as_chunks().0.iter()
}

// Sums of squares are in double precision: near the minimum the cost falls by 10⁻⁷ of itself in an iteration, and rounding
// would end the descent.

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_of_squares(values: &[f32]) -> f64 {
    let mut sums = [0.0; LANES];
    for values in lanes(values) {
        for l in 0..LANES {
            let value = f64::from(values[l]);
            sums[l] += value * value;
        }
    }
    sums.iter().sum()
}

// Writes u₀ − Hv and returns its square.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn misfit(data: &[f32], convolved: &[f32], residual: &mut [f32]) -> f64 {
    let mut sums = [0.0; LANES];
    let values = lanes(data).zip(lanes(convolved));
    for (to, (data, convolved)) in residual.as_chunks_mut().0.iter_mut().zip(values) {
        let mut out = [0.0f32; LANES];
        for l in 0..LANES {
            out[l] = data[l] - convolved[l];
            sums[l] += f64::from(out[l]) * f64::from(out[l]);
        }
        *to = out;
    }
    sums.iter().sum()
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn update_neurons(
    rule: &Rule,
    state: &[f32],
    gradient: &[f32],
    thresholds: &[f32],
    next: &mut [f32],
) -> u32 {
    let (unit, floor) = (rule.unit as f32, rule.floor());
    let (adaptive, step) = match rule.step {
        Step::Adaptive(c) | Step::Accelerated(c) => (true, c as f32),
        Step::Constant(delta) => (false, delta as f32),
    };
    let mut updated = [0; LANES];
    let values = lanes(state).zip(lanes(gradient)).zip(lanes(thresholds));
    for (to, ((from, f), thresholds)) in next.as_chunks_mut().0.iter_mut().zip(values) {
        let mut out = [0.0f32; LANES];
        for l in 0..LANES {
            let beyond = f[l].abs() > thresholds[l] * unit;
            let change = if adaptive {
                step * f[l]
            } else {
                step.copysign(f[l])
            };
            let value = if beyond { from[l] + change } else { from[l] };
            out[l] = if value > floor { value } else { floor };
            updated[l] += u32::from(beyond);
        }
        *to = out;
    }
    updated.iter().sum()
}

// Sets negative neurons of the candidate to zero (Eq. 14); returns whether there were any.
fn clip(next: &mut [f32]) -> bool {
    let mut negative = false;
    for value in next {
        let below = *value < 0.0;
        negative |= below;
        *value = if below { 0.0 } else { *value };
    }
    negative
}

// Adds momentum to an update from `b.state` to `b.next`: `b.moved` takes the update and `b.next` goes
// on beyond it, in the direction from the update before. `momentum` is Nesterov's t; it starts anew
// where the direction points uphill (O'Donoghue & Candès 2015, gradient scheme). Returns whether
// there was any momentum.
fn extrapolate(rule: &Rule, b: &mut NetworkScratch, momentum: &mut f64) -> bool {
    b.moved.copy_from_slice(&b.next);
    if points_uphill(&b.state, &b.moved, &b.last) {
        *momentum = 1.0;
    }
    let next = 0.5 * (1.0 + (1.0 + 4.0 * *momentum * *momentum).sqrt());
    let beta = ((*momentum - 1.0) / next) as f32;
    *momentum = next;
    let floor = rule.floor();
    for ((to, moved), last) in b.next.iter_mut().zip(&b.moved).zip(&b.last) {
        let value = moved + beta * (moved - last);
        *to = if value > floor { value } else { floor };
    }
    beta > 0.0
}

// Whether (from − moved)·(moved − last) > 0.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn points_uphill(from: &[f32], moved: &[f32], last: &[f32]) -> bool {
    let mut sums = [0.0; LANES];
    for ((from, moved), last) in lanes(from).zip(lanes(moved)).zip(lanes(last)) {
        for l in 0..LANES {
            sums[l] += f64::from((from[l] - moved[l]) * (moved[l] - last[l]));
        }
    }
    sums.iter().sum::<f64>() > 0.0
}

// Writes D times a row-major image of `n`×`n` pixels, zero outside, to `out`. The kernel is a·uuᵀ less a part of its
// middle element, with u = (1, r, 1): sums along x, and then along y. `lines` has `n` zeros, room for the image, and
// `n` zeros.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn roughen(image: &[f32], n: usize, lines: &mut [f32], out: &mut [f32]) {
    let corner = SUN_KERNEL[0][0];
    let ratio = SUN_KERNEL[0][1] / corner;
    let middle = SUN_KERNEL[1][1] - corner * ratio * ratio;
    let [corner, ratio, middle] = [corner, ratio, middle].map(|value| value as f32);
    let (image, out) = (&image[..n * n], &mut out[..n * n]);
    let inner = &mut lines[n..][..n * n];
    for (out, three) in inner[1..].iter_mut().zip(image.windows(3)) {
        *out = three[0] + three[2] + ratio * three[1];
    }
    // Pixels at the ends of rows have one neighbour.
    for (out, row) in inner.chunks_exact_mut(n).zip(image.chunks_exact(n)) {
        out[0] = row[1] + ratio * row[0];
        out[n - 1] = row[n - 2] + ratio * row[n - 1];
    }
    let above_and_below = lines[..n * n].iter().zip(&lines[2 * n..]);
    let values = lines[n..].iter().zip(above_and_below).zip(image);
    for (out, ((line, (above, below)), pixel)) in out.iter_mut().zip(values) {
        *out = corner * (above + below + ratio * line) + middle * pixel;
    }
}

#[cfg(test)]
mod tests;
