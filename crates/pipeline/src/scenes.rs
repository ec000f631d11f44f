//! Simulating scenes into a folder: exposures, their PSF, and the truth in tables.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::Array2;
use serde::{Deserialize, Serialize};
use shearq_dataset::layout::fill;
use shearq_dataset::run::{SIMULATION_FILE, claim};
use shearq_dataset::threads::Progress;
use shearq_files::fits::{ImageWriter, Value, write_vector};
use shearq_files::{FileError, atomic};
use shearq_simulate::render::RenderScratch;
use shearq_simulate::scene::{STAR, SceneSettings, SceneSimulator, Source, Stamp, View};
use shearq_simulate::set::NOISE_SIGMA;

use super::PipelineError;
use super::engine;
use super::simulate::is_whole;
use super::wcs::{Keys, Wcs};

/// Names of the files of a folder of scenes.
pub const SCENE: &str = "scene-{image:03}.fits";
const TRUTH: &str = "truth-{image:03}.csv";
pub const STAR_FILE: &str = "psf.fits";
// A PSF that varies, as PSFEx has it.
const MODEL_FILE: &str = "model.psf";
/// The shear of each scene, for `bias --truth`.
pub const SHEARS: &str = "shears.csv";

// The centre of all scenes. On the equator the axes of the pixels are those of the sky over the whole image.
const CENTRE_DEGREES: [f64; 2] = [150.0, 0.0];

// Objects that a worker draws at a time, some milliseconds. Chosen by hand.
const CHUNK: usize = 256;

/// What determines the scenes of a folder. Their number does not: more can be added.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneRecord {
    pub version: String,
    pub settings: SceneSettings,
    /// Fingerprint of the table of fits to galaxies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub galaxies: Option<String>,
}

struct Chunk {
    scene: u32,
    epoch: u32,
    objects: Range<usize>,
    is_last: bool,
}

/// Where scenes are written to: exposures and PSF into one folder, tables of truth and settings into the other, which may be the
/// same one.
#[derive(Debug, Clone, Copy)]
pub struct SceneFolders<'a> {
    pub images: &'a Path,
    pub truth: &'a Path,
}

/// Simulates scenes 1 to `scenes`. Returns the number of new ones.
///
/// One image is in memory at a time, and what the workers have drawn ahead. Light is added in the order of the objects, so that
/// the images are the same for any number of threads.
pub fn simulate_scenes(
    simulator: &SceneSimulator,
    record: &SceneRecord,
    scenes: u32,
    SceneFolders {
        images,
        truth: secret,
    }: SceneFolders<'_>,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<usize, PipelineError> {
    let claim = claim(&secret.join(SIMULATION_FILE), record, SCENE)?;
    let side = simulator.settings().side;
    let path = |(scene, epoch)| images.join(exposure_name(scene, epoch));
    let epochs = 1..=simulator.settings().epochs;
    let all: Vec<(u32, u32)> = (1..=scenes)
        .flat_map(|scene| epochs.clone().map(move |epoch| (scene, epoch)))
        .collect();
    let is_there = |&own: &(u32, u32)| {
        is_whole(&path(own), side) && (own.1 > 1 || truth_path(secret, own.0).exists())
    };
    let todo: Vec<(u32, u32)> = all.iter().copied().filter(|own| !is_there(own)).collect();
    write_star(simulator, record, images)?;
    let objects = simulator.objects();
    progress.skip((all.len() - todo.len()) as u64 * objects as u64);
    let mut image = Array2::zeros((side, side));
    let mut truth = TruthTable::new(simulator.settings());
    engine::ordered(
        threads,
        |feeder| {
            for &(scene, epoch) in &todo {
                // At least one chunk, also of a scene without objects.
                for first in (0..objects.max(1)).step_by(CHUNK) {
                    let end = (first + CHUNK).min(objects);
                    let chunk = Chunk {
                        scene,
                        epoch,
                        objects: first..end,
                        is_last: end == objects,
                    };
                    if !feeder.push(chunk) {
                        return Ok(());
                    }
                }
            }
            Ok(())
        },
        RenderScratch::new,
        |scratch, chunk: Chunk| {
            let sources = chunk.objects.clone();
            let sources = sources.filter_map(|index| simulator.source(chunk.scene, index));
            let view = simulator.settings().view(chunk.scene, chunk.epoch);
            let sources = sources.filter_map(|source| simulator.seen(&source, view));
            let drawn: Vec<(Source, Stamp)> = sources
                .map(|source| (source, simulator.draw(&source, scratch)))
                .collect();
            Ok((chunk, drawn))
        },
        |(chunk, drawn)| {
            progress.advance(chunk.objects.len() as u64);
            for (source, stamp) in &drawn {
                stamp.add_to(&mut image);
                truth.add(simulator, chunk.scene, source);
            }
            if chunk.is_last {
                claim.check()?;
                let Chunk { scene, epoch, .. } = chunk;
                simulator.add_noise(scene, epoch, &mut image);
                // The image is written last, so that its file shows that the scene is complete.
                let table = std::mem::replace(&mut truth, TruthTable::new(simulator.settings()));
                if epoch == 1 {
                    table.write(&truth_path(secret, scene))?;
                }
                write_image(record, (scene, epoch), &image, &path((scene, epoch)))?;
                image.fill(0.0);
            }
            Ok(())
        },
    )
    .map_err(|error| claim.explain(error))?;
    claim.check_results(all.iter().copied().map(path))?;
    Ok(todo.len())
}

