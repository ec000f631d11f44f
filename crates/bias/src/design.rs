//! How catalogues belong together.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use strum_macros::IntoStaticStr;

use crate::arms::Units;
use crate::catalogue::{Catalogue, Kinds, arms, same};
use crate::names;
use crate::stars::{Behind, StarNoise, shared};
use crate::sums::Layout;
use crate::units::{OfCatalogues, UnitSums};

/// How catalogues belong together: which test shears they have, and which of them contain the same galaxies. It determines
/// the units of the errors; the estimator is the same for all designs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr)]
#[strum(serialize_all = "lowercase")]
pub enum Design {
    /// Without true shear: only mean ellipticities and leakage follow.
    Null,
    /// One true shear. m and c cannot be separated: m assumes that c is zero.
    Single,
    /// Paired shears +γ and −γ of the same galaxies, whose shapes cancel in m.
    Pairs,
    /// The same galaxies under several test shears, such as ±g1 and ±g2, or γ and 0.
    #[strum(serialize = "shears")]
    Arms,
    /// Catalogues with a shear each, of different galaxies.
    Fields,
    /// Shears that vary within catalogues.
    Galaxies,
    /// Pairs of galaxies rotated by 90 degrees, in neighbouring rows or catalogues, whose shapes cancel in c, too (Nakajima &
    /// Bernstein 2007, AJ 133, 1763).
    Rotated,
}

impl Design {
    /// Name in options and output.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The design in words.
    pub fn meaning(self) -> &'static str {
        match self {
            Design::Null => "no true shear",
            Design::Single => "one true shear",
            Design::Pairs => "pairs of shears +γ and −γ",
            Design::Arms => "the same galaxies under several test shears",
            Design::Fields => "one true shear per catalogue",
            Design::Galaxies => "true shears that vary within catalogues",
            Design::Rotated => "pairs of galaxies rotated by 90 degrees",
        }
    }

    /// Recognises a design from the true shears of `catalogues`, with `truth` whether these are known. Rotated pairs are not
    /// recognised, because single catalogues have the same true shears.
    pub fn of(catalogues: &[Catalogue], truth: bool) -> Self {
        let used = || catalogues.iter().filter(|own| own.counted() > 0);
        if !truth {
            return Design::Null;
        }
        let shears: Option<Vec<[f64; 2]>> = used().map(Catalogue::constant).collect();
        let Some(shears) = shears else {
            return Design::Galaxies;
        };
        let kinds = Kinds::of(&shears);
        let counts = kinds.counts(&shears);
        let opposite = kinds
            .shears
            .iter()
            .map(|kind| kinds.opposite(*kind, &counts));
        let opposite: Vec<usize> = opposite.collect();
        let equal = opposite == counts;
        let both = opposite.iter().all(|count| *count > 0);
        // Catalogues of one shear may be missing if the names state which belong together.
        let paired = equal || both && names::groups(catalogues).is_some();
        match (kinds.shears.len(), paired) {
            (0 | 1, _) => Design::Single,
            (2, true) => Design::Pairs,
            (_, true) => Design::Arms,
            // Shears such as 0.02 and 0, or 0.08 and −0.02. Fields with a shear each have as many shears as catalogues.
            (count, false) => match names::groups(catalogues) {
                Some(groups) if names::count(&groups) >= count.max(2) => Design::Arms,
                _ => Design::Fields,
            },
        }
    }
}

/// A catalogue that is absent, although catalogues of the same galaxies under other test shears exist.
#[derive(Debug, Clone, PartialEq)]
pub struct Missing {
    /// One of the catalogues that are there.
    pub beside: String,
    /// The shear of the absent one.
    pub shear: [f64; 2],
}

/// Galaxies that count under one of two opposite shears only.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WithoutPartner {
    /// Their number: exact if units are galaxies, else estimated from the scatter of the numbers of galaxies in units.
    pub galaxies: f64,
    /// Galaxies under both signs together.
    pub of: f64,
    /// The part of the variances of m1 and m2 that is due to their shapes, which do not cancel. NaN for a component without
    /// true shear.
    pub share: [f64; 2],
}

