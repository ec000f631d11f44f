//! Galaxies on a grid, from catalogues of any program: what is scored.

use std::path::PathBuf;

use shearq_bias::SHEARED_CATALOGUES;
use shearq_files::FileError;
use shearq_files::frames::polars::DataFrame;
use shearq_files::table::{self, Place};
use shearq_measure::is_significant;
use shearq_quantities::linear::solve;
use shearq_quantities::statistics::RunningMean;
use shearq_scoring::{FieldSum, Row};

use crate::columns::{Columns, Shapes};
use crate::request::{Input, Request};
use crate::roles::Role;
use crate::rows::{SummedRow, placed_rows};
use crate::source::{Reading, Source, difference, sources, unused_in_others};
use crate::truth::Truth;

/// A galaxy with its weight, 1 without weights. Its ellipticity is NaN if it was not measured or does not count.
pub type Galaxy = (Row, f64);

/// The catalogue of one image: which of its columns are what.
#[derive(Debug)]
pub struct Galaxies {
    path: PathBuf,
    request: Request,
    sources: Vec<Source>,
}

impl Galaxies {
    /// Finds the columns of a catalogue, at most `most` rows of a text without names, whose columns are called `unnamed`.
    pub fn open(
        mut input: Input,
        request: &Request,
        unnamed: [&str; 4],
        most: usize,
    ) -> Result<Self, FileError> {
        let path = input.name.clone();
        let own = Galaxies {
            path: path.clone(),
            request: request.clone(),
            sources: Vec::new(),
        };
        if input.frame.is_none() {
            input.frame = own.without_names(unnamed, most)?;
        }
        let sources = sources(&input, &own.reading())?;
        if let Some(first) = sources.first()
            && !first.columns.have(&[Role::X, Role::Y])
        {
            let message = "there are no columns of positions (found none that is called x or y, expected pixels)";
            return Err(FileError::new(path, message).hint("--columns x=NAME,y=NAME"));
        }
        Ok(Galaxies { sources, ..own })
    }

    // The table of a text without names of columns.
    fn without_names(
        &self,
        unnamed: [&str; 4],
        most: usize,
    ) -> Result<Option<DataFrame>, FileError> {
        let place = Place::of(&self.path);
        let found = table::columns(&place)?;
        let names = &self.request.names;
        let is_named = |list: &shearq_files::table::Named| {
            let columns = Columns::find(&self.path, &list.names, names, false);
            columns.is_ok_and(|own| own.have(&[Role::X, Role::Y]))
        };
        let has_names = found.unnamed.is_empty() && !found.named.is_empty();
        if has_names || found.named.iter().any(is_named) {
            return Ok(None);
        }
        table::read_from(&place, Some(&unnamed), most).map(Some)
    }

    fn reading(&self) -> Reading<'_> {
        Reading {
            request: &self.request,
            truth: Truth::Constant([0.0; 2]),
            flip_g2: false,
        }
    }

    /// The columns that are used and what becomes of them, and columns that look as if they should be used, a sentence each.
    pub fn account(&self) -> Vec<String> {
        let Some(first) = self.sources.first() else {
            return Vec::new();
        };
        let mut lines = first.described(&self.reading());
        lines[0] = format!("Columns: {}. {}", first.columns.program(), lines[0]);
        lines
    }

    /// The columns that are used, by role.
    pub fn columns(&self) -> Vec<(String, String)> {
        let first = self.sources.first();
        first.map_or_else(Vec::new, |own| own.used(&self.reading()))
    }

    /// Columns that look as if they should be used and that the first catalogue does not have, of the first of `others` that has some.
    pub fn unused_in(&self, others: &[Galaxies]) -> Vec<String> {
        let others = others
            .iter()
            .map(|own| (own.path.as_path(), own.sources.as_slice()));
        let first = self.sources.first();
        first.map_or_else(Vec::new, |own| {
            unused_in_others(own, &self.reading(), others)
        })
    }

    // What catalogues of one set must have in common: columns by role, and what becomes of them.
    fn kind(&self) -> Vec<(String, String)> {
        let first = self.sources.first();
        first.map_or_else(Vec::new, |own| own.kind(&self.reading()))
    }

    // Whether ellipticities are to be divided by a mean response, or have weights.
    fn need_calibration(&self) -> bool {
        self.sources.iter().any(|own| {
            own.has_response()
                || own.shapes == Shapes::Responsivity
                || own.columns.have(&[Role::Weight])
        })
    }

    /// The galaxies in the order of the rows, at most `most`, before calibration.
    ///
    /// # Errors
    /// If a number stands for a failed measurement, or the file cannot be read.
    pub fn read(&self, most: usize) -> Result<Vec<Galaxy>, FileError> {
        let mut all = Vec::new();
        self.each(|[x, y], row| {
            let row = row.filter(|own| own.selected.of(0).binned.is_ok());
            let ([e1, e2], weight) =
                row.map_or(([f64::NAN; 2], 1.0), |own| (own.row.e, own.row.weight));
            if all.len() < most && row.is_none_or(|own| own.sheared == 0) {
                all.push((Row { x, y, e1, e2 }, weight));
            }
        })?;
        Ok(all)
    }

    fn each(&self, mut take: impl FnMut([f64; 2], Option<&SummedRow>)) -> Result<(), FileError> {
        placed_rows(&self.path, &self.reading(), &self.sources, &mut take).map(drop)
    }
}

