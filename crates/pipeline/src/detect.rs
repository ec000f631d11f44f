//! Detecting galaxies on exposures, with the response of the detection.
//!
//! Rows of tiles are read one after the other and detected in threads. Tiles depend on the exposure alone, so that the detections
//! are the same for any number of threads, and memory does not grow with the height of an exposure.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use ndarray::{Array2, ArrayView2};
use shearq_dataset::fingerprint::{Fingerprint, GALAXIES, PSF, of_image};
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::metadata::{CATALOGUE_FIRST_PIXEL, CATALOGUE_FRAME, frame_entry};
use shearq_dataset::run::{Run, Source};
use shearq_dataset::threads::Progress;
pub use shearq_detection::MAX_EPOCHS;
use shearq_detection::{
    Cells, DetectedPixel, Detection, Detections, Detector, Epoch, EpochCells, EpochDetector, Patch,
    Tile,
};
use shearq_files::FileError;
use shearq_files::frames::polars::{Column, DataFrame, PolarsResult};
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat, Place};
use shearq_measure::parts::{gaussian_sigma, significant};
use shearq_measure::{
    EXAMINED_PSFS, Examination, MeasureError, NoisePlan, PixelFrame, StampNoise, Threads as _,
};
use shearq_quantities::statistics::upper_median;
use shearq_quantities::{Frame, Jacobian};
use shearq_submissions::{
    Configuration, DetectionMethod, Method, NoiseSource, Psf, PsfForm, Stamp,
};

use crate::PipelineError;
use crate::engine;
use crate::gather::{
    Chip, Exposure, Files, Masks, Origin, PlaneReader, PsfModel, another, lose, truncation,
};
use crate::measure::metadata;
use crate::wcs::{Wcs, aligned};

/// An exposure with its PSF.
#[derive(Debug, Clone, Copy)]
pub struct EpochFiles<'a> {
    pub exposure: Files<'a>,
    /// A stamp of the star, at its centre, or a model of the PSF by position.
    pub psf: Files<'a>,
    pub masks: Option<Masks<'a>>,
    /// Standard deviation of a pixel; that of the header key NOISESIG, or measured with its correlation, if `None`.
    pub noise: Option<f64>,
}

/// Exposures of one sky to detect galaxies on, those on the pixels of the first one.
#[derive(Debug, Clone)]
pub struct DetectionTask<'a> {
    /// At least one, and at most [`MAX_EPOCHS`].
    pub epochs: Vec<EpochFiles<'a>>,
    /// The axes of ellipticities; the sky's if the WCS has other axes than the pixels, unless it is given.
    pub frame: Option<Frame>,
    pub settings: DetectionMethod,
}

// In a catalogue's metadata: the number of several exposures, the standard deviation of a pixel of each and where it is from, the
// fingerprint of the masks, and the bits that make a pixel missing.
const EPOCHS: &str = "epochs";
const NOISE: &str = "noise";
const NOISE_SOURCE: &str = "noisesource";
const MASK: &str = "mask";
const MASK_BITS: &str = "maskbits";
// The source of a noise that neither the user nor the header states.
const MEASURED: &str = "measured";

// The noise of an exposure, where it is from, and the measured one.
struct NoiseLevel {
    noise: StampNoise,
    source: &'static str,
    measured: Option<StampNoise>,
}

/// What was found on an exposure.
#[derive(Debug, Clone)]
pub struct Detected {
    pub detections: usize,
    /// Σ w.
    pub weight: f64,
    /// Pixels from an edge or a missing pixel within which there is no detection.
    pub margin: usize,
    /// Parts of the exposure, each with the PSF at its middle; 1 if it does not vary.
    pub cells: usize,
    /// Standard deviation of a pixel of each exposure, and whether one was measured.
    pub noise: Vec<f64>,
    pub is_measured: bool,
    pub frame: Frame,
    pub missing: usize,
    /// Pixels that hold no light, beside those that are missing.
    pub unlit: usize,
    /// What is doubtful about the exposure and its PSF.
    pub doubts: Vec<String>,
}

// Sky in units of the noise of a pixel. Undetected galaxies of 75 and 150 per arcmin² raise the median of simulated exposures by 0.06 and 0.13.
const MAX_SKY: f64 = 0.3;
// Difference of the sky between parts of an exposure, in units of the noise of a pixel. Of 0.4 σ (a gradient of 0.5 σ across), m changes by less
// than its error, and a step of 1 σ has nine times as many detections as without.
const MAX_SKY_DIFFERENCE: f64 = 0.4;
// Parts along each side of an exposure. Chosen by hand.
const SKY_PARTS: usize = 4;
// Fewest pixels of a part: their median has an error of 0.03 σ.
const MIN_SKY_PIXELS: usize = 2000;
// Share by which a noise that is given may differ from the measured one. Undetected galaxies of 300 per arcmin² raise that by 1 %.
const MAX_NOISE_DIFFERENCE: f64 = 0.05;
// Most pixels that tell the sky of an exposure; those of the grid below are fewer.
const SAMPLE: usize = 4_000_000;

// Correlation of neighbouring pixels above which noise is not white. Undetected galaxies of 300 per arcmin² look like 0.04.
const MAX_CORRELATION: f64 = 0.05;
// The same of pixels that are as far apart as a correlation is measured.
const MAX_FAR_CORRELATION: f64 = 0.1;
// Pixels a side of a PSF over the σ of the Gaussian with its noise-equivalent area: without wings beyond 4.2 and 6.3 σ from the middle, m changes by +9 and +0.7
// (10⁻³), behind a Moffat profile of β = 3.
const MIN_PSF_SIGMAS: f64 = 12.0;

fn is_correlated(measured: &StampNoise) -> bool {
    measured.correlation_along(1).abs() > MAX_CORRELATION
}

/// Noise of a stated level, with the correlation that was measured if pixels are clearly correlated.
pub fn noise_of_level(sigma: f64, measured: Option<&StampNoise>) -> StampNoise {
    let clearly = measured.filter(|own| is_correlated(own));
    clearly.map_or_else(|| StampNoise::white(sigma), |own| own.at_level(sigma))
}

// What is doubtful about the noise of an exposure, which was `measured`, too.
fn doubts_of_noise(noise: &StampNoise, measured: &StampNoise) -> Vec<String> {
    let [near, far] = [1, MAX_LAG as i32].map(|lag| measured.correlation_along(lag));
    if far.abs() > MAX_FAR_CORRELATION {
        return vec![format!(
            "the noise is correlated over more than {MAX_LAG} px (found {far:.2} at {MAX_LAG} px, expected 0), so that its level and the responses are wrong. Try: the image before it was smoothed or resampled"
        )];
    }
    let mut doubts = Vec::new();
    let (stated, own) = (noise.sigma(), measured.sigma());
    if (own / stated - 1.0).abs() > MAX_NOISE_DIFFERENCE {
        let [stated, own] = [stated, own].map(|level| significant(level, 4));
        doubts.push(format!(
            "the noise is stated as {stated}, and measured as {own}: responses depend on it. Try: {own}"
        ));
    }
    if is_correlated(measured) {
        doubts.push(format!(
            "pixels of the noise are correlated (found {near:.2} between neighbours, expected 0), as was measured and is used. Try: the image before it was resampled"
        ));
    }
    doubts
}

