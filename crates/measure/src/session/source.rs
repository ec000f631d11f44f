//! What a session reads from, and the threads that it may use.

use std::ops::{Deref, Range};
use std::sync::{Arc, LazyLock};

use ndarray::Ix3;

use crate::error::MeasureError;
use crate::pixel::Pixels;
use crate::psfs::Psfs;
use crate::warning::Warning;

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
