//! Catalogues with probable faults: `score`, `compare` and `check` name them; options that do not apply are refused.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{Small, fail, shearq, succeed, text};

/// Cells a side of the grid.
const SIDE: usize = 32;
/// Images of the set.
const IMAGES: usize = 4;

/// Places of a catalogue's values: the cell, and the image.
type Values<'a> = &'a dyn Fn(usize, usize) -> (f64, f64);

/// A shear of E-mode waves with power on several scales.
fn shear(cell: usize) -> (f64, f64) {
    let (x, y) = ((cell % SIDE) as f64, (cell / SIDE) as f64);
    let waves = [(1, 2), (3, -1), (-2, 5), (6, 3), (4, -7), (8, 1)];
    let mut g = (0.0, 0.0);
    for (k, (kx, ky)) in waves.into_iter().enumerate() {
        let (kx, ky) = (f64::from(kx), f64::from(ky));
        let phase = std::f64::consts::TAU * (kx * x + ky * y) / SIDE as f64 + k as f64;
        let norm = 0.02 / (kx * kx + ky * ky);
        g.0 += norm * (kx * kx - ky * ky) * phase.cos();
        g.1 += norm * 2.0 * kx * ky * phase.cos();
    }
    g
}

/// Noise of rms 0.01 per component that depends on the cell, the image and the component alone.
fn noise(cell: usize, image: usize, component: u64) -> f64 {
    let mut state = (cell as u64) << 20 | (image as u64) << 4 | component;
    state = state
        .wrapping_mul(0x9e37_79b9_7f4a_7c15)
        .wrapping_add(0x1234_5678_9abc_def1);
    state = (state ^ (state >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    state = (state ^ (state >> 32)).wrapping_mul(0x94d0_49bb_1331_11eb);
    let uniform = (state >> 11) as f64 / (1_u64 << 53) as f64;
    (uniform - 0.5) * 0.01 * 12.0_f64.sqrt()
}

/// A sound measurement.
fn sound(cell: usize, image: usize) -> (f64, f64) {
    let (g1, g2) = shear(cell);
    (g1 + noise(cell, image, 0), g2 + noise(cell, image, 1))
}

/// A data folder with the truth of set 2, and folders of catalogues beside it.
struct Case {
    root: tempfile::TempDir,
}

impl Case {
    fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir_all(root.path().join("data/set02")).unwrap();
        let case = Case { root };
        case.truth("data/set02/truth.csv", "", &shear);
        case
    }

    fn at(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    fn rows(value: &dyn Fn(usize) -> (f64, f64), separator: &str) -> String {
        let row = |cell: usize| {
            let at = |k: usize| 24.5 + 48.0 * k as f64;
            let (a, b) = value(cell);
            let fields = [at(cell % SIDE), at(cell / SIDE), a, b].map(|v| v.to_string());
            fields.join(separator) + "\n"
        };
        (0..SIDE * SIDE).map(row).collect()
    }

    /// Writes a truth file with a comment after its header.
    fn truth(&self, name: &str, comment: &str, value: &dyn Fn(usize) -> (f64, f64)) -> PathBuf {
        let content = format!("x,y,g1,g2\n{comment}{}", Case::rows(value, ","));
        fs::write(self.at(name), content).unwrap();
        self.at(name)
    }

    /// Writes catalogues in the challenge's names.
    fn catalogues(&self, name: &str, value: Values<'_>) -> Vec<PathBuf> {
        fs::create_dir_all(self.at(name)).unwrap();
        let write = |image: usize| {
            let path = self
                .at(name)
                .join(format!("g10_v1_objs_2_{}.M.dat", image + 1));
            fs::write(&path, Case::rows(&|cell| value(cell, image), " ")).unwrap();
            path
        };
        (0..IMAGES).map(write).collect()
    }

    /// What `score` prints of catalogues against a truth, on one line.
    fn score(&self, truth: &Path, catalogues: &[PathBuf], more: &[&str]) -> String {
        let mut arguments = vec!["score", "--truth", text(truth)];
        arguments.extend(catalogues.iter().map(|path| text(path)));
        arguments.extend(more);
        one_line(&succeed(&arguments))
    }
}

/// A text without its line breaks.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn probable_faults_of_catalogues_are_named_by_score_compare_and_check() {
    let case = Case::new();
    let data = case.at("data");
    let truth = data.join("set02/truth.csv");
    let distortion = |cell, image| {
        let (e1, e2): (f64, f64) = sound(cell, image);
        let scale = 2.0 / (1.0 + e1 * e1 + e2 * e2);
        (scale * e1, scale * e2)
    };
    let last = SIDE * SIDE;
    let faults: [(&str, Values<'_>, &str, &str); 8] = [
        ("sound", &sound, "", ""),
        ("distortion", &distortion, "seem to be distortions", "type"),
        (
            "shifted",
            &|cell, image| sound((cell + last - 1) % last, image),
            "seem to be shifted by (+1, +0) cells",
            "order",
        ),
        (
            "swapped",
            &|cell, image| {
                let (e1, e2) = sound(cell, image);
                (e2, e1)
            },
            "e1 and e2 seem to be swapped",
            "convention",
        ),
        (
            "copies",
            &|cell, _| sound(cell, 0),
            "and 2 more likewise; expected an independent measurement",
            "copies",
        ),
        (
            "zero",
            &|_, _| (0.0, 0.0),
            "have the ellipticity (0, 0), and 3 more likewise",
            "constant",
        ),
        (
            "mixed",
            &|cell, image| sound((cell * 331 + 7) % last, image),
            "but their noise allows 0.9",
            "correlation",
        ),
        (
            "weak",
            &|cell, image| {
                let (e1, e2) = sound(cell, image);
                (0.5 * e1, 0.5 * e2)
            },
            "expected |m| below 0.1",
            "bias",
        ),
    ];
    for (name, value, words, check) in faults {
        let catalogues = case.catalogues(name, value);
        let printed = case.score(&truth, &catalogues, &[]);
        let toml = case.at(&format!("{name}.toml"));
        let pattern = format!("{name}/g10_v1_objs_{{set}}_{{image}}.M.dat");
        fs::write(
            &toml,
            format!("name = \"{name}\"\ncatalogues = \"{pattern}\"\nellipticity = \"shear\"\n"),
        )
        .unwrap();
        let compared = succeed(&["compare", "--data", text(&data), "--foreign", text(&toml)]);
        let compared = one_line(&compared);
        let checked = shearq(&["check", text(&case.at(name)), "--data", text(&data)]);
        let checked = String::from_utf8(checked.stdout).unwrap();
        if words.is_empty() {
            assert!(!printed.contains("warning"), "{printed}");
            assert!(!compared.contains("warning"), "{compared}");
            assert!(checked.ends_with("no findings\n"), "{checked}");
            continue;
        }
        for printed in [&printed, &compared] {
            let long = printed.replace(text(&case.at("")), "");
            assert!(
                long.contains("warning: ") && long.contains(words),
                "{name}: {long}"
            );
        }
        // One line per problem.
        let found = checked.matches(&format!("[{check}]")).count();
        assert_eq!(found, 1, "{name}: {checked}");
    }
    let given = case.catalogues("distortion", &distortion);
    let converted = case.score(&truth, &given, &["--ellipticity", "distortion"]);
    assert!(!converted.contains("warning"), "{converted}");
    assert!(converted.contains("The catalogues: m = "), "{converted}");
}

#[test]
fn the_sign_of_the_true_g2_is_stated_determined_or_asked_for() {
    let case = Case::new();
    let catalogues = case.catalogues("sound", &sound);
    let flipped = |cell| {
        let (g1, g2) = shear(cell);
        (g1, -g2)
    };
    let standard = "# g2sign: standard (g2 > 0 is a stretch along x = y)\n";
    let q = |printed: &str| printed.split("══ ").nth(1).unwrap()[..24].to_owned();
    let stated = case.truth("stated.csv", standard, &shear);
    let right = case.score(&stated, &catalogues, &[]);
    assert!(
        right.contains("truth: standard, as the file states"),
        "{right}"
    );
    let unstated = case.score(&case.truth("plain.csv", "", &shear), &catalogues, &[]);
    assert!(unstated.contains("truth: standard, in which"), "{unstated}");
    let challenge = case.score(&case.truth("challenge.csv", "", &flipped), &catalogues, &[]);
    assert!(
        challenge.contains("truth: challenge, in which"),
        "{challenge}"
    );
    assert_eq!((q(&unstated), q(&challenge)), (q(&right), q(&right)));
    let message = fail(&[
        "score",
        "--truth",
        text(&stated),
        "--truth-sign",
        "challenge",
        text(&catalogues[0]),
    ]);
    assert!(
        message.contains("the file states `g2sign: standard`"),
        "{message}"
    );
    // A field of E and B modes: the catalogues determine the sign, or nothing does.
    let both = |cell: usize| {
        let (g1, g2) = shear(cell);
        (g1 + 3.0 * noise(cell, 9, 0), g2 + 3.0 * noise(cell, 9, 1))
    };
    let mixed = case.truth("mixed.csv", "", &|cell| {
        (3.0 * noise(cell, 9, 0), 3.0 * noise(cell, 9, 1))
    });
    let measured = case.catalogues("both", &|cell, _| both(cell));
    let determined = case.score(&mixed, &measured[..1], &[]);
    assert!(
        determined.contains("truth: standard, which e2 of the catalogues follows"),
        "{determined}"
    );
    let other = case.catalogues("other", &|cell, _| (noise(cell, 1, 0), noise(cell, 1, 1)));
    let unknown = fail(&["score", "--truth", text(&mixed), text(&other[0])]);
    assert!(
        unknown.contains("cannot determine the sign of g2"),
        "{unknown}"
    );
    assert!(unknown.contains("Try: --truth-sign standard"), "{unknown}");
}

#[test]
fn true_shears_that_are_too_strong_are_refused_or_doubted() {
    let case = Case::new();
    let catalogues = case.catalogues("sound", &sound);
    let scaled = |factor: f64| {
        move |cell| {
            let (g1, g2) = shear(cell);
            (factor * g1, factor * g2)
        }
    };
    let percent = case.truth("percent.csv", "", &scaled(100.0));
    let message = fail(&["score", "--truth", text(&percent), text(&catalogues[0])]);
    assert!(
        message.contains("percent.csv: the true shear of cell") && message.contains("in percent"),
        "{message}"
    );
    let most = (0..SIDE * SIDE)
        .map(|k| shear(k).0.hypot(shear(k).1))
        .fold(0.0, f64::max);
    let strong = case.truth("strong.csv", "", &scaled(0.99 / most));
    let printed = case.score(&strong, &catalogues, &[]);
    assert!(printed.contains("too strong for weak lensing"), "{printed}");
}

#[test]
fn what_cannot_be_scored_is_an_error_with_its_likely_cause() {
    let case = Case::new();
    let data = case.at("data");
    let truth = data.join("set02/truth.csv");
    let nan = case.catalogues("nan", &|_, _| (f64::NAN, f64::NAN));
    let message = fail(&["score", "--truth", text(&truth), text(&nan[0])]);
    assert!(
        message.contains("none of the 1024 galaxies") && message.contains("flagged"),
        "{message}"
    );
    let degrees = case.at("degrees.dat");
    fs::write(&degrees, "180.1 -30.2 0.1 0.2\n-1 -1 0.1 0.2\n").unwrap();
    let message = fail(&["score", "--truth", text(&truth), text(&degrees)]);
    assert!(message.contains("in degrees?"), "{message}");
    // Folders that are absent or exchanged.
    let absent = case.at("absent");
    let message = fail(&["score", "--measured", text(&absent)]);
    assert!(
        message.contains("absent: there is no such folder"),
        "{message}"
    );
    let message = fail(&["compare", text(&absent)]);
    assert!(
        message.contains("absent: there is no such folder"),
        "{message}"
    );
    // Images of one's own have no truth.
    fs::remove_file(&truth).unwrap();
    let message = fail(&[
        "score",
        "--data",
        text(&data),
        "--foreign",
        text(&{
            let toml = case.at("nan.toml");
            let pattern = "nan/g10_v1_objs_{set}_{image}.M.dat";
            let text =
                format!("name = \"n\"\ncatalogues = \"{pattern}\"\nellipticity = \"shear\"\n");
            fs::write(&toml, text).unwrap();
            toml
        }),
    ]);
    assert!(message.contains("Try: shearq mean"), "{message}");
}

#[test]
fn a_bare_name_of_a_description_is_scored_and_no_store_is_left_of_a_failure() {
    let case = Case::new();
    case.catalogues("sound", &sound);
    let pattern = "sound/g10_v1_objs_{set}_{image}.M.dat";
    let toml = format!("name = \"sound\"\ncatalogues = \"{pattern}\"\nellipticity = \"shear\"\n");
    fs::write(case.at("fo.toml"), toml).unwrap();
    let run = |more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_shearq"))
            .current_dir(case.at(""))
            .args(["score", "--data", "data", "--foreign", "fo.toml"])
            .args(more)
            .output()
            .unwrap()
    };
    let output = run(&["--store", "st"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    assert_eq!(fs::read_dir(case.at("st")).unwrap().count(), 1);
    assert!(!run(&["--store", "other", "--sets", "9"]).status.success());
    assert!(!case.at("other").exists());
}

#[test]
fn options_that_do_not_apply_are_refused() {
    for refused in [
        &["--data", "d", "--foreign", "f", "--columns", "a,b,c,d"][..],
        &["--data", "d", "--foreign", "f", "--missing", "-99"],
        &["--data", "d", "--foreign", "f", "--stamp", "32"],
        &["--data", "d", "--measured", "m", "--truth-sign", "standard"],
        &["--data", "d", "--measured", "m", "--ellipticity", "shear"],
        &["--data", "d", "catalogue.dat"],
        &["--truth", "t", "--foreign", "f"],
        &["--data", "d", "--packed", "p", "--report", "r.html"],
    ] {
        let output = shearq(&[&["score"], refused].concat());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{refused:?}: {said}");
        assert!(said.contains("cannot be used with"), "{refused:?}: {said}");
    }
}

#[test]
fn folders_are_chosen_sorted_and_grouped_like_a_store() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let data = at("data");
    let simulate = ["simulate", "--images", "2", "--grid", "12", "--sets", "2,8"];
    succeed(&[&simulate[..], &["--out", text(&data)]].concat());
    for (name, out) in [("23/raw/star", "raw"), ("48/linear/star", "linear")] {
        let measure = ["measure", "--submission", name, "--data", text(&data)];
        succeed(&[&measure[..], &["--out", text(&at(out))]].concat());
    }
    let (raw, linear) = (at("raw"), at("linear"));
    let rows = |more: &[&str]| -> Vec<serde_json::Value> {
        let compare = ["compare", text(&raw), text(&linear), "--format", "json"];
        let printed = succeed(&[&compare[..], more].concat());
        let table: serde_json::Value = serde_json::from_str(&printed).unwrap();
        table["rows"].as_array().unwrap().clone()
    };
    let q = |row: &serde_json::Value| row["q"].as_f64().unwrap();
    let (all, one) = (rows(&[]), rows(&["--where", "set == 8"]));
    assert_ne!(q(&all[0]), q(&one[0]));
    let grouped = rows(&["--group-by", "set", "--sort", "q:desc"]);
    let sets: Vec<f64> = grouped
        .iter()
        .map(|row| row["set"].as_f64().unwrap())
        .collect();
    assert_eq!(sets, [2.0, 2.0, 8.0, 8.0]);
    assert!(q(&grouped[0]) >= q(&grouped[1]) && q(&grouped[2]) >= q(&grouped[3]));
    assert!(grouped[2..].iter().any(|row| q(row) == q(&one[0])));
    let sorted = rows(&["--sort", "q:desc"]);
    assert!(q(&sorted[0]) >= q(&sorted[1]));
    let named = rows(&["--where", "submission == '48/*'"]);
    assert_eq!(named.len(), 1);
    let message = fail(&["compare", text(&raw), "--where", "set == 3"]);
    assert!(message.contains("no set meets the conditions"), "{message}");
    // A data folder in place of results.
    let message = fail(&["compare", text(&data), text(&raw)]);
    assert!(
        message.contains("this is a data folder: it contains galaxy images and no run.json"),
        "{message}"
    );
    // Without a truth the images determine the grid.
    let sent = at("sent");
    succeed(&[
        "pack",
        "--measured",
        text(&raw),
        "--method",
        "M",
        "--out",
        text(&sent),
    ]);
    for set in ["set02", "set08"] {
        fs::remove_file(data.join(set).join("truth.csv")).unwrap();
    }
    let checked = succeed(&["check", text(&sent), "--data", text(&data)]);
    assert!(!checked.contains("grid"), "{checked}");
}

/// Q in the JSON of `score`.
fn q_of(printed: &str) -> f64 {
    let scores: serde_json::Value = serde_json::from_str(printed).unwrap();
    scores["Q"].as_f64().unwrap()
}

#[test]
fn stamps_of_one_pixel_have_the_scores_of_larger_stamps() {
    let case = Case::new();
    let truth = case.at("data/set02/truth.csv");
    let catalogues = case.catalogues("sound", &sound);
    let score = |truth: &Path, catalogues: &[PathBuf], stamp: &str| {
        let mut arguments = vec!["score", "--truth", text(truth), "--stamp", stamp];
        arguments.extend(catalogues.iter().map(|path| text(path)));
        arguments.extend(["--format", "json"]);
        q_of(&succeed(&arguments))
    };
    let large = score(&truth, &catalogues, "48");
    // Positions count cells: 24.5 becomes 1, 72.5 becomes 2.
    let small = |path: &Path, separator: &str| {
        let to = path.with_file_name(format!("small-{}", path.file_name().unwrap().display()));
        let convert = |line: &str| {
            let mut fields: Vec<String> = line.split(separator).map(str::to_owned).collect();
            for field in &mut fields[..2] {
                if let Ok(place) = field.parse::<f64>() {
                    *field = ((place - 0.5) / 48.0 + 0.5).to_string();
                }
            }
            fields.join(separator) + "\n"
        };
        let content = fs::read_to_string(path).unwrap();
        let content: String = content.lines().map(convert).collect();
        fs::write(&to, content).unwrap();
        to
    };
    let truth = small(&truth, ",");
    let catalogues: Vec<PathBuf> = catalogues.iter().map(|path| small(path, " ")).collect();
    assert_eq!(score(&truth, &catalogues, "1"), large);
}

#[test]
fn a_pattern_without_a_set_needs_the_sets() {
    let case = Case::new();
    let data = case.at("data");
    case.catalogues("sound", &sound);
    let describe = |name: &str, pattern: &str| {
        let path = case.at(name);
        let keys = "name = \"sound\"\nellipticity = \"shear\"";
        fs::write(&path, format!("{keys}\ncatalogues = \"{pattern}\"\n")).unwrap();
        path
    };
    let one = describe("one.toml", "sound/g10_v1_objs_2_{image}.M.dat");
    let all = describe("all.toml", "sound/g10_v1_objs_{set}_{image}.M.dat");
    let score = ["score", "--data", text(&data), "--foreign"];
    let message = fail(&[&score[..], &[text(&one)]].concat());
    assert!(message.contains("no {set}. Try: --sets 1"), "{message}");
    let q = |description: &Path| {
        let more = [text(description), "--sets", "2", "--format", "json"];
        let printed = succeed(&[&score[..], &more].concat());
        let table: serde_json::Value = serde_json::from_str(&printed).unwrap();
        table["rows"][0]["q"].as_f64().unwrap()
    };
    assert_eq!(q(&one), q(&all));
    let compare = ["compare", "--data", text(&data), "--foreign", text(&one)];
    let message = fail(&compare);
    assert!(
        message.contains("no `catalogues` contains {set}"),
        "{message}"
    );
    succeed(&[&compare[..], &["--foreign", text(&all)]].concat());
}

#[test]
fn a_psf_stamp_that_loses_the_wings_is_doubted() {
    let small = Small::new("2");
    let own = small.at("own.toml");
    for (size, doubted) in [(20, true), (32, false)] {
        let content = format!("extends = \"48/linear/star\"\npsf.size = {size}\n");
        fs::write(&own, content).unwrap();
        let said = small.measure(&["--submission", text(&own)]);
        let warning = format!("image 001: psf.size is {size} (expected 32 or more)");
        assert_eq!(said.contains(&warning), doubted, "{said}");
        assert_eq!(said.contains("warning"), doubted, "{said}");
    }
}
