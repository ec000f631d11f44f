//! Which images of a file are gathered, which rows of a catalogue, and in which unit.

use crate::support::{
    Folder, assert_has, fits_extension, fits_image, floats, pixels_of, stamps_of,
};

const SIDE: usize = 96;

/// A file of an empty primary image and one extension for each name, version and pixel value.
fn write_chips(folder: &Folder, name: &str, chips: &[(&str, i32, f32)]) {
    let mut file = fits_image(8, &[], &["EXTEND  = T"], &[]);
    for &(name, version, value) in chips {
        let cards = [
            format!("EXTNAME = '{name}'"),
            format!("EXTVER  = {version}"),
        ];
        let cards = cards.each_ref().map(String::as_str);
        let pixels = vec![value; SIDE * SIDE];
        file.extend(fits_extension(
            "IMAGE",
            -32,
            &[SIDE; 2],
            &cards,
            &floats(&pixels),
        ));
    }
    folder.write(name, file);
}

fn with_psf() -> Folder {
    let folder = Folder::new();
    let mut star = vec![0.0; 400];
    star[210] = 1.0;
    folder.image("psf.fits", &[20; 2], &[], &star);
    folder.write("places.csv", "x,y\n40,40\n60,60\n");
    folder
}

/// The first pixel that is gathered, and what is said.
fn gathered(folder: &Folder, from: &str) -> (f32, String) {
    folder.remove("data");
    let said = folder.said(&format!(
        "gather {from} --positions places.csv --psf psf.fits --size 20 --out data"
    ));
    let (pixels, _) = pixels_of(&folder.at("data/set01/galaxies-001.fits"));
    (pixels[0], said)
}

#[test]
fn images_are_chosen_by_name_version_or_number() {
    let folder = with_psf();
    let chips = [
        ("SCI", 1, 1.0),
        ("DQ", 1, 0.0),
        ("SCI", 2, 4.0),
        ("DQ", 2, 0.0),
    ];
    write_chips(&folder, "flc.fits", &chips);
    for from in [
        "--exposure flc.fits --extension SCI,2",
        "--exposure flc.fits --extension 3",
        "--exposure flc.fits[sci,2]",
        "--exposure flc.fits[3] --mask-extension DQ,2",
    ] {
        assert_eq!(gathered(&folder, from).0, 4.0, "{from}");
    }
    let (pixel, said) = gathered(&folder, "--exposure flc.fits");
    assert_eq!(pixel, 1.0);
    let note = "flc.fits: stamps are cut out of image 1 of 2 called SCI. --extension SCI,2 chooses the next one";
    assert_has(&said, note);
    let refuses = |from: &str, words: &str| {
        let line = format!("gather {from} --positions places.csv --psf psf.fits --out no");
        folder.refuses(&line, words);
    };
    let two =
        "2 images may be the stamp (found SCI,1, SCI,2; expected one). Try: --extension SCI,1";
    refuses("--exposure flc.fits --extension SCI", two);
    // The mask of another chip would fit, too.
    let masks = "2 images may be the mask (found DQ,1, DQ,2; expected one)";
    refuses("--exposure flc.fits[3] --mask-extension DQ", masks);
    let absent = "there is no image called `SCI,3`; found `SCI,1`, `DQ,1`, `SCI,2`, `DQ,2`";
    refuses("--exposure flc.fits[SCI,3]", absent);
    let twice = "images are chosen twice (found `SCI,2` in brackets and --extension SCI,1";
    refuses("--exposure flc.fits[SCI,2] --extension SCI,1", twice);
}

