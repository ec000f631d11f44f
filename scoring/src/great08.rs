//! The metric of GREAT08 (Bridle et al. 2010, MNRAS 405, 2044).

use shearq_quantities::Shear;

use crate::error::ScoringError;
use crate::great3::Quality;

// A mean square error of 10⁻⁷ has Q = 1000.
const Q_SCALE: f64 = 1e-4;

/// Q of GREAT08: 10⁻⁴ / ⟨(⟨g_sub − g_true⟩_images)²⟩ over sets and both components. `sets` has the differences
/// of the images of each set.
///
/// The mean over the images is inside the square: noise that averages to zero over a set costs little.
///
/// # Errors
/// If a set is empty, there is none, or a number is not finite.
pub fn score(sets: &[Vec<Shear>]) -> Result<Quality, ScoringError> {
    let empty = sets.iter().filter(|set| set.is_empty()).count();
    if empty > 0 || sets.is_empty() {
        return Err(ScoringError::Count {
            what: "sets with images",
            found: sets.len() - empty,
            expected: sets.len().max(1),
        });
    }
    let mut shears = sets.iter().flatten();
    if !shears.all(|g| g.e1.is_finite() && g.e2.is_finite()) {
        return Err(ScoringError::NotFinite("a shear"));
    }
    let squares: Vec<f64> = sets
        .iter()
        .map(|set| {
            let mean = |of: fn(&Shear) -> f64| set.iter().map(of).sum::<f64>() / set.len() as f64;
            0.5 * (mean(|g| g.e1).powi(2) + mean(|g| g.e2).powi(2))
        })
        .collect();
    Ok(Quality::over(squares.len(), |is_in| {
        let chosen = squares.iter().enumerate();
        let chosen: Vec<f64> = chosen
            .filter(|(k, _)| is_in(*k))
            .map(|(_, square)| *square)
            .collect();
        Q_SCALE * chosen.len() as f64 / chosen.iter().sum::<f64>()
    }))
}
