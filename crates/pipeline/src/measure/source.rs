//! Images of a data folder as sources of stamps, one by one or as epochs of the galaxies of the first.

use std::collections::HashMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ndarray::{Array3, ArrayView2, Axis, Ix3, Slice};
use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_files::open::is_there;
use shearq_files::table::numbers;
use shearq_measure::{
    Detector, FunctionalPsf, KnownNoise, Lazy, LazyStamps, MeasureError, Measurer, Pixels, Psfs,
    Session, StampRows, StampSource, Star, Threads, Warning,
};
use shearq_quantities::Jacobian;
use shearq_submissions::{Configuration, NoiseSource, PsfCut, PsfForm};

use crate::PipelineError;
use crate::stamp_table::{ID, PLACE, StampTable, subpixel_offset};
use crate::wcs::Wcs;
use shearq_dataset::great3::{self, GalaxyCatalogue};
use shearq_dataset::grid::{self, Mosaic, whole};
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{DataFolder, Layout, MAX_STAMP, fill};

// Several rows are in memory at a time: at most 64 MB of pixels each. Chosen by hand.
const MAX_ROW_PIXELS: usize = 1 << 24;

/// An open image with its PSFs. Further epochs are read in the order of the galaxies of the first.
pub struct ImageSource {
    pub(super) path: PathBuf,
    mosaic: Mosaic,
    image: ImageReader,
    psfs: PsfSource,
    noise: KnownNoise<'static>,
    pub(super) table: Option<StampTable>,
    jacobians: Option<Vec<Jacobian>>,
    gain: Option<f64>,
    detector: Detector,
    pub(super) aligned: bool,
    warnings: Vec<Warning>,
    rows: StampRows,
    /// The stamp of each galaxy, if it has one.
    tiles: Vec<Option<usize>>,
    /// Of the galaxies; `None` of a single image, which is measured where its galaxies are.
    offsets: Option<Vec<[f64; 2]>>,
    has_common_flux: bool,
}

impl fmt::Debug for ImageSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ImageSource")
            .field("path", &self.path)
            .field("mosaic", &self.mosaic)
            .finish_non_exhaustive()
    }
}

impl ImageSource {
    /// Opens an image and its PSFs.
    pub fn open(
        data: &DataFolder,
        id: ImageId,
        configuration: &Configuration,
    ) -> Result<Self, PipelineError> {
        let path = data.galaxies(id.set, id.image);
        let (mut image, mosaic) = open_galaxies(data, id)?;
        let stamp = mosaic.stamp;
        // Larger stamps are cut to the size of the configuration; smaller ones have no pixels to fill it with.
        if stamp < configuration.stamp.size {
            return Err(too_small(&path, stamp, configuration).into());
        }
        let stamps = data.stamps(id.set, id.image);
        let table = match data.layout().great3 {
            Some(branch) => Some(StampTable::of_great3(&stamps, id.set, branch, &mosaic)?),
            None => StampTable::read(&stamps, &mosaic)?,
        };
        let jacobians = match &table {
            Some(table) => table.jacobians(&stamps)?,
            None => None,
        };
        let levels = match &table {
            Some(table) => table.noise(&stamps)?,
            None => None,
        };
        let noise = known_noise(&path, &image, configuration, levels)?;
        let OpenPsfs {
            source: psfs,
            moved,
            wcs: psf_wcs,
            stated: stated_by_psf,
        } = open_psfs(data, id, configuration, &mosaic)?;
        let mut warnings: Vec<Warning> = moved.map(Warning::of_moved).into_iter().collect();
        if let (Some(all), PsfSource::Shared(_)) = (&jacobians, &psfs) {
            warnings.extend(Warning::of_shared_psf(all.iter().map(Jacobian::matrix)));
        }
        let wcs = Wcs::of_header(&mut image)?;
        warnings.extend(Wcs::disagreements(&psf_wcs, &wcs));
        let of_pixels = jacobians.is_none().then(|| wcs.frame()).flatten();
        let aligned = jacobians.is_none() && of_pixels.is_none() && wcs.states_axes();
        warnings.extend(of_pixels);
        for (of, stated) in [("galaxies", stated_image(&image)), ("PSF", stated_by_psf)] {
            let expected = [id.set, id.image];
            let other = stated.filter(|stated| *stated != expected);
            warnings.extend(other.map(|stated| Warning::OtherImage {
                of,
                stated,
                expected,
            }));
        }
        Ok(ImageSource {
            path,
            mosaic,
            image,
            psfs,
            noise,
            gain: table.as_ref().and_then(|table| table.head.gain),
            detector: wcs.detector(),
            table,
            jacobians,
            aligned,
            warnings,
            rows: mosaic.stamp_rows(),
            tiles: (0..mosaic.galaxies).map(Some).collect(),
            offsets: None,
            // Exposures of a survey may have a zero point each.
            has_common_flux: data.layout().great3.is_some(),
        })
    }

