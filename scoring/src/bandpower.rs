//! Linear ℓ bins and bandpowers, by two definitions.
//!
//! * [`Definition::Leaderboard`]: the arithmetic of the original scoring, with its peculiarities. The power
//!   of a bin is the sum of |E|²·|ℓ| over its modes, divided by the bin width. The multipole of a bin is |ℓ| of
//!   its last mode.
//! * [`Definition::Corrected`]: azimuthal averages over fixed bins. Centres and widths depend on the edges of
//!   the bins only.
//!
//! Both have 20 bins of width Δ = (ℓ_max − ℓ_min)/19; bins 2 to 9 (1-based) are scored.

use std::fmt::Display;
use std::ops::Range;

use ndarray::Array2;
#[cfg(feature = "serde")]
use serde::{Deserialize, Serialize};
use shearq_quantities::fourier::Complex64;

use crate::error::ScoringError;
use crate::grid::{Grid, check_shape};

/// Number of bins between ℓ_min and ℓ_max.
pub const BINS: usize = 20;
/// The scored bins, 0-based: the challenge's bins 2 to 9.
pub const SCORED: Range<usize> = 1..9;

/// How bandpowers and the quality factor are defined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(Serialize, Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "lowercase"))]
pub enum Definition {
    /// As in the challenge's program.
    #[default]
    Leaderboard,
    /// Azimuthal averages over fixed bins; cells are weighted by the number of images with a galaxy there.
    Corrected,
}

impl Display for Definition {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Definition::Leaderboard => "leaderboard",
            Definition::Corrected => "corrected",
        })
    }
}

/// The bins of one grid under one definition.
#[derive(Debug, Clone)]
pub struct Bins {
    /// Which definition.
    pub definition: Definition,
    /// Bin width Δ in multipole.
    pub width: f64,
    /// Multipole of each bin: |ℓ| of its last mode (leaderboard), or the mean over its modes
    /// (corrected). Zero for a bin without modes.
    pub l: [f64; BINS],
    /// Δ ln ℓ of each bin: between the `l` of this bin and the next (leaderboard), or between the
    /// bin's edges (corrected). Zero if one of the two bins has no modes.
    pub dln_l: [f64; BINS],
    /// Modes in each bin; a mode and its opposite are both counted.
    pub modes: [usize; BINS],
    /// Σ|ℓ| over each bin's modes.
    pub sum_l: [f64; BINS],
    // Bin of each mode in FFT order, `BINS` for none.
    bin_of: Array2<u8>,
    modulus: Array2<f64>,
    to_c_l: [f64; BINS],
    grid: Grid,
}

impl Bins {
    /// Assigns every mode of `grid` to its bin.
    pub fn new(grid: &Grid, definition: Definition) -> Self {
        let (l_min, l_max) = (grid.l_min().0, grid.l_max().0);
        let width = (l_max - l_min) / (BINS as f64 - 1.0);
        let mut bins = Bins {
            definition,
            width,
            l: [0.0; BINS],
            dln_l: [0.0; BINS],
            modes: [0; BINS],
            sum_l: [0.0; BINS],
            bin_of: Array2::from_elem((grid.n, grid.n), BINS as u8),
            modulus: Array2::zeros((grid.n, grid.n)),
            to_c_l: [0.0; BINS],
            grid: *grid,
        };
        let mut sum_l2 = [0.0; BINS];
        // The leaderboard definition depends on this order: centred, first index outermost.
        for i in 0..grid.n {
            for j in 0..grid.n {
                let modulus = grid.wave(i).hypot(grid.wave(j));
                let at = (grid.fft_index(i), grid.fft_index(j));
                bins.modulus[at] = modulus;
                let bin = match definition {
                    Definition::Leaderboard => {
                        if modulus < l_min || modulus > l_max {
                            continue;
                        }
                        // 1-based round((|ℓ| + 1 − ℓ_min)/Δ) + 1; the added 1 shifts every edge.
                        ((modulus + 1.0 - l_min) / width).round()
                    }
                    Definition::Corrected => {
                        let zero_mode = grid.frequency(i) == 0 && grid.frequency(j) == 0;
                        // Nyquist rows of an even grid have no opposite frequency. E and B are
                        // ambiguous there.
                        let nyquist = grid.n.is_multiple_of(2) && (i == 0 || j == 0);
                        if zero_mode || nyquist {
                            continue;
                        }
                        ((modulus - l_min) / width).round().max(0.0)
                    }
                };
                if bin >= BINS as f64 {
                    continue;
                }
                let bin = bin as usize;
                bins.bin_of[at] = bin as u8;
                bins.modes[bin] += 1;
                bins.sum_l[bin] += modulus;
                sum_l2[bin] += modulus * modulus;
                bins.l[bin] = modulus;
            }
        }
        match definition {
            Definition::Leaderboard => {
                for b in 0..BINS - 1 {
                    if bins.l[b] > 0.0 && bins.l[b + 1] > 0.0 {
                        bins.dln_l[b] = (bins.l[b + 1] / bins.l[b]).ln();
                    }
                }
                for b in 0..BINS {
                    if bins.modes[b] > 0 {
                        bins.to_c_l[b] = bins.side() * bins.side() / bins.mode_weight(b);
                    }
                }
            }
            Definition::Corrected => {
                for (b, sum_l2) in sum_l2.iter().enumerate() {
                    let low = (l_min + (b as f64 - 0.5) * width).max(l_min);
                    let high = l_min + (b as f64 + 0.5) * width;
                    bins.dln_l[b] = (high / low).ln();
                    if bins.modes[b] > 0 {
                        let count = bins.modes[b] as f64;
                        bins.l[b] = bins.sum_l[b] / count;
                        bins.to_c_l[b] = 2.0 * std::f64::consts::PI * count / sum_l2;
                    }
                }
            }
        }
        bins
    }

