//! Jackknife errors over groups of images: of a metric, and of differences on the same images.

/// Most groups of images that the jackknife leaves out in turn.
pub const MAX_GROUPS: usize = 20;

/// Number of images in each jackknife group if `images` are assigned to groups in turn.
pub fn group_sizes(images: usize) -> Vec<usize> {
    let groups = images.min(MAX_GROUPS);
    (0..groups)
        .map(|g| (images - g).div_ceil(MAX_GROUPS))
        .collect()
}

/// Standard error of a metric by the delete-a-group jackknife for groups of unequal size (Busing,
/// Meijer & van der Leeden 1999, Stat. Comput. 9, 3).
///
/// `full` is the metric from all `images`; `replicates` are its values with each group left out. For equal groups
/// it is Tukey's √((G−1)/G · Σ(θ_g − θ̄)²). Not a number with fewer than two groups.
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

/// Mean of a metric over sets and its standard error. The noise of sets is independent, so variances add:
/// error = √(Σ σ²)/N. Not a number if one error is unknown.
pub fn mean_over_sets(values_and_errors: &[(f64, f64)]) -> (f64, f64) {
    let count = values_and_errors.len() as f64;
    let mean = values_and_errors.iter().map(|v| v.0).sum::<f64>() / count;
    let variance: f64 = values_and_errors.iter().map(|v| v.1 * v.1).sum();
    (mean, variance.sqrt() / count)
}

/// Difference of two metrics measured on the same images, with its error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairedDifference {
    /// Mean over sets of (second − first).
    pub difference: f64,
    /// Its jackknife error. Noise common to both cancels in each replicate. Not a number if a set has fewer
    /// than [`MIN_REPLICATES`].
    pub error: f64,
}

impl PairedDifference {
    /// Significance: difference / error.
    pub fn sigma(&self) -> f64 {
        self.difference / self.error
    }
}

/// Fewest replicates for the error of a difference. A few replicates miss the products of noise of two images:
/// the error is up to ten times too small for two images, and a quarter too small for six.
pub const MIN_REPLICATES: usize = 8;

/// Paired difference over sets, second minus first. `None` without sets, or if the numbers of replicates differ.
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

/// One metric of one set in two configurations.
#[derive(Debug, Clone, Copy)]
pub struct PairedSet<'a> {
    /// Images of the set.
    pub images: usize,
    /// Metric of the first configuration.
    pub first: f64,
    /// Its replicates, each with one group left out.
    pub first_replicates: &'a [f64],
    /// Metric of the second configuration.
    pub second: f64,
    /// Its replicates, groups in the same order.
    pub second_replicates: &'a [f64],
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_assigned_to_groups_in_turn() {
        assert_eq!(group_sizes(3), vec![1, 1, 1]);
        assert_eq!(group_sizes(20), vec![1; 20]);
        let sizes = group_sizes(30);
        assert_eq!((sizes.len(), sizes[9], sizes[10]), (20, 2, 1));
        assert_eq!(group_sizes(200), vec![10; 20]);
    }

    #[test]
    fn bias_that_depends_on_the_number_of_images_is_no_scatter() {
        // θ = S + N/K without any noise: groups of one and of two images shift it differently.
        let theta = |images: f64| 3.0 + 7.0 / images;
        let replicates = group_sizes(30).into_iter().map(|m| theta(30.0 - m as f64));
        assert!(jackknife_error(theta(30.0), replicates, 30) < 1e-12);
    }
}
