//! Means, scatters and medians.

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
    fn medians_are_lower_ones_in_either_precision() {
        assert_eq!(median(&mut [3.0f32, 1.0, 2.0, 4.0]), Some(2.0));
        assert_eq!(median(&mut [-3.0f64, 1.0, -2.0]), Some(-2.0));
        assert_eq!(median::<f64>(&mut []), None);
        assert_eq!(upper_median(&mut [3.0f32, 1.0, 2.0, 4.0]), Some(3.0));
        assert_eq!(upper_median(&mut [-3.0f64, 1.0, -2.0]), Some(-2.0));
        assert_eq!(upper_median::<f64>(&mut []), None);
        assert_eq!(SCATTER, 1.482_602_2f32);
    }

    #[test]
    fn the_scatter_is_that_of_gaussian_numbers() {
        // Moduli 0, 1, 1, 2, 95, of which 1 is the median.
        let found = scatter(&mut [5.0, 4.0, 6.0, 7.0, 100.0]);
        assert_eq!(found, Some((6.0, FROM_MODULI)));
        assert_eq!(scatter(&mut []), None);
    }
}
