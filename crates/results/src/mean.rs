//! Mean shears of sets, for fields of constant shear.

use std::path::{Path, PathBuf};

use shearq_dataset::metadata::{Axes, CommonAxes, E_NOISE, number_pair, stated_axes};
use shearq_dataset::run::Run;
use shearq_files::FileError;
use shearq_files::table::{self, FileFormat};
use shearq_measure::{Flag, Flags, MeanShear, ShearSum, Warning};
use shearq_quantities::statistics::RunningMean;
use shearq_submissions::Calibration;

use crate::crowding::crowded;
use shearq_catalogue::failures::repeated_ellipticities;
use shearq_catalogue::select::StatedSelection;
use shearq_catalogue::shapes::MeasuredShapes;
use shearq_catalogue::star_noise::{Stars, of_catalogue};

/// The mean shear of the galaxies of a set.
#[derive(Debug, Clone, PartialEq)]
pub struct SetMean {
    pub set: u32,
    pub images: Vec<u32>,
    /// Galaxies with an ellipticity.
    pub galaxies: usize,
    /// Galaxies without an ellipticity.
    pub flagged: usize,
    /// Galaxies with an ellipticity that the selection leaves out.
    pub cut: usize,
    /// Galaxies whose ellipticity has a modulus of 1 or more, which only noise makes. They count like the others, because a cut
    /// would bias the mean.
    pub above_one: usize,
    /// Galaxies with the ellipticity of an earlier one of their image, if these are not few.
    pub repeated: u64,
    /// Galaxies with each of [`Flag::ALL`].
    pub flags: [usize; Flag::ALL.len()],
    /// Mean shear: the sum of ellipticities over the sum of responses. Errors include the error of the mean
    /// response and the noise of stars. `None` if all galaxies are flagged, or the mean response is not positive.
    pub shear: Option<MeanShear>,
    /// The part of the errors that the noise of the stars makes. Each star counts for all galaxies of its images.
    pub psf_error: [f64; 2],
    /// Images whose catalogue states the effect of the noise of its star.
    pub noisy_stars: usize,
    /// Standard deviation of e1 and of e2 of one galaxy.
    pub scatter: [f64; 2],
    /// Whether errors are for galaxies in pairs that are rotated by 90°, whose shapes cancel.
    pub rotated_pairs: bool,
    /// Galaxies of catalogues with positions in pixels, and those among them with another position on their stamp.
    pub placed: usize,
    pub crowded: usize,
    pub axes: Axes,
}

