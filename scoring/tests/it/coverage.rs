//! The errors of a set's metrics against the scatter of repeated trials.

use ndarray::Array2;
use shearq_quantities::fourier::Complex64;
use shearq_scoring::modes::{Decomposer, Modes};
use shearq_scoring::{Definition, Grid, Metrics, SCORED, SetImages, SetScorer};

use crate::common::{Content, Normal, add, field, standard, truth};

/// Intrinsic ellipticities: B modes of equal power in all modes, of this scatter per component before the
/// E modes are taken out.
const SHAPES: f64 = 0.2;

/// White noise without its E modes.
fn shapes(grid: &Grid, normal: &mut Normal) -> Array2<Complex64> {
    let decomposer = Decomposer::new(*grid);
    let white = Array2::from_shape_fn((grid.n, grid.n), |_| {
        Complex64::new(SHAPES * normal.draw(), SHAPES * normal.draw())
    });
    let Modes { mut e, b } = decomposer.decompose(white).unwrap();
    e.fill(Complex64::ZERO);
    decomposer.compose(&Modes { e, b }).unwrap()
}

/// One kind of set.
#[derive(Debug)]
struct Kind {
    images: usize,
    /// Noise of a galaxy's ellipticity per component.
    noise: f64,
    /// Whether all images have the same intrinsic shapes.
    shared: bool,
    /// The method's own bias.
    m: f64,
}

/// Scatter over trials of each metric that has an error and of each scored bandpower, over the mean of its error, and the
/// share of trials that have one.
fn coverage(grid: &Grid, kind: &Kind, definition: Definition) -> Vec<(String, f64, f64)> {
    const TRIALS: usize = 200;
    let shear = field(grid, Content::E, 5);
    let scorer = SetScorer::new(*grid, truth(&shear), standard(definition)).unwrap();
    let mut normal = Normal(77);
    let mut found: Vec<(Vec<f64>, Vec<f64>)> = Vec::new();
    for _ in 0..TRIALS {
        let mut common = shapes(grid, &mut normal);
        let mut images = SetImages::new(grid);
        for _ in 0..kind.images {
            if !kind.shared {
                common = shapes(grid, &mut normal);
            }
            let mut observed = &shear * Complex64::from(1.0 + kind.m) + &common;
            for e in &mut observed {
                *e += Complex64::new(kind.noise * normal.draw(), kind.noise * normal.draw());
            }
            add(&mut images, grid, &observed);
        }
        let score = scorer.score(&images).unwrap();
        let with_power =
            |metrics: Metrics, power: &[f64]| [&metrics.values(), &power[SCORED]].concat();
        found.push((
            with_power(score.metrics, &score.spectra().ee),
            with_power(score.errors, &score.ee_error),
        ));
    }
    let metrics = Metrics::ALL.iter().map(|metric| metric.name.to_owned());
    let names = metrics.chain(SCORED.map(|bin| format!("EE of bin {bin}")));
    names
        .enumerate()
        .map(|(k, name)| {
            let known: Vec<(f64, f64)> = found
                .iter()
                .map(|(values, errors)| (values[k], errors[k]))
                .filter(|(_, error)| error.is_finite())
                .collect();
            let count = known.len() as f64;
            let mean = |of: &dyn Fn(&(f64, f64)) -> f64| known.iter().map(of).sum::<f64>() / count;
            let centre = mean(&|v| v.0);
            let scatter = mean(&|v| (v.0 - centre).powi(2)).sqrt();
            let ratio = scatter / mean(&|v| v.1);
            (name, ratio, count / TRIALS as f64)
        })
        .collect()
}

#[test]
fn errors_are_the_scatter_of_repeated_trials() {
    let grid = Grid::great10(20).unwrap();
    let kind = |images, noise, shared, m| Kind {
        images,
        noise,
        shared,
        m,
    };
    for (definition, kind) in [
        (Definition::Leaderboard, kind(4, 0.107, false, 0.0)),
        (Definition::Leaderboard, kind(10, 0.107, true, -0.4)),
        (Definition::Leaderboard, kind(4, 0.054, true, 0.0)),
        (Definition::Leaderboard, kind(2, 0.107, true, 0.0)),
        (Definition::Leaderboard, kind(10, 0.03, false, 0.0)),
        (Definition::Corrected, kind(4, 0.054, true, 0.0)),
    ] {
        for (name, ratio, share) in coverage(&grid, &kind, definition) {
            let calibrated = ["q_calibrated", "galaxy_noise"].contains(&name.as_str());
            if calibrated && share < 0.95 {
                // A response that is often not told from zero: those that are known are the high ones.
                assert!(kind.noise > 0.1 || kind.shared, "{kind:?}: {name} {share}");
                continue;
            }
            // A scatter from 200 trials is good to 5 %; errors to first order, of squares and moduli, are
            // not exact.
            assert!(
                (0.8..1.25).contains(&ratio),
                "{definition:?} {kind:?}: {name} {ratio}"
            );
            assert!(share > 0.95, "{kind:?}: {name} has an error in {share}");
        }
    }
}

// The response is far from one and well known, so that the error of the noise is its own.
#[test]
fn errors_of_the_noise_follow_the_number_of_images() {
    let grid = Grid::great10(20).unwrap();
    for images in [2, 6] {
        let kind = Kind {
            images,
            noise: 0.01,
            shared: true,
            m: 1.0,
        };
        let all = coverage(&grid, &kind, Definition::Leaderboard);
        for (name, ratio, share) in all.iter().filter(|(name, ..)| name == "galaxy_noise") {
            assert!(
                (0.8..1.25).contains(ratio) && *share > 0.95,
                "{kind:?}: {name} {ratio} {share}"
            );
        }
    }
}

#[test]
fn errors_of_one_image_are_known_but_for_its_noise() {
    let grid = Grid::great10(20).unwrap();
    let kind = Kind {
        images: 1,
        noise: 0.02,
        shared: false,
        m: 0.0,
    };
    for (name, ratio, share) in coverage(&grid, &kind, Definition::Leaderboard) {
        if ["q_dn", "galaxy_noise"].contains(&name.as_str()) {
            assert_eq!(share, 0.0);
        } else {
            // Nothing but noise is left of σ_sys once the response is divided out: it is of the size of its
            // error, which is then up to half too large.
            let least = if name == "q_calibrated" { 0.6 } else { 0.8 };
            assert!((least..1.25).contains(&ratio), "{name} {ratio}");
        }
    }
}
