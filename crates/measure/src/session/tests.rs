//! Images from their stamps to rows and warnings.

use ndarray::{Array3, s};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};
use shearq_submissions::Registry;

use super::*;
use crate::testing::close;

fn moffat(e1: f64) -> FunctionalPsf {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    FunctionalPsf::new(profile, 3.4, Shear::new(e1, 0.0)).unwrap()
}

/// Elongated galaxies, every one a little more than the one before.
fn stamps(count: usize, side: usize) -> Array3<f32> {
    let middle = (side as f32 - 1.0) / 2.0;
    Array3::from_shape_fn((count, side, side), |(k, y, x)| {
        let (y, x) = (y as f32 - middle, x as f32 - middle);
        100.0 * (-(x * x / (9.0 + 0.5 * k as f32) + y * y / 9.0)).exp()
    })
}

/// Stars of S/N 100, one per galaxy. Uniform noise: enough for a test of who gets what.
fn noisy_stars(count: usize) -> Array3<f32> {
    let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::ZERO).unwrap();
    let psf = psf.stamp(48).mapv(|v| v as f32);
    let half = 3f32.sqrt() * psf.mapv(|v| v * v).sum().sqrt() / 100.0;
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    Array3::from_shape_fn((count, 48, 48), |(_, y, x)| {
        psf[(y, x)] + rng.random_range(-half..half)
    })
}

