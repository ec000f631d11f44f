//! Simulating sets into a data folder.

use std::sync::Arc;

use ndarray::Array2;
use shearq_quantities::FunctionalPsf;

use super::PipelineError;
use super::engine::{self, Feeder, Progress};
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::psf_table;
use shearq_dataset::record::claim;
use shearq_dataset::run::{SIMULATION_FILE, SimulationRecord};
use shearq_dataset::truth;
use shearq_files::atomic;
use shearq_files::fits::{ImageWriter, Value};
use shearq_simulate::kinds::{SETS, SetKind};
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{
    ImageFields, NOISE_SIGMA, PsfField, STAMP, SetSimulator, SimulationSettings,
};

/// One row of stamps to draw.
struct RowJob {
    set: Arc<SetSimulator>,
    fields: Arc<ImageFields>,
    iy: usize,
}

/// A row of stamps, drawn.
struct DrawnRow {
    job: RowJob,
    pixels: Vec<f32>,
    /// Strip of star stamps, if there is one PSF per galaxy.
    stars: Option<Vec<f32>>,
}

/// Prepares what all images of a set share.
///
/// # Errors
/// If there is no such set, or its shear would not be weak.
pub fn simulator(set: u32, settings: SimulationSettings) -> Result<SetSimulator, PipelineError> {
    let kind = SetKind::of(set).ok_or_else(|| {
        PipelineError::Request(format!("there is no set {set}; expected 1 to {SETS}"))
    })?;
    SetSimulator::new(kind, settings).map_err(|source| PipelineError::Scoring {
        set: Some(set),
        source,
    })
}

/// Simulates `images`, which are in the order of their sets, into `data`. Returns the number of new images and the number
/// that were there already.
///
/// # Errors
/// If a set does not exist, the folder holds data of other settings, or a file cannot be written.
pub fn simulate_folder(
    record: &SimulationRecord,
    images: &[ImageId],
    data: &DataFolder,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<(usize, usize), PipelineError> {
    simulate_into(
        record,
        images,
        Places { data, truth: data },
        threads,
        progress,
    )
}

/// Simulates `images` for a challenge: images and PSFs into `public`; settings, true shear and intrinsic shapes into
/// `private`. The headers of the images contain neither the seed nor properties of the galaxies.
///
/// # Errors
/// As [`simulate_folder`].
pub fn simulate_blind(
    record: &SimulationRecord,
    images: &[ImageId],
    public: &DataFolder,
    private: &DataFolder,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<(usize, usize), PipelineError> {
    let places = Places {
        data: public,
        truth: private,
    };
    simulate_into(record, images, places, threads, progress)
}

/// The folders of a simulation.
#[derive(Clone, Copy)]
struct Places<'a> {
    /// Images and PSFs.
    data: &'a DataFolder,
    /// Settings, true shear and intrinsic shapes.
    truth: &'a DataFolder,
}

impl Places<'_> {
    /// Whether the folder of the images must not determine the true shear.
    fn are_apart(&self) -> bool {
        self.data.root() != self.truth.root()
    }
}

fn simulate_into(
    record: &SimulationRecord,
    images: &[ImageId],
    places: Places<'_>,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<(usize, usize), PipelineError> {
    let Places { data, truth } = places;
    let claim = claim(&truth.root().join(SIMULATION_FILE), record)?;
    let todo: Vec<ImageId> = images
        .iter()
        .filter(|id| !data.galaxies(id.set, id.image).is_file())
        .copied()
        .collect();
    let already = images.len() - todo.len();
    let mut simulators = Vec::new();
    for of_set in todo.chunk_by(|a, b| a.set == b.set) {
        let simulator = simulator(of_set[0].set, record.settings)?;
        write_truth(truth, &simulator)?;
        simulators.push((Arc::new(simulator), of_set));
    }
    let mut made = 0;
    let mut open: Option<OpenImage> = None;
    engine::ordered(
        threads,
        |feeder| {
            feed(&simulators, feeder);
            Ok(())
        },
        RenderScratch::new,
        |scratch, job| Ok(draw_row(scratch, job)),
        |row: DrawnRow| {
            progress.advance(row.job.set.grid().n as u64);
            let mut image = match open.take() {
                Some(image) => image,
                None => {
                    // Writing would make the folder again, without the earlier images.
                    claim.check()?;
                    OpenImage::create(record, places, &row.job)?
                }
            };
            let last = row.job.iy + 1 == row.job.set.grid().n;
            image.add(row)?;
            if last {
                image.finish(places)?;
                made += 1;
            } else {
                open = Some(image);
            }
            Ok(())
        },
    )
    .map_err(|error| claim.explain(error))?;
    claim.check_results(images.iter().map(|id| data.galaxies(id.set, id.image)))?;
    Ok((made, already))
}

