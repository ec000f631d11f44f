//! Estimates of small catalogues against the equations of the crate, written as plain loops, and against the numbers that went
//! into galaxies without noise.

#![allow(clippy::unwrap_used, reason = "a failed test stops at the cause")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_bias::{Catalogue, Design, Layout, Range, Row, StarNoise, UnitSums, Units, group};
use shearq_bias::{Estimate, estimate};

type Matrix = [[f64; 2]; 2];

/// Terms of the fit, named as in the crate's description.
#[derive(Clone, Copy, PartialEq)]
enum Term {
    One,
    Own,
    Other,
    Square,
    Psf,
    PsfSize,
}
use Term::{One, Other, Own, Psf, PsfSize, Square};

/// Galaxies, and (e, weight) in each sheared catalogue; e is already divided by twice the artificial shear.
#[derive(Default)]
struct Sample {
    rows: Vec<Row>,
    sheared: Vec<[([f64; 2], f64); 4]>,
}

/// Arbitrary numbers: shears, PSFs, sizes, weights and responses are all different.
fn sample(seed: u64, sheared: bool, matrix: bool) -> Sample {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut sample = Sample::default();
    for _ in 0..60 {
        let mut within = |low: f64, high: f64| rng.random_range(low..high);
        let weight = within(0.5, 2.0);
        let e = [within(-0.4, 0.5), within(-0.3, 0.4)];
        let mut response = [
            [weight * within(0.2, 0.9), 0.0],
            [0.0, weight * within(0.3, 1.1)],
        ];
        if matrix {
            response[0][1] = weight * within(-0.2, 0.4);
            response[1][0] = weight * within(-0.4, 0.1);
        }
        sample.rows.push(Row {
            e,
            weight,
            response,
            g: [within(-0.06, 0.05), within(-0.04, 0.07)],
            psf: [within(-0.1, 0.2), within(-0.2, 0.1)],
            psf_size: within(1.0, 3.0),
        });
        if sheared {
            // Differences of 0.3 and 0.5, and of −0.1 and 0.2 in the other component.
            let mean = [[0.15, -0.05], [-0.15, 0.05], [0.1, 0.25], [-0.1, -0.25]];
            sample.sheared.push(mean.map(|mean| {
                let e = mean.map(|mean| mean + within(-0.1, 0.1));
                (e, within(0.5, 2.0))
            }));
        }
    }
    sample
}

impl Sample {
    fn sums(&self, layout: Layout) -> Units {
        let mut sums = UnitSums::new(layout, 1, 1);
        for (key, row) in (0..).zip(&self.rows) {
            sums.add(0, key, 0, row);
        }
        for (key, sheared) in (0..).zip(&self.sheared) {
            for (catalogue, (e, weight)) in sheared.iter().enumerate() {
                sums.add_sheared(0, key, 0, catalogue, (*e, *weight));
            }
        }
        sums.by_key(|_| 0)
    }

    /// ⟨e_i⟩ of the catalogue with a positive shear of component j, minus that with negative shear.
    fn extra(&self) -> Matrix {
        let mean = |catalogue: usize, i: usize| {
            let all = || self.sheared.iter().map(|sheared| sheared[catalogue]);
            let weights: f64 = all().map(|(_, weight)| weight).sum();
            all().map(|(e, weight)| weight * e[i]).sum::<f64>() / weights
        };
        if self.sheared.is_empty() {
            return [[0.0; 2]; 2];
        }
        [0, 1].map(|i| [0, 1].map(|j| mean(2 * j, i) - mean(2 * j + 1, i)))
    }

