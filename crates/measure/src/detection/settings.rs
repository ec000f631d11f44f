//! What a detection is: the lengths and the widths of its steps.

/// Settings of a [`Detector`](super::Detector). Lengths are in units of the PSF's σ: that of the Gaussian with the same
/// noise-equivalent area.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct DetectionSettings {
    /// S/N of the smoothed light at which a pixel has half of its weight.
    pub threshold: f64,
    /// Half width of that step, in S/N.
    pub threshold_half_width: f64,
    /// σ of the Gaussian that smooths the deconvolved image for detection.
    pub detection_sigma: f64,
    /// Distance of the four neighbours that a pixel is compared with, rounded to whole pixels.
    pub neighbour_distance: f64,
    /// Half width of the steps of these differences: standard deviations of their noise …
    pub neighbour_half_width: f64,
    /// … plus this share of the smoothed light. Without it single pixels of bright galaxies dominate the response.
    pub neighbour_share: f64,
    /// σ of the Gaussian under which moments are taken.
    pub moment_sigma: f64,
    /// What is added to the light that moments are divided by, in standard deviations of its noise.
    pub softening: f64,
}

impl Default for DetectionSettings {
    // Of the first prototype, whose PSF had a σ of 1.55 px.
    fn default() -> Self {
        DetectionSettings {
            threshold: 7.0,
            threshold_half_width: 2.0,
            detection_sigma: 1.2,
            neighbour_distance: 1.9,
            neighbour_half_width: 1.0,
            neighbour_share: 0.15,
            moment_sigma: 2.2,
            softening: 15.0,
        }
    }
}
