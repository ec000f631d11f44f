//! Gathering stamps into an image of a data folder: cubes, files of one or several images each, and cut-outs of an
//! exposure.

mod array;
mod exposure;
mod files;
mod maps;
mod model;
mod mosaic;
mod positions;
mod psfs;

use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;
use shearq_measure::{Examination, PixelFrame, Warning};
use shearq_quantities::linear::Matrix2;
use shearq_quantities::statistics::upper_median;
use shearq_quantities::{Frame, Jacobian};

pub use self::array::{GatheredPixels, HeaderPixels, is_aligned, pixel_difference};
use self::exposure::Exposure;
pub(crate) use self::exposure::subpixel_offset;
pub use self::files::{Content, Files};
use self::files::{Images, shown};
use self::model::Chip;
use self::mosaic::{Origins, Rows, StampWriter, already};
pub use self::positions::Table;
use self::positions::{Positions, rows_of_stamps};
use self::psfs::{GatheredPsfs, PsfFile, gather_psfs};
use super::PipelineError;
use super::measure::check_strip;
use crate::stamp_table::{self, Head, StampTable};
use crate::wcs::{Wcs, aligned};
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{DataFolder, MAX_STAMP};
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_files::frames::{self, polars::Column};
use shearq_files::open::is_there;
use shearq_files::table;

// Most stamps of one image: one per galaxy of the largest grid.
const MAX_STAMPS: usize = table::MAX_ROWS;
// Least pixels a side of a single stamp that looks like a mosaic or an exposure: four times the default stamp.
const LARGE_STAMP_PX: usize = 192;
const SQUARE: &str =
    "--square crop, which takes the central square; --square pad, which adds missing pixels; or ";
const MOSAIC: &str = "--exposure with --positions, which cuts stamps out of an exposure. A mosaic is read as DATA/set01/galaxies-001.fits, with `stamp = SIDE` in DATA/layout.toml";
// Largest difference of the median offset from the one pixel between positions from 0 and from 1. Chosen by hand.
const MAX_ORIGIN_MISMATCH_PX: f64 = 0.5;

#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stamps<'a> {
    /// FITS files, each with one stamp, a cube of them, or several extensions with either. Stamps smaller than the largest get
    /// missing pixels around them.
    Files(Files<'a>),
    Cutouts {
        exposure: Files<'a>,
        /// Table with the positions, in pixels or in degrees on the sky.
        positions: Table<'a>,
        /// Coordinate of the centre of the first pixel in the table, 0 or 1.
        first_pixel: u8,
        side: usize,
    },
}

impl<'a> Stamps<'a> {
    fn positions(&self) -> Option<Table<'a>> {
        match self {
            Stamps::Files(_) => None,
            Stamps::Cutouts { positions, .. } => Some(*positions),
        }
    }

    /// Coordinate of the centre of the first pixel in catalogues.
    fn first_pixel(&self) -> u8 {
        match self {
            Stamps::Files(_) => 1,
            Stamps::Cutouts { first_pixel, .. } => *first_pixel,
        }
    }
}

#[derive(Debug)]
pub struct Gathered {
    pub mosaic: Mosaic,
    /// Stamps with pixels that are beyond the exposure, masked, or not finite in their file.
    pub incomplete: usize,
    pub messages: Vec<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Square {
    Crop,
    /// By missing pixels around them. PSFs, which may not lack pixels, are cropped.
    Pad,
}

/// Masks, whose pixels are bad if they are not zero or have a bit that is asked for.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Masks<'a> {
    #[serde(flatten)]
    pub files: Files<'a>,
    /// Sum of the powers of two of the bits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bits: Option<u64>,
}

#[derive(Debug, Clone, Serialize)]
pub struct Gathering<'a> {
    pub stamps: Stamps<'a>,
    /// Table of the identities and places of stamps of files.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rows: Option<Table<'a>>,
    /// What stamps and PSFs of files that are not square become; without it they are refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub square: Option<Square>,
    pub masks: Option<Masks<'a>>,
    /// One PSF, one per stamp, or stars to average.
    pub psfs: Files<'a>,
    /// Pixels of the PSF images along a pixel of the galaxies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psf_oversampling: Option<usize>,
    pub noise: Option<f64>,
    /// Maps of the variance of pixels, or of its inverse.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub variances: Option<Files<'a>>,
    /// Electrons per unit of the image, for the Poisson noise of galaxies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
    /// The axes of ellipticities; the sky's if the WCS has other axes than the pixels, unless it is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame: Option<Frame>,
}

