//! Multiplicative and additive bias of catalogues of any program.
//!
//! [`Request`] specifies catalogues and options. [`sum`] reads the catalogues into sums that merge ([`Summed`]), and
//! [`Summed::result`] estimates.

mod cells;
mod error;
mod like;
mod partners;

use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::Path;

use serde::{Deserialize, Serialize};
use shearq_bias::{
    BiasError, Catalogue, Design, Estimate, Grouping, Layout, Range, UnitSums, difference, group,
};
use shearq_catalogue::columns::Shapes;
use shearq_catalogue::request::{Input, Request, Units};
use shearq_catalogue::roles::{CATALOGUES, Role, named};
use shearq_catalogue::rows::{distinct, rows};
use shearq_catalogue::sheared_files::{refuse_sheared_psfs, with_sheared_files, without_sheared};
use shearq_catalogue::source::{
    Reading, Source, difference as different_columns, sources, unused_in_others,
};
use shearq_catalogue::truth::{TrueSign, Truth};
use shearq_dataset::fingerprint::{GALAXIES, verify_source};
use shearq_dataset::metadata::{CATALOGUE_FRAME, CommonAxes, axes_of};
use shearq_dataset::run::Run;
use shearq_dataset::threads::{ALL_CORES, Progress, Quiet};
use shearq_dataset::truth::{Sign, stated_sign};
use shearq_files::table::{self, FileFormat};
use shearq_files::{FileError, names_of};
use shearq_scoring::TruthSign;

pub use cells::{Axis, Cells};
pub use error::BiasFailure;
pub use like::Population;
use partners::Partners;

/// What sums of catalogues are sums of.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct About {
    version: String,
    pub catalogues: Vec<Catalogue>,
    pub program: String,
    #[serde(default)]
    pub by_shearq: bool,
    truth: bool,
    // A number that other true shears do not have, of those that are not in the catalogues.
    #[serde(default)]
    shears: u64,
    /// Whether responses were read, or the type of the ellipticities was given.
    pub response: bool,
    /// Whether rows have a response that `--columns R11=none` leaves out.
    pub response_column: bool,
    /// Why nothing divides the ellipticities by their response, if they need one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub undivided: Option<String>,
    /// Why the true shears are no reduced ones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unreduced: Option<String>,
    /// The column of flags.
    #[serde(default)]
    pub flag: Option<String>,
    /// Whether units are named by identifiers.
    matched: bool,
    /// A column that is not used and looks like independent units.
    pub unit_column: Option<String>,
    // Columns by role and what becomes of them, in which all catalogues agree.
    #[serde(default)]
    kind: Vec<(String, String)>,
    design: Option<Design>,
    by_key: Option<bool>,
    pub cells: Cells,
    /// The column by whose values galaxies are a unit.
    pub named_unit: Option<String>,
    /// Whether only galaxies count that count under all test shears.
    pub paired: bool,
    /// Columns of `--where` or `--bins` without sheared versions: m contains how shear changes this choice.
    pub measured: Vec<String>,
    /// The texts of the options that select and weight rows, such as `where: snr > 10`.
    pub selection: Option<String>,
    /// Which columns are used as what, and which look as if they should be, a line each.
    pub columns: Vec<String>,
    /// The sign of the true g2; `None` if the truth needs none.
    pub sign: Option<Sign>,
    /// `pixel` or `sky`, of catalogues by shearq.
    pub frame: Option<String>,
    /// Remarks about images of the data that have no catalogue.
    // Left out of files of sums unless there are some, so that these stay the same.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub without_catalogue: Vec<String>,
}

impl About {
    /// The true shear of each catalogue with rows, in words: of one that varies, the range depends on which galaxies count.
    pub(crate) fn shears_in_words(&self) -> Vec<String> {
        let used = self.catalogues.iter().filter(|own| own.rows > 0);
        let shear = |own: &Catalogue| match own.constant() {
            None => "varying".to_owned(),
            Some([g1, g2]) => format!("{g1:.6}, {g2:.6}"),
        };
        used.map(shear).collect()
    }

