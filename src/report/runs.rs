//! Runs of a results store side by side: sorted, grouped, as a table and as a heat map.

use std::cmp::Ordering;
use std::str::FromStr;

use clap::ValueEnum;
use shearq_scoring::Figures;

use super::comparison::{
    difference_cells, figure_heading, leaderboard_cell, mean_cell, mean_figure, q_difference,
    q_heat_map, unpaired_note,
};
use super::figure::HeatMap;
use super::table::{Cell, Heading, Table};
use crate::io::store::{RunRecord, SetRecord, Value, column};

/// Digits of a run's id in tables, as many as tell runs of a store apart.
const ID_DIGITS: usize = 8;

/// What the sets of a run are put together by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Grouping {
    /// Each set alone.
    Set,
    /// The kinds of the paper's Table 2.
    SetKind,
    /// Fixed or variable PSF.
    Psf,
    /// Class of S/N.
    Snr,
    /// Class of galaxy sizes.
    Size,
}

impl Grouping {
    /// The column of the store that tells groups apart.
    fn column(self) -> &'static str {
        match self {
            Grouping::Set => "set",
            Grouping::SetKind => "set_kind",
            Grouping::Psf => "psf",
            Grouping::Snr => "snr",
            Grouping::Size => "size",
        }
    }

    fn label(self) -> &'static str {
        match self {
            Grouping::Set => "Set",
            Grouping::SetKind => "Kind",
            Grouping::Psf => "PSF",
            Grouping::Snr => "S/N",
            Grouping::Size => "Size",
        }
    }
}

/// What a table of runs is sorted by: `q:desc`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Order {
    field: String,
    descending: bool,
}

/// Fields beside the figures that a table can be sorted by.
const SORTED: [&str; 5] = ["submission", "run", "version", "group", "images"];

impl FromStr for Order {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (field, descending) = match text.split_once(':') {
            None | Some((_, "asc")) => (text.trim_end_matches(":asc"), false),
            Some((field, "desc")) => (field, true),
            Some((_, other)) => {
                return Err(format!("`{other}` is no order; expected `asc` or `desc`"));
            }
        };
        if !SORTED.contains(&field) && Figures::place(field).is_none() {
            return Err(format!(
                "a table cannot be sorted by `{field}`; expected one of {}, {}",
                SORTED.join(", "),
                Figures::ALL.map(|figure| figure.name).join(", ")
            ));
        }
        Ok(Order {
            field: field.to_owned(),
            descending,
        })
    }
}

/// One row of the table: a run, or a group of its sets.
struct Entry<'a> {
    run: &'a RunRecord,
    id: String,
    group: Option<Value>,
    sets: Vec<&'a SetRecord>,
}

impl Entry<'_> {
    /// The value sorted by.
    fn key(&self, field: &str) -> Value {
        match field {
            "submission" => Value::Text(self.run.submission.clone()),
            "run" => Value::Text(self.id.clone()),
            "version" => Value::Text(self.run.version.clone()),
            "group" => self.group.clone().unwrap_or(Value::Count(0)),
            "images" => Value::Count(self.images() as u64),
            figure => Value::Real(mean_figure(&self.sets, figure).0),
        }
    }

    fn images(&self) -> usize {
        self.sets.iter().map(|set| set.images.len()).sum()
    }

    fn name(&self) -> String {
        format!("{} {}", self.run.submission, self.id)
    }
}

/// Two values of one field in order; numbers that are none come last either way.
fn compare_values(a: &Value, b: &Value, descending: bool) -> Ordering {
    let way = |order: Ordering| if descending { order.reverse() } else { order };
    match (a, b) {
        (Value::Text(a), Value::Text(b)) => way(a.cmp(b)),
        (Value::Count(a), Value::Count(b)) => way(a.cmp(b)),
        (Value::Real(a), Value::Real(b)) => a
            .is_nan()
            .cmp(&b.is_nan())
            .then_with(|| way(a.total_cmp(b))),
        _ => Ordering::Equal,
    }
}

/// The first digits of a run's id.
fn short_id(run: &RunRecord) -> String {
    let mut id = run.id();
    id.truncate(ID_DIGITS);
    id
}

