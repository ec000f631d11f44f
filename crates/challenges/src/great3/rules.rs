//! What all files of a branch have in common: values that stand for no measurement, and messages about them.

use shearq_scoring::great3::Branch;

// A component from here on was not measured: averages leave out 9.9 and more, correlations 10 and more. Both as in the challenge.
pub(super) const NOT_AVERAGED: f64 = 9.9;
pub(super) const NOT_CORRELATED: f64 = 10.0;

/// A branch of GREAT3.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Great3(pub(super) Branch);

pub(super) fn zero(field: usize, name: &str) -> String {
    format!("field {field}: {name} is exactly zero, which no measurement gives")
}

pub(super) fn not_an_identity(row: usize, found: f64) -> String {
    format!(
        "row {}: not the identity of a galaxy (found {found}, expected SSSXXXYYY, such as 012034056)",
        row + 1
    )
}

pub(super) fn more(count: usize) -> String {
    match count {
        1 => String::new(),
        _ => format!(" and {} more", count - 1),
    }
}
