//! Positions of galaxies on an exposure: finding their columns in a table, and checking them.

use std::collections::HashMap;
use std::path::Path;

use shearq_files::FileError;
use shearq_files::names_of;
use shearq_files::table::{self, Columns, MAX_ROWS, Named, Place};

// Names of columns of positions in pixels counted from 1, the best first, in any case.
const KNOWN: [[&str; 2]; 6] = [
    ["x", "y"],
    ["xwin_image", "ywin_image"],
    ["x_image", "y_image"],
    ["xwin_image_dbl", "ywin_image_dbl"],
    ["x_image_dbl", "y_image_dbl"],
    ["xpsf_image", "ypsf_image"],
];
// Names of coordinates on the sky, in any case.
const SKY: [&str; 6] = [
    "ra",
    "ra_deg",
    "alpha_j2000",
    "alphawin_j2000",
    "alpha_sky",
    "right_ascension",
];
// Distance in pixels below which two positions have the same galaxy: stamps are cut to half a pixel.
const SAME_GALAXY_PX: f64 = 0.5;

#[derive(Debug, Clone, Copy, serde::Serialize)]
pub struct Table<'a> {
    /// The file, with `[TABLE]` behind its name if one of its tables is meant.
    #[serde(serialize_with = "super::shown")]
    pub path: &'a Path,
    /// Name or number of the table of a FITS file.
    pub table: Option<&'a str>,
    /// Names of the columns for x and y, or their numbers in a text table without names; without, known names.
    pub columns: Option<[&'a str; 2]>,
}

/// Positions in FITS pixels: the centre of the first is at 1.
pub(super) struct Positions {
    place: Place,
    pub(super) all: Vec<(f64, f64)>,
    /// Which columns they are, if the user did not name them.
    pub(super) note: Option<String>,
}

impl Positions {
    pub(super) fn read(table: Table<'_>) -> Result<Self, FileError> {
        let mut place = Place::with_table(table.path, table.table)?;
        let columns = table::columns(&place)?;
        let [x, y] = match table.columns {
            Some(names) => given(&place, &columns, names)?,
            None => known(&mut place, &columns)?,
        };
        let read = table::read_from(&place, Some(&[&x, &y]), MAX_ROWS)
            .map_err(|error| error.hint_of_columns("--columns X,Y names others"))?;
        let of = |name| table::numbers(&read, name, &place.path);
        let (xs, ys) = (of(&x)?, of(&y)?);
        let all: Vec<_> = xs.iter().copied().zip(ys.iter().copied()).collect();
        if all.is_empty() {
            let message = "there is no position; expected one per row";
            return Err(FileError::new(&place.path, message));
        }
        let most = f64::from(i32::MAX);
        let wrong = |(x, y): &(f64, f64)| !(x.abs() < most && y.abs() < most);
        if let Some(row) = all.iter().position(wrong) {
            let (x, y) = all[row];
            let message = format!(
                "row {}: the position is ({x}, {y}); expected pixels of the exposure",
                row + 1
            );
            return Err(FileError::new(&place.path, message));
        }
        let shown = format!(
            "{}: positions from the columns {x} and {y}",
            place.path.display()
        );
        let note = match (table.columns, place.table.as_deref()) {
            (Some(_), _) => None,
            (None, None) if (x.as_str(), y.as_str()) == ("x", "y") => None,
            (None, None) => Some(shown),
            (None, Some(table)) => Some(format!("{shown} of table {table}")),
        };
        Ok(Positions { place, all, note })
    }

    /// Warnings about the positions on an exposure of this size.
    pub(super) fn examine(
        &self,
        exposure: &Path,
        [width, height]: [usize; 2],
    ) -> Result<Vec<String>, FileError> {
        let path = &self.place.path;
        let count = self.all.len();
        let within = |at: f64, side: usize| at >= 0.5 && at < side as f64 + 0.5;
        let outside = |&(x, y): &(f64, f64)| !within(x, width) || !within(y, height);
        let beyond = self.all.iter().filter(|at| outside(at)).count();
        let (repeated, first) = self.repeated();
        let degrees = self
            .all
            .iter()
            .all(|(x, y)| (0.0..=360.0).contains(x) && y.abs() <= 90.0);
        let (x, y) = self.all[0];
        // Degrees that are treated as pixels lie within a few pixels.
        if beyond == count || degrees && count > 2 && 2 * repeated > count {
            let cause = match degrees {
                true => {
                    "Are these degrees (right ascension and declination)? Try: convert them to pixels with the WCS of the exposure"
                }
                false => {
                    "Are these positions of another image? Try: name the columns with --columns X,Y"
                }
            };
            let what = match beyond == count {
                true => format!("all {count} positions are outside the exposure"),
                false => format!(
                    "{repeated} of {count} positions are within {SAME_GALAXY_PX} px of an earlier one"
                ),
            };
            let message = format!(
                "{what} (found ({x}, {y}) first, expected FITS pixels of {}, 1 to {width} and 1 to {height}). {cause}",
                exposure.display()
            );
            return Err(FileError::new(path, message));
        }
        let mut doubts = Vec::new();
        if 10 * beyond > count {
            doubts.push(format!(
                "warning: {}: {beyond} of {count} positions are outside the exposure of {width} × {height} px. Try: check --columns and --exposure",
                path.display()
            ));
        }
        if let Some((earlier, later)) = first {
            let (x, y) = self.all[later];
            doubts.push(format!(
                "warning: {}: {repeated} of {count} positions are within {SAME_GALAXY_PX} px of an earlier one (the first is row {} at ({x}, {y}), like row {}). Each row counts as a galaxy. Try: remove duplicates",
                path.display(),
                later + 1,
                earlier + 1
            ));
        }
        Ok(doubts)
    }

