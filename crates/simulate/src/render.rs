//! Noise-free stamps of PSF-convolved galaxies, integrated over pixels.
//!
//! The image is a sum over wavenumbers 2π/N · (i, j) of galaxy × PSF × pixel. It repeats every N pixels: light from the
//! repeated images folds into the stamp where N is small. [`Renderer::render`] chooses N and the largest wavenumber for
//! each galaxy so that neither is seen; [`render_reference`] reads like the equation and is the oracle of its tests.
//!
//! So few of the wavenumbers have light that their sums take less time as products with small tables than as fast
//! transforms ([`shearq_quantities::linear`]). Positions are counted from the stamp's middle, where cosines are even and
//! sines are odd: one half of the stamp gives the other. At the centres of pixels, wavenumbers that differ by 2π are the
//! same wave, so those beyond π are added onto those within (that is what sampling does to real light, too).

use std::f64::consts::{PI, TAU};

use ndarray::Array2;
use shearq_quantities::fourier::Complex64;
use shearq_quantities::linear::{LANES, Matrix, ROWS, multiply};
use shearq_quantities::radial::{QuadraticForm, SingleTable};
use shearq_quantities::{FunctionalPsf, Pupil, TransformedPsf};

use super::galaxy::{Component, Galaxy};

mod lines;
mod phases;

use self::lines::{
    Wave, add_reversed, add_times, form_in_steps, shift, shine, tabulate, unfold_pixels,
    unfold_rows,
};
use self::phases::Phases;

// Wavenumbers are dropped where galaxy × PSF × pixel is below this share of the flux. The image loses about
// 1/(2π) ∫ k |F| dk over them; in a PSF's exponential tail near k = 3.5 that is a fifth of it, against a peak pixel of some
// 2e-2 of the flux.
const SPECTRUM_TOLERANCE: f64 = 6e-6;

// Light that may fold into the nearest corner of the stamp, relative to the galaxy's peak. Chosen by hand, below the 1e-4 of the
// peak that `render` promises.
const FOLDING_TOLERANCE: f64 = 3e-5;

// In units of π. Only PSFs with a FWHM near one pixel reach it.
const MAX_ORDER: usize = 3;

// Periods tried, smallest first, in thirds of the stamp's size, or of 16 px if it is smaller. Chosen by hand.
const PERIODS_IN_THIRDS: [usize; 7] = [5, 6, 7, 8, 10, 12, 24];

/// Draws galaxies on square stamps of one size.
///
/// It holds the tables of cosines and sines and is shared between threads; what changes with a galaxy
/// is in the caller's [`RenderScratch`].
#[derive(Debug)]
pub struct Renderer {
    stamp: usize,
    grids: Vec<Grid>,
}

/// One period of the image, in pixels, and the wavenumbers 2πj/N that belong to it.
#[derive(Debug)]
struct Grid {
    /// N. It is even, and N/2 + 1 is a multiple of eight.
    size: usize,
    /// Half of the stamp, its middle included, and padded to rows of a product.
    rows: usize,
    /// Half of the stamp, padded to lanes of a product.
    width: usize,
    /// Factor of a wave if its wavenumber changes by 2π. Positions in the stamp are half pixels from the
    /// middle if its side is even.
    turn: f32,
    /// cos(2πjd/N) at distances d from the middle, and the same of sines. Rows are d, and are padded to lanes.
    cosines: Vec<f32>,
    sines: Vec<f32>,
    /// The same, rows are j. Sines have the opposite sign.
    cosines_across: Vec<f32>,
    sines_across: Vec<f32>,
    /// sin(k/2)/(k/2), a pixel's transform along one axis, at k = 2πj/N; half at 0, because this wavenumber has no
    /// opposite one that it stands for.
    pixel: Vec<f32>,
}

/// Work space of [`Renderer::render`], for any renderer and any galaxy. Its contents do not
/// influence the result.
#[derive(Debug, Default)]
pub struct RenderScratch {
    /// Light at one ky and at its opposite.
    lines: [Vec<f32>; 2],
    /// Sum of both, and their difference times i, with the phases of the shift: real parts before imaginary parts.
    pair: [Vec<f32>; 2],
    /// The same for all ky, which are rows, with wavenumbers beyond π added onto those within.
    sums: Vec<f32>,
    differences: Vec<f32>,
    /// Even and odd parts of the transformed rows.
    even: Vec<f32>,
    odd: Vec<f32>,
    /// Real and imaginary parts after the transform along y; rows are y.
    along_y: [Vec<f32>; 2],
    transfers: Vec<Transfer>,
    phases: Phases,
}

