//! The leaderboard definition against metrics of the challenge's own scoring program.
//!
//! The cases and what they were made from lie in `tests/data`.

use std::fs;
use std::path::Path;

use flate2::read::GzDecoder;
use serde_json::{Value, json};
use shearq_scoring::{
    Bias, BiasFits, ConventionClass, ConventionScore, Grid, Noise, Options, Row, SetImages,
    SetScore, SetScorer, TrueShear, TruthSign,
};

use crate::common::sum_of;

fn rows(path: &Path) -> Vec<Row> {
    let file = fs::File::open(format!("{}.gz", path.display())).expect("readable case file");
    let text = std::io::read_to_string(GzDecoder::new(file)).expect("gzip-compressed text");
    let row = |line: &str| {
        let numbers = line.split(',').map(|field| field.parse().expect("number"));
        let [x, y, e1, e2] = numbers.collect::<Vec<f64>>().try_into().expect("4 numbers");
        Row { x, y, e1, e2 }
    };
    text.lines().skip(1).map(row).collect()
}

fn score(case: &Path, expected: &Value) -> SetScore {
    let grid = Grid::great10(expected["n"].as_u64().expect("n") as usize).unwrap();
    let truth = rows(&case.join("truth.csv"));
    let truth = TrueShear::from_rows(&grid, TruthSign::Challenge, truth).unwrap();
    let mut images = SetImages::new(&grid);
    for name in expected["files"]["catalogues"].as_array().expect("files") {
        let rows = rows(&case.join(name.as_str().expect("name")));
        images.add(&sum_of(&grid, &rows).0).unwrap();
    }
    let options = Options {
        noise: Noise::Given(expected["noise_var"].as_f64().expect("noise_var")),
        ..Options::default()
    };
    let scorer = SetScorer::new(grid, truth, options).unwrap();
    scorer.score(&images).unwrap()
}

fn fits(fits: &BiasFits) -> Value {
    let bias = |b: &Bias| json!({"M": b.M, "A": b.A, "sqrtA": b.sqrtA, "m": b.m_half});
    json!({"l2": bias(&fits.l2), "mode": bias(&fits.mode), "cl": bias(&fits.cl),
        "cl_over_2pi": bias(&fits.cl_over_2pi)})
}

fn class(class: &ConventionScore, correlation: f64) -> Value {
    let noise = "noise is given";
    json!({"EE": class.ee, "BB": class.bb, "Q": class.quality.q, "sigma_sys": class.quality.sigma_sys,
        "Q_dn": class.quality_dn.expect(noise).q, "fit": fits(&class.fit),
        "fit_dn": fits(class.fit_dn.as_ref().expect(noise)), "corr": correlation})
}

/// The figures of a case under the names of its own program.
fn figures(score: &SetScore) -> Value {
    let bins = &score.bins;
    let q = |k: usize| (format!("{}", k + 1), json!(score.conventions[k].quality.q));
    let correlation = |class| score.matching.class_correlation(class);
    json!({"l_min": score.grid.l_min().0, "l_max": score.grid.l_max().0, "dlogl": bins.width,
        "n_modes": bins.modes, "sum_l": bins.sum_l, "ll": bins.l, "dll": bins.dln_l,
        "P_noise": score.noise.expect("noise is given"),
        "truth": {"EE": score.true_ee, "BB": score.true_bb},
        "Q_per_convention": (0..8).map(q).collect::<serde_json::Map<_, _>>(),
        "classes": {"A": class(&score.conventions[5], correlation(ConventionClass::A)),
            "B": class(&score.conventions[4], correlation(ConventionClass::B))},
        // Conventions of one class tie up to rounding: the winner is compared by class.
        "winner_class": format!("{:?}", score.best.class()),
        "matched": score.matching.best().number()})
}

/// Notes each figure of `found` that is not the expected one.
fn compare(what: &str, found: &Value, expected: &Value, tolerance: f64, wrong: &mut Vec<String>) {
    match found {
        Value::Object(entries) => {
            for (key, value) in entries {
                compare(
                    &format!("{what}.{key}"),
                    value,
                    &expected[key],
                    tolerance,
                    wrong,
                );
            }
        }
        Value::Array(values) => {
            assert_eq!(
                values.len(),
                expected.as_array().expect(what).len(),
                "{what}"
            );
            for (bin, value) in values.iter().enumerate() {
                // A bin without modes has no figure.
                if !expected[bin].is_null() {
                    compare(what, value, &expected[bin], tolerance, wrong);
                }
            }
        }
        Value::Number(number) => {
            let (f, e) = (number.as_f64().unwrap(), expected.as_f64().expect(what));
            // Powers of B modes are rounding of those of E, which are up to 3·10⁻⁵: 10⁻⁶ of them; M and correlations are differences of
            // nearly equal numbers.
            let scale = match what.rsplit('.').next() {
                Some("EE" | "BB") => 3e-11,
                Some("M" | "m" | "corr") => 1e-3,
                _ => 0.0,
            };
            if (f - e).abs() > tolerance * e.abs().max(scale) {
                wrong.push(format!("{what}: found {f:e}, expected {e:e}"));
            }
        }
        _ if found != expected => wrong.push(format!("{what}: {found}, expected {expected}")),
        _ => {}
    }
}

#[test]
fn every_public_figure_is_reproduced() {
    let (mut wrong, mut cases) = (Vec::new(), 0);
    for entry in fs::read_dir("tests/data").expect("the folder of cases") {
        let case = entry.expect("readable folder").path();
        let Ok(text) = fs::read_to_string(case.join("expected.json")) else {
            continue;
        };
        cases += 1;
        let expected: Value = serde_json::from_str(&text).expect("valid JSON");
        let name = expected["case"].as_str().expect("case");
        // The cases' own README: 1e-9, and 1e-8 where nearly equal powers are subtracted.
        let tolerance = if name.contains("tiny_noise") {
            1e-8
        } else {
            1e-9
        };
        let found = figures(&score(&case, &expected));
        compare(name, &found, &expected, tolerance, &mut wrong);
    }
    assert_eq!(cases, 4);
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
