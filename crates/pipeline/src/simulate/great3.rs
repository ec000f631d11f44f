//! A branch like those of GREAT3 as files: data as participants got them, and the truth as it was released.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use shearq_dataset::great3;
use shearq_dataset::layout::fill;
use shearq_dataset::record::claim;
use shearq_dataset::run::SIMULATION_FILE;
use shearq_dataset::threads::Progress;
use shearq_files::fits::ImageWriter;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat, MAX_ROWS};
use shearq_files::{FileError, atomic};
use shearq_quantities::Shear;
use shearq_scoring::great3::STARS_PER_SIDE;
use shearq_simulate::galaxy::Sersic;
use shearq_simulate::great3::{Branch, BranchSimulator, Fit, FitComponent, Subfield};
use shearq_simulate::render::RenderScratch;

use crate::PipelineError;
use crate::engine;

/// What determines all subfields of a simulated branch. Their number does not: more can be added.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    pub version: String,
    pub branch: String,
    pub seed: u64,
    pub grid: usize,
    /// Whether all shears have the opposite sign.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub opposite: bool,
    /// Table of fits to galaxies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub galaxies: Option<PathBuf>,
}

/// Where the truth of a branch is, in a folder that holds its data.
pub fn truth_folder(out: &Path, branch: Branch) -> PathBuf {
    out.join("truth").join(branch.folder())
}

struct Row {
    subfield: Arc<Subfield>,
    epoch: usize,
    iy: usize,
}

/// Simulates subfields from 0 into `out`, and returns the number of new images. Images that are there are kept.
pub fn simulate_branch(
    simulator: &BranchSimulator,
    record: &Record,
    subfields: usize,
    out: &Path,
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<usize, PipelineError> {
    let claim = claim(&out.join(SIMULATION_FILE), record)?;
    let (branch, grid) = (simulator.branch, simulator.grid);
    let folder = out.join(branch.folder());
    let truth = truth_folder(out, branch);
    let epochs = branch.epochs();
    let image = |subfield, epoch| folder.join(named(great3::GALAXIES, subfield, epoch));
    // Other files of a subfield are written first, so that the last image shows that all are there.
    let todo: Vec<usize> = (0..subfields)
        .filter(|&number| !image(number, epochs - 1).is_file())
        .collect();
    let made = todo.len() * epochs;
    let side = grid * branch.stamp();
    let mut open: Option<ImageWriter> = None;
    engine::ordered(
        threads,
        |feeder| {
            for subfield in simulator.subfields(todo.into_iter()) {
                let subfield =
                    subfield.map_err(|source| PipelineError::Scoring { set: None, source })?;
                let subfield = Arc::new(subfield);
                let rows = (0..epochs * grid).map(|k| (k / grid, k % grid));
                for (epoch, iy) in rows {
                    let subfield = Arc::clone(&subfield);
                    if !feeder.push(Row {
                        subfield,
                        epoch,
                        iy,
                    }) {
                        return Ok(());
                    }
                }
            }
            Ok(())
        },
        || {
            (
                RenderScratch::new(),
                vec![0.0; branch.stamp() * branch.stamp()],
            )
        },
        |(scratch, stamp), row: Row| {
            let size = branch.stamp();
            let mut pixels = vec![0.0; side * size];
            for ix in 0..grid {
                simulator.draw(&row.subfield, row.epoch, (ix, row.iy), scratch, stamp);
                for (line, own) in pixels.chunks_exact_mut(side).zip(stamp.chunks_exact(size)) {
                    line[ix * size..][..size].copy_from_slice(own);
                }
            }
            Ok((row, pixels))
        },
        |(row, pixels)| {
            let Row {
                subfield,
                epoch,
                iy,
            } = row;
            if iy == 0 {
                claim.check()?;
                if epoch == 0 {
                    write_tables(simulator, &subfield, &folder, &truth)?;
                }
                write_stars(simulator, &subfield, epoch, &folder)?;
            }
            let writer = match &mut open {
                Some(writer) => writer,
                // Without keys, as in the challenge: participants had to measure the noise.
                None => open.insert(ImageWriter::create(
                    image(subfield.number, epoch),
                    side,
                    side,
                    &[],
                )?),
            };
            writer.write_rows(&pixels)?;
            progress.advance(grid as u64);
            if iy + 1 == grid
                && let Some(image) = open.take()
            {
                image.finish()?;
            }
            Ok(())
        },
    )
    .map_err(|error| claim.explain(error))?;
    claim.check_results((0..subfields).map(|number| image(number, epochs - 1)))?;
    Ok(made)
}

fn named(pattern: &str, subfield: usize, epoch: usize) -> String {
    fill(pattern, subfield as u32, epoch as u32)
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
        yaml(of, named(great3::SUBFIELD_OFFSETS, number, 0), &offset)?;
    }
    if let Some(Shear { e1, e2 }) = subfield.constant_shear {
        let stem = named(great3::SHEARS, number, 0);
        yaml(truth, stem, &[("g1", &e1), ("g2", &e2)])?;
    }
    for (epoch, own) in subfield.epochs.iter().enumerate() {
        let (x, y) = own.dither;
        let stem = named(great3::DITHERS, number, epoch);
        yaml(
            folder,
            stem,
            &[("xdither_pixels", &x), ("ydither_pixels", &y)],
        )?;
        let Shear { e1, e2 } = own.psf_ellipticity();
        let stem = named(great3::PSF_SHAPES, number, epoch);
        yaml(truth, stem, &[("psf_g1", &e1), ("psf_g2", &e2)])?;
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
        let path = of.join(named(great3::GALAXY_CATALOGUES, number, 0));
        let table = frame(columns).map_err(|error| FileError::new(&path, error))?;
        table::write(&path, FileFormat::Fits, &table, &Metadata::default())?;
    }
    Ok(())
}

