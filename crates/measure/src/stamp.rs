//! The pixels of stamps in either precision, and a stamp before its shape is measured: padding, sky and missing pixels.
//!
//! Missing pixels are bad ones, cosmic rays, another object's, or those beyond the edge of an exposure. They get the light of
//! the opposite ones, which a galaxy that looks the same rotated by 180 degrees has there, sheared or not. Noise that is
//! repeated like this adds to the autocorrelation at the lag between the two, so that near the galaxy only few may be missing.
//!
//! # Centroids and radii
//!
//! Both are moments of galaxies and PSFs under Gaussian weights. The weight of a centroid follows it.
//!
//! The mean square q = ½ Σ W r² I / Σ W I of radii under a Gaussian weight W of σ = 5 px, which keeps noise and neighbours
//! out, belongs to a Gaussian of mean square s per axis with 1/q = 1/s + 1/25; this s is the mean square radius here. The radii
//! of a galaxy and of its PSF differ by about the galaxy's own, so that the difference compares images of any seeing. The
//! narrow weight of a core compares the PSF with galaxies: no galaxy has a narrower core.

use std::borrow::Cow;
use std::ops::{Range, RangeInclusive};

use multiversion::multiversion;
use ndarray::{
    Array, Array3, ArrayView, ArrayView1, ArrayView2, ArrayView3, Axis, CowArray, Dimension, Ix3,
    RemoveAxis, Slice,
};
use shearq_quantities::statistics::upper_median;
use shearq_submissions::SkySource;
use shearq_submissions::limits::{MAX_CUT, MAX_PSF};

use crate::error::{MeasureError, length};
use crate::sky::{Sky, SkyCells};

// Brightest pixels, in image units, whose autocorrelation keeps single precision: the squares of its values neither vanish
// nor overflow.
pub(crate) const PEAK_RANGE: RangeInclusive<f32> = 1e-18..=1e17;
// Noise levels other than zero, in image units, whose squares keep single precision like the squares of [`PEAK_RANGE`].
const NOISE_LEVEL_RANGE: RangeInclusive<f64> = 1e-30..=1e18;

/// Whether a noise level can be used.
pub(crate) fn is_level(sigma: f64) -> bool {
    sigma == 0.0 || NOISE_LEVEL_RANGE.contains(&sigma)
}

/// `f32` or `f64`.
pub trait Pixel: Copy + Send + Sync + Into<f64> + private::Sealed {
    /// Rounded to single precision, in which stamps are measured.
    fn to_f32(self) -> f32;

    /// Stamps of this precision.
    fn pixels(stamps: ArrayView3<'_, Self>) -> Pixels<'_, Ix3>;
}

impl Pixel for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }

    fn pixels(stamps: ArrayView3<'_, Self>) -> Pixels<'_, Ix3> {
        stamps.into()
    }
}

impl Pixel for f64 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self as f32
    }

    fn pixels(stamps: ArrayView3<'_, Self>) -> Pixels<'_, Ix3> {
        stamps.into()
    }
}

/// Pixels of stamps in single or double precision, borrowed or owned.
#[derive(Debug, Clone)]
pub enum Pixels<'a, D: Dimension> {
    /// `f32`.
    Single(CowArray<'a, f32, D>),
    /// `f64`.
    Double(CowArray<'a, f64, D>),
}

impl<'a, D: Dimension> From<ArrayView<'a, f32, D>> for Pixels<'a, D> {
    fn from(pixels: ArrayView<'a, f32, D>) -> Self {
        Pixels::Single(pixels.into())
    }
}

impl<'a, D: Dimension> From<ArrayView<'a, f64, D>> for Pixels<'a, D> {
    fn from(pixels: ArrayView<'a, f64, D>) -> Self {
        Pixels::Double(pixels.into())
    }
}

impl<D: Dimension> From<Array<f32, D>> for Pixels<'_, D> {
    fn from(pixels: Array<f32, D>) -> Self {
        Pixels::Single(pixels.into())
    }
}

impl<D: Dimension> From<Array<f64, D>> for Pixels<'_, D> {
    fn from(pixels: Array<f64, D>) -> Self {
        Pixels::Double(pixels.into())
    }
}

impl<D: Dimension> Pixels<'_, D> {
    /// Lengths of the axes.
    pub fn dim(&self) -> D::Pattern {
        match self {
            Pixels::Single(pixels) => pixels.dim(),
            Pixels::Double(pixels) => pixels.dim(),
        }
    }

    /// A view of the same pixels.
    pub fn view(&self) -> Pixels<'_, D> {
        match self {
            Pixels::Single(pixels) => pixels.view().into(),
            Pixels::Double(pixels) => pixels.view().into(),
        }
    }
}

impl<D: RemoveAxis> Pixels<'_, D> {
    /// Some of the stamps along the first axis, without a copy.
    #[must_use]
    pub fn into_slice(mut self, range: Range<usize>) -> Self {
        match &mut self {
            Pixels::Single(stamps) => stamps.slice_axis_inplace(Axis(0), Slice::from(range)),
            Pixels::Double(stamps) => stamps.slice_axis_inplace(Axis(0), Slice::from(range)),
        }
        self
    }
}

impl Pixels<'_, Ix3> {
    /// Stamps of an image of `count` stamps of `side` pixels next to each other, row-major.
    ///
    /// # Errors
    /// If the image has another number of pixels.
    pub fn strip(pixels: Vec<f32>, count: usize, side: usize) -> Result<Self, MeasureError> {
        length("a strip of stamps", pixels.len(), count * side * side)?;
        let rows = Array3::from_shape_vec((side, count, side), pixels);
        let rows = rows.map_err(|error| MeasureError::Shape {
            what: "a strip of stamps",
            found: format!("{count} stamps of {side} × {side} pixels"),
            expected: error.to_string(),
        })?;
        Ok(rows.permuted_axes([1, 0, 2]).into())
    }
}

