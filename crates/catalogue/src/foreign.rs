//! Catalogues of other programs, described by a TOML file.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Deserializer, Serialize};
use shearq_quantities::{Distortion, MeasuredRange, Shear};
use shearq_scoring::{Grid, Row, RowCounts, RowFault};
use shearq_submissions::{EllipticityType, checked_name};

use shearq_dataset::images::{self, Files};
use shearq_dataset::layout::{IMAGE_PLACEHOLDERS, check_pattern};
use shearq_files::FileError;
use shearq_files::atomic::folder_of;
use shearq_files::table::{self, Place};

/// How to read another program's catalogues.
///
/// ```toml
/// name = "REGAUSS"
/// catalogues = "set{set:02}/hsm-regauss-{image:03}.csv"   # relative to this file, or absolute
/// ellipticity = "distortion"      # type of the columns: "distortion" or "shear"
/// report = "shear"                # type to score [default: shear]
/// table = "OBJECTS"               # FITS table, by name or number [default: the one with these columns]
/// x = "x"                         # names of the columns [defaults: x, y, e1, e2, no flag]
/// y = "y"
/// e1 = "e1"
/// e2 = "e2"
/// flag = "flag"                   # rows with another value than 0 have no ellipticity
/// missing = -99                   # rows with this value in e1 or e2 have none [default: no such value]
/// drop_missing = true             # rows with a number that no measurement gives, such as -99, have none [default: refused]
/// max_modulus = 1.0               # rows with a larger |e| (as reported) have none [default: no limit]
/// position_offset = 0.0           # added to x and y to make them FITS pixels (1 for 0-based positions)
/// e2_sign = 1                     # -1 if e2 is positive along x = -y
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Foreign {
    /// Name of the program in tables.
    #[serde(deserialize_with = "checked_name")]
    pub name: String,
    catalogues: String,
    ellipticity: EllipticityType,
    #[serde(default = "shear")]
    report: EllipticityType,
    #[serde(
        default,
        deserialize_with = "name_or_number",
        skip_serializing_if = "Option::is_none"
    )]
    table: Option<String>,
    #[serde(default = "x")]
    x: String,
    #[serde(default = "y")]
    y: String,
    #[serde(default = "e1")]
    e1: String,
    #[serde(default = "e2")]
    e2: String,
    flag: Option<String>,
    /// A value of e1 or e2 of galaxies that were not measured.
    pub missing: Option<f64>,
    /// Whether numbers that stand for a failed measurement count as not measured.
    // Left out of what is written unless set, so that descriptions of packed results stay the same.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub drop_missing: bool,
    /// The largest valid |e|, after conversion.
    pub max_modulus: Option<f64>,
    #[serde(default)]
    position_offset: f64,
    #[serde(default = "one")]
    e2_sign: i8,
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

fn shear() -> EllipticityType {
    EllipticityType::Shear
}
fn x() -> String {
    "x".into()
}
fn y() -> String {
    "y".into()
}
fn e1() -> String {
    "e1".into()
}
fn e2() -> String {
    "e2".into()
}
fn one() -> i8 {
    1
}

impl Foreign {
    /// The description of plain files with the columns x, y, e1 and e2 of these names.
    pub fn of_columns(columns: [&str; 4], ellipticity: EllipticityType) -> Self {
        let [x, y, e1, e2] = columns.map(str::to_owned);
        Foreign {
            name: String::new(),
            catalogues: String::new(),
            ellipticity,
            report: EllipticityType::Shear,
            table: None,
            x,
            y,
            e1,
            e2,
            flag: None,
            missing: None,
            drop_missing: false,
            max_modulus: None,
            position_offset: 0.0,
            e2_sign: 1,
            folder: PathBuf::new(),
        }
    }

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

    /// The rows of one image, at most `most`, converted to standard signs and the reported type.
    /// Flagged rows and distortions above 1 have no ellipticity.
    pub fn rows(&self, path: &Path, most: usize) -> Result<Vec<Row>, FileError> {
        let mut names = vec![
            self.x.as_str(),
            self.y.as_str(),
            self.e1.as_str(),
            self.e2.as_str(),
        ];
        names.extend(self.flag.as_deref());
        let place = Place::with_table(path, self.table.as_deref())?;
        let table = table::read_from(&place, Some(&names), most).map_err(|error| {
            let hint = match self.catalogues.is_empty() {
                true => "`score --columns` (names, or numbers such as 2,3,4,5) or a description (--foreign) names others",
                false => "the description of the catalogues specifies the names",
            };
            error.hint_of_columns(hint)
        })?;
        let column = |name: &str| table::numbers(&table, name, path);
        let flags = self.flag.as_deref().map(column).transpose()?;
        let (x, y) = (column(&self.x)?, column(&self.y)?);
        let (e1, e2) = (column(&self.e1)?, column(&self.e2)?);
        let row = |k: usize| {
            let flagged = flags.as_ref().is_some_and(|flags| flags[k] != 0.0);
            let (e1, e2) = match flagged {
                true => (f64::NAN, f64::NAN),
                false => (e1[k], e2[k]),
            };
            let (x, y) = (x[k] + self.position_offset, y[k] + self.position_offset);
            let [e1, e2] = self.screened(e1, e2).unwrap_or([f64::NAN; 2]);
            // After the screen, which compares with the values in the file. Conversions do not change the orientation.
            let e2 = f64::from(self.e2_sign) * e2;
            Row { x, y, e1, e2 }
        };
        Ok((0..x.len()).map(row).collect())
    }

