use ndarray::{Array2, ArrayView2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_quantities::PixelShape;
use shearq_quantities::fourier::Complex64;
use shearq_submissions::{LinearDeconvolution, Registry};

use super::deconvolution::*;
use super::noise::*;
use super::window::*;
use crate::network::convolve;
use crate::network::high_pass;
use crate::noise::StampNoise;
use crate::shape::{RoundMoments, SizeMoments, TypicalGalaxy};

fn settings(iterations: usize, target: f64, window: f64, lambda: f64) -> LinearDeconvolution {
    let registry = Registry::embedded().unwrap();
    let named = registry.get("48/linear/star").unwrap().configuration;
    LinearDeconvolution {
        max_iterations: iterations,
        target_sigma: target,
        window_sigma: window,
        reference_extent: 0.0,
        reference_area: 0.0,
        lambda,
        step: named.linear().unwrap().deconvolution.step,
    }
}

/// White noise.
fn white(plan: &Spectral) -> ModeNoise {
    plan.noise(&StampNoise::white(1.0))
}

/// A plan with a PSF, for white noise.
fn planned(
    n: usize,
    h: &Array2<f64>,
    settings: &LinearDeconvolution,
) -> (Spectral, SpectralPsf, SpectralScratch) {
    let plan = Spectral::new(n, h.nrows(), settings).unwrap();
    let (mut psf, mut scratch) = (plan.psf(), plan.scratch());
    plan.set_psf(h.view(), &white(&plan), &mut scratch, &mut psf)
        .unwrap();
    (plan, psf, scratch)
}

fn zero_lag(plan: &Spectral) -> usize {
    plan.lattice().middle(0) as usize
}

/// A lopsided PSF of sum one, centred on its stamp.
fn psf(p: usize) -> Array2<f64> {
    let centre = (p as f64 - 1.0) / 2.0;
    let psf = Array2::from_shape_fn((p, p), |(y, x)| {
        let (dy, dx) = (y as f64 - centre, x as f64 - centre);
        (-(dx * dx + 0.7 * dy * dy + 0.5 * dx * dy) / 3.0).exp()
    });
    let sum = psf.sum();
    psf / sum
}

// Square pixels, and sheared ones with a skew of either sign.
const PIXELS: [PixelShape; 3] = [
    PixelShape::SQUARE,
    PixelShape {
        stretch: 1.06,
        skew: 0.09,
    },
    PixelShape {
        stretch: 0.95,
        skew: -0.07,
    },
];

/// An elliptical Gaussian galaxy off the stamp's middle under a shear about the middle, before the PSF.
fn galaxy(n: usize, pixels: PixelShape, g1: f64, g2: f64) -> Array2<f64> {
    let middle = (n as f64 - 1.0) / 2.0;
    Array2::from_shape_fn((n, n), |(y, x)| {
        let [x, y] = pixels.map([x as f64 - middle, y as f64 - middle]);
        // Position before the shear, whose matrix is (1 + γ₁, γ₂; γ₂, 1 − γ₁), of determinant
        // one to first order.
        let (u, v) = ((1.0 - g1) * x - g2 * y, (1.0 + g1) * y - g2 * x);
        let (u, v) = (u + 0.3, v - 0.2);
        (-(u * u / 7.0 + v * v / 4.0 + 0.3 * u * v / 5.0)).exp()
    })
}

/// The galaxy as it is observed: centred PSFs of odd sides leave it where it is.
fn observed(n: usize, h: &Array2<f64>, g1: f64, g2: f64) -> Vec<f32> {
    observed_on(n, h, PixelShape::SQUARE, g1, g2)
}

fn observed_on(n: usize, h: &Array2<f64>, pixels: PixelShape, g1: f64, g2: f64) -> Vec<f32> {
    let image = convolve(galaxy(n, pixels, g1, g2).view(), h.view());
    image.iter().map(|&v| v as f32).collect()
}

fn noise(n: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    // Uniform noise of variance one.
    let half = 3f32.sqrt();
    (0..n * n).map(|_| rng.random_range(-half..half)).collect()
}

/// The transform of an image at wave vector (kx, ky), its first pixel at the origin: a plain sum.
fn transform(image: ArrayView2<'_, f64>, kx: f64, ky: f64) -> Complex64 {
    let terms = image.indexed_iter();
    terms
        .map(|((y, x), v)| Complex64::from_polar(*v, -(kx * x as f64 + ky * y as f64)))
        .sum()
}

/// The autocorrelation as the module's description has it, by plain sums in f64.
fn plain(
    plan: &Spectral,
    settings: &LinearDeconvolution,
    h: &Array2<f64>,
    stamp: &Array2<f64>,
) -> Vec<f64> {
    let (size, modes) = (plan.plane.period, plan.plane.modes);
    // Every pixel of the period.
    let side = size;
    let (n, p) = (stamp.nrows() as f64, h.nrows() as f64);
    let unit = std::f64::consts::TAU / size as f64;
    let spacing = size as f64 / side as f64;
    let waves: Vec<f64> = (-(modes as i32)..=modes as i32)
        .map(|j| unit * f64::from(j))
        .collect();
    let plane = || {
        waves
            .iter()
            .flat_map(|&kx| waves.iter().map(move |&ky| (kx, ky)))
    };
    // v̂ of each mode.
    let restored: Vec<Complex64> = plane()
        .map(|(kx, ky)| {
            let square = kx * kx + ky * ky;
            if square > (TARGET_CUT / settings.target_sigma).powi(2) {
                return Complex64::ZERO;
            }
            let centre = (p - 1.0) / 2.0 * (kx + ky);
            let h = transform(h.view(), kx, ky) * Complex64::from_polar(1.0, centre);
            let w = h.norm_sqr() + settings.lambda * high_pass(kx, ky).powi(2);
            let rest = (1.0 - settings.step * w).powi(settings.max_iterations as i32);
            let gaussian = (-0.5 * settings.target_sigma.powi(2) * square).exp();
            // cos² from three quarters of the largest wave number to it.
            let place = (square.sqrt() * settings.target_sigma / TARGET_CUT - 0.75) / 0.25;
            let fall = (std::f64::consts::FRAC_PI_2 * place.max(0.0)).cos().powi(2);
            let target = gaussian * fall;
            transform(stamp.view(), kx, ky) * h.conj() * (target * (1.0 - rest) / w)
        })
        .collect();
    // v at every pixel, windowed.
    let from_middle = |at: usize| {
        let x = at as f64 * spacing - (n - 1.0) / 2.0;
        x - size as f64 * (x / size as f64).round()
    };
    let windowed = Array2::from_shape_fn((side, side), |(y, x)| {
        let sum: Complex64 = plane()
            .zip(&restored)
            .map(|((kx, ky), v)| {
                v * Complex64::from_polar(1.0, spacing * (kx * x as f64 + ky * y as f64))
            })
            .sum();
        let square = from_middle(x).powi(2) + from_middle(y).powi(2);
        let window = (-0.5 * square / settings.window_sigma.powi(2)).exp();
        sum.re / (size * size) as f64 * window
    });
    // Its power and the lags.
    let circle = unit * modes as f64 * (1.0 + 1e-12);
    let powers: Vec<(f64, f64, f64)> = plane()
        .filter(|(kx, ky)| kx.hypot(*ky) <= circle)
        .map(|(kx, ky)| {
            let v = transform(windowed.view(), kx * spacing, ky * spacing);
            (
                kx,
                ky,
                v.norm_sqr() * spacing.powi(4) / (size * size) as f64,
            )
        })
        .collect();
    let lags = plan.lattice().places().map(|[x, y]| {
        let terms = powers.iter();
        terms
            .map(|(kx, ky, power)| power * (kx * x + ky * y).cos())
            .sum()
    });
    lags.collect()
}

#[test]
fn the_autocorrelation_equals_plain_sums_on_dirty_scratch() {
    for (n, p, iterations, lambda) in [(24, 11, 3, 0.0), (19, 8, 40, 1e-3), (13, 13, 1000, 0.0)] {
        let settings = settings(iterations, 1.5, n as f64 / 4.0, lambda);
        let h = psf(p);
        let stamp = convolve(galaxy(n, PixelShape::SQUARE, 0.0, 0.0).view(), h.view());
        let plan = Spectral::new(n, p, &settings).unwrap();
        let (mut own, mut scratch, mut lags) = (plan.psf(), plan.scratch(), plan.lags());
        let data: Vec<f32> = stamp.iter().map(|&v| v as f32).collect();
        // What another stamp left behind must not matter.
        plan.set_psf(psf(p).t(), &white(&plan), &mut scratch, &mut own)
            .unwrap();
        let other: Vec<f32> = data.iter().map(|v| 1e3 - v).collect();
        plan.autocorrelate(&own, &other, 3.0, &mut scratch, &mut lags);
        plan.set_psf(h.view(), &white(&plan), &mut scratch, &mut own)
            .unwrap();
        plan.autocorrelate(&own, &data, 0.0, &mut scratch, &mut lags);
        let expected = plain(&plan, &settings, &h, &stamp);
        let peak = expected[zero_lag(&plan)];
        let used = |place: &[f64; 2]| plan.lattice().contains(*place);
        let pairs = lags.acf.iter().zip(&expected).zip(plan.lattice().places());
        for ((found, expected), _) in pairs.filter(|(_, place)| used(place)) {
            // f32 transforms; modes below `MIN_PSF_POWER`, which are left out, have none of the light.
            let apart = (f64::from(*found) - expected).abs();
            assert!(apart < 1e-5 * peak, "{n} {p}: {found} {expected}");
        }
    }
}

#[test]
fn pictures_show_the_stamp_whose_lags_are_measured() {
    // The stamp's square is the autocorrelation's zero lag, on the finer grid of pixels too.
    let (n, p) = (33, 9);
    let settings = settings(1000, 1.5, 8.0, 0.0);
    let h = psf(p);
    for pixels in PIXELS {
        pictured(n, &h, &settings, pixels);
    }
}

fn pictured(n: usize, h: &Array2<f64>, settings: &LinearDeconvolution, pixels: PixelShape) {
    let (plan, mut own, mut scratch) = planned(n, h, settings);
    plan.set_pixel_shape(pixels, &mut scratch);
    plan.set_psf(h.view(), &white(&plan), &mut scratch, &mut own)
        .unwrap();
    let mut lags = plan.lags();
    let data = observed_on(n, h, pixels, 0.1, 0.0);
    plan.autocorrelate(&own, &data, 0.0, &mut scratch, &mut lags);
    let picture = plan.deconvolved(&own, &data, 0.0, &mut scratch);
    let square: f64 = picture.iter().map(|v| f64::from(v * v)).sum();
    let peak = f64::from(lags.acf[zero_lag(&plan)]);
    // The window spreads a little light beyond the largest circle of modes.
    assert!((square / peak - 1.0).abs() < 4e-3, "{square} {peak}");
}

#[test]
fn the_response_is_that_of_a_sheared_galaxy() {
    // The window goes through the galaxy.
    PIXELS.into_iter().for_each(the_response_on);
}

fn the_response_on(pixels: PixelShape) {
    let (n, p) = (40, 11);
    let h = psf(p);
    let (plan, mut own, mut scratch) = planned(n, &h, &settings(1000, 1.5, 3.0, 0.0));
    plan.set_pixel_shape(pixels, &mut scratch);
    plan.set_psf(h.view(), &white(&plan), &mut scratch, &mut own)
        .unwrap();
    let mut lags_of = |g1: f64, g2: f64| {
        let mut lags = plan.lags();
        let stamp = observed_on(n, &h, pixels, g1, g2);
        plan.autocorrelate(&own, &stamp, 0.0, &mut scratch, &mut lags);
        lags
    };
    let here = lags_of(0.0, 0.0);
    let peak = here.acf[zero_lag(&plan)];
    let step = 0.01;
    for (derivative, plus, minus) in [
        (&here.shear1, lags_of(step, 0.0), lags_of(-step, 0.0)),
        (&here.shear2, lags_of(0.0, step), lags_of(0.0, -step)),
    ] {
        let largest = derivative.iter().fold(0.0f32, |a, b| a.max(b.abs()));
        assert!(largest > 0.05 * peak);
        for (found, (a, b)) in derivative.iter().zip(plus.acf.iter().zip(&minus.acf)) {
            let expected = (a - b) / (2.0 * step as f32);
            // f32 rounding over the step (1e-5), second order in the step (1e-4 of the size).
            assert!((found - expected).abs() < 1e-3 * peak, "{found} {expected}");
        }
    }
}

/// The stamp of a broad Gaussian galaxy under a shear about `centre`, with light beyond all edges: cut out of a wider field.
fn broad(
    n: usize,
    h: &Array2<f64>,
    (pixels, centre): (PixelShape, [f64; 2]),
    g1: f64,
    g2: f64,
) -> Vec<f32> {
    let beyond = 16;
    let side = n + 2 * beyond;
    let middle = (side as f64 - 1.0) / 2.0;
    let field = Array2::from_shape_fn((side, side), |(y, x)| {
        let [x, y] = pixels.map([x as f64 - middle, y as f64 - middle]);
        let (x, y) = (x - centre[0], y - centre[1]);
        let (u, v) = ((1.0 - g1) * x - g2 * y, (1.0 + g1) * y - g2 * x);
        let (u, v) = (u + 1.5, v - 1.0);
        (-(u * u / 140.0 + v * v / 100.0 + 0.3 * u * v / 110.0)).exp()
    });
    let image = convolve(field.view(), h.view());
    let stamp = image.slice(ndarray::s![beyond..beyond + n, beyond..beyond + n]);
    stamp.iter().map(|&v| v as f32).collect()
}

#[test]
fn edges_stay_where_they_are_while_the_light_is_sheared() {
    let cases = [(40, [0.0, 0.0]), (41, [0.0, 0.0]), (40, [2.5, -3.0])];
    let cases = PIXELS.map(|pixels| cases.map(|(n, centre)| (n, centre, pixels)));
    for (n, centre, pixels) in cases.into_iter().flatten() {
        let h = psf(11);
        let plan = Spectral::new(n, 11, &settings(1000, 1.5, n as f64 / 4.0, 0.0)).unwrap();
        // A window that is told to be narrow does not look at the edges.
        let mut without = plan.clone();
        without.window_sigma = 1.0;
        assert!(plan.sees_edges([0.0; 2], pixels) && !without.sees_edges([0.0; 2], pixels));
        let (mut own, mut scratch) = (plan.psf(), plan.scratch());
        plan.set_pixel_shape(pixels, &mut scratch);
        plan.set_psf(h.view(), &white(&plan), &mut scratch, &mut own)
            .unwrap();
        let place = centre.map(|at| at as f32);
        plan.place_window(place, place, &mut scratch);
        let mut lags_of = |plan: &Spectral, g1: f64, g2: f64| {
            let mut lags = plan.lags();
            let stamp = broad(n, &h, (pixels, centre), g1, g2);
            plan.autocorrelate(&own, &stamp, 0.0, &mut scratch, &mut lags);
            lags
        };
        let (here, naive) = (lags_of(&plan, 0.0, 0.0), lags_of(&without, 0.0, 0.0));
        let step = 0.01;
        for (found, naive, plus, minus) in [
            (
                &here.shear1,
                &naive.shear1,
                lags_of(&plan, step, 0.0),
                lags_of(&plan, -step, 0.0),
            ),
            (
                &here.shear2,
                &naive.shear2,
                lags_of(&plan, 0.0, step),
                lags_of(&plan, 0.0, -step),
            ),
        ] {
            let apart = |lags: &[f32]| {
                let pairs = lags.iter().zip(plus.acf.iter().zip(&minus.acf));
                let apart = pairs.map(|(found, (a, b))| {
                    let expected = (a - b) / (2.0 * step as f32);
                    (found - expected).powi(2)
                });
                apart.sum::<f32>().sqrt()
            };
            let [with, without] = [found, naive].map(|lags| apart(lags));
            // The light between the last pixels and the edge is not quite on a straight line.
            assert!(
                with < 0.1 * without,
                "{n} {centre:?} {pixels:?}: {with} {without}"
            );
        }
    }
}

#[test]
fn edges_count_where_the_window_exceeds_a_fiftieth() {
    // exp(−24²/2σ²) is 0.011, and 0.033.
    for (window, counts) in [(8.0, false), (9.2, true)] {
        let plan = Spectral::new(48, 11, &settings(1000, 1.5, window, 0.0)).unwrap();
        let skewed = PixelShape {
            stretch: 1.0,
            skew: 1e-3,
        };
        for pixels in [PixelShape::SQUARE, skewed] {
            assert_eq!(plan.sees_edges([0.0; 2], pixels), counts, "{window}");
        }
    }
}

#[test]
fn planes_have_eight_free_pixels_in_steps_of_sixteen() {
    let settings = settings(1000, 1.5, 8.0, 0.0);
    let period = |n: usize| Spectral::new(n, 11, &settings).unwrap().plane.period;
    assert_eq!([40, 44].map(period), [48, 64]);
}

#[test]
fn the_ring_weighs_light_by_its_distance() {
    // A radius of 1.5 σ of the window, and at most a quarter of the stamp's side.
    for (n, window, radius) in [(64, 5.0, 7.5), (32, 8.0, 8.0)] {
        let h = psf(11);
        let (plan, own, mut scratch) = planned(n, &h, &settings(1000, 1.5, window, 0.0));
        let mut lags = plan.lags();
        for distance in [0.6, 1.0, 1.4].map(|share| share * radius) {
            let middle = (n as f64 - 1.0) / 2.0;
            // (x, y) and the light there of a galaxy of flux one and this variance.
            let galaxy = |at: usize, variance: f64| {
                let [x, y] = [at % n, at / n].map(|at| at as f64 - middle);
                let square = (x - distance).powi(2) + y * y;
                let light = (-0.5 * square / variance).exp() / (std::f64::consts::TAU * variance);
                ((x * x + y * y) / (radius * radius), light)
            };
            let image = Array2::from_shape_fn((n, n), |(y, x)| galaxy(y * n + x, 1.0).1);
            let image = convolve(image.view(), h.view());
            let data: Vec<f32> = image.iter().map(|&v| v as f32).collect();
            plan.autocorrelate(&own, &data, 0.0, &mut scratch, &mut lags);
            // Behind the target, whose variance is 2.25 px².
            let terms = (0..n * n).map(|at| {
                let (square, light) = galaxy(at, 3.25);
                square * square * (2.0 - 2.0 * square).exp() * light
            });
            let (found, expected) = (f64::from(lags.ring.value), terms.sum::<f64>());
            assert!(
                (found - expected).abs() < 0.01,
                "{n} {distance}: {found} {expected}"
            );
        }
    }
}

#[test]
fn light_times_clarity_is_the_squared_signal_to_noise() {
    let (n, p, extent) = (44, 11, 7.0);
    let h = psf(p);
    let plan = Spectral::new(n, p, &settings(1000, 1.5, 8.0, 0.0)).unwrap();
    let (mut own, mut scratch) = (plan.psf(), plan.scratch());
    let light = plan.light(extent);
    let mut signal = |noise: &ModeNoise| {
        plan.set_psf(h.view(), noise, &mut scratch, &mut own)
            .unwrap();
        let modes = light.iter().zip(own.clarity());
        modes.map(|(light, clarity)| light * clarity).sum::<f32>()
    };
    let galaxy = Array2::from_shape_fn((n, n), |(y, x)| {
        let [y, x] = [y, x].map(|at| at as f64 - (n as f64 - 1.0) / 2.0);
        (-0.5 * (x * x + y * y) / extent).exp() / (2.0 * std::f64::consts::PI * extent)
    });
    let image = convolve(galaxy.view(), h.view());
    let squares = image.iter().map(|v| v * v).sum::<f64>();
    // Single precision; modes beyond those kept have 10⁻⁷ of the galaxy's light.
    let found = f64::from(signal(&white(&plan)));
    assert!((found / squares - 1.0).abs() < 1e-5, "{found} {squares}");
    // Noise of a level of two, and of one that falls with the wavenumber along x: where it is less the galaxy is clearer.
    let mut noise = white(&plan);
    noise.power.fill(4.0);
    let less = f64::from(signal(&noise));
    assert!((4.0 * less / squares - 1.0).abs() < 1e-5, "{less}");
    for (power, kx) in noise.power.iter_mut().zip(&plan.waves[0]) {
        *power = (1.0 + kx * kx).recip();
    }
    // ∂/∂x of the image, squared, is what k_x² adds; by differences that are exact to k⁶/140, k² being 0.06 here.
    let slopes = image.rows().into_iter().flat_map(|row| {
        let row = row.to_vec();
        let slope = |w: &[f64]| (45.0 * (w[4] - w[2]) - 9.0 * (w[5] - w[1]) + (w[6] - w[0])) / 60.0;
        row.windows(7).map(|w| slope(w).powi(2)).collect::<Vec<_>>()
    });
    let (more, expected) = (f64::from(signal(&noise)), squares + slopes.sum::<f64>());
    assert!((more / expected - 1.0).abs() < 1e-4, "{more} {expected}");
}

#[test]
fn a_window_that_follows_the_galaxy_gives_equal_lags() {
    let (n, p) = (48, 11);
    let h = psf(p);
    let (plan, own, mut scratch) = planned(n, &h, &settings(1000, 1.5, 6.0, 0.0));
    let middle = observed(n, &h, 0.05, -0.03);
    // Three pixels along x and minus two along y.
    let moved: Vec<f32> = (0..n * n)
        .map(|at| {
            let (x, y) = ((at % n) as i32 - 3, (at / n) as i32 + 2);
            let side = 0..n as i32;
            if side.contains(&x) && side.contains(&y) {
                middle[y as usize * n + x as usize]
            } else {
                0.0
            }
        })
        .collect();
    let (mut there, mut here) = (plan.lags(), plan.lags());
    plan.place_window([3.0, -2.0], [3.0, -2.0], &mut scratch);
    plan.autocorrelate(&own, &moved, 0.0, &mut scratch, &mut there);
    plan.place_window([0.0; 2], [0.0; 2], &mut scratch);
    plan.autocorrelate(&own, &middle, 0.0, &mut scratch, &mut here);
    let peak = here.acf[zero_lag(&plan)];
    let pairs = |a: &[f32], b: &[f32]| {
        let apart = a.iter().zip(b).map(|(a, b)| (a - b).abs());
        apart.fold(0.0, f32::max)
    };
    // f32 through the division by the PSF's transform.
    assert!(pairs(&there.acf, &here.acf) < 1e-4 * peak);
    assert!(pairs(&there.shear1, &here.shear1) < 1e-3 * peak);
    assert!(pairs(&there.shear2, &here.shear2) < 1e-3 * peak);
}

/// Sum of 2 × 2 pixels of white noise, halved: of variance one, and power (1 + cos k_x)(1 + cos k_y).
fn summed(n: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let white = noise(n + 1, rng);
    let sum = |x: usize, y: usize| {
        let at = y * (n + 1) + x;
        0.5 * (white[at] + white[at + 1] + white[at + n + 1] + white[at + n + 2])
    };
    (0..n * n).map(|at| sum(at % n, at / n)).collect()
}

/// The noise of [`summed`], as it is known from many frames of it.
fn of_summed(rng: &mut ChaCha8Rng) -> StampNoise {
    let mut survey = crate::noise::NoisePlan::new(48, 1, None).unwrap().survey();
    for _ in 0..2000 {
        let stamp = Array2::from_shape_vec((48, 48), summed(48, rng)).unwrap();
        survey.add(stamp.view()).unwrap();
    }
    survey.result().unwrap().unwrap().noise
}

#[test]
fn noise_is_subtracted_in_the_mean_from_lags_and_derivatives() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let correlated = of_summed(&mut rng);
    for own in [&StampNoise::white(1.0), &correlated] {
        subtracted_in_the_mean(own, PixelShape::SQUARE, &mut rng);
    }
    subtracted_in_the_mean(&correlated, PIXELS[1], &mut rng);
}

