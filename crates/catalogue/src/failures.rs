//! Numbers and rows that stand for failed measurements: sentinels, values, rows and identifiers that repeat, responses that
//! outweigh all others, and measured shears in the place of true ones. They are found wherever rows are averaged.

use std::collections::HashMap;

use shearq_bias::{Dominant, Repeated, Row};
use shearq_quantities::MeasuredRange;
use shearq_quantities::hash::NumberMap;

use crate::identity::hash;

/// A number as messages show it.
pub fn shown(value: f64) -> String {
    match value.abs() >= 1e7 {
        // Thirty digits would hide the message.
        true => format!("{value:e}"),
        false => value.to_string(),
    }
}

/// The columns of a part of a table, by place.
pub type Part<'p> = [&'p [f64]];

/// Inverse variances in any unit are smaller; programs write 1e20, 1e30 or the largest float for a failure.
pub const MIN_FAILED_WEIGHT: f64 = 1e20;
/// A test of a column for numbers that stand for failed measurements. HSM's −10 in one row of a hundred gave c = −0.096, and 1e30
/// m = 3.5·10¹², without a word.
#[derive(Debug)]
pub struct Check {
    pub column: usize,
    pub expected: &'static str,
    pub range: MeasuredRange,
    pub fails: fn(f64, MeasuredRange) -> bool,
}

impl Check {
    /// Whether one of these numbers fails.
    pub fn fails_in(&self, values: &[f64]) -> bool {
        values.iter().any(|value| (self.fails)(*value, self.range))
    }
}

// A row is reported if it changes the mean response, and with it m, by half of the requirement of 2·10⁻³.
const MIN_DOMINANT_SHARE: f64 = 1e-3;
// Least ratio of its response to the mean, so that rows of small catalogues are not reported. Chosen by hand: responses of
// metacalibration at S/N 10 scatter by about twice the mean.
const MIN_DOMINANT_RATIO: f64 = 10.0;

// The row with the largest response of each component, and the sum of all. An R11 of 12 in one of
// 2000 rows, below the numbers that count as failures, changed m by 0.007 without a word.
#[derive(Debug, Default)]
pub struct LargestResponse {
    rows: u64,
    sums: [f64; 2],
    largest: [(u64, f64); 2],
}

impl LargestResponse {
    pub fn add(&mut self, number: u64, row: &Row) {
        self.rows += 1;
        for k in 0..2 {
            let response = row.response[k][k];
            self.sums[k] += response;
            if response.abs() > self.largest[k].1.abs() {
                self.largest[k] = (number, response);
            }
        }
    }

    pub fn found(&self) -> Option<Dominant> {
        let of_component = |component: usize| {
            let (row, response) = self.largest[component];
            // Without the row, because it may be most of the sum.
            let rest = self.sums[component] - response;
            let mean = rest / (self.rows - 1) as f64;
            let share = response.abs() / self.sums[component].abs();
            let is_dominant =
                share > MIN_DOMINANT_SHARE && response.abs() > MIN_DOMINANT_RATIO * mean.abs();
            is_dominant.then_some(Dominant {
                row,
                component,
                response,
                mean,
                share,
            })
        };
        if self.rows < 2 {
            return None;
        }
        (0..2).find_map(of_component)
    }
}

// Rows of a part that are sampled for repeated numbers; only those are then counted in all rows. Chosen by hand.
const SEARCHED_ROWS: usize = 4096;

// Many rows share numbers that were rounded to few digits, but a distribution is flat around its maximum, so that the ten most
// frequent numbers are about equally frequent. A number ten times as frequent as the tenth marks a failure or a default.
const REFERENCE_RANK: usize = 10;
const OUTSTANDING_RATIO: f64 = 10.0;
// With two digits, 10⁴ galaxies share a pair of ellipticities in one of ten rows at most.
const MIN_SHARED: f64 = 1e-3;
// Copies of a galaxy are fewer. Chosen by hand.
const MIN_SHARED_ROWS: u64 = 16;
// A column of fewer different numbers is one of classes, whose frequencies differ. Chosen by hand.
const MAX_CLASSES: usize = 10;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RepeatKind {
    /// Pairs of ellipticities, if a row in a thousand has them: with two digits, 10⁴ galaxies share one in ten rows at most.
    Ellipticities,
    /// Zeros of both columns, if not all rows have them.
    Zeros,
    /// The number that stands out in one column, other than zero for derivatives: a smooth cut far away has none.
    Number { or_zero: bool },
}

