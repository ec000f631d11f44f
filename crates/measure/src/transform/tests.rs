//! Transforms against plain sums.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shearq_quantities::fourier::Complex64;

use super::*;

fn numbers(rng: &mut ChaCha8Rng, count: usize) -> Vec<f32> {
    (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
}

/// All modes of an odd and an even period, and few of a longer one.
fn planes(n: usize) -> [Plane; 3] {
    [
        Plane::with_all_modes((n + 4) | 1),
        Plane::with_all_modes((n + 5) & !1),
        Plane::new(2 * n + 2, n / 2),
    ]
}

/// Place, and indices of the modes that are kept.
fn kept(plane: &Plane) -> impl Iterator<Item = (usize, [f64; 2])> {
    let wave = |j: usize| plane.wave(j);
    let all = (0..2 * plane.quarter()).map(|at| (at, plane.indices(at)));
    let kept = all.filter(|(_, (x, y, _))| *x.max(y) <= plane.modes);
    kept.map(move |(at, (x, y, below))| (at, [wave(x), if below { -wave(y) } else { wave(y) }]))
}

#[test]
fn folding_sums_opposite_pixels_and_unfolding_undoes_it() {
    for n in [1usize, 2, 3, 5, 14, 15, 16, 19, 23, 24, 31, 48] {
        let folding = Folding::new(n);
        let Folding {
            half, stride, band, ..
        } = folding;
        let image: Vec<f32> = (0..n * n).map(|at| ((at * at) % 97) as f32).collect();
        let mut folded = vec![f32::NAN; folding.len()];
        fold(&folding, &image, &mut folded);
        // Opposite pixels are as far from the other end.
        let pixel = |y: usize, x: usize| image[y * n + x];
        for (y, x) in (0..half * half).map(|at| (at / half, at % half)) {
            let (right, upper) = (n / 2 + x, n / 2 + y);
            let (left, lower) = (n - 1 - right, n - 1 - upper);
            let (ur, ul) = (pixel(upper, right), pixel(upper, left));
            let (lr, ll) = (pixel(lower, right), pixel(lower, left));
            let expected = [
                ur + ul + lr + ll,
                ur + ul - lr - ll,
                ur - ul + lr - ll,
                ur - ul - lr + ll,
            ];
            for (part, expected) in expected.into_iter().enumerate() {
                let found = folded[(part * band + y) * stride + x];
                assert_eq!(found, expected, "n {n}, {x}, {y}");
            }
        }
        let parts: Vec<f32> = folded.iter().map(|v| v / 4.0).collect();
        let mut found = vec![f32::NAN; n * n];
        unfold(&folding, &parts, &mut found);
        assert_eq!(found, image, "n {n}");
    }
}

/// Compares an image's transform, and those of it times places, with plain sums over pixels. Returns the first.
fn compare_with_sums(
    to_modes: &ToModes,
    plane: &Plane,
    image: &[f32],
    shape: PixelShape,
) -> Spectrum {
    let n = to_modes.side();
    let middle = (n as f64 - 1.0) / 2.0;
    let mut scratch = to_modes.scratch();
    scratch.lines.fill(f32::NAN);
    let mut spectra = [(); 3].map(|()| plane.spectrum());
    to_modes.transform_moments(image, &mut scratch, &mut spectra);
    for (moment, spectrum) in spectra.iter().enumerate() {
        let mut modes = plane.mode_by_mode();
        modes.take_spectrum(spectrum);
        let pixels: Vec<[f64; 3]> = (0..n * n)
            .map(|at| {
                let place = shape.map([at % n, at / n].map(|x| x as f64 - middle));
                let factor = [1.0, place[0], place[1]][moment];
                [place[0], place[1], factor * f64::from(image[at])]
            })
            .collect();
        let size: f64 = pixels.iter().map(|[.., v]| v.abs()).sum();
        // A part of the modes, for time.
        for (at, [kx, ky]) in kept(plane).step_by(7) {
            let terms = pixels.iter();
            let terms = terms.map(|[x, y, v]| Complex64::from_polar(*v, -(kx * x + ky * y)));
            let plain: Complex64 = terms.sum();
            let found = Complex64::new(f64::from(modes.re[at]), f64::from(modes.im[at]));
            // Two sums of a few tens of terms, and waves in single precision.
            assert!(
                (found - plain).norm() <= 2e-6 * size,
                "{n} {plane:?} {shape:?} {at}: {found} {plain}"
            );
        }
    }
    let [first, ..] = spectra;
    first
}

#[test]
fn modes_are_plain_sums_and_give_the_image_back() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    for n in [1, 2, 3, 8, 16, 23, 33, 48] {
        let image = numbers(&mut rng, n * n);
        for (which, plane) in planes(n).into_iter().enumerate() {
            let to_modes = ToModes::new(n, &plane, true);
            let with = compare_with_sums(&to_modes, &plane, &image, PixelShape::SQUARE);
            let plain = ToModes::new(n, &plane, false);
            let mut alone = plane.spectrum();
            plain.transform(&image, &mut plain.scratch(), &mut alone);
            assert_eq!(alone.0, with.0);
            if plane.modes < plane.period / 2 {
                continue;
            }
            let to_pixels = ToPixels::new(n, &plane);
            let (mut scratch, mut found) = (to_pixels.scratch(), vec![f32::NAN; n * n]);
            scratch.lines.fill(f32::NAN);
            to_pixels.transform(&alone, &mut scratch, &mut found);
            for (found, expected) in found.iter().zip(&image) {
                assert!((found - expected).abs() < 3e-6, "{n} {which}");
            }
        }
    }
}

