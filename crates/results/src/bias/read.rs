//! Rows of catalogues, as the sums need them.

use std::borrow::Cow;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::Path;

use shearq_bias::{Catalogue, Repeated, Row, SHEARED_CATALOGUES};
use shearq_files::FileError;
use shearq_files::frames::polars::{DataFrame, DataType};
use shearq_files::table::{self, FileFormat, Place};
use shearq_measure::{Observables, Selection};
use shearq_quantities::{Distortion, MeasuredRange};

use crate::expression::{Expression, Operand, fits};
use crate::foreign::shown;
use crate::select::{READ, Weighted, require_responses};
use crate::star_noise;

use super::Input;
use super::columns::{
    CATALOGUES, Columns, Key, Names, Preset, ROLES, Role, Shapes, base, fits_any,
};
use super::identity;
use super::positions::{self, Positions};
use super::truth::Truth;

/// How catalogues are read.
#[derive(Debug, Clone)]
pub(super) struct Reading {
    pub(super) names: Names,
    pub(super) truth: Truth,
    pub(super) shapes: Option<Shapes>,
    /// Whether minus the true g2 is used.
    pub(super) flip_g2: bool,
    pub(super) select: Option<Expression>,
    /// Cuts and weights whose response to shear is known.
    pub(super) selection: Option<Selection>,
    pub(super) binned: Option<Expression>,
    pub(super) drop_missing: bool,
    /// Artificial shear of metacalibration.
    pub(super) step: f64,
    /// Whether two neighbouring rows form a unit.
    pub(super) neighbours: bool,
    /// Column that names the unit; `None` for the recognised one, empty for none.
    pub(super) unit: Option<String>,
}

impl Reading {
    fn expressions(&self) -> impl Iterator<Item = &Expression> + Clone {
        [&self.select, &self.binned].into_iter().flatten()
    }

    /// Whether the column of a role is not needed.
    fn skips(&self, role: Role) -> bool {
        match role {
            Role::G1 | Role::G2 => !matches!(self.truth, Truth::Columns),
            Role::X | Role::Y => !matches!(self.truth, Truth::Positions(_) | Truth::Data(_)),
            _ => false,
        }
    }
}

// Columns of surveys and simulations that look like independent units. They are suggested, not used: a field or seed may
// also be the same in all rows.
const UNITS: &str = "tile tile_id tileid tilename tile_name field field_id patch patch_id seed tract pointing exposure \
    exp_id ccd chip healpix realisation";

// Columns that shear does not change, by their names in small letters.
const FIXED: &str = "*psf* *tile* *field* *patch* *seed* *true* *truth* *image* *ccd* *exp* *airmass* *seeing* *depth* \
    *zbin* *z_bin* *primary* *inner* ra dec x y z number row alpha delta set";

/// A row that counts.
pub(super) struct Item {
    /// Unit.
    pub(super) key: u64,
    /// The artificial shear of the row; `None` without one.
    pub(super) version: Option<usize>,
    pub(super) row: Row,
    /// The binned quantity in each catalogue that has it; infinity if the row is not selected.
    pub(super) binned: [f64; CATALOGUES],
    /// Its weight in each sheared catalogue.
    pub(super) weights: [f64; SHEARED_CATALOGUES.len()],
}

/// What is read of a row for one catalogue, as places in [`Source::wanted`].
#[derive(Default)]
struct Places {
    roles: [Option<usize>; ROLES],
    /// A row counts if all are zero.
    flags: Vec<usize>,
    /// The operands of the expressions; `None` if this catalogue lacks one.
    select: Option<Vec<usize>>,
    binned: Option<Vec<usize>>,
}

impl Places {
    fn of(&self, role: Role) -> Option<usize> {
        self.roles[role as usize]
    }

    fn pair(&self, [a, b]: [Role; 2]) -> Option<[usize; 2]> {
        Some([self.of(a)?, self.of(b)?])
    }
}

/// A table of a catalogue with its columns.
pub(super) struct Source {
    place: Place,
    /// The table, if it is in memory.
    frame: Option<DataFrame>,
    /// The artificial shear of all rows, if a FITS file has one table per sheared catalogue.
    version: Option<Option<usize>>,
    pub(super) columns: Columns,
    /// A column without a role that looks like independent units.
    pub(super) unit_column: Option<String>,
    /// All that is read.
    wanted: Vec<Operand>,
    /// Without artificial shear, and for each one.
    places: [Places; CATALOGUES],
    /// Columns of expressions that may change with shear and have no sheared columns.
    unanswered: Vec<String>,
    /// Whether flags and weights of the sheared catalogues give the response of the choice and of the weights.
    sheared_flags: bool,
    sheared_weight: bool,
    /// Flags of failed measurements of sheared catalogues.
    failed_versions: Vec<usize>,
    doubtful_weight: Option<usize>,
    /// Columns that say which rows count and are not used, with whether rows of value 1 do.
    choices: Vec<(usize, bool)>,
}

/// Whether a choice among the galaxies of a catalogue can have a response from its sheared columns.
fn answers(columns: &Columns) -> bool {
    // Catalogues with responses of galaxies often have only the selected quantities in sheared columns.
    match columns.preset {
        Preset::Metacal | Preset::Versions => true,
        Preset::Shearq | Preset::Anacal | Preset::Metadetect => false,
        Preset::Plain | Preset::Hsm => columns.have(&[Role::R11]),
    }
}

impl Source {
    /// Whether the selection is also known in each sheared catalogue, so that its response follows.
    pub(super) fn selects_versions(&self, reading: &Reading) -> bool {
        let chosen = reading.expressions().next().is_some();
        answers(&self.columns)
            && (chosen || self.sheared_flags || self.sheared_weight)
            && (self.places.iter()).all(|own| own.select.is_some() && own.binned.is_some())
    }

    /// Columns of `--where` and `--bins` by which shear changes the choice of galaxies, without a response of the choice.
    pub(super) fn unanswered(&self) -> &[String] {
        match self.has_version_rows() {
            // Each sheared catalogue is chosen by its own columns.
            true => &[],
            false => &self.unanswered,
        }
    }

    /// How ellipticities become shears.
    pub(super) fn shapes(&self, reading: &Reading) -> Shapes {
        reading.shapes.unwrap_or(match self.columns.distortion {
            true => Shapes::Responsivity,
            false => Shapes::Shear,
        })
    }

    /// What is used as what, and what is not used.
    pub(super) fn described(&self, reading: &Reading) -> Vec<String> {
        let responsivity = self.shapes(reading) == Shapes::Responsivity;
        let read = |role: Role| match role {
            Role::Unit => self.unit(reading).is_some(),
            Role::R12 | Role::R21 => self.has_matrix(reading),
            Role::RmsE | Role::SigmaE => responsivity,
            role => !reading.skips(role),
        };
        let mut lines = vec![format!("Used: {}.", self.columns.used(read))];
        let doubtful = self.columns.doubtful_weight.as_ref();
        let read = self.wanted.iter().map(|own| own.column.clone());
        let read: Vec<String> = read.filter(|name| Some(name) != doubtful).collect();
        lines.extend(self.columns.unused(&read));
        let first = &self.places[1];
        let flags = first.flags.iter().copied().filter(|_| self.sheared_flags);
        let weight = first.of(Role::Weight).filter(|_| self.sheared_weight);
        let sheared = flags.chain(weight);
        let sheared: Vec<&str> = sheared.map(|place| self.name(place)).collect();
        if !sheared.is_empty() {
            lines.push(format!(
                "Response of the choice and the weights: from {} and the other versions.",
                sheared.join(", ")
            ));
        }
        if responsivity {
            let rms = match (self.columns.of(Role::RmsE), self.columns.of(Role::SigmaE)) {
                (Some(rms), _) => format!("e_rms from {rms}"),
                (None, Some(sigma)) => format!("e_rms² = ⟨χ²⟩/2 − {sigma}²"),
                (None, None) => {
                    "e_rms² = ⟨χ²⟩/2, with the measurement noise. Try: --columns rms_e=NAME or sigma_e=NAME".into()
                }
            };
            lines.push(format!(
                "Shears from distortions: ⟨χ⟩/2ℛ with ℛ = 1 − ⟨w e_rms²⟩/⟨w⟩, {rms}. Moduli above 1 count. Try: --ellipticity distortion to convert each galaxy."
            ));
        }
        lines
    }

