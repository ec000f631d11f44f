//! Tables of configurations and recorded runs: mean metrics, differences in Q and calibrated Q, and Q per set.

use std::borrow::Borrow;
use std::collections::BTreeSet;

use ndarray::Array2;
use shearq_files::frames::polars::AnyValue;
use shearq_scoring::resample::PairedDifference;
use shearq_scoring::{Definition, Fault, Metrics};
use shearq_submissions::Published;

use crate::compare::{Paired, Variant, by_name, common_sets, difference};
use crate::groups::{Group, Grouping};
use crate::row::mean_metric;
use crate::row::{RunRecord, SetRecord};
use crate::views::diagnosis::of_sets;
use crate::views::metrics::{metric_cell, metric_heading};
use crate::views::scores::{best_is_another, definition_note, notes, zero_shear_note};
use crate::views::verdict::verdict;
use shearq_render::figure::{ColourMap, HeatMap};
use shearq_render::table::{Cell, Heading, Table};

/// The cell with the mean of the metric called `name` over sets.
fn mean_cell(sets: &[&SetRecord], name: &str) -> Cell {
    let (value, error) = mean_metric(sets, name);
    metric_cell(name, value, error)
}

/// Heading of the leaderboard's Q, a detail if it equals Q.
fn leaderboard_heading<'a>(sets: impl Iterator<Item = &'a SetRecord>) -> Heading {
    let differs = sets
        .into_iter()
        .any(|set| best_is_another(set.q_leaderboard, set.metrics.q));
    Heading {
        detail: !differs,
        ..Heading::new("q_leaderboard", "Q leaderboard")
    }
}

/// The cell with the mean of the leaderboard's Q over sets.
fn leaderboard_cell(sets: &[&SetRecord]) -> Cell {
    let sum: f64 = sets.iter().map(|set| set.q_leaderboard).sum();
    Cell::number(sum / sets.len() as f64, 2)
}

/// Differences in Q and calibrated Q from the first variant; `None` for the first variant.
type Differences = Option<[Option<PairedDifference>; 2]>;

/// Differences in Q and calibrated Q, `sets` minus `first`.
fn differences<R: Borrow<SetRecord>>(first: &[R], sets: &[R]) -> [Option<PairedDifference>; 2] {
    [Paired::Q, Paired::Calibrated].map(|metric| difference(metric, first, sets))
}

/// Headings of Q and calibrated Q, each with difference and significance.
fn q_headings() -> [Heading; 6] {
    [
        metric_heading("q"),
        Heading::new("q_difference", "ΔQ to first"),
        Heading::new("sigma", "in σ"),
        metric_heading("q_calibrated"),
        Heading::new("q_calibrated_difference", "ΔQ cal."),
        Heading::new("q_calibrated_sigma", "in σ"),
    ]
}

/// Cells of Q and calibrated Q, each with difference and significance.
fn q_cells(sets: &[&SetRecord], differences: Differences) -> Vec<Cell> {
    let differences = differences.unwrap_or_default();
    let of = |(name, found): (&str, Option<PairedDifference>)| {
        [
            mean_cell(sets, name),
            Cell::with_error(
                found.map_or(f64::NAN, |d| d.difference),
                found.map(|d| d.error),
                2,
            ),
            Cell::number(found.map_or(f64::NAN, |d| d.sigma()), 1),
        ]
    };
    ["q", "q_calibrated"]
        .into_iter()
        .zip(differences)
        .flat_map(of)
        .collect()
}

/// Why differences are absent for the variants `names`.
fn unpaired_note(names: &[&str]) -> Option<String> {
    (!names.is_empty()).then(|| {
        format!(
            "No difference for {}: differences need equal images, one definition and certain conventions.",
            names.join(", ")
        )
    })
}