/// What is doubtful about the PSFs of cells, the sky of an exposure, and its noise, which was `measured`, too.
pub fn doubts(
    stars: &[Array2<f64>],
    sky: Option<SkyLevel>,
    noise: &StampNoise,
    measured: Option<&StampNoise>,
) -> Vec<String> {
    let mut psf = Examination::new(stars[0].nrows(), 0);
    for star in stars.iter().step_by(stars.len().div_ceil(EXAMINED_PSFS)) {
        psf.add_psf((star / star.sum()).view(), None);
    }
    let mut doubts: Vec<String> = psf.warnings().iter().map(ToString::to_string).collect();
    let side = stars[0].nrows() as f64;
    let sigma = stars.iter().map(|star| gaussian_sigma(star.view()));
    let least = MIN_PSF_SIGMAS * sigma.fold(0.0, f64::max);
    if side < least {
        doubts.push(format!(
            "the PSF has {side} pixels a side (expected {least:.0} or more), and no wings beyond them, which biases m. Try: a larger stamp of the PSF"
        ));
    }
    doubts.extend(sky.and_then(|sky| sky.doubts(noise.sigma())));
    doubts.extend(
        measured
            .into_iter()
            .flat_map(|own| doubts_of_noise(noise, own)),
    );
    doubts
}

/// Medians of pixels of an exposure.
#[derive(Debug, Clone, Copy)]
pub struct SkyLevel {
    median: f64,
    /// Second darkest and second brightest median of parts of the exposure: one may contain a large galaxy.
    of_parts: Option<[f64; 2]>,
}

impl SkyLevel {
    /// From some of `count` pixels, with their places in units of the sides of the exposure; `None` if all are missing.
    pub fn of(count: usize, pixel: impl Fn(usize) -> ([f64; 2], f32)) -> Option<Self> {
        let every = count.div_ceil(SAMPLE).max(1);
        let pixels = (0..count).step_by(every).map(pixel);
        let mut parts = vec![Vec::new(); SKY_PARTS * SKY_PARTS];
        for (place, value) in pixels.filter(|(_, own)| own.is_finite()) {
            let [x, y] = place.map(|at| ((SKY_PARTS as f64 * at) as usize).min(SKY_PARTS - 1));
            parts[y * SKY_PARTS + x].push(f64::from(value));
        }
        let median = upper_median(&mut parts.concat())?;
        let large = parts.iter_mut().filter(|part| part.len() >= MIN_SKY_PIXELS);
        let mut medians: Vec<f64> = large.filter_map(|part| upper_median(part)).collect();
        medians.sort_by(f64::total_cmp);
        let of_parts = match medians[..] {
            [_, low, .., high, _] => Some([low, high]),
            _ => None,
        };
        Some(SkyLevel { median, of_parts })
    }

    fn doubts(self, noise: f64) -> Option<String> {
        let SkyLevel { median, of_parts } = self;
        if median.abs() > MAX_SKY * noise {
            let sigmas = median / noise;
            return Some(format!(
                "the median of the exposure is {median:.4}, {sigmas:.1} σ of its noise (expected 0): a sky counts as light. Try: subtract the sky first"
            ));
        }
        let [low, high] = of_parts.filter(|[low, high]| high - low > MAX_SKY_DIFFERENCE * noise)?;
        Some(format!(
            "the sky differs between parts of the exposure (found medians from {:+.2} to {:+.2} σ of the noise; expected 0): brighter parts count as light, and more is detected there. Try: subtract the sky of each amplifier, or a smooth model of it",
            low / noise,
            high / noise
        ))
    }
}

/// What is said of pixels that hold no light.
pub fn unlit_in_words(count: usize) -> Option<String> {
    let pixels = match count {
        0 => return None,
        1 => "1 pixel holds".to_owned(),
        count => format!("{count} pixels hold"),
    };
    Some(format!(
        "{pixels} no light (expected a mask for cosmic rays and defects). They count as missing, and fainter ones may be left: columns and trails are not looked for"
    ))
}

/// Detects galaxies on an exposure, and counts the pixels that hold no light. `open` is called in another thread and
/// returns a function that reads a number of rows. Progress is in pixels.
pub fn detect_rows<R: FnMut(usize) -> Result<Vec<f32>, PipelineError>>(
    threads: usize,
    cells: &Cells,
    [width, height]: [usize; 2],
    open: impl FnOnce() -> Result<R, PipelineError> + Send,
    progress: &mut dyn Progress,
) -> Result<(Vec<Detection>, usize), PipelineError> {
    let shared = cells.shared();
    let least = 2 * shared.margin() + 1;
    if width.min(height) < least {
        return Err(MeasureError::Shape {
            what: "the exposure",
            found: format!("{width} × {height} pixels"),
            expected: format!(
                "{least} or more along both axes, for nothing is detected near its edges. Try: exchange exposure and PSF, or a smaller stamp of the PSF if its wings are noise"
            ),
        }
        .into());
    }
    let (mut rows, mut unlit) = (Rows::new([width, height], shared), 0);
    engine::ordered(
        threads,
        |feeder| {
            let mut bands = Bands::new(width, height, open()?);
            let mut detectors: Vec<Arc<Detector>> = Vec::new();
            for number in 0..height.div_ceil(shared.rows_per_tile()) {
                if let Some(row) = cells.grid().beginning(number) {
                    detectors = feeder
                        .ahead()
                        .map(row.collect(), |cell| cells.detector(cell));
                }
                let tiles: Vec<Tile> = shared.tiles(width, number).collect();
                let band = Arc::new(bands.of(&tiles[0])?);
                for (at, tile) in tiles.iter().enumerate() {
                    let detector = Arc::clone(&detectors[cells.grid().column(at)]);
                    let job = (Arc::clone(&band), detector, *tile, at + 1 == tiles.len());
                    if !feeder.push(job) {
                        return Ok(());
                    }
                }
            }
            Ok(())
        },
        || (shared.scratch(), Vec::new()),
        |(scratch, pixels), (band, detector, tile, is_last)| {
            copy_tile(&band, width, &tile, pixels);
            let [columns, rows] = tile.sides;
            let unlit = detector.remove_unlit(pixels, scratch);
            let view = ArrayView2::from_shape((rows, columns), pixels).expect("as many as copied");
            let mut found = Vec::new();
            detector.detect(&tile, view, scratch, &mut found)?;
            Ok((found, unlit, is_last))
        },
        |(pixels, of_tile, is_last)| {
            unlit += of_tile;
            rows.add(pixels, is_last, progress);
            Ok(())
        },
    )?;
    Ok((rows.found.finish(), unlit))
}

