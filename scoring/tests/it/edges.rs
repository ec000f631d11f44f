//! Cases at the edges of what is scored: gaps, nothing at all, a constant shear, the fewest images.

use ndarray::Array2;
use shearq_quantities::fourier::Complex64;
use shearq_scoring::modes::Decomposer;
use shearq_scoring::quality::quality;
use shearq_scoring::{
    BINS, Bins, Convention, CrossSpectrum, Definition, FieldSum, Grid, Noise, Options, Row, SCORED,
    SetImages, SetScorer, cross_spectrum,
};

use crate::common::{Content, close, field, images, rows, score, standard, truth};

#[test]
fn cross_spectra_and_covariances_equal_their_formulae() {
    let grid = Grid::great10(16).unwrap();
    let shear = field(&grid, Content::E, 3);
    let sigmas = [0.05, 0.1, 0.07, 0.2, 0.05, 0.12, 0.06, 0.09, 0.05];
    let set = images(&grid, &shear, &sigmas, 11, |_, _| true);
    let found: CrossSpectrum = cross_spectrum(&grid, &set, Convention::STANDARD).unwrap();
    let bins = Bins::new(&grid, Definition::Leaderboard);
    let decomposer = Decomposer::new(grid);
    let modes: Vec<_> = set
        .groups()
        .iter()
        .map(|g| {
            decomposer
                .decompose(Convention::STANDARD.apply(&g.e1, &g.e2).unwrap())
                .unwrap()
                .e
        })
        .collect();
    let groups = modes.len();
    assert_eq!(groups, sigmas.len());
    let beyond = |power: [f64; BINS]| power[SCORED.end..].iter().sum::<f64>();
    let pair = |g: usize, h: usize| bins.power(&modes[g], &modes[h]).unwrap();
    let pairs: Vec<(usize, usize)> = (0..groups)
        .flat_map(|h| (0..h).map(move |g| (g, h)))
        .collect();
    let common = pairs.iter().map(|&(g, h)| beyond(pair(g, h))).sum::<f64>() / pairs.len() as f64;
    let inverse: Vec<f64> = (0..groups)
        .map(|g| 1.0 / (beyond(pair(g, g)) - common))
        .collect();
    assert!(inverse.iter().all(|w| *w > 0.0));
    let total: f64 = inverse.iter().sum();
    for (found, inverse) in found.weights.iter().zip(&inverse) {
        close(*found, inverse / total, "weight");
    }
    let share = |&(g, h): &(usize, usize)| inverse[g] * inverse[h];
    let all: f64 = pairs.iter().map(share).sum();
    let mut power = [0.0; BINS];
    for p in &pairs {
        for (sum, own) in power.iter_mut().zip(pair(p.0, p.1)) {
            *sum += share(p) * own / all;
        }
    }
    let covariance = found.covariance.unwrap();
    let count = groups as f64;
    let factor = count * (count - 1.0) / ((count - 2.0) * (count - 3.0));
    for b in SCORED {
        close(found.power[b], power[b], "power");
        for c in SCORED {
            // Pairs of pairs with a group in common.
            let mut sum = 0.0;
            for p in &pairs {
                for q in &pairs {
                    if [q.0, q.1].contains(&p.0) || [q.0, q.1].contains(&p.1) {
                        let of = |p: &(usize, usize), b: usize| {
                            share(p) / all * (pair(p.0, p.1)[b] - power[b])
                        };
                        sum += of(p, b) * of(q, c);
                    }
                }
            }
            let scale = (covariance[b][b] * covariance[c][c]).abs().sqrt();
            assert!(
                (covariance[b][c] - factor * sum).abs() < 1e-9 * scale,
                "{b} {c}"
            );
        }
    }
    // Where nothing but the shear is seen, no noise tells weights.
    let same = images(&grid, &shear, &[0.0, 0.0], 11, |_, _| true);
    let cross = cross_spectrum(&grid, &same, Convention::STANDARD).unwrap();
    assert_eq!(cross.weights, [0.5, 0.5]);
    // A galaxy that nobody measured counts as zero.
    let gap = images(&grid, &shear, &[0.1, 0.1], 11, |_, k| k != 7);
    let cross = cross_spectrum(&grid, &gap, Convention::STANDARD).unwrap();
    assert!(cross.power.iter().all(|power| power.is_finite()));
    // Two images are one pair, whose errors nobody knows; seven are too few still.
    for (sigmas, known) in [
        (&sigmas[..2], false),
        (&sigmas[..7], false),
        (&sigmas[..8], true),
    ] {
        let set = images(&grid, &shear, sigmas, 11, |_, _| true);
        let cross = cross_spectrum(&grid, &set, Convention::STANDARD).unwrap();
        assert_eq!(cross.covariance.is_some(), known);
        close(cross.weights.iter().sum(), 1.0, "sum of weights");
    }
}

