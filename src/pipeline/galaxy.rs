//! One galaxy: from its postage stamp and PSF to an ellipticity. Serial; allocates nothing.

use ndarray::{Array2, ArrayView2};
use shearq_scoring::{Distortion, Shear};
use shearq_submissions::{DenoiseMethod, EllipticityType, NoiseSource, Submission};

use super::method::{Found, Images, Method, Response, Worker};
use crate::deconvolve::reference::convolve;
use crate::deconvolve::{OperatorError, Outcome};
use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise};
use crate::psf::star::cut_start;

/// Why a galaxy could not be measured, as bits of the catalogue's `flag`. Zero is a good galaxy;
/// with any bit set, e1 and e2 are NaN.
pub mod flag {
    /// A pixel is not a finite number.
    pub const NOT_FINITE: u32 = 1;
    /// The galaxy's PSF cannot be used.
    pub const BAD_PSF: u32 = 2;
    /// All pixels are equal, none is positive, or the noise level is zero where one is needed: no unit
    /// of brightness. Or the brightest pixel is too faint or bright for single precision.
    pub const NO_SCALE: u32 = 4;
    /// Nothing is left after deconvolution.
    pub const NO_LIGHT: u32 = 8;
    /// The moments have no extent.
    pub const NO_EXTENT: u32 = 16;
    /// The distortion exceeds 1 and has no shear-type ellipticity.
    pub const NO_SHEAR: u32 = 32;
    /// The response by which the image's ellipticities were to be divided is not positive.
    pub const NO_RESPONSE: u32 = 64;

    /// Meaning of each bit, for tables and documentation.
    pub const MEANINGS: [(u32, &str); 7] = [
        (NOT_FINITE, "a pixel is not a finite number"),
        (BAD_PSF, "the PSF cannot be used"),
        (NO_SCALE, "nothing to scale the brightness by"),
        (NO_LIGHT, "nothing left after deconvolution"),
        (NO_EXTENT, "moments without extent"),
        (NO_SHEAR, "distortion above 1"),
        (NO_RESPONSE, "no response to shear to divide by"),
    ];
}

/// Brightest pixels, in image units, whose autocorrelation keeps single precision: its squares stay
/// away from the smallest and largest numbers there are.
const PEAKS: std::ops::RangeInclusive<f32> = 1e-18..=1e17;

/// What was measured on one galaxy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Reported ellipticity, of the submission's type; NaN if flagged.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
    /// Bits of [`flag`].
    pub flag: u32,
    /// Response of e1 to γ1 and of e2 to γ2, before any calibration; NaN where it is not measured. Fit
    /// for means over many galaxies: what sheared noise adds to the mean is subtracted from a few of
    /// them, for all.
    pub response: [f64; 2],
    /// How the network ran; `None` if it did not.
    pub outcome: Option<Outcome>,
    /// Noise level used, in image units; NaN if unknown.
    pub noise: f64,
    /// Sum of the deconvolved stamp, in image units; of the stamp itself under the linear update.
    pub flux: f64,
    /// Radius of the clipped ACF in pixels; of the lags used under the linear update.
    pub radius: f64,
    /// Qxx + Qyy of the clipped, or weighted, ACF in px².
    pub size: f64,
}

impl Measurement {
    /// A galaxy with nothing measured.
    pub(crate) fn flagged(flag: u32) -> Self {
        Measurement {
            e1: f64::NAN,
            e2: f64::NAN,
            flag,
            response: [f64::NAN; 2],
            outcome: None,
            noise: f64::NAN,
            flux: f64::NAN,
            radius: f64::NAN,
            size: f64::NAN,
        }
    }

    /// Code of the stop reason in catalogues; −1 if the network did not run.
    pub fn stop_code(&self) -> i64 {
        self.outcome.map_or(-1, |o| i64::from(o.stop.code()))
    }
}

/// Everything planned for one submission and one size of full stamps. Not changed by measuring, so
/// one serves all threads.
pub struct Measurer {
    submission: Submission,
    full: usize,
    n: usize,
    denoise: Option<WaveletWiener>,
    method: Method,
}

