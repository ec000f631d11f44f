//! The detections of a tile, from the pixels of all epochs under it.

use multiversion::multiversion;
use shearq_measure::parts::ExposureDefects;
use shearq_quantities::fourier::Complex64;
use shearq_quantities::linear::{apply, inverse};

use super::place::{BlockMap, near_value, shift};
use super::plan::{EpochCells, EpochDetector, EpochFunctionals, EpochPlan, Patch};
use crate::detector::{Constants, weighted_sums};
use crate::functionals::{Covariances, KERNELS};
use crate::pixel::DetectedPixel;
use crate::weight::COUNT;

// Of a bound, in standard deviations of v₀: four times what the cubic interpolation of its noise differs by at a FWHM of 3.5 px, by the fourth
// derivatives of a Gaussian field.
const SLACK: f64 = 0.15;
/// Buffers of a thread.
#[derive(Debug, Default)]
pub struct EpochScratch {
    image: Vec<Complex64>,
    spectrum: Vec<Complex64>,
    transform: Vec<Complex64>,
    defects: Vec<ExposureDefects>,
    places: Vec<usize>,
    /// v₀ of both halves of each epoch, and whether no pixel under the functionals is missing.
    light: Vec<[Vec<f32>; 2]>,
    covered: Vec<[Vec<bool>; 2]>,
    row: Vec<Sum>,
    /// Pixels that are shifted along x, and along both axes.
    shifted: [Vec<f32>; 2],
}

/// Epochs at a pixel as bits, their weights, and the weighted v₀.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    set: u64,
    weight: f64,
    light: f64,
}

/// A half of an epoch.
#[derive(Clone, Copy)]
pub(super) struct Half<'a> {
    pub(super) at: usize,
    pub(super) plan: &'a EpochPlan,
    pub(super) own: &'a EpochFunctionals,
    pub(super) map: BlockMap,
    pub(super) pixels: &'a [f32],
    pub(super) light: &'a [f32],
    pub(super) covered: &'a [bool],
}

impl EpochCells {
    /// Buffers for [`EpochCells::detect`].
    pub fn scratch(&self) -> EpochScratch {
        let defects = self.epochs.iter().map(|epoch| epoch.defects.clone());
        EpochScratch {
            defects: defects.collect(),
            light: vec![Default::default(); self.epochs.len()],
            covered: vec![Default::default(); self.epochs.len()],
            ..EpochScratch::default()
        }
    }

    /// Appends the pixels with a weight of a tile to `found`. `patches` are those of the tile with their pixels, NaN where they are missing.
    /// Returns the number of missing pixels of all epochs in the tile, and that of those that hold no light.
    pub fn detect(
        &self,
        detector: &EpochDetector,
        tile: [usize; 2],
        patches: &mut [(Patch, Vec<f32>)],
        scratch: &mut EpochScratch,
        found: &mut Vec<DetectedPixel>,
    ) -> [usize; 2] {
        let mut lost = [0; 2];
        for (patch, pixels) in &mut *patches {
            if let Some(own) = &detector.0[patch.epoch] {
                let [_, count] = self.block(tile, patch.half);
                let own = self.lose(own, patch, pixels, count, scratch);
                lost = [0, 1].map(|k| lost[k] + own[k]);
            }
        }
        for (epoch, own) in detector.0.iter().enumerate() {
            if let Some(own) = own {
                self.smooth(epoch, own, patches, scratch);
            }
        }
        let EpochScratch {
            light,
            covered,
            row,
            shifted,
            ..
        } = scratch;
        for half in 0..2 {
            let own = patches.iter().filter(|own| own.0.half == half);
            let halves = own.filter_map(|(patch, pixels)| {
                Some(Half {
                    at: patch.epoch,
                    plan: &self.epochs[patch.epoch],
                    own: detector.0[patch.epoch].as_ref()?,
                    map: patch.map,
                    pixels,
                    light: &light[patch.epoch][half],
                    covered: &covered[patch.epoch][half],
                })
            });
            let halves: Vec<Half<'_>> = halves.collect();
            self.detect_half(&halves, self.block(tile, half), row, shifted, found);
        }
        lost
    }

    // First column and row of a half of a tile, and their numbers.
    fn block(&self, [column, row]: [usize; 2], half: usize) -> [[usize; 2]; 2] {
        let inner = self.shared.columns_per_tile();
        let first = [column * inner, (2 * row + half) * inner];
        let count = [0, 1].map(|k| inner.min(self.sides[k].saturating_sub(first[k])));
        [first, count]
    }

