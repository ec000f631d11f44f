//! `shearq bias` on catalogues with known m and c.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde_json::Value;
use shearq_files::frames::frame;
use shearq_files::frames::polars::{Column, NamedFrom, Series};
use shearq_files::table::{self, FileFormat};

use crate::support::{fail, shearq, succeed, text};

const M: [f64; 2] = [0.02, -0.03];
const C: [f64; 2] = [1e-3, -2e-3];
const GALAXIES: usize = 2000;

/// Shears that are added in the catalogues noshear, 1p, 1m, 2p and 2m.
const SHEARS: [[f64; 2]; 5] = [
    [0.0, 0.0],
    [0.01, 0.0],
    [-0.01, 0.0],
    [0.0, 0.01],
    [0.0, -0.01],
];
const NAMES: [&str; 5] = ["noshear", "1p", "1m", "2p", "2m"];

/// Columns of a catalogue, by name.
type Columns = Vec<(&'static str, Vec<f64>)>;

/// The same galaxies under a shear, with a response of 0.8 on average.
fn galaxies(seed: u64, g: [f64; 2]) -> Columns {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut rows: Vec<[f64; 7]> = Vec::new();
    for id in 0..GALAXIES {
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let e = [0, 1].map(|k| 0.2 * normal() + 0.8 * ((1.0 + M[k]) * g[k] + C[k]));
        let response = [0; 2].map(|_| 0.8 + 0.2 * normal());
        let weight = rng.random_range(0.5..1.5);
        let snr = rng.random_range(5.0..50.0);
        rows.push([id as f64, e[0], e[1], weight, response[0], response[1], snr]);
    }
    let names = ["id", "e1", "e2", "w", "R11", "R22", "snr"];
    let column = |k: usize| rows.iter().map(|row| row[k]).collect();
    (0..7).map(|k| (names[k], column(k))).collect()
}

/// With true shears, and a flag on every hundredth row, whose ellipticities are missing.
fn complete(mut columns: Columns, g: [f64; 2]) -> Columns {
    let flags: Vec<f64> = (0..GALAXIES).map(|id| f64::from(id % 100 == 0)).collect();
    for (_, values) in &mut columns[1..3] {
        values.iter_mut().step_by(100).for_each(|e| *e = f64::NAN);
    }
    columns.push(("flag", flags));
    columns.push(("g1", vec![g[0]; GALAXIES]));
    columns.push(("g2", vec![g[1]; GALAXIES]));
    columns
}

/// The command fails with a message that contains `expected`.
fn refused(arguments: &[&str], expected: &str) {
    let error = fail(arguments);
    assert!(error.contains(expected), "{expected}: {error}");
}

/// The rows of the JSON table.
fn rows(arguments: &[&str]) -> Vec<Value> {
    let output = succeed(&[&["bias", "--format", "json"], arguments].concat());
    let json: Value = serde_json::from_str(&output).unwrap();
    json["rows"].as_array().unwrap().clone()
}

fn number(row: &Value, key: &str) -> f64 {
    row[key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"))
}

#[test]
fn distortions_are_noticed_and_converted() {
    let folder = tempfile::tempdir().unwrap();
    let files = [("plus", 0.05), ("minus", -0.05)].map(|(name, g)| {
        let path = folder.path().join(format!("{name}.csv"));
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut text = String::from("id,e1,e2,g1,g2\n");
        for id in 0..GALAXIES {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let shape = shearq_quantities::Shear::new(0.1 * normal(), 0.1 * normal());
            let e = shape
                .sheared_by(shearq_quantities::Shear::new(g, g))
                .to_distortion();
            writeln!(text, "{id},{},{},{g},{g}", e.e1, e.e2).unwrap();
        }
        fs::write(&path, text).unwrap();
        path
    });
    let (plus, minus) = (text(&files[0]), text(&files[1]));
    refused(&["bias", plus, minus], "look like distortions");
    let kept = &rows(&[plus, minus, "--ellipticity", "shear"])[0];
    assert!((0.9..1.0).contains(&number(kept, "m1")), "{kept}");
    let converted = &rows(&[plus, minus, "--ellipticity", "distortion"])[0];
    // The mean of sheared ellipticities is the shear for any intrinsic distribution, up to noise of the pairs.
    let (m, error) = (number(converted, "m1"), number(converted, "m1_error"));
    assert!(m.abs() < 4.0 * error && error < 2e-3, "{m} ± {error}");
    // Noise moves distortions above 1.
    for file in &files {
        let lines = fs::read_to_string(file).unwrap();
        fs::write(file, lines + "7000,0.9,0.8,0.05,0.05\n").unwrap();
    }
    let printed = succeed(&["bias", plus, minus, "--ellipticity", "distortion"]);
    assert!(
        printed.contains("Left out: 2 rows with a distortion above 1, which noise makes"),
        "{printed}"
    );
    let failed = fs::read_to_string(plus).unwrap() + "7001,-10,-10,0.05,0.05\n";
    fs::write(plus, failed).unwrap();
    refused(
        &["bias", plus, minus, "--ellipticity", "distortion"],
        "row 2002: column `e1` is -10",
    );
}

/// Catalogues of shearq state what the noise of their star does to m and c.
#[test]
fn errors_contain_the_noise_of_a_star_that_all_galaxies_share() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, format, g: f64, psf: &[(&str, &str)]| {
        let mut columns = complete(galaxies(3, [g; 2]), [g; 2]);
        columns.retain(|(name, _)| *name != "w" && *name != "snr");
        columns.push(("first_energy", vec![1.0; GALAXIES]));
        let renamed = |name: &'static str| if name == "flag" { "flags" } else { name };
        let columns = columns.into_iter();
        let columns = columns.map(|(name, values)| Column::new(renamed(name).into(), values));
        let path = folder.path().join(name);
        let metadata = psf.iter();
        let metadata = metadata.map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
        let table = frame(columns.collect()).unwrap();
        table::write(&path, format, &table, &metadata.collect()).unwrap();
        text(&path).to_owned()
    };
    let result = |of: &[String]| -> Value {
        let all: Vec<&str> = of.iter().map(String::as_str).collect();
        let found = shearq(&[&["bias"][..], &all, &["--format", "json"]].concat());
        assert!(found.status.success(), "{found:?}");
        serde_json::from_slice(&found.stdout).unwrap()
    };
    let pair = |name: &str, format, psfs: [&[(&str, &str)]; 2]| {
        let [plus, minus] = [("plus", 0.02, psfs[0]), ("minus", -0.02, psfs[1])]
            .map(|(sign, g, psf)| write(&format!("{sign}-{name}"), format, g, psf));
        result(&[plus, minus])
    };
    let noise = ("psfnoise", "3.00e-1 4.00e-3");
    let creator = ("creator", "shearq 0.2.0");
    let one: &[(&str, &str)] = &[creator, noise, ("psf", "a")];
    let other: &[(&str, &str)] = &[creator, noise, ("psf", "b")];
    let without = pair("0.parquet", FileFormat::Parquet, [&[], &[]]);
    assert!(!without["notes"].to_string().contains("star"), "{without}");
    for (name, format, psfs, [m, c], said) in [
        (
            "1.parquet",
            FileFormat::Parquet,
            [one, one],
            [0.3, 4e-3],
            "a star that several units share",
        ),
        (
            "1.fits",
            FileFormat::Fits,
            [one, one],
            [0.3, 4e-3],
            "a star that several units share",
        ),
        // Each star has half of the galaxies, and an error of c under one sign only is one of m, too.
        (
            "2.parquet",
            FileFormat::Parquet,
            [one, other],
            [
                (0.3 / 2f64.sqrt()).hypot(4e-3 / 0.02 / 2f64.sqrt()),
                (4e-3 / 2f64.sqrt()).hypot(0.3 * 0.02 / 2f64.sqrt()),
            ],
            "2 stars",
        ),
    ] {
        let found = pair(name, format, psfs);
        let notes = found["notes"].to_string();
        assert!(notes.contains(said), "{notes}");
        for (key, more) in [("m1", m), ("m2", m), ("c1", c), ("c2", c)] {
            let (row, own) = (&found["rows"][0], &without["rows"][0]);
            assert_eq!(row[key], own[key]);
            let key = format!("{key}_error");
            let expected = number(own, &key).hypot(more);
            // The two halves of the galaxies differ by their responses, 0.2/√4000 of 0.8.
            let error = number(row, &key);
            assert!(
                (error / expected - 1.0).abs() < 0.02,
                "{name} {key}: {error} {expected}"
            );
        }
    }
    // Of another program it means something else.
    let bad = [("psfnoise", "x")];
    let found = pair("3.parquet", FileFormat::Parquet, [&bad, &bad]);
    assert_eq!(found["rows"], without["rows"]);
    let bad = [creator, ("psfnoise", "x")];
    let bad = write("bad.parquet", FileFormat::Parquet, 0.02, &bad);
    refused(&["bias", &bad], "`psfnoise`");
}

/// Catalogues under ±0.02 in both components with R = [[0.8, 0.1], [0.1, 0.7]], weights and two halves of `snr`.
fn with_matrix(folder: &Path, names: [&str; 6]) -> [PathBuf; 2] {
    [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
        let mut rng = ChaCha8Rng::seed_from_u64(12);
        let mut text = format!("id,w,snr,{}\n", names.join(","));
        for id in 0..200 {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let s = [0; 2].map(|_| 0.2 * normal() + g);
            let (e1, e2) = (0.8 * s[0] + 0.1 * s[1], 0.1 * s[0] + 0.7 * s[1]);
            writeln!(text, "{id},{},{id},{e1},{e2},0.8,0.7,0.1,0.1", 1 + id % 3).unwrap();
        }
        let path = folder.join(format!("{}-{name}.csv", names[2]));
        fs::write(&path, text).unwrap();
        path
    })
}

