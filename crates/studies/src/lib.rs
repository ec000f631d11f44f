//! Studies on simulated data: the paper (Nurbaeva et al. 2015, A&A 577, A104) reproduced with its calibration of λ
//! (Sect. 4) and its configurations on 24 sets (Sect. 5), configurations compared with each other and with the
//! Cramér–Rao bound, and speed.
#![forbid(unsafe_code)]

pub mod bias;
pub mod bound;
pub mod calibration;
pub mod exhibits;
pub mod reproduce;
pub mod response;
pub mod speed;
pub mod study;

// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
