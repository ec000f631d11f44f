//! Pixels that hold no light: fill values, dead and hot pixels, cosmic rays, bad columns, trails. They become missing.
//!
//! Five properties of light behind a PSF decide, none of which a shear of the galaxy changes:
//!
//! * **Noise repeats no value.** An area of one value is a fill value, unless it is as dark as the stamp gets (no light at
//!   all, as in counts of photons) or joins its surroundings without a step (noise-free light that ends). How large
//!   an area has to be follows from how often neighbours of the stamp are equal by chance, as integers are.
//! * **Light is not negative**, apart from side lobes of the PSF.
//! * **A pixel is at most R_d times as bright as the mean of the two pixels ±d from it**: positive light f behind a PSF p has the
//!   image Σ f(y) p(x − y), so that R_d is the largest ratio of p(y) to the mean of p(y + d) and p(y − d) at any place y,
//!   pixel phases included.
//! * **Light falls no more steeply than the PSF**: a pixel is at most Q_d times as bright as the mean of the next two in any
//!   direction, by the largest ratio of p(y) to the mean of p(y + d) and p(y + 2d). So the edges of areas are found that are bright all over.
//! * **Light next to a defect** may be the edge of it, and is tested more strictly. A bright pixel inside a corner of defects is one.
//!
//! R_d is bounded by the peak of the PSF: exp(|d|² `RATIO_EXPONENT` p_max) `RATIO_MARGIN`, and that of a well sampled PSF by its ratios on its
//! pixels. Noise and light fainter than a share of
//! the stamp's peak are allowed for, so that rings of diffraction and Poisson noise of a bright galaxy do not count. On a stamp
//! of pure noise, no pixel is touched with a probability of 1 − 10⁻¹².

mod limits;
mod lines;

use multiversion::multiversion;
use ndarray::{ArrayView2, Axis};
use shearq_quantities::statistics::{SCATTER, median};

pub(crate) use self::limits::LightLimits;
use self::limits::{
    DIRECTIONS, FAINT_SHARE, LANES, MAX_SAMPLED_PEAK, MIN_DEPARTURE, PAIRS, extremes_from,
};
use self::lines::Lines;
use crate::measurement::DefectCounts;
use crate::pixels::frame;

// Defects around a bright pixel by which it is one: beside a straight edge there are three, in a corner five. Chosen by hand.
const MIN_DEFECTS_AROUND: usize = 5;
// Of the stamp's brightest pixel, from which a pixel is dead if it is darker than all pairs around it by R_d. The middle of a ring as wide as such a
// contrast allows has 0.65 of the light one pixel from it, behind a Gaussian PSF of FWHM 3.4 px.
const MIN_CORE_SHARE: f32 = 0.35;
// The same for pixels next to a defect. Chosen by hand, as in LA Cosmic (van Dokkum 2001, PASP 113, 1420).
const MIN_DEPARTURE_BESIDE: f32 = 4.0;
// The same in units of sky and counted light. Chosen by hand.
const MIN_DEPARTURE_DEAD: f32 = 5.0;
// Chance of an area of one value per stamp. Chosen by hand.
const MAX_CHANCE: f64 = 1e-6;
// Sides of square areas of one value; a line needs as many pixels. Chosen by hand.
const AREA_SIDES: std::ops::RangeInclusive<usize> = 3..=15;
// Equal neighbours that a square of 3 × 3 pixels in the last rows has at least, and a line of nine in another one.
const MIN_EQUAL_PAIRS: u32 = 6;
// Lower quartile of the changes of slope at the edge of an area, in units of the brightest pixel: noise of S/N 1000 has 0.002, noise-free wings have less, also on
// a gradient.
const MIN_STEP: f32 = 5e-4;
// Each pass may uncover pixels that were hidden by those beside them: of a square of nine hot pixels first the corners.
const MAX_PASSES: usize = 8;
// Half the side in pixels of the core of a PSF, which is on a pixel or between pixels. Chosen by hand.
const PSF_CORE: f64 = 3.0;
// Light of a dead row of a PSF in units of the mean of the adjacent ones: rows through dark rings of Airy discs of λ/D = 1.5 to 5 px, with
// obscurations of 0 to 0.6, have 0.18 and more.
const DEAD_LINE_SHARE: f64 = 0.1;
// Light of a hot pixel of a PSF in units of the peak: one of 0.05 at 14 px changes m by 0.001.
const HOT_SHARE: f32 = 0.05;
// In pixels, of the border in which noise and level of the stamp are measured. Chosen by hand.
const BORDER: usize = 4;

