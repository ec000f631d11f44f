//! PSFs of the stamps: one for all, one per galaxy, a table of functional ones, or a model that is drawn at the galaxies.

use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayView2};
use shearq_dataset::grid::{Mosaic, psfs_text, read_psfs};
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_files::{FileError, atomic};
use shearq_measure::{
    EXAMINED_PSFS, Examination, ExaminedPsfs, INVERTED_PSF, Oversampling, Psfs, Star, Truncation,
    Warning,
};
use shearq_quantities::linear::Matrix2;
use shearq_submissions::PsfCut;
use shearq_submissions::limits::MIN_PSF;

use super::files::PlaneReader;
use super::model::{Chip, PsfModel};
use super::mosaic::{Rows, central, first};
use super::plan::{Plan, Stack, psf_extension_advice};
use super::request::Gathering;
use crate::wcs::Wcs;

// Central pixels of a PSF that are examined, along each axis: those that configurations use.
const EXAMINED_SIDE_PX: usize = 48;
pub(super) struct GatheredPsfs {
    pub(super) file: PsfFile,
    pub(super) examination: Examination,
    pub(super) messages: Vec<String>,
    /// Of the first PSF, and the Jacobians of all.
    pub(super) wcs: Wcs,
    pub(super) pixels: Vec<Option<Matrix2>>,
    pub(super) first: PathBuf,
}

/// Gathers the PSFs of `files`, whose images have `oversampling` pixels along each pixel of the galaxies.
pub(super) fn gather_psfs(
    data: &DataFolder,
    id: ImageId,
    gathering: &Gathering<'_>,
    plan: &Plan,
    chip: Chip,
    places: Option<Vec<(f64, f64)>>,
) -> Result<GatheredPsfs, FileError> {
    let (files, square) = (gathering.psfs, gathering.square);
    let oversampling = gathering.psf_oversampling.unwrap_or(1);
    let mosaic = &Mosaic::of(plan.stack.count, plan.stack.side);
    if let [path] = files.paths
        && let Some(model) = PsfModel::read(path, chip)?
    {
        if oversampling > 1 {
            let message = format!(
                "a model states its own sampling (found an oversampling of {oversampling}, expected none)"
            );
            return Err(FileError::new(path, message).hint("without --psf-oversampling"));
        }
        let to = data.psf_star(id.set, id.image);
        return of_model(path, &model, &to, plan, places);
    }
    if let [table] = files.paths
        && table
            .extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
    {
        if oversampling != 1 {
            let message = "a table of functional PSFs has no pixels that could be oversampled";
            return Err(FileError::new(table, message));
        }
        return functional(data.psf_functional(id.set, id.image), table, mosaic);
    }
    let (stack, mut messages) = Stack::of(files, square)?;
    let path = &files.paths[0];
    let (oversampling, message) = oversampling_of(gathering, &stack, plan, path);
    messages.extend(message);
    let (count, fine) = (stack.count, stack.side);
    let side = fine / oversampling;
    // Headers of finer pixels state another scale.
    let (wcs, mut pixels_of_all) = match oversampling {
        1 => (stack.wcs.clone(), stack.pixels()),
        _ => (Wcs::default(), Vec::new()),
    };
    messages.extend(small(&files.paths[0], side));
    // A cube may have the PSFs of all rows of the positions, also of those that are left out.
    let kept = Some(&plan.kept).filter(|kept| kept.len() == count && count != mosaic.galaxies);
    let count = kept.map_or(count, |_| mosaic.galaxies);
    if let Some(kept) = kept {
        let mut rows = kept.iter();
        pixels_of_all.retain(|_| rows.next() == Some(&true));
    }
    check_count(&files.paths[0], count, mosaic)?;
    let path = data.psf_star(id.set, id.image);
    let mut writer = StarWriter::create(&path, count, side, &wcs)?;
    let mut planes = PlaneReader::of(files);
    let finer = (oversampling > 1).then(|| Oversampling::new((fine, fine), oversampling));
    let finer = finer.transpose();
    let mut rows = kept.into_iter().flatten();
    let before = messages.len();
    while let Some((origin, pixels)) = planes.next()? {
        if rows.next() == Some(&false) {
            continue;
        }
        let pixels = central(pixels, planes.sides(), fine);
        if oversampling > 1 && messages.len() == before {
            messages.extend(truncated(
                origin.file,
                &light_of(&pixels, [fine; 2]),
                oversampling as f64,
            ));
        }
        let finer = finer
            .as_ref()
            .map_err(|error| origin.fault(&error.to_string()))?;
        let pixels = match finer {
            None => pixels,
            Some(finer) => on_galaxy_pixels(pixels, fine, finer),
        };
        let light = writer.add(&pixels)?;
        if count == 1 && writer.dark > 0 {
            let missing = pixels.iter().filter(|value| !value.is_finite()).count();
            return Err(match missing {
                0 => origin
                    .fault(&format!("the pixels of the PSF add up to {light}; expected a positive sum"))
                    .hint_if((light < 0.0).then(|| INVERTED_PSF.to_owned())),
                _ => origin
                    .fault(&format!(
                        "{missing} of {} pixels of the PSF are missing (NaN or infinite; expected none)",
                        pixels.len()
                    ))
                    .hint("a model of the PSF, or values of the neighbours in their place"),
            });
        }
    }
    Ok(writer.gathered(&files.paths[0], messages, wcs, pixels_of_all))
}

