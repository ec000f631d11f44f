//! `compare --where`: conditions on the columns of a results store.

use shearq_files::frames::polars::DataFrame;
use shearq_files::frames::{TableError, reals};
use thiserror::Error;

use super::expression::{Expression, Operand, fits};
use super::record::{RunRecord, frame_of};

/// Why sets cannot be chosen.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ChoiceError {
    #[error(transparent)]
    Table(#[from] TableError),
    #[error(
        "--where: unknown column of a results store (found `{found}`, expected one of {known})"
    )]
    UnknownColumn { found: String, known: String },
    #[error(
        "--where: column `{0}` contains numbers (found a comparison with a text, expected a number)"
    )]
    Numbers(String),
    #[error(
        "--where: column `{0}` contains text (expected == or != with a text in quotation marks, such as {0} == 'a*')"
    )]
    Text(String),
    #[error("--where: no set meets the conditions")]
    NoSet,
    #[error("--where: the sets that meet the conditions have none in common")]
    NoCommonSet,
}

/// Keeps the sets of each run for which the `condition` holds, and drops runs without such a set.
pub fn choose(
    condition: &Expression,
    mut runs: Vec<RunRecord>,
) -> Result<Vec<RunRecord>, ChoiceError> {
    let table = frame_of(&runs)?;
    let operands = condition.operands().iter();
    let values: Vec<Vec<f64>> = operands
        .map(|operand| values(&table, operand))
        .collect::<Result<_, _>>()?;
    let mut rows = 0..table.height();
    for run in &mut runs {
        run.sets.retain(|_| {
            let row = rows.next().unwrap_or_default();
            // A missing number, such as Q of a set without errors, meets no condition.
            let held = condition.value(&|place| values[place][row]);
            held != 0.0 && !held.is_nan()
        });
    }
    runs.retain(|run| !run.sets.is_empty());
    Ok(runs)
}

fn values(table: &DataFrame, operand: &Operand) -> Result<Vec<f64>, ChoiceError> {
    let name = &operand.column;
    let column = table.column(name).map_err(|_| ChoiceError::UnknownColumn {
        found: name.clone(),
        known: shearq_files::names_of(&table.get_column_names()),
    })?;
    match (&operand.pattern, column.str()) {
        (Some(pattern), Ok(texts)) => Ok(texts
            .iter()
            .map(|text| f64::from(u8::from(fits(pattern, text.unwrap_or_default()))))
            .collect()),
        (Some(_), Err(_)) => Err(ChoiceError::Numbers(name.clone())),
        (None, Ok(_)) => Err(ChoiceError::Text(name.clone())),
        (None, Err(_)) => Ok(reals(column).unwrap_or_default().into_owned()),
    }
}
