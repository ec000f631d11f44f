//! The board of a challenge: ranks, and what the organiser decides about entries.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Deserialize;
use shearq_files::FileError;
use shearq_results::compare::difference;

use crate::entry::{Entry, EntryInfo, team_key};
use crate::kind::{ConstantShears, Noise, Published, RankBy};
use crate::seal::{BOARD_FILE, Key, read_toml};
use crate::terms::{Challenge, Deadline};

#[derive(Debug, Clone)]
pub struct Scored<'a> {
    pub entry: &'a Entry,
    /// Number of the entry of its team, from 1.
    pub number: usize,
    pub value: f64,
    pub error: f64,
    /// The value as boards print it.
    pub published: Published,
}

impl Scored<'_> {
    pub fn info(&self) -> &EntryInfo {
        &self.entry.info
    }
}

#[derive(Debug, Clone)]
pub struct Standing<'a> {
    pub board: Board,
    /// Rank of a team, from 1. References and partial entries have none.
    pub rank: Option<usize>,
    pub best: Scored<'a>,
    /// Whether others have the rank as well.
    pub shared: bool,
    /// Another team or reference whose best entry has the same content, in words.
    pub same_as: Option<String>,
    /// All entries that count, in order of arrival.
    pub entries: Vec<Scored<'a>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Board {
    /// Entries in time that cover all sets, and references.
    Main,
    /// Entries of scenes whose |m| is above the limit of the challenge. They have no rank, because a cut or a weight that biases m
    /// may lower the shear error.
    Biased,
    /// Entries after the deadline. The truth may have become known.
    Late,
    /// Entries of some sets. They have no rank, because some sets are easier than others and means over them do not compare.
    Partial,
}

impl Board {
    /// In the order of the page.
    pub const ALL: [Board; 4] = [Board::Main, Board::Biased, Board::Late, Board::Partial];
}

#[derive(Debug, Default)]
pub struct Leaderboard<'a> {
    /// Teams and references, the best first, board by board.
    pub standings: Vec<Standing<'a>>,
    /// Scored entries that do not count, with the reason.
    pub excluded: Vec<(&'a EntryInfo, String)>,
}

impl<'a> Leaderboard<'a> {
    pub fn of(&self, board: Board) -> impl Iterator<Item = &Standing<'a>> {
        let own = move |standing: &&Standing<'a>| standing.board == board;
        self.standings.iter().filter(own)
    }
}

// The entries of each team by board. References, each a team by its hash, have no rank.
type Teams<'a> = BTreeMap<(Board, bool, &'a str), Vec<Scored<'a>>>;

/// Why an entry that was compared with the true shear has no rank, in the words for its team: what the comparison showed depends
/// on the truth.
pub const UNSCORED: &str = "no score after the comparison with the true shear. Try: shearq challenge check, and the signs and components of a simulation with known shear";

/// Ranks entries, which are in order of arrival. On each board, a team has the rank of its best entry. A team shares the
/// rank of a better team if the difference of both is below its error, or if both values are printed alike. `constant` has the
/// true shears of sets with one shear each, `noise` the errors of a measurement with the noise of the images.
pub fn rank<'a>(
    entries: &'a [Entry],
    challenge: &Challenge,
    constant: Option<&ConstantShears>,
    noise: &Noise,
) -> Leaderboard<'a> {
    let rules = &challenge.rules;
    let metric = rules.metric;
    let mut leaderboard = Leaderboard::default();
    let mut teams = Teams::new();
    // Contents by team.
    let mut compared: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for entry in entries {
        let info = &entry.info;
        let (value, error) = entry.value(metric, constant);
        let mut result = Scored {
            entry,
            number: 1,
            value,
            error,
            published: entry.published(metric, constant, noise),
        };
        if info.reference && info.scored && entry.withdrawn.is_none() {
            // Each reference has a line.
            let own = teams.entry((Board::Main, true, info.sha256.as_str()));
            own.or_default().push(result);
            continue;
        }
        let own = compared.entry(&info.team).or_default();
        let is_new = own.insert(&info.content);
        // Entries that are withdrawn, late or without a score count towards the limit, which protects the truth.
        result.number = own.len();
        let most = rules
            .entries_per_team
            .filter(|most| result.number > *most as usize);
        let reason = match (&entry.withdrawn, most) {
            _ if !is_new => "identical content as an earlier entry of the team".into(),
            (Some(reason), _) => format!("withdrawn: {reason}"),
            (None, Some(most)) => format!("the team has {most} entries already"),
            (None, None) if !info.scored => UNSCORED.into(),
            (None, None) => {
                let late = |closes: &Deadline| info.received > closes.last;
                let max_m = rules.max_m.unwrap_or(f64::INFINITY);
                let board = match rules.closes.as_ref().is_some_and(late) {
                    _ if info.scenes.is_some_and(|own| own.is_biased(max_m)) => Board::Biased,
                    _ if info.scenes.is_none() && entry.sets.len() < challenge.data.sets.len() => {
                        Board::Partial
                    }
                    true => Board::Late,
                    false => Board::Main,
                };
                let team = teams.entry((board, false, info.team.as_str()));
                team.or_default().push(result);
                continue;
            }
        };
        leaderboard.excluded.push((info, reason));
    }
    leaderboard.standings = standings(teams, metric);
    leaderboard
}

