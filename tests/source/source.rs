//! The source code itself: levels of crates, cycles of modules, lengths of files, the public API.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a failed test stops at the cause"
)]

mod api;
mod crates;
mod lengths;
mod modules;
mod tree;
mod unsafe_code;
