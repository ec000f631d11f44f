//! Warnings about stamps and epochs, and their texts.

use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::sky::Sky;
use crate::testing::close;

const N: usize = 48;

/// A Gaussian of 3 px on a stamp with a plane under it.
fn stamp(level: f32, slope: [f32; 2], centre: [f32; 2]) -> Array2<f32> {
    Array2::from_shape_fn((N, N), |(y, x)| {
        let (x, y) = (x as f32 - 23.5, y as f32 - 23.5);
        let (dx, dy) = (x - centre[0], y - centre[1]);
        10.0 * (-(dx * dx + dy * dy) / 18.0).exp() + level + slope[0] * x + slope[1] * y
    })
}

#[test]
fn a_stamp_shows_its_level_slope_and_centre() {
    let mut examination = Examination::new(N, 1);
    let stamp = stamp(0.5, [0.01, -0.02], [0.75, -0.5]);
    examination.add_at(stamp.view(), [0.75, 0.0]).unwrap();
    let stamp = examination.stamps[0];
    // In single precision.
    assert!((stamp.corner - 0.5).abs() < 1e-5, "{stamp:?}");
    assert!((stamp.slope[0] - 0.01).abs() < 1e-6, "{stamp:?}");
    assert!((stamp.slope[1] + 0.02).abs() < 1e-6, "{stamp:?}");
    assert!(stamp.noise[0] < 1e-4 && stamp.noise[1] < 1e-4, "{stamp:?}");
    // Centroids fall short of the centre, and planes pull them.
    assert!(stamp.place[0].abs() < 0.15, "{stamp:?}");
    assert!((stamp.place[1] + 0.5).abs() < 0.15, "{stamp:?}");
}

#[test]
fn a_corner_with_missing_pixels_is_left_out() {
    let mut examination = Examination::new(N, 1);
    let mut stamp = stamp(0.5, [0.0; 2], [0.0; 2]);
    stamp[(1, 1)] = f32::NAN;
    stamp[(46, 2)] = 1e4;
    examination.add(stamp.view()).unwrap();
    assert!((examination.stamps[0].corner - 0.5).abs() < 1e-5);
    assert!(median_ignoring_nan(&mut [f64::NAN; 4]).is_nan());
    assert_eq!(
        median_ignoring_nan(&mut [3.0, -f64::NAN, f64::NAN, 1.0]),
        2.0
    );
    assert_eq!(median_ignoring_nan(&mut [4.0, 1.0, 9.0, 2.0]), 3.0);
}

#[test]
fn a_missing_pixel_changes_nothing_about_a_plane() {
    let pixels = stamp(0.5, [0.02, -0.01], [0.0; 2]);
    let mut pixels = pixels.into_raw_vec_and_offset().0;
    let whole = block(&pixels, N, 8, (0, 0));
    pixels[N + 1] = f32::NAN;
    pixels[6 * N + 6] = f32::INFINITY;
    let most = block(&pixels, N, 8, (0, 0));
    assert!((most.mean - whole.mean).abs() < 1e-6, "{most:?} {whole:?}");
    // Two of 64 pixels on the plane's mean: their share of its slope's square, 0.03.
    assert!(most.variance < 1e-4, "{most:?}");
    for pixel in pixels.iter_mut().take(5 * N) {
        *pixel = f32::NAN;
    }
    let few = block(&pixels, N, 8, (0, 0));
    assert!(few.mean.is_nan() && few.variance.is_nan());
}

/// Bright pixels in the noise of corners, of which one pixel or all are missing.
fn without_corners(all: bool) -> Examination {
    let mut examination = Examination::new(N, 8);
    for k in 0..8u8 {
        let mut stamp = stamp(0.0, [0.0, 0.0], [0.1 * f32::from(k), 0.0]);
        stamp[(5, 4)] += 10.0;
        for ((y, x), value) in stamp.indexed_iter_mut() {
            let away = |at: usize| at.min(N - 1 - at);
            let missing = if all {
                away(x) < 8 && away(y) < 8
            } else {
                away(x) == 1 && away(y) == 1
            };
            if missing {
                *value = f32::NAN;
            }
        }
        examination.add(stamp.view()).unwrap();
    }
    examination
}

