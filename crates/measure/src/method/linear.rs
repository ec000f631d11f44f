//! The linear method: the closed form of the network, and moments under a round weight.
//!
//! # Noise that is sheared along
//!
//! The response of a galaxy is computed on its noisy image, and shears the noise along with the galaxy. The galaxies that
//! lensing shears have no noise yet. The mean effect of noise on the change of the autocorrelation is subtracted in
//! `spectral/noise.rs`. What remains is that the ellipticity is not linear in the autocorrelation: f″(δA, δA′), with δA the
//! change by noise and δA′ the change by the shear of this noise. Both are linear in the noise, so that the mean follows from
//! its power and from the gradients of f and of its divisor ([`Ratio`]). Fields of noise, added and
//! subtracted as in Sheldon & Huff (2017), have the same mean; each field took longer and scattered. One galaxy in
//! [`NOISE_MOMENTS_INTERVAL`] is enough.
//!
//! # Noise that has the shape of the PSF
//!
//! Deconvolved noise has the ellipticity of the PSF. Its mean effect on the ellipticity of the galaxy, ½f″(δA, δA), is
//! −0.014 of the ellipticity of the PSF for small galaxies of S/N 10. Behind a PSF turned by 90 degrees it would have the
//! opposite sign, so half of the difference, −½f″(δA, δA⊥ − δA), is subtracted. δA⊥ is the same noise with the amplitude of
//! each mode behind the turned PSF.

use std::ops::RangeInclusive;
use std::sync::{Arc, OnceLock};

use ndarray::{Array2, ArrayView2};
use shearq_quantities::PixelShape;
use shearq_quantities::linear::Symmetric;
use shearq_submissions::limits::{MAX_TARGET, MIN_TARGET, WINDOWS};
use shearq_submissions::{LinearMethod, PsfCut, ShearOrigin};

use super::found::{Found, FoundObservables, NoiseMeans};
use super::worker::{AdaptedSettings, CutEpoch, CutWorker, Images, image};
use crate::error::MeasureError;
use crate::measurement::{Descent, FLUX, QUANTITIES, ResponseMatrix, Stop};
use crate::moments::{WeightedMoments, shear_origin};
use crate::noise::StampNoise;
use crate::psf::{
    ResidualProfiles, StarDenoiser, WIDTH_STEPS, gaussian_variance, noise_equivalent_area,
    width_factor, width_step,
};
use crate::random::{hash, uniform};
use crate::selection::ShearSettings;
use crate::shape::{
    Ratio, Regularisation, RegularisationTerms, RoundMoments, SizeMoments, TypicalGalaxy,
};
use crate::spectral::{
    EpochPixels, EpochStamp, Lags, ModeNoise, NoiseChanges, Spectral, SpectralPsf, SpectralScratch,
};
use crate::transform::HexLattice;

// In simulated pairs the choice of galaxies makes 7 % of the error of m, and half of it behind a PSF of ellipticity 0.1. All galaxies
// would double the time. Sheared catalogues need the noise of every galaxy.
const NOISE_MOMENTS_INTERVAL: u64 = 8;

// Correlated noise follows the shape of pixels in steps of 1/1024, because its power in all modes takes as long as several
// galaxies. Noise is then sheared by at most 0.0005 too much.
const NOISE_SHAPE_STEPS: f64 = 1024.0;

// The window follows the galaxies: on small galaxies a wide window keeps noise, on large ones a narrow window loses light. One
// width for all galaxies of an image cannot select by shear.
//
// Steps of 19 %. Chosen by hand.
const WINDOWS_PER_OCTAVE: f64 = 4.0;
// Power of the galaxies' mean square with which the best width grows: least scatter of simulated galaxies of different
// sizes. Command and seed were not kept.
const WINDOW_POWER: f64 = 0.8;
const WINDOW_STEPS: RangeInclusive<i32> = -3..=3;
// Mean square per axis of GREAT10's galaxies in units of the best window's σ²: least scatter of the simulated sets.
// Command and seed were not kept.
const GREAT10_VARIANCE: f64 = 0.1375;
// In units of the stamp's side. On 48 px a window of 10.4 px lowers the scatter by 0.9 %, but leaves m₁ = −0.0013 for
// large galaxies.
const WIDEST_WINDOW: f64 = 0.2;

// Index of the configured width among all widths.
const CONFIGURED_WINDOW: usize = WINDOW_STEPS.start().unsigned_abs() as usize;
const WINDOW_COUNT: usize = CONFIGURED_WINDOW + 1 + WINDOW_STEPS.end().unsigned_abs() as usize;

impl AdaptedSettings {
    /// The flux of a Gaussian of mean square `variance` px² per axis over the flux under the window, after convolution with the target.
    fn aperture(self, variance: f64) -> f64 {
        let AdaptedSettings {
            target_sigma: target,
            window_sigma: window,
            ..
        } = self;
        1.0 + (variance + target * target) / (window * window)
    }
}

/// The plan for one target, window and weight.
struct LinearPlan {
    lengths: AdaptedSettings,
    iterations: u32,
    noise_moments_interval: u64,
    origin: ShearOrigin,
    /// Shear of sheared catalogues, if they are requested.
    shear_step: Option<f64>,
    regularisation: Regularisation,
    spectral: Spectral,
    moments: RoundMoments,
    size_moments: SizeMoments,
    /// Gradients of A₀, A₊ and A× of [`RoundMoments`], as spectra.
    gradients: [Vec<f32>; 3],
    /// Gradients of P₀ and P₂ of [`SizeMoments`], as spectra.
    size_gradients: [Vec<f32>; 2],
    /// White noise of level one.
    white: ModeNoise,
    /// Factor that corrects the flux for the light beyond the window.
    aperture: f64,
}