// Numbers that several rows share exactly in two columns, or in one that is named twice.
#[derive(Debug)]
struct Repeat {
    kind: RepeatKind,
    columns: [usize; 2],
    names: [String; 2],
    counts: NumberMap<(u64, u64), Counted>,
    different: usize,
}

// How many rows have a number since it was first noticed, and the rows before that. Of a number that occurs in the last of ten
// tiles alone, the share is the one in the rows since then.
#[derive(Debug, Clone, Copy, Default)]
struct Counted {
    rows: u64,
    before: u64,
}

/// Counts of repeated numbers: zeros and other plain numbers often stand for failures that no flag states.
#[derive(Debug, Default)]
pub struct Repeats {
    used: u64,
    all: Vec<Repeat>,
}

impl Repeat {
    fn new(kind: RepeatKind, columns: [usize; 2], names: [String; 2]) -> Self {
        let zeros = (kind == RepeatKind::Zeros).then_some(((0, 0), Counted::default()));
        Repeat {
            kind,
            columns,
            names,
            counts: zeros.into_iter().collect(),
            different: 0,
        }
    }

    // Zeros with either sign are equal.
    fn key(&self, part: &Part<'_>, at: usize) -> (u64, u64) {
        let [a, b] = self.columns.map(|column| part[column][at] + 0.0);
        (a.to_bits(), b.to_bits())
    }

    // `before` rows were added already.
    fn look_for(&mut self, part: &Part<'_>, before: u64) {
        let (searched, or_zero) = match self.kind {
            RepeatKind::Zeros => return,
            RepeatKind::Ellipticities => (SEARCHED_ROWS, true),
            // Half of the failures in one of 1000 rows of a small catalogue are enough.
            RepeatKind::Number { or_zero } => (4 * SEARCHED_ROWS, or_zero),
        };
        let mut seen = NumberMap::<(u64, u64), ()>::default();
        let rows = part[self.columns[0]].len();
        for at in (0..rows).step_by(rows.div_ceil(searched).max(1)) {
            let values = self.columns.map(|column| part[column][at]);
            let counts = values.iter().all(|value| value.is_finite());
            let key = self.key(part, at);
            if counts && (or_zero || values[0] != 0.0) && seen.insert(key, ()).is_some() {
                self.counts
                    .entry(key)
                    .or_insert(Counted { rows: 0, before });
            }
        }
        self.different = self.different.max(seen.len());
    }

    // The most frequent numbers of the `used` rows, if coincidence does not explain their frequency.
    fn found(&self, used: u64) -> Option<([f64; 2], u64)> {
        let share = |own: &Counted| own.rows as f64 / (used - own.before).max(1) as f64;
        let mut counts: Vec<(&(u64, u64), &Counted)> = self.counts.iter().collect();
        counts.sort_unstable_by(|a, b| share(b.1).total_cmp(&share(a.1)).then(a.0.cmp(b.0)));
        let (&(a, b), most) = *counts.first()?;
        let worth = match self.kind {
            RepeatKind::Ellipticities => most.rows >= 3 && share(most) >= MIN_SHARED,
            RepeatKind::Zeros => most.rows >= 3 && most.rows < used,
            RepeatKind::Number { or_zero } => {
                let since = (used - most.before).max(1) as f64;
                let tenth = counts.get(REFERENCE_RANK - 1);
                let tenth = tenth.map_or(0.0, |(_, count)| share(count));
                let ratio = share(most) / tenth.max(1.0 / since);
                let stands_out = ratio > OUTSTANDING_RATIO && most.rows < used;
                stands_out && (self.different > MAX_CLASSES || !or_zero)
            }
        };
        worth.then(|| ([a, b].map(f64::from_bits), most.rows))
    }
}

impl Repeats {
    /// Also looks for numbers in two columns, or in one that is named twice.
    pub fn watch(&mut self, kind: RepeatKind, columns: [usize; 2], names: [String; 2]) {
        self.all.push(Repeat::new(kind, columns, names));
    }

    /// Searches a part for numbers that are then counted in all rows.
    pub fn look_for(&mut self, part: &Part<'_>) {
        let before = self.used;
        let all = self.all.iter_mut();
        all.for_each(|repeat| repeat.look_for(part, before));
    }

