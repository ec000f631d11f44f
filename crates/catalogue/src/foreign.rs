//! Catalogues of other programs, described by a TOML file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Deserializer, Serialize};
use shearq_quantities::Shear;
use shearq_scoring::{Grid, RowCounts, RowFault};
use shearq_submissions::{EllipticityType, checked_name};

use shearq_dataset::images::{self, Files};
use shearq_dataset::layout::{IMAGE_PLACEHOLDERS, check_pattern};
use shearq_files::FileError;
use shearq_files::atomic::folder_of;
use shearq_files::table::Place;

use crate::columns::{Names, Shapes};
use crate::failures::shown;
use crate::galaxies::{Galaxies, Galaxy};
use crate::recognition::Survey;
use crate::request::{Placed, Request};

/// How to read another program's catalogues. Columns that are not named are recognised.
///
/// ```toml
/// name = "REGAUSS"
/// catalogues = "set{set:02}/hsm-regauss-{image:03}.csv"   # relative to this file, or absolute
/// ellipticity = "distortion"      # type of the columns: "distortion", "responsivity" or "shear" [default: by their names]
/// report = "shear"                # type to score [default: shear]
/// table = "OBJECTS"               # FITS table, by name or number [default: the one with these columns]
/// x = "x"                         # names of the columns [default: recognised]
/// y = "y"
/// e1 = "e1"
/// e2 = "e2"
/// flag = "flag"                   # rows with another value than 0 have no ellipticity
/// columns = { w = "weight", R11 = "none" }   # other roles of `bias --columns`; "none" for a column that is not to be used
/// missing = -99                   # rows with this value in e1 or e2 have none [default: no such value]
/// step = 0.01                     # artificial shear of sheared catalogues [default: 0.01]
/// drop_missing = true             # rows with a number that no measurement gives, such as -99, have none [default: refused]
/// max_modulus = 1.0               # rows with a larger |e| (as reported) have none [default: no limit]
/// position_offset = 0.0           # added to x and y to make them FITS pixels (1 for 0-based positions)
/// e2_sign = 1                     # -1 if e2 is positive along x = -y; the responses and sheared catalogues are in the same axes
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Foreign {
    /// Name of the program in tables.
    #[serde(deserialize_with = "checked_name")]
    pub name: String,
    catalogues: String,
    /// How ellipticities become shears; by the names of the columns if it is not stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ellipticity: Option<Shapes>,
    #[serde(default)]
    report: EllipticityType,
    #[serde(
        default,
        deserialize_with = "name_or_number",
        skip_serializing_if = "Option::is_none"
    )]
    table: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    x: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    y: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    e1: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    e2: Option<String>,
    flag: Option<String>,
    /// Columns of other roles.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub columns: BTreeMap<String, String>,
    /// A value of e1 or e2 of galaxies that were not measured.
    pub missing: Option<f64>,
    /// Whether numbers that stand for a failed measurement count as not measured.
    // Left out of what is written unless set, so that descriptions of packed results stay the same.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub drop_missing: bool,
    /// The largest valid |e|, after conversion.
    pub max_modulus: Option<f64>,
    /// Artificial shear of metacalibration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step: Option<f64>,
    #[serde(default)]
    position_offset: f64,
    #[serde(default = "one")]
    e2_sign: i8,
    /// Surveys that are recognised, too.
    #[serde(skip)]
    pub presets: Vec<Survey>,
    #[serde(skip)]
    folder: PathBuf,
}

// The name or the number of a table.
fn name_or_number<'de, D: Deserializer<'de>>(value: D) -> Result<Option<String>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "expected the name or the number of a table")]
    enum Table {
        Number(u32),
        Name(String),
    }
    let table = Option::<Table>::deserialize(value)?;
    Ok(table.map(|table| match table {
        Table::Number(number) => number.to_string(),
        Table::Name(name) => name,
    }))
}

fn one() -> i8 {
    1
}

/// What names the columns of plain files.
pub const HINT_OF_COLUMNS: &str = "`score --columns` (names, or numbers such as 2,3,4,5) or a description (--foreign) names others";
// Columns of a text without names.
const UNNAMED: [&str; 4] = ["x", "y", "e1", "e2"];

impl Default for Foreign {
    /// Plain files, whose columns are recognised.
    fn default() -> Self {
        Foreign {
            name: String::new(),
            catalogues: String::new(),
            ellipticity: None,
            report: EllipticityType::Shear,
            table: None,
            x: None,
            y: None,
            e1: None,
            e2: None,
            flag: None,
            columns: BTreeMap::new(),
            missing: None,
            drop_missing: false,
            max_modulus: None,
            step: None,
            position_offset: 0.0,
            e2_sign: one(),
            presets: Vec::new(),
            folder: PathBuf::new(),
        }
    }
}

