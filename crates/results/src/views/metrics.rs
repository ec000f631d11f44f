//! Headings and decimals of the metrics in tables.

use shearq_render::table::{Cell, Heading};
use shearq_scoring::Metrics;

/// How tables show one metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MetricFormat {
    /// Name of the metric.
    pub name: &'static str,
    /// Heading, with the unit if there is one.
    pub label: &'static str,
    /// Decimals in tables for people.
    pub decimals: usize,
    /// Whether only wide tables contain it.
    pub detail: bool,
}

const fn format(
    name: &'static str,
    label: &'static str,
    decimals: usize,
    detail: bool,
) -> MetricFormat {
    MetricFormat {
        name,
        label,
        decimals,
        detail,
    }
}

/// The formats of all metrics, in the order of [`Metrics::ALL`].
pub const FORMATS: [MetricFormat; Metrics::ALL.len()] = [
    format("q", "Q", 2, false),
    format("q_dn", "Q_dn", 2, false),
    format("q_calibrated", "Q cal.", 2, false),
    format("m_half", "M/2", 4, false),
    format("sqrt_a", "√A×10⁴", 4, false),
    format("m_cross", "m (cross)", 4, false),
    format("galaxy_noise", "noise", 4, false),
    format("m1", "m1", 4, true),
    format("m2", "m2", 4, true),
    format("c1", "c1", 5, true),
    format("c2", "c2", 5, true),
    format("b_power", "B mode×10⁹", 3, true),
    format("eb_power", "EB×10⁹", 3, true),
    format("sigma_sys_1e4", "σ_sys×10⁴", 4, true),
];

/// The heading of the metric called `name`.
pub fn metric_heading(name: &'static str) -> Heading {
    let label = Metrics::place(name).map_or(name, |place| FORMATS[place].label);
    Heading::new(name, label)
}

/// The cell of a value of the metric called `name`.
pub fn metric_cell(name: &str, value: f64, error: f64) -> Cell {
    let decimals = Metrics::place(name).map_or(0, |place| FORMATS[place].decimals);
    Cell::with_error(value, Some(error), decimals)
}

/// The cells of all metrics.
pub fn metric_cells(metrics: &Metrics, errors: &Metrics) -> Vec<Cell> {
    let pairs = metrics.values().into_iter().zip(errors.values());
    pairs
        .zip(FORMATS)
        .map(|((value, error), metric)| metric_cell(metric.name, value, error))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_metric_has_its_format() {
        assert_eq!(
            FORMATS.map(|format| format.name),
            Metrics::ALL.map(|metric| metric.name)
        );
        assert_eq!(metric_heading("c1").label, "c1");
        assert_eq!(metric_heading("galaxy_noise").label, "noise");
        assert_eq!(
            metric_cell("c1", 1.0, 0.1),
            Cell::with_error(1.0, Some(0.1), 5)
        );
    }
}
