//! Detection on exposures, from scenes to m.

use std::fs;

use crate::support::{Folder, assert_has, contents, pixels_of};

/// The whole way, which has the signs of shear and response, the noise of the response, and places that move with the shear.
#[test]
fn detections_on_scenes_have_the_shear_stated() {
    let folder = Folder::new();
    let scenes = "--scenes 2 --side 600 --border 60 --seed 5 --density 60 --snr 8,100";
    folder.run(&format!(
        "simulate {scenes} --constant-shear 0.05,0.03 --opposite --rotated --opposite-noise --out scenes"
    ));
    let mut versions = 0;
    for version in fs::read_dir(folder.at("scenes")).unwrap() {
        let version = version.unwrap();
        if !version.path().is_dir() {
            continue;
        }
        versions += 1;
        let own = version.file_name().into_string().unwrap();
        for scene in 1..=2 {
            let data = format!("scenes/{own}");
            folder.run(&format!(
                "detect --exposure {data}/scene-00{scene}.fits --psf {data}/psf.fits --out shapes/{own}/scene-00{scene}"
            ));
        }
    }
    assert_eq!(versions, 8);
    let all = folder.json(
        "bias shapes/*/*/set01/*.parquet --truth scenes/shears.csv --area 2.56 --units catalogues",
    );
    let row = &all["rows"][0];
    for (key, error) in [("m1", "m1_error"), ("m2", "m2_error")] {
        let [m, sigma] = [key, error].map(|key| row[key].as_f64().unwrap());
        // The error of 5 arcmin² in eight versions is 0.1: a test of signs, with which m is −2. Unit tests have the rest.
        assert!(m.abs() < 0.4 && sigma < 0.2, "{key}: {m} ± {sigma}");
    }
}

#[test]
fn catalogues_are_the_same_for_any_number_of_threads() {
    let folder = Folder::new();
    folder.run("simulate --scenes 1 --side 900 --density 60 --constant-shear 0.02,0 --out scene");
    let detect = "detect --exposure scene/scene-001.fits --psf scene/psf.fits --threshold 5";
    folder.run(&format!("{detect} --threads 1 --out one"));
    folder.run(&format!("{detect} --threads 3 --out three"));
    let [one, three] = ["one", "three"].map(|name| contents(&folder.at(name)));
    assert!(one == three && one.len() == 2, "{} files", one.len());
    // Without further options.
    for command in [
        "mean --measured one",
        "shear --measured one --out shears.parquet",
    ] {
        folder.run(command);
    }
    folder.run("bias one/set01/catalogue-001.parquet --g1 0.02 --g2 0");
    assert_has(
        &folder.run(&format!("{detect} --out more --image 2 --format json")),
        "\"detections\"",
    );
}

#[test]
fn a_psf_that_varies_is_that_of_each_place() {
    let folder = Folder::new();
    let scene = "simulate --scenes 1 --side 900 --border 60 --seed 3 --density 40 --snr 20,200 --constant-shear 0,0 --psf-shape 0,0";
    folder.run(&format!("{scene} --out constant"));
    folder.run(&format!("{scene} --psf-gradient 0.05,0.1 --out varying"));
    let detect = |out: &str, more: &str| folder.json(&format!("detect {more} --out {out}"));
    let scene =
        |data: &str, psf: &str| format!("--exposure {data}/scene-001.fits --psf {data}/{psf}");
    let constant = detect("constant/out", &scene("constant", "psf.fits"));
    let varying = detect("varying/out", &scene("varying", "model.psf --threads 1"));
    assert_eq!(
        (constant["cells"].as_u64(), varying["cells"].as_u64()),
        (Some(1), Some(9))
    );
    detect("varying/three", &scene("varying", "model.psf --threads 3"));
    assert!(contents(&folder.at("varying/out")) == contents(&folder.at("varying/three")));
    detect("varying/middle", &scene("varying", "psf.fits"));
    // e1 of the PSF is 0.1 at the right edge, and −0.1 at the left one.
    let difference = |out: &str| {
        let g1 = |side: &str| {
            let mean = folder.json(&format!(
                "bias varying/{out}/set01/catalogue-001.parquet --g1 0 --g2 0 --where \"x {side} 450\""
            ));
            mean["rows"][0]["c1"].as_f64().unwrap()
        };
        g1(">") - g1("<")
    };
    let [own, middle] = ["out", "middle"].map(difference);
    // Shapes of galaxies cancel in the difference of both.
    assert!(middle - own > 0.05, "{own} {middle}");
}

