//! A plan for one configuration and size of stamps, and the workers that measure galaxies with it.
//!
//! The types fix the order. A [`Worker`] becomes an [`ImageWorker`] for an image, whose noise is known. An [`ImageWorker`]
//! becomes a [`PsfWorker`] for a PSF, and only this measures galaxies.

use std::fmt;
use std::sync::Arc;

use ndarray::{Array2, ArrayView2, ArrayView3};
use shearq_quantities::{Jacobian, PixelShape, Spin2};
use shearq_submissions::{Configuration, ConfigurationError, NoiseSource, Registry};

use crate::defects::{Defects, LightLimits, Screening};
use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise};
use crate::error::{EpochError, MeasureError};
use crate::measurement::{DefectCounts, Flag, Measurement, PsfShape};
use crate::method::{AdaptedSettings, CutEpoch, CutWorker, Images, MethodPlan, Saturation};
use crate::missing::{MissingPixels, mark_padding_missing};
use crate::network::convolve;
use crate::noise::{NoisePlan, StampNoise, Survey};
use crate::pixels::{PEAK_RANGE, Pixel, all_finite, highest, is_level};
use crate::psf::{Psfs, ResidualProfiles, Star, StarSurvey, cut_start};
use crate::spectral::EpochPixels;
use crate::stamp::{FullStamp, SkySubtraction};

// Pixels are then 1.22 times as far apart as square ones, so that the largest wave number of the sharpest target, 2.2 per
// pixel, is still below the Nyquist frequency. Chosen by hand: cameras are below 0.02.
const MAX_PIXEL_SHEAR: f64 = 0.2;
// The network works on pixels, so that a shear of pixels becomes an error of shears. Chosen by hand: a tenth of the network's errors.
const MAX_NETWORK_PIXEL_SHEAR: f64 = 1e-3;

/// The plan of a measurement, for one configuration and one size of stamps. Measuring does not change it, so it serves
/// all threads. Each thread has a [`Worker`]. Clones share the plan.
#[derive(Clone)]
pub struct Measurer(Arc<Plan>);

struct Plan {
    configuration: Configuration,
    full: usize,
    denoise: Option<WaveletWiener>,
    method: MethodPlan,
    noise: Option<NoisePlan>,
}

impl fmt::Debug for Measurer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Measurer")
            .field("configuration", &self.0.configuration)
            .field("full", &self.0.full)
            .finish_non_exhaustive()
    }
}

impl Measurer {
    /// Plans for full stamps of `full` pixels a side.
    ///
    /// If the stamps are odd and the configuration's stamp size is even, or the reverse, the linear method takes a pixel
    /// more of the stamps and a pixel less of PSFs. So galaxies stay in the middle of its window.
    ///
    /// # Errors
    /// If a setting is out of its range, or the stamps are smaller than the configuration needs.
    pub fn new(configuration: &Configuration, full: usize) -> Result<Self, MeasureError> {
        configuration.validate().map_err(ConfigurationError::from)?;
        let n = configuration.stamp.size;
        if full < n {
            let expected = format!(
                "at least {n} × {n}, as configuration {} needs",
                configuration.name
            );
            return Err(MeasureError::square("stamps", (full, full), expected));
        }
        let mut configuration = configuration.clone();
        if configuration.linear().is_some() && full % 2 != n % 2 {
            configuration.stamp.size += 1;
            configuration.psf.size -= 1;
            configuration.validate().map_err(ConfigurationError::from)?;
        }
        let wavelet = configuration.wavelet();
        Ok(Measurer(Arc::new(Plan {
            full,
            denoise: wavelet.map(|settings| WaveletWiener::new(full, settings)),
            method: MethodPlan::new(&configuration, configuration.stamp.size)?,
            noise: match configuration.noise {
                NoiseSource::Image { correlation, sky } => {
                    Some(NoisePlan::new(full, correlation, Some(sky))?)
                }
                NoiseSource::Header | NoiseSource::Border { .. } => None,
            },
            configuration,
        })))
    }

    /// The same for the name of a configuration or the path of a settings file.
    ///
    /// # Errors
    /// If there is no such configuration, it is not valid, or as [`Measurer::new`].
    pub fn named(configuration: &str, full: usize) -> Result<Self, MeasureError> {
        let named = Registry::embedded()?.get(configuration)?;
        Measurer::new(&named.configuration, full)
    }

    /// The configuration.
    pub fn configuration(&self) -> &Configuration {
        &self.0.configuration
    }

    /// Pixels a side of the full stamps.
    pub fn full(&self) -> usize {
        self.0.full
    }