    /// The number of positions near an earlier one, and the first such pair.
    fn repeated(&self) -> (usize, Option<(usize, usize)>) {
        // Two positions in one cell are nearer than SAME_GALAXY_PX. So a cell has at most one that is no repetition, and others
        // of it lie at most two cells away.
        let side = SAME_GALAXY_PX / std::f64::consts::SQRT_2;
        let mut kept: HashMap<(i64, i64), usize> = HashMap::with_capacity(self.all.len());
        let (mut count, mut first) = (0, None);
        for (k, &(x, y)) in self.all.iter().enumerate() {
            let cell = ((x / side).floor() as i64, (y / side).floor() as i64);
            let near = (-2..=2).flat_map(|dx| (-2..=2).map(move |dy| (dx, dy)));
            let mut others = near.filter_map(|(dx, dy)| kept.get(&(cell.0 + dx, cell.1 + dy)));
            let same = others.find(|&&other| {
                let (ox, oy) = self.all[other];
                (x - ox).hypot(y - oy) <= SAME_GALAXY_PX
            });
            match same.copied() {
                Some(other) => {
                    count += 1;
                    first.get_or_insert((other, k));
                }
                None => {
                    kept.insert(cell, k);
                }
            }
        }
        (count, first)
    }
}

fn given(place: &Place, columns: &Columns, names: [&str; 2]) -> Result<[String; 2], FileError> {
    let owned = names.map(str::to_owned);
    let numbers = names.iter().all(|name| name.parse::<usize>().is_ok());
    let has = |named: &Named| {
        names
            .iter()
            .all(|name| named.names.iter().any(|n| n == name))
    };
    if columns.unnamed.is_empty() || numbers || columns.named.iter().any(has) {
        return Ok(owned);
    }
    Err(FileError::new(
        &place.path,
        format!(
            "the columns have no names (found the first row `{}`, expected names such as `{}`). Try: --columns with the numbers of two columns, as in `1,2`",
            names_of(&columns.unnamed),
            names.join(",")
        ),
    ))
}

/// The columns with known names, or the only two columns. Sets the table that has them.
fn known(place: &mut Place, columns: &Columns) -> Result<[String; 2], FileError> {
    let found: Vec<(&Named, [String; 2])> = columns
        .named
        .iter()
        .filter_map(|named| Some((named, pair(&named.names)?)))
        .collect();
    match found.as_slice() {
        [(named, pair), others @ ..] if others.is_empty() || named.doubtful => {
            if let Some((number, _)) = &named.table {
                place.table.get_or_insert_with(|| number.to_string());
            }
            return Ok(pair.clone());
        }
        [] => {}
        several => {
            let tables: Vec<&str> = several
                .iter()
                .filter_map(|(named, _)| named.table.as_ref())
                .map(|(_, shown)| shown.as_str())
                .collect();
            let message = format!(
                "{} tables have positions (found {}, expected one). Try: --table with a number",
                several.len(),
                names_of(&tables)
            );
            return Err(FileError::new(&place.path, message));
        }
    }
    let all: Vec<&String> = columns.named.iter().flat_map(|n| &n.names).collect();
    let sky = all
        .iter()
        .any(|name| SKY.iter().any(|sky| name.eq_ignore_ascii_case(sky)));
    let degrees = match sky {
        true => ". Coordinates on the sky have to be converted to pixels first",
        false => "",
    };
    let certain: Vec<&String> = columns
        .named
        .iter()
        .filter(|named| !named.doubtful || sky)
        .flat_map(|named| &named.names)
        .collect();
    if columns.unnamed.len() == 2 && !sky {
        return Ok(["1".into(), "2".into()]);
    }
    let (found, example) = match certain.as_slice() {
        [] if columns.unnamed.is_empty() => ("no column".into(), "X,Y"),
        [] => {
            let row = names_of(&columns.unnamed);
            (format!("no names and the first row `{row}`"), "2,3")
        }
        names => (names_of(names), "X,Y"),
    };
    Err(FileError::new(
        &place.path,
        format!(
            "cannot determine the columns of the positions (found {found}; expected x and y, X_IMAGE and Y_IMAGE, or two columns){degrees}. Try: --columns {example}"
        ),
    ))
}

fn pair(names: &[String]) -> Option<[String; 2]> {
    let find = |wanted: &str| {
        names
            .iter()
            .find(|name| name.eq_ignore_ascii_case(wanted))
            .cloned()
    };
    KNOWN.iter().find_map(|[x, y]| Some([find(x)?, find(y)?]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn positions(all: &[(f64, f64)]) -> Positions {
        Positions {
            place: Place::of(Path::new("p.csv")),
            all: all.to_vec(),
            note: None,
        }
    }

    #[test]
    fn positions_within_half_a_pixel_of_an_earlier_one_are_counted() {
        let of = |all| positions(all).repeated();
        assert_eq!(of(&[(1.0, 1.0), (1.6, 1.0), (-3.0, 2.0)]), (0, None));
        let found = of(&[(1.0, 1.0), (9.0, 1.0), (1.35, 1.35), (1.0, 1.0), (9.0, 0.5)]);
        assert_eq!(found, (3, Some((0, 2))));
    }
}
