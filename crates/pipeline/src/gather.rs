//! Gathering stamps into an image of a data folder: cubes, files of one or several images each, and cut-outs of an
//! exposure.

mod array;
mod exposure;
mod files;
mod maps;
mod model;
mod mosaic;
mod plan;
mod positions;
mod psfs;
mod request;

use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;
use shearq_measure::{Examination, PixelFrame, Warning};
use shearq_quantities::Frame;
use shearq_quantities::linear::Matrix2;

pub use self::array::{
    GatheredPixels, HeaderPixels, is_aligned, pixel_difference, scale_difference,
};
pub(crate) use self::exposure::Exposure;
pub use self::files::{Content, Files};
pub(crate) use self::files::{Origin, PlaneReader};
pub(crate) use self::maps::{another, lose};
pub(crate) use self::model::{Chip, PsfModel};
use self::mosaic::{Rows, StampWriter, already};
pub use self::plan::PixelSize;
use self::plan::Plan;
pub use self::positions::Table;
use self::positions::{pixels_of_rows, rows_of_stamps};
pub(crate) use self::psfs::truncation;
use self::psfs::{GatheredPsfs, PsfFile, gather_psfs};
pub use self::request::{Gathering, Masks, Square, Stamps};
use super::PipelineError;
use super::measure::check_strip;
use crate::stamp_table::{self, Head, StampTable};
use crate::wcs::Wcs;
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_files::open::is_there;
use shearq_files::{FileError, atomic};

// Largest difference of the median offset from the one pixel between positions from 0 and from 1. Chosen by hand.
const MAX_ORIGIN_MISMATCH_PX: f64 = 0.5;

#[derive(Debug)]
pub struct Gathered {
    pub mosaic: Mosaic,
    /// Stamps with pixels that are beyond the exposure, masked, or not finite in their file.
    pub incomplete: usize,
    pub messages: Vec<String>,
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
        let message = "this folder is a branch of GREAT3, to which no image can be added (expected a folder of gathered images, or a new one)";
        return Err(FileError::new(data.root(), message)
            .hint("another folder")
            .into());
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
        .map(|one| Plan::of(&one.stamps, one.square, chips)?.with_places(one.rows));
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
                .is_some_and(|found| !found.degrees)
        {
            let message = format!(
                "x and y are pixels of one chip (found one table for {} chips, expected right ascension and declination, or a table for each)",
                same.len()
            );
            return Err(FileError::new(table.path, message).hint("--degrees"));
        }
        let on_none = (0..count).filter(|&row| !same.iter().any(|&chip| plans[chip].inside[row]));
        let on_none = on_none.count();
        if on_none == count {
            let message = format!("all {count} positions are outside the {} chips", same.len());
            return Err(FileError::new(table.path, message)
                .hint("check the positions and the WCS of the chips"));
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
            plan.kept.clone_from(&plan.inside);
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
        plan.kept = kept;
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
    let (count, side, wcs) = (plan.stack.count, plan.stack.side, &plan.stack.wcs);
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
    messages.extend(writer.masked_line(gathering));
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
                    let text = format!("stamp {row}: {warning}");
                    return Err(FileError::with_hint(&psfs.first, &text, warning.hint()));
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
        Some(warning) => Err(FileError::with_hint(&psfs.first, warning, warning.hint())),
        None => Ok(warnings),
    }
}

// The examinations of both are joined, because the condition compares the widths of PSF and galaxies.
fn width(galaxies: &Examination, psfs: &GatheredPsfs) -> Result<Option<Warning>, FileError> {
    let mut both = galaxies.clone();
    both.join(&psfs.examination);
    let broad = |warning: &Warning| matches!(warning, Warning::PsfBroad { .. });
    match both.warnings().into_iter().find(broad) {
        Some(warning) if warning.is_fatal() => {
            Err(FileError::with_hint(&psfs.first, &warning, warning.hint()))
        }
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
