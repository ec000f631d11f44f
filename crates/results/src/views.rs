//! Scores as tables, plots and pages.

pub mod bias;
pub mod comparison;
pub mod diagnosis;
pub(crate) mod junit;
pub mod mean;
pub mod pages;
pub mod scores;
pub mod spectrum;
pub mod steps;
