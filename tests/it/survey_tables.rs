//! `shearq bias` on tables as surveys publish them.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

use crate::support::{fail, succeed};

/// Shears of the versions without shear, 1p, 1m, 2p and 2m.
const SHEARS: [[f64; 2]; 5] = [
    [0.0, 0.0],
    [0.01, 0.0],
    [-0.01, 0.0],
    [0.0, 0.01],
    [0.0, -0.01],
];
const VERSIONS: [&str; 4] = ["1p", "1m", "2p", "2m"];

fn result(arguments: &[&str]) -> Value {
    let output = succeed(&[&["bias", "--format", "json"], arguments].concat());
    let json: Value = serde_json::from_str(&output).unwrap();
    json["rows"][0].clone()
}

fn number(row: &Value, key: &str) -> f64 {
    row[key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"))
}

/// Writes a table for each sign of a true shear of 0.02, and returns their paths.
fn pair(folder: &Path, name: &str, table: impl Fn(f64) -> String) -> [String; 2] {
    [("plus", 0.02), ("minus", -0.02)].map(|(sign, g)| {
        let path = folder.join(format!("{name}-{sign}.csv"));
        fs::write(&path, table(g)).unwrap();
        path.to_str().unwrap().to_owned()
    })
}

fn shapes(count: usize) -> Vec<[f64; 2]> {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let shape = |_| [(); 2].map(|()| rng.random_range(-0.5..0.5));
    (0..count).map(shape).collect()
}

fn versions_in_rows(column: &str, names: [&str; 5], g: f64) -> String {
    let mut text = format!("id,{column},gauss_flags,gauss_g1,gauss_g2,g1,g2\n");
    for (name, shear) in names.into_iter().zip(SHEARS) {
        for (id, shape) in shapes(500).iter().enumerate() {
            let flag = u8::from(id % 50 == 0);
            // Rows with a flag have other values.
            let e = [0, 1].map(|k| match flag {
                0 => 0.8 * (shape[k] + 1.05 * g + shear[k]),
                _ => 0.9,
            });
            writeln!(text, "{id},{name},{flag},{},{},{g},{g}", e[0], e[1]).unwrap();
        }
    }
    text
}

#[test]
fn rows_of_versions_are_recognised_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let lsst = ["ns", "1p", "1m", "2p", "2m"];
    for column in ["metaStep", "shear_type", "mdet_step"] {
        let [plus, minus] = pair(folder.path(), column, |g| versions_in_rows(column, lsst, g));
        let found = result(&[&plus, &minus]);
        assert!((number(&found, "r1") - 0.8).abs() < 1e-9, "{found}");
        assert!((number(&found, "m1") - 0.05).abs() < 1e-9, "{found}");
        assert_eq!(number(&found, "n"), 980.0);
    }
    let [plus, minus] = pair(folder.path(), "own", |g| {
        versions_in_rows("my_step", lsst, g)
    });
    let error = fail(&["bias", &plus, &minus]);
    assert!(error.contains("--columns version=my_step"), "{error}");
    let found = result(&[&plus, &minus, "--columns", "version=my_step"]);
    assert!((number(&found, "m1") - 0.05).abs() < 1e-9, "{found}");
    let other = ["sheared", "1p", "1m", "2p", "2m"];
    let [plus, minus] = pair(folder.path(), "other", |g| {
        versions_in_rows("shear_type", other, g)
    });
    let error = fail(&["bias", &plus, &minus]);
    assert!(
        error.contains("`sheared`") && !error.contains("version=none"),
        "{error}"
    );
}

/// The size of a galaxy under a shear that is added to `g`.
fn size(id: usize, shape: [f64; 2], g: f64, added: [f64; 2]) -> f64 {
    let along: f64 = (0..2).map(|k| shape[k] * (g + added[k])).sum();
    0.5 + (id as f64 * 0.618_034).fract() * (1.0 + 2.0 * along)
}

#[test]
fn versions_of_flags_and_weights_give_their_response() {
    let folder = tempfile::tempdir().unwrap();
    let count = 20_000;
    let shapes = shapes(count);
    let failed = |id: usize| id.is_multiple_of(40);
    for (weighted, name) in [(true, "y3"), (false, "selected")] {
        let weight = |size: f64| {
            if weighted {
                1.0 / (0.2 + 0.5 / size)
            } else {
                1.0
            }
        };
        let files = pair(folder.path(), name, |g| {
            let mut text =
                "coadd_object_id,e_1,e_2,R11,R12,R21,R22,g1,g2,flags,flags_select".to_owned();
            for version in VERSIONS {
                write!(text, ",flags_select_{version}").unwrap();
            }
            if weighted {
                text += ",weight";
                for version in VERSIONS {
                    write!(text, ",weight_{version}").unwrap();
                }
            }
            text += "\n";
            for (id, shape) in shapes.iter().enumerate() {
                let e = if failed(id) {
                    [0.7; 2]
                } else {
                    shape.map(|shape| shape + g)
                };
                let flag = u8::from(failed(id));
                write!(text, "{id},{},{},1,0,0,1,{g},{g},{flag}", e[0], e[1]).unwrap();
                let sizes = SHEARS.map(|added| size(id, *shape, g, added));
                for size in sizes {
                    write!(text, ",{}", u8::from(size < 0.7)).unwrap();
                }
                if weighted {
                    for size in sizes {
                        write!(text, ",{}", weight(size)).unwrap();
                    }
                }
                text += "\n";
            }
            text
        });
        // ⟨e⟩ of each version with its own choice and weights, over both catalogues.
        let mean = |version: usize, k: usize| {
            let mut sums = [0.0; 2];
            for g in [0.02, -0.02] {
                for (id, shape) in shapes.iter().enumerate().filter(|(id, _)| !failed(*id)) {
                    let size = size(id, *shape, g, SHEARS[version]);
                    if size >= 0.7 {
                        sums[0] += weight(size) * (shape[k] + g);
                        sums[1] += weight(size);
                    }
                }
            }
            sums[0] / sums[1]
        };
        let found = result(&[&files[0], &files[1]]);
        for k in 0..2 {
            let expected = 1.0 + (mean(1 + 2 * k, k) - mean(2 + 2 * k, k)) / 0.02;
            let r = number(&found, &format!("r{}", k + 1));
            assert!((r - expected).abs() < 1e-9, "{name}: {r}, {expected}");
            // The choice matters.
            assert!((r - 1.0).abs() > 0.02, "{r}");
        }
    }
}

