//! `score` reads catalogues of any program as `bias` does: with the same roles, conversions, calibration and rows that do not
//! count.

use std::fmt::Write;
use std::path::Path;

use serde_json::Value;

use crate::support::{Folder, shell};

const SIDE: usize = 12;
const STAMP: usize = 48;

/// Names in a column list of `tests/data/columns`, the columns by role that are used, and the options that this takes.
struct List {
    columns: Vec<String>,
    roles: Vec<(String, String)>,
    given: Vec<String>,
}

impl List {
    fn read(path: &Path) -> Self {
        let text = std::fs::read_to_string(path).unwrap();
        let stated = |key: &str| text.lines().find_map(|line| line.strip_prefix(key));
        let used = stated("# used: ").unwrap();
        let used = used.split_once("): ").unwrap().1.trim_end_matches('.');
        let pairs = used.split(", ").filter_map(|pair| pair.split_once('='));
        let mut roles = Vec::new();
        for (role, columns) in pairs {
            roles.extend(
                columns
                    .split('+')
                    .map(|column| (role.to_owned(), column.to_owned())),
            );
        }
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        let columns = lines.flat_map(str::split_whitespace).map(str::to_owned);
        let columns: Vec<String> = columns.collect();
        let given = stated("# given: ").unwrap_or_default().split_whitespace();
        let mut given: Vec<String> = given.map(str::to_owned).collect();
        if roles.iter().any(|(role, _)| role == "g1") {
            // Without a true shear, c is the mean shear.
            given.extend(["g1=none", "g2=none"].map(str::to_owned));
        }
        List {
            columns,
            roles,
            given,
        }
    }

    fn role(&self, column: &str) -> Option<&str> {
        let own = self.roles.iter().find(|(_, name)| name == column);
        own.map(|(role, _)| role.as_str())
    }

    /// A catalogue of a grid of galaxies, of which some have flags, no weight or a distortion above 1.
    fn table(&self) -> String {
        let mut text = format!("x,y,{}\n", self.columns.join(","));
        let sheared: &[&str] = match self.roles.iter().any(|(role, _)| role == "version") {
            true => &["noshear", "1p", "1m", "2p", "2m"],
            false => &["noshear"],
        };
        for galaxy in 0..SIDE * SIDE {
            for name in sheared {
                let position = |k: usize| (k * STAMP) as f64 + 24.5;
                let (x, y) = (position(galaxy % SIDE), position(galaxy / SIDE));
                write!(text, "{x},{y}").unwrap();
                for column in &self.columns {
                    let value = self.value(galaxy, name, column);
                    write!(text, ",{value}").unwrap();
                }
                text.push('\n');
            }
        }
        text
    }

    fn value(&self, galaxy: usize, sheared: &str, column: &str) -> String {
        // Numbers between 0 and 1 that do not repeat.
        let uniform = |seed: usize| ((galaxy * 97 + seed * 41 + 13) as f64 * 0.618_034).fract();
        let e = |k: usize| 0.02 + 0.3 * (uniform(k) - 0.5);
        let shear = match sheared {
            "1p" => [0.007, 0.0],
            "1m" => [-0.007, 0.0],
            "2p" => [0.0, 0.008],
            "2m" => [0.0, -0.008],
            _ => [0.0; 2],
        };
        let step = |role: &str| shear_of(role).map_or(0.0, |own| 0.8 * own);
        let value = match self.role(column) {
            Some("e1" | "ksb_e1") => e(1) + shear[0],
            Some("e2" | "ksb_e2") => e(2) + shear[1],
            Some(role) if role.starts_with("e1_") => e(1) + step(role),
            Some(role) if role.starts_with("e2_") => e(2) + step(role),
            Some("w") if galaxy % 29 == 3 => 0.0,
            Some("w") => 0.5 + uniform(3),
            Some("R11") => 0.7 + 0.2 * uniform(4),
            Some("R22") => 0.75 + 0.2 * uniform(5),
            Some("R12" | "R21") => 0.05 * uniform(6),
            Some("dw1" | "dw2") => 0.1 * (uniform(7) - 0.5),
            Some("rms_e") => 0.35 + 0.05 * uniform(8),
            Some("flag") => f64::from(u8::from(galaxy % 31 == 7)),
            Some("id") => (1000 + galaxy) as f64,
            Some("psf_e1" | "psf_e2") => 0.02 * (uniform(9) - 0.5),
            Some("psf_size") => 1.5 + uniform(10),
            Some("version") => return sheared.to_owned(),
            _ if column.to_ascii_lowercase().contains("flag") => 0.0,
            _ => 0.5 + 0.4 * uniform(column.len()),
        };
        value.to_string()
    }
}

