//! Scores as tables and as JSON.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};
use shearq_dataset::truth::Sign;
use shearq_render::table::{Cell, Heading, Table};
use shearq_scoring::{
    BINS, Bias, BiasFits, ConventionClass, ConventionScore, Definition, Fault, Metrics, SetScore,
};

use crate::record::{SetRecord, definition_word, mean, metric_cell};
use crate::score::{Basis, ScoredSet};
use crate::views::{diagnosis, spectrum};

fn kind_cell(record: &SetRecord) -> Cell {
    Cell::text(record.kind().map_or("", |kind| kind.image.label()))
}

fn kinds_note(records: &[SetRecord]) -> &'static str {
    match records.iter().any(|record| record.kind().is_some()) {
        true => " Kinds: as the GREAT10 sets with these numbers.",
        false => "",
    }
}

pub(super) fn definition_note(definition: Definition) -> String {
    let definition = match definition {
        Definition::Leaderboard => "leaderboard definition (the arithmetic of the challenge)",
        Definition::Corrected => "corrected definition (azimuthal averages, fixed bins)",
    };
    format!(
        "Metrics: {definition}. Errors: from the part that the truth does not explain, at fixed truth. √A in 10⁻⁴ for C_ℓ in steradian; its significance is twice the significance of A. Its error is blank if A is less than 2σ from zero."
    )
}

pub fn convention_note(scored: &[ScoredSet]) -> String {
    let Some(first) = scored.first() else {
        return String::new();
    };
    let chosen = first.score.chosen;
    let name = format!("{} ({})", chosen.number(), chosen.describe());
    let constant = scored.iter().all(|set| set.score.constant.is_some());
    match first.basis {
        Basis::Given => format!("Convention {name}."),
        Basis::HighestQ => "Convention: the highest Q of each set, as on the leaderboard.".into(),
        Basis::Matched(_) if constant => {
            format!("Convention {name}; a constant shear does not determine it.")
        }
        Basis::Matched(matching) if matching.is_clear() => format!(
            "Convention {name}, matched to the truth of all sets together (correlation {:.2}).",
            matching.correlation(chosen)
        ),
        Basis::Matched(matching) => format!(
            "warning: cannot determine the sign and axis convention: convention {} correlates best ({:.2}), but not by the required {:.2}. Scored in convention {name}; differences from other configurations are not significant. Try: --convention N.",
            matching.best().number(),
            matching.correlation(matching.best()),
            matching.least_clear()
        ),
    }
}

/// Notes on scores: the convention, sets whose leaderboard Q has another convention, and probable faults of truth and
/// catalogues.
pub fn notes(scored: &[ScoredSet]) -> Vec<String> {
    let mut lines = vec![convention_note(scored)];
    let mut signs: Vec<String> = scored
        .iter()
        .filter_map(|s| s.sign.and_then(Sign::line))
        .collect();
    signs.dedup();
    lines.extend(signs);
    for own in scored {
        let (set, score) = (own.number(), &own.score);
        let odd = diagnosis::odd_images(&own.odd_images).into_iter();
        lines.extend(odd.map(|odd| format!("{}{odd}.", diagnosis::prefix(set))));
        let name = set.map_or_else(|| "this set".to_owned(), |set| format!("set {set}"));
        if let Some(mean) = &score.constant {
            lines.push(format!(
                "note: the true shear of {name} is constant ({}, {}) and has no power to compare; mean e = ({:.5} ± {:.5}, {:.5} ± {:.5}).",
                mean.truth[0], mean.truth[1], mean.e[0], mean.error[0], mean.e[1], mean.error[1]
            ));
        } else if score.wrong_convention_wins() {
            let [best, chosen] = [score.best, score.chosen].map(|k| {
                let q = score.conventions[k.index()].quality.q;
                format!(
                    "convention {} ({}) with Q = {q:.2}",
                    k.number(),
                    k.describe()
                )
            });
            lines.push(format!(
                "warning: {name}: the leaderboard uses {best}, these metrics {chosen}."
            ));
        }
        if score.constant.is_none() && score.true_b_share() > 0.2 {
            lines.push(format!(
                "warning: {:.0} % of the true power of {name} is in B modes; g2 may have the other sign. Try: --truth-sign.",
                100.0 * score.true_b_share()
            ));
        }
        lines.extend(diagnosis::oddities(&own.rows, &name));
    }
    lines.extend(diagnosis::of_sets(
        scored.iter().map(|set| (set.number(), believable(set))),
    ));
    lines.extend(zero_shear_note(scored));
    let blank = |set: &&ScoredSet| {
        set.score.constant.is_none() && set.rows.used > 0 && set.score.metrics.q_calibrated.is_nan()
    };
    let blank: Vec<String> = scored
        .iter()
        .filter(blank)
        .filter_map(|set| Some(set.number()?.to_string()))
        .collect();
    if !blank.is_empty() {
        lines.push(format!(
            "note: no Q cal. and noise for set {}, because the response is less than 3σ from zero. More galaxies reduce its error.",
            blank.join(", ")
        ));
    }
    lines
}

