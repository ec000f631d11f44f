//! GREAT3 (Mandelbaum et al. 2014, ApJS 212, 5; results: 2015, MNRAS 450, 2963): branches, identities of galaxies, truth as
//! released, pre-submission and leaderboard.

mod pack;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use shearq_dataset::great3::{self as released, Parameters, file_name};
use shearq_dataset::threads::Pool;
use shearq_files::open::is_there;
use shearq_files::{FileError, table};
use shearq_quantities::Shear;
use shearq_quantities::statistics::RunningMean;
use shearq_render::figure::{LinePlot, Series, Style};
use shearq_scoring::aperture::{Lattice, LatticeShear, SEPARATION_BINS, separations};
use shearq_scoring::great3::{
    Bias, Branch, ConstantField, Identity, NODES_PER_GALAXY, PlusCross, Q_V_BINS, REQUIRED_C,
    REQUIRED_M, SUBFIELDS, SUBFIELDS_PER_FIELD, along, constant_score, position_angle,
    variable_score,
};
use shearq_scoring::{Line, Repeated, repeated};

use self::pack::Galaxies;
use super::{
    Columns, Entry, Figure, MIN_SHEAR_SLOPE, Presubmission, Presubmitting, PublicBranch, Score,
    Slope, Truth, disagreement, odd_fields, whole, wrong,
};

// A component from here on was not measured: averages leave out 9.9 and more, correlations 10 and more. Both as in the challenge.
const NOT_AVERAGED: f64 = 9.9;
const NOT_CORRELATED: f64 = 10.0;

/// A branch of GREAT3.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Great3(pub Branch);

// Q_c needs shears to 2·10⁻⁴: below, values count as equal. Aperture masses of shear alone are below 10⁻⁹ at the largest separations.
const EQUAL_SHEARS: f64 = 1e-4;
const EQUAL_MASSES: f64 = 1e-14;

// Refuses placeholders of fields that were not measured. A program that writes them would gain: Q_v of zeros is high.
fn refuse_repeated<const N: usize>(
    path: &Path,
    rows: &[[f64; N]],
    step: f64,
    name: impl Fn(Option<usize>) -> &'static str,
) -> Result<(), FileError> {
    if let Some(field) = rows
        .iter()
        .position(|row| row.iter().all(|own| *own == 0.0))
    {
        return wrong(path, zero(field, name(None)));
    }
    let Some(found) = repeated(rows, step) else {
        return Ok(());
    };
    let Repeated { rows, of, .. } = found;
    let (name, field) = (name(found.component), found.first);
    let message = format!(
        "{rows} of {of} fields have repeated values of {name}, the first of them field {field}; expected measured values, which do not repeat"
    );
    wrong(path, message)
}

fn zero(field: usize, name: &str) -> String {
    format!("field {field}: {name} is exactly zero, which no measurement gives")
}

fn not_an_identity(row: usize, found: f64) -> String {
    format!(
        "row {}: not the identity of a galaxy (found {found}, expected SSSXXXYYY, such as 012034056)",
        row + 1
    )
}

fn more(count: usize) -> String {
    match count {
        1 => String::new(),
        _ => format!(" and {} more", count - 1),
    }
}

const SHEARS: Columns<'static> = Columns {
    // Also as the challenge's program calls them.
    names: &[
        &["index", "field", "subfield_index", "field_index"],
        &["g1"],
        &["g2"],
    ],
    required: 3,
    unnamed: &[(3, &[0, 1, 2])],
};

const MASSES: Columns<'static> = Columns {
    names: &[
        &["field", "index", "field_index"],
        &["theta", "theta[deg]"],
        &["map_E"],
        &["map_B"],
        &["error"],
    ],
    required: 5,
    unnamed: &[(5, &[0, 1, 2, 3, 4])],
};

impl Great3 {
    // Fields of a branch of so many subfields, which is the whole branch unless the user states another number.
    fn fields(&self, subfields: Option<usize>) -> Result<usize, FileError> {
        let (found, per) = (subfields.unwrap_or(SUBFIELDS), self.0.subfields_per_field());
        match found > 0 && found % per == 0 {
            true => Ok(found / per),
            false => {
                let message = format!("found {found}, expected a multiple of {per} for {}", self.0);
                wrong(Path::new("--subfields"), message)
            }
        }
    }

