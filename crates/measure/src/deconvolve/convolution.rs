//! The convolution H with the PSF and its transpose, under a zero boundary, by sums over modes.
//!
//! The stamp is continued by zeros to a period that is long enough: light that wraps around does not reach it again. Its few modes are sums
//! of real numbers by parity, as `spectral::plane` defines them for another method: with s = −sin,
//!
//! ```text
//! Σ I exp(−i(k_x x ± k_y y)) = (cc ∓ ss) + i(sc ± cs)
//! ```
//!
//! from the middle of the stamp, where the first letter stands for x. Each sum along an axis is a dense product, both to
//! modes and back. These products have fewer terms than sums over the pixels of the PSF.

use ndarray::ArrayView2;

use super::fold::Folding;
use shearq_quantities::product::{LANES, Matrix, ROWS, product};
use shearq_quantities::real::Real;

/// H of one stamp size and PSF size, holding one PSF.
#[derive(Debug, Clone)]
pub struct Convolution<T> {
    stamp: ToModes<T>,
    back: ToPixels<T>,
    /// From a PSF with as many pixels before its centre as after it.
    psf: ToModes<T>,
    /// That PSF, and buffers for its transform.
    centred: Vec<T>,
    scratch: Scratch<T>,
    /// Transforms of the PSF, times four: its products are folded. And of the PSF turned by 180°.
    transfer: Modes<T>,
    turned: Modes<T>,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct Scratch<T> {
    /// A folded image.
    parts: Vec<T>,
    /// It, and then modes, transformed along one axis: even and odd along x.
    lines: [Vec<T>; 2],
    modes: Modes<T>,
}

/// Sums of an image by parity: cc, cs, sc and ss.
#[derive(Debug, Clone)]
struct Modes<T>([Vec<T>; 4]);

/// Sizes of the period.
#[derive(Debug, Clone, Copy)]
struct Period {
    /// In pixels; odd, so that no mode but zero is its own opposite.
    pixels: usize,
    /// Modes along an axis, from zero on.
    modes: usize,
    /// The same, filled up for products.
    rows: usize,
    width: usize,
}

impl Period {
    /// For stamps of side `n` and PSFs that reach as far as `reach` pixels.
    fn new(n: usize, reach: usize) -> Self {
        let pixels = (n + reach) | 1;
        let modes = pixels / 2 + 1;
        Period {
            pixels,
            modes,
            rows: modes.next_multiple_of(ROWS),
            width: modes.next_multiple_of(LANES),
        }
    }

    /// cos and s of mode `k` at the place `place` of a folded image.
    fn waves(&self, folding: &Folding, k: usize, place: usize) -> [f64; 2] {
        let angle = std::f64::consts::TAU * k as f64 / self.pixels as f64;
        let (sin, cos) = (angle * folding.distance(place)).sin_cos();
        [cos, -sin]
    }
}

/// Tables for cos and for s of `rows` by `columns`, zero outside of what `value` is asked for.
fn tables<T: Real>(
    [rows, columns]: [usize; 2],
    [all_rows, all_columns]: [usize; 2],
    value: impl Fn(usize, usize) -> [f64; 2],
) -> [Vec<T>; 2] {
    let mut tables = [0; 2].map(|_| vec![T::ZERO; all_rows * all_columns]);
    for row in 0..rows {
        for column in 0..columns {
            for (table, value) in tables.iter_mut().zip(value(row, column)) {
                table[row * all_columns + column] = T::from_f64(value);
            }
        }
    }
    tables
}

/// From the pixels of an image to its modes.
#[derive(Debug, Clone)]
struct ToModes<T> {
    folding: Folding,
    period: Period,
    /// By place and mode: cos and s along x.
    across: [Vec<T>; 2],
    /// By mode and place: cos and s along y.
    down: [Vec<T>; 2],
}

impl<T: Real> ToModes<T> {
    fn new(n: usize, period: Period) -> Self {
        let folding = Folding::new(n);
        let Folding { half, places, .. } = folding;
        let wave = |k: usize, place: usize| {
            let share = folding.share(place);
            period.waves(&folding, k, place).map(|wave| wave * share)
        };
        let Period {
            modes, rows, width, ..
        } = period;
        ToModes {
            folding,
            period,
            across: tables([half, modes], [half, width], |place, k| wave(k, place)),
            down: tables([modes, half], [rows, places], wave),
        }
    }

