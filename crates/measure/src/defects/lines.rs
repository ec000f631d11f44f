//! Lines across a whole stamp that hold no light: bad columns and rows, and trails of satellites.
//!
//! Sums of columns and rows obey the limits of [`LightLimits`], because each of their pixels does. Their noise is that of a line, so
//! that a departure of 1.5 σ per pixel is found, where that of one pixel has to be 11 σ. A trail is as smooth as light, but no light of
//! a galaxy has one brightness, or one that changes evenly, from edge to edge and none beside it.

use multiversion::multiversion;
use shearq_quantities::statistics::{SCATTER, median};

use super::limits::{DIRECTIONS, FAINT_SHARE, LightLimits, MIN_DEPARTURE};

// Of the pixels of a line that depart in its direction: noise has half, so that one cosmic ray is no line. Chosen by hand.
const MIN_DEPARTING_SHARE: f32 = 0.75;
// Lines that may be darker than light gets. Chosen by hand.
const MAX_DARK_LINES: usize = 3;

// In pixels, of the strips along the edges where a trail begins and ends. Chosen by hand.
const STRIP: usize = 4;
// Pixels of a strip of which the mean is taken: its depth, and three along it.
const STRIP_PIXELS: f32 = 3.0 * STRIP as f32;
// In pixels around the brightest one, of which an end is the centroid. Chosen by hand.
const END_RADIUS: usize = 3;
// In sides of the stamp. Shorter trails cross a corner, beyond the window of the galaxy.
const MIN_TRAIL: f32 = 0.5;
// Pixels along a trail of which the mean is taken, so that the noise is a quarter of a pixel's. Chosen by hand.
const PIECE: usize = 6;
// In pixels from the centre of the stamp, where the galaxy adds its light. Chosen by hand.
const GALAXY_RADIUS: f32 = 12.0;
// Pieces beyond that radius. Chosen by hand.
const MIN_PIECES: usize = 3;
// Of the fainter end: three galaxies in a row are fainter between them. Chosen by hand.
const MIN_PIECE: f32 = 0.65;
// Faintest piece in units of the upper quartile of those beyond the galaxy, both in units of the ramp through the latter. Wings of an
// exponential disc are as uniform from a scale of 28 px on; a ramp is no nearer to them, because they fall to both sides.
const MIN_UNIFORMITY: f32 = 0.7;
// Faint end of that ramp in units of the bright one. Chosen by hand: satellites that turn, and ends of trails.
const MIN_RAMP: f32 = 0.15;
// In pixels from a trail. Chosen by hand.
const BESIDE_TRAIL: f32 = 8.0;
// What is there in units of the trail, which leaves a fifth of it if its FWHM is 8 px. Chosen by hand.
const MAX_BESIDE: f32 = 0.35;
// In pixels from the middle of a trail, where a Moffat PSF of FWHM 3.4 px leaves 3 % of its light.
const TRAIL_HALF_WIDTH: f32 = 6.0;

/// Finds lines, with buffers for one thread.
#[derive(Debug, Clone, Default)]
pub(super) struct Lines {
    /// Of columns, and of rows.
    sums: [Vec<f32>; 2],
    values: Vec<f32>,
    /// Means across the strips along the left, right, lower and upper edge.
    strips: [Vec<f32>; 4],
    /// Of a trail: its pieces.
    pieces: Vec<Piece>,
}

impl Lines {
    /// For stamps of up to `n` pixels a side without allocation.
    pub(super) fn new(n: usize) -> Self {
        let buffer = || Vec::with_capacity(n);
        Lines {
            sums: [buffer(), buffer()],
            values: buffer(),
            strips: [buffer(), buffer(), buffer(), buffer()],
            pieces: Vec::with_capacity(n),
        }
    }

