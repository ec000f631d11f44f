//! Images of a data folder as a stream of rows of stamps.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use rayon::ThreadPool;
use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_measure::{Measurer, Warning};
use shearq_submissions::{Configuration, NoiseSource};

use super::head::{ImageHead, StampRow, check_strip};
use super::noise;
use super::psfs::{OpenPsfs, PsfSource, open_psf};
use crate::PipelineError;
use crate::data::layout::DataFolder;
use crate::data::mosaic::Mosaic;
use crate::grid;
use crate::images::ImageId;
use crate::wcs::Wcs;

/// An open image with its PSFs, read row by row.
pub struct ImageSource {
    head: Arc<ImageHead>,
    image: ImageReader,
    psfs: PsfSource,
    next: usize,
}

impl fmt::Debug for ImageSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ImageSource")
            .field("head", &self.head)
            .field("next", &self.next)
            .finish_non_exhaustive()
    }
}

impl ImageSource {
    /// Opens an image and its PSFs.
    ///
    /// # Errors
    /// If a file is absent, damaged or does not fit the configuration.
    pub fn open(
        data: &DataFolder,
        id: ImageId,
        configuration: &Configuration,
    ) -> Result<Self, PipelineError> {
        let path = data.galaxies(id.set, id.image);
        let (image, mosaic) = open_galaxies(data, id)?;
        let stamp = mosaic.stamp;
        if stamp < configuration.stamp.size {
            return Err(FileError::new(path, too_small(stamp, configuration)).into());
        }
        let header_noise = image.number("NOISESIG")?;
        let uses_header = configuration.noise == NoiseSource::Header;
        if uses_header && !header_noise.is_some_and(|sigma| sigma > 0.0 && sigma.is_finite()) {
            let found = header_noise.map_or("absent".into(), |sigma| sigma.to_string());
            let other = match configuration.linear() {
                Some(_) => "image",
                None => "border",
            };
            let message = format!(
                "the header key NOISESIG is {found}; expected a positive number, which the configuration {} requires. Try: noise.source = \"{other}\", to measure the noise",
                configuration.name
            );
            return Err(FileError::new(path, message).into());
        }
        let OpenPsfs {
            source: psfs,
            moved,
            wcs: psf_wcs,
            stated,
        } = open_psf(data, id, configuration, &mosaic)?;
        let mut warnings: Vec<Warning> = Warning::of_settings(configuration).into_iter().collect();
        warnings.extend(moved.map(Warning::of_moved));
        let wcs = Wcs::of_header(&image);
        warnings.extend(Wcs::disagreements(&psf_wcs, &wcs));
        warnings.extend(wcs.frame());
        for (of, stated) in [("galaxies", stated_image(&image)), ("PSF", stated)] {
            let expected = [id.set, id.image];
            let other = stated.filter(|stated| *stated != expected);
            warnings.extend(other.map(|stated| Warning::OtherImage {
                of,
                stated,
                expected,
            }));
        }
        let head = ImageHead {
            id,
            mosaic,
            noise: header_noise,
            stated_noise: header_noise.filter(|_| uses_header),
            survey: None,
            stars: None,
            warnings,
            run_warnings: Vec::new(),
            prints: BTreeMap::new(),
        };
        Ok(ImageSource {
            head: Arc::new(head),
            image,
            psfs,
            next: 0,
        })
    }

    /// What all rows of the image share.
    pub fn head(&self) -> &ImageHead {
        &self.head
    }

    /// The same, to be changed before the first row is read.
    pub(super) fn head_mut(&mut self) -> &mut ImageHead {
        Arc::make_mut(&mut self.head)
    }