#[test]
fn modes_of_skewed_pixels_are_plain_sums() {
    let mut rng = ChaCha8Rng::seed_from_u64(14);
    for n in [1, 2, 3, 8, 16, 23, 33, 48] {
        let image = numbers(&mut rng, n * n);
        for plane in planes(n) {
            // The same tables, one shape after the other.
            let mut to_modes = ToModes::new(n, &plane, true);
            let mut without = ToModes::new(n, &plane, false);
            for (stretch, skew) in [(1.05, 0.08), (0.93, -0.06), (1.0, 0.2), (1.1, 0.0)] {
                let shape = PixelShape { stretch, skew };
                to_modes.set_pixel_shape(&plane, shape);
                let with = compare_with_sums(&to_modes, &plane, &image, shape);
                without.set_pixel_shape(&plane, shape);
                let mut alone = plane.spectrum();
                without.transform(&image, &mut without.scratch(), &mut alone);
                assert_eq!(alone.0, with.0);
            }
        }
    }
}

#[test]
fn parities_and_modes_are_the_same_spectrum() {
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    let plane = Plane::new(48, 15);
    let quarter = plane.quarter();
    let mut spectrum = plane.spectrum();
    spectrum.0 = numbers(&mut rng, 4 * quarter);
    let mut modes = plane.mode_by_mode();
    modes.take_spectrum(&spectrum);
    for at in 0..quarter {
        let [cc, cs, sc, ss] = spectrum.quarters().map(|part| part[at]);
        assert_eq!((modes.re[at], modes.im[at]), (cc - ss, sc + cs));
        let below = (modes.re[quarter + at], modes.im[quarter + at]);
        assert_eq!(below, (cc + ss, sc - cs));
    }
    let mut back = plane.spectrum();
    back.take_modes(&modes);
    for (at, (found, expected)) in back.0.iter().zip(&spectrum.0).enumerate() {
        // A sum and a difference, each rounded.
        assert!((found - expected).abs() < 3e-7, "{at}");
    }
    let mut even = vec![0.0; 2 * quarter];
    even_parities(&modes.re, &mut even);
    assert_eq!(even[..quarter], back.0[..quarter]);
    assert_eq!(even[quarter..], back.0[3 * quarter..]);
    // Products and powers, mode by mode.
    let mut kernel = plane.spectrum();
    kernel.0 = numbers(&mut rng, 4 * quarter);
    let mut of_kernel = plane.mode_by_mode();
    of_kernel.take_spectrum(&kernel);
    let (mut product, mut of_product) = (spectrum.clone(), plane.mode_by_mode());
    product.multiply(&kernel);
    of_product.take_spectrum(&product);
    let mut power = plane.spectrum();
    spectrum.power(&mut even);
    power.0[..quarter].copy_from_slice(&even[..quarter]);
    power.0[3 * quarter..].copy_from_slice(&even[quarter..]);
    let mut of_power = plane.mode_by_mode();
    of_power.take_spectrum(&power);
    for at in 0..2 * quarter {
        let complex = |modes: &Modes| Complex64::new(modes.re[at].into(), modes.im[at].into());
        let (a, b) = (complex(&modes), complex(&of_kernel));
        assert!((complex(&of_product) - a * b).norm() < 3e-6, "{at}");
        assert!((complex(&of_power) - a.norm_sqr()).norm() < 3e-6, "{at}");
    }
}

