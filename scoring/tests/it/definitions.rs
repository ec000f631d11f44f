//! The corrected definition, null tests, masks, noise and errors, on fields made for the purpose.

use ndarray::Array2;
use shearq_fourier::Complex64;
use shearq_scoring::modes::Decomposer;
use shearq_scoring::{
    Bins, Convention, CrossSpectrum, Definition, FieldSum, Grid, Noise, Options, SCORED, SetImages,
    cross_spectrum,
};

use crate::common::{Content, Normal, field, images, score, standard, truth};

const BOTH: [Definition; 2] = [Definition::Leaderboard, Definition::Corrected];

#[test]
fn perfect_ellipticities_score_without_bound() {
    for n in [20, 25, 64] {
        let grid = Grid::great10(n).unwrap();
        let shear = field(&grid, Content::E, n as u64);
        for definition in BOTH {
            let images = images(&grid, &shear, &[0.0; 2], 1, |_, _| true);
            let f = score(grid, truth(&shear), &images, standard(definition)).metrics;
            assert!(f.q > 1e9, "n {n}: {}", f.q);
            for small in [
                f.m_half, f.m_cross, f.m1, f.m2, f.c1, f.c2, f.b_power, f.eb_power,
            ] {
                assert!(small.abs() < 1e-9, "n {n} {definition:?}: {f:?}");
            }
        }
    }
}

#[test]
fn b_only_and_mixed_fields_are_told_apart() {
    let grid = Grid::great10(32).unwrap();
    for definition in BOTH {
        let bins = Bins::new(&grid, definition);
        let decomposer = Decomposer::new(grid);
        let power = |content| {
            let modes = decomposer.decompose(field(&grid, content, 4)).unwrap();
            let sum = |p: [f64; 20]| SCORED.map(|b| p[b]).sum::<f64>();
            (
                sum(bins.power(&modes.e, &modes.e).unwrap()),
                sum(bins.power(&modes.b, &modes.b).unwrap()),
                sum(bins.power(&modes.e, &modes.b).unwrap()),
            )
        };
        let (e, b, _) = power(Content::E);
        assert!(b < 1e-20 * e.max(1e-9) + 1e-24, "{e} {b}");
        let (e, b, _) = power(Content::B);
        assert!(e < 1e-20 * b.max(1e-9) + 1e-24, "{e} {b}");
        // E and B drawn alike and independently: equal powers, no correlation, within the scatter
        // of some 300 independent modes.
        let (e, b, eb) = power(Content::Mixed);
        assert!((e / b - 1.0).abs() < 0.5, "{e} {b}");
        assert!(eb.abs() < 0.3 * e, "{e} {eb}");
    }
}

#[test]
fn biases_put_in_are_found() {
    let grid = Grid::great10(50).unwrap();
    let shear = field(&grid, Content::E, 8);
    let biased = shear.mapv(|g| Complex64::new(1.05 * g.re + 0.002, 1.05 * g.im - 0.001));
    for definition in BOTH {
        let images = images(&grid, &biased, &[0.0; 2], 1, |_, _| true);
        let options = Options {
            definition,
            ..Options::default()
        };
        let f = score(grid, truth(&shear), &images, options).metrics;
        // Exact: there is no noise. M = 1.05² − 1.
        assert!((f.m_half - 0.05125).abs() < 1e-9, "{f:?}");
        assert!(f.sqrt_a.abs() < 1e-5, "{f:?}");
        assert!((f.m_cross - 0.05).abs() < 1e-9 && (f.m1 - 0.05).abs() < 1e-9);
        assert!((f.c1 - 0.002).abs() < 1e-9 && (f.c2 + 0.001).abs() < 1e-9);
    }
}

