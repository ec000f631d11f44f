//! Multiplicative and additive bias of catalogues of any program.
//!
//! [`Request`] specifies catalogues and options. [`sum`] reads the catalogues into sums that merge ([`Summed`]), and
//! [`Summed::result`] estimates.

pub mod columns;
pub mod folders;
mod identity;
pub mod positions;
mod read;
pub mod truth;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_bias::{
    BiasError, Catalogue, Design, Errors, Estimate, Grouping, Layout, Range, UnitSums, difference,
    group,
};
use shearq_dataset::layout::stated_sign;
use shearq_dataset::truth::{Sign, SignBasis, word};
use shearq_files::FileError;
use shearq_files::frames::polars::DataFrame;
use shearq_scoring::TruthSign;
use thiserror::Error;

use crate::expression::Expression;
use crate::select::StatedSelection;
use columns::{Names, Preset, Role, Shapes};
use read::{Reading, Source};
use truth::{TrueSign, Truth};

/// Why there is no result.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BiasFailure {
    /// A file.
    #[error(transparent)]
    File(#[from] FileError),
    /// The data determine no bias.
    #[error(transparent)]
    Bias(#[from] BiasError),
    /// The catalogues do not fit the options.
    #[error("{0}")]
    Data(String),
}

/// Bins of an expression of columns.
#[derive(Debug, Clone)]
pub struct Binning {
    /// What is binned.
    pub of: Expression,
    /// The edges, or a number of bins with equally many galaxies.
    pub edges: Edges,
}

/// Edges of bins.
#[derive(Debug, Clone, PartialEq)]
pub enum Edges {
    /// So many bins with equally many galaxies.
    Equal(usize),
    /// Increasing edges. The last bin contains its upper edge.
    Given(Vec<f64>),
}

impl Edges {
    /// Number of bins.
    pub fn count(&self) -> usize {
        match self {
            Edges::Equal(count) => *count,
            Edges::Given(edges) => edges.len().saturating_sub(1),
        }
    }
}

/// Which galaxies form an independent unit.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum Units {
    /// Recognised from the columns and the design.
    #[default]
    Recognised,
    /// The same rows of all catalogues.
    Rows,
    /// Whole catalogues, or groups of them.
    Catalogues,
    /// Galaxies with the same value in this column.
    Column(String),
}

/// A catalogue: a file, or a table in memory.
#[derive(Debug, Clone)]
pub struct Input {
    /// The file, or the name of the table.
    pub name: PathBuf,
    /// The table, if it is in memory.
    pub frame: Option<DataFrame>,
}

impl From<PathBuf> for Input {
    fn from(name: PathBuf) -> Self {
        Input { name, frame: None }
    }
}

/// What is read, and how.
#[derive(Debug, Clone)]
pub struct Request {
    /// Catalogues.
    pub catalogues: Vec<Input>,
    /// Names of columns.
    pub names: Names,
    /// True shear.
    pub truth: Truth,
    /// How ellipticities become shears; `None` if the names of the columns decide.
    pub shapes: Option<Shapes>,
    /// Sign of the true g2.
    pub sign: TrueSign,
    /// Bins.
    pub bins: Option<Binning>,
    /// Rows that count, and weights of catalogues of linear configurations, whose response to shear enters.
    pub selection: Option<StatedSelection>,
    /// The design; recognised if `None`.
    pub design: Option<Design>,
    /// Units of the errors.
    pub units: Units,
    /// Whether rows with missing numbers are left out.
    pub drop_missing: bool,
    /// Artificial shear of metacalibration.
    pub step: f64,
}

/// What sums of catalogues are sums of.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct About {
    version: String,
    pub catalogues: Vec<Catalogue>,
    /// The program that wrote them.
    pub program: String,
    truth: bool,
    /// Whether responses were read, or the type of the ellipticities was given.
    response: bool,
    /// Whether rows have a response that `--columns R11=none` leaves out.
    pub response_column: bool,
    /// Whether units are named by identifiers.
    matched: bool,
    /// A column that is not used and looks like independent units.
    pub unit_column: Option<String>,
    design: Option<Design>,
    by_key: Option<bool>,
    /// What the bins are bins of.
    pub binned: String,
    edges: Vec<f64>,
    /// Columns of `--where` or `--bins` without sheared versions: m contains how shear changes this choice.
    pub measured: Vec<String>,
    /// The texts of the options that select and weight rows, such as `where: snr > 10`.
    pub selection: Option<String>,
    /// Which columns are used as what, and which look as if they should be, a line each.
    pub columns: Vec<String>,
    /// The sign of the true g2; `None` if the truth needs none.
    pub sign: Option<Sign>,
}

