//! Tables of a catalogue, and which of their columns are read as what.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::Path;

use shearq_bias::Design;
use shearq_files::fits::TableHead;
use shearq_files::frames::frame;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::table::{self, FileFormat, Place};
use shearq_files::{FileError, names_of};
use shearq_measure::{Observables, Selection};

use crate::expression::{
    Expression, Operand, RADIANS, operand_values, refuse_long_integers, texts_of, with_names,
};
use crate::own_columns::{
    SHAPE_COLUMNS, are_of_detections, changes_with_shear, cut_of_detections, require_responses,
};
use crate::recognition::{fits_any, has_any, names_of_role, recognition, words};

use crate::columns::{Columns, Names, Preset, Shapes, base, has_operand, may_be_number};
use crate::identity;
use crate::request::{Input, Request, Units};
use crate::roles::{CATALOGUES, Places, Role, name_of};
use crate::steps::{catalogue_named, sheared_column, sheared_name, unsheared};
use crate::truth::Truth;

/// How catalogues are read: a request with the true shears of its catalogues.
#[derive(Debug)]
pub struct Reading<'r> {
    pub request: &'r Request,
    pub truth: Truth,
    pub flip_g2: bool,
}

impl Reading<'_> {
    pub fn condition(&self) -> Option<&Expression> {
        self.request.selection.as_ref()?.rows.as_ref()
    }

    pub fn weights(&self) -> Option<&Selection> {
        self.request.selection.as_ref()?.weights.as_ref()
    }

    pub fn binned(&self) -> impl Iterator<Item = &Expression> + Clone {
        self.request.bins.iter().map(|bins| &bins.of)
    }

    fn expressions(&self) -> impl Iterator<Item = (Role, &Expression)> + Clone {
        let condition = self.condition().into_iter();
        let condition = condition.map(|own| (Role::Condition, own));
        condition.chain(self.binned().map(|own| (Role::Binned, own)))
    }

    fn chosen_by(&self) -> impl Iterator<Item = &str> + Clone {
        self.expressions().flat_map(|(_, own)| own.columns())
    }

    // Whether rows count or weigh by a quantity that shear changes, in the names of shearq.
    fn cuts(&self, columns: &Columns) -> bool {
        let condition = self.condition().into_iter().flat_map(Expression::columns);
        let weight = columns.of(Role::Weight);
        condition.into_iter().any(changes_with_shear)
            || weight.is_some_and(|own| has_operand(own, changes_with_shear))
    }

    // Columns of expressions that shear changes by an unknown amount.
    fn unanswered(&self, columns: &Columns, has_sheared: impl Fn(&str) -> bool) -> BTreeSet<&str> {
        self.chosen_by()
            .filter(|name| match columns.preset {
                Preset::Shearq => changes_with_shear(name),
                _ => !is_fixed(name, columns) && !has_sheared(name),
            })
            .filter(|name| !self.request.unsheared.iter().any(|own| own == name))
            .collect()
    }

    /// Whether rows 2k and 2k + 1 are a galaxy and its rotated image, which form a unit.
    pub fn rows_are_rotated_pairs(&self) -> bool {
        self.request.design == Some(Design::Rotated) && self.request.catalogues.len() == 1
    }

    // Whether the column of a role is of no use for the true shear.
    fn skips(&self, role: Role) -> bool {
        match role {
            Role::G1 | Role::G2 => !matches!(self.truth, Truth::Columns),
            Role::X | Role::Y => {
                let by_position = matches!(self.truth, Truth::Positions(_) | Truth::Data(_));
                !by_position && self.request.placed.is_none()
            }
            _ => false,
        }
    }
}

#[derive(Debug)]
pub struct Source {
    pub place: Place,
    pub frame: Option<DataFrame>,
    /// The sheared catalogue of all rows, 0 for noshear, if a FITS file has one table for each.
    pub sheared: Option<usize>,
    pub columns: Columns,
    pub shapes: Shapes,
    pub unit: Option<String>,
    /// A column without a role that looks like independent units.
    pub unit_column: Option<String>,
    /// Columns that are computed from others, with the formula as their name.
    pub formulas: Vec<Expression>,
    /// All that is read, each once.
    pub wanted: Vec<Operand>,
    pub places: Places,
    // Columns of expressions that shear changes by an unknown amount.
    unanswered: Vec<String>,
    // Formulas of weights and flags, with the columns in them whose sheared versions are not used.
    unanswered_formulas: Vec<(String, String)>,
    // Whether sheared catalogues have flags, which then give the response of the selection.
    sheared_flags: bool,
    /// Whether each sheared catalogue selects galaxies by its columns, so that the response of the selection follows.
    pub selects: bool,
    /// The column of weights that `select` wrote: rows with zero stay in its files and do not count.
    pub selection: Option<usize>,
    /// Whether `detect` wrote the catalogue.
    pub of_detections: bool,
    declines_matrix: bool,
    has_weights: bool,
    /// The signs of e1 and e2 in those of the table: −1 of a formula such as `-e2`. Other columns have the axes of the table.
    pub signs: [f64; 2],
    /// Whether the size of the PSF is T = 2σ², whose square root is a size.
    pub psf_area: bool,
    /// Why nothing divides the ellipticities by their response, if they need one.
    pub undivided: Option<String>,
    /// Why the true shears are no reduced ones.
    pub unreduced: Option<String>,
}

impl Source {
    /// Columns of `--where` and `--bins` by which shear changes the choice of galaxies, without a response of the choice.
    pub fn unanswered(&self) -> &[String] {
        match self.has_sheared_rows() {
            // Rows of each sheared catalogue are selected by sheared quantities.
            true => &[],
            false => &self.unanswered,
        }
    }

    // Whether the column of a role enters the result.
    fn reads(&self, reading: &Reading<'_>, role: Role) -> bool {
        match role {
            Role::Unit => self.unit.is_some(),
            // Sheared catalogues give the response.
            Role::R11 | Role::R22 | Role::R12 | Role::R21 if self.has_sheared_columns() => false,
            Role::R12 | Role::R21 => self.has_matrix(),
            Role::RmsE | Role::SigmaE => self.shapes == Shapes::Responsivity,
            role => !reading.skips(role),
        }
    }

    /// What catalogues of one list must have in common: columns by role, and what becomes of them.
    pub fn kind(&self, reading: &Reading<'_>) -> Vec<(String, String)> {
        let mut kind = self.used(reading);
        if let Some(unit) = &self.unit {
            kind.retain(|(role, _)| role != "unit");
            kind.push(("units".into(), unit.clone()));
        }
        let step = match self.has_sheared_rows() || self.has_sheared_columns() {
            true => reading.request.step().to_string(),
            false => "none".into(),
        };
        let of = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        kind.extend([
            of("the type of ellipticities", self.shapes.name()),
            of("the shear of sheared catalogues", &step),
            of(
                "sheared columns of cuts",
                if self.selects { "some" } else { "none" },
            ),
            of("the program", self.columns.program()),
        ]);
        kind
    }

    /// The columns that enter the result, by role.
    pub fn used(&self, reading: &Reading<'_>) -> Vec<(String, String)> {
        self.columns.roles(|role| self.reads(reading, role))
    }

    // The columns that enter the result.
    fn read(&self, reading: &Reading<'_>) -> Vec<String> {
        // Read to find out whether they are what their names suggest.
        let tested = self.columns.doubtful_weights.iter();
        let tested = tested.chain(&self.columns.steps);
        let is_tested = |name: &str| tested.clone().any(|own| own == name);
        let is_chosen = |name: &str| reading.chosen_by().any(|own| own == name);
        let read = self.wanted.iter().map(|own| own.column.as_str());
        let read = read.filter(|name| !is_tested(name) || is_chosen(name));
        let operands = self.formulas.iter().flat_map(Expression::columns);
        read.chain(operands).map(str::to_owned).collect()
    }

