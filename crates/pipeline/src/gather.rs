//! Gathering stamps into an image of a data folder: cubes, files of one or several images each, and cut-outs of an
//! exposure.

mod positions;
mod psfs;
mod source;
mod stamps;

use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;
use shearq_measure::{Examination, Warning};

use self::positions::Positions;
pub use self::positions::Table;
use self::psfs::{GatheredPsfs, gather_psfs};
pub use self::source::{Content, Files};
use self::source::{Exposure, Images, shown};
use self::stamps::{StampWriter, already};
use super::PipelineError;
use super::measure::check_strip;
use crate::wcs::Wcs;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::{DataFolder, MAX_STAMP};
use shearq_dataset::mosaic::Mosaic;
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_files::open::is_there;
use shearq_files::table;

// Most stamps of one image: one per galaxy of the largest grid.
const MAX_STAMPS: usize = table::MAX_ROWS;
// Least pixels a side of a single stamp that looks like a mosaic or an exposure: four times the default stamp.
const LARGE_STAMP_PX: usize = 192;
const SQUARE: &str =
    "--square crop, which takes the central square; --square pad, which adds missing pixels; or ";
const MOSAIC: &str = "--exposure with --positions, which cuts stamps out of an exposure. A mosaic is read as DATA/set01/galaxies-001.fits, with `stamp = SIDE` in DATA/layout.toml";
// Largest difference of an offset from a whole pixel.
const MAX_OFFSET_PX: f64 = 0.5;

#[derive(Debug, Clone, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stamps<'a> {
    /// FITS files, each with one stamp, a cube of them, or several extensions with either. Stamps smaller than the largest get
    /// missing pixels around them.
    Files(Files<'a>),
    Cutouts {
        exposure: Files<'a>,
        /// Table with the positions, in FITS pixels: the centre of the first one is at 1.
        positions: Table<'a>,
        /// Coordinate of the centre of the first pixel in the table, 0 or 1.
        first_pixel: u8,
        side: usize,
    },
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
    /// What stamps and PSFs of files that are not square become; without it they are refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub square: Option<Square>,
    pub masks: Option<Masks<'a>>,
    /// One PSF, one per stamp, or stars to average.
    pub psfs: Files<'a>,
    pub noise: Option<f64>,
}

#[derive(Serialize)]
struct Record<'a> {
    version: &'a str,
    #[serde(flatten)]
    gathering: &'a Gathering<'a>,
}

/// Gathers stamps and their PSFs into image `id` of `data`.
///
/// Writes the table of stamps, the record of the sources, the PSFs, and last the image. Leftovers of a stopped process
/// are replaced. Other processes that gather into the same folder wait.
pub fn gather(
    data: &DataFolder,
    id: ImageId,
    gathering: &Gathering<'_>,
) -> Result<Gathered, PipelineError> {
    let which = data.stamps(id.set, id.image);
    let folder = which.parent().unwrap_or(Path::new("."));
    let cannot = "cannot make the folder";
    let absent = |folder: &&Path| !folder.as_os_str().is_empty() && !folder.exists();
    let made: Vec<PathBuf> = folder
        .ancestors()
        .take_while(absent)
        .map(Path::to_owned)
        .collect();
    fs::create_dir_all(folder).map_err(FileError::doing(folder, cannot))?;
    let alone = fs::File::open(folder).map_err(FileError::doing(folder, cannot))?;
    // Not all file systems have locks.
    let _ = alone.lock();
    let gathered = gather_alone(data, id, gathering);
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
    id: ImageId,
    gathering: &Gathering<'_>,
) -> Result<Gathered, PipelineError> {
    let target = data.galaxies(id.set, id.image);
    let which = data.stamps(id.set, id.image);
    remove_leftovers(data, id)?;
    let record = Record {
        version: shearq_dataset::VERSION,
        gathering,
    };
    let record = serde_json::to_string_pretty(&record)
        .map_err(FileError::doing(&which, "cannot write the record"))?;
    let Plan {
        positions,
        stack,
        mut messages,
    } = Plan::of(&gathering.stamps, gathering.square)?;
    let Stack { count, side, wcs } = stack;
    let mosaic = Mosaic::of(count, side);
    check_strip(&target, mosaic.columns, side)?;
    let psfs = gather_psfs(data, id, gathering.psfs, gathering.square, &mosaic)?;
    messages.extend_from_slice(&psfs.messages);
    let mut writer = StampWriter::create(&target, mosaic, gathering.noise, &wcs)?;
    writer.copy(gathering, &positions)?;
    let mut warnings = writer.examination.warnings();
    warnings.extend(
        gathering
            .noise
            .and_then(|sigma| writer.examination.given_noise(sigma)),
    );
    warnings.extend(width(&writer.examination, &psfs)?);
    warnings.extend(Wcs::disagreements(&psfs.wcs, &wcs));
    warnings.extend(wcs.frame());
    let ImageId { set, image } = id;
    messages.extend(warnings.iter().map(|warning| {
        let hint = one_pixel_off(&gathering.stamps, warning).unwrap_or_default();
        format!("warning: set {set:02} image {image:03}: {warning}{hint}")
    }));
    let (places, incomplete) = (writer.places(&which)?, writer.incomplete);
    let record = format!("{record}\n");
    atomic::write(which.with_extension("json"), record.as_bytes())?;
    atomic::write(&which, &places)?;
    psfs.file.finish()?;
    writer.image.finish()?;
    Ok(Gathered {
        mosaic,
        incomplete,
        messages,
    })
}