#[test]
fn noise_is_that_of_the_pixels_that_corners_have() {
    let Estimate {
        value: noise,
        error,
    } = without_corners(false).noise();
    // One pixel of 10 among the 63 of a corner, in the mean with three corners without noise: √(10² / 60 / 4).
    assert!((noise - 0.645).abs() < 0.03, "{noise}");
    assert!(error.is_finite());
}

#[test]
fn of_stamps_without_corners_all_but_noise_and_sky_is_told() {
    let examination = without_corners(true);
    assert!(examination.noise().value.is_nan());
    let sky = Sky {
        level: 0.1,
        level_error: 0.01,
        slope: [0.01, 0.0],
        slope_error: 0.001,
    };
    let subtracted = examination.clone().without(SkySubtraction::Plane(sky));
    for warning in [examination.warnings(), subtracted.warnings()].concat() {
        let text = warning.to_string();
        assert!(!text.contains("inf") && !text.contains("NaN"), "{text}");
    }
    assert!(examination.core().is_none() && examination.stamps.len() < MIN_GALAXIES_CORE);
    assert!(examination.stamps.iter().all(|stamp| stamp.flux > 100.0));
}

#[test]
fn examinations_joined_are_one() {
    let [mut one, mut first, mut second] = [(); 3].map(|()| Examination::new(N, 8));
    for k in 0..8 {
        let stamp = stamp(0.5 + 0.1 * k as f32, [0.02, 0.0], [0.1 * k as f32, 0.0]);
        one.add(stamp.view()).unwrap();
        let part = if k < 3 { &mut first } else { &mut second };
        part.add(stamp.view()).unwrap();
    }
    first.join(&second);
    assert_eq!(first.warnings(), one.warnings());
    assert!(!one.warnings().is_empty());
}

/// An epoch of galaxies of several fluxes at `centre`, which is expected at `place`, with a PSF at `of_psf`. Its first stamp has
/// no pixels.
fn epoch(centre: [f32; 2], place: [f64; 2], of_psf: [f32; 2], order: [usize; 2]) -> Examination {
    let mut epoch = Examination::new(N, 42);
    let missing = Array2::from_elem((N, N), f32::NAN);
    epoch.add(missing.view()).unwrap();
    epoch.add(missing.view()).unwrap();
    for k in 0..40 {
        let flux = 1.0 + ((order[0] + order[1] * k) % 40) as f32;
        let noise = |at: usize| ((at * at * (k + 1)) % 97) as f32 / 97.0 - 0.5;
        let mut stamp = stamp(0.0, [0.0; 2], centre) * flux;
        let pixels = stamp.iter_mut().enumerate();
        pixels.for_each(|(at, value)| *value += 0.1 * noise(at));
        epoch.add_at(stamp.view(), place).unwrap();
    }
    let star = stamp(0.0, [0.0; 2], of_psf).mapv(f64::from);
    let star = &star / star.sum();
    epoch.add_psf(star.view(), None);
    epoch
}

