//! The measurement of one image, from its stamps and PSFs to calibrated rows and warnings.
//!
//! A [`Session`] is opened on a [`StampSource`]. Opening surveys the image: the noise and the sky of its stamps, and what
//! noisy stars have in common. Rows are then read, measured in any thread, and collected in order by a
//! [`MeasuredImage`], which calibrates them and says what is wrong with the image. Files, simulations, [`Measurer::batch`]
//! and Python all take this one way: while each of them had its own, they differed in what they surveyed and reported.

mod arrays;
mod source;
mod survey;

use std::sync::Arc;

use ndarray::{ArrayView3, Axis, Ix3};
use shearq_quantities::statistics::upper_median;
use shearq_submissions::{Configuration, NoiseSource};

pub use self::arrays::ArraySource;
pub use self::source::{Lazy, LazyStamps, OneThread, StampRows, StampSource, Threads};
use crate::brightness::is_level;
use crate::calibrate::calibrate;
use crate::error::{MeasureError, length};
use crate::examine::{EXAMINED_PSFS, Examination, enough, examined_rows};
use crate::galaxy::Measurer;
use crate::measurement::Measurement;
use crate::noise::{NoisePlan, StampNoise, Survey};
use crate::pixel::{Pixel, Pixels};
use crate::psf::CommonProfile;
use crate::psfs::Psfs;
use crate::warning::Warning;
use crate::worker::{ImageNoise, ImageWorker, Worker};

/// Largest distance along each axis at which white noise is tested for correlation, in pixels.
const CORRELATION_REACH: usize = 2;
/// Least relative difference between stated and measured noise that is reported.
const LEAST_NOISE_DIFFERENCE: f64 = 0.01;
/// The same in units of its standard error.
const NOISE_SIGNIFICANCE: f64 = 5.0;
/// Effect on m below which the noise of a star is not stated: a star that was rounded to single precision has that much.
const LEAST_PSF_NOISE: f64 = 1e-5;

/// What is known about the noise of an image before it is measured.
#[derive(Debug, Clone, Copy, Default)]
pub enum KnownNoise<'n> {
    /// Nothing.
    #[default]
    Unknown,
    /// A level that the data state. A configuration that measures the noise on the stamps reports a difference.
    Stated(f64),
    /// The level of white noise that the caller gives, which replaces the measurement on the stamps.
    Given(f64),
    /// The same, one level per stamp.
    GivenEach(&'n [f64]),
}

/// One image between its survey and its last row. Threads share it.
#[derive(Debug)]
pub struct Session<'n> {
    measurer: Measurer,
    rows: StampRows,
    noise: KnownNoise<'n>,
    survey: Option<Arc<Survey>>,
    stars: Option<Arc<CommonProfile>>,
    examined: Vec<usize>,
    /// Median of the positive levels of the examined stamps, if each stamp has its own.
    typical_level: Option<f64>,
    warnings: Vec<Warning>,
}

/// A row of stamps that was read, for the thread that measures it.
#[derive(Debug)]
pub struct RowJob<'n> {
    session: Arc<Session<'n>>,
    row: usize,
    stamps: LazyStamps<'n>,
    psfs: Lazy<'n, Psfs<'n>>,
}

/// The galaxies of a row before calibration.
#[derive(Debug)]
pub struct MeasuredRow {
    row: usize,
    /// One per stamp.
    pub galaxies: Vec<Measurement>,
    examined: Option<Examined>,
}

/// Examinations of stamps: as they are and, if each has a noise level of its own, in units of these levels.
#[derive(Debug)]
struct Examined {
    stamps: Examination,
    scaled: Option<Examination>,
}

/// Rows of an image as they come from the threads.
#[derive(Debug)]
pub struct MeasuredImage<'n> {
    session: Arc<Session<'n>>,
    galaxies: Vec<Measurement>,
    next: usize,
    examined: Option<Examined>,
}

/// The galaxies of an image, measured and calibrated.
#[derive(Debug, Clone, Default)]
pub struct Batch {
    /// One per stamp. Ellipticities are calibrated; responses are the galaxies' own.
    pub galaxies: Vec<Measurement>,
    /// The mean response of e1 to γ1 and of e2 to γ2 that ellipticities were divided by; `None` if the configuration
    /// asks for no calibration, or (then all galaxies are flagged) if it is not positive.
    pub response: Option<[f64; 2]>,
    /// What is wrong with the stamps and PSFs.
    pub warnings: Vec<Warning>,
    /// Standard deviations of m and c of the image by the noise of the star that all of its galaxies share. `None` if
    /// each galaxy has its own PSF, the configuration is not linear, or the effect is negligible.
    pub psf_noise: Option<[f64; 2]>,
}