/// Runs side by side: means over their sets, or over groups of them, and the difference in Q from
/// the first row, or the first of the same group, on the same images.
pub fn compare_runs(runs: &[RunRecord], group: Option<Grouping>, order: Option<&Order>) -> Table {
    let mut entries: Vec<Entry<'_>> = Vec::new();
    for run in runs {
        for set in &run.sets {
            let own = group.and_then(|group| column(&run.row(set), group.column()).cloned().ok());
            let id = short_id(run);
            match entries
                .iter_mut()
                .find(|e| std::ptr::eq(e.run, run) && e.group == own)
            {
                Some(entry) => entry.sets.push(set),
                None => entries.push(Entry {
                    run,
                    id,
                    group: own,
                    sets: vec![set],
                }),
            }
        }
    }
    // Groups stand together unless another order is asked for; the sort is stable.
    let (field, descending) = order.map_or(("group", false), |o| (o.field.as_str(), o.descending));
    entries.sort_by(|a, b| compare_values(&a.key(field), &b.key(field), descending));
    let mut headings = vec![
        Heading::new("submission", "Submission"),
        Heading::new("run", "Run"),
        Heading::new("version", "Version").detail(),
    ];
    headings.extend(group.map(|group| Heading::new(group.column(), group.label())));
    headings.extend([
        Heading::new("sets", "Sets"),
        Heading::new("images", "Images"),
        figure_heading("q"),
        Heading::new("q_difference", "ΔQ to first"),
        Heading::new("sigma", "in σ"),
        Heading::new("q_leaderboard", "Q leaderboard"),
        figure_heading("q_dn"),
        figure_heading("m_half"),
        figure_heading("sqrt_a"),
        figure_heading("m_cross"),
    ]);
    let mut rows = Vec::new();
    let mut unpaired = Vec::new();
    for (k, entry) in entries.iter().enumerate() {
        let first = entries[..k].iter().find(|e| e.group == entry.group);
        let difference = first
            .filter(|first| first.run.definition == entry.run.definition)
            .and_then(|first| q_difference(&first.sets, &entry.sets));
        if first.is_some() && difference.is_none() && !unpaired.contains(&entry.id.as_str()) {
            unpaired.push(entry.id.as_str());
        }
        let mut row = vec![
            Cell::text(&entry.run.submission),
            Cell::text(&entry.id),
            Cell::text(&entry.run.version),
        ];
        row.extend(entry.group.as_ref().map(|group| match group {
            Value::Text(words) => Cell::text(words),
            Value::Count(number) => Cell::number(*number as f64, 0),
            Value::Real(number) => Cell::number(*number, 4),
        }));
        row.extend([
            Cell::text(ranges(&entry.sets)),
            Cell::number(entry.images() as f64, 0),
            mean_cell(&entry.sets, "q"),
        ]);
        row.extend(difference_cells(difference));
        row.extend([
            leaderboard_cell(&entry.sets),
            mean_cell(&entry.sets, "q_dn"),
            mean_cell(&entry.sets, "m_half"),
            mean_cell(&entry.sets, "sqrt_a"),
            mean_cell(&entry.sets, "m_cross"),
        ]);
        rows.push(row);
    }
    Table {
        title: "Recorded runs".into(),
        headings,
        rows,
        notes: notes(runs, group, &unpaired),
    }
}

fn notes(runs: &[RunRecord], group: Option<Grouping>, unpaired: &[&str]) -> Vec<String> {
    let mut ways: Vec<String> = runs
        .iter()
        .map(|run| {
            format!(
                "{} definition, {} convention, noise {}",
                run.definition, run.choice, run.noise
            )
        })
        .collect();
    ways.sort();
    ways.dedup();
    let mut notes = vec![format!(
        "Means over the sets of each row. Figures: {}. √A in 10⁻⁴ for C_ℓ in steradian.",
        ways.join("; ")
    )];
    if group.is_some() {
        notes.push("ΔQ: from the first row of the same group.".into());
    }
    if ways.len() > 1 {
        notes.push("Warning: these runs were scored in different ways; choose one with --where definition=... or choice=...".into());
    }
    notes.extend(unpaired_note(unpaired));
    notes
}

/// Sets as `1-3,7`.
fn ranges(sets: &[&SetRecord]) -> String {
    let mut parts: Vec<(u32, u32)> = Vec::new();
    for set in sets {
        match parts.last_mut() {
            Some((_, last)) if *last + 1 == set.set => *last = set.set,
            _ => parts.push((set.set, set.set)),
        }
    }
    let texts: Vec<String> = parts
        .iter()
        .map(|(first, last)| match last - first {
            0 => first.to_string(),
            _ => format!("{first}-{last}"),
        })
        .collect();
    texts.join(",")
}

/// Q of each run (row) and set (column), runs in the order given or by their mean figure.
pub fn runs_heat_map(runs: &[RunRecord], order: Option<&Order>) -> HeatMap {
    let mut entries: Vec<Entry<'_>> = runs
        .iter()
        .map(|run| Entry {
            run,
            id: short_id(run),
            group: None,
            sets: run.sets.iter().collect(),
        })
        .collect();
    if let Some(order) = order {
        entries.sort_by(|a, b| {
            let (a, b) = (a.key(&order.field), b.key(&order.field));
            compare_values(&a, &b, order.descending)
        });
    }
    let rows: Vec<(String, Vec<&SetRecord>)> = entries
        .into_iter()
        .map(|entry| (entry.name(), entry.sets))
        .collect();
    q_heat_map(&rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_are_checked() {
        assert!("q:desc".parse::<Order>().unwrap().descending);
        assert!("q:down".parse::<Order>().is_err() && "colour".parse::<Order>().is_err());
    }
}
