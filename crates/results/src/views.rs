//! Scores as tables, plots and pages.

pub mod bias;
pub mod comparison;
pub(crate) mod junit;
pub mod mean;
pub mod pages;
pub mod scores;
