//! The linear network, and moments under an adaptive weight.
//!
//! # Sheared noise
//!
//! The response of a galaxy is worked out on its image with noise, and shears that noise along with
//! the galaxy; what the challenge shears has none. Of the difference, the mean of what noise adds to
//! the autocorrelation's change is subtracted there. What remains is that the ellipticity is not
//! linear in the autocorrelation: f″(δA, δA′), with δA the change that noise makes and δA′ that of the
//! noise's own shear. It is estimated with a second field of noise (as Sheldon & Huff 2017 do, but on
//! both sides and as a derivative), of which response and ellipticity are taken with the field added and
//! taken away. One galaxy in [`SHARE`] is enough.
//!
//! # What noise makes of the PSF
//!
//! Deconvolved noise has the ellipticity of the PSF, and its mean effect on the galaxy's, ½f″(δA, δA), leaves −0.014 of it
//! for small galaxies of S/N 10. With a PSF turned by 90 degrees it would be the opposite: half of the difference,
//! −½f″(δA, δA⊥ − δA), is subtracted. δA⊥ is that of the same field, each mode with the amplitude that the turned PSF
//! gives it, so that its noise is that of the PSF's small ellipticity alone. It is worked out and subtracted on the same
//! galaxies as the above, for all.

use std::sync::Arc;

use ndarray::{Array2, ArrayView2};
use shearq_submissions::{LinearMethod, Neighbours};

use super::found::{
    AdaptedSettings, CutWorker, Found, FoundObservables, Images, Sheared, image, whole,
};
use super::softening::Softening;
use crate::deconvolve::{
    Descent, Gradients, Lags, ModeNoise, Spectral, SpectralPsf, SpectralScratch, Stop, uniform,
};
use crate::error::MeasureError;
use crate::measurement::ResponseMatrix;
use crate::noise::StampNoise;
use crate::pixel::hash;
use crate::shape::{AdaptiveMoments, AdaptiveScratch, AdaptiveShape, Breadth};
use crate::surroundings::{Surroundings, centre, followed};
use crate::versions::VersionSettings;

/// One galaxy in this many is measured with a field of noise, for the noise term of the response. With sheared versions it is
/// every galaxy. See docs/constants.md.
const SHARE: u64 = 8;
/// Level of the field of noise in units of the image's noise. See docs/constants.md.
const FIELD: f32 = 0.25;

/// What one submission and stamp size need.
pub(super) struct LinearPlan {
    lengths: AdaptedSettings,
    iterations: u32,
    /// One galaxy in this many is measured with a field of noise.
    share: u64,
    /// Shear of sheared versions, if there are any.
    versions: Option<f64>,
    softening: Softening,
    spectral: Spectral,
    moments: AdaptiveMoments,
    breadth: Breadth,
    /// Gradients of P₀ and P₂.
    broad: [Vec<f32>; 2],
    /// Whether neighbours are subtracted, or flag the galaxy.
    clears: bool,
    /// What corrects the flux for the light beyond the window.
    aperture: f64,
}

impl LinearPlan {
    /// For stamps of `n` and PSFs of `p` pixels a side, and galaxies with a mean square of `extent` px² per axis.
    pub(super) fn new(
        method: &LinearMethod,
        n: usize,
        p: usize,
        extent: f64,
    ) -> Result<Self, MeasureError> {
        let settings = &method.deconvolution;
        let spectral = Spectral::new(n, p, settings)?;
        let scale = method.shape.weight_scale;
        let moments = AdaptiveMoments::new(scale, spectral.spacing(), spectral.reach());
        let (target, window) = (settings.target_sigma, settings.window_sigma);
        let breadth = Breadth::new(target, window, spectral.spacing(), spectral.reach());
        let mut scratch = spectral.scratch();
        let broad = breadth
            .gradients()
            .map(|weights| spectral.spectrum_of(&weights, &mut scratch));
        let step = method.shape.sheared_step;
        let versions = (step > 0.0).then_some(step);
        Ok(LinearPlan {
            clears: method.shape.neighbours == Neighbours::Flag,
            share: if versions.is_some() { 1 } else { SHARE },
            versions,
            lengths: AdaptedSettings {
                target_sigma: settings.target_sigma,
                window_sigma: settings.window_sigma,
                weight_scale: scale,
            },
            iterations: u32::try_from(settings.max_iterations).unwrap_or(u32::MAX),
            softening: Softening::new(method, extent, &spectral, &moments, &breadth),
            aperture: 1.0 + (extent + target * target) / (window * window),
            breadth,
            broad,
            moments,
            spectral,
        })
    }
}