    pub fn mosaic(&self) -> Mosaic {
        self.mosaic
    }

    /// The session of the image, for a measurer of the configuration that the image was opened for.
    pub fn session(
        &mut self,
        measurer: &Measurer,
        threads: &impl Threads,
    ) -> Result<Session<'static>, PipelineError> {
        let noise = match std::mem::take(&mut self.noise) {
            KnownNoise::StatedEach(levels) => {
                KnownNoise::StatedEach(ordered(&self.tiles, &levels).into())
            }
            other => other,
        };
        let session = Session::open(measurer, self, noise, threads);
        session.map_err(|error| self.named(error))
    }

    pub(super) fn named(&self, error: PipelineError) -> PipelineError {
        match error {
            PipelineError::Measure(error) => about(&self.path)(error).into(),
            other => other,
        }
    }

    fn tiles(&self, row: usize) -> &[Option<usize>] {
        &self.tiles[self.rows.stamps(row)]
    }

    /// Whether a row of galaxies is the same row of the image.
    fn is_whole(&self, row: usize) -> bool {
        let columns = self.mosaic.columns;
        let first = row * columns;
        let mut here = self.tiles(row).iter().enumerate();
        columns == self.rows.columns && here.all(|(k, tile)| *tile == Some(first + k))
    }
}

impl StampSource<'static> for ImageSource {
    type Error = PipelineError;

    fn rows(&self) -> StampRows {
        self.rows
    }

    fn warnings(&self) -> Vec<Warning> {
        self.warnings.clone()
    }

    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'static>, PipelineError> {
        let Mosaic { columns, stamp, .. } = self.mosaic;
        if self.is_whole(row) {
            return Ok(read_row(&mut self.image, self.mosaic, stamp, row)?.into());
        }
        let tiles = &self.tiles[self.rows.stamps(row)];
        Ok(squares(&mut self.image, (columns, stamp), tiles, f64::NAN)?.into())
    }

    fn psfs(&mut self, row: usize) -> Result<Lazy<'static, Psfs<'static>>, PipelineError> {
        let is_whole = self.is_whole(row);
        let tiles = &self.tiles[self.rows.stamps(row)];
        Ok(match &mut self.psfs {
            // Whole rows, which are faster than squares.
            PsfSource::Stars { image, side } if is_whole => {
                Psfs::Stars(read_row(image, self.mosaic, *side, row)?)
            }
            psfs => psfs.of_tiles(self.mosaic.columns, tiles)?,
        }
        .into())
    }

    fn jacobians(&mut self, row: usize) -> Result<Option<Vec<Jacobian>>, PipelineError> {
        let tiles = self.tiles(row);
        let all = self.jacobians.as_ref();
        Ok(all.map(|all| {
            let of = |tile: &Option<usize>| all[tile.unwrap_or(0)];
            tiles.iter().map(of).collect()
        }))
    }

    fn offsets(&mut self, row: usize) -> Result<Option<Vec<[f64; 2]>>, PipelineError> {
        let all = self.offsets.as_ref();
        Ok(all.map(|all| all[self.rows.stamps(row)].to_vec()))
    }

    fn gain(&self) -> Option<f64> {
        self.gain
    }

    fn detector(&self) -> Detector {
        self.detector
    }

    fn has_common_flux(&self) -> bool {
        self.has_common_flux
    }
}

// The noise that the table of stamps or the header states. Levels of single stamps, from a variance map, replace the one of the header.
fn known_noise(
    path: &Path,
    image: &ImageReader,
    configuration: &Configuration,
    levels: Option<Vec<f64>>,
) -> Result<KnownNoise<'static>, FileError> {
    let stated = image.number("NOISESIG")?;
    let is_level = |sigma: f64| sigma > 0.0 && sigma.is_finite();
    match (levels, stated) {
        (Some(levels), _) => Ok(KnownNoise::StatedEach(levels.into())),
        (None, stated)
            if configuration.noise == NoiseSource::Header && !stated.is_some_and(is_level) =>
        {
            let found = stated.map_or("absent".into(), |sigma| sigma.to_string());
            let other = match configuration.linear() {
                Some(_) => "image",
                None => "border",
            };
            let message = format!(
                "the header key NOISESIG is {found}; expected a positive number, which the configuration {} requires",
                configuration.name
            );
            Err(FileError::new(path, message)
                .hint(format!("noise.source = \"{other}\", to measure the noise")))
        }
        (None, Some(sigma)) => Ok(KnownNoise::Stated(sigma)),
        (None, None) => Ok(KnownNoise::Unknown),
    }
}

