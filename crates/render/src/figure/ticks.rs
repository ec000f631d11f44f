//! Axes: the range of the data, where the ticks are and what is written at them.

use super::scene::text_width;

/// A labelled place on an axis.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Tick {
    pub value: f64,
    pub label: String,
}

/// One axis of a plot.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Axis {
    low: f64,
    high: f64,
    log: bool,
    /// Labelled ticks, ascending.
    pub ticks: Vec<Tick>,
    /// Ticks without labels.
    pub minor: Vec<f64>,
    /// A power of ten by which all labels are to be multiplied, such as "×10⁻⁴".
    pub factor: Option<String>,
}

/// How values are laid along an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scale {
    Linear,
    /// Linear, of whole numbers: no tick lies between them.
    Whole,
    Logarithmic,
}

impl Scale {
    /// Logarithmic or not.
    pub(super) fn log(log: bool) -> Self {
        match log {
            true => Scale::Logarithmic,
            false => Scale::Linear,
        }
    }
}

/// How labels follow each other along an axis, which limits how many fit.
#[derive(Debug, Clone, Copy)]
pub(super) enum Direction {
    Across,
    Up,
}

/// Whether a plot can show the number: finite, with room for differences and padding, and above
/// zero on a logarithmic axis.
pub(super) fn shown(value: f64, log: bool) -> bool {
    value.abs() < 1e290 && (!log || value > TINIEST)
}

/// The least number on a logarithmic axis.
pub(super) const TINIEST: f64 = 1e-290;

impl Axis {
    /// An axis of `length` points with labels of `size`, around those of `values` that can be
    /// shown, or exactly over `range` if it is given and makes sense.
    pub(super) fn new(
        values: impl Iterator<Item = f64>,
        range: Option<(f64, f64)>,
        scale: Scale,
        length: f64,
        size: f64,
        direction: Direction,
    ) -> Self {
        let log = scale == Scale::Logarithmic;
        let range = range.filter(|&(low, high)| shown(low, log) && shown(high, log) && low < high);
        let (low, high) = range.unwrap_or_else(|| padded(values, log));
        let mut axis = Self {
            low,
            high,
            log,
            ticks: Vec::new(),
            minor: Vec::new(),
            factor: None,
        };
        let fits = |ticks: &[Tick]| {
            let room = |tick: &Tick| match direction {
                Direction::Across => text_width(&tick.label, size) + 0.9 * size,
                Direction::Up => 1.6 * size,
            };
            ticks.windows(2).all(|pair| {
                let apart = axis.fraction(pair[1].value) - axis.fraction(pair[0].value);
                apart * length >= 0.5 * (room(&pair[0]) + room(&pair[1]))
            })
        };
        let (ticks, minor, factor) = match log.then(|| log_ticks(low, high, &fits)).flatten() {
            Some((ticks, minor)) => (ticks, minor, None),
            None => {
                let least = if scale == Scale::Whole { 1.0 } else { 0.0 };
                let (ticks, factor) = linear_ticks(low, high, least, &fits);
                (ticks, Vec::new(), factor)
            }
        };
        (axis.ticks, axis.minor, axis.factor) = (ticks, minor, factor);
        axis
    }

    /// Where `value` is along the axis: 0 at its low and 1 at its high end, beyond outside.
    pub(super) fn fraction(&self, value: f64) -> f64 {
        if self.log {
            (value.max(TINIEST).log10() - self.low.log10()) / (self.high.log10() - self.low.log10())
        } else {
            (value - self.low) / (self.high - self.low)
        }
    }

    /// The width of the widest label.
    pub(super) fn label_width(&self, size: f64) -> f64 {
        self.ticks
            .iter()
            .map(|tick| text_width(&tick.label, size))
            .fold(0.0, f64::max)
    }
}

/// The range of those of `values` that can be shown, with some space around them.
fn padded(values: impl Iterator<Item = f64>, log: bool) -> (f64, f64) {
    let (low, high) = values
        .filter(|&value| shown(value, log))
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
    if low > high {
        return if log { (0.1, 10.0) } else { (0.0, 1.0) };
    }
    // A spread within rounding counts as none.
    let constant = high - low <= 1e-9 * low.abs().max(high.abs());
    if log {
        let factor = if constant {
            2.0
        } else {
            10_f64.powf((0.05 * (high.log10() - low.log10())).min(5.0))
        };
        (low / factor, high * factor)
    } else {
        let space = match (constant, low == 0.0) {
            (true, true) => 1.0,
            (true, false) => 0.1 * low.abs(),
            (false, _) => 0.05 * (high - low),
        };
        (low - space, high + space)
    }
}