/// Sums of catalogues.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summed {
    sums: UnitSums,
    about: About,
}

/// Estimates of one bin.
#[derive(Debug, Clone)]
pub struct BinResult {
    /// Lower and upper edge; `None` for all galaxies.
    pub edges: Option<[f64; 2]>,
    /// The estimates, or why there are none.
    pub estimate: Result<Estimate, BiasError>,
}

/// Estimates of all galaxies and of bins.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct BiasResult {
    /// All galaxies first, then each bin.
    pub bins: Vec<BinResult>,
    pub design: Design,
    /// The units of the errors, and what is wrong with them.
    pub grouping: Grouping,
    pub about: About,
}

impl BiasResult {
    /// The estimates of all galaxies.
    ///
    /// # Errors
    /// If there are none.
    pub fn all(&self) -> Result<&Estimate, BiasError> {
        let first = self.bins.first().map(|bin| bin.estimate.as_ref());
        first
            .unwrap_or(Err(&BiasError::NoGalaxies))
            .map_err(Clone::clone)
    }
}

/// Most values from which the edges of bins with equally many galaxies are determined.
const SAMPLE: usize = 1 << 20;

/// Most bins.
pub const MOST_BINS: usize = 100;

impl Request {
    fn reading(&self) -> Result<Reading, FileError> {
        let paths = self.catalogues.iter().map(|input| input.name.as_path());
        Ok(Reading {
            names: self.names.clone(),
            truth: self.truth.of_paths(paths)?,
            shapes: self.shapes,
            flip_g2: false,
            select: self.selection.as_ref().and_then(|own| own.rows.clone()),
            selection: self.selection.as_ref().and_then(|own| own.weights.clone()),
            binned: self.bins.as_ref().map(|bins| bins.of.clone()),
            drop_missing: self.drop_missing,
            step: self.step,
            neighbours: self.design == Some(Design::Rotated) && self.catalogues.len() == 1,
            unit: match &self.units {
                Units::Recognised => None,
                Units::Column(name) => Some(name.clone()),
                Units::Rows | Units::Catalogues => Some(String::new()),
            },
        })
    }
}

