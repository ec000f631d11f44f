//! Odd rows of catalogues in sentences.

use shearq_scoring::{Grid, RowCounts, RowFault};

/// The reason not to score these rows, if there is one.
pub fn fault(counts: &RowCounts, grid: &Grid) -> Option<String> {
    let limit = RowCounts::ABSURD;
    Some(match counts.fault()? {
        RowFault::Sentinels {
            rows,
            first: (row, e1, e2),
        } => format!(
            "{rows} rows have a number that no measurement of an ellipticity gives, the first of them row {row} with ({}, {}): if it stands for \"not measured\", try --drop-missing or name it as missing; otherwise set a largest |e|",
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

/// A number in few characters.
pub fn shown(value: f64) -> String {
    match value.abs() >= 1e7 {
        true => format!("{value:e}"),
        false => value.to_string(),
    }
}

/// A line for each kind of odd row in the catalogues of `whose`: how many there are, and how they are scored.
pub fn oddities(counts: &RowCounts, whose: &str) -> Vec<String> {
    let mut lines = Vec::new();
    if counts.outside + counts.excess > 0 {
        lines.push(format!(
            "warning: {whose} has {} outside the grid and {} beyond the number of cells; they do not count.",
            rows(counts.outside),
            counts.excess
        ));
    }
    if counts.repeated > 0 {
        lines.push(format!(
            "warning: {} of {whose} of galaxies that have one already; they add up.",
            rows(counts.repeated)
        ));
    }
    if counts.missing > 0 {
        lines.push(format!(
            "warning: {} of {} galaxies of {whose} are not in the catalogues; each counts as zero.",
            counts.missing,
            counts.missing + counts.used + counts.not_finite - counts.repeated
        ));
    }
    if counts.above_one > 0 {
        lines.push(format!(
            "warning: {} of {whose} with |e| > 1, {} with |e| > {}; scored unchanged.",
            rows(counts.above_one),
            counts.absurd,
            RowCounts::ABSURD
        ));
    }
    if counts.not_finite > 0 {
        lines.push(format!(
            "note: {} of {} galaxies of {whose} have no ellipticity (NaN, flagged, marked as missing, or a distortion above 1, which noise makes) and count as missing.",
            counts.not_finite,
            counts.not_finite + counts.used
        ));
    }
    lines
}

/// `count` rows, in words.
fn rows(count: usize) -> String {
    format!("{count} row{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> RowCounts {
        RowCounts {
            used: 64,
            ..RowCounts::default()
        }
    }

    #[test]
    fn faults_name_the_numbers_and_the_first_row() {
        let grid = Grid::great10(8).unwrap();
        assert_eq!(fault(&good(), &grid), None);
        let sentinel = RowCounts {
            sentinels: 3,
            first_sentinel: Some((7, -99.0, 99.0)),
            ..good()
        };
        let absurd = RowCounts {
            absurd: 4,
            first_absurd: Some((2, 7.5, 0.1)),
            ..good()
        };
        let repeated = RowCounts {
            repeated: 33,
            ..good()
        };
        let expected: [(RowCounts, &[&str]); 3] = [
            (
                sentinel,
                &["3 rows have a number that no", "row 7 with (-99, 99)"],
            ),
            (
                absurd,
                &["4 of 64 rows have |e| > 5", "row 2 with (7.5, 0.1)"],
            ),
            (repeated, &["33 of 64 rows", "48 px", "8 × 8 grid"]),
        ];
        for (counts, expected) in expected {
            let fault = fault(&counts, &grid).unwrap();
            for words in expected {
                assert!(fault.contains(words), "{fault}");
            }
        }
    }

    #[test]
    fn each_kind_of_odd_row_has_a_line() {
        assert!(oddities(&good(), "x").is_empty());
        let odd = RowCounts {
            used: 50,
            outside: 1,
            excess: 2,
            not_finite: 3,
            repeated: 4,
            missing: 15,
            above_one: 5,
            absurd: 2,
            ..RowCounts::default()
        };
        let lines = oddities(&odd, "set 7");
        let expected = [
            "set 7 has 1 row outside the grid and 2 beyond",
            "4 rows of set 7",
            "15 of 64 galaxies of set 7 are not in the catalogues",
            "5 rows of set 7 with |e| > 1, 2 with |e| > 5",
            "3 of 53 galaxies of set 7 have no ellipticity",
        ];
        assert_eq!(lines.len(), expected.len());
        for (line, words) in lines.iter().zip(expected) {
            assert!(line.contains(words), "{line}");
        }
        let (outside, excess) = (
            RowCounts {
                outside: 1,
                ..good()
            },
            RowCounts {
                excess: 1,
                ..good()
            },
        );
        assert_eq!(oddities(&outside, "x").len(), 1);
        assert_eq!(oddities(&excess, "x").len(), 1);
    }
}
