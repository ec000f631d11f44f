//! A branch as in GREAT3 as files: data as participants got them, and the truth as it was released.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use shearq_dataset::fingerprint;
use shearq_dataset::great3::{self, file_name};
use shearq_dataset::run::{SIMULATION_FILE, claim};
use shearq_dataset::threads::Progress;
use shearq_files::fits::{ImageReader, ImageWriter};
use shearq_files::frames::polars::Column;
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat};
use shearq_files::{FileError, atomic};
use shearq_pipeline::galaxy_fits::read_fits;
use shearq_pipeline::simulate::is_whole;
use shearq_pipeline::{PipelineError, engine};
use shearq_quantities::Shear;
use shearq_scoring::great3::{Branch, GRID, STARS_PER_SIDE, SUBFIELDS};
use shearq_simulate::render::RenderScratch;

use super::simulator::{BranchSimulator, Subfield};
use crate::{Simulated, Simulation, SimulationError};

/// What determines all subfields of a simulated branch. Their number does not: more can be added.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Record {
    version: String,
    branch: String,
    seed: u64,
    grid: usize,
    /// Whether all shears have the opposite sign.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    opposite: bool,
    /// Fingerprint of the table of fits to galaxies. Its path does not change when the table is edited.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    galaxies: Option<String>,
}

/// Simulates a branch, and its galaxies under the opposite shear, if asked for.
pub(super) fn simulate(
    branch: Branch,
    simulation: &Simulation<'_>,
    threads: usize,
    start: &dyn Fn(u64) -> Box<dyn Progress>,
) -> Result<Simulated, SimulationError> {
    let (seed, grid, out) = (simulation.seed, simulation.grid, simulation.out);
    if grid > GRID {
        return Err(SimulationError::Grid {
            found: grid,
            most: GRID,
            branch: "a branch of GREAT3",
        });
    }
    let fits = simulation.galaxies.map(read_fits).transpose()?;
    let print = simulation.galaxies.map(fingerprint::of_file).transpose()?;
    let mut simulator = BranchSimulator::new(branch, seed, grid, fits.unwrap_or_default())?;
    let subfields = simulation.subfields.unwrap_or(SUBFIELDS);
    let mut folders = vec![(out.to_owned(), false)];
    if simulation.opposite {
        folders.push((out.join("opposite"), true));
    }
    let images = folders.len() * subfields * branch.epochs();
    let mut progress = start((images * grid * grid) as u64);
    let mut made = 0;
    for (out, opposite) in folders {
        simulator.opposite = opposite;
        let record = Record {
            version: shearq_dataset::VERSION.into(),
            branch: branch.folder(),
            seed,
            grid,
            opposite,
            galaxies: print.clone(),
        };
        made += simulate_branch(
            &simulator,
            &record,
            subfields,
            &out,
            threads,
            &mut *progress,
        )?;
    }
    Ok(Simulated {
        made,
        images,
        folder: out.join(branch.folder()),
        truth: truth_folder(out, branch),
    })
}

/// Where the truth of a branch is, in a folder that holds its data.
fn truth_folder(out: &Path, branch: Branch) -> PathBuf {
    out.join("truth").join(branch.folder())
}

struct Row {
    subfield: Arc<Subfield>,
    epochs: Arc<[usize]>,
    iy: usize,
}

// Largest difference of a pixel from the same one drawn again, in standard deviations of the noise. Transforms on other processors
// round by 10⁻⁶ of the brightness; pixels of another seed differ by one or more. Chosen by hand.
const MAX_REDRAWN_DIFFERENCE: f32 = 0.1;