/// Sums the catalogues of a request for which `part` holds, given their number.
///
/// # Errors
/// If a catalogue cannot be read, lacks a column, or contains values that are not usable.
pub fn sum(request: &Request, part: &dyn Fn(usize) -> bool) -> Result<Summed, BiasFailure> {
    read::distinct(&request.catalogues)?;
    let mut reading = request.reading()?;
    let mut all: Vec<Vec<Source>> = Vec::new();
    for input in &request.catalogues {
        all.push(read::sources(input, &reading)?);
    }
    let Some(first) = all.first().and_then(|sources| sources.first()) else {
        return Err(BiasFailure::Data("there is no catalogue".into()));
    };
    let layout = Layout {
        psf: first.has_psf(),
        versions: first.has_version_rows() || first.selects_versions(&reading),
        matrix: first.has_matrix(&reading),
    };
    let measured = first.unanswered().to_vec();
    let truth = known(&request.truth, first);
    let response = has_response(first) || first.shapes(&reading) != Shapes::Shear;
    let described = first.described(&reading);
    check_columns(request, &reading, &all)?;
    let edges = match &request.bins {
        None => Vec::new(),
        Some(bins) => match &bins.edges {
            Edges::Given(edges) => edges.clone(),
            Edges::Equal(count) => equal_edges(request, &reading, &all, *count)?,
        },
    };
    let sign = known_sign(request, &all)?.filter(|_| truth);
    reading.flip_g2 = sign.is_some_and(|sign| sign.of == TruthSign::Challenge);
    let (sums, catalogues) = add_up(request, &reading, &all, (layout, &edges), part)?;
    let named_unit = matches!(request.units, Units::Column(_))
        || request.units == Units::Recognised && first.columns.of(Role::Unit).is_some();
    let about = About {
        version: env!("CARGO_PKG_VERSION").into(),
        catalogues,
        program: first.columns.program().into(),
        truth,
        response: response || request.shapes.is_some(),
        response_column: first.columns.have(&[Role::R11]),
        matched: named_unit || first.columns.of(Role::Id).is_some(),
        unit_column: first.unit_column.clone().filter(|_| !named_unit),
        design: request.design,
        by_key: match request.units {
            Units::Rows | Units::Column(_) => Some(true),
            Units::Catalogues => Some(false),
            Units::Recognised => named_unit.then_some(true),
        },
        binned: request
            .bins
            .as_ref()
            .map_or_else(String::new, |bins| bins.of.text().to_owned()),
        edges,
        measured,
        selection: request.selection.as_ref().map(|own| own.text.clone()),
        columns: described,
        sign,
    };
    let mut summed = Summed { sums, about };
    if let TrueSign::OfCatalogues(truth) = &request.sign {
        let sign = summed.sign_of_catalogues(truth)?;
        if sign.of == TruthSign::Challenge {
            reading.flip_g2 = true;
            let (layout, edges) = (summed.sums.layout(), &summed.about.edges);
            let found = add_up(request, &reading, &all, (layout, edges), part)?;
            (summed.sums, summed.about.catalogues) = found;
        }
        summed.about.sign = Some(sign);
    }
    Ok(summed)
}

/// The sums of the catalogues for whose numbers `part` holds.
fn add_up(
    request: &Request,
    reading: &Reading,
    all: &[Vec<Source>],
    (layout, edges): (Layout, &[f64]),
    part: &dyn Fn(usize) -> bool,
) -> Result<(UnitSums, Vec<Catalogue>), BiasFailure> {
    // The last bin is of galaxies outside of the edges.
    let bins = edges.len().max(1);
    let mut sums = UnitSums::new(layout, bins, request.catalogues.len());
    let mut catalogues = Vec::new();
    for (number, (Input { name, .. }, sources)) in request.catalogues.iter().zip(all).enumerate() {
        if !part(number) {
            catalogues.push(Catalogue {
                name: name.display().to_string(),
                ..Catalogue::default()
            });
            continue;
        }
        let selects = sources[0].selects_versions(reading);
        catalogues.push(read::rows(name, reading, sources, |item| {
            let number = number as u32;
            let row = &item.row;
            let scaled = row.e.map(|e| e / (2.0 * request.step));
            if let Some(version) = item.version {
                if let Some(bin) = bin_of(edges, item.binned[0]) {
                    sums.add_version(number, item.key, bin, version, (scaled, row.weight));
                }
                return Ok(());
            }
            if let Some(bin) = bin_of(edges, item.binned[0]) {
                sums.add(number, item.key, bin, row);
            }
            if selects {
                for (version, value) in item.binned[1..].iter().enumerate() {
                    if let Some(bin) = bin_of(edges, *value) {
                        let weight = item.weights[version];
                        sums.add_version(number, item.key, bin, version, (scaled, weight));
                    }
                }
            }
            Ok(())
        })?);
    }
    Ok((sums, catalogues))
}

