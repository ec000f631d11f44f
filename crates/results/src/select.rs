//! Cuts and weights on catalogues of linear configurations, with the response of the selection to shear.

use std::borrow::Cow;
use std::path::Path;

use shearq_dataset::fingerprint::{PRINTS, verify_source};
use shearq_dataset::metadata::KEYS;
use shearq_dataset::run::{RUN_FILE, Run, Source, claim};
use shearq_dataset::threads::ALL_CORES;
use shearq_files::frames::frame;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::table::Place;
use shearq_files::{FileError, atomic, table};
use shearq_measure::{
    Cut, Observables, Quantity, ResponseMatrix, Selection, ShearSum, ShearedCatalogues,
};
use thiserror::Error;

use crate::expression::{Condition, Expression, ExpressionError, Operand, Step, text_matches};

/// Columns that a selection replaces or reads. It also reads the columns of [`Observables`].
pub(crate) const READ: [&str; 7] = ["e1", "e2", "flags", "R11", "R22", "R12", "R21"];

/// Why `--where` and `--weight` cannot be used.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SelectionError {
    #[error(transparent)]
    Expression(#[from] ExpressionError),
    #[error(
        "galaxies cannot be selected by `{0}`: its response to shear is not known, so the mean shear would be biased (expected step() of snr, flux, size or neighbour)"
    )]
    Unknown(String),
    #[error("a step of `{0}`: the threshold must be finite and the half width positive")]
    Range(String),
    #[error(
        "a step of `{column}` is so narrow that hardly any galaxy lies within it, so that it is a sharp cut without a finite response to shear (found a half width of {found:e}, expected at least {least:.3}). Try: step({column}, THRESHOLD)"
    )]
    Sharp {
        column: &'static str,
        found: f64,
        least: f64,
    },
    // A sharp cut gives the response the density of galaxies at its edge, which no galaxy by itself determines.
    #[error(
        "`{0}` is a condition on a measured quantity, whose response to shear is not known, so the mean shear would be biased (expected steps, such as `step(snr, 10, 1.5) and step(size, 2.5)`, and conditions on positions and carried columns only). Try: step(NAME, THRESHOLD)"
    )]
    Condition(String),
    #[error(
        "a weight cannot depend on `{0}`, whose response to shear is not known (expected snr, flux or size)"
    )]
    WeightColumn(String),
    #[error(
        "the weight `{0}` is not smooth (found a comparison, `abs` or `not`). Try: --where with step()"
    )]
    WeightNotSmooth(String),
}

/// What `--where` and `--weight` select, and their texts.
#[derive(Debug, Clone, Default)]
#[non_exhaustive]
pub struct StatedSelection {
    /// Which rows count: a hard selection, whose response to shear follows from sheared catalogues or is missing.
    pub rows: Option<Expression>,
    /// Steps and weights, whose response to shear follows from the columns of linear configurations.
    pub weights: Option<Selection>,
    /// The texts, such as `where: step(snr, 10); weight: snr^2`.
    pub text: String,
}

/// The selection of `--where` and `--weight`; `None` without either.
pub fn selection(
    condition: Option<&str>,
    weight: Option<&str>,
) -> Result<Option<StatedSelection>, SelectionError> {
    let mut stated = StatedSelection::default();
    let mut weights = Selection::default();
    if let Some(text) = condition {
        let condition = Condition::parse(text)?;
        for step in &condition.steps {
            weights = weights.with_cut(cut(step)?);
        }
        stated.weights = (!condition.steps.is_empty()).then_some(weights.clone());
        stated.rows = condition.rows;
        stated.text = format!("where: {}", condition.text);
    }
    if let Some(text) = weight {
        let expression = Expression::parse(text)?;
        let known = |name: &&str| ["snr", "flux", "size"].contains(name);
        if let Some(other) = expression.columns().find(|name| !known(name)) {
            return Err(SelectionError::WeightColumn(other.to_owned()));
        }
        if !expression.is_smooth() {
            return Err(SelectionError::WeightNotSmooth(text.to_owned()));
        }
        let joint = if condition.is_some() { "; " } else { "" };
        stated.text += &format!("{joint}weight: {}", text.trim());
        stated.weights = Some(weights.with_weight(move |snr, flux, size| {
            expression.value(
                &|place| match expression.operands()[place].column.as_str() {
                    "snr" => snr,
                    "flux" => flux,
                    _ => size,
                },
            )
        }));
    }
    Ok((condition.is_some() || weight.is_some()).then_some(stated))
}

