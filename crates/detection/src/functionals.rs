//! Linear functionals of the deconvolved image about a pixel, their changes with shear, and the covariances of their noise.

use ndarray::ArrayView2;
use shearq_measure::StampNoise;
use shearq_quantities::PixelShape;
use shearq_quantities::fourier::{Complex64, Planner64};
use shearq_quantities::linear::{Matrix2, determinant};

use crate::weight::{COUNT, EXCESS, LIGHT, M00, M22, NEIGHBOURS, Square};

// Radius of the square of pixels under the functionals, in σ of their Gaussians. Weights beyond it are up to 2·10⁻³ of all, but of a
// blend behind Moffat PSFs of β = 2.5 and 3 and a Kolmogorov one they change the functionals by 10⁻⁶ of its light.
const KERNEL_SIGMAS: f64 = 6.5;
// Of the PSF's transform, below which modes are left out: rounding of single precision.
const MIN_TRANSFER: f64 = 1e-5;

/// Of each functional, with both components of shear after them: what a kernel is of.
pub(crate) const KERNELS: usize = 3 * COUNT;

/// Lengths in pixels.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lengths {
    pub(crate) detection_sigma: f64,
    pub(crate) moment_sigma: f64,
    pub(crate) distance: usize,
}

impl Lengths {
    /// Radius of the circle under the functionals, in the coordinates of [`PixelShape::map`].
    pub(crate) fn reach(&self) -> f64 {
        (KERNEL_SIGMAS * self.detection_sigma + self.distance as f64)
            .max(KERNEL_SIGMAS * self.moment_sigma)
    }

    /// Offsets of the neighbours in the coordinates of [`PixelShape::map`], along which the sky has no other direction: on a lattice of
    /// sheared pixels they would give round galaxies a mean shape.
    pub(crate) fn neighbours(&self) -> [[f64; 2]; NEIGHBOURS] {
        let d = self.distance as f64;
        [[d, 0.0], [-d, 0.0], [0.0, d], [0.0, -d]]
    }
}

/// The pixels of an exposure in the coordinates of functionals.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Axes {
    /// Shape of the pixels of the exposure on whose pixels the functionals are.
    pub(crate) pixels: PixelShape,
    /// From offsets in its pixels to those in pixels of this exposure.
    pub(crate) matrix: Matrix2,
}

impl Axes {
    /// Those of the exposure on whose pixels the functionals are.
    pub(crate) fn own(pixels: PixelShape) -> Self {
        Axes {
            pixels,
            matrix: [[1.0, 0.0], [0.0, 1.0]],
        }
    }

    /// Pixels of this exposure along the longer of its axes that a circle of this radius covers on each side of its centre.
    pub(crate) fn radius(&self, reach: f64) -> usize {
        let PixelShape { stretch, skew } = self.pixels;
        let along = |[x, y]: [f64; 2]| (x / stretch).hypot(stretch * y - skew * x);
        let longest = self.matrix.map(along).into_iter().fold(0.0, f64::max);
        (longest * reach).ceil() as usize
    }

    /// Area in pixels of this exposure of a pixel on which functionals are.
    fn area(&self) -> f64 {
        determinant(self.matrix).abs()
    }

    /// A wave vector in radians per pixel of this exposure, in the coordinates of [`PixelShape::map`].
    fn wave(&self, [kx, ky]: [f64; 2]) -> [f64; 2] {
        // k · x is the same in all coordinates.
        let [[xx, xy], [yx, yy]] = self.matrix;
        let [kx, ky] = [xx * kx + yx * ky, xy * kx + yy * ky];
        let PixelShape { stretch, skew } = self.pixels;
        [kx / stretch, stretch * ky - skew * kx]
    }
}

/// A factor of a filter at a mode, and its derivatives (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y).
#[derive(Clone, Copy)]
struct Factor {
    value: f64,
    slopes: [f64; 2],
}

impl Factor {
    const ONE: Factor = Factor {
        value: 1.0,
        slopes: [0.0; 2],
    };
}

/// A wave vector in the coordinates of [`PixelShape::map`], with its products.
#[derive(Clone, Copy)]
struct Wave {
    k: [f64; 2],
    square: f64,
    /// k_x² − k_y² and 2 k_x k_y.
    spin: [f64; 2],
}

impl Wave {
    /// That of a wave vector in radians per pixel.
    fn new(k: [f64; 2], axes: &Axes) -> Self {
        let k = axes.wave(k);
        Wave {
            k,
            square: k[0] * k[0] + k[1] * k[1],
            spin: [k[0] * k[0] - k[1] * k[1], 2.0 * k[0] * k[1]],
        }
    }

    /// The transform of a Gaussian.
    fn smoothed(&self, sigma: f64) -> f64 {
        (-0.5 * sigma * sigma * self.square).exp()
    }

