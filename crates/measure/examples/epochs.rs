//! Noise and m of galaxies on 16 epochs of S/N 5, against one stamp of S/N 20: `epochs GALAXIES SEED`.
//!
//! Gaussian galaxies come in fours, turned by 45 degrees each, under shears of ±0.02 with the same noise, added and taken away.
//! `plain` epochs have one PSF and depth; the others differ in both, `turned` ones in rotation and dither, too. `equal` weighs
//! epochs of different depths and PSFs as if they were alike.

#![expect(
    clippy::print_stdout,
    clippy::too_many_lines,
    reason = "a study that is read from top to bottom"
)]

use std::error::Error;
use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::ndarray::Array2;
use shearq_measure::{Epoch, ImageNoise, Jacobian, Measurer, Shear};

const N: usize = 48;
const EPOCHS: usize = 16;
const SHEAR: f64 = 0.02;
const SNR: f64 = 20.0;

type Matrix = [[f64; 2]; 2];

/// Moments (xx, xy, yy) of a circle of this variance under a shear.
fn moments(variance: f64, shear: Shear) -> [f64; 3] {
    let [[a, b], [c, d]] = shear.matrix();
    [a * a + b * b, a * c + b * d, c * c + d * d].map(|of| variance * of)
}

fn gaussian(n: usize, [xx, xy, yy]: [f64; 3], frame: Matrix, offset: [f64; 2]) -> Array2<f64> {
    let area = xx * yy - xy * xy;
    let middle = (n as f64 - 1.0) / 2.0;
    Array2::from_shape_fn((n, n), |(y, x)| {
        let (x, y) = (x as f64 - middle - offset[0], y as f64 - middle - offset[1]);
        let [u, v] = frame.map(|[along, across]| along * x + across * y);
        let square = (yy * u * u - 2.0 * xy * u * v + xx * v * v) / area;
        (-0.5 * square).exp() / (std::f64::consts::TAU * area.sqrt())
    })
}

struct Exposure {
    star: [f64; 3],
    frame: Matrix,
    offset: [f64; 2],
    /// In units of the level that all epochs would have.
    depth: f64,
    psf: Array2<f64>,
}

