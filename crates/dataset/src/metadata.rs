//! The metadata of catalogues: what they were measured with and from.

use std::fmt;
use std::path::{Path, PathBuf};

use shearq_files::FileError;
use shearq_files::frames::Metadata;
use shearq_files::table::{self, FileFormat};
use shearq_measure::PixelFrame;
use shearq_quantities::Frame;

/// Two numbers from 0 to `most`, as the metadata `key` of a catalogue state them with a blank between.
pub fn number_pair(path: &Path, key: &str, text: &str, most: f64) -> Result<[f64; 2], FileError> {
    let numbers: Option<Vec<f64>> = text.split(' ').map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[first, second])
            if [first, second]
                .iter()
                .all(|value| (0.0..=most).contains(value)) =>
        {
            Ok([first, second])
        }
        _ => {
            let message = format!(
                "the metadata `{key}` are {text:?} (expected two numbers from 0 to {most} such as 2.3e-2 1.2e-2)"
            );
            Err(FileError::new(path, message))
        }
    }
}

pub const WARNINGS: &str = "warnings";
/// Key of the effect of the noise of an image's star on its mean shear: the standard deviations of m and c.
// Keys have at most eight characters, the limit of FITS.
pub const PSF_NOISE: &str = "psfnoise";
/// Key of the measurement noise of e1 and e2 of a galaxy, of galaxies in pairs that are rotated by 90°: their mean shear has no
/// shape noise.
pub const E_NOISE: &str = "enoise";
/// Key of the frame of ellipticities: `sky`, or pixel axes that are not the sky's: position angle of +y in degrees, parity (−1
/// for mirrored), and both components of the shear.
pub const CATALOGUE_FRAME: &str = "frame";
/// Key of the coordinate of the centre of the first pixel in x and y, of stamps of an exposure.
pub const CATALOGUE_FIRST_PIXEL: &str = "xyfirst";
/// Key of the mean response: [`NOT_APPLIED`] if e1 and e2 are still to be divided by it, else the responses that g1 and g2
/// were divided by. Ellipticities without a response, and catalogues of earlier versions, do not have it.
pub const RESPONSE: &str = "response";
/// Value of [`RESPONSE`] of measured catalogues.
pub const NOT_APPLIED: &str = "not applied";
/// All keys except fingerprints.
pub const KEYS: [&str; 12] = [
    "creator",
    "submiss",
    "elltype",
    "set",
    "image",
    "settings",
    PSF_NOISE,
    E_NOISE,
    WARNINGS,
    CATALOGUE_FRAME,
    CATALOGUE_FIRST_PIXEL,
    RESPONSE,
];

/// Key and value that state the pixel axes.
pub fn frame_entry(frame: &PixelFrame) -> (String, String) {
    let parity = if frame.mirrored { -1 } else { 1 };
    let [g1, g2] = frame.shear;
    let text = format!("{:.2} {parity} {g1:.4} {g2:.4}", frame.angle);
    (CATALOGUE_FRAME.into(), text)
}

/// The axes of the ellipticities of a catalogue.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Axes {
    Sky,
    /// Pixel axes of an orientation that no WCS states.
    #[default]
    Pixel,
    /// Pixel axes of a known orientation on the sky; by default they are the sky's.
    Oriented(PixelFrame),
}

impl Axes {
    pub fn frame(self) -> Frame {
        match self {
            Axes::Sky => Frame::Sky,
            Axes::Pixel | Axes::Oriented(_) => Frame::Pixel,
        }
    }

    /// Whether ellipticities along these and along `other` axes have a mean, to twice the rotation and ten times the shear
    /// below which pixel axes count as the sky's.
    pub fn agree(self, other: Axes) -> bool {
        let [a, b] = match (self, other) {
            (Axes::Sky, Axes::Pixel) | (Axes::Pixel, Axes::Sky) => return false,
            axes => [axes.0, axes.1].map(|own| match own {
                Axes::Oriented(frame) => frame,
                // Pixels without a WCS belong to one detector, and are as likely the sky's as others.
                Axes::Sky | Axes::Pixel => PixelFrame::default(),
            }),
        };
        // Ellipticities do not change by half a turn.
        let turned = (a.angle - b.angle + 90.0).rem_euclid(180.0) - 90.0;
        let [g1, g2] = [0, 1].map(|k| a.shear[k] - b.shear[k]);
        // A rotation by 2 degrees mixes 7 % of e1 into e2 (sin 2·2°).
        a.mirrored == b.mirrored && turned.abs() < 2.0 && g1.hypot(g2) < 0.01
    }
}