impl LinearPlan {
    /// For stamps of `n` and PSFs of `p` pixels a side, and galaxies of mean square `variance` px² per axis.
    fn new(method: &LinearMethod, n: usize, p: usize, variance: f64) -> Result<Self, MeasureError> {
        let settings = &method.deconvolution;
        let spectral = Spectral::new(n, p, settings)?;
        let scale = method.shape.weight_scale;
        let (target, window) = (settings.target_sigma, settings.window_sigma);
        let galaxy = TypicalGalaxy {
            variance,
            target,
            window,
        };
        let moments = RoundMoments::new(scale, galaxy, spectral.lattice());
        let size_moments = SizeMoments::new(target, window, spectral.lattice());
        let mut scratch = spectral.scratch();
        let mut spectrum = |weights: Vec<f32>| spectral.spectrum_of(&weights, &mut scratch);
        let step = method.shape.sheared_step;
        let shear_step = (step > 0.0).then_some(step);
        let lengths = AdaptedSettings {
            target_sigma: target,
            window_sigma: window,
            weight_scale: scale,
        };
        Ok(LinearPlan {
            noise_moments_interval: shear_step.map_or(NOISE_MOMENTS_INTERVAL, |_| 1),
            origin: method.shape.origin,
            shear_step,
            lengths,
            iterations: u32::try_from(settings.max_iterations).unwrap_or(u32::MAX),
            regularisation: Regularisation::new(
                method.shape.half_snr,
                galaxy,
                &spectral,
                &moments,
                &size_moments,
            ),
            aperture: lengths.aperture(variance),
            white: spectral.noise(&StampNoise::white(1.0)),
            gradients: moments.gradients().map(&mut spectrum),
            size_gradients: size_moments.gradients().map(&mut spectrum),
            size_moments,
            moments,
            spectral,
        })
    }
}

/// Index of a plan of the family: the step of the PSF's width, and the index of the window.
type PlanIndex = (i32, usize);

const CONFIGURED: PlanIndex = (0, CONFIGURED_WINDOW);

/// The linear method for PSFs and galaxies of any width, with a plan for each step of both.
///
/// The wavenumbers that a PSF removes follow its width. So do the Gaussian that the deconvolved stamp is convolved with
/// and the weight of the moments: a target much sharper than the PSF consists of noise. The window, which excludes noise
/// beyond the galaxy, follows the galaxies.
pub(crate) struct LinearFamily {
    method: LinearMethod,
    n: usize,
    cut: PsfCut,
    configured: Arc<LinearPlan>,
    /// By step of the PSF and window, planned by the first thread that needs them.
    others: Vec<[OnceLock<Arc<LinearPlan>>; WINDOW_COUNT]>,
}

impl LinearFamily {
    pub(super) fn new(method: &LinearMethod, n: usize, cut: PsfCut) -> Result<Self, MeasureError> {
        let variance = Self::variance(method, CONFIGURED_WINDOW);
        Ok(LinearFamily {
            method: method.clone(),
            n,
            cut,
            configured: Arc::new(LinearPlan::new(method, n, cut.size, variance)?),
            others: WIDTH_STEPS.map(|_| Default::default()).collect(),
        })
    }

    fn variance(method: &LinearMethod, window: usize) -> f64 {
        let settings = &method.deconvolution;
        galaxy_variance(settings.reference_extent, settings.window_sigma, window)
    }

    fn plan(&self, index: PlanIndex) -> Result<Arc<LinearPlan>, MeasureError> {
        if index == CONFIGURED {
            return Ok(Arc::clone(&self.configured));
        }
        let (step, window) = index;
        let place = &self.others[(step - WIDTH_STEPS.start()) as usize][window];
        if let Some(plan) = place.get() {
            return Ok(Arc::clone(plan));
        }
        let mut method = self.method.clone();
        let target = &mut method.deconvolution.target_sigma;
        // A configured target beyond the bounds is kept.
        let (least, most) = (MIN_TARGET / *target, MAX_TARGET / *target);
        let factor = width_factor(step).clamp(least.min(1.0), most.max(1.0));
        *target *= factor;
        method.shape.weight_scale *= factor;
        let variance = Self::variance(&method, window);
        let sigma = &mut method.deconvolution.window_sigma;
        *sigma = window_width(*sigma, window, self.n);
        let plan = LinearPlan::new(&method, self.n, self.cut.size, variance)?;
        Ok(Arc::clone(place.get_or_init(|| Arc::new(plan))))
    }

    fn check_side(&self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        let PsfCut { size, least, .. } = self.cut;
        let side = psf.nrows();
        if !(least..=size).contains(&side) || side % 2 != size % 2 {
            let parity = if size % 2 == 0 { "an even" } else { "an odd" };
            let expected = format!("{parity} number a side, {least} to {size}");
            return Err(MeasureError::square("a PSF stamp", psf.dim(), expected));
        }
        Ok(())
    }

    /// A worker for one thread.
    pub(super) fn worker(self: &Arc<Self>) -> LinearWorker {
        LinearWorker {
            workers: vec![PlanWorker::new(CONFIGURED, Arc::clone(&self.configured))],
            current: 0,
            galaxy_variance: None,
            moments: WeightedMoments::default(),
            denoiser: StarDenoiser::default(),
            epoch_weights: Vec::new(),
            noise: StampNoise::white(1.0),
            pixels: PixelShape::SQUARE,
            gain: None,
            family: Arc::clone(self),
        }
    }
}

pub(super) struct LinearWorker {
    family: Arc<LinearFamily>,
    /// Workers of the plans that this thread has needed.
    workers: Vec<PlanWorker>,
    /// Place of the worker for the present PSF.
    current: usize,
    noise: StampNoise,
    pixels: PixelShape,
    gain: Option<f64>,
    galaxy_variance: Option<f64>,
    moments: WeightedMoments,
    denoiser: StarDenoiser,
    /// Of the epochs of a galaxy; their sum is one.
    epoch_weights: Vec<f32>,
}

impl CutWorker for LinearWorker {
    fn set_image(
        &mut self,
        noise: &StampNoise,
        galaxy_variance: Option<f64>,
        stars: Option<&Arc<ResidualProfiles>>,
    ) {
        self.denoiser.set_residual_profiles(stars);
        self.galaxy_variance = galaxy_variance;
        // The noise of each mode takes as long as several galaxies, and rows of an image share it.
        if self.noise != *noise {
            self.noise = noise.clone();
            for worker in &mut self.workers {
                worker.set_noise(noise, worker.noise_pixels);
            }
        }
    }

