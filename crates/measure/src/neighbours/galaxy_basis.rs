//! Principal components of the light of isolated galaxies, with which [`super::candidate`] separates a galaxy's shape from a
//! neighbour.
//!
//! A reference population of isolated galaxies behind PSFs, with a wide range of sizes, ellipticities and displacements, is
//! drawn on cells of 2 × 2 pixels. Its principal components with the variances of their amplitudes are a prior: light that
//! they explain belongs to the galaxy, and the residual is compared with a neighbour.
//!
//! The population is symmetric under reflection of either axis and under exchange of both. The components are therefore even
//! or odd along each axis, so that one quadrant of the cells determines them, in a quarter of the time and memory.

use std::f64::consts::PI;
use std::sync::OnceLock;

use shearq_quantities::linear::eigenvectors;

use crate::asymmetry::INNER_HALF_SIDE;
use crate::deconvolve::uniform;

// Pixels on a side of a cell.
// Smaller than the PSF's FWHM, with a quarter of the products that single pixels take. Chosen by hand.
pub(super) const CELL_SIDE: usize = 2;
// Cells from the centre to an edge, at most.
// 48 px less two on each side, for galaxies off the centre.
pub(super) const HALF_SIDE: usize = 11;
// Cells of a quadrant in rows of HALF_SIDE, padded with zeros to whole SIMD vectors.
pub(super) const QUADRANT: usize = (HALF_SIDE * HALF_SIDE).next_multiple_of(16);
// Components of each parity, those of the largest variances.
// With 12, three times as many Gaussian galaxies are flagged at S/N 50.
pub(super) const COMPONENTS: usize = 16;
// Galaxies that span the space in which the components are found. All 600 would make the eigenvectors take longer than many
// galaxies; with few more than COMPONENTS, the last components would not converge. Chosen by hand.
const SEARCH_DIMENSIONS: usize = 32;
// Whether a component is odd along x and along y.
pub(super) const PARITIES: [[bool; 2]; 4] =
    [[false, false], [true, true], [true, false], [false, true]];
// Whether x and y are negative in a quadrant.
pub(super) const QUADRANT_SIGNS: [[bool; 2]; 4] =
    [[false, false], [true, false], [false, true], [true, true]];
// σ of the Gaussian that is the model of a neighbour: 3 px, a typical galaxy of the population behind its PSF. Chosen by hand.
const NEIGHBOUR_SIGMA_CELLS: f64 = 1.5;
// Cells from the centre of the neighbour to the edge of its model, at 2.7 σ. Chosen by hand.
pub(super) const NEIGHBOUR_HALF_SIDE: usize = 4;

// Galaxies that are drawn; each is used again with exchanged axes. With 6,000 galaxies instead, the share of neighbours found
// changes by 0.2 %.
const POPULATION_SIZE: usize = 300;
// In pixels before the PSF: from unresolved ones to half-light radii of 10 px. Chosen by hand.
const GALAXY_SCALES_PX: [f64; 2] = [0.5, 8.0];
// At 0.8, four times as many galaxies with an ellipticity of 0.75 are flagged.
const MAX_ELLIPTICITY: f64 = 0.9;
// In pixels along an axis: half a pixel, and the error of the centre.
const MAX_DISPLACEMENT: f64 = 0.55;
// σ in pixels: FWHM of 2.4 to 5.7 px. A wider range finds 2 % fewer neighbours at 5 to 7 px.
const PSF_SIGMAS: [f64; 2] = [1.0, 2.4];
// Range from which the share of a galaxy's light in a single Gaussian is drawn. Negative shares become zero, so that a third of
// the galaxies have a bulge and a disc only.
// Without such galaxies, 3 instead of 0.9 % of Gaussian galaxies with a half-light radius of 8 px are flagged at S/N 20.
const GAUSSIAN_SHARES: [f64; 2] = [-0.5, 1.0];
// σ of the concentric Gaussians of a galaxy in units of its scale.
// Steps of 2: a bulge, a disc and wings. The last one is the single Gaussian.
const GALAXY_SIGMAS: [f64; 5] = [0.35, 0.75, 1.5, 2.8, 1.0];
// The square whose sum is the unit of the galaxy's light, as in the asymmetry.
const INNER_HALF_CELLS: usize = INNER_HALF_SIDE as usize / CELL_SIDE;
const SEED: u64 = 0x6761_6c61_7879; // "galaxy" in ASCII.

