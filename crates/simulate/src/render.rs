//! Noise-free stamps of PSF-convolved galaxies, integrated over pixels.
//!
//! The image is the inverse transform of galaxy × PSF × pixel on a grid of wavenumbers. A discrete
//! transform of N × N points repeats the image every N pixels and repeats the spectrum every 2π:
//! light from the repeated images folds into the stamp where N is small, and wavenumbers beyond π
//! must be added onto those within (that is what sampling does to real light, too).
//! [`Renderer::render`] chooses N and the largest wavenumber for each galaxy so that neither is
//! seen; [`render_reference`] reads like the equation and is the oracle of its tests.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use multiversion::multiversion;
use ndarray::Array2;
use shearq_fourier::{Complex32, Complex64, ComplexToReal, Plan32, Planner32};
use shearq_quantities::FunctionalPsf;
use shearq_quantities::Shear;
use shearq_quantities::TransformedPsf;
use shearq_quantities::radial::{QuadraticForm, SingleTable};

use super::galaxy::{Component, EXPONENTIAL_HALF_LIGHT, Galaxy, Sersic};

/// Wavenumbers are dropped where galaxy × PSF is below this share of the flux. The image loses
/// about 1/(2π) ∫ k |F| dk over them; in a PSF's exponential tail near k = 3 that is of the same
/// order, against a peak pixel of some 2e-2 of the flux.
const SPECTRUM_TOLERANCE: f64 = 3e-6;

/// Light that may fold into the nearest corner of the stamp, relative to the galaxy's peak.
const FOLDING_TOLERANCE: f64 = 3e-5;

/// The largest wavenumber in units of π. It is reached only by PSFs with a FWHM near one pixel.
const MAX_ORDER: usize = 3;

/// Smallest transforms tried, in thirds of the stamp's size.
const GRIDS_IN_THIRDS: [usize; 4] = [6, 8, 12, 24];

/// Draws galaxies on square stamps of one size.
///
/// It holds the plans of the transforms and is shared between threads; what changes with a galaxy
/// is in the caller's [`RenderScratch`].
pub struct Renderer {
    stamp: usize,
    grids: Vec<Grid>,
}

impl std::fmt::Debug for Renderer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Renderer").finish_non_exhaustive()
    }
}

/// One size of transform.
struct Grid {
    size: usize,
    /// The inverse transform along y.
    columns: Plan32,
    /// The inverse transform along x, from half of the wavenumbers to real values.
    rows: Arc<dyn ComplexToReal<f32>>,
    /// sin(k/2)/(k/2), a pixel's transform along one axis, at k = 2πj/N.
    pixel: Vec<f32>,
}

/// Work space of [`Renderer::render`], for any renderer and any galaxy. Its contents do not
/// influence the result.
#[derive(Default)]
pub struct RenderScratch {
    /// One column after the other: y runs fastest.
    spectrum: Vec<Complex32>,
    fft: Vec<Complex32>,
    row: Vec<Complex32>,
    line: Vec<f32>,
    /// Galaxy and PSF × pixel on one column.
    amplitude: Vec<f32>,
    blur: Vec<f32>,
    /// Transform of pixels along y times 1/N², for ky from −last to last.
    pixel_y: Vec<f32>,
    transfer: Transfer,
    phases: [Phases; Galaxy::MAX_COMPONENTS],
}

impl std::fmt::Debug for RenderScratch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RenderScratch").finish_non_exhaustive()
    }
}

/// The transform of the PSF that was used last: galaxies of an image often share it.
#[derive(Default)]
struct Transfer {
    /// The PSF and the size of the grid.
    of: Option<(FunctionalPsf, usize)>,
    /// Wavenumbers along an axis up to the largest, with those of column i at ky from −last to last in line i.
    last: usize,
    lines: Vec<f32>,
    /// Reach of the line of each column.
    reaches: Vec<Option<usize>>,
}

