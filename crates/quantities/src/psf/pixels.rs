//! The light of a sheared round profile in pixels.
//!
//! Near the centre, each pixel is integrated by a Gauss–Legendre rule whose length follows from the profile's sharpness
//! there. Pixels with the same rule are integrated side by side. Farther out the profile is so smooth that its values in the
//! middles of a pixel and its neighbours give the light in the pixel ([`SMOOTH_WEIGHTS`]).

use std::sync::LazyLock;

use multiversion::multiversion;
use ndarray::{Array2, ArrayViewMut2};

use super::RoundProfile;
use crate::radial::{QuadraticForm, gauss_legendre};

// Error of a pixel integral, relative to the brightest pixel. Its estimate is coarse, so that it is below the 1e-6 of
// `FunctionalPsf::draw_into`.
const PIXEL_TOLERANCE: f64 = 1e-7;

// Nodes of a Gauss–Legendre rule; sharper profiles divide the pixel instead.
const MAX_NODES: usize = 12;
// Parts of a pixel along an axis, by halving.
const MAX_DIVISIONS: usize = 64;
// The numbers of nodes times those of divisions.
const MAX_RULES: usize = MAX_NODES * (MAX_DIVISIONS.ilog2() as usize + 1);

// Weights of the values in the middles of a pixel and of its first to third neighbours along an axis: the integral over the
// pixel, Σ f⁽²ᵏ⁾/(4ᵏ (2k + 1)!), up to the sixth derivative by central differences.
const SMOOTH_WEIGHTS: [f64; NEIGHBOURS + 1] = [
    862_564.0 / 967_680.0,
    57_249.0 / 967_680.0,
    -5_058.0 / 967_680.0,
    367.0 / 967_680.0,
];
const NEIGHBOURS: usize = 3;
// Modulus of the factor of the eighth derivative in the integral, which the weights lack: (387/160 − 1/2304)/8!.
const EIGHTH_FACTOR: f64 = 6.0e-5;

// In pixels, in the circular coordinates in which pixels are widest: values in the middles would miss narrower cores.
const MIN_SMOOTH_CORE: f64 = 1.5;

// Pixels whose rules are chosen side by side: two vectors of AVX-512.
const LANES: usize = 16;
// Pixels that are integrated side by side.
const BATCH: usize = 48;

// Of the radius between two rules, in pixels; up to it the longer rule is used.
const BOUND_ERROR: f64 = 1.0 / 32.0;

static NODES: LazyLock<Vec<Vec<(f64, f64)>>> =
    LazyLock::new(|| (0..=MAX_NODES).map(gauss_legendre).collect());

/// A profile on pixels.
pub(super) struct Pixels<P> {
    pub profile: P,
    pub form: QuadraticForm,
    /// Modulus of the shear that made the profile elliptical.
    pub modulus: f64,
    /// Distance in pixels within which the profile is not smooth.
    pub core: f64,
}

/// Gauss–Legendre nodes on each axis of the parts of a pixel, and parts on each axis.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Rule {
    divisions: usize,
    nodes: usize,
}

/// Rules from the centre outwards, and the squared circular radius up to which each is used.
struct Rules {
    count: usize,
    bounds: [f64; MAX_RULES],
    rules: [Rule; MAX_RULES],
    /// The circular radius beyond which values in the middles of pixels suffice.
    smooth_from: f64,
}

/// Pixels that wait for others with the same rule.
#[derive(Clone, Copy)]
struct Waiting {
    count: usize,
    /// Places in the stamp, and distances from the centre.
    at: [u32; BATCH],
    dx: [f64; BATCH],
    dy: [f64; BATCH],
}

impl Default for Waiting {
    fn default() -> Self {
        Waiting {
            count: 0,
            at: [0; BATCH],
            dx: [0.0; BATCH],
            dy: [0.0; BATCH],
        }
    }
}

impl Waiting {
    /// Adds pixels side by side, from the one at `at` in the stamp on.
    fn push(&mut self, at: usize, dx: &[f64], dy: &[f64]) {
        let from = self.count;
        self.count += dx.len();
        self.dx[from..self.count].copy_from_slice(dx);
        self.dy[from..self.count].copy_from_slice(dy);
        for (place, at) in self.at[from..self.count].iter_mut().zip(at as u32..) {
            *place = at;
        }
    }
}