#[test]
fn lags_are_plain_sums_and_spectra_of_weights_their_adjoint() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for (plane, reach, steps, hexagonal) in [
        (Plane::new(64, 23), 15, 48, false),
        (Plane::new(48, 7), 9, 24, false),
        (Plane::with_all_modes(12), 6, 12, false),
        (Plane::with_all_modes(9), 4, 9, false),
        (Plane::new(64, 23), 15, 48, true),
        (Plane::new(48, 7), 10, 24, true),
    ] {
        // Places in steps along y.
        let lattice = HexLattice {
            row_spacing: 1.0,
            reach,
        };
        let square = (0..=reach).flat_map(|y| {
            let reach = reach as i32;
            (-reach..=reach).map(move |x| [f64::from(x), y as f64])
        });
        let (to_lags, places, scale): (_, Vec<_>, _) = if hexagonal {
            let to_lags = ToLags::hexagonal(lattice, steps, &plane);
            (to_lags, lattice.places().collect(), 1.0)
        } else {
            (
                ToLags::new(reach, steps, &plane, 0.5),
                square.collect(),
                0.5,
            )
        };
        let quarter = plane.quarter();
        // The last place of rows with a lag at zero is beyond the circle, and is not used.
        let used = |[x, y]: [f64; 2]| !hexagonal || lattice.contains([x, y]);
        let mut scratch = to_lags.scratch();
        // What another one left behind does not matter.
        scratch.between.fill(f32::NAN);
        scratch.lags[0].fill(f32::NAN);
        // Modes that are stored twice are the same, and those beyond the kept ones zero.
        let mut modes = vec![0.0f32; 2 * quarter];
        for (at, _) in kept(&plane) {
            modes[at] = rng.random_range(-1.0..1.0);
        }
        let own_opposite = |j: usize| plane.count(j) == 1.0;
        for at in 0..quarter {
            let (x, y, _) = plane.indices(at);
            if own_opposite(x) || own_opposite(y) {
                modes[quarter + at] = modes[at];
            }
        }
        let mut spectrum = vec![0.0; 2 * quarter];
        even_parities(&modes, &mut spectrum);
        let mut lags = vec![f32::NAN; to_lags.len()];
        to_lags.lags(&spectrum, &mut scratch, &mut lags);
        let share = |at: usize| {
            let (x, y, _) = plane.indices(at);
            plane.count(x) * plane.count(y) / 2.0
        };
        let unit = std::f64::consts::TAU / steps as f64;
        assert_eq!(lags.len(), places.len());
        for (place, found) in places.iter().zip(&lags).filter(|(place, _)| used(**place)) {
            let [dx, dy] = *place;
            let terms = kept(&plane).map(|(at, _)| {
                let (x, y, below) = plane.indices(at);
                let y = if below { -(y as f64) } else { y as f64 };
                share(at) * f64::from(modes[at]) * (unit * (x as f64 * dx + y * dy)).cos()
            });
            let plain = scale * terms.sum::<f64>();
            assert!(
                (f64::from(*found) - plain).abs() < 1e-4,
                "{place:?}: {found} {plain}"
            );
        }
        // Weights of the lags that are the same at opposite lags.
        let mut weights = numbers(&mut rng, to_lags.len());
        for (at, &[x, y]) in places.iter().enumerate() {
            if !used([x, y]) {
                weights[at] = 0.0;
            } else if y == 0.0 && x < 0.0 {
                weights[at] = weights[places.iter().position(|at| *at == [-x, 0.0]).unwrap()];
            }
        }
        let mut adjoint = vec![f32::NAN; 2 * quarter];
        to_lags.spectrum(&weights, &mut scratch, &mut adjoint);
        let (cc, ss) = adjoint.split_at(quarter);
        let by_modes = kept(&plane).map(|(at, _)| {
            let (below, at_quarter) = (at >= quarter, at % quarter);
            let sign = if below { 1.0 } else { -1.0 };
            let value = f64::from(cc[at_quarter] + sign * ss[at_quarter]);
            share(at) * f64::from(modes[at]) * value
        });
        let by_lags = weights.iter().zip(&lags).enumerate().map(|(at, (w, v))| {
            // A place below the first row stands for two.
            let count = if places[at][1] > 0.0 { 2.0 } else { 1.0 };
            count * f64::from(*w) * f64::from(*v)
        });
        let (by_modes, by_lags): (f64, f64) = (by_modes.sum(), by_lags.sum());
        // Thousands of terms of order one in single precision.
        assert!((by_modes - by_lags).abs() < 0.02, "{by_modes} {by_lags}");
        assert!(by_lags.abs() > 0.1, "{by_lags}");
    }
}

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