impl Transfer {
    /// Forgets the PSF unless it is `psf` on a grid of `size`, up to wavenumber `last`.
    fn prepare(&mut self, psf: &TransformedPsf<'_>, size: usize, last: usize) {
        let of = Some((psf.functional(), size));
        if self.of == of && last <= self.last {
            return;
        }
        self.of = of;
        self.last = last;
        self.lines.resize((last + 1) * (2 * last + 1), 0.0);
        self.reaches.clear();
        self.reaches.resize(last + 1, None);
    }

    /// The transform on column `i` from −reach to reach, with a quadratic form of the wavenumbers.
    fn line(
        &mut self,
        table: SingleTable<'_>,
        form: QuadraticForm,
        i: usize,
        reach: usize,
    ) -> &[f32] {
        let wide = 2 * self.last + 1;
        let span = i * wide + self.last - reach..i * wide + self.last + reach + 1;
        let line = &mut self.lines[span];
        if self.reaches[i].is_none_or(|known| known < reach) {
            tabulate(table, form, i, reach, line);
            self.reaches[i] = Some(reach);
        }
        line
    }
}

/// e^{−ik·x} of a shift along both axes: kx from 0 to last, ky from −last to last.
#[derive(Default)]
struct Phases {
    x: Vec<Complex32>,
    y_re: Vec<f32>,
    y_im: Vec<f32>,
}

impl RenderScratch {
    /// Empty; the first use takes the memory.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Renderer {
    /// For stamps of `stamp` × `stamp` pixels.
    ///
    /// # Panics
    /// When `stamp` is 0.
    pub fn new(stamp: usize) -> Self {
        assert!(stamp > 0, "a stamp has at least one pixel");
        let mut planner = Planner32::new();
        let grids = GRIDS_IN_THIRDS
            .iter()
            .map(|thirds| {
                let size = good_size((stamp * thirds).div_ceil(3).max(16));
                Grid {
                    size,
                    columns: planner.inverse(size),
                    rows: planner.real_inverse(size),
                    pixel: (0..=MAX_ORDER * size / 2)
                        .map(|j| sinc(TAU * j as f64 / size as f64) as f32)
                        .collect(),
                }
            })
            .collect();
        Renderer { stamp, grids }
    }

    /// Pixels on a side.
    pub fn stamp(&self) -> usize {
        self.stamp
    }

    /// Draws `galaxy`, convolved with `psf` and integrated over pixels, into `out`, a stamp in
    /// row-major order (rows are y). Called in parallel: it is serial, and takes no memory once
    /// `scratch` has grown.
    ///
    /// `centre` is the galaxy's centre in 0-based pixel-centre coordinates: (23.5, 23.5) is the
    /// corner of the four central pixels of a 48 × 48 stamp. The centre should lie in the stamp.
    /// The sum of `out` is the flux less the light outside the stamp. Errors are near 1e-4 of the
    /// peak or less; the transform grows with galaxies whose wings would fold, up to eight stamps.
    ///
    /// # Panics
    /// When `out` has not `stamp`² values.
    pub fn render(
        &self,
        galaxy: &Galaxy,
        psf: &TransformedPsf<'_>,
        centre: (f64, f64),
        scratch: &mut RenderScratch,
        out: &mut [f32],
    ) {
        assert_eq!(
            out.len(),
            self.stamp * self.stamp,
            "the stamp's size differs"
        );
        let grid = self.choose_grid(galaxy, psf, centre);
        grid.fill_spectrum(galaxy, psf, centre, scratch);
        grid.transform(self.stamp, scratch, out);
    }

    /// The side of the transform that [`Renderer::render`] takes for a galaxy.
    pub fn transform_size(
        &self,
        galaxy: &Galaxy,
        psf: &TransformedPsf<'_>,
        centre: (f64, f64),
    ) -> usize {
        self.choose_grid(galaxy, psf, centre).size
    }

    fn choose_grid(&self, galaxy: &Galaxy, psf: &TransformedPsf<'_>, centre: (f64, f64)) -> &Grid {
        let limit = FOLDING_TOLERANCE * rough_peak(galaxy, psf);
        let last = (self.stamp - 1) as f64;
        let reach = |c: f64| c.max(last - c);
        let reach = (reach(centre.0), reach(centre.1));
        let largest = self.grids.len() - 1;
        self.grids[..largest]
            .iter()
            .find(|grid| folded_light(galaxy, psf, grid.size as f64, reach) <= limit)
            .unwrap_or(&self.grids[largest])
    }
}

