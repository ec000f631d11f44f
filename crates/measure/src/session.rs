//! The measurement of one image, from its stamps and PSFs to rows and warnings.
//!
//! A [`Session`] is opened on a [`StampSource`]. Opening surveys the image: the noise and the sky of its stamps, and the
//! common profile of noisy stars. Rows are then read, measured in any thread, and collected in order by a
//! [`MeasuredImage`], which checks the image. Files, simulations, [`Measurer::batch`] and Python all
//! use it, so that they survey and report the same.

use std::borrow::Cow;
use std::fmt;
use std::ops::{ControlFlow, Deref, Range};
use std::sync::{Arc, LazyLock};

use ndarray::{ArrayView3, Axis, CowArray, Ix3, Slice};
use shearq_quantities::linear::{Matrix2, inverse, product};
use shearq_quantities::statistics::upper_median;
use shearq_quantities::{Frame, Jacobian, columns_of};
use shearq_submissions::limits::MIN_PSF;
use shearq_submissions::{Calibration, Configuration, NoiseSource};

use crate::calibration::mean_response;
use crate::defects::LightLimits;
use crate::error::{EpochError, MeasureError, length};
use crate::examine::{EXAMINED_PSFS, Estimate, Examination, enough, examined_rows};
use crate::measurement::{Flag, Measurement};
use crate::measurer::{Epoch, ImageNoise, ImageWorker, Measurer, Steps, Worker};
use crate::noise::{NoisePlan, NoiseSurvey, StampNoise, Survey};
use crate::pixels::{Pixel, Pixels, is_level};
use crate::psf::{Psfs, ResidualProfiles};
use crate::warning::Warning;

/// The noise of an image before it is measured, as far as it is known.
#[derive(Debug, Clone, Default)]
pub enum KnownNoise<'n> {
    /// Unknown.
    #[default]
    Unknown,
    /// A level that the data state. A configuration that measures the noise on the stamps reports a difference.
    Stated(f64),
    /// The level of white noise that the caller gives, which replaces the measurement on the stamps.
    Given(f64),
    /// The same, one level per stamp.
    GivenEach(Cow<'n, [f64]>),
    /// Levels that the data state, one per stamp. Sky, galaxies and the correlation of the noise are measured on the stamps.
    StatedEach(Cow<'n, [f64]>),
}

impl KnownNoise<'_> {
    pub(crate) fn levels(&self) -> Option<&[f64]> {
        match self {
            KnownNoise::GivenEach(levels) | KnownNoise::StatedEach(levels) => Some(levels),
            KnownNoise::Unknown | KnownNoise::Stated(_) | KnownNoise::Given(_) => None,
        }
    }
}

/// The stamps of an image in rows. The last row may be shorter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StampRows {
    /// Stamps of a full row, 1 or more.
    pub columns: usize,
    /// All stamps.
    pub count: usize,
}

impl StampRows {
    /// Number of rows.
    #[expect(clippy::len_without_is_empty, reason = "an image has rows")]
    pub fn len(&self) -> usize {
        self.count.div_ceil(self.columns)
    }

    /// Which stamps are in a row.
    pub fn stamps(&self, row: usize) -> Range<usize> {
        row * self.columns..((row + 1) * self.columns).min(self.count)
    }
}

/// Stamps and PSFs of an image: files, arrays, a simulation.
///
/// One thread reads, so a source may own a file that threads cannot share. Rows are read in ascending order and, for
/// surveys, some of them before that.
pub trait StampSource<'a> {
    /// Why a row cannot be read or measured.
    type Error: From<MeasureError> + Send;

    /// The rows of the image.
    fn rows(&self) -> StampRows;

    /// Warnings about the image from other sources than its pixels, such as headers.
    fn warnings(&self) -> Vec<Warning> {
        Vec::new()
    }

    /// Reads the stamps of a row, one along the first axis per galaxy.
    ///
    /// # Errors
    /// If they cannot be read.
    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'a>, Self::Error>;

    /// Reads the PSFs of a row: one PSF for all galaxies, or one per galaxy.
    ///
    /// # Errors
    /// If they cannot be read.
    fn psfs(&mut self, row: usize) -> Result<Lazy<'a, Psfs<'a>>, Self::Error>;

    /// The Jacobians of a row's stamps, one per galaxy, with which shapes are measured in the frame of the sky; `None`
    /// if they are measured in the frame of the pixels. It is the same for all rows of an image. PSFs are on the pixels of
    /// their stamps.
    ///
    /// # Errors
    /// If they cannot be determined.
    fn jacobians(&mut self, _row: usize) -> Result<Option<Vec<Jacobian>>, Self::Error> {
        Ok(None)
    }

    /// Offsets (x, y) of a row's galaxies from the centres of their stamps in pixels, which the window follows. It is the same for all
    /// rows of an image whether there are any; with `None`, galaxies are at the centres, and a single stamp is not an epoch.
    ///
    /// # Errors
    /// If they cannot be read.
    fn offsets(&mut self, _row: usize) -> Result<Option<Vec<[f64; 2]>>, Self::Error> {
        Ok(None)
    }

    /// Electrons per unit of the stamps. With them, the Poisson noise of the galaxies is part of their noise; without, the
    /// noise is that of the sky. Networks ignore it.
    fn gain(&self) -> Option<f64> {
        None
    }

    /// What a header states of the detector, which is compared with the stamps.
    fn detector(&self) -> Detector {
        Detector::default()
    }

    /// Whether the pixels have the unit of flux of other epochs, so that a ratio other than 1 is a mistake.
    fn has_common_flux(&self) -> bool {
        true
    }
}

/// What a header states of the detector.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Detector {
    /// Electrons per unit of the stamps, without use unless [`StampSource::gain`] has them.
    pub gain: Option<f64>,
    /// Pixels of this value and above are saturated.
    pub saturation: Option<f64>,
}