    /// The rows of all catalogues, and how many of them do not count for each reason.
    pub fn total(&self) -> Catalogue {
        let mut total = Catalogue::default();
        for own in &self.catalogues {
            total.rows += own.rows;
            total.flagged += own.flagged;
            total.unweighted += own.unweighted;
            total.unselected += own.unselected;
            total.missing += own.missing;
            total.failed += own.failed;
            total.above_one += own.above_one;
            total.without_partner += own.without_partner;
            for (total, own) in total.beyond.iter_mut().zip(own.beyond) {
                *total += own;
            }
        }
        // A text that one tile lacks may be in others.
        let mut used = self.catalogues.iter().filter(|own| own.rows > 0);
        if let Some(first) = used.next() {
            let rest: Vec<&Catalogue> = used.collect();
            let everywhere = |text: &&String| rest.iter().all(|own| own.unmatched.contains(text));
            let unmatched = first.unmatched.iter().filter(everywhere);
            total.unmatched = unmatched.cloned().collect();
        }
        total
    }
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Summed {
    sums: UnitSums,
    about: About,
    // Of surveys, whose catalogues are not summed.
    #[serde(skip)]
    populations: Vec<Population>,
}

#[derive(Debug, Clone)]
pub struct BinResult {
    /// `all`, the bins, or the survey to whose galaxies the simulated ones are weighted.
    pub label: String,
    /// Lower and upper edge of each binned quantity; empty for all galaxies.
    pub ranges: Vec<[f64; 2]>,
    /// The estimates, or why there are none.
    pub estimate: Result<Estimate, BiasError>,
}

#[derive(Debug, Clone)]
pub struct BiasResult {
    /// All galaxies first, then each bin.
    pub bins: Vec<BinResult>,
    pub design: Design,
    /// The units of the errors, and what is wrong with them.
    pub grouping: Grouping,
    pub about: About,
    /// Galaxies outside of all bins, which count in the row of all.
    pub outside: usize,
    /// The surveys to whose galaxies the simulated ones are weighted.
    pub populations: Vec<Population>,
}

impl BiasResult {
    pub fn all(&self) -> Result<&Estimate, BiasError> {
        let first = self.bins.first().map(|bin| bin.estimate.as_ref());
        first
            .unwrap_or(Err(&BiasError::NoGalaxies))
            .map_err(Clone::clone)
    }
}

/// Sums the catalogues of a request for which `part` holds, given their number.
pub fn sum(request: &Request, part: &dyn Fn(usize) -> bool) -> Result<Summed, BiasFailure> {
    sum_with_progress(request, part, &|_| Box::new(Quiet))
}

/// The same with the progress that `start` returns for a number of catalogues. Those that are read twice count twice.
pub fn sum_with_progress(
    request: &Request,
    part: &dyn Fn(usize) -> bool,
    start: &dyn Fn(u64) -> Box<dyn Progress>,
) -> Result<Summed, BiasFailure> {
    distinct(&request.catalogues)?;
    refuse_sheared_psfs(&request.catalogues, &request.names)?;
    let joined = Request {
        catalogues: with_sheared_files(request.catalogues.clone(), &request.truth, &request.names),
        ..request.clone()
    };
    let request = &joined;
    let paths = request.catalogues.iter().map(|input| input.name.as_path());
    let mut reading = Reading {
        request,
        truth: request.truth.of_paths(paths)?,
        flip_g2: false,
    };
    let numbered = cells::with_numbers(request, &reading)?;
    let (request, of_texts) = match &numbered {
        Some((request, axes)) => (request, axes.as_slice()),
        None => (request, &[][..]),
    };
    reading.request = request;
    let inputs = request.catalogues.iter();
    let all = inputs.map(|input| sources(input, &reading));
    let all: Vec<Vec<Source>> = all.collect::<Result<_, _>>()?;
    let first = all.first().and_then(|sources| sources.first());
    let first = first.ok_or(BiasFailure::NoCatalogue)?;
    let mut about = about(&reading, &all, first);
    about.kind = check_columns(&reading, &all)?;
    let (frame, images) = frame_and_images(&all)?;
    about.frame = frame;
    let named = request.catalogues.iter().zip(&images);
    distinct_images(named.map(|(input, image)| (input.name.display().to_string(), image)))?;
    verify_data(&request.truth)?;
    about.cells = cells::cells(&reading, &all)?;
    for (axis, of_texts) in about.cells.axes.iter_mut().zip(of_texts) {
        if let Some(own) = of_texts {
            *axis = own.clone();
        }
    }
    about.sign = known_sign(request, &all)?.filter(|_| about.truth);
    let count = (0..all.len()).filter(|number| part(*number)).count() as u64;
    // Partners are found after a first pass.
    let mut progress = start(count * (1 + u64::from(request.paired)));
    let mut summed = added_up(&mut reading, &all, about, part, progress.as_mut())?;
    drop(progress);
    if let Some(survey) = &request.like {
        if summed.about.cells.axes.is_empty() {
            return Err(BiasFailure::LikeWithoutBins);
        }
        summed.populations = like::populations(survey, request, &summed.about.cells)?;
    }
    for (catalogue, image) in summed.about.catalogues.iter_mut().zip(images) {
        catalogue.image = image;
    }
    Ok(summed)
}

// What is known of catalogues before their rows are read, apart from what they must have in common.
fn about(reading: &Reading<'_>, all: &[Vec<Source>], first: &Source) -> About {
    let request = reading.request;
    let has_response = first.has_response() || first.shapes != Shapes::Shear;
    let mut columns = first.described(reading);
    let undivided = without_sheared(&request.catalogues).or_else(|| first.undivided.clone());
    let named = request.catalogues.iter().map(|input| input.name.as_path());
    let others = named.zip(all.iter().map(Vec::as_slice));
    columns.extend(unused_in_others(first, reading, others));
    let named_unit = matches!(request.units, Units::Column(_))
        || request.units == Units::Recognised && first.columns.of(Role::Unit).is_some();
    let is_stated_unit =
        matches!(request.units, Units::Column(_)) || request.names.is_given(Role::Unit);
    About {
        version: env!("CARGO_PKG_VERSION").into(),
        catalogues: Vec::new(),
        program: first.columns.program().into(),
        by_shearq: first.columns.is_of_shearq(),
        truth: known(&request.truth, first),
        shears: reading.truth.content(),
        response: has_response || request.shapes.is_some(),
        response_column: first.columns.have(&[Role::R11]),
        unreduced: first.unreduced.clone(),
        undivided: undivided.filter(|_| !has_response && request.shapes.is_none()),
        flag: first.columns.flags.first().cloned(),
        matched: named_unit || first.columns.of(Role::Id).is_some(),
        // A unit that was recognised may be smaller than another one.
        unit_column: first.unit_column.clone().filter(|_| !is_stated_unit),
        kind: Vec::new(),
        design: request.design,
        by_key: match request.units {
            Units::Rows | Units::Column(_) => Some(true),
            Units::Catalogues => Some(false),
            Units::Recognised => named_unit.then_some(true),
        },
        named_unit: first.unit.clone().filter(|_| named_unit),
        paired: request.paired,
        cells: Cells::default(),
        measured: first.unanswered().to_vec(),
        selection: request.selection.as_ref().map(|own| own.text.clone()),
        columns,
        sign: None,
        frame: None,
        without_catalogue: request.without_catalogue.clone(),
    }
}

// The sums, in the sign of g2 that is known or that the catalogues follow, of the galaxies that count.
fn added_up(
    reading: &mut Reading<'_>,
    all: &[Vec<Source>],
    about: About,
    part: &dyn Fn(usize) -> bool,
    progress: &mut dyn Progress,
) -> Result<Summed, BiasFailure> {
    let request = reading.request;
    let first = &all[0][0];
    let layout = Layout {
        psf: first.has_psf(),
        sheared: first.has_sheared_rows() || first.selects,
        matrix: first.has_matrix(),
    };
    let is_of_challenge = |sign: Sign| sign.of == TruthSign::Challenge;
    reading.flip_g2 = about.sign.is_some_and(is_of_challenge);
    let (sums, catalogues) = add_up(reading, all, (layout, &about.cells), part, progress, None)?;
    distinct_content(&catalogues)?;
    let read = catalogues.iter().enumerate();
    let read = read.filter(|(number, _)| part(*number));
    check_counted(read.map(|(_, own)| own), about.truth)?;
    let mut summed = Summed {
        sums,
        about: About {
            catalogues,
            ..about
        },
        populations: Vec::new(),
    };
    // The catalogues are read again rather than the sums changed: g2 enters them in products of all terms.
    if let TrueSign::OfCatalogues(truth) = &request.sign {
        let sign = summed.sign_of_catalogues(truth)?;
        if is_of_challenge(sign) {
            reading.flip_g2 = true;
            // At most a second pass, of which the progress does not know.
            let found = add_up(
                reading,
                all,
                (layout, &summed.about.cells),
                part,
                &mut Quiet,
                None,
            )?;
            (summed.sums, summed.about.catalogues) = found;
        }
        summed.about.sign = Some(sign);
    }
    if request.paired {
        if first.has_sheared_rows() {
            return Err(BiasFailure::PairedSheared);
        }
        let design = summed.design();
        let partners = Partners::new(reading, all, design, &summed.about.catalogues)?;
        let cells = &summed.about.cells;
        let found = add_up(
            reading,
            all,
            (layout, cells),
            part,
            progress,
            Some(&partners),
        )?;
        (summed.sums, summed.about.catalogues) = found;
    }
    Ok(summed)
}

// The sums of the catalogues for whose numbers `part` holds.
fn add_up(
    reading: &Reading<'_>,
    all: &[Vec<Source>],
    (layout, cells): (Layout, &Cells),
    part: &dyn Fn(usize) -> bool,
    progress: &mut dyn Progress,
    partners: Option<&Partners<'_>>,
) -> Result<(UnitSums, Vec<Catalogue>), BiasFailure> {
    let request = reading.request;
    // The last cell is of galaxies outside of the edges.
    let mut sums = UnitSums::new(layout, cells.count() + 1, request.catalogues.len());
    let mut catalogues = Vec::new();
    for (number, (Input { name, .. }, sources)) in request.catalogues.iter().zip(all).enumerate() {
        if !part(number) {
            catalogues.push(Catalogue {
                name: name.display().to_string(),
                ..Catalogue::default()
            });
            continue;
        }
        let selects = sources[0].selects;
        let number = number as u32;
        let paired = partners.map(|all| all.of(number as usize)).transpose()?;
        let mut alone = 0;
        let mut catalogue = rows(name, reading, sources, |item| {
            let bin = |catalogue: usize| {
                let values = item.selected.of(catalogue).binned.ok()?;
                cells.of(&values)
            };
            let (row, own) = (&item.row, bin(0));
            // Differences of 1p and 1m are then derivatives.
            let scaled = row.e.map(|e| e / (2.0 * request.step()));
            let mut add_sheared = |bin, catalogue: usize, weight| {
                sums.add_sheared(number, item.key, bin, catalogue - 1, (scaled, weight));
            };
            match &paired {
                Some(paired) if !paired.contains(&item.galaxy) => {
                    alone += u64::from(item.selected.of(0).binned.is_ok());
                    return;
                }
                // The same galaxies under all shears, so that the choice has no response; weights have one.
                Some(_) => {
                    if let Some(bin) = own.filter(|_| selects) {
                        for catalogue in 1..CATALOGUES {
                            add_sheared(bin, catalogue, item.selected.of(catalogue).weight);
                        }
                    }
                }
                None => {
                    for (catalogue, weight) in item.in_sheared(selects) {
                        // A row of a sheared catalogue has its own bin, others that of each catalogue.
                        let chosen = if item.sheared > 0 { 0 } else { catalogue };
                        if let Some(bin) = bin(chosen) {
                            add_sheared(bin, catalogue, weight);
                        }
                    }
                }
            }
            if let Some(bin) = own.filter(|_| item.sheared == 0) {
                sums.add(number, item.key, bin, row);
            }
        })?;
        catalogue.without_partner = alone;
        catalogues.push(catalogue);
        progress.advance(1);
    }
    Ok((sums, catalogues))
}

// The sign of the true g2 that the user or files state; `None` if the truth needs no sign or the catalogues determine it.
fn known_sign(request: &Request, all: &[Vec<Source>]) -> Result<Option<Sign>, BiasFailure> {
    let specified = match &request.sign {
        TrueSign::Known(sign) => Some(*sign),
        TrueSign::Convention | TrueSign::OfCatalogues(_) => None,
    };
    match &request.truth {
        Truth::Data(_) if specified.is_some() => Err(BiasFailure::SignOfFolders),
        Truth::Columns => {
            let mut found: Option<(&Input, Option<Sign>)> = None;
            for (input, sources) in request.catalogues.iter().zip(all) {
                let has_shear = sources
                    .iter()
                    .all(|own| own.columns.have(&[Role::G1, Role::G2]));
                if input.frame.is_some() || !has_shear {
                    return Ok(specified);
                }
                let path = &sources[0].place.path;
                let own =
                    Sign::of_truth(stated_sign(path)?, specified.map(|sign| sign.of), || None)
                        .map_err(|fault| FileError::new(path, fault))?;
                let (first, sign) = *found.get_or_insert((input, own));
                if sign.map(|sign| sign.of) != own.map(|sign| sign.of) {
                    return Err(BiasFailure::Signs {
                        catalogue: input.name.clone(),
                        first: first.name.clone(),
                    });
                }
            }
            Ok(found.and_then(|(_, sign)| sign))
        }
        _ => Ok(specified),
    }
}

// Columns by role and what becomes of them. Refuses catalogues in which they differ: a weight in one of two catalogues gave a
// mixture of two estimates without a word.
fn check_columns(
    reading: &Reading<'_>,
    all: &[Vec<Source>],
) -> Result<Vec<(String, String)>, BiasFailure> {
    let catalogues = &reading.request.catalogues;
    let known = |source: &Source| known(&reading.request.truth, source);
    let first = &all[0][0];
    let kind = first.kind(reading);
    for (input, sources) in catalogues.iter().zip(all) {
        for source in sources {
            let mut difference = different_columns(&source.kind(reading), &kind);
            if difference.is_none() && known(source) != known(first) {
                difference = Some("a true shear in one of them".into());
            }
            if let Some(difference) = difference {
                return Err(BiasFailure::Columns {
                    catalogue: input.name.clone(),
                    first: catalogues[0].name.clone(),
                    difference,
                });
            }
        }
    }
    Ok(kind)
}

// The frame of catalogues by shearq, and the fingerprint of the image of each. Others do not state theirs.
fn frame_and_images(
    all: &[Vec<Source>],
) -> Result<(Option<String>, Vec<Option<String>>), FileError> {
    let mut axes = CommonAxes::default();
    let mut images = vec![None; all.len()];
    for (sources, image) in all.iter().zip(&mut images) {
        // Only other programs write several tables for a catalogue.
        let source = &sources[0];
        let path = &source.place.path;
        let own = source.columns.is_of_shearq() && source.frame.is_none();
        if let Some(format) = FileFormat::of(path).filter(|_| own) {
            let mut metadata = table::read_metadata(path, format, [CATALOGUE_FRAME, GALAXIES])?;
            axes.add(path, axes_of(path, &metadata)?, true)?;
            *image = metadata.remove(GALAXIES);
        }
    }
    let frame = axes.common().map(|axes| axes.frame().to_string());
    Ok((frame, images))
}

// Refuses two catalogues of one image: one that was copied between the arms of ±γ has the true shear of the other, which gave
// m = −0.139.
fn distinct_images<'c>(
    catalogues: impl Iterator<Item = (String, &'c Option<String>)>,
) -> Result<(), BiasFailure> {
    let mut seen = HashMap::new();
    for (second, image) in catalogues {
        if let Some(image) = image
            && let Some(first) = seen.insert(image, second.clone())
        {
            return Err(BiasFailure::SameImage { first, second });
        }
    }
    Ok(())
}

// Refuses sums of the same galaxies: a task that was repeated counts twice, and errors are too small by √2.
fn distinct_content(catalogues: &[Catalogue]) -> Result<(), BiasFailure> {
    let mut seen = HashMap::new();
    for own in catalogues.iter().filter(|own| own.content != 0) {
        if let Some(first) = seen.insert(own.content, &own.name) {
            return Err(BiasFailure::SameContent {
                first: first.clone(),
                second: own.name.clone(),
            });
        }
    }
    Ok(())
}

// Refuses catalogues without a row that counts among those with one shear each. Their shear is unknown, so that a pair was taken
// for one shear (m of 0.16 instead of 0.0075), and sixty tiles for galaxies whose shear varies.
fn check_counted<'c>(
    catalogues: impl Iterator<Item = &'c Catalogue>,
    truth: bool,
) -> Result<(), BiasFailure> {
    let (used, unused): (Vec<&Catalogue>, Vec<_>) = catalogues.partition(|own| own.counted() > 0);
    let have_one_shear = truth && used.iter().all(|own| own.constant().is_some());
    let empty = unused.iter().find(|own| own.rows == 0);
    match empty.or(unused.first().filter(|_| have_one_shear)) {
        Some(first) if !used.is_empty() => Err(BiasFailure::NothingCounts {
            catalogue: Box::new((*first).clone()),
            more: unused.len() - 1,
        }),
        _ => Ok(()),
    }
}

