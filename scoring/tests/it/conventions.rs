//! A catalogue's metrics are the same in whichever convention it comes.

use ndarray::Array2;
use shearq_quantities::fourier::Complex64;
use shearq_scoring::{
    Choice, Convention, Definition, FieldSum, Grid, Metrics, Noise, Options, Row, SetImages,
    SetScore, SetScorer,
};

use crate::common::{Content, Normal, field, rows, truth};

/// What a submitter of convention `k` hands in for rows in the standard one.
fn submitted(grid: &Grid, rows: &[Row], k: Convention) -> Vec<Row> {
    let (s1, s2) = k.signs();
    let turned = |row: &Row| {
        let (ix, iy) = grid.cell(row.x, row.y).unwrap();
        let (x, y) = match k.transposes() {
            true => grid.centre(iy, ix),
            false => grid.centre(ix, iy),
        };
        Row {
            x,
            y,
            e1: s1 * row.e1,
            e2: s2 * row.e2,
        }
    };
    rows.iter().map(turned).collect()
}

/// Six images of shear, intrinsic B modes and noise, one galaxy in 13 missing, in the convention `k`.
fn score(grid: Grid, k: Convention, options: Options) -> SetScore {
    let shear = field(&grid, Content::E, 21);
    let mut normal = Normal(9);
    let mut images = SetImages::new(&grid);
    for image in 0..6 {
        let shapes = field(&grid, Content::B, 100 + image as u64);
        let observed = Array2::from_shape_fn(shear.dim(), |at| {
            let noise = Complex64::new(0.004 * normal.draw(), 0.004 * normal.draw());
            shear[at] * 0.97 + shapes[at] + noise + Complex64::new(0.001, -0.002)
        });
        let mut all = rows(&grid, &observed);
        let mut number = image;
        all.retain(|_| {
            number += 1;
            number % 13 != 0
        });
        let mut sum = FieldSum::new(&grid);
        sum.add_image(&grid, submitted(&grid, &all, k));
        images.add(&sum).unwrap();
    }
    SetScorer::new(grid, truth(&shear), options)
        .unwrap()
        .score(&images)
        .unwrap()
}

#[test]
fn figures_and_errors_do_not_depend_on_the_convention() {
    for n in [24, 25] {
        let grid = Grid::great10(n).unwrap();
        for definition in [Definition::Leaderboard, Definition::Corrected] {
            for noise in [Noise::Measured, Noise::Given(0.004 * 0.004)] {
                let of = |k, choice| {
                    let options = Options {
                        definition,
                        noise,
                        choice,
                    };
                    score(grid, k, options)
                };
                let standard = of(Convention::STANDARD, Choice::Insist(Convention::STANDARD));
                let expected = [standard.metrics, standard.errors, standard.replicates[3]];
                assert!(expected[0].values().iter().all(|v| v.is_finite()));
                for k in Convention::ALL {
                    for choice in [Choice::Insist(k), Choice::Matched] {
                        let found = of(k, choice);
                        assert_eq!(found.chosen, k, "{choice:?}");
                        let found = [found.metrics, found.errors, found.replicates[3]];
                        for (found, expected) in found.iter().zip(&expected) {
                            let pairs = found.values().into_iter().zip(expected.values());
                            for ((found, expected), metric) in pairs.zip(Metrics::ALL) {
                                // Waves are 10⁻¹⁰ off the modes' centres (3·10⁻¹² of the first), which turns
                                // with the axes; differences of powers keep 10⁻⁷ of it at worst.
                                let scale = expected.abs().max(1e-4);
                                assert!(
                                    (found - expected).abs() <= 1e-7 * scale
                                        || found.is_nan() && expected.is_nan(),
                                    "{} of {k:?} {choice:?}, n {n}, {definition:?}, {noise:?}: {found} {expected}",
                                    metric.name
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}
