//! Scoring, packing, checking and ranking of GREAT3 and GREAT08 through the binary.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;

use flate2::read::GzDecoder;
use serde_json::Value;
use shearq_challenges::{CHALLENGES, PublicChallenge};
use shearq_files::frames::polars::Column;
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat};
use shearq_quantities::Shear;
use shearq_scoring::aperture::{Lattice, LatticeShear};
use shearq_scoring::great3::Observation;

use crate::support::{Folder, assert_has, pixels_of, printed, shell};

/// The folder of a case.
fn case(name: &str) -> String {
    let path = Path::new("scoring/tests/data/great3").join(name);
    path.canonicalize().unwrap().display().to_string()
}

fn branch(name: &str) -> String {
    format!("--challenge great3 --branch {name}")
}

/// The numbers of a row.
fn numbers(line: &str) -> Vec<f64> {
    let words = line.split_whitespace();
    words.map(|word| word.parse().unwrap()).collect()
}

/// The rows of a compressed file of a case.
fn rows(case_name: &str, name: &str) -> Vec<Vec<f64>> {
    let file = fs::File::open(format!("{}/{name}.txt.gz", case(case_name))).unwrap();
    let text = std::io::read_to_string(GzDecoder::new(file)).unwrap();
    let rows = text.lines().filter(|line| !line.starts_with('#'));
    rows.map(numbers).collect()
}

/// Q_c or Q_v.
fn quality(found: &Value) -> f64 {
    found["Q_c"].as_f64().or(found["Q_v"].as_f64()).unwrap()
}

#[test]
fn json_has_the_figures_of_the_challenge() {
    let folder = Folder::new();
    for name in [
        "p1_control_ground",
        "p2_multiepoch_space",
        "p3_full_ground",
        "p4_control_ground",
        "p5_full_space",
    ] {
        let case = case(name);
        let expected = fs::read_to_string(format!("{case}/expected.json")).unwrap();
        let expected: BTreeMap<String, Value> = serde_json::from_str(&expected).unwrap();
        let own = expected["branch"].as_str().unwrap();
        let (q, psf) = match own.ends_with("constant") {
            true => ("Q_c", format!("--psf {case}/psf.txt.gz")),
            false => ("Q_v", String::new()),
        };
        let line = format!(
            "score {} --truth {case}/truth.txt.gz {case}/submission.txt.gz {psf}",
            branch(own)
        );
        let found = folder.json(&line);
        for (key, value) in &expected {
            match value.as_f64() {
                None => assert_eq!(&found[key], value),
                Some(value) => {
                    let off = (found[key].as_f64().unwrap() / value - 1.0).abs();
                    assert!(off < 1e-9, "{case}: {key}: {} {value}", found[key]);
                }
            }
        }
        assert!(found[format!("jackknife_{q}")].as_f64().unwrap() > 0.0);
        let printed = folder.run(&format!("{line} --report report.html"));
        assert!(printed.contains(own), "{printed}");
        let page = fs::read_to_string(folder.at("report.html")).unwrap();
        assert!(
            page.contains("data:image/svg+xml") && page.contains(q),
            "{own}"
        );
    }
}

/// The catalogue of a small branch: identities, shears and weights.
fn catalogue(subfields: usize, grid: usize, constant: bool) -> Vec<(usize, Shear, f64)> {
    let galaxy = |k: usize| {
        let (subfield, x, y) = (k / (grid * grid), k / grid % grid, k % grid);
        // Subfields of a field have different offsets.
        let place = |at: usize, offset: usize| if constant { at } else { 7 * at + offset % 7 };
        let id = subfield * 1_000_000 + place(x, subfield) * 1000 + place(y, subfield / 3);
        let wave = |rate: f64| 0.1 * (k as f64 * rate).sin();
        (
            id,
            Shear::new(wave(0.7), wave(1.3)),
            0.5 + (k % 5) as f64 / 4.0,
        )
    };
    (0..subfields * grid * grid).map(galaxy).collect()
}

fn lines(galaxies: &[(usize, Shear, f64)]) -> Vec<String> {
    let line = |(id, g, w): &(usize, Shear, f64)| format!("{id:09} {} {} {w}", g.e1, g.e2);
    galaxies.iter().map(line).collect()
}