    /// Takes the modes of a folded image.
    #[inline(always)]
    fn transform<const R: usize, const FUSED: bool>(
        &self,
        parts: &[T],
        lines: &mut [Vec<T>; 2],
        modes: &mut Modes<T>,
    ) {
        let Period { rows, width, .. } = self.period;
        let Folding {
            half, places, band, ..
        } = self.folding;
        for x in 0..2 {
            let parts = Matrix::new(&parts[x * self.folding.len()..], places);
            let across = Matrix::new(&self.across[x], width);
            let lines = &mut lines[x][..2 * band * width];
            product::<T, R, FUSED>(parts, across, half, lines, width);
        }
        for (at, modes) in modes.0.iter_mut().enumerate() {
            let (x, y) = (at / 2, at % 2);
            let down = Matrix::new(&self.down[y], places);
            let lines = Matrix::new(&lines[x][y * band * width..], width);
            product::<T, R, FUSED>(down, lines, half, &mut modes[..rows * width], width);
        }
    }
}

/// From modes to the pixels of the image.
#[derive(Debug, Clone)]
struct ToPixels<T> {
    folding: Folding,
    period: Period,
    /// Places along y, filled up.
    padded: usize,
    /// By place and mode: cos and s along y, times how many modes each stands for.
    down: [Vec<T>; 2],
    /// By mode and place, the same along x.
    across: [Vec<T>; 2],
}

impl<T: Real> ToPixels<T> {
    fn new(n: usize, period: Period) -> Self {
        let folding = Folding::new(n);
        let Folding { half, places, .. } = folding;
        let wave = |k: usize, place: usize| {
            let count = if k == 0 { 1.0 } else { 2.0 };
            let waves = period.waves(&folding, k, place);
            waves.map(|wave| wave * count / period.pixels as f64)
        };
        let Period { modes, width, .. } = period;
        let padded = half.next_multiple_of(ROWS);
        ToPixels {
            folding,
            period,
            padded,
            down: tables([half, modes], [padded, width], |place, k| wave(k, place)),
            across: tables([modes, half], [modes, places], wave),
        }
    }

    /// Writes the parts, even and odd along each axis, of the image of these modes.
    #[inline(always)]
    fn transform<const R: usize, const FUSED: bool>(
        &self,
        Modes(spectrum): &Modes<T>,
        lines: &mut [Vec<T>; 2],
        parts: &mut [T],
    ) {
        let Period { modes, width, .. } = self.period;
        let Folding { places, band, .. } = self.folding;
        let halves = parts.chunks_exact_mut(self.folding.len());
        for (at, spectrum) in spectrum.iter().enumerate() {
            let (x, y) = (at / 2, at % 2);
            let down = Matrix::new(&self.down[y], width);
            // Rows of the first part beyond `band` are written again by the second; such rows of the second are not used.
            let lines = &mut lines[x][y * band * width..][..self.padded * width];
            product::<T, R, FUSED>(down, Matrix::new(spectrum, width), modes, lines, width);
        }
        for (x, parts) in halves.take(2).enumerate() {
            let lines = Matrix::new(&lines[x], width);
            let across = Matrix::new(&self.across[x], places);
            product::<T, R, FUSED>(lines, across, modes, parts, places);
        }
    }
}

impl<T: Real> Scratch<T> {
    /// For transforms of both.
    fn new(stamp: &ToModes<T>, psf: &ToModes<T>) -> Self {
        let Period { rows, width, .. } = stamp.period;
        let band = stamp.folding.band.max(psf.folding.band);
        let len = stamp.folding.len().max(psf.folding.len());
        Scratch {
            parts: vec![T::ZERO; 2 * len],
            lines: [0; 2].map(|_| vec![T::ZERO; (2 * band + ROWS) * width]),
            modes: Modes([0; 4].map(|_| vec![T::ZERO; rows * width])),
        }
    }
}

/// Multiplies modes by the modes of a kernel.
#[inline(always)]
fn filter<T: Real, const FUSED: bool>(Modes(modes): &mut Modes<T>, Modes(kernel): &Modes<T>) {
    for at in (0..modes[0].len()).step_by(LANES) {
        let [cc, cs, sc, ss] = four(modes, at);
        let [kcc, kcs, ksc, kss] = four(kernel, at);
        let mut out = [[T::ZERO; LANES]; 4];
        for l in 0..LANES {
            out[0][l] =
                products::<T, FUSED>(cc[l], kcc[l], ss[l], kss[l])
                    .minus(products::<T, FUSED>(sc[l], ksc[l], cs[l], kcs[l]));
            out[1][l] =
                products::<T, FUSED>(cc[l], kcs[l], cs[l], kcc[l])
                    .minus(products::<T, FUSED>(ss[l], ksc[l], sc[l], kss[l]));
            out[2][l] =
                products::<T, FUSED>(cc[l], ksc[l], sc[l], kcc[l])
                    .minus(products::<T, FUSED>(ss[l], kcs[l], cs[l], kss[l]));
            out[3][l] = products::<T, FUSED>(cc[l], kss[l], ss[l], kcc[l])
                .plus(products::<T, FUSED>(sc[l], kcs[l], cs[l], ksc[l]));
        }
        for (part, out) in modes.iter_mut().zip(out) {
            part[at..][..LANES].copy_from_slice(&out);
        }
    }
}

/// The lanes at a place of four parts.
#[inline(always)]
fn four<T: Copy>([cc, cs, sc, ss]: &[Vec<T>; 4], at: usize) -> [[T; LANES]; 4] {
    [lanes(cc, at), lanes(cs, at), lanes(sc, at), lanes(ss, at)]
}

#[inline(always)]
fn lanes<T: Copy>(values: &[T], at: usize) -> [T; LANES] {
    *values[at..].first_chunk().expect("modes of whole lanes")
}

/// a·b + c·d.
#[inline(always)]
fn products<T: Real, const FUSED: bool>(a: T, b: T, c: T, d: T) -> T {
    a.times(b).add_product::<FUSED>(c, d)
}

impl<T: Real> Convolution<T> {
    /// For stamps of n×n pixels and PSFs of p×p; the PSF is zero.
    pub(super) fn new(n: usize, p: usize) -> Self {
        let reach = p / 2;
        let period = Period::new(n, reach);
        let psf = ToModes::new(2 * reach + 1, period);
        let (stamp, back) = (ToModes::new(n, period), ToPixels::new(n, period));
        let scratch = Scratch::new(&stamp, &psf);
        Convolution {
            centred: vec![T::ZERO; psf.folding.n * psf.folding.n],
            transfer: scratch.modes.clone(),
            turned: scratch.modes.clone(),
            scratch,
            stamp,
            back,
            psf,
        }
    }