    fn set_pixel_shape(&mut self, shape: PixelShape) {
        self.pixels = shape;
    }

    fn set_gain(&mut self, gain: Option<f64>) {
        self.gain = gain;
    }

    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        self.family.check_side(psf)?;
        let psf = self.denoiser.denoised(psf);
        let settings = &self.family.method.deconvolution;
        let known = self
            .galaxy_variance
            .filter(|_| settings.reference_extent > 0.0);
        let known = known.and_then(|seen| Some(seen - self.moments.psf_mean_square(psf)?));
        let window = known.map_or(CONFIGURED_WINDOW, |variance| {
            window_index(variance, settings.reference_extent)
        });
        let area = noise_equivalent_area(psf);
        let index = (width_step(area, settings.reference_area), window);
        self.current = place_of(index, &mut self.workers, &self.family, &self.noise)?;
        let worker = &mut self.workers[self.current];
        worker.set_pixel_shape(self.pixels, &self.noise);
        worker.psf_variance = gaussian_variance(area);
        worker.set_psf(psf)
    }

    fn retake_psf(&mut self) {
        let worker = &mut self.workers[self.current];
        worker.set_pixel_shape(self.pixels, &self.noise);
        worker.retake_psf();
    }

    fn adapted(&self) -> Option<AdaptedSettings> {
        Some(self.workers[self.current].plan.lengths)
    }

    fn measure_cut(&mut self, cut: &[f32], noise: f64) -> Result<Option<Found>, MeasureError> {
        if !(noise >= 0.0 && noise.is_finite()) {
            return Ok(None);
        }
        // In the middle, whatever is there. A window on the centroid changes with the shear of lopsided galaxies and of blends, which
        // R does not contain: m was +23e-3 for rings at S/N 20, +4.4e-3 at S/N 60, and +6e-3 for blends at 5 to 7 px, instead of
        // 0.4 ± 0.6e-3, 0.3 ± 0.1e-3 and 0 ± 1e-3.
        let window = [0.0; 2];
        // A shear about the middle of the stamp also moves off-centre galaxies under the window: m is −1.5e-3 for
        // control-ground-constant of GREAT3, with offsets up to 1 px, and half of it for a shear about the centroid. About the
        // centroid, m is about +4e-3 for galaxies whose bulge is off their centre by its half-light radius, if the shear of the
        // simulation leaves that centre in its place.
        let worker = &mut self.workers[self.current];
        let origin = match worker.plan.origin {
            ShearOrigin::Stamp => window,
            ShearOrigin::Centroid => {
                shear_origin(cut, worker.plan.spectral.stamp_size(), noise).map(f64::from)
            }
        };
        let stamp = EpochStamp {
            pixels: cut,
            window,
            origin,
        };
        Ok(Some(worker.measure(&|_| stamp, noise, self.gain)))
    }

    // The plan follows the PSFs, not the galaxy: Σp² is the weighted mean over the PSFs.
    fn measure_combined<'a>(
        &mut self,
        count: usize,
        epoch: &dyn Fn(usize) -> CutEpoch<'a>,
    ) -> Result<(Found, f64), MeasureError> {
        let precision = |of: &CutEpoch<'_>| of.pixels.area() / (of.noise * of.noise);
        let total: f64 = (0..count).map(|k| precision(&epoch(k))).sum();
        let settings = &self.family.method.deconvolution;
        self.epoch_weights.clear();
        let (mut squares, mut inverse_gain) = (0.0, 0.0);
        // Weights of epochs with a survey, and the weighted mean squares of their galaxies without the PSF.
        let (mut surveyed, mut variance) = (0.0, 0.0);
        for k in 0..count {
            let epoch = epoch(k);
            self.family.check_side(epoch.psf)?;
            let (weight, pixel) = (precision(&epoch) / total, epoch.pixels.area());
            let psf = self.denoiser.denoised_with(epoch.psf, epoch.stars);
            squares += weight / (noise_equivalent_area(psf) * pixel);
            if let Some((seen, psf)) = epoch.galaxy_variance.zip(self.moments.psf_mean_square(psf))
            {
                surveyed += weight;
                variance += weight * pixel * (seen - psf);
            }
            // A photon of one epoch counts with its weight, and its variance with the square.
            inverse_gain += epoch.gain.map_or(0.0, |gain| weight * weight / gain);
            self.epoch_weights.push(weight as f32);
        }
        let window = match surveyed > 0.0 {
            true => window_index(variance / surveyed, settings.reference_extent),
            false => CONFIGURED_WINDOW,
        };
        let area = 1.0 / squares;
        let index = (width_step(area, settings.reference_area), window);
        self.current = place_of(index, &mut self.workers, &self.family, &self.noise)?;
        let worker = &mut self.workers[self.current];
        worker.psf_variance = gaussian_variance(area);
        let level = total.sqrt().recip();
        let gain = (inverse_gain > 0.0).then(|| inverse_gain.recip());
        for k in 0..count {
            let CutEpoch {
                psf, pixels, stars, ..
            } = epoch(k);
            worker.set_epoch_psf(k, self.denoiser.denoised_with(psf, stars), pixels)?;
        }
        worker.combine_epochs(&self.epoch_weights);
        // The window is on the light that is expected there, in all epochs.
        let stamp = |k: usize| {
            let CutEpoch { cut, offset, .. } = epoch(k);
            EpochStamp {
                pixels: cut,
                window: offset,
                origin: offset,
            }
        };
        Ok((worker.measure(&stamp, level, gain), level))
    }

    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images {
        self.workers[self.current].images(cut, psf)
    }
}

/// Place of the worker for a plan, which is made if it is new.
fn place_of(
    index: PlanIndex,
    workers: &mut Vec<PlanWorker>,
    family: &LinearFamily,
    noise: &StampNoise,
) -> Result<usize, MeasureError> {
    if let Some(known) = workers.iter().position(|worker| worker.index == index) {
        return Ok(known);
    }
    let mut worker = PlanWorker::new(index, family.plan(index)?);
    worker.set_noise(noise, PixelShape::SQUARE);
    workers.push(worker);
    Ok(workers.len() - 1)
}

