//! What is handed in: challenge files, packed for sending and checked before; catalogues of other
//! programs.

pub mod archive;
pub mod challenge;
pub mod check;
pub mod foreign;
pub mod manifest;
pub mod pack;
pub mod packed;
