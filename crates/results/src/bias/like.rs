//! Weighting simulated galaxies to the galaxies of a survey (`--like`).
//!
//! A survey measures ⟨w e⟩/⟨w R⟩ over its own galaxies. If m depends on S/N and size, the m of its mean shear is that of
//! simulated galaxies with the survey's distribution of both (Fenech Conti et al. 2017, MNRAS 467, 1627; Mandelbaum et al. 2018,
//! MNRAS 481, 3170; Li et al. 2023, A&A 670, A100). The simulated galaxies of each cell of the bins are weighted so that their
//! weights have the share that the weights of the survey's galaxies have in this cell.

use std::collections::BTreeMap;

use shearq_catalogue::columns::Columns;
use shearq_catalogue::expression::{Expression, Operand, operand_values, texts_of};
use shearq_catalogue::request::{self, MAX_AXES, MAX_BINS, Request};
use shearq_catalogue::roles::Role;
use shearq_catalogue::source::{add_formulas, with_formulas};
use shearq_files::FileError;
use shearq_files::frames::polars::DataFrame;
use shearq_files::table::{self, Place};

use super::cells::{Cells, key};
use super::error::BiasFailure;

/// Galaxies of a survey, or of one of its tomographic bins.
#[derive(Debug, Clone, PartialEq)]
pub struct Population {
    pub label: String,
    /// Galaxies with a positive weight and without a flag.
    pub galaxies: u64,
    /// Σ w of each cell; the last is outside of all bins.
    weights: Vec<f64>,
    /// Columns that were used.
    pub columns: String,
    /// Columns that look like weights or state which galaxies count, and are not used.
    pub unused: Vec<String>,
    /// The part of the weights in cells without simulated galaxies, by cell, with the largest first.
    pub uncovered: Vec<(String, f64)>,
}

impl Population {
    /// The shares of the cells with simulated galaxies, of which there are `counts`.
    pub(super) fn covered(
        &mut self,
        counts: &[usize],
        cells: &Cells,
    ) -> Result<Vec<f64>, BiasFailure> {
        let total: f64 = self.weights.iter().sum();
        let mut shares = vec![0.0; counts.len()];
        for (cell, weight) in self.weights.iter().enumerate() {
            match counts.get(cell) {
                Some(1..) => shares[cell] = *weight,
                _ if *weight == 0.0 => {}
                Some(0) => self.uncovered.push((cells.label(cell), weight / total)),
                None => {
                    let label = format!("outside of the bins of {}", cells.names());
                    self.uncovered.push((label, weight / total));
                }
            }
        }
        self.uncovered.sort_by(|a, b| b.1.total_cmp(&a.1));
        let covered: f64 = shares.iter().sum();
        if covered == 0.0 {
            return Err(BiasFailure::NothingAlike(self.label.clone().into()));
        }
        shares.iter_mut().for_each(|share| *share /= covered);
        Ok(shares)
    }
}

// Columns of tomographic bins: KiDS, HSC, DES and others.
const TOMOGRAPHY: [&str; 9] = [
    "tomobin",
    "tomo_bin",
    "tomographic_bin",
    "tomography_bin",
    "zbin",
    "z_bin",
    "hsc_y3_zbin",
    "bhat",
    "tom_bin_id",
];

// Without a recognised table of ellipticities.
const WEIGHTS: [&str; 5] = ["w", "weight", "shape_weight", "lensfit_weight", "weights"];

/// Which columns of a survey are used.
struct Survey<'r> {
    place: Place,
    weight: Option<String>,
    flags: Vec<String>,
    tomography: Option<String>,
    /// `--where`, if the survey has its columns.
    condition: Option<&'r Expression>,
    /// What is binned, and compared by the condition, by the survey's names of the columns.
    binned: Vec<Operand>,
    compared: Vec<Operand>,
    formulas: Vec<Expression>,
    /// What is used, in words.
    columns: String,
    unused: Vec<String>,
}