#[test]
fn a_response_matrix_is_used_in_bins_sums_and_differences() {
    let folder = tempfile::tempdir().unwrap();
    let truth = folder.path().join("truth.csv");
    fs::write(
        &truth,
        "catalogue,g1,g2\nR11-plus.csv,0.02,0.02\nR11-minus.csv,-0.02,-0.02\nde1_dg1-plus.csv,0.02,0.02\nde1_dg1-minus.csv,-0.02,-0.02\n",
    )
    .unwrap();
    let truth = text(&truth);
    let zero = |row: &Value| {
        for key in ["m1", "m2"] {
            // The shapes are equal under both shears, so only rounding is left.
            assert!(number(row, key).abs() < 1e-12, "{row}");
        }
    };
    let files = with_matrix(folder.path(), ["e1", "e2", "R11", "R22", "R12", "R21"]);
    let [plus, minus] = [text(&files[0]), text(&files[1])];
    let options = ["--truth", truth, "--bins", "snr:2"];
    let found = rows(&[&[plus, minus], &options[..]].concat());
    assert_eq!(found.len(), 3);
    found.iter().for_each(zero);
    assert!((number(&found[0], "r12") - 0.1).abs() < 1e-12);
    // Without R12 and R21, m is 0.1/0.8 and 0.1/0.7.
    let diagonal = rows(&[
        plus,
        minus,
        "--truth",
        truth,
        "--columns",
        "R12=none,R21=none",
    ]);
    assert!(
        (number(&diagonal[0], "m1") - 0.125).abs() < 0.02,
        "{diagonal:?}"
    );
    let sums = folder.path().join("sums");
    succeed(&["bias", plus, minus, "--truth", truth, "--sums", text(&sums)]);
    zero(&rows(&["--merge", text(&sums)])[0]);
    let others = with_matrix(
        folder.path(),
        ["e1", "e2", "de1_dg1", "de2_dg2", "de1_dg2", "de2_dg1"],
    );
    let against = [text(&others[0]), text(&others[1])];
    let compared = rows(&[
        plus,
        minus,
        "--truth",
        truth,
        "--against",
        against[0],
        against[1],
    ]);
    compared.iter().for_each(zero);
}

