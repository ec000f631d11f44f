//! Shapes in the frame of the sky do not depend on how the pixels lie there.

#![expect(clippy::unwrap_used, reason = "a test fails by a panic")]

use ndarray::{Array2, Array3, ArrayView2, Axis, stack};
use shearq_measure::{
    ArraySource, Batch, Frame, ImageNoise, Jacobian, KnownNoise, MeasureError, Measurement,
    Measurer, OneThread, Psfs, Shear, ndarray,
};

const N: usize = 48;
const SCALE: f64 = 0.2;

type Matrix = [[f64; 2]; 2];

/// Of squares, with u to the right.
const SQUARE: Matrix = [[SCALE, 0.0], [0.0, SCALE]];
/// Columns to the east, which is mirrored; turned by 37° and mirrored; columns to the north and rows to the west.
const TURNED: [Matrix; 3] = [
    [[-SCALE, 0.0], [0.0, SCALE]],
    [
        [-0.798_635_51 * SCALE, 0.601_815_02 * SCALE],
        [0.601_815_02 * SCALE, 0.798_635_51 * SCALE],
    ],
    [[0.0, SCALE], [SCALE, 0.0]],
];

/// Sheared by 0.05, turned and mirrored, and with a skew of either sign.
const SHEARED: [Matrix; 4] = [
    [[0.02, 0.16], [0.157, -0.01]],
    [[0.21, 0.0], [0.0, 0.19]],
    [[-0.2, 0.02], [0.01, 0.19]],
    [[0.12, -0.16], [0.15, 0.13]],
];

/// A Gaussian of sum one and these moments on the sky in units of pixels, sampled on pixels.
fn gaussian(n: usize, [xx, xy, yy]: [f64; 3], jacobian: Matrix) -> Array2<f64> {
    let scale = Jacobian::new(jacobian).unwrap().pixel_scale();
    let area = xx * yy - xy * xy;
    let middle = (n as f64 - 1.0) / 2.0;
    Array2::from_shape_fn((n, n), |(y, x)| {
        let (x, y) = (x as f64 - middle, y as f64 - middle);
        let [u, v] = jacobian.map(|[along, across]| (along * x + across * y) / scale);
        let square = (yy * u * u - 2.0 * xy * u * v + xx * v * v) / area;
        (-0.5 * square).exp() / (std::f64::consts::TAU * area.sqrt())
    })
}

/// Moments of a circle of variance `variance` under a shear.
fn moments(variance: f64, shear: Shear) -> [f64; 3] {
    let [[a, b], [c, d]] = shear.matrix();
    [
        variance * (a * a + b * b),
        variance * (a * c + b * d),
        variance * (c * c + d * d),
    ]
}

/// Galaxies of different shapes and their common PSF.
fn scene(jacobian: Matrix) -> (Array3<f64>, Array2<f64>) {
    let star = moments(2.2, Shear::new(0.04, -0.03));
    let shapes = [(0.0, 0.0), (0.2, 0.0), (0.0, 0.2), (-0.15, 0.1)];
    let galaxies = shapes.map(|(e1, e2)| {
        let own = moments(6.0, Shear::new(e1, e2));
        1000.0 * gaussian(N, [0, 1, 2].map(|k| own[k] + star[k]), jacobian)
    });
    let views = galaxies.each_ref().map(|galaxy| galaxy.view());
    (
        stack(Axis(0), &views).unwrap(),
        gaussian(40, star, jacobian),
    )
}

/// Without noise, so that no seed depends on pixels.
fn measured(jacobian: Matrix) -> Vec<Measurement> {
    let measurer = Measurer::named("48/linear/star", N).unwrap();
    let (galaxies, star) = scene(jacobian);
    let mut worker = measurer.worker();
    let mut image = worker.image(ImageNoise::Level(0.0));
    image
        .set_jacobian(Some(&Jacobian::new(jacobian).unwrap()))
        .unwrap();
    let mut worker = image.psf(star.view()).unwrap();
    let measure = |galaxy: ArrayView2<'_, f64>| worker.measure(galaxy).unwrap();
    galaxies.outer_iter().map(measure).collect()
}