/// Sums of responses and weights of the galaxies of a set.
#[derive(Debug, Clone, Default)]
pub struct CalibrationSums {
    // The first catalogue, and its columns by role.
    first: Option<(PathBuf, Vec<(String, String)>)>,
    weight: f64,
    diagonal: [RunningMean; 2],
    responses: [[f64; 2]; 2],
    // Of each sheared catalogue: weights times e/2h, and weights.
    sheared: [([f64; 2], f64); SHEARED_CATALOGUES.len()],
    has_sheared: bool,
    // Whether responses to the other component are known.
    has_matrix: bool,
}

impl CalibrationSums {
    /// Adds the galaxies of a catalogue.
    ///
    /// # Errors
    /// As [`Galaxies::read`], or if its columns are not those of the first catalogue.
    pub fn add(&mut self, own: &Galaxies) -> Result<(), FileError> {
        let kind = own.kind();
        let (before, first) = self
            .first
            .get_or_insert_with(|| (own.path.clone(), kind.clone()));
        if let Some(found) = difference(&kind, first) {
            let message = format!(
                "its columns are not the columns of {} (found {found})",
                before.display()
            );
            return Err(
                FileError::new(&own.path, message).hint("--columns with the same columns for all")
            );
        }
        if !own.need_calibration() {
            return Ok(());
        }
        let selects = own.sources.first().is_some_and(|own| own.selects);
        self.has_matrix = own.sources.first().is_some_and(Source::has_matrix);
        let shear_difference = 2.0 * own.request.step();
        own.each(|_, row| {
            if let Some(row) = row {
                self.add_row(row, selects, shear_difference);
            }
        })
    }

    fn add_row(&mut self, own: &SummedRow, selects: bool, shear_difference: f64) {
        let scaled = own.row.e.map(|e| e / shear_difference);
        for (catalogue, weight) in own.in_sheared(selects) {
            let (sums, weights) = &mut self.sheared[catalogue - 1];
            for (sum, e) in sums.iter_mut().zip(scaled) {
                *sum += weight * e;
            }
            *weights += weight;
            self.has_sheared = true;
        }
        if own.sheared > 0 || own.selected.of(0).binned.is_err() {
            return;
        }
        self.weight += own.row.weight;
        for (i, sums) in self.responses.iter_mut().enumerate() {
            self.diagonal[i].add(own.row.response[i][i]);
            for (j, sum) in sums.iter_mut().enumerate() {
                if i == j || self.has_matrix {
                    *sum += own.row.response[i][j];
                }
            }
        }
    }

    /// What the galaxies are divided by.
    ///
    /// # Errors
    /// If the mean response is not positive by three standard errors.
    pub fn calibration(&self) -> Result<Calibration, FileError> {
        let Some((path, _)) = self.first.as_ref().filter(|_| self.weight > 0.0) else {
            return Ok(Calibration::NONE);
        };
        let mut response = self.responses.map(|row| row.map(|sum| sum / self.weight));
        if self.has_sheared {
            let mean = |catalogue: usize, i: usize| {
                let (sums, weight) = &self.sheared[catalogue];
                sums[i] / weight
            };
            for (i, row) in response.iter_mut().enumerate() {
                for (j, own) in row.iter_mut().enumerate() {
                    if i == j || self.has_matrix {
                        *own += mean(2 * j, i) - mean(2 * j + 1, i);
                    }
                }
            }
        }
        for (k, own) in self.diagonal.iter().enumerate() {
            // Of metadetection, the mean alone is known.
            let is_clear = self.has_sheared || is_significant(own);
            let value = response[k][k];
            if !(is_clear && value > 0.0) {
                let number = k + 1;
                let message = format!(
                    "the mean response R{number}{number} of the {} galaxies of this and further catalogues is {value:.4} (expected a positive number of three standard errors), so that their ellipticities give no shear",
                    own.count()
                );
                return Err(FileError::new(path, message)
                    .hint("more galaxies, or --columns R11=none,R22=none if they are shears"));
            }
        }
        Ok(Calibration {
            response,
            weight: self.weight / self.diagonal[0].count() as f64,
        })
    }
}

/// What the ellipticities and weights of a set are divided by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration {
    /// The mean response, by rows to g1 and g2.
    pub response: [[f64; 2]; 2],
    /// The mean weight.
    pub weight: f64,
}

impl Calibration {
    /// Of shears without weights.
    pub const NONE: Self = Self::diagonal([1.0; 2]);

    /// Of ellipticities without weights.
    pub const fn diagonal([r11, r22]: [f64; 2]) -> Self {
        Calibration {
            response: [[r11, 0.0], [0.0, r22]],
            weight: 1.0,
        }
    }

    /// The same for ellipticities whose e2 and responses have the other sign of the second axis.
    #[must_use]
    pub fn with_other_sign_of_e2(mut self) -> Self {
        let [[_, r12], [r21, _]] = &mut self.response;
        (*r12, *r21) = (-*r12, -*r21);
        self
    }

    /// Calibrates a sum.
    pub fn apply(&self, sum: &mut FieldSum) {
        if self.weight != 1.0 {
            sum.divide_weights(self.weight);
        }
        self.shears(&mut sum.e1, &mut sum.e2);
    }

    /// Replaces ellipticities by shears.
    pub fn shears<'e>(
        &self,
        e1: impl IntoIterator<Item = &'e mut f64>,
        e2: impl IntoIterator<Item = &'e mut f64>,
    ) {
        for (e1, e2) in e1.into_iter().zip(e2) {
            [*e1, *e2] = self.shear([*e1, *e2]);
        }
    }

    /// The shear of an ellipticity.
    pub fn shear(&self, e: [f64; 2]) -> [f64; 2] {
        let [[r11, r12], [r21, r22]] = self.response;
        match r12 == 0.0 && r21 == 0.0 {
            true => [e[0] / r11, e[1] / r22],
            false => solve(self.response, e),
        }
    }
}
