//! Stamps that lie otherwise than a challenge's: gathered from cubes, extensions, single files and exposures, they are
//! measured as they were.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

use crate::support::{
    Small, fail, fits_image, floats, pixels_of, printed, shearq, shell, succeed, text,
};

const LINEAR: &str = "48/linear/star";

/// The stamps of a mosaic, along its rows.
fn stamps_of(path: &Path, side: usize) -> Vec<Vec<f32>> {
    let (pixels, width) = pixels_of(path);
    let n = width / side;
    (0..n * n)
        .map(|k| {
            let (x, y) = (k % n * side, k / n * side);
            let rows = (y..y + side).map(|row| &pixels[row * width + x..row * width + x + side]);
            rows.flatten().copied().collect()
        })
        .collect()
}

fn cube(stamps: &[Vec<f32>], side: usize) -> Vec<u8> {
    fits_image(
        -32,
        &[side, side, stamps.len()],
        &[],
        &floats(&stamps.concat()),
    )
}

/// A file of an empty primary header and one extension a stamp.
fn extensions(stamps: &[Vec<f32>], side: usize) -> Vec<u8> {
    let unnamed: Vec<(&str, &[f32])> = stamps.iter().map(|stamp| ("", &stamp[..])).collect();
    named_extensions(&unnamed, side)
}

/// The same with names.
fn named_extensions(stamps: &[(&str, &[f32])], side: usize) -> Vec<u8> {
    let mut file = fits_image(8, &[], &["EXTEND  =                    T"], &[]);
    for (name, stamp) in stamps {
        let name = format!("EXTNAME = '{name:<8}'");
        let keys = [
            "PCOUNT  =                    0",
            "GCOUNT  =                    1",
            &name,
        ];
        let mut image = fits_image(-32, &[side, side], &keys, &floats(stamp));
        image[..80].copy_from_slice(format!("{:<80}", "XTENSION= 'IMAGE   '").as_bytes());
        file.extend(image);
    }
    file
}

/// Bits of e1, e2 and the flags of the first catalogue of set 1 or 19.
fn measured(small: &Small, data: &Path, set: &str) -> Vec<Vec<u64>> {
    let out = small.at("out");
    let _ = fs::remove_dir_all(&out);
    let measure = ["measure", "--submission", LINEAR, "--out", text(&out)];
    succeed(&[&measure[..], &["--data", text(data)]].concat());
    ["e1", "e2", "flags"]
        .map(|column| {
            let values = small.measured(set, column);
            values.iter().map(|value| value.to_bits()).collect()
        })
        .into()
}

/// Gathers into `data`; what was printed on standard error, and whether it succeeded.
fn gather(root: &Path, from: &str) -> (bool, String) {
    let done = shell(
        root,
        &format!("rm -rf data; shearq gather {from} --out data"),
    );
    (
        done.status.success(),
        String::from_utf8(done.stderr).unwrap(),
    )
}

#[test]
fn stamps_of_all_kinds_of_files_are_measured_alike() {
    let small = Small::new("19");
    let at = |name: &str| small.at(name);
    let set = at("data/set19");
    fs::remove_file(set.join("galaxies-002.fits")).unwrap();
    let expected = measured(&small, &at("data"), "19");
    assert_eq!(expected[0].len(), 64);
    let galaxies = stamps_of(&set.join("galaxies-001.fits"), 48);
    let stars = stamps_of(
        &set.join("psf-001.fits"),
        pixels_of(&set.join("psf-001.fits")).1 / 8,
    );
    let side = stars[0].len().isqrt();

    fs::write(at("cube.fits"), cube(&galaxies, 48)).unwrap();
    fs::write(at("parts.fits"), extensions(&galaxies[1..], 48)).unwrap();
    let one = fits_image(-32, &[48, 48], &[], &floats(&galaxies[0]));
    fs::write(at("first.fits"), one).unwrap();
    fs::write(at("stars.fits"), cube(&stars, side)).unwrap();
    fs::write(at("stars-parts.fits"), extensions(&stars, side)).unwrap();
    let mut positions = String::from("id,ra_pixel,dec_pixel\n");
    for k in 0..64 {
        let centre = |index: usize| index as f64 * 48.0 + 24.5;
        // A position within half a pixel of the centre has the same stamp.
        let (x, y) = (centre(k % 8) + 0.4, centre(k / 8) - 0.4);
        positions += &format!("{k},{x},{y}\n");
    }
    fs::write(at("positions.csv"), positions).unwrap();

    let (cube, parts, first) = (at("cube.fits"), at("parts.fits"), at("first.fits"));
    let (exposure, positions) = (set.join("galaxies-001.fits"), at("positions.csv"));
    let ways: [(&str, Vec<&str>, PathBuf); 3] = [
        ("cube", vec!["--stamps", text(&cube)], at("stars.fits")),
        (
            "files",
            vec!["--stamps", text(&first), text(&parts)],
            at("stars-parts.fits"),
        ),
        (
            "exposure",
            vec![
                "--exposure",
                text(&exposure),
                "--positions",
                text(&positions),
                "--columns",
                "ra_pixel,dec_pixel",
            ],
            at("stars.fits"),
        ),
    ];
    for (name, from, psf) in &ways {
        let data = at(name);
        let rest = ["--psf", text(psf), "--out", text(&data)];
        succeed(&[&["gather"][..], from, &rest].concat());
        assert_eq!(measured(&small, &data, "01"), expected, "{name}");
    }
    // Stamps of an exposure have their places on it and the identities of the table; others have those of the image.
    let catalogue = |name: &str, columns: &[&str]| {
        let out = small.at("catalogue");
        let _ = fs::remove_dir_all(&out);
        let measure = ["measure", "--submission", LINEAR, "--out", text(&out)];
        succeed(&[&measure[..], &["--data", text(&at(name))]].concat());
        let path = out.join("set01/catalogue-001.parquet");
        let table = shearq_files::parquet::read(&path, Some(columns), 64).unwrap();
        let row = |k: usize| {
            table
                .columns()
                .iter()
                .map(move |c| c.get(k).unwrap().to_string())
        };
        [0, 2].map(|k| row(k).collect::<Vec<_>>().join(" "))
    };
    assert_eq!(catalogue("files", &["x", "y"]), ["24.5 24.5", "120.5 24.5"]);
    let expected = ["0 24.9 24.1", "2 120.9 24.1"];
    assert_eq!(catalogue("exposure", &["id", "x", "y"]), expected);
    let stamps = at("files").join("set01/stamps-001.parquet");
    let names = ["tile_x", "tile_y", "file", "image", "plane"];
    let table = shearq_files::parquet::read(&stamps, Some(&names), 64).unwrap();
    let third = format!("120.5 24.5 {:?} 2 1", text(&parts));
    let values = table
        .columns()
        .iter()
        .map(|c| c.get(2).unwrap().to_string());
    assert_eq!(values.collect::<Vec<_>>().join(" "), third);

    // As many as do not fill a square, and one PSF by its parameters.
    fs::write(at("few.fits"), self::cube(&galaxies[..5], 48)).unwrap();
    let formula = "x,y,profile,beta,fwhm,e1,e2\n0,0,moffat,3,3,0.01,0.02\n";
    fs::write(at("psf.csv"), formula).unwrap();
    let (few, psf, data) = (at("few.fits"), at("psf.csv"), at("five"));
    let gather = ["gather", "--stamps", text(&few), "--psf", text(&psf)];
    let more = ["--noise", "1", "--out", text(&data)];
    succeed(&[&gather[..], &more].concat());
    let out = at("out");
    let _ = fs::remove_dir_all(&out);
    let measure = [
        "measure",
        "--submission",
        "23/raw/func",
        "--out",
        text(&out),
    ];
    succeed(&[&measure[..], &["--data", text(&data)]].concat());
    assert_eq!(small.measured("01", "x"), [24.5, 72.5, 120.5, 24.5, 72.5]);
    let again = fail(&[&gather[..], &more].concat());
    assert!(again.contains("the file is there already"), "{again}");
    // They are no grid that has a spectrum.
    let sent = at("sent");
    let pack = ["pack", "--measured", text(&out), "--kind", "spectra"];
    let message = fail(&[&pack[..], &["--out", text(&sent)]].concat());
    assert!(
        message.contains("5 rows; expected the square of the grid's side"),
        "{message}"
    );
}

