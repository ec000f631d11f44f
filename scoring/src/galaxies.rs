//! Biases of both components from the galaxies of a set.

use ndarray::Array2;

/// Least squares of e = (1 + m)·g + c over all galaxies of a set, from the sums per cell.
pub(crate) struct ShearBias {
    /// Not a number if the true shear is the same everywhere; c is then the mean of e − g.
    pub m: f64,
    pub c: f64,
    /// Sum per cell of the residuals of the fit.
    pub residual: Array2<f64>,
    /// Weights of the sums per cell in m.
    pub of_m: Array2<f64>,
    /// Weights of the sums per cell in c.
    pub of_c: Array2<f64>,
}

impl ShearBias {
    /// Fits one component: its true shear `g`, and per cell the sum of its ellipticities and the number of
    /// galaxies.
    pub(crate) fn new(g: &Array2<f64>, sum: Array2<f64>, count: &Array2<f64>) -> Self {
        let galaxies = count.sum();
        let mean = (g * count).sum() / galaxies;
        let apart = g - mean;
        let square = (&apart * &apart * count).sum();
        let constant = g.iter().all(|value| *value == g[(0, 0)]);
        let of_m = match constant {
            true => Array2::zeros(g.dim()),
            false => &apart / square,
        };
        let response = match constant {
            true => 1.0,
            false => (&of_m * &sum).sum(),
        };
        let of_c = of_m.mapv(|w| 1.0 / galaxies - w * mean);
        let c = sum.sum() / galaxies - response * mean;
        ShearBias {
            m: if constant { f64::NAN } else { response - 1.0 },
            c,
            residual: &sum - &(g.mapv(|g| response * g + c) * count),
            of_m,
            of_c,
        }
    }
}