    /// The filter of a factor under a Gaussian at a place, and those of its changes with shear: −(k_x ∂_x − k_y ∂_y) and
    /// −(k_y ∂_x + k_x ∂_y) of it.
    ///
    /// A shear about the pixel maps the image's transform at k to that at the sheared k. By a change of variables the filter is
    /// sheared the other way.
    fn filters(&self, factor: Factor, sigma: f64, at: [f64; 2]) -> [Complex64; 3] {
        let [kx, ky] = self.k;
        let phase = kx * at[0] + ky * at[1];
        let light = Complex64::from_polar(self.smoothed(sigma), phase);
        let phases = [kx * at[0] - ky * at[1], ky * at[0] + kx * at[1]];
        let change = |g: usize| {
            let real = factor.slopes[g] - factor.value * sigma * sigma * self.spin[g];
            -light * Complex64::new(real, factor.value * phases[g])
        };
        [light * factor.value, change(0), change(1)]
    }

    /// The filter of v₀, and those of its changes.
    fn light(&self, lengths: &Lengths) -> [Complex64; 3] {
        self.filters(Factor::ONE, lengths.detection_sigma, [0.0; 2])
    }

    /// The filters of all functionals, each with those of its changes.
    fn all(&self, lengths: &Lengths) -> [[Complex64; 3]; COUNT] {
        let (sigma, scale) = (lengths.moment_sigma, -lengths.moment_sigma.powi(2));
        // (k_x ∂_x − k_y ∂_y) of k_x² − k_y² is 2k², and so is (k_y ∂_x + k_x ∂_y) of 2 k_x k_y; the others vanish.
        let moment = |component: usize| {
            let mut slopes = [0.0; 2];
            slopes[component] = 2.0 * scale * self.square;
            let value = scale * self.spin[component];
            self.filters(Factor { value, slopes }, sigma, [0.0; 2])
        };
        let mut out = [[Complex64::default(); 3]; COUNT];
        let centre = self.light(lengths);
        out[LIGHT] = centre;
        for (j, at) in lengths.neighbours().into_iter().enumerate() {
            let beside = self.filters(Factor::ONE, lengths.detection_sigma, at);
            out[EXCESS + j] = [0, 1, 2].map(|k| centre[k] - beside[k]);
        }
        out[M00] = self.filters(Factor::ONE, sigma, [0.0; 2]);
        (out[M22], out[M22 + 1]) = (moment(0), moment(1));
        out
    }
}

/// Transforms of square images of real pixels.
pub(crate) struct SquareTransform {
    forward: shearq_quantities::fourier::Plan64,
    inverse: shearq_quantities::fourier::Plan64,
    pub(crate) side: usize,
}

impl std::fmt::Debug for SquareTransform {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SquareTransform")
            .field("side", &self.side)
            .finish_non_exhaustive()
    }
}

// Columns and rows that are transposed at a time: 4 KB of both images.
const BLOCK: usize = 16;

impl SquareTransform {
    pub(crate) fn new(side: usize) -> Self {
        let mut planner = Planner64::new();
        SquareTransform {
            forward: planner.forward(side),
            inverse: planner.inverse(side),
            side,
        }
    }

    /// Numbers that [`SquareTransform::forward`] needs beside the image.
    pub(crate) fn scratch(&self) -> usize {
        let lengths = [&self.forward, &self.inverse].map(|plan| plan.get_inplace_scratch_len());
        lengths[0].max(lengths[1])
    }

    /// Writes the transform of `image`, which is destroyed, to `out`: transposed, with k_x along its rows' index.
    pub(crate) fn forward(
        &self,
        image: &mut [Complex64],
        out: &mut [Complex64],
        scratch: &mut [Complex64],
    ) {
        self.forward.process_with_scratch(image, scratch);
        transpose(image, out, self.side);
        self.forward.process_with_scratch(out, scratch);
    }

    /// The opposite, without the division by the number of pixels. `transform` is destroyed.
    pub(crate) fn inverse(
        &self,
        transform: &mut [Complex64],
        out: &mut [Complex64],
        scratch: &mut [Complex64],
    ) {
        self.inverse.process_with_scratch(transform, scratch);
        transpose(transform, out, self.side);
        self.inverse.process_with_scratch(out, scratch);
    }

    /// The wave number of an index, in radians per pixel.
    fn wave_number(&self, index: usize) -> f64 {
        let signed = if 2 * index > self.side {
            index as f64 - self.side as f64
        } else {
            index as f64
        };
        std::f64::consts::TAU * signed / self.side as f64
    }

    /// Wave vectors in the order of a transform.
    fn waves(&self) -> impl Iterator<Item = [f64; 2]> {
        let side = self.side;
        (0..side)
            .flat_map(move |x| (0..side).map(move |y| [self.wave_number(x), self.wave_number(y)]))
    }
}