// Pixels from a bright one within which its rings and spikes may be as steep as a defect: ten times the FWHM of well sampled PSFs. Chosen by hand.
const NEAR: usize = 30;

/// Finds defects of exposures behind one PSF, in noise of one level and without sky, with buffers for one thread.
#[derive(Debug, Clone)]
pub struct ExposureDefects {
    defects: Defects,
    limits: LightLimits,
    noise: f32,
}

impl ExposureDefects {
    /// For a PSF of sum one and noise of the standard deviation `noise`.
    pub fn new(psf: ArrayView2<'_, f64>, noise: f64) -> Self {
        ExposureDefects {
            defects: Defects::default(),
            limits: LightLimits::from_psf(psf),
            noise: noise as f32,
        }
    }

    /// Keeps light behind another PSF of sum one, too.
    pub fn keep_light_behind(&mut self, psf: ArrayView2<'_, f64>) {
        self.limits = self.limits.wider(&LightLimits::from_psf(psf));
    }

    /// Makes the pixels of a square part of an exposure, of `n` pixels a side, NaN that hold no light: areas of one value, and pixels that are
    /// too dark or too bright for those around them. Appends their places to `found`.
    pub fn remove(&mut self, part: &mut [f32], n: usize, found: &mut Vec<usize>) {
        let limits = &self.limits;
        let departure = MIN_DEPARTURE * self.noise;
        let floor = departure * limits.noise[0];
        let before: Vec<bool> = part.iter().map(|value| value.is_finite()).collect();
        self.defects
            .remove_repeated(part, n, Screening::of(part, n));
        remove_infinite(part);
        for _ in 0..MAX_PASSES {
            let places = &mut self.defects.places;
            places.clear();
            for (at, &value) in part.iter().enumerate() {
                let is_dark = value < -departure;
                if !is_dark && (value.is_nan() || value <= floor) {
                    continue;
                }
                let most = match is_dark {
                    true => f32::INFINITY,
                    false => most_light(part, n, at, (0.0, departure), limits),
                };
                if !is_dark && value <= most {
                    continue;
                }
                let [x, y] = [at % n, at / n];
                let columns = x.saturating_sub(NEAR)..(x + NEAR + 1).min(n);
                let rows = y.saturating_sub(NEAR)..(y + NEAR + 1).min(n);
                let around = rows.flat_map(|y| &part[y * n..][columns.clone()]);
                let peak = around.copied().fold(0.0, f32::max);
                if value < -departure - limits.lobe * peak || value > most + FAINT_SHARE * peak {
                    places.push(at);
                }
            }
            if places.is_empty() {
                break;
            }
            // Beside a dark pixel, means of pairs show no light.
            if places.iter().any(|&at| part[at] < 0.0) {
                places.retain(|&at| part[at] < 0.0);
            }
            for &at in &*places {
                part[at] = f32::NAN;
            }
        }
        found.extend((0..part.len()).filter(|&at| before[at] && part[at].is_nan()));
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
    /// A stamp less the level of its border.
    levelled: Vec<f32>,
    lines: Lines,
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
            levelled: Vec::with_capacity(n * n),
            lines: Lines::new(n),
        }
    }

    /// Makes the pixels of a stamp of `n` pixels a side NaN that hold no light, before its sky and noise are known.
    pub(crate) fn remove_before_survey(
        &mut self,
        stamp: &mut [f32],
        n: usize,
        limits: &LightLimits,
    ) -> DefectCounts {
        let mut found = DefectCounts {
            repeated: self.remove_repeated(stamp, n, Screening::of(stamp, n)),
            ..DefectCounts::default()
        };
        let StampSky { level, noise, .. } = self.border_sky(stamp, n);
        let mut levelled = std::mem::take(&mut self.levelled);
        levelled.clear();
        levelled.extend(stamp.iter().map(|value| value - level));
        let repeated = found.total();
        self.remove_unlit(&mut levelled, n, noise, limits, &mut found);
        self.levelled = levelled;
        if found.total() > repeated {
            let marked = stamp.iter_mut().zip(&self.marks).filter(|(_, mark)| **mark);
            marked.for_each(|(value, _)| *value = f32::NAN);
        }
        found
    }

    /// Makes pixels NaN that are too dark or too bright, or on lines across the stamp, in noise of this level and without sky. Counts them
    /// beside those that were `found` by [`Defects::remove_repeated`] on the same stamp.
    pub(crate) fn remove_unlit(
        &mut self,
        stamp: &mut [f32],
        n: usize,
        noise: f32,
        limits: &LightLimits,
        found: &mut DefectCounts,
    ) {
        let mut sky = StampSky::of_noise(noise);
        self.places.clear();
        self.lines.find(&mut self.places, stamp, n, noise, limits);
        if found.is_empty() {
            let is_exceeded = Threshold::of(extremes(stamp), &sky, limits).is_exceeded();
            if self.places.is_empty() && !is_exceeded {
                return;
            }
            self.clear_marks(stamp.len());
        }
        remove_infinite(stamp);
        // Before pixels, of which each would have to depart by more.
        for &at in &self.places {
            self.marks[at] = true;
            found.lines += u32::from(!stamp[at].is_nan());
            stamp[at] = f32::NAN;
        }
        let mut is_measured = false;
        for _ in 0..MAX_PASSES {
            let beside = !found.is_empty();
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
            if self.places.is_empty() {
                break;
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
        }
    }

    fn clear_marks(&mut self, pixels: usize) {
        self.marks.clear();
        self.marks.resize(pixels, false);
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
        let threshold = Threshold::of(extremes(stamp), sky, limits);
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
        find_dead(&mut self.places, stamp, n, sky, limits, &threshold);
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
                    let light = value - sky.level - threshold.faint;
                    if light > most_light(stamp, n, at, (sky.level, noise), limits)
                        || beside && light > noise && self.is_inside(n, at)
                    {
                        self.places.push(at);
                    }
                }
            }
        }
        false
    }

    /// Whether a pixel is in a corner of defects.
    fn is_inside(&self, n: usize, at: usize) -> bool {
        around(at, n).filter(|&at| self.marks[at]).count() >= MIN_DEFECTS_AROUND
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

    /// Level and scatter of the border of a stamp as it was read.
    fn border_sky(&mut self, stamp: &[f32], n: usize) -> StampSky {
        let values = &mut self.values;
        values.clear();
        // Without areas of one value, which may be most of it.
        let pairs = frame(stamp, n, BORDER).flat_map(|piece| piece.windows(2));
        let pairs = pairs.filter(|pair| pair[0] != pair[1]);
        values.extend(pairs.map(|pair| pair[0]).filter(|value| value.is_finite()));
        if values.is_empty() {
            let border = frame(stamp, n, BORDER).flatten().copied();
            values.extend(border.filter(|value| value.is_finite()));
        }
        let level = median(values).unwrap_or(0.0);
        values
            .iter_mut()
            .for_each(|value| *value = (*value - level).abs());
        let scatter = SCATTER * median(values).unwrap_or(0.0);
        // Most pixels of few counts have one value.
        let noise = if scatter > 0.0 {
            scatter
        } else {
            let square: f64 = values.iter().map(|value| f64::from(*value).powi(2)).sum();
            (square / values.len().max(1) as f64).sqrt() as f32
        };
        StampSky {
            level,
            ..StampSky::of_noise(noise)
        }
    }

    /// Makes areas of one value NaN on a stamp as it was read: a sky that is subtracted with its gradient makes values differ. Returns
    /// the number of pixels.
    pub(crate) fn remove_repeated(
        &mut self,
        stamp: &mut [f32],
        n: usize,
        screening: Screening,
    ) -> u32 {
        if !screening.may_repeat() {
            return 0;
        }
        remove_infinite(stamp);
        let Some(side) = area_side(stamp, n) else {
            return 0;
        };
        let sky = self.border_sky(stamp, n);
        // The darkest value may recur, as zeros of counts without sky. A pixel far below the sky is not the darkest: one of −99 would
        // make an area of all zeros.
        let dark = match sky.noise > 0.0 {
            true => sky.level - MIN_DEPARTURE_BESIDE * sky.noise,
            false => f32::NEG_INFINITY,
        };
        let bright = stamp.iter().copied().filter(|&value| value >= dark);
        let low = bright.fold(f32::INFINITY, f32::min);
        self.clear_marks(stamp.len());
        self.mark_areas(stamp, n, side, low);
        let unmarked = stamp.iter().zip(&self.marks).filter(|(_, mark)| !**mark);
        let high = unmarked.fold(f32::NEG_INFINITY, |high, (value, _)| high.max(*value));
        let mut count = 0;
        for first in 0..stamp.len() {
            if !self.marks[first] || stamp[first].is_nan() {
                continue;
            }
            self.collect_area(n, first);
            let Defects {
                marks,
                places,
                values,
                ..
            } = &mut *self;
            values.clear();
            for &at in &*places {
                for other in beside(at, n).filter(|&other| !marks[other]) {
                    let step = stamp[at] - stamp[other];
                    // Less the next step in that direction, so that a gradient joins.
                    let next = 2 * other as isize - at as isize;
                    let next = usize::try_from(next).ok().filter(|&next| {
                        let is_beside = beside(other, n).any(|place| place == next);
                        is_beside && !marks[next] && stamp[next].is_finite()
                    });
                    let further = next.map_or(0.0, |next| stamp[other] - stamp[next]);
                    values.extend(Some((step - further).abs()).filter(|step| step.is_finite()));
                }
            }
            let quarter = values.len() / 4;
            let is_light = !values.is_empty()
                && *values.select_nth_unstable_by(quarter, f32::total_cmp).1
                    < MIN_STEP * (high - sky.level);
            for &at in &self.places {
                self.marks[at] = !is_light;
                if !is_light {
                    stamp[at] = f32::NAN;
                    count += 1;
                }
            }
        }
        count
    }

    /// Collects the places of marked pixels that are connected with `first` by their sides: an area, or several that touch.
    fn collect_area(&mut self, n: usize, first: usize) {
        let Defects { marks, places, .. } = self;
        places.clear();
        places.push(first);
        marks[first] = false;
        let mut next = 0;
        while let Some(&at) = places.get(next) {
            for other in beside(at, n).filter(|&other| std::mem::take(&mut marks[other])) {
                places.push(other);
            }
            next += 1;
        }
        places.iter().for_each(|&at| marks[at] = true);
    }

    /// Marks squares of `side` pixels of one value other than `low`, and lines of as many pixels.
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
                if value.is_nan() || value == low {
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

/// Finds pixels in a bright core that are much darker than those around them.
fn find_dead(
    places: &mut Vec<usize>,
    stamp: &[f32],
    n: usize,
    sky: &StampSky,
    limits: &LightLimits,
    threshold: &Threshold,
) {
    let core = MIN_CORE_SHARE * (threshold.high - sky.level);
    if core < MIN_DEPARTURE * sky.noise {
        return;
    }
    for (first, values) in (0usize..).step_by(LANES).zip(stamp.chunks(LANES)) {
        if !values
            .iter()
            .fold(false, |any, value| any | (*value - sky.level > core))
        {
            continue;
        }
        // One of the pixels left and right of a dead one is as bright as their mean.
        let bright = (first..)
            .zip(values)
            .filter(|(_, v)| **v - sky.level > core);
        for (bright, _) in bright {
            for at in [bright.wrapping_sub(1), bright + 1] {
                if at >= stamp.len() || places.contains(&at) {
                    continue;
                }
                let (value, around) = (stamp[at] - sky.level, pair_means(stamp, n, at));
                let around = &around[..DIRECTIONS];
                // At an edge, one hot pixel would make those beside it dead.
                if around.iter().any(|mean| mean.is_nan()) {
                    continue;
                }
                let least = around.iter().copied().fold(f32::INFINITY, f32::min) - sky.level;
                // Of a sky of one electron or more, so that electrons are no fewer per unit than 1/σ.
                let counted = (sky.noise * (sky.noise + least)).sqrt();
                if (core..f32::INFINITY).contains(&least)
                    && value < least / limits.ratios[0]
                    && least - value > MIN_DEPARTURE * sky.noise
                    && least - value > MIN_DEPARTURE_DEAD * counted
                {
                    places.push(at);
                }
            }
        }
    }
}

/// Pixels of a PSF of sum one, in noise of `noise`, that are darker than the pairs of pixels around them by more than their light
/// can fall. In a dead row or column, the pair along it is as dark; so it is in dark rings, whose rows have more light.
pub(crate) fn dead_pixels(psf: ArrayView2<'_, f64>, noise: f64) -> usize {
    let lines = [1, 0].map(|axis| dead_lines(&psf.sum_axis(Axis(axis)).to_vec()));
    let (n, noise) = (psf.ncols(), noise as f32);
    let pixels: Vec<f32> = psf.iter().map(|&value| value as f32).collect();
    let [_, peak] = extremes(&pixels);
    let ratio = LightLimits::from_peak(peak).ratios[0];
    let is_dead = |at: &usize| {
        let mut around = pair_means(&pixels, n, *at);
        let around = &mut around[..DIRECTIONS];
        let is_known = around.iter().all(|mean| mean.is_finite());
        around.sort_by(f32::total_cmp);
        let is_on_line = lines[0][*at / n] || lines[1][*at % n];
        let least = around[usize::from(is_on_line)];
        let departure = MIN_DEPARTURE * noise;
        is_known
            && least > FAINT_SHARE * peak
            && pixels[*at] < least / ratio
            && least - pixels[*at] > departure
    };
    (0..pixels.len()).filter(is_dead).count()
}

// Which rows or columns have much less light than the adjacent ones, by their sums.
fn dead_lines(sums: &[f64]) -> Vec<bool> {
    let is_dead = |at: usize| match (at.checked_sub(1), sums.get(at + 1)) {
        (Some(before), Some(after)) => {
            sums[at].abs() < 0.5 * DEAD_LINE_SHARE * (sums[before] + after)
        }
        _ => false,
    };
    (0..sums.len()).map(is_dead).collect()
}

/// Distances from the middle, in pixels, of the pixels of a PSF of sum one, in noise of `noise`, that are brighter than its core
/// allows. The middle of a narrow core is not tested.
pub(crate) fn hot_pixels(psf: ArrayView2<'_, f64>, noise: f64) -> Vec<f64> {
    let n = psf.ncols();
    let pixels: Vec<f32> = psf.iter().map(|&value| value as f32).collect();
    let middle = 0.5 * (n as f64 - 1.0);
    let away = |at: usize| [at % n, at / n].map(|at| (at as f64 - middle).abs());
    let is_core = |at: usize| away(at).iter().all(|away| *away < PSF_CORE);
    let core = (0..pixels.len()).filter(|&at| is_core(at));
    let peak = core.map(|at| pixels[at]).fold(0.0, f32::max);
    let limits = LightLimits::from_peak(peak);
    let is_narrow = f64::from(peak) > MAX_SAMPLED_PEAK;
    let noise = MIN_DEPARTURE * noise as f32;
    let is_hot = |&at: &usize| {
        let light = pixels[at] - HOT_SHARE * peak;
        light > noise
            && !(is_narrow && is_core(at))
            && light > most_light(&pixels, n, at, (0.0, noise), &limits)
    };
    let hot = (0..pixels.len()).filter(is_hot);
    hot.map(|at| away(at)[0].hypot(away(at)[1])).collect()
}

/// The means of [`PAIRS`] of pixels; NaN with one that is missing or off the stamp.
fn pair_means(stamp: &[f32], n: usize, at: usize) -> [f32; PAIRS.len()] {
    PAIRS.map(|(dx, dy)| {
        0.5 * offset_pixel(stamp, n, at, (dx, dy)) + 0.5 * offset_pixel(stamp, n, at, (-dx, -dy))
    })
}

/// The pixel (dx, dy) from a pixel; NaN off the stamp.
fn offset_pixel(stamp: &[f32], n: usize, at: usize, (dx, dy): (isize, isize)) -> f32 {
    let x = (at % n).wrapping_add_signed(dx);
    let y = (at / n).wrapping_add_signed(dy);
    match x < n && y < n {
        true => stamp[y * n + x],
        false => f32::NAN,
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
    let mut most = f32::INFINITY;
    // A pair with a missing pixel bounds nothing. NaN is also an infinite ratio times no light.
    let mut bound_by = |mean: f32, ratio: f32, departure: f32| {
        let bound = ratio * (mean - level).max(0.0) + noise * departure;
        if !mean.is_nan() && bound < most {
            most = bound;
        }
    };
    for (k, mean) in pair_means(stamp, n, at).into_iter().enumerate() {
        bound_by(mean, limits.ratios[k], limits.noise[k]);
    }
    for (k, (dx, dy)) in PAIRS.into_iter().take(DIRECTIONS).enumerate() {
        for (dx, dy) in [(dx, dy), (-dx, -dy)] {
            let next = offset_pixel(stamp, n, at, (dx, dy));
            let mean = 0.5 * next + 0.5 * offset_pixel(stamp, n, at, (2 * dx, 2 * dy));
            bound_by(mean, limits.steepness[k], limits.steepness_noise[k]);
        }
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

/// The up to four pixels beside a pixel in a stamp of `n` pixels a side.
fn beside(at: usize, n: usize) -> impl Iterator<Item = usize> {
    let left = (!at.is_multiple_of(n)).then(|| at - 1);
    let right = (at % n + 1 < n).then_some(at + 1);
    let above = (at + n < n * n).then_some(at + n);
    left.into_iter()
        .chain(right)
        .chain(at.checked_sub(n))
        .chain(above)
}

/// The up to eight pixels around a pixel.
fn around(at: usize, n: usize) -> impl Iterator<Item = usize> {
    let side = |at: usize| at.saturating_sub(1)..(at + 2).min(n);
    let (xs, ys) = (side(at % n), side(at / n));
    ys.flat_map(move |y| xs.clone().map(move |x| y * n + x))
        .filter(move |&other| other != at)
}

fn remove_infinite(stamp: &mut [f32]) {
    for value in stamp.iter_mut().filter(|value| value.is_infinite()) {
        *value = f32::NAN;
    }
}

/// What shows that a stamp as it was read has no areas of one value, as nearly all stamps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Screening {
    /// Pixels with the value of the next one, in the order of rows, or of the one above.
    equal: u32,
}

impl Screening {
    pub(crate) fn of(stamp: &[f32], n: usize) -> Self {
        let last = &stamp[stamp.len() - n..];
        let in_last = last.windows(2).filter(|pair| pair[0] == pair[1]).count();
        Screening {
            equal: equal_below(stamp, n) + in_last as u32,
        }
    }

    /// Whether rows, or the whole stamp, may have one value.
    pub(crate) fn may_repeat(self) -> bool {
        self.equal >= MIN_EQUAL_PAIRS
    }
}

/// The pixels below the last row with the value of the next one or of the one above.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn equal_below(stamp: &[f32], n: usize) -> u32 {
    // Side by side, so that vector instructions take several pixels at a time.
    let mut equal = [0u32; LANES];
    let below = stamp.len() - n;
    let (values, rest) = stamp[..below].as_chunks::<LANES>();
    let (next, _) = stamp[1..].as_chunks::<LANES>();
    let (above, _) = stamp[n..].as_chunks::<LANES>();
    for ((values, next), above) in values.iter().zip(next).zip(above) {
        for lane in 0..LANES {
            let value = values[lane];
            equal[lane] += u32::from((value == next[lane]) | (value == above[lane]));
        }
    }
    for at in below - rest.len()..below {
        equal[0] += u32::from((stamp[at] == stamp[at + 1]) | (stamp[at] == stamp[at + n]));
    }
    equal.iter().sum()
}

/// Smallest and largest pixel, without NaN.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn extremes(stamp: &[f32]) -> [f32; 2] {
    extremes_from([f32::INFINITY, f32::NEG_INFINITY], stamp)
}

#[cfg(test)]
mod tests;
