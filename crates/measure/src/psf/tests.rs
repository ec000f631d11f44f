//! Stars that are cut, averaged and stacked, their widths and shapes, and warnings about them.

use ndarray::Array3;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_quantities::PsfProfile;

use super::*;
use crate::testing::close;

/// A star of sum one on a stamp of `side` pixels.
pub(super) fn drawn(profile: PsfProfile, fwhm: f64, shear: Shear, side: usize) -> Array2<f64> {
    FunctionalPsf::new(profile, fwhm, shear)
        .unwrap()
        .stamp(side)
}

/// The star with white noise, again of sum one.
pub(super) fn noisy(psf: &Array2<f64>, snr: f64, rng: &mut ChaCha8Rng) -> Array2<f64> {
    let sigma = psf.iter().map(|v| v * v).sum::<f64>().sqrt() / snr;
    let star = psf.mapv(|value| {
        let noise: f64 = StandardNormal.sample(rng);
        value + sigma * noise
    });
    let sum = star.sum();
    star / sum
}

/// Power of the transform at wave vector (kx, ky), in units of the square of the light.
pub(super) fn power(psf: ArrayView2<'_, f64>, [kx, ky]: [f64; 2]) -> f64 {
    let (mut re, mut im) = (0.0, 0.0);
    for ((y, x), value) in psf.indexed_iter() {
        let phase = kx * x as f64 + ky * y as f64;
        re += value * phase.cos();
        im += value * phase.sin();
    }
    (re * re + im * im) / psf.sum().powi(2)
}

#[test]
fn noisy_stars_off_the_centre_average_to_the_psf() {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.05, -0.03)).unwrap();
    let expected = psf.stamp(48);
    let cut = limits(48, 32, false);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for (snr, count, tolerance) in [(f64::INFINITY, 5, 2e-4), (200.0, 64, 4e-3)] {
        let mut stars = Array3::zeros((count, 48, 48));
        for (k, mut star) in stars.outer_iter_mut().enumerate() {
            let (dx, dy) = (0.37 * (k % 5) as f64 - 0.8, 0.29 - 0.2 * (k % 3) as f64);
            psf.draw_into(23.5 + dx, 23.5 + dy, star.view_mut());
            let noisy = noisy(&star.to_owned(), snr, &mut rng);
            // Of any flux.
            star.assign(&(noisy * (k + 1) as f64));
        }
        let found = average_stars(stars.view(), cut).unwrap();
        let peak = expected[(24, 24)];
        let worst = found.indexed_iter().map(|(at, value)| {
            let start = (48 - found.nrows()) / 2;
            (value - expected[(at.0 + start, at.1 + start)]).abs() / peak
        });
        // Noise of 1/200/√64 of √(Σ p²), which is 2.5 peaks, at four standard deviations.
        let worst = worst.fold(0.0, f64::max);
        assert!(worst < 2.5 * tolerance, "{snr}: {worst}");
    }
}

#[test]
fn a_star_that_cannot_be_averaged_is_named() {
    let mut stars = Array3::zeros((2, 32, 32));
    stars.slice_mut(s![0, 15..17, 15..17]).fill(1.0);
    let cut = limits(32, 32, false);
    let (number, error) = average_stars(stars.view(), cut).unwrap_err();
    assert_eq!(number, 2);
    assert!(error.to_string().contains("sum to 0"), "{error}");
}

fn moffat(fwhm: f64) -> FunctionalPsf {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    FunctionalPsf::new(profile, fwhm, Shear::new(0.05, -0.03)).unwrap()
}

fn limits(size: usize, least: usize, centred: bool) -> PsfCut {
    PsfCut {
        size,
        least,
        centred,
    }
}

fn cut<P: Pixel>(stamp: ArrayView2<'_, P>, cut: impl Into<PsfCut>) -> Array2<f64> {
    Star::cut(stamp, cut).unwrap().psf
}

#[test]
fn a_functional_psf_is_where_the_cut_of_a_star_is() {
    let psf = moffat(2.9);
    for (side, size) in [(48, 15), (48, 24), (33, 24), (33, 15)] {
        let cut = cut(psf.stamp(side).view(), size);
        for (a, b) in cut.iter().zip(&psf.stamp_beside(size, side)) {
            // Either is drawn to 1e-6 of the brightest pixel, which is below a tenth.
            assert!((a - b).abs() < 2e-7, "{side}, {size}: {a} {b}");
        }
    }
}

