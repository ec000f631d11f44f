//! Studies on simulated data: calibration of λ (Sect. 4 of the paper), seven configurations on 24 sets (Sect. 5),
//! configurations compared with each other and with the Cramér–Rao bound, convergence, speed.
#![forbid(unsafe_code)]

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