#[test]
fn psfs_that_galaxies_do_not_follow_are_named() {
    let places = |k: usize| {
        [
            (k * 7 % 40) as f32 / 40.0 - 0.5,
            (k * 13 % 40) as f32 / 40.0 - 0.5,
        ]
    };
    let found = |of_psf: f32, of_galaxy: f32, stated: f32| {
        let mut epoch = Examination::new(N, 40);
        let mut stars = ndarray::Array3::zeros((40, N, N));
        for k in 0..40 {
            let at = |factor: f32| places(k).map(|place| factor * place);
            let noise = |at: usize| ((at * at * (k + 1)) % 97) as f32 / 970.0;
            let mut galaxy = stamp(0.0, [0.0; 2], at(of_galaxy));
            galaxy
                .iter_mut()
                .enumerate()
                .for_each(|(at, value)| *value += noise(at));
            epoch
                .add_at(galaxy.view(), at(stated).map(f64::from))
                .unwrap();
            let star = stamp(0.0, [0.0; 2], at(of_psf)).mapv(f64::from);
            stars.index_axis_mut(ndarray::Axis(0), k).assign(&star);
        }
        epoch.add_psfs(&Psfs::stars(stars), N.into(), 40);
        epoch.scattered_psfs().map(|warning| warning.kind())
    };
    // PSFs and galaxies at their phases, of which the offsets may be stated alone, or those from the PSFs.
    assert_eq!(found(1.0, 1.0, 1.0), Some("scattered-psfs"));
    assert_eq!(found(1.0, 1.0, 0.0), None);
    assert_eq!(found(0.0, 1.0, 1.0), None);
    assert_eq!(found(1.0, 0.0, 0.0), Some("scattered-psfs"));
}

#[test]
fn epochs_that_contradict_the_first_are_named() {
    const SAME: Matrix2 = [[1.0, 0.0], [0.0, 1.0]];
    let dither = [0.5, -0.25];
    let (at, centred) = (dither.map(f64::from), [0.0; 2]);
    let first = epoch([0.0; 2], centred, [0.0; 2], [0, 1]);
    // Stamps without pixels are no copies.
    assert_eq!(first.copies(42), None);
    let kinds = |other: &Examination, axes: Matrix2| {
        let found = other.contradictions(&[&first], axes, true);
        found.iter().map(Warning::kind).collect::<Vec<_>>()
    };
    // Galaxies with a lesser share of noise, so that all are compared.
    let mut scaled = epoch([0.0; 2], centred, [0.0; 2], [0, 1]);
    for stamp in &mut scaled.stamps {
        (stamp.flux, stamp.core[0], stamp.trace) = (2.0 * stamp.flux, 2.0 * stamp.core[0], 0);
    }
    // In other filters, galaxies have other fluxes.
    assert_eq!(scaled.contradictions(&[&first], SAME, false), []);
    for (other, expected) in [
        (epoch(dither, at, [0.0; 2], [0, 1]), &[][..]),
        (epoch(dither, centred, dither, [0, 1]), &[]),
        (
            epoch(dither, at.map(|at| -at), [0.0; 2], [0, 1]),
            &["epoch-offset"],
        ),
        (epoch(dither, at, [1.0, 0.0], [0, 1]), &["epoch-offset"]),
        (epoch(dither, at, [0.0; 2], [39, 39]), &["epoch-galaxies"]),
        (scaled, &["epoch-flux"]),
        (first.clone(), &["epoch-copies"]),
    ] {
        assert_eq!(kinds(&other, SAME), expected);
    }
    // Noise alone, in either of both.
    let mut dark = Examination::new(N, 42);
    for k in 0..42 {
        let noise = |at: usize| ((at * at * (k + 1)) % 97) as f32 / 97.0 - 0.5;
        let stamp = Array2::from_shape_fn((N, N), |(y, x)| 0.1 * noise(y * N + x));
        dark.add(stamp.view()).unwrap();
    }
    assert_eq!(kinds(&dark, SAME), ["epoch-without-galaxies"]);
    let found = first.contradictions(&[&dark], SAME, true);
    assert_eq!(found, [Warning::EpochWithoutGalaxies { from_first: true }]);
    // Galaxies off their places by as much on the sky, of an epoch whose x axis is mirrored.
    let both = [
        epoch(dither, centred, [0.0; 2], [0, 1]),
        epoch([-0.5, -0.25], centred, [0.0; 2], [0, 1]),
    ];
    assert!(
        both[1]
            .contradictions(&[&both[0]], [[-1.0, 0.0], [0.0, 1.0]], true)
            .is_empty()
    );
    assert!(!both[1].contradictions(&[&both[0]], SAME, true).is_empty());
}