impl Grid {
    /// Puts galaxy × PSF × pixel × shift / N² into the half-plane kx ≥ 0 of `scratch.spectrum`.
    fn fill_spectrum(
        &self,
        galaxy: &Galaxy,
        psf: &TransformedPsf<'_>,
        centre: (f64, f64),
        scratch: &mut RenderScratch,
    ) {
        let n = self.size;
        let half = n / 2;
        let step = TAU / n as f64;
        let cut = largest_wavenumber(galaxy, psf).min(MAX_ORDER as f64 * PI);
        let last = ((cut / step) as usize).min(MAX_ORDER * n / 2);
        let wide = 2 * last + 1;

        let RenderScratch {
            spectrum,
            row,
            amplitude,
            blur,
            pixel_y,
            transfer,
            phases,
            ..
        } = scratch;
        spectrum.clear();
        spectrum.resize(n * (half + 1), Complex32::ZERO);
        amplitude.resize(wide, 0.0);
        blur.resize(wide, 0.0);
        let norm = 1.0 / (n as f32 * n as f32);
        pixel_y.clear();
        pixel_y.extend((0..wide).map(|j| self.pixel[j.abs_diff(last)] * norm));
        for (phases, group) in phases.iter_mut().zip(groups(galaxy)) {
            phases.set(step, last, centre.0 + group[0].dx, centre.1 + group[0].dy);
        }

        let psf_argument = argument(psf.shape, psf.fwhm, step);
        let psf_table = psf.transform.table().single();
        transfer.prepare(psf, n, last);
        let bulge_table = Sersic::de_vaucouleurs_table().single();
        for i in 0..=last {
            let beside = (cut / step).powi(2) - (i * i) as f64;
            let reach = (beside.max(0.0).sqrt() as usize).min(last);
            let span = last - reach..last + reach + 1;
            let blur = &mut blur[span.clone()];
            let transfer = transfer.line(psf_table, psf_argument, i, reach);
            blurred(self.pixel[i], &pixel_y[span.clone()], transfer, blur);
            for (phases, group) in phases.iter().zip(groups(galaxy)) {
                let amplitude = &mut amplitude[span.clone()];
                amplitude.fill(0.0);
                for component in group {
                    let at = argument(component.shape, component.half_light_radius, step);
                    let flux = component.flux as f32;
                    match component.profile {
                        Sersic::Exponential => {
                            let h2 = EXPONENTIAL_HALF_LIGHT * EXPONENTIAL_HALF_LIGHT;
                            add_exponential(at.scaled(1.0 / h2), i, reach, flux, amplitude);
                        }
                        Sersic::DeVaucouleurs => {
                            add_tabulated(bulge_table, at, i, reach, flux, amplitude);
                        }
                    }
                }
                multiply(amplitude, blur);
                let source = Line {
                    amplitude,
                    re: &phases.y_re[span.clone()],
                    im: &phases.y_im[span.clone()],
                    phase_x: phases.x[i],
                };
                // Wavenumbers that differ by N are one; the half-plane holds columns 0 to N/2,
                // and of a column beyond them the mirror image, the complex conjugate.
                let column = i % n;
                if column <= half {
                    add_line(&source, reach, &mut spectrum[column * n..][..n], false);
                }
                let mirror = (n - column) % n;
                if i > 0 && mirror <= half {
                    add_line(&source, reach, &mut spectrum[mirror * n..][..n], true);
                }
            }
        }
        // Its length says how many columns are not empty.
        row.clear();
        row.resize(last.min(half) + 1, Complex32::ZERO);
    }

