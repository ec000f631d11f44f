//! An exposure, or a map of one, out of which squares are cut.

use shearq_files::fits::{ImageHead, ImageReader, Pixel, image_heads};
use shearq_files::{FileError, names_of};

use super::files::{Content, Files, Images, Origin};
use crate::stamp_table::first_pixel;
use crate::wcs::Wcs;

/// One image of a file, to cut squares out of.
pub(crate) struct Exposure<'a> {
    images: Images<'a>,
    pub(crate) origin: Origin<'a>,
    /// Which image of several it is, if the user did not say.
    pub(crate) note: Option<String>,
}

impl<'a> Exposure<'a> {
    pub(crate) fn open(files: Files<'a>) -> Result<Self, FileError> {
        if let Some(more) = files.paths.get(1) {
            return Err(FileError::new(
                more,
                "this is a second file; expected one file with the exposure",
            ));
        }
        let note = check_one(&files)?;
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
            return Err(origin
                .fault(&message)
                .hint(format!("{} plane=1", files.content.option())));
        }
        Ok(Exposure {
            images,
            origin,
            note,
        })
    }

    fn reader(&mut self) -> Result<&mut ImageReader, FileError> {
        let none = || self.origin.fault("the image is no longer there");
        self.images.now().ok_or_else(none)
    }

    pub(super) fn content(&self) -> Content {
        self.images.content()
    }

    pub(crate) fn sides(&mut self) -> Result<[usize; 2], FileError> {
        let reader = self.reader()?;
        Ok([reader.width(), reader.height()])
    }

    pub(super) fn is_asinh(&mut self) -> Result<bool, FileError> {
        Ok(self.reader()?.is_asinh())
    }

    pub(super) fn differs_from_datasum(&mut self) -> Result<bool, FileError> {
        self.reader()?.differs_from_datasum()
    }

    pub(crate) fn wcs(&mut self) -> Result<Wcs, FileError> {
        Wcs::of_header(self.reader()?)
    }

    /// The number of a header key; `None` if absent.
    pub(crate) fn number(&mut self, key: &str) -> Result<Option<f64>, FileError> {
        self.reader()?.number(key)
    }

    /// The next `count` rows, from the first one on.
    pub(crate) fn rows<P: Pixel>(&mut self, count: usize) -> Result<Vec<P>, FileError> {
        self.reader()?.read_rows_as(count)
    }

    /// Refuses an image of another size than `other`.
    pub(crate) fn like(&mut self, other: &mut Self) -> Result<(), FileError> {
        let (own, expected) = (self.sides()?, other.sides()?);
        if own != expected {
            let message = format!(
                "the {} is {} × {} pixels; the exposure has {} × {}",
                self.images.content().noun(),
                own[0],
                own[1],
                expected[0],
                expected[1]
            );
            return Err(self.origin.fault(&message));
        }
        Ok(())
    }

    /// The square of `side` pixels a side from a column and row on, counted from 0; NaN beyond the image.
    pub(crate) fn square_from<P: Pixel>(
        &mut self,
        [x, y]: [i64; 2],
        side: usize,
    ) -> Result<Vec<P>, FileError> {
        self.reader()?.read_square(x, y, side)
    }

    /// The square of `side` pixels a side whose centre is nearest to a position in FITS pixels; NaN beyond the
    /// image.
    pub(crate) fn square<P: Pixel>(
        &mut self,
        (x, y): (f64, f64),
        side: usize,
    ) -> Result<Vec<P>, FileError> {
        self.reader()?
            .read_square(first_pixel(x, side), first_pixel(y, side), side)
    }
}

// CCDs of a mosaic camera, and the chips of HST, are images of one file: another one has other galaxies, and the mask of another one
// fits as well. Returns a note if the first of several is taken.
fn check_one(files: &Files<'_>) -> Result<Option<String>, FileError> {
    let (path, selection) = files.selected(&files.paths[0])?;
    let all = image_heads(&path)?;
    let is_candidate =
        |head: &&ImageHead| selection.names_images() || !files.content.is_not(&head.name);
    let meant: Vec<&ImageHead> = all
        .iter()
        .filter(|head| selection.has(head))
        .filter(is_candidate)
        .collect();
    let [first, _, ..] = meant[..] else {
        return Ok(None);
    };
    let (count, option) = (meant.len(), files.content.option());
    let names: Vec<String> = meant.iter().map(|head| head.shown(&all)).collect();
    if selection.names_images() || files.content != Content::Sky {
        let message = format!(
            "{count} images may be the {} (found {}; expected one)",
            files.content.noun(),
            names_of(&names)
        );
        return Err(FileError::new(&path, message).hint(format!("{option} {}", names[0])));
    }
    let called = match first.name.as_str() {
        "" => String::new(),
        name => format!(" called {name}"),
    };
    Ok(Some(format!(
        "note: {}: stamps are cut out of image 1 of {count}{called}. {option} {} chooses the next one",
        path.display(),
        names[1]
    )))
}