/// One thread's buffers, its PSF among them.
pub struct MeasureScratch {
    method: Box<dyn Worker>,
    denoise: Option<DenoiseScratch>,
    /// Full stamp, denoised in place.
    full: Vec<f32>,
    /// Cut stamp.
    cut: Vec<f32>,
    border: Vec<f32>,
    usable_psf: bool,
}

impl Measurer {
    /// Plans for full stamps of `full` pixels a side.
    ///
    /// # Errors
    /// Where a size is out of range. A cut larger than the full stamp is the caller's to refuse, see
    /// [`Measurer::fits`].
    pub fn new(submission: &Submission, full: usize) -> Result<Self, OperatorError> {
        let n = submission.stamp.size.min(full);
        Ok(Measurer {
            full,
            n,
            denoise: match submission.denoise.method {
                DenoiseMethod::None => None,
                DenoiseMethod::WaveletWiener => Some(WaveletWiener::new(full, &submission.denoise)),
            },
            method: Method::new(submission, n)?,
            submission: submission.clone(),
        })
    }

    /// Whether the submission's cut fits into full stamps of `full` pixels.
    pub fn fits(submission: &Submission, full: usize) -> bool {
        submission.stamp.size <= full
    }

    /// The submission.
    pub fn submission(&self) -> &Submission {
        &self.submission
    }

    /// Buffers for one thread.
    pub fn scratch(&self) -> MeasureScratch {
        let n = self.n;
        MeasureScratch {
            method: self.method.worker(),
            denoise: self.denoise.as_ref().map(WaveletWiener::scratch),
            full: vec![0.0; self.full * self.full],
            cut: vec![0.0; n * n],
            border: Vec::with_capacity(self.full * self.full),
            usable_psf: false,
        }
    }

    /// Takes the PSF for the galaxies that follow; `None`, or one the network refuses, flags them.
    pub fn set_psf(&self, scratch: &mut MeasureScratch, psf: Option<ArrayView2<'_, f64>>) {
        scratch.usable_psf = psf.is_some_and(|psf| scratch.method.set_psf(psf).is_ok());
    }

    /// Measures the galaxy whose full stamp's row `y` is `pixels[y·stride..]`. `header_noise` is the
    /// image's NOISESIG, without which a submission that needs it flags the galaxy.
    pub fn measure(
        &self,
        pixels: &[f32],
        stride: usize,
        header_noise: Option<f64>,
        scratch: &mut MeasureScratch,
    ) -> Measurement {
        let full = self.full;
        for (y, row) in scratch.full.chunks_exact_mut(full).enumerate() {
            row.copy_from_slice(&pixels[y * stride..y * stride + full]);
        }
        if scratch.full.iter().any(|v| !v.is_finite()) {
            return Measurement::flagged(flag::NOT_FINITE);
        }
        if !scratch.usable_psf {
            return Measurement::flagged(flag::BAD_PSF);
        }
        if scratch.full.iter().all(|v| *v == scratch.full[0]) {
            return Measurement::flagged(flag::NO_SCALE);
        }
        let noise = match (self.submission.noise.source, header_noise) {
            (NoiseSource::Header, header) => header.unwrap_or(f64::NAN),
            (NoiseSource::Border, _) => border_noise(
                &scratch.full,
                full,
                self.submission.noise.border,
                &mut scratch.border,
            )
            .map_or(f64::NAN, f64::from),
        };
        if let (Some(filter), Some(buffers)) = (&self.denoise, &mut scratch.denoise) {
            filter.apply(&mut scratch.full, noise as f32, buffers);
        }
        let n = self.n;
        let start = cut_start(full, n).unwrap_or(0);
        for (y, row) in scratch.cut.chunks_exact_mut(n).enumerate() {
            let from = (start + y) * full + start;
            row.copy_from_slice(&scratch.full[from..from + n]);
        }
        let peak = scratch.cut.iter().copied().fold(0.0f32, f32::max);
        let MeasureScratch { method, cut, .. } = scratch;
        let found = PEAKS.contains(&peak).then(|| method.measure(cut, noise));
        let Some(found) = found.flatten() else {
            return Measurement {
                noise,
                ..Measurement::flagged(flag::NO_SCALE)
            };
        };
        let (e1, e2, response, flag) = self.report(&found);
        Measurement {
            e1,
            e2,
            flag,
            response,
            outcome: Some(found.outcome),
            noise,
            flux: found.flux,
            radius: found.radius,
            size: found.size,
        }
    }

