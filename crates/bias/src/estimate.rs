//! Estimates with errors from a jackknife over units, which contain the correlation of galaxies within a unit.

use crate::arms::{Totals, Unit, Units};
use crate::design::Grouping;
use crate::error::{BiasError, MIN_FITTED_RESPONSE_SIGNIFICANCE};
use crate::fit::{ESTIMATES, Estimates, Known, M, MEAN_M, Plan, RESPONSE};
use crate::stars::Behind;
use crate::sums::{COUNT, WEIGHT, WEIGHT2, add};

/// A quantity that is estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantity {
    /// Key in CSV and JSON.
    pub key: &'static str,
    /// Name in tables.
    pub label: &'static str,
    /// What it is.
    pub meaning: &'static str,
}

const fn quantity(key: &'static str, label: &'static str, meaning: &'static str) -> Quantity {
    Quantity {
        key,
        label,
        meaning,
    }
}

/// The quantities, in the order in which they are estimated.
pub const QUANTITIES: [Quantity; ESTIMATES] = [
    quantity("m1", "m1", "multiplicative bias of g1"),
    quantity("c1", "c1", "additive bias of g1"),
    quantity("m2", "m2", "multiplicative bias of g2"),
    quantity("c2", "c2", "additive bias of g2"),
    quantity("m_plus", "m+", "multiplicative bias along the PSF"),
    quantity("c_plus", "c+", "additive bias along the PSF"),
    quantity(
        "m_cross",
        "m×",
        "multiplicative bias at 45 degrees to the PSF",
    ),
    quantity("c_cross", "c×", "additive bias at 45 degrees to the PSF"),
    quantity("alpha", "α", "shear per ellipticity of the PSF"),
    quantity("alpha1", "α1", "the same of component 1"),
    quantity("alpha2", "α2", "the same of component 2"),
    quantity(
        "alpha_size",
        "dα/dlnT",
        "change of α with a relative change of PSF size",
    ),
    quantity("q1", "q1", "quadratic term of g1"),
    quantity("q2", "q2", "quadratic term of g2"),
    quantity("m12", "m12", "change of the estimate of g1 with g2"),
    quantity("m21", "m21", "change of the estimate of g2 with g1"),
    quantity("r1", "⟨R11⟩", "mean response of component 1"),
    quantity("r2", "⟨R22⟩", "mean response of component 2"),
    quantity("r12", "⟨R12⟩", "mean response of e1 to g2"),
    quantity("r21", "⟨R21⟩", "mean response of e2 to g1"),
    quantity(
        "m_mean",
        "(m1+m2)/2",
        "mean multiplicative bias (m1 + m2)/2",
    ),
    quantity("r_mean", "⟨R⟩", "mean response (R11 + R22)/2"),
];

/// A value with its standard error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// The value.
    pub value: f64,
    /// Its standard error.
    pub error: f64,
}

/// Estimates of a bin: values and standard errors of [`QUANTITIES`].
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Estimate {
    /// Galaxies.
    pub galaxies: usize,
    /// Effective number of galaxies, (Σ w)² / Σ w² (Kish 1965): this number of galaxies with equal weights has the same
    /// information.
    pub effective: f64,
    /// Units.
    pub units: usize,
    values: Estimates,
    errors: Estimates,
    /// Per component: whether m assumes that c is zero, because all true shears are equal.
    pub assumes_no_c: [bool; 2],
}

impl Estimate {
    /// The quantity called `key`; `None` if the data do not determine it.
    pub fn value(&self, key: &str) -> Option<Measured> {
        let place = QUANTITIES.iter().position(|quantity| quantity.key == key)?;
        let (value, error) = (self.values[place], self.errors[place]);
        value.is_finite().then_some(Measured { value, error })
    }

    /// Error of a shear component from 1 arcmin², of both components in quadrature: σ(c)·√A, of units that have the `area` each in
    /// arcmin². It contains the factor 1 + m of the measured shears.
    pub fn shear_error(&self, area: f64) -> Option<f64> {
        let of = |key| self.value(key).map(|c| c.error);
        let squares = of("c1")?.powi(2) + of("c2")?.powi(2);
        Some((0.5 * squares * area * self.units as f64).sqrt())
    }

