//! Tables, figures and pages of both.

pub mod baseline;
pub mod comparison;
pub mod diagnosis;
pub mod escape;
pub mod figure;
mod font;
pub mod html;
pub mod mean;
pub mod page;
pub mod pages;
pub mod scores;
pub mod spectrum;
pub mod steps;
pub mod table;
pub mod terminal;
pub mod verdict;
