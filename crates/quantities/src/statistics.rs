//! Means, scatters and medians, and the range of measured quantities.

/// Mean and standard deviation of numbers that come one by one (Welford 1962). Sums of squares would lose the digits that a
/// large mean costs.
#[derive(Debug, Clone, Copy, Default)]
pub struct RunningMean {
    count: usize,
    mean: f64,
    squares: f64,
}

impl RunningMean {
    /// Adds a number.
    pub fn add(&mut self, value: f64) {
        self.count += 1;
        let off = value - self.mean;
        self.mean += off / self.count as f64;
        self.squares += off * (value - self.mean);
    }

    /// The number of numbers.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Their mean; NaN without numbers.
    pub fn mean(&self) -> f64 {
        match self.count {
            0 => f64::NAN,
            _ => self.mean,
        }
    }

    /// Their standard deviation, unbiased in its square; NaN of fewer than two.
    pub fn deviation(&self) -> f64 {
        match self.count {
            0 | 1 => f64::NAN,
            count => (self.squares / (count - 1) as f64).sqrt(),
        }
    }
}

/// Standard deviation of Gaussian numbers in units of the median of their moduli: 1/Φ⁻¹(3/4).
pub const FROM_MODULI: f64 = 1.482_602_2;
/// [`FROM_MODULI`] in single precision.
pub const SCATTER: f32 = FROM_MODULI as f32;
/// Standard error of a median in units of the standard error of the mean: √(π/2).
pub const OF_MEDIAN: f64 = 1.253_314;

/// The lower median of finite values; reorders them. `None` without values.
pub fn median<T: Copy + Into<f64>>(values: &mut [T]) -> Option<T> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(ranked(values, middle))
}

/// The upper median of finite values; reorders them. `None` without values.
pub fn upper_median<T: Copy + Into<f64>>(values: &mut [T]) -> Option<T> {
    (!values.is_empty()).then(|| ranked(values, values.len() / 2))
}

/// The usual median of finite values, the mean of the two middle ones of an even number; reorders them. `None` without values.
pub fn midpoint_median(values: &mut [f32]) -> Option<f32> {
    let upper = upper_median(values)?;
    let half = values.len() / 2;
    if values.len() % 2 == 1 {
        return Some(upper);
    }
    // Ranking left the lower half before it.
    let lower = values[..half].iter().copied().fold(f32::MIN, f32::max);
    Some(0.5 * (lower + upper))
}

fn ranked<T: Copy + Into<f64>>(values: &mut [T], rank: usize) -> T {
    let by_value = |a: &T, b: &T| Into::<f64>::into(*a).total_cmp(&(*b).into());
    *values.select_nth_unstable_by(rank, by_value).1
}

/// The lower median of finite values and their standard deviation, from the median of their distances to it. Reorders the
/// values. `None` without values.
pub fn scatter(values: &mut [f64]) -> Option<(f64, f64)> {
    let middle = median(values)?;
    let mut moduli: Vec<f64> = values.iter().map(|value| (value - middle).abs()).collect();
    Some((middle, FROM_MODULI * median(&mut moduli)?))
}

/// Standard errors by which a mean response to shear must exceed zero before anything is divided by it.
// Chosen by hand.
pub const MIN_RESPONSE_SIGNIFICANCE: f64 = 3.0;

/// The range of a measured quantity. Numbers outside of it, such as −99 or 1e30, stand for a measurement that failed.
///
/// Noise alone reaches far: ratios of noisy moments have tails like those of a Cauchy distribution, so that |e| of 20
/// occurs among 500 galaxies at S/N 40. Numbers for failures differ from such outliers because they are whole, or because no
/// tail reaches them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredRange {
    /// Largest modulus of a whole number.
    whole: f64,
    /// Largest modulus.
    any: f64,
}

// Whole numbers that are so many times the typical modulus stand for a failure: −10 among ellipticities of 0.1 to 0.5, which
// is HSM's. The whole numbers 0 and ±1 are values of honest catalogues, such as weights, responses and round galaxies.
const WHOLE: f64 = 10.0;
// Of a Cauchy distribution, one in 16 000 values exceeds the median by this factor.
const OUTLIER: f64 = 1e4;
// The same for quantities in other units, such as an ellipticity times the flux, which itself spans a factor of 10⁴, and
// derivatives of smooth cuts, which are exponentially small for most galaxies.
const OUTLIER_IN_OTHER_UNITS: f64 = 1e12;
// Single-precision numbers from 2²³ on are all whole.
const FRACTIONS_END: f64 = 8_388_608.0;

impl Default for MeasuredRange {
    fn default() -> Self {
        Self::ELLIPTICITY
    }
}

impl MeasuredRange {
    /// Ellipticities of either definition, and quantities that are about one.
    pub const ELLIPTICITY: Self = MeasuredRange {
        whole: WHOLE * 0.5,
        any: OUTLIER * 0.5,
    };

    /// The range of a quantity in unknown units. The typical modulus is the median of the moduli that occur, each counted
    /// once, so that a number for failures does not shift it although most rows may have it.
    pub fn from_values(values: &[f64]) -> Self {
        let moduli = values.iter().map(|value| value.abs());
        let mut moduli: Vec<f64> = moduli.filter(|m| m.is_finite() && *m > 0.0).collect();
        moduli.sort_unstable_by(f64::total_cmp);
        let usual = moduli.get(moduli.len() / 2).copied();
        moduli.dedup();
        // Of a constant response and −9 in 1 % of the rows, half of the moduli that occur are 9.
        let different = moduli.get(moduli.len() / 2).copied();
        let Some(typical) = usual.zip(different).map(|(a, b)| a.min(b)) else {
            return Self::ELLIPTICITY;
        };
        MeasuredRange {
            whole: WHOLE * typical,
            any: OUTLIER_IN_OTHER_UNITS * typical,
        }
    }