#[test]
fn given_noise_is_spread_over_gaps_if_corrected() {
    let grid = Grid::great10(16).unwrap();
    let shear = field(&grid, Content::E, 5);
    let keep = |image: usize, k: usize| !(image + k).is_multiple_of(3) && k != 7;
    let set = images(&grid, &shear, &[0.1; 5], 11, keep);
    let (variance, images) = (0.01, 5.0);
    for definition in [Definition::Leaderboard, Definition::Corrected] {
        let options = Options {
            noise: Noise::Given(variance),
            ..standard(definition)
        };
        let score = score(grid, truth(&shear), &set, options);
        let w = set.total().count.mapv(|count| count / images);
        let gain = match definition {
            Definition::Leaderboard => 1.0 / images,
            Definition::Corrected => w.mean().unwrap() / w.mapv(|w| w * w).mean().unwrap() / images,
        };
        let expected = Bins::new(&grid, definition).white_noise(variance * gain);
        for (found, expected) in score.noise.unwrap().iter().zip(expected) {
            close(*found, expected, "noise");
        }
        assert_eq!(score.noise_variance, Some(variance));
    }
}

#[test]
fn weights_raise_the_noise_by_their_squares() {
    let grid = Grid::great10(16).unwrap();
    let shear = field(&grid, Content::E, 5);
    // The mean weight of each cell is 1, and the mean square 1.36.
    let weight = |image: usize, k: usize| [0.4, 1.6][(image + k) % 2];
    let mut set = SetImages::new(&grid);
    for image in 0..4 {
        let mut sum = FieldSum::new(&grid);
        let rows = rows(&grid, &shear).into_iter().enumerate();
        sum.add_weighted(&grid, rows.map(|(k, row)| (row, 3.0 * weight(image, k))));
        sum.divide_weights(3.0);
        set.add(&sum).unwrap();
    }
    let variance = 0.01;
    for definition in [Definition::Leaderboard, Definition::Corrected] {
        let options = Options {
            noise: Noise::Given(variance),
            ..standard(definition)
        };
        let score = score(grid, truth(&shear), &set, options);
        let expected = Bins::new(&grid, definition).white_noise(1.36 * variance / 4.0);
        for (found, expected) in score.noise.unwrap().iter().zip(expected) {
            close(*found, expected, "noise");
        }
        let noise = score.metrics.galaxy_noise * (1.0 + score.metrics.m_cross);
        close(noise * noise, variance, "noise of a galaxy");
    }
}

