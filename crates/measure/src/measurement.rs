//! The result of measuring one galaxy: ellipticity, response, flux and size, or flags.

use std::fmt;

use thiserror::Error;

/// The adaptive moments of a PSF, pixels included: the moments of the elliptical Gaussian M that is the best weight,
/// M = 2 Σ W x xᵀ p / Σ W p with W = exp(−½ xᵀ M⁻¹ x) about the centroid under W (Bernstein & Jarvis 2002, AJ 123, 583;
/// Hirata & Seljak 2003, MNRAS 343, 459). GalSim's `FindAdaptiveMom` has the same `observed_shape` and `moments_sigma`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PsfShape {
    /// xx, xy and yy in px²; NaN if unknown.
    pub(crate) moments: [f64; 3],
}

impl PsfShape {
    pub(crate) const UNKNOWN: PsfShape = PsfShape {
        moments: [f64::NAN; 3],
    };
}

/// Response ∂e_i/∂γ_j of an ellipticity to shear, as `[i][j]`: R11, R12 and R21, R22.
pub type ResponseMatrix = [[f64; 2]; 2];

/// Why the network stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Stop {
    /// No neuron exceeds its threshold.
    Stable,
    /// The next state would not have had a lower energy; which one is kept is a setting.
    EnergyRise,
    /// M iterations were made.
    MaxIterations,
}

/// How the network went down in energy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Descent {
    /// Iterations whose state was accepted, or kept at the end.
    pub iterations: u32,
    /// Why it stopped.
    pub stop: Stop,
    /// E of the first state, in squared image units.
    pub first_energy: f64,
    /// E of the state returned.
    pub energy: f64,
    /// Neurons above their threshold in the last iteration that was examined.
    pub updated: u32,
}

/// The result of measuring one galaxy.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Measurement {
    /// First component of the ellipticity, of the configuration's type; NaN if flagged.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
    /// Reasons why the galaxy could not be measured.
    pub flags: Flags,
    /// Response of the reported ellipticity to shear; `None` for the network, for galaxies that could not be
    /// measured, and in images of a configuration without calibration. Only means over many galaxies are unbiased: the mean contribution of sheared noise is
    /// subtracted from one galaxy in eight, for all.
    pub response: Option<ResponseMatrix>,
    /// Variances of e1 and e2 by the noise of the pixels, to first order. They are determined for one galaxy in eight, with eight
    /// times the weight, and zero for the others: only means enter. Zero for the network.
    pub e_variance: [f64; 2],
    /// Flux and size before the PSF, with their responses; `None` for the network and for galaxies that could not be measured.
    pub observables: Option<Observables>,
    /// The galaxy under small shears, if the configuration requests sheared catalogues.
    pub sheared: Option<ShearedCatalogues>,
    /// Iterations; `None` if the method did not run. The linear method has its `max_iterations`, and energies of NaN.
    pub descent: Option<Descent>,
    /// Standard deviation of the noise that was used, in image units; NaN if unknown.
    pub noise: f64,
    /// Sum of the deconvolved stamp in image units. For the linear method, the flux of [`Observables`].
    pub flux: f64,
    /// Radius of the clipped autocorrelation in pixels. For the linear method, radius of the lags that are used.
    pub radius: f64,
    /// Qxx + Qyy of the clipped autocorrelation in px². For the linear method, the size of [`Observables`] in px.
    pub size: f64,
    /// The PSF in the frame of the ellipticity; of epochs, the mean of their moments with inverse-variance weights. NaN if the PSF
    /// cannot be used. Sigma is in pixels, on the sky in sides of a square of a pixel's area.
    pub psf: PsfShape,
    /// Pixels under the linear methods that hold no light and became missing, on all epochs.
    pub defects: DefectCounts,
}

impl Measurement {
    /// R11 and R22; NaN if there is no response.
    pub fn response_diagonal(&self) -> [f64; 2] {
        self.response
            .map_or([f64::NAN; 2], |[[r11, _], [_, r22]]| [r11, r22])
    }

    /// A galaxy that could not be measured.
    pub fn flagged(flag: impl Into<Flags>) -> Self {
        Measurement {
            e1: f64::NAN,
            e2: f64::NAN,
            flags: flag.into(),
            response: None,
            e_variance: [0.0; 2],
            observables: None,
            sheared: None,
            descent: None,
            noise: f64::NAN,
            flux: f64::NAN,
            radius: f64::NAN,
            size: f64::NAN,
            psf: PsfShape::UNKNOWN,
            defects: DefectCounts::default(),
        }
    }
}