/// 1000 galaxies with columns and values after e1, e2, g1 and g2.
fn galaxies(g: f64, names: &str, values: impl Fn(usize) -> String) -> String {
    let mut text = format!("id,e1,e2,g1,g2,{names}\n");
    for (id, [e1, e2]) in shapes(1000).iter().enumerate() {
        writeln!(text, "{id},{},{},{g},{g},{}", e1 + g, e2 + g, values(id)).unwrap();
    }
    text
}

#[test]
fn cuts_of_good_rows_and_constant_patches_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let select = |id: usize| u8::from(!id.is_multiple_of(5)).to_string();
    let [plus, minus] = pair(folder.path(), "cut", |g| {
        galaxies(g, "flags_select", select)
    });
    let error = fail(&["bias", &plus, &minus]);
    assert!(
        error.contains("--columns flag=none --where flags_select"),
        "{error}"
    );
    let found = result(&[
        &plus,
        &minus,
        "--columns",
        "flag=none",
        "--where",
        "flags_select",
    ]);
    assert_eq!(number(&found, "n"), 1600.0);
    let [plus, minus] = pair(folder.path(), "patch", |g| {
        galaxies(g, "patch", |_| "3".into())
    });
    let error = fail(&["bias", &plus, &minus]);
    assert!(error.contains("--units rows"), "{error}");
    let path = folder.path().join("a.h5");
    fs::write(&path, b"\x89HDF\r\n\x1a\n\0\0").unwrap();
    let error = fail(&["bias", path.to_str().unwrap()]);
    assert!(error.contains("HDF5, which is not read"), "{error}");
}

#[test]
fn choices_failures_and_repeated_numbers_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let every =
        |id: usize, one: &str, other: &str| if id % 50 == 3 { one } else { other }.to_owned();
    for (names, one, other, expected) in [
        ("is_primary", "0", "1", "--where 'is_primary'"),
        ("deblend_failed", "1", "0", "--where 'not(deblend_failed)'"),
        (
            "psf_e1,psf_e2",
            "2,2",
            "2,2",
            "psf_e1=none,psf_e2=none,psf_size=none",
        ),
    ] {
        let [plus, minus] = pair(folder.path(), names, |g| {
            galaxies(g, names, |id| every(id, one, other))
        });
        let error = fail(&["bias", &plus, &minus]);
        assert!(error.contains(expected), "{error}");
    }
    for failure in ["-10", "-1", "0", "-99"] {
        let [plus, minus] = pair(folder.path(), "rms", |g| {
            galaxies(g, "rms_e", |id| every(id, failure, "0.36"))
        });
        let arguments = ["bias", &plus, &minus, "--columns", "rms_e=rms_e"];
        let distortions = [&arguments[..], &["--ellipticity", "responsivity"]].concat();
        let error = fail(&distortions);
        assert!(error.contains("row 4: column `rms_e`"), "{error}");
    }
    let same = pair(folder.path(), "same", |g| {
        galaxies(g, "is_primary", |_| "1".into())
    });
    assert_eq!(number(&result(&[&same[0], &same[1]]), "n"), 2000.0);

    // A failure in one component of 20 in 1000, and honest numbers with two digits.
    let table = |g: f64, failed: bool, digits: usize| {
        let mut text = String::from("id,e1,e2,g1,g2\n");
        for (id, [e1, e2]) in shapes(1000).iter().enumerate() {
            let e1 = if failed && id % 50 == 3 {
                -99.9
            } else {
                e1 + g
            };
            writeln!(text, "{id},{e1:.digits$},{:.digits$},{g},{g}", e2 + g).unwrap();
        }
        text
    };
    for (failed, digits) in [(true, 9), (false, 2), (false, 1)] {
        let [plus, minus] = pair(folder.path(), "few", |g| table(g, failed, digits));
        let printed = succeed(&["bias", &plus, &minus]);
        let words = printed.split_whitespace().collect::<Vec<_>>().join(" ");
        assert_eq!(
            words.contains("`e1` is exactly -99.9 in 40 of 2000"),
            failed,
            "{printed}"
        );
        assert_eq!(words.contains("is exactly"), failed, "{printed}");
    }
}
