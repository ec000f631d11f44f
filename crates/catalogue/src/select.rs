//! Cuts and weights on catalogues of linear configurations, as `--where` and `--weight` state them.

use shearq_measure::{Cut, Quantity, Selection};
use shearq_quantities::{hints, tried};
use thiserror::Error;

use crate::expression::{Condition, Expression, ExpressionError, Step};
use crate::own_columns::is_measured;

/// Why `--where` and `--weight` cannot be used.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SelectionError {
    #[error(transparent)]
    Expression(#[from] ExpressionError),
    #[error(
        "galaxies cannot be selected by `{0}`: its response to shear is not known, so the mean shear would be biased (expected step() of snr, flux, size or neighbour)"
    )]
    Unknown(String),
    #[error("a step of `{0}`: the threshold must be finite and the half width positive")]
    Range(String),
    #[error("a step of `{column}` is so narrow that hardly any galaxy lies within it, so that it is a sharp cut without a finite response to shear (found a half width of {found:e}, expected at least {least:.3}){}", tried(self.hint()))]
    Sharp {
        column: &'static str,
        found: f64,
        least: f64,
    },
    // A sharp cut gives the response the density of galaxies at its edge, which no galaxy by itself determines.
    #[error("`{}` is a condition on a measured quantity, whose response to shear is not known, so the mean shear would be biased (expected steps, such as `step(snr, 10, 1.5) and step(size, 2.5)`, and conditions on positions and on carried columns that --unsheared names){}", .0, tried(self.hint()))]
    Condition(String),
    #[error("`{condition}` is a condition on the column {column}, which shear may change, so that the mean shear would be biased (expected positions, identities, PSF columns, and steps, such as `step(snr, 10)`){}", tried(self.hint()))]
    Carried { condition: String, column: String },
    #[error(
        "a weight cannot depend on `{0}`, whose response to shear is not known (expected snr, flux or size)"
    )]
    WeightColumn(String),
    #[error("the weight `{}` is not smooth (found a comparison, `abs` or `not`){}", .0, tried(self.hint()))]
    WeightNotSmooth(String),
}

impl SelectionError {
    hints! {
        Self::Sharp { column, .. } => &format!("step({column}, THRESHOLD)"),
        Self::Condition(..) => "step(NAME, THRESHOLD)",
        Self::Carried { column, .. } => &format!("--unsheared {column} if it was not measured on these galaxies' images, as a tile or a redshift of a survey"),
        Self::WeightNotSmooth(..) => "--where with step()",
    }
}

/// What `--where` and `--weight` select, and their texts.
#[derive(Debug, Clone, Default)]
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
