//! Axes: the range of the data, where the ticks are and what is written at them. The ticks of `plotters` on logarithmic
//! axes are neither powers nor 2 and 5 times powers of ten, and its labels have no exponents.

use std::ops::{Range, RangeInclusive};

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};

use super::canvas::{TICK_SIZE, text_width};
use crate::escape::line;

/// One axis of a plot, in the values themselves or, if it is logarithmic, their decimal logarithms.
pub(super) struct Axis {
    pub low: f64,
    pub high: f64,
    log: bool,
    pub ticks: Ticks,
    pub minor: Vec<f64>,
}

#[derive(Clone, Copy, PartialEq)]
pub(super) enum Scale<'a> {
    Linear,
    /// Linear, of whole numbers: no tick lies between them.
    Whole,
    Logarithmic,
    /// Downwards, one name at each of 0, 1, …
    Names(&'a [String]),
}

/// Whether a plot can show the number: finite, with room for differences and padding, and above zero on a logarithmic
/// axis.
pub(super) fn shown(value: f64, log: bool) -> bool {
    value.abs() < 1e290 && (!log || value > 1e-290)
}

impl Axis {
    /// An axis of `length` points around the `values` that can be shown, or exactly over `range` if it is given and
    /// makes sense.
    pub fn new(
        values: impl Iterator<Item = f64>,
        range: Option<(f64, f64)>,
        scale: Scale<'_>,
        length: f64,
        upwards: bool,
    ) -> Self {
        if let Scale::Names(names) = scale {
            let ticks = names.iter().enumerate();
            return Axis {
                low: names.len() as f64 - 0.5,
                high: -0.5,
                log: false,
                ticks: ticks.map(|(k, name)| (k as f64, name.clone())).collect(),
                minor: Vec::new(),
            };
        }
        let log = scale == Scale::Logarithmic;
        let mut axis = Axis {
            low: 0.0,
            high: 1.0,
            log,
            ticks: Vec::new(),
            minor: Vec::new(),
        };
        let sensible =
            |&(low, high): &(f64, f64)| shown(low, log) && shown(high, log) && low < high;
        (axis.low, axis.high) = match range.filter(sensible) {
            Some((low, high)) => (axis.at(low), axis.at(high)),
            None => padded(values.filter(|&v| shown(v, log)).map(|v| axis.at(v)), log),
        };
        let span = axis.high - axis.low;
        let fits = |ticks: &[Tick]| {
            let room = |text: &str| match upwards {
                true => 1.6 * TICK_SIZE,
                false => text_width(text, TICK_SIZE) + 0.9 * TICK_SIZE,
            };
            ticks.windows(2).all(|pair| {
                let apart = (pair[1].0 - pair[0].0) / span * length;
                apart >= 0.5 * (room(&pair[0].1) + room(&pair[1].1))
            })
        };
        (axis.ticks, axis.minor) = match log {
            true => log_ticks(axis.low, axis.high, &fits),
            false => {
                let least = if scale == Scale::Whole { 1.0 } else { 0.0 };
                (linear_ticks(axis.low, axis.high, least, &fits), Vec::new())
            }
        };
        axis
    }

    /// Where `value` is on the axis.
    pub fn at(&self, value: f64) -> f64 {
        match self.log {
            true => value.max(1e-290).log10(),
            false => value,
        }
    }

    /// Whether `at` is between the ends, but for rounding.
    pub fn contains(&self, at: f64) -> bool {
        let part = (at - self.low) / (self.high - self.low);
        (-1e-6..=1.0 + 1e-6).contains(&part)
    }

    /// Where `value` is, or the nearer end if it is beyond.
    pub fn clamped(&self, value: f64) -> f64 {
        let (low, high) = (self.low.min(self.high), self.low.max(self.high));
        self.at(value).clamp(low, high)
    }
}

impl Ranged for &Axis {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, at: &f64, (from, to): (i32, i32)) -> i32 {
        let part = (at - self.low) / (self.high - self.low);
        from + (part * f64::from(to - from)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        match hint.weight().allow_light_points() {
            true => Vec::new(),
            false => self.ticks.iter().map(|tick| tick.0).collect(),
        }
    }

    fn range(&self) -> Range<f64> {
        self.low..self.high
    }
}

impl ValueFormatter<f64> for &Axis {
    fn format_ext(&self, at: &f64) -> String {
        let tick = self.ticks.iter().find(|tick| tick.0 == *at);
        tick.map_or_else(String::new, |tick| line(&tick.1))
    }
}

fn padded(places: impl Iterator<Item = f64>, log: bool) -> (f64, f64) {
    let (low, high) = places.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), at| {
        (low.min(at), high.max(at))
    });
    if low > high {
        return if log { (-1.0, 1.0) } else { (0.0, 1.0) };
    }
    // A spread within rounding counts as none.
    let constant = high - low <= 1e-9 * low.abs().max(high.abs());
    let space = match constant {
        true if log => 0.3,
        true if low == 0.0 => 1.0,
        true => 0.1 * low.abs(),
        false => 0.05 * (high - low),
    };
    (low - space, high + space)
}

