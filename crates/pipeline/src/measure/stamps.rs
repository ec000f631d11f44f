//! Rows of stamps of an image.

use std::path::Path;

use ndarray::Ix3;
use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_measure::Pixels;

use crate::PipelineError;
use shearq_dataset::mosaic::Mosaic;

/// Most pixels of a row of stamps. Several rows are in memory at a time.
const MAX_STRIP: usize = 1 << 24;

/// Reads a row of stamps of `side` pixels. The last row may be shorter.
pub(super) fn read_row(
    image: &mut ImageReader,
    mosaic: Mosaic,
    side: usize,
    row: usize,
) -> Result<Pixels<'static, Ix3>, PipelineError> {
    image.rewind();
    image.skip_rows(row * side);
    let stamps = Pixels::strip(image.read_rows(side)?, mosaic.columns, side)?;
    Ok(stamps.into_slice(0..mosaic.of_row(row)))
}

/// Checks that a row of `n` stamps of `side` pixels a side fits into memory.
pub(crate) fn check_strip(path: &Path, n: usize, side: usize) -> Result<(), FileError> {
    let pixels = n * side * side;
    if pixels <= MAX_STRIP {
        return Ok(());
    }
    let message = format!(
        "a row of {n} stamps of {side} pixels a side has {pixels} pixels; expected at most {MAX_STRIP}"
    );
    Err(FileError::new(path, message))
}

/// Set and image that the header of a simulated image states. Headers of other programs may have one of these keys with
/// another meaning, so that both must be whole numbers.
pub(super) fn stated_image(image: &ImageReader) -> Option<[u32; 2]> {
    let whole = |key: &str| {
        let value = image.number(key).ok().flatten()?;
        (value.fract() == 0.0 && value >= 1.0).then_some(value as u32)
    };
    Some([whole("SET")?, whole("IMAGE")?])
}