    /// The coefficients of the terms of both components, in pixel axes or along and across the PSF, and the pivot of the
    /// last term of each component alone.
    fn solved(&self, terms: [&[Term]; 2], along_psf: bool, matrix: bool) -> [(Vec<f64>, f64); 2] {
        let places: Vec<(usize, Term)> = (0..2)
            .flat_map(|k| terms[k].iter().map(move |term| (k, *term)))
            .collect();
        let n = places.len();
        let mut a = vec![vec![0.0; n + 1]; n];
        let [[x11, x12], [x21, x22]] = self.extra();
        let extra = match along_psf {
            true => {
                let (half, turn) = ((x11 + x22) / 2.0, (x12 - x21) / 2.0);
                [[half, turn], [-turn, half]]
            }
            false => [[x11, x12], [x21, x22]],
        };
        for row in &self.rows {
            let angle = match along_psf {
                true => row.psf[1].atan2(row.psf[0]),
                false => 0.0,
            };
            let turn = [[angle.cos(), angle.sin()], [-angle.sin(), angle.cos()]];
            let turned = |v: [f64; 2]| [0, 1].map(|i| turn[i][0] * v[0] + turn[i][1] * v[1]);
            let (e, g, psf) = (turned(row.e), turned(row.g), turned(row.psf));
            let mut slope = [[0.0; 2]; 2];
            for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                slope[i][j] = row.weight * extra[i][j];
                for (k, l) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    slope[i][j] += turn[i][k] * row.response[k][l] * turn[j][l];
                }
            }
            let z = |(k, term): (usize, Term)| match term {
                One => 1.0,
                Own => g[k],
                Other => g[1 - k],
                Square => g[k] * g[k],
                Psf => psf[k],
                PsfSize => psf[k] * row.psf_size,
            };
            for (equation, s) in a.iter_mut().zip(&places) {
                for (value, t) in equation.iter_mut().zip(&places) {
                    if s.0 == t.0 || matrix {
                        *value += slope[s.0][t.0] * z(*s) * z(*t);
                    }
                }
                equation[n] += row.weight * e[s.0] * z(*s);
            }
        }
        let first = terms[0].len();
        let blocks = [0..first, first..n];
        let x = gauss(&a);
        blocks.map(|block| {
            // The inverse of the last element of the inverse of a component's own block.
            let mut own: Vec<Vec<f64>> = a[block.clone()]
                .iter()
                .map(|row| row[block.clone()].to_vec())
                .collect();
            let last = own.len() - 1;
            for (i, row) in own.iter_mut().enumerate() {
                row.push(f64::from(i == last));
            }
            (x[block].to_vec(), 1.0 / gauss(&own)[last])
        })
    }
}

/// Gauss's elimination with the largest pivots.
fn gauss(a: &[Vec<f64>]) -> Vec<f64> {
    let (mut a, n) = (a.to_vec(), a.len());
    for k in 0..n {
        let largest = (k..n).max_by(|i, j| a[*i][k].abs().total_cmp(&a[*j][k].abs()));
        a.swap(k, largest.unwrap());
        let pivot = a[k].clone();
        for i in (0..n).filter(|i| *i != k) {
            let factor = a[i][k] / pivot[k];
            for (own, other) in a[i].iter_mut().zip(&pivot).skip(k) {
                *own -= factor * other;
            }
        }
    }
    (0..n).map(|k| a[k][n] / a[k][k]).collect()
}

fn of(sums: &Units, truth: bool) -> Estimate {
    estimate(sums, 0, truth).unwrap()
}

fn layouts() -> impl Iterator<Item = Layout> {
    let all = [(false, false), (true, false), (false, true), (true, true)];
    all.into_iter().map(|(sheared, matrix)| Layout {
        psf: true,
        sheared,
        matrix,
    })
}

/// Rounding errors of sums of sixty numbers, with the condition of six terms.
const ROUNDING: f64 = 1e-9;