type Tick = (f64, String);
type Ticks = Vec<Tick>;

// Round ticks: the largest number up to nine that fits, at distances of at least `least`.
fn linear_ticks(low: f64, high: f64, least: f64, fits: &dyn Fn(&[Tick]) -> bool) -> Ticks {
    let exponent = low.abs().max(high.abs()).log10().floor() as i32;
    // Up to 99999 and down to two zeros after the point, numbers read well without an exponent.
    let exponent = if (-3..5).contains(&exponent) {
        0
    } else {
        exponent
    };
    let ticks = (1..=8).rev().map(|wanted| {
        let step = round_step((high - low) / f64::from(wanted)).max(least);
        let decimals = (f64::from(exponent) - (step * 1.0001).log10().floor()).max(0.0) as usize;
        // A tick at the very end must not be lost to rounding.
        let first = (low / step - 1e-6).ceil();
        let count = ((high / step + 1e-6).floor() - first).clamp(-1.0, 1000.0) as i64;
        let values = (0..=count).map(|number| (first + number as f64) * step);
        let label = |value: f64| match plain(value / 10_f64.powi(exponent), decimals) {
            number if exponent == 0 => number,
            _ if value.abs() < 0.5 * step => "0".into(),
            number => format!("{number}×{}", power_of_ten(exponent)),
        };
        values.map(|value| (value, label(value))).collect::<Ticks>()
    });
    ticks
        .into_iter()
        .find(|ticks| fits(ticks))
        .unwrap_or_default()
}

// The smallest of 1, 2, 5 × 10ⁿ that is not below `step`.
fn round_step(step: f64) -> f64 {
    let decade = 10_f64.powf(step.log10().floor());
    let within = [1.0, 2.0, 5.0].into_iter();
    let mut large_enough = within.filter(|factor| factor * decade >= step * 0.9999);
    large_enough.next().unwrap_or(10.0) * decade
}

// Ticks of 1, 2, 5 × 10ⁿ from 10^`low` to 10^`high`, fewer where they do not fit, with the other multiples as minor
// ticks. Where no two of them fit, the ticks of a linear axis.
fn log_ticks(low: f64, high: f64, fits: &dyn Fn(&[Tick]) -> bool) -> (Ticks, Vec<f64>) {
    let decades = low.floor() as i32..=high.ceil() as i32;
    let places = |factors: RangeInclusive<i32>, stride: i32| {
        let decades = decades
            .clone()
            .filter(move |decade| decade.rem_euclid(stride) == 0);
        let all = decades.flat_map(move |n| factors.clone().map(move |factor| (factor, n)));
        let at = |(factor, n)| (f64::from(factor).log10() + f64::from(n), factor, n);
        all.map(at)
            .filter(move |(at, ..)| (low - 1e-9..=high + 1e-9).contains(at))
    };
    // Numbers of few digits are written out, on all ticks or on none.
    let written_out = low >= -2.3 && high <= 4.3;
    let label = |factor: i32, n: i32| match (written_out, factor) {
        (true, _) => plain(f64::from(factor) * 10_f64.powi(n), (-n).max(0) as usize),
        (false, 1) => power_of_ten(n),
        (false, _) => format!("{factor}×{}", power_of_ten(n)),
    };
    let chosen = |factors: &[i32], stride| {
        let ticks: Ticks = places(1..=9, stride)
            .filter(|(_, factor, _)| factors.contains(factor))
            .map(|(at, factor, n)| (at, label(factor, n)))
            .collect();
        (ticks.len() > 1 && fits(&ticks)).then_some(ticks)
    };
    // Where whole decades abound, the numbers between them only add clutter.
    let between = (high - low < 2.5).then_some([&[1, 2, 5][..], &[1, 5][..]]);
    let mut ticks = between
        .into_iter()
        .flatten()
        .filter_map(|factors| chosen(factors, 1));
    let ticks = ticks.next().or_else(|| {
        let mut strides = [1, 2, 3, 5, 10, 50].into_iter();
        strides.find_map(|stride| chosen(&[1], stride))
    });
    let Some(ticks) = ticks else {
        let linear = |ticks: &[Tick]| {
            fits(
                &ticks
                    .iter()
                    .map(|(v, text)| (v.log10(), text.clone()))
                    .collect::<Ticks>(),
            )
        };
        let ticks = linear_ticks(10_f64.powf(low), 10_f64.powf(high), 0.0, &linear);
        return (
            ticks
                .into_iter()
                .map(|(v, text)| (v.log10(), text))
                .collect(),
            Vec::new(),
        );
    };
    // Minor ticks between decades that are far apart would merge into a line.
    let factors = if high - low < 6.0 { 1..=9 } else { 1..=1 };
    let stride = if high - low < 30.0 { 1 } else { 50 };
    (ticks, places(factors, stride).map(|(at, ..)| at).collect())
}

