//! The 24 kinds of set of GREAT10 (Table 2 of the paper).

use serde::Serialize;

pub const SETS: u32 = 24;

const FIDUCIAL: &str = "fiducial";

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variability {
    Fixed,
    Variable,
}

impl Variability {
    pub fn label(self) -> &'static str {
        match self {
            Variability::Fixed => "fixed",
            Variability::Variable => "variable",
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ImageType {
    /// S/N 20, bulge and disc of fiducial size, Moffat PSF.
    Fiducial,
    LowSnr,
    HighSnr,
    SmoothSnr,
    SmallGalaxy,
    LargeGalaxy,
    SmoothGalaxy,
    /// Kolmogorov PSF with turbulence.
    Kolmogorov,
    UniformBulge,
    OffsetBulge,
}

impl ImageType {
    /// The name of the paper's Table 2.
    pub fn label(self) -> &'static str {
        match self {
            ImageType::Fiducial => "Fiducial",
            ImageType::LowSnr => "Low S/N",
            ImageType::HighSnr => "High S/N",
            ImageType::SmoothSnr => "Smooth S/N",
            ImageType::SmallGalaxy => "Small galaxy",
            ImageType::LargeGalaxy => "Large galaxy",
            ImageType::SmoothGalaxy => "Smooth galaxy",
            ImageType::Kolmogorov => "Kolmogorov PSF",
            ImageType::UniformBulge => "Uniform bulge/disc ratios",
            ImageType::OffsetBulge => "50/50 bulge/disc offset",
        }
    }

    /// Class of S/N: `fiducial`, `low`, `high` or `smooth`, a distribution.
    pub fn snr_class(self) -> &'static str {
        match self {
            ImageType::LowSnr => "low",
            ImageType::HighSnr => "high",
            ImageType::SmoothSnr => "smooth",
            _ => FIDUCIAL,
        }
    }

    /// Class of galaxy sizes: `fiducial`, `small`, `large` or `smooth`, a distribution.
    pub fn size_class(self) -> &'static str {
        match self {
            ImageType::SmallGalaxy => "small",
            ImageType::LargeGalaxy => "large",
            ImageType::SmoothGalaxy => "smooth",
            _ => FIDUCIAL,
        }
    }

    /// Profile of the PSF: `moffat` or `kolmogorov`.
    pub fn psf_profile(self) -> &'static str {
        match self {
            ImageType::Kolmogorov => "kolmogorov",
            _ => "moffat",
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct SetKind {
    pub set: u32,
    /// PSF field over the images.
    pub psf: Variability,
    /// Intrinsic ellipticity field over the images.
    pub ellipticity: Variability,
    pub image: ImageType,
}

impl SetKind {
    /// The kind of set `set`, `None` beyond 24.
    pub fn of(set: u32) -> Option<Self> {
        use ImageType as I;
        use Variability::{Fixed, Variable};
        // Sets 1 to 12 come in threes (variable, fixed PSF, fixed ellipticity), the rest in pairs.
        let (image, place) = match set {
            1..=12 => (
                [I::Fiducial, I::LowSnr, I::HighSnr, I::SmoothSnr][(set as usize - 1) / 3],
                (set - 1) % 3,
            ),
            13..=24 => (
                [
                    I::SmallGalaxy,
                    I::LargeGalaxy,
                    I::SmoothGalaxy,
                    I::Kolmogorov,
                    I::UniformBulge,
                    I::OffsetBulge,
                ][(set as usize - 13) / 2],
                (set - 13) % 2,
            ),
            _ => return None,
        };
        let (psf, ellipticity) = match place {
            0 => (Variable, Variable),
            1 => (Fixed, Variable),
            _ => (Variable, Fixed),
        };
        Some(SetKind {
            set,
            psf,
            ellipticity,
            image,
        })
    }
}

/// Share of each of `sets` in a mean in which every kind of image counts as it does among the challenge's 24,
/// however many of the kind there are here.
pub fn shares(sets: &[u32]) -> Vec<f64> {
    let image = |set: u32| SetKind::of(set).map(|kind| kind.image);
    let share = |&set: &u32| {
        let same = |other: &u32| image(*other) == image(set);
        let challenge = (1..=24).filter(same).count();
        let here = sets.iter().copied().filter(same).count();
        challenge as f64 / here as f64
    };
    let all: Vec<f64> = sets.iter().map(share).collect();
    let sum: f64 = all.iter().sum();
    all.iter().map(|share| share / sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_counts_as_among_the_24_sets() {
        // Two of three fiducial sets, one of two with small galaxies.
        let expected = [1.5, 1.5, 2.0].map(|share| share / 5.0);
        for (share, expected) in shares(&[1, 2, 14]).into_iter().zip(expected) {
            assert!((share - expected).abs() < 1e-15, "{share} {expected}");
        }
        let all: Vec<u32> = (1..=24).collect();
        assert!(
            shares(&all)
                .iter()
                .all(|share| (share - 1.0 / 24.0).abs() < 1e-15)
        );
    }

    #[test]
    fn the_table_is_the_papers() {
        use ImageType as I;
        use Variability::{Fixed, Variable};
        let spots = [
            (1, Variable, Variable, I::Fiducial),
            (2, Fixed, Variable, I::Fiducial),
            (3, Variable, Fixed, I::Fiducial),
            (5, Fixed, Variable, I::LowSnr),
            (9, Variable, Fixed, I::HighSnr),
            (10, Variable, Variable, I::SmoothSnr),
            (12, Variable, Fixed, I::SmoothSnr),
            (13, Variable, Variable, I::SmallGalaxy),
            (14, Fixed, Variable, I::SmallGalaxy),
            (16, Fixed, Variable, I::LargeGalaxy),
            (17, Variable, Variable, I::SmoothGalaxy),
            (20, Fixed, Variable, I::Kolmogorov),
            (22, Fixed, Variable, I::UniformBulge),
            (23, Variable, Variable, I::OffsetBulge),
            (24, Fixed, Variable, I::OffsetBulge),
        ];
        for (set, psf, ellipticity, image) in spots {
            let kind = SetKind {
                set,
                psf,
                ellipticity,
                image,
            };
            assert_eq!(SetKind::of(set), Some(kind));
        }
        assert_eq!(SetKind::of(0), None);
        assert_eq!(SetKind::of(25), None);
    }
}
