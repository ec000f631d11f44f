//! Stamps that lie otherwise than a challenge's: gathered from cubes, extensions, single files and exposures, they are
//! measured as they were.

use serde_json::Value;
use shearq_files::parquet;

use crate::support::{
    Folder, assert_has, fits_extension, fits_image, floats, pixels_of, printed, refused, stamps_of,
};

const LINEAR: &str = "--submission 48/linear/star";

fn write_cube(folder: &Folder, name: &str, stamps: &[Vec<f32>]) {
    let side = stamps[0].len().isqrt();
    folder.image(name, &[side, side, stamps.len()], &[], &stamps.concat());
}

/// Writes a file of an empty primary header and an extension for each stamp.
fn write_extensions(folder: &Folder, name: &str, stamps: &[Vec<f32>]) {
    let mut file = fits_image(8, &[], &["EXTEND  = T"], &[]);
    for stamp in stamps {
        let sides = [stamp.len().isqrt(); 2];
        file.extend(fits_extension("IMAGE", -32, &sides, &[], &floats(stamp)));
    }
    folder.write(name, file);
}

/// Gathers into a new folder `data`.
fn gather(folder: &Folder, from: &str) -> String {
    folder.remove("data");
    folder.said(&format!("gather {from} --out data"))
}

fn refuse_to_gather(folder: &Folder, from: &str, words: &str) {
    folder.remove("data");
    folder.refuses(&format!("gather {from} --out data"), words);
    assert!(
        !folder.at("data/set01/galaxies-001.fits").exists(),
        "{from}"
    );
}

/// Measures a data folder into a new one, whose name ends in `-out`, and gives the standard error.
fn measure(folder: &Folder, data: &str) -> String {
    folder.remove(&format!("{data}-out"));
    folder.said(&format!("measure {LINEAR} --data {data} --out {data}-out"))
}

/// Bits of e1, e2 and the flags of a catalogue.
fn bits(folder: &Folder, name: &str) -> [Vec<u64>; 3] {
    let columns = folder.numbers(name, ["e1", "e2", "flags"]);
    columns.map(|values| values.iter().map(|value| value.to_bits()).collect())
}

#[test]
fn stamps_of_all_kinds_of_files_are_measured_alike() {
    let folder = Folder::with_set(19);
    let set = folder.at("data/set19");
    folder.remove("data/set19/galaxies-002.fits");
    folder.measure(LINEAR);
    let expected = bits(&folder, "out/set19/catalogue-001.parquet");
    assert_eq!(expected[0].len(), 64);
    let galaxies = stamps_of(&set.join("galaxies-001.fits"), 48);
    let star = set.join("psf-001.fits");
    let stars = stamps_of(&star, pixels_of(&star).1 / 8);

    write_cube(&folder, "cube.fits", &galaxies);
    write_extensions(&folder, "parts.fits", &galaxies[1..]);
    folder.image("first.fits", &[48, 48], &[], &galaxies[0]);
    write_cube(&folder, "stars.fits", &stars);
    write_extensions(&folder, "stars-parts.fits", &stars);
    // A position within half a pixel of the centre has the same stamp.
    let centre = |index: usize| index as f64 * 48.0 + 24.5;
    let rows = (0..64).map(|k| format!("{k},{},{}\n", centre(k % 8) + 0.4, centre(k / 8) - 0.4));
    let positions: String = ["id,ra_pixel,dec_pixel\n".to_owned()]
        .into_iter()
        .chain(rows)
        .collect();
    folder.write("positions.csv", positions);

    let exposure = "--exposure data/set19/galaxies-001.fits --positions positions.csv --columns ra_pixel,dec_pixel";
    for (name, from, psf) in [
        ("cube", "--stamps cube.fits", "stars.fits"),
        (
            "files",
            "--stamps first.fits parts.fits",
            "stars-parts.fits",
        ),
        ("exposure", exposure, "stars.fits"),
    ] {
        folder.run(&format!("gather {from} --psf {psf} --out {name}"));
        measure(&folder, name);
        let catalogue = format!("{name}-out/set01/catalogue-001.parquet");
        assert_eq!(bits(&folder, &catalogue), expected, "{name}");
    }
    // Stamps of an exposure have their places on it and the identities of the table; others have those of the image.
    let third = |name: &str, columns: &[&str]| {
        let table = parquet::read(folder.at(name), Some(columns), 64).unwrap();
        let values = table
            .columns()
            .iter()
            .map(|c| c.get(2).unwrap().to_string());
        values.collect::<Vec<_>>().join(" ")
    };
    let found = third("files-out/set01/catalogue-001.parquet", &["x", "y"]);
    assert_eq!(found, "120.5 24.5");
    let found = third(
        "exposure-out/set01/catalogue-001.parquet",
        &["id", "x", "y"],
    );
    assert_eq!(found, "2 120.9 24.1");
    let names = ["tile_x", "tile_y", "file", "image", "plane"];
    let found = third("files/set01/stamps-001.parquet", &names);
    assert_has(&found, "120.5 24.5 \"[..]parts.fits\" 2 1");

    // As many as do not fill a square, and one PSF by its parameters.
    write_cube(&folder, "few.fits", &galaxies[..5]);
    folder.write(
        "psf.csv",
        "x,y,profile,beta,fwhm,e1,e2\n0,0,moffat,3,3,0.01,0.02\n",
    );
    let gather = "gather --stamps few.fits --psf psf.csv --noise 1 --out five";
    folder.run(gather);
    folder.run("measure --submission 23/raw/func --data five --out five-out");
    let [x] = folder.numbers("five-out/set01/catalogue-001.parquet", ["x"]);
    assert_eq!(x, [24.5, 72.5, 120.5, 24.5, 72.5]);
    folder.refuses(gather, "the file is there already");
    // They are no grid that has a spectrum.
    let grid = "5 rows; expected the square of the grid's side";
    folder.refuses("pack --measured five-out --kind spectra --out sent", grid);
}