#[test]
fn noise_and_jackknife_errors_are_those_of_repeated_trials() {
    let grid = Grid::great10(32).unwrap();
    let shear = field(&grid, Content::E, 3);
    let sigma = 0.05;
    let (mut q_dn, mut m, mut errors, mut variances) = (vec![], vec![], vec![], vec![]);
    for trial in 0..40 {
        let images = images(&grid, &shear, &[sigma; 40], 100 + trial, |_, _| true);
        let options = standard(Definition::Leaderboard);
        let score = score(grid, truth(&shear), &images, options);
        q_dn.push(score.metrics.q_dn / score.metrics.q);
        m.push(score.metrics.m_cross);
        errors.push(score.errors.m_cross);
        variances.push(score.noise_variance.unwrap());
    }
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let scatter = |v: &[f64]| (v.iter().map(|x| (x - mean(v)).powi(2)).sum::<f64>() / 39.0).sqrt();
    // 40 trials of 19 differences between groups over some 400 modes.
    assert!(
        (mean(&variances) / (sigma * sigma) - 1.0).abs() < 0.03,
        "{}",
        mean(&variances)
    );
    assert!(
        mean(&q_dn) > 1.5,
        "removing the noise must help: {}",
        mean(&q_dn)
    );
    // A scatter from 40 trials is good to 11 %, a jackknife over 20 groups to 16 % a trial.
    let ratio = mean(&errors) / scatter(&m);
    assert!((0.65..1.5).contains(&ratio), "{ratio}");
    // Noise of known variance gives the same answer as measured noise, within its error.
    let images = images(&grid, &shear, &[sigma; 40], 100, |_, _| true);
    let given = Options {
        noise: Noise::Given(sigma * sigma),
        ..Options::default()
    };
    let power = score(grid, truth(&shear), &images, given).noise.unwrap();
    let measured = score(grid, truth(&shear), &images, Options::default())
        .noise
        .unwrap();
    let total = |p: [f64; 20]| SCORED.map(|b| p[b]).sum::<f64>();
    assert!((total(measured) / total(power) - 1.0).abs() < 0.1);
}

#[test]
fn cross_spectra_are_unbiased_with_the_stated_errors() {
    let grid = Grid::great10(32).unwrap();
    let shear = field(&grid, Content::E, 3);
    // Every fourth image has three times the noise; groups of two and of one image.
    let images_of = |seed| {
        let sigma = |image: usize| if image.is_multiple_of(4) { 0.15 } else { 0.05 };
        let sigmas: Vec<f64> = (0..31).map(sigma).collect();
        images(&grid, &shear, &sigmas, seed, |_, _| true)
    };
    let cross = |images: &SetImages| cross_spectrum(&grid, images, Convention::STANDARD).unwrap();
    let set = images_of(1);
    // The mean over trials is the truth within its error, and their covariance the one that is stated.
    let expected = score(grid, truth(&shear), &set, Options::default()).true_ee;
    let trials: Vec<_> = (0..60)
        .map(|trial| cross(&images_of(100 + trial)))
        .collect();
    let count = trials.len() as f64;
    let mut ratios = Vec::new();
    for b in SCORED {
        let mean = trials.iter().map(|t| t.power[b]).sum::<f64>() / count;
        let apart = |t: &&CrossSpectrum| (t.power[b] - mean).powi(2);
        let variance = trials.iter().map(|t| apart(&t)).sum::<f64>() / (count - 1.0);
        let error = (variance / count).sqrt();
        assert!((mean - expected[b]).abs() < 4.0 * error, "bin {b}");
        let own = |t: &CrossSpectrum| t.covariance.as_ref().unwrap()[b][b];
        ratios.push(trials.iter().map(own).sum::<f64>() / count / variance);
    }
    // A variance from 60 trials is good to 18 %, the mean over eight bins to 7 %.
    let ratio = ratios.iter().sum::<f64>() / ratios.len() as f64;
    assert!((0.8..1.25).contains(&ratio), "{ratio}");
    // Groups of noisy images, whose variance is that of nine and one halved, count less.
    let mean_of = |noisy: bool| {
        let of = |w: &&CrossSpectrum| w.weights[if noisy { 0 } else { 1 }];
        trials.iter().map(|t| of(&t)).sum::<f64>() / count
    };
    // Groups 0 and 1 have two images: 0 and 20, both noisy, and 1 and 21. The noise that weights are
    // measured from is that of some hundred modes in each trial.
    assert!((mean_of(false) / mean_of(true) / 9.0 - 1.0).abs() < 0.1);
    let mut one = SetImages::new(&grid);
    let image = FieldSum {
        images: 1,
        ..set.groups()[0].clone()
    };
    one.add(&image).unwrap();
    assert!(cross_spectrum(&grid, &one, Convention::STANDARD).is_err());
}

