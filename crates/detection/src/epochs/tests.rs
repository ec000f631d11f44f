//! Epochs against one exposure, and against differences of sheared skies.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_quantities::linear::{apply, product};

use ndarray::Array2;
use shearq_measure::{MeasureError, StampNoise};
use shearq_quantities::linear::Matrix2;
use shearq_submissions::DetectionMethod;

use super::place::BlockMap;
use super::plan::EpochFunctionals;
use super::tile::Half;
use super::*;
use crate::detector::Constants;
use crate::functionals::{Covariances, KERNELS};
use crate::pixel::DetectedPixel;
use crate::testing::close;
use crate::weight::{COUNT, LIGHT};

const SIDE: usize = 150;
const GALAXIES: [([f64; 2], f64); 3] = [
    ([60.2, 61.7], 900.0),
    ([65.1, 63.9], 500.0),
    ([95.4, 88.8], 700.0),
];
/// Covariances (xx, yy, xy) in px².
const GALAXY: [f64; 3] = [4.0, 3.0, 0.6];

/// Its place of p is matrix · p + shift, in pixels from 0.
#[derive(Clone, Copy)]
struct TestEpoch {
    matrix: Matrix2,
    shift: [f64; 2],
    /// Covariance of the PSF in pixels of the first exposure.
    psf: [f64; 3],
    noise: f64,
}

const FIRST: TestEpoch = TestEpoch {
    matrix: [[1.0, 0.0], [0.0, 1.0]],
    shift: [0.0; 2],
    psf: [2.6, 2.2, 0.2],
    noise: 1.0,
};

/// Rotated by 0.5 rad, with pixels of 0.9 and 1.1 times the scale, and mirrored; dithered.
fn others() -> [TestEpoch; 3] {
    let (sine, cosine) = 0.5f64.sin_cos();
    let turned = [[cosine, -sine], [sine, cosine]];
    [
        TestEpoch {
            matrix: turned,
            shift: [70.3, -20.6],
            psf: [2.4, 2.9, -0.1],
            noise: 1.0,
        },
        TestEpoch {
            matrix: product([[1.1, 0.0], [0.0, 1.1]], turned),
            shift: [71.3, -21.6],
            psf: [3.4, 2.9, -0.1],
            noise: 1.3,
        },
        TestEpoch {
            matrix: [[-0.9, 0.0], [0.0, 0.9]],
            shift: [150.37, 10.81],
            psf: [3.0, 2.7, 0.3],
            noise: 0.8,
        },
    ]
}

fn gaussian([xx, yy, xy]: [f64; 3], [x, y]: [f64; 2]) -> f64 {
    let determinant = xx * yy - xy * xy;
    let exponent = -0.5 * (x * x * yy + y * y * xx - 2.0 * x * y * xy) / determinant;
    exponent.exp() / (std::f64::consts::TAU * determinant.sqrt())
}

fn turned([xx, yy, xy]: [f64; 3], [[a, b], [c, d]]: Matrix2) -> [f64; 3] {
    [
        a * a * xx + 2.0 * a * b * xy + b * b * yy,
        c * c * xx + 2.0 * c * d * xy + d * d * yy,
        a * c * xx + (a * d + b * c) * xy + b * d * yy,
    ]
}

impl TestEpoch {
    fn place(&self, at: [f64; 2]) -> [f64; 2] {
        let at = apply(self.matrix, at);
        [0, 1].map(|k| at[k] + self.shift[k])
    }

    fn star(&self) -> Array2<f64> {
        let psf = turned(self.psf, self.matrix);
        Array2::from_shape_fn((48, 48), |(y, x)| {
            gaussian(psf, [x as f64 - 23.5, y as f64 - 23.5])
        })
    }

    /// The galaxies under a shear about a place.
    fn image(&self, g: [f64; 2], about: [f64; 2]) -> Array2<f32> {
        let shear = [[1.0 + g[0], g[1]], [g[1], 1.0 - g[0]]];
        let of_galaxy = turned(GALAXY, shear);
        let total = turned([0, 1, 2].map(|k| of_galaxy[k] + self.psf[k]), self.matrix);
        let mut image = Array2::<f64>::zeros((SIDE + 30, SIDE + 20));
        for (place, flux) in GALAXIES {
            let offset = apply(shear, [0, 1].map(|k| place[k] - about[k]));
            let [x0, y0] = self.place([0, 1].map(|k| about[k] + offset[k]));
            for ((y, x), value) in image.indexed_iter_mut() {
                *value += flux * gaussian(total, [x as f64 - x0, y as f64 - y0]);
            }
        }
        image.mapv(|value| value as f32)
    }