/// The lines of a settings file by which a configuration measures smaller stamps, of `stamp` pixels a side. Several settings must
/// agree.
pub fn settings_for_small_stamps(stamp: usize, configuration: &Configuration) -> String {
    let mut lines = format!(
        "  extends = \"{}\"\n  stamp.size = {stamp}",
        configuration.name
    );
    if let Some(linear) = configuration.linear() {
        // The linear method requires a window of at most a quarter of the stamp, and a PSF of the same parity. Light of galaxies is
        // lost beyond a window of more than a fifth of it, and one of 3/16 is that of docs/limitations.md.
        if linear.deconvolution.window_sigma > stamp as f64 / 5.0 {
            let window = stamp as f64 * 3.0 / 16.0;
            lines += &format!("\n  deconvolution.window_sigma = {window}");
        }
        if configuration.psf.size % 2 != stamp % 2 {
            lines += &format!("\n  psf.size = {}", configuration.psf.size - 1);
        }
    }
    lines
}

fn about(path: &Path) -> impl Fn(MeasureError) -> FileError {
    move |error| FileError::with_hint(path, &error, error.hint())
}

fn too_small(path: &Path, stamp: usize, configuration: &Configuration) -> FileError {
    let Configuration { name, .. } = configuration;
    let needed = configuration.stamp.size;
    let lines = settings_for_small_stamps(stamp, configuration);
    let message = format!(
        "the stamps are too small for the configuration {name} (found {stamp} px a side, expected {needed} or more)"
    );
    FileError::new(path, message).hint(format!(
        "--submission own.toml, with the file own.toml of these lines:\n{lines}"
    ))
}

/// Opens the galaxies of an image. Their stamps follow from the header, or else from the layout of the data.
pub(crate) fn open_galaxies(
    data: &DataFolder,
    id: ImageId,
) -> Result<(ImageReader, Mosaic), PipelineError> {
    let path = data.galaxies(id.set, id.image);
    let image = ImageReader::open(&path)?;
    let mosaic = grid::of_image(data, &path, &image)?;
    check_strip(&path, mosaic.columns, mosaic.stamp)?;
    Ok((image, mosaic))
}

enum PsfSource {
    Shared(Arc<Star>),
    Stars {
        image: Box<ImageReader>,
        side: usize,
    },
    /// A plane per galaxy, whose number each stamp has.
    Cube {
        image: Box<ImageReader>,
        planes: Vec<usize>,
    },
    Functional(Vec<FunctionalPsf>),
}

impl PsfSource {
    /// PSFs of these stamps, of rows of `columns`; any of a galaxy without a stamp.
    fn of_tiles(
        &mut self,
        columns: usize,
        tiles: &[Option<usize>],
    ) -> Result<Psfs<'static>, FileError> {
        Ok(match self {
            PsfSource::Shared(psf) => Psfs::Prepared(psf.clone()),
            PsfSource::Stars { image, side } => {
                Psfs::Stars(squares(image, (columns, *side), tiles, 0.0)?)
            }
            PsfSource::Cube { image, planes } => {
                let side = image.width();
                Psfs::Stars(stack(side, tiles, 0.0, |tile| {
                    image.rewind();
                    image.skip_rows(planes[tile] * side);
                    image.read_rows_as::<f64>(side)
                })?)
            }
            PsfSource::Functional(field) => {
                let of = |tile: &Option<usize>| -> FunctionalPsf { field[tile.unwrap_or(0)] };
                Psfs::functional(tiles.iter().map(of).collect::<Vec<_>>())
            }
        })
    }
}

// Squares of a mosaic of stamps, `missing` for those that are not there.
fn squares(
    image: &mut ImageReader,
    (columns, side): (usize, usize),
    tiles: &[Option<usize>],
    missing: f64,
) -> Result<Pixels<'static, Ix3>, FileError> {
    stack(side, tiles, missing, |tile| {
        let corner = [tile % columns, tile / columns].map(|at| (at * side) as i64);
        image.read_square::<f64>(corner[0], corner[1], side)
    })
}