#[test]
fn there_is_no_noise_beyond_the_edges_of_the_stamp() {
    let (n, p) = (32, 9);
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let (plan, own, mut scratch) = planned(n, &psf(p), &settings(1000, 1.5, n as f64 / 4.0, 0.0));
    let mut lags = plan.lags();
    let mut means = [0.0; 2];
    for _ in 0..8000 {
        let stamp = noise(n, &mut rng);
        for (mean, level) in means.iter_mut().zip([1.0, 0.0]) {
            plan.autocorrelate(&own, &stamp, level, &mut scratch, &mut lags);
            *mean += f64::from(lags.acf[zero_lag(&plan)]);
        }
    }
    // 0.5 % of the window's square is beyond the edges of either axis. 8000 squares of some fifty modes: 0.2 %.
    assert!((inside(n, n as f64 / 4.0) - 0.9953).abs() < 1e-4);
    assert!(means[0].abs() < 0.004 * means[1], "{means:?}");
}

fn subtracted_in_the_mean(own_noise: &StampNoise, pixels: PixelShape, rng: &mut ChaCha8Rng) {
    let (n, p) = (32, 9);
    let plan = Spectral::new(n, p, &settings(1000, 1.5, 5.0, 1e-4)).unwrap();
    let (mut own, mut scratch, mut lags) = (plan.psf(), plan.scratch(), plan.lags());
    plan.set_pixel_shape(pixels, &mut scratch);
    let noise_of_modes = plan.noise_on(own_noise, pixels);
    plan.set_psf(psf(p).view(), &noise_of_modes, &mut scratch, &mut own)
        .unwrap();
    let count = 4000;
    let mut means = [(); 2].map(|()| [(); 3].map(|()| vec![0.0f64; lags.acf.len()]));
    for _ in 0..count {
        let stamp = if own_noise.is_correlated() {
            summed(n, rng)
        } else {
            noise(n, rng)
        };
        for (level, sums) in [own_noise.sigma() as f32, 0.0].into_iter().zip(&mut means) {
            plan.autocorrelate(&own, &stamp, level, &mut scratch, &mut lags);
            for (sums, lags) in sums.iter_mut().zip([&lags.acf, &lags.shear1, &lags.shear2]) {
                for (sum, lag) in sums.iter_mut().zip(lags) {
                    *sum += f64::from(*lag) / f64::from(count);
                }
            }
        }
    }
    let [with, without] = means;
    let peak = without[0][zero_lag(&plan)];
    let largest = |lags: &[f64]| lags.iter().fold(0.0f64, |a, b| a.max(b.abs()));
    for (kind, (with, without)) in with.iter().zip(&without).enumerate() {
        let (left, all) = (largest(with), largest(without));
        // Some twenty independent modes in each of 4000 stamps: 0.4 % of the peak; the shear of noise
        // moves pixels by several of their distances, for which five times as much.
        let tolerance = [0.012, 0.06, 0.06][kind] * peak;
        assert!(left < tolerance, "{kind}: {left} of {all}, peak {peak}");
        assert!(all > 3.0 * tolerance, "{kind}: {all}, peak {peak}");
    }
}

