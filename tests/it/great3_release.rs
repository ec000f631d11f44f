//! Branches of GREAT3 in the form of their release, from images to a submission.

use std::fs;

use shearq_files::frames::polars::Column;
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat};

use crate::support::{Folder, assert_has, mosaic, pixels_of};

const GRID: usize = 8;
const STAMP: usize = 48;
const MEASURE: &str = "measure --data great3 --submission 48/linear/star --out";

/// A branch of two subfields, of the two images of a simulated set, without the keys that the simulation writes. Its catalogues
/// are in the reverse order of the stamps.
fn branch() -> Folder {
    let folder = Folder::with_set(2);
    for subfield in 0..2 {
        let from = |name: &str| folder.at(&format!("data/set02/{name}-00{}.fits", subfield + 1));
        let (galaxies, side) = pixels_of(&from("galaxies"));
        assert_eq!(side, GRID * STAMP);
        folder.image(
            &format!("great3/image-00{subfield}-0.fits"),
            &[side; 2],
            &[],
            &galaxies,
        );
        let (star, side) = pixels_of(&from("psf"));
        let rows = star.chunks(side).cycle().take(3 * side);
        let stars: Vec<f32> = rows.flat_map(|row| row.repeat(3)).collect();
        let name = format!("great3/starfield_image-00{subfield}-0.fits");
        folder.image(&name, &[3 * side; 2], &[], &stars);
        let column = |name: &str, of: &dyn Fn(usize) -> usize| {
            let values = (0..GRID * GRID).rev().map(|k| of(k) as i64);
            Column::new(name.into(), values.collect::<Vec<_>>())
        };
        let centre = |at: usize| at * STAMP + STAMP / 2 - 1;
        let columns = vec![
            column("x", &|k| centre(k % GRID)),
            column("y", &|k| centre(k / GRID)),
            column("ID", &|k| identity(subfield, k)),
        ];
        write_catalogue(&folder, subfield, columns);
    }
    folder
}

fn identity(subfield: usize, place: usize) -> usize {
    subfield * 1_000_000 + place % GRID * 1000 + place / GRID
}

fn write_catalogue(folder: &Folder, subfield: usize, columns: Vec<Column>) {
    let path = folder.at(&format!("great3/galaxy_catalog-00{subfield}.fits"));
    let table = frame(columns).unwrap();
    table::write(&path, FileFormat::Fits, &table, &Metadata::new()).unwrap();
}

/// A column of the catalogue of a subfield.
fn column(folder: &Folder, out: &str, subfield: usize, name: &str) -> Vec<f64> {
    let path = format!("{out}/set0{subfield}/catalogue-000.parquet");
    let [values] = folder.numbers(&path, [name]);
    values
}

/// e1 in two folders differs by at most `tolerance`; NaN is that of flagged galaxies.
fn assert_same_e1(folder: &Folder, outs: [&str; 2], tolerance: f64) {
    let [a, b] = outs.map(|out| column(folder, out, 0, "e1"));
    for (a, b) in a.iter().zip(b) {
        assert!((a - b).abs() < tolerance || a.is_nan(), "{a} {b}");
    }
}

#[test]
fn a_released_branch_is_measured_like_own_images() {
    let folder = branch();
    folder.measure("--submission 48/linear/star");
    folder.run(&format!("{MEASURE} m"));
    for subfield in 0..2 {
        let own = format!("out/set02/catalogue-00{}.parquet", subfield + 1);
        for name in ["x", "e1", "e2", "R11", "snr"] {
            let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            let (found, [expected]) = (
                column(&folder, "m", subfield, name),
                folder.numbers(&own, [name]),
            );
            assert_eq!(bits(&found), bits(&expected), "{subfield} {name}");
        }
        let ids = (0..GRID * GRID).map(|k| identity(subfield, k) as f64);
        assert!(ids.eq(column(&folder, "m", subfield, "id")));
    }
    // Copies of one star have the same stack, to the rounding of shifts.
    folder.run(&format!("{MEASURE} stacked --stack-stars"));
    assert_same_e1(&folder, ["m", "stacked"], 1e-5);
    let stack = "measure --data data --submission 48/linear/star --out s --stack-stars";
    folder.refuses(stack, "only star fields of GREAT3");
}

