//! The covariance of pixels behind the mean products of blocks.

use ndarray::Array2;
use shearq_quantities::linear::{Pivots, eliminate, substitute};

use super::blocks::{BLOCK, PIXELS, POLYNOMIALS, take_out};
use super::stamp_noise::StampNoise;

/// The noise that explains the mean products of `count` blocks, one product per lag up to `reach`. M is the `matrix` of
/// these lags. `None` if the variance is not positive.
pub(super) fn noise_of(
    matrix: &Array2<f64>,
    reach: usize,
    means: &[f64],
    count: f64,
) -> Option<StampNoise> {
    let covariance = solve(matrix, means)?;
    let variance = covariance[0];
    let positive = variance > 0.0 && variance.is_finite();
    positive.then(|| {
        let signed = reach as i32;
        let width = 2 * signed + 1;
        let mut correlation = vec![0.0; ((signed + 1) * width) as usize];
        for (&(dx, dy), value) in lags(reach).iter().zip(&covariance) {
            let ratio = value / variance;
            correlation[(dy * width + dx + signed) as usize] = ratio;
            if dy == 0 {
                correlation[(signed - dx) as usize] = ratio;
            }
        }
        let square = count * colour(matrix, &covariance) / (variance * variance);
        // Of squares of noise that is correlated in patches of Σρ² pixels.
        let patch = correlation.iter().map(|ratio| ratio * ratio).sum::<f64>() * 2.0;
        let freedom = (PIXELS - POLYNOMIALS) as f64 * count;
        StampNoise {
            sigma: variance.sqrt(),
            error: (0.5 * patch.max(1.0) / freedom).sqrt(),
            reach,
            correlation,
            colour: (square, covariance.len() as f64 - 1.0),
        }
    })
}

/// Solves linear equations; `None` where there is no solution.
fn solve(matrix: &Array2<f64>, right: &[f64]) -> Option<Vec<f64>> {
    /// Least pivot. See docs/constants.md.
    const LEAST_PIVOT: f64 = 1e-9;
    let rows = matrix.rows().into_iter().zip(right);
    let mut rows: Vec<Vec<f64>> = rows
        .map(|(row, right)| row.iter().chain([right]).copied().collect())
        .collect();
    let mut out = vec![0.0; right.len()];
    eliminate(&mut rows, Pivots::Largest, LEAST_PIVOT).then(|| {
        substitute(&rows, &mut out);
        out
    })
}

/// χ² of a covariance against white noise of variance one, for one block.
///
/// With S_l one for pixels ±l apart, products are q′S_l q/2 (q′q at l = 0), so that M(l, l′) = tr(P S_l P S_l′)/2 (without the half at l = 0) and, in
/// white noise, the products' covariance is M(l, l′), and twice that for l′ = 0. That of the solutions has the inverse
/// A(l, l′) = M(l′, l), half of it for l′ = 0, of which the variance at lag zero, whatever it is, takes its share.
fn colour(matrix: &Array2<f64>, covariance: &[f64]) -> f64 {
    let inverse = |i: usize, j: usize| matrix[(j, i)] * if j == 0 { 0.5 } else { 1.0 };
    let others = 1..covariance.len();
    let pairs = others
        .clone()
        .flat_map(|i| others.clone().map(move |j| (i, j)));
    pairs
        .map(|(i, j)| {
            let freed = inverse(i, 0) * inverse(0, j) / inverse(0, 0);
            covariance[i] * covariance[j] * (inverse(i, j) - freed)
        })
        .sum()
}

/// Lags of half the plane, zero first.
pub(super) fn lags(reach: usize) -> Vec<(i32, i32)> {
    let reach = reach as i32;
    let rows = (0..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
    let half = rows.filter(|&(dx, dy)| dy > 0 || dx >= 0);
    half.collect()
}

/// M(l, l′): the mean of the products at lag l on noise of covariance one at ±l′ and zero elsewhere.
pub(super) fn matrix(reach: usize, polynomials: &[[f64; PIXELS]; POLYNOMIALS]) -> Array2<f64> {
    let lags = lags(reach);
    let mut out = Array2::zeros((lags.len(), lags.len()));
    let place = |at: usize| ((at % BLOCK) as i32, (at / BLOCK) as i32);
    for (j, &(dx, dy)) in lags.iter().enumerate() {
        // Covariance of the block's pixels, by columns, and then by rows, without polynomials.
        let mut covariance: Vec<[f64; PIXELS]> = (0..PIXELS)
            .map(|a| {
                std::array::from_fn(|b| {
                    let ((ax, ay), (bx, by)) = (place(a), place(b));
                    let lag = (bx - ax, by - ay);
                    f64::from(u8::from(lag == (dx, dy) || lag == (-dx, -dy)))
                })
            })
            .collect();
        for _ in 0..2 {
            for row in &mut covariance {
                take_out(polynomials, row);
            }
            covariance = (0..PIXELS)
                .map(|a| std::array::from_fn(|b| covariance[b][a]))
                .collect();
        }
        for (i, &(dx, dy)) in lags.iter().enumerate() {
            let mut sum = 0.0;
            for (a, row) in covariance.iter().enumerate() {
                let (x, y) = place(a);
                let (x, y) = (x + dx, y + dy);
                let side = 0..BLOCK as i32;
                if side.contains(&x) && side.contains(&y) {
                    sum += row[y as usize * BLOCK + x as usize];
                }
            }
            out[(i, j)] = sum;
        }
    }
    out
}
