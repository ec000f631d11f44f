//! Which columns of a catalogue are what.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use shearq_bias::SHEARED_CATALOGUES;
use shearq_files::{FileError, names_of};
use shearq_submissions::EllipticityType;

use crate::expression::{Expression, with_names};
use crate::own_columns::refuse_divided;
use crate::recognition::{Survey, fits_any, has_any, names_of_role, recognition, words};
use crate::roles::{Key, Role, keys, name_of, named, partner, role_names, sheared_pair};
use crate::steps::{sheared_column, sheared_name, unsheared};

/// How ellipticities become shears.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shapes {
    /// They are shears (1 − q)/(1 + q), or of any type and divided by their response.
    Shear,
    /// Distortions (1 − q²)/(1 + q²), each converted to a shear. Moduli above 1 have none and are left out.
    #[serde(rename = "distortion")]
    Converted,
    /// Distortions, whose mean is divided by 2ℛ. ℛ = 1 − ⟨w e_rms²⟩/⟨w⟩ with the standard deviation e_rms of a component
    /// (Bernstein & Jarvis 2002, equation 5.33; Mandelbaum et al. 2018, equation 10).
    Responsivity,
}

impl Shapes {
    /// Its name in `--ellipticity`.
    pub fn name(self) -> &'static str {
        match self {
            Shapes::Shear => "shear",
            Shapes::Converted => "distortion",
            Shapes::Responsivity => "responsivity",
        }
    }
}

fn recognised((role, catalogue): Key) -> Vec<String> {
    let Some(sheared) = catalogue.checked_sub(1) else {
        return names_of_role(role).map(str::to_owned).collect();
    };
    let (sheared, k) = (SHEARED_CATALOGUES[sheared].0, role as usize);
    vec![
        format!("e{}_{sheared}", k + 1),
        format!("g{}_{sheared}", k + 1),
        format!("ngmix_ell_{sheared}[{k}]"),
    ]
}

// For a response of a component to the other one, the response to the own one, without which it is of no use.
fn diagonal((role, catalogue): Key) -> Option<Key> {
    match role {
        Role::R12 => Some((Role::R11, 0)),
        Role::R21 => Some((Role::R22, 0)),
        Role::E1 if catalogue > 2 => Some(sheared_pair(0, 0)[0]),
        Role::E2 if [1, 2].contains(&catalogue) => Some(sheared_pair(1, 1)[0]),
        _ => None,
    }
}

// Under artificial shears of one component alone, neither ellipticity would have a response, and m would be that of R = 1.
fn check_own_responses(path: &Path, columns: &BTreeMap<Key, String>) -> Result<(), FileError> {
    let pairs = [0, 1].map(|k| sheared_pair(k, k));
    let there = pairs.map(|pair| pair.iter().all(|key| columns.contains_key(key)));
    let Some(k) = [0, 1].into_iter().find(|&k| there[k] && !there[1 - k]) else {
        return Ok(());
    };
    let name = &columns[&pairs[k][0]];
    let without = ["e1_1p=none,e1_1m=none", "e2_2p=none,e2_2m=none"][k];
    let message = format!(
        "`{name}` and its partner give the response of e{} alone (expected e{} under its own artificial shears, too)",
        k + 1,
        2 - k
    );
    Err(FileError::new(path, message).hint(format!("--columns with its names, or {without}")))
}

// Metacalibration of `g1_noshear` is no response of a column `e1` of another method: m was 0.06 for −0.04.
fn check_sheared_names(
    path: &Path,
    columns: &BTreeMap<Key, String>,
    names: &Names,
) -> Result<(), FileError> {
    let sheared = (Role::E1, 1);
    let (Some(e1), Some(plus)) = (columns.get(&(Role::E1, 0)), columns.get(&sheared)) else {
        return Ok(());
    };
    let are_given = names.is_given(Role::E1) || names.given.contains_key(&sheared);
    let is_of_shear = recognised(sheared)
        .iter()
        .any(|own| own.starts_with('g') && own.eq_ignore_ascii_case(plus));
    if are_given || !is_of_shear || sheared_name(plus).is_some_and(|(_, own)| own == unsheared(e1))
    {
        return Ok(());
    }
    let other = plus.replace("_1p", "_noshear").replace("_1P", "_NOSHEAR");
    let second = other.replace('1', "2");
    let message =
        format!("`{plus}` is no sheared version of `{e1}` (expected e1 with its own response)");
    Err(FileError::new(path, message).hint(format!("--columns e1={other},e2={second} for these sheared catalogues, or e1_1p=none,e1_1m=none,e2_2p=none,e2_2m=none for `{e1}` without them")))
}

fn check_partners(
    path: &Path,
    columns: &BTreeMap<Key, String>,
    found: &[String],
) -> Result<(), FileError> {
    let absent = |key: &Key| partner(*key).filter(|partner| !columns.contains_key(partner));
    let Some((key, column, absent)) = columns
        .iter()
        .find_map(|(key, column)| Some((key, column, name_of(absent(key)?))))
    else {
        return Ok(());
    };
    Err(FileError::new(
        path,
        format!(
            "there is a column `{column}` but none for {absent} (found {})",
            names_of(found)
        ),
    )
    .hint(format!(
        "--columns {absent}=NAME, or {}=none",
        name_of(*key)
    )))
}

impl Survey {
    fn of(&self, key: Key) -> Option<&str> {
        self.columns.get(&key).map(String::as_str)
    }

    // Why a catalogue with the columns `found` is not of this survey: a column that it lacks. Names of e1 and e2 that the user gives
    // must be the survey's. A weight that the user gives is the survey's weight if all other columns are there and none is declined:
    // `w=w` turned plain catalogues into catalogues of UNIONS, whose R11 and R22 are not used.
    fn absent_column(&self, found: &[String], names: &Names) -> Option<&str> {
        const WEIGHT: Key = (Role::Weight, 0);
        let there = |column: &str| found.iter().any(|own| own.eq_ignore_ascii_case(column));
        let own_weight = self.of(WEIGHT);
        let is_own_weight = |own: &str| Some(own) == own_weight;
        let is_renamed = names.is_given(Role::Weight)
            && self
                .required
                .iter()
                .any(|own| is_own_weight(own) && !there(own));
        // Also a formula of it, such as one with another sign.
        let is_of = |given: &str, column: &str| {
            given.eq_ignore_ascii_case(column)
                || there(column) && has_operand(given, |own| own.eq_ignore_ascii_case(column))
        };
        let known = |key: &Key, column: &str| match (key, names.given.get(key)) {
            ((Role::E1 | Role::E2, 0), Some(given)) => is_of(given, column),
            ((Role::E1 | Role::E2, 0), None) => self.column_of(*key, found).is_some(),
            (key, _) => !is_renamed || *key == WEIGHT || there(column),
        };
        let mut columns = self.columns.iter();
        let absent = columns.find(|(key, column)| !known(key, column));
        let mut required = self.required.iter();
        let is_required = |own: &&String| !(there(own) || is_renamed && is_own_weight(own));
        let absent = absent.map(|(_, column)| column);
        absent
            .or_else(|| required.find(is_required))
            .map(String::as_str)
    }

    // The column of a role among `found`, or in a file of the user a formula or a sum of flags whose columns are there.
    fn column_of(&self, key: Key, found: &[String]) -> Option<String> {
        let stated = self.of(key)?;
        let mut all = found.iter();
        if let Some(own) = all.find(|own| is_called(own, stated)) {
            return Some(own.clone());
        }
        self.file.as_ref()?;
        // In any case, as columns.
        let there = |name: &str| {
            let exact = found.iter().find(|own| *own == name);
            let same = exact.or_else(|| found.iter().find(|own| is_called(own, name)));
            same.map(String::as_str)
        };
        let list: Option<Vec<&str>> = stated.split('+').map(there).collect();
        if let Some(list) = list.filter(|_| key.0 == Role::Flag) {
            return Some(list.join("+"));
        }
        let formula = Expression::parse(stated).ok()?;
        let columns: Vec<&str> = formula.columns().collect();
        let computes = computes(&formula, key.0, |name| there(name).is_some());
        let renamed = |name: &str| {
            let own = there(name).filter(|own| columns.contains(&name) && *own != name);
            own.map(str::to_owned)
        };
        computes.then(|| with_names(stated, renamed))
    }
}

/// Whether a number may stand in place of the column of a role, for all galaxies: an ellipticity or a flag of all is a mistake.
pub fn may_be_number(role: Role) -> bool {
    use Role::{C1, C2, G1, G2, M, PsfSize, R11, R12, R21, R22, RmsE, SigmaE};
    [R11, R22, R12, R21, M, C1, C2, G1, G2, RmsE, SigmaE, PsfSize].contains(&role)
}

/// Whether a role may have a formula: its columns are there, or it is a number that all galaxies may have.
pub fn computes(formula: &Expression, role: Role, is_there: impl FnMut(&str) -> bool) -> bool {
    match formula.is_number() {
        true => may_be_number(role),
        false => formula.columns().all(is_there),
    }
}

/// Whether a formula has such an operand.
pub fn has_operand(formula: &str, is_wanted: impl Fn(&str) -> bool) -> bool {
    Expression::parse(formula).is_ok_and(|own| own.columns().any(is_wanted))
}

// Whether a column has a name in any case, or is a component of a vector of this name.
fn is_called(own: &str, name: &str) -> bool {
    own.eq_ignore_ascii_case(name)
        || in_vector(name).is_some_and(|name| own.eq_ignore_ascii_case(&name))
}

// The column of this name, or else of this name in other letters.
fn same_name<'a>(found: &'a [String], name: &str) -> Option<&'a String> {
    let exact = found.iter().find(|own| *own == name);
    exact.or_else(|| found.iter().find(|own| own.eq_ignore_ascii_case(name)))
}

/// The name of a column without the name of the unsheared catalogue.
pub fn base(name: &str) -> &str {
    name.strip_suffix("_noshear").unwrap_or(name)
}

// The column of the other component: `sens_2` of `sens_1`, `R22` of `R11`, and of `fpfs1_de1_dg1` the one of the same method.
fn other_component<'f>(found: &'f [String], name: &str) -> Option<&'f String> {
    let prefix = method_of(name);
    let other = prefix.to_owned() + &name[prefix.len()..].replace('1', "2");
    let own = found.iter().find(|own| **own == other);
    own.filter(|_| other != name)
}

/// Columns that were given for roles, or `none`, and surveys that were described.
#[derive(Debug, Clone, Default)]
pub struct Names {
    given: BTreeMap<Key, String>,
    presets: Vec<Survey>,
}

/// Why `--columns` cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    #[error("--columns: found `{0}`, expected ROLE=COLUMN with a role of {known}", known = role_names())]
    Syntax(String),
    #[error("--columns: unknown role (found `{0}`, expected one of {known})", known = role_names())]
    Role(String),
    #[error("--columns: {0} is given twice")]
    Twice(String),
}

