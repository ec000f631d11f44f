//! Noise that is known, and what surveys find of it.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use ndarray::{Array2, s};
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::testing::close;

const SIDE: usize = 48;

/// Uniform noise of variance one, or its sum over 2 × 2 pixels halved, which has it too.
fn noise(rng: &mut ChaCha8Rng, correlated: bool) -> Array2<f32> {
    let half = 3f32.sqrt();
    let white = Array2::from_shape_fn((SIDE + 1, SIDE + 1), |_| rng.random_range(-half..half));
    Array2::from_shape_fn((SIDE, SIDE), |(y, x)| {
        if correlated {
            0.5 * (white[(y, x)] + white[(y + 1, x)] + white[(y, x + 1)] + white[(y + 1, x + 1)])
        } else {
            white[(y, x)]
        }
    })
}

fn survey(
    reach: usize,
    count: usize,
    mut stamp: impl FnMut(&mut ChaCha8Rng) -> Array2<f32>,
) -> StampNoise {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut survey = NoisePlan::new(SIDE, reach, None).unwrap().survey();
    for _ in 0..count {
        survey.add(stamp(&mut rng).view()).unwrap();
    }
    survey.noise().unwrap()
}

#[test]
fn the_error_of_a_level_is_its_scatter() {
    // The survey of few stamps, often: known to 1/√(2·300), 4 %.
    let mut rng = ChaCha8Rng::seed_from_u64(31);
    for correlated in [false, true] {
        let gaussian = |rng: &mut ChaCha8Rng| {
            let white = Array2::from_shape_fn((SIDE + 1, SIDE + 1), |_| -> f32 {
                StandardNormal.sample(rng)
            });
            Array2::from_shape_fn((SIDE, SIDE), |(y, x)| match correlated {
                true => 0.5 * white.slice(s![y..y + 2, x..x + 2]).sum(),
                false => white[(y, x)],
            })
        };
        let found = (0..300).map(|_| {
            let mut survey = NoisePlan::new(SIDE, 3, None).unwrap().survey();
            (0..6).for_each(|_| survey.add(gaussian(&mut rng).view()).unwrap());
            let noise = survey.noise().unwrap();
            (noise.sigma(), noise.error())
        });
        let (levels, errors): (Vec<f64>, Vec<f64>) = found.unzip();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let squares: Vec<f64> = levels
            .iter()
            .map(|level| (level - mean(&levels)).powi(2))
            .collect();
        let ratio = mean(&squares).sqrt() / (mean(&levels) * mean(&errors));
        assert!((0.85..1.15).contains(&ratio), "{correlated}: {ratio}");
    }
}

#[test]
fn white_noise_has_its_level_and_no_correlation() {
    let found = survey(3, 400, |rng| noise(rng, false));
    // 8,000 blocks; uniform noise scatters less than the error says.
    close(found.sigma(), 1.0, 3.0 * found.error());
    assert!(found.error() < 2e-3 && !found.is_correlated(), "{found:?}");
    let (power, _) = found.power([0.5, -0.8], PixelShape::SQUARE);
    // 24 lags of 1/√400,000 each, both ways: 1.5 %.
    assert!((power - 1.0).abs() < 0.06, "{power}");
}

#[test]
fn white_noise_has_the_correlation_of_chance() {
    let mut rng = ChaCha8Rng::seed_from_u64(21);
    let plan = NoisePlan::new(SIDE, 3, None).unwrap();
    let count = 150;
    let found = (0..count).map(|_| {
        let mut survey = plan.survey();
        for _ in 0..16 {
            survey.add(noise(&mut rng, false).view()).unwrap();
        }
        survey.noise().unwrap()
    });
    let found: Vec<StampNoise> = found.collect();
    assert!(found.iter().all(|noise| !noise.is_correlated()));
    let (mean, freedom) = (
        found.iter().map(|noise| noise.chi2.0).sum::<f64>() / f64::from(count),
        found[0].chi2.1,
    );
    // χ² scatters by √(2·24): 0.57 in the mean of 150.
    assert!((mean - freedom).abs() < 2.0, "{mean} {freedom}");
}

