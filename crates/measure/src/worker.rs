//! Measuring galaxies in one thread: an image, its PSFs, its galaxies.
//!
//! The types fix the order. A [`Worker`] becomes an [`ImageWorker`] for an image, whose noise is known. That becomes a
//! [`PsfWorker`] for a PSF, and only this measures galaxies.

use std::fmt;
use std::sync::Arc;

use ndarray::{ArrayView2, ArrayView3};
use shearq_submissions::{Configuration, Method, NoiseSource};

use crate::brightness::{PEAKS, all_finite, highest, is_level};
use crate::denoise::{DenoiseScratch, border_noise};
use crate::ellipticity::{observables, report, sheared_versions};
use crate::error::MeasureError;
use crate::flag::{Flag, Flags};
use crate::measurement::Measurement;
use crate::method::{AdaptedSettings, CutWorker};
use crate::noise::{StampNoise, Survey};
use crate::pixel::{self, Pixel};
use crate::plan::Plan;
use crate::psf::{CommonProfile, cut_start};
use crate::psfs::Psfs;
use crate::sky::{Cells, Subtraction};
use crate::surroundings::Missing;

/// What is known about the noise of an image.
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

    fn level(self) -> f64 {
        match self {
            ImageNoise::Survey(survey) => survey.noise.sigma(),
            ImageNoise::Level(level) => level,
            ImageNoise::Unknown => f64::NAN,
        }
    }
}

/// Buffers of one thread. Measuring a galaxy allocates nothing.
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
    cells: Cells,
    subtraction: Subtraction,
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
    pub(crate) worker: &'a mut Worker,
    level: f64,
}

impl fmt::Debug for Worker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Worker")
            .field("configuration", &self.plan.configuration.name)
            .field("full", &self.plan.full)
            .field("subtraction", &self.subtraction)
            .finish_non_exhaustive()
    }
}

impl Worker {
    pub(crate) fn new(plan: Arc<Plan>) -> Self {
        let Plan { full, n, .. } = *plan;
        Worker {
            method: plan.method.worker(),
            denoise: plan.denoise.as_ref().map(|denoise| denoise.scratch()),
            full: vec![0.0; full * full],
            cut: vec![0.0; n * n],
            border: Vec::with_capacity(full * full),
            missing: Missing::new(n),
            cells: Cells::new(full),
            subtraction: Subtraction::Nothing,
            plan,
        }
    }

    /// The configuration.
    pub fn configuration(&self) -> &Configuration {
        &self.plan.configuration
    }

    /// Prepares for the galaxies of an image with this noise.
    ///
    /// Noise of a survey is treated as white if its correlation is not significant. Without a survey, noise is white, and
    /// the window is the configuration's own. [`Session::image`](crate::Session::image) prepares for an image that was
    /// surveyed.
    pub fn image(&mut self, noise: ImageNoise<'_>) -> ImageWorker<'_> {
        self.image_with_stars(noise, None)
    }

    /// The same for an image whose noisy stars, one per galaxy, have this in common.
    pub(crate) fn image_with_stars(
        &mut self,
        noise: ImageNoise<'_>,
        stars: Option<&Arc<CommonProfile>>,
    ) -> ImageWorker<'_> {
        let (white, survey) = (StampNoise::white(1.0), noise.survey());
        self.subtraction = self.plan.subtraction(survey);
        let correlated = survey
            .map(|survey| &survey.noise)
            .filter(|noise| noise.is_correlated());
        let extent = survey.and_then(|survey| survey.extent);
        let of_modes = correlated.unwrap_or(&white);
        self.method.set_image(of_modes, extent, stars);
        ImageWorker {
            worker: self,
            level: noise.level(),
        }
    }

