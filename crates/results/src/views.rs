//! Scores as tables, plots and pages.

pub mod bias;
pub mod comparison;
pub mod mean;
pub mod pages;
pub mod per_area;
pub mod scores;