/// Units of the errors, and what is wrong with them.
#[derive(Debug, Clone, PartialEq)]
pub struct Grouping {
    /// The sums by unit.
    pub units: Units,
    /// The galaxies of noisy stars that several units share.
    pub stars: Vec<Behind>,
    /// What a unit is, in words.
    pub unit: &'static str,
    /// Whether units are catalogues, or groups of them.
    pub whole_catalogues: bool,
    /// Whether galaxies under different shears may be in different units: their numbers differ. The error of m is then too
    /// large, and the error of c too small.
    pub misaligned: bool,
    /// The correlation of the ellipticities in units under opposite shears, if it shows that they are not the same
    /// galaxies. Errors are wrong as above if they are the same in another order.
    pub uncorrelated: Option<f64>,
    /// Galaxies that count under one of two opposite shears only.
    pub without_partner: Option<WithoutPartner>,
    /// Catalogues that are absent.
    pub missing: Vec<Missing>,
    /// A shear and the numbers of catalogues under it and under the opposite one, if these differ and names do not state
    /// which belong together. The catalogues are then independent units, and errors contain shapes that pairs cancel.
    pub unpaired: Option<([f64; 2], [usize; 2])>,
    /// Whether several catalogues have the same shear and neither names nor keys state whether they contain the same
    /// galaxies: they count as different ones.
    pub assumed_different: bool,
}

impl Grouping {
    /// The same units with all bins joined to one.
    #[must_use]
    pub fn all_bins(&self) -> Self {
        Grouping {
            units: self.units.all_bins(),
            stars: self.stars.iter().map(Behind::all_bins).collect(),
            missing: self.missing.clone(),
            ..*self
        }
    }
}

/// The group of each catalogue of a design: those of one group contain the same galaxies, by their names or order.
pub fn same_galaxies(catalogues: &[Catalogue], design: Design) -> Vec<u32> {
    numbers(catalogues, design).0
}

// Fewest groups of catalogues that serve as units. Below, the same rows of all catalogues form a unit: a jackknife of 20 units
// determines an error to 16 %. Chosen by hand.
const MIN_GROUPS: usize = 20;

