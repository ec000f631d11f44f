use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};
use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

use super::*;

const N: usize = 48;

fn psf(fwhm: f64) -> Array2<f64> {
    let shape = Shear::new(0.05, -0.03);
    let psf = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, fwhm, shape).unwrap();
    psf.stamp(N)
}

pub(super) fn limits(fwhm: f64) -> LightLimits {
    LightLimits::from_psf(psf(fwhm).view())
}

/// A galaxy no larger than its PSF, of a peak of `peak` in noise of one.
pub(super) fn galaxy(fwhm: f64, n: usize, peak: f32, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let scale = (n as f64 - 1.0) / 2.0;
    let centre = [0, 1].map(|_| scale + rng.random_range(-0.7..0.7));
    // A Moffat of β = 3 without its pixel, which is narrower than the PSF.
    let alpha = fwhm / (2.0 * (2f64.powf(1.0 / 3.0) - 1.0).sqrt());
    (0..n * n)
        .map(|at| {
            let square = (((at % n) as f64 - centre[0]).powi(2)
                + ((at / n) as f64 - centre[1]).powi(2))
                / (alpha * alpha);
            let noise: f32 = StandardNormal.sample(rng);
            peak * (1.0 + square as f32).powi(-3) + noise
        })
        .collect()
}

fn remove(
    defects: &mut Defects,
    stamp: &mut [f32],
    n: usize,
    noise: f32,
    limits: &LightLimits,
) -> DefectCounts {
    let mut found = DefectCounts {
        repeated: defects.remove_repeated(stamp, n, Screening::of(stamp, n)),
        ..DefectCounts::default()
    };
    defects.remove_unlit(stamp, n, noise, limits, &mut found);
    found
}

/// The pixels that become missing, and their number by cause.
pub(super) fn found(
    stamp: &[f32],
    n: usize,
    noise: f32,
    limits: &LightLimits,
) -> (Vec<usize>, DefectCounts) {
    let mut cleaned = stamp.to_vec();
    // What was found before does not matter.
    let mut dirty = Defects::new(n);
    let mut other: Vec<f32> = (0..81)
        .map(|at| if at % 2 == 0 { 1e9 } else { -1e9 })
        .collect();
    remove(&mut dirty, &mut other, 9, 1.0, limits);
    let counts = remove(&mut dirty, &mut cleaned, n, noise, limits);
    let places: Vec<usize> = (0..stamp.len())
        .filter(|&at| cleaned[at].is_nan() && !stamp[at].is_nan())
        .collect();
    assert_eq!(places.len() as u32, counts.total());
    for at in (0..stamp.len()).filter(|at| !places.contains(at)) {
        assert_eq!(cleaned[at].to_bits(), stamp[at].to_bits());
    }
    (places, counts)
}

#[test]
fn clean_stamps_of_any_brightness_keep_their_pixels() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for fwhm in [1.5, 2.0, 3.4, 5.0] {
        let limits = limits(fwhm);
        for peak in [0.0, 1.0, 10.0, 100.0, 1000.0, 1e4, 1e6] {
            for n in [24, 47, 48, 64] {
                let stamp = galaxy(fwhm, n, peak, &mut rng);
                for noise in [1.0, 0.5, 0.0] {
                    let (places, _) = found(&stamp, n, noise, &limits);
                    assert!(places.is_empty(), "{fwhm} {peak} {n} {noise}: {places:?}");
                }
                for quantum in [0.2, 1.0, 2.0] {
                    let whole: Vec<f32> = stamp.iter().map(|v| (v / quantum).round()).collect();
                    let noise = 1f32.max(1.0 / quantum);
                    let (places, _) = found(&whole, n, noise, &limits);
                    assert!(
                        places.is_empty(),
                        "{fwhm} {peak} {n} /{quantum}: {places:?}"
                    );
                }
            }
        }
    }
}

