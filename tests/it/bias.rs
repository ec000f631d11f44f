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

use crate::support::{fail, shearq, succeed};

const M: [f64; 2] = [0.02, -0.03];
const C: [f64; 2] = [1e-3, -2e-3];
const GALAXIES: usize = 2000;

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

fn csv(path: &Path, columns: &Columns) {
    let names: Vec<&str> = columns.iter().map(|(name, _)| *name).collect();
    let mut text = names.join(",") + "\n";
    for row in 0..columns[0].1.len() {
        let fields: Vec<String> = columns.iter().map(|(_, v)| v[row].to_string()).collect();
        writeln!(text, "{}", fields.join(",")).unwrap();
    }
    fs::write(path, text).unwrap();
}

/// Two catalogues of the same galaxies under ±0.02 in both components.
fn pair(folder: &Path) -> [PathBuf; 2] {
    [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
        let path = folder.join(format!("{name}.csv"));
        csv(&path, &complete(galaxies(1, [g; 2]), [g; 2]));
        path
    })
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
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

/// The row has the known m and c within four of its errors, which are below the limits.
fn check(row: &Value, [m_error, c_error]: [f64; 2]) {
    for k in 0..2 {
        for (of, truth, most) in [("m", M[k], m_error), ("c", C[k], c_error)] {
            let key = format!("{of}{}", k + 1);
            let (value, error) = (number(row, &key), number(row, &format!("{key}_error")));
            assert!(
                (value - truth).abs() < 4.0 * error,
                "{key}: {value} ± {error}"
            );
            assert!(error > 0.0 && error < most, "{key}: {error}");
        }
    }
}

#[test]
fn pairs_without_options_give_m_and_c_and_bins_add_rows() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = pair(folder.path());
    let files = [text(&plus), text(&minus)];
    // Shapes cancel in m: 0.2/0.8 of 1980 galaxies over √2 is 0.0040 from the scatter of the responses alone. Without
    // the pairs it would be 0.2.
    let whole = rows(&files);
    assert_eq!(whole.len(), 1);
    check(&whole[0], [0.02, 0.01]);
    assert_eq!(number(&whole[0], "n"), 2.0 * 1980.0);
    let binned = rows(&[&files[..], &["--bins", "snr:5"]].concat());
    assert_eq!(binned.len(), 6);
    for row in &binned {
        check(row, [0.04, 0.03]);
    }
    let counts: f64 = binned[1..].iter().map(|row| number(row, "n")).sum();
    assert_eq!(counts, 2.0 * 1980.0);
    for row in &binned[1..] {
        assert!((number(row, "n") - 792.0).abs() < 4.0, "{row}");
    }
    // The response of a bin is its own: expressions and edges select it.
    let edges = rows(&[&files[..], &["--bins", "10*R11:-10,8,40"]].concat());
    assert!(number(&edges[1], "r1") < 0.75 && number(&edges[2], "r1") > 0.85);
    let printed = succeed(&["bias", files[0], files[1]]);
    for part in [
        "Design: pairs",
        "galaxies with the same identifier",
        "100 rows",
    ] {
        let expected = part.replace("100 rows", "40 rows with a flag");
        assert!(printed.contains(&expected), "{expected}: {printed}");
    }
}