#[test]
fn cross_spectra_do_without_galaxies_that_are_missing() {
    let grid = Grid::great10(16).unwrap();
    let shear = field(&grid, Content::E, 5);
    // Every image lacks one galaxy in three; of the three images of a group one lacks each.
    let of = |keep: &dyn Fn(usize, usize) -> bool| {
        let images = images(&grid, &shear, &[0.0; 60], 1, keep);
        cross_spectrum(&grid, &images, Convention::STANDARD)
            .unwrap()
            .power
    };
    let (gaps, whole) = (of(&|image, k| (image + k) % 3 != 0), of(&|_, _| true));
    for b in SCORED {
        assert!((gaps[b] / whole[b] - 1.0).abs() < 1e-9, "bin {b}");
    }
}

#[test]
fn missing_galaxies_bias_the_leaderboard_alone() {
    let grid = Grid::great10(50).unwrap();
    let shear = field(&grid, Content::E, 12);
    // A fifth of the galaxies of each image missing at random, some cells in all images.
    let keep = |image: usize, k: usize| {
        let mut normal = Normal((image as u64) << 32 | k as u64);
        normal.uniform();
        normal.uniform() > 0.2 && !k.is_multiple_of(97)
    };
    let images = images(&grid, &shear, &[0.0; 20], 1, keep);
    let m = |definition| {
        score(grid, truth(&shear), &images, standard(definition))
            .metrics
            .m_cross
    };
    // Counting a fifth as zero dilutes the field by a fifth.
    assert!((m(Definition::Leaderboard) + 0.2).abs() < 0.02);
    assert!(m(Definition::Corrected).abs() < 1e-9);
}

#[test]
fn every_convention_is_recognised_by_its_correlation() {
    let grid = Grid::great10(32).unwrap();
    let shear = field(&grid, Content::E, 21);
    for k in Convention::ALL {
        // What a submitter of convention k would hand in: the inverse of what the scorer undoes.
        let (s1, s2) = k.signs();
        let given = Array2::from_shape_fn(shear.dim(), |(ix, iy)| {
            let g = if k.transposes() {
                shear[(iy, ix)]
            } else {
                shear[(ix, iy)]
            };
            Complex64::new(s1 * g.re, s2 * g.im)
        });
        let images = images(&grid, &given, &[0.001; 2], 5, |_, _| true);
        let score = score(grid, truth(&shear), &images, Options::default());
        assert!(score.conventions[k.index()].correlation > 0.8, "{k:?}");
        assert_eq!(score.matching.best().class(), k.class(), "{k:?}");
        assert!(
            score.metrics.m_cross.abs() < 0.05,
            "{k:?}: {:?}",
            score.metrics
        );
    }
}

#[test]
fn noise_makes_the_wrong_convention_win_and_that_is_seen() {
    let grid = Grid::great10(50).unwrap();
    let shear = field(&grid, Content::E, 30);
    // Noise in the mean field of about the signal's own power in the scored bins.
    let images = images(&grid, &shear, &[0.02; 20], 6, |_, _| true);
    let score = score(grid, truth(&shear), &images, Options::default());
    assert!(score.wrong_convention_wins());
    assert_eq!(score.matching.best().class(), Convention::STANDARD.class());
    let q = |k: Convention| score.conventions[k.index()].quality.q;
    assert!(q(score.best) > q(score.matching.best()));
}