/// Joins sums to the units of a design, which are as large as the galaxies that are not independent: the galaxy under all its
/// shears and versions, or all galaxies of catalogues that contain the same galaxies by their names or order.
///
/// `by_key` forces units of the same keys in all catalogues (`true`), or of whole catalogues; by default the latter if there
/// are 20 groups or more. `matched` states that keys are identifiers of galaxies rather than numbers of rows.
pub fn group(
    sums: UnitSums,
    catalogues: &[Catalogue],
    design: Design,
    by_key: Option<bool>,
    matched: bool,
) -> Grouping {
    let (numbers, named) = numbers(catalogues, design);
    let arms = arms(catalogues);
    let arm = |catalogue: u32| arms.get(catalogue as usize).copied().unwrap_or(0);
    let noises: Vec<Option<&StarNoise>> = catalogues.iter().map(|own| own.star.as_ref()).collect();
    let groups = names::count(&numbers);
    let paired = matches!(design, Design::Pairs | Design::Arms);
    let missing = match paired {
        true => missing(catalogues, &numbers),
        false => Vec::new(),
    };
    let several = match design {
        Design::Pairs | Design::Arms => groups > 1,
        Design::Fields => groups > names::count(&arms),
        _ => false,
    };
    // Identifiers state which galaxies are the same, where names do not.
    let by_key = by_key.unwrap_or(groups < MIN_GROUPS || matched && several && !named);
    let rotated = design == Design::Rotated;
    // Tiles differ in their galaxies, but not under another shear.
    let differ = |(number, own): (&u32, &Catalogue)| {
        let group = numbers.iter().zip(catalogues);
        let mut group = group.filter(|(other, _)| *other == number);
        group.any(|(_, other)| other.rows != own.rows)
    };
    let differ = numbers.iter().zip(catalogues).any(differ);
    let misaligned = by_key && (paired || rotated) && !matched && differ;
    // The order of catalogues states no pairs where identifiers do.
    let are_known = named || !several || !matched;
    let pairs = match paired && are_known {
        true => opposite_pairs(catalogues, &numbers),
        false => Vec::new(),
    };
    let by_catalogue = sums.by_catalogue();
    let correlation = correlation(&by_catalogue, &pairs).filter(|_| by_key);
    let without_partner = match misaligned || correlation.is_some() {
        true => None,
        false => without_partner(&by_catalogue, &pairs),
    };
    let group = |catalogue: u32| {
        let number = numbers.get(catalogue as usize);
        number.copied().unwrap_or(catalogue)
    };
    let stars = shared(&sums, &noises, (!by_key).then_some(&numbers), arm);
    Grouping {
        stars,
        whole_catalogues: !by_key,
        unit: match (by_key, matched, catalogues.len()) {
            (true, true, _) => "galaxies with the same identifier",
            (true, false, 1) => "galaxies in blocks of neighbouring rows",
            (true, false, _) => "the same rows of all catalogues",
            (false, ..) if groups == catalogues.len() => "catalogues",
            (false, ..) => match design {
                Design::Pairs if 2 * groups >= catalogues.len() => "pairs of catalogues",
                Design::Rotated => "pairs of catalogues",
                Design::Arms if groups * names::count(&arms) >= catalogues.len() => {
                    "sets of catalogues with one catalogue per shear"
                }
                _ => "sets of catalogues of the same galaxies",
            },
        },
        misaligned,
        uncorrelated: correlation,
        without_partner,
        missing,
        unpaired: unpaired(catalogues, design),
        assumed_different: several && !named && !by_key,
        units: match by_key {
            true => sums.by_key(arm),
            false => sums.by_group(arm, group),
        },
    }
}

/// Numbers from which a correlation is tested: it has an error of 0.05.
pub(crate) const ENOUGH_TO_CORRELATE: usize = 400;
// The correlation below which rows are other galaxies. The ellipticities of a
// galaxy under opposite shears have its shape in common: they correlate by 0.3 if noise is 1.5 times the shapes, which is
// three standard deviations of 400 numbers above the limit. A few rows before the first that is absent may correspond.
const MIN_CORRELATION: f64 = 0.15;

// Catalogues of one group under opposite shears.
fn opposite_pairs(catalogues: &[Catalogue], numbers: &[u32]) -> Vec<[u32; 2]> {
    let shears: Vec<Option<[f64; 2]>> = catalogues.iter().map(Catalogue::constant).collect();
    let mut of_group: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for (k, number) in numbers.iter().enumerate() {
        of_group.entry(*number).or_default().push(k);
    }
    let mut pairs = Vec::new();
    for group in of_group.values() {
        // The k-th catalogue of a shear with the k-th of the opposite one: versions are listed in the same order.
        let mut free: Vec<usize> = group.clone();
        for &k in group {
            let Some([a, b]) = shears[k].filter(|shear| (shear[0], shear[1]) > (0.0, 0.0)) else {
                continue;
            };
            let partner = free
                .iter()
                .position(|other| shears[*other].is_some_and(|g| same(g, [-a, -b])));
            pairs.extend(partner.map(|at| [k as u32, free.remove(at) as u32]));
        }
    }
    pairs
}