#[test]
fn pack_averages_fields_and_its_result_is_sound() {
    let folder = Folder::new();
    let mut galaxies = catalogue(200, 2, true);
    // Without g1, and without both.
    galaxies[1].1.e1 = 9.95;
    galaxies[6].1 = Shear::new(10.0, f64::NAN);
    // No galaxy has such a shear; it counts as in the challenge.
    galaxies[9].1.e1 = -1.5;
    let (second, first) = galaxies.split_at(galaxies.len() / 2);
    // Numbers in a comment are no names.
    folder.write("a.txt", format!("# 0 0 0 1\n{}", lines(first).join("\n")));
    // In another order of columns, with a column that is not used.
    let row = |(id, g, w): &(usize, Shear, f64)| format!("{w},7,{},{},{id}\n", g.e2, g.e1);
    let csv: String = second.iter().map(row).collect();
    folder.write("b.csv", format!("weight,other,g2,g1,id\n{csv}"));
    folder.write("c.csv", format!("wt,other,g2,g1,id\n{csv}"));
    let branch = branch("control-space-constant");
    for (whole, option) in [(false, ""), (true, "--whole-galaxies")] {
        let pack = format!("pack {branch} --grid 2 --out out.txt a.txt b.csv {option}");
        let note = "not measured; columns that are not used: other; 1 with a g of 1 or more";
        assert_has(&folder.said(&pack), note);
        // Neither an earlier submission is replaced nor a text named as an archive.
        folder.refuses(&pack, "out.txt: the file exists already");
        folder.refuses(
            &pack.replace("out.txt", "out.tar.gz"),
            "is one text file (found .gz",
        );
        let packed = fs::read_to_string(folder.at("out.txt")).unwrap();
        let mean = |field: usize, of: fn(&Shear) -> f64| {
            let own = galaxies[4 * field..4 * field + 4].iter();
            let own = own.filter(|own| of(&own.1) < 9.9 && !(whole && own.1.e1 >= 9.9));
            let add =
                |(s, w): (f64, f64), own: &(usize, Shear, f64)| (s + own.2 * of(&own.1), w + own.2);
            let (sum, weight) = own.fold((0.0, 0.0), add);
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
        folder.run(&format!("check out.txt {branch}"));
        folder.remove("out.txt");
    }
    // A weight of another name.
    let pack = format!("pack {branch} --grid 2 --out out.txt a.txt c.csv");
    folder.refuses(&pack, "c.csv: `wt` looks like a weight but is not used");
}

#[test]
fn pack_writes_aperture_masses_that_score_the_ceiling() {
    let folder = Folder::new();
    let galaxies = catalogue(200, 3, false);
    folder.write("galaxies.txt", lines(&galaxies).join("\n"));
    let branch = branch("variable_psf-ground-variable");
    folder.run(&format!(
        "pack {branch} --grid 3 --out out.txt galaxies.txt"
    ));
    folder.run(&format!("check out.txt {branch}"));
    let mut field = LatticeShear::new(Lattice::GREAT3).unwrap();
    for (id, g, w) in &galaxies[9 * 20 * 4..9 * 20 * 5] {
        field.add((id / 1000 % 1000, id % 1000), *g, *w).unwrap();
    }
    let expected = field.correlations_by_pairs().aperture_mass();
    let packed = fs::read_to_string(folder.at("out.txt")).unwrap();
    for (b, line) in packed.lines().skip(1 + 15 * 4).take(15).enumerate() {
        let columns = [
            &expected.theta,
            &expected.map_e,
            &expected.map_b,
            &expected.error,
        ];
        let expected = [4.0].into_iter().chain(columns.map(|column| column[b]));
        for (found, expected) in numbers(line).into_iter().zip(expected) {
            let most = 1e-12 * expected.abs().max(1e-5);
            assert!((found - expected).abs() < most, "{line} {expected}");
        }
    }
    let q = quality(&folder.json(&format!("score {branch} --truth out.txt out.txt")));
    assert!((q - 1.837e-4 / 9e-8).abs() < 1e-6);
}

#[test]
fn released_galaxies_make_the_truth_of_variable_shear() {
    let folder = Folder::new();
    let galaxies = catalogue(20, 3, false);
    let intrinsic = |k: usize| Shear::new(0.2 * (k as f64).sin(), 0.2 * (k as f64).cos());
    let sheared = galaxies.iter().enumerate();
    let sheared = sheared.map(|(k, own)| (own.0, intrinsic(k).sheared_by(own.1), 1.0));
    folder.write(
        "sheared.txt",
        lines(&sheared.collect::<Vec<_>>()).join("\n"),
    );
    let write = |subfield: usize, kept: usize, amplitude: f64| {
        let column = |name: &str, of: &dyn Fn(usize) -> f64| {
            let all = 9 * subfield..9 * subfield + kept;
            Column::new(name.into(), all.map(of).collect::<Vec<f64>>())
        };
        let table = frame(vec![
            column("ID", &|k| galaxies[k].0 as f64),
            column("g1", &|k| amplitude * galaxies[k].1.e1),
            column("g2", &|k| amplitude * galaxies[k].1.e2),
            column("g1_intrinsic", &|k| intrinsic(k).e1),
            column("g2_intrinsic", &|k| intrinsic(k).e2),
        ]);
        let path = folder.at(&format!("galaxy_catalog-{subfield:03}.fits"));
        table::write(&path, FileFormat::Fits, &table.unwrap(), &Metadata::new()).unwrap();
    };
    let write_offset = |subfield: usize, x: f64, y: f64| {
        let content = format!("{{offset_deg_x: {x}, offset_deg_y: {y}}}");
        folder.write(&format!("subfield_offset-{subfield:03}.yaml"), content);
    };
    for subfield in 0..20 {
        write(subfield, 9, 1.0);
        let offset = |k: usize| (k % 7) as f64 / 70.0;
        write_offset(subfield, offset(subfield), offset(subfield / 3));
    }
    let branch = format!("{} --subfields 20", branch("control-space-variable"));
    folder.run(&format!("pack {branch} --grid 3 --out out.txt sheared.txt"));
    let score = format!("score {branch} --truth . out.txt");
    let q = quality(&folder.json(&score));
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
        folder.refuses(&score, &format!("galaxy_catalog-007[..]{says}"));
    }
    write(7, 9, 1.0);
    // A file of offsets of other data is noticed.
    write_offset(4, 0.0, 0.0);
    folder.refuses(&score, "disagrees with subfield_offset-004");
}