#[test]
fn the_mean_of_a_field_is_that_of_its_catalogue() {
    let small = Small::new("2");
    small.measure(&["--submission", LINEAR]);
    let out = small.at("out");
    let mean = printed(small.root(), "shearq mean --measured out --format json");
    let table: Value = serde_json::from_str(&mean).unwrap();
    let row = &table["rows"][0];
    let value = |key: &str| row[key].as_f64().unwrap();
    let (mut flagged, mut galaxies) = (0, Vec::new());
    for image in ["001", "002"] {
        let from = out.join(format!("set02/catalogue-{image}.parquet"));
        fs::rename(&from, out.join("set02/catalogue-001.parquet")).unwrap();
        let columns =
            ["e1", "e2", "R11", "R12", "R21", "R22"].map(|name| small.measured("02", name));
        let good: Vec<usize> = (0..columns[0].len())
            .filter(|k| columns[0][*k].is_finite())
            .collect();
        flagged += columns[0].len() - good.len();
        galaxies.extend(good.iter().map(|k| {
            let row: [f64; 6] = std::array::from_fn(|column| columns[column][*k]);
            ([row[0], row[1]], [[row[2], row[3]], [row[4], row[5]]])
        }));
    }
    let n = galaxies.len() as f64;
    let mut e = [0.0; 2];
    let mut r = [[0.0; 2]; 2];
    for (own, response) in &galaxies {
        for k in 0..2 {
            e[k] += own[k] / n;
            for j in 0..2 {
                r[k][j] += response[k][j] / n;
            }
        }
    }
    let determinant = r[0][0] * r[1][1] - r[0][1] * r[1][0];
    let solved = |e: [f64; 2]| {
        [
            (r[1][1] * e[0] - r[0][1] * e[1]) / determinant,
            (r[0][0] * e[1] - r[1][0] * e[0]) / determinant,
        ]
    };
    let shear = solved(e);
    // Sums in another order.
    let near = |found: f64, expected: f64| (found - expected).abs() < 1e-12;
    assert!(near(value("g1"), shear[0]) && near(value("g2"), shear[1]));
    // The error of a ratio of means contains the scatter of the responses.
    let squares: f64 = galaxies
        .iter()
        .map(|(own, response)| {
            let residual =
                [0, 1].map(|k| own[k] - response[k][0] * shear[0] - response[k][1] * shear[1]);
            solved(residual)[1].powi(2)
        })
        .sum();
    assert!(near(value("g2_error"), (squares / (n * (n - 1.0))).sqrt()));
    let square: f64 = galaxies
        .iter()
        .map(|(own, _)| (own[1] - e[1]).powi(2))
        .sum();
    assert!(near(
        value("scatter2"),
        (square / (n - 1.0)).sqrt() / r[1][1]
    ));
    assert_eq!(value("galaxies"), n);
    assert_eq!(value("flagged"), flagged as f64);
}

