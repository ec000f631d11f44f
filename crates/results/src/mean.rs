//! Mean shears of sets, for fields of constant shear.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use shearq_files::FileError;
use shearq_files::table::{self, FileFormat};
use shearq_measure::{Flag, MeanShear, Selection, ShearSum, Warning};
use shearq_pipeline::data::run::Run;
use shearq_pipeline::measure::PSF_NOISE;
use shearq_quantities::statistics::RunningMean;
use shearq_submissions::Calibration;

use crate::select::Weighted;

/// The mean shear of the galaxies of a set.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct SetMean {
    /// The set.
    pub set: u32,
    /// Images with a catalogue.
    pub images: Vec<u32>,
    /// Galaxies with an ellipticity.
    pub galaxies: usize,
    /// Galaxies without an ellipticity.
    pub flagged: usize,
    /// Galaxies with an ellipticity that the selection leaves out.
    pub cut: usize,
    /// Galaxies with each of [`Flag::ALL`].
    pub flags: [usize; Flag::ALL.len()],
    /// Mean shear, with errors that include the error of the mean response of each image and the noise of its star; `None`
    /// if all galaxies are flagged.
    pub shear: Option<MeanShear>,
    /// The part of the errors that the noise of the stars makes. Each star counts for all galaxies of its image.
    pub psf_error: [f64; 2],
    /// Standard deviation of e1 and of e2 of one galaxy.
    pub scatter: [f64; 2],
}

impl SetMean {
    /// A warning if more than half of the galaxies are flagged.
    pub fn mostly_flagged(&self) -> Option<Warning> {
        let with = |flag: Flag| {
            let mut counts = self.flags.iter().zip(Flag::ALL);
            counts
                .find(|(_, other)| *other == flag)
                .map_or(0, |(count, _)| *count)
        };
        Warning::of_counts(with, self.flagged, self.flagged + self.galaxies + self.cut)
    }

    /// Whether all galaxies have one ellipticity, so that the error is meaningless.
    pub fn is_constant(&self) -> bool {
        self.galaxies > 1 && self.scatter == [0.0; 2]
    }
}

/// The mean shear of the catalogues of each set of the results folder `out` (of `sets`, or of all if empty), of the
/// galaxies of a `selection`.
///
/// # Errors
/// If a catalogue cannot be read, or there is none; or if a selection needs columns that the catalogues do not have.
pub fn mean_shears(
    run: &Run,
    out: &Path,
    sets: &[u32],
    selection: Option<&Selection>,
) -> Result<Vec<SetMean>, FileError> {
    let files = run.catalogues(out, sets)?;
    let calibrated = run.configuration.calibration() != Calibration::None;
    let mut means = Vec::new();
    for set in files.wanted(sets) {
        let catalogues = files.of_set(set);
        if catalogues.is_empty() {
            let message = format!("there is no catalogue of set {set}");
            return Err(FileError::new(out, message));
        }
        means.push(mean_of(
            set,
            &catalogues,
            run.format,
            calibrated,
            selection,
        )?);
    }
    if means.is_empty() {
        return Err(FileError::new(
            out,
            "there is no catalogue; expected a folder that `measure` wrote",
        ));
    }
    Ok(means)
}

/// The mean shear of a set from its catalogues, of ellipticities that are `calibrated` or not.
fn mean_of(
    set: u32,
    catalogues: &[(u32, PathBuf)],
    format: FileFormat,
    calibrated: bool,
    selection: Option<&Selection>,
) -> Result<SetMean, FileError> {
    let (mut sum, mut moments) = (ShearSum::default(), [RunningMean::default(); 2]);
    let (mut flags, mut flagged, mut cut) = ([0; Flag::ALL.len()], 0, 0);
    // Of images with noisy stars: galaxies, and the scatter of m and c.
    let mut stars = Vec::new();
    for (_, path) in catalogues {
        let before = moments[0].count();
        let rows = match selection {
            Some(selection) => Rows::selected(path, selection)?,
            None => Rows::read(path, calibrated)?,
        };
        for &bits in &*rows.flags {
            for (count, flag) in flags.iter_mut().zip(Flag::ALL) {
                *count += usize::from(bits as u32 & flag as u32 != 0);
            }
        }
        let mean = rows.mean_response();
        for row in 0..rows.flags.len() {
            if !rows.is_good(row) {
                flagged += 1;
                continue;
            }
            if rows.cut[row] {
                cut += 1;
                continue;
            }
            let (e, response) = (rows.e(row), rows.response(row));
            // The ellipticities are divided by the mean response of their image.
            sum.add(e, [0, 1].map(|k| response[k] / mean[k]), 1.0);
            for (moment, e) in moments.iter_mut().zip(e) {
                moment.add(e);
            }
        }
        if let Some(effect) = psf_noise(path, format)? {
            stars.push((moments[0].count() - before, effect));
        }
    }
    let mut shear = sum.mean().ok();
    let psf_error = shear.map_or([0.0; 2], |found| {
        of_stars(&stars, moments[0].count(), found.shear)
    });
    if let Some(found) = &mut shear {
        for (k, error) in psf_error.into_iter().enumerate() {
            found.covariance[k][k] += error * error;
        }
    }
    Ok(SetMean {
        set,
        images: catalogues.iter().map(|(image, _)| *image).collect(),
        galaxies: moments[0].count(),
        flagged,
        cut,
        flags,
        shear,
        psf_error,
        scatter: moments.map(|moment| moment.deviation()),
    })
}

