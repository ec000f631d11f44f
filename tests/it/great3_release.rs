//! Branches of GREAT3 in the form of their release, from images to a submission.

use std::fs;
use std::path::Path;

use shearq_files::frames::polars::Column;
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat};

use crate::support::{Small, fits_image, floats, pixels_of, printed, refused, shell};

const GRID: usize = 8;
const STAMP: usize = 48;
const MEASURE: &str = "shearq measure --data great3 --submission 48/linear/star --out m";

fn write_image(path: &Path, sides: &[usize], pixels: &[f32]) {
    fs::write(path, fits_image(-32, sides, &[], &floats(pixels))).unwrap();
}

/// A branch of two subfields, of the two images of a simulated set, without the keys that the simulation writes. Its catalogues
/// are in the reverse order of the stamps.
fn branch(small: &Small) {
    let folder = small.at("great3");
    fs::create_dir(&folder).unwrap();
    for subfield in 0..2 {
        let from = |name: &str| small.at(&format!("data/set02/{name}-00{}.fits", subfield + 1));
        let (galaxies, side) = pixels_of(&from("galaxies"));
        assert_eq!(side, GRID * STAMP);
        let image = folder.join(format!("image-00{subfield}-0.fits"));
        write_image(&image, &[side, side], &galaxies);
        let (star, side) = pixels_of(&from("psf"));
        let field: Vec<f32> = star
            .chunks(side)
            .cycle()
            .take(3 * side)
            .flat_map(|row| row.repeat(3))
            .collect();
        let stars = folder.join(format!("starfield_image-00{subfield}-0.fits"));
        write_image(&stars, &[3 * side; 2], &field);
        let column = |name: &str, of: &dyn Fn(usize) -> usize| {
            let values = (0..GRID * GRID).rev().map(|k| of(k) as i64);
            Column::new(name.into(), values.collect::<Vec<_>>())
        };
        let centre = |at: usize| at * STAMP + STAMP / 2 - 1;
        let columns = vec![
            column("x", &|k| centre(k % GRID)),
            column("y", &|k| centre(k / GRID)),
            column("ID", &|k| subfield * 1_000_000 + k % GRID * 1000 + k / GRID),
        ];
        let path = folder.join(format!("galaxy_catalog-00{subfield}.fits"));
        let table = frame(columns).unwrap();
        table::write(&path, FileFormat::Fits, &table, &Metadata::new()).unwrap();
    }
}

fn column(path: &Path, name: &str) -> Vec<f64> {
    let read = table::read(path, Some(&[name]), table::MAX_ROWS).unwrap();
    table::numbers(&read, name, path).unwrap().into_owned()
}

#[test]
fn a_released_branch_is_measured_like_own_images() {
    let small = Small::new("2");
    branch(&small);
    small.measure(&["--submission", "48/linear/star"]);
    printed(small.root(), MEASURE);
    for subfield in 0..2 {
        let path = small.at(&format!("m/set0{subfield}/catalogue-000.parquet"));
        let own = small.at(&format!("out/set02/catalogue-00{}.parquet", subfield + 1));
        for name in ["x", "e1", "e2", "R11", "snr"] {
            let [found, expected] = [&path, &own].map(|path| column(path, name));
            // Not equal: NaN of a flagged galaxy.
            let same = |(a, b): (&f64, &f64)| a.to_bits() == b.to_bits();
            assert!(found.iter().zip(&expected).all(same), "{subfield} {name}");
        }
        let ids = (0..GRID * GRID).map(|k| subfield * 1_000_000 + k % GRID * 1000 + k / GRID);
        let ids: Vec<f64> = ids.map(|id| id as f64).collect();
        assert_eq!(column(&path, "id"), ids);
    }
    // Copies of one star have the same stack, to the rounding of shifts.
    printed(
        small.root(),
        &MEASURE.replace("--out m", "--stack-stars --out stacked"),
    );
    let [one, all] =
        ["m", "stacked"].map(|out| small.at(&format!("{out}/set00/catalogue-000.parquet")));
    for (a, b) in column(&one, "e1").iter().zip(column(&all, "e1")) {
        assert!((a - b).abs() < 1e-5 || a.is_nan(), "{a} {b}");
    }
    let message = refused(
        small.root(),
        "shearq measure --data data --submission 48/linear/star --out s --stack-stars",
    );
    assert!(message.contains("only star fields of GREAT3"), "{message}");
}

