//! Runs of a store, or groups of their sets, in sorted order.

use std::cmp::Ordering;
use std::str::FromStr;

use shearq_files::frames::TableError;
use shearq_files::frames::polars::AnyValue;
use shearq_scoring::Metrics;

use super::row::{RunRecord, SetRecord, mean_metric, table_of};

/// Digits of a run's id in tables, enough to distinguish the runs of a store.
const ID_DIGITS: usize = 8;

/// How the sets of a run are grouped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Grouping {
    /// Each set by itself.
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
    /// The column of the store whose values define the groups.
    pub fn column(self) -> &'static str {
        match self {
            Grouping::Set => "set",
            Grouping::SetKind => "set_kind",
            Grouping::Psf => "psf",
            Grouping::Snr => "snr",
            Grouping::Size => "size",
        }
    }
}

/// Field and direction of sorting: `q:desc`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Order {
    field: String,
    descending: bool,
}

/// Fields other than metrics to sort by.
const SORTED: [&str; 5] = ["submission", "run", "version", "group", "images"];

impl FromStr for Order {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (field, descending) = match text.split_once(':') {
            None | Some((_, "asc")) => (text.trim_end_matches(":asc"), false),
            Some((field, "desc")) => (field, true),
            Some((_, other)) => {
                return Err(format!(
                    "unknown order (found `{other}`, expected `asc` or `desc`)"
                ));
            }
        };
        if !SORTED.contains(&field) && Metrics::place(field).is_none() {
            return Err(format!(
                "cannot sort by `{field}`; expected one of {}, {}",
                SORTED.join(", "),
                Metrics::ALL.map(|metric| metric.name).join(", ")
            ));
        }
        Ok(Order {
            field: field.to_owned(),
            descending,
        })
    }
}

impl Order {
    /// Compares two runs.
    pub(super) fn compare(&self, a: &RunRecord, b: &RunRecord) -> Ordering {
        let (a, b) = (Group::whole(a), Group::whole(b));
        in_order(&a.key(&self.field), &b.key(&self.field), self.descending)
    }
}

/// A run, or a group of its sets.
#[derive(Debug, Clone)]
pub struct Group<'a> {
    /// The run.
    pub run: &'a RunRecord,
    /// First digits of the run's id.
    pub id: String,
    /// The common value of the [`Grouping::column`].
    pub value: Option<AnyValue<'static>>,
    /// Sets in ascending order.
    pub sets: Vec<&'a SetRecord>,
}

impl<'a> Group<'a> {
    /// A whole run.
    fn whole(run: &'a RunRecord) -> Self {
        Group {
            run,
            id: run.id(),
            value: None,
            sets: run.sets.iter().collect(),
        }
    }

    /// The groups of runs. Groups of equal value are adjacent and sorted by `order`.
    ///
    /// # Errors
    /// If polars cannot make a table of the runs.
    pub fn of(
        runs: &'a [RunRecord],
        grouping: Option<Grouping>,
        order: Option<&Order>,
    ) -> Result<Vec<Self>, TableError> {
        let table = table_of(runs)?;
        let column = grouping.and_then(|grouping| table.column(grouping.column()).ok());
        let mut groups: Vec<Group<'_>> = Vec::new();
        let mut row = 0;
        for run in runs {
            let mut id = run.id();
            id.truncate(ID_DIGITS);
            for set in &run.sets {
                let value = column.and_then(|column| Some(column.get(row).ok()?.into_static()));
                row += 1;
                let alike =
                    |group: &&mut Group<'_>| std::ptr::eq(group.run, run) && group.value == value;
                match groups.iter_mut().find(alike) {
                    Some(group) => group.sets.push(set),
                    None => groups.push(Group {
                        run,
                        id: id.clone(),
                        value,
                        sets: vec![set],
                    }),
                }
            }
        }
        let (field, descending) =
            order.map_or(("group", false), |o| (o.field.as_str(), o.descending));
        // The second sort is stable, so it keeps the order within a group.
        groups.sort_by(|a, b| in_order(&a.key(field), &b.key(field), descending));
        let of_groups = field == "group" && descending;
        groups.sort_by(|a, b| in_order(&a.key("group"), &b.key("group"), of_groups));
        Ok(groups)
    }

    /// The value to sort by.
    fn key(&self, field: &str) -> AnyValue<'_> {
        match field {
            "submission" => AnyValue::String(&self.run.configuration),
            "run" => AnyValue::String(&self.id),
            "version" => AnyValue::String(&self.run.version),
            "group" => self.value.clone().unwrap_or(AnyValue::Null),
            "images" => AnyValue::UInt64(self.images() as u64),
            metric => AnyValue::Float64(mean_metric(&self.sets, metric).0),
        }
    }

    /// Number of images of all sets.
    pub fn images(&self) -> usize {
        self.sets.iter().map(|set| set.images.len()).sum()
    }

    /// Names of configuration and run.
    pub fn name(&self) -> String {
        format!("{} {}", self.run.configuration, self.id)
    }
}

/// Compares two values of a field. NaN comes last in both directions.
fn in_order(a: &AnyValue<'_>, b: &AnyValue<'_>, descending: bool) -> Ordering {
    let nan = |value: &AnyValue<'_>| matches!(value, AnyValue::Float64(x) if x.is_nan());
    let order = a.partial_cmp(b).unwrap_or(Ordering::Equal);
    nan(a).cmp(&nan(b)).then(match descending {
        true => order.reverse(),
        false => order,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_are_checked() {
        assert!("q:desc".parse::<Order>().unwrap().descending);
        assert!("q:down".parse::<Order>().is_err() && "colour".parse::<Order>().is_err());
    }

    #[test]
    fn nan_comes_last_in_both_directions() {
        let (one, two, none) = (1.0, 2.0, f64::NAN);
        for (a, b, descending, expected) in [
            (one, two, false, Ordering::Less),
            (one, two, true, Ordering::Greater),
            (none, two, false, Ordering::Greater),
            (none, two, true, Ordering::Greater),
            (one, none, true, Ordering::Less),
            (none, none, true, Ordering::Equal),
        ] {
            let found = in_order(&AnyValue::Float64(a), &AnyValue::Float64(b), descending);
            assert_eq!(found, expected, "{a} {b} {descending}");
        }
    }
}