    // Refuses columns of a table in memory that have a role and no number or text in each row.
    fn refuse_unread(&self, unread: &[(String, String)]) -> Result<(), FileError> {
        let wanted = self.wanted.iter().map(|own| own.column.as_str());
        let operands = self.formulas.iter().flat_map(Expression::columns);
        let read: HashSet<&str> = wanted.chain(operands).collect();
        let Some((name, found)) = unread.iter().find(|(name, _)| read.contains(&**name)) else {
            return Ok(());
        };
        let own = &self.columns;
        let role = match own.all().find(|(_, own)| own == name) {
            Some((key, _)) => Some(name_of(key)),
            None if own.flags.contains(name) => Some(name_of((Role::Flag, 0))),
            None if own.doubtful_weights.contains(name) => Some(name_of((Role::Weight, 0))),
            None => None,
        };
        let without = role.map_or(String::new(), |role| format!(", or --columns {role}=none"));
        Err(FileError::new(
            &self.place.path,
            format!("column `{name}` {found} (expected a number or text in each row)"),
        )
        .hint(format!("such a column{without}")))
    }

    // Columns that are not used here, and that `first` does not have.
    fn unused_beside(&self, first: &Source, reading: &Reading<'_>) -> Vec<String> {
        let known = first.columns.without_role().cloned();
        let named = first.columns.all().map(|(_, name)| name.to_owned());
        let mut read = self.read(reading);
        read.extend(known.chain(named));
        self.columns.unused(&read)
    }

    pub fn described(&self, reading: &Reading<'_>) -> Vec<String> {
        let responsivity = self.shapes == Shapes::Responsivity;
        let used = self.columns.used(|role| self.reads(reading, role));
        let mut lines = vec![format!("Used: {used}.")];
        lines.extend(self.columns.unfit_presets.iter().cloned());
        lines.extend(self.columns.unused(&self.read(reading)));
        lines.extend(self.response_of_sheared(reading.request.step()));
        let mut sheared = Vec::new();
        if self.sheared_flags {
            sheared.extend(self.places.all((Role::Flag, 1)));
        }
        let sheared_weight = self.places.of((Role::Weight, 1));
        sheared.extend(sheared_weight);
        let is_of_survey = self.columns.program() == "DES Y3" && sheared_weight.is_none();
        if let Some(name) = self
            .columns
            .of(Role::Weight)
            .filter(|_| is_of_survey && sheared.is_empty())
        {
            lines.push(format!(
                "`{name}` has no sheared versions, so that its selection response is missing, whose size is unknown: m is wrong by it, because weights of DES depend on the S/N and size. Try: columns {name}_1p, {name}_1m, {name}_2p and {name}_2m"
            ));
        }
        if !sheared.is_empty() {
            let names: Vec<&str> = sheared.iter().map(|place| self.name(*place)).collect();
            lines.push(format!(
                "Selection response: from {} and the other sheared catalogues.",
                names.join(", ")
            ));
            let alone = [
                (Role::Flag, self.sheared_flags),
                (Role::Weight, sheared_weight.is_some()),
            ];
            for (role, is_sheared) in alone {
                if let (Some(name), false) = (self.columns.of(role), is_sheared) {
                    lines.push(format!(
                        "`{name}` has no sheared versions, so that its part of the selection response is missing, and m is wrong if it depends on the shape. Try: columns {name}_1p, {name}_1m, {name}_2p and {name}_2m"
                    ));
                }
            }
        }
        if self.sheared.is_some() {
            lines.push("Files or tables named noshear, 1p, 1m, 2p and 2m are one catalogue, whose response is the difference of their means. Try: --columns version=none if files of these names have test shears.".into());
        }
        lines.extend(self.turned());
        lines.extend(self.without_sheared_operands());
        lines.extend(self.converted());
        if responsivity {
            let rms = match (self.columns.of(Role::RmsE), self.columns.of(Role::SigmaE)) {
                (Some(rms), _) => format!("e_rms from {rms}"),
                (None, Some(sigma)) => format!("e_rms² = ⟨χ²⟩/2 − {sigma}²"),
                (None, None) => {
                    "e_rms² = ⟨χ²⟩/2, which contains the measurement noise. Try: --columns rms_e=NAME or sigma_e=NAME for the scatter of intrinsic shapes, with which m is lower".into()
                }
            };
            // A formula may contain the conversion.
            let formula = self.columns.of(Role::E1).filter(|e1| self.is_formula(e1));
            let formula = formula.map_or(String::new(), |e1| {
                format!(" Try: --ellipticity shear if `{e1}` is a shear already.")
            });
            lines.push(format!(
                "Shears from distortions: ⟨χ⟩/2ℛ with ℛ = 1 − ⟨w e_rms²⟩/⟨w⟩ (Bernstein & Jarvis 2002), {rms}. Moduli above 1 count. Try: --ellipticity distortion to convert each galaxy.{formula}"
            ));
        }
        lines
    }

    fn without_sheared_operands(&self) -> Option<String> {
        let mut unanswered = self.unanswered_formulas.iter();
        let (formula, sheared) = unanswered.find(|_| !self.has_sheared_rows())?;
        Some(format!(
            "`{formula}` has versions of sheared catalogues, such as `{sheared}`, that are not used, so that its selection response is missing: m is wrong if it depends on the shape. Try: --where in place of a flag, or a weight that shear does not change"
        ))
    }

    // A step that is wrong by a factor is an m of that factor.
    fn response_of_sheared(&self, step: f64) -> Option<String> {
        if !self.has_sheared_rows() && !self.has_sheared_columns() {
            return None;
        }
        let stated = match &self.columns.step_size {
            Some(name) => format!(" Try: --step with the number of `{name}`."),
            None => String::new(),
        };
        let columns = match self.columns.of(Role::R11) {
            Some(name) => format!(", and not from {name}"),
            None => String::new(),
        };
        Some(format!(
            "Response: from sheared catalogues, for artificial shears of ±{step} (--step){columns}.{stated}"
        ))
    }

    // What becomes of distortions, apart from ℛ.
    fn converted(&self) -> Option<String> {
        let text = match self.shapes {
            Shapes::Shear if self.columns.distortion => {
                "Distortions, divided by their response and not converted."
            }
            Shapes::Converted if self.has_sheared_rows() || self.has_sheared_columns() => {
                "Distortions, each converted to a shear, with those of the sheared catalogues."
            }
            Shapes::Converted => "Distortions, each converted to a shear.",
            Shapes::Shear | Shapes::Responsivity => return None,
        };
        Some(text.to_owned())
    }

    fn has_sheared_columns(&self) -> bool {
        self.columns.of_sheared((Role::E1, 1)).is_some()
    }

    fn is_formula(&self, name: &str) -> bool {
        self.formulas.iter().any(|own| own.text() == name)
    }

    /// The sign with which a column of a role is read, in the axes of e1 and e2: a formula has the right one.
    pub fn sign(&self, role: Role, column: Option<&str>) -> f64 {
        match column {
            Some(column) if !self.is_formula(column) => {
                axes(role).iter().map(|axis| self.signs[*axis]).product()
            }
            _ => 1.0,
        }
    }

    /// The sign of the column of a role.
    pub fn sign_of(&self, role: Role) -> f64 {
        self.sign(role, self.columns.of(role))
    }

