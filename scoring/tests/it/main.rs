//! Tests of the scoring through its public face.

#![allow(
    clippy::unwrap_used,
    clippy::too_many_lines,
    reason = "a failed test stops at the cause; tables of cases are long"
)]

mod api;
mod common;
mod conventions;
mod coverage;
mod definitions;
mod derivations;
mod edges;
mod great3;
mod input;
mod responses;