    // The folder that holds `stem` of subfield 0: the given one, or that of the branch below it.
    fn folder(&self, root: &Path, stem: &str) -> Result<PathBuf, FileError> {
        let below = root.join(self.0.folder());
        let folders = [root.to_owned(), below];
        let found = folders.iter().find(|folder| {
            let is = |ending: &&str| is_there(&folder.join(format!("{stem}.{ending}")));
            ["yaml", "txt", "fits"].iter().any(is)
        });
        found.cloned().ok_or_else(|| {
            let message = format!(
                "found no {stem}.yaml, .txt or .fits, here or in {}",
                folders[1].display()
            );
            FileError::new(root, message)
        })
    }

    fn true_shears(&self, truth: &Path, fields: usize) -> Result<Vec<Shear>, FileError> {
        if !truth.is_dir() {
            return self.read_shears(truth, fields);
        }
        let folder = self.folder(truth, &file_name(released::SHEARS, 0, 0))?;
        let per = self.0.subfields_per_field();
        let shear = |subfield: usize| {
            let stem = file_name(released::SHEARS, subfield, 0);
            match Parameters::read(&folder, &stem)? {
                Some(found) => shear_of(&found),
                None => wrong(&folder, missing(&stem, fields * per)),
            }
        };
        refuse_more(&folder, released::SHEARS, fields * per)?;
        let of_field = |field: usize| {
            let first = field * per;
            let g = shear(first)?;
            for subfield in first + 1..first + per {
                let other = shear(subfield)?;
                if (other.e1 - g.e1).hypot(other.e2 - g.e2) > EQUAL_SHEARS {
                    let message = format!(
                        "subfields {first} and {subfield} of field {field} have different shears (found {} {} and {} {}, expected one)",
                        g.e1, g.e2, other.e1, other.e2
                    );
                    return wrong(&folder, message);
                }
            }
            Ok(g)
        };
        (0..fields).map(of_field).collect()
    }

    // Mean ellipticities of the PSF of each of `fields`.
    fn psfs(&self, truth: Truth<'_>, fields: usize) -> Result<Vec<Shear>, FileError> {
        let (subfields, epochs) = (fields * self.0.subfields_per_field(), self.0.epochs());
        let source = truth.psf.unwrap_or(truth.path);
        if truth.psf.is_none() && !source.is_dir() {
            return wrong(source, "Q_c needs the PSF. Try: --psf FILE");
        }
        let known = match source.is_dir() {
            true => self.psfs_of_folder(source, subfields)?,
            false => self.psfs_of_table(source, subfields)?,
        };
        // A subfield without a known PSF counts as round, as in the challenge.
        let mean = |shears: &[Shear]| match shears.len() {
            0 => Shear::ZERO,
            n => {
                let mean = |of: fn(&Shear) -> f64| shears.iter().map(of).sum::<f64>() / n as f64;
                Shear::new(mean(|g| g.e1), mean(|g| g.e2))
            }
        };
        let subfields: Vec<Shear> = known
            .chunks(epochs)
            .map(|epochs| mean(&epochs.iter().copied().flatten().collect::<Vec<_>>()))
            .collect();
        Ok(subfields
            .chunks(self.0.subfields_per_field())
            .map(mean)
            .collect())
    }

    // The PSF of each epoch of each subfield; `None` if it is not known.
    fn psfs_of_folder(
        &self,
        folder: &Path,
        subfields: usize,
    ) -> Result<Vec<Option<Shear>>, FileError> {
        let folder = self.folder(folder, &file_name(released::PSF_SHAPES, 0, 0))?;
        let epochs = self.0.epochs();
        refuse_more(&folder, released::PSF_SHAPES, subfields)?;
        let psf = |k: usize| {
            let stem = file_name(released::PSF_SHAPES, k / epochs, k % epochs);
            match Parameters::read(&folder, &stem)? {
                Some(found) => psf_of(&found),
                None => {
                    let of = format!("{subfields} subfields with {epochs} epochs each");
                    wrong(
                        &folder,
                        format!("found no {stem}.yaml or .txt; expected {of}"),
                    )
                }
            }
        };
        let found: Result<Vec<_>, _> = (0..subfields * epochs).map(psf).collect();
        let extra = file_name(released::PSF_SHAPES, 0, epochs);
        match Parameters::read(&folder, &extra)? {
            Some(extra) => {
                let message = format!(
                    "{} has no such epoch (expected {epochs} per subfield)",
                    self.0
                );
                wrong(&extra.path, message)
            }
            None => found,
        }
    }

