//! Ellipticity, response and observables of the reported type, from what a method found.

use shearq_quantities::{Distortion, Shear};
use shearq_submissions::EllipticityType;

use crate::flag::Flag;
use crate::measurement::ResponseMatrix;
use crate::method::{Found, FoundObservables, Sheared};
use crate::observables::{Coupling, Observables};
use crate::versions::{Products, Versions, versions};

/// The ellipticity of type `kind` with its response, if the method knows it.
pub(crate) fn report(
    kind: EllipticityType,
    found: &Found,
) -> Result<(f64, f64, Option<ResponseMatrix>), Flag> {
    let chi = found.distortion?;
    let (mut e1, mut e2) = of_type(kind, chi).ok_or(Flag::NoShear)?;
    let mut response = found.response.map(|r| reported(kind, chi, r));
    let usable = |noise: &&Sheared| {
        let mut sides = noise.sides.iter();
        sides.all(|(chi, _)| of_type(kind, *chi).is_some())
    };
    if let Some(noise) = found.sheared_noise.as_ref().filter(usable) {
        let sides = noise.sides;
        let [plus, minus] = sides.map(|(chi, r)| reported(kind, chi, r));
        for (i, row) in response.iter_mut().flatten().enumerate() {
            for (j, value) in row.iter_mut().enumerate() {
                *value -= noise.weight * (plus[i][j] - minus[i][j]);
            }
        }
        let [plus, minus] = [0, 1].map(|k| changed(kind, sides[k].0, noise.turned[k]));
        e1 += 0.5 * noise.weight * (plus[0] - minus[0]);
        e2 += 0.5 * noise.weight * (plus[1] - minus[1]);
    }
    Ok((e1, e2, response))
}

/// Change of the ellipticity of type `kind` with a change of the distortion.
fn changed(kind: EllipticityType, chi: Distortion, by: [f64; 2]) -> [f64; 2] {
    // Like the response to one shear that changes both components.
    let change = reported(kind, chi, by.map(|by| [by; 2]));
    [change[0][0], change[1][1]]
}

/// The ellipticity of type `kind` of a distortion; `None` if there is none of that type.
fn of_type(kind: EllipticityType, chi: Distortion) -> Option<(f64, f64)> {
    match kind {
        EllipticityType::Distortion => Some((chi.e1, chi.e2)),
        EllipticityType::Shear => chi.to_shear().map(|Shear { e1, e2 }| (e1, e2)),
    }
}

/// The response of the ellipticity of type `kind`, from the response of the distortion.
pub(crate) fn reported(
    kind: EllipticityType,
    chi: Distortion,
    r: ResponseMatrix,
) -> ResponseMatrix {
    match kind {
        EllipticityType::Distortion => r,
        EllipticityType::Shear => {
            // ε = χ f, f = 1/(1 + s), s = √(1 − |χ|²): ∂ε_i/∂χ_j = f δ_ij + χ_i χ_j f²/s.
            let s = (1.0 - chi.e1 * chi.e1 - chi.e2 * chi.e2).sqrt();
            let f = 1.0 / (1.0 + s);
            let cross = |a: f64, b: f64| a * b * f * f / s;
            let (own1, own2) = (f + cross(chi.e1, chi.e1), f + cross(chi.e2, chi.e2));
            let other = cross(chi.e1, chi.e2);
            [
                [0, 1].map(|j| own1 * r[0][j] + other * r[1][j]),
                [0, 1].map(|j| own2 * r[1][j] + other * r[0][j]),
            ]
        }
    }
}