#[test]
fn mean_products_are_those_of_noise_on_the_stamp() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let correlated = of_summed(&mut rng);
    let square = PixelShape::SQUARE;
    let largest = [
        (&StampNoise::white(1.0), square),
        (&correlated, square),
        (&correlated, PIXELS[2]),
    ]
    .map(|(own, pixels)| products_of_noise_on_the_stamp(own, pixels, &mut rng));
    // Products with sheared noise are noticed.
    assert!(largest.iter().any(|share| *share > 0.15), "{largest:?}");
}

/// Returns the largest product with sheared noise in units of that with noise.
fn products_of_noise_on_the_stamp(
    own_noise: &StampNoise,
    pixels: PixelShape,
    rng: &mut ChaCha8Rng,
) -> f64 {
    let (n, p) = (32, 9);
    let h = psf(p);
    let plan = Spectral::new(n, p, &settings(1000, 1.5, 5.0, 0.0)).unwrap();
    let (mut own, mut scratch) = (plan.psf(), plan.scratch());
    plan.set_pixel_shape(pixels, &mut scratch);
    let noise_of_modes = plan.noise_on(own_noise, pixels);
    plan.set_psf(h.view(), &noise_of_modes, &mut scratch, &mut own)
        .unwrap();
    let data = observed_on(n, &h, pixels, 0.0, 0.0);
    let mut lags = plan.lags();
    plan.autocorrelate(&own, &data, 0.0, &mut scratch, &mut lags);
    let weights: [Vec<f32>; 5] = std::array::from_fn(|_| even(&plan, rng));
    let spectra = weights
        .each_ref()
        .map(|weights| plan.spectrum_of(weights, &mut scratch));
    let spectra = spectra.each_ref().map(|spectrum| &spectrum[..]);
    let found = plan.products(&own, spectra, &mut scratch);
    // Products of the first two quantities with themselves, of noise and of noise sheared, and their squares.
    let mut sums = [[[0.0f64; 2]; 3]; 2];
    let count = 12_000;
    for _ in 0..count {
        let stamp = if own_noise.is_correlated() {
            summed(n, rng)
        } else {
            noise(n, rng)
        };
        plan.restore(&own.epochs[0], &stamp, &mut scratch);
        plan.apply_window(&mut scratch);
        let changes = [0, 1, 2].map(|which| {
            take_change(&plan, which, &mut scratch, &mut lags.acf);
            [0, 1].map(|k| over_lags(&plan, &weights[k], &lags.acf))
        });
        for (k, sums) in sums.iter_mut().enumerate() {
            for ([sum, square], change) in sums.iter_mut().zip(changes) {
                let product = changes[0][k] * change[k];
                *sum += product / f64::from(count);
                *square += product * product / f64::from(count);
            }
        }
    }
    let mut largest = 0.0f64;
    let own = [[0, 0], [1, 1]].map(|pair| found.pairs[pair]);
    for (sums, found) in sums.into_iter().zip(own) {
        let [first, second] = found.sheared.map(f64::from);
        let plain = f64::from(found.plain);
        largest = largest.max(first.abs().max(second.abs()) / plain);
        for ([mean, square], found) in sums.into_iter().zip([plain, first, second]) {
            let error = ((square - mean * mean) / f64::from(count)).sqrt();
            // The noise of `summed` is known from as many pixels as 2000 stamps have.
            let tolerance = 4.5 * error + 0.01 * plain;
            assert!((found - mean).abs() < tolerance, "{found} {mean} ± {error}");
            assert!(error < 0.2 * plain, "{error} {plain}");
        }
    }
    largest
}

