//! Stamps and exposures in FITS files, image by image and plane by plane.

use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};

use shearq_files::FileError;
use shearq_files::fits::{ImageReader, Pixel};

use crate::wcs::Wcs;

// Names of images that accompany an image of the sky in one file. They are refused unless the user chooses them: a weight map
// would be measured like a galaxy.
const COMPANIONS: [&str; 15] = [
    "PSF",
    "ERR",
    "ERROR",
    "DQ",
    "MASK",
    "FLAGS",
    "SEG",
    "VAR",
    "VARIANCE",
    "IVAR",
    "WHT",
    "WEIGHT",
    "RMS",
    "BKG",
    "BACKGROUND",
];

// serde refuses paths that are not Unicode; a record may show them lossily.
pub(super) fn shown<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&path.display())
}

fn all_shown<S: Serializer>(paths: &[PathBuf], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(paths.iter().map(|path| path.display().to_string()))
}

/// FITS files and the name of the images in them.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Files<'a> {
    /// At least one.
    #[serde(serialize_with = "all_shown")]
    pub paths: &'a [PathBuf],
    /// Name of the images (EXTNAME, in any case); all images if `None`.
    pub extension: Option<&'a str>,
    #[serde(skip)]
    pub content: Content,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    Sky,
    Psf,
    /// Masks: not zero for a bad pixel.
    Mask,
    /// Variances of pixels, or their inverse: a weight.
    Variance,
    Weight,
}

impl Content {
    /// Whether an image of this name has another content.
    fn is_not(self, name: &str) -> bool {
        let companion = COMPANIONS
            .iter()
            .any(|other| name.eq_ignore_ascii_case(other));
        match self {
            Content::Sky => companion,
            Content::Psf => companion && !name.eq_ignore_ascii_case("PSF"),
            Content::Mask | Content::Variance | Content::Weight => false,
        }
    }

    pub(super) fn option(self) -> &'static str {
        match self {
            Content::Sky => "--extension",
            Content::Psf => "--psf-extension",
            Content::Mask => "--mask-extension",
            Content::Variance => "--variance-extension",
            Content::Weight => "--weight-extension",
        }
    }

    pub(super) fn noun(self) -> &'static str {
        match self {
            Content::Sky => "stamp",
            Content::Psf => "PSF",
            Content::Mask => "mask",
            Content::Variance => "variance map",
            Content::Weight => "weight map",
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Origin<'a> {
    pub(super) file: &'a Path,
    pub(super) image: usize,
    pub(super) plane: usize,
    pub(super) position: Option<(f64, f64)>,
}

impl Origin<'_> {
    pub(super) fn fault(&self, what: &str) -> FileError {
        let Origin { image, plane, .. } = self;
        FileError::new(self.file, format!("image {image}, plane {plane}: {what}"))
    }
}

pub(super) struct Images<'a> {
    files: Files<'a>,
    begun: usize,
    now: Option<ImageReader>,
    number: usize,
    /// Names of the images that were skipped, and whether one was not.
    others: Vec<String>,
    found: bool,
}

impl<'a> Images<'a> {
    pub(super) fn of(files: Files<'a>) -> Self {
        Images {
            files,
            begun: 0,
            now: None,
            number: 0,
            others: Vec::new(),
            found: false,
        }
    }

    pub(super) fn next(&mut self) -> Result<Option<(Origin<'a>, &mut ImageReader)>, FileError> {
        loop {
            if let Some(image) = self.now.take() {
                self.now = image.next_stack()?;
                self.number += 1;
            }
            if self.now.is_none() {
                self.all_there()?;
                let Some(path) = self.files.paths.get(self.begun) else {
                    return Ok(None);
                };
                self.now = Some(ImageReader::open_stack(path)?);
                (self.begun, self.number) = (self.begun + 1, 1);
                (self.found, self.others) = (false, Vec::new());
            }
            let origin = Origin {
                file: &self.files.paths[self.begun - 1],
                image: self.number,
                plane: 1,
                position: None,
            };
            let name = self.now.as_ref().map(ImageReader::name).unwrap_or_default();
            match self.files.extension {
                Some(wanted) if !name.eq_ignore_ascii_case(wanted) => {
                    self.others.push(name);
                    continue;
                }
                None if self.files.content.is_not(&name) => {
                    return Err(origin.fault(&format!(
                        "the image is called {name}; expected an image of the sky or a PSF. Try: choose images by name with {}",
                        self.files.content.option()
                    )));
                }
                Some(_) | None => self.found = true,
            }
            return Ok(self.now.as_mut().map(|image| (origin, image)));
        }
    }