    /// The file, without the name of a table.
    pub(super) fn path(&self) -> &Path {
        &self.place.path
    }

    fn name(&self, place: usize) -> &str {
        &self.wanted[place].column
    }

    /// Whether rows belong to sheared catalogues.
    pub(super) fn has_version_rows(&self) -> bool {
        self.version.is_some() || self.columns.of(Role::ShearedCatalogue).is_some()
    }

    /// Whether the responses of each component to the other one are known.
    pub(super) fn has_matrix(&self, reading: &Reading) -> bool {
        let of_rows = match self.columns.preset {
            Preset::Metacal | Preset::Versions => self.columns.have_other_sheared(),
            _ => self.columns.have(&[Role::R12, Role::R21]),
        };
        let found = of_rows || reading.selection.is_some() || self.has_version_rows();
        found && !reading.names.decline_matrix()
    }

    /// Whether rows have the ellipticity of the PSF.
    pub(super) fn has_psf(&self) -> bool {
        self.columns.have(&[Role::Psf1, Role::Psf2])
    }

    /// Gives the wanted columns to `take`, in parts.
    fn parts(
        &self,
        reading: &Reading,
        mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
    ) -> Result<(), FileError> {
        if let Some(frame) = &self.frame {
            return take(frame.clone());
        }
        let mut names: Vec<&str> = Vec::new();
        for Operand { column, .. } in &self.wanted {
            if !names.contains(&column.as_str()) {
                names.push(column);
            }
        }
        let texts = names
            .iter()
            .copied()
            .filter(|name| self.is_text(reading, name));
        table::read_parts(&self.place, &names, &texts.collect::<Vec<_>>(), take)
    }

    /// Whether a column may be a text: identifiers, names of sheared catalogues, and what is compared with a pattern.
    fn is_text(&self, reading: &Reading, name: &str) -> bool {
        let mut operands = reading.expressions().flat_map(Expression::operands);
        let compared = operands.find(|own| own.column == name || own.column == base(name));
        match compared {
            Some(operand) => operand.pattern.is_some(),
            None => {
                let roles = [Role::Id, Role::ShearedCatalogue].map(|role| self.columns.of(role));
                roles.contains(&Some(name))
                    || self.unit(reading) == Some(name)
                    || self.columns.steps.iter().any(|step| step == name)
            }
        }
    }

    /// Column that names the unit.
    fn unit<'a>(&'a self, reading: &'a Reading) -> Option<&'a str> {
        match &reading.unit {
            Some(name) if name.is_empty() => None,
            Some(name) => Some(name),
            None => self.columns.of(Role::Unit),
        }
    }
}

/// Finds the tables of a catalogue and their columns.
pub(super) fn sources(input: &Input, reading: &Reading) -> Result<Vec<Source>, FileError> {
    let path = input.name.as_path();
    if let Some(frame) = &input.frame {
        let place = Place {
            path: path.to_owned(),
            table: None,
        };
        let names = frame.columns().iter().map(|own| own.name().to_string());
        let names: Vec<String> = names.collect();
        let mut source = source(place, None, &names, reading)?;
        source.frame = Some(frame.clone());
        return Ok(vec![source]);
    }
    let place = Place::of(path);
    let found = table::columns(&place)?;
    let mut tables = Vec::new();
    for list in &found.named {
        let Some((number, shown)) = list.table.as_ref().filter(|_| place.table.is_none()) else {
            continue;
        };
        let name = shown.split('`').nth(1).unwrap_or_default();
        if let Some(version) = version_named(name) {
            let place = Place {
                path: place.path.clone(),
                table: Some(number.to_string()),
            };
            tables.push(source(place, Some(version), &list.names, reading)?);
        }
    }
    if tables.len() == CATALOGUES {
        return Ok(tables);
    }
    let lists = || {
        found
            .named
            .iter()
            .filter(|list| !list.doubtful || found.named.len() == 1)
    };
    let good: Vec<_> = lists()
        .filter(|list| Columns::find(path, &list.names, &reading.names).is_ok())
        .collect();
    let tables: Vec<&str> = good
        .iter()
        .filter_map(|list| Some(list.table.as_ref()?.1.as_str()))
        .collect();
    if let [first, _, ..] = tables[..] {
        // Tables of chips share a name.
        let name = |shown: &&str| shown.split('`').nth(1).unwrap_or_default().to_owned();
        let own = name(&first);
        let unique = !own.is_empty()
            && own.parse::<u64>().is_err()
            && tables.iter().filter(|other| name(other) == own).count() == 1;
        let number = first.split(' ').next().unwrap_or_default();
        return Err(FileError::new(
            path,
            format!(
                "several tables have columns of ellipticities (found {}, expected one). Try: {}[{}]",
                shearq_files::names_of(&tables),
                path.display(),
                if unique { &own } else { number }
            ),
        ));
    }
    let Some(list) = good.first().copied().or_else(|| lists().next()) else {
        return Err(FileError::new(
            path,
            format!(
                "the columns have no names (found {} fields, expected a header such as `e1,e2`). Try: write a first line with names",
                found.unnamed.len()
            ),
        ));
    };
    let place = match (&place.table, &list.table) {
        (None, Some((number, _))) => Place {
            table: Some(number.to_string()),
            ..place
        },
        _ => place,
    };
    Ok(vec![source(place, None, &list.names, reading)?])
}

/// Columns of expressions that shear changes by an unknown amount.
fn unanswered(
    reading: &Reading,
    columns: &Columns,
    has_versions: impl Fn(&str) -> bool,
) -> Vec<String> {
    let names = reading.expressions().flat_map(Expression::columns);
    let names: BTreeSet<&str> = names
        .filter(|name| match columns.preset {
            Preset::Shearq => is_measured(name),
            _ => !is_fixed(name, columns) && !has_versions(name),
        })
        .collect();
    names.into_iter().map(str::to_owned).collect()
}

/// The columns that are read of a table with these names, each once.
struct Wanted<'a> {
    path: &'a Path,
    names: &'a [String],
    columns: &'a Columns,
    all: Vec<Operand>,
}

/// The places of all catalogues, and whether flags and weights of sheared ones are there.
struct Placed {
    places: [Places; CATALOGUES],
    sheared_flags: bool,
    sheared_weight: bool,
}

