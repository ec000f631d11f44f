//! Aperture masses against TreeCorr and the sum over pairs, and limits of the scores of GREAT3 and GREAT08. The figures of whole
//! submissions are those of the challenge's own functions in the project's `tests/it/great3.rs`.

use std::fs;

use flate2::read::GzDecoder;
use serde_json::Value;
use shearq_quantities::Shear;
use shearq_quantities::units::Degrees;
use shearq_scoring::aperture::{Correlations, Lattice, LatticeShear, SEPARATION_BINS, separations};
use shearq_scoring::great3::{
    ConstantField, Identity, Observation, along, constant_score, position_angle, variable_score,
};
use shearq_scoring::great08;
use shearq_scoring::{Grid, ScoringError};

use crate::common::{Content, Normal, field};

// Rows of numbers of a file of a case, and the words of their first column.
fn rows(case: &str, file: &str) -> Vec<(String, Vec<f64>)> {
    let path = format!("tests/data/great3/{case}/{file}.txt.gz");
    let text = GzDecoder::new(fs::File::open(path).unwrap());
    let text = std::io::read_to_string(text).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines
        .map(|line| {
            let mut words = line.split_whitespace();
            let name = words.next().unwrap().to_owned();
            (name, words.map(|word| word.parse().unwrap()).collect())
        })
        .collect()
}