/// The scatter of m and c by the noise of the star of an image, as its catalogue states it.
fn psf_noise(path: &Path, format: FileFormat) -> Result<Option<[f64; 2]>, FileError> {
    let key = PSF_NOISE.to_owned();
    let metadata = table::read_metadata(path, format, std::iter::once(&key))?;
    let Some(text) = metadata.get(PSF_NOISE) else {
        return Ok(None);
    };
    let numbers: Option<Vec<f64>> = text.split(' ').map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[m, c]) if m >= 0.0 && c >= 0.0 => Ok(Some([m, c])),
        _ => Err(FileError::new(
            path,
            format!(
                "the metadata `{PSF_NOISE}` are `{text}`; expected the scatter of m and of c, such as 2.3e-2 1.2e-2"
            ),
        )),
    }
}

/// Errors of the mean of `galaxies` with the mean `shear` by the noise of independent stars, each for so many galaxies.
fn of_stars(stars: &[(usize, [f64; 2])], galaxies: usize, shear: [f64; 2]) -> [f64; 2] {
    shear.map(|g| {
        let variances = stars.iter().map(|&(count, [m, c])| {
            let share = count as f64 / galaxies as f64;
            share * share * (m * m * g * g + c * c)
        });
        variances.sum::<f64>().sqrt()
    })
}

/// The columns of a catalogue from which a mean shear follows.
struct Rows {
    e: [Vec<f64>; 2],
    flags: Vec<f64>,
    /// R11 and R22 of calibrated ellipticities.
    response: Option<[Vec<f64>; 2]>,
    /// Whether a selection leaves the galaxy out.
    cut: Vec<bool>,
}

impl Rows {
    fn read(path: &Path, calibrated: bool) -> Result<Self, FileError> {
        let mut names = vec!["e1", "e2", "flags"];
        if calibrated {
            names.extend(["R11", "R22"]);
        }
        let read = table::read(path, Some(&names), table::MAX_ROWS)?;
        let column = |name| table::numbers(&read, name, path).map(Cow::into_owned);
        let flags = column("flags")?;
        Ok(Rows {
            e: [column("e1")?, column("e2")?],
            cut: vec![false; flags.len()],
            flags,
            response: match calibrated {
                true => Some([column("R11")?, column("R22")?]),
                false => None,
            },
        })
    }

    /// The rows with the weights of a selection.
    fn selected(path: &Path, selection: &Selection) -> Result<Self, FileError> {
        let (weighted, flags) = Weighted::read(path, selection)?;
        let mean = weighted.mean_response();
        let Weighted {
            mut e,
            response,
            weight,
        } = weighted;
        // A mean of zero has no galaxies, and nothing to divide.
        for (e, mean) in e.iter_mut().zip(mean).filter(|(_, mean)| *mean != 0.0) {
            e.iter_mut().for_each(|e| *e /= mean);
        }
        Ok(Rows {
            e,
            flags,
            response: Some(response),
            cut: weight.iter().map(|weight| *weight == 0.0).collect(),
        })
    }

    fn e(&self, row: usize) -> [f64; 2] {
        [0, 1].map(|k| self.e[k][row])
    }

    fn is_good(&self, row: usize) -> bool {
        self.e(row).iter().all(|e| e.is_finite())
    }

    /// R11 and R22; 1 for ellipticities without calibration.
    fn response(&self, row: usize) -> [f64; 2] {
        let response = self.response.as_ref();
        response.map_or([1.0; 2], |all| [0, 1].map(|k| all[k][row]))
    }

