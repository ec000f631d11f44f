//! A challenge from its data to its leaderboard, and attempts to obtain the truth.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use flate2::Compression;
use flate2::write::GzEncoder;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;
use shearq_challenge::create::seed_of;
use shearq_challenge::seal::{Key, Receipt, sha256};

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

/// Copies a folder of files.
fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for (name, content) in contents(from) {
        fs::write(to.join(name), content).unwrap();
    }
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