    // A file without an image of the chosen name would otherwise be skipped, and the stamps would no longer match the PSFs.
    fn all_there(&self) -> Result<(), FileError> {
        match (
            self.files.extension,
            self.files.paths.get(self.begun.wrapping_sub(1)),
        ) {
            (Some(wanted), Some(path)) if !self.found => {
                let names = self.others.iter().map(|name| format!("`{name}`"));
                let names = names.collect::<Vec<_>>().join(", ");
                let message = format!("there is no image called `{wanted}`; found {names}");
                Err(FileError::new(path, message))
            }
            _ => Ok(()),
        }
    }
}

pub(super) struct Planes<'a> {
    images: Images<'a>,
    origin: Option<Origin<'a>>,
    left: usize,
}

impl<'a> Planes<'a> {
    pub(super) fn of(files: Files<'a>) -> Self {
        Planes {
            images: Images::of(files),
            origin: None,
            left: 0,
        }
    }

    pub(super) fn content(&self) -> Content {
        self.images.files.content
    }

    pub(super) fn sides(&self) -> [usize; 2] {
        let now = self.images.now.as_ref();
        now.map_or([0; 2], |image| [image.width(), image.height()])
    }

    // One plane at a time: a cube of stamps can be larger than the memory.
    pub(super) fn next<P: Pixel>(&mut self) -> Result<Option<(Origin<'a>, Vec<P>)>, FileError> {
        let origin = match self.origin {
            Some(origin) if self.left > 0 => Origin {
                plane: origin.plane + 1,
                ..origin
            },
            _ => match self.images.next()? {
                None => return Ok(None),
                Some((origin, image)) => {
                    self.left = image.planes();
                    origin
                }
            },
        };
        self.origin = Some(origin);
        self.left -= 1;
        let Some(image) = self.images.now.as_mut() else {
            return Ok(None);
        };
        let pixels = image.read_rows_as(image.height())?;
        Ok(Some((origin, pixels)))
    }
}

/// The first image of a file, to cut squares out of.
pub(super) struct Exposure<'a> {
    images: Images<'a>,
    pub(super) origin: Origin<'a>,
}

impl<'a> Exposure<'a> {
    pub(super) fn open(files: Files<'a>) -> Result<Self, FileError> {
        if let Some(more) = files.paths.get(1) {
            return Err(FileError::new(
                more,
                "this is a second file; expected one file with the exposure",
            ));
        }
        let mut images = Images::of(files);
        let (origin, planes) = match images.next()? {
            Some((origin, image)) => (origin, image.planes()),
            None => {
                return Err(FileError::new(
                    &files.paths[0],
                    "there is no image in this file",
                ));
            }
        };
        if planes != 1 {
            let message =
                format!("the image has {planes} planes; expected an exposure, which has one");
            return Err(origin.fault(&message));
        }
        Ok(Exposure { images, origin })
    }

    fn reader(&mut self) -> Result<&mut ImageReader, FileError> {
        let none = || self.origin.fault("the image is no longer there");
        self.images.now.as_mut().ok_or_else(none)
    }

    pub(super) fn content(&self) -> Content {
        self.images.files.content
    }

    pub(super) fn sides(&mut self) -> Result<[usize; 2], FileError> {
        let reader = self.reader()?;
        Ok([reader.width(), reader.height()])
    }

    pub(super) fn wcs(&mut self) -> Result<Wcs, FileError> {
        Ok(Wcs::of_header(self.reader()?))
    }

    /// Refuses an image of another size than `other`.
    pub(super) fn like(&mut self, other: &mut Self) -> Result<(), FileError> {
        let (own, expected) = (self.sides()?, other.sides()?);
        if own != expected {
            let message = format!(
                "the {} is {} × {} pixels; the exposure has {} × {}",
                self.images.files.content.noun(),
                own[0],
                own[1],
                expected[0],
                expected[1]
            );
            return Err(self.origin.fault(&message));
        }
        Ok(())
    }

    /// The square of `side` pixels a side whose centre is nearest to a position in FITS pixels; NaN beyond the
    /// image.
    pub(super) fn square<P: Pixel>(
        &mut self,
        (x, y): (f64, f64),
        side: usize,
    ) -> Result<Vec<P>, FileError> {
        self.reader()?
            .read_square(first_pixel(x, side), first_pixel(y, side), side)
    }
}

/// First pixel, from 0, of the `side` pixels whose middle is nearest to a position in FITS pixels.
fn first_pixel(at: f64, side: usize) -> i64 {
    (at - (side as f64 + 1.0) / 2.0).round() as i64
}

/// A position on the square that is cut around it, from the centre.
pub(crate) fn subpixel_offset((x, y): (f64, f64), side: usize) -> [f64; 2] {
    [x, y].map(|at| at - (side as f64 + 1.0) / 2.0 - first_pixel(at, side) as f64)
}