#[test]
fn galaxies_with_missing_cores_are_not_compared() {
    const SAME: Matrix2 = [[1.0, 0.0], [0.0, 1.0]];
    let [mut first, mut masked] = [(); 2].map(|()| Examination::new(N, 80));
    for k in 0..80u8 {
        let galaxy = stamp(0.0, [0.0; 2], [0.01 * f32::from(k), 0.0]);
        first.add(galaxy.view()).unwrap();
        let mut damaged = galaxy.clone();
        // A quarter without the columns of its core.
        if k % 4 == 0 {
            damaged.slice_mut(ndarray::s![.., 22..26]).fill(f32::NAN);
        }
        // No copies of each other.
        damaged *= 1.001;
        masked.add(damaged.view()).unwrap();
    }
    assert_eq!(masked.contradictions(&[&first], SAME, true), []);
}

#[test]
fn the_noise_of_a_star_has_one_effect_on_all_galaxies_or_none() {
    // Checks, which fourth differences see as noise.
    let star = Array2::from_shape_fn((N, N), |(y, x)| {
        let noise = if (x / 2 + y / 3) % 2 == 0 {
            2e-4
        } else {
            -2e-4
        };
        f64::from(stamp(0.0, [0.0; 2], [0.0; 2])[(y, x)]) / 565.5 + noise
    });
    let mut one = Examination::new(N, 1);
    assert_eq!(one.psf_noise(), None);
    one.add_psf(star.view(), None);
    let [m, c] = one.psf_noise().unwrap();
    assert!(m > 1e-3 && c > 0.3 * m && c < m, "{m} {c}");
    let stars = ndarray::stack![ndarray::Axis(0), star, star];
    let mut several = Examination::new(N, 2);
    several.add_psfs(&Psfs::stars(stars), N.into(), 2);
    assert_eq!((several.psfs.len(), several.psf_noise()), (2, None));
    // Stars of S/N 100 are enough for a galaxy each, but not for all galaxies.
    assert!(m < 0.02, "{m}");
    let noisy = |examination: &Examination| {
        let mut warnings = examination.warnings().into_iter();
        warnings.any(|warning| matches!(warning, Warning::PsfNoise { .. }))
    };
    assert!(noisy(&one) && !noisy(&one.clone().with_psf_of_each()));
}

#[test]
fn rows_are_spread_without_a_period_and_cover_small_images() {
    assert_eq!(examined_rows(16, 16), (0..16).collect::<Vec<_>>());
    assert_eq!(examined_rows(7, 1), [0]);
    assert!(examined_rows(7, 0).is_empty());
    let rows = examined_rows(100, 100);
    assert_eq!(rows.len(), 10);
    // Where a few rows more than are enough are spread, two chosen places may be in one row.
    for side in 1..120 {
        let rows = examined_rows(side, side);
        assert!(rows.windows(2).all(|pair| pair[0] < pair[1]), "{side}");
        assert!(rows.last() < Some(&side));
    }
    let even = rows.iter().filter(|row| *row % 2 == 0).count();
    assert!((3..=7).contains(&even), "{rows:?}");
}

// Odd, so that the median of evenly spread values is the middle one. Errors of the median are then below all limits.
const COUNT: usize = 2001;

/// Stamps with noise of one and galaxies of flux 1000, each changed with its number from −1 to 1.
fn examined(change: impl Fn(f64, &mut StampStatistics)) -> Examination {
    let mut examination = Examination::new(N, COUNT);
    examination.added = COUNT;
    examination.stamps = (0..COUNT)
        .map(|at| {
            let mut stamp = StampStatistics {
                at,
                corner: 0.0,
                side: 0.0,
                slope: [0.0; 2],
                saddle: 0.0,
                noise: [1.0; 2],
                pairs: [0.0, 0.0, 100.0],
                bands: [[0.0; 3]; 2],
                place: [0.0; 2],
                flux: 1000.0,
                peak: 20.0,
                core: [100.0, 100.0],
                trace: at as u64,
                is_core_damaged: false,
                is_masked: false,
                darkest_share: 0.0,
                brightest: 1,
            };
            change(2.0 * at as f64 / (COUNT - 1) as f64 - 1.0, &mut stamp);
            stamp
        })
        .collect();
    examination
}