impl<P: RoundProfile> Pixels<P> {
    /// Fills `out` (rows are y) with the light in each pixel, the profile's centre being at `centre` (x, y).
    pub(super) fn integrate(&self, centre: (f64, f64), mut out: ArrayViewMut2<f64>) {
        let (rows, columns) = out.dim();
        match out.as_slice_mut() {
            Some(pixels) => self.integrate_rows(centre, (rows, columns), pixels),
            None => {
                let mut pixels = Array2::zeros((rows, columns));
                let lines = pixels.as_slice_mut().expect("an array is made in rows");
                self.integrate_rows(centre, (rows, columns), lines);
                out.assign(&pixels);
            }
        }
    }

    /// The same for pixels one row after the other.
    fn integrate_rows(&self, centre: (f64, f64), size: (usize, usize), pixels: &mut [f64]) {
        if pixels.is_empty() {
            return;
        }
        // About the centre of the stamp the profile is the same on opposite sides: half of the pixels are copied.
        let middle = |at: f64, side: usize| 2.0 * at == side as f64 - 1.0;
        let halved = middle(centre.0, size.1) && middle(centre.1, size.0);
        let count = if halved { size.0.div_ceil(2) } else { size.0 };
        let rules = self.rules(centre, size);
        if rules.smooth_from.is_finite() {
            self.fill_smooth(centre, (count, size.1), pixels);
        }
        // The widest that the ellipse of a circular radius is.
        let reach = rules.smooth_from * 2.0 * half_pixel(self.modulus);
        let mut waiting = vec![Waiting::default(); rules.count];
        for row in 0..count {
            let dy = [row as f64 - centre.1; LANES];
            if dy[0].abs() > reach {
                continue;
            }
            for first in (0..size.1).step_by(LANES) {
                let dx: [f64; LANES] = std::array::from_fn(|lane| (first + lane) as f64 - centre.0);
                if dx[0] > reach || dx[LANES - 1] < -reach {
                    continue;
                }
                let chosen = choose_lanes(self.form, rules.bounds(), &dx, &dy);
                let inside = LANES.min(size.1 - first);
                let mut lane = 0;
                while lane < inside {
                    // Neighbours with the same rule.
                    let rule = chosen[lane];
                    let same = chosen[lane..].iter().take_while(|other| **other == rule);
                    let lanes = lane..inside.min(lane + same.count());
                    lane = lanes.end;
                    if rule as usize == rules.count {
                        continue;
                    }
                    let waiting = &mut waiting[rule as usize];
                    waiting.push(
                        row * size.1 + first + lanes.start,
                        &dx[lanes.clone()],
                        &dy[lanes],
                    );
                    if waiting.count > BATCH - LANES {
                        self.integrate_waiting(waiting, rules.rules[rule as usize], pixels);
                    }
                }
            }
        }
        for (waiting, rule) in waiting.iter_mut().zip(rules.rules) {
            self.integrate_waiting(waiting, rule, pixels);
        }
        if halved {
            let (first, rest) = pixels.split_at_mut(pixels.len() / 2);
            for (pixel, opposite) in rest.iter_mut().rev().zip(&*first) {
                *pixel = *opposite;
            }
        }
    }

    /// Fills rows of pixels as if the profile were smooth in all of them.
    fn fill_smooth(&self, centre: (f64, f64), (rows, columns): (usize, usize), pixels: &mut [f64]) {
        let width = columns + 2 * NEIGHBOURS;
        let mut values = vec![0.0; (rows + 2 * NEIGHBOURS) * width];
        let mut y = -(NEIGHBOURS as f64) - centre.1;
        for line in values.chunks_exact_mut(width) {
            values_along(self, -(NEIGHBOURS as f64) - centre.0, y, line);
            y += 1.0;
        }
        let mut line = vec![0.0; width];
        for (row, out) in pixels.chunks_exact_mut(columns).enumerate().take(rows) {
            smooth(&values[row * width..], &mut line, out);
        }
    }

