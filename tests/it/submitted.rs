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
