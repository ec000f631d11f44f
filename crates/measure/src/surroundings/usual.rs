//! What galaxies usually look like, so that a neighbour can be told from a galaxy's own shape.
//!
//! A fixed ensemble of single galaxies behind PSFs is drawn on cells of 2 × 2 pixels. It has all sizes, ellipticities and
//! displacements that a stamp may have, and no neighbours. Its principal components, each with the variance of its amplitude, are
//! what is ascribed to the galaxy.
//!
//! The ensemble is the same after reflections of either axis and after an exchange of both. The components are therefore even or
//! odd along each axis, and one quadrant of the cells is enough.

use std::f64::consts::PI;
use std::sync::OnceLock;

use shearq_quantities::linear::eigenvectors;

use crate::deconvolve::split_mix;

/// Pixels on a side of a cell. See docs/constants.md.
pub(super) const CELL: usize = 2;
/// Cells from the centre to an edge, at most. See docs/constants.md.
pub(super) const HALF: usize = 11;
/// Cells of a quadrant, in rows of [`HALF`], with room up to whole vectors.
pub(super) const QUADRANT: usize = (HALF * HALF).next_multiple_of(16);
/// Components of each parity. See docs/constants.md.
pub(super) const COMPONENTS: usize = 24;
/// The parities along x and y: whether odd.
pub(super) const PARITIES: [[bool; 2]; 4] =
    [[false, false], [true, true], [true, false], [false, true]];
/// σ of the Gaussian neighbour in cells. See docs/constants.md.
const WIDTH: f64 = 1.5;
/// Cells from the middle of the neighbour to its last one. See docs/constants.md.
pub(super) const REACH: usize = 4;

/// Galaxies of the ensemble. See docs/constants.md.
const GALAXIES: usize = 300;
/// Smallest and largest scale of a galaxy before the PSF. See docs/constants.md.
const SCALES: [f64; 2] = [0.5, 8.0];
/// Largest ellipticity of a galaxy. See docs/constants.md.
const ELLIPTICITY: f64 = 0.9;
/// Largest displacement along an axis. See docs/constants.md.
const DISPLACED: f64 = 0.55;
/// Smallest and largest σ of the PSF. See docs/constants.md.
const PSFS: [f64; 2] = [1.0, 2.4];
/// σ of the concentric Gaussians of a galaxy in units of its scale. See docs/constants.md.
const WIDTHS: [f64; 4] = [0.35, 0.75, 1.5, 2.8];
/// Cells from the centre to an edge of the square whose sum is the galaxy's light: 16 × 16 pixels. See docs/constants.md.
const INNER: usize = 4;
/// Seed of the ensemble.
const SEED: u64 = 0x6761_6c61_7879;

/// One number for each cell of a quadrant.
pub(super) type Quadrant = [f32; QUADRANT];

/// Components of one parity, each of length one over all cells.
pub(super) struct Components {
    /// In the positive quadrant, times two: length one over the quadrant alone.
    pub(super) shapes: [Quadrant; COMPONENTS],
    /// The components under the light of a neighbour.
    pub(super) smoothed: [Quadrant; COMPONENTS],
    /// Variance of the amplitudes in units of the square of the galaxy's light. Infinite for those that are free: a galaxy's
    /// brightness, and a sky.
    pub(super) variances: [f32; COMPONENTS],
}

/// The components for stamps of one size.
pub(super) struct Usual {
    /// Cells from the centre to an edge.
    pub(super) half: usize,
    /// Of each of [`PARITIES`].
    pub(super) components: [Components; 4],
    /// Sum of the squares of the light of a neighbour in the middle of each cell.
    pub(super) squares: Quadrant,
}

