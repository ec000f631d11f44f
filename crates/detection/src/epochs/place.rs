//! Places between pixels, and values there.

use multiversion::multiversion;

/// Pixels along each axis whose polynomial gives a value between them. Behind PSFs with a FWHM of 3.3 px, functionals of noiseless galaxies then
/// differ by up to 10⁻⁵ of the largest v₀ from those on pixels; with 10 or 8 pixels, by 4·10⁻⁵ or 1.3·10⁻⁴.
pub(super) const TAPS: usize = 12;

// Pixels that are summed at a time: those of a register of AVX. Squares under functionals have at least as many along a side.
const LANES: usize = 8;

/// From the pixels of a block of the first exposure to those of an epoch: polynomials of the second order in x and in y, by axes, powers
/// of y and powers of x.
#[derive(Debug, Clone, Copy)]
pub(super) struct BlockMap([[[f64; 3]; 3]; 2]);

impl BlockMap {
    /// That of the exposure itself, of a block with this first pixel.
    pub(super) fn shift([x, y]: [f64; 2]) -> Self {
        let none = [0.0; 3];
        BlockMap([
            [[x, 1.0, 0.0], none, none],
            [[y, 0.0, 0.0], [1.0, 0.0, 0.0], none],
        ])
    }

    /// Through the places in FITS pixels of nine points, row by row, that are `step` apart from the first pixel on.
    pub(super) fn through(points: &[Option<[f64; 2]>], step: f64) -> Option<Self> {
        let powers = |[a, b, c]: [f64; 3]| {
            let slope = (4.0 * b - 3.0 * a - c) / (2.0 * step);
            [a, slope, (a - 2.0 * b + c) / (2.0 * step * step)]
        };
        let mut axes = [[[0.0; 3]; 3]; 2];
        for (k, axis) in axes.iter_mut().enumerate() {
            let mut rows = [[0.0; 3]; 3];
            for (row, points) in rows.iter_mut().zip(points.chunks_exact(3)) {
                *row = powers([points[0]?[k], points[1]?[k], points[2]?[k]].map(|at| at - 1.0));
            }
            for i in 0..3 {
                let of_power = powers(rows.map(|row| row[i]));
                (0..3).for_each(|j| axis[j][i] = of_power[j]);
            }
        }
        Some(BlockMap(axes))
    }

    /// With another first pixel of the epoch.
    pub(super) fn counted_from(mut self, first: [f64; 2]) -> Self {
        (0..2).for_each(|k| self.0[k][0][0] -= first[k]);
        self
    }

    /// The powers of x in a row, by axes.
    pub(super) fn row(&self, y: f64) -> [[f64; 3]; 2] {
        self.0
            .map(|[a, b, c]| std::array::from_fn(|i| a[i] + y * (b[i] + y * c[i])))
    }

    #[inline(always)]
    pub(super) fn at(row: &[[f64; 3]; 2], x: f64) -> [f64; 2] {
        row.map(|[a, b, c]| a + x * (b + x * c))
    }

    /// The least and largest places of corners, the middle, and the middles of sides of a block of this length.
    pub(super) fn bounds(&self, length: f64) -> [[f64; 2]; 2] {
        let steps = [0.0, 0.5 * length, length];
        let of_row = |y: f64| steps.map(|x| BlockMap::at(&self.row(y), x));
        let all = steps.map(of_row).concat();
        let extreme = |pick: fn(f64, f64) -> f64, start: f64| {
            [0, 1].map(|k| all.iter().map(|at| at[k]).fold(start, pick))
        };
        [
            extreme(f64::min, f64::INFINITY),
            extreme(f64::max, f64::NEG_INFINITY),
        ]
    }
}

/// The weights of the pixels around a place by Lagrange's polynomial; the pixel at or before the place is number `N / 2 − 1`.
pub(super) fn lagrange<const N: usize>(fraction: f64) -> [f32; N] {
    let node = |i: usize| i as f64 - (N / 2 - 1) as f64;
    std::array::from_fn(|j| {
        let others = (0..N).filter(|i| *i != j);
        let factors = others.map(|i| (fraction - node(i)) / (node(j) - node(i)));
        factors.product::<f64>() as f32
    })
}

