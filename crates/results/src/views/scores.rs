//! Scores as tables, as JSON and as warnings about probable faults of catalogues and of the true shear.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};
use shearq_dataset::truth::{Sign, SignBasis};
use shearq_quantities::Frame;
use shearq_render::table::{Cell, Table};
use shearq_scoring::{
    BINS, Bias, BiasFits, ConventionClass, ConventionScore, Definition, Fault, Metrics, OddImages,
    OddResponse, Repeated, RowCounts, SetScore,
};

use crate::catalogues::PLAIN_SET;
use crate::record::{FRAME, SetRecord, columns_named, mean};
use crate::score::{Basis, ScoredSet};
use crate::views::pages::bins;

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

// Scores are the same under all conventions, and a shear of the other sign is wrong.
fn other_signs(of: &ScoredSet) -> Option<String> {
    let is_matched = matches!(of.basis, Basis::Matched(matching) if matching.is_clear());
    let is_stated = of.sign.is_some_and(|sign| sign.basis == SignBasis::Stated);
    let SetScore {
        chosen, constant, ..
    } = &of.score;
    (is_matched && is_stated && constant.is_none() && chosen.signs() != (1.0, 1.0)).then(|| {
        format!(
            "warning: the signs of the ellipticities are not those of the truth, whose file states the sign of g2 (found {}, expected both signs alike). The scores are as good as with the right signs. Try: --convention 5, or --columns e2=-NAME if this sign is known",
            chosen.describe()
        )
    })
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
    lines.extend(scored.first().and_then(other_signs));
    for own in scored {
        let (set, score) = (own.number(), &own.score);
        let name_of = |place: usize| own.names[place].display().to_string();
        let odd = odd_images(&own.odd_images, &name_of).into_iter();
        lines.extend(odd.map(|odd| format!("{}{odd}.", prefix(set))));
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
        // Lensing makes E modes only; the wrong sign of g2 mixes them with B modes, as weights and gaps of the corrected definition
        // do. The limit is chosen by hand.
        let counted = |own: &ScoredSet| own.weight_scatter.is_none() && own.rows.missing == 0;
        let is_whole = score.bins.definition == Definition::Leaderboard || counted(own);
        if score.constant.is_none() && is_whole && score.true_b_share() > 0.2 {
            lines.push(format!(
                "warning: {:.0} % of the true power of {name} is in B modes; g2 may have the other sign. Try: --truth-sign.",
                100.0 * score.true_b_share()
            ));
        }
        lines.extend(oddities(&own.rows, &name, own.score.bins.definition));
        lines.extend(weighted(own, &name));
    }
    let findings = scored.iter().map(|set| (set.number(), &*set.findings));
    lines.extend(of_sets(findings));
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

// Scatter of weights from which it limits Q. Chosen by hand.
const MIN_WEIGHT_SCATTER: f64 = 0.05;

// Weights multiply the shear of each galaxy, and the leaderboard compares the product with the true shear.
fn weighted(own: &ScoredSet, name: &str) -> Option<String> {
    let scatter = own.weight_scatter.filter(|own| *own > MIN_WEIGHT_SCATTER)?;
    (own.score.bins.definition == Definition::Leaderboard).then(|| {
        format!(
            "note: weights of {name} scatter by {:.0} % of their mean between galaxies, which multiplies their shear and limits Q. Try: --definition corrected, which gives the true shear the same weights, or --columns w=none.",
            100.0 * scatter
        )
    })
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

fn set_cell(record: &SetRecord) -> Cell {
    match record.set {
        PLAIN_SET => Cell::text("–"),
        set => Cell::text(format!("{set:02}")),
    }
}

// A row for each set, and a row of means for several, with the columns of records called `names`.
fn table_of_sets(records: &[SetRecord], title: &str, names: &[&str]) -> Table {
    let single = records.iter().map(|set| {
        let kind = set.kind().map_or("", |kind| kind.image.label());
        ([set_cell(set), Cell::text(kind)], std::slice::from_ref(set))
    });
    let mean = ([Cell::text("mean"), Cell::Empty], records);
    let means = (records.len() > 1).then_some(mean);
    let rows: Vec<_> = single.chain(means).collect();
    let mut table = Table::titled(title);
    table.column("set", "Set", &rows, |([set, _], _)| set.clone());
    table.column("kind", "Kind", &rows, |([_, kind], _)| kind.clone());
    for own in columns_named(names) {
        table.column(own.name, own.heading, &rows, |(_, sets)| {
            own.cell_of_sets(sets)
        });
    }
    table
}

/// Metrics per set, with a row of means for several sets.
pub fn per_set(scored: &[ScoredSet], title: &str, definition: Definition) -> Table {
    if scored.iter().all(|set| set.score.constant.is_some()) {
        return constant_shear(scored, title);
    }
    let records: Vec<SetRecord> = scored.iter().map(|set| set.record.clone()).collect();
    let metrics = Metrics::ALL.map(|metric| metric.name);
    let frame = frame_column(scored);
    let names = [
        &["images"],
        frame,
        &metrics,
        &["convention", "q_leaderboard"],
    ]
    .concat();
    let mut table = table_of_sets(&records, title, &names);
    let apart = records
        .iter()
        .any(|set| best_is_another(set.q_leaderboard, set.metrics.q));
    for (place, heading) in table.headings.iter_mut().enumerate() {
        heading.detail = match heading.key {
            "images" => true,
            "q_leaderboard" => !apart,
            // A number of a convention is a name, and has no mean.
            "convention" => {
                for (k, row) in table.rows.iter_mut().enumerate() {
                    let name = records
                        .get(k)
                        .map(|set| set.convention.number().to_string());
                    row[place] = name.map_or(Cell::Empty, Cell::text);
                }
                true
            }
            metric => Metrics::named(metric).is_some_and(|metric| metric.detail),
        };
    }
    let counts: BTreeSet<usize> = scored.iter().map(|set| set.score.images).collect();
    let counts: Vec<String> = counts.iter().map(usize::to_string).collect();
    table.notes = vec![
        format!(
            "Images per set: {}.{}",
            counts.join(", "),
            kinds_note(&records)
        ),
        definition_note(definition),
    ];
    table.notes.extend(notes(scored));
    table
}

fn frame_column(scored: &[ScoredSet]) -> &'static [&'static str] {
    match scored.iter().all(|set| set.record.frame == Frame::Pixel) {
        true => &[],
        false => &[FRAME],
    }
}

// Whether the leaderboard's Q has another class of conventions than the metrics. Within a class Q differs by
// rounding only, at most 1e-7.
pub(super) fn best_is_another(q_leaderboard: f64, q: f64) -> bool {
    (q_leaderboard / q - 1.0).abs() > 1e-6
}

fn constant_shear(scored: &[ScoredSet], title: &str) -> Table {
    let rows = scored
        .iter()
        .filter_map(|own| Some((own, own.score.constant?)));
    let rows: Vec<_> = rows.collect();
    let shear = |value, error| Cell::with_error(value, Some(error), 5);
    let mut table = Table::titled(title);
    table.column("set", "Set", &rows, |(own, _)| set_cell(&own.record));
    table.column("images", "Images", &rows, |(own, _)| {
        Cell::number(own.score.images as f64, 0)
    });
    for name in frame_column(scored) {
        table.column(name, "Frame", &rows, |(own, _)| {
            Cell::text(own.record.frame.to_string())
        });
    }
    for (k, (key, label)) in [("e1", "mean e1"), ("e2", "mean e2")]
        .into_iter()
        .enumerate()
    {
        table.column(key, label, &rows, |(_, mean)| {
            shear(mean.e[k], mean.error[k])
        });
    }
    for (k, (key, label)) in [("g1", "true g1"), ("g2", "true g2")]
        .into_iter()
        .enumerate()
    {
        table.column(key, label, &rows, |(_, mean)| {
            Cell::number(mean.truth[k], 5)
        });
    }
    table.column("c1", "c1", &rows, |(own, mean)| {
        shear(own.score.metrics.c1, mean.error[0])
    });
    table.column("c2", "c2", &rows, |(own, mean)| {
        shear(own.score.metrics.c2, mean.error[1])
    });
    table.notes = notes(scored);
    table
}

/// Metrics of power spectra, with a row per set and a row of means. `zero_q` has Q of zero shear of each set.
pub fn spectra(
    records: &[SetRecord],
    zero_q: &[f64],
    title: &str,
    definition: Definition,
) -> Table {
    let names = ["q", "sigma_sys_1e4", "m_half", "sqrt_a"];
    let mut table = table_of_sets(records, title, &names);
    let errors = match records.iter().all(|set| set.errors.q.is_nan()) {
        true => "No errors, because no covariance of the bandpowers is known.",
        false => "Errors: from the covariance in the manifest, to first order.",
    };
    let zero = zero_q.iter().sum::<f64>() / zero_q.len() as f64;
    table.notes = vec![format!(
        "Metrics: {} definition. {errors} √A in 10⁻⁴ for C_ℓ in steradian.{}",
        definition,
        kinds_note(records)
    )];
    let zero = zero_shear_line(zero, mean(records, |metrics| metrics.q).0);
    table.notes.extend(zero);
    table
}

pub fn bandpowers(scored: &[ScoredSet]) -> Table {
    let rows = scored.iter().flat_map(|own| {
        let measured = own.score.spectra();
        bins(&own.score.bins.l).map(move |bin| (own, bin, measured))
    });
    let rows: Vec<_> = rows.collect();
    let power = |value: f64| Cell::number(value * 1e6, 4);
    let mut table = Table::titled("Shear bandpowers ℓ²C_ℓ/2π of the scored bins");
    table.column("set", "Set", &rows, |(own, ..)| {
        own.number()
            .map_or(Cell::Empty, |set| Cell::number(f64::from(set), 0))
    });
    table.column("bin", "Bin", &rows, |(_, bin, _)| {
        Cell::number(*bin as f64 + 1.0, 0)
    });
    table.column("l", "ℓ", &rows, |(own, bin, _)| {
        Cell::number(own.score.bins.l[*bin], 1)
    });
    table.column("true_ee", "true EE×10⁶", &rows, |(own, bin, _)| {
        power(own.score.true_ee[*bin])
    });
    table.column("ee", "EE×10⁶", &rows, |(own, bin, measured)| {
        let error = own.score.ee_error[*bin] * 1e6;
        Cell::with_error(measured.ee[*bin] * 1e6, Some(error), 4)
    });
    table.column("bb", "BB×10⁶", &rows, |(_, bin, measured)| {
        power(measured.bb[*bin])
    });
    table.column("eb", "EB×10⁶", &rows, |(_, bin, measured)| {
        power(measured.eb[*bin])
    });
    table.notes =
        vec!["Errors: from the part that the truth does not explain, at fixed truth.".into()];
    table
}

/// A line for each kind of odd row in the catalogues of `whose`: how many there are, and how a definition scores them.
pub fn oddities(counts: &RowCounts, whose: &str, definition: Definition) -> Vec<String> {
    let mut lines = Vec::new();
    if counts.outside + counts.excess > 0 {
        lines.push(format!(
            "warning: {whose} has {} outside the grid and {} beyond the number of cells; they do not count.{}",
            rows(counts.outside),
            counts.excess,
            match counts.excess {
                0 => "",
                _ => " If a galaxy has several rows, as in several bands, try: a table with one row of each.",
            }
        ));
    }
    if counts.repeated > 0 {
        lines.push(format!(
            "warning: {} of {whose} of galaxies that have one already; they add up.",
            rows(counts.repeated)
        ));
    }
    if counts.missing > 0 {
        lines.push(format!(
            "warning: {} of {} galaxies of {whose} are not in the catalogues; {}.",
            counts.missing,
            counts.missing + counts.used + counts.not_finite - counts.repeated,
            match definition {
                Definition::Leaderboard => "each counts as zero",
                Definition::Corrected => "their true shear does not count either",
            }
        ));
    }
    if counts.above_one > 0 {
        lines.push(format!(
            "warning: {} of {whose} with |e| > 1, {} with |e| > {}; scored unchanged.",
            rows(counts.above_one),
            counts.absurd,
            RowCounts::ABSURD
        ));
    }
    if counts.not_finite > 0 {
        lines.push(format!(
            "note: {} of {} galaxies of {whose} have no ellipticity (NaN, flagged, with a weight of zero or less, marked as missing, or a distortion above 1, which noise makes) and count as missing.",
            counts.not_finite,
            counts.not_finite + counts.used
        ));
    }
    lines
}

fn rows(count: usize) -> String {
    format!("{count} row{}", if count == 1 { "" } else { "s" })
}

// Part of the galaxies that are missing from which they matter for a large m. Chosen by hand.
const MIN_MISSING: f64 = 0.05;

pub fn words(finding: &Fault) -> String {
    match *finding {
        Fault::StrongTruth { rms } => format!(
            "the true shear is too strong for weak lensing (rms {rms:.3}, expected below 0.3); it may be in percent, or another quantity"
        ),
        Fault::Convention {
            scored,
            correlation,
            better,
            with,
        } => format!(
            "the convention is probably wrong: convention {} ({}) correlates with the true shear by {with:.2}, convention {} only by {correlation:.2}. Check the signs of e1 and e2 and the order of x and y",
            better.number(),
            better.describe(),
            scored.number()
        ),
        Fault::Swapped { correlation, with } => format!(
            "e1 and e2 seem to be swapped: swapped they correlate with the true shear by {with:.2}, as given only by {correlation:.2}. Check the order of the columns"
        ),
        Fault::Shifted {
            x,
            y,
            correlation,
            with,
        } => format!(
            "the ellipticities seem to be shifted by ({x:+}, {y:+}) cells: shifted back they correlate with the true shear by {with:.2}, as given only by {correlation:.2}. Check the order of the rows and the positions"
        ),
        Fault::Uncorrelated {
            correlation,
            allowed,
        } => format!(
            "the ellipticities correlate with the true shear by only {correlation:.2}, but their noise allows {allowed:.2}. Check the order of the rows, the positions, the columns, and that truth and catalogues belong together"
        ),
        Fault::Distortion { m, error } => format!(
            "the ellipticities respond to shear by a factor of {:.2} ± {error:.2}, expected 1: they seem to be distortions χ, not shear-type ε",
            1.0 + m
        ),
        Fault::Biased { m, error, missing } if missing > MIN_MISSING => format!(
            "m = {m:.3} ± {error:.3}, expected |m| below 0.1: {:.0} % of the galaxies are missing and count as zero, which alone is m = {:.2}. Try: --definition corrected, which leaves them out",
            100.0 * missing,
            -missing
        ),
        Fault::Biased { m, error, .. } => format!(
            "m = {m:.3} ± {error:.3}, expected |m| below 0.1: a high Q does not make such ellipticities fit for use. Calibrate them"
        ),
    }
}

/// Faults of single images, one sentence each.
pub fn odd_images(odd: &OddImages, name: &dyn Fn(usize) -> String) -> Vec<String> {
    let mut lines = Vec::new();
    let more = |count: usize| match count {
        1 => String::new(),
        2 => ", and 1 more likewise".to_owned(),
        _ => format!(", and {} more likewise", count - 1),
    };
    if let Some(&(copy, first)) = odd.copies.first() {
        lines.push(format!(
            "{} has the ellipticities of {}{}; expected an independent measurement per image. Noise, Q_dn and errors are wrong",
            name(copy),
            name(first),
            more(odd.copies.len())
        ));
    }
    if let Some((place, found)) = odd.repeated.first() {
        lines.push(format!(
            "{}: {}{}; expected measured values, which do not repeat. Check the column names, and leave out galaxies that were not measured",
            name(*place),
            repeated_shapes(found),
            more(odd.repeated.len())
        ));
    }
    for response in odd.responses.iter().take(MAX_NAMED) {
        lines.push(format!(
            "{} {}",
            name(response.place),
            odd_response(response)
        ));
    }
    if let Some(left) = odd.responses.len().checked_sub(MAX_NAMED + 1) {
        let others = odd.responses[MAX_NAMED..].iter();
        let names: Vec<String> = others.map(|own| name(own.place)).collect();
        lines.push(format!(
            "{} more images likewise: {}",
            left + 1,
            names.join(", ")
        ));
    }
    lines
}

/// Galaxies that share ellipticities.
pub fn repeated_shapes(found: &Repeated<2>) -> String {
    let [e1, e2] = found.value;
    let value = match found.component {
        None => format!("(e1, e2) = ({e1}, {e2})"),
        Some(0) => format!("e1 = {e1}"),
        Some(_) => format!("e2 = {e2}"),
    };
    format!(
        "{} of {} galaxies have repeated values, most often {value}",
        found.rows, found.of
    )
}

// Chosen by hand: more sentences hide the others.
const MAX_NAMED: usize = 4;

// Exchanged rows have a slope of zero within the errors. Chosen by hand.
const CLEAR_SLOPE_SIGMA: f64 = 5.0;

/// Whether an image follows the shear clearly, and by less than half of the others.
pub fn follows_by_less(odd: &OddResponse) -> bool {
    let OddResponse {
        response, slope, ..
    } = odd;
    response.slope / slope < 0.5 && response.slope > CLEAR_SLOPE_SIGMA * response.error
}

/// How an image differs from the others of its set, with the probable cause.
pub fn odd_response(odd: &OddResponse) -> String {
    let OddResponse {
        response,
        slope,
        correlation,
        ..
    } = odd;
    let ratio = response.slope / slope;
    // Chosen by hand. Exchanged rows leave a slope near 0, another sign the slope −1, and distortions a slope near 2.
    let cause = match ratio {
        _ if ratio < -0.5 => "Its signs are probably wrong",
        _ if follows_by_less(odd) => {
            "Its ellipticities are probably of another scale, as of galaxies with low weights, or some of its galaxies are in another order"
        }
        _ if ratio < 0.5 => {
            "Its galaxies are probably in another order, at other positions or of another set"
        }
        _ => "Its ellipticities are probably of another type or scale",
    };
    format!(
        "follows the true shear by {:.2} ± {:.2} (correlation {:.2}), the images of its set by {slope:.2} ({correlation:.2}). {cause}",
        response.slope, response.error, response.correlation
    )
}

/// Findings of several sets, one line per kind: the message of the first set, and the numbers of the other sets.
pub fn of_sets<'a>(sets: impl Iterator<Item = (Option<u32>, &'a [Fault])>) -> Vec<String> {
    let mut kinds: Vec<(Fault, Vec<Option<u32>>)> = Vec::new();
    for (set, findings) in sets {
        for finding in findings {
            // A fault of the whole method appears in all of its sets; a line for each would hide the others.
            let kind = std::mem::discriminant(finding);
            match kinds
                .iter_mut()
                .find(|(first, _)| std::mem::discriminant(first) == kind)
            {
                Some((_, sets)) => sets.push(set),
                None => kinds.push((*finding, vec![set])),
            }
        }
    }
    kinds
        .iter()
        .map(|(finding, sets)| {
            let others: Vec<String> = sets[1..].iter().flatten().map(u32::to_string).collect();
            let others = match others.is_empty() {
                true => String::new(),
                false => format!(" (likewise in set {})", others.join(", ")),
            };
            let advice = match finding {
                Fault::Distortion { .. } => {
                    " Try: --ellipticity distortion, or `ellipticity = \"distortion\"` with --foreign."
                }
                _ => "",
            };
            format!("{}{}{others}.{advice}", prefix(sets[0]), words(finding))
        })
        .collect()
}