#[test]
fn bands_of_one_galaxy_are_not_three_galaxies() {
    let folder = with_psf();
    let plane = |value: f32| vec![value; 400];
    let cube = |bands: [f32; 3]| bands.map(plane).concat();
    for (k, value) in [(1, 1.0), (2, 5.0)] {
        let cube = cube([value, value + 1.0, value + 2.0]);
        folder.image(&format!("grz-{k}.fits"), &[20, 20, 3], &[], &cube);
    }
    folder.image(
        "legacy.fits",
        &[20, 20, 3],
        &["BANDS   = 'grz'"],
        &cube([1.0, 2.0, 3.0]),
    );
    let line = |stamps: &str| format!("gather --stamps {stamps} --psf psf.fits --out data");
    let bands = "the image has 3 planes, which may be one galaxy in 3 bands (expected a galaxy per plane). Try: --extension plane=1";
    folder.refuses(&line("grz-1.fits grz-2.fits"), bands);
    folder.refuses(&line("legacy.fits"), bands);
    let of = |more: &str| {
        folder.remove("data");
        folder.run(&line(&format!("grz-1.fits grz-2.fits --extension {more}")));
        let stamps = stamps_of(&folder.at("data/set01/galaxies-001.fits"), 20);
        stamps.iter().map(|stamp| stamp[0]).collect::<Vec<_>>()
    };
    assert_eq!(of("plane=2")[..2], [2.0, 6.0]);
    assert_eq!(of("plane=all")[..6], [1.0, 2.0, 3.0, 5.0, 6.0, 7.0]);
    folder.remove("data");
    folder.refuses(
        &line("legacy.fits[plane=4]"),
        "there is no plane 4 (found 3 planes)",
    );
}

#[test]
fn planes_of_a_cube_are_exposures() {
    let folder = with_psf();
    // The rows of other planes are beyond the image.
    let cube: Vec<f32> = (0..3).flat_map(|k| vec![k as f32; SIDE * SIDE]).collect();
    folder.image("cube.fits", &[SIDE, SIDE, 3], &[], &cube);
    folder.write("places.csv", "x,y\n40,1\n40,96\n");
    let (_, said) = gathered(&folder, "--exposure cube.fits[plane=2]");
    assert_has(&said, "2 stamps with missing pixels");
    let (pixels, _) = pixels_of(&folder.at("data/set01/galaxies-001.fits"));
    let seen = pixels.iter().filter(|pixel| pixel.is_finite());
    assert!(seen.clone().all(|pixel| [0.0, 1.0].contains(pixel)));
    assert_eq!(seen.filter(|pixel| **pixel == 1.0).count(), 20 * (10 + 10));
    let plane =
        "the image has 3 planes; expected an exposure, which has one. Try: --extension plane=1";
    folder.refuses(
        "gather --exposure cube.fits --positions places.csv --psf psf.fits --out no",
        plane,
    );
}

#[test]
fn asinh_magnitudes_are_read_as_fluxes() {
    let folder = with_psf();
    let (offset, softening) = (3.0f64, 40.0f64);
    let cards = [
        "BOFFSET =                  3.0",
        "BSOFTEN =                 40.0",
    ];
    for flux in [-25.0f64, 0.0, 3.0, 800.0] {
        let magnitude = 2.5 / 10f64.ln() * ((flux - offset) / (2.0 * softening)).asinh();
        folder.image(
            "warp.fits",
            &[SIDE; 2],
            &cards,
            &vec![magnitude as f32; SIDE * SIDE],
        );
        let (pixel, said) = gathered(&folder, "--exposure warp.fits");
        // Rounding of magnitudes in single precision.
        assert!(
            (f64::from(pixel) - flux).abs() < 1e-5 * (softening + flux.abs()),
            "{pixel} {flux}"
        );
        assert_has(&said, "the pixels are asinh magnitudes (BSOFTEN)");
    }
    folder.image("flux.fits", &[SIDE; 2], &cards, &vec![5000.0; SIDE * SIDE]);
    folder.refuses(
        "gather --exposure flux.fits --positions places.csv --psf psf.fits --out no",
        "Try: remove BSOFTEN if the pixels are fluxes already",
    );
}

const SKY: [&str; 8] = [
    "CTYPE1  = 'RA---TAN'",
    "CTYPE2  = 'DEC--TAN'",
    "CRVAL1  =                150.0",
    "CRVAL2  =                  2.0",
    "CRPIX1  =                 48.5",
    "CRPIX2  =                 48.5",
    "CDELT1  =              -1.0E-4",
    "CDELT2  =               1.0E-4",
];

