//! Wrong data do not give shears without a message, and good data give none.

use std::fs;
use std::path::Path;

use ndarray::{Array3, ArrayView2, s};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{Measurer, Psfs};
use shearq_simulate::kinds::SetKind;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{STAMP, SetSimulator, SimulationSettings};

use crate::support::{fail, fits_image, floats, pixels_of, shared, shearq, succeed, text};

/// Galaxies along a side of the images.
const GRID: usize = 16;
const LINEAR: &str = "48/linear/star";

/// The stamps of an image, one each along the first axis.
type Stamps = Array3<f32>;

fn noise(level: f32, count: usize, seed: u64) -> Stamps {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Stamps::from_shape_simple_fn((count, STAMP, STAMP), || {
        let value: f32 = StandardNormal.sample(&mut rng);
        level * value
    })
}

/// Adds a light that depends on the place on the stamp.
fn lit(mut stamps: Stamps, light: impl Fn(f32, f32) -> f32) -> Stamps {
    for ((_, y, x), value) in stamps.indexed_iter_mut() {
        *value += light(x as f32 - 23.5, y as f32 - 23.5);
    }
    stamps
}

/// Moves all stamps by whole pixels.
fn moved(stamps: &Stamps, dx: usize, dy: usize) -> Stamps {
    Stamps::from_shape_fn(stamps.dim(), |(k, y, x)| {
        stamps[(k, (y + STAMP - dy) % STAMP, (x + STAMP - dx) % STAMP)]
    })
}

/// Sums over squares of so many pixels, which correlates noise.
fn smoothed(stamps: &Stamps, side: usize) -> Stamps {
    Stamps::from_shape_fn(stamps.dim(), |(k, y, x)| {
        let at = |dy: usize, dx: usize| stamps[(k, (y + dy) % STAMP, (x + dx) % STAMP)];
        let all = (0..side).flat_map(|dy| (0..side).map(move |dx| (dy, dx)));
        all.map(|(dy, dx)| at(dy, dx)).sum::<f32>() / side as f32
    })
}

/// Name, what is done to good stamps, and what the message contains.
type Case = (&'static str, fn(&Stamps) -> Stamps, &'static str);

const CASES: [Case; 22] = [
    ("sky 0.5σ", |s| s + 0.5, "contain sky (found 0.5"),
    ("sky 3σ", |s| s + 3.0, "contain sky (found 3.0"),
    ("sky 10σ", |s| s + 10.0, "contain sky (found 10"),
    ("sky 100σ", |s| s + 100.0, "contain sky (found 100"),
    ("sky −0.5σ", |s| s - 0.5, "contain sky (found -0.4"),
    ("sky −3σ", |s| s - 3.0, "contain sky (found -2.9"),
    (
        "gradient 0.01 along x",
        |s| lit(s.clone(), |x, _| 0.01 * x),
        "gradient (found +0.01",
    ),
    (
        "gradient 0.02 along x",
        |s| lit(s.clone(), |x, _| 0.02 * x),
        "gradient (found +0.0",
    ),
    (
        "gradient −0.05 along y",
        |s| lit(s.clone(), |_, y| -0.05 * y),
        "along x and -0.05",
    ),
    ("one pixel off", |s| moved(s, 1, 1), "off the centre"),
    ("2 px off", |s| moved(s, 2, 0), "off the centre"),
    ("4 px off", |s| moved(s, 0, 4), "off the centre"),
    ("8 px off", |s| moved(s, 8, 0), "off the centre"),
    (
        "wandering",
        |s| {
            let mut out = s.clone();
            for (k, mut stamp) in out.outer_iter_mut().enumerate() {
                let (dx, dy) = ([0, 5, 43][k % 3], [0, 5, 43][k / 3 % 3]);
                let one = s.slice(s![k..k + 1, .., ..]).to_owned();
                stamp.assign(&moved(&one, dx, dy).slice(s![0, .., ..]));
            }
            out
        },
        "scattered over their stamps",
    ),
    (
        "negated",
        |s| -s,
        "darker than their surroundings (found negative flux on 256 of 256",
    ),
    (
        "two depths",
        |s| {
            let mut out = s + &noise(0.9, s.dim().0, 4);
            let half = s.dim().0 / 2;
            out.slice_mut(s![..half, .., ..])
                .assign(&s.slice(s![..half, .., ..]));
            out
        },
        "the noise differs between stamps",
    ),
    (
        "correlated over 6 px",
        |s| s + &(smoothed(&noise(1.0, s.dim().0, 5), 6) * 2.0),
        "correlated over more than 3 px",
    ),
    (
        "copies",
        |s| {
            let mut out = s.clone();
            let first = s.slice(s![..16, .., ..]).to_owned();
            out.slice_mut(s![32..48, .., ..]).assign(&first);
            out
        },
        "copies of each other (found 16 of 256",
    ),
    (
        "all copies",
        |s| Stamps::from_shape_fn(s.dim(), |(_, y, x)| s[(0, y, x)]),
        "copies of each other (found 255 of 256",
    ),
    ("blank", |s| s * 0.0, "stamps are blank"),
    (
        "in units of 1e-20",
        |s| s * 1e20,
        "out of range (found brightest pixels of about",
    ),
    ("in units of 1e+22", |s| s * 1e-22, "expected 1e-18 to 1e17"),
];