    /// The sheared catalogue (from 1; 0 for noshear) of the axes of e1 and e2 that the table calls `catalogue`.
    pub fn of_axes(&self, catalogue: usize) -> usize {
        match catalogue.checked_sub(1) {
            Some(sheared) if self.signs[sheared / 2] < 0.0 => (sheared ^ 1) + 1,
            _ => catalogue,
        }
    }

    // Which columns of responses change their sign with e1 or e2.
    fn turned(&self) -> Option<String> {
        let [a, b] = self.signs;
        let (k, e) = [(0, Role::E1), (1, Role::E2)][usize::from(b < 0.0)];
        if a > 0.0 && b > 0.0 {
            return None;
        }
        let formula = self.columns.of(e)?;
        let names = ROLES_WITH_AXES.iter().filter_map(|role| {
            let name = self.columns.of(*role)?;
            (self.sign_of(*role) < 0.0).then(|| format!("`{name}`"))
        });
        let mut changed: Vec<String> = names.collect();
        if a * b < 0.0 && (self.has_sheared_rows() || self.has_sheared_columns() || self.selects) {
            changed.push(format!("the artificial shear of {0}p and {0}m", k + 1));
        }
        (!changed.is_empty()).then(|| {
            format!(
                "With the sign of `{formula}`, these change theirs, too: {}. Try: a formula such as --columns 'R12=1*R12' for a column of the right sign.",
                changed.join(", ")
            )
        })
    }

    pub fn name(&self, place: usize) -> &str {
        &self.wanted[place].column
    }

    pub fn has_sheared_rows(&self) -> bool {
        self.sheared.is_some() || self.columns.of(Role::ShearedCatalogue).is_some()
    }

    pub fn has_response(&self) -> bool {
        let by_columns = [Preset::Metacal, Preset::Sheared].contains(&self.columns.preset);
        self.has_sheared_rows() || by_columns || self.columns.have(&[Role::R11])
    }

    /// Whether the responses of each component to the other one are known.
    pub fn has_matrix(&self) -> bool {
        let of_rows = match self.columns.preset {
            Preset::Metacal | Preset::Sheared => self.columns.have_other_sheared(),
            _ => self.columns.have(&[Role::R12, Role::R21]),
        };
        (of_rows || self.has_weights || self.has_sheared_rows()) && !self.declines_matrix
    }

    pub fn has_psf(&self) -> bool {
        self.columns.have(&[Role::Psf1, Role::Psf2])
    }

    pub fn parts(
        &self,
        reading: &Reading<'_>,
        mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
    ) -> Result<(), FileError> {
        let path = &self.place.path;
        let mut take = |part: DataFrame| take(add_formulas(part, &self.formulas, path)?);
        if let Some(frame) = &self.frame {
            return take(frame.clone());
        }
        let computed = |name: &str| self.formulas.iter().any(|own| own.text() == name);
        let read = self.wanted.iter().map(|own| own.column.as_str());
        let read = read.filter(|name| !computed(name));
        let operands = self.formulas.iter().flat_map(Expression::columns);
        let names: BTreeSet<&str> = read.chain(operands).collect();
        let names: Vec<&str> = names.into_iter().collect();
        let mut texts = names.clone();
        texts.retain(|name| self.is_text(reading, name));
        table::read_parts(&self.place, &names, &texts, take)
    }

    /// Whether a column may be a text: identifiers, names of sheared catalogues, and what is compared with texts.
    pub fn is_text(&self, reading: &Reading<'_>, name: &str) -> bool {
        let chosen = reading.expressions().flat_map(|(_, own)| own.operands());
        let computed = self.formulas.iter().flat_map(Expression::operands);
        let mut operands = chosen.chain(computed);
        match operands.find(|own| own.column == name || own.column == base(name)) {
            Some(operand) => operand.texts.is_some(),
            None => {
                let roles = [Role::Id, Role::ShearedCatalogue].map(|role| self.columns.of(role));
                roles.contains(&Some(name))
                    || self.unit.as_deref() == Some(name)
                    || self.columns.steps.iter().any(|step| step == name)
            }
        }
    }
}

/// Columns without a role that the first catalogue does not have, of the first of `others` that has some: a mask in the second of
/// two catalogues gave m = −0.167 without a word.
pub fn unused_in_others<'s>(
    first: &Source,
    reading: &Reading<'_>,
    others: impl Iterator<Item = (&'s Path, &'s [Source])>,
) -> Vec<String> {
    let mut others = others.filter_map(|(name, sources)| {
        let own = sources.iter().map(|own| own.unused_beside(first, reading));
        Some((name, own.into_iter().find(|lines| !lines.is_empty())?))
    });
    let Some((name, mut lines)) = others.next() else {
        return Vec::new();
    };
    let more = match others.count() {
        0 => String::new(),
        more => format!(" (and {more} more catalogues likewise)"),
    };
    for line in &mut lines {
        *line = format!("{}{more}: {line}", name.display());
    }
    lines
}

/// The first role or use in which two catalogues differ.
pub fn difference(own: &[(String, String)], expected: &[(String, String)]) -> Option<String> {
    let of = |all: &[(String, String)], role: &str| {
        let found = all.iter().find(|(known, _)| known == role);
        found.map_or("none".to_owned(), |(_, column)| column.clone())
    };
    let mut roles = expected.iter().chain(own).map(|(role, _)| role);
    roles.find_map(|role| {
        let (found, expected) = (of(own, role), of(expected, role));
        (!found.eq_ignore_ascii_case(&expected))
            .then(|| format!("`{found}` for {role}, expected `{expected}`"))
    })
}

pub fn sources(input: &Input, reading: &Reading<'_>) -> Result<Vec<Source>, FileError> {
    let mut all = Vec::new();
    for (path, sheared) in &input.parts {
        let part = Input::from(path.clone());
        all.extend(sources_of(&part, *sheared, reading)?);
    }
    match input.parts.is_empty() {
        true => sources_of(input, None, reading),
        false => Ok(all),
    }
}

fn sources_of(
    input: &Input,
    sheared: Option<usize>,
    reading: &Reading<'_>,
) -> Result<Vec<Source>, FileError> {
    let path = input.name.as_path();
    if let Some(table) = &input.frame {
        let place = Place {
            path: path.to_owned(),
            table: None,
        };
        let mut names: Vec<String> = (table.columns().iter())
            .map(|own| own.name().to_string())
            .collect();
        names.extend(input.unread.iter().map(|(name, _)| name.clone()));
        let source = Source {
            frame: Some(table.clone()),
            ..source(place, None, (&names, Some(table)), reading)?
        };
        source.refuse_unread(&input.unread)?;
        return Ok(vec![source]);
    }
    let place = Place::of(path);
    let found = table::columns(&place)?;
    let table = |number: usize| Place {
        path: place.path.clone(),
        table: Some(number.to_string()),
    };
    // Metadetection of LSST writes a table per sheared catalogue.
    if place.table.is_none() {
        let mut tables = Vec::new();
        for list in &found.named {
            let Some(head) = &list.table else { continue };
            if let Some(catalogue) = catalogue_named(&head.name) {
                let own = source(
                    table(head.number),
                    Some(catalogue),
                    (&list.names, None),
                    reading,
                )?;
                tables.push(own);
            }
        }
        if tables.len() == CATALOGUES {
            return Ok(tables);
        }
    }
    let lists: Vec<_> = (found.named.iter())
        .filter(|list| !list.doubtful || found.named.len() == 1)
        .collect();
    let names = &reading.request.names;
    let good: Vec<_> = (lists.iter().copied())
        .filter(|list| {
            // What is wrong with the only one is found when it is read.
            if lists.len() == 1 {
                return true;
            }
            let all = with_formulas(path, &list.names, names);
            all.is_ok_and(|(all, _)| Columns::find(path, &all, names, false).is_ok())
        })
        .collect();
    let tables: Vec<&TableHead> = good.iter().filter_map(|list| list.table.as_ref()).collect();
    if let [first, others @ ..] = &tables[..]
        && !others.is_empty()
    {
        // Tables of chips share a name, and a name of digits would be read as a number.
        let unique = !first.name.is_empty()
            && first.name.parse::<u64>().is_err()
            && !others.iter().any(|other| other.is_called(&first.name));
        let advised = match unique {
            true => first.name.clone(),
            false => first.number.to_string(),
        };
        let found: Vec<String> = tables.iter().map(|head| head.shown()).collect();
        return Err(FileError::new(
            path,
            format!(
                "several tables have columns of ellipticities (found {}, expected one)",
                names_of(&found)
            ),
        )
        .hint(format!("{}[{advised}]", path.display())));
    }
    let Some(list) = good.first().or(lists.first()) else {
        return Err(FileError::new(
            path,
            format!(
                "the columns have no names (found {} fields, expected a header such as `e1,e2`)",
                found.unnamed.len()
            ),
        )
        .hint("write a first line with names"));
    };
    let own = match (&place.table, &list.table) {
        (None, Some(head)) => table(head.number),
        _ => place,
    };
    Ok(vec![source(own, sheared, (&list.names, None), reading)?])
}