    fn psfs_of_table(
        &self,
        path: &Path,
        subfields: usize,
    ) -> Result<Vec<Option<Shear>>, FileError> {
        let epochs = self.0.epochs();
        let columns = Columns {
            names: &[&["subfield"], &["epoch"], &["psf_g1"], &["psf_g2"]],
            required: 4,
            unnamed: &[(4, &[0, 1, 2, 3])],
        }
        .read(path)?;
        let mut found = vec![None; subfields * epochs];
        let rows = columns[0].iter().zip(&columns[1]);
        let psfs = columns[2].iter().zip(&columns[3]);
        for (k, ((subfield, epoch), (e1, e2))) in rows.zip(psfs).enumerate() {
            let fault = |message: String| FileError::new(path, format!("row {}: {message}", k + 1));
            let number = |found: f64, end: usize, name: &str| {
                let last = end - 1;
                let message = || {
                    format!(
                        "no {name} of {} (found {found}, expected 0 to {last})",
                        self.0
                    )
                };
                whole(found, end).ok_or_else(|| fault(message()))
            };
            let subfield = number(*subfield, subfields, "subfield")?;
            let epoch = number(*epoch, epochs, "epoch")?;
            let psf = known_psf(Shear::new(*e1, *e2)).map_err(fault)?;
            if found[subfield * epochs + epoch].replace(psf).is_some() {
                return Err(fault(format!(
                    "subfield {subfield} epoch {epoch} is there twice; expected each once"
                )));
            }
        }
        if let Some(k) = found.iter().position(Option::is_none) {
            let message = format!(
                "subfield {} has no PSF of epoch {}; expected {subfields} subfields with {epochs} epochs each",
                k / epochs,
                k % epochs
            );
            return wrong(path, message);
        }
        Ok(found.into_iter().flatten().collect())
    }

    // `index g1 g2`, a row for each field.
    fn read_shears(&self, path: &Path, expected: usize) -> Result<Vec<Shear>, FileError> {
        let columns = SHEARS.read(path)?;
        let mut found = vec![None; expected];
        for (k, &number) in columns[0].iter().enumerate() {
            let field = field_of(path, k, number, expected)?;
            for (name, column) in [("g1", &columns[1]), ("g2", &columns[2])] {
                let found = column[k];
                if found.is_nan() || found.abs() >= 1.0 {
                    let message =
                        format!("field {field}: {name} is {found}, expected a shear below 1");
                    return wrong(path, message);
                }
            }
            let g = Shear::new(columns[1][k], columns[2][k]);
            if found[field].replace(g).is_some() {
                let message = format!("field {field} is there twice; expected each once");
                return wrong(path, message);
            }
        }
        complete(path, found)
    }

    fn submitted_shears(&self, path: &Path, fields: usize) -> Result<Vec<Shear>, FileError> {
        let shears = self.read_shears(path, fields)?;
        let rows: Vec<_> = shears.iter().map(|g| [g.e1, g.e2]).collect();
        let name =
            |component: Option<usize>| ["(g1, g2)", "g1", "g2"][component.map_or(0, |k| k + 1)];
        refuse_repeated(path, &rows, EQUAL_SHEARS, name)?;
        Ok(shears)
    }

    // `field theta map_E map_B error`, a row for each field and bin.
    fn read_masses(&self, path: &Path, expected: usize) -> Result<Vec<Masses>, FileError> {
        let columns = MASSES.read(path)?;
        let mut found = vec![None::<[Option<[f64; 2]>; SEPARATION_BINS]>; expected];
        for (k, &number) in columns[0].iter().enumerate() {
            let field = field_of(path, k, number, expected)?;
            let theta = columns[1][k];
            // As the challenge compares them: equal to 3 decimals.
            let is = |centre: f64| (centre - theta).abs() < 1.5e-3;
            let Some(bin) = separations().iter().position(|centre| is(centre.0)) else {
                let [first, last] = [0, SEPARATION_BINS - 1].map(|bin| separations()[bin].0);
                let message = format!(
                    "field {field}: theta is {theta}, expected one of the {SEPARATION_BINS} centres {first:.4} to {last:.4} degrees to 3 decimals. Try: shearq pack --challenge great3"
                );
                return wrong(path, message);
            };
            for (name, column) in [("map_E", 2), ("map_B", 3), ("error", 4)] {
                let found = columns[column][k];
                let least = if name == "error" { 0.0 } else { -1.0 };
                // Dispersions of shears below 1.
                if !(least..1.0).contains(&found) {
                    let expected = if name == "error" { "0 to 1" } else { "-1 to 1" };
                    let message = format!("field {field}: {name} is {found}, expected {expected}");
                    return wrong(path, message);
                }
            }
            let own = found[field].get_or_insert_default();
            if own[bin].replace([columns[2][k], columns[3][k]]).is_some() {
                let theta = separations()[bin].0;
                let message =
                    format!("field {field}: theta = {theta:.4} is there twice; expected each once");
                return wrong(path, message);
            }
        }
        let mut masses = Vec::new();
        for (field, own) in complete(path, found)?.into_iter().enumerate() {
            if let Some(bin) = own.iter().position(Option::is_none) {
                let theta = separations()[bin].0;
                let message = format!(
                    "field {field}: theta = {theta:.4} is missing; expected {SEPARATION_BINS} rows per field"
                );
                return wrong(path, message);
            }
            let own = own.map(Option::unwrap_or_default);
            masses.push(Masses {
                e: own.map(|[e, _]| e),
                b: own.map(|[_, b]| b),
            });
        }
        Ok(masses)
    }

