//! Simulating sets into a data folder.

use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Arc;

use super::PipelineError;
use super::engine::{self, Feeder};
use shearq_dataset::grid::write_psfs;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{SIMULATION_FILE, SimulationRecord, claim};
use shearq_dataset::threads::Progress;
use shearq_dataset::truth;
use shearq_files::fits::{ImageReader, ImageWriter, Value};
use shearq_files::{atomic, open};
use shearq_simulate::kinds::SetKind;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{
    ImageFields, NOISE_SIGMA, PsfField, STAMP, SetSimulator, SimulationSettings,
};

pub fn simulator(set: u32, settings: SimulationSettings) -> Result<SetSimulator, PipelineError> {
    let kind = SetKind::of(set).ok_or(PipelineError::NoSuchSet(set))?;
    SetSimulator::new(kind, settings).map_err(|source| PipelineError::Scoring {
        set: Some(set),
        source,
    })
}

/// Simulates `images`, which are in the order of their sets: images and PSFs into `public`; settings, true shear and
/// intrinsic shapes into `private`. If these are two folders, as of a challenge, the headers of the images contain neither
/// the seed nor properties of the galaxies. Returns the number of new images and the number that were there already.
pub fn simulate_images(
    record: &SimulationRecord,
    images: &[ImageId],
    public: &DataFolder,
    private: &DataFolder,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<(usize, usize), PipelineError> {
    let path = private.root().join(SIMULATION_FILE);
    let claim = claim(&path, record, &public.layout().galaxies)?;
    let side = record.settings.grid * STAMP;
    // The galaxies of an image are written last, so that their file shows that the image was completed.
    let mut simulators = Vec::new();
    for of_set in images.chunk_by(|a, b| a.set == b.set) {
        let set = of_set[0].set;
        let simulator = simulator(set, record.settings)?;
        let grid = simulator.grid();
        let last = grid.centre(grid.n - 1, grid.n - 1);
        let last_psf = match simulator.has_one_psf() {
            true => grid.centre(0, 0),
            false => last,
        };
        let is_there = |&ImageId { image, .. }: &ImageId| {
            is_whole(&public.galaxies(set, image), side)
                && ImageReader::open(public.psf_star(set, image)).is_ok()
                && is_whole_table(&public.psf_functional(set, image), last_psf)
                && is_whole_table(&private.intrinsic(set, image), last)
        };
        let todo: Vec<ImageId> = (of_set.iter().filter(|id| !is_there(id)).copied()).collect();
        // Before the images: one whose truth is missing cannot be scored, and a complete image is not simulated again.
        if !todo.is_empty() || !is_whole_table(&private.truth(set), last) {
            write_truth(private, &simulator)?;
        }
        simulators.push((simulator, todo));
    }
    let todo: usize = simulators.iter().map(|(_, todo)| todo.len()).sum();
    let already = images.len() - todo;
    let mut made = 0;
    let mut open: Option<OpenImage<'_>> = None;
    engine::ordered(
        threads,
        |feeder| {
            feed(&simulators, feeder);
            Ok(())
        },
        RenderScratch::new,
        |scratch, row: Row<'_>| {
            let pixels = row.set.draw_row(&row.fields, row.iy, scratch);
            // One PSF of the image is written with its header, not with each row.
            let one_each = matches!(row.fields.psf, PsfField::PerGalaxy(_));
            let stars = one_each.then(|| row.set.draw_stars(&row.fields, row.iy));
            Ok((row, pixels, stars))
        },
        |(row, pixels, stars)| {
            let n = row.set.grid().n;
            progress.advance(n as u64);
            let image = match &mut open {
                Some(image) => image,
                None => {
                    // If a user removed the folder meanwhile, writing would create it again with the later images only.
                    claim.check()?;
                    open.insert(OpenImage::create(record, [public, private], &row)?)
                }
            };
            image.add(&row, &pixels, stars.as_deref())?;
            if row.iy + 1 == n
                && let Some(image) = open.take()
            {
                image.finish(private)?;
                made += 1;
            }
            Ok(())
        },
    )
    .map_err(|error| claim.explain(error))?;
    claim.check_results(images.iter().map(|id| public.galaxies(id.set, id.image)))?;
    Ok((made, already))
}

struct Row<'s> {
    set: &'s SetSimulator,
    fields: Arc<ImageFields>,
    iy: usize,
}

fn feed<'s>(simulators: &'s [(SetSimulator, Vec<ImageId>)], feeder: &mut Feeder<'_, Row<'s>>) {
    for (set, images) in simulators {
        for id in images {
            // Shared by the rows, because they are drawn from one realisation of PSFs and intrinsic shapes.
            let fields = Arc::new(set.image_fields(id.image));
            for iy in 0..set.grid().n {
                let fields = Arc::clone(&fields);
                if !feeder.push(Row { set, fields, iy }) {
                    return;
                }
            }
        }
    }
}

// An image that was cut off when a disk was full or a copy stopped has its name, but not its size.
pub fn is_whole(path: &Path, side: usize) -> bool {
    ImageReader::open(path).is_ok_and(|image| (image.width(), image.height()) == (side, side))
}

