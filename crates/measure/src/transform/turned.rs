//! Transforms of pixels that are turned against the axes of the plane.
//!
//! A triangular map of the lattice leaves the sums along the axes nearly separable; a rotation mixes the axes, so that each mode has
//! its own wave numbers p and q along both axes of the pixels, k·M(x, y) = p x + q y. Sums over rows are then made anew for
//! each mode, for LANES of them at a time: ten times the time of the dense products.

use multiversion::multiversion;

use super::{Folding, LANES, Modes, Plane, fold};

/// Waves of LANES modes at the places of an axis from the middle on: cos, x sin, sin and x cos.
type Waves = [[f32; LANES]; 4];

/// From turned pixels to modes, with its buffers for one thread.
#[derive(Debug, Clone)]
pub(crate) struct ToTurnedModes {
    folding: Folding,
    folded: Vec<f32>,
    along_x: Vec<Waves>,
    along_y: Vec<Waves>,
    /// Edges of a stamp, folded: sums and differences of opposite places.
    lines: Vec<[f32; 2]>,
}

impl ToTurnedModes {
    /// For images of n×n pixels.
    pub(crate) fn new(n: usize) -> Self {
        let folding = Folding::new(n);
        let waves = || vec![[[0.0; LANES]; 4]; folding.half];
        ToTurnedModes {
            folding,
            folded: vec![0.0; folding.len()],
            along_x: waves(),
            along_y: waves(),
            lines: vec![[0.0; 2]; EDGE_LINES * folding.half],
        }
    }

    /// The transforms of a row-major image, and of it times both coordinates M(x, y) of its pixels.
    pub(crate) fn transform_moments(
        &mut self,
        image: &[f32],
        matrix: [[f64; 2]; 2],
        plane: &Plane,
        out: &mut [Modes; 3],
    ) {
        let [[a, b], [c, d]] = matrix.map(|row| row.map(|value| value as f32));
        fold(&self.folding, image, &mut self.folded);
        let [plain, first, second] = out;
        for_each_block(plane, matrix, |at, [p, q]| {
            take_waves(&self.folding, &p, &mut self.along_x);
            take_waves(&self.folding, &q, &mut self.along_y);
            let mut sums = [[0.0; LANES]; 6];
            sum_pixels(
                &self.folding,
                &self.folded,
                [&self.along_x, &self.along_y],
                &mut sums,
            );
            let [re, im, x_re, x_im, y_re, y_im] = &sums;
            plain.re[at..][..LANES].copy_from_slice(re);
            plain.im[at..][..LANES].copy_from_slice(im);
            for l in 0..LANES {
                first.re[at + l] = a * x_re[l] + b * y_re[l];
                first.im[at + l] = a * x_im[l] + b * y_im[l];
                second.re[at + l] = c * x_re[l] + d * y_re[l];
                second.im[at + l] = c * x_im[l] + d * y_im[l];
            }
        });
    }

    /// Writes the transforms of two sets of edges: left, right, lower and upper values along each, half a pixel beyond the
    /// middles of the last pixels.
    pub(crate) fn transform_edges(
        &mut self,
        edges: &[f32],
        matrix: [[f64; 2]; 2],
        plane: &Plane,
        mut out: [&mut Modes; 2],
    ) {
        let Folding { n, half, .. } = self.folding;
        let lines = edges.chunks_exact(n).take(EDGE_LINES);
        for (line, folded) in lines.zip(self.lines.chunks_exact_mut(half)) {
            for (place, folded) in folded.iter_mut().enumerate() {
                let (above, below) = (line[n / 2 + place], line[half - 1 - place]);
                *folded = [above + below, above - below];
            }
        }
        let beyond = n as f64 / 2.0;
        for_each_block(plane, matrix, |at, [p, q]| {
            take_waves(&self.folding, &p, &mut self.along_x);
            take_waves(&self.folding, &q, &mut self.along_y);
            // Phases of the first edges; the last ones have the conjugates.
            let phases = [&p, &q].map(|wave| wave.map(|k| (k * beyond).sin_cos()));
            for (which, out) in out.iter_mut().enumerate() {
                let mut sums = [[0.0f32; LANES]; 2];
                for line in 0..EDGE_LINES / 2 {
                    let (waves, phase) = match line < 2 {
                        true => (&self.along_y, &phases[0]),
                        false => (&self.along_x, &phases[1]),
                    };
                    let sign = if line % 2 == 0 { 1.0 } else { -1.0 };
                    let first = (which * EDGE_LINES / 2 + line) * half;
                    let mut along = [[0.0f32; LANES]; 2];
                    for ([even, odd], [cos, _, sin, _]) in self.lines[first..].iter().zip(waves) {
                        for l in 0..LANES {
                            along[0][l] += even * cos[l];
                            along[1][l] -= odd * sin[l];
                        }
                    }
                    for l in 0..LANES {
                        let (sin, cos) = (sign * phase[l].0 as f32, phase[l].1 as f32);
                        sums[0][l] += along[0][l] * cos - along[1][l] * sin;
                        sums[1][l] += along[0][l] * sin + along[1][l] * cos;
                    }
                }
                out.re[at..][..LANES].copy_from_slice(&sums[0]);
                out.im[at..][..LANES].copy_from_slice(&sums[1]);
            }
        });
    }
}

