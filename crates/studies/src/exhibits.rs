//! The figures and tables of the paper from the results of the studies.

mod findings;
mod lambda;
mod sets;

pub use findings::{Finding, findings, findings_table, lambda_findings};
pub use lambda::{calibration_figures, calibration_table, curves_table};
pub use sets::{
    bias_per_set, denoising_table, per_set_table, power_spectra, power_spectra_table, q_per_set,
    table_one,
};
