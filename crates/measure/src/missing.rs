//! Missing pixels of a stamp: bad ones, cosmic rays, another object's, or those beyond the edge of an exposure.
//!
//! They get the light of the opposite ones, which a galaxy that looks the same rotated by 180 degrees has there, sheared or not. Noise
//! that is repeated like this adds to the autocorrelation at the lag between the two, so that near the galaxy only few may be
//! missing.

use crate::moments::galaxy_centroid;

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

// Of the pixels of a stamp. Chosen by hand.
const MAX_MISSING_SHARE: f32 = 0.25;
// Of the pixels of a stamp that become zero: the opposite one is missing, and too few adjacent ones are present. Chosen by hand.
const MAX_MISSING_PAIR_SHARE: f32 = 0.02;
// Width in pixels of a border that may be missing altogether: no light is there. The sky that shows defects is measured on a border of 4 px.
const MAX_MISSING_BORDER: usize = 3;
// In pixels around the galaxy's centre, with stricter limits. Chosen by hand.
const INNER_MISSING_RADIUS: f32 = 12.0;
// Missing pixels within that radius. Chosen by hand.
const MAX_INNER_MISSING: usize = 24;
// Of the eight around a pixel whose opposite is missing or off the stamp. Chosen by hand.
const MIN_ADJACENT_PRESENT: usize = 7;

/// Width of the border of which all pixels are missing, as of stamps that were resampled or whose edges were masked; 0 if it is too wide.
pub(crate) fn missing_border(pixels: &[f32], n: usize) -> usize {
    let is_missing = |depth: usize| {
        let inner = depth..n - depth;
        inner.clone().all(|at| {
            let ring = [depth, n - 1 - depth].map(|far| [far * n + at, at * n + far]);
            ring.as_flattened()
                .iter()
                .all(|&at| !pixels[at].is_finite())
        })
    };
    let width = (0..n / 2).take_while(|depth| is_missing(*depth)).count();
    if width > MAX_MISSING_BORDER { 0 } else { width }
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
        if self.places.is_empty() {
            return true;
        }
        // Without this border, the stamp is a smaller one.
        let border = missing_border(stamp, n);
        let of_border = 4 * border * (n - border);
        if (self.places.len() - of_border) as f32 > MAX_MISSING_SHARE * stamp.len() as f32 {
            return false;
        }
        // The centroid needs all pixels: first filled about the stamp's centre, then about the galaxy's.
        self.fill_about(stamp, (n, border), [0.0; 2]);
        let centroid = galaxy_centroid(stamp, n);
        for &at in &self.places {
            stamp[at] = f32::NAN;
        }
        let inner = self.places.iter().filter(|at| is_inner(**at, n, centroid));
        let few_inner = inner.count() <= MAX_INNER_MISSING;
        self.fill_about(stamp, (n, border), centroid) && few_inner
    }

    /// Gives missing pixels the light of the opposite ones, or if that is missing too the mean of the adjacent ones, or
    /// zero. False if a pixel near the centre becomes zero, or too many elsewhere whose opposite is on the stamp and inside of the
    /// missing border.
    fn fill_about(
        &mut self,
        stamp: &mut [f32],
        (n, border): (usize, usize),
        centroid: [f32; 2],
    ) -> bool {
        let inside = border..n - border;
        let rotation = rotation_sum(centroid, n);
        let (mut inner_filled, mut zeroed) = (true, 0);
        self.lights.clear();
        for &at in &self.places {
            let other = opposite(stamp, n, rotation, [at % n, at / n]);
            let light = other.filter(|light| light.is_finite());
            let light = light.or_else(|| adjacent_mean(stamp, n, at));
            if light.is_none() {
                // An opposite that is off the stamp is so far out that there is no light.
                let is_inside = [at % n, at / n].iter().all(|at| inside.contains(at));
                zeroed += usize::from(is_inside && other.is_some());
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

#[cfg(test)]
mod tests {
    use super::*;

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
    fn a_missing_border_makes_a_smaller_stamp() {
        let border = |width: usize| {
            let is_border = move |(x, y): &(usize, usize)| {
                [*x, *y].iter().any(|at| *at < width || *at >= N - width)
            };
            (0..N * N).map(|at| (at % N, at / N)).filter(is_border)
        };
        let whole = galaxy();
        for width in [1, 3] {
            let found = mended(border(width)).unwrap();
            let worst = found.iter().zip(&whole).map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, f32::max) < 1e-3, "{width}");
        }
        assert!(mended(border(4)).is_none());
        // With a hole the opposite of which is missing, as without a border.
        let hole = |x0: usize| (0..100).map(move |k| (x0 + k % 8, 20 + k / 8));
        assert!(mended(border(1).chain(hole(4)).chain(hole(37))).is_none());
        let mut pixels = whole;
        assert_eq!(missing_border(&pixels, N), 0);
        pixels[..N].fill(f32::NAN);
        assert_eq!(missing_border(&pixels, N), 0);
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
}