    /// Covariance of m1 and m2; `None` if the data do not determine both.
    pub fn covariance(&self) -> Option<f64> {
        // Of the variances of m1, m2 and (m1 + m2)/2, which contain the noise of stars, too.
        let variance = |place: usize| self.errors[place] * self.errors[place];
        let covariance = 2.0 * variance(MEAN_M) - (variance(M[0]) + variance(M[1])) / 2.0;
        covariance.is_finite().then_some(covariance)
    }
}

/// Estimates of a `bin`, with `truth` whether the true shears are known; without, only c, α and responses follow.
/// Errors do not contain the noise of stars; see [`Grouping::estimate`].
///
/// # Errors
/// [`BiasError::NoGalaxies`] or [`BiasError::FewUnits`] if no galaxy or only one unit was added to the bin,
/// [`BiasError::Sheared`] if a sheared catalogue lacks, and
/// [`BiasError::Response`] if a mean response is below five standard errors.
pub fn estimate(units: &Units, bin: usize, truth: bool) -> Result<Estimate, BiasError> {
    behind_stars((units, &[]), (bin, None), truth)
}

impl Grouping {
    /// Estimates of a bin. Errors include the noise of stars that several units share, to first order.
    ///
    /// # Errors
    /// As [`estimate`].
    pub fn estimate(&self, bin: usize, truth: bool) -> Result<Estimate, BiasError> {
        behind_stars((&self.units, &self.stars), (bin, None), truth)
    }

    /// Estimates for another population, in which the weights of the galaxies of bin k have the share `shares[k]`: the
    /// galaxies of each bin are weighted by `shares[k]`/Σ w of the bin. Errors are those of the weighted galaxies; the
    /// shares are known exactly. Bins without galaxies have to have no share.
    ///
    /// # Errors
    /// As [`estimate`].
    pub fn estimate_like(&self, shares: &[f64], truth: bool) -> Result<Estimate, BiasError> {
        behind_stars((&self.units, &self.stars), (0, Some(shares)), truth)
    }
}

fn behind_stars(
    (units, stars): (&Units, &[Behind]),
    (bin, shares): (usize, Option<&[f64]>),
    truth: bool,
) -> Result<Estimate, BiasError> {
    let count = shares.map_or(1, <[f64]>::len);
    let layout = units.layout();
    let units = units.of_bins(bin, count);
    let totals = Totals::new(layout, &units, shares);
    let total = &totals.all;
    if total[COUNT] == 0.0 {
        return Err(BiasError::NoGalaxies);
    }
    if let Some(name) = totals.lacking {
        return Err(BiasError::Sheared { name });
    }
    if units.len() < 2 {
        return Err(BiasError::FewUnits { found: units.len() });
    }
    // The bins and terms that all units determine are estimated from each part of them: a unit that is left out changes
    // values, not their meaning.
    let plan = Plan::new(layout.with_response(), total, truth);
    let values = plan.estimates(total);
    let left_out = units
        .iter()
        .map(|unit| plan.estimates(&totals.without(unit)));
    let mut errors = jackknife(&left_out.collect::<Vec<_>>());
    for star in stars {
        let behind = star.units.of_bins(bin, count);
        let sums = behind.iter().map(|unit| totals.of_unit(unit)).collect();
        let more = variances(&plan, (total, &values), star, (sums, units.len()));
        for (error, more) in errors.iter_mut().zip(more) {
            *error = error.hypot(more.sqrt());
        }
    }
    for (component, place) in (1..).zip(RESPONSE) {
        let (found, error) = (values[place], errors[place]);
        // Rounding leaves an error of 10⁻¹⁶ for a response of 1.
        if !(found > MIN_FITTED_RESPONSE_SIGNIFICANCE * error && found > 0.0) {
            return Err(BiasError::Response {
                component,
                found,
                error,
            });
        }
    }
    Ok(Estimate {
        galaxies: total[COUNT] as usize,
        effective: total[WEIGHT] * total[WEIGHT] / total[WEIGHT2],
        units: units.len(),
        values,
        errors,
        assumes_no_c: [0, 1].map(|k| plan.known[k] == Known::OnlyM),
    })
}