#[test]
fn means_of_rotated_pairs_are_packed_with_errors_of_pixel_noise() {
    let small = Small::new("2");
    branch(&small);
    printed(small.root(), MEASURE);
    let mean = printed(
        small.root(),
        "shearq mean --measured m --sets all --format csv",
    );
    printed(
        small.root(),
        "shearq pack --challenge great3 --branch control-ground-constant --measured m --subfields 2 --grid 8 --out g.txt",
    );
    let packed = fs::read_to_string(small.at("g.txt")).unwrap();
    let mut lines = mean.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    for (mean, packed) in lines.zip(packed.lines().skip(1)) {
        let mean: Vec<&str> = mean.split(',').collect();
        let value = |name: &str| -> f64 {
            let place = names.iter().position(|own| *own == name).unwrap();
            mean[place].parse().unwrap()
        };
        let packed: Vec<f64> = packed
            .split(' ')
            .map(|word| word.parse().unwrap())
            .collect();
        assert_eq!(value("set"), packed[0]);
        for (k, [g, error, scatter]) in [
            ["g1", "g1_error", "scatter1"],
            ["g2", "g2_error", "scatter2"],
        ]
        .into_iter()
        .enumerate()
        {
            assert!(
                (value(g) - packed[k + 1]).abs() < 1e-6,
                "{mean:?} {packed:?}"
            );
            // At S/N 20 the noise is a part of the scatter.
            let independent = value(scatter) / value("galaxies").sqrt();
            let ratio = value(error) / independent;
            assert!((0.2..0.9).contains(&ratio), "{ratio}");
        }
    }
}

#[test]
fn identities_are_those_of_subfield_column_and_row() {
    let small = Small::new("2");
    branch(&small);
    let catalogue = |subfield: usize| small.at(&format!("great3/galaxy_catalog-00{subfield}.fits"));
    let other = MEASURE.replace("--out m", "--out other");
    // Of the second subfield, whose catalogue the first cannot stand for: exchanged axes, and rows in another order.
    let sound = table::read(&catalogue(1), None, table::MAX_ROWS).unwrap();
    let of = |name: &str| sound.column(name).unwrap().clone();
    let exchanged = vec![
        of("y").with_name("x".into()),
        of("x").with_name("y".into()),
        of("ID"),
    ];
    let reversed = vec![of("x"), of("y"), of("ID").reverse()];
    for (columns, says) in [
        (
            exchanged,
            "the galaxy at x = 359, y = 311 has the ID 001006007 (expected 001007006",
        ),
        (
            reversed,
            "the galaxy at x = 359, y = 359 has the ID 001000000 (expected 001007007",
        ),
    ] {
        let table = frame(columns).unwrap();
        table::write(&catalogue(1), FileFormat::Fits, &table, &Metadata::new()).unwrap();
        let message = refused(small.root(), &format!("rm -rf other; {other}"));
        assert!(message.contains(says), "{message}");
    }
    fs::copy(catalogue(0), catalogue(1)).unwrap();
    let message = refused(small.root(), &format!("rm -rf other; {other}"));
    assert!(
        message.contains("has the ID 000007007 (expected 001007007"),
        "{message}"
    );
}

#[test]
fn nothing_is_gathered_into_a_branch() {
    let small = Small::new("2");
    branch(&small);
    let catalogue = small.at("great3/galaxy_catalog-001.fits");
    let before = fs::read(&catalogue).unwrap();
    let message = refused(
        small.root(),
        "shearq gather --stamps data/set02/psf-001.fits --psf data/set02/psf-001.fits --out great3",
    );
    assert!(message.contains("is a branch of GREAT3"), "{message}");
    assert_eq!(fs::read(&catalogue).unwrap(), before);
}

