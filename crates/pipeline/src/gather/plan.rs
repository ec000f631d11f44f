//! Sizes, positions and pixels on the sky of all stamps, which are checked before the first one is written.

use std::path::Path;

use shearq_dataset::grid::Mosaic;
use shearq_dataset::layout::MAX_STAMP;
use shearq_files::fits::image_heads;
use shearq_files::frames::polars::Column;
use shearq_files::table::{MAX_ROWS, Place};
use shearq_files::{FileError, names_of};
use shearq_measure::Detector;
use shearq_quantities::linear::Matrix2;
use shearq_quantities::statistics::upper_median;
use shearq_quantities::{Frame, Jacobian, tried};

use super::exposure::Exposure;
use super::files::{Content, Files, Images};
use super::mosaic::{Origins, StampWriter};
use super::positions::{Positions, Table, pixels_of_rows, rows_of_stamps};
use super::request::{Gathering, Square, Stamps};
use crate::stamp_table::{self, Head};
use crate::wcs::{READ_PROJECTIONS, Wcs, aligned};

// Most stamps of one image: one per galaxy of the largest grid.
const MAX_STAMPS: usize = MAX_ROWS;
// Least pixels a side of a single stamp that looks like a mosaic or an exposure: four times the default stamp.
const LARGE_STAMP_PX: usize = 192;
// As --psf-oversampling.
const MAX_OVERSAMPLING: f64 = 32.0;
// Relative difference of pixel scales that are the same. Chosen by hand: detectors have distortions of some percent, and factors are
// 2 or more.
const MAX_SCALE_DIFFERENCE: f64 = 0.1;
const SQUARE: &str =
    "--square crop, which takes the central square; --square pad, which adds missing pixels; or ";
const MOSAIC: &str = "--exposure with --positions, which cuts stamps out of an exposure. A mosaic is read as DATA/set01/galaxies-001.fits, with `stamp = SIDE` in DATA/layout.toml";

const PIXEL_AXES: &str = "--frame pixel, for ellipticities along the pixel axes";

pub(super) struct Plan {
    /// Where they are cut out of an exposure.
    pub(super) positions: Option<Positions>,
    /// Whether these are on the exposure.
    pub(super) inside: Vec<bool>,
    /// Which rows of their table were not left out.
    pub(super) kept: Vec<bool>,
    pub(super) stack: Stack,
    pub(super) messages: Vec<String>,
}