/// Why a galaxy could not be measured. The number is a bit of the column `flags` in catalogues.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Error)]
#[repr(u32)]
#[non_exhaustive]
pub enum Flag {
    /// Pixels are not finite numbers: one, or under a linear method more than can be filled from the opposite side.
    #[error("pixels are missing")]
    NotFinite = 1,
    /// The galaxy's PSF cannot be used.
    #[error("the PSF cannot be used")]
    BadPsf = 2,
    /// All pixels are equal, none is positive, or the noise level is zero where one is needed: no unit
    /// of brightness. Or the brightest pixel is too faint or bright for single precision.
    #[error("nothing to scale the brightness by")]
    NoScale = 4,
    /// The deconvolved stamp has no light.
    #[error("nothing left after deconvolution")]
    NoLight = 8,
    /// The moments have no extent.
    #[error("moments without extent")]
    NoExtent = 16,
    /// The distortion exceeds 1 and has no shear-type ellipticity.
    #[error("distortion above 1")]
    NoShear = 32,
    // 64 was "no response to divide by", when each image was calibrated by itself, and 128 "a neighbour or an unusual shape". Neither
    // may mean something else. A flag for neighbours selects by shear: at S/N 60, m was −0.03 for galaxies with knots and −0.14 for offset bulges.
}

impl Flag {
    /// All, in the order of their bits.
    pub const ALL: [Flag; 6] = [
        Flag::NotFinite,
        Flag::BadPsf,
        Flag::NoScale,
        Flag::NoLight,
        Flag::NoExtent,
        Flag::NoShear,
    ];
}

/// All reasons why a galaxy could not be measured: none for a good galaxy. With any flag, e1 and e2 are NaN.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Flags(u32);

impl Flags {
    /// The flags of a good galaxy.
    pub const NONE: Flags = Flags(0);

    /// Whether the galaxy is good.
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Whether `flag` is set.
    pub fn contains(self, flag: Flag) -> bool {
        self.0 & flag as u32 != 0
    }

    /// The flags that are set.
    pub fn iter(self) -> impl Iterator<Item = Flag> {
        Flag::ALL
            .into_iter()
            .filter(move |&flag| self.contains(flag))
    }

    /// The value in the column `flags`.
    pub fn bits(self) -> u32 {
        self.0
    }

    /// The flags of a value of the column `flags`.
    pub fn from_bits(bits: u32) -> Flags {
        Flags(bits)
    }
}

impl From<Flag> for Flags {
    fn from(flag: Flag) -> Self {
        Flags(flag as u32)
    }
}

impl fmt::Display for Flags {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let reasons: Vec<String> = self.iter().map(|flag| flag.to_string()).collect();
        f.write_str(&reasons.join(", "))
    }
}

/// Pixels of a stamp that became missing, by what showed that they hold no light.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DefectCounts {
    /// In areas of one value.
    pub repeated: u32,
    /// Far below the sky.
    pub dark: u32,
    /// Brighter than their neighbours by more than the PSF allows.
    pub bright: u32,
    /// On lines across the stamp: bad columns and rows, trails.
    pub lines: u32,
}

impl DefectCounts {
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.total() == 0
    }

    /// All of them.
    pub fn total(&self) -> u32 {
        self.repeated + self.dark + self.bright + self.lines
    }
}

impl std::ops::AddAssign for DefectCounts {
    fn add_assign(&mut self, other: Self) {
        self.repeated += other.repeated;
        self.dark += other.dark;
        self.bright += other.bright;
        self.lines += other.lines;
    }
}

/// Flux and size of a galaxy before the PSF.
///
/// A selection or weight by them is also a selection by shear and by noise. [`Selection`](crate::Selection) corrects for
/// both with the responses and the couplings of this struct.
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
    /// Light of a ring around the galaxy, in image units: the deconvolved image under (r/R)⁴ exp(2 − 2r²/R²), where R is 1.5 times
    /// σ of the window, at most a quarter of the stamp's side. It is linear in the image, so that its response is exact.
    pub ring: f64,
    /// Derivatives of the light of the ring with γ1 and γ2.
    pub ring_response: [f64; 2],
    /// Effect of noise on products of flux, size and ellipticity.
    pub coupling: Coupling,
}