fn feed(simulators: &[(Arc<SetSimulator>, &[ImageId])], feeder: &mut Feeder<'_, RowJob>) {
    for (set, images) in simulators {
        for id in *images {
            let fields = Arc::new(set.image_fields(id.image));
            for iy in 0..set.grid().n {
                let job = RowJob {
                    set: Arc::clone(set),
                    fields: Arc::clone(&fields),
                    iy,
                };
                if !feeder.push(job) {
                    return;
                }
            }
        }
    }
}

fn draw_row(scratch: &mut RenderScratch, job: RowJob) -> DrawnRow {
    let pixels = draw_stamps(&job.set, &job.fields, job.iy, scratch);
    let stars = matches!(job.fields.psf, PsfField::PerGalaxy(_))
        .then(|| draw_stars(&job.set, &job.fields, job.iy));
    DrawnRow { job, pixels, stars }
}

/// A strip of noisy stamps.
pub(super) fn draw_stamps(
    set: &SetSimulator,
    fields: &ImageFields,
    iy: usize,
    scratch: &mut RenderScratch,
) -> Vec<f32> {
    let n = set.grid().n;
    let mut pixels = vec![0.0; n * STAMP * STAMP];
    let mut stamp = vec![0.0; STAMP * STAMP];
    for ix in 0..n {
        set.draw(fields, ix, iy, scratch, &mut stamp);
        place(&stamp, STAMP, ix, n, &mut pixels);
    }
    pixels
}

/// A strip of star stamps, one per galaxy.
pub(super) fn draw_stars(set: &SetSimulator, fields: &ImageFields, iy: usize) -> Vec<f32> {
    let n = set.grid().n;
    let mut strip = vec![0.0; n * STAMP * STAMP];
    let mut light = Array2::zeros((STAMP, STAMP));
    let mut star = vec![0.0; STAMP * STAMP];
    for ix in 0..n {
        star_into(fields.psf.at(ix, iy), &mut light, &mut star);
        place(&star, STAMP, ix, n, &mut strip);
    }
    strip
}

/// Copies a stamp to its place in a strip of `n`.
pub fn place(stamp: &[f32], side: usize, ix: usize, n: usize, strip: &mut [f32]) {
    for (y, row) in stamp.chunks_exact(side).enumerate() {
        let at = y * n * side + ix * side;
        strip[at..at + side].copy_from_slice(row);
    }
}

/// A noise-free star stamp with a sum of one.
pub fn star(psf: &FunctionalPsf, side: usize) -> Vec<f32> {
    let mut star = vec![0.0; side * side];
    star_into(psf, &mut Array2::zeros((side, side)), &mut star);
    star
}

/// The same in place of what `star` holds, with room for its light in double precision.
fn star_into(psf: &FunctionalPsf, light: &mut Array2<f64>, star: &mut [f32]) {
    psf.stamp_into(light.nrows(), light.view_mut());
    let light = light.as_slice().expect("a whole array has one order");
    for (pixel, light) in star.iter_mut().zip(light) {
        *pixel = *light as f32;
    }
}

/// Writes the true shear of a set.
pub(super) fn write_truth(data: &DataFolder, set: &SetSimulator) -> Result<(), PipelineError> {
    let path = data.truth(set.kind().set);
    Ok(truth::write_truth(&path, &set.grid(), &set.truth())?)
}

/// Files of one image that is being written.
struct OpenImage {
    galaxies: ImageWriter,
    stars: Option<ImageWriter>,
    job: RowJob,
    intrinsic: csv::Writer<Vec<u8>>,
}