    fn submitted_masses(&self, path: &Path, fields: usize) -> Result<Vec<Masses>, FileError> {
        let masses = self.read_masses(path, fields)?;
        let rows: Vec<_> = masses.iter().map(|own| own.e).collect();
        refuse_repeated(path, &rows, EQUAL_MASSES, |_| "map_E")?;
        Ok(masses)
    }

    fn true_masses(
        &self,
        truth: &Path,
        fields: usize,
        pool: &Pool,
    ) -> Result<Vec<Masses>, FileError> {
        if !truth.is_dir() {
            return self.read_masses(truth, fields);
        }
        let folder = self.folder(
            truth,
            &stem_of(&file_name(released::GALAXY_CATALOGUES, 0, 0)),
        )?;
        let catalogue =
            |subfield: usize| folder.join(file_name(released::GALAXY_CATALOGUES, subfield, 0));
        let subfields = fields * SUBFIELDS_PER_FIELD;
        if let Some(lacking) = (0..subfields).find(|k| !is_there(&catalogue(*k))) {
            return wrong(
                &folder,
                missing(
                    &stem_of(&file_name(released::GALAXY_CATALOGUES, lacking, 0)),
                    subfields,
                ),
            );
        }
        if is_there(&catalogue(subfields)) {
            return wrong(&catalogue(subfields), more_subfields(subfields));
        }
        let fields = (0..subfields).step_by(SUBFIELDS_PER_FIELD);
        let masses = pool.in_order(fields, |first| {
            let mut galaxies = lattice()?;
            for subfield in first..first + SUBFIELDS_PER_FIELD {
                add_truth(&mut galaxies, &folder, &catalogue(subfield), subfield)?;
            }
            let found = galaxies.correlations().aperture_mass();
            Ok(Masses {
                e: found.map_e,
                b: found.map_b,
            })
        });
        masses.collect()
    }
}

// The error of each field's shear against the true shear, along the PSF and at 45° to it, with the fit (c, m) and the requirement.
fn residual_plots(fields: &[ConstantField], biases: [(Bias, Bias); 2]) -> Vec<LinePlot> {
    let plots = [("₊", true), ("×", false)].into_iter().zip(biases);
    let plots = plots.map(|((name, is_plus), (c, m))| {
        let of = |g: Shear, field: &ConstantField| {
            let PlusCross { plus, cross } = along(g, position_angle(field.psf));
            if is_plus { plus } else { cross }
        };
        let x: Vec<f64> = fields.iter().map(|own| of(own.truth, own)).collect();
        let submitted = fields.iter().map(|own| of(own.submitted, own));
        let y = submitted
            .zip(&x)
            .map(|(g, truth)| 1e3 * (g - truth))
            .collect();
        let most = x.iter().fold(0.0_f64, |most, g| most.max(g.abs()));
        let ends = vec![-most, 0.0, most];
        let line = |name: &str, c: f64, m: f64, size: &dyn Fn(f64) -> f64, style| {
            let y = ends.iter().map(|g| 1e3 * (c + m * size(*g))).collect();
            Series::new(name, ends.clone(), y, style, 7)
        };
        LinePlot {
            title: format!(
                "m{name} = ({:.1} ± {:.1})·10⁻³, c{name} = ({:.1} ± {:.1})·10⁻⁴",
                1e3 * m.value,
                1e3 * m.error,
                1e4 * c.value,
                1e4 * c.error
            ),
            x_label: format!("true g{name}"),
            y_label: format!("g{name} − true g{name}, 10⁻³"),
            series: vec![
                Series::new("fields", x, y, Style::Points, 0),
                line("c + m g", c.value, m.value, &|g| g, Style::Line),
                line(
                    "requirement",
                    REQUIRED_C,
                    REQUIRED_M,
                    &f64::abs,
                    Style::Dashed,
                ),
                line("", -REQUIRED_C, -REQUIRED_M, &f64::abs, Style::Dashed),
            ],
            ..LinePlot::default()
        }
    });
    plots.collect()
}

