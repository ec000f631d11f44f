//! The metadata of catalogues: what they were measured with and from.

use std::path::Path;

use shearq_files::FileError;
use shearq_files::table::{self, FileFormat};
use shearq_measure::PixelFrame;
use shearq_quantities::Frame;

pub const WARNINGS: &str = "warnings";
/// Key of the effect of the noise of an image's star on its mean shear: the standard deviations of m and c.
// A FITS key has eight characters.
pub const PSF_NOISE: &str = "psfnoise";
/// Key of the frame of ellipticities: `sky`, or pixel axes that are not the sky's: position angle of +y in degrees, parity (−1
/// for mirrored), and both components of the shear.
pub const FRAME: &str = "frame";
/// Key of the coordinate of the centre of the first pixel in x and y, of stamps of an exposure.
pub const FIRST_PIXEL: &str = "xyfirst";
/// All keys beside fingerprints.
pub const KEYS: [&str; 10] = [
    "creator",
    "submiss",
    "elltype",
    "set",
    "image",
    "settings",
    PSF_NOISE,
    WARNINGS,
    FRAME,
    FIRST_PIXEL,
];

/// Key and value that state the pixel axes.
pub fn frame_entry(frame: &PixelFrame) -> (String, String) {
    let PixelFrame {
        angle,
        mirrored,
        shear: [g1, g2],
    } = frame;
    let parity = if *mirrored { -1 } else { 1 };
    let text = format!("{angle:.2} {parity} {g1:.4} {g2:.4}");
    (FRAME.into(), text)
}

/// The pixel axes of a catalogue's image; `None` if they are the sky's, or unknown.
pub fn stated_frame(path: &Path, format: FileFormat) -> Result<Option<PixelFrame>, FileError> {
    let keys = [FRAME.to_owned()];
    let metadata = table::read_metadata(path, format, keys.iter())?;
    let Some(text) = metadata.get(FRAME) else {
        return Ok(None);
    };
    // Python states the frame of the pixels, too.
    if text.parse::<Frame>().is_ok() {
        return Ok(None);
    }
    let numbers: Option<Vec<f64>> = text.split(' ').map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[angle, parity, g1, g2]) if numbers.iter().flatten().all(|n| n.is_finite()) => {
            Ok(Some(PixelFrame {
                angle,
                mirrored: parity < 0.0,
                shear: [g1, g2],
            }))
        }
        _ => {
            let message = format!(
                "the metadata `{FRAME}` are {text:?} (expected four numbers such as 90.00 -1 0.0100 0.0000)"
            );
            Err(FileError::new(path, message))
        }
    }
}