fn transpose(from: &[Complex64], to: &mut [Complex64], side: usize) {
    for y0 in (0..side).step_by(BLOCK) {
        for x0 in (0..side).step_by(BLOCK) {
            for x in x0..(x0 + BLOCK).min(side) {
                for y in y0..(y0 + BLOCK).min(side) {
                    to[x * side + y] = from[y * side + x];
                }
            }
        }
    }
}

/// One over the transform of a star of sum one about the centre of its stamp, at the modes of a transform; zero where the star has
/// no power.
fn inverse_transfer(star: ArrayView2<'_, f64>, transform: &SquareTransform) -> Vec<Complex64> {
    let side = transform.side;
    let mut padded = vec![Complex64::default(); side * side];
    let sum = star.sum();
    for ((y, x), value) in star.indexed_iter() {
        // A star that is larger than the transform has the same values at its modes.
        padded[y % side * side + x % side] += value / sum;
    }
    let mut out = vec![Complex64::default(); side * side];
    let mut scratch = vec![Complex64::default(); transform.scratch()];
    transform.forward(&mut padded, &mut out, &mut scratch);
    let centre = [star.ncols(), star.nrows()].map(|side| (side as f64 - 1.0) / 2.0);
    for (value, [kx, ky]) in out.iter_mut().zip(transform.waves()) {
        let transfer = *value * Complex64::cis(kx * centre[0] + ky * centre[1]);
        *value = if transfer.norm() > MIN_TRANSFER {
            transfer.inv()
        } else {
            Complex64::default()
        };
    }
    out
}

/// The filter of v₀ at the modes of a transform, with the division by the number of pixels.
pub(crate) fn light_filter(
    star: ArrayView2<'_, f64>,
    lengths: &Lengths,
    axes: &Axes,
    transform: &SquareTransform,
) -> Vec<Complex64> {
    let norm = axes.area() / (transform.side * transform.side) as f64;
    let mut filter = inverse_transfer(star, transform);
    for (value, k) in filter.iter_mut().zip(transform.waves()) {
        *value *= norm * Wave::new(k, axes).smoothed(lengths.detection_sigma);
    }
    filter
}

/// The same. Those of the neighbours follow if pixels are not square; otherwise neighbours are pixels.
pub(crate) fn light_filters(
    star: ArrayView2<'_, f64>,
    lengths: &Lengths,
    pixels: PixelShape,
    transform: &SquareTransform,
) -> Vec<Vec<Complex64>> {
    let axes = Axes::own(pixels);
    let mut filters = vec![light_filter(star, lengths, &axes, transform)];
    if !pixels.is_square() {
        for [x, y] in lengths.neighbours() {
            let waves = transform.waves().map(|k| axes.wave(k));
            let moved = filters[0].iter().zip(waves);
            let moved = moved.map(|(own, k)| own * Complex64::cis(k[0] * x + k[1] * y));
            filters.push(moved.collect());
        }
    }
    filters
}

/// The kernels of all functionals, and the covariances of their noise.
#[derive(Debug)]
pub(crate) struct Functionals {
    /// For each pixel of a square, row by row, the weights of all [`KERNELS`].
    pub(crate) kernels: Vec<[f32; KERNELS]>,
    pub(crate) covariances: Covariances,
}

/// Mean products of the noise of functionals.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Covariances {
    pub(crate) plain: Square,
    /// ⟨n_a′ n_b⟩ for both components of shear.
    pub(crate) sheared: [Square; 2],
    /// C behind the PSF, and of noise, turned by 90 degrees.
    pub(crate) turned: Square,
}

impl Covariances {
    const ZERO: Covariances = Covariances {
        plain: [[0.0; COUNT]; COUNT],
        sheared: [[[0.0; COUNT]; COUNT]; 2],
        turned: [[0.0; COUNT]; COUNT],
    };

    /// Those of sums of functionals of independent noise, each times its weight.
    pub(crate) fn of_sum<'a>(parts: impl Iterator<Item = (f64, &'a Self)>) -> Self {
        let mut sum = Covariances::ZERO;
        let add = |to: &mut Square, from: &Square, square: f64| {
            let pairs = to.as_flattened_mut().iter_mut().zip(from.as_flattened());
            pairs.for_each(|(to, from)| *to += square * from);
        };
        for (weight, own) in parts {
            let square = weight * weight;
            add(&mut sum.plain, &own.plain, square);
            add(&mut sum.turned, &own.turned, square);
            for g in 0..2 {
                add(&mut sum.sheared[g], &own.sheared[g], square);
            }
        }
        sum
    }
}