impl SetMean {
    /// A warning if more than half of the galaxies are flagged.
    pub fn mostly_flagged(&self) -> Option<Warning> {
        let of = self.flagged + self.galaxies + self.cut;
        Warning::of_counts(self.flags, self.flagged, of)
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
/// If a catalogue is missing or cannot be read, or if a selection needs columns that the catalogues do not have.
pub fn mean_shears(
    run: &Run,
    out: &Path,
    sets: &[u32],
    selection: Option<&StatedSelection>,
) -> Result<Vec<SetMean>, FileError> {
    let files = run.catalogues(out, sets)?;
    let with_response = run.configuration.calibration() != Calibration::None;
    // Weights differ between the galaxies of a pair, so that shapes do not cancel.
    let pairs = selection.is_none() && run.selection.is_none();
    let mut means = Vec::new();
    for set in files.wanted(sets) {
        let catalogues = files.of_set(set);
        if catalogues.is_empty() {
            let message = format!("there is no catalogue of set {set}");
            return Err(FileError::new(out, message));
        }
        let mut mean = mean_of(
            set,
            &catalogues,
            run.format,
            with_response,
            selection,
            pairs,
        )?;
        if run.configuration.is_detection() {
            // What noise of the PSF's shape adds is subtracted from all, so that those of a small weight have any ellipticity.
            mean.above_one = 0;
        }
        means.push(mean);
    }
    if means.is_empty() {
        return Err(FileError::new(
            out,
            "there is no catalogue; expected a folder that `measure` wrote",
        ));
    }
    Ok(means)
}

/// The mean shear of a set from its catalogues, of ellipticities `with_response` or of shears. If catalogues state that their
/// galaxies are `pairs`, the errors contain no shape noise.
fn mean_of(
    set: u32,
    catalogues: &[(u32, PathBuf)],
    format: FileFormat,
    with_response: bool,
    selection: Option<&StatedSelection>,
    pairs: bool,
) -> Result<SetMean, FileError> {
    let (mut sum, mut moments) = (ShearSum::default(), [RunningMean::default(); 2]);
    let (mut flags, mut flagged, mut cut, mut above_one) = ([0; Flag::ALL.len()], 0, 0, 0);
    let mut stars = Stars::default();
    let mut axes = CommonAxes::default();
    let (mut noise, mut in_pairs) = ([0.0; 2], pairs);
    let mut responses = [RunningMean::default(); 2];
    let mut repeated = 0;
    let (mut placed, mut close) = (0, 0);
    for (_, path) in catalogues {
        // A catalogue without positions says nothing of neighbours.
        if let Ok(read) = table::read(path, Some(&["x", "y"]), table::MAX_ROWS) {
            let [x, y] = ["x", "y"].map(|name| table::numbers(&read, name, path));
            let (x, y) = (x?, y?);
            placed += x.len();
            close += crowded(&x, &y);
        }
        let stated = if in_pairs {
            e_noise(path, format)?
        } else {
            None
        };
        in_pairs &= stated.is_some();
        axes.add(path, stated_axes(path, format)?, false)?;
        let shapes = MeasuredShapes::read(path, selection, with_response)?;
        for &bits in &shapes.flags {
            for (count, flag) in flags.iter_mut().zip(Flag::ALL) {
                *count += usize::from(Flags::from_bits(bits as u32).contains(flag));
            }
        }
        let counted = shapes.e.iter().zip(&shapes.weight);
        let counted = counted.filter(|(e, weight)| e[0].is_finite() && **weight != 0.0);
        repeated += repeated_ellipticities(counted.map(|(e, _)| *e));
        let mut share = [0.0; 2];
        for (row, (&e, &response)) in shapes.e.iter().zip(&shapes.response).enumerate() {
            if !e.iter().all(|e| e.is_finite()) {
                flagged += 1;
                continue;
            }
            if shapes.weight[row] == 0.0 {
                cut += 1;
                continue;
            }
            // Both components are multiplied by the weight.
            above_one += usize::from(e[0].hypot(e[1]) >= shapes.weight[row]);
            sum.add(e, response, 1.0);
            for k in 0..2 {
                moments[k].add(e[k]);
                responses[k].add(response[k][k]);
                noise[k] += stated.map_or(0.0, |sigma| sigma[k] * sigma[k]);
                share[k] += response[k][k];
            }
        }
        stars.add(of_catalogue(path, format)?, share);
    }
    let mut shear = sum.mean().ok();
    let mut psf_error = [0.0; 2];
    if let Some(found) = &mut shear {
        if in_pairs {
            found.covariance = covariance_of_pairs(found, noise, flagged, &moments, &responses);
        }
        psf_error = stars.errors(found.shear);
        for (k, error) in psf_error.into_iter().enumerate() {
            found.covariance[k][k] += error * error;
        }
    }
    let response = shear.map_or([1.0; 2], |found| found.response);
    Ok(SetMean {
        set,
        images: catalogues.iter().map(|(image, _)| *image).collect(),
        galaxies: moments[0].count(),
        flagged,
        cut,
        above_one,
        repeated,
        flags,
        shear,
        psf_error,
        noisy_stars: stars.stated(),
        rotated_pairs: in_pairs,
        placed,
        crowded: close,
        scatter: [0, 1].map(|k| moments[k].deviation() / response[k]),
        axes: axes.common().unwrap_or_default(),
    })
}

// The covariance of the mean shear of galaxies whose shapes cancel in pairs: of the measurement noise, whose variances have the
// sum `noise`, of responses, and of galaxies whose partner is flagged. GREAT3 does not state which galaxies are partners, and
// fluxes and sizes at S/N 20 do not find one of 10,000; the scatter of all was 3.2 times the error.
fn covariance_of_pairs(
    found: &MeanShear,
    noise: [f64; 2],
    flagged: usize,
    moments: &[RunningMean; 2],
    responses: &[RunningMean; 2],
) -> [[f64; 2]; 2] {
    let mut covariance = [[0.0; 2]; 2];
    for k in 0..2 {
        let count = moments[k].count() as f64;
        let of_response = count * (found.shear[k] * responses[k].deviation()).powi(2);
        let without_partner = flagged as f64 * moments[k].deviation().powi(2);
        let sum = noise[k] + of_response + without_partner;
        covariance[k][k] = sum / (count * found.response[k]).powi(2);
    }
    covariance
}

// The measurement noise of e1 and e2 of a galaxy that a catalogue of rotated pairs states.
fn e_noise(path: &Path, format: FileFormat) -> Result<Option<[f64; 2]>, FileError> {
    let metadata = table::read_metadata(path, format, [E_NOISE])?;
    let text = metadata.get(E_NOISE);
    text.map(|text| number_pair(path, E_NOISE, text, 1.0))
        .transpose()
}

#[cfg(test)]
mod tests {
    use shearq_dataset::fingerprint::PSF;
    use shearq_dataset::metadata::{CATALOGUE_FRAME, PSF_NOISE};
    use shearq_files::frames::frame;
    use shearq_files::frames::polars::Column;
    use shearq_measure::PixelFrame;

    use super::*;

    /// Writes a catalogue with responses along the diagonal and across it.
    fn write(
        path: &Path,
        e: &[[f64; 2]],
        [diagonal, across]: [&[f64]; 2],
        metadata: &[(&str, &str)],
    ) {
        let column = |name: &str, of: &dyn Fn(usize) -> f64| {
            let values: Vec<f64> = (0..e.len()).map(of).collect();
            Column::new(name.into(), values)
        };
        let table = frame(vec![
            column("e1", &|k| e[k][0]),
            column("e2", &|k| e[k][1]),
            column("flags", &|k| if e[k][0].is_nan() { 4.0 } else { 0.0 }),
            column("R11", &|k| diagonal[k]),
            column("R22", &|k| diagonal[k]),
            column("R12", &|k| across[k]),
            column("R21", &|k| -across[k]),
        ]);
        let own = |(key, value): &(&str, &str)| ((*key).to_owned(), (*value).to_owned());
        let metadata = metadata.iter().map(own).collect();
        table::write(path, FileFormat::Parquet, &table.unwrap(), &metadata).unwrap();
    }

    /// Writes a catalogue of two good galaxies, of mean response 0.5, and one flagged.
    fn written(path: &Path, e: [f64; 2], metadata: &[(&str, &str)]) {
        let e = [[e[0], -0.5 * e[0]], [e[1], -0.5 * e[1]], [f64::NAN; 2]];
        let diagonal = [0.4, 0.6, f64::NAN];
        write(path, &e, [&diagonal, &[0.0, 0.0, f64::NAN]], metadata);
    }

    /// The mean of set 7 of these Parquet files, all of whose galaxies are selected.
    fn mean_of_files(
        catalogues: &[(u32, PathBuf)],
        with_response: bool,
        pairs: bool,
    ) -> Result<SetMean, FileError> {
        mean_of(
            7,
            catalogues,
            FileFormat::Parquet,
            with_response,
            None,
            pairs,
        )
    }

    #[test]
    fn the_shear_is_a_ratio_of_means_and_its_error_that_of_a_ratio() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalogue-001.parquet");
        written(&path, [0.05, 0.2], &[]);
        let catalogues = [(1, path)];
        let mean = mean_of_files(&catalogues, true, true).unwrap();
        assert_eq!((mean.galaxies, mean.flagged, mean.flags[2]), (2, 1, 1));
        let shear = mean.shear.unwrap();
        assert!((shear.shear[0] - 0.25).abs() < 1e-15 && (shear.shear[1] + 0.125).abs() < 1e-15);
        // Residuals 0.05 − 0.25 · 0.4 and 0.2 − 0.25 · 0.6 are ∓0.05, over the response: √(2 · 0.01)/2.
        assert!((shear.error()[0] - 0.1).abs() < 1e-15, "{shear:?}");
        // The scatter of 0.1 and 0.4.
        let scatter = 0.3 / 2f64.sqrt();
        assert!((mean.scatter[0] - scatter).abs() < 1e-15, "{mean:?}");
        // Without responses the residuals are ∓0.075.
        let plain = mean_of_files(&catalogues, false, true);
        let plain = plain.unwrap();
        let error = plain.shear.unwrap().error();
        assert!((error[0] - 0.075).abs() < 1e-15, "{plain:?}");
        assert_eq!(plain.above_one, 0);
        written(&catalogues[0].1, [0.05, 5.0], &[]);
        let wrong = mean_of_files(&catalogues, true, true);
        assert_eq!(wrong.unwrap().above_one, 1);
    }

    #[test]
    fn images_weigh_by_their_responses() {
        let folder = tempfile::tempdir().unwrap();
        let path = |image: u32| folder.path().join(format!("{image}.parquet"));
        written(&path(1), [0.05, 0.2], &[]);
        // Galaxies of the other have hardly any response, and noise.
        write(&path(2), &[[5e-3; 2]; 2], [&[1e-3; 2], &[0.0; 2]], &[]);
        let catalogues = [1, 2].map(|image| (image, path(image)));
        let mean = mean_of_files(&catalogues, true, true);
        let found = mean.unwrap().shear.unwrap().shear[0];
        assert!((found - (0.25 + 0.01) / 1.002).abs() < 1e-15, "{found}");
    }

    #[test]
    fn the_whole_response_is_divided_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalogue-001.parquet");
        let (diagonal, across) = ([0.4, 0.6, 0.7, 0.5], [0.1, 0.2, -0.1, 0.05]);
        let e = [[0.05, 0.1], [0.2, -0.1], [-0.3, 0.2], [0.1, 0.0]];
        write(&path, &e, [&diagonal, &across], &[]);
        let found = mean_of_files(&[(1, path)], true, true).unwrap();
        let found = found.shear.unwrap();
        // By plain sums: R = [[a, b], [−b, a]].
        let mean = |values: &dyn Fn(usize) -> f64| (0..4).map(values).sum::<f64>() / 4.0;
        let (a, b) = (mean(&|k| diagonal[k]), mean(&|k| across[k]));
        let solved = |e: [f64; 2]| {
            let determinant = a * a + b * b;
            [
                (a * e[0] - b * e[1]) / determinant,
                (b * e[0] + a * e[1]) / determinant,
            ]
        };
        let shear = solved([mean(&|k| e[k][0]), mean(&|k| e[k][1])]);
        for i in 0..2 {
            // The error of a ratio of means contains the scatter of the responses.
            let square = |k: usize| {
                let (r, x) = (diagonal[k], across[k]);
                let residual = [
                    e[k][0] - r * shear[0] - x * shear[1],
                    e[k][1] + x * shear[0] - r * shear[1],
                ];
                solved(residual)[i].powi(2)
            };
            let error = (mean(&square) / 3.0).sqrt();
            assert!(
                (found.shear[i] - shear[i]).abs() < 1e-14,
                "{found:?} {shear:?}"
            );
            assert!(
                (found.error()[i] - error).abs() < 1e-14,
                "{found:?} {error}"
            );
        }
    }

