//! m and c of simulated galaxies that are measured with a PSF image with errors: noise, a background, another pixel
//! scale, an offset, a small stamp.
//!
//! `cargo run --release -p shearq-studies --example wrong_psfs -- CASES SETS GRID STARS`, where CASES is `noise`, `stars`
//! (a noisy star per galaxy), `background`, `sampling`, `centre`, `size` or `narrow`, SETS a set or several with commas, GRID the galaxies a side and
//! STARS the realizations of a star's noise. Prints one row per case: means over galaxies under shears of both signs,
//! with both signs of their intrinsic ellipticities, so that shape noise cancels.
#![expect(clippy::print_stdout, reason = "an example shows what it finds")]

use std::error::Error;

use ndarray::{Array2, Array3, ArrayView3, Axis};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{
    ArraySource, Examination, FunctionalPsf, KnownNoise, Measurer, OneThread, Psfs, Session, Star,
    Warning,
};
use shearq_quantities::Shear;
use shearq_simulate::kinds::SetKind;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{NOISE_SIGMA, STAMP, SetSimulator, SimulationSettings, Version};

/// Shear of each component, of either sign.
const SHEAR: f64 = 0.02;

/// Galaxies under (γ, γ) and (−γ, −γ).
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

/// m1, m2, c1, c2 and the share that is flagged.
fn measured(
    measurer: &Measurer,
    galaxies: &Galaxies,
    star: &Array2<f64>,
) -> Result<[f64; 5], Box<dyn Error>> {
    let Star { psf, .. } = Star::cut(star.view(), measurer.configuration().psf_cut())?;
    measured_with(measurer, galaxies, &Psfs::prepared(psf.view()))
}

/// The same with any PSFs.
fn measured_with(
    measurer: &Measurer,
    galaxies: &Galaxies,
    psfs: &Psfs<'_>,
) -> Result<[f64; 5], Box<dyn Error>> {
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
    shearq_measure::calibrate(measurer.configuration(), &mut both);
    let sides = both.split_at(half);
    // Galaxies count with all of their versions or not at all.
    let (mut sums, mut count, mut lost) = ([[0.0; 2]; 2], 0.0, 0.0);
    for (plus, minus) in sides.0.chunks(4).zip(sides.1.chunks(4)) {
        let whole = plus.iter().chain(minus).all(|g| g.flags.is_empty());
        if !whole {
            lost += 1.0;
            continue;
        }
        count += 4.0;
        for (sum, versions) in sums.iter_mut().zip([plus, minus]) {
            for galaxy in versions {
                sum[0] += galaxy.e1;
                sum[1] += galaxy.e2;
            }
        }
    }
    let m = |k: usize| (sums[0][k] - sums[1][k]) / count / 2.0 / SHEAR - 1.0;
    let c = |k: usize| (sums[0][k] + sums[1][k]) / count / 2.0;
    let all = lost + count / 4.0;
    Ok([m(0), m(1), c(0), c(1), lost / all])
}

/// The warnings about a PSF.
fn warned(measurer: &Measurer, galaxies: &Galaxies, star: &Array2<f64>) -> Vec<Warning> {
    let stamps = galaxies.sides[0].view();
    let mut examination = Examination::new(STAMP, stamps.len_of(Axis(0)));
    for stamp in stamps.outer_iter().take(1000) {
        if let Err(error) = examination.add(stamp) {
            println!("{error}");
        }
    }
    let psf = Psfs::star(star.view());
    examination.add_psfs(&psf, measurer.configuration().psf_cut(), 1);
    examination.warnings()
}

fn noisy(psf: &Array2<f64>, snr: f64, rng: &mut ChaCha8Rng) -> Array2<f64> {
    let sigma = psf.iter().map(|v| v * v).sum::<f64>().sqrt() / snr;
    psf.mapv(|value| {
        let noise: f64 = StandardNormal.sample(rng);
        value + sigma * noise
    })
}

/// `psf` drawn off the middle.
fn drawn(psf: &FunctionalPsf, side: usize, [dx, dy]: [f64; 2]) -> Array2<f64> {
    let mut stamp = Array2::zeros((side, side));
    let middle = (side as f64 - 1.0) / 2.0;
    psf.draw_into(middle + dx, middle + dy, stamp.view_mut());
    stamp
}