fn stack(
    side: usize,
    tiles: &[Option<usize>],
    missing: f64,
    mut read: impl FnMut(usize) -> Result<Vec<f64>, FileError>,
) -> Result<Pixels<'static, Ix3>, FileError> {
    let mut all = Array3::from_elem((tiles.len(), side, side), missing);
    for (tile, mut square) in tiles.iter().zip(all.outer_iter_mut()) {
        let Some(tile) = *tile else { continue };
        square
            .iter_mut()
            .zip(read(tile)?)
            .for_each(|(to, from)| *to = from);
    }
    Ok(Pixels::from(all))
}

struct OpenPsfs {
    source: PsfSource,
    /// Offset of the star for all galaxies in pixels, if it was moved to the centre of its stamp.
    moved: Option<[f64; 2]>,
    wcs: Wcs,
    /// Set and image that the header states.
    stated: Option<[u32; 2]>,
}

fn open_psfs(
    data: &DataFolder,
    id: ImageId,
    configuration: &Configuration,
    mosaic: &Mosaic,
) -> Result<OpenPsfs, FileError> {
    let cut = configuration.psf_cut();
    match configuration.psf.form {
        PsfForm::Functional => {
            let path = data.psf_functional(id.set, id.image);
            if !is_there(&path) && is_there(&data.psf_star(id.set, id.image)) {
                let message = format!(
                    "the table of functional PSFs is missing, which {} needs; the PSFs of this image are stamps",
                    configuration.name
                );
                return Err(FileError::new(&path, message)
                    .hint("a configuration for stamps, such as 48/linear/star"));
            }
            Ok(OpenPsfs {
                source: open_functional(&path, cut, mosaic)?,
                moved: None,
                wcs: Wcs::default(),
                stated: None,
            })
        }
        PsfForm::Star => {
            let path = data.psf_star(id.set, id.image);
            match data.layout() {
                Layout { great3: None, .. } => open_stars(&path, cut, mosaic),
                layout if layout.psf_star == great3::PSF_IMAGES => {
                    open_interpolated(data, id, &path, cut, mosaic)
                }
                _ => open_star_field(data, id, &path, cut),
            }
        }
    }
}

// PSFs that another program interpolated to the galaxies of GREAT3: a mosaic as the galaxies', or a cube in the order of their
// catalogue.
fn open_interpolated(
    data: &DataFolder,
    id: ImageId,
    path: &Path,
    cut: PsfCut,
    mosaic: &Mosaic,
) -> Result<OpenPsfs, FileError> {
    let image = ImageReader::open_stack(path)?;
    let (side, planes) = (image.width(), image.planes());
    if planes == 1 {
        return open_stars(path, cut, mosaic);
    }
    if image.height() != side
        || planes != mosaic.galaxies
        || !(cut.least..=MAX_STAMP).contains(&side)
    {
        let message = format!(
            "the cube has {planes} planes of {side} × {} pixels; expected {}, one per galaxy, of squares of {} to {MAX_STAMP} pixels a side",
            image.height(),
            mosaic.galaxies,
            cut.least
        );
        return Err(FileError::new(path, message));
    }
    check_strip(path, mosaic.columns, side)?;
    let places = GalaxyCatalogue::read(&data.stamps(id.set, id.image))?.places(mosaic)?;
    let mut of_stamps = vec![0; planes];
    for (plane, place) in places.into_iter().enumerate() {
        of_stamps[place] = plane;
    }
    Ok(OpenPsfs {
        source: PsfSource::Cube {
            image: Box::new(image),
            planes: of_stamps,
        },
        moved: None,
        wcs: Wcs::default(),
        stated: None,
    })
}

