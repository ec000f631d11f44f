//! What columns without a role suggest: weights, flags, responses and calibrations that are not used.

use super::{Columns, Names, other_component};
use crate::recognition::{Patterns, fits_any, has_any, recognition, words};
use crate::roles::Role;
use crate::steps::sheared_name;

// Whether rows count that have 1 in a column of this name, rather than 0; `None` for a column that makes no choice.
pub fn counted_value(name: &str) -> Option<bool> {
    let known = recognition().cuts.get(&name.to_ascii_lowercase())?;
    Some(*known)
}

/// Whether the name of a column suggests that it is a weight of shapes.
pub fn looks_like_weight(name: &str) -> bool {
    let Patterns {
        weight, no_weight, ..
    } = &recognition().patterns;
    // The dark energy w₀ of a mock catalogue.
    let is_w0 = name.eq_ignore_ascii_case("w_0");
    has_any(weight, name) && !has_any(no_weight, name) && !is_w0
}

fn is_like_a_calibration(name: &str) -> bool {
    has_any(&recognition().patterns.calibration, name)
        && !is_magnitude(name)
        && !is_like_a_response(name)
}

fn is_magnitude(name: &str) -> bool {
    has_any(&recognition().patterns.no_calibration, name)
}

// Whether the words of a name are those of a quantity that m and c do not depend on.
fn is_harmless(name: &str) -> bool {
    let known = &recognition().patterns;
    is_magnitude(name) || has_any(&known.harmless, name) && !has_any(&known.not_harmless, name)
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
    pub(super) fn find_unused(&mut self, found: &[String], names: &Names) {
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
        let (unused, unknown) = (unread(&self.unused), unread(&self.unknown));
        let mut lines = Vec::new();
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
            is_clear && is_like_a_response(name) && sheared_name(name).is_none()
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
        let m = own(&["_m_", "_m1_", "_m_1_"]).filter(|_| without_response);
        if let Some(m) = m {
            let other = other_component(unused, m).unwrap_or(m);
            columns.push(match is_shear {
                true => format!("R11=1+{m},R22=1+{other}"),
                false => format!("m={m}"),
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
        // CFHTLenS uses rows of MASK 0 and 1 (Erben et al. 2013, MNRAS 433, 2545).
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
pub(super) fn likely_ellipticities(found: &[String]) -> String {
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
    match first.or_else(|| pairs.find(is_e1)) {
        Some(name) => format!("e1={name},e2={}", name.replace('1', "2")),
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
