//! Q of arrays of ellipticities against the true shear.
#![expect(clippy::print_stdout, reason = "an example prints its results")]

use ndarray::Array2;
use shearq_scoring::{Choice, Convention, Grid, Options, SetImages, SetScorer, TrueShear};

fn main() -> Result<(), shearq_scoring::ScoringError> {
    let grid = Grid::great10(24)?; // 24 × 24 galaxies on 10 degrees, index [ix, iy]
    // Replace these with your arrays: a true shear of one wave, and two images with m = 0.01.
    let g1 = Array2::from_shape_fn((24, 24), |(ix, _)| 0.02 * (ix as f64 * 0.785).cos());
    let (e1, zeros) = (1.01 * &g1, Array2::zeros((24, 24)));

    let images = SetImages::of_arrays(&grid, [[e1.view(), zeros.view()]; 2])?; // NaN: not measured
    let truth = TrueShear {
        g1,
        g2: zeros.clone(),
    };
    let options = Options {
        choice: Choice::Insist(Convention::STANDARD),
        ..Options::default()
    };
    let score = SetScorer::new(grid, truth, options)?.score(&images)?;
    println!(
        "Q = {:.1} ± {:.1}, m = {:.4}",
        score.metrics.q, score.errors.q, score.metrics.m_cross
    );
    assert!((score.metrics.m_cross - 0.01).abs() < 1e-9);
    Ok(())
}