#[test]
fn models_of_other_exposures_are_refused() {
    let folder = Folder::new();
    folder.run("simulate --scenes 1 --side 300 --density 20 --constant-shear 0,0 --psf-gradient 0.01,0.01 --out small");
    folder.run("simulate --scenes 1 --side 900 --density 20 --constant-shear 0,0 --out large");
    folder.refuses(
        "detect --exposure large/scene-001.fits --psf small/model.psf --out out",
        "the model has no stars near x = 788, y = 113 of the exposure (found stars with x from 0 to 300 and y from 0 to 300; expected some in all parts). Try: the model of this exposure and chip",
    );
}

#[test]
fn what_an_exposure_lacks_is_said() {
    let folder = Folder::new();
    folder.run("simulate --scenes 1 --side 400 --density 0 --constant-shear 0,0 --out empty");
    folder.run("simulate --scenes 1 --side 600 --density 0 --constant-shear 0,0 --out large");
    let scene = "--exposure empty/scene-001.fits --psf empty/psf.fits --out out";
    folder.refuses(
        &format!("detect {scene} --threshold 12"),
        "no galaxy was detected (expected some). Try: a lower --threshold, or check --noise",
    );
    folder.refuses(
        &format!("detect {scene} --threshold 1"),
        "--threshold is 1.0; expected 3 to 10000",
    );
    folder.refuses(
        &format!("detect {scene} --noise 0"),
        "--noise is 0.0; expected a positive number",
    );
    folder.refuses(
        "detect --exposure empty/psf.fits --psf large/scene-001.fits --noise 1 --out out",
        "the PSF of 600 × 600 pixels; expected a square stamp of a star",
    );
    folder.refuses(
        "detect --exposure empty/psf.fits --psf empty/psf.fits --out out",
        "the noise cannot be measured (expected an exposure with blank sky",
    );
}