/// A worker for one thread.
pub(super) struct LinearWorker {
    plan: Arc<LinearPlan>,
    noise: ModeNoise,
    /// Noise of sums over many pixels, in units of that of white noise.
    grain: f32,
    /// None if neighbours are kept.
    surroundings: Option<Surroundings>,
    psf: SpectralPsf,
    /// What is added to the divisor of the moments, in px⁴ times the unit of the autocorrelation, in noise of level one.
    added: f32,
    /// What is added to P₀ of the size, in its unit, in noise of level one.
    faint: f32,
    gradients: Gradients,
    buffers: SpectralScratch,
    lags: Lags,
    /// What was found on them last.
    shape: Option<AdaptiveShape>,
    /// Of a field of noise, and of what it lacks to be that of a PSF turned by 90 degrees.
    field: Lags,
    turned: Lags,
    /// The autocorrelation with that field.
    shifted: Vec<f32>,
    values: AdaptiveScratch,
}

impl LinearWorker {
    pub(super) fn new(plan: Arc<LinearPlan>) -> Self {
        LinearWorker {
            noise: plan.spectral.noise(&StampNoise::white(1.0)),
            psf: plan.spectral.psf(),
            added: 0.0,
            faint: 0.0,
            gradients: plan.spectral.gradients(),
            buffers: plan.spectral.scratch(),
            surroundings: plan
                .clears
                .then(|| Surroundings::new(plan.spectral.stamp_size())),
            grain: 1.0,
            lags: plan.spectral.lags(),
            shape: None,
            field: plan.spectral.lags(),
            turned: plan.spectral.lags(),
            shifted: plan.spectral.lags().acf,
            values: plan.moments.scratch(),
            plan,
        }
    }

    /// Sets the noise of an image in units of its level. A PSF is set after it.
    pub(super) fn set_noise(&mut self, noise: &StampNoise) {
        self.noise = self.plan.spectral.noise(noise);
        self.grain = noise.power([0.0; 2]).0.sqrt() as f32;
    }

    /// Response of `shape` to a change of the autocorrelation by `lags.shear1` and `lags.shear2`.
    fn response(
        plan: &LinearPlan,
        shape: &AdaptiveShape,
        lags: &Lags,
        values: &mut AdaptiveScratch,
    ) -> ResponseMatrix {
        let first = plan.moments.response(shape, &lags.shear1, values);
        let second = plan.moments.response(shape, &lags.shear2, values);
        [[first[0], second[0]], [first[1], second[1]]]
    }

    /// Flux and size with their responses, of the galaxy whose `shape` was found last; with the effect of noise on them and
    /// on the ellipticity if `coupled`.
    fn observed(
        &mut self,
        shape: &AdaptiveShape,
        noise: f32,
        seed: u64,
        coupled: bool,
    ) -> FoundObservables {
        let plan = &*self.plan;
        let lags = &self.lags;
        let (soft, typical) = (self.faint * noise * noise, plan.softening.typical);
        let breadth = plan.breadth.measure(&lags.acf, soft, typical);
        let response = |change: &[f32]| f64::from(plan.breadth.response(&breadth, change));
        let flux = lags.flux.map(|flux| plan.aperture * f64::from(flux));
        let products = coupled.then(|| {
            let [first, second] = &mut self.gradients.pair;
            plan.moments
                .gradients(shape, &mut self.values, [first, second]);
            let [zero, two] = &plan.broad;
            for ((third, zero), two) in self.gradients.third.iter_mut().zip(zero).zip(two) {
                *third = Breadth::combine(&breadth, [*zero, *two]);
            }
            let found = plan
                .spectral
                .products(&self.psf, &self.gradients, &mut self.buffers);
            let unit = f64::from(noise * noise) * plan.share as f64;
            // The last of four quantities is the flux.
            let scale = [0, 0, 0, 1, 0, 0, 1, 0, 1, 2];
            std::array::from_fn(|k| {
                let unit = unit * plan.aperture.powi(scale[k]);
                found[k].map(|value| unit * f64::from(value))
            })
        });
        FoundObservables {
            flux: flux[0],
            flux_error: plan.aperture * f64::from(noise * self.psf.flux_error()),
            flux_response: [flux[1], flux[2]],
            square_response: [response(&lags.shear1), response(&lags.shear2)],
            size: plan.breadth.size(f64::from(breadth.square)),
            products,
            versions: plan.versions.map(|step| VersionSettings {
                step,
                normals: normals(seed),
            }),
        }
    }

    /// The response to sheared noise; `None` if the galaxy cannot be measured with the field.
    fn sheared_noise(&mut self, seed: u64, noise: f32, softening: f32) -> Option<Sheared> {
        let plan = &*self.plan;
        plan.spectral
            .noise_field(&self.psf, seed, &mut self.buffers, &mut self.field);
        plan.spectral
            .turned_field(&self.psf, seed, &mut self.buffers, &mut self.turned);
        let step = FIELD * noise;
        let soft = self.faint * noise * noise;
        let mut side = |step: f32| {
            let terms = self.lags.acf.iter().zip(&self.field.acf);
            for (out, (acf, change)) in self.shifted.iter_mut().zip(terms) {
                *out = acf + step * change;
            }
            let moments = &plan.moments;
            let shape = moments.measure(&self.shifted, softening, &mut self.values);
            let shape = shape.ok()?;
            let response = Self::response(plan, &shape, &self.field, &mut self.values);
            let turned = moments.response(&shape, &self.turned.acf, &mut self.values);
            let breadth = plan
                .breadth
                .measure(&self.shifted, soft, plan.softening.typical);
            let changes = [&self.field.shear1, &self.field.shear2, &self.turned.acf];
            let breadth = changes.map(|change| f64::from(plan.breadth.response(&breadth, change)));
            Some(((shape.distortion, response), turned, breadth))
        };
        let (plus, minus) = (side(step)?, side(-step)?);
        Some(Sheared {
            sides: [plus.0, minus.0],
            turned: [plus.1, minus.1],
            breadth: [plus.2, minus.2],
            weight: f64::from(noise * noise / (2.0 * step)) * plan.share as f64,
        })
    }
}

