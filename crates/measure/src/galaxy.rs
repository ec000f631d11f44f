//! One galaxy: from its postage stamp and PSF to an ellipticity. Serial; allocates nothing.

use std::sync::Arc;

use ndarray::ArrayView2;
use shearq_quantities::{Distortion, Shear};
use shearq_submissions::{Configuration, EllipticityType, Method, NoiseSource, Registry};

use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise};
use crate::error::MeasureError;
use crate::examine::PEAKS;
use crate::flag::{Flag, Flags};
use crate::measurement::Measurement;
use crate::method::{CutWorker, Found, MethodPlan, ResponseMatrix};
use crate::noise::{NoisePlan, StampNoise, Survey};
use crate::pixel::Pixel;
use crate::psf::cut_start;
use crate::surroundings::Missing;

/// Everything planned for one submission and one size of full stamps. Not changed by measuring, so
/// one serves all threads, each with a [`Worker`] of its own.
pub struct Measurer {
    plan: Arc<Plan>,
}

struct Plan {
    configuration: Configuration,
    full: usize,
    n: usize,
    denoise: Option<WaveletWiener>,
    method: MethodPlan,
    noise: Option<NoisePlan>,
}

/// One thread's part in measuring: its buffers, and the PSF of the galaxies at hand. Nothing is allocated
/// for a galaxy.
pub struct Worker {
    plan: Arc<Plan>,
    pub(crate) method: Box<dyn CutWorker>,
    denoise: Option<DenoiseScratch>,
    /// Full stamp, denoised in place.
    full: Vec<f32>,
    /// Cut stamp.
    pub(crate) cut: Vec<f32>,
    border: Vec<f32>,
    missing: Missing,
    /// Of the image of the galaxies at hand, where it was given.
    survey: Option<Arc<Survey>>,
    usable_psf: bool,
}

impl Measurer {
    /// Plans for full stamps of `full` pixels a side.
    ///
    /// # Errors
    /// Where the stamps are smaller than the submission needs, or a size is out of range.
    pub fn new(configuration: &Configuration, full: usize) -> Result<Self, MeasureError> {
        let n = configuration.stamp.size;
        if full < n {
            let expected = format!(
                "at least {n} × {n}, as submission {} needs",
                configuration.name
            );
            return Err(MeasureError::square("stamps", (full, full), expected));
        }
        let plan = Plan {
            full,
            n,
            denoise: configuration
                .wavelet()
                .map(|settings| WaveletWiener::new(full, settings)),
            method: MethodPlan::new(configuration, n)?,
            noise: match configuration.noise {
                NoiseSource::Image { correlation } => Some(NoisePlan::new(full, correlation)?),
                NoiseSource::Header | NoiseSource::Border { .. } => None,
            },
            configuration: configuration.clone(),
        };
        Ok(Measurer {
            plan: Arc::new(plan),
        })
    }

    /// The same by the name of a submission or the path of a settings file.
    ///
    /// # Errors
    /// Where there is no such submission, it is not valid, or as [`Measurer::new`].
    pub fn named(configuration: &str, full: usize) -> Result<Self, MeasureError> {
        Measurer::new(
            &Registry::embedded()?.get(configuration)?.configuration,
            full,
        )
    }

    /// The submission.
    pub fn configuration(&self) -> &Configuration {
        &self.plan.configuration
    }

    /// How the noise of an image is measured on its stamps, where the submission asks for that.
    pub fn noise_plan(&self) -> Option<&NoisePlan> {
        self.plan.noise.as_ref()
    }

    /// Pixels a side of the full stamps.
    pub fn full(&self) -> usize {
        self.plan.full
    }

    /// Buffers for one thread.
    pub fn worker(&self) -> Worker {
        let Plan {
            full,
            n,
            denoise,
            method,
            ..
        } = &*self.plan;
        Worker {
            method: method.worker(),
            denoise: denoise.as_ref().map(WaveletWiener::scratch),
            full: vec![0.0; full * full],
            cut: vec![0.0; n * n],
            border: Vec::with_capacity(full * full),
            missing: Missing::new(*n),
            usable_psf: false,
            survey: None,
            plan: Arc::clone(&self.plan),
        }
    }
}

impl Worker {
    /// The submission.
    pub fn configuration(&self) -> &Configuration {
        &self.plan.configuration
    }