#[test]
fn sheared_catalogues_leave_out_a_declined_matrix() {
    let folder = tempfile::tempdir().unwrap();
    let response = |g: [f64; 2]| [0.8 * g[0] + 0.3 * g[1], 0.2 * g[0] + 0.7 * g[1]];
    let catalogues = || NAMES.into_iter().zip(SHEARS);
    for by_rows in [false, true] {
        let files = [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
            let mut rng = ChaCha8Rng::seed_from_u64(37);
            let head = NAMES.map(|name| format!("g1_{name},g2_{name}"));
            let mut text = match by_rows {
                true => "id,mdet_step,wmom_g_1,wmom_g_2,g1,g2\n".to_owned(),
                false => format!("id,{},g1,g2\n", head.join(",")),
            };
            for id in 0..200 {
                let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
                let shape = [0; 2].map(|_| 0.2 * normal());
                let of = |h: [f64; 2]| response([0, 1].map(|k| shape[k] + g + h[k]));
                if by_rows {
                    for (name, [e1, e2]) in catalogues().map(|(name, h)| (name, of(h))) {
                        writeln!(text, "{id},{name},{e1},{e2},{g},{g}").unwrap();
                    }
                } else {
                    let all = SHEARS.map(of).map(|[e1, e2]| format!("{e1},{e2}"));
                    writeln!(text, "{id},{},{g},{g}", all.join(",")).unwrap();
                }
            }
            let path = folder.path().join(format!("{name}-{by_rows}.csv"));
            fs::write(&path, text).unwrap();
            path
        });
        let files = [text(&files[0]), text(&files[1])];
        let declined = ["--columns", "R12=none,R21=none"];
        for (options, expected) in [
            (&[][..], [0.0, 0.0]),
            (&declined[..], [0.3 / 0.8, 0.2 / 0.7]),
        ] {
            let found = &rows(&[&files[..], options].concat())[0];
            for (key, expected) in ["m1", "m2"].into_iter().zip(expected) {
                // The same shapes under both shears leave rounding alone.
                assert!(
                    (number(found, key) - expected).abs() < 1e-9,
                    "{by_rows}: {found}"
                );
            }
        }
    }
}

