//! A challenge from its data to its leaderboard, and attempts to obtain the truth.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use flate2::Compression;
use flate2::write::GzEncoder;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use shearq_challenge::create::seed_of;
use shearq_challenge::receipt::Receipt;
use shearq_challenge::seal::{Key, sha256};

use crate::support::{contents, fail, shearq, succeed, text};

/// Name of the challenges.
const NAME: &str = "pilot";

/// A challenge with two entries of shearq, which are packed as `linear.tar.gz` and `den.tar.gz`.
struct Pilot {
    root: tempfile::TempDir,
}

/// The seed of the challenges.
const SEED: u64 = 9_876_543_210_123_456_789;

impl Pilot {
    /// A new challenge with more options.
    fn new(more: &[&str]) -> Self {
        let pilot = Pilot {
            root: tempfile::tempdir().unwrap(),
        };
        let (public, private) = (pilot.at("public"), pilot.at("private"));
        let new = [
            "challenge",
            "new",
            "--name",
            NAME,
            "--sets",
            "2,8",
            "--images",
            "8",
            "--grid",
            "12",
            "--amplitude",
            "100",
            "--seed",
            &SEED.to_string(),
            "--public",
            text(&public),
            "--private",
            text(&private),
        ];
        succeed(&[&new[..], more].concat());
        pilot
    }

    fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// Measures with a configuration and packs the result.
    fn enter(&self, configuration: &str, measured: &str, archive: &str, more: &[&str]) -> PathBuf {
        let (public, out, path) = (self.at("public"), self.at(measured), self.at(archive));
        if !out.exists() {
            let measure = [
                "measure",
                "--submission",
                configuration,
                "--data",
                text(&public),
            ];
            succeed(&[&measure[..], &["--out", text(&out)]].concat());
        }
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let pack = [
            "pack",
            "--measured",
            text(&out),
            "--out",
            text(&path),
            "--challenge",
            NAME,
        ];
        succeed(&[&pack[..], more].concat());
        path
    }

    /// Unpacks an archive and writes its catalogues again after `edit`, without a manifest.
    fn edited(
        &self,
        archive: &Path,
        name: &str,
        edit: impl Fn(usize, [f64; 4]) -> [f64; 4],
    ) -> PathBuf {
        let folder = self.at(name);
        succeed(&["unpack", text(archive), "--out", text(&folder)]);
        fs::remove_file(folder.join("manifest.json")).unwrap();
        for (file, content) in contents(&folder) {
            let content = String::from_utf8(content).unwrap();
            let mut lines = String::new();
            for (k, line) in content.lines().enumerate() {
                let numbers: Vec<f64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
                let [x, y, e1, e2] = edit(k, numbers.try_into().unwrap());
                lines += &format!("{x} {y} {e1} {e2}\n");
            }
            fs::write(folder.join(file), lines).unwrap();
        }
        folder
    }

    /// Ranks `inbox` into `store`.
    fn rank(&self, inbox: &str, store: &str, more: &[&str]) -> (Value, String) {
        let (public, private) = (self.at("public"), self.at("private"));
        let (inbox, store) = (self.at(inbox), self.at(store));
        let rank = [
            "challenge",
            "rank",
            text(&inbox),
            "--challenge",
            text(&public),
            "--truth",
            text(&private),
            "--store",
            text(&store),
            "--format",
            "json",
        ];
        let output = shearq(&[&rank[..], more].concat());
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{said}");
        (serde_json::from_slice(&output.stdout).unwrap(), said)
    }

    /// Names of the checks that an entry fails, and whether it is accepted.
    fn check(&self, entry: &Path) -> (Vec<String>, bool) {
        let public = self.at("public");
        let output = shearq(&[
            "challenge",
            "check",
            text(entry),
            "--challenge",
            text(&public),
            "--json",
        ]);
        let findings: Value = serde_json::from_slice(&output.stdout).unwrap();
        let name = |finding: &Value| finding["check"].as_str().unwrap().to_owned();
        let mut names: Vec<String> = findings.as_array().unwrap().iter().map(name).collect();
        names.sort();
        names.dedup();
        (names, output.status.success())
    }
}

fn teams(board: &Value) -> Vec<(u64, String)> {
    let rows = board["rows"].as_array().unwrap().iter();
    rows.map(|row| {
        (
            row["rank"].as_u64().unwrap_or(0),
            row["team"].as_str().unwrap().to_owned(),
        )
    })
    .collect()
}

/// Packs a folder as anyone could.
fn archive(folder: &Path, path: &Path) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let file = fs::File::create(path).unwrap();
    let mut builder = tar::Builder::new(GzEncoder::new(file, Compression::fast()));
    builder.append_dir_all(".", folder).unwrap();
    builder.into_inner().unwrap().finish().unwrap();
}

