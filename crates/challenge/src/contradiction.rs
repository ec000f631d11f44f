//! True shears that the images contradict: another sign, order, scale or set. An organiser who seals such a truth finds out
//! when entries arrive.

use shearq_scoring::ndarray::Array2;
use shearq_scoring::{FieldSum, Line, TrueShear, common_slope};

type Pair = [(f64, f64); 2];

// Largest slope of the measured on the true shear, or inverse. A reference measurement has an m of a few tenths at most,
// and a truth of twice or half the scale has a slope of 0.5 or 2.
const MAX_SLOPE: f64 = 1.6;
// Slopes of a right truth.
const SLOPE_RANGE: std::ops::RangeInclusive<f64> = 1.0 / MAX_SLOPE..=MAX_SLOPE;
// Standard errors by which a slope must be out of range. With three slopes of each of 24 sets, chance reaches this in one
// of 400 challenges whose slopes are all at the limit, and in none whose slopes are near 1.
const MIN_CONTRADICTION_SIGNIFICANCE: f64 = 4.0;

#[derive(Debug)]
pub(crate) struct First {
    pub set: u32,
    pub measured: FieldSum,
    pub truth: TrueShear,
}

type Slope = (f64, f64);

// The measured on the true shears of a component of a set, and the point of no bias that the line passes through: the means of
// the set if its shear varies.
type Group = (Line, Option<(f64, f64)>);

fn is_wrong((slope, error): Slope) -> bool {
    slope + MIN_CONTRADICTION_SIGNIFICANCE * error < *SLOPE_RANGE.start()
        || slope - MIN_CONTRADICTION_SIGNIFICANCE * error > *SLOPE_RANGE.end()
}

// Whether a slope is in range and clearly above zero.
fn is_right((slope, error): Slope) -> bool {
    slope > MIN_CONTRADICTION_SIGNIFICANCE * error && SLOPE_RANGE.contains(&slope)
}

fn line(e: &Array2<f64>, count: &Array2<f64>, g: &Array2<f64>, sign: f64) -> Line {
    let each = e.iter().zip(count).zip(g);
    let there = each.filter(|((_, count), _)| **count > 0.0);
    let points = there.map(|((e, count), g)| (sign * g, e / count));
    Line::through(&points.collect::<Vec<_>>())
}

// A change of the true shear: signs of both components, and whether they are exchanged.
type Change = (f64, f64, bool);

// True and measured shear without bias, of both components.
type Zeros = Option<[(f64, f64); 2]>;

const SAME: Change = (1.0, 1.0, false);

// What an organiser may have exchanged.
const CHANGES: [(Change, &str); 6] = [
    ((1.0, -1.0, false), "the sign of g2"),
    ((-1.0, 1.0, false), "the sign of g1"),
    ((-1.0, -1.0, false), "the signs of g1 and g2"),
    ((1.0, 1.0, true), "the order of g1 and g2"),
    ((1.0, -1.0, true), "the order of g1 and g2, and a sign"),
    ((-1.0, 1.0, true), "the order of g1 and g2, and a sign"),
];

fn of_set(
    first: &First,
    truth: &TrueShear,
    (s1, s2, exchanged): Change,
    zeros: Zeros,
) -> [Group; 2] {
    let FieldSum { e1, e2, count, .. } = &first.measured;
    let (g1, g2) = match exchanged {
        true => (&truth.g2, &truth.g1),
        false => (&truth.g1, &truth.g2),
    };
    [
        (line(e1, count, g1, s1), zeros.map(|zeros| zeros[0])),
        (line(e2, count, g2, s2), zeros.map(|zeros| zeros[1])),
    ]
}

// Mean true and measured shear of both components of a set with one shear.
fn means(first: &First, (s1, s2, exchanged): Change) -> Option<[(f64, f64); 2]> {
    let [g1, g2] = first.truth.constant()?;
    let (g1, g2) = if exchanged { (g2, g1) } else { (g1, g2) };
    let FieldSum { e1, e2, count, .. } = &first.measured;
    let mean = |e: &Array2<f64>| e.sum() / count.sum();
    Some([(s1 * g1, mean(e1)), (s2 * g2, mean(e2))])
}

