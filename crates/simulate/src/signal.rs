//! The light that a galaxy's S/N is counted by.

use std::f64::consts::PI;
use std::sync::LazyLock;

use multiversion::multiversion;
use shearq_quantities::radial::{QuadraticForm, composite_rule};
use shearq_quantities::{Shear, TransformedPsf};

use super::galaxy::{Component, Galaxy, Sersic};
use super::render::sinc;

// Directions over a quarter of a turn. Equal steps are exact but for terms that only ellipticities of 0.7 have.
const QUARTER: usize = 10;
const HALF: usize = 2 * QUARTER;

// In radians per pixel: beyond it the square of a 3 px PSF's transform is below 10⁻¹².
const END: f64 = 2.0 * PI;

/// A node of the integral over the moduli of wavenumbers.
struct Ring {
    k: f64,
    /// k dk, the square of a pixel's transform in the mean over directions, and the factor before the integral.
    weight: f64,
}

/// Cosines and sines of the directions, in the middle of equal parts of half a turn.
struct Turns {
    cos: [f64; HALF],
    sin: [f64; HALF],
}

static TURNS: LazyLock<Turns> = LazyLock::new(|| {
    let angle = |i: usize| PI * (i as f64 + 0.5) / HALF as f64;
    Turns {
        cos: std::array::from_fn(|i| angle(i).cos()),
        sin: std::array::from_fn(|i| angle(i).sin()),
    }
});

static RINGS: LazyLock<Vec<Ring>> = LazyLock::new(|| {
    // k = t³ brings nodes to the small wavenumbers, where galaxies have their power.
    composite_rule(0.0, END.cbrt(), 2, 12)
        .into_iter()
        .map(|(t, weight)| {
            let k = t.powi(3);
            let turns = TURNS.cos.iter().zip(&TURNS.sin);
            let pixels = turns.map(|(cos, sin)| (sinc(k * cos) * sinc(k * sin)).powi(2));
            let pixel = pixels.sum::<f64>() / HALF as f64;
            Ring {
                k,
                // Twice the half plane over (2π)².
                weight: weight * 3.0 * t * t * k * pixel / (2.0 * PI),
            }
        })
        .collect()
});

/// ∫ I² d²x, I being the light of `galaxy` per px² behind pixels and a round PSF of the width of `psf`: the sum of
/// squared pixels of a stamp that holds all of it.
///
/// The S/N of a galaxy must not depend on its orientation to the PSF. Behind an elliptical PSF the sum is larger along its axis than across,
/// and fluxes chosen by it would make galaxies along the PSF fainter: a method that weights by flux would seem to leak
/// the PSF's ellipticity.
///
/// By Parseval's theorem, ∫ |F|² d²k / (2π)², to 4·10⁻⁴ for PSFs of 3 px or more and ellipticities up to 0.7.
pub fn power(galaxy: &Galaxy, psf: &TransformedPsf<'_>) -> f64 {
    let components = galaxy.components();
    let first = components[0];
    let alike = |c: &Component| c.shape == first.shape && (c.dx, c.dy) == (first.dx, first.dy);
    let sum = |squares: &dyn Fn(f64) -> f64| -> f64 {
        let rings = RINGS.iter().map(|ring| {
            let blur = psf.transform.at((ring.k * psf.fwhm).powi(2));
            ring.weight * squares(ring.k) * blur * blur
        });
        rings.sum()
    };
    if components.iter().all(alike) {
        // Light that is symmetric about one axis repeats after a quarter of a turn if this axis is x. Rotating it there does not
        // change the sum behind a round PSF.
        let shape = Shear::new(first.shape.modulus(), 0.0);
        let along = |c: &Component| Component { shape, ..*c }.form();
        let lights = lights(components, along);
        sum(&|k| mean_square::<QUARTER>(&lights, k, &TURNS))
    } else {
        let lights = lights(components, Component::form);
        sum(&|k| mean_square::<HALF>(&lights, k, &TURNS))
    }
}

struct Light {
    profile: Sersic,
    flux: f64,
    form: QuadraticForm,
    /// Place of the centre, relative to the first component.
    offset: (f64, f64),
}

fn lights(
    components: &[Component],
    form: impl Fn(&Component) -> QuadraticForm,
) -> [Option<Light>; Galaxy::MAX_COMPONENTS] {
    std::array::from_fn(|k| {
        components.get(k).map(|c| Light {
            profile: c.profile,
            flux: c.flux,
            form: form(c),
            offset: (c.dx - components[0].dx, c.dy - components[0].dy),
        })
    })
}