/// REGAUSS distortions of galaxies under ±0.03, some with moduli above 1, with weights and HSC's columns.
fn regauss(folder: &Path, columns: [&str; 4]) -> [PathBuf; 2] {
    [("plus", 0.03), ("minus", -0.03)].map(|(name, g)| {
        let mut rng = ChaCha8Rng::seed_from_u64(23);
        let mut text = format!("{},g1,g2\n", columns.join(","));
        for id in 0..GALAXIES {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let shape = shearq_quantities::Shear::new(0.2 * normal(), 0.2 * normal());
            let chi = shape
                .sheared_by(shearq_quantities::Shear::new(g, -g))
                .to_distortion();
            let noise = [0.3 * normal(), 0.3 * normal()];
            let (weight, rms) = (1 + id % 4, 0.36 + 0.01 * (id % 4) as f64);
            let (e1, e2) = (chi.e1 + noise[0], chi.e2 + noise[1]);
            writeln!(text, "{e1},{e2},{weight},{rms},{g},{}", -g).unwrap();
        }
        let path = folder.join(format!("{name}.csv"));
        fs::write(&path, text).unwrap();
        path
    })
}

/// A text without its line breaks.
fn words(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn mean_distortions_are_divided_by_the_responsivity() {
    let folder = tempfile::tempdir().unwrap();
    let files = regauss(
        folder.path(),
        [
            "i_hsmshaperegauss_e1",
            "i_hsmshaperegauss_e2",
            "i_hsmshaperegauss_derived_weight",
            "i_hsmshaperegauss_derived_rms_e",
        ],
    );
    let [plus, minus] = [text(&files[0]), text(&files[1])];
    // ⟨w χ⟩/(2 ⟨w⟩ (1 − ⟨w e_rms²⟩/⟨w⟩)) by plain loops.
    let (mut e, mut response, mut noisy) = ([[0.0; 2]; 2], [0.0; 2], [0.0; 2]);
    for (place, path) in files.iter().enumerate() {
        for line in fs::read_to_string(path).unwrap().lines().skip(1) {
            let values: Vec<f64> = line.split(',').map(|own| own.parse().unwrap()).collect();
            let [e1, e2, w, rms, ..] = values[..] else {
                panic!("{line}")
            };
            e[place][0] += w * e1;
            e[place][1] += w * e2;
            response[place] += 2.0 * w * (1.0 - rms * rms);
            noisy[place] += 2.0 * w * (1.0 - 0.5 * (e1 * e1 + e2 * e2) + 0.09);
        }
    }
    let expected = |response: [f64; 2]| {
        [0.03, -0.03].map(|g| {
            let k = usize::from(g < 0.0);
            (e[0][k] / response[0] - e[1][k] / response[1]) / (2.0 * g) - 1.0
        })
    };
    // The first is a ratio for each catalogue, the estimate one of both: the difference is of second order.
    let check = |row: &Value, expected: [f64; 2]| {
        for (key, expected) in ["m1", "m2"].into_iter().zip(expected) {
            let value = number(row, key);
            assert!(
                (value - expected).abs() < 1e-3,
                "{key}: {value}, {expected}"
            );
        }
    };
    check(&rows(&[plus, minus])[0], expected(response));
    let printed = succeed(&["bias", plus, minus]);
    for part in [
        "Columns: HSC Y3.",
        "rms_e=i_hsmshaperegauss_derived_rms_e",
        "e_rms from i_hsmshaperegauss_derived_rms_e",
    ] {
        assert!(words(&printed).contains(part), "{part}: {printed}");
    }
    assert!(!printed.contains("Left out"), "{printed}");
    // Without the column, the scatter of the catalogue less its noise.
    let lines = files.each_ref().map(|path| {
        let text = fs::read_to_string(path).unwrap();
        let text = text.replace(",0.36,", ",0.3,").replace(",0.37,", ",0.3,");
        let text = text.replace(",0.38,", ",0.3,").replace(",0.39,", ",0.3,");
        fs::write(path, text).unwrap();
        path
    });
    let sigma = "rms_e=none,sigma_e=i_hsmshaperegauss_derived_rms_e";
    let found = rows(&[text(lines[0]), text(lines[1]), "--columns", sigma]);
    check(&found[0], expected(noisy));
}

#[test]
fn shears_of_ksb_replace_distortions_of_minus_ten() {
    let folder = tempfile::tempdir().unwrap();
    let mean = |lines: &str| {
        let path = folder.path().join("hsm.csv");
        let head = "corrected_e1,corrected_e2,corrected_g1,corrected_g2\n";
        fs::write(&path, format!("{head}{lines}")).unwrap();
        let row = &rows(&[text(&path)])[0];
        [number(row, "c1"), number(row, "c2")]
    };
    let ksb = mean("-10,-10,0.1,0.2\n-10,-10,0.3,-0.1\n-10,-10,0.2,-0.1\n");
    assert!(
        (ksb[0] - 0.2).abs() < 1e-12 && ksb[1].abs() < 1e-12,
        "{ksb:?}"
    );
    // A distortion of 0.2 and 0.1 has a response of 2 (1 − 0.025).
    let both = mean(&"-10,-10,0.1,0.2\n0.2,0.1,-10,-10\n".repeat(20));
    assert!((both[0] - 0.3 / 2.95).abs() < 1e-12, "{both:?}");
}

#[test]
fn sheared_sizes_give_the_response_of_a_selection() {
    // As DES Y1: responses of galaxies, and only the selected quantity in sheared catalogues.
    let folder = tempfile::tempdir().unwrap();
    let files = [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
        let mut rng = ChaCha8Rng::seed_from_u64(31);
        let mut text = String::from("id,e1,e2,R11,R22,T,T_1p,T_1m,T_2p,T_2m,g1,g2\n");
        for id in 0..20_000 {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let shape = [0; 2].map(|_| 0.2 * normal());
            let size = (0.4 * normal()).exp();
            let e = shape.map(|shape| shape + g);
            let of = |h: [f64; 2]| {
                let along: f64 = (0..2).map(|k| shape[k] * (g + h[k])).sum();
                size * (1.0 + 2.0 * along)
            };
            let sizes = SHEARS.map(|h| of(h).to_string()).join(",");
            writeln!(text, "{id},{},{},1,1,{sizes},{g},{g}", e[0], e[1]).unwrap();
        }
        let path = folder.path().join(format!("{name}.csv"));
        fs::write(&path, text).unwrap();
        path
    });
    let [plus, minus] = [text(&files[0]), text(&files[1])];
    let found = &rows(&[plus, minus, "--where", "T > 1"])[0];
    for key in ["m1", "m2"] {
        let (m, error) = (number(found, key), number(found, &format!("{key}_error")));
        assert!(
            m.abs() < 4.0 * error && error < 0.02,
            "{key}: {m} ± {error}"
        );
    }
    // The response of the selection is about 2 σ² times the density of ln T at the cut over the share: 0.16.
    assert!(number(found, "r1") > 1.1, "{found}");
    let printed = shearq(&["bias", plus, minus, "--where", "T > 1"]);
    assert!(printed.stderr.is_empty());
}