impl Batch {
    /// The batch, unless a warning says that no result should be made from such data.
    ///
    /// # Errors
    /// That warning.
    pub fn checked(mut self) -> Result<Batch, MeasureError> {
        match self.warnings.iter().position(Warning::is_fatal) {
            Some(fatal) => Err(MeasureError::Data(self.warnings.swap_remove(fatal))),
            None => Ok(self),
        }
    }

    /// The warning with the most frequent flag, if there are galaxies and all are flagged.
    pub fn all_flagged(&self) -> Option<&Warning> {
        let all = |warning: &&Warning| matches!(warning, Warning::Flagged { count, of, .. } if count == of);
        self.warnings.iter().find(all)
    }
}

impl<'n> Session<'n> {
    /// Opens an image: surveys its stars and, unless its noise is given, its stamps.
    ///
    /// If all stamps have too many missing pixels for a survey, the galaxies will be flagged: a stated level does not
    /// replace the measurement, because without a survey the window has another width and results another bias.
    ///
    /// # Errors
    /// If stamps or stars cannot be read, the stamps have no border of noise, or a level that is needed is absent or not
    /// a finite number of zero or more.
    pub fn open<S: StampSource<'n>>(
        measurer: &Measurer,
        source: &mut S,
        noise: KnownNoise<'n>,
        threads: &impl Threads,
    ) -> Result<Self, S::Error> {
        let rows = source.rows();
        check(measurer.configuration(), noise, rows.count)?;
        let examined = match rows.count {
            0 => Vec::new(),
            _ => examined_rows(rows.columns, rows.len()),
        };
        let of_settings = Warning::of_settings(measurer.configuration());
        let warnings = of_settings.into_iter().chain(source.warnings()).collect();
        let stars = survey::stars(measurer, source, &examined, threads)?;
        let mut session = Session {
            measurer: measurer.clone(),
            rows,
            noise,
            survey: None,
            stars,
            examined,
            typical_level: None,
            warnings,
        };
        if let KnownNoise::GivenEach(levels) = noise {
            let examined = session.examined.iter().flat_map(|&row| rows.stamps(row));
            let mut levels: Vec<f64> = examined.map(|at| levels[at]).collect();
            levels.retain(|level| *level > 0.0);
            session.typical_level = upper_median(&mut levels);
        }
        if let Some(plan) = session.surveyed() {
            session.survey = survey::noise(plan, source, threads)?;
            let found = session.survey.as_ref();
            let warning = found.map_or(Some(Warning::NoNoise), |survey| {
                differing(noise, &survey.noise)
            });
            session.warnings.extend(warning);
        }
        Ok(session)
    }

    /// The plan by which the noise is measured on the stamps, if it is.
    fn surveyed(&self) -> Option<&NoisePlan> {
        let plan = self.measurer.noise_plan().filter(|_| self.rows.count > 0);
        match self.noise {
            KnownNoise::Unknown | KnownNoise::Stated(_) => plan,
            KnownNoise::Given(_) | KnownNoise::GivenEach(_) => None,
        }
    }

    /// The rows of the image.
    pub fn rows(&self) -> StampRows {
        self.rows
    }

    /// Prepares a worker for galaxies of this image.
    pub fn image<'w>(&self, worker: &'w mut Worker) -> ImageWorker<'w> {
        let noise = match (&self.survey, self.noise) {
            (Some(survey), _) => ImageNoise::Survey(survey),
            (None, KnownNoise::Given(level)) => ImageNoise::Level(level),
            (None, KnownNoise::Stated(level)) if self.surveyed().is_none() => {
                ImageNoise::Level(level)
            }
            (None, _) => ImageNoise::Unknown,
        };
        worker.image_with_stars(noise, self.stars.as_ref())
    }

    /// A warning if the configuration treats noise as white that is correlated. It takes a second survey, so that a run
    /// tests one of its images.
    ///
    /// # Errors
    /// If stamps cannot be read.
    pub fn correlated_noise<S: StampSource<'n>>(
        &self,
        source: &mut S,
        threads: &impl Threads,
    ) -> Result<Option<Warning>, S::Error> {
        let configuration = self.measurer.configuration();
        let white = match configuration.noise {
            NoiseSource::Image { correlation, .. } => correlation == 0,
            NoiseSource::Header | NoiseSource::Border { .. } => true,
        };
        let blind = self.surveyed().is_some() && self.survey.is_none();
        if configuration.linear().is_none() || !white || blind {
            return Ok(None);
        }
        // Small stamps have no border that could be surveyed.
        let found = NoisePlan::new(self.measurer.full(), CORRELATION_REACH)
            .map_err(S::Error::from)
            .and_then(|plan| survey::noise(&plan, source, threads));
        let found = match found {
            Err(error) if self.surveyed().is_some() => return Err(error),
            found => found.ok().flatten(),
        };
        Ok(found
            .filter(|survey| survey.noise.is_correlated())
            .map(|survey| Warning::CorrelatedNoise {
                correlation: [(1, 0), (0, 1)].map(|(x, y)| survey.noise.correlation(x, y)),
            }))
    }

    /// Reads a row for the thread that measures it.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn read<S: StampSource<'n>>(
        self: &Arc<Self>,
        source: &mut S,
        row: usize,
    ) -> Result<RowJob<'n>, S::Error> {
        Ok(RowJob {
            session: Arc::clone(self),
            row,
            stamps: source.stamps(row)?,
            psfs: source.psfs(row)?,
        })
    }

    /// Measures the stamps of a row, before calibration.
    ///
    /// # Errors
    /// If sizes do not fit, or a PSF for all galaxies cannot be used.
    pub fn measure(
        &self,
        worker: &mut Worker,
        row: usize,
        stamps: &Pixels<'_, Ix3>,
        psfs: &Psfs<'_>,
    ) -> Result<MeasuredRow, MeasureError> {
        match stamps {
            Pixels::Single(stamps) => self.measure_row(worker, row, stamps.view(), psfs),
            Pixels::Double(stamps) => self.measure_row(worker, row, stamps.view(), psfs),
        }
    }

    fn measure_row<T: Pixel>(
        &self,
        worker: &mut Worker,
        row: usize,
        stamps: ArrayView3<'_, T>,
        psfs: &Psfs<'_>,
    ) -> Result<MeasuredRow, MeasureError> {
        length("a row", stamps.len_of(Axis(0)), self.rows.stamps(row).len())?;
        let levels = match self.noise {
            KnownNoise::GivenEach(levels) => Some(&levels[self.rows.stamps(row)]),
            KnownNoise::Unknown | KnownNoise::Stated(_) | KnownNoise::Given(_) => None,
        };
        let galaxies = self.image(worker).measure_in_noise(stamps, psfs, levels)?;
        let examined = match self.examined.contains(&row) {
            true => Some(self.examine(row, stamps, psfs)?),
            false => None,
        };
        Ok(MeasuredRow {
            row,
            galaxies,
            examined,
        })
    }

    fn examine<T: Pixel>(
        &self,
        row: usize,
        stamps: ArrayView3<'_, T>,
        psfs: &Psfs<'_>,
    ) -> Result<Examined, MeasureError> {
        let mut examination = self.examination();
        for stamp in stamps.outer_iter() {
            examination.add(stamp)?;
        }
        // A PSF for all galaxies is examined once.
        if psfs.count().is_some() || self.examined.first() == Some(&row) {
            let most = EXAMINED_PSFS.div_ceil(enough(self.rows.columns, self.rows.len()));
            examination.add_psfs(psfs, self.measurer.configuration().psf_cut(), most);
        }
        let scaled = match (self.noise, self.typical_level) {
            (KnownNoise::GivenEach(levels), Some(typical)) => {
                let mut scaled = Examination::new(self.measurer.full(), stamps.len_of(Axis(0)));
                let levels = &levels[self.rows.stamps(row)];
                for (stamp, level) in stamps.outer_iter().zip(levels) {
                    if *level > 0.0 {
                        let scale = typical / level;
                        let stamp = stamp.mapv(|value| Into::<f64>::into(value) * scale);
                        scaled.add(stamp.view())?;
                    }
                }
                Some(scaled)
            }
            _ => None,
        };
        Ok(Examined {
            stamps: examination,
            scaled,
        })
    }

    fn examination(&self) -> Examination {
        let subtraction = self.measurer.subtraction(self.survey.as_deref());
        Examination::new(self.measurer.full(), self.rows.columns).without(subtraction)
    }

    /// The image without rows.
    ///
    /// # Errors
    /// If there is no memory for its galaxies.
    pub fn begin(self: Arc<Self>) -> Result<MeasuredImage<'n>, MeasureError> {
        let mut galaxies = Vec::new();
        let count = self.rows.count;
        galaxies
            .try_reserve_exact(count)
            .map_err(|_| MeasureError::Memory(count))?;
        Ok(MeasuredImage {
            session: self,
            galaxies,
            next: 0,
            examined: None,
        })
    }
}