/// Round ticks on a linear axis, as many as fit up to nine and no nearer than `least`, and the factor taken out of the
/// labels.
fn linear_ticks(
    low: f64,
    high: f64,
    least: f64,
    fits: &dyn Fn(&[Tick]) -> bool,
) -> (Vec<Tick>, Option<String>) {
    let largest = low.abs().max(high.abs());
    let exponent = largest.log10().floor() as i32;
    // Up to 9999 and down to two zeros after the point the numbers read well as they are.
    let exponent = if (-2..4).contains(&exponent) {
        0
    } else {
        exponent
    };
    let scale = 10_f64.powi(exponent);
    let mut coarsest = Vec::new();
    for wanted in (1..=8).rev() {
        let step = round_step((high - low) / f64::from(wanted)).max(least);
        let decimals = (exponent as f64 - (step * 1.0001).log10().floor()).max(0.0) as usize;
        let ticks: Vec<Tick> = multiples(step, low, high)
            .map(|value| Tick {
                value,
                label: plain(value / scale, decimals),
            })
            .collect();
        if fits(&ticks) {
            coarsest = ticks;
            break;
        }
    }
    let factor = (exponent != 0).then(|| format!("×{}", power_of_ten(exponent)));
    (coarsest, factor)
}

/// The multiples of `step` from `low` to `high`.
fn multiples(step: f64, low: f64, high: f64) -> impl Iterator<Item = f64> {
    // A tick at the very end must not be lost to rounding.
    let first = (low / step - 1e-6).ceil();
    let count = ((high / step + 1e-6).floor() - first).clamp(-1.0, 1000.0) as i64;
    (0..=count).map(move |number| (first + number as f64) * step)
}

/// The smallest of 1, 2, 5 × 10ⁿ that is not below `step`.
fn round_step(step: f64) -> f64 {
    let decade = 10_f64.powf(step.log10().floor());
    let within = [1.0, 2.0, 5.0]
        .into_iter()
        .find(|factor| factor * decade >= step * 0.9999);
    within.unwrap_or(10.0) * decade
}

/// Ticks of 1, 2, 5 × 10ⁿ on a logarithmic axis, fewer where they do not fit, with the other
/// multiples as minor ticks; `None` if the axis is too short for any two.
fn log_ticks(low: f64, high: f64, fits: &dyn Fn(&[Tick]) -> bool) -> Option<(Vec<Tick>, Vec<f64>)> {
    let decades = (low.log10().floor() as i32)..=(high.log10().ceil() as i32);
    let inside = |value: f64| value >= low * (1.0 - 1e-9) && value <= high * (1.0 + 1e-9);
    let places = |factors: &[i32], stride: i32| -> Vec<(i32, i32)> {
        decades
            .clone()
            .filter(|decade| decade.rem_euclid(stride) == 0)
            .flat_map(|decade| factors.iter().map(move |&factor| (factor, decade)))
            .filter(|&(factor, decade)| inside(f64::from(factor) * 10_f64.powi(decade)))
            .collect()
    };
    // Numbers of few digits are written out, on all ticks or on none.
    let written_out = low >= 0.005 && high <= 20_000.0;
    let label = |factor: i32, decade: i32| match (written_out, factor) {
        (true, _) => plain(
            f64::from(factor) * 10_f64.powi(decade),
            (-decade).max(0) as usize,
        ),
        (false, 1) => power_of_ten(decade),
        (false, _) => format!("{factor}×{}", power_of_ten(decade)),
    };
    let choices: [(&[i32], i32); 8] = [
        (&[1, 2, 5], 1),
        (&[1, 5], 1),
        (&[1], 1),
        (&[1], 2),
        (&[1], 3),
        (&[1], 5),
        (&[1], 10),
        (&[1], 50),
    ];
    let mut ticks = choices.iter().filter_map(|&(factors, stride)| {
        // Where whole decades abound, the numbers between them only add clutter.
        if factors.len() > 1 && high.log10() - low.log10() > 2.5 {
            return None;
        }
        let ticks: Vec<Tick> = places(factors, stride)
            .into_iter()
            .map(|(factor, decade)| Tick {
                value: f64::from(factor) * 10_f64.powi(decade),
                label: label(factor, decade),
            })
            .collect();
        (ticks.len() >= 2 && fits(&ticks)).then_some(ticks)
    });
    let ticks = ticks.next()?;
    // Minor ticks between decades that are far apart would merge into a line.
    let minor = match high.log10() - low.log10() {
        span if span <= 6.0 => places(&[1, 2, 3, 4, 5, 6, 7, 8, 9], 1),
        span if span <= 30.0 => places(&[1], 1),
        _ => Vec::new(),
    };
    let minor = minor
        .into_iter()
        .map(|(factor, decade)| f64::from(factor) * 10_f64.powi(decade));
    Some((ticks, minor.collect()))
}