/// A value that is made by the first thread that needs it: threads share the drawing of simulated galaxies, although one
/// thread reads the rows. Clones share the value.
#[derive(Debug, Clone)]
pub struct Lazy<'a, T>(Arc<LazyLock<T, Box<dyn FnOnce() -> T + Send + 'a>>>);

/// The stamps of a row.
pub type LazyStamps<'a> = Lazy<'a, Pixels<'a, Ix3>>;

impl<'a, T> Lazy<'a, T> {
    /// A value that will be made.
    pub fn new(make: impl FnOnce() -> T + Send + 'a) -> Self {
        Lazy(Arc::new(LazyLock::new(Box::new(make))))
    }
}

impl<'a, T: Send + 'a> From<T> for Lazy<'a, T> {
    fn from(value: T) -> Self {
        Lazy::new(move || value)
    }
}

impl<T> Deref for Lazy<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

/// Threads of the caller. This crate starts none.
pub trait Threads {
    /// Number of threads, 1 or more.
    fn count(&self) -> usize;

    /// Maps values, in order, in any thread.
    fn map<T: Send, R: Send>(&self, of: Vec<T>, map: impl Fn(T) -> R + Sync + Send) -> Vec<R>;
}

/// The calling thread alone.
#[derive(Debug, Clone, Copy, Default)]
pub struct OneThread;

impl Threads for OneThread {
    fn count(&self) -> usize {
        1
    }

    fn map<T: Send, R: Send>(&self, of: Vec<T>, map: impl Fn(T) -> R + Sync + Send) -> Vec<R> {
        of.into_iter().map(map).collect()
    }
}

/// Some of the stamps, or of their PSFs.
type Slices<'a, T, E> = Box<dyn FnMut(Range<usize>) -> Result<T, E> + Send + 'a>;

/// Stamps and PSFs in arrays, in the arrangement nearest to a square: images with equal numbers of stamps have the same rows,
/// so that the same stamps are surveyed and examined.
pub struct ArraySource<'a, E = MeasureError> {
    count: usize,
    stamps: Slices<'a, Pixels<'a, Ix3>, E>,
    psfs: Slices<'a, Psfs<'a>, E>,
    moved: Option<[f64; 2]>,
    is_psf_shared: bool,
    /// One for all stamps or one per stamp.
    jacobians: Option<Cow<'a, [Jacobian]>>,
    offsets: Option<Cow<'a, [[f64; 2]]>>,
    detector: Detector,
}

impl<E> fmt::Debug for ArraySource<'_, E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ArraySource")
            .field("count", &self.count)
            .finish_non_exhaustive()
    }
}

impl<'a> ArraySource<'a> {
    /// Of stamps, one along the first axis per galaxy. A star for all galaxies is cut and normalised here.
    ///
    /// # Errors
    /// If there is not one PSF for all or one per galaxy, or the star for all cannot be used.
    pub fn new<T: Pixel>(
        measurer: &Measurer,
        stamps: ArrayView3<'a, T>,
        psfs: &'a Psfs<'_>,
    ) -> Result<Self, MeasureError> {
        let (count, full, _) = stamps.dim();
        let (shared, moved) = match psfs.count() {
            Some(given) if given != count => {
                return Err(MeasureError::Shape {
                    what: "PSFs",
                    found: format!("{given} galaxies"),
                    expected: format!("{count}, one each"),
                });
            }
            None if matches!(psfs, Psfs::Star(_)) => {
                let star = psfs.at(0, measurer.configuration().psf_cut(), full)?;
                let moved = star.moved;
                (Some(Arc::new(star)), moved)
            }
            _ => (None, None),
        };
        let is_shared = shared.is_some();
        let stamps = move |range| {
            let mut some = stamps;
            some.slice_axis_inplace(Axis(0), Slice::from(range));
            Ok(T::pixels(some))
        };
        let psfs = move |range| {
            let shared = shared.clone().map(Psfs::Prepared);
            Ok(shared.unwrap_or_else(|| psfs.slice(range)))
        };
        let source = ArraySource::from_fn(count, stamps, psfs, moved);
        Ok(match is_shared {
            true => source.with_shared_psf(),
            false => source,
        })
    }
}

impl<'a, E> ArraySource<'a, E> {
    /// A source of `count` stamps that two functions read by range, the pixels and their PSFs. `moved` is the offset in pixels
    /// by which the star for all galaxies was moved to the centre of its stamp.
    pub fn from_fn(
        count: usize,
        stamps: impl FnMut(Range<usize>) -> Result<Pixels<'a, Ix3>, E> + Send + 'a,
        psfs: impl FnMut(Range<usize>) -> Result<Psfs<'a>, E> + Send + 'a,
        moved: Option<[f64; 2]>,
    ) -> Self {
        ArraySource {
            count,
            stamps: Box::new(stamps),
            psfs: Box::new(psfs),
            moved,
            is_psf_shared: false,
            jacobians: None,
            offsets: None,
            detector: Detector::default(),
        }
    }

    /// The same stamps with what their header states of the detector.
    #[must_use]
    pub fn with_detector(self, detector: Detector) -> Self {
        ArraySource { detector, ..self }
    }

    /// The same stamps, of which all have one PSF.
    #[must_use]
    pub fn with_shared_psf(mut self) -> Self {
        self.is_psf_shared = true;
        self
    }

    /// The same stamps with their galaxies at these offsets (x, y) from their centres in pixels, one per stamp. If all are zero, there
    /// are none.
    ///
    /// # Errors
    /// If there are another number of them.
    pub fn with_offsets(
        mut self,
        offsets: impl Into<Cow<'a, [[f64; 2]]>>,
    ) -> Result<Self, MeasureError> {
        let offsets = offsets.into();
        length("offsets", offsets.len(), self.count)?;
        self.offsets = offsets.iter().any(|at| *at != [0.0; 2]).then_some(offsets);
        Ok(self)
    }

