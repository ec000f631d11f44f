//! Scoring, packing, checking and ranking of GREAT3 and GREAT08 through the binary.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use shearq_quantities::Shear;
use shearq_results::published::{CHALLENGES, Challenge};
use shearq_scoring::aperture::{Lattice, LatticeShear};
use shearq_scoring::great3::Observation;

use crate::support::{fail, shearq, succeed, text};

const CASES: &str = "scoring/tests/data/great3";

fn json(arguments: &[&str]) -> Value {
    serde_json::from_str(&succeed(arguments)).unwrap()
}

fn file(folder: &Path, name: &str, content: &str) -> PathBuf {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(&path, content).unwrap();
    path
}

// The rows of a compressed file of a case.
fn rows(path: &Path) -> Vec<Vec<f64>> {
    let text = flate2::read::GzDecoder::new(fs::File::open(path).unwrap());
    let text = std::io::read_to_string(text).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines
        .map(|line| {
            let numbers = line.split_whitespace().map(|word| word.parse().unwrap());
            numbers.collect()
        })
        .collect()
}

#[test]
fn json_has_the_figures_of_the_challenge() {
    for case in [
        "p1_control_ground",
        "p2_multiepoch_space",
        "p3_full_ground",
        "p4_control_ground",
        "p5_full_space",
    ] {
        let path = |name: &str| format!("{CASES}/{case}/{name}");
        let expected: Value =
            serde_json::from_str(&fs::read_to_string(path("expected.json")).unwrap()).unwrap();
        let (truth, psf, submission) = (
            path("truth.txt.gz"),
            path("psf.txt.gz"),
            path("submission.txt.gz"),
        );
        let branch = expected["branch"].as_str().unwrap();
        let mut arguments = vec![
            "score",
            "--challenge",
            "great3",
            "--branch",
            branch,
            "--truth",
            &truth,
        ];
        if branch.ends_with("constant") {
            arguments.extend(["--psf", &psf]);
        }
        arguments.extend([submission.as_str(), "--format", "json"]);
        let found = json(&arguments);
        for (key, value) in expected.as_object().unwrap() {
            match value.as_f64() {
                None => assert_eq!(&found[key], value),
                Some(value) => {
                    let off = (found[key].as_f64().unwrap() / value - 1.0).abs();
                    assert!(off < 1e-9, "{case}: {key}: {} {value}", found[key]);
                }
            }
        }
        let first = found
            .as_object()
            .unwrap()
            .keys()
            .find(|key| key.starts_with("jackknife"));
        assert!(found[first.unwrap()].as_f64().unwrap() > 0.0);
        // The table shows the same figures.
        arguments.truncate(arguments.len() - 2);
        assert!(succeed(&arguments).contains(branch));
    }
}

#[test]
fn released_folders_score_like_tables() {
    let folder = tempfile::tempdir().unwrap();
    for (case, branch) in [
        ("p1_control_ground", "control-ground-constant"),
        ("p2_multiepoch_space", "multiepoch-space-constant"),
        ("p3_full_ground", "full-ground-constant"),
    ] {
        let case = Path::new(CASES).join(case);
        let below = format!(
            "{case}/{branch}",
            case = case.file_name().unwrap().to_str().unwrap()
        )
        .replace('-', "/");
        let truth = rows(&case.join("truth.txt.gz"));
        let per_field = 200 / truth.len();
        for subfield in 0..200 {
            let [_, g1, g2] = truth[subfield / per_field][..] else {
                panic!()
            };
            // Both formats that the challenge wrote, and both styles of YAML.
            let (ending, content) = match subfield % 3 {
                0 => ("yaml", format!("{{g1: {g1}, g2: {g2}}}\n")),
                1 => ("yaml", format!("g1: {g1}\ng2: {g2}\n")),
                _ => ("txt", format!("# g1 g2 \n{g1} {g2} \n")),
            };
            file(
                folder.path(),
                &format!("{below}/shear_params-{subfield:03}.{ending}"),
                &content,
            );
        }
        for row in rows(&case.join("psf.txt.gz")) {
            let name = format!("{below}/starshape_parameters-{:03}-{}.yaml", row[0], row[1]);
            let content = format!(
                "{{epoch_index: {}, psf_g1: {}, psf_g2: {}, subfield_index: {}}}\n",
                row[1], row[2], row[3], row[0]
            );
            file(folder.path(), &name, &content);
        }
        let root = folder.path().join(case.file_name().unwrap());
        let (table, psf, submission) = (
            case.join("truth.txt.gz"),
            case.join("psf.txt.gz"),
            case.join("submission.txt.gz"),
        );
        let score = |truth: &[&str]| {
            let mut arguments = vec![
                "score",
                "--challenge",
                "great3",
                "--branch",
                branch,
                text(&submission),
                "--format",
                "json",
                "--truth",
            ];
            arguments.extend(truth);
            succeed(&arguments)
        };
        assert_eq!(
            score(&[text(&root)]),
            score(&[text(&table), "--psf", text(&psf)])
        );
    }
}

