//! End to end, through the binary and the library's public face.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    clippy::too_many_lines,
    reason = "a failed test stops at the cause and prints to standard error; tables of cases are long"
)]

mod bias;
mod cases;
mod challenge;
mod challenge_scenes;
mod chosen_images;
mod constants;
mod damaged;
mod detection;
mod documents;
mod entry_points;
mod figures;
mod fuzz;
mod galsim;
mod gathered;
mod generated;
mod great3;
mod great3_release;
mod identity;
mod inputs;
mod killed;
mod ledger;
mod one_session;
mod orientation;
mod packed;
mod recognised;
mod reference;
mod reproduced;
mod scenes;
mod scoring_cases;
mod source;
mod support;
mod terminal;
