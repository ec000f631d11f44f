//! Configurations compared with each other and with the Cramér–Rao bound: scatter, bias, Q and cost.

use serde::{Deserialize, Serialize};
use shearq_scoring::resample::mean_over_sets;
use shearq_submissions::Configuration;

use super::bias::{ShearBias, biases};
use super::bound::{cramer_rao, ensemble_bound, expected_q};
use super::reproduce::{ConfigurationResult, Plan, SetResult, Study};
use super::speed;
use shearq_dataset::record::read_record;
use shearq_pipeline::PipelineError;
use shearq_pipeline::engine::Progress;
use shearq_pipeline::run::measurers;
use shearq_pipeline::simulate::simulator;
use shearq_render::table::{Cell, Heading, Table};
use shearq_simulate::kinds::SetKind;

/// Biases of all configurations on one set, and the bound on their scatter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetBiases {
    /// Set number.
    pub set: u32,
    /// Cramér–Rao bound on the scatter of ε per component, if there is one.
    pub bound: Option<f64>,
    /// Standard error of the bound.
    pub bound_error: Option<f64>,
    /// Bound on the scatter of shears from elliptical galaxies with the best weights, if there is one.
    pub ensemble_bound: Option<f64>,
    /// Expected Q for the images of the plan with a scatter at the bound.
    #[serde(rename = "limit")]
    pub expected_q: Option<f64>,
    /// One per configuration, in the order of the plan.
    pub biases: Vec<ShearBias>,
}