impl Foreign {
    /// Reads a description, and returns its text too.
    pub fn read(path: &Path) -> Result<(Self, String), FileError> {
        let text = shearq_files::open::read_to_string(path, shearq_files::open::SETTINGS).map_err(
            FileError::doing(path, "cannot read the description of catalogues"),
        )?;
        let mut foreign: Foreign =
            toml::from_str(&text).map_err(|e| FileError::new(path, e.to_string().trim_end()))?;
        // Another factor would be a calibration, and change m silently.
        if foreign.e2_sign.abs() != 1 {
            let message = format!("`e2_sign` is {}; expected 1 or -1", foreign.e2_sign);
            return Err(FileError::new(path, message));
        }
        if let Some(most) = foreign.max_modulus.filter(|m| !(m.is_finite() && *m > 0.0)) {
            let message = format!("`max_modulus` is {most}; expected a positive number");
            return Err(FileError::new(path, message));
        }
        if let Some(step) = foreign.step.filter(|own| !(own.is_finite() && *own > 0.0)) {
            let message = format!("`step` is {step}; expected a positive number");
            return Err(FileError::new(path, message));
        }
        if foreign.report == EllipticityType::Distortion
            && foreign
                .ellipticity
                .is_none_or(|own| own == Shapes::Responsivity)
        {
            let message = "`report` is \"distortion\", which needs the type of each ellipticity";
            return Err(
                FileError::new(path, message).hint("`ellipticity` = \"distortion\" or \"shear\"")
            );
        }
        foreign.request(path)?;
        check_pattern("catalogues", &foreign.catalogues, &[IMAGE_PLACEHOLDERS])
            .map_err(|message| FileError::new(path, message))?;
        foreign.folder = folder_of(path).to_owned();
        Ok((foreign, text))
    }

    /// The pattern of the catalogues' names, with its folder.
    pub fn pattern(&self) -> PathBuf {
        self.folder.join(&self.catalogues)
    }

    /// The existing catalogues of `sets` (of all if empty).
    pub fn catalogues(&self, sets: &[u32]) -> Result<Files, FileError> {
        images::find(&self.folder, &self.catalogues, &[""], sets)
    }

    /// Whether e2 of the catalogues is positive along x = −y.
    pub fn has_other_sign_of_e2(&self) -> bool {
        self.e2_sign < 0
    }

    fn request(&self, path: &Path) -> Result<Request, FileError> {
        let keys = [
            ("x", &self.x),
            ("y", &self.y),
            ("e1", &self.e1),
            ("e2", &self.e2),
            ("flag", &self.flag),
        ];
        let keys = keys
            .iter()
            .filter_map(|(role, column)| Some((*role, column.as_deref()?)));
        let others = self.columns.iter();
        let others = others.map(|(role, column)| (role.as_str(), column.as_str()));
        let mut names = Names::default();
        names.add_presets(self.presets.clone());
        for (role, column) in keys.chain(others) {
            names
                .add(&format!("{role}={column}"))
                .map_err(|error| FileError::new(path, error))?;
        }
        let shapes = match (self.ellipticity, self.report) {
            // Distortions stay ones.
            (Some(Shapes::Converted), EllipticityType::Distortion) => Some(Shapes::Shear),
            (shapes, _) => shapes,
        };
        Ok(Request {
            names,
            shapes,
            drop_missing: self.drop_missing,
            step: self.step,
            placed: Some(Placed {
                missing: self.missing,
                max_modulus: self.max_modulus,
            }),
            ..Request::default()
        })
    }

    /// Finds the columns of a catalogue, of which at most `most` rows are read.
    pub fn open(&self, path: &Path, most: usize) -> Result<Galaxies, FileError> {
        let place = Place::with_table(path, self.table.as_deref())?;
        let mut name = place.path.into_os_string();
        if let Some(table) = place.table {
            name.push(format!("[{table}]"));
        }
        let request = self.request(path)?;
        let keys = [&self.x, &self.y, &self.e1, &self.e2];
        let unnamed: [&str; 4] = std::array::from_fn(|k| {
            let given = keys[k].as_ref().or_else(|| self.columns.get(UNNAMED[k]));
            given.map_or(UNNAMED[k], String::as_str)
        });
        let found = Galaxies::open(PathBuf::from(name).into(), &request, unnamed, most);
        found.map_err(|error| match self.catalogues.is_empty() {
            true => error.hint_of_columns(HINT_OF_COLUMNS),
            false => error
                .hint_of_columns("the description of the catalogues specifies the names")
                .with_words("--columns ", "`columns` of the description, "),
        })
    }