impl Wanted<'_> {
    /// The place of a column among those that are read; `None` if the table does not have it.
    fn add(&mut self, name: &str, pattern: Option<&String>) -> Option<usize> {
        if !self.names.iter().any(|own| own == name) {
            return None;
        }
        let operand = Operand {
            column: name.to_owned(),
            pattern: pattern.cloned(),
        };
        let known = self.all.iter().position(|own| *own == operand);
        Some(known.unwrap_or_else(|| {
            self.all.push(operand);
            self.all.len() - 1
        }))
    }

    /// The same for a column that must be there.
    fn require(&mut self, name: &str) -> Result<usize, FileError> {
        let found = self.add(name, None);
        found.ok_or_else(|| FileError::no_column(self.path, name, self.names))
    }

    /// The column of a sheared catalogue, in any case.
    fn sheared(&self, name: &str, version: &str) -> Option<String> {
        let wanted = format!("{}_{version}", base(name));
        let mut names = self.names.iter();
        names.find(|own| own.eq_ignore_ascii_case(&wanted)).cloned()
    }

    fn has_sheared(&self, name: &str) -> bool {
        let mut versions = SHEARED_CATALOGUES.iter();
        answers(self.columns) && versions.all(|(version, _)| self.sheared(name, version).is_some())
    }

    /// Whether a flag is a cut in all catalogues. Other flags of metacalibration with sheared ones are those of failed
    /// measurements.
    fn is_cut(&self, name: &str) -> bool {
        let by_name = name.to_ascii_lowercase().contains("select");
        (by_name || self.columns.preset != Preset::Metacal) && self.has_sheared(name)
    }

    /// The places of roles, flags and expressions. A column without sheared ones is the same in all catalogues if
    /// `by_versions`, or if flags or weights have sheared ones.
    fn places(&mut self, reading: &Reading, by_versions: bool) -> Result<Placed, FileError> {
        let columns = self.columns;
        let mut places: [Places; CATALOGUES] = Default::default();
        for ((role, catalogue), name) in columns.all() {
            if role != Role::Unit && !reading.skips(role) {
                places[catalogue].roles[role as usize] = self.add(name, None);
            }
        }
        let cuts = columns.flags.iter().any(|name| self.is_cut(name));
        let weight = columns
            .of(Role::Weight)
            .filter(|name| self.has_sheared(name));
        let by_versions = by_versions || cuts || weight.is_some();
        let selected = self.expression(reading.select.as_ref(), by_versions)?;
        let binned = self.expression(reading.binned.as_ref(), by_versions)?;
        let known = selected.iter().chain(&binned).all(Option::is_some);
        for (own, (selected, binned)) in places.iter_mut().zip(selected.into_iter().zip(binned)) {
            (own.select, own.binned) = (selected, binned);
        }
        let weight = weight.filter(|_| known);
        for (catalogue, own) in places.iter_mut().enumerate() {
            let version = catalogue
                .checked_sub(1)
                .map(|version| SHEARED_CATALOGUES[version].0);
            for flag in &columns.flags {
                let sheared = version.filter(|_| known && self.is_cut(flag));
                let sheared = sheared.and_then(|version| self.sheared(flag, version));
                own.flags
                    .push(self.require(sheared.as_ref().unwrap_or(flag))?);
            }
            if let (Some(name), Some(version)) = (weight, version) {
                let sheared = self.sheared(name, version);
                own.roles[Role::Weight as usize] = sheared.and_then(|name| self.add(&name, None));
            }
        }
        Ok(Placed {
            places,
            sheared_flags: cuts && known,
            sheared_weight: weight.is_some(),
        })
    }

    /// The operands of an expression in each catalogue that has them.
    fn expression(
        &mut self,
        expression: Option<&Expression>,
        by_versions: bool,
    ) -> Result<Vec<Option<Vec<usize>>>, FileError> {
        let Some(expression) = expression else {
            return Ok(vec![Some(Vec::new()); CATALOGUES]);
        };
        let mut own = Vec::new();
        for Operand { column, pattern } in expression.operands() {
            // Sheared catalogues of shearq have noise that other columns do not have.
            let plain = format!("{column}_noshear");
            let [first, second] = match self.columns.preset {
                Preset::Versions => [&plain, column],
                _ => [column, &plain],
            };
            let found = self.add(first, pattern.as_ref());
            let found = found.or_else(|| self.add(second, pattern.as_ref()));
            own.push(found.ok_or_else(|| FileError::no_column(self.path, column, self.names))?);
        }
        let mut all = vec![Some(own)];
        for (version, _) in SHEARED_CATALOGUES {
            // A column without sheared ones is the same in all, if there are sheared columns of another one.
            let operands = expression.operands().iter();
            let sheared = operands.map(|Operand { column, pattern }| {
                let own = self.add(&format!("{}_{version}", base(column)), pattern.as_ref());
                own.or_else(|| self.add(column, pattern.as_ref()).filter(|_| by_versions))
            });
            all.push(sheared.collect());
        }
        Ok(all)
    }
}

fn source(
    place: Place,
    version: Option<Option<usize>>,
    names: &[String],
    reading: &Reading,
) -> Result<Source, FileError> {
    let path = &place.path;
    let mut columns = Columns::find(path, names, &reading.names)?;
    if matches!(reading.truth, Truth::Columns) && !columns.have(&[Role::G1]) {
        reading.names.check_true_shear(path)?;
    }
    let has_versions = |name: &str| names.contains(&format!("{}_1p", base(name)));
    let mut named = reading.expressions().flat_map(Expression::columns);
    // Also if one of them is named.
    let by_versions = (named.clone()).any(|name| has_versions(name) || version_of(name).is_some());
    columns.choose_versions(names, by_versions && reading.selection.is_none());
    if columns.preset == Preset::Versions {
        check_named(path, named.clone(), has_versions)?;
    }
    if columns.of_sheared((Role::E1, 1)).is_some() && named.any(has_versions) {
        check_step(path, reading.step)?;
    }
    let mut wanted = Wanted {
        path,
        names,
        columns: &columns,
        all: Vec::new(),
    };
    let Placed {
        places,
        sheared_flags,
        sheared_weight,
    } = wanted.places(reading, by_versions)?;
    let doubtful_weight = columns.doubtful_weight.as_ref();
    let doubtful_weight = doubtful_weight.and_then(|name| wanted.add(name, None));
    for name in &columns.steps {
        wanted.require(name)?;
    }
    let unanswered = unanswered(reading, &columns, has_versions);
    let mut failed_versions = Vec::new();
    for name in names.iter().filter(|_| columns.preset == Preset::Metacal) {
        let small = name.to_ascii_lowercase();
        let is_flag = small.contains("flag") && !small.contains("select");
        if is_flag && version_of(&small).is_some() {
            failed_versions.push(wanted.require(name)?);
        }
    }
    let mut choices = Vec::new();
    for (name, good) in &columns.choices {
        if !reading
            .expressions()
            .flat_map(Expression::columns)
            .any(|own| own == name)
        {
            choices.push((wanted.require(name)?, *good));
        }
    }
    if reading.selection.is_some() {
        require_responses(path, names.iter().map(String::as_str))?;
        for name in READ.iter().chain(&Observables::COLUMNS) {
            wanted.require(name)?;
        }
    }
    let like_unit = |name: &&String| fits_any(UNITS, &name.to_ascii_lowercase());
    let unit_column = names.iter().find(like_unit).cloned();
    let unit = match &reading.unit {
        Some(name) => Some(name.as_str()).filter(|name| !name.is_empty()),
        None => columns.of(Role::Unit),
    };
    if let Some(unit) = unit {
        wanted.require(unit)?;
    }
    let wanted = wanted.all;
    Ok(Source {
        place,
        frame: None,
        version,
        columns,
        unit_column,
        wanted,
        places,
        unanswered,
        sheared_flags,
        sheared_weight,
        failed_versions,
        doubtful_weight,
        choices,
    })
}

/// Whether shear does not change a column, judged by its role and name.
fn is_fixed(name: &str, columns: &Columns) -> bool {
    use Role::{Flag, G1, G2, Id, Psf1, Psf2, PsfSize, Unit, X, Y};
    let roles = [G1, G2, Id, Psf1, Psf2, PsfSize, Unit, X, Y, Flag];
    let mut flags = columns.flags.iter();
    roles.iter().any(|role| columns.of(*role) == Some(name))
        || flags.any(|flag| flag.eq_ignore_ascii_case(name))
        || fits_any(FIXED, &name.to_ascii_lowercase())
}

/// The name of a column of one sheared catalogue, without the name of the shear.
fn version_of(name: &str) -> Option<&str> {
    let mut versions = SHEARED_CATALOGUES.iter();
    versions.find_map(|(version, _)| name.strip_suffix(version)?.strip_suffix('_'))
}

/// Whether a column of shearq's catalogues was measured on the galaxies.
fn is_measured(name: &str) -> bool {
    let known = Observables::COLUMNS.contains(&name) || READ.contains(&name);
    (known || name == "snr" || name == "radius") && name != "flags"
}