    /// The plan for measuring the noise of an image on its stamps, if the configuration requires that.
    pub(crate) fn noise_plan(&self) -> Option<&NoisePlan> {
        self.0.noise.as_ref()
    }

    pub(crate) fn subtraction(&self, survey: Option<&Survey>) -> SkySubtraction {
        let sky = survey.and_then(|survey| survey.sky);
        SkySubtraction::of(self.0.configuration.noise.sky(), sky)
    }

    /// Buffers to examine the stars of an image with one per galaxy; `None` if the configuration uses stars as they are.
    pub(crate) fn star_survey(&self) -> Option<StarSurvey> {
        self.0.configuration.linear()?;
        Some(StarSurvey::new(self.0.configuration.psf_cut(), self.full()))
    }

    /// Largest offset of a galaxy from the centre of an epoch's stamp that [`ImageWorker::measure_epochs`] accepts, along each
    /// axis in pixels. Farther out, the window would reach over the edge.
    pub fn max_epoch_offset(&self) -> f64 {
        self.0.configuration.stamp.size as f64 / 4.0
    }

    /// Buffers for one thread.
    pub fn worker(&self) -> Worker {
        let (plan, n) = (&*self.0, self.0.configuration.stamp.size);
        Worker {
            measurer: self.clone(),
            method: plan.method.worker(),
            denoise: plan.denoise.as_ref().map(WaveletWiener::scratch),
            full: FullStamp::new(plan.full),
            cut: vec![0.0; n * n],
            border: Vec::with_capacity(plan.full * plan.full),
            missing: MissingPixels::new(n),
            defects: Defects::new(plan.full),
            found_defects: DefectCounts::default(),
            light: LightLimits::default(),
            to_sky: None,
            jacobian: None,
            psf: PsfShape::UNKNOWN,
            epochs: Vec::new(),
            used: Vec::new(),
        }
    }

    /// Measures one stamp with its star stamp and noise level, which may be `None` if the configuration measures the noise
    /// on the border of the stamp.
    ///
    /// The response is determined on this galaxy. The ellipticity is **not calibrated**: the quotient of ellipticity and response
    /// of one galaxy is noisy and biased. Divide it by [`Batch::response`](crate::Batch::response) of galaxies like this one.
    ///
    /// # Errors
    /// If sizes do not fit, the noise level is not finite, pixels are not (more of them than a linear method fills
    /// from the opposite side), or the PSF is dark or off centre. A galaxy that cannot be measured for other reasons is
    /// flagged.
    pub fn stamp<T: Pixel, P: Pixel>(
        &self,
        stamp: ArrayView2<'_, T>,
        psf: ArrayView2<'_, P>,
        noise: Option<f64>,
    ) -> Result<Measurement, MeasureError> {
        match noise {
            Some(level) if !is_level(level) => return Err(MeasureError::Noise(level.to_string())),
            None if !matches!(self.configuration().noise, NoiseSource::Border { .. }) => {
                return Err(MeasureError::Noise("not given".into()));
            }
            _ => {}
        }
        let Star { psf, .. } = Star::cut(psf, self.configuration().psf_cut())?;
        let mut worker = self.worker();
        let mut image = worker.image(noise.map_or(ImageNoise::Unknown, ImageNoise::Level));
        let found = image.psf(psf.view())?.measure(stamp)?;
        if found.flags.contains(Flag::NotFinite) {
            let mut pixels = stamp.indexed_iter();
            let place = pixels.find(|(_, pixel)| !pixel.to_f32().is_finite());
            let (y, x) = place.map(|(at, _)| at).unwrap_or_default();
            return Err(MeasureError::NotFinite {
                what: "stamp",
                x: x + 1,
                y: y + 1,
            });
        }
        Ok(found)
    }
}

/// The noise of an image, as far as it is known.
#[derive(Debug, Clone, Copy, Default)]
pub enum ImageNoise<'a> {
    /// Level and correlation as measured on the stamps of the image, with the size of its galaxies.
    Survey(&'a Survey),
    /// White noise of this standard deviation per pixel.
    Level(f64),
    /// Nothing. A configuration that does not measure the noise on each stamp flags the galaxies.
    #[default]
    Unknown,
}

impl<'a> ImageNoise<'a> {
    fn survey(self) -> Option<&'a Survey> {
        match self {
            ImageNoise::Survey(survey) => Some(survey),
            ImageNoise::Level(_) | ImageNoise::Unknown => None,
        }
    }

    pub(crate) fn level(self) -> f64 {
        match self {
            ImageNoise::Survey(survey) => survey.noise.sigma(),
            ImageNoise::Level(level) => level,
            ImageNoise::Unknown => f64::NAN,
        }
    }
}