#[test]
fn exposures_of_one_sky_are_combined() {
    let folder = Folder::new();
    folder.run("simulate --scenes 1 --side 600 --border 60 --seed 3 --density 40 --psf-shape 0,0 --constant-shear 0,0 --opposite-noise --out scenes");
    let [first, other] = ["g1_+0_g2_+0", "g1_+0_g2_+0_noise"].map(|own| format!("scenes/{own}"));
    let (pixels, width) = pixels_of(&folder.at(&format!("{other}/scene-001.fits")));
    // Axes are exchanged, and the first ten columns are missing.
    let pixel = |at: usize| pixels[(at % (width - 10) + 10) * width + at / (width - 10)];
    let turned: Vec<f32> = (0..width * (width - 10)).map(pixel).collect();
    let step = 0.2 / 3600.0;
    let card = |key: &str, value: f64| format!("{key:<8}= {value:>20.12}");
    let mut cards = vec![
        "CTYPE1  = 'RA---TAN'".to_owned(),
        "CTYPE2  = 'DEC--TAN'".to_owned(),
    ];
    let values = [
        ("CRPIX1", 290.5),
        ("CRPIX2", 300.5),
        ("CRVAL1", 150.0),
        ("CRVAL2", 0.0),
        ("CD1_2", -step),
        ("CD2_1", step),
        ("NOISESIG", 1.0),
    ];
    cards.extend(values.map(|(key, value)| card(key, value)));
    let cards: Vec<&str> = cards.iter().map(String::as_str).collect();
    let sides = [width - 10, width];
    folder.image("turned.fits", &sides, &cards, &turned);
    folder.image("plain.fits", &sides, &cards[..2], &turned);
    let mut mask = vec![0.0f32; sides[0] * sides[1]];
    mask[300 * sides[0] + 200] = 1.0;
    folder.image("mask.fits", &sides, &[], &mask);
    folder.image("clear.fits", &[width; 2], &[], &vec![0.0; width * width]);
    let psf = format!("--psf {first}/psf.fits");
    let detect = format!("detect --exposure {first}/scene-001.fits");
    let alone = folder.json(&format!("{detect} {psf} --out alone"));
    let both = format!("{detect} turned.fits {psf}");
    let found = folder.json(&format!("{both} --threads 1 --out one"));
    folder.run(&format!("{both} --threads 3 --out three"));
    let [one, three] = ["one", "three"].map(|name| contents(&folder.at(name)));
    assert!(one == three && one.len() == 2, "{} files", one.len());
    assert_eq!((&alone["epochs"], &found["epochs"]), (&1.into(), &2.into()));
    assert_eq!(found["noise"], serde_json::json!([1.0, 1.0]));
    // The threshold is lower by the root of two.
    let rows = |found: &serde_json::Value| found["detections"].as_f64().unwrap();
    assert!(rows(&found) > 1.1 * rows(&alone), "{alone} {found}");
    folder.run("mean --measured one");
    // Places, parity and shapes of bright galaxies are those of the first one.
    let columns = ["x", "y", "e1", "e2", "selection", "snr"];
    let [alone, both_rows] = ["alone", "one"]
        .map(|name| folder.numbers(&format!("{name}/set01/catalogue-001.parquet"), columns));
    let mut bright = 0;
    for row in (0..alone[0].len()).filter(|row| alone[5][*row] > 60.0) {
        let is_near =
            |other: &usize| (0..2).all(|k| (both_rows[k][*other] - alone[k][row]).abs() < 0.5);
        let other = (0..both_rows[0].len()).find(is_near).unwrap();
        for k in [2, 3] {
            let e = |own: &[Vec<f64>; 6], row: usize| own[k][row] / own[4][row];
            let (one, both) = (e(&alone, row), e(&both_rows, other));
            // The softening of e is proportional to the noise.
            assert!((one - both).abs() < 0.03 + 0.2 * one.abs(), "{one} {both}");
        }
        bright += 1;
    }
    assert!(bright > 3, "{bright}");
    let masked = folder.json(&format!(
        "{detect} turned.fits {psf} --mask clear.fits mask.fits --out masked"
    ));
    assert_eq!(masked["missing"], 1);
    folder.refuses(
        &format!("{detect} plain.fits {psf} --out none"),
        "plain.fits: image 1, plane 1: there is no celestial WCS (expected one of each of several exposures",
    );
    folder.refuses(
        &format!("{both} {first}/psf.fits {first}/psf.fits --out none"),
        "--psf has 3 files for 2 exposures (expected one for each, in the same order)",
    );
    folder.refuses(
        &format!("{both} --mask mask.fits --out none"),
        "--mask has 1 file for 2 exposures",
    );
}

#[test]
fn detections_are_not_cut_by_what_shear_changes() {
    let folder = Folder::new();
    folder.run("simulate --scenes 1 --side 500 --density 60 --constant-shear 0.02,0 --out scene");
    let detect = "detect --exposure scene/scene-001.fits --psf scene/psf.fits --out found";
    folder.run(detect);
    let mean = "mean found/set01/catalogue-001.parquet";
    for cut in ["--where 'snr > 10'", "--columns w=selection"] {
        folder.refuses(
            &format!("{mean} {cut}"),
            "the response of a cut or weight by their columns is not known",
        );
    }
    folder.run(&format!("{mean} --where 'x < 250'"));
    let twice = detect.replace("--psf", "scene/scene-001.fits --psf");
    folder.refuses(
        &twice.replace("found", "twice"),
        "the same pixels as an earlier exposure",
    );
}