// Roles that one column may have together: a scalar response of both components, a symmetric one, and identifiers of units.
// Another column with two roles compares a quantity with itself: `e1=g1`, with g1 as the true shear, gave m = 0.
const SHARED: [[Role; 2]; 3] = [
    [Role::R11, Role::R22],
    [Role::R12, Role::R21],
    [Role::Id, Role::Unit],
];

impl Names {
    pub fn add(&mut self, text: &str) -> Result<(), NameError> {
        let (role, column) = match text.split_once('=') {
            Some((role, column)) if !column.is_empty() => (role, column),
            _ => return Err(NameError::Syntax(text.to_owned())),
        };
        // Names of recognised columns are accepted for roles: AnaCal calls dw1 dw_dg1.
        let is_recognised = |key: &Key| {
            let mut all = recognised(*key).into_iter();
            all.any(|own| own.eq_ignore_ascii_case(role))
        };
        let key = named(role).or_else(|| keys().find(is_recognised));
        let key = key.ok_or_else(|| NameError::Role(role.to_owned()))?;
        match self.given.insert(key, column.to_owned()) {
            Some(_) => Err(NameError::Twice(role.to_owned())),
            None => Ok(()),
        }
    }

    /// Adds the column that names the sheared catalogue of each row.
    pub fn add_step(&mut self, column: String) {
        self.given.insert((Role::ShearedCatalogue, 0), column);
    }

    /// Declines columns of these roles, also of those that were given.
    pub fn decline(&mut self, roles: &[Role]) {
        let none = roles.iter().map(|role| ((*role, 0), "none".to_owned()));
        self.given.extend(none);
    }

    /// Adds surveys, which are preferred to the known ones.
    pub fn add_presets(&mut self, surveys: Vec<Survey>) {
        self.presets.extend(surveys);
    }

    /// The same with the columns and formulas of the survey of the user's files that a table with the columns `found` belongs to.
    ///
    /// # Errors
    /// If the table lacks one of them: roles that were dropped without a word gave m = −0.175.
    pub fn of_table(&self, path: &Path, found: &[String]) -> Result<Cow<'_, Self>, FileError> {
        let mut presets = self.presets.iter();
        let Some(survey) = presets.find(|own| own.absent_column(found, self).is_none()) else {
            return Ok(Cow::Borrowed(self));
        };
        let mut all = self.clone();
        for (key, stated) in &survey.columns {
            let column = match stated.as_str() {
                none @ "none" => Some(none.to_owned()),
                _ => survey.column_of(*key, found),
            };
            match (all.given.contains_key(key), column) {
                (true, _) => {}
                (false, Some(column)) => _ = all.given.insert(*key, column),
                (false, None) => {
                    let file = survey.file.as_deref().unwrap_or(Path::new("--preset"));
                    let (role, names) = (name_of(*key), names_of(found));
                    let message = format!(
                        "there is no column `{stated}`, which {} states as {role} of `{}` (found {names})",
                        file.display(),
                        survey.name
                    );
                    return Err(FileError::new(path, message)
                        .hint(format!("--columns {role}=NAME, or {role}=none")));
                }
            }
        }
        Ok(Cow::Owned(all))
    }

    // Surveys of the user's files that a table does not belong to, if it belongs to none of them.
    fn unfit_presets(&self, found: &[String]) -> Vec<String> {
        let absent = |own: &Survey| {
            let column = own.absent_column(found, self)?;
            let file = own.file.as_deref().unwrap_or(Path::new("--preset"));
            Some(format!(
                "Not of the survey `{}` of {}, because there is no column `{column}`.",
                own.name,
                file.display()
            ))
        };
        let lines = self.presets.iter().map(absent);
        lines.collect::<Option<_>>().unwrap_or_default()
    }

    /// The columns and formulas that were given.
    pub fn columns(&self) -> impl Iterator<Item = (Role, &str)> {
        let given = self.given.iter();
        given.map(|((role, _), column)| (*role, column.as_str()))
    }

    /// The columns and formulas of a table with the columns `found`, which may lack the columns of others.
    pub fn within(&self, found: &[String]) -> Self {
        let is_there = |name: &str| found.iter().any(|own| own == name);
        let is_list =
            |(role, _): &Key, text: &str| *role == Role::Flag && text.split('+').all(is_there);
        let mut own = self.clone();
        own.given.retain(|key, name| {
            name == "none"
                || is_there(name)
                || is_list(key, name)
                || Expression::parse(name).is_ok_and(|own| computes(&own, key.0, is_there))
        });
        own
    }

    /// Whether the responses of each component to the other one are not to be used, in columns or by sheared catalogues.
    pub fn decline_matrix(&self) -> bool {
        let mut roles = [Role::R12, Role::R21].into_iter();
        roles.any(|role| self.given.get(&(role, 0)).is_some_and(|own| own == "none"))
    }

    fn key_of(&self, column: &str) -> Option<Key> {
        let mut given = self.given.iter();
        given.find_map(|(key, own)| (own == column && own != "none").then_some(*key))
    }

    pub fn is_given(&self, role: Role) -> bool {
        self.given.contains_key(&(role, 0))
    }

    // Refuses a column with two roles: measured shears that are also the true ones have m = 0.
    fn check_single_roles(&self, path: &Path) -> Result<(), FileError> {
        for (key, column) in &self.given {
            let first = self.key_of(column).unwrap_or(*key);
            // Of numbers, both components may have the same.
            let is_number = || Expression::parse(column).is_ok_and(|own| own.is_number());
            if first != *key && !SHARED.contains(&[first.0, key.0]) && !is_number() {
                let (first, role) = (name_of(first), name_of(*key));
                return Err(FileError::new(
                    path,
                    format!(
                        "column `{column}` is given as {first} and as {role} (expected one role)"
                    ),
                )
                .hint(format!("--columns {role}=NAME, or {role}=none")));
            }
        }
        Ok(())
    }

    /// Refuses columns with names of true shears that are given as something else, if nothing else states the true shear.
    pub fn check_true_shear(&self, path: &Path) -> Result<(), FileError> {
        if self.is_given(Role::G1) || self.is_given(Role::G2) {
            return Ok(());
        }
        for name in [Role::G1, Role::G2].into_iter().flat_map(names_of_role) {
            let mut given = self.given.iter();
            if let Some((key, _)) = given.find(|(_, own)| own.eq_ignore_ascii_case(name)) {
                return Err(FileError::new(
                    path,
                    format!(
                        "`{name}` is given as {}, so the true shear is unknown",
                        name_of(*key)
                    ),
                )
                .hint("--truth FILE, --columns g1=NAME,g2=NAME, or g1=none,g2=none for c alone"));
            }
        }
        Ok(())
    }
}

/// Which program wrote a catalogue, recognised by its columns.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Preset {
    /// No known program.
    #[default]
    Plain,
    /// shearq, without sheared catalogues.
    Shearq,
    /// shearq with sheared catalogues in columns, after `shape.sheared_step`.
    Sheared,
    /// GalSim's or LSST's HSM.
    Hsm,
    /// Metacalibration, with a column per sheared catalogue.
    Metacal,
    /// Metadetection, with rows or tables per sheared catalogue.
    Metadetect,
    /// AnaCal, with derivatives.
    Anacal,
}

impl Preset {
    fn of_columns(columns: &BTreeMap<Key, String>, is_hsm: bool, is_own: bool) -> Self {
        let have = |key| columns.contains_key(&key);
        if have((Role::ShearedCatalogue, 0)) {
            Preset::Metadetect
        } else if have((Role::R11, 0)) && is_own {
            Preset::Shearq
        } else if have((Role::E1, 1)) && have((Role::E2, 3)) {
            Preset::Metacal
        } else if is_hsm {
            Preset::Hsm
        } else if have((Role::Dw1, 0)) {
            Preset::Anacal
        } else {
            Preset::Plain
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Preset::Plain => "plain columns",
            Preset::Shearq => "shearq",
            Preset::Sheared => "shearq, sheared catalogues",
            Preset::Hsm => "HSM",
            Preset::Metacal => "ngmix metacal",
            Preset::Metadetect => "metadetect",
            Preset::Anacal => "AnaCal",
        }
    }
}

#[derive(Debug, Clone, Default)]
pub struct Columns {
    columns: BTreeMap<Key, String>,
    pub preset: Preset,
    /// The public catalogue or the output of a program that its columns are known from.
    survey: Option<String>,
    /// Whether the names say that ellipticities are distortions.
    pub distortion: bool,
    /// Columns that look like a weight, if none has this role and it was not declined.
    pub doubtful_weights: Vec<String>,
    /// Columns that look like a weight, flag, response, calibration, error or sheared catalogue and have no role.
    unused: Vec<String>,
    // Columns without a role whose names say nothing.
    unknown: Vec<String>,
    // Ellipticities of other methods, which are not used.
    others: Vec<[String; 2]>,
    /// All columns of flags; the first has the role.
    pub flags: Vec<String>,
    pub choices: Vec<String>,
    /// Columns that may hold names of sheared catalogues, if no column has this role and it was not declined.
    pub steps: Vec<String>,
    /// A column without a role that states the artificial shear of sheared catalogues.
    pub step_size: Option<String>,
    /// Why the surveys of the user's files are not used, a sentence each.
    pub unfit_presets: Vec<String>,
    /// The first text of each column of texts.
    pub texts: BTreeMap<String, String>,
}

