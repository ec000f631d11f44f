//! What is wrong with data that can be measured all the same.

use std::fmt;

use shearq_submissions::Configuration;

use crate::flag::Flag;
use crate::measurement::Measurement;

/// Something in the data of an image that biases shears, or is likely a mistake.
///
/// The text of [`Display`](fmt::Display) is one line without the name of the image.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Warning {
    /// The corners of the stamps are brighter or darker than zero.
    Sky {
        /// Mean level in image units.
        level: f64,
        /// Its standard error.
        error: f64,
        /// Noise of a pixel in image units.
        noise: f64,
        /// Light of this sky within 8 px of a galaxy, in units of the galaxy's.
        share: f64,
        /// Whether it was subtracted from the stamps before they were measured.
        subtracted: bool,
    },
    /// The level of the stamps' corners changes along x or y.
    Gradient {
        /// Change per pixel along x and y, in image units.
        slope: [f64; 2],
        /// Standard error of either.
        error: f64,
        /// Noise of a pixel in image units.
        noise: f64,
        /// Whether it was subtracted from the stamps before they were measured.
        subtracted: bool,
    },
    /// The galaxies are not in the middle of their stamps.
    OffCentre {
        /// Median of their centroids from the middle, along x and y in pixels.
        offset: [f64; 2],
        /// Standard error of either.
        error: f64,
    },
    /// The galaxies are at different places of their stamps.
    Wandering {
        /// Scatter of their centroids along x and y in pixels.
        scatter: [f64; 2],
    },
    /// Most galaxies are darker than their surroundings.
    Negative {
        /// Stamps with a negative flux.
        count: usize,
        /// Stamps examined.
        of: usize,
    },
    /// The noise differs from stamp to stamp.
    Depths {
        /// Scatter of the stamps' noise, in units of their median.
        scatter: f64,
    },
    /// Noise is correlated over more pixels than can be measured.
    LongCorrelation {
        /// Mean correlation of pixels four and five apart along an axis.
        correlation: f64,
    },
    /// The network stopped before its first iteration on most galaxies.
    Idle {
        /// Number of these galaxies.
        count: usize,
        /// Number of galaxies that the network ran on.
        of: usize,
    },
    /// Stamps are copies of other stamps.
    Copies {
        /// Stamps that are copies.
        count: usize,
        /// Stamps examined.
        of: usize,
    },
    /// All pixels of a stamp are equal, on every stamp examined.
    Blank {
        /// Stamps examined.
        of: usize,
    },
    /// Pixel values are too small or large for single precision.
    Brightness {
        /// Median of the stamps' brightest pixels.
        peak: f64,
    },
    /// The noise of the stamps disagrees with the one that was given.
    NoiseLevel {
        /// The header key NOISESIG.
        given: f64,
        /// The noise measured on the stamps.
        measured: f64,
        /// Whether the measured noise is used.
        used: bool,
    },
    /// The noise of the stamps disagrees with the one in the call.
    GivenNoise {
        /// The noise in the call.
        given: f64,
        /// The noise measured in the corners of the stamps.
        measured: f64,
    },
    /// Noise is correlated, and the configuration treats it as white.
    CorrelatedNoise {
        /// Correlation of neighbours along x and y.
        correlation: [f64; 2],
    },
    /// No stamp is good enough to measure the noise on.
    NoNoise,
    /// The star was not in the middle of its stamp, and was cut around itself.
    PsfOffCentre {
        /// Offset along x and y in pixels.
        offset: [f64; 2],
        /// PSFs.
        of: Of,
    },
    /// The PSF image contains a background.
    PsfBackground {
        /// Level in units of the peak.
        level: f64,
        /// Its light in units of the star's.
        share: f64,
        /// PSFs.
        of: Of,
    },
    /// The background of the PSF image changes along x or y.
    PsfGradient {
        /// Change per pixel along x and y in units of the peak.
        slope: [f64; 2],
        /// PSFs.
        of: Of,
    },
    /// The noise of the star biases shears.
    PsfNoise {
        /// √(Σ p²)/σ.
        snr: f64,
        /// The same that is enough.
        enough: f64,
        /// Standard deviations of m and c by the noise of one star for all galaxies.
        effect: Option<[f64; 2]>,
        /// PSFs.
        of: Of,
    },
    /// The PSF is narrower than pixels can show.
    PsfNarrow {
        /// Noise-equivalent area in px².
        area: f64,
        /// PSFs.
        of: Of,
    },
    /// The PSF is broader than the galaxies that were blurred by it.
    PsfBroad {
        /// FWHM of its core in pixels.
        psf: f64,
        /// FWHM of the core of the galaxies in pixels.
        galaxies: f64,
        /// Whether the difference is too large for stars that are measured as galaxies.
        fatal: bool,
    },
    /// The headers of the PSF image and of the galaxy image state different pixel scales.
    PixelScale {
        /// Arcseconds per pixel of the PSF image.
        psf: f64,
        /// Arcseconds per pixel of the galaxy image.
        galaxies: f64,
    },
    /// The header of a file states the set and image of another file.
    OtherImage {
        /// What the file is of: galaxies, or the PSF.
        of: &'static str,
        /// SET and IMAGE of the header.
        stated: [u32; 2],
        /// Set and image of the path.
        expected: [u32; 2],
    },
    /// Ellipticities are along pixel axes that the header rotates, mirrors or shears against the sky's.
    PixelFrame(PixelFrame),
    /// The headers of the PSF image and of the galaxy image state pixel axes of different orientation or shear.
    PsfFrame {
        /// The pixel axes of the PSF image.
        psf: PixelFrame,
        /// The pixel axes of the galaxy image.
        galaxies: PixelFrame,
    },
    /// The configuration uses so little of the PSF that its wings are missing.
    PsfSize {
        /// Pixels a side that are used.
        size: usize,
    },
    /// Most galaxies could not be measured.
    Flagged {
        /// The most frequent reason.
        flag: Flag,
        /// Galaxies that are flagged.
        count: usize,
        /// All galaxies.
        of: usize,
    },
}