#[test]
fn several_stars_of_one_psf_are_averaged() {
    const STARS: usize = 9;
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.05, -0.02)).unwrap();
    let truth = psf.stamp(48);
    let power = truth.iter().map(|v| v * v).sum::<f64>().sqrt();
    // A fixed sequence of numbers of mean zero and variance one: the stars have S/N 100.
    let mut state = 7u32;
    let mut noise = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        12f64.sqrt() * (f64::from(state >> 8) / f64::from(1 << 24) - 0.5) * power / 100.0
    };
    let stars: Vec<Vec<f32>> = (0..STARS)
        .map(|_| truth.iter().map(|v| (v + noise()) as f32).collect())
        .collect();
    let stamps: Vec<Vec<f32>> = (0..20)
        .map(|_| {
            truth
                .iter()
                .map(|v| (50.0 * v + 20.0 * noise()) as f32)
                .collect()
        })
        .collect();
    fs::write(at("stamps.fits"), cube(&stamps, 48)).unwrap();
    fs::write(at("stars.fits"), cube(&stars, 48)).unwrap();
    let (done, said) = gather(root.path(), "--stamps stamps.fits --psf stars.fits");
    assert!(done, "{said}");
    let expected = "stars.fits: 9 stars were averaged to one PSF for all galaxies";
    assert!(said.contains(expected), "{said}");
    let (average, side) = pixels_of(&at("data/set01/psf-001.fits"));
    assert_eq!(side, 48);
    let off = |star: &[f32]| {
        let sum: f64 = star.iter().map(|v| f64::from(*v)).sum();
        let each = star.iter().zip(&truth);
        each.map(|(v, t)| (f64::from(*v) / sum - t).powi(2))
            .sum::<f64>()
            .sqrt()
    };
    // Nine stars have a third of the noise of one; shifts by their measured places add to it.
    let ratio = off(&average) / off(&stars[0]);
    assert!(ratio < 0.5, "{ratio}");
}

#[test]
fn correlated_noise_treated_as_white_and_padding_are_named() {
    let small = Small::new("2");
    let set = small.at("data/set02");
    let galaxies = stamps_of(&set.join("galaxies-001.fits"), 48);
    let settings = |name: &str, lines: &str| {
        let text = format!("extends = \"{LINEAR}\"\n[noise]\n{lines}\n");
        fs::write(small.at(name), text).unwrap();
    };
    settings("white.toml", "correlation = 0");
    settings("border.toml", "source = \"border\"");
    let measure = |name: &str, stamps: &[Vec<f32>], submission: &str| {
        if !small.at(name).exists() {
            fs::write(small.at("stamps.fits"), cube(stamps, 48)).unwrap();
            let gather = "shearq gather --stamps stamps.fits --psf data/set02/psf-001.fits";
            printed(small.root(), &format!("{gather} --out {name}"));
        }
        let measure = format!("shearq measure --submission {submission} --data {name} --out out");
        let done = shell(small.root(), &format!("rm -rf out; {measure}"));
        (
            done.status.success(),
            String::from_utf8(done.stderr).unwrap(),
        )
    };
    let summed: Vec<Vec<f32>> = galaxies
        .iter()
        .map(|stamp| {
            let at = |y: usize, x: usize| stamp[y % 48 * 48 + x % 48];
            let sum = |y, x| at(y, x) + at(y + 1, x) + at(y, x + 1) + at(y + 1, x + 1);
            (0..48 * 48).map(|k| sum(k / 48, k % 48)).collect()
        })
        .collect();
    for (submission, told) in [(LINEAR, false), ("white.toml", true), ("border.toml", true)] {
        let (_, said) = measure("plain", &galaxies, submission);
        assert!(!said.contains("is treated as white"), "{said}");
        let (well, said) = measure("summed", &summed, submission);
        assert!(
            well && said.contains("is treated as white") == told,
            "{said}"
        );
    }
    let mut padded = galaxies;
    for (k, value) in padded.iter_mut().flatten().enumerate() {
        let (y, x) = (k / 48 % 48, k % 48);
        if y.min(x) < 3 || y.max(x) > 44 {
            *value = 0.0;
        }
    }
    let (well, said) = measure("padded", &padded, LINEAR);
    assert!(
        !well && said.contains("expected two or more complete borders"),
        "{said}"
    );
}

/// Pixels of the stamps that were gathered, of which those that are missing are NaN.
fn gathered(root: &Path, from: &str, side: usize) -> Vec<Vec<f32>> {
    let (done, said) = gather(root, &format!("{from} --psf psf.fits"));
    assert!(done, "{said}");
    stamps_of(&root.join("data/set01/galaxies-001.fits"), side)
}

/// Places of missing pixels, stamp after stamp.
fn lost(found: &[Vec<f32>]) -> Vec<usize> {
    let places = found.iter().flatten().enumerate();
    let missing = places.filter(|(_, value)| value.is_nan());
    missing.map(|(at, _)| at).collect()
}

