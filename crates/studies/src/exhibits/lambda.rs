//! Sect. 4: Figs 4 to 7.

use shearq_submissions::Configuration;

use crate::calibration::{CTR_SNR_DB, Curves, LOG_LAMBDA, LambdaSums, PAPER_LAMBDA, SNR_DB};
use shearq_render::figure::{LinePlot, PanelGrid, Series, Style};
use shearq_render::page::{Page, PageError};
use shearq_render::table::{Cell, Heading, Table};

/// Names of the two rules in legends, in the order of [`crate::calibration::UPDATES`].
const RULES: [&str; 2] = ["adaptive", "constant"];

fn lambdas() -> Vec<f64> {
    LOG_LAMBDA.iter().map(|log| 10f64.powf(*log)).collect()
}

fn over_lambda(curve: &[LambdaSums], value: fn(&LambdaSums) -> f64) -> Vec<f64> {
    curve.iter().map(value).collect()
}

/// Draws Figs 4 to 7.
///
/// # Errors
/// If a file cannot be written.
pub fn calibration_figures(page: &mut Page<'_>, curves: &Curves) -> Result<(), PageError> {
    page.figure(
        "fig4-ctr-snr",
        &ctr_over_snr(curves),
        "As Fig. 4 of the paper: correct transition rate against S/N for the adaptive and the constant update.",
    )?;
    page.figure(
        "fig5-ctr-lambda",
        &ctr_over_lambda(curves),
        "As Fig. 5 of the paper: correct transition rate against λ, adaptive update.",
    )?;
    page.figure(
        "fig6-dsnr-lambda",
        &dsnr_over_lambda(curves),
        "As Fig. 6 of the paper: discriminative signal-to-noise ratio against λ, adaptive update.",
    )?;
    page.figure(
        "fig7-rmsd-lambda",
        &inverse_rmsd(curves),
        "As Fig. 7 of the paper: 1/RMSD of the ellipticities against λ for both updates.",
    )
}

/// Fig. 4: CTR against S/N at λ = 10^−3.5 for both rules.
fn ctr_over_snr(curves: &Curves) -> LinePlot {
    let series = curves
        .over_snr
        .iter()
        .zip(RULES)
        .enumerate()
        .map(|(k, (sums, rule))| {
            let y = over_lambda(sums, LambdaSums::ctr);
            let style = if k == 0 { Style::Dashed } else { Style::Line };
            Series::new(rule, CTR_SNR_DB.to_vec(), y, style, k)
                .with_errors(over_lambda(sums, LambdaSums::ctr_error))
        })
        .collect();
    LinePlot {
        title: "Correct transition rate, λ = 10⁻³·⁵".into(),
        x_label: "SNR [dB]".into(),
        y_label: "CTR".into(),
        series,
        ..LinePlot::default()
    }
}

/// Figs 5 and 6: a quantity of the adaptive rule against λ at the three S/N.
fn adaptive_over_lambda(
    curves: &Curves,
    title: &str,
    y_label: &str,
    value: fn(&LambdaSums) -> f64,
    error: fn(&LambdaSums) -> f64,
) -> LinePlot {
    let series = SNR_DB
        .iter()
        .enumerate()
        .map(|(s, snr)| {
            let sums = &curves.over_lambda[0][s];
            let y = over_lambda(sums, value);
            Series::new(&format!("SNR {snr} dB"), lambdas(), y, Style::Line, s)
                .with_errors(over_lambda(sums, error))
        })
        .collect();
    LinePlot {
        title: title.into(),
        x_label: "λ".into(),
        y_label: y_label.into(),
        x_log: true,
        series,
        ..LinePlot::default()
    }
}

/// Fig. 5: CTR against λ.
fn ctr_over_lambda(curves: &Curves) -> LinePlot {
    adaptive_over_lambda(
        curves,
        "Correct transition rate",
        "CTR",
        LambdaSums::ctr,
        LambdaSums::ctr_error,
    )
}

/// Fig. 6: dSNR against λ.
fn dsnr_over_lambda(curves: &Curves) -> LinePlot {
    let title = "Discriminative signal-to-noise ratio";
    adaptive_over_lambda(
        curves,
        title,
        "dSNR [dB]",
        LambdaSums::mean_dsnr,
        LambdaSums::mean_dsnr_error,
    )
}

