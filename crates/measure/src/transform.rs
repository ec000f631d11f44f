//! Transforms of small images by products of real matrices.
//!
//! An image lies on a plane that is periodic along both axes. The plane's modes are kept up to the index `modes` along
//! each axis; modes with k_x ≥ 0 determine a real image. With s = −sin, its transform at (k_x, ±k_y) is
//!
//! ```text
//! Σ I exp(−i(k_x x ± k_y y)) = (cc ∓ ss) + i(sc ± cs)
//! ```
//!
//! where cc is the sum Σ I cos(k_x x) cos(k_y y), sc = Σ I s(k_x x) cos(k_y y), and so on: the first letter stands for x.
//! Places are measured from the middle of the image. Sums and differences of opposite pixels are even and odd about it, so that
//! each of the four sums runs over a quarter of the pixels.
//!
//! Pixels that are not square on the sky lie on a skewed lattice, T(x, y) = (a x + b y, y/a). Modes stay where they are, and
//!
//! ```text
//! Σ I exp(−i k·T(x, y)) = Σ_y exp(−i k_y y/a) [exp(−i k_x b y) Σ_x I exp(−i k_x a x)],
//! ```
//!
//! so that the sums along the axes have other tables, and a phase for each row and k_x is between them.
//!
//! Each sum along an axis is a dense product. Both methods keep 16 to 48 modes along an axis, for which products were three to
//! six times as fast as rustfft in `bench` of one machine: 0.9 µs against 5.4 µs for 23 px to 31 modes and back.
//!
//! # Turned pixels
//!
//! A triangular map of the lattice leaves the sums along the axes nearly separable; a rotation mixes the axes, so that each mode has
//! its own wave numbers p and q along both axes of the pixels, k·M(x, y) = p x + q y. Sums over rows are then made anew for
//! each mode, for LANES of them at a time: ten times the time of the dense products.

use multiversion::multiversion;
use shearq_quantities::PixelShape;
use shearq_quantities::linear::{LANES, Matrix, ROWS, multiply};

// Layout: one vector of AVX2.
const FOLDED_PIXELS: usize = 8;

/// A periodic plane and the modes that are kept of it.
#[derive(Debug, Clone)]
pub(crate) struct Plane {
    /// In pixels.
    pub(crate) period: usize,
    /// Largest index of a mode along an axis.
    pub(crate) modes: usize,
    /// Rows and columns of a quarter: `modes + 1`, filled up with zeros to what products need.
    pub(crate) rows: usize,
    pub(crate) width: usize,
}

impl Plane {
    pub(crate) fn new(period: usize, modes: usize) -> Self {
        Plane {
            period,
            modes,
            rows: (modes + 1).next_multiple_of(ROWS),
            width: (modes + 1).next_multiple_of(LANES),
        }
    }

    pub(crate) fn with_all_modes(period: usize) -> Self {
        Plane::new(period, period / 2)
    }

    pub(crate) fn quarter(&self) -> usize {
        self.rows * self.width
    }

    /// Wave number of index `j`, in radians per pixel.
    pub(crate) fn wave(&self, j: usize) -> f64 {
        std::f64::consts::TAU * j as f64 / self.period as f64
    }

    /// For how many modes along an axis, ±`j`, index `j` stands.
    pub(crate) fn count(&self, j: usize) -> f64 {
        // The highest mode of an even period is equal to its opposite.
        if j == 0 || 2 * j == self.period {
            1.0
        } else {
            2.0
        }
    }

    /// Place in [`Modes`] of the mode of indices (`x`, ±`y`), the lower sign if `below`.
    pub(crate) fn place(&self, x: usize, y: usize, below: bool) -> usize {
        usize::from(below) * self.quarter() + y * self.width + x
    }

    /// Indices (x, ±y) of the mode at place `at` of [`Modes`], and whether the lower sign holds.
    pub(crate) fn indices(&self, at: usize) -> (usize, usize, bool) {
        let (half, rest) = (at / self.quarter(), at % self.quarter());
        (rest % self.width, rest / self.width, half == 1)
    }

    pub(crate) fn spectrum(&self) -> Spectrum {
        Spectrum(vec![0.0; 4 * self.quarter()])
    }

    pub(crate) fn mode_by_mode(&self) -> Modes {
        Modes {
            re: vec![0.0; 2 * self.quarter()],
            im: vec![0.0; 2 * self.quarter()],
        }
    }
}

/// The spectrum of a real image by parity: the quarters cc, cs, sc and ss, with a row for each k_y.
#[derive(Debug, Clone)]
pub(crate) struct Spectrum(pub(crate) Vec<f32>);

impl Spectrum {
    // cc = ½[Re f(k_x, −k_y) + Re f(k_x, k_y)], and so on.
    pub(crate) fn take_modes(&mut self, Modes { re, im }: &Modes) {
        let [cc, cs, sc, ss] = self.quarters_mut();
        for at in 0..cc.len() {
            let below = at + cc.len();
            (cc[at], ss[at]) = (0.5 * (re[below] + re[at]), 0.5 * (re[below] - re[at]));
            (sc[at], cs[at]) = (0.5 * (im[at] + im[below]), 0.5 * (im[at] - im[below]));
        }
    }

    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.0.copy_from_slice(&other.0);
    }

    /// The sum of the image's pixels.
    pub(crate) fn sum(&self) -> f32 {
        self.0[0]
    }

    pub(crate) fn quarters(&self) -> [&[f32]; 4] {
        let (c, s) = self.0.split_at(self.0.len() / 2);
        let ((cc, cs), (sc, ss)) = (c.split_at(c.len() / 2), s.split_at(s.len() / 2));
        [cc, cs, sc, ss]
    }

    pub(crate) fn quarters_mut(&mut self) -> [&mut [f32]; 4] {
        four_parts(&mut self.0)
    }

    /// Multiplies by the spectrum of a kernel: a convolution of the images, whose middles are the origin.
    pub(crate) fn multiply(&mut self, kernel: &Spectrum) {
        products(self, kernel);
    }

    /// Writes |f|² of each mode, a real even spectrum.
    pub(crate) fn power(&self, out: &mut [f32]) {
        powers(self, out);
    }
}

/// The spectrum of a real image mode by mode: modes with k_y ≥ 0, and then with k_y ≤ 0, in rows of one |k_y|. Modes
/// without k_y are stored twice.
#[derive(Debug, Clone)]
pub(crate) struct Modes {
    pub(crate) re: Vec<f32>,
    pub(crate) im: Vec<f32>,
}

impl Modes {
    pub(crate) fn take_spectrum(&mut self, spectrum: &Spectrum) {
        modes_of(spectrum, &mut self.re, &mut self.im);
    }

    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.re.copy_from_slice(&other.re);
        self.im.copy_from_slice(&other.im);
    }
}

fn four_parts(values: &mut [f32]) -> [&mut [f32]; 4] {
    let (c, s) = values.split_at_mut(values.len() / 2);
    let (cc, cs) = c.split_at_mut(c.len() / 2);
    let (sc, ss) = s.split_at_mut(s.len() / 2);
    [cc, cs, sc, ss]
}