/// Every way in which a file could contain these numbers: texts, and pairs of 32-bit words.
fn secrets(private: &Path, seeds: &[u64]) -> (HashSet<String>, HashSet<u64>) {
    let (mut texts, mut words) = (HashSet::new(), HashSet::new());
    let mut add = |bytes: [u8; 8]| {
        words.insert(u64::from_be_bytes(bytes));
        words.insert(u64::from_le_bytes(bytes));
    };
    for (name, content) in contents(private) {
        if !name.ends_with(".csv") {
            continue;
        }
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
        texts.insert(seed.to_string());
        texts.insert(format!("{seed:x}"));
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
fn a_challenge_runs_from_its_data_to_its_leaderboard() {
    let pilot = Pilot::new(&["--closes", "2999-12-31", "--metric", "q", "--spectra"]);
    let public = pilot.at("public");
    let secrets = secrets(&pilot.at("private"), &[SEED, seed_of(NAME, 1, SEED)]);
    assert_eq!(leaks(&public, &secrets), Vec::<String>::new());
    // The search finds what an ordinary simulation reveals.
    assert!(leaks(&pilot.at("private"), &secrets).len() > 10);
    let names: Vec<String> = contents(&public).into_iter().map(|file| file.0).collect();
    for name in ["README.md", "SHA256SUMS", "challenge.toml", "layout.toml"] {
        assert!(names.iter().any(|own| own == name), "{name}");
    }
    assert!(
        !names
            .iter()
            .any(|name| name.contains("truth") || name.contains("intrinsic"))
    );
    for word in ["SEED", "KIND", "amplitude", "DATE"] {
        let found = contents(&public).into_iter().find(|(_, content)| {
            content
                .windows(word.len())
                .any(|part| part == word.as_bytes())
        });
        assert!(found.is_none(), "{word} in {:?}", found.map(|file| file.0));
    }
    let linear = pilot.enter(
        "48/linear/star",
        "linear",
        "inbox/a.tar.gz",
        &["--team", "Linear", "--title", "=1+1"],
    );
    let hostile = "<script>alert(1)</script>";
    let den = pilot.enter(
        "23/den/star",
        "den",
        "inbox/Ours/den.tar.gz",
        &["--team", "ignored", "--method", "d"],
    );
    pilot.enter(
        "23/raw/star",
        "raw",
        "inbox/evil.tar.gz",
        &[
            "--team",
            hostile,
            "--title",
            "@SUM(A1)",
            "--contact",
            "secret@example.org",
        ],
    );
    // Another program's shapes: less response, and noise of its own.
    let other = pilot.edited(&linear, "other", |k, [x, y, e1, e2]| {
        let noise = 0.2 * (k as f64 * 12.9898).sin();
        [x, y, 0.9 * e1 + noise, 0.9 * e2 - noise]
    });
    archive(&other, &pilot.at("inbox/Regauss/shapes.tgz"));
    for entry in [&linear, &den] {
        let (_, accepted) = pilot.check(entry);
        assert!(accepted, "{}", entry.display());
    }
    let whole = fs::read(&linear).unwrap();
    fs::write(pilot.at("inbox/broken.tar.gz"), &whole[..whole.len() / 2]).unwrap();
    fs::write(pilot.at("inbox/copy.tar.gz"), &whole).unwrap();
    let flipped = pilot.edited(&den, "flipped", |_, [x, y, e1, e2]| [x, y, e1, -e2]);
    archive(&flipped, &pilot.at("inbox/flipped.tar.gz"));
    let page = pilot.at("board.html");
    let reference = pilot.at("spectra.tar.gz");
    let pack = ["pack", "--kind", "cross-spectra", "--out", text(&reference)];
    succeed(&[&pack[..], &["--measured", text(&pilot.at("linear"))]].concat());
    let more = [
        "--report",
        text(&page),
        "--reference",
        text(&reference),
        "--detail",
    ];
    let (board, said) = pilot.rank("inbox", "store", &more);
    for expected in [
        "broken.tar.gz: not scored: cannot unpack",
        "not scored: identical content as ",
        "flipped.tar.gz: not scored: g10_v1_objs_2_1.d.dat: the shapes agree with the image only after a change of signs or axes",
        "expected 5, standard); also image 2-8 [reference",
        "entries: 5 scored, 0 scored earlier, 3 not scored",
    ] {
        assert!(said.contains(expected), "{expected}\n{said}");
    }
    let ranked = teams(&board);
    let rank_of = |team: &str| ranked.iter().find(|(_, own)| own == team).unwrap().0;
    assert_eq!(ranked.len(), 6);
    assert_eq!((rank_of("spectra"), rank_of("zero shear")), (0, 0));
    assert!(rank_of("Linear") < rank_of("Regauss"), "{ranked:?}");
    assert!(rank_of("Linear") < rank_of(hostile), "{ranked:?}");
    assert!(ranked.iter().all(|(_, team)| team != "ignored"));
    // Q is that of `score`, with the decimals of the leaderboard.
    let data = pilot.at("private");
    let score = ["score", "--data", text(&data), "--packed", text(&linear)];
    let scores = succeed(&[&score[..], &["--format", "json"]].concat());
    let scores: Value = serde_json::from_str(&scores).unwrap();
    let rows = scores["rows"].as_array().unwrap();
    let q = |set: u32| -> f64 {
        let of_set = |row: &&Value| {
            let own = row["set"].as_str().and_then(|own| own.parse().ok());
            own == Some(set)
        };
        rows.iter().find(of_set).unwrap()["q"].as_f64().unwrap()
    };
    let mean = 0.5 * (q(2) + q(8));
    let own = board["rows"]
        .as_array()
        .unwrap()
        .iter()
        .find(|row| row["team"] == "Linear")
        .unwrap();
    assert!(
        (own["q"].as_f64().unwrap() - mean).abs() <= 0.05 + 1e-9,
        "{own} {mean}"
    );
    assert_eq!(own["q"], format!("{mean:.1}").parse::<f64>().unwrap());
    let html = fs::read_to_string(&page).unwrap();
    assert!(html.contains("&lt;script&gt;alert(1)") && !html.contains(hostile));
    assert!(html.contains("figure-q-per-set") && !html.contains("secret@example.org"));
    let csv = fs::read_to_string(page.with_extension("csv")).unwrap();
    assert!(
        csv.contains(",'=1+1,") && csv.contains(",'@SUM(A1),"),
        "{csv}"
    );
    assert!(page.with_extension("json").exists());
    // A repeated run scores nothing, and changes nothing.
    let before = contents(&pilot.at("store"));
    let (again, said) = pilot.rank("inbox", "store", &more);
    assert!(
        said.contains("entries: 0 scored, 5 scored earlier, 3 not scored"),
        "{said}"
    );
    assert_eq!((again, contents(&pilot.at("store"))), (board, before));
    let store = pilot.at("store");
    let compared = succeed(&["compare", "--store", text(&store), "--format", "csv"]);
    assert!(compared.contains("Regauss: 48-linear-star"), "{compared}");
}

/// Another way to the same leaderboard: two processes at the same time, and one that is killed.
#[test]
fn concurrent_and_killed_rankings_lose_nothing() {
    let pilot = Pilot::new(&[]);
    let linear = pilot.enter(
        "48/linear/star",
        "linear",
        "linear.tar.gz",
        &["--team", "Linear"],
    );
    for k in 0..12 {
        let folder = pilot.edited(&linear, &format!("entry-{k}"), |row, [x, y, e1, e2]| {
            let noise = 0.01 * f64::from(k) * (row as f64).sin();
            [x, y, e1 + noise, e2]
        });
        archive(
            &folder,
            &pilot.at(&format!("inbox/team{}/{k}.tar.gz", k % 4)),
        );
    }
    let (expected, said) = pilot.rank("inbox", "alone", &[]);
    assert!(said.contains("entries: 12 scored"), "{said}");
    let (public, private, inbox) = (pilot.at("public"), pilot.at("private"), pilot.at("inbox"));
    let start = |store: &Path| {
        Command::new(env!("CARGO_BIN_EXE_shearq"))
            .args([
                "challenge",
                "rank",
                text(&inbox),
                "--challenge",
                text(&public),
            ])
            .args(["--truth", text(&private), "--store", text(store)])
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap()
    };
    let together = pilot.at("together");
    let mut both = [start(&together), start(&together)];
    for process in &mut both {
        assert!(process.wait().unwrap().success());
    }
    // Without the time of arrival, which is that of the first scoring.
    let untimed = |board: Value| {
        let mut rows = board["rows"].as_array().unwrap().clone();
        for row in &mut rows {
            row["received"] = Value::Null;
        }
        rows
    };
    let (board, said) = pilot.rank("inbox", "together", &[]);
    assert!(
        said.contains("entries: 0 scored, 12 scored earlier"),
        "{said}"
    );
    assert_eq!(untimed(board), untimed(expected.clone()));
    let killed = pilot.at("killed");
    for wait in [5, 20, 40, 60, 80, 100] {
        let mut process = start(&killed);
        std::thread::sleep(std::time::Duration::from_millis(wait));
        process.kill().unwrap();
        process.wait().unwrap();
    }
    let (board, _) = pilot.rank("inbox", "killed", &[]);
    assert_eq!(untimed(board), untimed(expected));
}

#[test]
fn an_entry_is_checked_without_the_truth() {
    let pilot = Pilot::new(&["--entries-per-team", "1"]);
    fs::remove_dir_all(pilot.at("private")).unwrap();
    let linear = pilot.enter(
        "48/linear/star",
        "linear",
        "linear.tar.gz",
        &["--team", "Linear"],
    );
    assert_eq!(pilot.check(&linear), (vec![], true));
    // `check` without data takes the grid from the positions.
    let plain = succeed(&["check", text(&linear)]);
    assert!(plain.ends_with("linear.tar.gz: no findings\n"), "{plain}");
    let swapped = pilot.edited(&linear, "swapped", |_, [x, y, e1, e2]| [x, y, e2, e1]);
    assert_eq!(pilot.check(&swapped), (vec!["convention".into()], false));
    let flipped = pilot.edited(&linear, "flipped", |_, [x, y, e1, e2]| [x, y, -e1, e2]);
    assert_eq!(pilot.check(&flipped), (vec!["convention".into()], false));
    let transposed = pilot.edited(&linear, "transposed", |_, [x, y, e1, e2]| [y, x, e1, e2]);
    assert_eq!(pilot.check(&transposed), (vec!["convention".into()], false));
    let distortion = pilot.edited(&linear, "distortion", |_, [x, y, e1, e2]| {
        let factor = 2.0 / (1.0 + e1 * e1 + e2 * e2);
        [x, y, factor * e1, factor * e2]
    });
    let (found, accepted) = pilot.check(&distortion);
    assert!(accepted && found.contains(&"type".to_owned()), "{found:?}");
    let missing = pilot.edited(&linear, "missing", |k, [x, y, e1, e2]| match k < 30 {
        true => [24.5, 24.5, e1, e2],
        false => [x, y, e1, e2],
    });
    let (found, accepted) = pilot.check(&missing);
    let expected = ["duplicates", "missing"].map(str::to_owned);
    assert!(
        !accepted && expected.iter().all(|name| found.contains(name)),
        "{found:?}"
    );
    let short = pilot.edited(&linear, "short", |_, row| row);
    fs::remove_file(short.join("g10_v1_objs_2_3.48-linear-star.dat")).unwrap();
    for image in 1..=8 {
        fs::remove_file(short.join(format!("g10_v1_objs_8_{image}.48-linear-star.dat"))).unwrap();
    }
    assert_eq!(
        pilot.check(&short),
        (vec!["images".into(), "sets".into()], false)
    );
    let description = pilot.at("public/challenge.toml");
    let alone = pilot.at("challenge.toml");
    fs::copy(description, &alone).unwrap();
    let output = shearq(&[
        "challenge",
        "check",
        text(&linear),
        "--challenge",
        text(&alone),
    ]);
    assert!(output.status.success());
    assert!(String::from_utf8_lossy(&output.stderr).contains("shapes were not compared"));
}

/// The seed below a million with which `simulate` makes the PSF of set 2, tried as it is and as a challenge derives it.
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
    (0..1_000_000).find(|&seed| agrees(seed) || agrees(seed_of(NAME, 1, seed)))
}

#[test]
fn no_small_seed_regenerates_the_public_files() {
    let root = tempfile::tempdir().unwrap();
    let data = root.path().join("data");
    let simulate = [
        "simulate", "--sets", "2", "--images", "1", "--grid", "8", "--seed", "4321",
    ];
    succeed(&[&simulate[..], &["--out", text(&data)]].concat());
    assert_eq!(guessed(&data), Some(4321));
    let new = |place: &str, more: &[&str]| {
        let (public, private) = (
            root.path().join(place),
            root.path().join(format!("{place}-truth")),
        );
        let new = [
            "challenge",
            "new",
            "--name",
            NAME,
            "--sets",
            "2",
            "--images",
            "8",
            "--grid",
            "20",
            "--amplitude",
            "30",
        ];
        let folders = ["--public", text(&public), "--private", text(&private)];
        let output = shearq(&[&new[..], &folders, more].concat());
        assert!(output.status.success());
        (public, String::from_utf8(output.stderr).unwrap())
    };
    let (weak, warned) = new("weak", &["--seed", "77"]);
    assert_eq!(guessed(&weak), Some(77));
    assert!(
        warned.contains("participants can find the seed by trying"),
        "{warned}"
    );
    let (strong, warned) = new("strong", &[]);
    assert_eq!(guessed(&strong), None);
    assert!(!warned.contains("warning"), "{warned}");
    // Two challenges without a seed, and two with one seed and other names, have different noise.
    let (other, _) = new("other", &[]);
    let named = [
        "challenge",
        "new",
        "--name",
        "second",
        "--sets",
        "2",
        "--images",
        "8",
        "--grid",
        "20",
        "--amplitude",
        "30",
        "--seed",
        "77",
    ];
    let (second, truth) = (root.path().join("second"), root.path().join("second-truth"));
    let output = shearq(
        &[
            &named[..],
            &["--public", text(&second), "--private", text(&truth)],
        ]
        .concat(),
    );
    assert!(output.status.success());
    let image = |folder: &Path| fs::read(folder.join("set02/galaxies-001.fits")).unwrap();
    assert_ne!(image(&strong), image(&other));
    assert_ne!(image(&weak), image(&second));
}

#[test]
fn images_of_another_simulator_make_a_challenge() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let data = at("data");
    let simulate = [
        "simulate", "--sets", "2,8", "--images", "4", "--grid", "12", "--seed", "4321",
    ];
    succeed(&[&simulate[..], &["--amplitude", "100", "--out", text(&data)]].concat());
    fs::create_dir(at("tables")).unwrap();
    for set in [2, 8] {
        let truth = data.join(format!("set0{set}/truth.csv"));
        fs::rename(truth, at(&format!("tables/shear-{set}.csv"))).unwrap();
    }
    let (public, private, table) = (at("public"), at("private"), at("tables/shear-{set}.csv"));
    let new = [
        "challenge",
        "new",
        "--name",
        "theirs",
        "--data",
        text(&data),
        "--truth-table",
        text(&table),
        "--public",
        text(&public),
        "--private",
        text(&private),
    ];
    succeed(&new);
    for (name, content) in contents(&public) {
        let seed = content
            .windows(4)
            .any(|part| part == b"SEED" || part == b"4321");
        assert!(!seed, "{name}");
    }
    let out = at("out");
    let archive = at("entry.tar.gz");
    let measure = [
        "measure",
        "--submission",
        "48/linear/star",
        "--data",
        text(&public),
    ];
    succeed(&[&measure[..], &["--out", text(&out)]].concat());
    let pack = [
        "pack",
        "--measured",
        text(&out),
        "--challenge",
        "theirs",
        "--team",
        "T",
    ];
    succeed(&[&pack[..], &["--out", text(&archive)]].concat());
    let store = at("store");
    let rank = [
        "challenge",
        "rank",
        text(&archive),
        "--challenge",
        text(&public),
        "--truth",
        text(&private),
    ];
    let ranked = succeed(&[&rank[..], &["--store", text(&store), "--format", "csv"]].concat());
    assert!(
        ranked
            .lines()
            .nth(1)
            .unwrap()
            .starts_with("1,T,48-linear-star,,catalogues,"),
        "{ranked}"
    );
    // A changed description and another private folder are refused.
    let refused = |expected: &str| {
        let message = fail(&[&rank[..], &["--store", text(&store)]].concat());
        assert!(message.contains(expected), "{message}");
    };
    let path = public.join("challenge.toml");
    let description = fs::read_to_string(&path).unwrap();
    fs::write(&path, description.replace("images = 4", "images = 1")).unwrap();
    refused("challenge.toml: the file was changed");
    fs::write(&path, description).unwrap();
    fs::write(public.join("SHA256SUMS"), "").unwrap();
    refused("the public folder does not belong to");
    assert!(fail(&new).contains("this is a complete challenge; expected a new folder"));
}

