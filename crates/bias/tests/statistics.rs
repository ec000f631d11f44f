//! Estimates of synthetic catalogues are unbiased, and their errors are the scatter of repeated draws.

#![allow(clippy::unwrap_used, reason = "a failed test stops at the cause")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_bias::{
    Catalogue, Design, Layout, Range, Row, StarNoise, UnitSums, WithoutPartner, estimate, group,
};

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
    /// Depending on e, with the derivative of the weight in the response.
    OfShape,
}

struct Galaxies {
    rng: ChaCha8Rng,
    weights: Weights,
    /// Modulus of each component of shear.
    gamma: f64,
}

impl Galaxies {
    fn new(weights: Weights, gamma: f64) -> Self {
        Galaxies {
            rng: ChaCha8Rng::seed_from_u64(5),
            weights,
            gamma,
        }
    }

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
            Weights::OfShape => {
                let w = 1.0 / (1.0 + (e[0] * e[0] + e[1] * e[1]) / (SCALE * SCALE));
                (w, e.map(|e| -2.0 * e / (SCALE * SCALE) * w * w * 0.7))
            }
        };
        let [r11, r22] = [0, 1].map(|k| weight * response[k] + e[k] * derivative[k]);
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
fn gamma_of(weights: Weights, count: usize) -> f64 {
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

/// Mean and standard deviation of the pulls of each quantity with its expectation.
fn pulls(
    draws: usize,
    expected: &[(&str, f64)],
    mut draw: impl FnMut() -> (UnitSums, Vec<Catalogue>, Design),
) -> Vec<[f64; 2]> {
    let mut sums = vec![[0.0; 2]; expected.len()];
    for _ in 0..draws {
        let (units, catalogues, design) = draw();
        let grouping = group(units, &catalogues, design, None, false);
        let found = estimate(&grouping.units, 0, design != Design::Null).unwrap();
        for (sums, (key, expected)) in sums.iter_mut().zip(expected) {
            let measured = found.value(key).unwrap();
            let pull = (measured.value - expected) / measured.error;
            sums[0] += pull;
            sums[1] += pull * pull;
        }
    }
    let n = draws as f64;
    let of_sums = |[pull, square]: &[f64; 2]| [pull / n, (square / n).sqrt()];
    sums.iter().map(of_sums).collect()
}

const MC: [(&str, f64); 4] = [("m1", M[0]), ("m2", M[1]), ("c1", C[0]), ("c2", C[1])];

/// Checks the pulls of `draws` draws of each design.
fn check(draws: usize, count: usize) {
    for weights in [Weights::Equal, Weights::OfShape] {
        let leakage = [MC.as_slice(), &[("alpha", ALPHA)]].concat();
        let gamma = gamma_of(weights, count);
        // A single shear determines m if c is zero.
        let single = [0, 1].map(|k| (MC[k].0, M[k] + C[k] / gamma));
        for (design, expected) in [
            (Design::Galaxies, &leakage[..]),
            (Design::Pairs, &MC),
            (Design::Arms, &MC),
            (Design::Rotated, &MC),
            (Design::Fields, &MC),
            (Design::Single, &single),
            (Design::Null, &MC[2..]),
        ] {
            // Fifty catalogues need some galaxies each.
            let count = if design == Design::Fields {
                count.max(1000)
            } else {
                count
            };
            let mut galaxies = Galaxies::new(weights, gamma_of(weights, count));
            let found = pulls(draws, expected, || {
                let Draw { sums, catalogues } = draw(design, &mut galaxies, count);
                (sums, catalogues, design)
            });
            check_pulls(&format!("{design:?}"), draws, &found, expected);
        }
    }
}

/// The standard deviation of pulls is 1 within 10 %, and their mean is 0.
fn check_pulls(what: &str, draws: usize, found: &[[f64; 2]], expected: &[(&str, f64)]) {
    for ([pull, deviation], (key, _)) in found.iter().zip(expected) {
        // Four standard errors of the mean, and a ratio's bias of about its relative error squared.
        let tolerance = 4.0 / (draws as f64).sqrt() + 0.05;
        assert!(pull.abs() < tolerance, "{what} {key}: mean pull {pull}");
        assert!(
            (0.9..1.1).contains(deviation),
            "{what} {key}: pulls scatter by {deviation}"
        );
    }
}

// The scatter of 800 pulls has a standard error of 2.5 %, so that 10 % are four of them.
const DRAWS: usize = 800;

#[test]
fn estimates_are_unbiased_and_errors_right_in_every_design() {
    check(DRAWS, 150);
}

/// Forty tiles of five galaxies, each also rotated by 90 degrees with the same noise, in catalogues of their own.
fn draw_versions(design: Design, galaxies: &mut Galaxies) -> Draw {
    let gamma = galaxies.gamma;
    let shears = match design {
        Design::Pairs => vec![[gamma, gamma], [-gamma, -gamma]],
        Design::Arms => vec![[gamma, 0.0], [0.0, gamma], [0.0, 0.0]],
        Design::Null => vec![[0.0; 2]],
        _ => vec![[gamma, gamma]],
    };
    let tiles = 40;
    let mut draw = Draw::new(tiles * 2 * shears.len(), false);
    for tile in 0..tiles {
        let own = [0; 2].map(|_| gamma * galaxies.rng.random_range(-1.0..1.0));
        for key in 0..5 {
            let [noise, intrinsic, response] = galaxies.galaxy();
            for (arm, shear) in shears.iter().enumerate() {
                let shear = if design == Design::Fields {
                    own
                } else {
                    *shear
                };
                for (version, shape) in [intrinsic, intrinsic.map(|e| -e)].into_iter().enumerate() {
                    let catalogue = (arm * 2 + version) * tiles + tile;
                    let suffix = ["", "_rot90"][version];
                    draw.catalogues[catalogue].name =
                        format!("arm{arm}{suffix}/tile{tile:02}.fits");
                    draw.add(
                        catalogue,
                        key,
                        &galaxies.row([noise, shape, response], shear, [0.0; 2]),
                    );
                }
            }
        }
    }
    draw
}

#[test]
fn errors_are_right_with_versions_of_the_same_galaxies() {
    let single = [0, 1].map(|k| (MC[k].0, M[k] + C[k] / GAMMA));
    for (design, expected) in [
        (Design::Pairs, &MC[..]),
        (Design::Arms, &MC),
        (Design::Fields, &MC),
        (Design::Single, &single),
        (Design::Null, &MC[2..]),
    ] {
        let mut galaxies = Galaxies::new(Weights::Equal, GAMMA);
        let found = pulls(DRAWS, expected, || {
            let Draw { sums, catalogues } = draw_versions(design, &mut galaxies);
            let recognised = Design::of(&catalogues, design != Design::Null);
            assert_eq!(recognised, design);
            (sums, catalogues, design)
        });
        check_pulls(&format!("{design:?} in versions"), DRAWS, &found, expected);
    }
}

#[test]
fn galaxies_without_partner_are_counted_with_their_cost() {
    let mut galaxies = Galaxies::new(Weights::Equal, GAMMA);
    let shears = [[GAMMA; 2], [-GAMMA; 2]];
    let (mut draw, mut paired, mut alone) = (Draw::new(2, false), Draw::new(2, false), 0.0);
    for key in 0..20_000 {
        // One noise for both signs, so that only responses scatter.
        let galaxy = galaxies.galaxy();
        let is_paired = galaxies.rng.random_range(0.0..1.0) > 0.01;
        alone += f64::from(!is_paired);
        for (catalogue, g) in shears.into_iter().enumerate() {
            let row = galaxies.row(galaxy, g, [0.0; 2]);
            if catalogue == 0 || is_paired {
                draw.add(catalogue, key, &row);
            }
            if is_paired {
                paired.add(catalogue, key, &row);
            }
        }
    }
    let errors = [draw, paired].map(|draw| {
        let grouping = group(draw.sums, &draw.catalogues, Design::Pairs, None, true);
        let found = grouping.estimate(0, true).unwrap();
        (grouping.without_partner, found.value("m1").unwrap().error)
    });
    let (found, with) = errors[0];
    let found = found.unwrap();
    assert!(errors[1].0.is_none());
    // The variance of the numbers in 1250 units of 16 keys has a relative error of √(2/1250) = 4 %.
    assert!(
        (found.galaxies / alone - 1.0).abs() < 0.2,
        "{found:?} {alone}"
    );
    assert_eq!(found.of, 40_000.0 - alone);
    let (expected, stated) = (with / errors[1].1, (1.0 - found.share[0]).sqrt().recip());
    assert!(
        (stated / expected - 1.0).abs() < 0.3,
        "σ(m) is {expected} times as large, stated {stated}"
    );
}

#[test]
fn seeds_per_file_count_galaxies_without_partner() {
    assert!(seeds_per_file(50, 1000).0.is_none());
    let (found, alone) = seeds_per_file(400, 200);
    let found = found.unwrap();
    // 400 units determine a variance to √(2/400) = 7 %.
    let ratio = found.galaxies / alone;
    assert!((ratio - 1.0).abs() < 0.25, "{found:?} {alone}");
    assert!(found.share[0] > 0.5, "{found:?}");
    assert!(found.share[1].is_nan(), "{found:?}");
}

/// What is found of galaxies without partner in pairs of catalogues that are a unit each, and their number.
fn seeds_per_file(pairs: usize, count: usize) -> (Option<WithoutPartner>, f64) {
    let mut galaxies = Galaxies::new(Weights::Equal, GAMMA);
    // Without true g2.
    let shears = [[GAMMA, 0.0], [-GAMMA, 0.0]];
    let (mut draw, mut alone) = (Draw::new(2 * pairs, false), 0.0);
    for pair in 0..pairs {
        for (sign, name) in ["plus", "minus"].into_iter().enumerate() {
            draw.catalogues[2 * pair + sign].name = format!("{name}-{pair:03}.csv");
        }
        for _ in 0..count {
            let galaxy = galaxies.galaxy();
            let is_paired = galaxies.rng.random_range(0.0..1.0) > 0.02;
            let first = usize::from(galaxies.rng.random_range(0.0..1.0) > 0.5);
            alone += f64::from(!is_paired);
            for (sign, g) in shears.into_iter().enumerate() {
                if sign == first || is_paired {
                    draw.add(2 * pair + sign, pair, &galaxies.row(galaxy, g, [0.0; 2]));
                }
            }
        }
    }
    let grouping = group(draw.sums, &draw.catalogues, Design::Pairs, Some(true), true);
    (grouping.without_partner, alone)
}

/// The same for 100 to 1,000,000 galaxies and 1,000 draws where that takes minutes.
#[test]
#[ignore = "takes minutes"]
fn errors_are_right_from_a_hundred_to_a_million_galaxies() {
    for (count, draws) in [(100, 1000), (10_000, 1000), (1_000_000, 100)] {
        check(draws, count);
    }
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
        let sums = sums.by_key(|_| 0);
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
    let of = |sums: &UnitSums| estimate(&sums.clone().by_key(|_| 0), 0, false).unwrap_err();
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

#[test]
fn the_part_that_a_jackknife_knows_of_a_star_is_exact() {
    const KEYS: [(&str, f64); 5] = [
        ("m1", 0.06),
        ("m_plus", 0.06),
        ("c2", 4e-3),
        ("c_plus", 4e-3),
        ("c_cross", 4e-3),
    ];
    // Twenty pairs without noise, so that a jackknife finds nothing.
    let range = |value| Range {
        low: value,
        high: value,
    };
    let layout = Layout {
        psf: true,
        ..Layout::default()
    };
    let with = |count: u32| {
        let mut sums = UnitSums::new(layout, 1, 40);
        let mut catalogues = Vec::new();
        for number in 0..40 {
            let g = [if number % 2 == 0 { GAMMA } else { -GAMMA }; 2];
            let row = Row {
                e: g.map(|g| 0.7 * g),
                weight: 1.0,
                response: [[0.7, 0.0], [0.0, 0.7]],
                g,
                psf: [0.02, 0.01],
                psf_size: 1.0,
            };
            sums.add(number, 0, 0, &row);
            catalogues.push(Catalogue {
                rows: 1,
                shear: g.map(range),
                star: Some(StarNoise {
                    star: (number / 2 % count).to_string(),
                    m: 0.06,
                    c: 4e-3,
                }),
                ..Catalogue::default()
            });
        }
        let grouping = group(sums, &catalogues, Design::Pairs, None, false);
        // Of twenty stars, each belongs to a unit and is known to the jackknife.
        assert_eq!(
            grouping.stars.len(),
            if count < 20 { count as usize } else { 0 }
        );
        let found = grouping.estimate(0, true).unwrap();
        KEYS.map(|(key, _)| found.value(key).unwrap().error)
    };
    // The variance by k stars of 20/k units each is 1/k of that of one star. A jackknife of 20 units contains a part of it.
    for count in [1u32, 2, 4, 10, 20] {
        let k = f64::from(count);
        let known = 20.0 / 19.0 * (20.0 / k * (1.0 / 20.0f64).powi(2) - 1.0 / (k * k * 20.0)) * k;
        let share = (1.0 / k - known).max(0.0).sqrt();
        for (found, (key, noise)) in with(count).into_iter().zip(KEYS) {
            let off = (found - share * noise).abs();
            assert!(off < 1e-9, "{count} {key}: {found} {share}");
        }
    }
}
