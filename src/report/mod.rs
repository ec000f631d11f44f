//! Tables and figures.

pub mod figure;
mod font;
pub mod scores;
pub mod table;