#[test]
fn submissions_are_compared_and_recorded_like_folders() {
    let pilot = Pilot::new(&[]);
    let linear = pilot.enter(
        "48/linear/star",
        "linear",
        "linear.tar.gz",
        &["--team", "L"],
    );
    pilot.enter("23/den/star", "den", "den.tar.gz", &["--team", "D"]);
    let (truth, den, store) = (
        pilot.at("private"),
        pilot.at("den.tar.gz"),
        pilot.at("store"),
    );
    let compare = ["compare", "--data", text(&truth), "--format", "json"];
    let packed = succeed(&[&compare[..], &[text(&linear), text(&den)]].concat());
    let q = |text: &str| -> HashMap<String, f64> {
        let table: Value = serde_json::from_str(text).unwrap();
        let row = |row: &Value| {
            let name = row["submission"].as_str().unwrap().to_owned();
            (name, row["q"].as_f64().unwrap())
        };
        table["rows"].as_array().unwrap().iter().map(row).collect()
    };
    let found = q(&packed);
    assert_eq!(found.len(), 2, "{packed}");
    let spectra = pilot.at("spectra.tar.gz");
    let pack = [
        "pack",
        "--kind",
        "cross-spectra",
        "--method",
        "S",
        "--out",
        text(&spectra),
    ];
    succeed(&[&pack[..], &["--measured", text(&pilot.at("linear"))]].concat());
    for path in [&linear, &spectra] {
        let score = ["score", "--data", text(&truth), "--packed", text(path)];
        succeed(&[&score[..], &["--store", text(&store)]].concat());
    }
    let stored = q(&succeed(&[
        "compare",
        "--store",
        text(&store),
        "--format",
        "json",
    ]));
    assert!((stored["48-linear-star"] / found["48-linear-star"] - 1.0).abs() < 1e-12);
    assert!(stored["S"] > 0.0);
    let message = fail(&["compare", text(&linear), text(&den)]);
    assert!(
        message.contains("a submission needs the true shear. Try: --data DIR"),
        "{message}"
    );
    let message = fail(&[&compare[..], &[text(&spectra)]].concat());
    assert!(
        message.contains("this submission contains power spectra; expected catalogues"),
        "{message}"
    );
}

