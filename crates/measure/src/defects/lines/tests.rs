use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::defects::tests::{found, galaxy, limits};

const N: usize = 48;

fn noise(rng: &mut ChaCha8Rng) -> f32 {
    StandardNormal.sample(rng)
}

/// Light by the place (x, y) from the middle, in noise of one.
fn stamp(light: impl Fn(f32, f32) -> f32, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let place = |k: usize| k as f32 - 0.5 * (N as f32 - 1.0);
    (0..N * N)
        .map(|at| light(place(at % N), place(at / N)) + noise(rng))
        .collect()
}

#[test]
fn bad_columns_and_rows_become_missing() {
    let mut rng = ChaCha8Rng::seed_from_u64(21);
    for fwhm in [1.8, 3.4] {
        let limits = limits(fwhm);
        let least = if fwhm < 2.8 { 8.0 } else { 2.5 };
        for (first, width, level) in [
            (5, 1, least),
            (24, 1, 5.0 * least),
            (46, 1, least),
            (12, 1, 1e3),
            (0, 1, 20.0),
            (30, 2, 20.0),
            (20, 1, -3.0),
            (23, 2, -5.0),
        ] {
            // Edges and pairs show by their steepness.
            if fwhm < 2.8 && level > 0.0 && (first == 0 || width > 1) {
                continue;
            }
            for is_column in [true, false] {
                let mut stamp = galaxy(fwhm, N, 20.0, &mut rng);
                let line = |at: usize| if is_column { at % N } else { at / N };
                let bad = |at: &usize| (first..first + width).contains(&line(*at));
                let expected: Vec<usize> = (0..N * N).filter(bad).collect();
                expected.iter().for_each(|&at| stamp[at] += level);
                let (missing, counts) = found(&stamp, N, 1.0, &limits);
                assert_eq!(missing, expected, "{fwhm} {first} {width} {level}");
                assert_eq!(counts.lines as usize, width * N);
            }
        }
    }
}

#[test]
fn a_cosmic_ray_takes_no_line_with_it() {
    let mut stamp = galaxy(3.4, N, 20.0, &mut ChaCha8Rng::seed_from_u64(22));
    for k in 0..12 {
        stamp[(10 + k) * N + 8] += 1e4;
    }
    let (missing, counts) = found(&stamp, N, 1.0, &limits(3.4));
    assert_eq!((missing.len(), counts.lines), (12, 0));
}

#[test]
fn trails_become_missing_at_any_angle() {
    let mut rng = ChaCha8Rng::seed_from_u64(23);
    let limits = limits(3.4);
    for level in [6.0, 10.0, 20.0, 1e3] {
        let mut seen = 0;
        for _ in 0..50 {
            let angle: f32 = rng.random_range(0.0..std::f32::consts::PI);
            let off: f32 = rng.random_range(-16.0..16.0);
            let across = |x: f32, y: f32| x * angle.cos() + y * angle.sin() - off;
            // A Moffat profile of β = 3 integrated along a line.
            let trail = |x: f32, y: f32| level * (1.0 + (across(x, y) / 3.6).powi(2)).powf(-2.5);
            let core = |x: f32, y: f32| 20.0 * (-(x * x + y * y) / 18.0).exp();
            let stamp = stamp(|x, y| trail(x, y) + core(x, y), &mut rng);
            let (missing, counts) = found(&stamp, N, 1.0, &limits);
            if counts.lines == 0 {
                continue;
            }
            seen += 1;
            let place = |k: usize| k as f32 - 0.5 * (N as f32 - 1.0);
            let off = |at: &usize| across(place(at % N), place(at / N)).abs();
            assert!(missing.iter().all(|at| off(at) < 9.0), "{level} {angle}");
            // Nothing of its middle is left.
            let left = (0..N * N).filter(|at| off(at) < 3.0 && !missing.contains(at));
            assert_eq!(left.count(), 0, "{level} {angle}");
        }
        assert!(seen >= 45, "{level}: {seen} of 50");
    }
}

#[test]
fn trails_that_fade_become_missing() {
    let mut rng = ChaCha8Rng::seed_from_u64(26);
    let limits = limits(3.4);
    for (level, fade) in [(10.0, 0.3), (20.0, 0.6), (1e3, 0.7)] {
        let mut seen = 0;
        for _ in 0..50 {
            let angle: f32 = rng.random_range(0.0..std::f32::consts::PI);
            let off: f32 = rng.random_range(-12.0..12.0);
            let (sin, cos) = angle.sin_cos();
            let trail = |x: f32, y: f32| {
                let (across, along) = (x * cos + y * sin - off, y * cos - x * sin);
                level * (1.0 + fade * along / 24.0) * (-across * across / 3.25).exp()
            };
            let core = |x: f32, y: f32| 20.0 * (-(x * x + y * y) / 18.0).exp();
            let stamp = stamp(|x, y| trail(x, y).max(0.0) + core(x, y), &mut rng);
            seen += usize::from(found(&stamp, N, 1.0, &limits).1.lines > 0);
        }
        // 39 to 45; the others end near a corner, or fade by more than a ramp may.
        assert!(seen >= 35, "{level} {fade}: {seen} of 50");
    }
}

