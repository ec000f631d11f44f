//! Estimates of synthetic catalogues are unbiased, and their errors are the scatter of repeated draws.

#![allow(clippy::unwrap_used, reason = "a failed test stops at the cause")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_bias::{Catalogue, Design, Layout, Range, Row, StarNoise, UnitSums, estimate, group};

const M: [f64; 2] = [0.03, -0.05];
const C: [f64; 2] = [2e-3, -3e-3];
const ALPHA: f64 = 0.1;
const GAMMA: f64 = 0.05;
/// Scale of the weight 1/(1 + |e|²/s²).
const SCALE: f64 = 0.5;

/// How galaxies are weighted.
#[derive(Clone, Copy, PartialEq)]
enum Weights {
    Equal,
    /// Depending on e, with the derivative of the weight.
    OfShape,
    /// The same without the derivative.
    Incomplete,
}

struct Galaxies {
    rng: ChaCha8Rng,
    weights: Weights,
    /// Modulus of each component of shear.
    gamma: f64,
}

impl Galaxies {
    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.rng)
    }

    /// Noise, intrinsic ellipticity and response of a galaxy.
    fn galaxy(&mut self) -> [[f64; 2]; 3] {
        let noise = [0; 2].map(|_| 0.1 * self.normal());
        let intrinsic = [0; 2].map(|_| 0.25 * self.normal());
        let response = [0; 2].map(|_| 0.7 + 0.3 * self.normal());
        [noise, intrinsic, response]
    }

    /// The galaxy under a shear. The response of the row scatters around the response to shear, which is 0.7.
    fn row(&self, [noise, intrinsic, response]: [[f64; 2]; 3], g: [f64; 2], psf: [f64; 2]) -> Row {
        let e = [0, 1].map(|k| {
            let shear = (1.0 + M[k]) * g[k] + C[k] + ALPHA * psf[k];
            0.7 * shear + intrinsic[k] + noise[k]
        });
        let (weight, derivative) = match self.weights {
            Weights::Equal => (1.0, [0.0; 2]),
            _ => {
                let w = 1.0 / (1.0 + (e[0] * e[0] + e[1] * e[1]) / (SCALE * SCALE));
                (w, e.map(|e| -2.0 * e / (SCALE * SCALE) * w * w * 0.7))
            }
        };
        let [r11, r22] = [0, 1].map(|k| match self.weights {
            Weights::OfShape => weight * response[k] + e[k] * derivative[k],
            _ => weight * response[k],
        });
        Row {
            e,
            weight,
            response: [[r11, 0.0], [0.0, r22]],
            g,
            psf,
            psf_size: 1.0,
        }
    }
}

/// Shear for so many galaxies. With weights that depend on shape the response has terms of second order in the shear,
/// about γ²/σ², which must stay below the errors.
fn gamma(weights: Weights, count: usize) -> f64 {
    match (weights, count > 10_000) {
        (Weights::Equal, _) => GAMMA,
        (_, false) => 0.01,
        (_, true) => 0.001,
    }
}

/// Sums and descriptions of the catalogues of one draw.
struct Draw {
    sums: UnitSums,
    catalogues: Vec<Catalogue>,
}

impl Draw {
    fn new(catalogues: usize, psf: bool) -> Self {
        let layout = Layout {
            psf,
            ..Layout::default()
        };
        Draw {
            sums: UnitSums::new(layout, 1, catalogues),
            catalogues: vec![Catalogue::default(); catalogues],
        }
    }

    fn add(&mut self, catalogue: usize, key: usize, row: &Row) {
        let about = &mut self.catalogues[catalogue];
        about.rows += 1;
        for (range, g) in about.shear.iter_mut().zip(row.g) {
            range.add(g);
        }
        self.sums.add(catalogue as u32, key as u64, 0, row);
    }
}