impl Columns {
    /// Finds the columns of the catalogue `path`, which has the columns `found`; `is_own` if shearq wrote it.
    pub fn find(
        path: &Path,
        found: &[String],
        names: &Names,
        is_own: bool,
    ) -> Result<Self, FileError> {
        let names = &*names.of_table(path, found)?;
        names.check_single_roles(path)?;
        let mut surveys = names.presets.iter().chain(&recognition().surveys);
        let survey = surveys.find(|survey| survey.absent_column(found, names).is_none());
        // A column called g1 that is given as e1 is not the true shear, too.
        let free = &|name: &str| {
            let all = found.iter().filter(|own| is_called(own, name));
            let mut all = all.filter(|own| names.key_of(own).is_none());
            all.clone().find(|own| *own == name).or_else(|| all.next())
        };
        // The names of e1 and e2 that the table has, both of one method.
        let pairs = names_of_role(Role::E1).zip(names_of_role(Role::E2));
        let pairs = pairs.filter_map(|(e1, e2)| Some([free(e1)?, free(e2)?]));
        let pairs: Vec<[&String; 2]> = pairs.collect();
        let chosen = chosen_pair(found, names, &pairs);
        let mut columns = columns_by_role(path, found, names, survey, (&pairs, chosen), free)?;
        let name_of_e1 = |columns: &BTreeMap<Key, String>| {
            columns
                .get(&(Role::E1, 0))
                .map(|e1| e1.to_ascii_lowercase())
        };
        // A role without its partner is refused below, so KSB's shears are forgotten without distortions.
        // HSM has both in one table: shears of KSB, and distortions of all other methods.
        if name_of_e1(&columns).is_none_or(|e1| e1 != "corrected_e1") {
            columns.retain(|(role, _), _| ![Role::KsbE1, Role::KsbE2].contains(role));
        }
        without_derivatives_alone(path, &mut columns, names)?;
        // Responses are those of the distortions, and no shear of KSB has one.
        let has_response = columns.contains_key(&(Role::R11, 0));
        if has_response || columns.contains_key(&(Role::ShearedCatalogue, 0)) {
            columns.retain(|(role, _), _| ![Role::KsbE1, Role::KsbE2].contains(role));
        }
        let flags = find_flags(path, found, names, survey, name_of_e1(&columns))?;
        columns.extend(flags.first().map(|first| ((Role::Flag, 0), first.clone())));
        find_sheared(&mut columns, found, names);
        for (key, own) in keys().filter_map(|key| Some((key, diagonal(key)?))) {
            if names.decline_matrix() || !columns.contains_key(&own) {
                columns.remove(&key);
            }
        }
        check_own_responses(path, &columns)?;
        check_sheared_names(path, &columns, names)?;
        let Some(e1) = name_of_e1(&columns).or_else(|| Some(columns.get(&(Role::E2, 0))?.clone()))
        else {
            return Err(FileError::new(
                path,
                format!(
                    "there are no columns of ellipticities (found {}, expected e1 and e2)",
                    names_of(found)
                ),
            )
            .hint(format!("--columns {}", likely_ellipticities(found))));
        };
        check_partners(path, &columns, found)?;
        let is_distortion = |name: &str| {
            let mut known = recognition().ellipticity.distortion.iter();
            known.any(|own| own == name)
        };
        let distortion = is_distortion(&e1)
            || has_operand(&e1, is_distortion)
            || survey.is_some_and(|survey| survey.ellipticity == EllipticityType::Distortion);
        let preset = Preset::of_columns(&columns, distortion || e1 == "corrected_g1", is_own);
        if preset == Preset::Shearq {
            refuse_divided(path, found)?;
        }
        let others = match survey.is_none() && chosen.is_some() {
            true => other_pairs(&pairs, &e1),
            false => Vec::new(),
        };
        let mut columns = Columns {
            columns,
            preset,
            survey: survey.map(|survey| survey.name.clone()),
            distortion,
            others,
            flags,
            unfit_presets: names.unfit_presets(found),
            ..Columns::default()
        };
        if preset == Preset::Metacal && !names.is_given(Role::E1) {
            columns.take_unsheared(found);
        }
        // All columns of shearq are known.
        if preset != Preset::Shearq {
            columns.find_unused(found, names);
        }
        Ok(columns)
    }

    /// The ellipticities of other methods, which are not used.
    pub fn others(&self) -> impl Iterator<Item = &String> {
        self.others.iter().flatten()
    }

    /// The public catalogue or the program that wrote it.
    pub fn program(&self) -> &str {
        self.survey.as_deref().unwrap_or(self.preset.name())
    }

    /// Each column that is used, as in `--columns`. Roles that are not `read` are left out.
    pub fn used(&self, read: impl Fn(Role) -> bool) -> String {
        let roles = self.roles(read).into_iter();
        let named = roles.map(|(role, column)| format!("{role}={column}"));
        named.collect::<Vec<_>>().join(", ")
    }

    /// The roles that are `read`, by their names in `--columns`, with their columns.
    pub fn roles(&self, read: impl Fn(Role) -> bool) -> Vec<(String, String)> {
        let used = keys().filter(|key| read(key.0) && self.columns.contains_key(key));
        let named = used.map(|key| match key.0 {
            Role::Flag => (name_of(key), self.flags.join("+")),
            _ => (name_of(key), self.columns[&key].clone()),
        });
        named.collect()
    }

    /// Gives a role to a column.
    pub fn take(&mut self, role: Role, column: &str) {
        self.columns.insert((role, 0), column.to_owned());
    }

    /// Forgets the column of a role.
    pub fn decline(&mut self, role: Role) {
        self.columns.remove(&(role, 0));
    }

    /// Refuses flags that are texts, of which only the user knows which one good rows have.
    pub fn refuse_texts_of_flags(&self, path: &Path) -> Result<(), FileError> {
        let mut flags = self.flags.iter();
        let text = flags.find_map(|name| Some((name, self.texts.get(name)?)));
        match text {
            None => Ok(()),
            Some((name, text)) => {
                let message = format!(
                    "`{name}` has texts (found `{text}` in the first row, expected a flag, which is 0 in good rows)"
                );
                Err(FileError::new(path, message).hint(format!(
                    "--columns \"flag={name} != 'TEXT'\" with the text of good rows, or flag=none"
                )))
            }
        }
    }

    /// Of a catalogue of shearq with sheared catalogues, takes these if a selection requires them, and otherwise the columns
    /// without them, which have less noise.
    pub fn choose_sheared(&mut self, found: &[String], required: bool) {
        if self.preset != Preset::Shearq || self.of_sheared((Role::E1, 1)).is_none() {
            return;
        }
        if required {
            self.preset = Preset::Sheared;
            self.take_unsheared(found);
        } else {
            self.columns.retain(|(_, catalogue), _| *catalogue == 0);
        }
    }

    // Takes the ellipticity of the unsheared catalogue, whose noise is the one of the sheared catalogues: other columns may
    // have less.
    fn take_unsheared(&mut self, found: &[String]) {
        for (role, name) in [(Role::E1, "e1_noshear"), (Role::E2, "e2_noshear")] {
            if found.iter().any(|own| own == name) {
                self.columns.insert((role, 0), name.to_owned());
            }
        }
    }

    pub fn of(&self, role: Role) -> Option<&str> {
        self.of_sheared((role, 0))
    }

    pub fn of_sheared(&self, key: Key) -> Option<&str> {
        self.columns.get(&key).map(String::as_str)
    }

    pub fn have(&self, roles: &[Role]) -> bool {
        roles.iter().all(|role| self.of(*role).is_some())
    }

    /// Whether the ellipticities of each component under shears of the other one are there.
    pub fn have_other_sheared(&self) -> bool {
        let mut keys = [sheared_pair(0, 1), sheared_pair(1, 0)]
            .into_iter()
            .flatten();
        keys.all(|key| self.columns.contains_key(&key))
    }

    /// Whether sheared columns of cuts and weights give the response of the selection.
    pub fn give_selection_response(&self) -> bool {
        match self.preset {
            Preset::Metacal | Preset::Sheared => true,
            Preset::Shearq | Preset::Anacal | Preset::Metadetect => false,
            // Catalogues with responses of galaxies often have only the selected quantities in sheared columns: DES Y1
            // publishes R11 to R22 and `flags_select_1p`, but no sheared ellipticities.
            Preset::Plain | Preset::Hsm => self.have(&[Role::R11]),
        }
    }

    pub fn is_of_shearq(&self) -> bool {
        [Preset::Shearq, Preset::Sheared].contains(&self.preset)
    }

    pub fn all(&self) -> impl Iterator<Item = (Key, &str)> {
        self.columns.iter().map(|(key, name)| (*key, name.as_str()))
    }
}

// The column without artificial shear if its name says so in another spelling: `noshear_e1`, `00/g1`, `unsheared/R11`.
fn unsheared_column<'f>(
    found: &'f [String],
    (role, catalogue): Key,
    names: &[String],
    free: &impl Fn(&str) -> Option<&'f String>,
) -> Option<&'f String> {
    use Role::{E1, E2, R11, R12, R21, R22, Weight};
    if ![E1, E2, R11, R12, R21, R22, Weight].contains(&role) || catalogue > 0 {
        return None;
    }
    let is_plain = |own: &String| words(own).trim_matches('_') == unsheared(own);
    // `g1` alone is the true shear.
    let more: &[&str] = match role {
        E1 => &["g1", "g_1"],
        E2 => &["g2", "g_2"],
        _ => &[],
    };
    let known = |own: &String| {
        let rest = unsheared(own);
        let mut names = names.iter().map(String::as_str).chain(more.iter().copied());
        let is_word = |name: &str| words(name).trim_matches('_') == rest;
        // `e_1` is the first component, and `e[1]` the second one.
        match own.contains('[') {
            true => names.any(|name| is_word(&in_vector(name).unwrap_or_default())),
            false => names.any(|name| !name.contains('[') && is_word(name)),
        }
    };
    let mut all = found.iter().filter(|own| !is_plain(own) && known(own));
    all.find_map(|own| free(own))
}

// Ends of the names of a method: those of its ellipticities, responses and weights.
const ENDS_OF_METHODS: [&str; 12] = [
    "_g_K", "_gK", "_g[K]", "_e_K", "_eK", "_e[K]", "_rKK", "_r_KK", "_r[K]", "_deK_dgK", "_eK_gK",
    "_w",
];

// The prefix that the columns of a method share: `mcal` of `mcal_g_1`, `fpfs1` of `fpfs1_de1_dg1`, nothing of `e1`.
fn method_of(name: &str) -> &str {
    let name = base(name);
    let digits = |c: char| {
        if c.is_ascii_digit() {
            'K'
        } else {
            c.to_ascii_lowercase()
        }
    };
    let plain: String = name.chars().map(digits).collect();
    let ends = ENDS_OF_METHODS.iter();
    let longest = ends
        .filter(|end| plain.ends_with(**end))
        .max_by_key(|end| end.len());
    let longest = longest.filter(|_| plain != "eK_gK");
    // Letters that are not ASCII are as long as they were.
    longest.map_or("", |end| &name[..plain.len() - end.len()])
}

// The column of each role but flags: the given one, that of the survey, or one with a known name.
fn columns_by_role<'f>(
    path: &Path,
    found: &'f [String],
    names: &Names,
    survey: Option<&Survey>,
    (pairs, chosen): (&[[&'f String; 2]], Option<[&'f String; 2]>),
    free: &impl Fn(&str) -> Option<&'f String>,
) -> Result<BTreeMap<Key, String>, FileError> {
    let mut columns = BTreeMap::new();
    let by_name = |key, columns: &BTreeMap<Key, String>| {
        let names = recognised(key);
        let known = of_method(found, key, columns, pairs, free);
        known.or_else(|| unsheared_column(found, key, &names, free))
    };
    let by_name = |key: Key, columns: &BTreeMap<Key, String>| match (key, chosen) {
        ((Role::E1, 0), Some([e1, _])) => Some(e1),
        ((Role::E2, 0), Some([_, e2])) => Some(e2),
        ((Role::E2, 0), None) => {
            let given = names.given.get(&(Role::E1, 0));
            let other = given.and_then(|e1| other_component(found, e1));
            let is_known = |own: &&String| names_of_role(Role::E2).any(|e2| is_called(own, e2));
            other.filter(is_known).or_else(|| by_name(key, columns))
        }
        _ => by_name(key, columns),
    };
    for key in keys().filter(|(role, _)| *role != Role::Flag) {
        let column = match (
            names.given.get(&key),
            survey.and_then(|survey| survey.of(key)),
        ) {
            (Some(none), _) if none == "none" => None,
            (Some(given), _) if found.contains(given) => Some(given),
            (Some(given), _) => return Err(FileError::no_column(path, given, found)),
            (None, Some("none")) => None,
            // A table with the columns of a survey may have a weight of another name.
            (None, Some(known)) => free(known).or_else(|| by_name(key, &columns)),
            (None, None) => by_name(key, &columns),
        };
        columns.extend(column.map(|column| (key, column.clone())));
    }
    Ok(columns)
}