    fn noise(&self, rng: &mut ChaCha8Rng) -> Array2<f32> {
        Array2::from_shape_simple_fn((SIDE + 30, SIDE + 20), || {
            let value: f64 = StandardNormal.sample(rng);
            (self.noise * value) as f32
        })
    }
}

fn cells(epochs: &[TestEpoch], settings: &DetectionMethod) -> EpochCells {
    let epoch = |own: &TestEpoch| {
        let own = *own;
        Epoch {
            sides: [SIDE + 20, SIDE + 30],
            noise: StampNoise::white(own.noise),
            stars: Box::new(move |places| Ok(vec![own.star(); places.len()])),
            is_constant: true,
            fault: Box::new(|error| error),
            places: Box::new(move |places| {
                let place = |at: &[f64; 2]| own.place(at.map(|at| at - 1.0)).map(|at| at + 1.0);
                Ok(places.iter().map(|at| Some(place(at))).collect())
            }),
        }
    };
    EpochCells::new::<MeasureError>(epochs.iter().map(epoch).collect(), None, settings).unwrap()
}

/// The patches of a tile with their pixels.
fn read(cells: &EpochCells, images: &[Array2<f32>], tile: [usize; 2]) -> Vec<(Patch, Vec<f32>)> {
    let with_pixels = |patch: Patch| {
        let image = &images[patch.epoch];
        let pixel = |at: usize| {
            let [x, y] = [at % patch.side, at / patch.side].map(|at| at as i64);
            let [x, y] = [x + patch.origin[0], y + patch.origin[1]].map(usize::try_from);
            let (Ok(x), Ok(y)) = (x, y) else {
                return f32::NAN;
            };
            image.get([y, x]).copied().unwrap_or(f32::NAN)
        };
        (patch, (0..patch.side * patch.side).map(pixel).collect())
    };
    cells.patches(tile).into_iter().map(with_pixels).collect()
}

/// Pixels with a weight.
fn found(cells: &EpochCells, images: &[Array2<f32>]) -> Vec<DetectedPixel> {
    let (mut scratch, mut found) = (cells.scratch(), Vec::new());
    let [columns, rows] = cells.tiles();
    for tile in (0..rows).flat_map(|y| (0..columns).map(move |x| [x, y])) {
        let mut patches = read(cells, images, tile);
        let detector = cells.detector(0);
        cells.detect(&detector, tile, &mut patches, &mut scratch, &mut found);
    }
    found.sort_by_key(|pixel| [pixel.place[1], pixel.place[0]]);
    found
}

/// All functionals of an epoch at a pixel of the upper half of the first tile, whose patches are given.
fn sums(
    cells: &EpochCells,
    detector: &EpochDetector,
    patches: &[(Patch, Vec<f32>)],
    epoch: usize,
    [x, y]: [usize; 2],
) -> [f32; KERNELS] {
    let (patch, pixels) = &patches[epoch];
    assert_eq!((patch.epoch, patch.half), (epoch, 0));
    let half = Half {
        at: epoch,
        plan: &cells.epochs[epoch],
        own: detector.0[epoch].as_ref().unwrap(),
        map: patch.map,
        pixels,
        light: &[],
        covered: &[],
    };
    let place = BlockMap::at(&patch.map.row(y as f64), x as f64);
    half.sums(place, &mut Default::default())
}

fn with_others() -> Vec<TestEpoch> {
    std::iter::once(FIRST).chain(others()).collect()
}

#[test]
fn functionals_of_rotated_and_dithered_epochs_are_those_of_the_first() {
    let epochs = with_others();
    let cells = cells(&epochs, &DetectionMethod::default());
    let images: Vec<Array2<f32>> = epochs
        .iter()
        .map(|own| own.image([0.0; 2], [0.0; 2]))
        .collect();
    let detector = cells.detector(0);
    let patches = read(&cells, &images, [0, 0]);
    let light = sums(&cells, &detector, &patches, 0, [60, 62])[LIGHT];
    for place in [[60, 62], [63, 60], [55, 70], [94, 90]] {
        let first = sums(&cells, &detector, &patches, 0, place);
        for epoch in 1..epochs.len() {
            let own = sums(&cells, &detector, &patches, epoch, place);
            for k in 0..KERNELS {
                // Changes also differ by what the rotated square of an epoch leaves out.
                let most = if k < COUNT { 3e-5 } else { 2e-4 };
                close(own[k], first[k], most * light);
            }
        }
    }
}