/// Buffers of one thread. Measuring a galaxy allocates nothing.
pub struct Worker {
    measurer: Measurer,
    method: Box<dyn CutWorker>,
    denoise: Option<DenoiseScratch>,
    /// Denoised in place.
    full: FullStamp,
    cut: Vec<f32>,
    border: Vec<f32>,
    missing: MissingPixels,
    defects: Defects,
    /// On the last stamp that was cut.
    found_defects: DefectCounts,
    /// Behind the present PSF.
    light: LightLimits,
    /// What turns ellipticities to the frame of the sky, if they are measured there.
    to_sky: Option<Spin2>,
    jacobian: Option<Jacobian>,
    /// The present PSF on its pixels.
    psf: PsfShape,
    /// Cut stamps of the usable epochs of a galaxy, and which epochs they are.
    epochs: Vec<f32>,
    used: Vec<usize>,
}

/// One of several stamps of a galaxy: an exposure, or a band.
#[derive(Debug, Clone, Copy)]
pub struct Epoch<'a, T> {
    /// The full stamp, of the size planned.
    pub stamp: ArrayView2<'a, T>,
    /// The PSF, as [`ImageWorker::psf`] takes it.
    pub psf: ArrayView2<'a, f64>,
    /// Standard deviation per pixel of the stamp's noise, which is taken as white; above 0.
    pub noise: f64,
    /// The map from pixels to the sky, for all epochs or for none. Pixels may differ in rotation, parity, shear and scale.
    pub jacobian: Option<Jacobian>,
    /// Offset (x, y) of the galaxy from the centre of the stamp in pixels.
    pub offset: [f64; 2],
    /// The survey of the epoch's image: its sky is subtracted, and the window follows its galaxies.
    pub survey: Option<&'a Survey>,
    /// Electrons per unit of the stamp, with which the galaxy's Poisson noise is part of the noise.
    pub gain: Option<f64>,
}

/// A worker for the galaxies of one image.
#[derive(Debug)]
pub struct ImageWorker<'a> {
    worker: &'a mut Worker,
    level: f64,
}

/// A worker for galaxies of one image and one PSF.
#[derive(Debug)]
pub struct PsfWorker<'a> {
    worker: &'a mut Worker,
    level: f64,
}

impl fmt::Debug for Worker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Worker")
            .field("measurer", &self.measurer)
            .finish_non_exhaustive()
    }
}