#[test]
fn counts_of_few_photons_keep_their_pixels() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let limits = limits(3.4);
    for sky in [1.0, 10.0] {
        for peak in [1.0, 10.0, 100.0, 1000.0] {
            let light = galaxy(3.4, N, peak, &mut rng);
            let counts: Vec<f32> = light
                .iter()
                .map(|v| {
                    let mean = f64::from(v.max(0.0)) + sky;
                    Poisson::new(mean).unwrap().sample(&mut rng) as f32 - sky as f32
                })
                .collect();
            let (places, _) = found(&counts, N, (sky as f32).sqrt(), &limits);
            assert!(places.is_empty(), "{sky} {peak}: {places:?}");
        }
    }
}

#[test]
fn whole_numbers_of_little_noise_keep_their_pixels() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for sigma in [0.5, 0.4, 0.3, 0.25, 0.2] {
        for _ in 0..40 {
            let noise = |_| {
                let value: f32 = StandardNormal.sample(&mut rng);
                (sigma * value).round()
            };
            let stamp: Vec<f32> = (0..N * N).map(noise).collect();
            let (places, _) = found(&stamp, N, sigma, &limits(3.4));
            assert!(places.is_empty(), "{sigma}: {}", places.len());
        }
    }
}

#[test]
fn a_cold_pixel_leaves_zeros_of_counts() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    // Of a gain, so that they are no whole numbers.
    let mut stamp: Vec<f32> = (0..N * N)
        .map(|_| 1.7 * f32::from(u8::from(rng.random_bool(0.02))))
        .collect();
    let cold = 5 * N + 7;
    stamp[cold] = -99.0;
    let (places, _) = found(&stamp, N, 0.1, &limits(3.4));
    assert!(places.contains(&cold));
    assert!(
        places.iter().all(|&at| stamp[at] != 0.0),
        "{} zeros",
        places.len()
    );
}

#[test]
fn stamps_without_noise_keep_zeros_beyond_their_light() {
    let limits = limits(3.4);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let stamp: Vec<f32> = galaxy(3.4, N, 1e9, &mut rng)
        .iter()
        .map(|v| if *v < 3e4 { 0.0 } else { *v })
        .collect();
    for noise in [0.0, 1.0] {
        assert!(found(&stamp, N, noise, &limits).0.is_empty());
    }
    // Counts without a sky.
    let sparse: Vec<f32> = (0..N * N)
        .map(|_| f32::from(u8::from(rng.random_bool(0.02))))
        .collect();
    assert!(found(&sparse, N, 0.1, &limits).0.is_empty());
}

/// A stamp at S/N of about 100 with defects.
fn damaged(defects: &[(usize, usize)], value: impl Fn(f32) -> f32) -> Vec<f32> {
    let mut stamp = galaxy(3.4, N, 20.0, &mut ChaCha8Rng::seed_from_u64(4));
    for &(x, y) in defects {
        stamp[y * N + x] = value(stamp[y * N + x]);
    }
    stamp
}

#[test]
fn fill_values_of_any_size_become_missing() {
    let disc: Vec<(usize, usize)> = (0..7)
        .flat_map(|y| (0..7).map(move |x| (x, y)))
        .filter(|(x, y)| (*x as i32 - 3).pow(2) + (*y as i32 - 3).pow(2) <= 10)
        .collect();
    for corner in [(0, 0), (30, 10), (41, 41)] {
        let places: Vec<_> = disc
            .iter()
            .map(|(x, y)| (x + corner.0, y + corner.1))
            .collect();
        for fill in [0.0, 0.3, -20.0, -9999.0, -1e16, 65535.0, 1e18] {
            let stamp = damaged(&places, |_| fill);
            let (missing, counts) = found(&stamp, N, 1.0, &limits(3.4));
            // Ends of rows of equal pixels are narrower than the smallest area.
            let least = if fill.abs() < 5.0 {
                places.len() - 8
            } else {
                places.len()
            };
            assert!(missing.len() >= least, "{fill}: {counts:?}");
            assert!(
                missing.iter().all(|at| places.contains(&(at % N, at / N))),
                "{fill}"
            );
        }
    }
    let column: Vec<_> = (0..N).map(|y| (20, y)).collect();
    let (missing, counts) = found(&damaged(&column, |_| 0.0), N, 1.0, &limits(3.4));
    assert_eq!((missing.len(), counts.repeated), (N, N as u32));
}

