//! One wrong image of several, in every command that compares catalogues with a truth, and files of another image.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::{shearq, succeed, text};

const LINEAR: &str = "48/linear/star";

/// Sets 2 and 8 with ten times the rms of shear, in six images of 24 × 24 galaxies.
fn simulated(root: &Path) -> PathBuf {
    let data = root.join("data");
    succeed(&[
        "simulate",
        "--sets",
        "2,8",
        "--images",
        "6",
        "--grid",
        "24",
        "--amplitude",
        "100",
        "--seed",
        "3",
        "--out",
        text(&data),
    ]);
    // The folder does not state which files belong to it any more.
    fs::remove_file(data.join("simulation.json")).unwrap();
    data
}

/// What a command wrote, one line, without the breaks of terminals.
fn said(arguments: &[&str]) -> (String, bool) {
    let done = shearq(arguments);
    let all = [done.stdout, done.stderr].concat();
    let all = String::from_utf8(all).unwrap();
    let words: Vec<&str> = all.split_whitespace().collect();
    (words.join(" "), done.status.success())
}

/// How often a line names an image that differs from its set.
fn named(said: &str) -> usize {
    said.matches("follows the true shear by").count()
}

#[test]
fn exchanged_images_are_named_by_their_header_and_by_their_response() {
    let root = tempfile::tempdir().unwrap();
    let at = |name: &str| root.path().join(name);
    let data = simulated(root.path());
    let measure = |out: &Path| {
        let command = ["measure", "--submission", LINEAR, "--data", text(&data)];
        said(&[&command[..], &["--out", text(out)]].concat()).0
    };
    let good = measure(&at("good"));
    assert!(!good.contains("warning"), "{good}");
    for file in ["galaxies-003.fits", "psf-003.fits"] {
        let [two, eight] = ["set02", "set08"].map(|set| data.join(set).join(file));
        fs::rename(&two, at("kept")).unwrap();
        fs::rename(&eight, &two).unwrap();
        fs::rename(at("kept"), &eight).unwrap();
    }
    let bad = measure(&at("bad"));
    let expected = "set 02 image 003: the header of the galaxies states another image (found SET = 8 and IMAGE = 3, expected 2 and 3)";
    assert!(bad.contains(expected), "{bad}");

    let (honest, _) = said(&[
        "score",
        "--measured",
        text(&at("good")),
        "--data",
        text(&data),
    ]);
    assert_eq!(named(&honest), 0, "{honest}");
    let (scored, _) = said(&["score", "--measured", text(&at("bad"))]);
    assert_eq!(named(&scored), 2, "{scored}");
    for set in ["set02", "set08"] {
        let name = format!("{set}/catalogue-003.parquet follows the true shear by");
        assert!(scored.contains(&name), "{scored}");
    }
    let (compared, _) = said(&["compare", text(&at("bad"))]);
    assert_eq!(named(&compared), 2, "{compared}");

    let sent = at("sent");
    succeed(&["pack", "--measured", text(&at("bad")), "--out", text(&sent)]);
    let check = ["check", text(&sent), "--data", text(&data)];
    let (checked, accepted) = said(&check);
    assert!(!accepted && checked.contains("error [image]"), "{checked}");
    assert!(checked.contains("(2 files"), "{checked}");
}

#[test]
fn plain_catalogues_in_any_convention_have_their_odd_image_named() {
    let root = tempfile::tempdir().unwrap();
    let data = simulated(root.path());
    let out = root.path().join("out");
    let measure = ["measure", "--submission", LINEAR, "--data", text(&data)];
    succeed(&[&measure[..], &["--sets", "8", "--out", text(&out)]].concat());
    let sent = root.path().join("sent");
    let pack = ["pack", "--measured", text(&out), "--method", "A"];
    succeed(&[&pack[..], &["--out", text(&sent)]].concat());
    let names: Vec<PathBuf> = (1..=6)
        .map(|image| sent.join(format!("g10_v1_objs_8_{image}.A.dat")))
        .collect();
    let truth = data.join("set08/truth.csv");
    let score = || {
        let mut command = vec!["score", "--truth", text(&truth)];
        command.extend(names.iter().map(|path| text(path)));
        said(&command).0
    };
    let edit = |path: &Path, row: &dyn Fn(&[f64]) -> [f64; 4]| {
        let written = fs::read_to_string(path).unwrap();
        let line = |line: &str| {
            let numbers: Vec<f64> = line.split(' ').map(|n| n.parse().unwrap()).collect();
            let [x, y, e1, e2] = row(&numbers);
            format!("{x} {y} {e1} {e2}\n")
        };
        fs::write(path, written.lines().map(line).collect::<String>()).unwrap();
    };
    // All images with the other sign of e2, which `score` finds out.
    for path in &names {
        edit(path, &|f| [f[0], f[1], f[2], -f[3]]);
    }
    assert_eq!(named(&score()), 0);
    let kept = fs::read(&names[3]).unwrap();
    for wrong in [
        |f: &[f64]| [f[1], f[0], f[2], f[3]],
        |f: &[f64]| [f[0], f[1], 2.0 * f[2], 2.0 * f[3]],
        |f: &[f64]| [f[0], f[1], f[2], -f[3]],
        // Rows from the last to the first.
        |f: &[f64]| {
            [
                24.0 * 48.0 + 1.0 - f[0],
                24.0 * 48.0 + 1.0 - f[1],
                f[2],
                f[3],
            ]
        },
    ] {
        edit(&names[3], &wrong);
        let found = score();
        assert!(
            named(&found) == 1 && found.contains("_8_4.A.dat follows"),
            "{found}"
        );
        fs::write(&names[3], &kept).unwrap();
    }
}