/// Checks that the columns of an expression have versions, unless they do not change with shear.
fn check_named<'a>(
    path: &Path,
    named: impl Iterator<Item = &'a str>,
    has_versions: impl Fn(&str) -> bool,
) -> Result<(), FileError> {
    for name in named {
        if let Some(base) = version_of(name).filter(|base| has_versions(base)) {
            return Err(FileError::new(
                path,
                format!(
                    "`{name}` belongs to one sheared version (expected a column of all). Try: {base}"
                ),
            ));
        }
        if is_measured(name) && !has_versions(name) {
            return Err(FileError::new(
                path,
                format!(
                    "galaxies cannot be selected by `{name}`: it changes with shear, and has no sheared versions (expected e1, e2, snr, flux or size)"
                ),
            ));
        }
    }
    Ok(())
}

/// Checks that the versions of a catalogue of shearq are for a shear of `step`, if its settings are there.
fn check_step(path: &Path, step: f64) -> Result<(), FileError> {
    let key = "settings".to_owned();
    let stated = || {
        let read = table::read_metadata(path, FileFormat::of(path)?, std::iter::once(&key));
        let metadata = read.ok()?;
        let settings: toml::Table = metadata.get(&key)?.parse().ok()?;
        settings.get("shape")?.get("sheared_step")?.as_float()
    };
    match stated() {
        Some(stated) if stated != step => Err(FileError::new(
            path,
            format!(
                "the sheared versions are for another shear (found {stated}, expected {step}). Try: --step {stated}"
            ),
        )),
        _ => Ok(()),
    }
}

/// Reads the rows of a catalogue and gives those that count to `take`, with a description of the catalogue.
pub(super) fn rows(
    path: &Path,
    reading: &Reading,
    sources: &[Source],
    mut take: impl FnMut(&Item) -> Result<(), FileError>,
) -> Result<Catalogue, FileError> {
    let mut about = Catalogue {
        name: path.display().to_string(),
        ..Catalogue::default()
    };
    let own = [Preset::Shearq, Preset::Versions];
    if let Some(first) = sources
        .first()
        .filter(|first| own.contains(&first.columns.preset))
    {
        let path = &first.place.path;
        about.star = match (&first.frame, FileFormat::of(path)) {
            (Some(frame), _) => star_noise::of_table(frame, path),
            (None, Some(format)) => star_noise::of_any(path, format)?,
            (None, None) => None,
        };
    }
    // Rows of each version so far.
    let mut counts = [0u64; CATALOGUES];
    let mut shared = Shared::default();
    for source in sources {
        let (mut first, mut ranges) = (0, None::<Ranges>);
        source.parts(reading, |frame| {
            let mut part = Part::new(source, reading, &frame, path)?;
            // The units of all parts are those of the first.
            part.ranges = *ranges.get_or_insert_with(|| part.ranges());
            shared.look_for(&part);
            for at in 0..part.rows {
                part.row(at, first + at, &mut counts, &mut about, &mut |item| {
                    if item.version.is_none() && item.binned[0].is_finite() {
                        shared.add(&part, at);
                    }
                    take(item)
                })?;
            }
            first += part.rows;
            Ok(())
        })?;
    }
    about.rows = counts[0];
    if let Some(first) = sources.first() {
        check_share(path, first, reading, &about)?;
        shared.check_choices(path, first)?;
    }
    about.repeated = sources
        .first()
        .map_or_else(Vec::new, |first| shared.found(first));
    Ok(about)
}

/// Rows of a part that are searched for ellipticities that occur several times.
const SEARCHED: usize = 4096;

/// Pairs of numbers that several rows share exactly, with numbers of rows. Of a part with more than [`SEARCHED`] rows,
/// ellipticities that one row in a thousand has are found.
#[derive(Default)]
struct Shared {
    ellipticities: HashMap<[u64; 2], u64>,
    no_response: u64,
    no_psf: u64,
    used: u64,
    /// Rows that count although a column of [`Source::choices`] excludes them.
    excluded: Vec<u64>,
    columns: Vec<SharedColumn>,
}

/// Numbers of one column that several rows have, and how many different ones there are in the searched rows.
struct SharedColumn {
    column: usize,
    /// Whether zeros are values like others: derivatives of a smooth cut far from it.
    has_zeros: bool,
    counts: HashMap<u64, u64>,
    different: usize,
}

/// Numbers with few digits are shared by many rows, but the ten that most rows have are about equally frequent: around its
/// maximum, a distribution is flat. One number that is so much more frequent than the tenth stands for something else.
const FREQUENT: usize = 10;

impl Shared {
    fn look_for(&mut self, part: &Part<'_>) {
        let stride = part.rows.div_ceil(SEARCHED).max(1);
        let mut seen = HashSet::new();
        for at in (0..part.rows).step_by(stride) {
            let e = part.pair(part.e, at);
            if e.iter().all(|e| e.is_finite()) && !seen.insert(Self::key(e)) {
                self.ellipticities.entry(Self::key(e)).or_default();
            }
        }
        // Half of the failures in one of 1000 rows of a small catalogue are enough.
        self.look_in_columns(part, part.rows.div_ceil(4 * SEARCHED).max(1));
    }

    fn look_in_columns(&mut self, part: &Part<'_>, stride: usize) {
        if self.columns.is_empty() {
            let own = [Preset::Shearq, Preset::Versions].contains(&part.source.columns.preset);
            let places = &part.source.places[0];
            let ksb = places.pair(KSB).is_some();
            let measured = [Some(part.e).filter(|_| !ksb), places.pair(RESPONSE)];
            let sheared = [part.sheared(OWN), part.sheared(OTHER)];
            let measured = measured.into_iter().flatten();
            let measured = measured.chain(sheared.into_iter().flatten().flatten());
            let no_rms = part.shapes == Shapes::Responsivity && places.of(Role::RmsE).is_none();
            let sigma = places.of(Role::SigmaE).filter(|_| no_rms);
            let measured = measured
                .flatten()
                .chain(sigma)
                .map(|column| (column, false));
            let derivatives = places.pair(DERIVATIVE).into_iter().flatten();
            let all = measured.chain(derivatives.map(|column| (column, true)));
            self.columns = all
                .filter(|_| !own)
                .map(|(column, has_zeros)| SharedColumn {
                    column,
                    has_zeros,
                    counts: HashMap::new(),
                    different: 0,
                })
                .collect();
        }
        for own in &mut self.columns {
            let mut seen = HashSet::new();
            for at in (0..part.rows).step_by(stride) {
                let value = part.value(own.column, at);
                let counts = value.is_finite() && !(own.has_zeros && value == 0.0);
                if counts && !seen.insert((value + 0.0).to_bits()) {
                    own.counts.entry((value + 0.0).to_bits()).or_default();
                }
            }
            own.different = own.different.max(seen.len());
        }
    }

    /// The number that stands out in a column.
    fn standing_out(&self, own: &SharedColumn) -> Option<(f64, u64)> {
        if own.different <= FREQUENT && !own.has_zeros {
            return None;
        }
        let mut counts: Vec<(u64, u64)> = own.counts.iter().map(|(v, n)| (*n, *v)).collect();
        counts.sort_unstable_by(|a, b| b.cmp(a));
        let (most, value) = *counts.first()?;
        let tenth = counts
            .get(FREQUENT - 1)
            .map_or(1, |(count, _)| (*count).max(1));
        let stands_out = most > FREQUENT as u64 * tenth;
        (stands_out && most < self.used).then_some((f64::from_bits(value), most))
    }

    /// Refuses rows of which an unused column says that they do not count, if other rows do.
    fn check_choices(&self, path: &Path, source: &Source) -> Result<(), FileError> {
        let found = self.excluded.iter().zip(&source.choices);
        let mut found = found.filter(|(rows, _)| (1..self.used).contains(rows));
        let Some((rows, (column, good))) = found.next() else {
            return Ok(());
        };
        let name = source.name(*column);
        let choice = match good {
            true => name.to_owned(),
            false => format!("not({name})"),
        };
        Err(FileError::new(
            path,
            format!(
                "`{name}` excludes {rows} of {} rows that would count (expected none). Try: --where '{choice}', or --where '{name} > -1' for all rows",
                self.used
            ),
        ))
    }

