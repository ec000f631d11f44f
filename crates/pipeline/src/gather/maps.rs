//! Masks and variances of pixels.

use shearq_files::table::Place;
use shearq_files::{FileError, MAX_EXACT_INTEGER};
use shearq_quantities::statistics::upper_median;

use super::files::{Content, Origin};

// Without --mask-extension, the image itself would be read as its mask, and all bright pixels would be missing.
pub(crate) fn another(
    map: &Origin<'_>,
    image: &Origin<'_>,
    content: Content,
) -> Result<(), FileError> {
    let [own, of_image] = [map, image].map(|origin| Place::of(origin.file).path);
    if own == of_image && map.image == image.image {
        let (noun, option) = (content.noun(), content.option());
        let message = format!("the {noun} is the image itself; expected another ({option})");
        return Err(map.fault(&message));
    }
    Ok(())
}

// Variance in units of the median of a stamp from which it marks a bad pixel: surveys write 10⁶ or SExtractor's 10³⁰ in place of
// infinity. A star of 65,000 electrons in a sky of one has 6.5·10⁴.
const MIN_BAD_RATIO: f64 = 1e5;

// Maps may have any value where the pixel is missing already. `fault` names the stamp.
pub(super) fn variance(
    pixels: &mut [f32],
    values: &mut [f64],
    content: Content,
    fault: impl Fn(&str) -> FileError,
) -> Result<(), FileError> {
    let inverse = |stated: f64| match content {
        Content::Weight => 1.0 / stated,
        _ => stated,
    };
    let known = values.iter().map(|stated| inverse(*stated));
    let mut known: Vec<f64> = known
        .filter(|value| value.is_finite() && *value > 0.0)
        .collect();
    let most = MIN_BAD_RATIO * upper_median(&mut known).unwrap_or(f64::INFINITY);
    for (pixel, value) in pixels.iter_mut().zip(values) {
        let stated = *value;
        *value = inverse(stated);
        // The weight 0, or an infinite variance, marks bad pixels in the maps of most surveys. Reading makes infinity NaN.
        if *value >= most || content != Content::Weight && stated.is_nan() {
            *pixel = f32::NAN;
        }
        if pixel.is_finite() && (value.is_nan() || *value <= 0.0) {
            let shown = match stated.is_nan() {
                true => "NaN or infinite".to_owned(),
                false => stated.to_string(),
            };
            return Err(match content {
                Content::Weight => fault(&format!("the weight is {shown}; expected a positive number, or 0 for a bad pixel")),
                _ => fault(&format!("the variance is {shown}; expected a positive number, or infinity for a bad pixel")).hint("infinity in place of it if such pixels are bad, or --mask with these pixels"),
            });
        }
        if !pixel.is_finite() {
            *value = f64::NAN;
        }
    }
    Ok(())
}

// The median over the pixels outside a circle around the galaxy.
//
// Variance maps of many surveys contain the Poisson noise of the counts themselves. A level from pixels of the galaxy would be
// high where its noise is positive, and the subtracted noise power would correlate with the data. If two depths meet on the
// stamp, the galaxy in the centre lies on the larger part, whose level the median takes; a gradient cancels. The galaxy's own
// Poisson noise is added by `gain`.
pub(super) fn level(variances: &[f64], side: usize) -> f64 {
    let finite = |at: &usize| variances[*at].is_finite();
    let chosen = (0..variances.len())
        .filter(finite)
        .filter(|&at| is_outside(at, side));
    let mut chosen: Vec<f64> = chosen.map(|at| variances[at]).collect();
    if chosen.is_empty() {
        chosen = variances
            .iter()
            .copied()
            .filter(|v| v.is_finite())
            .collect();
    }
    upper_median(&mut chosen).map_or(f64::NAN, f64::sqrt)
}

// Whether a pixel of a stamp is beyond the galaxy.
fn is_outside(at: usize, side: usize) -> bool {
    let middle = (side as f64 - 1.0) / 2.0;
    // Chosen by hand: 12 px of 48, where most galaxies of a stamp of this size have no light.
    let radius = side as f64 / 4.0;
    let [x, y] = [at % side, at / side].map(|k| k as f64 - middle);
    x.hypot(y) > radius
}

// Makes the pixels of a stamp missing whose `mask` is not zero, or has one of these bits. Returns their number.
pub(crate) fn lose(
    pixels: &mut [f32],
    mask: &[f64],
    bits: Option<u64>,
    origin: &Origin<'_>,
) -> Result<usize, FileError> {
    let mut lost = 0;
    for (pixel, mask) in pixels.iter_mut().zip(mask) {
        let bad = match bits {
            Some(bits) if mask.is_finite() => {
                if mask.fract() != 0.0 {
                    return Err(origin.fault(&format!(
                        "the mask has the value {mask}; expected whole numbers, of which --mask-bits takes bits"
                    )));
                }
                // Masks are read in double precision, which has no low bits beside such a one.
                if mask.abs() >= MAX_EXACT_INTEGER {
                    let message = format!(
                        "the mask has the value {mask:e}, but --mask-bits reads bits 0 to 52 only (expected values below 2^53)"
                    );
                    return Err(origin.fault(&message).hint("a mask of 32-bit integers with the bits that are needed, as `mask & 0x7fffffff`"));
                }
                // Negative numbers are in two's complement, as in the file.
                (*mask as i64) as u64 & bits != 0
            }
            _ => *mask != 0.0,
        };
        if bad {
            lost += usize::from(!pixel.is_nan());
            *pixel = f32::NAN;
        }
    }
    Ok(lost)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn masks_whose_low_bits_are_lost_are_refused() {
        let origin = Origin {
            file: Path::new("mask.fits"),
            image: 1,
            plane: 1,
            position: None,
        };
        let of = |mask: i64, bits| {
            let lost = lose(&mut [1.0], &[mask as f64], bits, &origin);
            lost.map_err(|error| error.text())
        };
        for mask in [1 << 53, (1 << 54) + 1, (1 << 60) + 1, i64::MIN + 1] {
            let error = of(mask, Some(1)).unwrap_err();
            assert!(error.contains("expected values below 2^53"), "{error}");
            assert_eq!(of(mask, None), Ok(1), "{mask}");
        }
        assert_eq!(of((1 << 52) + 1, Some(1)), Ok(1));
        assert_eq!(of(-1, Some(1 << 52)), Ok(1));
        assert_eq!(of(1 << 52, Some(1)), Ok(0));
    }

    #[test]
    fn finite_marks_of_bad_pixels_are_missing() {
        for (content, good, bad) in [
            (Content::Variance, 2.0, 1e30),
            (Content::Variance, 2.0, 1e6),
            (Content::Weight, 0.5, 1e-6),
            (Content::Weight, 0.5, 0.0),
        ] {
            let mut pixels = [1.0; 9];
            let mut values = [good; 9];
            values[4] = bad;
            // Of a bright star.
            values[5] = if content == Content::Weight {
                good / 6e4
            } else {
                good * 6e4
            };
            let fault = |what: &str| FileError::new("map.fits", what);
            variance(&mut pixels, &mut values, content, fault).unwrap();
            assert!(pixels[4].is_nan() && values[4].is_nan(), "{bad}");
            let missing = pixels.iter().filter(|pixel| pixel.is_nan()).count();
            assert_eq!((missing, values[0]), (1, 2.0), "{bad}");
        }
    }
}
