//! The leaderboard definition against metrics of the challenge's own scoring program.
//!
//! The cases and what they were made from lie in `tests/data`.

use std::fs;
use std::path::{Path, PathBuf};

use flate2::read::GzDecoder;
use serde_json::Value;
use shearq_scoring::{
    Bias, BiasFits, ConventionClass, ConventionScore, FieldSum, Grid, Noise, Options, Row,
    SetImages, SetScore, SetScorer, TrueShear, TruthSign,
};

fn cases() -> Vec<PathBuf> {
    let mut cases: Vec<PathBuf> = fs::read_dir("tests/data")
        .expect("the folder of cases")
        .map(|entry| entry.expect("readable folder").path())
        .filter(|path| path.is_dir())
        .collect();
    cases.sort();
    assert_eq!(cases.len(), 4);
    cases
}

fn rows(path: &Path) -> Vec<Row> {
    let file = fs::File::open(format!("{}.gz", path.display())).expect("readable case file");
    let text = std::io::read_to_string(GzDecoder::new(file)).expect("gzip-compressed text");
    text.lines()
        .skip(1)
        .map(|line| {
            let v: Vec<f64> = line
                .split(',')
                .map(|f| f.parse().expect("number"))
                .collect();
            Row {
                x: v[0],
                y: v[1],
                e1: v[2],
                e2: v[3],
            }
        })
        .collect()
}

fn score(case: &Path, expected: &Value) -> SetScore {
    let grid = Grid::great10(expected["n"].as_u64().expect("n") as usize).unwrap();
    let truth = rows(&case.join("truth.csv"));
    let truth = TrueShear::from_rows(&grid, TruthSign::Challenge, truth).unwrap();
    let mut images = SetImages::new(&grid);
    for name in expected["files"]["catalogues"].as_array().expect("files") {
        let mut image = FieldSum::new(&grid);
        image.add_image(&grid, rows(&case.join(name.as_str().expect("name"))));
        images.add(&image).unwrap();
    }
    let options = Options {
        noise: Noise::Given(expected["noise_var"].as_f64().expect("noise_var")),
        ..Options::default()
    };
    SetScorer::new(grid, truth, options)
        .unwrap()
        .score(&images)
        .unwrap()
}

struct Check<'a> {
    case: &'a str,
    tolerance: f64,
    failures: Vec<String>,
}

impl Check<'_> {
    fn close(&mut self, what: &str, found: f64, expected: &Value, scale: f64) {
        let wanted = expected
            .as_f64()
            .unwrap_or_else(|| panic!("{what} in expected.json"));
        let size = wanted.abs().max(scale);
        if (found - wanted).abs() > self.tolerance * size {
            self.failures.push(format!(
                "{}: {what}: found {found:e}, expected {wanted:e}",
                self.case
            ));
        }
    }

    fn list(&mut self, what: &str, found: &[f64], expected: &Value, scale: f64) {
        let wanted = expected
            .as_array()
            .unwrap_or_else(|| panic!("{what} in expected.json"));
        assert_eq!(found.len(), wanted.len(), "{what}");
        for (b, (f, w)) in found.iter().zip(wanted).enumerate() {
            if !w.is_null() {
                self.close(&format!("{what}[{b}]"), *f, w, scale);
            }
        }
    }

    fn bias(&mut self, what: &str, found: &Bias, expected: &Value) {
        self.close(&format!("{what}.M"), found.M, &expected["M"], 1e-3);
        self.close(&format!("{what}.A"), found.A, &expected["A"], 0.0);
        self.close(
            &format!("{what}.sqrtA"),
            found.sqrtA,
            &expected["sqrtA"],
            0.0,
        );
        self.close(&format!("{what}.m"), found.m_half, &expected["m"], 1e-3);
    }

    fn fits(&mut self, what: &str, found: &BiasFits, expected: &Value) {
        self.bias(&format!("{what}.l2"), &found.l2, &expected["l2"]);
        self.bias(&format!("{what}.mode"), &found.mode, &expected["mode"]);
        self.bias(&format!("{what}.cl"), &found.cl, &expected["cl"]);
        self.bias(
            &format!("{what}.cl_over_2pi"),
            &found.cl_over_2pi,
            &expected["cl_over_2pi"],
        );
    }

    fn class(&mut self, what: &str, found: &ConventionScore, expected: &Value) {
        // B-mode powers of a pure E field are rounding noise: compare them on the scale of E.
        let scale = found.ee.iter().copied().fold(0.0, f64::max) * 1e-6;
        self.list(&format!("{what}.EE"), &found.ee, &expected["EE"], scale);
        self.list(&format!("{what}.BB"), &found.bb, &expected["BB"], scale);
        self.close(&format!("{what}.Q"), found.quality.q, &expected["Q"], 0.0);
        self.close(
            &format!("{what}.sigma_sys"),
            found.quality.sigma_sys,
            &expected["sigma_sys"],
            0.0,
        );
        let dn = found.quality_dn.expect("noise is given");
        self.close(&format!("{what}.Q_dn"), dn.q, &expected["Q_dn"], 0.0);
        self.fits(&format!("{what}.fit"), &found.fit, &expected["fit"]);
        let fit_dn = found.fit_dn.as_ref().expect("noise is given");
        self.fits(&format!("{what}.fit_dn"), fit_dn, &expected["fit_dn"]);
    }
}