    /// Zeros with either sign are equal.
    fn key(e: [f64; 2]) -> [u64; 2] {
        e.map(|e| (e + 0.0).to_bits())
    }

    fn add(&mut self, part: &Part<'_>, at: usize) {
        let places = &part.source.places[0];
        self.used += 1;
        let choices = &part.source.choices;
        self.excluded.resize(choices.len(), 0);
        for (count, (column, good)) in self.excluded.iter_mut().zip(choices) {
            *count += u64::from((part.value(*column, at) != 0.0) != *good);
        }
        for own in &mut self.columns {
            if !own.counts.is_empty() {
                let value = part.value(own.column, at) + 0.0;
                if let Some(count) = own.counts.get_mut(&value.to_bits()) {
                    *count += 1;
                }
            }
        }
        let is_zero =
            |columns: Option<[usize; 2]>| columns.is_some_and(|own| part.pair(own, at) == [0.0; 2]);
        self.no_response += u64::from(is_zero(places.pair(RESPONSE)));
        self.no_psf += u64::from(is_zero(places.pair(PSF)));
        if !self.ellipticities.is_empty()
            && let Some(count) = self
                .ellipticities
                .get_mut(&Self::key(part.pair(part.e, at)))
        {
            *count += 1;
        }
    }

    /// The ellipticity that most rows share, if it is no coincidence of numbers with few digits (with two digits, 10⁴
    /// galaxies share one in ten rows at most), and zeros of responses and PSFs that not all rows have.
    fn found(&self, source: &Source) -> Vec<Repeated> {
        let most = self.ellipticities.iter();
        let most = most.max_by_key(|(e, count)| (**count, **e));
        let most = most.filter(|(_, count)| **count >= 3.max(self.used.div_ceil(1000)));
        let most = most.map(|(e, count)| (e.map(f64::from_bits), *count));
        let some = |zeros: u64| {
            let some = zeros >= 3 && zeros < self.used;
            some.then_some(([0.0; 2], zeros))
        };
        let all = [
            (most, [Role::E1, Role::E2]),
            (some(self.no_response), [Role::R11, Role::R22]),
            (some(self.no_psf), [Role::Psf1, Role::Psf2]),
        ];
        let repeated = |(found, roles): (Option<([f64; 2], u64)>, [Role; 2])| {
            let (values, rows) = found?;
            let columns = roles.map(|role| source.columns.of(role).unwrap_or_default().to_owned());
            Some(Repeated {
                columns,
                values,
                rows,
            })
        };
        let mut found: Vec<Repeated> = all.into_iter().filter_map(repeated).collect();
        for own in &self.columns {
            let name = source.name(own.column).to_owned();
            let known = found.iter().any(|pair| pair.columns.contains(&name));
            if let Some((value, rows)) = self.standing_out(own).filter(|_| !known) {
                found.push(Repeated {
                    columns: [name.clone(), name],
                    values: [value; 2],
                    rows,
                });
            }
        }
        found
    }
}

const PSF: [Role; 2] = [Role::Psf1, Role::Psf2];
const RESPONSE: [Role; 2] = [Role::R11, Role::R22];
const OTHER_RESPONSE: [Role; 2] = [Role::R12, Role::R21];
const DERIVATIVE: [Role; 2] = [Role::Dw1, Role::Dw2];
const KSB: [Role; 2] = [Role::KsbE1, Role::KsbE2];
/// Ellipticities under positive and negative artificial shears of the same component, and of the other one.
const OWN: [[Key; 2]; 2] = [
    [(Role::E1, 1), (Role::E1, 2)],
    [(Role::E2, 3), (Role::E2, 4)],
];
const OTHER: [[Key; 2]; 2] = [
    [(Role::E1, 3), (Role::E1, 4)],
    [(Role::E2, 1), (Role::E2, 2)],
];

/// Ranges of the measured quantities of a catalogue.
#[derive(Clone, Copy, Default)]
struct Ranges {
    e: MeasuredRange,
    response: MeasuredRange,
    derivative: MeasuredRange,
    psf_size: MeasuredRange,
}

/// Weights in any unit are smaller; programs write 1e20, 1e30 or the largest number for a failure.
const HUGE: f64 = 1e20;
/// Values from which a range is determined.
const SAMPLED: usize = 1 << 16;

/// Columns of some rows.
struct Part<'a> {
    source: &'a Source,
    reading: &'a Reading,
    rows: usize,
    columns: Vec<Cow<'a, [f64]>>,
    /// The rows after a selection.
    weighted: Option<Weighted>,
    /// The columns of the ellipticity.
    e: [usize; 2],
    versions: Option<Vec<Option<usize>>>,
    frame: &'a DataFrame,
    /// Keys of the identifiers of galaxies and of units.
    ids: Option<Vec<u64>>,
    units: Option<Vec<u64>>,
    truth: OfRows<'a>,
    shapes: Shapes,
    ranges: Ranges,
}

/// Whether a row with this weight counts. NaN does, so that it is refused.
fn weighs(weight: f64) -> bool {
    weight.is_nan() || weight > 0.0
}

/// Why a row without a flag does not count.
enum LeftOut {
    /// A number stands for a failed measurement.
    Failed,
    /// A distortion above 1 has no shear.
    AboveOne,
    /// NaN or infinity.
    Missing,
}

