//! Tables of methods and recorded runs: mean metrics, differences in Q and calibrated Q, Q per set, and the verdict.

use std::collections::{BTreeMap, BTreeSet};

use shearq_render::figure::{LinePlot, PanelGrid, Series, Style};
use shearq_render::table::{Cell, Table};
use shearq_scoring::resample::PairedDifference;
use shearq_scoring::{Definition, Fault, Metrics};
use shearq_submissions::Published;

use crate::compare::{Paired, Variant, difference, keep_common_sets};
use crate::record::{RunRecord, SetRecord, columns_named, mean};
use crate::score::ScoredSet;
use crate::views::scores::{best_is_another, definition_note, notes, of_sets};

/// A method or run with its sets.
pub type Named<'a> = (String, &'a [SetRecord]);

pub fn named(variants: &[Variant]) -> Vec<Named<'_>> {
    let named = |variant: &'_ Variant| variant.name.clone();
    variants
        .iter()
        .map(|variant| (named(variant), variant.run.sets.as_slice()))
        .collect()
}

// The columns of a row that follow Q and calibrated Q.
const METRICS: [&str; 6] = [
    "galaxy_noise",
    "m_cross",
    "q_leaderboard",
    "q_dn",
    "m_half",
    "sqrt_a",
];

// A row of a comparison.
struct Compared<'a> {
    run: &'a RunRecord,
    differences: Differences,
}

type Differences = [Option<PairedDifference>; 2];

fn differences(first: &RunRecord, run: &RunRecord) -> Differences {
    // Bandpowers of two definitions differ by more than methods do.
    match first.definition == run.definition {
        true => {
            [Paired::Q, Paired::Calibrated].map(|metric| difference(metric, &first.sets, &run.sets))
        }
        false => [None; 2],
    }
}