#[allow(clippy::too_many_lines, reason = "one block per kind of error")]
fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [cases, sets, grid, stars] = arguments.as_slice() else {
        return Err("expected CASES SETS GRID STARS".into());
    };
    let (grid, stars): (usize, u64) = (grid.parse()?, stars.parse()?);
    for set in sets.split(',') {
        let galaxies = galaxies(set.parse()?, grid)?;
        let psf = galaxies.psf;
        let measurer = Measurer::named("48/linear/star", STAMP)?;
        let print = |name: &str, found: [f64; 5]| {
            let [m1, m2, c1, c2, lost] = found;
            println!("| {set} | {name} | {m1:+.4} | {m2:+.4} | {c1:+.4} | {c2:+.4} | {lost:.3} |");
        };
        let one = |name: &str, star: &Array2<f64>| {
            match measured(&measurer, &galaxies, star) {
                Ok(found) => print(name, found),
                Err(error) => println!("| {set} | {name} | {error} |"),
            }
            for warning in warned(&measurer, &galaxies, star) {
                println!("    {warning}");
            }
        };
        let middle = psf.stamp(STAMP);
        let peak = middle.iter().copied().fold(0.0, f64::max);
        one("none", &middle);
        let wide = |factor: f64| FunctionalPsf {
            fwhm: psf.fwhm * factor,
            ..psf
        };
        match cases.as_str() {
            "noise" => {
                for snr in [20.0, 50.0, 100.0, 200.0, 500.0, 1000.0] {
                    let (mut sums, mut squares, mut count) = ([0.0; 5], [0.0; 5], 0.0);
                    for star in 0..stars {
                        let mut rng = ChaCha8Rng::seed_from_u64(star);
                        let found = measured(&measurer, &galaxies, &noisy(&middle, snr, &mut rng));
                        let Ok(found) = found else { continue };
                        count += 1.0;
                        for k in 0..5 {
                            sums[k] += found[k];
                            squares[k] += found[k] * found[k];
                        }
                    }
                    let mean = sums.map(|sum| sum / count);
                    print(&format!("S/N {snr}: mean of {count}"), mean);
                    let scatter = [0, 1, 2, 3, 4]
                        .map(|k| (squares[k] / count - mean[k] * mean[k]).max(0.0).sqrt());
                    print(&format!("S/N {snr}: scatter"), scatter);
                }
            }
            "stars" => {
                for snr in [50.0, 100.0, 200.0, 1000.0] {
                    let (mut sums, mut squares) = ([0.0; 5], [0.0; 5]);
                    for seed in 0..stars {
                        let mut rng = ChaCha8Rng::seed_from_u64(seed);
                        // One for all versions of a galaxy.
                        let mut own = Array3::zeros((4 * grid * grid, STAMP, STAMP));
                        for mut versions in own.axis_chunks_iter_mut(Axis(0), 4) {
                            versions.assign(&noisy(&middle, snr, &mut rng));
                        }
                        let found = measured_with(&measurer, &galaxies, &Psfs::stars(own.view()))?;
                        for k in 0..5 {
                            sums[k] += found[k] / stars as f64;
                            squares[k] += found[k] * found[k] / stars as f64;
                        }
                    }
                    print(&format!("S/N {snr}, one each: mean of {stars}"), sums);
                    let scatter =
                        [0, 1, 2, 3, 4].map(|k| (squares[k] - sums[k] * sums[k]).max(0.0).sqrt());
                    print(&format!("S/N {snr}, one each: scatter"), scatter);
                }
            }
            "background" => {
                for share in [-0.01, -0.001, 0.0003, 0.001, 0.003, 0.01, 0.05, 0.2] {
                    one(
                        &format!("plus {share} of the peak"),
                        &(&middle + share * peak),
                    );
                }
                for share in [0.001, 0.003, 0.01, 0.03, 0.1] {
                    let gradient = Array2::from_shape_fn(middle.dim(), |(_, x)| {
                        share * peak * (x as f64 - 23.5) / 23.5
                    });
                    one(
                        &format!("gradient to {share} of the peak"),
                        &(&middle + &gradient),
                    );
                }
            }
            "sampling" => {
                for factor in [
                    0.5, 0.7, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4, 1.5, 2.0,
                ] {
                    one(
                        &format!("{factor} times as wide"),
                        &wide(factor).stamp(STAMP),
                    );
                }
            }
            "centre" => {
                for off in [
                    [0.4, 0.0],
                    [1.0, 0.0],
                    [1.5, -0.7],
                    [3.0, 0.0],
                    [2.6, -2.4],
                    [5.0, 4.0],
                    [10.0, 3.0],
                ] {
                    one(&format!("off by {off:?} px"), &drawn(&psf, STAMP, off));
                }
            }
            "narrow" => {
                for fwhm in [0.01, 0.5, 0.8, 1.0, 1.2, 1.4, 1.7] {
                    let narrow = FunctionalPsf { fwhm, ..psf };
                    one(&format!("FWHM {fwhm} px"), &narrow.stamp(STAMP));
                }
            }
            "size" => {
                for size in [12, 16, 20, 24, 28, 32, 40] {
                    let mut configuration = measurer.configuration().clone();
                    configuration.psf.size = size;
                    let found = Measurer::new(&configuration, STAMP)
                        .map_err(Box::<dyn Error>::from)
                        .and_then(|cut| measured(&cut, &galaxies, &middle));
                    match found {
                        Ok(found) => print(&format!("psf.size {size}"), found),
                        Err(error) => println!("| {set} | psf.size {size} | {error} |"),
                    }
                }
            }
            _ => {
                return Err(
                    "CASES: expected noise, stars, background, sampling, centre, narrow or size"
                        .into(),
                );
            }
        }
    }
    Ok(())
}