/// Detects galaxies on several exposures of one sky. Returns the numbers of pixels that are missing, and of those that hold no light, too.
/// `open` is called in another thread and returns a function that reads the pixels of a patch. Progress is in pixels.
pub fn detect_epochs<R: FnMut(&Patch) -> Result<Vec<f32>, PipelineError>>(
    threads: usize,
    cells: &EpochCells,
    sides: [usize; 2],
    open: impl FnOnce() -> Result<R, PipelineError> + Send,
    progress: &mut dyn Progress,
) -> Result<(Vec<Detection>, [usize; 2]), PipelineError> {
    let (mut rows, mut lost) = (Rows::new(sides, cells.shared()), [0; 2]);
    engine::ordered(
        threads,
        |feeder| {
            let mut read = open()?;
            let mut detectors: Vec<Arc<EpochDetector>> = Vec::new();
            let [columns, rows] = cells.tiles();
            for tile in (0..rows).flat_map(|y| (0..columns).map(move |x| [x, y])) {
                if let Some(row) = cells.grid().beginning(tile[1]).filter(|_| tile[0] == 0) {
                    let ahead = feeder.ahead();
                    detectors = ahead.map(row.collect(), |cell| cells.detector(cell));
                }
                let patches = cells.patches(tile).into_iter();
                let read = patches.map(|patch| Ok((patch, read(&patch)?)));
                let patches = read.collect::<Result<Vec<_>, PipelineError>>()?;
                let detector = Arc::clone(&detectors[cells.grid().column(tile[0])]);
                if !feeder.push((detector, tile, patches, tile[0] + 1 == columns)) {
                    return Ok(());
                }
            }
            Ok(())
        },
        || cells.scratch(),
        |scratch, (detector, tile, mut patches, is_last)| {
            let mut found = Vec::new();
            let lost = cells.detect(&detector, tile, &mut patches, scratch, &mut found);
            Ok((found, lost, is_last))
        },
        |(pixels, of_tile, is_last)| {
            lost = [0, 1].map(|k| lost[k] + of_tile[k]);
            rows.add(pixels, is_last, progress);
            Ok(())
        },
    )?;
    Ok((rows.found.finish(), lost))
}

/// The detections of rows of tiles.
struct Rows {
    found: Detections,
    of_row: Vec<DetectedPixel>,
    width: usize,
    /// Rows that are left, and those of a row of tiles.
    left: usize,
    per_tile: usize,
}

impl Rows {
    fn new([width, height]: [usize; 2], shared: &Detector) -> Self {
        Rows {
            found: Detections::default(),
            of_row: Vec::new(),
            width,
            left: height,
            per_tile: shared.rows_per_tile(),
        }
    }

    // Adds the pixels of a tile, of which the last one completes a row.
    fn add(&mut self, pixels: Vec<DetectedPixel>, is_last: bool, progress: &mut dyn Progress) {
        self.of_row.extend(pixels);
        if is_last {
            self.of_row
                .sort_unstable_by_key(|pixel| [pixel.place[1], pixel.place[0]]);
            for pixel in self.of_row.drain(..) {
                self.found.add(&pixel);
            }
            let rows = self.per_tile.min(self.left);
            self.left -= rows;
            progress.advance((rows * self.width) as u64);
        }
    }
}

/// Rows of an exposure that overlap.
struct Bands<R> {
    width: usize,
    height: usize,
    read: R,
    /// Rows that were read, and those among them that a later band needs.
    next: usize,
    rest: Vec<f32>,
}

impl<R: FnMut(usize) -> Result<Vec<f32>, PipelineError>> Bands<R> {
    fn new(width: usize, height: usize, read: R) -> Self {
        Bands {
            width,
            height,
            read,
            next: 0,
            rest: Vec::new(),
        }
    }

    /// The rows of a tile, each over the whole width; NaN beyond the exposure. Tiles come in order.
    fn of(&mut self, tile: &Tile) -> Result<Vec<f32>, PipelineError> {
        let (width, rows) = (self.width, tile.sides[1]);
        let start = tile.origin[1];
        let end = (start + rows as i64).clamp(0, self.height as i64) as usize;
        let kept = self.next - self.rest.len() / width;
        let mut band = vec![f32::NAN; start.min(0).unsigned_abs() as usize * width];
        let first = start.max(0) as usize;
        band.extend_from_slice(&self.rest[(first - kept) * width..]);
        if end > self.next {
            band.extend((self.read)(end - self.next)?);
            self.next = end;
        }
        let beyond = band.len().min((-start).max(0) as usize * width);
        self.rest = band[beyond..].to_vec();
        band.resize(rows * width, f32::NAN);
        Ok(band)
    }
}

// The columns of a tile from the rows of its band.
fn copy_tile(band: &[f32], width: usize, tile: &Tile, to: &mut Vec<f32>) {
    to.clear();
    let columns = tile.sides[0];
    let start = tile.origin[0];
    let inside = |at: i64| at.clamp(0, width as i64) as usize;
    let (first, last) = (inside(start), inside(start + columns as i64));
    for row in band.chunks_exact(width) {
        let end = to.len() + columns;
        to.resize(to.len() + start.min(0).unsigned_abs() as usize, f32::NAN);
        to.extend_from_slice(&row[first..last]);
        to.resize(end, f32::NAN);
    }
}

/// An exposure whose noise is known.
struct Opened<'a> {
    files: EpochFiles<'a>,
    origin: Origin<'a>,
    sides: [usize; 2],
    wcs: Wcs,
    /// Stamps of a grid.
    sample: Vec<f32>,
    level: NoiseLevel,
}

/// The pixels of an exposure, NaN where they are missing.
struct Pixels<'a> {
    exposure: Exposure<'a>,
    mask: Option<(Exposure<'a>, Option<u64>)>,
}

impl Pixels<'_> {
    fn rows(&mut self, count: usize) -> Result<Vec<f32>, FileError> {
        let mut pixels = self.exposure.rows(count)?;
        if let Some((map, bits)) = &mut self.mask {
            let values: Vec<f64> = map.rows(count)?;
            lose(&mut pixels, &values, *bits, &map.origin)?;
        }
        Ok(pixels)
    }

    fn square(&mut self, origin: [i64; 2], side: usize) -> Result<Vec<f32>, FileError> {
        let mut pixels = self.exposure.square_from(origin, side)?;
        if let Some((map, bits)) = &mut self.mask {
            let values: Vec<f64> = map.square_from(origin, side)?;
            lose(&mut pixels, &values, *bits, &map.origin)?;
        }
        Ok(pixels)
    }
}

