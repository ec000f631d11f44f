//! Several stamps of a galaxy, combined before its shape is measured.

#![expect(clippy::unwrap_used, reason = "a test fails by a panic")]

use ndarray::{Array2, ArrayView2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_measure::{
    Epoch, EpochError, Flag, ImageNoise, Jacobian, MeasureError, Measurement, Measurer, ndarray,
};

const N: usize = 48;
const SQUARE: [[f64; 2]; 2] = [[0.2, 0.0], [0.0, 0.2]];

/// A Gaussian of sum one and moments (xx, xy, yy) in arcsec² at an offset in pixels, on pixels of a Jacobian.
fn gaussian(
    n: usize,
    [xx, xy, yy]: [f64; 3],
    jacobian: [[f64; 2]; 2],
    offset: [f64; 2],
) -> Array2<f64> {
    let area = xx * yy - xy * xy;
    let pixel = Jacobian::new(jacobian).unwrap().pixel_scale().powi(2);
    let middle = (n as f64 - 1.0) / 2.0;
    Array2::from_shape_fn((n, n), |(y, x)| {
        let (x, y) = (x as f64 - middle - offset[0], y as f64 - middle - offset[1]);
        let [u, v] = jacobian.map(|[along, across]| along * x + across * y);
        let square = (yy * u * u - 2.0 * xy * u * v + xx * v * v) / area;
        pixel * (-0.5 * square).exp() / (std::f64::consts::TAU * area.sqrt())
    })
}

fn noise(rng: &mut ChaCha8Rng, level: f64) -> Array2<f64> {
    let half = level * 3f64.sqrt();
    Array2::from_shape_fn((N, N), |_| rng.random_range(-half..half))
}

fn epoch<'a>(stamp: &'a Array2<f64>, psf: &'a Array2<f64>, noise: f64) -> Epoch<'a, f64> {
    Epoch {
        stamp: stamp.view(),
        psf: psf.view(),
        noise,
        jacobian: None,
        offset: [0.0; 2],
        survey: None,
        gain: None,
    }
}

fn measured(epochs: &[Epoch<'_, f64>]) -> Result<Measurement, MeasureError> {
    let measurer = Measurer::named("48/linear/star", N).unwrap();
    let mut worker = measurer.worker();
    worker.image(ImageNoise::Unknown).measure_epochs(epochs)
}

fn numbers(found: &Measurement) -> [f64; 8] {
    let [[r11, r12], [r21, r22]] = found.response.unwrap();
    [
        found.e1,
        found.e2,
        r11,
        r12,
        r21,
        r22,
        found.flux / 1e3,
        found.size / 10.0,
    ]
}

fn close(found: &Measurement, expected: &Measurement, tolerance: f64) {
    let (found, expected) = (numbers(found), numbers(expected));
    for (at, (found, expected)) in found.iter().zip(&expected).enumerate() {
        assert!(
            (found - expected).abs() < tolerance,
            "{at}: {found} {expected}"
        );
    }
}

fn scene() -> (Array2<f64>, Array2<f64>) {
    let galaxy = gaussian(N, [0.36, 0.04, 0.28], SQUARE, [0.0; 2]) * 1000.0;
    (galaxy, gaussian(32, [0.09, -0.004, 0.08], SQUARE, [0.0; 2]))
}

#[test]
fn one_epoch_has_the_bits_of_one_stamp() {
    let (galaxy, psf) = scene();
    let stamp = galaxy + noise(&mut ChaCha8Rng::seed_from_u64(1), 0.5);
    let found = measured(&[epoch(&stamp, &psf, 0.5)]).unwrap();
    let measurer = Measurer::named("48/linear/star", N).unwrap();
    let mut worker = measurer.worker();
    let mut image = worker.image(ImageNoise::Level(0.5));
    let alone = image
        .psf(psf.view())
        .unwrap()
        .measure(stamp.view())
        .unwrap();
    assert_eq!(numbers(&found), numbers(&alone));
    assert_eq!(found.noise, alone.noise);
    // An epoch without pixels counts for nothing.
    let empty = Array2::zeros((N, N));
    let both = measured(&[epoch(&empty, &psf, 0.1), epoch(&stamp, &psf, 0.5)]).unwrap();
    close(&both, &alone, 1e-4);
}

#[test]
fn equal_epochs_measure_as_their_mean() {
    let (galaxy, psf) = scene();
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    // So bright that the noise terms, which one galaxy in eight has for all eight, are far below the tolerance.
    for _ in 0..20 {
        let stamps: Vec<_> = (0..4).map(|_| &galaxy + &noise(&mut rng, 0.4)).collect();
        let mean = stamps
            .iter()
            .fold(Array2::zeros((N, N)), |sum, stamp| sum + stamp)
            / 4.0;
        let epochs: Vec<_> = stamps.iter().map(|stamp| epoch(stamp, &psf, 0.4)).collect();
        let found = measured(&epochs).unwrap();
        assert!((found.noise - 0.2).abs() < 1e-12);
        close(&found, &measured(&[epoch(&mean, &psf, 0.2)]).unwrap(), 1e-4);
    }
}

#[test]
fn turned_and_dithered_epochs_agree_on_the_sky() {
    let (cos, sin) = (0.2 * 0.8, 0.2 * 0.6);
    let frames = [
        (SQUARE, [0.0; 2]),
        ([[cos, -sin], [sin, cos]], [0.4, -0.3]),
        ([[-sin, 1.04 * cos], [cos / 1.04, sin]], [-0.2, 3.1]),
        // Larger pixels.
        ([[0.25, 0.0], [0.0, 0.25]], [0.1, 0.2]),
    ];
    // Large enough for light at the edges, and not round.
    let (own, star) = ([1.3, 0.2, 1.0], [0.09, -0.01, 0.08]);
    let scenes = frames.map(|(jacobian, offset)| {
        let stamp = gaussian(N, [0, 1, 2].map(|k| own[k] + star[k]), jacobian, offset);
        (stamp * 1000.0, gaussian(32, star, jacobian, [0.0; 2]))
    });
    let each: Vec<_> = scenes
        .iter()
        .zip(frames)
        .map(|((stamp, psf), (jacobian, offset))| Epoch {
            jacobian: Some(Jacobian::new(jacobian).unwrap()),
            offset,
            ..epoch(stamp, psf, 1e-3)
        })
        .collect();
    let one = measured(&each[..1]).unwrap();
    close(&measured(&each).unwrap(), &one, 5e-3);
    for other in 1..3 {
        close(&measured(&[each[0], each[other]]).unwrap(), &one, 2e-3);
        // Lags lie along the first pixels, and responses differ by 1 % along a square grid and across it.
        close(&measured(&[each[other], each[0]]).unwrap(), &one, 2e-2);
    }
}

#[test]
fn deeper_epochs_count_more() {
    let (galaxy, psf) = scene();
    let wide = gaussian(32, [0.16, 0.0, 0.16], SQUARE, [0.0; 2]);
    let broad = gaussian(N, [0.43, 0.044, 0.36], SQUARE, [0.0; 2]) * 1000.0;
    let sharp = measured(&[epoch(&galaxy, &psf, 0.1)]).unwrap();
    // The same galaxy behind another PSF.
    let both = measured(&[epoch(&galaxy, &psf, 0.1), epoch(&broad, &wide, 0.1)]).unwrap();
    assert!((both.e1 - sharp.e1).abs() < 2e-3 && (both.e2 - sharp.e2).abs() < 2e-3);
    // A stamp of nothing but noise dilutes the flux by its weight.
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let nothing = noise(&mut rng, 3.0);
    let diluted = measured(&[epoch(&galaxy, &psf, 1.0), epoch(&nothing, &psf, 3.0)]).unwrap();
    let share = diluted.flux / measured(&[epoch(&galaxy, &psf, 1.0)]).unwrap().flux;
    assert!((share - 0.9).abs() < 0.03, "{share}");
}

#[test]
fn epochs_on_pixels_of_other_sizes_have_the_psf_of_the_first() {
    let (own, star) = ([0.3, 0.05, 0.25], [0.09, -0.01, 0.08]);
    let scenes = [1.0, 0.5, 1.6].map(|size| {
        let jacobian = SQUARE.map(|row| row.map(|value| size * value));
        let stamp = gaussian(N, [0, 1, 2].map(|k| own[k] + star[k]), jacobian, [0.0; 2]) * 1000.0;
        (
            jacobian,
            stamp,
            gaussian(32, star, jacobian, [0.0; 2]),
            size,
        )
    });
    let each = scenes.each_ref().map(|(jacobian, stamp, psf, size)| Epoch {
        jacobian: Some(Jacobian::new(*jacobian).unwrap()),
        // Of equal weights.
        ..epoch(stamp, psf, 1e-3 * size)
    });
    let one = measured(&each[..1]).unwrap();
    for other in &each[1..] {
        let both = measured(&[each[0], *other]).unwrap();
        // Samples of another distance, and lags on another lattice.
        close(&both, &one, 2e-2);
        let sigma = (star[0] * star[2] - star[1] * star[1]).powf(0.25) / 0.2;
        assert!(
            (both.psf.sigma() / sigma - 1.0).abs() < 5e-3,
            "{:?}",
            both.psf
        );
    }
}

#[test]
fn photons_of_epochs_add_up() {
    let (galaxy, psf) = scene();
    let of = |levels: &[(f64, f64)]| {
        let each = levels.iter().map(|&(noise, gain)| Epoch {
            gain: Some(gain),
            ..epoch(&galaxy, &psf, noise)
        });
        let found = measured(&each.collect::<Vec<_>>()).unwrap();
        found.observables.unwrap().flux_error
    };
    // Two equal exposures are one of twice the electrons.
    let twice = of(&[(0.5f64.sqrt(), 1.0)]);
    assert!((of(&[(1.0, 0.5), (1.0, 0.5)]) / twice - 1.0).abs() < 1e-6);
    // Exposures with weights of 0.8 and 0.2: their sum has the variance 0.8²/0.5 + 0.2²/2 per unit of light.
    let sum = of(&[(0.8f64.sqrt() * 0.5, 1.0 / (0.64 / 0.5 + 0.04 / 2.0))]);
    assert!((of(&[(0.5, 0.5), (1.0, 2.0)]) / sum - 1.0).abs() < 1e-6);
    // The light matters: without it the error is that of the sky.
    let sky = measured(&[epoch(&galaxy, &psf, 0.5f64.sqrt())]).unwrap();
    assert!(twice > 1.1 * sky.observables.unwrap().flux_error);
}

#[test]
fn wrong_epochs_are_typed_errors() {
    let (galaxy, psf) = scene();
    let good = epoch(&galaxy, &psf, 1.0);
    let error = |epochs: &[Epoch<'_, f64>]| match measured(epochs) {
        Err(MeasureError::Epochs(error)) => error,
        other => panic!("{other:?}"),
    };
    assert_eq!(error(&[]), EpochError::None);
    let silent = Epoch { noise: 0.0, ..good };
    let expected = EpochError::Noise {
        epoch: 1,
        noise: 0.0,
    };
    assert_eq!(error(&[good, silent]), expected);
    let far = Epoch {
        offset: [0.0, 13.0],
        ..good
    };
    assert!(matches!(error(&[far]), EpochError::Offset { epoch: 0, .. }));
    let sky = Epoch {
        jacobian: Some(Jacobian::new(SQUARE).unwrap()),
        ..good
    };
    assert_eq!(error(&[good, sky]), EpochError::Frames);
    let small: ArrayView2<'_, f64> = galaxy.slice(ndarray::s![1.., 1..]);
    let small = Epoch {
        stamp: small,
        ..good
    };
    assert!(matches!(
        measured(&[good, small]),
        Err(MeasureError::Shape { .. })
    ));
    let network = Measurer::named("23/raw/star", N).unwrap();
    let found = network
        .worker()
        .image(ImageNoise::Unknown)
        .measure_epochs(&[good]);
    assert!(matches!(
        found,
        Err(MeasureError::Epochs(EpochError::Network))
    ));
    let dark = Array2::zeros((N, N));
    let dark = [epoch(&dark, &psf, 1.0); 2];
    assert!(measured(&dark).unwrap().flags.contains(Flag::NoScale));
}
