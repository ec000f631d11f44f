//! Pixels that hold no light: fill values, dead and hot pixels, cosmic rays. They become missing.
//!
//! Four properties of light behind a PSF decide, none of which a shear of the galaxy changes:
//!
//! * **Noise repeats no value.** An area of one value is a fill value, unless it is as dark as the stamp gets (no light at
//!   all, as in counts of photons) or joins its surroundings without a step (noise-free light that ends). How large
//!   an area has to be follows from how often neighbours of the stamp are equal by chance, as integers are.
//! * **Light is not negative**, apart from side lobes of the PSF.
//! * **A pixel is at most R_d times as bright as the mean of the two pixels ±d from it**: positive light f behind a PSF p has the
//!   image Σ f(y) p(x − y), so that R_d is the largest ratio of p(y) to the mean of p(y + d) and p(y − d) at any place y,
//!   pixel phases included.
//! * **Light next to a defect** may be the edge of it, and is tested more strictly.
//!
//! R_d is bounded by the peak of the PSF: exp(|d|² [`RATIO_EXPONENT`] p_max) [`RATIO_MARGIN`]. Noise and light fainter than a share of
//! the stamp's peak are allowed for, so that rings of diffraction and Poisson noise of a bright galaxy do not count. On a stamp
//! of pure noise, no pixel is touched with a probability of 1 − 10⁻¹².

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::statistics::{SCATTER, median};

use crate::measurement::DefectCounts;
use crate::pixels::frame;

// Pixels ±d from a pixel, d = (x, y). Those two pixels away show clusters of hot pixels.
const PAIRS: [(isize, isize); 6] = [(1, 0), (0, 1), (1, 1), (1, -1), (2, 0), (0, 2)];
// Largest −ln R_d/(|d|² p_max) of 22 PSFs (Moffat of FWHM 1 to 5 px, Kolmogorov of e = 0.28, Airy of λ/D 0.8 to 3 px, Euclid VIS and NISP, Roman)
// without the margin. Gaussians have π. Strong coma with a peak of a third of an Airy disc has 22.
const RATIO_EXPONENT: f32 = 12.0;
// Chosen by hand: Poisson noise of cores changes the ratio, and so do errors of the PSF.
const RATIO_MARGIN: f32 = 1.5;
// Of the stamp's brightest pixel. Rings and spikes of diffraction are fainter. Chosen by hand.
const FAINT_SHARE: f32 = 0.1;
// In units of the noise. Gaussian noise exceeds it in one of 10¹⁵ pixels.
const MIN_DEPARTURE: f32 = 8.0;
// The same for pixels next to a defect. Chosen by hand, as in LA Cosmic (van Dokkum 2001, PASP 113, 1420).
const MIN_DEPARTURE_BESIDE: f32 = 4.0;
// Times the depth of the PSF's side lobes. Chosen by hand.
const LOBE_MARGIN: f32 = 1.5;
// Chance of an area of one value per stamp. Chosen by hand.
const MAX_CHANCE: f64 = 1e-6;
// Sides of square areas of one value; a line needs as many pixels. Chosen by hand.
const AREA_SIDES: std::ops::RangeInclusive<usize> = 3..=15;
// Equal neighbours that a square of 3 × 3 pixels in the last rows has at least, and a line of nine in another one.
const MIN_EQUAL_PAIRS: u32 = 6;
// Mean step at the edge of an area, in units of the brightest pixel. Noise of S/N 1000 has 0.006, noise-free wings have less.
const MIN_STEP: f32 = 5e-4;
// Each pass may uncover pixels that were hidden by those beside them: of a square of nine hot pixels first the corners.
const MAX_PASSES: usize = 8;
// Two vectors of AVX-512.
const LANES: usize = 32;
// In pixels, of the border in which noise and level of the stamp are measured. Chosen by hand.
const BORDER: usize = 4;

/// What light behind a PSF can look like.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct LightLimits {
    /// R_d of [`PAIRS`], with its margin.
    ratios: [f32; PAIRS.len()],
    /// Departures from them that noise may cause, in units of its departure for one pixel. The mean of a pair is not taken below
    /// zero and R_d has a margin, so that half of R_d amplifies its noise.
    noise: [f32; PAIRS.len()],
    /// Depth of the side lobes in units of the peak.
    lobe: f32,
}