/// PSF × pixel, of the PSF that was used last: galaxies of an image often share it.
#[derive(Debug, Default)]
struct Transfer {
    of: Option<(FunctionalPsf, Option<Pupil>, usize)>,
    /// Wavenumbers along an axis. Lines of kx are at ky from 0, and after them at ky from 0 downwards.
    count: usize,
    lines: Vec<f32>,
    /// How many of the line of each |ky| are known.
    known: Vec<usize>,
}

impl Transfer {
    /// Drops the cached PSF unless it is `psf` with a period of `size`, and `count` wavenumbers have room.
    fn prepare(&mut self, psf: &TransformedPsf<'_>, size: usize, count: usize) {
        let of = Some((psf.functional(), psf.pupil(), size));
        if self.of == of && count <= self.count {
            return;
        }
        self.of = of;
        self.count = count;
        self.lines.resize(2 * count * count, 0.0);
        self.known.clear();
        self.known.resize(count, 0);
    }

    /// PSF × pixel at wavenumbers `j` and -`j` along y and the first `lit` along x; `form` is the PSF's in
    /// wavenumbers.
    fn lines(
        &mut self,
        table: SingleTable<'_>,
        form: QuadraticForm,
        (j, lit): (usize, usize),
        pixel: &[f32],
    ) -> [&[f32]; 2] {
        let (above, below) = self.lines.split_at_mut(self.count * self.count);
        let [above, below] = [above, below].map(|lines| &mut lines[j * self.count..][..lit]);
        if self.known[j] < lit {
            let pixel_y = pixel[j];
            tabulate(table, form, j as f32, pixel_y, pixel, above);
            tabulate(table, form, -(j as f32), pixel_y, pixel, below);
            self.known[j] = lit;
        }
        [above, below]
    }
}

impl RenderScratch {
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
        let grids =
            PERIODS_IN_THIRDS.map(|thirds| Grid::new((stamp.max(16) * thirds).div_ceil(3), stamp));
        Renderer {
            stamp,
            grids: grids.into(),
        }
    }

    /// Draws `galaxy`, convolved with `psf` and integrated over pixels, into `out`, a stamp in
    /// row-major order (rows are y). Called in parallel: it is serial, and takes no memory once
    /// `scratch` has grown.
    ///
    /// `centre` is the galaxy's centre in 0-based pixel-centre coordinates: (23.5, 23.5) is the
    /// corner of the four central pixels of a 48 × 48 stamp. The centre should lie in the stamp.
    /// The sum of `out` is the flux less the light outside the stamp. Errors are near 1e-4 of the
    /// peak or less; the period grows with galaxies whose wings would fold, up to eight stamps. PSFs and galaxies below
    /// a pixel have light beyond the largest wavenumber.
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
        let at = self.choose_grid(galaxy, psf, centre);
        let grid = &self.grids[at];
        scratch
            .transfers
            .resize_with(self.grids.len(), Transfer::default);
        let modes = grid.fill(self.stamp, galaxy, psf, centre, scratch, at);
        grid.transform(self.stamp, modes, scratch, out);
    }

    fn choose_grid(&self, galaxy: &Galaxy, psf: &TransformedPsf<'_>, centre: (f64, f64)) -> usize {
        let limit = FOLDING_TOLERANCE * rough_peak(galaxy, psf);
        let last = (self.stamp - 1) as f64;
        let reach = |c: f64| c.max(last - c);
        let offset = |of: fn(&Component) -> f64| -> f64 {
            let all = galaxy.components().iter();
            all.map(|c| of(c).abs()).fold(0.0, f64::max)
        };
        let reach = (
            reach(centre.0) + offset(|c| c.dx),
            reach(centre.1) + offset(|c| c.dy),
        );
        let largest = self.grids.len() - 1;
        self.grids[..largest]
            .iter()
            .position(|grid| folded_light(galaxy, psf, grid.size as f64, reach) <= limit)
            .unwrap_or(largest)
    }
}