// f(k_x, ±k_y) = (cc ∓ ss) + i(sc ± cs).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn modes_of(spectrum: &Spectrum, re: &mut [f32], im: &mut [f32]) {
    let [cc, cs, sc, ss] = spectrum.quarters();
    let (re_above, re_below) = re.split_at_mut(cc.len());
    let (im_above, im_below) = im.split_at_mut(cc.len());
    sums_and_differences(ss, cc, re_below, re_above);
    sums_and_differences(cs, sc, im_above, im_below);
}

/// Writes the parities cc and ss of a real even spectrum, whose other parities are zero, from its modes.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn even_parities(modes: &[f32], out: &mut [f32]) {
    let (above, below) = modes.split_at(modes.len() / 2);
    let (cc, ss) = out.split_at_mut(above.len());
    half_sums_and_differences(below, above, cc, ss);
}

// Writes b + a and b − a.
#[inline(always)]
fn sums_and_differences(a: &[f32], b: &[f32], sums: &mut [f32], differences: &mut [f32]) {
    let out = sums.iter_mut().zip(differences);
    for ((sum, difference), (a, b)) in out.zip(a.iter().zip(b)) {
        (*sum, *difference) = (b + a, b - a);
    }
}

#[inline(always)]
fn half_sums_and_differences(a: &[f32], b: &[f32], sums: &mut [f32], differences: &mut [f32]) {
    let out = sums.iter_mut().zip(differences);
    for ((sum, difference), (a, b)) in out.zip(a.iter().zip(b)) {
        (*sum, *difference) = (0.5 * (a + b), 0.5 * (a - b));
    }
}

// The product of two numbers (cc ∓ ss) + i(sc ± cs), sorted by parity: four terms for each quarter. Real and imaginary parts of
// modes above and below would need the same number of products, and conversions in addition.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn products(spectrum: &mut Spectrum, kernel: &Spectrum) {
    for at in (0..spectrum.0.len() / 4).step_by(LANES) {
        let mut out = [[0.0f32; LANES]; 4];
        {
            let [cc, cs, sc, ss] = four_lanes(spectrum.quarters(), at);
            let [kcc, kcs, ksc, kss] = four_lanes(kernel.quarters(), at);
            for l in 0..LANES {
                out[0][l] = (cc[l] * kcc[l] + ss[l] * kss[l]) - (sc[l] * ksc[l] + cs[l] * kcs[l]);
                out[1][l] = (cc[l] * kcs[l] + cs[l] * kcc[l]) - (ss[l] * ksc[l] + sc[l] * kss[l]);
                out[2][l] = (cc[l] * ksc[l] + sc[l] * kcc[l]) - (ss[l] * kcs[l] + cs[l] * kss[l]);
                out[3][l] = (cc[l] * kss[l] + ss[l] * kcc[l]) + (sc[l] * kcs[l] + cs[l] * ksc[l]);
            }
        }
        store(spectrum.quarters_mut(), at, out);
    }
}

// |f(k_x, ±k_y)|² = even ∓ odd.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn powers(spectrum: &Spectrum, out: &mut [f32]) {
    let quarters = spectrum.quarters();
    let (even, odd) = out.split_at_mut(quarters[0].len());
    for at in (0..quarters[0].len()).step_by(LANES) {
        let [cc, cs, sc, ss] = four_lanes(quarters, at);
        let mut out = [[0.0f32; LANES]; 2];
        for l in 0..LANES {
            out[0][l] = (cc[l] * cc[l] + ss[l] * ss[l]) + (sc[l] * sc[l] + cs[l] * cs[l]);
            out[1][l] = 2.0 * (cc[l] * ss[l] - sc[l] * cs[l]);
        }
        store([&mut *even, &mut *odd], at, out);
    }
}

#[inline(always)]
pub(crate) fn lanes(values: &[f32], at: usize) -> &[f32; LANES] {
    values[at..].first_chunk().expect("quarters of whole lanes")
}

#[inline(always)]
pub(crate) fn four_lanes([cc, cs, sc, ss]: [&[f32]; 4], at: usize) -> [&[f32; LANES]; 4] {
    [lanes(cc, at), lanes(cs, at), lanes(sc, at), lanes(ss, at)]
}

/// Stores lanes together: the compiler cannot prove that results and operands do not overlap in memory, and would not use
/// vectors.
#[inline(always)]
pub(crate) fn store<const N: usize>(to: [&mut [f32]; N], at: usize, values: [[f32; LANES]; N]) {
    for (to, values) in to.into_iter().zip(values) {
        to[at..][..LANES].copy_from_slice(&values);
    }
}

/// A table of `value` at rows and columns, in rows of `width` numbers. Zeros fill it up to `all_rows`.
pub(crate) fn table(
    [rows, columns]: [usize; 2],
    [all_rows, width]: [usize; 2],
    value: impl Fn(usize, usize) -> f64,
) -> Vec<f32> {
    let mut table = vec![0.0; all_rows * width];
    for row in 0..rows {
        for column in 0..columns {
            table[row * width + column] = value(row, column) as f32;
        }
    }
    table
}

/// Images of n×n pixels, folded about their middle along both axes.
///
/// A folded image has four parts: sums along x of opposite pixels, of sums and then of differences along y; and differences
/// along x, of the same. A part has the places from the middle on; the middle pixel of an odd number is the first, and is added
/// to itself.
#[derive(Debug, Clone, Copy)]
struct Folding {
    n: usize,
    /// Places along an axis.
    half: usize,
    /// Numbers in a row: the places, filled up for products.
    stride: usize,
    /// Rows of a part: the places, filled up so that two parts are a multiple of [`ROWS`].
    band: usize,
}

impl Folding {
    fn new(n: usize) -> Self {
        let half = n.div_ceil(2);
        Folding {
            n,
            half,
            stride: half.next_multiple_of(LANES),
            band: half.next_multiple_of(ROWS / 2),
        }
    }

    // Numbers in a folded image.
    fn len(&self) -> usize {
        4 * self.band * self.stride
    }

    // Pixels from the middle to a place.
    fn distance(&self, place: usize) -> f64 {
        let middle = if self.n.is_multiple_of(2) { 0.5 } else { 0.0 };
        place as f64 + middle
    }

    // The share of a place along one axis: folding adds the middle pixel to itself.
    fn share(&self, place: usize) -> f64 {
        if self.distance(place) == 0.0 {
            0.5
        } else {
            1.0
        }
    }

    #[inline(always)]
    fn fold_by<const K: usize>(&self, image: &[f32], folded: &mut [f32]) {
        let Folding { n, half, .. } = *self;
        let mut parts = four_parts(folded);
        for y in 0..half {
            let upper = &image[(n / 2 + y) * n..][..n];
            let lower = &image[(half - 1 - y) * n..][..n];
            for first in (0..half).step_by(K) {
                // The last ones overlap where there are too few.
                let x = first.min(half - K);
                let (right, left) = (n / 2 + x, half - K - x);
                let (upper_right, lower_right) = (run::<K>(upper, right), run::<K>(lower, right));
                let (upper_left, lower_left) = (run::<K>(upper, left), run::<K>(lower, left));
                let mut out = [[0.0f32; K]; 4];
                for k in 0..K {
                    let (upper_left, lower_left) = (upper_left[K - 1 - k], lower_left[K - 1 - k]);
                    let sums = (upper_right[k] + lower_right[k], upper_left + lower_left);
                    let differences = (upper_right[k] - lower_right[k], upper_left - lower_left);
                    out[0][k] = sums.0 + sums.1;
                    out[1][k] = differences.0 + differences.1;
                    out[2][k] = sums.0 - sums.1;
                    out[3][k] = differences.0 - differences.1;
                }
                for (part, out) in parts.iter_mut().zip(out) {
                    part[y * self.stride + x..][..K].copy_from_slice(&out);
                }
            }
        }
    }

