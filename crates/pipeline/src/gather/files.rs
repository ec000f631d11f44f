//! The images of FITS files that are gathered, chosen by name, version, number or plane.

use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};
use shearq_files::FileError;
use shearq_files::fits::{ImageHead, ImageReader, Pixel, Planes, Selection};
use shearq_files::table::Place;

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

/// FITS files and which images of them are meant.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Files<'a> {
    /// At least one. `FILE[SELECTION]` has a selection for this file.
    #[serde(serialize_with = "all_shown")]
    pub paths: &'a [PathBuf],
    /// A [`Selection`] of images; all if `None`.
    pub extension: Option<&'a str>,
    #[serde(skip)]
    pub content: Content,
}

// Most planes of a cube that may be bands of one galaxy. Chosen by hand: LSST has six, and J-PLUS twelve.
const MAX_BANDS: usize = 12;

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
    pub(super) fn is_not(self, name: &str) -> bool {
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
pub(crate) struct Origin<'a> {
    pub(super) file: &'a Path,
    pub(super) image: usize,
    pub(super) plane: usize,
    pub(super) position: Option<(f64, f64)>,
}

impl Origin<'_> {
    pub(crate) fn fault(&self, what: &str) -> FileError {
        let Origin { image, plane, .. } = self;
        FileError::new(self.file, format!("image {image}, plane {plane}: {what}"))
    }
}

impl Files<'_> {
    /// One of the files, and which images of it are meant: those that `FILE[SELECTION]` or the extension names.
    pub(super) fn selected(&self, path: &Path) -> Result<(PathBuf, Selection), FileError> {
        let (path, text) = self.place(path)?;
        let selection = text.as_deref().map(Selection::parse).transpose();
        let selection = selection.map_err(|message| FileError::new(&path, message))?;
        Ok((path, selection.unwrap_or_default()))
    }

    fn place(&self, path: &Path) -> Result<(PathBuf, Option<String>), FileError> {
        let Place { path, table } = Place::of(path);
        match (table, self.extension, self.content) {
            (Some(inner), Some(outer), Content::Sky | Content::Psf) => {
                let message = format!(
                    "images are chosen twice (found `{inner}` in brackets and {} {outer}; expected one)",
                    self.content.option()
                );
                Err(FileError::new(&path, message))
            }
            // Masks and weights in the file of the image, which may have its brackets.
            (_, Some(outer), _) => Ok((path, Some(outer.to_owned()))),
            (inner, None, _) => Ok((path, inner)),
        }
    }
}

/// The images of files in turn, those that are meant.
pub(super) struct Images<'a> {
    files: Files<'a>,
    begun: usize,
    selection: Selection,
    now: Option<ImageReader>,
    number: usize,
    /// The images that were skipped, and whether one was not.
    others: Vec<ImageHead>,
    found: bool,
    /// Cubes of as many planes as there may be bands.
    small_cubes: usize,
}

impl<'a> Images<'a> {
    pub(super) fn of(files: Files<'a>) -> Self {
        Images {
            files,
            begun: 0,
            selection: Selection::default(),
            now: None,
            number: 0,
            others: Vec::new(),
            found: false,
            small_cubes: 0,
        }
    }

    pub(super) fn content(&self) -> Content {
        self.files.content
    }

    /// The image that was found last.
    pub(super) fn now(&mut self) -> Option<&mut ImageReader> {
        self.now.as_mut()
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
                let (path, selection) = self.files.selected(path)?;
                self.selection = selection;
                self.now = Some(ImageReader::open_stack(path)?);
                (self.begun, self.number) = (self.begun + 1, 1);
                (self.found, self.others) = (false, Vec::new());
            }
            let Some(image) = &mut self.now else { continue };
            let mut origin = Origin {
                file: &self.files.paths[self.begun - 1],
                image: self.number,
                plane: 1,
                position: None,
            };
            let head = image.head()?;
            if !self.selection.has(&head) {
                self.others.push(head);
                continue;
            }
            if !self.selection.names_images() && self.files.content.is_not(&head.name) {
                return Err(origin
                    .fault(&format!(
                        "the image is called {}; expected an image of the sky or a PSF",
                        head.name
                    ))
                    .hint(format!(
                        "choose images by name with {}",
                        self.files.content.option()
                    )));
            }
            self.found = true;
            match self.selection.planes {
                Planes::One(plane) => {
                    image.only_plane(plane)?;
                    origin.plane = plane;
                }
                Planes::Unstated if self.files.content == Content::Sky => {
                    let planes = image.planes();
                    self.small_cubes += usize::from((2..=MAX_BANDS).contains(&planes));
                    if planes > 1 && (self.small_cubes > 1 || has_bands(image)) {
                        let message = format!(
                            "the image has {planes} planes, which may be one galaxy in {planes} bands (expected a galaxy per plane)"
                        );
                        return Err(origin.fault(&message).hint("--extension plane=1 for one band, or --extension plane=all if each plane is a galaxy"));
                    }
                }
                Planes::Unstated | Planes::Each => {}
            }
            return Ok(self.now.as_mut().map(|image| (origin, image)));
        }
    }

    // A file without an image of the chosen name would otherwise be skipped, and the stamps would no longer match the PSFs.
    fn all_there(&self) -> Result<(), FileError> {
        let Some(path) = self.files.paths.get(self.begun.wrapping_sub(1)) else {
            return Ok(());
        };
        if self.found {
            return Ok(());
        }
        let (path, text) = self.files.place(path)?;
        let label = |head: &ImageHead| match head.shown(&self.others) {
            // Names tell more where several images share one.
            number if number == head.number.to_string() && !head.name.is_empty() => {
                head.name.clone()
            }
            shown => shown,
        };
        let others = self.others.iter();
        let names = others.map(|head| format!("`{}`", label(head)));
        let message = format!(
            "there is no image called `{}`; found {}",
            text.unwrap_or_default(),
            names.collect::<Vec<_>>().join(", ")
        );
        Err(FileError::new(path, message))
    }
}

// As cut-outs of the Legacy Surveys have it, or by an axis of wavelengths.
fn has_bands(image: &ImageReader) -> bool {
    let kind = image.text("CTYPE3").to_ascii_uppercase();
    let is_spectral = |name: &&str| kind.starts_with(name);
    let named = ["WAV", "AWAV", "FREQ", "BAND", "FILTER"];
    !image.text("BANDS").is_empty() || named.iter().any(is_spectral)
}

/// The planes of images in turn.
pub(crate) struct PlaneReader<'a> {
    images: Images<'a>,
    origin: Option<Origin<'a>>,
    left: usize,
}

impl<'a> PlaneReader<'a> {
    pub(crate) fn of(files: Files<'a>) -> Self {
        PlaneReader {
            images: Images::of(files),
            origin: None,
            left: 0,
        }
    }

    pub(super) fn content(&self) -> Content {
        self.images.content()
    }

    pub(crate) fn sides(&self) -> [usize; 2] {
        let now = self.images.now.as_ref();
        now.map_or([0; 2], |image| [image.width(), image.height()])
    }

    /// That of the image that was read last.
    pub(crate) fn wcs(&mut self) -> Result<Wcs, FileError> {
        self.images
            .now()
            .map_or_else(|| Ok(Wcs::default()), Wcs::of_header)
    }

    // One plane at a time: a cube of stamps can be larger than the memory.
    pub(crate) fn next<P: Pixel>(&mut self) -> Result<Option<(Origin<'a>, Vec<P>)>, FileError> {
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