    /// Takes what [`NoiseSurvey`](crate::NoiseSurvey) found on the image of the galaxies that follow: level and
    /// correlation of the noise, where one that is correlated no more than chance would have it is taken as
    /// white, and how broad they are. `None` leaves them with the level that they are given one by one, white noise, and
    /// the submission's own window. The PSF has to be taken after it, without which galaxies are flagged.
    pub fn set_survey(&mut self, survey: Option<&Arc<Survey>>) {
        if self.survey.as_ref() == survey {
            return;
        }
        self.usable_psf = false;
        self.survey = survey.cloned();
        self.method
            .set_extent(survey.and_then(|survey| survey.extent));
        match survey {
            Some(survey) if survey.noise.is_correlated() => self.method.set_noise(&survey.noise),
            Some(_) | None => self.method.set_noise(&StampNoise::white(1.0)),
        }
    }

    /// Takes the PSF of the galaxies that follow, centred, of sum one, and as large as [`star_psf`](crate::star_psf) cuts it
    /// with [`Configuration::psf_cut`](shearq_submissions::Submission::psf_cut). One that is refused flags them.
    ///
    /// # Errors
    /// Where its sizes are others, or a pixel is not finite.
    pub fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        let taken = self.method.set_psf(psf);
        self.usable_psf = taken.is_ok();
        taken
    }

    /// Leaves the galaxies that follow without a PSF, which flags them.
    pub(crate) fn lose_psf(&mut self) {
        self.usable_psf = false;
    }

    /// Measures a galaxy on its full stamp, before any calibration. `header_noise` is the image's noise
    /// level, where none was taken before; without either a submission that needs it flags the galaxy.
    ///
    /// # Errors
    /// Where the stamp has other sizes than planned.
    pub fn measure<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
        header_noise: Option<f64>,
    ) -> Result<Measurement, MeasureError> {
        let plan = Arc::clone(&self.plan);
        let (full, n) = (plan.full, plan.n);
        if stamp.dim() != (full, full) {
            let expected = format!("{full} × {full}");
            return Err(MeasureError::square("a stamp", stamp.dim(), expected));
        }
        for (row, from) in self.full.chunks_exact_mut(full).zip(stamp.rows()) {
            // Pixels that lie side by side, as those of an image do, are taken several at a time.
            match from.as_slice() {
                Some(from) => taken(row, from.iter()),
                None => taken(row, from.iter()),
            }
        }
        // Without an end before the last one, which would keep it from looking at several at a time.
        let whole = self.full.iter().fold(true, |all, v| all & v.is_finite());
        if !whole && !matches!(plan.configuration.method, Method::Linear(_)) {
            return Ok(Measurement::flagged(Flag::NotFinite));
        }
        if !self.usable_psf {
            return Ok(Measurement::flagged(Flag::BadPsf));
        }
        if self.full.iter().all(|v| *v == self.full[0]) {
            return Ok(Measurement::flagged(Flag::NoScale));
        }
        let noise = match plan.configuration.noise {
            NoiseSource::Header | NoiseSource::Image { .. } => match &self.survey {
                Some(survey) => survey.noise.sigma(),
                None => header_noise.unwrap_or(f64::NAN),
            },
            NoiseSource::Border { border } => {
                border_noise(&self.full, full, border, &mut self.border).map_or(f64::NAN, f64::from)
            }
        };
        if let (Some(filter), Some(buffers)) = (&plan.denoise, &mut self.denoise) {
            filter.apply(&mut self.full, noise as f32, buffers);
        }
        let start = cut_start(full, n).unwrap_or(0);
        for (y, row) in self.cut.chunks_exact_mut(n).enumerate() {
            let from = (start + y) * full + start;
            row.copy_from_slice(&self.full[from..from + n]);
        }
        if !whole && !self.missing.mend(&mut self.cut, n) {
            return Ok(Measurement::flagged(Flag::NotFinite));
        }
        let peak = highest(&self.cut);
        let found = if PEAKS.contains(&peak) {
            self.method.measure(&self.cut, noise)?
        } else {
            None
        };
        let Some(found) = found else {
            return Ok(Measurement {
                noise,
                ..Measurement::flagged(Flag::NoScale)
            });
        };
        let nothing = Measurement {
            descent: Some(found.descent),
            noise,
            flux: found.flux,
            radius: found.radius,
            size: found.size,
            ..Measurement::flagged(Flag::NoShear)
        };
        Ok(match report(plan.configuration.ellipticity(), &found) {
            Err(flag) => Measurement {
                flags: flag.into(),
                ..nothing
            },
            Ok((e1, e2, response)) => Measurement {
                e1,
                e2,
                flags: Flags::NONE,
                response,
                ..nothing
            },
        })
    }
}

fn taken<'a, T: Pixel + 'a>(row: &mut [f32], from: impl Iterator<Item = &'a T>) {
    for (value, pixel) in row.iter_mut().zip(from) {
        *value = pixel.to_f32();
    }
}

