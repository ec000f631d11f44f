//! Images of files in memory, for callers that measure arrays, read as [`gather`](super::gather()) reads them.

use std::collections::BTreeMap;
use std::path::Path;

use shearq_files::FileError;
use shearq_measure::Warning;
use shearq_quantities::linear::Matrix2;

use super::files::{Content, Files, PlaneReader};
use super::mosaic::central;
use super::plan::{PixelSize, Stack};
use crate::wcs::{self, Keys, Wcs};

/// Square images of a file.
#[derive(Debug)]
pub struct GatheredPixels {
    /// Of all images, row by row.
    pub pixels: Vec<f32>,
    pub side: usize,
    /// Of each image, if all headers have a WCS: `((du/dx, du/dy), (dv/dx, dv/dy))` in arcsec, u to the west and v to the north.
    pub jacobians: Option<Vec<Matrix2>>,
    /// Why the header of a cube does not state the pixels of its stamps.
    pub fault_of_cube: Option<String>,
    /// Of the first image.
    pub pixel_size: PixelSize,
    pub messages: Vec<String>,
}

impl GatheredPixels {
    /// Reads stamps or PSFs of a file, or of `FILE[SELECTION]`.
    ///
    /// # Errors
    /// As [`gather`](super::gather()); also if its WCS is damaged or has a projection that is not read.
    pub fn read(path: &Path, content: Content) -> Result<Self, FileError> {
        let files = Files {
            paths: &[path.to_owned()],
            extension: None,
            content,
        };
        let (stack, messages) = Stack::of(files, None)?;
        if let Some(fault) = stack.wcs.fault() {
            return Err(FileError::new(path, fault));
        }
        let mut planes = PlaneReader::of(files);
        let mut pixels = Vec::new();
        while let Some((_, plane)) = planes.next::<f32>()? {
            pixels.extend(central(plane, planes.sides(), stack.side));
        }
        Ok(GatheredPixels {
            pixels,
            side: stack.side,
            jacobians: stack.pixels().into_iter().collect(),
            pixel_size: stack.pixel_size(),
            fault_of_cube: stack.fault_of_cube,
            messages,
        })
    }
}

/// What a header states of pixels.
#[derive(Debug)]
pub struct HeaderPixels {
    /// In the middle of the image.
    pub jacobian: Option<Matrix2>,
    /// Why it is not that of several stamps.
    pub fault_of_cube: Option<String>,
    pub pixel_size: PixelSize,
    /// What of the header is used against its name, or not used.
    pub doubts: Vec<String>,
}

impl HeaderPixels {
    /// From the values of keys as cards have them, texts in quotes, of `planes` images of these sides.
    ///
    /// # Errors
    /// What is wrong with the WCS.
    pub fn from_cards(
        cards: BTreeMap<String, String>,
        sides: [usize; 2],
        planes: usize,
    ) -> Result<Self, String> {
        let wcs = Wcs::of_keys(&Keys::new(cards));
        let middle = sides.map(|side| (side as f64 + 1.0) / 2.0);
        match wcs.fault() {
            Some(fault) => Err(fault),
            None => Ok(HeaderPixels {
                jacobian: wcs.jacobian(middle),
                fault_of_cube: wcs.fault_of_cube(planes, middle),
                pixel_size: PixelSize::of_wcs(&wcs),
                doubts: wcs.doubts().to_vec(),
            }),
        }
    }
}

/// The first difference between pixels of PSFs and of stamps, of which each may be one for all.
pub fn pixel_difference(psfs: &[Matrix2], stamps: &[Matrix2]) -> Option<Warning> {
    let count = psfs.len().max(stamps.len());
    let of = |all: &[Matrix2], k: usize| Some(Wcs::of_jacobian(*all.get(k).or(all.first())?));
    (0..count).find_map(|k| Wcs::disagreements(&of(psfs, k)?, &of(stamps, k)?).next())
}

/// What is wrong with a PSF on pixels of this scale in arcseconds for galaxies on pixels of that one.
pub fn scale_difference(psf: f64, galaxies: f64) -> Option<Warning> {
    wcs::scale_difference(psf, galaxies)
}

/// Whether ellipticities along pixels of this Jacobian are along the axes of the sky.
pub fn is_aligned(jacobian: &Matrix2) -> bool {
    wcs::aligned(jacobian)
}