#[test]
fn rows_elsewhere_on_the_sky_are_left_out() {
    let folder = with_psf();
    folder.image("field.fits", &[SIDE; 2], &SKY, &vec![1.0; SIDE * SIDE]);
    let mut moved = SKY;
    moved[4] = "CRPIX1  =                 78.5";
    folder.image("moved.fits", &[SIDE; 2], &moved, &vec![1.0; SIDE * SIDE]);
    // At pixels 18.5, 48.5 and 88.5 of the first exposure, and half of the sky around.
    let mut rows = "id,ra,dec,mag\n".to_owned();
    for k in 0..500 {
        let (ra, dec) = (k as f64 * 0.7, (k % 90) as f64 - 45.0);
        rows += &format!("{},{ra},{dec},{k}\n", 1000 + k);
    }
    rows += "1,150.003,2,21\n2,150.0,2,22\n3,149.996,2,23\n";
    folder.write("field.csv", rows);
    let gather = |exposures: &str, psfs: &str, to: &str| {
        folder.said(&format!(
            "gather --exposure {exposures} --positions field.csv --carry mag --psf {psfs} --size 20 --out {to}"
        ))
    };
    let said = gather("field.fits", "psf.fits", "data");
    assert_has(
        &said,
        "note: field.csv: 500 of 503 positions are outside the exposure and left out",
    );
    assert!(!said.contains("warning: field.csv"), "{said}");
    let [id, mag] = folder.numbers("data/set01/stamps-001.parquet", ["id", "mag"]);
    assert_eq!(
        (&id[..], &mag[..]),
        (&[1.0, 2.0, 3.0][..], &[21.0, 22.0, 23.0][..])
    );
    // Epochs have the rows of each other: the third galaxy is beyond the second exposure.
    gather("field.fits moved.fits", "psf.fits psf.fits", "both");
    let [id] = folder.numbers("both/set01/stamps-002.parquet", ["id"]);
    assert_eq!(id, [1.0, 2.0, 3.0]);
    let far = "all 2 positions are outside the exposure (found ra 10, dec 2 first";
    folder.write("far.csv", "ra,dec\n10,2\n11,2\n");
    folder.refuses(
        "gather --exposure field.fits --positions far.csv --psf psf.fits --out no",
        far,
    );
}

#[test]
fn psfs_are_compared_with_their_own_stamps() {
    let folder = Folder::new();
    let turned = [[-1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0]];
    let write = |name: &str, side: usize, peak: f32| {
        for (k, matrix) in turned.iter().enumerate() {
            let keys = ["CD1_1", "CD1_2", "CD2_1", "CD2_2"].into_iter().zip(matrix);
            let mut cards: Vec<String> = keys
                .map(|(key, value)| format!("{key:<8}= {:>20.6E}", value * 5e-5))
                .collect();
            cards.extend(["CTYPE1  = 'RA---TAN'", "CTYPE2  = 'DEC--TAN'"].map(str::to_owned));
            let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
            let mut pixels = vec![0.1; side * side];
            pixels[side * side / 2 + side / 2] = peak + k as f32;
            folder.image(&format!("{name}-{k}.fits"), &[side; 2], &cards, &pixels);
        }
        folder.image(
            &format!("{name}.fits"),
            &[side; 2],
            &[],
            &vec![1.0; side * side],
        );
    };
    write("stamp", 24, 5.0);
    write("star", 20, 50.0);
    let line = |psfs: &str| {
        folder.remove("data");
        format!("gather --stamps stamp-0.fits stamp-1.fits --psf {psfs} --out data")
    };
    let shared = "one PSF is for all stamps, whose pixels differ on the sky";
    assert_has(&folder.said(&line("star.fits")), shared);
    let said = folder.said(&line("star-0.fits star-1.fits"));
    assert!(
        !said.contains(shared) && !said.contains("other pixel axes"),
        "{said}"
    );
    let exchanged =
        "stamp 1: the PSF image and the galaxy image have pixel axes of different orientation";
    folder.refuses(&line("star-1.fits star-0.fits"), exchanged);
}