// A table that was cut off lacks its last line, which starts with the position of the last galaxy.
fn is_whole_table(path: &Path, (x, y): (f64, f64)) -> bool {
    // More than a line has.
    const TAIL_BYTES: u64 = 512;
    let tail = || -> std::io::Result<Vec<u8>> {
        let mut file = open::open(path)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(TAIL_BYTES)))?;
        let mut tail = Vec::new();
        file.read_to_end(&mut tail)?;
        Ok(tail)
    };
    let starts = |line: &[u8]| line.starts_with(format!("{x},{y},").as_bytes());
    tail().is_ok_and(|tail| {
        let lines = tail.strip_suffix(b"\n");
        let last = lines.and_then(|lines| lines.rsplit(|byte| *byte == b'\n').next());
        last.is_some_and(starts)
    })
}

pub(super) fn write_truth(data: &DataFolder, set: &SetSimulator) -> Result<(), PipelineError> {
    let path = data.truth(set.kind().set);
    Ok(truth::write_truth(&path, &set.grid(), &set.truth())?)
}

struct OpenImage<'s> {
    set: &'s SetSimulator,
    fields: Arc<ImageFields>,
    galaxies: ImageWriter,
    stars: Option<ImageWriter>,
    intrinsic: csv::Writer<Vec<u8>>,
}

impl<'s> OpenImage<'s> {
    fn create(
        record: &SimulationRecord,
        [public, private]: [&DataFolder; 2],
        row: &Row<'s>,
    ) -> Result<Self, PipelineError> {
        let (set, fields) = (row.set, Arc::clone(&row.fields));
        let (number, image, n) = (set.kind().set, fields.image, set.grid().n);
        let common = [
            ("SET", Value::Int(i64::from(number))),
            ("IMAGE", Value::Int(i64::from(image))),
            ("STAMP", Value::Int(STAMP as i64)),
        ];
        let creator = ("CREATOR", Value::Text(format!("shearq {}", record.version)));
        let mut header = common.to_vec();
        header.extend([
            ("NGRID", Value::Int(n as i64)),
            ("NOISESIG", Value::Real(NOISE_SIGMA)),
            creator.clone(),
        ]);
        // Participants of a challenge get the public folder: the seed would repeat the simulation, with its shear.
        if public.root() == private.root() {
            let seed = record.settings.seed;
            header.extend([
                ("SNR", Value::Real(set.nominal_snr())),
                ("KIND", Value::Text(set.kind().image.label().into())),
                match i64::try_from(seed) {
                    // Integers of FITS are signed, seeds are not.
                    Ok(seed) => ("SEED", Value::Int(seed)),
                    Err(_) => ("SEED", Value::Text(seed.to_string())),
                },
            ]);
        }
        let side = n * STAMP;
        let galaxies = ImageWriter::create(public.galaxies(number, image), side, side, &header)?;
        let path = public.psf_star(number, image);
        let header = [&common[..], &[creator]].concat();
        let stars = match &fields.psf {
            PsfField::One(_) => {
                let mut writer = ImageWriter::create(&path, STAMP, STAMP, &header)?;
                writer.write_rows(&fields.psf.star(0, 0).into_raw_vec_and_offset().0)?;
                writer.finish()?;
                None
            }
            PsfField::PerGalaxy(_) => Some(ImageWriter::create(&path, side, side, &header)?),
        };
        let grid = set.grid();
        let psf = |(ix, iy): (usize, usize)| (grid.centre(ix, iy), *fields.psf.at(ix, iy));
        let rows: Vec<_> = match &fields.psf {
            PsfField::One(_) => vec![psf((0, 0))],
            PsfField::PerGalaxy(_) => (0..grid.cells()).map(|k| psf((k % n, k / n))).collect(),
        };
        // Both forms of the PSF, so that configurations of either can be compared on the same galaxies.
        write_psfs(&public.psf_functional(number, image), &rows)?;
        // Writing to memory cannot fail.
        let mut intrinsic = csv::Writer::from_writer(Vec::new());
        let _ = intrinsic.write_record(["x", "y", "e1", "e2", "observed_e1", "observed_e2"]);
        Ok(OpenImage {
            set,
            fields,
            galaxies,
            stars,
            intrinsic,
        })
    }

    fn add(
        &mut self,
        row: &Row<'_>,
        pixels: &[f32],
        stars: Option<&[f32]>,
    ) -> Result<(), PipelineError> {
        self.galaxies.write_rows(pixels)?;
        if let (Some(writer), Some(stars)) = (&mut self.stars, stars) {
            writer.write_rows(stars)?;
        }
        let Row { set, fields, iy } = row;
        for ix in 0..set.grid().n {
            let (x, y) = set.grid().centre(ix, *iy);
            let e = fields.intrinsic[(ix, *iy)];
            let observed = set.observed(fields, ix, *iy);
            let numbers = [x, y, e.re, e.im, observed.e1, observed.e2];
            let _ = self
                .intrinsic
                .write_record(numbers.map(|number| number.to_string()));
        }
        Ok(())
    }

    // The galaxies are renamed last: an image with galaxies is complete.
    fn finish(self, private: &DataFolder) -> Result<(), PipelineError> {
        if let Some(stars) = self.stars {
            stars.finish()?;
        }
        let path = private.intrinsic(self.set.kind().set, self.fields.image);
        atomic::write(path, &self.intrinsic.into_inner().unwrap_or_default())?;
        self.galaxies.finish()?;
        Ok(())
    }
}