    // The converted ellipticity; `None` if the galaxy was not measured.
    fn screened(&self, e1: f64, e2: f64) -> Option<[f64; 2]> {
        use EllipticityType::{Distortion as Chi, Shear as Epsilon};
        let failed = is_failure(e1, e2);
        let missing = self.missing.is_some_and(|m| e1 == m || e2 == m);
        let e = match (self.ellipticity, self.report) {
            _ if missing || failed && self.drop_missing => return None,
            // No shear belongs to such a number, but only a request makes it missing: the sum refuses it.
            _ if failed => [e1, e2],
            (Chi, Epsilon) => Distortion::new(e1, e2).to_shear().map(|e| [e.e1, e.e2])?,
            (Epsilon, Chi) => {
                let e = Shear::new(e1, e2).to_distortion();
                [e.e1, e.e2]
            }
            _ => [e1, e2],
        };
        let most = self.max_modulus;
        most.is_none_or(|most| e[0].hypot(e[1]) <= most)
            .then_some(e)
    }
}

// Whether one component stands for a failed measurement.
fn is_failure(e1: f64, e2: f64) -> bool {
    // HSM's −10 in one row of a hundred gave c = −0.096, and 1e30 gave m = 3.5e12, both without a message.
    let range = MeasuredRange::ELLIPTICITY;
    range.excludes(e1) || range.excludes(e2)
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

pub fn shown(value: f64) -> String {
    match value.abs() >= 1e7 {
        // Thirty digits would hide the message.
        true => format!("{value:e}"),
        false => value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // The rows of a catalogue with the columns a, b, u, v and bad, described by more keys.
    fn rows(keys: &str, lines: &str) -> Vec<Row> {
        let folder = tempfile::tempdir().unwrap();
        let (toml, csv) = (folder.path().join("f.toml"), folder.path().join("1-1.csv"));
        let names = "x = \"a\"\ny = \"b\"\ne1 = \"u\"\ne2 = \"v\"\nflag = \"bad\"";
        let start = "name = \"F\"\ncatalogues = \"{set}-{image}.csv\"";
        std::fs::write(&toml, format!("{start}\n{names}\n{keys}\n")).unwrap();
        std::fs::write(&csv, format!("a,b,u,v,bad\n{lines}")).unwrap();
        let foreign = Foreign::read(&toml).unwrap().0;
        assert_eq!(foreign.catalogues(&[]).unwrap().of_set(1).len(), 1);
        foreign.rows(&csv, 100).unwrap()
    }

    #[test]
    fn flagged_missing_and_large_ellipticities_are_not_measured() {
        let keys = "ellipticity = \"shear\"\nmissing = -99\nmax_modulus = 0.5";
        let lines = "1,1,0.1,0.2,0\n1,1,0.1,0.2,4\n1,1,-99,0.2,0\n1,1,0.4,0.4,0\n";
        let measured: Vec<bool> = rows(keys, lines).iter().map(|r| r.e1.is_finite()).collect();
        assert_eq!(measured, [true, false, false, false]);
        let failed = |keys| rows(keys, "1,1,-10,0.2,0\n")[0].e1;
        assert_eq!(failed("ellipticity = \"shear\""), -10.0);
        assert!(failed("ellipticity = \"shear\"\ndrop_missing = true").is_nan());
        let reported = rows(
            "ellipticity = \"shear\"\nreport = \"distortion\"",
            "1,1,0.2,0,0\n",
        );
        assert!((reported[0].e1 - 0.4 / 1.04).abs() < 1e-15);
        let described = Foreign {
            missing: Some(-99.0),
            max_modulus: Some(0.5),
            ..Foreign::of_columns(["a", "b", "u", "v"], EllipticityType::Distortion)
        };
        let apply = |e1| described.screened(e1, 0.0).map(|e| e[0]);
        assert!((apply(0.6).unwrap() - 1.0 / 3.0).abs() < 1e-15);
        // A distortion of 0.9 is a shear of 0.63.
        assert_eq!([-99.0, 0.9].map(apply), [None; 2]);
        // No shear belongs to −10, but only a request makes it missing.
        for drop_missing in [false, true] {
            let described = Foreign {
                drop_missing,
                ..Foreign::of_columns(["a", "b", "u", "v"], EllipticityType::Distortion)
            };
            assert_eq!(described.screened(-10.0, 0.0).is_none(), drop_missing);
        }
    }
}