    fn transform(&self, stamp: usize, scratch: &mut RenderScratch, out: &mut [f32]) {
        let n = self.size;
        let columns = scratch.row.len();
        let need = self
            .columns
            .get_inplace_scratch_len()
            .max(self.rows.get_scratch_len());
        scratch
            .fft
            .resize(need.max(scratch.fft.len()), Complex32::ZERO);
        self.columns
            .process_with_scratch(&mut scratch.spectrum[..columns * n], &mut scratch.fft);
        scratch.row.resize(n / 2 + 1, Complex32::ZERO);
        scratch.line.resize(n, 0.0);
        for (y, pixels) in out.chunks_exact_mut(stamp).enumerate() {
            for (i, value) in scratch.row[..columns].iter_mut().enumerate() {
                *value = scratch.spectrum[i * n + y];
            }
            scratch.row[columns..].fill(Complex32::ZERO);
            // Real by symmetry; only rounding is removed.
            scratch.row[0].im = 0.0;
            if n.is_multiple_of(2) {
                scratch.row[n / 2].im = 0.0;
            }
            self.rows
                .process_with_scratch(&mut scratch.row, &mut scratch.line, &mut scratch.fft)
                .expect("lengths come from the plan");
            pixels.copy_from_slice(&scratch.line[..stamp]);
        }
    }
}

impl Phases {
    fn set(&mut self, step: f64, last: usize, x: f64, y: f64) {
        self.x.clear();
        let mut phase = Complex64::ONE;
        let turn = Complex64::from_polar(1.0, -step * x);
        for _ in 0..=last {
            self.x
                .push(Complex32::new(phase.re as f32, phase.im as f32));
            phase *= turn;
        }
        self.y_re.resize(2 * last + 1, 0.0);
        self.y_im.resize(2 * last + 1, 0.0);
        let mut phase = Complex64::ONE;
        let turn = Complex64::from_polar(1.0, -step * y);
        for j in 0..=last {
            self.y_re[last + j] = phase.re as f32;
            self.y_im[last + j] = phase.im as f32;
            self.y_re[last - j] = phase.re as f32;
            self.y_im[last - j] = -phase.im as f32;
            phase *= turn;
        }
    }
}

/// Components that share a centre: they share their phases and add up as real numbers.
fn groups(galaxy: &Galaxy) -> impl Iterator<Item = &[Component]> {
    galaxy
        .components()
        .chunk_by(|a, b| a.dx == b.dx && a.dy == b.dy)
}

/// A column of wavenumbers from −reach to reach: real values and the phases of the shift.
struct Line<'a> {
    amplitude: &'a [f32],
    re: &'a [f32],
    im: &'a [f32],
    phase_x: Complex32,
}

/// The squared radius in a table's units at integer wavenumbers (i, j).
fn argument(shape: Shear, length: f64, step: f64) -> QuadraticForm {
    QuadraticForm::of_wavenumbers(shape).scaled((length * step).powi(2))
}