impl LightLimits {
    /// For a PSF of sum one.
    pub(crate) fn from_psf(psf: ArrayView2<'_, f64>) -> Self {
        let (low, high) = psf.fold((0.0f64, 0.0f64), |(low, high), &value| {
            (low.min(value), high.max(value))
        });
        let ratios = PAIRS.map(|(x, y)| {
            RATIO_MARGIN * (RATIO_EXPONENT * high as f32 * (x * x + y * y) as f32).exp()
        });
        LightLimits {
            ratios,
            noise: ratios.map(|ratio| (1.0 + ratio * ratio / 8.0).sqrt()),
            lobe: LOBE_MARGIN * (-low / high) as f32,
        }
    }
}

/// Finds defects, with buffers for one thread.
#[derive(Debug, Clone, Default)]
pub(crate) struct Defects {
    /// Whether a pixel was found.
    marks: Vec<bool>,
    /// Of each column: side of the square of equal pixels that ends here, in this row and the last, and number of equal pixels up to here.
    squares: [Vec<usize>; 2],
    runs: Vec<usize>,
    places: Vec<usize>,
    values: Vec<f32>,
}

impl Defects {
    /// For stamps of up to `n` pixels a side without allocation.
    pub(crate) fn new(n: usize) -> Self {
        Defects {
            marks: Vec::with_capacity(n * n),
            squares: [Vec::with_capacity(n), Vec::with_capacity(n)],
            runs: Vec::with_capacity(n),
            places: Vec::with_capacity(n * n),
            values: Vec::with_capacity(n * n),
        }
    }

    /// Makes the pixels of a stamp of `n` pixels a side NaN that hold no light, in noise of this level.
    pub(crate) fn remove(
        &mut self,
        stamp: &mut [f32],
        n: usize,
        noise: f32,
        limits: &LightLimits,
    ) -> DefectCounts {
        let mut found = DefectCounts::default();
        let screening = Screening::of(stamp, n);
        let may_repeat = screening.equal >= MIN_EQUAL_PAIRS;
        let mut sky = StampSky::of_noise(noise);
        if !may_repeat && !Threshold::of(screening.extremes(), &sky, limits).is_exceeded() {
            return found;
        }
        for value in stamp.iter_mut().filter(|value| value.is_infinite()) {
            *value = f32::NAN;
        }
        self.marks.clear();
        self.marks.resize(stamp.len(), false);
        let mut is_measured = false;
        for _ in 0..MAX_PASSES {
            let before = found.total();
            if may_repeat {
                found.repeated += self.remove_repeated(stamp, n, &sky);
            }
            let beside = found.total() > 0;
            let mut is_dark = self.find(stamp, n, &sky, limits, beside);
            if !self.places.is_empty() && !is_measured {
                for &at in &self.places {
                    self.marks[at] = true;
                }
                sky = self.measure_sky(stamp, n, noise);
                for &at in &self.places {
                    self.marks[at] = false;
                }
                is_measured = true;
                is_dark = self.find(stamp, n, &sky, limits, beside);
            }
            for &at in &self.places {
                self.marks[at] = true;
                stamp[at] = f32::NAN;
            }
            let count = self.places.len() as u32;
            match is_dark {
                true => found.dark += count,
                false => found.bright += count,
            }
            if found.total() == before {
                break;
            }
        }
        found
    }

    /// Finds pixels that are too dark or, if there are none, too bright, with lower limits `beside` pixels that were found.
    /// Whether they are dark: next to a fill value, means of pairs show no light.
    fn find(
        &mut self,
        stamp: &[f32],
        n: usize,
        sky: &StampSky,
        limits: &LightLimits,
        beside: bool,
    ) -> bool {
        self.places.clear();
        let threshold = Threshold::of(Screening::of(stamp, n).extremes(), sky, limits);
        if !beside && !threshold.is_exceeded() {
            return false;
        }
        let least = if beside {
            MIN_DEPARTURE_BESIDE
        } else {
            MIN_DEPARTURE
        };
        let departure = |at: usize| match beside && around(at, n).any(|at| self.marks[at]) {
            true => MIN_DEPARTURE_BESIDE,
            false => MIN_DEPARTURE,
        };
        let darkest = sky.level - threshold.lobes;
        if threshold.low < darkest - least * sky.noise {
            for (at, &value) in stamp.iter().enumerate() {
                if value < darkest - least * sky.noise
                    && value < darkest - departure(at) * sky.noise
                {
                    self.places.push(at);
                }
            }
        }
        if !self.places.is_empty() {
            return true;
        }
        let floor = sky.level + threshold.faint + least * sky.noise * limits.noise[0];
        for (first, values) in (0..).step_by(LANES).zip(stamp.chunks(LANES)) {
            // Without an early exit, so that several pixels are tested at a time.
            if !values
                .iter()
                .fold(false, |any, value| any | (*value > floor))
            {
                continue;
            }
            for (at, &value) in (first..).zip(values) {
                if value > floor {
                    let noise = departure(at) * sky.noise_at(stamp, n, at);
                    if value - sky.level - threshold.faint
                        > most_light(stamp, n, at, (sky.level, noise), limits)
                    {
                        self.places.push(at);
                    }
                }
            }
        }
        false
    }