impl Usual {
    /// Components on cells that reach `half` cells from the centre to each side; shared by all who ask.
    pub(super) fn of(half: usize) -> &'static Usual {
        static ALL: [OnceLock<Usual>; HALF + 1] = [const { OnceLock::new() }; HALF + 1];
        let half = half.min(HALF);
        ALL[half].get_or_init(|| Usual::new(half))
    }

    fn new(half: usize) -> Usual {
        let galaxies = ensemble(half);
        let components = PARITIES.map(|odd| Components::new(&galaxies, half, odd));
        let along: [f64; HALF] = std::array::from_fn(|at| {
            let reach = REACH as i32;
            let light = (-reach..=reach).filter(|step| on_cells(at as i32 + step, half));
            light.map(|step| neighbour(step).powi(2)).sum()
        });
        let mut squares = [0.0; QUADRANT];
        for (at, square) in squares.iter_mut().take(HALF * HALF).enumerate() {
            *square = (along[at % HALF] * along[at / HALF]) as f32;
        }
        Usual {
            half,
            components,
            squares,
        }
    }
}

/// Whether a cell is within `half` cells of the centre; the first one beyond the centre is 0.
fn on_cells(at: i32, half: usize) -> bool {
    (-(half as i32)..half as i32).contains(&at)
}

/// Light of a neighbour of flux 1 along one axis, this many cells from its middle.
pub(super) fn neighbour(step: i32) -> f64 {
    let offset = f64::from(step) / WIDTH;
    (-0.5 * offset * offset).exp() / ((2.0 * PI).sqrt() * WIDTH)
}

/// Light of a galaxy in cells of a quadrant, for each of [`PARITIES`], in units of the light of the inner cells.
type Folded = [[f64; HALF * HALF]; 4];

/// The ensemble, with each galaxy once more under exchanged axes.
fn ensemble(half: usize) -> Vec<Folded> {
    let mut state = SEED;
    let mut uniform = move |[low, high]: [f64; 2]| {
        let unit = (split_mix(&mut state) >> 11) as f64 / (1u64 << 53) as f64;
        low + (high - low) * unit
    };
    let mut galaxies = Vec::with_capacity(2 * GALAXIES);
    for _ in 0..GALAXIES {
        let galaxy = Galaxy {
            scale: uniform(SCALES.map(f64::ln)).exp(),
            // As many per area of the plane.
            ellipticity: ELLIPTICITY * uniform([0.0, 1.0]).sqrt(),
            angle: uniform([0.0, PI]),
            bulge: uniform([0.0, 1.0]),
            place: [(); 2].map(|()| uniform([-DISPLACED, DISPLACED])),
            psf: uniform(PSFS.map(f64::ln)).exp(),
        };
        let folded = galaxy.folded(half);
        galaxies.push(folded);
        let turned = [0, 1, 3, 2].map(|parity: usize| {
            std::array::from_fn(|at| folded[parity][at % HALF * HALF + at / HALF])
        });
        galaxies.push(turned);
    }
    galaxies
}

/// Concentric Gaussians of one ellipticity behind a Gaussian PSF; lengths in pixels.
struct Galaxy {
    scale: f64,
    ellipticity: f64,
    angle: f64,
    bulge: f64,
    place: [f64; 2],
    psf: f64,
}