impl Worker {
    /// Prepares for the galaxies of an image with this noise.
    ///
    /// Noise of a survey is treated as white if its correlation is not significant. Without a survey, noise is white, and
    /// the window is the configuration's own. [`Session::image`](crate::Session::image) prepares for an image that was
    /// surveyed.
    pub fn image(&mut self, noise: ImageNoise<'_>) -> ImageWorker<'_> {
        self.image_with_stars(noise, None)
    }

    /// The same for an image whose noisy stars, one per galaxy, have a common profile.
    pub(crate) fn image_with_stars(
        &mut self,
        noise: ImageNoise<'_>,
        stars: Option<&Arc<ResidualProfiles>>,
    ) -> ImageWorker<'_> {
        let (white, survey) = (StampNoise::white(1.0), noise.survey());
        self.full.subtraction = self.measurer.subtraction(survey);
        let correlated = survey
            .map(|survey| &survey.noise)
            .filter(|noise| noise.is_correlated());
        let extent = survey.and_then(|survey| survey.mean_square_radius);
        let of_modes = correlated.unwrap_or(&white);
        self.method.set_image(of_modes, extent, stars);
        (self.to_sky, self.jacobian) = (None, None);
        self.method.set_pixel_shape(PixelShape::SQUARE);
        self.method.set_gain(None);
        ImageWorker {
            worker: self,
            level: noise.level(),
        }
    }

    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        self.method.set_psf(psf)?;
        self.psf = PsfShape::from_psf(psf);
        self.light = LightLimits::from_psf(psf);
        Ok(())
    }

    /// Measures a galaxy in noise of `level`, without calibration. Without a usable PSF it is flagged.
    fn measure_stamp<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
        level: f64,
        usable_psf: bool,
    ) -> Result<Measurement, MeasureError> {
        let mut measured = match self.cut(stamp, level, usable_psf)? {
            Err(flagged) => flagged,
            Ok(noise) => match self.method.measure_cut(&self.cut, noise)? {
                None => Measurement {
                    noise,
                    ..Measurement::flagged(Flag::NoScale)
                },
                Some(mut found) => {
                    if let Some(to_sky) = &self.to_sky {
                        found.turn(to_sky);
                    }
                    found.measurement(Saturation::of(self.measurer.configuration()), noise)
                }
            },
        };
        measured.defects = self.found_defects;
        if usable_psf {
            let psf = self.psf;
            measured.psf = self.jacobian.map_or(psf, |jacobian| psf.on_sky(&jacobian));
        }
        Ok(measured)
    }

    /// Cuts a stamp and prepares its pixels. Returns the level of its noise, or the measurement if it is flagged before its shape is
    /// measured.
    fn cut<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
        level: f64,
        usable_psf: bool,
    ) -> Result<Result<f64, Measurement>, MeasureError> {
        let plan = Arc::clone(&self.measurer.0);
        let n = plan.configuration.stamp.size;
        let linear = plan.configuration.linear().is_some();
        self.found_defects = DefectCounts::default();
        self.full.read(stamp)?;
        let mut whole = all_finite(&self.full.pixels);
        if linear {
            let screening = Screening::of(&self.full.pixels, plan.full);
            let pixels = &mut self.full.pixels;
            if screening.may_repeat() && mark_padding_missing(pixels, plan.full) {
                whole = false;
            }
            self.found_defects.repeated =
                self.defects.remove_repeated(pixels, plan.full, screening);
        }
        if !whole && !linear {
            return Ok(Err(Measurement::flagged(Flag::NotFinite)));
        }
        if !usable_psf {
            return Ok(Err(Measurement::flagged(Flag::BadPsf)));
        }
        if self.full.is_blank() {
            return Ok(Err(Measurement::flagged(Flag::NoScale)));
        }
        self.full.subtract_sky();
        let pixels = &mut self.full.pixels;
        let noise = match plan.configuration.noise {
            NoiseSource::Header | NoiseSource::Image { .. } => level,
            NoiseSource::Border { border } => {
                let found = border_noise(pixels, plan.full, border, &mut self.border);
                found.map_or(f64::NAN, f64::from)
            }
        };
        if let (Some(filter), Some(buffers)) = (&plan.denoise, &mut self.denoise) {
            filter.apply(pixels, noise as f32, buffers);
        }
        if linear {
            let (noise, found) = (noise as f32, &mut self.found_defects);
            self.defects
                .remove_unlit(pixels, plan.full, noise, &self.light, found);
            whole &= found.is_empty();
        }
        if n == plan.full {
            std::mem::swap(&mut self.cut, pixels);
        } else {
            let start = cut_start(plan.full, n).unwrap_or(0);
            for (y, row) in self.cut.chunks_exact_mut(n).enumerate() {
                let from = (start + y) * plan.full + start;
                row.copy_from_slice(&pixels[from..from + n]);
            }
        }
        if !whole && !self.missing.fill(&mut self.cut, n) {
            return Ok(Err(Measurement::flagged(Flag::NotFinite)));
        }
        if !PEAK_RANGE.contains(&highest(&self.cut)) || (noise.is_finite() && !is_level(noise)) {
            return Ok(Err(Measurement {
                noise,
                ..Measurement::flagged(Flag::NoScale)
            }));
        }
        Ok(Ok(noise))
    }

    /// Measures a galaxy on its epochs, whose input was checked. `stars` are the common profiles of the noisy stars of their
    /// images.
    fn measure_cuts<T: Pixel>(
        &mut self,
        epochs: &[Epoch<'_, T>],
        stars: &[Option<&Arc<ResidualProfiles>>],
    ) -> Result<Measurement, MeasureError> {
        let (mut flagged, mut defects) = (None, DefectCounts::default());
        self.epochs.clear();
        self.used.clear();
        for (k, epoch) in epochs.iter().enumerate() {
            self.full.subtraction = self.measurer.subtraction(epoch.survey);
            self.light = LightLimits::from_psf(epoch.psf);
            let cut = self.cut(epoch.stamp, epoch.noise, true)?;
            defects += self.found_defects;
            match cut {
                Ok(_) => {
                    self.epochs.extend_from_slice(&self.cut);
                    self.used.push(k);
                }
                Err(found) => flagged = flagged.or(Some(found)),
            }
        }
        let (Some(&first), size) = (self.used.first(), self.cut.len()) else {
            let flagged = flagged.unwrap_or(Measurement::flagged(Flag::NoScale));
            return Ok(Measurement { defects, ..flagged });
        };
        let frame = epochs[first].jacobian.map(|jacobian| {
            let (orientation, _) = jacobian.factors();
            (orientation, jacobian.pixel_scale())
        });
        let (cuts, used) = (&self.epochs, &self.used);
        let epoch = |at: usize| {
            let epoch = &epochs[used[at]];
            let matrix = match (&frame, &epoch.jacobian) {
                (Some((orientation, scale)), Some(jacobian)) => {
                    // The transpose of an orthogonal matrix is its inverse.
                    let ([[a, b], [c, d]], [u, v]) = (orientation.matrix(), jacobian.matrix());
                    [[a, c], [b, d]].map(|[of_u, of_v]| {
                        [0, 1].map(|axis| (of_u * u[axis] + of_v * v[axis]) / scale)
                    })
                }
                _ => [[1.0, 0.0], [0.0, 1.0]],
            };
            CutEpoch {
                cut: &cuts[at * size..][..size],
                psf: epoch.psf,
                noise: epoch.noise,
                pixels: EpochPixels::new(matrix),
                offset: epoch.offset,
                galaxy_variance: epoch.survey.and_then(|survey| survey.mean_square_radius),
                gain: epoch.gain,
                stars: stars.get(used[at]).copied().flatten(),
            }
        };
        let (mut found, noise) = self.method.measure_combined(used.len(), &epoch)?;
        if let Some((orientation, _)) = &frame {
            found.turn(&orientation.spin2());
        }
        let mut measured = found.measurement(Saturation::of(self.measurer.configuration()), noise);
        let scale = epochs[first]
            .jacobian
            .map_or(1.0, |jacobian| jacobian.pixel_scale());
        let psfs = self.used.iter().map(|&k| {
            let (epoch, psf) = (&epochs[k], PsfShape::from_psf(epochs[k].psf));
            let (psf, area) = match &epoch.jacobian {
                Some(jacobian) => (
                    psf.on_sky(jacobian),
                    (jacobian.pixel_scale() / scale).powi(2),
                ),
                None => (psf, 1.0),
            };
            (psf, area, area / (epoch.noise * epoch.noise))
        });
        measured.psf = PsfShape::mean(psfs);
        measured.defects = defects;
        Ok(measured)
    }
}