/// The PSF of an exposure.
enum ExposurePsf {
    Constant(Array2<f64>),
    Model(PsfModel),
}

/// The detectors of one exposure, or of several.
enum Search {
    One(Cells),
    Epochs(EpochCells),
}

impl Search {
    // Draws stars of models with what is doubtful about these.
    fn of(
        opened: &[Opened<'_>],
        jacobian: Option<&Jacobian>,
        settings: &DetectionMethod,
    ) -> Result<(Self, Vec<Option<String>>), PipelineError> {
        let psfs = opened.iter().map(|own| own.files.psf(&own.wcs));
        let psfs = psfs.collect::<Result<Vec<_>, FileError>>()?;
        let doubts: Vec<RefCell<Option<String>>> =
            opened.iter().map(|_| RefCell::default()).collect();
        let stars = &|at: usize, places: &[(f64, f64)]| match &psfs[at] {
            ExposurePsf::Constant(star) => Ok(vec![star.clone(); places.len()]),
            ExposurePsf::Model(model) => {
                let framed = model.framed(places);
                let warning = framed.and_then(|(psf, fine)| truncation(&psf, fine));
                doubts[at].replace(warning.map(|warning| warning.to_string()));
                let (path, scale) = (&opened[at].files.psf.paths[0], opened[at].wcs.scale());
                Ok::<_, PipelineError>(model.stars(path, places, scale)?)
            }
        };
        let first = &opened[0];
        let search = match (opened, &psfs[0]) {
            ([one], ExposurePsf::Constant(star)) => {
                let cells = Cells::constant(star.clone(), &one.level.noise, jacobian, settings);
                Search::One(cells.map_err(|error| one.fault(error))?)
            }
            ([one], ExposurePsf::Model(_)) => {
                let stars = |places: &[(f64, f64)]| stars(0, places);
                let cells = Cells::varying(one.sides, &one.level.noise, jacobian, settings, stars);
                Search::One(cells.map_err(|error| match error {
                    PipelineError::Measure(error) => one.fault(error),
                    other => other,
                })?)
            }
            _ => {
                let mut epochs = Vec::new();
                for (at, own) in opened.iter().enumerate() {
                    epochs.push(Epoch {
                        sides: own.sides,
                        noise: own.level.noise.clone(),
                        stars: Box::new(move |places| stars(at, places)),
                        is_constant: matches!(psfs[at], ExposurePsf::Constant(_)),
                        places: Box::new(|places| {
                            let place = |place: &[f64; 2]| own.wcs.place_of(&first.wcs, *place);
                            Ok(places.iter().map(place).collect())
                        }),
                        fault: Box::new(|error| own.fault(error)),
                    });
                }
                Search::Epochs(EpochCells::new(epochs, jacobian, settings)?)
            }
        };
        Ok((
            search,
            doubts.into_iter().map(RefCell::into_inner).collect(),
        ))
    }

    fn shared(&self) -> &Detector {
        match self {
            Search::One(cells) => cells.shared(),
            Search::Epochs(cells) => cells.shared(),
        }
    }

    fn cells(&self) -> usize {
        match self {
            Search::One(cells) => cells.stars().len(),
            Search::Epochs(cells) => cells.count(),
        }
    }

    // The stars of an exposure.
    fn stars(&self, at: usize) -> &[Array2<f64>] {
        match self {
            Search::One(cells) => cells.stars(),
            Search::Epochs(cells) => cells.stars(at),
        }
    }

    // Detections, and numbers of pixels that are missing and that hold no light.
    fn run(
        &self,
        threads: usize,
        opened: &[Opened<'_>],
        progress: &mut dyn Progress,
    ) -> Result<(Vec<Detection>, [usize; 2]), PipelineError> {
        let sides = opened[0].sides;
        match self {
            Search::One(cells) => {
                let missing = AtomicUsize::new(0);
                let open = || {
                    let mut reader = opened[0].files.pixels()?;
                    let missing = &missing;
                    Ok(move |rows: usize| {
                        let pixels = reader.rows(rows)?;
                        let lost = pixels.iter().filter(|pixel| !pixel.is_finite()).count();
                        missing.fetch_add(lost, Ordering::Relaxed);
                        Ok(pixels)
                    })
                };
                let (found, unlit) = detect_rows(threads, cells, sides, open, progress)?;
                Ok((found, [missing.into_inner(), unlit]))
            }
            Search::Epochs(cells) => {
                let files: Vec<EpochFiles<'_>> = opened.iter().map(|own| own.files).collect();
                let open = move || {
                    let readers = files.iter().map(|own| own.pixels());
                    let mut readers = readers.collect::<Result<Vec<_>, PipelineError>>()?;
                    Ok(move |patch: &Patch| {
                        Ok(readers[patch.epoch].square(patch.origin, patch.side)?)
                    })
                };
                detect_epochs(threads, cells, sides, open, progress)
            }
        }
    }
}

impl Opened<'_> {
    // An error of the exposure or its PSF.
    fn fault(&self, error: MeasureError) -> PipelineError {
        match error {
            MeasureError::Noise(_) => self.origin.fault(&error.to_string()).into(),
            _ => FileError::with_hint(&self.files.psf.paths[0], &error, error.hint()).into(),
        }
    }

    fn doubts(&self, stars: &[Array2<f64>], of_model: Option<String>) -> Vec<String> {
        let [per_row, rows] = self.sides.map(|side| grid(side).count());
        let sky = SkyLevel::of(self.sample.len(), |at| {
            let stamp = at / STAMP_PIXELS;
            let [x, y] = [stamp % per_row, stamp / per_row].map(|at| at as f64);
            ([x / per_row as f64, y / rows as f64], self.sample[at])
        });
        let level = &self.level;
        let mut doubts = doubts(stars, sky, &level.noise, level.measured.as_ref());
        doubts.extend(of_model);
        doubts.extend(self.wcs.doubts().iter().cloned());
        doubts
    }
}

impl DetectionTask<'_> {
    /// The record of catalogues in the folder `out`.
    pub fn run(&self, out: &Path, format: FileFormat) -> Result<Run, FileError> {
        let exposure = Place::of(&self.epochs[0].exposure.paths[0]).path;
        let folder = match exposure.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
            _ => PathBuf::from("."),
        };
        let configuration = Configuration {
            name: "detection".into(),
            description: "Detection on exposures with its response in closed form".into(),
            // Those of the detector's squares and stars, which follow the PSF.
            stamp: Stamp { size: 48 },
            psf: Psf {
                form: PsfForm::Star,
                size: 48,
            },
            noise: NoiseSource::Header,
            method: Method::Detection {
                detection: self.settings,
            },
        };
        let source = Source::folder(&DataFolder::new(folder), out)?;
        Ok(Run::new(source, configuration, format))
    }

    /// Writes the catalogue `id` of a run into the folder `out`.
    ///
    /// # Errors
    /// If a file cannot be read, the noise is not known, or the catalogue cannot be written.
    pub fn write_catalogue(
        &self,
        run: &Run,
        out: &Path,
        id: ImageId,
        threads: usize,
        start: impl FnOnce(u64) -> Box<dyn Progress>,
    ) -> Result<Detected, PipelineError> {
        let opened = self.epochs.iter().map(|files| files.open());
        let opened = opened.collect::<Result<Vec<_>, PipelineError>>()?;
        refuse_copies(&opened)?;
        let jacobian = self.check_axes(&opened)?;
        let path = run.catalogue(out, id.set, id.image);
        let first = &opened[0];
        let (sides, origin) = (first.sides, first.origin);
        let (search, of_models) = Search::of(&opened, jacobian.as_ref(), &self.settings)?;
        let print = self.print(|own| own.exposure.paths.first())?;
        refuse_other(&path, run.format, print.as_deref().unwrap_or_default())?;
        let mut progress = start((sides[0] * sides[1]) as u64);
        let found = search.run(threads, &opened, progress.as_mut());
        drop(progress);
        let (found, [missing, unlit]) = found.map_err(|error| match error {
            PipelineError::Measure(error) => origin.fault(&error.to_string()).into(),
            other => other,
        })?;
        if found.is_empty() {
            let count = |own: &Opened<'_>| own.sides[0] * own.sides[1];
            let fault = match missing == opened.iter().map(count).sum::<usize>() {
                true => origin.fault("all pixels are missing (expected a few)"),
                false => (origin.fault("no galaxy was detected (expected some)"))
                    .hint("a lower --threshold, or check --noise"),
            };
            return Err(fault.into());
        }
        let frame = jacobian.map_or(Frame::Pixel, |_| Frame::Sky);
        // Not before: a folder that a failed detection has claimed would refuse its remedies.
        let _claim = run.claim(out)?;
        let columns = self::columns(&found, &first.wcs);
        let columns = columns.map_err(|error| FileError::new(&path, error))?;
        let metadata = self.metadata((run, id), print, &opened, frame)?;
        table::write(&path, run.format, &columns, &metadata)?;
        let mut doubts = Vec::new();
        for ((at, own), of_model) in opened.iter().enumerate().zip(of_models) {
            let path = own.files.exposure.paths[0].display();
            let named = |doubt| match opened.len() {
                1 => doubt,
                _ => format!("{path}: {doubt}"),
            };
            let own = own.doubts(search.stars(at), of_model);
            doubts.extend(own.into_iter().map(named));
        }
        doubts.extend(unlit_in_words(unlit));
        let levels = || opened.iter().map(|own| &own.level);
        Ok(Detected {
            detections: found.len(),
            weight: found.iter().map(|own| own.weight).sum(),
            margin: search.shared().margin(),
            cells: search.cells(),
            noise: levels().map(|level| level.noise.sigma()).collect(),
            is_measured: levels().any(|level| level.source == MEASURED),
            frame,
            missing,
            doubts,
            unlit,
        })
    }

    // The axes of ellipticities, if they are not those of the pixels. Refuses exposures that these and their places need and do not have.
    fn check_axes(&self, opened: &[Opened<'_>]) -> Result<Option<Jacobian>, FileError> {
        let first = &opened[0];
        let fault = |own: &Opened<'_>| Some(own.origin.fault(&own.wcs.fault()?));
        if let Some(fault) = fault(first).filter(|_| self.frame == Some(Frame::Sky)) {
            return Err(fault);
        }
        let jacobian = self.jacobian(first)?;
        if let Some(fault) = fault(first).filter(|_| jacobian.is_some()) {
            return Err(fault.hint("--frame pixel"));
        }
        for own in opened.iter().filter(|_| opened.len() > 1) {
            if let Some(fault) = fault(own) {
                return Err(fault);
            }
            if !own.wcs.has_sky() {
                let message = "there is no celestial WCS (expected one of each of several exposures, by which their pixels have places on the sky)";
                return Err(own.origin.fault(message));
            }
        }
        Ok(jacobian)
    }

    // The fingerprint of a file, or of those of all exposures: the header of a FITS file has no room for one of each.
    fn print(
        &self,
        file: impl for<'e> Fn(&'e EpochFiles<'_>) -> Option<&'e PathBuf>,
    ) -> Result<Option<String>, FileError> {
        let files: Vec<Option<&PathBuf>> = self.epochs.iter().map(file).collect();
        if let [one] = files[..] {
            let print = one.map(|file| of_image(&Place::of(file).path));
            return print.transpose();
        }
        let mut print = Fingerprint::default();
        for (at, file) in files.iter().enumerate() {
            if let Some(file) = file {
                print.add(at.to_le_bytes());
                print.add(of_image(&Place::of(file).path)?);
            }
        }
        let is_known = files.iter().any(Option::is_some);
        Ok(is_known.then(|| print.finish()))
    }

    // What the catalogue states of its exposures.
    fn metadata(
        &self,
        (run, id): (&Run, ImageId),
        of_exposure: Option<String>,
        opened: &[Opened<'_>],
        frame: Frame,
    ) -> Result<Metadata, PipelineError> {
        let of_psf = self.print(|own| own.psf.paths.first())?;
        let of_mask = self.print(|own| own.masks.as_ref()?.files.paths.first())?;
        let prints = [(GALAXIES, of_exposure), (PSF, of_psf), (MASK, of_mask)];
        let prints = prints.into_iter();
        let prints = prints.filter_map(|(key, print)| Some((key.to_owned(), print?)));
        let mut metadata = metadata(run, id, prints.collect())?;
        metadata.insert(CATALOGUE_FIRST_PIXEL.into(), "1".into());
        let levels = || opened.iter().map(|own| &own.level);
        let noise: Vec<String> = levels().map(|own| own.noise.sigma().to_string()).collect();
        let sources: Vec<&str> = levels().map(|own| own.source).collect();
        metadata.insert(NOISE.into(), noise.join(","));
        metadata.insert(NOISE_SOURCE.into(), sources.join(","));
        if opened.len() > 1 {
            metadata.insert(EPOCHS.into(), opened.len().to_string());
        }
        if let Some(bits) = self.epochs[0].masks.and_then(|masks| masks.bits) {
            metadata.insert(MASK_BITS.into(), bits.to_string());
        }
        match (frame, opened[0].wcs.reference()) {
            (Frame::Sky, _) => {
                metadata.insert(CATALOGUE_FRAME.into(), Frame::Sky.to_string());
            }
            (Frame::Pixel, Some(matrix)) => {
                metadata.extend([frame_entry(&PixelFrame::from_jacobian(matrix))]);
            }
            (Frame::Pixel, None) => {}
        }
        Ok(metadata)
    }

    // That of the middle of the first exposure, if ellipticities are to be along the axes of the sky.
    fn jacobian(&self, first: &Opened<'_>) -> Result<Option<Jacobian>, FileError> {
        let middle = first.sides.map(|side| 0.5 * (side as f64 + 1.0));
        let matrix = first.wcs.jacobian(middle);
        let origin = &first.origin;
        let wanted = match (self.frame, &matrix) {
            (Some(Frame::Sky), None) => {
                return Err(origin
                    .fault("there is no WCS (expected one with --frame sky)")
                    .hint("--frame pixel"));
            }
            (Some(frame), _) => frame == Frame::Sky,
            (None, Some(matrix)) => !aligned(matrix),
            (None, None) => false,
        };
        let matrix = matrix.filter(|_| wanted).map(Jacobian::new).transpose();
        matrix.map_err(|error| origin.fault(&error.to_string()))
    }
}

impl<'a> EpochFiles<'a> {
    fn open(&self) -> Result<Opened<'a>, PipelineError> {
        let mut exposure = Exposure::open(self.exposure)?;
        let sides = exposure.sides()?;
        let wcs = exposure.wcs()?;
        let mut pixels = self.pixels()?;
        let sample = sample(sides, |origin| pixels.square(origin, NOISE_STAMP))?;
        Ok(Opened {
            files: *self,
            sides,
            wcs,
            level: self.noise(&mut exposure, &sample)?,
            sample,
            origin: exposure.origin,
        })
    }

    fn noise(
        &self,
        exposure: &mut Exposure<'_>,
        sample: &[f32],
    ) -> Result<NoiseLevel, PipelineError> {
        let (stated, source) = match self.noise {
            Some(noise) => (Some(noise), "given"),
            None => match exposure.number("NOISESIG")? {
                Some(noise) => (Some(noise), "header"),
                None => (None, MEASURED),
            },
        };
        let measured = measured_noise(exposure, sample);
        let known = measured.as_ref().ok().cloned();
        let noise = match stated {
            Some(sigma) => noise_of_level(sigma, known.as_ref()),
            None => measured.map_err(|error| match error {
                PipelineError::Measure(_) => unmeasured(exposure).into(),
                other => other,
            })?,
        };
        Ok(NoiseLevel {
            noise,
            source,
            measured: known,
        })
    }

    fn pixels(&self) -> Result<Pixels<'a>, PipelineError> {
        let mut exposure = Exposure::open(self.exposure)?;
        let mask = match self.masks {
            None => None,
            Some(masks) => {
                let mut map = Exposure::open(masks.files)?;
                map.like(&mut exposure)?;
                another(&map.origin, &exposure.origin, masks.files.content)?;
                Some((map, masks.bits))
            }
        };
        Ok(Pixels { exposure, mask })
    }

    fn psf(&self, wcs: &Wcs) -> Result<ExposurePsf, FileError> {
        Ok(
            match PsfModel::read(&self.psf.paths[0], Chip { at: 0, of: 1 })? {
                Some(model) => ExposurePsf::Model(model),
                None => ExposurePsf::Constant(self.star(wcs)?),
            },
        )
    }

    fn star(&self, wcs: &Wcs) -> Result<Array2<f64>, FileError> {
        let mut planes = PlaneReader::of(self.psf);
        let path = &self.psf.paths[0];
        let Some((origin, pixels)) = planes.next::<f64>()? else {
            return Err(FileError::new(path, "there is no image in this file"));
        };
        let [width, height] = planes.sides();
        if let Some(at) = pixels.iter().position(|value| !value.is_finite()) {
            let (x, y) = (at % width + 1, at / width + 1);
            return Err(origin.fault(&format!(
                "pixel ({x}, {y}) of the PSF is not a finite number"
            )));
        }
        if planes.next::<f64>()?.is_some() {
            return Err(FileError::new(
                path,
                "there are several PSFs (expected one stamp for the exposure)",
            )
            .hint("a model of PSFEx or Piff, if the PSF varies"));
        }
        let of_psf = planes.wcs()?;
        if let Some(fine) = of_psf.oversampling().filter(|fine| *fine != 1.0) {
            let message = format!(
                "the header states {fine} pixels of the PSF along a pixel of the galaxies (expected 1)"
            );
            return Err(FileError::new(path, message).hint("resample the PSF"));
        }
        if let Some(warning) = Wcs::disagreements(&of_psf, wcs).next() {
            return Err(FileError::new(path, warning));
        }
        Array2::from_shape_vec((height, width), pixels).map_err(|error| FileError::new(path, error))
    }
}

