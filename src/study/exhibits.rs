//! The paper's figures and tables from the studies' numbers.

use shearq_scoring::SCORED;
use shearq_scoring::resample::{PairedSet, mean_over_sets, paired_difference};
use shearq_submissions::{DenoiseMethod, PsfForm, Published, Submission};

use super::calibration::{CTR_SNR_DB, Curves, LOG_LAMBDA, SNR_DB, Sums};
use super::reproduce::SetResult;
use crate::report::figure::{
    BarGroup, BarPlot, ColourMap, HeatMap, LinePlot, PanelGrid, Series, Style,
};
use crate::report::table::{Cell, Heading, Table};
use crate::simulate::kinds::{ImageType, SetKind};

/// Names of the two rules in legends, in the order of [`super::calibration::UPDATES`].
const RULES: [&str; 2] = ["adaptive", "constant"];

fn lambdas() -> Vec<f64> {
    LOG_LAMBDA.iter().map(|log| 10f64.powf(*log)).collect()
}

fn over_lambda(curve: &[Sums], value: fn(&Sums) -> f64) -> Vec<f64> {
    curve.iter().map(value).collect()
}

/// Fig. 4: CTR against S/N at λ = 10^−3.5 for both rules.
pub fn ctr_over_snr(curves: &Curves) -> LinePlot {
    let series = curves
        .over_snr
        .iter()
        .zip(RULES)
        .enumerate()
        .map(|(k, (sums, rule))| {
            let y = over_lambda(sums, Sums::ctr);
            let style = if k == 0 { Style::Dashed } else { Style::Line };
            Series::new(rule, CTR_SNR_DB.to_vec(), y, style, k)
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

/// Figs 5 and 6: a figure of the adaptive rule against λ at the three S/N.
fn adaptive_over_lambda(
    curves: &Curves,
    title: &str,
    y_label: &str,
    value: fn(&Sums) -> f64,
) -> LinePlot {
    let series = SNR_DB
        .iter()
        .enumerate()
        .map(|(s, snr)| {
            let y = over_lambda(&curves.over_lambda[0][s], value);
            Series::new(&format!("SNR {snr} dB"), lambdas(), y, Style::Line, s)
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
pub fn ctr_over_lambda(curves: &Curves) -> LinePlot {
    adaptive_over_lambda(curves, "Correct transition rate", "CTR", Sums::ctr)
}

/// Fig. 6: dSNR against λ.
pub fn dsnr_over_lambda(curves: &Curves) -> LinePlot {
    let title = "Discriminative signal-to-noise ratio";
    adaptive_over_lambda(curves, title, "dSNR [dB]", Sums::mean_dsnr)
}

/// Fig. 7: 1/RMSD against λ for both rules at the three S/N.
pub fn inverse_rmsd(curves: &Curves) -> PanelGrid {
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
                        over_lambda(sums, Sums::inverse_rmsd),
                        style,
                        rule,
                    )
                    .with_errors(over_lambda(sums, Sums::inverse_rmsd_error))
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
                    Cell::number(sums.ctr(), 4),
                    Cell::number(sums.mean_dsnr(), 3),
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

/// A short table for terminals: per rule and S/N, the best λ and the figures at 10⁻⁴.
pub fn calibration_table(curves: &Curves, submission: &Submission) -> Table {
    let at = |log: f64| LOG_LAMBDA.iter().position(|l| *l == log).unwrap_or(0);
    let mut rows = Vec::new();
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
            let paper = &curve[at(-4.0)];
            let value = |sums: &Sums| {
                Cell::with_error(sums.inverse_rmsd(), Some(sums.inverse_rmsd_error()), 3)
            };
            rows.push(vec![
                Cell::text(*name),
                Cell::number(*snr, 0),
                Cell::number(LOG_LAMBDA[best], 1),
                value(&curve[best]),
                value(paper),
                Cell::number(paper.ctr(), 4),
                Cell::number(paper.mean_dsnr(), 2),
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
    Table {
        title: format!(
            "Calibration of λ for {} on {} synthetic galaxies",
            submission.name, curves.galaxies
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
        notes: vec![format!(
            "λ chosen (the largest within two standard errors of the best 1/RMSD over all S/N): {}. The paper suggests 10^-4.",
            chosen.join(", ")
        )],
    }
}

/// Figures of one submission over sets, from its place in each set's results.
fn over_sets(results: &[SetResult], place: usize, figure: usize) -> Vec<(f64, Option<f64>)> {
    results
        .iter()
        .map(|set| {
            let result = &set.results[place];
            let error = result.errors.map(|e| e.values()[figure]);
            (result.figures.values()[figure], error)
        })
        .collect()
}

/// Table 1: our figures beside the published ones.
pub fn table_one(results: &[SetResult], submissions: &[(Submission, Option<Published>)]) -> Table {
    let mut rows = Vec::new();
    for (place, (submission, published)) in submissions.iter().enumerate() {
        let mean = |figure: usize, decimals: usize| {
            let (value, error) = mean_over_sets(&over_sets(results, place, figure));
            Cell::with_error(value, error, decimals)
        };
        let given = |value: fn(&Published) -> f64, decimals: usize| {
            Cell::number(published.as_ref().map_or(f64::NAN, value), decimals)
        };
        let yes = |yes: bool| Cell::text(if yes { "Y" } else { "N" });
        rows.push(vec![
            Cell::text(&submission.name),
            Cell::text(format!("{0}×{0}", submission.stamp.size)),
            yes(submission.denoise.method != DenoiseMethod::None),
            Cell::text(match submission.psf.form {
                PsfForm::Star => "Star",
                PsfForm::Functional => "Func",
            }),
            mean(2, 4),
            given(|p| p.m_half, 4),
            mean(3, 4),
            given(|p| p.sqrt_a, 4),
            mean(0, 2),
            given(|p| p.q, 2),
            mean(1, 1),
            mean(4, 4),
        ]);
    }
    Table {
        title: "Table 1: submissions over all sets (simulated data)".into(),
        headings: vec![
            Heading::new("method", "Method"),
            Heading::new("size", "Size"),
            Heading::new("denoised", "Den"),
            Heading::new("psf", "PSF"),
            Heading::new("m_half", "M/2"),
            Heading::new("m_half_published", "M/2 publ."),
            Heading::new("sqrt_a", "√A×10⁴"),
            Heading::new("sqrt_a_published", "√A publ."),
            Heading::new("q", "Q"),
            Heading::new("q_published", "Q publ."),
            Heading::new("q_dn", "Q_dn"),
            Heading::new("m_cross", "m (cross)"),
        ],
        rows,
        notes: vec![
            "Matched convention, leaderboard definition, jackknife errors. Published figures are of the challenge's own images, 200 per set.".into(),
        ],
    }
}

fn set_labels(results: &[SetResult]) -> Vec<String> {
    results.iter().map(|set| set.set.to_string()).collect()
}

/// Fig. 8: Q per set and variant.
pub fn q_per_set(results: &[SetResult], names: &[String]) -> HeatMap {
    let mut columns = set_labels(results);
    columns.push("mean".into());
    let values = ndarray::Array2::from_shape_fn((names.len(), columns.len()), |(place, k)| {
        let over = over_sets(results, place, 0);
        over.get(k)
            .map_or_else(|| mean_over_sets(&over).0, |value| value.0)
    });
    HeatMap {
        title: "Quality factor per set".into(),
        row_label: "submission".into(),
        column_label: "set".into(),
        rows: names.to_vec(),
        columns,
        values,
        decimals: 1,
        value_label: "Q".into(),
        map: ColourMap::Viridis,
    }
}

/// Figures of every set and submission: the data of Figs 8, 10 and 11.
pub fn per_set_table(results: &[SetResult]) -> Table {
    let mut rows = Vec::new();
    for set in results {
        for result in &set.results {
            let values = result.figures.values();
            let errors = result.errors.map(|e| e.values());
            let cell = |at: usize, decimals: usize| {
                Cell::with_error(values[at], errors.map(|e| e[at]), decimals)
            };
            rows.push(vec![
                Cell::number(f64::from(set.set), 0),
                Cell::text(SetKind::of(set.set).map_or("", |kind| kind.image.label())),
                Cell::text(&result.submission),
                cell(0, 2),
                Cell::number(result.q_leaderboard, 2),
                cell(1, 1),
                cell(2, 4),
                cell(3, 4),
                cell(4, 4),
                Cell::text(format!(
                    "{}/{}",
                    result.matched.number(),
                    result.best.number()
                )),
                Cell::number(result.flagged as f64, 0),
            ]);
        }
    }
    Table {
        title: "Every set and submission".into(),
        headings: vec![
            Heading::new("set", "Set"),
            Heading::new("kind", "Kind"),
            Heading::new("submission", "Submission"),
            Heading::new("q", "Q"),
            Heading::new("q_leaderboard", "Q leaderboard"),
            Heading::new("q_dn", "Q_dn"),
            Heading::new("m_half", "M/2"),
            Heading::new("sqrt_a", "√A×10⁴"),
            Heading::new("m_cross", "m (cross)"),
            Heading::new("conventions", "Conv. matched/best"),
            Heading::new("flagged", "Flagged"),
        ],
        rows,
        notes: Vec::new(),
    }
}

/// Fig. 9: true and measured shear power spectra, a panel per set.
pub fn power_spectra(results: &[SetResult], place: usize, name: &str) -> PanelGrid {
    let plots = results
        .iter()
        .map(|set| {
            let scored = |values: &[f64]| SCORED.map(|b| values[b]).collect::<Vec<f64>>();
            LinePlot {
                title: format!(
                    "Set {} {}",
                    set.set,
                    SetKind::of(set.set).map_or("", |kind| kind.image.label())
                ),
                x_label: "ℓ".into(),
                y_label: "ℓ²C_ℓ/2π".into(),
                x_log: true,
                y_log: true,
                series: vec![
                    Series::new("true", scored(&set.l), scored(&set.true_ee), Style::Line, 2),
                    Series::new(
                        "measured",
                        scored(&set.l),
                        scored(&set.results[place].ee),
                        Style::Line,
                        5,
                    ),
                ],
                ..LinePlot::default()
            }
        })
        .collect();
    PanelGrid {
        title: format!("Shear power spectra of {name}"),
        columns: 4,
        plots,
    }
}

/// The data of Fig. 9.
pub fn power_spectra_table(results: &[SetResult], place: usize) -> Table {
    let mut rows = Vec::new();
    for set in results {
        for b in SCORED {
            rows.push(vec![
                Cell::number(f64::from(set.set), 0),
                Cell::number(b as f64 + 1.0, 0),
                Cell::number(set.l[b], 1),
                Cell::number(set.true_ee[b], 9),
                Cell::number(set.results[place].ee[b], 9),
            ]);
        }
    }
    Table {
        title: "Shear power spectra".into(),
        headings: vec![
            Heading::new("set", "Set"),
            Heading::new("bin", "Bin"),
            Heading::new("l", "ℓ"),
            Heading::new("true", "true"),
            Heading::new("measured", "measured"),
        ],
        rows,
        notes: Vec::new(),
    }
}

/// Figs 10 and 11: M/2 or √A per set for two submissions.
pub fn bias_per_set(
    results: &[SetResult],
    places: &[(usize, &str)],
    figure: usize,
    title: &str,
    y_label: &str,
) -> BarPlot {
    let groups = places
        .iter()
        .map(|&(place, name)| {
            let over = over_sets(results, place, figure);
            BarGroup {
                label: name.into(),
                values: over.iter().map(|v| v.0).collect(),
                errors: over.iter().map(|v| v.1).collect(),
            }
        })
        .collect();
    BarPlot {
        title: title.into(),
        y_label: y_label.into(),
        categories: set_labels(results),
        groups,
    }
}

/// One qualitative statement of the paper and what the simulation says.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// What the paper says.
    pub paper: &'static str,
    /// What was found here.
    pub here: String,
    /// Whether they agree; `None` where the errors do not tell.
    pub agrees: Option<bool>,
}

/// Mean ratio-like difference in Q of `second` over `first`: (ΔQ, error, Q of the first).
fn q_difference(results: &[SetResult], first: usize, second: usize) -> Option<(f64, f64, f64)> {
    let sets: Vec<PairedSet<'_>> = results
        .iter()
        .map(|set| PairedSet {
            images: set.images as usize,
            first: set.results[first].figures.q,
            first_replicates: &set.results[first].q_replicates,
            second: set.results[second].figures.q,
            second_replicates: &set.results[second].q_replicates,
        })
        .collect();
    let difference = paired_difference(&sets)?;
    let mean = mean_over_sets(&over_sets(results, first, 0)).0;
    Some((difference.difference, difference.error, mean))
}

/// The paper's qualitative findings (Sect. 5.3) held against `results`.
pub fn findings(results: &[SetResult], names: &[String]) -> Vec<Finding> {
    let place = |name: &str| names.iter().position(|n| n == name);
    let mut found = Vec::new();
    let mut compare = |paper, first: &str, second: &str, expected: fn(f64, f64) -> Option<bool>| {
        let (Some(a), Some(b)) = (place(first), place(second)) else {
            return;
        };
        let Some((difference, error, mean)) = q_difference(results, a, b) else {
            return;
        };
        found.push(Finding {
            paper,
            here: format!(
                "Q of {second} is {:+.1} ± {:.1} % from that of {first}",
                100.0 * difference / mean,
                100.0 * error / mean
            ),
            agrees: expected(difference / mean, error / mean),
        });
    };
    let higher: fn(f64, f64) -> Option<bool> = |d, e| {
        if d.abs() < 2.0 * e {
            None
        } else {
            Some(d > 0.0)
        }
    };
    compare(
        "Denoising improves Q by 5 to 10 % (star PSF)",
        "23/raw/star",
        "23/den/star",
        higher,
    );
    compare(
        "Denoising improves Q (functional PSF)",
        "23/raw/func",
        "23/den/func",
        higher,
    );
    compare(
        "Larger stamps improve Q",
        "23/den/func",
        "29/den/func",
        higher,
    );
    compare(
        "Star and functional PSF give much the same Q",
        "23/den/func",
        "23/den/star",
        // The paper's own two differ by 4 %.
        |d, _| Some(d.abs() < 0.05),
    );
    let Some(den) = place("23/den/star") else {
        return found;
    };
    let mean_of = |wanted: &dyn Fn(ImageType) -> bool, figure: usize| -> Option<f64> {
        let values: Vec<f64> = results
            .iter()
            .filter(|set| SetKind::of(set.set).is_some_and(|kind| wanted(kind.image)))
            .map(|set| set.results[den].figures.values()[figure])
            .collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let fiducial = mean_of(&|kind| kind == ImageType::Fiducial, 0);
    let mut kinds = |paper, label: &str, kind: ImageType, above: bool| {
        if let (Some(q), Some(base)) = (mean_of(&|k| k == kind, 0), fiducial) {
            found.push(Finding {
                paper,
                here: format!("{label}: Q {q:.1}, fiducial {base:.1}"),
                agrees: Some((q > base) == above),
            });
        }
    };
    kinds(
        "Q is good for sets 10 and 11 (smooth S/N)",
        "smooth S/N",
        ImageType::SmoothSnr,
        true,
    );
    kinds(
        "Q is good for sets 17 and 18 (smooth galaxies)",
        "smooth galaxies",
        ImageType::SmoothGalaxy,
        true,
    );
    kinds("Q is poor at low S/N", "low S/N", ImageType::LowSnr, false);
    kinds(
        "Q is poor for small galaxies",
        "small galaxies",
        ImageType::SmallGalaxy,
        false,
    );
    kinds(
        "Q is best for offset bulges (sets 23, 24)",
        "offset bulges",
        ImageType::OffsetBulge,
        true,
    );
    kinds(
        "Q is best for turbulent PSFs (set 20)",
        "Kolmogorov PSF",
        ImageType::Kolmogorov,
        true,
    );
    if let Some(raw) = place("23/raw/star") {
        let mean = |place: usize, figure: usize| mean_over_sets(&over_sets(results, place, figure));
        let mut bias = |paper, figure: usize, name: &str, lower: bool| {
            let ((raw, raw_error), (den, den_error)) = (mean(raw, figure), mean(den, figure));
            let error = raw_error
                .unwrap_or(f64::NAN)
                .hypot(den_error.unwrap_or(f64::NAN));
            let change = den.abs() - raw.abs();
            found.push(Finding {
                paper,
                here: format!("{name}: raw {raw:+.4}, denoised {den:+.4}, ± {error:.4} on the difference at most"),
                agrees: (change.abs() > error).then_some((change < 0.0) == lower),
            });
        };
        bias(
            "Denoising decreases the multiplicative bias",
            2,
            "M/2",
            true,
        );
        bias(
            "Denoising slightly increases the additive bias",
            3,
            "√A×10⁴",
            false,
        );
    }
    found
}

/// Findings as a table.
pub fn findings_table(findings: &[Finding]) -> Table {
    Table {
        title: "The paper's findings".into(),
        headings: vec![
            Heading::new("paper", "The paper"),
            Heading::new("here", "Here"),
            Heading::new("agrees", "Agrees"),
        ],
        rows: findings
            .iter()
            .map(|f| {
                vec![
                    Cell::text(f.paper),
                    Cell::text(&f.here),
                    Cell::text(match f.agrees {
                        Some(true) => "yes",
                        Some(false) => "no",
                        None => "errors do not tell",
                    }),
                ]
            })
            .collect(),
        notes: Vec::new(),
    }
}