    /// Mean response of the galaxies with an ellipticity. Galaxies that are left out have a response of zero.
    fn mean_response(&self) -> [f64; 2] {
        let good = || (0..self.flags.len()).filter(|&row| self.is_good(row));
        let count = good().count() as f64;
        [0, 1].map(|k| good().map(|row| self.response(row)[k]).sum::<f64>() / count)
    }
}

#[cfg(test)]
mod tests {
    use shearq_files::frames::frame;
    use shearq_files::frames::polars::Column;

    use super::*;

    /// Writes a catalogue of two good galaxies, of mean response 0.5, and one flagged.
    fn written(path: &Path, e: [f64; 2], names: [&str; 3], psf_noise: Option<&str>) {
        let column = |name: &str, values: [f64; 3]| Column::new(name.into(), values);
        let e = |sign: f64| [sign * e[0], sign * e[1], f64::NAN];
        let [flags, r11, r22] = names;
        let table = frame(vec![
            column("e1", e(1.0)),
            column("e2", e(-1.0)),
            column(flags, [0.0, 0.0, 4.0]),
            column(r11, [0.4, 0.6, f64::NAN]),
            column(r22, [0.4, 0.6, f64::NAN]),
        ]);
        table::write(
            path,
            FileFormat::Parquet,
            &table.unwrap(),
            &psf_noise
                .map(|text| (PSF_NOISE.to_owned(), text.to_owned()))
                .into_iter()
                .collect(),
        )
        .unwrap();
    }

    #[test]
    fn the_shear_is_the_mean_ellipticity_and_its_error_that_of_a_ratio() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalogue-001.parquet");
        written(&path, [0.1, 0.4], ["flags", "R11", "R22"], None);
        let catalogues = [(1, path)];
        let mean = mean_of(7, &catalogues, FileFormat::Parquet, true, None).unwrap();
        assert_eq!((mean.galaxies, mean.flagged, mean.flags[2]), (2, 1, 1));
        let shear = mean.shear.unwrap();
        assert!((shear.shear[0] - 0.25).abs() < 1e-15 && (shear.shear[1] + 0.25).abs() < 1e-15);
        // Residuals 0.1 − 0.25 · 0.8 and 0.4 − 0.25 · 1.2 are ∓0.1: √(2 · 0.02)/2.
        assert!((shear.error()[0] - 0.1).abs() < 1e-15, "{shear:?}");
        // Without responses the residuals are ∓0.15.
        let plain = mean_of(7, &catalogues, FileFormat::Parquet, false, None)
            .unwrap()
            .shear
            .unwrap();
        assert!((plain.error()[0] - 0.15).abs() < 1e-15, "{plain:?}");
    }

    #[test]
    fn the_noise_of_stars_is_in_the_error_and_falls_with_their_number() {
        let folder = tempfile::tempdir().unwrap();
        let mean = |images: u32, text: Option<&str>| {
            let catalogues: Vec<_> = (1..=images)
                .map(|image| (image, folder.path().join(format!("{image}.parquet"))))
                .collect();
            for (_, path) in &catalogues {
                written(path, [0.1, 0.4], ["flags", "R11", "R22"], text);
            }
            mean_of(7, &catalogues, FileFormat::Parquet, true, None)
        };
        let without = mean(1, None).unwrap();
        assert_eq!(without.psf_error, [0.0; 2]);
        for images in [1, 4] {
            let (with, own) = (
                mean(images, Some("4.00e-1 1.00e-2")).unwrap(),
                mean(images, None).unwrap(),
            );
            // m times the mean of 0.25, and c.
            let expected = 0.1f64.hypot(0.01) / f64::from(images).sqrt();
            let total = own.shear.unwrap().error()[1].hypot(expected);
            assert!((with.psf_error[1] - expected).abs() < 1e-15, "{with:?}");
            assert!((with.shear.unwrap().error()[1] - total).abs() < 1e-15);
        }
        for text in ["", "0.1", "0.1 x", "-1e-2 1e-2", "NaN 0"] {
            let error = mean(1, Some(text)).unwrap_err().to_string();
            assert!(error.contains("psfnoise"), "{error}");
        }
    }

    #[test]
    fn an_old_catalogue_is_refused_with_the_new_names_of_its_columns() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalogue-001.parquet");
        for (names, expected) in [
            (["flag", "R11", "R22"], "`flag` is now called `flags`"),
            (
                ["flags", "response1", "response2"],
                "`response1` is now called `R11`",
            ),
        ] {
            written(&path, [0.1, 0.4], names, None);
            let error = mean_of(7, &[(1, path.clone())], FileFormat::Parquet, true, None)
                .unwrap_err()
                .to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
