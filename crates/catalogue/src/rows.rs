//! Rows of shear catalogues of any program: checks of their numbers, and the shape, response, weight and true shear that each
//! row adds to the sums of the bias.

use std::borrow::Cow;
use std::collections::HashSet;
use std::path::Path;

use shearq_bias::{Catalogue, Row};
use shearq_files::frames::polars::{DataFrame, DataType};
use shearq_files::frames::reals;
use shearq_files::table::{self, FileFormat};
use shearq_files::{FileError, names_of};
use shearq_quantities::{Distortion, MeasuredRange};

use crate::expression::{Operand, RADIANS, Texts, operand_values, refuse_long_integers, texts_of};
use crate::failures::{
    Check, Copies, LargestResponse, MIN_FAILED_WEIGHT, RepeatKind, Repeats, TrueShears, shown,
};
use crate::shapes::MeasuredShapes;
use crate::star_noise;

use crate::columns::{Shapes, counted_value};
use crate::identity;
use crate::request::{Input, MAX_AXES, Placed};
use crate::roles::{CATALOGUES, RESPONSES, Role, sheared_pair};
use crate::source::{Reading, Source};
use crate::steps::catalogue_named;
use crate::truth::{OfRows, RADIUS, check};

/// A row that counts, in the catalogue without artificial shear or in a sheared one.
#[derive(Debug)]
pub struct SummedRow {
    /// The key of its unit.
    pub key: u64,
    /// The identifier of the galaxy, or the number of the row.
    pub galaxy: u64,
    /// Index of the sheared catalogue that the row belongs to, 0 for noshear.
    pub sheared: usize,
    pub row: Row,
    pub selected: Selected,
    // The place of its true shear in a table by positions.
    place: Option<usize>,
}

impl SummedRow {
    /// The sheared catalogues (from 1) to whose means the row adds its ellipticity, with its weight in each: its own, or if its
    /// columns choose galaxies in each sheared catalogue (`selects`), all that choose it. The ellipticities without artificial
    /// shear of the galaxies that a sheared catalogue selects, with its weights, give the selection response R_S of Sheldon &
    /// Huff (2017, ApJ 841, 24). It needs all four catalogues, because a cut by S/N responds to both components.
    pub fn in_sheared(&self, selects: bool) -> impl Iterator<Item = (usize, f64)> + '_ {
        let counts = |catalogue: usize| self.selected.of(catalogue).binned.is_ok();
        let own = (self.sheared > 0 && counts(0)).then_some((self.sheared, self.row.weight));
        let last = match selects && self.sheared == 0 {
            true => CATALOGUES,
            false => 1,
        };
        let chosen = (1..last).filter(move |catalogue| counts(*catalogue));
        own.into_iter()
            .chain(chosen.map(|catalogue| (catalogue, self.selected.of(catalogue).weight)))
    }
}

/// Whether a row counts in noshear and in each sheared catalogue, by its flags, weights, `--where` and `--bins`. A shear may move
/// a galaxy over a cut, which is the response of the selection.
#[derive(Debug)]
pub struct Selected {
    noshear: Choice,
    // Without columns of their own, all sheared catalogues select the same rows.
    sheared: Option<Box<[Choice; CATALOGUES - 1]>>,
}

/// Whether a row counts in one catalogue, and its weight there.
#[derive(Debug)]
pub struct Choice {
    /// The binned quantities if the row is selected: 0 without bins, NaN if a number is missing.
    pub binned: Result<[f64; MAX_AXES], Exclusion>,
    pub weight: f64,
}

impl Selected {
    /// The choice in noshear (0) or a sheared catalogue.
    pub fn of(&self, catalogue: usize) -> &Choice {
        match (&self.sheared, catalogue.checked_sub(1)) {
            (Some(all), Some(sheared)) => &all[sheared],
            _ => &self.noshear,
        }
    }

    fn is_somewhere(&self) -> bool {
        let sheared = self.sheared.iter().flat_map(|all| all.iter());
        self.noshear.binned.is_ok() || sheared.into_iter().any(|own| own.binned.is_ok())
    }
}

/// Why a row does not count.
#[derive(Debug, Clone, Copy)]
pub enum Exclusion {
    Flagged,
    Unweighted,
    Unselected,
    // A number stands for a failed measurement.
    Failed,
    // A distortion above 1 has no shear.
    AboveOne,
    // NaN or infinity, or no true shear.
    Missing,
}

// Why a row gives no galaxy: it is left out, or the message and the hint with which the command ends.
enum Rejected {
    Excluded(Exclusion),
    Invalid(String, Option<String>),
}

impl From<Exclusion> for Rejected {
    fn from(reason: Exclusion) -> Self {
        Rejected::Excluded(reason)
    }
}

impl From<String> for Rejected {
    fn from(message: String) -> Self {
        Rejected::Invalid(message, None)
    }
}

// Share of the sum of the response that makes a detection doubtful. Sums over the pixels of bright galaxies are 4 % of those of 1000 rows,
// which is no reason to flag them.
const DOMINANT_DETECTION_SHARE: f64 = 0.1;

fn count(summary: &mut Catalogue, excluded: Exclusion) {
    *match excluded {
        Exclusion::Flagged => &mut summary.flagged,
        Exclusion::Unweighted => &mut summary.unweighted,
        Exclusion::Unselected => &mut summary.unselected,
        Exclusion::Failed => &mut summary.failed,
        Exclusion::AboveOne => &mut summary.above_one,
        Exclusion::Missing => &mut summary.missing,
    } += 1;
}

/// Calls `take` for each row of a user's catalogue that is neither flagged nor cut, and returns its counts and means.
pub fn rows(
    path: &Path,
    reading: &Reading<'_>,
    sources: &[Source],
    mut take: impl FnMut(&SummedRow),
) -> Result<Catalogue, FileError> {
    placed_rows(path, reading, sources, &mut |_, row| {
        row.into_iter().for_each(&mut take);
    })
}