#[test]
fn means_of_rotated_pairs_are_packed_with_errors_of_pixel_noise() {
    let folder = branch();
    folder.run(&format!("{MEASURE} m"));
    let means = folder.json("mean --measured m --sets all");
    let pack = "pack --challenge great3 --branch control-ground-constant --measured m";
    folder.run(&format!("{pack} --subfields 2 --grid 8 --out g.txt"));
    let packed = fs::read_to_string(folder.at("g.txt")).unwrap();
    let rows = means["rows"].as_array().unwrap().iter();
    for (row, packed) in rows.zip(packed.lines().skip(1)) {
        let value = |name: &str| row[name].as_f64().unwrap();
        let packed: Vec<f64> = packed
            .split(' ')
            .map(|word| word.parse().unwrap())
            .collect();
        assert_eq!(value("set"), packed[0]);
        for k in 1..=2 {
            let off = value(&format!("g{k}")) - packed[k];
            assert!(off.abs() < 1e-6, "{row} {packed:?}");
            // At S/N 20 the noise is a part of the scatter.
            let independent = value(&format!("scatter{k}")) / value("galaxies").sqrt();
            let ratio = value(&format!("g{k}_error")) / independent;
            assert!((0.2..0.9).contains(&ratio), "{ratio}");
        }
    }
}

#[test]
fn identities_are_those_of_subfield_column_and_row() {
    let folder = branch();
    let all = format!("{MEASURE} other");
    // Of the second subfield, whose catalogue the first cannot stand for: exchanged axes, and rows in another order.
    let path = folder.at("great3/galaxy_catalog-001.fits");
    let sound = table::read(&path, None, table::MAX_ROWS).unwrap();
    let of = |name: &str| sound.column(name).unwrap().clone();
    let exchanged = [
        of("y").with_name("x".into()),
        of("x").with_name("y".into()),
        of("ID"),
    ];
    let reversed = [of("x"), of("y"), of("ID").reverse()];
    for (columns, words) in [
        (
            exchanged,
            "the galaxy at x = 359, y = 311 has the ID 001006007 (expected 001007006",
        ),
        (
            reversed,
            "the galaxy at x = 359, y = 359 has the ID 001000000 (expected 001007007",
        ),
    ] {
        write_catalogue(&folder, 1, columns.into());
        folder.remove("other");
        folder.refuses(&all, words);
    }
    fs::copy(folder.at("great3/galaxy_catalog-000.fits"), path).unwrap();
    folder.remove("other");
    folder.refuses(&all, "has the ID 000007007 (expected 001007007");
}

#[test]
fn nothing_is_gathered_into_a_branch() {
    let folder = branch();
    let catalogue = || fs::read(folder.at("great3/galaxy_catalog-001.fits")).unwrap();
    let before = catalogue();
    let star = "data/set02/psf-001.fits";
    let gather = format!("gather --stamps {star} --psf {star} --out great3");
    folder.refuses(&gather, "is a branch of GREAT3");
    assert_eq!(catalogue(), before);
}