#[test]
fn every_estimate_solves_the_equations_of_the_crate() {
    for layout in layouts() {
        let sample = sample(3, layout.sheared, layout.matrix);
        let found = of(&sample.sums(layout), true);
        let check = |key: &str, expected: f64| {
            let value = found.value(key).unwrap().value;
            assert!(
                (value - expected).abs() < ROUNDING * expected.abs().max(1.0),
                "{layout:?} {key}: {value}, expected {expected}"
            );
        };
        let solved = |terms, along_psf| sample.solved(terms, along_psf, layout.matrix);
        let main: &[Term] = &[One, Own];
        for (along_psf, m, c) in [
            (false, ["m1", "m2"], ["c1", "c2"]),
            (true, ["m_plus", "m_cross"], ["c_plus", "c_cross"]),
        ] {
            for (k, (x, _)) in solved([main, main], along_psf).into_iter().enumerate() {
                check(c[k], x[0]);
                check(m[k], x[1] - 1.0);
            }
        }
        let longer: [(_, &[Term]); 2] = [
            (["q1", "q2"], &[One, Own, Square]),
            (["m12", "m21"], &[One, Own, Other]),
        ];
        for (keys, more) in longer {
            for (key, (x, _)) in keys.into_iter().zip(solved([more; 2], false)) {
                check(key, x[2]);
            }
        }
        let leakage: &[Term] = &[One, Own, Psf];
        let [(x1, weight1), (x2, weight2)] = solved([leakage; 2], false);
        check("alpha1", x1[2]);
        check("alpha2", x2[2]);
        check(
            "alpha",
            (x1[2] * weight1 + x2[2] * weight2) / (weight1 + weight2),
        );
        let with_size: &[Term] = &[One, Own, Psf, PsfSize];
        let [(x1, weight1), (x2, weight2)] = solved([with_size; 2], false);
        let weights: f64 = sample.rows.iter().map(|row| row.weight).sum();
        let sizes = sample.rows.iter().map(|row| row.weight * row.psf_size);
        let size = sizes.sum::<f64>() / weights;
        check(
            "alpha_size",
            (x1[3] * weight1 + x2[3] * weight2) / (weight1 + weight2) * size,
        );
        let mean = |of: fn(&Row) -> f64| sample.rows.iter().map(of).sum::<f64>() / weights;
        let extra = sample.extra();
        check("r1", mean(|row| row.response[0][0]) + extra[0][0]);
        check("r2", mean(|row| row.response[1][1]) + extra[1][1]);
        if layout.matrix {
            check("r12", mean(|row| row.response[0][1]) + extra[0][1]);
            check("r21", mean(|row| row.response[1][0]) + extra[1][0]);
        } else {
            assert!(found.value("r12").is_none());
        }
    }
}

#[test]
fn without_truth_or_with_one_shear_a_single_term_is_solved() {
    for layout in layouts() {
        let mut sample = sample(5, layout.sheared, layout.matrix);
        let solved = |sample: &Sample, terms| sample.solved([terms; 2], false, layout.matrix);
        let null = of(&sample.sums(layout), false);
        let leakage = [One, Psf];
        for k in 0..2 {
            let value = |key: &str| null.value(&format!("{key}{}", k + 1));
            let expected = solved(&sample, &[One])[k].0[0];
            assert!((value("c").unwrap().value - expected).abs() < ROUNDING);
            let expected = solved(&sample, &leakage)[k].0[1];
            assert!((value("alpha").unwrap().value - expected).abs() < ROUNDING);
            assert!(value("m").is_none());
        }
        for row in &mut sample.rows {
            row.g = [0.03, -0.02];
        }
        let single = of(&sample.sums(layout), true);
        assert_eq!(single.assumes_no_c, [true; 2]);
        for k in 0..2 {
            let m = single.value(["m1", "m2"][k]).unwrap().value;
            let expected = solved(&sample, &[Own])[k].0[0] - 1.0;
            assert!((m - expected).abs() < ROUNDING * expected.abs().max(1.0));
            let alpha = single.value(["alpha1", "alpha2"][k]).unwrap().value;
            let expected = solved(&sample, &leakage)[k].0[1];
            assert!((alpha - expected).abs() < ROUNDING);
        }
    }
}

