//! What the noise of a star does to the shears of all galaxies that share it.

use super::shrink::{AS_IT_IS, LEAST_SIDE};

/// Scatter of m with a star's noise, times the star's S/N. See docs/constants.md.
const M_PER_NOISE: f64 = 2.3;
/// Scatter of c with a star's noise, times the star's S/N. See docs/constants.md.
const C_PER_NOISE: f64 = 1.2;
/// Scatter of m with the noise of a star that is used unchanged, times the star's S/N. See docs/constants.md.
const M_UNCHANGED: f64 = 5.5;
/// Scatter of c with the noise of a star that is used unchanged, times the star's S/N. See docs/constants.md.
const C_UNCHANGED: f64 = 2.3;

/// How much the noise of one star of S/N `snr` and `side` pixels a side changes m and c of a linear configuration: one
/// standard deviation.
pub(super) fn of_noise(snr: f64, side: usize) -> [f64; 2] {
    let [stays, unchanged] = AS_IT_IS;
    if side < LEAST_SIDE || snr >= unchanged {
        return [M_UNCHANGED, C_UNCHANGED].map(|times| times / snr.max(1.0));
    }
    // Between the two, less and less of the noise is taken away.
    [M_PER_NOISE, C_PER_NOISE].map(|times| times / snr.clamp(1.0, stays))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_noise_of_bright_and_of_small_stars_is_not_reduced() {
        // The measured scatters of docs/limitations.md, to 6 %.
        for (snr, m, c) in [
            (50.0, 0.045, 0.023),
            (100.0, 0.023, 0.012),
            (200.0, 0.012, 0.0058),
            (500.0, 0.0047, 0.0024),
            (1000.0, 0.0055, 0.0023),
        ] {
            let found = of_noise(snr, 48);
            assert!((found[0] / m - 1.0).abs() < 0.06, "{snr}: {found:?}");
            assert!((found[1] / c - 1.0).abs() < 0.06, "{snr}: {found:?}");
        }
        assert_eq!(of_noise(100.0, 23), [0.055, 0.023]);
        assert_eq!(of_noise(f64::INFINITY, 48), [0.0; 2]);
        // Less than one is as bad as one.
        assert_eq!(of_noise(0.0, 48), [2.3, 1.2]);
    }
}