#[test]
fn padding_is_no_noise() {
    let padded = |edges: &[bool; 4], rng: &mut ChaCha8Rng| {
        let mut stamp = noise(rng, false);
        for ((y, x), value) in stamp.indexed_iter_mut() {
            let near = [y < 3, y >= SIDE - 2, x < 1, x >= SIDE - 5];
            if near.iter().zip(edges).any(|(near, edge)| *near && *edge) {
                *value = 7.0;
            }
        }
        stamp
    };
    for edge in 0..4 {
        let mut edges = [false; 4];
        edges[edge] = true;
        let found = survey(3, 300, |rng| padded(&edges, rng));
        assert!(
            (found.sigma() - 1.0).abs() < 3.0 * found.error() && !found.is_correlated(),
            "{edge}: {found:?}"
        );
    }
    let mut rng = ChaCha8Rng::seed_from_u64(10);
    let mut survey = NoisePlan::new(SIDE, 3, None).unwrap().survey();
    for _ in 0..30 {
        survey.add(padded(&[true; 4], &mut rng).view()).unwrap();
    }
    assert!(survey.noise().is_none() && survey.surveyed > survey.unusable);
}

#[test]
fn missing_pixels_cost_their_blocks_alone() {
    let found = survey(3, 600, |rng| {
        let mut stamp = noise(rng, false);
        for value in &mut stamp {
            if rng.random_range(0.0..1.0) < 0.01 {
                *value = f32::NAN;
            }
        }
        stamp
    });
    close(found.sigma(), 1.0, 3.0 * found.error());
    // Of 600 frames of 20 blocks of 64 pixels about half are whole: as of 300 frames without missing pixels.
    assert!(
        found.error() < 2.5e-3 && !found.is_correlated(),
        "{found:?}"
    );
    let mut survey = NoisePlan::new(SIDE, 3, None).unwrap().survey();
    survey
        .add(Array2::from_elem((SIDE, SIDE), f32::NAN).view())
        .unwrap();
    assert!(survey.noise().is_none());
}

#[test]
fn blank_stamps_are_unusable_and_do_not_count() {
    let plan = NoisePlan::new(SIDE, 3, None).unwrap();
    let (mut empty, mut with, mut without) = (plan.survey(), plan.survey(), plan.survey());
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    for _ in 0..20 {
        let flat = Array2::from_elem((SIDE, SIDE), 2.5f32);
        let stamp = noise(&mut rng, false);
        empty.add(flat.view()).unwrap();
        with.add(flat.view()).unwrap();
        for survey in [&mut with, &mut without] {
            survey.add(stamp.view()).unwrap();
        }
    }
    assert_eq!(empty.result().unwrap(), None);
    assert_eq!(with.result().unwrap(), without.result().unwrap());
}

#[test]
fn surveys_joined_are_one() {
    let plan = NoisePlan::new(SIDE, 2, None).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(10);
    let mut whole = plan.survey();
    let mut parts = [plan.survey(), plan.survey()];
    for k in 0..60 {
        let mut stamp = noise(&mut rng, false);
        stamp[(SIDE / 2, SIDE / 2)] += 500.0;
        if k % 7 == 0 {
            stamp[(0, 0)] = f32::NAN;
        }
        whole.add(stamp.view()).unwrap();
        parts[k / 25 % 2].add(stamp.view()).unwrap();
    }
    // The last ten were added to the first.
    let [mut first, second] = parts;
    first.join(&second).unwrap();
    let [found, expected] = [first, whole].map(|survey| survey.result().unwrap().unwrap());
    // Sums in another order.
    assert!((found.noise.sigma() / expected.noise.sigma() - 1.0).abs() < 1e-12);
    assert!(
        (found.mean_square_radius.unwrap() / expected.mean_square_radius.unwrap() - 1.0).abs()
            < 1e-12
    );
}

