//! Units of the errors, differences of two programs, and what is refused.

#![allow(clippy::unwrap_used, reason = "a failed test stops at the cause")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_bias::{
    BiasError, Catalogue, Design, Grouping, Layout, Measured, Range, Row, UnitSums, difference,
    estimate, group,
};

const GAMMA: f64 = 0.04;
const PAIR: [[f64; 2]; 2] = [[GAMMA, -GAMMA], [-GAMMA, GAMMA]];

fn catalogue(name: &str, rows: u64, g: [f64; 2]) -> Catalogue {
    Catalogue {
        name: name.into(),
        rows,
        shear: g.map(|g| Range { low: g, high: g }),
        ..Catalogue::default()
    }
}

/// A galaxy with a response of one.
fn row(e: [f64; 2], weight: f64, g: [f64; 2]) -> Row {
    Row {
        e,
        weight,
        response: [[weight, 0.0], [0.0, weight]],
        g,
        ..Row::default()
    }
}

/// Shapes and weights of galaxies.
fn galaxies(seed: u64, count: usize) -> Vec<([f64; 2], f64)> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut shape = || rng.random_range(-0.4..0.5);
    let galaxies = (0..count).map(|_| [shape(), shape(), shape()]);
    galaxies.map(|[a, b, w]| ([a, b], 1.0 + w)).collect()
}

/// m and c of weighted shapes under a pair of shears, with a sum over all but one galaxy.
fn plain(rows: &[Vec<Row>; 2], without: Option<usize>) -> [f64; 4] {
    let mut found = [0.0; 4];
    for k in 0..2 {
        let (mut matrix, mut right) = ([[0.0; 2]; 2], [0.0; 2]);
        for row in rows.iter().flat_map(|rows| {
            let rows = rows.iter().enumerate();
            rows.filter(|(at, _)| Some(*at) != without)
                .map(|(_, row)| row)
        }) {
            let z = [1.0, row.g[k]];
            for s in 0..2 {
                right[s] += row.weight * row.e[k] * z[s];
                for t in 0..2 {
                    matrix[s][t] += row.weight * z[s] * z[t];
                }
            }
        }
        let determinant = matrix[0][0] * matrix[1][1] - matrix[0][1] * matrix[1][0];
        found[2 * k] = (matrix[0][0] * right[1] - matrix[1][0] * right[0]) / determinant - 1.0;
        found[2 * k + 1] = (matrix[1][1] * right[0] - matrix[0][1] * right[1]) / determinant;
    }
    found
}

/// The root of (n − 1)/n Σ (x − ⟨x⟩) (y − ⟨y⟩) over galaxies that are left out, before the root.
fn jackknife(left_out: &[[f64; 4]], x: usize, y: usize) -> f64 {
    let n = left_out.len() as f64;
    let mean = |k: usize| left_out.iter().map(|own| own[k]).sum::<f64>() / n;
    let means = [mean(x), mean(y)];
    let products = left_out
        .iter()
        .map(|own| (own[x] - means[0]) * (own[y] - means[1]));
    (n - 1.0) / n * products.sum::<f64>()
}

fn rows_of(shapes: &[([f64; 2], f64)], m: f64) -> [Vec<Row>; 2] {
    PAIR.map(|g| {
        let row = |(at, (shape, weight)): (usize, &([f64; 2], f64))| {
            // Noise that differs under both signs.
            let noise = 0.1 * ((at as f64 * 1.7 + g[0] * 99.0).sin());
            row(
                [0, 1].map(|k| (1.0 + m) * (shape[k] + g[k]) + noise),
                *weight,
                g,
            )
        };
        shapes.iter().enumerate().map(row).collect()
    })
}

fn sums_of(rows: &[Vec<Row>; 2]) -> UnitSums {
    let mut sums = UnitSums::new(Layout::default(), 1, 2);
    for (catalogue, rows) in (0..).zip(rows) {
        for (key, row) in (0..).zip(rows) {
            sums.add(catalogue, key, 0, row);
        }
    }
    sums
}