impl ImageWorker<'_> {
    /// Prepares for galaxies with this PSF: centred, of sum one, and with the pixels that
    /// [`Star::cut`](crate::Star::cut) cuts for [`Configuration::psf_cut`].
    ///
    /// # Errors
    /// If the PSF has another size, or a pixel that is not finite.
    pub fn psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<PsfWorker<'_>, MeasureError> {
        self.worker.set_psf(psf)?;
        Ok(PsfWorker {
            worker: self.worker,
            level: self.level,
        })
    }

    /// Sets the electrons per unit of the stamps, with which the Poisson noise of the galaxies is part of their noise. Networks
    /// ignore it.
    pub fn set_gain(&mut self, gain: Option<f64>) {
        self.worker.method.set_gain(gain);
    }

    /// Sets the Jacobian of the galaxies and PSFs that follow, which are measured in the frame of the sky; with `None`, as
    /// for a new image, in the frame of the pixels.
    ///
    /// # Errors
    /// If pixels are sheared more than the method can use.
    pub fn set_jacobian(&mut self, jacobian: Option<&Jacobian>) -> Result<(), MeasureError> {
        let (to_sky, shape) = match jacobian {
            Some(jacobian) => {
                let (orientation, shape) = jacobian.factors();
                (Some(orientation.spin2()), shape)
            }
            None => (None, PixelShape::SQUARE),
        };
        self.check_shape(shape)?;
        self.worker.to_sky = to_sky;
        self.worker.jacobian = jacobian.copied();
        self.worker.method.set_pixel_shape(shape);
        Ok(())
    }

    fn check_shape(&self, shape: PixelShape) -> Result<(), MeasureError> {
        let most = match self.worker.measurer.configuration().linear() {
            Some(_) => MAX_PIXEL_SHEAR,
            None => MAX_NETWORK_PIXEL_SHEAR,
        };
        let shear = shape.shear();
        if shear > most {
            return Err(MeasureError::ShearedPixels { shear, most });
        }
        Ok(())
    }

    /// Measures one galaxy on several stamps, without calibration.
    ///
    /// Deconvolved stamps are combined in each Fourier mode with inverse-variance weights, the squares of the epochs' signal over
    /// noise there, and the shape is measured once. It is as noisy as on one stamp of the summed S/N², and responds like the
    /// combined image, whereas a mean of the epochs' ellipticities would divide by noisy responses. `noise` of the
    /// measurement is the noise of the combination, per pixel of the first usable epoch; lengths are in its pixels. Shapes are in
    /// the frame of the sky if there are Jacobians.
    ///
    /// An epoch without usable pixels has no weight, and without usable epochs the galaxy is flagged. The window of each epoch
    /// is at its offset, and all light under it is measured. Stamps should have one flux: for several bands, the shape is measured on
    /// the weighted sum of the images. One epoch without survey and gain, with the galaxy in the centre of its stamp, is measured
    /// as by [`PsfWorker::measure`], with the same bits and the survey of the image of this worker. Otherwise the noise of epochs
    /// is treated as white. The PSF of a [`PsfWorker`] has to be set again after it.
    ///
    /// # Errors
    /// An [`EpochError`] if there are no epochs, a noise level is not above 0, an offset is beyond a quarter of the stamp, some
    /// have Jacobians and others none, or the configuration is not linear. Also if sizes do not fit, pixels of a PSF are
    /// not finite, or pixels are sheared too much.
    pub fn measure_epochs<T: Pixel>(
        &mut self,
        epochs: &[Epoch<'_, T>],
    ) -> Result<Measurement, MeasureError> {
        self.measure_epochs_with_stars(epochs, &[])
    }

    /// The same for epochs of images whose noisy stars, one per galaxy, have common profiles: one entry per epoch, or none.
    pub(crate) fn measure_epochs_with_stars<T: Pixel>(
        &mut self,
        epochs: &[Epoch<'_, T>],
        stars: &[Option<&Arc<ResidualProfiles>>],
    ) -> Result<Measurement, MeasureError> {
        if self.worker.measurer.configuration().linear().is_none() {
            return Err(EpochError::Network.into());
        }
        let one = epochs.first().ok_or(EpochError::None)?;
        let most = self.worker.measurer.max_epoch_offset();
        for (k, found) in epochs.iter().enumerate() {
            let (noise, [x, y]) = (found.noise, found.offset);
            if !(noise > 0.0 && noise.is_finite()) {
                return Err(EpochError::Noise { epoch: k, noise }.into());
            }
            // Not a number fails, too.
            if !(x.abs() <= most && y.abs() <= most) {
                return Err(EpochError::Offset {
                    epoch: k,
                    x,
                    y,
                    most,
                }
                .into());
            }
            if found.jacobian.is_some() != one.jacobian.is_some() {
                return Err(EpochError::Frames.into());
            }
            if let Some(jacobian) = &found.jacobian {
                self.check_shape(jacobian.factors().1)?;
            }
        }
        // What is known of an epoch's image would have to replace what is known of this worker's: all galaxies of a set with
        // such epochs are measured in one way, also those with a single usable epoch.
        let has_stars = stars.iter().any(Option::is_some);
        let of_image = one.survey.is_some() || one.gain.is_some() || has_stars;
        if epochs.len() == 1 && one.offset == [0.0; 2] && !of_image {
            self.set_jacobian(one.jacobian.as_ref())?;
            self.worker.set_psf(one.psf)?;
            return self.worker.measure_stamp(one.stamp, one.noise, true);
        }
        self.worker.measure_cuts(epochs, stars)
    }

    /// Measures stamps, one per galaxy along the first axis, without calibration, in the noise of the image, or in white noise
    /// with one level per stamp. Jacobians are one per stamp. With PSFs per galaxy, a galaxy with an unusable PSF is flagged.
    pub(crate) fn measure_stamps<T: Pixel>(
        &mut self,
        stamps: ArrayView3<'_, T>,
        psfs: &Psfs<'_>,
        levels: Option<&[f64]>,
        jacobians: Option<&[Jacobian]>,
    ) -> Result<Vec<Measurement>, MeasureError> {
        let cut = self.worker.measurer.configuration().psf_cut();
        let (count, full, _) = stamps.dim();
        let given = psfs.count();
        if let Some(given) = given.filter(|given| *given != count) {
            return Err(MeasureError::Shape {
                what: "PSFs",
                found: format!("{given} galaxies"),
                expected: format!("{count}, one each"),
            });
        }
        let shared = match given {
            Some(_) => None,
            None => Some(psfs.at(0, cut, full)?.psf),
        };
        let mut last = None;
        let stamps = stamps.outer_iter().enumerate();
        let measured = stamps.map(|(k, stamp)| {
            let jacobian = jacobians.map(|each| &each[k]);
            // The transform of a shared PSF holds for one Jacobian; in most images all galaxies have the same.
            let new = last != Some(jacobian);
            if new {
                self.set_jacobian(jacobian)?;
                last = Some(jacobian);
            }
            let usable_psf = match &shared {
                Some(psf) => {
                    match (k, new) {
                        (0, _) => self.worker.set_psf(psf.view())?,
                        (_, true) => self.worker.method.retake_psf(),
                        (_, false) => {}
                    }
                    true
                }
                None => {
                    let psf = psfs
                        .at(k, cut, full)
                        .and_then(|Star { psf, .. }| self.worker.set_psf(psf.view()));
                    psf.is_ok()
                }
            };
            let level = levels.map_or(self.level, |levels| levels[k]);
            self.worker.measure_stamp(stamp, level, usable_psf)
        });
        measured.collect()
    }
}

impl PsfWorker<'_> {
    /// The settings that were adapted to the PSF, and to the galaxies of a survey. `None` for the network, which adapts
    /// nothing.
    pub fn adapted(&self) -> Option<AdaptedSettings> {
        self.worker.method.adapted()
    }

    /// Measures a galaxy on its full stamp, without calibration, in the noise of the image.
    ///
    /// # Errors
    /// If the stamp has another size than planned.
    pub fn measure<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
    ) -> Result<Measurement, MeasureError> {
        self.worker.measure_stamp(stamp, self.level, true)
    }

    /// Measures a galaxy behind `psf`, the PSF of this worker, with the steps of the method unless it did not run.
    pub(crate) fn measure_with_steps<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
        psf: Array2<f64>,
    ) -> Result<(Measurement, Option<Steps>), MeasureError> {
        let measured = self.measure(stamp)?;
        if measured.descent.is_none() {
            return Ok((measured, None));
        }
        let n = self.worker.measurer.configuration().stamp.size;
        let start = cut_start(stamp.nrows(), n).unwrap_or(0);
        let (full, side) = (&mut self.worker.full, stamp.nrows());
        full.read(stamp)?;
        full.subtract_sky();
        let data = Array2::from_shape_fn((n, n), |(y, x)| {
            f64::from(full.pixels[(start + y) * side + start + x])
        });
        let pixel = |(y, x)| f64::from(stamp[(start + y, start + x)].to_f32());
        let stamp = Array2::from_shape_fn((n, n), pixel);
        let Images {
            deconvolved,
            acf,
            weight,
            spacing,
        } = self.worker.method.images(&self.worker.cut, psf.view());
        let reconvolved = convolve(deconvolved.view(), psf.view());
        let middle = (acf.nrows() / 2) as f64;
        let used = Array2::from_shape_fn(acf.dim(), |at| {
            let (dy, dx) = (at.0 as f64 - middle, at.1 as f64 - middle);
            if dy.hypot(dx) * spacing <= measured.radius {
                acf[at] * weight.as_ref().map_or(1.0, |weight| weight[at])
            } else {
                f64::NAN
            }
        });
        let steps = Steps {
            residual: data - reconvolved,
            stamp,
            psf,
            deconvolved,
            acf,
            used,
        };
        Ok((measured, Some(steps)))
    }
}