// ⟨M_ap²⟩ of the submission and of the truth, means over fields with the error by their scatter.
fn mass_plot(truth: &[[f64; SEPARATION_BINS]], submitted: &[[f64; SEPARATION_BINS]]) -> LinePlot {
    let theta: Vec<f64> = separations().iter().map(|centre| centre.0).collect();
    let mean = |fields: &[[f64; SEPARATION_BINS]], b: usize| {
        let mut mean = RunningMean::default();
        fields.iter().for_each(|own| mean.add(1e6 * own[b]));
        mean
    };
    let means = |fields| (0..SEPARATION_BINS).map(move |b| mean(fields, b));
    let error = |own: RunningMean| own.deviation() / (own.count() as f64).sqrt();
    let values = |fields| means(fields).map(|own| own.mean()).collect();
    LinePlot {
        title: "Aperture mass dispersion".into(),
        x_label: "θ, degrees".into(),
        y_label: "⟨M_ap²⟩, 10⁻⁶".into(),
        x_log: true,
        series: vec![
            Series::new("true", theta.clone(), values(truth), Style::Line, 2),
            Series::new("submitted", theta, values(submitted), Style::Points, 5)
                .with_errors(means(submitted).map(error).collect()),
        ],
        ..LinePlot::default()
    }
}

// Why aperture masses are not of the true shear. ⟨M_ap²⟩ follows from ξ₊ and ξ₋; a flipped or exchanged component leaves ξ₊ and
// averages ξ₋ to zero, so that E and B are both the mean of the true E and B.
fn disagreement_of_masses(submitted: &[Masses], truth: &[Masses], path: &Path) -> Option<String> {
    let e: Vec<(f64, f64)> = submitted
        .iter()
        .zip(truth)
        .flat_map(|(own, truth)| truth.e.into_iter().zip(own.e))
        .collect();
    let Some(found) = Slope::of(&e) else {
        return Some(format!(
            "whether map_E follows the true one cannot be determined, because that of {} is the same at all separations",
            path.display()
        ));
    };
    // Of a square of shears.
    if !found.is_clear(MIN_SHEAR_SLOPE * MIN_SHEAR_SLOPE) {
        return Some(format!(
            "map_E does not follow the true one (found a slope of {found}, expected about 1): it contains no measurable shear"
        ));
    }
    // Of sums over fields, as in Q_v: ξ₋ of one field is not zero by chance.
    let sum = |of: &dyn Fn(&Masses) -> f64, masses: &[Masses]| masses.iter().map(of).sum::<f64>();
    let (mut as_given, mut averaged) = (0.0, 0.0);
    for bin in 0..SEPARATION_BINS {
        let both = |masses| {
            [
                sum(&|own| own.e[bin], masses),
                sum(&|own| own.b[bin], masses),
            ]
        };
        let ([e, b], [true_e, true_b]) = (both(submitted), both(truth));
        let mean = 0.5 * (true_e + true_b);
        as_given += (e - true_e).powi(2) + (b - true_b).powi(2);
        averaged += (e - mean).powi(2) + (b - mean).powi(2);
    }
    // Chosen by hand: map_B of zero, as of a program that does not compute it, reaches one half.
    (averaged < 0.25 * as_given).then(|| {
        "map_E and map_B are both the mean of the true E and B: the sign of g1 or g2, or their order, is probably wrong".into()
    })
}

// Standard errors by which the correlation with the true differences between fields must exceed chance.
const MIN_ORDER_SIGNIFICANCE: f64 = 3.0;