/// Variants side by side: means over their common sets, differences in Q from the first variant, paired over equal
/// images, and published metrics.
pub fn compare(variants: &[Variant], definition: Definition) -> Table {
    let records: Vec<Vec<SetRecord>> = variants.iter().map(Variant::records).collect();
    let common = common_sets(&records);
    let mut headings = vec![Heading::new("submission", "Configuration")];
    headings.extend(q_headings());
    headings.extend([
        metric_heading("galaxy_noise"),
        metric_heading("m_cross"),
        leaderboard_heading(records.iter().flatten()),
        metric_heading("q_dn"),
        metric_heading("m_half"),
        metric_heading("sqrt_a"),
        Heading::new("q_published", "Q publ."),
        Heading::new("m_half_published", "M/2 publ."),
        Heading::new("sqrt_a_published", "√A publ."),
    ]);
    let shown: Vec<&str> = headings.iter().map(|heading| heading.key).collect();
    let others = || {
        Metrics::ALL
            .iter()
            .filter(|metric| !shown.contains(&metric.name))
    };
    let mut headings = headings.clone();
    headings.extend(others().map(|metric| metric_heading(metric.name).detail()));
    let mut rows = Vec::new();
    let mut unpaired = Vec::new();
    let mut first: Option<Vec<&SetRecord>> = None;
    for (variant, records) in variants.iter().zip(&records) {
        let sets: Vec<&SetRecord> = records
            .iter()
            .filter(|set| common.contains(&set.set))
            .collect();
        let differences = first.as_ref().map(|first| differences(first, &sets));
        if matches!(differences, Some([None, _])) {
            unpaired.push(variant.name.as_str());
        }
        let published = |value: fn(&Published) -> f64, decimals: usize| {
            Cell::number(variant.published.as_ref().map_or(f64::NAN, value), decimals)
        };
        let mut row = vec![Cell::text(&variant.name)];
        row.extend(q_cells(&sets, differences));
        row.extend([
            mean_cell(&sets, "galaxy_noise"),
            mean_cell(&sets, "m_cross"),
            leaderboard_cell(&sets),
            mean_cell(&sets, "q_dn"),
            mean_cell(&sets, "m_half"),
            mean_cell(&sets, "sqrt_a"),
            published(|p| p.q, 2),
            published(|p| p.m_half, 4),
            published(|p| p.sqrt_a, 4),
        ]);
        row.extend(others().map(|metric| mean_cell(&sets, metric.name)));
        rows.push(row);
        first.get_or_insert(sets);
    }
    let images: usize = first.iter().flatten().map(|set| set.images.len()).sum();
    let list: Vec<String> = common.iter().map(u32::to_string).collect();
    let mut lines = vec![
        match list.as_slice() {
            [one] => format!("Set {one}; {images} images."),
            _ => format!("Means over sets {}; {images} images in all.", list.join(", ")),
        },
        definition_note(definition),
        "ΔQ, ΔQ cal.: difference from the first row on the same images, with a jackknife error if each set has eight images or more.".into(),
    ];
    if variants.iter().any(|variant| variant.published.is_some()) {
        lines.push("Published: for the challenge's 24 sets of 200 images, not comparable in absolute value.".into());
    }
    lines.extend(unpaired_note(&unpaired));
    lines.extend(notes_of_variants(variants));
    lines.extend(verdict(&by_name(variants)));
    Table {
        title: "Comparison of configurations".into(),
        headings,
        rows,
        notes: lines,
    }
}

