//! What a method found on a stamp becomes the reported ellipticity, with its response, couplings and sheared catalogues.

use shearq_quantities::linear::Symmetric;
use shearq_quantities::{Distortion, Spin2};
use shearq_submissions::{Configuration, EllipticityType, Method};

use crate::measurement::{
    Coupling, Descent, FLUX, Flag, Flags, Measurement, Observables, QUANTITIES, RING,
    ResponseMatrix, SIZE, ShearedCatalogues, VARIABLES, isotropic,
};
use crate::selection::{Matrix, ShearSettings, sheared};
use crate::shape::Size;
use crate::spectral::{Light, NoiseChanges};

/// Results of a method on a stamp.
pub(crate) struct Found {
    pub(super) descent: Descent,
    /// Before saturation.
    pub(super) ellipticity: Result<[f64; 2], Flag>,
    /// Response of the ellipticity, if the method determines it.
    pub(super) response: Option<ResponseMatrix>,
    /// On the galaxies that the method determines it for.
    pub(super) noise_moments: Option<NoiseChanges<NoiseMeans>>,
    pub(super) observables: Option<FoundObservables>,
    pub(super) flux: f64,
    pub(super) radius: f64,
    pub(super) size: f64,
}

/// Flux and size of a galaxy before the PSF.
pub(super) struct FoundObservables {
    pub(super) flux: Light<f64>,
    pub(super) flux_error: f64,
    /// Response of T, from which the size follows.
    pub(super) square_response: [f64; 2],
    pub(super) size: Size,
    pub(super) ring: Light<f64>,
    /// For sheared catalogues, if they are requested.
    pub(super) sheared: Option<ShearSettings>,
}

/// Mean products of the changes of quantities by noise, and mean second derivatives.
#[derive(Default)]
pub(super) struct NoiseMeans {
    /// Of e₁ and e₂ before saturation, the flux, the mean square T from which the size follows, and the ring.
    pub(super) products: Symmetric<QUANTITIES>,
    /// Second derivatives of e₁, e₂ and T.
    pub(super) curvature: [f64; 3],
}

impl NoiseChanges<NoiseMeans> {
    /// Turns both components of e, and both components of the shear that changes the noise.
    fn turn(&mut self, by: &Spin2) {
        let [first, second] = &self.sheared;
        let sheared = [0, 1].map(|k| NoiseMeans {
            products: Symmetric::from_fn(|a, b| {
                by.turn([first.products[[a, b]], second.products[[a, b]]])[k]
            }),
            curvature: [0, 1, 2].map(|a| by.turn([first.curvature[a], second.curvature[a]])[k]),
        });
        self.sheared = sheared;
        let [first, second] = &mut self.sheared;
        for means in [first, second, &mut self.turned, &mut self.plain] {
            let [e1, e2, square] = means.curvature;
            let [e1, e2] = by.turn([e1, e2]);
            means.curvature = [e1, e2, square];
            let columns = [[1.0, 0.0], [0.0, 1.0]].map(|unit| by.turn(unit));
            let matrix = [0, 1].map(|i| columns.map(|column| column[i]));
            means.products = means
                .products
                .transformed(&beside(matrix, [1.0; VARIABLES]));
        }
    }
}

/// How all quantities change with the ellipticity, by a matrix, and with the variables, each by a factor.
fn beside(
    ellipticity: ResponseMatrix,
    variables: [f64; VARIABLES],
) -> [[f64; QUANTITIES]; QUANTITIES] {
    let mut rows = [[0.0; QUANTITIES]; QUANTITIES];
    for (row, of) in rows.iter_mut().zip(ellipticity) {
        row[..2].copy_from_slice(&of);
    }
    for (k, factor) in variables.into_iter().enumerate() {
        rows[2 + k][2 + k] = factor;
    }
    rows
}