// The star field of a subfield and epoch of GREAT3.
fn open_star_field(
    data: &DataFolder,
    id: ImageId,
    path: &Path,
    cut: PsfCut,
) -> Result<OpenPsfs, FileError> {
    const ALL: usize = shearq_scoring::great3::STARS_PER_SIDE;
    if great3::has_varying_psf(data.root(), id.set) {
        let expected = fill(great3::PSF_IMAGES, id.set, id.image);
        let message = format!(
            "the stars are all over the field, so that each galaxy has another PSF (expected {expected} beside this file)"
        );
        return Err(FileError::new(path, message).hint("a program that interpolates stars, such as PSFEx or PIFF, to write one PSF stamp per galaxy, as a mosaic like the galaxies' or a cube in the order of their catalogue"));
    }
    let mut image = ImageReader::open(path)?;
    let (width, height) = (image.width(), image.height());
    let side = width / ALL;
    if width != height || width % ALL != 0 || !(cut.least..=MAX_STAMP).contains(&side) {
        let message = format!(
            "the star field is {width} × {height} pixels; expected {ALL} × {ALL} stars of {} to {MAX_STAMP} pixels a side",
            cut.least
        );
        return Err(FileError::new(path, message));
    }
    let pixels = image.read_rows(height)?;
    let field = ArrayView2::from_shape((height, width), &pixels)
        .map_err(|error| FileError::new(path, error))?;
    let star = |place: usize| {
        let [x, y] = [place % ALL, place / ALL].map(|at| Slice::from(at * side..(at + 1) * side));
        let mut star = field;
        star.slice_axis_inplace(Axis(0), y);
        star.slice_axis_inplace(Axis(1), x);
        star
    };
    let stacked = data
        .layout()
        .great3
        .is_some_and(|branch| branch.stacked_stars);
    let found = match stacked {
        true => {
            Star::stack((0..ALL * ALL).map(star)).and_then(|stack| Star::cut(stack.view(), cut))
        }
        false => Star::cut(star(0), cut),
    };
    let star = found.map_err(about(path))?;
    Ok(OpenPsfs {
        moved: star.moved,
        source: PsfSource::Shared(Arc::new(star)),
        wcs: Wcs::default(),
        stated: None,
    })
}

fn open_functional(path: &Path, cut: PsfCut, mosaic: &Mosaic) -> Result<PsfSource, FileError> {
    let rows = grid::psfs_of(path, mosaic)?;
    if let Some(wide) = rows.iter().find(|psf| psf.fwhm > cut.size as f64) {
        let message = format!(
            "a PSF has a FWHM of {} px; expected at most the {} pixels a side of the configuration's PSF stamp",
            wide.fwhm, cut.size
        );
        return Err(FileError::new(path, message));
    }
    // A shared PSF is drawn here once; the workers draw PSFs of galaxies.
    let [psf] = rows.as_slice() else {
        return Ok(PsfSource::Functional(rows));
    };
    let stamp = psf.stamp_beside(cut.size, mosaic.stamp);
    // The stamp is divided by its sum, which is zero for a profile between the pixels.
    if stamp.iter().any(|value| !value.is_finite()) {
        let message = format!(
            "a PSF with a FWHM of {} px has no light on its stamp; expected a width of about a pixel or more",
            psf.fwhm
        );
        return Err(FileError::new(path, message));
    }
    Ok(PsfSource::Shared(Arc::new(stamp.into())))
}

fn open_stars(path: &Path, cut: PsfCut, mosaic: &Mosaic) -> Result<OpenPsfs, FileError> {
    let least = cut.least;
    let mut image = ImageReader::open(path)?;
    let (wcs, stated) = (Wcs::of_header(&mut image)?, stated_image(&image));
    let (width, height) = (image.width(), image.height());
    let (columns, rows) = (mosaic.columns, mosaic.rows());
    let side = match whole(&image, path, "STAMP", MAX_STAMP)? {
        Some(side) => side,
        // One star is never as large as a mosaic of the smallest PSF stamps that could be used.
        None if width >= columns * least
            && width.is_multiple_of(columns)
            && height == rows * (width / columns) =>
        {
            width / columns
        }
        None => width,
    };
    if side < least {
        // The linear method requires one parity.
        let odd = usize::from(cut.centred) * (least - side) % 2;
        let size = side - odd;
        let message =
            format!("the PSF stamp has {side} pixels a side; the configuration requires {least}");
        return Err(FileError::new(path, message).hint(format!(
            "larger PSF stamps, or psf.size = {size} in a settings file"
        )));
    }
    let stars = whole(&image, path, "NSTAMPS", columns * rows)?;
    if let Some(stars) = stars.filter(|stars| *stars != 1 && *stars != mosaic.galaxies) {
        let message = format!(
            "the header key NSTAMPS is {stars}; expected 1, or {}, one per galaxy",
            mosaic.galaxies
        );
        return Err(FileError::new(path, message));
    }
    let one = (width, height) == (side, side);
    // A single galaxy has a shared star: both are one stamp, and a shared one is prepared once.
    if mosaic.galaxies > 1 && (width, height) == (columns * side, rows * side) {
        check_strip(path, columns, side)?;
        let image = Box::new(image);
        return Ok(OpenPsfs {
            source: PsfSource::Stars { image, side },
            moved: None,
            wcs,
            stated,
        });
    }
    if !one || side > MAX_STAMP {
        let message = format!(
            "the star image is {width} × {height} pixels; expected one stamp, or {columns} × {rows} stamps, one per galaxy, of {0} × {0} pixels",
            side.min(MAX_STAMP)
        );
        return Err(FileError::new(path, message));
    }
    let pixels = image.read_rows(height)?;
    let stamp = ArrayView2::from_shape((height, width), &pixels)
        .map_err(|error| FileError::new(path, error))?;
    let star = Star::cut(stamp, cut).map_err(about(path))?;
    Ok(OpenPsfs {
        moved: star.moved,
        source: PsfSource::Shared(Arc::new(star)),
        wcs,
        stated,
    })
}