// The columns that are read of a table with these names, each once.
struct Wanted<'a> {
    path: &'a Path,
    names: &'a [String],
    columns: &'a Columns,
    // By formula, the same of the columns of each sheared catalogue.
    sheared_formulas: &'a BTreeMap<String, Vec<String>>,
    all: Vec<Operand>,
}

impl Wanted<'_> {
    // As what the operand `like` of an expression reads, or as a number.
    fn add(&mut self, name: &str, like: Option<&Operand>) -> Option<usize> {
        if !self.names.iter().any(|own| own == name) {
            return None;
        }
        let operand = Operand {
            column: name.to_owned(),
            ..like.cloned().unwrap_or_default()
        };
        let known = self.all.iter().position(|own| *own == operand);
        Some(known.unwrap_or_else(|| {
            self.all.push(operand);
            self.all.len() - 1
        }))
    }

    fn require(&mut self, name: &str) -> Result<usize, FileError> {
        let found = self.add(name, None);
        found.ok_or_else(|| FileError::no_column(self.path, name, self.names))
    }

    fn has_sheared(&self, name: &str) -> bool {
        let mut catalogues = 1..CATALOGUES;
        self.columns.give_selection_response()
            && catalogues.all(|catalogue| self.sheared(name, catalogue).is_some())
    }

    // The column, or the formula of columns, of a sheared catalogue.
    fn sheared(&self, name: &str, catalogue: usize) -> Option<&str> {
        match self.sheared_formulas.get(name) {
            Some(all) => Some(&all[catalogue - 1]),
            None => sheared_column(self.names, name, catalogue).map(String::as_str),
        }
    }

    // Whether a flag is a cut in all catalogues: DES's `flags_select_1p` chooses the galaxies of 1p. Other flags of
    // metacalibration with sheared ones are those of failed measurements.
    fn is_cut(&self, name: &str) -> bool {
        let is_formula = self.sheared_formulas.contains_key(name);
        let is_unsheared = is_formula || unsheared(name) != words(name).trim_matches('_');
        let by_name = is_unsheared || name.to_ascii_lowercase().contains("select");
        (by_name || self.columns.preset != Preset::Metacal) && self.has_sheared(name)
    }

    // Flags of failed measurements of metacalibration, apart from those that choose in each catalogue.
    fn sheared_failures(&mut self, places: &Places) -> Result<Vec<usize>, FileError> {
        let of_cuts = (1..CATALOGUES).flat_map(|catalogue| places.all((Role::Flag, catalogue)));
        let of_cuts: Vec<String> = of_cuts
            .map(|place| self.all[*place].column.clone())
            .collect();
        let mut failures = Vec::new();
        for name in self
            .names
            .iter()
            .filter(|_| self.columns.preset == Preset::Metacal)
        {
            let small = name.to_ascii_lowercase();
            let is_flag = small.contains("flag") && !small.contains("select");
            let mut formulas = self.sheared_formulas.values().flatten();
            let is_column = formulas.all(|own| own != name);
            if is_flag && is_column && sheared_name(name).is_some() && !of_cuts.contains(name) {
                failures.push(self.require(name)?);
            }
        }
        Ok(failures)
    }

    // Columns of cuts that no condition names. Also reads those that may name sheared catalogues, to refuse them if they do.
    fn choices(&mut self, reading: &Reading<'_>) -> Result<Vec<usize>, FileError> {
        let columns = self.columns;
        for name in &columns.steps {
            self.require(name)?;
        }
        let is_chosen = |name: &&String| reading.chosen_by().any(|own| own == *name);
        let choices = columns.choices.iter().filter(|name| !is_chosen(name));
        choices.map(|name| self.require(name)).collect()
    }

    // The places of roles, flags and expressions, whether each sheared catalogue has what the expressions require, and
    // whether it has flags of its own. A column without sheared ones is the same in all catalogues if `by_catalogue`, or
    // if flags or weights have sheared ones.
    fn places(
        &mut self,
        reading: &Reading<'_>,
        by_catalogue: bool,
    ) -> Result<(Places, bool, bool), FileError> {
        let columns = self.columns;
        let mut places = Places::default();
        for (key, name) in columns.all() {
            // Units may be texts; a flag may have several columns.
            if ![Role::Unit, Role::Flag].contains(&key.0) && !reading.skips(key.0) {
                places.set(key, self.add(name, None).into_iter().collect());
            }
        }
        let cuts = columns.flags.iter().any(|name| self.is_cut(name));
        let weight = columns
            .of(Role::Weight)
            .filter(|name| self.has_sheared(name));
        let by_catalogue = by_catalogue || cuts || weight.is_some();
        let mut known = true;
        for (role, expression) in reading.expressions() {
            let operands = self.operands(expression, by_catalogue)?;
            for (catalogue, own) in operands.into_iter().enumerate() {
                known &= own.len() == expression.operands().len();
                // Several quantities may be binned.
                let key = (role, catalogue);
                let all = [places.all(key), &own].concat();
                places.set(key, all);
            }
        }
        let weight = weight.filter(|_| known);
        for catalogue in 0..CATALOGUES {
            let mut flags = Vec::new();
            for flag in &columns.flags {
                let own = match catalogue > 0 && known && self.is_cut(flag) {
                    true => self.sheared(flag, catalogue).map(str::to_owned),
                    false => None,
                };
                flags.push(self.require(own.as_deref().unwrap_or(flag))?);
            }
            places.set((Role::Flag, catalogue), flags);
            if let Some(name) = weight.filter(|_| catalogue > 0) {
                let own = self.sheared(name, catalogue).map(str::to_owned);
                let own = own.and_then(|name| self.add(&name, None));
                places.set((Role::Weight, catalogue), own.into_iter().collect());
            }
        }
        Ok((places, known, cuts && known))
    }

    // The operands of an expression in each catalogue; none in a catalogue that lacks one. A column without sheared ones
    // is the same in all catalogues if another one has them (`by_catalogue`).
    fn operands(
        &mut self,
        expression: &Expression,
        by_catalogue: bool,
    ) -> Result<Vec<Vec<usize>>, FileError> {
        let mut all = vec![Vec::new()];
        for operand in expression.operands() {
            let column = &operand.column;
            // Sheared catalogues of shearq have noise that other columns do not have.
            let plain = format!("{column}_noshear");
            let [first, second] = match self.columns.preset {
                Preset::Sheared => [&plain, column],
                _ => [column, &plain],
            };
            let found = self.add(first, Some(operand));
            let found = found.or_else(|| self.add(second, Some(operand)));
            all[0].push(found.ok_or_else(|| FileError::no_column(self.path, column, self.names))?);
        }
        for catalogue in 1..CATALOGUES {
            let operands = expression.operands().iter();
            let sheared = operands.map(|operand| {
                let column = &operand.column;
                let own = sheared_column(self.names, column, catalogue);
                let own = own.and_then(|name| self.add(name, Some(operand)));
                own.or_else(|| self.add(column, Some(operand)).filter(|_| by_catalogue))
            });
            all.push(sheared.collect::<Option<_>>().unwrap_or_default());
        }
        Ok(all)
    }
}

