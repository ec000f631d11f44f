//! Colours: the palette of series and the maps of values.

use plotters::style::RGBColor;

/// Values that are missing: a warm beige, which none of the maps contains.
pub(super) const MISSING: RGBColor = RGBColor(214, 196, 168);
/// Ranges of values and lines of reference.
pub(super) const GREY: RGBColor = RGBColor(110, 110, 110);

// The Okabe–Ito palette, told apart by colour-blind readers, with the strong colours first, and grey instead of its
// yellow, which is hardly visible on white.
const PALETTE: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(230, 159, 0),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
    GREY,
];

/// The palette's colour number `index`; it starts anew after eight.
pub(super) fn series_colour(index: usize) -> RGBColor {
    PALETTE[index % PALETTE.len()]
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ColourMap {
    /// From dark violet over green to yellow, with even steps of lightness.
    #[default]
    Viridis,
    /// From blue over white, at zero, to red.
    Diverging,
}

const VIRIDIS: [[f64; 3]; 11] = [
    [68.0, 1.0, 84.0],
    [72.0, 36.0, 117.0],
    [65.0, 68.0, 135.0],
    [53.0, 95.0, 141.0],
    [42.0, 120.0, 142.0],
    [33.0, 145.0, 140.0],
    [34.0, 168.0, 132.0],
    [68.0, 191.0, 112.0],
    [122.0, 209.0, 81.0],
    [189.0, 223.0, 38.0],
    [253.0, 231.0, 37.0],
];
const DIVERGING: [[f64; 3]; 9] = [
    [5.0, 48.0, 97.0],
    [33.0, 102.0, 172.0],
    [67.0, 147.0, 195.0],
    [146.0, 197.0, 222.0],
    [247.0, 247.0, 247.0],
    [244.0, 165.0, 130.0],
    [214.0, 96.0, 77.0],
    [178.0, 24.0, 43.0],
    [103.0, 0.0, 31.0],
];

impl ColourMap {
    /// The colour at `position` from 0 to 1; positions beyond are cut, NaN is [`MISSING`].
    pub(super) fn colour(self, position: f64) -> RGBColor {
        if position.is_nan() {
            return MISSING;
        }
        let stops: &[[f64; 3]] = match self {
            Self::Viridis => &VIRIDIS,
            Self::Diverging => &DIVERGING,
        };
        let last = stops.len() - 1;
        let along = position.clamp(0.0, 1.0) * last as f64;
        let below = (along as usize).min(last - 1);
        let part = along - below as f64;
        let [r, g, b] = [0, 1, 2].map(|channel| {
            let (from, to) = (stops[below][channel], stops[below + 1][channel]);
            (from + part * (to - from)).round() as u8
        });
        RGBColor(r, g, b)
    }

    /// The ends of the scale of `values`, around zero for a diverging map; NaN without values.
    pub(super) fn limits<'a>(self, values: impl Iterator<Item = &'a f64>) -> (f64, f64) {
        let finite = values.filter(|value| super::axis::shown(**value, false));
        let (low, high) = finite.fold((f64::NAN, f64::NAN), |(low, high), value| {
            (value.min(low), value.max(high))
        });
        let reach = high.max(-low);
        match self {
            Self::Viridis => (low, high),
            Self::Diverging => (-reach, reach),
        }
    }
}

/// Where a value is between two limits, NaN if it is not finite.
pub(super) fn position(value: f64, (low, high): (f64, f64)) -> f64 {
    match value.is_finite() {
        true if high > low => (value - low) / (high - low),
        // All values are equal: the middle of the map.
        true if high == low => 0.5,
        _ => f64::NAN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_end_at_their_ends_and_mark_missing_values() {
        for map in [ColourMap::Viridis, ColourMap::Diverging] {
            assert_eq!(map.colour(-3.0), map.colour(0.0));
            assert_eq!(map.colour(f64::INFINITY), map.colour(1.0));
            assert_eq!(map.colour(f64::NAN), MISSING);
        }
        assert_eq!(ColourMap::Diverging.colour(0.5), RGBColor(247, 247, 247));
        assert_eq!(ColourMap::Viridis.colour(1.0), RGBColor(253, 231, 37));
    }

    #[test]
    fn limits_leave_out_what_is_not_finite() {
        let values = [f64::NAN, 2.0, f64::INFINITY, -1.0];
        assert_eq!(ColourMap::Viridis.limits(values.iter()), (-1.0, 2.0));
        assert_eq!(ColourMap::Diverging.limits(values.iter()), (-2.0, 2.0));
        let none = ColourMap::Viridis.limits([].iter());
        assert!(position(1.0, none).is_nan() && position(f64::NAN, (0.0, 1.0)).is_nan());
        assert_eq!(position(2.0, (2.0, 2.0)), 0.5);
    }
}