/// The steps of one measurement as images.
#[derive(Clone)]
pub struct Steps {
    /// The stamp as cut from the data, before any denoising.
    pub stamp: Array2<f64>,
    /// The PSF that was deconvolved.
    pub psf: Array2<f64>,
    /// The deconvolved stamp.
    pub deconvolved: Array2<f64>,
    /// Data without their sky minus the deconvolved stamp convolved with the PSF.
    pub residual: Array2<f64>,
    /// Autocorrelation, zero lag in the middle: all lags for the network, lags within the weight for the linear method.
    pub acf: Array2<f64>,
    /// The same times the weight of the moments, if the method has one; NaN beyond the radius of the moments.
    pub used: Array2<f64>,
}

impl std::fmt::Debug for Steps {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Steps").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::sky::Sky;

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
    fn a_neighbour_counts_as_light_of_the_galaxy() {
        let named = Measurer::named("48/linear/star", N).unwrap();
        let psf = gaussian(32, 2.0, 2.0);
        let psf = &psf / psf.sum();
        let galaxy = gaussian(N, 8.0, 8.0) * 100.0;
        // The same galaxy once more, 8 px to the left.
        let pair = Array2::from_shape_fn((N, N), |(y, x)| {
            galaxy[(y, x)] + galaxy.get((y, x + 8)).unwrap_or(&0.0)
        });
        let mut worker = named.worker();
        let mut image = worker.image(ImageNoise::Level(0.1));
        let mut worker = image.psf(psf.view()).unwrap();
        let found = worker.measure(pair.view()).unwrap();
        assert!(found.flags.is_empty() && found.e1 > 0.2, "{found:?}");
    }