impl Grid {
    /// For a period near `period` pixels, at most 3 shorter.
    fn new(period: usize, stamp: usize) -> Self {
        let modes = (period / 2).next_multiple_of(8);
        let padded = modes.next_multiple_of(LANES);
        let size = 2 * (modes - 1);
        let half = stamp.div_ceil(2);
        let (rows, width) = (half.next_multiple_of(ROWS), half.next_multiple_of(LANES));
        let even = stamp.is_multiple_of(2);
        let step = TAU / size as f64;
        let angle =
            |row: usize, j: usize| step * j as f64 * (row as f64 + if even { 0.5 } else { 0.0 });
        let table = |lines: usize, places: usize, value: &dyn Fn(usize, usize) -> f64| {
            let values = (0..lines * places).map(|at| value(at / places, at % places) as f32);
            values.collect::<Vec<f32>>()
        };
        let count = (MAX_ORDER * size / 2 + 1).next_multiple_of(LANES);
        let pixel = |j: usize| if j == 0 { 0.5 } else { sinc(step * j as f64) };
        Grid {
            size,
            rows,
            width,
            turn: if even { -1.0 } else { 1.0 },
            cosines: table(rows, padded, &|row, j| angle(row, j).cos()),
            sines: table(rows, padded, &|row, j| angle(row, j).sin()),
            cosines_across: table(modes, width, &|j, row| angle(row, j).cos()),
            sines_across: table(modes, width, &|j, row| -angle(row, j).sin()),
            pixel: table(1, count, &|_, j| pixel(j)),
        }
    }

    /// Wavenumbers from 0 to π.
    fn modes(&self) -> usize {
        self.size / 2 + 1
    }

    /// Where wavenumber `j` is added: the place within π, whether it is the opposite one, and the factor.
    fn place(&self, j: usize) -> (usize, bool, f32) {
        let (turns, rest) = (j / self.size, j % self.size);
        let opposite = rest > self.size / 2;
        let turns = turns + usize::from(opposite);
        let factor = if turns % 2 == 1 { self.turn } else { 1.0 };
        let rest = if opposite { self.size - rest } else { rest };
        (rest, opposite, factor)
    }

    /// Puts galaxy × PSF × pixel × shift into `scratch`, ready to be transformed along y. Returns the number of
    /// wavenumbers along an axis.
    fn fill(
        &self,
        stamp: usize,
        galaxy: &Galaxy,
        psf: &TransformedPsf<'_>,
        centre: (f64, f64),
        scratch: &mut RenderScratch,
        at: usize,
    ) -> usize {
        let step = TAU / self.size as f64;
        let cut = largest_wavenumber(galaxy, psf).min(MAX_ORDER as f64 * PI) / step;
        let last = (cut as usize).min(MAX_ORDER * self.size / 2);
        // Whole lanes, so that a few wavenumbers beyond the largest have their light too.
        let count = (last + 1).next_multiple_of(LANES);
        let lit = |j: usize| {
            let beside = (cut * cut - (j * j) as f64).max(0.0).sqrt() as usize + 1;
            beside.next_multiple_of(LANES).min(count)
        };
        let middle = (stamp as f64 - 1.0) / 2.0;
        // Each pair of opposite wave vectors is one, and the sum is over the square of the period.
        let norm = 2.0 / (self.size * self.size) as f32;

        let RenderScratch {
            lines: [above, below],
            pair,
            sums,
            differences,
            transfers,
            phases,
            ..
        } = scratch;
        let transfer = &mut transfers[at];
        let modes = (last + 1).min(self.modes());
        let width = 2 * modes.next_multiple_of(LANES);
        for all in [&mut *sums, &mut *differences] {
            all.clear();
            all.resize(modes * width, 0.0);
        }
        above.resize(count, 0.0);
        below.resize(count, 0.0);
        for half in &mut *pair {
            half.resize(2 * count, 0.0);
        }
        transfer.prepare(psf, self.size, count);
        let psf_form = form_in_steps(psf.shape, psf.fwhm, step);
        let psf_table = psf.transform.table().single();
        for group in groups(galaxy) {
            let (x, y) = (centre.0 + group[0].dx, centre.1 + group[0].dy);
            phases.set(step, count, x - middle, y - middle);
            let waves: [Option<Wave>; Galaxy::MAX_COMPONENTS] =
                std::array::from_fn(|k| group.get(k).map(|c| Wave::new(c, step)));
            for j in 0..=last {
                let lit = lit(j);
                let blur = transfer.lines(psf_table, psf_form, (j, lit), &self.pixel);
                let (above, below) = (&mut above[..lit], &mut below[..lit]);
                shine(&waves, j as f32, blur[0], above);
                shine(&waves, -(j as f32), blur[1], below);
                let [sum, difference] = pair.each_mut().map(|half| &mut half[..2 * lit]);
                let shifted = [&mut *sum, &mut *difference];
                shift(above, below, phases, phases.y[j] * norm, shifted);

                let (row, opposite, factor) = self.place(j);
                let row = row * width..(row + 1) * width;
                self.add(sum, factor, &mut sums[row.clone()]);
                let factor = if opposite { -factor } else { factor };
                self.add(difference, factor, &mut differences[row]);
            }
        }
        modes
    }

