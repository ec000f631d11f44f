//! What a linear measurement looks at before it measures: where the galaxy is, and whether there is another.
//!
//! Galaxies look nearly the same turned by 180 degrees, and neighbours do not. The stamp is compared with itself turned
//! about the galaxy's centre, in blocks of 6 × 6 pixels away from it. Where a block is brighter than its
//! opposite by more than noise makes it, there is a neighbour: the half of the stamp on its side, from a third
//! of the way to it, gets the pixels of the opposite side. A neighbour that is too near for this flags
//! the galaxy. Pixels that are filled like this repeat noise only at lags beyond those that the shape is
//! measured on.

use crate::flag::Flag;

/// σ in pixels of the weight under which the centre is found: narrow, for the centre not to follow noise.
const WEIGHT: f32 = 2.0;
/// Half the side of the square that the weight reaches over, in pixels.
const WEIGHT_REACH: i32 = 6;
/// Steps to the centre.
const STEPS: usize = 3;
/// Step in units of the weighted centroid, which falls short of the centre by the width of galaxies.
const STRIDE: f32 = 1.5;
/// Offsets in pixels up to which the window stays in the middle of the stamp, and from which on it is on the
/// galaxy. A window that followed each centroid would follow noise (m = −0.004 at S/N 20); a pixel off does no
/// harm.
const STAYS: f32 = 1.25;
const FOLLOWS: f32 = 2.0;
/// Pixels a side of blocks, and least distance of their centres from the galaxy's.
const BLOCK: i32 = 6;
const LEAST_DISTANCE: f32 = 9.0;
/// Difference of opposite blocks that is a neighbour: in units of its noise, and of the galaxy's light.
const SIGNIFICANT: f32 = 5.0;
const BRIGHT: f32 = 0.03;
/// Where filling begins, in units of the neighbour's distance.
const FILLED_FROM: f32 = 0.3;
/// Distance in pixels of neighbours that are too near to be filled.
const TOO_NEAR: f32 = 17.0;
/// Pixels around the middle whose sum is the galaxy's light.
const INNER: i32 = 8;

/// A stamp's surroundings, and room for it filled.
pub(super) struct Surroundings {
    n: i32,
    pub(super) filled: Vec<f32>,
    hits: Vec<Hit>,
}

/// A block that is brighter than its opposite: by how much, and where, from the galaxy's centre.
#[derive(Clone, Copy)]
struct Hit {
    excess: f32,
    x: f32,
    y: f32,
}

impl Surroundings {
    pub(super) fn new(n: usize) -> Self {
        Surroundings {
            n: n as i32,
            filled: vec![0.0; n * n],
            hits: Vec::with_capacity(n * n / 16),
        }
    }

    /// Centre (x, y) of the galaxy from the middle of its stamp, in pixels; (0, 0) where none is found.
    pub(super) fn centre(&self, stamp: &[f32]) -> [f32; 2] {
        let middle = (self.n as f32 - 1.0) / 2.0;
        let most = middle / 2.0;
        let [mut x, mut y] = [0.0f32; 2];
        for _ in 0..STEPS {
            let (first_x, first_y) = (start(middle + x), start(middle + y));
            let mut along = [0.0f32; (2 * WEIGHT_REACH) as usize];
            for (i, weight) in along.iter_mut().enumerate() {
                *weight = gaussian((first_x + i as i32) as f32 - middle - x);
            }
            let mut sums = [0.0f32; 3];
            for j in 0..2 * WEIGHT_REACH {
                let row = first_y + j;
                if !(0..self.n).contains(&row) {
                    continue;
                }
                let (mut all, mut first) = (0.0, 0.0);
                for (i, weight) in along.iter().enumerate() {
                    let column = first_x + i as i32;
                    if (0..self.n).contains(&column) {
                        let light = weight * stamp[(row * self.n + column) as usize];
                        all += light;
                        first += light * (column as f32 - middle - x);
                    }
                }
                let dy = row as f32 - middle - y;
                let weight = gaussian(dy);
                sums[0] += weight * all;
                sums[1] += weight * first;
                sums[2] += weight * all * dy;
            }
            if sums[0] <= 0.0 {
                return [0.0; 2];
            }
            let step = |sum: f32| STRIDE * (sum / sums[0]).clamp(-WEIGHT, WEIGHT);
            x = (x + step(sums[1])).clamp(-most, most);
            y = (y + step(sums[2])).clamp(-most, most);
        }
        [x, y]
    }