#[test]
fn one_of_two_images_alone_has_twice_the_noise_of_both() {
    let grid = Grid::great10(16).unwrap();
    let shear = field(&grid, Content::E, 5);
    let set = images(&grid, &shear, &[0.1, 0.1], 11, |_, _| true);
    let options = standard(Definition::Leaderboard);
    let score = score(grid, truth(&shear), &set, options);
    let noise = score.noise.unwrap();
    let decomposer = Decomposer::new(grid);
    for (left_out, replicate) in score.replicates.iter().enumerate() {
        let other = &set.groups()[1 - left_out];
        let modes = decomposer
            .decompose(Convention::STANDARD.apply(&other.e1, &other.e2).unwrap())
            .unwrap();
        let power = score.bins.power(&modes.e, &modes.e).unwrap();
        let denoised = std::array::from_fn(|b| power[b] - 2.0 * noise[b]);
        let expected = quality(&score.bins, &denoised, &score.true_ee).q;
        close(replicate.q_dn, expected, "Q_dn of one image");
    }
}

#[test]
fn arrays_are_scored_like_rows_and_must_have_the_grids_shape() {
    let grid = Grid::great10(16).unwrap();
    let shear = field(&grid, Content::E, 5);
    let keep = |image: usize, k: usize| k != 7 * image + 3;
    let set = images(&grid, &shear, &[0.1, 0.2, 0.1], 11, keep);
    let mut arrays: Vec<[Array2<f64>; 2]> = set
        .groups()
        .iter()
        .map(|g| [g.e1.clone(), g.e2.clone()])
        .collect();
    for (image, [e1, _]) in arrays.iter_mut().enumerate() {
        let k = 7 * image + 3;
        let found = set.groups()[image]
            .count
            .indexed_iter()
            .find(|(_, c)| **c == 0.0);
        e1[found.unwrap().0] = [f64::NAN, f64::INFINITY][k % 2];
    }
    let views = || arrays.iter().map(|[e1, e2]| [e1.view(), e2.view()]);
    let same = SetImages::of_arrays(&grid, views()).unwrap();
    let of = |images: &SetImages| score(grid, truth(&shear), images, Options::default());
    // By bits: what is not known is not a number.
    let bits = |images: &SetImages| of(images).metrics.values().map(f64::to_bits);
    assert_eq!(bits(&same), bits(&set));
    assert_eq!(same.total().count, set.total().count);
}

#[test]
fn the_true_spectrum_is_that_of_all_cells_in_both_definitions() {
    let grid = Grid::great10(16).unwrap();
    let shear = field(&grid, Content::E, 7);
    for definition in [Definition::Leaderboard, Definition::Corrected] {
        let options = Options {
            definition,
            ..Options::default()
        };
        let scorer = SetScorer::new(grid, truth(&shear), options).unwrap();
        let modes = Decomposer::new(grid).decompose(shear.clone()).unwrap();
        let expected = Bins::new(&grid, definition)
            .power(&modes.e, &modes.e)
            .unwrap();
        for b in SCORED {
            close(scorer.true_bandpowers()[b], expected[b], "bandpower");
        }
    }
}

#[test]
fn without_galaxies_the_leaderboard_counts_zeros() {
    let grid = Grid::great10(8).unwrap();
    let shear = field(&grid, Content::E, 7);
    let set = images(&grid, &shear, &[0.1, 0.1], 11, |_, _| false);
    let of = |definition| score(grid, truth(&shear), &set, standard(definition));
    let leaderboard = of(Definition::Leaderboard);
    let nothing = [0.0; BINS];
    let expected = quality(&leaderboard.bins, &nothing, &leaderboard.true_ee).q;
    close(leaderboard.metrics.q, expected, "Q of nothing");
    // All conventions of nothing are the same; the first of equals wins.
    assert_eq!(leaderboard.best.number(), 1);
    // Seen through no galaxies, the truth has no power either.
    let corrected = of(Definition::Corrected);
    assert_eq!(corrected.true_ee[SCORED], nothing[SCORED]);
    let own = corrected.conventions[Convention::STANDARD.index()].ee;
    assert_eq!(own[SCORED], nothing[SCORED]);
}