// Q of zero shear, which is above that of a measurement while noise dominates.
pub(super) fn zero_shear_note(scored: &[ScoredSet]) -> Option<String> {
    let varying = || scored.iter().filter(|set| set.score.constant.is_none());
    let count = varying().count() as f64;
    let mean = |q: fn(&SetScore) -> f64| varying().map(|set| q(&set.score)).sum::<f64>() / count;
    zero_shear_line(
        mean(|score| score.zero_quality().q),
        mean(|score| score.metrics.q),
    )
}

fn zero_shear_line(zero: f64, own: f64) -> Option<String> {
    let verdict = match zero > own {
        true => ", above this Q: noise dominates Q. Compare Q cal., m and noise",
        false => "",
    };
    zero.is_finite()
        .then(|| format!("note: without any image, zero shear has Q = {zero:.2}{verdict}."))
}

// Findings of a set that odd images do not explain. Copies appear to have no noise, and constant ellipticities no
// response.
fn believable(set: &ScoredSet) -> &[Fault] {
    let odd = &set.odd_images;
    match set.findings.as_slice() {
        [Fault::Uncorrelated { .. }] if !odd.copies.is_empty() => &[],
        [Fault::Biased { .. }] if !odd.constant.is_empty() => &[],
        all => all,
    }
}

fn set_cell(record: &SetRecord) -> Cell {
    match record.set {
        0 => Cell::text("–"),
        set => Cell::text(format!("{set:02}")),
    }
}

/// Metrics per set, with a row of means for several sets.
pub fn per_set(scored: &[ScoredSet], title: &str, definition: Definition) -> Table {
    if scored.iter().all(|set| set.score.constant.is_some()) {
        return constant_shear(scored, title);
    }
    let records: Vec<SetRecord> = scored.iter().map(|set| set.record.clone()).collect();
    let mut headings = vec![
        Heading::new("set", "Set"),
        Heading::new("kind", "Kind"),
        Heading::new("images", "Images").detail(),
    ];
    let metrics = Metrics::ALL.iter();
    headings.extend(metrics.map(|metric| Heading {
        detail: metric.detail,
        ..Heading::new(metric.name, metric.heading)
    }));
    headings.push(Heading::new("convention", "Conv.").detail());
    let apart = records
        .iter()
        .any(|set| best_is_another(set.q_leaderboard, set.metrics.q));
    headings.push(Heading {
        detail: !apart,
        ..Heading::new("q_leaderboard", "Q leaderboard")
    });
    let row = |names: [Cell; 2], sets: &[SetRecord], convention: Cell| {
        let images: usize = sets.iter().map(|set| set.images.len()).sum();
        let best: f64 = sets.iter().map(|set| set.q_leaderboard).sum();
        let mut row = names.to_vec();
        row.push(Cell::number(images as f64, 0));
        row.extend(Metrics::ALL.map(|metric| metric_cell(metric, sets)));
        row.push(convention);
        row.push(Cell::number(best / sets.len() as f64, 2));
        row
    };
    let mut rows: Vec<Vec<Cell>> = records
        .iter()
        .map(|record| {
            let names = [set_cell(record), kind_cell(record)];
            let convention = Cell::text(record.convention.to_string());
            row(names, std::slice::from_ref(record), convention)
        })
        .collect();
    if records.len() > 1 {
        let names = [Cell::text("mean"), Cell::Empty];
        rows.push(row(names, &records, Cell::Empty));
    }
    let counts: BTreeSet<usize> = scored.iter().map(|set| set.score.images).collect();
    let counts: Vec<String> = counts.iter().map(usize::to_string).collect();
    let mut lines = vec![
        format!(
            "Images per set: {}.{}",
            counts.join(", "),
            kinds_note(&records)
        ),
        definition_note(definition),
    ];
    lines.extend(notes(scored));
    Table {
        title: title.to_owned(),
        headings,
        rows,
        notes: lines,
    }
}

// Whether the leaderboard's Q has another class of conventions than the metrics. Within a class Q differs by
// rounding only, at most 1e-7.
pub(super) fn best_is_another(q_leaderboard: f64, q: f64) -> bool {
    (q_leaderboard / q - 1.0).abs() > 1e-6
}

