//! Conditions that choose rows of a results store.

use std::str::FromStr;

use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::frames::reals;

use super::row::{RunRecord, table_of};
use shearq_pipeline::PipelineError;

/// How a column is compared with a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Relation {
    Is,
    IsNot,
    Below,
    AtMost,
    Above,
    AtLeast,
}

/// Conditions on rows of a store, which must all be met: `snr=low,submission=23/*,q>50`.
///
/// A condition is a column, one of `=`, `!=`, `<`, `<=`, `>`, `>=`, and a value. `*` in a text stands
/// for any characters.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Conditions(Vec<(String, Relation, String)>);

impl FromStr for Conditions {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // Longer signs first: `<=` begins with `<`.
        const RELATIONS: [(&str, Relation); 6] = [
            ("!=", Relation::IsNot),
            ("<=", Relation::AtMost),
            (">=", Relation::AtLeast),
            ("<", Relation::Below),
            (">", Relation::Above),
            ("=", Relation::Is),
        ];
        let condition = |part: &str| {
            let at = part.find(['=', '<', '>', '!']);
            at.and_then(|at| {
                let (name, rest) = (part[..at].trim(), &part[at..]);
                let (sign, relation) = RELATIONS.iter().find(|(sign, _)| rest.starts_with(sign))?;
                let value = rest[sign.len()..].trim();
                (!name.is_empty()).then(|| (name.to_owned(), *relation, value.to_owned()))
            })
            .ok_or_else(|| {
                format!(
                    "not a condition (found `{part}`, expected a column, one of = != < <= > >=, and a value, such as `q>50`)"
                )
            })
        };
        text.split(',')
            .map(condition)
            .collect::<Result<_, _>>()
            .map(Conditions)
    }
}

impl Conditions {
    /// Keeps the sets of each run that meet all conditions, and drops runs without such a set.
    ///
    /// # Errors
    /// If a column does not exist, or a value has another type than its column.
    pub fn choose(&self, mut runs: Vec<RunRecord>) -> Result<Vec<RunRecord>, PipelineError> {
        let table = table_of(&runs).map_err(|error| PipelineError::Request(error.to_string()))?;
        let mut kept = vec![true; table.height()];
        for (name, relation, wanted) in &self.0 {
            let held = hold(column(&table, name)?, *relation, wanted)?;
            kept.iter_mut().zip(held).for_each(|(all, one)| *all &= one);
        }
        let mut kept = kept.into_iter();
        for run in &mut runs {
            run.sets.retain(|_| kept.next().unwrap_or(false));
        }
        runs.retain(|run| !run.sets.is_empty());
        Ok(runs)
    }
}

/// A column of the table of runs.
fn column<'a>(table: &'a DataFrame, name: &str) -> Result<&'a Column, PipelineError> {
    table.column(name).map_err(|_| {
        let names: Vec<&str> = table
            .get_column_names()
            .iter()
            .map(|n| n.as_str())
            .collect();
        let names = names.join(", ");
        PipelineError::Request(format!(
            "unknown column of a results store (found `{name}`, expected one of {names})"
        ))
    })
}

/// Whether a condition holds, for each value of a column.
fn hold(column: &Column, relation: Relation, wanted: &str) -> Result<Vec<bool>, PipelineError> {
    let name = column.name();
    if let Ok(texts) = column.str() {
        let holds: fn(&str, &str) -> bool = match relation {
            Relation::Is => matches,
            Relation::IsNot => |wanted, own| !matches(wanted, own),
            _ => {
                let message = format!("column `{name}` contains text; expected = or !=");
                return Err(PipelineError::Request(message));
            }
        };
        return Ok(texts
            .iter()
            .map(|own| holds(wanted, own.unwrap_or("")))
            .collect());
    }
    let wanted: f64 = wanted.parse().map_err(|_| {
        PipelineError::Request(format!(
            "column `{name}` contains numbers (found `{wanted}`, expected a number)"
        ))
    })?;
    let holds: fn(&f64, &f64) -> bool = match relation {
        Relation::Is => f64::eq,
        Relation::IsNot => f64::ne,
        Relation::Below => f64::lt,
        Relation::AtMost => f64::le,
        Relation::Above => f64::gt,
        Relation::AtLeast => f64::ge,
    };
    let values = reals(column).unwrap_or_default();
    Ok(values.iter().map(|own| holds(own, &wanted)).collect())
}

/// Whether `text` is `pattern`, in which `*` stands for any characters.
fn matches(pattern: &str, text: &str) -> bool {
    let Some((first, rest)) = pattern.split_once('*') else {
        return pattern == text;
    };
    let Some(text) = text.strip_prefix(first) else {
        return false;
    };
    // `*` may stand for any beginning of the remaining text.
    text.char_indices()
        .map(|(at, _)| at)
        .chain([text.len()])
        .any(|at| matches(rest, &text[at..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stars_stand_for_any_characters() {
        assert!(matches("23/*", "23/den/star") && matches("*star", "23/den/star"));
        assert!(matches("*/den/*", "subm/23/den/func") && matches("low", "low"));
        assert!(!matches("23/*", "subm/23/den/func") && !matches("low", "lower"));
        assert!(!matches("*star", "23/den/stars"));
    }

    #[test]
    fn conditions_are_parsed() {
        let conditions: Conditions = "snr=low, q>=50,psf!=fixed".parse().unwrap();
        let second = ("q".into(), Relation::AtLeast, "50".into());
        assert_eq!(conditions.0[1], second);
        for wrong in ["", "q", "=3", "q!5"] {
            assert!(wrong.parse::<Conditions>().is_err(), "{wrong}");
        }
    }
}