// The artificial shear of the own component in the name of a role.
fn shear_of(role: &str) -> Option<f64> {
    let (own, sheared) = role.split_once('_')?;
    match (own, sheared) {
        ("e1", "1p") | ("e2", "2p") => Some(0.01),
        ("e1", "1m") | ("e2", "2m") => Some(-0.01),
        _ => None,
    }
}

fn constant_truth() -> String {
    let mut text = "x,y,g1,g2\n".to_owned();
    for cell in 0..SIDE * SIDE {
        let position = |k: usize| (k * STAMP) as f64 + 24.5;
        let (x, y) = (position(cell % SIDE), position(cell / SIDE));
        writeln!(text, "{x},{y},0.02,0.01").unwrap();
    }
    text
}

#[test]
fn scores_have_the_mean_shear_and_rows_of_bias() {
    let folder = Folder::new();
    folder.write("truth.csv", constant_truth());
    let mut count = 0;
    for entry in std::fs::read_dir("tests/data/columns").unwrap() {
        let path = entry.unwrap().path();
        let list = List::read(&path);
        folder.write("c.csv", list.table());
        let given = match list.given.is_empty() {
            true => String::new(),
            false => format!("--columns {}", list.given.join(",")),
        };
        let bias = folder.json(&format!("bias c.csv --units rows {given}"));
        let all = &bias["rows"][0];
        let score = folder.json(&format!(
            "score --truth truth.csv --truth-sign standard c.csv {given}"
        ));
        let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
        for (k, key) in ["c1", "c2"].into_iter().enumerate() {
            let (own, expected) = (number(&score["mean_shear"]["e"][k]), number(&all[key]));
            let off = (own - expected).abs();
            assert!(off < 1e-12, "{}: {key} {own} {expected}", path.display());
        }
        let used = number(&score["rows"]["used"]);
        assert_eq!(used, number(&all["n"]), "{}", path.display());
        let rejected = number(&score["rows"]["not_finite"]);
        assert_eq!(used + rejected, (SIDE * SIDE) as f64, "{}", path.display());
        let expects_rejected = (list.roles.iter()).any(|(role, _)| role == "w" || role == "flag");
        assert_eq!(rejected > 0.0, expects_rejected, "{}", path.display());
        let account = score["columns"].to_string();
        assert!(account.contains("Used: e1="), "{account}");
        count += 1;
    }
    assert_eq!(count, 21);
}

#[test]
fn check_rejects_the_rows_that_score_rejects() {
    let folder = Folder::new();
    folder.write("truth.csv", constant_truth());
    folder.write("data/set01/truth.csv", constant_truth());
    for entry in std::fs::read_dir("tests/data/columns").unwrap() {
        let path = entry.unwrap().path();
        let list = List::read(&path);
        // An entry has no options.
        if !list.given.is_empty() {
            continue;
        }
        folder.write("c.csv", list.table());
        let score = folder.json("score --truth truth.csv --truth-sign standard c.csv");
        let rejected = score["rows"]["not_finite"].as_u64().unwrap();
        let found = folder.json("check c.csv --data data");
        let text = |finding: &Value, key: &str| finding[key].as_str().unwrap().to_owned();
        // A single file may have any name.
        let found = found["findings"].as_array().unwrap().iter();
        let found: Vec<String> = found
            .filter(|finding| finding["check"] != "name")
            .map(|finding| text(finding, "check") + ": " + &text(finding, "message"))
            .collect();
        let missing =
            format!("missing: {rejected} of 144 galaxies are missing; each counts as zero");
        let expected: Vec<String> = (rejected > 0).then_some(missing).into_iter().collect();
        assert_eq!(found, expected, "{}", path.display());
    }
}