/// The sign of the true g2 that the user or files state; `None` if the truth needs no sign or the catalogues determine it.
fn known_sign(request: &Request, all: &[Vec<Source>]) -> Result<Option<Sign>, BiasFailure> {
    let specified = match &request.sign {
        TrueSign::Known(sign) => Some(*sign),
        TrueSign::Convention | TrueSign::OfCatalogues(_) => None,
    };
    match &request.truth {
        Truth::Data(_) if specified.is_some() => Err(BiasFailure::Data(
            "--truth-sign: the data of these folders state the sign of g2. Try: omit --truth-sign"
                .into(),
        )),
        Truth::Columns => {
            let mut found: Option<(&Input, Option<Sign>)> = None;
            for (input, sources) in request.catalogues.iter().zip(all) {
                let has_shear = sources
                    .iter()
                    .all(|own| own.columns.have(&[Role::G1, Role::G2]));
                if input.frame.is_some() || !has_shear {
                    return Ok(specified);
                }
                let path = sources[0].path();
                let own =
                    Sign::of_truth(stated_sign(path)?, specified.map(|sign| sign.of), || None)
                        .map_err(|fault| FileError::new(path, fault))?;
                let (first, sign) = *found.get_or_insert((input, own));
                if sign.map(|sign| sign.of) != own.map(|sign| sign.of) {
                    return Err(BiasFailure::Data(format!(
                        "{}: it does not state the same sign of g2 as {}. Try: --truth-sign, or the same statement in all",
                        input.name.display(),
                        first.name.display()
                    )));
                }
            }
            Ok(found.and_then(|(_, sign)| sign))
        }
        _ => Ok(specified),
    }
}

/// Refuses catalogues with other columns than the first one.
fn check_columns(
    request: &Request,
    reading: &Reading,
    all: &[Vec<Source>],
) -> Result<(), BiasFailure> {
    let kind = |source: &Source| {
        (
            known(&request.truth, source),
            has_response(source),
            source.has_psf(),
            source.has_matrix(reading),
            source.selects_versions(reading),
            source.columns.preset,
        )
    };
    let first = all[0].first().map(kind);
    for (input, sources) in request.catalogues.iter().zip(all) {
        if !sources.iter().all(|source| Some(kind(source)) == first) {
            return Err(BiasFailure::Data(format!(
                "{}: its columns are not the columns of {} (expected the same columns for truth, response and PSF in all catalogues). Try: one command per kind of catalogue",
                input.name.display(),
                request.catalogues[0].name.display()
            )));
        }
    }
    Ok(())
}

fn unlike(what: &str) -> Result<(), BiasFailure> {
    let message = format!("the sums do not belong together: they have {what}");
    Err(BiasFailure::Data(message))
}

/// Whether the true shear is known.
fn known(truth: &Truth, source: &Source) -> bool {
    !matches!(truth, Truth::Columns) || source.columns.have(&[Role::G1, Role::G2])
}

/// Whether the catalogue has responses.
fn has_response(source: &Source) -> bool {
    source.has_version_rows()
        || matches!(source.columns.preset, Preset::Metacal | Preset::Versions)
        || source.columns.have(&[Role::R11])
}

/// The bin of a value; the last one is outside of all edges. `None` for a row that is not selected.
fn bin_of(edges: &[f64], value: f64) -> Option<usize> {
    if !value.is_finite() {
        return None;
    }
    let Some((last, _)) = edges.split_last() else {
        return Some(0);
    };
    let outside = edges.len() - 1;
    if value == *last {
        return Some(outside - 1);
    }
    let above = edges.partition_point(|edge| *edge <= value);
    Some(if above == 0 { outside } else { above - 1 })
}

/// Edges of bins with equally many galaxies without artificial shear, from a sample of the catalogues.
fn equal_edges(
    request: &Request,
    reading: &Reading,
    all: &[Vec<Source>],
    count: usize,
) -> Result<Vec<f64>, BiasFailure> {
    let (mut values, mut stride, mut number) = (Vec::new(), 1u64, 0u64);
    for (input, sources) in request.catalogues.iter().zip(all) {
        read::rows(&input.name, reading, sources, |item| {
            if item.version.is_none() && item.binned[0].is_finite() {
                if number % stride == 0 {
                    values.push(item.binned[0]);
                }
                number += 1;
            }
            if values.len() > SAMPLE {
                // Every second value of the sample remains.
                let mut odd = false;
                values.retain(|_| {
                    odd = !odd;
                    odd
                });
                stride *= 2;
            }
            Ok(())
        })?;
    }
    values.sort_unstable_by(f64::total_cmp);
    let (Some(low), Some(high)) = (values.first(), values.last()) else {
        return Err(BiasError::NoGalaxies.into());
    };
    let mut edges = vec![*low];
    edges.extend((1..count).map(|k| values[k * values.len() / count]));
    edges.push(*high);
    if !edges.windows(2).all(|pair| pair[0] < pair[1]) {
        return Err(BiasFailure::Data(format!(
            "--bins: `{}` has too few different values for {count} bins with equally many galaxies. Try: fewer bins or given edges",
            reading.binned.as_ref().map_or("", Expression::text)
        )));
    }
    // A sample may lack the extreme values.
    if stride > 1 {
        edges[0] = f64::MIN;
        edges[count] = f64::MAX;
    }
    Ok(edges)
}