// The catalogue of a small branch: identities, shears and weights.
fn catalogue(subfields: usize, grid: usize, constant: bool) -> Vec<(usize, Shear, f64)> {
    let mut galaxies = Vec::new();
    for k in 0..subfields * grid * grid {
        let (subfield, x, y) = (k / (grid * grid), k / grid % grid, k % grid);
        // Subfields of a field have different offsets.
        let place = |at: usize, offset: usize| if constant { at } else { 7 * at + offset % 7 };
        let id = subfield * 1_000_000 + place(x, subfield) * 1000 + place(y, subfield / 3);
        let wave = |rate: f64| 0.1 * (k as f64 * rate).sin();
        galaxies.push((
            id,
            Shear::new(wave(0.7), wave(1.3)),
            0.5 + (k % 5) as f64 / 4.0,
        ));
    }
    galaxies
}

fn lines(galaxies: &[(usize, Shear, f64)]) -> Vec<String> {
    let line = |(id, g, w): &(usize, Shear, f64)| format!("{id:09} {} {} {w}", g.e1, g.e2);
    galaxies.iter().map(line).collect()
}

#[test]
fn pack_averages_fields_and_its_result_is_sound() {
    let folder = tempfile::tempdir().unwrap();
    let mut galaxies = catalogue(200, 2, true);
    // Without g1, and without both.
    galaxies[1].1.e1 = 9.95;
    galaxies[6].1 = Shear::new(10.0, f64::NAN);
    let half = galaxies.len() / 2;
    let first = file(folder.path(), "a.txt", &lines(&galaxies[half..]).join("\n"));
    let csv = lines(&galaxies[..half]).join("\n").replace(' ', ",");
    let second = file(
        folder.path(),
        "b.csv",
        &format!(
            "w2,ID,g1,g2,weight\n{}",
            csv.replace('\n', "\n7,").replacen("", "7,", 1)
        ),
    );
    let out = folder.path().join("out.txt");
    for whole in [false, true] {
        let mut arguments = vec![
            "pack",
            "--challenge",
            "great3",
            "--branch",
            "control-space-constant",
            "--grid",
            "2",
            "--out",
            text(&out),
            text(&first),
            text(&second),
        ];
        if whole {
            arguments.push("--whole-galaxies");
        }
        succeed(&arguments);
        let packed = fs::read_to_string(&out).unwrap();
        let mean = |field: usize, of: fn(&Shear) -> f64| {
            let own = galaxies[4 * field..4 * field + 4].iter();
            let own = own.filter(|own| of(&own.1) < 9.9 && !(whole && own.1.e1 >= 9.9));
            let (sum, weight) = own.fold((0.0, 0.0), |(s, w), own| {
                (s + own.2 * of(&own.1), w + own.2)
            });
            sum / weight
        };
        for (field, line) in packed.lines().skip(1).enumerate() {
            let own: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
            assert_eq!(own[0], field as f64);
            for (found, expected) in [
                (own[1], mean(field, |g| g.e1)),
                (own[2], mean(field, |g| g.e2)),
            ] {
                assert!((found - expected).abs() < 1e-15, "{line} {expected}");
            }
        }
        assert_eq!(packed.lines().count(), 201);
        succeed(&[
            "check",
            text(&out),
            "--challenge",
            "great3",
            "--branch",
            "control-space-constant",
        ]);
    }
}