    /// Looks for neighbours of a galaxy centred at `centre`, in noise of level `noise` on large scales. True
    /// where there are some, and the stamp without them is in `self.filled`.
    ///
    /// # Errors
    /// Where one is too near.
    pub(super) fn clear(
        &mut self,
        stamp: &[f32],
        centre: [f32; 2],
        noise: f32,
    ) -> Result<bool, Flag> {
        // Pixel p is opposite to `turn − p`.
        let turn = centre.map(|c| (2.0 * c).round() as i32 + self.n - 1);
        self.find(stamp, turn, noise);
        if self.hits.is_empty() {
            return Ok(false);
        }
        self.hits.sort_by(|a, b| b.excess.total_cmp(&a.excess));
        self.filled.copy_from_slice(stamp);
        while let Some(&brightest) = self.hits.first() {
            let (x, y) = self.place(stamp, turn, brightest);
            let distance = x.hypot(y);
            if distance < TOO_NEAR {
                return Err(Flag::Neighbour);
            }
            let (x, y) = (x / distance, y / distance);
            let from = FILLED_FROM * distance;
            self.fill(stamp, turn, (x, y), from);
            self.hits.retain(|hit| hit.x * x + hit.y * y <= from);
        }
        Ok(true)
    }

    /// Blocks that are brighter than their opposites.
    fn find(&mut self, stamp: &[f32], turn: [i32; 2], noise: f32) {
        self.hits.clear();
        let blocks = (self.n / 2 + BLOCK - 1) / BLOCK;
        // The first pixel beyond the centre.
        let [x0, y0] = turn.map(|turn| turn.div_euclid(2) + 1);
        let inner = self.block(stamp, (x0 - INNER, y0 - INNER), 2 * INNER).0;
        for j in 0..blocks {
            for i in -blocks..blocks {
                let at = (x0 + i * BLOCK, y0 + j * BLOCK);
                let half = (BLOCK as f32 - 1.0) / 2.0;
                let x = at.0 as f32 + half - turn[0] as f32 / 2.0;
                let y = at.1 as f32 + half - turn[1] as f32 / 2.0;
                if x.hypot(y) < LEAST_DISTANCE {
                    continue;
                }
                let opposite = (turn[0] - at.0 - BLOCK + 1, turn[1] - at.1 - BLOCK + 1);
                let (here, own) = self.block(stamp, at, BLOCK);
                let (there, other) = self.block(stamp, opposite, BLOCK);
                let excess = here - there;
                let least = SIGNIFICANT * noise * ((own + other) as f32).sqrt();
                if excess.abs() > least.max(BRIGHT * inner) {
                    let side = excess.signum();
                    self.hits.push(Hit {
                        excess: excess.abs(),
                        x: side * x,
                        y: side * y,
                    });
                }
            }
        }
    }

    /// Sum over a block, as far as it is on the stamp, and the number of its pixels there.
    fn block(&self, stamp: &[f32], (x, y): (i32, i32), side: i32) -> (f32, i32) {
        let (left, right) = (x.max(0), (x + side).min(self.n));
        if left >= right {
            return (0.0, 0);
        }
        let (top, bottom) = (y.max(0), (y + side).min(self.n));
        let mut sum = 0.0;
        for row in top..bottom {
            let line = (row * self.n) as usize;
            sum += stamp[line + left as usize..line + right as usize]
                .iter()
                .sum::<f32>();
        }
        (sum, (right - left) * (bottom - top).max(0))
    }

    /// The light of a pixel less that of its opposite, which is none off the stamp.
    fn excess(&self, stamp: &[f32], turn: [i32; 2], (x, y): (i32, i32)) -> f32 {
        stamp[(y * self.n + x) as usize] - self.opposite(stamp, turn, (x, y))
    }

    fn opposite(&self, stamp: &[f32], turn: [i32; 2], (x, y): (i32, i32)) -> f32 {
        let (x, y) = (turn[0] - x, turn[1] - y);
        let side = 0..self.n;
        if side.contains(&x) && side.contains(&y) {
            stamp[(y * self.n + x) as usize]
        } else {
            0.0
        }
    }

    /// Centroid of the excess around a block, from the galaxy's centre.
    fn place(&self, stamp: &[f32], turn: [i32; 2], hit: Hit) -> (f32, f32) {
        let (mut all, mut sx, mut sy) = (0.0f32, 0.0f32, 0.0f32);
        for row in 0..self.n {
            let y = row as f32 - turn[1] as f32 / 2.0;
            for column in 0..self.n {
                let x = column as f32 - turn[0] as f32 / 2.0;
                let square = (x - hit.x).powi(2) + (y - hit.y).powi(2);
                if square > 64.0 {
                    continue;
                }
                let excess = self.excess(stamp, turn, (column, row)).max(0.0);
                let light = excess * (-square / 16.0).exp();
                all += light;
                sx += light * x;
                sy += light * y;
            }
        }
        if all > 0.0 {
            (sx / all, sy / all)
        } else {
            (hit.x, hit.y)
        }
    }