/// The columns that are read of a table with columns of these `names`, so that others need not be in memory. Columns of texts are
/// always needed, because they may name sheared catalogues.
pub fn needed_columns(
    names: &[String],
    reading: &Reading<'_>,
) -> Result<BTreeSet<String>, FileError> {
    let place = Place {
        path: "table".into(),
        table: None,
    };
    let empty = |name: &String| Column::new(name.as_str().into(), Vec::<f64>::new());
    let table = frame(names.iter().map(empty).collect())
        .map_err(|error| FileError::new(&place.path, error))?;
    let own = source(place, None, (names, Some(&table)), reading)?;
    let read = own.wanted.iter().map(|own| own.column.clone());
    let operands = own.formulas.iter().flat_map(Expression::columns);
    let roles = own.columns.all().map(|(_, name)| name);
    let larger = around_patches(names).map(String::as_str);
    let larger = larger.filter(|_| own.columns.of(Role::Unit).is_some_and(is_patch));
    let convergence = convergence(names).map(String::as_str);
    // Of several methods, the texts of a step decide.
    let others = own.columns.others().map(String::as_str);
    let more = operands.chain(roles).chain(larger).chain(convergence);
    let more = more.chain(others);
    let more = more.map(str::to_owned);
    let all: BTreeSet<String> = read.chain(more).collect();
    Ok(all
        .into_iter()
        .filter(|name| names.contains(name))
        .collect())
}

// The columns by role, with a column that names sheared catalogues by its texts, and without identities that are counts.
fn columns_of(
    place: &Place,
    sheared: Option<usize>,
    (names, frame): (&[String], Option<&DataFrame>),
    given: &Names,
) -> Result<Columns, FileError> {
    let is_own = is_own(place, frame, names)?;
    let mut columns = Columns::find(&place.path, names, given, is_own)?;
    // Catalogues of shearq have no texts that matter.
    let texts = match is_own {
        true => BTreeMap::new(),
        false => first_texts(place, frame)?,
    };
    if sheared.is_none()
        && columns.of(Role::ShearedCatalogue).is_none()
        && !given.is_given(Role::ShearedCatalogue)
        && let Some(step) = step_column(place, frame, &texts, &columns)?
    {
        let mut given = given.clone();
        given.add_step(step);
        columns = Columns::find(&place.path, names, &given, is_own)?;
    }
    columns.texts = texts;
    columns.texts.retain(|_, text| is_word(text));
    columns.refuse_texts_of_flags(&place.path)?;
    if !given.is_given(Role::Unit)
        && let Some(unit) = columns.of(Role::Unit)
        && let Some(larger) = larger_unit(place, frame, names, unit)?
    {
        columns.take(Role::Unit, &larger);
    }
    // A seed of each row is no unit of galaxies that have identifiers.
    if let (Some(unit), Some(_)) = (columns.of(Role::Unit), columns.of(Role::Id))
        && unit.eq_ignore_ascii_case("seed")
        && !given.is_given(Role::Unit)
        && are_different(place, frame, unit)?
    {
        columns.decline(Role::Unit);
    }
    if let Some(id) = columns.of(Role::Id)
        && id.eq_ignore_ascii_case(COUNTER)
        && !given.is_given(Role::Id)
        && !is_identity(place, frame, id)?
    {
        columns.decline(Role::Id);
    }
    Ok(columns)
}

fn source(
    place: Place,
    sheared: Option<usize>,
    (names, frame): (&[String], Option<&DataFrame>),
    reading: &Reading<'_>,
) -> Result<Source, FileError> {
    let path = &place.path;
    let given = &*reading.request.names.of_table(path, names)?;
    let (names, mut formulas) = with_formulas(path, names, given)?;
    let mut columns = columns_of(&place, sheared, (&names, frame), given)?;
    if matches!(reading.truth, Truth::Columns) && !columns.have(&[Role::G1]) {
        given.check_true_shear(path)?;
    }
    let of_detections = columns.is_of_shearq() && are_of_detections(&names);
    if of_detections && reading.cuts(&columns) {
        return Err(cut_of_detections(path));
    }
    let in_rows = sheared.is_some() || columns.of(Role::ShearedCatalogue).is_some();
    check_calibration(path, &columns, in_rows)?;
    if let Units::Column(name) = &reading.request.units {
        columns.decline(Role::Unit);
        if !name.is_empty() {
            columns.take(Role::Unit, name);
        }
    }
    let names = names.as_slice();
    let has_sheared = |name: &str| sheared_column(names, name, 1).is_some();
    let mut chosen_by = reading.chosen_by();
    // Also if one of them is named.
    let by_catalogue =
        (chosen_by.clone()).any(|name| has_sheared(name) || sheared_name(name).is_some());
    columns.choose_sheared(names, by_catalogue && reading.weights().is_none());
    let sheared_formulas = sheared_formulas(names, &formulas, &columns);
    let (all_names, unanswered_formulas) =
        add_sheared(names, &mut formulas, &sheared_formulas, &columns);
    let names = all_names.as_slice();
    if columns.preset == Preset::Sheared {
        check_chosen(path, chosen_by.clone(), has_sheared)?;
    }
    // A step that is wrong by a factor is an m of that factor.
    if columns.of_sheared((Role::E1, 1)).is_some() && chosen_by.any(has_sheared) {
        check_step(path, reading.request.step())?;
    }
    let mut wanted = Wanted {
        path,
        names,
        columns: &columns,
        sheared_formulas: &sheared_formulas,
        all: Vec::new(),
    };
    let (mut places, known, sheared_flags) = wanted.places(reading, by_catalogue)?;
    let doubtful = columns.doubtful_weights.iter();
    let doubtful = doubtful.filter_map(|name| wanted.add(name, None));
    places.set((Role::DoubtfulWeight, 0), doubtful.collect());
    let failures = wanted.sheared_failures(&places)?;
    places.set((Role::ShearedFailure, 0), failures);
    places.set((Role::Choice, 0), wanted.choices(reading)?);
    if reading.weights().is_some() {
        require_responses(path, names)?;
        for name in SHAPE_COLUMNS.iter().chain(&Observables::COLUMNS) {
            wanted.require(name)?;
        }
    }
    let unit = match &reading.request.units {
        Units::Recognised | Units::Column(_) => columns.of(Role::Unit),
        Units::Rows | Units::Catalogues => None,
    };
    if let Some(unit) = unit {
        wanted.require(unit)?;
    }
    let unanswered = reading.unanswered(&columns, has_sheared);
    let selection = match columns.is_of_shearq() {
        true => wanted.add("selection", None),
        false => None,
    };
    check_twice(path, names, &wanted.all)?;
    let unreduced = match reading.truth {
        Truth::Columns => unreduced(&place, frame, names, &columns)?,
        _ => None,
    };
    let sheared_weight = places.of((Role::Weight, 1)).is_some();
    let chosen = reading.expressions().next().is_some() || sheared_flags || sheared_weight;
    Ok(Source {
        signs: signs(&formulas, &columns),
        unanswered_formulas,
        sheared,
        shapes: conversion(path, reading.request.shapes, &columns, sheared.is_some())?,
        formulas,
        unit: unit.map(str::to_owned),
        unit_column: unit_like(names, &columns),
        unanswered: unanswered.into_iter().map(str::to_owned).collect(),
        sheared_flags,
        selects: columns.give_selection_response() && chosen && known,
        selection,
        of_detections,
        undivided: columns.undivided(!given.is_given(Role::R11)),
        unreduced,
        declines_matrix: given.decline_matrix(),
        has_weights: reading.weights().is_some(),
        psf_area: columns.of(Role::PsfSize).is_some_and(is_area),
        wanted: wanted.all,
        frame: None,
        places,
        place,
        columns,
    })
}