// Adds Q and calibrated Q, each with difference and significance, and `METRICS`.
fn add_metrics(table: &mut Table, rows: &[Compared<'_>]) {
    let add = |table: &mut Table, name: &str| {
        for own in columns_named(&[name]) {
            table.column(own.name, own.heading, rows, |row| own.cell(row.run));
        }
    };
    for (k, (name, difference, label, sigma)) in [
        ("q", "q_difference", "ΔQ to first", "sigma"),
        (
            "q_calibrated",
            "q_calibrated_difference",
            "ΔQ cal.",
            "q_calibrated_sigma",
        ),
    ]
    .into_iter()
    .enumerate()
    {
        add(table, name);
        table.column(difference, label, rows, |row| {
            let (value, error) = row.differences[k].map(|d| (d.difference, d.error)).unzip();
            Cell::with_error(value.unwrap_or(f64::NAN), error, 2)
        });
        table.column(sigma, "in σ", rows, |row| {
            Cell::number(row.differences[k].map_or(f64::NAN, |d| d.sigma()), 1)
        });
    }
    for name in METRICS {
        add(table, name);
    }
    // Equal to Q if the leaderboard uses the same class of conventions.
    let mut sets = rows.iter().flat_map(|row| &row.run.sets);
    let differs = sets.any(|set| best_is_another(set.q_leaderboard, set.metrics.q));
    for heading in &mut table.headings {
        heading.detail |= heading.key == "q_leaderboard" && !differs;
    }
}

fn unpaired_note(names: &[String]) -> Option<String> {
    (!names.is_empty()).then(|| {
        format!(
            "No difference for {}: differences need equal images, one definition and certain conventions.",
            names.join(", ")
        )
    })
}

/// Methods side by side: means over their common sets, differences in Q from the first method, paired over equal images,
/// and published metrics.
pub fn compare(variants: &[Variant], definition: Definition) -> Table {
    let rows = variants
        .iter()
        .enumerate()
        .map(|(k, Variant { run, .. })| Compared {
            run,
            differences: match k {
                0 => [None; 2],
                _ => differences(&variants[0].run, run),
            },
        });
    let rows: Vec<Compared<'_>> = rows.collect();
    let mut table = Table::titled("Comparison of configurations");
    table.column("submission", "Configuration", variants, |variant| {
        Cell::text(&variant.name)
    });
    add_metrics(&mut table, &rows);
    let published = |value: fn(&Published) -> f64, decimals: usize| {
        move |variant: &Variant| {
            let value = variant.published.as_ref().map_or(f64::NAN, value);
            Cell::number(value, decimals)
        }
    };
    table.column("q_published", "Q publ.", variants, published(|p| p.q, 2));
    table.column(
        "m_half_published",
        "M/2 publ.",
        variants,
        published(|p| p.m_half, 4),
    );
    table.column(
        "sqrt_a_published",
        "√A publ.",
        variants,
        published(|p| p.sqrt_a, 4),
    );
    let mut others = Metrics::ALL.map(|metric| metric.name).to_vec();
    others.retain(|name| table.place(name).is_none());
    for own in columns_named(&others) {
        let place = table.column(own.name, own.heading, &rows, |row| own.cell(row.run));
        table.headings[place].detail = true;
    }
    let unpaired = variants.iter().zip(&rows).skip(1);
    let unpaired = unpaired.filter(|(_, row)| row.differences[0].is_none());
    let unpaired: Vec<String> = unpaired.map(|(variant, _)| variant.name.clone()).collect();
    let (sets, images) = sets_and_images(variants);
    let mut lines = vec![
        match sets.contains(',') {
            false => format!("Set {sets}; {images} images."),
            true => format!("Means over sets {sets}; {images} images in all."),
        },
        definition_note(definition),
        "ΔQ, ΔQ cal.: difference from the first row on the same images, with a jackknife error if each set has eight images or more.".into(),
    ];
    if variants.iter().any(|variant| variant.published.is_some()) {
        lines.push("Published: for the challenge's 24 sets of 200 images, not comparable in absolute value.".into());
    }
    lines.extend(unpaired_note(&unpaired));
    lines.extend(notes_of_variants(variants));
    table.notes = lines;
    table
}

fn sets_and_images(variants: &[Variant]) -> (String, usize) {
    let sets = variants.first().map_or(&[][..], |first| &first.run.sets);
    let list: Vec<String> = sets.iter().map(|set| set.set.to_string()).collect();
    (
        list.join(", "),
        sets.iter().map(|set| set.images.len()).sum(),
    )
}

/// Notes on the sets of each variant. A note on several variants appears once, with their names.
fn notes_of_variants(variants: &[Variant]) -> Vec<String> {
    let mut found: Vec<(String, Vec<&str>)> = Vec::new();
    for variant in variants {
        let lines = notes(&variant.scored()).into_iter();
        for line in lines.chain(variant.unscored.iter().cloned()) {
            match found.iter_mut().find(|(known, _)| *known == line) {
                Some((_, names)) => names.push(&variant.name),
                None => found.push((line, vec![&variant.name])),
            }
        }
    }
    let all = variants.len();
    let shown = found.into_iter().map(|(line, names)| match names.len() {
        many if many == all => line,
        _ => format!("{}: {line}", names.join(", ")),
    });
    shown.collect()
}

/// Runs side by side: means over their sets, and the difference in Q from the first run on the same images.
pub fn compare_runs(runs: &[RunRecord]) -> Table {
    let rows = runs.iter().enumerate().map(|(k, run)| Compared {
        run,
        differences: match k {
            0 => [None; 2],
            _ => differences(&runs[0], run),
        },
    });
    let rows: Vec<Compared<'_>> = rows.collect();
    let unpaired = rows.iter().skip(1);
    let unpaired = unpaired.filter(|row| row.differences[0].is_none());
    let unpaired: Vec<String> = unpaired.map(|row| row.run.short_id()).collect();
    let mut table = Table::titled("Recorded runs");
    table.column("submission", "Configuration", runs, |run| {
        Cell::text(&run.configuration)
    });
    table.column("run", "Run", runs, |run| Cell::text(run.short_id()));
    let version = table.column("version", "Version", runs, |run| Cell::text(&run.version));
    table.headings[version].detail = true;
    table.column("sets", "Sets", runs, |run| Cell::text(ranges(&run.sets)));
    table.column("images", "Images", runs, |run| {
        let images: usize = run.sets.iter().map(|set| set.images.len()).sum();
        Cell::number(images as f64, 0)
    });
    add_metrics(&mut table, &rows);
    table.notes = run_notes(runs, &unpaired);
    table
}

fn run_notes(runs: &[RunRecord], unpaired: &[String]) -> Vec<String> {
    let way = |run: &RunRecord| {
        format!(
            "{} definition, {} convention, noise {}",
            run.definition, run.choice, run.noise
        )
    };
    let ways: BTreeSet<String> = runs.iter().map(way).collect();
    let several = ways.len() > 1;
    let ways: Vec<String> = ways.into_iter().collect();
    let mut notes = vec![format!(
        "Means over the sets of each row. Metrics: {}. √A in 10⁻⁴ for C_ℓ in steradian.",
        ways.join("; ")
    )];
    if several {
        notes.push("warning: the runs were scored in different ways and cannot be compared. Try: --where \"definition == 'leaderboard'\" or \"choice == 'matched'\"".into());
    }
    notes.extend(unpaired_note(unpaired));
    notes.extend(runs.iter().filter_map(bias_note));
    notes
}

fn bias_note(run: &RunRecord) -> Option<String> {
    // Records of a store have no other findings than those that follow from their metrics.
    let findings = run.sets.iter().map(|set| {
        let finding = Fault::of_bias(set.metrics.m_cross, set.errors.m_cross, 0.0);
        (Some(set.set), finding.into_iter().collect::<Vec<Fault>>())
    });
    let findings: Vec<_> = findings.collect();
    let lines = of_sets(findings.iter().map(|(set, found)| (*set, found.as_slice())));
    (!lines.is_empty()).then(|| format!("{}: {}", run.configuration, lines.join(" ")))
}

// Sets as `1-3,7`.
fn ranges(sets: &[SetRecord]) -> String {
    let texts = sets.chunk_by(|a, b| a.set + 1 == b.set).map(|run| {
        let (first, last) = (run[0].set, run[run.len() - 1].set);
        match first == last {
            true => first.to_string(),
            false => format!("{first}-{last}"),
        }
    });
    texts.collect::<Vec<_>>().join(",")
}

/// Q, calibrated Q and m of each set with errors, a series per configuration.
pub fn per_set_plot(rows: &[Named<'_>]) -> PanelGrid {
    let kinds = rows.iter().flat_map(|(_, sets)| *sets);
    let kinds: BTreeMap<u32, &SetRecord> = kinds.map(|own| (own.set, own)).collect();
    let name = |own: &SetRecord| {
        let kind = own.kind().map_or("", |kind| kind.image.label());
        format!("set {} {kind}", own.set).trim_end().to_owned()
    };
    let names: Vec<String> = kinds.values().map(|own| name(own)).collect();
    let numbers: Vec<u32> = kinds.into_keys().collect();
    let place = |set: u32| numbers.iter().position(|own| *own == set).unwrap_or(0) as f64;
    let panel = |key: &str, of: fn(&Metrics) -> f64| {
        let series = rows.iter().enumerate().map(|(k, (name, sets))| {
            // Side by side, so that points do not hide each other.
            let aside = 0.6 * ((k as f64 + 0.5) / rows.len() as f64 - 0.5);
            let x = sets.iter().map(|own| place(own.set) + aside).collect();
            let y = sets.iter().map(|own| of(&own.metrics)).collect();
            let errors = sets.iter().map(|own| of(&own.errors)).collect();
            Series::new(name, x, y, Style::Points, k).with_errors(errors)
        });
        LinePlot {
            y_label: columns_named(&[key])
                .iter()
                .map(|own| own.heading.to_owned())
                .collect(),
            x_names: names.clone(),
            series: series.collect(),
            ..LinePlot::default()
        }
    };
    PanelGrid {
        columns: 2,
        plots: vec![
            panel("q", |metrics| metrics.q),
            panel("q_calibrated", |metrics| metrics.q_calibrated),
            panel("m_cross", |metrics| metrics.m_cross),
        ],
        ..PanelGrid::default()
    }
}

/// The verdict on recorded runs, from the sets that all of them have.
pub fn verdict_on_runs(mut runs: Vec<RunRecord>) -> Option<String> {
    keep_common_sets(runs.iter_mut());
    let named = runs
        .iter()
        .map(|run| (run.name_with_id(), run.sets.as_slice()));
    verdict(&named.collect::<Vec<_>>())
}

pub fn verdict_line(name: &str, scored: &[ScoredSet]) -> Option<String> {
    let with_power = scored.iter().filter(|set| set.score.constant.is_none());
    let records: Vec<SetRecord> = with_power.map(|set| set.record.clone()).collect();
    verdict(&[(name.to_owned(), &records)])
}

// Chosen by hand: with few methods, a difference of 3σ by chance is rare enough for an advice.
const CLEAR_SIGMA: f64 = 3.0;
// Chosen by hand. More sets would fill lines.
const MAX_SETS_LISTED: usize = 3;

/// Which method to use, with the decisive metrics; for a single method, its metrics. `None` for a single method with an
/// unknown response.
pub fn verdict(methods: &[Named<'_>]) -> Option<String> {
    let calibrated = |sets: &[SetRecord]| mean(sets, |metrics| metrics.q_calibrated).0;
    let known = methods
        .iter()
        .enumerate()
        .filter(|(_, (_, sets))| !sets.is_empty() && calibrated(sets).is_finite());
    let best = known.max_by(|a, b| calibrated(a.1.1).total_cmp(&calibrated(b.1.1)));
    let Some((place, (name, sets))) = best else {
        return (methods.len() > 1).then(|| "Not enough data to rank the configurations.".into());
    };
    let shown = |metric: fn(&Metrics) -> f64, decimals: usize| {
        let (value, error) = mean(sets, metric);
        Cell::with_error(value, Some(error), decimals).in_words()
    };
    let rivals: Vec<&Named<'_>> = methods[..place]
        .iter()
        .chain(&methods[place + 1..])
        .collect();
    let (mut lower, mut equal, mut raised) = (String::new(), Vec::new(), Vec::new());
    for (other, others) in rivals {
        let lead = difference(Paired::Calibrated, others, sets);
        if let Some(lead) = lead {
            let by = Cell::with_error(lead.difference, Some(lead.error), 1).in_words();
            lower += &match lower.is_empty() {
                true => format!("; {other} is lower by {by}"),
                false => format!(", {other} by {by}"),
            };
        }
        // A method without a calibrated Q is not distinguished either.
        if !lead.is_some_and(|lead| lead.sigma() >= CLEAR_SIGMA) {
            equal.push(other.as_str());
        }
        // A method that loses shear and noise alike raises Q while noise dominates it.
        let of = |metric| mean(others, metric).0;
        if of(|metrics| metrics.q) > mean(sets, |metrics| metrics.q).0
            && of(|metrics| metrics.m_cross) < 0.0
        {
            raised.push(other.as_str());
        }
    }
    let lead = match (methods.len(), equal.is_empty()) {
        (1, _) => name.clone(),
        (_, true) => format!("Use {name}"),
        (_, false) => format!(
            "{name} has the highest Q calibrated, but these images do not distinguish it from {}",
            equal.join(" and ")
        ),
    };
    let warning = match raised.is_empty() {
        true => String::new(),
        false => format!(
            " Q itself is higher for {}, which lose shear and noise alike (m below zero). Real analyses cannot use this.",
            raised.join(" and ")
        ),
    };
    let noise = match sets.len() {
        1 => shown(|metrics| metrics.galaxy_noise, 3),
        2..=MAX_SETS_LISTED => {
            let noise = sets.iter().map(|set| {
                let error = Some(set.errors.galaxy_noise);
                let noise = Cell::with_error(set.metrics.galaxy_noise, error, 3).in_words();
                format!("{noise} in set {}", set.set)
            });
            noise.collect::<Vec<_>>().join(" and ")
        }
        many => format!(
            "{} (mean of {many} sets)",
            shown(|metrics| metrics.galaxy_noise, 3)
        ),
    };
    Some(format!(
        "{lead}: m = {}, noise per galaxy after calibration {noise}, and Q calibrated = {}{lower}.{warning}",
        shown(|metrics| metrics.m_cross, 2),
        shown(|metrics| metrics.q_calibrated, 1),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    // A method with one set of eight images, whose calibrated Q scatters as `replicates`.
    fn method(name: &str, q: f64, calibrated: f64, replicates: [f64; 8]) -> (String, SetRecord) {
        let with = |q, q_calibrated, m_cross| {
            let mut metrics = Metrics::unknown();
            (metrics.q, metrics.q_calibrated, metrics.m_cross) = (q, q_calibrated, m_cross);
            metrics
        };
        let record = SetRecord {
            images: (1..=8).collect(),
            metrics: with(q, calibrated, -0.3),
            errors: with(0.1, 2.0, 0.01),
            q_replicates: vec![q; 8],
            q_calibrated_replicates: replicates.map(|off| calibrated + off).to_vec(),
            ..SetRecord::unknown(2)
        };
        (name.into(), record)
    }

    fn verdict_on(methods: &[(String, SetRecord)]) -> Option<String> {
        let named = methods
            .iter()
            .map(|(name, set)| (name.clone(), std::slice::from_ref(set)));
        verdict(&named.collect::<Vec<_>>())
    }

    #[test]
    fn sets_are_names_and_keep_their_place_in_each_method() {
        let (name, first) = method("a", 12.0, 20.0, [0.0; 8]);
        let second = SetRecord {
            set: 8,
            ..first.clone()
        };
        let both = [first, second.clone()];
        let plot = per_set_plot(&[(name, &both), ("b".into(), &[second])]);
        assert_eq!(plot.plots.len(), 3);
        for panel in &plot.plots {
            assert!(panel.x_names[0].starts_with("set 2") && panel.x_names[1].starts_with("set 8"));
            let places = |k: usize| panel.series[k].points.iter().map(|point| point.x.round());
            assert_eq!(places(0).collect::<Vec<_>>(), [0.0, 1.0]);
            assert_eq!(places(1).collect::<Vec<_>>(), [1.0]);
        }
        let y = |k: usize| plot.plots[k].series[0].points[0].y;
        assert_eq!([0, 1, 2].map(y), [12.0, 20.0, -0.3]);
    }

    #[test]
    fn the_best_method_is_named_if_it_is_distinguished() {
        let common = [0.5, -0.5, 0.5, -0.5, 0.5, -0.5, 0.5, -0.5];
        let replicates = [0.7, -0.7, 0.3, -0.3, 0.7, -0.7, 0.3, -0.3];
        let better = method("b", 10.0, 25.0, replicates);
        // Common noise cancels: the error of the difference is √(7/8 · Σ 0.2²) = 0.53, although each error is 2.
        let clear = verdict_on(&[method("a", 12.0, 20.0, common), better.clone()]).unwrap();
        assert!(clear.starts_with("Use b: m = -0.300 ± 0.010"), "{clear}");
        assert!(
            clear.contains("Q calibrated = 25.0 ± 2.0; a is lower by 5.00 ± 0.53."),
            "{clear}"
        );
        assert!(
            clear.contains("Q itself is higher for a, which lose shear"),
            "{clear}"
        );
        let tied = verdict_on(&[method("a", 9.0, 24.0, common), better.clone()]).unwrap();
        let start =
            "b has the highest Q calibrated, but these images do not distinguish it from a: m";
        assert!(
            tied.starts_with(start) && !tied.contains("itself"),
            "{tied}"
        );
        let unknown = verdict_on(&[method("a", 9.0, f64::NAN, common), better]).unwrap();
        assert!(
            unknown.contains("do not distinguish it from a"),
            "{unknown}"
        );
        let blank = || method("a", 9.0, f64::NAN, common);
        let none = verdict_on(&[blank(), blank()]).unwrap();
        assert_eq!(none, "Not enough data to rank the configurations.");
        assert_eq!(verdict_on(&[blank()]), None);
        let alone = verdict_on(&[method("a", 9.0, 24.0, common)]).unwrap();
        assert!(alone.starts_with("a: m = -0.300 ± 0.010, noise"), "{alone}");
    }
}