#[test]
fn extensions_are_chosen_by_name_and_masks_make_pixels_missing() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    fs::write(at("psf.fits"), cube(&[vec![1.0; 400]], 20)).unwrap();
    let stamps: Vec<Vec<f32>> = (0..4).map(|k| vec![1.0 + k as f32; 576]).collect();
    let mut flags = vec![vec![0.0f32; 576]; 4];
    flags[2][24 * 3 + 5] = 4.0;
    let mut parts: Vec<(&str, &[f32])> = Vec::new();
    for (stamp, flag) in stamps.iter().zip(&flags) {
        parts.extend([("SCI", &stamp[..]), ("ERR", flag), ("DQ", flag)]);
    }
    fs::write(at("parts.fits"), named_extensions(&parts, 24)).unwrap();
    fs::write(at("masks.fits"), cube(&flags, 24)).unwrap();
    let sky = "--stamps parts.fits --extension sci";
    assert_eq!(gathered(root.path(), sky, 24), stamps);
    for mask in ["--mask-extension DQ", "--mask masks.fits"] {
        let found = gathered(root.path(), &format!("{sky} {mask}"), 24);
        assert_eq!(lost(&found), [2 * 576 + 24 * 3 + 5]);
        assert_eq!(found[3], stamps[3]);
    }

    // An exposure of the four side by side, as its first image.
    let wide = |of: &[Vec<f32>]| {
        let rows =
            (0..24).flat_map(|y| of.iter().flat_map(move |s| s[24 * y..24 * y + 24].to_vec()));
        fits_image(-32, &[96, 24], &[], &floats(&rows.collect::<Vec<_>>()))
    };
    fs::write(at("wide.fits"), wide(&stamps)).unwrap();
    fs::write(at("wide-mask.fits"), wide(&flags)).unwrap();
    let positions = "x,y\n12.5,12.5\n36.5,12.5\n60.5,12.5\n84.5,12.5\n";
    fs::write(at("places.csv"), positions).unwrap();
    // What is called a mask may be one.
    let called: Vec<(&str, &[f32])> = flags.iter().map(|flag| ("MASK", &flag[..])).collect();
    fs::write(at("named.fits"), named_extensions(&called, 24)).unwrap();
    let cut = "--exposure wide.fits --positions places.csv --size 24";
    for masked in [
        format!("{cut} --mask wide-mask.fits"),
        format!("{sky} --mask named.fits"),
    ] {
        let found = gathered(root.path(), &masked, 24);
        assert_eq!(lost(&found), [2 * 576 + 24 * 3 + 5]);
    }
    fs::write(at("three.fits"), cube(&flags[..3], 24)).unwrap();
    let five = [&flags[..], &flags[..1]].concat();
    fs::write(at("five.fits"), cube(&five, 24)).unwrap();
    for (from, more, expected) in [
        (
            "--stamps parts.fits",
            "",
            "parts.fits: image 2, plane 1: the image is called ERR; expected an image of the sky or a PSF. Try: choose images by name with --extension",
        ),
        (
            "--stamps parts.fits",
            "--extension PRIMARY",
            "there is no image called `PRIMARY`; found `SCI`, `ERR`, `DQ`, `SCI`",
        ),
        (
            sky,
            "--mask parts.fits",
            "parts.fits: image 1, plane 1: the mask is the image itself; expected another (--mask-extension)",
        ),
        (
            cut,
            "--mask wide-mask.fits named.fits",
            "named.fits: this is a second file",
        ),
        (
            sky,
            "--mask three.fits",
            "image 10, plane 1: there is no mask for this stamp",
        ),
        (
            sky,
            "--mask five.fits",
            "plane 5: there is no stamp for this mask",
        ),
        (
            sky,
            "--mask wide-mask.fits",
            "wide-mask.fits: image 1, plane 1: the mask is 96 × 24 pixels; its stamp has 24 × 24",
        ),
        (
            cut,
            "--mask masks.fits",
            "masks.fits: image 1, plane 1: the image has 4 planes",
        ),
        (
            cut,
            "--mask psf.fits",
            "the mask is 20 × 20 pixels; the exposure has 96 × 24",
        ),
    ] {
        let (done, message) = gather(root.path(), &format!("{from} {more} --psf psf.fits"));
        assert!(!done && message.contains(expected), "{message}");
        assert!(!at("data/set01/galaxies-001.fits").exists());
    }
}

#[test]
fn compressed_cubes_are_read_plane_by_plane() {
    let root = tempfile::tempdir().unwrap();
    fs::write(root.path().join("psf.fits"), cube(&[vec![1.0; 400]], 20)).unwrap();
    // As astropy wrote it, in tiles of 24 × 10 pixels.
    let bytes = fs::read("tests/data/cube.fits").unwrap();
    fs::write(root.path().join("cube.fits"), &bytes).unwrap();
    let value = |plane: usize, at: usize| {
        ((17 * (at % 24) + 31 * (at / 24) + 101 * plane) % 256) as f32 / 16.0
    };
    let expected: Vec<Vec<f32>> = (0..3)
        .map(|plane| (0..576).map(|at| value(plane, at)).collect())
        .collect();
    let found = gathered(root.path(), "--stamps cube.fits", 24);
    assert_eq!(found[..3], expected);
}

#[test]
fn psfs_of_other_pixels_or_wider_than_galaxies_are_reported() {
    let small = Small::new("2");
    let set = small.at("data/set02");
    let galaxies = stamps_of(&set.join("galaxies-001.fits"), 48);
    let (star, side) = pixels_of(&set.join("psf-001.fits"));
    let scale = |arcsec: &str| format!("PIXSCALE= {arcsec:>20}");
    let write = |name: &str, sides: &[usize], scale: &str, pixels: &[f32]| {
        let file = fits_image(-32, sides, &[scale], &floats(pixels));
        fs::write(small.at(name), file).unwrap();
    };
    let sides = [48, 48, galaxies.len()];
    write("stamps.fits", &sides, &scale("0.2"), &galaxies.concat());
    let gather = |psf: &str| gather(small.root(), &format!("--stamps stamps.fits --psf {psf}"));
    write("good.fits", &[side; 2], &scale("0.2"), &star);
    let (done, said) = gather("good.fits");
    assert!(done && !said.contains("warning"), "{said}");
    write("other.fits", &[side; 2], &scale("0.263"), &star);
    let (done, said) = gather("other.fits");
    let expected = "warning: set 01 image 001: the PSF image and the galaxy image have different pixel scales (found 0.263, expected 0.2 arcsec";
    assert!(done && said.contains(expected), "{said}");
    // A Gaussian of FWHM 14 px.
    let wide: Vec<f32> = (0..side * side)
        .map(|k| [k % side, k / side].map(|at| at as f32 - (side as f32 - 1.0) / 2.0))
        .map(|[x, y]| (-(x * x + y * y) / 72.0).exp())
        .collect();
    write("wide.fits", &[side; 2], &scale("0.2"), &wide);
    let (done, said) = gather("wide.fits");
    let expected = "wide.fits: the PSF is broader than the galaxies";
    assert!(!done && said.contains(expected), "{said}");
    assert!(!small.at("data/set01").exists());
}

