//! Submissions held against each other and against what can be reached: scatter, bias, Q and cost.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shearq_submissions::Submission;

use super::bias::{Bias, biases};
use super::bound::cramer_rao;
use super::reproduce::{Plan, SetResult};
use super::speed;
use crate::io::run::{read_record, write_record};
use crate::pipeline::PipelineError;
use crate::pipeline::engine::Progress;
use crate::pipeline::run::measurers;
use crate::pipeline::simulate::simulator;
use crate::report::table::{Cell, Heading, Table};
use crate::simulate::kinds::SetKind;

/// Biases of all submissions on one set, and the bound on their scatter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetBiases {
    /// Set number.
    pub set: u32,
    /// Cramér–Rao bound on the scatter of ε per component.
    pub bound: f64,
    /// One per submission, in the plan's order.
    pub biases: Vec<Bias>,
}

/// Measures biases on the galaxies of `images` images of each set, keeping each set's result in
/// `folder`, which [`super::reproduce::run_sets`] has claimed for the same plan.
///
/// # Errors
/// Where a file cannot be written, or read back.
pub fn bias_sets(
    plan: &Plan,
    sets: &[u32],
    images: u32,
    folder: &Path,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<SetBiases>, PipelineError> {
    let measurers = measurers(&plan.submissions)?;
    let numbers: Vec<u32> = (1..=images).collect();
    let mut found = Vec::new();
    for &set in sets {
        let path = folder.join(format!("bias/set{set:02}-{images}.json"));
        if let Some(result) = read_record::<SetBiases>(&path)? {
            found.push(result);
            progress.advance(u64::from(images) * (plan.simulation.grid as u64).pow(2));
            continue;
        }
        let simulator = simulator(set, plan.simulation)?;
        progress.note(&format!("set {set:02}"));
        let result = SetBiases {
            set,
            bound: cramer_rao(&simulator),
            biases: biases(&simulator, &numbers, &measurers, threads, progress)?,
        };
        write_record(&path, &result)?;
        found.push(result);
    }
    Ok(found)
}

/// Everything about every submission on every set.
///
/// # Errors
/// Where a submission's sizes cannot be worked with.
pub fn contest_table(
    plan: &Plan,
    results: &[SetResult],
    biases: &[SetBiases],
) -> Result<Table, PipelineError> {
    let costs = plan
        .submissions
        .iter()
        .map(|submission| speed::whole(submission, plan.simulation))
        .collect::<Result<Vec<f64>, _>>()?;
    let mut rows = Vec::new();
    for (result, bias) in results.iter().zip(biases) {
        for (k, submission) in plan.submissions.iter().enumerate() {
            rows.push(row(result, bias, k, submission, costs[k]));
        }
    }
    if results.len() > 1 {
        for (k, submission) in plan.submissions.iter().enumerate() {
            let mean = |value: &dyn Fn(&SetResult) -> f64| {
                results.iter().map(value).sum::<f64>() / results.len() as f64
            };
            let mut row = vec![
                Cell::text("mean"),
                Cell::text(""),
                Cell::text(&submission.name),
            ];
            row.extend((0..7).map(|_| Cell::text("")));
            row.push(Cell::number(mean(&|r| r.results[k].figures.q), 1));
            row.push(Cell::number(mean(&|r| r.results[k].figures.values()[1]), 0));
            row.push(Cell::number(costs[k], 0));
            rows.push(row);
        }
    }
    let headings = [
        ("set", "Set"),
        ("kind", "Kind"),
        ("submission", "Submission"),
        ("scatter", "scatter"),
        ("scatter_over_bound", "/ bound"),
        ("m1", "m1×10³"),
        ("m2", "m2×10³"),
        ("c1", "c1×10⁴"),
        ("c2", "c2×10⁴"),
        ("leakage", "PSF leakage"),
        ("q", "Q catalogue"),
        ("q_spectrum", "Q spectrum"),
        ("microseconds", "µs"),
    ];
    Ok(Table {
        title: "Submissions against each other and the bound (simulated data)".into(),
        headings: headings.map(|(key, label)| Heading::new(key, label)).into(),
        rows,
        notes: vec![
            "Scatter of ε per component after dividing by its slope, and over the Cramér–Rao bound of the galaxies.".into(),
            "m and c from pairs of galaxies with shears of ± 0.02, intrinsic ellipticities ± e and the same noise; leakage: c along the PSF's ellipticity.".into(),
            "Q of the catalogues, and of cross-spectra between groups of images, in which noise has no mean; leaderboard definition, standard convention.".into(),
        ],
    })
}

fn row(
    result: &SetResult,
    bias: &SetBiases,
    k: usize,
    submission: &Submission,
    cost: f64,
) -> Vec<Cell> {
    let (own, biases) = (&result.results[k], &bias.biases[k]);
    let errors = own.errors.map(|e| e.values());
    let figure = |at: usize, decimals: usize| {
        Cell::with_error(own.figures.values()[at], errors.map(|e| e[at]), decimals)
    };
    let scaled = |value: f64, error: f64, scale: f64| {
        Cell::with_error(value * scale, Some(error * scale), 1)
    };
    let scatter = own.response.rms_scatter();
    vec![
        Cell::text(format!("{:02}", result.set)),
        Cell::text(SetKind::of(result.set).map_or("", |kind| kind.image.label())),
        Cell::text(&submission.name),
        Cell::with_error(scatter, Some(own.response.rms_scatter_error()), 4),
        Cell::number(scatter / bias.bound, 3),
        scaled(biases.m[0], biases.m_error[0], 1e3),
        scaled(biases.m[1], biases.m_error[1], 1e3),
        scaled(biases.c[0], biases.c_error[0], 1e4),
        scaled(biases.c[1], biases.c_error[1], 1e4),
        Cell::with_error(biases.leakage, Some(biases.leakage_error), 3),
        figure(0, 1),
        figure(1, 0),
        Cell::number(cost, 0),
    ]
}
