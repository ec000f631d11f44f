//! Means, scatters and medians.

/// Mean and scatter of numbers that come one by one, in a way that keeps the digits which a large mean would cost.
#[derive(Debug, Clone, Copy, Default)]
pub struct RunningMean {
    count: usize,
    mean: f64,
    squares: f64,
}

impl RunningMean {
    /// Takes one more.
    pub fn add(&mut self, value: f64) {
        self.count += 1;
        let off = value - self.mean;
        self.mean += off / self.count as f64;
        self.squares += off * (value - self.mean);
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Their mean; not a number of none.
    pub fn mean(&self) -> f64 {
        match self.count {
            0 => f64::NAN,
            _ => self.mean,
        }
    }

    /// Their standard deviation, unbiased in its square; not a number of fewer than two.
    pub fn deviation(&self) -> f64 {
        match self.count {
            0 | 1 => f64::NAN,
            count => (self.squares / (count - 1) as f64).sqrt(),
        }
    }
}

/// Scatter of Gaussian numbers in units of the median of their moduli.
pub const SCATTER: f32 = 1.482_602_2;

/// The lower median of finite values; reorders them. `None` of none.
pub fn median(values: &mut [f32]) -> Option<f32> {
    if values.is_empty() {
        return None;
    }
    let middle = (values.len() - 1) / 2;
    let (_, median, _) = values.select_nth_unstable_by(middle, f32::total_cmp);
    Some(*median)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_running_mean_is_that_of_all_and_keeps_its_digits() {
        let mut running = RunningMean::default();
        assert!(running.mean().is_nan() && running.deviation().is_nan());
        for value in [1.0, 2.0, 6.0] {
            running.add(1e9 + value);
        }
        assert_eq!((running.count(), running.mean()), (3, 1e9 + 3.0));
        assert_eq!(running.deviation(), 7.0f64.sqrt());
    }
}