// A warning about fields that are not clearly in the order of the truth. Q_v does not depend on it, but its jackknife does, and
// exchanged fields are a fault of a catalogue, such as galaxies with the identities of another subfield.
fn doubt_of_order(submitted: &[Masses], truth: &[Masses]) -> Option<String> {
    // The sum over separations, which noise affects least.
    let sum = |masses: &Masses| masses.e[Q_V_BINS].iter().sum::<f64>();
    let each = submitted.iter().zip(truth);
    let pairs: Vec<_> = each.map(|(own, truth)| (sum(truth), sum(own))).collect();
    let (count, correlation) = (pairs.len() as f64, Line::through(&pairs).correlation());
    // Fisher's transform of a correlation has the variance 1/(N − 3).
    let significance = correlation.atanh() * (count - 3.0).max(0.0).sqrt();
    if pairs.len() < 2 || significance >= MIN_ORDER_SIGNIFICANCE {
        return odd_fields(&[pairs]);
    }
    Some(format!(
        "whether the fields are in the order of the truth cannot be determined (found a correlation of {correlation:.2} of map_E of {count} fields, which is {:.1}σ above zero, expected {MIN_ORDER_SIGNIFICANCE}σ): they may be exchanged, or their noise is large",
        if significance.is_nan() {
            0.0
        } else {
            significance
        }
    ))
}

// ⟨M_ap²⟩ of a field by separation.
struct Masses {
    e: [f64; SEPARATION_BINS],
    b: [f64; SEPARATION_BINS],
}

fn stem_of(name: &str) -> String {
    name.trim_end_matches(".fits").to_owned()
}

fn missing(stem: &str, subfields: usize) -> String {
    format!(
        "found no {stem}.*, expected {subfields} subfields. Try: --subfields N if the branch was simulated with fewer"
    )
}

fn more_subfields(subfields: usize) -> String {
    format!(
        "expected {subfields} subfields. Try: --subfields N if the branch was simulated with more"
    )
}

// Refuses files of a subfield after the last: a part of the branch would be scored as the whole.
fn refuse_more(folder: &Path, pattern: &str, subfields: usize) -> Result<(), FileError> {
    match Parameters::read(folder, &file_name(pattern, subfields, 0))? {
        Some(more) => wrong(&more.path, more_subfields(subfields)),
        None => Ok(()),
    }
}

// The ellipticity of a PSF; `None` if it is not known, which files state by −10.
fn known_psf(psf: Shear) -> Result<Option<Shear>, String> {
    match psf {
        Shear { e1, e2 } if e1 <= -NOT_CORRELATED || e2 <= -NOT_CORRELATED => Ok(None),
        psf if psf.modulus() < 1.0 => Ok(Some(psf)),
        Shear { e1, e2 } => Err(format!(
            "not the ellipticity of a PSF (found {e1} {e2}, expected a modulus below 1, or -10 if it is not known)"
        )),
    }
}

fn field_of(path: &Path, k: usize, found: f64, fields: usize) -> Result<usize, FileError> {
    let (row, last) = (k + 1, fields - 1);
    whole(found, fields).ok_or_else(|| {
        let message =
            format!("row {row}: not the number of a field (found {found}, expected 0 to {last})");
        FileError::new(path, message)
    })
}

fn complete<T>(path: &Path, found: Vec<Option<T>>) -> Result<Vec<T>, FileError> {
    let expected = found.len();
    let missing = found.iter().position(Option::is_none);
    let there: Vec<T> = found.into_iter().flatten().collect();
    let Some(field) = missing else {
        return Ok(there);
    };
    let found = there.len();
    let more = more(expected - found);
    let message =
        format!("field {field} is missing{more} (found {found} fields, expected {expected})");
    wrong(path, message)
}

fn lattice() -> Result<LatticeShear, FileError> {
    LatticeShear::new(Lattice::GREAT3).map_err(|error| FileError::new("GREAT3", error))
}

