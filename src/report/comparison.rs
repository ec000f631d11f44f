//! Submissions side by side: the means of their figures, differences in Q, and Q per set.

use std::collections::BTreeSet;

use ndarray::Array2;
use shearq_scoring::resample::{PairedDifference, PairedSet, mean_over_sets, paired_difference};
use shearq_scoring::{Definition, Figures};
use shearq_submissions::Published;

use super::figure::{ColourMap, HeatMap};
use super::scores::definition_note;
use super::table::{Cell, Heading, Table};
use crate::io::store::SetRecord;

/// One variant in a comparison.
pub struct Variant {
    /// Name of the submission.
    pub name: String,
    /// Its sets, in order.
    pub sets: Vec<SetRecord>,
    /// Published figures.
    pub published: Option<Published>,
    /// What readers of its figures should know.
    pub notes: Vec<String>,
}

/// Mean over sets of the figure called `name`, and its error.
pub fn mean_figure(sets: &[&SetRecord], name: &str) -> (f64, f64) {
    let value =
        |figures: &Figures| Figures::place(name).map_or(f64::NAN, |place| figures.values()[place]);
    let pairs: Vec<(f64, f64)> = sets
        .iter()
        .map(|set| (value(&set.figures), value(&set.errors)))
        .collect();
    mean_over_sets(&pairs)
}

/// The cell of a mean over sets of the figure called `name`.
pub fn mean_cell(sets: &[&SetRecord], name: &str) -> Cell {
    let (value, error) = mean_figure(sets, name);
    let decimals = Figures::place(name).map_or(0, |place| Figures::ALL[place].decimals);
    Cell::with_error(value, Some(error), decimals)
}

/// The heading of the figure called `name`.
pub fn figure_heading(name: &'static str) -> Heading {
    let label = Figures::place(name).map_or(name, |place| Figures::ALL[place].label);
    Heading::new(name, label)
}

/// The cell of the leaderboard's Q, the mean over sets.
pub fn leaderboard_cell(sets: &[&SetRecord]) -> Cell {
    let sum: f64 = sets.iter().map(|set| set.q_leaderboard).sum();
    Cell::number(sum / sets.len() as f64, 2)
}

/// Cells of a difference in Q and of its significance.
pub fn difference_cells(difference: Option<PairedDifference>) -> [Cell; 2] {
    [
        Cell::with_error(
            difference.map_or(f64::NAN, |d| d.difference),
            difference.map(|d| d.error),
            2,
        ),
        Cell::number(difference.map_or(f64::NAN, |d| d.sigma()), 1),
    ]
}

/// Variants side by side over the sets that all of them have, with the significance of each one's
/// difference in Q from the first, paired over the same images, and the published figures.
pub fn compare(variants: &[Variant], definition: Definition) -> Table {
    let common = common_sets(variants);
    let headings = vec![
        Heading::new("submission", "Submission"),
        figure_heading("q"),
        Heading::new("q_difference", "ΔQ to first"),
        Heading::new("sigma", "in σ"),
        Heading::new("q_leaderboard", "Q leaderboard"),
        Heading::new("q_published", "Q publ."),
        figure_heading("q_dn"),
        figure_heading("m_half"),
        Heading::new("m_half_published", "M/2 publ."),
        figure_heading("sqrt_a"),
        Heading::new("sqrt_a_published", "√A publ."),
        figure_heading("m_cross"),
    ];
    let mut rows = Vec::new();
    let mut unpaired = Vec::new();
    let mut first: Option<Vec<&SetRecord>> = None;
    for variant in variants {
        let sets: Vec<&SetRecord> = variant
            .sets
            .iter()
            .filter(|set| common.contains(&set.set))
            .collect();
        let difference = first.as_ref().and_then(|first| q_difference(first, &sets));
        if first.is_some() && difference.is_none() {
            unpaired.push(variant.name.as_str());
        }
        let published = |value: fn(&Published) -> f64, decimals: usize| {
            Cell::number(variant.published.as_ref().map_or(f64::NAN, value), decimals)
        };
        let [delta, sigma] = difference_cells(difference);
        rows.push(vec![
            Cell::text(&variant.name),
            mean_cell(&sets, "q"),
            delta,
            sigma,
            leaderboard_cell(&sets),
            published(|p| p.q, 2),
            mean_cell(&sets, "q_dn"),
            mean_cell(&sets, "m_half"),
            published(|p| p.m_half, 4),
            mean_cell(&sets, "sqrt_a"),
            published(|p| p.sqrt_a, 4),
            mean_cell(&sets, "m_cross"),
        ]);
        first.get_or_insert(sets);
    }
    let images: usize = first.iter().flatten().map(|set| set.images.len()).sum();
    let list: Vec<String> = common.iter().map(u32::to_string).collect();
    let mut notes = vec![
        format!("Means over sets {}; {images} images in all.", list.join(", ")),
        definition_note(definition),
        "ΔQ: jackknife of the paired difference on the same images. Published: 24 sets of 200 images of the challenge's own data, not comparable in absolute value.".into(),
    ];
    notes.extend(unpaired_note(&unpaired));
    for variant in variants {
        for line in &variant.notes {
            notes.push(format!("{}: {line}", variant.name));
        }
    }
    Table {
        title: "Comparison of submissions".into(),
        headings,
        rows,
        notes,
    }
}

