//! The fast sums against dense ones, and responses against differences of sheared galaxies.

use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

use super::*;
use crate::testing::close;

/// Covariances (xx, yy, xy) in px².
const PSF: [f64; 3] = [2.6, 2.2, 0.2];
const GALAXY: [f64; 3] = [4.0, 3.0, 0.6];

/// Light of a Gaussian of a flux at an offset.
fn gaussian([xx, yy, xy]: [f64; 3], flux: f64, [x, y]: [f64; 2]) -> f64 {
    let determinant = xx * yy - xy * xy;
    let exponent = -0.5 * (x * x * yy + y * y * xx - 2.0 * x * y * xy) / determinant;
    flux * exponent.exp() / (std::f64::consts::TAU * determinant.sqrt())
}

fn star() -> Array2<f64> {
    Array2::from_shape_fn((48, 48), |(y, x)| {
        gaussian(PSF, 1.0, [x as f64 - 23.5, y as f64 - 23.5])
    })
}

/// A covariance under the matrix of a shear.
fn sheared([xx, yy, xy]: [f64; 3], [[a, b], [c, d]]: [[f64; 2]; 2]) -> [f64; 3] {
    [
        a * a * xx + 2.0 * a * b * xy + b * b * yy,
        c * c * xx + 2.0 * c * d * xy + d * d * yy,
        a * c * xx + (a * d + b * c) * xy + b * d * yy,
    ]
}

/// Galaxies at places (x, y) with fluxes, behind the PSF, sheared with their places about `about`.
fn exposure(
    side: usize,
    galaxies: &[([f64; 2], f64)],
    g: [f64; 2],
    about: [f64; 2],
) -> Array2<f32> {
    let shear = [[1.0 + g[0], g[1]], [g[1], 1.0 - g[0]]];
    let of_galaxy = sheared(GALAXY, shear);
    let total = [0, 1, 2].map(|k| of_galaxy[k] + PSF[k]);
    let mut image = Array2::<f64>::zeros((side, side));
    for (place, flux) in galaxies {
        let d = [0, 1].map(|k| place[k] - about[k]);
        let moved = [0, 1].map(|k| about[k] + shear[k][0] * d[0] + shear[k][1] * d[1]);
        for ((y, x), value) in image.indexed_iter_mut() {
            *value += gaussian(total, *flux, [x as f64 - moved[0], y as f64 - moved[1]]);
        }
    }
    image.mapv(|value| value as f32)
}

/// Pixels with a weight, by tiles.
fn found(detector: &Detector, image: &Array2<f32>) -> Vec<DetectedPixel> {
    let (height, width) = image.dim();
    let (mut scratch, mut all) = (detector.scratch(), Vec::new());
    for number in 0..height.div_ceil(detector.rows_per_tile()) {
        for tile in detector.tiles(width, number) {
            let [columns, rows] = tile.sides;
            let pixels = Array2::from_shape_fn((rows, columns), |(y, x)| {
                let [x, y] = [x as i64 + tile.origin[0], y as i64 + tile.origin[1]];
                let inside =
                    |at: i64, side: usize| usize::try_from(at).ok().filter(|at| *at < side);
                match (inside(y, height), inside(x, width)) {
                    (Some(y), Some(x)) => image[[y, x]],
                    _ => f32::NAN,
                }
            });
            detector
                .detect(&tile, pixels.view(), &mut scratch, &mut all)
                .unwrap();
        }
    }
    all.sort_by_key(|pixel| [pixel.place[1], pixel.place[0]]);
    all
}

// A threshold in image units that noise does not move, for galaxies without noise.
fn without_noise(threshold: f64) -> Detector {
    const NOISE: f64 = 1e-6;
    let settings = DetectionMethod::default();
    let known = Detector::new(star().view(), &StampNoise::white(NOISE), None, &settings).unwrap();
    let settings = DetectionMethod {
        threshold: threshold / known.constants.light_noise,
        threshold_half_width: 0.3 * threshold / known.constants.light_noise,
        softening: 1e6,
        ..settings
    };
    Detector::new(star().view(), &StampNoise::white(NOISE), None, &settings).unwrap()
}

