//! Which rows of a results store to look at.

use std::str::FromStr;

use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::frames::reals;

use super::row::{RunRecord, table_of};
use shearq_pipeline::PipelineError;

/// How a column is compared with what is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Relation {
    Is,
    IsNot,
    Below,
    AtMost,
    Above,
    AtLeast,
}

/// Conditions on rows of a store, all of which must hold: `snr=low,submission=23/*,q>50`.
///
/// A condition is a column, one of `=`, `!=`, `<`, `<=`, `>`, `>=`, and a value. `*` in a text stands
/// for any characters.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Conditions(Vec<(String, Relation, String)>);

impl FromStr for Conditions {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // Longer ones first: `<=` begins like `<`.
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
                    "`{part}` is no condition; expected a column, one of = != < <= > >=, and a value, as in `snr=low,q>50`"
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
    /// Leaves of each run the sets for which all conditions hold, and drops runs without any.
    ///
    /// # Errors
    /// Where there is no such column, or a value is not of the column's type.
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
        PipelineError::Request(format!("the store has no column `{name}`; it has {names}"))
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
                let message = format!("`{name}` is text; expected = or != and a text");
                return Err(PipelineError::Request(message));
            }
        };
        return Ok(texts
            .iter()
            .map(|own| holds(wanted, own.unwrap_or("")))
            .collect());
    }
    let wanted: f64 = wanted
        .parse()
        .map_err(|_| PipelineError::Request(format!("`{name}` is a number; `{wanted}` is none")))?;
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
    // Any split of the remaining text may be the one.
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
    fn conditions_are_taken_apart() {
        let conditions: Conditions = "snr=low, q>=50,psf!=fixed".parse().unwrap();
        let second = ("q".into(), Relation::AtLeast, "50".into());
        assert_eq!(conditions.0[1], second);
        for wrong in ["", "q", "=3", "q!5"] {
            assert!(wrong.parse::<Conditions>().is_err(), "{wrong}");
        }
    }
}
