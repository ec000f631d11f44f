//! The noise of an image: its level, its correlation and its power.

/// Least power of a mode of correlated noise, in units of white noise. See docs/constants.md.
const LEAST_POWER: f64 = 1e-3;

/// The noise of an image: its level, and the correlation of its pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct StampNoise {
    pub(super) sigma: f64,
    pub(super) error: f64,
    pub(super) reach: usize,
    /// Correlation at lags dy = 0…reach, dx = −reach…reach.
    pub(super) correlation: Vec<f64>,
    /// χ² of the correlation if there were none, and its degrees of freedom.
    pub(super) colour: (f64, f64),
}

impl StampNoise {
    /// White noise of a known level in image units.
    pub fn white(sigma: f64) -> Self {
        StampNoise {
            sigma,
            error: 0.0,
            reach: 0,
            correlation: vec![1.0],
            colour: (0.0, 0.0),
        }
    }

    /// Standard deviation of a pixel in image units.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Standard error of the level, in units of it.
    pub fn error(&self) -> f64 {
        self.error
    }

    /// Correlation of pixels (dx, dy) apart.
    pub fn correlation(&self, dx: i32, dy: i32) -> f64 {
        let (dx, dy) = if dy < 0 { (-dx, -dy) } else { (dx, dy) };
        let reach = self.reach as i32;
        if dx.abs() > reach || dy > reach {
            return 0.0;
        }
        self.correlation[(dy * (2 * reach + 1) + dx + reach) as usize]
    }

    /// Whether pixels are correlated more than chance would have it: χ² is five of its own standard
    /// deviations too large.
    pub fn is_correlated(&self) -> bool {
        let (square, freedom) = self.colour;
        square > freedom + 5.0 * (2.0 * freedom).sqrt()
    }

    /// Power at wave vector (kx, ky), in radians per pixel, in units of that of white noise of the same
    /// level, and its derivatives (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y).
    pub(crate) fn power(&self, [kx, ky]: [f64; 2]) -> (f64, [f64; 2]) {
        let reach = self.reach as i32;
        let (mut power, mut slopes) = (1.0, [0.0; 2]);
        for dy in 0..=reach {
            for dx in -reach..=reach {
                if dy == 0 && dx <= 0 {
                    continue;
                }
                let (x, y) = (f64::from(dx), f64::from(dy));
                let twice = 2.0 * self.correlation(dx, dy);
                let (sin, cos) = (kx * x + ky * y).sin_cos();
                power += twice * cos;
                slopes[0] -= twice * sin * (kx * x - ky * y);
                slopes[1] -= twice * sin * (ky * x + kx * y);
            }
        }
        if power < LEAST_POWER {
            return (LEAST_POWER, [0.0; 2]);
        }
        (power, slopes)
    }
}