// Refuses catalogues that were measured on other images or another true shear than their data have now.
fn verify_data(truth: &Truth) -> Result<(), FileError> {
    let Truth::Data(catalogues) = truth else {
        return Ok(());
    };
    // A catalogue is in the folder of its set.
    let folders = catalogues.keys().filter_map(|path| path.ancestors().nth(2));
    for folder in folders.collect::<BTreeSet<_>>() {
        verify_source(folder, &Run::require(folder)?, &[], ALL_CORES)?;
    }
    Ok(())
}

fn known(truth: &Truth, source: &Source) -> bool {
    !matches!(truth, Truth::Columns) || source.columns.have(&[Role::G1, Role::G2])
}

impl Summed {
    /// Columns by role and what becomes of them, in which all catalogues agree.
    pub(crate) fn kind(&self) -> &[(String, String)] {
        &self.about.kind
    }

    /// Checks sums that were read from a file.
    pub fn checked(mut self) -> Result<Self, BiasFailure> {
        let bins = self.about.cells.count() + 1;
        let mut sums = UnitSums::new(self.sums.layout(), bins, self.about.catalogues.len());
        sums.merge(self.sums)?;
        self.sums = sums;
        Ok(self)
    }

    /// Adds the sums of other catalogues of the same list.
    pub fn merge(&mut self, other: Summed) -> Result<(), BiasFailure> {
        self.check_options(&other)?;
        let names = |all: &[Catalogue]| -> Vec<String> {
            all.iter().map(|catalogue| catalogue.name.clone()).collect()
        };
        if names(&self.about.catalogues) != names(&other.about.catalogues) {
            return Err(BiasFailure::OtherLists);
        }
        if self.about.shears != other.about.shears {
            return Err(BiasFailure::Unlike("true shears in --truth, --g1 or --g2"));
        }
        for (own, more) in self.about.catalogues.iter_mut().zip(other.about.catalogues) {
            match (own.rows, more.rows) {
                (0, _) => *own = more,
                (_, 0) => {}
                _ => return Err(BiasFailure::InTwoFiles(own.name.clone())),
            }
        }
        Ok(self.sums.merge(other.sums)?)
    }

