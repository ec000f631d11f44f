//! Drawn galaxies beside sums over their profiles.

use super::*;
use shearq_quantities::PsfProfile;
use shearq_quantities::PsfTransform;
use shearq_quantities::Shear;
use shearq_quantities::radial::composite_rule;

const STAMP: usize = 48;
const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

struct Case {
    name: &'static str,
    galaxy: Galaxy,
    psf: FunctionalPsf,
    centre: (f64, f64),
}

/// Name; share of the bulge and half-light radii of bulge and disc; shape; offset of the bulge; PSF: β (0 for Kolmogorov),
/// FWHM and shape; centre.
const CASES: &str = "
fiducial            | 0.5 2.3 4.8  |  0.2 -0.1 |  0   0   | 3   3.4  0.02 -0.015 | 23.8 23.1
round               | 0.5 2.3 4.8  |  0    0   |  0   0   | 3   3.4  0.02 -0.015 | 23.5 23.5
flat                | 0.5 2.3 4.8  | -0.5  0.4 |  0   0   | 3   3.4  0.02 -0.015 | 23.1 23.9
bulge               | 1   2.3 4.8  |  0.1  0.3 |  0   0   | 3   3.4  0.02 -0.015 | 23.3 23.6
disc                | 0   2.3 4.8  |  0.1  0.3 |  0   0   | 3   3.4  0.02 -0.015 | 23.3 23.6
small               | 0.5 1.8 2.6  |  0.1 -0.2 |  0   0   | 3   3.4  0.02 -0.015 | 23   24
large               | 0.5 3.4 10   |  0.1 -0.2 |  0   0   | 3   3.4  0.02 -0.015 | 23.7 23.6
large, flat         | 0.5 3.4 10   |  0.6 -0.2 |  0   0   | 3   3.4  0.02 -0.015 | 23.7 23.6
bulge offset        | 0.5 2.3 4.8  |  0.3  0.1 |  1.3 -0.8 | 3   3.4  0.02 -0.015 | 23.2 23.8
Kolmogorov          | 0.5 2.3 4.8  |  0.2  0.2 |  0   0   | 0   3.4 -0.03  0.04  | 23.8 23.1
Kolmogorov, offset  | 0.3 1.8 2.6  | -0.2  0.3 | -2   0.5 | 0   3.4 -0.03  0.04  | 23.5 23.5
narrow PSF          | 0.5 2.3 4.8  |  0.2  0.2 |  0   0   | 3   2    0.1   0     | 23.8 23.1
narrow PSF, offset  | 0.5 2.3 4.8  |  0.2  0.2 |  0.7 0.2 | 3   1.5  0.1   0     | 23.8 23.1
wide PSF            | 0.5 2.3 4.8  |  0.2  0.2 |  0   0   | 2.5 6    0     0.2   | 23.8 23.1
far from the middle | 0.5 2.3 4.8  |  0.2  0.2 |  0   0   | 3   3.4  0.02 -0.015 | 30.4 17.2";

/// A case of a line such as those of `CASES`.
fn case(line: &'static str) -> Case {
    let (name, line) = line.split_once('|').unwrap();
    let words = line.split([' ', '|']).filter(|word| !word.is_empty());
    let numbers: Vec<f64> = words.map(|word| word.parse().unwrap()).collect();
    let [share, bulge, disc, e1, e2, dx, dy, beta, fwhm, p1, p2, x, y] = numbers[..] else {
        panic!("{line}: {} numbers", numbers.len());
    };
    let galaxy = Galaxy::bulge_and_disc(30.0, share, bulge, disc, Shear::new(e1, e2))
        .and_then(|galaxy| galaxy.with_bulge_offset(dx, dy))
        .unwrap();
    let profile = match beta {
        0.0 => PsfProfile::Kolmogorov,
        beta => PsfProfile::Moffat { beta },
    };
    Case {
        name: name.trim_end(),
        galaxy,
        psf: FunctionalPsf::new(profile, fwhm, Shear::new(p1, p2)).unwrap(),
        centre: (x, y),
    }
}

fn cases() -> impl Iterator<Item = Case> {
    CASES.lines().skip(1).map(case)
}

fn fast(case: &Case, scratch: &mut RenderScratch) -> Vec<f32> {
    fast_on(STAMP, case, scratch)
}

/// The same on a stamp of `side` × `side` pixels.
fn fast_on(side: usize, case: &Case, scratch: &mut RenderScratch) -> Vec<f32> {
    let transform = PsfTransform::new(case.psf.profile).unwrap();
    let mut out = vec![f32::NAN; side * side];
    Renderer::new(side).render(
        &case.galaxy,
        &transform.of(&case.psf).unwrap(),
        case.centre,
        scratch,
        &mut out,
    );
    out
}

/// Largest difference of two stamps over the peak of the second.
fn difference<'a>(a: impl IntoIterator<Item = &'a f32>, b: impl IntoIterator<Item = f64>) -> f64 {
    let (mut worst, mut peak) = (0f64, 0f64);
    for (a, b) in a.into_iter().zip(b) {
        worst = worst.max((f64::from(*a) - b).abs());
        peak = peak.max(b);
    }
    worst / peak
}