/// A number from words such as the bits of pixels, the same on all machines: Fowler, Noll and Vo's hash.
pub(crate) fn hash(words: impl Iterator<Item = u32>) -> u64 {
    words.fold(0xcbf2_9ce4_8422_2325, |hash, word| {
        (hash ^ u64::from(word)).wrapping_mul(0x0100_0000_01b3)
    })
}

pub(crate) fn copy_row<P: Pixel>(row: ArrayView1<'_, P>, to: &mut [f32]) {
    // Contiguous pixels, as in an image, are converted several at a time.
    match row.as_slice() {
        Some(row) => convert(to, row.iter()),
        None => convert(to, row.iter()),
    }
}

/// The pixels of a row, copied where they are apart in memory.
pub(crate) fn contiguous<P: Pixel>(row: ArrayView1<'_, P>) -> Cow<'_, [P]> {
    row.to_slice()
        .map_or_else(|| Cow::Owned(row.to_vec()), Cow::Borrowed)
}

fn convert<'a, P: Pixel + 'a>(to: &mut [f32], from: impl Iterator<Item = &'a P>) {
    for (value, pixel) in to.iter_mut().zip(from) {
        *value = pixel.to_f32();
    }
}

/// The largest pixel, or zero if none is positive. 64 running maxima let vector instructions take several at a time.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn highest(pixels: &[f32]) -> f32 {
    // Four vectors of AVX-512, so that comparisons overlap.
    const LANES: usize = 64;
    let mut lanes = [0.0f32; LANES];
    let chunks = pixels.chunks_exact(LANES);
    let rest = chunks.remainder().iter().copied().fold(0.0, f32::max);
    for chunk in chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            // Not a number is not larger.
            *lane = if *value > *lane { *value } else { *lane };
        }
    }
    lanes.into_iter().fold(rest, f32::max)
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn all_finite(pixels: &[f32]) -> bool {
    // No early exit, so that several pixels are tested at a time.
    let largest = pixels
        .iter()
        .fold(0, |most: u32, value| most.max(value.abs().to_bits()));
    largest < f32::INFINITY.to_bits()
}

/// How many rows of pixels at the lower and upper edge, and columns at the left and right edge, are all equal.
pub(crate) fn padding(pixels: &[f32], n: usize) -> [usize; 4] {
    [0, 1, 2, 3].map(|edge| {
        let at = |depth: usize, along: usize| match edge {
            0 => depth * n + along,
            1 => (n - 1 - depth) * n + along,
            2 => along * n + depth,
            _ => along * n + n - 1 - depth,
        };
        let value = pixels[at(0, 0)];
        let equal = |depth: &usize| (0..n).all(|along| pixels[at(*depth, along)] == value);
        (0..n).take_while(equal).count()
    })
}

pub(crate) fn check_sizes(n: usize, p: usize) -> Result<(), MeasureError> {
    if !(3..=MAX_CUT).contains(&n) {
        let expected = format!("a side of 3 to {MAX_CUT} pixels");
        return Err(MeasureError::square("a stamp", (n, n), expected));
    }
    if !(2..=MAX_PSF).contains(&p) {
        let expected = format!("a side of 2 to {MAX_PSF} pixels");
        return Err(MeasureError::square("a PSF stamp", (p, p), expected));
    }
    Ok(())
}

pub(crate) fn check_psf(psf: ArrayView2<'_, f64>, p: usize) -> Result<(), MeasureError> {
    if psf.dim() != (p, p) {
        let expected = format!("{p} × {p}");
        return Err(MeasureError::square("a PSF stamp", psf.dim(), expected));
    }
    // Without the places of its pixels, which only a bad one needs, and without an early exit.
    if !psf.fold(false, |bad, value| bad | !value.is_finite()) {
        return Ok(());
    }
    match psf.indexed_iter().find(|(_, value)| !value.is_finite()) {
        None => Ok(()),
        Some(((y, x), _)) => Err(MeasureError::NotFinite {
            what: "PSF stamp",
            x: x + 1,
            y: y + 1,
        }),
    }
}

mod private {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

// Of the pixels of a stamp. Chosen by hand.
const MAX_MISSING_SHARE: f32 = 0.25;
// Of the pixels of a stamp that become zero: the opposite one is missing, and too few adjacent ones are present. Chosen by hand.
const MAX_MISSING_PAIR_SHARE: f32 = 0.02;
// In pixels around the galaxy's centre, with stricter limits. Chosen by hand.
const INNER_MISSING_RADIUS: f32 = 12.0;
// Missing pixels within that radius. Chosen by hand.
const MAX_INNER_MISSING: usize = 24;
// Of the eight around a pixel whose opposite is missing or off the stamp. Chosen by hand.
const MIN_ADJACENT_PRESENT: usize = 7;

/// A full stamp in single precision and the sky that is subtracted from it, with buffers for one thread.
#[derive(Debug, Clone)]
pub(crate) struct FullStamp {
    pub(crate) side: usize,
    pub(crate) pixels: Vec<f32>,
    pub(crate) cells: SkyCells,
    pub(crate) subtraction: SkySubtraction,
}

impl FullStamp {
    pub(crate) fn new(side: usize) -> Self {
        FullStamp {
            side,
            pixels: vec![0.0; side * side],
            cells: SkyCells::new(side),
            subtraction: SkySubtraction::Nothing,
        }
    }

    pub(crate) fn read<P: Pixel>(&mut self, stamp: ArrayView2<'_, P>) -> Result<(), MeasureError> {
        let side = self.side;
        if stamp.dim() != (side, side) {
            let expected = format!("{side} × {side}");
            return Err(MeasureError::square("a stamp", stamp.dim(), expected));
        }
        let rows = self.pixels.chunks_exact_mut(side.max(1));
        for (to, row) in rows.zip(stamp.into_outer_iter()) {
            copy_row(row, to);
        }
        Ok(())
    }