    /// The same stamps in the frame of the sky, with one Jacobian for all or one per stamp.
    ///
    /// # Errors
    /// If there are another number of them.
    pub fn with_jacobians(
        mut self,
        jacobians: impl Into<Cow<'a, [Jacobian]>>,
    ) -> Result<Self, MeasureError> {
        let jacobians = jacobians.into();
        if jacobians.len() != 1 {
            length("Jacobians", jacobians.len(), self.count)?;
        }
        self.jacobians = Some(jacobians);
        Ok(self)
    }
}

impl<'a, E: From<MeasureError> + Send> StampSource<'a> for ArraySource<'a, E> {
    type Error = E;

    fn rows(&self) -> StampRows {
        StampRows {
            columns: columns_of(self.count),
            count: self.count,
        }
    }

    fn warnings(&self) -> Vec<Warning> {
        let moved = self.moved.map(Warning::of_moved);
        let pixels = self.jacobians.as_deref().filter(|_| self.is_psf_shared);
        let pixels = pixels.unwrap_or_default().iter().map(Jacobian::matrix);
        moved
            .into_iter()
            .chain(Warning::of_shared_psf(pixels))
            .collect()
    }

    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'a>, E> {
        let range = self.rows().stamps(row);
        Ok((self.stamps)(range)?.into())
    }

    fn psfs(&mut self, row: usize) -> Result<Lazy<'a, Psfs<'a>>, E> {
        let range = self.rows().stamps(row);
        Ok((self.psfs)(range)?.into())
    }

    fn jacobians(&mut self, row: usize) -> Result<Option<Vec<Jacobian>>, E> {
        let range = self.rows().stamps(row);
        Ok(self.jacobians.as_deref().map(|all| match all {
            [one] => vec![*one; range.len()],
            each => each[range].to_vec(),
        }))
    }

    fn offsets(&mut self, row: usize) -> Result<Option<Vec<[f64; 2]>>, E> {
        let range = self.rows().stamps(row);
        Ok(self.offsets.as_deref().map(|each| each[range].to_vec()))
    }

    fn detector(&self) -> Detector {
        self.detector
    }
}

// In pixels along each axis. Chosen by hand.
const WHITENESS_TEST_MAX_LAG: usize = 2;
// Relative difference of stated and surveyed noise, whose median of 1,000 stamps has an error of 0.15 %. Chosen by hand.
const STATED_NOISE_DIFFERENCE: f64 = 0.01;
// Effect on m below which the noise of a star is not stated: rounding a star to single precision has this effect.
const MIN_STATED_PSF_NOISE_M: f64 = 1e-5;

// PSFs of single galaxies of a row of which the narrowest limits light in surveys. Chosen by hand: limits have a margin.
const LIMITING_PSFS: usize = 9;

/// One image between its survey and its last row. Threads share it.
#[derive(Debug)]
pub struct Session<'n> {
    measurer: Measurer,
    rows: StampRows,
    frame: Frame,
    noise: KnownNoise<'n>,
    gain: Option<f64>,
    detector: Detector,
    common_flux: bool,
    survey: Option<Arc<Survey>>,
    stars: Option<Arc<ResidualProfiles>>,
    /// What pixels of the image hold light, if pixels that hold none are removed.
    light: Option<LightLimits>,
    examined: Vec<usize>,
    /// Median of the positive levels of the examined stamps, if there is a level for each stamp.
    typical_level: Option<f64>,
    /// Of the first stamp, in the frame of the sky.
    jacobian: Option<Jacobian>,
    warnings: Vec<Warning>,
    /// Whether galaxies are not at the centres of their stamps, so that even a single stamp is measured as an epoch.
    has_offsets: bool,
    /// Of the images that contain further epochs of the galaxies.
    epochs: Vec<Arc<Session<'n>>>,
}

/// A row of stamps that was read, for the thread that measures it.
#[derive(Debug)]
pub struct RowJob<'n> {
    session: Arc<Session<'n>>,
    row: usize,
    stamps: LazyStamps<'n>,
    psfs: Lazy<'n, Psfs<'n>>,
    jacobians: Option<Vec<Jacobian>>,
    offsets: Option<Vec<[f64; 2]>>,
    epochs: Vec<RowJob<'n>>,
}

/// The galaxies of a row.
#[derive(Debug)]
pub struct MeasuredRow {
    row: usize,
    /// One per stamp.
    pub galaxies: Vec<Measurement>,
    /// Of each image with an epoch of the galaxies.
    examined: Vec<Option<Examined>>,
}

/// Examinations of stamps: unscaled and, if there is a noise level for each stamp, in units of these levels.
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
    examined: Vec<Option<Examined>>,
}