// Left, right, lower and upper edge for each of two shears.
const EDGE_LINES: usize = 8;

/// Calls with the first place of LANES modes, and their wave numbers along the axes of the pixels. Places without modes get some
/// wave numbers, too; their amplitudes are zero in all that follows.
fn for_each_block(
    plane: &Plane,
    [[a, b], [c, d]]: [[f64; 2]; 2],
    mut with: impl FnMut(usize, [[f64; LANES]; 2]),
) {
    for at in (0..2 * plane.quarter()).step_by(LANES) {
        let (x, y, below) = plane.indices(at);
        if y > plane.modes || x > plane.modes {
            continue;
        }
        let ky = if below { -1.0 } else { 1.0 } * plane.wave(y);
        let kx: [f64; LANES] = std::array::from_fn(|l| plane.wave(x + l));
        with(
            at,
            [kx.map(|kx| a * kx + c * ky), kx.map(|kx| b * kx + d * ky)],
        );
    }
}

// By steps in double precision from the middle on. The middle pixel of an odd number is folded upon itself.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn take_waves(folding: &Folding, wave: &[f64; LANES], out: &mut [Waves]) {
    let (mut cos, mut sin) = ([0.0f64; LANES], [0.0f64; LANES]);
    let (mut step_cos, mut step_sin) = (cos, sin);
    let first = folding.distance(0);
    for l in 0..LANES {
        (sin[l], cos[l]) = (wave[l] * first).sin_cos();
        (step_sin[l], step_cos[l]) = wave[l].sin_cos();
    }
    for (place, [out_cos, out_x_sin, out_sin, out_x_cos]) in out.iter_mut().enumerate() {
        let (x, share) = (folding.distance(place), folding.share(place));
        for l in 0..LANES {
            out_cos[l] = (share * cos[l]) as f32;
            out_x_sin[l] = (x * sin[l]) as f32;
            out_sin[l] = sin[l] as f32;
            out_x_cos[l] = (x * cos[l]) as f32;
            (cos[l], sin[l]) = (
                cos[l] * step_cos[l] - sin[l] * step_sin[l],
                sin[l] * step_cos[l] + cos[l] * step_sin[l],
            );
        }
    }
}

