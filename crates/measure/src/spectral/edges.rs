//! Light that a shear takes across the edges of a stamp.

use multiversion::multiversion;
use shearq_quantities::PixelShape;
use shearq_quantities::linear::ROWS;

use crate::transform::{Modes, Plane, Spectrum, ToModes, TransformScratch, table};

/// The light that a shear takes across the edges of a stamp.
///
/// A shear γ moves light by v per γ, v = (x, −y) for γ₁ and (y, x) for γ₂, so that an image I changes by −v·∇I = −∇·(vI). What
/// the transform of the stamp gives is the change of TI, T being one on the stamp and zero beyond: −∇·(vTI), as if
/// the edges went with the light. They stay:
///
/// ```text
/// −T ∇·(vI) = −∇·(vTI) + I v·∇T.
/// ```
///
/// The last term is on the edges alone, half a pixel beyond the middles of the last pixels. It matters where a wide window
/// contains a large galaxy's light there.
#[derive(Debug, Clone)]
pub(super) struct Edges {
    pub(super) n: usize,
    pub(super) rows: usize,
    pub(super) width: usize,
    /// cos and sin of half a stamp for each frequency along an axis: the phase at the first edge. That at the last is its
    /// conjugate.
    pub(super) phase: [Vec<f32>; 2],
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub(super) struct EdgesScratch {
    /// The left, right, lower and upper edge for γ₁, and for γ₂.
    lines: Vec<f32>,
    /// Of each of them and each frequency along it, real and imaginary part.
    re: Vec<f32>,
    im: Vec<f32>,
    /// Of sheared pixels: the phase of each frequency along an axis at an edge, as cos and sin, and a spectrum.
    waves: [Vec<f32>; 2],
    spectrum: Spectrum,
}

impl Edges {
    pub(super) fn new(n: usize, plane: &Plane) -> Self {
        let phase = [f64::cos, f64::sin].map(|wave| {
            let half = |_, k| wave(plane.wave(k) * n as f64 / 2.0);
            table([1, plane.modes + 1], [1, plane.width], half)
        });
        Edges {
            n,
            rows: plane.rows,
            width: plane.width,
            phase,
        }
    }

    pub(super) fn scratch(&self, plane: &Plane) -> EdgesScratch {
        EdgesScratch {
            lines: vec![0.0; ROWS * self.n],
            re: vec![0.0; ROWS * self.width],
            im: vec![0.0; ROWS * self.width],
            waves: [(); 2].map(|()| vec![0.0; self.width]),
            spectrum: plane.spectrum(),
        }
    }

    // The same for pixels of another shape, about a centre in its coordinates. In pixels, a shear moves light by
    // v = T⁻¹ V T (x − c), V being the matrix of the shear.
    pub(super) fn take_skewed(
        &self,
        stamp: &[f32],
        (centre, pixels): ([f32; 2], PixelShape),
        ((to_modes, transform), plane): ((&ToModes, &mut TransformScratch), &Plane),
        scratch: &mut EdgesScratch,
        changes: [&mut Modes; 2],
    ) {
        let (n, width) = (self.n, self.width);
        let half = n as f64 / 2.0;
        let PixelShape { stretch, skew } = pixels;
        let [x0, y0] = pixels.pixel(centre.map(f64::from)).map(|at| at as f32);
        let shears = [
            [[1.0, 2.0 * skew / stretch], [0.0, -1.0]],
            [
                [-stretch * skew, 1.0 / (stretch * stretch) - skew * skew],
                [stretch * stretch, stretch * skew],
            ],
        ];
        let EdgesScratch {
            lines,
            re,
            im,
            waves,
            spectrum,
        } = scratch;
        edge_lines(stamp, n, shears, [x0, y0], lines);
        to_modes.transform_lines(lines, transform, [re, im]);
        edge_phases(plane, half * skew, waves);
        let edges = re.chunks_exact_mut(width).zip(im.chunks_exact_mut(width));
        for (line, (re, im)) in edges.enumerate() {
            let sign = match line % EDGES {
                2 => 1.0,
                3 => -1.0,
                // The left and right edges are transformed below, with all of their pixels.
                _ => continue,
            };
            let phases = waves[0].iter().zip(&waves[1]);
            for ((re, im), (cos, sin)) in re.iter_mut().zip(im).zip(phases) {
                let sin = sign * sin;
                (*re, *im) = (*re * cos - *im * sin, *re * sin + *im * cos);
            }
        }
        edge_phases(plane, half * stretch, waves);
        let mut changes = changes;
        for (which, change) in changes.iter_mut().enumerate() {
            let line = |edge: usize| &lines[(EDGES * which + edge) * n..][..n];
            let [cos, sin] = &*waves;
            to_modes.transform_sides([line(0), line(1)], [cos, sin], transform, spectrum);
            change.take_spectrum(spectrum);
        }
        edge_phases(plane, half / stretch, waves);
        let line = |k: usize| [&re[k * width..][..width], &im[k * width..][..width]];
        for (which, change) in changes.into_iter().enumerate() {
            let levels = [line(EDGES * which + 2), line(EDGES * which + 3)];
            self.add_rows(change, None, levels, waves);
        }
    }