impl NoiseMeans {
    /// Mean second derivative of the saturated ellipticity.
    fn curvature(&self, saturation: Saturation, e: [f64; 2]) -> [f64; 2] {
        // With H of `Saturation`, the second derivative by e_j and e_k is 2H′(e_i δ_jk + e_j δ_ik + e_k δ_ij) + 4H″ e_i e_j e_k.
        let [_, first, second] = saturation.factors(e);
        let [p11, p12, p22] = [[0, 0], [0, 1], [1, 1]].map(|pair| self.products[pair]);
        let along = [p11 * e[0] + p12 * e[1], p12 * e[0] + p22 * e[1]];
        let square = along[0] * e[0] + along[1] * e[1];
        // A change of e is like the response to one shear that changes both components.
        let [first_mean, second_mean, _] = self.curvature;
        let change = saturation.response(e, [[first_mean; 2], [second_mean; 2]]);
        [0, 1].map(|i| {
            let turned = e[i] * (p11 + p22) + 2.0 * along[i];
            change[i][i] + 2.0 * first * turned + 4.0 * second * e[i] * square
        })
    }
}

impl Found {
    /// Turns everything that refers to components of shear. It comes before sums over components, which keep only some.
    pub(crate) fn turn(&mut self, by: &Spin2) {
        if let Ok(e) = &mut self.ellipticity {
            *e = by.turn(*e);
        }
        if let Some(response) = &mut self.response {
            *response = by.turn_response(*response);
        }
        if let Some(noise) = &mut self.noise_moments {
            noise.turn(by);
        }
        if let Some(found) = &mut self.observables {
            for response in [
                &mut found.flux.response,
                &mut found.square_response,
                &mut found.ring.response,
            ] {
                *response = by.turn(*response);
            }
        }
    }

    /// The measurement, before calibration.
    pub(crate) fn measurement(&self, saturation: Saturation, noise: f64) -> Measurement {
        let measured = Measurement {
            descent: Some(self.descent),
            noise,
            flux: self.flux,
            radius: self.radius,
            size: self.size,
            ..Measurement::flagged(Flag::NoShear)
        };
        let (e, response) = match self.saturated(saturation) {
            Ok(found) => found,
            Err(flag) => {
                return Measurement {
                    flags: flag.into(),
                    ..measured
                };
            }
        };
        let noise = self.noise(saturation);
        let observables = self.observables(noise.as_ref());
        let pair = observables.as_ref().zip(response);
        Measurement {
            e1: e[0],
            e2: e[1],
            flags: Flags::NONE,
            // Sheared catalogues may be cut by e, and need all of R.
            response: response.map(|[[r11, _], [_, r22]]| isotropic(r11 + r22)),
            e_variance: noise
                .as_ref()
                .map_or([0.0; 2], |noise| [0, 1].map(|k| noise.plain[[k, k]])),
            observables,
            sheared: pair.and_then(|(observables, response)| {
                self.sheared_catalogues(noise.unwrap_or_default(), e, response, observables)
            }),
            ..measured
        }
    }

    /// The saturated ellipticity, and its response if the method determines it.
    fn saturated(
        &self,
        saturation: Saturation,
    ) -> Result<([f64; 2], Option<ResponseMatrix>), Flag> {
        let plain = self.ellipticity?;
        let [factor, ..] = saturation.factors(plain);
        let mut e = plain.map(|e| e * factor);
        let mut response = self.response.map(|r| saturation.response(plain, r));
        if let Some(noise) = &self.noise_moments {
            let [first, second] = &noise.sheared;
            let of_shear = [first, second].map(|means| means.curvature(saturation, plain));
            for (i, row) in response.iter_mut().flatten().enumerate() {
                *row = [0, 1].map(|k| row[k] - of_shear[k][i]);
            }
            let turned = noise.turned.curvature(saturation, plain);
            e = [0, 1].map(|i| e[i] + 0.5 * turned[i]);
        }
        Ok((e, response))
    }

    /// Mean products of the changes by noise of the saturated ellipticity, flux, size and ring.
    fn noise(&self, saturation: Saturation) -> Option<NoiseChanges<Symmetric<QUANTITIES>>> {
        let (plain, found) = (self.ellipticity.ok()?, self.observables.as_ref()?);
        let of_e = saturation.response(plain, [[1.0, 0.0], [0.0, 1.0]]);
        let rows = beside(of_e, [1.0, found.size.slope, 1.0]);
        let noise = self.noise_moments.as_ref()?;
        Some(noise.map(|means| means.products.transformed(&rows)))
    }