/// Differences of the estimates of two programs on the same galaxies: `sums` minus `other`. The
/// jackknife leaves out a unit of both, so what both have in common cancels in the errors.
/// They do not include the noise of stars.
///
/// # Errors
/// As [`estimate`], of either program.
pub fn difference(
    units: &Units,
    other: &Units,
    bin: usize,
    truth: bool,
) -> Result<Estimate, BiasError> {
    let first = estimate(units, bin, truth)?;
    let second = estimate(other, bin, truth)?;
    let sides = units.aligned(other);
    let pairs = Units::pairs(&sides, bin);
    let totals = [0, 1].map(|side| {
        let layout = sides[side].layout();
        let own: Vec<Unit<'_>> = pairs.iter().filter_map(|pair| pair[side].clone()).collect();
        let totals = Totals::new(layout, &own, None);
        let plan = Plan::new(layout.with_response(), &totals.all, truth);
        (plan, totals)
    });
    let without = |pair: &[Option<Unit<'_>>; 2]| -> Estimates {
        let [a, b] = [0, 1].map(|side| {
            let (plan, totals) = &totals[side];
            match &pair[side] {
                None => plan.estimates(&totals.all),
                Some(unit) => plan.estimates(&totals.without(unit)),
            }
        });
        std::array::from_fn(|k| a[k] - b[k])
    };
    let left_out: Vec<Estimates> = pairs.iter().map(without).collect();
    Ok(Estimate {
        galaxies: first.galaxies.min(second.galaxies),
        effective: first.effective.min(second.effective),
        units: pairs.len(),
        values: without(&[None, None]),
        errors: jackknife(&left_out),
        assumes_no_c: [0, 1].map(|k| first.assumes_no_c[k] || second.assumes_no_c[k]),
    })
}

// What the noise of a star adds to the variances of the estimates `values` that follow from the sums `total` of `n` units.
// `units` are the sums of the galaxies behind the star.
//
// If the noise changes an estimate by Σ aᵤ, with aᵤ due to the galaxies of unit u, then its variance is A² = (Σ aᵤ)². A
// jackknife contains n/(n − 1) (Σ aᵤ² − A²/n) of it, which is subtracted so that a star counts once.
fn variances(
    plan: &Plan,
    (total, values): (&[f64], &Estimates),
    star: &Behind,
    (units, n): (Vec<Vec<f64>>, usize),
) -> Estimates {
    let mut own = vec![0.0; total.len()];
    for unit in &units {
        add(&mut own, unit);
    }
    let mut more = [0.0; ESTIMATES];
    // m changes in all components alike, and c in each component separately.
    for change in 0..5 {
        let (mut m, mut c) = (0.0, [0.0; 4]);
        match change {
            4 => m = star.m,
            k => c[k] = star.c,
        }
        let effect = |sums: &[f64]| -> Estimates {
            let changed = plan.shifted(total, sums, (m, c));
            std::array::from_fn(|k| changed[k] - values[k])
        };
        let whole = effect(&own).map(|effect| effect * effect);
        let mut known = [0.0; ESTIMATES];
        if star.by_unit {
            for unit in &units {
                for (sum, effect) in known.iter_mut().zip(effect(unit)) {
                    *sum += effect * effect;
                }
            }
            let n = n as f64;
            known = std::array::from_fn(|k| n / (n - 1.0) * (known[k] - whole[k] / n));
        }
        for k in 0..ESTIMATES {
            more[k] += (whole[k] - known[k]).max(0.0);
        }
    }
    more
}

// σ² = (n − 1)/n Σ (θ₍ᵢ₎ − ⟨θ₍ᵢ₎⟩)² (Efron & Stein 1981, Annals of Statistics 9, 586).
fn jackknife(left_out: &[Estimates]) -> Estimates {
    let n = left_out.len() as f64;
    // In two passes: the squares of m would lose digits if its error is 10⁻⁸.
    std::array::from_fn(|k| {
        let mean = left_out.iter().map(|values| values[k]).sum::<f64>() / n;
        let squares = left_out.iter().map(|values| (values[k] - mean).powi(2));
        ((n - 1.0) / n * squares.sum::<f64>()).sqrt()
    })
}