/// The number with that many decimals, with a proper minus and no minus zero.
pub(super) fn plain(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.contains(|sign: char| sign.is_ascii_digit() && sign != '0') {
        true => text.replace('-', "−"),
        false => text.trim_start_matches('-').into(),
    }
}

/// The number with about three digits: "0.012", "−1.5×10⁻⁶".
pub(super) fn short(value: f64) -> String {
    // Rounded first, so that 999.9 is treated as 1000.
    let rounded = format!("{value:.2e}");
    let parts = rounded.split_once('e');
    let Some((mantissa, Ok(exponent))) = parts.map(|(m, e)| (m, e.parse::<i32>())) else {
        return plain(value, 0);
    };
    let trim = |text: String| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    };
    if value == 0.0 || (-3..4).contains(&exponent) {
        return trim(plain(value, (2 - exponent).max(0) as usize));
    }
    let mantissa = trim(mantissa.replace('-', "−"));
    format!("{mantissa}×{}", power_of_ten(exponent))
}

fn power_of_ten(exponent: i32) -> String {
    let raised = exponent
        .to_string()
        .chars()
        .map(|sign| match sign {
            '-' => '⁻',
            digit => {
                ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'][digit as usize - '0' as usize]
            }
        })
        .collect::<String>();
    format!("10{raised}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis) -> Vec<&str> {
        axis.ticks.iter().map(|(_, label)| label.as_str()).collect()
    }

    fn axis(values: &[f64], range: Option<(f64, f64)>, scale: Scale<'_>) -> Axis {
        Axis::new(values.iter().copied(), range, scale, 400.0, true)
    }

    #[test]
    fn whole_numbers_have_no_ticks_between_them() {
        let whole = |low: f64, high: f64| axis(&[], Some((low, high)), Scale::Whole);
        assert_eq!(labels(&whole(1.8, 2.2)), ["2"]);
        assert_eq!(labels(&whole(0.9, 4.1)), ["1", "2", "3", "4"]);
        assert_eq!(labels(&whole(0.0, 24.0)), ["0", "5", "10", "15", "20"]);
    }

    #[test]
    fn linear_ticks_are_round_numbers() {
        let linear = |low: f64, high: f64| axis(&[], Some((low, high)), Scale::Linear);
        assert_eq!(
            labels(&linear(0.0, 1.0)),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
        );
        assert_eq!(
            labels(&linear(-2e-4, 1e-4)),
            [
                "−2.0×10⁻⁴",
                "−1.5×10⁻⁴",
                "−1.0×10⁻⁴",
                "−0.5×10⁻⁴",
                "0",
                "0.5×10⁻⁴",
                "1.0×10⁻⁴"
            ]
        );
    }

    #[test]
    fn logarithmic_ticks_are_powers_or_one_two_five() {
        let log = |low: f64, high: f64| axis(&[], Some((low, high)), Scale::Logarithmic);
        assert_eq!(labels(&log(1e-6, 1e-3)), ["10⁻⁶", "10⁻⁵", "10⁻⁴", "10⁻³"]);
        assert_eq!(labels(&log(10.0, 100.0)), ["10", "20", "50", "100"]);
        assert_eq!(labels(&log(1e-5, 3e-5)), ["10⁻⁵", "2×10⁻⁵"]);
        // Too narrow for two such ticks: as on a linear axis.
        assert!(log(1.1, 1.4).ticks.len() > 2);
    }

    #[test]
    fn any_data_give_an_axis_of_finite_extent() {
        let cases: [&[f64]; 8] = [
            &[],
            &[0.0],
            &[-3.0, -3.0],
            &[1.0, 1.0 + f64::EPSILON],
            &[f64::NAN, f64::INFINITY, -1.0],
            &[f64::MAX, f64::MIN],
            &[1e-299, 1e299],
            &[-1e299, 1e299],
        ];
        for values in cases {
            for scale in [Scale::Linear, Scale::Logarithmic] {
                for range in [
                    None,
                    Some((1.0, 1.0)),
                    Some((f64::NAN, 2.0)),
                    Some((-1.0, 3.0)),
                ] {
                    let axis = axis(values, range, scale);
                    assert!(axis.low < axis.high && (axis.high - axis.low).is_finite());
                    assert!(axis.ticks.len() <= 12, "{values:?} {:?}", axis.ticks.len());
                    assert!(axis.ticks.iter().all(|(at, _)| axis.contains(*at)));
                }
            }
        }
    }

    #[test]
    fn short_numbers_have_three_digits_at_most() {
        let cases = [
            (0.0, "0"),
            (1234.0, "1234"),
            (999.96, "1000"),
            (-0.01234, "−0.0123"),
            (1.5e-6, "1.5×10⁻⁶"),
            (-2e7, "−2×10⁷"),
            (100.0, "100"),
        ];
        for (value, text) in cases {
            assert_eq!(short(value), text);
        }
    }
}