/// The file of an epoch (from 1) of a scene.
pub fn exposure_name(scene: u32, epoch: u32) -> String {
    match epoch {
        1 => fill(SCENE, 0, scene),
        _ => fill(SCENE, 0, scene).replace(".fits", &format!("-epoch-{epoch}.fits")),
    }
}

fn truth_path(out: &Path, scene: u32) -> PathBuf {
    out.join(fill(TRUTH, 0, scene))
}

// Keys of a tangential projection. In the first epoch x is to the west and y to the north.
fn wcs_keys(settings: &SceneSettings, view: View) -> Vec<(&'static str, Value)> {
    let text = |text: &str| Value::Text(text.into());
    let middle = 0.5 * (settings.side as f64 + 1.0);
    let [x, y] = view.dither.map(|offset| Value::Real(middle + offset));
    let pixel = settings.pixel_arcsec / 3600.0;
    // From turned pixels back to those of the first epoch, and from there to the sky. Added to zero, which makes no minus zero.
    let (sin, cos) = view.radians.sin_cos();
    let sky = |value: f64| Value::Real(pixel * value + 0.0);
    let [ra, dec] = CENTRE_DEGREES.map(Value::Real);
    vec![
        ("CTYPE1", text("RA---TAN")),
        ("CTYPE2", text("DEC--TAN")),
        ("CUNIT1", text("deg")),
        ("CUNIT2", text("deg")),
        ("CRPIX1", x),
        ("CRPIX2", y),
        ("CRVAL1", ra),
        ("CRVAL2", dec),
        ("CD1_1", sky(-cos)),
        ("CD1_2", sky(-sin)),
        ("CD2_1", sky(-sin)),
        ("CD2_2", sky(cos)),
    ]
}

// The same as [`Wcs`] reads it, so that positions in tables are those of the header.
fn wcs(settings: &SceneSettings) -> Wcs {
    let values = wcs_keys(settings, View::default())
        .into_iter()
        .map(|(key, value)| {
            let value = match value {
                Value::Int(number) => number.to_string(),
                Value::Real(number) => number.to_string(),
                Value::Text(text) => text,
            };
            (key.to_owned(), value)
        });
    Wcs::of_keys(&Keys::new(values.collect::<BTreeMap<_, _>>()))
}

fn creator(record: &SceneRecord) -> (&'static str, Value) {
    ("CREATOR", Value::Text(format!("shearq {}", record.version)))
}

fn write_image(
    record: &SceneRecord,
    (scene, epoch): (u32, u32),
    image: &Array2<f32>,
    path: &Path,
) -> Result<(), FileError> {
    let settings = &record.settings;
    let mut header = wcs_keys(settings, settings.view(scene, epoch));
    header.push(("SCENE", Value::Int(i64::from(scene))));
    header.extend((epoch > 1).then_some(("EPOCH", Value::Int(i64::from(epoch)))));
    header.push(("NOISESIG", Value::Real(NOISE_SIGMA)));
    header.extend(settings.gain.map(|gain| ("GAIN", Value::Real(gain))));
    header.push(creator(record));
    let (height, width) = image.dim();
    let mut writer = ImageWriter::create(path, width, height, &header)?;
    for row in image.rows() {
        writer.write_rows(row.as_slice().unwrap_or_default())?;
    }
    writer.finish()
}