    fn integrate_waiting(&self, waiting: &mut Waiting, rule: Rule, pixels: &mut [f64]) {
        // Whole vectors: the places beyond hold finite numbers of earlier pixels, which are not used.
        let count = waiting.count.next_multiple_of(8);
        let mut light = [0.0; BATCH];
        integrals(
            self,
            rule,
            (&waiting.dx[..count], &waiting.dy[..count]),
            &mut light[..count],
        );
        for (at, light) in waiting.at.iter().zip(light).take(waiting.count) {
            pixels[*at as usize] = light;
        }
        waiting.count = 0;
    }

    fn rules(&self, centre: (f64, f64), (rows, columns): (usize, usize)) -> Rules {
        let plan = RulePlan {
            half_pixel: half_pixel(self.modulus),
            core: self.core,
            // The brightest pixel of a PSF narrower than a pixel holds a flux near 1.
            peak: self.profile.at(0.0).min(1.0),
        };
        let corners = [0.0, columns as f64].map(|x| {
            let squared = [0.0, rows as f64].map(|y| self.form.at(x - centre.0, y - centre.1));
            squared[0].max(squared[1])
        });
        let farthest = corners[0].max(corners[1]).sqrt();
        let smooth_from = plan.smooth_from(&self.profile, farthest);
        let outermost = farthest.min(smooth_from);
        let (first, last) = (
            plan.choose(&self.profile, 0.0),
            plan.choose(&self.profile, outermost),
        );
        let mut rules = Rules {
            count: 0,
            bounds: [0.0; MAX_RULES],
            rules: [last; MAX_RULES],
            smooth_from,
        };
        self.divide(&plan, (0.0, first), (outermost, last), &mut rules);
        rules.add(smooth_from * smooth_from, last);
        rules
    }

    /// Adds the rules of radii between two, by bisection: rules become shorter outwards.
    fn divide(&self, plan: &RulePlan, inner: (f64, Rule), outer: (f64, Rule), rules: &mut Rules) {
        if inner.1 == outer.1 {
            return;
        }
        if outer.0 - inner.0 < BOUND_ERROR {
            rules.add(outer.0 * outer.0, inner.1);
            return;
        }
        let radius = 0.5 * (inner.0 + outer.0);
        let middle = (radius, plan.choose(&self.profile, radius));
        self.divide(plan, inner, middle, rules);
        self.divide(plan, middle, outer, rules);
    }
}

impl Rules {
    fn add(&mut self, bound: f64, rule: Rule) {
        self.bounds[self.count] = bound;
        self.rules[self.count] = rule;
        self.count += 1;
    }

    fn bounds(&self) -> &[f64] {
        &self.bounds[..self.count]
    }
}

/// Half a pixel, in the circular coordinates in which it is widest.
fn half_pixel(modulus: f64) -> f64 {
    0.5 * ((1.0 + modulus) / (1.0 - modulus)).sqrt()
}

/// The profile at (x, y) from the centre and at the next pixels along x.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn values_along<P: RoundProfile>(pixels: &Pixels<P>, x: f64, y: f64, line: &mut [f64]) {
    let QuadraticForm { xx, xy, yy } = pixels.form;
    let (constant, linear) = (yy * y * y, 2.0 * xy * y);
    for (at, value) in line.iter_mut().enumerate() {
        let x = x + at as i32 as f64;
        *value = constant + x * (linear + xx * x);
    }
    pixels.profile.at_each(line);
}

/// The light in a row of pixels from seven rows of `values` in the middles of pixels, about this row. `line` is a buffer of
/// the length of a row of values.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn smooth(values: &[f64], line: &mut [f64], out: &mut [f64]) {
    let width = line.len();
    let [a, b, c, d, e, f, g] = std::array::from_fn(|row| &values[row * width..][..width]);
    let [w0, w1, w2, w3] = SMOOTH_WEIGHTS;
    for (x, light) in line.iter_mut().enumerate() {
        *light = w0 * d[x] + w1 * (c[x] + e[x]) + w2 * (b[x] + f[x]) + w3 * (a[x] + g[x]);
    }
    let count = out.len();
    let [a, b, c, d, e, f, g] = std::array::from_fn(|first| &line[first..][..count]);
    for (x, light) in out.iter_mut().enumerate() {
        *light = w0 * d[x] + w1 * (c[x] + e[x]) + w2 * (b[x] + f[x]) + w3 * (a[x] + g[x]);
    }
}

