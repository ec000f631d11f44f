//! Tests of the scoring through its public face.

#![allow(clippy::unwrap_used, reason = "a test fails where it stands")]

mod api;
mod by_hand;
mod common;
mod conventions;
mod coverage;
mod definitions;
mod edges;
mod great10_cases;
