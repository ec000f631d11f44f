//! The light of a neighbour, fitted by a round profile.
//!
//! What a pixel is brighter than its opposite about the galaxy's centre is, but for noise, the neighbour's light there
//! less that in the opposite pixel: the galaxy is nearly the same turned by 180 degrees. The profile is a sum of
//! concentric Gaussians, whose amplitudes follow by least squares. It is taken from the whole stamp: a neighbour's wings
//! reach the galaxy's own side, where a fit or a copy of the opposite side alone would leave them.

use shearq_quantities::linear::cholesky;

use super::contrast::opposite;

/// σ of the Gaussians of a neighbour's profile, from a PSF's core to a large galaxy's wings. See
/// docs/constants.md.
const WIDTHS: [f32; COUNT] = [2.0, 3.5, 6.0, 10.5];
/// Number of these Gaussians. See docs/constants.md.
const COUNT: usize = 4;
/// Which of them may be elongated; the first may be displaced. See docs/constants.md.
const ELONGATED: [usize; 2] = [1, 2];
/// σ of the Gaussians whose derivatives are what a displacement of the galaxy changes. See docs/constants.md.
const CORES: [f32; 2] = [2.2, 4.0];
/// Terms of a neighbour: round ones, two of a displacement, and of elongations.
const TERMS: usize = COUNT + 2 + 2 * ELONGATED.len();
/// Usual amplitudes of a neighbour's terms in units of its peak: round ones, of a displacement, and of elongations. The
/// fit prefers them where noise hides the true ones. See docs/constants.md.
const USUAL: [f32; TERMS] = [1.0, 1.0, 0.3, 0.03, 0.3, 0.3, 0.3, 0.3, 0.03, 0.03];
/// Terms of the galaxy's displacement.
const MOVED: usize = 2 * CORES.len();
/// Terms of the fit.
const ALL: usize = TERMS + MOVED;
/// Relative addition to the diagonal of the normal equations, which keeps them soluble. See
/// docs/constants.md.
const RIDGE: f64 = 1e-6;

/// σ of the Gaussian weight for a neighbour's position. See docs/constants.md.
const PLACED_BY: f32 = 3.0;
/// Radius around a neighbour that counts for its position. See docs/constants.md.
pub(super) const AROUND: f32 = 9.0;
/// Steps to a neighbour's position. See docs/constants.md.
const STEPS: usize = 4;
/// Longest step to a neighbour's position. See docs/constants.md.
const MAX_STEP: f32 = 2.0;

/// What is known of a neighbour before the fit: its peak, and the noise.
#[derive(Clone, Copy)]
pub(super) struct Known {
    pub(super) peak: f32,
    pub(super) noise: f32,
}

/// Room for the Gaussians along the axes of a stamp.
pub(super) struct Profile {
    n: usize,
    /// Along x and y, at the pixels and at their opposites, `[pixel][width]`.
    here: [Vec<Along>; 2],
    opposite: [Vec<Along>; 2],
    /// Along x and y about the galaxy's centre.
    galaxy: [Vec<Core>; 2],
}

impl Profile {
    pub(super) fn new(n: usize) -> Self {
        let axis = || vec![Along::default(); n];
        let core = || vec![Core::default(); n];
        Profile {
            n,
            here: [axis(), axis()],
            opposite: [axis(), axis()],
            galaxy: [core(), core()],
        }
    }