/// The pixel axes of an image against the sky's: +x to the west, +y to the north.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PixelFrame {
    /// Position angle of +y in degrees, from north through east, without the shear.
    pub angle: f64,
    /// Whether +x is to the east where +y is to the north.
    pub mirrored: bool,
    /// Reduced shear that an object that is round on the sky has along the pixel axes.
    pub shear: [f64; 2],
}

impl fmt::Display for PixelFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let PixelFrame {
            angle,
            mirrored,
            shear,
        } = self;
        let parity = if *mirrored {
            "mirrored"
        } else {
            "not mirrored"
        };
        // Without the sign of a zero.
        let [g1, g2] = shear.map(|g| (g * 1e4).round() / 1e4 + 0.0);
        write!(
            f,
            "+y at position angle {angle:.1}°, {parity}, sheared by ({g1:+.4}, {g2:+.4})"
        )
    }
}

/// How many of the PSFs examined a warning is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Of {
    /// Their number.
    pub count: usize,
    /// PSFs examined.
    pub of: usize,
}

impl fmt::Display for Of {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Of { of: 1, .. } => Ok(()),
            Of { count, of } => write!(f, " on {count} of {of} PSFs examined"),
        }
    }
}

/// Side of a PSF stamp below which a linear configuration loses too much of the wings. See
/// docs/constants.md.
const LEAST_PSF_SIZE: usize = 32;
impl Warning {
    /// A warning if the configuration uses too little of the PSF.
    pub fn of_settings(configuration: &Configuration) -> Option<Warning> {
        let size = configuration.psf.size;
        let cut = configuration.linear().is_some() && size < LEAST_PSF_SIZE;
        cut.then_some(Warning::PsfSize { size })
    }