#[derive(Serialize)]
struct Record<'a> {
    version: &'a str,
    #[serde(flatten)]
    gathering: &'a Gathering<'a>,
}

/// How exposures of one list belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exposures {
    /// Of the same galaxies: each image has the rows of all galaxies that are on one of them.
    Epochs,
    /// Chips of a camera: each image has the galaxies that are on it. One without galaxies becomes no image.
    Chips,
}

/// Gathers stamps and their PSFs into images of `data` with consecutive numbers, from the number of `first` on. If one of them cannot be
/// gathered, none is written. Chips without galaxies have `None`.
///
/// Writes the table of stamps, the record of the sources, the PSFs, and last the image. Leftovers of a stopped process
/// are replaced. Other processes that gather into the same folder wait.
pub fn gather(
    data: &DataFolder,
    first: ImageId,
    all: &[Gathering<'_>],
    exposures: Exposures,
) -> Result<Vec<Option<Gathered>>, PipelineError> {
    let which = data.stamps(first.set, first.image);
    let folder = which.parent().unwrap_or(Path::new("."));
    let cannot = "cannot make the folder";
    let absent = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
    let made: Vec<PathBuf> = folder
        .ancestors()
        .take_while(absent)
        .map(Path::to_owned)
        .collect();
    fs::create_dir_all(folder).map_err(FileError::doing(folder, cannot))?;
    // A lock on the folder, not on a file in it, because the files are replaced.
    let alone = fs::File::open(folder).map_err(FileError::doing(folder, cannot))?;
    // Not all file systems have locks.
    let _ = alone.lock();
    let gathered = gather_alone(data, first, all, exposures);
    if gathered.is_err() {
        for folder in made {
            // Fails if the folder is not empty.
            let _ = fs::remove_dir(folder);
        }
    }
    gathered
}

fn gather_alone(
    data: &DataFolder,
    first: ImageId,
    all: &[Gathering<'_>],
    exposures: Exposures,
) -> Result<Vec<Option<Gathered>>, PipelineError> {
    // The table of stamps would replace the catalogue of galaxies, which another program wrote.
    if data.layout().great3.is_some() {
        let message = "this folder is a branch of GREAT3, to which no image can be added (expected a folder of gathered images, or a new one). Try: another folder";
        return Err(FileError::new(data.root(), message).into());
    }
    let ids = (first.image..).map(|image| ImageId { image, ..first });
    for (_, id) in all.iter().zip(ids.clone()) {
        remove_leftovers(data, id)?;
    }
    // All files have temporary names until the last exposure is read: with some of them in the folder, the user could neither repeat
    // the command nor see which exposures were lost.
    let chips = exposures == Exposures::Chips;
    let plans = all
        .iter()
        .map(|one| Plan::of(&one.stamps, one.square, chips));
    let mut plans: Vec<Plan> = plans.collect::<Result<_, _>>()?;
    match exposures {
        Exposures::Chips => leave_out_of_chips(&mut plans, all)?,
        Exposures::Epochs => leave_out_elsewhere(&mut plans, all)?,
    }
    let jacobians = jacobians_of_all(&plans, all)?;
    let prepared = ids.zip(all).zip(plans.into_iter().zip(jacobians));
    let prepared = prepared
        .enumerate()
        .map(|(at, ((id, one), (plan, jacobians)))| {
            let chip = Chip { at, of: all.len() };
            let is_empty = plan.stack.count == 0;
            let prepare = || prepare(data, id, one, plan, jacobians.as_deref(), chip);
            (!is_empty).then(prepare).transpose()
        });
    let prepared: Vec<Option<Prepared>> = prepared.collect::<Result<_, _>>()?;
    let finish = |image: Option<Prepared>| image.map(Prepared::finish).transpose();
    prepared.into_iter().map(finish).collect()
}

// Each chip keeps the galaxies that are on it.
fn leave_out_of_chips(plans: &mut [Plan], all: &[Gathering<'_>]) -> Result<(), FileError> {
    let tables: Vec<Option<Table<'_>>> = all.iter().map(|one| one.stamps.positions()).collect();
    for (at, table) in tables
        .iter()
        .enumerate()
        .filter_map(|(at, table)| Some((at, (*table)?)))
    {
        let same: Vec<usize> = (0..plans.len())
            .filter(|other| tables[*other] == Some(table))
            .collect();
        if same[0] != at {
            continue;
        }
        let count = plans[at].inside.len();
        if let [_, _, ..] = same[..]
            && plans[at]
                .positions
                .as_ref()
                .is_some_and(|found| !found.in_degrees())
        {
            let message = format!(
                "x and y are pixels of one chip (found one table for {} chips, expected right ascension and declination, or a table for each). Try: --degrees",
                same.len()
            );
            return Err(FileError::new(table.path, message));
        }
        let on_none = (0..count).filter(|&row| !same.iter().any(|&chip| plans[chip].inside[row]));
        let on_none = on_none.count();
        if on_none == count {
            let message = format!(
                "all {count} positions are outside the {} chips. Try: check the positions and the WCS of the chips",
                same.len()
            );
            return Err(FileError::new(table.path, message));
        }
        if on_none > 0 {
            let message = format!(
                "note: {}: {on_none} of {count} positions are on no chip and left out",
                table.path.display()
            );
            plans[at].messages.push(message);
        }
    }
    for plan in plans {
        if let Some(positions) = &mut plan.positions {
            positions.keep(&plan.inside)?;
            plan.stack.count = positions.all.len();
            plan.inside.retain(|inside| *inside);
        }
    }
    Ok(())
}

// Galaxies that are on another exposure of the same table are kept, so that epochs have the same rows.
fn leave_out_elsewhere(plans: &mut [Plan], all: &[Gathering<'_>]) -> Result<(), FileError> {
    let tables: Vec<Option<Table<'_>>> = all.iter().map(|one| one.stamps.positions()).collect();
    let kept = |at: usize| {
        let mut kept = plans[at].inside.clone();
        for other in (0..plans.len()).filter(|other| tables[*other] == tables[at]) {
            let inside = &plans[other].inside;
            kept.iter_mut()
                .zip(inside)
                .for_each(|(kept, inside)| *kept |= inside);
        }
        kept
    };
    let kept: Vec<Vec<bool>> = (0..plans.len()).map(kept).collect();
    for (plan, kept) in plans.iter_mut().zip(kept) {
        let Some(positions) = &mut plan.positions else {
            continue;
        };
        plan.messages.extend(positions.keep(&kept)?);
        plan.stack.count = positions.all.len();
        let mut row = kept.iter();
        plan.inside.retain(|_| row.next() == Some(&true));
    }
    Ok(())
}

/// The files of an image, which have temporary names or are in memory.
struct Prepared {
    record: String,
    /// Where the table of stamps will be.
    which: PathBuf,
    table: StampTable,
    psfs: PsfFile,
    image: Rows,
    gathered: Gathered,
}

impl Prepared {
    fn finish(self) -> Result<Gathered, PipelineError> {
        atomic::write(self.which.with_extension("json"), self.record.as_bytes())?;
        self.table.write(&self.which)?;
        self.psfs.finish()?;
        self.image.finish()?;
        Ok(self.gathered)
    }
}

fn prepare(
    data: &DataFolder,
    id: ImageId,
    gathering: &Gathering<'_>,
    plan: Plan,
    jacobians: Option<&[Matrix2]>,
    chip: Chip,
) -> Result<Prepared, PipelineError> {
    let target = data.galaxies(id.set, id.image);
    let which = data.stamps(id.set, id.image);
    let record = Record {
        version: shearq_dataset::VERSION,
        gathering,
    };
    let record = serde_json::to_string_pretty(&record)
        .map_err(FileError::doing(&which, "cannot write the record"))?;
    let mut messages = plan.messages.clone();
    match jacobians {
        Some(jacobians) => messages.push(frame_line(jacobians)),
        None => messages.extend(plan.stack.differs.clone()),
    }
    let &Stack {
        count,
        side,
        ref wcs,
        ..
    } = &plan.stack;
    let rows = gathering.rows.map(|rows| rows_of_stamps(rows, count));
    let rows = rows.transpose()?;
    let mosaic = Mosaic::of(count, side);
    check_strip(&target, mosaic.columns, side)?;
    let places = match &plan.positions {
        Some(found) => Some(found.all.clone()),
        None => rows.as_deref().and_then(pixels_of_rows),
    };
    let psfs = gather_psfs(data, id, gathering, &plan, chip, places)?;
    messages.extend_from_slice(&psfs.messages);
    let of_psf = check_psf(&psfs, &plan, jacobians)?;
    let mut writer = StampWriter::create(&target, mosaic, gathering.noise, wcs, &psfs.examination)?;
    writer.copy(gathering, plan.places())?;
    let mut warnings = writer.examination.warnings();
    if gathering.variances.is_some() {
        warnings.retain(|warning| !matches!(warning, Warning::Depths { .. }));
    }
    warnings.extend(
        gathering
            .noise
            .and_then(|sigma| writer.examination.given_noise(sigma)),
    );
    warnings.extend(width(&writer.examination, &psfs)?);
    warnings.extend(of_psf);
    if jacobians.is_none() {
        warnings.extend(wcs.frame());
    }
    let ImageId { set, image } = id;
    messages.extend(warnings.iter().map(|warning| {
        let hint = one_pixel_off(&gathering.stamps, warning).unwrap_or_default();
        format!("warning: set {set:02} image {image:03}: {warning}{hint}")
    }));
    let head = Head {
        frame: jacobians.map_or(Frame::Pixel, |_| Frame::Sky),
        first_pixel: gathering.stamps.first_pixel(),
        gain: gathering.gain,
    };
    let incomplete = writer.incomplete;
    let mut columns = rows.unwrap_or_default();
    columns.extend(plan.columns(head, &mosaic, &mut writer, jacobians));
    Ok(Prepared {
        record: format!("{record}\n"),
        table: stamp_table::table(&which, head, columns)?,
        which,
        psfs: psfs.file,
        image: writer.image,
        gathered: Gathered {
            mosaic,
            incomplete,
            messages,
        },
    })
}

// The columns x and y of stamps that are not cut out.
fn pixels_of_rows(rows: &[Column]) -> Option<Vec<(f64, f64)>> {
    let of = |wanted: &str| {
        let column = rows.iter().find(|column| column.name() == wanted);
        column.and_then(frames::reals)
    };
    let [x, y, ..] = stamp_table::PLACE;
    let (x, y) = (of(x)?, of(y)?);
    Some(x.iter().copied().zip(y.iter().copied()).collect())
}

// Of all exposures or of none, because `measure --epochs` combines stamps along common axes: exposures along the sky next to turned
// ones need Jacobians, too, and so do exposures along the sky with different pixel scales.
fn jacobians_of_all(
    plans: &[Plan],
    all: &[Gathering<'_>],
) -> Result<Vec<Option<Vec<Matrix2>>>, FileError> {
    let own = |(plan, one): (&Plan, &Gathering<'_>)| plan.jacobians(one, one.frame);
    let own: Vec<_> = plans.iter().zip(all).map(own).collect::<Result<_, _>>()?;
    let differs = |plan: &Plan| {
        let mut found = Wcs::disagreements(&plan.stack.wcs, &plans[0].stack.wcs);
        found.next().is_some()
    };
    if !(own.iter().any(Option::is_some) || plans.iter().any(differs)) {
        return Ok(own);
    }
    let of_each = own.into_iter().zip(plans.iter().zip(all));
    let of_each = of_each.map(|(own, (plan, one))| match own {
        Some(own) => Ok(Some(own)),
        None => plan.jacobians(one, one.frame.or(Some(Frame::Sky))),
    });
    of_each.collect()
}

// A process may have been stopped between PSFs and image. The user would otherwise have to remove files by hand.
fn remove_leftovers(data: &DataFolder, id: ImageId) -> Result<(), FileError> {
    let target = data.galaxies(id.set, id.image);
    if is_there(&target) {
        return Err(already(target));
    }
    // Only `gather` writes the table of stamps, and the image comes last. So a table without an image is a leftover.
    let stopped = is_there(&data.stamps(id.set, id.image));
    let psfs = [
        data.psf_star(id.set, id.image),
        data.psf_functional(id.set, id.image),
    ];
    for path in psfs.into_iter().filter(|path| is_there(path)) {
        if !stopped {
            return Err(already(path));
        }
        fs::remove_file(&path).map_err(FileError::doing(&path, "cannot remove the leftover"))?;
    }
    Ok(())
}

// Sizes and positions of all stamps are checked before the first one is written.
struct Plan {
    /// Where they are cut out of an exposure.
    positions: Option<Positions>,
    /// Whether these are on the exposure.
    inside: Vec<bool>,
    stack: Stack,
    messages: Vec<String>,
}

impl Plan {
    fn of(stamps: &Stamps<'_>, square: Option<Square>, chips: bool) -> Result<Self, FileError> {
        match stamps {
            Stamps::Files(files) => Plan::of_files(*files, square),
            Stamps::Cutouts {
                exposure,
                positions,
                first_pixel,
                side,
            } => Plan::of_cutouts(*exposure, *positions, (*first_pixel, *side), chips),
        }
    }

    fn places(&self) -> &[(f64, f64)] {
        self.positions.as_ref().map_or(&[], |found| &found.all)
    }

    /// Jacobians of the stamps, of those whose header has a WCS.
    fn pixels(&self) -> Vec<Option<Matrix2>> {
        match &self.positions {
            Some(found) => {
                let each = found.all.iter();
                each.map(|&(x, y)| self.stack.wcs.jacobian([x, y]))
                    .collect()
            }
            None => self.stack.pixels(),
        }
    }

    // `None` if ellipticities stay on the pixel axes, as `frame` says, or without it the WCS.
    fn jacobians(
        &self,
        gathering: &Gathering<'_>,
        frame: Option<Frame>,
    ) -> Result<Option<Vec<Matrix2>>, FileError> {
        let files = match &gathering.stamps {
            Stamps::Files(files)
            | Stamps::Cutouts {
                exposure: files, ..
            } => files,
        };
        let fault = |message: String| Err(FileError::new(&files.paths[0], message));
        if frame == Some(Frame::Pixel) {
            return Ok(None);
        }
        let all: Option<Vec<Matrix2>> = self.pixels().into_iter().collect();
        let Some(all) = all else {
            if let Some(error) = self.stack.wcs.fault() {
                return fault(format!(
                    "{error}. Try: --frame pixel, for ellipticities along the pixel axes"
                ));
            }
            let expected = "and the header has no WCS (expected TAN, TAN-SIP, TPV or a linear one)";
            return match (frame, gathering.frame) {
                (Some(Frame::Sky), Some(_)) => fault(format!("--frame is sky, {expected}")),
                (Some(Frame::Sky), None) => fault(format!(
                    "the exposures have different pixels on the sky, {expected}. Try: a header with a WCS, or --frame pixel, for ellipticities along the pixel axes of each exposure"
                )),
                _ => Ok(None),
            };
        };
        // Pixels that are already along the sky need no Jacobians, which take time in each measurement.
        let plain = all.iter().all(aligned);
        if plain && frame.is_none() {
            return Ok(None);
        }
        if let Some(kind) = self.stack.wcs.unread() {
            return fault(format!(
                "the WCS is {kind} (expected TAN, TAN-SIP, TPV or a linear one), so that the pixels on the sky are not known. Try: --frame pixel, for ellipticities along the pixel axes"
            ));
        }
        for (row, jacobian) in all.iter().enumerate() {
            if let Err(error) = Jacobian::new(*jacobian) {
                let row = row + 1;
                return fault(format!(
                    "the WCS has no inverse at stamp {row}: {error}. Try: --frame pixel, or correct the header"
                ));
            }
        }
        Ok(Some(all))
    }

    fn columns(
        self,
        head: Head,
        mosaic: &Mosaic,
        writer: &mut StampWriter,
        jacobians: Option<&[Matrix2]>,
    ) -> Vec<Column> {
        let mut columns = Vec::new();
        let real = |name: &str, values: Vec<f64>| Column::new(name.into(), values);
        if let Some(found) = self.positions {
            columns.extend(found.id);
            // Catalogues have the positions as the user counts them, so that rows match the input.
            let shift = f64::from(head.first_pixel) - 1.0;
            let (x, y) = found
                .all
                .iter()
                .map(|(x, y)| (x + shift, y + shift))
                .unzip();
            let places = [x, y].into_iter().chain(found.sky.into_iter().flatten());
            let named = stamp_table::PLACE.into_iter().zip(places);
            columns.extend(named.map(|(name, values)| real(name, values)));
            columns.extend(found.carried);
        }
        if let Some(mut levels) = writer.levels.take() {
            // A stamp without pixels has no level. Any positive one will do, because its galaxy is flagged.
            let mut known: Vec<f64> = levels.iter().copied().filter(|v| v.is_finite()).collect();
            let typical = upper_median(&mut known).unwrap_or(0.0);
            levels
                .iter_mut()
                .filter(|v| v.is_nan())
                .for_each(|v| *v = typical);
            columns.push(real(stamp_table::NOISE, levels));
        }
        if let Some(all) = jacobians {
            for (at, name) in stamp_table::JACOBIAN.into_iter().enumerate() {
                columns.push(real(name, all.iter().map(|j| j[at / 2][at % 2]).collect()));
            }
        }
        let tiles = (0..mosaic.galaxies).map(|place| mosaic.position(place));
        let (tile_x, tile_y) = tiles.unzip();
        let Origins { file, image, plane } = std::mem::take(&mut writer.origins);
        let [x, y, of_file, of_image, of_plane] = stamp_table::ORIGIN;
        columns.extend([real(x, tile_x), real(y, tile_y)]);
        columns.push(Column::new(of_file.into(), file));
        columns.push(Column::new(of_image.into(), image));
        columns.push(Column::new(of_plane.into(), plane));
        columns
    }

    fn of_files(files: Files<'_>, square: Option<Square>) -> Result<Self, FileError> {
        let (stack, mut messages) = Stack::of(files, square)?;
        let side = stack.side;
        if stack.count == 1 && side >= LARGE_STAMP_PX {
            messages.push(format!(
                "warning: {}: the only stamp is {side} × {side} px, which looks like a mosaic of stamps or an exposure. Try: {MOSAIC}",
                files.paths[0].display()
            ));
        }
        Ok(Plan {
            positions: None,
            inside: Vec::new(),
            stack,
            messages,
        })
    }

    fn of_cutouts(
        exposure: Files<'_>,
        positions: Table<'_>,
        (first_pixel, side): (u8, usize),
        is_chip: bool,
    ) -> Result<Self, FileError> {
        let path = &exposure.paths[0];
        let mut exposure = Exposure::open(exposure)?;
        let wcs = exposure.wcs()?;
        let mut messages: Vec<String> = exposure.note.take().into_iter().collect();
        messages.extend(exposure.is_asinh()?.then(|| asinh_line(path)));
        messages.extend(exposure.differs_from_datasum()?.then(|| sum_line(path)));
        let positions = Positions::read(positions, path, &wcs, first_pixel)?;
        messages.extend(positions.note.clone());
        messages.extend(doubts(path, &wcs));
        let sides = exposure.sides()?;
        let inside = positions.inside(sides);
        // Most galaxies of a camera are on other chips.
        if !is_chip || inside.iter().any(|inside| *inside) {
            messages.extend(positions.examine(path, &wcs, sides)?);
        }
        Ok(Plan {
            stack: Stack {
                count: positions.all.len(),
                side,
                wcs,
                of_images: Vec::new(),
                differs: None,
            },
            inside,
            positions: Some(positions),
            messages,
        })
    }
}

struct Stack {
    count: usize,
    side: usize,
    /// Of the first image.
    wcs: Wcs,
    /// Jacobians of images with several stamps each, with the numbers of stamps.
    of_images: Vec<(usize, Option<Matrix2>)>,
    /// A warning if an image has other pixels than the first one.
    differs: Option<String>,
}

impl Stack {
    /// Jacobians of the stamps.
    fn pixels(&self) -> Vec<Option<Matrix2>> {
        let each = self.of_images.iter();
        let each = each.flat_map(|&(count, jacobian)| std::iter::repeat_n(jacobian, count));
        each.collect()
    }

    fn of(files: Files<'_>, square: Option<Square>) -> Result<(Self, Vec<String>), FileError> {
        let (mut count, mut first, mut messages) = (0usize, None, Vec::new());
        let (mut of_images, mut differs) = (Vec::new(), None);
        let mut sides = [0; 2];
        let mut images = Images::of(files);
        while let Some((origin, image)) = images.next()? {
            let (width, height) = (image.width(), image.height());
            if width.max(height) > MAX_STAMP || width != height && square.is_none() {
                let advice = match files.content {
                    Content::Sky if width.max(height) < LARGE_STAMP_PX => {
                        format!(". Try: {SQUARE}{MOSAIC}")
                    }
                    Content::Sky => format!(". Try: {MOSAIC}"),
                    Content::Psf if width.max(height) <= MAX_STAMP => {
                        ". Try: --square crop, which takes the central square".to_owned()
                    }
                    _ => String::new(),
                };
                let message = format!(
                    "the stamp is {width} × {height} pixels; expected a square of at most {MAX_STAMP}{advice}"
                );
                return Err(origin.fault(&message));
            }
            let side = match (files.content, square) {
                (Content::Sky, Some(Square::Pad)) => width.max(height),
                _ => width.min(height),
            };
            let wcs = Wcs::of_header(image)?;
            if first.is_none() {
                messages.extend(doubts(origin.file, &wcs));
                messages.extend(image.is_asinh().then(|| asinh_line(origin.file)));
                messages.extend(image.differs_from_datasum()?.then(|| sum_line(origin.file)));
            }
            let centre = [width, height].map(|side| (side as f64 + 1.0) / 2.0);
            of_images.push((image.planes(), wcs.jacobian(centre)));
            let (expected, first_wcs) = &*first.get_or_insert_with(|| (side, wcs.clone()));
            let expected = *expected;
            if side != expected && files.content == Content::Psf {
                let message = format!(
                    "the stamp is {width} × {height} pixels; the first has {expected} × {expected}"
                );
                return Err(origin.fault(&message));
            }
            sides = match sides {
                [0, 0] => [side; 2],
                [least, most] => [side.min(least), side.max(most)],
            };
            if differs.is_none() && Wcs::disagreements(&wcs, first_wcs).next().is_some() {
                let message = "the header states other pixel axes or another pixel scale than that of the first image, so that ellipticities are not along the same axes. Try: one orientation per image (--image)";
                differs = Some(format!("warning: {}", origin.fault(message)));
            }
            count += image.planes();
            if count > MAX_STAMPS {
                return Err(origin.fault(&format!("there are more than {MAX_STAMPS} stamps")));
            }
        }
        // Clap requires a file, so that the default is never used.
        let (_, wcs) = first.unwrap_or_default();
        let [least, side] = sides;
        if least < side {
            messages.push(format!(
                "note: {}: the stamps have sides of {least} to {side} px. Smaller ones get missing pixels around them, to {side} px",
                files.paths[0].display()
            ));
        }
        let stack = Stack {
            count,
            side,
            wcs,
            of_images,
            differs,
        };
        Ok((stack, messages))
    }
}

// Astropy keeps the key when it writes other pixels, so that it is no error.
fn sum_line(path: &Path) -> String {
    format!(
        "note: {}: the pixels differ from the checksum DATASUM of the header: they are damaged, or a program changed them and kept the key",
        path.display()
    )
}

fn asinh_line(path: &Path) -> String {
    format!(
        "note: {}: the pixels are asinh magnitudes (BSOFTEN), which are converted to fluxes",
        path.display()
    )
}

fn doubts(path: &Path, wcs: &Wcs) -> impl Iterator<Item = String> {
    let doubts = wcs.doubts().iter();
    doubts.map(move |doubt| format!("warning: {}: {doubt}", path.display()))
}

// A user who did not ask for a frame must learn that the components differ from those on the pixels.
fn frame_line(jacobians: &[Matrix2]) -> String {
    let pixels = PixelFrame::from_jacobian(jacobians[0]);
    format!(
        "frame: sky (e1 > 0 along east–west, e2 > 0 along north-west). The WCS of the first stamp: {pixels}. --frame pixel keeps the pixel axes"
    )
}

// A PSF on other pixels, such as of a rotated or resampled exposure, would be deconvolved with the wrong orientation: m and leakage.
fn check_psf(
    psfs: &GatheredPsfs,
    plan: &Plan,
    jacobians: Option<&[Matrix2]>,
) -> Result<Vec<Warning>, FileError> {
    // Each PSF is compared with its stamp. The stars of a field have the pixels of its middle, from which distortions differ by less
    // than what is refused.
    let pixels = plan.pixels();
    let (psf_pixels, wcs) = (&psfs.pixels, &plan.stack.wcs);
    let mut warnings = Vec::new();
    if psf_pixels.len() == pixels.len() && pixels.len() > 1 {
        for (row, both) in psf_pixels.iter().zip(&pixels).enumerate() {
            if let (Some(psf), Some(stamp)) = both {
                let [psf, stamp] = [psf, stamp].map(|matrix| Wcs::of_jacobian(*matrix));
                if let Some(warning) = Wcs::disagreements(&psf, &stamp).next() {
                    let row = row + 1;
                    return Err(FileError::new(
                        &psfs.first,
                        format!("stamp {row}: {warning}"),
                    ));
                }
            }
        }
    } else {
        let typical = jacobians.map(|all| Wcs::of_jacobian(all[all.len() / 2]));
        warnings.extend(Wcs::disagreements(
            &psfs.wcs,
            typical.as_ref().unwrap_or(wcs),
        ));
        let all: Option<Vec<Matrix2>> = pixels.into_iter().collect();
        warnings.extend(Warning::of_shared_psf(all.unwrap_or_default()));
    }
    // A pixel scale in a header key is often copied from another image, so it only warns. Axes come from a CD matrix, and are refused.
    let refused = |warning: &&Warning| match warning {
        Warning::PsfFrame { .. } => true,
        Warning::SharedPsf { .. } => false,
        _ => jacobians.is_some(),
    };
    match warnings.iter().find(refused) {
        Some(warning) => Err(FileError::new(&psfs.first, warning)),
        None => Ok(warnings),
    }
}

// The examinations of both are joined, because the condition compares the widths of PSF and galaxies.
fn width(galaxies: &Examination, psfs: &GatheredPsfs) -> Result<Option<Warning>, FileError> {
    let mut both = galaxies.clone();
    both.join(&psfs.examination);
    let broad = |warning: &Warning| matches!(warning, Warning::PsfBroad { .. });
    match both.warnings().into_iter().find(broad) {
        Some(warning) if warning.is_fatal() => Err(FileError::new(&psfs.first, warning)),
        found => Ok(found),
    }
}

// An offset of all galaxies by one pixel in both axes is the difference between positions from 0 (numpy) and from 1 (FITS).
fn one_pixel_off(stamps: &Stamps<'_>, warning: &Warning) -> Option<String> {
    let (Stamps::Cutouts { first_pixel, .. }, Warning::OffCentre { offset, .. }) =
        (stamps, warning)
    else {
        return None;
    };
    let other = 1 - first_pixel.min(&1);
    let expected = f64::from(*first_pixel) - f64::from(other);
    let off = offset
        .iter()
        .all(|found| (found - expected).abs() < MAX_ORIGIN_MISMATCH_PX);
    off.then(|| format!(". Are the positions counted from {other}? Try: --first-pixel {other}"))
}