/// Buffers of one thread for one plan.
struct PlanWorker {
    index: PlanIndex,
    plan: Arc<LinearPlan>,
    noise: ModeNoise,
    /// The shape of pixels that `noise` is for.
    noise_pixels: PixelShape,
    pixels: PixelShape,
    psf: SpectralPsf,
    /// Mean square per axis in px² of the Gaussian with the noise-equivalent area of the PSF.
    psf_variance: f64,
    regularisation: RegularisationTerms,
    /// Of e₁, e₂ and the size's T, as spectra.
    gradients: [Vec<f32>; 3],
    buffers: SpectralScratch,
    lags: Lags,
}

impl PlanWorker {
    fn new(index: PlanIndex, plan: Arc<LinearPlan>) -> Self {
        PlanWorker {
            index,
            noise: plan.white.clone(),
            noise_pixels: PixelShape::SQUARE,
            pixels: PixelShape::SQUARE,
            psf: plan.spectral.psf(),
            psf_variance: 0.0,
            regularisation: RegularisationTerms::default(),
            gradients: plan.gradients.clone(),
            buffers: plan.spectral.scratch(),
            lags: plan.spectral.lags(),
            plan,
        }
    }

    /// Sets the noise of an image in units of its level. A PSF is set after it.
    fn set_noise(&mut self, noise: &StampNoise, pixels: PixelShape) {
        self.noise = self.plan.spectral.noise_on(noise, pixels);
        self.noise_pixels = pixels;
    }

