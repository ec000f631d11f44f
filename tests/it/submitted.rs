//! Challenge files: packed, checked and scored; other programs' catalogues in the same table.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::support::{galsim_sets, shearq, succeed, text};

/// A measured small set and its packed catalogues.
pub struct Packed {
    root: tempfile::TempDir,
}

impl Packed {
    pub fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        succeed(&[
            "simulate",
            "--sets",
            "8",
            "--images",
            "3",
            "--grid",
            "16",
            "--seed",
            "5",
            "--amplitude",
            "100",
            "--out",
            text(&at("data")),
        ]);
        succeed(&[
            "measure",
            "--submission",
            "as-printed/23/den/star",
            "--data",
            text(&at("data")),
            "--out",
            text(&at("out")),
        ]);
        succeed(&[
            "pack",
            "--measured",
            text(&at("out")),
            "--method",
            "NN",
            "--out",
            text(&at("sent")),
        ]);
        Packed { root }
    }

    pub fn at(&self, name: &str) -> std::path::PathBuf {
        self.root.path().join(name)
    }

    pub fn file(&self, image: u32) -> std::path::PathBuf {
        self.at("sent")
            .join(format!("g10_v1_objs_8_{image}.NN.dat"))
    }

    /// Makes the packed files ones that no manifest speaks of, so that they may be edited.
    pub fn forget_manifest(&self) {
        fs::remove_file(self.at("sent/manifest.json")).unwrap();
    }

    /// Names of the checks that found something on `path`, and the exit code.
    pub fn check(&self, path: &Path) -> (Vec<String>, i32) {
        let output = shearq(&[
            "check",
            text(path),
            "--data",
            text(&self.at("data")),
            "--images",
            "3",
            "--json",
        ]);
        let findings: Value = serde_json::from_slice(&output.stdout).unwrap();
        let names = findings
            .as_array()
            .unwrap()
            .iter()
            .map(|f| f["check"].as_str().unwrap().to_owned())
            // The literal reading of the paper loses half of the shear.
            .filter(|check| check != "bias")
            .collect();
        (names, output.status.code().unwrap())
    }
}

#[test]
fn a_sound_submission_passes_and_scores_like_its_catalogues() {
    let packed = Packed::new();
    assert_eq!(packed.check(&packed.at("sent")), (vec![], 0));
    let plain = succeed(&["check", text(&packed.at("sent")), "--grid", "16"]);
    assert!(plain.ends_with("no findings\n"), "{plain}");
    let truth = packed.at("data").join("set08/truth.csv");
    let files: Vec<_> = (1..=3).map(|image| packed.file(image)).collect();
    let mut arguments = vec!["score", "--truth", text(&truth), "--truth-sign", "standard"];
    arguments.extend(files.iter().map(|f| text(f)));
    arguments.extend(["--format", "csv"]);
    let from_ascii = succeed(&arguments);
    let (data, out) = (packed.at("data"), packed.at("out"));
    let from_catalogues = succeed(&[
        "score",
        "--data",
        text(&data),
        "--measured",
        text(&out),
        "--format",
        "csv",
    ]);
    let q = |csv: &str| -> f64 {
        csv.lines()
            .nth(1)
            .unwrap()
            .split(',')
            .nth(3)
            .unwrap()
            .parse()
            .unwrap()
    };
    // ASCII keeps nine decimals.
    assert!((q(&from_ascii) / q(&from_catalogues) - 1.0).abs() < 1e-6);
    // Column of a figure by its name, in the line of the first set.
    let figure = |csv: &str, name: &str| -> f64 {
        let mut lines = csv.lines().map(|line| line.split(','));
        let at = lines.next().unwrap().position(|key| key == name);
        let value = lines.next().unwrap().nth(at.unwrap()).unwrap();
        value.parse().unwrap()
    };
    // Files keep thirteen digits of the bandpowers. Every galaxy is measured, and every image is a group of
    // its own, so that cross-spectra are the spectrum less its noise but for the weights of groups, which
    // scatter by the noise of the modes they are measured in, some five per cent.
    for (kind, expected, tolerance) in [("spectra", "q", 1e-6), ("cross-spectra", "q_dn", 0.02)] {
        let folder = packed.at(kind);
        let command = ["pack", "--measured", text(&out), "--method", "NN"];
        succeed(&[&command, &["--kind", kind, "--out", text(&folder)][..]].concat());
        let command = ["score", "--data", text(&data), "--spectra", text(&folder)];
        let scores = succeed(&[&command, &["--format", "csv"][..]].concat());
        let ratio = figure(&scores, "q") / figure(&from_catalogues, expected);
        assert!((ratio - 1.0).abs() < tolerance, "{kind}: {ratio}");
        // Fewer than eight images have no covariance.
        let told = match kind {
            "spectra" => vec![],
            _ => vec!["covariance"],
        };
        let (mut found, code) = packed.check(&folder);
        // Noise of so few galaxies makes bandpowers negative, or not.
        found.retain(|check| kind == "spectra" || check != "negative");
        assert_eq!(
            (found, code),
            (told.into_iter().map(Into::into).collect(), 0)
        );
    }
}