/// The number with that many decimals, with a proper minus and no minus zero.
pub(super) fn plain(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    let zero = text.chars().all(|sign| matches!(sign, '-' | '0' | '.'));
    if zero {
        text.trim_start_matches('-').into()
    } else {
        text.replace('-', "−")
    }
}

/// The number with about three digits: "0.012", "−1.5×10⁻⁶".
pub(super) fn short(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return plain(value, 0);
    }
    // Rounded first, so that 999.9 is treated as 1000.
    let rounded = format!("{value:.2e}");
    let Some((mantissa, exponent)) = rounded.split_once('e') else {
        return rounded;
    };
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let trim = |text: String| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    };
    if (-3..4).contains(&exponent) {
        return trim(plain(value, (2 - exponent).max(0) as usize));
    }
    format!(
        "{}×{}",
        trim(mantissa.replace('-', "−")),
        power_of_ten(exponent)
    )
}

/// "10⁻⁴".
fn power_of_ten(exponent: i32) -> String {
    let digits = exponent.to_string();
    let raised = digits.chars().map(|sign| match sign {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        '4' => '⁴',
        '5' => '⁵',
        '6' => '⁶',
        '7' => '⁷',
        '8' => '⁸',
        '9' => '⁹',
        _ => '⁰',
    });
    format!("10{}", raised.collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis) -> Vec<&str> {
        axis.ticks.iter().map(|tick| tick.label.as_str()).collect()
    }

    fn axis(values: &[f64], range: Option<(f64, f64)>, log: bool) -> Axis {
        Axis::new(
            values.iter().copied(),
            range,
            Scale::log(log),
            400.0,
            12.0,
            Direction::Up,
        )
    }

    #[test]
    fn whole_numbers_have_no_ticks_between_them() {
        let axis = |low: f64, high: f64| {
            let range = Some((low, high));
            Axis::new(
                std::iter::empty(),
                range,
                Scale::Whole,
                400.0,
                12.0,
                Direction::Up,
            )
        };
        assert_eq!(labels(&axis(1.8, 2.2)), ["2"]);
        assert_eq!(labels(&axis(0.9, 4.1)), ["1", "2", "3", "4"]);
        assert_eq!(labels(&axis(0.0, 24.0)), ["0", "5", "10", "15", "20"]);
    }

    #[test]
    fn linear_ticks_are_round_numbers() {
        assert_eq!(
            labels(&axis(&[], Some((0.0, 1.0)), false)),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
        );
        let small = axis(&[], Some((-2e-4, 1e-4)), false);
        assert_eq!(small.factor.as_deref(), Some("×10⁻⁴"));
        assert_eq!(
            labels(&small),
            ["−2.0", "−1.5", "−1.0", "−0.5", "0.0", "0.5", "1.0"]
        );
    }

    #[test]
    fn logarithmic_ticks_are_powers_or_one_two_five() {
        assert_eq!(
            labels(&axis(&[], Some((1e-6, 1e-3)), true)),
            ["10⁻⁶", "10⁻⁵", "10⁻⁴", "10⁻³"]
        );
        assert_eq!(
            labels(&axis(&[], Some((10.0, 100.0)), true)),
            ["10", "20", "50", "100"]
        );
        assert_eq!(
            labels(&axis(&[], Some((1e-5, 3e-5)), true)),
            ["10⁻⁵", "2×10⁻⁵"]
        );
        // Too narrow for two such ticks: as on a linear axis.
        assert!(axis(&[], Some((1.1, 1.4)), true).ticks.len() > 2);
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
            for log in [false, true] {
                for range in [
                    None,
                    Some((1.0, 1.0)),
                    Some((f64::NAN, 2.0)),
                    Some((-1.0, 3.0)),
                ] {
                    let axis = axis(values, range, log);
                    assert!(axis.low < axis.high && (axis.high - axis.low).is_finite());
                    assert!(axis.ticks.len() <= 12, "{values:?} {:?}", axis.ticks.len());
                    assert!(
                        axis.ticks
                            .iter()
                            .all(|tick| axis.fraction(tick.value).is_finite())
                    );
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