    /// Flux and size with their couplings to the saturated ellipticity by `noise`.
    fn observables(
        &self,
        noise: Option<&NoiseChanges<Symmetric<QUANTITIES>>>,
    ) -> Option<Observables> {
        let found = self.observables.as_ref()?;
        let Size {
            px: size,
            slope,
            curvature,
        } = found.size;
        let mut size_response = found.square_response.map(|response| slope * response);
        let mut coupling = Coupling::default();
        if let Some((noise, means)) = noise.zip(self.noise_moments.as_ref()) {
            // The size is not linear in T, and T not in the autocorrelation.
            let change_of_size = |means: &NoiseMeans| {
                let [.., of_square] = means.curvature;
                slope * of_square + curvature * means.products[[2 + SIZE; 2]]
            };
            for (response, means) in size_response.iter_mut().zip(&means.sheared) {
                *response -= change_of_size(means);
            }
            let variables: [usize; VARIABLES] = [FLUX, SIZE, RING];
            let with_e = |products: &Symmetric<QUANTITIES>, k: usize| {
                variables.map(|v| products[[k, 2 + v]])
            };
            let among = |products: &Symmetric<QUANTITIES>| {
                variables.map(|a| variables.map(|b| products[[2 + a, 2 + b]]))
            };
            coupling = Coupling {
                sheared_e: [0, 1].map(|k| with_e(&noise.sheared[k], k)),
                sheared: noise.sheared.each_ref().map(among),
                turned_e: [0, 1].map(|k| with_e(&noise.turned, k)),
                turned: among(&noise.turned),
                turned_size: change_of_size(&means.turned),
            };
        }
        Some(Observables {
            flux: found.flux.value,
            flux_error: found.flux_error,
            size,
            flux_response: found.flux.response,
            size_response,
            ring: found.ring.value,
            ring_response: found.ring.response,
            coupling,
        })
    }

    /// The galaxy as it would be measured under small shears; `None` if that is not requested. In the rare case that the
    /// effect of noise is unknown, it is not corrected.
    fn sheared_catalogues(
        &self,
        noise: NoiseChanges<Symmetric<QUANTITIES>>,
        e: [f64; 2],
        response: ResponseMatrix,
        observables: &Observables,
    ) -> Option<ShearedCatalogues> {
        let settings = self.observables.as_ref()?.sheared?;
        let noise = noise.map(|products| -> Matrix {
            std::array::from_fn(|a| std::array::from_fn(|b| products[[a, b]]))
        });
        let Observables {
            flux_response,
            size_response,
            ..
        } = *observables;
        let size = observables.size + 0.5 * observables.coupling.turned_size;
        let values = [e[0], e[1], observables.flux, size];
        let derivatives = [0, 1].map(|k| {
            let [e1, e2] = [response[0][k], response[1][k]];
            [e1, e2, flux_response[k], size_response[k]]
        });
        let catalogues = |noise: &_| sheared(values, derivatives, noise, &settings);
        Some(ShearedCatalogues {
            each: catalogues(&noise).or_else(|| catalogues(&NoiseChanges::default()))?,
            flux_error: observables.flux_error,
        })
    }
}

/// What is reported of an ellipticity e: e H(|e|²), H(v) = (1 + v/a²)^(−1/2), with the modulus a; a = 0 to report e.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Saturation(f64);

impl Saturation {
    pub(crate) fn of(configuration: &Configuration) -> Self {
        Saturation(match &configuration.method {
            Method::Network(_) | Method::Detection { .. } => 0.0,
            Method::Linear(linear) => linear.shape.saturation,
        })
    }