const KEYS: [&str; 4] = ["m1", "c1", "m2", "c2"];

fn close(found: f64, expected: f64) -> bool {
    (found - expected).abs() < 1e-9 * expected.abs().max(1.0)
}

#[test]
fn values_errors_and_covariance_are_those_of_plain_loops() {
    let rows = rows_of(&galaxies(1, 40), 0.1);
    let found = estimate(&sums_of(&rows).by_key(|_| 0), 0, true).unwrap();
    let left_out: Vec<[f64; 4]> = (0..40).map(|at| plain(&rows, Some(at))).collect();
    for (k, (key, expected)) in KEYS.into_iter().zip(plain(&rows, None)).enumerate() {
        let Measured { value, error } = found.value(key).unwrap();
        assert!(close(value, expected), "{key}: {value}, {expected}");
        let expected = jackknife(&left_out, k, k).sqrt();
        assert!(close(error, expected), "{key}: ± {error}, {expected}");
    }
    assert!(close(
        found.covariance().unwrap(),
        jackknife(&left_out, 0, 2)
    ));
    let mean = found.value("m_mean").unwrap();
    let [m1, m2] = ["m1", "m2"].map(|key| found.value(key).unwrap());
    assert!(close(mean.value, (m1.value + m2.value) / 2.0));
    let variance = (m1.error.powi(2) + m2.error.powi(2)) / 4.0 + found.covariance().unwrap() / 2.0;
    assert!(close(mean.error, variance.sqrt()));
    assert_eq!(found.value("r_mean").unwrap().value, 1.0);
    let weights = || rows.iter().flatten().map(|row| row.weight);
    let effective = weights().sum::<f64>().powi(2) / weights().map(|w| w * w).sum::<f64>();
    assert!(close(found.effective, effective));
    assert_eq!((found.galaxies, found.units), (80, 40));
}

#[test]
fn differences_of_two_programs_have_paired_errors() {
    let shapes = galaxies(2, 30);
    let [first, mut second] = [rows_of(&shapes, 0.1), rows_of(&shapes, -0.05)];
    // The second program lacks a galaxy.
    second.iter_mut().for_each(|rows| rows.truncate(29));
    let [a, b] = [&first, &second].map(|rows| sums_of(rows).by_key(|_| 0));
    let found = difference(&a, &b, 0, true).unwrap();
    let both = |without: Option<usize>| {
        let [a, b] = [&first, &second].map(|rows| plain(rows, without));
        [0, 1, 2, 3].map(|k| a[k] - b[k])
    };
    let left_out: Vec<[f64; 4]> = (0..30).map(|at| both(Some(at))).collect();
    for (k, (key, expected)) in KEYS.into_iter().zip(both(None)).enumerate() {
        let Measured { value, error } = found.value(key).unwrap();
        assert!(close(value, expected), "{key}: {value}, {expected}");
        assert!(
            close(error, jackknife(&left_out, k, k).sqrt()),
            "{key}: ± {error}"
        );
    }
    assert_eq!((found.galaxies, found.units), (58, 30));
    let alone = estimate(&a, 0, true).unwrap();
    assert!(found.value("m1").unwrap().error < 0.5 * alone.value("m1").unwrap().error);
}

#[test]
fn a_response_without_significance_is_refused_with_its_sign() {
    let found = |response: [f64; 2]| {
        let mut sums = UnitSums::new(Layout::default(), 1, 1);
        for key in 0..50 {
            let scatter = 0.1 * (key as f64).sin();
            let mut row = row([0.1, scatter], 1.0, [0.0; 2]);
            row.response = [[response[0] + scatter, 0.0], [0.0, response[1] + scatter]];
            sums.add(0, key, 0, &row);
        }
        estimate(&sums.by_key(|_| 0), 0, false)
    };
    assert!(found([0.5, 0.5]).is_ok());
    // The error of the mean is about 0.01.
    for (response, component, words) in [
        ([0.02, 0.5], 1, "too close to zero"),
        ([-0.02, 0.5], 1, "too close to zero"),
        ([0.5, -0.5], 2, "is negative"),
    ] {
        let error = found(response).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
        assert!(matches!(error, BiasError::Response { component: k, .. } if k == component));
    }
}