    /// Adds the pixels of bad columns and rows, or else of a trail, on a stamp of `n` pixels a side in noise of this level.
    pub(super) fn find(
        &mut self,
        places: &mut Vec<usize>,
        stamp: &[f32],
        n: usize,
        noise: f32,
        limits: &LightLimits,
    ) {
        let mut sums = std::mem::take(&mut self.sums);
        sum_lines(stamp, n, &mut sums);
        for (axis, sums) in sums.iter().enumerate() {
            let bounds = LineBounds { sums, axis, limits };
            self.find_bad(places, stamp, n, noise, &bounds);
        }
        self.sums = sums;
        if places.is_empty()
            && let Some(trail) = self.find_trail(stamp, n, noise)
        {
            let on_trail = |at: &usize| trail.distance(*at, n) <= TRAIL_HALF_WIDTH;
            places.extend((0..stamp.len()).filter(on_trail));
        }
    }

    fn find_bad(
        &mut self,
        places: &mut Vec<usize>,
        stamp: &[f32],
        n: usize,
        noise: f32,
        bounds: &LineBounds<'_>,
    ) {
        let white = noise * (n as f32).sqrt();
        // Nearly all stamps end here: light that is too faint only widens the bounds.
        let least = MIN_DEPARTURE * white;
        if !exceeds(bounds.sums, least) {
            return;
        }
        let faint = bounds.faint();
        if !(0..n).any(|line| bounds.departs(line, white, faint).is_some()) {
            return;
        }
        // Noise that is correlated along lines, or stripes.
        let values = &mut self.values;
        values.clear();
        let steps = bounds.sums.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        values.extend(steps.filter(|step| step.is_finite()));
        let step = median(values).unwrap_or(0.0);
        let noise = white.max(SCATTER * step / 2f32.sqrt());
        values.clear();
        values.extend(bounds.sums.iter().filter(|sum| sum.is_finite()));
        values.sort_unstable_by(f32::total_cmp);
        let darkest = values.get(MAX_DARK_LINES).copied().unwrap_or(0.0);
        for line in 0..n {
            let Some(reference) = bounds.departs(line, noise, faint) else {
                continue;
            };
            let pixel = |line: usize, k: usize| match bounds.axis {
                0 => stamp[k * n + line],
                _ => stamp[line * n + k],
            };
            let departs = |k: &usize| match reference {
                Reference::Lines([a, b]) => {
                    pixel(line, *k) > 0.5 * pixel(a, *k) + 0.5 * pixel(b, *k)
                }
                Reference::Sky => pixel(line, *k) < darkest / n as f32,
            };
            let is_dark = matches!(reference, Reference::Sky);
            if is_dark && bounds.sums[line] > darkest - MIN_DEPARTURE * noise {
                continue;
            }
            if (0..n).filter(departs).count() as f32 >= MIN_DEPARTING_SHARE * n as f32 {
                places.extend((0..n).map(|k| match bounds.axis {
                    0 => k * n + line,
                    _ => line * n + k,
                }));
            }
        }
    }

    fn find_trail(&mut self, stamp: &[f32], n: usize, noise: f32) -> Option<Trail> {
        // No place of such a stamp is beyond its galaxy.
        if n < 2 * STRIP {
            return None;
        }
        let mut strips = std::mem::take(&mut self.strips);
        mean_strips(stamp, n, &mut strips);
        let ends = [0, 1, 2, 3].map(|side| self.find_end(&strips[side], n, side, noise));
        self.strips = strips;
        // A ramp may fit light along a wrong line, too, so that all lines of one brightness come first.
        for may_fade in [false, true] {
            for (k, first) in ends.iter().enumerate() {
                for second in &ends[k + 1..] {
                    let (Some(first), Some(second)) = (first, second) else {
                        continue;
                    };
                    let trail = Trail::new([first.at, second.at]);
                    let level = first.level.min(second.level);
                    if trail.length >= MIN_TRAIL * n as f32
                        && self.is_trail(&trail, stamp, n, level, may_fade)
                    {
                        return Some(trail);
                    }
                }
            }
        }
        None
    }