/// Where the true shears of the rows of a catalogue are.
#[derive(Clone, Copy)]
enum OfRows<'a> {
    /// One shear.
    Constant([f64; 2]),
    /// By identifier.
    Identifiers(&'a HashMap<u64, [f64; 2]>),
    /// By the position in two columns.
    Positions(&'a Positions, [usize; 2]),
    /// In two columns.
    Columns([usize; 2]),
    /// Unknown.
    Nowhere,
}

impl<'a> OfRows<'a> {
    fn new(path: &Path, places: &Places, truth: &'a Truth) -> Result<Self, FileError> {
        let absent = |what: &str, option: &str| {
            FileError::new(
                path,
                format!(
                    "the catalogue has no {what} to find the true shear with. Try: --columns {option}"
                ),
            )
        };
        if let Some(positions) = truth.positions(path)? {
            let position = places.pair([Role::X, Role::Y]);
            let position = position.ok_or_else(|| absent("positions", "x=NAME,y=NAME"))?;
            return Ok(OfRows::Positions(positions, position));
        }
        if let Truth::Galaxies(galaxies) = truth {
            let id = places.of(Role::Id);
            id.ok_or_else(|| absent("identifier", "id=NAME"))?;
            return Ok(OfRows::Identifiers(galaxies));
        }
        Ok(
            match (truth.of_catalogue(path), places.pair([Role::G1, Role::G2])) {
                (Some(shear), _) => OfRows::Constant(shear),
                (None, Some(columns)) => OfRows::Columns(columns),
                (None, None) => OfRows::Nowhere,
            },
        )
    }

    /// Whether a row may be absent from the truth.
    fn may_lack_rows(self) -> bool {
        matches!(self, OfRows::Identifiers(..) | OfRows::Positions(..))
    }
}

/// A galaxy's ellipticity, and the derivatives of the weighted one with its own and with the other component of shear.
struct Shape {
    e: [f64; 2],
    slope: [f64; 2],
    cross: [f64; 2],
}

impl<'a> Part<'a> {
    fn new(
        source: &'a Source,
        reading: &'a Reading,
        frame: &'a DataFrame,
        catalogue: &Path,
    ) -> Result<Self, FileError> {
        let path = &source.place.path;
        let places = &source.places[0];
        let truth = OfRows::new(catalogue, places, &reading.truth)?;
        let version = source.columns.of(Role::ShearedCatalogue);
        let mut columns = Vec::new();
        for Operand { column, pattern } in &source.wanted {
            columns.push(match pattern {
                Some(pattern) => Cow::Owned(compared(frame, column, pattern, path)?),
                None if source.is_text(reading, column) => Cow::Borrowed(&[][..]),
                None => table::numbers(frame, column, path)?,
            });
        }
        check_steps(frame, &source.columns, path)?;
        check_selected(frame, source, reading)?;
        let keys = |name: &str| identity::keys(frame, name, path);
        let ids = source.columns.of(Role::Id).map(keys).transpose()?;
        let units = source.unit(reading).map(keys).transpose()?;
        let versions = version
            .map(|name| versions(frame, name, path))
            .transpose()?;
        let weighted = reading.selection.as_ref().map(|selection| {
            Weighted::of(path, selection, |name| table::numbers(frame, name, path))
        });
        Ok(Part {
            ranges: Ranges::default(),
            weighted: weighted.transpose()?,
            source,
            reading,
            rows: frame.height(),
            columns,
            e: places.pair([Role::E1, Role::E2]).unwrap_or_default(),
            versions,
            frame,
            ids,
            units,
            truth,
            shapes: source.shapes(reading),
        })
    }

    fn places(&self) -> &Places {
        &self.source.places[0]
    }

    /// The columns of ellipticities under artificial shears, if all are there.
    fn sheared(&self, keys: [[Key; 2]; 2]) -> Option<[[usize; 2]; 2]> {
        let place = |(role, catalogue): Key| self.source.places[catalogue].of(role);
        let pair = |[plus, minus]: [Key; 2]| Some([place(plus)?, place(minus)?]);
        Some([pair(keys[0])?, pair(keys[1])?])
    }

    fn value(&self, column: usize, at: usize) -> f64 {
        self.columns[column][at]
    }

    /// The ranges of the quantities in these rows.
    fn ranges(&self) -> Ranges {
        let places = self.places();
        let of = |columns: &[usize]| {
            let stride = (columns.len() * self.rows).div_ceil(SAMPLED).max(1);
            let values = columns
                .iter()
                .flat_map(|column| self.columns[*column].iter().step_by(stride).copied());
            MeasuredRange::from_values(&values.collect::<Vec<_>>())
        };
        let pair = |columns: Option<[usize; 2]>| match columns {
            Some(columns) => of(&columns),
            None => MeasuredRange::ELLIPTICITY,
        };
        // Ellipticities with a response may have any unit.
        let response = places.pair(RESPONSE);
        let any_unit =
            response.is_some() || self.sheared(OWN).is_some() || self.source.has_version_rows();
        Ranges {
            e: pair(Some(self.e).filter(|_| any_unit)),
            response: pair(response),
            derivative: pair(places.pair(DERIVATIVE)),
            psf_size: pair(places.of(Role::PsfSize).map(|size| [size; 2])),
        }
    }

    /// The columns of the ellipticity of a row. GalSim's HSM writes −10 into those that its method does not determine.
    fn shape_columns(&self, at: usize) -> [usize; 2] {
        match (self.places().pair(KSB), self.pair(self.e, at)) {
            (Some(ksb), [-10.0, -10.0]) => ksb,
            _ => self.e,
        }
    }

    /// A number of a row that stands for a failed measurement: its column and what was expected.
    fn failure(&self, at: usize) -> Option<(usize, &'static str)> {
        let (places, ranges) = (self.places(), &self.ranges);
        let value = |column: usize| self.value(column, at);
        let outside = |columns: Option<[usize; 2]>, range: MeasuredRange| {
            let mut columns = columns.into_iter().flatten();
            columns.find(|column| range.excludes(value(*column)))
        };
        let sheared = [self.sheared(OWN), self.sheared(OTHER)];
        let mut shapes =
            std::iter::once(self.shape_columns(at)).chain(sheared.into_iter().flatten().flatten());
        // Distortions are below 1 and so is their scatter. Without noise, sigma is zero.
        let responsivity = self.shapes == Shapes::Responsivity;
        let rms = places.of(Role::RmsE).filter(|_| responsivity);
        let sigma = places
            .of(Role::SigmaE)
            .filter(|_| responsivity && rms.is_none());
        let wrong = |value: f64| MeasuredRange::ELLIPTICITY.excludes(value);
        let failed_rms =
            |rms: &usize| value(*rms) <= 0.0 || value(*rms) > 1.0 || wrong(value(*rms));
        let failed_sigma = |sigma: &usize| value(*sigma) < 0.0 || wrong(value(*sigma));
        let sheared_weights = (self.source.places[1..].iter())
            .filter_map(|own| own.of(Role::Weight).filter(|_| self.source.sheared_weight));
        let size = places.of(Role::PsfSize);
        let found = shapes
            .find_map(|columns| outside(Some(columns), ranges.e))
            .map(|column| (column, "an ellipticity"));
        found
            .or_else(|| {
                let expected = "a standard deviation, above 0 and at most 1";
                Some((rms.filter(failed_rms)?, expected))
            })
            .or_else(|| Some((sigma.filter(failed_sigma)?, "a standard deviation of noise")))
            .or_else(|| {
                let mut flags = self.source.failed_versions.iter().copied();
                let failed = flags.find(|flag| value(*flag) != 0.0)?;
                Some((failed, "0, as for a version that was measured"))
            })
            .or_else(|| {
                let mut weights = sheared_weights;
                let is_none = |own: &usize| value(*own).is_nan() || value(*own) >= HUGE;
                Some((weights.find(is_none)?, "a weight"))
            })
            .or_else(|| {
                let own = outside(places.pair(RESPONSE), ranges.response);
                let other = || outside(places.pair(OTHER_RESPONSE), ranges.response);
                Some((own.or_else(other)?, "a response"))
            })
            .or_else(|| {
                let found = outside(places.pair(DERIVATIVE), ranges.derivative);
                Some((found?, "a derivative"))
            })
            .or_else(|| {
                let mut psf = places.pair(PSF).into_iter().flatten();
                let round = psf.find(|column| value(*column).abs() >= 1.0);
                Some((round?, "an ellipticity of a PSF, below 1"))
            })
            .or_else(|| {
                let failed =
                    |own: &usize| value(*own) <= 0.0 || ranges.psf_size.excludes(value(*own));
                Some((size.filter(failed)?, "a size of a PSF, above 0"))
            })
            .or_else(|| {
                let weight = places.of(Role::Weight);
                Some((weight.filter(|own| value(*own) >= HUGE)?, "a weight"))
            })
    }

    fn pair(&self, columns: [usize; 2], at: usize) -> [f64; 2] {
        columns.map(|column| self.columns[column][at])
    }

    /// A column that looks like a weight, is not used, and would leave out this row.
    fn unused_weight(&self, at: usize) -> Option<(&str, f64)> {
        let place = self.source.doubtful_weight?;
        let (name, value) = (self.source.name(place), self.value(place, at));
        (value.is_nan() || value <= 0.0).then_some((name, value))
    }

    /// A row without its true shear, or why it is left out.
    fn measured(
        &self,
        at: usize,
        weight: f64,
        binned: f64,
    ) -> Result<Result<Row, LeftOut>, String> {
        let places = self.places();
        if let Some((column, expected)) = self.failure(at) {
            if self.reading.drop_missing {
                return Ok(Err(LeftOut::Failed));
            }
            let of_psf = [Role::Psf1, Role::Psf2, Role::PsfSize].map(|role| places.of(role));
            let of_psf = of_psf.contains(&Some(column));
            let all_equal = || {
                let value = self.value(column, at);
                self.columns[column].iter().all(|other| *other == value)
            };
            let remedy = match of_psf && all_equal() {
                true => "--columns psf_e1=none,psf_e2=none,psf_size=none",
                false => "--drop-missing",
            };
            return Err(format!(
                "column `{}` is {} in a row without a flag, which stands for a failed measurement (expected {expected}). Try: {remedy}",
                self.source.name(column),
                shown(self.value(column, at))
            ));
        }
        let Some(Shape { e, slope, cross }) = self.shape(at, weight) else {
            return Ok(Err(LeftOut::AboveOne));
        };
        let psf = places.pair(PSF).map_or([0.0; 2], |psf| self.pair(psf, at));
        let psf_size = places
            .of(Role::PsfSize)
            .map_or(1.0, |size| self.value(size, at));
        let expression = if binned.is_nan() { f64::NAN } else { 0.0 };
        let checked = [
            ("e1", e[0]),
            ("e2", e[1]),
            ("the weight", weight),
            (
                "the response or its derivative",
                slope[0] + slope[1] + cross[0] + cross[1],
            ),
            ("the PSF's ellipticity or size", psf[0] + psf[1] + psf_size),
            ("the expression of --where or --bins", expression),
        ];
        match checked.iter().find(|(_, value)| !value.is_finite()) {
            Some(_) if self.reading.drop_missing => Ok(Err(LeftOut::Missing)),
            Some((what, value)) => Err(format!(
                "{what} is {value} in a row without a flag (expected a number). Try: --drop-missing"
            )),
            None => Ok(Ok(Row {
                e,
                weight,
                slope,
                cross,
                g: [0.0; 2],
                psf,
                psf_size,
            })),
        }
    }

    /// Weights of a row in the sheared catalogues, and which of them it belongs to: one may choose a row that is left out
    /// without shear.
    fn versions_of(
        &self,
        at: usize,
        weight: f64,
    ) -> (
        [f64; SHEARED_CATALOGUES.len()],
        [bool; SHEARED_CATALOGUES.len()],
    ) {
        let all = std::array::from_fn(|version| {
            let own = &self.source.places[version + 1];
            let weight = match own.of(Role::Weight).filter(|_| self.source.sheared_weight) {
                Some(place) => self.value(place, at),
                None => weight,
            };
            (weight, !self.is_flagged(own, at) && weighs(weight))
        });
        (all.map(|own| own.0), all.map(|own| own.1))
    }

    fn is_flagged(&self, places: &Places, at: usize) -> bool {
        places.flags.iter().any(|flag| self.value(*flag, at) != 0.0)
    }

    /// Gives a row to `take` if it counts. `number` counts rows of the table from 0.
    fn row(
        &self,
        at: usize,
        number: usize,
        counts: &mut [u64; CATALOGUES],
        about: &mut Catalogue,
        take: &mut impl FnMut(&Item) -> Result<(), FileError>,
    ) -> Result<(), FileError> {
        let places = self.places();
        let version = match (&self.versions, self.source.version) {
            (Some(versions), _) => versions[at],
            (None, version) => version.flatten(),
        };
        let count = &mut counts[version.map_or(0, |version| version + 1)];
        let index = *count;
        *count += 1;
        let own = version.is_none();
        let flagged = self.is_flagged(places, at);
        let weight = places
            .of(Role::Weight)
            .map_or(1.0, |weight| self.value(weight, at));
        let counted = !flagged && weighs(weight);
        let (of_versions, in_versions) = self.versions_of(at, weight);
        if !counted {
            let count = match flagged {
                true => &mut about.flagged,
                false => &mut about.unweighted,
            };
            *count += u64::from(own);
            if in_versions == [false; SHEARED_CATALOGUES.len()] {
                return Ok(());
            }
        }
        let fault = |what: String| {
            let row = number + 1;
            FileError::new(&self.source.place.path, format!("row {row}: {what}"))
        };
        if let Some((name, value)) = self.unused_weight(at) {
            return Err(fault(format!(
                "`{name}` looks like a weight but is not used, and is {value} here, so that this galaxy would count wrongly. Try: --columns w={name}, or w=none"
            )));
        }
        let left_out = |weighted: &Weighted| weighted.weight[at] <= 0.0;
        if self.weighted.as_ref().is_some_and(left_out) {
            about.unselected += u64::from(own);
            return Ok(());
        }
        let mut binned = self.binned(at);
        about.unselected += u64::from(own && counted && binned[0].is_infinite());
        let left_out = std::iter::once(!counted).chain(in_versions.map(|own| !own));
        for (bin, _) in binned.iter_mut().zip(left_out).filter(|(_, out)| *out) {
            *bin = f64::INFINITY;
        }
        if binned.iter().all(|value| value.is_infinite()) {
            return Ok(());
        }
        let weight = match &self.weighted {
            Some(weighted) => weighted.weight[at],
            None => weight,
        };
        let mut row = match self.measured(at, weight, binned[0]).map_err(&fault)? {
            Ok(row) => row,
            Err(reason) => {
                let count = match reason {
                    LeftOut::Failed => &mut about.failed,
                    LeftOut::AboveOne => &mut about.above_one,
                    LeftOut::Missing => &mut about.missing,
                };
                *count += u64::from(own);
                return Ok(());
            }
        };
        row.g = match self.truth(at) {
            Err(_) if self.reading.drop_missing && self.truth.may_lack_rows() => {
                about.missing += u64::from(own);
                return Ok(());
            }
            found => found.map_err(&fault)?,
        };
        positions::check(row.g).map_err(&fault)?;
        if self.reading.flip_g2 {
            row.g[1] = -row.g[1];
        }
        if own {
            for k in 0..2 {
                about.shear[k].add(row.g[k]);
                about.ellipticity[k].add(row.e[k]);
            }
        }
        take(&Item {
            key: self.key(at, index),
            version,
            weights: match self.source.sheared_weight {
                true => of_versions,
                false => [row.weight; SHEARED_CATALOGUES.len()],
            },
            row,
            binned,
        })
    }

    /// The ellipticity, and the derivatives of the weighted ellipticity with shear.
    fn shape(&self, at: usize, weight: f64) -> Option<Shape> {
        let places = self.places();
        if let Some(weighted) = &self.weighted {
            // Both are of the weighted ellipticity.
            return Some(Shape {
                e: [0, 1].map(|k| weighted.e[k][at] / weight),
                slope: [0, 1].map(|k| weighted.response[k][at]),
                cross: [0, 1].map(|k| weighted.cross[k][at]),
            });
        }
        let columns = self.shape_columns(at);
        let mut e = self.pair(columns, at);
        match if columns == self.e {
            self.shapes
        } else {
            Shapes::Shear
        } {
            Shapes::Converted if e.iter().all(|e| e.is_finite()) => {
                let shear = Distortion::new(e[0], e[1]).to_shear()?;
                e = [shear.e1, shear.e2];
            }
            Shapes::Shear | Shapes::Converted => {}
            Shapes::Responsivity => {
                let value = |place: Option<usize>| place.map(|place| self.value(place, at));
                let square = match (value(places.of(Role::RmsE)), value(places.of(Role::SigmaE))) {
                    (Some(rms), _) => rms * rms,
                    (None, sigma) => {
                        0.5 * (e[0] * e[0] + e[1] * e[1]) - sigma.map_or(0.0, |sigma| sigma * sigma)
                    }
                };
                return Some(Shape {
                    e,
                    slope: [2.0 * weight * (1.0 - square); 2],
                    cross: [0.0; 2],
                });
            }
        }
        if self.source.has_version_rows() {
            // The response follows from the versions.
            return Some(Shape {
                e,
                slope: [0.0; 2],
                cross: [0.0; 2],
            });
        }
        let step = 2.0 * self.reading.step;
        let differences = |sheared: [[usize; 2]; 2]| {
            sheared.map(|[plus, minus]| (self.value(plus, at) - self.value(minus, at)) / step)
        };
        // Configurations without a response have none, and no divisor.
        let divided = |response: [usize; 2], divisor: [usize; 2], without: f64| {
            let (response, divisor) = (self.pair(response, at), self.pair(divisor, at));
            [0, 1].map(|k| match response[k] / divisor[k] {
                ratio if ratio.is_nan() => without,
                ratio => ratio,
            })
        };
        let divisor = places.pair([Role::Divisor1, Role::Divisor2]);
        let of = |columns: Option<[usize; 2]>, without: f64| match (columns, divisor) {
            (None, _) => [without; 2],
            (Some(response), Some(divisor)) => divided(response, divisor, without),
            (Some(response), None) => self.pair(response, at),
        };
        let (response, other) = match self.sheared(OWN) {
            Some(own) => (
                differences(own),
                self.sheared(OTHER).map_or([0.0; 2], differences),
            ),
            None => (
                of(places.pair(RESPONSE), 1.0),
                of(places.pair(OTHER_RESPONSE), 0.0),
            ),
        };
        let derivative = places
            .pair(DERIVATIVE)
            .map_or([0.0; 2], |d| self.pair(d, at));
        Some(Shape {
            e,
            slope: [0, 1].map(|k| weight * response[k] + e[k] * derivative[k]),
            cross: [0, 1].map(|k| weight * other[k] + e[k] * derivative[1 - k]),
        })
    }

    /// The binned quantity in the row, and under each version. Infinity if the row is not selected; NaN if a number is
    /// missing.
    fn binned(&self, at: usize) -> [f64; CATALOGUES] {
        if self.reading.select.is_none() && self.reading.binned.is_none() {
            return [0.0; CATALOGUES];
        }
        let of = |expression: &Option<Expression>, places: &Option<Vec<usize>>, without: f64| match (
            expression, places,
        ) {
            (None, _) => without,
            (Some(expression), Some(places)) => expression.value(&|k| self.value(places[k], at)),
            (Some(_), None) => f64::INFINITY,
        };
        std::array::from_fn(|version| {
            let places = &self.source.places[version];
            let selected = of(&self.reading.select, &places.select, 1.0);
            if selected == 0.0 || selected.is_infinite() {
                return f64::INFINITY;
            }
            let binned = of(&self.reading.binned, &places.binned, 0.0);
            if selected.is_nan() { f64::NAN } else { binned }
        })
    }

    fn truth(&self, at: usize) -> Result<[f64; 2], String> {
        match self.truth {
            OfRows::Constant(shear) => Ok(shear),
            OfRows::Identifiers(galaxies) => {
                let key = self.ids.as_ref().and_then(|ids| galaxies.get(&ids[at]));
                key.copied().ok_or_else(|| {
                    let name = self.source.columns.of(Role::Id).unwrap_or_default();
                    let id = identity::shown(self.frame, name, at);
                    format!("the table of true shears does not contain the identifier {id}")
                })
            }
            OfRows::Positions(positions, columns) => positions.at(self.pair(columns, at)),
            OfRows::Columns(columns) => Ok(self.pair(columns, at)),
            OfRows::Nowhere => Ok([0.0; 2]),
        }
    }

    /// The key of the unit of a row, the `index`-th of its version.
    fn key(&self, at: usize, index: u64) -> u64 {
        match (&self.units, &self.ids) {
            (Some(units), _) => units[at],
            (None, Some(ids)) if !self.reading.neighbours => ids[at],
            _ => index >> u32::from(self.reading.neighbours),
        }
    }
}

/// Whether a text column has a pattern, as 1 and 0.
fn compared(
    frame: &DataFrame,
    name: &str,
    pattern: &str,
    path: &Path,
) -> Result<Vec<f64>, FileError> {
    let texts = frame.column(name).ok().and_then(|column| column.str().ok());
    let Some(texts) = texts else {
        return Err(FileError::new(
            path,
            format!(
                "column `{name}` contains no texts (found a comparison with '{pattern}', expected a number)"
            ),
        ));
    };
    let compared = texts
        .iter()
        .map(|text| f64::from(u8::from(fits(pattern, text.unwrap_or_default()))));
    Ok(compared.collect())
}

/// The version of a name, `None` for that without shear: `ns` in metadetection of LSST, `00` in TXPipe.
fn version_named(name: &str) -> Option<Option<usize>> {
    let name = name.trim().to_ascii_lowercase();
    if ["noshear", "ns", "00"].contains(&name.as_str()) {
        return Some(None);
    }
    let mut versions = SHEARED_CATALOGUES.iter();
    versions.position(|(known, _)| *known == name).map(Some)
}

/// Whether a text is the name of a sheared version.
fn is_sheared(text: Option<&str>) -> bool {
    text.is_some_and(|text| matches!(version_named(text), Some(Some(_))))
}

/// Refuses a table whose rows belong to versions, if no column has this role: its mean would be one of all versions.
fn check_steps(frame: &DataFrame, columns: &Columns, path: &Path) -> Result<(), FileError> {
    for name in &columns.steps {
        let texts = frame.column(name).ok().and_then(|column| column.str().ok());
        if texts.is_some_and(|texts| texts.iter().any(is_sheared)) {
            return Err(FileError::new(
                path,
                format!(
                    "column `{name}` names sheared versions, but is not used. Try: --columns version={name}"
                ),
            ));
        }
    }
    Ok(())
}

/// Columns of cuts that are taken for flags by their names.
fn recognised_cuts<'a>(
    source: &'a Source,
    reading: &Reading,
) -> impl Iterator<Item = &'a String> + use<'a> {
    let given = reading.names.is_given(Role::Flag);
    let flags = source.columns.flags.iter().filter(move |_| !given);
    flags.filter(|name| name.to_ascii_lowercase().contains("select"))
}