/// As [`rows`], also with the rows without sheared ones that do not count, and the position of each if it is read.
pub fn placed_rows(
    path: &Path,
    reading: &Reading<'_>,
    sources: &[Source],
    // Not generic, so that the loop over the rows is compiled with what it calls.
    take: &mut dyn FnMut([f64; 2], Option<&SummedRow>),
) -> Result<Catalogue, FileError> {
    let mut summary = Catalogue {
        name: path.display().to_string(),
        ..Catalogue::default()
    };
    if let Some(first) = sources
        .first()
        .filter(|source| source.columns.is_of_shearq())
    {
        let path = &first.place.path;
        // Only in catalogues by shearq: other programs may use the same key for another quantity.
        summary.star = match (&first.frame, FileFormat::of(path)) {
            (Some(frame), _) => star_noise::of_table(frame, path),
            (None, Some(format)) => star_noise::of_catalogue(path, format)?,
            (None, None) => None,
        };
    }
    // Rows of noshear and of each sheared catalogue so far.
    let mut counts = [0u64; CATALOGUES];
    // Those that count.
    let mut used = [0u64; CATALOGUES];
    let mut found = Found::default();
    for source in sources {
        let (mut first, mut checks) = (0, None::<Vec<Check>>);
        source.parts(reading, |frame| {
            let columns = columns_of(source, reading, &frame)?;
            let columns: Vec<&[f64]> = columns.iter().map(AsRef::as_ref).collect();
            let part = TableRows::new(source, reading, (&frame, &columns), (path, first))?;
            // Ranges follow from the first part, so that a file is judged in the same way however it is split.
            let checks = part.failed(checks.get_or_insert_with(|| part.checks()));
            found.look_for(&part);
            for at in 0..part.rows {
                let sheared = part.sheared(at);
                let index = counts[sheared];
                counts[sheared] += 1;
                let selected = part.select(at);
                let mut excluded = selected.noshear.binned.err();
                let mut item = None;
                if selected.is_somewhere() {
                    match part.galaxy(at, index, selected, &checks) {
                        Ok(own) => {
                            if sheared == 0 {
                                for k in 0..2 {
                                    summary.shear[k].add(own.row.g[k]);
                                    summary.ellipticity[k].add(own.row.e[k]);
                                }
                                let [a, b] = own.row.e;
                                for (count, limit) in summary.beyond.iter_mut().zip([1.0, 2.0]) {
                                    *count += u64::from(a * a + b * b > limit * limit);
                                }
                                if excluded.is_none() {
                                    found.add(&part, at, (first + at + 1) as u64, &own);
                                }
                            }
                            used[sheared] += u64::from(excluded.is_none());
                            item = Some(own);
                        }
                        // A row counts for its first reason.
                        Err(Rejected::Excluded(reason)) => _ = excluded.get_or_insert(reason),
                        Err(Rejected::Invalid(what, hint)) => {
                            let row = first + at + 1;
                            let message = format!("row {row}: {what}");
                            return Err(FileError::new(&source.place.path, message).hint_if(hint));
                        }
                    }
                }
                if let Some(reason) = excluded.filter(|_| sheared == 0) {
                    count(&mut summary, reason);
                }
                if item.is_some() || sheared == 0 {
                    take(part.position(at), item.as_ref());
                }
            }
            first += part.rows;
            Ok(())
        })?;
    }
    summary.rows = counts[0];
    if sources.iter().any(Source::has_sheared_rows) {
        require_sheared(path, &counts)?;
        if used[0] >= MIN_UNSHEARED {
            require_sheared(path, &used)?;
        }
    }
    if let Some(first) = sources.first() {
        check_share(path, first, reading, &summary)?;
        found.refuse_sheared_rows(path, first)?;
        found.refuse_unused_cuts(path, first)?;
        found.refuse_measured_shears(path, first, reading)?;
        found.refuse_shared_truths(path)?;
        summary.repeated = found.repeats.found();
        let dominant = found.largest.found();
        summary.dominant =
            dominant.filter(|own| !first.of_detections || own.share > DOMINANT_DETECTION_SHARE);
        summary.content = found.content;
        summary.unmatched = found.unmatched(first);
        summary.copies = found.copies.rows().unwrap_or_default();
        summary.shared_identifiers = found.copies.identifiers().unwrap_or_default();
    }
    Ok(summary)
}

const E_ROLES: [Role; 2] = [Role::E1, Role::E2];
const PSF_ROLES: [Role; 2] = [Role::Psf1, Role::Psf2];
const RESPONSE_ROLES: [Role; 2] = [Role::R11, Role::R22];
const CROSS_RESPONSE_ROLES: [Role; 2] = [Role::R12, Role::R21];
const WEIGHT_DERIVATIVE_ROLES: [Role; 2] = [Role::Dw1, Role::Dw2];
const KSB_ROLES: [Role; 2] = [Role::KsbE1, Role::KsbE2];

// Programs write 1e20, 1e30 or the largest float for a failure.
const MIN_FAILED_NUMBER: f64 = 1e20;
// Values of a column that determine its range. A sample is enough for an order of magnitude. Chosen by hand.
const SAMPLED_VALUES: usize = 1 << 16;

struct TableRows<'a> {
    source: &'a Source,
    reading: &'a Reading<'a>,
    rows: usize,
    columns: &'a [&'a [f64]],
    weighted: Option<MeasuredShapes>,
    e: [usize; 2],
    // Columns of roles, if they are there.
    ksb: Option<[usize; 2]>,
    dw: Option<[usize; 2]>,
    psf: Option<[usize; 2]>,
    psf_size: Option<usize>,
    calibration: [Option<usize>; 3],
    // In noshear and in each sheared catalogue.
    weights: [Option<usize>; CATALOGUES],
    // Whether `--where` or `--bins` has columns.
    chooses: bool,
    places: Option<[usize; 2]>,
    // Whose numbers tell rows apart.
    compared: Vec<usize>,
    // Of each sheared catalogue, if its distortions are converted.
    converted: Option<[[usize; 2]; CATALOGUES - 1]>,
    responses: [[Response; 2]; 2],
    // Of the responses, in the axes of e1 and e2.
    signs: [[f64; 2]; 2],
    dw_signs: [f64; 2],
    c_signs: [f64; 2],
    psf_signs: [f64; 2],
    sheared_of_rows: Option<Vec<usize>>,
    // The sheared catalogue of the axes of e1 and e2, of each of the table.
    of_axes: [usize; CATALOGUES],
    frame: &'a DataFrame,
    ids: Option<Vec<u64>>,
    // Rows without an identifier or unit, if they are left out.
    unnamed: Vec<bool>,
    ids_are_units: bool,
    units: Option<Vec<u64>>,
    truth: OfRows<'a>,
}

// Where an element of the response of an ellipticity comes from.
enum Response {
    Known(f64),
    Column(usize),
    // The number in rows where the column is NaN: configurations of networks have no response.
    ColumnOr(usize, f64),
    // (e₊ − e₋)/2h of two sheared catalogues.
    Difference([usize; 2]),
}

// NaN counts as a weight, so that a later check refuses it instead of dropping the row silently.
fn has_weight(weight: f64) -> bool {
    weight.is_nan() || weight > 0.0
}

// The numbers of each wanted column; none of texts.
fn columns_of<'f>(
    source: &Source,
    reading: &Reading<'_>,
    frame: &'f DataFrame,
) -> Result<Vec<Cow<'f, [f64]>>, FileError> {
    let doubtful = source.places.all((Role::DoubtfulWeight, 0));
    let mut columns = Vec::new();
    for (place, wanted) in source.wanted.iter().enumerate() {
        let is_text = wanted.texts.is_none() && source.is_text(reading, &wanted.column);
        columns.push(match doubtful.contains(&place) {
            // Texts are no weights: `WEIGHT_IMAGE` may have names of files.
            true if texts_of(frame, &wanted.column).is_some() => {
                Cow::Owned(vec![1.0; frame.height()])
            }
            false if is_text => Cow::Borrowed(&[][..]),
            _ => operand_values(frame, wanted, &source.place.path)?,
        });
    }
    Ok(columns)
}

