//! Runs of a store, or groups of their sets, in order.

use std::cmp::Ordering;
use std::str::FromStr;

use shearq_files::frames::TableError;
use shearq_files::frames::polars::AnyValue;
use shearq_scoring::Metrics;

use super::compare::mean_metric;
use super::row::{RunRecord, SetRecord, table_of};

/// Digits of a run's id in tables, as many as tell runs of a store apart.
const ID_DIGITS: usize = 8;

/// What the sets of a run are put together by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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

/// What runs are sorted by: `q:desc`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Order {
    field: String,
    descending: bool,
}

/// Fields beside the metrics that runs can be sorted by.
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
        if !SORTED.contains(&field) && Metrics::place(field).is_none() {
            return Err(format!(
                "a table cannot be sorted by `{field}`; expected one of {}, {}",
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
    /// Two runs in this order.
    pub(super) fn compare(&self, a: &RunRecord, b: &RunRecord) -> Ordering {
        let (a, b) = (Group::whole(a), Group::whole(b));
        in_order(&a.key(&self.field), &b.key(&self.field), self.descending)
    }
}

/// A run, or a group of its sets.
pub struct Group<'a> {
    /// The run.
    pub run: &'a RunRecord,
    /// The first digits of its id.
    pub id: String,
    /// What the group has in common: the value of the [`Grouping::column`].
    pub value: Option<AnyValue<'static>>,
    /// Its sets, in order.
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

    /// The groups of runs: rows of equal value stand together, and are in the order of `order`.
    ///
    /// # Errors
    /// Where polars cannot make a table of the runs.
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
        // The sort is stable: rows of a group are sorted first, and stay in that order.
        groups.sort_by(|a, b| in_order(&a.key(field), &b.key(field), descending));
        let of_groups = field == "group" && descending;
        groups.sort_by(|a, b| in_order(&a.key("group"), &b.key("group"), of_groups));
        Ok(groups)
    }

    /// The value sorted by.
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

    /// Images of all its sets.
    pub fn images(&self) -> usize {
        self.sets.iter().map(|set| set.images.len()).sum()
    }

    /// Submission and run.
    pub fn name(&self) -> String {
        format!("{} {}", self.run.configuration, self.id)
    }
}

/// Two values of one field in order; numbers that are none come last either way.
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
    fn numbers_that_are_none_come_last_either_way() {
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