/// Entries without images, or with shapes in some images only, against an honest one.
#[test]
fn entries_without_images_have_no_rank() {
    let pilot = Pilot::new(&[]);
    let honest = pilot.enter("48/linear/star", "h", "in/honest.tar.gz", &["--team", "H"]);
    let calls = std::cell::Cell::new(0.0);
    let random = || {
        calls.set(calls.get() + 12.9898);
        (f64::sin(calls.get()) * 43758.5453).fract()
    };
    let noise = |_: usize, [x, y, ..]: [f64; 4]| [x, y, 1e-6 * random(), 1e-6 * random()];
    let shrunk =
        |factor: f64| move |_: usize, [x, y, e1, e2]: [f64; 4]| [x, y, factor * e1, factor * e2];
    pilot.edited(&honest, "in/zero", |_, [x, y, ..]| [x, y, 0.0, 0.0]);
    pilot.edited(&honest, "in/noise", noise);
    // Shapes in image 1 and noise in the others; the same with shapes that are there, but tiny.
    let first = |folder: PathBuf| {
        for set in [2, 8] {
            let name = format!("g10_v1_objs_{set}_1.48-linear-star.dat");
            fs::copy(pilot.at("whole").join(&name), folder.join(&name)).unwrap();
        }
        folder
    };
    pilot.edited(&honest, "whole", |_, row| row);
    let one_image = first(pilot.edited(&honest, "in/first", noise));
    let tiny = first(pilot.edited(&honest, "in/tiny", shrunk(1e-6)));
    // Shrinking all shapes changes nothing.
    pilot.edited(&honest, "in/shrunk", shrunk(0.1));
    fs::create_dir(pilot.at("in/spectra")).unwrap();
    for set in [2, 8] {
        let lines: String = (2..10)
            .map(|bin| format!("{bin} {} 0\n", 100 * bin))
            .collect();
        fs::write(pilot.at(&format!("in/spectra/Z_set{set}.dat")), lines).unwrap();
    }
    let (found, accepted) = pilot.check(&one_image);
    assert!(
        !accepted && found.contains(&"shapes".to_owned()),
        "{found:?}"
    );
    let (found, accepted) = pilot.check(&tiny);
    assert!(!accepted && found == ["shapes"], "{found:?}");
    let (board, said) = pilot.rank("in", "store", &[]);
    for expected in [
        "noise: not scored: g10_v1_objs_2_1.48-linear-star.dat: the shapes do not agree with the image; were the rows or images exchanged?; also image 2-8",
        "first: not scored: g10_v1_objs_2_2.48-linear-star.dat: the shapes do not agree with the image; were the rows or images exchanged?; also image 3-8",
        "tiny: not scored: ",
        "zero: not scored: ",
        "spectra: not scored: the challenge does not accept power spectra (expected catalogues)",
    ] {
        assert!(said.contains(expected), "{expected}\n{said}");
    }
    let rows = board["rows"].as_array().unwrap();
    let of = |team: &str| rows.iter().find(|row| row["team"] == team).unwrap();
    assert_eq!(of("shrunk")["q_calibrated"], of("H")["q_calibrated"]);
    assert_eq!(
        (of("shrunk")["rank"].as_u64(), of("H")["rank"].as_u64()),
        (Some(1), Some(1))
    );
    assert!(of("zero shear")["rank"].is_null() && of("zero shear")["q_calibrated"].is_null());
    assert_eq!(rows.len(), 3, "{board}");
    let notes = board["notes"].to_string();
    assert!(
        notes.contains("Zero shear has Q = ") && notes.contains("It has no Q cal."),
        "{notes}"
    );
}