    /// The sky and the noise of a stamp beside marked pixels. It may be noisier than its image, with a sky of its own, and counts
    /// of few photons are noisier where there is light.
    fn measure_sky(&mut self, stamp: &[f32], n: usize, noise: f32) -> StampSky {
        let values = &mut self.values;
        let mut median_of = |of: &mut dyn Iterator<Item = f32>| {
            values.clear();
            values.extend(of.filter(|value| value.is_finite()));
            median(values).unwrap_or(0.0)
        };
        let level = median_of(&mut frame(stamp, n, BORDER).flatten().copied()).min(0.0);
        let pairs = frame(stamp, n, BORDER).flat_map(|piece| piece.windows(2));
        let step = median_of(&mut pairs.map(|pair| (pair[1] - pair[0]).abs()));
        let noise = noise.max(SCATTER * step / 2f32.sqrt());
        let marks = &self.marks;
        let lit = || {
            (0..stamp.len())
                .filter(|&at| !marks[at] && !around(at, n).any(|at| marks[at]))
                .map(|at| (stamp[at], mean_around(stamp, n, at) - level))
                .filter(|&(_, light)| light > noise)
        };
        let light = median_of(&mut lit().map(|(_, light)| light));
        let apart = median_of(&mut lit().map(|(value, light)| (value - level - light).abs()));
        // A pixel and the mean of eight around it.
        let variance = (SCATTER * apart).powi(2) / (1.0 + 1.0 / 8.0);
        let per_light = match light > 0.0 {
            true => ((variance - noise * noise) / light).max(0.0),
            false => 0.0,
        };
        StampSky {
            level,
            noise,
            per_light,
        }
    }

    /// Removes areas of one value. Returns the number of pixels.
    fn remove_repeated(&mut self, stamp: &mut [f32], n: usize, sky: &StampSky) -> u32 {
        let Some(side) = area_side(stamp, n) else {
            return 0;
        };
        // The darkest value may recur, as zeros of counts without sky. A pixel far below the sky is not the darkest: one of −99 would
        // make an area of all zeros.
        let dark = match sky.noise > 0.0 {
            true => sky.level - MIN_DEPARTURE * sky.noise,
            false => f32::NEG_INFINITY,
        };
        let bright = stamp.iter().copied().filter(|&value| value >= dark);
        let low = bright.fold(f32::INFINITY, f32::min);
        self.mark_areas(stamp, n, side, low);
        let (mut step, mut pairs, mut high) = (0.0f32, 0u32, 0.0f32);
        for (at, &value) in stamp.iter().enumerate() {
            if !self.marks[at] && value > high {
                high = value;
            }
            for beside in beside(at, n) {
                if self.marks[at] != self.marks[beside] {
                    let apart = (value - stamp[beside]).abs();
                    if apart.is_finite() {
                        step += apart;
                        pairs += 1;
                    }
                }
            }
        }
        let is_light = pairs > 0 && step < MIN_STEP * high * pairs as f32;
        let mut count = 0;
        for (mark, value) in self.marks.iter_mut().zip(stamp) {
            if *mark && !value.is_nan() {
                *mark = !is_light;
                if !is_light {
                    *value = f32::NAN;
                    count += 1;
                }
            }
        }
        count
    }

    /// Marks squares of `side` pixels of one value above `low`, and lines of as many pixels.
    fn mark_areas(&mut self, stamp: &[f32], n: usize, side: usize, low: f32) {
        let length = side * side;
        for buffer in self.squares.iter_mut().chain([&mut self.runs]) {
            buffer.clear();
            buffer.resize(n, 0);
        }
        for y in 0..n {
            let mut run = 0;
            for x in 0..n {
                let at = y * n + x;
                let value = stamp[at];
                let left = x > 0 && stamp[at - 1] == value;
                let above = y > 0 && stamp[at - n] == value;
                run = if left { run + 1 } else { 1 };
                self.runs[x] = if above { self.runs[x] + 1 } else { 1 };
                let [last, this] = &mut self.squares;
                this[x] = match left && above && stamp[at - n - 1] == value {
                    true => 1 + this[x - 1].min(last[x]).min(last[x - 1]),
                    false => 1,
                };
                if value.is_nan() || value <= low {
                    continue;
                }
                if this[x] >= side {
                    for row in y + 1 - side..=y {
                        self.marks[row * n + x + 1 - side..=row * n + x].fill(true);
                    }
                }
                if run >= length {
                    self.marks[at + 1 - length..=at].fill(true);
                }
                if self.runs[x] >= length {
                    (y + 1 - length..=y).for_each(|row| self.marks[row * n + x] = true);
                }
            }
            self.squares.swap(0, 1);
        }
    }
}