    #[test]
    fn a_single_epoch_counts_its_survey_and_gain_anywhere() {
        let measurer = Measurer::named("48/linear/star", N).unwrap();
        let psf = gaussian(32, 2.0, 2.1);
        let psf = &psf / psf.sum();
        let sky = Sky {
            level: 0.5,
            level_error: 0.01,
            slope: [0.02, 0.0],
            slope_error: 0.001,
        };
        let survey = Survey {
            noise: StampNoise::white(0.5),
            // Narrower galaxies than the configuration's.
            mean_square_radius: Some(6.0),
            sky: Some(sky),
        };
        let middle = (N as f64 - 1.0) / 2.0;
        let plane = |(y, x)| sky.at(x as f64 - middle, y as f64 - middle);
        let stamp = gaussian(N, 6.0, 5.0) * 300.0 + Array2::from_shape_fn((N, N), plane);
        let mut worker = measurer.worker();
        let mut image = worker.image(ImageNoise::Survey(&survey));
        image.set_gain(Some(0.5));
        let mut behind_psf = image.psf(psf.view()).unwrap();
        let expected = behind_psf.measure(stamp.view()).unwrap();
        let numbers = |found: &Measurement| {
            let observables = found.observables.unwrap();
            let [r11, r22] = found.response_diagonal();
            let flux = found.flux / 300.0;
            [found.e1, r11, r22, flux, found.size, observables.flux_error]
        };
        for x in [0.0, 1e-9] {
            let epoch = Epoch {
                stamp: stamp.view(),
                psf: psf.view(),
                noise: 0.5,
                jacobian: None,
                offset: [x, 0.0],
                survey: Some(&survey),
                gain: Some(0.5),
            };
            let mut image = worker.image(ImageNoise::Unknown);
            let found = image.measure_epochs(&[epoch]).unwrap();
            for (found, expected) in numbers(&found).iter().zip(numbers(&expected)) {
                assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
            }
        }
    }

