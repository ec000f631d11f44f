//! Fields and random numbers that tests of the scoring share.
use ndarray::Array2;
use shearq_quantities::fourier::Complex64;
use shearq_scoring::modes::{Decomposer, Modes};
use shearq_scoring::{
    Choice, Convention, Definition, FieldSum, Grid, Options, Row, RowCounts, SetImages, SetScore,
    SetScorer, TrueShear,
};

/// Standard normal numbers from a linear congruential generator (Box–Muller).
pub struct Normal(pub u64);

impl Normal {
    pub fn uniform(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    pub fn draw(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        radius * (2.0 * std::f64::consts::PI * self.uniform()).cos()
    }
}

/// Which modes a test field has.
#[derive(Clone, Copy, PartialEq)]
pub enum Content {
    E,
    B,
    Mixed,
}

/// A Gaussian field with C_ℓ ∝ 1/ℓ² below the Nyquist multipole, rms of a few per cent.
pub fn field(grid: &Grid, content: Content, seed: u64) -> Array2<Complex64> {
    let n = grid.n;
    let mut normal = Normal(seed);
    let decomposer = Decomposer::new(*grid);
    let white = Array2::from_shape_fn((n, n), |_| Complex64::new(normal.draw(), normal.draw()));
    let Modes { mut e, mut b } = decomposer.decompose(white).unwrap();
    for ((i, j), value) in e.indexed_iter_mut() {
        let f = |k: usize| {
            if 2 * k > n {
                k as f64 - n as f64
            } else {
                k as f64
            }
        };
        let l = f(i).hypot(f(j));
        let inside = l > 0.0 && 2.0 * l < n as f64 && 2 * i != n && 2 * j != n;
        let scale = if inside { 0.02 / l } else { 0.0 };
        *value *= scale;
        b[(i, j)] *= scale;
    }
    if content == Content::E {
        b.fill(Complex64::ZERO);
    }
    if content == Content::B {
        e.fill(Complex64::ZERO);
    }
    decomposer.compose(&Modes { e, b }).unwrap()
}

pub fn rows(grid: &Grid, field: &Array2<Complex64>) -> Vec<Row> {
    let row = |((ix, iy), e): ((usize, usize), &Complex64)| {
        let (x, y) = grid.centre(ix, iy);
        Row {
            x,
            y,
            e1: e.re,
            e2: e.im,
        }
    };
    field.indexed_iter().map(row).collect()
}

pub fn truth(field: &Array2<Complex64>) -> TrueShear {
    TrueShear {
        g1: field.mapv(|g| g.re),
        g2: field.mapv(|g| g.im),
    }
}

/// One image of rows on the grid.
pub fn sum_of(grid: &Grid, rows: &[Row]) -> (FieldSum, RowCounts) {
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, rows.iter().copied());
    (sum, counts)
}

/// Adds an image of ellipticities to those of a set.
pub fn add(images: &mut SetImages, grid: &Grid, ellipticities: &Array2<Complex64>) {
    let (sum, _) = sum_of(grid, &rows(grid, ellipticities));
    images.add(&sum).unwrap();
}

/// Images of a shear, each with noise of its `sigma` per component; galaxies for which `keep` is false are missing.
pub fn images(
    grid: &Grid,
    shear: &Array2<Complex64>,
    sigmas: &[f64],
    seed: u64,
    keep: impl Fn(usize, usize) -> bool,
) -> SetImages {
    let mut normal = Normal(seed);
    let mut images = SetImages::new(grid);
    for (image, sigma) in sigmas.iter().enumerate() {
        let mut number = 0;
        let observed = shear.mapv(|g| {
            let noise = Complex64::new(sigma * normal.draw(), sigma * normal.draw());
            number += 1;
            match keep(image, number - 1) {
                true => g + noise,
                false => Complex64::new(f64::NAN, f64::NAN),
            }
        });
        add(&mut images, grid, &observed);
    }
    images
}

/// A definition in the standard convention.
pub fn standard(definition: Definition) -> Options {
    Options {
        definition,
        choice: Choice::Insist(Convention::STANDARD),
        ..Options::default()
    }
}

pub fn score(grid: Grid, truth: TrueShear, images: &SetImages, options: Options) -> SetScore {
    let scorer = SetScorer::new(grid, truth, options).unwrap();
    scorer.score(images).unwrap()
}

/// Rounding of sums of a few hundred terms.
pub fn close(found: f64, expected: f64, what: &str) {
    let scale = expected.abs().max(1e-300);
    let apart = (found - expected).abs();
    assert!(apart <= 1e-10 * scale, "{what}: {found} is not {expected}");
}