/// The galaxies of an image.
#[derive(Debug, Clone, Default)]
pub struct Batch {
    /// One per stamp. Ellipticities are not divided by a response.
    pub galaxies: Vec<Measurement>,
    /// The mean response of e1 to γ1 and of e2 to γ2 of the galaxies without a flag; `None` if the configuration asks for no
    /// calibration. The mean shear of many images is the sum of all ellipticities over the sum of all responses.
    pub response: Option<[f64; 2]>,
    /// Root mean square of the measurement noise of e1 and e2 of the galaxies without a flag, before division by the response; zero
    /// for the network. Their scatter contains the intrinsic shapes, too.
    pub e_noise: [f64; 2],
    /// What is wrong with the stamps and PSFs.
    pub warnings: Vec<Warning>,
    /// Standard deviations of m and c of the image by the noise of the star that all of its galaxies share. `None` if
    /// there is a PSF per galaxy, the configuration is not linear, or the effect is negligible.
    pub psf_noise: Option<[f64; 2]>,
    /// The frame of ellipticities and of everything that refers to components of shear. Lengths are in pixels; in the frame
    /// of the sky, in sides of a square of a pixel's area.
    pub frame: Frame,
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
    /// Opens an image: surveys its stars and, unless its noise is given, its stamps. A configuration that treats noise as white
    /// needs a second survey, which shows whether it is.
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
        check(measurer.configuration(), &noise, rows.count)?;
        let examined = match rows.count {
            0 => Vec::new(),
            _ => examined_rows(rows.columns, rows.len()),
        };
        let configuration = measurer.configuration();
        let size = configuration.psf.size;
        let loses_wings = configuration.linear().is_some() && size < MIN_PSF;
        let of_settings = loses_wings.then_some(Warning::PsfSize { size });
        let warnings = of_settings.into_iter().chain(source.warnings()).collect();
        let stars = survey_stars(measurer, source, &examined, threads)?;
        let light = light_limits(measurer, source, &examined)?;
        let jacobians = match rows.count {
            0 => None,
            _ => source.jacobians(0)?,
        };
        let frame = match jacobians {
            None => Frame::Pixel,
            Some(_) => Frame::Sky,
        };
        let jacobian = jacobians.and_then(|all| all.first().copied());
        let has_offsets =
            configuration.linear().is_some() && rows.count > 0 && source.offsets(0)?.is_some();
        let mut session = Session {
            measurer: measurer.clone(),
            rows,
            frame,
            noise,
            gain: source.gain(),
            detector: source.detector(),
            common_flux: source.has_common_flux(),
            survey: None,
            stars,
            light,
            examined,
            typical_level: None,
            jacobian,
            warnings,
            has_offsets,
            epochs: Vec::new(),
        };
        if let Some(levels) = session.noise.levels() {
            let examined = session.examined.iter().flat_map(|&row| rows.stamps(row));
            let mut levels: Vec<f64> = examined.map(|at| levels[at]).collect();
            levels.retain(|level| *level > 0.0);
            session.typical_level = upper_median(&mut levels);
        }
        if let Some(plan) = session.noise_plan() {
            let survey = survey_noise(plan, source, light, threads)?;
            let border = survey.missing_border();
            session.survey = survey.result()?.map(Arc::new);
            session.warnings.extend(border);
            session
                .warnings
                .extend(match (&session.survey, &session.noise) {
                    (None, KnownNoise::StatedEach(_)) => None,
                    (None, _) => Some(Warning::NoNoise),
                    (Some(survey), KnownNoise::Stated(level)) => {
                        stated_noise(*level, &survey.noise)
                    }
                    (Some(_), _) => None,
                });
        }
        let correlated = session.correlated_noise(source, threads)?;
        session.warnings.extend(correlated);
        Ok(session)
    }

    /// Adds the images of further epochs: galaxy k is on stamp k of each. [`Session::read_epochs`] reads their rows.
    ///
    /// # Errors
    /// If the images have other numbers of stamps, or other frames.
    pub fn with_epochs(mut self, epochs: Vec<Session<'n>>) -> Result<Self, MeasureError> {
        for epoch in &epochs {
            length("stamps of an epoch", epoch.rows.count, self.rows.count)?;
            if epoch.frame != self.frame {
                return Err(EpochError::Frames.into());
            }
        }
        self.epochs = epochs.into_iter().map(Arc::new).collect();
        Ok(self)
    }

    /// The noise of stamps for which no level is given.
    fn image_noise(&self) -> ImageNoise<'_> {
        match (&self.survey, &self.noise) {
            (Some(survey), _) => ImageNoise::Survey(survey),
            (None, KnownNoise::Given(level)) => ImageNoise::Level(*level),
            (None, KnownNoise::Stated(level)) if self.noise_plan().is_none() => {
                ImageNoise::Level(*level)
            }
            (None, _) => ImageNoise::Unknown,
        }
    }

    /// The plan by which the noise is measured on the stamps, if it is.
    fn noise_plan(&self) -> Option<&NoisePlan> {
        let plan = self.measurer.noise_plan().filter(|_| self.rows.count > 0);
        match self.noise {
            KnownNoise::Unknown | KnownNoise::Stated(_) => plan,
            // Unscaled: sky has the units of the image, and all levels of noise have one correlation.
            KnownNoise::StatedEach(_) => plan,
            KnownNoise::Given(_) | KnownNoise::GivenEach(_) => None,
        }
    }

    /// The rows of the image.
    pub fn rows(&self) -> StampRows {
        self.rows
    }

    /// The frame in which the shapes of this image are measured.
    pub fn frame(&self) -> Frame {
        self.frame
    }

    /// Prepares a worker for galaxies of this image.
    pub fn image<'w>(&self, worker: &'w mut Worker) -> ImageWorker<'w> {
        let mut image = worker.image_with_stars(self.image_noise(), self.stars.as_ref());
        image.set_gain(self.gain);
        image
    }

    /// A warning if the configuration treats noise as white that is correlated.
    fn correlated_noise<S: StampSource<'n>>(
        &self,
        source: &mut S,
        threads: &impl Threads,
    ) -> Result<Option<Warning>, S::Error> {
        let configuration = self.measurer.configuration();
        let white = match configuration.noise {
            NoiseSource::Image { correlation, .. } => correlation == 0,
            NoiseSource::Header | NoiseSource::Border { .. } => true,
        };
        let survey_failed = self.noise_plan().is_some() && self.survey.is_none();
        if configuration.linear().is_none() || !white || survey_failed {
            return Ok(None);
        }
        // Small stamps have no border that could be surveyed.
        let Ok(plan) = NoisePlan::new(self.measurer.full(), WHITENESS_TEST_MAX_LAG, None) else {
            return Ok(None);
        };
        let found = match survey_noise(&plan, source, self.light, threads)?.result() {
            Err(error) if self.noise_plan().is_some() => return Err(error.into()),
            // Without borders there is nothing to test a given level with.
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
            jacobians: source.jacobians(row)?,
            offsets: source.offsets(row)?,
            epochs: Vec::new(),
        })
    }

    /// Reads a row of the image from `first`, and of its further epochs from `others`, in the order of [`Session::with_epochs`].
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn read_epochs<S: StampSource<'n>>(
        self: &Arc<Self>,
        first: &mut S,
        others: &mut [S],
        row: usize,
    ) -> Result<RowJob<'n>, S::Error> {
        let mut job = self.read(first, row)?;
        let others = others.iter_mut().zip(&self.epochs);
        let epochs = others.map(|(source, session)| session.read(source, row));
        job.epochs = epochs.collect::<Result<_, _>>()?;
        Ok(job)
    }

    /// Measures stamp `k` of a row before calibration, with all steps unless the method did not run. Levels of single stamps
    /// are not used.
    ///
    /// # Errors
    /// If the row cannot be read, or the PSF cannot be used.
    pub fn steps<S: StampSource<'n>>(
        &self,
        source: &mut S,
        row: usize,
        k: usize,
    ) -> Result<(Measurement, Option<Steps>), S::Error> {
        let (stamps, psfs) = (source.stamps(row)?, source.psfs(row)?);
        let cut = self.measurer.configuration().psf_cut();
        let psf = psfs.at(k, cut, self.measurer.full())?.psf;
        let mut worker = self.measurer.worker();
        let mut image = self.image(&mut worker);
        let jacobians = source.jacobians(row)?;
        image.set_jacobian(jacobians.as_ref().and_then(|each| each.get(k)))?;
        let mut worker = image.psf(psf.view())?;
        Ok(match &*stamps {
            Pixels::Single(stamps) => {
                worker.measure_with_steps(stamps.index_axis(Axis(0), k), psf)?
            }
            Pixels::Double(stamps) => {
                worker.measure_with_steps(stamps.index_axis(Axis(0), k), psf)?
            }
        })
    }

    fn examine<T: Pixel>(
        &self,
        row: usize,
        stamps: ArrayView3<'_, T>,
        psfs: &Psfs<'_>,
        offsets: Option<&[[f64; 2]]>,
    ) -> Result<Option<Examined>, MeasureError> {
        if !self.examined.contains(&row) {
            return Ok(None);
        }
        let mut examination = self.examination();
        for (k, stamp) in stamps.outer_iter().enumerate() {
            examination.add_at(stamp, offsets.map_or([0.0; 2], |each| each[k]))?;
        }
        // A PSF for all galaxies is examined once.
        if psfs.count().is_some() || self.examined.first() == Some(&row) {
            let most = EXAMINED_PSFS.div_ceil(enough(self.rows.columns, self.rows.len()));
            examination.add_psfs(psfs, self.measurer.configuration().psf_cut(), most);
        }
        let scaled = match (self.noise.levels(), self.typical_level) {
            (Some(levels), Some(typical)) => {
                let count = stamps.len_of(Axis(0));
                let scaled = Examination::new(self.measurer.full(), count);
                let mut scaled = scaled.with_light(self.light);
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
        Ok(Some(Examined {
            stamps: examination,
            scaled,
        }))
    }

    fn examination(&self) -> Examination {
        let subtraction = self.measurer.subtraction(self.survey.as_deref());
        Examination::new(self.measurer.full(), self.rows.columns)
            .without(subtraction)
            .with_light(self.light)
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
            examined: Vec::new(),
        })
    }
}

