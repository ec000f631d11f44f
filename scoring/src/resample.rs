//! Errors by the jackknife over groups of images, alone and for differences on the same images.

/// Standard error of a figure from its delete-one replicates:
/// √((G−1)/G · Σ(θ_g − θ̄)²) (Tukey's jackknife). Not a number with fewer than two replicates.
pub fn jackknife_error(replicates: impl IntoIterator<Item = f64>) -> f64 {
    let values: Vec<f64> = replicates.into_iter().collect();
    let count = values.len() as f64;
    if count < 2.0 {
        return f64::NAN;
    }
    let mean = values.iter().sum::<f64>() / count;
    let square: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    ((count - 1.0) / count * square).sqrt()
}

/// Mean over sets of a figure and its standard error. Sets have noise of their own, so their
/// variances add: error = √(Σ σ²)/N.
pub fn mean_over_sets(values_and_errors: &[(f64, Option<f64>)]) -> (f64, Option<f64>) {
    let count = values_and_errors.len() as f64;
    let mean = values_and_errors.iter().map(|v| v.0).sum::<f64>() / count;
    let variance = values_and_errors
        .iter()
        .map(|v| v.1.map(|e| e * e))
        .sum::<Option<f64>>();
    (mean, variance.map(|v| v.sqrt() / count))
}

/// Difference of two figures measured on the same images, in units of its own error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairedDifference {
    /// Mean over sets of (second − first).
    pub difference: f64,
    /// Its jackknife error: noise common to both cancels in each replicate.
    pub error: f64,
}

impl PairedDifference {
    /// difference / error.
    pub fn sigma(&self) -> f64 {
        self.difference / self.error
    }
}

/// Paired difference over sets: each item is one set's (value, replicates) of the first and of the
/// second variant. `None` where a set's replicates are fewer than two or do not pair up.
pub fn paired_difference(sets: &[PairedSet<'_>]) -> Option<PairedDifference> {
    if sets.is_empty() {
        return None;
    }
    let count = sets.len() as f64;
    let mut difference = 0.0;
    let mut variance = 0.0;
    for set in sets {
        if set.first_replicates.len() != set.second_replicates.len()
            || set.first_replicates.len() < 2
        {
            return None;
        }
        difference += (set.second - set.first) / count;
        let pairs = set.first_replicates.iter().zip(set.second_replicates);
        variance += jackknife_error(pairs.map(|(a, b)| b - a)).powi(2);
    }
    Some(PairedDifference {
        difference,
        error: variance.sqrt() / count,
    })
}

/// One figure of one set under two variants.
#[derive(Debug, Clone, Copy)]
pub struct PairedSet<'a> {
    /// The first variant's figure.
    pub first: f64,
    /// Its delete-one replicates.
    pub first_replicates: &'a [f64],
    /// The second variant's figure.
    pub second: f64,
    /// Its delete-one replicates, groups in the same order.
    pub second_replicates: &'a [f64],
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jackknife_of_a_mean_is_its_standard_error() {
        let data = [1.0, 4.0, 2.0, 7.0, 5.0];
        let n = data.len() as f64;
        let sum: f64 = data.iter().sum();
        let mean = sum / n;
        let standard =
            (data.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n * (n - 1.0))).sqrt();
        let error = jackknife_error(data.iter().map(|v| (sum - v) / (n - 1.0)));
        assert!((error / standard - 1.0).abs() < 1e-12);
        assert!(jackknife_error([1.0]).is_nan());
    }

    #[test]
    fn common_noise_cancels_in_a_paired_difference() {
        let first = [1.0, 2.0, 3.0];
        let second = first.map(|v| v + 0.5);
        let paired = paired_difference(&[PairedSet {
            first: 2.0,
            first_replicates: &first,
            second: 2.5,
            second_replicates: &second,
        }])
        .unwrap();
        assert_eq!(paired.difference, 0.5);
        assert!(paired.error < 1e-15);
    }
}