#[test]
fn stamps_become_squares_of_the_largest_side_on_request() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    fs::write(at("psf.fits"), cube(&[vec![1.0; 400]], 20)).unwrap();
    let value = |x: usize, y: usize| (100 * y + x) as f32;
    let image = |name: &str, [columns, rows]: [usize; 2]| {
        let pixels: Vec<f32> = (0..columns * rows)
            .map(|at| value(at % columns, at / columns))
            .collect();
        let file = fits_image(-32, &[columns, rows], &[], &floats(&pixels));
        fs::write(at(name), file).unwrap();
    };
    // Column 0 and row 0 of the stamp are at `first` in the file.
    let expected = |side: usize, [columns, rows]: [usize; 2], first: [i64; 2]| -> Vec<u32> {
        let pixel = |at: usize| {
            let (x, y) = ((at % side) as i64 + first[0], (at / side) as i64 + first[1]);
            match (0..columns as i64).contains(&x) && (0..rows as i64).contains(&y) {
                true => value(x as usize, y as usize).to_bits(),
                false => f32::NAN.to_bits(),
            }
        };
        (0..side * side).map(pixel).collect()
    };
    let bits = |stamp: &[f32]| -> Vec<u32> { stamp.iter().map(|value| value.to_bits()).collect() };
    image("wide.fits", [24, 20]);
    image("small.fits", [21, 21]);
    image("large.fits", [24, 24]);
    let wide = "--stamps wide.fits";
    let (_, message) = gather(root.path(), &format!("{wide} --psf psf.fits"));
    let explained = message.contains("24 × 20") && message.contains("--square crop");
    assert!(explained, "{message}");
    let square = |how: &str, side| {
        let found = gathered(root.path(), &format!("{wide} --square {how}"), side);
        bits(&found[0])
    };
    assert_eq!(square("crop", 20), expected(20, [24, 20], [2, 0]));
    assert_eq!(square("pad", 24), expected(24, [24, 20], [0, -2]));
    // A mask has the shape of its stamp.
    let mut mask = vec![0.0f32; 480];
    mask[24 * 5 + 7] = 1.0;
    let mask = fits_image(-32, &[24, 20], &[], &floats(&mask));
    fs::write(at("mask.fits"), mask).unwrap();
    let masked = format!("{wide} --square crop --mask mask.fits");
    assert_eq!(lost(&gathered(root.path(), &masked, 20)), [20 * 5 + 5]);
    // Without a request: these are squares.
    let both = "--stamps small.fits large.fits large.fits large.fits";
    let found = gathered(root.path(), both, 24);
    assert_eq!(bits(&found[0]), expected(24, [21, 21], [-2, -2]));
    assert_eq!(bits(&found[1]), expected(24, [24, 24], [0, 0]));
    let (_, said) = gather(root.path(), &format!("{both} --psf psf.fits"));
    let note = "the stamps have sides of 21 to 24 px";
    assert!(said.contains(note), "{said}");
}

#[test]
fn mask_bits_and_sextractors_blank_make_pixels_missing() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    fs::write(at("psf.fits"), cube(&[vec![1.0; 400]], 20)).unwrap();
    let mut stamp = vec![1.0f32; 400];
    stamp[9] = -1e30;
    // Large, but a value.
    stamp[10] = -1e29;
    let mut mask = vec![0i32; 400];
    // Single precision has no 2^30 + 1.
    mask[3] = (1 << 30) + 1;
    mask[4] = 1 << 30;
    mask[5] = 6;
    // All bits but the lowest.
    mask[6] = -2;
    let bytes: Vec<u8> = mask.iter().flat_map(|value| value.to_be_bytes()).collect();
    let mut half = vec![0.0f32; 400];
    half[0] = 0.5;
    fs::write(at("stamps.fits"), cube(&[stamp], 20)).unwrap();
    fs::write(at("mask.fits"), fits_image(32, &[20, 20], &[], &bytes)).unwrap();
    fs::write(at("half.fits"), cube(&[half], 20)).unwrap();
    for (more, expected) in [
        ("", &[9][..]),
        ("--mask mask.fits", &[3, 4, 5, 6, 9]),
        ("--mask mask.fits --mask-bits 0", &[3, 9]),
        ("--mask mask.fits --mask-bits 1,30", &[3, 4, 5, 6, 9]),
    ] {
        let found = gathered(root.path(), &format!("--stamps stamps.fits {more}"), 20);
        assert_eq!(lost(&found), expected, "{more}");
    }
    for (more, expected) in [
        ("--mask half.fits", "the mask has the value 0.5"),
        ("", "without a mask"),
    ] {
        let from = format!("--stamps stamps.fits --mask-bits 2 --psf psf.fits {more}");
        let (done, message) = gather(root.path(), &from);
        assert!(!done && message.contains(expected), "{message}");
    }
}