#[test]
fn challenges_that_cannot_be_ranked_are_refused() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let new = |more: &[&str]| {
        for folder in ["p", "t"] {
            let _ = fs::remove_dir_all(at(folder));
        }
        let (public, private) = (at("p"), at("t"));
        let new = ["challenge", "new", "--name", "c", "--public", text(&public)];
        shearq(&[&new[..], &["--private", text(&private)], more].concat())
    };
    let refused = |more: &[&str], expected: &str| {
        let output = new(more);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(
            output.status.code() == Some(1) && said.contains(expected),
            "{expected}\n{said}"
        );
        assert!(!at("p/challenge.toml").exists());
    };
    let small = [
        "--sets",
        "2,8",
        "--images",
        "8",
        "--grid",
        "16",
        "--seed",
        "9876543210123456789",
    ];
    let with = |more: &[&'static str]| [&small[..], more].concat();
    refused(
        &small,
        "the data are too small to rank entries by Q cal.: the response of set 2 is expected to be ",
    );
    refused(
        &with(&["--amplitude", "0"]),
        "--amplitude 0: without shear, entries cannot be ranked",
    );
    let dates = ["--opens", "2030-02-01", "--closes", "2030-01-31"];
    refused(
        &with(&dates),
        "--closes: the last day is before the first one (found 2030-01-31 (UTC), expected 2030-02-01 (UTC) or later)",
    );
    refused(
        &with(&["--spectra"]),
        "--spectra: Q cal. is not defined for power spectra. Try: --metric q or q-corrected",
    );
    refused(
        &with(&["--metric", "qc", "--amplitude", "30"]),
        "the true shear varies within the sets, so Q_c is not defined. Try: ",
    );
    // One constant shear, and shears that differ between the sets.
    let simulate = |set: &str, shear: &str, seed: &str| {
        let data = at("d");
        let simulate = [
            "simulate", "--sets", set, "--images", "2", "--grid", "20", "--seed", seed,
        ];
        succeed(
            &[
                &simulate[..],
                &["--constant-shear", shear, "--out", text(&at(set))],
            ]
            .concat(),
        );
        fs::create_dir_all(&data).unwrap();
        let name = format!("set0{set}");
        fs::rename(at(set).join(&name), data.join(&name)).unwrap();
    };
    simulate("1", "0.05,-0.05", "1");
    let data = at("d");
    let theirs = ["--data", text(&data)];
    refused(
        &theirs,
        "constant shears need at least 3 sets with different g1 to separate m from c (found 1)",
    );
    simulate("2", "-0.05,0.05", "2");
    simulate("3", "0.02,0.02", "3");
    for metric in ["q", "q-calibrated", "noise"] {
        let wrong = [&theirs[..], &["--metric", metric]].concat();
        refused(
            &wrong,
            "the true shear is the same for all galaxies of a set, so ",
        );
    }
    let output = new(&theirs);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    assert!(
        said.contains("warning: a team can tune Q_c to the truth with 5 entries"),
        "{said}"
    );
    let (public, private, out, store) = (at("p"), at("t"), at("o"), at("s"));
    assert!(
        fs::read_to_string(public.join("challenge.toml"))
            .unwrap()
            .contains("metric = \"qc\"")
    );
    let measure = [
        "measure",
        "--submission",
        "48/linear/star",
        "--data",
        text(&public),
    ];
    succeed(&[&measure[..], &["--out", text(&out)]].concat());
    let archive = at("in/A.tar.gz");
    fs::create_dir(at("in")).unwrap();
    let pack = [
        "pack",
        "--measured",
        text(&out),
        "--challenge",
        "c",
        "--team",
        "A",
    ];
    succeed(&[&pack[..], &["--out", text(&archive)]].concat());
    let rank = [
        "challenge",
        "rank",
        text(&archive),
        "--challenge",
        text(&public),
        "--truth",
        text(&private),
    ];
    let board = succeed(&[&rank[..], &["--store", text(&store), "--format", "csv"]].concat());
    let lines: Vec<&str> = board.lines().collect();
    assert!(
        lines[1].starts_with("1,A,48-linear-star,") && lines[2].contains("zero shear"),
        "{board}"
    );
    // Zero shear has m = −1: 2464/√(2·500² + 4).
    assert!(lines[2].contains(",3.5,"), "{board}");
}