impl<'n> RowJob<'n> {
    /// Measures the row.
    ///
    /// # Errors
    /// As [`Session::measure`].
    pub fn measure(&self, worker: &mut Worker) -> Result<MeasuredRow, MeasureError> {
        self.session
            .measure(worker, self.row, &self.stamps, &self.psfs)
    }

    /// The image of the row.
    pub fn session(&self) -> &Arc<Session<'n>> {
        &self.session
    }
}

impl MeasuredImage<'_> {
    /// Adds the next row.
    ///
    /// # Panics
    /// If it is another row than the next one: the result would depend on threads.
    pub fn add(&mut self, row: MeasuredRow) {
        assert_eq!(row.row, self.next, "rows are collected in order");
        self.next += 1;
        self.galaxies.extend(row.galaxies);
        let Some(more) = row.examined else { return };
        match &mut self.examined {
            None => self.examined = Some(more),
            Some(all) => {
                all.stamps.join(&more.stamps);
                if let (Some(all), Some(more)) = (&mut all.scaled, &more.scaled) {
                    all.join(more);
                }
            }
        }
    }

    /// Whether all rows are there.
    pub fn is_complete(&self) -> bool {
        self.next == self.session.rows.len()
    }

    /// Calibrates the galaxies, and collects what is wrong with the image.
    pub fn finish(self) -> Batch {
        let MeasuredImage {
            session,
            mut galaxies,
            examined,
            ..
        } = self;
        let configuration = session.measurer.configuration();
        let response = calibrate(configuration, &mut galaxies);
        let mut warnings = session.warnings.clone();
        let mut psf_noise = None;
        if let Some(Examined { stamps, scaled }) = examined {
            warnings.extend(stamps.warnings());
            warnings.extend(match session.noise {
                KnownNoise::Given(level) => stamps.given_noise(level),
                KnownNoise::GivenEach(_) => scaled
                    .zip(session.typical_level)
                    .and_then(|(scaled, level)| scaled.given_noise(level)),
                KnownNoise::Stated(level) if configuration.noise == NoiseSource::Header => {
                    stamps.given_noise(level).map(Warning::of_stated)
                }
                KnownNoise::Stated(_) | KnownNoise::Unknown => None,
            });
            let effect = stamps.psf_noise().filter(|[m, _]| *m > LEAST_PSF_NOISE);
            psf_noise = effect.filter(|_| configuration.linear().is_some());
        }
        warnings.extend(Warning::of_galaxies(&galaxies));
        Batch {
            galaxies,
            response,
            warnings,
            psf_noise,
        }
    }
}