// From the first row of the file, because surveys have read rows in another order. The last row may be shorter.
fn read_row(
    image: &mut ImageReader,
    mosaic: Mosaic,
    side: usize,
    row: usize,
) -> Result<Pixels<'static, Ix3>, PipelineError> {
    image.rewind();
    image.skip_rows(row * side);
    let stamps = Pixels::strip(image.read_rows(side)?, mosaic.columns, side)?;
    Ok(stamps.into_slice(0..mosaic.of_row(row)))
}

/// Checks that a row of `n` stamps of `side` pixels a side fits into memory.
pub(crate) fn check_strip(path: &Path, n: usize, side: usize) -> Result<(), FileError> {
    let pixels = n * side * side;
    if pixels <= MAX_ROW_PIXELS {
        return Ok(());
    }
    let message = format!(
        "a row of {n} stamps of {side} pixels a side has {pixels} pixels; expected at most {MAX_ROW_PIXELS}"
    );
    Err(FileError::new(path, message))
}

/// Set and image that the header of a simulated image states. Headers of other programs may have one of these keys with
/// another meaning, so that both must be whole numbers.
fn stated_image(image: &ImageReader) -> Option<[u32; 2]> {
    let whole = |key: &str| {
        let value = image.number(key).ok().flatten()?;
        (value.fract() == 0.0 && value >= 1.0).then_some(value as u32)
    };
    Some([whole("SET")?, whole("IMAGE")?])
}

// Distance up to which two places on the sky are one galaxy. Chosen by hand: half of the seeing.
const SAME_GALAXY_ARCSEC: f64 = 0.5;
// Distance from which places of one identity are two galaxies. Chosen by hand.
const OTHER_GALAXY_ARCSEC: f64 = 3.0;

/// Opens an image, or those of several epochs.
pub(super) fn open_epochs(
    data: &DataFolder,
    ids: &[ImageId],
    measurer: &Measurer,
) -> Result<Vec<ImageSource>, PipelineError> {
    let mut sources: Vec<ImageSource> = Vec::new();
    let mut first: Option<(ImageId, Galaxies)> = None;
    let most = measurer.max_epoch_offset();
    for &id in ids {
        let mut source = ImageSource::open(data, id, measurer.configuration())?;
        if ids.len() == 1 {
            return Ok(vec![source]);
        }
        let path = data.stamps(id.set, id.image);
        let galaxies = Galaxies::read(&path, source.table.as_ref())?;
        if let Some((of, first)) = &first {
            source.tiles = first.find_in(*of, &galaxies, &path)?;
            source.rows = sources[0].rows;
        }
        let offsets = match (data.layout().great3, &source.table) {
            (Some(_), _) => Some(vec![
                great3::dither(data.root(), id.set, id.image, most)?;
                source.mosaic.galaxies
            ]),
            (None, Some(table)) => offsets(table, &path, source.mosaic.stamp)?,
            (None, None) => None,
        };
        source.offsets = Some(ordered(&source.tiles, offsets.as_deref().unwrap_or(&[])));
        sources.push(source);
        first.get_or_insert((id, galaxies));
    }
    Ok(sources)
}

/// Values of stamps in the order of galaxies; a galaxy without a stamp gets any, because its pixels are missing.
fn ordered<T: Copy + Default>(tiles: &[Option<usize>], of_stamps: &[T]) -> Vec<T> {
    let any = of_stamps.first().copied().unwrap_or_default();
    let of = |tile: &Option<usize>| tile.and_then(|tile| of_stamps.get(tile)).copied();
    tiles.iter().map(|tile| of(tile).unwrap_or(any)).collect()
}

// Of the galaxies from the centres of stamps that were cut from an exposure to whole pixels.
fn offsets(
    table: &StampTable,
    path: &Path,
    side: usize,
) -> Result<Option<Vec<[f64; 2]>>, FileError> {
    let [x, y, ..] = PLACE;
    if [x, y]
        .iter()
        .any(|name| table.columns.column(name).is_err())
    {
        return Ok(None);
    }
    let x = numbers(&table.columns, x, path)?;
    let y = numbers(&table.columns, y, path)?;
    let shift = f64::from(table.head.first_pixel) - 1.0;
    let places = x.iter().zip(&*y).map(|(x, y)| (x - shift, y - shift));
    Ok(Some(
        places.map(|place| subpixel_offset(place, side)).collect(),
    ))
}