impl Functionals {
    /// The functionals behind a star in noise, from the square of 2 `radius` + 2 pixels whose pixel `radius` along both axes is the pixel itself.
    pub(crate) fn new(
        star: ArrayView2<'_, f64>,
        noise: &StampNoise,
        lengths: &Lengths,
        axes: &Axes,
        radius: usize,
    ) -> Self {
        let side = 2 * radius + 2;
        let transform = SquareTransform::new(
            (4 * radius)
                .max(star.nrows())
                .max(star.ncols())
                .next_power_of_two(),
        );
        let inverse = inverse_transfer(star, &transform);
        let n = transform.side;
        let (norm, area) = (1.0 / (n * n) as f64, axes.area());
        let filters = transform.waves().map(|k| Wave::new(k, axes).all(lengths));
        let filters: Vec<[[Complex64; 3]; COUNT]> = filters.collect();
        let mut kernels = vec![[0.0f32; KERNELS]; side * side];
        let mut plane = vec![Complex64::default(); n * n];
        let mut out = plane.clone();
        let mut scratch = vec![Complex64::default(); transform.scratch()];
        for kernel in 0..KERNELS {
            // The image at an offset d from the pixel enters with exp(−ik·d): the inverse transform at −d.
            for ((value, filters), inverse) in plane.iter_mut().zip(&filters).zip(&inverse) {
                *value = (filters[kernel % COUNT][kernel / COUNT] * inverse).conj();
            }
            transform.inverse(&mut plane, &mut out, &mut scratch);
            for (at, weights) in kernels.iter_mut().enumerate() {
                let [y, x] = [at / side, at % side].map(|at| (at + n - radius) % n);
                weights[kernel] = (area * norm * out[y * n + x].re) as f32;
            }
        }
        let mut covariances = Covariances::ZERO;
        let power = |k: [f64; 2]| {
            let (power, _) = noise.power(k, PixelShape::SQUARE);
            area * area * norm * noise.sigma().powi(2) * power
        };
        for ((filters, inverse), k) in filters.iter().zip(&inverse).zip(transform.waves()) {
            let power = power(k);
            let filters = filters.map(|own| own.map(|filter| filter * inverse));
            for a in 0..COUNT {
                for b in 0..COUNT {
                    let product = |k: usize| power * (filters[a][k] * filters[b][0].conj()).re;
                    covariances.plain[a][b] += product(0);
                    for g in 0..2 {
                        covariances.sheared[g][a][b] += product(1 + g);
                    }
                }
            }
        }
        covariances.turned = turned(&covariances.plain);
        Functionals {
            kernels,
            covariances,
        }
    }
}

/// Covariances behind a PSF and of noise that are turned by 90 degrees on the sky: those of turned functionals, among which neighbours change
/// places and M₂₂ its sign.
fn turned(plain: &Square) -> Square {
    // Of (d, 0), (−d, 0), (0, d) and (0, −d).
    const OTHER: [usize; COUNT] = {
        let [right, left, up, down] = [EXCESS, EXCESS + 1, EXCESS + 2, EXCESS + 3];
        [LIGHT, down, up, right, left, M00, M22, M22 + 1]
    };
    let sign = |a: usize| if a < M22 { 1.0 } else { -1.0 };
    let of = |a: usize, b: usize| sign(a) * sign(b) * plain[OTHER[a]][OTHER[b]];
    std::array::from_fn(|a| std::array::from_fn(|b| of(a, b)))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::*;
    use crate::testing::close;

    // Covariances behind a star that is a Gaussian on the sky, of white noise.
    fn covariances([xx, yy, xy]: [f64; 3], pixels: PixelShape) -> Covariances {
        let star = Array2::from_shape_fn((48, 48), |(y, x)| {
            let [u, v] = pixels.map([x as f64 - 23.5, y as f64 - 23.5]);
            (-0.5 * (u * u / xx + v * v / yy + 2.0 * xy * u * v)).exp()
        });
        let lengths = Lengths {
            detection_sigma: 2.4,
            moment_sigma: 3.0,
            distance: 3,
        };
        let axes = Axes::own(pixels);
        Functionals::new(star.view(), &StampNoise::white(1.0), &lengths, &axes, 12).covariances
    }

    #[test]
    fn covariances_behind_a_turned_star_are_those_of_turned_functionals() {
        for pixels in [
            PixelShape::SQUARE,
            PixelShape {
                stretch: 1.1,
                skew: 0.2,
            },
        ] {
            let own = covariances([3.0, 2.4, 0.05], pixels);
            let other = covariances([2.4, 3.0, -0.05], pixels);
            for a in 0..COUNT {
                let error = |b: usize| 1e-5 * (own.plain[a][a] * own.plain[b][b]).sqrt();
                for b in 0..COUNT {
                    close(own.turned[a][b], other.plain[a][b], error(b));
                }
            }
            // The star has a shape.
            let product = own.plain[M00][M22].powi(2) / (own.plain[M00][M00] * own.plain[M22][M22]);
            assert!(product > 1e-4, "{product}");
        }
    }
}
