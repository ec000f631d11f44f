//! Challenges of scenes, from their data to the board.

use std::fmt::Write;
use std::fs;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use crate::challenge::{NAME, with_seed};
use crate::support::{Folder, assert_has, contents, shell};

const SCENES: u32 = 24;
// The m of `detect` on these 50 arcmin² is 3σ above −1.
const SIZE: &str = "--side 500 --border 20 --density 100";
const SEED: u128 = 0x5eed_3f0c_77aa_5e13_0d5b_9c41_e862_f3b7;

fn new(folder: &Folder, place: &str, scenes: u32) -> String {
    let private = folder.at(&format!("{place}-truth"));
    if !private.exists() {
        with_seed(&private, SEED);
    }
    folder.said(&format!(
        "challenge new --name {NAME} --kind scenes --scenes {scenes} {SIZE} --public {place} --private {place}-truth"
    ))
}

fn shears(folder: &Folder) -> Vec<[f64; 2]> {
    let text = fs::read_to_string(folder.at("public-truth/shears.csv")).unwrap();
    let shear = |line: &str| {
        let (_, numbers) = line.split_once(',').unwrap();
        let (g1, g2) = numbers.split_once(',').unwrap();
        [g1, g2].map(|g| g.parse().unwrap())
    };
    text.lines().skip(1).map(shear).collect()
}

/// Writes an entry with `rows` of a catalogue of each scene: the shear and noise, times a factor.
fn entry(folder: &Folder, team: &str, rows: usize, factor: f64) {
    for (scene, g) in (1..).zip(shears(folder)) {
        let mut rng = ChaCha8Rng::seed_from_u64(scene);
        let mut text = "e1,e2\n".to_owned();
        for _ in 0..rows {
            let [e1, e2] = g.map(|g| factor * (g + rng.random_range(-0.2..0.2)));
            writeln!(text, "{e1},{e2}").unwrap();
        }
        folder.write(&format!("inbox/{team}/scene-{scene:03}/shapes.csv"), text);
    }
}

fn row<'b>(board: &'b Value, team: &str) -> &'b Value {
    let rows = board["rows"].as_array().unwrap();
    let found = rows.iter().find(|row| row["team"] == team);
    found.unwrap_or_else(|| panic!("{team}: {board}"))
}

