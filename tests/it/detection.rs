//! Detection on exposures, from scenes to m.

use std::fs;

use crate::support::{Folder, assert_has, contents};

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