/// The place of the rule of pixels at (`dx`, `dy`) from the centre: the number of bounds that they exceed.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn choose_lanes(
    form: QuadraticForm,
    bounds: &[f64],
    dx: &[f64; LANES],
    dy: &[f64; LANES],
) -> [u64; LANES] {
    let mut squared = [0.0; LANES];
    for lane in 0..LANES {
        squared[lane] = form.at(dx[lane], dy[lane]);
    }
    let mut chosen = [0; LANES];
    for bound in bounds {
        for lane in 0..LANES {
            chosen[lane] += u64::from(squared[lane] > *bound);
        }
    }
    chosen
}

/// The light in pixels at (`dx`, `dy`) from the centre, at most [`BATCH`] of them.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn integrals<P: RoundProfile>(
    pixels: &Pixels<P>,
    rule: Rule,
    (dx, dy): (&[f64], &[f64]),
    light: &mut [f64],
) {
    let QuadraticForm { xx, xy, yy } = pixels.form;
    let half = 0.5 / rule.divisions as f64;
    let nodes = &NODES[rule.nodes];
    let count = light.len();
    let (mut constant, mut linear) = ([0.0; BATCH], [0.0; BATCH]);
    let (mut line, mut value) = ([0.0; BATCH], [0.0; BATCH]);
    let (constant, linear) = (&mut constant[..count], &mut linear[..count]);
    let (line, value) = (&mut line[..count], &mut value[..count]);
    light.fill(0.0);
    for part_y in 0..rule.divisions {
        let part_y = half * (2 * part_y + 1) as f64 - 0.5;
        for part_x in 0..rule.divisions {
            let part_x = half * (2 * part_x + 1) as f64 - 0.5;
            for &(node_y, weight_y) in nodes {
                let below = part_y + half * node_y;
                for ((constant, linear), dy) in constant.iter_mut().zip(&mut *linear).zip(dy) {
                    let y = dy + below;
                    *constant = yy * y * y;
                    *linear = 2.0 * xy * y;
                }
                line.fill(0.0);
                for &(node_x, weight_x) in nodes {
                    let beside = part_x + half * node_x;
                    let forms = constant.iter().zip(&*linear);
                    for ((value, dx), (constant, linear)) in value.iter_mut().zip(dx).zip(forms) {
                        let x = dx + beside;
                        *value = constant + x * (linear + xx * x);
                    }
                    pixels.profile.at_each(value);
                    for (line, value) in line.iter_mut().zip(&*value) {
                        *line += weight_x * value;
                    }
                }
                for (light, line) in light.iter_mut().zip(&*line) {
                    *light += weight_y * line;
                }
            }
        }
    }
    for light in light {
        *light *= half * half;
    }
}

/// Chooses the quadrature inside a pixel.
struct RulePlan {
    half_pixel: f64,
    core: f64,
    peak: f64,
}

impl RulePlan {
    /// The circular radius beyond which [`SMOOTH_WEIGHTS`] err by less than the tolerance: infinite beyond `farthest`.
    ///
    /// This is an estimate: a derivative of order 8 at distance d from a singularity is about 8! (2/d)⁸ times the value at
    /// half the radius. Both axes contribute.
    fn smooth_from(&self, profile: &impl RoundProfile, farthest: f64) -> f64 {
        let error = |radius: f64| {
            let distance = (radius * radius + self.core * self.core).sqrt();
            let steps = 2.0 * (2.0 * self.half_pixel) / distance;
            2.0 * EIGHTH_FACTOR * 40_320.0 * steps.powi(8) * profile.at(0.25 * radius * radius)
        };
        let most = self.peak * PIXEL_TOLERANCE;
        if self.core < MIN_SMOOTH_CORE * 2.0 * self.half_pixel || error(farthest) > most {
            return f64::INFINITY;
        }
        let (mut inside, mut outside) = (0.0, farthest);
        while outside - inside > BOUND_ERROR {
            let radius = 0.5 * (inside + outside);
            if error(radius) > most {
                inside = radius;
            } else {
                outside = radius;
            }
        }
        outside
    }