impl<'n> RowJob<'n> {
    /// The galaxies of the row before calibration, in the frame of the sky if there are Jacobians.
    ///
    /// # Errors
    /// If sizes or the frame do not fit, pixels are sheared too much, or a PSF for all galaxies cannot be used.
    pub fn measure_row(&self, worker: &mut Worker) -> Result<MeasuredRow, MeasureError> {
        if !self.epochs.is_empty() || self.session.has_offsets {
            return self.row_of_epochs(worker);
        }
        match &*self.stamps {
            Pixels::Single(stamps) => self.measure_stamps(worker, stamps.view()),
            Pixels::Double(stamps) => self.measure_stamps(worker, stamps.view()),
        }
    }

    fn measure_stamps<T: Pixel>(
        &self,
        worker: &mut Worker,
        stamps: ArrayView3<'_, T>,
    ) -> Result<MeasuredRow, MeasureError> {
        let (session, row) = (&self.session, self.row);
        let (psfs, jacobians) = (&*self.psfs, self.jacobians.as_deref());
        let count = session.rows.stamps(row).len();
        length("a row", stamps.len_of(Axis(0)), count)?;
        // Results of two frames must not become one image.
        let on_sky = match session.frame {
            Frame::Pixel => 0,
            Frame::Sky => count,
        };
        length(
            "Jacobians of a row",
            jacobians.map_or(0, <[_]>::len),
            on_sky,
        )?;
        let levels = session.noise.levels();
        let levels = levels.map(|levels| &levels[session.rows.stamps(row)]);
        let mut image = session.image(worker);
        let galaxies = image.measure_stamps(stamps, psfs, levels, jacobians)?;
        Ok(MeasuredRow {
            row,
            galaxies,
            examined: vec![session.examine(row, stamps, psfs, None)?],
        })
    }