#[test]
fn small_psfs_and_grids_of_stars_are_explained() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let profile = PsfProfile::Moffat { beta: 3.0 };
    let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.0, 0.0)).unwrap();
    let star = |side: usize| -> Vec<f32> { psf.stamp(side).iter().map(|v| *v as f32).collect() };
    let one = star(48);
    // As GREAT3 has them.
    let nine: Vec<f32> = (0..144 * 144)
        .map(|at| one[at / 144 % 48 * 48 + at % 144 % 48])
        .collect();
    for (name, stamps, side) in [
        ("stamps.fits", vec![one.clone(); 4], 48),
        ("three.fits", vec![one; 3], 48),
        ("small.fits", vec![star(24)], 24),
        ("nine.fits", vec![nine], 144),
        ("large.fits", vec![star(144)], 144),
    ] {
        fs::write(at(name), cube(&stamps, side)).unwrap();
    }
    let said = |psf: &str| {
        let line =
            format!("rm -rf new; shearq gather --stamps stamps.fits --psf {psf} --out new/data");
        let done = shell(root.path(), &line);
        // A failure leaves no folder.
        assert_eq!(at("new").exists(), done.status.success());
        String::from_utf8(done.stderr).unwrap()
    };
    for (psf, expected) in [
        ("absent.fits", "absent.fits"),
        ("three.fits", "at least twice as many stamps"),
        ("small.fits", "24 × 24 px (expected 32 × 32"),
        ("small.fits", "psf.size = 24"),
        ("nine.fits", "the image has 3 × 3 stars"),
        ("nine.fits", "a cube of 9 stamps of 48 × 48 px"),
    ] {
        let message = said(psf);
        assert!(message.contains(expected), "{message}");
    }
    let message = said("large.fits");
    let quiet = !message.contains("stars") && !message.contains("expected 32");
    assert!(quiet, "{message}");
}

#[test]
fn pixel_axes_that_are_not_the_skys_are_stated() {
    let small = Small::new("2");
    let set = small.at("data/set02");
    let galaxies = stamps_of(&set.join("galaxies-001.fits"), 48);
    let (star, side) = pixels_of(&set.join("psf-001.fits"));
    let header = |matrix: [f64; 4]| -> Vec<String> {
        let names = ["CD1_1", "CD1_2", "CD2_1", "CD2_2"].into_iter();
        let mut cards: Vec<_> = names
            .zip(matrix)
            .map(|(name, value)| format!("{name:<8}= {:>20.6E}", value * 7.3e-5))
            .collect();
        cards.extend(["CTYPE1  = 'RA---TAN'", "CTYPE2  = 'DEC--TAN'"].map(str::to_owned));
        cards
    };
    // DECam's x is to the south and its y to the east.
    let [on_camera, on_sky] = [
        ("camera", [0.0, 1.0, -1.0, 0.0]),
        ("sky", [-1.0, 0.0, 0.0, 1.0]),
    ]
    .map(|(name, matrix)| {
        let cards = header(matrix);
        let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
        let write = |name: String, sides: &[usize], pixels: &[f32]| {
            let path = small.at(&name);
            fs::write(&path, fits_image(-32, sides, &cards, &floats(pixels))).unwrap();
            path
        };
        let stack = [48, 48, galaxies.len()];
        (
            write(format!("{name}.fits"), &stack, &galaxies.concat()),
            write(format!("{name}-psf.fits"), &[side; 2], &star),
        )
    });
    let said = |arguments: &[&str]| {
        let done = shearq(arguments);
        let said = String::from_utf8(done.stderr).unwrap();
        assert!(done.status.success(), "{said}");
        said
    };
    let gather = |stamps: &[&str], psf: &Path, [image, out, frame]: [&str; 3]| {
        let out = small.at(out);
        let rest = ["--psf", text(psf), "--image", image, "--out", text(&out)];
        let frame = if frame.is_empty() {
            &[][..]
        } else {
            &["--frame", frame]
        };
        said(&[&["gather", "--stamps"][..], stamps, &rest, frame].concat())
    };
    let measure = |data: &str| {
        let (data, out) = (small.at(data), small.at(&format!("{data}-out")));
        let measure = ["measure", "--submission", LINEAR, "--data", text(&data)];
        said(&[&measure[..], &["--out", text(&out)]].concat())
    };
    let (camera, sky) = (text(&on_camera.0), text(&on_sky.0));
    let message = gather(&[sky], &on_sky.1, ["1", "both", ""]);
    assert!(
        !message.contains("warning") && !message.contains("frame"),
        "{message}"
    );
    let out = small.at("camera-out");
    let stated = "e1 and e2 are along the pixel axes, which are not the sky's (found rotated by 90.0° from north to east, mirrored, sheared by (+0.0000, +0.0000)";
    for message in [
        gather(&[camera], &on_camera.1, ["1", "camera", "pixel"]),
        measure("camera"),
        said(&["mean", "--measured", text(&out)]),
    ] {
        assert!(message.contains(stated), "{message}");
    }
    // Without the option, ellipticities are along the sky's axes: those of x to the south and y to the east have the other
    // sign of e1.
    let message = gather(&[camera], &on_camera.1, ["1", "turned", ""]);
    let frame = "frame: sky (e1 > 0 along east–west, e2 > 0 along north-west). The WCS of the first stamp: rotated by 90.0° from north to east, mirrored";
    assert!(message.contains(frame), "{message}");
    measure("turned");
    let out = small.at("turned-out");
    let message = said(&["mean", "--measured", text(&out)]);
    assert!(!message.contains("pixel axes"), "{message}");
    let shapes = |out: &str| {
        let path = small.at(out).join("set01/catalogue-001.parquet");
        let table = shearq_files::table::read(&path, Some(&["e1", "e2"]), 64).unwrap();
        ["e1", "e2"].map(|name| {
            shearq_files::table::numbers(&table, name, &path)
                .unwrap()
                .into_owned()
        })
    };
    let ([along1, along2], [sky1, sky2]) = (shapes("camera-out"), shapes("turned-out"));
    for k in 0..along1.len() {
        let off = (along1[k] + sky1[k]).abs().max((along2[k] - sky2[k]).abs());
        // Noise of the correction for noise.
        assert!(off < 0.02 || along1[k].is_nan(), "{k}: {off}");
    }
    gather(&[camera], &on_camera.1, ["2", "both", "pixel"]);
    measure("both");
    let out = small.at("both-out");
    let message = fail(&["mean", "--measured", text(&out)]);
    let expected = "catalogue-001.parquet and no common mean with them (found pixel axes rotated by 90.0° from north to east, mirrored, sheared by (+0.0000, +0.0000); expected pixel axes rotated by 0.0° from north to east, not mirrored";
    assert!(message.contains(expected), "{message}");
    // Both are along the sky in one set: axes that are the sky's anyhow, and those that the WCS turns.
    gather(&[sky], &on_sky.1, ["1", "all", ""]);
    gather(&[camera], &on_camera.1, ["2", "all", ""]);
    measure("all");
    let json = |out: &str| -> Value {
        let line = format!("shearq mean --measured {out}-out --format json");
        let table: Value = serde_json::from_str(&printed(small.root(), &line)).unwrap();
        table["rows"][0].clone()
    };
    let (mixed, turned, along) = (json("all"), json("turned"), json("camera"));
    assert_eq!([&mixed["frame"], &along["frame"]], ["sky", "pixel"]);
    let scored = |out: &str| {
        let truth = small.at(out).join("set01/truth.csv");
        fs::copy(small.at("data/set02/truth.csv"), truth).unwrap();
        let line = format!(
            "rm -r {out}-out; shearq measure --data {out} --submission {LINEAR} --out {out}-out; shearq score --measured {out}-out --format csv"
        );
        printed(small.root(), &line)
    };
    assert!(scored("turned").contains(",frame,") && scored("turned").contains(",sky,"));
    assert!(!scored("camera").contains("frame"));
    // The stamps are the same, so that on the sky e1 of the two images differs in sign and e2 does not.
    let [g2, turned2] = [&mixed, &turned].map(|row| row["g2"].as_f64().unwrap());
    assert!((g2 - turned2).abs() < 0.005, "{g2} {turned2}");
    assert!(mixed["g1"].as_f64().unwrap().abs() < 0.005, "{mixed}");
    // Pixels without a WCS may lie in any orientation.
    let plain = small.at("plain.fits");
    let stack = [48, 48, galaxies.len()];
    fs::write(
        &plain,
        fits_image(-32, &stack, &[], &floats(&galaxies.concat())),
    )
    .unwrap();
    gather(&[camera], &on_camera.1, ["1", "open", ""]);
    gather(
        &[text(&plain)],
        &set.join("psf-001.fits"),
        ["2", "open", ""],
    );
    measure("open");
    let message = fail(&["mean", "--measured", text(&small.at("open-out"))]);
    let expected = "(found pixel axes without a WCS; expected the axes of the sky)";
    assert!(message.contains(expected), "{message}");
    let mixed = small.at("mixed");
    let of = ["gather", "--stamps", sky, "--psf", text(&on_camera.1)];
    let message = fail(&[&of[..], &["--out", text(&mixed)]].concat());
    let expected =
        "the PSF image and the galaxy image have pixel axes of different orientation or shear";
    assert!(message.contains(expected), "{message}");
    let message = gather(&[sky, camera], &on_sky.1, ["1", "two", "pixel"]);
    let expected = "camera.fits: image 1, plane 1: the header states other pixel axes";
    assert!(message.contains(expected), "{message}");
}