/// The pixels of PSFs along a pixel of the galaxies, as the option or else the header states them, and what is said of the header.
fn oversampling_of(
    gathering: &Gathering<'_>,
    psfs: &Stack,
    plan: &Plan,
    path: &Path,
) -> (usize, Option<String>) {
    if let Some(given) = gathering.psf_oversampling {
        return (given, None);
    }
    let (size, scale, path) = (psfs.pixel_size(), plan.stack.wcs.scale(), path.display());
    match size.oversampling_of(scale) {
        Some(stated) => {
            let note = format!(
                "note: {path}: the PSF has {stated} × {stated} pixels for a pixel of the galaxies, as OVERSAMP, PSF_SAMP or SAMPLING of its header states. --psf-oversampling 1 ignores that"
            );
            (stated, Some(note))
        }
        None => {
            let unused = size.unused(scale);
            (1, unused.map(|text| format!("warning: {path}: {text}")))
        }
    }
}

/// The PSFs of a model at the galaxies, on pixels that have the size of the stamps.
fn of_model(
    path: &Path,
    model: &PsfModel,
    to: &Path,
    plan: &Plan,
    places: Option<Vec<(f64, f64)>>,
) -> Result<GatheredPsfs, FileError> {
    let Some(mut places) = places else {
        let message = "a model of the PSF is drawn at the galaxies, whose places are not known (expected columns x and y, in FITS pixels of the exposure)";
        return Err(FileError::new(path, message).hint("--positions"));
    };
    // A galaxy beyond the exposure has no pixels here, and a polynomial may have any value there.
    let inside = plan.inside.iter().position(|inside| *inside);
    if let Some(known) = inside.map(|inside| places[inside]) {
        let all = places.iter_mut().zip(&plan.inside);
        all.filter(|(_, inside)| !**inside)
            .for_each(|(place, _)| *place = known);
    }
    let side = plan.stack.side.max(MIN_PSF);
    let mut writer = StarWriter::create(to, places.len(), side, &plan.stack.wcs)?;
    model.draw(&places, side, plan.stack.wcs.scale(), |stamp| {
        writer.add(stamp).map(|_| ())
    })?;
    let messages = model
        .framed(&places)
        .and_then(|(psf, fine)| truncated(path, &psf, fine));
    Ok(writer.gathered(
        path,
        messages.into_iter().collect(),
        plan.stack.wcs.clone(),
        plan.pixels(),
    ))
}

/// PSF stamps that are written and examined: one, or one per galaxy in the same places.
struct StarWriter {
    image: Rows,
    examination: Examination,
    side: usize,
    /// PSFs without light.
    dark: usize,
}

impl StarWriter {
    fn create(path: &Path, count: usize, side: usize, wcs: &Wcs) -> Result<Self, FileError> {
        let examination = Examination::new(side, 0);
        Ok(StarWriter {
            image: Rows::create(path, Mosaic::of(count, side), &wcs.keys())?,
            examination: match count {
                1 => examination,
                _ => examination.with_psf_of_each(),
            },
            side,
            dark: 0,
        })
    }

    /// Returns the sum of the pixels.
    fn add(&mut self, pixels: &[f32]) -> Result<f64, FileError> {
        let side = self.side;
        let light: f64 = pixels.iter().map(|&value| f64::from(value)).sum();
        self.dark += usize::from(!(light > 0.0 && light.is_finite()));
        if let Ok(stamp) = ArrayView2::from_shape((side, side), pixels)
            && let Ok(Star { psf, moved, .. }) = Star::cut(stamp, examined_cut(side))
        {
            self.examination.add_psf(psf.view(), moved);
        }
        self.image.add(pixels)?;
        Ok(light)
    }

    fn gathered(
        self,
        first: &Path,
        mut messages: Vec<String>,
        wcs: Wcs,
        pixels: Vec<Option<Matrix2>>,
    ) -> GatheredPsfs {
        messages.extend(named(&self.examination, first));
        if self.dark > 0 {
            messages.push(format!(
                "warning: {} of {} PSFs have no positive sum of pixels. Their galaxies will be flagged",
                self.dark, self.image.mosaic.galaxies
            ));
        }
        GatheredPsfs {
            file: PsfFile::Stars(Box::new(self.image)),
            examination: self.examination,
            messages,
            wcs,
            pixels,
            first: first.to_owned(),
        }
    }
}