#[test]
fn epochs_of_a_subfield_are_combined() {
    let small = Small::new("2");
    branch(&small);
    printed(small.root(), MEASURE);
    let at = |name: &str| small.at(&format!("great3/{name}"));
    fs::copy(
        at("starfield_image-000-0.fits"),
        at("starfield_image-000-1.fits"),
    )
    .unwrap();
    // The same image again, two pixels along x.
    let (mut pixels, side) = pixels_of(&at("image-000-0.fits"));
    pixels.chunks_mut(side).for_each(|row| row.rotate_right(2));
    write_image(&at("image-000-1.fits"), &[side, side], &pixels);
    let measure = MEASURE.replace("--out m", "--sets 0 --out epochs");
    let message = refused(small.root(), &measure);
    assert!(message.contains("epoch_dither-000-0"), "{message}");
    let catalogue = |out: &str| small.at(&format!("{out}/set00/catalogue-000.parquet"));
    let snr = |out: &str| column(&catalogue(out), "snr").iter().sum::<f64>();
    let mut found = Vec::new();
    for dither in [0.0, 2.0] {
        for (epoch, dither) in [0.0, dither].into_iter().enumerate() {
            let text = format!("{{xdither_pixels: {dither}, ydither_pixels: 0.0}}\n");
            fs::write(at(&format!("epoch_dither-000-{epoch}.yaml")), text).unwrap();
        }
        let output = shell(small.root(), &format!("rm -rf epochs; {measure}"));
        assert!(output.status.success());
        let said = String::from_utf8(output.stderr).unwrap();
        let warned = said.contains(
            "great3/image-000-1.fits: the galaxies are displaced from those of the first epoch",
        );
        found.push((warned, snr("epochs") / snr("m")));
    }
    assert_eq!(
        column(&catalogue("m"), "id"),
        column(&catalogue("epochs"), "id")
    );
    // Light adds up at the right place. The survey takes moved galaxies for larger ones, and the wider window has more noise than √2
    // of one image allows.
    let [(warned, without), (silent, with)] = found[..] else {
        panic!("{found:?}");
    };
    assert!(
        warned && !silent && 1.2 < without && without < with && with < 1.42,
        "{found:?}"
    );
    assert!(!small.at("epochs/set00/catalogue-001.parquet").exists());
    let kept = fs::read(at("image-000-1.fits")).unwrap();
    write_image(
        &at("image-000-1.fits"),
        &[side, side],
        &vec![0.0; side * side],
    );
    let output = shell(small.root(), &measure.replace("--out epochs", "--out zero"));
    let said = String::from_utf8(output.stderr).unwrap();
    let expected = "great3/image-000-1.fits: cannot measure the noise: no stamp has enough pixels that differ (expected galaxies and noise). The epoch is left out";
    assert!(said.contains(expected), "{said}");
    assert_eq!(snr("zero"), snr("m"));
    fs::write(at("image-000-1.fits"), kept).unwrap();
    // Another dither makes the catalogue one of other data.
    let dither = at("epoch_dither-000-1.yaml");
    fs::write(&dither, "{xdither_pixels: -2.0, ydither_pixels: 0.0}").unwrap();
    for command in [
        "measure --data great3 --submission 48/linear/star --sets 0 --out epochs",
        "mean --measured epochs",
        "shear --measured epochs --out shears.fits",
        "select --measured epochs --where 'step(snr, 10)' --out selected",
        "pack --measured epochs --out packed",
    ] {
        let message = refused(small.root(), &format!("shearq {command}"));
        assert!(
            message.contains("epoch_dither-000-1.yaml: the file has changed since"),
            "{command}: {message}"
        );
    }
    for (x, found) in [("nan", "(NaN, 0)"), ("1e9", "(1000000000, 0)")] {
        fs::write(
            &dither,
            format!("{{xdither_pixels: {x}, ydither_pixels: 0.0}}"),
        )
        .unwrap();
        let message = refused(small.root(), &format!("rm -rf epochs; {measure}"));
        let expected =
            format!("epoch_dither-000-1.yaml: the dither is {found} px (expected up to 12");
        assert!(message.contains(&expected), "{message}");
    }
    fs::write(&dither, "{xdither_pixels: -2.0, ydither_pixels: 0.0}").unwrap();
    fs::write(
        at("epoch_dither-000-1.txt"),
        "# xdither_pixels ydither_pixels\n2 0\n",
    )
    .unwrap();
    let message = refused(small.root(), &format!("rm -rf epochs; {measure}"));
    assert!(
        message.contains("epoch_dither-000-1.txt: `xdither_pixels` is 2; ")
            && message.contains("has -2 (expected the same)"),
        "{message}"
    );
    let message = refused(small.root(), &MEASURE.replace("--out m", "--out all"));
    assert!(
        message.contains(
            "image-001-1.fits: there is no such epoch (found 0 of subfield 1, expected epochs 0 to 1, as there is"
        ),
        "{message}"
    );
    // The last epoch, which all subfields lack, and a subfield without images.
    for set in 0..2 {
        let _ = fs::remove_file(at(&format!("image-00{set}-1.fits")));
    }
    let message = refused(small.root(), &MEASURE.replace("--out m", "--out all"));
    let expected = "image-000-1.fits: there is no such epoch (found 0 of subfield 0, expected epochs 0 to 1, as there is";
    assert!(message.contains(expected), "{message}");
    for epoch in 0..2 {
        fs::write(at(&format!("image-000-{epoch}.fits")), "").unwrap();
    }
    fs::remove_file(at("image-001-0.fits")).unwrap();
    let message = refused(small.root(), &MEASURE.replace("--out m", "--out all"));
    let expected = "image-001-0.fits: there is no such epoch (found none of subfield 1";
    assert!(
        message.contains(expected) && message.contains("Try: restore the image, or --sets"),
        "{message}"
    );
}