// The correlation of the ellipticities of units under opposite shears, if there are enough units and it is too small for the
// same galaxies: the error of m is then too large, because the shapes do not cancel.
fn correlation(sums: &OfCatalogues<'_>, pairs: &[[u32; 2]]) -> Option<f64> {
    let (mut count, mut cross, mut squares) = (0, 0.0, [0.0; 2]);
    for [a, b] in pairs {
        let pairs: Vec<[[f64; 2]; 2]> = sums
            .pairs(*a, *b, |layout, all| layout.mean(all))
            .into_iter()
            .filter_map(|[a, b]| Some([a?, b?]))
            .filter(|pair| pair.iter().flatten().all(|e| e.is_finite()))
            .collect();
        for component in 0..2 {
            let mean = |of: usize| {
                let values = pairs.iter().map(|pair| pair[of][component]);
                values.sum::<f64>() / pairs.len() as f64
            };
            let means = [mean(0), mean(1)];
            for pair in &pairs {
                let [a, b] = [0, 1].map(|of| pair[of][component] - means[of]);
                cross += a * b;
                squares = [squares[0] + a * a, squares[1] + b * b];
            }
        }
        count += 2 * pairs.len();
    }
    let found = cross / (squares[0] * squares[1]).sqrt();
    (count >= ENOUGH_TO_CORRELATE && found < MIN_CORRELATION).then_some(found)
}

// Units that determine the number of galaxies without partner to √(2/200) = 10 %: 50 units said 4292 for 2962.
const MIN_UNITS_TO_COUNT: usize = 200;

// If galaxies without partner are drawn at random, the difference of the numbers of galaxies in a unit under the two shears has
// the variance of a Poisson distribution of their number. m follows from the sums of w e g. What the shapes of galaxies without
// partner add to their variance is their share of Σ (w e g)², which is the variance between units of the sums under one shear.
fn without_partner(sums: &OfCatalogues<'_>, pairs: &[[u32; 2]]) -> Option<WithoutPartner> {
    type Numbers = (f64, [[f64; 2]; 2]);
    let (mut galaxies, mut of) = (0.0, 0.0);
    let (mut of_shapes, mut of_all) = ([0.0; 2], [0.0; 2]);
    let units = |[a, b]: &[u32; 2]| -> Vec<[Numbers; 2]> {
        let units = sums.pairs(*a, *b, Layout::counts_and_slopes).into_iter();
        units
            .map(|pair| pair.map(Option::unwrap_or_default))
            .collect()
    };
    // One unit has no scatter: pairs of catalogues that are one unit each, such as a seed or tile per file, are compared with each
    // other.
    let (single, mut all): (Vec<_>, Vec<_>) =
        pairs.iter().map(units).partition(|own| own.len() == 1);
    all.push(single.concat());
    all.retain(|units| units.len() > 1);
    if all.iter().map(Vec::len).sum::<usize>() < MIN_UNITS_TO_COUNT {
        return None;
    }
    for units in all {
        let total: f64 = units.iter().map(|[a, b]| a.0 + b.0).sum();
        // The variance of what a value differs from its expectation, which is proportional to `scale`.
        type Value<'a> = &'a dyn Fn(&[Numbers; 2]) -> f64;
        let variance = |value: Value<'_>, scale: Value<'_>| {
            let sum = |of: Value<'_>| units.iter().map(of).sum::<f64>();
            let mean = sum(value) / sum(scale);
            let residual = |unit: &[Numbers; 2]| value(unit) - mean * scale(unit);
            units.iter().map(|unit| residual(unit).powi(2)).sum::<f64>()
        };
        let count: Value<'_> = &|[a, b]| a.0 + b.0;
        of += total;
        // Flags of the other sign under one shear leave galaxies without partner that are not drawn at random.
        let excess: f64 = units.iter().map(|[a, b]| a.0 - b.0).sum();
        galaxies += variance(&|[a, b]| a.0 - b.0, count).max(excess.abs());
        for k in 0..2 {
            let shapes = |at: usize| variance(&|unit| unit[at].1[0][k], count);
            of_shapes[k] += shapes(0) + shapes(1);
            // The response of sheared catalogues is in no row.
            let response: Value<'_> = &|[a, b]| a.1[1][k] + b.1[1][k];
            let has_response = units.iter().any(|unit| response(unit) != 0.0);
            let scale = if has_response { response } else { count };
            of_all[k] += variance(&|[a, b]| a.1[0][k] + b.1[0][k], scale);
        }
    }
    // `clamp` keeps the NaN of a component without true shear, and `min` would make it 1.
    let share = |k: usize| (galaxies / of * of_shapes[k] / of_all[k]).clamp(0.0, 1.0);
    (galaxies > 0.0).then_some(WithoutPartner {
        galaxies,
        of,
        share: [share(0), share(1)],
    })
}