// Adds the galaxies of a subfield with their intrinsic ellipticities, sheared: ⟨M_ap²⟩ of the shear alone would not have their
// noise, which the submission has.
fn add_truth(
    galaxies: &mut LatticeShear,
    folder: &Path,
    path: &Path,
    subfield: usize,
) -> Result<(), FileError> {
    const WANTED: [&str; 5] = ["ID", "g1", "g2", "g1_intrinsic", "g2_intrinsic"];
    let read = table::read(path, Some(&WANTED), table::MAX_ROWS)?;
    let mut columns = Vec::new();
    for name in WANTED {
        columns.push(table::numbers(&read, name, path)?);
    }
    // Files of offsets are optional, as identities contain them.
    let offset =
        match Parameters::read(folder, &file_name(released::SUBFIELD_OFFSETS, subfield, 0))? {
            None => None,
            Some(found) => Some([found.number("offset_deg_x")?, found.number("offset_deg_y")?]),
        };
    let side = columns[0].len().isqrt();
    if side == 0 || side * side != columns[0].len() {
        let message = format!(
            "found {} galaxies, expected those of a square grid: the table is incomplete",
            columns[0].len()
        );
        return wrong(path, message);
    }
    let is_constant = |column: &[f64]| side > 1 && column.iter().all(|g| *g == column[0]);
    if is_constant(&columns[1]) && is_constant(&columns[2]) {
        let message = format!(
            "all galaxies have the true shear {} {}, expected one that varies. Try: --branch with constant shear",
            columns[1][0], columns[2][0]
        );
        return wrong(path, message);
    }
    let mut seen = BTreeSet::new();
    for (k, &found) in columns[0].iter().enumerate() {
        let id = Identity::of_number(found).filter(|id| id.subfield() == subfield);
        let Some(id) = id else {
            return wrong(path, not_an_identity(k, found));
        };
        if !seen.insert(id) {
            return wrong(
                path,
                format!("galaxy {id} is there twice; expected each once"),
            );
        }
        let (x, y) = id.place();
        // Without repetition, all places of the grid have their galaxy.
        if x.max(y) >= side * NODES_PER_GALAXY {
            let message = format!(
                "galaxy {id} is outside of the grid of {side} × {side} galaxies: others are missing"
            );
            return wrong(path, message);
        }
        if let Some(degrees) = offset {
            let nodes = degrees.map(|offset| {
                (offset * Lattice::GREAT3.side as f64 / Lattice::GREAT3.field.0).round() as usize
            });
            if [x % NODES_PER_GALAXY, y % NODES_PER_GALAXY] != nodes {
                let message = format!(
                    "galaxy {id} disagrees with subfield_offset-{subfield:03} (found the offset {} and {} nodes, expected {} and {})",
                    x % NODES_PER_GALAXY,
                    y % NODES_PER_GALAXY,
                    nodes[0],
                    nodes[1]
                );
                return wrong(path, message);
            }
        }
        let shear = |first: usize| below_one(Shear::new(columns[first][k], columns[first + 1][k]));
        let fault = |message: String| FileError::new(path, format!("galaxy {id}: {message}"));
        let intrinsic = shear(3).map_err(fault)?;
        let g = intrinsic.sheared_by(shear(1).map_err(fault)?);
        galaxies
            .add((x, y), g, 1.0)
            .map_err(|error| FileError::new(path, format!("galaxy {id}: {error}")))?;
    }
    Ok(())
}

fn shear_of(found: &Parameters) -> Result<Shear, FileError> {
    let shear = Shear::new(found.number("g1")?, found.number("g2")?);
    below_one(shear).map_err(|message| FileError::new(&found.path, message))
}

fn psf_of(found: &Parameters) -> Result<Option<Shear>, FileError> {
    let psf = Shear::new(found.number("psf_g1")?, found.number("psf_g2")?);
    known_psf(psf).map_err(|message| FileError::new(&found.path, message))
}

fn below_one(g: Shear) -> Result<Shear, String> {
    match g.modulus() < 1.0 {
        true => Ok(g),
        false => Err(format!(
            "not a shear (found {} {}, expected |g| < 1)",
            g.e1, g.e2
        )),
    }
}

impl Great3 {
    fn scored(
        &self,
        figures: Vec<Figure>,
        plots: Vec<LinePlot>,
        refusal: Option<String>,
        doubt: Option<String>,
    ) -> Score {
        Score {
            branch: Some(self.0.to_string()),
            figures,
            plots,
            refusal,
            warnings: doubt.into_iter().collect(),
        }
    }

    // Q_c of mean shears of fields.
    fn score_constant(&self, truth: Truth<'_>, submission: &Path) -> Result<Score, FileError> {
        let fields = self.fields(truth.subfields)?;
        let shears = self.true_shears(truth.path, fields)?;
        let psfs = self.psfs(truth, fields)?;
        let submitted = self.submitted_shears(submission, fields)?;
        let pairs: Vec<_> = shears
            .iter()
            .copied()
            .zip(submitted.iter().copied())
            .collect();
        let refusal = disagreement(&pairs, truth.path);
        let component = |of: fn(Shear) -> f64| pairs.iter().map(move |(g, own)| (of(*g), of(*own)));
        let components = [component(|g| g.e1), component(|g| g.e2)];
        let doubt = odd_fields(&components.map(Iterator::collect));
        let fields = shears.iter().zip(&submitted).zip(&psfs);
        let fields: Vec<ConstantField> = fields
            .map(|((&truth, &submitted), &psf)| ConstantField {
                truth,
                submitted,
                psf,
            })
            .collect();
        let found = constant_score(&fields, self.0.observation)
            .map_err(|error| FileError::new(submission, error))?;
        let plots = residual_plots(
            &fields,
            [(found.c.plus, found.m.plus), (found.c.cross, found.m.cross)],
        );
        let mut figures = vec![Figure {
            key: "Q_c",
            value: found.q,
            error: None,
            jackknife: found.jackknife,
            perfect: Some(self.0.observation.q_c([[0.0; 2]; 2])),
            requirement: None,
            decimals: 1,
        }];
        for (key, bias, requirement) in [
            ("c_plus", found.c.plus, REQUIRED_C),
            ("m_plus", found.m.plus, REQUIRED_M),
            ("c_cross", found.c.cross, REQUIRED_C),
            ("m_cross", found.m.cross, REQUIRED_M),
        ] {
            figures.push(Figure {
                key,
                value: bias.value,
                error: Some(bias.error),
                jackknife: bias.jackknife,
                perfect: None,
                requirement: Some(requirement),
                decimals: 6,
            });
        }
        Ok(self.scored(figures, plots, refusal, doubt))
    }

