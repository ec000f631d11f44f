//! Stamps in memory.

use std::fmt;
use std::ops::Range;

use ndarray::{ArrayView3, Axis, Ix3, Slice};

use super::source::{Lazy, LazyStamps, StampRows, StampSource};
use crate::error::MeasureError;
use crate::galaxy::Measurer;
use crate::pixel::{Pixel, Pixels};
use crate::psf::Star;
use crate::psfs::Psfs;
use crate::warning::Warning;
use shearq_quantities::columns_of;

/// Some of the stamps, or of their PSFs.
type Slices<'a, T, E> = Box<dyn FnMut(Range<usize>) -> Result<T, E> + Send + 'a>;

/// Stamps and PSFs in arrays, in the arrangement nearest to a square: images of as many stamps have the same rows, so
/// that the same stamps are surveyed and examined.
pub struct ArraySource<'a, E = MeasureError> {
    count: usize,
    stamps: Slices<'a, Pixels<'a, Ix3>, E>,
    psfs: Slices<'a, Psfs<'a>, E>,
    moved: Option<[f64; 2]>,
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
        let (psfs, moved) = match psfs.count() {
            Some(given) if given != count => {
                return Err(MeasureError::Shape {
                    what: "PSFs",
                    found: format!("{given} galaxies"),
                    expected: format!("{count}, one each"),
                });
            }
            None if matches!(psfs, Psfs::Star(_)) => {
                let Star { psf, moved } = psfs.at(0, measurer.configuration().psf_cut(), full)?;
                (Psfs::Prepared(psf.into_shared()), moved)
            }
            _ => (psfs.slice(0..count), None),
        };
        let stamps = move |range| {
            let mut some = stamps;
            some.slice_axis_inplace(Axis(0), Slice::from(range));
            Ok(T::pixels(some))
        };
        let psfs = move |range| Ok(psfs.clone().into_slice(range));
        Ok(ArraySource::from_fn(count, stamps, psfs, moved))
    }
}

impl<'a, E> ArraySource<'a, E> {
    /// Of `count` stamps, of which functions give some with their PSFs. The star for all galaxies was `moved` by so many
    /// pixels to be in the middle.
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
        }
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
}