/// A binary table: its name, its columns with their formats, and the bytes of its rows.
type FitsTable<'a> = (&'a str, &'a [(&'a str, &'a str)], Vec<Vec<u8>>);

fn fits(path: &Path, tables: &[FitsTable<'_>]) {
    fn padded(mut bytes: Vec<u8>, fill: u8) -> Vec<u8> {
        bytes.resize(bytes.len().next_multiple_of(2880), fill);
        bytes
    }
    let header = |cards: Vec<(String, String)>| {
        let mut text: String = cards
            .iter()
            .map(|(key, value)| format!("{:<80}", format!("{key:<8}= {value:>20}")))
            .collect();
        text += &format!("{:<80}", "END");
        padded(text.into_bytes(), b' ')
    };
    let card = |key: &str, value: &str| (key.to_owned(), value.to_owned());
    let text = |key: String, value: &str| (key, format!("'{value:<8}'"));
    let primary = [
        ("SIMPLE", "T"),
        ("BITPIX", "8"),
        ("NAXIS", "0"),
        ("EXTEND", "T"),
    ];
    let mut file = header(primary.map(|(key, value)| card(key, value)).into());
    for (name, columns, rows) in tables {
        let mut cards = vec![text("XTENSION".into(), "BINTABLE")];
        for (key, value) in [
            ("BITPIX", "8".to_owned()),
            ("NAXIS", "2".into()),
            ("NAXIS1", rows[0].len().to_string()),
            ("NAXIS2", rows.len().to_string()),
            ("PCOUNT", "0".into()),
            ("GCOUNT", "1".into()),
            ("TFIELDS", columns.len().to_string()),
        ] {
            cards.push(card(key, &value));
        }
        for (k, (column, format)) in columns.iter().enumerate() {
            cards.push(text(format!("TTYPE{}", k + 1), column));
            cards.push(text(format!("TFORM{}", k + 1), format));
        }
        cards.push(text("EXTNAME".into(), name));
        file.extend(header(cards));
        file.extend(padded(rows.concat(), 0));
    }
    fs::write(path, file).unwrap();
}

/// Rows of metadetect as its own examples write them: the sheared catalogue as text, the ellipticity as a vector of two, and an
/// identifier above 2⁵³.
#[test]
fn vectors_texts_and_long_integers_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let catalogues = || NAMES.into_iter().zip(SHEARS);
    let first = 1_000_000_000_000_000_000_i64;
    let (mut scalar, mut fits_files, mut parquet) = (Vec::new(), Vec::new(), Vec::new());
    for (name, g) in [("plus", 0.02), ("minus", -0.02)] {
        let base = galaxies(1, [g; 2]);
        let (mut rows, mut vectors, mut ids, mut names) = (vec![], vec![], vec![], vec![]);
        let mut flat = String::from("shear_type,id,wmom_g_1,wmom_g_2,g1,g2\n");
        for (sheared, shear) in catalogues() {
            for k in 0..GALAXIES {
                let e = [0, 1].map(|j| base[j + 1].1[k] + 0.8 * shear[j]);
                let mut row = format!("{sheared:<7}").into_bytes();
                row.extend((first + k as i64).to_be_bytes());
                for value in e.into_iter().chain([g, g]) {
                    row.extend(f64::to_be_bytes(value));
                }
                rows.push(row);
                vectors.push(e);
                ids.push(first + k as i64);
                names.push(sheared);
                writeln!(
                    flat,
                    "{sheared},{},{},{},{g},{g}",
                    first + k as i64,
                    e[0],
                    e[1]
                )
                .unwrap();
            }
        }
        let file = path(&format!("{name}.csv"));
        fs::write(&file, flat).unwrap();
        scalar.push(file);
        let file = path(&format!("{name}.fits"));
        let columns: &[(&str, &str)] = &[
            ("shear_type", "7A"),
            ("ID", "K"),
            ("g", "2D"),
            ("g1", "D"),
            ("g2", "D"),
        ];
        fits(&file, &[("metadetect", columns, rows)]);
        fits_files.push(file);
        let lists: Vec<Series> = vectors
            .iter()
            .map(|e| Series::new("".into(), e.as_slice()))
            .collect();
        let count = names.len();
        let table = frame(vec![
            Column::new("mdet_step".into(), names),
            Column::new("id".into(), ids),
            Column::new("wmom_g".into(), lists),
            Column::new("g1".into(), vec![g; count]),
            Column::new("g2".into(), vec![g; count]),
        ])
        .unwrap();
        let file = path(&format!("{name}.parquet"));
        table::write(&file, FileFormat::Parquet, &table, &Default::default()).unwrap();
        parquet.push(file);
    }
    let found = [scalar, fits_files, parquet].map(|files| {
        let printed = succeed(&["bias", text(&files[0]), text(&files[1])]);
        assert!(
            printed.contains("galaxies with the same identifier"),
            "{printed}"
        );
        rows(&[text(&files[0]), text(&files[1])])
    });
    // Only rounding is left of shapes and responses.
    assert!(
        (number(&found[0][0], "m1") - M[0]).abs() < 1e-9,
        "{}",
        found[0][0]
    );
    assert!((number(&found[0][0], "r1") - 0.8).abs() < 1e-9);
    assert_eq!(number(&found[0][0], "n"), 2.0 * GALAXIES as f64);
    // Identifiers that are rounded would make 16 units.
    assert!(number(&found[0][0], "units") > 500.0, "{}", found[0][0]);
    assert_eq!(found[1], found[0]);
    assert_eq!(found[2], found[0]);
}