impl<'a> TableRows<'a> {
    fn new(
        source: &'a Source,
        reading: &'a Reading<'a>,
        (frame, columns): (&'a DataFrame, &'a [&'a [f64]]),
        // The rows of the file before these.
        (file, before): (&Path, usize),
    ) -> Result<Self, FileError> {
        let (path, places) = (&source.place.path, &source.places);
        let truth = OfRows::new(file, places, &reading.truth)?;
        check_angles(source, reading, columns)?;
        if let Some(condition) = reading.condition() {
            refuse_long_integers(frame, &condition.exact_columns(), condition, path)?;
        }
        for binned in reading.binned() {
            let mut exact = binned.exact_columns();
            exact.extend(binned.column());
            refuse_long_integers(frame, &exact, binned, path)?;
        }
        refuse_boolean_flags(frame, source, reading)?;
        let drops = reading.request.drop_missing;
        let mut unnamed = Vec::new();
        let mut keys = |name: &str| {
            if !drops {
                return identity::keys(frame, name, path);
            }
            let missing = identity::missing(frame, name);
            unnamed.resize(missing.len(), false);
            let both = unnamed.iter_mut().zip(missing);
            both.for_each(|(own, more)| *own |= more);
            identity::keys_or_zero(frame, name, path)
        };
        let ids = source.columns.of(Role::Id).map(&mut keys).transpose()?;
        let units = source.unit.as_deref().map(&mut keys).transpose()?;
        let sheared_of_rows = source.columns.of(Role::ShearedCatalogue);
        let sheared_of_rows = sheared_of_rows.map(|name| sheared_of(frame, name, path));
        let weighted = reading.weights().map(|selection| -> Result<_, FileError> {
            let column = |name: &str| table::numbers(frame, name, path);
            let mut shapes = MeasuredShapes::of(column, true)?;
            shapes.weigh(path, before, selection, column)?;
            Ok(shapes)
        });
        Ok(TableRows {
            weighted: weighted.transpose()?,
            rows: frame.height(),
            columns,
            e: places.pair(E_ROLES).unwrap_or_default(),
            ksb: places.pair(KSB_ROLES),
            dw: places.pair(WEIGHT_DERIVATIVE_ROLES),
            psf: places.pair(PSF_ROLES),
            psf_size: places.of((Role::PsfSize, 0)),
            calibration: [Role::M, Role::C1, Role::C2].map(|role| places.of((role, 0))),
            weights: std::array::from_fn(|sheared| {
                let own = places.of((Role::Weight, sheared));
                own.or_else(|| places.of((Role::Weight, 0)))
            }),
            chooses: reading.condition().is_some() || reading.binned().next().is_some(),
            places: places.pair([Role::X, Role::Y]),
            converted: converted_columns(source),
            compared: ([Role::E1, Role::E2, Role::Weight, Role::R11].iter())
                .chain(&KSB_ROLES)
                .filter_map(|role| places.of((*role, 0)))
                .collect(),
            signs: response_signs(source),
            dw_signs: WEIGHT_DERIVATIVE_ROLES.map(|role| source.sign_of(role)),
            c_signs: [Role::C1, Role::C2].map(|role| source.sign_of(role)),
            psf_signs: PSF_ROLES.map(|role| source.sign_of(role)),
            responses: responses(source),
            sheared_of_rows: sheared_of_rows.transpose()?,
            of_axes: std::array::from_fn(|catalogue| source.of_axes(catalogue)),
            ids,
            unnamed,
            ids_are_units: source.unit.as_deref() == source.columns.of(Role::Id),
            units,
            source,
            reading,
            frame,
            truth,
        })
    }

    fn value(&self, column: usize, at: usize) -> f64 {
        self.columns[column][at]
    }

    fn pair(&self, columns: [usize; 2], at: usize) -> [f64; 2] {
        columns.map(|column| self.columns[column][at])
    }

    fn signed(&self, columns: [usize; 2], signs: [f64; 2], at: usize) -> [f64; 2] {
        [0, 1].map(|k| signs[k] * self.value(columns[k], at))
    }

    fn of(&self, role: Role) -> Option<usize> {
        self.source.places.of((role, 0))
    }

    fn position(&self, at: usize) -> [f64; 2] {
        self.places
            .map_or([f64::NAN; 2], |columns| self.pair(columns, at))
    }

    fn roles(&self, roles: [Role; 2]) -> Option<[usize; 2]> {
        self.source.places.pair(roles)
    }

    fn range(&self, columns: &[usize]) -> MeasuredRange {
        let stride = (columns.len() * self.rows).div_ceil(SAMPLED_VALUES).max(1);
        let values = columns
            .iter()
            .flat_map(|column| self.columns[*column].iter().step_by(stride).copied());
        MeasuredRange::from_values(&values.collect::<Vec<_>>())
    }

    // The first check that a row fails is reported, so that causes come before consequences.
    fn checks(&self) -> Vec<Check> {
        let (source, mut checks) = (self.source, Vec::new());
        let mut add = |columns: &[usize], expected, range, fails| {
            checks.extend(columns.iter().map(|&column| Check {
                column,
                expected,
                range,
                fails,
            }));
        };
        let shear = MeasuredRange::ELLIPTICITY;
        let pair = |roles: [Role; 2]| self.roles(roles).map_or(vec![], Vec::from);
        let range = |columns: &[usize]| match columns {
            [] => shear,
            columns => self.range(columns),
        };
        let measured: fn(f64, MeasuredRange) -> bool = |value, range| range.excludes(value);
        let sheared = sheared_columns(source);
        // With a response, ellipticities may have any scale, which cancels in the ratio.
        let any_unit = self.roles(RESPONSE_ROLES).is_some()
            || sheared[0].is_some()
            || source.has_sheared_rows();
        let range_e = range(if any_unit { &self.e } else { &[] });
        let sheared: Vec<usize> = sheared.into_iter().flatten().flatten().flatten().collect();
        let expected = "an ellipticity";
        add(&self.e, expected, range_e, measured);
        add(&sheared, expected, range_e, measured);
        // Distortions are below 1 and so is their scatter. Without noise, sigma is zero.
        if source.shapes == Shapes::Responsivity {
            let expected = "a standard deviation, above 0 and at most 1";
            let (rms, sigma) = (self.of(Role::RmsE), self.of(Role::SigmaE));
            add(rms.as_slice(), expected, shear, |rms, range| {
                rms <= 0.0 || rms > 1.0 || range.excludes(rms)
            });
            let sigma = sigma.filter(|_| rms.is_none());
            let expected = "a standard deviation of noise";
            add(sigma.as_slice(), expected, shear, |sigma, range| {
                sigma < 0.0 || range.excludes(sigma)
            });
        }
        let failures = source.places.all((Role::ShearedFailure, 0));
        let expected = "0, as in sheared catalogues that were measured";
        add(failures, expected, shear, |flag, _| flag != 0.0);
        for sheared in 1..CATALOGUES {
            let weights = source.places.all((Role::Weight, sheared));
            add(weights, "a weight", shear, |weight, _| {
                weight.is_nan() || weight >= MIN_FAILED_WEIGHT
            });
        }
        let range_r = range(&pair(RESPONSE_ROLES));
        add(&pair(RESPONSE_ROLES), "a response", range_r, measured);
        add(&pair(CROSS_RESPONSE_ROLES), "a response", range_r, measured);
        let derivative = pair(WEIGHT_DERIVATIVE_ROLES);
        add(&derivative, "a derivative", range(&derivative), measured);
        let expected = "an ellipticity of a PSF, below 1";
        add(&pair(PSF_ROLES), expected, shear, |e, _| e.abs() >= 1.0);
        let size = source.places.all((Role::PsfSize, 0));
        let expected = "a size of a PSF, above 0";
        add(size, expected, range(size), |size, range| {
            size <= 0.0 || range.excludes(size)
        });
        // Bins of −99 or 1e20 would be bins of failures. Other large numbers are fluxes of bright galaxies.
        for column in self.binned_columns() {
            let expected = "a number that can be binned";
            add(&[column], expected, range(&[column]), |value, range| {
                value < 0.0 && range.excludes(value) || value.abs() >= MIN_FAILED_NUMBER
            });
        }
        let weight = source.places.all((Role::Weight, 0));
        add(weight, "a weight", range(weight), |weight, range| {
            // Infinity is reported as such.
            weight.is_finite() && weight >= MIN_FAILED_WEIGHT || range.excludes_mark(weight)
        });
        checks
    }

    // The checks that a row of this part may fail: few columns have a number for failures. A row may take its shape from other
    // columns than those of the checks.
    fn failed<'c>(&self, checks: &'c [Check]) -> Vec<&'c Check> {
        let fails = |own: &&Check| self.ksb.is_some() || own.fails_in(self.columns[own.column]);
        checks.iter().filter(fails).collect()
    }