/// Sets that all variants have.
fn common_sets(variants: &[Variant]) -> BTreeSet<u32> {
    let sets =
        |variant: &Variant| -> BTreeSet<u32> { variant.sets.iter().map(|set| set.set).collect() };
    variants
        .iter()
        .map(sets)
        .reduce(|all, more| &all & &more)
        .unwrap_or_default()
}

/// Why differences are absent, if any are.
pub fn unpaired_note(names: &[&str]) -> Option<String> {
    (!names.is_empty()).then(|| {
        format!(
            "No difference is given for {}: it needs at least two images, the same ones as the first, and conventions that are known.",
            names.join(", ")
        )
    })
}

/// Paired difference in Q of `second` from `first`; `None` where they are not of the same sets, data
/// and images, or where noise may have chosen the convention of either.
pub fn q_difference(first: &[&SetRecord], second: &[&SetRecord]) -> Option<PairedDifference> {
    let same = |(a, b): (&&SetRecord, &&SetRecord)| {
        let known = a.convention_known && b.convention_known;
        known && a.set == b.set && a.data == b.data && a.images == b.images
    };
    if first.len() != second.len() || !first.iter().zip(second).all(same) {
        return None;
    }
    let pairs: Vec<PairedSet<'_>> = first
        .iter()
        .zip(second)
        .map(|(a, b)| PairedSet {
            images: a.images.len(),
            first: a.figures.q,
            first_replicates: &a.q_replicates,
            second: b.figures.q,
            second_replicates: &b.q_replicates,
        })
        .collect();
    paired_difference(&pairs)
}

/// Q of each set (column) and variant (row), and means over each row.
pub fn q_heat_map(variants: &[(String, Vec<&SetRecord>)]) -> HeatMap {
    let sets: BTreeSet<u32> = variants
        .iter()
        .flat_map(|(_, sets)| sets.iter().map(|set| set.set))
        .collect();
    let mut columns: Vec<String> = sets.iter().map(u32::to_string).collect();
    columns.push("mean".into());
    let mut values = Array2::from_elem((variants.len(), columns.len()), f64::NAN);
    for (mut row, (_, own)) in values.rows_mut().into_iter().zip(variants) {
        for (value, set) in row.iter_mut().zip(&sets) {
            *value = own
                .iter()
                .find(|own| own.set == *set)
                .map_or(f64::NAN, |own| own.figures.q);
        }
        row[sets.len()] = mean_figure(own, "q").0;
    }
    HeatMap {
        title: "Quality factor per set".into(),
        row_label: "submission".into(),
        column_label: "set".into(),
        rows: variants.iter().map(|(name, _)| name.clone()).collect(),
        columns,
        values,
        decimals: 1,
        value_label: "Q".into(),
        map: ColourMap::Viridis,
    }
}