fn expected(case: &str) -> Value {
    let text = fs::read_to_string(format!("tests/data/great3/{case}/expected.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

#[test]
fn aperture_masses_are_those_of_treecorr_with_every_pair() {
    for case in ["p6_aperture", "p7_aperture_weights_holes"] {
        let mut galaxies = LatticeShear::new(Lattice::GREAT3).unwrap();
        for (id, own) in rows(case, "catalogue") {
            // 10 marks a galaxy that was not measured.
            if own[2] < 10.0 && own[3] < 10.0 {
                let node = (id[3..6].parse().unwrap(), id[6..].parse().unwrap());
                galaxies
                    .add(node, Shear::new(own[2], own[3]), own[4])
                    .unwrap();
            }
        }
        let expected = expected(case);
        let found = galaxies.correlations();
        let masses = found.aperture_mass();
        let values = expected["map_E"].as_array().unwrap().iter();
        let moduli = values.map(|value| value.as_f64().unwrap().abs());
        let map = moduli.fold(0.0, f64::max);
        for (key, found, tolerance) in [
            ("theta", masses.theta, 1e-12),
            ("pairs", found.pairs, 0.0),
            // TreeCorr keeps shears in 32 bits: ξ± of order 10⁻³ have errors of 10⁻¹².
            ("xi_plus", found.xi_plus, 1e-11),
            ("xi_minus", found.xi_minus, 1e-11),
            ("map_E", masses.map_e, 1e-8 * map),
            ("map_B", masses.map_b, 1e-8 * map),
        ] {
            for (b, found) in found.into_iter().enumerate() {
                let value = expected[key][b].as_f64().unwrap();
                let off = (found - value).abs();
                assert!(
                    off <= tolerance,
                    "{case}: {key}[{b}]: found {found}, expected {value}"
                );
            }
        }
    }
}

fn assert_alike(fast: &Correlations, plain: &Correlations) {
    assert_eq!(fast.pairs, plain.pairs);
    for (fast, plain) in [
        (fast.mean_r, plain.mean_r),
        (fast.xi_plus, plain.xi_plus),
        (fast.xi_minus, plain.xi_minus),
        (fast.variance, plain.variance),
    ] {
        for (fast, plain) in fast.into_iter().zip(plain) {
            // Transforms round sums of order 1 to some 1e-15.
            assert!((fast - plain).abs() < 1e-12, "{fast} {plain}");
        }
    }
}

#[test]
fn transforms_equal_the_sum_over_pairs() {
    // 0.02° and 10° are lags of the second and third lattice, where each pair is tested by itself.
    for (side, field) in [(30, 10.0), (12, 0.24), (17, 17.0), (1, 10.0)] {
        let mut normal = Normal(side as u64);
        let field = Degrees(field);
        let mut galaxies = LatticeShear::new(Lattice { side, field }).unwrap();
        for _ in 0..side * side {
            let mut at = || (normal.uniform() * side as f64) as usize;
            let node = (at(), at());
            let g = Shear::new(0.1 * normal.draw(), 0.1 * normal.draw());
            galaxies.add(node, g, normal.uniform()).unwrap();
        }
        assert_alike(&galaxies.correlations(), &galaxies.correlations_by_pairs());
    }
}

#[test]
fn e_modes_have_no_b_mode_and_turn_into_it() {
    let n = 60;
    let grid = Grid::great10(n).unwrap();
    let shears = field(&grid, Content::E, 5);
    let masses = |turn: f64| {
        let field = Degrees(10.0);
        let mut galaxies = LatticeShear::new(Lattice { side: n, field }).unwrap();
        for (node, g) in shears.indexed_iter() {
            let g = along(
                Shear::new(g.re, g.im),
                shearq_quantities::units::Radians(turn),
            );
            galaxies
                .add(node, Shear::new(g.plus, g.cross), 1.0)
                .unwrap();
        }
        galaxies.correlations().aperture_mass()
    };
    let (plain, turned) = (masses(0.0), masses(std::f64::consts::FRAC_PI_4));
    // From some cells to a third of the field, where bins have pairs and the field does not cut them.
    for b in 8..12 {
        assert!(plain.map_e[b] > 3.0 * plain.map_b[b].abs(), "{plain:?}");
        assert!((plain.map_e[b] - turned.map_b[b]).abs() < 1e-12);
    }
}

#[test]
fn errors_of_aperture_masses_are_the_scatter_of_noise() {
    let (side, field) = (24, Degrees(10.0));
    let mut normal = Normal(77);
    let fields = 200;
    let (mut squares, mut variances) = ([0.0; SEPARATION_BINS], [0.0; SEPARATION_BINS]);
    for _ in 0..fields {
        let mut galaxies = LatticeShear::new(Lattice { side, field }).unwrap();
        for cell in 0..side * side {
            let g = Shear::new(0.2 * normal.draw(), 0.2 * normal.draw());
            let node = (cell % side, cell / side);
            galaxies.add(node, g, 0.5 + normal.uniform()).unwrap();
        }
        let masses = galaxies.correlations().aperture_mass();
        for b in 0..SEPARATION_BINS {
            squares[b] += masses.map_e[b].powi(2);
            variances[b] += masses.error[b].powi(2);
        }
    }
    for b in 7..13 {
        // Of 200 values: 5 % of the scatter, times 4. Bins share galaxies, which adds some.
        let ratio = (squares[b] / variances[b]).sqrt();
        assert!((0.8..1.25).contains(&ratio), "{b}: {ratio}");
    }
}

#[test]
fn perfect_submissions_reach_the_ceilings() {
    let fields: Vec<ConstantField> = (0..20)
        .map(|k| {
            let truth = Shear::new(0.002 * f64::from(k), 0.03 - 0.001 * f64::from(k));
            ConstantField {
                truth,
                submitted: truth,
                psf: Shear::new(0.01, -0.02),
            }
        })
        .collect();
    let masses = [[1e-6; SEPARATION_BINS]; 10];
    for (observation, q_c, q_v) in [
        (Observation::Ground, 1232.0, 1.837e-4 / 9e-8),
        (Observation::Space, 2464.0, 1.837e-4 / 4e-8),
    ] {
        let found = constant_score(&fields, observation).unwrap();
        assert!((found.q - q_c).abs() < 1e-6);
        let found = variable_score(&masses, &masses, observation).unwrap();
        assert!((found.q - q_v).abs() < 1e-6);
    }
    // Differences of one field outside of the ten bins do not count, those inside by a tenth of their mean over fields.
    let mut off = masses;
    off[3][2] += 1.0;
    off[3][13] += 1.0;
    off[3][3] += 9e-8 * 100.0;
    let found = variable_score(&off, &masses, Observation::Ground).unwrap();
    assert!((found.q - 0.5 * 1.837e-4 / 9e-8).abs() < 1e-6, "{found:?}");
}

#[test]
fn components_follow_the_axis_of_the_psf() {
    let psf = Shear::new(0.0, 0.03);
    let found = along(Shear::new(0.01, 0.02), position_angle(psf));
    assert!((found.plus - 0.02).abs() < 1e-15 && (found.cross + 0.01).abs() < 1e-15);
}

#[test]
fn great08_averages_images_within_the_square() {
    // Differences of ±0.01 around 3·10⁻⁴ and −10⁻⁴ in the two components of one set, 0 in the other.
    let set = vec![Shear::new(0.0103, -0.0101), Shear::new(-0.0097, 0.0099)];
    let found = great08::score(&[set, vec![Shear::ZERO; 3]]).unwrap();
    let square: f64 = (9e-8 + 1e-8) / 4.0;
    assert!((found.q / (1e-4 / square) - 1.0).abs() < 1e-9);
    // The nominal target.
    let set = vec![Shear::new(1e-7_f64.sqrt(), 1e-7_f64.sqrt())];
    assert!((great08::score(&[set]).unwrap().q - 1000.0).abs() < 1e-6);
}

#[test]
fn impossible_input_is_an_error() {
    let mut galaxies = LatticeShear::new(Lattice::GREAT3).unwrap();
    let outside = galaxies.add((700, 0), Shear::ZERO, 1.0);
    assert!(matches!(outside, Err(ScoringError::OutsideLattice { .. })));
    let nan = galaxies.add((0, 0), Shear::new(f64::NAN, 0.0), 1.0);
    assert!(matches!(nan, Err(ScoringError::NotFinite(_))));
    let field = ConstantField {
        truth: Shear::new(0.01, 0.01),
        submitted: Shear::ZERO,
        psf: Shear::ZERO,
    };
    let same = constant_score(&[field; 5], Observation::Ground);
    assert_eq!(same, Err(ScoringError::SameShears));
    assert!(variable_score(&[[0.0; 15]], &[], Observation::Space).is_err());
    // Fields without a partner on either side, and none.
    for [sent, of_truth] in [[1, 2], [2, 1], [0, 0]] {
        let fields = |count: usize| vec![[1e-6; 15]; count];
        let result = variable_score(&fields(sent), &fields(of_truth), Observation::Space);
        assert!(matches!(result, Err(ScoringError::Count { found, .. }) if found == sent));
    }
    assert!(great08::score(&[]).is_err() && great08::score(&[vec![]]).is_err());
    assert!((separations()[3].0 - 0.0853).abs() < 5e-5);
}

#[test]
fn identities_state_subfield_column_and_row() {
    let identity = Identity::new(12, (34, 56));
    assert_eq!(identity.to_string(), "012034056");
    assert_eq!((identity.subfield(), identity.place()), (12, (34, 56)));
}
