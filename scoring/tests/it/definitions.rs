//! The corrected definition, null tests, masks, noise and errors, on fields made for the purpose.

use shearq_quantities::fourier::Complex64;
use shearq_scoring::{Bins, Convention, Definition, Grid, Options, SCORED, cross_spectrum};

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
fn noise_is_measured_from_the_scatter_of_images() {
    let grid = Grid::great10(32).unwrap();
    let shear = field(&grid, Content::E, 3);
    let sigma = 0.05;
    let total = |p: [f64; 20]| SCORED.map(|b| p[b]).sum::<f64>();
    let (mut variance, mut power, mut q, mut q_dn) = (0.0, 0.0, 0.0, 0.0);
    for trial in 0..20 {
        let images = images(&grid, &shear, &[sigma; 40], 100 + trial, |_, _| true);
        let score = score(
            grid,
            truth(&shear),
            &images,
            standard(Definition::Leaderboard),
        );
        variance += score.noise_variance.unwrap() / 20.0;
        power += total(score.noise.unwrap()) / 20.0;
        q += score.metrics.q;
        q_dn += score.metrics.q_dn;
    }
    // 20 trials of 19 differences between groups over some 400 modes.
    assert!(
        (variance / (sigma * sigma) - 1.0).abs() < 0.03,
        "{variance}"
    );
    assert!(q_dn > 1.5 * q, "removing the noise must help: {q} {q_dn}");
    // Noise of known variance.
    let known = total(Bins::new(&grid, Definition::Leaderboard).white_noise(sigma * sigma / 40.0));
    assert!((power / known - 1.0).abs() < 0.03, "{power} {known}");
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
