//! What is handed in: challenge files, packed for sending and checked before.

pub mod archive;
pub mod challenge;
pub mod check;
pub mod manifest;
pub mod pack;
pub mod packed;
