//! Ranks the entries of a challenge.

use std::collections::BTreeMap;

use shearq_results::compare::difference;

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
/// better team if the difference of both is below its error.
pub fn rank<'a>(entries: &'a [Entry], rules: &Rules) -> Leaderboard<'a> {
    let metric = rules.metric;
    let mut board = Leaderboard::default();
    let mut teams: BTreeMap<(bool, &str), Vec<Result<'a>>> = BTreeMap::new();
    let mut numbers: BTreeMap<&str, usize> = BTreeMap::new();
    for entry in entries {
        let info = &entry.info;
        let (value, error) = metric.of(&entry.sets);
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

fn better(metric: RankBy, a: f64, b: f64) -> bool {
    match metric.larger_is_better() {
        true => a > b,
        false => a < b,
    }
}

/// Whether the difference of two entries is below its error. The error is of the paired difference over the same images;
/// otherwise the errors of both are added in quadrature, which neglects common noise.
fn equal(metric: RankBy, a: &Result<'_>, b: &Result<'_>) -> bool {
    let paired = metric
        .paired()
        .and_then(|paired| difference(paired, &a.entry.sets, &b.entry.sets))
        .filter(|difference| difference.error.is_finite());
    let (gap, error) = match paired {
        Some(found) => (found.difference, found.error),
        None => (a.value - b.value, a.error.hypot(b.error)),
    };
    // Without a known error, only equal values are equal.
    gap == 0.0 || gap.abs() < error
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_results::row::SetRecord;
    use shearq_results::submit::manifest::Contents;
    use shearq_scoring::Metrics;

    fn entry(team: &str, received: &str, q: f64, replicates: &[f64]) -> Entry {
        let mut metrics = Metrics::unknown();
        metrics.q = q;
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
            sets: vec![SetRecord {
                set: 2,
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
            }],
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
        let board = rank(&entries, &rules());
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
        let board = rank(&entries, &rules());
        let ranks: Vec<_> = board.standings.iter().map(|s| s.rank).collect();
        assert_eq!(ranks, [Some(1), Some(2)]);
    }
}
