//! Images of a data folder as sources of stamps.

use std::fmt;
use std::path::PathBuf;

use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_measure::{
    KnownNoise, Lazy, LazyStamps, Measurer, Psfs, Session, StampRows, StampSource, Threads, Warning,
};
use shearq_submissions::{Configuration, NoiseSource};

use super::psfs::{OpenPsfs, PsfSource, open_psf};
use super::stamps::{check_strip, read_row, stated_image};
use crate::PipelineError;
use crate::wcs::Wcs;
use shearq_dataset::grid;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::mosaic::Mosaic;

/// An open image with its PSFs.
pub struct ImageSource {
    path: PathBuf,
    mosaic: Mosaic,
    image: ImageReader,
    psfs: PsfSource,
    noise: KnownNoise<'static>,
    warnings: Vec<Warning>,
}

impl fmt::Debug for ImageSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ImageSource")
            .field("path", &self.path)
            .field("mosaic", &self.mosaic)
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
        let stated = image.number("NOISESIG")?;
        let uses_header = configuration.noise == NoiseSource::Header;
        if uses_header && !stated.is_some_and(|sigma| sigma > 0.0 && sigma.is_finite()) {
            let found = stated.map_or("absent".into(), |sigma| sigma.to_string());
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
            stated: of_psf,
        } = open_psf(data, id, configuration, &mosaic)?;
        let mut warnings: Vec<Warning> = moved.map(Warning::of_moved).into_iter().collect();
        let wcs = Wcs::of_header(&image);
        warnings.extend(Wcs::disagreements(&psf_wcs, &wcs));
        warnings.extend(wcs.frame());
        for (of, stated) in [("galaxies", stated_image(&image)), ("PSF", of_psf)] {
            let expected = [id.set, id.image];
            let other = stated.filter(|stated| *stated != expected);
            warnings.extend(other.map(|stated| Warning::OtherImage {
                of,
                stated,
                expected,
            }));
        }
        Ok(ImageSource {
            path,
            mosaic,
            image,
            psfs,
            noise: stated.map_or(KnownNoise::Unknown, KnownNoise::Stated),
            warnings,
        })
    }

    /// How the stamps lie.
    pub fn mosaic(&self) -> Mosaic {
        self.mosaic
    }

    /// The session of the image, for a measurer of the configuration that the image was opened for.
    ///
    /// # Errors
    /// If stamps or stars cannot be read, or stamps have no border of noise.
    pub fn session(
        &mut self,
        measurer: &Measurer,
        threads: &impl Threads,
    ) -> Result<Session<'static>, PipelineError> {
        let session = Session::open(measurer, self, self.noise, threads);
        session.map_err(|error| self.named(error))
    }

    /// A warning if noise is correlated that the configuration treats as white.
    ///
    /// # Errors
    /// As [`ImageSource::session`].
    pub(super) fn correlated_noise(
        &mut self,
        session: &Session<'static>,
        threads: &impl Threads,
    ) -> Result<Option<Warning>, PipelineError> {
        let found = session.correlated_noise(self, threads);
        found.map_err(|error| self.named(error))
    }

    /// The error with the name of the image.
    fn named(&self, error: PipelineError) -> PipelineError {
        match error {
            PipelineError::Measure(error) => FileError::new(&self.path, error).into(),
            other => other,
        }
    }
}

impl StampSource<'static> for ImageSource {
    type Error = PipelineError;

    fn rows(&self) -> StampRows {
        StampRows {
            columns: self.mosaic.columns,
            count: self.mosaic.galaxies,
        }
    }

    fn warnings(&self) -> Vec<Warning> {
        self.warnings.clone()
    }

    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'static>, PipelineError> {
        Ok(read_row(&mut self.image, self.mosaic, self.mosaic.stamp, row)?.into())
    }

    fn psfs(&mut self, row: usize) -> Result<Lazy<'static, Psfs<'static>>, PipelineError> {
        Ok(self.psfs.row(self.mosaic, row)?.into())
    }
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