// The names of e1 and e2 of methods other than that of `e1`, the first pair of each.
fn other_pairs(pairs: &[[&String; 2]], e1: &str) -> Vec<[String; 2]> {
    let mut methods = vec![method_of(e1).to_ascii_lowercase()];
    let mut others = Vec::new();
    for pair in pairs {
        let method = method_of(pair[0]).to_ascii_lowercase();
        if !methods.contains(&method) {
            methods.push(method);
            others.push(pair.map(String::clone));
        }
    }
    others
}

// Of several methods in a table, the first whose response is there: `e1` was divided by `mcal_R11` of `mcal_g_1`, which gave
// m = −0.134 for 0.05.
fn chosen_pair<'f>(
    found: &'f [String],
    names: &Names,
    pairs: &[[&'f String; 2]],
) -> Option<[&'f String; 2]> {
    let given = |role: Role| names.given.get(&(role, 0)).map(String::as_str);
    if names.is_given(Role::E1) || names.is_given(Role::E2) {
        return None;
    }
    let has = |column: &str| found.iter().any(|own| own.eq_ignore_ascii_case(column));
    let mut steps = names_of_role(Role::ShearedCatalogue);
    let in_rows = match given(Role::ShearedCatalogue) {
        Some(given) => given != "none",
        None => steps.any(has),
    };
    let undivided = &recognition().ellipticity.undivided;
    let responds = |[e1, _]: &&[&String; 2]| {
        let method = method_of(e1);
        let is_of_method = |own: &&str| method_of(own).eq_ignore_ascii_case(method);
        match given(Role::R11) {
            _ if in_rows => undivided.iter().any(|own| own.eq_ignore_ascii_case(e1)),
            Some("none") => false,
            Some(given) => is_of_method(&given),
            None => {
                let responses = found.iter().map(String::as_str);
                let mut responses = responses
                    .filter(|own| is_response(Role::R11, own) && is_of_whole_matrix(found, own));
                responses.any(|own| is_of_method(&own)) || sheared_column(found, e1, 1).is_some()
            }
        }
    };
    let first = pairs.first()?;
    // Of one method, the order of the names decides.
    let is_other =
        |own: &&[&String; 2]| !method_of(own[0]).eq_ignore_ascii_case(method_of(first[0]));
    Some(
        *pairs
            .iter()
            .find(responds)
            .filter(is_other)
            .unwrap_or(first),
    )
}

// Whether a name is one of the role, perhaps with the prefix of a method.
fn is_response(role: Role, name: &str) -> bool {
    let method = method_of(name);
    let own = name[method.len()..].trim_start_matches('_');
    names_of_role(role).any(|known| known.eq_ignore_ascii_case(own))
}

// The column of a role by its name, of the method of e1. Without a column of its method, one of no method may be meant if no
// ellipticities of no method are there; derivatives of a weight that is there are not those of another one.
fn of_method<'f>(
    found: &'f [String],
    key: Key,
    columns: &BTreeMap<Key, String>,
    pairs: &[[&String; 2]],
    free: &dyn Fn(&str) -> Option<&'f String>,
) -> Option<&'f String> {
    use Role::{Dw1, Dw2, R11, R12, R21, R22, Weight};
    let names = recognised(key);
    let free = |name: &str| free(name).filter(|own| is_of_whole_matrix(found, own));
    let mut all = names.iter().filter_map(|name| free(name));
    let (role, is_unsheared) = (key.0, key.1 == 0);
    let of = |key: Key| columns.get(&key).map_or("", String::as_str);
    let e1 = of((Role::E1, 0));
    // Of a formula, the method of its first column.
    let formula = Expression::parse(e1).ok();
    let operand = formula.as_ref().and_then(|own| own.columns().next());
    // The first response that is found decides on the others.
    let first =
        Some(of((R11, 0))).filter(|own| [R12, R21, R22].contains(&role) && is_response(R11, own));
    let own = method_of(first.or(operand).unwrap_or(e1));
    let is = |method: &str, other: &str| method.eq_ignore_ascii_case(other);
    let has_pair = |method: &str| pairs.iter().any(|pair| is(method_of(pair[0]), method));
    match role {
        R11 | R12 | R21 | R22 if is_unsheared => {
            let prefixed = names.iter().filter(|name| method_of(name).is_empty());
            let mut prefixed = prefixed.map(|name| format!("{own}_{name}"));
            let own_column = match own.is_empty() {
                true => None,
                false => prefixed.find_map(|name| free(&name)),
            };
            own_column.or_else(|| {
                all.find(|name| {
                    let method = method_of(name);
                    let may_be_meant = first.is_none() && (method.is_empty() || own.is_empty());
                    is(method, own) || may_be_meant && !has_pair(method)
                })
            })
        }
        Weight => {
            let all: Vec<&String> = all.collect();
            let of_method = all.iter().find(|name| is(method_of(name), own));
            let is_free = |name: &&&String| {
                let method = method_of(name);
                method.is_empty() || !has_pair(method)
            };
            of_method
                .filter(|_| !own.is_empty())
                .or_else(|| all.iter().find(is_free))
                .copied()
        }
        Dw1 | Dw2 => {
            let weight = of((Weight, 0));
            let is_of_weight = |name: &&String| {
                let own = weight_of(name);
                is(&own, weight) || !found.iter().any(|other| is(other, &own))
            };
            let all: Vec<&String> = all.collect();
            let exact = all.iter().find(|name| is(&weight_of(name), weight));
            exact
                .or_else(|| all.iter().find(|name| is_of_weight(name)))
                .copied()
        }
        _ => all.next(),
    }
}

// Whether a number of a vector `R` is one of four: other vectors are no responses, and `r[0]` is a radius.
fn is_of_whole_matrix(found: &[String], name: &str) -> bool {
    let is_there = |stem: &str, k: usize| found.contains(&format!("{stem}[{k}]"));
    match name.split_once('[') {
        Some((stem, _)) if format!("_{stem}").to_ascii_lowercase().ends_with("_r") => {
            stem.ends_with('R') && is_there(stem, 3) && !is_there(stem, 4)
        }
        _ => true,
    }
}

// The weight that a derivative belongs to: `wdet` of `dwdet_dg1` and `wdet_g1`, `fpfs_w` of `fpfs_dw_dg1`.
fn weight_of(derivative: &str) -> String {
    let name = derivative.to_ascii_lowercase();
    let ends = ["_dg1", "_dg2", "_g1", "_g2"];
    let stem = ends
        .iter()
        .find_map(|end| name.strip_suffix(end))
        .unwrap_or(&name);
    match stem.rsplit_once('_') {
        Some((method, weight)) => format!("{method}_{}", weight.trim_start_matches('d')),
        None => stem.trim_start_matches('d').to_owned(),
    }
}

// Adds sheared catalogues by the names of e1 and e2.
fn find_sheared(columns: &mut BTreeMap<Key, String>, found: &[String], names: &Names) {
    for role in [Role::E1, Role::E2] {
        let Some(name) = columns.get(&(role, 0)).cloned() else {
            continue;
        };
        for pair in [[1, 2], [3, 4]] {
            let both = pair.map(|catalogue| sheared_column(found, &name, catalogue));
            let [Some(plus), Some(minus)] = both else {
                continue;
            };
            for (catalogue, column) in pair.into_iter().zip([plus, minus]) {
                if !names.given.contains_key(&(role, catalogue)) {
                    let own = columns.entry((role, catalogue));
                    own.or_insert_with(|| column.clone());
                }
            }
        }
    }
}

// Derivatives of a weight are of no use without it: weights of each component have such names.
fn without_derivatives_alone(
    path: &Path,
    columns: &mut BTreeMap<Key, String>,
    names: &Names,
) -> Result<(), FileError> {
    if !columns.contains_key(&(Role::Weight, 0)) {
        let is_derivative = |(role, _): &Key| [Role::Dw1, Role::Dw2].contains(role);
        let given = columns
            .iter()
            .find(|(key, _)| is_derivative(key) && names.is_given(key.0));
        if let Some((_, name)) = given {
            let message = format!(
                "`{name}` is given as the derivative of a weight, and there is no column of weights"
            );
            return Err(
                FileError::new(path, message).hint("--columns w=NAME, or dw1=none,dw2=none")
            );
        }
        columns.retain(|key, _| !is_derivative(key));
    }
    Ok(())
}

// Columns of flags. A row counts if all are zero: DES has failures in `flags` and cuts in `flags_select`, and metadetection
// has one flag per kind of shape.
fn find_flags(
    path: &Path,
    found: &[String],
    names: &Names,
    survey: Option<&Survey>,
    e1: Option<String>,
) -> Result<Vec<String>, FileError> {
    match names.given.get(&(Role::Flag, 0)) {
        None => {}
        Some(none) if none == "none" => return Ok(Vec::new()),
        Some(given) if found.contains(given) => return Ok(vec![given.clone()]),
        Some(given) => {
            let known = |name: &str| match found.iter().find(|own| *own == name) {
                Some(own) => Ok(own.clone()),
                None => Err(FileError::no_column(path, name, found)),
            };
            return given.split('+').map(known).collect();
        }
    }
    let own = |name: &str| same_name(found, name).filter(|own| names.key_of(own).is_none());
    // The survey's flag is preferred to general names: DES Y1 has both `flags_select` and `flags`.
    let first = match survey.and_then(|survey| survey.of((Role::Flag, 0))) {
        Some("none") => None,
        Some(known) => own(known).or_else(|| names_of_role(Role::Flag).find_map(own)),
        None => names_of_role(Role::Flag).find_map(own),
    };
    let e1 = e1.unwrap_or_default();
    let e1 = base(&e1);
    let kind = Some(method_of(e1)).filter(|kind| !kind.is_empty());
    let of_kind = |ending: &str| own(&format!("{}_{ending}", kind?));
    let cuts = own("flags_select");
    let all = [
        first,
        own("flags").filter(|_| cuts.is_some()),
        cuts,
        of_kind("flags"),
        of_kind("flag"),
        own("ngmix_mcal_flags").filter(|_| e1.starts_with("ngmix")),
        own("ngmix_mom_fail").filter(|_| e1.starts_with("ngmix")),
    ];
    let mut flags: Vec<String> = Vec::new();
    for name in all.into_iter().flatten() {
        if !flags.contains(name) {
            flags.push(name.clone());
        }
    }
    Ok(flags)
}