    /// Adds a row that counts, and returns whether its ellipticity is one that many rows share.
    pub fn add(&mut self, part: &Part<'_>, at: usize) -> bool {
        self.used += 1;
        let mut shared = false;
        for repeat in self
            .all
            .iter_mut()
            .filter(|repeat| !repeat.counts.is_empty())
        {
            let key = repeat.key(part, at);
            if repeat.kind == RepeatKind::Zeros && key != (0, 0) {
                continue;
            }
            if let Some(count) = repeat.counts.get_mut(&key) {
                count.rows += 1;
                // Of a few rows, these are copies rather than a failure.
                let since = (self.used - count.before) as f64;
                let many = count.rows > MIN_SHARED_ROWS && count.rows as f64 > MIN_SHARED * since;
                shared |= many && repeat.kind == RepeatKind::Ellipticities;
            }
        }
        shared
    }

    pub fn found(&self) -> Vec<Repeated> {
        let mut all: Vec<Repeated> = Vec::new();
        for repeat in &self.all {
            let columns = repeat.names.clone();
            // A pair explains its columns.
            let known = all.iter().any(|pair| pair.columns.contains(&columns[0]));
            let is_number = matches!(repeat.kind, RepeatKind::Number { .. });
            if let Some((values, rows)) = repeat.found(self.used).filter(|_| !(is_number && known))
            {
                all.push(Repeated {
                    columns,
                    values,
                    rows,
                });
            }
        }
        all
    }
}

// Different keys that are counted. The error of a share of 1 % is then 0.04 %.
const MAX_COUNTED_KEYS: usize = 1 << 16;

/// How many rows repeat an earlier one, by a key of each row with evenly distributed bits. Which keys are counted depends on
/// their bits, so that all rows of a key are, whatever the number of rows; keys that are frequent in the first rows are
/// counted in any case.
#[derive(Debug, Default)]
pub struct Multiplicity {
    rows: u64,
    frequent: NumberMap<u64, u64>,
    frequent_rows: u64,
    // Keys are counted that end with so many zeros.
    zeros: u32,
    counts: NumberMap<u64, u64>,
}

impl Multiplicity {
    /// Searches the first part for keys that are counted in any case.
    pub fn look_for(&mut self, keys: impl Iterator<Item = u64>) {
        if self.rows > 0 {
            return;
        }
        let mut counts = HashMap::<u64, u64>::new();
        keys.for_each(|key| *counts.entry(key).or_default() += 1);
        let frequent = counts.into_iter().filter(|(_, count)| *count >= 3);
        self.frequent = frequent.map(|(key, _)| (key, 0)).collect();
    }

    pub fn add(&mut self, key: u64) {
        self.rows += 1;
        if !self.frequent.is_empty()
            && let Some(count) = self.frequent.get_mut(&key)
        {
            *count += 1;
            self.frequent_rows += 1;
        } else if key.trailing_zeros() >= self.zeros {
            *self.counts.entry(key).or_default() += 1;
            while self.counts.len() > MAX_COUNTED_KEYS {
                self.zeros += 1;
                let zeros = self.zeros;
                self.counts.retain(|key, _| key.trailing_zeros() >= zeros);
            }
        }
    }

    /// The number of rows that are not the first one of their key.
    pub fn repeated(&self) -> u64 {
        let counted: u64 = self.counts.values().sum();
        let share = match counted {
            0 => 0.0,
            counted => 1.0 - self.counts.len() as f64 / counted as f64,
        };
        let frequent = self.frequent.values().filter(|count| **count > 0).count();
        let others = (self.rows - self.frequent_rows) as f64 * share;
        self.frequent_rows - frequent as u64 + others.round() as u64
    }
}

// Shares of rows that are not the first of their values, above which they are reported: as many as of equal pairs of ellipticities
// in `shearq_scoring::repeated`; of identifiers, which never repeat by chance, a tenth of it.
const MIN_REPEATED_ROWS: f64 = 0.01;
const MIN_REPEATED_IDENTIFIERS: f64 = 0.001;
// By so many times the rows must exceed those that rounded numbers repeat by chance. Chosen by hand.
const CHANCE: f64 = 3.0;

/// Rows and identifiers that occur several times in one catalogue.
#[derive(Debug, Default)]
pub struct Copies {
    rows: Multiplicity,
    identifiers: Multiplicity,
    // Probability that a component of two galaxies is the same number, which was rounded.
    coincidence: [f64; 2],
}