    // Columns of numbers that are binned.
    fn binned_columns(&self) -> Vec<usize> {
        let places = self.source.places.all((Role::Binned, 0)).iter().copied();
        let numbers = places.filter(|place| self.source.wanted[*place].texts.is_none());
        numbers.collect()
    }

    // What is looked for in the columns.
    fn repeats(&self) -> Repeats {
        let source = self.source;
        let mut all = Repeats::default();
        let name = |column: usize| source.name(column).to_owned();
        let mut watch = |kind, columns: [usize; 2]| all.watch(kind, columns, columns.map(name));
        watch(RepeatKind::Ellipticities, self.e);
        for roles in [RESPONSE_ROLES, PSF_ROLES] {
            if let Some(own) = self.roles(roles) {
                watch(RepeatKind::Zeros, own);
            }
        }
        if source.columns.is_of_shearq() {
            return all;
        }
        let mut numbers = |columns: &[usize], or_zero| {
            let kind = RepeatKind::Number { or_zero };
            columns.iter().for_each(|column| watch(kind, [*column; 2]));
        };
        if self.ksb.is_none() {
            numbers(&self.e, true);
        }
        numbers(self.roles(RESPONSE_ROLES).as_slice().as_flattened(), true);
        let sheared = sheared_columns(source).into_iter().flatten().flatten();
        numbers(&sheared.flatten().collect::<Vec<_>>(), true);
        let no_rms = source.shapes == Shapes::Responsivity && self.of(Role::RmsE).is_none();
        let sigma = self.of(Role::SigmaE).filter(|_| no_rms);
        numbers(sigma.as_slice(), true);
        numbers(&self.binned_columns(), true);
        let derivatives = self.roles(WEIGHT_DERIVATIVE_ROLES);
        numbers(derivatives.as_slice().as_flattened(), false);
        all
    }

    // The columns of the ellipticity of a row. GalSim's HSM writes −10 into those that its method does not determine.
    fn shape_columns(&self, at: usize) -> [usize; 2] {
        match self.ksb {
            Some(ksb) if self.pair(self.e, at) == [-10.0, -10.0] => ksb,
            _ => self.e,
        }
    }