    /// H and its first and second derivative.
    fn factors(self, [e1, e2]: [f64; 2]) -> [f64; 3] {
        let Saturation(modulus) = self;
        if modulus == 0.0 {
            return [1.0, 0.0, 0.0];
        }
        let per_square = modulus.powi(-2);
        let h = (1.0 + (e1 * e1 + e2 * e2) * per_square).sqrt().recip();
        [
            h,
            -0.5 * per_square * h.powi(3),
            0.75 * per_square * per_square * h.powi(5),
        ]
    }

    /// The response of what is reported, from that of e: its derivative with e_j is H δ_ij + 2H′ e_i e_j.
    fn response(self, [e1, e2]: [f64; 2], r: ResponseMatrix) -> ResponseMatrix {
        let [h, first, _] = self.factors([e1, e2]);
        let cross = |a: f64, b: f64| 2.0 * first * a * b;
        let (own1, own2, other) = (h + cross(e1, e1), h + cross(e2, e2), cross(e1, e2));
        [
            [0, 1].map(|j| own1 * r[0][j] + other * r[1][j]),
            [0, 1].map(|j| own2 * r[1][j] + other * r[0][j]),
        ]
    }
}

/// The components of an ellipticity of this type; none has a distortion above 1 as a shear.
pub(super) fn components(chi: Distortion, kind: EllipticityType) -> Result<[f64; 2], Flag> {
    match kind {
        EllipticityType::Distortion => Ok([chi.e1, chi.e2]),
        EllipticityType::Shear => {
            let shear = chi.to_shear().ok_or(Flag::NoShear)?;
            Ok([shear.e1, shear.e2])
        }
    }
}

#[cfg(test)]
mod tests {
    use shearq_quantities::Jacobian;

    use super::*;
    use crate::measurement::Stop;
    use crate::testing::close;

    /// Numbers without a pattern, small enough for an ellipticity.
    fn numbers(state: &mut f64) -> f64 {
        *state = (*state * 78.233).sin();
        0.3 * *state
    }

    fn means(next: &mut impl FnMut() -> f64) -> NoiseMeans {
        let values: [f64; 25] = std::array::from_fn(|_| next());
        NoiseMeans {
            products: Symmetric::from_fn(|a, b| values[5 * a + b]),
            curvature: [next(), next(), next()],
        }
    }

    fn found() -> Found {
        let mut state = 0.37;
        let mut next = || numbers(&mut state);
        let [e1, e2] = [next(), next()];
        let [r11, r12, r21, r22] = [next(), next(), next(), next()];
        Found {
            descent: Descent {
                iterations: 1,
                stop: Stop::Stable,
                first_energy: 0.0,
                energy: 0.0,
                updated: 0,
            },
            ellipticity: Ok([e1, e2]),
            response: Some([[r11, r12], [r21, r22]]),
            noise_moments: Some(NoiseChanges {
                sheared: [means(&mut next), means(&mut next)],
                turned: means(&mut next),
                plain: means(&mut next),
            }),
            observables: Some(FoundObservables {
                flux: Light {
                    value: 10.0,
                    response: [0.3, -0.1],
                },
                flux_error: 1.0,
                square_response: [0.2, 0.5],
                size: Size {
                    px: 2.0,
                    slope: 0.4,
                    curvature: -0.1,
                },
                ring: Light {
                    value: 1.5,
                    response: [0.6, -0.4],
                },
                sheared: Some(ShearSettings {
                    step: 0.02,
                    normals: [0.0; 4],
                }),
            }),
            flux: 10.0,
            radius: 1.0,
            size: 2.0,
        }
    }

    const SATURATIONS: [Saturation; 2] = [Saturation(0.0), Saturation(0.4)];

