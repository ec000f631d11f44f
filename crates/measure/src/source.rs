//! Sources of the stamps and PSFs of an image: files, simulations and arrays.

use std::borrow::Cow;
use std::fmt;
use std::ops::{Deref, Range};
use std::sync::{Arc, LazyLock};

use ndarray::{ArrayView3, Axis, Ix3, Slice};
use shearq_quantities::{Jacobian, columns_of};

use crate::error::{MeasureError, length};
use crate::measurer::Measurer;
use crate::psf::{Psfs, Star};
use crate::stamp::{Pixel, Pixels};
use crate::warning::Warning;

/// The noise of an image before it is measured, as far as it is known.
#[derive(Debug, Clone, Default)]
pub enum KnownNoise<'n> {
    /// Unknown.
    #[default]
    Unknown,
    /// A level that the data state. A configuration that measures the noise on the stamps reports a difference.
    Stated(f64),
    /// The level of white noise that the caller gives, which replaces the measurement on the stamps.
    Given(f64),
    /// The same, one level per stamp.
    GivenEach(Cow<'n, [f64]>),
    /// Levels that the data state, one per stamp. Sky, galaxies and the correlation of the noise are measured on the stamps.
    StatedEach(Cow<'n, [f64]>),
}

impl KnownNoise<'_> {
    pub(crate) fn levels(&self) -> Option<&[f64]> {
        match self {
            KnownNoise::GivenEach(levels) | KnownNoise::StatedEach(levels) => Some(levels),
            KnownNoise::Unknown | KnownNoise::Stated(_) | KnownNoise::Given(_) => None,
        }
    }
}

/// The stamps of an image in rows. The last row may be shorter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StampRows {
    /// Stamps of a full row, 1 or more.
    pub columns: usize,
    /// All stamps.
    pub count: usize,
}

impl StampRows {
    /// Number of rows.
    #[expect(clippy::len_without_is_empty, reason = "an image has rows")]
    pub fn len(&self) -> usize {
        self.count.div_ceil(self.columns)
    }

    /// Which stamps are in a row.
    pub fn stamps(&self, row: usize) -> Range<usize> {
        row * self.columns..((row + 1) * self.columns).min(self.count)
    }
}

/// Stamps and PSFs of an image: files, arrays, a simulation.
///
/// One thread reads, so a source may own a file that threads cannot share. Rows are read in ascending order and, for
/// surveys, some of them before that.
pub trait StampSource<'a> {
    /// Why a row cannot be read or measured.
    type Error: From<MeasureError> + Send;

    /// The rows of the image.
    fn rows(&self) -> StampRows;

    /// Warnings about the image from other sources than its pixels, such as headers.
    fn warnings(&self) -> Vec<Warning> {
        Vec::new()
    }

    /// Reads the stamps of a row, one along the first axis per galaxy.
    ///
    /// # Errors
    /// If they cannot be read.
    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'a>, Self::Error>;

    /// Reads the PSFs of a row: one PSF for all galaxies, or one per galaxy.
    ///
    /// # Errors
    /// If they cannot be read.
    fn psfs(&mut self, row: usize) -> Result<Lazy<'a, Psfs<'a>>, Self::Error>;

    /// The Jacobians of a row's stamps, one per galaxy, with which shapes are measured in the frame of the sky; `None`
    /// if they are measured in the frame of the pixels. It is the same for all rows of an image. PSFs are on the pixels of
    /// their stamps.
    ///
    /// # Errors
    /// If they cannot be determined.
    fn jacobians(&mut self, _row: usize) -> Result<Option<Vec<Jacobian>>, Self::Error> {
        Ok(None)
    }

    /// Offsets (x, y) of a row's galaxies from the centres of their stamps in pixels, which several epochs of a galaxy need; zero if
    /// `None`. A single stamp has its galaxy where it is found.
    ///
    /// # Errors
    /// If they cannot be read.
    fn offsets(&mut self, _row: usize) -> Result<Option<Vec<[f64; 2]>>, Self::Error> {
        Ok(None)
    }

    /// Electrons per unit of the stamps. With them, the Poisson noise of the galaxies is part of their noise; without, the
    /// noise is that of the sky. Networks ignore it.
    fn gain(&self) -> Option<f64> {
        None
    }

    /// Whether the pixels have the unit of flux of other epochs, so that a ratio other than 1 is a mistake.
    fn has_common_flux(&self) -> bool {
        true
    }
}

/// A value that is made by the first thread that needs it: threads share the drawing of simulated galaxies, although one
/// thread reads the rows. Clones share the value.
#[derive(Debug, Clone)]
pub struct Lazy<'a, T>(Arc<LazyLock<T, Box<dyn FnOnce() -> T + Send + 'a>>>);

/// The stamps of a row.
pub type LazyStamps<'a> = Lazy<'a, Pixels<'a, Ix3>>;

impl<'a, T> Lazy<'a, T> {
    /// A value that will be made.
    pub fn new(make: impl FnOnce() -> T + Send + 'a) -> Self {
        Lazy(Arc::new(LazyLock::new(Box::new(make))))
    }
}

impl<'a, T: Send + 'a> From<T> for Lazy<'a, T> {
    fn from(value: T) -> Self {
        Lazy::new(move || value)
    }
}

impl<T> Deref for Lazy<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

/// Threads of the caller. This crate starts none.
pub trait Threads {
    /// Number of threads, 1 or more.
    fn count(&self) -> usize;

    /// Maps values, in order, in any thread.
    fn map<T: Send, R: Send>(&self, of: Vec<T>, map: impl Fn(T) -> R + Sync + Send) -> Vec<R>;
}

/// The calling thread alone.
#[derive(Debug, Clone, Copy, Default)]
pub struct OneThread;