    fn failure<'c>(&self, at: usize, checks: &[&'c Check]) -> Option<(usize, &'c Check)> {
        let shape = self.shape_columns(at);
        let column_of = |check: &Check| match self.e.iter().position(|e| *e == check.column) {
            Some(k) => shape[k],
            None => check.column,
        };
        let mut checks = checks.iter().map(|check| (column_of(check), *check));
        checks.find(|(column, check)| (check.fails)(self.value(*column, at), check.range))
    }

    fn sheared(&self, at: usize) -> usize {
        let sheared_of_rows = self.sheared_of_rows.as_ref();
        let sheared = sheared_of_rows.map_or(self.source.sheared, |all| Some(all[at]));
        self.of_axes[sheared.unwrap_or(0)]
    }

    // A sheared catalogue may choose a row that is left out without shear: these rows are the response of the selection.
    fn select(&self, at: usize) -> Selected {
        let choice = |sheared: usize| self.choice(at, self.of_axes[sheared + 1]);
        let sheared = || Box::new(std::array::from_fn(choice));
        Selected {
            noshear: self.choice(at, 0),
            sheared: self.source.selects.then(sheared),
        }
    }

    fn choice(&self, at: usize, sheared: usize) -> Choice {
        let weight = self.weights[sheared].map_or(1.0, |column| self.value(column, at));
        let mut flags = self.source.places.all((Role::Flag, sheared)).iter();
        let selection = self.source.selection.map(|place| self.value(place, at));
        let is_left_out = selection.is_some_and(|weight| weight <= 0.0);
        // Smooth steps of `--where` are zero far below their threshold. Such a row would add zeros to all sums.
        let stepped = self.weighted.as_ref().map(|selection| selection.weight[at]);
        let is_outside = stepped.is_some_and(|weight| weight <= 0.0);
        let binned = if flags.any(|flag| self.value(*flag, at) != 0.0) {
            Err(Exclusion::Flagged)
        } else if !has_weight(weight) || is_left_out {
            Err(Exclusion::Unweighted)
        } else if self.chooses {
            let binned = self.binned(at, sheared).filter(|_| !is_outside);
            binned.ok_or(Exclusion::Unselected)
        } else if is_outside {
            Err(Exclusion::Unselected)
        } else {
            Ok([0.0; MAX_AXES])
        };
        Choice { binned, weight }
    }

    // The binned quantities in a sheared catalogue (0 for noshear) if `--where` selects the row; NaN if a number is missing.
    fn binned(&self, at: usize, sheared: usize) -> Option<[f64; MAX_AXES]> {
        let mut values = [0.0; MAX_AXES];
        // A sheared catalogue without the columns of the expression selects nothing.
        let mut selected = Some(true);
        if let Some(condition) = self.reading.condition() {
            let places = self.source.places.all((Role::Condition, sheared));
            let places = (places.len() == condition.operands().len()).then_some(places)?;
            selected = condition.holds(&|k| self.value(places[k], at));
        }
        if selected == Some(false) {
            return None;
        }
        let mut places = self.source.places.all((Role::Binned, sheared));
        for (own, expression) in values.iter_mut().zip(self.reading.binned()) {
            let (first, rest) = places.split_at_checked(expression.operands().len())?;
            *own = expression.value(&|k| self.value(first[k], at));
            if own.is_infinite() {
                return None;
            }
            places = rest;
        }
        Some(match selected {
            Some(_) => values,
            None => [f64::NAN; MAX_AXES],
        })
    }

    // The row, the `index`-th of its sheared catalogue, with its shape and its true shear.
    fn galaxy(
        &self,
        at: usize,
        index: u64,
        selected: Selected,
        checks: &[&Check],
    ) -> Result<SummedRow, Rejected> {
        if self.is_unmeasured(at) || self.unnamed.get(at) == Some(&true) {
            return Err(Exclusion::Missing.into());
        }
        self.check_unused_weight(at)?;
        self.check_failures(at, checks)?;
        let weight = self.weighted.as_ref().map(|selection| selection.weight[at]);
        let weight = weight.unwrap_or(selected.noshear.weight);
        let mut row = self.measured(at, weight)?;
        self.check_numbers(&row, &selected)?;
        // After the cuts, because a table of true shears may lack galaxies that are cut.
        let place;
        (row.g, place) = self.truth(at)?;
        check(row.g)?;
        if self.reading.flip_g2 {
            row.g[1] = -row.g[1];
        }
        Ok(SummedRow {
            key: self.key(at, index),
            galaxy: self.ids.as_ref().map_or(index, |ids| ids[at]),
            sheared: self.sheared(at),
            row,
            selected,
            place,
        })
    }

    // Galaxies on a grid have a row also without an ellipticity.
    fn is_unmeasured(&self, at: usize) -> bool {
        let is_none = |placed: Placed| {
            let e = self.pair(self.shape_columns(at), at);
            let is_larger = |most: f64| e[0].hypot(e[1]) > most.max(1.0);
            e.iter()
                .any(|e| !e.is_finite() || placed.missing == Some(*e))
                || placed.max_modulus.is_some_and(is_larger)
        };
        self.reading.request.placed.is_some_and(is_none)
    }

    // Without it, galaxies that another program excludes by a weight of zero would count fully.
    fn check_unused_weight(&self, at: usize) -> Result<(), Rejected> {
        let weights = self.source.places.all((Role::DoubtfulWeight, 0)).iter();
        let mut weights = weights.map(|place| (self.source.name(*place), self.value(*place, at)));
        match weights.find(|(_, value)| !(*value > 0.0 && *value < MIN_FAILED_WEIGHT)) {
            None => Ok(()),
            Some((name, value)) => Err(Rejected::Invalid(
                format!(
                    "`{name}` looks like a weight but is not used, and is {} here, so that this galaxy would count wrongly",
                    shown(value)
                ),
                Some(format!("--columns w={name}, or w=none")),
            )),
        }
    }

    fn check_failures(&self, at: usize, checks: &[&Check]) -> Result<(), Rejected> {
        let Some((column, check)) = self.failure(at, checks) else {
            return Ok(());
        };
        if self.reading.request.drop_missing {
            return Err(Exclusion::Failed.into());
        }
        let value = self.value(column, at);
        let mut of_psf = [Role::Psf1, Role::Psf2, Role::PsfSize].into_iter();
        let of_psf = of_psf.any(|role| self.of(role) == Some(column));
        // A PSF of 2 in all rows is another quantity, rather than a failure in each.
        let all_equal = || self.columns[column].iter().all(|other| *other == value);
        let remedy = match of_psf && all_equal() {
            true => "--columns psf_e1=none,psf_e2=none,psf_size=none".to_owned(),
            false => self.remedy_for_failures(),
        };
        let message = format!(
            "column `{}` is {} in a row without a flag, which stands for a failed measurement (expected {})",
            self.source.name(column),
            shown(value),
            check.expected
        );
        Err(Rejected::Invalid(message, Some(remedy)))
    }

    // A column that looks like a flag comes first, because it also excludes failures whose numbers look like measurements.
    fn remedy_for_failures(&self) -> String {
        let choice = self.source.columns.remedy_of_choice();
        let choice = choice.map(|choice| format!("{choice}, or "));
        choice.unwrap_or_default() + "--drop-missing"
    }

    // A row with a true shear of zero.
    fn measured(&self, at: usize, weight: f64) -> Result<Row, Exclusion> {
        let (e, response) = self.shape(at, weight).ok_or(Exclusion::AboveOne)?;
        let (e, response) = self.calibrated(at, weight, e, response);
        Ok(Row {
            e,
            weight,
            response,
            g: [0.0; 2],
            psf: self
                .psf
                .map_or([0.0; 2], |psf| self.signed(psf, self.psf_signs, at)),
            psf_size: self
                .psf_size
                .map_or(1.0, |size| match self.source.psf_area {
                    true => self.value(size, at).sqrt(),
                    false => self.value(size, at),
                }),
        })
    }

    fn check_numbers(&self, row: &Row, selected: &Selected) -> Result<(), Rejected> {
        let [[r11, r12], [r21, r22]] = row.response;
        let binned = selected.noshear.binned.unwrap_or_default();
        // One number that is not finite makes the sum so.
        let sums = [
            row.e[0] + row.e[1] + row.weight,
            r11 + r22 + r12 + r21,
            row.psf[0] + row.psf[1] + row.psf_size,
            binned.iter().sum(),
        ];
        if sums.iter().sum::<f64>().is_finite() {
            return Ok(());
        }
        // A calibration is multiplied by the weight, so that the weight comes first.
        let checked = [
            ("the weight", row.weight),
            ("e1", row.e[0]),
            ("e2", row.e[1]),
            ("the response or its derivative", sums[1]),
            ("the PSF's ellipticity or size", sums[2]),
            ("the expression of --where or --bins", sums[3]),
        ];
        match checked.iter().find(|(_, value)| !value.is_finite()) {
            None => Ok(()),
            Some(_) if self.reading.request.drop_missing => Err(Exclusion::Missing.into()),
            Some((what, value)) => {
                let expected = match value.is_nan() {
                    true => "a number",
                    false => "a finite number",
                };
                let message =
                    format!("{what} is {value} in a row without a flag (expected {expected})");
                Err(Rejected::Invalid(message, Some(self.remedy_for_failures())))
            }
        }
    }

    // With the calibration of a survey, so that the mean shear is that of e − R c over R (1 + m), as HSC defines its m and c
    // (Mandelbaum et al. 2018, PASJ 70, S25, equation A6).
    fn calibrated(
        &self,
        at: usize,
        weight: f64,
        mut e: [f64; 2],
        mut response: [[f64; 2]; 2],
    ) -> ([f64; 2], [[f64; 2]; 2]) {
        let [m, c1, c2] = self.calibration.map(|place| Some(self.value(place?, at)));
        for (j, c) in [c1, c2].into_iter().enumerate() {
            if let Some(c) = c {
                let c = self.c_signs[j] * c;
                e = [0, 1].map(|i| e[i] - response[i][j] / weight * c);
            }
        }
        if let Some(m) = m {
            response = response.map(|row| row.map(|own| own * (1.0 + m)));
        }
        (e, response)
    }

    // The ellipticity, and the response of the weighted ellipticity; `None` for a distortion without a shear.
    fn shape(&self, at: usize, weight: f64) -> Option<([f64; 2], [[f64; 2]; 2])> {
        if let Some(weighted) = &self.weighted {
            // Sums multiply by the weight, which these ellipticities contain already, so it is divided out.
            let e = weighted.e[at].map(|e| e / weight);
            return Some((e, weighted.response[at]));
        }
        let columns = self.shape_columns(at);
        let mut e = self.pair(columns, at);
        let dw = self.dw;
        let dw = dw.map_or([0.0; 2], |dw| self.signed(dw, self.dw_signs, at));
        // d(w e_i)/dg_j = w R_ij + e_i dw/dg_j: weights of AnaCal change with shear.
        let weighted = |e: [f64; 2], response: [[f64; 2]; 2]| {
            [0, 1].map(|i| [0, 1].map(|j| weight * response[i][j] + e[i] * dw[j]))
        };
        match self.source.shapes {
            // KSB's are shears.
            _ if columns != self.e => {}
            Shapes::Converted => e = converted(e)?,
            Shapes::Shear => {}
            Shapes::Responsivity => {
                let value = |role| self.of(role).map(|place| self.value(place, at));
                let square = match (value(Role::RmsE), value(Role::SigmaE)) {
                    (Some(rms), _) => rms * rms,
                    // ⟨χ²⟩ contains the noise of both components.
                    (None, sigma) => {
                        0.5 * (e[0] * e[0] + e[1] * e[1]) - sigma.map_or(0.0, |sigma| sigma * sigma)
                    }
                };
                let response = 2.0 * (1.0 - square);
                return Some((e, weighted(e, [[response, 0.0], [0.0, response]])));
            }
        }
        if self.source.has_sheared_rows() {
            // The response follows from the means of the sheared catalogues.
            return Some((e, [[0.0; 2]; 2]));
        }
        if let Some(sheared) = &self.converted {
            let mut all = [[0.0; 2]; CATALOGUES - 1];
            for (own, columns) in all.iter_mut().zip(sheared) {
                *own = converted(self.pair(*columns, at))?;
            }
            let step = 2.0 * self.reading.request.step();
            let of =
                |i: usize, j: usize| self.signs[i][j] * (all[2 * j][i] - all[2 * j + 1][i]) / step;
            return Some((e, weighted(e, [0, 1].map(|i| [0, 1].map(|j| of(i, j))))));
        }
        let of = |i: usize, j: usize| self.signs[i][j] * self.response(&self.responses[i][j], at);
        Some((e, weighted(e, [0, 1].map(|i| [0, 1].map(|j| of(i, j))))))
    }

    fn response(&self, of: &Response, at: usize) -> f64 {
        match *of {
            Response::Known(response) => response,
            Response::Column(column) => self.value(column, at),
            Response::ColumnOr(column, without) => match self.value(column, at) {
                missing if missing.is_nan() => without,
                response => response,
            },
            Response::Difference([plus, minus]) => {
                (self.value(plus, at) - self.value(minus, at)) / (2.0 * self.reading.request.step())
            }
        }
    }

    // The true shear, and its place in a table by positions.
    fn truth(&self, at: usize) -> Result<([f64; 2], Option<usize>), Rejected> {
        let found = match self.truth {
            OfRows::Constant(shear) => Ok((shear, None)),
            OfRows::Identifiers(galaxies) => {
                let key = self.ids.as_ref().and_then(|ids| galaxies.get(&ids[at]));
                key.map(|shear| (*shear, None)).ok_or_else(|| {
                    let name = self.source.columns.of(Role::Id).unwrap_or_default();
                    let id = identity::text(self.frame, name, at);
                    let message =
                        format!("the table of true shears does not contain the identifier {id}");
                    Rejected::from(message)
                })
            }
            OfRows::Positions(positions, columns) => {
                let [x, y] = self.pair(columns, at);
                let found = positions.at([x, y]).ok_or_else(|| {
                    let message = format!("the table of true shears has no galaxy within {RADIUS} pixel of x = {x}, y = {y}");
                    let hint = "check whether positions begin with 0 or 1, or --drop-missing";
                    Rejected::Invalid(message, Some(hint.to_owned()))
                });
                found.map(|(place, shear)| (shear, Some(place)))
            }
            OfRows::Columns(columns) => Ok((self.pair(columns, at), None)),
        };
        let may_lack = self.reading.request.drop_missing && self.truth.may_lack_rows();
        found.map_err(|reason| match may_lack {
            true => Exclusion::Missing.into(),
            false => reason,
        })
    }

    // The key of the unit of a row, the `index`-th of its sheared catalogue.
    fn key(&self, at: usize, index: u64) -> u64 {
        let rotated_pairs = self.reading.rows_are_rotated_pairs();
        match (&self.units, &self.ids) {
            (Some(units), _) => units[at],
            (None, Some(ids)) if !rotated_pairs => ids[at],
            _ => index >> u32::from(rotated_pairs),
        }
    }
}