/// Whether a kind of warning is there beyond its limit and absent before it, by a fifth. Limits are literal: a test that
/// takes the constant itself does not notice another value.
fn begins_at(limit: f64, kind: &str, warnings: impl Fn(f64) -> Vec<Warning>) {
    for (factor, expected) in [(0.8, false), (1.2, true)] {
        let found = warnings(factor * limit);
        let has = found.iter().any(|warning| warning.kind() == kind);
        assert_eq!(has, expected, "{kind} at {factor} times {limit}: {found:?}");
    }
}

#[test]
fn warnings_about_stamps_begin_at_their_limits() {
    let light_of_sky = 1000.0 / INNER_AREA;
    begins_at(0.15, "sky", |share| {
        let level = share * light_of_sky;
        examined(|_, stamp| (stamp.corner, stamp.side) = (level, level)).warnings()
    });
    begins_at(0.6, "sky", |ratio| {
        examined(|_, stamp| (stamp.corner, stamp.side) = (2.0, 2.0 / ratio)).warnings()
    });
    begins_at(0.04, "gradient", |share| {
        let slope = share * light_of_sky / INNER_RADIUS;
        examined(|_, stamp| stamp.slope = [0.0, slope]).warnings()
    });
    begins_at(0.04, "sky-slopes", |share| {
        // Of numbers from −1 to 1.
        let slope = share * light_of_sky / INNER_RADIUS / 0.741;
        examined(|at, stamp| stamp.slope = [slope * at; 2]).warnings()
    });
    // As noise of any correlation makes them.
    let noise = examined(|at, stamp| (stamp.slope, stamp.saddle) = ([at; 2], at)).warnings();
    assert!(
        !noise.iter().any(|one| one.kind() == "sky-slopes"),
        "{noise:?}"
    );
    begins_at(0.85, "off-centre", |offset| {
        examined(|_, stamp| stamp.place = [offset, 0.0]).warnings()
    });
    // Half of the places of an even spread of ±1 are within ½ of its median; of a normal one, within 1/1.4826 of σ.
    begins_at(2.0, "position-scatter", |scatter| {
        examined(|at, stamp| stamp.place[1] = 2.0 / 1.4826 * scatter * at).warnings()
    });
    begins_at(0.1, "depths", |scatter| {
        examined(|at, stamp| stamp.noise = [(3f64.sqrt() * scatter * at).exp(); 2]).warnings()
    });
    begins_at(0.03, "long-correlation", |correlation| {
        examined(|_, stamp| stamp.pairs[0] = 100.0 * correlation).warnings()
    });
    for of in [[1.0, 0.3], [0.3, 1.0]] {
        begins_at(0.004, "banding", |square| {
            examined(|_, stamp| stamp.bands = of.map(|share| [share * square, 0.0, 0.0])).warnings()
        });
    }
    // The other direction.
    begins_at(1.0 / 0.33, "banding", |ratio| {
        examined(|_, stamp| stamp.bands = [0.01, 0.01 / ratio].map(|all| [all, 0.0, 0.0]))
            .warnings()
    });
    begins_at(0.8, "near-saturation", |peak| {
        let found = examined(|_, stamp| stamp.peak = peak);
        found.near_saturation(1.0).into_iter().collect()
    });
    // Half of the correlation.
    begins_at(0.5, "sky-levels", |share| {
        let levels = (share * 0.1_f64).sqrt();
        let change = |at: f64, stamp: &mut StampStatistics| {
            let level = 2.0 / 1.4826 * levels * at;
            (stamp.corner, stamp.side) = (level, level);
            stamp.pairs[0] = 10.0;
        };
        examined(change).warnings()
    });
    // Strongly correlated noise scatters corners, their median and their differences.
    let smooth = examined(|at, stamp| {
        let level = 2.0 / 1.4826 * at;
        (stamp.corner, stamp.side) = (level, level);
        stamp.saddle = 4.0 * level / (2.0 * 40.0);
        stamp.pairs[0] = 190.0;
    });
    let kinds: Vec<&str> = smooth.warnings().iter().map(|one| one.kind()).collect();
    assert!(
        kinds.contains(&"long-correlation") && !kinds.contains(&"sky-levels"),
        "{kinds:?}"
    );
    begins_at(0.02, "given-noise", |difference| {
        let given = examined(|_, _| {}).given_noise(1.0 + difference);
        given.into_iter().collect()
    });
}

