//! Ranks the entries of a challenge.

use std::collections::BTreeMap;

use shearq_results::compare::difference;

use crate::constant::ConstantShears;
use crate::date::day_of;
use crate::judge::{Entry, EntryInfo};
use crate::kind::RankBy;
use crate::terms::Rules;

/// An entry with its metric.
#[derive(Debug, Clone)]
pub struct Result<'a> {
    /// The entry.
    pub entry: &'a Entry,
    /// Number of the entry of its team, from 1.
    pub number: usize,
    /// Mean metric over sets.
    pub value: f64,
    /// Its standard error; not a number if unknown.
    pub error: f64,
}

impl Result<'_> {
    /// Team, method and time.
    pub fn info(&self) -> &EntryInfo {
        &self.entry.info
    }
}

/// A team, or a reference of the organiser.
#[derive(Debug, Clone)]
pub struct Standing<'a> {
    /// Rank of a team, from 1. References have none.
    pub rank: Option<usize>,
    /// The best entry.
    pub best: Result<'a>,
    /// All entries that count, in order of arrival.
    pub entries: Vec<Result<'a>>,
}

/// The ranked teams.
#[derive(Debug, Default)]
pub struct Leaderboard<'a> {
    /// Teams and references, the best first.
    pub standings: Vec<Standing<'a>>,
    /// Scored entries that do not count, with the reason.
    pub excluded: Vec<(&'a EntryInfo, String)>,
}

/// Ranks entries, which are in order of arrival. Each team has the rank of its best entry. A team shares the rank of a
/// better team if the difference of both is below its error. `constant` has the true shears of sets with one shear each.
pub fn rank<'a>(
    entries: &'a [Entry],
    rules: &Rules,
    constant: Option<&ConstantShears>,
) -> Leaderboard<'a> {
    let metric = rules.metric;
    let mut board = Leaderboard::default();
    let mut teams: BTreeMap<(bool, &str), Vec<Result<'a>>> = BTreeMap::new();
    let mut numbers: BTreeMap<&str, usize> = BTreeMap::new();
    for entry in entries {
        let info = &entry.info;
        let (value, error) = metric.of(&entry.sets, constant);
        if info.reference {
            // Each reference has its own line.
            let own = teams.entry((true, info.sha256.as_str())).or_default();
            own.push(Result {
                entry,
                number: 1,
                value,
                error,
            });
            continue;
        }
        let count = numbers.entry(&info.team).or_default();
        if let Some(reason) = excluded(info, *count + 1, rules) {
            board.excluded.push((info, reason));
            continue;
        }
        *count += 1;
        let team = teams.entry((false, info.team.as_str())).or_default();
        team.push(Result {
            entry,
            number: *count,
            value,
            error,
        });
    }
    board.standings = teams
        .into_iter()
        .filter_map(|((reference, _), entries)| {
            // Of equal entries, the first counts.
            let best = entries.iter().reduce(|best, other| {
                match better(metric, other.value, best.value) {
                    true => other,
                    false => best,
                }
            })?;
            Some(Standing {
                rank: (!reference).then_some(0),
                best: best.clone(),
                entries,
            })
        })
        .collect();
    let ahead = |a: &Standing<'_>, b: &Standing<'_>| match metric.larger_is_better() {
        true => b.best.value.total_cmp(&a.best.value),
        false => a.best.value.total_cmp(&b.best.value),
    };
    board.standings.sort_by(ahead);
    let mut leader: Option<(usize, Result<'a>)> = None;
    let mut place = 0;
    for standing in &mut board.standings {
        let Some(rank) = &mut standing.rank else {
            continue;
        };
        place += 1;
        match &leader {
            Some((first, best)) if equal(metric, best, &standing.best) => *rank = *first,
            _ => {
                *rank = place;
                leader = Some((place, standing.best.clone()));
            }
        }
    }
    board
}

/// Why an entry does not count.
fn excluded(info: &EntryInfo, number: usize, rules: &Rules) -> Option<String> {
    let day = day_of(&info.received)?;
    if let Some(opens) = rules.opens.filter(|opens| day < *opens) {
        return Some(format!("received before the first day, {opens}"));
    }
    if let Some(closes) = rules.closes.filter(|closes| day > *closes) {
        return Some(format!("received after the last day, {closes}"));
    }
    let most = rules.entries_per_team?;
    (number > most as usize).then(|| format!("the team has {most} entries already"))
}

pub(crate) fn better(metric: RankBy, a: f64, b: f64) -> bool {
    match metric.larger_is_better() {
        true => a > b,
        false => a < b,
    }
}