    /// A warning about the star for all galaxies, which was `moved` by so many pixels to be in the middle.
    pub fn of_moved(moved: [f64; 2]) -> Warning {
        Warning::PsfOffCentre {
            offset: moved,
            of: Of { count: 1, of: 1 },
        }
    }

    /// A warning about a level that the data state, which is used.
    pub(crate) fn of_stated(warning: Warning) -> Warning {
        match warning {
            Warning::GivenNoise { given, measured } => Warning::NoiseLevel {
                given,
                measured,
                used: false,
            },
            other => other,
        }
    }

    /// Warnings about what was found on the galaxies of an image.
    pub(crate) fn of_galaxies(galaxies: &[Measurement]) -> impl Iterator<Item = Warning> {
        let flagged = galaxies.iter().filter(|g| !g.flags.is_empty()).count();
        let with = |flag: Flag| galaxies.iter().filter(|g| g.flags.contains(flag)).count();
        let flags = Warning::of_counts(with, flagged, galaxies.len());
        flags.into_iter().chain(Warning::of_idle(galaxies))
    }

    /// A warning if the network made no iteration on more than half of the galaxies that it ran on.
    fn of_idle(galaxies: &[Measurement]) -> Option<Warning> {
        let (mut count, mut of) = (0, 0);
        for descent in galaxies.iter().filter_map(|galaxy| galaxy.descent.as_ref()) {
            count += usize::from(descent.iterations == 0);
            of += 1;
        }
        (2 * count > of).then_some(Warning::Idle { count, of })
    }

    /// A warning if more than half of the galaxies are flagged: `count` of so many, each number of them `with` a flag.
    pub fn of_counts(with: impl Fn(Flag) -> usize, count: usize, of: usize) -> Option<Warning> {
        // Galaxies without a usable mean response have this flag together with the one that explains it.
        let explains = |flag: &Flag| *flag != Flag::NoResponse && 2 * with(*flag) > of;
        let flag = Flag::ALL.into_iter().find(explains);
        // Of equal numbers the first reason.
        let most = || Flag::ALL.into_iter().rev().max_by_key(|flag| with(*flag));
        let flag = flag.or_else(most)?;
        (2 * count > of).then_some(Warning::Flagged { flag, count, of })
    }

    /// A name for each kind of warning, for counting.
    pub fn kind(&self) -> &'static str {
        match self {
            Warning::Sky { .. } => "sky",
            Warning::Gradient { .. } => "gradient",
            Warning::OffCentre { .. } => "off-centre",
            Warning::Wandering { .. } => "wandering",
            Warning::Negative { .. } => "negative",
            Warning::Depths { .. } => "depths",
            Warning::LongCorrelation { .. } => "long-correlation",
            Warning::Idle { .. } => "idle",
            Warning::Copies { .. } => "copies",
            Warning::Blank { .. } => "blank",
            Warning::Brightness { .. } => "brightness",
            Warning::NoiseLevel { .. } => "noise-level",
            Warning::GivenNoise { .. } => "given-noise",
            Warning::CorrelatedNoise { .. } => "correlated-noise",
            Warning::NoNoise => "no-noise",
            Warning::PsfOffCentre { .. } => "psf-off-centre",
            Warning::PsfBackground { .. } => "psf-background",
            Warning::PsfGradient { .. } => "psf-gradient",
            Warning::PsfNoise { .. } => "psf-noise",
            Warning::PsfNarrow { .. } => "psf-narrow",
            Warning::PsfBroad { .. } => "psf-broad",
            Warning::PixelScale { .. } => "pixel-scale",
            Warning::OtherImage { .. } => "other-image",
            Warning::PixelFrame(_) => "pixel-frame",
            Warning::PsfFrame { .. } => "psf-frame",
            Warning::PsfSize { .. } => "psf-size",
            Warning::Flagged { .. } => "flagged",
        }
    }

    /// Whether no result should be made from such data.
    pub fn is_fatal(&self) -> bool {
        matches!(self, Warning::PsfBroad { fatal: true, .. })
    }
}