impl Summed {
    /// Checks sums that were read from a file.
    ///
    /// # Errors
    /// If their parts contradict each other.
    pub fn checked(mut self) -> Result<Self, BiasFailure> {
        let bins = self.about.edges.len().max(1);
        let mut sums = UnitSums::new(self.sums.layout(), bins, self.about.catalogues.len());
        sums.merge(self.sums)?;
        self.sums = sums;
        Ok(self)
    }

    /// Adds the sums of other catalogues of the same list.
    ///
    /// # Errors
    /// If the lists, options or columns differ, or a catalogue is in both.
    pub fn merge(&mut self, other: Summed) -> Result<(), BiasFailure> {
        self.check_options(&other)?;
        let names = |all: &[Catalogue]| -> Vec<String> {
            all.iter().map(|catalogue| catalogue.name.clone()).collect()
        };
        if names(&self.about.catalogues) != names(&other.about.catalogues) {
            return unlike("different lists of catalogues");
        }
        for (own, more) in self.about.catalogues.iter_mut().zip(other.about.catalogues) {
            match (own.rows, more.rows) {
                (0, _) => *own = more,
                (_, 0) => {}
                _ => {
                    return Err(BiasFailure::Data(format!(
                        "{}: the catalogue is in two files of sums",
                        own.name
                    )));
                }
            }
        }
        Ok(self.sums.merge(other.sums)?)
    }

    /// Adds the sums of other catalogues, which follow these.
    ///
    /// # Errors
    /// If options or columns differ.
    pub fn append(&mut self, other: Summed) -> Result<(), BiasFailure> {
        self.check_options(&other)?;
        self.about.catalogues.extend(other.about.catalogues);
        Ok(self.sums.append(other.sums)?)
    }

    /// Catalogues without rows, because their shards are absent.
    pub fn absent(&self) -> Vec<&str> {
        let empty = self.about.catalogues.iter().filter(|own| own.rows == 0);
        empty.map(|own| own.name.as_str()).collect()
    }

    /// Refuses sums of other options.
    fn check_options(&self, other: &Summed) -> Result<(), BiasFailure> {
        if self.about.version != other.about.version {
            return unlike("different versions");
        }
        if (&self.about.binned, &self.about.edges, &self.about.selection)
            != (
                &other.about.binned,
                &other.about.edges,
                &other.about.selection,
            )
            || (
                self.about.truth,
                self.about.matched,
                self.about.design,
                self.about.by_key,
            ) != (
                other.about.truth,
                other.about.matched,
                other.about.design,
                other.about.by_key,
            )
        {
            return unlike("different options");
        }
        if self.about.sign.map(|sign| sign.of) != other.about.sign.map(|sign| sign.of) {
            return unlike("different signs of g2");
        }
        Ok(())
    }

    /// The estimates.
    ///
    /// # Errors
    /// If no galaxy counts, an ellipticity is constant, the mean response is too close to zero, or the ellipticities do
    /// not follow the true shear.
    pub fn result(&self, errors: Errors) -> Result<BiasResult, BiasFailure> {
        let (design, grouping) = self.grouped()?;
        let all = grouping.all_bins().estimate(0, self.about.truth, errors);
        let all = all.map_err(|error| match error {
            // All rows have the same patch or tile.
            BiasError::FewUnits { .. } if self.about.by_key == Some(true) => {
                BiasFailure::Data(format!("{error}. Try: --units rows"))
            }
            error => error.into(),
        })?;
        self.check_slopes(&all)?;
        Ok(BiasResult {
            bins: self.bins(all, |bin| grouping.estimate(bin, self.about.truth, errors)),
            design,
            grouping,
            about: self.about.clone(),
        })
    }