#[test]
fn correlated_noise_that_is_treated_as_white_is_named() {
    let folder = Folder::with_set(2);
    let galaxies = stamps_of(&folder.at("data/set02/galaxies-001.fits"), 48);
    let summed = galaxies.iter().map(|stamp| {
        let at = |y: usize, x: usize| stamp[y % 48 * 48 + x % 48];
        let sum = |y, x| at(y, x) + at(y + 1, x) + at(y, x + 1) + at(y + 1, x + 1);
        (0..48 * 48).map(|k| sum(k / 48, k % 48)).collect()
    });
    write_cube(&folder, "summed.fits", &summed.collect::<Vec<_>>());
    write_cube(&folder, "plain.fits", &galaxies);
    for name in ["plain", "summed"] {
        let psf = "data/set02/psf-001.fits";
        folder.run(&format!(
            "gather --stamps {name}.fits --psf {psf} --out {name}"
        ));
        for (noise, treats_as_white) in [
            ("", false),
            ("correlation = 0", true),
            ("source = \"border\"", true),
        ] {
            folder.write(
                "own.toml",
                format!("extends = \"48/linear/star\"\n[noise]\n{noise}\n"),
            );
            folder.remove("out");
            let said = folder.said(&format!(
                "measure --submission own.toml --data {name} --out out"
            ));
            let is_named = said.contains("is treated as white");
            assert_eq!(
                is_named,
                treats_as_white && name == "summed",
                "{name} {noise}: {said}"
            );
        }
    }
}

/// Pixels of the stamps that were gathered, of which those that are missing are NaN.
fn gathered(folder: &Folder, from: &str, side: usize) -> Vec<Vec<f32>> {
    gather(folder, &format!("{from} --psf psf.fits"));
    stamps_of(&folder.at("data/set01/galaxies-001.fits"), side)
}

/// Places of missing pixels, stamp after stamp.
fn lost(found: &[Vec<f32>]) -> Vec<usize> {
    let places = found.iter().flatten().enumerate();
    places
        .filter_map(|(at, value)| value.is_nan().then_some(at))
        .collect()
}

#[test]
fn compressed_cubes_are_read_plane_by_plane() {
    let folder = Folder::new();
    write_cube(&folder, "psf.fits", &[vec![1.0; 400]]);
    // As astropy wrote it, in tiles of 24 × 10 pixels.
    let cube = std::fs::read("tests/data/cube.fits").unwrap();
    folder.write("cube.fits", cube);
    let value = |plane: usize, at: usize| {
        ((17 * (at % 24) + 31 * (at / 24) + 101 * plane) % 256) as f32 / 16.0
    };
    let expected: [Vec<f32>; 3] =
        [0, 1, 2].map(|plane| (0..576).map(|at| value(plane, at)).collect());
    let found = gathered(&folder, "--stamps cube.fits", 24);
    assert_eq!(found[..3], expected);
}