/// The galaxies of an image and of its further epochs.
fn with_epochs<'a>(
    measurer: &Measurer,
    [mut first, mut second]: [ArraySource<'a>; 2],
    [noise, second_noise]: [KnownNoise<'a>; 2],
) -> Batch {
    let session = Session::open(measurer, &mut first, noise, &OneThread).unwrap();
    let other = Session::open(measurer, &mut second, second_noise, &OneThread).unwrap();
    let session = Arc::new(session.with_epochs(vec![other]).unwrap());
    let mut image = Arc::clone(&session).begin().unwrap();
    let mut worker = measurer.worker();
    let others = std::slice::from_mut(&mut second);
    for row in 0..session.rows().len() {
        let job = session.read_epochs(&mut first, others, row).unwrap();
        image.add(job.measure_row(&mut worker).unwrap());
    }
    image.finish()
}

fn message<T>(result: Result<T, MeasureError>, expected: &str) {
    let Err(error) = result else {
        panic!("nothing wrong; expected {expected}")
    };
    assert!(error.to_string().contains(expected), "{error}");
}

#[test]
fn noise_that_is_treated_as_white_is_tested_on_arrays() {
    let mut rng = ChaCha8Rng::seed_from_u64(21);
    let white = Array3::from_shape_fn((200, 49, 49), |_| rng.random_range(-1.0..1.0f32));
    let summed = Array3::from_shape_fn((200, 48, 48), |(k, y, x)| {
        white.slice(s![k, y..y + 2, x..x + 2]).sum()
    });
    let plain = white.slice(s![.., ..48, ..48]);
    let star = moffat(0.0).stamp(48);
    let registry = Registry::embedded().unwrap();
    let named = registry.get("48/linear/star").unwrap().configuration;
    let of_noise = |noise: NoiseSource| Configuration {
        noise,
        ..named.clone()
    };
    let correlation = |correlation: usize| match named.noise {
        NoiseSource::Image { sky, .. } => of_noise(NoiseSource::Image { correlation, sky }),
        _ => unreachable!("it measures noise on the stamps"),
    };
    for (configuration, treats_as_white) in [
        (correlation(0), true),
        (of_noise(NoiseSource::Header), true),
        (correlation(2), false),
    ] {
        let measurer = Measurer::new(&configuration, 48).unwrap();
        for (stamps, is_correlated) in [(plain, false), (summed.view(), true)] {
            let batch = measurer
                .batch(stamps, &Psfs::star(star.view()), Some(2.0))
                .unwrap();
            let found = batch.warnings.iter().find_map(|warning| match warning {
                Warning::CorrelatedNoise { correlation } => Some(*correlation),
                _ => None,
            });
            assert_eq!(
                found.is_some(),
                treats_as_white && is_correlated,
                "{configuration:?}"
            );
            // Of sums of 2 × 2 pixels.
            for of_neighbours in found.into_iter().flatten() {
                close(of_neighbours, 0.5, 0.03);
            }
        }
    }
}

#[test]
fn batches_are_stamps_with_their_mean_response() {
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let (stamps, psf) = (stamps(6, 48), moffat(0.02));
    let star = psf.stamp(40);
    let batch = measurer.batch(stamps.view(), &Psfs::star(star.view()), Some(0.5));
    let batch = batch.unwrap();
    let response = batch.response.unwrap();
    let mut means = [0.0; 2];
    for (stamp, galaxy) in stamps.outer_iter().zip(&batch.galaxies) {
        let double = stamp.mapv(f64::from);
        let one = measurer
            .stamp(double.view(), star.view(), Some(0.5))
            .unwrap();
        assert_eq!(one.response, galaxy.response);
        assert_eq!(one.e1, galaxy.e1);
        means = [0, 1].map(|k| means[k] + one.response_diagonal()[k] / 6.0);
    }
    assert!((means[0] / response[0] - 1.0).abs() < 1e-12);
    assert!((means[1] / response[1] - 1.0).abs() < 1e-12);
    let increase = batch
        .galaxies
        .windows(2)
        .all(|pair| pair[0].e1 < pair[1].e1);
    assert!(increase, "{:?}", batch.galaxies);
}

#[test]
fn psfs_one_each_are_each_galaxys_own() {
    let measurer = Measurer::named("23/raw/star", 48).unwrap();
    let stamps = stamps(3, 48);
    let formulas = [0.0, 0.1, -0.1].map(moffat);
    let mut stars = Array3::<f32>::zeros((3, 26, 26));
    for (formula, mut star) in formulas.iter().zip(stars.outer_iter_mut()) {
        star.assign(&formula.stamp(26).mapv(|v| v as f32));
    }
    let batch = measurer
        .batch(stamps.view(), &Psfs::stars(stars.view()), None)
        .unwrap();
    assert_eq!(batch.response, None);
    for (k, galaxy) in batch.galaxies.iter().enumerate() {
        let (stamp, star) = (stamps.slice(s![k, .., ..]), stars.slice(s![k, .., ..]));
        let one = measurer.stamp(stamp, star, None).unwrap();
        assert_eq!(
            (one.e1, one.e2, one.size),
            (galaxy.e1, galaxy.e2, galaxy.size)
        );
    }
    let functional = Psfs::functional(&formulas);
    let drawn = measurer.batch(stamps.view(), &functional, None).unwrap();
    for (drawn, star) in drawn.galaxies.iter().zip(&batch.galaxies) {
        // Light beyond the 15 px of the submission, which each is normalised without.
        assert!((drawn.e1 - star.e1).abs() < 1e-3, "{drawn:?} {star:?}");
    }
}

#[test]
fn noisy_stars_one_each_share_what_they_have_in_common() {
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let stars = noisy_stars(80);
    let (stamps, psfs) = (stamps(80, 48), Psfs::stars(stars.view()));
    let batch = measurer.batch(stamps.view(), &psfs, Some(0.5)).unwrap();
    let mut worker = measurer.worker();
    let of = |mut image: ImageWorker<'_>| {
        let found = image
            .measure_stamps(stamps.view(), &psfs, None, None)
            .unwrap();
        found.iter().map(|one| one.response).collect::<Vec<_>>()
    };
    let of_batch: Vec<_> = batch.galaxies.iter().map(|one| one.response).collect();
    let session = |measurer: &Measurer| {
        let mut source = ArraySource::new(measurer, stamps.view(), &psfs).unwrap();
        Session::open(measurer, &mut source, KnownNoise::Given(0.5), &OneThread).unwrap()
    };
    assert_eq!(of(session(&measurer).image(&mut worker)), of_batch);
    // The next image knows nothing of it.
    assert_ne!(of(worker.image(ImageNoise::Level(0.5))), of_batch);
}