    // Q_v of aperture masses of fields.
    fn score_variable(
        &self,
        truth: Truth<'_>,
        submission: &Path,
        pool: &Pool,
    ) -> Result<Score, FileError> {
        let of_submission = |error| FileError::new(submission, error);
        let fields = self.fields(truth.subfields)?;
        if let Some(psf) = truth.psf {
            return wrong(
                psf,
                format!(
                    "--psf: Q_v of {} has no use for the PSF. Try: without --psf",
                    self.0
                ),
            );
        }
        let masses = self.true_masses(truth.path, fields, pool)?;
        let submitted = self.submitted_masses(submission, fields)?;
        let refusal = disagreement_of_masses(&submitted, &masses, truth.path);
        let doubt = doubt_of_order(&submitted, &masses);
        let e = |masses: &[Masses]| masses.iter().map(|own| own.e).collect::<Vec<_>>();
        let true_e = e(&masses);
        let score = |submitted: &[_]| variable_score(submitted, &true_e, self.0.observation);
        let found = score(&e(&submitted)).map_err(of_submission)?;
        let perfect = score(&true_e).map_err(of_submission)?;
        let plots = vec![mass_plot(&true_e, &e(&submitted))];
        let figures = vec![Figure {
            key: "Q_v",
            value: found.q,
            error: None,
            jackknife: found.jackknife,
            perfect: Some(perfect.q),
            requirement: None,
            decimals: 1,
        }];
        Ok(self.scored(figures, plots, refusal, doubt))
    }
}

impl PublicBranch for Great3 {
    fn title(&self) -> String {
        format!("GREAT3 {}", self.0)
    }

    fn score(&self, truth: Truth<'_>, submission: &Path, pool: &Pool) -> Result<Score, FileError> {
        match self.0.constant {
            true => self.score_constant(truth, submission),
            false => self.score_variable(truth, submission, pool),
        }
    }

    fn check(&self, submission: &Path, subfields: Option<usize>) -> Result<(), FileError> {
        let fields = self.fields(subfields)?;
        match self.0.constant {
            true => self.submitted_shears(submission, fields).map(|_| ()),
            false => self.submitted_masses(submission, fields).map(|_| ()),
        }
    }

    fn pack(
        &self,
        packing: &Presubmitting<'_>,
        pool: &Pool,
    ) -> Option<Result<Presubmission, FileError>> {
        let read = Galaxies::read(self.0, packing);
        Some(read.and_then(|galaxies| galaxies.summarise(packing, pool)))
    }

    fn leaderboard(&self) -> Vec<Entry> {
        let branch = self.0.to_string();
        let entries = LEADERBOARD.lines().filter_map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            let [board, team, method, numbers @ ..] = fields.as_slice() else {
                return None;
            };
            let number = |k: usize| numbers[k].parse().unwrap_or(f64::NAN);
            (*board == branch).then(|| Entry {
                team: (*team).to_owned(),
                method: (*method).to_owned(),
                q: number(0),
                biases: [1, 2, 3, 4].map(number),
            })
        });
        entries.collect()
    }

    fn leaderboard_source(&self) -> Option<&'static str> {
        Some(
            "Source: public leaderboard of GREAT3 (2014) in github.com/barnabytprowe/great3-public; 120 of its entries, and the best of each branch. Teams sent many entries, and the best of many is partly luck.",
        )
    }
}

// board,team,method,Q_c,m_plus,m_cross,c_plus,c_cross. Rows without a team have the highest Q of a branch, whose biases are not given.
const LEADERBOARD: &str = include_str!("great3-leaderboard.csv");