#[test]
fn each_galaxy_has_the_noise_of_its_place_and_of_its_light() {
    let small = Small::new("2");
    let set = small.at("data/set02");
    let (exposure, psf) = (set.join("galaxies-001.fits"), set.join("psf-001.fits"));
    let width = pixels_of(&exposure).1;
    let at = |k: usize| (k % 8 * 48 + 24, k / 8 * 48 + 24);
    let rows = (0..64).map(|k| format!("{k},{}.5,{}.5\n", at(k).0, at(k).1));
    let positions = small.at("positions.csv");
    fs::write(
        &positions,
        "id,x,y\n".to_owned() + &rows.collect::<String>(),
    )
    .unwrap();
    // The map has the light of the galaxies, as maps of counts do, and another depth from column 180 on, which is on a stamp.
    let variance: Vec<f32> = (0..width * width)
        .map(|pixel| {
            let [x, y] = [pixel % width, pixel / width];
            let centre = (x % 48).abs_diff(24).max((y % 48).abs_diff(24));
            let own = if centre < 8 { 5.0 } else { 0.0 };
            own + if x < 180 { 1.0 } else { 4.0 }
        })
        .collect();
    let write = |name: &str, values: Vec<f32>| {
        let path = small.at(name);
        fs::write(&path, fits_image(-32, &[width; 2], &[], &floats(&values))).unwrap();
        path
    };
    let map = write("variance.fits", variance.clone());
    let weight = write("weight.fits", variance.iter().map(|v| 1.0 / v).collect());
    let of = |exposure: &Path, name: &str, options: &[&str]| {
        let (data, out) = (small.at(name), small.at(&format!("{name}-out")));
        let from = ["gather", "--exposure", text(exposure), "--psf", text(&psf)];
        let to = ["--positions", text(&positions), "--out", text(&data)];
        succeed(&[&from[..], &to, options].concat());
        let measure = ["measure", "--submission", LINEAR, "--data", text(&data)];
        succeed(&[&measure[..], &["--out", text(&out)]].concat());
        let path = out.join("set01/catalogue-001.parquet");
        let table = shearq_files::table::read(&path, None, 64).unwrap();
        ["noise", "flux_error", "flux"].map(|name| {
            let values = shearq_files::table::numbers(&table, name, &path);
            values.unwrap().into_owned()
        })
    };
    let columns = |name: &str, options: &[&str]| of(&exposure, name, options);
    for (name, option, file) in [
        ("variance", "--variance", &map),
        ("weight", "--weight-map", &weight),
    ] {
        let [noise, ..] = columns(name, &[option, text(file)]);
        for (k, found) in noise.iter().enumerate() {
            // Column 180 is right of the middle of the fourth stamp.
            let expected = if at(k).0 <= 180 { 1.0 } else { 2.0 };
            assert!((found - expected).abs() < 1e-6, "{name} {k}: {found}");
        }
    }
    let plain = columns("plain", &[]);
    // With a map, too, the sky is subtracted.
    let (pixels, _) = pixels_of(&exposure);
    let raised = pixels.iter().map(|value| value + 30.0).collect();
    let light = of(
        &write("raised.fits", raised),
        "light",
        &["--variance", text(&map)],
    );
    let dark = columns("dark", &["--variance", text(&map)]);
    for (k, (light, dark)) in light[2].iter().zip(&dark[2]).enumerate() {
        // A sky of 30 on the hundred pixels of a window has thousands.
        let off = (light - dark).abs();
        assert!(off < 50.0 || dark.is_nan(), "{k}: {light} {dark}");
    }
    assert_eq!(columns("bright", &["--gain", "1e30"])[1..], plain[1..]);
    // The light of a galaxy under the window adds to the variance: flux over gain and area, less what the window leaves out.
    let own = columns("gain", &["--gain", "0.2"]);
    for k in 0..64 {
        let (noise, flux) = (plain[0][k], plain[2][k]);
        if flux.is_nan() {
            continue;
        }
        let ratio = (own[1][k] / plain[1][k]).powi(2) - 1.0;
        let area = ratio.recip() * flux / 0.2 / (noise * noise);
        // π w² for windows of 6.7 to 9.5 px, and up to 1.6 times as much.
        assert!((140.0..450.0).contains(&area) || flux < 0.0, "{k}: {area}");
    }
}