    fn bins(
        &self,
        all: Estimate,
        estimate: impl Fn(usize) -> Result<Estimate, BiasError>,
    ) -> Vec<BinResult> {
        let all = BinResult {
            edges: None,
            estimate: Ok(all),
        };
        let bins = self.about.edges.windows(2).enumerate();
        let bins = bins.map(|(bin, edges)| BinResult {
            edges: Some([edges[0], edges[1]]),
            estimate: estimate(bin),
        });
        [all].into_iter().chain(bins).collect()
    }

    /// Units and design, if the values are usable.
    fn grouped(&self) -> Result<(Design, Grouping), BiasFailure> {
        self.check_values()?;
        let design = self
            .about
            .design
            .unwrap_or_else(|| Design::of(&self.about.catalogues, self.about.truth));
        let grouping = group(
            self.sums.clone(),
            &self.about.catalogues,
            design,
            self.about.by_key,
            self.about.matched,
        );
        Ok((design, grouping))
    }

    /// Differences of the estimates from `other`, of another program on the same galaxies, with paired errors.
    ///
    /// # Errors
    /// As [`Summed::result`], or if the options or the designs differ.
    pub fn difference(&self, other: &Summed) -> Result<BiasResult, BiasFailure> {
        if (&self.about.binned, &self.about.edges, self.about.truth)
            != (&other.about.binned, &other.about.edges, other.about.truth)
        {
            return Err(BiasFailure::Data(
                "the catalogues cannot be compared: truth or bins differ. Try: bins with edges"
                    .into(),
            ));
        }
        if let (Some(own), Some(theirs)) = (self.about.sign, other.about.sign)
            && own.of != theirs.of
        {
            return Err(BiasFailure::Data(format!(
                "the catalogues cannot be compared: e2 of one follows the true g2 of sign {}, of the other {}. Try: --truth-sign",
                word(own.of),
                word(theirs.of)
            )));
        }
        let ((design, own), (their_design, theirs)) = (self.grouped()?, other.grouped()?);
        if (design, own.unit) != (their_design, theirs.unit) {
            return Err(BiasFailure::Data(format!(
                "the catalogues cannot be compared (found {} with {} and {} with {}, expected the same design and units). Try: --design and --units",
                design.name(),
                own.unit,
                their_design.name(),
                theirs.unit
            )));
        }
        let (a, b, truth) = (&own.sums, &theirs.sums, self.about.truth);
        let all = difference(&a.all_bins(), &b.all_bins(), 0, truth)?;
        let bins = self.bins(all, |bin| difference(a, b, bin, truth));
        let about = About {
            program: format!("{} minus {}", self.about.program, other.about.program),
            measured: Vec::new(),
            ..self.about.clone()
        };
        // What both have in common is not in the errors: the noise of stars, and galaxies that both leave out.
        let grouping = Grouping {
            misaligned: own.misaligned || theirs.misaligned,
            uncorrelated: None,
            stars: Vec::new(),
            ..own
        };
        Ok(BiasResult {
            bins,
            design,
            grouping,
            about,
        })
    }

    fn check_slopes(&self, all: &Estimate) -> Result<(), BiasFailure> {
        check_slopes(
            all,
            self.about.response,
            ratio(&self.about.catalogues),
            self.about.sign,
        )
    }

    /// The sign of g2 in the file `truth` that e2 follows, from sums for the standard sign.
    fn sign_of_catalogues(&self, truth: &Path) -> Result<Sign, BiasFailure> {
        let mut used = self.about.catalogues.iter().filter(|own| own.rows > 0);
        if used.all(|own| own.shear[1].constant() == Some(0.0)) {
            return Ok(Sign::ZERO);
        }
        let undetermined = |found| {
            let sign = Sign::of_catalogues(found);
            sign.map_err(|fault| FileError::new(truth, fault).into())
        };
        // A shard may be too small for an estimate that all catalogues have.
        let estimate = self.grouped().and_then(|(_, grouping)| {
            Ok(grouping.all_bins().estimate(0, true, Errors::Jackknife)?)
        });
        let all = match estimate {
            Err(_) if !self.absent().is_empty() => return undetermined(None),
            found => found?,
        };
        let m = all.value("m2").filter(|m| m.error.is_finite());
        let found = m.and_then(|m| {
            let (slope, clear) = (1.0 + m.value, SIGNIFICANT * m.error);
            match slope {
                _ if slope >= clear => Some(TruthSign::Standard),
                _ if slope <= -clear => Some(TruthSign::Challenge),
                _ => None,
            }
        });
        if found.is_none() {
            // Exchanged components or wrong rows are the better remark.
            self.check_slopes(&all)?;
        }
        undetermined(found)
    }