#[test]
fn pack_writes_aperture_masses_that_score_the_ceiling() {
    let folder = tempfile::tempdir().unwrap();
    let galaxies = catalogue(200, 3, false);
    let path = file(folder.path(), "galaxies.txt", &lines(&galaxies).join("\n"));
    let out = folder.path().join("out.txt");
    let branch = [
        "--challenge",
        "great3",
        "--branch",
        "variable_psf-ground-variable",
    ];
    let pack = [
        &["pack"][..],
        &branch,
        &["--grid", "3", "--out", text(&out), text(&path)],
    ]
    .concat();
    succeed(&pack);
    succeed(&[&["check", text(&out)][..], &branch].concat());
    let mut field = LatticeShear::new(Lattice::GREAT3).unwrap();
    for (id, g, w) in &galaxies[9 * 20 * 4..9 * 20 * 5] {
        field.add((id / 1000 % 1000, id % 1000), *g, *w).unwrap();
    }
    let expected = field.correlations_by_pairs().aperture_mass();
    let packed = fs::read_to_string(&out).unwrap();
    for (b, line) in packed.lines().skip(1 + 15 * 4).take(15).enumerate() {
        let own: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
        assert_eq!(own[0], 4.0);
        for (found, expected) in [
            (own[1], expected.theta[b]),
            (own[2], expected.map_e[b]),
            (own[3], expected.map_b[b]),
            (own[4], expected.error[b]),
        ] {
            assert!(
                (found - expected).abs() < 1e-12 * expected.abs().max(1e-5),
                "{line} {expected}"
            );
        }
    }
    let score = [
        &[
            "score",
            "--truth",
            text(&out),
            text(&out),
            "--format",
            "json",
        ][..],
        &branch,
    ]
    .concat();
    let q = json(&score)["Q_v"].as_f64().unwrap();
    assert!((q - 1.837e-4 / 9e-8).abs() < 1e-6);
}

#[test]
fn released_galaxies_make_the_truth_of_variable_shear() {
    let folder = tempfile::tempdir().unwrap();
    let galaxies = catalogue(20, 3, false);
    let intrinsic = |k: usize| Shear::new(0.2 * (k as f64).sin(), 0.2 * (k as f64).cos());
    let sheared = galaxies
        .iter()
        .enumerate()
        .map(|(k, own)| (own.0, intrinsic(k).sheared_by(own.1), 1.0));
    let sheared: Vec<_> = sheared.collect();
    for subfield in 0..20 {
        let range = 9 * subfield..9 * subfield + 9;
        let own = || range.clone();
        let columns = [
            own().map(|k| galaxies[k].0 as f64).collect::<Vec<f64>>(),
            own().map(|k| galaxies[k].1.e1).collect(),
            own().map(|k| galaxies[k].1.e2).collect(),
            own().map(|k| intrinsic(k).e1).collect(),
            own().map(|k| intrinsic(k).e2).collect(),
        ];
        let names = ["ID", "g1", "g2", "g1_intrinsic", "g2_intrinsic"];
        let columns = names.iter().zip(columns);
        let columns = columns.map(|(name, values)| {
            shearq_files::frames::polars::Column::new((*name).into(), values)
        });
        let table = shearq_files::frames::frame(columns.collect()).unwrap();
        let path = folder
            .path()
            .join(format!("galaxy_catalog-{subfield:03}.fits"));
        shearq_files::table::write(
            &path,
            shearq_files::table::FileFormat::Fits,
            &table,
            &Default::default(),
        )
        .unwrap();
        let offset = |k: usize| (k % 7) as f64 / 70.0;
        let content = format!(
            "{{offset_deg_x: {}, offset_deg_y: {}}}",
            offset(subfield),
            offset(subfield / 3)
        );
        file(
            folder.path(),
            &format!("subfield_offset-{subfield:03}.yaml"),
            &content,
        );
    }
    let path = file(folder.path(), "sheared.txt", &lines(&sheared).join("\n"));
    let out = folder.path().join("out.txt");
    let branch = [
        "--challenge",
        "great3",
        "--branch",
        "control-space-variable",
    ];
    succeed(
        &[
            &["pack"][..],
            &branch,
            &[
                "--grid",
                "3",
                "--subfields",
                "20",
                "--out",
                text(&out),
                text(&path),
            ],
        ]
        .concat(),
    );
    let score = [
        &[
            "score",
            "--truth",
            text(folder.path()),
            text(&out),
            "--format",
            "json",
        ][..],
        &branch,
    ]
    .concat();
    let q = json(&score)["Q_v"].as_f64().unwrap();
    assert!((q - 1.837e-4 / 4e-8).abs() < 1e-3, "{q}");
    // A file of offsets of other data is noticed.
    file(
        folder.path(),
        "subfield_offset-004.yaml",
        "{offset_deg_x: 0.0, offset_deg_y: 0.0}",
    );
    assert!(fail(&score).contains("disagrees with subfield_offset-004"));
}