    #[test]
    fn shapes_of_rotated_pairs_are_not_in_the_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("catalogue-001.parquet");
        let mean = |metadata: &[(&str, &str)], pairs| {
            written(&path, [0.05, 0.2], metadata);
            let catalogues = [(1, path.clone())];
            mean_of_files(&catalogues, true, pairs)
        };
        let stated = (E_NOISE, "3.0e-2 2.0e-2");
        let own = mean(&[stated], true).unwrap();
        // Of two galaxies, two responses 0.4 and 0.6, and one galaxy without a partner, over the sum of responses.
        for (k, (sigma, (g, spread))) in [0.03, 0.02]
            .into_iter()
            .zip([(0.25, 0.15), (0.125, 0.075)])
            .enumerate()
        {
            let half: f64 = 2.0 * (g * 0.2 / 2f64.sqrt() * 1.0f64).powi(2);
            let expected = 2.0 * sigma * sigma + half + spread * spread / 2.0;
            let found = own.shear.unwrap().covariance[k][k];
            assert!((found - expected).abs() < 1e-15, "{found} {expected}");
        }
        assert!(own.rotated_pairs);
        let plain = mean(&[], true).unwrap();
        assert_eq!(mean(&[stated], false).unwrap().shear, plain.shear);
        assert!(!plain.rotated_pairs);
        let error = mean(&[(E_NOISE, "0.1")], true).unwrap_err().to_string();
        assert!(error.contains("`enoise` are \"0.1\""), "{error}");
    }

    #[test]
    fn only_ellipticities_along_common_axes_have_a_mean() {
        let folder = tempfile::tempdir().unwrap();
        let mean = |frames: &[&str]| {
            let mut catalogues = Vec::new();
            for (image, frame) in (1..).zip(frames) {
                let path = folder.path().join(format!("{image}.parquet"));
                let stated = (CATALOGUE_FRAME, *frame);
                let metadata = if frame.is_empty() { &[][..] } else { &[stated] };
                written(&path, [0.05, 0.2], metadata);
                catalogues.push((image, path));
            }
            mean_of_files(&catalogues, true, true)
        };
        let turned = PixelFrame {
            angle: 37.0,
            ..PixelFrame::default()
        };
        let (aligned, other) = ("0.00 1 0.0000 0.0000", "37.00 1 0.0000 0.0000");
        for (frames, axes) in [
            (&[""; 2], Axes::Pixel),
            (&["pixel", ""], Axes::Pixel),
            (&["sky"; 2], Axes::Sky),
            // A WCS states that these pixels are along the sky.
            (&[aligned, "sky"], Axes::Sky),
            (&["sky", aligned], Axes::Sky),
            (&[other, "217.50 1 0.0010 0.0000"], Axes::Oriented(turned)),
        ] {
            assert_eq!(mean(frames).unwrap().axes, axes, "{frames:?}");
        }
        for frames in [
            &["sky", ""],
            &["", "sky"],
            &["pixel", "sky"],
            &["sky", other],
            &[other, aligned],
            &[other, "37.00 -1 0.0000 0.0000"],
        ] {
            let error = mean(frames).unwrap_err().to_string();
            assert!(error.contains("have other axes than those"), "{error}");
        }
        for text in ["galactic", "37.00 1", "37.00 1 0.0 NaN"] {
            assert!(mean(&[text]).unwrap_err().to_string().contains("`frame`"));
        }
    }

    #[test]
    fn noise_of_stars_is_in_the_error_and_falls_with_their_number() {
        let folder = tempfile::tempdir().unwrap();
        let mean = |images: &[&[(&str, &str)]]| {
            let catalogues: Vec<_> = (1..)
                .zip(images)
                .map(|(image, metadata)| {
                    let path = folder.path().join(format!("{image}.parquet"));
                    written(&path, [0.05, 0.2], metadata);
                    (image, path)
                })
                .collect();
            mean_of_files(&catalogues, true, true)
        };
        let own = |images: usize| mean(&vec![&[][..]; images]).unwrap();
        let noisy = (PSF_NOISE, "4.00e-1 1.00e-2");
        // m times the mean shears of 0.25 and −0.125, and c.
        let of_one = [0.1f64.hypot(0.01), 0.05f64.hypot(0.01)];
        for (images, stated, factor) in [
            (&[&[][..]][..], 0, 0.0),
            (&[&[noisy]], 1, 1.0),
            (&[&[noisy], &[noisy], &[noisy], &[noisy]], 4, 0.5),
            // The same star, different ones, and an image without noise.
            (&[&[noisy, (PSF, "a")], &[noisy, (PSF, "a")]], 2, 1.0),
            (
                &[&[noisy, (PSF, "a")], &[noisy, (PSF, "b")]],
                2,
                0.5f64.sqrt(),
            ),
            (&[&[noisy], &[]], 1, 0.5),
        ] {
            let (with, own) = (mean(images).unwrap(), own(images.len()));
            assert_eq!(with.noisy_stars, stated);
            for (k, of_one) in of_one.into_iter().enumerate() {
                let expected = factor * of_one;
                assert!((with.psf_error[k] - expected).abs() < 1e-15, "{with:?}");
                let total = own.shear.unwrap().error()[k].hypot(expected);
                assert!((with.shear.unwrap().error()[k] - total).abs() < 1e-15);
            }
        }
        for text in [
            "",
            "0.1",
            "0.1 x",
            "-1e-2 1e-2",
            "NaN 0",
            "inf 0",
            "0 11",
            "0  0",
        ] {
            let error = mean(&[&[(PSF_NOISE, text)]]).unwrap_err().to_string();
            assert!(error.contains("psfnoise"), "{error}");
        }
    }
}