    #[inline(always)]
    fn unfold_by<const K: usize>(&self, folded: &[f32], image: &mut [f32]) {
        let Folding { n, half, .. } = *self;
        let part = |k: usize| &folded[k * self.band * self.stride..];
        let parts = [part(0), part(1), part(2), part(3)];
        for y in 0..half {
            let (above, below) = ((n / 2 + y) * n, (half - 1 - y) * n);
            for first in (0..half).step_by(K) {
                let x = first.min(half - K);
                let (right, left) = (n / 2 + x, half - K - x);
                let [ee, eo, oe, oo] = parts.map(|part| run::<K>(part, y * self.stride + x));
                // Upper right, upper left, lower right, lower left.
                let mut out = [[0.0f32; K]; 4];
                for k in 0..K {
                    let (even, odd) = (ee[k] + eo[k], oe[k] + oo[k]);
                    let (even_below, odd_below) = (ee[k] - eo[k], oe[k] - oo[k]);
                    out[0][k] = even + odd;
                    out[1][K - 1 - k] = even - odd;
                    out[2][k] = even_below + odd_below;
                    out[3][K - 1 - k] = even_below - odd_below;
                }
                let places = [above + right, above + left, below + right, below + left];
                for (place, out) in places.into_iter().zip(out) {
                    image[place..][..K].copy_from_slice(&out);
                }
            }
        }
    }
}

// A reference to an array has a constant length, so that the compiler uses one vector.
#[inline(always)]
fn run<const K: usize>(values: &[f32], first: usize) -> &[f32; K] {
    values[first..].first_chunk().expect("pixels of a row")
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn fold(folding: &Folding, image: &[f32], folded: &mut [f32]) {
    if folding.half < FOLDED_PIXELS {
        folding.fold_by::<1>(image, folded);
    } else {
        folding.fold_by::<FOLDED_PIXELS>(image, folded);
    }
}

// The image whose parts, even or odd along each axis, are given: unfolding a folded image multiplies it by four.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn unfold(folding: &Folding, folded: &[f32], image: &mut [f32]) {
    if folding.half < FOLDED_PIXELS {
        folding.unfold_by::<1>(folded, image);
    } else {
        folding.unfold_by::<FOLDED_PIXELS>(folded, image);
    }
}

/// From the pixels of n×n images to their modes.
#[derive(Debug, Clone)]
pub(crate) struct ToModes {
    folding: Folding,
    width: usize,
    /// Columns of `across`: `width`, or twice that with moments.
    columns: usize,
    /// By place and mode along x: cos and, with moments, x·s for sums of opposite pixels; s and x·cos for differences.
    across: [Vec<f32>; 2],
    /// By mode and place along y: cos and s, and with moments y·cos and y·s.
    down: Vec<Vec<f32>>,
    /// What is between the sums if pixels are not square.
    skew: Option<Box<Skew>>,
}

/// The phases k_x b y of a skewed lattice of pixels.
#[derive(Debug, Clone)]
struct Skew {
    shape: PixelShape,
    /// cos and sin by place along y and mode along x.
    phases: [Vec<f32>; 2],
    /// Waves on their way through a table, and their steps.
    waves: Waves,
}

/// Numbers exp(iφ) that advance by steps, side by side.
#[derive(Debug, Clone)]
struct Waves {
    at: [Vec<f64>; 2],
    step: [Vec<f64>; 2],
}

impl Waves {
    fn new(most: usize) -> Self {
        let zeros = || [vec![0.0; most], vec![0.0; most]];
        Waves {
            at: zeros(),
            step: zeros(),
        }
    }

    // Starts `count` waves: number j at j·`first`, advancing by j·`step`; for `halves`, at (j + ½)·`first`, by (j + ½)·`step`.
    fn start(&mut self, count: usize, halves: bool, first: f64, step: f64) {
        for (out, angle) in [(&mut self.at, first), (&mut self.step, step)] {
            let (by_im, by_re) = angle.sin_cos();
            // In double precision a recurrence loses nothing that single precision shows.
            let (mut im, mut re) = if halves {
                (0.5 * angle).sin_cos()
            } else {
                (0.0, 1.0)
            };
            let [out_re, out_im] = out;
            for (out_re, out_im) in out_re[..count].iter_mut().zip(&mut out_im[..count]) {
                (*out_re, *out_im) = (re, im);
                (re, im) = (re * by_re - im * by_im, re * by_im + im * by_re);
            }
        }
    }
}

// Writes cos and −sin of waves, in single precision, and advances the waves.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn take_waves(waves: &mut Waves, cos: &mut [f32], s: &mut [f32]) {
    let [re, im] = &mut waves.at;
    let [by_re, by_im] = &waves.step;
    let at = re.iter_mut().zip(im).zip(by_re.iter().zip(by_im));
    for (((re, im), (by_re, by_im)), (cos, s)) in at.zip(cos.iter_mut().zip(s)) {
        (*cos, *s) = (*re as f32, -*im as f32);
        (*re, *im) = (*re * by_re - *im * by_im, *re * by_im + *im * by_re);
    }
}

/// Buffers for one thread. Their content between calls does not matter, but for the zeros that fill up `folded`.
#[derive(Debug, Clone)]
pub(crate) struct TransformScratch {
    pub(crate) folded: Vec<f32>,
    /// The same transformed along x.
    pub(crate) lines: Vec<f32>,
}

impl ToModes {
    /// For images of n×n pixels; with `moments` also for transforms of the image times x and times y.
    pub(crate) fn new(n: usize, plane: &Plane, moments: bool) -> Self {
        let folding = Folding::new(n);
        let Folding { half, stride, .. } = folding;
        let (modes, width) = (plane.modes, plane.width);
        let at = |place: usize| folding.distance(place);
        let cos = |k: usize, place: usize| folding.share(place) * (plane.wave(k) * at(place)).cos();
        let s = |k: usize, place: usize| -(plane.wave(k) * at(place)).sin();
        let waves: [&dyn Fn(usize, usize) -> f64; 2] = [&cos, &s];
        let columns = if moments { 2 * width } else { width };
        let across = [0, 1].map(|parity| {
            table([half, columns], [half, columns], |place, column| {
                match (column / width, column % width) {
                    (_, k) if k > modes => 0.0,
                    (0, k) => waves[parity](k, place),
                    (_, k) => at(place) * waves[1 - parity](k, place),
                }
            })
        });
        // Sums along x are shared: the transform times y differs along y alone.
        let down = |wave: &dyn Fn(usize, usize) -> f64| {
            table([modes + 1, half], [plane.rows, stride], wave)
        };
        let mut down = vec![down(&cos), down(&s)];
        if moments {
            for wave in waves {
                let moment = |k: usize, place: usize| at(place) * wave(k, place);
                down.push(table([modes + 1, half], [plane.rows, stride], moment));
            }
        }
        ToModes {
            folding,
            width,
            columns,
            across,
            down,
            skew: None,
        }
    }

