//! The two kinds of files that the challenge accepts: ellipticity catalogues and power spectra.
//!
//! * Catalogue: ASCII `x y e1 e2`, one line per galaxy, one file per image,
//!   `g10_v1_objs_{set}_{image}.{method}.dat`.
//! * Power spectrum: ASCII `index l power`, the eight bins 2 to 9, one file per set,
//!   `{method}_set{set}.dat`; power is ℓ²C_ℓ/2π.

use std::path::Path;

use shearq_scoring::{
    Bins, Convention, Definition, Grid, Row, SCORED, ScoringError, SetImages, SpectrumCovariance,
    cross_spectrum, measured_bandpowers,
};

use super::manifest::Contents;
use shearq_dataset::layout::{MAX_IMAGE, MAX_SET};
use shearq_files::FileError;
use shearq_files::table;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpectrumLine {
    pub index: u32,
    pub l: f64,
    pub power: f64,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    Catalogue {
        set: u32,
        image: u32,
        method: String,
    },
    Spectrum {
        set: u32,
        method: String,
    },
}

impl Kind {
    pub const EXPECTED: &str =
        "neither g10_v1_objs_{set}_{image}.{method}.dat nor {method}_set{set}.dat";

    pub fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?.strip_suffix(".dat")?;
        if let Some(rest) = name.strip_prefix("g10_v1_objs_") {
            let (numbers, method) = rest.split_once('.')?;
            let (set, image) = numbers.split_once('_')?;
            return Some(Kind::Catalogue {
                set: number(set, MAX_SET)?,
                image: number(image, MAX_IMAGE)?,
                method: method.to_owned(),
            });
        }
        let (method, set) = name.rsplit_once("_set")?;
        Some(Kind::Spectrum {
            set: number(set, MAX_SET)?,
            method: method.to_owned(),
        })
    }

    pub fn file_name(&self) -> String {
        match self {
            Kind::Catalogue { set, image, method } => {
                format!("g10_v1_objs_{set}_{image}.{method}.dat")
            }
            Kind::Spectrum { set, method } => format!("{method}_set{set}.dat"),
        }
    }

    pub fn set(&self) -> u32 {
        match self {
            Kind::Catalogue { set, .. } | Kind::Spectrum { set, .. } => *set,
        }
    }
}

fn number(text: &str, most: u32) -> Option<u32> {
    if text.starts_with('0') || !text.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    text.parse().ok().filter(|number| *number <= most)
}

/// The measured galaxies of a catalogue in the challenge's format. Galaxies without an ellipticity are left out; the
/// original scoring counts them as zero.
pub fn catalogue_text(rows: &[Row]) -> String {
    let mut text = String::new();
    for Row { x, y, e1, e2 } in rows {
        if e1.is_finite() && e2.is_finite() {
            text.push_str(&format!("{x} {y} {e1:.9} {e2:.9}\n"));
        }
    }
    text
}

/// The power spectrum of a set in the challenge's format, and the covariance of its bandpowers, if known.
pub fn spectrum_text(
    grid: &Grid,
    images: &SetImages,
    contents: Contents,
) -> Result<(String, Option<SpectrumCovariance>), ScoringError> {
    let standard = Convention::STANDARD;
    let (bins, power, covariance) = match contents {
        Contents::CrossSpectra => cross_spectrum(grid, images, standard)
            .map(|cross| (cross.bins, cross.power, cross.covariance))?,
        _ => measured_bandpowers(grid, images.total(), standard)
            .map(|(bins, power)| (bins, power, None))?,
    };
    let text = SCORED
        .map(|b| format!("{} {:.6} {:.12e}\n", b + 1, bins.l[b], power[b]))
        .collect();
    let first = SCORED.start;
    let scored = covariance
        .map(|all| std::array::from_fn(|i| std::array::from_fn(|j| all[first + i][first + j])));
    Ok((text, scored))
}

/// Reads a power-spectrum file without checking it; [`super::check`] checks it.
pub fn read_spectrum(path: &Path) -> Result<Vec<SpectrumLine>, FileError> {
    let table = table::read_text(path, &["index", "l", "power"])?;
    let column = |name: &str| table::numbers(&table, name, path);
    let (index, l, power) = (column("index")?, column("l")?, column("power")?);
    if let Some(odd) = index
        .iter()
        .find(|i| i.fract() != 0.0 || !(0.0..=99.0).contains(*i))
    {
        return Err(FileError::new(
            path,
            format!("not the number of a bin (found {odd}, expected 2 to 9)"),
        ));
    }
    Ok((0..index.len())
        .map(|k| SpectrumLine {
            index: index[k] as u32,
            l: l[k],
            power: power[k],
        })
        .collect())
}

/// The first line whose multipole differs from its bin's, the bin's multipole, and the number of such lines.
pub fn wrong_multipoles<'a>(
    lines: &'a [SpectrumLine],
    bins: &Bins,
) -> Option<(&'a SpectrumLine, f64, usize)> {
    let centre = |line: &SpectrumLine| bins.l.get((line.index as usize).wrapping_sub(1)).copied();
    let off = |line: &'a SpectrumLine| {
        let centre = centre(line).filter(|l| !(line.l - l).abs().le(&(0.5 * bins.width)))?;
        Some((line, centre))
    };
    let mut wrong = lines.iter().filter_map(off);
    let (line, centre) = wrong.next()?;
    Some((line, centre, 1 + wrong.count()))
}

/// The eight bandpowers of a power-spectrum file for galaxies on `grid`, in order.
pub fn read_bandpowers(path: &Path, grid: &Grid) -> Result<Vec<f64>, FileError> {
    let lines = read_spectrum(path)?;
    let bins = Bins::new(grid, Definition::Leaderboard);
    if let Some((SpectrumLine { index, l, .. }, centre, _)) = wrong_multipoles(&lines, &bins) {
        let message = format!(
            "bin {index} has l = {l}; expected {centre:.1}, as the true shear has {n} × {n} cells",
            n = grid.n
        );
        return Err(FileError::new(path, message));
    }
    let found: Vec<u32> = lines.iter().map(|line| line.index).collect();
    let expected: Vec<u32> = SCORED.map(|b| b as u32 + 1).collect();
    if found != expected {
        return Err(FileError::new(
            path,
            format!("the bins are {found:?}; expected {expected:?}"),
        ));
    }
    if let Some(bad) = lines.iter().find(|line| !line.power.is_finite()) {
        return Err(FileError::new(
            path,
            format!("the power of bin {} is not a finite number", bad.index),
        ));
    }
    Ok(lines.iter().map(|line| line.power).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_recognised_and_made() {
        for name in [
            "g10_v1_objs_7_12.NN23.dat",
            "g10_v1_objs_100_1000.NN23.dat",
            "NN_23_set24.dat",
        ] {
            let kind = Kind::of(Path::new(name)).unwrap();
            assert_eq!(kind.file_name(), name);
        }
        for wrong in [
            "g10_v1_objs_7.NN.dat",
            "NN_set1.txt",
            "NN_set01.dat",
            "NN_set10000.dat",
            "g10_v1_objs_1_1000000.NN.dat",
            "set.dat",
            "x",
        ] {
            assert_eq!(Kind::of(Path::new(wrong)), None, "{wrong}");
        }
    }
}