/// Copies a folder of files.
fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for (name, content) in contents(from) {
        fs::write(to.join(name), content).unwrap();
    }
}

#[test]
fn changed_truth_images_stores_and_links_are_refused() {
    let pilot = Pilot::new(&[]);
    let (public, private) = (pilot.at("public"), pilot.at("private"));
    let linear = pilot.enter("48/linear/star", "linear", "in/a.tar.gz", &["--team", "A"]);
    pilot.rank("in", "store", &[]);
    let inbox = pilot.at("in");
    let refused = |private: &Path, public: &Path, store: &str, expected: &str| {
        let rank = [
            "challenge",
            "rank",
            text(&inbox),
            "--challenge",
            text(public),
        ];
        let store = pilot.at(store);
        let folders = ["--truth", text(private), "--store", text(&store)];
        let message = fail(&[&rank[..], &folders].concat());
        assert!(message.contains(expected), "{message}");
    };
    #[cfg(unix)]
    {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let mode = |path: &Path| path.metadata().unwrap().permissions().mode() & 0o777;
        assert_eq!(
            (mode(&private), mode(&private.join("set02"))),
            (0o700, 0o700)
        );
        for (name, _) in contents(&private) {
            assert_eq!(mode(&private.join(&name)), 0o600, "{name}");
        }
        // Links could name the truth.
        let links = pilot.at("links/B");
        let folder = pilot.edited(&linear, "whole", |_, row| row);
        copied(&folder, &links);
        let file = links.join("g10_v1_objs_2_1.48-linear-star.dat");
        fs::remove_file(&file).unwrap();
        symlink(private.join("set02/truth.csv"), &file).unwrap();
        symlink(&linear, pilot.at("links/c.tar.gz")).unwrap();
        symlink(&private, pilot.at("links/D")).unwrap();
        let (_, said) = pilot.rank("links", "other", &[]);
        assert_eq!(said.matches("this is a link").count(), 3, "{said}");
        let check = ["challenge", "check", text(&links), "--challenge"];
        let message = fail(&[&check[..], &[text(&public)]].concat());
        assert!(message.contains("g10_v1_objs_2_1.48-linear-star.dat: this is a link"));
    }
    // Any private file, and its checksum in the key.
    for name in ["set02/truth.csv", "simulation.json", "layout.toml"] {
        let (path, key) = (private.join(name), private.join("key.toml"));
        let (content, sealed) = (fs::read(&path).unwrap(), fs::read_to_string(&key).unwrap());
        let changed = [&content[..], b"\n"].concat();
        fs::write(&path, &changed).unwrap();
        refused(
            &private,
            &public,
            "store",
            &format!("{name}: the file was changed"),
        );
        let forged = sealed.replace(&sha256(&content), &sha256(&changed));
        assert_ne!(forged, sealed);
        fs::write(&key, forged).unwrap();
        refused(
            &private,
            &public,
            "store",
            "key.toml: the checksums are not those",
        );
        fs::write(&key, sealed).unwrap();
        fs::write(&path, content).unwrap();
    }
    // A public image.
    let image = public.join("set02/galaxies-001.fits");
    let content = fs::read(&image).unwrap();
    let mut changed = content.clone();
    changed[20_000..40_000].fill(0);
    fs::write(&image, changed).unwrap();
    let expected = "galaxies-001.fits: the file was changed (found SHA-256 ";
    refused(&private, &public, "new", expected);
    let check = [
        "challenge",
        "check",
        text(&linear),
        "--challenge",
        text(&public),
    ];
    assert!(fail(&check).contains(expected));
    fs::write(&image, content).unwrap();
    // A second release with the store of the first.
    let second = Pilot::new(&["--data-version", "2"]);
    refused(
        &second.at("private"),
        &second.at("public"),
        "store",
        ".parquet: the entry was scored with another truth or other data of `pilot`",
    );
}

/// Writes a receipt and returns the SHA-256 of the entry.
fn signed(key: &Key, entry: &Path, team: &str, time: &str) -> String {
    let id = match entry.is_dir() {
        true => {
            let listed: String = contents(entry)
                .iter()
                .map(|(name, content)| format!("{name} {}\n", sha256(content)))
                .collect();
            sha256(listed.as_bytes())
        }
        false => sha256(&fs::read(entry).unwrap()),
    };
    let receipt = Receipt::sign(key, team, time.parse().unwrap(), &id);
    receipt.write(entry).unwrap();
    id
}