const PAIR: [([f64; 2], f64); 2] = [([60.2, 61.7], 900.0), ([65.1, 63.9], 500.0)];

#[test]
fn functionals_are_those_of_the_galaxy_without_psf() {
    let detector = without_noise(5.0);
    let image = exposure(128, &PAIR[..1], [0.0; 2], [0.0; 2]);
    let ([x0, y0], flux) = PAIR[0];
    let (x, y) = (62, 60);
    let sums = detector.sums(image.as_slice().unwrap(), 128, [x, y]);
    let lengths = detector.shared.lengths;
    let under = |sigma: f64, at: [f64; 2]| {
        let [xx, yy, xy] = GALAXY;
        let total = [xx + sigma * sigma, yy + sigma * sigma, xy];
        gaussian(total, flux, [x as f64 + at[0] - x0, y as f64 + at[1] - y0])
    };
    let centre = under(lengths.detection_sigma, [0.0; 2]);
    // Of the peak: rounding of single precision, and the square.
    let tolerance = 3e-5 * centre;
    close(sums[LIGHT], centre, tolerance);
    for (j, at) in lengths.neighbours().into_iter().enumerate() {
        close(
            sums[EXCESS + j],
            centre - under(lengths.detection_sigma, at),
            tolerance,
        );
    }
    close(sums[M00], under(lengths.moment_sigma, [0.0; 2]), tolerance);
    // Second derivatives by differences: σ² (∂_x² − ∂_y²) and 2σ² ∂_x ∂_y of the smoothed light.
    let h = 1e-3;
    let at = |dx: f64, dy: f64| under(lengths.moment_sigma, [h * dx, h * dy]);
    let second = [
        at(1.0, 0.0) + at(-1.0, 0.0) - at(0.0, 1.0) - at(0.0, -1.0),
        0.5 * (at(1.0, 1.0) + at(-1.0, -1.0) - at(1.0, -1.0) - at(-1.0, 1.0)),
    ];
    for (k, second) in second.into_iter().enumerate() {
        let expected = lengths.moment_sigma.powi(2) * second / (h * h);
        close(sums[M00 + 1 + k], expected, tolerance);
    }
}

#[test]
fn light_beyond_the_square_of_the_kernels_changes_no_moment() {
    let noise = StampNoise::white(1.0);
    for profile in [
        PsfProfile::Moffat { beta: 2.5 },
        PsfProfile::Moffat { beta: 3.0 },
        PsfProfile::Kolmogorov,
    ] {
        let psf = FunctionalPsf::new(profile, 3.5, Shear::new(0.05, -0.03)).unwrap();
        let star = psf.stamp(64);
        let own = Detector::new(star.view(), &noise, None, &DetectionMethod::default()).unwrap();
        let (radius, wide) = (own.radius, 30);
        let axes = Axes::own(PixelShape::SQUARE);
        let all = Functionals::new(star.view(), &noise, &own.shared.lengths, &axes, wide);
        let side = 2 * wide + 2;
        // A galaxy of stars with Gaussian weights, and one of half its light beside it.
        let mut image = Array2::<f64>::zeros((side, side));
        for (dy, dx) in (-8..=8).flat_map(|y: i64| (-8..=8).map(move |x: i64| (y, x))) {
            let weight = (-0.125 * (dx * dx + dy * dy) as f64).exp();
            for (share, [x0, y0]) in [(1.0, [0, 0]), (0.5, [11, 5])] {
                for ((y, x), light) in star.indexed_iter() {
                    let at = [(y as i64 + dy + y0, 31), (x as i64 + dx + x0, 31)]
                        .map(|(at, middle)| usize::try_from(at - middle + wide as i64));
                    if let [Ok(y), Ok(x)] = at
                        && let Some(value) = image.get_mut([y, x])
                    {
                        *value += share * weight * light;
                    }
                }
            }
        }
        let (mut total, mut beyond) = ([0.0; KERNELS], [0.0; KERNELS]);
        for (at, weights) in all.kernels.iter().enumerate() {
            let (y, x) = (at / side, at % side);
            let is_beyond = x.abs_diff(wide).max(y.abs_diff(wide)) > radius;
            for (k, weight) in weights.iter().enumerate() {
                let part = f64::from(*weight) * image[[y, x]];
                total[k] += part;
                beyond[k] += f64::from(u8::from(is_beyond)) * part;
            }
        }
        for beyond in beyond {
            // Of the light that ellipticities are divided by; a twentieth of what is required of m.
            let share = beyond.abs() / total[M00];
            assert!(share < 1e-4, "{profile:?}: {share}");
        }
    }
}