impl OpenImage {
    fn create(
        record: &SimulationRecord,
        places: Places<'_>,
        job: &RowJob,
    ) -> Result<Self, PipelineError> {
        let data = places.data;
        let (set, image) = (job.set.kind().set, job.fields.image);
        let n = job.set.grid().n;
        let mut header = vec![
            ("SET", Value::Int(i64::from(set))),
            ("IMAGE", Value::Int(i64::from(image))),
            ("STAMP", Value::Int(STAMP as i64)),
            ("NGRID", Value::Int(n as i64)),
            ("NOISESIG", Value::Real(NOISE_SIGMA)),
            ("CREATOR", Value::Text(format!("shearq {}", record.version))),
        ];
        if !places.are_apart() {
            let seed = record.settings.seed;
            header.extend([
                ("SNR", Value::Real(job.set.nominal_snr())),
                ("KIND", Value::Text(job.set.kind().image.label().into())),
                match i64::try_from(seed) {
                    Ok(seed) => ("SEED", Value::Int(seed)),
                    Err(_) => ("SEED", Value::Text(seed.to_string())),
                },
            ]);
        }
        let side = n * STAMP;
        let galaxies = ImageWriter::create(data.galaxies(set, image), side, side, &header)?;
        let psf_path = data.psf_star(set, image);
        let psf_header = [
            ("SET", Value::Int(i64::from(set))),
            ("IMAGE", Value::Int(i64::from(image))),
            ("STAMP", Value::Int(STAMP as i64)),
            ("CREATOR", Value::Text(format!("shearq {}", record.version))),
        ];
        let stars = match &job.fields.psf {
            PsfField::One(psf) => {
                let mut writer = ImageWriter::create(&psf_path, STAMP, STAMP, &psf_header)?;
                writer.write_rows(&star(psf, STAMP))?;
                writer.finish()?;
                None
            }
            PsfField::PerGalaxy(_) => {
                Some(ImageWriter::create(&psf_path, side, side, &psf_header)?)
            }
        };
        write_psf_table(data, job)?;
        // Writing to memory cannot fail.
        let mut intrinsic = csv::Writer::from_writer(Vec::new());
        let _ = intrinsic.write_record(["x", "y", "e1", "e2", "observed_e1", "observed_e2"]);
        Ok(OpenImage {
            galaxies,
            stars,
            job: RowJob {
                set: Arc::clone(&job.set),
                fields: Arc::clone(&job.fields),
                iy: 0,
            },
            intrinsic,
        })
    }

    fn add(&mut self, row: DrawnRow) -> Result<(), PipelineError> {
        self.galaxies.write_rows(&row.pixels)?;
        if let (Some(writer), Some(strip)) = (&mut self.stars, &row.stars) {
            writer.write_rows(strip)?;
        }
        let RowJob { set, fields, iy } = row.job;
        for ix in 0..set.grid().n {
            let (x, y) = set.grid().centre(ix, iy);
            let e = fields.intrinsic[(ix, iy)];
            let observed = set.observed(&fields, ix, iy);
            let numbers = [x, y, e.re, e.im, observed.e1, observed.e2];
            let _ = self
                .intrinsic
                .write_record(numbers.map(|number| number.to_string()));
        }
        Ok(())
    }

    /// The galaxies are renamed last: an image with galaxies is complete.
    fn finish(self, places: Places<'_>) -> Result<(), PipelineError> {
        let (set, image) = (self.job.set.kind().set, self.job.fields.image);
        if let Some(stars) = self.stars {
            stars.finish()?;
        }
        atomic::write(
            places.truth.intrinsic(set, image),
            &self.intrinsic.into_inner().unwrap_or_default(),
        )?;
        self.galaxies.finish()?;
        Ok(())
    }
}

fn write_psf_table(data: &DataFolder, job: &RowJob) -> Result<(), PipelineError> {
    let grid = job.set.grid();
    let rows: Vec<_> = match &job.fields.psf {
        PsfField::One(psf) => vec![(grid.centre(0, 0), *psf)],
        PsfField::PerGalaxy(field) => (0..grid.cells())
            .map(|k| {
                let (ix, iy) = (k % grid.n, k / grid.n);
                (grid.centre(ix, iy), field[(ix, iy)])
            })
            .collect(),
    };
    let path = data.psf_functional(job.set.kind().set, job.fields.image);
    Ok(psf_table::write(&path, &rows)?)
}