// What a single set with one shear is relative to: the median additive bias over sets, which one wrong set does not change.
fn median_bias(firsts: &[First]) -> Zeros {
    let all: Option<Vec<_>> = firsts.iter().map(|first| means(first, SAME)).collect();
    let all = all.filter(|all| !all.is_empty())?;
    Some([0, 1].map(|k: usize| {
        let mut apart: Vec<f64> = all.iter().map(|set| set[k].1 - set[k].0).collect();
        apart.sort_by(f64::total_cmp);
        let middle = apart[(apart.len() - 1) / 2] + apart[apart.len() / 2];
        (0.0, 0.5 * middle)
    }))
}

// Groups of several sets. The line of sets with one shear each passes through their common means.
fn together(firsts: &[&First], change: Change) -> Vec<Group> {
    let all: Option<Vec<_>> = firsts.iter().map(|first| means(first, change)).collect();
    let zeros = all.map(|all| {
        let mean = |of: &dyn Fn(&Pair) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
        [0, 1].map(|k: usize| (mean(&|set| set[k].0), mean(&|set| set[k].1)))
    });
    let each = firsts.iter();
    each.flat_map(|first| of_set(first, &first.truth, change, zeros))
        .collect()
}

// The first set, or all sets together, whose true shear the images contradict, and the likely cause.
pub(crate) fn contradiction(firsts: &[First]) -> Option<String> {
    let zeros = median_bias(firsts);
    let slopes = |parts: &[Group]| -> [Slope; 3] {
        let component = |k: usize| -> Vec<Group> { parts.chunks(2).map(|set| set[k]).collect() };
        [parts.to_vec(), component(0), component(1)].map(|parts| common_slope(&parts))
    };
    let wrong = |parts: &[Group]| slopes(parts).into_iter().find(|slope| is_wrong(*slope));
    let each: Vec<Option<Slope>> = firsts
        .iter()
        .map(|first| wrong(&of_set(first, &first.truth, SAME, zeros)))
        .collect();
    let sound: Vec<&First> = firsts
        .iter()
        .zip(&each)
        .filter(|(_, found)| found.is_none())
        .map(|(first, _)| first)
        .collect();
    let all: Vec<&First> = firsts.iter().collect();
    // Each set alone may have too much noise to show what all have in common. Without sound sets, slopes are no numbers.
    let common = slopes(&together(&sound, SAME))
        .iter()
        .any(|(slope, _)| !SLOPE_RANGE.contains(slope));
    let first = each.iter().position(Option::is_some);
    let (wrong_sets, (value, error)) = match (first, wrong(&together(&all, SAME))) {
        (_, Some(found)) if common => (firsts, found),
        (Some(first), _) => (&firsts[first..=first], each[first]?),
        (None, _) => return None,
    };
    let of = match wrong_sets {
        [one] => format!("set {}", one.set),
        _ => "all sets".into(),
    };
    let after = |change: Change| match wrong_sets {
        [one] => common_slope(&of_set(one, &one.truth, change, zeros)),
        _ => common_slope(&together(&all, change)),
    };
    let clearness = |(slope, error): Slope| slope / error;
    let change = CHANGES
        .iter()
        .map(|(change, cause)| (after(*change), format!("{cause} may be wrong")));
    let exchanged = wrong_sets.iter().flat_map(|first| {
        let others = firsts.iter().filter(|other| other.set != first.set);
        others.map(|other| {
            let found = common_slope(&of_set(first, &other.truth, SAME, zeros));
            let cause = format!("the true shear of set {} fits set {}", other.set, first.set);
            (found, cause)
        })
    });
    let own = after(SAME);
    let cause = change
        .chain(exchanged)
        .filter(|(found, _)| is_right(*found) && clearness(*found) > clearness(own))
        .max_by(|a, b| clearness(a.0).total_cmp(&clearness(b.0)))
        .map_or_else(
            || match own.0 > MIN_CONTRADICTION_SIGNIFICANCE * own.1 {
                true => format!("the true shear may be {:.1} times too large", 1.0 / own.0),
                false => "positions, rows or sets may be exchanged".into(),
            },
            |(_, cause)| cause,
        );
    Some(format!(
        "{of}: the images contradict the true shear (found a slope of {value:.2} ± {error:.2} of the measured on the true shear, expected 0.6 to {MAX_SLOPE}); {cause}"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_quantities::units::{Degrees, Pixels};
    use shearq_scoring::Grid;

    const SIDE: usize = 48;

    // Numbers between −1 and 1 that follow from their place.
    fn number(place: usize) -> f64 {
        let value = (place as f64 * 12.9898 + 1.0).sin() * 43758.5453;
        2.0 * (value - value.floor()) - 1.0
    }

    // Measured and true shear of a set; all galaxies have one shear if it is `constant`.
    fn first(set: u32, constant: bool, scatter: f64) -> First {
        let grid = Grid::new(SIDE, Pixels(48.0), Degrees(10.0)).unwrap();
        let place = |k: usize, (i, j): (usize, usize)| match constant {
            true => set as usize * 2 + k,
            false => (set as usize * 2 + k) * SIDE * SIDE + i * SIDE + j,
        };
        let g = |k: usize| Array2::from_shape_fn((SIDE, SIDE), |at| 0.1 * number(place(k, at)));
        let truth = TrueShear { g1: g(0), g2: g(1) };
        let mut measured = FieldSum::new(&grid);
        measured.images = 1;
        measured.count.fill(1.0);
        let noise = |k: usize| {
            let from = (1000 + set as usize * 2 + k) * SIDE * SIDE;
            Array2::from_shape_fn((SIDE, SIDE), |(i, j)| scatter * number(from + i * SIDE + j))
        };
        // m = −0.1 and c = 0.01.
        measured.e1 = 0.9 * &truth.g1 + noise(0) + 0.01;
        measured.e2 = 0.9 * &truth.g2 + noise(1) + 0.01;
        First {
            set,
            measured,
            truth,
        }
    }

    fn found(constant: bool, scatter: f64, edit: &dyn Fn(&mut Vec<First>)) -> String {
        let mut firsts: Vec<First> = (1..=6).map(|set| first(set, constant, scatter)).collect();
        edit(&mut firsts);
        contradiction(&firsts).unwrap_or_default()
    }

    fn each(edit: impl Fn(&mut TrueShear)) -> impl Fn(&mut Vec<First>) {
        move |firsts| firsts.iter_mut().for_each(|first| edit(&mut first.truth))
    }

    fn scaled(factor: f64) -> impl Fn(&mut Vec<First>) {
        each(move |truth| {
            truth.g1 *= factor;
            truth.g2 *= factor;
        })
    }

    #[test]
    fn wrong_truths_are_found_and_explained() {
        let has = |constant, edit: &dyn Fn(&mut Vec<First>), start: &str, cause: &str| {
            let message = found(constant, 0.2, edit);
            assert!(
                message.starts_with(start) && message.contains(cause),
                "constant {constant}: {message}, expected {start} {cause}"
            );
        };
        let flip = each(|truth| truth.g2 *= -1.0);
        for constant in [false, true] {
            assert_eq!(found(constant, 0.2, &|_| {}), "");
            // Few sets of one shear do not tell one cause from all others.
            let start = if constant { "" } else { "all sets: " };
            has(constant, &flip, start, "the sign of g2 may be");
            let flip_first = each(|truth| truth.g1 *= -1.0);
            has(constant, &flip_first, start, "the sign of g1 may be");
            let exchange = each(|truth| std::mem::swap(&mut truth.g1, &mut truth.g2));
            has(constant, &exchange, start, "may be wrong");
            has(constant, &scaled(2.0), start, "contradict");
            has(constant, &scaled(0.5), start, "contradict");
            let one = |firsts: &mut Vec<First>| firsts[3].truth.g2 *= -1.0;
            has(constant, &one, "set 4: ", "contradict");
        }
        let factor = "may be 2.2 times too large";
        has(false, &scaled(2.0), "all sets: ", factor);
        let exchange = |firsts: &mut Vec<First>| {
            let (a, b) = firsts.split_at_mut(3);
            std::mem::swap(&mut a[1].truth, &mut b[0].truth);
        };
        let other = "the true shear of set 4 fits set 2";
        has(false, &exchange, "set 2: ", other);
        // With much noise, every sign is possible.
        assert_eq!(found(false, 30.0, &flip), "");
    }
}