#[test]
fn each_planted_fault_in_a_catalogue_is_found() {
    let packed = Packed::new();
    packed.forget_manifest();
    let file = packed.file(2);
    let sound = fs::read_to_string(&file).unwrap();
    let lines: Vec<&str> = sound.lines().collect();
    let edit = |change: &dyn Fn(&str) -> String| -> String {
        lines.iter().map(|line| change(line) + "\n").collect()
    };
    let fields = |line: &str| -> Vec<f64> { line.split(' ').map(|f| f.parse().unwrap()).collect() };
    let first = |replacement: &str| {
        std::iter::once(replacement)
            .chain(lines[1..].iter().copied())
            .map(|l| format!("{l}\n"))
            .collect::<String>()
    };
    let faults: Vec<(&str, String, &str)> = vec![
        ("few rows", lines[..100].join("\n"), "missing"),
        ("one row missing", lines[1..].join("\n"), "missing"),
        ("a row twice", first(lines[1]), "duplicates"),
        (
            "more rows than cells",
            format!("{sound}{}\n", lines[5]),
            "excess",
        ),
        ("outside the grid", first("99999 24.5 0.1 0.1"), "outside"),
        ("NaN", first("24.5 24.5 NaN 0.1"), "not-finite"),
        ("infinite", first("24.5 24.5 0.1 inf"), "not-finite"),
        ("large |e|", first("24.5 24.5 0.9 0.9"), "range"),
        ("words", first("24.5 24.5 none 0.1"), "readable"),
        (
            "a column too few",
            edit(&|l| l.rsplit_once(' ').unwrap().0.to_owned()),
            "readable",
        ),
        (
            "all zero",
            edit(&|l| {
                let f = fields(l);
                format!("{} {} 0 0", f[0], f[1])
            }),
            "constant",
        ),
        (
            "all the same",
            edit(&|l| {
                let f = fields(l);
                format!("{} {} 0.1 -0.2", f[0], f[1])
            }),
            "constant",
        ),
        (
            "positions counted from 0",
            edit(&|l| {
                let f = fields(l);
                format!("{} {} {} {}", f[0] - 1.0, f[1] - 1.0, f[2], f[3])
            }),
            "positions",
        ),
        ("empty", String::new(), "missing"),
    ];
    for (fault, content, expected) in faults {
        fs::write(&file, content).unwrap();
        let (found, code) = packed.check(&packed.at("sent"));
        assert!(found.iter().any(|f| f == expected), "{fault}: {found:?}");
        let only_warning = ["one row missing", "large |e|", "positions counted from 0"];
        assert_eq!(
            code,
            i32::from(!only_warning.contains(&fault)),
            "{fault}: {found:?}"
        );
    }
    fs::write(&file, &sound).unwrap();
    fs::rename(&file, packed.at("sent").join("catalogue_2.txt")).unwrap();
    let (found, _) = packed.check(&packed.at("sent"));
    assert!(
        found.contains(&"name".into()) && found.contains(&"images".into()),
        "{found:?}"
    );
    fs::rename(
        packed.at("sent").join("catalogue_2.txt"),
        packed.at("sent").join("g10_v1_objs_8_2.other.dat"),
    )
    .unwrap();
    assert!(
        packed
            .check(&packed.at("sent"))
            .0
            .contains(&"method".into())
    );
}