/// The ellipticity of type `kind` with its response.
fn report(kind: EllipticityType, found: &Found) -> Result<(f64, f64, [f64; 2]), Flag> {
    let (mut e1, mut e2, mut response) =
        reported(kind, found.distortion?, found.response).ok_or(Flag::NoShear)?;
    if let Some(noise) = &found.sheared_noise {
        let sides = noise.sides.map(|(chi, r)| reported(kind, chi, r));
        if let [Some((_, _, plus)), Some((_, _, minus))] = sides {
            for k in 0..2 {
                response[k] -= noise.weight * (plus[k] - minus[k]);
            }
        }
        let turned = [0, 1].map(|k| changed(kind, noise.sides[k].0, noise.turned[k]));
        if let [Some(plus), Some(minus)] = turned {
            e1 += 0.5 * noise.weight * (plus[0] - minus[0]);
            e2 += 0.5 * noise.weight * (plus[1] - minus[1]);
        }
    }
    Ok((e1, e2, response))
}

/// Change of the ellipticity of type `kind` with a change of the distortion.
fn changed(kind: EllipticityType, chi: Distortion, by: [f64; 2]) -> Option<[f64; 2]> {
    // Both components move: as the response of either to one shear that does so.
    reported(kind, chi, by.map(|by| [by; 2])).map(|(_, _, change)| change)
}

/// The ellipticity of type `kind` for a distortion, and the response of each of its components to the
/// same component of shear; `None` where there is none of that type.
fn reported(
    kind: EllipticityType,
    chi: Distortion,
    r: ResponseMatrix,
) -> Option<(f64, f64, [f64; 2])> {
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

/// The largest of the pixels, or zero: of 16 running maxima, which vector instructions take at a time.
pub(crate) fn highest(pixels: &[f32]) -> f32 {
    const LANES: usize = 16;
    let mut lanes = [0.0f32; LANES];
    let chunks = pixels.chunks_exact(LANES);
    let rest = chunks.remainder().iter().copied().fold(0.0, f32::max);
    for chunk in chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane = lane.max(*value);
        }
    }
    lanes.into_iter().fold(rest, f32::max)
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const N: usize = 48;

    /// A Gaussian of covariance (xx, yy) and flux one, about the middle of the stamp.
    fn gaussian(n: usize, xx: f64, yy: f64) -> Array2<f64> {
        let middle = (n as f64 - 1.0) / 2.0;
        Array2::from_shape_fn((n, n), |(y, x)| {
            let (x, y) = (x as f64 - middle, y as f64 - middle);
            (-0.5 * (x * x / xx + y * y / yy)).exp() / (std::f64::consts::TAU * (xx * yy).sqrt())
        })
    }

    #[test]
    fn noise_of_an_elliptical_psf_leaves_round_galaxies_round() {
        // Covariances in px²: a PSF of |e| = 0.05, along x and along y, and a small galaxy.
        let (long, short, own) = (2.31, 1.89, 3.0);
        let e = (long - short) / (long + short) / 2.0;
        let measurer = Measurer::named("48/linear/star", N).unwrap();
        let sides = [(long, short), (short, long)].map(|(xx, yy)| {
            let psf = gaussian(32, xx, yy);
            let mut worker = measurer.worker();
            worker.set_psf((&psf / psf.sum()).view()).unwrap();
            let galaxy = gaussian(N, own + xx, own + yy);
            let strength = galaxy.iter().map(|v| v * v).sum::<f64>().sqrt();
            // S/N 10.
            (worker, galaxy * (10.0 / strength))
        });
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let half = 3f64.sqrt();
        let [mut first, mut second] = sides;
        let mut leaks = Vec::new();
        let mut response = 0.0;
        for _ in 0..3000 {
            let noise = Array2::from_shape_fn((N, N), |_| rng.random_range(-half..half));
            let mut mean = |(worker, galaxy): &mut (Worker, Array2<f64>)| {
                // The noise is taken away, too: of what it does the even part is left.
                let [a, b] = [1.0, -1.0].map(|sign| {
                    let stamp = &*galaxy + &(&noise * sign);
                    worker.measure(stamp.view(), Some(1.0)).unwrap()
                });
                response += 0.25 * (a.response[0] + b.response[0]);
                0.5 * (a.e1 + b.e1)
            };
            leaks.push(0.5 * (mean(&mut first) - mean(&mut second)));
        }
        let count = leaks.len() as f64;
        let scale = e * response / count;
        let mean = leaks.iter().sum::<f64>() / count;
        let square = leaks.iter().map(|leak| (leak - mean).powi(2)).sum::<f64>();
        let (leak, error) = (mean / scale, square.sqrt() / count / scale);
        // Without looking at the field of the turned PSF it is −0.014.
        assert!(
            error < 2.5e-3 && leak.abs() < 2.5 * error,
            "{leak} ± {error}"
        );
    }
}