#[test]
fn epochs_of_a_subfield_are_combined() {
    let folder = branch();
    folder.run(&format!("{MEASURE} m"));
    let at = |name: &str| folder.at(&format!("great3/{name}"));
    fs::copy(
        at("starfield_image-000-0.fits"),
        at("starfield_image-000-1.fits"),
    )
    .unwrap();
    // The same image again, two pixels along x.
    let (mut pixels, side) = pixels_of(&at("image-000-0.fits"));
    pixels.chunks_mut(side).for_each(|row| row.rotate_right(2));
    let write = |pixels: &[f32]| folder.image("great3/image-000-1.fits", &[side; 2], &[], pixels);
    write(&pixels);
    let dither = |epoch: usize, x: &str| {
        let text = format!("{{xdither_pixels: {x}, ydither_pixels: 0.0}}\n");
        folder.write(&format!("great3/epoch_dither-000-{epoch}.yaml"), text);
    };
    let measure = format!("{MEASURE} epochs --sets 0");
    let refuse_anew = |words: &str| {
        folder.remove("epochs");
        folder.refuses(&measure, words);
    };
    let snr = |out: &str| column(&folder, out, 0, "snr").iter().sum::<f64>();
    folder.refuses(&measure, "epoch_dither-000-0");
    let found = ["0.0", "2.0"].map(|x| {
        dither(0, "0.0");
        dither(1, x);
        folder.remove("epochs");
        let said = folder.said(&measure);
        let displaced =
            "image-000-1.fits: the galaxies are displaced from those of the first epoch";
        (said.contains(displaced), snr("epochs") / snr("m"))
    });
    // Light adds up at the right place. The survey takes moved galaxies for larger ones, and the wider window has more noise than √2
    // of one image allows.
    let [(warned, without), (silent, with)] = found;
    let larger = 1.2 < without && without < with && with < 1.42;
    assert!(warned && !silent && larger, "{found:?}");
    assert_eq!(
        column(&folder, "m", 0, "id"),
        column(&folder, "epochs", 0, "id")
    );
    assert!(!folder.at("epochs/set00/catalogue-001.parquet").exists());
    write(&vec![0.0; side * side]);
    let said = folder.said(&format!("{MEASURE} zero --sets 0"));
    let blank = "great3/image-000-1.fits: cannot measure the noise: on no stamp are there enough pixels that differ and are not missing (expected galaxies and noise). The epoch is left out";
    assert_has(&said, blank);
    assert_eq!(snr("zero"), snr("m"));
    write(&pixels);
    // Another dither makes the catalogue one of other data.
    dither(1, "-2.0");
    for command in [
        measure.as_str(),
        "mean --measured epochs",
        "shear --measured epochs --out shears.fits",
        "select --measured epochs --where 'step(snr, 10)' --out selected",
        "pack --measured epochs --out packed",
    ] {
        folder.refuses(
            command,
            "epoch_dither-000-1.yaml: the file has changed since",
        );
    }
    for (x, found) in [("nan", "(NaN, 0)"), ("1e9", "(1000000000, 0)")] {
        dither(1, x);
        refuse_anew(&format!(
            "epoch_dither-000-1.yaml: the dither is {found} px (expected up to 12"
        ));
    }
    dither(1, "-2.0");
    folder.write(
        "great3/epoch_dither-000-1.txt",
        "# xdither_pixels ydither_pixels\n2 0\n",
    );
    refuse_anew("epoch_dither-000-1.txt: `xdither_pixels` is 2; [..]has -2 (expected the same)");
    let all = format!("{MEASURE} all");
    let lacks = |subfield: usize| {
        format!(
            "image-00{subfield}-1.fits: there is no such epoch (found 0 of subfield {subfield}, expected epochs 0 to 1, as there is"
        )
    };
    folder.refuses(&all, &lacks(1));
    // The last epoch, which all subfields lack, and a subfield without images.
    folder.remove("great3/image-000-1.fits");
    folder.refuses(&all, &lacks(0));
    folder.write("great3/image-000-0.fits", "");
    folder.write("great3/image-000-1.fits", "");
    folder.remove("great3/image-001-0.fits");
    let none = "image-001-0.fits: there is no such epoch (found none of subfield 1[..]Try: restore the image, or --sets";
    folder.refuses(&all, none);
}

#[test]
fn a_varying_psf_is_taken_from_images_of_one_per_galaxy() {
    let folder = branch();
    folder.write("great3/star_catalog-000.fits", "");
    let both = "starfield_image-000-0.fits[..]psf_image-000-0.fits";
    folder.refuses(&format!("{MEASURE} m"), both);
    let stars =
        [1, 2].map(|image| pixels_of(&folder.at(&format!("data/set02/psf-00{image}.fits"))));
    let side = stars[0].1;
    // The first star for the first galaxy of the catalogue, which is on the last stamp; the second star for all others.
    let star = |row: usize| &stars[usize::from(row > 0)].0;
    let stamps = |rows: &mut dyn Iterator<Item = usize>| {
        rows.flat_map(|row| star(row).clone()).collect::<Vec<f32>>()
    };
    let count = GRID * GRID;
    for subfield in 0..2 {
        let name = format!("great3/psf_image-00{subfield}-0.fits");
        folder.image(&name, &[side, side, count], &[], &stamps(&mut (0..count)));
    }
    folder.run(&format!("{MEASURE} m"));
    let on_image = mosaic(&stamps(&mut (0..count).rev()), side, GRID);
    folder.image(
        "great3/psf_image-000-0.fits",
        &[GRID * side; 2],
        &[],
        &on_image,
    );
    folder.run(&format!("{MEASURE} mosaic --sets 0"));
    assert_same_e1(&folder, ["m", "mosaic"], 1e-9);
    folder.refuses(
        &format!("{MEASURE} n --stack-stars"),
        "without --stack-stars",
    );
    folder.image(
        "great3/psf_image-000-0.fits",
        &[side, side, 3],
        &[],
        &vec![0.0; side * side * 3],
    );
    folder.refuses(&format!("{MEASURE} n --sets 0"), "the cube has 3 planes");
}