/// Identifiers of any type join a table of true shears.
#[test]
fn long_and_textual_identifiers_join_the_truth() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let base = galaxies(3, [0.0; 2]);
    let shear = |k: usize| 0.04 * ((k % 11) as f64 / 5.0 - 1.0);
    let of = |id: &dyn Fn(usize) -> String| {
        let (mut catalogue, mut truth) = (String::from("ID,e1,e2\n"), String::from("g2,Id,g1\n"));
        for k in 0..GALAXIES {
            let e = [0, 1].map(|j| base[j + 1].1[k] / 10.0 + shear(k));
            writeln!(catalogue, "{},{},{}", id(k), e[0], e[1]).unwrap();
            let other = GALAXIES - 1 - k;
            writeln!(truth, "{},{},{}", shear(other), id(other), shear(other)).unwrap();
        }
        fs::write(path("c.csv"), catalogue).unwrap();
        fs::write(path("t.csv"), truth).unwrap();
        rows(&[text(&path("c.csv")), "--truth", text(&path("t.csv"))])
    };
    let small = of(&|k| k.to_string());
    // Shapes of 0.02 and shears of 0.025 leave 0.02/0.025/√2000.
    assert!(number(&small[0], "m1").abs() < 0.08, "{}", small[0]);
    for found in [
        of(&|k| (1_000_000_000_000_000_000 + k).to_string()),
        of(&|k| (9_223_372_036_854_775_808_u64 + k as u64).to_string()),
        of(&|k| format!("J{k:06}")),
    ] {
        // Sums in the order of other keys differ by rounding.
        assert!((number(&found[0], "m1") - number(&small[0], "m1")).abs() < 1e-9);
    }
    let lines = fs::read_to_string(path("t.csv"))
        .unwrap()
        .replace("J000007", "J000008");
    fs::write(path("t.csv"), lines).unwrap();
    refused(
        &[
            "bias",
            text(&path("c.csv")),
            "--truth",
            text(&path("t.csv")),
        ],
        "the identifier J000008 occurs twice",
    );
}