    /// Buffers that fit.
    pub(super) fn scratch(&self) -> Scratch<T> {
        Scratch::new(&self.stamp, &self.psf)
    }

    /// Takes `factor` times a PSF of the planned size, whose centre is its pixel p/2. Allocates nothing.
    #[inline(always)]
    pub(super) fn set_psf<const R: usize, const FUSED: bool>(
        &mut self,
        psf: ArrayView2<'_, f64>,
        factor: f64,
    ) {
        // One of even side has no pixels in the last row and column.
        let rows = self.centred.chunks_exact_mut(self.psf.folding.n);
        for (to, row) in rows.zip(psf.rows()) {
            for (to, value) in to.iter_mut().zip(row) {
                *to = T::from_f64(*value * factor);
            }
        }
        let Scratch {
            parts,
            lines,
            modes,
        } = &mut self.scratch;
        let (sums, differences) = parts.split_at_mut(self.psf.folding.len());
        self.psf.folding.fold(&self.centred, sums, differences);
        self.psf.transform::<R, FUSED>(parts, lines, modes);
        let four = T::from_f64(4.0);
        for (part, modes) in modes.0.iter().enumerate() {
            // Turned by 180°, what is odd along one axis changes its sign.
            let sign = T::from_f64(if part == 1 || part == 2 { -1.0 } else { 1.0 });
            let out = self.transfer.0[part]
                .iter_mut()
                .zip(&mut self.turned.0[part]);
            for ((transfer, turned), mode) in out.zip(modes) {
                (*transfer, *turned) = (mode.times(four), mode.times(sign));
            }
        }
    }

    /// Numbers in a folded stamp.
    pub(super) fn folded_len(&self) -> usize {
        2 * self.stamp.folding.len()
    }

    /// What the square of each number of a folded stamp adds to the sum of the squares of its pixels.
    pub(super) fn weights(&self) -> Vec<f64> {
        let folding = &self.stamp.folding;
        let places = folding.band * folding.places;
        let weight = |at: usize| {
            let (y, x) = (at % places / folding.places, at % folding.places);
            if y.max(x) >= folding.half {
                return 0.0;
            }
            // Four pixels of a square; each part is four times as large as what it adds to a pixel.
            folding.share(x) * folding.share(y) / 4.0
        };
        (0..self.folded_len()).map(weight).collect()
    }

    /// Folds a row-major stamp.
    #[inline(always)]
    pub(super) fn fold(&self, image: &[T], folded: &mut [T]) {
        let (sums, differences) = folded.split_at_mut(self.stamp.folding.len());
        self.stamp.folding.fold(image, sums, differences);
    }

    /// Writes H times a row-major image, folded.
    #[inline(always)]
    pub(super) fn apply<const R: usize, const FUSED: bool>(
        &self,
        image: &[T],
        Scratch { lines, modes, .. }: &mut Scratch<T>,
        folded: &mut [T],
    ) {
        self.fold(image, folded);
        self.stamp.transform::<R, FUSED>(folded, lines, modes);
        filter::<T, FUSED>(modes, &self.transfer);
        self.back.transform::<R, FUSED>(modes, lines, folded);
    }

    /// Writes Hᵀ times a folded image, row-major.
    #[inline(always)]
    pub(super) fn apply_transposed<const R: usize, const FUSED: bool>(
        &self,
        folded: &[T],
        Scratch {
            parts,
            lines,
            modes,
        }: &mut Scratch<T>,
        image: &mut [T],
    ) {
        self.stamp.transform::<R, FUSED>(folded, lines, modes);
        filter::<T, FUSED>(modes, &self.turned);
        self.back.transform::<R, FUSED>(modes, lines, parts);
        let (even, odd) = parts.split_at(self.stamp.folding.len());
        self.stamp.folding.unfold(even, odd, image);
    }
}