/// Stamps and PSF of an image of a simulated set.
fn simulated(set: u32) -> (Stamps, Vec<f32>) {
    let settings = SimulationSettings::new(11, GRID);
    let set = SetSimulator::new(SetKind::of(set).unwrap(), settings).unwrap();
    let fields = set.image_fields(1);
    let mut stamps = Stamps::zeros((GRID * GRID, STAMP, STAMP));
    let mut scratch = RenderScratch::new();
    for (k, mut stamp) in stamps.outer_iter_mut().enumerate() {
        let pixels = stamp.as_slice_mut().unwrap();
        set.draw(&fields, k % GRID, k / GRID, &mut scratch, pixels);
    }
    let psf = fields.psf.at(0, 0).stamp(STAMP);
    (stamps, psf.iter().map(|value| *value as f32).collect())
}

fn warnings(stamps: &Stamps, psf: &[f32], name: &str) -> Vec<String> {
    let measurer = Measurer::named(name, STAMP).unwrap();
    let psf = ArrayView2::from_shape((STAMP, STAMP), psf).unwrap();
    let given =
        (measurer.configuration().noise == shearq_submissions::NoiseSource::Header).then_some(1.0);
    let batch = measurer.batch(stamps.view(), &Psfs::star(psf), given);
    let batch = match batch {
        Ok(batch) => batch,
        Err(error) => return vec![error.to_string()],
    };
    batch.warnings.iter().map(ToString::to_string).collect()
}

#[test]
fn a_batch_of_wrong_stamps_has_a_warning_of_what_is_wrong() {
    let (stamps, psf) = simulated(2);
    assert_eq!(warnings(&stamps, &psf, LINEAR), Vec::<String>::new());
    for (case, spoil, expected) in CASES {
        let found = warnings(&spoil(&stamps), &psf, LINEAR);
        println!("{case}: {found:#?}");
        assert!(
            found.iter().any(|text| text.contains(expected)),
            "{case}: {found:#?}"
        );
    }
}

#[test]
fn a_batch_with_another_noise_than_that_of_the_stamps_has_a_warning() {
    let (stamps, psf) = simulated(2);
    let measurer = Measurer::named(LINEAR, STAMP).unwrap();
    let psf = ArrayView2::from_shape((STAMP, STAMP), &psf).unwrap();
    for (given, silent) in [(1.0, true), (0.9, false), (2.0, false)] {
        let batch = measurer.batch(stamps.view(), &Psfs::star(psf), Some(given));
        let found = batch.unwrap().warnings;
        assert_eq!(found.is_empty(), silent, "{given}: {found:?}");
        let expected = "the given noise disagrees with the noise of the stamps (found ";
        assert!(
            silent || found[0].to_string().contains(expected),
            "{found:?}"
        );
    }
}

#[test]
fn simulated_stamps_have_no_warning() {
    for set in [2, 5, 8, 11, 14, 17] {
        let (stamps, psf) = simulated(set);
        for name in [LINEAR, "23/raw/star"] {
            let found = warnings(&stamps, &psf, name);
            assert!(found.is_empty(), "{set}, {name}: {found:#?}");
        }
    }
}