fn write_stars(
    simulator: &BranchSimulator,
    subfield: &Subfield,
    epoch: usize,
    folder: &Path,
) -> Result<(), FileError> {
    let side = STARS_PER_SIDE * simulator.branch.stamp();
    let path = folder.join(named(great3::STAR_FIELDS, subfield.number, epoch));
    let mut writer = ImageWriter::create(path, side, side, &[])?;
    writer.write_rows(&simulator.stars(subfield, epoch, &mut RenderScratch::new()))?;
    writer.finish()
}

/// Reads fits to galaxies: `n r_e q`, and perhaps `flux bulge_r_e bulge_q bulge_flux` and `snr`.
pub fn read_fits(path: &Path) -> Result<Vec<Fit>, FileError> {
    let read = table::read(path, None, MAX_ROWS)?;
    let required = |name| table::numbers(&read, name, path).map(|values| values.to_vec());
    let optional = |name| match has(&read, name) {
        true => required(name).map(Some),
        false => Ok(None),
    };
    let [n, radius, ratio] = [required("n")?, required("r_e")?, required("q")?];
    let flux = optional("flux")?;
    let snr = optional("snr")?;
    let bulge = match has(&read, "bulge_flux") {
        true => Some([
            required("bulge_r_e")?,
            required("bulge_q")?,
            required("bulge_flux")?,
        ]),
        false => None,
    };
    let component = |profile, radius: f64, ratio: f64, flux| FitComponent {
        profile,
        half_light_arcsec: radius * ratio.sqrt(),
        flux,
        axis_ratio: ratio,
    };
    // A flux of zero has no S/N to scale it by, and a number that is missing has no nearest profile.
    let mut positive = vec![("n", &n)];
    positive.extend(flux.as_ref().map(|flux| ("flux", flux)));
    for (name, values) in positive {
        let wrong = |value: &f64| !(value.is_finite() && *value > 0.0);
        if let Some(row) = values.iter().position(wrong) {
            let (row, found) = (row + 1, values[row]);
            let message = format!("row {row}: {name} is {found}, expected a positive number");
            return Err(FileError::new(path, message));
        }
    }
    let fits: Vec<Fit> = (0..n.len())
        .map(|k| {
            let main = Sersic::nearest(n[k]);
            let bulge = bulge
                .as_ref()
                .map(|of| of.each_ref().map(|column| column[k]));
            let bulge = bulge.filter(|[_, _, flux]| *flux > 0.0);
            Fit {
                main: component(
                    main,
                    radius[k],
                    ratio[k],
                    flux.as_ref().map_or(1.0, |flux| flux[k]),
                ),
                bulge: bulge.map(|[radius, ratio, flux]| {
                    component(Sersic::DeVaucouleurs, radius, ratio, flux)
                }),
                snr: snr.as_ref().map(|snr| snr[k]),
            }
        })
        .collect();
    for (k, fit) in fits.iter().enumerate() {
        let ratios = [Some(fit.main), fit.bulge]
            .into_iter()
            .flatten()
            .map(|own| own.axis_ratio);
        if let Some(found) = ratios
            .into_iter()
            .find(|ratio| !(0.0..=1.0).contains(ratio) || *ratio == 0.0)
        {
            let message = format!(
                "row {}: the axis ratio is {found}, expected above 0 and up to 1",
                k + 1
            );
            return Err(FileError::new(path, message));
        }
        if let Some(found) = fit.snr.filter(|snr| !(snr.is_finite() && *snr > 0.0)) {
            let message = format!("row {}: snr is {found}, expected a positive number", k + 1);
            return Err(FileError::new(path, message));
        }
    }
    if fits.is_empty() {
        return Err(FileError::new(
            path,
            "there is no galaxy; expected a row for each fit",
        ));
    }
    Ok(fits)
}

fn has(table: &DataFrame, name: &str) -> bool {
    table.column(name).is_ok()
}