#[test]
fn a_noisy_psf_has_an_uncertain_centroid() {
    let mut epoch = examined(|_, _| {});
    epoch.add_psf(stamp(0.0, [0.0; 2], [0.0; 2]).mapv(f64::from).view(), None);
    // The weight of a centroid has σ = 2 px.
    let expected = OF_MEDIAN * 2.0 / epoch.psfs[0].snr();
    let found = epoch.psf_offset()[0].error;
    assert!((found - expected).abs() < 1e-12, "{found} {expected}");
}

#[test]
fn warnings_about_epochs_begin_at_their_limits() {
    const SAME: Matrix2 = [[1.0, 0.0], [0.0, 1.0]];
    // Copies are told by their trace.
    let epoch = |change: &dyn Fn(f64, &mut StampStatistics)| {
        let first = examined(|_, _| {});
        let own = examined(|at, stamp| {
            stamp.trace += COUNT as u64;
            change(at, stamp);
        });
        own.contradictions(&[&first], SAME, true)
    };
    begins_at(0.1, "epoch-offset", |offset| {
        epoch(&|_, stamp| stamp.place[0] = offset)
    });
    begins_at(0.2, "epoch-flux", |difference| {
        epoch(&|_, stamp| stamp.flux *= 1.0 + difference)
    });
    begins_at(0.1, "epoch-galaxies", |share| {
        epoch(&|at, stamp| {
            if 0.5 * (at + 1.0) < share {
                stamp.core[0] = 300.0;
            }
        })
    });
    // Without significant flux, this epoch has at most five errors of its median: below the limit it cannot show the galaxies.
    let error = OF_MEDIAN * 1.4826 * 0.5 / (COUNT as f64).sqrt();
    begins_at(4.0, "epoch-without-galaxies", |times_deeper| {
        let spread = 1000.0 / times_deeper / (SIGNIFICANT * error);
        epoch(&|at, stamp| stamp.flux = spread * at)
    });
}

#[test]
fn bright_stars_count_as_four_galaxies_in_the_core() {
    let core = |count: usize| {
        let mut examination = examined(|_, _| {});
        examination.stamps.truncate(count);
        examination.stamps[0].core = [10_000.0, 5_000.0];
        examination.core().map(|core| core.mean_square_radius)
    };
    assert_eq!(core(29), None);
    let q = 0.5 * (29.0 * 100.0 + 4.0 * 50.0) / (29.0 * 100.0 + 4.0 * 100.0);
    let expected = CoreSize::from_weighted(q, 0.0).unwrap();
    let found = core(30).unwrap();
    close(found / expected.mean_square_radius, 1.0, 1e-12);
}

#[test]
fn pixel_scales_are_shown_with_the_digits_that_differ() {
    let message = |psf: f64, galaxies: f64| Warning::PixelScale { psf, galaxies }.to_string();
    let found = message(0.2, 0.263);
    assert!(
        found.contains("different pixel scales (found 0.2, expected 0.263 arcsec per pixel)"),
        "{found}"
    );
    let found = message(0.200_000_000_1 * 1.001, 0.199_999_999_9);
    assert!(found.contains("found 0.2002, expected 0.2 "), "{found}");
}