impl Plan {
    pub(super) fn of(
        stamps: &Stamps<'_>,
        square: Option<Square>,
        chips: bool,
    ) -> Result<Self, FileError> {
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

    /// The same with the pixels at the places of stamps in a table, where the WCS of a cube needs them.
    pub(super) fn with_places(mut self, rows: Option<Table<'_>>) -> Result<Self, FileError> {
        let (Some(_), Some(rows)) = (&self.stack.fault_of_cube, rows) else {
            return Ok(self);
        };
        let columns = rows_of_stamps(rows, self.stack.count)?;
        if let Some(places) = pixels_of_rows(&columns) {
            let at = |(x, y)| (1, self.stack.wcs.jacobian([x, y]));
            self.stack.of_images = places.into_iter().map(at).collect();
            self.stack.fault_of_cube = None;
        }
        Ok(self)
    }

    pub(super) fn places(&self) -> &[(f64, f64)] {
        self.positions.as_ref().map_or(&[], |found| &found.all)
    }

    /// Jacobians of the stamps, of those whose header has a WCS.
    pub(super) fn pixels(&self) -> Vec<Option<Matrix2>> {
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
    pub(super) fn jacobians(
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
        let fault = |message: &str| FileError::new(&files.paths[0], message);
        if frame == Some(Frame::Pixel) {
            return Ok(None);
        }
        if let Some(error) = &self.stack.fault_of_cube {
            return Err(fault(error).hint("--positions with x and y of each stamp, in FITS pixels of the exposure, or --frame pixel, for ellipticities along the pixel axes"));
        }
        let all: Option<Vec<Matrix2>> = self.pixels().into_iter().collect();
        let Some(all) = all else {
            if let Some(error) = self.stack.wcs.fault() {
                return Err(fault(&error).hint(PIXEL_AXES));
            }
            let expected = format!("and the header has no WCS (expected {READ_PROJECTIONS})");
            return match (frame, gathering.frame) {
                (Some(Frame::Sky), Some(_)) => Err(fault(&format!("--frame is sky, {expected}"))),
                (Some(Frame::Sky), None) => Err(fault(&format!(
                    "the exposures have different pixels on the sky, {expected}"
                ))
                .hint(format!(
                    "a header with a WCS, or {PIXEL_AXES} of each exposure"
                ))),
                _ => Ok(None),
            };
        };
        if let Some(kind) = self.stack.wcs.unread() {
            let message = format!(
                "the WCS is {kind} (expected {READ_PROJECTIONS}), so that the pixels on the sky are not known"
            );
            return Err(fault(&message).hint(PIXEL_AXES));
        }
        // Pixels that are already along the sky need no Jacobians, which take time in each measurement.
        let plain = all.iter().all(aligned);
        if plain && frame.is_none() {
            return Ok(None);
        }
        for (row, jacobian) in all.iter().enumerate() {
            if let Err(error) = Jacobian::new(*jacobian) {
                let row = row + 1;
                let message = format!("the WCS has no inverse at stamp {row}: {error}");
                return Err(fault(&message).hint("--frame pixel, or correct the header"));
            }
        }
        Ok(Some(all))
    }

    pub(super) fn columns(
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
            let message = format!(
                "the only stamp is {side} × {side} px, which looks like a mosaic of stamps or an exposure"
            );
            let warning = FileError::new(&files.paths[0], message).hint(MOSAIC);
            messages.push(format!("warning: {warning}"));
        }
        Ok(Plan {
            positions: None,
            inside: Vec::new(),
            kept: Vec::new(),
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
                fault_of_cube: None,
            },
            kept: vec![true; inside.len()],
            inside,
            positions: Some(positions),
            messages,
        })
    }
}

pub(super) struct Stack {
    pub(super) count: usize,
    pub(super) side: usize,
    /// Of the first image.
    pub(super) wcs: Wcs,
    /// Jacobians of images with several stamps each, with the numbers of stamps.
    of_images: Vec<(usize, Option<Matrix2>)>,
    /// A warning if an image has other pixels than the first one.
    pub(super) differs: Option<String>,
    /// What is wrong with the WCS of cubes.
    pub(super) fault_of_cube: Option<String>,
}

/// What a header states of the size of its pixels.
#[derive(Debug, Clone, Copy, Default)]
pub struct PixelSize {
    /// In arcseconds.
    pub scale: Option<f64>,
    /// Pixels of a PSF along one of the galaxies: OVERSAMP of STPSF and WebbPSF, the inverse of PSF_SAMP of PSFEx, or either of SAMPLING.
    pub oversampling: Option<f64>,
    /// Of the image that has these pixels.
    pub detector: Detector,
}

impl PixelSize {
    pub(super) fn of_wcs(wcs: &Wcs) -> Self {
        PixelSize {
            scale: wcs.scale(),
            oversampling: wcs.oversampling(),
            detector: wcs.detector(),
        }
    }

    /// What is said of a sampling that cannot be used, if the scales do not state the sampling, too.
    pub fn unused(&self, galaxies: Option<f64>) -> Option<String> {
        let stated = self.oversampling.filter(|stated| *stated != 1.0)?;
        let is_unused =
            self.scale.and(galaxies).is_none() && self.oversampling_of(galaxies).is_none();
        is_unused.then(|| format!("the header states {stated:.3} pixels of the PSF along a pixel of the galaxies (found OVERSAMP, PSF_SAMP or SAMPLING, expected a whole number of 1 to {MAX_OVERSAMPLING}), which is not used. A PSF of other pixels biases m by 1.3 times the relative difference or more{}", tried(Some("resample the PSF to the pixels of the galaxies"))))
    }