impl<'r> Survey<'r> {
    fn of(request: &'r Request, stated: &request::Survey) -> Result<Self, FileError> {
        let place = Place::of(&stated.catalogue.name);
        let path = place.path.as_path();
        let known: Vec<String> = match &stated.catalogue.frame {
            Some(frame) => (frame.columns().iter())
                .map(|own| own.name().to_string())
                .collect(),
            None => match table::columns(&place)?.named.into_iter().next() {
                Some(list) => list.names,
                None => Vec::new(),
            },
        };
        let there = |name: &str| -> Option<String> {
            let exact = known.iter().find(|own| *own == name);
            let similar = || known.iter().find(|own| own.eq_ignore_ascii_case(name));
            exact.or_else(similar).cloned()
        };
        let own = |operand: &Operand| -> Option<Operand> {
            Some(Operand {
                column: there(&operand.column)?,
                ..operand.clone()
            })
        };
        let absent = |name: &str| FileError::no_column(path, name, &known);
        let names = request.names.within(&known);
        let (all, formulas) = with_formulas(path, &known, &names)?;
        // A survey may be a table of S/N and size alone, whose other columns are found as beside ellipticities.
        let columns = Columns::find(path, &all, &names, false);
        let is_bare = columns.is_err();
        // Other faults remain with ellipticities.
        let columns = columns.or_else(|_| {
            let shapes = ["e1", "e2"].map(str::to_owned);
            Columns::find(path, &[&all[..], &shapes].concat(), &names, false)
                .map_err(|error| error.with_words(", e1, e2", ""))
        })?;
        let weight = columns.of(Role::Weight).map(str::to_owned);
        let weight = match is_bare && !names.is_given(Role::Weight) {
            true => weight.or_else(|| WEIGHTS.iter().find_map(|name| there(name))),
            false => weight,
        };
        let flags = columns.flags.clone();
        let tomography = match &stated.tomography {
            Some(name) => Some(there(name).ok_or_else(|| absent(name))?),
            None => TOMOGRAPHY.iter().find_map(|name| there(name)),
        };
        let binned = request.bins.iter().flat_map(|bins| bins.of.operands());
        let binned = binned.map(|operand| own(operand).ok_or_else(|| absent(&operand.column)));
        let binned = binned.collect::<Result<_, _>>()?;
        let selection = request.selection.as_ref();
        let stated = selection.and_then(|own| own.rows.as_ref());
        let compared: Option<Vec<Operand>> =
            stated.and_then(|condition| condition.operands().iter().map(own).collect());
        let condition = stated.filter(|_| compared.is_some());
        let mut roles: Vec<String> = weight.iter().map(|own| format!("w={own}")).collect();
        roles.extend(flags.iter().map(|own| format!("flag={own}")));
        roles.extend(
            tomography
                .iter()
                .map(|own| format!("tomographic bin={own}")),
        );
        if roles.is_empty() {
            roles.push("no weight".into());
        }
        roles.extend(stated.map(|own| match condition {
            Some(_) => format!("where {}", own.text()),
            None => format!("all rows, because it lacks a column of `{}`", own.text()),
        }));
        let mut survey = Survey {
            unused: Vec::new(),
            columns: roles.join(", "),
            place,
            weight,
            flags,
            tomography,
            condition,
            binned,
            compared: compared.unwrap_or_default(),
            formulas,
        };
        let unused = columns.unused_choices(&survey.read()).into_iter();
        survey.unused = unused.map(str::to_owned).collect();
        Ok(survey)
    }

    fn operands(&self) -> impl Iterator<Item = &Operand> {
        self.binned.iter().chain(&self.compared)
    }