#[test]
fn a_sheared_catalogue_without_galaxies_is_named() {
    let layout = Layout {
        sheared: true,
        ..Layout::default()
    };
    let mut sums = UnitSums::new(layout, 1, 1);
    for key in 0..5 {
        sums.add(0, key, 0, &row([0.1, 0.2], 1.0, [0.0; 2]));
        for sheared in [0, 1, 3] {
            sums.add_sheared(0, key, 0, sheared, ([0.1; 2], 1.0));
        }
    }
    let error = estimate(&sums.by_key(|_| 0), 0, false).unwrap_err();
    assert_eq!(error, BiasError::Sheared { name: "2p" });
}

/// The units of a pair of catalogues, whose second one has other galaxies under `shifted` keys.
fn paired(count: usize, shifted: usize, rows: [u64; 2]) -> Grouping {
    let shapes = galaxies(3, count + shifted);
    let mut sums = UnitSums::new(Layout::default(), 1, 2);
    for (number, g) in PAIR.into_iter().enumerate() {
        for key in 0..count {
            let (shape, weight) = shapes[key + number * shifted];
            let e = [0, 1].map(|k| shape[k] + g[k]);
            sums.add(number as u32, key as u64, 0, &row(e, weight, g));
        }
    }
    let catalogues = [0, 1].map(|k| catalogue(["a", "b"][k], rows[k], PAIR[k]));
    group(sums, &catalogues, Design::Pairs, None, false)
}

#[test]
fn rows_that_do_not_correspond_are_noticed() {
    let same = paired(300, 0, [300; 2]);
    assert_eq!((same.uncorrelated, same.misaligned), (None, false));
    assert_eq!(same.unit, "the same rows of all catalogues");
    assert!(same.without_partner.is_none());
    let other = paired(300, 7, [300; 2]);
    assert!(other.uncorrelated.unwrap().abs() < 0.15, "{other:?}");
    assert!(other.without_partner.is_none());
    // 2 × 100 numbers are too few to tell.
    assert!(paired(100, 7, [100; 2]).uncorrelated.is_none());
    assert!(paired(300, 0, [300, 310]).misaligned);
}

#[test]
fn a_catalogue_of_each_shear_makes_a_set() {
    let shears = [[0.02, 0.0], [-0.02, 0.0], [0.0, 0.02], [0.0, -0.02]];
    let grouped = |versions: usize| {
        let mut sums = UnitSums::new(Layout::default(), 1, 24 * 4 * versions);
        let mut catalogues = Vec::new();
        for (tile, version) in (0..24).flat_map(|tile| (0..versions).map(move |v| (tile, v))) {
            for g in shears {
                let at = catalogues.len() as u32;
                let name = format!("g{}{}/v{version}/tile{tile}.fits", g[0], g[1]);
                catalogues.push(catalogue(&name, 1, g));
                sums.add(at, 0, 0, &row([0.1 * f64::from(at % 7), 0.1], 1.0, g));
            }
        }
        group(sums, &catalogues, Design::Arms, None, false).unit
    };
    assert_eq!(
        grouped(1),
        "sets of catalogues with one catalogue per shear"
    );
    assert_eq!(grouped(2), "sets of catalogues of the same galaxies");
}

