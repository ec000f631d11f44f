//! Images folded about their middle along both axes.
//!
//! A folded image has four parts: sums and differences along x, each of sums and of differences along y. A part has the
//! places from the middle on, `half` in each of `half` rows; the middle pixel of an odd number is the first, and is added
//! to itself.

use shearq_quantities::product::{LANES, ROWS};
use shearq_quantities::real::Real;

/// Places that are folded side by side. See docs/constants.md.
const SIDE: usize = 8;

/// How a folded image of n×n pixels lies in memory: in two halves, for sums and differences along x. Each has two parts, for
/// sums and differences along y, in `band` rows of `places` numbers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Folding {
    /// Pixels a side.
    pub(super) n: usize,
    /// Places along an axis from the middle on.
    pub(super) half: usize,
    /// The same, filled up for products.
    pub(super) places: usize,
    /// Rows of a part. The rows of two parts are a multiple of [`ROWS`].
    pub(super) band: usize,
}

impl Folding {
    /// Of images of `n` pixels a side.
    pub(super) fn new(n: usize) -> Self {
        let half = n.div_ceil(2);
        Folding {
            n,
            half,
            places: half.next_multiple_of(LANES),
            band: half.next_multiple_of(ROWS / 2),
        }
    }

    /// Numbers in a half.
    pub(super) fn len(&self) -> usize {
        2 * self.band * self.places
    }

    /// Pixels from the middle to a place.
    pub(super) fn distance(&self, place: usize) -> f64 {
        let middle = if self.n.is_multiple_of(2) { 0.5 } else { 0.0 };
        place as f64 + middle
    }

    /// The share of a place along one axis: the middle pixel is its own opposite, and folding doubles it.
    pub(super) fn share(&self, place: usize) -> f64 {
        if self.distance(place) == 0.0 {
            0.5
        } else {
            1.0
        }
    }

    /// Folds a row-major image.
    #[inline(always)]
    pub(super) fn fold<T: Real>(&self, image: &[T], sums: &mut [T], differences: &mut [T]) {
        let (ss, sd) = sums.split_at_mut(self.band * self.places);
        let (ds, dd) = differences.split_at_mut(self.band * self.places);
        fold(image, self.n, self.places, [ss, sd, ds, dd]);
    }

    /// The image from its parts, even and odd along each axis. `even` and `odd` are the halves along x.
    #[inline(always)]
    pub(super) fn unfold<T: Real>(&self, even: &[T], odd: &[T], image: &mut [T]) {
        let (ee, eo) = even.split_at(self.band * self.places);
        let (oe, oo) = odd.split_at(self.band * self.places);
        unfold([ee, eo, oe, oo], self.places, self.n, image);
    }
}

/// Folds a row-major image of `n`×`n` pixels into parts with rows of `half` places, `stride` apart: sums along x, of sums
/// and then of differences along y; and differences along x, of the same.
#[inline(always)]
fn fold<T: Real>(image: &[T], n: usize, stride: usize, parts: [&mut [T]; 4]) {
    let half = n.div_ceil(2);
    for y in 0..half {
        // From the middle on, and opposite.
        let upper = &image[(n / 2 + y) * n..][..n];
        let lower = &image[(half - 1 - y) * n..][..n];
        for first in (0..sides(half)).step_by(SIDE) {
            // The last ones overlap where there are too few.
            let x = first.min(half - SIDE);
            let (right, left) = (n / 2 + x, half - SIDE - x);
            let (upper_right, lower_right) = (side(upper, right), side(lower, right));
            let (upper_left, lower_left) = (side(upper, left), side(lower, left));
            let mut out = [[T::ZERO; SIDE]; 4];
            for k in 0..SIDE {
                let opposite = SIDE - 1 - k;
                let folded = fold_four([
                    [upper_right[k], upper_left[opposite]],
                    [lower_right[k], lower_left[opposite]],
                ]);
                for (out, folded) in out.iter_mut().zip(folded) {
                    out[k] = folded;
                }
            }
            for k in 0..4 {
                parts[k][y * stride + x..][..SIDE].copy_from_slice(&out[k]);
            }
        }
        if half < SIDE {
            for x in 0..half {
                let (right, left) = (n / 2 + x, half - 1 - x);
                let folded = fold_four([[upper[right], upper[left]], [lower[right], lower[left]]]);
                for k in 0..4 {
                    parts[k][y * stride + x] = folded[k];
                }
            }
        }
    }
}