    /// Whether all pixels are equal, as on a stamp beyond the exposure.
    pub(crate) fn is_blank(&self) -> bool {
        self.pixels.iter().all(|value| *value == self.pixels[0])
    }

    /// Missing pixels stay missing.
    pub(crate) fn subtract_sky(&mut self) {
        let sky = match self.subtraction {
            SkySubtraction::Nothing => None,
            SkySubtraction::Plane(sky) => Some(sky),
            SkySubtraction::EachStamp => self.cells.plane_of(&self.pixels),
        };
        if let Some(sky) = sky {
            sky.subtract(&mut self.pixels, self.side);
        }
    }
}

/// Sum of a pixel and its opposite under rotation by 180° about a galaxy, along each axis. It rounds the galaxy's centre to
/// half a pixel, so that opposites are pixels.
pub(crate) fn rotation_sum(centroid: [f32; 2], n: usize) -> [i32; 2] {
    centroid.map(|c| (2.0 * c).round() as i32 + n as i32 - 1)
}

/// The light of the opposite of a pixel (x, y) on a stamp of `n` pixels a side; `None` off the stamp.
fn opposite(stamp: &[f32], n: usize, rotation: [i32; 2], [x, y]: [usize; 2]) -> Option<f32> {
    let on_stamp = |at: i32| usize::try_from(at).ok().filter(|&at| at < n);
    let column = on_stamp(rotation[0] - x as i32)?;
    let row = on_stamp(rotation[1] - y as i32)?;
    Some(stamp[row * n + column])
}

/// Makes rows and columns of padding missing, unless the opposite edge has some as well: a stamp beyond an edge of an
/// exposure. Whether there are any.
pub(crate) fn mark_padding_missing(pixels: &mut [f32], n: usize) -> bool {
    let [low, high, left, right] = padding(pixels, n);
    let one = |a: usize, b: usize| if a > 0 && b > 0 { [0; 2] } else { [a, b] };
    let ([low, high], [left, right]) = (one(low, high), one(left, right));
    if low + high + left + right == 0 {
        return false;
    }
    for (y, row) in pixels.chunks_exact_mut(n).enumerate() {
        if y < low || y >= n - high {
            row.fill(f32::NAN);
        }
        row[..left].fill(f32::NAN);
        row[n - right..].fill(f32::NAN);
    }
    true
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) enum SkySubtraction {
    #[default]
    Nothing,
    Plane(Sky),
    /// The plane of each stamp, measured on its border.
    EachStamp,
}

impl SkySubtraction {
    /// What a configuration with this key subtracts if `sky` was found.
    pub(crate) fn of(source: Option<SkySource>, sky: Option<Sky>) -> Self {
        match (source, sky) {
            (Some(SkySource::Stamp), _) => SkySubtraction::EachStamp,
            (Some(SkySource::Image), Some(sky)) => SkySubtraction::Plane(sky),
            (Some(SkySource::Image | SkySource::None) | None, _) => SkySubtraction::Nothing,
        }
    }
}

/// Fills missing pixels, with buffers for one thread.
#[derive(Debug, Clone, Default)]
pub(crate) struct MissingPixels {
    places: Vec<usize>,
    lights: Vec<f32>,
}

impl MissingPixels {
    /// For stamps of up to `n` pixels a side without allocation.
    pub(crate) fn new(n: usize) -> Self {
        MissingPixels {
            places: Vec::with_capacity(n * n),
            lights: Vec::with_capacity(n * n),
        }
    }

    /// Fills the pixels of a stamp of `n` pixels a side that are not finite. False if too many are, or if holes on
    /// both sides leave a pixel near the centre or too many elsewhere unknown.
    pub(crate) fn fill(&mut self, stamp: &mut [f32], n: usize) -> bool {
        self.places.clear();
        let pixels = stamp.iter().enumerate();
        let missing = pixels.filter(|(_, value)| !value.is_finite());
        self.places.extend(missing.map(|(at, _)| at));
        if self.places.len() as f32 > MAX_MISSING_SHARE * stamp.len() as f32 {
            return false;
        }
        // The centroid needs all pixels: first filled about the stamp's centre, then about the galaxy's.
        self.fill_about(stamp, n, [0.0; 2]);
        let centroid = galaxy_centroid(stamp, n);
        for &at in &self.places {
            stamp[at] = f32::NAN;
        }
        let inner = self.places.iter().filter(|at| is_inner(**at, n, centroid));
        let few_inner = inner.count() <= MAX_INNER_MISSING;
        self.fill_about(stamp, n, centroid) && few_inner
    }