#[test]
fn mask_bits_and_sextractors_blank_make_pixels_missing() {
    let folder = Folder::new();
    write_cube(&folder, "psf.fits", &[vec![1.0; 400]]);
    let mut stamp = vec![1.0f32; 400];
    // -1e29 is large, but a value.
    (stamp[9], stamp[10]) = (-1e30, -1e29);
    write_cube(&folder, "stamps.fits", &[stamp]);
    let mut mask = [0i32; 400];
    // Single precision has no 2^30 + 1. All bits of -2 but the lowest are set.
    mask[3..7].copy_from_slice(&[(1 << 30) + 1, 1 << 30, 6, -2]);
    let bytes: Vec<u8> = mask.iter().flat_map(|value| value.to_be_bytes()).collect();
    folder.write("mask.fits", fits_image(32, &[20, 20], &[], &bytes));
    write_cube(&folder, "half.fits", &[vec![0.5; 400]]);
    for (more, expected) in [
        ("", &[9][..]),
        ("--mask mask.fits", &[3, 4, 5, 6, 9]),
        ("--mask mask.fits --mask-bits 0", &[3, 9]),
        ("--mask mask.fits --mask-bits 1,30", &[3, 4, 5, 6, 9]),
    ] {
        let found = gathered(&folder, &format!("--stamps stamps.fits {more}"), 20);
        assert_eq!(lost(&found), expected, "{more}");
    }
    let bits = "--stamps stamps.fits --mask-bits 2 --psf psf.fits";
    refuse_to_gather(
        &folder,
        &format!("{bits} --mask half.fits"),
        "the mask has the value 0.5",
    );
    refuse_to_gather(&folder, bits, "without a mask");
    let mut wide = [1i64 << 60; 400];
    wide[3] += 1;
    let bytes: Vec<u8> = wide.iter().flat_map(|value| value.to_be_bytes()).collect();
    folder.write("wide.fits", fits_image(64, &[20, 20], &[], &bytes));
    let lost_bits = "expected values below 2^53). Try: a mask of 32-bit integers";
    refuse_to_gather(&folder, &format!("{bits} --mask wide.fits"), lost_bits);
}

#[test]
fn axes_of_length_one_are_left_out() {
    let folder = Folder::new();
    write_cube(&folder, "psf.fits", &[vec![1.0; 400]]);
    let stamp: Vec<f32> = (0..400u16).map(f32::from).collect();
    folder.image("radio.fits", &[20, 20, 1, 1], &[], &stamp);
    let found = gathered(&folder, "--stamps radio.fits", 20);
    assert_eq!(found, [stamp]);
}

#[test]
fn psfs_of_a_file_of_several_are_chosen_by_name() {
    let folder = Folder::new();
    write_cube(&folder, "stamps.fits", &[vec![1.0; 400]]);
    let mut file = fits_image(8, &[], &["EXTEND  = T"], &[]);
    for (name, side) in [
        ("OVERSAMP", 80),
        ("DET_SAMP", 20),
        ("OVERDIST", 80),
        ("DET_DIST", 20),
    ] {
        let card = format!("EXTNAME = '{name}'");
        let pixels = floats(&vec![1.0; side * side]);
        file.extend(fits_extension("IMAGE", -32, &[side; 2], &[&card], &pixels));
    }
    folder.write("stpsf.fits", file);
    let from = "--stamps stamps.fits --psf stpsf.fits";
    refuse_to_gather(&folder, from, "Try: --psf-extension DET_DIST");
    gather(&folder, &format!("{from} --psf-extension DET_DIST"));
    let mut star = vec![1.0; 400];
    star[7] = f32::NAN;
    write_cube(&folder, "nan.fits", &[star]);
    refuse_to_gather(
        &folder,
        "--stamps stamps.fits --psf nan.fits",
        "1 of 400 pixels of the PSF are missing",
    );
}