/// Kinds of the warnings about 40 stamps of noise and a galaxy, each changed by its number.
fn kinds_of(change: impl Fn(usize, f32) -> f32) -> Vec<&'static str> {
    let mut rng = ChaCha8Rng::seed_from_u64(31);
    let mut examination = Examination::new(N, 40);
    for k in 0..40 {
        let stamp = stamp(0.0, [0.0; 2], [0.3, -0.2]).mapv(|light| {
            let noise: f32 = StandardNormal.sample(&mut rng);
            change(k, light + 0.3 * noise)
        });
        examination.add(stamp.view()).unwrap();
    }
    let found = examination.warnings();
    found.iter().map(Warning::kind).collect()
}

#[test]
fn pixels_cut_off_below_or_above_are_named() {
    let all = |kind: &str, change: &dyn Fn(usize, f32) -> f32| kinds_of(change).contains(&kind);
    assert!(kinds_of(|_, value| value).is_empty());
    for least in [0.0, -0.3, -0.55] {
        assert!(all("clipped", &|_, value| value.max(least)), "{least}");
    }
    // Counts, and values that a gain makes of them.
    for step in [0.25, 0.3, 0.6] {
        let counts = |_: usize, value: f32| (value / step).round().max(0.0) * step;
        assert!(
            kinds_of(counts)
                .iter()
                .all(|kind| !["clipped", "flat-tops"].contains(kind))
        );
    }
    // Each exposure has its level.
    let cut = |k: usize, value: f32| value.min(7.0 + 0.01 * k as f32);
    assert!(all("flat-tops", &cut));
}

/// The plain reference of [`ends`].
fn plain_ends(pixels: &[f32]) -> (f64, usize) {
    let finite: Vec<f32> = pixels.iter().copied().filter(|v| v.is_finite()).collect();
    let low = finite.iter().copied().fold(f32::INFINITY, f32::min);
    let high = finite.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let of = |end: f32| finite.iter().filter(|value| **value == end).count();
    let repeats = |pair: &&[f32]| pair[0] == pair[1] && pair[0] != low && pair[0] != high;
    let equal = pixels.windows(2).filter(repeats).count();
    match equal as f64 > MAX_EQUAL_SHARE * finite.len() as f64 {
        true => (0.0, 0),
        false => (of(low) as f64 / finite.len() as f64, of(high)),
    }
}

#[test]
fn fast_ends_agree_with_plain_ones() {
    for count in [1, 2, 31, 32, 33, 64, 1000, 2304] {
        // Whole numbers repeat, fractions do not; the ends are cut off.
        for (step, cut) in [(1.0, 9.0), (0.001, 9.0), (0.001, 0.4), (0.001, 0.0)] {
            let value = |at: usize| {
                let value = step * ((at * at * 7919 + at) % 10007) as f32;
                value.clamp(-cut, cut + 1.0)
            };
            let mut pixels: Vec<f32> = (0..count).map(value).collect();
            assert_eq!(ends(&pixels), plain_ends(&pixels), "{count} {step} {cut}");
            if count > 4 {
                pixels[1] = f32::NAN;
                pixels[count - 1] = f32::NAN;
                assert_eq!(ends(&pixels), plain_ends(&pixels), "{count} {step} {cut}");
                pixels[2] = f32::INFINITY;
                pixels[3] = f32::INFINITY;
                pixels[count - 2] = f32::NEG_INFINITY;
                assert_eq!(ends(&pixels), plain_ends(&pixels), "{count} {step} {cut}");
            }
        }
    }
}