impl Threads for OneThread {
    fn count(&self) -> usize {
        1
    }

    fn map<T: Send, R: Send>(&self, of: Vec<T>, map: impl Fn(T) -> R + Sync + Send) -> Vec<R> {
        of.into_iter().map(map).collect()
    }
}

/// Some of the stamps, or of their PSFs.
type Slices<'a, T, E> = Box<dyn FnMut(Range<usize>) -> Result<T, E> + Send + 'a>;

/// Stamps and PSFs in arrays, in the arrangement nearest to a square: images with equal numbers of stamps have the same rows,
/// so that the same stamps are surveyed and examined.
pub struct ArraySource<'a, E = MeasureError> {
    count: usize,
    stamps: Slices<'a, Pixels<'a, Ix3>, E>,
    psfs: Slices<'a, Psfs<'a>, E>,
    moved: Option<[f64; 2]>,
    /// One for all stamps or one per stamp.
    jacobians: Option<Cow<'a, [Jacobian]>>,
    offsets: Option<Cow<'a, [[f64; 2]]>>,
}

impl<E> fmt::Debug for ArraySource<'_, E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ArraySource")
            .field("count", &self.count)
            .finish_non_exhaustive()
    }
}

impl<'a> ArraySource<'a> {
    /// Of stamps, one along the first axis per galaxy. A star for all galaxies is cut and normalised here.
    ///
    /// # Errors
    /// If there is not one PSF for all or one per galaxy, or the star for all cannot be used.
    pub fn new<T: Pixel>(
        measurer: &Measurer,
        stamps: ArrayView3<'a, T>,
        psfs: &'a Psfs<'_>,
    ) -> Result<Self, MeasureError> {
        let (count, full, _) = stamps.dim();
        let (shared, moved) = match psfs.count() {
            Some(given) if given != count => {
                return Err(MeasureError::Shape {
                    what: "PSFs",
                    found: format!("{given} galaxies"),
                    expected: format!("{count}, one each"),
                });
            }
            None if matches!(psfs, Psfs::Star(_)) => {
                let Star { psf, moved } = psfs.at(0, measurer.configuration().psf_cut(), full)?;
                (Some(psf.into_shared()), moved)
            }
            _ => (None, None),
        };
        let stamps = move |range| {
            let mut some = stamps;
            some.slice_axis_inplace(Axis(0), Slice::from(range));
            Ok(T::pixels(some))
        };
        let psfs = move |range| {
            let shared = shared.clone().map(Psfs::Prepared);
            Ok(shared.unwrap_or_else(|| psfs.slice(range)))
        };
        Ok(ArraySource::from_fn(count, stamps, psfs, moved))
    }
}

impl<'a, E> ArraySource<'a, E> {
    /// A source of `count` stamps that two functions read by range, the pixels and their PSFs. `moved` is the offset in pixels
    /// by which the star for all galaxies was moved to the centre of its stamp.
    pub fn from_fn(
        count: usize,
        stamps: impl FnMut(Range<usize>) -> Result<Pixels<'a, Ix3>, E> + Send + 'a,
        psfs: impl FnMut(Range<usize>) -> Result<Psfs<'a>, E> + Send + 'a,
        moved: Option<[f64; 2]>,
    ) -> Self {
        ArraySource {
            count,
            stamps: Box::new(stamps),
            psfs: Box::new(psfs),
            moved,
            jacobians: None,
            offsets: None,
        }
    }

    /// The same stamps with their galaxies at these offsets (x, y) from their centres in pixels, one per stamp.
    ///
    /// # Errors
    /// If there are another number of them.
    pub fn with_offsets(
        mut self,
        offsets: impl Into<Cow<'a, [[f64; 2]]>>,
    ) -> Result<Self, MeasureError> {
        let offsets = offsets.into();
        length("offsets", offsets.len(), self.count)?;
        self.offsets = Some(offsets);
        Ok(self)
    }

    /// The same stamps in the frame of the sky, with one Jacobian for all or one per stamp.
    ///
    /// # Errors
    /// If there are another number of them.
    pub fn with_jacobians(
        mut self,
        jacobians: impl Into<Cow<'a, [Jacobian]>>,
    ) -> Result<Self, MeasureError> {
        let jacobians = jacobians.into();
        if jacobians.len() != 1 {
            length("Jacobians", jacobians.len(), self.count)?;
        }
        self.jacobians = Some(jacobians);
        Ok(self)
    }
}

impl<'a, E: From<MeasureError> + Send> StampSource<'a> for ArraySource<'a, E> {
    type Error = E;

    fn rows(&self) -> StampRows {
        StampRows {
            columns: columns_of(self.count),
            count: self.count,
        }
    }

    fn warnings(&self) -> Vec<Warning> {
        self.moved.map(Warning::of_moved).into_iter().collect()
    }

    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'a>, E> {
        let range = self.rows().stamps(row);
        Ok((self.stamps)(range)?.into())
    }

    fn psfs(&mut self, row: usize) -> Result<Lazy<'a, Psfs<'a>>, E> {
        let range = self.rows().stamps(row);
        Ok((self.psfs)(range)?.into())
    }

    fn jacobians(&mut self, row: usize) -> Result<Option<Vec<Jacobian>>, E> {
        let range = self.rows().stamps(row);
        Ok(self.jacobians.as_deref().map(|all| match all {
            [one] => vec![*one; range.len()],
            each => each[range].to_vec(),
        }))
    }

    fn offsets(&mut self, row: usize) -> Result<Option<Vec<[f64; 2]>>, E> {
        let range = self.rows().stamps(row);
        Ok(self.offsets.as_deref().map(|each| each[range].to_vec()))
    }
}