#[test]
fn equal_psfs_determine_no_leakage_and_equal_sizes_no_change_of_it() {
    for layout in layouts() {
        let mut sample = sample(4, layout.sheared, layout.matrix);
        for row in &mut sample.rows {
            row.psf_size = 2.0;
        }
        let found = of(&sample.sums(layout), true);
        assert!(found.value("alpha").is_some() && found.value("alpha_size").is_none());
        for row in &mut sample.rows {
            row.psf = [0.05, -0.02];
        }
        // A size that varies makes p times size vary, but not p.
        sample.rows[7].psf_size = 3.0;
        let found = of(&sample.sums(layout), true);
        for key in ["alpha", "alpha1", "alpha2", "alpha_size"] {
            assert!(found.value(key).is_none(), "{key}");
        }
    }
}

/// Galaxies without noise, e = R g.
fn exact(layout: Layout) -> Sample {
    let mut sample = sample(8, layout.sheared, layout.matrix);
    // Equal galaxies in each sheared catalogue, so that no unit changes their response.
    if let Some(first) = sample.sheared.first().copied() {
        sample.sheared.fill(first);
    }
    let extra = sample.extra();
    for row in &mut sample.rows {
        let is_used = |i: usize, j: usize| f64::from(i == j || layout.matrix);
        let r =
            |i: usize, j: usize| is_used(i, j) * (row.response[i][j] / row.weight + extra[i][j]);
        row.e = [0, 1].map(|i| r(i, 0) * row.g[0] + r(i, 1) * row.g[1]);
    }
    sample
}

#[test]
fn the_noise_of_a_star_changes_shear_before_the_response() {
    // One star for all galaxies: the errors are those of its m and c, whatever the response is.
    for layout in layouts() {
        let sample = exact(layout);
        let constant = |value: f64| Range {
            low: value,
            high: value,
        };
        let mut sums = UnitSums::new(layout, 1, 2);
        for (key, row) in (0..).zip(&sample.rows) {
            for catalogue in 0..2 {
                sums.add(catalogue, key, 0, row);
            }
        }
        for (key, sheared) in (0..).zip(&sample.sheared) {
            for (which, (e, weight)) in sheared.iter().enumerate() {
                for catalogue in 0..2 {
                    sums.add_sheared(catalogue, key, 0, which, (*e, *weight));
                }
            }
        }
        let catalogue = Catalogue {
            rows: 60,
            shear: [constant(0.0); 2],
            star: Some(StarNoise {
                star: "one".into(),
                m: 0.06,
                c: 4e-3,
            }),
            ..Catalogue::default()
        };
        let catalogues = [catalogue.clone(), catalogue];
        let grouping = group(sums, &catalogues, Design::Galaxies, Some(true), true);
        let found = grouping.estimate(0, true).unwrap();
        for (key, expected) in [("m1", 0.06), ("m2", 0.06), ("c1", 4e-3), ("c2", 4e-3)] {
            let error = found.value(key).unwrap().error;
            assert!((error - expected).abs() < 1e-9, "{layout:?} {key}: {error}");
        }
    }
}

