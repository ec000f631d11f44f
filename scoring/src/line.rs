//! Straight lines through points.

/// The straight line of least squares through points (x, y), such as measured against true shears.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Line {
    /// y at x = 0.
    pub intercept: f64,
    /// 0 if the x do not differ.
    pub slope: f64,
    /// Mean x and y.
    pub mean: (f64, f64),
    /// Number of points.
    pub count: f64,
    // Mean squares of x − x̄, y − ȳ, their product, and the residuals.
    square: f64,
    cross: f64,
    height: f64,
    residual: f64,
}

// Scatter of x that rounding can make of equal numbers, in their root mean square. A sum of N of them is off by up to
// N·10⁻¹⁶, and challenges have up to 10⁵ fields or bandpowers.
const ROUNDING: f64 = 1e-10;

fn differ(variance: f64, mean: f64) -> bool {
    variance > ROUNDING.powi(2) * (variance + mean * mean)
}

impl Line {
    /// The line through `points`; NaN without any.
    pub fn through(points: &[(f64, f64)]) -> Self {
        let count = points.len() as f64;
        let mean =
            |of: &dyn Fn(f64, f64) -> f64| points.iter().map(|p| of(p.0, p.1)).sum::<f64>() / count;
        let (x, y) = (mean(&|x, _| x), mean(&|_, y| y));
        let square = mean(&|own, _| (own - x).powi(2));
        let cross = mean(&|own, value| (own - x) * (value - y));
        let slope = if differ(square, x) {
            cross / square
        } else {
            0.0
        };
        let intercept = y - slope * x;
        Line {
            intercept,
            slope,
            mean: (x, y),
            count,
            square,
            cross,
            height: mean(&|_, own| (own - y).powi(2)),
            residual: mean(&|x, y| (y - intercept - slope * x).powi(2)),
        }
    }

    /// Whether the x differ by more than rounding, so that there is a slope. Without this test, a constant true shear
    /// had slopes of ±10¹⁵.
    pub fn is_determined(&self) -> bool {
        differ(self.square, self.mean.0)
    }

    /// Variance of a point around the line, with N − 2 degrees of freedom; NaN of two points.
    pub fn variance(&self) -> f64 {
        match self.count > 2.0 {
            true => self.count * self.residual / (self.count - 2.0),
            false => f64::NAN,
        }
    }

    /// Standard error of the slope by the scatter of the points around the line.
    pub fn slope_error(&self) -> f64 {
        (self.variance() / (self.count * self.square)).sqrt()
    }

    /// Standard errors of intercept and slope with N degrees of freedom instead of N − 2, as GREAT3 has them.
    pub fn errors_of_great3(&self) -> [f64; 2] {
        let error = (self.residual / self.square / self.count).sqrt();
        [error * (self.square + self.mean.0.powi(2)).sqrt(), error]
    }

    /// Derivatives of intercept and slope with the y of a point at `x`, by which errors of the points propagate.
    pub fn derivatives(&self, x: f64) -> [f64; 2] {
        let slope = (x - self.mean.0) / (self.count * self.square);
        [1.0 / self.count - self.mean.0 * slope, slope]
    }

    /// Pearson's correlation of x and y.
    pub fn correlation(&self) -> f64 {
        self.cross / (self.square * self.height).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_have_the_errors_of_text_books() {
        let line = Line::through(&[(1.0, 1.0), (2.0, 3.0), (3.0, 2.0), (6.0, 6.0)]);
        // Σ(x − 3)² = 14, Σ(x − 3)(y − 3) = 13, Σ(y − 3)² = 14.
        assert!((line.slope - 13.0 / 14.0).abs() < 1e-15);
        assert!((line.intercept - 3.0 / 14.0).abs() < 1e-15);
        let residuals = 14.0 - 169.0 / 14.0;
        assert!((line.slope_error() - (residuals / 2.0 / 14.0_f64).sqrt()).abs() < 1e-15);
        // The same without degrees of freedom, and at x = 0 of the mean 3.
        let [intercept, slope] = line.errors_of_great3();
        assert!((slope - (residuals / 4.0 / 14.0_f64).sqrt()).abs() < 1e-15);
        assert!((intercept - slope * (14.0 / 4.0 + 9.0_f64).sqrt()).abs() < 1e-15);
        assert!((line.correlation() - 13.0 / 14.0).abs() < 1e-15);
        assert!((line.derivatives(6.0)[1] - 3.0 / 14.0).abs() < 1e-15);
    }

    #[test]
    fn equal_numbers_have_no_slope_by_rounding() {
        let points: Vec<_> = (0..200).map(|k| (0.02, f64::from(k).sin())).collect();
        let line = Line::through(&points);
        assert!(!line.is_determined() && line.slope == 0.0);
        let points = [(0.02, 0.0), (0.02 + 1e-9, 0.0)];
        assert!(Line::through(&points).is_determined());
    }
}