// The name of a component of a vector, `g[0]` for `g_1`.
fn in_vector(name: &str) -> Option<String> {
    let first = name.strip_suffix("_1").map(|vector| format!("{vector}[0]"));
    first.or_else(|| name.strip_suffix("_2").map(|vector| format!("{vector}[1]")))
}

// Whether rows count that have 1 in a column of this name, rather than 0; `None` for a column that makes no choice.
pub fn counted_value(name: &str) -> Option<bool> {
    let known = recognition().cuts.get(&name.to_ascii_lowercase())?;
    Some(*known)
}

/// Whether the name of a column suggests that it is a weight of shapes.
pub fn looks_like_weight(name: &str) -> bool {
    let known = &recognition().patterns;
    // The dark energy w₀ of a mock catalogue.
    let is_w0 = name.eq_ignore_ascii_case("w_0");
    has_any(&known.weight, name) && !has_any(&known.no_weight, name) && !is_w0
}

// Errors of calibrations and of corrected shapes calibrate nothing.
fn is_like_a_calibration(name: &str) -> bool {
    has_any(&recognition().patterns.calibration, name)
        && !is_no_calibration(name)
        && !is_like_a_response(name)
        && !has_any(&recognition().patterns.error, name)
}

fn is_no_calibration(name: &str) -> bool {
    has_any(&recognition().patterns.no_calibration, name)
}

// Whether the words of a name are those of a quantity that m and c do not depend on.
fn is_harmless(name: &str) -> bool {
    let known = &recognition().patterns;
    is_no_calibration(name) || has_any(&known.harmless, name) && !has_any(&known.not_harmless, name)
}

fn is_like_a_response(name: &str) -> bool {
    let known = &recognition().patterns;
    known.response_in_capitals.iter().any(|own| own == name)
        || has_any(&known.response, name) && !has_any(&known.no_response, name)
}

fn is_secondary(name: &str) -> bool {
    has_any(&recognition().patterns.secondary, name)
}

fn is_like_a_flag(name: &str) -> bool {
    let known = &recognition().patterns;
    has_any(&known.flag, name) && !has_any(&known.no_flag, name)
}

// Whether the name of a column suggests that it states which rows are good.
fn is_like_a_choice(name: &str) -> bool {
    is_like_a_flag(name) || has_any(&recognition().patterns.choice, name)
}

// Whether the name of a column suggests a role that changes the result.
fn is_like_a_role(name: &str) -> bool {
    counted_value(name).is_some()
        || looks_like_weight(name)
        || is_like_a_calibration(name)
        || is_like_a_response(name)
        || is_like_a_choice(name)
        || has_any(&recognition().patterns.error, name)
        || sheared_name(name).is_some()
}

impl Columns {
    fn find_unused(&mut self, found: &[String], names: &Names) {
        let taken = |name: &String| {
            self.columns
                .values()
                .chain(&self.flags)
                .any(|own| own == name)
        };
        // Lines between the columns of a text are names without letters.
        let has_letters = |name: &String| name.contains(char::is_alphanumeric);
        let unused = found
            .iter()
            .filter(|name| has_letters(name) && !taken(name));
        let unused: Vec<&String> = unused.collect();
        let all = |wanted: &dyn Fn(&str) -> bool| -> Vec<String> {
            let unused = unused.iter().filter(|name| wanted(name));
            unused.map(|name| (*name).clone()).collect()
        };
        let choices = unused
            .iter()
            .filter_map(|name| counted_value(name).map(|_| (*name).clone()));
        let choices = choices.collect();
        if self.of(Role::ShearedCatalogue).is_none() && !names.is_given(Role::ShearedCatalogue) {
            self.steps = all(&|name| fits_any(&recognition().patterns.step, name));
        }
        if self.of(Role::Weight).is_none() && !names.is_given(Role::Weight) {
            self.doubtful_weights = all(&looks_like_weight);
            self.doubtful_weights.sort_by_key(|name| is_secondary(name));
        }
        let of_lensfit = found
            .iter()
            .any(|own| has_any(&recognition().patterns.lensfit, own));
        self.unused = all(&|name| is_like_a_role(name) && !(of_lensfit && name == "R"));
        let is_like_no_role = |name: &str| !self.unused.iter().any(|own| own == name);
        self.unknown = all(&|name| is_like_no_role(name) && !is_harmless(name));
        self.step_size = all(&|name| has_any(&recognition().patterns.step_size, name)).pop();
        self.choices = choices;
    }

    /// Columns that look like one of a role but have none, and columns of which nothing is known, unless they are `read` for
    /// another reason.
    pub fn unused(&self, read: &[String]) -> Vec<String> {
        let unread = |all: &[String]| -> Vec<String> {
            let unread = all.iter().filter(|name| !read.contains(name));
            unread.cloned().collect()
        };
        let (unused, mut unknown) = (unread(&self.unused), unread(&self.unknown));
        let mut lines = Vec::new();
        for [e1, e2] in self.others.iter().filter(|[e1, _]| !read.contains(e1)) {
            unknown.retain(|name| name != e1 && name != e2);
            lines.push(format!(
                "Not used: {e1}, {e2} of another method. Try: --columns e1={e1},e2={e2} for them with their own response."
            ));
        }
        if !unused.is_empty() {
            let calibration = self.before_calibration(&unused).unwrap_or_default();
            lines.push(format!(
                "Not used: {}. Try: {}.{calibration}",
                counted_names(&unused),
                self.suggested(&unused)
            ));
        }
        if !unknown.is_empty() {
            lines.push(format!(
                "Not used, and not known: {}.",
                counted_names(&unknown)
            ));
        }
        lines
    }

    /// Why nothing divides ellipticities without a response that need one, by the names of e1 and of columns without a role.
    pub fn undivided(&self, may_have_response: bool) -> Option<String> {
        let e1 = self.of(Role::E1).unwrap_or_default();
        let mut known = recognition().ellipticity.undivided.iter();
        if known.any(|own| own.eq_ignore_ascii_case(e1)) {
            return Some(format!(
                "nothing divides the ellipticities by their response: `{e1}` is one of metacalibration, metadetection or AnaCal (expected sheared catalogues, or R11 and R22). Try: the tables or rows of noshear, 1p, 1m, 2p and 2m, --columns R11=NAME,R22=NAME, or --ellipticity shear if it is calibrated"
            ));
        }
        let in_capitals = &recognition().patterns.response_in_capitals;
        let mut unused = self.unused.iter();
        let response = unused.find(|name| {
            let is_clear = !in_capitals.contains(name) && !is_secondary(name);
            let is_of_method = method_of(name).eq_ignore_ascii_case(method_of(e1));
            is_clear && is_of_method && is_like_a_response(name) && sheared_name(name).is_none()
        });
        let response = response.filter(|_| may_have_response && self.survey.is_none())?;
        Some(format!(
            "nothing divides the ellipticities by a response, and `{response}` looks like one. Try: {}, or --columns R11=none,R22=none if they are calibrated",
            self.suggested(std::slice::from_ref(response))
        ))
    }

    /// Columns without a role that look like a weight or state which rows count, unless they are `read`.
    pub fn unused_choices(&self, read: &[&str]) -> Vec<&str> {
        let unused = self.unused.iter().map(String::as_str);
        let chooses = |name: &str| {
            looks_like_weight(name) || is_like_a_choice(name) || counted_value(name).is_some()
        };
        let mut chosen: Vec<&str> = unused.filter(|name| chooses(name)).collect();
        chosen.retain(|name| !read.contains(name));
        chosen
    }

    /// All names that `unused` may list.
    pub fn without_role(&self) -> impl Iterator<Item = &String> {
        self.unused.iter().chain(&self.unknown)
    }

    /// What excludes rows by a column that looks like a flag or a choice and is not used.
    pub fn remedy_of_choice(&self) -> Option<String> {
        let first = |like: fn(&str) -> bool| {
            let mut all = self.unused.iter();
            all.find(|name| like(name) && sheared_name(name).is_none())
        };
        match first(is_like_a_flag) {
            Some(name) => Some(self.of_good_rows(name).unwrap_or_else(|| {
                let flags = self.with_flags(name);
                format!("--columns flag={flags} if it is 0 in good rows")
            })),
            None => first(is_like_a_choice).map(|name| {
                let by_text = self.of_good_rows(name);
                by_text.unwrap_or_else(|| format!("--where {name} if it is true in good rows"))
            }),
        }
    }

    // What m and c are without the columns of a calibration, and how these are applied: surveys divide by the weighted mean of 1 + m
    // and subtract c (Fenech Conti et al. 2017, MNRAS 467, 1627, equation 15).
    fn before_calibration(&self, unused: &[String]) -> Option<String> {
        let is_calibration =
            |name: &&String| is_like_a_calibration(name) && !looks_like_weight(name);
        let name = unused.iter().find(is_calibration)?;
        let own = |patterns: &[&str]| {
            let is_own = |name: &&String| patterns.iter().any(|own| words(name).ends_with(own));
            unused.iter().find(is_own)
        };
        let mut columns = Vec::new();
        let without_response = self.of(Role::R11).is_none();
        let is_shear = without_response && !self.distortion;
        let m = own(&["_m_", "_m1_", "_m_1_", "plusm_"]).filter(|_| without_response);
        if let Some(m) = m {
            let other = other_component(unused, m).unwrap_or(m);
            // The factor 1 + m itself, such as `one_plus_m`.
            let is_factor = words(m).replace('_', "").contains("plusm");
            columns.push(match (is_shear, is_factor) {
                (true, true) => format!("R11={m},R22={other}"),
                (true, false) => format!("R11=1+{m},R22=1+{other}"),
                (false, true) => format!("m={m}-1"),
                (false, false) => format!("m={m}"),
            });
        }
        let c1 = own(&["_c1_", "_c_1_"]);
        // CFHTLenS has c2 alone.
        let c2 = match c1 {
            Some(c1) => other_component(unused, c1),
            None => own(&["_c2_", "_c_2_"]),
        };
        let all = [("e1", "c1", Role::E1, c1), ("e2", "c2", Role::E2, c2)];
        for (component, role, of, c) in all {
            let Some(c) = c.filter(|_| without_response && c2.is_some()) else {
                continue;
            };
            columns.push(match is_shear {
                true => format!("{component}={}-{c}", self.of(of).unwrap_or_default()),
                false => format!("{role}={c}"),
            });
        }
        let remedy = match columns.is_empty() {
            true => String::new(),
            false => format!(
                " Try: --columns '{}' for those after it.",
                columns.join(",")
            ),
        };
        Some(format!(
            " m and c are those before a calibration by `{name}`.{remedy}"
        ))
    }

    // The flags that are used and another one, which would replace them: of DES Y6, 2 % of the rows came back.
    fn with_flags(&self, name: &str) -> String {
        let flags = self.flags.iter().map(String::as_str);
        flags.chain([name]).collect::<Vec<_>>().join("+")
    }

