//! What the public folder of a challenge must not contain. What commands print is in `tests/cases/challenges.md`.

use std::collections::HashSet;
use std::fs;
use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::support::{Folder, contents};

/// Name of the challenges.
pub(crate) const NAME: &str = "pilot";
const SEED: u128 = 0x8912_3f0c_77aa_5e13_0d5b_9c41_e862_f3b7;

/// Leaves a private folder with a seed, as a `challenge new` that was stopped.
pub(crate) fn with_seed(private: &Path, seed: u128) {
    fs::create_dir(private).unwrap();
    let key = format!("name = {NAME:?}\nversion = 1\nseed = \"{seed}\"\nsecret = \"00\"\n");
    fs::write(private.join("key.toml"), key).unwrap();
}

/// Every way in which a file could contain these numbers: texts, and pairs of 32-bit words.
fn secrets(private: &Path, seeds: &[u64]) -> (HashSet<String>, HashSet<u64>) {
    let (mut texts, mut words) = (HashSet::new(), HashSet::new());
    let mut add = |bytes: [u8; 8]| {
        words.extend([u64::from_be_bytes(bytes), u64::from_le_bytes(bytes)]);
    };
    let all = contents(private).into_iter();
    for (_, content) in all.filter(|(name, _)| name.ends_with(".csv")) {
        let content = String::from_utf8(content).unwrap();
        let lines = content
            .lines()
            .skip(1)
            .filter(|line| !line.starts_with('#'));
        let mut before = 0f32;
        for number in lines.flat_map(|line| line.split(',').skip(2)) {
            texts.insert(number.to_owned());
            let value: f64 = number.parse().unwrap();
            add(value.to_be_bytes());
            let pair = [before.to_be_bytes(), (value as f32).to_be_bytes()].concat();
            add(pair.try_into().unwrap());
            before = value as f32;
        }
    }
    assert!(texts.len() > 1000);
    for seed in seeds {
        texts.extend([seed.to_string(), format!("{seed:x}")]);
        add(seed.to_be_bytes());
    }
    (texts, words)
}

/// Names of the files below `public` that contain a secret.
fn leaks(public: &Path, (texts, words): &(HashSet<String>, HashSet<u64>)) -> Vec<String> {
    let leaks = |content: &[u8]| {
        let word = |at: usize| u64::from_be_bytes(content[at..at + 8].try_into().unwrap());
        let binary = (0..content.len().saturating_sub(7)).step_by(4);
        let header = &content[..content.len().min(5760)];
        let readable = match str::from_utf8(content) {
            Ok(text) => text.to_owned(),
            Err(_) => String::from_utf8_lossy(header).into_owned(),
        };
        let separators = |c: char| !(c.is_ascii_alphanumeric() || "-.".contains(c));
        readable
            .split(separators)
            .any(|token| texts.contains(token))
            || binary.into_iter().any(|at| words.contains(&word(at)))
    };
    let files = contents(public).into_iter();
    files
        .filter(|(_, content)| leaks(content))
        .map(|(name, _)| name)
        .collect()
}

#[test]
fn public_files_contain_no_true_shear_and_no_seed() {
    let folder = Folder::new();
    let size = "--sets 2,8 --images 8 --grid 12 --amplitude 100 --metric q --spectra";
    with_seed(&folder.at("private"), SEED);
    let new = format!("challenge new --name {NAME} {size}");
    folder.run(&format!("{new} --public public --private private"));
    let (public, private) = (folder.at("public"), folder.at("private"));
    let secrets = secrets(&private, &[SEED as u64, (SEED >> 64) as u64]);
    assert_eq!(leaks(&public, &secrets), Vec::<String>::new());
    // The search finds what an ordinary simulation reveals.
    assert!(leaks(&private, &secrets).len() > 10);
    let files = contents(&public);
    let names: Vec<&str> = files.iter().map(|file| file.0.as_str()).collect();
    for name in ["README.md", "SHA256SUMS", "challenge.toml", "layout.toml"] {
        assert!(names.contains(&name), "{name}");
    }
    let secret = |name: &&str| name.contains("truth") || name.contains("intrinsic");
    assert!(!names.iter().any(secret), "{names:?}");
    for word in ["SEED", "KIND", "amplitude", "DATE"] {
        for (name, content) in &files {
            let mut parts = content.windows(word.len());
            assert!(
                !parts.any(|part| part == word.as_bytes()),
                "{word} in {name}"
            );
        }
    }
}

/// The seed below a million with which `simulate` makes the PSF of set 2.
fn guessed(public: &Path) -> Option<u64> {
    let table = fs::read_to_string(public.join("set02/psf-001.csv")).unwrap();
    let row: Vec<&str> = table.lines().nth(1).unwrap().split(',').collect();
    let (e1, e2): (f64, f64) = (row[5].parse().unwrap(), row[6].parse().unwrap());
    let angle = e2.atan2(e1).rem_euclid(std::f64::consts::TAU);
    let agrees = |seed: u64| {
        let mut key = [0; 32];
        // Seed, set, all images of the set, PSF: as in crates/simulate/src/set.rs.
        for (bytes, word) in key.chunks_exact_mut(8).zip([seed, 2, 0, 3]) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        let drawn: f64 = ChaCha8Rng::from_seed(key).random_range(0.0..std::f64::consts::TAU);
        (drawn - angle).abs() < 1e-9
    };
    (0..1_000_000).find(|&seed| agrees(seed))
}

#[test]
fn no_small_seed_regenerates_the_public_files() {
    let folder = Folder::new();
    folder.run("simulate --fixed-psf one --sets 2 --images 1 --grid 8 --seed 4321 --out data");
    assert_eq!(guessed(&folder.at("data")), Some(4321));
    // 64 bits alone, as earlier versions drew them, and both halves.
    let image = |place: &str, seed: u128| {
        with_seed(&folder.at(&format!("{place}-truth")), seed);
        let size = "--sets 2 --images 8 --grid 20 --amplitude 30";
        let folders = format!("--public {place} --private {place}-truth");
        folder.run(&format!("challenge new --name {NAME} {size} {folders}"));
        let first = fs::read(folder.at(place).join("set02/galaxies-001.fits")).unwrap();
        (guessed(&folder.at(place)), first)
    };
    let (low, of_low) = image("low", 77);
    let (high, of_high) = image("high", 77 | 1 << 64);
    let (highest, of_highest) = image("highest", 77 | 1 << 127);
    assert_eq!([low, high, highest], [Some(77), None, None]);
    assert!(of_low != of_high && of_high != of_highest && of_low != of_highest);
}