/// A quadratic form on column `i`, as a polynomial in j: `(constant, linear, square)`.
#[inline(always)]
fn on_column(form: QuadraticForm, i: usize) -> (f32, f32, f32) {
    let i = i as f64;
    (
        (form.xx * i * i) as f32,
        (2.0 * form.xy * i) as f32,
        form.yy as f32,
    )
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_exponential(form: QuadraticForm, i: usize, reach: usize, flux: f32, out: &mut [f32]) {
    let (constant, linear, square) = on_column(form, i);
    for (index, value) in out.iter_mut().enumerate() {
        let j = index as i32 as f32 - reach as i32 as f32;
        let v = 1.0 + constant + j * (linear + square * j);
        *value += flux / (v * v.sqrt());
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_tabulated(
    table: SingleTable<'_>,
    form: QuadraticForm,
    i: usize,
    reach: usize,
    flux: f32,
    out: &mut [f32],
) {
    let (constant, linear, square) = on_column(form, i);
    for (index, value) in out.iter_mut().enumerate() {
        let j = index as i32 as f32 - reach as i32 as f32;
        let u = constant + j * (linear + square * j);
        *value += flux * table.at(u.max(0.0));
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn tabulate(table: SingleTable<'_>, form: QuadraticForm, i: usize, reach: usize, out: &mut [f32]) {
    let (constant, linear, square) = on_column(form, i);
    for (index, value) in out.iter_mut().enumerate() {
        let j = index as i32 as f32 - reach as i32 as f32;
        let u = constant + j * (linear + square * j);
        *value = table.at(u.max(0.0));
    }
}

/// The transform of the PSF and of pixels.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn blurred(pixel_x: f32, pixel_y: &[f32], transfer: &[f32], out: &mut [f32]) {
    for (out, (pixel_y, transfer)) in out.iter_mut().zip(pixel_y.iter().zip(transfer)) {
        *out = pixel_x * pixel_y * transfer;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn multiply(values: &mut [f32], factors: &[f32]) {
    for (value, factor) in values.iter_mut().zip(factors) {
        *value *= factor;
    }
}

/// Adds a column, or its point reflection, onto wavenumbers modulo the length of `target`.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_line(line: &Line<'_>, reach: usize, target: &mut [Complex32], mirrored: bool) {
    let n = target.len();
    let count = 2 * reach + 1;
    let mut from = 0;
    // Parts without a jump from the last to the first wavenumber. Where several meet, they are added in order.
    while from < count {
        // index − reach, or its opposite, made positive before the remainder.
        let j = if mirrored { 2 * reach - from } else { from };
        let place = (j + n * reach.div_ceil(n) - reach) % n;
        let room = if mirrored { place + 1 } else { n - place };
        let part = from..(from + room).min(count);
        from = part.end;
        if mirrored {
            let first = place + 1 - part.len();
            let target = target[first..=place].iter_mut().rev();
            add_values(line, part, target, -1.0);
        } else {
            add_values(line, part, target[place..].iter_mut(), 1.0);
        }
    }
}

/// Adds a part of a column, or its complex conjugate if `sign` is −1.
#[inline(always)]
fn add_values<'a>(
    line: &Line<'_>,
    part: std::ops::Range<usize>,
    target: impl Iterator<Item = &'a mut Complex32>,
    sign: f32,
) {
    let phases = line.re[part.clone()].iter().zip(&line.im[part.clone()]);
    let values = line.amplitude[part].iter().zip(phases);
    let p = line.phase_x;
    for (sum, (a, (re, im))) in target.zip(values) {
        let (re, im) = (a * re, a * im);
        sum.re += re * p.re - im * p.im;
        sum.im += sign * (re * p.im + im * p.re);
    }
}

/// The wavenumber (rad/px) beyond which galaxy × PSF is below the tolerance in all directions.
fn largest_wavenumber(galaxy: &Galaxy, psf: &TransformedPsf<'_>) -> f64 {
    // Along its short axis an ellipse's transform reaches farthest.
    let short = |modulus: f64| (1.0 - modulus) / (1.0 + modulus);
    let psf_scale = psf.fwhm * psf.fwhm * short(psf.shape.modulus());
    let limit = SPECTRUM_TOLERANCE * galaxy.flux();
    let above = |k: f64| {
        let light: f64 = galaxy
            .components()
            .iter()
            .map(|c| {
                let scale = c.half_light_radius * c.half_light_radius;
                c.flux * c.profile.fourier(k * k * scale * short(c.shape.modulus()))
            })
            .sum();
        light * psf.transform.at(k * k * psf_scale) > limit
    };
    let (mut low, mut high) = (0.0, MAX_ORDER as f64 * PI);
    if above(high) {
        return high;
    }
    for _ in 0..9 {
        let middle = 0.5 * (low + high);
        if above(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// A rough peak surface brightness after the PSF, on the low side.
fn rough_peak(galaxy: &Galaxy, psf: &TransformedPsf<'_>) -> f64 {
    let blur = 0.6 * psf.fwhm;
    galaxy
        .components()
        .iter()
        .map(|c| c.flux / (PI * (c.half_light_radius * c.half_light_radius + blur * blur)))
        .sum()
}

/// The brightest that a repeated image, `period` pixels away along x or y, gets within the stamp.
/// `reach` is the distance from the centre to the stamp's farthest pixel along x and y.
fn folded_light(galaxy: &Galaxy, psf: &TransformedPsf<'_>, period: f64, reach: (f64, f64)) -> f64 {
    let nearest = |form: QuadraticForm| {
        // The form's least value on the stamp's side facing the repeated image.
        let on_side = |across: f64, cross: f64, along: f64, distance: f64, half: f64| {
            let t = (-cross * distance / along).clamp(-half, half);
            across * distance * distance + 2.0 * cross * distance * t + along * t * t
        };
        let beside = on_side(
            form.xx,
            form.xy,
            form.yy,
            f64::max(period - reach.0, 0.0),
            reach.1,
        );
        let above = on_side(
            form.yy,
            form.xy,
            form.xx,
            f64::max(period - reach.1, 0.0),
            reach.0,
        );
        beside.min(above).sqrt()
    };
    let wings = psf
        .functional()
        .round_value(nearest(QuadraticForm::of_positions(psf.shape)));
    galaxy
        .components()
        .iter()
        .map(|c| {
            let radius = nearest(QuadraticForm::of_positions(c.shape)) / c.half_light_radius;
            let area = c.half_light_radius * c.half_light_radius;
            c.flux * (wings + c.profile.brightness(radius) / area)
        })
        .sum()
}

/// The smallest product of 2s and 3s that is even and at least `n`: quick to transform.
fn good_size(n: usize) -> usize {
    let is_good = |candidate: &usize| {
        let mut rest = *candidate;
        for factor in [2, 3] {
            while rest.is_multiple_of(factor) {
                rest /= factor;
            }
        }
        rest == 1 && candidate.is_multiple_of(2)
    };
    (n..).find(is_good).expect("powers of 2 do not end")
}

/// sin(k/2)/(k/2): the transform of a pixel along one axis.
pub(crate) fn sinc(k: f64) -> f64 {
    if k == 0.0 {
        1.0
    } else {
        (0.5 * k).sin() / (0.5 * k)
    }
}

/// The same image as [`Renderer::render`], written as the sum it is, in double precision.
///
/// I(x) = 1/N² Σ_k e^{ik·x} P(k) T(k) Σ_c F_c(k) e^{−ik·x_c} over k = 2π/N · (i, j), |k_x| and
/// |k_y| up to `orders`·π, with N = `period` pixels; T is the PSF by its formula and P the pixel.
/// Exact as both grow. Takes seconds; for tests and comparisons.
pub fn render_reference(
    stamp: usize,
    galaxy: &Galaxy,
    psf: &FunctionalPsf,
    centre: (f64, f64),
    period: usize,
    orders: f64,
) -> Array2<f64> {
    let step = TAU / period as f64;
    let last = (0.5 * orders * period as f64) as i64;
    let mut image = Array2::zeros((stamp, stamp));
    let mut along_y = vec![Complex64::ZERO; stamp];
    for i in 0..=last {
        let kx = step * i as f64;
        along_y.fill(Complex64::ZERO);
        for j in -last..=last {
            let ky = step * j as f64;
            let blur = psf.fourier(kx, ky) * sinc(kx) * sinc(ky);
            if blur.abs() < 1e-13 {
                continue;
            }
            let light: Complex64 = galaxy
                .components()
                .iter()
                .map(|c| {
                    let shift = kx * (centre.0 + c.dx) + ky * (centre.1 + c.dy);
                    c.fourier(kx, ky) * Complex64::from_polar(1.0, -shift)
                })
                .sum();
            let turn = Complex64::from_polar(1.0, ky);
            let mut value = light * blur;
            for sum in &mut along_y {
                *sum += value;
                value *= turn;
            }
        }
        // Wave vectors come in opposite pairs with conjugate values, except for kx = 0.
        let pair = if i == 0 { 1.0 } else { 2.0 };
        for ((y, x), pixel) in image.indexed_iter_mut() {
            let phase = Complex64::from_polar(1.0, kx * x as f64);
            *pixel += pair * (along_y[y] * phase).re;
        }
    }
    image / (period * period) as f64
}

#[cfg(test)]
mod tests;