#[test]
fn turned_noise_is_the_geometric_mean_of_both_powers_less_one() {
    for (n, p) in [(40, 11), (33, 10)] {
        let plan = Spectral::new(n, p, &settings(1000, 1.5, 8.0, 0.0)).unwrap();
        let straight = psf(p);
        // Of even and odd sides alike: about the middle of its stamp.
        let rotated = Array2::from_shape_fn((p, p), |(y, x)| straight[(x, p - 1 - y)]);
        let mut scratch = plan.scratch();
        let [straight, rotated] = [straight, rotated].map(|psf| {
            let mut own = plan.psf();
            plan.set_psf(psf.view(), &white(&plan), &mut scratch, &mut own)
                .unwrap();
            own
        });
        let quarter = plan.plane.quarter();
        let modes = |parities: &[f32]| -> Vec<f32> {
            let pairs = (0..quarter).map(|at| [parities[at], parities[quarter + at]]);
            pairs.flat_map(|[cc, ss]| [cc - ss, cc + ss]).collect()
        };
        let [lack, plain] = [&straight.powers.turned, &straight.powers.plain].map(|p| modes(p));
        let there = modes(&rotated.powers.plain);
        let peak = plain.iter().fold(0.0f32, |most, value| most.max(*value));
        let largest = lack.iter().fold(0.0f32, |most, v| most.max(v.abs()));
        assert!(largest > 0.05 * peak, "{largest} {peak}");
        for ((lack, plain), there) in lack.iter().zip(&plain).zip(&there) {
            let expected = (plain * there).max(0.0).sqrt();
            // f32 transforms of two PSFs, divided by modes of which some are small.
            assert!(
                (plain + lack - expected).abs() < 1e-3 * peak,
                "{plain} {lack} {expected}"
            );
        }
    }
}