    /// Gives missing pixels the light of the opposite ones, or if that is missing too the mean of the adjacent ones, or
    /// zero. False if a pixel near the centre becomes zero, or too many elsewhere whose opposite is on the stamp.
    fn fill_about(&mut self, stamp: &mut [f32], n: usize, centroid: [f32; 2]) -> bool {
        let rotation = rotation_sum(centroid, n);
        let (mut inner_filled, mut zeroed) = (true, 0);
        self.lights.clear();
        for &at in &self.places {
            let other = opposite(stamp, n, rotation, [at % n, at / n]);
            let light = other.filter(|light| light.is_finite());
            let light = light.or_else(|| adjacent_mean(stamp, n, at));
            if light.is_none() {
                // An opposite that is off the stamp is so far out that there is no light.
                zeroed += usize::from(other.is_some());
                inner_filled &= !is_inner(at, n, centroid);
            }
            self.lights.push(light.unwrap_or(0.0));
        }
        // Only now, so that no pixel is filled from one that was filled.
        for (&at, &light) in self.places.iter().zip(&self.lights) {
            stamp[at] = light;
        }
        inner_filled && zeroed as f32 <= MAX_MISSING_PAIR_SHARE * stamp.len() as f32
    }
}

fn is_inner(at: usize, n: usize, centroid: [f32; 2]) -> bool {
    let place = |at: usize, c: f32| at as f32 - (n as f32 - 1.0) / 2.0 - c;
    place(at % n, centroid[0]).hypot(place(at / n, centroid[1])) < INNER_MISSING_RADIUS
}

fn adjacent_mean(stamp: &[f32], n: usize, at: usize) -> Option<f32> {
    let (x, y) = (at % n, at / n);
    let side = |at: usize| at.saturating_sub(1)..(at + 2).min(n);
    let square = side(y).flat_map(|y| side(x).map(move |x| stamp[y * n + x]));
    let there = square.filter(|light| light.is_finite());
    let (sum, count) = there.fold((0.0, 0), |(sum, count), light| (sum + light, count + 1));
    (count >= MIN_ADJACENT_PRESENT).then(|| sum / count as f32)
}

/// The pixels of an n × n stamp within `width` of its edges, in pieces, row by row.
pub fn frame(stamp: &[f32], n: usize, width: usize) -> impl Iterator<Item = &[f32]> {
    let width = width.min(n);
    let rows = stamp.chunks_exact(n).enumerate();
    rows.flat_map(move |(y, row)| match y < width || y >= n - width {
        true => [row, &[]],
        false => [&row[..width], &row[n - width..]],
    })
}

// Narrow, so that a centroid does not follow noise: at S/N 20 it is good to 0.2 px. Chosen by hand.
pub(crate) const CENTROID_WEIGHT_SIGMA: f64 = 2.0;
// Three σ.
const CENTROID_WEIGHT_HALF_SIDE: usize = 6;
const CENTROID_WEIGHT_SIDE: usize = 2 * CENTROID_WEIGHT_HALF_SIDE;
// The weighted centroid falls short of the centre: of a Gaussian of σ = 2 px it goes half the way. Chosen by hand.
const STEP_FACTOR: f64 = 1.5;

// Of the offset of a Gaussian of σ = 3 px, three steps leave 0.16. Chosen by hand.
const GALAXY_STEPS: usize = 3;
// A weighted centroid of one σ of the weight. Chosen by hand.
const MAX_GALAXY_STEP: f64 = 3.0;
// S/N ν under the weight at which half of a centroid is the origin of the shear. The noise of a centroid correlates with that of the
// response: whole centroids would make m about +1e-3 (20/ν)² (tests/stress --cases off1,off2,off3), with 30 it is below 0.3e-3 at any ν.
const HALF_CENTROID_SNR: f64 = 30.0;

// A star of FWHM 10 px is found to 10⁻³ px. Chosen by hand.
const MAX_STAR_STEPS: usize = 40;
// Chosen by hand.
const CONVERGED_STEP: f64 = 1e-3;
// Largest distance of a star's centroid from the start of the search, in pixels.
// Farther away it is another object. Chosen by hand.
pub(crate) const MAX_STAR_SHIFT: f64 = 3.0;

/// Offset (x, y) of the galaxy from the centre of its stamp of `n` pixels a side; zero if there is no light.
pub(crate) fn galaxy_centroid(stamp: &[f32], n: usize) -> [f32; 2] {
    galaxy_centroid_near(stamp, n, [0.0; 2])
}

/// The same for a galaxy that is expected at `start` from the centre, which is returned if there is no light. Steps that fall short of the
/// centroid leave no part of an offset that was expected.
pub(crate) fn galaxy_centroid_near(stamp: &[f32], n: usize, start: [f64; 2]) -> [f32; 2] {
    centroid_and_light(stamp, n, start).0
}

/// Place (x, y) about which a shear deforms the galaxy, from the centre of its stamp of `n` pixels a side in noise of this level.
pub(crate) fn shear_origin(stamp: &[f32], n: usize, noise: f64) -> [f32; 2] {
    let (centroid, light) = centroid_and_light(stamp, n, [0.0; 2]);
    // The integral of the squared weight is πσ².
    let snr = light / (noise * CENTROID_WEIGHT_SIGMA * std::f64::consts::PI.sqrt());
    let share = 1.0 / (1.0 + (HALF_CENTROID_SNR / snr).powi(4));
    centroid.map(|at| at * share as f32)
}

// The centroid of `galaxy_centroid_near`, and the light under its last weight.
fn centroid_and_light(stamp: &[f32], n: usize, start: [f64; 2]) -> ([f32; 2], f64) {
    let centre = (n as f64 - 1.0) / 2.0;
    let bound = centre / 2.0;
    let (mut offset, mut light) = (start, 0.0);
    for _ in 0..GALAXY_STEPS {
        let row = |y: usize| &stamp[y * n..][..n];
        let Some((step, under_weight)) = step([n; 2], row, offset.map(|at| centre + at)) else {
            return (start.map(|at| at as f32), 0.0);
        };
        light = under_weight;
        for (at, step) in offset.iter_mut().zip(step) {
            let step = step.clamp(-MAX_GALAXY_STEP, MAX_GALAXY_STEP);
            *at = (*at + step).clamp(-bound, bound);
        }
    }
    (offset.map(|at| at as f32), light)
}

/// Centroid (x, y) of a star near `start`, in pixels from the first; `start` if the search leaves it or finds no light.
pub(crate) fn star_centroid<P: Pixel>(stamp: ArrayView2<'_, P>, start: [f64; 2]) -> [f64; 2] {
    let (rows, columns) = stamp.dim();
    let mut at = start;
    for _ in 0..MAX_STAR_STEPS {
        let row = |y: usize| contiguous(stamp.row(y));
        let Some((step, _)) = step([columns, rows], row, at) else {
            return start;
        };
        for k in 0..2 {
            at[k] += step[k];
            if (at[k] - start[k]).abs() > MAX_STAR_SHIFT {
                return start;
            }
        }
        if step.iter().all(|step| step.abs() < CONVERGED_STEP) {
            break;
        }
    }
    at
}

/// The step from `at` towards the centroid, and the light under the weight; `None` without light.
fn step<P: Pixel, R: AsRef<[P]>>(
    [columns, rows]: [usize; 2],
    row: impl Fn(usize) -> R,
    at: [f64; 2],
) -> Option<([f64; 2], f64)> {
    let [first_x, first_y] =
        at.map(|at| at.floor() as isize + 1 - CENTROID_WEIGHT_HALF_SIDE as isize);
    let weights_x = weights(first_x as f64 - at[0]);
    let weights_y = weights(first_y as f64 - at[1]);
    let on_stamp = |first: isize, side: usize| {
        let start = first.min(0).unsigned_abs().min(CENTROID_WEIGHT_SIDE);
        start..(side as isize - first).clamp(start as isize, CENTROID_WEIGHT_SIDE as isize) as usize
    };
    let (xs, ys) = (on_stamp(first_x, columns), on_stamp(first_y, rows));
    let (mut light, mut first) = (0.0, [0.0; 2]);
    for y in ys {
        let row = row((first_y + y as isize) as usize);
        let pixels = &row.as_ref()[(first_x + xs.start as isize) as usize..];
        let (mut of_row, mut along_row) = (0.0, 0.0);
        for (x, pixel) in xs.clone().zip(pixels) {
            let weighted = weights_x[x] * Into::<f64>::into(*pixel);
            of_row += weighted;
            along_row += weighted * ((first_x + x as isize) as f64 - at[0]);
        }
        let dy = (first_y + y as isize) as f64 - at[1];
        light += weights_y[y] * of_row;
        first[0] += weights_y[y] * along_row;
        first[1] += weights_y[y] * of_row * dy;
    }
    // Not of a stamp with pixels that are NaN, which the caller sees in the result.
    if light <= 0.0 {
        return None;
    }
    Some((first.map(|sum| STEP_FACTOR * sum / light), light))
}

/// The weight at places one pixel apart, from `first` pixels from its centre on.
fn weights(first: f64) -> [f64; CENTROID_WEIGHT_SIDE] {
    // exp(−(x + 1)²/2σ²) is exp(−x²/2σ²) times exp(−(2x + 1)/2σ²), whose ratio from place to place is exp(−1/σ²): three
    // exponentials in place of twelve.
    let square = CENTROID_WEIGHT_SIGMA * CENTROID_WEIGHT_SIGMA;
    let mut value = (-0.5 * first * first / square).exp();
    let mut factor = (-(first + 0.5) / square).exp();
    let ratio = (-1.0 / square).exp();
    std::array::from_fn(|_| {
        let here = value;
        value *= factor;
        factor *= ratio;
        here
    })
}

// σ of the weight in pixels. Chosen by hand.
const SIZE_WEIGHT_SIGMA: f64 = 5.0;
// σ of the weight of cores in pixels. Chosen by hand.
const CORE_SIGMA: f64 = 1.0;
// 5σ: exp(−12.5) = 4·10⁻⁶.
pub(crate) const CORE_RADIUS_PX: f64 = 5.0 * CORE_SIGMA;
// Width of the border whose mean is the sky, in pixels. Chosen by hand.
const BORDER: usize = 2;
// At S/N 10, thirty stamps give the mean square radius to a tenth. Command and seed not recorded.
const MIN_STAMPS: usize = 30;
// Times the median by which one stamp may count, so that outliers do not matter; no simulated galaxy exceeds it. Chosen
// by hand.
const MAX_TIMES_MEDIAN: f64 = 4.0;

/// The core of a galaxy or PSF, as of a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CoreSize {
    /// Mean square radius per axis and its standard error, in px².
    pub(crate) mean_square_radius: f64,
    pub(crate) error: f64,
}