fn is_area(psf_size: &str) -> bool {
    let squared = &recognition().psf_size.squared;
    squared.iter().any(|own| own.eq_ignore_ascii_case(psf_size))
}

fn convergence(names: &[String]) -> Option<&String> {
    let known = &recognition().patterns.convergence;
    names.iter().find(|name| has_any(known, name))
}

// m from which a convergence matters: a twentieth of what surveys require.
const MIN_CONVERGENCE: f64 = 1e-4;

// Galaxies have the reduced shear γ/(1 − κ) (Bartelmann & Schneider 2001, Phys. Rep. 340, 291, equation 4.13): simulations that state
// κ beside `gamma1` or `shear1` state γ, and `g1` is reduced. A κ of 0.08 gave m = 0.097 for 0.008 without a word.
fn unreduced(
    place: &Place,
    frame: Option<&DataFrame>,
    names: &[String],
    columns: &Columns,
) -> Result<Option<String>, FileError> {
    let [g1, g2] = [Role::G1, Role::G2].map(|role| columns.of(role));
    let (Some(g1), Some(g2), Some(kappa)) = (g1, g2, convergence(names)) else {
        return Ok(None);
    };
    let words = words(g1);
    let is_shear = words.contains("gamma") || words.contains("shear");
    // Also in a formula.
    if !is_shear || words.contains("reduced") || has_operand(g1, |own| own == kappa) {
        return Ok(None);
    }
    let mut is_small = true;
    let mut add = |part: &DataFrame| -> Result<(), FileError> {
        // Marks of a missing κ are above 1.
        let matters = |own: &f64| (MIN_CONVERGENCE..1.0).contains(&own.abs());
        is_small = is_small
            && !table::numbers(part, kappa, &place.path)?
                .iter()
                .any(matters);
        Ok(())
    };
    each_part(place, frame, &[kappa], &[], &mut add)?;
    Ok((!is_small).then(|| {
        let part = |g: &str| match Expression::parse(g).is_ok_and(|own| own.column().is_some()) {
            true => g.to_owned(),
            false => format!("({g})"),
        };
        format!(
            "`{g1}` beside `{kappa}` is a shear γ and not the reduced shear γ/(1 − κ) that galaxies have, so that m is wrong by about κ. Try: --columns 'g1={}/(1-{kappa}),g2={}/(1-{kappa})'",
            part(g1),
            part(g2)
        )
    }))
}

// The names and formulas with those of sheared catalogues, which need not be read without a response of the selection: then, the
// formulas that lack it, each with its first sheared one.
fn add_sheared(
    names: &[String],
    formulas: &mut Vec<Expression>,
    sheared: &BTreeMap<String, Vec<String>>,
    columns: &Columns,
) -> (Vec<String>, Vec<(String, String)>) {
    let mut names = names.to_vec();
    if !columns.give_selection_response() {
        let all = sheared.iter();
        let unanswered = all.map(|(formula, own)| (formula.clone(), own[0].clone()));
        return (names, unanswered.collect());
    }
    for text in sheared.values().flatten() {
        formulas.extend(Expression::parse(text));
        names.push(text.clone());
    }
    (names, Vec::new())
}

// Roles whose columns have signs of the axes of the table.
const ROLES_WITH_AXES: [Role; 8] = [
    Role::R12,
    Role::R21,
    Role::Dw1,
    Role::Dw2,
    Role::C1,
    Role::C2,
    Role::Psf1,
    Role::Psf2,
];

// The axes that change the sign of a column of a role: 0 of e1, 1 of e2.
fn axes(role: Role) -> &'static [usize] {
    match role {
        Role::R12 | Role::R21 => &[0, 1],
        Role::Dw1 | Role::C1 | Role::Psf1 => &[0],
        Role::Dw2 | Role::C2 | Role::Psf2 => &[1],
        _ => &[],
    }
}

// The signs of e1 and e2 in the axes of the table: those of a column of ellipticities in a formula, or of its first column.
fn signs(formulas: &[Expression], columns: &Columns) -> [f64; 2] {
    [Role::E1, Role::E2].map(|role| {
        let mut formulas = formulas.iter();
        let own = formulas.find(|own| Some(own.text()) == columns.of(role));
        let falls = own.is_some_and(|own| {
            let is_known =
                |name: &&str| names_of_role(role).any(|known| known.eq_ignore_ascii_case(name));
            let column = own
                .columns()
                .find(is_known)
                .or_else(|| own.columns().next());
            column.is_some_and(|column| own.falls_with(column))
        });
        if falls { -1.0 } else { 1.0 }
    })
}

/// Gives `take` the table in memory, or the parts of the file.
pub fn each_part(
    place: &Place,
    frame: Option<&DataFrame>,
    wanted: &[&str],
    texts: &[&str],
    take: &mut dyn FnMut(&DataFrame) -> Result<(), FileError>,
) -> Result<(), FileError> {
    match frame {
        Some(frame) => take(frame),
        None => table::read_parts(place, wanted, texts, |part| take(&part)),
    }
}

// The formulas of weights and flags of which each sheared catalogue has columns, with those of its columns. Flags of failed
// measurements of metacalibration choose in no catalogue.
fn sheared_formulas(
    names: &[String],
    formulas: &[Expression],
    columns: &Columns,
) -> BTreeMap<String, Vec<String>> {
    let is_cut = |own: &Expression| {
        let mut names = own.columns().map(str::to_ascii_lowercase);
        columns.preset != Preset::Metacal
            || !names.any(|name| name.contains("flag") && !name.contains("select"))
    };
    let chooses = |own: &&Expression| {
        columns.of(Role::Weight) == Some(own.text())
            || columns.flags.iter().any(|flag| flag == own.text()) && is_cut(own)
    };
    let of = |own: &Expression| {
        let of_catalogue = |catalogue: usize| {
            let text = with_names(own.text(), |name| {
                let is_operand = own.columns().any(|own| own == name);
                let new = sheared_column(names, name, catalogue);
                new.filter(|_| is_operand).cloned()
            });
            (text != own.text()).then_some(text)
        };
        let all: Option<Vec<String>> = (1..CATALOGUES).map(of_catalogue).collect();
        Some((own.text().to_owned(), all?))
    };
    formulas.iter().filter(chooses).filter_map(of).collect()
}

fn check_calibration(path: &Path, columns: &Columns, in_rows: bool) -> Result<(), FileError> {
    let calibration = [Role::M, Role::C1, Role::C2].map(|role| columns.of(role));
    if let Some(name) = calibration.into_iter().flatten().next().filter(|_| in_rows) {
        let message = format!(
            "`{name}`: m and c of galaxies are not applied to sheared catalogues, whose response is that of their means"
        );
        return Err(FileError::new(path, message).hint("m=none,c1=none,c2=none in --columns"));
    }
    Ok(())
}