#[test]
fn unusable_sizes_and_psfs_are_refused() {
    let settings = settings(10, 1.5, 3.0, 0.0);
    assert!(Spectral::new(65, 15, &settings).is_err());
    assert!(Spectral::new(32, 49, &settings).is_err());
    let plan = Spectral::new(32, 7, &settings).unwrap();
    let (mut own, mut scratch) = (plan.psf(), plan.scratch());
    let mut bad = psf(7);
    assert!(
        plan.set_psf(psf(9).view(), &white(&plan), &mut scratch, &mut own)
            .is_err()
    );
    bad[(2, 3)] = f64::NAN;
    let error = plan
        .set_psf(bad.view(), &white(&plan), &mut scratch, &mut own)
        .unwrap_err();
    assert!(error.to_string().contains("pixel (4, 3)"), "{error}");
}

/// Weights of the lags that are the same at opposite lags.
fn even(plan: &Spectral, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let lattice = plan.lattice();
    let weights = lattice.places().map(|place| {
        let weight = rng.random_range(-1.0..1.0);
        if lattice.contains(place) { weight } else { 0.0 }
    });
    let mut weights: Vec<f32> = weights.collect();
    let zero = zero_lag(plan);
    for lag in 1..=zero {
        weights[zero - lag] = weights[zero + lag];
    }
    weights
}