// The standings of the teams by board, the best first.
fn standings<'a>(teams: Teams<'a>, metric: RankBy) -> Vec<Standing<'a>> {
    let standing = |((board, reference, _), entries): ((Board, bool, &str), Vec<Scored<'a>>)| {
        // Of equal entries, the first counts.
        let best =
            entries.iter().reduce(
                |best, other| match better(metric, other.value, best.value) {
                    true => other,
                    false => best,
                },
            )?;
        Some(Standing {
            board,
            rank: (!reference && matches!(board, Board::Main | Board::Late)).then_some(0),
            best: best.clone(),
            shared: false,
            same_as: None,
            entries,
        })
    };
    let mut standings: Vec<Standing<'a>> = teams.into_iter().filter_map(standing).collect();
    // Of equal printed values the entry with the earlier receipt leads. Without receipts, times are those of the first `rank`,
    // and the names of the teams decide who is printed first.
    let arrival = |of: &Standing<'_>| {
        let info = of.best.info();
        (
            !info.receipt,
            info.receipt.then_some(info.received),
            info.team.clone(),
        )
    };
    let ahead = |a: &Standing<'_>, b: &Standing<'_>| {
        let by = |of: fn(Published, f64) -> f64| {
            let sign = if metric.larger_is_better() { 1.0 } else { -1.0 };
            let [of_a, of_b] = [a, b].map(|standing| sign * of(standing.best.published, sign));
            of_b.total_cmp(&of_a)
        };
        // At the worse end of its error: otherwise an entry leads whose large error rounds it up.
        let by_worse_end = by(|Published { value, step, .. }, sign| value - sign * step);
        let by_value = by(|Published { value, .. }, _| value);
        let by_arrival = || arrival(a).cmp(&arrival(b));
        let order = a.board.cmp(&b.board).then(by_worse_end);
        order.then(by_value).then_with(by_arrival)
    };
    standings.sort_by(ahead);
    for of_board in standings.chunk_by_mut(|a, b| a.board == b.board) {
        number(of_board, metric);
        for (standing, same) in same_entries(of_board) {
            of_board[standing].same_as = Some(same);
        }
    }
    standings
}

// Standings with the content of another one, and the words for it. Methods and images determine an entry, so that nobody needs to
// have copied it.
fn same_entries(standings: &[Standing<'_>]) -> Vec<(usize, String)> {
    let mut same = Vec::new();
    for (k, own) in standings.iter().enumerate() {
        let info = own.best.info();
        let mut others = standings
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != k);
        let Some((_, other)) = others.find(|(_, other)| other.best.info().content == info.content)
        else {
            continue;
        };
        let other = other.best.info();
        let first = match info.receipt && other.receipt && other.received < info.received {
            true => ", which has the earlier receipt",
            false => "",
        };
        let by = match &info.configuration {
            Some(name) if other.configuration.as_ref() == Some(name) => {
                format!(", both by shearq's configuration {name}")
            }
            _ => String::new(),
        };
        same.push((k, format!("same entry as {}{first}{by}", other.team)));
    }
    same
}