#[test]
fn noisy_stars_of_epochs_share_what_they_have_in_common() {
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let (stamps, stars) = (stamps(80, 48), noisy_stars(80));
    let psfs = Psfs::stars(stars.view());
    let source = || ArraySource::new(&measurer, stamps.view(), &psfs).unwrap();
    let noise = || KnownNoise::Given(0.5);
    let epochs = with_epochs(&measurer, [source(), source()], [noise(), noise()]);
    // Two equal epochs are an image of half the variance.
    let level = 0.5 / 2f64.sqrt();
    let image = measurer.batch(stamps.view(), &psfs, Some(level)).unwrap();
    let mut worker = measurer.worker();
    let mut alone = worker.image(ImageNoise::Level(level));
    let alone = alone
        .measure_stamps(stamps.view(), &psfs, None, None)
        .unwrap();
    let distance = |galaxies: &[Measurement]| -> f64 {
        let pairs = galaxies.iter().zip(&image.galaxies);
        pairs
            .map(|(a, b)| (a.response_diagonal()[0] - b.response_diagonal()[0]).abs())
            .sum()
    };
    let (shared, alone) = (distance(&epochs.galaxies), distance(&alone));
    assert!(shared < 0.1 * alone, "{shared} {alone}");
}

#[test]
fn stated_noise_does_not_replace_a_failed_survey_of_an_epoch() {
    let measurer = Measurer::named("48/linear/star", 64).unwrap();
    let (stamps, star) = (stamps(4, 64), moffat(0.02).stamp(48));
    let psfs = Psfs::star(star.view());
    // Too many missing pixels for a survey, but none among the 48 that are cut.
    let mut framed = Array3::from_elem((4, 64, 64), f32::NAN);
    let inner = s![.., 8..56, 8..56];
    framed.slice_mut(inner).assign(&stamps.slice(inner));
    let source = |stamps| ArraySource::new(&measurer, stamps, &psfs).unwrap();
    let found = with_epochs(
        &measurer,
        [source(stamps.view()), source(framed.view())],
        [KnownNoise::Given(0.5), KnownNoise::Stated(0.5)],
    );
    let left_out = Warning::Epoch {
        epoch: 2,
        warning: Box::new(Warning::EpochNoNoise),
    };
    assert!(found.warnings.contains(&left_out), "{:?}", found.warnings);
    for galaxy in &found.galaxies {
        assert_eq!(galaxy.noise, 0.5);
    }
}

#[test]
fn unmeasurable_stamps_are_errors_alone_and_flags_in_batches() {
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let mut stamps = stamps(3, 48);
    // Both sides of the galaxy.
    stamps[(1, 7, 5)] = f32::NAN;
    stamps.slice_mut(s![1, 23..25, ..]).fill(f32::NAN);
    let star = moffat(0.0).stamp(32);
    let bad = stamps.slice(s![1, .., ..]);
    message(
        measurer.stamp(bad, star.view(), Some(1.0)),
        "pixel (6, 8) of the stamp, counted from 1, is not a finite number",
    );
    let mut stars = Array3::zeros((3, 32, 32));
    stars.slice_mut(s![0, .., ..]).assign(&star);
    stars.slice_mut(s![1, .., ..]).assign(&star);
    let batch = measurer.batch(stamps.view(), &Psfs::stars(stars.view()), Some(1.0));
    let flags: Vec<Vec<Flag>> = batch
        .unwrap()
        .galaxies
        .iter()
        .map(|galaxy| galaxy.flags.iter().collect())
        .collect();
    assert_eq!(flags, [vec![], vec![Flag::NotFinite], vec![Flag::BadPsf]]);
}