impl Observables {
    /// Names of the columns of catalogues with the values of [`Observables::to_array`].
    pub const COLUMNS: [&'static str; 41] = [
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
        "ring",
        "ring_g1",
        "ring_g2",
        "n1_er",
        "n1_fr",
        "n1_sr",
        "n1_rr",
        "n2_er",
        "n2_fr",
        "n2_sr",
        "n2_rr",
        "t_e1r",
        "t_e2r",
        "t_fr",
        "t_sr",
        "t_rr",
    ];

    /// Flux over its error.
    pub fn snr(&self) -> f64 {
        self.flux / self.flux_error
    }

    /// Light of the ring over the flux: the light of neighbours, relative to the galaxy. Single galaxies with half-light radii of 2.5 to 5 px
    /// have 0.1 to 0.5 at S/N 20.
    pub fn neighbour(&self) -> f64 {
        self.ring / self.flux
    }

    /// All values, in the order of [`Observables::COLUMNS`].
    pub fn to_array(&self) -> [f64; 41] {
        let Observables {
            flux,
            flux_error,
            size,
            flux_response: [flux_g1, flux_g2],
            size_response: [size_g1, size_g2],
            ring,
            ring_response: [ring_g1, ring_g2],
            coupling,
        } = *self;
        let Coupling {
            sheared_e: [[n1_ef, n1_es, n1_er], [n2_ef, n2_es, n2_er]],
            sheared:
                [
                    [[n1_ff, n1_fs, n1_fr], [_, n1_ss, n1_sr], [.., n1_rr]],
                    [[n2_ff, n2_fs, n2_fr], [_, n2_ss, n2_sr], [.., n2_rr]],
                ],
            turned_e: [[t_e1f, t_e1s, t_e1r], [t_e2f, t_e2s, t_e2r]],
            turned: [[t_ff, t_fs, t_fr], [_, t_ss, t_sr], [.., t_rr]],
            turned_size: t_s,
        } = coupling;
        [
            flux, size, flux_error, flux_g1, flux_g2, size_g1, size_g2, n1_ef, n1_es, n1_ff, n1_fs,
            n1_ss, n2_ef, n2_es, n2_ff, n2_fs, n2_ss, t_e1f, t_e1s, t_e2f, t_e2s, t_ff, t_fs, t_ss,
            t_s, ring, ring_g1, ring_g2, n1_er, n1_fr, n1_sr, n1_rr, n2_er, n2_fr, n2_sr, n2_rr,
            t_e1r, t_e2r, t_fr, t_sr, t_rr,
        ]
    }

    /// Observables with these values, in the order of [`Observables::COLUMNS`].
    pub fn from_array(all: &[f64; 41]) -> Self {
        fn next<const K: usize>(rest: &mut impl Iterator<Item = f64>) -> [f64; K] {
            std::array::from_fn(|_| rest.next().unwrap_or(f64::NAN))
        }
        let rest = &mut all.iter().copied();
        let [flux, size, flux_error, flux_g1, flux_g2, size_g1, size_g2] = next(rest);
        let [n1_ef, n1_es, n1_ff, n1_fs, n1_ss] = next(rest);
        let [n2_ef, n2_es, n2_ff, n2_fs, n2_ss] = next(rest);
        let [t_e1f, t_e1s, t_e2f, t_e2s, t_ff, t_fs, t_ss, t_s] = next(rest);
        let [ring, ring_g1, ring_g2] = next(rest);
        let [n1_er, n1_fr, n1_sr, n1_rr] = next(rest);
        let [n2_er, n2_fr, n2_sr, n2_rr] = next(rest);
        let [t_e1r, t_e2r, t_fr, t_sr, t_rr] = next(rest);
        Observables {
            flux,
            flux_error,
            size,
            flux_response: [flux_g1, flux_g2],
            size_response: [size_g1, size_g2],
            ring,
            ring_response: [ring_g1, ring_g2],
            coupling: Coupling {
                sheared_e: [[n1_ef, n1_es, n1_er], [n2_ef, n2_es, n2_er]],
                sheared: [
                    [
                        [n1_ff, n1_fs, n1_fr],
                        [n1_fs, n1_ss, n1_sr],
                        [n1_fr, n1_sr, n1_rr],
                    ],
                    [
                        [n2_ff, n2_fs, n2_fr],
                        [n2_fs, n2_ss, n2_sr],
                        [n2_fr, n2_sr, n2_rr],
                    ],
                ],
                turned_e: [[t_e1f, t_e1s, t_e1r], [t_e2f, t_e2s, t_e2r]],
                turned: [[t_ff, t_fs, t_fr], [t_fs, t_ss, t_sr], [t_fr, t_sr, t_rr]],
                turned_size: t_s,
            },
        }
    }
}