#[test]
fn published_q_c_follows_from_published_biases() {
    let mut checked = 0;
    for name in (CHALLENGES[0].branches)() {
        let observation = if name.contains("ground") {
            Observation::Ground
        } else {
            Observation::Space
        };
        let branch = Challenge::named("great3")
            .unwrap()
            .branch(Some(&name))
            .unwrap();
        let entries = branch.leaderboard();
        assert!(!entries.is_empty(), "{name}");
        for entry in entries.iter().filter(|entry| entry.biases[0].is_finite()) {
            let [m_plus, m_cross, c_plus, c_cross] = entry.biases;
            let q = observation.q_c([[c_plus, m_plus], [c_cross, m_cross]]);
            assert!((q / entry.q - 1.0).abs() < 1e-3, "{name}: {entry:?}: {q}");
            checked += 1;
        }
    }
    assert_eq!(checked, 120);
}

#[test]
fn submissions_are_ranked_among_published_entries() {
    let case = Path::new(CASES).join("p1_control_ground");
    let (truth, psf, own) = (
        case.join("truth.txt.gz"),
        case.join("psf.txt.gz"),
        case.join("submission.txt.gz"),
    );
    let found = json(&[
        "compare",
        "--challenge",
        "great3",
        "--branch",
        "control-ground-constant",
        "--leaderboard",
        "--truth",
        text(&truth),
        "--psf",
        text(&psf),
        text(&own),
        "--format",
        "json",
    ]);
    let rows = found["rows"]
        .as_array()
        .unwrap_or_else(|| panic!("{found}"));
    let q = |row: &Value| row["q"].as_f64().unwrap();
    assert!(rows.windows(2).all(|pair| q(&pair[0]) >= q(&pair[1])));
    let this = rows.iter().position(|row| row["team"] == "this").unwrap();
    assert!((q(&rows[this]) - 498.5).abs() < 0.1 && rows[this]["rank"] == 1.0 + this as f64);
    assert_eq!(q(&rows[0]), 1211.0);
}

