//! Scoring, packing, checking and ranking of GREAT3 and GREAT08 through the binary.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use flate2::read::GzDecoder;
use serde_json::Value;
use shearq_files::frames::polars::Column;
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat};
use shearq_quantities::Shear;
use shearq_results::published::{CHALLENGES, PublicChallenge};
use shearq_scoring::aperture::{Lattice, LatticeShear};
use shearq_scoring::great3::Observation;

use crate::support::{fail, pixels_of, shearq, succeed};

const CASES: &str = "scoring/tests/data/great3";

// The words of a command without blanks in its arguments.
fn words(line: &str) -> Vec<&str> {
    line.split_whitespace().collect()
}

fn json(line: &str) -> Value {
    let line = format!("{line} --format json");
    serde_json::from_str(&succeed(&words(&line))).unwrap()
}

fn file(folder: &Path, name: &str, content: &str) -> String {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(&path, content).unwrap();
    path.to_str().unwrap().to_owned()
}

// The numbers of a row.
fn numbers(line: &str) -> Vec<f64> {
    line.split_whitespace()
        .map(|word| word.parse().unwrap())
        .collect()
}

// The rows of a compressed file of a case.
fn rows(case: &str, name: &str) -> Vec<Vec<f64>> {
    let text = GzDecoder::new(fs::File::open(format!("{CASES}/{case}/{name}.txt.gz")).unwrap());
    let text = std::io::read_to_string(text).unwrap();
    text.lines()
        .filter(|line| !line.starts_with('#'))
        .map(numbers)
        .collect()
}

#[test]
fn json_has_the_figures_of_the_challenge() {
    let mut cases = 0;
    for entry in fs::read_dir(CASES).unwrap() {
        let case = entry.unwrap().path();
        let expected = fs::read_to_string(case.join("expected.json")).unwrap();
        let expected: Value = serde_json::from_str(&expected).unwrap();
        // The others have aperture masses, which tests of the crate compare.
        let Some(branch) = expected["branch"].as_str() else {
            continue;
        };
        cases += 1;
        let case = case.display();
        let mut line = format!(
            "score --challenge great3 --branch {branch} --truth {case}/truth.txt.gz {case}/submission.txt.gz"
        );
        if branch.ends_with("constant") {
            let _ = write!(line, " --psf {case}/psf.txt.gz");
        }
        let found = json(&line);
        for (key, value) in expected.as_object().unwrap() {
            match value.as_f64() {
                None => assert_eq!(&found[key], value),
                Some(value) => {
                    let off = (found[key].as_f64().unwrap() / value - 1.0).abs();
                    assert!(off < 1e-9, "{case}: {key}: {} {value}", found[key]);
                }
            }
        }
        let q = if branch.ends_with("constant") {
            "Q_c"
        } else {
            "Q_v"
        };
        assert!(found[format!("jackknife_{q}")].as_f64().unwrap() > 0.0);
        let folder = tempfile::tempdir().unwrap();
        let report = folder.path().join("report.html");
        let _ = write!(line, " --report {}", report.display());
        assert!(succeed(&words(&line)).contains(branch));
        let page = fs::read_to_string(report).unwrap();
        assert!(
            page.contains("data:image/svg+xml") && page.contains(q),
            "{branch}"
        );
    }
    assert_eq!(cases, 5);
}