impl fmt::Display for Axes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Axes::Sky => f.write_str("the axes of the sky"),
            Axes::Pixel => f.write_str("pixel axes without a WCS"),
            Axes::Oriented(frame) => write!(f, "pixel axes {frame}"),
        }
    }
}

/// The axes of catalogues that are averaged.
#[derive(Debug, Default)]
pub struct CommonAxes {
    first: Option<(PathBuf, Axes)>,
    on_sky: bool,
}

impl CommonAxes {
    /// Adds a catalogue. True shears along the pixel axes of each image can be compared with catalogues of `any_pixels`; a
    /// mean requires one orientation.
    ///
    /// # Errors
    /// If its axes differ from the others'.
    pub fn add(&mut self, path: &Path, axes: Axes, any_pixels: bool) -> Result<(), FileError> {
        let (first, expected) = self.first.get_or_insert_with(|| (path.to_owned(), axes));
        let both_pixels = (axes.frame(), expected.frame()) == (Frame::Pixel, Frame::Pixel);
        if axes.agree(*expected) || any_pixels && both_pixels {
            self.on_sky |= axes == Axes::Sky;
            return Ok(());
        }
        // Without a WCS there is no frame of the sky.
        let has_wcs = axes != Axes::Pixel && *expected != Axes::Pixel;
        let remedy = match (both_pixels, has_wcs) {
            (true, true) => {
                "images of one orientation per set (gather --set), or gather --frame sky"
            }
            (true, false) => "images of one orientation per set (gather --set)",
            (false, true) => "gather all with --frame sky, or all with --frame pixel",
            (false, false) => "gather all with --frame pixel",
        };
        let message = format!(
            "the ellipticities have other axes than those of {} and no common mean with them (found {axes}; expected {expected})",
            first.display()
        );
        Err(FileError::new(path, message).hint(remedy))
    }

    /// The axes of all; `None` without a catalogue.
    pub fn common(&self) -> Option<Axes> {
        // Pixel axes that are the sky's agree with axes of the sky.
        let first = self.first.as_ref().map(|(_, axes)| *axes);
        first.map(|axes| if self.on_sky { Axes::Sky } else { axes })
    }
}

/// The axes that a catalogue states.
pub fn stated_axes(path: &Path, format: FileFormat) -> Result<Axes, FileError> {
    axes_of(
        path,
        &table::read_metadata(path, format, [CATALOGUE_FRAME])?,
    )
}

/// The axes that the metadata of the catalogue `path` state by [`CATALOGUE_FRAME`].
pub fn axes_of(path: &Path, metadata: &Metadata) -> Result<Axes, FileError> {
    let Some(text) = metadata.get(CATALOGUE_FRAME) else {
        return Ok(Axes::Pixel);
    };
    // Catalogues written by Python state `pixel`, too, which has no angle.
    if let Ok(frame) = text.parse::<Frame>() {
        return Ok(match frame {
            Frame::Sky => Axes::Sky,
            Frame::Pixel => Axes::Pixel,
        });
    }
    let numbers: Option<Vec<f64>> = text.split(' ').map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[angle, parity, g1, g2]) if numbers.iter().flatten().all(|n| n.is_finite()) => {
            Ok(Axes::Oriented(PixelFrame {
                angle,
                mirrored: parity < 0.0,
                shear: [g1, g2],
            }))
        }
        _ => {
            let message = format!(
                "the metadata `{CATALOGUE_FRAME}` are {text:?} (expected four numbers such as 90.00 -1 0.0100 0.0000)"
            );
            Err(FileError::new(path, message))
        }
    }
}