#[test]
fn two_epochs_are_one_exposure_of_less_noise() {
    let settings = DetectionMethod::default();
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let second = TestEpoch {
        psf: FIRST.psf,
        shift: [13.0, -7.0],
        ..FIRST
    };
    let signal = FIRST.image([0.0; 2], [0.0; 2]);
    let one = &signal + &FIRST.noise(&mut rng);
    let (dy, dx) = (-7i64, 13i64);
    let mut moved = second.image([0.0; 2], [0.0; 2]) + second.noise(&mut rng);
    let mut mean = one.clone();
    for ((y, x), value) in mean.indexed_iter_mut() {
        let at = [y as i64 + dy, x as i64 + dx].map(usize::try_from);
        let [Ok(y), Ok(x)] = at else {
            *value = f32::NAN;
            continue;
        };
        *value = moved
            .get([y, x])
            .map_or(f32::NAN, |own| 0.5 * (*value + own));
    }
    // Where the second epoch ends, the first one is alone.
    moved[[40, 150]] = f32::NAN;
    mean[[47, 137]] = f32::NAN;
    let both = cells(&[FIRST, second], &settings);
    let both = found(&both, &[one, moved]);
    let quiet = TestEpoch {
        noise: 0.5f64.sqrt(),
        ..FIRST
    };
    let alone = found(&cells(&[quiet], &settings), &[mean]);
    assert!(alone.len() > 20, "{}", alone.len());
    for own in &alone {
        let same = both.iter().find(|other| other.place == own.place).unwrap();
        // Rounding of the sums.
        close(same.weight, own.weight, 1e-4);
        close(same.snr, own.snr, 1e-4 * own.snr);
        for k in 0..2 {
            close(same.e[k], own.e[k], 1e-4);
            for g in 0..2 {
                close(same.response[k][g], own.response[k][g], 1e-3);
            }
        }
    }
}

#[test]
fn a_pixel_that_is_missing_in_one_epoch_is_that_of_the_others() {
    let settings = DetectionMethod::default();
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let epochs = with_others();
    let cells = cells(&epochs, &settings);
    let images = epochs
        .iter()
        .map(|own| own.image([0.0; 2], [0.0; 2]) + own.noise(&mut rng));
    let mut images: Vec<Array2<f32>> = images.collect();
    let all = found(&cells, &images);
    images[0][[62, 60]] = f32::NAN;
    let masked = found(&cells, &images);
    let gone = Array2::from_elem(images[0].dim(), f32::NAN);
    let without = found(&cells, &[&[gone], &images[1..]].concat());
    let reach = cells.epochs[0].radius;
    let (mut near, mut far) = (0, 0);
    for own in &masked {
        let is_near = own.place[0].abs_diff(60).max(own.place[1].abs_diff(62)) < reach;
        let expected = if is_near { &without } else { &all };
        *(if is_near { &mut near } else { &mut far }) += 1;
        assert!(expected.contains(own), "{own:?}");
    }
    assert!(near > 10 && far > 5, "{near} {far}");
    // Beyond all epochs, nothing is detected.
    for image in &mut images {
        image.fill(f32::NAN);
    }
    assert_eq!(found(&cells, &images), []);
}