/// A value with the digits that its error allows, in any unit.
struct Shown(f64);

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Shown(value) = *self;
        if value != 0.0 && !(1e-3..1e5).contains(&value.abs()) {
            return write!(f, "{value:.2e}");
        }
        let decimals = if value == 0.0 {
            0.0
        } else {
            2.0 - value.abs().log10().floor()
        };
        write!(f, "{value:.*}", decimals.max(0.0) as usize)
    }
}

/// A pixel scale to six digits, without trailing zeros.
struct Scale(f64);

impl fmt::Display for Scale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Scale(scale) = *self;
        if !(scale.is_finite() && scale > 0.0) {
            return write!(f, "{scale}");
        }
        let unit = 10f64.powf(5.0 - scale.log10().floor());
        write!(f, "{}", (scale * unit).round() / unit)
    }
}

/// A level in units of the noise, where there is noise and it is known.
fn share_of_noise(level: f64, noise: f64, decimals: usize) -> String {
    if noise > 0.0 {
        format!(", or {:.decimals$} of the noise", level / noise)
    } else {
        String::new()
    }
}

/// A level of noise to five digits, in whatever unit pixels have.
fn level(sigma: f64) -> String {
    if sigma == 0.0 {
        return "0".into();
    }
    if !(1e-3..1e5).contains(&sigma) {
        return format!("{sigma:.4e}");
    }
    let decimals = 4.0 - sigma.log10().floor();
    format!("{sigma:.*}", decimals.max(0.0) as usize)
}