/// `warning: set 02: `, or `warning: ` if the set has no number.
pub fn prefix(set: Option<u32>) -> String {
    set.map_or_else(
        || "warning: ".into(),
        |set| format!("warning: set {set:02}: "),
    )
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
    /// Which columns are used as what.
    pub columns: Vec<String>,
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
        "convention_known": scored.basis.is_certain(),
        "metrics": score.metrics,
        "metric_errors": score.errors,
        "error_method": "from the part that the truth does not explain, at fixed truth; for c1 and c2 at least the jackknife over images",
        "mean_shear": score.constant,
        "rows": scored.rows,
        "columns": input.columns,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_of_several_sets_is_one_line_with_advice() {
        let distorted = |m| Fault::Distortion { m, error: 0.1 };
        let (two, five) = ([distorted(1.02)], [distorted(0.9)]);
        let sets = [(Some(2), &two[..]), (Some(5), &five[..])];
        let lines = of_sets(sets.into_iter());
        assert_eq!(lines.len(), 1);
        assert!(lines[0].starts_with("warning: set 02: ") && lines[0].contains("2.02 ± 0.10"));
        assert!(lines[0].contains("(likewise in set 5). Try: --ellipticity distortion"));
        assert!(of_sets([(None, &two[..])].into_iter())[0].starts_with("warning: the "));
    }

    fn good() -> RowCounts {
        RowCounts {
            used: 64,
            ..RowCounts::default()
        }
    }

    #[test]
    fn each_kind_of_odd_row_has_a_line() {
        assert!(oddities(&good(), "x", Definition::Leaderboard).is_empty());
        let odd = RowCounts {
            used: 50,
            outside: 1,
            excess: 2,
            not_finite: 3,
            repeated: 4,
            missing: 15,
            above_one: 5,
            absurd: 2,
            ..RowCounts::default()
        };
        let lines = oddities(&odd, "set 7", Definition::Leaderboard);
        let expected = [
            "set 7 has 1 row outside the grid and 2 beyond",
            "4 rows of set 7",
            "15 of 64 galaxies of set 7 are not in the catalogues",
            "5 rows of set 7 with |e| > 1, 2 with |e| > 5",
            "3 of 53 galaxies of set 7 have no ellipticity",
        ];
        assert_eq!(lines.len(), expected.len());
        for (line, words) in lines.iter().zip(expected) {
            assert!(line.contains(words), "{line}");
        }
        for (outside, excess) in [(1, 0), (0, 1)] {
            let counts = RowCounts {
                outside,
                excess,
                ..good()
            };
            assert_eq!(oddities(&counts, "x", Definition::Leaderboard).len(), 1);
        }
    }
}