fn exposure(rng: &mut ChaCha8Rng, differ: bool, turned: bool) -> Exposure {
    let mut within = |most: f64| rng.random_range(-most..most);
    let (size, e, depth) = (within(0.3), [within(0.07), within(0.07)], within(0.7));
    let (angle, offset) = (within(3.0), [within(0.5), within(0.5)]);
    let (sin, cos) = angle.sin_cos();
    let star = match differ {
        true => moments(2.2 * (1.0 + size), Shear::new(e[0], e[1])),
        false => moments(2.2, Shear::new(0.03, -0.02)),
    };
    let frame = if turned {
        [[cos, -sin], [sin, cos]]
    } else {
        [[1.0, 0.0], [0.0, 1.0]]
    };
    Exposure {
        psf: gaussian(40, star, frame, [0.0; 2]),
        star,
        frame,
        offset: if turned { offset } else { [0.0; 2] },
        depth: if differ { depth.exp() } else { 1.0 },
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1).map(|word| word.parse::<u64>());
    let (count, seed) = (
        arguments.next().unwrap_or(Ok(400))?,
        arguments.next().unwrap_or(Ok(1))?,
    );
    let measurer = Measurer::named("48/linear/star", N)?;
    let mut worker = measurer.worker();
    for (case, differ, turned, equal) in [
        ("one", false, false, false),
        ("plain", false, false, false),
        ("depths", true, false, false),
        ("equal", true, false, true),
        ("turned", true, true, false),
    ] {
        // The same galaxies in all cases.
        let mut shapes = ChaCha8Rng::seed_from_u64(seed);
        let mut rng = ChaCha8Rng::seed_from_u64(seed + 1000);
        let epochs = if case == "one" { 1 } else { EPOCHS };
        // Of each four: Σ (e₊ − e₋)/(2 γ), ΣR, and squares of changes by noise.
        let (mut fours, mut scatter) = (Vec::new(), [0.0; 2]);
        let (mut spent, mut measured) = (0.0, 0);
        for _ in 0..count / 4 {
            let modulus = shapes.random_range(0.05..0.35);
            let variance = shapes.random_range(4.0..12.0);
            let mut four = [0.0; 2];
            for turn in 0..4 {
                let angle = f64::from(turn) * std::f64::consts::FRAC_PI_2;
                let exposures: Vec<Exposure> = (0..epochs)
                    .map(|_| exposure(&mut rng, differ, turned))
                    .collect();
                // Σ S²/σ² = SNR².
                let own = Shear::new(modulus * angle.cos(), modulus * angle.sin());
                let images = [1.0, -1.0].map(|sign| {
                    let intrinsic = moments(variance, own);
                    let [[a, b], [c, d]] = Shear::new(sign * SHEAR, 0.0).matrix();
                    let [xx, xy, yy] = intrinsic;
                    let sheared = [
                        a * a * xx + 2.0 * a * b * xy + b * b * yy,
                        a * c * xx + (a * d + b * c) * xy + b * d * yy,
                        c * c * xx + 2.0 * c * d * xy + d * d * yy,
                    ];
                    let image = |of: &Exposure| {
                        let all = [0, 1, 2].map(|k| sheared[k] + of.star[k]);
                        gaussian(N, all, of.frame, of.offset)
                    };
                    exposures.iter().map(image).collect::<Vec<_>>()
                });
                let power: f64 = images[0]
                    .iter()
                    .zip(&exposures)
                    .map(|(image, of)| image.iter().map(|v| v * v).sum::<f64>() / of.depth.powi(2))
                    .sum();
                let level = power.sqrt() / SNR;
                let noises: Vec<Array2<f64>> = exposures
                    .iter()
                    .map(|of| {
                        Array2::from_shape_fn((N, N), |_| {
                            let number: f64 = StandardNormal.sample(&mut rng);
                            level * of.depth * number
                        })
                    })
                    .collect();
                let mut found = [[[0.0; 2]; 2]; 2];
                for (shear, images) in images.iter().enumerate() {
                    for (side, sign) in [1.0, -1.0].into_iter().enumerate() {
                        let stamps: Vec<Array2<f64>> = images
                            .iter()
                            .zip(&noises)
                            .map(|(image, noise)| image + &(noise * sign))
                            .collect();
                        let mut list = Vec::new();
                        for (stamp, of) in stamps.iter().zip(&exposures) {
                            let depth = if equal { 1.0 } else { of.depth };
                            list.push(Epoch {
                                stamp: stamp.view(),
                                psf: of.psf.view(),
                                noise: level * depth,
                                jacobian: Some(Jacobian::new(of.frame)?),
                                offset: of.offset,
                                survey: None,
                                gain: None,
                            });
                        }
                        let mut image = worker.image(ImageNoise::Unknown);
                        let start = Instant::now();
                        let galaxy = image.measure_epochs(&list)?;
                        spent += start.elapsed().as_secs_f64();
                        measured += epochs;
                        let response = galaxy.response.map_or(f64::NAN, |response| response[0][0]);
                        found[shear][side] = [galaxy.e1, response];
                    }
                }
                let [[plus, plus_minus], [minus, minus_minus]] = found;
                four[0] += (plus[0] + plus_minus[0] - minus[0] - minus_minus[0]) / (4.0 * SHEAR);
                four[1] += (plus[1] + plus_minus[1] + minus[1] + minus_minus[1]) / 4.0;
                if (plus[0] - plus_minus[0]).is_finite() {
                    scatter[0] += (0.5 * (plus[0] - plus_minus[0])).powi(2);
                    scatter[1] += 1.0;
                }
            }
            fours.push(four);
        }
        fours.retain(|four| four.iter().all(|value| value.is_finite()));
        let number = fours.len() as f64;
        let mean = [0, 1].map(|k| fours.iter().map(|four| four[k]).sum::<f64>() / number);
        let m = mean[0] / mean[1] - 1.0;
        let shares = fours
            .iter()
            .map(|[change, response]| change - (1.0 + m) * response);
        let error = shares.map(|share| share * share).sum::<f64>().sqrt() / number / mean[1];
        let noise = (scatter[0] / scatter[1]).sqrt() / (mean[1] / 4.0);
        println!(
            "{case:8} noise {noise:.4} ± {:.4}  m {:+.2} ± {:.2} (1e-3)  {:.0} µs per epoch",
            noise / (2.0 * scatter[1]).sqrt(),
            1e3 * m,
            1e3 * error,
            1e6 * spent / f64::from(measured as u32)
        );
    }
    Ok(())
}