    #[test]
    fn noise_of_an_elliptical_psf_leaves_round_galaxies_round() {
        // Covariances in px²: a PSF of |e| = 0.05, along x and along y, and a small galaxy.
        let (long, short, own) = (2.31, 1.89, 3.0);
        let e = (long - short) / (long + short) / 2.0;
        let measurer = Measurer::named("48/linear/star", N).unwrap();
        let sides = [(long, short), (short, long)].map(|(xx, yy)| {
            let psf = gaussian(32, xx, yy);
            let psf = &psf / psf.sum();
            let galaxy = gaussian(N, own + xx, own + yy);
            let strength = galaxy.iter().map(|v| v * v).sum::<f64>().sqrt();
            // S/N 10.
            (psf, galaxy * (10.0 / strength))
        });
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let half = 3f64.sqrt();
        let [first, second] = sides;
        let mut worker = measurer.worker();
        let mut leaks = Vec::new();
        let mut response = 0.0;
        for _ in 0..3000 {
            let noise = Array2::from_shape_fn((N, N), |_| rng.random_range(-half..half));
            let mut mean = |(psf, galaxy): &(Array2<f64>, Array2<f64>)| {
                let mut image = worker.image(ImageNoise::Level(1.0));
                let mut worker = image.psf(psf.view()).unwrap();
                // Noise of both signs leaves the even part of its effect.
                let [a, b] = [1.0, -1.0].map(|sign| {
                    let stamp = &*galaxy + &(&noise * sign);
                    worker.measure(stamp.view()).unwrap()
                });
                response += 0.25 * (a.response_diagonal()[0] + b.response_diagonal()[0]);
                0.5 * (a.e1 + b.e1)
            };
            leaks.push(0.5 * (mean(&first) - mean(&second)));
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

    #[test]
    fn pixels_sheared_beyond_a_limit_are_refused() {
        for (configuration, limit) in [("48/linear/star", 0.2), ("23/raw/star", 1e-3)] {
            let measurer = Measurer::named(configuration, N).unwrap();
            let mut worker = measurer.worker();
            let mut image = worker.image(ImageNoise::Level(1.0));
            let mut is_measured = |shear: f64| {
                let matrix = [[1.0 + shear, 0.0], [0.0, 1.0 - shear]];
                image
                    .set_jacobian(Some(&Jacobian::new(matrix).unwrap()))
                    .is_ok()
            };
            assert!(
                is_measured(0.9 * limit) && !is_measured(1.1 * limit),
                "{limit}"
            );
        }
    }
}