#[test]
fn noise_of_summed_pixels_has_their_power() {
    let found = survey(3, 1000, |rng| noise(rng, true));
    assert!(found.is_correlated());
    assert!((found.correlation(1, 0) - 0.5).abs() < 0.01, "{found:?}");
    assert!((found.correlation(-1, 1) - 0.25).abs() < 0.01, "{found:?}");
    let wave = |kx: f64, ky: f64| (1.0 + kx.cos()) * (1.0 + ky.cos());
    for k in [[0.0, 0.0], [0.5, 0.3], [-1.0, 0.4], [0.9, -1.1]] {
        let (power, slopes) = found.power(k, PixelShape::SQUARE);
        let expected = wave(k[0], k[1]);
        // As above with a million pixels, four times as much where the power is.
        assert!((power - expected).abs() < 0.12, "{k:?}: {power} {expected}");
        let dx = -k[0].sin() * (1.0 + k[1].cos());
        let dy = -k[1].sin() * (1.0 + k[0].cos());
        let along = [k[0] * dx - k[1] * dy, k[1] * dx + k[0] * dy];
        // Far lags weigh more in slopes, which scatter by 0.07 between seeds.
        for (found, expected) in slopes.iter().zip(along) {
            assert!((found - expected).abs() < 0.25, "{k:?}: {found} {expected}");
        }
    }
}

#[test]
fn galaxies_and_neighbours_do_not_raise_the_noise() {
    let plain = survey(2, 300, |rng| noise(rng, false));
    let crowded = survey(2, 300, |rng| {
        let mut stamp = noise(rng, false);
        // An exponential disc in the middle with a scale of 6 px and 2000 times the noise's light, and in
        // every stamp one like it, of 3 px and S/N 20, 20 px away in any direction.
        let away: f32 = rng.random_range(0.0..std::f32::consts::TAU);
        for ((y, x), value) in stamp.indexed_iter_mut() {
            let (y, x) = (y as f32 - 23.5, x as f32 - 23.5);
            *value += 2000.0 / 226.0 * (-x.hypot(y) / 6.0).exp();
            let (x, y) = (x - 20.0 * away.cos(), y - 20.0 * away.sin());
            *value += 300.0 / 56.0 * (-x.hypot(y) / 3.0).exp();
        }
        stamp
    });
    // The same noise, of which fewer blocks are left.
    close(crowded.sigma() / plain.sigma(), 1.0, 4e-3);
    assert!(!crowded.is_correlated(), "{crowded:?}");
}

#[test]
fn blocks_go_once_around_the_border() {
    assert_eq!(border_blocks(48).len(), 20);
    let odd = border_blocks(51);
    assert_eq!((odd.len(), odd[0], odd[5]), (20, (0, 0), (0, 43)));
    assert!(NoisePlan::new(23, 2, None).is_err());
    let long = NoisePlan::new(48, 5, None).unwrap_err().to_string();
    assert!(long.contains("lags up to 5 px"), "{long}");
    let mut survey = NoisePlan::new(48, 3, None).unwrap().survey();
    for (full, reach) in [(48, 2), (50, 3)] {
        let other = NoisePlan::new(full, reach, None).unwrap().survey();
        let refused = survey.join(&other).unwrap_err().to_string();
        assert!(
            refused.contains(&format!(
                "stamps of {full} × {full} pixels with lags up to {reach} px; expected stamps of 48"
            )),
            "{refused}"
        );
    }
    let plan = NoisePlan::new(48, 3, None).unwrap();
    assert_eq!(plan.rows(3, 3), [0, 1, 2]);
    // Stamps one by one, as in a batch: a thousand of them, not one.
    assert_eq!(plan.rows(1, 10_000).len(), 1000);
    assert_eq!(plan.rows(1000, 7), [3]);
    assert_eq!(plan.rows(100, 100), [5, 15, 25, 35, 45, 55, 65, 75, 85, 95]);
    assert!(plan.survey().noise().is_none());
}