#[test]
fn linear_methods_measure_without_a_few_pixels() {
    let whole = stamps(2, 48);
    let star = moffat(0.0).stamp(32);
    let mut holed = whole.clone();
    holed.slice_mut(s![.., 19..22, 26..29]).fill(f32::NAN);
    let measured = |configuration: &str, stamps: &Array3<f32>| {
        let measurer = Measurer::named(configuration, 48).unwrap();
        let psf = &Psfs::star(star.view());
        measurer.batch(stamps.view(), psf, Some(1.0)).unwrap()
    };
    let linear = "48/linear/star";
    let (found, expected) = (measured(linear, &holed), measured(linear, &whole));
    for (found, expected) in found.galaxies.iter().zip(&expected.galaxies) {
        assert!(found.flags.is_empty());
        // Without noise, and the same turned by 180 degrees.
        close(found.e1, expected.e1, 1e-3);
        close(found.e2, expected.e2, 1e-3);
    }
    // Pixels beyond the 48 that are cut are not looked at.
    let (mut holed, mut framed) = (stamps(2, 64), stamps(2, 64));
    framed.slice_mut(s![.., .., ..8]).fill(f32::NAN);
    framed.slice_mut(s![.., 56.., ..]).fill(f32::NAN);
    let measurer = Measurer::named(linear, 64).unwrap();
    let [whole, framed] = [&holed, &framed].map(|stamps| {
        let psf = &Psfs::star(star.view());
        measurer.batch(stamps.view(), psf, Some(1.0)).unwrap()
    });
    for (whole, framed) in whole.galaxies.iter().zip(&framed.galaxies) {
        assert_eq!((whole.e1, whole.e2), (framed.e1, framed.e2));
    }
    holed.slice_mut(s![.., 30, 30]).fill(f32::NAN);
    let network = Measurer::named("23/raw/star", 64).unwrap();
    let network = network.batch(holed.view(), &Psfs::star(star.view()), Some(1.0));
    let network = network.unwrap();
    assert!(
        network
            .galaxies
            .iter()
            .all(|galaxy| galaxy.flags.contains(Flag::NotFinite))
    );
}

#[test]
fn wrong_shapes_and_numbers_name_what_was_expected() {
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let (good, star) = (stamps(2, 48), moffat(0.0).stamp(32));
    let one = good.slice(s![0, .., ..]);
    let noise = Some(1.0);
    message(
        Measurer::named("48/linear/star", 40),
        "stamps of 40 × 40 pixels; expected at least 48 × 48",
    );
    message(
        Measurer::named("48/linear/stra", 48),
        "no configuration or file named",
    );
    let narrow = one.slice(s![.., ..46]);
    message(
        measurer.stamp(narrow, star.view(), noise),
        "a stamp of 48 × 46 pixels; expected 48 × 48",
    );
    let small = star.slice(s![..30, ..]);
    message(
        measurer.stamp(one, small, noise),
        "a PSF stamp of 30 × 32 pixels; expected at least 32 × 32",
    );
    let stars = Array3::<f32>::zeros((3, 32, 32));
    message(
        measurer.batch(good.view(), &Psfs::stars(stars.view()), noise),
        "PSFs of 3 galaxies; expected 2, one each",
    );
    message(
        measurer.batch(good.view(), &Psfs::prepared(star.slice(s![1.., ..])), noise),
        "a PSF stamp of 31 × 32 pixels; expected an even number a side, 32 to 48",
    );
    for (level, found) in [
        (None, "not given"),
        (Some(f64::NAN), "NaN"),
        (Some(-1.0), "-1"),
    ] {
        let expected = format!("the noise level is {found}; expected a finite number");
        message(measurer.stamp(one, star.view(), level), &expected);
    }
    let mut dead = star.clone();
    dead[(3, 2)] = f64::INFINITY;
    message(
        measurer.batch(good.view(), &Psfs::star(dead.view()), noise),
        "pixel (3, 4) of the PSF stamp",
    );
}