    #[test]
    fn saturation_has_its_derivatives() {
        let saturation = SATURATIONS[1];
        for u in [0.04f64, 0.3, 1.7] {
            let at = |u: f64| saturation.factors([u.sqrt() * 0.6, u.sqrt() * 0.8]);
            let step = 1e-5;
            let ([plus, first, ..], [minus, first_before, ..]) = (at(u + step), at(u - step));
            let [_, slope, curvature] = at(u);
            // Truncation and rounding of differences.
            let slopes = [plus - minus, first - first_before].map(|apart| apart / (2.0 * step));
            assert!((slopes[0] - slope).abs() < 1e-6, "{u}");
            assert!((slopes[1] - curvature).abs() < 1e-5 * (1.0 + curvature.abs()));
        }
        let [half, ..] = saturation.factors([0.0, 0.4]);
        assert!((half - 0.5f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn noise_of_saturated_ellipticities_follows_its_derivatives() {
        let (saturation, galaxy) = (SATURATIONS[1], found());
        let e = galaxy.ellipticity.unwrap();
        let slope = |of: &dyn Fn([f64; 2]) -> [f64; 2], k: usize| {
            let step = 1e-4;
            let [plus, minus] = [step, -step].map(|by| {
                let mut moved = e;
                moved[k] += by;
                of(moved)
            });
            [0, 1].map(|i| (plus[i] - minus[i]) / (2.0 * step))
        };
        let saturated = |e: [f64; 2]| e.map(|component| component * saturation.factors(e)[0]);
        let columns = [0, 1].map(|j| slope(&saturated, j));
        let column = |e, j: usize| {
            saturation
                .response(e, [[1.0, 0.0], [0.0, 1.0]])
                .map(|row| row[j])
        };
        // Of e_j and e_k.
        let bent = [0, 1].map(|j| [0, 1].map(|k| slope(&|e| column(e, j), k)));
        let products = |means: &NoiseMeans| [0, 1].map(|j| [0, 1].map(|k| means.products[[j, k]]));
        let curvature = |means: &NoiseMeans| {
            let p = products(means);
            [0, 1].map(|i| {
                let pairs = (0..2).flat_map(|j| (0..2).map(move |k| [j, k]));
                let linear = (0..2)
                    .map(|j| columns[j][i] * means.curvature[j])
                    .sum::<f64>();
                linear + pairs.map(|[j, k]| p[j][k] * bent[j][k][i]).sum::<f64>()
            })
        };
        let noise = galaxy.noise_moments.as_ref().unwrap();
        let [own, turned] = [saturated(e), curvature(&noise.turned)];
        let ([e1, e2], response) = galaxy.saturated(saturation).unwrap();
        let (r, p) = (galaxy.response.unwrap(), products(&noise.plain));
        let variance = galaxy.measurement(saturation, 1.0).e_variance;
        for i in 0..2 {
            // Truncation of differences.
            close([e1, e2][i], own[i] + 0.5 * turned[i], 1e-6);
            let mut expected = 0.0;
            for j in 0..2 {
                let by_shear = columns[0][i] * r[0][j] + columns[1][i] * r[1][j];
                let noisy = curvature(&noise.sheared[j])[i];
                close(response.unwrap()[i][j], by_shear - noisy, 1e-6);
                for k in 0..2 {
                    expected += columns[j][i] * p[j][k] * columns[k][i];
                }
            }
            close(variance[i], expected, 1e-6);
        }
    }

    #[test]
    fn noise_that_is_sheared_along_is_taken_out_of_the_size() {
        let galaxy = found();
        let (own, noise) = (
            galaxy.observables.as_ref().unwrap(),
            galaxy.noise_moments.as_ref().unwrap(),
        );
        let found = galaxy.measurement(SATURATIONS[0], 1.0).observables.unwrap();
        let (first, second) = (own.size.slope, own.size.curvature);
        for k in 0..2 {
            let means = &noise.sheared[k];
            // Of a function of T, of which the mean of the second derivative and of the squared change are known.
            let by_noise = first * means.curvature[2] + second * means.products[[2 + SIZE; 2]];
            close(
                found.size_response[k],
                first * own.square_response[k] - by_noise,
                1e-12,
            );
        }
    }

    #[test]
    fn turned_galaxies_turn_all_that_refers_to_shear() {
        // A rotation by 90° changes the signs of spin-2 components and of nothing else; a reflection those of e2 and γ2.
        let quarter = [[0.0, -1.0], [1.0, 0.0]];
        let mirror = [[-1.0, 0.0], [0.0, 1.0]];
        for saturation in SATURATIONS {
            let plain = found().measurement(saturation, 1.0);
            for (matrix, signs) in [(quarter, [-1.0, -1.0]), (mirror, [1.0, -1.0])] {
                let (orientation, _) = Jacobian::new(matrix).unwrap().factors();
                let mut turned = found();
                turned.turn(&orientation.spin2());
                let turned = turned.measurement(saturation, 1.0);
                let expected = expected(&plain, signs);
                assert_eq!(all(&turned).len(), expected.len());
                for (at, (found, expected)) in all(&turned).iter().zip(&expected).enumerate() {
                    assert!((found - expected).abs() < 1e-12, "{at}: {found} {expected}");
                }
            }
            // A rotation by 45°, in two steps, exchanges components: e1 becomes e2, and what γ1 does is done by γ2.
            let (sin, cos) = (std::f64::consts::PI / 8.0).sin_cos();
            let (orientation, _) = Jacobian::new([[cos, -sin], [sin, cos]]).unwrap().factors();
            let mut turned = found();
            turned.turn(&orientation.spin2());
            turned.turn(&orientation.spin2());
            let turned = turned.measurement(saturation, 1.0);
            assert!((turned.e2 - plain.e1).abs() < 1e-12 && (turned.e1 + plain.e2).abs() < 1e-12);
            let [one, two] = [&plain, &turned].map(|galaxy| galaxy.observables.unwrap());
            let close = |found: &[f64], expected: &[f64], sign: f64| {
                let mut pairs = found.iter().zip(expected);
                assert!(pairs.all(|(a, b)| (a - sign * b).abs() < 1e-12));
            };
            // Of e1 with γ1 and e2 with γ2, both signs change or none.
            for (k, sign) in [(0, 1.0), (1, -1.0)] {
                let [one, two] = [(&one.coupling, k), (&two.coupling, 1 - k)];
                close(
                    two.0.sheared[two.1].as_flattened(),
                    one.0.sheared[one.1].as_flattened(),
                    sign,
                );
                close(&two.0.sheared_e[two.1], &one.0.sheared_e[one.1], 1.0);
            }
        }
    }

    fn all(galaxy: &Measurement) -> Vec<f64> {
        let [[r11, r12], [r21, r22]] = galaxy.response.unwrap();
        let mut all = vec![galaxy.e1, galaxy.e2, r11, r12, r21, r22];
        all.extend(galaxy.observables.unwrap().to_array());
        for sheared in galaxy.sheared.unwrap().each {
            all.extend([sheared.e1, sheared.e2, sheared.flux, sheared.size]);
        }
        all
    }

    /// The galaxy with other signs of spin-2 components.
    fn expected(plain: &Measurement, [one, two]: [f64; 2]) -> Vec<f64> {
        let mut galaxy = *plain;
        (galaxy.e1, galaxy.e2) = (one * galaxy.e1, two * galaxy.e2);
        let [[_, r12], [r21, _]] = galaxy.response.as_mut().unwrap();
        (*r12, *r21) = (one * two * *r12, one * two * *r21);
        let observables = galaxy.observables.as_mut().unwrap();
        for response in [
            &mut observables.flux_response,
            &mut observables.size_response,
            &mut observables.ring_response,
        ] {
            *response = [one * response[0], two * response[1]];
        }
        let Coupling {
            sheared, turned_e, ..
        } = &mut observables.coupling;
        for (k, sign) in [one, two].into_iter().enumerate() {
            let products = sheared[k].as_flattened_mut().iter_mut();
            products
                .chain(&mut turned_e[k])
                .for_each(|value| *value *= sign);
        }
        let sheared = galaxy.sheared.as_mut().unwrap();
        // Catalogues noshear, 1p, 1m, 2p, 2m: a negative sign exchanges p and m.
        let each = &mut sheared.each;
        if one < 0.0 {
            each.swap(1, 2);
        }
        if two < 0.0 {
            each.swap(3, 4);
        }
        for sheared in each {
            (sheared.e1, sheared.e2) = (one * sheared.e1, two * sheared.e2);
        }
        all(&galaxy)
    }
}