#[test]
fn measurements_of_good_images_are_silent() {
    let root = tempfile::tempdir().unwrap();
    let out = |name: &str| root.path().join(name);
    let run = [
        "run",
        "--simulate",
        "--sets",
        "4,7,13,16,19,24",
        "--images",
        "1",
        "--grid",
        "16",
    ];
    let rest = ["--submission", "48/linear/func", "--out"];
    let done = shearq(&[&run[..], &rest, &[text(&out("run"))]].concat());
    let said = String::from_utf8(done.stderr).unwrap();
    assert!(done.status.success() && !said.contains("warning"), "{said}");
    let Some(data) = shared("galsim-sets") else {
        return;
    };
    for name in [LINEAR, "23/raw/star"] {
        let out = out(&name.replace('/', "-"));
        let measure = ["measure", "--data", text(&data), "--submission", name];
        let done = shearq(&[&measure[..], &["--out", text(&out)]].concat());
        let said = String::from_utf8(done.stderr).unwrap();
        assert!(done.status.success() && !said.contains("warning"), "{said}");
    }
}

/// Replaces the images of a simulated set by spoilt ones.
fn spoil(data: &Path, images: u32, spoil: fn(&Stamps) -> Stamps) {
    for image in 1..=images {
        let path = data.join(format!("set02/galaxies-{image:03}.fits"));
        let (pixels, side) = pixels_of(&path);
        let grid = side / STAMP;
        let at =
            |k: usize, y: usize, x: usize| (k / grid * STAMP + y) * side + k % grid * STAMP + x;
        let stamps =
            Stamps::from_shape_fn((grid * grid, STAMP, STAMP), |(k, y, x)| pixels[at(k, y, x)]);
        let mut image = vec![0.0; side * side];
        for ((k, y, x), value) in spoil(&stamps).indexed_iter() {
            image[at(k, y, x)] = *value;
        }
        let card = format!("STAMP   = {STAMP:>20}");
        fs::write(
            path,
            fits_image(-32, &[side, side], &[&card], &floats(&image)),
        )
        .unwrap();
    }
}

#[test]
fn every_command_warns_once_for_all_images() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let data = at("data");
    let simulate = ["simulate", "--sets", "2", "--images", "3", "--grid", "16"];
    succeed(&[&simulate[..], &["--out", text(&data)]].concat());
    spoil(&data, 3, |stamps| stamps + 3.0);
    for command in ["measure", "run"] {
        for name in [LINEAR, "23/raw/star"] {
            let out = at(&format!("{command}-{}", name.replace('/', "-")));
            let command = [command, "--data", text(&data), "--submission", name];
            let done = shearq(&[&command[..], &["--out", text(&out)]].concat());
            let said = String::from_utf8(done.stderr).unwrap();
            let first = "warning: set 02 image 001: the stamps contain sky (found 3.0";
            assert_eq!(said.matches("contain sky").count(), 1, "{said}");
            assert!(said.contains(first), "{said}");
            assert!(said.contains("warning: 2 more images"), "{said}");
        }
    }
    // Cut-outs of the mosaic around the middles of its stamps, counted from 1 and from 0.
    succeed(&[&simulate[..], &["--out", text(&at("good"))]].concat());
    let good = at("good/set02");
    for first in [0, 1] {
        let mut table = String::from("x,y\n");
        for k in 0..GRID * GRID {
            let place = |at: usize| (at * STAMP) as f64 + 23.5 + f64::from(first);
            table += &format!("{},{}\n", place(k % GRID), place(k / GRID));
        }
        fs::write(at("positions.csv"), table).unwrap();
        for option in [0, 1] {
            let out = at(&format!("gathered-{first}-{option}"));
            let (exposure, psf) = (good.join("galaxies-001.fits"), good.join("psf-001.fits"));
            let positions = at("positions.csv");
            let gather = ["gather", "--exposure", text(&exposure), "--psf", text(&psf)];
            let option_text = option.to_string();
            let rest = [
                "--positions",
                text(&positions),
                "--first-pixel",
                &option_text,
            ];
            let done = shearq(&[&gather[..], &rest, &["--out", text(&out)]].concat());
            let said = String::from_utf8(done.stderr).unwrap();
            assert!(done.status.success(), "{said}");
            let hint =
                format!("Are the positions counted from {first}? Try: --first-pixel {first}");
            assert_eq!(said.contains(&hint), first != option, "{said}");
            assert_eq!(said.contains("warning"), first != option, "{said}");
        }
    }
}

