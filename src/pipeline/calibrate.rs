//! Calibration of an image's ellipticities by its own mean response to shear.

use shearq_submissions::{Calibration, Submission};

use super::galaxy::flag;
use super::measure::MeasuredRow;

/// Divides the ellipticities of an image, all of whose rows are given, as the submission asks, each
/// component by its own mean response.
///
/// One galaxy's response is far too noisy to divide by (and correlated with its ellipticity); the
/// mean over 10,000 has an error of 0.2 to 0.5 %, independent from image to image, so that the error
/// of a set's mean ellipticity is far below a thousandth. Where the mean is not positive, all
/// galaxies are flagged.
pub(super) fn calibrate(submission: &Submission, rows: &mut [MeasuredRow]) {
    if submission.shape.calibration == Calibration::None {
        return;
    }
    let good = || {
        rows.iter()
            .flat_map(|row| &row.galaxies)
            .filter(|g| g.flag == 0)
    };
    let count = good().count() as f64;
    // Components apart: lags on a square grid, and PSFs with a direction, tell them from each other.
    let means = [0, 1].map(|k| good().map(|g| g.response[k]).sum::<f64>() / count);
    let usable = means.iter().all(|mean| *mean > 0.0 && mean.is_finite());
    for galaxy in rows.iter_mut().flat_map(|row| &mut row.galaxies) {
        if usable {
            galaxy.e1 /= means[0];
            galaxy.e2 /= means[1];
        } else {
            (galaxy.e1, galaxy.e2) = (f64::NAN, f64::NAN);
            galaxy.flag |= flag::NO_RESPONSE;
        }
    }
}

#[cfg(test)]
mod tests {
    use shearq_scoring::Grid;
    use shearq_submissions::Registry;

    use super::super::galaxy::Measurement;
    use super::super::images::ImageId;
    use super::*;

    fn row(responses: &[f64]) -> MeasuredRow {
        let galaxies = responses.iter().map(|&r| {
            let flag = if r.is_nan() { flag::NO_LIGHT } else { 0 };
            Measurement {
                e1: 0.1,
                e2: -0.2,
                response: [r, r],
                ..Measurement::flagged(flag)
            }
        });
        MeasuredRow {
            id: ImageId { set: 1, image: 1 },
            iy: 0,
            grid: Grid::great10(8).unwrap(),
            galaxies: galaxies.collect(),
        }
    }

    #[test]
    fn ellipticities_are_divided_by_the_mean_of_good_galaxies() {
        let mut submission = Registry::embedded()
            .unwrap()
            .get("paper")
            .unwrap()
            .submission;
        let mut rows = vec![row(&[0.4, 0.8, f64::NAN]), row(&[0.3])];
        calibrate(&submission, &mut rows);
        assert_eq!(rows[0].galaxies[0].e1, 0.1);
        submission.shape.calibration = Calibration::Response;
        calibrate(&submission, &mut rows);
        assert!((rows[0].galaxies[0].e1 - 0.2).abs() < 1e-12);
        assert!((rows[1].galaxies[0].e2 + 0.4).abs() < 1e-12);
        let mut rows = vec![row(&[-0.1, f64::NAN])];
        calibrate(&submission, &mut rows);
        assert_eq!(rows[0].galaxies[0].flag, flag::NO_RESPONSE);
        assert!(rows[0].galaxies[0].e1.is_nan());
    }
}
