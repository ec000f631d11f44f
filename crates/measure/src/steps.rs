//! The steps of one measurement, for pictures.

use ndarray::{Array2, ArrayView2};

use crate::deconvolve::convolve;
use crate::error::MeasureError;
use crate::measurement::Measurement;
use crate::method::Images;
use crate::pixel::Pixel;
use crate::psf::cut_start;
use crate::sizes::check_psf;
use crate::worker::PsfWorker;

/// The steps of one measurement as images.
#[derive(Clone)]
pub struct Steps {
    /// The stamp as cut from the data, before any denoising.
    pub stamp: Array2<f64>,
    /// The deconvolved stamp.
    pub deconvolved: Array2<f64>,
    /// Data minus the deconvolved stamp convolved with the PSF.
    pub residual: Array2<f64>,
    /// Autocorrelation, zero lag in the middle: all lags for the network, those that the weight
    /// reaches for the linear one.
    pub acf: Array2<f64>,
    /// The same under the weight that its moments have, which for the network is none; NaN beyond the radius within
    /// which it is used.
    pub used: Array2<f64>,
}

impl std::fmt::Debug for Steps {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Steps").finish_non_exhaustive()
    }
}

impl PsfWorker<'_> {
    /// The steps behind the last measurement, `measurement` of `stamp` with `psf`.
    ///
    /// # Errors
    /// Where the stamp or the PSF has other sizes than planned.
    pub fn steps<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
        psf: ArrayView2<'_, f64>,
        measurement: &Measurement,
    ) -> Result<Steps, MeasureError> {
        let n = self.configuration().stamp.size;
        let (Some(y0), Some(x0)) = (cut_start(stamp.nrows(), n), cut_start(stamp.ncols(), n))
        else {
            let expected = format!("at least {n} × {n}");
            return Err(MeasureError::square("a stamp", stamp.dim(), expected));
        };
        check_psf(psf, psf.nrows())?;
        let stamp =
            Array2::from_shape_fn((n, n), |(y, x)| f64::from(stamp[(y0 + y, x0 + x)].to_f32()));
        let Images {
            deconvolved,
            acf,
            weight,
            spacing,
        } = self.worker.method.images(&self.worker.cut, psf);
        let reconvolved = convolve(deconvolved.view(), psf);
        let middle = (acf.nrows() / 2) as f64;
        let used = Array2::from_shape_fn(acf.dim(), |at| {
            let (dy, dx) = (at.0 as f64 - middle, at.1 as f64 - middle);
            if dy.hypot(dx) * spacing <= measurement.radius {
                acf[at] * weight.as_ref().map_or(1.0, |weight| weight[at])
            } else {
                f64::NAN
            }
        });
        Ok(Steps {
            residual: &stamp - &reconvolved,
            stamp,
            deconvolved,
            acf,
            used,
        })
    }
}