/// Measures biases on the galaxies of `images` images of each set. The result of each set is written as soon as it
/// is known; existing results are read.
///
/// # Errors
/// If a file cannot be written or read, or if the folder was removed meanwhile.
pub fn bias_sets(
    study: &Study<'_>,
    sets: &[u32],
    images: u32,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<SetBiases>, PipelineError> {
    let &Study { plan, folder, .. } = study;
    let measurers = measurers(&plan.submissions)?;
    let numbers: Vec<u32> = (1..=images).collect();
    let path = |set: u32| folder.join(format!("bias/set{set:02}-{images}.json"));
    let mut found = Vec::new();
    for &set in sets {
        let path = path(set);
        if let Some(result) = read_record::<SetBiases>(&path)? {
            found.push(result);
            progress.skip(u64::from(images) * (plan.simulation.grid as u64).pow(2));
            continue;
        }
        let simulator = simulator(set, plan.simulation)?;
        progress.note(&format!("set {set:02}"));
        let (bound, bound_error) = cramer_rao(&simulator).unzip();
        let expected_q = bound.map(|bound| expected_q(&simulator, bound, plan.images));
        let result = SetBiases {
            set,
            bound,
            bound_error,
            ensemble_bound: ensemble_bound(&simulator).map(|(bound, _)| bound),
            expected_q: expected_q
                .transpose()
                .map_err(|source| PipelineError::Scoring {
                    set: Some(set),
                    source,
                })?,
            biases: biases(&simulator, &numbers, &measurers, threads, progress)?,
        };
        study.keep(&path, &result)?;
        found.push(result);
    }
    study.check_results(sets.iter().map(|&set| path(set)))?;
    Ok(found)
}

/// A row for each configuration on each set, and means over sets if there are several.
///
/// # Errors
/// If the sizes of a configuration are invalid.
pub fn contest_table(
    plan: &Plan,
    results: &[SetResult],
    biases: &[SetBiases],
) -> Result<Table, PipelineError> {
    let costs = plan
        .submissions
        .iter()
        .map(|configuration| speed::whole(configuration, plan.simulation))
        .collect::<Result<Vec<f64>, _>>()?;
    let mut rows = Vec::new();
    for (result, bias) in results.iter().zip(biases) {
        for (k, configuration) in plan.submissions.iter().enumerate() {
            rows.push(row(result, bias, k, configuration, costs[k]));
        }
    }
    if results.len() > 1 {
        let limits: Vec<f64> = biases.iter().filter_map(|b| b.expected_q).collect();
        let limit = limits.iter().sum::<f64>() / limits.len() as f64;
        for (k, configuration) in plan.submissions.iter().enumerate() {
            let mean = |value: &dyn Fn(&ConfigurationResult) -> (f64, f64), decimals: usize| {
                let all: Vec<_> = results.iter().map(|r| value(&r.results[k])).collect();
                let (mean, error) = mean_over_sets(&all);
                Cell::with_error(mean, Some(error), decimals)
            };
            let mut row = vec![
                Cell::text("mean"),
                Cell::Empty,
                Cell::text(&configuration.name),
            ];
            row.extend((0..11).map(|_| Cell::Empty));
            row.push(mean(&|r| (r.score.metrics.q, r.score.errors.q), 1));
            row.push(mean(&spectrum, 0));
            row.push(Cell::number(limit, 0));
            row.push(Cell::number(costs[k], 0));
            rows.push(row);
        }
    }
    let headings = [
        ("set", "Set"),
        ("kind", "Kind"),
        ("submission", "Configuration"),
        ("scatter", "scatter"),
        ("scatter_over_bound", "/ bound"),
        ("scatter_over_ensemble", "/ ensemble"),
        ("total", "total"),
        ("total_over_bound", "/ bound"),
        ("m1", "m1×10³"),
        ("m2", "m2×10³"),
        ("c1", "c1×10⁴"),
        ("c2", "c2×10⁴"),
        ("leakage", "PSF leakage"),
        ("unmeasured", "unmeasured"),
        ("q", "Q catalogue"),
        ("q_spectrum", "Q spectrum"),
        ("q_limit", "expected Q"),
        ("microseconds", "µs"),
    ];
    Ok(Table {
        title: "Configurations compared with each other and the bound (simulated data)".into(),
        headings: headings.map(|(key, label)| Heading::new(key, label)).into(),
        rows,
        notes: vec![
            "Scatter of ε per component after division by its response, and its ratio to the Cramér–Rao bound of a sample of the galaxies, were they round. Ensemble: the bound on shears from the same galaxies with their ellipticities, of unknown flux and size, with the best weights. Offset bulges have no bound. Total: the scatter with intrinsic shapes, and its ratio to that with noise at the bound. If S/N differ, galaxies of low S/N count less, and the scatter can be below the bound.".into(),
            "m and c: from galaxies drawn with shears of ± 0.02, intrinsic ellipticities ± e and noise of either sign. Leakage: c along the ellipticity of the PSF. Unmeasured: galaxies without ellipticity; they are left out.".into(),
            "Q of the catalogues, and of cross-spectra between groups of images, which noise does not bias; leaderboard definition, standard convention. Expected Q: mean Q of a perfect method with noise at the bound.".into(),
        ],
    })
}

/// The table in two parts: scatter and biases; Q and cost.
pub fn contest_parts(table: &Table) -> [Table; 2] {
    let (biases, quality) = table.notes.split_at(2);
    let shapes = [
        "set",
        "kind",
        "submission",
        "scatter",
        "scatter_over_bound",
        "scatter_over_ensemble",
        "total",
        "total_over_bound",
        "m1",
        "m2",
        "c1",
        "c2",
        "leakage",
        "unmeasured",
    ];
    let spectra = [
        "set",
        "kind",
        "submission",
        "q",
        "q_spectrum",
        "q_limit",
        "microseconds",
    ];
    [
        table.part(&shapes, "Scatter and biases (simulated data)", biases),
        table.part(&spectra, "Quality and cost (simulated data)", quality),
    ]
}

fn row(
    result: &SetResult,
    bias: &SetBiases,
    k: usize,
    configuration: &Configuration,
    cost: f64,
) -> Vec<Cell> {
    let (own, biases) = (&result.results[k], &bias.biases[k]);
    let scaled = |value: f64, error: f64, scale: f64| {
        Cell::with_error(value * scale, Some(error * scale), 1)
    };
    let (scatter, scatter_error) = (own.response.rms_scatter(), own.response.rms_scatter_error());
    let bound = bias.bound.unwrap_or(f64::NAN);
    let relative = (scatter_error / scatter).hypot(bias.bound_error.unwrap_or(f64::NAN) / bound);
    let (q_spectrum, q_spectrum_error) = spectrum(own);
    let total = own.response.rms_total();
    // Of intrinsic shapes, which are the rest of the total, and noise at the bound.
    let total_bound = (total * total - scatter * scatter + bound * bound).sqrt();
    vec![
        Cell::text(format!("{:02}", result.set)),
        Cell::text(SetKind::of(result.set).map_or("", |kind| kind.image.label())),
        Cell::text(&configuration.name),
        Cell::with_error(scatter, Some(scatter_error), 5),
        Cell::with_error(scatter / bound, Some(scatter / bound * relative), 3),
        Cell::number(scatter / bias.ensemble_bound.unwrap_or(f64::NAN), 3),
        Cell::number(total, 4),
        Cell::number(total / total_bound, 4),
        scaled(biases.m[0], biases.m_error[0], 1e3),
        scaled(biases.m[1], biases.m_error[1], 1e3),
        scaled(biases.c[0], biases.c_error[0], 1e4),
        scaled(biases.c[1], biases.c_error[1], 1e4),
        Cell::with_error(biases.leakage, Some(biases.leakage_error), 3),
        Cell::number((own.response.flagged + biases.dropped) as f64, 0),
        Cell::with_error(own.score.metrics.q, Some(own.score.errors.q), 1),
        Cell::with_error(q_spectrum, Some(q_spectrum_error), 0),
        Cell::number(bias.expected_q.unwrap_or(f64::NAN), 0),
        Cell::number(cost, 0),
    ]
}

/// Q of a configuration's cross-spectrum and its error.
fn spectrum(result: &ConfigurationResult) -> (f64, f64) {
    (
        result.q_spectrum.unwrap_or(f64::NAN),
        result.q_spectrum_error.unwrap_or(f64::NAN),
    )
}