#[test]
fn small_star_stamps_keep_their_centre() {
    let sides = limits(48, 32, false);
    let stamp = moffat(3.4).stamp(64);
    for (given, expected) in [(32, 32), (37, 36), (48, 48), (64, 48)] {
        let from = cut_start(64, given).unwrap();
        let star = stamp.slice(s![from..from + given, from..from + given]);
        let taken = cut(star, sides);
        assert_eq!(taken.dim(), (expected, expected), "{given}");
        assert!((taken.sum() - 1.0).abs() < 1e-12);
        // Where the parity is another, half a pixel early.
        let early = given % 2;
        let middle = expected / 2;
        let found = taken[(middle - 3, middle + 5)] / taken[(middle, middle)];
        let at = |y: usize, x: usize| stamp[(y - early, x - early)];
        let expected = at(29, 37) / at(32, 32);
        assert!((found - expected).abs() < 1e-12, "{given}");
    }
    assert!(Star::cut(stamp.slice(s![..31, ..31]), sides).is_err());
}

#[test]
fn stacked_stars_are_at_the_place_of_the_first() {
    let psf = moffat(3.4);
    let star = psf.stamp(48);
    let moved = |dx: f64, dy: f64| {
        let along = |offset: f64| fourier_shift(48, 48, -offset);
        3.0 * along(dy).dot(&star).dot(&along(dx).t())
    };
    let others = [moved(0.4, -0.9), moved(-0.25, 0.1)];
    let all = [star.view(), others[0].view(), others[1].view()];
    let stack = Star::stack(all).unwrap() / 3.0;
    let light = star.sum();
    for (found, expected) in stack.iter().zip(&star) {
        // Centroids are found to 10⁻³ px.
        close(*found, expected / light, 1e-4);
    }
    assert!(Star::stack([star.view(), star.slice(s![1.., 1..])]).is_err());
    assert!(Star::stack(std::iter::empty::<ArrayView2<'_, f64>>()).is_err());
}

#[test]
fn unusable_stars_are_refused_with_the_reason() {
    let mut stamp = Array2::<f32>::zeros((9, 9));
    let refused = |stamp: &Array2<f32>, size: usize, expected: &str| {
        let message = Star::cut(stamp.view(), size).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    };
    refused(&stamp, 5, "sum to 0; expected a positive sum");
    stamp[(4, 4)] = -1.0;
    refused(&stamp, 5, "sum to -1");
    stamp[(4, 4)] = 1.0;
    refused(&stamp, 15, "of 9 × 9 pixels; expected at least 15 × 15");
    stamp[(4, 8)] = 3.0;
    refused(&stamp, 5, "(+3.8, ");
    stamp[(0, 1)] = f32::INFINITY;
    refused(&stamp, 5, "(2, 1)");
}

#[test]
fn a_star_of_the_other_parity_is_drawn_on_the_cut() {
    let psf = moffat(4.0);
    for (given, size) in [(49, 48), (53, 48), (33, 32), (48, 47), (64, 49)] {
        let sides = limits(size, size, true);
        let found = cut(psf.stamp(given).view(), sides);
        let expected = cut(psf.stamp(size + 6).view(), sides);
        let peak = expected.iter().copied().fold(0.0, f64::max);
        let inner = s![8..size - 8, 8..size - 8];
        for (a, b) in found.slice(inner).iter().zip(expected.slice(inner)) {
            // The light beyond the stamp, of which a Moffat profile has 1e-3 here, comes back at the other side.
            assert!((a - b).abs() < 1e-3 * peak, "{given} to {size}: {a} {b}");
        }
    }
    // Only one side is of the other parity.
    let cut = Star::cut(Array2::<f32>::ones((9, 8)).view(), limits(8, 8, true));
    assert_eq!(cut.unwrap().psf.dim(), (8, 8));
}

#[test]
fn largest_values_are_found_unless_one_is_not_finite() {
    for count in [1, 16, 23] {
        for at in 0..count {
            let mut values = vec![-3.0f32; count];
            values[at] = -2.0;
            assert_eq!(largest_finite(&values), Some(-2.0));
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                values[at] = bad;
                assert_eq!(largest_finite(&values), None);
            }
        }
    }
}

#[test]
fn sums_do_not_depend_on_the_layout_in_memory() {
    for (rows, columns) in [(1, 1), (3, 16), (7, 23), (48, 40)] {
        let wide = Array2::from_shape_fn((rows + 2, 2 * columns), |(y, x)| {
            ((31 * y + 17 * x) % 101) as f64 - 20.0
        });
        for view in [
            wide.slice(s![1..=rows, 1..=columns]),
            wide.slice(s![1..=rows, ..;2]),
            wide.slice(s![1..=rows, ..columns]),
        ] {
            // Whole numbers: exact in any order.
            assert_eq!(sum(view), view.iter().sum::<f64>());
            let squares: f64 = view.iter().map(|value| value * value).sum();
            assert_eq!(sum_of_squares(view), squares);
        }
        let thirds = wide.mapv(|value| value / 3.0);
        let apart = thirds.slice(s![1..=rows, ..;2]);
        assert_eq!(sum(apart), sum(apart.to_owned().view()));
        let transposed = apart.reversed_axes().as_standard_layout().into_owned();
        assert_eq!(sum(apart), sum(transposed.view().reversed_axes()));
    }
}

#[test]
fn bright_stars_count_alike_in_the_average() {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let [narrow, wide] = [3.0, 4.0].map(|fwhm| drawn(profile, fwhm, Shear::ZERO, 48));
    let wide = noisy(&wide, 1300.0, &mut ChaCha8Rng::seed_from_u64(8));
    let mut stars = Array3::zeros((2, 48, 48));
    stars.slice_mut(s![0, .., ..]).assign(&narrow);
    stars.slice_mut(s![1, .., ..]).assign(&wide);
    let cut = limits(48, 32, false);
    let found = average_stars(stars.view(), cut).unwrap();
    let [found, narrow, wide] = [&found, &narrow, &wide].map(|psf| psf[(24, 24)] / psf.sum());
    // By its S/N of 1300, which is above 1000, the second would count less than the first, which has no noise.
    let share = (found - wide) / (narrow - wide);
    assert!((share - 0.5).abs() < 0.03, "{share}");
}

#[test]
fn steps_follow_the_width() {
    let moffat = |fwhm| {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        drawn(profile, fwhm, Shear::new(0.03, -0.02), 64)
    };
    // A Moffat of β = 3 has 1.25 π (FWHM/1.0196)² = 3.78 FWHM², and the pixel's width adds to it.
    let expected = 3.78 * 6.0f64.powi(2);
    let found = noise_equivalent_area(moffat(6.0).view());
    assert!((found / expected - 1.0).abs() < 0.02, "{found}");
    let step =
        |psf: Array2<f64>, reference| width_step(noise_equivalent_area(psf.view()), reference);
    let steps = |fwhm| step(moffat(fwhm), 50.0);
    let narrow = [0.5, 2.0, 2.3, 2.45, 2.55, 2.7, 3.06].map(steps);
    assert_eq!(narrow, [-3, -2, -1, -1, 0, 0, 0]);
    let wide = [3.4, 3.74, 4.5, 6.0, 20.0].map(steps);
    assert_eq!(wide, [0, 0, 1, 3, 6]);
    assert_eq!(step(moffat(6.0), 0.0), 0);
    // Noise of a star of S/N 30 alone would make it a step narrower.
    let star = noisy(&moffat(3.4), 30.0, &mut ChaCha8Rng::seed_from_u64(9));
    assert_eq!(step(star, 50.0), 0);
    assert_eq!(step(moffat(6.0) * f64::NAN, 50.0), 0);
    assert_eq!([-4, 0, 4].map(width_factor), [0.5, 1.0, 2.0]);
}

fn gaussian(moments: [f64; 3], centre: [f64; 2]) -> Array2<f64> {
    let [a, b, c] = inverse(moments).unwrap();
    Array2::from_shape_fn((32, 32), |(y, x)| {
        let (x, y) = (x as f64 - 15.5 - centre[0], y as f64 - 15.5 - centre[1]);
        (-0.5 * (a * x * x + 2.0 * b * x * y + c * y * y)).exp()
    })
}

#[test]
fn gaussians_have_their_own_moments() {
    let moments = [3.1, 0.4, 2.2];
    for centre in [[0.0; 2], [0.4, -0.8]] {
        let psf = gaussian(moments, centre);
        let found = PsfShape::from_psf((&psf / psf.sum()).view());
        for (found, expected) in found.moments.iter().zip(moments) {
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
    }
    // Pixels do not matter to a wide PSF, so that the shear-type ellipticity is the formula's.
    let wide = drawn(
        PsfProfile::Moffat { beta: 3.0 },
        6.0,
        Shear::new(0.05, -0.03),
        64,
    );
    let found = PsfShape::from_psf(wide.view());
    let [e1, e2] = found.ellipticity();
    assert!(
        (e1 - 0.05).abs() < 1e-3 && (e2 + 0.03).abs() < 1e-3,
        "{e1} {e2}"
    );
    let noise = noisy(&wide, 0.02, &mut ChaCha8Rng::seed_from_u64(4));
    let sigma = PsfShape::from_psf(noise.view()).sigma();
    assert!(sigma.is_nan() || sigma > 0.0);
}

#[test]
fn adaptive_moments_are_those_of_galsim() {
    // galsim.Moffat(3, fwhm=3.4).shear(g1=0.06, g2=-0.04).drawImage(nx=32, ny=32, scale=1), FindAdaptiveMom of version 2.8.
    let psf = drawn(
        PsfProfile::Moffat { beta: 3.0 },
        3.4,
        Shear::new(0.06, -0.04),
        32,
    );
    let found = PsfShape::from_psf(psf.view());
    let [e1, e2] = found.ellipticity();
    let expected = [0.057_834, -0.038_571, 1.668_405];
    for (found, expected) in [e1, e2, found.sigma()].into_iter().zip(expected) {
        assert!((found - expected).abs() < 2e-4, "{found} {expected}");
    }
}

#[test]
fn jacobians_turn_and_shear_the_moments() {
    let psf = gaussian([3.1, 0.4, 2.2], [0.0; 2]);
    let psf = PsfShape::from_psf((&psf / psf.sum()).view());
    // Columns to the north and rows to the east: u = −y and v = x.
    let turned = psf.on_sky(&Jacobian::new([[0.0, -0.2], [0.2, 0.0]]).unwrap());
    let ([e1, e2], [t1, t2]) = (psf.ellipticity(), turned.ellipticity());
    assert!((t1 + e1).abs() < 1e-12 && (t2 + e2).abs() < 1e-12);
    assert!((turned.sigma() - psf.sigma()).abs() < 1e-12);
    // By 30 degrees, and so ellipticities by 60.
    let (cos, sin) = (0.2 * 0.75f64.sqrt(), 0.1);
    let [t1, t2] = psf
        .on_sky(&Jacobian::new([[cos, -sin], [sin, cos]]).unwrap())
        .ellipticity();
    let (cos, sin) = (0.5, 0.75f64.sqrt());
    assert!((t1 - cos * e1 + sin * e2).abs() < 1e-12 && (t2 - sin * e1 - cos * e2).abs() < 1e-12);
    let sheared = psf.on_sky(&Jacobian::new([[0.22, 0.0], [0.0, 0.2]]).unwrap());
    assert!(sheared.ellipticity()[0] > e1 + 0.04);
    let mean = PsfShape::mean([(psf, 1.0, 1.0), (turned, 1.0, 1.0)].into_iter());
    assert!(mean.ellipticity().iter().all(|e| e.abs() < 1e-12));
}

const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

fn sheared(profile: PsfProfile, fwhm: f64, side: usize) -> Array2<f64> {
    drawn(profile, fwhm, Shear::new(0.05, -0.03), side)
}

#[test]
fn the_bias_of_a_noisy_star_is_the_measured_one() {
    // The measured scatters of docs/limitations.md, to 6 %.
    for (snr, m, c) in [
        (50.0, 0.045, 0.023),
        (100.0, 0.023, 0.012),
        (200.0, 0.012, 0.0058),
        (500.0, 0.0047, 0.0024),
        (1000.0, 0.0055, 0.0023),
    ] {
        let found = quality(snr, 48).noise_bias();
        assert!((found[0] / m - 1.0).abs() < 0.06, "{snr}: {found:?}");
        assert!((found[1] / c - 1.0).abs() < 0.06, "{snr}: {found:?}");
    }
    assert_eq!(quality(100.0, 23).noise_bias(), [0.055, 0.023]);
    assert_eq!(quality(f64::INFINITY, 48).noise_bias(), [0.0; 2]);
    // Less than one is as bad as one.
    assert_eq!(quality(0.0, 48).noise_bias(), [2.3, 1.2]);
}

fn quality(snr: f64, side: usize) -> PsfQuality {
    let psf = sheared(MOFFAT, 3.4, 48);
    let quality = PsfQuality::from_psf(psf.view(), None).unwrap();
    PsfQuality {
        snr,
        side,
        ..quality
    }
}

/// Kinds of warnings about a PSF of any sum.
fn kinds(stamp: &Array2<f64>) -> Vec<&'static str> {
    let Star { psf, .. } = Star::cut(stamp.view(), stamp.nrows()).unwrap();
    let quality = PsfQuality::from_psf(psf.view(), None).unwrap();
    let found = psf_warnings(&[quality], true, None);
    found.iter().map(Warning::kind).collect()
}

/// An Airy disc, (2 J₁(x)/x)² at pixel centres.
fn airy(fwhm: f64, side: usize) -> Array2<f64> {
    let middle = (side as f64 - 1.0) / 2.0;
    Array2::from_shape_fn((side, side), |(y, x)| {
        let r = (x as f64 - middle).hypot(y as f64 - middle);
        let x = 3.2327 * r / fwhm;
        (2.0 * puruspe::bessel::Jn(1, x) / x).powi(2)
    })
}

#[test]
fn wings_are_neither_background_nor_noise() {
    for side in [32, 48, 64] {
        for fwhm in [1.6, 2.4, 3.4, 6.0] {
            for profile in [
                MOFFAT,
                PsfProfile::Moffat { beta: 2.2 },
                PsfProfile::Kolmogorov,
            ] {
                let found = kinds(&sheared(profile, fwhm, side));
                assert!(found.is_empty(), "{profile:?} {fwhm} {side}: {found:?}");
            }
        }
        for fwhm in [2.4, 3.4] {
            let found = kinds(&airy(fwhm, side));
            assert!(found.is_empty(), "Airy {fwhm} {side}: {found:?}");
        }
    }
    for side in [15, 23] {
        let found = kinds(&sheared(MOFFAT, 3.4, side));
        assert!(found.is_empty(), "{side}: {found:?}");
    }
}

#[test]
fn wrong_psfs_have_their_warning() {
    let good = sheared(MOFFAT, 3.4, 48);
    let peak = good.iter().copied().fold(0.0, f64::max);
    for (share, expected) in [(0.01, 1), (0.05, 1), (-0.002, 1), (0.0003, 0)] {
        let found = kinds(&(&good + share * peak));
        assert_eq!(found, vec!["psf-background"; expected], "{share}");
    }
    let slope = |y: f64| {
        let gradient = |(_, x): (usize, usize)| y * peak * (x as f64 - 23.5) / 23.5;
        &good + &Array2::from_shape_fn((48, 48), gradient)
    };
    assert_eq!(kinds(&slope(0.005)), ["psf-gradient"]);
    let tilted = slope(0.005);
    let quality = PsfQuality::from_psf((&tilted / tilted.sum()).view(), None).unwrap();
    let text = psf_warnings(&[quality], true, None)[0].to_string();
    // 0.5 % of the peak over 23.5 px.
    assert!(
        text.contains("found 0.021 % of the peak per pixel along x and 0.000 %"),
        "{text}"
    );
    assert!(kinds(&slope(0.0005)).is_empty());
    let mut delta = Array2::zeros((48, 48));
    delta[(24, 23)] = 3.0;
    assert_eq!(kinds(&delta), ["psf-narrow"]);
    assert_eq!(kinds(&sheared(MOFFAT, 0.3, 48)), ["psf-narrow"]);
}

#[test]
fn warnings_about_stamps_without_a_star_are_legible() {
    let quality =
        PsfQuality::from_psf(Array2::from_elem((48, 48), 1.0 / 2304.0).view(), None).unwrap();
    let found = psf_warnings(&[quality], true, None);
    let text: Vec<String> = found.iter().map(ToString::to_string).collect();
    assert!(
        !text.is_empty() && text.iter().all(|line| line.len() < 300),
        "{text:?}"
    );
}

#[test]
fn the_noise_of_a_star_is_measured_and_only_warned_about() {
    let good = sheared(MOFFAT, 3.4, 48);
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for snr in [20.0, 50.0, 100.0, 500.0, 3000.0] {
        for _ in 0..20 {
            let star = noisy(&good, snr, &mut rng) * 100.0;
            let Star { psf, .. } = Star::cut(star.view(), 48).unwrap();
            let quality = PsfQuality::from_psf(psf.view(), None).unwrap();
            // 370 pixels determine σ to 6 %, and Σ p² is known to 2/(S/N).
            let error = quality.snr / snr - 1.0;
            assert!(error.abs() < 0.25 + 10.0 / snr, "{quality:?}");
            let expected = vec!["psf-noise"; usize::from(snr < 1000.0)];
            assert_eq!(kinds(&star), expected, "{quality:?}");
        }
    }
}

#[test]
fn warnings_begin_at_their_limits() {
    let good = PsfQuality {
        snr: 1e6,
        ..quality(1e6, 48)
    };
    // Literal limits, a factor of 1.2 before and beyond each of them.
    let begins = |kind: &str, shared: bool, limit: f64, of: &dyn Fn(f64) -> PsfQuality| {
        let [before, beyond] = [limit / 1.2, limit * 1.2].map(|value| {
            let found = psf_warnings(&[of(value)], shared, None);
            found.iter().any(|warning| warning.kind() == kind)
        });
        assert!(before != beyond, "{kind} {limit}");
    };
    begins("psf-background", true, 0.1, &|background| PsfQuality {
        background,
        ..good
    });
    begins("psf-gradient", true, 0.3, &|gradient| PsfQuality {
        gradient,
        ..good
    });
    begins("psf-noise", true, 1000.0, &|snr| PsfQuality { snr, ..good });
    begins("psf-noise", false, 100.0, &|snr| PsfQuality { snr, ..good });
    begins("psf-narrow", true, 6.0, &|area| PsfQuality { area, ..good });
    let core = |mean_square_radius| CoreSize {
        mean_square_radius,
        error: 0.0,
    };
    let broad = |ratio: f64| {
        let psf = PsfQuality {
            core: Some(core(ratio)),
            ..good
        };
        let found = psf_warnings(&[psf], true, Some(core(1.0)));
        found.iter().map(Warning::is_fatal).collect::<Vec<_>>()
    };
    assert_eq!(broad(0.8), []);
    assert_eq!(broad(0.86), [false]);
    assert_eq!(broad(0.99), [false]);
    assert_eq!(broad(1.05), [true]);
    // A tenth of the PSFs of an image.
    let of_hundred = |bad: usize| {
        let psf = |k: usize| PsfQuality {
            gradient: if k < bad { 1.0 } else { 0.0 },
            ..good
        };
        psf_warnings(&(0..100).map(psf).collect::<Vec<_>>(), false, None).len()
    };
    assert_eq!([8, 12].map(of_hundred), [0, 1]);
}

#[test]
fn the_slowest_wing_is_no_background() {
    let wing = Array2::from_shape_fn((48, 48), |(y, x)| {
        let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
        (1.0 + x * x + y * y).powf(-1.25)
    });
    let background = |stamp: &Array2<f64>| {
        let psf = stamp / stamp.sum();
        PsfQuality::from_psf(psf.view(), None).unwrap().background
    };
    assert!(background(&wing).abs() < 0.02, "{}", background(&wing));
    // Light that falls more slowly is one.
    let slower = wing.mapv(|value| value.powf(0.5));
    assert!(background(&slower) > 0.2, "{}", background(&slower));
}
