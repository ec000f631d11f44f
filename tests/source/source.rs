//! The source code itself: levels of crates and cycles of modules.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a failed test stops at the cause"
)]

mod crates;
mod modules;
mod tree;
mod unsafe_code;