// Ranks the standings of a board, which are in order of their values.
fn number(standings: &mut [Standing<'_>], metric: RankBy) {
    let mut leader: Option<(usize, Scored<'_>)> = None;
    let mut printed = None;
    let mut place = 0;
    for standing in standings.iter_mut() {
        let Some(rank) = &mut standing.rank else {
            continue;
        };
        place += 1;
        let own = Some(standing.best.published.value);
        match &leader {
            Some((first, best)) if own == printed || equal(metric, best, &standing.best) => {
                *rank = *first;
            }
            _ => {
                *rank = place;
                leader = Some((place, standing.best.clone()));
            }
        }
        printed = own;
    }
    let ranks: Vec<usize> = standings
        .iter()
        .filter_map(|standing| standing.rank)
        .collect();
    for standing in standings {
        let own = ranks.iter().filter(|rank| Some(**rank) == standing.rank);
        standing.shared = own.count() > 1;
    }
}

pub(crate) fn better(metric: RankBy, a: f64, b: f64) -> bool {
    match metric.larger_is_better() {
        true => a > b,
        false => a < b,
    }
}

// Whether `other` is behind `best` by less than the error of the difference.
//
// This error is the smaller of two. The jackknife of the paired difference over the same images is right if both entries
// respond to the images alike; for an entry with shapes in one of eight images, whose Q was
// 171.8 ± 20.7, it exceeded the lead of 154 over 17.9 ± 1.7. The quadratic sum of both errors neglects common noise, so it is an upper limit. In that sum, the error of
// `other` is limited to the error of `best`: otherwise an entry with much noise would share every rank.
fn equal(metric: RankBy, best: &Scored<'_>, other: &Scored<'_>) -> bool {
    let gap = other.value - best.value;
    let apart = best.error.hypot(other.error.min(best.error));
    let paired = metric
        .paired()
        .and_then(|paired| difference(paired, &best.entry.sets, &other.entry.sets))
        .map_or(f64::NAN, |found| found.error);
    // Without a known error, only equal values are equal.
    gap == 0.0 || gap.abs() < paired.min(apart)
}

// Fewest digits of an SHA-256 that name an entry.
const MIN_DIGITS: usize = 8;

#[derive(Debug, Clone, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Decisions {
    /// Whether teams without an alias have drawn names, and methods, titles and refused entries are not published.
    pub anonymous: bool,
    pub aliases: BTreeMap<String, String>,
    /// Reasons, by the first digits of the SHA-256 of the archive, or `DIGITS/TEAM` if several teams sent it.
    pub withdrawn: BTreeMap<String, String>,
}

impl Decisions {
    /// Reads the decisions in a private folder; without a file, nothing is decided.
    pub fn read(private: &Path) -> Result<Self, FileError> {
        let decisions = read_toml(&private.join(BOARD_FILE), "decisions")?;
        Ok(decisions.unwrap_or_default())
    }

    /// Marks withdrawn entries and replaces the names of teams.
    pub fn apply(&self, entries: &mut [Entry], key: &Key) -> Result<(), String> {
        for (id, reason) in &self.withdrawn {
            // Two teams may have sent the same archive.
            let (digits, team) = match id.split_once('/') {
                Some((digits, team)) => (digits, Some(team)),
                None => (id.as_str(), None),
            };
            let names = |entry: &Entry| {
                digits.len() >= MIN_DIGITS
                    && entry.info.sha256.starts_with(digits)
                    && team.is_none_or(|team| team_key(&entry.info.team) == team_key(team))
            };
            let named: Vec<usize> = (0..entries.len()).filter(|k| names(&entries[*k])).collect();
            let [entry] = named.as_slice() else {
                let known: Vec<String> = entries
                    .iter()
                    .map(|entry| {
                        let info = &entry.info;
                        format!("{} ({}, {})", info.short_id(), info.team, info.file)
                    })
                    .collect();
                return Err(format!(
                    "`withdrawn` names no single entry (found `{id}`, expected {MIN_DIGITS} digits or more of an SHA-256: {})",
                    known.join(", ")
                ));
            };
            entries[*entry].withdrawn = Some(reason.clone());
        }
        let teams: BTreeSet<String> = entries
            .iter()
            .filter(|entry| !entry.info.reference)
            .map(|entry| entry.info.team.clone())
            .collect();
        let aliases: BTreeMap<String, &String> = self
            .aliases
            .iter()
            .map(|(team, alias)| (team_key(team), alias))
            .collect();
        let keys: BTreeSet<String> = teams.iter().map(|team| team_key(team)).collect();
        let mut named = self.aliases.keys();
        if let Some(unknown) = named.find(|team| !keys.contains(&team_key(team))) {
            let known: Vec<&str> = teams.iter().map(String::as_str).collect();
            return Err(format!(
                "`aliases` has an unknown team (found `{unknown}`, expected one of {})",
                known.join(", ")
            ));
        }
        let mut names: BTreeMap<String, String> = BTreeMap::new();
        for team in &teams {
            let name = match (aliases.get(&team_key(team)), self.anonymous) {
                (Some(alias), _) => (*alias).clone(),
                // The name depends neither on the order of arrival nor on the rank, and is the same on every board.
                (None, true) => format!("team {}", &key.sign("team", &[team])[..6]),
                (None, false) => team.clone(),
            };
            if let Some((other, _)) = names.iter().find(|(_, own)| **own == name) {
                return Err(format!("`{name}` stands for two teams: {other} and {team}"));
            }
            names.insert(team.clone(), name);
        }
        for Entry { info, .. } in entries.iter_mut().filter(|entry| !entry.info.reference) {
            info.team = names[&info.team].clone();
            if self.anonymous {
                info.method.clear();
                info.title.clear();
                info.configuration = None;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::kind::Kind;
    use crate::terms::{Data, Rules};
    use shearq_results::record::SetRecord;
    use shearq_results::submit::Contents;

    pub(crate) fn record(set: u32, q: f64, replicates: &[f64]) -> SetRecord {
        let mut record = SetRecord::unknown(set);
        record.images = (1..=replicates.len() as u32).collect();
        (record.metrics.q, record.q_replicates) = (q, replicates.to_vec());
        record
    }

    const DAY: &str = "2026-11-24";

    // An entry of a day, at ten o'clock, or of a moment.
    fn entry(team: &str, received: &str, q: f64, replicates: &[f64]) -> Entry {
        let received = match received.contains('T') {
            true => received.to_owned(),
            false => format!("{received}T10:00:00Z"),
        };
        Entry {
            info: EntryInfo {
                challenge: "c".into(),
                team: team.into(),
                method: "M".into(),
                title: String::new(),
                contact: String::new(),
                received: received.parse().unwrap(),
                receipt: false,
                file: String::new(),
                sha256: format!("{team}{received}"),
                content: format!("{team}{received}"),
                contents: Contents::Catalogues,
                configuration: None,
                reference: team.starts_with("our"),
                scored: true,
                findings: Vec::new(),
                scenes: None,
            },
            sets: vec![record(2, q, replicates)],
            withdrawn: None,
        }
    }

    // A challenge of one set, with two entries per team until the last second of a day.
    fn challenge() -> Challenge {
        Challenge {
            name: "c".into(),
            version: 1,
            kind: Kind::Great10,
            contact: String::new(),
            address: String::new(),
            seal: String::new(),
            data: Data {
                sets: vec![2],
                images: 10,
                grid: 8,
                stamp: 48,
                field_degrees: 10.0,
                scene: None,
            },
            conventions: BTreeMap::new(),
            rules: Rules {
                metric: RankBy::Q,
                contents: vec![Contents::Catalogues],
                entries_per_team: Some(2),
                opens: None,
                closes: "2026-11-30".parse().ok(),
                partial: true,
                max_m: None,
            },
        }
    }

    // Entries with one image.
    fn entries<const N: usize>(of: [(&str, &str, f64); N]) -> [Entry; N] {
        of.map(|(team, received, q)| entry(team, received, q, &[q]))
    }

    // Board, rank, team and value of each standing.
    fn found<'a>(board: &'a Leaderboard<'_>) -> Vec<(Board, Option<usize>, &'a str, f64)> {
        let of = |s: &'a Standing<'_>| (s.board, s.rank, s.best.info().team.as_str(), s.best.value);
        board.standings.iter().map(of).collect()
    }

    // Values are published to two digits.
    const NOISE: Noise = Noise {
        response: 0.005,
        c: 0.0,
    };

    fn ranks(entries: &[Entry]) -> Vec<Option<usize>> {
        let challenge = challenge();
        let board = rank(entries, &challenge, None, &NOISE);
        board.standings.iter().map(|s| s.rank).collect()
    }

    fn reasons<'a>(board: &'a Leaderboard<'_>) -> Vec<&'a str> {
        board
            .excluded
            .iter()
            .map(|(_, reason)| reason.as_str())
            .collect()
    }

    #[test]
    fn the_best_entry_counts_and_small_differences_share_a_rank() {
        // Noise of 10 that is common to all entries, and `own` noise.
        let with = |team, received, q: f64, own: f64| {
            let [common, apart] = [2, 3].map(|n| move |k: i32| f64::from(k % n));
            let image = |k| q + 10.0 * (2.0 * common(k) - 1.0) + own * (apart(k) - 1.0);
            entry(team, received, q, &(0..10).map(image).collect::<Vec<_>>())
        };
        let entries = [
            with("A", "2026-11-20", 90.0, 0.0),
            with("A", "2026-11-21", 100.0, 0.0),
            with("A", "2026-11-22", 500.0, 0.0),
            with("B", DAY, 99.9, 1.0),
            with("C", DAY, 99.0, 0.0),
            with("D", "2026-12-01T00:00:00Z", 200.0, 0.0),
            with("ours", DAY, 99.5, 0.0),
        ];
        let challenge = challenge();
        let board = rank(&entries, &challenge, None, &NOISE);
        // The common noise of 10 does not matter; noise of its own makes B equal to A, but not C.
        let expected = [
            (Board::Main, Some(1), "A", 100.0),
            (Board::Main, Some(1), "B", 99.9),
            (Board::Main, None, "ours", 99.5),
            (Board::Main, Some(3), "C", 99.0),
            (Board::Late, Some(1), "D", 200.0),
        ];
        assert_eq!(found(&board), expected);
        assert_eq!(board.standings[0].entries.len(), 2);
        assert_eq!(reasons(&board), ["the team has 2 entries already"]);
    }

    #[test]
    fn equal_worse_ends_are_ordered_by_value() {
        // Published as 9 ± 1 and 10 ± 2.
        let entries = [("A", 9.2, 0.9), ("B", 10.9, 1.1)].map(|(team, q, error)| {
            let mut entry = entry(team, DAY, q, &[q - 0.1, q + 0.1, q - 0.1, q + 0.1]);
            entry.sets[0].errors.q = error;
            entry
        });
        let challenge = challenge();
        let board = rank(&entries, &challenge, None, &NOISE);
        let expected = [
            (Board::Main, Some(1), "B", 10.9),
            (Board::Main, Some(2), "A", 9.2),
        ];
        assert_eq!(found(&board), expected);
    }

    #[test]
    fn an_error_of_its_own_does_not_buy_a_rank() {
        let with = |team, q, replicates: &[f64], error| {
            let mut entry = entry(team, DAY, q, replicates);
            entry.sets[0].errors.q = error;
            entry
        };
        // Found with shapes in one image and noise in seven: replicates of 3 to 900.
        let cheat = with(
            "A",
            171.8,
            &[900.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0],
            20.7,
        );
        let pairs = [18.0, 17.0, 18.0, 17.0, 18.0, 17.0, 18.0, 17.0];
        let honest = with("B", 17.9, &pairs, 1.7);
        assert_eq!(ranks(&[cheat, honest.clone()]), [Some(1), Some(2)]);
        // An entry with much noise does not share the first rank, one within the errors does.
        let noisy = with("C", 10.0, &[10.0], 15.0);
        let near = with("D", 16.0, &[16.0], 1.7);
        assert_eq!(ranks(&[honest, noisy, near]), [Some(1), Some(1), Some(3)]);
    }

    #[test]
    fn without_errors_printed_values_rank() {
        let of = [
            ("A", DAY, 2.04),
            ("B", DAY, 2.03),
            ("C", DAY, 1.91),
            ("D", DAY, 1.915),
        ];
        assert_eq!(ranks(&entries(of)), [1, 1, 3, 3].map(Some));
    }

    #[test]
    fn deadlines_hold_to_the_second_and_in_far_years() {
        let entries = entries([
            ("in time", "2026-11-30T23:59:59Z", 3.0),
            ("late", "2026-12-01T00:00:00Z", 4.0),
            ("far", "9999-12-30T00:00:00Z", 5.0),
        ]);
        let challenge = challenge();
        let board = rank(&entries, &challenge, None, &NOISE);
        let expected = [
            (Board::Main, Some(1), "in time", 3.0),
            (Board::Late, Some(1), "far", 5.0),
            (Board::Late, Some(2), "late", 4.0),
        ];
        assert_eq!(found(&board), expected);
    }

    #[test]
    fn identical_content_shares_a_rank() {
        let mut entries = entries([
            ("Withdrawn", "2026-11-20", 3.0),
            ("Owner", "2026-11-21", 3.0),
            ("Other", "2026-11-22", 3.0),
            ("Owner", "2026-11-23", 3.0),
        ]);
        for entry in &mut entries {
            entry.info.content = "same".into();
            entry.info.configuration = Some("48/linear/star".into());
        }
        entries[0].withdrawn = Some("a mistake".into());
        let challenge = challenge();
        let same = |entries: &[Entry]| -> Vec<String> {
            let board = rank(entries, &challenge, None, &NOISE);
            let reasons = reasons(&board);
            let own = "identical content as an earlier entry of the team";
            assert_eq!(reasons, ["withdrawn: a mistake", own]);
            let of = |s: &Standing<'_>| {
                assert_eq!((s.rank, s.shared), (Some(1), true));
                format!("{}: {}", s.best.info().team, s.same_as.clone().unwrap())
            };
            board.standings.iter().map(of).collect()
        };
        let by = ", both by shearq's configuration 48/linear/star";
        // Without receipts the name decides who is printed first, and not the time of `rank`.
        let other = format!("Other: same entry as Owner{by}");
        let owner = format!("Owner: same entry as Other{by}");
        assert_eq!(same(&entries), [other.clone(), owner.clone()]);
        for entry in &mut entries {
            entry.info.receipt = true;
        }
        let later = format!("Other: same entry as Owner, which has the earlier receipt{by}");
        assert_eq!(same(&entries), [owner, later]);
    }

    #[test]
    fn entries_without_a_score_count_towards_the_limit() {
        let mut entries = entries([
            ("A", "2026-11-20", 3.0),
            ("A", "2026-11-21", 2.0),
            ("A", "2026-11-22", 9.0),
        ]);
        for entry in &mut entries[..2] {
            entry.info.scored = false;
            entry.info.findings = vec!["secret".into()];
        }
        let challenge = challenge();
        let board = rank(&entries, &challenge, None, &NOISE);
        assert!(board.standings.is_empty());
        let limit = "the team has 2 entries already";
        assert_eq!(reasons(&board), [UNSCORED, UNSCORED, limit]);
    }

    #[test]
    fn partial_entries_have_no_rank_and_withdrawn_ones_count() {
        let mut entries = entries([
            ("A", "2026-11-20", 3.0),
            ("A", "2026-11-21", 2.0),
            ("A", "2026-11-22", 9.0),
            ("B", "2026-11-23", 1.0),
            ("C", "2026-11-24", 8.0),
        ]);
        let mut challenge = challenge();
        challenge.data.sets = vec![2, 3];
        for entry in &mut entries[..4] {
            let mut more = entry.sets[0].clone();
            more.set = 3;
            entry.sets.push(more);
        }
        entries[0].withdrawn = Some("a mistake".into());
        let board = rank(&entries, &challenge, None, &NOISE);
        let expected = [
            (Board::Main, Some(1), "A", 2.0),
            (Board::Main, Some(2), "B", 1.0),
            (Board::Partial, None, "C", 8.0),
        ];
        assert_eq!(found(&board), expected);
        let reasons = reasons(&board);
        assert_eq!(
            reasons,
            ["withdrawn: a mistake", "the team has 2 entries already"]
        );
    }
}