    /// Sets the shape of pixels in images with `noise`. A PSF is set after it.
    fn set_pixel_shape(&mut self, pixels: PixelShape, noise: &StampNoise) {
        self.pixels = pixels;
        self.plan
            .spectral
            .set_pixel_shape(pixels, &mut self.buffers);
        if noise.is_white() {
            return;
        }
        // Rounded, not kept until it differs: results must not depend on the galaxies before.
        let rounded = |value: f64| (value * NOISE_SHAPE_STEPS).round() / NOISE_SHAPE_STEPS;
        let pixels = PixelShape {
            stretch: rounded(pixels.stretch),
            skew: rounded(pixels.skew),
        };
        if self.noise_pixels != pixels {
            self.set_noise(noise, pixels);
        }
    }

    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        let plan = &self.plan;
        plan.spectral
            .set_psf(psf, &self.noise, &mut self.buffers, &mut self.psf)?;
        self.regularisation = plan.regularisation.behind(&self.psf);
        Ok(())
    }

    fn retake_psf(&mut self) {
        let plan = &self.plan;
        plan.spectral
            .retake_psf(&self.noise, &mut self.buffers, &mut self.psf);
        self.regularisation = plan.regularisation.behind(&self.psf);
    }

    /// Response of the ellipticity to a change of the autocorrelation by `lags.shear1` and `lags.shear2`.
    fn response(&self, e: &[Ratio; 2]) -> ResponseMatrix {
        let of = |change| self.plan.moments.response(e, change);
        let (first, second) = (of(&self.lags.shear1), of(&self.lags.shear2));
        [[first[0], second[0]], [first[1], second[1]]]
    }

    /// Flux and size with their responses.
    fn observables(&self, mean_square: Ratio, noise: f32, seed: u64) -> FoundObservables {
        let LinearPlan {
            size_moments: moments,
            aperture,
            shear_step,
            ..
        } = &*self.plan;
        let response = |change: &[f32]| f64::from(moments.response(mean_square, change));
        FoundObservables {
            flux: self.lags.flux.map(|flux| aperture * f64::from(flux)),
            flux_error: aperture * f64::from(noise * self.psf.flux_error()),
            ring: self.lags.ring.map(f64::from),
            square_response: [response(&self.lags.shear1), response(&self.lags.shear2)],
            size: moments.size(f64::from(mean_square.value)),
            sheared: shear_step.map(|step| ShearSettings {
                step,
                normals: normals(seed),
            }),
        }
    }

    /// Mean effects of noise on the galaxy whose lags were measured last, with the weight of all galaxies that it stands for.
    fn noise_moments(
        &mut self,
        [e1, e2]: [Ratio; 2],
        mean_square: Ratio,
        noise: f32,
    ) -> NoiseChanges<NoiseMeans> {
        let plan = &*self.plan;
        let ([light, plus, cross], [zero, two]) = (&plan.gradients, &plan.size_gradients);
        let parts = [
            (e1, light, plus),
            (e2, light, cross),
            (mean_square, zero, two),
        ];
        for (out, (ratio, divisor, dividend)) in self.gradients.iter_mut().zip(parts) {
            for ((out, divisor), dividend) in out.iter_mut().zip(divisor).zip(dividend) {
                *out = ratio.change(*divisor, *dividend);
            }
        }
        let [of_e1, of_e2, of_square] = &self.gradients;
        let products = plan.spectral.products(
            &self.psf,
            [of_e1, of_e2, light, of_square, zero],
            &mut self.buffers,
        );
        let unit = f64::from(noise * noise) * plan.noise_moments_interval as f64;
        // The aperture corrects each factor of the flux.
        let mut factors = [1.0; QUANTITIES];
        factors[2 + FLUX] = plan.aperture;
        let ratios = [e1, e2, mean_square];
        let means = |change: fn(NoiseChanges<f32>) -> f32| NoiseMeans {
            products: Symmetric::from_fn(|a, b| {
                unit * (factors[a] * factors[b]) * f64::from(change(products.pairs[[a, b]]))
            }),
            curvature: std::array::from_fn(|k| {
                unit * ratios[k].mean_second_derivative(change(products.with_divisors[k]))
            }),
        };
        NoiseChanges {
            sheared: [
                means(|product| product.sheared[0]),
                means(|product| product.sheared[1]),
            ],
            turned: means(|product| product.turned),
            plain: means(|product| product.plain),
        }
    }

    /// What the galaxy's own Poisson noise adds to the variance of a pixel, in units of the image times electrons: as much of
    /// white noise has its power under the window.
    ///
    /// Noise n of variance s(x)/g, s being the light of the galaxy behind the PSF, has the mean power ∫ W² s/g in each mode
    /// under the window W, white noise the power σ² ∫ W² = σ² π w². The light is a Gaussian of the measured flux and size,
    /// so that positive noise of a pixel does not raise the variance there; the flux is noisy, by 1/ν.
    fn own_variance(&self, noise: f32) -> f64 {
        let plan = &*self.plan;
        let lags = &self.lags;
        let of_size = self.regularisation.size * noise * noise;
        let typical = plan.regularisation.typical_square;
        let mean_square = plan.size_moments.measure(&lags.acf, of_size, typical);
        let size = plan.size_moments.size(f64::from(mean_square.value)).px;
        let window = plan.lengths.window_sigma * plan.lengths.window_sigma;
        let of_galaxy = size * size;
        let flux = f64::from(lags.flux.value) * plan.lengths.aperture(of_galaxy);
        let under = flux / (1.0 + 2.0 * (of_galaxy + self.psf_variance) / window);
        under.max(0.0) / (std::f64::consts::PI * window)
    }

    fn set_epoch_psf(
        &mut self,
        at: usize,
        psf: ArrayView2<'_, f64>,
        pixels: EpochPixels,
    ) -> Result<(), MeasureError> {
        let spectral = &self.plan.spectral;
        spectral.set_epoch_psf(at, psf, pixels, &mut self.buffers, &mut self.psf)
    }

    /// Takes the epochs whose PSFs were set, in white noise and with these weights.
    fn combine_epochs(&mut self, weights: &[f32]) {
        let plan = &self.plan;
        plan.spectral
            .combine(weights, &plan.white, &mut self.buffers, &mut self.psf);
        self.regularisation = plan.regularisation.behind(&self.psf);
    }

    /// Measures a galaxy on a stamp per PSF that was set, in noise of this level.
    fn measure<'a>(
        &mut self,
        stamp: &dyn Fn(usize) -> EpochStamp<'a>,
        noise: f64,
        gain: Option<f64>,
    ) -> Found {
        let plan = Arc::clone(&self.plan);
        let (spectral, mut sigma) = (&plan.spectral, noise as f32);
        spectral.restore_epochs(&self.psf, stamp, &mut self.buffers);
        if gain.is_some() {
            self.buffers.keep();
        }
        spectral.take_lags(&self.psf, sigma, &mut self.buffers, &mut self.lags);
        if let Some(gain) = gain {
            sigma = noise.hypot((self.own_variance(sigma) / gain).sqrt()) as f32;
            self.buffers.recall();
            spectral.take_lags(&self.psf, sigma, &mut self.buffers, &mut self.lags);
        }
        self.measure_lags(stamp(0).pixels, noise, sigma)
    }

    /// Measures `lags` of a galaxy in noise of the sky of level `sky_noise`, and together with the galaxy's own of level
    /// `total_noise`. `stamp` decides for which galaxies the effects of noise are determined.
    fn measure_lags(&mut self, stamp: &[f32], sky_noise: f64, total_noise: f32) -> Found {
        let plan = Arc::clone(&self.plan);
        let acf = &self.lags.acf;
        let RegularisationTerms { ellipticity, size } = self.regularisation;
        let variance = total_noise * total_noise;
        let e = plan.moments.measure(acf, ellipticity * variance);
        let mut found = Found {
            descent: Descent {
                iterations: plan.iterations,
                stop: Stop::MaxIterations,
                first_energy: f64::NAN,
                energy: f64::NAN,
                updated: stamp.len() as u32,
            },
            ellipticity: e.map(|e| e.map(|ratio| f64::from(ratio.value))),
            response: None,
            noise_moments: None,
            observables: None,
            flux: plan.aperture * f64::from(self.lags.flux.value),
            radius: plan.spectral.lattice().radius(),
            size: f64::NAN,
        };
        if let Ok(e) = e {
            found.response = Some(self.response(&e));
            let seed = seed_of(stamp, total_noise);
            let typical = plan.regularisation.typical_square;
            let mean_square = plan.size_moments.measure(acf, size * variance, typical);
            if sky_noise > 0.0 && seed.is_multiple_of(plan.noise_moments_interval) {
                found.noise_moments = Some(self.noise_moments(e, mean_square, total_noise));
            }
            let observables = self.observables(mean_square, total_noise, seed);
            found.size = observables.size.px;
            found.observables = Some(observables);
        }
        found
    }

    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images {
        let LinearPlan {
            spectral, moments, ..
        } = &*self.plan;
        // A convolution takes pixel p/2 for the centre of the PSF, half a pixel beyond the middle of an even one.
        let shift = if psf.nrows().is_multiple_of(2) {
            0.5
        } else {
            0.0
        };
        let deconvolved = spectral.deconvolved(&self.psf, cut, shift, &mut self.buffers);
        let lattice = spectral.lattice();
        let acf = square_lags(&self.lags.acf, lattice);
        let lag = |place: usize| (place as f64 - lattice.reach as f64) * lattice.row_spacing;
        let weight = Array2::from_shape_fn(acf.dim(), |(y, x)| {
            moments.weight(lag(x).powi(2) + lag(y).powi(2))
        });
        Images {
            deconvolved: image(&deconvolved, spectral.stamp_size()),
            acf,
            weight: Some(weight),
            spacing: lattice.row_spacing,
        }
    }
}

