//! Calibration of ellipticities by their own mean response to shear.

use shearq_quantities::statistics::RunningMean;
use shearq_submissions::{Calibration, Configuration};

use crate::flag::Flag;
use crate::measurement::Measurement;

/// Least significance of the mean response before anything is divided by it. See docs/constants.md.
const CLEAR: f64 = 3.0;

/// Divides the ellipticities of an image, all of whose galaxies are given, as the configuration asks: each component by
/// its mean response over the good galaxies, which is returned; `None` if nothing is divided.
///
/// One galaxy's response is far too noisy to divide by (and correlated with its ellipticity); the
/// mean over 10,000 has an error of 0.2 to 0.5 %, independent from image to image, so that the error
/// of a set's mean ellipticity is far below a thousandth. Where a mean is not positive by three of its errors, as where
/// there are no galaxies on the stamps, all are flagged. (One galaxy's has no error, and need be positive alone.)
pub fn calibrate(configuration: &Configuration, galaxies: &mut [Measurement]) -> Option<[f64; 2]> {
    if configuration.calibration() == Calibration::None {
        return None;
    }
    let good = || galaxies.iter().filter(|g| g.flags.is_empty());
    let count = good().count() as f64;
    // Components apart: lags on a square grid, and PSFs with a direction, tell them from each other.
    let means = [0, 1].map(|k| good().map(|g| g.response_diagonal()[k]).sum::<f64>() / count);
    let usable = [0, 1].into_iter().all(|k| {
        let mut responses = RunningMean::default();
        good().for_each(|g| responses.add(g.response_diagonal()[k]));
        let error = responses.deviation() / count.sqrt();
        means[k].is_finite() && means[k] > 0.0 && (count == 1.0 || means[k] >= CLEAR * error)
    });
    for galaxy in galaxies {
        if usable {
            galaxy.e1 /= means[0];
            galaxy.e2 /= means[1];
            galaxy.divisor = Some(means);
            for version in galaxy.versions.iter_mut().flat_map(|all| &mut all.each) {
                version.e1 /= means[0];
                version.e2 /= means[1];
            }
        } else {
            (galaxy.e1, galaxy.e2) = (f64::NAN, f64::NAN);
            galaxy.versions = None;
            galaxy.flags.add(Flag::NoResponse);
        }
    }
    usable.then_some(means)
}

#[cfg(test)]
mod tests {
    use shearq_submissions::Registry;

    use super::*;
    use crate::flag::Flags;

    fn row(responses: &[f64]) -> Vec<Measurement> {
        let galaxies = responses.iter().map(|&r| {
            let nothing = Measurement::flagged(Flag::NoLight);
            Measurement {
                e1: 0.1,
                e2: -0.2,
                response: (!r.is_nan()).then_some([[r, 0.0], [0.0, r]]),
                flags: if r.is_nan() {
                    nothing.flags
                } else {
                    Flags::NONE
                },
                ..nothing
            }
        });
        galaxies.collect()
    }

    #[test]
    fn ellipticities_are_divided_by_the_mean_of_good_galaxies() {
        let registry = Registry::embedded().unwrap();
        let of = |name| registry.get(name).unwrap().configuration;
        let (plain, calibrated) = (of("paper"), of("48/linear/star"));
        let mut rows = row(&[0.4, 0.8, f64::NAN, 0.3]);
        assert_eq!(calibrate(&plain, &mut rows), None);
        assert_eq!(rows[0].e1, 0.1);
        let mean = calibrate(&calibrated, &mut rows).unwrap();
        assert!((mean[0] - 0.5).abs() < 1e-12 && mean[0] == mean[1]);
        assert!((rows[0].e1 - 0.2).abs() < 1e-12);
        assert!(rows.iter().all(|g| g.divisor == Some(mean)));
        assert!((rows[3].e2 + 0.4).abs() < 1e-12);
        // 0.1 ± 0.1 and, of others, 0.1 ± 0.03.
        let unsure = [0.3, -0.1, 0.25, -0.05];
        assert_eq!(calibrate(&calibrated, &mut row(&unsure)), None);
        let scatter = [0.19, 0.01, 0.17, 0.03];
        let mut rows = row(&[scatter, scatter].concat());
        assert!(calibrate(&calibrated, &mut rows).is_some());
        let mut rows = row(&[-0.1, f64::NAN]);
        assert_eq!(calibrate(&calibrated, &mut rows), None);
        assert_eq!(rows[0].flags, Flag::NoResponse.into());
        assert!(rows[0].e1.is_nan());
        assert!(rows[1].flags.contains(Flag::NoLight));
    }
}