impl CoreSize {
    pub(crate) fn from_weighted(q: f64, error: f64) -> Option<CoreSize> {
        let mean_square_radius = without_weight(q, CORE_SIGMA)?;
        error.is_finite().then(|| CoreSize {
            mean_square_radius,
            error: error * (mean_square_radius / q).powi(2),
        })
    }

    pub(crate) fn fwhm(&self) -> f64 {
        (8.0 * std::f64::consts::LN_2 * self.mean_square_radius).sqrt()
    }
}

/// Σ W I and Σ W r² I under the narrow weight about `centre`, (x, y) in pixels from the stamp's centre.
pub(crate) fn core_sums(
    value: impl Fn(usize, usize) -> f64,
    sides: [usize; 2],
    centre: [f64; 2],
) -> [f64; 2] {
    let at = [0, 1].map(|k| (sides[k] as f64 - 1.0) / 2.0 + centre[k]);
    let range = |k: usize| {
        let first = (at[k] - CORE_RADIUS_PX).ceil().max(0.0) as usize;
        let last = (at[k] + CORE_RADIUS_PX).floor().max(0.0) as usize;
        first..(last + 1).min(sides[k])
    };
    let weight = |at: usize, centre: f64| {
        let square = (at as f64 - centre).powi(2);
        ((-0.5 * square / (CORE_SIGMA * CORE_SIGMA)).exp(), square)
    };
    let mut along_x = [(0.0, 0.0); 2 * CORE_RADIUS_PX as usize + 1];
    for (weights, x) in along_x.iter_mut().zip(range(0)) {
        *weights = weight(x, at[0]);
    }
    let mut sums = [0.0; 2];
    for y in range(1) {
        let (down, square_y) = weight(y, at[1]);
        for (x, (weight, square_x)) in range(0).zip(along_x) {
            let light = down * weight * value(x, y);
            sums[0] += light;
            sums[1] += (square_x + square_y) * light;
        }
    }
    sums
}