    /// The brightest place of the strip along the left, right, lower or upper edge, if it is brighter than noise.
    fn find_end(&mut self, strip: &[f32], n: usize, side: usize, noise: f32) -> Option<End> {
        // Nearly all strips end here.
        if !is_brighter(strip, MIN_DEPARTURE * noise / STRIP_PIXELS.sqrt()) {
            return None;
        }
        let inner = (1usize..).zip(strip.windows(3));
        let (brightest, level) = inner
            .map(|(at, near)| (at, smooth([near[0], near[1], near[2]])))
            .fold((0, f32::MIN), |most, other| match other.1 > most.1 {
                true => other,
                false => most,
            });
        let around = brightest.saturating_sub(END_RADIUS)..(brightest + END_RADIUS + 1).min(n);
        let light = |at: usize| strip[at].max(0.0);
        let total: f32 = around.clone().map(light).sum();
        let along = around.map(|at| at as f32 * light(at)).sum::<f32>() / total;
        let depth = 0.5 * (STRIP as f32 - 1.0);
        let far = n as f32 - 1.0 - depth;
        let at = [[depth, along], [far, along], [along, depth], [along, far]][side];
        // Noise that is correlated, and the wings of large galaxies.
        self.values.clear();
        let finite = strip.iter().filter(|value| value.is_finite());
        self.values.extend(finite);
        let middle = median(&mut self.values)?;
        let apart = |value: &mut f32| *value = (*value - middle).abs();
        self.values.iter_mut().for_each(apart);
        let scatter = SCATTER * median(&mut self.values)? / 3f32.sqrt();
        (level - middle > MIN_DEPARTURE * scatter).then_some(End { at, level })
    }

    /// Whether light of about one brightness, or one that changes evenly if it `may_fade`, is along a line, of `level` or more, and none
    /// beside it.
    fn is_trail(
        &mut self,
        trail: &Trail,
        stamp: &[f32],
        n: usize,
        level: f32,
        may_fade: bool,
    ) -> bool {
        let Lines { pieces, values, .. } = self;
        pieces.clear();
        let middle = 0.5 * (n as f32 - 1.0);
        let mean = |first: usize, across: &[f32]| {
            let (mut sum, mut count) = (0.0, 0.0);
            for step in first..first + PIECE {
                for &off in across {
                    let value = trail
                        .pixel(step as f32, off, n)
                        .map_or(f32::NAN, |at| stamp[at]);
                    if value.is_finite() {
                        sum += value;
                        count += 1.0;
                    }
                }
            }
            sum / count
        };
        for first in (0..).step_by(PIECE).take(trail.length as usize / PIECE) {
            let light = mean(first, &[-1.0, 0.0, 1.0]);
            // Not a number, without pixels, is not too faint.
            if light < MIN_PIECE * level {
                return false;
            }
            let along = (first + PIECE / 2) as f32;
            let [x, y] = trail.at(along, 0.0);
            let is_beyond = (x - middle).hypot(y - middle) > GALAXY_RADIUS;
            pieces.push(Piece {
                along,
                light,
                beside: match is_beyond {
                    true => mean(first, &[-BESIDE_TRAIL, BESIDE_TRAIL]),
                    false => f32::NAN,
                },
                is_beyond: is_beyond && light.is_finite(),
            });
        }
        let beyond = || pieces.iter().filter(|piece| piece.is_beyond);
        if beyond().count() < MIN_PIECES {
            return false;
        }
        let ramp = match may_fade {
            true => Ramp::through(beyond()),
            false => Ramp::EVEN,
        };
        let ends = [0.0, trail.length].map(|along| ramp.at(along));
        if ends[0].min(ends[1]) < MIN_RAMP * ends[0].max(ends[1]) {
            return false;
        }
        values.clear();
        values.extend(beyond().map(|piece| piece.light / ramp.at(piece.along)));
        let rank = 3 * values.len() / 4;
        let bright = *values.select_nth_unstable_by(rank, f32::total_cmp).1;
        let lights = pieces
            .iter()
            .map(|piece| piece.light / ramp.at(piece.along));
        if lights.fold(f32::INFINITY, f32::min) < MIN_UNIFORMITY * bright {
            return false;
        }
        values.clear();
        let beside = beyond().map(|piece| piece.beside / ramp.at(piece.along));
        values.extend(beside.filter(|light| light.is_finite()));
        median(values).is_some_and(|light| light <= MAX_BESIDE * bright)
    }
}

