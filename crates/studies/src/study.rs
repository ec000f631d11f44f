//! Configurations compared with each other and with the Cramér–Rao bound: scatter, bias and cost.

use serde::{Deserialize, Serialize};

use super::bias::{ShearBias, biases};
use super::bound::cramer_rao;
use super::reproduce::{Plan, SetResult, Study};
use super::response::Response;
use super::speed;
use shearq_dataset::threads::Progress;
use shearq_pipeline::PipelineError;
use shearq_pipeline::run::measurers;
use shearq_pipeline::simulate::simulator;
use shearq_render::table::{Cell, Table};
use shearq_simulate::kinds::SetKind;

/// Biases of all configurations on one set, and the bound on their scatter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetBiases {
    pub set: u32,
    /// Cramér–Rao bound on the scatter of ε per component, if there is one.
    pub bound: Option<f64>,
    pub bound_error: Option<f64>,
    /// One per configuration, in the order of the plan.
    pub biases: Vec<ShearBias>,
}

/// Measures biases on the galaxies of `images` images of each set.
pub fn bias_sets(
    study: &Study<'_>,
    sets: &[u32],
    images: u32,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<SetBiases>, PipelineError> {
    let plan = study.plan;
    let measurers = measurers(&plan.configurations)?;
    let numbers: Vec<u32> = (1..=images).collect();
    let path = |set: u32| format!("bias/set{set:02}-{images}.json").into();
    study.each_set(sets, images, path, progress, |set, progress| {
        let simulator = simulator(set, plan.simulation)?;
        progress.note(&format!("set {set:02}"));
        let (bound, bound_error) = cramer_rao(&simulator).unzip();
        Ok(SetBiases {
            set,
            bound,
            bound_error,
            biases: biases(&simulator, &numbers, &measurers, threads, progress)?,
        })
    })
}

// A configuration on a set.
struct Row<'a> {
    configuration: usize,
    response: &'a Response,
    set: &'a SetBiases,
    bias: &'a ShearBias,
}

/// A row for each configuration on each set.
pub fn study_table(
    plan: &Plan,
    results: &[SetResult],
    biases: &[SetBiases],
) -> Result<Table, PipelineError> {
    let costs = plan.configurations.iter();
    let costs =
        costs.map(|configuration| Ok(speed::costs(configuration, plan.simulation)?.measure));
    let costs = costs.collect::<Result<Vec<f64>, PipelineError>>()?;
    let mut rows: Vec<Row<'_>> = Vec::new();
    for (result, set) in results.iter().zip(biases) {
        rows.extend((0..plan.configurations.len()).map(|configuration| Row {
            configuration,
            response: &result.results[configuration].response,
            set,
            bias: &set.biases[configuration],
        }));
    }
    let mut table =
        Table::titled("Configurations compared with each other and the bound (simulated data)");
    table.column("set", "Set", &rows, |row| {
        Cell::text(format!("{:02}", row.set.set))
    });
    table.column("kind", "Kind", &rows, |row| {
        Cell::text(SetKind::of(row.set.set).map_or("", |kind| kind.image.label()))
    });
    table.column("submission", "Configuration", &rows, |row| {
        Cell::text(&plan.configurations[row.configuration].name)
    });
    table.column("scatter", "scatter", &rows, |Row { response, .. }| {
        Cell::with_error(
            response.rms_scatter(),
            Some(response.rms_scatter_error()),
            5,
        )
    });
    table.column("scatter_over_bound", "/ bound", &rows, |row| {
        let (ratio, error) = over_bound(row.response, row.set);
        Cell::with_error(ratio, Some(error), 3)
    });
    for (key, k) in [("m1", 0), ("m2", 1)] {
        table.column(
            key,
            format!("{key}×10³"),
            &rows,
            |Row { bias, .. }| Cell::with_error(bias.m[k] * 1e3, Some(bias.m_error[k] * 1e3), 1),
        );
    }
    for (key, k) in [("c1", 0), ("c2", 1)] {
        table.column(
            key,
            format!("{key}×10⁴"),
            &rows,
            |Row { bias, .. }| Cell::with_error(bias.c[k] * 1e4, Some(bias.c_error[k] * 1e4), 1),
        );
    }
    table.column("leakage", "PSF leakage", &rows, |Row { bias, .. }| {
        Cell::with_error(bias.leakage, Some(bias.leakage_error), 3)
    });
    table.column("unmeasured", "unmeasured", &rows, |row| {
        Cell::number((row.response.flagged + row.bias.dropped) as f64, 0)
    });
    table.column("microseconds", "µs", &rows, |row| {
        Cell::number(costs[row.configuration], 0)
    });
    table.notes = vec![
        "Scatter of ε per component after division by its response, and its ratio to the Cramér–Rao bound of a sample of the galaxies, were they round. Offset bulges have no bound. If S/N differ, galaxies of low S/N count less, and the scatter can be below the bound.".into(),
        "m and c: from galaxies drawn with shears of ± 0.02, intrinsic ellipticities ± e and noise of either sign. Leakage: c along the ellipticity of the PSF. Unmeasured: galaxies without ellipticity; they are left out.".into(),
    ];
    Ok(table)
}

// The scatter over its bound, and the error.
fn over_bound(own: &Response, set: &SetBiases) -> (f64, f64) {
    let (scatter, error) = (own.rms_scatter(), own.rms_scatter_error());
    let bound = set.bound.unwrap_or(f64::NAN);
    let relative = (error / scatter).hypot(set.bound_error.unwrap_or(f64::NAN) / bound);
    (scatter / bound, scatter / bound * relative)
}