    /// Sets the tables for pixels of this shape. It allocates the first time only.
    pub(crate) fn set_pixel_shape(&mut self, plane: &Plane, shape: PixelShape) {
        let (folding, width, columns) = (self.folding, self.width, self.columns);
        let Folding { half, stride, .. } = folding;
        let modes = plane.modes + 1;
        let Skew {
            shape: of,
            phases,
            waves,
        } = &mut **self.skew.get_or_insert_with(|| {
            let phases = || vec![0.0; half * width];
            Box::new(Skew {
                shape,
                phases: [phases(), phases()],
                waves: Waves::new(half.max(modes)),
            })
        });
        *of = shape;
        let (unit, offset) = (plane.wave(1), folding.distance(0));
        let PixelShape { stretch, skew } = shape;
        // Waves are the modes, which advance from place to place.
        waves.start(modes, false, unit * stretch * offset, unit * stretch);
        let [even, odd] = &mut self.across;
        let rows = even
            .chunks_exact_mut(columns)
            .zip(odd.chunks_exact_mut(columns));
        for (place, (even, odd)) in rows.enumerate() {
            take_waves(waves, &mut even[..modes], &mut odd[..modes]);
            if columns > width {
                let x = (stretch * folding.distance(place)) as f32;
                for k in 0..modes {
                    (even[width + k], odd[width + k]) = (x * odd[k], x * even[k]);
                }
            }
            let share = folding.share(place) as f32;
            even[..modes].iter_mut().for_each(|value| *value *= share);
        }
        waves.start(modes, false, unit * skew * offset, unit * skew);
        let [cos, sin] = phases;
        for (cos, sin) in cos.chunks_exact_mut(width).zip(sin.chunks_exact_mut(width)) {
            take_waves(waves, &mut cos[..modes], &mut sin[..modes]);
            sin.iter_mut().for_each(|sin| *sin = -*sin);
        }
        // Waves are the places, which advance from mode to mode.
        waves.start(half, offset > 0.0, 0.0, unit / stretch);
        let mut tables = self.down.iter_mut();
        let mut rows = || tables.next().map(|table| table.chunks_exact_mut(stride));
        let (Some(cos), Some(s)) = (rows(), rows()) else {
            return;
        };
        let (mut y_cos, mut y_s) = (rows(), rows());
        let middle = folding.share(0) as f32;
        for (cos, s) in cos.zip(s).take(modes) {
            take_waves(waves, &mut cos[..half], &mut s[..half]);
            let moments = y_cos.as_mut().zip(y_s.as_mut());
            if let Some((y_cos, y_s)) = moments.and_then(|(cos, s)| cos.next().zip(s.next())) {
                for place in 0..half {
                    let y = (folding.distance(place) / stretch) as f32;
                    (y_cos[place], y_s[place]) = (y * cos[place], y * s[place]);
                }
            }
            cos[0] *= middle;
        }
    }

    pub(crate) fn side(&self) -> usize {
        self.folding.n
    }

    pub(crate) fn scratch(&self) -> TransformScratch {
        TransformScratch {
            folded: vec![0.0; self.folding.len()],
            lines: vec![0.0; 4 * self.folding.band * self.columns],
        }
    }

    pub(crate) fn transform(
        &self,
        image: &[f32],
        scratch: &mut TransformScratch,
        out: &mut Spectrum,
    ) {
        let TransformScratch { folded, lines } = scratch;
        fold(&self.folding, image, folded);
        self.across(folded, lines);
        self.turn(lines);
        for (at, quarter) in out.quarters_mut().into_iter().enumerate() {
            let (x, y) = (at / 2, at % 2);
            self.down(y, [x, y, 0], lines, quarter);
        }
    }

    /// The transforms of a row-major image, and of it times x and y from its middle, in the coordinates of
    /// [`PixelShape::map`].
    pub(crate) fn transform_moments(
        &self,
        image: &[f32],
        scratch: &mut TransformScratch,
        out: &mut [Spectrum; 3],
    ) {
        let [plain, times_x, times_y] = out;
        self.transform(image, scratch, plain);
        let moments = times_x
            .quarters_mut()
            .into_iter()
            .zip(times_y.quarters_mut());
        for (at, (times_x, times_y)) in moments.enumerate() {
            // Times x, what was even along x is odd.
            let (x, y) = (at / 2, at % 2);
            self.down(y, [1 - x, y, 1], &scratch.lines, times_x);
            self.down(2 + y, [x, 1 - y, 0], &scratch.lines, times_y);
            if let Some(skew) = &self.skew {
                // Beyond the stretched x, a row is shifted by its skew.
                let PixelShape { stretch, skew } = skew.shape;
                add_scaled(times_y, (stretch * skew) as f32, times_x);
            }
        }
    }

    // Multiplies lines of sums along x by exp(−i k_x b y), if pixels are not square.
    fn turn(&self, lines: &mut [f32]) {
        let Some(skew) = &self.skew else { return };
        let (width, columns) = (self.width, self.columns);
        let [cos, sin] = &skew.phases;
        let [even, even_odd, odd_even, odd] = four_parts(lines);
        let mut parts = [even, even_odd, odd_even, odd].map(|part| part.chunks_exact_mut(columns));
        for (cos, sin) in cos.chunks_exact(width).zip(sin.chunks_exact(width)) {
            let [Some(ee), Some(eo), Some(oe), Some(oo)] = parts.each_mut().map(Iterator::next)
            else {
                return;
            };
            // Sums of pixels at opposite x are the real part C, differences the imaginary part S; even and odd along y
            // C(±y) = ½(C_e ± C_o). A phase at opposite y is conjugate, so that it mixes C_e with S_o and C_o with S_e. Times x,
            // sums are the imaginary part.
            let ((ee, x_ee), (eo, x_eo)) = (ee.split_at_mut(width), eo.split_at_mut(width));
            let ((oe, x_oe), (oo, x_oo)) = (oe.split_at_mut(width), oo.split_at_mut(width));
            turn_pair(ee, oo, cos, sin);
            turn_pair(eo, oe, cos, sin);
            turn_pair(x_oe, x_eo, cos, sin);
            turn_pair(x_oo, x_ee, cos, sin);
        }
    }

    // Sums along x.
    fn across(&self, folded: &[f32], lines: &mut [f32]) {
        let Folding {
            half, stride, band, ..
        } = self.folding;
        let lines = lines.chunks_exact_mut(2 * band * self.columns);
        let halves = folded.chunks_exact(self.folding.len() / 2);
        for ((lines, folded), table) in lines.zip(halves).zip(&self.across) {
            let folded = Matrix::new(folded, stride);
            let table = Matrix::new(table, self.columns);
            multiply(folded, table, half, lines, self.columns);
        }
    }