    /// Adds the sums of other catalogues, which follow these.
    pub fn append(&mut self, other: Summed) -> Result<(), BiasFailure> {
        self.check_options(&other)?;
        if self.populations != other.populations {
            return Err(BiasFailure::Unlike("surveys of --like"));
        }
        let all = || self.about.catalogues.iter().chain(&other.about.catalogues);
        check_counted(all(), self.about.truth)?;
        self.about.catalogues.extend(other.about.catalogues);
        let named = self.about.catalogues.iter();
        distinct_images(named.map(|own| (own.name.clone(), &own.image)))?;
        distinct_content(&self.about.catalogues)?;
        let remarks = other.about.without_catalogue;
        self.about.without_catalogue.extend(remarks);
        Ok(self.sums.append(other.sums)?)
    }

    /// Catalogues without rows, because their shards are absent.
    pub fn absent(&self) -> Vec<&str> {
        let empty = self.about.catalogues.iter().filter(|own| own.rows == 0);
        empty.map(|own| own.name.as_str()).collect()
    }

    fn check_options(&self, other: &Summed) -> Result<(), BiasFailure> {
        if self.about.version != other.about.version {
            return Err(BiasFailure::Unlike("versions"));
        }
        let options = |of: &About| {
            let About {
                truth,
                matched,
                design,
                by_key,
                ..
            } = *of;
            (truth, matched, design, by_key)
        };
        let rows = |of: &About| (of.cells.clone(), of.paired, of.selection.clone());
        if options(&self.about) != options(&other.about) || rows(&self.about) != rows(&other.about)
        {
            return Err(BiasFailure::Unlike("options"));
        }
        if let Some(difference) = different_columns(&other.about.kind, &self.about.kind) {
            return Err(BiasFailure::UnlikeColumns(difference));
        }
        if self.about.sign.map(|sign| sign.of) != other.about.sign.map(|sign| sign.of) {
            return Err(BiasFailure::Unlike("signs of g2"));
        }
        if self.about.frame != other.about.frame {
            return Err(BiasFailure::Unlike("frames of ellipticities"));
        }
        Ok(())
    }