/// A part of a trail.
#[derive(Debug, Clone, Copy)]
struct Piece {
    /// In pixels from the beginning of the trail.
    along: f32,
    light: f32,
    /// NaN at the galaxy.
    beside: f32,
    is_beyond: bool,
}

/// Brightness that changes evenly along a trail.
#[derive(Debug, Clone, Copy)]
struct Ramp {
    start: f32,
    slope: f32,
}

impl Ramp {
    /// Of one brightness.
    const EVEN: Ramp = Ramp {
        start: 1.0,
        slope: 0.0,
    };

    /// The least squares of some pieces.
    fn through<'p>(pieces: impl Iterator<Item = &'p Piece> + Clone) -> Self {
        let count = pieces.clone().count() as f32;
        let mean = |of: fn(&Piece) -> f32| pieces.clone().map(of).sum::<f32>() / count;
        let (along, light) = (mean(|piece| piece.along), mean(|piece| piece.light));
        let about = pieces.map(|piece| (piece.along - along, piece.light - light));
        let [square, product] = about.fold([0.0; 2], |[square, product], (x, y)| {
            [square + x * x, product + x * y]
        });
        let slope = product / square;
        Ramp {
            start: light - slope * along,
            slope,
        }
    }

    fn at(&self, along: f32) -> f32 {
        self.start + self.slope * along
    }
}

/// With which a line does not agree.
#[derive(Debug, Clone, Copy)]
enum Reference {
    /// It is brighter than these two lines allow.
    Lines([usize; 2]),
    /// It is darker than the sky.
    Sky,
}

/// What the sums of columns, axis 0, or rows can be.
#[derive(Debug)]
struct LineBounds<'a> {
    sums: &'a [f32],
    axis: usize,
    limits: &'a LightLimits,
}

impl LineBounds<'_> {
    /// Light that is too faint to be tested: a share of the second brightest line, because the brightest may be bad.
    fn faint(&self) -> f32 {
        let (mut first, mut second) = (0.0f32, 0.0f32);
        for &sum in self.sums {
            // Without a branch, and without NaN.
            let lower = if sum > first { first } else { sum };
            first = if sum > first { sum } else { first };
            second = if lower > second { lower } else { second };
        }
        FAINT_SHARE * second
    }

    /// With what a line does not agree, in noise of a line.
    fn departs(&self, line: usize, noise: f32, faint: f32) -> Option<Reference> {
        let (sum, limits) = (self.sums[line], self.limits);
        if sum < -MIN_DEPARTURE * noise - limits.lobe / FAINT_SHARE * faint {
            return Some(Reference::Sky);
        }
        // The limits of PAIRS and of DIRECTIONS across this line.
        let near = (limits.ratios[self.axis], limits.noise[self.axis]);
        let far = DIRECTIONS + self.axis;
        let far = (limits.ratios[far], limits.noise[far]);
        let steep = (
            limits.steepness[self.axis],
            limits.steepness_noise[self.axis],
        );
        let light = sum - faint;
        if light <= MIN_DEPARTURE * noise {
            return None;
        }
        let references = [
            ([-1, 1], near),
            ([-2, 2], far),
            ([1, 2], steep),
            ([-1, -2], steep),
        ];
        references
            .into_iter()
            .find_map(|(lines, (ratio, departure))| {
                let lines = lines.map(|step| line.wrapping_add_signed(step));
                let [a, b] = lines.map(|line| self.sums.get(line).copied().unwrap_or(f32::NAN));
                let most = ratio * (0.5 * a + 0.5 * b).max(0.0) + noise * departure * MIN_DEPARTURE;
                // `max` takes zero for NaN.
                (!(a + b).is_nan() && light > most).then_some(Reference::Lines(lines))
            })
    }
}