/// The squared modulus of the galaxy's transform at the modulus `k` of wavenumbers, in the mean over `D` directions.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn mean_square<const D: usize>(
    lights: &[Option<Light>; Galaxy::MAX_COMPONENTS],
    k: f64,
    turns: &Turns,
) -> f64 {
    let (mut re, mut im) = ([0.0; D], [0.0; D]);
    for light in lights.iter().flatten() {
        let form = light.form.scaled(k * k);
        let mut values = [0.0; D];
        for ((value, cos), sin) in values.iter_mut().zip(&turns.cos).zip(&turns.sin) {
            *value = form.at(*cos, *sin);
        }
        light.profile.fourier_each(&mut values);
        if light.offset == (0.0, 0.0) {
            // Most components: no phase, which costs as much as the rest.
            for (re, value) in re.iter_mut().zip(values) {
                *re += light.flux * value;
            }
            continue;
        }
        let (dx, dy) = light.offset;
        for i in 0..D {
            let (sin, cos) = (k * (dx * turns.cos[i] + dy * turns.sin[i])).sin_cos();
            re[i] += light.flux * values[i] * cos;
            im[i] += light.flux * values[i] * sin;
        }
    }
    let squares = re.iter().zip(im).map(|(re, im)| re * re + im * im);
    squares.sum::<f64>() / D as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::{RenderScratch, Renderer};
    use shearq_quantities::PsfTransform;
    use shearq_quantities::{FunctionalPsf, PsfProfile};

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

    #[test]
    fn it_is_the_sum_of_squared_pixels() {
        let side = 192;
        let renderer = Renderer::new(side);
        let mut scratch = RenderScratch::new();
        let mut stamp = vec![0.0f32; side * side];
        for profile in [MOFFAT, PsfProfile::Kolmogorov] {
            let transform = PsfTransform::new(profile).unwrap();
            for fwhm in [3.06, 3.4, 3.74] {
                let psf = FunctionalPsf::new(profile, fwhm, Shear::new(0.0, 0.0)).unwrap();
                let psf = transform.of(&psf).unwrap();
                let sizes = [
                    (0.5, 2.3, 4.8),
                    (0.5, 1.8, 2.6),
                    (0.5, 3.4, 10.0),
                    (0.0, 2.3, 4.8),
                    (1.0, 2.3, 4.8),
                ];
                let shapes = [
                    (Shear::ZERO, (0.0, 0.0)),
                    (Shear::new(0.2, -0.1), (0.0, 0.0)),
                    (Shear::new(-0.5, 0.49), (0.0, 0.0)),
                    (Shear::new(0.0, 0.3), (2.0, 1.0)),
                ];
                for (fraction, bulge, disc) in sizes {
                    for (shape, offset) in shapes {
                        let galaxy =
                            Galaxy::bulge_and_disc(3.0, fraction, bulge, disc, shape).unwrap();
                        let galaxy = galaxy.with_bulge_offset(offset.0, offset.1).unwrap();
                        let middle = (side as f64 - 1.0) / 2.0 + 0.3;
                        renderer.render(&galaxy, &psf, (middle, middle), &mut scratch, &mut stamp);
                        let sum: f64 = stamp.iter().map(|&v| f64::from(v).powi(2)).sum();
                        let found = power(&galaxy, &psf);
                        // The rule's own, at an ellipticity of 0.7; otherwise it is below 3·10⁻⁵.
                        let most = if shape.modulus() > 0.5 { 4e-4 } else { 3e-5 };
                        let what = format!("{profile:?} {fwhm} {fraction} {disc} {shape:?}");
                        assert!((found / sum - 1.0).abs() < most, "{what}: {found} {sum}");
                    }
                }
            }
        }
    }

    #[test]
    fn it_does_not_depend_on_how_the_galaxy_lies() {
        let transform = PsfTransform::new(MOFFAT).unwrap();
        let power = |shape: Shear, (dx, dy): (f64, f64), psf: Shear| {
            let psf = FunctionalPsf::new(MOFFAT, 3.4, psf).unwrap();
            let galaxy = Galaxy::bulge_and_disc(1.0, 0.5, 2.3, 4.8, shape).unwrap();
            let galaxy = galaxy.with_bulge_offset(dx, dy).unwrap();
            power(&galaxy, &transform.of(&psf).unwrap())
        };
        let along = power(Shear::new(0.3, 0.0), (2.0, 0.0), Shear::new(0.05, 0.0));
        // The opposite ellipticity is the shape turned by a quarter, half a component into the other an eighth.
        for (shape, offset) in [
            (Shear::new(-0.3, 0.0), (0.0, 2.0)),
            (Shear::new(0.0, 0.3), (2f64.sqrt(), 2f64.sqrt())),
        ] {
            let turned = power(shape, offset, Shear::new(0.05, 0.0));
            assert!((turned / along - 1.0).abs() < 1e-9, "{turned} {along}");
        }
        // Between the rule's directions.
        let (sin, cos) = 13f64.to_radians().sin_cos();
        let shape = Shear::new(0.3 * (cos * cos - sin * sin), 0.6 * sin * cos);
        let turned = power(shape, (2.0 * cos, 2.0 * sin), Shear::new(0.05, 0.0));
        assert!((turned / along - 1.0).abs() < 3e-5, "{turned} {along}");
    }
}