/// Fig. 7: 1/RMSD against λ for both rules at the three S/N.
fn inverse_rmsd(curves: &Curves) -> PanelGrid {
    let plots = SNR_DB
        .iter()
        .enumerate()
        .map(|(s, snr)| LinePlot {
            title: format!("SNR {snr} dB"),
            x_label: "λ".into(),
            y_label: "1/RMSD".into(),
            x_log: true,
            series: RULES
                .iter()
                .enumerate()
                .map(|(rule, name)| {
                    let sums = &curves.over_lambda[rule][s];
                    let style = if rule == 0 {
                        Style::Dashed
                    } else {
                        Style::Line
                    };
                    Series::new(
                        name,
                        lambdas(),
                        over_lambda(sums, LambdaSums::inverse_rmsd),
                        style,
                        rule,
                    )
                    .with_errors(over_lambda(sums, LambdaSums::inverse_rmsd_error))
                })
                .collect(),
            ..LinePlot::default()
        })
        .collect();
    PanelGrid {
        title: "Accuracy of the ellipticities".into(),
        columns: 3,
        plots,
    }
}

/// All curves over λ as one table: the data of Figs 5 to 7.
pub fn curves_table(curves: &Curves) -> Table {
    let mut rows = Vec::new();
    for (rule, name) in RULES.iter().enumerate() {
        for (s, snr) in SNR_DB.iter().enumerate() {
            for (k, sums) in curves.over_lambda[rule][s].iter().enumerate() {
                rows.push(vec![
                    Cell::text(*name),
                    Cell::number(*snr, 0),
                    Cell::number(LOG_LAMBDA[k], 1),
                    Cell::with_error(sums.ctr(), Some(sums.ctr_error()), 4),
                    Cell::with_error(sums.mean_dsnr(), Some(sums.mean_dsnr_error()), 3),
                    Cell::with_error(sums.inverse_rmsd(), Some(sums.inverse_rmsd_error()), 3),
                    Cell::number(sums.iterations as f64 / sums.galaxies as f64, 1),
                ]);
            }
        }
    }
    Table {
        title: format!("Calibration of λ on {} synthetic galaxies", curves.galaxies),
        headings: vec![
            Heading::new("update", "Update"),
            Heading::new("snr_db", "SNR [dB]"),
            Heading::new("log10_lambda", "log λ"),
            Heading::new("ctr", "CTR"),
            Heading::new("dsnr_db", "dSNR [dB]"),
            Heading::new("inverse_rmsd", "1/RMSD"),
            Heading::new("iterations", "Iterations"),
        ],
        rows,
        notes: Vec::new(),
    }
}

/// A short table for terminals: per rule and S/N, the best λ and the values at 10⁻⁴.
pub fn calibration_table(curves: &Curves, configuration: &Configuration) -> Table {
    let mut rows = Vec::new();
    let mut at_edge = false;
    for (rule, name) in RULES.iter().enumerate() {
        for (s, snr) in SNR_DB.iter().enumerate() {
            let curve = &curves.over_lambda[rule][s];
            let best = (0..curve.len())
                .max_by(|a, b| {
                    curve[*a]
                        .inverse_rmsd()
                        .total_cmp(&curve[*b].inverse_rmsd())
                })
                .unwrap_or(0);
            at_edge |= best == 0 || best + 1 == curve.len();
            let paper = &curve[PAPER_LAMBDA];
            let value = |sums: &LambdaSums| {
                Cell::with_error(sums.inverse_rmsd(), Some(sums.inverse_rmsd_error()), 3)
            };
            rows.push(vec![
                Cell::text(*name),
                Cell::number(*snr, 0),
                Cell::number(LOG_LAMBDA[best], 1),
                value(&curve[best]),
                value(paper),
                Cell::with_error(paper.ctr(), Some(paper.ctr_error()), 4),
                Cell::with_error(paper.mean_dsnr(), Some(paper.mean_dsnr_error()), 2),
            ]);
        }
    }
    let chosen: Vec<String> = RULES
        .iter()
        .enumerate()
        .map(|(rule, name)| {
            format!(
                "10^{:.1} for the {name} update",
                curves.best_log_lambda(rule)
            )
        })
        .collect();
    let mut notes = vec![format!(
        "λ chosen (the largest within two standard errors of the best 1/RMSD over all S/N): {}. The paper suggests 10^-4.",
        chosen.join(", ")
    )];
    if at_edge {
        notes.push(format!(
            "warning: a best λ is at the edge of the range, 10^{} to 10^{}; the true optimum may lie beyond.",
            LOG_LAMBDA[0],
            LOG_LAMBDA[LOG_LAMBDA.len() - 1]
        ));
    }
    Table {
        title: format!(
            "Calibration of λ for {} on {} synthetic galaxies",
            configuration.name, curves.galaxies
        ),
        headings: vec![
            Heading::new("update", "Update"),
            Heading::new("snr_db", "SNR [dB]"),
            Heading::new("best_log10_lambda", "best log λ"),
            Heading::new("inverse_rmsd_best", "1/RMSD there"),
            Heading::new("inverse_rmsd", "1/RMSD at 10⁻⁴"),
            Heading::new("ctr", "CTR at 10⁻⁴"),
            Heading::new("dsnr_db", "dSNR at 10⁻⁴ [dB]"),
        ],
        rows,
        notes,
    }
}