    /// The rule of a pixel at circular radius `radius`.
    ///
    /// An n-point rule on an interval of half-width h errs by about B^(−2n), where for a
    /// singularity at distance d the Bernstein ellipse has B = d/h + sqrt(1 + (d/h)²).
    fn choose(&self, profile: &impl RoundProfile, radius: f64) -> Rule {
        let nearest = (radius - self.half_pixel).max(0.0);
        let excess = 10.0 * profile.at(nearest * nearest) / (self.peak * PIXEL_TOLERANCE);
        let mut divisions = 1;
        loop {
            let half = self.half_pixel / divisions as f64;
            let ratio = (nearest * nearest + self.core * self.core).sqrt() / half;
            let bernstein = ratio + (1.0 + ratio * ratio).sqrt();
            let shrink = bernstein * bernstein;
            let mut nodes = 1;
            let mut error = excess / shrink;
            while error > 1.0 && nodes <= MAX_NODES {
                error /= shrink;
                nodes += 1;
            }
            if nodes <= MAX_NODES {
                return Rule { divisions, nodes };
            }
            if divisions >= MAX_DIVISIONS {
                return Rule {
                    divisions,
                    nodes: MAX_NODES,
                };
            }
            divisions *= 2;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Brightness, MoffatBrightness};
    use super::*;
    use crate::{FunctionalPsf, PsfProfile, Shear};
    use ndarray::{Array2, s};

    fn moffat(psf: &FunctionalPsf) -> MoffatBrightness {
        match psf.brightness() {
            Brightness::Moffat(moffat) => moffat,
            Brightness::Kolmogorov(_) => unreachable!("the PSFs here are Moffats"),
        }
    }

    /// The integral of one pixel, by the rule that is chosen for it alone.
    fn plain<P: RoundProfile>(
        pixels: &Pixels<P>,
        centre: (f64, f64),
        (row, column): (usize, usize),
    ) -> f64 {
        let (dx, dy) = (column as f64 - centre.0, row as f64 - centre.1);
        let rules = pixels.rules(centre, (row + 1, column + 1));
        let inside = |bound: &f64| pixels.form.at(dx, dy) <= *bound;
        // Where the profile is smooth, the last rule is longer than required.
        let at = rules.bounds().iter().position(inside);
        let rule = rules.rules[at.unwrap_or(rules.count - 1)];
        let half = 0.5 / rule.divisions as f64;
        let mut sum = 0.0;
        for part_y in 0..rule.divisions {
            for part_x in 0..rule.divisions {
                for (node_y, weight_y) in gauss_legendre(rule.nodes) {
                    for (node_x, weight_x) in gauss_legendre(rule.nodes) {
                        let x = dx - 0.5 + half * ((2 * part_x + 1) as f64 + node_x);
                        let y = dy - 0.5 + half * ((2 * part_y + 1) as f64 + node_y);
                        sum += weight_x * weight_y * pixels.profile.at(pixels.form.at(x, y));
                    }
                }
            }
        }
        sum * half * half
    }

    /// Sides and centre of a stamp.
    type Stamp = ((usize, usize), (f64, f64));

    /// Compares all pixels of stamps; returns how many are in the smooth part of the profile.
    fn compare<P: RoundProfile>(pixels: &Pixels<P>, stamps: &[Stamp]) -> usize {
        let mut smooth = 0;
        for &(size, centre) in stamps {
            let mut out = Array2::from_elem(size, f64::NAN);
            pixels.integrate(centre, out.view_mut());
            let brightest = out.iter().copied().fold(0.0, f64::max);
            let from = pixels.rules(centre, size).smooth_from;
            for (place, light) in out.indexed_iter() {
                let expected = plain(pixels, centre, place);
                // Either is within the tolerance of the exact light.
                let tolerance = 2.0 * PIXEL_TOLERANCE * brightest.min(1.0);
                assert!(
                    (light - expected).abs() < tolerance,
                    "{size:?} {place:?}: {light} {expected}"
                );
                let (dx, dy) = (place.1 as f64 - centre.0, place.0 as f64 - centre.1);
                smooth += usize::from(pixels.form.at(dx, dy).sqrt() > from);
            }
        }
        smooth
    }

    #[test]
    fn stamps_agree_with_one_pixel_at_a_time() {
        // Sides that lanes divide and that they do not, and centres on, between and beside pixels.
        let sizes = [
            ((48, 48), (23.5, 23.5)),
            ((40, 31), (15.0, 19.5)),
            ((33, 70), (60.5, 4.0)),
            ((16, 24), (11.5, 7.5)),
            ((15, 9), (4.0, 7.0)),
            ((11, 6), (2.5, 5.0)),
            ((11, 13), (6.3, 4.9)),
            ((3, 5), (-2.0, 1.0)),
        ];
        let wide = [((48, 40), (18.6, 21.1))];
        let mut smooth = 0;
        for (fwhm, beta, shape, sizes) in [
            (3.4, 3.0, Shear::new(0.05, -0.02), &sizes[..]),
            (0.4, 2.5, Shear::new(-0.3, 0.4), &sizes[..]),
            (1.2, 4.0, Shear::ZERO, &sizes[..]),
            (2.85, 1.5, Shear::new(-0.3, 0.4), &wide[..]),
            (6.0, 12.5, Shear::new(0.05, -0.02), &wide[..]),
            (11.0, 3.0, Shear::ZERO, &wide[..]),
        ] {
            let psf = FunctionalPsf::new(PsfProfile::Moffat { beta }, fwhm, shape).unwrap();
            smooth += compare(&psf.pixels(moffat(&psf)), sizes);
        }
        assert!(smooth > 0);
        for fwhm in [3.4, 6.0] {
            let shape = Shear::new(0.05, -0.02);
            let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, fwhm, shape).unwrap();
            let Brightness::Kolmogorov(profile) = psf.brightness() else {
                unreachable!("a Kolmogorov profile");
            };
            compare(&psf.pixels(profile), &wide);
        }
    }