#[test]
fn a_varying_psf_is_taken_from_images_of_one_per_galaxy() {
    let small = Small::new("2");
    branch(&small);
    fs::write(small.at("great3/star_catalog-000.fits"), "").unwrap();
    let message = refused(small.root(), MEASURE);
    assert!(
        message.contains("starfield_image-000-0.fits") && message.contains("psf_image-000-0.fits"),
        "{message}"
    );
    let stars = [1, 2].map(|image| pixels_of(&small.at(&format!("data/set02/psf-00{image}.fits"))));
    let side = stars[0].1;
    // The first star for the first galaxy of the catalogue, which is on the last stamp; the second star for all others.
    let star = |row: usize| &stars[usize::from(row > 0)].0;
    for subfield in 0..2 {
        let cube: Vec<f32> = (0..GRID * GRID).flat_map(|row| star(row).clone()).collect();
        let path = small.at(&format!("great3/psf_image-00{subfield}-0.fits"));
        write_image(&path, &[side, side, GRID * GRID], &cube);
    }
    printed(small.root(), MEASURE);
    let mosaic = |y: usize, x: usize| {
        let tile = y / side * GRID + x / side;
        star(GRID * GRID - 1 - tile)[y % side * side + x % side]
    };
    let wide = GRID * side;
    let mosaic: Vec<f32> = (0..wide * wide)
        .map(|k| mosaic(k / wide, k % wide))
        .collect();
    write_image(
        &small.at("great3/psf_image-000-0.fits"),
        &[wide, wide],
        &mosaic,
    );
    printed(
        small.root(),
        &MEASURE.replace("--out m", "--sets 0 --out mosaic"),
    );
    let [cube, mosaic] =
        ["m", "mosaic"].map(|out| small.at(&format!("{out}/set00/catalogue-000.parquet")));
    for (a, b) in column(&cube, "e1").iter().zip(column(&mosaic, "e1")) {
        assert!((a - b).abs() < 1e-9 || a.is_nan(), "{a} {b}");
    }
    let message = refused(
        small.root(),
        &MEASURE.replace("--out m", "--stack-stars --out n"),
    );
    assert!(message.contains("without --stack-stars"), "{message}");
    write_image(
        &small.at("great3/psf_image-000-0.fits"),
        &[side, side, 3],
        &vec![0.0; side * side * 3],
    );
    let message = refused(
        small.root(),
        &MEASURE.replace("--out m", "--sets 0 --out n"),
    );
    assert!(message.contains("the cube has 3 planes"), "{message}");
}