#[test]
fn formats_and_ways_to_state_the_truth_agree() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = pair(folder.path());
    let expected = rows(&[text(&plus), text(&minus)]);
    for format in [FileFormat::Fits, FileFormat::Parquet] {
        let files = [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
            let path = folder.path().join(format!("{name}.{}", format.extension()));
            let columns = complete(galaxies(1, [g; 2]), [g; 2]);
            let columns = columns.into_iter().map(|(n, v)| Column::new(n.into(), v));
            let table = frame(columns.collect()).unwrap();
            table::write(&path, format, &table, &Default::default()).unwrap();
            path
        });
        assert_eq!(rows(&[text(&files[0]), text(&files[1])]), expected);
    }
    let bare: Vec<PathBuf> = [("a", 0.02), ("b", -0.02)]
        .into_iter()
        .map(|(name, g)| {
            let path = folder.path().join(format!("{name}.csv"));
            let columns = complete(galaxies(1, [g; 2]), [g; 2]);
            csv(
                &path,
                &columns
                    .into_iter()
                    .filter(|(n, _)| !n.starts_with('g'))
                    .collect(),
            );
            path
        })
        .collect();
    let truth = folder.path().join("truth.csv");
    fs::write(
        &truth,
        "catalogue,g1,g2\na.csv,0.02,0.02\nb.csv,-0.02,-0.02\n",
    )
    .unwrap();
    let files = [text(&bare[0]), text(&bare[1])];
    assert_eq!(
        rows(&[&files[..], &["--truth", text(&truth)]].concat()),
        expected
    );
    // One shear: m only.
    let single = rows(&[files[0], "--g1", "0.02", "--g2", "0"]);
    assert!(single[0]["c1"].is_null() && single[0]["m2"].is_null());
    assert!(
        (number(&single[0], "m1") - M[0] - C[0] / 0.02).abs()
            < 4.0 * number(&single[0], "m1_error")
    );
    // A shear per galaxy, joined by identifier in another order.
    let ids = folder.path().join("ids.csv");
    let line = |id: usize| format!("0.02,{id},0.02\n");
    let lines: String = (0..GALAXIES).rev().map(line).collect();
    fs::write(&ids, format!("g1,id,g2\n{lines}")).unwrap();
    // A slope of 3.5σ does not determine the sign of g2.
    let joined = rows(&[files[0], "--truth", text(&ids), "--truth-sign", "standard"]);
    let constant = rows(&[files[0], "--g1", "0.02", "--g2", "0.02"]);
    assert_eq!(joined, constant);
}

#[test]
fn shards_merge_to_the_estimate_of_all_catalogues() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = pair(folder.path());
    let sums = ["1", "2"].map(|shard| folder.path().join(shard));
    for (path, shard) in sums.iter().zip(["1/2", "2/2"]) {
        let files = [text(&plus), text(&minus)];
        succeed(&[
            "bias",
            files[0],
            files[1],
            "--shard",
            shard,
            "--sums",
            text(path),
        ]);
    }
    let merged = rows(&["--merge", text(&sums[0]), text(&sums[1])]);
    check(&merged[0], [0.02, 0.01]);
    let whole = rows(&[text(&plus), text(&minus)]);
    for key in ["m1", "m2", "c1", "c2"] {
        // Sums in another order differ by rounding.
        assert!((number(&merged[0], key) - number(&whole[0], key)).abs() < 1e-9);
    }
    let one = fail(&["bias", "--merge", text(&sums[0])]);
    assert!(
        one.contains("absent: ") && one.contains("minus.csv"),
        "{one}"
    );
    refused(
        &["bias", "--merge", text(&sums[0]), text(&sums[0])],
        "in two files of sums",
    );
}

#[test]
fn limits_set_the_exit_code_and_junit() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = pair(folder.path());
    let junit = folder.path().join("bias.xml");
    let run = |limit: &str| {
        let (plus, minus) = (text(&plus), text(&minus));
        shearq(&[
            "bias",
            plus,
            minus,
            "--fail-above",
            limit,
            "--junit",
            text(&junit),
        ])
    };
    assert!(run("m=0.2@3sigma").status.success());
    assert!(
        fs::read_to_string(&junit)
            .unwrap()
            .contains("failures=\"0\"")
    );
    let failed = run("m2=0.001");
    assert_eq!(failed.status.code(), Some(1));
    let message = String::from_utf8(failed.stderr).unwrap();
    assert!(
        message.contains("error: |m2| exceeds its limit"),
        "{message}"
    );
    assert!(
        fs::read_to_string(&junit)
            .unwrap()
            .contains("failures=\"1\"")
    );
}