#[test]
fn pixel_axes_that_are_not_the_skys_are_stated() {
    let folder = Folder::with_set(2);
    let galaxies = stamps_of(&folder.at("data/set02/galaxies-001.fits"), 48);
    let (star, side) = pixels_of(&folder.at("data/set02/psf-001.fits"));
    let stack = [48, 48, galaxies.len()];
    // DECam's x is to the south and its y to the east.
    for (name, matrix) in [
        ("camera", [0.0, 1.0, -1.0, 0.0]),
        ("sky", [-1.0, 0.0, 0.0, 1.0]),
    ] {
        let keys = ["CD1_1", "CD1_2", "CD2_1", "CD2_2"].into_iter().zip(matrix);
        let mut cards: Vec<_> = keys
            .map(|(key, value)| format!("{key:<8}= {:>20.6E}", value * 7.3e-5))
            .collect();
        cards.extend(["CTYPE1  = 'RA---TAN'", "CTYPE2  = 'DEC--TAN'"].map(str::to_owned));
        let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
        folder.image(&format!("{name}.fits"), &stack, &cards, &galaxies.concat());
        folder.image(&format!("{name}-psf.fits"), &[side; 2], &cards, &star);
    }
    write_cube(&folder, "plain.fits", &galaxies);
    let gather = |stamps: &str, psf: &str, to: &str| {
        folder.said(&format!(
            "gather --stamps {stamps} --psf {psf} --image {to}"
        ))
    };
    let camera = |to: &str| gather("camera.fits", "camera-psf.fits", to);
    let sky = |to: &str| gather("sky.fits", "sky-psf.fits", to);
    let said = sky("1 --out both");
    assert!(
        !said.contains("warning") && !said.contains("frame"),
        "{said}"
    );
    let stated = "e1 and e2 are along the pixel axes, which are not the sky's (found rotated by 90.0° from north to east, mirrored, sheared by (+0.0000, +0.0000)";
    assert_has(&camera("1 --out camera --frame pixel"), stated);
    assert_has(&measure(&folder, "camera"), stated);
    assert_has(&folder.said("mean --measured camera-out"), stated);
    // Without the option, ellipticities are along the sky's axes: those of x to the south and y to the east have the other
    // sign of e1.
    let frame = "frame: sky (e1 > 0 along east–west, e2 > 0 along north-west). The WCS of the first stamp: rotated by 90.0° from north to east, mirrored";
    assert_has(&camera("1 --out turned"), frame);
    measure(&folder, "turned");
    let said = folder.said("mean --measured turned-out");
    assert!(!said.contains("pixel axes"), "{said}");
    let shapes = |data: &str| {
        folder.numbers(
            &format!("{data}-out/set01/catalogue-001.parquet"),
            ["e1", "e2"],
        )
    };
    let ([along1, along2], [sky1, sky2]) = (shapes("camera"), shapes("turned"));
    for k in 0..along1.len() {
        let off = (along1[k] + sky1[k]).abs().max((along2[k] - sky2[k]).abs());
        // Noise of the correction for noise.
        assert!(off < 0.02 || along1[k].is_nan(), "{k}: {off}");
    }
    camera("2 --out both --frame pixel");
    measure(&folder, "both");
    let other = "catalogue-001.parquet and no common mean with them (found pixel axes rotated by 90.0° from north to east, mirrored, sheared by (+0.0000, +0.0000); expected pixel axes rotated by 0.0° from north to east, not mirrored";
    folder.refuses("mean --measured both-out", other);
    // Both are along the sky in one set: axes that are the sky's anyhow, and those that the WCS turns.
    sky("1 --out all");
    camera("2 --out all");
    measure(&folder, "all");
    let mean = |data: &str| folder.json(&format!("mean --measured {data}-out"))["rows"][0].clone();
    let (mixed, turned, along) = (mean("all"), mean("turned"), mean("camera"));
    assert_eq!([&mixed["frame"], &along["frame"]], ["sky", "pixel"]);
    // The stamps are the same, so that on the sky e1 of the two images differs in sign and e2 does not.
    let number = |row: &Value, key: &str| row[key].as_f64().unwrap();
    let off = (number(&mixed, "g2") - number(&turned, "g2")).abs();
    assert!(
        off < 0.005 && number(&mixed, "g1").abs() < 0.005,
        "{mixed} {turned}"
    );
    let scored = |data: &str| {
        let truth = folder.at(&format!("{data}/set01/truth.csv"));
        std::fs::copy(folder.at("data/set02/truth.csv"), truth).unwrap();
        measure(&folder, data);
        folder.run(&format!("score --measured {data}-out --format csv"))
    };
    assert_has(&scored("turned"), ",frame,[..],sky,");
    assert!(!scored("camera").contains("frame"));
    // Pixels without a WCS may lie in any orientation.
    camera("1 --out open");
    gather("plain.fits", "data/set02/psf-001.fits", "2 --out open");
    measure(&folder, "open");
    let without = "(found pixel axes without a WCS; expected the axes of the sky)";
    folder.refuses("mean --measured open-out", without);
    let psf =
        "the PSF image and the galaxy image have pixel axes of different orientation or shear";
    folder.refuses(
        "gather --stamps sky.fits --psf camera-psf.fits --out mixed",
        psf,
    );
    let said = gather(
        "sky.fits camera.fits",
        "sky-psf.fits",
        "1 --out two --frame pixel",
    );
    assert_has(
        &said,
        "camera.fits: image 1, plane 1: the header states other pixel axes",
    );
}