    pub fn result(&self) -> Result<BiasResult, BiasFailure> {
        let (design, grouping) = self.grouped()?;
        let all = grouping.all_bins().estimate(0, self.about.truth);
        let all = all.map_err(|error| match error {
            BiasError::FewUnits { .. } if self.about.by_key == Some(true) => {
                BiasFailure::OneUnit(error)
            }
            error => error.into(),
        })?;
        check_responses(&self.about, &all)?;
        let cells = &self.about.cells;
        // A survey has cells without simulated galaxies, which are named.
        let is_empty = |cell: &usize| grouping.units.galaxies(*cell) == 0;
        let empty = (0..cells.count()).find(is_empty);
        if let Some(cell) = empty.filter(|_| cells.are_stated() && self.populations.is_empty()) {
            return Err(BiasFailure::EmptyBin(cells.label(cell)));
        }
        let outside = match cells.count() {
            0 => 0,
            count => grouping.units.galaxies(count),
        };
        let mut bins = self.bins(all, |bin| grouping.estimate(bin, self.about.truth));
        let mut populations = self.populations.clone();
        if !populations.is_empty() {
            // The survey instead of up to 400 bins.
            bins.truncate(1);
        }
        for population in &mut populations {
            let counts = (0..cells.count()).map(|cell| grouping.units.galaxies(cell));
            let shares = population.covered(&counts.collect::<Vec<_>>(), cells)?;
            bins.push(BinResult {
                label: population.label.clone(),
                ranges: Vec::new(),
                estimate: grouping.estimate_like(&shares, self.about.truth),
            });
        }
        Ok(BiasResult {
            bins,
            design,
            grouping,
            about: self.about.clone(),
            outside,
            populations,
        })
    }