/// Draws catalogues of a design with so many galaxies.
fn draw(design: Design, galaxies: &mut Galaxies, count: usize) -> Draw {
    let random = |galaxies: &mut Galaxies| {
        [0; 2].map(|_| galaxies.gamma * galaxies.rng.random_range(-1.0..1.0))
    };
    let gamma = galaxies.gamma;
    match design {
        Design::Galaxies => {
            let mut draw = Draw::new(1, true);
            for key in 0..count {
                let (galaxy, g) = (galaxies.galaxy(), random(galaxies));
                let psf = [0; 2].map(|_| 0.05 * galaxies.normal());
                draw.add(0, key, &galaxies.row(galaxy, g, psf));
            }
            draw
        }
        Design::Pairs | Design::Arms => {
            let mut shears = vec![[gamma, gamma], [-gamma, -gamma]];
            if design == Design::Arms {
                shears = vec![[gamma, 0.0], [-gamma, 0.0], [0.0, gamma], [0.0, -gamma]];
            }
            let mut draw = Draw::new(shears.len(), false);
            for key in 0..count {
                let galaxy = galaxies.galaxy();
                for (catalogue, g) in shears.iter().enumerate() {
                    draw.add(catalogue, key, &galaxies.row(galaxy, *g, [0.0; 2]));
                }
            }
            draw
        }
        Design::Fields => {
            let catalogues = 50;
            let mut draw = Draw::new(catalogues, false);
            for catalogue in 0..catalogues {
                let g = random(galaxies);
                for key in 0..count / catalogues {
                    let galaxy = galaxies.galaxy();
                    draw.add(catalogue, key, &galaxies.row(galaxy, g, [0.0; 2]));
                }
            }
            draw
        }
        Design::Rotated => {
            // Both galaxies of a pair have one key.
            let mut draw = Draw::new(1, false);
            for key in 0..count {
                let ([noise, intrinsic, response], g) = (galaxies.galaxy(), random(galaxies));
                let [other, _, second] = galaxies.galaxy();
                draw.add(
                    0,
                    key,
                    &galaxies.row([noise, intrinsic, response], g, [0.0; 2]),
                );
                let turned = intrinsic.map(|e| -e);
                draw.add(0, key, &galaxies.row([other, turned, second], g, [0.0; 2]));
            }
            draw
        }
        Design::Single | Design::Null => {
            let g = if design == Design::Null { 0.0 } else { gamma };
            let mut draw = Draw::new(1, false);
            for key in 0..count {
                let galaxy = galaxies.galaxy();
                draw.add(0, key, &galaxies.row(galaxy, [g; 2], [0.0; 2]));
            }
            draw
        }
    }
}

/// Mean pull, standard deviation of the pulls, and mean value of each quantity with its expectation.
fn pulls(
    design: Design,
    weights: Weights,
    (draws, count): (usize, usize),
    expected: &[(&str, f64)],
) -> Vec<[f64; 3]> {
    let rng = ChaCha8Rng::seed_from_u64(5);
    let gamma = gamma(weights, count);
    let mut galaxies = Galaxies {
        rng,
        weights,
        gamma,
    };
    let mut sums = vec![[0.0; 3]; expected.len()];
    for _ in 0..draws {
        let Draw {
            sums: units,
            catalogues,
        } = draw(design, &mut galaxies, count);
        let truth = design != Design::Null;
        let grouping = group(units, &catalogues, design, None, false);
        let found = estimate(&grouping.sums, 0, truth).unwrap();
        for (sums, (key, expected)) in sums.iter_mut().zip(expected) {
            let measured = found.value(key).unwrap();
            let pull = (measured.value - expected) / measured.error;
            sums[0] += pull;
            sums[1] += pull * pull;
            sums[2] += measured.value;
        }
    }
    let n = draws as f64;
    sums.iter()
        .map(|[pull, square, value]| [pull / n, (square / n).sqrt(), value / n])
        .collect()
}

const MC: [(&str, f64); 4] = [("m1", M[0]), ("m2", M[1]), ("c1", C[0]), ("c2", C[1])];

/// Checks pulls of `draws` draws.
fn check(design: Design, weights: Weights, draws: usize, count: usize, expected: &[(&str, f64)]) {
    let found = pulls(design, weights, (draws, count), expected);
    for ([pull, deviation, _], (key, _)) in found.iter().zip(expected) {
        // Four standard errors of the mean, and a ratio's bias of about its relative error squared.
        let tolerance = 4.0 / (draws as f64).sqrt() + 0.05;
        assert!(pull.abs() < tolerance, "{design:?} {key}: mean pull {pull}");
        // 10 %, as required, with four standard errors of the deviation.
        let tolerance = 0.1 + 4.0 / (2.0 * draws as f64).sqrt();
        assert!(
            (deviation - 1.0).abs() < tolerance,
            "{design:?} {key}: pulls scatter by {deviation}"
        );
    }
}