// Refuses angles in degrees in `--where` and `--bins`.
fn check_angles(
    source: &Source,
    reading: &Reading<'_>,
    columns: &[&[f64]],
) -> Result<(), FileError> {
    for expression in reading.condition().into_iter().chain(reading.binned()) {
        let place = |own: &Operand| source.wanted.iter().position(|known| known == own);
        let places: Option<Vec<usize>> = expression.operands().iter().map(place).collect();
        let Some(places) = places else { continue };
        let rows = places.first().map_or(0, |place| columns[*place].len());
        expression
            .check_angles(rows, |at, k| columns[places[k]][at])
            .map_err(|message| FileError::new(&source.place.path, message).hint(RADIANS))?;
    }
    Ok(())
}

// The columns of e1 and e2 under artificial shears of the same component, and of the other component, if all exist.
fn sheared_columns(source: &Source) -> [Option<[[usize; 2]; 2]>; 2] {
    [[0, 1], [1, 0]].map(|by| {
        let pair = |of: usize| {
            let [plus, minus] = sheared_pair(of, by[of]);
            Some([source.places.of(plus)?, source.places.of(minus)?])
        };
        Some([pair(0)?, pair(1)?])
    })
}

// The columns of both components in each sheared catalogue, if their distortions are converted like those of e1 and e2.
fn converted_columns(source: &Source) -> Option<[[usize; 2]; CATALOGUES - 1]> {
    let mut all = [[0; 2]; CATALOGUES - 1];
    for (catalogue, own) in (1..).zip(&mut all) {
        let [e1, e2] = E_ROLES.map(|role| source.places.of((role, catalogue)));
        *own = [e1?, e2?];
    }
    (source.shapes == Shapes::Converted).then_some(all)
}

// The shear of a distortion, if it has one. A missing number stays one.
fn converted(e: [f64; 2]) -> Option<[f64; 2]> {
    if !e.iter().all(|e| e.is_finite()) {
        return Some(e);
    }
    let shear = Distortion::new(e[0], e[1]).to_shear()?;
    Some([shear.e1, shear.e2])
}