#[test]
fn blank_catalogues_count_as_images_and_odd_tables_get_errors() {
    let packed = Packed::new();
    let truth = packed.at("data").join("set08/truth.csv");
    let blank = packed.at("blank.dat");
    fs::write(&blank, "").unwrap();
    let score = |files: &[&Path], columns: &str| {
        let mut arguments = vec!["score", "--truth", text(&truth), "--truth-sign", "standard"];
        arguments.extend(files.iter().map(|f| text(f)));
        arguments.extend(["--columns", columns, "--format", "json"]);
        shearq(&arguments)
    };
    let first = packed.file(1);
    let figures = |output: std::process::Output| -> Value {
        assert!(
            output.status.success(),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let alone = figures(score(&[&first], "x,y,e1,e2"));
    let diluted = figures(score(&[&first, &blank], "x,y,e1,e2"));
    assert_eq!(diluted["n_images"], 2);
    // Half the field, a quarter of the power.
    let power = |found: &Value| found["classes"]["B"]["EE"][3].as_f64().unwrap();
    assert!((power(&diluted) / power(&alone) - 0.25).abs() < 1e-9);
    let nothing = score(&[&blank], "x,y,e1,e2");
    let message = String::from_utf8(nothing.stderr).unwrap();
    assert_eq!(nothing.status.code(), Some(1), "{message}");
    assert!(
        message.contains("found no galaxy in 1 catalogue(s)"),
        "{message}"
    );
    // The same column twice, from every format.
    for file in [
        first.clone(),
        packed.at("out").join("set08/catalogue-001.parquet"),
    ] {
        let output = score(&[&file], "x,y,e1,e1");
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{message}");
        assert!(message.contains("`e1` is asked for twice"), "{message}");
    }
    // An absurd image number is no name of a catalogue.
    let absurd = packed.at("sent").join("g10_v1_objs_8_4294967295.NN.dat");
    fs::copy(&first, &absurd).unwrap();
    assert!(packed.check(&packed.at("sent")).0.contains(&"name".into()));
}

#[test]
fn differences_are_given_only_for_the_same_images() {
    let packed = Packed::new();
    let (data, other) = (packed.at("data"), packed.at("other"));
    succeed(&[
        "measure",
        "--submission",
        "23/raw/star",
        "--data",
        text(&data),
        "--out",
        text(&other),
    ]);
    let compare = || -> Value {
        let out = succeed(&[
            "compare",
            text(&packed.at("out")),
            text(&other),
            "--format",
            "json",
        ]);
        serde_json::from_str(&out).unwrap()
    };
    assert!(compare()["rows"][1]["q_difference"].is_number());
    fs::remove_file(other.join("set08/catalogue-001.parquet")).unwrap();
    fs::remove_file(packed.at("out").join("set08/catalogue-003.parquet")).unwrap();
    let table = compare();
    assert!(table["rows"][1]["q_difference"].is_null(), "{table}");
    assert!(
        table["notes"]
            .to_string()
            .contains("differences need equal images")
    );
}

#[test]
fn wrong_conventions_and_types_are_suspected() {
    let packed = Packed::new();
    packed.forget_manifest();
    let change = |e1: f64, e2: f64| {
        for image in 1..=3 {
            let text = fs::read_to_string(packed.file(image)).unwrap();
            let changed: String = text
                .lines()
                .map(|line| {
                    let f: Vec<f64> = line.split(' ').map(|f| f.parse().unwrap()).collect();
                    format!("{} {} {} {}\n", f[0], f[1], e1 * f[2], e2 * f[3])
                })
                .collect();
            fs::write(packed.file(image), changed).unwrap();
        }
    };
    change(1.0, -1.0);
    let (found, code) = packed.check(&packed.at("sent"));
    assert_eq!((found, code), (vec!["convention".to_owned()], 1));
    change(5.0, -5.0);
    let (found, _) = packed.check(&packed.at("sent"));
    assert!(found.contains(&"type".to_owned()), "{found:?}");
}

#[test]
fn each_planted_fault_in_a_spectrum_is_found() {
    let packed = Packed::new();
    let (out, folder) = (packed.at("out"), packed.at("spectra"));
    succeed(&[
        "pack",
        "--measured",
        text(&out),
        "--method",
        "NN",
        "--kind",
        "spectra",
        "--out",
        text(&folder),
    ]);
    let file = folder.join("NN_set8.dat");
    let sound = fs::read_to_string(&file).unwrap();
    let lines: Vec<&str> = sound.lines().collect();
    let scaled: String = lines
        .iter()
        .map(|line| {
            let f: Vec<f64> = line.split(' ').map(|f| f.parse().unwrap()).collect();
            format!("{} {} {:e}\n", f[0], f[1], f[2] * 1e-4)
        })
        .collect();
    let replaced = |line: &str| {
        std::iter::once(line)
            .chain(lines[1..].iter().copied())
            .map(|l| format!("{l}\n"))
            .collect::<String>()
    };
    let second = lines[0].split(' ').nth(1).unwrap();
    for (content, expected) in [
        (lines[1..].join("\n"), "bins"),
        (replaced("2 9999 1e-5"), "multipole"),
        (replaced(&format!("2 {second} nan")), "not-finite"),
        (replaced(&format!("2 {second} -1e-5")), "negative"),
        (scaled, "unit"),
        ("nothing here\n1 2\n".to_owned(), "readable"),
    ] {
        fs::write(&file, content).unwrap();
        let (found, _) = packed.check(&folder);
        assert!(found.iter().any(|f| f == expected), "{expected}: {found:?}");
    }
}

#[test]
fn catalogues_of_other_programs_are_compared_in_the_same_table() {
    // The stored sets have too few galaxies to be scored.
    for folder in galsim_sets()
        .iter()
        .filter(|folder| !folder.starts_with("tests"))
    {
        compare_with_other_programs(&folder.canonicalize().unwrap());
    }
}

fn compare_with_other_programs(folder: &Path) {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    succeed(&[
        "measure",
        "--submission",
        "23/raw/star",
        "--data",
        text(folder),
        "--out",
        text(&at("out")),
    ]);
    let describe = |name: &str, ellipticity: &str, report: &str| {
        let path = at(&format!("{name}-{report}.toml"));
        let pattern = folder.join(format!("set{{set:02}}/hsm-{name}-{{image:03}}.csv"));
        let content = format!(
            "name = \"{name}\"\ncatalogues = \"{}\"\nellipticity = \"{ellipticity}\"\nreport = \"{report}\"\nflag = \"flag\"\n",
            pattern.display()
        );
        fs::write(&path, content).unwrap();
        path
    };
    let regauss = describe("regauss", "distortion", "shear");
    let ksb = describe("ksb", "shear", "shear");
    let distortion = describe("regauss", "distortion", "distortion");
    let table = succeed(&[
        "compare",
        text(&at("out")),
        "--foreign",
        text(&regauss),
        "--foreign",
        text(&ksb),
        "--foreign",
        text(&distortion),
        "--format",
        "json",
    ]);
    let table: Value = serde_json::from_str(&table).unwrap();
    let value = |row: usize, key: &str| table["rows"][row][key].as_f64().unwrap();
    // Two of one name are told apart by their files.
    let name = |row: usize| {
        table["rows"][row]["submission"]
            .as_str()
            .unwrap()
            .to_owned()
    };
    assert_eq!(name(1), format!("regauss ({})", regauss.display()));
    assert_eq!(name(2), "ksb");
    assert_eq!(name(3), format!("regauss ({})", distortion.display()));
    // Shape noise: the jackknife error comes from two images per set.
    for row in [1, 2] {
        let (m, error) = (value(row, "m_cross"), value(row, "m_cross_error"));
        assert!(m.abs() < 4.0 * error, "{table:#}");
    }
    // The same catalogue read as distortions responds nearly twice as much; its noise is common to both.
    let ratio = (1.0 + value(3, "m_cross")) / (1.0 + value(1, "m_cross"));
    assert!((1.5..2.0).contains(&ratio), "{ratio}");
    let broken = at("broken.toml");
    fs::write(
        &broken,
        "name = \"x\"\ncatalogues = \"{set}-{image}\"\nellipticity = \"shear\"\ncolumn = 1\n",
    )
    .unwrap();
    let output = shearq(&["score", "--data", text(folder), "--foreign", text(&broken)]);
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(
        message.contains("broken.toml") && message.contains("column"),
        "{message}"
    );
}