    /// The columns that are read, each once.
    fn read(&self) -> Vec<&str> {
        let is_computed = |name: &str| self.formulas.iter().any(|own| own.text() == name);
        let roles = self
            .weight
            .iter()
            .chain(&self.flags)
            .chain(&self.tomography);
        let roles = roles.map(String::as_str).filter(|name| !is_computed(name));
        let operands = self.operands().map(|own| own.column.as_str());
        let computed = self.formulas.iter().flat_map(Expression::columns);
        let mut all: Vec<&str> = operands.chain(roles).chain(computed).collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    /// Columns that may be texts.
    fn texts(&self) -> Vec<&str> {
        let computed = self.formulas.iter().flat_map(Expression::operands);
        let texts = self.operands().chain(computed);
        let texts = texts.filter(|own| own.texts.is_some());
        let texts = texts.map(|own| own.column.as_str());
        texts.chain(self.tomography.as_deref()).collect()
    }

    /// Adds the weights of the rows of a part to their cells, of the whole survey (`None`) and of their tomographic bin.
    fn add(
        &self,
        part: DataFrame,
        (request, cells): (&Request, &Cells),
        found: &mut Weights,
    ) -> Result<(), FileError> {
        let path = self.place.path.as_path();
        let frame = &add_formulas(part, &self.formulas, path)?;
        let column = |name: &str| table::numbers(frame, name, path);
        let weights = self.weight.as_deref().map(column).transpose()?;
        let flags = self.flags.iter().map(|name| column(name));
        let flags = flags.collect::<Result<Vec<_>, _>>()?;
        let values = |operand| operand_values(frame, operand, path);
        let binned = self.binned.iter().map(values);
        let binned = binned.collect::<Result<Vec<_>, _>>()?;
        let compared = self.compared.iter().map(values);
        let compared = compared.collect::<Result<Vec<_>, _>>()?;
        let bins = (self.tomography.as_ref()).map(|name| -> Result<Vec<String>, FileError> {
            match texts_of(frame, name) {
                Some(texts) => Ok(texts
                    .map(|text| text.unwrap_or_default().trim().to_owned())
                    .collect()),
                None => Ok(column(name)?.iter().map(f64::to_string).collect()),
            }
        });
        let bins = bins.transpose()?;
        for at in 0..frame.height() {
            let weight = weights.as_ref().map_or(1.0, |weights| weights[at]);
            let holds = |own: &Expression| own.holds(&|k| compared[k][at]) == Some(true);
            // NaN is no weight either.
            let is_used = weight > 0.0
                && flags.iter().all(|flag| flag[at] == 0.0)
                && self.condition.is_none_or(holds);
            if !is_used {
                continue;
            }
            let (mut own, mut first) = ([0.0; MAX_AXES], 0);
            for (own, binning) in own.iter_mut().zip(&request.bins) {
                *own = binning.of.value(&|k| binned[first + k][at]);
                first += binning.of.operands().len();
            }
            let cell = cells.of(&own).unwrap_or(cells.outside());
            let mut add = |name: Option<String>| {
                let (count, weights) = found
                    .entry(name)
                    .or_insert_with(|| (0, vec![0.0; cells.count() + 1]));
                *count += 1;
                weights[cell] += weight;
            };
            add(None);
            if let Some(bins) = &bins {
                add(Some(bins[at].clone()));
            }
        }
        match found.len() > MAX_BINS {
            true => {
                let message = format!(
                    "column `{}` has more than {MAX_BINS} different values (expected tomographic bins)",
                    self.tomography.as_deref().unwrap_or_default()
                );
                Err(FileError::new(path, message).hint("--tomography NAME"))
            }
            false => Ok(()),
        }
    }
}

// Galaxies and Σ w of each cell: of the whole survey, and of its tomographic bins.
type Weights = BTreeMap<Option<String>, (u64, Vec<f64>)>;

/// The whole survey, then its tomographic bins.
pub(super) fn populations(
    stated: &request::Survey,
    request: &Request,
    cells: &Cells,
) -> Result<Vec<Population>, BiasFailure> {
    let survey = Survey::of(request, stated)?;
    let mut found = Weights::new();
    let mut add = |part| survey.add(part, (request, cells), &mut found);
    match &stated.catalogue.frame {
        Some(frame) => add(frame.clone())?,
        None => table::read_parts(&survey.place, &survey.read(), &survey.texts(), add)?,
    }
    let name = stated.catalogue.name.display();
    // A number where there is one, so that bin 10 comes after bin 9.
    let mut all: Vec<_> = found.into_iter().collect();
    let order = |name: &Option<String>| {
        let name = name.as_ref()?;
        Some((name.parse::<f64>().map_or(u64::MAX, key), name.clone()))
    };
    all.sort_by_key(|(name, _)| order(name));
    let population = |(bin, (galaxies, weights)): (Option<String>, (u64, Vec<f64>))| Population {
        label: match (bin, &survey.tomography) {
            (Some(bin), Some(column)) => format!("like {name}, {column} {bin}"),
            _ => format!("like {name}"),
        },
        galaxies,
        weights,
        columns: survey.columns.clone(),
        unused: survey.unused.clone(),
        uncovered: Vec::new(),
    };
    Ok(all.into_iter().map(population).collect())
}
