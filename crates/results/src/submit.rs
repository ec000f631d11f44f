//! Submissions to a challenge: their files, archives and checks.

pub mod archive;
pub mod challenge;
pub mod check;
pub mod manifest;
pub mod pack;
pub mod packed;