    fn row_of_epochs(&self, worker: &mut Worker) -> Result<MeasuredRow, MeasureError> {
        let measurer = &self.session.measurer;
        let jobs: Vec<&RowJob<'n>> = std::iter::once(self).chain(&self.epochs).collect();
        let count = self.session.rows.stamps(self.row).len();
        let mut all = Vec::with_capacity(jobs.len());
        for job in &jobs {
            // Pixels in one precision serve epochs of both, and single precision keeps its bits.
            let stamps = match &*job.stamps {
                Pixels::Single(stamps) => CowArray::from(stamps.mapv(f64::from)),
                Pixels::Double(stamps) => CowArray::from(stamps.view()),
            };
            length("a row", stamps.len_of(Axis(0)), count)?;
            all.push(stamps);
        }
        let cut = measurer.configuration().psf_cut();
        let shared = jobs.iter().map(|job| match job.psfs.count() {
            Some(_) => Ok(None),
            None => job
                .psfs
                .at(0, cut, measurer.full())
                .map(|star| Some(star.psf)),
        });
        let shared: Vec<_> = shared.collect::<Result<_, _>>()?;
        let mut galaxies = Vec::with_capacity(count);
        for k in 0..count {
            let own = jobs.iter().zip(&shared).map(|(job, shared)| match shared {
                Some(_) => None,
                None => job
                    .psfs
                    .at(k, cut, measurer.full())
                    .ok()
                    .map(|star| star.psf),
            });
            let own: Vec<_> = own.collect();
            let mut epochs = Vec::with_capacity(jobs.len());
            let mut stars = Vec::with_capacity(jobs.len());
            let mut usable_psf = false;
            for (at, job) in jobs.iter().enumerate() {
                // An epoch without PSF or noise has no weight, as one without pixels.
                let Some(psf) = shared[at].as_ref().or(own[at].as_ref()) else {
                    continue;
                };
                usable_psf = true;
                let session = &job.session;
                let stamp = session.rows.stamps(job.row).start + k;
                let levels = session.noise.levels();
                // NaN if it is unknown.
                let noise = levels.map_or_else(|| session.image_noise().level(), |all| all[stamp]);
                if noise.is_nan() || noise <= 0.0 {
                    continue;
                }
                stars.push(session.stars.as_ref());
                epochs.push(Epoch {
                    stamp: all[at].index_axis(Axis(0), k),
                    psf: psf.view(),
                    noise,
                    jacobian: job.jacobians.as_ref().map(|each| each[k]),
                    offset: job.offsets.as_ref().map_or([0.0; 2], |each| each[k]),
                    survey: session.survey.as_deref(),
                    gain: session.gain,
                });
            }
            let flag = if usable_psf {
                Flag::NoScale
            } else {
                Flag::BadPsf
            };
            // The epochs bring the noise, the sky and the stars of their images.
            let mut image = worker.image(ImageNoise::Unknown);
            galaxies.push(match epochs.is_empty() {
                true => Measurement::flagged(flag),
                false => image.measure_epochs_with_stars(&epochs, &stars)?,
            });
        }
        let examined = jobs.iter().zip(&all).map(|(job, stamps)| {
            let offsets = job.offsets.as_deref();
            let session = &job.session;
            session.examine(job.row, stamps.view(), &job.psfs, offsets)
        });
        Ok(MeasuredRow {
            row: self.row,
            galaxies,
            examined: examined.collect::<Result<_, _>>()?,
        })
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
        self.examined.resize_with(row.examined.len(), || None);
        for (all, more) in self.examined.iter_mut().zip(row.examined) {
            match (all, more) {
                (_, None) => {}
                (all @ None, more) => *all = more,
                (Some(all), Some(more)) => {
                    all.stamps.join(&more.stamps);
                    if let (Some(all), Some(more)) = (&mut all.scaled, &more.scaled) {
                        all.join(more);
                    }
                }
            }
        }
    }

    /// Whether all rows are there.
    pub fn is_complete(&self) -> bool {
        self.next == self.session.rows.len()
    }

    /// Collects what is wrong with the image.
    pub fn finish(self) -> Batch {
        let MeasuredImage {
            session,
            mut galaxies,
            examined,
            ..
        } = self;
        let configuration = session.measurer.configuration();
        let calibrated = configuration.calibration() == Calibration::Response;
        let response = calibrated.then(|| mean_response(&galaxies));
        if !calibrated {
            // A response in a catalogue is one to divide by.
            galaxies
                .iter_mut()
                .for_each(|galaxy| galaxy.response = None);
        }
        let own = examined.first().and_then(Option::as_ref);
        let is_single = session.epochs.is_empty();
        let mut warnings = match is_single && !session.has_offsets {
            true => session.image_warnings(own),
            false => session.epoch_warnings(&examined),
        };
        // The noise of several stars averages, and its effect is not known.
        let psf_noise = is_single.then(|| session.psf_noise(own)).flatten();
        // A sky below that of other stamps makes fluxes negative, too.
        let is_sky = |one: &Warning| matches!(one.inner(), Warning::SkyLevels { .. });
        let levels_differ = warnings.iter().any(is_sky);
        let of_galaxies = Warning::of_galaxies(&galaxies);
        let is_known = |one: &Warning| levels_differ && matches!(one, Warning::Empty { .. });
        warnings.extend(of_galaxies.filter(|one| !is_known(one)));
        // Of correlated noise, the level of a pixel is not the noise that a galaxy has.
        let is_white = session
            .survey
            .as_ref()
            .is_none_or(|survey| !survey.noise.is_correlated());
        let is_unused = session.gain.is_none() && is_white;
        let unused_gain = session.detector.gain.filter(|_| is_unused);
        warnings.extend(unused_gain.and_then(|gain| Warning::of_poisson(&galaxies, gain)));
        if let Some(mean) = &response
            && !mean.is_significant
            && galaxies.iter().any(|galaxy| galaxy.flags.is_empty())
        {
            let response = mean.diagonal;
            warnings.push(Warning::NoResponse { response });
        }
        let good = galaxies.iter().filter(|galaxy| galaxy.flags.is_empty());
        let count = good.clone().count().max(1) as f64;
        let variance = |k: usize| good.clone().map(|galaxy| galaxy.e_variance[k]).sum::<f64>();
        let e_noise = [0, 1].map(|k| (variance(k) / count).sqrt());
        Batch {
            galaxies,
            response: response.map(|mean| mean.diagonal),
            e_noise,
            warnings,
            psf_noise,
            frame: session.frame,
        }
    }
}