#[test]
fn great08_scores_images_and_sets() {
    let folder = tempfile::tempdir().unwrap();
    let truth = file(
        folder.path(),
        "truth.txt",
        "# image set g1 g2\n0 0 0.01 0.02\n1 0 0.01 0.02\n2 1 -0.03 0\n",
    );
    let plain = file(
        folder.path(),
        "plain.txt",
        "0 0.01 0.02\n1 0.01 0.02\n2 -0.03 0\n",
    );
    let images = file(
        folder.path(),
        "images.txt",
        "0 0.0203 0.0199\n1 0.0003 0.0199\n2 -0.03 0\n",
    );
    let sets = file(
        folder.path(),
        "sets.csv",
        "set,g1,g2\n0,0.0103,0.0199\n1,-0.03,0\n",
    );
    for (truth, submission) in [(&truth, &images), (&plain, &images), (&truth, &sets)] {
        let found = json(&[
            "score",
            "--challenge",
            "great08",
            "--truth",
            text(truth),
            text(submission),
            "--format",
            "json",
        ]);
        let expected = 1e-4 / ((9e-8 + 1e-8) / 4.0);
        assert!(
            (found["Q"].as_f64().unwrap() / expected - 1.0).abs() < 1e-6,
            "{found}"
        );
    }
    let message = fail(&[
        "score",
        "--challenge",
        "great08",
        "--truth",
        text(&plain),
        text(&sets),
    ]);
    assert!(message.contains("image 2 is missing"), "{message}");
}