fn missing(catalogues: &[Catalogue], numbers: &[u32]) -> Vec<Missing> {
    let shears: Vec<[f64; 2]> = catalogues.iter().filter_map(Catalogue::constant).collect();
    if shears.len() < catalogues.len() {
        return Vec::new();
    }
    let mut groups: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for (k, number) in numbers.iter().enumerate() {
        groups.entry(*number).or_default().push(k);
    }
    let absent = |group: &Vec<usize>, kind: [f64; 2]| !group.iter().any(|k| same(shears[*k], kind));
    let kinds = Kinds::of(&shears).shears;
    let of_group = |group: Vec<usize>| {
        let kinds: Vec<[f64; 2]> = kinds
            .iter()
            .copied()
            .filter(|kind| absent(&group, *kind))
            .collect();
        let beside = catalogues[group[0]].name.clone();
        kinds.into_iter().map(move |shear| Missing {
            beside: beside.clone(),
            shear,
        })
    };
    groups.into_values().flat_map(of_group).collect()
}

// The first shear with an opposite one under which there are more or fewer catalogues, with both numbers: a survey's
// simulation in which tiles failed, rather than fields of random shears.
fn unpaired(catalogues: &[Catalogue], design: Design) -> Option<([f64; 2], [usize; 2])> {
    if design != Design::Fields {
        return None;
    }
    let shears: Vec<[f64; 2]> = catalogues.iter().filter_map(Catalogue::constant).collect();
    let kinds = Kinds::of(&shears);
    let counts = kinds.counts(&shears);
    let all = kinds.shears.iter().zip(&counts);
    let mut all = all.map(|(kind, own)| (*kind, [*own, kinds.opposite(*kind, &counts)]));
    all.find(|(_, [own, opposite])| *opposite > 0 && own != opposite)
}

