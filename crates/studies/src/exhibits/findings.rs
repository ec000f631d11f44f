//! The qualitative statements of the paper, compared with results.

use shearq_scoring::Metrics;
use shearq_scoring::resample::mean_over_sets;

use super::sets::{mean_of_24, weighted};
use crate::calibration::{CTR_SNR_DB, Curves, LOG_LAMBDA, LambdaSums, PAPER_LAMBDA, SNR_DB};
use crate::reproduce::SetResult;
use shearq_render::table::{Cell, Heading, Table};
use shearq_results::compare::{Paired, difference};
use shearq_simulate::kinds::{ImageType, SetKind};
use std::slice::from_ref;

/// A qualitative statement of the paper and the result of the simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// The statement.
    pub paper: &'static str,
    /// The result here.
    pub here: String,
    /// Whether they agree; `None` if the errors are too large to decide.
    pub agrees: Option<bool>,
}

/// Mean difference in Q of `second` from `first` over the challenge's 24 sets: (ΔQ, error, Q of the first).
fn q_difference(results: &[SetResult], first: usize, second: usize) -> Option<(f64, f64, f64)> {
    let of_set = |set: &SetResult| {
        let [a, b] = [first, second].map(|configuration| &set.results[configuration].score);
        difference(Paired::Q, from_ref(a), from_ref(b))
            .map(|paired| (paired.difference, paired.error))
    };
    let differences = results.iter().map(of_set).collect::<Option<Vec<_>>>()?;
    let (difference, error) = weighted(results, &differences);
    Some((difference, error, mean_of_24(results, first, |f| f.q).0))
}

/// A value with its error, as in sentences.
fn with_error(value: f64, error: f64, decimals: usize) -> String {
    Cell::with_error(value, Some(error), decimals).in_words()
}

/// The qualitative statements of the paper's Sect. 5.3, compared with `results`.
pub fn findings(results: &[SetResult], names: &[String]) -> Vec<Finding> {
    let place = |name: &str| names.iter().position(|n| n == name);
    let mut found = q_findings(results, names);
    let Some(den) = place("23/den/star") else {
        return found;
    };
    found.extend(kind_findings(results, den));
    if let Some(raw) = place("23/raw/star") {
        found.extend(bias_findings(results, raw, den));
    }
    found
}

/// Whether a difference is positive, if it is significant. `None` if its error is unknown.
fn is_higher(difference: f64, error: f64) -> Option<bool> {
    (difference.abs() >= 2.0 * error).then_some(difference > 0.0)
}

/// Statements on Q of pairs of configurations.
fn q_findings(results: &[SetResult], names: &[String]) -> Vec<Finding> {
    type Expected = fn(f64, f64) -> Option<bool>;
    let statements: [(&str, &str, &str, Expected); 5] = [
        (
            "Denoising improves Q (star PSF)",
            "23/raw/star",
            "23/den/star",
            is_higher,
        ),
        ("by 5 to 10 %", "23/raw/star", "23/den/star", |d, e| {
            let inside = d - e > 0.05 && d + e < 0.10;
            let outside = d + 2.0 * e < 0.05 || d - 2.0 * e > 0.10;
            (inside || outside).then_some(inside)
        }),
        (
            "Denoising improves Q (functional PSF)",
            "23/raw/func",
            "23/den/func",
            is_higher,
        ),
        (
            "Larger stamps improve Q",
            "23/den/func",
            "29/den/func",
            is_higher,
        ),
        (
            "Star and functional PSF give much the same Q",
            "23/den/func",
            "23/den/star",
            // The two differ by 4 % in the paper.
            |d, _| Some(d.abs() < 0.05),
        ),
    ];
    let place = |name: &str| names.iter().position(|n| n == name);
    let compare = |(paper, first, second, expected): (&'static str, &str, &str, Expected)| {
        let (difference, error, mean) = q_difference(results, place(first)?, place(second)?)?;
        let percent = with_error(100.0 * difference / mean, 100.0 * error / mean, 1);
        Some(Finding {
            paper,
            here: format!("Q of {second} minus Q of {first}: {percent} %"),
            agrees: expected(difference / mean, error / mean),
        })
    };
    statements.into_iter().filter_map(compare).collect()
}