/// Identities of galaxies, which show their type, and degrees on the sky, by which epochs are joined.
struct Galaxies {
    ids: Option<Vec<String>>,
    sky: Option<[Vec<f64>; 2]>,
}

impl Galaxies {
    fn read(path: &Path, table: Option<&StampTable>) -> Result<Self, FileError> {
        let Some(StampTable { columns, .. }) = table else {
            return Ok(Galaxies {
                ids: None,
                sky: None,
            });
        };
        let ids = columns.column(ID).ok().map(|column| {
            let value = |row| column.get(row).map(|value| value.to_string());
            (0..column.len()).map(value).collect::<Result<Vec<_>, _>>()
        });
        let ids = ids.transpose();
        let [_, _, ra, dec] = PLACE;
        let sky = match columns.column(ra) {
            Ok(_) => Some([
                numbers(columns, ra, path)?.into_owned(),
                numbers(columns, dec, path)?.into_owned(),
            ]),
            Err(_) => None,
        };
        Ok(Galaxies {
            ids: ids.map_err(|error| FileError::new(path, error))?,
            sky,
        })
    }

    /// The row of each of these galaxies, which are of image `first`, in the table of another epoch.
    fn find_in(
        &self,
        first: ImageId,
        other: &Galaxies,
        path: &Path,
    ) -> Result<Vec<Option<usize>>, FileError> {
        let fault = |message: String| FileError::new(path, message);
        let found = match (&self.ids, &other.ids, &self.sky, &other.sky) {
            (Some(ids), Some(others), ..) => by_identity(ids, others).map_err(fault)?,
            (_, _, Some(sky), Some(others)) => {
                by_place(sky, others).map_err(|message| fault(message).hint("a column id"))?
            }
            _ => {
                let message = "epochs are joined by the columns id, or ra and dec, which the stamps of one of the images have not (expected them in all images of the set)";
                return Err(fault(message.into()).hint("gather --positions with such columns"));
            }
        };
        let count = other.ids.as_ref().map_or_else(
            || other.sky.as_ref().map_or(0, |[ra, _]| ra.len()),
            Vec::len,
        );
        // Of each row, the galaxy that it is.
        let mut known: Vec<Option<usize>> = vec![None; count];
        for (galaxy, row) in found.iter().enumerate() {
            let Some(row) = *row else { continue };
            if let Some(earlier) = known[row].replace(galaxy) {
                let message = format!(
                    "rows {} and {} of image {} are one galaxy here (expected each galaxy once)",
                    earlier + 1,
                    galaxy + 1,
                    first.image
                );
                return Err(fault(message).hint("positions without repeated galaxies"));
            }
        }
        let missing = known.iter().filter(|known| known.is_none()).count();
        if let Some(row) = known.iter().position(Option::is_none) {
            let name = match (&other.ids, &other.sky) {
                (Some(ids), _) => format!("id {}", ids[row]),
                (None, Some([ra, dec])) => format!("ra {}, dec {}", ra[row], dec[row]),
                _ => format!("row {}", row + 1),
            };
            let message = format!(
                "{missing} of {count} galaxies, such as {name}, are not in image {} (expected epochs of the galaxies of the first image of the set)",
                first.image
            );
            let hint = "one table of positions for all exposures, or another set";
            return Err(fault(message).hint(hint));
        }
        if let (Some(sky), Some(others)) = (&self.sky, &other.sky) {
            for (galaxy, row) in found.iter().enumerate() {
                let Some(row) = row else { continue };
                let [here, there] = [at(sky, galaxy), at(others, *row)];
                let apart = arcsec(here, there);
                if apart > OTHER_GALAXY_ARCSEC {
                    let id = other.ids.as_ref().map_or("", |ids| &ids[*row]);
                    let message = format!(
                        "the galaxy of id {id} is {apart:.1}″ from the one of image {} (expected the same galaxy)",
                        first.image
                    );
                    return Err(
                        fault(message).hint("identities that are the same on all exposures")
                    );
                }
            }
        }
        Ok(found)
    }
}

fn by_identity(ids: &[String], others: &[String]) -> Result<Vec<Option<usize>>, String> {
    let mut rows = HashMap::new();
    for (row, id) in others.iter().enumerate() {
        if let Some(first) = rows.insert(id, row) {
            return Err(format!(
                "the id {id} is in rows {} and {} (expected one row per galaxy)",
                first + 1,
                row + 1
            ));
        }
    }
    Ok(ids.iter().map(|id| rows.get(id).copied()).collect())
}