#[test]
fn every_public_figure_is_reproduced() {
    let mut failures = Vec::new();
    for case in cases() {
        let text = fs::read_to_string(case.join("expected.json")).expect("expected.json");
        let expected: Value = serde_json::from_str(&text).expect("valid JSON");
        let score = score(&case, &expected);
        let name = expected["case"].as_str().expect("case");
        let mut check = Check {
            case: name,
            // The cases' own README: 1e-9, and 1e-8 where nearly equal powers are subtracted.
            tolerance: if name.contains("tiny_noise") {
                1e-8
            } else {
                1e-9
            },
            failures: Vec::new(),
        };
        let bins = &score.bins;
        check.close("l_min", score.grid.l_min().0, &expected["l_min"], 0.0);
        check.close("l_max", score.grid.l_max().0, &expected["l_max"], 0.0);
        check.close("dlogl", bins.width, &expected["dlogl"], 0.0);
        let modes = bins.modes.map(|m| m as f64);
        check.list("n_modes", &modes, &expected["n_modes"], 0.0);
        check.list("sum_l", &bins.sum_l, &expected["sum_l"], 0.0);
        check.list("ll", &bins.l, &expected["ll"], 0.0);
        check.list("dll", &bins.dln_l, &expected["dll"], 0.0);
        let noise = score.noise.expect("noise is given");
        check.list("P_noise", &noise, &expected["P_noise"], 1e-30);
        let scale = score.true_ee.iter().copied().fold(0.0, f64::max) * 1e-6;
        check.list("truth.EE", &score.true_ee, &expected["truth"]["EE"], scale);
        check.list("truth.BB", &score.true_bb, &expected["truth"]["BB"], scale);
        for (name, q) in expected["Q_per_convention"].as_object().expect("eight Q") {
            let number: usize = name.parse().expect("number");
            let found = score.conventions[number - 1].quality.q;
            check.close(&format!("Q_per_convention.{name}"), found, q, 0.0);
        }
        check.class(
            "classes.A",
            &score.conventions[5],
            &expected["classes"]["A"],
        );
        check.class(
            "classes.B",
            &score.conventions[4],
            &expected["classes"]["B"],
        );
        for (name, class) in [("A", ConventionClass::A), ("B", ConventionClass::B)] {
            let corr = score.matching.class_correlation(class);
            check.close("corr", corr, &expected["classes"][name]["corr"], 1e-3);
        }
        failures.extend(check.failures);
        let class = |c: shearq_scoring::Convention| format!("{:?}", c.class());
        // Conventions of one class tie up to rounding: compare the winner by class.
        assert_eq!(
            class(score.best),
            expected["winner_class"].as_str().unwrap()
        );
        assert_eq!(
            u64::from(score.matching.best().number()),
            expected["matched"].as_u64().unwrap()
        );
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}
