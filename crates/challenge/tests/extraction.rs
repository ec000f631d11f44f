//! How many entries extract how much of the truth from a leaderboard. docs/run-a-challenge.md quotes the result.

#![allow(clippy::unwrap_used, reason = "a failed test stops at the cause")]

use shearq_pipeline::simulate::simulator;
use shearq_scoring::{Options, SCORED, SetScorer};
use shearq_simulate::field::ShearSpectrum;
use shearq_simulate::set::SimulationSettings;

/// Largest relative error of the true bandpowers that nine entries extract from a leaderboard of one set, if the mean of
/// Q over `sets` sets is published with so many decimals. The attacker changes the spectrum of one set only.
fn extracted(digits: usize, sets: usize) -> f64 {
    let settings = SimulationSettings {
        spectrum: ShearSpectrum::default(),
        ..SimulationSettings::new(3, 100)
    };
    let set = simulator(2, settings).unwrap();
    let scorer = SetScorer::new(set.grid(), set.truth(), Options::default()).unwrap();
    let truth = scorer.true_bandpowers();
    let bins = scorer.bins();
    // A bound that the attacker knows: twice the largest power.
    let high = 2.0 * SCORED.map(|b| truth[b]).fold(0.0, f64::max);
    let sigma_of = |powers: &[f64]| {
        let q = scorer.score_spectrum(powers, None).unwrap().quality.q;
        // The other sets contribute the same number to each mean.
        let others = 100.0 * (sets - 1) as f64;
        let mean = (q + others) / sets as f64;
        let published: f64 = format!("{mean:.digits$}").parse().unwrap();
        5e-3 / (published * sets as f64 - others)
    };
    let base = vec![high; SCORED.len()];
    let sigma = sigma_of(&base);
    let errors = SCORED.enumerate().map(|(k, b)| {
        let mut powers = base.clone();
        powers[k] = 0.0;
        let found = 0.5 * ((sigma_of(&powers) - sigma) / bins.dln_l[b] + high);
        (found / truth[b] - 1.0).abs()
    });
    errors.fold(0.0, f64::max)
}

#[test]
fn decimals_limit_what_nine_entries_extract() {
    let found =
        [(6, 1), (1, 1), (0, 1), (1, 24), (0, 24)].map(|(digits, sets)| extracted(digits, sets));
    println!("{found:?}");
    assert!(found[0] < 1e-6, "{found:?}");
    assert!(
        found[0] < found[1] && found[1] < found[2] && found[2] < found[4],
        "{found:?}"
    );
    assert!(found[1] < found[3], "{found:?}");
}