#[test]
fn galaxies_of_any_shape_are_no_trails() {
    let mut rng = ChaCha8Rng::seed_from_u64(24);
    let limits = limits(3.4);
    // About an exponential disc, of Gaussians, behind a Gaussian PSF of FWHM 3.4 px; its peak is one.
    let disc = |scale: f32, q: f32, angle: f32, [x0, y0]: [f32; 2]| {
        let parts = [(0.2, 0.5), (0.5, 1.2), (0.3, 2.2)].map(|(light, width)| {
            let variance = |axis: f32| (width * scale * axis).powi(2) + 2.08;
            (light, [variance(1.0), variance(q)])
        });
        let at = move |a: f32, b: f32| -> f32 {
            let of = |(light, [long, short]): (f32, [f32; 2])| {
                light / (long * short).sqrt() * (-0.5 * (a * a / long + b * b / short)).exp()
            };
            parts.into_iter().map(of).sum()
        };
        move |x: f32, y: f32| {
            let ((x, y), (sin, cos)) = ((x - x0, y - y0), angle.sin_cos());
            at(x * cos + y * sin, y * cos - x * sin) / at(0.0, 0.0)
        }
    };
    for peak in [10.0, 30.0, 100.0, 1e3, 1e4, 1e6] {
        for scale in [2.0, 4.0, 8.0, 12.0] {
            for q in [1.0, 0.5, 0.2, 0.1] {
                for _ in 0..4 {
                    let angle = rng.random_range(0.0..std::f32::consts::PI);
                    let light = disc(scale, q, angle, [0.3, -0.2]);
                    let stamp = stamp(|x, y| peak * light(x, y), &mut rng);
                    let (missing, _) = found(&stamp, N, 1.0, &limits);
                    assert!(missing.is_empty(), "{peak} {scale} {q} {angle}");
                }
            }
        }
        // Neighbours at both ends of a line through the galaxy.
        for distance in [14.0, 18.0, 21.0] {
            let angle: f32 = rng.random_range(0.0..std::f32::consts::PI);
            let (sin, cos) = angle.sin_cos();
            let three =
                [-distance, 0.0, distance].map(|at| disc(3.0, 0.6, angle, [at * cos, at * sin]));
            let stamp = stamp(
                |x, y| peak * three.iter().map(|one| one(x, y)).sum::<f32>(),
                &mut rng,
            );
            let (missing, _) = found(&stamp, N, 1.0, &limits);
            assert!(missing.is_empty(), "{peak} {distance} {angle}");
        }
    }
}

#[test]
fn stripes_and_correlated_noise_keep_their_lines() {
    let mut rng = ChaCha8Rng::seed_from_u64(25);
    let limits = limits(3.4);
    for _ in 0..200 {
        let white = stamp(|_, _| 0.0, &mut rng);
        let stripes: Vec<f32> = (0..N).map(|_| 0.5 * noise(&mut rng)).collect();
        let striped: Vec<f32> = (0..N * N).map(|at| white[at] + stripes[at / N]).collect();
        let at = |x: usize, y: usize| white[(y % N) * N + x % N];
        // Noise of a resampled image, of its own level.
        let smooth: Vec<f32> = (0..N * N)
            .map(|k| {
                let (x, y) = (k % N, k / N);
                let near = at(x + 1, y) + at(x + N - 1, y) + at(x, y + 1) + at(x, y + N - 1);
                (at(x, y) + 0.7 * near) / 1.72
            })
            .collect();
        for stamp in [&striped, &smooth] {
            assert!(found(stamp, N, 1.0, &limits).0.is_empty());
        }
    }
}

#[test]
fn fast_sums_agree_with_plain_ones() {
    let mut rng = ChaCha8Rng::seed_from_u64(26);
    // Dirty.
    let mut sums = [vec![1e9; 80], vec![f32::NAN; 3]];
    for n in [3, 8, 15, 16, 17, 33, 48, 64] {
        // Whole numbers, whose sums are exact.
        let stamp: Vec<f32> = (0..n * n).map(|_| rng.random_range(-9..9) as f32).collect();
        sum_lines(&stamp, n, &mut sums);
        let plain = |step: [usize; 2]| -> Vec<f32> {
            (0..n)
                .map(|line| (0..n).map(|k| stamp[line * step[0] + k * step[1]]).sum())
                .collect()
        };
        assert_eq!(sums, [plain([1, n]), plain([n, 1])], "{n}");
    }
}

#[test]
fn fast_strips_agree_with_plain_ones() {
    let mut rng = ChaCha8Rng::seed_from_u64(27);
    // Dirty.
    let mut strips = [0, 3, 80, 500].map(|size| vec![f32::NAN; size]);
    for n in [8, 15, 16, 17, 33, 48, 64] {
        let mut stamp: Vec<f32> = (0..n * n).map(|_| noise(&mut rng)).collect();
        stamp[5 * n + 1] = f32::NAN;
        mean_strips(&stamp, n, &mut strips);
        for (side, strip) in strips.iter().enumerate() {
            assert_eq!(strip.len(), n);
            let plain: Vec<f32> = (0..n)
                .map(|k| {
                    let pixels = (0..STRIP).map(|depth| match side {
                        0 => stamp[k * n + depth],
                        1 => stamp[k * n + n - 1 - depth],
                        2 => stamp[depth * n + k],
                        _ => stamp[(n - 1 - depth) * n + k],
                    });
                    pixels.sum::<f32>() / STRIP as f32
                })
                .collect();
            for (fast, plain) in strip.iter().zip(&plain) {
                let agrees = fast == plain || fast.is_nan() && plain.is_nan();
                assert!(agrees, "{n} {side} {fast} {plain}");
            }
            for at in 1..n - 1 {
                let level = smooth([plain[at - 1], plain[at], plain[at + 1]]);
                for least in [level - 1e-3, level, level + 1e-3] {
                    let brighter = |near: &[f32]| smooth([near[0], near[1], near[2]]) > least;
                    let expected = plain.windows(3).any(brighter);
                    assert_eq!(is_brighter(strip, least), expected, "{n} {side} {at}");
                    let expected = plain.iter().any(|value| value.abs() > least);
                    assert_eq!(exceeds(strip, least), expected, "{n} {side} {at}");
                }
            }
        }
    }
}