pub(super) type Quadrant = [f32; QUADRANT];
type Cells = [f64; HALF_SIDE * HALF_SIDE];
// The even and odd parts of a galaxy's light in the positive quadrant, one for each of PARITIES, in units of the galaxy's
// light within INNER_HALF_CELLS.
type Folded = [Cells; 4];

// Of one parity, orthonormal over all cells.
pub(super) struct Components {
    // In the positive quadrant, times two: the norm is one over this quadrant.
    pub(super) shapes: [Quadrant; COMPONENTS],
    // The scalar product of a component with a neighbour centred on each cell.
    pub(super) smoothed: [Quadrant; COMPONENTS],
    // Of the amplitudes, in units of the galaxy's light squared; infinite for components without a prior, as flux and sky.
    pub(super) variances: [f32; COMPONENTS],
}

pub(super) struct GalaxyBasis {
    /// Cells from the centre to an edge.
    pub(super) half_side: usize,
    pub(super) components: [Components; 4],
    // Norm squared of a neighbour centred on each cell, without the light beyond the cells.
    pub(super) squares: Quadrant,
}

impl GalaxyBasis {
    // Once per process, because it takes longer than many galaxies.
    pub(super) fn for_half_side(half: usize) -> &'static GalaxyBasis {
        static ALL: [OnceLock<GalaxyBasis>; HALF_SIDE + 1] =
            [const { OnceLock::new() }; HALF_SIDE + 1];
        let half = half.min(HALF_SIDE);
        ALL[half].get_or_init(|| GalaxyBasis::new(half))
    }

    fn new(half: usize) -> GalaxyBasis {
        let galaxies = reference_population(half);
        let components = std::array::from_fn(|parity| Components::new(&galaxies, half, parity));
        let along: [f64; HALF_SIDE] = std::array::from_fn(|at| {
            let cells = NEIGHBOUR_HALF_SIDE as i32;
            let light = (-cells..=cells).filter(|step| on_cells(at as i32 + step, half));
            light.map(|step| neighbour_light(step).powi(2)).sum()
        });
        let mut squares = [0.0; QUADRANT];
        for (at, square) in squares.iter_mut().take(HALF_SIDE * HALF_SIDE).enumerate() {
            *square = (along[at % HALF_SIDE] * along[at / HALF_SIDE]) as f32;
        }
        GalaxyBasis {
            half_side: half,
            components,
            squares,
        }
    }
}

fn on_cells(at: i32, half: usize) -> bool {
    (-(half as i32)..half as i32).contains(&at)
}

/// Light of a neighbour of flux 1 along one axis, this many cells from its middle.
pub(super) fn neighbour_light(step: i32) -> f64 {
    let offset = f64::from(step) / NEIGHBOUR_SIGMA_CELLS;
    (-0.5 * offset * offset).exp() / ((2.0 * PI).sqrt() * NEIGHBOUR_SIGMA_CELLS)
}

// Each galaxy is added again with exchanged axes, which makes the components as symmetric as the cells.
fn reference_population(half: usize) -> Vec<Folded> {
    let mut state = SEED;
    let mut within = move |[low, high]: [f64; 2]| low + (high - low) * uniform(&mut state);
    let mut galaxies = Vec::with_capacity(2 * POPULATION_SIZE);
    for _ in 0..POPULATION_SIZE {
        let galaxy = Galaxy {
            scale: within(GALAXY_SCALES_PX.map(f64::ln)).exp(),
            // The root makes the density uniform in the plane of both components.
            ellipticity: MAX_ELLIPTICITY * within([0.0, 1.0]).sqrt(),
            angle: within([0.0, PI]),
            bulge: within([0.0, 1.0]),
            gaussian: within(GAUSSIAN_SHARES).max(0.0),
            centre: [(); 2].map(|()| within([-MAX_DISPLACEMENT, MAX_DISPLACEMENT])),
            psf_sigma: within(PSF_SIGMAS.map(f64::ln)).exp(),
        };
        let folded = galaxy.folded(half);
        galaxies.push(folded);
        let exchanged = [0, 1, 3, 2].map(|parity: usize| {
            std::array::from_fn(|at| folded[parity][at % HALF_SIDE * HALF_SIDE + at / HALF_SIDE])
        });
        galaxies.push(exchanged);
    }
    galaxies
}

