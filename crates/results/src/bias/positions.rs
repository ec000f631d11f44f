//! True shears of galaxies, found by their positions.

use std::path::Path;

use shearq_dataset::truth::sign_on_any_grid;
use shearq_files::FileError;
use shearq_files::table::{self, MAX_ROWS, Place, TRUTH_COLUMNS};
use shearq_scoring::{Row, TruthSign};

/// Largest distance of a galaxy from its place in the truth, in pixels.
pub const RADIUS: f64 = 1.0;

/// A place of the truth.
#[derive(Debug, Clone, Copy)]
struct Entry {
    x: f64,
    y: f64,
    shear: [f64; 2],
}

impl Entry {
    /// Square of side [`RADIUS`] that contains the place: row and column.
    fn cell(&self) -> (i64, i64) {
        (
            (self.y / RADIUS).floor() as i64,
            (self.x / RADIUS).floor() as i64,
        )
    }
}

/// True shears at positions.
#[derive(Debug, Clone, Default)]
pub struct Positions {
    /// In the order of their cells.
    entries: Vec<Entry>,
}

impl Positions {
    /// Reads a table with the columns x, y (pixels), g1 and g2 of this sign.
    ///
    /// # Errors
    /// If the file cannot be read, or a number is no position or no shear.
    pub fn read(path: &Path, sign: TruthSign) -> Result<Self, FileError> {
        let place = Place::of(path);
        let found = table::columns(&place)?;
        let names = TRUTH_COLUMNS.map(|name| {
            let mut all = found.named.iter().flat_map(|list| &list.names);
            let own = all.find(|own| own.eq_ignore_ascii_case(name));
            own.map_or(name, String::as_str)
        });
        let read = table::read_from(&place, Some(&names), MAX_ROWS)?;
        let column = |k: usize| table::numbers(&read, names[k], path);
        let [xs, ys, g1, g2] = [column(0)?, column(1)?, column(2)?, column(3)?];
        let factor = match sign {
            TruthSign::Standard => 1.0,
            TruthSign::Challenge => -1.0,
        };
        let mut entries = Vec::with_capacity(xs.len());
        for row in 0..xs.len() {
            let fault = |fault: String| FileError::new(path, format!("row {}: {fault}", row + 1));
            let (x, y) = (xs[row], ys[row]);
            if !(x.is_finite() && y.is_finite()) {
                return Err(fault(format!(
                    "found the position {x}, {y}, expected numbers"
                )));
            }
            let shear = [g1[row], factor * g2[row]];
            check(shear).map_err(fault)?;
            entries.push(Entry { x, y, shear });
        }
        entries.sort_by(|a, b| {
            let places = || a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y));
            a.cell().cmp(&b.cell()).then_with(places)
        });
        // A table of several images, or of several catalogues: the first shear would be used for all of them.
        let contradictory = |pair: &&[Entry]| {
            (pair[0].x, pair[0].y) == (pair[1].x, pair[1].y) && pair[0].shear != pair[1].shear
        };
        if let Some([a, b]) = entries.windows(2).find(contradictory) {
            return Err(FileError::new(
                path,
                format!(
                    "the position x = {}, y = {} has two true shears (found {:?} and {:?}, expected one). Try: a table per catalogue, or the columns id, g1, g2",
                    a.x, a.y, a.shear, b.shear
                ),
            ));
        }
        Ok(Positions { entries })
    }

    /// The sign of g2 in which the shears are an E-mode field; `None` if they do not fill a square grid.
    pub(super) fn sign_by_modes(&self) -> Option<TruthSign> {
        let rows = self.entries.iter().map(|entry| Row {
            x: entry.x,
            y: entry.y,
            e1: entry.shear[0],
            e2: entry.shear[1],
        });
        sign_on_any_grid(&rows.collect::<Vec<_>>())
    }

    /// The shear of the nearest place within [`RADIUS`].
    ///
    /// # Errors
    /// If there is none.
    pub fn at(&self, [x, y]: [f64; 2]) -> Result<[f64; 2], String> {
        let own = Entry {
            x,
            y,
            shear: [0.0; 2],
        };
        let (row, column) = own.cell();
        let mut nearest: Option<(f64, [f64; 2])> = None;
        for row in row - 1..=row + 1 {
            let first = self
                .entries
                .partition_point(|e| e.cell() < (row, column - 1));
            let near = self.entries[first..].iter();
            for entry in near.take_while(|e| e.cell() <= (row, column + 1)) {
                let distance = (entry.x - x).hypot(entry.y - y);
                if distance <= RADIUS && nearest.is_none_or(|(least, _)| distance < least) {
                    nearest = Some((distance, entry.shear));
                }
            }
        }
        nearest.map(|(_, shear)| shear).ok_or_else(|| {
            format!(
                "the table of true shears has no galaxy within {RADIUS} pixel of x = {x}, y = {y}. Try: check whether positions begin with 0 or 1, or --drop-missing"
            )
        })
    }
}

/// Refuses what is no shear.
pub(crate) fn check([g1, g2]: [f64; 2]) -> Result<(), String> {
    // Without the square root: this is checked in every row.
    if g1 * g1 + g2 * g2 < 1.0 {
        return Ok(());
    }
    Err(format!(
        "this is no shear (found g1 {g1} and g2 {g2}, expected a modulus below 1)"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_place_within_a_pixel_is_found_across_cells() {
        let places = [
            (0.1, 0.1),
            (0.9, 0.1),
            (10.0, 10.0),
            (-0.4, -0.4),
            (10.0, 11.5),
        ];
        let mut entries: Vec<Entry> = places
            .iter()
            .enumerate()
            .map(|(k, &(x, y))| Entry {
                x,
                y,
                shear: [k as f64, 0.0],
            })
            .collect();
        entries.sort_by_key(Entry::cell);
        let found = Positions { entries };
        for (position, expected) in [
            ([0.1, 0.1], Some(0.0)),
            ([0.6, 0.2], Some(1.0)),
            ([-0.2, -0.2], Some(3.0)),
            ([10.9, 10.2], Some(2.0)),
            ([9.2, 9.5], Some(2.0)),
            ([10.0, 10.8], Some(4.0)),
            ([11.1, 10.0], None),
            ([5.0, 5.0], None),
        ] {
            assert_eq!(
                found.at(position).ok().map(|g| g[0]),
                expected,
                "{position:?}"
            );
        }
    }
}
