//! The convolution H with the PSF and its transpose, under a zero boundary, by sums over modes.
//!
//! The stamp is continued by zeros to a period in which nothing that wraps around reaches it again. Its few modes are sums
//! of real numbers by parity, as `spectral::plane` defines them for another method: with s = −sin,
//!
//! ```text
//! Σ I exp(−i(k_x x ± k_y y)) = (cc ∓ ss) + i(sc ± cs)
//! ```
//!
//! from the middle of the stamp, where the first letter stands for x. Each sum along an axis is a dense product, both to
//! modes and back. These products have fewer terms than sums over the pixels of the PSF.

use ndarray::ArrayView2;

use super::fold::{fold, unfold};
use super::product::{LANES, Matrix, ROWS, product};
use super::real::Real;

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

    /// cos and s of mode `k` at the place `place` of a folded image of `n` pixels a side.
    fn waves(&self, n: usize, k: usize, place: usize) -> [f64; 2] {
        let middle = if n.is_multiple_of(2) { 0.5 } else { 0.0 };
        let angle = std::f64::consts::TAU * k as f64 / self.pixels as f64;
        let (sin, cos) = (angle * (place as f64 + middle)).sin_cos();
        [cos, -sin]
    }
}

/// How a folded image of n×n pixels lies in memory: four parts, in the order of [`fold`], each in `band` rows of `places`
/// numbers. What is not used is zero.
#[derive(Debug, Clone, Copy)]
struct Folding {
    n: usize,
    /// Places along an axis from the middle on.
    half: usize,
    places: usize,
    /// Two parts are a multiple of [`ROWS`].
    band: usize,
}

impl Folding {
    fn new(n: usize) -> Self {
        let half = n.div_ceil(2);
        Folding {
            n,
            half,
            places: half.next_multiple_of(LANES),
            band: half.next_multiple_of(ROWS / 2),
        }
    }

    /// Numbers in a part.
    fn part(&self) -> usize {
        self.band * self.places
    }

    #[inline(always)]
    fn fold<T: Real>(&self, image: &[T], parts: &mut [T]) {
        let (sums, differences) = parts.split_at_mut(2 * self.part());
        let (ss, sd) = sums.split_at_mut(self.part());
        let (ds, dd) = differences.split_at_mut(self.part());
        fold(image, self.n, self.places, [ss, sd, ds, dd]);
    }

    /// The image whose parts, even and odd along each axis, are `parts`.
    #[inline(always)]
    fn unfold<T: Real>(&self, parts: &[T], image: &mut [T]) {
        let (even, odd) = parts.split_at(2 * self.part());
        let (ee, eo) = even.split_at(self.part());
        let (oe, oo) = odd.split_at(self.part());
        unfold([ee, eo, oe, oo], self.places, self.n, image);
    }

    /// What the square of each number adds to the sum of the squares of the pixels.
    fn weights(&self) -> Vec<f64> {
        let middle = |place: usize| {
            let doubled = !self.n.is_multiple_of(2) && place == 0;
            if doubled { 0.5 } else { 1.0 }
        };
        let mut weights = vec![0.0; 4 * self.part()];
        for part in weights.chunks_exact_mut(self.part()) {
            for (y, row) in part
                .chunks_exact_mut(self.places)
                .take(self.half)
                .enumerate()
            {
                for (x, weight) in row[..self.half].iter_mut().enumerate() {
                    // Four pixels of a square; each part is four times as large as what it adds to a pixel.
                    *weight = middle(x) * middle(y) / 4.0;
                }
            }
        }
        weights
    }
}