/// The selection of `--where` and `--weight` by steps, weights, and conditions on columns that shear does not change, such as
/// positions: all keep a mean shear calibrated.
pub fn smooth_selection(
    condition: Option<&str>,
    weight: Option<&str>,
) -> Result<Option<StatedSelection>, SelectionError> {
    let stated = selection(condition, weight)?;
    match stated.as_ref().and_then(|stated| stated.rows.as_ref()) {
        Some(rows) if rows.columns().any(is_measured) => {
            Err(SelectionError::Condition(rows.text().to_owned()))
        }
        _ => Ok(stated),
    }
}

fn cut(step: &Step) -> Result<Cut, SelectionError> {
    let mut known = Quantity::ALL.into_iter();
    let Some((_, quantity)) = known.find(|(name, _)| *name == step.column) else {
        return Err(SelectionError::Unknown(step.column.clone()));
    };
    Cut::new(quantity, !step.falls, step.threshold, step.half_width)
        .ok_or_else(|| SelectionError::Range(step.column.clone()))
}

// A step may state a width; without one it is wide enough.
fn refuse_sharp(selection: &Selection, flux_error: f64) -> Result<(), SelectionError> {
    let mut stated = selection
        .cuts()
        .iter()
        .filter_map(|cut| Some((cut, cut.half_width?)));
    // Not of NaN, which a galaxy without an error has.
    match stated.find(|(cut, found)| *found < cut.least_half_width(flux_error)) {
        None => Ok(()),
        Some((cut, found)) => {
            let mut known = Quantity::ALL.into_iter();
            let name = known.find(|(_, quantity)| *quantity == cut.quantity);
            Err(SelectionError::Sharp {
                column: name.map_or("", |(name, _)| name),
                found,
                least: cut.least_half_width(flux_error),
            })
        }
    }
}

// Name of the column with the weights.
pub(crate) const WEIGHT: &str = "selection";

/// Writes the catalogues of the folder `from` with the weights of a `stated` selection to the folder `to`:
/// ellipticities and responses are multiplied by the weights, so that all that uses catalogues uses the selection. Galaxies
/// that are left out have an ellipticity and a response of zero. Returns the number of galaxies that are kept, and of those without a flag.
pub fn write_selected(
    run: &Run,
    from: &Path,
    to: &Path,
    stated: &StatedSelection,
) -> Result<(usize, usize), FileError> {
    let selection = stated.weights.clone().unwrap_or_default();
    verify_source(from, run, &[], ALL_CORES)?;
    // The second selection would divide by the response of the first one again.
    if let Some(earlier) = &run.selection {
        return Err(FileError::new(
            from,
            format!(
                "these catalogues have the selection `{earlier}` already. Try: the folder that they were selected from"
            ),
        ));
    }
    let files = run.catalogues(from, &[])?;
    // Nothing is written if one of the sets has too few galaxies left.
    for set in files.wanted(&[]) {
        let mut sum = ShearSum::default();
        for (_, path) in files.of_set(set) {
            let (mut rows, flags) = Weighted::read(&path, &selection)?;
            rows.keep_of_file(&path, stated)?;
            for row in (0..flags.len()).filter(|row| flags[*row] == 0.0) {
                sum.add([rows.e[0][row], rows.e[1][row]], rows.matrix(row), 1.0);
            }
        }
        if let Err(error) = sum.mean() {
            let message = format!(
                "set {set:02}: the selection leaves no galaxies with a response to shear: {error}. Try: a lower threshold"
            );
            return Err(FileError::new(from, message));
        }
    }
    let record = Run {
        source: run.source.moved(from, to)?,
        selection: Some(stated.text.clone()),
        ..run.clone()
    };
    let claim = claim(&to.join(RUN_FILE), &record)?;
    let keys: Vec<String> = KEYS
        .iter()
        .chain(&PRINTS)
        .map(|key| (*key).to_owned())
        .collect();
    let (mut kept, mut good) = (0, 0);
    for set in files.wanted(&[]) {
        if let Source::Simulated(_) = run.source {
            // The truth of a simulated run lies beside the catalogues.
            let truth = run.source.data(from)?.truth(set);
            if let (Ok(within), Ok(bytes)) = (truth.strip_prefix(from), std::fs::read(&truth)) {
                atomic::write(to.join(within), &bytes)?;
            }
        }
        for (image, path) in files.of_set(set) {
            let read = table::read(&path, None, table::MAX_ROWS)?;
            let mut weighted = Weighted::of_table(&path, &selection, &read)?;
            weighted.keep_of_table(&path, stated, &read)?;
            kept += weighted
                .weight
                .iter()
                .filter(|weight| **weight > 0.0)
                .count();
            good += weighted.e[0].iter().filter(|e| e.is_finite()).count();
            let changed = weighted.table(&path, &read)?;
            // The origin of the catalogue stays, so that it is still compared with its images.
            let mut metadata = table::read_metadata(&path, run.format, keys.iter())?;
            metadata.insert("select".into(), stated.text.clone());
            let out = record.catalogue(to, set, image);
            claim.check()?;
            table::write(&out, run.format, &changed, &metadata)?;
        }
    }
    Ok((kept, good))
}