    /// Refuses catalogues without usable rows, and constant ellipticities.
    fn check_values(&self) -> Result<(), BiasFailure> {
        let total = |of: fn(&Catalogue) -> u64| self.about.catalogues.iter().map(of).sum::<u64>();
        let rows = total(|c| c.rows);
        let (flagged, unweighted) = (total(|c| c.flagged), total(|c| c.unweighted));
        let (unselected, missing) = (total(|c| c.unselected), total(|c| c.missing));
        let (failed, above_one) = (total(|c| c.failed), total(|c| c.above_one));
        let used =
            rows.saturating_sub(flagged + unweighted + unselected + missing + failed + above_one);
        if used == 0 {
            return Err(BiasFailure::Data(format!(
                "no galaxy can be used (found {rows} rows: {flagged} with a flag, {unweighted} with a weight of zero or less, {unselected} not selected, {missing} with missing numbers, {failed} with failed measurements, {above_one} with a distortion above 1)"
            )));
        }
        for k in 0..2 {
            let ranges = self.about.catalogues.iter().filter(|c| c.rows > 0);
            let (low, high) = ranges.fold((f64::MAX, f64::MIN), |(low, high), c| {
                let own = c.ellipticity[k];
                (low.min(own.low), high.max(own.high))
            });
            if used > 1 && low == high {
                return Err(BiasFailure::Data(format!(
                    "e{} is {low} in all {used} rows (expected different values)",
                    k + 1
                )));
            }
        }
        Ok(())
    }
}

/// Significance at which an implausible slope is refused, and at which the slope of e2 determines the sign of g2: a slope
/// of 0 exceeds it by chance in 6 of 10⁷ cases.
const SIGNIFICANT: f64 = 5.0;

/// g2/g1 of the true shears, if it is the same in all catalogues: slopes on g1 and g2 then do not tell e1 from e2.
fn ratio(catalogues: &[Catalogue]) -> Option<f64> {
    let used = catalogues.iter().filter(|catalogue| catalogue.rows > 0);
    let ratios = used.map(|catalogue| {
        let [g1, g2] = catalogue.shear.map(Range::constant);
        Some(g2? / g1?).filter(|ratio| ratio.is_finite() && *ratio != 0.0)
    });
    let ratios: Vec<f64> = ratios.collect::<Option<_>>()?;
    let first = *ratios.first()?;
    ratios
        .iter()
        .all(|ratio| (ratio / first - 1.0).abs() < 1e-6)
        .then_some(first)
}

/// Largest relative difference of slopes from those of exchanged components: a bias of the shapes.
const BIASED: f64 = 0.3;

/// Whether e1 follows g2, and e2 follows g1.
fn are_exchanged(all: &Estimate, ratio: Option<f64>) -> bool {
    let known = |key: &str| all.value(key).filter(|found| found.error.is_finite());
    let Some([m1, m2]) = known("m1").zip(known("m2")).map(<[_; 2]>::from) else {
        return false;
    };
    let cross = ["m12", "m21"]
        .map(|key| known(key).is_some_and(|found| found.value - SIGNIFICANT * found.error > 0.5));
    let lost = [m1, m2].map(|m| m.value + SIGNIFICANT * m.error < -0.5);
    if cross == [true; 2] && lost == [true; 2] {
        return true;
    }
    // All shears lie on one line: the slopes are g2/g1 and g1/g2.
    let Some(ratio) = ratio else {
        return false;
    };
    let expected = [(m1, ratio), (m2, 1.0 / ratio)];
    expected.iter().all(|(m, ratio)| {
        let like = ((1.0 + m.value) / ratio - 1.0).abs() < BIASED;
        // Neither the own component nor minus it.
        let clear = SIGNIFICANT * m.error;
        like && m.value.abs() > clear.max(BIASED) && (2.0 + m.value).abs() > clear
    })
}

