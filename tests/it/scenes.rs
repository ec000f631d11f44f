//! Scenes, from their simulation to m.

use crate::support::{Folder, assert_has, contents, csv, pixels_of};

const SMALL: &str = "simulate --scenes 2 --side 300 --density 60 --stars 3 --opposite";

#[test]
fn scenes_are_the_same_for_any_number_of_threads() {
    let folder = Folder::new();
    folder.run(&format!("{SMALL} --threads 1 --out one"));
    folder.run(&format!("{SMALL} --threads 3 --out three"));
    let [one, three] = ["one", "three"].map(|name| contents(&folder.at(name)));
    assert!(one == three && one.len() == 13, "{} files", one.len());
}

#[test]
fn further_scenes_are_added_to_those_that_are_there() {
    let folder = Folder::new();
    let scenes =
        |count: u32, out: &str| format!("simulate --side 200 --scenes {count} --out {out}");
    folder.run(&scenes(3, "all"));
    folder.run(&scenes(1, "some"));
    assert_has(
        &folder.said(&scenes(3, "some")),
        "2 scenes of 0.44 arcmin² simulated, 1 there already",
    );
    assert!(contents(&folder.at("all")) == contents(&folder.at("some")));
    folder.refuses(
        "simulate --side 200 --scenes 3 --density 20 --out some",
        "settings.density: 75.0 ≠ 20.0",
    );
    // A scene without its table of galaxies is incomplete.
    folder.remove("some/truth-002.csv");
    assert_has(&folder.said(&scenes(3, "some")), "1 scenes of");
}

#[test]
fn noise_does_not_depend_on_what_is_drawn() {
    let folder = Folder::new();
    let scene = |density: &str, out: &str| {
        folder.run(&format!(
            "simulate --scenes 1 --side 256 {density} --out {out}"
        ));
        pixels_of(&folder.at(&format!("{out}/scene-001.fits"))).0
    };
    let (full, empty) = (
        scene("--density 40 --snr 50,100", "full"),
        scene("--density 0", "empty"),
    );
    let mean: f32 = empty.iter().sum::<f32>() / empty.len() as f32;
    let square: f32 = empty.iter().map(|value| value * value).sum::<f32>() / empty.len() as f32;
    // 65,536 pixels: four standard errors of a mean and of a variance.
    assert!(
        mean.abs() < 0.016 && (square - 1.0).abs() < 0.022,
        "{mean} {square}"
    );
    // What galaxies add is positive but for rounding: no noise is left.
    let least = full
        .iter()
        .zip(&empty)
        .map(|(a, b)| a - b)
        .fold(0.0, f32::min);
    assert!(least > -1e-3, "{least}");
}

/// The whole way, which has the sign of the shear, the axes of images, positions and truth, and the names of `shears.csv`: a
/// flipped y axis gives m2 = −2.
#[test]
fn galaxies_of_scenes_have_the_shear_stated() {
    let folder = Folder::new();
    let scenes =
        "--scenes 3 --side 700 --border 60 --seed 4 --layout hexagonal --density 25 --snr 100,200";
    folder.run(&format!(
        "simulate {scenes} --constant-shear 0.05,0.03 --opposite --rotated --out scenes"
    ));
    for version in ["+0.05_g2_+0.03", "-0.05_g2_-0.03"] {
        for turn in ["", "_rotated"] {
            for scene in 1..=3 {
                let own = format!("g1_{version}{turn}");
                let data = format!("scenes/{own}");
                let positions = format!("{data}/truth-00{scene}.csv");
                folder.run(&format!(
                    "gather --exposure {data}/scene-00{scene}.fits --psf {data}/psf.fits --positions {positions} --out stamps"
                ));
                let out = format!("shapes/{own}/scene-00{scene}");
                folder.run(&format!(
                    "measure --submission 48/linear/star --data stamps --out {out}"
                ));
                folder.remove("stamps");
            }
        }
    }
    let all = folder.json(
        "bias shapes/*/*/set01/*.parquet --truth scenes/shears.csv --area 3.74 --units catalogues",
    );
    let row = &all["rows"][0];
    for (key, error) in [("m1", "m1_error"), ("m2", "m2_error")] {
        let [m, sigma] = [key, error].map(|key| row[key].as_f64().unwrap());
        // A lattice has no blends, and S/N 100 hardly any noise. 3e-3: the limit of terms of second order in the shear of 0.06.
        assert!(
            m.abs() < 3e-3 + 4.0 * sigma && sigma < 0.02,
            "{key}: {m} ± {sigma}"
        );
    }
    let density = row["density"].as_f64().unwrap();
    assert!((density - 25.0).abs() < 2.0, "{density}");
}