/// A table of `rows` by `columns`, zero outside of what `value` is asked for.
fn table<T: Real>(
    [rows, columns]: [usize; 2],
    [all_rows, all_columns]: [usize; 2],
    value: impl Fn(usize, usize) -> f64,
) -> Vec<T> {
    let mut table = vec![T::ZERO; all_rows * all_columns];
    for row in 0..rows {
        for column in 0..columns {
            table[row * all_columns + column] = T::from_f64(value(row, column));
        }
    }
    table
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
        let wave = |parity: usize, k: usize, place: usize| {
            // Folding doubles the middle pixel.
            let middle = !n.is_multiple_of(2) && place == 0;
            period.waves(n, k, place)[parity] * if middle { 0.5 } else { 1.0 }
        };
        let Period {
            modes, rows, width, ..
        } = period;
        ToModes {
            folding,
            period,
            across: [0, 1].map(|parity| {
                table([half, modes], [half, width], |place, k| {
                    wave(parity, k, place)
                })
            }),
            down: [0, 1].map(|parity| {
                table([modes, half], [rows, places], |k, place| {
                    wave(parity, k, place)
                })
            }),
        }
    }

    /// Takes the modes of a folded image.
    #[inline(always)]
    fn transform<const R: usize, const FUSED: bool>(&self, parts: &[T], scratch: &mut Scratch<T>) {
        let Period { rows, width, .. } = self.period;
        let Folding {
            half, places, band, ..
        } = self.folding;
        let Scratch { lines, modes, .. } = scratch;
        for x in 0..2 {
            let parts = Matrix::new(&parts[x * 2 * band * places..], places);
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
    /// By place and mode: cos and s along y, times how many modes each stands for.
    down: [Vec<T>; 2],
    /// By mode and place, the same along x.
    across: [Vec<T>; 2],
}

impl<T: Real> ToPixels<T> {
    fn new(n: usize, period: Period) -> Self {
        let folding = Folding::new(n);
        let Folding { half, places, .. } = folding;
        let wave = |parity: usize, k: usize, place: usize| {
            let count = if k == 0 { 1.0 } else { 2.0 };
            period.waves(n, k, place)[parity] * count / period.pixels as f64
        };
        let Period { modes, width, .. } = period;
        ToPixels {
            folding,
            period,
            down: [0, 1].map(|parity| {
                let all = [half.next_multiple_of(ROWS), width];
                table([half, modes], all, |place, k| wave(parity, k, place))
            }),
            across: [0, 1].map(|parity| {
                table([modes, half], [modes, places], |k, place| {
                    wave(parity, k, place)
                })
            }),
        }
    }

    /// Writes the parts, even and odd along each axis, of the image whose modes `scratch` has.
    #[inline(always)]
    fn transform<const R: usize, const FUSED: bool>(
        &self,
        scratch: &mut Scratch<T>,
        parts: &mut [T],
    ) {
        let Period { modes, width, .. } = self.period;
        let Folding {
            half, places, band, ..
        } = self.folding;
        let padded = half.next_multiple_of(ROWS);
        for (at, spectrum) in scratch.modes.0.iter().enumerate() {
            let (x, y) = (at / 2, at % 2);
            let down = Matrix::new(&self.down[y], width);
            // Rows of the first part beyond `band` are written again by the second; those of the second are not used.
            let lines = &mut scratch.lines[x][y * band * width..][..padded * width];
            product::<T, R, FUSED>(down, Matrix::new(spectrum, width), modes, lines, width);
        }
        for x in 0..2 {
            let lines = Matrix::new(&scratch.lines[x], width);
            let across = Matrix::new(&self.across[x], places);
            let parts = &mut parts[x * 2 * band * places..][..2 * band * places];
            product::<T, R, FUSED>(lines, across, modes, parts, places);
        }
    }
}

/// Multiplies modes by those of a kernel.
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
        let modes = Modes([0; 4].map(|_| vec![T::ZERO; period.rows * period.width]));
        let mut convolution = Convolution {
            centred: vec![T::ZERO; psf.folding.n * psf.folding.n],
            scratch: Scratch {
                parts: Vec::new(),
                lines: [Vec::new(), Vec::new()],
                modes: modes.clone(),
            },
            transfer: modes.clone(),
            turned: modes,
            stamp,
            back,
            psf,
        };
        convolution.scratch = convolution.scratch();
        convolution
    }

    /// Buffers that fit.
    pub(super) fn scratch(&self) -> Scratch<T> {
        let [stamp, psf] = [self.stamp.folding, self.psf.folding];
        let rows = 2 * stamp.band.max(psf.band) + ROWS;
        let Period { width, .. } = self.stamp.period;
        Scratch {
            parts: vec![T::ZERO; 4 * stamp.part().max(psf.part())],
            lines: [0, 1].map(|_| vec![T::ZERO; rows * width]),
            modes: self.scratch.modes.clone(),
        }
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
        let mut parts = std::mem::take(&mut self.scratch.parts);
        self.psf.folding.fold(&self.centred, &mut parts);
        self.psf.transform::<R, FUSED>(&parts, &mut self.scratch);
        self.scratch.parts = parts;
        let four = T::from_f64(4.0);
        for (part, modes) in self.scratch.modes.0.iter().enumerate() {
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
        4 * self.stamp.folding.part()
    }

    /// What the square of each number of a folded stamp adds to the sum of the squares of its pixels.
    pub(super) fn weights(&self) -> Vec<f64> {
        self.stamp.folding.weights()
    }

    /// Folds a row-major stamp.
    #[inline(always)]
    pub(super) fn fold(&self, image: &[T], folded: &mut [T]) {
        self.stamp.folding.fold(image, folded);
    }

    /// Writes H times a row-major image, folded.
    #[inline(always)]
    pub(super) fn apply<const R: usize, const FUSED: bool>(
        &self,
        image: &[T],
        scratch: &mut Scratch<T>,
        folded: &mut [T],
    ) {
        self.stamp.folding.fold(image, folded);
        self.stamp.transform::<R, FUSED>(folded, scratch);
        filter::<T, FUSED>(&mut scratch.modes, &self.transfer);
        self.back.transform::<R, FUSED>(scratch, folded);
    }

    /// Writes Hᵀ times a folded image, row-major.
    #[inline(always)]
    pub(super) fn apply_transposed<const R: usize, const FUSED: bool>(
        &self,
        folded: &[T],
        scratch: &mut Scratch<T>,
        image: &mut [T],
    ) {
        self.stamp.transform::<R, FUSED>(folded, scratch);
        filter::<T, FUSED>(&mut scratch.modes, &self.turned);
        let mut parts = std::mem::take(&mut scratch.parts);
        self.back.transform::<R, FUSED>(scratch, &mut parts);
        self.back.folding.unfold(&parts, image);
        scratch.parts = parts;
    }
}