    /// Place of a neighbour from the galaxy's centre, (x, y) in pixels, near `start`: that of a Gaussian which fits best.
    /// (A centroid would be drawn inwards where the stamp ends beside the neighbour.)
    /// Also returns the peak of the Gaussian.
    pub(super) fn place(&self, stamp: &[f32], turn: [i32; 2], start: [f32; 2]) -> ([f32; 2], f32) {
        let mut peak = 0.0;
        let centre = turn.map(|turn| turn as f32 / 2.0);
        let [mut x, mut y] = start;
        for _ in 0..STEPS {
            // A Gaussian, and its change with place along both axes.
            let mut matrix = [[0.0; 3]; 3];
            let mut right = [0.0; 3];
            for row in self.around(centre[1] + y) {
                let dy = row as f32 - centre[1] - y;
                for column in self.around(centre[0] + x) {
                    let dx = column as f32 - centre[0] - x;
                    let excess = stamp[row * self.n + column]
                        - opposite(stamp, self.n, turn, [column, row]).unwrap_or(0.0);
                    let light = (-0.5 * (dx * dx + dy * dy) / (PLACED_BY * PLACED_BY)).exp();
                    add(
                        &mut matrix,
                        &mut right,
                        [light, light * dx, light * dy],
                        excess,
                        1.0,
                    );
                }
            }
            let [light, along_x, along_y] = solved(matrix, right);
            if light <= 0.0 {
                return (start, peak);
            }
            peak = light as f32;
            let step = |along: f64| {
                let step = PLACED_BY * PLACED_BY * (along / light) as f32;
                step.clamp(-MAX_STEP, MAX_STEP)
            };
            (x, y) = (x + step(along_x), y + step(along_y));
        }
        // Farther away it is something else.
        if (x - start[0]).hypot(y - start[1]) < AROUND {
            ([x, y], peak)
        } else {
            (start, peak)
        }
    }

    /// Pixels along an axis around one.
    fn around(&self, pixel: f32) -> std::ops::Range<usize> {
        let first = (pixel - AROUND).ceil().clamp(0.0, self.n as f32) as usize;
        let end = (pixel + AROUND + 1.0).floor().clamp(0.0, self.n as f32) as usize;
        first..end
    }

    /// Subtracts from `stamp` the neighbour at `place` from the galaxy's centre, (x, y) in pixels. Pixel p is opposite to
    /// `turn − p`. The fit is to pixels further than `from` in the neighbour's direction. Returns the neighbour's light.
    pub(super) fn subtract(
        &mut self,
        stamp: &mut [f32],
        turn: [i32; 2],
        place: [f32; 2],
        from: f32,
        known: Known,
    ) -> f32 {
        for axis in 0..2 {
            let centre = turn[axis] as f32 / 2.0;
            for at in 0..self.n {
                let x = at as f32 - centre;
                self.here[axis][at] = Along::of(x - place[axis]);
                self.opposite[axis][at] = Along::of(-x - place[axis]);
                self.galaxy[axis][at] = Core::of(x);
            }
        }
        let amplitudes = self.fit(stamp, turn, place, from, known);
        for (row, line) in stamp.chunks_exact_mut(self.n).enumerate() {
            let y = &self.here[1][row];
            for (pixel, x) in line.iter_mut().zip(&self.here[0]) {
                let terms = x.terms(y);
                let light = terms.iter().zip(&amplitudes);
                *pixel -= light.map(|(t, a)| t * *a as f32).sum::<f32>();
            }
        }
        let areas = WIDTHS.map(|width| 2.0 * std::f32::consts::PI * width * width);
        let lights = amplitudes.iter().zip(areas);
        lights.map(|(peak, area)| *peak as f32 * area).sum()
    }