#[test]
fn responses_are_those_of_sheared_blends() {
    let detector = without_noise(9.0);
    // About each pixel, so that the neighbours and the blend move.
    let plain = found(&detector, &exposure(128, &PAIR, [0.0; 2], [0.0; 2]));
    assert!(plain.len() > 10, "{}", plain.len());
    let h = 1e-3;
    let largest = plain
        .iter()
        .flat_map(|pixel| pixel.response.concat())
        .fold(0.0f64, |a, b| a.max(b.abs()));
    let partial = plain.iter().filter(|pixel| pixel.weight < 0.99).count();
    assert!(partial > 5 && largest > 0.1, "{partial} {largest}");
    for pixel in plain.iter().step_by(3) {
        let about = pixel.place.map(|at| at as f64);
        for g in 0..2 {
            let e = [h, -h].map(|h| {
                let mut shear = [0.0; 2];
                shear[g] = h;
                let image = exposure(128, &PAIR, shear, about);
                let sums = detector.sums(image.as_slice().unwrap(), 128, pixel.place);
                detector
                    .pixel(pixel.place, &sums)
                    .map_or([0.0; 2], |own| own.e)
            });
            for (k, (plus, minus)) in e[0].iter().zip(e[1]).enumerate() {
                let slope = (plus - minus) / (2.0 * h);
                // Rounding of the sums over 2h, and terms of third order.
                close(pixel.response[k][g], slope, 4e-3 * largest);
            }
        }
    }
}

