//! Whether an entry follows the true shear: slopes on the truth, and fields that differ from the others.

use std::collections::BTreeSet;
use std::fmt::Display;
use std::path::Path;

use shearq_files::names_of;
use shearq_quantities::Shear;
use shearq_quantities::statistics::{RunningMean, scatter};
use shearq_scoring::Line;

/// Standard errors by which the slope of an entry on the true shear must exceed zero: below, it contains no shear that could be
/// ranked.
pub const MIN_ENTRY_SLOPE_SIGNIFICANCE: f64 = 3.0;
// Least slope of an entry that measures shear: below, m < −0.9 is no bias of a method. `bias` has the same limit.
pub(crate) const MIN_SHEAR_SLOPE: f64 = 0.1;

// Slope of the measured on the true values, with its standard error.
#[derive(Clone, Copy)]
pub(crate) struct Slope {
    value: f64,
    error: f64,
}

impl Slope {
    // `None` if the values do not determine it.
    pub(crate) fn of(pairs: &[(f64, f64)]) -> Option<Self> {
        let line = Line::through(pairs);
        let (value, error) = (line.slope, line.slope_error());
        (pairs.len() > 2 && line.is_determined()).then_some(Slope { value, error })
    }

    fn differs_from(self, other: f64) -> bool {
        (self.value - other).abs() > MIN_ENTRY_SLOPE_SIGNIFICANCE * self.error
    }

    // Whether it is above zero, and not below `least`.
    pub(crate) fn is_clear(self, least: f64) -> bool {
        self.value > 0.0
            && self.differs_from(0.0)
            && (self.value >= least || !self.differs_from(least))
    }
}

impl Display for Slope {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.3} ± {:.3}", self.value, self.error)
    }
}

// Why submitted shears are no measurement of those in the file `truth`. `pairs` are true and submitted shears.
pub(crate) fn disagreement(pairs: &[(Shear, Shear)], truth: &Path) -> Option<String> {
    let component = |g: Shear, k: usize| [g.e1, g.e2][k];
    let slope = |of: usize, on: usize| {
        let values = pairs
            .iter()
            .map(|(g, own)| (component(*g, on), component(*own, of)));
        Slope::of(&values.collect::<Vec<_>>())
    };
    let (Some(g1), Some(g2), Some(g1_on_g2), Some(g2_on_g1)) =
        (slope(0, 0), slope(1, 1), slope(0, 1), slope(1, 0))
    else {
        return Some(format!(
            "whether it follows the true shear cannot be determined (found {} fields in {}, expected at least 3 whose true g1 and g2 differ)",
            pairs.len(),
            truth.display()
        ));
    };
    let (own, cross) = ([g1, g2], [g1_on_g2, g2_on_g1]);
    let wrong = own
        .iter()
        .position(|slope| !slope.is_clear(MIN_SHEAR_SLOPE))?;
    let stronger =
        |k: usize| cross[k].differs_from(0.0) && cross[k].value.abs() > own[k].value.abs();
    let (found, name) = (own[wrong], ["g1", "g2"][wrong]);
    let cause = if stronger(0) && stronger(1) {
        "g1 and g2 are probably exchanged"
    } else if found.differs_from(0.0) && found.value <= -MIN_SHEAR_SLOPE {
        "its sign is probably wrong"
    } else {
        "it contains no measurable shear"
    };
    Some(format!(
        "{name} does not follow the true {name} (found a slope of {found}, expected about 1): {cause}"
    ))
}

// Largest residual of a field in standard deviations of the others, and least one in the scatter of the true shears: exchanged fields
// have residuals of about this scatter. Chosen by hand.
const MAX_FIELD_RESIDUAL: f64 = 8.0;
const MIN_ODD_RESIDUAL: f64 = 0.5;
// Share of the fields from which on they are no exceptions: the submission is of another kind then. Chosen by hand.
const MAX_ODD_SHARE: f64 = 0.25;

// A warning about fields that follow the truth differently from the others. Each of `quantities` has the true and the submitted
// value of each field.
pub(crate) fn odd_fields(quantities: &[Vec<(f64, f64)>]) -> Option<String> {
    let (mut odd, mut count) = (BTreeSet::new(), 0);
    for pairs in quantities {
        count = pairs.len();
        let residuals = pairs.iter().map(|(truth, own)| own - truth);
        let residuals: Vec<f64> = residuals.collect();
        let (centre, deviation) = scatter(&mut residuals.clone())?;
        let mut true_values = RunningMean::default();
        pairs.iter().for_each(|(truth, _)| true_values.add(*truth));
        let most = (MAX_FIELD_RESIDUAL * deviation).max(MIN_ODD_RESIDUAL * true_values.deviation());
        odd.extend((0..count).filter(|k| (residuals[*k] - centre).abs() > most));
    }
    let names: Vec<String> = odd.iter().map(usize::to_string).collect();
    (!names.is_empty() && (names.len() as f64) < MAX_ODD_SHARE * count as f64).then(|| {
        format!(
            "{} of {count} fields do not follow the truth as the others do: {}. Were fields exchanged?",
            names.len(),
            names_of(&names)
        )
    })
}