fn constant_shear(scored: &[ScoredSet], title: &str) -> Table {
    let headings = [
        ("set", "Set"),
        ("images", "Images"),
        ("e1", "mean e1"),
        ("e2", "mean e2"),
        ("g1", "true g1"),
        ("g2", "true g2"),
        ("c1", "c1"),
        ("c2", "c2"),
    ];
    let rows = scored.iter().filter_map(|scored| {
        let score = &scored.score;
        let mean = score.constant?;
        let shear = |value, error| Cell::with_error(value, Some(error), 5);
        Some(vec![
            set_cell(&scored.record),
            Cell::number(score.images as f64, 0),
            shear(mean.e[0], mean.error[0]),
            shear(mean.e[1], mean.error[1]),
            Cell::number(mean.truth[0], 5),
            Cell::number(mean.truth[1], 5),
            shear(score.metrics.c1, mean.error[0]),
            shear(score.metrics.c2, mean.error[1]),
        ])
    });
    Table {
        title: title.to_owned(),
        headings: headings.map(|(key, label)| Heading::new(key, label)).into(),
        rows: rows.collect(),
        notes: notes(scored),
    }
}

/// Metrics of power spectra, with a row per set and a row of means. `zero_q` has Q of zero shear of each set.
pub fn spectra(
    records: &[SetRecord],
    zero_q: &[f64],
    title: &str,
    definition: Definition,
) -> Table {
    let metrics = ["q", "sigma_sys_1e4", "m_half", "sqrt_a"].map(Metrics::named);
    let mut headings = vec![Heading::new("set", "Set"), Heading::new("kind", "Kind")];
    let metrics = || metrics.into_iter().flatten();
    headings.extend(metrics().map(|metric| Heading::new(metric.name, metric.heading)));
    let row = |names: [Cell; 2], sets: &[SetRecord]| {
        let mut row = names.to_vec();
        row.extend(metrics().map(|metric| metric_cell(metric, sets)));
        row
    };
    let mut rows: Vec<Vec<Cell>> = records
        .iter()
        .map(|set| row([set_cell(set), kind_cell(set)], std::slice::from_ref(set)))
        .collect();
    if records.len() > 1 {
        rows.push(row([Cell::text("mean"), Cell::Empty], records));
    }
    let errors = match records.iter().all(|set| set.errors.q.is_nan()) {
        true => "No errors, because no covariance of the bandpowers is known.",
        false => "Errors: from the covariance in the manifest, to first order.",
    };
    let zero = zero_q.iter().sum::<f64>() / zero_q.len() as f64;
    let mut notes = vec![format!(
        "Metrics: {} definition. {errors} √A in 10⁻⁴ for C_ℓ in steradian.{}",
        definition_word(definition),
        kinds_note(records)
    )];
    notes.extend(zero_shear_line(zero, mean(records, |metrics| metrics.q).0));
    Table {
        title: title.to_owned(),
        headings,
        rows,
        notes,
    }
}

pub fn bandpowers(scored: &[ScoredSet]) -> Table {
    let power = |value: f64| Cell::number(value * 1e6, 4);
    let mut rows = Vec::new();
    for own in scored {
        let score = &own.score;
        let measured = score.spectra();
        for b in spectrum::bins(&score.bins.l) {
            rows.push(vec![
                own.number()
                    .map_or(Cell::Empty, |set| Cell::number(f64::from(set), 0)),
                Cell::number(b as f64 + 1.0, 0),
                Cell::number(score.bins.l[b], 1),
                power(score.true_ee[b]),
                Cell::with_error(measured.ee[b] * 1e6, Some(score.ee_error[b] * 1e6), 4),
                power(measured.bb[b]),
                power(measured.eb[b]),
            ]);
        }
    }
    let headings = [
        ("set", "Set"),
        ("bin", "Bin"),
        ("l", "ℓ"),
        ("true_ee", "true EE×10⁶"),
        ("ee", "EE×10⁶"),
        ("bb", "BB×10⁶"),
        ("eb", "EB×10⁶"),
    ];
    Table {
        title: "Shear bandpowers ℓ²C_ℓ/2π of the scored bins".into(),
        headings: headings.map(|(key, label)| Heading::new(key, label)).into(),
        rows,
        notes: vec![
            "Errors: from the part that the truth does not explain, at fixed truth.".into(),
        ],
    }
}

fn bias_json(bias: &Bias) -> Value {
    json!({ "M": bias.M, "A": bias.A, "sqrtA": bias.sqrtA, "m": bias.m_half })
}

fn fits_json(fits: &BiasFits) -> Value {
    json!({
        "l2": bias_json(&fits.l2),
        "mode": bias_json(&fits.mode),
        "cl": bias_json(&fits.cl),
        "cl_over_2pi": bias_json(&fits.cl_over_2pi),
    })
}

