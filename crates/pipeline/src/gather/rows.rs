//! Mosaics of stamps on their way to a file.

use std::path::{Path, PathBuf};

use shearq_files::FileError;
use shearq_files::atomic;
use shearq_files::fits::{ImageWriter, Value};

use shearq_dataset::mosaic::Mosaic;

/// A mosaic that is written a row of stamps at a time.
pub(super) struct Rows {
    path: PathBuf,
    writer: ImageWriter,
    pub(super) mosaic: Mosaic,
    /// Number of stamps that are written.
    pub(super) next: usize,
    /// The row that is being filled.
    pixels: Vec<f32>,
}

impl Rows {
    pub(super) fn create(
        path: &Path,
        mosaic: Mosaic,
        more: &[(&str, Value)],
    ) -> Result<Self, FileError> {
        let Mosaic {
            columns,
            galaxies,
            stamp,
        } = mosaic;
        let mut keys = vec![
            ("STAMP", Value::Int(stamp as i64)),
            ("NSTAMPS", Value::Int(galaxies as i64)),
        ];
        keys.extend_from_slice(more);
        atomic::sweep_beside(path);
        Ok(Rows {
            path: path.to_owned(),
            writer: ImageWriter::create(path, columns * stamp, mosaic.rows() * stamp, &keys)?,
            pixels: vec![0.0; columns * stamp * stamp],
            mosaic,
            next: 0,
        })
    }

    pub(super) fn add(&mut self, stamp: &[f32]) -> Result<(), FileError> {
        let Mosaic {
            columns,
            stamp: side,
            galaxies,
        } = self.mosaic;
        let start = self.next % columns * side;
        let lines = self.pixels.chunks_exact_mut(columns * side);
        for (line, from) in lines.zip(stamp.chunks_exact(side)) {
            line[start..start + side].copy_from_slice(from);
        }
        self.next += 1;
        if self.next.is_multiple_of(columns) || self.next == galaxies {
            self.writer.write_rows(&self.pixels)?;
            self.pixels.fill(0.0);
        }
        Ok(())
    }

    pub(super) fn finish(self) -> Result<(), FileError> {
        first(self.writer.finish_if_absent()?, self.path)
    }
}

/// The error for a file that is there already.
pub(super) fn already(path: PathBuf) -> FileError {
    let message = "the file is there already. Try: another number with --set and --image";
    FileError::new(path, message)
}

/// An error if the file was not `named`, because there is one at `path`.
pub(super) fn first(named: bool, path: PathBuf) -> Result<(), FileError> {
    match named {
        true => Ok(()),
        false => Err(already(path)),
    }
}