/// The core of a PSF stamp with its star at `centre`, a background of `level` and noise of `sigma` per pixel.
pub(crate) fn psf_core_size(
    psf: ArrayView2<'_, f64>,
    centre: [f64; 2],
    level: f64,
    sigma: f64,
) -> Option<CoreSize> {
    let sides = [psf.ncols(), psf.nrows()];
    let [light, squares] = core_sums(|x, y| psf[(y, x)] - level, sides, centre);
    let q = 0.5 * squares / light;
    // Var(Σ W (r²/2 − q) n) = σ² ∫ W² (r²/2 − q)² d²x, where W² is a Gaussian of half the variance.
    let half = CORE_SIGMA * CORE_SIGMA / 2.0;
    let spread = 2.0 * half * half - 2.0 * half * q + q * q;
    let variance = std::f64::consts::PI * CORE_SIGMA * CORE_SIGMA * spread;
    CoreSize::from_weighted(q, sigma * variance.sqrt() / light.abs())
}

/// The mean square radius of light whose mean square under a weight of σ is `q`; `None` if it is not positive.
fn without_weight(q: f64, sigma: f64) -> Option<f64> {
    let square = 1.0 / (1.0 / q - 1.0 / (sigma * sigma));
    (square > 0.0 && square.is_finite()).then_some(square)
}

/// Buffers for moments under the wide weight.
#[derive(Debug, Clone, Default)]
pub(crate) struct WeightedMoments {
    /// Sides and centre of the last stamp.
    last: Option<([usize; 2], [f64; 2])>,
    /// Its W and x² of each column, and W and y² of each row.
    columns: Vec<[f64; 2]>,
    rows: Vec<[f64; 2]>,
    /// Of each column, the sums over rows of W I and W y² I.
    light: Vec<f64>,
    squares: Vec<f64>,
}

impl WeightedMoments {
    /// Σ W I and Σ W r² I of `sides` = [columns, rows] pixels less a sky, about `centre`.
    fn sums<P: Pixel, R: AsRef<[P]>>(
        &mut self,
        sides: [usize; 2],
        centre: [f64; 2],
        sky: f64,
        pixels: impl Iterator<Item = R>,
    ) -> [f64; 2] {
        // Most stamps of an image have the same sides and centre, and exponentials are slow.
        if self.last != Some((sides, centre)) {
            self.last = Some((sides, centre));
            for (axis, weights) in [&mut self.columns, &mut self.rows].into_iter().enumerate() {
                let middle = (sides[axis] as f64 - 1.0) / 2.0;
                weights.clear();
                weights.extend((0..sides[axis]).map(|at| {
                    let square = (at as f64 - middle - centre[axis]).powi(2);
                    let weight = (-0.5 * square / (SIZE_WEIGHT_SIGMA * SIZE_WEIGHT_SIGMA)).exp();
                    [weight, square]
                }));
            }
        }
        for sums in [&mut self.light, &mut self.squares] {
            sums.clear();
            sums.resize(sides[0], 0.0);
        }
        for (row, &weights) in pixels.zip(&self.rows) {
            let row = row.as_ref();
            add_row(row, sky, weights, &mut self.light, &mut self.squares);
        }
        let mut sums = [0.0; 2];
        let columns = self.light.iter().zip(&self.squares);
        for ((light, squares), [weight, square]) in columns.zip(&self.columns) {
            sums[0] += weight * light;
            sums[1] += weight * (squares + square * light);
        }
        sums
    }

    /// The mean square radius of a PSF in px²; `None` if it is not positive.
    pub(crate) fn psf_mean_square(&mut self, psf: ArrayView2<'_, f64>) -> Option<f64> {
        let rows = psf.into_outer_iter().map(contiguous);
        let sides = [psf.ncols(), psf.nrows()];
        mean_square(self.sums::<f64, _>(sides, [0.0; 2], 0.0, rows))
    }
}

fn mean_square([light, squares]: [f64; 2]) -> Option<f64> {
    without_weight(0.5 * squares / light, SIZE_WEIGHT_SIGMA)
}

/// Adds a row to the sums of all columns, which are side by side so that no addition waits for the one before.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_row<P: Pixel>(
    row: &[P],
    sky: f64,
    [weight, square]: [f64; 2],
    light: &mut [f64],
    squares: &mut [f64],
) {
    for ((light, squares), value) in light.iter_mut().zip(squares).zip(row) {
        let value = weight * (Into::<f64>::into(*value) - sky);
        *light += value;
        *squares += square * value;
    }
}

#[derive(Debug, Clone, Default)]
pub(crate) struct GalaxyMoments {
    /// Σ W I and Σ W r² I of each stamp.
    stamps: Vec<[f64; 2]>,
    moments: WeightedMoments,
}

impl GalaxyMoments {
    /// Adds a stamp of `n` × `n` pixels with a galaxy in its middle.
    pub(crate) fn add(&mut self, pixels: &[f32], n: usize) {
        let (mut sum, mut count) = (0.0, 0.0);
        for value in frame(pixels, n, BORDER).flatten() {
            sum += f64::from(*value);
            count += 1.0;
        }
        // The sky of each stamp: the plane of the image is subtracted only where it matters to shapes.
        let rows = pixels.chunks_exact(n);
        let sums = self.moments.sums([n; 2], [0.0; 2], sum / count, rows);
        self.stamps.push(sums);
    }

    /// Adds the stamps of the next part of the image.
    pub(crate) fn join(&mut self, other: &Self) {
        self.stamps.extend_from_slice(&other.stamps);
    }