/// Catalogues in the columns of surveys and pipelines have the numbers that numpy gives for them (`tests/data/layouts/make.py`).
#[test]
fn layouts_of_surveys_have_the_values_of_numpy() {
    const LAYOUTS: &str = "tests/data/layouts";
    const GALAXIES: f64 = 64.0;
    // The files have ten digits, and responses are differences over 0.02.
    const ROUNDING: f64 = 1e-8;
    let folder = Folder::new();
    folder.write("truth.csv", constant_truth());
    let expected = std::fs::read_to_string(format!("{LAYOUTS}/layouts.json")).unwrap();
    let expected: serde_json::Map<String, Value> = serde_json::from_str(&expected).unwrap();
    assert_eq!(expected.len(), 13);
    for (name, own) in expected {
        let table = std::fs::read_to_string(format!("{LAYOUTS}/{name}.csv")).unwrap();
        folder.write("c.csv", table);
        let given: Vec<&str> = (own["given"].as_array().unwrap().iter())
            .map(|text| text.as_str().unwrap())
            .collect();
        let columns = |more: &[&str]| {
            let mut all: Vec<&str> = given.clone();
            all.retain(|own| !more.iter().any(|one| one[..3] == own[..3]));
            all.extend(more);
            match all.is_empty() {
                true => String::new(),
                false => format!("--columns '{}'", all.join(",")),
            }
        };
        let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
        let assert_near = |what: &str, found: &Value, expected: &Value| {
            let off = (number(found) - number(expected)).abs();
            assert!(off < ROUNDING, "{name}: {what} {found} {expected}");
        };
        let found = folder.json(&format!("bias c.csv {}", columns(&[])));
        let all = &found["rows"][0];
        for key in ["m1", "m2", "c1", "c2"] {
            assert_near(key, &all[key], &own[key]);
        }
        assert_eq!(all["n"], own["galaxies"], "{name}");
        let no_truth = columns(&["g1=none", "g2=none"]);
        let found = folder.json(&format!("bias c.csv {no_truth}"));
        let score = "score --truth truth.csv --truth-sign standard c.csv";
        let scored = folder.json(&format!("{score} {no_truth}"));
        for k in 0..2 {
            let key = ["c1", "c2"][k];
            assert_near(key, &found["rows"][0][key], &own["mean"][k]);
            assert_near(key, &scored["mean_shear"]["e"][k], &own["mean"][k]);
        }
        let rejected = GALAXIES - number(&own["galaxies"]);
        assert_eq!(number(&scored["rows"]["not_finite"]), rejected, "{name}");
    }
}

#[test]
fn plain_catalogues_of_shearq_have_its_convention() {
    let folder = Folder::with_set(2);
    folder.measure("--submission 48/linear/star");
    // Metrics and the convention, without the number of the set and its kind.
    let scored = |line: &str| {
        let table = folder.run(&format!("{line} --format csv"));
        let cells = table.lines().nth(1).unwrap().splitn(3, ',').last();
        cells.unwrap().to_owned()
    };
    let measured = scored("score --measured out --wide");
    let plain = "out/set02/catalogue-001.parquet out/set02/catalogue-002.parquet";
    let plain = format!("score --truth data/set02/truth.csv {plain}");
    // 128 galaxies do not determine a convention.
    assert_eq!(scored(&format!("{plain} --wide")), measured);
    assert!(!folder.said(&plain).contains("cannot determine the sign"));
    // Beside a table of another program, columns are recognised: without a response, it is another measurement.
    let copy = "out/set02/catalogue-001.parquet";
    folder.write("other.csv", "x,y,e1,e2\n24.5,24.5,0.1,0.1\n");
    folder.refuses(
        &format!("score --truth data/set02/truth.csv {copy} other.csv"),
        "other.csv: its columns are not the columns of",
    );
}

#[test]
fn check_expects_the_images_that_the_data_have() {
    let folder = Folder::with_set(2);
    folder.run("simulate --fixed-psf one --images 1 --grid 8 --seed 5 --out more --sets 5");
    std::fs::rename(folder.at("more/set05"), folder.at("data/set05")).unwrap();
    folder.measure("--submission 48/linear/star");
    folder.run("pack --measured out --method OWN --out sent");
    let check = |options: &str| {
        let line = format!("shearq check sent {options}");
        String::from_utf8(shell(folder.root(), &line).stdout).unwrap()
    };
    assert!(!check("--data data").contains("[images]"));
    assert!(check("--grid 8").contains("warning [images]: set 5 has 1 images, and another set 2"));
    assert!(check("--grid 8 --images 2").contains("set 5 lacks 1 of 2 images: 2"));
}