/// Sky and noise of a stamp.
#[derive(Debug, Clone, Copy)]
struct StampSky {
    /// At most zero.
    level: f32,
    noise: f32,
    /// Variance per unit of light: Poisson noise, or the structure of the galaxy.
    per_light: f32,
}

impl StampSky {
    fn of_noise(noise: f32) -> Self {
        StampSky {
            level: 0.0,
            noise,
            per_light: 0.0,
        }
    }

    fn noise_at(&self, stamp: &[f32], n: usize, at: usize) -> f32 {
        if self.per_light == 0.0 {
            return self.noise;
        }
        // Not a number is no light.
        let light = (mean_around(stamp, n, at) - self.level).max(0.0);
        (self.noise * self.noise + self.per_light * light).sqrt()
    }
}

/// Beyond which pixels of a stamp are compared with those around them.
#[derive(Debug, Clone, Copy)]
struct Threshold {
    /// Of the stamp.
    low: f32,
    high: f32,
    dark: f32,
    bright: f32,
    /// Side lobes of the brightest pixel, and light that is too faint to be tested.
    lobes: f32,
    faint: f32,
}

impl Threshold {
    fn of([low, high]: [f32; 2], sky: &StampSky, limits: &LightLimits) -> Self {
        let peak = (high - sky.level).max(0.0);
        let (lobes, faint) = (limits.lobe * peak, FAINT_SHARE * peak);
        Threshold {
            low,
            high,
            dark: sky.level - lobes - MIN_DEPARTURE * sky.noise,
            bright: sky.level + faint + MIN_DEPARTURE * sky.noise * limits.noise[0],
            lobes,
            faint,
        }
    }

    fn is_exceeded(&self) -> bool {
        self.low < self.dark || self.high > self.bright
    }
}

/// The most light above `level` that a pixel can have, given those around it and a departure by noise.
fn most_light(
    stamp: &[f32],
    n: usize,
    at: usize,
    (level, noise): (f32, f32),
    limits: &LightLimits,
) -> f32 {
    let (x, y) = ((at % n) as isize, (at / n) as isize);
    let value = |x: isize, y: isize| {
        // Negative places are large.
        match (x as usize) < n && (y as usize) < n {
            true => stamp[y as usize * n + x as usize],
            false => f32::NAN,
        }
    };
    let mut most = f32::INFINITY;
    for (k, (dx, dy)) in PAIRS.into_iter().enumerate() {
        let mean = 0.5 * value(x + dx, y + dy) + 0.5 * value(x - dx, y - dy) - level;
        let bound = limits.ratios[k] * mean.max(0.0) + noise * limits.noise[k];
        // A pair with a missing pixel bounds nothing.
        most = if !mean.is_nan() && bound < most {
            bound
        } else {
            most
        };
    }
    if most == f32::INFINITY {
        // A corner, or between missing pixels. A diagonal pair is as far as any of the pixels around.
        let mean = (mean_around(stamp, n, at) - level).max(0.0);
        return limits.ratios[2] * mean + noise * limits.noise[2];
    }
    most
}