#[test]
fn exposures_of_one_call_are_epochs_or_say_why_not() {
    let small = Small::new("2");
    let set = small.at("data/set02");
    let (pixels, width) = pixels_of(&set.join("galaxies-001.fits"));
    let psf = set.join("psf-001.fits");
    let rows = (0..64).map(|k| format!("{k},{},{}\n", k % 8 * 48 + 24, k / 8 * 48 + 24));
    let table = "id,x,y\n".to_owned() + &rows.collect::<String>();
    fs::write(small.at("positions.csv"), table).unwrap();
    let exposure = |name: &str, cards: &[&str]| {
        let content = fits_image(-32, &[width; 2], cards, &floats(&pixels));
        fs::write(small.at(name), content).unwrap();
    };
    // Without places on the sky, which would be those of other galaxies.
    let linear = [
        "CTYPE1  = 'LINEAR'",
        "CTYPE2  = 'LINEAR'",
        "CUNIT1  = 'arcsec'",
        "CUNIT2  = 'arcsec'",
    ];
    let along = ["CD1_1   = 0.26", "CD2_2   = 0.26"];
    let turned = ["CD1_2   = -0.26", "CD2_1   = 0.26"];
    let coarse = ["CD1_1   = 0.3", "CD2_2   = 0.3"];
    exposure("along.fits", &[&linear[..], &along].concat());
    exposure("turned.fits", &[&linear[..], &turned].concat());
    exposure("coarse.fits", &[&linear[..], &coarse].concat());
    exposure("plain.fits", &[]);
    let gather = |exposures: &str, out: &str| {
        let psfs = vec![text(&psf); exposures.split(' ').count()].join(" ");
        format!(
            "shearq gather --exposure {exposures} --psf {psfs} --positions positions.csv --out {out}"
        )
    };
    let measure = |data: &str| {
        format!("shearq measure --epochs --data {data} --submission {LINEAR} --out {data}-out")
    };
    for (exposures, data) in [
        ("along.fits turned.fits along.fits", "three"),
        ("along.fits coarse.fits", "scales"),
    ] {
        let line = format!("{} && {}", gather(exposures, data), measure(data));
        let done = shell(small.root(), &line);
        let said = String::from_utf8(done.stderr).unwrap();
        assert!(
            done.status.success() && said.contains("frame: sky"),
            "{said}"
        );
    }
    let refused = |line: &str| {
        let done = shell(small.root(), line);
        assert!(!done.status.success());
        String::from_utf8(done.stderr).unwrap()
    };
    let said = refused(&gather("along.fits plain.fits turned.fits", "none"));
    assert!(
        said.contains(
            "plain.fits: the exposures have different pixels on the sky, and the header has no WCS"
        ),
        "{said}"
    );
    // Another call does not know the first one.
    let line = format!("{} --image 4", gather("along.fits", "three"));
    assert!(shell(small.root(), &line).status.success());
    let said = refused(&format!("rm -r three-out; {}", measure("three")));
    assert!(
        said.contains("galaxies-004.fits: some epochs have Jacobians and others have none")
            && said.contains("Try:"),
        "{said}"
    );
    fs::remove_file(small.at("three/set01/galaxies-002.fits")).unwrap();
    let said = refused(&measure("three"));
    let expected =
        "galaxies-002.fits: there is no such image (found 1, 3, 4 of set 1, expected 1 to 4";
    assert!(said.contains(expected), "{said}");
}