    /// Whether a number stands for a failure.
    pub fn excludes(self, value: f64) -> bool {
        let modulus = value.abs();
        // Few numbers are so large, and `fract` calls a function on old processors.
        let is_whole = || modulus < FRACTIONS_END && modulus.fract() == 0.0;
        modulus > self.any || modulus > self.whole && (is_whole() || is_mark(modulus))
    }

    /// Whether a number beyond the typical ones is written by nines, or is a power of ten.
    pub fn excludes_mark(self, value: f64) -> bool {
        value.abs() > self.whole && is_mark(value.abs())
    }
}

// 9.99, 99, 9999 and 1e20 in either precision: measured numbers have other digits.
fn is_mark(modulus: f64) -> bool {
    let is_of_nines = |text: &str| {
        let mut digits = text.bytes().filter(|digit| *digit != b'.');
        text.len() > 1 && digits.all(|digit| digit == b'9')
    };
    let is_power = |text: &str| {
        text.len() > 5 && text.starts_with('1') && text[1..].bytes().all(|digit| digit == b'0')
    };
    let single = modulus as f32;
    let either = [modulus.to_string(), single.to_string()];
    let either = match f64::from(single) == modulus {
        true => &either[..],
        false => &either[..1],
    };
    either
        .iter()
        .any(|text| is_of_nines(text) || is_power(text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_running_mean_keeps_its_digits() {
        let mut running = RunningMean::default();
        assert!(running.mean().is_nan() && running.deviation().is_nan());
        for value in [1.0, 2.0, 6.0] {
            running.add(1e9 + value);
        }
        assert_eq!((running.count(), running.mean()), (3, 1e9 + 3.0));
        assert_eq!(running.deviation(), 7.0f64.sqrt());
    }

    #[test]
    fn numbers_of_nines_stand_for_failures() {
        let range = MeasuredRange::ELLIPTICITY;
        for value in [
            -9.99,
            -9.9,
            99.0,
            -99.9,
            9999.0,
            1e20,
            -999.25_f64.trunc(),
            f64::from(-9.99_f32),
        ] {
            assert!(range.excludes(value), "{value}");
        }
        for value in [0.99, -0.999, 9.98, 9.5, -12.75] {
            assert!(!range.excludes(value), "{value}");
        }
        // A constant response beside a failure.
        let values: Vec<f64> = (0..1000)
            .map(|k| if k % 100 == 0 { -9.0 } else { 0.7 })
            .collect();
        assert!(MeasuredRange::from_values(&values).excludes(-9.0));
        let weights = MeasuredRange::from_values(&[0.5, 2.0, 14.0]);
        assert!(
            weights.excludes_mark(9999.0)
                && weights.excludes_mark(1e10)
                && !weights.excludes_mark(400.0)
        );
    }

    #[test]
    fn medians_are_lower_ones_in_either_precision() {
        assert_eq!(median(&mut [3.0f32, 1.0, 2.0, 4.0]), Some(2.0));
        assert_eq!(median(&mut [-3.0f64, 1.0, -2.0]), Some(-2.0));
        assert_eq!(median::<f64>(&mut []), None);
        assert_eq!(upper_median(&mut [3.0f32, 1.0, 2.0, 4.0]), Some(3.0));
        assert_eq!(upper_median(&mut [-3.0f64, 1.0, -2.0]), Some(-2.0));
        assert_eq!(upper_median::<f64>(&mut []), None);
        assert_eq!(midpoint_median(&mut [3.0, 1.0, 2.0, 4.0]), Some(2.5));
        assert_eq!(midpoint_median(&mut [-3.0, 1.0, -2.0]), Some(-2.0));
        assert_eq!(midpoint_median(&mut []), None);
        assert_eq!(SCATTER, 1.482_602_2f32);
    }

    #[test]
    fn the_scatter_is_that_of_gaussian_numbers() {
        // Moduli 0, 1, 1, 2, 95, of which 1 is the median.
        let found = scatter(&mut [5.0, 4.0, 6.0, 7.0, 100.0]);
        assert_eq!(found, Some((6.0, FROM_MODULI)));
        assert_eq!(scatter(&mut []), None);
    }

    #[test]
    fn failures_are_excluded_and_outliers_are_not() {
        let own = MeasuredRange::ELLIPTICITY;
        for failure in [-10.0, -99.0, 99.0, -9999.0, 1e20, -1e20, 1e30, f64::MAX] {
            assert!(own.excludes(failure), "{failure}");
        }
        // The largest of HSM's KSB among 256 galaxies of a simulation.
        for value in [0.0, -1.0, 1.09, 21.6099, -7.02415, f64::NAN] {
            assert!(!own.excludes(value), "{value}");
        }
    }

    #[test]
    fn the_range_follows_units_although_most_rows_failed() {
        let of = |scale: f64, failure: f64| {
            let mut values: Vec<f64> = (1..100).map(|k| scale * (k as f64).sqrt()).collect();
            values.extend(vec![failure; 900]);
            MeasuredRange::from_values(&values)
        };
        let small = of(0.003_001, -1.0);
        assert!(small.excludes(-1.0) && !small.excludes(0.03));
        // Single-precision fluxes are whole numbers.
        let large = of(1e7, -9999.0);
        assert!(large.excludes(1e30) && !large.excludes(4e9));
        assert_eq!(
            MeasuredRange::from_values(&[0.0]),
            MeasuredRange::ELLIPTICITY
        );
    }
}