#[test]
fn pipelines_are_ranked_by_their_shear_error() {
    let folder = Folder::new();
    assert_has(
        &new(&folder, "public", SCENES),
        "24 scenes of 2.35 arcmin², which determine m to about 0.241",
    );
    for scene in 1..=SCENES {
        folder.run(&format!(
            "detect --exposure public/scene-{scene:03}.fits --psf public/psf.fits --out inbox/Detect --image {scene}"
        ));
    }
    // σ of the noise of a row is 0.115, so that the errors of m are 0.016 and 0.023.
    for (team, rows, factor) in [
        ("All", 2000, 1.0),
        ("Half", 1000, 1.0),
        ("Scaled", 2000, 1.1),
        ("Zeros", 10, 0.0),
        ("Flipped", 2000, -1.0),
    ] {
        entry(&folder, team, rows, factor);
    }
    let pack = "tar czf inbox/Same.tar.gz -C inbox/Detect set01";
    assert!(shell(folder.root(), pack).status.success());
    let check = "challenge check inbox/Detect --challenge public";
    assert_has(&folder.said(check), "Used: e1=e1, e2=e2, R11=R11");
    folder.said(&format!("{check} --truth public-truth"));
    let rank = "challenge rank inbox --challenge public --truth public-truth --store store";
    let board = folder.json(&format!("{rank} --detail"));
    let of = |team: &str, key: &str| row(&board, team)[key].as_f64().unwrap();
    let order: Vec<&str> = board["rows"]
        .as_array()
        .unwrap()
        .iter()
        .map(|row| row["team"].as_str().unwrap())
        .collect();
    let expected = ["All", "Half", "Detect", "Same", "zero shear", "Scaled"];
    assert_eq!(order, expected);
    assert_has(
        row(&board, "Same")["title"].as_str().unwrap(),
        "same entry as Detect",
    );
    // 0.115/√(2000/2.35) per row, within three errors of a scatter of 22 scenes.
    let expected = 0.4 / 12f64.sqrt() / (2000.0 / 2.35_f64).sqrt();
    let ratio = of("All", "shear_error") / expected;
    assert!((ratio - 1.0).abs() < 0.33, "{ratio}");
    let ratio = of("Half", "shear_error") / of("All", "shear_error");
    assert!((1.1..1.8).contains(&ratio), "{ratio}");
    for (team, rank) in [
        ("All", "1"),
        ("Half", "2"),
        ("Detect", "3="),
        ("Same", "3="),
    ] {
        assert_eq!(row(&board, team)["rank"], rank, "{team}");
    }
    let scaled = row(&board, "Scaled");
    assert!(
        scaled["rank"].is_null() && scaled["board"] == "|m| above 0.02",
        "{scaled}"
    );
    assert!((of("Scaled", "m") - 0.1).abs() < 0.06, "{scaled}");
    // The factor is not in the shear error.
    let ratio = of("Scaled", "shear_error") / of("All", "shear_error");
    assert!((ratio - 1.0).abs() < 1e-3, "{ratio}");
    assert!((of("All", "density") - 2000.0 / 2.35).abs() < 5.0);
    // While the challenge is open, participants see neither m and c nor why an entry has no score.
    let open = folder.json(rank);
    assert!(row(&open, "All").get("m").is_none() && row(&open, "All").get("c").is_none());
    let said = folder.said(rank);
    assert_has(&said, "inbox/Zeros: not scored");
    assert_has(&said, "the entry of Flipped");
    assert_has(&said, "no score after the comparison with the true shear");
    // The numbers are those of `bias`.
    let of_bias = folder.json(
        "bias inbox/All/*/shapes.csv --truth public-truth/shears.csv --units catalogues --area 2.351",
    );
    let of_bias = |key: &str| of_bias["rows"][0][key].as_f64().unwrap();
    let m = 0.5 * (of_bias("m1") + of_bias("m2"));
    assert!((of("All", "m") - m.abs()).abs() < 1e-3, "{m}");
    let sigma = of_bias("shear_error") / (1.0 + m);
    assert!(
        (of("All", "shear_error") / sigma - 1.0).abs() < 0.02,
        "{sigma}"
    );
}

#[test]
fn catalogues_of_an_entry_are_checked() {
    let folder = Folder::new();
    new(&folder, "public", 3);
    entry(&folder, "A", 100, 1.0);
    let check = || {
        let line = "shearq challenge check inbox/A --challenge public";
        let output = shell(folder.root(), line);
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stdout).unwrap()
    };
    folder.said("challenge check inbox/A --challenge public");
    // A line passes through two scenes whatever their shears are.
    for (scene, weight) in [(1, "1e-9"), (2, "1"), (3, "1")] {
        let path = format!("inbox/A/scene-{scene:03}/shapes.csv");
        let own = fs::read_to_string(folder.at(&path)).unwrap();
        let weighted = own.trim_end().replace('\n', &format!(",{weight}\n"));
        let weighted = weighted.replacen(&format!(",{weight}"), ",w", 1);
        folder.write(&path, format!("{weighted},{weight}\n"));
    }
    let few = "few scenes decide: the mean shear follows as if from 2.0 of 3";
    assert_has(&check(), few);
    let rank = "challenge rank inbox --challenge public --truth public-truth --store store";
    assert_has(&folder.said(rank), few);
    entry(&folder, "A", 100, 1.0);
    let first = "inbox/A/scene-001/shapes.csv";
    let content = fs::read_to_string(folder.at(first)).unwrap();
    folder.write(first, content.clone() + "nan,0.1\n");
    assert_has(&check(), "scene-001/shapes.csv");
    folder.write(first, &content);
    folder.write("inbox/A/scene-001.txt", &content);
    assert_has(&check(), "another catalogue of scene 1");
    folder.remove("inbox/A/scene-001.txt");
    folder.remove(first);
    assert_has(&check(), "scene 1 has no catalogue (found 2 of 3 scenes)");
    folder.write("inbox/A/scene-004.csv", &content);
    assert_has(
        &check(),
        "scene-004.csv: the name has no number of a scene of this challenge",
    );
    folder.remove("inbox/A/scene-004.csv");
    // Faults of the form do not count as entries, and are told in full.
    assert_has(&folder.said(rank), "scene 1 has no catalogue");
    // Sheared catalogues.
    folder.remove("inbox/A");
    for (scene, g) in (1..).zip(shears(&folder)) {
        for (step, [h1, h2]) in [
            ("noshear", [0.0, 0.0]),
            ("1p", [0.01, 0.0]),
            ("1m", [-0.01, 0.0]),
            ("2p", [0.0, 0.01]),
            ("2m", [0.0, -0.01]),
        ] {
            let mut rng = ChaCha8Rng::seed_from_u64(scene);
            let mut text = "e1,e2\n".to_owned();
            for _ in 0..500 {
                let noise: f64 = rng.random_range(-0.01..0.01);
                writeln!(
                    text,
                    "{},{}",
                    0.5 * (g[0] + h1) + noise,
                    0.5 * (g[1] + h2) - noise
                )
                .unwrap();
            }
            folder.write(&format!("inbox/A/scene-{scene:03}_{step}.csv"), text);
        }
    }
    let board = folder.json(&format!("{rank} --detail"));
    let m = row(&board, "A")["m"].as_f64().unwrap();
    assert!(m < 0.05 && row(&board, "A")["rank"] == "1", "{board}");
}