// The group of each catalogue, and whether names state it. Without names, the k-th catalogues of each shear belong together,
// as files are listed.
fn numbers(catalogues: &[Catalogue], design: Design) -> (Vec<u32>, bool) {
    let arms = arms(catalogues);
    // Fields with a shear each: versions of a field have its shear.
    if design == Design::Fields && names::count(&arms) >= MIN_GROUPS {
        return (arms, true);
    }
    if design != Design::Rotated
        && let Some(numbers) = names::groups(catalogues)
        && (design != Design::Fields || names::count(&numbers) > 1)
    {
        return (numbers, true);
    }
    let mut so_far: BTreeMap<u32, u32> = BTreeMap::new();
    let number = |(k, arm): (usize, &u32)| match design {
        Design::Pairs | Design::Arms => {
            let next = so_far.entry(*arm).or_default();
            *next += 1;
            *next - 1
        }
        Design::Rotated => k as u32 / 2,
        _ => k as u32,
    };
    (arms.iter().enumerate().map(number).collect(), false)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::Range;

    fn catalogues(shears: &[[f64; 2]]) -> Vec<Catalogue> {
        let range = |value| Range {
            low: value,
            high: value,
        };
        let of = |shear: &[f64; 2]| Catalogue {
            rows: 1,
            shear: shear.map(range),
            ..Catalogue::default()
        };
        shears.iter().map(of).collect()
    }

    #[test]
    fn designs_are_recognised_from_the_true_shears() {
        let of = |shears: &[[f64; 2]]| Design::of(&catalogues(shears), true);
        let (plus, minus) = ([0.02, 0.0], [-0.02, 0.0]);
        assert_eq!(of(&[plus]), Design::Single);
        assert_eq!(of(&[plus, minus, plus, minus]), Design::Pairs);
        assert_eq!(of(&[plus, minus, [0.0, 0.02], [0.0, -0.02]]), Design::Arms);
        assert_eq!(of(&[plus, minus, plus]), Design::Fields);
        assert_eq!(of(&[plus, [0.01, 0.0]]), Design::Fields);
        let mut varying = catalogues(&[plus]);
        varying[0].shear[1].add(0.5);
        assert_eq!(Design::of(&varying, true), Design::Galaxies);
        assert_eq!(Design::of(&varying, false), Design::Null);
    }

    #[test]
    fn the_same_catalogue_of_each_shear_belongs_to_a_group() {
        let (plus, minus) = ([0.02, 0.0], [-0.02, 0.0]);
        let shears = catalogues(&[plus, plus, minus, minus]);
        assert_eq!(numbers(&shears, Design::Pairs).0, [0, 1, 0, 1]);
        assert_eq!(numbers(&shears, Design::Rotated).0, [0, 0, 1, 1]);
        assert_eq!(numbers(&shears, Design::Fields).0, [0, 1, 2, 3]);
    }

    fn named(of: &[(&str, [f64; 2])]) -> Vec<Catalogue> {
        let shears: Vec<[f64; 2]> = of.iter().map(|own| own.1).collect();
        let mut all = catalogues(&shears);
        for (catalogue, (name, _)) in all.iter_mut().zip(of) {
            catalogue.name = (*name).to_owned();
        }
        all
    }

    #[test]
    fn catalogues_pair_by_name_if_some_are_missing() {
        let (plus, minus) = ([0.02, 0.0], [-0.02, 0.0]);
        let tiles = named(&[
            ("1p2z/tile01.fits", plus),
            ("1p2z/tile02.fits", plus),
            ("1p2z/tile04.fits", plus),
            ("1m2z/tile04.fits", minus),
            ("1m2z/tile03.fits", minus),
            ("1m2z/tile01.fits", minus),
            ("1m2z/tile02.fits", minus),
        ]);
        assert_eq!(Design::of(&tiles, true), Design::Pairs);
        let numbers = numbers(&tiles, Design::Pairs).0;
        assert_eq!(numbers, [0, 1, 2, 2, 3, 0, 1]);
        let expected = Missing {
            beside: "1m2z/tile03.fits".into(),
            shear: plus,
        };
        assert_eq!(missing(&tiles, &numbers), [expected]);
        // Signs in names, and numbers of tiles behind them.
        let signs = named(&[
            ("cat_g1+0.02_7.csv", plus),
            ("cat_g1+0.02_9.csv", plus),
            ("cat_g1-0.02_9.csv", minus),
            ("cat_g1-0.02_7.csv", minus),
        ]);
        assert_eq!(names::groups(&signs), Some(vec![0, 1, 1, 0]));
        // Numbers that go on do not pair; the order does.
        let runs = named(&[
            ("run1", plus),
            ("run2", plus),
            ("run3", minus),
            ("run4", minus),
        ]);
        assert_eq!(names::groups(&runs), None);
        assert_eq!(
            super::numbers(&runs, Design::Pairs),
            (vec![0, 1, 0, 1], false)
        );
        let three = named(&[("a1", plus), ("b2", plus), ("c3", minus)]);
        assert_eq!(Design::of(&three, true), Design::Fields);
    }

    #[test]
    fn single_precision_shears_pair_with_double_precision() {
        let plus = [0.02_f32, -0.015].map(f64::from);
        let both = catalogues(&[plus, [-0.02, 0.015]]);
        assert_eq!(Design::of(&both, true), Design::Pairs);
        let other = catalogues(&[plus, [-0.02002, 0.015]]);
        assert_eq!(Design::of(&other, true), Design::Fields);
    }

    #[test]
    fn other_shears_of_the_same_names_are_arms() {
        let of = |shears: &[[f64; 2]], name: &dyn Fn(usize, usize) -> String| {
            let of: Vec<(String, [f64; 2])> = (0..30)
                .flat_map(|seed| (0..shears.len()).map(move |arm| (arm, seed)))
                .map(|(arm, seed)| (name(arm, seed), shears[arm]))
                .collect();
            let of: Vec<_> = of.iter().map(|(name, g)| (name.as_str(), *g)).collect();
            let all = named(&of);
            let design = Design::of(&all, true);
            (design, names::count(&numbers(&all, design).0))
        };
        let (large, small, zero) = ([0.08, 0.0], [-0.02, 0.0], [0.0; 2]);
        let folders = |arm: usize, seed: usize| format!("arm{arm}/seed{seed:03}.fits");
        assert_eq!(of(&[large, small], &folders), (Design::Arms, 30));
        assert_eq!(of(&[large, zero], &folders), (Design::Arms, 30));
        assert_eq!(
            of(&[small, [0.02, 0.0], zero], &folders),
            (Design::Arms, 30)
        );
        // Other seeds under each shear.
        let other = |arm: usize, seed: usize| format!("seed{:03}.fits", 30 * arm + seed);
        assert_eq!(of(&[large, small], &other), (Design::Fields, 60));
    }

    #[test]
    fn a_part_that_states_another_one_keeps_its_values() {
        let all: Vec<(String, [f64; 2])> = (0..8)
            .map(|k| {
                let (arm, tile) = (k / 4, k % 4);
                let name = format!("{}/run{}/tile{tile}.fits", ["p", "q"][arm], tile / 2);
                (name, [[0.02, 0.0], [-0.02, 0.0]][arm])
            })
            .collect();
        let all: Vec<_> = all.iter().map(|(name, g)| (name.as_str(), *g)).collect();
        // A tile states its run, which does not state the tile.
        assert_eq!(
            names::groups(&named(&all)),
            Some(vec![0, 1, 2, 3, 0, 1, 2, 3])
        );
    }

    #[test]
    fn versions_of_the_same_galaxies_belong_to_a_group() {
        let groups = |shears: &[[f64; 2]], name: &dyn Fn(usize, usize, usize) -> String| {
            let mut all = Vec::new();
            for tile in 0..24 {
                for version in 0..2 {
                    for (arm, g) in shears.iter().enumerate() {
                        all.push((name(arm, version, tile), *g));
                    }
                }
            }
            let all: Vec<_> = all.iter().map(|(name, g)| (name.as_str(), *g)).collect();
            names::groups(&named(&all)).map(|groups| names::count(&groups))
        };
        let pair = [[0.02, 0.0], [-0.02, 0.0]];
        let rotation = |version| 90 * version;
        let folders = |a, v, t| format!("out/{}_rot{}/tile{t:02}.fits", ["p", "q"][a], rotation(v));
        let files = |a, v, t| format!("{}_rot{}_tile{t:02}.fits", ["p", "q"][a], rotation(v));
        let suffix =
            |a, v: usize, t| format!("{}/tile{t:02}{}.fits", ["p", "q"][a], ["", "_rot"][v]);
        let prefix =
            |a, v: usize, t| format!("{}{}/{t:02}.fits", ["p", "q"][a], ["", "-turned"][v]);
        let shapes: [&dyn Fn(usize, usize, usize) -> String; 4] =
            [&folders, &files, &suffix, &prefix];
        for name in shapes {
            assert_eq!(groups(&pair, name), Some(24), "{}", name(0, 1, 3));
            assert_eq!(groups(&pair[..1], name), Some(24), "{}", name(0, 1, 3));
        }
        // Twenty-four seeds of two tiles are other galaxies, or two versions: one unit is right for both.
        let seeds = |a, v, t| format!("{}/seed{t}/tile{v}.fits", ["p", "q"][a]);
        assert_eq!(groups(&pair, &seeds), Some(24));
    }
}