pub(crate) const FLUX: usize = 0; // Place of the flux in the arrays of a coupling.
pub(crate) const SIZE: usize = 1; // Place of the size.
pub(crate) const RING: usize = 2; // Place of the light of the ring.
pub(crate) const VARIABLES: usize = 3;
pub(crate) const QUANTITIES: usize = 2 + VARIABLES; // The components of the ellipticity come before the variables.

/// Mean products of the changes by noise of the ellipticity and of three variables: flux, size and light of the ring, in this order.
///
/// They are determined for one galaxy in eight, with eight times the weight, and zero for the others: only means enter.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[non_exhaustive]
pub struct Coupling {
    /// Products of e1 with each variable for the change of noise with γ1, and of e2 for that with γ2.
    pub sheared_e: [[f64; 3]; 2],
    /// Products of the variables with each other for the change of noise with γ1, and with γ2. Symmetric.
    pub sheared: [[[f64; 3]; 3]; 2],
    /// Products of e1 and of e2 with each variable for the difference to noise behind a PSF turned by 90 degrees.
    pub turned_e: [[f64; 3]; 2],
    /// Products of the variables with each other for this difference. Symmetric.
    pub turned: [[f64; 3]; 3],
    /// Mean change of the size by this difference.
    pub turned_size: f64,
}

/// The mean of a response R of this trace over rotations and reflections of the galaxy: the same for both components.
pub(crate) fn isotropic(trace: f64) -> ResponseMatrix {
    // A shear of galaxies of all orientations sees this mean. The rest of R is noise that averages need not have.
    let response = 0.5 * trace;
    [[response, 0.0], [0.0, response]]
}

/// The values of a galaxy in one catalogue.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ShearedGalaxy {
    /// First component of the ellipticity.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
    /// As [`Observables::flux`](crate::Observables::flux).
    pub flux: f64,
    /// As [`Observables::size`](crate::Observables::size).
    pub size: f64,
}

/// A galaxy without shear, under γ1 = ±h and under γ2 = ±h, in the order of [`ShearedCatalogues::NAMES`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ShearedCatalogues {
    /// The galaxy in each catalogue.
    pub each: [ShearedGalaxy; 5],
    /// Standard deviation of the flux in each catalogue.
    pub flux_error: f64,
}

impl ShearedCatalogues {
    /// Names of the catalogues.
    pub const NAMES: [&'static str; 5] = ["noshear", "1p", "1m", "2p", "2m"];

    /// Names of the values in each catalogue.
    pub const QUANTITIES: [&'static str; 5] = ["e1", "e2", "snr", "flux", "size"];

    /// The names of all columns, catalogue by catalogue: `e1_noshear`, `e2_noshear`, …
    pub fn columns() -> impl Iterator<Item = String> {
        let columns = |name| Self::QUANTITIES.map(|quantity| format!("{quantity}_{name}"));
        Self::NAMES.into_iter().flat_map(columns)
    }

    /// The values in a catalogue, in the order of [`ShearedCatalogues::QUANTITIES`].
    pub fn values(&self, catalogue: usize) -> [f64; 5] {
        let ShearedGalaxy { e1, e2, flux, size } = self.each[catalogue];
        [e1, e2, flux / self.flux_error, flux, size]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_keep_every_value_in_its_place() {
        let all: [f64; 41] = std::array::from_fn(|k| k as f64 + 0.5);
        let observables = Observables::from_array(&all);
        assert_eq!(observables.to_array(), all);
        let at = |name: &str| {
            let place = Observables::COLUMNS.iter().position(|own| *own == name);
            all[place.unwrap()]
        };
        assert_eq!(observables.size_response[1], at("size_g2"));
        let coupling = observables.coupling;
        assert_eq!(coupling.sheared_e[1][RING], at("n2_er"));
        assert_eq!(coupling.turned_e[1][FLUX], at("t_e2f"));
        for (a, b, name) in [(FLUX, SIZE, "fs"), (FLUX, RING, "fr"), (SIZE, RING, "sr")] {
            for (products, noise) in [(coupling.sheared[1], "n2"), (coupling.turned, "t")] {
                let expected = at(&format!("{noise}_{name}"));
                assert_eq!([products[a][b], products[b][a]], [expected; 2], "{name}");
            }
        }
    }
}