    /// Adds wavenumbers from 0 along x to those within π: real parts before imaginary parts, times a factor.
    fn add(&self, line: &[f32], factor: f32, to: &mut [f32]) {
        let (re, im) = line.split_at(line.len() / 2);
        let (to_re, to_im) = to.split_at_mut(to.len() / 2);
        let mut from = 0;
        // Parts without a jump.
        while from < re.len() {
            let (place, opposite, turn) = self.place(from);
            let factor = turn * factor;
            let room = if opposite {
                place
            } else {
                self.modes() - place
            };
            let part = from..re.len().min(from + room);
            from = part.end;
            if opposite {
                // The complex conjugate of the opposite wave vector.
                let places = place + 1 - part.len()..place + 1;
                add_reversed(&re[part.clone()], factor, &mut to_re[places.clone()]);
                add_reversed(&im[part], -factor, &mut to_im[places]);
            } else {
                let places = place..place + part.len();
                add_times(&re[part.clone()], factor, &mut to_re[places.clone()]);
                add_times(&im[part], factor, &mut to_im[places]);
            }
        }
    }

    /// Transforms the modes of [`Grid::fill`] to the image.
    fn transform(&self, stamp: usize, modes: usize, scratch: &mut RenderScratch, out: &mut [f32]) {
        let RenderScratch {
            sums,
            differences,
            even,
            odd,
            along_y,
            ..
        } = scratch;
        let pair = 2 * modes.next_multiple_of(LANES);
        let lines = stamp.next_multiple_of(ROWS);
        for half in [&mut *even, &mut *odd] {
            half.resize((self.rows * pair).max(lines * self.width), 0.0);
        }
        let (up, down) = (&mut even[..self.rows * pair], &mut odd[..self.rows * pair]);
        let padded = self.cosines.len() / self.rows;
        let cosines = Matrix::new(&self.cosines, padded);
        let sines = Matrix::new(&self.sines, padded);
        multiply(cosines, Matrix::new(sums, pair), modes, up, pair);
        multiply(sines, Matrix::new(differences, pair), modes, down, pair);
        // Whole rows of the next products. What is beyond the stamp stays finite, and is not used.
        let width = pair / 2;
        for (part, along_y) in along_y.iter_mut().enumerate() {
            along_y.resize(lines * width, 0.0);
            let columns = part * width..(part + 1) * width;
            unfold_rows(up, down, (pair, columns), &mut along_y[..stamp * width]);
        }

        let up = &mut even[..lines * self.width];
        let down = &mut odd[..lines * self.width];
        let cosines = Matrix::new(&self.cosines_across, self.width);
        let sines = Matrix::new(&self.sines_across, self.width);
        let [re, im] = along_y.each_ref().map(|part| Matrix::new(part, width));
        multiply(re, cosines, modes, up, self.width);
        multiply(im, sines, modes, down, self.width);
        unfold_pixels(up, down, (self.width, stamp), out);
    }
}

/// Components that share a centre: they share their phases and add up as real numbers.
fn groups(galaxy: &Galaxy) -> impl Iterator<Item = &[Component]> {
    galaxy
        .components()
        .chunk_by(|a, b| a.dx == b.dx && a.dy == b.dy)
}

/// The wavenumber (rad/px) beyond which galaxy × PSF × pixel is below the tolerance in all directions.
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
        // The sine of a pixel's transform changes sign.
        let pixel = f64::min(1.0, 2.0 / k);
        light * psf.transform.at(k * k * psf_scale) * pixel > limit
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
    let blur = psf.core();
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
    let wings = psf.wings(nearest(QuadraticForm::of_positions(psf.shape)));
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

/// The smallest of `sides` of a stamp, in rising order, beyond which a galaxy near its centre has no light that matters: the
/// nearest pixel outside of it has less than [`FOLDING_TOLERANCE`] of the peak.
pub(crate) fn stamp_side(
    galaxy: &Galaxy,
    psf: &TransformedPsf<'_>,
    sides: &[usize],
) -> Option<usize> {
    let limit = FOLDING_TOLERANCE * rough_peak(galaxy, psf);
    let is_enough = |side: usize| {
        // The centre may be half a pixel from the middle.
        let half = 0.5 * (side as f64 - 1.0);
        folded_light(galaxy, psf, 2.0 * half, (half, half)) <= limit
    };
    sides.iter().position(|side| is_enough(*side))
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