    fn bins(
        &self,
        all: Estimate,
        estimate: impl Fn(usize) -> Result<Estimate, BiasError>,
    ) -> Vec<BinResult> {
        let all = BinResult {
            label: "all".into(),
            ranges: Vec::new(),
            estimate: Ok(all),
        };
        let cells = &self.about.cells;
        let bins = (0..cells.count()).map(|cell| BinResult {
            label: cells.label(cell),
            ranges: cells.ranges(cell),
            estimate: estimate(cell),
        });
        [all].into_iter().chain(bins).collect()
    }

    /// See [`UnitSums::effective_catalogues`].
    pub fn effective_catalogues(&self) -> f64 {
        self.sums.effective_catalogues()
    }

    pub fn about(&self) -> &About {
        &self.about
    }

    /// The columns that are used, by role.
    pub fn columns(&self) -> impl Iterator<Item = (String, String)> {
        let kind = self.about.kind.iter();
        kind.filter(|(role, _)| named(role).is_some()).cloned()
    }

    fn design(&self) -> Design {
        let recognised = || Design::of(&self.about.catalogues, self.about.truth);
        self.about.design.unwrap_or_else(recognised)
    }

    fn grouped(&self) -> Result<(Design, Grouping), BiasFailure> {
        self.check_values()?;
        let design = self.design();
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
    pub fn difference(&self, other: &Summed) -> Result<BiasResult, BiasFailure> {
        if (&self.about.cells, self.about.truth) != (&other.about.cells, other.about.truth) {
            return Err(BiasFailure::BinsDiffer);
        }
        if let (Some(own), Some(theirs)) = (self.about.sign, other.about.sign)
            && own.of != theirs.of
        {
            return Err(BiasFailure::SignsDiffer(own.of, theirs.of));
        }
        // Other programs do not state theirs.
        if let (Some(own), Some(theirs)) = (&self.about.frame, &other.about.frame)
            && own != theirs
        {
            return Err(BiasFailure::FramesDiffer(own.clone(), theirs.clone()));
        }
        self.check_images(other)?;
        self.check_truths(other)?;
        let ((design, own), (their_design, theirs)) = (self.grouped()?, other.grouped()?);
        let designs = [(design, own.unit), (their_design, theirs.unit)];
        if designs[0] != designs[1] {
            return Err(BiasFailure::DesignsDiffer(designs[0], designs[1]));
        }
        let (a, b, truth) = (&own.units, &theirs.units, self.about.truth);
        let all = difference(&a.all_bins(), &b.all_bins(), 0, truth)?;
        let bins = self.bins(all, |bin| difference(a, b, bin, truth));
        let about = About {
            program: format!(
                "{} minus {}",
                side(&self.about, "the catalogues"),
                side(&other.about, "those of --against")
            ),
            measured: Vec::new(),
            ..self.about.clone()
        };
        // What both have in common is not in the errors: the noise of stars, and galaxies that both leave out.
        let grouping = Grouping {
            misaligned: own.misaligned || theirs.misaligned,
            uncorrelated: None,
            without_partner: None,
            stars: Vec::new(),
            ..own
        };
        Ok(BiasResult {
            bins,
            design,
            grouping,
            about,
            outside: 0,
            populations: Vec::new(),
        })
    }

    // Refuses images of both sides that are not in the same places. If the sides have no image in common, the same galaxies
    // may have been cut out or drawn in two ways, and only the user knows.
    fn check_images(&self, other: &Summed) -> Result<(), BiasFailure> {
        let (own, theirs) = (&self.about.catalogues, &other.about.catalogues);
        if !share_images(own, theirs) {
            return Ok(());
        }
        let mut pairs =
            (0..own.len().max(theirs.len())).map(|k| [own, theirs].map(|all| all.get(k)));
        let image = |own: Option<&Catalogue>| own.and_then(|own| own.image.clone());
        let name =
            |own: Option<&Catalogue>| own.map_or("no catalogue".into(), |own| own.name.clone());
        match pairs.find(|[a, b]| image(*a) != image(*b)) {
            None => Ok(()),
            Some([a, b]) => Err(BiasFailure::ImagesDiffer {
                own: name(a),
                other: name(b),
            }),
        }
    }

    // The order of catalogues does not matter: galaxies are paired by identifiers or rows.
    fn check_truths(&self, other: &Summed) -> Result<(), BiasFailure> {
        let [own, theirs] =
            [self, other].map(|side| BTreeSet::from_iter(side.about.shears_in_words()));
        match own == theirs {
            true => Ok(()),
            false => Err(BiasFailure::TruthsDiffer([own, theirs].map(|all| {
                let all = all.into_iter().map(|shear| format!("({shear})"));
                names_of(&all.collect::<Vec<_>>())
            }))),
        }
    }

    // The sign of g2 in the file `truth` that e2 follows, from sums for the standard sign.
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
        let estimate = self
            .grouped()
            .and_then(|(_, grouping)| Ok(grouping.all_bins().estimate(0, true)?));
        let all = match estimate {
            Err(_) if !self.absent().is_empty() => return undetermined(None),
            found => found?,
        };
        let m = all.value("m2").filter(|m| m.error.is_finite());
        let found = m.and_then(|m| {
            let (response, clear) = (1.0 + m.value, SIGNIFICANT * m.error);
            match response {
                _ if response >= clear => Some(TruthSign::Standard),
                _ if response <= -clear => Some(TruthSign::Challenge),
                _ => None,
            }
        });
        if found.is_none() {
            // Exchanged components or wrong rows are the better remark.
            check_responses(&self.about, &all)?;
        }
        undetermined(found)
    }