impl CutWorker for LinearWorker {
    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        self.plan
            .spectral
            .set_psf(psf, &self.noise, &mut self.buffers, &mut self.psf)?;
        [self.added, self.faint] = self.plan.softening.behind(&self.psf);
        Ok(())
    }

    fn adapted(&self) -> Option<AdaptedSettings> {
        Some(self.plan.lengths)
    }

    fn measure(&mut self, cut: &[f32], noise: f64) -> Result<Option<Found>, MeasureError> {
        if !(noise >= 0.0 && noise.is_finite()) {
            return Ok(None);
        }
        let plan = Arc::clone(&self.plan);
        let sigma = noise as f32;
        let found = centre(cut, plan.spectral.stamp_size());
        let surroundings = self.surroundings.as_mut();
        let cleared = surroundings.map_or(Ok(false), |surroundings| {
            surroundings.clear(cut, found, self.grain * sigma)
        });
        let whole = cut;
        let cut = match &self.surroundings {
            Some(surroundings) if cleared == Ok(true) => &surroundings.filled,
            _ => cut,
        };
        let (buffers, lags) = (&mut self.buffers, &mut self.lags);
        plan.spectral.place_window(followed(found), buffers);
        plan.spectral
            .autocorrelate(&self.psf, cut, sigma, buffers, lags);
        let softening = self.added * sigma * sigma;
        let shape =
            cleared.and_then(|_| plan.moments.measure(&lags.acf, softening, &mut self.values));
        self.shape = shape.as_ref().ok().copied();
        let mut response = None;
        let mut sheared_noise = None;
        let mut observed = None;
        if let Ok(shape) = &shape {
            response = Some(Self::response(&plan, shape, lags, &mut self.values));
            let seed = seed_of(whole, sigma);
            let coupled = noise > 0.0 && seed.is_multiple_of(plan.share);
            if coupled {
                sheared_noise = self.sheared_noise(seed, sigma, softening);
            }
            observed = Some(self.observed(shape, sigma, seed, sheared_noise.is_some()));
        }
        Ok(Some(Found {
            descent: Descent {
                iterations: plan.iterations,
                stop: Stop::MaxIterations,
                first_energy: f64::NAN,
                energy: f64::NAN,
                updated: whole.len() as u32,
            },
            distortion: shape.map(|s| s.distortion),
            response,
            sheared_noise,
            flux: plan.aperture * f64::from(self.lags.flux[0]),
            radius: plan.spectral.reach() as f64 * plan.spectral.spacing(),
            size: observed.as_ref().map_or(f64::NAN, |found| found.size[0]),
            observed,
        }))
    }

    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images {
        let LinearPlan {
            spectral, moments, ..
        } = &*self.plan;
        let acf = whole(&self.lags.acf, spectral.reach());
        let lag = |place: usize| (place as f64 - spectral.reach() as f64) * spectral.spacing();
        let weight = self.shape.map(|shape| {
            Array2::from_shape_fn(acf.dim(), |(y, x)| moments.weight(&shape, lag(x), lag(y)))
        });
        Images {
            deconvolved: image(&spectral.deconvolved(psf, cut), spectral.stamp_size()),
            acf,
            weight,
            spacing: spectral.spacing(),
        }
    }
}

/// A seed that is the stamp's own: whether and with which noise a galaxy is looked at depends on nothing
/// else. Of pixels in steps of a sixteenth of the noise, so that another machine's rounding hardly ever
/// gives another.
fn seed_of(stamp: &[f32], noise: f32) -> u64 {
    // Pixels along the middle: noise makes them different for every galaxy.
    let n = stamp.len().isqrt();
    let row = &stamp[n / 2 * n..][..n];
    let step = |value: &f32| ((16.0 * value / noise).round() as i32).cast_unsigned();
    hash(row.iter().map(step)) >> 16
}

/// Gaussian numbers from a seed (Box and Muller 1958), other than the signs of the field of noise.
fn normals(seed: u64) -> [f64; 4] {
    let mut state = seed ^ 0x5368_6561_7265_6421;
    let mut pair = || {
        let radius = (-2.0 * (1.0 - uniform(&mut state)).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * uniform(&mut state)).sin_cos();
        [radius * cos, radius * sin]
    };
    let ([a, b], [c, d]) = (pair(), pair());
    [a, b, c, d]
}