#[test]
fn noise_is_compared_with_the_header_of_every_image() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let simulate = ["simulate", "--sets", "2", "--images", "2", "--grid", "16"];
    succeed(&[&simulate[..], &["--out", text(&at("data"))]].concat());
    let path = at("data/set02/galaxies-002.fits");
    let (pixels, side) = pixels_of(&path);
    let cards = [
        format!("STAMP   = {STAMP:>20}"),
        format!("NOISESIG= {:>20}", "2.0"),
    ];
    let cards = cards.each_ref().map(String::as_str);
    fs::write(
        &path,
        fits_image(-32, &[side, side], &cards, &floats(&pixels)),
    )
    .unwrap();
    let (data, out) = (at("data"), at("out"));
    let measure = ["measure", "--data", text(&data), "--submission", LINEAR];
    let done = shearq(&[&measure[..], &["--out", text(&out)]].concat());
    let said = String::from_utf8(done.stderr).unwrap();
    let expected = "warning: set 02 image 002: NOISESIG disagrees with the measured noise (found 2.0000, expected ";
    assert!(said.contains(expected), "{said}");
}

#[test]
fn results_without_a_galaxy_are_an_error_with_the_likely_cause() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let simulate = ["simulate", "--sets", "2", "--images", "1", "--grid", "16"];
    succeed(&[&simulate[..], &["--out", text(&at("data"))]].concat());
    let (data, out) = (at("data"), at("out"));
    spoil(&data, 1, |stamps| lit(stamps.clone(), |x, _| 0.08 * x));
    let measure = ["measure", "--data", text(&data), "--out", text(&out)];
    let message = {
        let done = shearq(&[&measure[..], &["--submission", LINEAR]].concat());
        assert_eq!(done.status.code(), Some(1));
        String::from_utf8(done.stderr).unwrap()
    };
    assert!(message.contains("the sky has a gradient"), "{message}");
    let expected = "256 of 256 galaxies are flagged (most frequent reason: a second peak near the galaxy). Try: check sky gradients";
    assert!(
        message.contains(&format!("error: no galaxy could be measured: {expected}")),
        "{message}"
    );
    let message = fail(&["mean", "--measured", text(&out)]);
    assert!(
        message.contains(&format!("error: set 02: {expected}")),
        "{message}"
    );
    // Without noise that can be measured there is one error, and no folder of results.
    spoil(&data, 1, |stamps| stamps * 1e20);
    let out = at("other");
    let measure = ["measure", "--data", text(&data), "--out", text(&out)];
    let message = fail(&[&measure[..], &["--submission", LINEAR]].concat());
    assert!(
        message.contains("pixel values are out of range (found brightest"),
        "{message}"
    );
}

#[test]
fn a_mean_of_identical_galaxies_has_no_error() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let simulate = ["simulate", "--sets", "2", "--images", "1", "--grid", "16"];
    succeed(&[&simulate[..], &["--out", text(&at("data"))]].concat());
    let (data, out) = (at("data"), at("out"));
    spoil(&data, 1, |s| {
        Stamps::from_shape_fn(s.dim(), |(_, y, x)| s[(0, y, x)])
    });
    let measure = ["measure", "--data", text(&data), "--out", text(&out)];
    let done = shearq(&[&measure[..], &["--submission", LINEAR]].concat());
    let said = String::from_utf8(done.stderr).unwrap();
    assert!(said.contains("copies of each other"), "{said}");
    let done = shearq(&["mean", "--measured", text(&out)]);
    let said = String::from_utf8(done.stderr).unwrap();
    assert!(
        said.contains("warning: set 02: all 256 galaxies have the same ellipticity"),
        "{said}"
    );
}
