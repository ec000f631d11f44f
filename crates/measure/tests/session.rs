//! A session gives the same for any threads, and rows of any precision.

#![expect(clippy::unwrap_used, reason = "a test fails by a panic")]

use ndarray::Array3;
use shearq_measure::{
    ArraySource, Batch, FunctionalPsf, KnownNoise, Measurement, Measurer, OneThread, PsfProfile,
    Psfs, ResponseMatrix, Shear, Threads, Warning, ndarray,
};

/// Threads that are done in the opposite order.
struct Backwards(usize);

impl Threads for Backwards {
    fn count(&self) -> usize {
        self.0
    }

    fn map<T: Send, R: Send>(&self, of: Vec<T>, map: impl Fn(T) -> R + Sync + Send) -> Vec<R> {
        let mut found: Vec<R> = of.into_iter().rev().map(map).collect();
        found.reverse();
        found
    }
}

/// Uniform noise of variance one: enough for a test of who gets what.
fn noise(state: &mut u64) -> f32 {
    *state = state
        .wrapping_mul(6_364_136_223_846_793_005)
        .wrapping_add(1_442_695_040_888_963_407);
    12f32.sqrt() * ((*state >> 40) as f32 / (1u64 << 24) as f32 - 0.5)
}

/// Galaxies on a sky with a gradient, and a noisy star for each of them.
fn data(count: usize) -> (Array3<f32>, Array3<f32>) {
    let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::ZERO).unwrap();
    let psf = psf.stamp(48).mapv(|v| v as f32);
    let sigma = psf.mapv(|v| v * v).sum().sqrt() / 100.0;
    let mut state = 5;
    let stars = Array3::from_shape_fn((count, 48, 48), |(_, y, x)| {
        psf[(y, x)] + sigma * noise(&mut state)
    });
    let stamps = Array3::from_shape_fn((count, 48, 48), |(k, y, x)| {
        let (dy, dx) = (y as f32 - 23.5, x as f32 - 23.5);
        let light = 15.0 * (-(dx * dx / (14.0 + (k % 5) as f32) + dy * dy / 15.0)).exp();
        light + 0.6 + 0.01 * dx + noise(&mut state)
    });
    (stamps, stars)
}

fn measured(
    measurer: &Measurer,
    stamps: &Array3<f32>,
    psfs: &Psfs<'_>,
    noise: KnownNoise<'_>,
    threads: &impl Threads,
) -> Batch {
    let mut source = ArraySource::new(measurer, stamps.view(), psfs).unwrap();
    measurer.measure_image(&mut source, noise, threads).unwrap()
}

/// What depends on every step; other numbers may be NaN, which is not equal to itself.
fn shapes(batch: &Batch) -> Vec<(f64, f64, Option<ResponseMatrix>)> {
    let shape = |galaxy: &Measurement| {
        assert!(galaxy.flags.is_empty(), "{galaxy:?}");
        (galaxy.e1, galaxy.e2, galaxy.response)
    };
    batch.galaxies.iter().map(shape).collect()
}

#[test]
fn surveys_do_not_depend_on_threads() {
    let (stamps, stars) = data(500);
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let psfs = Psfs::stars(stars.view());
    let one = measured(&measurer, &stamps, &psfs, KnownNoise::Unknown, &OneThread);
    let sky = |warning: &Warning| {
        matches!(
            warning,
            Warning::Sky {
                subtracted: true,
                ..
            }
        )
    };
    assert!(one.warnings.iter().any(sky), "{:?}", one.warnings);
    for threads in [2, 7, 40] {
        let threads = Backwards(threads);
        let found = measured(&measurer, &stamps, &psfs, KnownNoise::Unknown, &threads);
        assert_eq!(shapes(&found), shapes(&one));
        assert_eq!(found.response, one.response);
        assert_eq!(found.warnings, one.warnings);
    }
    let batch = measurer.batch(stamps.view(), &psfs, None).unwrap();
    assert_eq!(shapes(&batch), shapes(&one));
    let double = stamps.mapv(f64::from);
    let batch = measurer.batch(double.view(), &psfs, None).unwrap();
    assert_eq!(shapes(&batch), shapes(&one));
}

#[test]
fn a_given_level_replaces_the_survey_and_a_stated_one_does_not() {
    let (mut stamps, stars) = data(100);
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let psfs = Psfs::stars(stars.view());
    let of = |stamps: &Array3<f32>, noise: KnownNoise<'_>| {
        measured(&measurer, stamps, &psfs, noise, &OneThread)
    };
    let given = of(&stamps, KnownNoise::Given(1.25));
    assert!(given.galaxies.iter().all(|galaxy| galaxy.noise == 1.25));
    let levels = vec![1.25; 100];
    let each = of(&stamps, KnownNoise::GivenEach(levels.as_slice().into()));
    assert_eq!(shapes(&each), shapes(&given));
    let surveyed = of(&stamps, KnownNoise::Unknown);
    let stated = of(&stamps, KnownNoise::Stated(2.0));
    assert_eq!(shapes(&stated), shapes(&surveyed));
    // Levels of the data beside a survey: sky, galaxies and correlation are those of the survey.
    let levels = vec![surveyed.galaxies[0].noise; 100];
    let each = of(&stamps, KnownNoise::StatedEach(levels.as_slice().into()));
    assert_eq!(shapes(&each), shapes(&surveyed));
    let differs = |warning: &&Warning| matches!(warning, Warning::NoiseLevel { used: true, .. });
    assert_eq!(stated.warnings.iter().filter(differs).count(), 1);
    // Without a stamp to survey, a stated level measures nothing.
    stamps.fill(f32::NAN);
    let blind = of(&stamps, KnownNoise::Stated(1.0));
    assert!(blind.warnings.contains(&Warning::NoNoise));
    assert!(blind.all_flagged().is_some());
}

#[test]
fn stamps_with_missing_borders_are_measured_inside_of_them() {
    let (mut stamps, stars) = data(100);
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let psfs = Psfs::stars(stars.view());
    let of =
        |stamps: &Array3<f32>| measured(&measurer, stamps, &psfs, KnownNoise::Unknown, &OneThread);
    let whole = of(&stamps);
    for width in [1, 3] {
        for ((_, y, x), value) in stamps.indexed_iter_mut() {
            if [x, y].iter().any(|at| *at < width || *at >= 48 - width) {
                *value = f32::NAN;
            }
        }
        let found = of(&stamps);
        shapes(&found);
        let ratio = found.galaxies[0].noise / whole.galaxies[0].noise;
        assert!((ratio - 1.0).abs() < 0.03, "{width}: {ratio}");
        let (count, of) = (100, 100);
        let expected = Warning::MissingBorder { width, count, of };
        assert!(found.warnings.contains(&expected), "{:?}", found.warnings);
    }
}

#[test]
fn no_stamps_are_an_empty_batch() {
    let measurer = Measurer::named("48/linear/star", 48).unwrap();
    let (stamps, stars) = data(0);
    let psfs = Psfs::stars(stars.view());
    let batch = measurer.batch(stamps.view(), &psfs, None).unwrap();
    assert!(batch.galaxies.is_empty() && batch.all_flagged().is_none());
}