    // Refuses catalogues without usable rows, and constant ellipticities.
    fn check_values(&self) -> Result<(), BiasFailure> {
        let total = self.about.total();
        let used = total.counted();
        if used == 0 {
            return Err(BiasFailure::NoGalaxy(total.into()));
        }
        let read = self.about.catalogues.iter().filter(|own| own.rows > 0);
        check_counted(read, self.about.truth)?;
        for k in 0..2 {
            let ranges = self.about.catalogues.iter().filter(|c| c.rows > 0);
            let (low, high) = ranges.fold((f64::MAX, f64::MIN), |(low, high), c| {
                let own = c.ellipticity[k];
                (low.min(own.low), high.max(own.high))
            });
            if used > 1 && low == high {
                return Err(BiasFailure::Constant {
                    component: k + 1,
                    value: low,
                    rows: used,
                });
            }
        }
        // Ellipticities with a response may have any scale. Magnitudes, angles in degrees and percent are beyond 2 in most rows.
        if !self.about.response && 2 * total.beyond[1] > used {
            return Err(BiasFailure::Beyond {
                rows: total.beyond[1],
                used,
            });
        }
        Ok(())
    }
}

/// Joins parts in their order, each time two that contain about equally many, so that n parts take a time of n log n rather than
/// n²: a union looks at all that it contains.
pub fn joined<P, E>(
    parts: impl IntoIterator<Item = Result<P, E>>,
    join: impl Fn(&mut P, P) -> Result<(), E>,
) -> Result<Option<P>, E> {
    // Unions with the number of their parts, the later ones smaller.
    let mut unions: Vec<(usize, P)> = Vec::new();
    let union = |unions: &mut Vec<(usize, P)>, most: usize| -> Result<(), E> {
        while let [.., (before, _), (count, _)] = &unions[..]
            && *before <= most.max(*count)
        {
            let last = unions.pop();
            if let (Some((more, last)), Some((count, first))) = (last, unions.last_mut()) {
                join(first, last)?;
                *count += more;
            }
        }
        Ok(())
    };
    for part in parts {
        unions.push((1, part?));
        union(&mut unions, 0)?;
    }
    union(&mut unions, usize::MAX)?;
    Ok(unions.pop().map(|(_, all)| all))
}