#[test]
fn places_on_the_sky_are_those_of_the_header() {
    let folder = Folder::new();
    folder.run("simulate --scenes 1 --side 400 --density 30 --out scene");
    let truth = folder.at("scene/truth-001.csv");
    let columns = csv(&truth, &["x", "y", "ra", "dec"]);
    // x to the west, y to the north, from the centre at (150, 0): tangents of small angles.
    let pixel = 0.2 / 3600.0;
    for [x, y, ra, dec] in columns[0]
        .iter()
        .zip(&columns[1])
        .zip(columns[2].iter().zip(&columns[3]))
        .map(|((x, y), (ra, dec))| [x, y, ra, dec])
    {
        assert!((150.0 - ra - (x - 200.5) * pixel).abs() < 1e-8, "{x} {ra}");
        assert!((dec - (y - 200.5) * pixel).abs() < 1e-8, "{y} {dec}");
    }
}

#[test]
fn epochs_of_a_scene_have_the_same_sky() {
    let folder = Folder::new();
    let scene = "--scenes 1 --side 700 --border 160 --layout hexagonal --density 25 --snr 300,400";
    let simulate = format!("simulate {scene} --epochs 2 --out scene");
    assert_has(&folder.said(&simulate), "2 exposures of");
    let whole = contents(&folder.at("scene"));
    folder.remove("scene/scene-001-epoch-2.fits");
    assert_has(&folder.said(&simulate), "1 exposures of");
    assert!(whole == contents(&folder.at("scene")));
    folder.run("gather --exposure scene/scene-001.fits scene/scene-001-epoch-2.fits --psf scene/psf.fits scene/psf.fits --positions scene/truth-001.csv --degrees --frame sky --out stamps");
    folder.run("measure --submission 48/linear/star --data stamps --out shapes");
    let [first, second] = [1, 2].map(|epoch| {
        let path = format!("shapes/set01/catalogue-00{epoch}.parquet");
        folder.numbers(&path, ["e1", "e2"])
    });
    // Shapes have a scatter of 0.2, noise of S/N 300 one of 0.004.
    let off = first.iter().flatten().zip(second.iter().flatten());
    let off: Vec<f64> = off.map(|(a, b)| (a - b).abs()).collect();
    let largest = off.iter().copied().fold(0.0, f64::max);
    assert!(off.len() > 20 && largest < 0.03, "{largest} {}", off.len());
}

#[test]
fn mean_says_that_crowded_positions_are_without_detection() {
    let folder = Folder::new();
    let said = |layout: &str| {
        folder.run(&format!(
            "simulate --scenes 1 --side 500 --density 20 --snr 30,100 --layout {layout} --out {layout}"
        ));
        let (scene, star) = (
            format!("{layout}/scene-001.fits"),
            format!("{layout}/psf.fits"),
        );
        folder.run(&format!(
            "gather --exposure {scene} --psf {star} --positions {layout}/truth-001.csv --out {layout}/stamps"
        ));
        folder.run(&format!(
            "measure --submission 48/linear/star --data {layout}/stamps --out {layout}/shapes"
        ));
        folder.run(&format!("mean --measured {layout}/shapes"))
    };
    let crowded = said("random");
    let words: Vec<&str> = crowded.split_whitespace().collect();
    assert_has(&words.join(" "), "without detection:");
    assert_has(&words.join(" "), "within 24 px");
    // Galaxies of the lattice are 72 px apart.
    assert!(!said("hexagonal").contains("without detection"));
}