/// What to try if e2 follows minus the true g2.
fn other_sign(sign: Option<Sign>) -> String {
    match sign {
        None
        | Some(Sign {
            basis: SignBasis::Zero,
            ..
        }) => "--truth-sign challenge (of folders: truth_sign in layout.toml of the data)".into(),
        Some(sign) if sign.basis == SignBasis::Stated => format!(
            "check the sign of e2, or the statement `{}` in the truth",
            word(sign.of)
        ),
        Some(sign) => format!(
            "check the sign of e2, or --truth-sign {}",
            word(match sign.of {
                TruthSign::Standard => TruthSign::Challenge,
                TruthSign::Challenge => TruthSign::Standard,
            })
        ),
    }
}

/// Refuses ellipticities that follow minus the true shear, or do not follow it, and distortions without responses. `ratio`
/// is g2/g1 of the true shears, if it is constant.
fn check_slopes(
    all: &Estimate,
    response: bool,
    ratio: Option<f64>,
    sign: Option<Sign>,
) -> Result<(), BiasFailure> {
    let slopes = ["m1", "m2"].map(|key| {
        let m = all.value(key).filter(|m| m.error.is_finite())?;
        Some((1.0 + m.value, SIGNIFICANT * m.error))
    });
    let negative = slopes.map(|slope| slope.is_some_and(|(slope, error)| slope + error < 0.0));
    let shown = |k: usize| slopes[k].map_or(f64::NAN, |(slope, _)| slope);
    let refused = |text: String| Err(BiasFailure::Data(text));
    if are_exchanged(all, ratio) {
        return refused(format!(
            "e1 follows the true g2, and e2 the true g1 (found slopes of {:.3} and {:.3} on the own component, expected about 1): e1 and e2 are probably exchanged. Try: --columns with the names exchanged",
            shown(0),
            shown(1)
        ));
    }
    match negative {
        [false, false] => {}
        [false, true] => {
            return refused(format!(
                "e2 follows minus the true g2 (found a slope of {:.3}, expected about 1). Try: {}",
                shown(1),
                other_sign(sign)
            ));
        }
        [true, _] => {
            return refused(format!(
                "e1 follows minus the true g1 (found a slope of {:.3}, expected about 1). Try: check the sign of the truth",
                shown(0)
            ));
        }
    }
    let known = || slopes.iter().flatten();
    // A response below 0.1 is no calibration error: rows and true shears do not belong together.
    if known().count() > 0 && known().all(|(slope, error)| slope + error < 0.1) {
        return refused(format!(
            "the ellipticities do not follow the true shear (found slopes of {:.3} and {:.3}, expected about 1). Try: check the order of the rows and of e1 and e2, or join by id",
            shown(0),
            shown(1)
        ));
    }
    // A distortion responds by 2 (1 − ⟨χ²⟩/2), which is 1.6 to 2 for galaxies.
    let like = |(slope, error): &(f64, f64)| (1.5..2.1).contains(slope) && slope - error > 1.3;
    if !response && known().count() > 0 && known().all(like) {
        return refused(format!(
            "the ellipticities look like distortions (found slopes of {:.3} and {:.3}, expected about 1). Try: --ellipticity distortion, or --ellipticity shear to keep them",
            shown(0),
            shown(1)
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_contain_their_lower_edges_and_the_last_its_upper_edge() {
        let edges = [1.0, 2.0, 4.0];
        let bins = [0.5, 1.0, 1.9, 2.0, 4.0, 4.1].map(|value| bin_of(&edges, value));
        assert_eq!(bins, [2, 0, 0, 1, 1, 2].map(Some));
        assert_eq!(bin_of(&[], 3.0), Some(0));
        assert_eq!(bin_of(&edges, f64::INFINITY), None);
    }
}