    /// Amplitudes of the neighbour's terms, and of those of the galaxy's displacement.
    fn fit(
        &self,
        stamp: &[f32],
        turn: [i32; 2],
        place: [f32; 2],
        from: f32,
        known: Known,
    ) -> [f64; ALL] {
        let distance = place[0].hypot(place[1]);
        let side = place.map(|p| p / distance);
        let mut matrix = [[0.0; ALL]; ALL];
        let mut right = [0.0; ALL];
        if known.peak > 0.0 {
            for (k, usual) in USUAL.into_iter().enumerate() {
                let ratio = f64::from(known.noise / (usual * known.peak));
                matrix[k][k] = ratio * ratio;
            }
        }
        for row in 0..self.n {
            let across = (row as f32 - turn[1] as f32 / 2.0) * side[1];
            for column in 0..self.n {
                if (column as f32 - turn[0] as f32 / 2.0) * side[0] + across <= from {
                    continue;
                }
                let own = self.here[0][column].terms(&self.here[1][row]);
                let mut terms = [0.0; ALL];
                terms[..TERMS].copy_from_slice(&own);
                let mut excess = stamp[row * self.n + column];
                // In units of the inverse of the noise's variance: a difference has twice that of a pixel.
                let mut weight = 1.0;
                if let Some(light) = opposite(stamp, self.n, turn, [column, row]) {
                    let other = self.opposite[0][column].terms(&self.opposite[1][row]);
                    for (term, other) in terms.iter_mut().zip(other) {
                        *term -= other;
                    }
                    let moved = self.galaxy[0][column].moved(&self.galaxy[1][row]);
                    terms[TERMS..].copy_from_slice(&moved);
                    excess -= light;
                    weight = 0.5;
                }
                add(&mut matrix, &mut right, terms, excess, weight);
            }
        }
        solved(matrix, right)
    }
}

/// Factors along one axis of a neighbour's terms.
#[derive(Clone, Copy, Default)]
struct Along {
    /// Distance from the neighbour in units of [`PLACED_BY`].
    offset: f32,
    gaussians: [f32; COUNT],
}

impl Along {
    fn of(x: f32) -> Self {
        Along {
            offset: x / PLACED_BY,
            gaussians: gaussians(x),
        }
    }

    /// All terms at a pixel, of which `self` is along x: round ones, then two of a displacement, and for each of
    /// [`ELONGATED`] two of an elongation.
    fn terms(&self, y: &Along) -> [f32; TERMS] {
        let mut terms = [0.0; TERMS];
        for (k, term) in terms.iter_mut().take(COUNT).enumerate() {
            *term = self.gaussians[k] * y.gaussians[k];
        }
        let (u, v) = (self.offset, y.offset);
        let round = terms[ELONGATED[0]];
        terms[COUNT] = u * round;
        terms[COUNT + 1] = v * round;
        for (k, width) in ELONGATED.into_iter().enumerate() {
            let round = terms[width];
            terms[COUNT + 2 + 2 * k] = (u * u - v * v) * round;
            terms[COUNT + 3 + 2 * k] = u * v * round;
        }
        terms
    }
}

/// Factors along one axis of what a displacement of the galaxy changes.
#[derive(Clone, Copy, Default)]
struct Core {
    x: f32,
    gaussians: [f32; CORES.len()],
}

impl Core {
    fn of(x: f32) -> Self {
        Core {
            x,
            gaussians: CORES.map(|width| (-0.5 * (x / width).powi(2)).exp()),
        }
    }

    fn moved(&self, y: &Core) -> [f32; MOVED] {
        std::array::from_fn(|k| {
            let round = self.gaussians[k / 2] * y.gaussians[k / 2];
            round * if k % 2 == 0 { self.x } else { y.x }
        })
    }
}

fn gaussians(x: f32) -> [f32; COUNT] {
    WIDTHS.map(|width| (-0.5 * (x / width).powi(2)).exp())
}

/// Adds a pixel to normal equations, of which the lower triangle is kept.
fn add<const N: usize>(
    matrix: &mut [[f64; N]; N],
    right: &mut [f64; N],
    terms: [f32; N],
    value: f32,
    weight: f64,
) {
    for i in 0..N {
        let term = weight * f64::from(terms[i]);
        right[i] += term * f64::from(value);
        for j in 0..=i {
            matrix[i][j] += term * f64::from(terms[j]);
        }
    }
}