    /// Measures noise and galaxy sizes on the stamps, if the configuration of `measurer` requires it, and looks at noisy stars
    /// if there is one for each galaxy, on `threads`. If all stamps have too many missing pixels, the galaxies are flagged: NOISESIG does
    /// not replace the measurement.
    ///
    /// # Errors
    /// If stamps or stars cannot be read, or stamps have no border of noise.
    pub fn survey(
        &mut self,
        data: &DataFolder,
        measurer: &Measurer,
        threads: &ThreadPool,
    ) -> Result<(), PipelineError> {
        let mosaic = self.head.mosaic;
        self.head_mut().stars = self.psfs.survey(mosaic, measurer, threads)?;
        let Some(plan) = measurer.noise_plan() else {
            return Ok(());
        };
        let id = self.head.id;
        let path = data.galaxies(id.set, id.image);
        let found = noise::survey(&mut self.image, &path, mosaic, plan)?;
        let head = self.head_mut();
        match &found {
            Some(survey) => {
                let stated = head.noise;
                head.warnings.extend(noise::disagreement(stated, survey));
            }
            None => {
                head.noise = None;
                head.warnings.push(Warning::NoNoise);
            }
        }
        head.survey = found;
        Ok(())
    }

    /// Checks whether noise is correlated that the configuration treats as white.
    ///
    /// # Errors
    /// If stamps cannot be read, or have no border of noise although the configuration requires it.
    pub(super) fn check_correlation(
        &mut self,
        data: &DataFolder,
        measurer: &Measurer,
    ) -> Result<(), PipelineError> {
        let id = self.head.id;
        let path = data.galaxies(id.set, id.image);
        let found = noise::correlation(&mut self.image, &path, &self.head, measurer)?;
        self.head_mut().run_warnings.extend(found);
        Ok(())
    }

    /// The next row of stamps, `None` after the last.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn next_row(&mut self) -> Result<Option<StampRow>, PipelineError> {
        let mosaic = self.head.mosaic;
        if self.next == mosaic.rows() {
            return Ok(None);
        }
        let iy = self.next;
        self.next += 1;
        Ok(Some(StampRow {
            head: Arc::clone(&self.head),
            iy,
            pixels: self.image.read_rows(mosaic.stamp)?,
            psfs: self.psfs.next_row(mosaic, iy)?,
        }))
    }
}

/// Set and image that the header of a simulated image states. Headers of other programs may have one of these keys with
/// another meaning, so that both must be whole numbers.
pub(super) fn stated_image(image: &ImageReader) -> Option<[u32; 2]> {
    let whole = |key: &str| {
        let value = image.number(key).ok().flatten()?;
        (value.fract() == 0.0 && value >= 1.0).then_some(value as u32)
    };
    Some([whole("SET")?, whole("IMAGE")?])
}

/// Why stamps of `stamp` pixels a side cannot be measured, with the lines of a configuration that measures them.
fn too_small(stamp: usize, configuration: &Configuration) -> String {
    let Configuration { name, .. } = configuration;
    let needed = configuration.stamp.size;
    let mut lines = format!("  extends = \"{name}\"\n  stamp.size = {stamp}");
    if let Some(linear) = configuration.linear() {
        // The linear method requires a window of at most a quarter of the stamp, and a PSF of the same parity.
        let window = stamp as f64 / 4.0;
        if linear.deconvolution.window_sigma > window {
            lines += &format!("\n  deconvolution.window_sigma = {window}");
        }
        if configuration.psf.size % 2 != stamp % 2 {
            lines += &format!("\n  psf.size = {}", configuration.psf.size - 1);
        }
    }
    format!(
        "the stamps are too small for the configuration {name} (found {stamp} px a side, expected {needed} or more). Try: --submission own.toml, with the file own.toml of these lines:\n{lines}"
    )
}

/// Opens the galaxies of an image. Their stamps follow from the header, or else from the layout of the data.
pub(crate) fn open_galaxies(
    data: &DataFolder,
    id: ImageId,
) -> Result<(ImageReader, Mosaic), PipelineError> {
    let path = data.galaxies(id.set, id.image);
    let image = ImageReader::open(&path)?;
    let mosaic = grid::of_image(data, &path, &image)?;
    check_strip(&path, mosaic.columns, mosaic.stamp)?;
    Ok((image, mosaic))
}