/// Content that came early, to another challenge, or was withdrawn, blocks no team that sends it as well.
#[test]
fn entries_that_do_not_count_block_no_others() {
    let pilot = Pilot::new(&["--opens", "2020-06-01"]);
    let private = pilot.at("private");
    let linear = pilot.enter("48/linear/star", "linear", "a.tar.gz", &["--team", "A"]);
    let key = Key::read(&private).unwrap().unwrap();
    let other = pilot.at("in/Wrong/x.tar.gz");
    fs::create_dir_all(other.parent().unwrap()).unwrap();
    let pack = ["pack", "--challenge", "another", "--team", "Wrong", "--out"];
    let measured = pilot.at("linear");
    succeed(&[&pack[..], &[text(&other), "--measured", text(&measured)]].concat());
    signed(&key, &other, "Wrong", "2020-06-01T10:00:00Z");
    let mut id = String::new();
    for (team, time) in [
        ("Early", "2020-05-31T10:00:00Z"),
        ("Owner", "2020-06-02T10:00:00Z"),
        ("Second", "2020-06-03T10:00:00Z"),
    ] {
        let folder = pilot.at(&format!("in/{team}"));
        succeed(&["unpack", text(&linear), "--out", text(&folder)]);
        fs::remove_file(folder.join("manifest.json")).unwrap();
        id = signed(&key, &folder, team, time);
    }
    fs::create_dir(pilot.at("in/Misnamed")).unwrap();
    fs::write(pilot.at("in/Misnamed/set2.dat"), "24.5 24.5 0 0\n").unwrap();
    let (board, said) = pilot.rank("in", "store", &[]);
    assert!(teams(&board).contains(&(1, "Owner".into())), "{board}");
    for expected in [
        "x.tar.gz: not scored: the entry belongs to another challenge",
        "Misnamed: not scored: ",
        "the entry of Early of 2020-05-31T10:00:00Z does not count: received before",
        "the entry of Second of 2020-06-03T10:00:00Z does not count: identical content as the entry of Owner of 2020-06-02T10:00:00Z",
        "entries: 3 scored, 0 scored earlier, 2 not scored",
    ] {
        assert!(said.contains(expected), "{expected}\n{said}");
    }
    let withdrawn = format!("[withdrawn]\n\"{}/Owner\" = \"a mistake\"\n", &id[..8]);
    fs::write(private.join("board.toml"), withdrawn).unwrap();
    // The early entry comes again, after the first day.
    signed(&key, &pilot.at("in/Early"), "Early", "2020-06-04T10:00:00Z");
    let (board, said) = pilot.rank("in", "store", &[]);
    assert!(teams(&board).contains(&(1, "Second".into())), "{board}");
    for expected in [
        "the entry of Owner of 2020-06-02T10:00:00Z does not count: withdrawn: a mistake",
        "the entry of Early of 2020-06-04T10:00:00Z does not count: identical content as the entry of Second",
        "entries: 1 scored, 2 scored earlier, 2 not scored",
    ] {
        assert!(said.contains(expected), "{expected}\n{said}");
    }
}

#[test]
fn true_shears_that_the_images_contradict_are_not_sealed() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let data = at("data");
    let simulate = [
        "simulate", "--sets", "2,8", "--images", "2", "--grid", "48", "--seed", "4321",
    ];
    succeed(&[&simulate[..], &["--amplitude", "80", "--out", text(&data)]].concat());
    fs::create_dir(at("tables")).unwrap();
    let (public, private, table) = (at("public"), at("private"), at("tables/shear-{set}.csv"));
    let new = |from: [u32; 2], edit: fn([f64; 2]) -> [f64; 2]| {
        for (set, from) in [2, 8].into_iter().zip(from) {
            let truth = fs::read_to_string(data.join(format!("set0{from}/truth.csv"))).unwrap();
            let edited: Vec<String> = truth
                .lines()
                .map(|line| {
                    let numbers: Result<Vec<f64>, _> = line.split(',').map(str::parse).collect();
                    match numbers.as_deref() {
                        Ok([x, y, g1, g2]) => {
                            let [g1, g2] = edit([*g1, *g2]);
                            format!("{x},{y},{g1},{g2}")
                        }
                        _ => line.to_owned(),
                    }
                })
                .collect();
            fs::write(at(&format!("tables/shear-{set}.csv")), edited.join("\n")).unwrap();
        }
        let new = [
            "challenge",
            "new",
            "--name",
            "theirs",
            "--data",
            text(&data),
        ];
        let folders = ["--public", text(&public), "--private", text(&private)];
        shearq(&[&new[..], &["--truth-table", text(&table)], &folders].concat())
    };
    let refused = |from: [u32; 2], edit: fn([f64; 2]) -> [f64; 2], expected: &[&str]| {
        let output = new(from, edit);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{expected:?} {said}");
        for expected in expected {
            assert!(said.contains(expected), "{expected}\n{said}");
        }
        assert!(!public.join("challenge.toml").exists() && !public.join("SHA256SUMS").exists());
    };
    let all = "all sets: the images contradict the true shear (found a slope of ";
    refused(
        [2, 8],
        |[a, b]| [a, -b],
        &[all, "the sign of g2 may be wrong"],
    );
    refused(
        [2, 8],
        |[a, b]| [-a, b],
        &[all, "the sign of g1 may be wrong"],
    );
    refused(
        [2, 8],
        |[a, b]| [b, a],
        &[all, "the order of g1 and g2 may be wrong"],
    );
    refused(
        [2, 8],
        |[a, b]| [2.0 * a, 2.0 * b],
        &[all, " times too large"],
    );
    refused(
        [2, 8],
        |[a, b]| [0.5 * a, 0.5 * b],
        &[all, " times too large"],
    );
    refused([8, 2], |g| g, &[all, "the true shear of set "]);
    refused(
        [2, 2],
        |g| g,
        &["set 8: the images contradict the true shear"],
    );
    // The same command with the right truth continues.
    let output = new([2, 8], |g| g);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    let terms = fs::read_to_string(public.join("challenge.toml")).unwrap();
    assert!(terms.contains("entries_per_team = 10"), "{terms}");
    let readme = fs::read_to_string(public.join("README.md")).unwrap();
    assert!(readme.contains("at most 10 entries"), "{readme}");
}