/// Checks the noise levels of `count` stamps, or whether there must be one.
fn check(
    configuration: &Configuration,
    noise: KnownNoise<'_>,
    count: usize,
) -> Result<(), MeasureError> {
    let header = configuration.noise == NoiseSource::Header;
    let wrong = |level: &f64| (!is_level(*level)).then(|| level.to_string());
    let found = match noise {
        KnownNoise::Unknown => header.then(|| "not given".to_owned()),
        KnownNoise::Stated(level) => wrong(&level).filter(|_| header),
        KnownNoise::Given(level) => wrong(&level),
        KnownNoise::GivenEach(levels) => {
            length("noise levels", levels.len(), count)?;
            levels.iter().find_map(wrong)
        }
    };
    found.map_or(Ok(()), |found| Err(MeasureError::Noise(found)))
}

/// A warning if a stated level disagrees with the measured noise, which is used.
fn differing(noise: KnownNoise<'_>, measured: &StampNoise) -> Option<Warning> {
    let KnownNoise::Stated(given) = noise else {
        return None;
    };
    let apart = measured.sigma() / given - 1.0;
    let least = (NOISE_SIGNIFICANCE * measured.error()).max(LEAST_NOISE_DIFFERENCE);
    // NaN if the stated level is zero or NaN.
    (apart.abs() > least || apart.is_nan()).then_some(Warning::NoiseLevel {
        given,
        measured: measured.sigma(),
        used: true,
    })
}