#[test]
fn hot_pixels_and_rays_become_missing() {
    let block: Vec<(usize, usize)> = (0..16).map(|k| (33 + k % 4, 8 + k / 4)).collect();
    let wide: Vec<(usize, usize)> = (0..25).map(|k| (5 + k % 5, 38 + k / 5)).collect();
    let columns: Vec<(usize, usize)> = (0..N).flat_map(|y| [(14, y), (15, y)]).collect();
    let shapes: [&[(usize, usize)]; 9] = [
        &block,
        &wide,
        &columns,
        &[(30, 11)],
        &[(0, 0)],
        &[(47, 20)],
        &[(9, 30), (10, 30), (11, 30)],
        &[(36, 36), (37, 36), (36, 37), (37, 37)],
        &[(5, 5), (6, 6), (7, 7), (8, 8), (9, 9)],
    ];
    for shape in shapes {
        for charge in [100.0, 1000.0, 1e4, 1e18] {
            let stamp = damaged(shape, |value| value + charge);
            // The edges of areas are found by their steepness, with more noise.
            if shape.len() > 9 && charge < 200.0 {
                continue;
            }
            let (missing, counts) = found(&stamp, N, 1.0, &limits(3.4));
            let mut expected: Vec<usize> = shape.iter().map(|(x, y)| y * N + x).collect();
            expected.sort_unstable();
            assert_eq!(missing, expected, "{charge}: {counts:?}");
            // The largest charge leaves areas of one value.
            let causes = counts.bright + counts.repeated + counts.lines;
            assert_eq!(causes, missing.len() as u32);
        }
    }
    // Behind a PSF of one pixel, a bright pixel may be a star.
    let stamp = damaged(&[(30, 11)], |value| value + 30.0);
    assert!(found(&stamp, N, 1.0, &limits(0.8)).0.is_empty());
}

#[test]
fn neighbours_of_defects_keep_their_light() {
    // In the core, where a fill value makes the mean of pairs negative.
    let stamp = damaged(&[(24, 24)], |_| -1e5);
    assert_eq!(found(&stamp, N, 1.0, &limits(3.4)).0, [24 * N + 24]);
    // Missing pixels stay missing, and are not counted.
    let stamp = damaged(&[(24, 24), (30, 30)], |_| f32::NAN);
    assert_eq!(
        found(&stamp, N, 1.0, &limits(3.4)).1,
        DefectCounts::default()
    );
}

#[test]
fn dead_pixels_of_a_core_become_missing() {
    let clean = galaxy(3.4, N, 100.0, &mut ChaCha8Rng::seed_from_u64(12));
    let brightest = (0..N * N)
        .max_by(|a, b| clean[*a].total_cmp(&clean[*b]))
        .unwrap();
    for value in [0.0, 2.0, -5.0] {
        let mut stamp = clean.clone();
        stamp[brightest] = value;
        let (places, counts) = found(&stamp, N, 1.0, &limits(3.4));
        assert_eq!(places, [brightest], "{value}");
        assert_eq!(counts.dark, 1);
    }
}

#[test]
fn holes_of_rings_keep_their_light() {
    let mut rng = ChaCha8Rng::seed_from_u64(13);
    for radius in [2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 7.0] {
        // Points on a ring behind a Gaussian PSF of FWHM 3.4 px.
        let points: Vec<[f32; 2]> = (0..90)
            .map(|k| (k as f32 * 4.0).to_radians().sin_cos())
            .map(|(sin, cos)| [23.4 + radius * cos, 23.6 + radius * sin])
            .collect();
        let light = |at: usize| -> f32 {
            let of = |point: &[f32; 2]| {
                let (x, y) = ((at % N) as f32 - point[0], (at / N) as f32 - point[1]);
                (-(x * x + y * y) / 4.2).exp()
            };
            points.iter().map(of).sum()
        };
        for peak in [10.0, 100.0, 1e4] {
            let stamp: Vec<f32> = (0..N * N)
                .map(|at| {
                    let noise: f32 = StandardNormal.sample(&mut rng);
                    peak / 20.0 * light(at) + noise
                })
                .collect();
            let psf = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, 3.4, Shear::ZERO);
            let limits = LightLimits::from_psf(psf.unwrap().stamp(N).view());
            assert!(
                found(&stamp, N, 1.0, &limits).0.is_empty(),
                "{radius} {peak}"
            );
        }
    }
}

