//! Tests of the scoring through its public face.

mod by_hand;
mod common;
mod conventions;
mod coverage;
mod definitions;
mod edges;
mod great10_cases;