/// Galaxies without noise of two arms with other responses: e = R ((1 + m) g + c).
#[test]
fn each_arm_has_its_own_response() {
    const M: f64 = 0.05;
    const C: f64 = 0.002;
    let layout = Layout {
        sheared: true,
        ..Layout::default()
    };
    let shears = [[0.04, -0.03], [-0.04, 0.03]];
    let responses = [[0.3, 0.5], [0.6, 0.4]];
    let mut sums = UnitSums::new(layout, 1, 2);
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for key in 0..50 {
        for (arm, (g, r)) in shears.into_iter().zip(responses).enumerate() {
            let weight = rng.random_range(0.5..2.0);
            let row = Row {
                e: [0, 1].map(|k| r[k] * ((1.0 + M) * g[k] + C)),
                weight,
                g,
                ..Row::default()
            };
            sums.add(arm as u32, key, 0, &row);
            // The sums of weights differ from arm to arm and from catalogue to catalogue.
            for catalogue in 0..4 {
                let sign = if catalogue % 2 == 0 { 0.5 } else { -0.5 };
                let e = r.map(|r| sign * r + 0.1);
                sums.add_sheared(arm as u32, key, 0, catalogue, (e, weight));
            }
        }
    }
    let catalogues = shears.map(|g| Catalogue {
        rows: 50,
        shear: g.map(|g| Range { low: g, high: g }),
        ..Catalogue::default()
    });
    let found = |sums: UnitSums| {
        let grouping = group(sums, &catalogues, Design::Pairs, None, true);
        grouping.estimate(0, true).unwrap()
    };
    let own = found(sums.clone());
    for (key, expected) in [("m1", M), ("m2", M), ("c1", C), ("c2", C)] {
        let own = own.value(key).unwrap();
        assert!((own.value - expected).abs() < ROUNDING, "{key}: {own:?}");
        assert!(own.error < ROUNDING, "{key}: {own:?}");
    }
    // With one response for both, the difference of the responses would be a c.
    let pooled = of(&sums.clone().by_key(|_| 0), true);
    assert!((pooled.value("c1").unwrap().value - C).abs() > 0.01);
    // An arm without galaxies in a sheared catalogue has the response of all.
    let mut lacking = UnitSums::new(layout, 1, 3);
    lacking.append(sums).unwrap();
    let g = [0.0; 2];
    let row = Row {
        e: [0.001; 2],
        weight: 1e-3,
        g,
        ..Row::default()
    };
    lacking.add(2, 7, 0, &row);
    assert!(of(&lacking.by_key(|arm| arm), true).value("m1").is_some());
}

/// m of shapes with a weight w(|e|) under ±γ, from sheared catalogues of each arm.
#[test]
fn weights_that_depend_on_shape_bias_m_alike_in_both_arms() {
    type Complex = [f64; 2];
    const STEP: f64 = 0.01;
    let times = |a: Complex, b: Complex| [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]];
    // (e + g)/(1 + g* e)
    let sheared = |e: Complex, g: Complex| {
        let below = times([g[0], -g[1]], e);
        let below = [1.0 + below[0], below[1]];
        let square = below[0] * below[0] + below[1] * below[1];
        times(
            [e[0] + g[0], e[1] + g[1]],
            [below[0] / square, -below[1] / square],
        )
    };
    let weight = |e: Complex| 1.0 / (0.07 + e[0] * e[0] + e[1] * e[1]);
    let layout = Layout {
        sheared: true,
        ..Layout::default()
    };
    let arms = [[0.05, -0.05], [-0.05, 0.05]];
    let steps = [[STEP, 0.0], [-STEP, 0.0], [0.0, STEP], [0.0, -STEP]];
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut sums = UnitSums::new(layout, 1, 2);
    // Σ w e, Σ w of each arm under each added shear, with plain loops.
    let mut plain = [[([0.0; 2], 0.0); 5]; 2];
    for key in 0..500 {
        let modulus = rng.random_range(0.0..0.6);
        let angle = rng.random_range(0.0..std::f64::consts::TAU);
        // Four orientations, so that shapes cancel.
        for turn in 0..4 {
            let angle = angle + f64::from(turn) * std::f64::consts::FRAC_PI_2;
            let shape = [modulus * angle.cos(), modulus * angle.sin()];
            for (arm, g) in arms.into_iter().enumerate() {
                for (k, step) in [[0.0; 2]].into_iter().chain(steps).enumerate() {
                    let e = sheared(shape, [g[0] + step[0], g[1] + step[1]]);
                    let w = weight(e);
                    let own = &mut plain[arm][k];
                    own.1 += w;
                    own.0 = [own.0[0] + w * e[0], own.0[1] + w * e[1]];
                    match k.checked_sub(1) {
                        None => {
                            let row = Row {
                                e,
                                weight: w,
                                g,
                                ..Row::default()
                            };
                            sums.add(arm as u32, key, 0, &row);
                        }
                        Some(catalogue) => {
                            let e = e.map(|e| e / (2.0 * STEP));
                            sums.add_sheared(arm as u32, key, 0, catalogue, (e, w));
                        }
                    }
                }
            }
        }
    }
    let m = |component: usize| {
        let mean = |arm: usize, k: usize| plain[arm][k].0[component] / plain[arm][k].1;
        let response = |arm: usize| {
            (mean(arm, 1 + 2 * component) - mean(arm, 2 + 2 * component)) / (2.0 * STEP)
        };
        let [plus, minus] = [0, 1].map(|arm| mean(arm, 0) / response(arm));
        (plus - minus) / (2.0 * arms[0][component]) - 1.0
    };
    let catalogues = arms.map(|g| Catalogue {
        rows: 2000,
        shear: g.map(|g| Range { low: g, high: g }),
        ..Catalogue::default()
    });
    let grouping = group(sums.clone(), &catalogues, Design::Pairs, None, true);
    let found = grouping.estimate(0, true).unwrap();
    let pooled = of(&sums.by_key(|_| 0), true);
    for (component, key) in ["m1", "m2"].into_iter().enumerate() {
        let own = found.value(key).unwrap().value;
        // The responses of both arms are equal only within the scatter of the shapes.
        assert!((own - m(component)).abs() < 1e-6, "{key}: {own}");
        // A common response is wrong by 2kγ², with k of about −4 here.
        let pooled = pooled.value(key).unwrap().value;
        assert!((pooled - own).abs() > 0.01, "{key}: {pooled} {own}");
    }
}