#[test]
fn a_sky_that_was_not_subtracted_is_no_defect() {
    for sky in [-30.0, 30.0] {
        let stamp: Vec<f32> = galaxy(3.4, N, 30.0, &mut ChaCha8Rng::seed_from_u64(5))
            .iter()
            .map(|v| v + sky)
            .collect();
        assert!(found(&stamp, N, 1.0, &limits(3.4)).0.is_empty(), "{sky}");
    }
}

#[test]
fn fast_loops_agree_with_plain_ones() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for n in [3, 7, 8, 9, 16, 17, 18, 33, 48, 63, 64] {
        let mut stamp: Vec<f32> = (0..n * n).map(|_| rng.random_range(-3..4) as f32).collect();
        stamp[0] = f32::NAN;
        stamp[n] = f32::INFINITY;
        stamp[n * n - 1] = f32::NEG_INFINITY;
        let numbers = || stamp.iter().copied().filter(|v| !v.is_nan());
        let low = numbers().fold(f32::INFINITY, f32::min);
        let high = numbers().fold(f32::NEG_INFINITY, f32::max);
        assert_eq!(extremes(&stamp), [low, high], "{n}");
        let right = |at: usize| !(at + 1).is_multiple_of(n) && stamp[at] == stamp[at + 1];
        let above = |at: usize| at + n < n * n && stamp[at] == stamp[at + n];
        // The end of a row below the last is compared with the next one's beginning.
        let next = |at: usize| at + n < n * n && stamp[at] == stamp[at + 1];
        let equal = (0..n * n).filter(|&at| right(at) || next(at) || above(at));
        assert_eq!(
            Screening::of(&stamp, n),
            Screening {
                equal: equal.count() as u32
            },
            "{n}"
        );
    }
}

#[test]
fn areas_are_squares_and_lines_of_equal_pixels() {
    // Against the definition: a pixel is in an area if some square of this side, or line of as many pixels, around it is of one value.
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    for (n, side) in [(9, 3), (24, 3), (31, 4)] {
        for share in [0.05, 0.2] {
            let stamp: Vec<f32> = (0..n * n)
                .map(|_| if rng.random_bool(share) { 2.0 } else { 1.0 })
                .collect();
            let mut defects = Defects::new(n);
            defects.marks.resize(n * n, false);
            defects.mark_areas(&stamp, n, side, 0.0);
            let mut expected = vec![false; n * n];
            for (height, width) in [(side, side), (1, side * side), (side * side, 1)] {
                for y in 0..(n + 1).saturating_sub(height) {
                    for x in 0..(n + 1).saturating_sub(width) {
                        let all = || {
                            (y..y + height)
                                .flat_map(|row| (x..x + width).map(move |column| row * n + column))
                        };
                        if all().all(|at| stamp[at] == stamp[y * n + x]) {
                            all().for_each(|at| expected[at] = true);
                        }
                    }
                }
            }
            assert_eq!(defects.marks, expected, "{n} {side} {share}");
        }
    }
}

#[test]
fn bounds_contain_stars_at_any_pixel_phase() {
    for fwhm in [1.2, 1.5, 2.0, 3.4] {
        let limits = limits(fwhm);
        for phase in [[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.25, -0.4]] {
            let alpha = fwhm / (2.0 * (2f64.powf(1.0 / 3.0) - 1.0).sqrt());
            // A star as wide as the PSF is without its pixel: narrower than any light behind it.
            let star = |x: isize, y: isize| {
                let square = (x as f64 - phase[0]).powi(2) + (y as f64 - phase[1]).powi(2);
                (1.0 + square / (alpha * alpha)).powi(-3) as f32
            };
            for (ratio, (dx, dy)) in limits.ratios.iter().zip(PAIRS) {
                for (x, y) in (-4..5).flat_map(|y| (-4..5).map(move |x| (x, y))) {
                    let mean = 0.5 * (star(x + dx, y + dy) + star(x - dx, y - dy));
                    assert!(star(x, y) - FAINT_SHARE <= ratio * mean, "{fwhm} {phase:?}");
                }
            }
        }
    }
}