    /// The pixels of PSFs along a pixel of galaxies of this scale, unless the scales contradict it.
    pub fn oversampling_of(&self, galaxies: Option<f64>) -> Option<usize> {
        let stated = self
            .oversampling
            .filter(|stated| (2.0..=MAX_OVERSAMPLING).contains(stated) && stated.fract() == 0.0)?;
        let agrees = self.scale.zip(galaxies).is_none_or(|(psf, galaxies)| {
            (stated * psf / galaxies - 1.0).abs() < MAX_SCALE_DIFFERENCE
        });
        agrees.then_some(stated as usize)
    }
}

impl Stack {
    /// What the first header states of the size of pixels.
    pub(super) fn pixel_size(&self) -> PixelSize {
        PixelSize::of_wcs(&self.wcs)
    }

    /// Jacobians of the stamps.
    pub(super) fn pixels(&self) -> Vec<Option<Matrix2>> {
        let each = self.of_images.iter();
        let each = each.flat_map(|&(count, jacobian)| std::iter::repeat_n(jacobian, count));
        each.collect()
    }

    pub(super) fn of(
        files: Files<'_>,
        square: Option<Square>,
    ) -> Result<(Self, Vec<String>), FileError> {
        let (mut count, mut first, mut messages) = (0usize, None, Vec::new());
        let (mut of_images, mut differs, mut fault_of_cube) = (Vec::new(), None, None);
        let mut sides = [0; 2];
        let mut images = Images::of(files);
        while let Some((origin, image)) = images.next()? {
            let (width, height) = (image.width(), image.height());
            if width.max(height) > MAX_STAMP || width != height && square.is_none() {
                let fault = origin.fault(&format!(
                    "the stamp is {width} × {height} pixels; expected a square of at most {MAX_STAMP}"
                ));
                return Err(match files.content {
                    Content::Sky if width.max(height) < LARGE_STAMP_PX => {
                        fault.hint(format!("{SQUARE}{MOSAIC}"))
                    }
                    Content::Sky => fault.hint(MOSAIC),
                    Content::Psf if width.max(height) <= MAX_STAMP => {
                        fault.hint("--square crop, which takes the central square")
                    }
                    _ => fault,
                });
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
            fault_of_cube = fault_of_cube.or_else(|| wcs.fault_of_cube(image.planes(), centre));
            let (expected, first_wcs) = &*first.get_or_insert_with(|| (side, wcs.clone()));
            let expected = *expected;
            if side != expected && files.content == Content::Psf {
                let message = format!(
                    "the stamp is {width} × {height} pixels; the first has {expected} × {expected}"
                );
                let hint = psf_extension_advice(origin.file);
                return Err(origin.fault(&message).hint_if(hint));
            }
            sides = match sides {
                [0, 0] => [side; 2],
                [least, most] => [side.min(least), side.max(most)],
            };
            let is_other = wcs.states_axes() != first_wcs.states_axes()
                || Wcs::disagreements(&wcs, first_wcs).next().is_some();
            if differs.is_none() && is_other {
                let message = "the header states other pixel axes or another pixel scale than that of the first image, so that ellipticities are not along the same axes";
                differs = Some(format!(
                    "warning: {}",
                    origin
                        .fault(message)
                        .hint("one orientation per image (--image)")
                ));
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
            fault_of_cube,
        };
        Ok((stack, messages))
    }
}

/// What to try with a file of several images as PSFs; `None` of a file of one. STPSF and WebbPSF write the PSF on fine pixels and on the
/// detector's, without and with distortion.
pub(super) fn psf_extension_advice(path: &Path) -> Option<String> {
    const DETECTOR_PIXELS: &str = "DET_DIST";
    let heads = image_heads(&Place::of(path).path).unwrap_or_default();
    let named: Vec<&str> = heads.iter().map(|head| head.name.as_str()).collect();
    let chosen = named.iter().find(|name| **name == DETECTOR_PIXELS);
    let chosen = chosen.or(named.iter().find(|name| !name.is_empty()));
    let name = chosen.filter(|_| named.len() > 1)?;
    let shown: Vec<_> = heads.iter().map(|head| head.shown(&heads)).collect();
    Some(format!(
        "--psf-extension {name} for one of the images ({})",
        names_of(&shown)
    ))
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
