//! Wrong PSF images: each has its warning or error, and a good one has none.

use std::fs;

use shearq_files::fits::ImageReader;

use crate::support::{Small, fits_image, floats, pixels_of, succeed, text};

const LINEAR: [&str; 2] = ["--submission", "48/linear/star"];

/// Pixels of the star moved by whole pixels; what comes in is dark.
fn moved(star: &[f32], side: usize, by: [i32; 2]) -> Vec<f32> {
    let n = side as i32;
    let at = |x: i32, y: i32| match (0..n).contains(&x) && (0..n).contains(&y) {
        true => star[(y * n + x) as usize],
        false => 0.0,
    };
    let places = (0..n).flat_map(|y| (0..n).map(move |x| (x, y)));
    places.map(|(x, y)| at(x - by[0], y - by[1])).collect()
}

#[test]
fn wrong_psfs_are_named_and_good_ones_are_not() {
    let small = Small::new("2");
    fs::remove_file(small.at("data/set02/galaxies-002.fits")).unwrap();
    let path = small.at("data/set02/psf-001.fits");
    let mut image = ImageReader::open(&path).unwrap();
    let side = image.width();
    let star = image.read_rows(side).unwrap();
    let peak = star.iter().copied().fold(0.0, f32::max);
    let write = |pixels: &[f32]| {
        fs::write(&path, fits_image(-32, &[side; 2], &[], &floats(pixels))).unwrap();
    };
    write(&star);
    let said = small.measure(&LINEAR);
    assert!(!said.contains("PSF") && !said.contains("star is"), "{said}");
    let e1 = small.measured("02", "e1");

    let plus = |share: f32| star.iter().map(|v| v + share * peak).collect::<Vec<_>>();
    let mut delta = vec![0.0; side * side];
    delta[side * side / 2 + side / 2] = 1.0;
    // A fixed sequence of numbers between −√3 and √3, of variance one.
    let power = star.iter().map(|v| v * v).sum::<f32>().sqrt();
    let mut state = 1u32;
    let noisy: Vec<f32> = star
        .iter()
        .map(|v| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let uniform = (state >> 8) as f32 / (1 << 24) as f32 - 0.5;
            v + power / 100.0 * 12f32.sqrt() * uniform
        })
        .collect();
    for (name, pixels, expected) in [
        (
            "background of 1 %",
            plus(0.01),
            "the PSF contains a background",
        ),
        (
            "background of 5 %",
            plus(0.05),
            "the PSF contains a background",
        ),
        ("delta", delta, "narrower than the pixels can show"),
        ("S/N 100", noisy, "the PSF is noisy"),
        ("3 px off", moved(&star, side, [3, 0]), "found (+3.0, "),
    ] {
        write(&pixels);
        let said = small.measure(&LINEAR);
        assert!(said.contains(expected), "{name}: {said}");
        let stated = stars_in_the_error(&small);
        assert_eq!(stated.is_some(), name == "S/N 100", "{name}: {stated:?}");
    }
    // The star that was moved to the centre: wings beyond 42 px are cut off.
    for (found, expected) in small.measured("02", "e1").iter().zip(&e1) {
        assert!((found - expected).abs() < 2e-3, "{found} {expected}");
    }
    for (pixels, expected) in [
        (star.iter().map(|v| -v).collect(), "expected a positive sum"),
        (moved(&star, side, [10, 0]), "(+10.0, "),
        (vec![f32::NAN; side * side], "is not a finite number"),
    ] {
        write(&pixels);
        let message = small.fail_to_measure(&LINEAR);
        assert!(message.contains(expected), "{message}");
    }
}

/// What `mean` says about the noise of stars in its errors.
fn stars_in_the_error(small: &Small) -> Option<String> {
    let said = succeed(&["mean", "--measured", text(&small.at("out"))]);
    let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
    let from = said.find("Errors include the noise of the star of")?;
    let stated = said[from..].to_owned();
    assert!(stated.contains("each image"), "{stated}");
    Some(stated)
}

#[test]
fn another_pixel_scale_in_the_header_of_the_psf_is_reported() {
    let small = Small::new("2");
    let scaled = |name: &str, cards: &[&str]| {
        let path = small.at(&format!("data/set02/{name}-001.fits"));
        let (pixels, side) = pixels_of(&path);
        let cards = [&["STAMP   =                   48"], cards].concat();
        fs::write(&path, fits_image(-32, &[side; 2], &cards, &floats(&pixels))).unwrap();
    };
    let degrees = [
        "CD1_1   =          -5.5556E-05",
        "CD2_2   =           5.5556E-05",
    ];
    scaled("galaxies", &degrees);
    scaled("psf", &["GS_SCALE=                  0.2"]);
    let said = small.measure(&["--submission", "48/linear/star"]);
    assert!(!said.contains("pixel scale"), "{said}");
    scaled("psf", &["GS_SCALE=                 0.15"]);
    let said = small.measure(&["--submission", "48/linear/star"]);
    let expected = "warning: set 02 image 001: the PSF image and the galaxy image have different pixel scales (found 0.15, expected 0.200002 arcsec";
    assert!(said.contains(expected), "{said}");
}