/// A file with tables of galaxies and of stars has two ellipticities.
#[test]
fn one_of_several_tables_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let columns: &[(&str, &str)] = &[("e1", "D"), ("e2", "D"), ("g1", "D"), ("g2", "D")];
    let files = [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
        let file = folder.path().join(format!("{name}.fits"));
        let base = galaxies(1, [g; 2]);
        let row = |k: usize| -> Vec<u8> {
            let e = [0, 1].map(|j| base[j + 1].1[k] / 0.8);
            e.into_iter()
                .chain([g, g])
                .flat_map(f64::to_be_bytes)
                .collect()
        };
        let stars = |k: usize| -> Vec<u8> {
            [0.05 + 1e-4 * k as f64, 0.0, g, g]
                .into_iter()
                .flat_map(f64::to_be_bytes)
                .collect()
        };
        fits(
            &file,
            &[
                ("STARS", columns, (0..300).map(stars).collect()),
                ("GALAXIES", columns, (0..GALAXIES).map(row).collect()),
            ],
        );
        text(&file).to_owned()
    });
    let error = fail(&["bias", &files[0], &files[1]]);
    for part in [
        "several tables",
        "1 `STARS`, 2 `GALAXIES`",
        "plus.fits[STARS]",
    ] {
        assert!(error.contains(part), "{error}");
    }
    let named = files.clone().map(|file| format!("{file}[GALAXIES]"));
    let found = rows(&[&named[0], &named[1]]);
    assert_eq!(number(&found[0], "n"), 2.0 * GALAXIES as f64);
    // The table of true shears names files.
    let truth = folder.path().join("truth.csv");
    fs::write(
        &truth,
        "catalogue,g1,g2\nplus.fits,0.02,0.02\nminus.fits,-0.02,-0.02\n",
    )
    .unwrap();
    assert_eq!(
        rows(&[&named[0], &named[1], "--truth", text(&truth)]),
        found
    );
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