impl Copies {
    /// Searches the first part, whose ellipticities are in columns `e`.
    pub fn look_for(&mut self, part: &Part<'_>, e: [usize; 2], ids: Option<&[u64]>) {
        if self.rows.rows > 0 {
            return;
        }
        let rows = part[e[0]].len();
        let sampled = || (0..rows).step_by(rows.div_ceil(SEARCHED_ROWS).max(1));
        self.coincidence = e.map(|column| {
            let mut counts = HashMap::<u64, usize>::new();
            let values = sampled().map(|at| part[column][at].to_bits());
            values.for_each(|value| *counts.entry(value).or_default() += 1);
            let pairs = |count: usize| (count * count.saturating_sub(1)) as f64;
            let equal: f64 = counts.values().map(|count| pairs(*count)).sum();
            equal / pairs(sampled().count()).max(1.0)
        });
        if let Some(ids) = ids {
            self.identifiers.look_for(sampled().map(|at| ids[at]));
        }
    }

    /// Adds a row that counts, by a key of its numbers and its identifier.
    pub fn add(&mut self, row: Option<u64>, id: Option<u64>) {
        row.into_iter().for_each(|key| self.rows.add(key));
        id.into_iter().for_each(|key| self.identifiers.add(key));
    }

    /// Rows that are not the first with their numbers, if chance does not explain them.
    pub fn rows(&self) -> Option<u64> {
        let (all, repeated) = (self.rows.rows as f64, self.rows.repeated());
        let chance = all * self.coincidence[0] * self.coincidence[1];
        (repeated as f64 > all * (MIN_REPEATED_ROWS + CHANCE * chance)).then_some(repeated)
    }

    /// Rows that are not the first with their identifier.
    pub fn identifiers(&self) -> Option<u64> {
        let (all, repeated) = (self.identifiers.rows as f64, self.identifiers.repeated());
        (repeated as f64 > all * MIN_REPEATED_IDENTIFIERS).then_some(repeated)
    }
}

/// How many rows of one catalogue by shearq, which rounds nothing, have the ellipticity of an earlier row; 0 of few.
pub fn repeated_ellipticities(rows: impl Iterator<Item = [f64; 2]> + Clone) -> u64 {
    let mut found = Multiplicity::default();
    let key = |e: [f64; 2]| hash(hash(e[0].to_bits()) ^ e[1].to_bits());
    found.look_for(rows.clone().take(SEARCHED_ROWS).map(key));
    rows.for_each(|e| found.add(key(e)));
    let repeated = found.repeated();
    match repeated as f64 > found.rows as f64 * MIN_REPEATED_ROWS {
        true => repeated,
        false => 0,
    }
}

// Shears that are measured scatter like shapes, by 0.2 to 0.4. Weak lensing has 0.03, and GREAT10's fields up to 0.05.
const MAX_SCATTER: f64 = 0.1;
// Beyond this modulus lensing is not weak; in so many rows, the column contains no true shears.
const MAX_SHEAR: f64 = 0.3;
const MIN_LARGE_SHARE: f64 = 0.005;
// Squared correlation with e: of true shears, σ_g²/σ_e² is below 0.1. Below a scatter of 0.05, round galaxies under true shears
// may have any correlation.
const MAX_CORRELATION: f64 = 0.5;
const MIN_SCATTER: f64 = 0.05;
// Rows from which these statistics are meaningful, and after which they do not change. Chosen by hand.
const MIN_ROWS: f64 = 100.0;
const MAX_ROWS: f64 = 65_536.0;

/// Whether the true shears of the rows of a catalogue look like measured ones. `gamma1` = e1/1.35 beside e1 gave
/// m = 0.100 ± 10⁻¹³.
#[derive(Debug, Default)]
pub struct TrueShears {
    rows: f64,
    large: f64,
    // Sums of g, e, g², e² and g e of each component.
    sums: [[f64; 5]; 2],
}

impl TrueShears {
    pub fn add(&mut self, row: &Row) {
        if self.rows >= MAX_ROWS {
            return;
        }
        self.rows += 1.0;
        self.large += f64::from(u8::from(row.g[0].hypot(row.g[1]) > MAX_SHEAR));
        for ((sums, g), e) in self.sums.iter_mut().zip(row.g).zip(row.e) {
            for (sum, term) in sums.iter_mut().zip([g, e, g * g, e * e, g * e]) {
                *sum += term;
            }
        }
    }