/// Statements on Q of kinds of sets, for the configuration at `place`.
fn kind_findings(results: &[SetResult], place: usize) -> Vec<Finding> {
    // Statement, label, kind, whether Q is expected above the fiducial Q.
    let statements = [
        (
            "Q is good for sets 10 and 11 (smooth S/N)",
            "smooth S/N",
            ImageType::SmoothSnr,
            true,
        ),
        (
            "Q is good for sets 17 and 18 (smooth galaxies)",
            "smooth galaxies",
            ImageType::SmoothGalaxy,
            true,
        ),
        ("Q is poor at low S/N", "low S/N", ImageType::LowSnr, false),
        (
            "Q is poor for small galaxies",
            "small galaxies",
            ImageType::SmallGalaxy,
            false,
        ),
        (
            "Q is best for offset bulges (sets 23, 24)",
            "offset bulges",
            ImageType::OffsetBulge,
            true,
        ),
        (
            "Q is best for turbulent PSFs (set 20)",
            "Kolmogorov PSF",
            ImageType::Kolmogorov,
            true,
        ),
    ];
    // Mean Q over the sets of a kind, and its error.
    let mean_of = |wanted: ImageType| -> Option<(f64, f64)> {
        let values: Vec<(f64, f64)> = results
            .iter()
            .filter(|set| SetKind::of(set.set).is_some_and(|kind| kind.image == wanted))
            .map(|set| &set.results[place].score)
            .map(|score| (score.metrics.q, score.errors.q))
            .collect();
        (!values.is_empty()).then(|| mean_over_sets(&values))
    };
    let Some((base, base_error)) = mean_of(ImageType::Fiducial) else {
        return Vec::new();
    };
    let compare = |(paper, label, kind, above): (&'static str, &str, ImageType, bool)| {
        let (q, error) = mean_of(kind)?;
        let significant = (q - base).abs() > 2.0 * error.hypot(base_error);
        Some(Finding {
            paper,
            here: format!(
                "{label}: Q {}, fiducial {}",
                with_error(q, error, 1),
                with_error(base, base_error, 1)
            ),
            agrees: significant.then_some((q > base) == above),
        })
    };
    statements.into_iter().filter_map(compare).collect()
}

/// Statements on the biases of the configurations at `raw` and `den`, without and with denoising.
fn bias_findings(results: &[SetResult], raw: usize, den: usize) -> [Finding; 2] {
    let bias = |paper, metric: fn(&Metrics) -> f64, name: &str, lower: bool| {
        let mean = |place: usize| mean_of_24(results, place, metric);
        let ((raw, raw_error), (den, den_error)) = (mean(raw), mean(den));
        let error = raw_error.hypot(den_error);
        let change = den.abs() - raw.abs();
        Finding {
            paper,
            here: format!(
                "{name}: raw {}, denoised {}",
                with_error(raw, raw_error, 4),
                with_error(den, den_error, 4)
            ),
            agrees: (change.abs() > error).then_some((change < 0.0) == lower),
        }
    };
    [
        bias(
            "Denoising decreases the multiplicative bias",
            |f| f.m_half,
            "M/2",
            true,
        ),
        bias(
            "Denoising slightly increases the additive bias",
            |f| f.sqrt_a,
            "√A×10⁴",
            false,
        ),
    ]
}

/// The range of values, in words.
fn range(values: impl Iterator<Item = f64>, decimals: usize) -> String {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    format!("{low:.decimals$} to {high:.decimals$}")
}