#[test]
fn catalogues_without_weight_or_response_count_less() {
    let effective = |second: [f64; 2]| {
        let mut sums = UnitSums::new(Layout::default(), 1, 2);
        for (number, [first, other]) in (0..).zip([[1.0, 1.0], second]) {
            let response = [[first, 0.0], [0.0, other]];
            let of_two = Row {
                response,
                ..row([0.1; 2], 1.0, PAIR[0])
            };
            // In two units of a catalogue.
            (0..2).for_each(|key| sums.add(number, key, 0, &of_two));
        }
        sums.effective_catalogues()
    };
    assert_eq!(effective([1.0, 1.0]), 2.0);
    // (1 + 3)²/(1 + 9), and the component with the smaller number.
    assert_eq!(effective([3.0, 1.0]), 1.6);
    assert_eq!(effective([1.0, 0.0]), 1.0);
}

#[test]
fn without_names_the_assumption_is_stated() {
    let sums = |count: u32| {
        let mut sums = UnitSums::new(Layout::default(), 1, count as usize);
        let mut catalogues = Vec::new();
        for number in 0..count {
            let g = PAIR[usize::from(number >= count / 2)];
            // Numbers that go on from one shear to the other.
            catalogues.push(catalogue(&format!("run{number}"), 1, g));
            sums.add(
                number,
                0,
                0,
                &row([f64::from(number % 7) * 0.1, 0.1], 1.0, g),
            );
        }
        (sums, catalogues)
    };
    let grouped = |by_key, matched| {
        let (sums, catalogues) = sums(60);
        group(sums, &catalogues, Design::Pairs, by_key, matched)
    };
    let by_order = grouped(None, false);
    assert!(by_order.assumed_different);
    assert_eq!(by_order.unit, "pairs of catalogues");
    assert_eq!(estimate(&by_order.units, 0, true).unwrap().units, 30);
    // Identifiers state which galaxies are the same.
    let matched = grouped(None, true);
    assert!(!matched.assumed_different);
    assert_eq!(matched.unit, "galaxies with the same identifier");
}

#[test]
fn many_bins_keep_fewer_units() {
    let layout = Layout {
        psf: true,
        sheared: true,
        matrix: true,
    };
    let mut sums = UnitSums::new(layout, 400, 1);
    for key in 0..3000 {
        let row = row([0.1, 0.2], 1.0, [0.0; 2]);
        sums.add(0, key, (key % 400) as usize, &row);
        for sheared in 0..4 {
            let e = if sheared % 2 == 0 {
                [0.5; 2]
            } else {
                [-0.5; 2]
            };
            sums.add_sheared(0, key, 0, sheared, (e, 1.0));
        }
    }
    let units = sums.by_key(|_| 0).all_bins();
    let found = estimate(&units, 0, false).unwrap();
    // 256 units of 12 keys would be 250; keys join by powers of two.
    assert!((128..=256).contains(&found.units), "{}", found.units);
    assert_eq!(found.galaxies, 3000);
}

#[test]
fn appended_catalogues_are_numbered_on_and_others_refused() {
    let single = |shift: f64| {
        let mut sums = UnitSums::new(Layout::default(), 1, 1);
        for key in 0..4 {
            sums.add(
                0,
                key,
                0,
                &row([0.1 * key as f64 + shift, 0.3 - shift], 1.0, [0.0; 2]),
            );
        }
        sums
    };
    let mut all = single(0.0);
    all.append(single(0.05)).unwrap();
    all.append(single(0.2)).unwrap();
    let found = estimate(&all.by_group(|_| 0, |catalogue| catalogue), 0, false).unwrap();
    assert_eq!((found.units, found.galaxies), (3, 12));
    assert!(close(found.value("c1").unwrap().value, 0.15 + 0.25 / 3.0));
    let mut one = single(0.0);
    let other = UnitSums::new(Layout::default(), 2, 1);
    let error = one.merge(other).unwrap_err();
    assert!(matches!(
        error,
        BiasError::Layouts {
            found_bins: 2,
            expected_bins: 1,
            ..
        }
    ));
}
