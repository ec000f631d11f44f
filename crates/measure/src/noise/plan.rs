//! What is prepared for measuring the noise of images with stamps of one size.

use std::sync::Arc;

use ndarray::Array2;
use shearq_submissions::SkySource;

use super::blocks::{BLOCK, PIXELS, POLYNOMIALS, frame, polynomials};
use super::covariance::{lags, matrix};
use crate::error::MeasureError;
use crate::examine::enough;

/// Side of the smallest stamps whose border is free of the galaxy. See docs/constants.md.
const LEAST_STAMP: usize = 24;

/// Plan for measuring the noise of images with stamps of one size.
#[derive(Debug, Clone)]
pub struct NoisePlan {
    pub(super) full: usize,
    pub(super) reach: usize,
    /// What is done about the sky; `None` if it is not looked at.
    pub(super) sky: Option<SkySource>,
    /// First pixels of the blocks, around the frame.
    pub(super) blocks: Arc<[(usize, usize)]>,
    pub(super) lags: Arc<[(i32, i32)]>,
    pub(super) polynomials: Arc<[[f64; PIXELS]; POLYNOMIALS]>,
    /// M(l, l′).
    pub(super) matrix: Arc<Array2<f64>>,
}

impl NoisePlan {
    /// Plans for stamps of `full` pixels a side and a covariance of lags up to `reach` along each axis.
    ///
    /// # Errors
    /// If the stamps are smaller than 24 × 24 pixels, or the lags longer than 4 px.
    pub fn new(full: usize, reach: usize) -> Result<Self, MeasureError> {
        if full < LEAST_STAMP {
            let expected = format!(
                "at least {LEAST_STAMP} × {LEAST_STAMP}, for the noise to be measured on their frames"
            );
            return Err(MeasureError::square("stamps", (full, full), expected));
        }
        if reach > BLOCK / 2 {
            return Err(MeasureError::Shape {
                what: "a noise correlation",
                found: format!("lags up to {reach} px"),
                expected: format!("at most {} px", BLOCK / 2),
            });
        }
        let polynomials = polynomials();
        Ok(NoisePlan {
            full,
            reach,
            sky: None,
            blocks: frame(full).into(),
            lags: lags(reach).into(),
            matrix: Arc::new(matrix(reach, &polynomials)),
            polynomials: Arc::new(polynomials),
        })
    }

    /// The same with the sky of images, as a configuration treats it.
    #[must_use]
    pub fn with_sky(self, sky: SkySource) -> Self {
        NoisePlan {
            sky: Some(sky),
            ..self
        }
    }

    /// Which of `rows` rows of `columns` stamps are looked at, evenly spread: enough for a thousand stamps,
    /// or all.
    pub fn rows(&self, columns: usize, rows: usize) -> Vec<usize> {
        let count = enough(columns, rows);
        (0..count)
            .map(|k| (2 * k + 1) * rows / (2 * count))
            .collect()
    }
}