#[test]
fn versions_of_metadetect_give_the_response() {
    let folder = tempfile::tempdir().unwrap();
    let mut files = Vec::new();
    for (name, g) in [("plus", 0.02), ("minus", -0.02)] {
        let base = galaxies(1, [g; 2]);
        let (mut versions, mut e1, mut e2, mut ids) =
            (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (version, shear) in [
            ("noshear", [0.0, 0.0]),
            ("1p", [0.01, 0.0]),
            ("1m", [-0.01, 0.0]),
            ("2p", [0.0, 0.01]),
            ("2m", [0.0, -0.01]),
        ] {
            versions.extend(vec![version; GALAXIES]);
            ids.extend(base[0].1.iter().copied());
            e1.extend(base[1].1.iter().map(|e| e + 0.8 * shear[0]));
            e2.extend(base[2].1.iter().map(|e| e + 0.8 * shear[1]));
        }
        let path = folder.path().join(format!("{name}.parquet"));
        let table = frame(vec![
            Column::new("id".into(), ids),
            Column::new("mdet_step".into(), versions),
            Column::new("wmom_g_1".into(), e1),
            Column::new("wmom_g_2".into(), e2),
            Column::new("g1".into(), vec![g; 5 * GALAXIES]),
            Column::new("g2".into(), vec![g; 5 * GALAXIES]),
        ])
        .unwrap();
        table::write(&path, FileFormat::Parquet, &table, &Default::default()).unwrap();
        files.push(path);
    }
    let found = &rows(&[text(&files[0]), text(&files[1])])[0];
    assert!((number(found, "r1") - 0.8).abs() < 1e-9, "{found}");
    // Only rounding is left of shapes and responses.
    assert!((number(found, "m1") - M[0]).abs() < 1e-9, "{found}");
    assert_eq!(number(found, "n"), 2.0 * GALAXIES as f64);
    let printed = succeed(&["bias", text(&files[0]), text(&files[1])]);
    assert!(printed.contains("Columns: metadetect."), "{printed}");
}

#[test]
fn plots_and_reports_are_written() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = pair(folder.path());
    let [plot, report] = ["m.svg", "r.html"].map(|name| folder.path().join(name));
    let (plus, minus) = (text(&plus), text(&minus));
    succeed(&[
        "bias",
        plus,
        minus,
        "--bins",
        "snr:3",
        "--plot",
        text(&plot),
        "--report",
        text(&report),
    ]);
    let drawn = fs::read_to_string(plot).unwrap();
    assert!(drawn.contains("Multiplicative bias"), "{drawn}");
    // The legend has each symbol once, and the requirement is a band in both panels.
    for label in ["m1, c1", "m2, c2", "requirement"] {
        assert_eq!(drawn.matches(label).count(), 1, "{label}");
    }
    assert_eq!(drawn.matches("opacity=\"0.3\"").count(), 3, "{drawn}");
    let page = fs::read_to_string(report).unwrap();
    assert!(page.contains("Mandelbaum et al. 2014") && page.contains("plus.csv"));
    refused(
        &["bias", plus, minus, "--plot", "m.pdf"],
        "expected the extension",
    );
}

/// A pair with columns changed in the first catalogue.
fn changed(folder: &Path, change: impl Fn(&mut Columns)) -> [PathBuf; 2] {
    let files = pair(folder);
    let mut columns = complete(galaxies(1, [0.02; 2]), [0.02; 2]);
    change(&mut columns);
    csv(&files[0], &columns);
    files
}