/// Simulates subfields from 0 into `out`, and returns the number of new images. Whole images are kept if their first galaxy is the
/// one that `simulator` draws; the others are not compared, which would take as long as drawing them.
fn simulate_branch(
    simulator: &BranchSimulator,
    record: &Record,
    subfields: usize,
    out: &Path,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<usize, PipelineError> {
    let (branch, grid) = (simulator.branch, simulator.grid);
    let folder = out.join(branch.folder());
    let truth = truth_folder(out, branch);
    let image = |subfield, epoch| folder.join(file_name(great3::GALAXIES, subfield, epoch));
    let image = &image;
    let images = |subfield| (0..branch.epochs()).map(move |epoch| image(subfield, epoch));
    let pattern = format!("{}/{}", branch.folder(), great3::GALAXIES);
    let claim = claim(&out.join(SIMULATION_FILE), record, &pattern)?;
    let size = branch.stamp();
    let side = grid * size;
    let missing = |subfield| -> Arc<[usize]> {
        let epochs = 0..branch.epochs();
        epochs
            .filter(|epoch| !is_whole(&image(subfield, *epoch), side))
            .collect()
    };
    let todo: Vec<_> = (0..subfields).map(missing).collect();
    let made = todo.iter().map(|epochs| epochs.len()).sum();
    let mut open: Vec<ImageWriter> = Vec::new();
    engine::ordered(
        threads,
        |feeder| {
            for (subfield, epochs) in simulator.subfields(0..subfields).zip(todo) {
                let subfield =
                    subfield.map_err(|source| PipelineError::Scoring { set: None, source })?;
                let subfield = Arc::new(subfield);
                claim.check()?;
                check_kept(simulator, &subfield, &epochs, image)?;
                // Also beside whole images: a table that was lost or edited would make them the images of other galaxies. They take a
                // thousandth of the time of the images.
                write_tables(simulator, &subfield, &folder, &truth)?;
                for iy in (0..grid).filter(|_| !epochs.is_empty()) {
                    let (subfield, epochs) = (Arc::clone(&subfield), Arc::clone(&epochs));
                    if !feeder.push(Row {
                        subfield,
                        epochs,
                        iy,
                    }) {
                        return Ok(());
                    }
                }
            }
            Ok(())
        },
        || (RenderScratch::new(), vec![0.0; size * size]),
        |(scratch, stamp), row: Row| {
            let mut pixels = vec![0.0; row.epochs.len() * side * size];
            for ix in 0..grid {
                let galaxy = simulator.galaxy_at(&row.subfield, (ix, row.iy));
                for (strip, epoch) in pixels.chunks_exact_mut(side * size).zip(&*row.epochs) {
                    simulator.draw(&row.subfield, *epoch, &galaxy, scratch, stamp);
                    for (line, own) in strip.chunks_exact_mut(side).zip(stamp.chunks_exact(size)) {
                        line[ix * size..][..size].copy_from_slice(own);
                    }
                }
            }
            Ok((row, pixels))
        },
        |(row, pixels)| {
            if row.iy == 0 {
                claim.check()?;
                for epoch in &*row.epochs {
                    // Without keys, as in the challenge: participants had to measure the noise.
                    let path = image(row.subfield.number, *epoch);
                    open.push(ImageWriter::create(path, side, side, &[])?);
                }
            }
            for (writer, strip) in open.iter_mut().zip(pixels.chunks_exact(side * size)) {
                writer.write_rows(strip)?;
            }
            progress.advance((row.epochs.len() * grid) as u64);
            if row.iy + 1 == grid {
                open.drain(..).try_for_each(ImageWriter::finish)?;
            }
            Ok(())
        },
    )
    .map_err(|error| claim.explain(error))?;
    claim.check_results((0..subfields).flat_map(images))?;
    Ok(made)
}

// Compares the first galaxy of the epochs that are not `new`.
fn check_kept(
    simulator: &BranchSimulator,
    subfield: &Subfield,
    new: &[usize],
    image: &dyn Fn(usize, usize) -> PathBuf,
) -> Result<(), FileError> {
    let size = simulator.branch.stamp();
    let mut scratch = RenderScratch::new();
    let mut stamp = vec![0.0; size * size];
    let galaxy = simulator.galaxy_at(subfield, (0, 0));
    for epoch in (0..simulator.branch.epochs()).filter(|epoch| !new.contains(epoch)) {
        simulator.draw(subfield, epoch, &galaxy, &mut scratch, &mut stamp);
        let path = image(subfield.number, epoch);
        let mut reader = ImageReader::open(&path)?;
        let rows = reader.read_rows(size)?;
        let found = rows
            .chunks_exact(reader.width())
            .flat_map(|row| &row[..size]);
        // Not `>`, which NaN passes.
        let is_same = |(own, found): (&f32, &f32)| (own - found).abs() <= MAX_REDRAWN_DIFFERENCE;
        if !stamp.iter().zip(found).all(is_same) {
            let message = "the first galaxy is not the one of this seed and these settings";
            return Err(FileError::new(path, message)
                .hint("remove the image, which is then simulated again"));
        }
    }
    Ok(())
}

fn yaml(folder: &Path, stem: String, values: &[(&str, &dyn Display)]) -> Result<(), FileError> {
    let pairs: Vec<String> = values
        .iter()
        .map(|(name, value)| format!("{name}: {value}"))
        .collect();
    // One line in braces, as the challenge's program wrote them.
    let text = format!("{{{}}}\n", pairs.join(", "));
    atomic::write(folder.join(stem + ".yaml"), text.as_bytes())
}

fn write_tables(
    simulator: &BranchSimulator,
    subfield: &Subfield,
    folder: &Path,
    truth: &Path,
) -> Result<(), FileError> {
    let number = subfield.number;
    let (x, y) = subfield.offset_degrees();
    let offset: [(&str, &dyn Display); 2] = [("offset_deg_x", &x), ("offset_deg_y", &y)];
    for of in [folder, truth] {
        yaml(of, file_name(great3::SUBFIELD_OFFSETS, number, 0), &offset)?;
    }
    if let Some(Shear { e1, e2 }) = subfield.constant_shear {
        let stem = file_name(great3::SHEARS, number, 0);
        yaml(truth, stem, &[("g1", &e1), ("g2", &e2)])?;
    }
    for (epoch, own) in subfield.epochs.iter().enumerate() {
        let (x, y) = own.dither;
        let stem = file_name(great3::DITHERS, number, epoch);
        yaml(
            folder,
            stem,
            &[("xdither_pixels", &x), ("ydither_pixels", &y)],
        )?;
        let Shear { e1, e2 } = own.psf_ellipticity();
        let stem = file_name(great3::PSF_SHAPES, number, epoch);
        yaml(truth, stem, &[("psf_g1", &e1), ("psf_g2", &e2)])?;
        let side = STARS_PER_SIDE * simulator.branch.stamp();
        let path = folder.join(file_name(great3::STAR_FIELDS, number, epoch));
        let mut writer = ImageWriter::create(path, side, side, &[])?;
        writer.write_rows(&simulator.stars(subfield, epoch, &mut RenderScratch::new()))?;
        writer.finish()?;
    }
    let (mut places, mut ids) = ([Vec::new(), Vec::new()], Vec::new());
    let mut shears = [const { Vec::new() }; 4];
    for k in 0..simulator.grid * simulator.grid {
        let at = (k % simulator.grid, k / simulator.grid);
        let ([x, y], id) = simulator.place(subfield, at);
        let (g, intrinsic) = simulator.truth(subfield, at);
        places[0].push(x);
        places[1].push(y);
        ids.push(id);
        for (column, value) in shears
            .iter_mut()
            .zip([g.e1, g.e2, intrinsic.e1, intrinsic.e2])
        {
            column.push(value);
        }
    }
    let whole = |name: &str, values: &Vec<i64>| Column::new(name.into(), values);
    let public = vec![
        whole("x", &places[0]),
        whole("y", &places[1]),
        whole("ID", &ids),
    ];
    let names = ["g1", "g2", "g1_intrinsic", "g2_intrinsic"];
    let known = names
        .iter()
        .zip(&shears)
        .map(|(name, values)| Column::new((*name).into(), values));
    let private = public.iter().cloned().chain(known).collect();
    for (of, columns) in [(folder, public), (truth, private)] {
        let path = of.join(file_name(great3::GALAXY_CATALOGUES, number, 0));
        let table = frame(columns).map_err(|error| FileError::new(&path, error))?;
        table::write(&path, FileFormat::Fits, &table, &Metadata::default())?;
    }
    Ok(())
}