#[test]
fn areas_are_found_at_the_last_row_and_column() {
    let last = N - 1;
    let lines: [Vec<(usize, usize)>; 3] = [
        (0..N).map(|x| (x, last)).collect(),
        (0..N).map(|y| (last, y)).collect(),
        (10..30).map(|x| (x, last)).collect(),
    ];
    for line in lines {
        for fill in [0.0, 0.3, -7.0, 4.5] {
            let stamp = damaged(&line, |_| fill);
            let (places, _) = found(&stamp, N, 1.0, &limits(3.4));
            assert_eq!(places.len(), line.len(), "{fill}");
        }
    }
}

#[test]
fn each_value_of_areas_is_judged_alone() {
    // Light without noise that ends in zeros, with a fill value beside it.
    let alpha = 4.0;
    let mut stamp: Vec<f32> = (0..N * N)
        .map(|at| {
            let square = ((at % N) as f32 - 23.3).powi(2) + ((at / N) as f32 - 23.6).powi(2);
            (1000.0 * (-square / (2.0 * alpha * alpha)).exp()).max(1e-3)
        })
        .collect();
    stamp[0] = 1e-4;
    assert!(found(&stamp, N, 0.0, &limits(3.4)).0.is_empty());
    let fill: Vec<usize> = (0..16).map(|k| (30 + k / 4) * N + 22 + k % 4).collect();
    fill.iter().for_each(|&at| stamp[at] = 500.0);
    assert_eq!(found(&stamp, N, 0.0, &limits(3.4)).0, fill);
}

#[test]
fn defects_are_found_before_sky_and_noise_are_known() {
    let mut rng = ChaCha8Rng::seed_from_u64(10);
    let limits = limits(3.4);
    for (sky, slope) in [(0.0, 0.0), (1000.0, 0.0), (-300.0, 0.05), (50.0, -0.1)] {
        for peak in [0.0, 20.0, 1000.0] {
            let clean: Vec<f32> = galaxy(3.4, N, peak, &mut rng)
                .iter()
                .enumerate()
                .map(|(at, v)| v + sky + slope * (at % N) as f32)
                .collect();
            let remove = |stamp: &[f32]| {
                let mut cleaned = stamp.to_vec();
                Defects::new(N).remove_before_survey(&mut cleaned, N, &limits);
                let removed = (0..N * N).filter(|&at| cleaned[at].is_nan());
                removed.collect::<Vec<_>>()
            };
            assert!(remove(&clean).is_empty(), "{sky} {slope} {peak}");
            let expected: Vec<usize> = (0..6)
                .flat_map(|y| (0..6).map(move |x| y * N + x))
                .collect();
            for fill in [0.3, -99.0, -9999.0, 65535.0] {
                let mut stamp = clean.clone();
                expected.iter().for_each(|&at| stamp[at] = sky + fill);
                assert_eq!(remove(&stamp), expected, "{sky} {slope} {peak} {fill}");
            }
            for hot in [7 * N + 11, 20, 47 * N + 30, 25 * N] {
                let mut stamp = clean.clone();
                stamp[hot] += 1e5;
                assert_eq!(remove(&stamp), [hot], "{sky} {slope} {peak}");
            }
            // More than half of the border.
            let mut stamp = clean.clone();
            let corner = |at: &usize| at % N < 6 || at / N < 6;
            let expected: Vec<usize> = (0..N * N).filter(corner).collect();
            expected.iter().for_each(|&at| stamp[at] = sky - 99.0);
            assert_eq!(remove(&stamp), expected, "{sky} {slope} {peak}");
        }
    }
}