#[test]
fn bands_and_skies_of_stamps_are_named() {
    type Value<'a> = &'a dyn Fn([usize; 3], [&[f32]; 3]) -> f32;
    let kinds = |of: Value<'_>| {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut examination = Examination::new(N, 400);
        for k in 0..400 {
            let mut draw = |count: usize| -> Vec<f32> {
                (0..count)
                    .map(|_| StandardNormal.sample(&mut rng))
                    .collect()
            };
            let (noise, rows, columns, sky) = (draw(N * N), draw(N), draw(N), draw(1));
            let stamp = stamp(0.0, [0.0; 2], [0.3, -0.2]);
            let changed = Array2::from_shape_fn((N, N), |(y, x)| {
                let levels = [&rows[..], &columns[..], &sky[..]];
                stamp[(y, x)] + noise[y * N + x] + of([k, y, x], levels)
            });
            examination.add(changed.view()).unwrap();
        }
        let found = examination.warnings();
        found.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    assert!(kinds(&|_, _| 0.0).is_empty());
    let one = |found: Vec<String>, text: &str| {
        assert!(found.len() == 1 && found[0].contains(text), "{found:?}");
    };
    one(
        kinds(&|[_, y, _], [rows, ..]| 0.2 * rows[y]),
        "found rows with levels",
    );
    one(
        kinds(&|[_, _, x], [_, columns, _]| 0.2 * columns[x]),
        "found columns with",
    );
    // Levels of odd and even columns have the other sign of c1, and an m; those of rows the opposite c1.
    let alternate = |at: usize| if at.is_multiple_of(2) { 0.2 } else { -0.2 };
    one(kinds(&|[.., x], _| alternate(x)), "c1 by about +0.003");
    one(kinds(&|[.., x], _| alternate(x)), "m by about -0.003");
    one(kinds(&|[_, y, _], _| alternate(y)), "c1 by about -0.003");
    let two_and_two = |at: usize| if at % 4 < 2 { 0.2 } else { -0.2 };
    one(kinds(&|[.., x], _| two_and_two(x)), "m by about -0.01");
    for scatter in [0.3, 0.9, 3.0] {
        one(
            kinds(&|_, [.., sky]| scatter * sky[0]),
            "noise.sky = \"stamp\"",
        );
    }
    // Straight gradients along one axis are no bands.
    one(
        kinds(&|[_, y, _], [.., sky]| 0.02 * sky[0] * (y as f32 - 23.5)),
        "the slope of the sky differs",
    );
}

#[test]
fn stamps_divided_by_their_peaks_are_not_saturated() {
    let found = |brightest: usize, of_one: f64| {
        let examined = examined(|at, stamp| {
            stamp.peak = if at < of_one { 1.0 } else { 1.0 - at };
            stamp.brightest = brightest;
        });
        let found = examined.warnings().into_iter();
        found.map(|one| one.kind()).collect::<Vec<_>>()
    };
    assert_eq!(found(1, 2.0), ["peak-normalised"]);
    assert_eq!(found(2, 2.0), ["saturated"]);
    assert_eq!(found(1, 0.5), ["saturated"]);
}

#[test]
fn masked_centres_are_named_before_their_places() {
    let kinds = |masked: usize, radius: f32| {
        let mut examination = Examination::new(N, 40);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for k in 0..40 {
            let mut stamp = stamp(0.0, [0.0; 2], [0.0; 2]);
            for ((y, x), value) in stamp.indexed_iter_mut() {
                let noise: f32 = StandardNormal.sample(&mut rng);
                *value += 0.3 * noise;
                if k < masked && (x as f32 - 23.5).hypot(y as f32 - 23.5) < radius {
                    *value = f32::NAN;
                }
            }
            examination.add(stamp.view()).unwrap();
        }
        let found = examination.warnings();
        found.iter().map(Warning::kind).collect::<Vec<_>>()
    };
    for (masked, radius, expected) in [(40, 5.0, 1), (8, 2.5, 1), (2, 5.0, 0), (40, 1.2, 0)] {
        let found = kinds(masked, radius);
        let count = found
            .iter()
            .filter(|kind| **kind == "masked-galaxies")
            .count();
        assert_eq!(count, expected, "{masked} {radius}: {found:?}");
        assert!(!found.contains(&"position-scatter"), "{found:?}");
    }
}
