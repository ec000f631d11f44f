//! The public interface: arrays of other grids are errors, and every NaN has a reason.

use ndarray::Array2;
use shearq_scoring::modes::{Decomposer, Modes};
use shearq_scoring::{
    Bins, Complex64, Convention, Definition, Fault, FieldSum, Grid, MeanShear, Metrics, Noise,
    Options, ScoringError, SetImages, SetScore, SetScorer, TrueShear, TruthSign, cross_spectrum,
    measured_bandpowers, sign_by_correlation, sign_by_modes,
};

use crate::common::{Content, Normal, field, score, standard, truth};

fn grid(n: usize) -> Grid {
    Grid::great10(n).unwrap()
}

/// Images with the shear `response · g` and noise.
fn images(shear: &Array2<Complex64>, count: usize, response: f64, noise: f64) -> SetImages {
    let shear = shear.mapv(|g| response * g);
    crate::common::images(
        &grid(shear.nrows()),
        &shear,
        &vec![noise; count],
        1,
        |_, _| true,
    )
}

fn is_shape<T>(result: Result<T, ScoringError>) -> bool {
    matches!(result, Err(ScoringError::Shape { .. }))
}

#[test]
fn arrays_of_another_grid_are_an_error() {
    let (small, large) = (grid(16), grid(20));
    let shear = field(&large, Content::E, 1);
    let others = images(&shear, 2, 1.0, 0.01);
    let own_shear = field(&small, Content::E, 1);
    let own = images(&own_shear, 2, 1.0, 0.01);
    let scorer = SetScorer::new(small, truth(&own_shear), Options::default()).unwrap();
    let score = scorer.score(&own).unwrap();
    let standard = Convention::STANDARD;
    assert!(is_shape(scorer.score(&others)));
    assert!(is_shape(scorer.match_convention(&others)));
    assert!(is_shape(scorer.diagnose(&others, &score, standard)));
    assert!(is_shape(measured_bandpowers(
        &small,
        others.total(),
        standard
    )));
    assert!(is_shape(cross_spectrum(&small, &others, standard)));
    assert!(is_shape(sign_by_modes(&small, &truth(&shear))));
    assert!(is_shape(sign_by_correlation(&truth(&shear), own.total())));
    let decomposer = Decomposer::new(small);
    assert!(is_shape(decomposer.decompose(shear.clone())));
    let modes = Decomposer::new(large).decompose(shear).unwrap();
    assert!(is_shape(decomposer.compose(&modes)));
    let bins = Bins::new(&small, Definition::Corrected);
    assert!(is_shape(bins.power(&modes.e, &modes.e)));
    let mixed = Modes {
        e: Array2::zeros((16, 16)),
        b: modes.b,
    };
    assert!(is_shape(bins.power(&mixed.e, &mixed.b)));
    assert!(is_shape(decomposer.compose(&mixed)));
    let (square, wide) = (Array2::zeros((16, 16)), Array2::zeros((16, 20)));
    assert!(is_shape(standard.apply(&square, &wide)));
    assert!(is_shape(standard.apply(&wide, &wide)));
    for (a, b) in [(&square, &wide), (&wide, &square)] {
        assert!(is_shape(SetImages::of_arrays(
            &small,
            [[a.view(), b.view()]]
        )));
        let (g1, g2) = (a.clone(), b.clone());
        let found = SetScorer::new(small, TrueShear { g1, g2 }, Options::default());
        assert!(is_shape(found));
    }
}

#[test]
fn only_single_images_of_the_grid_are_added() {
    let own = grid(16);
    let mut all = SetImages::new(&own);
    let one = FieldSum {
        images: 1,
        ..FieldSum::new(&own)
    };
    for images in [0, 2] {
        let sum = FieldSum {
            images,
            ..one.clone()
        };
        assert_eq!(all.add(&sum), Err(ScoringError::NotOneImage(images)));
    }
    for k in 0..3 {
        let mut sum = one.clone();
        *[&mut sum.e1, &mut sum.e2, &mut sum.count][k] = Array2::zeros((20, 20));
        assert!(is_shape(all.add(&sum)));
    }
    assert_eq!((all.total().images, all.groups().len()), (0, 0));
    all.add(&one).unwrap();
    assert_eq!((all.total().images, all.groups().len()), (1, 1));
}

#[test]
fn without_images_nothing_is_scored() {
    let grid = grid(16);
    let shear = field(&grid, Content::E, 1);
    let scorer = SetScorer::new(grid, truth(&shear), Options::default()).unwrap();
    let none = SetImages::new(&grid);
    let matched = scorer.match_convention(&none);
    assert_eq!(matched.unwrap_err(), ScoringError::NoImages);
    assert_eq!(scorer.score(&none).unwrap_err(), ScoringError::NoImages);
    for count in [0, 1] {
        let set = images(&shear, count, 1.0, 0.01);
        let found = cross_spectrum(&grid, &set, Convention::STANDARD);
        assert_eq!(found.unwrap_err(), ScoringError::TooFewImages(count));
    }
}

