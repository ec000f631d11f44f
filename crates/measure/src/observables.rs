//! Flux and size of a galaxy before the PSF, as catalogues have them: with all that a selection by them requires.

/// Flux and size of a galaxy before the PSF.
///
/// Galaxies that are selected or weighted by them are selected by shear and by noise, too. [`Selection`](crate::Selection)
/// corrects for both, with the responses and the couplings of this struct.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Observables {
    /// Flux in a round Gaussian aperture as wide as the window, in image units, corrected for the light of a typical galaxy
    /// beyond the aperture.
    pub flux: f64,
    /// Standard deviation of the flux. S/N is flux over this error.
    pub flux_error: f64,
    /// Standard deviation per axis, in pixels, of the round Gaussian galaxy with the same moments of the autocorrelation.
    pub size: f64,
    /// Derivatives of the flux with γ1 and γ2.
    pub flux_response: [f64; 2],
    /// Derivatives of the size with γ1 and γ2.
    pub size_response: [f64; 2],
    /// Effect of noise on products of flux, size and ellipticity.
    pub coupling: Coupling,
}

impl Observables {
    /// Names of the columns of catalogues with the values of [`Observables::to_array`].
    pub const COLUMNS: [&'static str; 25] = [
        "flux",
        "size",
        "flux_error",
        "flux_g1",
        "flux_g2",
        "size_g1",
        "size_g2",
        "n1_ef",
        "n1_es",
        "n1_ff",
        "n1_fs",
        "n1_ss",
        "n2_ef",
        "n2_es",
        "n2_ff",
        "n2_fs",
        "n2_ss",
        "t_e1f",
        "t_e1s",
        "t_e2f",
        "t_e2s",
        "t_ff",
        "t_fs",
        "t_ss",
        "t_s",
    ];

    /// Flux over its error.
    pub fn snr(&self) -> f64 {
        self.flux / self.flux_error
    }

    /// All values, in the order of [`Observables::COLUMNS`].
    pub fn to_array(&self) -> [f64; 25] {
        let Observables {
            flux,
            flux_error,
            size,
            flux_response: [f1, f2],
            size_response: [s1, s2],
            coupling: Coupling { shear, turned },
        } = *self;
        let mut all = [0.0; 25];
        all[..7].copy_from_slice(&[flux, size, flux_error, f1, f2, s1, s2]);
        all[7..12].copy_from_slice(&shear[0]);
        all[12..17].copy_from_slice(&shear[1]);
        all[17..].copy_from_slice(&turned);
        all
    }

    /// Observables with these values, in the order of [`Observables::COLUMNS`].
    pub fn from_array(all: &[f64; 25]) -> Self {
        let five = |first: usize| std::array::from_fn(|k| all[first + k]);
        Observables {
            flux: all[0],
            size: all[1],
            flux_error: all[2],
            flux_response: [all[3], all[4]],
            size_response: [all[5], all[6]],
            coupling: Coupling {
                shear: [five(7), five(12)],
                turned: std::array::from_fn(|k| all[17 + k]),
            },
        }
    }
}

/// Mean products of the changes that noise makes of ellipticity, flux and size.
///
/// They are determined for one galaxy in eight, with eight times the weight, and zero for the others.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
pub struct Coupling {
    /// For the change of noise with γ1 and with γ2: products of e (of the same component) and flux, e and size, flux and flux,
    /// flux and size, size and size.
    pub shear: [[f64; 5]; 2],
    /// For what noise lacks to be noise behind a PSF turned by 90 degrees: e1 and flux, e1 and size, e2 and flux, e2 and size, flux and
    /// flux, flux and size, size and size; and the mean change of the size alone.
    pub turned: [f64; 8],
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_keep_every_value_in_its_place() {
        let all: [f64; 25] = std::array::from_fn(|k| k as f64 + 0.5);
        let observables = Observables::from_array(&all);
        assert_eq!(observables.to_array(), all);
        let at = |name: &str| {
            let place = Observables::COLUMNS.iter().position(|own| *own == name);
            all[place.unwrap()]
        };
        assert_eq!(observables.size_response[1], at("size_g2"));
        assert_eq!(observables.coupling.shear[1][3], at("n2_fs"));
        assert_eq!(observables.coupling.turned[2], at("t_e2f"));
    }
}