impl Session<'_> {
    /// The map from pixels of another image to pixels of this image.
    fn axes_from(&self, other: &Self) -> Matrix2 {
        match (&self.jacobian, &other.jacobian) {
            (Some(own), Some(other)) => product(inverse(own.matrix()), other.matrix()),
            _ => [[1.0, 0.0], [0.0, 1.0]],
        }
    }

    /// Warnings of all epochs; each is compared with those before it.
    fn epoch_warnings(&self, examined: &[Option<Examined>]) -> Vec<Warning> {
        let images = std::iter::once(self).chain(self.epochs.iter().map(Arc::as_ref));
        let mut warnings = Vec::new();
        let mut earlier = Vec::new();
        for (epoch, (image, examined)) in (1..).zip(images.zip(examined)) {
            let mut own = image.image_warnings(examined.as_ref());
            if let Some(Examined { stamps, .. }) = examined {
                let axes = image.axes_from(self);
                own.extend(stamps.contradictions(&earlier, axes, image.common_flux));
                own.extend(stamps.scattered_psfs());
                earlier.push(stamps);
            }
            warnings.extend(image.of_epoch(own).map(|warning| {
                let warning = Box::new(warning);
                Warning::Epoch { epoch, warning }
            }));
        }
        warnings
    }

    /// Adapts the warnings of this image to an epoch, which is left out without noise, and whose offsets are stated.
    fn of_epoch(&self, warnings: Vec<Warning>) -> impl Iterator<Item = Warning> {
        let noise = self.survey.as_ref().map(|survey| &survey.noise);
        let correlated = noise.filter(|noise| noise.is_correlated());
        let correlated = correlated.map(|noise| Warning::EpochNoise {
            correlation: [(1, 0), (0, 1)].map(|(x, y)| noise.correlation(x, y)),
        });
        let displaced = |warning: &Warning| matches!(warning, Warning::EpochOffset { .. });
        let is_displaced = warnings.iter().any(displaced);
        let own = move |warning| match warning {
            Warning::NoNoise => Some(Warning::EpochNoNoise),
            Warning::CorrelatedNoise { correlation } => Some(Warning::EpochNoise { correlation }),
            Warning::OffCentre { .. } if is_displaced => None,
            Warning::OffCentre { offset, error } => Some(Warning::EpochOffset {
                offset,
                error,
                from_first: false,
            }),
            other => Some(other),
        };
        warnings.into_iter().filter_map(own).chain(correlated)
    }

    /// Warnings of the source, of the survey and of the examined stamps.
    fn image_warnings(&self, examined: Option<&Examined>) -> Vec<Warning> {
        let mut warnings = self.warnings.clone();
        let Some(Examined { stamps, scaled }) = examined else {
            return warnings;
        };
        // Stamps with stated levels may come from images of several depths.
        let one_level = self.noise.levels().is_none();
        let found = stamps.warnings().into_iter();
        warnings.extend(found.filter(|one| one_level || !matches!(one, Warning::Depths { .. })));
        let saturation = self.detector.saturation;
        warnings.extend(saturation.and_then(|level| stamps.near_saturation(level)));
        let header = self.measurer.configuration().noise == NoiseSource::Header;
        warnings.extend(match &self.noise {
            KnownNoise::Given(level) => stamps.given_noise(*level),
            KnownNoise::GivenEach(_) | KnownNoise::StatedEach(_) => scaled
                .as_ref()
                .zip(self.typical_level)
                .and_then(|(scaled, level)| scaled.given_noise(level)),
            &KnownNoise::Stated(given) if header => {
                stamps
                    .noise_unlike(given)
                    .map(|measured| Warning::NoiseLevel {
                        given,
                        measured,
                        used: false,
                    })
            }
            KnownNoise::Stated(_) | KnownNoise::Unknown => None,
        });
        warnings
    }

    /// The effect of the star's noise on m and c of a linear configuration, if it is large enough to be stated.
    fn psf_noise(&self, examined: Option<&Examined>) -> Option<[f64; 2]> {
        self.measurer.configuration().linear()?;
        let effect = examined?.stamps.psf_noise();
        effect.filter(|[m, _]| *m > MIN_STATED_PSF_NOISE_M)
    }
}

/// Checks the noise levels of `count` stamps, or whether there must be one.
fn check(
    configuration: &Configuration,
    noise: &KnownNoise<'_>,
    count: usize,
) -> Result<(), MeasureError> {
    let header = configuration.noise == NoiseSource::Header;
    let wrong = |level: &f64| (!is_level(*level)).then(|| level.to_string());
    let found = match noise {
        KnownNoise::Unknown => header.then(|| "not given".to_owned()),
        KnownNoise::Stated(level) => wrong(level).filter(|_| header),
        KnownNoise::Given(level) => wrong(level),
        KnownNoise::GivenEach(levels) | KnownNoise::StatedEach(levels) => {
            length("noise levels", levels.len(), count)?;
            levels.iter().find_map(wrong)
        }
    };
    found.map_or(Ok(()), |found| Err(MeasureError::Noise(found)))
}

/// Tests a level of the header, which is not used, against the survey.
fn stated_noise(given: f64, survey: &StampNoise) -> Option<Warning> {
    let measured = survey.sigma();
    let apart = Estimate {
        value: measured / given - 1.0,
        error: survey.error(),
    };
    let differs = apart.is_significant() && apart.value.abs() > STATED_NOISE_DIFFERENCE;
    // NaN if the stated level is zero or NaN.
    (differs || apart.value.is_nan()).then_some(Warning::NoiseLevel {
        given,
        measured,
        used: true,
    })
}

/// The survey of the noise, the sky and the galaxy size of an image.
fn survey_noise<'a, S: StampSource<'a>>(
    plan: &NoisePlan,
    source: &mut S,
    light: Option<LightLimits>,
    threads: &impl Threads,
) -> Result<NoiseSurvey, S::Error> {
    let rows = source.rows();
    let chosen = plan.rows(rows.columns, rows.len());
    let mut pass = |mut all: NoiseSurvey| {
        let empty = all.clone();
        scan(
            (rows, &chosen, threads),
            |row| source.stamps(row),
            |stamps, range| {
                let mut survey = empty.clone();
                match &**stamps {
                    Pixels::Single(stamps) => add_stamps(&mut survey, stamps.view(), range)?,
                    Pixels::Double(stamps) => add_stamps(&mut survey, stamps.view(), range)?,
                }
                Ok(survey)
            },
            |found| {
                all.join(&found)?;
                Ok(ControlFlow::Continue(()))
            },
        )?;
        Ok::<_, S::Error>(all)
    };
    let mut survey = pass(plan.survey().with_light(light))?;
    if let Some(again) = survey.without_sky() {
        survey = pass(again)?;
    }
    Ok(survey)
}

