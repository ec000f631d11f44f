//! Energy of the network against iterations and time, with and without momentum.

use std::hint::black_box;

use shearq_measure::parts::{Network, Rule, Step};
use shearq_submissions::Configuration;

use super::speed::{Inputs, network_of, time};
use shearq_pipeline::PipelineError;
use shearq_render::figure::{LinePlot, PanelGrid, Series, Style};
use shearq_render::table::{Cell, Heading, Table};
use shearq_simulate::set::SimulationSettings;

/// Iterations at which the energy is recorded.
const ITERATIONS: [usize; 12] = [1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 40, 80];
/// Iterations with momentum that determine the minimum of the energy.
const MANY: usize = 1500;
/// Names of the two updates.
const UPDATES: [&str; 2] = ["adaptive", "accelerated"];

/// Energy above the minimum and cost, for both updates and several numbers of iterations.
#[derive(Debug)]
pub struct Convergence {
    configuration: String,
    /// Mean over galaxies of (E − E_min)/(E₀ − E_min).
    excess: [Vec<f64>; 2],
    /// Microseconds per galaxy.
    cost: [Vec<f64>; 2],
}

/// Runs the network of a configuration on simulated fiducial stamps with both updates.
///
/// # Errors
/// If the sizes of the configuration are invalid.
pub fn convergence(
    configuration: &Configuration,
    settings: SimulationSettings,
) -> Result<Convergence, PipelineError> {
    let inputs = Inputs::new(settings)?;
    let (n, p) = (configuration.stamp.size, configuration.psf.size);
    let deconvolution = &network_of(configuration)?.deconvolution;
    let lambda = deconvolution.printed_lambda(deconvolution.lambda);
    let mut network = Network::plan(n, p, lambda)?;
    network.set_psf(inputs.psf(p).view(), deconvolution.psf_scale)?;
    let mut scratch = network.scratch();
    let mut out = vec![0.0; n * n];
    let galaxies: Vec<(Vec<f32>, Rule, f64)> = inputs
        .cuts(n)
        .into_iter()
        .filter_map(|cut| {
            let peak = cut.iter().copied().fold(0.0, f32::max);
            let rule = Rule::new(deconvolution, f64::from(peak), 1.0)?;
            let (Step::Adaptive(c) | Step::Accelerated(c) | Step::Constant(c)) = rule.step;
            Some((cut, rule, c))
        })
        .collect();
    let lowest: Vec<f64> = galaxies
        .iter()
        .map(|(cut, rule, c)| {
            let rule = Rule {
                step: Step::Accelerated(*c),
                max_iterations: MANY,
                ..*rule
            };
            let descent = network.deconvolve(&rule, cut, &mut scratch, &mut out)?;
            Ok(descent.energy)
        })
        .collect::<Result<_, PipelineError>>()?;
    let mut found = Convergence {
        configuration: configuration.name.clone(),
        excess: Default::default(),
        cost: Default::default(),
    };
    for (k, step) in [Step::Adaptive as fn(f64) -> Step, Step::Accelerated]
        .into_iter()
        .enumerate()
    {
        for max_iterations in ITERATIONS {
            let rule_of = |(_, rule, c): &(Vec<f32>, Rule, f64)| Rule {
                step: step(*c),
                max_iterations,
                ..*rule
            };
            let mut excess = 0.0;
            for (galaxy, lowest) in galaxies.iter().zip(&lowest) {
                let rule = rule_of(galaxy);
                let descent = network.deconvolve(&rule, &galaxy.0, &mut scratch, &mut out)?;
                excess += (descent.energy - lowest) / (descent.first_energy - lowest);
            }
            found.excess[k].push(excess / galaxies.len() as f64);
            found.cost[k].push(time(|at| {
                let galaxy = &galaxies[at % galaxies.len()];
                let rule = rule_of(galaxy);
                let _ = black_box(network.deconvolve(&rule, &galaxy.0, &mut scratch, &mut out));
            }));
        }
    }
    Ok(found)
}

impl Convergence {
    /// The numbers as a table.
    pub fn table(&self) -> Table {
        let rows = ITERATIONS.iter().enumerate().map(|(at, iterations)| {
            let mut row = vec![Cell::number(*iterations as f64, 0)];
            for k in 0..2 {
                row.push(Cell::number(self.excess[k][at] * 1e3, 3));
                row.push(Cell::number(self.cost[k][at], 1));
            }
            row
        });
        Table {
            title: format!("Energy of {} above its minimum", self.configuration),
            headings: vec![
                Heading::new("iterations", "Iterations"),
                Heading::new("adaptive_excess", "adaptive ×10³"),
                Heading::new("adaptive_microseconds", "µs"),
                Heading::new("accelerated_excess", "accelerated ×10³"),
                Heading::new("accelerated_microseconds", "µs"),
            ],
            rows: rows.collect(),
            notes: vec![format!(
                "Mean of (E − E_min)/(E₀ − E_min) over simulated fiducial galaxies; E_min after {MANY} accelerated iterations."
            )],
        }
    }

    /// Energy against iterations, and against time.
    pub fn figure(&self) -> PanelGrid {
        let iterations: Vec<f64> = ITERATIONS.iter().map(|m| *m as f64).collect();
        let panel = |label: &str, x: &dyn Fn(usize) -> Vec<f64>| LinePlot {
            title: format!("against {label}"),
            x_label: label.into(),
            y_label: "(E − E_min)/(E₀ − E_min)".into(),
            x_log: true,
            y_log: true,
            series: UPDATES
                .iter()
                .enumerate()
                .map(|(k, name)| {
                    let style = if k == 0 { Style::Dashed } else { Style::Line };
                    Series::new(name, x(k), self.excess[k].clone(), style, k)
                })
                .collect(),
            ..LinePlot::default()
        };
        PanelGrid {
            title: format!("Energy of {}", self.configuration),
            columns: 2,
            plots: vec![
                panel("iterations", &|_| iterations.clone()),
                panel("µs per galaxy", &|k| self.cost[k].clone()),
            ],
        }
    }
}