impl fmt::Display for Warning {
    #[allow(clippy::too_many_lines, reason = "one arm per warning")]
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Warning::Sky {
                level,
                error,
                noise,
                subtracted: true,
                ..
            } => write!(
                f,
                "the stamps contain sky (found {} ± {}{}; expected 0). It was subtracted from all stamps",
                Shown(*level),
                Shown(*error),
                share_of_noise(*level, *noise, 3)
            ),
            Warning::Sky {
                level,
                error,
                noise,
                share,
                subtracted: false,
            } => write!(
                f,
                "the stamps contain sky (found {} ± {} in their corners{}; expected 0). Its light within 8 px of a galaxy is {:.0} % of the galaxy's, which biases shears. Try: subtract the sky",
                Shown(*level),
                Shown(*error),
                share_of_noise(*level, *noise, 2),
                100.0 * share
            ),
            Warning::Gradient {
                slope,
                error,
                noise,
                subtracted,
            } => {
                let (unit, name) = if *noise > 0.0 {
                    (*noise, "the noise")
                } else {
                    (1.0, "the image")
                };
                write!(
                    f,
                    "the sky has a gradient (found {:+.4} along x and {:+.4} along y, ± {:.4}, in units of {name} per pixel; expected 0){}",
                    slope[0] / unit,
                    slope[1] / unit,
                    error / unit,
                    if *subtracted {
                        ". It was subtracted from all stamps"
                    } else {
                        ", which biases shears. Try: subtract the sky"
                    }
                )
            }
            Warning::OffCentre { offset, error } => write!(
                f,
                "the galaxies are off the centre of their stamps (found a median of {:+.2} px along x and {:+.2} px along y, ± {error:.2}; expected the middle). Try: cut the stamps around the galaxies",
                offset[0], offset[1]
            ),
            Warning::Wandering { scatter } => write!(
                f,
                "the galaxies are scattered over their stamps (found {:.1} px along x and {:.1} px along y; expected less than 2 px). Try: cut the stamps around the galaxies",
                scatter[0], scatter[1]
            ),
            Warning::Negative { count, of } => write!(
                f,
                "galaxies are darker than their surroundings (found negative flux on {count} of {of} stamps; expected positive flux). Try: check the sign of the image"
            ),
            Warning::Depths { scatter } => write!(
                f,
                "the noise differs between stamps (found a scatter of {:.0} %; expected one level). Try: put stamps of one depth into an image",
                100.0 * scatter
            ),
            Warning::LongCorrelation { correlation } => write!(
                f,
                "the noise is correlated over more than 3 px (found {correlation:.2} for pixels 4 and 5 px apart; expected 0). The response is corrected for shorter correlations only. Try: use images before resampling or smoothing"
            ),
            Warning::Idle { count, of } => write!(
                f,
                "the network makes no iteration (found {count} of {of} galaxies). Their images are not deconvolved. Try: other values of deconvolution.step and deconvolution.lambda"
            ),
            Warning::Copies { count, of } => write!(
                f,
                "stamps are copies of each other (found {count} of {of}; expected none). Copies make errors too small. Try: remove repeated galaxies"
            ),
            Warning::Blank { of } => write!(
                f,
                "the stamps are blank (found equal pixels on each of {of} stamps; expected a galaxy and noise). Try: check the file and its extension"
            ),
            Warning::Brightness { peak } => write!(
                f,
                "pixel values are out of range (found brightest pixels of about {peak:.1e}; expected 1e-18 to 1e17). Try: divide the image and its noise by a constant"
            ),
            Warning::NoiseLevel {
                given,
                measured,
                used,
            } => write!(
                f,
                "NOISESIG disagrees with the measured noise (found {}, expected {}): {}",
                level(*given),
                level(*measured),
                if *used {
                    "the measured noise is used"
                } else {
                    "NOISESIG is used"
                }
            ),
            Warning::GivenNoise { given, measured } => write!(
                f,
                "the given noise disagrees with the noise of the stamps (found {}, expected {}), which biases shears. Try: leave out the noise, so that it is measured",
                level(*given),
                level(*measured)
            ),
            Warning::CorrelatedNoise { correlation } => write!(
                f,
                "the noise of neighbouring pixels is correlated, but is treated as white (found {:.2} along x and {:.2} along y, expected 0). Try: set noise.source to \"image\" and noise.correlation above 0",
                correlation[0], correlation[1]
            ),
            Warning::NoNoise => f.write_str(
                "cannot measure the noise: no stamp has enough pixels that differ. All galaxies are flagged. Try: set noise.source to \"header\" to use NOISESIG",
            ),
            Warning::PsfOffCentre { offset, of } => write!(
                f,
                "the star is off the centre of its stamp (found ({:+.1}, {:+.1}) px{of}; expected at most 1 px). It was moved to the centre by whole pixels",
                offset[0], offset[1]
            ),
            Warning::PsfBackground { level, share, of } => write!(
                f,
                "the PSF contains a background (found {} % of its peak{of}; expected 0). It changes the star's light by {:+.0} % and biases shears. Try: subtract the background, or use a larger PSF stamp if the PSF fills it",
                Shown(100.0 * level),
                100.0 * share
            ),
            Warning::PsfGradient { slope, of } => write!(
                f,
                "the background of the PSF has a gradient (found {:.3} % of the peak per pixel along x and {:.3} % along y{of}; expected 0). It biases shears. Try: subtract the background",
                100.0 * slope[0],
                100.0 * slope[1]
            ),
            Warning::PsfNoise {
                snr,
                enough,
                effect,
                of,
            } => {
                write!(
                    f,
                    "the PSF is noisy (found S/N {snr:.0}{of}; expected more than {enough:.0}). "
                )?;
                match effect {
                    Some([m, c]) => write!(
                        f,
                        "The noise of one star changes m by about {m:.3} and c by about {c:.3}. Try: average several stars, or fit a model"
                    ),
                    None => f.write_str(
                        "With a star of S/N 50 for each galaxy, m is right to 0.003 behind Moffat and Kolmogorov PSFs, and to 0.01 behind others. Try: a model of the PSF, fitted to all stars"
                    ),
                }
            }
            Warning::PsfNarrow { area, of } => write!(
                f,
                "the PSF is narrower than the pixels can show (found light on {area:.1} px{of}; expected 6 px or more, a FWHM of about 1 px). Try: check that the file is a PSF with the pixel scale of the galaxies"
            ),
            Warning::PsfBroad {
                psf,
                galaxies,
                fatal,
            } => {
                let (relation, expected) = if *fatal {
                    ("broader than", "less than")
                } else {
                    ("nearly as broad as", "clearly less than")
                };
                write!(
                    f,
                    "the PSF is {relation} the galaxies (found a FWHM of {psf:.2} px in the core, expected {expected} the {galaxies:.2} px of the galaxies). A PSF sampled with another pixel scale biases m by up to 10. Try: check the sampling of the PSF, and that the objects are not stars"
                )
            }
            Warning::PixelScale { psf, galaxies } => write!(
                f,
                "the PSF image and the galaxy image have different pixel scales (found {}, expected {} arcsec per pixel). This can bias m by 0.1 or more. Try: resample the PSF to the pixels of the galaxies, or correct its header",
                Scale(*psf),
                Scale(*galaxies)
            ),
            Warning::OtherImage {
                of,
                stated: [set, image],
                expected,
            } => write!(
                f,
                "the header of the {of} states another image (found SET = {set} and IMAGE = {image}, expected {} and {}). With galaxies or a PSF of another image shears are wrong. Try: put the files back, or correct the header",
                expected[0], expected[1]
            ),
            Warning::PixelFrame(frame) => write!(
                f,
                "e1 and e2 are along the pixel axes, which are not the sky's (found {frame}; expected 0°, not mirrored, no shear). Try: transform e1 and e2 with the WCS, or compare them with shears along the pixel axes"
            ),
            Warning::PsfFrame { psf, galaxies } => write!(
                f,
                "the PSF image and the galaxy image have pixel axes of different orientation or shear (found {psf}; expected {galaxies}). The PSF is deconvolved in the wrong orientation. Try: draw the PSF with the WCS of the galaxies, or correct its header"
            ),
            Warning::PsfSize { size } => write!(
                f,
                "psf.size is {size} (expected {LEAST_PSF_SIZE} or more). The wings of the PSF that are cut off bias m, by about 0.002 at 20 px and 0.01 at 16 px for a FWHM of 3.4 px. Try: psf.size = {LEAST_PSF_SIZE}"
            ),
            Warning::Flagged { flag, count, of } => write!(
                f,
                "{count} of {of} galaxies are flagged (most frequent reason: {flag}). Try: {}",
                advice(*flag)
            ),
        }
    }
}

