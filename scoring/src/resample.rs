//! Errors by the jackknife over groups of images, alone and for differences on the same images.

use crate::score::MAX_GROUPS;

/// Images in each jackknife group when `images` are dealt out in turn.
pub fn group_sizes(images: usize) -> Vec<usize> {
    let groups = images.min(MAX_GROUPS);
    (0..groups)
        .map(|g| (images - g).div_ceil(MAX_GROUPS))
        .collect()
}

/// Standard error of a metric by the delete-a-group jackknife for groups of unequal size (Busing,
/// Meijer & van der Leeden 1999, Stat. Comput. 9, 3): `full` is the metric from all `images`,
/// `replicates` those with each group left out. For equal groups it is Tukey's
/// √((G−1)/G · Σ(θ_g − θ̄)²). Not a number with fewer than two groups.
pub fn jackknife_error(full: f64, replicates: impl IntoIterator<Item = f64>, images: usize) -> f64 {
    let sizes = group_sizes(images);
    let values: Vec<f64> = replicates.into_iter().collect();
    if values.len() < 2 || values.len() != sizes.len() {
        return f64::NAN;
    }
    let groups = values.len() as f64;
    let total = images as f64;
    let pairs = || {
        values
            .iter()
            .zip(&sizes)
            .map(|(&value, &size)| (value, total / size as f64))
    };
    let mean = groups * full
        - pairs()
            .map(|(value, h)| (1.0 - 1.0 / h) * value)
            .sum::<f64>();
    let variance = pairs()
        .map(|(value, h)| {
            let pseudo = h * full - (h - 1.0) * value;
            (pseudo - mean).powi(2) / (h - 1.0)
        })
        .sum::<f64>()
        / groups;
    variance.sqrt()
}

/// Mean over sets of a metric and its standard error. Sets have noise of their own, so their
/// variances add: error = √(Σ σ²)/N, not a number where one of them is unknown.
pub fn mean_over_sets(values_and_errors: &[(f64, f64)]) -> (f64, f64) {
    let count = values_and_errors.len() as f64;
    let mean = values_and_errors.iter().map(|v| v.0).sum::<f64>() / count;
    let variance: f64 = values_and_errors.iter().map(|v| v.1 * v.1).sum();
    (mean, variance.sqrt() / count)
}

/// Difference of two metrics measured on the same images, in units of its own error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairedDifference {
    /// Mean over sets of (second − first).
    pub difference: f64,
    /// Its jackknife error: noise common to both cancels in each replicate. Not a number where a set has
    /// fewer than [`MIN_REPLICATES`].
    pub error: f64,
}

impl PairedDifference {
    /// difference / error.
    pub fn sigma(&self) -> f64 {
        self.difference / self.error
    }
}

/// Fewest replicates that tell the error of a difference. Noise of one image times noise of another is in
/// none of a few replicates: from two images the error comes out up to ten times too small, from six by a
/// quarter.
pub const MIN_REPLICATES: usize = 8;

/// Paired difference over sets: each item is one set's (value, replicates) of the first and of the
/// second variant. `None` where there is no set or replicates do not pair up.
pub fn paired_difference(sets: &[PairedSet<'_>]) -> Option<PairedDifference> {
    if sets.is_empty() {
        return None;
    }
    let count = sets.len() as f64;
    let mut difference = 0.0;
    let mut variance = 0.0;
    for set in sets {
        let pairs = set.first_replicates.iter().zip(set.second_replicates);
        let full = set.second - set.first;
        let count_of = set.first_replicates.len();
        if set.second_replicates.len() != count_of {
            return None;
        }
        let error = match count_of >= MIN_REPLICATES {
            true => jackknife_error(full, pairs.map(|(a, b)| b - a), set.images),
            false => f64::NAN,
        };
        difference += full / count;
        variance += error.powi(2);
    }
    Some(PairedDifference {
        difference,
        error: variance.sqrt() / count,
    })
}

/// One metric of one set under two variants.
#[derive(Debug, Clone, Copy)]
pub struct PairedSet<'a> {
    /// Images of the set.
    pub images: usize,
    /// The first variant's metric.
    pub first: f64,
    /// Its delete-one replicates.
    pub first_replicates: &'a [f64],
    /// The second variant's metric.
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
        let error = jackknife_error(mean, data.iter().map(|v| (sum - v) / (n - 1.0)), 5);
        assert!((error / standard - 1.0).abs() < 1e-12);
        assert!(jackknife_error(1.0, [1.0], 1).is_nan());
    }

    #[test]
    fn images_are_dealt_to_groups_in_turn() {
        assert_eq!(group_sizes(3), vec![1, 1, 1]);
        assert_eq!(group_sizes(20), vec![1; 20]);
        let sizes = group_sizes(30);
        assert_eq!((sizes.len(), sizes[9], sizes[10]), (20, 2, 1));
        assert_eq!(group_sizes(200), vec![10; 20]);
    }

    #[test]
    fn a_bias_that_falls_with_the_number_of_images_is_no_scatter() {
        // θ = S + N/K without any noise: groups of one and of two images shift it differently.
        let theta = |images: f64| 3.0 + 7.0 / images;
        let replicates = group_sizes(30).into_iter().map(|m| theta(30.0 - m as f64));
        assert!(jackknife_error(theta(30.0), replicates, 30) < 1e-12);
    }

    #[test]
    fn common_noise_cancels_in_a_paired_difference() {
        let first = [1.0, 2.0, 3.0, 1.5, 2.5, 0.5, 3.5, 2.0];
        let second = first.map(|v| v + 0.5);
        let pair = |images: usize, second: &[f64]| {
            paired_difference(&[PairedSet {
                images,
                first: 2.0,
                first_replicates: &first[..images],
                second: 2.5,
                second_replicates: second,
            }])
        };
        let paired = pair(8, &second).unwrap();
        assert_eq!(paired.difference, 0.5);
        assert!(paired.error < 1e-15);
        // Too few to know, and replicates that do not pair up.
        let few = pair(7, &second[..7]).unwrap();
        assert!(few.difference == 0.5 && few.error.is_nan() && few.sigma().is_nan());
        assert_eq!(pair(8, &second[..7]), None);
    }
}