/// Removes the PSFs that a stopped process left.
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

// The stamps of an image before they are read.
struct Plan {
    /// Positions on the exposure in FITS pixels, if stamps are cut out.
    positions: Vec<(f64, f64)>,
    stack: Stack,
    messages: Vec<String>,
}

impl Plan {
    fn of(stamps: &Stamps<'_>, square: Option<Square>) -> Result<Self, FileError> {
        match stamps {
            Stamps::Files(files) => Plan::of_files(*files, square),
            Stamps::Cutouts {
                exposure,
                positions,
                first_pixel,
                side,
            } => Plan::of_cutouts(*exposure, *positions, *first_pixel, *side),
        }
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
            positions: Vec::new(),
            stack,
            messages,
        })
    }

    fn of_cutouts(
        exposure: Files<'_>,
        positions: Table<'_>,
        first_pixel: u8,
        side: usize,
    ) -> Result<Self, FileError> {
        // From here on the first pixel is 1.
        let shift = 1.0 - f64::from(first_pixel);
        let mut positions = Positions::read(positions)?;
        for (x, y) in &mut positions.all {
            (*x, *y) = (*x + shift, *y + shift);
        }
        let path = &exposure.paths[0];
        let mut exposure = Exposure::open(exposure)?;
        let mut messages: Vec<String> = positions.note.clone().into_iter().collect();
        messages.extend(positions.examine(path, exposure.sides()?)?);
        Ok(Plan {
            stack: Stack {
                count: positions.all.len(),
                side,
                wcs: exposure.wcs()?,
            },
            positions: positions.all,
            messages,
        })
    }
}

struct Stack {
    count: usize,
    side: usize,
    wcs: Wcs,
}

impl Stack {
    fn of(files: Files<'_>, square: Option<Square>) -> Result<(Self, Vec<String>), FileError> {
        let (mut count, mut first, mut messages) = (0usize, None, Vec::new());
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
                    Content::Psf | Content::Mask => String::new(),
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
            let wcs = Wcs::of_header(image);
            let (expected, first_wcs) = *first.get_or_insert((side, wcs));
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
            if messages.is_empty() && Wcs::disagreements(&wcs, &first_wcs).next().is_some() {
                let message = "the header states other pixel axes or another pixel scale than that of the first image, so that ellipticities are not along the same axes. Try: one orientation per image (--image)";
                messages.push(format!("warning: {}", origin.fault(message)));
            }
            count += image.planes();
            if count > MAX_STAMPS {
                return Err(origin.fault(&format!("there are more than {MAX_STAMPS} stamps")));
            }
        }
        // No list of files is empty.
        let (_, wcs) = first.unwrap_or_default();
        let [least, side] = sides;
        if least < side {
            messages.push(format!(
                "note: {}: the stamps have sides of {least} to {side} px. Smaller ones get missing pixels around them, to {side} px",
                files.paths[0].display()
            ));
        }
        Ok((Stack { count, side, wcs }, messages))
    }
}

// A warning if the PSF is too broad for the galaxies.
fn width(galaxies: &Examination, psfs: &GatheredPsfs) -> Result<Option<Warning>, FileError> {
    let mut both = galaxies.clone();
    both.join(&psfs.examination);
    let broad = |warning: &Warning| matches!(warning, Warning::PsfBroad { .. });
    match both.warnings().into_iter().find(broad) {
        Some(warning) if warning.is_fatal() => Err(FileError::new(&psfs.first, warning)),
        found => Ok(found),
    }
}

// Advice if positions are counted from another first pixel than specified.
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
        .all(|found| (found - expected).abs() < MAX_OFFSET_PX);
    off.then(|| format!(". Are the positions counted from {other}? Try: --first-pixel {other}"))
}