/// What to look at if most galaxies have this flag.
pub(crate) fn advice(flag: Flag) -> &'static str {
    match flag {
        Flag::NotFinite => "check masks, and positions outside the image (are they degrees?)",
        Flag::BadPsf => "check the PSF stamps: sum, centre and finite pixels",
        Flag::NoScale => "check that the stamps are not blank and that the noise is known",
        Flag::NoLight | Flag::NoExtent => "check the sky, the sign of the image and its units",
        Flag::NoShear => "check that there is a galaxy on the stamps",
        Flag::NoResponse => {
            "check that the PSF has the pixel scale of the galaxies, and that there are galaxies"
        }
        Flag::Neighbour => {
            "check sky gradients and that the stamps are centred on the galaxies. If each stamp has one galaxy, set shape.neighbours = \"keep\""
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixel_scales_are_shown_with_the_digits_that_differ() {
        let message = |psf: f64, galaxies: f64| Warning::PixelScale { psf, galaxies }.to_string();
        let found = message(0.2, 0.263);
        assert!(
            found.contains("different pixel scales (found 0.2, expected 0.263 arcsec per pixel)"),
            "{found}"
        );
        let found = message(0.200_000_000_1 * 1.001, 0.199_999_999_9);
        assert!(found.contains("found 0.2002, expected 0.2 "), "{found}");
    }
}