/// Sums of columns and of rows.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_lines(stamp: &[f32], n: usize, sums: &mut [Vec<f32>; 2]) {
    const LANES: usize = 16;
    let [columns, rows] = sums;
    columns.clear();
    columns.resize(n, 0.0);
    rows.clear();
    for row in stamp.chunks_exact(n) {
        for (sum, value) in columns.iter_mut().zip(row) {
            *sum += value;
        }
        let (chunks, rest) = row.as_chunks::<LANES>();
        let mut lanes = [0.0f32; LANES];
        for chunk in chunks {
            for (lane, value) in lanes.iter_mut().zip(chunk) {
                *lane += value;
            }
        }
        for half in [8, 4, 2, 1] {
            let (low, high) = lanes.split_at_mut(half);
            for (low, high) in low.iter_mut().zip(&*high) {
                *low += high;
            }
        }
        rows.push(lanes[0] + rest.iter().sum::<f32>());
    }
}

/// Whether a number is farther from zero than `most`.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn exceeds(numbers: &[f32], most: f32) -> bool {
    // Without an early exit, so that several numbers are tested at a time.
    numbers
        .iter()
        .fold(false, |any, number| any | (number.abs() > most))
}

/// Means across the strips along the left, right, lower and upper edge of a stamp, which is at least as wide as one.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn mean_strips(stamp: &[f32], n: usize, strips: &mut [Vec<f32>; 4]) {
    // From the edge on.
    let mean = |[a, b, c, d]: [f32; STRIP]| (a + b + c + d) / STRIP as f32;
    for strip in strips.iter_mut() {
        strip.clear();
        strip.resize(n, 0.0);
    }
    let [left, right, lower, upper] = strips;
    let rows = stamp.chunks_exact(n).zip(left.iter_mut().zip(right));
    for (row, (left, right)) in rows {
        if let (Some(first), Some(&[d, c, b, a])) = (row.first_chunk(), row.last_chunk()) {
            *left = mean(*first);
            *right = mean([a, b, c, d]);
        }
    }
    let row = |y: usize| &stamp[y * n..][..n];
    let (first, last) = ([0, 1, 2, 3].map(row), [1, 2, 3, 4].map(|k| row(n - k)));
    for (strip, rows) in [(lower, first), (upper, last)] {
        let [a, b, c, d] = rows;
        for (x, out) in strip[..n].iter_mut().enumerate() {
            *out = mean([a[x], b[x], c[x], d[x]]);
        }
    }
}

fn smooth([a, b, c]: [f32; 3]) -> f32 {
    (a + b + c) / 3.0
}

/// Whether the mean of three neighbours is above a level.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn is_brighter(strip: &[f32], level: f32) -> bool {
    let (next, further) = (&strip[1..], &strip[2..]);
    let near = strip.iter().zip(next).zip(further);
    near.fold(false, |any, ((a, b), c)| {
        any | (smooth([*a, *b, *c]) > level)
    })
}

#[derive(Debug, Clone, Copy)]
struct End {
    at: [f32; 2],
    level: f32,
}

#[derive(Debug, Clone, Copy)]
struct Trail {
    from: [f32; 2],
    /// Of length one.
    direction: [f32; 2],
    length: f32,
}

impl Trail {
    fn new([from, to]: [[f32; 2]; 2]) -> Self {
        let step = [0, 1].map(|k| to[k] - from[k]);
        let length = step[0].hypot(step[1]);
        Trail {
            from,
            direction: step.map(|step| step / length),
            length,
        }
    }

    /// The place `along` the trail and `across` it.
    fn at(&self, along: f32, across: f32) -> [f32; 2] {
        let ([x, y], [dx, dy]) = (self.from, self.direction);
        [x + along * dx - across * dy, y + along * dy + across * dx]
    }

    fn pixel(&self, along: f32, across: f32, n: usize) -> Option<usize> {
        let [x, y] = self.at(along, across).map(|place| place.round());
        let on_stamp = |place: f32| (0.0..n as f32).contains(&place);
        (on_stamp(x) && on_stamp(y)).then(|| y as usize * n + x as usize)
    }

    fn distance(&self, at: usize, n: usize) -> f32 {
        let [x, y] = [
            (at % n) as f32 - self.from[0],
            (at / n) as f32 - self.from[1],
        ];
        (y * self.direction[0] - x * self.direction[1]).abs()
    }
}

#[cfg(test)]
mod tests;