#[test]
fn covariances_are_those_of_noise() {
    let own = others()[1];
    let cells = cells(&[FIRST, own], &DetectionMethod::default());
    let detector = cells.detector(0);
    let blank = Array2::zeros((SIDE + 30, SIDE + 20));
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut sums = [[0.0; COUNT]; KERNELS];
    let mut count = 0.0;
    for _ in 0..160 {
        let images = [blank.clone(), own.noise(&mut rng)];
        let patches = read(&cells, &images, [0, 0]);
        for place in [[40, 60], [80, 60], [60, 95], [95, 95]] {
            let found = self::sums(&cells, &detector, &patches, 1, place);
            assert!(found.iter().all(|own| own.is_finite()));
            count += 1.0;
            for (a, sums) in sums.iter_mut().enumerate() {
                for (b, sum) in sums.iter_mut().enumerate() {
                    *sum += f64::from(found[a]) * f64::from(found[b]);
                }
            }
        }
    }
    let expected = &detector.0[1].as_ref().unwrap().functionals.covariances;
    // Five standard deviations.
    let error = 5.0 * (2.0f64 / count).sqrt();
    for (a, b) in (0..COUNT).flat_map(|a| (0..COUNT).map(move |b| (a, b))) {
        let scale = (expected.plain[a][a] * expected.plain[b][b]).sqrt();
        let mean = |k: usize| sums[COUNT * k + a][b] / count;
        close(mean(0), expected.plain[a][b], error * scale);
        for g in 0..2 {
            close(mean(1 + g), expected.sheared[g][a][b], 2.0 * error * scale);
        }
    }
}

#[test]
fn responses_are_those_of_a_sheared_sky() {
    let epochs = [FIRST, others()[1]].map(|own| TestEpoch { noise: 1e-6, ..own });
    let settings = DetectionMethod::default();
    let noise = cells(&epochs, &settings).detector(0);
    let weight: f64 = noise.0.iter().flatten().map(|own| own.weight).sum();
    let threshold = 9.0 * weight.sqrt();
    let settings = DetectionMethod {
        threshold,
        threshold_half_width: 0.3 * threshold,
        softening: 1e6,
        ..settings
    };
    let cells = cells(&epochs, &settings);
    let at = |g: [f64; 2], about: [f64; 2]| {
        let images = epochs.each_ref().map(|own| own.image(g, about));
        found(&cells, &images)
    };
    let plain = at([0.0; 2], [0.0; 2]);
    let responses = plain.iter().flat_map(|own| own.response.concat());
    let largest = responses.fold(0.0f64, |a, b| a.max(b.abs()));
    assert!(
        plain.len() > 20 && largest > 0.1,
        "{} {largest}",
        plain.len()
    );
    let h = 1e-3;
    for pixel in plain.iter().step_by(5) {
        let about = pixel.place.map(|at| at as f64);
        for g in 0..2 {
            let e = [h, -h].map(|h| {
                let mut shear = [0.0; 2];
                shear[g] = h;
                let found = at(shear, about);
                let own = found.iter().find(|own| own.place == pixel.place);
                own.map_or([0.0; 2], |own| own.e)
            });
            for (k, (plus, minus)) in e[0].iter().zip(e[1]).enumerate() {
                // Rounding of the sums over 2h, terms of third order, and interpolation.
                close(
                    pixel.response[k][g],
                    (plus - minus) / (2.0 * h),
                    4e-3 * largest,
                );
            }
        }
    }
}

#[test]
fn all_pixels_with_a_weight_are_found() {
    let epochs = with_others();
    let settings = DetectionMethod {
        threshold: 5.0,
        ..DetectionMethod::default()
    };
    let cells = cells(&epochs, &settings);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let images = epochs
        .iter()
        .map(|own| own.image([0.0; 2], [0.0; 2]) + own.noise(&mut rng));
    let images: Vec<Array2<f32>> = images.collect();
    let by_tiles = found(&cells, &images);
    let detector = cells.detector(0);
    let parts: Vec<&EpochFunctionals> = detector.0.iter().flatten().collect();
    let total: f64 = parts.iter().map(|own| own.weight).sum();
    let of_sum = parts
        .iter()
        .map(|own| (own.weight / total, &own.functionals.covariances));
    let constants = Constants::new(&Covariances::of_sum(of_sum), &settings);
    let patches = read(&cells, &images, [0, 0]);
    let mut all = Vec::new();
    // Inside of all epochs.
    for (y, x) in (58..92).flat_map(|y| (50..100).map(move |x| (y, x))) {
        let mut values = [[0.0; COUNT]; 3];
        for (epoch, own) in parts.iter().enumerate() {
            let sums = sums(&cells, &detector, &patches, epoch, [x, y]);
            for (value, sum) in values.as_flattened_mut().iter_mut().zip(sums) {
                *value += own.weight / total * f64::from(sum);
            }
        }
        all.extend(cells.shared.shared.pixel([x, y], &values, &constants));
    }
    assert!(all.len() > 20, "{}", all.len());
    for own in &all {
        assert!(by_tiles.contains(own), "{own:?}");
    }
}
