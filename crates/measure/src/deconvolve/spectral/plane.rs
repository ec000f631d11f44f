//! The modes that the linear network keeps, and how they are stored.
//!
//! The plane is periodic with a period of `size` pixels. Of its modes only those with indices |j| ≤ `modes` along each axis
//! are kept. A real image is determined by the modes with k_x ≥ 0. They are stored in two ways:
//!
//! * mode by mode ([`Modes`]): those with k_y ≥ 0, and then those with k_y ≤ 0, each in rows of one |k_y| with k_x from zero;
//! * by their parity ([`Quarters`]), in which sums along an axis are sums of real numbers.
//!
//! With s = −sin, the transform of an image at (k_x, ±k_y), k_y ≥ 0, is
//!
//! ```text
//! Σ I exp(−i(k_x x ± k_y y)) = (cc ∓ ss) + i(sc ± cs)
//! ```
//!
//! where cc is the sum Σ I cos(k_x x) cos(k_y y), sc = Σ I s(k_x x) cos(k_y y), and so on: the first letter stands for x.
//! Places are measured from the middle of the image. Rows and columns are filled up with zeros to multiples that
//! [`crate::deconvolve::product`] needs.

use multiversion::multiversion;

use crate::fft::transform_size;
use shearq_quantities::product::{LANES, ROWS};

/// Least number of lags per pixel of a grid that samples the kept modes, along an axis. See docs/constants.md.
const FINER: f64 = 1.5;

/// Pixels of which the period is a multiple. See docs/constants.md.
const GRAIN: usize = 16;

/// The kept modes.
#[derive(Debug, Clone)]
pub(super) struct Plane {
    /// Period in pixels.
    pub(super) size: usize,
    /// Largest index of a mode.
    pub(super) modes: usize,
    /// Lags along an axis in a period.
    pub(super) lags: usize,
    /// Rows of a quarter. The first `modes + 1` are used.
    pub(super) rows: usize,
    /// Columns of a quarter. The first `modes + 1` are used.
    pub(super) width: usize,
}

impl Plane {
    /// A plane of at least `least` pixels that keeps wave numbers up to `cut` radians per pixel.
    pub(super) fn new(least: usize, cut: f64) -> Self {
        let size = least.next_multiple_of(GRAIN);
        let places = cut * size as f64 / std::f64::consts::PI;
        let side = transform_size(places.ceil() as usize + 2).min(size);
        let modes = side / 2 - 1;
        Plane {
            size,
            modes,
            lags: transform_size((FINER * side as f64).ceil() as usize),
            rows: (modes + 1).next_multiple_of(ROWS),
            width: (modes + 1).next_multiple_of(LANES),
        }
    }

    /// Numbers in a quarter.
    pub(super) fn quarter(&self) -> usize {
        self.rows * self.width
    }

    /// Pixels between lags.
    pub(super) fn lag_spacing(&self) -> f64 {
        self.size as f64 / self.lags as f64
    }

    /// Wave number of index `j`, in radians per pixel.
    pub(super) fn wave(&self, j: usize) -> f64 {
        std::f64::consts::TAU * j as f64 / self.size as f64
    }

    /// Place in [`Modes`] of the mode of indices (`x`, ±`y`), the lower sign if `below`.
    pub(super) fn place(&self, x: usize, y: usize, below: bool) -> usize {
        usize::from(below) * self.quarter() + y * self.width + x
    }

    /// Indices (x, ±y) of the mode at place `at` of [`Modes`], and whether the lower sign holds.
    fn indices(&self, at: usize) -> (usize, usize, bool) {
        let (half, rest) = (at / self.quarter(), at % self.quarter());
        (rest % self.width, rest / self.width, half == 1)
    }

    /// Wave vector of each mode.
    pub(super) fn waves(&self) -> Vec<[f64; 2]> {
        let places = 0..2 * self.quarter();
        places
            .map(|at| {
                let (x, y, below) = self.indices(at);
                let sign = if below { -1.0 } else { 1.0 };
                [self.wave(x), sign * self.wave(y)]
            })
            .collect()
    }

    /// For how many modes of the plane each stands. One without k_y is stored twice, and counts half each time.
    pub(super) fn counts(&self) -> Vec<f32> {
        let places = 0..2 * self.quarter();
        places
            .map(|at| {
                let (x, y, _) = self.indices(at);
                if x > self.modes || y > self.modes {
                    return 0.0;
                }
                let along = if x == 0 { 1.0 } else { 2.0 };
                along * if y == 0 { 0.5 } else { 1.0 }
            })
            .collect()
    }

