//! What catalogues state of the noise of their star, which changes m and c of all galaxies of an image, and what this does to
//! a mean shear.

use std::collections::BTreeMap;
use std::path::Path;

pub use shearq_bias::StarNoise;
use shearq_dataset::fingerprint::PSF;
use shearq_dataset::metadata::{PSF_NOISE, number_pair};
use shearq_files::FileError;
use shearq_files::frames::Metadata;
use shearq_files::frames::polars::DataFrame;
use shearq_files::table::{self, FileFormat};

// Largest effect on m or c that metadata can state: a star without any signal has 5.5.
const MAX_STAR_EFFECT: f64 = 10.0;

// Columns that Python's catalogues have instead: a number for the star, and the scatter of m and of c.
const COLUMNS: [&str; 3] = ["psf_id", "psf_m", "psf_c"];

// The noise of the star of a table in memory; `None` if it has no such columns, no noise, or galaxies behind several
// stars.
pub fn of_table(table: &DataFrame, name: &Path) -> Option<StarNoise> {
    let [star, m, c] = COLUMNS.map(|column| {
        let values = table::numbers(table, column, name).ok()?;
        let first = *values.first()?;
        values.iter().all(|value| *value == first).then_some(first)
    });
    let (star, m, c) = (star?, m?, c?);
    let known = [m, c]
        .iter()
        .all(|effect| (0.0..=MAX_STAR_EFFECT).contains(effect))
        && m > 0.0;
    known.then(|| StarNoise {
        star: format!("{star:.0}"),
        m,
        c,
    })
}

// The noise of the star of a catalogue of shearq; `None` if the catalogue does not state it.
pub fn of_catalogue(path: &Path, format: FileFormat) -> Result<Option<StarNoise>, FileError> {
    stated(path, table::read_metadata(path, format, [PSF_NOISE, PSF])?)
}

// The noise that metadata state, of a star that is named by its fingerprint or, without one, as the catalogue.
fn stated(path: &Path, mut metadata: Metadata) -> Result<Option<StarNoise>, FileError> {
    let Some(text) = metadata.get(PSF_NOISE) else {
        return Ok(None);
    };
    let [m, c] = number_pair(path, PSF_NOISE, text, MAX_STAR_EFFECT)?;
    let star = metadata.remove(PSF);
    let star = star.unwrap_or_else(|| path.display().to_string());
    Ok(Some(StarNoise { star, m, c }))
}

/// The noise of stars in a mean shear. Images with the same star have the same error.
#[derive(Debug, Default)]
pub struct Stars {
    // By star: sums of responses, which are the shares in the mean, times the scatter of m and of c.
    effects: BTreeMap<String, [[f64; 2]; 2]>,
    responses: [f64; 2],
    stated: usize,
}

impl Stars {
    /// Adds an image with this star, if its noise is known, and galaxies with responses of the sum `share`.
    pub fn add(&mut self, noise: Option<StarNoise>, share: [f64; 2]) {
        for (sum, share) in self.responses.iter_mut().zip(share) {
            *sum += share;
        }
        let Some(StarNoise { star, m, c }) = noise else {
            return;
        };
        self.stated += 1;
        let sums = self.effects.entry(star).or_default();
        for (sums, effect) in sums.iter_mut().zip([m, c]) {
            for (sum, share) in sums.iter_mut().zip(share) {
                *sum += share * effect;
            }
        }
    }

    pub fn stated(&self) -> usize {
        self.stated
    }

    pub fn errors(&self, shear: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|k| {
            let variances = self.effects.values().map(|[m, c]| {
                let [m, c] = [m[k], c[k]].map(|sum| sum / self.responses[k]);
                (m * shear[k]).powi(2) + c * c
            });
            variances.sum::<f64>().sqrt()
        })
    }
}