/// Checks that a catalogue with columns of these names has what a selection requires, and no selection yet.
pub(crate) fn require_responses<'a>(
    path: &Path,
    mut names: impl Iterator<Item = &'a str> + Clone,
) -> Result<(), FileError> {
    refuse_divided(path, names.clone())?;
    if names.clone().any(|name| name == WEIGHT) {
        return Err(FileError::new(
            path,
            "this catalogue has a selection already. Try: the catalogue that it was selected from",
        ));
    }
    if names.any(|name| name == Observables::COLUMNS[2]) {
        return Ok(());
    }
    Err(FileError::new(
        path,
        "the catalogue has no responses of flux and size, so a selection cannot be corrected (expected a catalogue of a linear configuration such as 48/linear/star)",
    ))
}

/// The names of the columns of a catalogue that is not divided by its response.
pub(crate) fn undivided_columns(path: &Path) -> Result<Vec<String>, FileError> {
    let present = table::columns(&Place::of(path))?;
    let names = present.named.into_iter().flat_map(|named| named.names);
    let names: Vec<String> = names.collect();
    refuse_divided(path, names.iter().map(String::as_str))?;
    Ok(names)
}

/// Refuses catalogues of earlier versions, whose ellipticities were divided by `divisor1` and `divisor2`: Σ e / Σ R would be
/// too large by 1/R.
pub(crate) fn refuse_divided<'a>(
    path: &Path,
    mut columns: impl Iterator<Item = &'a str>,
) -> Result<(), FileError> {
    if columns.any(|name| name == "divisor1") {
        let message = "an earlier version of shearq measured this catalogue and divided e1 and e2 by their mean response (found the column `divisor1`; expected ellipticities before the division). Try: shearq measure, or multiply e1 by divisor1 and e2 by divisor2 and remove these columns";
        return Err(FileError::new(path, message));
    }
    Ok(())
}

/// Rows of a catalogue after a selection.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Weighted {
    /// Weighted ellipticities; NaN in rows with a flag.
    pub e: [Vec<f64>; 2],
    /// Their responses R11 and R22; NaN in rows with a flag.
    pub response: [Vec<f64>; 2],
    /// R12 of e1 to g2 and R21 of e2 to g1; NaN in rows with a flag.
    pub cross: [Vec<f64>; 2],
    /// Weights; zero in rows with a flag.
    pub weight: Vec<f64>,
}