fn write_star(
    simulator: &SceneSimulator,
    record: &SceneRecord,
    out: &Path,
) -> Result<(), FileError> {
    let pixel = record.settings.pixel_arcsec;
    // Of turned exposures it is the PSF on the pixels of each, whatever their axes on the sky.
    let mut header = match record.settings.epochs {
        1 => Wcs::of_jacobian([[pixel, 0.0], [0.0, pixel]]).keys(),
        _ => Vec::new(),
    };
    header.push(creator(record));
    let mut writer = ImageWriter::create(out.join(STAR_FILE), STAR, STAR, &header)?;
    writer.write_rows(&simulator.star().into_raw_vec_and_offset().0)?;
    writer.finish()?;
    if record.settings.psf_gradient == [0.0; 2] {
        return Ok(());
    }
    let terms = simulator.star_terms();
    let side = STAR + 1;
    let count = terms.len() / (side * side);
    let text = |text: &str| Value::Text(text.into());
    let whole = |number: usize| Value::Int(number as i64);
    let scene = record.settings.side as f64;
    let [middle, scale] = [0.5 * (scene + 1.0), scene].map(Value::Real);
    let keys = [
        ("TDIM1", text(&format!("({side},{side},{count})"))),
        ("POLNAXIS", whole(2)),
        ("POLNGRP", whole(1)),
        ("POLGRP1", whole(1)),
        ("POLGRP2", whole(1)),
        ("POLNAME1", text("X_IMAGE")),
        ("POLNAME2", text("Y_IMAGE")),
        ("POLZERO1", middle.clone()),
        ("POLZERO2", middle),
        ("POLSCAL1", scale.clone()),
        ("POLSCAL2", scale),
        ("POLDEG1", whole(2)),
        ("PSF_SAMP", Value::Real(1.0)),
        ("PSFNAXIS", whole(3)),
        ("PSFAXIS1", whole(side)),
        ("PSFAXIS2", whole(side)),
        ("PSFAXIS3", whole(count)),
        creator(record),
    ];
    write_vector(&out.join(MODEL_FILE), "PSF_MASK", terms, &keys)
}

/// Writes the shears of scenes 1 to `scenes` of each version for `bias --truth`, by names that catalogues may have as files or
/// folders: `scene-001`, or `plus/scene-001` if there are several versions, each in its folder of `out`.
pub fn write_shears<'v>(
    versions: impl Iterator<Item = (&'v SceneSimulator, &'v Path)>,
    scenes: u32,
    out: &Path,
) -> Result<(), FileError> {
    let mut table = String::from("catalogue,g1,g2\n");
    for (simulator, folder) in versions {
        let folder = folder.strip_prefix(out).unwrap_or(folder);
        for scene in 1..=scenes {
            let g = simulator.shear(scene);
            let name = folder.join(fill(SCENE, 0, scene)).with_extension("");
            table += &format!("{},{},{}\n", name.display(), g.e1, g.e2);
        }
    }
    atomic::write(out.join(SHEARS), table.as_bytes())
}

/// Rows of sources whose centres are on the image.
struct TruthTable {
    rows: csv::Writer<Vec<u8>>,
    wcs: Wcs,
}

const TRUTH_COLUMNS: [&str; 19] = [
    "id",
    "scene",
    "star",
    "x",
    "y",
    "ra",
    "dec",
    "snr",
    "flux",
    "half_light_radius",
    "bulge_share",
    "bulge_half_light_radius",
    "fit",
    "e1",
    "e2",
    "observed_e1",
    "observed_e2",
    "g1",
    "g2",
];

impl TruthTable {
    fn new(settings: &SceneSettings) -> Self {
        let mut rows = csv::Writer::from_writer(Vec::new());
        // Writing to memory cannot fail.
        let _ = rows.write_record(TRUTH_COLUMNS);
        TruthTable {
            rows,
            wcs: wcs(settings),
        }
    }

    fn add(&mut self, simulator: &SceneSimulator, scene: u32, source: &Source) {
        let settings = simulator.settings();
        let inside = |at: &f64| (-0.5..settings.side as f64 - 0.5).contains(at);
        if !source.centre.iter().all(inside) {
            return;
        }
        // FITS counts from 1.
        let [x, y] = source.centre.map(|at| at + 1.0);
        let [ra, dec] = self.wcs.sky([x, y]).unwrap_or([f64::NAN; 2]);
        let g = simulator.shear(scene);
        let numbers = [
            source.index as f64,
            f64::from(scene),
            f64::from(u8::from(source.is_star)),
            x,
            y,
            ra,
            dec,
            source.snr,
            source.flux,
            source.half_light_px,
            source.bulge_share,
            source.bulge_half_light_px,
            source.fit as f64,
            source.intrinsic.e1,
            source.intrinsic.e2,
            source.observed.e1,
            source.observed.e2,
            g.e1,
            g.e2,
        ];
        let _ = self
            .rows
            .write_record(numbers.map(|number| number.to_string()));
    }

    fn write(self, path: &Path) -> Result<(), FileError> {
        atomic::write(path, &self.rows.into_inner().unwrap_or_default())
    }
}
