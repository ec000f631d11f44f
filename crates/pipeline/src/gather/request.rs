//! What is gathered: files of stamps, PSFs, masks and maps, as the user gives them.

use serde::Serialize;
use shearq_quantities::Frame;

use super::files::Files;
use super::positions::Table;

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
    pub(super) fn positions(&self) -> Option<Table<'a>> {
        match self {
            Stamps::Files(_) => None,
            Stamps::Cutouts { positions, .. } => Some(*positions),
        }
    }

    /// Coordinate of the centre of the first pixel in catalogues.
    pub(super) fn first_pixel(&self) -> u8 {
        match self {
            Stamps::Files(_) => 1,
            Stamps::Cutouts { first_pixel, .. } => *first_pixel,
        }
    }
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
