//! Scores as tables, plots and pages.

pub mod baseline;
pub mod bias;
pub mod comparison;
pub mod diagnosis;
mod junit;
pub mod mean;
pub mod pages;
pub mod scores;
pub mod spectrum;
pub mod steps;