    /// Gives the pixels further than `from` in direction (x, y) those of the opposite side.
    fn fill(&mut self, stamp: &[f32], turn: [i32; 2], (x, y): (f32, f32), from: f32) {
        for row in 0..self.n {
            let across = (row as f32 - turn[1] as f32 / 2.0) * y;
            for column in 0..self.n {
                if (column as f32 - turn[0] as f32 / 2.0) * x + across > from {
                    let light = self.opposite(stamp, turn, (column, row));
                    self.filled[(row * self.n + column) as usize] = light;
                }
            }
        }
    }
}

/// Where the window is for a galaxy centred at `centre`.
pub(super) fn followed(centre: [f32; 2]) -> [f32; 2] {
    let away = centre[0].hypot(centre[1]);
    let share = ((away - STAYS) / (FOLLOWS - STAYS)).clamp(0.0, 1.0);
    centre.map(|c| share * c)
}

/// First of the pixels under the weight.
fn start(centre: f32) -> i32 {
    centre.floor() as i32 + 1 - WEIGHT_REACH
}

fn gaussian(x: f32) -> f32 {
    (-0.5 * (x / WEIGHT).powi(2)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 48;

    fn blob(stamp: &mut [f32], x: f32, y: f32, light: f32) {
        for (at, value) in stamp.iter_mut().enumerate() {
            let (dx, dy) = ((at % N) as f32 - 23.5 - x, (at / N) as f32 - 23.5 - y);
            *value += light * (-(dx * dx + dy * dy) / 18.0).exp();
        }
    }

    #[test]
    fn centres_are_found_and_the_window_follows_those_that_are_far() {
        let look = Surroundings::new(N);
        for (x, y) in [(0.0, 0.0), (1.0, -0.5), (-3.0, 1.5), (0.3, 4.0)] {
            let mut stamp = vec![0.0; N * N];
            blob(&mut stamp, x, y, 10.0);
            let found = look.centre(&stamp);
            // For a Gaussian of 3 px a step goes 1.5 · 4/(4 + 9) of the way; three of them leave 0.16 of it.
            let left = (found[0] - x).hypot(found[1] - y);
            assert!(left < 0.16 * x.hypot(y) + 0.01, "{found:?} {x} {y}");
        }
        assert_eq!(followed([0.9, -0.8]), [0.0; 2]);
        assert_eq!(followed([-2.0, 1.0]), [-2.0, 1.0]);
        assert_eq!(look.centre(&[-1.0; N * N]), [0.0; 2]);
    }

    #[test]
    fn a_galaxy_alone_is_left_as_it_is_and_far_neighbours_are_filled() {
        let mut look = Surroundings::new(N);
        let mut alone = vec![0.0; N * N];
        blob(&mut alone, 0.4, -0.3, 20.0);
        assert_eq!(look.clear(&alone, [0.4, -0.3], 1.0), Ok(false));
        for (x, y) in [(20.0, 3.0), (-13.0, 14.0), (0.0, -19.0)] {
            let mut stamp = alone.clone();
            blob(&mut stamp, x, y, 20.0);
            assert_eq!(look.clear(&stamp, [0.4, -0.3], 1.0), Ok(true), "{x} {y}");
            // What is left of it: the turn is rounded to half a pixel.
            let worst = look.filled.iter().zip(&alone).map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, f32::max) < 3.0, "{x} {y}");
        }
        // Two of them, on different sides.
        let mut stamp = alone.clone();
        blob(&mut stamp, 20.0, 0.0, 20.0);
        blob(&mut stamp, 0.0, 20.0, 15.0);
        assert_eq!(look.clear(&stamp, [0.4, -0.3], 1.0), Ok(true));
        assert!(
            look.filled
                .iter()
                .skip(20 * N + 40)
                .take(8)
                .all(|v| v.abs() < 3.0)
        );
    }

    #[test]
    fn near_neighbours_are_told() {
        let mut look = Surroundings::new(N);
        let mut stamp = vec![0.0; N * N];
        blob(&mut stamp, 0.0, 0.0, 20.0);
        blob(&mut stamp, -9.0, 10.0, 20.0);
        assert_eq!(look.clear(&stamp, [0.0; 2], 1.0), Err(Flag::Neighbour));
    }
}