    // What chooses the good rows by the texts of a column.
    fn of_good_rows(&self, name: &str) -> Option<String> {
        // Rows of MASK 0 and 1 serve most purposes, and fitclass 0 is a galaxy (README of the catalogues; Erben et al. 2013, MNRAS
        // 433, 2545).
        let is_of_cfhtlens = || self.unused.iter().any(|own| own == "fitclass");
        if name == "MASK" && is_of_cfhtlens() {
            return Some("--where 'MASK <= 1 and fitclass == 0', which CFHTLenS uses".into());
        }
        let text = self.texts.get(name)?;
        Some(format!(
            "--where \"{name} == 'TEXT'\" with the text of good rows (the first row has '{text}')"
        ))
    }

    // What uses columns by their names, an option of each kind.
    fn suggested(&self, unused: &[String]) -> String {
        let first = |like: &dyn Fn(&str) -> bool| {
            let mut all = unused.iter();
            all.find(|name| like(name) && !is_secondary(name))
        };
        let needed = match unused.len() {
            1 => "if the result needs it",
            _ => "if the result needs them",
        };
        let is_mask = |name: &str| name == "MASK" && self.of_good_rows(name).is_some();
        if let Some(remedy) = first(&is_mask).and_then(|name| self.of_good_rows(name)) {
            return remedy;
        }
        let mut roles = Vec::new();
        if let Some(name) = first(&looks_like_weight) {
            roles.push(format!("w={name}"));
        }
        let is_first = |name: &str| {
            is_like_a_response(name)
                && sheared_name(name).is_none()
                && !name.contains('[')
                && (!name.contains('2') || name.contains('1'))
        };
        if let Some(name) = first(&is_first) {
            let other = other_component(unused, name).unwrap_or(name);
            roles.push(format!("R11={name},R22={other}"));
        }
        if let Some(name) = first(&|name| is_like_a_flag(name) && self.of_good_rows(name).is_none())
        {
            roles.push(format!("flag={}", self.with_flags(name)));
        }
        let choice = first(&is_like_a_choice);
        let by_text = choice.and_then(|name| self.of_good_rows(name));
        match (choice, roles.is_empty()) {
            (Some(name), true) => by_text.unwrap_or_else(|| {
                format!(
                    "--where {name} if it is true in good rows, --columns flag={name} if it is 0"
                )
            }),
            (None, true) => format!("--columns ROLE=NAME {needed}"),
            _ => format!("--columns {} {needed}", roles.join(",")),
        }
    }
}

// Two columns that may be e1 and e2: a pair of components with a name of shapes.
fn likely_ellipticities(found: &[String]) -> String {
    let known = &recognition().patterns;
    let pair = |name: &&String| {
        let other = has_any(&known.truth, name) || words(name).contains("psf");
        !other && has_any(&known.shape, name) && other_component(found, name).is_some()
    };
    let mut pairs = found.iter().filter(pair);
    // Ellipticities with a calibration, such as `AlphaRecalD2_e1`, if there are no others.
    let is_e1 = |name: &&String| {
        let words = words(name);
        (words.contains("_e1_") || words.contains("_e_1_")) && is_like_a_calibration(name)
    };
    let first = pairs.clone().find(|name| !is_like_a_role(name));
    // What a shell would take apart is quoted: pandas has names such as `('ref', 'i', 'e1')`.
    let is_plain = |name: &str| !name.contains([' ', '(', '\'', '*']);
    let pair = first.or_else(|| pairs.find(is_e1));
    match pair.and_then(|name| Some((name, other_component(found, name)?))) {
        Some((e1, e2)) if !is_plain(e1) => format!("\"e1={e1},e2={e2}\""),
        Some((e1, e2)) => format!("e1={e1},e2={e2}"),
        None => "e1=NAME,e2=NAME".to_owned(),
    }
}