/// Refuses a cut that excludes more than half of the rows: it may be true for selected rows.
fn check_share(
    path: &Path,
    source: &Source,
    reading: &Reading,
    about: &Catalogue,
) -> Result<(), FileError> {
    let most = 2 * about.flagged > about.rows;
    match recognised_cuts(source, reading).next().filter(|_| most) {
        None => Ok(()),
        Some(name) => Err(FileError::new(
            path,
            format!(
                "flags exclude {} of {} rows, among them `{name}` (expected less than half: 0 for good rows). Try: --columns flag=none --where {name} if good rows have 1, --columns flag={} otherwise",
                about.flagged,
                about.rows,
                source.columns.flags.join("+")
            ),
        )),
    }
}

/// Refuses a recognised flag that is true for selected rows.
fn check_selected(frame: &DataFrame, source: &Source, reading: &Reading) -> Result<(), FileError> {
    for name in recognised_cuts(source, reading) {
        let is_boolean = || {
            let column = frame.column(name);
            column.is_ok_and(|column| *column.dtype() == DataType::Boolean)
        };
        if is_boolean() {
            return Err(FileError::new(
                &source.place.path,
                format!(
                    "column `{name}` is true or false (expected a flag, which is 0 for good rows). Try: --columns flag=none --where {name} if it is true for selected rows, --columns flag={name} otherwise"
                ),
            ));
        }
    }
    Ok(())
}