/// What a single shear determines: m, if c is zero.
fn of_single(weights: Weights, count: usize) -> [(&'static str, f64); 2] {
    let gamma = gamma(weights, count);
    [0, 1].map(|k| (["m1", "m2"][k], M[k] + C[k] / gamma))
}

#[test]
fn estimates_are_unbiased_and_errors_right_in_every_design() {
    let leakage = [MC.as_slice(), &[("alpha", ALPHA)]].concat();
    for weights in [Weights::Equal, Weights::OfShape] {
        check(Design::Galaxies, weights, 400, 400, &leakage);
        for design in [Design::Pairs, Design::Arms, Design::Rotated] {
            check(design, weights, 400, 300, &MC);
        }
        check(Design::Fields, weights, 400, 1000, &MC);
        check(Design::Single, weights, 400, 300, &of_single(weights, 300));
        check(Design::Null, weights, 400, 300, &MC[2..]);
    }
}

/// The same for 100 to 1,000,000 galaxies and 1,000 draws where that takes minutes.
#[test]
#[ignore = "takes minutes"]
fn errors_are_right_from_a_hundred_to_a_million_galaxies() {
    let leakage = [MC.as_slice(), &[("alpha", ALPHA)]].concat();
    for (count, draws) in [(100, 1000), (10_000, 1000), (1_000_000, 100)] {
        for weights in [Weights::Equal, Weights::OfShape] {
            check(Design::Galaxies, weights, draws, count, &leakage);
            for design in [Design::Pairs, Design::Arms, Design::Rotated, Design::Fields] {
                check(design, weights, draws, count, &MC);
            }
            check(
                Design::Single,
                weights,
                draws,
                count,
                &of_single(weights, count),
            );
            check(Design::Null, weights, draws, count, &MC[2..]);
        }
    }
}

#[test]
fn a_weight_that_depends_on_shear_needs_its_derivative() {
    let value = |weights| {
        let sizes = (40, 20_000);
        let found = pulls(Design::Pairs, weights, sizes, &MC[..2]);
        [found[0][2], found[1][2]]
    };
    let (with, without) = (value(Weights::OfShape), value(Weights::Incomplete));
    // The expectation: E[d(w e)/dg] over E[w dR/dg], by the midpoint rule in |e|², which is exponential with mean
    // 2 σ², σ² = 0.25² + 0.1². The mean of e1 dw/de1 is half the mean of |e| dw/d|e|.
    let (mut weight, mut slope) = (0.0, 0.0);
    let variance = 0.25 * 0.25 + 0.1 * 0.1;
    for k in 0..100_000 {
        let square = (f64::from(k) + 0.5) * 2e-4 * variance;
        let density = (-square / (2.0 * variance)).exp();
        let w = 1.0 / (1.0 + square / (SCALE * SCALE));
        weight += w * density;
        slope += (w - square / (SCALE * SCALE) * w * w) * density;
    }
    for k in 0..2 {
        // Terms of second order in the shear are below γ²/σ² = 0.002 of the response.
        assert!((with[k] - M[k]).abs() < 0.01, "{with:?}");
        let expected = (1.0 + M[k]) * slope / weight - 1.0;
        assert!(
            (without[k] - expected).abs() < 0.01,
            "{without:?}, {expected}"
        );
        assert!(expected < -0.1, "{expected}");
    }
}

/// Ellipticities of a galaxy without added shear, and with shears of ±0.01 added to each component.
#[test]
fn sheared_catalogues_give_the_response_of_a_selection() {
    let layout = Layout {
        sheared: true,
        ..Layout::default()
    };
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut sums = UnitSums::new(layout, 1, 2);
    let mut direct = UnitSums::new(Layout::default(), 1, 2);
    for key in 0..200_000 {
        let intrinsic =
            [0; 2].map(|_| 0.25 * Distribution::<f64>::sample(&StandardNormal, &mut rng));
        for (file, g) in [(0, GAMMA), (1, -GAMMA)] {
            // Galaxies are detected if e1 is small: the selection depends on shear.
            let detected = |e: [f64; 2]| e[0].abs() < 0.3;
            let e = intrinsic.map(|e| e + 0.8 * g);
            let row = Row {
                e,
                weight: 1.0,
                g: [g; 2],
                ..Row::default()
            };
            if detected(e) {
                sums.add(file, key, 0, &row);
                let response = [[0.8, 0.0], [0.0, 0.8]];
                direct.add(file, key, 0, &Row { response, ..row });
            }
            for (number, (_, catalogue)) in shearq_bias::SHEARED_CATALOGUES.iter().enumerate() {
                let mut sheared = e;
                sheared[catalogue.component] += if catalogue.plus { 0.008 } else { -0.008 };
                if detected(sheared) {
                    // The response is the difference over 0.02: scale here.
                    sums.add_sheared(file, key, 0, number, (sheared.map(|e| e / 0.02), 1.0));
                }
            }
        }
    }
    let of = |sums: UnitSums| estimate(&sums.by_key(), 0, true).unwrap();
    let (with, without) = (of(sums), of(direct));
    let (m, wrong) = (with.value("m1").unwrap(), without.value("m1").unwrap());
    assert!(m.value.abs() < 4.0 * m.error + 0.01, "{m:?}");
    assert!(wrong.value < -0.2, "{wrong:?}");
    // Component 2 is not selected.
    let m2 = with.value("m2").unwrap();
    assert!(m2.value.abs() < 4.0 * m2.error, "{m2:?}");
}

#[test]
fn many_units_are_joined_and_shards_merge_to_the_same_sums() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mut whole = UnitSums::new(Layout::default(), 2, 2);
    let mut parts = [whole.clone(), whole.clone()];
    for key in 0..50_000 {
        for (file, g) in [(0, 0.02), (1, -0.02)] {
            let e = [rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5)];
            let row = Row {
                e,
                weight: 1.0,
                response: [[1.0, 0.0], [0.0, 1.0]],
                g: [g; 2],
                ..Row::default()
            };
            let bin = (key % 2) as usize;
            whole.add(file, key, bin, &row);
            parts[file as usize].add(file, key, bin, &row);
        }
    }
    let [mut merged, other] = parts;
    merged.merge(other).unwrap();
    let [a, b] = [whole, merged].map(|sums| {
        let sums = sums.by_key();
        let all = estimate(&sums.all_bins(), 0, true).unwrap();
        assert!((512..=2048).contains(&all.units), "{}", all.units);
        (all, estimate(&sums, 1, true).unwrap())
    });
    for (a, b) in [(&a.0, &b.0), (&a.1, &b.1)] {
        for key in ["m1", "m2", "c1", "c2"] {
            let (a, b) = (a.value(key).unwrap(), b.value(key).unwrap());
            // Sums in another order differ by rounding.
            assert!((a.value - b.value).abs() < 1e-9 && (a.error / b.error - 1.0).abs() < 1e-6);
        }
    }
    let range = Range::default();
    assert!(range.constant().is_none());
}

