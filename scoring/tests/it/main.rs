//! Tests of the scoring through its public face.

mod common;
mod conventions;
mod coverage;
mod definitions;
mod great10_cases;