fn check_twice(path: &Path, names: &[String], wanted: &[Operand]) -> Result<(), FileError> {
    // Which of both is meant is unknown, and a file gives the first.
    let is_twice = |own: &&Operand| names.iter().filter(|name| **name == own.column).count() > 1;
    if let Some(twice) = wanted.iter().find(is_twice) {
        return Err(FileError::new(
            path,
            format!(
                "there are two columns named `{}` (expected one)",
                twice.column
            ),
        )
        .hint("other names"));
    }
    Ok(())
}

fn is_patch(unit: &str) -> bool {
    unit.eq_ignore_ascii_case("patch")
}

// Columns of areas beside `patch`, whose patches may have the same names in each.
fn around_patches(names: &[String]) -> impl Iterator<Item = &String> {
    let areas = ["tract", "tile_id"].into_iter();
    areas.filter_map(|area| names.iter().find(|own| own.eq_ignore_ascii_case(area)))
}

// The column of independent units that replaces `patch`: patches of LSST have the same numbers in each tract, which made errors of c
// 0.6 times as large, and UNIONS has 7 patches of many tiles.
fn larger_unit(
    place: &Place,
    frame: Option<&DataFrame>,
    names: &[String],
    unit: &str,
) -> Result<Option<String>, FileError> {
    if !is_patch(unit) {
        return Ok(None);
    }
    for area in around_patches(names) {
        let (different, _) = counted(place, frame, area)?;
        let enough = match area.eq_ignore_ascii_case("tract") {
            true => different > 1,
            false => different > counted(place, frame, unit)?.0,
        };
        if enough {
            return Ok(Some(area.clone()));
        }
    }
    Ok(None)
}

// A column that looks like independent units. A seed of each row is none where galaxies have identifiers.
fn unit_like(names: &[String], columns: &Columns) -> Option<String> {
    let unit = columns.of(Role::Unit);
    let is_of_rows = |name: &str| {
        let has_id = columns.of(Role::Id).is_some() && columns.of(Role::Unit).is_none();
        has_id && name.eq_ignore_ascii_case("seed")
    };
    let mut names = names.iter();
    // Patches repeat within the unit that replaces them, and a single tract replaces none.
    let is_tract = |name: &str| name.eq_ignore_ascii_case("tract");
    let is_other = |name: &str| {
        unit.is_none_or(|unit| {
            unit != name && !is_patch(name) && !(is_patch(unit) && is_tract(name))
        })
    };
    let is_like = |name: &str| fits_any(&recognition().patterns.unit, name);
    let own = names.find(|name| is_like(name) && is_other(name) && !is_of_rows(name));
    own.cloned()
}

// The first value of each column of texts. Of a text table, any field of the first row may be one.
fn first_texts(
    place: &Place,
    frame: Option<&DataFrame>,
) -> Result<BTreeMap<String, String>, FileError> {
    let Some(frame) = frame else {
        return Ok(table::first_texts(place)?.into_iter().collect());
    };
    let text = |own: &Column| Some((own.name().to_string(), own.str().ok()?.get(0)?.to_owned()));
    Ok(frame.columns().iter().filter_map(text).collect())
}

// Whether a field is no number, and no word that a text table has for one.
fn is_word(text: &str) -> bool {
    !text.trim().is_empty() && table::number_of(text).is_none()
}

// A column without a role whose texts name sheared catalogues, whatever its name: the first row has one, too.
fn step_column(
    place: &Place,
    frame: Option<&DataFrame>,
    texts: &BTreeMap<String, String>,
    columns: &Columns,
) -> Result<Option<String>, FileError> {
    for (name, text) in texts {
        let is_candidate =
            catalogue_named(text).is_some() && !columns.all().any(|(_, own)| own == name);
        let by_name = fits_any(&recognition().patterns.step, name);
        if is_candidate && (by_name || names_sheared(place, frame, name)?) {
            return Ok(Some(name.clone()));
        }
    }
    Ok(None)
}

// Whether the texts of all rows are those of sheared catalogues: `00` and `m1` are also numbers of chips and names of fields. Other
// texts are those of sheared PSFs if noshear is beside a sheared catalogue.
fn names_sheared(place: &Place, frame: Option<&DataFrame>, name: &str) -> Result<bool, FileError> {
    let (mut seen, mut others, mut are_clear) = ([false; CATALOGUES], false, true);
    let mut known = HashSet::new();
    let mut add = |part: &DataFrame| -> Result<(), FileError> {
        for text in texts_of(part, name).into_iter().flatten().flatten() {
            if known.len() < MAX_COUNTED && !known.contains(text) {
                known.insert(text.to_owned());
                are_clear &= text.trim().len() > 2;
                // Text tables give `00` as the number that it is.
                let is_zero = || (text.trim() == "0").then_some(0);
                match catalogue_named(text).or_else(is_zero) {
                    Some(catalogue) => seen[catalogue] = true,
                    None => others = true,
                }
            }
        }
        Ok(())
    };
    each_part(place, frame, &[name], &[name], &mut add)?;
    let [noshear, plus1, minus1, plus2, minus2] = seen;
    let sheared = plus1 || minus1 || plus2 || minus2;
    let pair = plus1 && minus1 || plus2 && minus2;
    // Of a column of numbers, such as `00` to `61` in a text table, no text is known.
    let are_clear = are_clear && !known.is_empty();
    Ok(noshear && sheared || !others && (pair || are_clear))
}

// Whether shearq wrote a table. Those in memory and text have no metadata: columns decide that no other program writes, the
// energy of the network, or those of detections.
fn is_own(place: &Place, frame: Option<&DataFrame>, names: &[String]) -> Result<bool, FileError> {
    let in_file = match frame {
        None => states_shearq(&place.path)?,
        Some(_) => None,
    };
    let by_columns = || are_of_detections(names) || names.iter().any(|name| name == "first_energy");
    Ok(in_file.unwrap_or_else(by_columns))
}

/// Whether the metadata of a file state that shearq wrote it; `None` of text, which has none.
pub fn states_shearq(path: &Path) -> Result<Option<bool>, FileError> {
    let Some(format) = FileFormat::of(path) else {
        return Ok(None);
    };
    let stated = table::read_metadata(path, format, ["creator"])?;
    let creator = stated.get("creator");
    Ok(Some(creator.is_some_and(|own| own.starts_with("shearq "))))
}

// SExtractor's name of a running number, which other programs use for counts.
const COUNTER: &str = "number";
// Rows that share an identifier in catalogues of several measurements of each galaxy, at most. Chosen by hand: metadetection
// has five.
const MAX_SHARING: usize = 20;
// So many different numbers are no counts.
const MAX_COUNTED: usize = 1 << 16;

// The different values of a column, and the rows until [`MAX_COUNTED`] of them were found, however the table is split.
fn counted(
    place: &Place,
    frame: Option<&DataFrame>,
    name: &str,
) -> Result<(usize, usize), FileError> {
    let (mut keys, mut rows) = (HashSet::new(), 0);
    let mut add = |part: &DataFrame| -> Result<(), FileError> {
        if keys.len() < MAX_COUNTED {
            for key in identity::keys(part, name, &place.path)? {
                rows += 1;
                keys.insert(key);
                if keys.len() >= MAX_COUNTED {
                    break;
                }
            }
        }
        Ok(())
    };
    each_part(place, frame, &[name], &[name], &mut add)?;
    Ok((keys.len(), rows))
}