#[test]
fn noise_changes_neither_responses_nor_shapes() {
    // A galaxy near the threshold, at a pixel beside its peak.
    let detector = Detector::new(
        star().view(),
        &StampNoise::white(1.0),
        None,
        &DetectionMethod::default(),
    )
    .unwrap();
    let galaxy = [([64.3, 63.6], 75.0)];
    let place = [65, 64];
    let clean = exposure(128, &galaxy, [0.0; 2], [0.0; 2]);
    let h = 0.02;
    let shears = [[h, 0.0], [-h, 0.0], [0.0, h], [0.0, -h]];
    let about = place.map(|at| at as f64);
    let moved = shears.map(|g| exposure(128, &galaxy, g, about));
    let values = |image: &Array2<f32>| detector.sums(image.as_slice().unwrap(), 128, place);
    // Sums are linear, so that those of noise are added.
    let clean = values(&clean);
    let moved = moved.map(|image| values(&image));
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut sums = [[0.0; 2]; 4];
    const PAIRS: usize = 6000;
    for _ in 0..PAIRS {
        let noise =
            Array2::from_shape_simple_fn((128, 128), || -> f32 { StandardNormal.sample(&mut rng) });
        let noise = values(&noise);
        let mut of_pair = [[0.0; 2]; 3];
        for sign in [1.0, -1.0] {
            let noisy = |sums: &[f32; KERNELS]| -> [f32; KERNELS] {
                std::array::from_fn(|k| sums[k] + sign * noise[k])
            };
            let at = |sums: &[f32; KERNELS]| detector.pixel(place, &noisy(sums));
            let plain = at(&clean);
            let here = noisy(&clean);
            let (parts, _) = here.as_chunks::<COUNT>();
            let weighted = detector.constants.steps.weighted(&parts[0].map(f64::from));
            for k in 0..2 {
                let of = |g: usize| at(&moved[g]).map_or(0.0, |own| own.e[k]);
                let slope = (of(2 * k) - of(2 * k + 1)) / (2.0 * h);
                let response = plain.map_or(0.0, |own| own.response[k][k]);
                // Without the noise of the response, which the test has to see.
                let raw = weighted.map_or(0.0, |(_, of)| {
                    dot(&of[k].first, &parts[1 + k].map(f64::from))
                });
                for (sum, value) in of_pair
                    .iter_mut()
                    .zip([slope, response - slope, raw - slope])
                {
                    sum[k] += 0.5 * value;
                }
            }
        }
        for k in 0..2 {
            let [slope, off, raw] = of_pair.map(|sum| sum[k]);
            let values = [slope, off, off * off, raw];
            sums.iter_mut()
                .zip(values)
                .for_each(|(sum, value)| sum[k] += value);
        }
    }
    for k in 0..2 {
        let [slope, off, square, raw] = sums.map(|sum| sum[k] / PAIRS as f64);
        let error = ((square - off * off) / PAIRS as f64).sqrt();
        // The slope of differences over 2h has an error of third order, far below 1 %.
        let is_small = off.abs() < 4.0 * error && error < 0.02 * slope;
        assert!(
            is_small && raw.abs() > 10.0 * error,
            "{slope} {off} ± {error} {raw}"
        );
    }
}

#[test]
fn tiles_find_what_all_pixels_have() {
    let settings = DetectionMethod {
        threshold: 5.0,
        ..DetectionMethod::default()
    };
    let detector = Detector::new(star().view(), &StampNoise::white(1.0), None, &settings).unwrap();
    let (width, height) = (450, 480);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut image = Array2::from_shape_simple_fn((height, width), || -> f32 {
        StandardNormal.sample(&mut rng)
    });
    for k in 0..60 {
        let galaxy = exposure(
            60,
            &[([30.3, 29.8], 100.0 + 10.0 * f64::from(k))],
            [0.1, 0.0],
            [30.0; 2],
        );
        let (x, y) = (11 * k as usize % 390, 97 * k as usize % 420);
        let mut part = image.slice_mut(ndarray::s![y..y + 60, x..x + 60]);
        part += &galaxy;
    }
    image[[300, 200]] = f32::NAN;
    let by_tiles = found(&detector, &image);
    let margin = detector.margin();
    let mut all = Vec::new();
    let values = image.as_slice().unwrap();
    for y in margin..height - margin - 1 {
        for x in margin..width - margin - 1 {
            let sums = detector.sums(values, width, [x, y]);
            all.extend(detector.pixel([x, y], &sums));
        }
    }
    assert!(all.len() > 200, "{}", all.len());
    assert_eq!(by_tiles.len(), all.len());
    for (by_tile, own) in by_tiles.iter().zip(&all) {
        assert_eq!(by_tile, own);
    }
    for pixel in &all {
        let [x, y] = pixel.place;
        let off = x.abs_diff(200).max(y.abs_diff(300));
        assert!(off > margin, "{x} {y}");
    }
}