/// The versions that a column of text names.
fn versions(frame: &DataFrame, name: &str, path: &Path) -> Result<Vec<Option<usize>>, FileError> {
    let fault = |found: &str, remedy: &str| {
        FileError::new(
            path,
            format!(
                "column `{name}`: unknown version (found {found}, expected noshear or ns, 1p, 1m, 2p or 2m). Try: {remedy}"
            ),
        )
    };
    let none = "--columns version=none";
    let column = frame.column(name);
    let column = column.map_err(|_| fault("no such column", none))?;
    let texts = column.str().map_err(|_| fault("no text", none))?;
    // The mean of all versions has a wrong m.
    let remedy = match texts.iter().any(is_sheared) {
        true => "a table of these versions alone",
        false => none,
    };
    texts
        .iter()
        .map(|text| {
            let text = text.unwrap_or("nothing");
            version_named(text).ok_or_else(|| fault(&format!("`{text}`"), remedy))
        })
        .collect()
}

/// Paths of catalogues, each once.
///
/// # Errors
/// If a catalogue is given twice.
pub(super) fn distinct(inputs: &[Input]) -> Result<(), FileError> {
    for (k, input) in inputs.iter().enumerate() {
        if inputs[..k].iter().any(|other| other.name == input.name) {
            return Err(FileError::new(&input.name, "the catalogue is given twice"));
        }
    }
    Ok(())
}