/// Notes on the sets of each variant. A note on several variants appears once, with their names.
pub fn notes_of_variants(variants: &[Variant]) -> Vec<String> {
    let mut found: Vec<(String, Vec<&str>)> = Vec::new();
    for variant in variants {
        for line in notes(&variant.sets).iter().chain(&variant.unscored) {
            match found.iter_mut().find(|(known, _)| known == line) {
                Some((_, names)) => names.push(&variant.name),
                None => found.push((line.clone(), vec![&variant.name])),
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

/// The metrics that decide between variants: Q, calibrated Q, m and noise, as means over their common sets.
pub fn compact(variants: &[Variant]) -> Table {
    const METRICS: [&str; 4] = ["q", "q_calibrated", "m_cross", "galaxy_noise"];
    let records: Vec<Vec<SetRecord>> = variants.iter().map(Variant::records).collect();
    let common = common_sets(&records);
    let mut headings = vec![Heading::new("submission", "Configuration")];
    headings.extend(METRICS.map(metric_heading));
    let rows = variants.iter().zip(&records).map(|(variant, records)| {
        let sets: Vec<&SetRecord> = records
            .iter()
            .filter(|set| common.contains(&set.set))
            .collect();
        let mut row = vec![Cell::text(&variant.name)];
        row.extend(METRICS.map(|name| mean_cell(&sets, name)));
        row
    });
    let list: Vec<String> = common.iter().map(u32::to_string).collect();
    let images: usize = records
        .first()
        .into_iter()
        .flatten()
        .map(|set| set.images.len())
        .sum();
    Table {
        title: "Comparison of configurations".into(),
        headings,
        rows: rows.collect(),
        notes: vec![
            format!(
                "Means over the simulated sets {}; {images} images. ± is a standard error.",
                list.join(", ")
            ),
            "Q: the challenge's score. Q cal.: Q after division by the response.".into(),
            "m: multiplicative bias. noise: scatter per galaxy and component.".into(),
        ]
        .into_iter()
        .chain(highest_q(variants).and_then(|best| zero_shear_note(&best.sets)))
        .collect(),
    }
}

/// The variant with the highest mean Q.
fn highest_q(variants: &[Variant]) -> Option<&Variant> {
    let q = |variant: &Variant| mean_metric(&variant.records(), "q").0;
    variants.iter().max_by(|a, b| q(a).total_cmp(&q(b)))
}

/// Runs side by side: means over sets or groups of sets, and the difference in Q from the first row, or the first row
/// of the group, on the same images.
pub fn compare_runs(runs: &[RunRecord], groups: &[Group<'_>], grouping: Option<Grouping>) -> Table {
    let mut headings = vec![
        Heading::new("submission", "Configuration"),
        Heading::new("run", "Run"),
        Heading::new("version", "Version").detail(),
    ];
    headings.extend(grouping.map(|grouping| {
        let label = match grouping {
            Grouping::Set => "Set",
            Grouping::SetKind => "Kind",
            Grouping::Psf => "PSF",
            Grouping::Snr => "S/N",
            Grouping::Size => "Size",
        };
        Heading::new(grouping.column(), label)
    }));
    headings.extend([
        Heading::new("sets", "Sets"),
        Heading::new("images", "Images"),
    ]);
    headings.extend(q_headings());
    headings.extend([
        metric_heading("galaxy_noise"),
        metric_heading("m_cross"),
        leaderboard_heading(groups.iter().flat_map(|group| group.sets.iter().copied())),
        metric_heading("q_dn"),
        metric_heading("m_half"),
        metric_heading("sqrt_a"),
    ]);
    let mut rows = Vec::new();
    let mut unpaired = Vec::new();
    for (k, group) in groups.iter().enumerate() {
        let first = groups[..k].iter().find(|other| other.value == group.value);
        let differences = first.map(|first| match first.run.definition == group.run.definition {
            true => differences(&first.sets, &group.sets),
            false => [None; 2],
        });
        if matches!(differences, Some([None, _])) && !unpaired.contains(&group.id.as_str()) {
            unpaired.push(group.id.as_str());
        }
        let mut row = vec![
            Cell::text(&group.run.configuration),
            Cell::text(&group.id),
            Cell::text(&group.run.version),
        ];
        row.extend(group.value.clone().map(|value| match value {
            AnyValue::Int64(number) => Cell::number(number as f64, 0),
            words => Cell::text(words.get_str().unwrap_or_default()),
        }));
        row.extend([
            Cell::text(ranges(&group.sets)),
            Cell::number(group.images() as f64, 0),
        ]);
        row.extend(q_cells(&group.sets, differences));
        row.extend([
            mean_cell(&group.sets, "galaxy_noise"),
            mean_cell(&group.sets, "m_cross"),
            leaderboard_cell(&group.sets),
            mean_cell(&group.sets, "q_dn"),
            mean_cell(&group.sets, "m_half"),
            mean_cell(&group.sets, "sqrt_a"),
        ]);
        rows.push(row);
    }
    Table {
        title: "Recorded runs".into(),
        headings,
        rows,
        notes: run_notes(runs, groups, grouping, &unpaired),
    }
}

fn run_notes(
    runs: &[RunRecord],
    groups: &[Group<'_>],
    grouping: Option<Grouping>,
    unpaired: &[&str],
) -> Vec<String> {
    let ways: BTreeSet<String> = runs
        .iter()
        .map(|run| {
            format!(
                "{} definition, {} convention, noise {}",
                run.definition, run.choice, run.noise
            )
        })
        .collect();
    let several = ways.len() > 1;
    let ways: Vec<String> = ways.into_iter().collect();
    let mut notes = vec![format!(
        "Means over the sets of each row. Metrics: {}. √A in 10⁻⁴ for C_ℓ in steradian.",
        ways.join("; ")
    )];
    if grouping.is_some() {
        notes.push("ΔQ, ΔQ cal.: difference from the first row of the group.".into());
    }
    if several {
        notes.push("warning: the runs were scored in different ways and cannot be compared. Try: --where definition=… or choice=…".into());
    }
    notes.extend(unpaired_note(unpaired));
    for run in runs {
        notes.extend(bias_note(run));
    }
    if grouping.is_none() {
        let runs: Vec<(String, Vec<SetRecord>)> = groups
            .iter()
            .map(|group| {
                (
                    group.name(),
                    group.sets.iter().map(|&set| set.clone()).collect(),
                )
            })
            .collect();
        let sets: Vec<Vec<SetRecord>> = runs.iter().map(|(_, sets)| sets.clone()).collect();
        let common = common_sets(&sets);
        let of_common = |(name, mut sets): (String, Vec<SetRecord>)| {
            sets.retain(|set| common.contains(&set.set));
            (name, sets)
        };
        let runs: Vec<_> = runs.into_iter().map(of_common).collect();
        notes.extend(verdict(&runs));
    }
    notes
}

/// A warning about sets of a recorded run with a large multiplicative bias.
fn bias_note(run: &RunRecord) -> Option<String> {
    let findings: Vec<(Option<u32>, Vec<Fault>)> = run
        .sets
        .iter()
        .map(|set| {
            let finding = Fault::of_bias(set.metrics.m_cross, set.errors.m_cross);
            (Some(set.set), finding.into_iter().collect())
        })
        .collect();
    let lines = of_sets(findings.iter().map(|(set, found)| (*set, found.as_slice())));
    (!lines.is_empty()).then(|| format!("{}: {}", run.configuration, lines.join(" ")))
}

/// Sets as `1-3,7`.
fn ranges(sets: &[&SetRecord]) -> String {
    let texts = sets.chunk_by(|a, b| a.set + 1 == b.set).map(|run| {
        let (first, last) = (run[0].set, run[run.len() - 1].set);
        match first == last {
            true => first.to_string(),
            false => format!("{first}-{last}"),
        }
    });
    texts.collect::<Vec<_>>().join(",")
}

/// Q of each set (column) and variant or run (row), with means in the last column.
pub fn q_heat_map<R: Borrow<SetRecord>>(variants: &[(String, Vec<R>)]) -> HeatMap {
    let sets: BTreeSet<u32> = variants
        .iter()
        .flat_map(|(_, sets)| sets.iter().map(|set| set.borrow().set))
        .collect();
    let mut columns: Vec<String> = sets.iter().map(u32::to_string).collect();
    columns.push("mean".into());
    let mut values = Array2::from_elem((variants.len(), columns.len()), f64::NAN);
    for (mut row, (_, own)) in values.rows_mut().into_iter().zip(variants) {
        for (value, set) in row.iter_mut().zip(&sets) {
            *value = own
                .iter()
                .map(Borrow::borrow)
                .find(|own| own.set == *set)
                .map_or(f64::NAN, |own| own.metrics.q);
        }
        row[sets.len()] = mean_metric(own, "q").0;
    }
    let most = values.iter().copied().fold(f64::NAN, f64::max);
    HeatMap {
        title: "Quality factor per set".into(),
        row_label: "configuration".into(),
        column_label: "set".into(),
        rows: variants.iter().map(|(name, _)| name.clone()).collect(),
        columns,
        values,
        decimals: if most < 10.0 { 2 } else { 1 },
        value_label: "Q".into(),
        map: ColourMap::Viridis,
    }
}