#[test]
fn stopped_challenges_of_scenes_continue_to_the_same_files() {
    let folder = Folder::new();
    for place in ["whole", "stopped"] {
        new(&folder, place, 3);
    }
    for file in [
        "stopped/challenge.toml",
        "stopped/SHA256SUMS",
        "stopped/scene-002.fits",
        "stopped-truth/truth-003.csv",
    ] {
        folder.remove(file);
    }
    new(&folder, "stopped", 3);
    for ending in ["", "-truth"] {
        let [whole, stopped] =
            ["whole", "stopped"].map(|place| contents(&folder.at(&format!("{place}{ending}"))));
        assert!(whole == stopped, "{ending}");
    }
    let secret = fs::read_to_string(folder.at("whole-truth/shears.csv")).unwrap();
    let secret: Vec<&str> = secret
        .lines()
        .skip(1)
        .flat_map(|line| line.split(',').skip(1))
        .collect();
    let seed = SEED.to_string();
    let halves = [SEED as u64, (SEED >> 64) as u64].map(|half| half.to_string());
    for (name, content) in contents(&folder.at("whole")) {
        let text = String::from_utf8_lossy(&content);
        let words = secret
            .iter()
            .copied()
            .chain([&*seed, &halves[0], &halves[1]]);
        assert_eq!(
            words.filter(|word| text.contains(word)).count(),
            0,
            "{name}"
        );
    }
}

#[test]
fn seeds_of_scenes_have_128_bits() {
    let folder = Folder::new();
    let first = |place: &str, seed: u128| {
        with_seed(&folder.at(&format!("{place}-truth")), seed);
        new(&folder, place, 3);
        fs::read(folder.at(&format!("{place}/scene-001.fits"))).unwrap()
    };
    let all = [
        ("low", 77),
        ("high", 77 | 1 << 64),
        ("highest", 77 | 1 << 127),
    ]
    .map(|(place, seed)| first(place, seed));
    assert!(all[0] != all[1] && all[1] != all[2] && all[0] != all[2]);
}

#[test]
fn options_of_other_kinds_are_refused() {
    let folder = Folder::new();
    let new = |options: &str| {
        format!("challenge new --name {NAME} {options} --public public --private private")
    };
    folder.refuses(
        &new("--scenes 3"),
        "--scenes is of another kind of challenge (found --kind great10). Try: --kind scenes",
    );
    folder.refuses(
        &new("--kind scenes --sets 2 --images 8"),
        "--kind scenes needs the number of scenes. Try: --scenes N",
    );
    folder.refuses(
        &new("--kind scenes --scenes 100000"),
        "--scenes: found 100000, expected 3 to",
    );
    folder.refuses(
        &new("--kind scenes --scenes 2"),
        "--scenes: found 2, expected 3 to",
    );
    folder.refuses(
        &new("--kind scenes --scenes 3 --density 0"),
        "--density: found 0 galaxies",
    );
}