/// A PSF of `fine` pixels a side integrated over pixels of the galaxies.
fn on_galaxy_pixels(pixels: Vec<f32>, fine: usize, finer: &Oversampling) -> Vec<f32> {
    let psf = finer.psf(light_of(&pixels, [fine; 2]).view());
    psf.iter().map(|&value| value as f32).collect()
}

fn light_of(pixels: &[f32], [columns, rows]: [usize; 2]) -> Array2<f64> {
    let light = pixels.iter().map(|&value| f64::from(value)).collect();
    Array2::from_shape_vec((rows, columns), light).unwrap_or_default()
}

/// The warning about a PSF that ends where it has light, of which so many pixels are along a pixel of the galaxies. Interpolation to
/// those hides the end.
fn truncated(path: &Path, psf: &Array2<f64>, oversampling: f64) -> Option<String> {
    let warning = truncation(psf, oversampling)?;
    Some(format!("warning: {}: {warning}", path.display()))
}

pub(crate) fn truncation(psf: &Array2<f64>, oversampling: f64) -> Option<Warning> {
    let found = Truncation::of(psf.view(), oversampling)?;
    Some(Warning::PsfTruncated {
        side: found.side,
        level: found.level,
        effect: found.effect(),
        of: ExaminedPsfs { count: 1, of: 1 },
    })
}

// Named configurations refuse such PSF stamps. Users should learn it before they have gathered all images.
fn small(path: &Path, side: usize) -> Option<String> {
    (side < MIN_PSF).then(|| {
        let message = format!(
            "the PSF stamps are {side} × {side} px (expected {MIN_PSF} × {MIN_PSF} or more, which configurations of 48 px require)"
        );
        let hint = format!(
            "larger PSF stamps; or, if no light is beyond them, --submission own.toml with the file own.toml of these lines:\n  extends = \"48/linear/star\"\n  psf.size = {}",
            side - side % 2
        );
        format!("warning: {}", FileError::new(path, message).hint(hint))
    })
}

fn check_count(path: &Path, found: usize, mosaic: &Mosaic) -> Result<(), FileError> {
    if found == 1 || found == mosaic.galaxies {
        return Ok(());
    }
    let message = format!(
        "there are {found} PSFs; expected one, or one for each of the {} stamps",
        mosaic.galaxies
    );
    let average = "average stars before, as average_stars of the crate shearq-measure does";
    let hint = psf_extension_advice(path).unwrap_or_else(|| average.to_owned());
    Err(FileError::new(path, message).hint(hint))
}

fn examined_cut(side: usize) -> PsfCut {
    let size = side - side.saturating_sub(EXAMINED_SIDE_PX).next_multiple_of(2);
    PsfCut {
        size,
        // So that a star off the centre can be cut around itself.
        least: size - (size / 3).next_multiple_of(2),
        centred: false,
    }
}

// In the order of the galaxies, like stars. Positions in the mosaic replace the positions of the table, which are on another image.
fn functional(path: PathBuf, table: &Path, mosaic: &Mosaic) -> Result<GatheredPsfs, FileError> {
    let mut rows = read_psfs(table)?;
    check_count(table, rows.len(), mosaic)?;
    for (place, (position, _)) in rows.iter_mut().enumerate() {
        *position = mosaic.position(place);
    }
    let mut examination = Examination::new(mosaic.stamp, 0);
    let psfs: Vec<_> = rows.iter().map(|(_, psf)| *psf).collect();
    let cut = examined_cut(mosaic.stamp);
    examination.add_psfs(&Psfs::functional(psfs), cut, EXAMINED_PSFS);
    Ok(GatheredPsfs {
        file: PsfFile::Table(path, psfs_text(&rows)),
        examination,
        messages: Vec::new(),
        wcs: Wcs::default(),
        pixels: Vec::new(),
        first: table.to_owned(),
    })
}

/// The warnings of an examination, with the file that they are about.
fn named(examination: &Examination, path: &Path) -> Vec<String> {
    let found = examination.warnings();
    let line = |warning: &Warning| format!("warning: {}: {warning}", path.display());
    found.iter().map(line).collect()
}

pub(super) enum PsfFile {
    Stars(Box<Rows>),
    Table(PathBuf, String),
}

impl PsfFile {
    pub(super) fn finish(self) -> Result<(), FileError> {
        match self {
            PsfFile::Stars(image) => image.finish(),
            PsfFile::Table(path, text) => {
                first(atomic::write_if_absent(&path, text.as_bytes())?, path)
            }
        }
    }
}