#[test]
fn where_the_shear_is_constant_the_mean_is_the_truth_and_c() {
    let grid = Grid::great10(8).unwrap();
    let of = |e1, e2| Array2::from_elem((8, 8), Complex64::new(e1, e2));
    let measured = of(0.035, -0.024);
    let set = images(&grid, &measured, &[0.0, 0.0], 11, |_, _| true);
    let options = standard(Definition::Leaderboard);
    let score = score(grid, truth(&of(0.03, -0.02)), &set, options);
    let mean = score.constant.unwrap();
    assert_eq!(mean.truth, [0.03, -0.02]);
    for (found, expected) in [
        (mean.e[0], 0.035),
        (mean.e[1], -0.024),
        (score.metrics.c1, 0.005),
        (score.metrics.c2, -0.004),
    ] {
        assert!(
            (found - expected).abs() < 1e-15,
            "{found}, expected {expected}"
        );
    }
}

#[test]
fn errors_of_a_constant_shear_ignore_signs() {
    let grid = Grid::great10(16).unwrap();
    // One image has no jackknife.
    let keep = |_: usize, k: usize| !(40..140).contains(&k);
    let of = |sign: f64| {
        let shear = Array2::from_elem((16, 16), Complex64::new(0.03, -0.02 * sign));
        let mut flipped = SetImages::new(&grid);
        let plain = Array2::from_elem((16, 16), Complex64::new(0.03, -0.02));
        for group in images(&grid, &plain, &[0.1], 11, keep).groups() {
            let mut sum = group.clone();
            sum.e2 *= sign;
            flipped.add(&sum).unwrap();
        }
        let options = standard(Definition::Leaderboard);
        score(grid, truth(&shear), &flipped, options)
            .constant
            .unwrap()
            .error
    };
    let (plain, flipped) = (of(1.0), of(-1.0));
    // 156 galaxies of noise 0.1, spread over 256 cells; some fifty modes tell it to 10 %.
    let expected = 0.1 / 156.0_f64.sqrt();
    for (a, b) in plain.iter().zip(&flipped) {
        close(*a, *b, "error");
        assert!((a / expected - 1.0).abs() < 0.3, "{a}, expected {expected}");
    }
}

#[test]
fn whole_numbers_beyond_ellipticities_are_sentinels() {
    let grid = Grid::great10(8).unwrap();
    let (x, y) = grid.centre(0, 0);
    // Zero is whole too, beside an outlier that is not. Above 1 and above 5 are counted, too.
    for (e1, e2, expected) in [
        (-99.0, -99.0, [1, 1, 1]),
        (-9.0, 0.2, [1, 1, 1]),
        (0.2, 999.0, [1, 1, 1]),
        (0.0, 7.5, [0, 1, 1]),
        (5.0, 0.0, [0, 1, 0]),
        (5.5, 0.0, [0, 1, 1]),
        (1.0, 0.1, [0, 1, 0]),
        (-0.9, -0.9, [0, 1, 0]),
        (0.9, -0.9, [0, 1, 0]),
        (1.0, 0.0, [0, 0, 0]),
        (0.9, 0.2, [0, 0, 0]),
        (0.2, 0.9, [0, 0, 0]),
    ] {
        let counts = FieldSum::new(&grid).add_image(&grid, [Row { x, y, e1, e2 }]);
        let found = [counts.sentinels, counts.above_one, counts.absurd];
        assert_eq!(found, expected, "({e1}, {e2})");
    }
}

#[test]
fn grids_are_squares_of_fields_on_the_sky() {
    assert_eq!(
        (Grid::side_of(64), Grid::side_of(63), Grid::side_of(65)),
        (Some(8), None, None)
    );
    use shearq_quantities::units::{Degrees, Pixels};
    let grid = |field| Grid::new(8, Pixels(48.0), Degrees(field));
    assert!(grid(1e-3).is_ok() && grid(360.0).is_ok());
    for field in [0.0, 9e-4, 361.0, 1e308, f64::NAN, f64::INFINITY, -10.0] {
        assert!(grid(field).is_err(), "{field}");
    }
}