    /// Measures a galaxy in noise of `level`, without calibration. Without a usable PSF it is flagged.
    fn measure<T: Pixel>(
        &mut self,
        stamp: ArrayView2<'_, T>,
        level: f64,
        usable_psf: bool,
    ) -> Result<Measurement, MeasureError> {
        let plan = Arc::clone(&self.plan);
        let n = plan.n;
        let linear = matches!(plan.configuration.method, Method::Linear(_));
        let mut whole = self.read(stamp)?;
        if linear && pixel::lose_padding(&mut self.full, plan.full) {
            whole = false;
        }
        if !whole && !linear {
            return Ok(Measurement::flagged(Flag::NotFinite));
        }
        if !usable_psf {
            return Ok(Measurement::flagged(Flag::BadPsf));
        }
        if self.full.iter().all(|v| *v == self.full[0]) {
            return Ok(Measurement::flagged(Flag::NoScale));
        }
        if self.subtraction != Subtraction::Nothing {
            self.subtraction.apply(&mut self.full, &mut self.cells);
        }
        let noise = match plan.configuration.noise {
            NoiseSource::Header | NoiseSource::Image { .. } => level,
            NoiseSource::Border { border } => {
                let found = border_noise(&self.full, plan.full, border, &mut self.border);
                found.map_or(f64::NAN, f64::from)
            }
        };
        if let (Some(filter), Some(buffers)) = (&plan.denoise, &mut self.denoise) {
            filter.apply(&mut self.full, noise as f32, buffers);
        }
        if n == plan.full {
            std::mem::swap(&mut self.cut, &mut self.full);
        } else {
            let start = cut_start(plan.full, n).unwrap_or(0);
            for (y, row) in self.cut.chunks_exact_mut(n).enumerate() {
                let from = (start + y) * plan.full + start;
                row.copy_from_slice(&self.full[from..from + n]);
            }
        }
        if !whole && !self.missing.mend(&mut self.cut, n) {
            return Ok(Measurement::flagged(Flag::NotFinite));
        }
        let no_scale = Measurement {
            noise,
            ..Measurement::flagged(Flag::NoScale)
        };
        if !PEAKS.contains(&highest(&self.cut)) || (noise.is_finite() && !is_level(noise)) {
            return Ok(no_scale);
        }
        let Some(found) = self.method.measure(&self.cut, noise)? else {
            return Ok(no_scale);
        };
        let measured = Measurement {
            descent: Some(found.descent),
            noise,
            flux: found.flux,
            radius: found.radius,
            size: found.size,
            ..Measurement::flagged(Flag::NoShear)
        };
        let kind = plan.configuration.ellipticity();
        let observables = found.distortion.ok().and_then(|chi| {
            let observed = found.observed.as_ref()?;
            Some(observables(
                kind,
                chi,
                observed,
                found.sheared_noise.as_ref(),
            ))
        });
        Ok(match report(kind, &found) {
            Err(flag) => Measurement {
                flags: flag.into(),
                ..measured
            },
            Ok((e1, e2, response)) => Measurement {
                e1,
                e2,
                flags: Flags::NONE,
                response,
                observables,
                versions: observables
                    .zip(response)
                    .and_then(|(observables, response)| {
                        sheared_versions(kind, &found, ([e1, e2], response), &observables)
                    }),
                ..measured
            },
        })
    }

    /// Copies a full stamp; whether all of its pixels are finite.
    fn read<T: Pixel>(&mut self, stamp: ArrayView2<'_, T>) -> Result<bool, MeasureError> {
        let full = self.plan.full;
        if stamp.dim() != (full, full) {
            let expected = format!("{full} × {full}");
            return Err(MeasureError::square("a stamp", stamp.dim(), expected));
        }
        pixel::copy(stamp, &mut self.full);
        Ok(all_finite(&self.full))
    }
}

impl ImageWorker<'_> {
    /// The configuration.
    pub fn configuration(&self) -> &Configuration {
        self.worker.configuration()
    }

    /// Prepares for galaxies with this PSF: centred, of sum one, and with the pixels that
    /// [`star_psf`](crate::star_psf) cuts for [`Configuration::psf_cut`].
    ///
    /// # Errors
    /// If the PSF has another size, or a pixel that is not finite.
    pub fn psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<PsfWorker<'_>, MeasureError> {
        self.worker.method.set_psf(psf)?;
        Ok(PsfWorker {
            worker: self.worker,
            level: self.level,
        })
    }

    /// Measures stamps, one per galaxy along the first axis, without calibration, in the noise of the image.
    ///
    /// # Errors
    /// If sizes or numbers do not fit, or a PSF for all galaxies cannot be used. A galaxy whose own PSF cannot be used is
    /// flagged.
    pub fn measure_each<T: Pixel>(
        &mut self,
        stamps: ArrayView3<'_, T>,
        psfs: &Psfs<'_>,
    ) -> Result<Vec<Measurement>, MeasureError> {
        self.measure_in_noise(stamps, psfs, None)
    }

    /// The same for white noise with one level per stamp, if there are any.
    pub(crate) fn measure_in_noise<T: Pixel>(
        &mut self,
        stamps: ArrayView3<'_, T>,
        psfs: &Psfs<'_>,
        levels: Option<&[f64]>,
    ) -> Result<Vec<Measurement>, MeasureError> {
        let cut = self.configuration().psf_cut();
        let (count, full, _) = stamps.dim();
        let given = psfs.count();
        match given {
            Some(given) if given != count => {
                return Err(MeasureError::Shape {
                    what: "PSFs",
                    found: format!("{given} galaxies"),
                    expected: format!("{count}, one each"),
                });
            }
            Some(_) => {}
            None => self
                .worker
                .method
                .set_psf(psfs.at(0, cut, full)?.psf.view())?,
        }
        let stamps = stamps.outer_iter().enumerate();
        let measured = stamps.map(|(k, stamp)| {
            let mut set = || {
                let psf = psfs.at(k, cut, full)?;
                self.worker.method.set_psf(psf.psf.view())
            };
            let usable_psf = given.is_none() || set().is_ok();
            let level = levels.map_or(self.level, |levels| levels[k]);
            self.worker.measure(stamp, level, usable_psf)
        });
        measured.collect()
    }
}

impl PsfWorker<'_> {
    /// The configuration.
    pub fn configuration(&self) -> &Configuration {
        self.worker.configuration()
    }

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
        self.worker.measure(stamp, self.level, true)
    }
}