#[test]
fn metrics_are_unknown_where_the_data_do_not_determine_them() {
    let small = grid(16);
    let shear = field(&small, Content::E, 5);
    let score = |truth: TrueShear, images: &SetImages, noise: Noise| {
        let options = standard(Definition::Leaderboard);
        score(small, truth, images, Options { noise, ..options })
    };
    let unknown = |score: &SetScore| -> Vec<&'static str> {
        let metrics = Metrics::ALL.iter().zip(score.metrics.values());
        let unknown = metrics.filter(|(_, value)| value.is_nan());
        unknown.map(|(metric, _)| metric.name).collect()
    };
    let two = images(&shear, 2, 1.0, 0.001);
    assert_eq!(
        unknown(&score(truth(&shear), &two, Noise::Measured)),
        [""; 0]
    );
    // One image does not determine its noise.
    let one = images(&shear, 1, 1.0, 0.001);
    let found = score(truth(&shear), &one, Noise::Measured);
    assert_eq!(unknown(&found), ["q_dn", "galaxy_noise"]);
    assert!(found.noise.is_none() && found.noise_variance.is_none());
    assert!(found.replicates.is_empty());

    let constant = Array2::from_elem((16, 16), Complex64::new(0.02, 0.01));
    let constant = score(truth(&constant), &two, Noise::Measured);
    let found = unknown(&constant);
    assert_eq!(found.len(), Metrics::ALL.len() - 2);
    assert!(!found.contains(&"c1") && !found.contains(&"c2"));
    assert!(matches!(constant.constant, Some(MeanShear { .. })));

    let one_constant_component = TrueShear {
        g2: Array2::zeros((16, 16)),
        ..truth(&shear)
    };
    let found = unknown(&score(one_constant_component, &two, Noise::Measured));
    assert_eq!(found, ["m2"]);

    let no_response = images(&shear, 2, 0.0, 0.1);
    let found = unknown(&score(truth(&shear), &no_response, Noise::Given(0.01)));
    assert_eq!(found, ["q_calibrated", "galaxy_noise"]);

    let missing = Array2::from_elem((16, 16), f64::NAN);
    let empty = SetImages::of_arrays(&small, [[missing.view(), missing.view()]; 2]).unwrap();
    let found = unknown(&score(truth(&shear), &empty, Noise::Measured));
    assert!(found.contains(&"c1"));
}

#[test]
fn the_sign_of_a_truth_follows_from_modes_and_images() {
    let grid = grid(24);
    let shear = field(&grid, Content::E, 3);
    let plain = truth(&shear);
    let set = images(&shear, 2, 1.0, 0.001);
    for (truth, sign) in [
        (&plain, TruthSign::Standard),
        (&plain.flipped(), TruthSign::Challenge),
    ] {
        assert_eq!(sign_by_modes(&grid, truth), Ok(Some(sign)));
        assert_eq!(sign_by_correlation(truth, set.total()), Ok(Some(sign)));
    }
}

/// Random shears have E and B modes of equal power, and thus no sign, however few modes a small grid has.
#[test]
fn chance_does_not_determine_the_sign_of_a_truth() {
    let mut normal = Normal(5);
    for n in [8, 12, 16] {
        let grid = grid(n);
        for _ in 0..200 {
            let random = Array2::from_shape_simple_fn((n, n), || {
                Complex64::new(0.03 * normal.draw(), 0.03 * normal.draw())
            });
            assert_eq!(sign_by_modes(&grid, &truth(&random)), Ok(None));
        }
        // Few of the modes contain the power.
        for seed in 0..200 {
            let mixed = field(&grid, Content::Mixed, seed);
            assert_eq!(sign_by_modes(&grid, &truth(&mixed)), Ok(None));
        }
    }
}

#[test]
fn shifted_rows_are_found_with_their_direction() {
    let grid = grid(24);
    let shear = field(&grid, Content::E, 7);
    for (x, y) in [(1, 0), (0, -1), (1, 1), (1, -1)] {
        // The galaxy of cell (ix, iy) lies in cell (ix + x, iy + y).
        let from = |k: usize, by: i32| (k as i32 - by).rem_euclid(24) as usize;
        let moved = Array2::from_shape_fn((24, 24), |(ix, iy)| shear[(from(ix, x), from(iy, y))]);
        let set = images(&moved, 2, 1.0, 0.001);
        let options = standard(Definition::Leaderboard);
        let scorer = SetScorer::new(grid, truth(&shear), options).unwrap();
        let score = scorer.score(&set).unwrap();
        let faults = scorer.diagnose(&set, &score, Convention::STANDARD).unwrap();
        let shift = |fault: &Fault| match fault {
            Fault::Shifted { x, y, .. } => Some((*x, *y)),
            _ => None,
        };
        let found: Vec<(i32, i32)> = faults.iter().filter_map(shift).collect();
        assert_eq!(found, [(x, y)], "{faults:?}");
    }
}
