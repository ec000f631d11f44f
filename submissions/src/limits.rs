//! Limits that the arithmetic of the measurement sets to settings.

/// Largest side of what is cut of a stamp, in pixels.
pub const MAX_CUT: usize = 64;

/// Largest side of a PSF stamp, in pixels.
pub const MAX_PSF: usize = 48;

/// Pixels a side of the smallest PSF stamps that the linear method takes where its settings ask for more.
pub const LEAST_PSF: usize = 32;

/// Narrowest target of the linear method, in pixels.
pub const MIN_TARGET: f64 = 1.0;

/// Broadest target of the linear method, in pixels.
pub const MAX_TARGET: f64 = 6.0;

/// Windows of the linear method, in pixels.
pub const WINDOWS: std::ops::RangeInclusive<f64> = 2.0..=16.0;

/// Largest eigenvalue of G = DᵀD, D being Sun's high-pass (Sect. 3.1), rounded up: the square of the kernel's
/// transform where that is largest.
pub const MAX_ROUGHNESS: f64 = 0.0093;