/// The qualitative statements of the paper's Sect. 4, compared with `curves`.
pub fn lambda_findings(curves: &Curves) -> Vec<Finding> {
    let [adaptive, constant] = [&curves.over_lambda[0], &curves.over_lambda[1]];
    let over_snr = |rule: usize| curves.over_snr[rule].iter().map(LambdaSums::ctr);
    let weak = PAPER_LAMBDA;
    let rising = |values: Vec<f64>| values.windows(2).all(|pair| pair[1] > pair[0]);
    let ctr_rises = rising(adaptive.iter().map(|curve| curve[weak].ctr()).collect());
    let dsnr_rises = rising(adaptive.iter().map(|c| c[weak].mean_dsnr()).collect());
    let strongest = LOG_LAMBDA.len() - 1;
    let dsnr_falls = adaptive
        .iter()
        .all(|curve| curve[strongest].mean_dsnr() < curve[weak].mean_dsnr());
    let best = |curve: &[LambdaSums]| {
        let best = (0..curve.len()).max_by(|a, b| curve[*a].ctr().total_cmp(&curve[*b].ctr()));
        LOG_LAMBDA[best.unwrap_or(0)]
    };
    // 1/RMSD of the adaptive rule over that of the constant one.
    let gains = |snr: usize, from: usize, to: usize| -> Vec<f64> {
        (from..=to)
            .map(|k| adaptive[snr][k].inverse_rmsd() / constant[snr][k].inverse_rmsd())
            .collect()
    };
    let small: Vec<f64> = (0..SNR_DB.len())
        .flat_map(|snr| gains(snr, 0, weak))
        .collect();
    let large = |snr: usize| gains(snr, weak + 1, strongest);
    let everywhere = |gains: &[f64]| gains.iter().all(|gain| *gain >= 1.0);
    let quiet: Vec<f64> = (1..SNR_DB.len()).flat_map(large).collect();
    vec![
        Finding {
            paper: "Whatever the S/N, the adaptive update has the higher CTR",
            here: format!(
                "CTR {} adaptive, {} constant, from {} to {} dB",
                range(over_snr(0), 2),
                range(over_snr(1), 2),
                CTR_SNR_DB[0],
                CTR_SNR_DB[CTR_SNR_DB.len() - 1]
            ),
            agrees: Some(over_snr(0).zip(over_snr(1)).all(|(a, c)| a > c)),
        },
        Finding {
            paper: "CTR increases with S/N",
            here: format!(
                "at λ = 10⁻⁴ it is {} at 10, 20 and 40 dB",
                adaptive
                    .iter()
                    .map(|curve| format!("{:.3}", curve[weak].ctr()))
                    .collect::<Vec<_>>()
                    .join(", ")
            ),
            agrees: Some(ctr_rises),
        },
        Finding {
            paper: "CTR is highest at λ = 10^−3.5",
            here: format!(
                "highest at λ = 10^{} at 10, 20 and 40 dB",
                adaptive
                    .iter()
                    .map(|curve| format!("{:.1}", best(curve)))
                    .collect::<Vec<_>>()
                    .join(", 10^")
            ),
            agrees: Some(adaptive.iter().all(|curve| best(curve) == -3.5)),
        },
        Finding {
            paper: "dSNR is higher for higher S/N and decreases with λ",
            here: format!(
                "at λ = 10⁻⁴ {} dB, at 10⁶ {} dB",
                range(adaptive.iter().map(|c| c[weak].mean_dsnr()), 2),
                range(adaptive.iter().map(|c| c[strongest].mean_dsnr()), 2)
            ),
            agrees: Some(dsnr_rises && dsnr_falls),
        },
        Finding {
            paper: "1/RMSD of the adaptive update is the better one for λ ≤ 10⁻⁴, whatever the S/N",
            here: format!(
                "{} times the constant update's",
                range(small.iter().copied(), 2)
            ),
            agrees: Some(everywhere(&small)),
        },
        Finding {
            paper: "and beyond at 20 and 40 dB",
            here: format!("{} times", range(quiet.iter().copied(), 2)),
            agrees: Some(everywhere(&quiet)),
        },
        Finding {
            paper: "but not at 10 dB",
            here: format!("{} times", range(large(0).into_iter(), 2)),
            agrees: Some(!everywhere(&large(0))),
        },
    ]
}