/// The image of `n`×`n` pixels whose parts, even or odd along each axis, are given from the middle on, in rows `stride`
/// apart; the parts have the order of [`fold`].
#[inline(always)]
fn unfold<T: Real>(parts: [&[T]; 4], stride: usize, n: usize, image: &mut [T]) {
    let half = n.div_ceil(2);
    for y in 0..half {
        let (above, below) = ((n / 2 + y) * n, (half - 1 - y) * n);
        let [ee, eo, oe, oo] = parts;
        let line = y * stride..y * stride + half;
        let (ee, eo) = (&ee[line.clone()], &eo[line.clone()]);
        let (oe, oo) = (&oe[line.clone()], &oo[line]);
        for first in (0..sides(half)).step_by(SIDE) {
            // The last ones overlap where there are too few.
            let x = first.min(half - SIDE);
            let (right, left) = (n / 2 + x, half - SIDE - x);
            let (ee, eo, oe, oo) = (side(ee, x), side(eo, x), side(oe, x), side(oo, x));
            // Upper right, upper left, lower right, lower left.
            let mut out = [[T::ZERO; SIDE]; 4];
            for k in 0..SIDE {
                let [[upper_right, upper_left], [lower_right, lower_left]] =
                    unfold_four([ee[k], eo[k], oe[k], oo[k]]);
                let opposite = SIDE - 1 - k;
                (out[0][k], out[1][opposite]) = (upper_right, upper_left);
                (out[2][k], out[3][opposite]) = (lower_right, lower_left);
            }
            let places = [above + right, above + left, below + right, below + left];
            for (place, out) in places.into_iter().zip(out) {
                image[place..][..SIDE].copy_from_slice(&out);
            }
        }
        if half < SIDE {
            for x in 0..half {
                let (right, left) = (n / 2 + x, half - 1 - x);
                let [[upper_right, upper_left], [lower_right, lower_left]] =
                    unfold_four([ee[x], eo[x], oe[x], oo[x]]);
                (image[above + right], image[above + left]) = (upper_right, upper_left);
                (image[below + right], image[below + left]) = (lower_right, lower_left);
            }
        }
    }
}

/// Places of `half` that are folded side by side: all or none.
#[inline(always)]
fn sides(half: usize) -> usize {
    if half < SIDE { 0 } else { half }
}

/// From opposite pixels, right and left of an upper and of a lower row.
#[inline(always)]
fn fold_four<T: Real>([upper, lower]: [[T; 2]; 2]) -> [T; 4] {
    let sums = (upper[0].plus(lower[0]), upper[1].plus(lower[1]));
    let differences = (upper[0].minus(lower[0]), upper[1].minus(lower[1]));
    [
        sums.0.plus(sums.1),
        differences.0.plus(differences.1),
        sums.0.minus(sums.1),
        differences.0.minus(differences.1),
    ]
}

/// The opposite of [`fold_four`]. It needs quarters of its results.
#[inline(always)]
fn unfold_four<T: Real>([ee, eo, oe, oo]: [T; 4]) -> [[T; 2]; 2] {
    let (even, odd) = (ee.plus(eo), oe.plus(oo));
    let (even_below, odd_below) = (ee.minus(eo), oe.minus(oo));
    [
        [even.plus(odd), even.minus(odd)],
        [even_below.plus(odd_below), even_below.minus(odd_below)],
    ]
}

#[inline(always)]
fn side<T>(line: &[T], first: usize) -> &[T; SIDE] {
    line[first..].first_chunk().expect("pixels of a line")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unfolding_gives_the_image_from_a_quarter_of_its_parts() {
        for n in [1usize, 2, 3, 5, 14, 15, 16, 19, 23, 24, 31, 48] {
            let half = n.div_ceil(2);
            let image: Vec<f64> = (0..n * n).map(|at| ((at * at) % 97) as f64).collect();
            let mut parts = vec![vec![f64::NAN; half * half]; 4];
            let [a, b, c, d] = &mut parts[..] else {
                unreachable!("four parts")
            };
            fold(&image, n, half, [a, b, c, d]);
            // Opposite pixels are as far from the other end.
            let pixel = |y: usize, x: usize| image[y * n + x];
            for (y, x) in (0..half).flat_map(|y| (0..half).map(move |x| (y, x))) {
                let (right, upper) = (n / 2 + x, n / 2 + y);
                let (left, lower) = (n - 1 - right, n - 1 - upper);
                let (ur, ul) = (pixel(upper, right), pixel(upper, left));
                let (lr, ll) = (pixel(lower, right), pixel(lower, left));
                let expected = [
                    ur + ul + lr + ll,
                    ur + ul - lr - ll,
                    ur - ul + lr - ll,
                    ur - ul - lr + ll,
                ];
                for (part, expected) in parts.iter().zip(expected) {
                    assert_eq!(part[y * half + x], expected, "n {n}, {x}, {y}");
                }
            }
            // A part is four times its even and odd component.
            let components: Vec<Vec<f64>> = parts
                .iter()
                .map(|part| part.iter().map(|v| v / 4.0).collect())
                .collect();
            let mut found = vec![f64::NAN; n * n];
            let parts = [0, 1, 2, 3].map(|k| &components[k][..]);
            unfold(parts, half, n, &mut found);
            assert_eq!(found, image, "n {n}");
        }
    }
}