#[test]
fn noise_taken_as_white_is_tested_up_to_two_pixels() {
    let text = "extends = \"48/linear/star\"\n[noise]\ncorrelation = 0\n";
    let measurer = Measurer::new(&text.parse().unwrap(), 48).unwrap();
    let star = moffat(0.0).stamp(48);
    let mut state = 5;
    // Correlated by 0.08 at a distance along x: so little that the polynomials, which spread it to other lags, do not matter.
    let mut warns = |distance: usize| {
        let mut noise = Array3::from_shape_fn((40, 48, 51), |_| {
            crate::random::uniform(&mut state) as f32 - 0.5
        });
        let other = noise.clone();
        let width = 51 - distance;
        let mut own = noise.slice_mut(s![.., .., ..width]);
        own.scaled_add(0.08, &other.slice(s![.., .., distance..]));
        let stamps = stamps(40, 48) * 0.1 + noise.slice(s![.., .., ..48]);
        let psfs = Psfs::star(star.view());
        let mut source = ArraySource::new(&measurer, stamps.view(), &psfs).unwrap();
        let session = Session::open(&measurer, &mut source, KnownNoise::Unknown, &OneThread);
        let warning = session.unwrap().correlated_noise(&mut source, &OneThread);
        warning.unwrap().is_some()
    };
    assert_eq!([2, 3].map(&mut warns), [true, false]);
}

#[test]
fn hints_of_warnings_are_known_apart_from_their_texts() {
    let warning = Warning::Epoch {
        epoch: 2,
        warning: Box::new(Warning::EpochNoNoise),
    };
    let hint = Some("check the file, its extension and its mask".to_owned());
    assert_eq!(warning.hint(), hint);
    let text = warning.to_string();
    assert!(text.starts_with("epoch 2: cannot measure the noise"));
    assert!(text.ends_with("left out. Try: check the file, its extension and its mask"));
    assert_eq!(MeasureError::Data(warning).hint(), hint);
}

#[test]
fn errors_of_reading_are_not_taken_for_small_stamps() {
    let registry = Registry::embedded().unwrap();
    let named = registry.get("48/linear/star").unwrap().configuration;
    let configuration = Configuration {
        noise: NoiseSource::Header,
        ..named
    };
    let measurer = Measurer::new(&configuration, 48).unwrap();
    let (stamps, star) = (noisy_stars(40), moffat(0.0).stamp(48));
    let psfs = Psfs::star(star.view());
    let mut source = ArraySource::new(&measurer, stamps.view(), &psfs).unwrap();
    let noise = KnownNoise::Given(0.01);
    let session = Session::open(&measurer, &mut source, noise, &OneThread).unwrap();
    assert!(session.noise_plan().is_none());
    let mut broken = ArraySource::from_fn(
        40,
        |_| Err(MeasureError::Data(Warning::NoNoise)),
        |_| unreachable!(),
        None,
    );
    let found = session.correlated_noise(&mut broken, &OneThread);
    assert!(matches!(found, Err(MeasureError::Data(Warning::NoNoise))));
}

#[test]
fn stated_noise_may_differ_by_one_percent() {
    for (difference, expected) in [(0.008, false), (0.012, true)] {
        let found = stated_noise(1.0 / (1.0 + difference), &StampNoise::white(1.0));
        assert_eq!(found.is_some(), expected, "{difference}");
    }
}

#[test]
fn residuals_of_steps_have_no_sky() {
    let registry = Registry::embedded().unwrap();
    let mut configuration = registry.get("48/linear/star").unwrap().configuration;
    let NoiseSource::Image { sky, .. } = &mut configuration.noise else {
        unreachable!("it measures noise on the stamps")
    };
    *sky = shearq_submissions::SkySource::Stamp;
    let measurer = Measurer::new(&configuration, 48).unwrap();
    let star = moffat(0.0).stamp(48);
    let psfs = Psfs::star(star.view());
    let residual = |sky: f32| {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let stamps = stamps(40, 48).mapv(|value| value + sky + rng.random_range(-1.0..1.0f32));
        let mut source = ArraySource::new(&measurer, stamps.view(), &psfs).unwrap();
        let noise = KnownNoise::Given(0.5);
        let session = Session::open(&measurer, &mut source, noise, &OneThread).unwrap();
        let (_, steps) = session.steps(&mut source, 0, 0).unwrap();
        steps.unwrap().residual
    };
    let differences = residual(0.0) - residual(20.0);
    assert!(differences.iter().all(|own| own.abs() < 1e-3));
}