/// Positions of the 8 × 8 galaxies of an image.
fn write_positions(folder: &Folder, within: f64) {
    let at = |k: usize| (k * 48 + 24) as f64 + within;
    let rows = (0..64).map(|k| format!("{k},{},{}\n", at(k % 8), at(k / 8)));
    folder.write(
        "positions.csv",
        "id,x,y\n".to_owned() + &rows.collect::<String>(),
    );
}

#[test]
fn each_galaxy_has_the_noise_of_its_place_and_of_its_light() {
    let folder = Folder::with_set(2);
    let exposure = "data/set02/galaxies-001.fits";
    let (pixels, width) = pixels_of(&folder.at(exposure));
    write_positions(&folder, 0.5);
    // The map has the light of the galaxies, as maps of counts do, and another depth from column 180 on, which is on a stamp.
    let variance = |at: usize| {
        let [x, y] = [at % width, at / width];
        let centre = (x % 48).abs_diff(24).max((y % 48).abs_diff(24));
        let own = if centre < 8 { 5.0 } else { 0.0 };
        own + if x < 180 { 1.0 } else { 4.0 }
    };
    let write = |name: &str, of: &dyn Fn(usize) -> f32| {
        let values: Vec<f32> = (0..width * width).map(of).collect();
        folder.image(name, &[width; 2], &[], &values);
    };
    write("variance.fits", &variance);
    write("weight.fits", &|at| 1.0 / variance(at));
    write("raised.fits", &|at| pixels[at] + 30.0);
    let columns = |exposure: &str, options: &str| {
        let from = format!("gather --exposure {exposure} --psf data/set02/psf-001.fits");
        folder.remove("own");
        folder.run(&format!(
            "{from} --positions positions.csv --out own {options}"
        ));
        measure(&folder, "own");
        let catalogue = "own-out/set01/catalogue-001.parquet";
        folder.numbers(catalogue, ["noise", "flux_error", "flux"])
    };
    let map = "--variance variance.fits";
    let dark = columns(exposure, map);
    for noise in [&dark[0], &columns(exposure, "--weight-map weight.fits")[0]] {
        for (k, found) in noise.iter().enumerate() {
            // Column 180 is right of the middle of the fourth stamp.
            let expected = if k % 8 < 4 { 1.0 } else { 2.0 };
            assert!((found - expected).abs() < 1e-6, "{k}: {found}");
        }
    }
    // With a map, too, the sky is subtracted: a sky of 30 on the hundred pixels of a window has thousands.
    let light = columns("raised.fits", map);
    for (light, dark) in light[2].iter().zip(&dark[2]) {
        assert!(
            (light - dark).abs() < 50.0 || dark.is_nan(),
            "{light} {dark}"
        );
    }
    let plain = columns(exposure, "");
    assert_eq!(columns(exposure, "--gain 1e30")[1..], plain[1..]);
    // The light of a galaxy under the window adds to the variance: flux over gain and area, less what the window leaves out.
    let own = columns(exposure, "--gain 0.2");
    for k in (0..64).filter(|k| plain[2][*k] >= 0.0) {
        let (noise, flux) = (plain[0][k], plain[2][k]);
        let ratio = (own[1][k] / plain[1][k]).powi(2) - 1.0;
        let area = ratio.recip() * flux / 0.2 / (noise * noise);
        // π w² for windows of 6.7 to 9.5 px, and up to 1.6 times as much.
        assert!((140.0..450.0).contains(&area), "{k}: {area}");
    }
}