#[test]
fn released_folders_score_like_tables() {
    let folder = tempfile::tempdir().unwrap();
    for (case, branch) in [
        ("p1_control_ground", "control-ground-constant"),
        ("p2_multiepoch_space", "multiepoch-space-constant"),
        ("p3_full_ground", "full-ground-constant"),
    ] {
        let below = folder.path().join(case).join(branch.replace('-', "/"));
        let truth = rows(case, "truth");
        for subfield in 0..200 {
            let own = &truth[subfield * truth.len() / 200];
            let (g1, g2) = (own[1], own[2]);
            // Both formats that the challenge wrote, and both styles of YAML.
            let (ending, content) = match subfield % 3 {
                0 => ("yaml", format!("{{g1: {g1}, g2: {g2}}}\n")),
                1 => ("yaml", format!("g1: {g1}\ng2: {g2}\n")),
                _ => ("txt", format!("# g1 g2 \n{g1} {g2} \n")),
            };
            file(
                &below,
                &format!("shear_params-{subfield:03}.{ending}"),
                &content,
            );
        }
        for row in rows(case, "psf") {
            let name = format!("starshape_parameters-{:03}-{}.yaml", row[0], row[1]);
            let content = format!(
                "{{epoch_index: {}, psf_g1: {}, psf_g2: {}}}\n",
                row[1], row[2], row[3]
            );
            file(&below, &name, &content);
        }
        let score =
            format!("score --challenge great3 --branch {branch} {CASES}/{case}/submission.txt.gz");
        let by_folder = format!("{score} --truth {}", folder.path().join(case).display());
        let by_table =
            format!("{score} --truth {CASES}/{case}/truth.txt.gz --psf {CASES}/{case}/psf.txt.gz");
        assert_eq!(json(&by_folder), json(&by_table));
        // One of twenty subfields of a field.
        file(&below, "shear_params-005.txt", "# g1 g2\n0.5 0.5\n");
        let _ = fs::remove_file(below.join("shear_params-005.yaml"));
        if case == "p3_full_ground" {
            let message = fail(&words(&by_folder));
            assert!(
                message.contains("subfields 0 and 5 of field 0 have different shears"),
                "{message}"
            );
        }
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
    // No galaxy has such a shear; it counts as in the challenge.
    galaxies[9].1.e1 = -1.5;
    let half = galaxies.len() / 2;
    // Numbers in a comment are no names.
    let rows = lines(&galaxies[half..]).join("\n");
    let first = file(folder.path(), "a.txt", &format!("# 0 0 0 1\n{rows}"));
    // In another order of columns, with a column that is not used.
    let csv = galaxies[..half]
        .iter()
        .fold("weight,other,g2,g1,id\n".to_owned(), |text, (id, g, w)| {
            text + &format!("{w},7,{},{},{id}\n", g.e2, g.e1)
        });
    let second = file(folder.path(), "b.csv", &csv);
    let out = folder.path().join("out.txt");
    let branch = "--challenge great3 --branch control-space-constant";
    for (whole, option) in [(false, ""), (true, "--whole-galaxies")] {
        let pack = format!(
            "pack {branch} --grid 2 --out {} {first} {second} {option}",
            out.display()
        );
        let told = said(&pack);
        assert!(
            told.contains(
                "not measured; columns that are not used: other; 1 with a g of 1 or more"
            ),
            "{told}"
        );
        // Neither an earlier submission is replaced nor a text named as an archive.
        assert!(fail(&words(&pack)).contains("out.txt: the file exists already"));
        let archive = pack.replace("out.txt", "out.tar.gz");
        assert!(fail(&words(&archive)).contains("is one text file (found .gz"));
        let packed = fs::read_to_string(&out).unwrap();
        fs::remove_file(&out).unwrap();
        let mean = |field: usize, of: fn(&Shear) -> f64| {
            let own = galaxies[4 * field..4 * field + 4].iter();
            let own = own.filter(|own| of(&own.1) < 9.9 && !(whole && own.1.e1 >= 9.9));
            let (sum, weight) = own.fold((0.0, 0.0), |(s, w), own| {
                (s + own.2 * of(&own.1), w + own.2)
            });
            sum / weight
        };
        for (field, line) in packed.lines().skip(1).enumerate() {
            let own = numbers(line);
            assert_eq!(own[0], field as f64);
            let off = [
                own[1] - mean(field, |g| g.e1),
                own[2] - mean(field, |g| g.e2),
            ];
            assert!(off.iter().all(|off| off.abs() < 1e-15), "{line}: {off:?}");
        }
        assert_eq!(packed.lines().count(), 201);
        fs::write(&out, &packed).unwrap();
        succeed(&words(&format!("check {} {branch}", out.display())));
        fs::remove_file(&out).unwrap();
    }
    // A weight of another name.
    let other = file(folder.path(), "c.csv", &csv.replacen("weight", "wt", 1));
    let message = fail(&words(&format!(
        "pack {branch} --grid 2 --out {} {first} {other}",
        out.display()
    )));
    assert!(
        message.contains("c.csv: `wt` looks like a weight but is not used"),
        "{message}"
    );
}

#[test]
fn pack_writes_aperture_masses_that_score_the_ceiling() {
    let folder = tempfile::tempdir().unwrap();
    let galaxies = catalogue(200, 3, false);
    let path = file(folder.path(), "galaxies.txt", &lines(&galaxies).join("\n"));
    let out = folder.path().join("out.txt").display().to_string();
    let branch = "--challenge great3 --branch variable_psf-ground-variable";
    succeed(&words(&format!(
        "pack {branch} --grid 3 --out {out} {path}"
    )));
    succeed(&words(&format!("check {out} {branch}")));
    let mut field = LatticeShear::new(Lattice::GREAT3).unwrap();
    for (id, g, w) in &galaxies[9 * 20 * 4..9 * 20 * 5] {
        field.add((id / 1000 % 1000, id % 1000), *g, *w).unwrap();
    }
    let expected = field.correlations_by_pairs().aperture_mass();
    let packed = fs::read_to_string(&out).unwrap();
    for (b, line) in packed.lines().skip(1 + 15 * 4).take(15).enumerate() {
        let own = numbers(line);
        let expected = [
            4.0,
            expected.theta[b],
            expected.map_e[b],
            expected.map_b[b],
            expected.error[b],
        ];
        for (found, expected) in own.iter().zip(expected) {
            let most = 1e-12 * expected.abs().max(1e-5);
            assert!((found - expected).abs() < most, "{line} {expected}");
        }
    }
    let q = json(&format!("score {branch} --truth {out} {out}"))["Q_v"]
        .as_f64()
        .unwrap();
    assert!((q - 1.837e-4 / 9e-8).abs() < 1e-6);
}

#[test]
fn released_galaxies_make_the_truth_of_variable_shear() {
    let folder = tempfile::tempdir().unwrap();
    let galaxies = catalogue(20, 3, false);
    let intrinsic = |k: usize| Shear::new(0.2 * (k as f64).sin(), 0.2 * (k as f64).cos());
    let sheared = galaxies.iter().enumerate();
    let sheared: Vec<_> = sheared
        .map(|(k, own)| (own.0, intrinsic(k).sheared_by(own.1), 1.0))
        .collect();
    let write = |subfield: usize, kept: usize, amplitude: f64| {
        let column = |name: &str, of: &dyn Fn(usize) -> f64| {
            let all = 9 * subfield..9 * subfield + kept;
            Column::new(name.into(), all.map(of).collect::<Vec<f64>>())
        };
        let columns = vec![
            column("ID", &|k| galaxies[k].0 as f64),
            column("g1", &|k| amplitude * galaxies[k].1.e1),
            column("g2", &|k| amplitude * galaxies[k].1.e2),
            column("g1_intrinsic", &|k| intrinsic(k).e1),
            column("g2_intrinsic", &|k| intrinsic(k).e2),
        ];
        let path = folder
            .path()
            .join(format!("galaxy_catalog-{subfield:03}.fits"));
        let table = frame(columns).unwrap();
        table::write(&path, FileFormat::Fits, &table, &Metadata::new()).unwrap();
    };
    for subfield in 0..20 {
        write(subfield, 9, 1.0);
        let offset = |k: usize| (k % 7) as f64 / 70.0;
        let (x, y) = (offset(subfield), offset(subfield / 3));
        let content = format!("{{offset_deg_x: {x}, offset_deg_y: {y}}}");
        file(
            folder.path(),
            &format!("subfield_offset-{subfield:03}.yaml"),
            &content,
        );
    }
    let path = file(folder.path(), "sheared.txt", &lines(&sheared).join("\n"));
    let root = folder.path().display();
    let branch = "--challenge great3 --branch control-space-variable";
    succeed(&words(&format!(
        "pack {branch} --grid 3 --subfields 20 --out {root}/out.txt {path}"
    )));
    let score = format!("score {branch} --subfields 20 --truth {root} {root}/out.txt");
    let q = json(&score)["Q_v"].as_f64().unwrap();
    assert!((q - 1.837e-4 / 4e-8).abs() < 1e-3, "{q}");
    for (kept, amplitude, says) in [
        (0, 1.0, "found 0 galaxies, expected those of a square grid"),
        (8, 1.0, "found 8 galaxies"),
        (4, 1.0, "is outside of the grid of 2 × 2 galaxies"),
        (
            9,
            0.0,
            "all galaxies have the true shear 0 0, expected one that varies",
        ),
    ] {
        write(7, kept, amplitude);
        let message = fail(&words(&score));
        assert!(
            message.contains("galaxy_catalog-007") && message.contains(says),
            "{message}"
        );
    }
    write(7, 9, 1.0);
    // A file of offsets of other data is noticed.
    let other = "{offset_deg_x: 0.0, offset_deg_y: 0.0}";
    file(folder.path(), "subfield_offset-004.yaml", other);
    assert!(fail(&words(&score)).contains("disagrees with subfield_offset-004"));
}

#[test]
fn published_q_c_follows_from_published_biases() {
    let mut checked = 0;
    for name in (CHALLENGES[0].branches)() {
        let ground = name.contains("ground");
        let observation = if ground {
            Observation::Ground
        } else {
            Observation::Space
        };
        let branch = PublicChallenge::named("great3")
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

// The lines of standard error of a command that succeeds.
fn said(line: &str) -> String {
    let output = shearq(&words(line));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{line}: {said}");
    said
}

#[test]
fn aperture_masses_of_grids_follow_the_square_of_the_response() {
    let folder = tempfile::tempdir().unwrap();
    let n = 24;
    let (mut truth, mut catalogue) = ("x,y,g1,g2\n".to_owned(), "x,y,e1,e2\n".to_owned());
    for k in 0..n * n {
        let (x, y) = (f64::from(k % n), f64::from(k / n));
        // A wave along x, an E mode.
        let g1 = 0.02 * (2.0 * std::f64::consts::PI * 2.0 * x / f64::from(n)).cos();
        let place = format!("{},{}", 48.0 * x + 24.5, 48.0 * y + 24.5);
        let _ = writeln!(truth, "{place},{g1},0");
        // One galaxy is missing.
        if k != 30 {
            let _ = writeln!(catalogue, "{place},{},0", 1.1 * g1);
        }
    }
    let truth = file(folder.path(), "truth.csv", &truth);
    let catalogue = file(folder.path(), "a.csv", &catalogue);
    let found = json(&format!(
        "score --truth {truth} {catalogue} --aperture-mass --convention 5 --truth-sign standard"
    ));
    let rows = found["rows"].as_array().unwrap();
    let (mut ratios, mut largest) = (Vec::new(), 0.0_f64);
    for row in rows {
        let number = |key: &str| row[key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"));
        ratios.push(number("map_e_1e6") / number("true_map_e_1e6"));
        largest = largest.max(number("map_e_1e6"));
        assert!(number("theta") > 10.0 / f64::from(n));
    }
    assert!(
        ratios.len() > 5 && ratios.iter().all(|ratio| (ratio / 1.21 - 1.0).abs() < 1e-9),
        "{ratios:?}"
    );
    // Of 2·10⁻⁴, the variance of the wave, the filter passes up to a tenth.
    assert!((1.0..40.0).contains(&largest), "{largest}");
}

// Changes of sound files: which files, what is changed, and what the error says. `set ROW COLUMN VALUE`, `column COLUMN VALUE`,
// `half COLUMN VALUE`, `all-half VALUE`, `zero ROW`, `drop ROW`, `twice ROW`, `keep ROWS`, `first LINE`, `all CONTENT`.
const MALFORMED: &str = include_str!("malformed.txt");

fn edited(sound: &[String], edit: &str) -> String {
    let mut rows: Vec<Vec<&str>> = sound.iter().map(|row| row.split(' ').collect()).collect();
    let (kind, rest) = edit.split_once(' ').unwrap_or((edit, ""));
    let mut rest = rest.splitn(if kind == "set" { 3 } else { 2 }, ' ');
    let mut number = || rest.next().unwrap().parse::<usize>().unwrap();
    match kind {
        "set" => {
            let (row, column) = (number(), number());
            rows[row][column] = rest.next().unwrap();
        }
        "column" => {
            let (column, value) = (number(), rest.next().unwrap());
            rows.iter_mut().for_each(|row| row[column] = value);
        }
        // In every second field.
        "half" => {
            let (column, value) = (number(), rest.next().unwrap());
            let odd = |row: &&mut Vec<&str>| row[0].parse::<usize>().unwrap() % 2 == 1;
            rows.iter_mut()
                .filter(odd)
                .for_each(|row| row[column] = value);
        }
        "all-half" => {
            let value = rest.next().unwrap();
            rows.iter_mut()
                .skip(1)
                .step_by(2)
                .for_each(|row| row[1..].fill(value));
        }
        "zero" => rows[number()][1..].fill("0"),
        "drop" => _ = rows.remove(number()),
        "twice" => rows.push(rows[number()].clone()),
        "keep" => rows.truncate(number()),
        "first" => rows.insert(0, vec![&edit[6..]]),
        _ => return edit[3..].trim_start().replace("\\n", "\n"),
    }
    let lines = rows.iter().map(|row| row.join(" ") + "\n");
    lines.collect()
}

#[test]
fn a_hundred_malformed_submissions_have_one_clear_error_each() {
    let folder = tempfile::tempdir().unwrap();
    let shears = (0..200).map(|k| format!("{k} {0} {0}", 0.001 + f64::from(k) * 1e-4));
    let masses = rows("p4_control_ground", "submission");
    let masses = masses.iter().map(|row| {
        let words: Vec<String> = row.iter().map(f64::to_string).collect();
        words.join(" ")
    });
    let (constant, variable) = ("control-ground-constant", "control-ground-variable");
    let groups: [(&str, &str, Vec<String>, &[&str]); 4] = [
        (
            "pack",
            constant,
            lines(&catalogue(200, 2, true)),
            &["any", "identities"],
        ),
        (
            "pack",
            variable,
            lines(&catalogue(200, 2, false)),
            &["any", "identities", "offsets"],
        ),
        ("check", constant, shears.collect(), &["any", "shears"]),
        ("check", variable, masses.collect(), &["any", "masses"]),
    ];
    let (path, out) = (
        folder.path().join("made.txt"),
        folder.path().join("out.txt"),
    );
    let (mut count, mut wrong) = (0, Vec::new());
    for (command, branch, sound, kinds) in &groups {
        let mut line = format!(
            "{command} {} --challenge great3 --branch {branch}",
            path.display()
        );
        if *command == "pack" {
            let _ = write!(line, " --grid 2 --out {}", out.display());
        }
        fs::write(&path, sound.join("\n")).unwrap();
        succeed(&words(&line));
        let _ = fs::remove_file(&out);
        for row in MALFORMED.lines() {
            let [kind, edit, says] = row.splitn(3, " | ").collect::<Vec<_>>()[..] else {
                panic!("{row}");
            };
            if !kinds.contains(&kind) {
                continue;
            }
            fs::write(&path, edited(sound, edit)).unwrap();
            let output = shearq(&words(&line));
            let told = match *command {
                "pack" => String::from_utf8(output.stderr).unwrap(),
                _ => String::from_utf8(output.stdout).unwrap(),
            };
            // `check` ends with their number.
            let errors = told.lines().filter(|line| line.contains("error")).count();
            let one = output.status.code() == Some(1) && told.contains("made.txt") && errors <= 2;
            if !one || !told.contains(says) || told.contains("panicked") || out.exists() {
                wrong.push(format!(
                    "{command} {branch} {edit}: expected {says}, found {told}"
                ));
            }
            count += 1;
        }
    }
    assert!(wrong.is_empty(), "{}\n{}", wrong.len(), wrong.join("\n"));
    assert!(count >= 100, "{count}");
}

// ID, g1 and g2 of the galaxies of simulated truth, as rows of text: sheared shapes, or shears alone.
fn true_galaxies(folder: &Path, subfields: usize, sheared: bool) -> String {
    let mut rows = String::new();
    for subfield in 0..subfields {
        let path = folder.join(format!("galaxy_catalog-{subfield:03}.fits"));
        let read = table::read(&path, None, table::MAX_ROWS).unwrap();
        let column = |name| table::numbers(&read, name, &path).unwrap();
        let [ids, g1, g2, e1, e2] = ["ID", "g1", "g2", "g1_intrinsic", "g2_intrinsic"].map(column);
        for k in 0..ids.len() {
            let shear = Shear::new(g1[k], g2[k]);
            let shape = Shear::new(e1[k], e2[k]).sheared_by(shear);
            let Shear { e1, e2 } = if sheared { shape } else { shear };
            let _ = writeln!(rows, "{:.0} {e1} {e2}", ids[k]);
        }
    }
    rows
}

#[test]
fn simulated_branches_are_scored_by_their_released_truth() {
    let folder = tempfile::tempdir().unwrap();
    for (branch, subfields, ceiling) in [
        ("control-space-constant", 3, 2464.0),
        ("multiepoch-ground-constant", 3, 1232.0),
        ("control-ground-variable", 20, 1.837e-4 / 9e-8),
    ] {
        let root = folder.path().join(branch);
        let out = root.display();
        let line = format!(
            "simulate --challenge great3 --branch {branch} --subfields {subfields} --grid 8 --opposite --out {out}"
        );
        succeed(&words(&line));
        let catalogue = Path::new("truth")
            .join(branch.replace('-', "/"))
            .join("galaxy_catalog-001.fits");
        let [plain, opposite] = [
            root.join(&catalogue),
            root.join("opposite").join(&catalogue),
        ]
        .map(|path| {
            let read = table::read(&path, None, table::MAX_ROWS).unwrap();
            ["g1", "g2_intrinsic"].map(|name| table::numbers(&read, name, &path).unwrap()[5])
        });
        assert_eq!(opposite, [-plain[0], plain[1]]);
        let below = branch.replace('-', "/");
        let [public, private] = ["public", "private"].map(|name| root.join(name));
        let message = fail(&words(&format!(
            "challenge new --name own --kind great3 --data {} --public {} --private {}",
            root.join(&below).display(),
            public.display(),
            private.display()
        )));
        assert!(
            message.contains("this is a branch of GREAT3") && !public.exists(),
            "{message}"
        );
        let truth = root.join("truth").join(&below);
        let rows = true_galaxies(&truth, subfields, branch.ends_with("variable"));
        let galaxies = file(&root, "galaxies.txt", &rows);
        let (packed, released) = (root.join("packed.txt"), root.join("truth"));
        let (packed, released) = (packed.display(), released.display());
        let line = format!(
            "pack --challenge great3 --branch {branch} --subfields {subfields} --grid 8 --out {packed} {galaxies}"
        );
        succeed(&words(&line));
        let line = format!(
            "score --challenge great3 --branch {branch} --subfields {subfields} --truth {released} {packed}"
        );
        let found = json(&line);
        let q = found["Q_c"].as_f64().or(found["Q_v"].as_f64()).unwrap();
        assert!((q / ceiling - 1.0).abs() < 1e-6, "{branch}: {q}");
        let check =
            format!("check --challenge great3 --branch {branch} --subfields {subfields} {packed}");
        succeed(&words(&check));
        let ranked = line.replacen("score", "compare --leaderboard", 1);
        let ranked = succeed(&words(&ranked));
        assert!(
            ranked.contains(&format!(
                "have {subfields} subfields, the published ones 200"
            )),
            "{ranked}"
        );

        // What participants got: 3 x 3 stars, and stamps whose lower central pixels the catalogue names.
        let data = root.join(&below);
        let (_, width) = pixels_of(&data.join("starfield_image-000-0.fits"));
        let path = data.join("galaxy_catalog-001.fits");
        let read = table::read(&path, None, table::MAX_ROWS).unwrap();
        assert_eq!(read.get_column_names(), ["x", "y", "ID"]);
        let x = table::numbers(&read, "x", &path).unwrap();
        let stamp = if branch.contains("space") { 96 } else { 48 };
        assert_eq!(width, 3 * stamp);
        assert_eq!(
            [x[0], x[7], x[8]],
            [0.5, 7.5, 0.5].map(|k| k * stamp as f64 - 1.0)
        );
        let (_, width) = pixels_of(&data.join("image-001-0.fits"));
        assert_eq!(width, 8 * stamp);
    }
}

// All files below a folder by name, with their contents.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut all = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => all.extend(contents(&path)),
            false => all.push((path.clone(), fs::read(&path).unwrap())),
        }
    }
    all.sort();
    all
}

#[test]
fn resumed_branches_are_those_of_one_run() {
    let folder = tempfile::tempdir().unwrap();
    let fits = file(folder.path(), "fits.txt", "n r_e q\n1 0.5 0.6\n");
    let out = folder.path().join("out");
    let line = format!(
        "simulate --challenge great3 --branch multiepoch-ground-constant --subfields 2 --grid 8 --galaxies {fits} --out {}",
        out.display()
    );
    succeed(&words(&line));
    let whole = contents(&out);
    let below = out.join("multiepoch/ground/constant");
    let truth = out.join("truth/multiepoch/ground/constant");
    for lost in [
        below.join("image-001-2.fits"),
        below.join("starfield_image-000-5.fits"),
        below.join("epoch_dither-001-3.yaml"),
        truth.join("galaxy_catalog-000.fits"),
    ] {
        fs::remove_file(&lost).unwrap();
        succeed(&words(&line));
        assert!(contents(&out) == whole, "{}", lost.display());
    }
    for damaged in [
        below.join("image-001-5.fits"),
        below.join("galaxy_catalog-001.fits"),
        truth.join("shear_params-000.yaml"),
    ] {
        let bytes = fs::read(&damaged).unwrap();
        fs::write(&damaged, &bytes[..bytes.len() / 2]).unwrap();
        succeed(&words(&line));
        assert!(contents(&out) == whole, "{}", damaged.display());
    }
    // An image of another seed, and images whose record is lost.
    let other = folder.path().join("other");
    let of_other = line.replace(&out.display().to_string(), &other.display().to_string());
    succeed(&words(&format!("{of_other} --seed 7")));
    let name = "multiepoch/ground/constant/image-001-2.fits";
    let own = fs::read(out.join(name)).unwrap();
    fs::copy(other.join(name), out.join(name)).unwrap();
    let message = fail(&words(&line));
    assert!(
        message.contains("image-001-2.fits: the first galaxy is not the one of this seed"),
        "{message}"
    );
    fs::write(out.join(name), own).unwrap();
    fs::remove_file(other.join("simulation.json")).unwrap();
    let message = fail(&words(&of_other));
    assert!(
        message.contains("image-000-0.fits: nothing states the settings of this image"),
        "{message}"
    );
    assert!(!other.join("simulation.json").exists());
    // Another table of the same name.
    file(folder.path(), "fits.txt", "n r_e q\n1 0.4 0.6\n");
    let message = fail(&words(&line));
    assert!(
        message.contains("other settings") && message.contains("galaxies: "),
        "{message}"
    );
}

#[test]
fn simulated_branches_draw_from_a_table_of_fits() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out").display().to_string();
    let line = |path: &str| {
        format!(
            "simulate --challenge great3 --branch control-ground-constant --subfields 1 --grid 8 --galaxies {path} --out {out}"
        )
    };
    let head = "n r_e q flux bulge_r_e bulge_q bulge_flux snr";
    let fits = file(
        folder.path(),
        "fits.txt",
        &format!("{head}\n1 0.5 0.6 2 0.2 0.9 1 50\n2.3 0.3 1 1 0 0 0 30\n"),
    );
    succeed(&words(&line(&fits)));
    // Round galaxies and pairs of one axis ratio.
    let truth = Path::new(&out).join("truth/control/ground/constant");
    let path = truth.join("galaxy_catalog-000.fits");
    let read = table::read(&path, None, table::MAX_ROWS).unwrap();
    let column = |name| table::numbers(&read, name, &path).unwrap();
    let (e1, e2) = (column("g1_intrinsic"), column("g2_intrinsic"));
    for (e1, e2) in e1.iter().zip(e2.iter()) {
        let modulus = e1.hypot(*e2);
        assert!(modulus < 1e-9 || (modulus - 0.25).abs() < 1e-9, "{modulus}");
    }
    for (rows, says) in [
        ("n r_e q\n1 0.5 0\n", "row 1: q is 0"),
        ("n r_e q\n1 0.5 0.6\nnan 0.5 0.6\n", "row 2: n is NaN"),
        ("n r_e q flux\n1 0.5 0.6 0\n", "row 1: flux is 0"),
        (
            "n r_e q\n7 0.5 0.6\n",
            "row 1: n is 7, expected 0.25 to 6.25",
        ),
        ("n r_e q\n1 0.5 0.6\n1 -0.5 0.5\n", "row 2: r_e is -0.5"),
        ("n r_e q snr\n1 0.5 0.6 inf\n", "row 1: snr is inf"),
        (
            "n r_e q bulge_flux bulge_r_e bulge_q\n1 0.5 0.6 nan 0.2 0.9\n",
            "row 1: bulge_flux is NaN",
        ),
        ("n r_e\n1 0.5\n", "q"),
    ] {
        let path = file(folder.path(), "wrong.txt", rows);
        let told = fail(&words(&line(&path)));
        assert!(told.contains("wrong.txt") && told.contains(says), "{told}");
    }
}