#[test]
fn bad_catalogues_give_one_clear_error() {
    let set = |name: &'static str, value: fn(usize, f64) -> f64| {
        move |columns: &mut Columns| {
            for (_, values) in columns.iter_mut().filter(|(own, _)| *own == name) {
                for (row, own) in values.iter_mut().enumerate() {
                    *own = value(row, *own);
                }
            }
        }
    };
    let folder = tempfile::tempdir().unwrap();
    let nothing = |_: &mut Columns| {};
    // Of other galaxies, and of another catalogue.
    let [ids, other] = ["ids.csv", "other.csv"].map(|name| folder.path().join(name));
    fs::write(&ids, "id,g1,g2\n1,0.02,0\n2,-0.02,0\n").unwrap();
    fs::write(&other, "catalogue,g1,g2\nother.csv,0.02,0\n").unwrap();
    let [ids, other] = [text(&ids), text(&other)].map(|table| ["--truth", table]);
    let same_e1 = set("e1", |_, _| 0.1);
    let (no_weight, negative_weight) = (set("w", |_, _| 0.0), set("w", |_, _| -1.0));
    let all_flagged = set("flag", |_, _| 1.0);
    let one_left = set("flag", |row, _| f64::from(row != 7));
    let missing = set("e2", |row, e| if row == 41 { f64::NAN } else { e });
    let no_response = set("R11", |_, r| r - 0.8);
    let no_shear = set("g1", |_, _| 2.0);
    type Case<'a> = (&'a dyn Fn(&mut Columns), &'a [&'a str], usize, &'a str);
    let cases: [Case<'_>; 14] = [
        (&same_e1, &[], 1, "e1 is 0.1 in all"),
        (
            &no_weight,
            &[],
            1,
            "20 with a flag, 1980 with a weight of zero or less",
        ),
        (&negative_weight, &[], 1, "no galaxy can be used"),
        (&all_flagged, &[], 1, "(found 2000 rows: 2000 with a flag"),
        (&one_left, &[], 1, "found 1, expected 2"),
        (&missing, &[], 2, "row 42: e2 is NaN"),
        (
            &no_response,
            &[],
            1,
            "mean response R11 is too close to zero",
        ),
        (&no_shear, &[], 2, "row 2: this is no shear (found g1 2"),
        (
            &nothing,
            &["--bins", "flux/snr:3"],
            2,
            "there is no column `flux`",
        ),
        (
            &nothing,
            &["--where", "sn > 3"],
            2,
            "there is no column `sn`",
        ),
        (
            &nothing,
            &["--columns", "w=weight"],
            2,
            "there is no column `weight`",
        ),
        (
            &nothing,
            &["--truth-sign", "challenge"],
            2,
            "e2 follows minus the true g2",
        ),
        (&nothing, &ids, 1, "does not contain the identifier 3"),
        (
            &nothing,
            &other,
            1,
            "does not contain this catalogue (found other.csv;",
        ),
    ];
    for (change, more, count, expected) in cases {
        let files = changed(folder.path(), change);
        let files = [text(&files[0]), text(&files[1])];
        let error = fail(&[&["bias"], &files[..count], more].concat());
        assert!(error.contains(expected), "{expected}: {error}");
        assert_eq!(error.lines().count(), 1, "{error}");
    }
}

#[test]
fn missing_numbers_can_be_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = changed(folder.path(), |columns| columns[1].1[41] = f64::NAN);
    let found = &rows(&[text(&plus), text(&minus), "--drop-missing"])[0];
    assert_eq!(number(found, "n"), 2.0 * 1980.0 - 1.0);
    check(found, [0.02, 0.01]);
}

