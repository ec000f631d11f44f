//! m and c of simulated galaxies that are measured with a noisy image of the PSF: the scatter between images that have
//! a star of the same S/N each.
//!
//! `cargo run --release -p shearq-studies --example star_noise -- SET GRID STARS` prints one row per S/N, with GRID
//! galaxies a side and STARS realizations of the noise. m and c are those of galaxies under shears of both signs, with
//! both signs of their intrinsic ellipticities, so that shape noise cancels.
#![expect(clippy::print_stdout, reason = "an example shows what it finds")]

use std::error::Error;

use ndarray::{Array2, Array3, ArrayView3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{
    ArraySource, FunctionalPsf, KnownNoise, Measurer, OneThread, Psfs, Session, Star,
};
use shearq_quantities::Shear;
use shearq_simulate::kinds::SetKind;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{NOISE_SIGMA, STAMP, SetSimulator, SimulationSettings, Version};

// Shear of each component, of either sign.
const SHEAR: f64 = 0.02;

// Galaxies under (γ, γ) and (−γ, −γ).
struct Galaxies {
    sides: [Array3<f32>; 2],
    psf: FunctionalPsf,
}

fn galaxies(set: u32, grid: usize) -> Result<Galaxies, Box<dyn Error>> {
    let kind = SetKind::of(set).ok_or("there is no such set")?;
    let simulator = SetSimulator::new(kind, SimulationSettings::new(33, grid))?;
    let fields = simulator.image_fields(1);
    let mut scratch = RenderScratch::new();
    let sides = [SHEAR, -SHEAR].map(|shear| {
        let mut stamps = Array3::zeros((4 * grid * grid, STAMP, STAMP));
        let mut pixels = vec![0.0; STAMP * STAMP];
        for (k, mut stamp) in stamps.outer_iter_mut().enumerate() {
            // Four versions: of either orientation and sign of the noise.
            let (place, of) = (k / 4, k % 4);
            let (ix, iy) = (place % grid, place / grid);
            let e = fields.intrinsic[(ix, iy)] * [1.0, -1.0][of % 2];
            let version = Version {
                intrinsic: Shear::new(e.re, e.im),
                shear: Shear::new(shear, shear),
                size: 1.0,
                noise: [1.0, -1.0][of / 2],
            };
            simulator.draw_as(&fields, (ix, iy), version, &mut scratch, &mut pixels);
            stamp
                .iter_mut()
                .zip(&pixels)
                .for_each(|(to, from)| *to = *from);
        }
        stamps
    });
    Ok(Galaxies {
        sides,
        psf: *fields.psf.at(0, 0),
    })
}

// m1, m2, c1 and c2.
fn biases(
    measurer: &Measurer,
    galaxies: &Galaxies,
    star: &Array2<f64>,
) -> Result<[f64; 4], Box<dyn Error>> {
    let Star { psf, .. } = Star::cut(star.view(), measurer.configuration().psf_cut())?;
    let psfs = &Psfs::prepared(psf.view());
    let side = |stamps: ArrayView3<'_, f32>| -> Result<_, Box<dyn Error>> {
        let mut source = ArraySource::new(measurer, stamps, psfs)?;
        let noise = KnownNoise::Stated(NOISE_SIGMA);
        let session = Session::open(measurer, &mut source, noise, &OneThread)?;
        let mut worker = measurer.worker();
        Ok(session.image(&mut worker).measure_each(stamps, psfs)?)
    };
    let mut both = side(galaxies.sides[0].view())?;
    let half = both.len();
    both.extend(side(galaxies.sides[1].view())?);
    let sides = both.split_at(half);
    // Galaxies count with all of their versions or not at all.
    let (mut sums, mut responses) = ([[0.0; 2]; 2], [0.0; 2]);
    for (plus, minus) in sides.0.chunks(4).zip(sides.1.chunks(4)) {
        let whole = plus.iter().chain(minus).all(|g| g.flags.is_empty());
        if !whole {
            continue;
        }
        for (sum, versions) in sums.iter_mut().zip([plus, minus]) {
            for galaxy in versions {
                sum[0] += galaxy.e1;
                sum[1] += galaxy.e2;
                let of_galaxy = galaxy.response_diagonal();
                responses = [0, 1].map(|k| responses[k] + of_galaxy[k] / 2.0);
            }
        }
    }
    let m = |k: usize| (sums[0][k] - sums[1][k]) / responses[k] / 2.0 / SHEAR - 1.0;
    let c = |k: usize| (sums[0][k] + sums[1][k]) / responses[k] / 2.0;
    Ok([m(0), m(1), c(0), c(1)])
}

fn noisy(psf: &Array2<f64>, snr: f64, seed: u64) -> Array2<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let sigma = psf.iter().map(|v| v * v).sum::<f64>().sqrt() / snr;
    psf.mapv(|value| {
        let noise: f64 = StandardNormal.sample(&mut rng);
        value + sigma * noise
    })
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [set, grid, stars] = arguments.as_slice() else {
        return Err("expected SET GRID STARS".into());
    };
    let galaxies = galaxies(set.parse()?, grid.parse()?)?;
    let stars: u64 = stars.parse()?;
    let measurer = Measurer::named("48/linear/star", STAMP)?;
    let exact = galaxies.psf.stamp(STAMP);
    println!("| S/N of the star | | m1 | m2 | c1 | c2 |\n|---|---|---|---|---|---|");
    let print = |snr: &str, what: &str, [m1, m2, c1, c2]: [f64; 4]| {
        println!("| {snr} | {what} | {m1:+.4} | {m2:+.4} | {c1:+.4} | {c2:+.4} |");
    };
    print("no noise", "value", biases(&measurer, &galaxies, &exact)?);
    for snr in [20.0, 50.0, 100.0, 200.0, 500.0, 1000.0] {
        let (mut sums, mut squares, mut count) = ([0.0; 4], [0.0; 4], 0.0);
        for star in 0..stars {
            // At low S/N, noise can make a star that no PSF can be taken from.
            let Ok(found) = biases(&measurer, &galaxies, &noisy(&exact, snr, star)) else {
                continue;
            };
            count += 1.0;
            for k in 0..4 {
                sums[k] += found[k];
                squares[k] += found[k] * found[k];
            }
        }
        let mean = sums.map(|sum| sum / count);
        let scatter =
            [0, 1, 2, 3].map(|k| (squares[k] / count - mean[k] * mean[k]).max(0.0).sqrt());
        print(&snr.to_string(), &format!("mean of {count}"), mean);
        print(&snr.to_string(), "scatter", scatter);
    }
    Ok(())
}
