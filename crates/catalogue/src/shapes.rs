//! Catalogues by shearq: which columns they have, and the ellipticity, response, weight and flags of their galaxies. `mean`,
//! `shear`, `select`, scores and `bias --where 'step(…)'` read them here.

use std::borrow::Cow;
use std::path::Path;

use shearq_files::FileError;
use shearq_files::frames::polars::DataFrame;
use shearq_files::table::{self, Place};
use shearq_measure::{Observables, ResponseMatrix, Selection};

use crate::expression::{Expression, Operand, operand_values};
use crate::own_columns::{SHAPE_COLUMNS, WEIGHT, refuse_divided, require_responses};
use crate::select::{StatedSelection, refuse_sharp};

fn names_of_columns(path: &Path) -> Result<Vec<String>, FileError> {
    let present = table::columns(&Place::of(path))?;
    Ok(present
        .named
        .into_iter()
        .flat_map(|own| own.names)
        .collect())
}

/// The names of the columns of a catalogue that is not divided by its response.
pub fn undivided_columns(path: &Path) -> Result<Vec<String>, FileError> {
    let names = names_of_columns(path)?;
    refuse_divided(path, &names)?;
    Ok(names)
}

/// The weights of the selection that was applied to a table, or 1.
pub fn applied_weights(path: &Path, table: &DataFrame) -> Result<Vec<f64>, FileError> {
    match table.column(WEIGHT) {
        Ok(_) => Ok(table::numbers(table, WEIGHT, path)?.into_owned()),
        Err(_) => Ok(vec![1.0; table.height()]),
    }
}

/// Shapes of the rows of a catalogue.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredShapes {
    /// Zero in rows of good galaxies.
    pub flags: Vec<f64>,
    /// Weighted ellipticities; NaN in rows with a flag.
    pub e: Vec<[f64; 2]>,
    /// Their responses by rows to g1 and g2; NaN in rows with a flag.
    pub response: Vec<ResponseMatrix>,
    /// Weights, which ellipticities and responses contain; zero in rows with a flag.
    pub weight: Vec<f64>,
}