#[test]
fn bins_are_weighted_to_the_shares_of_another_population() {
    const SHARES: [f64; 3] = [0.2, 0.5, 0.3];
    for sheared in [false, true] {
        let layout = Layout {
            sheared,
            ..Layout::default()
        };
        let sample = sample(6, sheared, false);
        let bin_of = |key: usize| key % 3;
        let weight = |bin: usize| -> f64 {
            let all = sample.rows.iter().enumerate();
            let own = all.filter(|(key, _)| bin_of(*key) == bin);
            own.map(|(_, row)| row.weight).sum()
        };
        let weights = [0, 1, 2].map(weight);
        let (mut binned, mut weighted) = (UnitSums::new(layout, 3, 1), UnitSums::new(layout, 1, 1));
        for (key, row) in sample.rows.iter().enumerate() {
            let bin = bin_of(key);
            let factor = SHARES[bin] / weights[bin];
            binned.add(0, key as u64, bin, row);
            let own = Row {
                weight: factor * row.weight,
                response: row.response.map(|row| row.map(|r| factor * r)),
                ..*row
            };
            weighted.add(0, key as u64, 0, &own);
            for (which, (e, weight)) in sample.sheared.get(key).into_iter().flatten().enumerate() {
                binned.add_sheared(0, key as u64, bin, which, (*e, *weight));
                weighted.add_sheared(0, key as u64, 0, which, (*e, factor * weight));
            }
        }
        let grouping = group(
            binned,
            &[Catalogue::default()],
            Design::Galaxies,
            None,
            false,
        );
        let found = grouping.estimate_like(&SHARES, true).unwrap();
        let expected = of(&weighted.by_key(|_| 0), true);
        assert_eq!(found.galaxies, 60);
        assert!((found.effective / expected.effective - 1.0).abs() < ROUNDING);
        for key in ["m1", "m2", "c1", "c2", "r1"] {
            let [found, expected] = [&found, &expected].map(|own| own.value(key).unwrap());
            assert!((found.value - expected.value).abs() < 1e-9 * expected.value.abs().max(1.0));
            // The factors follow from the galaxies, so that errors differ by a term of the order of 1/n.
            assert!((found.error / expected.error - 1.0).abs() < 0.2, "{key}");
        }
    }
}