fn at([ra, dec]: &[Vec<f64>; 2], row: usize) -> [f64; 2] {
    [ra[row], dec[row]]
}

// Between places that are near each other.
fn arcsec([ra1, dec1]: [f64; 2], [ra2, dec2]: [f64; 2]) -> f64 {
    let around = (ra1 - ra2 + 540.0).rem_euclid(360.0) - 180.0;
    let east = around * (0.5 * (dec1 + dec2)).to_radians().cos();
    3600.0 * east.hypot(dec1 - dec2)
}

fn by_place(sky: &[Vec<f64>; 2], others: &[Vec<f64>; 2]) -> Result<Vec<Option<usize>>, String> {
    let mut order: Vec<usize> = (0..others[1].len()).collect();
    order.sort_by(|a, b| others[1][*a].total_cmp(&others[1][*b]));
    let within = SAME_GALAXY_ARCSEC / 3600.0;
    let find = |galaxy: usize| {
        let place = at(sky, galaxy);
        let first = order.partition_point(|row| others[1][*row] < place[1] - within);
        let near = order[first..]
            .iter()
            .take_while(|row| others[1][**row] <= place[1] + within);
        let mut near = near.filter(|row| arcsec(place, at(others, **row)) <= SAME_GALAXY_ARCSEC);
        let found = near.next().copied();
        match near.next() {
            None => Ok(found),
            Some(_) => Err(format!(
                "two galaxies are within {SAME_GALAXY_ARCSEC}″ of ra {}, dec {} (expected one)",
                place[0], place[1]
            )),
        }
    };
    (0..sky[0].len()).map(find).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn galaxies(ids: Option<&[&str]>, sky: &[[f64; 2]]) -> Galaxies {
        let own = |id: &&str| (*id).to_owned();
        let axis = |axis: usize| sky.iter().map(|place| place[axis]).collect();
        Galaxies {
            ids: ids.map(|ids| ids.iter().map(own).collect()),
            sky: (!sky.is_empty()).then(|| [axis(0), axis(1)]),
        }
    }

    fn find(first: &Galaxies, other: &Galaxies) -> Result<Vec<Option<usize>>, String> {
        let id = ImageId { set: 1, image: 1 };
        let found = first.find_in(id, other, Path::new("stamps-002.parquet"));
        found.map_err(|error| error.to_string())
    }

    #[test]
    fn epochs_are_joined_by_identity_or_place() {
        let first = galaxies(Some(&["7", "8", "9"]), &[]);
        let found = find(&first, &galaxies(Some(&["9", "7"]), &[]));
        assert_eq!(found, Ok(vec![Some(1), None, Some(0)]));
        // Across the meridian, and 0.1″ apart.
        let first = galaxies(None, &[[359.999_99, 60.0], [12.0, -5.0]]);
        let other = galaxies(None, &[[12.0, -5.0], [0.000_02, 60.0]]);
        assert_eq!(find(&first, &other), Ok(vec![Some(1), Some(0)]));
    }

    #[test]
    fn epochs_of_other_galaxies_are_refused() {
        let first = galaxies(Some(&["7", "8"]), &[[12.0, 1.0], [12.1, 1.0]]);
        let twice = galaxies(None, &[[12.0, 1.0], [12.0, 1.000_05]]);
        let alone = galaxies(None, &[[12.0, 1.0]]);
        let of = |ids: &[&str], sky: &[[f64; 2]]| galaxies(Some(ids), sky);
        let absent = "1 of 1 galaxies, such as id \"7\", are not in image 1";
        for (first, other, words) in [
            (&first, of(&["\"7\""], &[]), absent),
            (
                &first,
                of(&["7"], &[[12.1, 1.0]]),
                "id 7 is 359.9″ from the one of image 1",
            ),
            (&first, of(&["7", "7"], &[]), "the id 7 is in rows 1 and 2"),
            (
                &first,
                galaxies(None, &[]),
                "joined by the columns id, or ra and dec",
            ),
            (&alone, twice, "two galaxies are within 0.5″"),
            (
                &galaxies(Some(&["7", "8", "7"]), &[]),
                of(&["7", "8"], &[]),
                "rows 1 and 3 of image 1 are one galaxy here",
            ),
        ] {
            let text = find(first, &other).unwrap_err();
            assert!(text.contains(words), "{text}");
        }
    }
}