#[test]
fn without_galaxies_units_or_response_there_is_an_error() {
    let mut sums = UnitSums::new(Layout::default(), 1, 1);
    let of = |sums: &UnitSums| estimate(sums, 0, false).unwrap_err();
    assert!(of(&sums).to_string().contains("no galaxy"));
    let mut row = Row {
        e: [0.1, 0.2],
        weight: 1.0,
        response: [[1.0, 0.0], [0.0, 1.0]],
        ..Row::default()
    };
    sums.add(0, 0, 0, &row);
    assert!(of(&sums).to_string().contains("found 1, expected 2"));
    for key in 1..100 {
        row.response[0][0] = if key % 2 == 0 { 1.0 } else { -1.0 };
        sums.add(0, key, 0, &row);
    }
    assert!(of(&sums).to_string().contains("mean response R11"));
}

/// Catalogues under ±γ, of which the k-th of each sign have the star `star(k)`, whose noise changes m and c.
fn behind_stars(
    galaxies: &mut Galaxies,
    pairs: usize,
    star: impl Fn(usize) -> Option<usize>,
) -> (UnitSums, Vec<Catalogue>) {
    const NOISE: [f64; 2] = [0.06, 4e-3];
    let layout = Layout {
        psf: true,
        ..Layout::default()
    };
    let mut sums = UnitSums::new(layout, 1, 2 * pairs);
    let mut catalogues = Vec::new();
    let faults: Vec<[f64; 3]> = (0..pairs)
        .map(|_| [0; 3].map(|_| galaxies.normal()))
        .collect();
    for number in 0..2 * pairs {
        let pair = number / 2;
        let fault = star(pair).map_or([0.0; 3], |star| faults[star]);
        let g = [if number % 2 == 0 { GAMMA } else { -GAMMA }; 2];
        for key in 0..300 {
            let response = 0.7;
            let e = [0, 1].map(|k| {
                let shear = (1.0 + NOISE[0] * fault[0]) * g[k] + NOISE[1] * fault[1 + k];
                response * shear + 0.02 * galaxies.normal()
            });
            let row = Row {
                e,
                weight: 1.0,
                response: [[response, 0.0], [0.0, response]],
                g,
                psf: [0.02, 0.01],
                psf_size: 1.0,
            };
            sums.add(number as u32, key, 0, &row);
        }
        let range = |value| Range {
            low: value,
            high: value,
        };
        catalogues.push(Catalogue {
            rows: 300,
            shear: g.map(range),
            star: star(pair).map(|star| StarNoise {
                star: star.to_string(),
                m: NOISE[0],
                c: NOISE[1],
            }),
            ..Catalogue::default()
        });
    }
    (sums, catalogues)
}