// Real and imaginary parts of the transforms of an image, of it times x, and of it times y. Of a row f(x) with even part E and odd
// part O, Σ f exp(−ipx) = Σ E cos − i Σ O sin, and Σ x f exp(−ipx) = Σ x O cos − i Σ x E sin; and the same along y.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_pixels(
    folding: &Folding,
    folded: &[f32],
    [along_x, along_y]: [&[Waves]; 2],
    sums: &mut [[f32; LANES]; 6],
) {
    let Folding {
        half, stride, band, ..
    } = *folding;
    let part = |k: usize| &folded[k * band * stride..][..band * stride];
    let [ee, eo, oe, oo] = [part(0), part(1), part(2), part(3)];
    for y in 0..half {
        let [ee, eo, oe, oo] = [ee, eo, oe, oo].map(|part| &part[y * stride..][..half]);
        let [mut ec_e, mut ex_e, mut ec_o, mut ex_o] = [[0.0f32; LANES]; 4];
        for ((e, o), [cos, x_sin, ..]) in ee.iter().zip(eo).zip(along_x) {
            for l in 0..LANES {
                ec_e[l] += e * cos[l];
                ex_e[l] += e * x_sin[l];
                ec_o[l] += o * cos[l];
                ex_o[l] += o * x_sin[l];
            }
        }
        let [mut os_e, mut ox_e, mut os_o, mut ox_o] = [[0.0f32; LANES]; 4];
        for ((e, o), [.., sin, x_cos]) in oe.iter().zip(oo).zip(along_x) {
            for l in 0..LANES {
                os_e[l] += e * sin[l];
                ox_e[l] += e * x_cos[l];
                os_o[l] += o * sin[l];
                ox_o[l] += o * x_cos[l];
            }
        }
        let [cos, y_sin, sin, y_cos] = &along_y[y];
        let [re, im, x_re, x_im, y_re, y_im] = &mut *sums;
        for l in 0..LANES {
            re[l] += ec_e[l] * cos[l] - os_o[l] * sin[l];
            im[l] -= os_e[l] * cos[l] + ec_o[l] * sin[l];
            x_re[l] += ox_e[l] * cos[l] - ex_o[l] * sin[l];
            x_im[l] -= ex_e[l] * cos[l] + ox_o[l] * sin[l];
            y_re[l] += ec_o[l] * y_cos[l] - os_e[l] * y_sin[l];
            y_im[l] -= os_o[l] * y_cos[l] + ec_e[l] * y_sin[l];
        }
    }
}

#[cfg(test)]
mod tests {
    use shearq_fourier::Complex64;

    use super::*;

    #[test]
    fn modes_of_turned_pixels_are_plain_sums() {
        let matrix = [[0.8, -0.65], [0.55, 0.9]];
        for n in [3, 8, 23, 48] {
            let plane = Plane::new(64, 18);
            let image: Vec<f32> = (0..n * n)
                .map(|at| ((at * at) as f32 * 0.37).sin())
                .collect();
            let mut out = [(); 3].map(|()| plane.mode_by_mode());
            let mut to_modes = ToTurnedModes::new(n);
            to_modes.transform_moments(&image, matrix, &plane, &mut out);
            let middle = (n as f64 - 1.0) / 2.0;
            let edges: Vec<f32> = (0..EDGE_LINES * n)
                .map(|at| (at as f32 * 0.61).cos())
                .collect();
            let mut of_edges = [(); 2].map(|()| plane.mode_by_mode());
            let [first, second] = &mut of_edges;
            to_modes.transform_edges(&edges, matrix, &plane, [first, second]);
            let map = |x: f64, y: f64| matrix.map(|[along_x, along_y]| along_x * x + along_y * y);
            for at in (0..2 * plane.quarter()).step_by(5) {
                let (x, y, below) = plane.indices(at);
                if x.max(y) > plane.modes {
                    continue;
                }
                let k = [
                    plane.wave(x),
                    if below { -1.0 } else { 1.0 } * plane.wave(y),
                ];
                let phase = |[x, y]: [f64; 2]| Complex64::cis(-(k[0] * x + k[1] * y));
                let check = |modes: &Modes, expected: Complex64, size: f64| {
                    let found = Complex64::new(f64::from(modes.re[at]), f64::from(modes.im[at]));
                    assert!(
                        (found - expected).norm() < 3e-6 * size,
                        "{n} {at}: {found} {expected}"
                    );
                };
                for (moment, modes) in out.iter().enumerate() {
                    let pixels = (0..n * n).map(|at| {
                        let place = map((at % n) as f64 - middle, (at / n) as f64 - middle);
                        let factor = [1.0, place[0], place[1]][moment];
                        (phase(place), factor * f64::from(image[at]))
                    });
                    let size: f64 = pixels.clone().map(|(_, value)| value.abs()).sum();
                    check(
                        modes,
                        pixels.map(|(phase, value)| phase * value).sum(),
                        size,
                    );
                }
                for (which, modes) in of_edges.iter().enumerate() {
                    let lines = (0..EDGE_LINES / 2 * n).map(|place| {
                        let along = (place % n) as f64 - middle;
                        let beyond = if (place / n) % 2 == 0 { -0.5 } else { 0.5 } * n as f64;
                        let [x, y] = match place / n < 2 {
                            true => [beyond, along],
                            false => [along, beyond],
                        };
                        phase(map(x, y)) * f64::from(edges[which * EDGE_LINES / 2 * n + place])
                    });
                    check(modes, lines.sum(), n as f64);
                }
            }
        }
    }
}