/// Sum of products over all lags: a place below the first row stands for two.
fn over_lags(plan: &Spectral, weights: &[f32], values: &[f32]) -> f64 {
    let products = weights.iter().zip(values).enumerate();
    products
        .map(|(at, (w, v))| {
            let count = if at < plan.lattice().width() {
                1.0
            } else {
                2.0
            };
            count * f64::from(*w) * f64::from(*v)
        })
        .sum()
}

/// Writes how the autocorrelation of the stamp last given changes with a change of v̂ in `scratch.windowed`.
fn take_change(plan: &Spectral, which: usize, scratch: &mut SpectralScratch, out: &mut [f32]) {
    let SpectralScratch {
        windowed,
        stamp,
        even,
        lags,
        ..
    } = scratch;
    let nothing = vec![0.0; even.len()];
    change_of_power(stamp, &windowed[which], &plan.scale, &nothing, 0.0, even);
    plan.to_lags.lags(even, lags, out);
}

/// Those with γ₁, with γ₂, behind a turned PSF, and of noise itself.
fn each<T>(changes: &NoiseChanges<T>) -> [&T; 4] {
    let [first, second] = &changes.sheared;
    [first, second, &changes.turned, &changes.plain]
}

/// Calls `visit` for fields of noise of one mode, real and imaginary: with the change of the lags of the stamp last given and
/// of its flux by an amplitude of one, and with the mean square of amplitudes in noise of σ = 1, times the change with γ₁, the
/// change with γ₂, the difference to noise behind a turned PSF, and one.
fn for_each_mode(
    plan: &Spectral,
    psf: &SpectralPsf,
    scratch: &mut SpectralScratch,
    mut visit: impl FnMut(&[f32], f64, [f64; 4]),
) {
    let (width, quarter) = (plan.plane.width, plan.plane.quarter());
    let mut change = plan.lags().acf;
    let mut field = plan.plane.mode_by_mode();
    for at in 0..2 * quarter {
        let (below, x, y) = (at >= quarter, at % width, at % quarter / width);
        // Modes that are stored twice are taken once.
        if plan.counts[at] == 0.0 || (below && (x == 0 || y == 0)) {
            continue;
        }
        let alone = at == 0;
        for phase in [Complex64::ONE, Complex64::I] {
            if alone && phase == Complex64::I {
                continue;
            }
            field.re.fill(0.0);
            field.im.fill(0.0);
            let (re, im) = (phase.re as f32, phase.im as f32);
            (field.re[at], field.im[at]) = (re, im);
            if x == 0 {
                let opposite = plan.plane.place(0, y, true);
                (field.re[opposite], field.im[opposite]) = (re, -im);
            }
            if y == 0 {
                let same = plan.plane.place(x, 0, true);
                (field.re[same], field.im[same]) = (re, im);
            }
            scratch.windowed[0].take_modes(&field);
            plan.window
                .apply(&mut scratch.windowed[0], &mut scratch.quarter);
            let flux = f64::from(scratch.windowed[0].sum());
            take_change(plan, 0, scratch, &mut change);
            // Half of the power of a mode is that of its real part; but for the mean, which has no other.
            let share = if alone { 1.0 } else { 0.5 };
            let powers = each(&psf.powers).map(|power| {
                let [cc, ss] = [0, quarter].map(|part| power[part + at % quarter]);
                let power = if below { cc + ss } else { cc - ss };
                share * f64::from(power / plan.counts[at])
            });
            visit(&change, flux, powers);
        }
    }
}