#[test]
fn shapes_are_those_of_the_sky() {
    let settings = DetectionMethod::default();
    let galaxies = [([64.0, 64.0], 2000.0)];
    let image = exposure(128, &galaxies, [0.0; 2], [0.0; 2]);
    let at = |jacobian: Option<[[f64; 2]; 2]>, star: &Array2<f64>, image: &Array2<f32>| {
        let jacobian = jacobian.map(|matrix| Jacobian::new(matrix).unwrap());
        let detector = Detector::new(
            star.view(),
            &StampNoise::white(1.0),
            jacobian.as_ref(),
            &settings,
        )
        .unwrap();
        let sums = detector.sums(image.as_slice().unwrap(), 128, [64, 64]);
        detector.pixel([64, 64], &sums).unwrap()
    };
    let plain = at(None, &star(), &image);
    assert!(plain.e[0] > 0.01 && plain.e[1] > 0.01, "{plain:?}");
    let swapped = image.t().as_standard_layout().into_owned();
    let same = at(
        Some([[0.0, 0.3], [0.3, 0.0]]),
        &star().t().to_owned(),
        &swapped,
    );
    for k in 0..2 {
        // Rounding of single precision.
        close(same.e[k], plain.e[k], 1e-5);
        for g in 0..2 {
            close(same.response[k][g], plain.response[k][g], 1e-5);
        }
    }
    // Pixels that are sheared: the image of the galaxy at J⁻¹ of its places on the sky.
    let matrix = [[1.08, 0.05], [0.03, 0.94]];
    let inverse = shearq_quantities::linear::inverse(matrix);
    let scale = shearq_quantities::linear::determinant(matrix).abs();
    let drawn = |covariance: [f64; 3], side: usize, middle: f64| {
        let covariance = sheared(covariance, inverse);
        Array2::from_shape_fn((side, side), |(y, x)| {
            gaussian(covariance, 1.0, [x as f64 - middle, y as f64 - middle])
        })
    };
    let total = [0, 1, 2].map(|k| scale * (GALAXY[k] + PSF[k]));
    let star = drawn(PSF.map(|value| scale * value), 48, 23.5);
    let image = drawn(total, 128, 64.0).mapv(|value| (2000.0 * value) as f32);
    let on_sky = at(Some(matrix), &star, &image);
    for k in 0..2 {
        // Neighbours are along other axes of the galaxy, and the sampling differs.
        close(on_sky.e[k], plain.e[k], 3e-4);
        for g in 0..2 {
            close(on_sky.response[k][g], plain.response[k][g], 2e-3);
        }
    }
}

#[test]
fn noise_of_an_elliptical_psf_has_no_shape() {
    // Peaks of noise alone, behind a star that is longer along x: deconvolved noise has its power along the star's short axis.
    let star = Array2::from_shape_fn((48, 48), |(y, x)| {
        gaussian([2.9, 2.1, 0.0], 1.0, [x as f64 - 23.5, y as f64 - 23.5])
    });
    let settings = DetectionMethod {
        threshold: 1.5,
        softening: 5.0,
        ..DetectionMethod::default()
    };
    let detector = Detector::new(star.view(), &StampNoise::white(1.0), None, &settings).unwrap();
    let mut without = Detector::new(star.view(), &StampNoise::white(1.0), None, &settings).unwrap();
    without.constants.of_psf = [[0.0; COUNT]; COUNT];
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut sums = [[0.0; 2]; 2];
    const IMAGES: usize = 24;
    for _ in 0..IMAGES {
        let image =
            Array2::from_shape_simple_fn((300, 300), || -> f32 { StandardNormal.sample(&mut rng) });
        for (sums, detector) in sums.iter_mut().zip([&detector, &without]) {
            let sum: f64 = found(detector, &image).iter().map(|own| own.e[0]).sum();
            sums[0] += sum;
            sums[1] += sum * sum;
        }
    }
    let [with, without] = sums.map(|[sum, square]| {
        let mean = sum / IMAGES as f64;
        let variance = square / IMAGES as f64 - mean * mean;
        (mean, (variance / IMAGES as f64).sqrt())
    });
    // The correction is of first order in the star's ellipticity: what it leaves is of second order.
    assert!(without.0.abs() > 8.0 * without.1, "{without:?}");
    assert!(
        with.0.abs() < 3.0 * with.1.max(0.05 * without.0.abs()),
        "{with:?} {without:?}"
    );
}