/// Solution of normal equations, of which the lower triangle is given, by Cholesky's decomposition.
pub(super) fn solved<const N: usize>(mut matrix: [[f64; N]; N], mut right: [f64; N]) -> [f64; N] {
    for (i, row) in matrix.iter_mut().enumerate() {
        row[i] *= 1.0 + RIDGE;
    }
    let positive = |pivot: f64| Some(pivot.max(f64::MIN_POSITIVE));
    // No pivot is refused.
    let _ = cholesky(&mut matrix, &mut right, N, positive);
    right
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 48;

    /// Concentric Gaussians around `place` from the middle, in light of 1, 0.5, …
    fn neighbour(place: [f32; 2]) -> Vec<f32> {
        let at = |pixel: usize, axis: usize| gaussians(pixel as f32 - 23.5 - place[axis]);
        let pixel = |p: usize| {
            let (x, y) = (at(p % N, 0), at(p / N, 1));
            (0..COUNT).map(|k| x[k] * y[k] / (1 << k) as f32).sum()
        };
        (0..N * N).map(pixel).collect()
    }

    #[test]
    fn a_round_neighbour_is_taken_away_wherever_it_is_and_the_galaxy_left() {
        let galaxy = |p: usize| {
            let (x, y) = ((p % N) as f32 - 23.5, (p / N) as f32 - 23.5);
            20.0 * (-(x * x + 0.7 * y * y + 0.4 * x * y) / 18.0).exp()
        };
        let mut profile = Profile::new(N);
        // The nearest one reaches its own opposite side.
        for place in [
            [20.0, 0.0],
            [-12.0, 9.0],
            [5.0, -17.0],
            [16.0, 16.0],
            [8.0, -7.0],
        ] {
            let light = neighbour(place);
            let mut stamp: Vec<f32> = (0..N * N).map(|p| galaxy(p) + light[p]).collect();
            let known = Known {
                peak: 1.5,
                noise: 0.0,
            };
            profile.subtract(&mut stamp, [47, 47], place, 5.0, known);
            // f32 holds light of 20 to 2e-6, and the equations lose three to four digits.
            let worst = (0..N * N).map(|p| (stamp[p] - galaxy(p)).abs());
            assert!(worst.fold(0.0, f32::max) < 5e-3, "{place:?}");
        }
    }

    #[test]
    fn neighbours_are_placed_at_the_edge_as_elsewhere() {
        let profile = Profile::new(N);
        for place in [[20.0, 1.0], [-12.0, 9.5], [2.0, -21.5]] {
            let stamp: Vec<f32> = (0..N * N)
                .map(|p| {
                    let (x, y) = (
                        (p % N) as f32 - 23.5 - place[0],
                        (p / N) as f32 - 23.5 - place[1],
                    );
                    (-(x * x + y * y) / 18.0).exp()
                })
                .collect();
            let ([x, y], peak) = profile.place(&stamp, [47, 47], [place[0] - 2.0, place[1] + 2.5]);
            assert!((peak - 1.0).abs() < 0.01, "{peak}");
            // Steps go the whole way for a Gaussian of that width, and converge quadratically.
            assert!(
                (x - place[0]).hypot(y - place[1]) < 0.01,
                "{x} {y} {place:?}"
            );
        }
    }

    #[test]
    fn equations_are_solved_and_such_without_pixels_give_none() {
        let matrix = [
            [4.0, 0.0, 0.0, 0.0],
            [2.0, 5.0, 0.0, 0.0],
            [0.4, 0.2, 3.0, 0.0],
            [0.1, 1.0, 0.5, 2.0],
        ];
        let expected = [1.0, -2.0, 0.5, 3.0];
        let entry = |i: usize, j: usize| if j <= i { matrix[i][j] } else { matrix[j][i] };
        let right = std::array::from_fn(|i| (0..COUNT).map(|j| entry(i, j) * expected[j]).sum());
        for (found, expected) in solved(matrix, right).iter().zip(expected) {
            assert!((found - expected).abs() < 1e-4, "{found} {expected}");
        }
        assert_eq!(solved([[0.0; COUNT]; COUNT], [0.0; COUNT]), [0.0; COUNT]);
    }
}