impl MeasuredShapes {
    /// The shapes of columns, which `column` gives by name. They are shears already unless `with_response`.
    pub fn of<'a>(
        column: impl Fn(&str) -> Result<Cow<'a, [f64]>, FileError>,
        with_response: bool,
    ) -> Result<Self, FileError> {
        let flags = column("flags")?.into_owned();
        let (e1, e2) = (column("e1")?, column("e2")?);
        let responses = match with_response {
            true => Some([
                column("R11")?,
                column("R12")?,
                column("R21")?,
                column("R22")?,
            ]),
            false => None,
        };
        let rows = 0..flags.len();
        let good = |row: usize| flags[row] == 0.0;
        let missing = [f64::NAN; 2];
        let e = rows.clone().map(|row| match good(row) {
            true => [e1[row], e2[row]],
            false => missing,
        });
        let response = rows.clone().map(|row| match &responses {
            _ if !good(row) => [missing; 2],
            Some([r11, r12, r21, r22]) => [[r11[row], r12[row]], [r21[row], r22[row]]],
            None => [[1.0, 0.0], [0.0, 1.0]],
        });
        Ok(MeasuredShapes {
            e: e.collect(),
            response: response.collect(),
            weight: rows.map(|row| f64::from(u8::from(good(row)))).collect(),
            flags,
        })
    }

    /// The shapes of a table with the weights of the selection that it contains.
    pub fn of_table(
        path: &Path,
        table: &DataFrame,
        with_response: bool,
    ) -> Result<Self, FileError> {
        let mut shapes = Self::of(|name| table::numbers(table, name, path), with_response)?;
        for (own, applied) in shapes.weight.iter_mut().zip(applied_weights(path, table)?) {
            *own *= applied;
        }
        Ok(shapes)
    }

    /// The shapes of the catalogue `path` after a selection. They are shears already unless `with_response`.
    pub fn read(
        path: &Path,
        selection: Option<&StatedSelection>,
        with_response: bool,
    ) -> Result<Self, FileError> {
        let names = names_of_columns(path)?;
        let weights = selection.and_then(|own| own.weights.as_ref());
        let with_response = with_response || weights.is_some();
        if weights.is_some() {
            require_responses(path, &names)?;
        } else if with_response {
            refuse_divided(path, &names)?;
        }
        let count = if with_response {
            SHAPE_COLUMNS.len()
        } else {
            3
        };
        let mut wanted = SHAPE_COLUMNS[..count].to_vec();
        wanted.extend(weights.iter().flat_map(|_| Observables::COLUMNS));
        wanted.extend(names.iter().any(|name| name == WEIGHT).then_some(WEIGHT));
        let condition = selection.and_then(|own| own.rows.as_ref());
        for name in condition.iter().flat_map(|own| own.columns()) {
            if !wanted.contains(&name) {
                wanted.push(name);
            }
        }
        let table = table::read(path, Some(&wanted), table::MAX_ROWS)?;
        let mut shapes = Self::of_table(path, &table, with_response)?;
        shapes.select(path, &table, selection)?;
        Ok(shapes)
    }

    /// Applies a selection by the columns of the same table.
    pub fn select(
        &mut self,
        path: &Path,
        table: &DataFrame,
        selection: Option<&StatedSelection>,
    ) -> Result<(), FileError> {
        let Some(StatedSelection { rows, weights, .. }) = selection else {
            return Ok(());
        };
        if let Some(weights) = weights {
            self.weigh(path, 0, weights, |name| table::numbers(table, name, path))?;
        }
        if let Some(condition) = rows {
            self.keep(path, condition, |own| operand_values(table, own, path))?;
        }
        Ok(())
    }

    /// Multiplies the shapes by the weights of a selection, whose response to shear enters theirs. `column` gives the columns of
    /// [`Observables`] by name, from the row after `before` on.
    ///
    /// # Errors
    /// If a column cannot be read, a step is too sharp for a response, or a weight is negative or no number.
    pub fn weigh<'a>(
        &mut self,
        path: &Path,
        before: usize,
        selection: &Selection,
        column: impl Fn(&str) -> Result<Cow<'a, [f64]>, FileError>,
    ) -> Result<(), FileError> {
        let observed = Observables::COLUMNS.iter().map(|name| column(name));
        let observed: Vec<_> = observed.collect::<Result<_, _>>()?;
        for (row, flag) in self.flags.iter().enumerate() {
            if *flag != 0.0 {
                continue;
            }
            let observables = Observables::from_array(&std::array::from_fn(|k| observed[k][row]));
            refuse_sharp(selection, observables.flux_error)
                .map_err(|error| FileError::new(path, error))?;
            let selected = selection.apply(self.e[row], self.response[row], &observables);
            if !(selected.weight >= 0.0 && selected.weight.is_finite()) {
                let found = selected.weight;
                return Err(FileError::new(
                    path,
                    format!(
                        "row {}: the weight is {found} (expected a number from 0 on)",
                        before + row + 1
                    ),
                ));
            }
            self.e[row] = selected.e;
            self.response[row] = selected.response;
            self.weight[row] = selected.weight;
        }
        Ok(())
    }

    /// Leaves out rows for which a condition on columns that shear does not change does not hold; the others keep their weights.
    /// `column` gives the values of an operand.
    ///
    /// # Errors
    /// If a column cannot be read, or a row that counts neither holds nor fails the condition because a number is missing.
    pub fn keep<'a>(
        &mut self,
        path: &Path,
        condition: &Expression,
        column: impl Fn(&Operand) -> Result<Cow<'a, [f64]>, FileError>,
    ) -> Result<(), FileError> {
        let columns = condition.operands().iter().map(column);
        let columns: Vec<_> = columns.collect::<Result<_, _>>()?;
        for (row, e) in self.e.iter_mut().enumerate() {
            // Carried numbers of galaxies with a flag may be missing, too.
            if !e.iter().all(|e| e.is_finite()) {
                continue;
            }
            let Some(holds) = condition.holds(&|place| columns[place][row]) else {
                let message = format!(
                    "row {}: a number of `{}` is missing (expected one in each row without a flag)",
                    row + 1,
                    condition.text()
                );
                return Err(FileError::new(path, message));
            };
            if !holds {
                *e = [0.0; 2];
                self.response[row] = [[0.0; 2]; 2];
                self.weight[row] = 0.0;
            }
        }
        Ok(())
    }

    /// e1, e2, R11, R22, R12, R21 and the weight by rows.
    pub fn columns(&self) -> [Vec<f64>; 7] {
        let e = [0, 1].map(|k| self.e.iter().map(|e| e[k]).collect());
        let r = [(0, 0), (1, 1), (0, 1), (1, 0)];
        let r = r.map(|(i, j)| self.response.iter().map(|own| own[i][j]).collect());
        let ([e1, e2], [r11, r22, r12, r21]) = (e, r);
        [e1, e2, r11, r22, r12, r21, self.weight.clone()]
    }
}

#[cfg(test)]
mod tests {
    use shearq_files::frames::frame;
    use shearq_files::frames::polars::Column;

    use super::*;

    #[test]
    fn flags_and_applied_weights_decide_which_rows_count() {
        let column = |name: &str, values: [f64; 4]| Column::new(name.into(), values);
        // The second galaxy has a flag and an ellipticity, and the selection left out the third.
        let table = frame(vec![
            column("flags", [0.0, 4.0, 0.0, 0.0]),
            column("e1", [0.1, 0.2, 0.0, 0.3]),
            column("e2", [0.2, 0.1, 0.0, -0.3]),
            column(WEIGHT, [0.5, 0.0, 0.0, 1.0]),
            column("x", [1.0, f64::NAN, 2.0, 3.0]),
        ]);
        let (path, table) = (Path::new("c.parquet"), table.unwrap());
        let mut shapes = MeasuredShapes::of_table(path, &table, false).unwrap();
        assert!(shapes.e[1].iter().all(|e| e.is_nan()));
        assert_eq!(shapes.weight, [0.5, 0.0, 0.0, 1.0]);
        assert_eq!(shapes.response[0], [[1.0, 0.0], [0.0, 1.0]]);
        let rows = Some(Expression::parse("x < 3").unwrap());
        let selection = StatedSelection {
            rows,
            ..StatedSelection::default()
        };
        shapes.select(path, &table, Some(&selection)).unwrap();
        assert_eq!(shapes.weight, [0.5, 0.0, 0.0, 0.0]);
        assert_eq!((shapes.e[0], shapes.e[3]), ([0.1, 0.2], [0.0; 2]));
    }
}