/// The size of a galaxy under a shear that is added to `g`.
fn size(id: usize, shape: [f64; 2], g: f64, added: [f64; 2]) -> f64 {
    let along: f64 = (0..2).map(|k| shape[k] * (g + added[k])).sum();
    0.5 + (id as f64 * 0.618_034).fract() * (1.0 + 2.0 * along)
}

#[test]
fn sheared_flags_and_weights_give_their_response() {
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
            for name in &NAMES[1..] {
                write!(text, ",flags_select_{name}").unwrap();
            }
            if weighted {
                text += ",weight";
                for name in &NAMES[1..] {
                    write!(text, ",weight_{name}").unwrap();
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
        // ⟨e⟩ of each catalogue with its own choice and weights, over both catalogues.
        let mean = |catalogue: usize, k: usize| {
            let mut sums = [0.0; 2];
            for g in [0.02, -0.02] {
                for (id, shape) in shapes.iter().enumerate().filter(|(id, _)| !failed(*id)) {
                    let size = size(id, *shape, g, SHEARS[catalogue]);
                    if size >= 0.7 {
                        sums[0] += weight(size) * (shape[k] + g);
                        sums[1] += weight(size);
                    }
                }
            }
            sums[0] / sums[1]
        };
        let found = &rows(&[&files[0], &files[1]])[0];
        for k in 0..2 {
            let expected = 1.0 + (mean(1 + 2 * k, k) - mean(2 + 2 * k, k)) / 0.02;
            let r = number(found, &format!("r{}", k + 1));
            assert!((r - expected).abs() < 1e-9, "{name}: {r}, {expected}");
            // The choice matters.
            assert!((r - 1.0).abs() > 0.02, "{r}");
        }
    }
}