#[test]
fn errors_contain_the_noise_of_stars_once() {
    let rng = ChaCha8Rng::seed_from_u64(77);
    let mut galaxies = Galaxies {
        rng,
        weights: Weights::Equal,
        gamma: GAMMA,
    };
    type Star = fn(usize) -> Option<usize>;
    // One star for all, one for two halves, one for every two pairs, and one for each pair, which is a unit then.
    let cases: [(usize, Star, usize); 5] = [
        (3, |_| Some(0), 1),
        (2, Some, 2),
        (40, |pair| Some(pair / 2), 20),
        (40, Some, 0),
        (3, |_| None, 0),
    ];
    for (pairs, star, shared) in cases {
        let mut squares = [0.0; 5];
        let draws = 300;
        let keys = ["m1", "c2", "m_plus", "c_cross", "c_plus"];
        for _ in 0..draws {
            let (sums, catalogues) = behind_stars(&mut galaxies, pairs, star);
            let grouping = group(sums, &catalogues, Design::Pairs, None, false);
            assert_eq!(grouping.stars.len(), shared);
            let grouping = grouping.all_bins();
            let found = grouping.estimate(0, true).unwrap();
            let without = estimate(&grouping.sums, 0, true).unwrap();
            for (square, key) in squares.iter_mut().zip(keys) {
                let measured = found.value(key).unwrap();
                *square += (measured.value / measured.error).powi(2);
                let same = measured.error == without.value(key).unwrap().error;
                assert_eq!(same, shared == 0, "{key}");
            }
        }
        for (square, key) in squares.iter().zip(keys) {
            let deviation = (square / f64::from(draws)).sqrt();
            // Four standard errors of the deviation, and the jackknife's own errors of 10 %.
            let least = 0.9 - 4.0 / (2.0 * f64::from(draws)).sqrt();
            let most = 1.1 + 4.0 / (2.0 * f64::from(draws)).sqrt();
            assert!(
                (least..most).contains(&deviation),
                "{pairs} pairs, {key}: pulls scatter by {deviation}"
            );
        }
    }
}

#[test]
fn the_part_that_a_jackknife_knows_of_a_star_is_exact() {
    // Twenty pairs without noise, so that a jackknife finds nothing.
    let range = |value| Range {
        low: value,
        high: value,
    };
    let with = |star: &dyn Fn(u32) -> u32| {
        let mut sums = UnitSums::new(Layout::default(), 1, 40);
        let mut catalogues = Vec::new();
        for number in 0..40 {
            let g = [if number % 2 == 0 { GAMMA } else { -GAMMA }; 2];
            let row = Row {
                e: g.map(|g| 0.7 * g),
                weight: 1.0,
                response: [[0.7, 0.0], [0.0, 0.7]],
                g,
                ..Row::default()
            };
            sums.add(number, 0, 0, &row);
            catalogues.push(Catalogue {
                rows: 1,
                shear: g.map(range),
                star: Some(StarNoise {
                    star: star(number / 2).to_string(),
                    m: 0.06,
                    c: 4e-3,
                }),
                ..Catalogue::default()
            });
        }
        let grouping = group(sums, &catalogues, Design::Pairs, None, false);
        let found = grouping.estimate(0, true).unwrap();
        ["m1", "c2"].map(|key| found.value(key).unwrap().error)
    };
    // The variance by k stars of 20/k units each is 1/k of that of one star. A jackknife of 20 units contains a part of it.
    for count in [1u32, 2, 4, 10, 20] {
        let k = f64::from(count);
        let known = 20.0 / 19.0 * (20.0 / k * (1.0 / 20.0f64).powi(2) - 1.0 / (k * k * 20.0)) * k;
        let share = (1.0 / k - known).max(0.0).sqrt();
        let found = with(&|pair| pair % count);
        for (found, noise) in found.into_iter().zip([0.06, 4e-3]) {
            assert!(
                (found - share * noise).abs() < 1e-9,
                "{count}: {found} {share}"
            );
        }
    }
}