#[test]
fn fast_path_agrees_with_the_reference() {
    let mut dirty = RenderScratch::new();
    for case in cases() {
        // Only the narrow PSFs leave light beyond 2π.
        let orders = if case.psf.fwhm < 3.0 { 4.0 } else { 2.0 };
        let (galaxy, psf) = (&case.galaxy, &case.psf);
        let exact = render_reference(STAMP, galaxy, psf, case.centre, 6 * STAMP, orders);
        let clean = fast(&case, &mut RenderScratch::new());
        let error = difference(&clean, exact.iter().copied());
        println!("{:20} {error:.1e}", case.name);
        // What remains is untruncated de Vaucouleurs wings from the repeated images, held
        // near FOLDING_TOLERANCE; single precision and the spectrum's cut are near 5e-6.
        assert!(error < 1e-4, "{}: {error:e}", case.name);
        // Scratch left by another galaxy, PSF and transform size, and by NaN.
        let [above, below] = &mut dirty.lines;
        let planes = [
            above,
            below,
            &mut dirty.sums,
            &mut dirty.even,
            &mut dirty.odd,
        ];
        planes.into_iter().for_each(|buffer| buffer.fill(f32::NAN));
        dirty
            .along_y
            .iter_mut()
            .for_each(|buffer| buffer.fill(f32::NAN));
        assert_eq!(fast(&case, &mut dirty), clean, "{}", case.name);
    }
}

/// ∫ galaxy(x′) PSF(x − x′) d²x′ in real space, in polar coordinates about each component.
fn by_real_space(case: &Case, x: usize, y: usize) -> f64 {
    let pixel = |dx: f64, dy: f64| {
        let mut value = Array2::zeros((1, 1));
        case.psf.draw_into(-dx, -dy, value.view_mut());
        value[(0, 0)]
    };
    let angles = 96;
    let mut sum = 0.0;
    for c in case.galaxy.components() {
        let [[a, b], [d, e]] = c.shape.matrix();
        // r = t⁴ flattens the cusp; 4⁴ r_e holds 1 − 1e-6 of the PSF-weighted light.
        for (t, w) in composite_rule(0.0, 3.6, 40, 6) {
            let (r, re) = (t.powi(4), c.half_light_radius);
            let ring = w * 4.0 * t.powi(3) * r * c.flux * c.profile.brightness(r);
            for angle in 0..angles {
                let (sin, cos) = (TAU * angle as f64 / angles as f64).sin_cos();
                let (u, v) = (re * r * cos, re * r * sin);
                let dx = x as f64 - case.centre.0 - c.dx - a * u - b * v;
                let dy = y as f64 - case.centre.1 - c.dy - d * u - e * v;
                sum += ring * TAU / angles as f64 * pixel(dx, dy);
            }
        }
    }
    sum
}

#[test]
fn stamps_agree_with_a_convolution_in_real_space() {
    for case in cases() {
        if !["fiducial", "Kolmogorov, offset"].contains(&case.name) {
            continue;
        }
        let stamp = fast(&case, &mut RenderScratch::new());
        let peak = f64::from(stamp.iter().copied().fold(0.0, f32::max));
        for (x, y) in [(23, 23), (24, 23), (20, 25), (28, 22)] {
            let exact = by_real_space(&case, x, y);
            let error = (f64::from(stamp[y * STAMP + x]) - exact).abs() / peak;
            println!("{} ({x}, {y}): {error:.1e}", case.name);
            assert!(error < 3e-5, "{} ({x}, {y}): {error:e}", case.name);
        }
    }
}

#[test]
fn a_point_is_the_psf() {
    let galaxy = Galaxy::bulge_and_disc(1.0, 0.0, 1.0, 1e-3, Shear::ZERO).unwrap();
    for profile in [MOFFAT, PsfProfile::Kolmogorov] {
        let psf = FunctionalPsf::new(profile, 3.4, Shear::new(0.1, -0.05)).unwrap();
        let case = Case {
            name: "point",
            galaxy,
            psf,
            centre: (23.7, 22.9),
        };
        let mut drawn = Array2::zeros((STAMP, STAMP));
        psf.draw_into(23.7, 22.9, drawn.view_mut());
        let error = difference(&fast(&case, &mut RenderScratch::new()), drawn);
        assert!(error < 5e-5, "{profile:?}: {error:e}");
    }
}

#[test]
fn flux_is_conserved() {
    // Discs keep their light inside the stamp; a larger stamp catches what the wings of bulges carry away.
    for (line, side, lost) in [
        (
            "| 0 2.3 2.6 | 0.2 0.1 | 0 0 | 5 3 0 0 | 23.4 23.7",
            STAMP,
            2e-4,
        ),
        (
            "| 0.5 2.3 4.8 | 0 0 | 0 0 | 3 3.4 0 0 | 119.5 119.5",
            240,
            2e-3,
        ),
    ] {
        let stamp = fast_on(side, &case(line), &mut RenderScratch::new());
        let sum: f64 = stamp.iter().map(|&v| f64::from(v)).sum();
        assert!((sum / 30.0 - 1.0).abs() < lost, "{line}: {sum}");
    }
}

#[test]
fn small_and_odd_stamps_are_drawn_like_large_ones() {
    for side in [1, 2, 3, 9, 15, 16] {
        for fwhm in [1.5, 3.4] {
            let at = (side as f64 - 1.0) / 2.0 + 0.2;
            let plain = case("| 0.3 1.8 2.6 | 0.2 -0.1 | 0.4 -0.3 | 3 3.4 0.05 0 | 0 0");
            let case = Case {
                psf: FunctionalPsf { fwhm, ..plain.psf },
                centre: (at, at - 0.3),
                ..plain
            };
            let exact = render_reference(side, &case.galaxy, &case.psf, case.centre, 180, 4.0);
            let out = fast_on(side, &case, &mut RenderScratch::new());
            let error = difference(&out, exact.iter().copied());
            // Folded light is held near 3e-5 of the peak surface brightness, a rough one.
            assert!(error < 2e-4, "{side} {fwhm}: {error:e}");
        }
    }
}