impl Galaxy {
    fn folded(&self, half: usize) -> Folded {
        let bulge = self.bulge;
        let lights = [0.5 * bulge, 0.5, 0.4 * (1.0 - 0.5 * bulge), 0.12];
        let stretch = (1.0 + self.ellipticity) / (1.0 - self.ellipticity);
        let (sin, cos) = self.angle.sin_cos();
        let gaussians: [_; WIDTHS.len()] = std::array::from_fn(|k| {
            let square = (self.scale * WIDTHS[k]).powi(2);
            let (long, short) = (square * stretch, square / stretch);
            let xx = long * cos * cos + short * sin * sin + self.psf * self.psf;
            let yy = long * sin * sin + short * cos * cos + self.psf * self.psf;
            let xy = (long - short) * sin * cos;
            let determinant = xx * yy - xy * xy;
            let peak = lights[k] / determinant.sqrt();
            (
                peak,
                [yy, xx, -2.0 * xy].map(|term| -0.5 * term / determinant),
            )
        });
        // The four pixels of a cell.
        let light = |side: [f64; 2], at: usize| {
            let mut sum = 0.0;
            for pixel in 0..CELL * CELL {
                let middle = |cell: usize, step: usize| (CELL * cell + step) as f64 + 0.5;
                let x = side[0] * middle(at % HALF, pixel % CELL) - self.place[0];
                let y = side[1] * middle(at / HALF, pixel / CELL) - self.place[1];
                for (peak, [a, b, c]) in &gaussians {
                    sum += peak * (a * x * x + b * y * y + c * x * y).exp();
                }
            }
            sum
        };
        let mut folded = [[0.0; HALF * HALF]; 4];
        for at in 0..HALF * HALF {
            if at % HALF >= half || at / HALF >= half {
                continue;
            }
            for x in [1.0, -1.0] {
                for y in [1.0, -1.0] {
                    let light = light([x, y], at);
                    for (out, odd) in folded.iter_mut().zip(PARITIES) {
                        out[at] += 0.5 * sign(odd, [x, y]) * light;
                    }
                }
            }
        }
        // Twice the sum over the quadrant of the even part is the sum over all four.
        let inner = (0..HALF * HALF).filter(|at| at % HALF < INNER && at / HALF < INNER);
        let inner = 2.0 * inner.map(|at| folded[0][at]).sum::<f64>();
        folded.map(|cells| cells.map(|light| light / inner))
    }
}

/// Sign of a component of parities `odd` in the quadrant of these signs.
fn sign(odd: [bool; 2], side: [f64; 2]) -> f64 {
    let along = |axis: usize| if odd[axis] { side[axis] } else { 1.0 };
    along(0) * along(1)
}

impl Components {
    fn new(galaxies: &[Folded], half: usize, odd: [bool; 2]) -> Components {
        let parity = PARITIES.iter().position(|one| *one == odd).unwrap_or(0);
        let mut rows: Vec<[f64; HALF * HALF]> = galaxies.iter().map(|one| one[parity]).collect();
        let mut basis = Basis::default();
        for free in free(&rows, half, odd) {
            basis.add(free, &mut rows);
        }
        let count = basis.vectors.len();
        // The directions of those galaxies that the earlier directions explain the least.
        while basis.vectors.len() < COMPONENTS {
            let size = |row: &[f64; HALF * HALF]| dot(row, row);
            let Some(least) = rows.iter().max_by(|a, b| size(a).total_cmp(&size(b))) else {
                break;
            };
            basis.add(*least, &mut rows);
        }
        let (vectors, variances) = basis.principal(galaxies, parity, count);
        let mut components = Components {
            shapes: [[0.0; QUADRANT]; COMPONENTS],
            smoothed: [[0.0; QUADRANT]; COMPONENTS],
            variances: variances.map(|variance| variance as f32),
        };
        for (k, vector) in vectors.iter().enumerate() {
            for at in 0..HALF * HALF {
                components.shapes[k][at] = vector[at] as f32;
                components.smoothed[k][at] = under_a_neighbour(vector, half, odd, at) as f32;
            }
        }
        components
    }
}

/// Components whose amplitude is free: a sky, its gradients, and the mean galaxy.
fn free(rows: &[[f64; HALF * HALF]], half: usize, odd: [bool; 2]) -> Vec<[f64; HALF * HALF]> {
    let field = |value: &dyn Fn(usize) -> f64| {
        std::array::from_fn(|at| {
            let on = at % HALF < half && at / HALF < half;
            if on { value(at) } else { 0.0 }
        })
    };
    let mean = || field(&|at| rows.iter().map(|row| row[at]).sum::<f64>() / rows.len() as f64);
    match odd {
        [false, false] => vec![field(&|_| 1.0), mean()],
        [true, false] => vec![field(&|at| (at % HALF) as f64 + 0.5)],
        [false, true] => vec![field(&|at| (at / HALF) as f64 + 0.5)],
        [true, true] => Vec::new(),
    }
}

