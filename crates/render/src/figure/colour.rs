//! Colours: the palette of series and the maps of images.

/// A colour as red, green and blue.
pub(super) type Rgb = [u8; 3];

pub(super) const BLACK: Rgb = [0, 0, 0];
pub(super) const WHITE: Rgb = [255, 255, 255];
/// Axes and their labels.
pub(super) const INK: Rgb = [38, 38, 38];
pub(super) const GRID: Rgb = [228, 228, 228];
/// Pixels without a value: a warm beige, which none of the maps contains.
pub(super) const MASKED: Rgb = [214, 196, 168];

/// The Okabe–Ito palette, told apart by colour-blind readers, with the strong colours first.
const PALETTE: [Rgb; 8] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [230, 159, 0],
    [204, 121, 167],
    [86, 180, 233],
    [0, 0, 0],
    [240, 228, 66],
];

/// The palette's colour number `index`; it starts anew after eight.
pub(super) fn series_colour(index: usize) -> Rgb {
    PALETTE[index % PALETTE.len()]
}

/// How numbers become colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColourMap {
    /// From dark violet over green to yellow, with even steps of lightness.
    #[default]
    Viridis,
    /// From black to white.
    Grey,
    /// From blue over white, at zero, to red.
    Diverging,
}

const VIRIDIS: [Rgb; 11] = [
    [68, 1, 84],
    [72, 36, 117],
    [65, 68, 135],
    [53, 95, 141],
    [42, 120, 142],
    [33, 145, 140],
    [34, 168, 132],
    [68, 191, 112],
    [122, 209, 81],
    [189, 223, 38],
    [253, 231, 37],
];
const GREY: [Rgb; 2] = [BLACK, WHITE];
const DIVERGING: [Rgb; 9] = [
    [5, 48, 97],
    [33, 102, 172],
    [67, 147, 195],
    [146, 197, 222],
    [247, 247, 247],
    [244, 165, 130],
    [214, 96, 77],
    [178, 24, 43],
    [103, 0, 31],
];

impl ColourMap {
    /// The colour at `position` from 0 to 1; positions beyond are cut, NaN is [`MASKED`].
    pub(super) fn colour(self, position: f64) -> Rgb {
        if position.is_nan() {
            return MASKED;
        }
        let stops: &[Rgb] = match self {
            Self::Viridis => &VIRIDIS,
            Self::Grey => &GREY,
            Self::Diverging => &DIVERGING,
        };
        let last = stops.len() - 1;
        let along = position.clamp(0.0, 1.0) * last as f64;
        let below = (along as usize).min(last - 1);
        let part = along - below as f64;
        std::array::from_fn(|channel| {
            let (from, to) = (
                f64::from(stops[below][channel]),
                f64::from(stops[below + 1][channel]),
            );
            (from + part * (to - from)).round() as u8
        })
    }
}

/// Black or white, whichever reads better on `background`.
pub(super) fn text_on(background: Rgb) -> Rgb {
    let [red, green, blue] = background.map(f64::from);
    let lightness = 0.299 * red + 0.587 * green + 0.114 * blue;
    if lightness > 140.0 { BLACK } else { WHITE }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_end_at_their_ends_and_mark_missing_values() {
        for map in [ColourMap::Viridis, ColourMap::Grey, ColourMap::Diverging] {
            assert_eq!(map.colour(-3.0), map.colour(0.0));
            assert_eq!(map.colour(f64::INFINITY), map.colour(1.0));
            assert_eq!(map.colour(f64::NAN), MASKED);
        }
        assert_eq!(ColourMap::Grey.colour(0.5), [128, 128, 128]);
        assert_eq!(ColourMap::Diverging.colour(0.5), [247, 247, 247]);
        assert_eq!(ColourMap::Viridis.colour(1.0), [253, 231, 37]);
    }
}