#[test]
fn round_galaxies_on_sheared_pixels_have_no_mean_shape() {
    // Along x, pixels are 1.2 times as long on the sky as along y.
    let (a, b) = (1.1, 1.0 / 1.1);
    let jacobian = Jacobian::new([[a, 0.0], [0.0, b]]).unwrap();
    let drawn = |square: f64, [x0, y0]: [f64; 2], side: usize| {
        let covariance = [square / (a * a), square / (b * b), 0.0];
        Array2::from_shape_fn((side, side), |(y, x)| {
            gaussian(covariance, 1.0, [x as f64 - x0, y as f64 - y0])
        })
    };
    let star = drawn(3.0, [23.5; 2], 48);
    let settings = DetectionMethod::default();
    let noise = StampNoise::white(1.0);
    let detector = Detector::new(star.view(), &noise, Some(&jacobian), &settings).unwrap();
    let mut sums = [0.0; 3];
    // Phases, whose mean is that over all places. The light of 30σ has no neighbours that are as bright.
    for phase in 0..4 {
        let place = [
            64.0 + 0.25 * f64::from(phase),
            64.0 + 0.25 * f64::from(phase * 3 % 4),
        ];
        let image = drawn(6.0, place, 128).mapv(|value| (600.0 * value) as f32);
        for pixel in found(&detector, &image) {
            sums[0] += pixel.e[0];
            sums[1] += pixel.e[1];
            sums[2] += 0.5 * (pixel.response[0][0] + pixel.response[1][1]);
        }
    }
    // With neighbours on the lattice of pixels it is 0.1. Four axes leave a difference of R11 and R22, but no direction.
    let [e1, e2] = [sums[0] / sums[2], sums[1] / sums[2]];
    assert!(
        sums[2] > 1.0 && e1.abs() < 2e-3 && e2.abs() < 2e-3,
        "{e1} {e2} {sums:?}"
    );
}

#[test]
fn stars_larger_than_their_transform_have_the_same_detections() {
    let noise = StampNoise::white(1.0);
    let settings = DetectionMethod::default();
    let wide = |side: usize| {
        let middle = (side as f64 - 1.0) / 2.0;
        Array2::from_shape_fn((side, side), |(y, x)| {
            gaussian(PSF, 1.0, [x as f64 - middle, y as f64 - middle])
        })
    };
    let image = exposure(128, &PAIR, [0.0; 2], [0.0; 2]);
    let [small, large] = [48, 300].map(|side| {
        let detector = Detector::new(wide(side).view(), &noise, None, &settings).unwrap();
        found(&detector, &image)
    });
    assert!(small.len() > 10 && small.len() == large.len());
    for (small, large) in small.iter().zip(&large) {
        // Rounding.
        close(small.e[0], large.e[0], 1e-6);
        close(small.weight, large.weight, 1e-6);
    }
    for star in [Array2::ones((513, 513)), Array2::ones((48, 50))] {
        assert!(Detector::new(star.view(), &noise, None, &settings).is_err());
    }
}

#[test]
fn functionals_are_the_same_behind_another_star() {
    let detector = without_noise(5.0);
    let ([x0, y0], flux) = PAIR[0];
    let of = |psf: [f64; 3]| {
        let star = Array2::from_shape_fn((48, 48), |(y, x)| {
            gaussian(psf, 1.0, [x as f64 - 23.5, y as f64 - 23.5])
        });
        let total = [0, 1, 2].map(|k| GALAXY[k] + psf[k]);
        let image = Array2::from_shape_fn((128, 128), |(y, x)| {
            gaussian(total, flux, [x as f64 - x0, y as f64 - y0]) as f32
        });
        let detector = detector.behind(&star);
        detector.sums(image.as_slice().unwrap(), 128, [62, 60])
    };
    // Smaller by 10 % and of another shape.
    let (one, other) = (of(PSF), of([2.0, 2.1, -0.1]));
    for (own, found) in one.iter().zip(&other) {
        close(
            f64::from(*own),
            f64::from(*found),
            1e-4 * f64::from(one[LIGHT]),
        );
    }
}