/// One in a hundred rows has a number for a failure in both catalogues.
#[test]
fn numbers_for_failures_are_refused_and_can_be_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let written = |column: &str, failure: f64| {
        [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
            let path = folder.path().join(format!("{name}.csv"));
            let mut columns = complete(galaxies(1, [g; 2]), [g; 2]);
            for part in ["psf_e1", "psf_e2", "psf_size"] {
                let value =
                    |k: usize| if part == "psf_size" { 3.1 } else { 0.1 } + 1e-3 * (k % 97) as f64;
                columns.push((part, (0..GALAXIES).map(value).collect()));
            }
            for (_, values) in columns.iter_mut().filter(|(own, _)| *own == column) {
                values
                    .iter_mut()
                    .skip(50)
                    .step_by(100)
                    .for_each(|own| *own = failure);
            }
            csv(&path, &columns);
            path
        })
    };
    for (column, failure, shown) in [
        ("e1", -10.0, "-10"),
        ("e2", -99.0, "-99"),
        ("e1", -9999.0, "-9999"),
        ("e2", 1e20, "1e20"),
        ("e1", -1e30, "-1e30"),
        ("R11", -99.0, "-99"),
        ("R22", 1e30, "1e30"),
        ("w", 1e30, "1e30"),
        ("psf_e1", -10.0, "-10"),
        ("psf_size", -1.0, "-1"),
        ("psf_size", 0.0, "0"),
    ] {
        let [plus, minus] = written(column, failure);
        let files = [text(&plus), text(&minus)];
        let error = fail(&["bias", files[0], files[1]]);
        let expected = format!("plus.csv: row 51: column `{column}` is {shown} in a row without");
        assert!(
            error.contains(&expected) && error.contains("--drop-missing"),
            "{error}"
        );
        let found = &rows(&[files[0], files[1], "--drop-missing"])[0];
        assert_eq!(number(found, "n"), 2.0 * 1960.0);
        check(found, [0.02, 0.01]);
        let printed = succeed(&["bias", files[0], files[1], "--drop-missing"]);
        assert!(
            printed.contains("40 rows with numbers that stand for failed"),
            "{printed}"
        );
    }
    // Numbers that may be measured count, and are reported if rows share them.
    for (column, value, reported) in [
        ("e1", 21.6099, ""),
        ("R11", 0.0, ""),
        ("e1", 0.0, ""),
        (
            "both",
            0.0,
            "`e1` and `e2` are exactly 0 and 0 in 40 of 4000 rows",
        ),
    ] {
        let [plus, minus] = match column {
            "both" => {
                let mut files = written("e1", value);
                for file in &mut files {
                    let lines = fs::read_to_string(&*file).unwrap();
                    let zero = |(k, line): (usize, &str)| match k % 100 == 51 {
                        true => {
                            let mut fields: Vec<&str> = line.split(',').collect();
                            fields[2] = "-0";
                            fields.join(",") + "\n"
                        }
                        false => format!("{line}\n"),
                    };
                    let lines: String = lines.lines().enumerate().map(zero).collect();
                    fs::write(&*file, lines).unwrap();
                }
                files
            }
            column => written(column, value),
        };
        let printed = succeed(&["bias", text(&plus), text(&minus)]);
        match reported {
            "" => assert!(!printed.contains("are exactly"), "{printed}"),
            line => assert!(printed.contains(line), "{printed}"),
        }
    }
}

/// Measured shears that are also the true ones would have m = 0.
#[test]
fn measured_columns_are_not_the_true_shear() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = pair(folder.path());
    let files = [text(&plus), text(&minus)];
    let error = fail(&["bias", files[0], files[1], "--columns", "e1=g1,e2=g2"]);
    assert!(
        error.contains("`g1` is given as e1, so the true shear is unknown"),
        "{error}"
    );
    refused(
        &[
            "bias",
            files[0],
            files[1],
            "--columns",
            "e1=g1,e2=g2,g1=g1,g2=g2",
        ],
        "column `g1` is given as e1 and as g1",
    );
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