/// The pixels of a square of `side`, shifted by fractions of a pixel. `pixels` begin `TAPS / 2 − 1` rows and columns before it, and are
/// `columns` a row. `rows` is a buffer.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn shift(
    pixels: &[f32],
    columns: usize,
    side: usize,
    fractions: [f64; 2],
    [rows, out]: &mut [Vec<f32>; 2],
) {
    let [along, across] = fractions.map(lagrange::<TAPS>);
    // The last ones end with the row.
    let blocks = || (0..side).step_by(LANES).map(|x| x.min(side - LANES));
    rows.resize((side + TAPS - 1) * side, 0.0);
    for (to, from) in rows.chunks_exact_mut(side).zip(pixels.chunks(columns)) {
        for x in blocks() {
            let sum = weighted(&along, |tap| &from[x + tap..]);
            to[x..x + LANES].copy_from_slice(&sum);
        }
    }
    out.resize(side * side, 0.0);
    for (y, to) in out.chunks_exact_mut(side).enumerate() {
        for x in blocks() {
            let sum = weighted(&across, |tap| &rows[(y + tap) * side + x..]);
            to[x..x + LANES].copy_from_slice(&sum);
        }
    }
}

/// Sums of so many neighbouring pixels, each times the weight of its tap.
#[inline(always)]
fn weighted<'a>(weights: &[f32; TAPS], pixels: impl Fn(usize) -> &'a [f32]) -> [f32; LANES] {
    let mut sum = [0.0; LANES];
    for (tap, weight) in weights.iter().enumerate() {
        for (sum, pixel) in sum.iter_mut().zip(&pixels(tap)[..LANES]) {
            *sum += weight * pixel;
        }
    }
    sum
}

/// The value of an image of `columns` at a place, by the cubic polynomial through four pixels along each axis.
#[inline(always)]
pub(super) fn near_value(image: &[f32], columns: usize, [x, y]: [f64; 2]) -> f64 {
    // Places are positive, of which truncation is several times faster than the floor.
    let (column, row) = (x as usize, y as usize);
    let along = cubic((x - column as f64) as f32);
    let across = cubic((y - row as f64) as f32);
    let first = (row - 1) * columns + column - 1;
    let mut sum = 0.0;
    for (k, weight) in across.iter().enumerate() {
        let [a, b, c, d] = image[first + k * columns..][..4] else {
            continue;
        };
        sum += weight * (along[0] * a + along[1] * b + along[2] * c + along[3] * d);
    }
    f64::from(sum)
}

/// As [`lagrange`], of four pixels.
#[inline(always)]
fn cubic(t: f32) -> [f32; 4] {
    let [before, after, beyond] = [t + 1.0, t - 1.0, t - 2.0];
    [
        -t * after * beyond / 6.0,
        before * after * beyond / 2.0,
        -before * t * beyond / 2.0,
        before * t * after / 6.0,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::close;

    #[test]
    fn maps_follow_distortions() {
        // Third derivatives of 10⁻⁹ per px² are ten times those of DECam.
        let place = |[x, y]: [f64; 2]| {
            let [u, v] = [x - 4000.0, y - 3000.0];
            let distortion = |a: f64, b: f64| a * (a * a + b * b) / 6e9;
            let turned = [0.8 * u - 0.6 * v, 0.6 * u + 0.8 * v];
            [turned[0] + distortion(u, v), turned[1] + distortion(v, u)]
        };
        let (first, step) = ([700.0, 900.0], 100.5);
        let on_first = |x: f64, y: f64| place([first[0] + x, first[1] + y]);
        let points: Vec<Option<[f64; 2]>> = (0..9)
            .map(|k| Some(on_first(step * f64::from(k % 3), step * f64::from(k / 3))))
            .collect();
        let map = BlockMap::through(&points, step)
            .unwrap()
            .counted_from([5.0, 7.0]);
        for (x, y) in (0..=200)
            .step_by(10)
            .flat_map(|y| [(3.0, y), (90.0, y), (201.0, y)])
        {
            let y = f64::from(y);
            let (own, expected) = (BlockMap::at(&map.row(y), x), on_first(x, y));
            // From 0, with other first pixels.
            close(own[0], expected[0] - 6.0, 1e-3);
            close(own[1], expected[1] - 8.0, 1e-3);
        }
        let holed = [&points[..8], &[None]].concat();
        assert!(BlockMap::through(&holed, step).is_none());
    }

    #[test]
    fn polynomials_of_their_order_are_exact() {
        let weights: [f32; TAPS] = lagrange(0.37);
        let fifth = |x: f64| (0.1 * x).powi(5) - 0.2 * x;
        let nodes = (0..TAPS).map(|k| fifth(k as f64 - 5.0));
        let value: f64 = nodes
            .zip(weights)
            .map(|(own, weight)| own * f64::from(weight))
            .sum();
        close(value, fifth(0.37), 1e-6);
        let image: Vec<f32> = (0..100)
            .map(|k| (k % 10) as f32 + 0.1 * (k / 10) as f32)
            .collect();
        close(near_value(&image, 10, [4.25, 6.5]), 4.25 + 0.65, 1e-5);
    }
}
