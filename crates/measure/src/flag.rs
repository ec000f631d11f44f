//! Why a galaxy could not be measured.

use std::fmt;

/// A reason. Its number is a bit of the catalogues' column `flags`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
#[non_exhaustive]
pub enum Flag {
    /// Pixels are not finite numbers: one, or under a linear method more than can be filled from the opposite side.
    NotFinite = 1,
    /// The galaxy's PSF cannot be used.
    BadPsf = 2,
    /// All pixels are equal, none is positive, or the noise level is zero where one is needed: no unit
    /// of brightness. Or the brightest pixel is too faint or bright for single precision.
    NoScale = 4,
    /// Nothing is left after deconvolution.
    NoLight = 8,
    /// The moments have no extent.
    NoExtent = 16,
    /// The distortion exceeds 1 and has no shear-type ellipticity.
    NoShear = 32,
    /// The response by which the ellipticities were to be divided is not positive.
    NoResponse = 64,
    /// Another galaxy is so near that its light cannot be told from this one's, or the galaxy's own shape looks like that.
    Neighbour = 128,
}

impl Flag {
    /// All, in the order of their bits.
    pub const ALL: [Flag; 8] = [
        Flag::NotFinite,
        Flag::BadPsf,
        Flag::NoScale,
        Flag::NoLight,
        Flag::NoExtent,
        Flag::NoShear,
        Flag::NoResponse,
        Flag::Neighbour,
    ];
}

impl fmt::Display for Flag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Flag::NotFinite => "pixels are missing",
            Flag::BadPsf => "the PSF cannot be used",
            Flag::NoScale => "nothing to scale the brightness by",
            Flag::NoLight => "nothing left after deconvolution",
            Flag::NoExtent => "moments without extent",
            Flag::NoShear => "distortion above 1",
            Flag::NoResponse => "no response to shear to divide by",
            Flag::Neighbour => "a neighbour or an unusual shape",
        })
    }
}

/// The reasons why one galaxy could not be measured: none for a good one. With any of them e1 and e2 are NaN.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Flags(u32);

impl Flags {
    /// A good galaxy.
    pub const NONE: Flags = Flags(0);

    /// Whether the galaxy is good.
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Whether this is one of the reasons.
    pub fn contains(self, flag: Flag) -> bool {
        self.0 & flag as u32 != 0
    }

    /// The reasons.
    pub fn iter(self) -> impl Iterator<Item = Flag> {
        Flag::ALL
            .into_iter()
            .filter(move |&flag| self.contains(flag))
    }

    /// The bits of the catalogues' column.
    pub fn bits(self) -> u32 {
        self.0
    }

    /// The reasons of the bits of the catalogues' column.
    pub fn from_bits(bits: u32) -> Flags {
        Flags(bits)
    }

    pub(crate) fn add(&mut self, flag: Flag) {
        self.0 |= flag as u32;
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
