//! What is handed in: challenge files, catalogues of other programs, and checks before sending.

pub mod challenge;
pub mod check;
pub mod foreign;