#[test]
fn positions_come_from_standard_input() {
    let folder = Folder::with_set(2);
    write_positions(&folder, 0.5);
    let from = "gather --exposure data/set02/galaxies-001.fits --psf data/set02/psf-001.fits";
    folder.run(&format!("{from} --positions positions.csv --out file"));
    let root = folder.at("");
    printed(
        &root,
        &format!("cat positions.csv | shearq {from} --positions - --out pipe"),
    );
    let stamps = |out: &str| stamps_of(&folder.at(&format!("{out}/set01/galaxies-001.fits")), 48);
    assert_eq!(stamps("pipe"), stamps("file"));
    let line = format!("printf 'x,y\\n24.5,no\\n' | shearq {from} --positions - --out bad");
    assert_has(&refused(&root, &line), "standard-input: line 2");
}

#[test]
fn psfs_of_rows_that_are_left_out_are_left_out() {
    let folder = Folder::with_set(2);
    folder.write("positions.csv", "x,y\n24.5,24.5\n9999,24.5\n72.5,24.5\n");
    let round = |variance: f32| -> Vec<f32> {
        let offset = |at: usize| at as f32 - 23.5;
        let square = |at: usize| offset(at % 48).powi(2) + offset(at / 48).powi(2);
        (0..48 * 48)
            .map(|at| (-0.5 * square(at) / variance).exp())
            .collect()
    };
    let psfs = [2.0, 4.0, 3.0].map(round);
    write_cube(&folder, "psfs.fits", &psfs);
    let from = "gather --exposure data/set02/galaxies-001.fits --positions positions.csv";
    folder.said(&format!("{from} --psf psfs.fits --out cut"));
    let found = stamps_of(&folder.at("cut/set01/psf-001.fits"), 48);
    let peak = |psf: &[f32]| {
        let sum: f32 = psf.iter().sum();
        psf.iter().copied().fold(0.0, f32::max) / sum
    };
    assert_eq!(found.len(), 2);
    for (found, expected) in found.iter().zip([&psfs[0], &psfs[2]]) {
        // Single precision.
        assert!((peak(found) / peak(expected) - 1.0).abs() < 1e-5);
    }
}

#[test]
fn exposures_of_one_call_are_epochs_or_say_why_not() {
    let folder = Folder::with_set(2);
    let (pixels, width) = pixels_of(&folder.at("data/set02/galaxies-001.fits"));
    write_positions(&folder, 0.0);
    // Without places on the sky, which would be those of other galaxies.
    let linear = [
        "CTYPE1  = 'LINEAR'",
        "CTYPE2  = 'LINEAR'",
        "CUNIT1  = 'arcsec'",
        "CUNIT2  = 'arcsec'",
    ];
    for (name, matrix) in [
        ("along.fits", ["CD1_1   = 0.26", "CD2_2   = 0.26"]),
        ("turned.fits", ["CD1_2   = -0.26", "CD2_1   = 0.26"]),
        ("coarse.fits", ["CD1_1   = 0.3", "CD2_2   = 0.3"]),
    ] {
        folder.image(name, &[width; 2], &[&linear[..], &matrix].concat(), &pixels);
    }
    folder.image("plain.fits", &[width; 2], &[], &pixels);
    let gather = |exposures: &str, out: &str| {
        let psfs = "data/set02/psf-001.fits ".repeat(exposures.split(' ').count());
        format!("gather --exposure {exposures} --psf {psfs} --positions positions.csv --out {out}")
    };
    let measure = |data: &str| {
        folder.remove(&format!("{data}-out"));
        format!("measure --epochs --data {data} {LINEAR} --out {data}-out")
    };
    for (exposures, data) in [
        ("along.fits turned.fits along.fits", "three"),
        ("along.fits coarse.fits", "scales"),
    ] {
        assert_has(&folder.said(&gather(exposures, data)), "frame: sky");
        folder.run(&measure(data));
    }
    let none = gather("along.fits plain.fits turned.fits", "none");
    let pixels =
        "plain.fits: the exposures have different pixels on the sky, and the header has no WCS";
    folder.refuses(&none, pixels);
    // Another call does not know the first one.
    folder.run(&format!("{} --image 4", gather("along.fits", "three")));
    let some = "galaxies-004.fits: some epochs have Jacobians and others have none[..]Try:";
    folder.refuses(&measure("three"), some);
    folder.remove("three/set01/galaxies-002.fits");
    let absent =
        "galaxies-002.fits: there is no such image (found 1, 3, 4 of set 1, expected 1 to 4";
    folder.refuses(&measure("three"), absent);
}
