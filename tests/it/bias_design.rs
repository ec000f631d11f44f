//! `shearq bias` on catalogues that do not pair, and errors that name their cause.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde_json::Value;

use crate::support::{fail, shearq, succeed, text};

/// Ellipticities of `count` galaxies under `g`: shapes of 0.25 per component, m = 0.05 and c = 0.001. A share of `lost`
/// is absent, others under each shear.
fn shapes(seed: u64, count: usize, g: [f64; 2], lost: f64) -> Vec<[f64; 2]> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut losses =
        ChaCha8Rng::seed_from_u64(seed ^ g[0].to_bits() ^ g[1].to_bits().rotate_left(7));
    let mut rows = Vec::new();
    for _ in 0..count {
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let e = g.map(|g| 0.25 * normal() + 1.05 * g + 0.001);
        if losses.random_range(0.0..1.0) >= lost {
            rows.push(e);
        }
    }
    rows
}

/// Writes columns e1, e2 and more of equal values.
fn csv(path: &Path, rows: &[[f64; 2]], more: &[(&str, String)]) {
    let mut text = String::from("e1,e2");
    more.iter()
        .for_each(|(name, _)| text += &format!(",{name}"));
    text.push('\n');
    for [e1, e2] in rows {
        write!(text, "{e1},{e2}").unwrap();
        more.iter()
            .for_each(|(_, value)| text += &format!(",{value}"));
        text.push('\n');
    }
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

fn shear(g: [f64; 2]) -> Vec<(&'static str, String)> {
    vec![("g1", g[0].to_string()), ("g2", g[1].to_string())]
}

/// The first row of the table, the notes, and what was said.
fn bias(files: &[PathBuf], more: &[&str]) -> (Value, String) {
    let mut arguments = vec!["bias", "--format", "json"];
    arguments.extend(files.iter().map(|path| text(path)));
    arguments.extend(more);
    let done = shearq(&arguments);
    let said = String::from_utf8(done.stderr).unwrap();
    assert!(done.status.success(), "{said}");
    let json: Value = serde_json::from_slice(&done.stdout).unwrap();
    (json["rows"][0].clone(), said)
}

fn number(row: &Value, key: &str) -> f64 {
    row[key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"))
}

const ARMS: [(&str, [f64; 2]); 4] = [
    ("1p2z", [0.02, 0.0]),
    ("1m2z", [-0.02, 0.0]),
    ("1z2p", [0.0, 0.02]),
    ("1z2m", [0.0, -0.02]),
];

#[test]
fn tiles_of_which_some_are_missing_pair_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let mut files = Vec::new();
    for (name, g) in ARMS {
        for tile in (0..24).filter(|tile| !matches!((name, tile), ("1p2z", 3) | ("1z2m", 9))) {
            let path = folder.path().join(format!("{name}/tile{tile:02}.csv"));
            let columns = [&shear(g)[..], &[("TILE_ID", format!("{tile}.3"))]].concat();
            csv(&path, &shapes(tile, 500, g, 0.05), &columns);
            files.push(path);
        }
    }
    let (found, said) = bias(&files, &[]);
    let expected = "warning: catalogues are missing: g = (0, -0.02) beside ";
    assert!(
        said.contains(expected) && said.contains("g = (0.02, 0) beside "),
        "{said}"
    );
    assert!(
        said.contains("1m2z/tile03.csv") && said.contains("tile09.csv"),
        "{said}"
    );
    // The noise of the galaxies without a partner, 5 % under each shear and one tile: √(2·570 + 500)·0.25/11400/0.04.
    let error = number(&found, "m1_error");
    assert!((0.015..0.031).contains(&error), "{error}");
    assert_eq!(number(&found, "units"), 24.0);
    // The column of tiles gives the same units.
    let (by_tile, _) = bias(&files, &["--units", "TILE_ID"]);
    for key in ["m1", "m1_error", "c1_error", "m2_error"] {
        let (a, b) = (number(&found, key), number(&by_tile, key));
        assert!((a / b - 1.0).abs() < 1e-9, "{key}: {a} {b}");
    }
    // Names that state nothing: each catalogue is a unit, and the remedy is the column.
    let renamed: Vec<PathBuf> = files
        .iter()
        .enumerate()
        .map(|(k, path)| {
            let name = folder
                .path()
                .join(format!("{}.csv", (k * 7919 + 13) % 9973));
            fs::copy(path, &name).unwrap();
            name
        })
        .collect();
    let (_, said) = bias(&renamed, &[]);
    assert!(
        said.contains("do not pair (found 23 with g = (0.02, 0) and 24")
            && said.contains("Try: --units TILE_ID"),
        "{said}"
    );
}

#[test]
fn rows_in_another_order_are_said_to_change_the_errors() {
    let folder = tempfile::tempdir().unwrap();
    let g = [0.02, -0.015];
    let opposite = g.map(|g: f64| -g);
    let at = |name: &str| folder.path().join(name);
    let (plus, mut minus) = (shapes(5, 2000, g, 0.0), shapes(5, 2000, opposite, 0.0));
    let files = [at("plus.csv"), at("minus.csv")];
    csv(&files[0], &plus, &shear(g));
    csv(&files[1], &minus, &shear(opposite));
    let (good, said) = bias(&files, &[]);
    assert_eq!(said, "");
    minus.reverse();
    csv(&files[1], &minus, &shear(opposite));
    let (reversed, said) = bias(&files, &[]);
    assert!(
        said.contains("are different galaxies (their ellipticities correlate by"),
        "{said}"
    );
    assert!(
        said.contains(
            "the error of m is too large, and that of c too small by up to √2. Try: --columns id"
        ),
        "{said}"
    );
    // As said.
    let ratio = number(&good, "c1_error") / number(&reversed, "c1_error");
    assert!((ratio / 2_f64.sqrt() - 1.0).abs() < 0.05, "{ratio}");
    // Numbers of rows are no identifiers.
    let lost = [shapes(5, 2000, g, 0.05), shapes(5, 2000, opposite, 0.05)];
    for ((path, rows), g) in files.iter().zip(&lost).zip([g, opposite]) {
        let mut text = String::from("NUMBER,e1,e2,g1,g2\n");
        for (k, [e1, e2]) in rows.iter().enumerate() {
            writeln!(text, "{},{e1},{e2},{},{}", k + 1, g[0], g[1]).unwrap();
        }
        fs::write(path, text).unwrap();
    }
    let (_, said) = bias(&files, &[]);
    assert!(said.contains("different galaxies"), "{said}");
}

#[test]
fn causes_of_implausible_results_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let files = [at("plus.csv"), at("minus.csv")];
    // Writes a pair with ellipticities after `change`, and more columns that depend on the row.
    let write = |g: [f64; 2],
                 change: &dyn Fn([f64; 2]) -> [f64; 2],
                 more: &str,
                 value: &dyn Fn(usize) -> f64| {
        for (path, sign) in files.iter().zip([1.0, -1.0]) {
            let g = g.map(|g| sign * g);
            let mut text = format!("e1,e2,g1,g2,{more}\n");
            for (k, e) in shapes(7, 4000, g, 0.0).into_iter().enumerate() {
                let [e1, e2] = change(e);
                writeln!(text, "{e1},{e2},{},{},{}", g[0], g[1], value(k)).unwrap();
            }
            fs::write(path, text).unwrap();
        }
    };
    let g = [0.02, -0.012];
    let arguments = ["bias", text(&files[0]), text(&files[1])];
    write(g, &|[e1, e2]| [e2, e1], "extra", &|_| 0.0);
    let error = fail(&arguments);
    assert!(
        error.contains("e1 and e2 are probably exchanged"),
        "{error}"
    );
    // Both signs wrong is another cause.
    write(g, &|[e1, e2]| [-e1, -e2], "extra", &|_| 0.0);
    assert!(fail(&arguments).contains("e1 follows minus the true g1"));
    write(g, &|e| e, "w", &|k| if k == 5 { 1e6 } else { 1.0 });
    let (_, said) = bias(&files, &[]);
    assert!(
        said.contains("few weights dominate: 8000 galaxies have the information of 2.0"),
        "{said}"
    );
    write(g, &|e| e, "w", &|k| (k % 7 + 1) as f64);
    assert_eq!(bias(&files, &[]).1, "");
    let response = ["--columns", "R11=r,R22=r"];
    write(g, &|e| e, "r", &|k| -0.7 + 0.1 * (k as f64).sin());
    let error = fail(&[&arguments[..], &response].concat());
    assert!(error.contains("R11 is negative (found -0.70"), "{error}");
    // The advice to leave out a response appears only if there is one.
    write(g, &|[e1, e2]| [1.6 * e1, 0.9 * e2], "r", &|_| 1.0);
    let (none, with) = (
        succeed(&arguments),
        succeed(&[&arguments[..], &response].concat()),
    );
    assert!(
        none.contains("expected |m| below 0.3") && !none.contains("R11=none"),
        "{none}"
    );
    assert!(with.contains("R11=none"), "{with}");
    // Two catalogues under one shear: first the truth is asked for.
    write(g, &|e| e, "r", &|_| 1.0);
    let one = ["--g1", "0.1", "--g2", "0.1"];
    let shown = succeed(&[&arguments[..], &response, &one].concat());
    let (asks, advises) = (shown.find("--truth shears.csv"), shown.find("R11=none"));
    assert!(asks.is_some() && asks < advises, "{shown}");
    // PSFs of other galaxies leave minus a part of their ellipticity.
    for (leak, named) in [(-0.7, true), (0.05, false)] {
        let mut text = String::from("e1,e2,psf_e1,psf_e2,g1,g2\n");
        for (k, [e1, e2]) in shapes(9, 4000, g, 0.0).into_iter().enumerate() {
            let psf = [(k as f64).sin(), (k as f64).cos()].map(|p| 0.05 * p);
            let e = [e1 + leak * psf[0], e2 + leak * psf[1]];
            writeln!(
                text,
                "{},{},{},{},{},{}",
                e[0], e[1], psf[0], psf[1], g[0], g[1]
            )
            .unwrap();
        }
        fs::write(&files[0], text).unwrap();
        let (_, said) = bias(&files[..1], &[]);
        assert_eq!(
            said.contains("follow minus the ellipticity of the PSF (found α = -0."),
            named,
            "{said}"
        );
    }
    // Two images in one table of the truth.
    let truth = at("truth.csv");
    fs::write(&truth, "x,y,g1,g2\n1,1,0.02,0\n2,9,0.01,0\n1,1,-0.02,0\n").unwrap();
    let error = fail(&[&arguments[..], &["--truth", text(&truth)]].concat());
    assert!(
        error.contains("x = 1, y = 1 has two true shears"),
        "{error}"
    );
}