// Whether a column names galaxies: a number of exposures has few values.
fn is_identity(place: &Place, frame: Option<&DataFrame>, name: &str) -> Result<bool, FileError> {
    let (different, rows) = counted(place, frame, name)?;
    Ok(different >= MAX_COUNTED || different * MAX_SHARING >= rows)
}

// Whether each row has its own value.
fn are_different(place: &Place, frame: Option<&DataFrame>, name: &str) -> Result<bool, FileError> {
    let (different, rows) = counted(place, frame, name)?;
    Ok(different == rows && rows > 0)
}

/// Adds the columns that formulas give, with the formula as their name.
///
/// # Errors
/// If a formula compares a text with a column of numbers, or has an angle in degrees.
pub fn add_formulas(
    mut part: DataFrame,
    formulas: &[Expression],
    path: &Path,
) -> Result<DataFrame, FileError> {
    for formula in formulas {
        refuse_long_integers(&part, &formula.exact_columns(), formula, path)?;
        let operands = formula.operands().iter();
        let operands = operands.map(|own| operand_values(&part, own, path));
        let operands: Vec<_> = operands.collect::<Result<_, _>>()?;
        formula
            .check_angles(part.height(), |at, k| operands[k][at])
            .map_err(|message| FileError::new(path, message).hint(RADIANS))?;
        let values = (0..part.height()).map(|at| formula.value(&|k| operands[k][at]));
        let values: Vec<f64> = values.collect();
        let column = Column::new(formula.text().into(), values);
        part.with_column(column)
            .map_err(|error| FileError::new(path, error.to_string()))?;
    }
    Ok(part)
}

/// The names of all columns, and the formulas among those that the user gives for roles, whose texts are names, too. A plus between
/// columns of flags is no sum.
///
/// # Errors
/// If a formula has a column that is absent.
pub fn with_formulas(
    path: &Path,
    names: &[String],
    given: &Names,
) -> Result<(Vec<String>, Vec<Expression>), FileError> {
    let given = given.of_table(path, names)?;
    let there = |name: &str| name == "none" || names.iter().any(|own| own == name);
    let is_list = |role: Role, text: &str| role == Role::Flag && text.split('+').all(there);
    let mut found: Vec<Expression> = Vec::new();
    for (role, text) in given.columns() {
        // A name with a minus or a dot may be the name of a column.
        if there(text) || is_list(role, text) || found.iter().any(|own| own.text() == text) {
            continue;
        }
        let Ok(formula) = Expression::parse(text) else {
            continue;
        };
        // A column that is absent is reported as such.
        let is_absent = formula.is_number() && !may_be_number(role);
        if formula.columns().any(|name| name == text) || is_absent {
            continue;
        }
        if let Some(absent) = formula.columns().find(|name| !there(name)) {
            return Err(FileError::no_column(path, absent, names));
        }
        found.push(formula);
    }
    let computed = found.iter().map(|own| own.text().to_owned());
    Ok((names.iter().cloned().chain(computed).collect(), found))
}

// How ellipticities become shears, as the user states or as the columns have it. A response of the ellipticities themselves
// replaces a conversion: with the names of HSM, `R11` was listed and not used, which gave m = −0.233 for 0.031.
fn conversion(
    path: &Path,
    stated: Option<Shapes>,
    columns: &Columns,
    has_sheared_tables: bool,
) -> Result<Shapes, FileError> {
    let in_rows = has_sheared_tables || columns.of(Role::ShearedCatalogue).is_some();
    let in_columns = columns.of_sheared((Role::E1, 1));
    let response = columns.of(Role::R11).or(in_columns);
    let response = response.or(columns.of(Role::ShearedCatalogue));
    let has_response = in_rows || response.is_some();
    let (option, why) = match stated {
        None if columns.distortion && !has_response => return Ok(Shapes::Responsivity),
        None => return Ok(Shapes::Shear),
        Some(Shapes::Responsivity) if has_response => ("responsivity", "2ℛ replaces it"),
        Some(Shapes::Converted) if columns.of(Role::R11).is_some() => (
            "distortion",
            "it is the response of the distortions that are converted",
        ),
        // Sheared ellipticities are converted like the others, for which both components are required.
        Some(Shapes::Converted) if in_columns.is_some() && !columns.have_other_sheared() => (
            "distortion",
            "the other component of the sheared distortions is missing",
        ),
        Some(shapes) => return Ok(shapes),
    };
    let named = response.unwrap_or("the sheared catalogues");
    let message =
        format!("`{named}`: with --ellipticity {option}, this response is not used, because {why}");
    Err(FileError::new(path, message).hint("--ellipticity shear, which divides the ellipticities by their response whatever their type, or R11=none,R22=none in --columns without it"))
}

// Whether shear does not change a column, judged by its role and name.
fn is_fixed(name: &str, columns: &Columns) -> bool {
    use Role::{Flag, G1, G2, Id, Psf1, Psf2, PsfSize, Unit, X, Y};
    let roles = [G1, G2, Id, Psf1, Psf2, PsfSize, Unit, X, Y, Flag];
    let mut flags = columns.flags.iter();
    roles.iter().any(|role| columns.of(*role) == Some(name))
        || flags.any(|flag| flag.eq_ignore_ascii_case(name))
        || fits_any(&recognition().patterns.fixed, name)
}

// Refuses to choose galaxies by columns of one sheared catalogue, or by measured ones without sheared columns.
fn check_chosen<'a>(
    path: &Path,
    chosen_by: impl Iterator<Item = &'a str>,
    has_sheared: impl Fn(&str) -> bool,
) -> Result<(), FileError> {
    for name in chosen_by {
        if let Some((_, base)) = sheared_name(name).filter(|(_, base)| has_sheared(base)) {
            return Err(FileError::new(
                path,
                format!("`{name}` belongs to one sheared catalogue (expected a column of all)"),
            )
            .hint(base));
        }
        if changes_with_shear(name) && !has_sheared(name) {
            return Err(FileError::new(
                path,
                format!(
                    "galaxies cannot be selected by `{name}`: it changes with shear, and has no columns of sheared catalogues (expected e1, e2, snr, flux or size)"
                ),
            ));
        }
    }
    Ok(())
}

// Checks that the sheared catalogues of shearq are for a shear of `step`, if the settings are there.
fn check_step(path: &Path, step: f64) -> Result<(), FileError> {
    let stated = || {
        let metadata = table::read_metadata(path, FileFormat::of(path)?, ["settings"]).ok()?;
        let settings: toml::Table = metadata.get("settings")?.parse().ok()?;
        settings.get("shape")?.get("sheared_step")?.as_float()
    };
    match stated() {
        Some(stated) if stated != step => Err(FileError::new(
            path,
            format!(
                "the sheared catalogues are for another shear (found {stated}, expected {step})"
            ),
        )
        .hint(format!("--step {stated}"))),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_of_all_rows_decide_on_sheared_catalogues() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.csv");
        for (texts, expected) in [
            ("noshear 1p 1m 2p 2m", true),
            ("00 1p 1m 2p 2m", true),
            ("noshear 1p 1m 1p_psf", true),
            ("1p 1m", true),
            ("noshear noshear", true),
            ("00 01 02 03 04", false),
            ("00 17 61", false),
            ("m1 m2 m3", false),
            ("1m 2m", false),
            ("1+ 2+ 3+", false),
            ("00 00", false),
        ] {
            let rows = texts.split(' ').map(|text| format!("{text},0.1\n"));
            let text = format!("ccd,e1\n{}", rows.collect::<String>());
            std::fs::write(&path, text).unwrap();
            let found = names_sheared(&Place::of(&path), None, "ccd").unwrap();
            assert_eq!(found, expected, "{texts}");
        }
    }
}
