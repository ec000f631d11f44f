//! The light that a galaxy's S/N is counted by.

use std::f64::consts::PI;
use std::sync::LazyLock;

use multiversion::multiversion;
use shearq_quantities::TransformedPsf;
use shearq_quantities::radial::{QuadraticForm, composite_rule};

use super::galaxy::{Component, Galaxy};
use super::render::sinc;

/// Directions over half a turn. Equal steps are exact but for terms that only ellipticities of 0.7 have.
const DIRECTIONS: usize = 20;

/// The end of the integral in radians per pixel: beyond it the square of a 3 px PSF's transform is below 10⁻¹².
const END: f64 = 2.0 * PI;

/// A node of the integral over the moduli of wavenumbers.
struct Ring {
    /// Radians per pixel.
    k: f64,
    /// k dk, the square of a pixel's transform in the mean over directions, and the factor before the integral.
    weight: f64,
}

/// Cosine and sine of the directions.
static TURNS: LazyLock<[(f64, f64); DIRECTIONS]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let (sin, cos) = (PI * i as f64 / DIRECTIONS as f64).sin_cos();
        (cos, sin)
    })
});

static RINGS: LazyLock<Vec<Ring>> = LazyLock::new(|| {
    // k = t³ brings nodes to the small wavenumbers, where galaxies have their power.
    composite_rule(0.0, END.cbrt(), 2, 12)
        .into_iter()
        .map(|(t, weight)| {
            let k = t.powi(3);
            let pixels = TURNS.map(|(cos, sin)| (sinc(k * cos) * sinc(k * sin)).powi(2));
            let pixel = pixels.iter().sum::<f64>() / DIRECTIONS as f64;
            Ring {
                k,
                // Twice the half plane over (2π)².
                weight: weight * 3.0 * t * t * k * pixel / (2.0 * PI * DIRECTIONS as f64),
            }
        })
        .collect()
});

/// ∫ I² d²x, I being the light of `galaxy` per px² behind pixels and a round PSF of the width of `psf`: the sum of
/// squared pixels of a stamp that holds all of it.
///
/// A galaxy cannot know how it lies to the PSF. Behind an elliptical one the sum is larger along its axis than across,
/// and fluxes chosen by it would make galaxies along the PSF fainter: a method that weights by flux would seem to leak
/// the PSF's ellipticity.
///
/// By Parseval's theorem, ∫ |F|² d²k / (2π)², to 4·10⁻⁴ for PSFs of 3 px or more and ellipticities up to 0.7.
pub fn power(galaxy: &Galaxy, psf: &TransformedPsf<'_>) -> f64 {
    let components = galaxy.components();
    // The forms, once for all rings.
    let forms: [Option<QuadraticForm>; Galaxy::MAX_COMPONENTS] =
        std::array::from_fn(|k| components.get(k).map(Component::form));
    RINGS
        .iter()
        .map(|ring| {
            let (mut re, mut im) = ([0.0; DIRECTIONS], [0.0; DIRECTIONS]);
            for (component, form) in components.iter().zip(forms.iter().flatten()) {
                let mut values = [0.0; DIRECTIONS];
                on_ring(component, *form, ring.k, &TURNS, &mut values);
                let (dx, dy) = (component.dx, component.dy);
                if (dx, dy) == (0.0, 0.0) {
                    // Most galaxies: no phase, which costs as much as the rest.
                    for (re, value) in re.iter_mut().zip(values) {
                        *re += value;
                    }
                    continue;
                }
                let places = re.iter_mut().zip(&mut im).zip(&*TURNS);
                for (((re, im), (cos, sin)), value) in places.zip(values) {
                    let (turn_im, turn_re) = (ring.k * (dx * cos + dy * sin)).sin_cos();
                    *re += value * turn_re;
                    *im += value * turn_im;
                }
            }
            let blur = psf.transform.at((ring.k * psf.fwhm).powi(2));
            let light: f64 = re.iter().zip(im).map(|(re, im)| re * re + im * im).sum();
            ring.weight * light * blur * blur
        })
        .sum()
}

/// The transform of a component, whose form is `form`, about its centre on a ring.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn on_ring(
    component: &Component,
    form: QuadraticForm,
    k: f64,
    turns: &[(f64, f64); DIRECTIONS],
    out: &mut [f64; DIRECTIONS],
) {
    for (value, (cos, sin)) in out.iter_mut().zip(turns) {
        *value = form.at(k * cos, k * sin);
    }
    component.profile.fourier_each(out);
    for value in out {
        *value *= component.flux;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::{RenderScratch, Renderer};
    use shearq_quantities::PsfTransform;
    use shearq_quantities::Shear;
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
                for (fraction, bulge, disc) in [
                    (0.5, 2.3, 4.8),
                    (0.5, 1.8, 2.6),
                    (0.5, 3.4, 10.0),
                    (0.0, 2.3, 4.8),
                    (1.0, 2.3, 4.8),
                ] {
                    for (shape, offset) in [
                        (Shear::new(0.0, 0.0), (0.0, 0.0)),
                        (Shear::new(0.2, -0.1), (0.0, 0.0)),
                        (Shear::new(-0.5, 0.49), (0.0, 0.0)),
                        (Shear::new(0.0, 0.3), (2.0, 1.0)),
                    ] {
                        let galaxy =
                            Galaxy::bulge_and_disc(3.0, fraction, bulge, disc, shape).unwrap();
                        let galaxy = galaxy.with_bulge_offset(offset.0, offset.1).unwrap();
                        let middle = (side as f64 - 1.0) / 2.0 + 0.3;
                        renderer.render(&galaxy, &psf, (middle, middle), &mut scratch, &mut stamp);
                        let sum: f64 = stamp.iter().map(|&v| f64::from(v).powi(2)).sum();
                        let found = power(&galaxy, &psf);
                        // The rule's own, at an ellipticity of 0.7; otherwise it is below 3·10⁻⁵.
                        assert!(
                            (found / sum - 1.0).abs()
                                < if shape.modulus() > 0.5 { 4e-4 } else { 3e-5 },
                            "{profile:?} {fwhm} {fraction} {disc} {shape:?}: {found} {sum}"
                        );
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
