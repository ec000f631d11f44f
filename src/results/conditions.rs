//! Which rows of a results store to look at.

use std::str::FromStr;

use super::{RunRecord, Value, column};

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
    /// A message where there is no such column, or a value is not of the column's type.
    pub fn choose(&self, runs: Vec<RunRecord>) -> Result<Vec<RunRecord>, String> {
        let mut chosen = Vec::new();
        for mut run in runs {
            let mut kept = Vec::new();
            for set in std::mem::take(&mut run.sets) {
                if self.hold(&run.row(&set))? {
                    kept.push(set);
                }
            }
            if !kept.is_empty() {
                run.sets = kept;
                chosen.push(run);
            }
        }
        Ok(chosen)
    }

    fn hold(&self, row: &[(String, Value)]) -> Result<bool, String> {
        let mut all = true;
        for (name, relation, wanted) in &self.0 {
            all &= holds(column(row, name)?, name, *relation, wanted)?;
        }
        Ok(all)
    }
}

fn holds(value: &Value, name: &str, relation: Relation, wanted: &str) -> Result<bool, String> {
    let own = match value {
        Value::Text(own) => {
            return match relation {
                Relation::Is => Ok(matches(wanted, own)),
                Relation::IsNot => Ok(!matches(wanted, own)),
                _ => Err(format!("`{name}` is text; expected = or != and a text")),
            };
        }
        Value::Real(own) => *own,
        Value::Count(own) => *own as f64,
    };
    let wanted: f64 = wanted
        .parse()
        .map_err(|_| format!("`{name}` is a number; `{wanted}` is none"))?;
    Ok(match relation {
        Relation::Is => own == wanted,
        Relation::IsNot => own != wanted,
        Relation::Below => own < wanted,
        Relation::AtMost => own <= wanted,
        Relation::Above => own > wanted,
        Relation::AtLeast => own >= wanted,
    })
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