/// The true shear of galaxies is found by their positions, whatever their order.
#[test]
fn the_truth_is_joined_by_position() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let truth = |k: usize| {
        if k.is_multiple_of(2) {
            [0.05, -0.02]
        } else {
            [-0.03, 0.04]
        }
    };
    let mut catalogue = String::from("x,y,e1,e2\n");
    let mut places = vec![String::new(); 400];
    for k in 0..400 {
        let (x, y, g) = (
            24.5 + 48.0 * (k % 20) as f64,
            24.5 + 48.0 * (k / 20) as f64,
            truth(k),
        );
        let noise = 0.001 * ((k * 7919 % 1000) as f64 / 1000.0 - 0.5);
        // Positions differ by less than a pixel.
        writeln!(
            catalogue,
            "{},{},{},{}",
            x + 0.4,
            y - 0.5,
            1.02 * g[0] + noise,
            0.97 * g[1] - noise
        )
        .unwrap();
        places[(k * 37) % 400] = format!("{x},{y},{},{}", g[0], g[1]);
    }
    fs::write(path("c.csv"), &catalogue).unwrap();
    let table = |sign: &str, rows: &[String]| format!("x,y,g1,g2\n{sign}{}\n", rows.join("\n"));
    fs::write(path("truth.csv"), table("", &places)).unwrap();
    let rows = rows(&[text(&path("c.csv")), "--truth", text(&path("truth.csv"))]);
    for (key, expected) in [("m1", 0.02), ("m2", -0.03)] {
        // The noise of 400 galaxies of 0.0003 and shears of 0.03 leaves 0.0005.
        let found = rows[0][key].as_f64().unwrap();
        assert!((found - expected).abs() < 2e-3, "{key} {found}");
    }
    // The sign that the file states is applied.
    fs::write(path("signed.csv"), table("# g2sign: challenge\n", &places)).unwrap();
    refused(
        &[
            "bias",
            text(&path("c.csv")),
            "--truth",
            text(&path("signed.csv")),
        ],
        "e2 follows minus the true g2",
    );
    // A galaxy that the truth does not have.
    fs::write(path("less.csv"), table("", &places[1..])).unwrap();
    let (own, part) = (path("c.csv"), path("less.csv"));
    let less = ["bias", text(&own), "--truth", text(&part)];
    refused(&less, "within 1 pixel of x = ");
    succeed(&[&less[..], &["--drop-missing"]].concat());
    fs::write(path("nowhere.csv"), catalogue.replacen("x,y", "p,q", 1)).unwrap();
    refused(
        &[
            "bias",
            text(&path("nowhere.csv")),
            "--truth",
            text(&path("truth.csv")),
        ],
        "no positions to find the true shear with",
    );
}

/// From the simulation of pairs to m and c, without a table of shears.
#[test]
fn folders_of_constant_shear_are_recognised_as_pairs() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let data = path("data");
    succeed(&[
        "simulate",
        "--sets",
        "8",
        "--images",
        "2",
        "--grid",
        "10",
        "--constant-shear=0.03,-0.02",
        "--opposite",
        "--out",
        &data,
    ]);
    let mut measured = Vec::new();
    for version in ["g1_+0.03_g2_-0.02", "g1_-0.03_g2_+0.02"] {
        let (from, to) = (format!("{data}/{version}"), path(version));
        succeed(&[
            "measure",
            "--submission",
            "48/linear/star",
            "--data",
            &from,
            "--out",
            &to,
        ]);
        measured.push(to);
    }
    let all: Vec<&str> = measured.iter().map(String::as_str).collect();
    let found = shearq(&[&["bias"][..], &all, &["--format", "json"]].concat());
    let found: Value = serde_json::from_slice(&found.stdout).unwrap();
    let row = &found["rows"][0];
    assert_eq!(row["n"], 400.0);
    for key in ["m1", "m2"] {
        // Shape noise cancels in pairs: 200 galaxies at S/N 40 leave 0.05/√200/0.02.
        let m = row[key].as_f64().unwrap();
        let error = row[format!("{key}_error")].as_f64().unwrap();
        assert!(m.abs() < 5.0 * error && error < 0.3, "{row}");
    }
    assert!(found["notes"].to_string().contains("pairs"), "{found}");
    // A rotated version has the same noise, and the opposite shapes.
    let out = path("turned");
    succeed(&[
        "simulate",
        "--sets",
        "8",
        "--images",
        "1",
        "--grid",
        "8",
        "--constant-shear",
        "0,0",
        "--rotated",
        "--out",
        &out,
    ]);
    let shapes =
        |name: &str| fs::read_to_string(format!("{out}/{name}/set08/intrinsic-001.csv")).unwrap();
    let numbers = |text: String| -> Vec<f64> {
        let fields = text.lines().skip(1).flat_map(|line| {
            line.split(',')
                .skip(2)
                .map(str::to_owned)
                .collect::<Vec<_>>()
        });
        fields.filter_map(|field| field.parse().ok()).collect()
    };
    let (plain, turned) = (
        numbers(shapes("g1_+0_g2_+0")),
        numbers(shapes("g1_+0_g2_+0_rotated")),
    );
    // Ellipticities before and after lensing.
    assert_eq!(plain.len(), 256);
    assert!(
        plain.iter().zip(&turned).all(|(a, b)| *a == -b),
        "{plain:?} {turned:?}"
    );
    let plain_folder = path("g1_+0.03_g2_-0.02");
    fs::remove_file(format!("{plain_folder}/run.json")).unwrap();
    refused(&["bias", &plain_folder], "this folder has no run.json");
    refused(
        &[
            "simulate",
            "--sets",
            "8",
            "--images",
            "1",
            "--constant-shear",
            "2,0",
            "--out",
            &out,
        ],
        "the constant shear is 2, 0",
    );
    let twice = [
        "--constant-shear",
        "0.02,0",
        "--constant-shear=-0.02,0",
        "--opposite",
    ];
    refused(
        &[
            &["simulate", "--sets", "8", "--images", "1", "--out", &out][..],
            &twice,
        ]
        .concat(),
        "asked for twice",
    );
}