#[test]
fn published_q_c_follows_from_published_biases() {
    let mut checked = 0;
    let great3 = PublicChallenge::named("great3").unwrap();
    for name in (CHALLENGES[0].branches)() {
        let observation = match name.contains("ground") {
            true => Observation::Ground,
            false => Observation::Space,
        };
        let entries = great3.branch(Some(&name)).unwrap().leaderboard();
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
            let odd = rows.iter_mut().filter(odd);
            odd.for_each(|row| row[column] = value);
        }
        "all-half" => {
            let value = rest.next().unwrap();
            let odd = rows.iter_mut().skip(1).step_by(2);
            odd.for_each(|row| row[1..].fill(value));
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
    let folder = Folder::new();
    let shears = (0..200).map(|k| format!("{k} {0} {0}", 0.001 + f64::from(k) * 1e-4));
    let masses = rows("p4_control_ground", "submission").into_iter();
    let masses = masses.map(|row| row.iter().map(f64::to_string).collect::<Vec<_>>().join(" "));
    let (constant, variable) = ("control-ground-constant", "control-ground-variable");
    let galaxies = |constant| lines(&catalogue(200, 2, constant));
    let groups: [(&str, &str, Vec<String>, &[&str]); 4] = [
        ("pack", constant, galaxies(true), &["any", "identities"]),
        (
            "pack",
            variable,
            galaxies(false),
            &["any", "identities", "offsets"],
        ),
        ("check", constant, shears.collect(), &["any", "shears"]),
        ("check", variable, masses.collect(), &["any", "masses"]),
    ];
    let (mut count, mut wrong) = (0, Vec::new());
    for (command, own, sound, kinds) in &groups {
        let packs = *command == "pack";
        let more = if packs { "--grid 2 --out out.txt" } else { "" };
        let line = format!("shearq {command} made.txt {} {more}", branch(own));
        folder.write("made.txt", sound.join("\n"));
        printed(folder.root(), &line);
        folder.remove("out.txt");
        for row in MALFORMED.lines() {
            let [kind, edit, says] = row.splitn(3, " | ").collect::<Vec<_>>()[..] else {
                panic!("{row}");
            };
            if !kinds.contains(&kind) {
                continue;
            }
            folder.write("made.txt", edited(sound, edit));
            let output = shell(folder.root(), &line);
            let told = if packs { output.stderr } else { output.stdout };
            let told = String::from_utf8(told).unwrap();
            // `check` ends with their number.
            let errors = told.lines().filter(|line| line.contains("error")).count();
            let one = output.status.code() == Some(1) && told.contains("made.txt") && errors <= 2;
            let clear = told.contains(says) && !told.contains("panicked");
            if !one || !clear || folder.at("out.txt").exists() {
                wrong.push(format!(
                    "{command} {own} {edit}: expected {says}, found {told}"
                ));
            }
            count += 1;
        }
    }
    assert!(wrong.is_empty(), "{}\n{}", wrong.len(), wrong.join("\n"));
    assert!(count >= 100, "{count}");
}

#[test]
fn simulated_branches_are_scored_by_their_released_truth() {
    const TRUTH: [&str; 5] = ["ID", "g1", "g2", "g1_intrinsic", "g2_intrinsic"];
    for (own, subfields, ceiling) in [
        ("control-space-constant", 3, 2464.0),
        ("multiepoch-ground-constant", 3, 1232.0),
        ("control-ground-variable", 20, 1.837e-4 / 9e-8),
    ] {
        let folder = Folder::new();
        let (below, branch) = (
            own.replace('-', "/"),
            format!("{} --subfields {subfields}", branch(own)),
        );
        folder.run(&format!("simulate {branch} --grid 8 --opposite --out ."));
        let truth = |root: &str, subfield: usize| {
            folder.numbers(
                &format!("{root}truth/{below}/galaxy_catalog-{subfield:03}.fits"),
                TRUTH,
            )
        };
        let (plain, opposite) = (truth("", 1), truth("opposite/", 1));
        assert_eq!(
            (opposite[1][5], opposite[4][5]),
            (-plain[1][5], plain[4][5])
        );
        let new = format!(
            "challenge new --name own --kind great3 --data {below} --public public --private private"
        );
        folder.refuses(&new, "this is a branch of GREAT3");
        assert!(!folder.at("public").exists());
        // Sheared shapes of single galaxies for variable shear, and shears alone for constant ones.
        let mut galaxies = String::new();
        for subfield in 0..subfields {
            let [ids, g1, g2, e1, e2] = truth("", subfield);
            for k in 0..ids.len() {
                let shear = Shear::new(g1[k], g2[k]);
                let sheared = Shear::new(e1[k], e2[k]).sheared_by(shear);
                let e = if own.ends_with("variable") {
                    sheared
                } else {
                    shear
                };
                writeln!(galaxies, "{:.0} {} {}", ids[k], e.e1, e.e2).unwrap();
            }
        }
        folder.write("galaxies.txt", galaxies);
        folder.run(&format!(
            "pack {branch} --grid 8 --out packed.txt galaxies.txt"
        ));
        let q = quality(&folder.json(&format!("score {branch} --truth truth packed.txt")));
        assert!((q / ceiling - 1.0).abs() < 1e-6, "{own}: {q}");
        folder.run(&format!("check {branch} packed.txt"));
        let ranked = folder.run(&format!(
            "compare --leaderboard {branch} --truth truth packed.txt"
        ));
        assert_has(
            &ranked,
            &format!("have {subfields} subfields, the published ones 200"),
        );

        // What participants got: 3 x 3 stars, and stamps whose lower central pixels the catalogue names.
        let width = |name: &str| pixels_of(&folder.at(&format!("{below}/{name}"))).1;
        let stamp = if own.contains("space") { 96 } else { 48 };
        assert_eq!(width("starfield_image-000-0.fits"), 3 * stamp);
        assert_eq!(width("image-001-0.fits"), 8 * stamp);
        let path = folder.at(&format!("{below}/galaxy_catalog-001.fits"));
        let read = table::read(&path, None, table::MAX_ROWS).unwrap();
        assert_eq!(read.get_column_names(), ["x", "y", "ID"]);
        let x = table::numbers(&read, "x", &path).unwrap();
        let expected = [0.5, 7.5, 0.5].map(|k| k * stamp as f64 - 1.0);
        assert_eq!([x[0], x[7], x[8]], expected);
    }
}
