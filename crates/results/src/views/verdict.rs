//! Which configuration to use, in one sentence.

use std::borrow::Borrow;

use crate::compare::{Paired, difference};
use crate::row::SetRecord;
use crate::row::mean_metric;
use shearq_render::table::Cell;

/// Significance above which one configuration is better than another.
const CLEAR: f64 = 3.0;
/// Most sets whose noise is listed set by set.
const LISTED: usize = 3;

/// Words of every verdict with metrics.
const NOISE: &str = ", noise per galaxy after calibration ";

/// Takes the verdict out of the notes of a table.
pub fn take_verdict(notes: &mut Vec<String>) -> Option<String> {
    let place = notes.iter().position(|note| note.contains(NOISE))?;
    Some(notes.remove(place))
}

/// Which configuration to use, with the decisive metrics; for a single configuration, its metrics. `None` for a single
/// configuration with an unknown response.
pub fn verdict<R: Borrow<SetRecord>>(configurations: &[(String, Vec<R>)]) -> Option<String> {
    let mean = |sets: &[R], name: &str| mean_metric(sets, name).0;
    let calibrated = |sets: &[R]| mean(sets, "q_calibrated");
    let known = configurations
        .iter()
        .filter(|(_, sets)| !sets.is_empty() && calibrated(sets).is_finite());
    let best = known.max_by(|a, b| calibrated(&a.1).total_cmp(&calibrated(&b.1)));
    let Some((place, (name, sets))) = best.and_then(|best| {
        configurations
            .iter()
            .enumerate()
            .find(|(_, s)| std::ptr::eq(*s, best))
    }) else {
        return (configurations.len() > 1)
            .then(|| "Not enough data to rank the configurations.".into());
    };
    let shown = |sets: &[R], name: &str, decimals: usize| {
        let (value, error) = mean_metric(sets, name);
        Cell::with_error(value, Some(error), decimals).in_words()
    };
    let rivals = || {
        let others = configurations.iter().enumerate();
        others
            .filter(move |(k, _)| *k != place)
            .map(|(_, rival)| rival)
    };
    let behind = |others: &[R]| difference(Paired::Calibrated, others, sets);
    let lower = rivals()
        .filter_map(|(other, others)| {
            let behind = behind(others)?;
            let by = Cell::with_error(behind.difference, Some(behind.error), 1);
            Some((other, by.in_words()))
        })
        .enumerate()
        .map(|(k, (other, by))| match k {
            0 => format!("; {other} is lower by {by}"),
            _ => format!(", {other} by {by}"),
        });
    let lower: String = lower.collect();
    // A configuration without a calibrated Q is not distinguished either.
    let equal: Vec<&str> = rivals()
        .filter(|(_, others)| !behind(others).is_some_and(|d| d.sigma() >= CLEAR))
        .map(|(other, _)| other.as_str())
        .collect();
    let lead = match (configurations.len(), equal.is_empty()) {
        (1, _) => name.clone(),
        (_, true) => format!("Use {name}"),
        (_, false) => format!(
            "{name} has the highest Q calibrated, but these images do not distinguish it from {}",
            equal.join(" and ")
        ),
    };
    // With few images, Q itself can rank otherwise.
    let raised = rivals()
        .filter(|(_, others)| mean(others, "q") > mean(sets, "q") && mean(others, "m_cross") < 0.0)
        .map(|(other, _)| other.as_str())
        .collect::<Vec<_>>();
    let warning = match raised.is_empty() {
        true => String::new(),
        false => format!(
            " Q itself is higher for {}, which lose shear and noise alike (m below zero). Real analyses cannot use this.",
            raised.join(" and ")
        ),
    };
    let noise = match sets.as_slice() {
        [_] => shown(sets, "galaxy_noise", 3),
        few if few.len() <= LISTED => {
            let noise = few.iter().map(|set| {
                let set = set.borrow();
                let noise = Some(set.errors.galaxy_noise);
                let noise = Cell::with_error(set.metrics.galaxy_noise, noise, 3).in_words();
                format!("{noise} in set {}", set.set)
            });
            noise.collect::<Vec<_>>().join(" and ")
        }
        many => format!(
            "{} (mean of {} sets)",
            shown(many, "galaxy_noise", 3),
            many.len()
        ),
    };
    Some(format!(
        "{lead}: m = {}{NOISE}{noise}, and Q calibrated = {}{lower}.{warning}",
        shown(sets, "m_cross", 2),
        shown(sets, "q_calibrated", 1),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_scoring::Metrics;

    /// A configuration with one set of eight images, whose calibrated Q scatters as `replicates`.
    fn configuration(
        name: &str,
        q: f64,
        calibrated: f64,
        replicates: [f64; 8],
    ) -> (String, Vec<SetRecord>) {
        let with = |q, q_calibrated, m_cross| {
            let mut metrics = Metrics::unknown();
            (metrics.q, metrics.q_calibrated, metrics.m_cross) = (q, q_calibrated, m_cross);
            metrics
        };
        let record = SetRecord {
            set: 2,
            simulated: true,
            data: String::new(),
            images: (1..=8).collect(),
            galaxies: 8,
            flagged: 0,
            metrics: with(q, calibrated, -0.3),
            errors: with(0.1, 2.0, 0.01),
            q_replicates: vec![q; 8],
            q_calibrated_replicates: replicates.map(|off| calibrated + off).to_vec(),
            q_leaderboard: q,
            convention: 5,
            convention_known: true,
            convention_leaderboard: 5,
        };
        (name.into(), vec![record])
    }

    #[test]
    fn the_best_configuration_is_named_if_it_is_distinguished() {
        let common = [0.5, -0.5, 0.5, -0.5, 0.5, -0.5, 0.5, -0.5];
        let replicates = [0.7, -0.7, 0.3, -0.3, 0.7, -0.7, 0.3, -0.3];
        let better = configuration("b", 10.0, 25.0, replicates);
        // Common noise cancels: the error of the difference is √(7/8 · Σ 0.2²) = 0.53, although each error is 2.
        let clear = verdict(&[configuration("a", 12.0, 20.0, common), better.clone()]).unwrap();
        assert!(clear.starts_with("Use b: m = -0.300 ± 0.010"), "{clear}");
        assert!(
            clear.contains("Q calibrated = 25.0 ± 2.0; a is lower by 5.00 ± 0.53."),
            "{clear}"
        );
        assert!(
            clear.contains("Q itself is higher for a, which lose shear"),
            "{clear}"
        );
        let tied = verdict(&[configuration("a", 9.0, 24.0, common), better.clone()]).unwrap();
        let start =
            "b has the highest Q calibrated, but these images do not distinguish it from a: m";
        assert!(
            tied.starts_with(start) && !tied.contains("itself"),
            "{tied}"
        );
        let unknown = verdict(&[configuration("a", 9.0, f64::NAN, common), better]).unwrap();
        assert!(
            unknown.contains("do not distinguish it from a"),
            "{unknown}"
        );
        let mut notes = vec!["first".to_owned(), clear.clone(), "last".to_owned()];
        assert_eq!(take_verdict(&mut notes), Some(clear));
        assert_eq!(notes, ["first", "last"]);
        let blank = || configuration("a", 9.0, f64::NAN, common);
        let none = verdict(&[blank(), blank()]).unwrap();
        assert_eq!(none, "Not enough data to rank the configurations.");
        assert_eq!(verdict(&[blank()]), None);
        let alone = verdict(&[configuration("a", 9.0, 24.0, common)]).unwrap();
        assert!(alone.starts_with("a: m = -0.300 ± 0.010, noise"), "{alone}");
    }
}