    /// What measured shears have and true ones have not.
    pub fn fault(&self) -> Option<String> {
        if self.rows < MIN_ROWS {
            return None;
        }
        let of_component = |sums: [f64; 5]| {
            let [g, e, gg, ee, ge] = sums.map(|sum| sum / self.rows);
            let scatter = (gg - g * g).max(0.0).sqrt();
            let correlation = (ge - g * e) / (scatter * (ee - e * e).max(0.0).sqrt());
            (scatter, correlation)
        };
        let both = self.sums.map(of_component);
        let scatter = both[0].0.max(both[1].0);
        let related = |(scatter, correlation): &&(f64, f64)| {
            *scatter > MIN_SCATTER && correlation * correlation > MAX_CORRELATION
        };
        let large = self.large / self.rows;
        Some(match () {
            () if scatter > MAX_SCATTER => {
                format!(
                    "found a scatter of {scatter:.3}, expected true shears, which scatter by less than {MAX_SCATTER}"
                )
            }
            () if large > MIN_LARGE_SHARE => format!(
                "found a modulus above {MAX_SHEAR} in {:.1} % of the rows, expected true shears below it",
                100.0 * large
            ),
            () => {
                let (_, correlation) = both.iter().find(related)?;
                format!(
                    "found a correlation of {correlation:.3} with the ellipticity, expected true shears, on which shapes do not depend"
                )
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_keys_are_counted_in_tables_of_any_length() {
        // Each key four times: three quarters of the rows are not the first.
        for rows in [400, 400_000] {
            let mut found = Multiplicity::default();
            (0..rows).for_each(|row| found.add(hash(row / 4)));
            let share = found.repeated() as f64 / rows as f64;
            assert!((share - 0.75).abs() < 0.01, "{share}");
        }
        // One key in half of the rows, which no choice by bits may miss.
        let mut found = Multiplicity::default();
        let key = |row: u64| hash(if row.is_multiple_of(2) { 1 << 60 } else { row });
        found.look_for((0..1000).map(key));
        (0..400_000).for_each(|row| found.add(key(row)));
        let share = found.repeated() as f64 / 4e5;
        assert!((share - 0.5).abs() < 1e-3, "{share}");
        let mut found = Multiplicity::default();
        (0..400_000).for_each(|row| found.add(hash(row)));
        assert_eq!(found.repeated(), 0);
    }

    #[test]
    fn rounded_shapes_repeat_by_chance() {
        let digits = |scale: f64| -> Option<u64> {
            let mut found = Copies::default();
            let value = |row: u64, k: u64| {
                let uniform = hash(2 * row + k) as f64 / u64::MAX as f64;
                (uniform * scale).round() / scale
            };
            let columns = [0, 1].map(|k| (0..20_000).map(|row| value(row, k)).collect::<Vec<_>>());
            let part = columns.each_ref().map(Vec::as_slice);
            found.look_for(&part, [0, 1], None);
            for (e1, e2) in part[0].iter().zip(part[1].iter()) {
                let key = [e1, e2]
                    .iter()
                    .fold(0, |key, value| hash(key ^ value.to_bits()));
                found.add(Some(key), None);
            }
            found.rows()
        };
        // Of 10⁴ pairs of numbers, most occur twice; of 10¹², none.
        assert_eq!(digits(100.0), None);
        assert_eq!(digits(1e6), None);
    }

    #[test]
    fn measured_shears_are_no_true_ones() {
        let uniform = |row: u64| hash(row) as f64 / u64::MAX as f64 - 0.5;
        let fault = |g: &dyn Fn(u64, [f64; 2]) -> [f64; 2]| {
            let mut found = TrueShears::default();
            for row in 0..1000 {
                let e = [uniform(2 * row), uniform(2 * row + 1)];
                let g = g(row, e);
                let response = [[1.0, 0.0], [0.0, 1.0]];
                found.add(&Row {
                    e,
                    weight: 1.0,
                    response,
                    g,
                    psf: [0.0; 2],
                    psf_size: 1.0,
                });
            }
            found.fault()
        };
        assert!(
            fault(&|_, e| e.map(|e| e / 1.35))
                .unwrap()
                .contains("scatter")
        );
        assert!(
            fault(&|_, e| e.map(|e| 0.2 * e))
                .unwrap()
                .contains("correlation")
        );
        let large = |row: u64| if row < 10 { [0.5, 0.0] } else { [0.01, 0.0] };
        assert!(fault(&|row, _| large(row)).unwrap().contains("modulus"));
        let other = |row: u64| [0, 1].map(|k| 0.1 * uniform(7000 + 2 * row + k));
        assert_eq!(fault(&|row, _| other(row)), None);
        // Round galaxies.
        assert_eq!(fault(&|_, e| e.map(|e| 0.1 * e)), None);
        assert_eq!(fault(&|_, _| [0.02, -0.01]), None);
    }
}