/// Sheared versions of a galaxy with the ellipticity `e` of type `kind`, its `response` and its `observables`. `None` if none
/// are asked for. If the effect of noise is not known, which is rare, it is not corrected.
pub(crate) fn sheared_versions(
    kind: EllipticityType,
    found: &Found,
    (e, response): ([f64; 2], ResponseMatrix),
    observables: &Observables,
) -> Option<Versions> {
    let (chi, found) = (found.distortion.ok()?, found.observed.as_ref()?);
    let settings = found.versions?;
    let products = found.products.unwrap_or_default();
    let jacobian = reported(kind, chi, [[1.0, 0.0], [0.0, 1.0]]);
    let along = |row: [f64; 2]| [row[0], row[1], 0.0, 0.0];
    // Rows are e1, e2, flux and size; columns χ₁, χ₂, T and flux.
    let rows = [
        along(jacobian[0]),
        along(jacobian[1]),
        [0.0, 0.0, 0.0, 1.0],
        [0.0, 0.0, found.size[1], 0.0],
    ];
    // Number of the product of a pair, in the order 00, 01, 02, 03, 11, …
    let number = |i: usize, j: usize| i.min(j) * (7 - i.min(j)) / 2 + i.max(j);
    let product = |a: usize, b: usize, noise: usize| -> f64 {
        let terms = (0..4).flat_map(|i| (0..4).map(move |j| [i, j]));
        terms
            .map(|[i, j]| rows[a][i] * rows[b][j] * products[number(i, j)][noise])
            .sum()
    };
    let matrix =
        |noise: usize| std::array::from_fn(|a| std::array::from_fn(|b| product(a, b, noise)));
    let noise = Products {
        plain: matrix(3),
        sheared: [matrix(0), matrix(1)],
        turned: matrix(2),
    };
    let Observables {
        flux,
        flux_error,
        size,
        flux_response,
        size_response,
        coupling,
    } = *observables;
    let [.., t_s] = coupling.turned;
    let values = [e[0], e[1], flux, size + 0.5 * t_s];
    let derivatives = [0, 1].map(|k| {
        [
            response[0][k],
            response[1][k],
            flux_response[k],
            size_response[k],
        ]
    });
    let of = |noise: &Products| versions(values, derivatives, noise, &settings);
    let each = of(&noise).or_else(|| of(&Products::NONE))?;
    Some(Versions { each, flux_error })
}

/// Flux and size with their couplings to an ellipticity of type `kind`, measured as the distortion `chi`.
pub(crate) fn observables(
    kind: EllipticityType,
    chi: Distortion,
    found: &FoundObservables,
    sheared: Option<&Sheared>,
) -> Observables {
    let [size, first, second] = found.size;
    let mut size_response = found.square_response.map(|response| first * response);
    let mut coupling = Coupling::default();
    if let (Some(sheared), Some(products)) = (sheared, &found.products) {
        let product = |number: usize, noise: usize| products[number][noise];
        let jacobian = reported(kind, chi, [[1.0, 0.0], [0.0, 1.0]]);
        // Numbers of the products of χ₁ and χ₂ with T and with the flux.
        let of = |i: usize, numbers: [usize; 2], noise: usize| {
            let [one, two] = numbers.map(|number| product(number, noise));
            jacobian[i][0] * one + jacobian[i][1] * two
        };
        let (with_size, with_flux) = ([2, 5], [3, 6]);
        let squares = |noise: usize| {
            let [size2, cross, flux2] = [7, 8, 9].map(|number| product(number, noise));
            [flux2, first * cross, first * first * size2]
        };
        let curved = |noise: usize| {
            let [plus, minus] = sheared.breadth;
            first * sheared.weight * (plus[noise] - minus[noise]) + second * product(7, noise)
        };
        for (k, response) in size_response.iter_mut().enumerate() {
            let [flux2, cross, size2] = squares(k);
            coupling.shear[k] = [
                of(k, with_flux, k),
                first * of(k, with_size, k),
                flux2,
                cross,
                size2,
            ];
            *response -= curved(k);
        }
        let [flux2, cross, size2] = squares(2);
        let [one, two] = [0, 1].map(|i| [of(i, with_flux, 2), first * of(i, with_size, 2)]);
        coupling.turned = [
            one[0],
            one[1],
            two[0],
            two[1],
            flux2,
            cross,
            size2,
            curved(2),
        ];
    }
    Observables {
        flux: found.flux,
        flux_error: found.flux_error,
        size,
        flux_response: found.flux_response,
        size_response,
        coupling,
    }
}