/// Whether `other` is behind `best` by less than the error of the difference.
///
/// This error is the smallest of three. The jackknife of the paired difference over the same images is right if both entries
/// respond to the images alike; for an entry with shapes in one of eight images, whose Q was
/// 171.8 ± 20.7, it exceeded the lead of 154 over 17.9 ± 1.7. The quadratic sum of both errors neglects common noise, so it is an upper limit. In that sum, the error of
/// `other` counts at most as much as that of `best`: otherwise an entry with much noise would share every rank.
fn equal(metric: RankBy, best: &Result<'_>, other: &Result<'_>) -> bool {
    let gap = other.value - best.value;
    let apart = best.error.hypot(other.error.min(best.error));
    let paired = metric
        .paired()
        .and_then(|paired| difference(paired, &best.entry.sets, &other.entry.sets))
        .map_or(f64::NAN, |found| found.error);
    // Without a known error, only equal values are equal.
    gap == 0.0 || gap.abs() < paired.min(apart)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use shearq_results::row::SetRecord;
    use shearq_results::submit::manifest::Contents;
    use shearq_scoring::Metrics;

    pub(crate) fn record(set: u32, q: f64, replicates: &[f64]) -> SetRecord {
        let mut metrics = Metrics::unknown();
        metrics.q = q;
        SetRecord {
            set,
            simulated: true,
            data: "d".into(),
            images: (1..=replicates.len() as u32).collect(),
            galaxies: 1,
            flagged: 0,
            metrics,
            errors: Metrics::unknown(),
            q_replicates: replicates.to_vec(),
            q_calibrated_replicates: Vec::new(),
            q_leaderboard: q,
            convention: 5,
            convention_known: true,
            convention_leaderboard: 5,
        }
    }

    fn entry(team: &str, received: &str, q: f64, replicates: &[f64]) -> Entry {
        Entry {
            info: EntryInfo {
                challenge: "c".into(),
                team: team.into(),
                method: "M".into(),
                title: String::new(),
                contact: String::new(),
                received: received.into(),
                sha256: format!("{team}{received}"),
                content: format!("{team}{received}"),
                contents: Contents::Catalogues,
                reference: team.starts_with("our"),
            },
            sets: vec![record(2, q, replicates)],
        }
    }

    fn rules() -> Rules {
        Rules {
            metric: RankBy::Q,
            contents: vec![Contents::Catalogues],
            entries_per_team: Some(2),
            opens: None,
            closes: "2026-11-30".parse().ok(),
        }
    }

    #[test]
    fn the_best_entry_counts_and_small_differences_share_a_rank() {
        let common = |q: f64, own: f64| -> Vec<f64> {
            // Noise of 10 that is common to all entries, and `own` noise.
            let noise = |k: i32| f64::from(k % 2 * 2 - 1);
            let third = |k: i32| f64::from(k % 3 - 1);
            (0..10)
                .map(|k| q + 10.0 * noise(k) + own * third(k))
                .collect()
        };
        let day = "2026-11-24 10:00:00";
        let entries = [
            entry("A", "2026-11-20 10:00:00", 90.0, &common(90.0, 0.0)),
            entry("A", "2026-11-21 10:00:00", 100.0, &common(100.0, 0.0)),
            entry("A", "2026-11-22 10:00:00", 500.0, &common(500.0, 0.0)),
            entry("B", day, 99.9, &common(99.9, 1.0)),
            entry("C", day, 99.0, &common(99.0, 0.0)),
            entry("D", "2026-12-01 00:00:00", 200.0, &common(200.0, 0.0)),
            entry("ours", day, 99.5, &common(99.5, 0.0)),
        ];
        let board = rank(&entries, &rules(), None);
        let found: Vec<(Option<usize>, &str, f64, usize)> = board
            .standings
            .iter()
            .map(|s| {
                (
                    s.rank,
                    s.best.info().team.as_str(),
                    s.best.value,
                    s.entries.len(),
                )
            })
            .collect();
        // The common noise of 10 does not matter; noise of its own makes B equal to A, but not C.
        let expected = [
            (Some(1), "A", 100.0, 2),
            (Some(1), "B", 99.9, 1),
            (None, "ours", 99.5, 1),
            (Some(3), "C", 99.0, 1),
        ];
        assert_eq!(found, expected);
        let reasons: Vec<&str> = board.excluded.iter().map(|e| e.1.as_str()).collect();
        assert_eq!(
            reasons,
            [
                "the team has 2 entries already",
                "received after the last day, 2026-11-30"
            ]
        );
    }

    #[test]
    fn without_errors_values_rank() {
        let entries = [entry("A", "x", 2.0, &[2.0]), entry("B", "x", 1.0, &[1.0])];
        let board = rank(&entries, &rules(), None);
        let ranks: Vec<_> = board.standings.iter().map(|s| s.rank).collect();
        assert_eq!(ranks, [Some(1), Some(2)]);
    }

    #[test]
    fn an_error_of_its_own_does_not_buy_a_rank() {
        // Found with shapes in one image and noise in seven: replicates of 3 to 900.
        let (mut cheat, mut honest) = (
            entry("A", "x", 171.8, &[900.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0]),
            entry(
                "B",
                "x",
                17.9,
                &[18.0, 17.0, 18.0, 17.0, 18.0, 17.0, 18.0, 17.0],
            ),
        );
        (cheat.sets[0].errors.q, honest.sets[0].errors.q) = (20.7, 1.7);
        let ranks = |entries: &[Entry]| -> Vec<Option<usize>> {
            let board = rank(entries, &rules(), None);
            board.standings.iter().map(|s| s.rank).collect()
        };
        assert_eq!(ranks(&[cheat, honest.clone()]), [Some(1), Some(2)]);
        // An entry with much noise does not share the first rank, one within the errors does.
        let mut noisy = entry("C", "x", 10.0, &[10.0]);
        noisy.sets[0].errors.q = 15.0;
        let mut near = entry("D", "x", 16.0, &[16.0]);
        near.sets[0].errors.q = 1.7;
        assert_eq!(ranks(&[honest, noisy, near]), [Some(1), Some(1), Some(3)]);
    }
}