/// Findings as a table.
pub fn findings_table(findings: &[Finding]) -> Table {
    Table {
        title: "The paper's findings".into(),
        headings: vec![
            Heading::new("agrees", "Agrees"),
            Heading::new("paper", "The paper"),
            Heading::new("here", "Here"),
        ],
        rows: findings
            .iter()
            .map(|f| {
                vec![
                    Cell::text(match f.agrees {
                        Some(true) => "yes",
                        Some(false) => "no",
                        None => "undecided",
                    }),
                    Cell::text(f.paper),
                    Cell::text(&f.here),
                ]
            })
            .collect(),
        notes: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::calibrate;
    use crate::reproduce::{Plan, Study, run_sets};
    use shearq_pipeline::engine::Quiet;
    use shearq_simulate::set::SimulationSettings;
    use shearq_submissions::Registry;

    #[test]
    fn only_significant_differences_are_decided() {
        assert_eq!(is_higher(0.3, 0.1), Some(true));
        assert_eq!(is_higher(-0.3, 0.1), Some(false));
        assert_eq!(is_higher(0.15, 0.1), None);
        assert_eq!(is_higher(0.15, f64::NAN), None);
    }

    #[test]
    fn statements_need_their_configurations_and_kinds() {
        let registry = Registry::embedded().unwrap();
        let names = ["23/raw/star", "23/den/star"];
        let plan = Plan {
            version: "test".into(),
            simulation: SimulationSettings::new(5, 12),
            images: 2,
            submissions: names
                .map(|name| registry.get(name).unwrap().configuration)
                .into(),
        };
        let folder = tempfile::tempdir().unwrap();
        let study = Study::open(&plan, folder.path()).unwrap();
        let mut results = run_sets(&study, &[2, 5], 1, &mut Quiet).unwrap();
        // Known metrics: denoising halves M/2, and set 5 (low S/N) has a lower Q.
        for (set, q) in results.iter_mut().zip([10.0, 4.0]) {
            for (result, m) in set.results.iter_mut().zip([-0.2, -0.1]) {
                let record = &mut result.score;
                (record.metrics.q, record.errors.q) = (q, 0.1);
                (record.metrics.m_half, record.errors.m_half) = (m, 0.01);
                (record.metrics.sqrt_a, record.errors.sqrt_a) = (1.0, 0.1);
            }
        }
        let names = names.map(String::from);
        let all = findings(&results, &names);
        let agrees = |words: &str| {
            let found = all.iter().find(|finding| finding.paper.contains(words));
            found.unwrap().agrees
        };
        assert_eq!(agrees("poor at low S/N"), Some(true));
        assert_eq!(agrees("decreases the multiplicative bias"), Some(true));
        assert_eq!(agrees("increases the additive bias"), None);
        assert!(all.iter().all(|finding| !finding.paper.contains("Larger")));
        assert!(all.iter().all(|finding| !finding.paper.contains("offset")));
        assert_eq!(findings_table(&all).rows.len(), all.len());
        // Without the denoising configuration only pairs could be compared, and there is none.
        assert_eq!(findings(&results, &names[..1]), []);
    }

    #[test]
    fn every_statement_on_lambda_has_a_result() {
        let paper = Registry::embedded().unwrap().get("paper").unwrap();
        let curves = calibrate(&paper.configuration, 8, 1, 1, &mut Quiet).unwrap();
        let found = lambda_findings(&curves);
        assert!(!found.is_empty());
        let decided = |finding: &Finding| finding.agrees.is_some() && !finding.here.contains("NaN");
        assert!(found.iter().all(decided), "{found:?}");
    }
}