    /// The bin of multipole `l` between ℓ_min and ℓ_max; the first or the last one beyond them.
    pub fn nearest(&self, l: f64) -> usize {
        let bin = ((l + 1.0 - self.grid.l_min().0) / self.width).round();
        bin.clamp(0.0, BINS as f64 - 1.0) as usize
    }

    fn side(&self) -> f64 {
        self.grid.side().0
    }

    /// W_b = Σ|ℓ|/Δ: bandpower of a field with unit |FFT|²/n⁴ in every mode (leaderboard).
    pub fn mode_weight(&self, bin: usize) -> f64 {
        self.sum_l[bin] / self.width
    }

    /// Factor from a bandpower (≈ ℓ²C_ℓ/2π) to C_ℓ in steradian; zero for a bin without modes.
    pub fn to_c_l(&self, bin: usize) -> f64 {
        self.to_c_l[bin]
    }

    /// Bandpowers ≈ ℓ²C_ℓ/2π (dimensionless) of the products Re(a·b*) of two sets of modes; the
    /// auto-spectrum for `a` = `b`.
    ///
    /// Leaderboard: P_b = Σ Re(a b*)|ℓ| / (n⁴Δ). Corrected: P_b = ⟨ℓ² Re(a b*)⟩ L²/(2πn⁴), the mean
    /// over the bin's modes.
    ///
    /// # Errors
    /// If the shape of `a` or `b` differs from the grid.
    pub fn power(
        &self,
        a: &Array2<Complex64>,
        b: &Array2<Complex64>,
    ) -> Result<[f64; BINS], ScoringError> {
        check_shape("the first set of modes", a, self.grid.n)?;
        check_shape("the second set of modes", b, self.grid.n)?;
        Ok(self.power_of(a, b))
    }

    pub(crate) fn power_of(&self, a: &Array2<Complex64>, b: &Array2<Complex64>) -> [f64; BINS] {
        let mut sums = [0.0; BINS];
        // The order of the original, so that sums round alike.
        for i in 0..self.grid.n {
            for j in 0..self.grid.n {
                let at = (self.grid.fft_index(i), self.grid.fft_index(j));
                let bin = usize::from(self.bin_of[at]);
                if bin < BINS {
                    let l = self.modulus[at];
                    let weight = match self.definition {
                        Definition::Leaderboard => l,
                        Definition::Corrected => l * l,
                    };
                    sums[bin] += (a[at] * b[at].conj()).re * weight;
                }
            }
        }
        let n4 = (self.grid.n as f64).powi(4);
        std::array::from_fn(|b| match self.definition {
            Definition::Leaderboard => sums[b] / (n4 * self.width),
            Definition::Corrected if self.modes[b] > 0 => {
                sums[b] * self.side() * self.side()
                    / (2.0 * std::f64::consts::PI * n4 * self.modes[b] as f64)
            }
            Definition::Corrected => 0.0,
        })
    }

    /// E-mode (or B-mode) bandpowers of white noise with `variance` per component and cell.
    pub fn white_noise(&self, variance: f64) -> [f64; BINS] {
        // |FFT|² of n² independent cells is n²·variance, so |FFT|²/n⁴ is variance/n².
        let per_mode = variance / self.grid.cells() as f64;
        std::array::from_fn(|b| {
            if self.modes[b] == 0 {
                return 0.0;
            }
            match self.definition {
                Definition::Leaderboard => self.mode_weight(b) * per_mode,
                Definition::Corrected => per_mode * self.side() * self.side() / self.to_c_l[b],
            }
        })
    }

    // Calls `call` with every scored mode (index in FFT order), its bin and its weight w in P_b = Σ w·Re(a b*).
    pub(crate) fn each_scored(&self, mut call: impl FnMut((usize, usize), usize, f64)) {
        let n4 = (self.grid.n as f64).powi(4);
        for (at, &bin) in self.bin_of.indexed_iter() {
            let bin = usize::from(bin);
            if SCORED.contains(&bin) {
                let l = self.modulus[at];
                let weight = match self.definition {
                    Definition::Leaderboard => l / (n4 * self.width),
                    Definition::Corrected => {
                        let modes = self.modes[bin] as f64;
                        (l * self.side()).powi(2) / (2.0 * std::f64::consts::PI * n4 * modes)
                    }
                };
                call(at, bin, weight);
            }
        }
    }

    // Relative variance of the scored power of one field of white noise: 2 Σw²/(Σw)². Opposite modes are
    // conjugates, hence the 2.
    pub(crate) fn variance_of_white_power(&self) -> f64 {
        let (mut sum, mut squares) = (0.0, 0.0);
        self.each_scored(|_, _, w| {
            sum += w;
            squares += w * w;
        });
        2.0 * squares / (sum * sum)
    }

    // Plain sums over scored modes of Re(a·b*), each mode counting once.
    pub(crate) fn scored_product(&self, a: &Array2<Complex64>, b: &Array2<Complex64>) -> f64 {
        self.bin_of
            .indexed_iter()
            .filter(|(_, bin)| SCORED.contains(&usize::from(**bin)))
            .map(|(at, _)| (a[at] * b[at].conj()).re)
            .sum()
    }
}
