//! E- and B-mode bandpowers of a field of ellipticities.
#![expect(clippy::print_stdout, reason = "an example prints its results")]

use ndarray::Array2;
use shearq_scoring::modes::Decomposer;
use shearq_scoring::{Bins, Convention, Definition, Grid, SCORED};

fn main() -> Result<(), shearq_scoring::ScoringError> {
    let grid = Grid::great10(24)?; // 24 × 24 galaxies on 10 degrees, index [ix, iy]
    let e1 = Array2::from_shape_fn((24, 24), |(ix, _)| 0.02 * (ix as f64 * 0.785).cos());
    let e2 = Array2::zeros((24, 24));

    let modes = Decomposer::new(grid).decompose(Convention::STANDARD.apply(&e1, &e2)?)?;
    let bins = Bins::new(&grid, Definition::Corrected);
    let ee = bins.power(&modes.e, &modes.e)?;
    let bb = bins.power(&modes.b, &modes.b)?;
    for b in SCORED {
        println!(
            "l = {:6.1}  EE = {:.3e}  BB = {:.3e}",
            bins.l[b], ee[b], bb[b]
        );
    }
    assert!(SCORED.map(|b| ee[b]).sum::<f64>() > 1e3 * SCORED.map(|b| bb[b]).sum::<f64>());
    Ok(())
}