    // Adds edges at both ends of the stamp to all rows of modes: `sides` along y, unless they are added already, and `levels`
    // along x. `phase` is the phase of each frequency at the first edge.
    fn add_rows(
        &self,
        Modes { re, im }: &mut Modes,
        sides: Option<[[&[f32]; 2]; 2]>,
        levels: [[&[f32]; 2]; 2],
        [cos, sin]: &[Vec<f32>; 2],
    ) {
        let rows = re.chunks_exact_mut(self.width);
        for (row, (re, im)) in rows.zip(im.chunks_exact_mut(self.width)).enumerate() {
            // Real lines have conjugate transforms at opposite frequencies, in the rows below.
            let (y, sign) = if row < self.rows {
                (row, 1.0)
            } else {
                (row - self.rows, -1.0)
            };
            let sides = sides.map(|sides| sides.map(|[re, im]| [re[y], sign * im[y]]));
            let down = [cos[y], sign * sin[y]];
            add_edges(
                [re, im],
                sides.unwrap_or_default(),
                [cos, sin],
                levels,
                down,
            );
        }
    }

    // Writes what edges of `stamp` add to its changes with γ₁ and γ₂ about `centre`, (x, y) in pixels from the middle.
    pub(super) fn take(
        &self,
        stamp: &[f32],
        centre: [f32; 2],
        (to_modes, transform): (&ToModes, &mut TransformScratch),
        scratch: &mut EdgesScratch,
        changes: [&mut Modes; 2],
    ) {
        let width = self.width;
        let EdgesScratch { lines, re, im, .. } = scratch;
        edge_lines(stamp, self.n, SHEARS, centre, lines);
        to_modes.transform_lines(lines, transform, [re, im]);
        let line = |k: usize| [&re[k * width..][..width], &im[k * width..][..width]];
        for (which, change) in changes.into_iter().enumerate() {
            let [left, right, lower, upper] = [0, 1, 2, 3].map(|edge| line(EDGES * which + edge));
            change.re.fill(0.0);
            change.im.fill(0.0);
            self.add_rows(change, Some([left, right]), [lower, upper], &self.phase);
        }
    }
}

// Matrices of γ₁ and γ₂: a shear moves light at x by γ V x.
pub(super) const SHEARS: [[[f64; 2]; 2]; 2] = [[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]];
// Left, right, lower and upper edge.
const EDGES: usize = 4;

// Writes I v·∇T of a stamp on its edges for two shears about (x0, y0), v = S (x − x0, y − y0) with a matrix S in pixels: for each
// shear the left, right, lower and upper edge.
pub(super) fn edge_lines(
    stamp: &[f32],
    n: usize,
    shears: [[[f64; 2]; 2]; 2],
    [x0, y0]: [f32; 2],
    lines: &mut [f32],
) {
    let (middle, half) = ((n as f32 - 1.0) / 2.0, n as f32 / 2.0);
    for (which, shear) in shears.iter().enumerate() {
        let [[xx, xy], [yx, yy]] = shear.map(|row| row.map(|value| value as f32));
        for at in 0..n {
            let edge = |first: usize, step: usize| {
                let beyond = |a: usize, b: usize| 1.5 * stamp[a] - 0.5 * stamp[b];
                let last = first + (n - 1) * step;
                [beyond(first, first + step), beyond(last, last - step)]
            };
            let ([left, right], [lower, upper]) = (edge(at * n, 1), edge(at, n));
            let place = at as f32 - middle;
            // Light moves in at the first edge, and out at the last.
            let values = [
                left * (xx * (-half - x0) + xy * (place - y0)),
                -right * (xx * (half - x0) + xy * (place - y0)),
                lower * (yx * (place - x0) + yy * (-half - y0)),
                -upper * (yx * (place - x0) + yy * (half - y0)),
            ];
            for (line, value) in values.into_iter().enumerate() {
                lines[(EDGES * which + line) * n + at] = value;
            }
        }
    }
}

// Writes cos and sin of the phase of each mode along an axis at an edge, `distance` px from the middle.
fn edge_phases(plane: &Plane, distance: f64, [cos, sin]: &mut [Vec<f32>; 2]) {
    for k in 0..=plane.modes {
        let (s, c) = (plane.wave(k) * distance).sin_cos();
        (cos[k], sin[k]) = (c as f32, s as f32);
    }
}

// Adds the edges to a row of modes: the first and the last edge across, of phases `across`, and the first and the last edge
// along it, of phase `down`. The last edge has the conjugate phase of the first one.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_edges(
    [re, im]: [&mut [f32]; 2],
    [first, last]: [[f32; 2]; 2],
    across: [&[f32]; 2],
    levels: [[&[f32]; 2]; 2],
    down: [f32; 2],
) {
    let [[first_re, first_im], [last_re, last_im]] = levels;
    // a·exp(iφ) + b·exp(−iφ) = (a + b) cos φ + i(a − b) sin φ.
    let sum = [first[0] + last[0], first[1] + last[1]];
    let difference = [first[0] - last[0], first[1] - last[1]];
    for x in 0..re.len() {
        let (cos, sin) = (across[0][x], across[1][x]);
        let levels_sum = [first_re[x] + last_re[x], first_im[x] + last_im[x]];
        let levels_difference = [first_re[x] - last_re[x], first_im[x] - last_im[x]];
        re[x] += sum[0] * cos - difference[1] * sin + levels_sum[0] * down[0]
            - levels_difference[1] * down[1];
        im[x] += sum[1] * cos
            + difference[0] * sin
            + levels_sum[1] * down[0]
            + levels_difference[0] * down[1];
    }
}