#[test]
fn mean_products_are_sums_over_modes_of_what_each_changes() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let settings = settings(400, 1.5, 6.0, 1e-4);
    let h = psf(31);
    let (plan, psf, mut scratch) = planned(32, &h, &settings);
    for centre in [[0.0, 0.0], [1.5, -2.0]] {
        plan.place_window(centre, centre, &mut scratch);
        let stamp = observed(32, &h, 0.0, 0.0);
        let mut lags = plan.lags();
        plan.autocorrelate(&psf, &stamp, 0.0, &mut scratch, &mut lags);
        let weights: [Vec<f32>; 5] = std::array::from_fn(|_| even(&plan, &mut rng));
        let spectra = weights
            .each_ref()
            .map(|weights| plan.spectrum_of(weights, &mut scratch));
        let spectra = spectra.each_ref().map(|spectrum| &spectrum[..]);
        let found = plan.products(&psf, spectra, &mut scratch);
        let mut expected = [[0.0f64; 4]; 13];
        let mut sizes = [0.0f64; 13];
        for_each_mode(&plan, &psf, &mut scratch, |change, flux, powers| {
            let of = |weights: &Vec<f32>| over_lags(&plan, weights, change);
            let [a, b, light, c, d] = weights.each_ref().map(of);
            let quantities = [a, b, flux, c];
            let pairs = (0..4).flat_map(|k| quantities[k..].iter().map(move |q| quantities[k] * q));
            let products = pairs.chain([a * light, b * light, c * d]);
            let rows = expected.iter_mut().zip(&mut sizes).zip(products);
            for ((expected, size), product) in rows {
                for (sum, power) in expected.iter_mut().zip(powers) {
                    *sum += power * product;
                    *size = size.max(sum.abs());
                }
            }
        });
        let pairs = (0..4).flat_map(|a| (a..4).map(move |b| [a, b]));
        let found = pairs
            .map(|pair| found.pairs[pair])
            .chain(found.with_divisors);
        for ((found, expected), size) in found.zip(expected).zip(sizes) {
            for (found, expected) in each(&found).into_iter().zip(expected) {
                // A thousand terms of both signs in single precision.
                let difference = (f64::from(*found) - expected).abs();
                assert!(difference < 1e-4 * size, "{found} {expected} {size}");
            }
        }
    }
}