#[test]
fn receipts_copies_and_decisions_shape_the_board() {
    let pilot = Pilot::new(&["--closes", "2020-06-30T18:00:00+02:00", "--partial"]);
    let (public, private) = (pilot.at("public"), pilot.at("private"));
    let linear = pilot.enter("48/linear/star", "linear", "a.tar.gz", &["--team", "First"]);
    let first = pilot.edited(&linear, "in/First", |_, row| row);
    // One digit of one file, and noise below a millionth in all files.
    let digit = pilot.at("in/Digit");
    copied(&first, &digit);
    let file = digit.join("g10_v1_objs_2_1.48-linear-star.dat");
    let content = fs::read_to_string(&file).unwrap();
    fs::write(&file, content.replacen('\n', "1\n", 1)).unwrap();
    let noisy = pilot.edited(&linear, "in/Noise", |k, [x, y, e1, e2]| {
        let noise = 1e-6 * (k as f64 * 12.9898).sin();
        [x, y, e1 + noise, e2 - noise]
    });
    let other = pilot.enter("23/den/star", "den", "b.tar.gz", &["--team", "Other"]);
    let half = pilot.edited(&other, "in/Half", |_, row| row);
    for image in 1..=8 {
        fs::remove_file(half.join(format!("g10_v1_objs_8_{image}.23-den-star.dat"))).unwrap();
    }
    let (found, accepted) = pilot.check(&half);
    assert!(accepted && found.contains(&"sets".into()), "{found:?}");
    // Receipts of the past make entries arrive in time; without one, entries arrive when they are ranked, and are late.
    let key = Key::read(&private).unwrap().unwrap();
    let sign = |folder: &Path, time: &str| {
        let team = text(folder).rsplit('/').next().unwrap();
        signed(&key, folder, team, time)
    };
    sign(&first, "2020-06-30T15:59:58Z");
    sign(&digit, "2020-06-30T16:00:00Z");
    let withdrawn = sign(&noisy, "2020-06-30T15:59:59Z");
    let (board, said) = pilot.rank("in", "store", &[]);
    assert_eq!(
        teams(&board)[..3].iter().filter(|team| team.0 == 1).count(),
        3,
        "{board}"
    );
    let rows = board["rows"].as_array().unwrap();
    let half_row = rows.iter().find(|row| row["team"] == "Half").unwrap();
    assert_eq!(
        (&half_row["team"], &half_row["board"]),
        (&"Half".into(), &"1 of 2 sets".into())
    );
    assert!(half_row["rank"].is_null(), "{half_row}");
    for column in ["q_calibrated", "m", "c"] {
        assert!(board["rows"][0][column].is_number(), "{column} {board}");
    }
    for expected in [
        "warning: Noise of Noise is a near copy of First of First: 0 of 16 files",
        "warning: Digit of Digit is a near copy of First of First: 15 of 16 files",
    ] {
        assert!(said.contains(expected), "{said}");
    }
    assert_eq!(said.matches("near copy").count(), 2, "{said}");
    // The team of the folder, and a receipt that was changed.
    let receipt = Receipt::path(&digit);
    let signed = fs::read_to_string(&receipt).unwrap();
    for (from, to, expected) in [
        ("16:00:00", "15:00:00", "was not signed with the key"),
        ("\"Digit\"", "\"First\"", "was not signed with the key"),
        ("sha256 = \"", "sha256 = \"0", "belongs to other content"),
    ] {
        fs::write(&receipt, signed.replace(from, to)).unwrap();
        let (_, said) = pilot.rank("in", "store", &[]);
        assert!(said.contains(expected), "{said}");
    }
    // `check` signs the present, once, which is after the deadline.
    let check = [
        "challenge",
        "check",
        text(&other),
        "--challenge",
        text(&public),
    ];
    let sign = [&check[..], &["--truth", text(&private)]].concat();
    succeed(&sign);
    let receipt = fs::read(Receipt::path(&other)).unwrap();
    succeed(&sign);
    assert_eq!(fs::read(Receipt::path(&other)).unwrap(), receipt);
    fs::create_dir(pilot.at("late")).unwrap();
    fs::rename(&other, pilot.at("late/b.tar.gz")).unwrap();
    fs::write(Receipt::path(&pilot.at("late/b.tar.gz")), receipt).unwrap();
    let decisions = format!(
        "anonymous = true\n[aliases]\nOther = \"Anon\"\n[withdrawn]\n{} = \"by mistake\"\n",
        &withdrawn[..8]
    );
    fs::write(private.join("board.toml"), &decisions).unwrap();
    let page = pilot.at("board.html");
    let (board, said) = pilot.rank("late", "store", &["--report", text(&page)]);
    let late = board["rows"]
        .as_array()
        .unwrap()
        .iter()
        .find(|row| row["board"] == "late");
    assert_eq!(
        (&late.unwrap()["team"], &late.unwrap()["rank"]),
        (&"Anon".into(), &1.into())
    );
    assert!(
        said.contains("does not count: withdrawn: by mistake"),
        "{said}"
    );
    let html = fs::read_to_string(&page).unwrap();
    for secret in [">First", ">Digit", ">Noise", "48-linear-star"] {
        assert!(!html.contains(secret), "{secret}");
    }
    for expected in [
        "Late entries",
        "Near copies",
        "Rules",
        "2020-06-30T16:00:00Z",
    ] {
        assert!(html.contains(expected), "{expected}");
    }
    for (wrong, expected) in [
        (
            decisions.replace("Other", "Nobody"),
            "`aliases` has an unknown team (found `Nobody`",
        ),
        (
            decisions.replace(&withdrawn[..8], "0000"),
            "`withdrawn` names no single entry (found `0000`",
        ),
        (
            decisions.replace("anonymous", "secret"),
            "unknown field `secret`",
        ),
    ] {
        fs::write(private.join("board.toml"), wrong).unwrap();
        let rank = ["challenge", "rank", "--challenge", text(&public), "--truth"];
        let store = pilot.at("store");
        let folders = [text(&private), "--store", text(&store)];
        let message = fail(&[&rank[..], &folders].concat());
        assert!(message.contains(expected), "{message}");
    }
}