// Names as a message lists them, with the number of those that it leaves out.
fn counted_names(names: &[String]) -> String {
    const SHOWN: usize = 40;
    let more = match names.len().saturating_sub(SHOWN) {
        0 => String::new(),
        more => format!(", and {more} more"),
    };
    names[..names.len().min(SHOWN)].join(", ") + &more
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recognition::fits_any;

    fn found(columns: &str, given: &[&str]) -> Result<Columns, String> {
        let columns: Vec<String> = columns.split(' ').map(str::to_owned).collect();
        let mut names = Names::default();
        for text in given {
            names.add(text).map_err(|error| error.to_string())?;
        }
        let is_own = columns.iter().any(|name| name == "first_energy");
        let found = Columns::find(Path::new("c.fits"), &columns, &names, is_own);
        found.map_err(|error| error.to_string())
    }

    #[test]
    fn roles_may_have_the_names_of_their_columns() {
        let found = found(
            "a b c d e",
            &["e1=a", "e2=b", "dw_dg1=c", "dw_dg2=d", "weight=e"],
        );
        let found = found.unwrap();
        assert_eq!(found.of(Role::Dw1), Some("c"));
        assert_eq!(found.of(Role::Weight), Some("e"));
    }

    #[test]
    fn programs_are_recognised_by_their_columns() {
        let weighted = found("e1 e2 w R11 R22", &["w=w"]).unwrap();
        assert_eq!(weighted.of(Role::R11), Some("R11"));
        let hsc = "i_hsmshaperegauss_e1 i_hsmshaperegauss_e2 i_hsmshaperegauss_flag w";
        let rms = "i_hsmshaperegauss_derived_rms_e";
        let renamed = found(&format!("{hsc} {rms}"), &["w=w"]).unwrap();
        assert_eq!(
            (renamed.program(), renamed.of(Role::RmsE)),
            ("HSC Y3", Some(rms))
        );
        assert_eq!(found(hsc, &["w=w"]).unwrap().program(), "LSST");
        // A formula of the survey's own column, which is a name, too.
        let turned = found(
            &format!("{hsc} {rms} -i_hsmshaperegauss_e1"),
            &["e1=-i_hsmshaperegauss_e1", "w=w"],
        );
        let turned = turned.unwrap();
        assert_eq!((turned.program(), turned.distortion), ("HSC Y3", true));
        assert_eq!(turned.of(Role::E2), Some("i_hsmshaperegauss_e2"));
        assert_eq!(turned.flags, ["i_hsmshaperegauss_flag"]);
        assert!(
            found("regauss_e1 regauss_e2 -regauss_e1", &["e1=-regauss_e1"])
                .unwrap()
                .distortion
        );
        let unflagged = hsc.replace("i_hsmshaperegauss_flag ", "");
        let renamed = found(&format!("{unflagged} {rms}"), &["w=w"]).unwrap();
        assert_eq!(renamed.program(), "HSC Y3");
        for (columns, preset) in [
            ("e1 e2 w flag", Preset::Plain),
            ("x y e1 e2 flags R11 R22 first_energy", Preset::Shearq),
            (
                "e1 e2 flags R11 R22 first_energy e1_noshear e2_noshear e1_1p e1_1m e2_2p e2_2m",
                Preset::Shearq,
            ),
            ("corrected_e1 corrected_e2", Preset::Hsm),
            (
                "e1_noshear e2_noshear e1_1p e1_1m e2_2p e2_2m",
                Preset::Metacal,
            ),
            ("wmom_g_1 wmom_g_2 w mdet_step", Preset::Metadetect),
            ("e1 de1_dg1 e2 de2_dg2 w dw_dg1 dw_dg2", Preset::Anacal),
        ] {
            assert_eq!(found(columns, &[]).unwrap().preset, preset, "{columns}");
        }
        assert!(found("corrected_e1 corrected_e2", &[]).unwrap().distortion);
        let names =
            "e1 e2 flags R11 R22 first_energy e1_noshear e2_noshear e1_1p e1_1m e2_2p e2_2m";
        for (required, preset, e1, plus) in [
            (true, Preset::Sheared, "e1_noshear", Some("e1_1p")),
            (false, Preset::Shearq, "e1", None),
        ] {
            let mut own = found(names, &[]).unwrap();
            let all: Vec<String> = names.split(' ').map(str::to_owned).collect();
            own.choose_sheared(&all, required);
            assert_eq!((own.preset, own.of(Role::E1)), (preset, Some(e1)));
            assert_eq!(own.of_sheared((Role::E1, 1)), plus);
        }
        let given = found("a b R11 R22", &["e1=a", "e2=b", "R11=none", "R22=none"]).unwrap();
        assert_eq!((given.of(Role::E1), given.of(Role::R11)), (Some("a"), None));
    }

    #[test]
    fn sheared_columns_of_another_method_are_refused() {
        let metacal = "g1_noshear g2_noshear g1_1p g1_1m g2_2p g2_2m";
        assert_eq!(found(metacal, &[]).unwrap().preset, Preset::Metacal);
        let both = format!("e1 e2 {metacal}");
        let error = found(&both, &[]).unwrap_err();
        assert!(error.contains("e1=g1_noshear,e2=g2_noshear"), "{error}");
        let names = ["e1=g1_noshear", "e2=g2_noshear"];
        let chosen = found(&both, &names).unwrap();
        assert_eq!(chosen.of_sheared((Role::E1, 1)), Some("g1_1p"));
        let none = ["e1_1p=none", "e1_1m=none", "e2_2p=none", "e2_2m=none"];
        let plain = found(&both, &none).unwrap();
        assert_eq!(
            (plain.preset, plain.of(Role::E1)),
            (Preset::Plain, Some("e1"))
        );
    }

    #[test]
    fn names_in_the_same_letters_are_preferred() {
        let own = found("E1 E2 e1 e2 FLAG flag", &[]).unwrap();
        assert_eq!(
            (own.of(Role::E1), own.of(Role::E2)),
            (Some("e1"), Some("e2"))
        );
        assert_eq!(own.flags, ["flag"]);
        // A vector `e` beside responses is like a table of DES Y3, with a weight and a flag of other names.
        let vector = found("e[0] e[1] w flag R11 R22", &[]).unwrap();
        assert_eq!(vector.program(), "DES Y3");
        assert_eq!(
            (vector.of(Role::Weight), vector.of(Role::Flag)),
            (Some("w"), Some("flag"))
        );
    }

    #[test]
    fn unsheared_columns_are_found_in_any_spelling() {
        let split = "NGMIX_ELL_1P_0 NGMIX_ELL_1M_0 NGMIX_ELL_2P_1 NGMIX_ELL_2M_1 NGMIX_MOM_FAIL NGMIX_ELL_NOSHEAR_0 NGMIX_ELL_NOSHEAR_1";
        let own = found(split, &[]).unwrap();
        assert_eq!(own.preset, Preset::Metacal);
        assert_eq!(own.of_sheared((Role::E2, 3)), Some("NGMIX_ELL_2P_1"));
        assert_eq!(
            (own.of(Role::E1), own.flags.clone()),
            (
                Some("NGMIX_ELL_NOSHEAR_0"),
                vec!["NGMIX_MOM_FAIL".to_owned()]
            )
        );
        for (columns, e1, response) in [
            ("00/g1 00/g2", "00/g1", None),
            ("g_noshear_1 g_noshear_2", "g_noshear_1", None),
            (
                "unsheared/e_1 unsheared/e_2 unsheared/R11 unsheared/R22",
                "unsheared/e_1",
                Some("unsheared/R11"),
            ),
            (
                "mcal_g_noshear[0] mcal_g_noshear[1]",
                "mcal_g_noshear[0]",
                None,
            ),
        ] {
            let own = found(columns, &[]).unwrap();
            assert_eq!((own.of(Role::E1), own.of(Role::R11)), (Some(e1), response));
            assert_ne!(own.of(Role::E2), Some(e1));
        }
        // The own component alone, in another spelling.
        let own = found("e1 e2 1p_e1 1m_e1 2p_e2 2m_e2", &[]).unwrap();
        assert_eq!(own.preset, Preset::Metacal);
    }

    #[test]
    fn roles_of_one_method_belong_together() {
        for (columns, given, e1, response, others) in [
            (
                "fpfs1_e1 fpfs1_e2 fpfs1_de1_dg1 fpfs1_de2_dg2 fpfs_de1_dg1 fpfs_de2_dg2",
                "",
                "fpfs1_e1",
                Some("fpfs1_de1_dg1"),
                "",
            ),
            (
                "e1 e2 mcal_g_1 mcal_g_2 mcal_R11 mcal_R22",
                "",
                "mcal_g_1",
                Some("mcal_R11"),
                "Not used: e1, e2 of another method. Try: --columns e1=e1,e2=e2",
            ),
            (
                "e1 e2 mcal_g_1 mcal_g_2 mcal_R11 mcal_R22",
                "e1=e1,e2=e2",
                "e1",
                None,
                "",
            ),
            (
                "e1 e2 mcal_g_1 mcal_g_2 mcal_R11 mcal_R22",
                "R11=none,R22=none",
                "e1",
                None,
                "Not used: mcal_g_1, mcal_g_2 of another method.",
            ),
            (
                "e1 e2 fpfs_e1 fpfs_e2 fpfs_de1_dg1 fpfs_de2_dg2",
                "",
                "fpfs_e1",
                Some("fpfs_de1_dg1"),
                "Not used: e1, e2 of another method.",
            ),
            (
                "mcal_g_1 mcal_g_2 R11 R22 mcal_R11 mcal_R22",
                "",
                "mcal_g_1",
                Some("mcal_R11"),
                "",
            ),
            (
                "e1 e2 mcal_g_1 mcal_g_2 R11 R22",
                "e1=-mcal_g_1,e2=mcal_g_2",
                "-mcal_g_1",
                None,
                "",
            ),
            ("e1 e2 r11 r22 R11 R22", "", "e1", Some("R11"), ""),
            (
                "regauss_e1 regauss_e2 R11 R22",
                "",
                "regauss_e1",
                Some("R11"),
                "",
            ),
            (
                "fpfs1_e1 fpfs1_e2 fpfs_de1_dg1 fpfs_de2_dg2",
                "",
                "fpfs1_e1",
                None,
                "",
            ),
            (
                "mdet_step e1 e2 wmom_g_1 wmom_g_2",
                "",
                "wmom_g_1",
                None,
                "Not used: e1, e2 of another method.",
            ),
            ("e1 mcal_g_1 mcal_g_2", "", "mcal_g_1", None, ""),
            (
                "e1 e2 mcal_g_1 mcal_g_2",
                "e1=mcal_g_1",
                "mcal_g_1",
                None,
                "",
            ),
        ] {
            let given: Vec<&str> = given.split(',').filter(|own| !own.is_empty()).collect();
            let formula = given.iter().find_map(|own| own.strip_prefix("e1=-"));
            let formula = formula.map_or(String::new(), |own| format!(" -{own}"));
            let own = found(&format!("{columns}{formula}"), &given).unwrap();
            assert_eq!((own.of(Role::E1), own.of(Role::R11)), (Some(e1), response));
            assert_eq!(
                method_of(own.of(Role::E2).unwrap()),
                method_of(e1.trim_start_matches('-'))
            );
            let unused = own.unused(&[]).join(" ");
            assert!(unused.contains(others), "{columns}: {unused}");
            assert_eq!(unused.contains("another method"), !others.is_empty());
        }
    }

    #[test]
    fn weights_and_responses_belong_to_their_method() {
        // Derivatives of a weight that is there are not those of another one.
        for (columns, weight, derivative) in [
            ("weight wdet dwdet_dg1 dwdet_dg2", "weight", None),
            ("weight dw_dg1 dw_dg2", "weight", Some("dw_dg1")),
            (
                "wdet wsel dwsel_dg1 dwsel_dg2 dwdet_dg1 dwdet_dg2",
                "wdet",
                Some("dwdet_dg1"),
            ),
            (
                "fpfs_w fpfs_dw_dg1 fpfs_dw_dg2",
                "fpfs_w",
                Some("fpfs_dw_dg1"),
            ),
        ] {
            let own = found(&format!("e1 e2 {columns}"), &[]).unwrap();
            let roles = (own.of(Role::Weight), own.of(Role::Dw1));
            assert_eq!(roles, (Some(weight), derivative));
        }
        let own = found("wmom_g_1 wmom_g_2 wmom_R11 wmom_R22", &[]).unwrap();
        assert_eq!(
            (own.of(Role::E1), own.of(Role::R11)),
            (Some("wmom_g_1"), Some("wmom_R11"))
        );
        for (columns, response) in [
            (
                "e1 e2 R[0] R[1] R[2] R[3]",
                ["R[0]", "R[1]", "R[2]", "R[3]"].map(Some),
            ),
            ("e1 e2 r[0] r[1] r[2] r[3]", [None; 4]),
            ("e1 e2 R[0] R[1] R[2] R[3] R[4]", [None; 4]),
            ("e1 e2 R[0] R[1]", [None; 4]),
            (
                "mcal_e1 mcal_e2 e1 e2 mcal_R[0] mcal_R[1] mcal_R[2] mcal_R[3]",
                ["mcal_R[0]", "mcal_R[1]", "mcal_R[2]", "mcal_R[3]"].map(Some),
            ),
        ] {
            let own = found(columns, &[]).unwrap();
            let roles = [Role::R11, Role::R12, Role::R21, Role::R22];
            assert_eq!(roles.map(|role| own.of(role)), response, "{columns}");
        }
        let metacal = "e1 e2 mcal_e1 mcal_e2 mcal_e1_1p mcal_e1_1m mcal_e2_2p mcal_e2_2m";
        assert_eq!(found(metacal, &[]).unwrap().of(Role::E1), Some("mcal_e1"));
        // A vector of radii is no response of e1.
        let radii = "e1 e2 mcal_g_1 mcal_g_2 mcal_R11 mcal_R22 r[0] r[1] r[2]";
        assert_eq!(found(radii, &[]).unwrap().of(Role::E1), Some("mcal_g_1"));
        let mixed = "mcal_g_1 mcal_g_2 mcal_R11 R11 R22";
        assert!(found(mixed, &[]).unwrap_err().contains("none for R22"));
        let own = found("fpfs_e1 fpfs_e2 w fpfs_w", &[]).unwrap();
        assert_eq!(own.of(Role::Weight), Some("fpfs_w"));
        let own = found("e1 e2 fpfs_e1 fpfs_e2 fpfs_w", &[]).unwrap();
        assert_eq!(own.of(Role::Weight), None);
        // The advised response is that of the method.
        let own = found(
            "e1 e2 fpfs1_e1 fpfs1_e2 fpfs1_de1_dg1 fpfs1_de2_dg2",
            &["e1=e1", "e2=e2"],
        );
        let unused = own.unwrap().unused(&[]).join(" ");
        assert!(
            unused.contains("R11=fpfs1_de1_dg1,R22=fpfs1_de2_dg2"),
            "{unused}"
        );
    }

    #[test]
    fn a_column_has_one_role() {
        let own = found("g1 g2", &["e1=g1", "e2=g2"]).unwrap();
        assert_eq!((own.of(Role::E1), own.of(Role::G1)), (Some("g1"), None));
        let own = found(
            "g1 g2 g1_true g2_true",
            &["e1=g1", "e2=g2", "g1=g1_true", "g2=g2_true"],
        );
        assert_eq!(own.unwrap().of(Role::G1), Some("g1_true"));
        // A column that says that it is true is preferred to one that may be of the PSF.
        for truth in ["g1_true g2_true", "true_g1 true_g2", "g1_in g2_in"] {
            let own = found(&format!("e1 e2 g1 g2 {truth}"), &[]).unwrap();
            assert_eq!(own.of(Role::G1), truth.split(' ').next());
            assert_eq!(own.unused(&[]), ["Not used, and not known: g1, g2."]);
        }
        let own = found("wmom_g[0] wmom_g[1] mdet_step", &[]).unwrap();
        assert_eq!(own.of(Role::E2), Some("wmom_g[1]"));
        let own = found("e1 e2 R", &["R11=R", "R22=R"]).unwrap();
        assert_eq!(
            (own.of(Role::R11), own.of(Role::R22)),
            (Some("R"), Some("R"))
        );
    }

    #[test]
    fn columns_that_are_absent_are_named() {
        for (columns, given, expected) in [
            ("a b", vec![], "expected e1 and e2). Try: --columns e1=NAME"),
            (
                "ra w chi_1 chi_2",
                vec![],
                "Try: --columns e1=chi_1,e2=chi_2",
            ),
            (
                "psf_e1_LF_r psf_e2_LF_r g1_in g2_in AlphaRecalD2_e1 AlphaRecalD2_e2 shear_bias_c1 shear_bias_c2",
                vec![],
                "Try: --columns e1=AlphaRecalD2_e1,e2=AlphaRecalD2_e2",
            ),
            ("e1 e2 R11", vec![], "none for R22"),
            ("e1 e2", vec!["w=weight"], "there is no column `weight`"),
            (
                "e1 e2 a b",
                vec!["dw1=a", "dw2=b"],
                "there is no column of weights",
            ),
            ("e1 e2", vec!["q=weight"], "unknown role (found `q`"),
            ("e1 e2", vec!["w"], "expected ROLE=COLUMN"),
            (
                "g1 g2",
                vec!["e1=g1", "e2=g2", "g1=g1", "g2=g2"],
                "column `g1` is given as e1 and as g1",
            ),
        ] {
            let error = found(columns, &given).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn each_survey_is_that_of_its_own_columns() {
        let surveys = &recognition().surveys;
        for survey in surveys {
            let columns = survey.columns.values().filter(|own| *own != "none");
            let columns: Vec<String> = columns.chain(&survey.required).cloned().collect();
            let mut all = surveys.iter();
            let first = all.find(|own| own.absent_column(&columns, &Names::default()).is_none());
            assert_eq!(first, Some(survey), "{columns:?}");
        }
    }

    // Column lists of public catalogues as their documentation has them, a name per line, with the columns that must be used.
    #[test]
    fn public_catalogues_are_read_by_their_published_columns() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/columns");
        let mut count = 0;
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            let expected = text.lines().find_map(|line| line.strip_prefix("# used: "));
            let given = text.lines().find_map(|line| line.strip_prefix("# given: "));
            let names: Vec<&str> = text
                .lines()
                .filter(|line| !line.starts_with('#'))
                .flat_map(str::split_whitespace)
                .collect();
            let given: Vec<&str> = given.into_iter().flat_map(|text| text.split(' ')).collect();
            let columns = found(&names.join(" "), &given).unwrap();
            let used = columns.used(|_| true);
            let found = format!("Columns ({}): {used}.", columns.program());
            assert_eq!(found, expected.unwrap(), "{}", path.display());
            count += 1;
        }
        // The catalogues of the documentation.
        assert!(count >= 17, "{count}");
    }

    #[test]
    fn columns_that_look_like_a_role_are_named() {
        let columns = found("e1 e2 my_weight BadFlag T_1p T R12 mag", &["R11=none"]).unwrap();
        let unused = columns.unused(&[]).join(" ");
        assert!(unused.contains("my_weight, BadFlag, T_1p, R12"), "{unused}");
        let read = ["T_1p".to_owned()];
        assert!(!columns.unused(&read).join(" ").contains("T_1p"));
        assert_eq!(columns.doubtful_weights, ["my_weight"]);
        let several = found("e1 e2 wht ivar", &[]).unwrap();
        assert_eq!(several.doubtful_weights, ["wht", "ivar"]);
        let declined = found("e1 e2 my_weight", &["w=none"]).unwrap();
        assert!(declined.doubtful_weights.is_empty());
        let others = "e1 e2 w i_blendedness mag T r z correspond_id ra flux1 size sersic_r1 snr chi2 psf_flux tile x";
        assert_eq!(found(others, &[]).unwrap().unused(&[]), [""; 0]);
        let clean = found("e1 e2 w m_g m_r |", &[]).unwrap();
        assert_eq!(clean.unused(&[]), [""; 0]);
        let weights = "flux_weight shape_psf_weight w_mag wflux R_psf";
        let named = found(&format!("e1 e2 w {weights}"), &[]).unwrap();
        let listed = weights.replace(' ', ", ");
        assert_eq!(
            named.unused(&[]),
            [format!("Not used, and not known: {listed}.")]
        );
        let components = found("e1 e2 w_g1 w_g2", &[]).unwrap();
        assert_eq!(components.of(Role::Dw1), None);
        assert_eq!(components.doubtful_weights, ["w_g1", "w_g2"]);
        let unknown = found("e1 e2 w mag peso", &[]).unwrap().unused(&[]);
        assert_eq!(unknown, ["Not used, and not known: peso."]);
        for name in (recognised_in_part()).split_whitespace() {
            let columns = found(&format!("e1 e2 w {name}"), &[]).unwrap();
            let unused = columns.unused(&[]).join(" ");
            assert!(
                unused.contains(&format!("Not used: {name}. Try: ")),
                "{name}: {unused}"
            );
        }
        for (names, expected) in [
            ("R_gamma1 R_gamma2", "R11=R_gamma1,R22=R_gamma2 if"),
            ("sensitivity", "R11=sensitivity,R22=sensitivity if"),
            ("lensWeight my_flag", "w=lensWeight,flag=my_flag if"),
            ("quality", "Try: --where quality if it is true in good rows"),
            ("Rs11 Rs22", "Try: --columns ROLE=NAME if"),
            (
                "oldweight_LF_r AlphaRecalC_weight",
                "w=AlphaRecalC_weight if",
            ),
            ("m_corr", "Try: --columns ROLE=NAME if"),
            (
                "Flag_SOM_Fid_NONE R SNR_LF_r",
                "Not used: Flag_SOM_Fid_NONE. Try: --where Flag_SOM_Fid_NONE if it is true",
            ),
            (
                "mask_flags mdet_flags pgauss_g_flux",
                "Not used: mask_flags. Try: --columns flag=mdet_flags+mask_flags if",
            ),
            ("fitclass MASK star_flag", "--where 'MASK <= 1"),
            ("w m c2", "'R11=1+m,R22=1+m,e2=e2-c2' for those after it"),
            ("w one_plus_m", "'R11=one_plus_m,R22=one_plus_m' for"),
            ("w onePlusM", "'R11=onePlusM,R22=onePlusM' for"),
            (
                "w one_plus_m1 one_plus_m2",
                "'R11=one_plus_m1,R22=one_plus_m2' for",
            ),
        ] {
            let unused = found(&format!("e1 e2 {names}"), &[]).unwrap().unused(&[]);
            assert!(unused[0].contains(expected), "{unused:?}");
        }
        let factor = found("regauss_e1 regauss_e2 w oneplusm", &[]).unwrap();
        let unused = factor.unused(&[]).join(" ");
        assert!(unused.contains("'m=oneplusm-1' for"), "{unused}");
        for error in [
            "corrected_shape_err",
            "m_err",
            "shear_bias_c1_err",
            "correction_status",
        ] {
            let unused = found(&format!("e1 e2 w {error}"), &[]).unwrap().unused(&[]);
            assert!(unused[0].starts_with(&format!("Not used: {error}.")));
            assert!(!unused[0].contains("calibration"), "{unused:?}");
        }
        let flagged = found("e1 e2 w BadFlag", &[]).unwrap().remedy_of_choice();
        assert_eq!(
            flagged.unwrap(),
            "--columns flag=BadFlag if it is 0 in good rows"
        );
    }

    #[test]
    fn steps_and_units_are_found_by_their_names() {
        let step = found("e1 e2 mcal_step_size", &[]).unwrap().step_size;
        assert_eq!(step.as_deref(), Some("mcal_step_size"));
        let patterns = &recognition().patterns;
        for name in
            "tile_label hpix healpix_256 pointing_id image_id subfield visit_id jk BRICK".split(' ')
        {
            assert!(fits_any(&patterns.unit, name), "{name}");
        }
        for name in ["TOMOBIN", "TOM_BIN_ID"] {
            assert!(fits_any(&patterns.fixed, name), "{name}");
        }
    }

    // Names that state a role in part.
    fn recognised_in_part() -> &'static str {
        "Resp11 resp1 R1 Rg1 e1_resp de1dg1 R vis_det FIT_CLASS good is_star shape_select m m1 c1 m11 e1_corrected w_1p BadFlag \
            b_mode_mask R_gamma sensitivity Psh11 P_gamma metacal_R R11_all Rs metacal_m1 mcorr one_plus_m quality class star reject \
            valid detected e_err SHEAR_POLARISABILITY_1 nbc_m multiplicative e1_err sigma_e1 outlier CLASS_STAR"
    }

    #[test]
    fn a_weight_alone_is_no_survey() {
        for weight in ["w_des", "w_iv"] {
            let own = found(&format!("e1 e2 {weight} R11 R22"), &[]).unwrap();
            assert_eq!(
                (own.program(), own.of(Role::R11)),
                ("plain columns", Some("R11"))
            );
            assert_eq!(own.doubtful_weights, [weight]);
        }
    }

    #[test]
    fn surveys_of_the_user_come_first() {
        let text = "[[survey]]\nname = \"Own\"\n[survey.columns]\ne1 = \"e1\"\ne2 = \"e2\"\nw = \"wl\"\nR11 = \"none\"\n";
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("own.toml");
        std::fs::write(&path, text).unwrap();
        let mut names = Names::default();
        names.add_presets(crate::recognition::read_presets(&path).unwrap());
        let columns = ["e1", "e2", "w", "wl", "R22"].map(str::to_owned);
        let found = Columns::find(Path::new("c"), &columns, &names, false);
        // R22 has no partner, because the survey has no R11.
        assert!(found.unwrap_err().to_string().contains("none for R11"));
        let found = Columns::find(Path::new("c"), &columns[..4], &names, false).unwrap();
        assert_eq!(
            (found.program(), found.of(Role::Weight)),
            ("Own", Some("wl"))
        );
    }

    #[test]
    fn columns_of_the_users_surveys_are_formulas_or_refused() {
        let text = "[[survey]]\nname = \"Own\"\n[survey.columns]\ne1 = \"a/p\"\ne2 = \"b\"\nw = \"wl\"\nflag = \"u+v\"\n";
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("own.toml");
        std::fs::write(&path, text).unwrap();
        let mut names = Names::default();
        names.add_presets(crate::recognition::read_presets(&path).unwrap());
        let stated = |columns: &str| {
            let columns: Vec<String> = columns.split(' ').map(str::to_owned).collect();
            let own = names.of_table(Path::new("c"), &columns);
            own.map_err(|error| error.to_string()).map(|own| {
                let own = own.columns().map(|(_, column)| column.to_owned());
                own.collect::<Vec<_>>()
            })
        };
        assert_eq!(stated("a b p WL u v").unwrap(), ["a/p", "b", "WL", "u+v"]);
        let absent = stated("a b p u v").unwrap_err();
        assert!(
            absent.contains("there is no column `wl`, which "),
            "{absent}"
        );
        assert!(absent.contains("own.toml states as w of `Own`"), "{absent}");
        assert!(stated("a b p wl u").unwrap_err().contains("`u+v`"));
        // Without e1 or e2, the table is of no survey of the file.
        assert!(stated("e1 e2 wl").unwrap().is_empty());
        let columns = ["e1", "e2", "wl"].map(str::to_owned);
        let found = Columns::find(Path::new("c"), &columns, &names, false).unwrap();
        assert!(found.unfit_presets[0].ends_with("because there is no column `a/p`."));
    }

    #[test]
    fn weights_of_shapes_are_recognised_by_their_names() {
        let weights = "weight_lensfit ivar inverse_variance AUTO_WHT weightsum wht_sum weight_map WEIGHT_IMAGE my_weight wht \
            w_iv w_des wt_a recal_weight_A SHE_LENSMC_WEIGHT invVar shape_e1_ivar ivar_e1 wgt lensWeight ivar[0] w.lens w-lens \
            inv_sigma2 wtot sumw sum_w precision shape_precision photoz_weight weight_redshift w[0]";
        for name in weights.split_whitespace() {
            assert!(looks_like_weight(name), "{name}");
        }
        let others = "FLAGS_WEIGHT weight_mask weighted_x psf_weight star_weight flux_ivar_g fiberflux_ivar ra_ivar dec_ivar \
            pmra_ivar shape_r_ivar sersic_ivar z_ivar mag_weight weight_1p w_dg1 w1mpro W2 wmom_g_1 wdm_r f814w_flux width n_weight w_0 photoz_ivar";
        for name in others.split_whitespace() {
            assert!(!looks_like_weight(name), "{name}");
        }
    }
}