/// Directions at right angles, of length one.
#[derive(Default)]
struct Basis {
    vectors: Vec<[f64; HALF * HALF]>,
}

impl Basis {
    /// Adds what is new in `vector`, and takes it from the rows. A vector with nothing new adds zeros.
    fn add(&mut self, vector: [f64; HALF * HALF], rows: &mut [[f64; HALF * HALF]]) {
        let mut new = vector;
        // Once more for what rounding leaves.
        for _ in 0..2 {
            for old in &self.vectors {
                take(&mut new, old);
            }
        }
        let size = dot(&new, &new).sqrt();
        let scale = if size > 1e-9 * dot(&vector, &vector).sqrt() {
            1.0 / size
        } else {
            0.0
        };
        let new = new.map(|value| scale * value);
        for row in rows.iter_mut() {
            take(row, &new);
        }
        self.vectors.push(new);
    }

    /// Principal components of the galaxies in the space of the vectors, after the first `free` ones, which are kept.
    fn principal(
        &self,
        galaxies: &[Folded],
        parity: usize,
        free: usize,
    ) -> ([[f64; HALF * HALF]; COMPONENTS], [f64; COMPONENTS]) {
        let mut products = [[0.0; COMPONENTS]; COMPONENTS];
        for galaxy in galaxies {
            let mut amplitudes = [0.0; COMPONENTS];
            for (amplitude, vector) in amplitudes.iter_mut().zip(&self.vectors).skip(free) {
                *amplitude = dot(&galaxy[parity], vector);
            }
            for (row, a) in products.iter_mut().zip(amplitudes) {
                for (product, b) in row.iter_mut().zip(amplitudes) {
                    *product += a * b / galaxies.len() as f64;
                }
            }
        }
        let axes = eigenvectors(&mut products);
        let vectors = axes.map(|axis| {
            let mut sum = [0.0; HALF * HALF];
            for (share, vector) in axis.iter().zip(&self.vectors) {
                for (sum, value) in sum.iter_mut().zip(vector) {
                    *sum += share * value;
                }
            }
            sum
        });
        let variances = std::array::from_fn(|k| {
            if k < free {
                f64::INFINITY
            } else {
                products[k][k]
            }
        });
        (vectors, variances)
    }
}

fn dot(a: &[f64; HALF * HALF], b: &[f64; HALF * HALF]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Takes from `vector` what is along a direction of length one.
fn take(vector: &mut [f64; HALF * HALF], direction: &[f64; HALF * HALF]) {
    let along = dot(vector, direction);
    for (value, step) in vector.iter_mut().zip(direction) {
        *value -= along * step;
    }
}

/// The product of a component with a neighbour of flux 1 in the middle of a cell of the positive quadrant.
fn under_a_neighbour(vector: &[f64; HALF * HALF], half: usize, odd: [bool; 2], at: usize) -> f64 {
    let reach = REACH as i32;
    let mut sum = 0.0;
    for down in -reach..=reach {
        for along in -reach..=reach {
            let (x, y) = ((at % HALF) as i32 + along, (at / HALF) as i32 + down);
            if !on_cells(x, half) || !on_cells(y, half) {
                continue;
            }
            // Cell −1 is the mirror image of cell 0.
            let mirror = |cell: i32| if cell < 0 { -1 - cell } else { cell } as usize;
            let side = [x, y].map(|cell| if cell < 0 { -1.0 } else { 1.0 });
            let light = neighbour(along) * neighbour(down);
            sum += 0.5 * sign(odd, side) * light * vector[mirror(y) * HALF + mirror(x)];
        }
    }
    sum
}