    /// The rows of one image, at most `most`, converted to standard signs and the reported type, with their weights. Rows that
    /// do not count have no ellipticity.
    pub fn rows(&self, galaxies: &Galaxies, most: usize) -> Result<Vec<Galaxy>, FileError> {
        let mut all = galaxies.read(most)?;
        for (row, _) in &mut all {
            row.x += self.position_offset;
            row.y += self.position_offset;
            if (self.ellipticity, self.report) == (Some(Shapes::Shear), EllipticityType::Distortion)
            {
                let e = Shear::new(row.e1, row.e2).to_distortion();
                (row.e1, row.e2) = (e.e1, e.e2);
            }
            // Conversions do not change the orientation.
            row.e2 *= f64::from(self.e2_sign);
            if self
                .max_modulus
                .is_some_and(|most| row.e1.hypot(row.e2) > most)
            {
                (row.e1, row.e2) = (f64::NAN, f64::NAN);
            }
        }
        Ok(all)
    }
}

/// What to do about numbers that stand for a failed measurement, on the command line.
pub const ADVICE_ON_SENTINELS: &str =
    "try --drop-missing or name it as missing; otherwise set a largest |e|";

/// The reason not to score these rows, if there is one. `advice` on numbers that stand for a failed measurement depends
/// on the caller: arrays have NaN instead of options.
pub fn fault_of_rows(counts: &RowCounts, grid: &Grid, advice: &str) -> Option<String> {
    let limit = RowCounts::ABSURD;
    Some(match counts.fault()? {
        RowFault::Sentinels {
            rows,
            first: (row, e1, e2),
        } => format!(
            "{rows} rows have a number that no measurement of an ellipticity gives, the first of them row {row} with ({}, {}): if it stands for \"not measured\", {advice}",
            shown(e1),
            shown(e2)
        ),
        RowFault::Absurd {
            rows,
            used,
            first: (row, e1, e2),
        } => format!(
            "{rows} of {used} rows have |e| > {limit}, the first of them row {row} with ({e1}, {e2}); expected ellipticities, below 1. If these are outliers, set a largest |e|"
        ),
        RowFault::Repeated { rows, used } => format!(
            "{rows} of {used} rows fall into cells that have a row already; expected positions in pixels, of {} px stamps on a {1} × {1} grid",
            grid.stamp.0, grid.n
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    // The rows of a catalogue with the columns a, b, u, v and bad, described by more keys.
    fn rows(keys: &str, lines: &str) -> Result<Vec<Galaxy>, FileError> {
        let folder = tempfile::tempdir().unwrap();
        let (toml, csv) = (folder.path().join("f.toml"), folder.path().join("1-1.csv"));
        let names = "x = \"a\"\ny = \"b\"\ne1 = \"u\"\ne2 = \"v\"\nflag = \"bad\"";
        let start = "name = \"F\"\ncatalogues = \"{set}-{image}.csv\"";
        std::fs::write(&toml, format!("{start}\n{names}\n{keys}\n")).unwrap();
        std::fs::write(&csv, format!("a,b,u,v,bad\n{lines}")).unwrap();
        let foreign = Foreign::read(&toml).unwrap().0;
        assert_eq!(foreign.catalogues(&[]).unwrap().of_set(1).len(), 1);
        foreign.rows(&foreign.open(&csv, 100)?, 100)
    }

    #[test]
    fn flagged_missing_and_large_ellipticities_are_not_measured() {
        let keys = "ellipticity = \"shear\"\nmissing = -99\nmax_modulus = 0.5";
        let lines = "1,1,0.1,0.2,0\n1,1,0.1,0.2,4\n1,1,-99,0.2,0\n1,1,0.4,0.4,0\n1,1,,0.2,0\n";
        let measured = rows(keys, lines).unwrap();
        let measured: Vec<bool> = measured.iter().map(|own| own.0.e1.is_finite()).collect();
        assert_eq!(measured, [true, false, false, false, false]);
        let converted = |keys: &str, e1: f64| {
            let rows = rows(keys, &format!("1,1,{e1},0,0\n"));
            rows.map(|rows| rows[0].0.e1)
        };
        let reported = converted("ellipticity = \"shear\"\nreport = \"distortion\"", 0.2);
        assert!((reported.unwrap() - 0.4 / 1.04).abs() < 1e-15);
        let distortion = "ellipticity = \"distortion\"";
        assert!((converted(distortion, 0.6).unwrap() - 1.0 / 3.0).abs() < 1e-15);
        let kept = format!("{distortion}\nreport = \"distortion\"");
        assert_eq!(converted(&kept, 0.6).unwrap(), 0.6);
        // A distortion of 0.9 is a shear of 0.63, and no shear belongs to 1.2.
        let limited = format!("{distortion}\nmax_modulus = 0.5");
        assert!(converted(&limited, 0.9).unwrap().is_nan());
        assert!(converted(distortion, 1.2).unwrap().is_nan());
        // Only a request makes a failed measurement missing.
        for keys in [distortion, "ellipticity = \"shear\""] {
            assert!(converted(keys, -10.0).is_err());
            let dropped = format!("{keys}\ndrop_missing = true");
            assert!(converted(&dropped, -10.0).unwrap().is_nan());
        }
    }
}