/// An autocorrelation as an image with the spacing of the lattice's rows, interpolated along the rows.
fn square_lags(lags: &[f32], lattice: HexLattice) -> Array2<f64> {
    let side = 2 * lattice.reach + 1;
    Array2::from_shape_fn((side, side), |(y, x)| {
        let [x, y] = [x, y].map(|at| at as f64 - lattice.reach as f64);
        // A(−dx, −dy) = A(dx, dy).
        let (x, row) = if y < 0.0 {
            (-x, -y as usize)
        } else {
            (x, y as usize)
        };
        let at = x * lattice.row_spacing / lattice.spacing() + lattice.middle(row);
        let first = at.floor();
        let value = |column: f64| {
            if (0.0..lattice.width() as f64).contains(&column) {
                f64::from(lags[row * lattice.width() + column as usize])
            } else {
                0.0
            }
        };
        (1.0 - (at - first)) * value(first) + (at - first) * value(first + 1.0)
    })
}

/// Index of the width for galaxies of a mean square of `variance` px² per axis. The configured width is for `reference` px².
fn window_index(variance: f64, reference: f64) -> usize {
    // A point source has no positive ratio, and gets the narrowest window.
    let ratio = (variance / reference).max(f64::MIN_POSITIVE);
    let step = (WINDOWS_PER_OCTAVE * WINDOW_POWER * ratio.log2()).round() as i32;
    match reference > 0.0 {
        true => CONFIGURED_WINDOW
            .wrapping_add_signed(step.clamp(*WINDOW_STEPS.start(), *WINDOW_STEPS.end()) as isize),
        false => CONFIGURED_WINDOW,
    }
}

/// Mean square per axis in px² of the galaxies that the width at `index` is for, if the configured width is `sigma` px
/// for `reference` px². Without a reference it is the mean square of GREAT10's galaxies, in proportion to `sigma`².
fn galaxy_variance(reference: f64, sigma: f64, index: usize) -> f64 {
    let configured = if reference > 0.0 {
        reference
    } else {
        sigma * sigma * GREAT10_VARIANCE
    };
    configured
        * ((index as f64 - CONFIGURED_WINDOW as f64) / (WINDOWS_PER_OCTAVE * WINDOW_POWER)).exp2()
}

/// The width at `index` on stamps of `n` pixels a side, if the configured width is `sigma`.
fn window_width(sigma: f64, index: usize, n: usize) -> f64 {
    if index == CONFIGURED_WINDOW {
        return sigma;
    }
    let steps = index as f64 - CONFIGURED_WINDOW as f64;
    let widest = (WIDEST_WINDOW * n as f64).max(sigma).min(*WINDOWS.end());
    (sigma * (steps / WINDOWS_PER_OCTAVE).exp2()).clamp(*WINDOWS.start(), widest)
}

/// A seed from the stamp alone, so that neither order nor threads decide which galaxies get the moments of noise. Pixels
/// count in steps of a sixteenth of the noise: the rounding of another machine hardly ever changes the seed.
fn seed_of(stamp: &[f32], noise: f32) -> u64 {
    // Noise makes the middle row different for each galaxy.
    let n = stamp.len().isqrt();
    let row = &stamp[n / 2 * n..][..n];
    let step = |value: &f32| ((16.0 * value / noise).round() as i32).cast_unsigned();
    hash(row.iter().map(step)) >> 16
}

/// Gaussian numbers from a seed (Box & Muller 1958). The crate has no dependency on random generators outside of tests.
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