// One change of a sound file: of the value at a row and column, of rows, or of all of it.
#[derive(Clone, Copy, Debug)]
enum Edit {
    Set(usize, usize, &'static str),
    SetAll(usize, &'static str),
    Drop(usize),
    Twice(usize),
    Keep(usize),
    First(&'static str),
    All(&'static str),
}

fn edited(sound: &[String], edit: Edit) -> String {
    let mut rows: Vec<Vec<String>> = sound
        .iter()
        .map(|row| row.split(' ').map(str::to_owned).collect())
        .collect();
    match edit {
        Edit::Set(row, column, value) => rows[row][column] = value.into(),
        Edit::SetAll(column, value) => rows.iter_mut().for_each(|row| row[column] = value.into()),
        Edit::Drop(row) => _ = rows.remove(row),
        Edit::Twice(row) => rows.push(rows[row].clone()),
        Edit::Keep(count) => rows.truncate(count),
        Edit::First(line) => rows.insert(0, vec![line.into()]),
        Edit::All(content) => return content.into(),
    }
    rows.iter().fold(String::new(), |mut text, row| {
        let _ = writeln!(text, "{}", row.join(" "));
        text
    })
}

#[test]
fn a_hundred_malformed_submissions_have_one_clear_error_each() {
    use Edit::{All, Drop, First, Keep, Set, SetAll, Twice};
    let folder = tempfile::tempdir().unwrap();
    let any = [
        (All(""), "found 0 columns, expected"),
        (All("# nothing\n"), "found 0 columns, expected"),
        (All("1 2\n3 4\n"), "found 2 columns, expected"),
        (All("1 2 3 4 5 6 7\n"), "found 7 columns, expected"),
        (All("<?xml version='1.0'?>"), "XML"),
        (All("SIMPLE  =                    T"), "END"),
        (
            All("x,y,e1,e2\n1,2,3,4\n"),
            "found the columns x, y, e1, e2, expected",
        ),
        (
            First("a b c d e"),
            "found the columns a, b, c, d, e, expected",
        ),
        (Set(3, 1, "zero"), "line 4"),
        (Set(3, 2, "0.1 0.2"), "line 4"),
        (Set(3, 2, "--"), "line 4"),
        (Set(3, 0, "0x1"), "line 4"),
    ];
    let identities = [
        (
            Set(5, 0, "-1"),
            "row 6: not the identity of a galaxy (found -1",
        ),
        (Set(5, 0, "0.5"), "row 6: not the identity"),
        (Set(5, 0, "nan"), "row 6: not the identity"),
        (Set(5, 0, "1e12"), "row 6: not the identity"),
        (
            Set(5, 0, "200000000"),
            "galaxy 200000000: subfield 200 does not exist",
        ),
        (Set(5, 0, "999000000"), "subfield 999 does not exist"),
        (
            Set(5, 0, "000900000"),
            "galaxy 000900000: column 900 and row 0 are outside",
        ),
        (Set(5, 0, "000000900"), "column 0 and row 900 are outside"),
        (Set(1, 0, "000000000"), "galaxy 000000000 is there twice"),
        (Twice(3), "is there twice; it is also in"),
        (Twice(0), "Try: remove one"),
        (
            Set(5, 1, "-99"),
            "g1 is -99, which the challenge's program would average",
        ),
        (Set(5, 2, "-10"), "g2 is -10"),
        (Set(5, 1, "-inf"), "g1 is -inf"),
        (Set(5, 3, "-1"), "the weight is -1, expected"),
        (Set(5, 3, "nan"), "the weight is NaN"),
        (Set(5, 3, "inf"), "the weight is inf"),
        (Set(5, 3, "one"), "line 6"),
        (
            Drop(0),
            "galaxy 000000000 is missing: subfield 0 has 3 galaxies, expected 4",
        ),
        (Drop(799), "is missing: subfield 199 has 3"),
        (Drop(9), "is missing: subfield 2 has 3 galaxies"),
        (
            Keep(798),
            "and 1 more: subfield 199 has 2 galaxies, expected 4. Try: a row with",
        ),
        (Keep(796), "1 of 200 subfields are missing: 199"),
        (
            Keep(4),
            "199 of 200 subfields are missing: 1, 2, 3, 4, 5, …",
        ),
        (SetAll(1, "10"), "field 0 has no measured galaxy"),
        (SetAll(3, "0"), "field 0 has no measured galaxy"),
    ];
    let offsets = [
        (
            Set(5, 0, "001003000"),
            "not a multiple of 7 nodes (found (3, 0), expected (1, 0)",
        ),
        (Set(5, 0, "001001002"), "galaxy 001001002: its offset"),
        (
            Set(0, 0, "000014014"),
            "galaxy 000014014: column 14 and row 14 are outside",
        ),
    ];
    let shears = [
        (
            Set(5, 0, "-1"),
            "row 6: not the number of a field (found -1, expected 0 to 199)",
        ),
        (Set(5, 0, "200"), "row 6: not the number"),
        (Set(5, 0, "5.5"), "row 6: not the number"),
        (Set(5, 0, "nan"), "row 6: not the number"),
        (Set(5, 0, "4"), "field 4 is there twice"),
        (Twice(199), "field 199 is there twice"),
        (Set(5, 1, "1"), "field 5: g1 is 1, expected a shear below 1"),
        (Set(5, 2, "-2.5"), "field 5: g2 is -2.5"),
        (Set(5, 1, "nan"), "field 5: g1 is NaN"),
        (Set(5, 1, "inf"), "field 5: g1 is inf"),
        (Set(0, 2, "10"), "field 0: g2 is 10"),
        (Set(199, 2, "99"), "field 199: g2 is 99"),
        (
            Drop(0),
            "field 0 is missing (found 199 fields, expected 200)",
        ),
        (Drop(199), "field 199 is missing (found"),
        (Keep(20), "field 20 is missing and 179 more"),
        (Keep(1), "field 1 is missing and 198 more"),
        (SetAll(1, "0"), "all values of g1 are zero"),
        (SetAll(2, "0"), "all values of g2 are zero"),
    ];
    let masses = [
        (
            Set(20, 0, "10"),
            "row 21: not the number of a field (found 10, expected 0 to 9)",
        ),
        (Set(20, 0, "-1"), "row 21: not the number"),
        (Set(20, 0, "1.5"), "row 21: not the number"),
        (Set(20, 0, "2"), "field 2: theta = 0.1953 is there twice"),
        (Twice(149), "field 9: theta = 8.1289 is there twice"),
        (
            Set(20, 1, "0.2"),
            "field 1: theta is 0.2, expected one of the 15 centres 0.0246 to 8.1289",
        ),
        (Set(20, 1, "nan"), "field 1: theta is NaN"),
        (Set(20, 1, "11.7"), "field 1: theta is 11.7"),
        (
            Set(20, 1, "0.0246"),
            "field 1: theta = 0.0246 is there twice",
        ),
        (SetAll(1, "0.0246"), "theta = 0.0246 is there twice"),
        (Set(20, 2, "nan"), "field 1: map_E is NaN"),
        (Set(20, 2, "2"), "field 1: map_E is 2, expected -1 to 1"),
        (Set(20, 2, "-inf"), "field 1: map_E is -inf"),
        (Set(20, 3, "nan"), "field 1: map_B is NaN"),
        (Set(20, 3, "7"), "field 1: map_B is 7"),
        (
            Set(20, 4, "-1e-9"),
            "field 1: error is -0.000000001, expected 0 to 1",
        ),
        (Set(20, 4, "nan"), "field 1: error is NaN"),
        (Set(20, 4, "5"), "field 1: error is 5"),
        (Drop(0), "field 0: theta = 0.0246 is missing"),
        (Drop(149), "field 9: theta = 8.1289 is missing"),
        (Drop(37), "field 2: theta = 0.4472 is missing"),
        (
            Keep(135),
            "field 9 is missing (found 9 fields, expected 10)",
        ),
        (Keep(1), "field 1 is missing and 8 more"),
        (SetAll(2, "0"), "all values of map_E are zero"),
    ];
    let sound_shears = (0..200).map(|k| format!("{k} {} 0.01", 0.001 + f64::from(k) * 1e-4));
    let sound_masses = rows(&Path::new(CASES).join("p4_control_ground/submission.txt.gz"));
    let sound_masses = sound_masses
        .iter()
        .map(|row| row.iter().map(f64::to_string).collect::<Vec<_>>().join(" "));
    let (constant, variable) = ("control-ground-constant", "control-ground-variable");
    type Edits<'a> = Vec<&'a [(Edit, &'a str)]>;
    let groups: [(&str, &str, Vec<String>, Edits<'_>); 4] = [
        (
            "pack",
            constant,
            lines(&catalogue(200, 2, true)),
            vec![&any, &identities],
        ),
        (
            "pack",
            variable,
            lines(&catalogue(200, 2, false)),
            vec![&any, &identities, &offsets],
        ),
        (
            "check",
            constant,
            sound_shears.collect(),
            vec![&any, &shears],
        ),
        (
            "check",
            variable,
            sound_masses.collect(),
            vec![&any, &masses],
        ),
    ];
    let (path, out) = (
        folder.path().join("made.txt"),
        folder.path().join("out.txt"),
    );
    let (mut count, mut wrong) = (0, Vec::new());
    for (command, branch, sound, edits) in &groups {
        let mut arguments = vec![
            *command,
            text(&path),
            "--challenge",
            "great3",
            "--branch",
            branch,
        ];
        if *command == "pack" {
            arguments.extend(["--grid", "2", "--out", text(&out)]);
        }
        fs::write(&path, edited(sound, Keep(sound.len()))).unwrap();
        succeed(&arguments);
        let _ = fs::remove_file(&out);
        for (edit, says) in edits.iter().copied().flatten() {
            // A change of the first rows of one kind may be none in another.
            fs::write(&path, edited(sound, *edit)).unwrap();
            let output = shearq(&arguments);
            let told = match *command {
                "pack" => String::from_utf8(output.stderr).unwrap(),
                _ => String::from_utf8(output.stdout).unwrap(),
            };
            let errors = told.lines().filter(|line| line.contains("error")).count();
            let one = output.status.code() == Some(1) && told.contains("made.txt") && errors <= 2;
            if !one || !told.contains(says) || told.contains("panicked") || out.exists() {
                wrong.push(format!(
                    "{command} {branch} {edit:?}: expected {says:?}, found {told}"
                ));
            }
            count += 1;
        }
    }
    assert!(wrong.is_empty(), "{}\n{}", wrong.len(), wrong.join("\n"));
    assert!(count >= 100, "{count}");
}
