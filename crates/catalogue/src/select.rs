//! Cuts and weights on catalogues of linear configurations, with the response of the selection to shear.

use std::path::Path;

use shearq_dataset::fingerprint::{PRINTS, verify_source};
use shearq_dataset::metadata::KEYS;
use shearq_dataset::run::{Run, Source};
use shearq_dataset::threads::ALL_CORES;
use shearq_files::frames::frame;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::{FileError, atomic, table};
use shearq_measure::{Cut, Quantity, Selection, ShearSum, ShearedCatalogues};
use thiserror::Error;

use crate::expression::{Condition, Expression, ExpressionError, Step};
use crate::shapes::{MeasuredShapes, WEIGHT, is_measured};

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
        "`{condition}` is a condition on the column {column}, which shear may change, so that the mean shear would be biased (expected positions, identities, PSF columns, and steps, such as `step(snr, 10)`). Try: --unsheared {column} if it was not measured on these galaxies' images, as a tile or a redshift of a survey"
    )]
    Carried { condition: String, column: String },
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

/// Columns that shear does not change.
const UNSHEARED: [&str; 12] = [
    "id",
    "x",
    "y",
    "ra",
    "dec",
    "tile_x",
    "tile_y",
    "set",
    "file",
    "image",
    "plane",
    "submission",
];

/// The selection of `--where` and `--weight` by steps, weights, and conditions on columns that shear does not change: positions and
/// those that the user declares as `unsheared`. All keep a mean shear calibrated.
// Carried columns of fluxes, sizes and flags were measured on images of the galaxies: cuts on them cost m of −0.015 to −0.03.
pub fn smooth_selection(
    condition: Option<&str>,
    weight: Option<&str>,
    unsheared: &[String],
) -> Result<Option<StatedSelection>, SelectionError> {
    let stated = selection(condition, weight)?;
    let Some(rows) = stated.as_ref().and_then(|stated| stated.rows.as_ref()) else {
        return Ok(stated);
    };
    let condition = rows.text().to_owned();
    if rows.columns().any(is_measured) {
        return Err(SelectionError::Condition(condition));
    }
    let is_known = |name: &&str| {
        let declared = unsheared.iter().any(|own| own == name);
        declared || UNSHEARED.contains(name) || name.starts_with("psf_")
    };
    let carried = rows.columns().find(|name| !is_known(name));
    match carried.map(str::to_owned) {
        Some(column) => Err(SelectionError::Carried { condition, column }),
        None => Ok(stated),
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
pub fn refuse_sharp(selection: &Selection, flux_error: f64) -> Result<(), SelectionError> {
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

/// Writes the catalogues of the folder `from` with the weights of a `stated` selection to the folder `to`:
/// ellipticities and responses are multiplied by the weights, so that all that uses catalogues uses the selection. Galaxies
/// that are left out have an ellipticity and a response of zero. Returns the number of galaxies that are kept, and of those without a flag.
pub fn write_selected(
    run: &Run,
    from: &Path,
    to: &Path,
    stated: &StatedSelection,
) -> Result<(usize, usize), FileError> {
    // A condition alone has the weight 1, whose response is zero.
    let stated = &StatedSelection {
        weights: Some(stated.weights.clone().unwrap_or_default()),
        ..stated.clone()
    };
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
            let shapes = MeasuredShapes::read(&path, Some(stated), true)?;
            let good = (0..shapes.flags.len()).filter(|row| shapes.flags[*row] == 0.0);
            good.for_each(|row| sum.add(shapes.e[row], shapes.response[row], 1.0));
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
    let claim = record.claim(to)?;
    let keys: Vec<String> = KEYS
        .iter()
        .chain(&PRINTS)
        .map(|key| (*key).to_owned())
        .collect();
    let (mut kept, mut good) = (0, 0);
    for set in files.wanted(&[]) {
        if let Source::Simulated(_) = run.source {
            // The truth of a simulated run is in the folder of the catalogues.
            let truth = run.source.data(from)?.truth(set);
            if let (Ok(within), Ok(bytes)) = (truth.strip_prefix(from), std::fs::read(&truth)) {
                atomic::write(to.join(within), &bytes)?;
            }
        }
        for (image, path) in files.of_set(set) {
            let read = table::read(&path, None, table::MAX_ROWS)?;
            let mut shapes = MeasuredShapes::of_table(&path, &read, true)?;
            shapes.select(&path, &read, Some(stated))?;
            kept += shapes.weight.iter().filter(|own| **own > 0.0).count();
            good += shapes.e.iter().filter(|e| e[0].is_finite()).count();
            let changed = selected_table(&path, &shapes, &read)?;
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

// The catalogue `read` with weighted ellipticities and their responses.
fn selected_table(
    path: &Path,
    shapes: &MeasuredShapes,
    read: &DataFrame,
) -> Result<DataFrame, FileError> {
    let [e1, e2, r11, r22, r12, r21, weight] = shapes.columns();
    let new = [e1, e2, r11, r22, r12, r21];
    let names = ["e1", "e2", "R11", "R22", "R12", "R21"];
    // Sheared versions would not have the selection.
    let kept =
        |own: &&Column| !ShearedCatalogues::columns().any(|name| own.name().as_str() == name);
    let columns = read.columns().iter().filter(kept).map(|own| {
        match names.iter().position(|name| own.name().as_str() == *name) {
            Some(k) => Column::new(own.name().clone(), &new[k]),
            None => own.clone(),
        }
    });
    let mut columns: Vec<Column> = columns.collect();
    columns.push(Column::new(WEIGHT.into(), weight));
    frame(columns).map_err(|error| FileError::new(path, error.to_string()))
}