    // Makes pixels missing that hold no light, and counts them, and those that were missing, on a block of so many columns and rows.
    fn lose(
        &self,
        own: &EpochFunctionals,
        patch: &Patch,
        pixels: &mut [f32],
        count: [usize; 2],
        scratch: &mut EpochScratch,
    ) -> [usize; 2] {
        let plan = &self.epochs[patch.epoch];
        let middle = 0.5 * (self.shared.columns_per_tile() as f64 - 1.0);
        let at_middle = BlockMap::at(&patch.map.row(middle), middle);
        let back = inverse(own.matrix);
        let is_inside = |at: usize| {
            let pixel = [at % patch.side, at / patch.side];
            let is_on =
                |k: usize| (0..plan.sides[k] as i64).contains(&(patch.origin[k] + pixel[k] as i64));
            let offset = apply(back, [0, 1].map(|k| pixel[k] as f64 - at_middle[k]));
            let is_in = |k: usize| {
                let at = middle + offset[k] + 0.5;
                at >= 0.0 && at < count[k] as f64
            };
            (0..2).all(|k| is_on(k) && is_in(k))
        };
        let missing = pixels.iter().enumerate().filter(|own| own.1.is_nan());
        let missing = missing.filter(|own| is_inside(own.0)).count();
        scratch.places.clear();
        scratch.defects[patch.epoch].remove(pixels, patch.side, &mut scratch.places);
        let unlit = scratch.places.iter().filter(|at| is_inside(**at)).count();
        [missing, unlit]
    }

    // v₀ of both halves of an epoch, and where it is known.
    fn smooth(
        &self,
        epoch: usize,
        own: &EpochFunctionals,
        patches: &[(Patch, Vec<f32>)],
        scratch: &mut EpochScratch,
    ) {
        let plan = &self.epochs[epoch];
        let side = plan.transform.side;
        let halves = [0, 1].map(|half| {
            let mut patches = patches.iter();
            patches.find(|(patch, _)| patch.epoch == epoch && patch.half == half)
        });
        if halves.iter().all(Option::is_none) {
            return;
        }
        let known = |half: usize, at: usize| {
            let value = halves[half].map_or(0.0, |own| own.1[at]);
            if value.is_nan() {
                0.0
            } else {
                f64::from(value)
            }
        };
        let EpochScratch {
            image,
            spectrum,
            transform,
            light,
            covered,
            ..
        } = scratch;
        image.clear();
        image.extend((0..side * side).map(|at| Complex64::new(known(0, at), known(1, at))));
        spectrum.resize(side * side, Complex64::default());
        transform.resize(plan.transform.scratch(), Complex64::default());
        plan.transform.forward(image, spectrum, transform);
        for (value, [re, im]) in spectrum.iter_mut().zip(&own.light_filter) {
            *value *= Complex64::new((*re).into(), (*im).into());
        }
        plan.transform.inverse(spectrum, image, transform);
        let [upper, lower] = &mut light[epoch];
        for (light, part) in [(upper, 0), (lower, 1)] {
            light.clear();
            light.extend(image.iter().map(|own| [own.re, own.im][part] as f32));
        }
        let reach = [plan.radius + plan.taps[0], plan.radius + 1 + plan.taps[1]];
        for (covered, half) in covered[epoch].iter_mut().zip(halves) {
            if let Some((_, pixels)) = half {
                mark_covered(pixels, side, reach, covered);
            }
        }
    }