fn add_stamps<T: Pixel>(
    survey: &mut NoiseSurvey,
    mut stamps: ArrayView3<'_, T>,
    range: Range<usize>,
) -> Result<(), MeasureError> {
    stamps.slice_axis_inplace(Axis(0), Slice::from(range));
    stamps.outer_iter().try_for_each(|stamp| survey.add(stamp))
}

/// What light looks like behind any of the PSFs of an image; `None` if the configuration does not remove pixels that hold none.
fn light_limits<'a, S: StampSource<'a>>(
    measurer: &Measurer,
    source: &mut S,
    chosen: &[usize],
) -> Result<Option<LightLimits>, S::Error> {
    if measurer.configuration().linear().is_none() {
        return Ok(None);
    }
    for &row in chosen {
        let psfs = source.psfs(row)?;
        let count = psfs.count().unwrap_or(1);
        let some = count.min(LIMITING_PSFS);
        let limits = (0..some).filter_map(|k| {
            let cut = measurer.configuration().psf_cut();
            let star = psfs.at((2 * k + 1) * count / (2 * some), cut, measurer.full());
            Some(LightLimits::from_psf(star.ok()?.psf.view()))
        });
        let limits = limits.reduce(|all, more| all.wider(&more));
        // An epoch may have no PSFs of the galaxies of a row.
        if limits.is_some() {
            return Ok(limits);
        }
    }
    Ok(None)
}

/// The residual profiles of noisy stars, one per galaxy. `None` if all galaxies share a PSF, PSFs are formulas, stars have no noise,
/// or the configuration does not denoise stars.
fn survey_stars<'a, S: StampSource<'a>>(
    measurer: &Measurer,
    source: &mut S,
    chosen: &[usize],
    threads: &impl Threads,
) -> Result<Option<Arc<ResidualProfiles>>, S::Error> {
    let Some(mut survey) = measurer.star_survey() else {
        return Ok(None);
    };
    let rows = source.rows();
    scan(
        (rows, chosen, threads),
        |row| source.psfs(row),
        |psfs, range| {
            let (Psfs::Stars(_), Some(mut part)) = (&**psfs, measurer.star_survey()) else {
                return Ok(None);
            };
            range.for_each(|at| part.add(psfs, at));
            Ok(Some(part))
        },
        |part| {
            let Some(part) = part else {
                return Ok(ControlFlow::Break(()));
            };
            survey.join(part);
            Ok(match survey.is_over() {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            })
        },
    )?;
    Ok(survey.residual_profiles())
}

/// Reads `chosen` rows, one per thread at a time, surveys parts of them in the threads, and joins the parts in the order of
/// the stamps.
fn scan<R: Send + Sync, L: Send, E: Send>(
    (rows, chosen, threads): (StampRows, &[usize], &impl Threads),
    mut read: impl FnMut(usize) -> Result<R, E>,
    survey: impl Fn(&R, Range<usize>) -> Result<L, E> + Send + Sync,
    mut join: impl FnMut(L) -> Result<ControlFlow<()>, E>,
) -> Result<(), E> {
    let together = threads.count().max(1);
    for some in chosen.chunks(together) {
        let read: Vec<(R, usize)> = some
            .iter()
            .map(|&row| Ok((read(row)?, rows.stamps(row).len())))
            .collect::<Result<_, E>>()?;
        let parts = together.div_ceil(read.len());
        let jobs = read.iter().flat_map(|(row, count)| {
            let size = count.div_ceil(parts);
            let starts = (0..*count).step_by(size.max(1));
            starts.map(move |start| (row, start..(start + size).min(*count)))
        });
        for found in threads.map(jobs.collect(), |(row, range)| survey(row, range)) {
            if join(found?)?.is_break() {
                return Ok(());
            }
        }
    }
    Ok(())
}

impl Measurer {
    /// Measures stamps `[galaxy, y, x]`. `noise` is σ of white noise; without it, it is measured on the stamps as `noise.source`
    /// says, or refused if that is `"header"`. Ellipticities are to be divided by the mean response, which several thousand galaxies determine to 1 %.
    ///
    /// A galaxy with pixels that are not finite (under a linear method: too many), or with an unusable PSF among PSFs
    /// per galaxy, is flagged.
    ///
    /// # Errors
    /// If shapes do not match, `noise` is not a finite number of zero or more, or the PSF of all stamps cannot be used.
    pub fn batch<T: Pixel>(
        &self,
        stamps: ArrayView3<'_, T>,
        psfs: &Psfs<'_>,
        noise: Option<f64>,
    ) -> Result<Batch, MeasureError> {
        let mut source = ArraySource::new(self, stamps, psfs)?;
        let noise = noise.map_or(KnownNoise::Unknown, KnownNoise::Given);
        self.measure_image(&mut source, noise, &OneThread)?
            .checked()
    }

    /// Measures an image of any source, whose stamps `threads` survey and this thread measures.
    ///
    /// # Errors
    /// As [`Session::open`], [`Session::read`] and [`RowJob::measure_row`].
    pub fn measure_image<'n, S: StampSource<'n>>(
        &self,
        source: &mut S,
        noise: KnownNoise<'n>,
        threads: &impl Threads,
    ) -> Result<Batch, S::Error> {
        let session = Arc::new(Session::open(self, source, noise, threads)?);
        let mut image = Arc::clone(&session).begin()?;
        let mut worker = self.worker();
        for row in 0..session.rows().len() {
            image.add(session.read(source, row)?.measure_row(&mut worker)?);
        }
        Ok(image.finish())
    }
}

#[cfg(test)]
mod tests;