    /// The mean square radius of the galaxies behind the PSF, in px²; `None` of few stamps, and if it is not positive.
    pub(crate) fn mean_square_radius(&self) -> Option<f64> {
        if self.stamps.len() < MIN_STAMPS {
            return None;
        }
        let largest = [0, 1].map(|k| {
            let mut moduli: Vec<f64> = self.stamps.iter().map(|sums| sums[k].abs()).collect();
            MAX_TIMES_MEDIAN * upper_median(&mut moduli).unwrap_or(f64::NAN)
        });
        let mut sums = [0.0; 2];
        for stamp in &self.stamps {
            let share = (largest[0] / stamp[0].abs()).min(largest[1] / stamp[1].abs());
            // NaN of a blank stamp.
            let share = if share < 1.0 { share } else { 1.0 };
            sums[0] += share * stamp[0];
            sums[1] += share * stamp[1];
        }
        mean_square(sums)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::testing::close;

    const N: usize = 48;

    /// A galaxy that is the same turned by 180 degrees about its centre, (0.5, −0.5) px off the middle.
    fn galaxy() -> Vec<f32> {
        let pixel = |at: usize| {
            let (x, y) = ((at % N) as f32 - 24.0, (at / N) as f32 - 23.0);
            30.0 * (-(x * x + 0.5 * x * y + 1.5 * y * y) / 20.0).exp()
        };
        (0..N * N).map(pixel).collect()
    }

    fn mended(missing: impl IntoIterator<Item = (usize, usize)>) -> Option<Vec<f32>> {
        let mut stamp = galaxy();
        for (x, y) in missing {
            stamp[y * N + x] = f32::NAN;
        }
        // What was found before does not matter.
        let mut dirty = MissingPixels::new(N);
        dirty.fill(&mut [f32::INFINITY; 49], 7);
        dirty.fill(&mut stamp, N).then_some(stamp)
    }

    #[test]
    fn missing_pixels_are_filled_from_the_opposite_side() {
        let whole = galaxy();
        let patch = (27..31).flat_map(|x| (22..25).map(move |y| (x, y)));
        let edge = (0..4).flat_map(|x| (0..N).map(move |y| (x, y)));
        let corners = [(0, 0), (47, 47), (2, 41), (47, 2)];
        for found in [
            mended(patch),
            mended(edge),
            mended(corners),
            mended([(24, 21)]),
        ] {
            let found = found.unwrap();
            let worst = found.iter().zip(&whole).map(|(a, b)| (a - b).abs());
            // The centre lies on half pixels, to which it is rounded.
            assert!(worst.fold(0.0, f32::max) < 1e-3);
        }
        assert_eq!(mended([]).unwrap(), whole);
    }

    #[test]
    fn holes_that_hide_the_galaxy_are_refused() {
        // Opposite patches near the centre at (24, 23), and away from it; of single pixels the mean of those around.
        let patches = |dx: usize| {
            let patch = (0..9).map(move |k| (24 + dx + k % 3, 19 + k / 3));
            patch.flat_map(|(x, y)| [(x, y), (48 - x, 46 - y)])
        };
        assert!(mended(patches(3)).is_none());
        assert!(mended(patches(14)).is_some());
        let found = mended([(27, 20), (21, 26)]).unwrap();
        let (worst, light) = (
            found[20 * N + 27] - galaxy()[20 * N + 27],
            galaxy()[20 * N + 27],
        );
        assert!(worst.abs() < 0.1 * light, "{worst} of {light}");
        // A row through the centre.
        assert!(mended((0..N).map(|x| (x, 23))).is_none());
        let square =
            |side: usize| (0..side).flat_map(move |x| (0..side).map(move |y| (26 + x, 22 + y)));
        assert!(mended(square(4)).is_some());
        assert!(mended(square(5)).is_none());
        // Columns on both sides away from the centre.
        let both = |from: usize, count: usize| {
            let columns = (from..from + count).flat_map(|x| [x, 48 - x]);
            columns.flat_map(|x| (0..N).map(move |y| (x, y)))
        };
        assert!(mended(both(6, 3)).is_none());
        assert!(mended((0..20).map(|y| (7 + y % 2, 2 + y))).is_some());
        // Bars of one column on opposite sides, whose ends have enough neighbours: at most a fiftieth of the stamp may become zero.
        let bars = |length: usize| (0..length).flat_map(|y| [(6, 9 + y), (42, 37 - y)]);
        assert!(mended(bars(20)).is_some());
        assert!(mended(bars(28)).is_none());
        // More than a quarter of the stamp.
        let most = |columns: usize| (0..columns).flat_map(|x| (0..N).map(move |y| (x, y)));
        assert!(mended(most(12)).is_some());
        assert!(mended(most(13)).is_none());
    }

    const SMALL: usize = 8;

    fn stamp() -> Vec<f32> {
        (0..SMALL * SMALL).map(|at| at as f32).collect()
    }

    #[test]
    fn rows_and_columns_of_padding_are_counted_from_each_edge() {
        let mut stamp = stamp();
        stamp[..2 * SMALL].fill(1.0);
        (0..SMALL).for_each(|y| stamp[y * SMALL + SMALL - 3..(y + 1) * SMALL].fill(1.0));
        assert_eq!(padding(&stamp, SMALL), [2, 0, 0, 3]);
    }

    #[test]
    fn padding_at_one_of_opposite_edges_is_missing() {
        let (mut corner, mut around) = (stamp(), stamp());
        assert!(!mark_padding_missing(&mut corner, SMALL));
        corner[(SMALL - 2) * SMALL..].fill(0.0);
        (0..SMALL).for_each(|y| corner[y * SMALL] = 0.0);
        assert!(mark_padding_missing(&mut corner, SMALL));
        for (at, value) in corner.iter().enumerate() {
            let missing = at / SMALL >= SMALL - 2 || at % SMALL == 0;
            assert_eq!(value.is_nan(), missing, "{at}");
        }
        // The light of a small galaxy without noise ends before all edges.
        for at in (0..SMALL * SMALL).filter(|at| {
            [0, SMALL - 1].contains(&(at / SMALL)) || [0, SMALL - 1].contains(&(at % SMALL))
        }) {
            around[at] = 0.0;
        }
        assert!(!mark_padding_missing(&mut around, SMALL));
    }

    #[test]
    fn centroids_of_galaxies_are_found() {
        for (x, y) in [(0.0, 0.0), (1.0, -0.5), (-3.0, 1.5), (0.3, 4.0)] {
            let stamp: Vec<f32> = (0..N * N)
                .map(|at| {
                    let (dx, dy) = ((at % N) as f32 - 23.5 - x, (at / N) as f32 - 23.5 - y);
                    10.0 * (-(dx * dx + dy * dy) / 18.0).exp()
                })
                .collect();
            let found = galaxy_centroid(&stamp, N);
            // For a Gaussian of 3 px a step goes 1.5 · 4/(4 + 9) of the way; three of them leave 0.16 of it.
            let rest = (found[0] - x).hypot(found[1] - y);
            assert!(rest < 0.16 * x.hypot(y) + 0.01, "{found:?} {x} {y}");
        }
        assert_eq!(galaxy_centroid(&[-1.0; N * N], N), [0.0; 2]);
        assert_eq!(shear_origin(&[-1.0; N * N], N, 1.0), [0.0; 2]);
    }

    #[test]
    fn noisy_centroids_are_no_origins_of_shear() {
        let stamp: Vec<f32> = (0..N * N)
            .map(|at| 1.0 + 0.01 * ((at % N) as f32 - 23.5))
            .collect();
        let centroid = galaxy_centroid(&stamp, N)[0];
        assert!(centroid > 0.05);
        // About one per pixel has a light of 2πσ² under the weight.
        let noise = |snr: f64| 2.0 * std::f64::consts::PI.sqrt() * CENTROID_WEIGHT_SIGMA / snr;
        for (snr, share) in [
            (f64::INFINITY, 1.0),
            (HALF_CENTROID_SNR, 0.5),
            (10.0, 1.0 / 82.0),
        ] {
            let found = shear_origin(&stamp, N, noise(snr))[0] / centroid;
            // The stamp is a little brighter about the centroid.
            assert!((found / share - 1.0).abs() < 0.06, "{snr}: {found}");
        }
    }

    /// A Gaussian of mean square `square` per axis, off the middle.
    fn gaussian(square: f64, centre: [f64; 2]) -> Array2<f64> {
        Array2::from_shape_fn((N, N), |(y, x)| {
            let (x, y) = (x as f64 - 23.5 - centre[0], y as f64 - 23.5 - centre[1]);
            (-0.5 * (x * x + y * y) / square).exp() / square
        })
    }

    fn of_stamps(count: usize, level: f64, sky: f64, square: f64) -> Option<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let mut light = GalaxyMoments::default();
        for _ in 0..count {
            let stamp: Vec<f32> = gaussian(square, [0.0; 2])
                .iter()
                .map(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    (value + level * noise + sky) as f32
                })
                .collect();
            light.add(&stamp, N);
        }
        light.mean_square_radius()
    }

    #[test]
    fn the_mean_square_radius_of_a_gaussian_is_its_variance() {
        for square in [3.0, 10.0, 20.0] {
            for sky in [0.0, 0.5] {
                let found = of_stamps(MIN_STAMPS, 0.0, sky, square).unwrap();
                // The frame holds 10⁻⁴ of the light of the broadest.
                assert!((found / square - 1.0).abs() < 2e-3, "{square} {found}");
            }
            let psf = WeightedMoments::default().psf_mean_square(gaussian(square, [0.0; 2]).view());
            let psf = psf.unwrap();
            assert!((psf / square - 1.0).abs() < 1e-3, "{square} {psf}");
        }
    }

    #[test]
    fn the_core_of_a_gaussian_is_its_variance_within_its_error() {
        for square in [2.0, 6.0] {
            let psf = gaussian(square, [0.3, -0.2]);
            let core = psf_core_size(psf.view(), [0.3, -0.2], 0.0, 0.0).unwrap();
            close(core.mean_square_radius / square, 1.0, 1e-3);
            // The mean square of errors is that of 300 fields of noise, to a tenth.
            let (sigma, mut rng) = (0.01, ChaCha8Rng::seed_from_u64(4));
            let square = (0..300).map(|_| {
                let noisy = psf.mapv(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    value + sigma * noise
                });
                let found = psf_core_size(noisy.view(), [0.3, -0.2], 0.0, sigma).unwrap();
                ((found.mean_square_radius - square) / found.error).powi(2)
            });
            let square = square.sum::<f64>() / 300.0;
            assert!((0.7..1.4).contains(&square), "{square} {square}");
        }
    }

    #[test]
    fn noise_averages_away_and_few_stamps_are_refused() {
        // S/N √(Σ I²)/σ of 10.
        let square = 12.0;
        let level = (std::f64::consts::PI * square).sqrt() / square / 10.0;
        let found = of_stamps(1000, level, 0.0, square).unwrap();
        // A tenth from thirty stamps is 0.02 from a thousand.
        assert!((found / square - 1.0).abs() < 0.06, "{found}");
        assert!(of_stamps(MIN_STAMPS - 1, 0.0, 0.0, square).is_none());
        assert!(of_stamps(MIN_STAMPS, 0.0, 0.0, -1.0).is_none());
    }

    #[test]
    fn a_bright_stamp_counts_as_four_in_the_mean_radius() {
        let mean = |count: usize| {
            let mut galaxies = GalaxyMoments {
                stamps: vec![[1.0, 8.0]; count],
                ..GalaxyMoments::default()
            };
            galaxies.stamps[0] = [100.0, 800.0];
            galaxies.stamps[1] = [1.0, 80.0];
            galaxies.mean_square_radius()
        };
        assert_eq!(mean(29), None);
        // The second of ten times the width counts with 0.4 of its light, and four times its moment.
        let expected = mean_square([28.0 + 4.0 + 0.4, 8.0 * (28.0 + 4.0 + 4.0)]);
        let [found, expected] = [mean(30), expected].map(Option::unwrap);
        assert!((found / expected - 1.0).abs() < 1e-12, "{found} {expected}");
    }
}