    // Sums along y with one of the tables, of lines that are sums (0) or differences (1) along x and along y, plain (0) or
    // times x (1).
    fn down(&self, table: usize, [x, y, moment]: [usize; 3], lines: &[f32], out: &mut [f32]) {
        let Folding {
            half, stride, band, ..
        } = self.folding;
        let first = (2 * x + y) * band * self.columns + moment * self.width;
        let lines = Matrix::new(&lines[first..], self.columns);
        let table = Matrix::new(&self.down[table], stride);
        multiply(table, lines, half, out, self.width);
    }

    /// The transform of two edges of the stamp along y, whose values are `first` at x = −n/2 and `last` at x = n/2. `cos` and
    /// `sin` are of the phase of each mode along x at the first edge.
    pub(crate) fn transform_sides(
        &self,
        [first, last]: [&[f32]; 2],
        [cos, sin]: [&[f32]; 2],
        scratch: &mut TransformScratch,
        out: &mut Spectrum,
    ) {
        let Folding { n, half, .. } = self.folding;
        let (width, columns) = (self.width, self.columns);
        let [ee, eo, oe, oo] = four_parts(&mut scratch.lines);
        for place in 0..half {
            let (upper, lower) = (n / 2 + place, half - 1 - place);
            let folded = |side: &[f32]| [side[upper] + side[lower], side[upper] - side[lower]];
            let ([first_even, first_odd], [last_even, last_odd]) = (folded(first), folded(last));
            let row = place * columns..place * columns + width;
            // a·exp(iφ) + b·exp(−iφ) = (a + b) cos φ + i(a − b) sin φ.
            let waves = cos.iter().zip(sin);
            let parts = ee[row.clone()].iter_mut().zip(&mut eo[row.clone()]);
            let parts = parts.zip(oe[row.clone()].iter_mut().zip(&mut oo[row]));
            for (((ee, eo), (oe, oo)), (cos, sin)) in parts.zip(waves) {
                (*ee, *eo) = ((first_even + last_even) * cos, (first_odd + last_odd) * cos);
                (*oe, *oo) = ((first_even - last_even) * sin, (first_odd - last_odd) * sin);
            }
        }
        self.turn(&mut scratch.lines);
        for (at, quarter) in out.quarters_mut().into_iter().enumerate() {
            let (x, y) = (at / 2, at % 2);
            self.down(y, [x, y, 0], &scratch.lines, quarter);
        }
    }

    /// Transforms of [`ROWS`] lines of n real numbers: real and imaginary parts, in rows of the plane's width.
    pub(crate) fn transform_lines(
        &self,
        lines: &[f32],
        scratch: &mut TransformScratch,
        out: [&mut [f32]; 2],
    ) {
        let Folding {
            n, half, stride, ..
        } = self.folding;
        // There is room for them: two parts have at least eight rows.
        let (sums, differences) = scratch.folded.split_at_mut(self.folding.len() / 2);
        let rows = sums.chunks_exact_mut(stride);
        let rows = rows.zip(differences.chunks_exact_mut(stride));
        for (line, (sums, differences)) in lines.chunks_exact(n).zip(rows) {
            let (left, right) = (&line[..half], &line[n - half..]);
            for x in 0..half {
                sums[x] = right[x] + left[half - 1 - x];
                differences[x] = right[x] - left[half - 1 - x];
            }
        }
        for ((folded, table), out) in [&*sums, differences].into_iter().zip(&self.across).zip(out) {
            let folded = Matrix::new(folded, stride);
            let table = Matrix::new(table, self.columns);
            multiply(folded, table, half, out, self.width);
        }
    }
}

