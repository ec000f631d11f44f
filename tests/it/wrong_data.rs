//! Messages about wrong data: once for all images of a run, with the image, and as an error without any galaxy.

use std::fs;
use std::path::Path;

use ndarray::Array3;
use shearq_files::table::{self, FileFormat};
use shearq_simulate::set::STAMP;

use crate::support::{fail, fits_image, floats, pixels_of, shearq, succeed, text};

/// Galaxies per axis of the images.
const GRID: usize = 16;
const LINEAR: &str = "48/linear/star";

/// Stamps along the first axis.
type Stamps = Array3<f32>;

/// Adds light that depends on the position on the stamp.
fn lit(mut stamps: Stamps, light: impl Fn(f32, f32) -> f32) -> Stamps {
    for ((_, y, x), value) in stamps.indexed_iter_mut() {
        *value += light(x as f32 - 23.5, y as f32 - 23.5);
    }
    stamps
}

/// Changes the images of a simulated set.
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
            // Within two hundredths.
            let found = "warning: set 02 image 001: the stamps contain sky (found ";
            let first = [2.98, 2.99, 3.0, 3.01, 3.02].map(|level| format!("{found}{level:.2}"));
            assert_eq!(said.matches("contain sky").count(), 1, "{said}");
            assert!(first.iter().any(|first| said.contains(first)), "{said}");
            // The network does not subtract it.
            let subtracted = said.contains("It was subtracted from all stamps");
            assert_eq!(subtracted, name == LINEAR, "{said}");
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
    let data = at("data");
    let header = at("header.toml");
    fs::write(
        &header,
        format!("extends = \"{LINEAR}\"\nnoise.source = \"header\"\n"),
    )
    .unwrap();
    for (submission, used) in [(LINEAR, "the measured noise"), (text(&header), "NOISESIG")] {
        let out = at(&used.replace(' ', "-"));
        let measure = ["measure", "--data", text(&data), "--submission", submission];
        let done = shearq(&[&measure[..], &["--out", text(&out)]].concat());
        let said = String::from_utf8(done.stderr).unwrap();
        let expected = "warning: set 02 image 002: NOISESIG disagrees with the measured noise (found 2.0000, expected ";
        assert!(said.contains(expected), "{said}");
        assert!(said.contains(&format!("): {used} is used")), "{said}");
        let stored = |image: u32| {
            let path = out.join(format!("set02/catalogue-00{image}.parquet"));
            table::read_metadata(
                &path,
                FileFormat::Parquet,
                [&"warnings".to_owned()].into_iter(),
            )
            .unwrap()
        };
        assert!(stored(1).is_empty());
        let warnings = &stored(2)["warnings"];
        assert!(warnings.starts_with("NOISESIG disagrees"), "{warnings}");
    }
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
    let own = at("own.toml");
    let settings = format!("extends = \"{LINEAR}\"\n[noise]\nsky = \"none\"\n");
    fs::write(&own, settings).unwrap();
    let measured = || {
        let done = shearq(&[&measure[..], &["--submission", text(&own)]].concat());
        assert_eq!(done.status.code(), Some(1));
        String::from_utf8(done.stderr).unwrap()
    };
    let message = measured();
    assert!(message.contains("the sky has a gradient"), "{message}");
    let expected = "256 of 256 galaxies are flagged (most frequent reason: a neighbour or an unusual shape). Try: check sky gradients";
    assert!(
        message.contains(&format!("error: no galaxy could be measured: {expected}")),
        "{message}"
    );
    let again = measured();
    assert!(
        again.contains("1 there already") && again.contains(expected),
        "{again}"
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
        Stamps::from_shape_fn(s.dim(), |(_, y, x)| s[(5, y, x)])
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