#[cfg(test)]
mod tests {
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};
    use shearq_submissions::{Configuration, Method, Registry};

    use super::*;
    use crate::measurement::Measurement;
    use crate::measurer::{ImageNoise, Measurer};
    use crate::noise::Survey;

    #[test]
    fn windows_follow_the_galaxies() {
        assert_eq!(WINDOW_STEPS.count(), WINDOW_COUNT);
        let index = |variance| window_index(variance, 10.0);
        // Once, a fifth, twice, and nothing of 10 px²: 3.2·log₂ of it, within bounds.
        let found = [10.0, 2.0, 20.0, 0.0, -2.0, 1e9].map(index);
        assert_eq!(found, [CONFIGURED_WINDOW, 0, 6, 0, 0, 6]);
        let wider = index(10.0 * 2f64.powf(0.34));
        assert_eq!(wider, CONFIGURED_WINDOW + 1);
        assert_eq!(window_index(2.0, 0.0), CONFIGURED_WINDOW);
        let ratio =
            |of: &dyn Fn(usize) -> f64| of(CONFIGURED_WINDOW + 2) / of(CONFIGURED_WINDOW - 2);
        let twice = ratio(&|at| window_width(5.0, at, 48));
        assert!((twice - 2.0).abs() < 1e-12, "{twice}");
        let twice = ratio(&|at| galaxy_variance(9.0, 8.0, at));
        assert!((twice.powf(WINDOW_POWER) - 2.0).abs() < 1e-12, "{twice}");
        assert_eq!(galaxy_variance(9.0, 8.0, CONFIGURED_WINDOW), 9.0);
        assert_eq!(galaxy_variance(0.0, 8.0, CONFIGURED_WINDOW), 8.8);
        let widths = [
            (8.0, CONFIGURED_WINDOW, 48),
            (8.0, CONFIGURED_WINDOW, 32),
            (8.0, 6, 32),
            (15.0, 6, 64),
        ];
        assert_eq!(
            widths.map(|(s, at, n)| window_width(s, at, n)),
            [8.0, 8.0, 8.0, 15.0]
        );
        assert!((window_width(8.0, 6, 48) - 9.6).abs() < 1e-12);
        assert_eq!(window_width(2.0, 0, 48), 2.0);
        assert_eq!(window_width(8.0, 6, 96), 8.0 * 2f64.powf(0.75));
    }

    fn configuration(reference_area: f64) -> Configuration {
        let mut configuration = Registry::embedded()
            .unwrap()
            .get("48/linear/star")
            .unwrap()
            .configuration;
        if let Method::Linear(linear) = &mut configuration.method {
            linear.deconvolution.reference_area = reference_area;
        }
        configuration
    }

    fn moffat(fwhm: f64) -> FunctionalPsf {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        FunctionalPsf::new(profile, fwhm, Shear::new(0.03, -0.02)).unwrap()
    }

    /// Measurements of a galaxy as wide as the PSF, elongated along x, with the σ of the target.
    fn measured(
        configuration: &Configuration,
        fwhms: &[f64],
        noise: f64,
    ) -> Vec<(Measurement, f64)> {
        let mut worker = Measurer::new(configuration, 48).unwrap().worker();
        let each = fwhms.iter().map(|&fwhm| {
            let psf = moffat(fwhm).stamp_beside(configuration.psf_cut().size, 48);
            let stamp = Array2::from_shape_fn((48, 48), |(y, x)| {
                let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
                (100.0 * (-(x * x / 1.2 + y * y) / (fwhm * fwhm)).exp()) as f32
            });
            let mut image = worker.image(ImageNoise::Level(noise));
            let mut worker = image.psf(psf.view()).unwrap();
            let found = worker.measure(stamp.view()).unwrap();
            (found, worker.adapted().unwrap().target_sigma)
        });
        each.collect()
    }

    #[test]
    fn targets_follow_the_width_of_the_psf() {
        let (with, without) = (configuration(50.0), configuration(0.0));
        let fwhms = [3.4, 6.0, 3.06, 2.0];
        let found = measured(&with, &fwhms, 0.5);
        let plain = measured(&without, &fwhms, 0.5);
        for k in [0, 2] {
            assert_eq!(
                (found[k].0.e1, found[k].0.response),
                (plain[k].0.e1, plain[k].0.response)
            );
        }
        assert!(found[1].1 > 1.2 * plain[1].1, "{found:?} {plain:?}");
        assert!(found[3].1 < 0.8 * plain[3].1, "{found:?} {plain:?}");
        // Earlier PSFs of the worker do not matter.
        let alone = measured(&with, &[6.0], 0.5);
        assert_eq!(
            (found[1].0.e1, found[1].0.e2),
            (alone[0].0.e1, alone[0].0.e2)
        );
    }

    #[test]
    fn windows_follow_the_galaxies_of_the_image() {
        let configuration = configuration(50.0);
        let mut worker = Measurer::new(&configuration, 48).unwrap().worker();
        let psf = moffat(3.4).stamp_beside(configuration.psf_cut().size, 48);
        let stamp = moffat(6.0).stamp(48).mapv(|v| 1000.0 * v as f32);
        let mut radius = |extent: Option<f64>| {
            let survey = Survey {
                noise: StampNoise::white(0.1),
                mean_square_radius: extent,
                sky: None,
            };
            let survey = Arc::new(survey);
            let mut image = worker.image(ImageNoise::Survey(&survey));
            let mut worker = image.psf(psf.view()).unwrap();
            let found = worker.measure(stamp.view()).unwrap();
            assert!(found.e1.is_finite() && found.noise == 0.1, "{found:?}");
            (found.radius, worker.adapted().unwrap().window_sigma)
        };
        let [own, narrow, wide, again] = [None, Some(4.0), Some(30.0), Some(13.0)].map(&mut radius);
        // In steps of the lags; the stamp's side limits the wide one.
        assert!(
            narrow.0 < 0.7 * own.0 && wide.0 > own.0 && again == own,
            "{narrow:?} {own:?} {wide:?} {again:?}"
        );
        assert!(narrow.1 < own.1 && wide.1 > own.1);
        assert_eq!(
            own.1,
            configuration.linear().unwrap().deconvolution.window_sigma
        );
    }

    #[test]
    fn variances_of_psfs_are_without_the_noise_of_their_border() {
        let configuration = configuration(50.0);
        let (linear, cut) = (configuration.linear().unwrap(), configuration.psf_cut());
        let family = Arc::new(LinearFamily::new(linear, 48, cut).unwrap());
        let mut worker = family.worker();
        worker.set_gain(Some(1.0));
        let psf = moffat(3.4).stamp(cut.size) + 1e-3;
        let psf = &psf / psf.sum();
        worker.set_psf(psf.view()).unwrap();
        let area = noise_equivalent_area(StarDenoiser::default().denoised(psf.view()));
        let ratio = 4.0 * std::f64::consts::PI * worker.workers[worker.current].psf_variance / area;
        assert!((ratio - 1.0).abs() < 1e-12, "{ratio}");
    }

    #[test]
    fn zeros_around_a_psf_change_nothing() {
        let configuration = configuration(50.0);
        let mut worker = Measurer::new(&configuration, 48).unwrap().worker();
        let stamp = moffat(8.0).stamp(48).mapv(|v| 1000.0 * v as f32);
        let star = moffat(6.0).stamp(36);
        let mut wide = Array2::zeros((48, 48));
        wide.slice_mut(ndarray::s![6..42, 6..42]).assign(&star);
        let mut image = worker.image(ImageNoise::Level(0.1));
        let [small, large] = [&star, &wide].map(|psf| {
            let mut worker = image.psf(psf.view()).unwrap();
            worker.measure(stamp.view()).unwrap()
        });
        assert_eq!((small.e1, small.response), (large.e1, large.response));
        for side in [30, 33, 50] {
            assert!(image.psf(moffat(6.0).stamp(side).view()).is_err(), "{side}");
        }
    }

    /// `48/linear/star` with a PSF as large as the stamp.
    fn wide_psf(half_snr: f64) -> Configuration {
        let registry = Registry::embedded().unwrap();
        let mut configuration = registry.get("48/linear/star").unwrap().configuration;
        configuration.psf.size = 48;
        if let Method::Linear(linear) = &mut configuration.method {
            linear.shape.half_snr = half_snr;
        }
        configuration
    }

    /// A nearly round Gaussian of a mean square of `extent` px² per axis behind a round Gaussian PSF of `variance` px².
    fn stamp(extent: f64, variance: f64) -> Array2<f32> {
        let (along, across) = (1.01 * extent + variance, 0.99 * extent + variance);
        Array2::from_shape_fn((48, 48), |(y, x)| {
            let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
            (-0.5 * (x * x / along + y * y / across)).exp() as f32
        })
    }

    fn gaussian(fwhm: f64) -> FunctionalPsf {
        // A Moffat of large exponent.
        let profile = PsfProfile::Moffat { beta: 60.0 };
        FunctionalPsf::new(profile, fwhm, Shear::new(0.0, 0.0)).unwrap()
    }

    /// A galaxy with a core and wings at (x, y) from the middle of its stamp, sheared about its own centre.
    fn off_centre([x0, y0]: [f64; 2], [g1, g2]: [f64; 2], psf_variance: f64) -> Array2<f32> {
        let norm = 1.0 - g1 * g1 - g2 * g2;
        Array2::from_shape_fn((48, 48), |(y, x)| {
            let (x, y) = (x as f64 - 23.5 - x0, y as f64 - 23.5 - y0);
            let each = [2.0, 16.0].map(|extent| {
                let (a, d) = (1.2 * extent, extent / 1.2);
                let xx = ((1.0 + g1).powi(2) * a + g2 * g2 * d) / norm + psf_variance;
                let yy = (g2 * g2 * a + (1.0 - g1).powi(2) * d) / norm + psf_variance;
                let xy = g2 * ((1.0 + g1) * a + (1.0 - g1) * d) / norm;
                let det = xx * yy - xy * xy;
                (-0.5 * (yy * x * x + xx * y * y - 2.0 * xy * x * y) / det).exp() / det.sqrt()
            });
            (1e4 * (each[0] + each[1])) as f32
        })
    }

    #[test]
    fn response_of_galaxies_off_the_middle_is_about_their_centroid() {
        let variance = 1.7;
        let mut psf = Array2::from_shape_fn((48, 48), |(y, x)| {
            let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
            (-0.5 * (x * x + y * y) / variance).exp()
        });
        psf /= psf.sum();
        let measured = |origin: ShearOrigin, g: [f64; 2]| {
            let mut configuration = wide_psf(0.0);
            if let Method::Linear(linear) = &mut configuration.method {
                linear.shape.origin = origin;
            }
            let mut worker = Measurer::new(&configuration, 48).unwrap().worker();
            let mut image = worker.image(ImageNoise::Level(1e-2));
            let mut worker = image.psf(psf.view()).unwrap();
            let stamp = off_centre([1.5, -1.0], g, variance);
            let found = worker.measure(stamp.view()).unwrap();
            ([found.e1, found.e2], found.response.unwrap()[0][0])
        };
        let step = 0.01;
        let slope = |k: usize| {
            let e = [step, -step].map(|by| {
                let mut g = [0.0; 2];
                g[k] = by;
                measured(ShearOrigin::Stamp, g).0[k]
            });
            (e[0] - e[1]) / (2.0 * step)
        };
        let expected = 0.5 * (slope(0) + slope(1));
        let [stamp, centroid] = [ShearOrigin::Stamp, ShearOrigin::Centroid]
            .map(|origin| measured(origin, [0.0; 2]).1 / expected - 1.0);
        // Three steps leave a part of the offset.
        assert!(
            stamp > 1.5e-3 && centroid.abs() < 3e-4,
            "{stamp} {centroid}"
        );
    }

    #[test]
    fn the_size_of_a_galaxy_of_snr_5_is_half_the_typical_one() {
        let configuration = wide_psf(15.0);
        let method = configuration.linear().unwrap();
        let variance = LinearFamily::variance(method, CONFIGURED_WINDOW);
        let plan = Arc::new(LinearPlan::new(method, 48, 48, variance).unwrap());
        for fwhm in [2.4, 5.5] {
            let mut worker = PlanWorker::new(CONFIGURED, Arc::clone(&plan));
            worker.set_psf(gaussian(fwhm).stamp(48).view()).unwrap();
            let stamp = stamp(variance, (fwhm / 2.354_82_f64).powi(2) + 1.0 / 12.0);
            let light = stamp.iter().map(|v| v * v).sum::<f32>();
            let stamp = EpochStamp {
                pixels: stamp.as_slice().unwrap(),
                window: [0.0; 2],
                origin: [0.0; 2],
            };
            worker.measure(&|_| stamp, 0.0, None);
            let [zero, _] = plan.size_moments.sums(&worker.lags.acf);
            // The variance of the noise is the light over the square of the S/N.
            let added = worker.regularisation.size * light / 25.0;
            assert!((added / zero - 1.0).abs() < 0.03, "{fwhm}: {added} {zero}");
        }
    }

    #[test]
    fn half_snr_halves_the_weight_behind_any_psf_and_window() {
        // Bright, because the mean of noise is subtracted from stamps without noise.
        let half_snr = 150.0;
        let mut workers =
            [half_snr, 0.0].map(|snr| Measurer::new(&wide_psf(snr), 48).unwrap().worker());
        let mut moments = WeightedMoments::default();
        for (fwhm, window) in [
            (2.4, CONFIGURED_WINDOW),
            (3.4, CONFIGURED_WINDOW),
            (3.4, 0),
            (3.4, WINDOW_COUNT - 1),
            (5.5, CONFIGURED_WINDOW),
            (5.5, WINDOW_COUNT - 1),
        ] {
            let psf = gaussian(fwhm).stamp(48);
            let extent = galaxy_variance(8.8, 8.0, window);
            let stamp = stamp(extent, (fwhm / 2.354_82_f64).powi(2) + 1.0 / 12.0);
            let light = stamp.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>();
            let seen = extent + moments.psf_mean_square(psf.view()).unwrap();
            // ν²/(ν² + ν₀²).
            for (snr, share) in [(half_snr, 0.5), (2.0 * half_snr, 0.8)] {
                let survey = Arc::new(Survey {
                    noise: StampNoise::white(light.sqrt() / snr),
                    mean_square_radius: Some(seen),
                    sky: None,
                });
                let [soft, hard] = workers.each_mut().map(|worker| {
                    let mut image = worker.image(ImageNoise::Survey(&survey));
                    let mut worker = image.psf(psf.view()).unwrap();
                    worker.measure(stamp.view()).unwrap().e1
                });
                // The noise that is left, 10⁻³ of the light at most, and the window's effect on the matched filter.
                assert!(
                    (soft / hard / share - 1.0).abs() < 0.01,
                    "{fwhm} {window} {snr}: {soft} of {hard}"
                );
            }
        }
    }
}