/// Whether catalogues of one side of a comparison state an image that those of the other side state.
pub fn share_images(own: &[Catalogue], theirs: &[Catalogue]) -> bool {
    let theirs: HashSet<_> = theirs.iter().filter_map(|own| own.image.as_ref()).collect();
    let mut own = own.iter().filter_map(|own| own.image.as_ref());
    own.any(|image| theirs.contains(image))
}

// One side of a comparison: its first catalogue, how many more and their columns.
fn side(about: &About, name: &str) -> String {
    let all = &about.catalogues;
    let first = all.first().map_or("", |own| own.name.as_str());
    let more = match all.len() {
        0 | 1 => String::new(),
        count => format!(" and {} more", count - 1),
    };
    format!("{name} ({first}{more}; {})", about.program)
}

// Significance at which an implausible response is refused, and at which the response of e2 determines the sign of g2: one
// of 0 exceeds it by chance in 6 of 10⁷ cases.
const SIGNIFICANT: f64 = 5.0;

// g2/g1 of the true shears, if it is the same in all catalogues: e1 and e2 then respond to both components alike.
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

// Largest relative difference of responses from the ones that exchanged components have: a bias of the shapes. Chosen by hand.
const BIASED: f64 = 0.3;

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
    // All shears lie on one line: the responses are g2/g1 and g1/g2.
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

// Refuses ellipticities that follow minus the true shear, or do not follow it, and distortions without responses.
fn check_responses(about: &About, all: &Estimate) -> Result<(), BiasFailure> {
    // g2/g1 of the true shears, if it is constant.
    let (has_response, ratio, sign) = (about.response, ratio(&about.catalogues), about.sign);
    let mut roles = about.kind.iter();
    let e1 = roles.find_map(|(role, column)| (role == "e1").then_some(column.as_str()));
    let e1 = e1.unwrap_or("e1");
    // 1 + m of each component: the response that remains after division by the response in the catalogue.
    let responses = ["m1", "m2"].map(|key| {
        let m = all.value(key).filter(|m| m.error.is_finite())?;
        Some((1.0 + m.value, SIGNIFICANT * m.error))
    });
    let found = responses.map(|response| response.map_or(f64::NAN, |(response, _)| response));
    let is_negative = |k: usize| responses[k].is_some_and(|(value, error)| value + error < 0.0);
    if are_exchanged(all, ratio) {
        return Err(BiasFailure::Exchanged(found));
    }
    if is_negative(0) {
        let is_name = |text: &str| text.chars().all(|c| c.is_alphanumeric() || c == '_');
        return Err(BiasFailure::MinusG1 {
            response: found[0],
            e1: match e1.strip_prefix('-').filter(|own| is_name(own)) {
                Some(own) => own.to_owned(),
                None if is_name(e1) => format!("-{e1}"),
                None => format!("'-({e1})'"),
            },
        });
    }
    if is_negative(1) {
        return Err(BiasFailure::MinusG2 {
            response: found[1],
            sign,
        });
    }
    let known: Vec<(f64, f64)> = responses.into_iter().flatten().collect();
    if known.is_empty() {
        return Ok(());
    }
    // A response below 0.1 is no calibration error: rows and true shears do not belong together.
    if known.iter().all(|(value, error)| value + error < 0.1) {
        return Err(BiasFailure::Unrelated(found));
    }
    // A distortion responds by 2 (1 − ⟨χ²⟩/2), which is 1.6 to 2 for galaxies.
    let like = |(value, error): &(f64, f64)| (1.5..2.1).contains(value) && value - error > 1.3;
    if !has_response && known.iter().all(like) {
        return Err(BiasFailure::Distortions(found));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_joined_in_their_order_with_few_copies() {
        let copied = std::cell::Cell::new(0);
        let join = |all: &mut Vec<usize>, more: Vec<usize>| {
            copied.set(copied.get() + all.len() + more.len());
            all.extend(more);
            Ok::<(), ()>(())
        };
        for count in [1, 2, 3, 7, 1000] {
            copied.set(0);
            let all = joined((0..count).map(|k| Ok(vec![k])), join).unwrap();
            assert_eq!(all, Some((0..count).collect()));
            assert!(copied.get() <= 12 * count, "{}", copied.get());
        }
        assert_eq!(joined([] as [Result<_, ()>; 0], join), Ok(None));
    }

    #[test]
    fn ellipticities_in_other_frames_are_not_compared() {
        let in_frame = |frame: Option<&str>| -> Summed {
            let about = serde_json::json!({
                "version": "", "catalogues": [], "program": "", "truth": true, "response": false,
                "response_column": false, "matched": true, "cells": { "axes": [] }, "paired": false,
                "measured": [], "columns": [], "frame": frame,
            });
            Summed {
                sums: UnitSums::new(Layout::default(), 0, 0),
                about: serde_json::from_value(about).unwrap(),
                populations: Vec::new(),
            }
        };
        let differ = |own, other| {
            let found = in_frame(own).difference(&in_frame(other));
            matches!(found, Err(BiasFailure::FramesDiffer(..)))
        };
        assert!(differ(Some("pixel"), Some("sky")));
        assert!(!differ(Some("sky"), Some("sky")) && !differ(None, Some("sky")));
    }
}