#[test]
fn mean_second_derivatives_are_sums_of_differences_over_modes() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let n = 32;
    let round = Array2::from_shape_fn((9, 9), |(y, x)| {
        let (x, y) = (x as f64 - 4.0, y as f64 - 4.0);
        (-(1.05 * x * x + 0.95 * y * y) / 4.0).exp()
    });
    let round = &round / round.sum();
    let settings = settings(1000, 1.5, 5.0, 0.0);
    // Noise of the stamp, whose galaxy has a peak of some 0.3, and the regularisation in units of the divisor.
    for (h, level, share) in [
        (psf(9), 0.0, 0.0),
        (psf(9), 0.02, 0.3),
        (round.clone(), 0.005, 0.1),
        (round, 0.03, 0.5),
    ] {
        let (plan, own, mut scratch) = planned(n, &h, &settings);
        let typical = TypicalGalaxy {
            variance: 4.0,
            target: 1.5,
            window: 5.0,
        };
        let moments = RoundMoments::new(2.0, typical, plan.lattice());
        let sizes = SizeMoments::new(1.5, 5.0, plan.lattice());
        let noise = noise(n, &mut rng);
        let stamp = observed(n, &h, 0.0, 0.0);
        let stamp: Vec<f32> = stamp
            .iter()
            .zip(noise)
            .map(|(v, x)| v + level * x)
            .collect();
        let mut lags = plan.lags();
        plan.autocorrelate(&own, &stamp, level, &mut scratch, &mut lags);
        let acf = lags.acf.clone();
        let regularisation = share * moments.sums(&acf)[0];
        let [e1, e2] = moments.measure(&acf, regularisation).unwrap();
        let floor = share * sizes.sums(&acf)[0];
        let mean_square = sizes.measure(&acf, floor, 20.0);

        let mut spectrum = |weights: Vec<f32>| plan.spectrum_of(&weights, &mut scratch);
        let [light, plus, cross] = moments.gradients().map(&mut spectrum);
        let [zero, two] = sizes.gradients().map(&mut spectrum);
        let parts = [
            (e1, &light, plus),
            (e2, &light, cross),
            (mean_square, &zero, two),
        ];
        let [of_e1, of_e2, of_square] = parts.map(|(ratio, divisor, dividend)| {
            let terms = divisor.iter().zip(dividend);
            let change: Vec<f32> = terms.map(|(zero, top)| ratio.change(*zero, top)).collect();
            change
        });
        let spectra = [&of_e1[..], &of_e2, &light, &of_square, &zero];
        let found = plan.products(&own, spectra, &mut scratch);

        let mut expected = [[0.0f64; 3]; 4];
        let mut size = [[0.0f64; 3]; 4];
        let most = |lags: &[f32]| lags.iter().fold(0.0f32, |most, v| most.max(v.abs()));
        let peak = most(&acf);
        for_each_mode(&plan, &own, &mut scratch, |change, _, powers| {
            let step = 0.01 * peak / most(change);
            let side = |step: f32| {
                let acf: Vec<f32> = acf.iter().zip(change).map(|(a, c)| a + step * c).collect();
                let found = moments.measure(&acf, regularisation).unwrap();
                let [e1, e2] = moments.response(&found, change);
                let square = sizes.response(sizes.measure(&acf, floor, 20.0), change);
                [e1, e2, f64::from(square)]
            };
            let (plus, minus) = (side(step), side(-step));
            for (kind, power) in powers.into_iter().enumerate() {
                for k in 0..3 {
                    let term = power * (plus[k] - minus[k]) / (2.0 * f64::from(step));
                    expected[kind][k] += term;
                    size[kind][k] += term.abs();
                }
            }
        });
        for kind in 0..4 {
            let of_kind = |product: NoiseChanges<f32>| *each(&product)[kind];
            let products = found.with_divisors.map(of_kind);
            let ratios = [e1, e2, mean_square].into_iter().zip(products);
            let found = ratios.map(|(ratio, product)| ratio.mean_second_derivative(product));
            for (k, found) in found.enumerate() {
                let (expected, size) = (expected[kind][k], size[kind][k]);
                // Third derivatives, and differences of f32.
                assert!(
                    (found - expected).abs() < 2e-3 * size,
                    "{level} {kind} {k}: {found} {expected} of {size}"
                );
            }
        }
    }
}
