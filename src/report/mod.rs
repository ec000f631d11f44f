//! Tables, figures and pages of both.

pub mod figure;
mod font;
pub mod html;
pub mod scores;
pub mod table;