    #[test]
    fn pixels_may_be_anywhere_in_memory() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let psf = FunctionalPsf::new(profile, 2.5, Shear::new(0.1, 0.2)).unwrap();
        let mut one = Array2::zeros((9, 11));
        psf.draw_into(4.3, 5.1, one.view_mut());
        let mut apart = Array2::zeros((9, 22));
        psf.draw_into(4.3, 5.1, apart.slice_mut(s![.., ..;2]));
        assert_eq!(apart.slice(s![.., ..;2]), one);
        assert!(apart.slice(s![.., 1..;2]).iter().all(|light| *light == 0.0));
    }

    #[test]
    fn no_rule_is_shorter_than_its_pixel_requires() {
        for fwhm in [0.3, 1.0, 3.4] {
            let psf =
                FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, fwhm, Shear::ZERO).unwrap();
            let pixels = psf.pixels(moffat(&psf));
            let rules = pixels.rules((23.5, 23.5), (48, 48));
            assert!(rules.bounds().is_sorted());
            let plan = RulePlan {
                half_pixel: 0.5,
                core: pixels.core,
                peak: pixels.profile.at(0.0).min(1.0),
            };
            for step in 0..3000 {
                let radius = 0.01 * f64::from(step);
                let asked = plan.choose(&pixels.profile, radius);
                let inside = |bound: &f64| radius * radius <= *bound;
                let at = rules.bounds().iter().position(inside);
                let rule = &rules.rules[at.unwrap_or(rules.count - 1)];
                let length = |rule: &Rule| (rule.divisions, rule.nodes);
                assert!(
                    length(rule) >= length(&asked),
                    "{fwhm} {radius}: {rule:?} {asked:?}"
                );
            }
        }
    }
}