/// Concentric Gaussians of one ellipticity behind a Gaussian PSF; lengths in pixels.
struct Galaxy {
    scale: f64,
    ellipticity: f64,
    angle: f64,
    bulge: f64,
    /// Share of the light with a Gaussian profile.
    gaussian: f64,
    centre: [f64; 2],
    psf_sigma: f64,
}

impl Galaxy {
    fn cells(&self, half: usize) -> Vec<f64> {
        let along = 2 * half;
        let mut cells = vec![0.0; along * along];
        let bulge = self.bulge;
        // Light of the Gaussians of GALAXY_SIGMAS: bulge, middle, disc, wings, and the single one. A stronger bulge takes from
        // the disc. Chosen by hand.
        let core = 1.0 - self.gaussian;
        let lights = [
            core * 0.5 * bulge,
            core * 0.5,
            core * 0.4 * (1.0 - 0.5 * bulge),
            core * 0.12,
            self.gaussian,
        ];
        let stretch = (1.0 + self.ellipticity) / (1.0 - self.ellipticity);
        let (sin, cos) = self.angle.sin_cos();
        for (light, width) in lights.into_iter().zip(GALAXY_SIGMAS) {
            let square = (self.scale * width).powi(2);
            let (long, short) = (square * stretch, square / stretch);
            let xx = long * cos * cos + short * sin * sin + self.psf_sigma * self.psf_sigma;
            let yy = long * sin * sin + short * cos * cos + self.psf_sigma * self.psf_sigma;
            let xy = (long - short) * sin * cos;
            let determinant = xx * yy - xy * xy;
            // The logarithm of the light is a x² + b y² + c x y.
            let [a, b, c] = [yy, xx, -2.0 * xy].map(|term| -0.5 * term / determinant);
            let from = 0.5 - (CELL_SIDE * half) as f64;
            let x = from - self.centre[0];
            let peak = light / determinant.sqrt();
            // Along a row the logarithm is a quadratic function, so that the ratio of neighbouring pixels changes by the factor
            // exp(2a): two products instead of an exponential per pixel.
            let change = (2.0 * a).exp();
            for row in 0..CELL_SIDE * along {
                let y = from + row as f64 - self.centre[1];
                let mut pixel = peak * (a * x * x + b * y * y + c * x * y).exp();
                let mut factor = (a * (2.0 * x + 1.0) + c * y).exp();
                let line = &mut cells[row / CELL_SIDE * along..][..along];
                for cell in line {
                    for _ in 0..CELL_SIDE {
                        *cell += pixel;
                        pixel *= factor;
                        factor *= change;
                    }
                }
            }
        }
        cells
    }

    fn folded(&self, half: usize) -> Folded {
        let along = 2 * half;
        let cells = self.cells(half);
        let mut folded = [[0.0; HALF_SIDE * HALF_SIDE]; 4];
        for at in
            (0..HALF_SIDE * HALF_SIDE).filter(|at| at % HALF_SIDE < half && at / HALF_SIDE < half)
        {
            for side in QUADRANT_SIGNS {
                let (x, y) = (
                    mirrored(half, at % HALF_SIDE, side[0]),
                    mirrored(half, at / HALF_SIDE, side[1]),
                );
                let light = cells[y * along + x];
                for (out, odd) in folded.iter_mut().zip(PARITIES) {
                    out[at] += 0.5 * parity_sign(odd, side) * light;
                }
            }
        }
        // `folded` has half of the sum over the four quadrants.
        let inner = (0..HALF_SIDE * HALF_SIDE)
            .filter(|at| at % HALF_SIDE < INNER_HALF_CELLS && at / HALF_SIDE < INNER_HALF_CELLS);
        let light = 2.0 * inner.map(|at| folded[0][at]).sum::<f64>();
        folded.map(|cells| cells.map(|value| value / light))
    }
}

// Index along an axis, counted from the edge, of the `cell`-th cell from the centre.
#[inline(always)]
pub(super) fn mirrored(half: usize, cell: usize, negative: bool) -> usize {
    if negative {
        half - 1 - cell
    } else {
        half + cell
    }
}