// Where R11, R12, R21 and R22 come from: sheared catalogues, else columns, else the ellipticities are shears already.
fn responses(source: &Source) -> [[Response; 2]; 2] {
    let [own, other] = sheared_columns(source);
    let is_of_shearq = source.columns.is_of_shearq();
    let diagonal = source.places.pair(RESPONSE_ROLES).is_some();
    let off_diagonal = source.places.pair(CROSS_RESPONSE_ROLES).is_some();
    [0, 1].map(|i| {
        [0, 1].map(|j| {
            let (without, known) = if i == j {
                (1.0, diagonal)
            } else {
                (0.0, off_diagonal)
            };
            let column = source.places.of((RESPONSES[i][j], 0)).filter(|_| known);
            match (own, other) {
                (Some(own), _) if i == j => Response::Difference(own[i]),
                (Some(_), Some(other)) => Response::Difference(other[i]),
                (Some(_), None) => Response::Known(0.0),
                (None, _) => match column {
                    None => Response::Known(without),
                    Some(column) if is_of_shearq => Response::ColumnOr(column, without),
                    Some(column) => Response::Column(column),
                },
            }
        })
    })
}

// The signs of responses in the axes of e1 and e2, of which a formula such as `-e2` turns one.
fn response_signs(source: &Source) -> [[f64; 2]; 2] {
    let has_sheared = sheared_columns(source)[0].is_some();
    [0, 1].map(|i| {
        [0, 1].map(|j| {
            let role = RESPONSES[i][j];
            let column = source.columns.of(role).filter(|_| !has_sheared);
            let sheared = || source.columns.of_sheared(sheared_pair(i, j)[0]);
            source.sign(role, column.or_else(sheared))
        })
    })
}

// Share of rows that may have the true shear of another row: two detections within a pixel are rare. Chosen by hand.
const MAX_SHARED_TRUTHS: f64 = 0.01;

// What the rows that count have that measurements do not have.
#[derive(Default)]
struct Found {
    repeats: Repeats,
    copies: Copies,
    largest: LargestResponse,
    shears: TrueShears,
    used: u64,
    // A sum of the keys of the rows.
    content: u64,
    // Rows that count although a column of [`Role::Choice`] excludes them.
    excluded: Vec<u64>,
    // By column of `Columns::steps`.
    numbered: Vec<Numbered>,
    // By place of what is read: whether a row has the text with which a column is compared.
    matched: Vec<bool>,
    // By place in a table of true shears: the position of the first row that has this shear.
    takers: Vec<Option<[f64; 2]>>,
    // Rows at other positions that have the shear of an earlier row.
    shared_truths: u64,
    begun: bool,
}

impl Found {
    fn look_for(&mut self, part: &TableRows<'_>) {
        if !self.begun {
            self.begun = true;
            self.repeats = part.repeats();
        }
        let steps = &part.source.columns.steps;
        self.numbered.resize_with(steps.len(), Numbered::default);
        for (numbered, name) in self.numbered.iter_mut().zip(steps) {
            numbered.add(part.frame, name);
        }
        if let OfRows::Positions(positions, _) = part.truth {
            self.takers.resize(positions.len(), None);
        }
        let choices = part.source.places.all((Role::Choice, 0));
        self.excluded.resize(choices.len(), 0);
        self.matched.resize(part.columns.len(), false);
        for (place, operand) in part.source.wanted.iter().enumerate() {
            if operand.texts.is_some() && !self.matched[place] {
                self.matched[place] = part.columns[place].contains(&1.0);
            }
        }
        self.repeats.look_for(part.columns);
        self.copies
            .look_for(part.columns, part.e, part.ids.as_deref());
    }

    fn add(&mut self, part: &TableRows<'_>, at: usize, number: u64, summed: &SummedRow) {
        let row = &summed.row;
        self.used += 1;
        if let (OfRows::Positions(_, columns), Some(place)) = (part.truth, summed.place) {
            let own = part.pair(columns, at);
            let first = *self.takers[place].get_or_insert(own);
            self.shared_truths += u64::from(first != own);
        }
        self.largest.add(number, row);
        if let OfRows::Columns(_) = part.truth {
            self.shears.add(row);
        }
        let choices = part.source.places.all((Role::Choice, 0));
        for (count, column) in self.excluded.iter_mut().zip(choices) {
            let good = counted_value(part.source.name(*column)) == Some(true);
            *count += u64::from((part.value(*column, at) != 0.0) != good);
        }
        // A shared ellipticity is reported by itself.
        let of_e = part.shape_columns(at) == part.e;
        let shared = of_e && self.repeats.add(part.columns, at);
        let own = part.compared.iter().map(|column| part.value(*column, at));
        let own = own.fold(0, |key, value| identity::hash(key ^ value.to_bits()));
        self.content = self.content.wrapping_add(own);
        // Units that the user names may have many galaxies.
        let ids = part.ids.as_ref().filter(|_| !part.ids_are_units);
        let id = ids.map(|ids| ids[at]);
        self.copies.add((!shared).then_some(own), id);
    }

    // Comparisons with a text that no row has, which is probably misspelt.
    fn unmatched(&self, source: &Source) -> Vec<String> {
        let all = source.wanted.iter().zip(&self.matched);
        let unmatched = all.filter(|(_, matched)| !**matched);
        let texts = unmatched.filter_map(|(operand, _)| match &operand.texts {
            Some(Texts::Pattern(pattern)) => Some(format!("{} == '{pattern}'", operand.column)),
            _ => None,
        });
        texts.collect()
    }

    // A table whose rows belong to sheared catalogues has no mean of galaxies. Texts of these are recognised, but the order of numbers
    // is the program's own.
    fn refuse_sheared_rows(&self, path: &Path, source: &Source) -> Result<(), FileError> {
        let mut steps = source.columns.steps.iter().zip(&self.numbered);
        let is_step = |own: &Numbered| !own.others && own.seen.iter().all(|seen| *seen);
        match steps.find(|(_, own)| is_step(own)) {
            None => Ok(()),
            Some((name, _)) => {
                let message =
                    format!("column `{name}` has the numbers 0 to 4, as of sheared catalogues");
                Err(FileError::new(path, message).hint(format!("--columns version={name} if 0 is noshear and 1 to 4 are 1p, 1m, 2p and 2m, or version=none if it is another quantity")))
            }
        }
    }

    // If a column for cuts that the user did not choose excludes some rows and not others, the catalogue needs a decision: its
    // authors excluded these rows from their shears.
    fn refuse_unused_cuts(&self, path: &Path, source: &Source) -> Result<(), FileError> {
        let found = self
            .excluded
            .iter()
            .zip(source.places.all((Role::Choice, 0)));
        let mut found = found.filter(|(rows, _)| (1..self.used).contains(rows));
        let Some((rows, column)) = found.next() else {
            return Ok(());
        };
        let name = source.name(*column);
        let choice = match counted_value(name) {
            Some(true) => name.to_owned(),
            _ => format!("not({name})"),
        };
        Err(FileError::new(
            path,
            format!(
                "`{name}` excludes {rows} of {} rows that would count (expected none)",
                self.used
            ),
        )
        .hint(format!(
            "--where '{choice}', or --where '{name} > -1' for all rows"
        )))
    }