impl Weighted {
    /// Applies `selection` to the rows of the catalogue `path`. `column` gives a column of it by name.
    pub fn of<'a>(
        path: &Path,
        selection: &Selection,
        column: impl Fn(&str) -> Result<Cow<'a, [f64]>, FileError>,
    ) -> Result<Self, FileError> {
        let all: Vec<_> = Observables::COLUMNS
            .iter()
            .map(|name| column(name))
            .collect::<Result<_, _>>()?;
        let [e1, e2, flags, r11, r22, r12, r21] = {
            let read: Vec<_> = READ
                .iter()
                .map(|name| column(name))
                .collect::<Result<_, _>>()?;
            <[_; READ.len()]>::try_from(read)
                .map_err(|_| FileError::new(path, "columns are missing"))?
        };
        let count = flags.len();
        let nothing = || vec![f64::NAN; count];
        let mut weighted = Weighted {
            e: [nothing(), nothing()],
            response: [nothing(), nothing()],
            cross: [nothing(), nothing()],
            weight: vec![0.0; count],
        };
        for row in 0..count {
            if flags[row] != 0.0 {
                continue;
            }
            let observables = Observables::from_array(&std::array::from_fn(|k| all[k][row]));
            refuse_sharp(selection, observables.flux_error)
                .map_err(|error| FileError::new(path, error))?;
            let e = [e1[row], e2[row]];
            let response = [[r11[row], r12[row]], [r21[row], r22[row]]];
            let selected = selection.apply(e, response, &observables);
            if !(selected.weight >= 0.0 && selected.weight.is_finite()) {
                let found = selected.weight;
                return Err(FileError::new(
                    path,
                    format!(
                        "row {}: the weight is {found} (expected a number from 0 on)",
                        row + 1
                    ),
                ));
            }
            for k in 0..2 {
                weighted.e[k][row] = selected.e[k];
                weighted.response[k][row] = selected.response[k][k];
                weighted.cross[k][row] = selected.response[k][1 - k];
            }
            weighted.weight[row] = selected.weight;
        }
        Ok(weighted)
    }

    /// The same for a table in memory.
    pub fn of_table(
        path: &Path,
        selection: &Selection,
        read: &DataFrame,
    ) -> Result<Self, FileError> {
        let names = read.get_column_names();
        require_responses(path, names.iter().map(|name| name.as_str()))?;
        Weighted::of(path, selection, |name| table::numbers(read, name, path))
    }

    /// The same for the columns of a file that a selection needs, with the flags of its rows.
    pub fn read(path: &Path, selection: &Selection) -> Result<(Self, Vec<f64>), FileError> {
        let present = table::columns(&Place::of(path))?;
        let names = present.named.iter().flat_map(|named| &named.names);
        require_responses(path, names.map(String::as_str))?;
        let wanted: Vec<&str> = READ.iter().chain(&Observables::COLUMNS).copied().collect();
        let read = table::read(path, Some(&wanted), table::MAX_ROWS)?;
        let flags = table::numbers(&read, "flags", path)?.into_owned();
        Ok((Weighted::of_table(path, selection, &read)?, flags))
    }

    /// The rows of a catalogue without a selection, with the flags: weights of one, and the responses of shears if the
    /// ellipticities are not `calibrated`. Catalogues of a folder that is `selected` have zero for galaxies that were left out.
    pub(crate) fn unselected(
        path: &Path,
        calibrated: bool,
        selected: bool,
    ) -> Result<(Self, Vec<f64>), FileError> {
        let mut names = if calibrated { &READ[..] } else { &READ[..3] }.to_vec();
        names.extend(selected.then_some(WEIGHT));
        if calibrated {
            undivided_columns(path)?;
        }
        let read = table::read(path, Some(&names), table::MAX_ROWS)?;
        let column = |name: &str| table::numbers(&read, name, path).map(Cow::into_owned);
        let pair = |[a, b]: [&str; 2]| Ok::<_, FileError>([column(a)?, column(b)?]);
        let (flags, e) = (column("flags")?, pair(["e1", "e2"])?);
        let all = |value: f64| vec![value; flags.len()];
        let (mut response, mut cross) = ([all(1.0), all(1.0)], [all(0.0), all(0.0)]);
        if calibrated {
            (response, cross) = (pair(["R11", "R22"])?, pair(["R12", "R21"])?);
        }
        // Ellipticities and responses contain the weights already.
        let mut weight = all(1.0);
        if selected {
            let counts = |weight: f64| f64::from(u8::from(weight != 0.0));
            weight = column(WEIGHT)?.into_iter().map(counts).collect();
        }
        let weighted = Weighted {
            e,
            response,
            cross,
            weight,
        };
        Ok((weighted, flags))
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
        for row in 0..self.weight.len() {
            // Of galaxies with a flag, carried numbers may be missing, too.
            if !self.e[0][row].is_finite() {
                continue;
            }
            let holds = condition.value(&|place| columns[place][row]);
            if holds.is_nan() {
                let message = format!(
                    "row {}: a number of `{}` is missing (expected one in each row without a flag)",
                    row + 1,
                    condition.text()
                );
                return Err(FileError::new(path, message));
            }
            if holds == 0.0 {
                self.weight[row] = 0.0;
                for values in [&mut self.e, &mut self.response, &mut self.cross] {
                    values.iter_mut().for_each(|own| own[row] = 0.0);
                }
            }
        }
        Ok(())
    }

    // The same for the condition of a selection on the columns of a table, if it has one.
    fn keep_of_table(
        &mut self,
        path: &Path,
        stated: &StatedSelection,
        table: &DataFrame,
    ) -> Result<(), FileError> {
        let Some(condition) = &stated.rows else {
            return Ok(());
        };
        self.keep(
            path,
            condition,
            |Operand { column, pattern }| match pattern {
                Some(pattern) => text_matches(table, column, pattern, path).map(Cow::Owned),
                None => {
                    let numbers = table::numbers(table, column, path)?;
                    Ok(Cow::Owned(numbers.into_owned()))
                }
            },
        )
    }

    // The same, reading only the columns of the condition.
    pub(crate) fn keep_of_file(
        &mut self,
        path: &Path,
        stated: &StatedSelection,
    ) -> Result<(), FileError> {
        let Some(condition) = &stated.rows else {
            return Ok(());
        };
        let names: Vec<&str> = condition.columns().collect();
        let read = table::read(path, Some(&names), table::MAX_ROWS)?;
        self.keep_of_table(path, stated, &read)
    }

    /// The response of e1 and e2 of a row, by rows, to g1 and g2.
    pub(crate) fn matrix(&self, row: usize) -> ResponseMatrix {
        let ([r11, r22], [r12, r21]) = (&self.response, &self.cross);
        [[r11[row], r12[row]], [r21[row], r22[row]]]
    }

    // The catalogue `read` with weighted ellipticities and their responses.
    fn table(&self, path: &Path, read: &DataFrame) -> Result<DataFrame, FileError> {
        let new = |name: &str| match name {
            "e1" => Some(self.e[0].clone()),
            "e2" => Some(self.e[1].clone()),
            "R11" => Some(self.response[0].clone()),
            "R22" => Some(self.response[1].clone()),
            "R12" => Some(self.cross[0].clone()),
            "R21" => Some(self.cross[1].clone()),
            _ => None,
        };
        // Sheared versions would not have the selection.
        let kept =
            |own: &&Column| !ShearedCatalogues::columns().any(|name| own.name().as_str() == name);
        let mut columns: Vec<Column> = read
            .columns()
            .iter()
            .filter(kept)
            .map(|own| match new(own.name()) {
                Some(values) => Column::new(own.name().clone(), values),
                None => own.clone(),
            })
            .collect();
        columns.push(Column::new(WEIGHT.into(), self.weight.clone()));
        frame(columns).map_err(|error| FileError::new(path, error.to_string()))
    }
}

// Whether shear changes a column of shearq's catalogues.
pub(crate) fn changes_with_shear(name: &str) -> bool {
    let read = READ.contains(&name) && name != "flags";
    read || Observables::COLUMNS.contains(&name) || ["snr", "neighbour", "radius"].contains(&name)
}

// Whether a column was measured on the stamps.
pub(crate) fn is_measured(name: &str) -> bool {
    const OTHERS: [&str; 8] = [
        "flags",
        "iterations",
        "stop",
        "updated",
        "first_energy",
        "energy",
        "noise",
        WEIGHT,
    ];
    changes_with_shear(name)
        || OTHERS.contains(&name)
        || ShearedCatalogues::columns().any(|column| column == name)
}