// Multiplies a real part a and an imaginary part b, of opposite parity along y, by exp(−iφ).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn turn_pair(a: &mut [f32], b: &mut [f32], cos: &[f32], sin: &[f32]) {
    let pairs = a.iter_mut().zip(b);
    for ((a, b), (cos, sin)) in pairs.zip(cos.iter().zip(sin)) {
        (*a, *b) = (cos * *a + sin * *b, cos * *b - sin * *a);
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_scaled(values: &[f32], factor: f32, out: &mut [f32]) {
    for (out, value) in out.iter_mut().zip(values) {
        *out += factor * value;
    }
}

/// From modes back to pixels.
#[derive(Debug, Clone)]
pub(crate) struct ToPixels {
    folding: Folding,
    width: usize,
    /// Modes along an axis.
    modes: usize,
    /// Places along y, filled up for products.
    padded: usize,
    /// By place and mode along y: cos and s, times how many modes each stands for.
    down: [Vec<f32>; 2],
    /// By mode and place along x, the same.
    across: [Vec<f32>; 2],
}

impl ToPixels {
    pub(crate) fn new(n: usize, plane: &Plane) -> Self {
        let folding = Folding::new(n);
        let (half, modes) = (folding.half, plane.modes + 1);
        let padded = half.next_multiple_of(ROWS);
        // A mode stands for its opposite, too, which is its conjugate: sums over half of the plane are real.
        let wave = |parity: usize, k: usize, place: usize| {
            let angle = plane.wave(k) * folding.distance(place);
            let wave = if parity == 0 {
                angle.cos()
            } else {
                -angle.sin()
            };
            wave * plane.count(k) / plane.period as f64
        };
        ToPixels {
            folding,
            width: plane.width,
            modes,
            padded,
            down: [0, 1].map(|parity| {
                table([half, modes], [padded, plane.width], |place, k| {
                    wave(parity, k, place)
                })
            }),
            across: [0, 1].map(|parity| {
                table([modes, half], [modes, folding.stride], |k, place| {
                    wave(parity, k, place)
                })
            }),
        }
    }

    /// For transforms to pixels, and of images without moments to modes.
    pub(crate) fn scratch(&self) -> TransformScratch {
        TransformScratch {
            folded: vec![0.0; self.folding.len()],
            lines: vec![0.0; (4 * self.folding.band + ROWS) * self.width],
        }
    }

    pub(crate) fn transform(
        &self,
        spectrum: &Spectrum,
        scratch: &mut TransformScratch,
        image: &mut [f32],
    ) {
        let TransformScratch { folded, lines } = scratch;
        let (width, Folding { stride, band, .. }) = (self.width, self.folding);
        for (part, quarter) in spectrum.quarters().into_iter().enumerate() {
            let down = Matrix::new(&self.down[part % 2], width);
            // The next part overwrites rows beyond `band`; those of the last part are not used.
            let lines = &mut lines[part * band * width..][..self.padded * width];
            multiply(down, Matrix::new(quarter, width), self.modes, lines, width);
        }
        let halves = folded.chunks_exact_mut(self.folding.len() / 2);
        for ((x, folded), across) in halves.enumerate().zip(&self.across) {
            let lines = Matrix::new(&lines[2 * x * band * width..], width);
            let across = Matrix::new(across, stride);
            multiply(lines, across, self.modes, folded, stride);
        }
        unfold(&self.folding, folded, image);
    }
}

/// Lags on a hexagonal lattice: rows along x; every second row is shifted by half a step.
///
/// It is the same after rotations by 60 degrees. Sums over it, and the circle that ends it, cannot prefer an axis to the
/// diagonal between axes, as on a square lattice, where the response of e1 is 1 to 6 % larger than the response of e2 for small galaxies.
/// It also has 13 % fewer places for the same distance to the nearest alias.
#[derive(Debug, Clone, Copy)]
pub struct HexLattice {
    /// Pixels between rows.
    pub row_spacing: f64,
    /// Number of the last row, and radius of the circle of the lags that are used in rows.
    pub reach: usize,
}

impl HexLattice {
    /// Pixels between the lags of a row.
    pub fn spacing(self) -> f64 {
        self.row_spacing * 2.0 / 3f64.sqrt()
    }

    /// Largest whole number of steps along x within the circle.
    fn columns(self) -> usize {
        (self.radius() / self.spacing()) as usize
    }

    /// Lags in a row.
    pub fn width(self) -> usize {
        2 * self.columns() + 2
    }

    // Lags in half the plane.
    #[cfg(test)]
    pub(crate) fn count(self) -> usize {
        (self.reach + 1) * self.width()
    }

    /// Area in px² of a lag.
    pub fn area(self) -> f64 {
        self.row_spacing * self.spacing()
    }

    /// Where a row has x = 0, in lags.
    pub fn middle(self, row: usize) -> f64 {
        (2 * self.columns() + row % 2) as f64 / 2.0
    }

    /// Places (x, y) of the lags in px, row by row.
    pub fn places(self) -> impl Iterator<Item = [f64; 2]> {
        (0..=self.reach).flat_map(move |row| {
            (0..self.width()).map(move |at| {
                let x = (at as f64 - self.middle(row)) * self.spacing();
                [x, row as f64 * self.row_spacing]
            })
        })
    }

    /// Largest lag that is used, in px.
    pub fn radius(self) -> f64 {
        self.reach as f64 * self.row_spacing
    }

    /// Whether a lag is within the circle.
    pub fn contains(self, [x, y]: [f64; 2]) -> bool {
        x.hypot(y) <= self.radius() * (1.0 + 1e-12)
    }

    /// For how many lags of the plane within the circle a place stands: rows y > 0 for both signs.
    pub(crate) fn multiplicity(self, place @ [_, y]: [f64; 2]) -> f64 {
        match self.contains(place) {
            false => 0.0,
            true if y == 0.0 => 1.0,
            true => 2.0,
        }
    }
}

/// From real even spectra, given as cc and ss, to lags of autocorrelations, and the adjoint.
///
/// Lags are sums over modes along y, and then along x.
#[derive(Debug, Clone)]
pub(crate) struct ToLags {
    /// Lags in a row, and those from zero or half a step on. The last may be beyond them, and is zero.
    row: usize,
    count: usize,
    modes: usize,
    rows: usize,
    width: usize,
    /// Columns of lags from zero, filled up.
    lag_width: usize,
    /// Columns of `down_back`: stored rows of lags, filled up.
    down_width: usize,
    /// cos and sin by stored row of lags and mode: a mode stands for its opposite.
    down: [Vec<f32>; 2],
    /// The adjoint, by mode and stored row of lags, which stands for its opposite.
    down_back: [Vec<f32>; 2],
    groups: Vec<LagRows>,
}

/// Rows whose lags have the same places along x.
#[derive(Debug, Clone)]
struct LagRows {
    /// Number of each row along y.
    rows: Vec<usize>,
    /// Stored rows before these, and of these, filled up.
    first: usize,
    stored: usize,
    /// Whether the first lag is at zero, and not half a step from it.
    from_zero: bool,
    /// cos and sin by mode and lag along x: a mode stands for its opposite. And the adjoint, by lag and mode.
    across: [Vec<f32>; 2],
    across_back: [Vec<f32>; 2],
}

/// Buffers for one thread.
#[derive(Debug, Clone)]
pub(crate) struct LagsScratch {
    /// Halfway between modes and lags.
    between: Vec<f32>,
    /// Lags from zero, of both parities.
    lags: [Vec<f32>; 2],
}

impl ToLags {
    /// For lags up to `reach` steps along an axis, `steps` of them per period; `scale` multiplies the sums over modes.
    pub(crate) fn new(reach: usize, steps: usize, plane: &Plane, scale: f64) -> Self {
        let all = vec![((0..=reach).collect(), true)];
        let (row, steps) = (2 * reach + 1, [steps as f64; 2]);
        Self::of_groups(all, [row, reach + 1], steps, plane, scale)
    }

    /// For the lags of a lattice, of whose rows a period has `steps`.
    pub(crate) fn hexagonal(lattice: HexLattice, steps: usize, plane: &Plane) -> Self {
        let rows = |first: usize| (first..=lattice.reach).step_by(2).collect();
        let groups = vec![(rows(0), true), (rows(1), false)];
        let lags = [lattice.width(), lattice.columns() + 1];
        let along_x = steps as f64 * lattice.row_spacing / lattice.spacing();
        Self::of_groups(groups, lags, [along_x, steps as f64], plane, 1.0)
    }

    // Of each group: the rows, and whether they have a lag at zero.
    fn of_groups(
        groups: Vec<(Vec<usize>, bool)>,
        [row, count]: [usize; 2],
        steps: [f64; 2],
        plane: &Plane,
        scale: f64,
    ) -> Self {
        let [unit_x, unit_y] = steps.map(|steps| std::f64::consts::TAU / steps);
        let modes = plane.modes + 1;
        // A spectrum that is the same at opposite modes has an even image: Σ P cos(k_x dx + k_y dy). Its part
        // cc has the products of cosines, and ss the products of sines.
        let wave = |parity: usize, angle: f64| {
            if parity == 0 {
                angle.cos()
            } else {
                angle.sin()
            }
        };
        let tables = |used, stored, value: &dyn Fn(usize, usize, usize) -> f64| {
            [0, 1].map(|parity| table(used, stored, |a, b| value(parity, a, b)))
        };
        let lag_width = (row - count + 1).next_multiple_of(LANES);
        let mut stored_rows: Vec<Option<usize>> = Vec::new();
        let mut found = Vec::new();
        for (rows, from_zero) in groups {
            let start = if from_zero { 0.0 } else { 0.5 };
            let first = stored_rows.len();
            stored_rows.extend(rows.iter().map(|&row| Some(row)));
            stored_rows.resize(stored_rows.len().next_multiple_of(ROWS), None);
            let place = |lag: usize, mode: usize| unit_x * (lag as f64 + start) * mode as f64;
            found.push(LagRows {
                first,
                stored: stored_rows.len() - first,
                rows,
                from_zero,
                across: tables([modes, count], [modes, lag_width], &|parity, mode, lag| {
                    scale * (plane.count(mode) * wave(parity, place(lag, mode)))
                }),
                across_back: tables(
                    [count, modes],
                    [count, plane.width],
                    &|parity, lag, mode| scale * wave(parity, place(lag, mode)),
                ),
            });
        }
        let lag_rows = stored_rows.len();
        let down_width = lag_rows.next_multiple_of(LANES);
        let both_signs = |lag: usize| if lag == 0 { 1.0 } else { 2.0 };
        let angle = |lag: usize, mode: usize| unit_y * (lag * mode) as f64;
        ToLags {
            row,
            count,
            modes,
            rows: plane.rows,
            width: plane.width,
            lag_width,
            down_width,
            down: tables(
                [lag_rows, modes],
                [lag_rows, plane.width],
                &|parity, at, mode| {
                    stored_rows[at].map_or(0.0, |lag| {
                        plane.count(mode) * wave(parity, angle(lag, mode))
                    })
                },
            ),
            down_back: tables(
                [modes, lag_rows],
                [plane.rows, down_width],
                &|parity, mode, at| {
                    stored_rows[at]
                        .map_or(0.0, |lag| both_signs(lag) * wave(parity, angle(lag, mode)))
                },
            ),
            groups: found,
        }
    }

    pub(crate) fn scratch(&self) -> LagsScratch {
        let stored = self.groups.iter().map(|group| group.stored).sum::<usize>();
        let (rows, width) = (self.rows.max(stored), self.width.max(self.lag_width));
        LagsScratch {
            between: vec![0.0; rows * width],
            lags: [0, 1].map(|_| vec![0.0; stored * self.lag_width]),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.row
            * self
                .groups
                .iter()
                .map(|group| group.rows.len())
                .sum::<usize>()
    }

    /// The image of a spectrum at the lags.
    pub(crate) fn lags(&self, spectrum: &[f32], scratch: &mut LagsScratch, out: &mut [f32]) {
        let (modes, width, lag_width) = (self.modes, self.width, self.lag_width);
        let quarters = spectrum.chunks_exact(self.rows * width);
        for (parity, (quarter, lags)) in quarters.zip(&mut scratch.lags).enumerate() {
            let between = &mut scratch.between[..self.down[parity].len()];
            let down = Matrix::new(&self.down[parity], width);
            multiply(down, Matrix::new(quarter, width), modes, between, width);
            for group in &self.groups {
                let across = Matrix::new(&group.across[parity], lag_width);
                let between = Matrix::new(&between[group.first * width..], width);
                let lags = &mut lags[group.first * lag_width..][..group.stored * lag_width];
                multiply(between, across, modes, lags, lag_width);
            }
        }
        let [even, odd] = &scratch.lags;
        for group in &self.groups {
            let skip = usize::from(group.from_zero);
            for (stored, &dy) in (group.first..).zip(&group.rows) {
                let [even, odd] = [even, odd].map(|part| &part[stored * lag_width..][..lag_width]);
                let (left, right) =
                    out[dy * self.row..][..self.row].split_at_mut(self.count - skip);
                for (out, (even, odd)) in right.iter_mut().zip(even.iter().zip(odd)) {
                    *out = even + odd;
                }
                let opposite = even[skip..].iter().zip(&odd[skip..]);
                for (out, (even, odd)) in left.iter_mut().rev().zip(opposite) {
                    *out = even - odd;
                }
            }
        }
    }

    /// The adjoint of [`ToLags::lags`]: the real even spectrum of an even function of the lags.
    pub(crate) fn spectrum(&self, lags: &[f32], scratch: &mut LagsScratch, out: &mut [f32]) {
        let (width, lag_width) = (self.width, self.lag_width);
        let [even, odd] = &mut scratch.lags;
        for group in &self.groups {
            let skip = usize::from(group.from_zero);
            for (stored, &dy) in (group.first..).zip(&group.rows) {
                let [even, odd] =
                    [&mut *even, odd].map(|part| &mut part[stored * lag_width..][..lag_width]);
                let (left, right) = lags[dy * self.row..][..self.row].split_at(self.count - skip);
                (even[0], odd[0]) = (right[0], 0.0);
                let pairs = right[skip..].iter().zip(left.iter().rev());
                let out = even[skip..].iter_mut().zip(&mut odd[skip..]);
                for ((even, odd), (right, left)) in out.zip(pairs) {
                    (*even, *odd) = (right + left, right - left);
                }
            }
        }
        let lag_rows = scratch.lags[0].len() / lag_width;
        let quarters = out.chunks_exact_mut(self.rows * width);
        for (parity, (quarter, folded)) in quarters.zip(&scratch.lags).enumerate() {
            let between = &mut scratch.between[..lag_rows * width];
            for group in &self.groups {
                multiply(
                    Matrix::new(&folded[group.first * lag_width..], lag_width),
                    Matrix::new(&group.across_back[parity], width),
                    self.count,
                    &mut between[group.first * width..][..group.stored * width],
                    width,
                );
            }
            let down = Matrix::new(&self.down_back[parity], self.down_width);
            multiply(down, Matrix::new(between, width), lag_rows, quarter, width);
        }
    }
}

/// TurnedWaves of LANES modes at the places of an axis from the middle on: cos, x sin, sin and x cos.
type TurnedWaves = [[f32; LANES]; 4];

/// From turned pixels to modes, with its buffers for one thread.
#[derive(Debug, Clone)]
pub(crate) struct ToTurnedModes {
    folding: Folding,
    folded: Vec<f32>,
    along_x: Vec<TurnedWaves>,
    along_y: Vec<TurnedWaves>,
    /// Edges of a stamp, folded: sums and differences of opposite places.
    lines: Vec<[f32; 2]>,
}

impl ToTurnedModes {
    /// For images of n×n pixels.
    pub(crate) fn new(n: usize) -> Self {
        let folding = Folding::new(n);
        let waves = || vec![[[0.0; LANES]; 4]; folding.half];
        ToTurnedModes {
            folding,
            folded: vec![0.0; folding.len()],
            along_x: waves(),
            along_y: waves(),
            lines: vec![[0.0; 2]; EDGE_LINES * folding.half],
        }
    }

    /// The transforms of a row-major image, and of it times both coordinates M(x, y) of its pixels.
    pub(crate) fn transform_moments(
        &mut self,
        image: &[f32],
        matrix: [[f64; 2]; 2],
        plane: &Plane,
        out: &mut [Modes; 3],
    ) {
        let [[a, b], [c, d]] = matrix.map(|row| row.map(|value| value as f32));
        fold(&self.folding, image, &mut self.folded);
        let [plain, first, second] = out;
        for_each_block(plane, matrix, |at, [p, q]| {
            take_turned_waves(&self.folding, &p, &mut self.along_x);
            take_turned_waves(&self.folding, &q, &mut self.along_y);
            let mut sums = [[0.0; LANES]; 6];
            sum_pixels(
                &self.folding,
                &self.folded,
                [&self.along_x, &self.along_y],
                &mut sums,
            );
            let [re, im, x_re, x_im, y_re, y_im] = &sums;
            plain.re[at..][..LANES].copy_from_slice(re);
            plain.im[at..][..LANES].copy_from_slice(im);
            for l in 0..LANES {
                first.re[at + l] = a * x_re[l] + b * y_re[l];
                first.im[at + l] = a * x_im[l] + b * y_im[l];
                second.re[at + l] = c * x_re[l] + d * y_re[l];
                second.im[at + l] = c * x_im[l] + d * y_im[l];
            }
        });
    }

    /// Writes the transforms of two sets of edges: left, right, lower and upper values along each, half a pixel beyond the
    /// middles of the last pixels.
    pub(crate) fn transform_edges(
        &mut self,
        edges: &[f32],
        matrix: [[f64; 2]; 2],
        plane: &Plane,
        mut out: [&mut Modes; 2],
    ) {
        let Folding { n, half, .. } = self.folding;
        let lines = edges.chunks_exact(n).take(EDGE_LINES);
        for (line, folded) in lines.zip(self.lines.chunks_exact_mut(half)) {
            for (place, folded) in folded.iter_mut().enumerate() {
                let (above, below) = (line[n / 2 + place], line[half - 1 - place]);
                *folded = [above + below, above - below];
            }
        }
        let beyond = n as f64 / 2.0;
        for_each_block(plane, matrix, |at, [p, q]| {
            take_turned_waves(&self.folding, &p, &mut self.along_x);
            take_turned_waves(&self.folding, &q, &mut self.along_y);
            // Phases of the first edges; the last ones have the conjugates.
            let phases = [&p, &q].map(|wave| wave.map(|k| (k * beyond).sin_cos()));
            for (which, out) in out.iter_mut().enumerate() {
                let mut sums = [[0.0f32; LANES]; 2];
                for line in 0..EDGE_LINES / 2 {
                    let (waves, phase) = match line < 2 {
                        true => (&self.along_y, &phases[0]),
                        false => (&self.along_x, &phases[1]),
                    };
                    let sign = if line % 2 == 0 { 1.0 } else { -1.0 };
                    let first = (which * EDGE_LINES / 2 + line) * half;
                    let mut along = [[0.0f32; LANES]; 2];
                    for ([even, odd], [cos, _, sin, _]) in self.lines[first..].iter().zip(waves) {
                        for l in 0..LANES {
                            along[0][l] += even * cos[l];
                            along[1][l] -= odd * sin[l];
                        }
                    }
                    for l in 0..LANES {
                        let (sin, cos) = (sign * phase[l].0 as f32, phase[l].1 as f32);
                        sums[0][l] += along[0][l] * cos - along[1][l] * sin;
                        sums[1][l] += along[0][l] * sin + along[1][l] * cos;
                    }
                }
                out.re[at..][..LANES].copy_from_slice(&sums[0]);
                out.im[at..][..LANES].copy_from_slice(&sums[1]);
            }
        });
    }
}

// Left, right, lower and upper edge for each of two shears.
const EDGE_LINES: usize = 8;

/// Calls with the first place of LANES modes, and their wave numbers along the axes of the pixels. Places without modes get some
/// wave numbers, too; their amplitudes are zero in all that follows.
fn for_each_block(
    plane: &Plane,
    [[a, b], [c, d]]: [[f64; 2]; 2],
    mut with: impl FnMut(usize, [[f64; LANES]; 2]),
) {
    for at in (0..2 * plane.quarter()).step_by(LANES) {
        let (x, y, below) = plane.indices(at);
        if y > plane.modes || x > plane.modes {
            continue;
        }
        let ky = if below { -1.0 } else { 1.0 } * plane.wave(y);
        let kx: [f64; LANES] = std::array::from_fn(|l| plane.wave(x + l));
        with(
            at,
            [kx.map(|kx| a * kx + c * ky), kx.map(|kx| b * kx + d * ky)],
        );
    }
}

// By steps in double precision from the middle on. The middle pixel of an odd number is folded upon itself.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn take_turned_waves(folding: &Folding, wave: &[f64; LANES], out: &mut [TurnedWaves]) {
    let (mut cos, mut sin) = ([0.0f64; LANES], [0.0f64; LANES]);
    let (mut step_cos, mut step_sin) = (cos, sin);
    let first = folding.distance(0);
    for l in 0..LANES {
        (sin[l], cos[l]) = (wave[l] * first).sin_cos();
        (step_sin[l], step_cos[l]) = wave[l].sin_cos();
    }
    for (place, [out_cos, out_x_sin, out_sin, out_x_cos]) in out.iter_mut().enumerate() {
        let (x, share) = (folding.distance(place), folding.share(place));
        for l in 0..LANES {
            out_cos[l] = (share * cos[l]) as f32;
            out_x_sin[l] = (x * sin[l]) as f32;
            out_sin[l] = sin[l] as f32;
            out_x_cos[l] = (x * cos[l]) as f32;
            (cos[l], sin[l]) = (
                cos[l] * step_cos[l] - sin[l] * step_sin[l],
                sin[l] * step_cos[l] + cos[l] * step_sin[l],
            );
        }
    }
}

// Real and imaginary parts of the transforms of an image, of it times x, and of it times y. Of a row f(x) with even part E and odd
// part O, Σ f exp(−ipx) = Σ E cos − i Σ O sin, and Σ x f exp(−ipx) = Σ x O cos − i Σ x E sin; and the same along y.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_pixels(
    folding: &Folding,
    folded: &[f32],
    [along_x, along_y]: [&[TurnedWaves]; 2],
    sums: &mut [[f32; LANES]; 6],
) {
    let Folding {
        half, stride, band, ..
    } = *folding;
    let part = |k: usize| &folded[k * band * stride..][..band * stride];
    let [ee, eo, oe, oo] = [part(0), part(1), part(2), part(3)];
    for y in 0..half {
        let [ee, eo, oe, oo] = [ee, eo, oe, oo].map(|part| &part[y * stride..][..half]);
        let [mut ec_e, mut ex_e, mut ec_o, mut ex_o] = [[0.0f32; LANES]; 4];
        for ((e, o), [cos, x_sin, ..]) in ee.iter().zip(eo).zip(along_x) {
            for l in 0..LANES {
                ec_e[l] += e * cos[l];
                ex_e[l] += e * x_sin[l];
                ec_o[l] += o * cos[l];
                ex_o[l] += o * x_sin[l];
            }
        }
        let [mut os_e, mut ox_e, mut os_o, mut ox_o] = [[0.0f32; LANES]; 4];
        for ((e, o), [.., sin, x_cos]) in oe.iter().zip(oo).zip(along_x) {
            for l in 0..LANES {
                os_e[l] += e * sin[l];
                ox_e[l] += e * x_cos[l];
                os_o[l] += o * sin[l];
                ox_o[l] += o * x_cos[l];
            }
        }
        let [cos, y_sin, sin, y_cos] = &along_y[y];
        let [re, im, x_re, x_im, y_re, y_im] = &mut *sums;
        for l in 0..LANES {
            re[l] += ec_e[l] * cos[l] - os_o[l] * sin[l];
            im[l] -= os_e[l] * cos[l] + ec_o[l] * sin[l];
            x_re[l] += ox_e[l] * cos[l] - ex_o[l] * sin[l];
            x_im[l] -= ex_e[l] * cos[l] + ox_o[l] * sin[l];
            y_re[l] += ec_o[l] * y_cos[l] - os_e[l] * y_sin[l];
            y_im[l] -= os_o[l] * y_cos[l] + ec_e[l] * y_sin[l];
        }
    }
}

#[cfg(test)]
mod tests;
