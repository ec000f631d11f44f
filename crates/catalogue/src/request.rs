//! What to read of which catalogues: the true shear, columns, selection, bins and units that the user states.

use shearq_bias::Design;

use crate::columns::{Names, Shapes};
use crate::expression::Expression;
pub use crate::input::Input;
use crate::select::StatedSelection;
use crate::truth::{Expanded, TrueSign, Truth};

/// Bins of all quantities together. KiDS calibrates in 20 × 20 bins of S/N and size (Fenech Conti et al. 2017, MNRAS 467, 1627).
pub const MAX_BINS: usize = 400;
/// Artificial shear of metacalibration in ngmix and metadetect, whose catalogues do not state it.
const DEFAULT_STEP: f64 = 0.01;
/// Quantities that are binned at the same time.
pub const MAX_AXES: usize = 3;

#[derive(Debug, Clone)]
pub struct Binning {
    pub of: Expression,
    pub edges: Edges,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Edges {
    /// A number of bins with equally many galaxies.
    Equal(usize),
    /// Increasing edges of half-open bins, which contain their lower edge.
    Given(Vec<f64>),
    /// A bin for each different number or text.
    Values,
}

impl Edges {
    /// So many bins; `None` of fewer than two or more than [`MAX_BINS`].
    pub fn equal(count: usize) -> Option<Self> {
        (2..=MAX_BINS)
            .contains(&count)
            .then_some(Edges::Equal(count))
    }

    /// Bins between edges; `None` if there are none or too many, or edges do not increase.
    pub fn given(edges: Vec<f64>) -> Option<Self> {
        let increase =
            edges.iter().all(|edge| edge.is_finite()) && edges.is_sorted_by(|a, b| a < b);
        ((2..=MAX_BINS + 1).contains(&edges.len()) && increase).then_some(Edges::Given(edges))
    }
}

/// A catalogue of a survey, to whose galaxies simulated ones are weighted.
#[derive(Debug, Clone)]
pub struct Survey {
    pub catalogue: Input,
    /// Column of its tomographic bins.
    pub tomography: Option<String>,
}

/// Which galaxies form an independent unit.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum Units {
    /// Recognised from the columns and the design.
    #[default]
    Recognised,
    /// The same rows of all catalogues.
    Rows,
    /// Whole catalogues, or groups of them.
    Catalogues,
    /// Galaxies with the same value in this column.
    Column(String),
}

/// Galaxies on a grid, of which each has a row: NaN is an ellipticity that was not measured.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Placed {
    /// A value of e1 or e2 that also is none.
    pub missing: Option<f64>,
    /// Ellipticities above it, and above 1, are none either.
    pub max_modulus: Option<f64>,
}

#[derive(Debug, Clone, Default)]
pub struct Request {
    pub catalogues: Vec<Input>,
    pub names: Names,
    pub truth: Truth,
    /// How ellipticities become shears; `None` if the names of the columns decide.
    pub shapes: Option<Shapes>,
    pub sign: TrueSign,
    /// At most [`MAX_AXES`].
    pub bins: Vec<Binning>,
    pub like: Option<Survey>,
    /// Rows that count, and weights of catalogues of linear configurations, whose response to shear enters.
    pub selection: Option<StatedSelection>,
    /// Columns of `--where` and bins that shear does not change.
    pub unsheared: Vec<String>,
    pub design: Option<Design>,
    pub units: Units,
    /// Whether only galaxies count that count under all test shears.
    pub paired: bool,
    /// Whether rows with missing numbers are left out.
    pub drop_missing: bool,
    /// Artificial shear of metacalibration, if it is not 0.01.
    pub step: Option<f64>,
    /// Whether they are galaxies on a grid, whose positions are read.
    pub placed: Option<Placed>,
    /// Remarks about images of the data that have no catalogue.
    pub without_catalogue: Vec<String>,
}

impl Request {
    /// All rows of the catalogues, with everything recognised from them.
    pub fn new(found: Expanded) -> Self {
        Request {
            catalogues: found.catalogues,
            truth: found.truth,
            without_catalogue: found.without_catalogue,
            ..Request::default()
        }
    }

    pub fn step(&self) -> f64 {
        self.step.unwrap_or(DEFAULT_STEP)
    }

    /// The first column that is declared unsheared and that neither a condition nor bins use: it is probably misspelt.
    pub fn unused_unsheared(&self) -> Option<&str> {
        let condition = self.selection.as_ref().and_then(|own| own.rows.as_ref());
        let bins = self.bins.iter().map(|own| &own.of);
        let used: Vec<&str> = bins
            .chain(condition)
            .flat_map(Expression::columns)
            .collect();
        let mut declared = self.unsheared.iter().map(String::as_str);
        declared.find(|name| !used.contains(name))
    }
}