/// What refers to components of shear, and what does not.
fn quantities(galaxy: &Measurement) -> Vec<f64> {
    let [[r11, r12], [r21, r22]] = galaxy.response.unwrap();
    let observables = galaxy.observables.unwrap();
    let [flux1, flux2] = observables.flux_response.map(|response| response / 1000.0);
    let [size1, size2] = observables.size_response;
    vec![
        galaxy.e1,
        galaxy.e2,
        r11,
        r12,
        r21,
        r22,
        flux1,
        flux2,
        size1,
        size2,
        galaxy.flux / 1000.0,
        galaxy.size,
    ]
}

fn compare(jacobian: Matrix, reference: Matrix, tolerance: f64) {
    for (found, expected) in measured(jacobian).iter().zip(&measured(reference)) {
        let (found, expected) = (quantities(found), quantities(expected));
        for (at, (found, expected)) in found.iter().zip(&expected).enumerate() {
            assert!(
                (found - expected).abs() < tolerance,
                "{jacobian:?}, {at}: {found} {expected}"
            );
        }
    }
}

#[test]
fn turned_and_mirrored_pixels_measure_the_same_sky() {
    // Lags on a square grid give the components different responses, by 2 %.
    for jacobian in TURNED {
        compare(jacobian, SQUARE, 0.03);
    }
}

#[test]
fn sheared_pixels_measure_what_square_ones_would() {
    for jacobian in SHEARED {
        let jacobian_of = Jacobian::new(jacobian).unwrap();
        let (orientation, _) = jacobian_of.factors();
        let square = orientation.matrix();
        compare(jacobian, square, 3e-4);
    }
}

fn batch(measurer: &Measurer, jacobians: Option<Vec<Jacobian>>) -> Result<Batch, MeasureError> {
    let (galaxies, star) = scene(SQUARE);
    let psfs = Psfs::star(star.view());
    let mut source = ArraySource::new(measurer, galaxies.view(), &psfs)?;
    if let Some(jacobians) = jacobians {
        source = source.with_jacobians(jacobians)?;
    }
    measurer.measure_image(&mut source, KnownNoise::Given(0.5), &OneThread)
}

#[test]
fn a_batch_has_the_frame_of_its_jacobians() {
    let measurer = Measurer::named("48/linear/star", N).unwrap();
    let jacobian = |matrix| Jacobian::new(matrix).unwrap();
    let plain = batch(&measurer, None).unwrap();
    assert_eq!(plain.frame, Frame::Pixel);
    let along = batch(&measurer, Some(vec![jacobian(SQUARE)])).unwrap();
    assert_eq!(along.frame, Frame::Sky);
    // One Jacobian per stamp: every other one mirrored.
    let each = [SQUARE, TURNED[0], SQUARE, TURNED[0]].map(jacobian);
    let mixed = batch(&measurer, Some(each.to_vec())).unwrap();
    let mixed = mixed.galaxies.iter().enumerate();
    for ((k, mixed), (plain, along)) in mixed.zip(plain.galaxies.iter().zip(&along.galaxies)) {
        assert_eq!((plain.e1, plain.response), (along.e1, along.response));
        let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
        let (raw, mixed) = ([plain.e1, plain.e2], [mixed.e1, mixed.e2]);
        assert!((mixed[0] - raw[0]).abs() < 1e-12, "{k}: {mixed:?} {raw:?}");
        assert!(
            (mixed[1] - sign * raw[1]).abs() < 1e-12,
            "{k}: {mixed:?} {raw:?}"
        );
    }
    let error = batch(&measurer, Some(vec![jacobian(SQUARE); 3])).unwrap_err();
    assert!(error.to_string().contains("3 values"), "{error}");
}

#[test]
fn pixels_that_a_method_cannot_use_are_refused() {
    let sheared = |g: f64| {
        let matrix = [[SCALE * (1.0 + g), 0.0], [0.0, SCALE * (1.0 - g)]];
        Some(vec![Jacobian::new(matrix).unwrap()])
    };
    let linear = Measurer::named("48/linear/star", N).unwrap();
    assert!(batch(&linear, sheared(0.15)).is_ok());
    let error = batch(&linear, sheared(0.25)).unwrap_err();
    assert!(error.to_string().contains("sheared by 2.50e-1"), "{error}");
    let network = Measurer::named("23/raw/star", N).unwrap();
    assert!(batch(&network, sheared(5e-4)).is_ok());
    let error = batch(&network, sheared(0.01)).unwrap_err();
    assert!(error.to_string().contains("48/linear/star"), "{error}");
}