/// Catalogues of shearq state what the noise of their star does to m and c.
#[test]
fn errors_contain_the_noise_of_a_star_that_all_galaxies_share() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, format, g: f64, psf: &[(&str, &str)]| {
        let mut columns = complete(galaxies(3, [g; 2]), [g; 2]);
        columns.retain(|(name, _)| *name != "w" && *name != "snr");
        for divisor in ["divisor1", "divisor2"] {
            columns.push((divisor, vec![1.0; GALAXIES]));
        }
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

/// Two programs that measure the same galaxies with the same intrinsic scatter differ by less than either is uncertain.
#[test]
fn differences_of_two_programs_have_paired_errors() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, change: f64| {
        let mut columns = complete(galaxies(7, [0.03, 0.01]), [0.03, 0.01]);
        columns[1].1.iter_mut().for_each(|e| *e += change);
        let path = folder.path().join(name);
        csv(&path, &columns);
        path.display().to_string()
    };
    let (first, second) = (write("a.csv", 0.0), write("b.csv", 0.008));
    let found = rows(&[&first, "--against", &second]);
    let value = |row: usize, key: &str| found[row][key].as_f64().unwrap();
    assert_eq!(found.len(), 3);
    assert_eq!(found[2]["of"], "difference");
    // e1 of the second is higher by 0.008, which is a shear of 0.01 after division by the response of 0.8: a third of
    // the true shear.
    let (m, error) = (value(2, "m1"), value(2, "m1_error"));
    assert!((m + 1.0 / 3.0).abs() < 5.0 * error + 0.01, "{m} {error}");
    assert!((value(0, "m1") - value(1, "m1") - m).abs() < 1e-12);
    // The scatter of 0.2 is common; only the response scatters.
    assert!(error < 0.1 * value(0, "m1_error"), "{error}");
    assert!(value(2, "m2").abs() < 1e-12 && value(2, "m2_error") < 1e-12);
    // Edges of equally many galaxies agree for a column that both share.
    let binned = rows(&[&first, "--against", &second, "--bins", "snr:3"]);
    assert_eq!(binned.len(), 12);
    refused(
        &["bias", &first, "--against", &second, "--bins", "e1:3"],
        "truth or bins differ",
    );
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
fn sheared_versions_leave_out_a_declined_matrix() {
    let folder = tempfile::tempdir().unwrap();
    let response = |g: [f64; 2]| [0.8 * g[0] + 0.3 * g[1], 0.2 * g[0] + 0.7 * g[1]];
    let versions = [
        ("noshear", [0.0, 0.0]),
        ("1p", [0.01, 0.0]),
        ("1m", [-0.01, 0.0]),
        ("2p", [0.0, 0.01]),
        ("2m", [0.0, -0.01]),
    ];
    for by_rows in [false, true] {
        let files = [("plus", 0.02), ("minus", -0.02)].map(|(name, g)| {
            let mut rng = ChaCha8Rng::seed_from_u64(37);
            let head = versions.map(|(version, _)| format!("g1_{version},g2_{version}"));
            let mut text = match by_rows {
                true => "id,mdet_step,wmom_g_1,wmom_g_2,g1,g2\n".to_owned(),
                false => format!("id,{},g1,g2\n", head.join(",")),
            };
            for id in 0..200 {
                let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
                let shape = [0; 2].map(|_| 0.2 * normal());
                let of = |h: [f64; 2]| response([0, 1].map(|k| shape[k] + g + h[k]));
                let all = versions.map(|(version, h)| (version, of(h)));
                if by_rows {
                    for (version, [e1, e2]) in all {
                        writeln!(text, "{id},{version},{e1},{e2},{g},{g}").unwrap();
                    }
                } else {
                    let all = all.map(|(_, [e1, e2])| format!("{e1},{e2}"));
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
fn a_selection_without_its_response_is_always_noted() {
    let folder = tempfile::tempdir().unwrap();
    let [plus, minus] = pair(folder.path());
    let said = |select: &str| {
        let output = shearq(&["bias", text(&plus), text(&minus), "--where", select]);
        String::from_utf8(output.stderr).unwrap()
    };
    let warning = said("snr > 20");
    for part in ["a choice by `snr`", "−0.11", "snr_1p"] {
        assert!(warning.contains(part), "{part}: {warning}");
    }
    assert_eq!(said("id > 20"), "");
}

#[test]
fn sizes_of_versions_give_the_response_of_a_selection() {
    // As DES Y1: responses of galaxies, and only the selected quantity in sheared versions.
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
            let versions = [
                [0.0; 2],
                [0.01, 0.0],
                [-0.01, 0.0],
                [0.0, 0.01],
                [0.0, -0.01],
            ];
            let sizes = versions.map(|h| of(h).to_string()).join(",");
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

#[test]
fn an_unused_weight_of_zero_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("c.csv");
    fs::write(&path, "e1,e2,my_weight\n0.1,0.2,1\n0.2,0.1,0\n0.3,0.3,2\n").unwrap();
    refused(
        &["bias", text(&path)],
        "row 2: `my_weight` looks like a weight",
    );
    let used = rows(&[text(&path), "--columns", "w=my_weight"]);
    assert_eq!(number(&used[0], "n"), 2.0);
    let declined = rows(&[text(&path), "--columns", "w=none"]);
    assert_eq!(number(&declined[0], "n"), 3.0);
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

/// Rows of metadetect as its own examples write them: the version as text, the ellipticity as a vector of two, and an
/// identifier above 2⁵³.
#[test]
fn vectors_texts_and_long_integers_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let versions = [
        ("noshear", [0.0, 0.0]),
        ("1p", [0.01, 0.0]),
        ("1m", [-0.01, 0.0]),
        ("2p", [0.0, 0.01]),
        ("2m", [0.0, -0.01]),
    ];
    let first = 1_000_000_000_000_000_000_i64;
    let (mut scalar, mut fits_files, mut parquet) = (Vec::new(), Vec::new(), Vec::new());
    for (name, g) in [("plus", 0.02), ("minus", -0.02)] {
        let base = galaxies(1, [g; 2]);
        let (mut rows, mut vectors, mut ids, mut names) = (vec![], vec![], vec![], vec![]);
        let mut flat = String::from("shear_type,id,wmom_g_1,wmom_g_2,g1,g2\n");
        for (version, shear) in versions {
            for k in 0..GALAXIES {
                let e = [0, 1].map(|j| base[j + 1].1[k] + 0.8 * shear[j]);
                let mut row = format!("{version:<7}").into_bytes();
                row.extend((first + k as i64).to_be_bytes());
                for value in e.into_iter().chain([g, g]) {
                    row.extend(f64::to_be_bytes(value));
                }
                rows.push(row);
                vectors.push(e);
                ids.push(first + k as i64);
                names.push(version);
                writeln!(
                    flat,
                    "{version},{},{},{},{g},{g}",
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