// Stamps a side of the grid on which the noise is measured, and their side in pixels. A thousand stamps have an error of the level
// of 10⁻³.
const NOISE_GRID: usize = 32;
const NOISE_STAMP: usize = 48;
const STAMP_PIXELS: usize = NOISE_STAMP * NOISE_STAMP;
// Largest distance of pixels that may be correlated, as `48/linear/star` has it.
const MAX_LAG: usize = 3;

// Noise of epochs is taken as independent.
fn refuse_copies(opened: &[Opened<'_>]) -> Result<(), FileError> {
    // Missing pixels are not numbers.
    fn bits<'o>(own: &'o Opened<'_>) -> impl Iterator<Item = u32> + 'o {
        own.sample.iter().map(|pixel| pixel.to_bits())
    }
    for (at, own) in opened.iter().enumerate() {
        if opened[..at].iter().any(|other| bits(other).eq(bits(own))) {
            let message = "the same pixels as an earlier exposure (expected each exposure once)";
            return Err(own.origin.fault(message));
        }
    }
    Ok(())
}

// Another exposure's catalogue is no earlier result of this one.
fn refuse_other(path: &Path, format: FileFormat, print: &str) -> Result<(), FileError> {
    if !path.exists() {
        return Ok(());
    }
    let key = GALAXIES.to_owned();
    match table::read_metadata(path, format, std::iter::once(&key))?.remove(GALAXIES) {
        Some(own) if own != print => Err(FileError::new(
            path,
            "this catalogue is of another exposure (expected this one's, or none)",
        )
        .hint("another --image, --set or --out")),
        _ => Ok(()),
    }
}

// Places of the stamps of a grid along a side.
fn grid(side: usize) -> impl Iterator<Item = usize> {
    let step = (side / NOISE_GRID).max(NOISE_STAMP);
    (step / 2..side).step_by(step)
}

// Stamps of a grid over an exposure, one after the other. `square` gives the pixels of one from its first pixel on.
fn sample<E>(
    sides: [usize; 2],
    mut square: impl FnMut([i64; 2]) -> Result<Vec<f32>, E>,
) -> Result<Vec<f32>, E> {
    let mut stamps = Vec::new();
    for y in grid(sides[1]) {
        for x in grid(sides[0]) {
            stamps.extend(square(
                [x, y].map(|at| at as i64 - (NOISE_STAMP / 2) as i64),
            )?);
        }
    }
    Ok(stamps)
}

fn unmeasured(exposure: &Exposure<'_>) -> FileError {
    let message =
        "the noise cannot be measured (expected an exposure with blank sky between the galaxies)";
    exposure.origin.fault(message).hint("--noise SIGMA")
}

fn measured_noise(exposure: &Exposure<'_>, stamps: &[f32]) -> Result<StampNoise, PipelineError> {
    Ok(noise_of(stamps)?.ok_or_else(|| unmeasured(exposure))?)
}

/// The pixels of a square of an image (ny, nx) from the column and row `origin` on, NaN beyond the image.
pub fn square_of(image: ArrayView2<'_, f32>, origin: [i64; 2], side: usize) -> Vec<f32> {
    let pixel = |at: usize| {
        let [x, y] = [at % side, at / side].map(|at| at as i64);
        let [Ok(y), Ok(x)] = [y + origin[1], x + origin[0]].map(usize::try_from) else {
            return f32::NAN;
        };
        image.get([y, x]).copied().unwrap_or(f32::NAN)
    };
    (0..side * side).map(pixel).collect()
}

/// The noise of an image (ny, nx), NaN where pixels are missing; `None` if it cannot be measured.
pub fn noise_in(image: ArrayView2<'_, f32>) -> Option<StampNoise> {
    let square = |origin| Ok(square_of(image, origin, NOISE_STAMP));
    let stamps = sample([image.ncols(), image.nrows()], square);
    stamps.and_then(|stamps| noise_of(&stamps)).ok()?
}

// The noise of stamps one after the other; `None` if they do not show it.
fn noise_of(stamps: &[f32]) -> Result<Option<StampNoise>, MeasureError> {
    let mut survey = NoisePlan::new(NOISE_STAMP, MAX_LAG, None)?.survey();
    for stamp in stamps.chunks_exact(STAMP_PIXELS) {
        if let Ok(stamp) = ArrayView2::from_shape((NOISE_STAMP, NOISE_STAMP), stamp) {
            survey.add(stamp)?;
        }
    }
    let found = survey.result()?.map(|found| found.noise);
    Ok(found.map(|found| match found.is_correlated() {
        true => found,
        // What is measured of the correlation of white noise is noise.
        false => StampNoise::white(found.sigma()),
    }))
}

/// A column of catalogues: its name and its values.
pub type DetectionColumn<T> = (&'static str, fn(&Detection) -> T);

/// Columns of catalogues of detections, for the command line and Python: places in FITS pixels, and what follows them. `flags` and
/// `pixels` are whole numbers.
pub const PLACE: [DetectionColumn<f64>; 2] = [
    ("x", |own| own.centre[0] + 1.0),
    ("y", |own| own.centre[1] + 1.0),
];
pub const COLUMNS: [DetectionColumn<f64>; 8] = [
    ("e1", |own| own.e[0]),
    ("e2", |own| own.e[1]),
    ("R11", |own| own.response[0][0]),
    ("R22", |own| own.response[1][1]),
    ("R12", |own| own.response[0][1]),
    ("R21", |own| own.response[1][0]),
    // The weight, which e and R contain, by the name that it has after `select`.
    ("selection", |own| own.weight),
    ("snr", |own| own.snr),
];
pub const WHOLE: [DetectionColumn<i64>; 2] =
    [("flags", |_| 0), ("pixels", |own| own.pixels as i64)];

fn columns(found: &[Detection], wcs: &Wcs) -> PolarsResult<DataFrame> {
    let real = |(name, of): &DetectionColumn<f64>| {
        Column::new((*name).into(), found.iter().map(of).collect::<Vec<f64>>())
    };
    let whole = |(name, of): &DetectionColumn<i64>| {
        Column::new((*name).into(), found.iter().map(of).collect::<Vec<i64>>())
    };
    let mut columns: Vec<Column> = PLACE.iter().map(real).collect();
    if wcs.has_sky() {
        let sky = found.iter().map(|own| {
            let [x, y] = PLACE.map(|(_, of)| of(own));
            wcs.sky([x, y]).unwrap_or([f64::NAN; 2])
        });
        let (ra, dec): (Vec<f64>, Vec<f64>) = sky.map(|[ra, dec]| (ra, dec)).unzip();
        columns.extend([Column::new("ra".into(), ra), Column::new("dec".into(), dec)]);
    }
    columns.extend(COLUMNS.iter().map(real));
    columns.extend(WHOLE.iter().map(whole));
    frame(columns)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_measure::FunctionalPsf;
    use shearq_quantities::{PsfProfile, Shear};

    #[test]
    fn a_sky_that_differs_between_parts_is_named() {
        let words = |sky: &dyn Fn(f64, f64) -> f64| {
            const SIDE: usize = 300;
            let pixel = |at: usize| {
                let [x, y] = [at % SIDE, at / SIDE].map(|at| at as f64 / SIDE as f64);
                // Uniform noise of σ = 1.
                let noise = 12f64.sqrt() * ((at as f64 * 0.618_033_988_75).fract() - 0.5);
                ([x, y], (noise + sky(x, y)) as f32)
            };
            let found = SkyLevel::of(SIDE * SIDE, pixel).and_then(|sky| sky.doubts(1.0));
            found.unwrap_or_default()
        };
        for (sky, expected) in [
            (&(|_, _| 0.0) as &dyn Fn(f64, f64) -> f64, ""),
            (&|x, _| 0.4 * (x - 0.5), ""),
            (&|x, _| 2.0 * (x - 0.5), "the sky differs"),
            (&|_, y| if y < 0.5 { -0.3 } else { 0.3 }, "the sky differs"),
            // A large galaxy.
            (&|x, y| if x < 0.25 && y < 0.25 { 3.0 } else { 0.0 }, ""),
            (&|_, _| 0.5, "the median of the exposure is 0.5"),
        ] {
            let found = words(sky);
            assert!(found.starts_with(expected), "{found}");
            assert_eq!(found.is_empty(), expected.is_empty(), "{found}");
        }
    }

    #[test]
    fn tiles_have_the_pixels_of_the_exposure() {
        let psf = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, 3.5, Shear::ZERO).unwrap();
        let settings = DetectionMethod::default();
        let detector = Detector::new(
            psf.stamp(48).view(),
            &StampNoise::white(1.0),
            None,
            &settings,
        )
        .unwrap();
        let (width, height) = (530, 2 * detector.rows_per_tile() + 9);
        let mut next = 0;
        let read = |rows: usize| {
            let first = next;
            next += rows * width;
            Ok((first..next).map(|at| at as f32).collect())
        };
        let mut bands = Bands::new(width, height, read);
        for number in 0..3 {
            let tiles: Vec<Tile> = detector.tiles(width, number).collect();
            let band = bands.of(&tiles[0]).unwrap();
            let mut pixels = vec![7.0];
            for tile in &tiles {
                copy_tile(&band, width, tile, &mut pixels);
                let [columns, rows] = tile.sides;
                assert_eq!(pixels.len(), columns * rows);
                for (at, pixel) in pixels.iter().enumerate().step_by(97) {
                    let [x, y] = [at % columns, at / columns];
                    let [x, y] = [x as i64 + tile.origin[0], y as i64 + tile.origin[1]];
                    let inside = |at: i64, side| (0..side as i64).contains(&at);
                    match inside(x, width) && inside(y, height) {
                        true => assert_eq!(*pixel, (y * width as i64 + x) as f32, "{x} {y}"),
                        false => assert!(pixel.is_nan(), "{x} {y}"),
                    }
                }
            }
        }
    }

    fn noise_image(sides: [usize; 2]) -> Array2<f32> {
        // Sums of twelve uniform numbers have a variance of one.
        let mut state = 1u64;
        let mut uniform = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        Array2::from_shape_simple_fn(sides, || (0..12).map(|_| uniform()).sum::<f32>() - 6.0)
    }

    fn found_on(image: &Array2<f32>, cells: &Cells) -> (Vec<Detection>, usize) {
        let open = || {
            let mut rows = image.rows().into_iter();
            Ok(move |count: usize| Ok(rows.by_ref().take(count).flatten().copied().collect()))
        };
        let (height, width) = image.dim();
        let mut quiet = shearq_dataset::threads::Quiet;
        detect_rows(2, cells, [width, height], open, &mut quiet).unwrap()
    }

    #[test]
    fn doubts_about_psfs_are_stated_once_with_their_number() {
        let psf = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, 3.5, Shear::ZERO);
        let star = psf.unwrap().stamp(48);
        let with_sky = &star + 3e-4;
        let found = doubts(
            &[star, with_sky.clone(), with_sky],
            None,
            &StampNoise::white(1.0),
            None,
        );
        let [doubt] = &found[..] else {
            panic!("{found:?}")
        };
        assert!(doubt.contains("on 2 of 3 PSFs"), "{doubt}");
    }

    #[test]
    fn noise_that_is_correlated_is_not_taken_as_white() {
        let white = noise_image([700, 700]);
        // The mean of two neighbours along x, and of six, in units of its scatter.
        let mean = |count: usize| {
            let scale = (count as f32).sqrt();
            Array2::from_shape_fn((700, 700 - count), |(y, x)| {
                (0..count).map(|k| white[[y, x + k]]).sum::<f32>() / scale
            })
        };
        let of = |image: &Array2<f32>| {
            let measured = noise_in(image.view()).unwrap();
            let noise = noise_of_level(1.0, Some(&measured));
            let star = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, 3.5, Shear::ZERO);
            let star = star.unwrap().stamp(48);
            (
                noise.correlation_along(1),
                doubts(&[star], None, &noise, Some(&measured)),
            )
        };
        assert_eq!(of(&white), (0.0, Vec::new()));
        let (near, found) = of(&mean(2));
        assert!((near - 0.5).abs() < 0.02, "{near}");
        assert!(
            found[0].contains("found 0.50 between neighbours"),
            "{found:?}"
        );
        let (_, found) = of(&mean(6));
        assert!(
            found[0].contains("correlated over more than 3 px"),
            "{found:?}"
        );
    }

    #[test]
    fn a_psf_without_wings_is_named() {
        let psf = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, 3.5, Shear::ZERO).unwrap();
        let found = |side: usize| doubts(&[psf.stamp(side)], None, &StampNoise::white(1.0), None);
        assert!(
            found(16)
                .iter()
                .any(|own| own.contains("the PSF has 16 pixels a side"))
        );
        assert_eq!(found(24), [""; 0]);
    }

    #[test]
    fn a_galaxy_on_the_border_of_cells_is_one_detection() {
        let sides = [900, 200];
        let star = |(x, _): (f64, f64)| {
            let psf = PsfProfile::Moffat { beta: 3.0 };
            let psf = FunctionalPsf::new(psf, 3.3 + 4e-4 * x, Shear::new(1e-4 * x, 0.0));
            psf.unwrap().stamp(48)
        };
        let settings = DetectionMethod::default();
        let noise = StampNoise::white(1.0);
        let cells = Cells::varying(sides, &noise, None, &settings, |places| {
            Ok::<_, PipelineError>(places.iter().map(|place| star(*place)).collect())
        });
        let cells = cells.unwrap();
        let tiles = cells.shared().tiles(sides[0], 0);
        let at = |column: usize, tile: Tile| (cells.grid().column(column), tile.origin[0]);
        let tiles: Vec<(usize, i64)> = tiles.enumerate().map(|(k, tile)| at(k, tile)).collect();
        let first = tiles.iter().find(|(column, _)| *column == 1).unwrap();
        let border = (first.1 - tiles[0].1) as usize;
        let mut image = noise_image([sides[1], sides[0]]);
        for ((y, x), value) in star((border as f64, 0.0)).indexed_iter() {
            image[[76 + y, border - 24 + x]] += (3000.0 * value) as f32;
        }
        let (found, _) = found_on(&image, &cells);
        let bright: Vec<&Detection> = found.iter().filter(|own| own.snr > 50.0).collect();
        let [one] = bright[..] else {
            panic!("{found:?}")
        };
        assert!(
            (one.centre[0] - (border as f64 - 0.5)).abs() < 0.1,
            "{one:?}"
        );
        assert!(one.pixels > 4, "{one:?}");
    }

    #[test]
    fn defects_are_found_and_stars_are_kept() {
        const SIDE: usize = 400;
        let psf = FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, 3.5, Shear::new(0.05, 0.0));
        let star = psf.unwrap().stamp(48);
        let star = &star / star.sum();
        let mut image = noise_image([SIDE, SIDE]);
        // Stars of S/N 20 to 10⁵.
        for number in 0..16 {
            let flux = 100.0 * 1.8f64.powi(number);
            let [x0, y0] = [number as usize % 4, number as usize / 4].map(|at| 30 + 90 * at);
            for ((y, x), value) in star.indexed_iter() {
                image[[y0 + y, x0 + x]] += (flux * value) as f32;
            }
        }
        let settings = DetectionMethod::default();
        let noise = StampNoise::white(1.0);
        let cells = Cells::constant(star.clone(), &noise, None, &settings).unwrap();
        let unlit = |image: &Array2<f32>| found_on(image, &cells).1;
        assert_eq!(unlit(&image), 0);
        for (at, light) in [(100, 30.0), (210, 100.0), (305, 1e5), (140, -500.0)] {
            image[[at, at + 5]] = light;
        }
        for (y, x) in (0..20).flat_map(|y| (380..SIDE).map(move |x| (y, x))) {
            image[[y, x]] = 0.0;
        }
        // Those at the edge of the area that have no light of their own are no defects.
        assert_eq!(unlit(&image), 4 + 20 * 20);
    }
}