    /// The ellipticity of the submission's type with its response, and the flag.
    fn report(&self, found: &Found) -> (f64, f64, [f64; 2], u32) {
        let none = |flag| (f64::NAN, f64::NAN, [f64::NAN; 2], flag);
        let kind = self.submission.shape.ellipticity;
        let chi = match found.distortion {
            Ok(chi) => chi,
            Err(flag) => return none(flag),
        };
        let Some((e1, e2, mut response)) = reported(kind, chi, found.response) else {
            return none(flag::NO_SHEAR);
        };
        if let Some(noise) = &found.sheared_noise {
            let sides = noise.sides.map(|(chi, r)| reported(kind, chi, r));
            if let [Some((_, _, plus)), Some((_, _, minus))] = sides {
                for k in 0..2 {
                    response[k] -= noise.weight * (plus[k] - minus[k]);
                }
            }
        }
        (e1, e2, response, 0)
    }
}

/// The ellipticity of type `kind` for a distortion, and the response of each of its components to the
/// same component of shear; `None` where there is none of that type.
fn reported(kind: EllipticityType, chi: Distortion, r: Response) -> Option<(f64, f64, [f64; 2])> {
    match kind {
        EllipticityType::Distortion => Some((chi.e1, chi.e2, [r[0][0], r[1][1]])),
        EllipticityType::Shear => {
            let Shear { e1, e2 } = chi.to_shear()?;
            // ε = χ f, f = 1/(1 + s), s = √(1 − |χ|²): ∂ε_i/∂χ_j = f δ_ij + χ_i χ_j f²/s.
            let s = (1.0 - chi.e1 * chi.e1 - chi.e2 * chi.e2).sqrt();
            let f = 1.0 / (1.0 + s);
            let cross = |a: f64, b: f64| a * b * f * f / s;
            let response = [
                (f + cross(chi.e1, chi.e1)) * r[0][0] + cross(chi.e1, chi.e2) * r[1][0],
                (f + cross(chi.e2, chi.e2)) * r[1][1] + cross(chi.e1, chi.e2) * r[0][1],
            ];
            Some((e1, e2, response))
        }
    }
}

/// The steps of one measurement as images, for pictures.
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
    /// The same, NaN beyond the radius within which it is used.
    pub clipped: Array2<f64>,
}

impl Measurer {
    /// The steps behind the last call of [`Measurer::measure`] with this scratch and `psf`.
    pub fn steps(
        &self,
        pixels: &[f32],
        stride: usize,
        psf: ArrayView2<'_, f64>,
        measurement: &Measurement,
        scratch: &mut MeasureScratch,
    ) -> Steps {
        let n = self.n;
        let start = cut_start(self.full, n).unwrap_or(0);
        let stamp = Array2::from_shape_fn((n, n), |(y, x)| {
            f64::from(pixels[(start + y) * stride + start + x])
        });
        let MeasureScratch { method, cut, .. } = scratch;
        let Images {
            deconvolved,
            acf,
            spacing,
        } = method.images(cut, psf);
        let reconvolved = convolve(deconvolved.view(), psf);
        let middle = (acf.nrows() / 2) as f64;
        let clipped = Array2::from_shape_fn(acf.dim(), |at| {
            let (dy, dx) = (at.0 as f64 - middle, at.1 as f64 - middle);
            if dy.hypot(dx) * spacing <= measurement.radius {
                acf[at]
            } else {
                f64::NAN
            }
        });
        Steps {
            residual: &stamp - &reconvolved,
            stamp,
            deconvolved,
            acf,
            clipped,
        }
    }
}
