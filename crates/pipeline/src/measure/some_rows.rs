//! Some rows of stamps of an image, before all of them are read.

use std::ops::ControlFlow;

use shearq_files::fits::ImageReader;

use crate::PipelineError;

/// Reads rows of stamps of `side` pixels in order, until `take` wants no more, and goes back to the first row.
///
/// # Errors
/// If a row cannot be read, or as `take`.
pub(super) fn read(
    image: &mut ImageReader,
    side: usize,
    rows: impl IntoIterator<Item = usize>,
    mut take: impl FnMut(usize, Vec<f32>) -> Result<ControlFlow<()>, PipelineError>,
) -> Result<(), PipelineError> {
    let mut next = 0;
    for row in rows {
        image.skip_rows((row - next) * side);
        next = row + 1;
        let pixels = image.read_rows(side)?;
        if take(row, pixels)?.is_break() {
            break;
        }
    }
    image.rewind();
    Ok(())
}