/// The mean of the finite pixels around a pixel; NaN without any.
fn mean_around(stamp: &[f32], n: usize, at: usize) -> f32 {
    let finite = around(at, n)
        .map(|at| stamp[at])
        .filter(|value| value.is_finite());
    let (sum, count) = finite.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

/// The side of squares of one value that are no chance.
fn area_side(stamp: &[f32], n: usize) -> Option<usize> {
    // Of pairs and of three neighbours: those that are not all equal, and all.
    let (mut two, mut three) = ([0.0; 2], [0.0; 2]);
    let mut add = |a: f32, b: f32, c: Option<f32>| {
        if a.is_finite() && b.is_finite() {
            two[0] += f64::from(a != b);
            two[1] += 1.0;
            if let Some(c) = c.filter(|c| c.is_finite()) {
                three[0] += f64::from(a != b || b != c);
                three[1] += 1.0;
            }
        }
    };
    for (y, row) in stamp.chunks_exact(n).enumerate() {
        for x in 0..n {
            let at = y * n + x;
            if x + 1 < n {
                add(row[x], row[x + 1], row.get(x + 2).copied());
            }
            if y + 1 < n {
                add(row[x], stamp[at + n], stamp.get(at + 2 * n).copied());
            }
        }
    }
    // If a share A of the stamp is noise whose neighbours are equal with a probability q, 1 − A(1 − q) of the pairs are equal
    // and 1 − A(1 − q²) of the threes.
    let equal = (three[0] / three[1]) / (two[0] / two[1]) - 1.0;
    // The most frequent value has at most the probability √q.
    let most_frequent = if equal > 0.0 { equal.sqrt() } else { 0.0 };
    let most_frequent = most_frequent.max(majority_of_counts(stamp));
    AREA_SIDES.into_iter().find(|&side| {
        let others = (side * side - 1) as i32;
        stamp.len() as f64 * most_frequent.powi(others) < MAX_CHANCE
    })
}

/// The share of the value that more than half of the pixels have, if all are whole numbers: noise below half a count repeats one
/// value more often than its neighbours show. Zero otherwise.
fn majority_of_counts(stamp: &[f32]) -> f64 {
    // The vote of Boyer & Moore (1981), which keeps the value that has the majority, if one has.
    let (mut value, mut votes, mut known) = (0.0, 0usize, 0usize);
    for &own in stamp.iter().filter(|own| own.is_finite()) {
        if own.fract() != 0.0 {
            return 0.0;
        }
        known += 1;
        if votes == 0 {
            value = own;
        }
        votes = if own == value { votes + 1 } else { votes - 1 };
    }
    let count = stamp.iter().filter(|&&own| own == value).count();
    if 2 * count > known {
        count as f64 / known as f64
    } else {
        0.0
    }
}

/// The pixels to the right of a pixel and above it in a stamp of `n` pixels a side.
fn beside(at: usize, n: usize) -> impl Iterator<Item = usize> {
    let right = (at % n + 1 < n).then_some(at + 1);
    let above = (at + n < n * n).then_some(at + n);
    right.into_iter().chain(above)
}

/// The up to eight pixels around a pixel.
fn around(at: usize, n: usize) -> impl Iterator<Item = usize> {
    let side = |at: usize| at.saturating_sub(1)..(at + 2).min(n);
    let (xs, ys) = (side(at % n), side(at / n));
    ys.flat_map(move |y| xs.clone().map(move |x| y * n + x))
        .filter(move |&other| other != at)
}

/// What shows that no pixel of a stamp has to be compared with others, as of nearly all stamps.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Screening {
    /// Smallest and largest pixel, without NaN.
    low: f32,
    high: f32,
    /// Pixels below the last row with the value of the next one, in the order of rows, or of the one above.
    equal: u32,
}

impl Screening {
    fn of(stamp: &[f32], n: usize) -> Self {
        let (mut found, rest) = screen(stamp, n);
        for &value in &stamp[rest..] {
            found.low = found.low.min(value);
            found.high = found.high.max(value);
        }
        found
    }

    fn extremes(&self) -> [f32; 2] {
        [self.low, self.high]
    }
}

/// The screening of the pixels below the last row but few, and the number of pixels.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn screen(stamp: &[f32], n: usize) -> (Screening, usize) {
    // Side by side, so that vector instructions take several pixels at a time.
    let mut low = [f32::INFINITY; LANES];
    let mut high = [f32::NEG_INFINITY; LANES];
    let mut equal = [0u32; LANES];
    let below = stamp.len() - n;
    let (values, rest) = stamp[..below].as_chunks::<LANES>();
    let (next, _) = stamp[1..].as_chunks::<LANES>();
    let (above, _) = stamp[n..].as_chunks::<LANES>();
    for ((values, next), above) in values.iter().zip(next).zip(above) {
        for lane in 0..LANES {
            let value = values[lane];
            low[lane] = if value < low[lane] { value } else { low[lane] };
            high[lane] = if value > high[lane] {
                value
            } else {
                high[lane]
            };
            equal[lane] += u32::from((value == next[lane]) | (value == above[lane]));
        }
    }
    let done = below - rest.len();
    for at in done..below {
        equal[0] += u32::from((stamp[at] == stamp[at + 1]) | (stamp[at] == stamp[at + n]));
    }
    let found = Screening {
        low: low.into_iter().fold(f32::INFINITY, f32::min),
        high: high.into_iter().fold(f32::NEG_INFINITY, f32::max),
        equal: equal.iter().sum(),
    };
    (found, done)
}

#[cfg(test)]
mod tests;
