//! What `shearq bias` does without catalogues: the number of galaxies for an error of m, and example catalogues.

use std::fmt::Write;
use std::fs;
use std::ops::RangeInclusive;
use std::path::Path;

use anyhow::Context;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, Uniform};
use shearq_files::atomic;
use shearq_render::table::{Cell, Table};

// Scatter of a component of e over R that remains in the difference between +γ and −γ, and what makes it. Shape noise of
// 0.26 is that of real galaxies at S/N above 20, 0.14 that of GREAT10. The pixel noise of 0.11 is that of `48/linear/star`
// at S/N 20.
const DESIGNS: [(&str, Scatter); 4] = [
    (
        "other galaxies at −γ, shape noise 0.26",
        Scatter::Shear(0.28),
    ),
    (
        "other galaxies at −γ, shape noise 0.14",
        Scatter::Shear(0.18),
    ),
    ("same galaxies, other pixel noise", Scatter::Shear(0.11)),
    // Measured: m1 ± 0.00072 from 100,000 measurements at ±0.02 (docs/validate-shapes.md), and the same at ±0.05 and ±0.1.
    (
        "same galaxies and same pixel noise",
        Scatter::Response(0.23),
    ),
];

/// What remains in the difference between +γ and −γ of a galaxy.
enum Scatter {
    /// Of e over R.
    Shear(f64),
    /// Of the relative response alone, so that the difference scatters in proportion to γ.
    Response(f64),
}
const SHEARS: [f64; 3] = [0.02, 0.05, 0.1];

// Errors of m for which a plan is useful: 10⁻⁶ takes 5·10¹⁰ to 2·10¹⁴ measurements.
const PLANNED_ERRORS: RangeInclusive<f64> = 1e-6..=1.0;

pub(crate) fn planned_error(text: &str) -> Result<f64, String> {
    let number = text.parse().ok();
    number
        .filter(|error| PLANNED_ERRORS.contains(error))
        .ok_or_else(|| {
            let (low, high) = (PLANNED_ERRORS.start(), PLANNED_ERRORS.end());
            format!("found `{text}`, expected an error of m from {low:e} to {high}")
        })
}

/// How many measurements determine m of a component to `error`: σ(m) = σ/(γ√N), the error of the slope of N points at ±γ.
pub(crate) fn plan(error: f64) -> Table {
    let mut table = Table::titled(format!("Measurements for σ(m) = {error}"));
    table.column("design", "Design", &DESIGNS, |(what, _)| Cell::text(*what));
    table.column("scatter", "σ", &DESIGNS, |(_, scatter)| {
        Cell::text(match scatter {
            Scatter::Shear(scatter) => scatter.to_string(),
            Scatter::Response(scatter) => format!("{scatter} γ"),
        })
    });
    for (key, shear) in ["n_02", "n_05", "n_10"].into_iter().zip(SHEARS) {
        table.column(key, format!("γ = {shear}"), &DESIGNS, |(_, scatter)| {
            let relative = match scatter {
                Scatter::Shear(scatter) => scatter / shear,
                Scatter::Response(scatter) => *scatter,
            };
            Cell::text(format!("{:.1e}", (relative / error).powi(2)))
        });
    }
    table.notes.push(
        "σ(m) = σ/(γ√N) for N measurements of a component at ±γ; a galaxy under both signs counts twice.".into(),
    );
    table
}

const GALAXIES: usize = 20_000;

/// Writes `plus.csv` and `minus.csv`: the same galaxies under (γ, γ) and (−γ, −γ), measured with a known bias.
pub(crate) fn example(folder: &Path) -> anyhow::Result<()> {
    const SHEAR: f64 = 0.02;
    const M: [f64; 2] = [0.01, -0.02];
    const C: [f64; 2] = [0.001, -0.0005];
    fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    for (name, shear) in [("plus", SHEAR), ("minus", -SHEAR)] {
        // One stream for galaxies and one for pixel noise, so that both catalogues have the same galaxies.
        let mut galaxies = ChaCha8Rng::seed_from_u64(1);
        let mut noise = ChaCha8Rng::seed_from_u64(if shear > 0.0 { 2 } else { 3 });
        let normal = |random: &mut ChaCha8Rng| -> f64 { StandardNormal.sample(random) };
        let signal_to_noise = Uniform::new(5.0, 50.0)?;
        let mut text = String::from("id,e1,e2,w,R11,R22,snr,flag,g1,g2\n");
        for id in 0..GALAXIES {
            let snr: f64 = signal_to_noise.sample(&mut galaxies);
            let (mut shapes, mut responses) = ([0.0_f64; 2], [0.0_f64; 2]);
            for k in 0..2 {
                responses[k] = 0.8 + 0.1 * normal(&mut galaxies);
                shapes[k] = 0.2 * normal(&mut galaxies)
                    + 0.01 * normal(&mut noise)
                    + responses[k] * ((1.0 + M[k]) * shear + C[k]);
            }
            let [e1, e2] = shapes;
            let [r1, r2] = responses;
            // 2/S/N: about the error of a component. One row in a hundred failed.
            let weight = 1.0 / (0.2_f64.powi(2) + (2.0_f64 / snr).powi(2));
            let flag = u8::from(id % 100 == 0);
            writeln!(
                text,
                "{id},{e1:.6},{e2:.6},{weight:.4},{r1:.5},{r2:.5},{snr:.3},{flag},{shear},{shear}"
            )?;
        }
        atomic::write(folder.join(format!("{name}.csv")), text.as_bytes())?;
    }
    Ok(())
}