    /// Place of the mode at `at` turned by 90 degrees, or of its opposite; a mode that is not kept stays.
    pub(super) fn turned(&self, at: usize) -> usize {
        let (x, y, below) = self.indices(at);
        if x > self.modes || y > self.modes {
            return at;
        }
        // (k_x, k_y) becomes (k_y, −k_x), and (k_x, −k_y) the opposite of (k_y, k_x).
        self.place(y, x, !below)
    }

    /// Zeros.
    pub(super) fn spectrum(&self) -> Modes {
        Modes {
            re: vec![0.0; 2 * self.quarter()],
            im: vec![0.0; 2 * self.quarter()],
        }
    }

    /// Zeros.
    pub(super) fn quarters(&self) -> Quarters {
        Quarters(vec![0.0; 4 * self.quarter()])
    }
}

/// The half spectrum of a real image, mode by mode.
#[derive(Debug, Clone)]
pub(super) struct Modes {
    pub(super) re: Vec<f32>,
    pub(super) im: Vec<f32>,
}

impl Modes {
    /// Takes the modes of `quarters`.
    pub(super) fn take(&mut self, quarters: &Quarters) {
        modes_of(&quarters.0, &mut self.re, &mut self.im);
    }

    /// Takes the numbers of another.
    pub(super) fn copy_from(&mut self, other: &Self) {
        self.re.copy_from_slice(&other.re);
        self.im.copy_from_slice(&other.im);
    }
}

/// The spectrum of a real image by parity: cc, cs, sc and ss.
#[derive(Debug, Clone)]
pub(super) struct Quarters(pub(super) Vec<f32>);

impl Quarters {
    /// Takes the parities of `modes`.
    pub(super) fn take(&mut self, modes: &Modes) {
        quarters_of(&modes.re, &modes.im, &mut self.0);
    }

    /// Takes the numbers of another.
    pub(super) fn copy_from(&mut self, other: &Self) {
        self.0.copy_from_slice(&other.0);
    }

    /// The sum of the image.
    pub(super) fn sum(&self) -> f32 {
        self.0[0]
    }

    /// cc, cs, sc and ss.
    pub(super) fn each(&mut self) -> [&mut [f32]; 4] {
        each(&mut self.0)
    }
}

/// Four parts of equal length.
fn each(values: &mut [f32]) -> [&mut [f32]; 4] {
    let (c, s) = values.split_at_mut(values.len() / 2);
    let (cc, cs) = c.split_at_mut(c.len() / 2);
    let (sc, ss) = s.split_at_mut(s.len() / 2);
    [cc, cs, sc, ss]
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn modes_of(quarters: &[f32], re: &mut [f32], im: &mut [f32]) {
    let count = quarters.len() / 4;
    let (c, s) = quarters.split_at(2 * count);
    let ((cc, cs), (sc, ss)) = (c.split_at(count), s.split_at(count));
    sum_and_difference(ss, cc, &mut re[..2 * count], true);
    sum_and_difference(cs, sc, &mut im[..2 * count], false);
}

/// Writes b + a and then b − a, or in the other order if `turned`.
#[inline(always)]
fn sum_and_difference(a: &[f32], b: &[f32], out: &mut [f32], turned: bool) {
    let (mut first, mut second) = out.split_at_mut(a.len());
    if turned {
        (first, second) = (second, first);
    }
    let out = first.iter_mut().zip(second);
    for ((sum, difference), (a, b)) in out.zip(a.iter().zip(b)) {
        *sum = b + a;
        *difference = b - a;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn quarters_of(re: &[f32], im: &[f32], quarters: &mut [f32]) {
    let [cc, cs, sc, ss] = each(quarters);
    halves(re, cc, ss, true);
    halves(im, sc, cs, false);
}

/// Writes half the sum and half the difference of the two halves of `values`; of the second and the first if `turned`.
#[inline(always)]
fn halves(values: &[f32], sum: &mut [f32], difference: &mut [f32], turned: bool) {
    let (mut first, mut second) = values.split_at(sum.len());
    if turned {
        (first, second) = (second, first);
    }
    let out = sum.iter_mut().zip(difference);
    for ((sum, difference), (a, b)) in out.zip(first.iter().zip(second)) {
        *sum = 0.5 * (a + b);
        *difference = 0.5 * (a - b);
    }
}

/// Parities cc and ss of a real even spectrum, from its modes.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn even_quarters(modes: &[f32], quarters: &mut [f32]) {
    let (cc, ss) = quarters.split_at_mut(modes.len() / 2);
    halves(modes, cc, ss, true);
}
