//! What is found at a pixel, and the sums over the pixels of a detection.

use shearq_measure::ResponseMatrix;

/// A pixel with a weight above zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectedPixel {
    /// Column and row, from 0.
    pub place: [usize; 2],
    /// The weight w.
    pub weight: f64,
    /// w e.
    pub e: [f64; 2],
    /// The response of w e.
    pub response: ResponseMatrix,
    /// Smoothed light over its noise.
    pub snr: f64,
}

/// Sums over pixels that touch each other.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Detection {
    /// Mean place (x, y) under the weight in pixels, from 0.
    pub centre: [f64; 2],
    /// Σ w.
    pub weight: f64,
    /// Σ w e.
    pub e: [f64; 2],
    /// Response of Σ w e.
    pub response: ResponseMatrix,
    /// The largest S/N of the smoothed light.
    pub snr: f64,
    /// Pixels with a weight.
    pub pixels: usize,
}

impl Detection {
    /// Of one pixel; its centre is a sum over weights until [`Detection::centred`].
    pub(crate) fn of(pixel: &DetectedPixel) -> Self {
        Detection {
            centre: pixel.place.map(|at| at as f64 * pixel.weight),
            weight: pixel.weight,
            e: pixel.e,
            response: pixel.response,
            snr: pixel.snr,
            pixels: 1,
        }
    }

    pub(crate) fn add(&mut self, other: &Self) {
        self.weight += other.weight;
        self.snr = self.snr.max(other.snr);
        self.pixels += other.pixels;
        for i in 0..2 {
            self.centre[i] += other.centre[i];
            self.e[i] += other.e[i];
            for j in 0..2 {
                self.response[i][j] += other.response[i][j];
            }
        }
    }

    pub(crate) fn centred(mut self) -> Self {
        self.centre = self.centre.map(|sum| sum / self.weight);
        self
    }
}
