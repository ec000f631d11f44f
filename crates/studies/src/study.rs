//! Configurations compared with each other and with the Cramér–Rao bound: scatter, bias, Q and cost.

use serde::{Deserialize, Serialize};
use shearq_scoring::resample::mean_over_sets;

use super::bias::{ShearBias, biases};
use super::bound::{cramer_rao, expected_q};
use super::reproduce::{ConfigurationResult, Plan, SetResult, Study};
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
    /// Expected Q for the images of the plan with a scatter at the bound.
    #[serde(rename = "limit")]
    pub expected_q: Option<f64>,
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
        let scoring = |source| PipelineError::Scoring {
            set: Some(set),
            source,
        };
        let (bound, bound_error) = cramer_rao(&simulator).unzip();
        let expected_q = match bound {
            Some(bound) => Some(expected_q(&simulator, bound, plan.images).map_err(scoring)?),
            None => None,
        };
        Ok(SetBiases {
            set,
            bound,
            bound_error,
            expected_q,
            biases: biases(&simulator, &numbers, &measurers, threads, progress)?,
        })
    })
}

enum Row<'a> {
    Set(&'a SetResult, &'a SetBiases, usize),
    /// The mean over sets of one configuration.
    Mean(usize),
}

// A cell of a configuration on a set.
type CellOf<'a> = &'a dyn Fn(&Response, &SetBiases, &ShearBias) -> Cell;

/// A row for each configuration on each set, and means over sets if there are several.
#[allow(clippy::too_many_lines, reason = "one column after the other")]
pub fn study_table(
    plan: &Plan,
    results: &[SetResult],
    biases: &[SetBiases],
) -> Result<Table, PipelineError> {
    let costs = plan.configurations.iter();
    let costs =
        costs.map(|configuration| Ok(speed::costs(configuration, plan.simulation)?.measure));
    let costs = costs.collect::<Result<Vec<f64>, PipelineError>>()?;
    let configurations = 0..plan.configurations.len();
    let mut rows: Vec<Row<'_>> = Vec::new();
    for (result, bias) in results.iter().zip(biases) {
        rows.extend(configurations.clone().map(|k| Row::Set(result, bias, k)));
    }
    if results.len() > 1 {
        rows.extend(configurations.map(Row::Mean));
    }
    let place = |row: &Row<'_>| match row {
        Row::Set(.., k) | Row::Mean(k) => *k,
    };
    let mut table =
        Table::titled("Configurations compared with each other and the bound (simulated data)");
    table.column("set", "Set", &rows, |row| match row {
        Row::Set(result, ..) => Cell::text(format!("{:02}", result.set)),
        Row::Mean(_) => Cell::text("mean"),
    });
    table.column("kind", "Kind", &rows, |row| match row {
        Row::Set(result, ..) => {
            Cell::text(SetKind::of(result.set).map_or("", |kind| kind.image.label()))
        }
        Row::Mean(_) => Cell::Empty,
    });
    table.column("submission", "Configuration", &rows, |row| {
        Cell::text(&plan.configurations[place(row)].name)
    });
    let shapes = |table: &mut Table, key, label: &str, cell: CellOf<'_>| {
        table.column(key, label, &rows, |row| match row {
            Row::Set(result, bias, k) => cell(&result.results[*k].response, bias, &bias.biases[*k]),
            Row::Mean(_) => Cell::Empty,
        });
    };
    shapes(&mut table, "scatter", "scatter", &|own, _, _| {
        Cell::with_error(own.rms_scatter(), Some(own.rms_scatter_error()), 5)
    });
    shapes(
        &mut table,
        "scatter_over_bound",
        "/ bound",
        &|own, set, _| {
            let (ratio, error) = over_bound(own, set);
            Cell::with_error(ratio, Some(error), 3)
        },
    );
    for (key, k) in [("m1", 0), ("m2", 1)] {
        shapes(&mut table, key, &format!("{key}×10³"), &|_, _, bias| {
            Cell::with_error(bias.m[k] * 1e3, Some(bias.m_error[k] * 1e3), 1)
        });
    }
    for (key, k) in [("c1", 0), ("c2", 1)] {
        shapes(&mut table, key, &format!("{key}×10⁴"), &|_, _, bias| {
            Cell::with_error(bias.c[k] * 1e4, Some(bias.c_error[k] * 1e4), 1)
        });
    }
    shapes(&mut table, "leakage", "PSF leakage", &|_, _, bias| {
        Cell::with_error(bias.leakage, Some(bias.leakage_error), 3)
    });
    shapes(&mut table, "unmeasured", "unmeasured", &|own, _, bias| {
        Cell::number((own.flagged + bias.dropped) as f64, 0)
    });
    let mut quality = |key, label, value: fn(&ConfigurationResult) -> (f64, f64), decimals| {
        table.column(key, label, &rows, |row| {
            let (value, error) = match row {
                Row::Set(result, _, k) => value(&result.results[*k]),
                Row::Mean(k) => {
                    let all: Vec<_> = results.iter().map(|r| value(&r.results[*k])).collect();
                    mean_over_sets(&all)
                }
            };
            Cell::with_error(value, Some(error), decimals)
        });
    };
    quality(
        "q",
        "Q catalogue",
        |own| (own.score.metrics.q, own.score.errors.q),
        1,
    );
    quality("q_spectrum", "Q spectrum", spectrum, 0);
    table.column("q_limit", "expected Q", &rows, |row| match row {
        Row::Set(_, bias, _) => Cell::number(bias.expected_q.unwrap_or(f64::NAN), 0),
        Row::Mean(_) => {
            let known: Vec<f64> = biases.iter().filter_map(|bias| bias.expected_q).collect();
            Cell::number(known.iter().sum::<f64>() / known.len() as f64, 0)
        }
    });
    table.column("microseconds", "µs", &rows, |row| {
        Cell::number(costs[place(row)], 0)
    });
    table.notes = vec![
        "Scatter of ε per component after division by its response, and its ratio to the Cramér–Rao bound of a sample of the galaxies, were they round. Offset bulges have no bound. If S/N differ, galaxies of low S/N count less, and the scatter can be below the bound.".into(),
        "m and c: from galaxies drawn with shears of ± 0.02, intrinsic ellipticities ± e and noise of either sign. Leakage: c along the ellipticity of the PSF. Unmeasured: galaxies without ellipticity; they are left out.".into(),
        "Q of the catalogues, and of cross-spectra between groups of images, which noise does not bias; leaderboard definition, standard convention. Expected Q: mean Q of a perfect method with noise at the bound.".into(),
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

// Q of a configuration's cross-spectrum and its error.
fn spectrum(result: &ConfigurationResult) -> (f64, f64) {
    let known = |value: Option<f64>| value.unwrap_or(f64::NAN);
    (known(result.q_spectrum), known(result.q_spectrum_error))
}