fn class_json(score: &SetScore, representative: &ConventionScore, class: ConventionClass) -> Value {
    let mut object = json!({
        "EE": representative.ee,
        "BB": representative.bb,
        "EB": representative.eb,
        "sigma_sys": representative.quality.sigma_sys,
        "Q": representative.quality.q,
        "corr": score.matching.class_correlation(class),
        "M": representative.fit.cl.M,
        "A": representative.fit.cl.A,
        "sqrtA": representative.fit.cl.sqrtA,
        "fit": fits_json(&representative.fit),
    });
    if let (Some(quality), Some(fit)) = (&representative.quality_dn, &representative.fit_dn) {
        object["sigma_sys_dn"] = json!(quality.sigma_sys);
        object["Q_dn"] = json!(quality.q);
        object["fit_dn"] = fits_json(fit);
    }
    object
}

// Keys of [`one_set_json`] that are undefined for a constant true shear.
const OF_TRUE_POWER: [&str; 15] = [
    "Q",
    "sigma_sys",
    "winner",
    "winner_class",
    "matched",
    "matched_class",
    "corr_matched",
    "Q_matched",
    "M",
    "A",
    "sqrtA",
    "Q_dn",
    "sigma_sys_dn",
    "Q_per_convention",
    "classes",
];

#[derive(Debug, Clone)]
pub struct SetInput {
    pub case: String,
    pub truth: String,
    pub catalogues: Vec<String>,
    pub definition: Definition,
}

/// All scores of one set from plain files: the keys of the public scoring cases, errors and null tests.
pub fn one_set_json(scored: &ScoredSet, input: &SetInput) -> Value {
    let score = &scored.score;
    let best = &score.conventions[score.best.index()];
    let matched = &score.conventions[score.matching.best().index()];
    let bins = &score.bins;
    let per_convention: BTreeMap<String, f64> = score
        .conventions
        .iter()
        .map(|c| (c.convention.number().to_string(), c.quality.q))
        .collect();
    let weights: Vec<f64> = (0..BINS).map(|b| bins.mode_weight(b)).collect();
    let mut object = json!({
        "case": input.case,
        "description": format!(
            "{} catalogue(s) scored by shearq {}",
            input.catalogues.len(),
            shearq_dataset::VERSION
        ),
        "definition": input.definition,
        "files": { "truth": input.truth, "catalogues": input.catalogues },
        "n": score.grid.n,
        "size_deg": score.grid.field.0,
        "postage": score.grid.stamp.0,
        "n_images": score.images,
        "noise_var": score.noise_variance,
        "l_min": score.grid.l_min().0,
        "l_max": score.grid.l_max().0,
        "dlogl": bins.width,
        "n_modes": bins.modes,
        "sum_l": bins.sum_l,
        "W": weights,
        "ll": bins.l,
        "dll": bins.dln_l,
        "P_noise": score.noise,
        "truth": { "EE": score.true_ee, "BB": score.true_bb },
        "submission": { "EE": best.ee, "BB": best.bb },
        "Q": best.quality.q,
        "sigma_sys": best.quality.sigma_sys,
        "winner": score.best.number(),
        "winner_class": score.best.class(),
        "matched": matched.convention.number(),
        "matched_class": matched.convention.class(),
        "corr_matched": matched.correlation,
        "Q_matched": matched.quality.q,
        "M": best.fit.cl.M,
        "A": best.fit.cl.A,
        "sqrtA": best.fit.cl.sqrtA,
        "Q_dn": best.quality_dn.map(|q| q.q),
        "sigma_sys_dn": best.quality_dn.map(|q| q.sigma_sys),
        "Q_per_convention": per_convention,
        "classes": {
            "A": class_json(score, &score.conventions[5], ConventionClass::A),
            "B": class_json(score, &score.conventions[4], ConventionClass::B),
        },
    });
    // Keys that the public cases do not have.
    let own = json!({
        "chosen": score.chosen.number(),
        "convention_known": scored.basis.is_known(),
        "metrics": score.metrics,
        "metric_errors": score.errors,
        "error_method": "from the part that the truth does not explain, at fixed truth; for c1 and c2 at least the jackknife over images",
        "mean_shear": score.constant,
        "rows": scored.rows,
        "warnings": notes(std::slice::from_ref(scored)),
    });
    if let (Value::Object(object), Value::Object(own)) = (&mut object, own) {
        object.extend(own);
        if score.constant.is_some() {
            // These keys need a true power.
            for (key, value) in object.iter_mut() {
                if OF_TRUE_POWER.contains(&key.as_str()) {
                    *value = Value::Null;
                }
            }
        }
    }
    object
}
