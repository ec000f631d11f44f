//! Studies: the paper's Sect. 4 (calibration of λ) and Sect. 5 (seven submissions on 24 sets), submissions
//! against each other and against what can be reached, convergence, speed.

pub mod bias;
pub mod bound;
pub mod calibration;
pub mod contest;
pub mod convergence;
pub mod exhibits;
pub mod reproduce;
pub mod response;
pub mod speed;

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