/// Sign of a component of parities `odd` on the `negative` side of these axes.
pub(super) fn parity_sign(odd: [bool; 2], negative: [bool; 2]) -> f64 {
    if (odd[0] && negative[0]) == (odd[1] && negative[1]) {
        1.0
    } else {
        -1.0
    }
}

impl Components {
    fn new(galaxies: &[Folded], half: usize, parity: usize) -> Components {
        let odd = PARITIES[parity];
        let mut rows: Vec<Cells> = galaxies.iter().map(|one| one[parity]).collect();
        let mut basis = Basis::default();
        for component in unconstrained_components(&rows, half, odd) {
            basis.add(component, &mut rows);
        }
        let unconstrained = basis.vectors.len();
        // Greedy pivoting as in a pivoted Cholesky decomposition: the next vector is the galaxy with the largest residual.
        while basis.vectors.len() < SEARCH_DIMENSIONS {
            let sizes = rows.iter().map(|row| (dot(row, row), row));
            let Some((_, unexplained)) = sizes.max_by(|a, b| a.0.total_cmp(&b.0)) else {
                break;
            };
            basis.add(*unexplained, &mut rows);
        }
        let (vectors, variances) = basis.principal(galaxies, parity, unconstrained);
        let mut components = Components {
            shapes: [[0.0; QUADRANT]; COMPONENTS],
            smoothed: [[0.0; QUADRANT]; COMPONENTS],
            variances: variances.map(|variance| variance as f32),
        };
        let light = std::array::from_fn(|step| neighbour_light(step as i32));
        for (k, vector) in vectors.iter().enumerate() {
            for at in 0..HALF_SIDE * HALF_SIDE {
                components.shapes[k][at] = vector[at] as f32;
                components.smoothed[k][at] =
                    overlap_with_neighbour(vector, half, odd, &light, at) as f32;
            }
        }
        components
    }
}

// Components without a prior on their amplitudes: a constant sky, its gradients, and the mean galaxy, whose amplitude is flux.
fn unconstrained_components(rows: &[Cells], half: usize, odd: [bool; 2]) -> Vec<Cells> {
    let field = |value: &dyn Fn(usize) -> f64| {
        std::array::from_fn(|at| {
            let on = at % HALF_SIDE < half && at / HALF_SIDE < half;
            if on { value(at) } else { 0.0 }
        })
    };
    let mean = || field(&|at| rows.iter().map(|row| row[at]).sum::<f64>() / rows.len() as f64);
    match odd {
        [false, false] => vec![field(&|_| 1.0), mean()],
        [true, false] => vec![field(&|at| (at % HALF_SIDE) as f64 + 0.5)],
        [false, true] => vec![field(&|at| (at / HALF_SIDE) as f64 + 0.5)],
        [true, true] => Vec::new(),
    }
}

// Orthonormal vectors, or zeros.
#[derive(Default)]
struct Basis {
    vectors: Vec<Cells>,
}