    fn detect_half(
        &self,
        halves: &[Half<'_>],
        [first, [columns, rows]]: [[usize; 2]; 2],
        row: &mut Vec<Sum>,
        shifted: &mut [Vec<f32>; 2],
        found: &mut Vec<DetectedPixel>,
    ) {
        let shared = &self.shared.shared;
        let least = shared.settings.threshold - shared.settings.threshold_half_width - SLACK;
        let mut constants = None;
        for y in 0..rows {
            row.clear();
            row.resize(columns, Sum::default());
            for half in halves {
                half.add(&half.map.row(y as f64), row);
            }
            for (x, &Sum { set, weight, light }) in row.iter().enumerate() {
                // The noise of v₀ is one over the root of the weight.
                if set == 0 || light < least * weight.sqrt() {
                    continue;
                }
                let known = constants.take().filter(|(own, _)| *own == set);
                let (_, known) = constants.insert(known.unwrap_or_else(|| {
                    let parts = halves.iter().filter(|half| half.is_in(set));
                    let parts = parts
                        .map(|half| (half.own.weight / weight, &half.own.functionals.covariances));
                    let sum = Covariances::of_sum(parts);
                    (set, Constants::new(&sum, &shared.settings))
                }));
                let places = |half: &Half<'_>| BlockMap::at(&half.map.row(y as f64), x as f64);
                let light = light / weight;
                let mut neighbours = [0.0; 4];
                for half in halves.iter().filter(|half| half.is_in(set)) {
                    let at = places(half);
                    for (sum, offset) in neighbours.iter_mut().zip(shared.lengths.neighbours()) {
                        let offset = apply(half.own.matrix, shared.pixels.pixel(offset));
                        let at = [0, 1].map(|k| at[k] + offset[k]);
                        *sum += half.own.weight / weight * half.light(at);
                    }
                }
                let slack = SLACK * known.light_noise + self.light_error * light.max(0.0);
                if !known.steps.may_count(light, neighbours, slack) {
                    continue;
                }
                let mut values = [[0.0; COUNT]; 3];
                for half in halves.iter().filter(|half| half.is_in(set)) {
                    let sums = half.sums(places(half), shifted);
                    let share = half.own.weight / weight;
                    for (value, sum) in values.as_flattened_mut().iter_mut().zip(sums) {
                        *value += share * f64::from(sum);
                    }
                }
                let place = [first[0] + x, first[1] + y];
                found.extend(shared.pixel(place, &values, known));
            }
        }
    }
}

impl Half<'_> {
    fn is_in(&self, set: u64) -> bool {
        set >> self.at & 1 == 1
    }

    // Adds the light of a row of the first exposure.
    fn add(&self, line: &[[f64; 3]; 2], row: &mut [Sum]) {
        let images = (self.light, self.covered, self.plan.transform.side);
        add_light(images, line, (1 << self.at, self.own.weight), row);
    }

    fn light(&self, at: [f64; 2]) -> f64 {
        near_value(self.light, self.plan.transform.side, at)
    }

    // All functionals at a place, and their changes with shear.
    pub(super) fn sums(&self, at: [f64; 2], shifted: &mut [Vec<f32>; 2]) -> [f32; KERNELS] {
        let (columns, radius) = (self.plan.transform.side, self.plan.radius);
        let side = 2 * radius + 2;
        let [x, y] = at.map(|at| at as usize - radius);
        let fractions = at.map(|at| at - at.floor());
        let kernels = &self.own.functionals.kernels;
        if fractions == [0.0; 2] {
            return weighted_sums(&self.pixels[y * columns + x..], columns, kernels, side);
        }
        let before = self.plan.taps[0];
        let pixels = &self.pixels[(y - before) * columns + x - before..];
        shift(pixels, columns, side, fractions, shifted);
        weighted_sums(&shifted[1], side, kernels, side)
    }
}

/// Adds v₀ of an epoch, of which the bit and the weight are given, to the sums of a row.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_light(
    (light, covered, side): (&[f32], &[bool], usize),
    line: &[[f64; 3]; 2],
    (bit, weight): (u64, f64),
    row: &mut [Sum],
) {
    for (x, sum) in row.iter_mut().enumerate() {
        let place = BlockMap::at(line, x as f64);
        // A place beyond the patch is on its border, which is not covered.
        let [column, of_row] = place.map(|at| (at as usize).min(side - 1));
        if covered[of_row * side + column] {
            sum.set |= bit;
            sum.weight += weight;
            sum.light += weight * near_value(light, side, place);
        }
    }
}

/// Marks the pixels of a square image of `side` with no missing pixel (NaN) from `before` pixels before them to `after` pixels after
/// them along both axes.
fn mark_covered(pixels: &[f32], side: usize, [before, after]: [usize; 2], covered: &mut Vec<bool>) {
    covered.clear();
    covered.resize(side * side, false);
    // Of each column, rows up to this one in which all pixels along it are known.
    let mut runs = vec![0; side];
    for (y, row) in pixels.chunks_exact(side).enumerate() {
        let mut run = 0;
        for (x, value) in row.iter().enumerate() {
            run = if value.is_nan() { 0 } else { run + 1 };
            let Some(x) = x.checked_sub(after) else {
                continue;
            };
            runs[x] = if run > before + after { runs[x] + 1 } else { 0 };
            if runs[x] > before + after {
                covered[(y - after) * side + x] = true;
            }
        }
    }
}