    // Of positions in degrees, a galaxy that the table lacks finds another galaxy within one unit.
    fn refuse_shared_truths(&self, path: &Path) -> Result<(), FileError> {
        if self.shared_truths as f64 <= MAX_SHARED_TRUTHS * self.used as f64 {
            return Ok(());
        }
        let message = format!(
            "{} of {} rows are within 1 pixel of a place in the table of true shears at which another row is (expected a galaxy for each)",
            self.shared_truths, self.used
        );
        Err(FileError::new(path, message).hint("x and y in pixels (--columns x=NAME,y=NAME, or formulas), or a table with the columns id, g1, g2"))
    }

    // Refuses columns that the user did not name as true shears and that look like measured ones.
    fn refuse_measured_shears(
        &self,
        path: &Path,
        source: &Source,
        reading: &Reading<'_>,
    ) -> Result<(), FileError> {
        let [g1, g2] = [Role::G1, Role::G2].map(|role| source.columns.of(role).unwrap_or_default());
        let is_stated =
            reading.request.names.is_given(Role::G1) || g1.to_ascii_lowercase().contains("tru");
        match self.shears.fault().filter(|_| !is_stated) {
            None => Ok(()),
            Some(fault) => {
                let message = format!("`{g1}` and `{g2}` look like measured shears ({fault})");
                Err(FileError::new(path, message).hint(format!("--columns g1=none,g2=none for c alone, --truth FILE, or --columns g1={g1},g2={g2} if they are the true shears")))
            }
        }
    }
}

// Rows without shear that count, of which sheared ones have some, too, unless a flag leaves out all of them. Chosen by hand.
const MIN_UNSHEARED: u64 = 50;

// Without one of the sheared catalogues, the response is unknown: it was NaN, and the message named R11.
fn require_sheared(path: &Path, counts: &[u64; CATALOGUES]) -> Result<(), FileError> {
    let names = ["noshear", "1p", "1m", "2p", "2m"];
    let with = |has_rows: bool| -> Vec<&str> {
        let all = names.iter().zip(counts);
        let chosen = all.filter(|(_, count)| (**count > 0) == has_rows);
        chosen.map(|(name, _)| *name).collect()
    };
    let (found, absent) = (with(true), with(false));
    // A table without rows is reported as such.
    if absent.is_empty() || found.is_empty() {
        return Ok(());
    }
    let message = format!(
        "there is no row of {} that counts (found {}, expected rows of all sheared catalogues, whose differences are the response)",
        names_of(&absent),
        names_of(&found)
    );
    Err(FileError::new(path, message).hint(
        "the table with all of them, or --columns version=none if the ellipticities are calibrated",
    ))
}

fn is_sheared(text: Option<&str>) -> bool {
    text.and_then(catalogue_named).is_some_and(|own| own > 0)
}

// Numbers of sheared catalogues in the order of ngmix: 0 is noshear.
fn numbered(value: f64) -> Option<usize> {
    let catalogue = value as usize;
    (catalogue < CATALOGUES && catalogue as f64 == value).then_some(catalogue)
}

// The different values of a column whose numbers may be those of sheared catalogues.
#[derive(Default)]
struct Numbered {
    seen: [bool; CATALOGUES],
    others: bool,
}

impl Numbered {
    fn add(&mut self, frame: &DataFrame, name: &str) {
        if self.others {
            return;
        }
        let mut add = |value: Option<usize>| match value {
            Some(catalogue) => self.seen[catalogue] = true,
            None => self.others = true,
        };
        if let Some(texts) = texts_of(frame, name) {
            texts.for_each(|text| add(text.and_then(|text| numbered(text.trim().parse().ok()?))));
        } else if let Some(values) = frame.column(name).ok().and_then(reals) {
            values.iter().for_each(|value| add(numbered(*value)));
        }
    }
}

fn recognised_cuts<'a>(
    source: &'a Source,
    reading: &Reading<'_>,
) -> impl Iterator<Item = &'a String> + use<'a> {
    let given = reading.request.names.is_given(Role::Flag);
    let flags = source.columns.flags.iter().filter(move |_| !given);
    flags.filter(|name| name.to_ascii_lowercase().contains("select"))
}

// Refuses a cut that excludes more than half of the rows: it may be true for selected rows.
fn check_share(
    path: &Path,
    source: &Source,
    reading: &Reading<'_>,
    summary: &Catalogue,
) -> Result<(), FileError> {
    let most = 2 * summary.flagged > summary.rows;
    match recognised_cuts(source, reading).next().filter(|_| most) {
        None => Ok(()),
        Some(name) => {
            let message = format!(
                "flags exclude {} of {} rows, among them `{name}` (expected less than half: 0 for good rows)",
                summary.flagged, summary.rows
            );
            Err(FileError::new(path, message).hint(format!("--columns flag=none --where {name} if good rows have 1, --columns flag={} otherwise", source.columns.flags.join("+"))))
        }
    }
}

// Refuses a recognised flag that is true for selected rows.
fn refuse_boolean_flags(
    frame: &DataFrame,
    source: &Source,
    reading: &Reading<'_>,
) -> Result<(), FileError> {
    let is_boolean = |name: &str| {
        let column = frame.column(name);
        column.is_ok_and(|column| *column.dtype() == DataType::Boolean)
    };
    match recognised_cuts(source, reading).find(|name| is_boolean(name)) {
        None => Ok(()),
        Some(name) => {
            let message = format!(
                "column `{name}` is true or false (expected a flag, which is 0 for good rows)"
            );
            Err(FileError::new(&source.place.path, message).hint(format!("--columns flag=none --where {name} if it is true for selected rows, --columns flag={name} otherwise")))
        }
    }
}

// The sheared catalogues that a column of text names, 0 for the one without shear.
fn sheared_of(frame: &DataFrame, name: &str, path: &Path) -> Result<Vec<usize>, FileError> {
    let fault = |found: &str, remedy: &str| {
        let expected = "noshear or ns, 1p, 1m, 2p or 2m, or 0 to 4 in this order";
        FileError::new(
            path,
            format!(
                "column `{name}`: unknown sheared catalogue (found {found}, expected {expected})"
            ),
        )
        .hint(remedy)
    };
    let none = "--columns version=none";
    let Some(texts) = texts_of(frame, name) else {
        let values = table::numbers(frame, name, path)?;
        let known = |value: &f64| numbered(*value).ok_or_else(|| fault(&shown(*value), none));
        return values.iter().map(known).collect();
    };
    let known = |text: Option<&str>| {
        let text = text.unwrap_or("nothing");
        let number = || numbered(text.trim().parse().ok()?);
        catalogue_named(text).or_else(number).ok_or_else(|| {
            // The mean of all sheared catalogues has a wrong m.
            let sheared = texts_of(frame, name).is_some_and(|mut texts| texts.any(is_sheared));
            let remedy = match sheared {
                true => "a table of these catalogues alone",
                false => none,
            };
            fault(&format!("`{text}`"), remedy)
        })
    };
    texts.map(known).collect()
}

pub fn distinct(inputs: &[Input]) -> Result<(), FileError> {
    let mut seen = HashSet::new();
    match inputs.iter().find(|input| !seen.insert(&input.name)) {
        None => Ok(()),
        Some(input) => Err(FileError::new(&input.name, "the catalogue is given twice")),
    }
}