impl Basis {
    // A Gram–Schmidt step. A vector that depends linearly on the others adds zeros, so that the number of vectors stays known.
    fn add(&mut self, vector: Cells, rows: &mut [Cells]) {
        let mut new = vector;
        // Rounding leaves parts of the other vectors after one pass; "twice is enough" (Kahan, in Parlett 1980, Sect. 6.9).
        for _ in 0..2 {
            for old in &self.vectors {
                project_out(&mut new, old);
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
            project_out(row, &new);
        }
        self.vectors.push(new);
    }

    // Principal components of the galaxies in the space of the vectors. The first `unconstrained` vectors are components
    // themselves.
    fn principal(
        &self,
        galaxies: &[Folded],
        parity: usize,
        unconstrained: usize,
    ) -> ([Cells; COMPONENTS], [f64; COMPONENTS]) {
        let mut products = [[0.0; SEARCH_DIMENSIONS]; SEARCH_DIMENSIONS];
        for galaxy in galaxies {
            let mut amplitudes = [0.0; SEARCH_DIMENSIONS];
            for (amplitude, vector) in amplitudes.iter_mut().zip(&self.vectors).skip(unconstrained)
            {
                *amplitude = dot(&galaxy[parity], vector);
            }
            for (row, a) in products.iter_mut().zip(amplitudes) {
                for (product, b) in row.iter_mut().zip(amplitudes) {
                    *product += a * b / galaxies.len() as f64;
                }
            }
        }
        let axes = eigenvectors(&mut products);
        // Without products, unconstrained vectors are eigenvectors of eigenvalue 0, and infinity sorts them first.
        let variance = |k: usize| {
            if k < unconstrained {
                f64::INFINITY
            } else {
                products[k][k]
            }
        };
        let mut order: [usize; SEARCH_DIMENSIONS] = std::array::from_fn(|k| k);
        order.sort_by(|a, b| variance(*b).total_cmp(&variance(*a)));
        let vectors = std::array::from_fn(|k| {
            let mut sum = [0.0; HALF_SIDE * HALF_SIDE];
            for (share, vector) in axes[order[k]].iter().zip(&self.vectors) {
                for (sum, value) in sum.iter_mut().zip(vector) {
                    *sum += share * value;
                }
            }
            sum
        });
        (vectors, std::array::from_fn(|k| variance(order[k])))
    }
}

// A sum per column, so that additions do not wait for each other and vectorise.
fn dot(a: &Cells, b: &Cells) -> f64 {
    let mut columns = [0.0; HALF_SIDE];
    for (a, b) in a.chunks_exact(HALF_SIDE).zip(b.chunks_exact(HALF_SIDE)) {
        for ((sum, a), b) in columns.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    columns.iter().sum()
}

fn project_out(vector: &mut Cells, direction: &Cells) {
    let along = dot(vector, direction);
    for (value, step) in vector.iter_mut().zip(direction) {
        *value -= along * step;
    }
}

// Scalar product of a component with a neighbour of flux 1 that is centred on a cell of the positive quadrant. `light` is the
// profile of the neighbour along an axis, from its centre on.
fn overlap_with_neighbour(
    vector: &Cells,
    half: usize,
    odd: [bool; 2],
    light: &[f64; NEIGHBOUR_HALF_SIDE + 1],
    at: usize,
) -> f64 {
    let cells = NEIGHBOUR_HALF_SIDE as i32;
    let mut sum = 0.0;
    for down in -cells..=cells {
        for along in -cells..=cells {
            let (x, y) = (
                (at % HALF_SIDE) as i32 + along,
                (at / HALF_SIDE) as i32 + down,
            );
            if !on_cells(x, half) || !on_cells(y, half) {
                continue;
            }
            // The centre of the stamp lies between cells −1 and 0.
            let mirror = |cell: i32| if cell < 0 { -1 - cell } else { cell } as usize;
            let side = [x, y].map(|cell| cell < 0);
            let [across, along] = [along, down].map(|step| light[step.unsigned_abs() as usize]);
            let value = vector[mirror(y) * HALF_SIDE + mirror(x)];
            sum += 0.5 * parity_sign(odd, side) * across * along * value;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    fn galaxy(scale: f64, ellipticity: f64, angle: f64, centre: [f64; 2]) -> Galaxy {
        Galaxy {
            scale,
            ellipticity,
            angle,
            bulge: 0.4,
            gaussian: 0.0,
            centre,
            psf_sigma: 1.5,
        }
    }

    /// Sums over cells of the light times 1, x, y, x², xy and y².
    fn sums(cells: &[f64]) -> [f64; 6] {
        let mut sums = [0.0; 6];
        for (at, light) in cells.iter().enumerate() {
            let middle = |cell: usize| CELL_SIDE as f64 * (cell as f64 + 0.5 - HALF_SIDE as f64);
            let (x, y) = (middle(at % (2 * HALF_SIDE)), middle(at / (2 * HALF_SIDE)));
            for (sum, term) in sums.iter_mut().zip([1.0, x, y, x * x, x * y, y * y]) {
                *sum += term * light;
            }
        }
        sums
    }

    #[test]
    fn galaxies_have_their_position_and_angle() {
        for (scale, angle, centre) in [(2.0, 0.3, [0.4, -0.2]), (3.0, 2.0, [-0.5, 0.5])] {
            let cells = galaxy(scale, 0.3, angle, centre).cells(HALF_SIDE);
            let [all, x, y, xx, xy, yy] = sums(&cells);
            let (x, y) = (x / all, y / all);
            // 2 % of the light of the larger one is beyond the cells, on one side more than on the other.
            assert!(
                (x - centre[0]).abs() < 0.05 && (y - centre[1]).abs() < 0.05,
                "{x} {y}"
            );
            let found = 0.5 * (2.0 * xy / all - 2.0 * x * y).atan2((xx - yy) / all - x * x + y * y);
            let apart = (found - angle).rem_euclid(PI);
            assert!(apart.min(PI - apart) < 0.05, "{found} {angle}");
        }
    }

    #[test]
    fn a_single_gaussian_has_the_variance_of_its_scale() {
        let galaxy = Galaxy {
            gaussian: 1.0,
            ..galaxy(3.0, 0.3, 0.6, [0.0; 2])
        };
        let [all, _, _, xx, _, yy] = sums(&galaxy.cells(HALF_SIDE));
        let stretch: f64 = 1.3 / 0.7;
        let expected = 9.0 * (stretch + 1.0 / stretch) + 2.0 * 1.5 * 1.5;
        // Sheppard: the middle of a cell instead of its pixels adds 2 (4 − 1)/12 px². A tail of 10⁻³ is beyond the cells.
        let found = (xx + yy) / all - 0.5;
        assert!((found / expected - 1.0).abs() < 0.01, "{found} {expected}");
    }

    #[test]
    fn components_are_orthonormal_and_symmetric() {
        let basis = GalaxyBasis::for_half_side(HALF_SIDE);
        for components in &basis.components {
            for (i, a) in components.shapes.iter().enumerate() {
                for (j, b) in components.shapes.iter().enumerate() {
                    let product: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                    // A hundred products of f32.
                    assert!(
                        (product - f32::from(u8::from(i == j))).abs() < 1e-5,
                        "{i} {j} {product}"
                    );
                }
            }
            assert!(components.variances.is_sorted_by(|a, b| a >= b && *b > 0.0));
        }
        let [_, _, x, y] = &basis.components;
        for k in 0..COMPONENTS {
            assert!((x.variances[k] / y.variances[k] - 1.0).abs() < 1e-3 || k == 0);
            let product: f32 = (0..HALF_SIDE * HALF_SIDE)
                .map(|at| {
                    x.shapes[k][at] * y.shapes[k][at % HALF_SIDE * HALF_SIDE + at / HALF_SIDE]
                })
                .sum();
            // Of either sign.
            assert!((product.abs() - 1.0).abs() < 1e-3, "{k} {product}");
        }
    }

    #[test]
    fn galaxies_are_explained_and_pairs_are_not() {
        let basis = GalaxyBasis::for_half_side(HALF_SIDE);
        // The squared residual, in units of the squared light.
        let left = |folded: &Folded| -> f64 {
            let parts = basis.components.iter().zip(folded);
            let parts = parts.map(|(components, light)| {
                let mut left = dot(light, light);
                for shape in &components.shapes {
                    let along: f64 = light
                        .iter()
                        .zip(shape)
                        .map(|(a, b)| a * f64::from(*b))
                        .sum();
                    left -= along * along;
                }
                left / (light.iter().sum::<f64>().powi(2) + 1.0)
            });
            parts.sum()
        };
        let mut most = 0.0f64;
        for ellipticity in [0.0, 0.5, 0.7] {
            for angle in [0.2, 1.0, 2.5] {
                for gaussian in [0.0, 1.0] {
                    let galaxy = galaxy(2.0, ellipticity, angle, [0.3, -0.4]);
                    most = most.max(left(&Galaxy { gaussian, ..galaxy }.folded(HALF_SIDE)));
                }
            }
        }
        let (first, second) = (
            galaxy(2.0, 0.1, 0.0, [0.0; 2]),
            galaxy(2.0, 0.1, 1.0, [7.0, 3.0]),
        );
        let (first, second) = (first.folded(HALF_SIDE), second.folded(HALF_SIDE));
        let pair = std::array::from_fn(|k| std::array::from_fn(|at| first[k][at] + second[k][at]));
        assert!(most < 0.02 * left(&pair), "{most} {}", left(&pair));
    }
}
